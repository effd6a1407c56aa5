//! Scene flow: velocities of Gaussians as image channels, and rendered 2D flow between two times and cameras.
//!
//! A motion model already *is* scene flow; everything here is written once over [`Motion::at`] and
//! [`Motion::velocity`](crate::motion::Motion::velocity) and rendered as further channels of the renderer, with the
//! blend weights w_i = α_i T_i of the first time's image.
//!
//! [`Motion::at`]: crate::motion::Motion::at

pub mod lift;
pub mod query;
#[cfg(test)]
mod tests;
pub mod tracks;

use crate::layers::{Evaluation, Scene};
use crate::math::Real;
use crate::render::{self, Image, Renderer};
use crate::scene::{Camera, Planes, Space, Splats, Table, Time};

/// Less alpha than this does not carry a flow: dividing by it would only amplify rounding.
pub(crate) const FLOW_ALPHA_MIN: f64 = 1e-3;

/// A scene at one time, seen by a camera.
#[derive(Clone, Copy, Debug)]
pub struct Shot<'a> {
    /// When.
    pub t: Time,
    /// From where (pinhole).
    pub camera: &'a Camera,
}

/// A rendered vector field.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Flow<F = f32> {
    /// [C, h, w]: Σ w_i s_i / max(Σ w_i, `FLOW_ALPHA_MIN`).
    pub vectors: Planes<F>,
    /// Σ w_i over splats that have a vector, [1, h, w]; where it is small the vector means nothing.
    pub weight: Planes<F>,
    /// The first time's image.
    pub image: Image<F>,
}

/// dμ/dt of every splat of `scene.at(t, instant)`, in the order of the splats: [splats, 3], scene units per second.
///
/// Panics: `instant` is not this scene's.
pub fn velocities<F: Real>(scene: &Scene<F>, instant: &Evaluation<F>) -> Table<F> {
    let mut out = Table::new(&[("velocity", 3)], scene.splats(instant).len());
    let mut first = 0;
    for (layer, tape) in scene.layers.iter().zip(instant.tapes()) {
        let mut own = Table::default();
        layer.motion.velocity(&tape.query(&layer.params), &mut own);
        for j in 0..own.rows() {
            let v = own.read::<3>(j, 0);
            let framed = || layer.frame.vector(v.map(F::f64)).map(F::of);
            out.write(first + j, 0, if layer.frame.is_identity() { v } else { framed() });
        }
        first += own.rows();
    }
    out
}

/// [`velocities`] as further channels of an image: [splats, 4], x, y, z and 1 ([`divided`]).
///
/// Panics: `instant` is not this scene's.
pub fn velocity_columns<F: Real>(scene: &Scene<F>, instant: &Evaluation<F>) -> Table<F> {
    let moving = velocities(scene, instant);
    let mut extra = Table::new(&[("velocity", 3), ("valid", 1)], moving.rows());
    for j in 0..moving.rows() {
        let [x, y, z] = moving.read::<3>(j, 0);
        extra.write(j, 0, [x, y, z, F::ONE]);
    }
    extra
}

/// 2D flow in pixels, [2, h, w] (x right, y down): F(p) = Σ w_i [π_to(μ_i(t_to)) − π_from(μ_i(t_from))] / Σ w_i.
///
/// The rows alive at `from.t` are followed to `to.t`, whatever their temporal opacity there. With the same camera for
/// both it is the flow of objects alone, else the camera's motion is in it. A splat that is behind a camera has no
/// vector. Source: "F_simple" of rendered optical flow, Σ w Δμ_2D, as in Gao et al. 2024 (GaussianFlow) §3.2 without
/// its covariance term.
pub fn render_flow<F: Real>(scene: &Scene<F>, from: Shot<'_>, to: Shot<'_>, renderer: &mut Renderer<F>) -> Flow<F> {
    let mut start = Evaluation::default();
    scene.at(from.t, &mut start);
    let extra = flow_columns(scene, &start, from.camera, to);
    draw(&scene.splats(&start), from.camera, scene.background, &extra, renderer)
}

/// The displacement of every splat on the screen as further channels of an image: [splats, 3], u, v in pixels and 1, or
/// zeros for a splat that is behind a camera ([`divided`]).
///
/// Panics: `start` is not this scene's.
pub fn flow_columns<F: Real>(scene: &Scene<F>, start: &Evaluation<F>, from: &Camera, to: Shot<'_>) -> Table<F> {
    let mut end = Evaluation::default();
    follow(scene, start, to.t, &mut end);
    let mut extra = Table::new(&[("flow", 2), ("valid", 1)], scene.splats(start).len());
    let mut j = 0;
    for (a, b) in start.tapes().zip(end.tapes()) {
        for r in 0..a.out().rows() {
            let [at, then] = [a, b].map(|t| t.out().read::<3>(r, 0).map(F::f64));
            if let (Some((p, _)), Some((q, _))) = (from.project(at), to.camera.project(then)) {
                extra.write(j, 0, [F::of(q[0] - p[0]), F::of(q[1] - p[1]), F::ONE]);
            }
            j += 1;
        }
    }
    extra
}

/// The same rows as in `of`, at time t.
fn follow<F: Real>(scene: &Scene<F>, of: &Evaluation<F>, t: Time, out: &mut Evaluation<F>) {
    out.begin();
    for (layer, from) in of.tapes().enumerate() {
        out.request(layer, Space::Gaussians, from.rows(), t);
    }
    out.evaluate(&scene.layers);
}

/// Blends vectors (all columns but the last) and divides by the blended last column, 1 where there is a vector.
fn draw<F: Real>(
    splats: &Splats<'_, F>,
    camera: &Camera,
    background: [f32; 3],
    extra: &Table<F>,
    renderer: &mut Renderer<F>,
) -> Flow<F> {
    let mut image = Image::default();
    let background = background.map(|b| F::of(f64::from(b)));
    let shot = render::Shot { extra: Some(extra), depth: true, ..render::Shot::new(splats, camera, background) };
    renderer.render(&shot, &mut image);
    let (vectors, weight) = divided(&image.extra);
    Flow { vectors, weight, image }
}

/// Blended channels, of which the last is Σ w_i of the splats that have a value: the others over that, [C − 1, h, w],
/// and it, [1, h, w]. Where it is small the values mean nothing.
pub fn divided<F: Real>(extra: &Planes<F>) -> (Planes<F>, Planes<F>) {
    let count = extra.channels - 1;
    let mut values = Planes::new(count, extra.height, extra.width);
    let mut weight = Planes::new(1, extra.height, extra.width);
    weight.data.copy_from_slice(extra.plane(count));
    for c in 0..count {
        let sums = extra.plane(c).iter().zip(&weight.data);
        for (out, (&sum, &w)) in values.plane_mut(c).iter_mut().zip(sums) {
            *out = sum / w.max(F::of(FLOW_ALPHA_MIN));
        }
    }
    (values, weight)
}
