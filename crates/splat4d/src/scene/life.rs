//! The lifespan of a Gaussian: an envelope in time that any layer may carry, so that birth, death and the active set
//! work for every motion model.

use super::Time;
use crate::math::Real;

/// The shape of the envelope σ(t) of a layer's Gaussians. Centres and widths are in seconds, widths as logarithms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LifeKind {
    /// σ = 1 at all times; no columns.
    Infinite,
    /// σ = exp(−½u²), u = (t − centre)/width: FreeTimeGS (Wang et al. 2025) and native 4D Gaussians.
    GaussHalf,
    /// σ = exp(−u²): Spacetime Gaussians (Li et al. 2024). The same life needs a width √2 larger than `GaussHalf`.
    GaussOne,
    /// σ = 1 within ± width of the centre, Gaussian tails exp(−½e²) outside, e in units of `softness` (Ex4DGS).
    Interval,
}

/// Column of the centre in the lifespan table.
pub const CENTER: usize = 0;
/// Column of the logarithm of the width in the lifespan table.
pub const LOG_WIDTH: usize = 1;
/// Column of the logarithm of the softness in the lifespan table (interval only).
pub(crate) const LOG_SOFTNESS: usize = 2;

/// σ and its derivatives to (t, centre, log width, log softness).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LifeValue<F> {
    /// The envelope, in [0, 1].
    pub sigma: F,
    /// ∂σ/∂t; ∂σ/∂centre is its negative.
    pub d_time: F,
    /// ∂σ/∂ log width
    pub d_log_width: F,
    /// ∂σ/∂ log softness
    pub d_log_softness: F,
}

impl LifeKind {
    /// The lifespan table's columns.
    pub fn columns(self) -> &'static [(&'static str, usize)] {
        match self {
            Self::Infinite => &[],
            Self::GaussHalf | Self::GaussOne => &[("life_centers", 1), ("life_log_widths", 1)],
            Self::Interval => &[("life_centers", 1), ("life_log_widths", 1), ("life_log_softness", 1)],
        }
    }

    /// The name that files and recipes use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Infinite => "infinite",
            Self::GaussHalf => "gauss-half",
            Self::GaussOne => "gauss-one",
            Self::Interval => "interval",
        }
    }

    /// The kind with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::Infinite, Self::GaussHalf, Self::GaussOne, Self::Interval].into_iter().find(|k| k.name() == name)
    }

    /// σ at time t and its derivatives; `row` holds the lifespan columns (unused ones are not read).
    #[inline(always)]
    pub fn eval<F: Real>(self, row: [F; 3], t: Time) -> LifeValue<F> {
        let zero = F::ZERO;
        let delta = F::of(t.0) - row[CENTER];
        match self {
            Self::Infinite => LifeValue { sigma: F::ONE, d_time: zero, d_log_width: zero, d_log_softness: zero },
            Self::GaussHalf | Self::GaussOne => {
                let half = if self == Self::GaussHalf { F::HALF } else { F::ONE };
                let inverse = (-row[LOG_WIDTH]).exp();
                let u = delta * inverse;
                let sigma = (-half * u * u).exp();
                let slope = F::TWO * half * sigma * u;
                LifeValue { sigma, d_time: -slope * inverse, d_log_width: slope * u, d_log_softness: zero }
            }
            Self::Interval => {
                let width = row[LOG_WIDTH].exp();
                let over = delta.abs() - width;
                if over <= zero {
                    return LifeValue { sigma: F::ONE, d_time: zero, d_log_width: zero, d_log_softness: zero };
                }
                let inverse = (-row[LOG_SOFTNESS]).exp();
                let e = over * inverse;
                let sigma = (-F::HALF * e * e).exp();
                let slope = sigma * e * inverse; // −∂σ/∂|Δ|
                let sign = if delta < zero { -F::ONE } else { F::ONE };
                LifeValue { sigma, d_time: -slope * sign, d_log_width: slope * width, d_log_softness: sigma * e * e }
            }
        }
    }

    /// ∂²σ/∂t² at time t, for a `row` as [`LifeKind::eval`] takes it: how far from constant or fading evenly the
    /// lifespan is. Where an interval's flat top meets its tail it jumps; there it is the top's, 0.
    pub fn d2_time<F: Real>(self, row: [F; 3], t: Time) -> F {
        let (delta, sigma) = (F::of(t.0) - row[CENTER], self.eval(row, t).sigma);
        // σ = exp(−h·x²), x in units of 1/inverse: σ'' = (4h²x² − 2h)·σ·inverse².
        let (h, x, inverse) = match self {
            Self::Infinite => return F::ZERO,
            Self::GaussHalf | Self::GaussOne => {
                let inverse = (-row[LOG_WIDTH]).exp();
                (if self == Self::GaussHalf { F::HALF } else { F::ONE }, delta * inverse, inverse)
            }
            Self::Interval => {
                let (over, inverse) = (delta.abs() - row[LOG_WIDTH].exp(), (-row[LOG_SOFTNESS]).exp());
                if over <= F::ZERO {
                    return F::ZERO;
                }
                (F::HALF, over * inverse, inverse)
            }
        };
        let h2 = F::TWO * h;
        (h2 * h2 * x * x - h2) * sigma * inverse * inverse
    }

    /// The seconds before and after the centre at which σ·opacity falls to `alpha_min`; negative where it never reaches
    /// it.
    pub fn reach(self, row: [f64; 3], opacity: f64, alpha_min: f64) -> f64 {
        let level = (opacity / alpha_min).ln();
        if level < 0.0 {
            return -1.0;
        }
        match self {
            Self::Infinite => f64::INFINITY,
            Self::GaussHalf => row[LOG_WIDTH].exp() * (2.0 * level).sqrt(),
            Self::GaussOne => row[LOG_WIDTH].exp() * level.sqrt(),
            Self::Interval => row[LOG_WIDTH].exp() + row[LOG_SOFTNESS].exp() * (2.0 * level).sqrt(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_equal_finite_differences() {
        for kind in [LifeKind::GaussHalf, LifeKind::GaussOne, LifeKind::Interval] {
            for i in 0..40 {
                let t = -2.0 + i as f64 * 0.11;
                let row = [0.1, -0.4, -0.7];
                let v = kind.eval(row, Time(t));
                let h = 1e-6;
                let fd = |k: usize| {
                    let (mut up, mut down) = (row, row);
                    up[k] += h;
                    down[k] -= h;
                    (kind.eval(up, Time(t)).sigma - kind.eval(down, Time(t)).sigma) / (2.0 * h)
                };
                let fd_t = (kind.eval(row, Time(t + h)).sigma - kind.eval(row, Time(t - h)).sigma) / (2.0 * h);
                for (a, b) in [(v.d_time, fd_t), (-v.d_time, fd(0)), (v.d_log_width, fd(1)), (v.d_log_softness, fd(2))]
                {
                    assert!((a - b).abs() < 1e-7, "{kind:?} t {t}: {a} {b}");
                }
                let slope = |t: f64| kind.eval(row, Time(t)).d_time;
                let (a, b) = (kind.d2_time(row, Time(t)), (slope(t + h) - slope(t - h)) / (2.0 * h));
                assert!((a - b).abs() < 1e-6, "{kind:?} t {t}, second derivative: {a} {b}");
            }
        }
    }

    #[test]
    fn spacetime_and_freetime_lifespans_agree_at_width_times_sqrt_two() {
        for t in [-0.7, 0.0, 0.2, 1.5] {
            let free = LifeKind::GaussHalf.eval([0.2, -0.5, 0.0], Time(t)).sigma;
            let stg = LifeKind::GaussOne.eval([0.2, -0.5 + 2.0f64.sqrt().ln(), 0.0], Time(t)).sigma;
            assert!((free - stg).abs() < 1e-14);
        }
    }

    #[test]
    fn interval_has_a_flat_top_and_infinite_life_is_one() {
        let row = [1.0, 0.5f64.ln(), 0.1f64.ln()];
        assert_eq!(LifeKind::Interval.eval(row, Time(1.49)).sigma, 1.0);
        assert!(LifeKind::Interval.eval(row, Time(1.7)).sigma < 0.2);
        assert_eq!(LifeKind::Infinite.eval([0.0; 3], Time(1e9)).sigma, 1.0);
    }

    #[test]
    fn reach_is_where_the_envelope_falls_to_the_threshold() {
        let row = [0.0, -1.0, -2.0];
        for kind in [LifeKind::GaussHalf, LifeKind::GaussOne, LifeKind::Interval] {
            let r = kind.reach(row, 0.7, 1.0 / 255.0);
            let level = 0.7 * kind.eval(row, Time(r)).sigma;
            assert!((level * 255.0 - 1.0).abs() < 1e-9, "{kind:?}");
            assert!(kind.reach(row, 1e-3, 1.0 / 255.0) < 0.0);
        }
    }
}
