//! How strongly images react to an error of each Gaussian, measured on renders of the model.
//!
//! A Gaussian behind a wall, or one of its neighbours' colour, may err by pixels without a trace; the edge of a sign may not.
//! [`Importance::sensitivities`] gives the exact second moment of the image's gradient for each Gaussian alone. Some cameras
//! at some times stand for all. What none of them sees keeps a share of what its size and opacity would weigh alone.

use super::lookout::Lookout;
use super::sample::GEOMETRY;
use crate::layers::{Evaluation, Scene};
use crate::math::sym3;
use crate::render::{Importance, RenderConfig, Shot};
use crate::scene::splats::SPLAT_OPACITY;
use crate::scene::{Camera, Time};

/// Renders that are looked at: enough that a rig and a clip are covered; each costs about three ordinary ones.
const RENDERS: usize = 12;
/// Longer side of these renders, pixels.
const SIDE: usize = 480;
/// Share of an error that counts in every direction, also along a line of sight that no render looked across.
const ISOTROPIC: f64 = 0.1;
/// Share of the weight by size and opacity alone that is kept where no render sees the Gaussian.
const UNSEEN: f64 = 0.02;
/// Squared contrast to the background that is assumed there, each channel.
const CONTRAST: f64 = 0.05;
/// Low-pass of the projection, pixels² (CONVENTIONS.md).
const LOW_PASS: f64 = 0.3;
/// Pixels of the image that is assumed where there is no camera: 1080p.
const PIXELS: f64 = 1920.0 * 1080.0;
/// Channels of an image.
const CHANNELS: f64 = 3.0;
/// Places of the mean's block in the upper triangle of a 6x6 matrix, as (xx, xy, xz, yy, yz, zz).
const MEAN_BLOCK: [usize; 6] = [0, 1, 2, 6, 7, 11];
/// A Gaussian fainter than this tells nothing of how strongly images react to it.
const FAINT: f64 = 0.02;

/// Sums over renders for one Gaussian, each divided by its squared opacity there.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    /// Second moment of the image's gradient with respect to the mean, mean squared error a unit².
    moment: [f64; 6],
    /// Squared share of the image's pixels, mean squared error for a change of colour by 1.
    color: f64,
    /// Renders at whose time it was there.
    renders: f64,
}

/// What was measured, by layer and row.
#[derive(Debug)]
pub(super) struct Weights {
    seen: Vec<Vec<Seen>>,
    /// Pixels of an image.
    pixels: f64,
}

/// The weight of one Gaussian's errors: mean squared error of images for errors of size 1.
#[derive(Clone, Copy, Debug)]
pub(super) struct Weight {
    /// Lower triangle L of its quadratic form of the mean, L Lᵀ, per unit².
    pub mean: [[f64; 3]; 3],
    /// For a relative change of opacity by 1.
    pub opacity: f64,
    /// For a change of colour by 1.
    pub color: f64,
}

impl Weights {
    /// Renders the model and measures.
    pub(super) fn measure(scene: &Scene<f32>, cameras: &[Camera], progress: &mut dyn FnMut(usize, usize)) -> Self {
        let mut seen: Vec<Vec<Seen>> = scene.layers.iter().map(|l| vec![Seen::default(); l.params.len()]).collect();
        let mut importance = Importance::new(RenderConfig::default());
        let (mut instant, mut shares, mut answers) = (Evaluation::default(), Vec::new(), Vec::new());
        let renders = if cameras.is_empty() { 0 } else { RENDERS };
        let mut all = 0.0;
        for i in 0..renders {
            let [from, to] = scene.clip;
            let time = from + (to - from) * (i as f64 + 0.5) / renders as f64;
            // Of a moving camera every second render is from where it is at that time, the others from far away in time.
            let n = cameras.len();
            let camera = &cameras[(i * n / renders + i % 2 * (n / 2)) % n];
            let camera = camera.downscaled(camera.width.max(camera.height).div_ceil(SIDE).max(1));
            let pixels = (camera.width * camera.height) as f64;
            all += pixels;
            scene.at(Time(time), &mut instant);
            let splats = scene.splats(&instant);
            importance.sensitivities(&Shot::new(&splats, &camera, scene.background), &mut answers);
            importance.last_contributions(&mut shares);
            let mut first = 0;
            for (tape, seen) in instant.tapes().zip(&mut seen) {
                let (rows, out) = (tape.rows(), tape.out());
                for j in 0..out.rows() {
                    let opacity = f64::from(out.get(j, SPLAT_OPACITY));
                    if opacity < FAINT {
                        continue;
                    }
                    let seen = &mut seen[rows.id(j)];
                    seen.renders += 1.0;
                    let (answer, share) = (&answers[first + j], f64::from(shares[first + j]));
                    let projected = &importance.projected()[first + j];
                    let scale = 1.0 / (opacity * opacity * pixels * CHANNELS);
                    for (sum, k) in seen.moment.iter_mut().zip(MEAN_BLOCK) {
                        *sum += scale * answer.fisher[k];
                    }
                    let [a, b, c] = projected.conic.map(f64::from);
                    // Σ (αT)² of a bell whose Σ αT is known: its square over twice the ellipse's area.
                    let area = 4.0 * std::f64::consts::PI / (a * c - b * b).max(f64::MIN_POSITIVE).sqrt();
                    if share > 0.0 {
                        seen.color += CHANNELS * scale * share * share / area;
                    }
                }
                first += out.rows();
            }
            progress(i + 1, renders);
        }
        Self { seen, pixels: if all > 0.0 { all / renders as f64 } else { PIXELS } }
    }

    /// The weight of row `row` of a layer that looks like `sample` where it is clearest.
    pub(super) fn of(&self, layer: usize, row: usize, sample: &[f32], lookout: &Lookout) -> Weight {
        let v: [f64; GEOMETRY] = std::array::from_fn(|k| f64::from(sample[k]));
        let opacity = v[SPLAT_OPACITY].max(0.0);
        let (values, axes) = sym3::eigen([v[3], v[4], v[5], v[6], v[7], v[8]]);
        let scale = lookout.pixels([v[0], v[1], v[2]]);
        let pass = LOW_PASS / (scale * scale);
        let sizes = values.map(|s| s.max(0.0) + pass);
        // By its size alone: a bell of that contrast that nothing hides.
        let area = std::f64::consts::PI * (sizes[0] * sizes[1]).sqrt() * scale * scale / self.pixels;
        let Seen { moment, color, renders } = self.seen[layer][row];
        let alone = if self.seen[layer].is_empty() || renders == 0.0 { 1.0 } else { UNSEEN };
        let energy = alone * CONTRAST * area * opacity * opacity;
        let mean = renders.max(1.0);
        let mut form = moment.map(|m| m * opacity * opacity / mean);
        let trace = form[0] + form[3] + form[5];
        let even = ISOTROPIC * trace / 3.0 + 0.5 * energy / sizes[1];
        [0, 3, 5].into_iter().for_each(|k| form[k] += even);
        // Σ v² from its second moments: exact for bells.
        let measured: f64 = (0..3).map(|k| quadratic(&form, [axes[0][k], axes[1][k], axes[2][k]]) * sizes[k]).sum();
        let own_color = color * opacity * opacity / mean + alone * area * opacity * opacity;
        Weight { mean: cholesky(form), opacity: measured.max(energy), color: own_color }
    }
}

/// xᵀ M x
fn quadratic(m: &[f64; 6], x: [f64; 3]) -> f64 {
    m[0] * x[0] * x[0]
        + m[3] * x[1] * x[1]
        + m[5] * x[2] * x[2]
        + 2.0 * (m[1] * x[0] * x[1] + m[2] * x[0] * x[2] + m[4] * x[1] * x[2])
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
        assert!((y - quadratic(&m, x)).abs() < 1e-12);
        assert!(cholesky([0.0; 6]) == [[0.0; 3]; 3] && cholesky([f64::NAN; 6]) == [[0.0; 3]; 3]);
    }
}
