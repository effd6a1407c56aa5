//! Regularisers of feature planes (the `hexplane` model): sums over levels of
//!
//! - smoothness: mean of (P[i−1] − 2P\[i\] + P[i+1])² along both axes of xy, xz and yz. The released code of 4DGaussians
//!   calls it TV and takes the second axis alone; both make no axis special;
//! - time smoothness: the same along time, of xt, yt and zt;
//! - L1-time: mean |1 − P| of xt, yt and zt, which pulls towards features that do not depend on time;
//! - variation: (P[i+1] − P\[i\])² along both axes of xy, xz and yz, each a mean over its pairs: the true (squared) total
//!   variation, as an alternative to the first.
//!
//! Sources: Wu et al. 2024 ("4DGaussians") §4.3; Fridovich-Keil et al. 2023 (K-Planes) §3.2.

use super::terms::{ParamLoss, StepInfo};
use rayon::prelude::*;
use splat4d::layers::Scene;
use splat4d::math::Real;
use splat4d::nn::hexplane::{PlaneShape, SPATIAL, TEMPORAL};
use splat4d::scene::{Grads, Key, Params};
use splat4d::simd::{Pass, Simd, dispatch_pass};

/// Weights; each is a factor of a mean, 0: off.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct PlaneWeights {
    /// Second differences of the spatial planes.
    pub smoothness: f64,
    /// Second differences of the time planes along time.
    pub time_smoothness: f64,
    /// |1 − P| of the time planes.
    pub l1_time: f64,
    /// First differences of the spatial planes.
    pub variation: f64,
}

impl PlaneWeights {
    /// Whether there is anything to do.
    pub(crate) fn any(&self) -> bool {
        [self.smoothness, self.time_smoothness, self.l1_time, self.variation].iter().any(|w| *w > 0.0)
    }
}

/// Steps between two evaluations, whose gradient counts as often: a plane has millions of numbers, and a step changes
/// few of them much.
const EVERY: usize = 4;

/// All of the module's regularisers on every layer that has such planes.
pub(crate) struct SmoothPlanes {
    shape: PlaneShape,
    levels: usize,
    weights: PlaneWeights,
}

impl SmoothPlanes {
    /// Its name, in metrics.
    pub(crate) const NAME: &'static str = "planes";

    /// For planes of one shape, of which this many levels are in use.
    pub(crate) fn new(shape: PlaneShape, levels: usize, weights: PlaneWeights) -> Self {
        Self { shape, levels, weights }
    }

    /// The loss of one layer's levels in use, and `factor` times its gradient added to `d`; 0 without planes.
    pub(crate) fn of_layer<F: Real>(&self, p: &Params<F>, factor: f64, d: &mut Grads<F>) -> f64 {
        let mut loss = 0.0;
        for level in 0..self.shape.multires.len().min(self.levels) {
            let keys: Option<Vec<Key>> = (0..6).map(|plane| p.find(&PlaneShape::name(level, plane))).collect();
            let Some(keys) = keys else { continue };
            let tables = d.many(&keys);
            let losses: Vec<f64> = tables
                .into_par_iter()
                .enumerate()
                .with_max_len(1)
                .map(|(plane, d)| {
                    let data = p[keys[plane]].data();
                    self.of_plane(level, plane, &data[..p[keys[plane]].rows()], d.data_mut(), factor)
                })
                .collect();
            loss += losses.iter().sum::<f64>();
        }
        loss
    }

    fn of_plane<F: Real>(&self, level: usize, plane: usize, data: &[F], d: &mut [F], factor: f64) -> f64 {
        let c = self.shape.channels;
        let [across, down] = self.shape.size(level, plane);
        let row = across * c;
        let w = &self.weights;
        let simd = Simd::detect();
        let mut loss = 0.0;
        // A difference is of whole rows of numbers: `gap` apart, `run` of them in each of as many runs as fit.
        let mut difference = |order: usize, weight: f64, gap: usize, run: usize| {
            let reach = order * gap;
            if weight > 0.0 && run > reach {
                let count = data.len() / run * (run - reach);
                let scale = weight / count as f64;
                for (data, d) in data.chunks_exact(run).zip(d.chunks_exact_mut(run)) {
                    let d_scale = F::of(2.0 * scale * factor);
                    let mut sum = 0.0;
                    // Blocks of the differences, so that their gradient needs no memory of its own.
                    let pass = Difference { data, gap, order, d_scale };
                    dispatch_pass(simd, &pass, &mut sum, d);
                    loss += scale * sum;
                }
            }
        };
        if SPATIAL.contains(&plane) {
            difference(2, w.smoothness, row, data.len());
            difference(2, w.smoothness, c, row);
            difference(1, w.variation, row, data.len());
            difference(1, w.variation, c, row);
        }
        if TEMPORAL.contains(&plane) {
            debug_assert_eq!(data.len(), down * row);
            difference(2, w.time_smoothness, row, data.len());
            if w.l1_time > 0.0 {
                let scale = w.l1_time / data.len() as f64;
                let mut sum = 0.0;
                let d_scale = F::of(scale * factor);
                dispatch_pass(simd, &Distance { data, d_scale }, &mut sum, &mut d[..data.len()]);
                loss += scale * sum;
            }
        }
        loss
    }
}

impl<F: Real> ParamLoss<F> for SmoothPlanes {
    fn name(&self) -> &str {
        Self::NAME
    }

    fn eval(&self, scene: &Scene<F>, info: &StepInfo, d: &mut [Grads<F>]) -> f64 {
        if !info.iteration.is_multiple_of(EVERY) {
            return 0.0;
        }
        scene.layers.iter().zip(d).map(|(layer, d)| EVERY as f64 * self.of_layer(&layer.params, EVERY as f64, d)).sum()
    }
}

/// Numbers that are worked on together.
const LANES: usize = 16;

/// Squared differences of first or second order between numbers `gap` apart; `gap` is a multiple of [`LANES`].
struct Difference<'a, F> {
    data: &'a [F],
    gap: usize,
    order: usize,
    d_scale: F,
}

impl<F: Real> Pass for Difference<'_, F> {
    /// The sum of squares.
    type Scratch = f64;
    type Into = [F];
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(&self, sum: &mut f64, d: &mut [F]) {
        let gap = self.gap / LANES;
        let data = self.data.as_chunks::<LANES>().0;
        let d = d.as_chunks_mut::<LANES>().0;
        let mut total = [0.0f64; LANES];
        for i in 0..data.len() - self.order * gap {
            let (a, b) = (&data[i], &data[i + gap]);
            let mut e = [F::ZERO; LANES];
            if self.order == 2 {
                let c = &data[i + 2 * gap];
                for k in 0..LANES {
                    e[k] = (c[k] - b[k]) - (b[k] - a[k]);
                }
            } else {
                for k in 0..LANES {
                    e[k] = b[k] - a[k];
                }
            }
            let middle = if self.order == 2 { -F::TWO } else { F::ONE };
            let first = if self.order == 2 { F::ONE } else { -F::ONE };
            for k in 0..LANES {
                total[k] += (e[k] * e[k]).f64();
                e[k] *= self.d_scale;
                d[i][k] += first * e[k];
                d[i + gap][k] += middle * e[k];
            }
            if self.order == 2 {
                for k in 0..LANES {
                    d[i + 2 * gap][k] += e[k];
                }
            }
        }
        *sum += total.iter().sum::<f64>();
    }
}

/// |1 − x|; the gradient at 1 is zero.
struct Distance<'a, F> {
    data: &'a [F],
    d_scale: F,
}

impl<F: Real> Pass for Distance<'_, F> {
    type Scratch = f64;
    type Into = [F];
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(&self, sum: &mut f64, d: &mut [F]) {
        let mut total = [0.0f64; LANES];
        for (x, d) in self.data.as_chunks::<LANES>().0.iter().zip(d.as_chunks_mut::<LANES>().0) {
            for k in 0..LANES {
                let e = x[k] - F::ONE;
                let sign = if e > F::ZERO { F::ONE } else { F::ZERO } - if e < F::ZERO { F::ONE } else { F::ZERO };
                total[k] += e.abs().f64();
                d[k] += self.d_scale * sign;
            }
        }
        *sum += total.iter().sum::<f64>();
    }
}

#[cfg(test)]
mod tests;
