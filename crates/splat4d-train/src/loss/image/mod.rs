//! Losses on a rendered image, each an [`ImageTerm`]: photometric, total variation, frequencies, masks, entropy of
//! alpha, agreement of depth and normals, known depth, flow.
//!
//! Each *adds* `weight` times its gradient and returns `weight` times its value, and gives the same bits with any
//! number of threads. `terms` is the list of those that a recipe requests.

pub(crate) mod depth;
pub(crate) mod entropy;
mod fft;
pub(crate) mod flow;
pub(crate) mod frequency;
pub(crate) mod mask;
pub(crate) mod normal;
pub(crate) mod segmentation;
mod term;
#[cfg(test)]
mod tests;
pub(crate) mod tv;

pub use term::{Channel, Gradient, ImageTerm, LossGrads, LossValue, Needs, Shown, View};

use super::{LossSettings, Photometric};
use rayon::prelude::*;
use splat4d::math::Real;

/// Alpha from which on a pixel shows something: below it depth, normal and flow are those of haze.
pub(crate) const SEEN: f64 = 0.5;

/// The terms that have a weight, in the order in which values and gradients are summed: colours as 3DGS compares them,
/// then what has a weight.
pub(crate) fn terms(settings: &LossSettings) -> Vec<Box<dyn ImageTerm>> {
    type Make = fn(f64) -> Box<dyn ImageTerm>;
    let weighted: [(f64, Make); 10] = [
        (settings.tv, |w| Box::new(tv::TotalVariation(w))),
        (settings.frequency, |w| Box::new(frequency::FrequencyTerm::new(w))),
        (settings.mask, |w| Box::new(mask::Mask(w))),
        (settings.mask_entropy, |w| Box::new(entropy::MaskEntropy(w))),
        (settings.depth_tv, |w| Box::new(tv::DepthSmoothness(w))),
        (settings.depth_normal, |w| Box::new(normal::DepthNormal(w))),
        (settings.depth, |w| Box::new(depth::Depth(w))),
        (settings.geometry, |w| Box::new(depth::Measured(w))),
        (settings.flow, |w| Box::new(flow::Flow(w))),
        (settings.tracks, |w| Box::new(flow::Tracks(w))),
    ];
    let photometric: Box<dyn ImageTerm> = Box::new(Photometric::new(settings.dssim as f32));
    let weighted = weighted.into_iter().filter(|(weight, _)| *weight > 0.0).map(|(weight, make)| make(weight));
    std::iter::once(photometric).chain(weighted).collect()
}

/// Calls `f(y, row)` for every row of a plane in parallel and returns the sum of the results in order.
pub(crate) fn over_rows<T: Send>(plane: &mut [T], width: usize, f: impl Fn(usize, &mut [T]) -> f64 + Sync) -> f64 {
    if width == 0 {
        return 0.0;
    }
    let sums: Vec<f64> = plane.par_chunks_mut(width).enumerate().map(|(y, row)| f(y, row)).collect();
    sums.iter().sum()
}

/// The VJP of expected depth D = S/max(A, `floor`), Σ z α T = S: adds to the gradients of S and A.
pub(crate) fn expected_depth_backward<F: Real>(
    expected: &[F],
    alpha: &[F],
    floor: F,
    d_expected: &[F],
    d_depth: &mut [F],
    d_alpha: &mut [F],
) {
    for (p, &g) in d_expected.iter().enumerate() {
        let a = alpha[p].max(floor);
        d_depth[p] += g / a;
        if alpha[p] > floor {
            d_alpha[p] -= g * expected[p] / a;
        }
    }
}

#[cfg(test)]
pub(crate) mod check {
    //! Finite differences of losses on planes.

    use splat4d::math::Rng;
    use splat4d::scene::Planes;

    /// Uniform numbers in [low, high).
    pub(crate) fn planes(purpose: &str, shape: [usize; 3], low: f64, high: f64) -> Planes<f64> {
        let rng = Rng::new(13, purpose, 0);
        let mut out = Planes::new(shape[0], shape[1], shape[2]);
        out.data.iter_mut().enumerate().for_each(|(i, x)| *x = low + (high - low) * rng.uniform(i as u64));
        out
    }

    /// Every seventh number of every plane; returns the value.
    pub(crate) fn gradients(
        inputs: &[Planes<f64>],
        loss: impl Fn(&[Planes<f64>], &mut [Planes<f64>]) -> f64,
        value: impl Fn(&[Planes<f64>]) -> f64,
    ) -> f64 {
        let mut d: Vec<Planes<f64>> = inputs.iter().map(|p| Planes::new(p.channels, p.height, p.width)).collect();
        let out = loss(inputs, &mut d);
        for k in 0..inputs.len() {
            for i in (0..inputs[k].data.len()).step_by(7) {
                let at = |h: f64| {
                    let mut moved = inputs.to_vec();
                    moved[k].data[i] += h;
                    value(&moved)
                };
                let fd = (at(1e-6) - at(-1e-6)) / 2e-6;
                let got = d[k].data[i];
                assert!((fd - got).abs() < 1e-7 * (1.0 + fd.abs()), "input {k}, number {i}: {fd} {got}");
            }
        }
        out
    }
}
