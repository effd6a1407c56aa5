//! How strongly images react to an error of each Gaussian, measured on renders of the model.
//!
//! A Gaussian behind a wall, or one with its neighbours' colour, may be off by pixels without a visible effect; the
//! edge of a sign may not. [`Importance::sensitivities`] gives the exact second moment of the image's gradient for each
//! Gaussian alone. Some cameras at some times represent all. Of a camera that moves, each time has its own pose: a
//! Gaussian counts when that camera sees it. A Gaussian that no render sees keeps a share of the weight that its size
//! and opacity give, so that it is not lost for other views.

use super::sample::GEOMETRY;
use super::sampling::Viewpoints;
use crate::layers::{Evaluation, Scene};
use crate::math::sym3;
use crate::render::{Importance, RenderConfig, Shot};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::{Camera, Time};

/// Renders of fixed cameras, and of one that moves: enough that a rig and a clip are covered; each costs about
/// three ordinary ones.
pub(super) const STILL_RENDERS: usize = 12;
/// See [`STILL_RENDERS`].
pub(super) const PATH_RENDERS: usize = 32;
/// Longer side of these renders, pixels.
const SIDE: usize = 480;
/// Share of an error that counts in every direction, also along a line of sight that no render crosses.
const ISOTROPIC: f64 = 0.1;
/// Share of the weight by size and opacity alone for Gaussians that no render sees, and of its greatest weight at times
/// at which the moving camera does not.
const UNSEEN: f64 = 0.02;
/// Squared contrast to the surroundings, assumed where it is unknown, per channel.
const CONTRAST: f64 = 0.05;
/// Low-pass of the projection, pixels² (CONVENTIONS.md).
const LOW_PASS: f64 = 0.3;
/// Pixels of the image that is assumed where there is no camera: 1080p.
const PIXELS: f64 = 1920.0 * 1080.0;
/// Channels of an image.
const CHANNELS: f64 = 3.0;
/// Places of the mean's block in the upper triangle of a 6x6 matrix, as (xx, xy, xz, yy, yz, zz).
const MEAN_BLOCK: [usize; 6] = [0, 1, 2, 6, 7, 11];
/// Gaussians fainter than this are left out when the reaction of images is measured.
const FAINT: f64 = 0.02;

/// Sums over renders for one Gaussian, each divided by its squared opacity there.
#[derive(Clone, Copy, Debug, Default)]
struct GaussianSums {
    /// Second moment of the image's gradient with respect to the mean, mean squared error per unit².
    moment: [f64; 6],
    /// Its trace in units of the Gaussian's own size: mean squared error of all of it.
    energy: f64,
    /// Squared share of the image's pixels, mean squared error for a change of colour by 1.
    color: f64,
    /// Renders of fixed cameras at whose time it was there, and their part of `energy`.
    still: [f64; 2],
}

/// The measurements, by layer and row.
#[derive(Debug)]
pub(super) struct Weights {
    seen: Vec<Vec<GaussianSums>>,
    /// Seconds of the renders of a camera that moves, rising.
    times: Vec<f64>,
    /// By layer, [times, rows]: energies in these renders.
    path: Vec<Vec<f32>>,
    /// Pixels of an image.
    pixels: f64,
}

/// The weight of one Gaussian's errors: mean squared error of images for errors of size 1, at the time at which it
/// weighs most.
#[derive(Clone, Debug)]
pub(super) struct Weight {
    /// Lower triangle L of its quadratic form of the mean, L Lᵀ, per unit².
    pub mean: [[f64; 3]; 3],
    /// For a relative change of opacity by 1.
    pub opacity: f64,
    /// For a change of colour by 1.
    pub color: f64,
    /// The largest cost of a wrong position: missing at the right one, and wrong at its own.
    pub most: f64,
    /// Its share at other times: seconds and share. Empty: 1 at all times.
    shares: Vec<(f64, f64)>,
}

impl Weight {
    /// The share of the weight at a time: the greater of those at the renders before and after.
    pub(super) fn share(&self, time: f64) -> f64 {
        let after = self.shares.partition_point(|s| s.0 <= time);
        let sides = [after.checked_sub(1), Some(after)].map(|i| i.and_then(|i| self.shares.get(i)).map(|s| s.1));
        sides.into_iter().flatten().reduce(f64::max).unwrap_or(1.0)
    }
}

impl Weights {
    /// Renders the model as `cameras` see it at all times and as a moving camera does at its own (rising), each at most
    /// `most` times, and measures.
    pub(super) fn measure(
        scene: &Scene<f32>,
        cameras: &[Camera],
        path: &[(f64, Camera)],
        most: usize,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Self {
        let renders = if cameras.is_empty() { 0 } else { STILL_RENDERS.min(most) };
        let still = |i: usize| {
            let [from, to] = scene.clip;
            (from + (to - from) * (i as f64 + 0.5) / renders as f64, &cameras[i * cameras.len() / renders])
        };
        let poses = PATH_RENDERS.min(most);
        let stride = path.len().div_ceil(poses.max(1)).max(1);
        let moving: Vec<(f64, &Camera)> = path.iter().step_by(stride).take(poses).map(|(t, c)| (*t, c)).collect();
        let shots: Vec<(f64, &Camera)> = (0..renders).map(still).chain(moving.iter().copied()).collect();
        let mut out = Self {
            seen: scene.layers.iter().map(|l| vec![GaussianSums::default(); l.params.len()]).collect(),
            times: moving.iter().map(|m| m.0).collect(),
            path: scene.layers.iter().map(|l| vec![0.0; moving.len() * l.params.len()]).collect(),
            pixels: PIXELS,
        };
        let mut importance = Importance::new(RenderConfig::default());
        let (mut instant, mut shares, mut answers) = (Evaluation::default(), Vec::new(), Vec::new());
        let mut all = 0.0;
        for (i, &(time, camera)) in shots.iter().enumerate() {
            let camera = camera.downscaled(camera.width.max(camera.height).div_ceil(SIDE).max(1));
            let pixels = (camera.width * camera.height) as f64;
            all += pixels;
            scene.at(Time(time), &mut instant);
            let splats = scene.splats(&instant);
            importance.sensitivities(&Shot::new(&splats, &camera, scene.background), &mut answers);
            importance.last_contributions(&mut shares);
            let mut first = 0;
            for ((tape, seen), path) in instant.tapes().zip(&mut out.seen).zip(&mut out.path) {
                let (rows, table, count) = (tape.rows(), tape.out(), seen.len());
                for j in 0..table.rows() {
                    let opacity = f64::from(table.get(j, SPLAT_OPACITY));
                    if opacity < FAINT {
                        continue;
                    }
                    let row = rows.id(j);
                    let seen = &mut seen[row];
                    let (answer, share) = (&answers[first + j], f64::from(shares[first + j]));
                    let scale = 1.0 / (opacity * opacity * pixels * CHANNELS);
                    let moment = MEAN_BLOCK.map(|k| scale * answer.fisher[k]);
                    let energy = energy(&moment, table.read::<6>(j, COV).map(f64::from));
                    (0..6).for_each(|k| seen.moment[k] += moment[k]);
                    seen.energy += energy;
                    if share > 0.0 {
                        let [a, b, c] = importance.projected()[first + j].conic.map(f64::from);
                        // Σ (αT)² of a bell whose Σ αT is known: its square over twice the ellipse's area.
                        let area = 4.0 * std::f64::consts::PI / (a * c - b * b).max(f64::MIN_POSITIVE).sqrt();
                        seen.color += CHANNELS * scale * share * share / area;
                    }
                    match i.checked_sub(renders) {
                        Some(k) => path[k * count + row] = energy as f32,
                        None => seen.still = [seen.still[0] + 1.0, seen.still[1] + energy],
                    }
                }
                first += table.rows();
            }
            progress(i + 1, shots.len());
        }
        if !shots.is_empty() {
            out.pixels = all / shots.len() as f64;
        }
        out
    }

    /// The weight of row `row` of a layer that renders like `sample` where it is clearest.
    pub(super) fn of(&self, layer: usize, row: usize, sample: &[f32], sampling: &Viewpoints) -> Weight {
        let v: [f64; GEOMETRY] = std::array::from_fn(|k| f64::from(sample[k]));
        let square = v[SPLAT_OPACITY] * v[SPLAT_OPACITY];
        let values = sym3::eigen([v[3], v[4], v[5], v[6], v[7], v[8]]).0;
        let scale = sampling.pixels([v[0], v[1], v[2]]);
        let pass = LOW_PASS / (scale * scale);
        let sizes = values.map(|s| s.max(0.0) + pass);
        let GaussianSums { moment, energy: sum, color, still: [renders, still] } = self.seen[layer][row];
        // Cameras that are static and one that moves count the same, each by its mean.
        let still = if renders > 0.0 { still / renders } else { 0.0 };
        let count = self.seen[layer].len();
        let on_path = |k: usize| f64::from(self.path[layer][k * count + row]);
        let kinds = f64::from(u8::from(renders > 0.0)) + f64::from(u8::from(!self.times.is_empty()));
        let most = (0..self.times.len()).map(on_path).fold(0.0, f64::max);
        let measured = square * (most + still) / kinds.max(1.0);
        // By its size alone: a bell of that contrast that nothing hides.
        let area = std::f64::consts::PI * (sizes[0] * sizes[1]).sqrt() * scale * scale / self.pixels;
        let alone = if kinds == 0.0 { 1.0 } else { UNSEEN };
        let guessed = alone * CONTRAST * area * square;
        let part = if sum > 0.0 { measured / sum } else { 0.0 };
        let mut form = moment.map(|m| m * part);
        let even = ISOTROPIC * (form[0] + form[3] + form[5]) / 3.0 + 0.5 * guessed / sizes[1];
        [0, 3, 5].into_iter().for_each(|k| form[k] += even);
        let shares = self.times.iter().enumerate().map(|(k, t)| {
            let here = square * (on_path(k) + still) / kinds.max(1.0) + guessed;
            (*t, (here / (measured + guessed)).max(UNSEEN))
        });
        let shares = if measured > 0.0 { shares.collect() } else { Vec::new() };
        let (opacity, color) = (measured + guessed, color * part + alone * area * square);
        Weight { mean: cholesky(form), opacity, color, most: opacity + CONTRAST * color, shares }
    }
}

/// Σ of the squares of a gradient whose second moments are those of a bell of this covariance.
fn energy(moment: &[f64; 6], cov: [f64; 6]) -> f64 {
    let products: [f64; 6] = std::array::from_fn(|k| moment[k] * cov[k]);
    products[0] + products[3] + products[5] + 2.0 * (products[1] + products[2] + products[4])
}

/// The lower triangle of a positive semidefinite matrix; rows of what is not finite or positive are zero.
fn cholesky(m: [f64; 6]) -> [[f64; 3]; 3] {
    let full = [[m[0], m[1], m[2]], [m[1], m[3], m[4]], [m[2], m[4], m[5]]];
    let mut l = [[0.0; 3]; 3];
    for i in 0..3 {
        for j in 0..=i {
            let rest = full[i][j] - (0..j).map(|k| l[i][k] * l[j][k]).sum::<f64>();
            let value = if i == j { rest.max(0.0).sqrt() } else { rest / l[j][j] };
            l[i][j] = if value.is_finite() { value } else { 0.0 };
        }
    }
    l
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_triangle_is_a_root_of_its_form() {
        let m = [4.0, 1.0, -0.5, 3.0, 0.25, 2.0];
        let l = cholesky(m);
        let x = [0.3, -1.2, 0.7];
        let y: f64 = (0..3).map(|c| (0..3).map(|r| l[r][c] * x[r]).sum::<f64>().powi(2)).sum();
        let outer = [x[0] * x[0], x[0] * x[1], x[0] * x[2], x[1] * x[1], x[1] * x[2], x[2] * x[2]];
        assert!((y - energy(&m, outer)).abs() < 1e-12);
        assert!(cholesky([0.0; 6]) == [[0.0; 3]; 3] && cholesky([f64::NAN; 6]) == [[0.0; 3]; 3]);
    }

    #[test]
    fn a_weight_lasts_from_render_to_render() {
        let of = |shares| Weight { mean: [[0.0; 3]; 3], opacity: 1.0, color: 1.0, most: 2.0, shares };
        let weight = of(vec![(0.0, 0.1), (1.0, 1.0), (2.0, 0.2), (3.0, 0.02)]);
        assert_eq!([-1.0, 0.5, 1.0, 1.5, 2.5, 9.0].map(|t| weight.share(t)), [0.1, 1.0, 1.0, 1.0, 0.2, 0.02]);
        assert_eq!(of(Vec::new()).share(3.0), 1.0);
    }
}
