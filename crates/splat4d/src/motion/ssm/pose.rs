//! From what the network states at ticks to poses at any time: interpolation, rotation vectors, composed rates.

use crate::math::{Real, quat};
use crate::nn::ssm::{LANES, Lane};
use crate::simd::each;

/// Below this |θ|² sine and cosine are computed by their series, radians squared (the terms left out are below 1e-17).
const SMALL_ANGLE: f64 = 1e-4;

/// The ticks around a time, with Catmull-Rom weights and their slopes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Knots<F> {
    ticks: [usize; 4],
    weights: [F; 4],
    /// Of the weights, 1/s.
    slopes: [F; 4],
}

impl<F: Real> Knots<F> {
    /// Around `u`, in ticks; `per_second` ticks a second. Before the first and after the last tick the nearest one
    /// counts.
    pub(crate) fn new(u: f64, per_second: f64, last: usize) -> Self {
        let inside = u > 0.0 && u < last as f64;
        let u = if u.is_nan() { 0.0 } else { u.clamp(0.0, last as f64) };
        let low = (u.floor() as usize).min(last - 1);
        let x = u - low as f64;
        let weights = [
            0.5 * x * (x * (2.0 - x) - 1.0),
            0.5 * (x * x * (3.0 * x - 5.0) + 2.0),
            0.5 * x * (x * (4.0 - 3.0 * x) + 1.0),
            0.5 * x * x * (x - 1.0),
        ];
        let slopes = [
            0.5 * (4.0 * x - 3.0 * x * x - 1.0),
            0.5 * (9.0 * x * x - 10.0 * x),
            0.5 * (8.0 * x - 9.0 * x * x + 1.0),
            0.5 * (3.0 * x * x - 2.0 * x),
        ];
        let rate = if inside { per_second } else { 0.0 };
        Self {
            ticks: [low.saturating_sub(1), low, low + 1, (low + 2).min(last)],
            weights: weights.map(F::of),
            slopes: slopes.map(|s| F::of(s * rate)),
        }
    }

    /// The last tick that is examined.
    pub(crate) fn last(&self) -> usize {
        self.ticks[3]
    }
}

/// The pose at the knots of one node's ticks \[ticks, 6 or 7\]: shift 3, quaternion residual 4; and the numbers that
/// were interpolated.
pub(crate) fn at<F: Real>(own: &[F], width: usize, knots: &Knots<F>) -> ([F; 7], [F; 7]) {
    let mut x = [F::ZERO; 7];
    for (&tick, &w) in knots.ticks.iter().zip(&knots.weights) {
        (0..width).for_each(|k| x[k] += w * own[tick * width + k]);
    }
    let q = if width == 7 { [x[3], x[4], x[5], x[6]] } else { exp([x[3], x[4], x[5]]) };
    ([x[0], x[1], x[2], q[0] - F::ONE, q[1], q[2], q[3]], x)
}

/// VJP of [`at`]: adds to `d_own`, returns dL/dt.
pub(crate) fn at_backward<F: Real>(own: &[F], width: usize, knots: &Knots<F>, d: [F; 7], d_own: &mut [F]) -> f64 {
    let (_, x) = at(own, width, knots);
    let mut d_x = d;
    if width == 6 {
        let turn = exp_backward([x[3], x[4], x[5]], [d[3], d[4], d[5], d[6]]);
        d_x = [d[0], d[1], d[2], turn[0], turn[1], turn[2], F::ZERO];
    }
    let mut d_time = F::ZERO;
    for ((&tick, &w), &slope) in knots.ticks.iter().zip(&knots.weights).zip(&knots.slopes) {
        for k in 0..width {
            d_own[tick * width + k] += w * d_x[k];
            d_time += slope * own[tick * width + k] * d_x[k];
        }
    }
    d_time.f64()
}

/// cos(|θ|/2) and sin(|θ|/2)/|θ|, and the slope of the latter by |θ|².
#[inline(always)]
fn half_angle<F: Real>(square: F) -> [F; 3] {
    if square < F::of(SMALL_ANGLE) {
        let c = F::ONE - square * F::of(1.0 / 8.0) + square * square * F::of(1.0 / 384.0);
        let s = F::HALF - square * F::of(1.0 / 48.0) + square * square * F::of(1.0 / 3840.0);
        return [c, s, F::of(-1.0 / 48.0) + square * F::of(1.0 / 1920.0)];
    }
    let angle = square.sqrt();
    let (c, s) = ((F::HALF * angle).cos(), (F::HALF * angle).sin() / angle);
    [c, s, (F::HALF * c - s) / (F::TWO * square)]
}

/// The unit quaternion of a rotation vector, radians.
pub(super) fn exp<F: Real>(theta: [F; 3]) -> [F; 4] {
    let [c, s, _] = half_angle(theta[0] * theta[0] + theta[1] * theta[1] + theta[2] * theta[2]);
    [c, s * theta[0], s * theta[1], s * theta[2]]
}

/// VJP of [`exp`].
pub(crate) fn exp_backward<F: Real>(theta: [F; 3], d: [F; 4]) -> [F; 3] {
    let [_, s, slope] = half_angle(theta[0] * theta[0] + theta[1] * theta[1] + theta[2] * theta[2]);
    let along = d[1] * theta[0] + d[2] * theta[1] + d[3] * theta[2];
    // d cos/d|θ|² = −s/4
    let d_square = slope * along - F::of(0.25) * s * d[0];
    each(|k| s * d[k + 1] + F::TWO * theta[k] * d_square)
}

/// Poses \[7, ticks\] of rates \[6, ticks\]: the first tick's is the first pose, the others last `share` of a clip
/// each: ρₙ = ρₙ₋₁ + share·ξₙ, qₙ = qₙ₋₁ ⊗ exp(share·ωₙ).
pub(crate) fn compose<F: Real>(rates: &[Lane<F>], share: f64) -> Vec<Lane<F>> {
    let ticks = rates.len() / 6;
    let mut out = vec![[F::ZERO; LANES]; 7 * ticks];
    for l in 0..LANES {
        let (mut shift, mut q) = ([F::ZERO; 3], [F::ONE, F::ZERO, F::ZERO, F::ZERO]);
        for t in 0..ticks {
            let span = F::of(if t == 0 { 1.0 } else { share });
            for k in 0..3 {
                shift[k] += span * rates[k * ticks + t][l];
                out[k * ticks + t][l] = shift[k];
            }
            q = quat::product(q, exp(each(|k| span * rates[(3 + k) * ticks + t][l])));
            (0..4).for_each(|k| out[(3 + k) * ticks + t][l] = q[k]);
        }
    }
    out
}

/// VJP of [`compose`].
pub(crate) fn compose_backward<F: Real>(rates: &[Lane<F>], share: f64, d_out: &[Lane<F>]) -> Vec<Lane<F>> {
    let ticks = rates.len() / 6;
    let out = compose(rates, share);
    let mut d = vec![[F::ZERO; LANES]; 6 * ticks];
    for l in 0..LANES {
        let (mut d_shift, mut d_q) = ([F::ZERO; 3], [F::ZERO; 4]);
        for t in (0..ticks).rev() {
            let span = F::of(if t == 0 { 1.0 } else { share });
            for k in 0..3 {
                d_shift[k] += d_out[k * ticks + t][l];
                d[k * ticks + t][l] = span * d_shift[k];
            }
            (0..4).for_each(|k| d_q[k] += d_out[(3 + k) * ticks + t][l]);
            let theta: [F; 3] = each(|k| span * rates[(3 + k) * ticks + t][l]);
            let before =
                if t == 0 { [F::ONE, F::ZERO, F::ZERO, F::ZERO] } else { each(|k| out[(3 + k) * ticks + t - 1][l]) };
            // q = a ⊗ b: the gradients are g ⊗ b* to a and a* ⊗ g to b.
            let d_theta = exp_backward(theta, quat::product(quat::conjugate(before), d_q));
            (0..3).for_each(|k| d[(3 + k) * ticks + t][l] = span * d_theta[k]);
            d_q = quat::product(d_q, quat::conjugate(exp(theta)));
        }
    }
    d
}
