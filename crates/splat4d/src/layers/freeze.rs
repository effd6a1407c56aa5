//! Evaluates a dynamic scene at one time as static Gaussians, as 3DGS files store them.

use super::{Evaluation, Layer, LayerTape, Scene};
use crate::Result;
use crate::math::sh::MAX_COEFFS;
use crate::math::sh_rotation::{rotate_coefficients, sh_rotation};
use crate::math::{Real, Sim3, logit, quat, sym3};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::{Color, GEOMETRY, Key, LIFE, LifeKind, Params, Rows, SH, Space, Time};
use rayon::prelude::*;

/// Y00, by which the base coefficient becomes colour; colour is ½ at coefficient 0 (Kerbl et al. 2023).
const SH0: f32 = crate::math::sh::C0 as f32;
/// Share of the trace by which a covariance may differ before it counts as turned or stretched: f32 rounding.
const SAME: f64 = 1e-5;
/// Smallest scale of a decomposition, as a share of the largest: below it f32 covariances hold no digit.
const THINNEST: f64 = 1e-4;
/// Opacities are kept this far from 0 and 1, where logits are infinite.
const OPACITY_MARGIN: f32 = 1e-6;

/// The Gaussians that are alive at `time`, all layers together, in the world, as a still layer's parameters.
///
/// Errors: the scene has a head, without which its Gaussians look different.
pub fn freeze(scene: &Scene<f32>, time: Time) -> Result<Params<f32>> {
    scene.without_head("plain Gaussians")?;
    let mut instant = Evaluation::default();
    scene.at(time, &mut instant);
    let coefficients = coefficients(scene);
    let rows = instant.tapes().map(|t| t.out().rows()).sum();
    let mut params = Params::new(rows, coefficients, LifeKind::Infinite.columns());
    let mut first = 0;
    for (layer, tape) in scene.layers.iter().zip(instant.tapes()) {
        write(layer, tape, coefficients, first, &mut params);
        first += tape.out().rows();
    }
    Ok(params)
}

/// The same, but the static background anyway keeps its very bits.
pub fn moment(scene: &Scene<f32>, time: Time) -> Result<Params<f32>> {
    scene.without_head("plain Gaussians")?;
    match &scene.layers[..] {
        [only] if !scene.is_moving() && only.frame.is_identity() => Ok(only.params.clone()),
        _ => freeze(scene, time),
    }
}

/// These rows of a layer (strictly increasing) at `time`, lifespan and frame included, as a still layer's parameters;
/// of Gaussians with features only the base colour is left.
pub fn freeze_rows(layer: &Layer<f32>, rows: &[u32], time: Time) -> Params<f32> {
    let seen = Evaluation::of_layer(layer, Space::Gaussians, Rows::Some(rows), time);
    let coefficients = (layer.params[SH].width() / 3).clamp(1, MAX_COEFFS);
    let mut params = Params::new(rows.len(), coefficients, LifeKind::Infinite.columns());
    write(layer, seen.tape(0), coefficients, 0, &mut params);
    params
}

/// The Gaussians alive at one time as row-major arrays of activated numbers, as renderers of still Gaussians take them
/// (gsplat's `rasterization`).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    /// [N, 3] world.
    pub means: Vec<[f32; 3]>,
    /// [N, 4] unit, wxyz.
    pub quats: Vec<[f32; 4]>,
    /// [N, 3] standard deviations along the axes, scene units.
    pub scales: Vec<[f32; 3]>,
    /// `[N]` in (0, 1), life applied.
    pub opacities: Vec<f32>,
}

/// Rows that a task turns into plain Gaussians: some hundred microseconds.
const ROWS: usize = 1024;

impl Gaussians {
    /// The content of `seen` after [`Scene::at`], all layers together. Colours: [`Gaussians::sh`].
    pub fn of(scene: &Scene<f32>, seen: &Evaluation) -> Self {
        let rows = seen.tapes().map(|t| t.out().rows()).sum();
        let mut all = Self {
            means: vec![[0.0; 3]; rows],
            quats: vec![[0.0; 4]; rows],
            scales: vec![[0.0; 3]; rows],
            opacities: vec![0.0; rows],
        };
        let mut first = 0;
        for (layer, tape) in scene.layers.iter().zip(seen.tapes()) {
            let (shapes, part) = (Shapes::new(layer, tape), layer.part(tape));
            let end = first + part.out.rows();
            let means = all.means[first..end].par_chunks_mut(ROWS);
            let quats = all.quats[first..end].par_chunks_mut(ROWS);
            let scales = all.scales[first..end].par_chunks_mut(ROWS);
            let opacities = all.opacities[first..end].par_chunks_mut(ROWS);
            let chunks = means.zip(quats).zip(scales).zip(opacities).enumerate();
            chunks.for_each(|(chunk, (((means, quats), scales), opacities))| {
                for i in 0..means.len() {
                    let j = chunk * ROWS + i;
                    means[i] = part.out.read::<3>(j, 0);
                    opacities[i] = part.out.get(j, SPLAT_OPACITY);
                    (quats[i], scales[i]) = shapes.activated(j, part.out.read::<6>(j, COV));
                }
            });
            first = end;
        }
        all
    }

    /// Spherical harmonics [N, K, 3] of the same rows, and K.
    pub fn sh(scene: &Scene<f32>, seen: &Evaluation) -> (Vec<f32>, usize) {
        let (count, rows) = (coefficients(scene), seen.tapes().map(|t| t.out().rows()).sum::<usize>());
        let (width, mut first) = (3 * count, 0);
        let mut all = vec![0.0; rows * width];
        for (layer, tape) in scene.layers.iter().zip(seen.tapes()) {
            let part = layer.part(tape);
            let sh_matrix = part.layer_from_world.map(|_| sh_rotation(&layer.frame.rotation));
            let end = first + part.out.rows() * width;
            all[first..end].par_chunks_mut(ROWS * width).enumerate().for_each(|(chunk, rows)| {
                for (i, row) in rows.chunks_exact_mut(width).enumerate() {
                    coefficients_of(&part.color, chunk * ROWS + i, row);
                    if let Some(m) = &sh_matrix {
                        rotate_coefficients(m, row);
                    }
                }
            });
            first = end;
        }
        (all, count)
    }
}

/// Most coefficients of spherical harmonics that a layer has.
fn coefficients(scene: &Scene<f32>) -> usize {
    scene.layers.iter().map(|l| l.params[SH].width() / 3).max().unwrap_or(1).clamp(1, MAX_COEFFS)
}

/// Shapes of a layer's splats as quaternions and log scales.
struct Shapes<'a> {
    layer: &'a Layer<f32>,
    tape: &'a LayerTape<f32>,
    /// Quaternion rates, and the centre of those who have infinite lifespans.
    turning: Option<(Key, f64)>,
}

impl<'a> Shapes<'a> {
    fn new(layer: &'a Layer<f32>, tape: &'a LayerTape<f32>) -> Self {
        let turning = layer.motion.polynomial().and_then(|p| Some((p.rotation_rates?, p.origin)));
        Self { layer, tape, turning }
    }

    /// The raw quaternion and log scales of splat j, whose covariance is `cov`.
    fn of(&self, j: usize, cov: [f64; 6]) -> ([f64; 4], [f64; 3]) {
        let (q, log_scales) = self.learnt(j);
        let own = framed_shape(&self.layer.frame, q, log_scales);
        // Most motion turns shapes at most: then the learnt numbers are exact and a decomposition is not.
        if unchanged(own, cov) { own } else { decomposed(cov) }
    }

    /// The unit quaternion and the scales of splat j, whose covariance is `cov`.
    #[inline(always)]
    fn activated(&self, j: usize, cov: [f32; 6]) -> ([f32; 4], [f32; 3]) {
        let own = self.learnt(j);
        if self.layer.frame.is_identity() && unchanged(own, cov) {
            return (quat::normalize(own.0).0, own.1.map(Real::exp));
        }
        let (q, s) = self.of(j, cov.map(f64::from));
        (quat::normalize(q).0.map(|x| x as f32), s.map(|s| s.exp() as f32))
    }

    /// The raw quaternion, rotated to the time, and the log scales of splat j, in the layer's axes.
    #[inline(always)]
    fn learnt(&self, j: usize) -> ([f32; 4], [f32; 3]) {
        let (id, raw) = (self.tape.rows().id(j), &self.layer.params[GEOMETRY]);
        let mut q = raw.read::<4>(id, QUAT);
        if let Some((rates, origin)) = self.turning {
            let life = &self.layer.params[LIFE];
            let center = if life.width() > 0 { f64::from(life.get(id, 0)) } else { origin };
            let (rates, delta) = (self.layer.params[rates].read::<4>(id, 0), (self.tape.time().0 - center) as f32);
            q = std::array::from_fn(|k| q[k] + rates[k] * delta);
        }
        (q, raw.read(id, LOG_SCALE))
    }
}

/// Writes what a tape holds into rows of a still layer, from `first` on.
fn write(layer: &Layer<f32>, tape: &LayerTape<f32>, coefficients: usize, first: usize, params: &mut Params<f32>) {
    let (shapes, part) = (Shapes::new(layer, tape), layer.part(tape));
    let sh_matrix = part.layer_from_world.map(|_| sh_rotation(&layer.frame.rotation));
    let mut colors = vec![0.0; 3 * coefficients];
    for j in 0..part.out.rows() {
        let row = first + j;
        let mean = part.out.read::<3>(j, 0);
        let cov = part.out.read::<6>(j, COV).map(f64::from);
        let (q, s) = shapes.of(j, cov);
        let [geometry, sh] = params.get_mut([GEOMETRY, SH]);
        geometry.write(row, 0, mean);
        geometry.write(row, QUAT, q.map(|x| x as f32));
        geometry.write(row, LOG_SCALE, s.map(|x| x as f32));
        geometry.set(row, OPACITY, logit(part.out.get(j, SPLAT_OPACITY), OPACITY_MARGIN));
        coefficients_of(&part.color, j, &mut colors);
        if let Some(m) = &sh_matrix {
            rotate_coefficients(m, &mut colors);
        }
        for (k, value) in colors.iter().enumerate() {
            sh.set(row, k, *value);
        }
    }
}

/// A learnt shape (raw quaternion and log scales) as the frame shows it.
pub(crate) fn framed_shape(frame: &Sim3, q: [f32; 4], log_scales: [f32; 3]) -> ([f64; 4], [f64; 3]) {
    let own = (q.map(f64::from), log_scales.map(f64::from));
    if frame.is_identity() {
        return own;
    }
    (quat::product(quat::from_rotation(&frame.rotation), own.0), own.1.map(|s| s + frame.scale.ln()))
}

/// Whether a shape has this covariance.
#[inline(always)]
fn unchanged<F: Real>((q, s): ([F; 4], [F; 3]), cov: [F; 6]) -> bool {
    let own = sym3::from_quat_log_scales(quat::normalize(q).0, s);
    let most = F::of(SAME) * (cov[0] + cov[3] + cov[5]).abs();
    own.iter().zip(cov).all(|(a, b)| (*a - b).abs() <= most)
}

fn decomposed(cov: [f64; 6]) -> ([f64; 4], [f64; 3]) {
    let largest = cov[0].max(cov[3]).max(cov[5]).max(0.0).sqrt();
    sym3::to_quat_log_scales(cov, (THINNEST * largest).max(1e-12))
}

/// Writes the SH coefficients [K·3] of one splat; those that it lacks are zero.
fn coefficients_of(color: &Color<'_>, j: usize, out: &mut [f32]) {
    let (id, table, width, weights) = match color {
        Color::Sh { table, rows, weights, .. } => {
            (rows.id(j), table, table.width() / weights.map_or(1, |w| w.width().max(1)), weights)
        }
        Color::Direct { table } => (j, table, 3.min(table.width()), &None),
    };
    out.fill(0.0);
    for (k, out) in out.iter_mut().enumerate().take(width) {
        *out = match (color, weights) {
            (Color::Direct { .. }, _) => (table.get(id, k) - 0.5) / SH0,
            (_, Some(w)) => (0..w.width().max(1)).map(|b| w.get(j, b) * table.get(id, b * width + k)).sum(),
            _ => table.get(id, k),
        };
    }
}
