//! Renders as cameras with a [`Shutter`] take them: every Gaussian at the time of its own row, and the average of
//! several subframes.
//!
//! The scene is evaluated at three times, the nodes: the image's time, and the first and the last light of its rows.
//! Between two nodes Gaussians change linearly, which keeps covariances positive and opacities below 1. The row of a
//! Gaussian is that of its centre, found by two fixed-point steps. A camera that moves meanwhile is replaced by a scene
//! that moves the other way.
//!
//! Cost: two more evaluations of the motion model per image, and one more render and backward pass for each further
//! subframe (two renders, because subframes are rendered again for the backward pass).
//!
//! The gradient treats rows as fixed. The neglected part is the share of the image's height that a Gaussian crosses
//! during the readout: a few percent in fast films.

use crate::capture::shutter::Shutter;
use crate::loss::image::View;
use crate::train_state::moved;
use rayon::prelude::*;
use splat4d::Result;
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::{Real, Se3};
use splat4d::render::{Backend, Image, ImageGrads, RenderGrads, Shot};
use splat4d::scene::splats::COV;
use splat4d::scene::{Camera, Grads, Planes, Rows, Space, Splats, Table, Time};

/// Times at which the scene is evaluated: that of the image, then the first and the last.
const NODES: usize = 3;
/// Fixed-point steps that find a Gaussian's row; a third one changes times by less than a microsecond.
const FIXED_POINT: usize = 2;
/// Subframes are averaged as light: codes are about the 2.2th root of it (sRGB, IEC 61966-2-1).
const GAMMA: f64 = 2.2;
/// Codes below this are averaged as they are: the root has no derivative at 0.
const DARK: f64 = 1e-3;

/// Mean 3, covariance 6, opacity 1.
type Row<F> = [F; 10];

/// The times of an image at which Gaussians are evaluated.
pub(crate) fn times(t: Time, shutter: Option<&Shutter>) -> impl Iterator<Item = Time> + use<> {
    let count = if shutter.is_some() { NODES } else { 1 };
    nodes(t, shutter.map_or(0.0, Shutter::half)).into_iter().take(count)
}

fn nodes(t: Time, half: f64) -> [Time; NODES] {
    [t, Time(t.0 - half), Time(t.0 + half)]
}

/// Lets the queries for the nodes of each view have the same rows. All nodes were requested.
pub(crate) fn align<F: Real>(evaluation: &mut Evaluation<F>, layers: usize, views: &[(Time, Shutter)]) {
    let count = |evaluation: &Evaluation<F>, i: usize| match evaluation.tape(i).rows() {
        Rows::All => usize::MAX,
        Rows::Some(ids) => ids.len(),
    };
    // A query that two views share may grow a second time; every one ends with all rows at the latest.
    let mut changed = true;
    while std::mem::take(&mut changed) {
        for (t, shutter) in views {
            let times = nodes(*t, shutter.half());
            for layer in 0..layers {
                for (&from, &to) in times.iter().flat_map(|a| times.iter().map(move |b| (a, b))) {
                    let [from, target] = [from, to].map(|t| query(evaluation, layer, t));
                    let before = count(evaluation, target);
                    evaluation.request_again(from, to);
                    changed |= count(evaluation, target) != before;
                }
            }
        }
    }
}

fn query<F: Real>(evaluation: &Evaluation<F>, layer: usize, t: Time) -> usize {
    evaluation.find(layer, Space::Gaussians, t).expect("every node was queried")
}

/// Shares of the nodes at a time between them.
fn shares(after: f64, half: f64) -> [f64; NODES] {
    let x = (after / half).clamp(-1.0, 1.0);
    [1.0 - x.abs(), (-x).max(0.0), x.max(0.0)]
}

/// A subframe of an image: the splats of all layers, each at its own time.
#[derive(Default)]
pub(crate) struct Exposed<F: Real> {
    /// By layer.
    tables: Vec<Table<F>>,
    /// By layer and splat: seconds from the image's time.
    after: Vec<Vec<f64>>,
    rows: Vec<(Row<F>, f64)>,
}

/// An image's shutter, its camera and time.
#[derive(Clone, Copy)]
pub(crate) struct Taken<'a> {
    pub(crate) camera: &'a Camera,
    pub(crate) t: Time,
    pub(crate) shutter: &'a Shutter,
}

impl<'a> Taken<'a> {
    /// Of a view, if its shutter is not ideal.
    pub(crate) fn of<F: Real>(view: &'a View<'_, F>) -> Option<Self> {
        Some(Self { camera: view.camera, t: view.t, shutter: view.shutter.as_ref()? })
    }

    /// By node: how the world moves, seen from the camera's pose at the image's time. `None`: the camera is fixed.
    fn motions(&self) -> Option<[Se3; NODES]> {
        let Shutter { twist, .. } = *self.shutter;
        if twist == [0.0; 6] {
            return None;
        }
        let (pose, half) = (&self.camera.cam_from_world, self.shutter.half());
        let at = |after: f64| pose.inverse().after(&moved(pose, twist.map(|v| v * after)));
        Some([Se3::IDENTITY, at(-half), at(half)])
    }

    /// When the row of a point is read, seconds from the middle row.
    fn row_of(&self, mean: [f64; 3]) -> f64 {
        let k = &self.camera.intrinsics;
        let p = self.camera.cam_from_world.apply(mean);
        let share = if p[2] > self.camera.near { (k.fy * p[1] / p[2] + k.cy) / self.camera.height as f64 } else { 0.5 };
        self.shutter.row(share)
    }
}

impl<F: Real> Exposed<F> {
    /// Makes the splats of subframe `k`.
    pub(crate) fn expose(&mut self, evaluation: &Evaluation<F>, layers: usize, taken: Taken<'_>, k: usize) {
        let (half, begin) = (taken.shutter.half(), taken.shutter.subframe(k));
        let motions = taken.motions();
        let times = nodes(taken.t, half);
        self.tables.resize_with(layers, Table::default);
        self.after.resize_with(layers, Vec::new);
        for layer in 0..layers {
            let nodes: [&Table<F>; NODES] =
                std::array::from_fn(|n| evaluation.tape(query(evaluation, layer, times[n])).out());
            let rows = nodes[0].rows();
            assert!(nodes.iter().all(|table| table.rows() == rows), "nodes have the same rows");
            let expose = |j: usize| {
                let at: [Row<F>; NODES] = std::array::from_fn(|n| {
                    let row = nodes[n].read::<10>(j, 0);
                    motions.as_ref().filter(|_| n > 0).map_or(row, |motions| carry(&motions[n], row))
                });
                let mix = |after: f64| -> Row<F> {
                    let w = shares(after, half).map(F::of);
                    std::array::from_fn(|c| w[0] * at[0][c] + w[1] * at[1][c] + w[2] * at[2][c])
                };
                let mut after = begin;
                if taken.shutter.readout != 0.0 {
                    for _ in 0..FIXED_POINT {
                        let [x, y, z, ..] = mix(after);
                        after = begin + taken.row_of([x, y, z].map(Real::f64));
                    }
                }
                (mix(after), after)
            };
            (0..rows).into_par_iter().with_min_len(512).map(expose).collect_into_vec(&mut self.rows);
            let table = &mut self.tables[layer];
            if table.width() != nodes[0].width() {
                *table = Table::with_columns(nodes[0].columns().to_vec(), 0);
            }
            table.resize(rows);
            self.after[layer].clear();
            for (j, (row, after)) in self.rows.iter().enumerate() {
                table.write(j, 0, *row);
                self.after[layer].push(*after);
            }
        }
    }

    /// These splats, with the colours of the image's time; where nothing was `exposed`, those of that time.
    pub(crate) fn shown<'a>(
        &'a self,
        evaluation: &'a Evaluation<F>,
        scene: &'a Scene<F>,
        t: Time,
        exposed: bool,
    ) -> Splats<'a, F> {
        let mut splats = evaluation.splats(scene, t);
        if !exposed {
            return splats;
        }
        splats.parts.iter_mut().zip(&self.tables).for_each(|(part, table)| part.out = table);
        splats
    }

    /// The VJP of [`expose`](Self::expose), for rows that stay: adds to the gradients of the nodes. The tables of `d`
    /// may be replaced by others with undefined numbers.
    pub(crate) fn backward(
        &self,
        d: &mut RenderGrads<F>,
        scene: &Scene<F>,
        taken: Taken<'_>,
        evaluation: &mut Evaluation<F>,
        d_layers: &mut [Grads<F>],
    ) {
        let half = taken.shutter.half();
        let motions = taken.motions();
        let times = nodes(taken.t, half);
        for (layer, part) in d.parts.iter_mut().enumerate() {
            let queries: [usize; NODES] = std::array::from_fn(|n| query(evaluation, layer, times[n]));
            for (j, &after) in self.after[layer].iter().enumerate() {
                let row = part.out.read::<10>(j, 0);
                if row.iter().all(|x| *x == F::ZERO) {
                    continue;
                }
                let w = shares(after, half);
                for n in (1..NODES).filter(|&n| w[n] > 0.0) {
                    let d_row = row.map(|x| x * F::of(w[n]));
                    let d_row = motions.as_ref().map_or(d_row, |motions| carry_backward(&motions[n], d_row));
                    evaluation.d_out(queries[n]).add(j, 0, d_row);
                }
                part.out.write(j, 0, row.map(|x| x * F::of(w[0])));
            }
        }
        d.add_to(scene, taken.t, evaluation, d_layers);
    }
}

/// A splat after a rigid motion.
fn carry<F: Real>(motion: &Se3, row: Row<F>) -> Row<F> {
    let r = motion.rotation.map(|row| row.map(F::of));
    let mut out = row;
    for k in 0..3 {
        out[k] = r[k][0] * row[0] + r[k][1] * row[1] + r[k][2] * row[2] + F::of(motion.translation[k]);
    }
    let full = symmetric([row[COV], row[COV + 1], row[COV + 2], row[COV + 3], row[COV + 4], row[COV + 5]]);
    let turned = conjugate(&r, &full);
    for (c, (i, j)) in PACKED.into_iter().enumerate() {
        out[COV + c] = turned[i][j];
    }
    out
}

/// Its VJP.
fn carry_backward<F: Real>(motion: &Se3, d: Row<F>) -> Row<F> {
    let r = motion.rotation.map(|row| row.map(F::of));
    let back: [[F; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| r[j][i]));
    let mut out = d;
    for k in 0..3 {
        out[k] = back[k][0] * d[0] + back[k][1] * d[1] + back[k][2] * d[2];
    }
    // An off-diagonal's gradient covers both its positions.
    let half = |c: usize| F::HALF * d[COV + c];
    let full = symmetric([d[COV], half(1), half(2), d[COV + 3], half(4), d[COV + 5]]);
    let turned = conjugate(&back, &full);
    for (c, (i, j)) in PACKED.into_iter().enumerate() {
        out[COV + c] = if i == j { turned[i][j] } else { F::TWO * turned[i][j] };
    }
    out
}

/// Positions of a packed symmetric matrix.
const PACKED: [(usize, usize); 6] = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)];

fn symmetric<F: Real>([xx, xy, xz, yy, yz, zz]: [F; 6]) -> [[F; 3]; 3] {
    [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
}

/// R S Rᵀ.
fn conjugate<F: Real>(r: &[[F; 3]; 3], s: &[[F; 3]; 3]) -> [[F; 3]; 3] {
    let product = |a: &[F; 3], b: &[F; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let rs: [[F; 3]; 3] =
        std::array::from_fn(|i| std::array::from_fn(|j| r[i][0] * s[0][j] + r[i][1] * s[1][j] + r[i][2] * s[2][j]));
    std::array::from_fn(|i| std::array::from_fn(|j| product(&rs[i], &r[j])))
}

/// The average of subframes: colours as light, other channels as they are.
#[derive(Default)]
pub(crate) struct Average<F> {
    light: Planes<F>,
}

impl<F: Real> Average<F> {
    /// Adds subframe k of n to `sum`, which is the average after the last one.
    pub(crate) fn add(&mut self, sum: &mut Image<F>, part: &Image<F>, [k, n]: [usize; 2]) {
        let share = F::of(1.0 / n as f64);
        if k == 0 {
            sum.clone_from(part);
            for planes in [&mut sum.alpha, &mut sum.depth, &mut sum.extra] {
                planes.data.iter_mut().for_each(|x| *x *= share);
            }
            self.light.reset(part.color.channels, part.color.height, part.color.width);
        } else {
            let others = [(&mut sum.alpha, &part.alpha), (&mut sum.depth, &part.depth), (&mut sum.extra, &part.extra)];
            for (sum, part) in others {
                sum.data.iter_mut().zip(&part.data).for_each(|(x, y)| *x += share * *y);
            }
        }
        self.light.data.iter_mut().zip(&part.color.data).for_each(|(x, y)| *x += share * light(*y));
        if k + 1 == n {
            sum.color.data.iter_mut().zip(&self.light.data).for_each(|(x, y)| *x = code(*y));
        }
    }
}

/// Light of a code. Below [`DARK`] a line with the same value there.
fn light<F: Real>(code: F) -> F {
    match code.f64() > DARK {
        true => power(code, GAMMA),
        false => code * F::of(DARK.powf(GAMMA - 1.0)),
    }
}

/// Its inverse.
fn code<F: Real>(light: F) -> F {
    match light.f64() > DARK.powf(GAMMA) {
        true => power(light, 1.0 / GAMMA),
        false => light * F::of(DARK.powf(1.0 - GAMMA)),
    }
}

/// Derivative of [`light`].
fn d_light<F: Real>(code: F) -> F {
    match code.f64() > DARK {
        true => F::of(GAMMA) * power(code, GAMMA - 1.0),
        false => F::of(DARK.powf(GAMMA - 1.0)),
    }
}

fn power<F: Real>(x: F, exponent: f64) -> F {
    (F::of(exponent) * x.ln()).exp()
}

/// The gradient to one subframe of an average.
#[derive(Default)]
pub(crate) struct Share<F> {
    color: Planes<F>,
    alpha: Option<Planes<F>>,
    depth: Option<Planes<F>>,
    extra: Option<Planes<F>>,
}

impl<F: Real> Share<F> {
    /// Of the gradient to the average of n, with the subframe and the average as they are.
    pub(crate) fn take(&mut self, d: &ImageGrads<'_, F>, part: &Image<F>, average: &Image<F>, n: usize) {
        let share = F::of(1.0 / n as f64);
        self.color.clone_from(d.color);
        let pixels = part.color.data.iter().zip(&average.color.data);
        for (d, (x, y)) in self.color.data.iter_mut().zip(pixels) {
            *d *= share * d_light(*x) / d_light(*y);
        }
        let scaled = |planes: Option<&Planes<F>>| {
            planes.map(|planes| {
                let mut planes = planes.clone();
                planes.data.iter_mut().for_each(|x| *x *= share);
                planes
            })
        };
        (self.alpha, self.depth, self.extra) = (scaled(d.alpha), scaled(d.depth), scaled(d.extra));
    }

    /// As the renderer takes it.
    pub(crate) fn grads(&self) -> ImageGrads<'_, F> {
        ImageGrads {
            color: &self.color,
            alpha: self.alpha.as_ref(),
            depth: self.depth.as_ref(),
            extra: self.extra.as_ref(),
        }
    }
}

/// Renders colours of a scene as a camera with a shutter takes them. Errors: those of the backend.
pub(crate) fn render<F: Real>(
    scene: &Scene<F>,
    taken: Taken<'_>,
    evaluation: &mut Evaluation<F>,
    backend: &mut dyn Backend<F>,
    out: &mut Image<F>,
) -> Result<()> {
    evaluation.begin();
    for t in times(taken.t, Some(taken.shutter)) {
        for (index, layer) in scene.layers.iter().enumerate() {
            evaluation.request_active(index, layer, t);
        }
    }
    align(evaluation, scene.layers.len(), &[(taken.t, *taken.shutter)]);
    evaluation.evaluate(&scene.layers);
    let (mut exposed, mut average, mut part) = (Exposed::default(), Average::default(), Image::default());
    let n = taken.shutter.subframes;
    for k in 0..n {
        exposed.expose(evaluation, scene.layers.len(), taken, k);
        let splats = exposed.shown(evaluation, scene, taken.t, true);
        let background = scene.background.map(|x| F::of(f64::from(x)));
        let shot = Shot::new(&splats, taken.camera, background);
        if n == 1 {
            return backend.render(&shot, out);
        }
        backend.render(&shot, &mut part)?;
        average.add(out, &part, [k, n]);
    }
    Ok(())
}
