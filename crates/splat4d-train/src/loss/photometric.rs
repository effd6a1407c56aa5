//! The image loss of 3DGS, (1 − λ)·L1 + λ·(1 − SSIM), and its gradient, in one pass over the image.

use super::image::{ImageTerm, LossGrads, LossValue, Shown, View};
use super::kernel::{self, Scratch, Strip};
use super::terms::StepInfo;
use rayon::prelude::*;
use splat4d::math::Real;
use splat4d::render::{Comparison, Target};
use splat4d::scene::Planes;
use splat4d::simd::{Simd, dispatch_pass};
use std::sync::Mutex;

/// Most rows of a strip, the unit of parallel work: strips are of even size, and that depends on the image alone, so
/// that sums do not depend on the number of threads. Every strip works on a window's halo of ten rows in addition.
const STRIP_ROWS: usize = 128;
/// Strips are whole groups of rows of the kernel.
const GROUP_ROWS: usize = 4;

/// L1 and SSIM with their gradient; keeps its working memory between calls.
#[derive(Debug)]
pub struct Photometric<F = f32> {
    /// λ: the share of 1 − SSIM, 0.2 in 3DGS.
    pub lambda_dssim: f32,
    simd: Simd,
    taps: [F; kernel::TAPS],
    /// One per thread of the pool; a thread holds its own only while it works on one strip.
    scratch: Vec<Mutex<Scratch<F>>>,
    /// [channels, strips] sums, added up in order.
    sums: Vec<[f64; 3]>,
    /// Of the last view.
    measured: LossValue,
}

impl<F: Real> Photometric<F> {
    /// A loss with this λ, at the best instruction set of this CPU.
    pub fn new(lambda_dssim: f32) -> Self {
        Self::with_simd(lambda_dssim, Simd::detect())
    }

    /// A loss with this λ at a given instruction set.
    pub(crate) fn with_simd(lambda_dssim: f32, simd: Simd) -> Self {
        Self {
            lambda_dssim,
            simd,
            taps: kernel::window(),
            scratch: Vec::new(),
            sums: Vec::new(),
            measured: LossValue::default(),
        }
    }

    /// (1 − λ)·L1 + λ·(1 − SSIM), and its gradient to `render`, which overwrites `d_render`.
    ///
    /// Shapes: render, truth `[C,H,W]`, values nominally in `[0,1]`; weight `[1,H,W]`, ≥ 0; d_render becomes `[C,H,W]`.
    /// SSIM has an 11x11 Gaussian window (σ = 1.5), zero padding, C1 = 0.01², C2 = 0.03², per channel.
    /// With weights, L1 and SSIM are Σ w·(…) / (C·Σ w). A pixel of weight 0 is treated as if it lay outside the image:
    /// zero in both images, as the padding, so what it shows reaches neither the value nor the gradient, not even
    /// through a neighbour's window. If every weight is 0 the loss is 0, with ssim 1.
    /// The bits do not depend on the number of threads; nothing is allocated once sizes have been seen.
    /// Panics: shapes differ. Source: Wang 2004; Kerbl 2023 §5 (`utils/loss_utils.py` for the padding).
    pub fn loss_and_grad(
        &mut self,
        render: &Planes<F>,
        truth: &Planes<F>,
        weight: Option<&Planes<F>>,
        d_render: &mut Planes<F>,
    ) -> LossValue {
        let (channels, height, width) = (render.channels, render.height, render.width);
        assert_eq!(
            (channels, height, width),
            (truth.channels, truth.height, truth.width),
            "render and truth must have the same channels, height and width"
        );
        if let Some(w) = weight {
            assert_eq!(
                (1, height, width),
                (w.channels, w.height, w.width),
                "the weight must be one plane of that size"
            );
        }
        if (d_render.channels, d_render.height, d_render.width) != (channels, height, width) {
            d_render.reset(channels, height, width);
        }
        let pixels = render.pixels();
        let rows = height.div_ceil(height.div_ceil(STRIP_ROWS).max(1)).next_multiple_of(GROUP_ROWS);
        let strips = height.div_ceil(rows.max(1));
        self.sums.resize(channels * strips, [0.0; 3]);
        let total_weight = match weight {
            None => pixels as f64,
            Some(w) => total(&w.data, (rows * width).max(1), &mut self.sums[..strips]),
        } * channels as f64;
        if total_weight <= 0.0 {
            d_render.data.fill(F::ZERO);
            return LossValue { total: 0.0, l1: 0.0, ssim: 1.0, mse: 0.0 };
        }

        let lambda = f64::from(self.lambda_dssim);
        while self.scratch.len() < rayon::current_num_threads() {
            self.scratch.push(Mutex::new(Scratch::new()));
        }
        let (simd, scratch, taps) = (self.simd, &self.scratch, self.taps);
        let weight = weight.map(|w| w.data.as_slice());
        let (d_l1, d_ssim) = (F::of((1.0 - lambda) / total_weight), F::of(-lambda / total_weight));

        let planes = d_render.data.par_chunks_exact_mut(pixels).zip(self.sums.par_chunks_exact_mut(strips));
        planes.enumerate().for_each(|(c, (d, sums))| {
            let (render, truth) = (render.plane(c), truth.plane(c));
            d.par_chunks_mut(rows * width).zip(sums).enumerate().for_each(|(i, (d, sums))| {
                let first = i * rows;
                let job = Strip { render, truth, weight, width, height, first, taps, d_l1, d_ssim };
                // A loop of one step may run on the caller's own thread, then alone.
                let thread = rayon::current_thread_index().unwrap_or(0);
                let mut scratch = scratch[thread].lock().expect("no strip panics while it holds its scratch");
                *sums = dispatch_pass(simd, &job, &mut *scratch, d);
            });
        });

        let mut total = [0.0; 3];
        for s in &self.sums {
            (0..3).for_each(|i| total[i] += s[i]);
        }
        let [l1, ssim, mse] = total.map(|x| x / total_weight);
        LossValue { total: (1.0 - lambda) * l1 + lambda * (1.0 - ssim), l1, ssim, mse }
    }
}

/// The sum of weights, strip by strip of `length` numbers; `sums` holds one per strip.
fn total<F: Real>(weight: &[F], length: usize, sums: &mut [[f64; 3]]) -> f64 {
    const LANES: usize = 8;
    weight.par_chunks(length).zip(&mut *sums).for_each(|(strip, sum)| {
        let (chunks, rest) = strip.as_chunks::<LANES>();
        let mut lanes = [0.0; LANES];
        chunks.iter().for_each(|chunk| (0..LANES).for_each(|l| lanes[l] += chunk[l].f64()));
        sum[0] = lanes.iter().sum::<f64>() + rest.iter().map(|x| x.f64()).sum::<f64>();
    });
    sums.iter().map(|sum| sum[0]).sum()
}

impl<F: Real> ImageTerm<F> for Photometric<F> {
    fn eval(&mut self, _: &StepInfo, view: &View<'_, F>, shown: &Shown<'_, F>, d: &mut LossGrads<F>) -> f64 {
        self.measured = match d.color.overwrite() {
            Some(d_color) => self.loss_and_grad(shown.color, view.truth, view.weight, d_color),
            None => {
                let mut own = Planes::default();
                let measured = self.loss_and_grad(shown.color, view.truth, view.weight, &mut own);
                d.color.add().data.iter_mut().zip(&own.data).for_each(|(d, x)| *d += *x);
                measured
            }
        };
        self.measured.total
    }

    fn target<'a>(&self, view: &View<'a, F>) -> Option<Target<'a, F>> {
        let View { truth, weight, frame, .. } = *view;
        Some(Target { truth, weight, picture: frame, dssim: f64::from(self.lambda_dssim), response: None })
    }

    fn compared(&mut self, _: &View<'_, F>, c: &Comparison) -> f64 {
        let lambda = f64::from(self.lambda_dssim);
        let total = (1.0 - lambda) * c.l1 + lambda * (1.0 - c.ssim);
        self.measured = LossValue { total, l1: c.l1, ssim: c.ssim, mse: c.mse };
        total
    }

    fn measured(&self) -> Option<LossValue> {
        Some(self.measured)
    }
}

#[cfg(test)]
mod tests;
