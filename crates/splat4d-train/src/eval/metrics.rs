//! Image metrics that need no learnt weights.
//!
//! Every metric uses values clamped to `[0,1]` and not rounded to 8 bits; a metric that is not defined for an image is
//! `None`, never a synthetic number. All sums run in a fixed order in f64.

use crate::loss::Photometric;
use rayon::prelude::*;
use splat4d::math::image::halve;
use splat4d::scene::Planes;

/// A pixel is dynamic where a channel is further than this from its camera's temporal mean.
pub(crate) const DYNAMIC_THRESHOLD: f32 = 0.05;
/// Exponents of the five scales (Wang 2003).
const SCALE_WEIGHTS: [f64; 5] = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333];
/// Shorter side below which MS-SSIM is not defined: at the fifth scale (÷16) an 11-pixel window must still fit.
pub(crate) const MS_SSIM_MIN_SIDE: usize = 176;
/// Window and constants of SSIM (Wang 2004).
const TAPS: usize = 11;
const SIGMA: f64 = 1.5;
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;
/// 8-bit steps in `[0,1]`: the unit of flicker.
const LEVELS: f64 = 255.0;

fn assert_same(render: &Planes<f32>, truth: &Planes<f32>) {
    assert_eq!(
        (render.channels, render.height, render.width),
        (truth.channels, truth.height, truth.width),
        "render and truth must have the same channels, height and width"
    );
}

/// −10 log₁₀ of the mean squared error in dB; infinite for equal images, `None` for one without pixels.
///
/// Shapes: `[C,H,W]` both. Panics: shapes differ.
pub fn psnr(render: &Planes<f32>, truth: &Planes<f32>) -> Option<f64> {
    psnr_where(render, truth, |_| true)
}

/// [`psnr`] over the pixels p (row-major) with `region[p]`; `None` where there are none.
///
/// Panics: shapes differ, or the region is not `[H·W]`.
pub fn psnr_region(render: &Planes<f32>, truth: &Planes<f32>, region: &[bool]) -> Option<f64> {
    assert_eq!(region.len(), render.pixels(), "a region holds one value a pixel");
    psnr_where(render, truth, |p| region[p])
}

fn psnr_where(render: &Planes<f32>, truth: &Planes<f32>, inside: impl Fn(usize) -> bool) -> Option<f64> {
    assert_same(render, truth);
    let (mut sum, mut count) = (0.0, 0usize);
    for c in 0..render.channels {
        for (p, (a, b)) in render.plane(c).iter().zip(truth.plane(c)).enumerate() {
            if inside(p) {
                sum += f64::from(a.clamp(0.0, 1.0) - b.clamp(0.0, 1.0)).powi(2);
                count += 1;
            }
        }
    }
    (count > 0).then(|| -10.0 * (sum / count as f64).log10())
}

/// Mean SSIM as 3DGS measures it: 11x11 Gaussian, zero padding, per channel. `None` for an image without pixels.
///
/// Source: Wang 2004; the training loss is the same function.
pub(crate) fn ssim(render: &Planes<f32>, truth: &Planes<f32>) -> Option<f64> {
    assert_same(render, truth);
    if render.data.is_empty() {
        return None;
    }
    let mut unused = Planes::default();
    let value = Photometric::new(1.0).loss_and_grad(&clamped(render), &clamped(truth), None, &mut unused);
    Some(value.ssim)
}

/// (1 − SSIM)/2
pub(crate) fn d_ssim(ssim: f64) -> f64 {
    (1.0 - ssim) / 2.0
}

fn clamped(p: &Planes<f32>) -> Planes<f32> {
    let data = p.data.iter().map(|x| x.clamp(0.0, 1.0)).collect();
    Planes { channels: p.channels, height: p.height, width: p.width, data }
}

/// Multi-scale SSIM: Π over five scales of contrast·structure^w, times luminance^w at the last; mean over channels.
///
/// Windows are entirely inside the image; between scales 2x2 pixels are averaged (an odd last row or column is
/// dropped); a negative contrast·structure term counts as 0. `None` where the shorter side is below
/// [`MS_SSIM_MIN_SIDE`]. Source: Wang 2003.
pub(crate) fn ms_ssim(render: &Planes<f32>, truth: &Planes<f32>) -> Option<f64> {
    assert_same(render, truth);
    if render.channels == 0 || render.height.min(render.width) < MS_SSIM_MIN_SIDE {
        return None;
    }
    let channel = |c: usize| {
        let load = |p: &Planes<f32>| p.plane(c).iter().map(|x| f64::from(x.clamp(0.0, 1.0))).collect::<Vec<f64>>();
        let (mut a, mut b, mut h, mut w) = (load(render), load(truth), render.height, render.width);
        let mut product = 1.0;
        for (scale, weight) in SCALE_WEIGHTS.into_iter().enumerate() {
            let last = scale + 1 == SCALE_WEIGHTS.len();
            let (full, contrast) = valid_ssim(&a, &b, h, w);
            product *= if last { full } else { contrast }.max(0.0).powf(weight);
            if !last {
                [&mut a, &mut b].into_iter().for_each(|plane| halve(plane, [1, h, w]));
                (h, w) = (h / 2, w / 2);
            }
        }
        product
    };
    let values: Vec<f64> = (0..render.channels).into_par_iter().map(channel).collect();
    Some(values.iter().sum::<f64>() / values.len() as f64)
}

/// Means of SSIM and of its contrast·structure factor over all windows inside [h,w].
fn valid_ssim(a: &[f64], b: &[f64], h: usize, w: usize) -> (f64, f64) {
    let bell: [f64; TAPS] = std::array::from_fn(|i| (-(i as f64 - 5.0).powi(2) / (2.0 * SIGMA * SIGMA)).exp());
    let norm: f64 = bell.iter().sum();
    let taps = bell.map(|x| x / norm);
    let (oh, ow) = (h + 1 - TAPS, w + 1 - TAPS);
    let means: Vec<Vec<f64>> = (0..4)
        .map(|moment| {
            let mut map = vec![0.0; h * w];
            for ((m, x), y) in map.iter_mut().zip(a).zip(b) {
                *m = match moment {
                    0 => *x,
                    1 => *y,
                    2 => x * x + y * y,
                    _ => x * y,
                };
            }
            let mut down = vec![0.0; oh * w];
            for y in 0..oh {
                let out = &mut down[y * w..(y + 1) * w];
                for (t, tap) in taps.iter().enumerate() {
                    out.iter_mut().zip(&map[(y + t) * w..]).for_each(|(o, m)| *o += tap * m);
                }
            }
            let mut across = vec![0.0; oh * ow];
            for y in 0..oh {
                let out = &mut across[y * ow..(y + 1) * ow];
                for (t, tap) in taps.iter().enumerate() {
                    out.iter_mut().zip(&down[y * w + t..]).for_each(|(o, m)| *o += tap * m);
                }
            }
            across
        })
        .collect();
    let (mut full, mut contrast) = (0.0, 0.0);
    for i in 0..oh * ow {
        let (x, y, sq, xy) = (means[0][i], means[1][i], means[2][i], means[3][i]);
        let cs = (2.0 * (xy - x * y) + C2) / (sq - x * x - y * y + C2);
        contrast += cs;
        full += cs * (2.0 * x * y + C1) / (x * x + y * y + C1);
    }
    let n = (oh * ow) as f64;
    (full / n, contrast / n)
}

/// The mean over time of one fixed camera's images, taken one by one.
#[derive(Clone, Debug, Default)]
pub(crate) struct TemporalMean {
    sum: Vec<f64>,
    size: (usize, usize, usize),
    frames: usize,
}

impl TemporalMean {
    /// Adds an image. Panics: its size differs from the first one's.
    pub(crate) fn push(&mut self, image: &Planes<f32>) {
        let size = (image.channels, image.height, image.width);
        if self.frames == 0 {
            (self.size, self.sum) = (size, vec![0.0; image.data.len()]);
        }
        assert_eq!(size, self.size, "a camera's images must have one size");
        self.sum.iter_mut().zip(&image.data).for_each(|(s, x)| *s += f64::from(*x));
        self.frames += 1;
    }

    /// Number of images.
    #[cfg(test)]
    pub(crate) fn frames(&self) -> usize {
        self.frames
    }

    /// The mean; `None` before the first image.
    pub(crate) fn mean(&self) -> Option<Planes<f32>> {
        let (channels, height, width) = self.size;
        let data = self.sum.iter().map(|s| (s / self.frames as f64) as f32).collect();
        (self.frames > 0).then_some(Planes { channels, height, width, data })
    }
}

/// The pixels that move: `[H·W]`, true where any channel is more than [`DYNAMIC_THRESHOLD`] from the temporal mean.
///
/// Only a fixed camera has a temporal mean. Panics: sizes differ.
pub(crate) fn dynamic_region(truth: &Planes<f32>, temporal_mean: &Planes<f32>) -> Vec<bool> {
    assert_same(truth, temporal_mean);
    let mut region = vec![false; truth.pixels()];
    for c in 0..truth.channels {
        for (r, (a, b)) in region.iter_mut().zip(truth.plane(c).iter().zip(temporal_mean.plane(c))) {
            *r |= (a - b).abs() > DYNAMIC_THRESHOLD;
        }
    }
    region
}

/// Flicker of one fixed camera: mean |(R_{t+1} − R_t) − (G_{t+1} − G_t)|·255, frames taken one by one in order of time.
#[derive(Clone, Debug, Default)]
pub(crate) struct Flicker {
    last: Vec<f32>,
    sum: f64,
    pairs: usize,
}

impl Flicker {
    /// Adds the next frame. Panics: render, truth or the last frame differ in size.
    pub(crate) fn push(&mut self, render: &Planes<f32>, truth: &Planes<f32>) {
        assert_same(render, truth);
        let error: Vec<f32> =
            render.data.iter().zip(&truth.data).map(|(r, g)| r.clamp(0.0, 1.0) - g.clamp(0.0, 1.0)).collect();
        if !self.last.is_empty() {
            assert_eq!(self.last.len(), error.len(), "a camera's frames must have one size");
            let change: f64 = self.last.iter().zip(&error).map(|(a, b)| f64::from((b - a).abs())).sum();
            self.sum += change / error.len() as f64 * LEVELS;
            self.pairs += 1;
        }
        self.last = error;
    }

    /// The mean over pairs of neighbouring frames in 8-bit steps; `None` with fewer than two frames.
    pub(crate) fn value(&self) -> Option<f64> {
        (self.pairs > 0).then(|| self.sum / self.pairs as f64)
    }

    /// The mean over all pairs of several cameras.
    pub(crate) fn over<'a>(cameras: impl IntoIterator<Item = &'a Flicker>) -> Option<f64> {
        let mut all = Flicker::default();
        for camera in cameras {
            all.sum += camera.sum;
            all.pairs += camera.pairs;
        }
        all.value()
    }
}

/// Colours of an error map from none to full: dark to light in even steps of lightness, so that it reads in grey too.
const RAMP: [[f32; 3]; 5] =
    [[0.0, 0.0, 0.02], [0.26, 0.06, 0.42], [0.71, 0.20, 0.36], [0.98, 0.57, 0.16], [1.0, 1.0, 0.78]];

/// The mean |render − truth| over channels as a colour image `[3,H,W]`; errors from `full` on are the last colour.
///
/// Panics: shapes differ, or `full` is not above 0.
pub fn error_map(render: &Planes<f32>, truth: &Planes<f32>, full: f32) -> Planes<f32> {
    assert_same(render, truth);
    assert!(full > 0.0, "an error map needs an error above 0 for its last colour, not {full}");
    let mut out = Planes::new(3, render.height, render.width);
    let n = render.pixels();
    for p in 0..n {
        let sum: f32 = (0..render.channels)
            .map(|c| (render.data[c * n + p].clamp(0.0, 1.0) - truth.data[c * n + p].clamp(0.0, 1.0)).abs())
            .sum();
        let at = (sum / render.channels as f32 / full).clamp(0.0, 1.0) * (RAMP.len() - 1) as f32;
        let step = (at as usize).min(RAMP.len() - 2);
        let blend = at - step as f32;
        for c in 0..3 {
            out.data[c * n + p] = RAMP[step][c] + blend * (RAMP[step + 1][c] - RAMP[step][c]);
        }
    }
    out
}

#[cfg(test)]
mod tests;
