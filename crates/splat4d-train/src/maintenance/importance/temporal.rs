//! Temporal score of a Gaussian's lifespan: the temporal half of the score of 4DGS-1K (Yuan et al. 2025, §4.1), and its
//! variants.
//!
//! The paper's S^TV = Σ_t 1/(½ tanh p''(t) + ½), p the lifespan, summed over the whole clip, ranks in the opposite
//! order than its text states: a term is 1 + exp(−2p''), so that it overflows at the peak of a short lifespan, and a
//! time at which the Gaussian is not there counts 2, the most that |p''| could give. The reading that does what the
//! text states takes the product with the spatial score time by time: absent times vanish, and each present one weighs
//! 1 (flickers) to 2 (lasts). That is [`Temporal::InstantAbs`], the default; the others are kept for comparison.

use crate::settings::nearest;
use crate::{Error, Result};
use splat4d::layers::Layer;
use splat4d::math::Real;
use splat4d::scene::{LifeKind, Time};
use std::str::FromStr;

/// |p''| of the literal score is cut here: tanh is 1 to 7 digits, and Σ stays finite.
const LITERAL_LIMIT: f64 = 8.0;

/// Temporal score of a lifespan.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Temporal {
    /// 1/(½ tanh|p''(t)| + ½) at every time.
    #[default]
    InstantAbs,
    /// Σ over all times of the clip of 1/(½ tanh p''(t) + ½), signed as the paper prints it, |p''| at most 8.
    LiteralSignedClamped,
    /// 1/(½ tanh|p'(t)| + ½) at every time.
    FirstDerivative,
    /// The variance of the lifespan, the clip's length squared at most.
    Width,
    /// The mean of p over all times of the clip.
    ActiveFraction,
    /// 1: the spatial score alone.
    None,
}

/// The quantity of a view that becomes a spatial score.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Spatial {
    /// Σ over pixels of α T: how much of the images it is (4DGS-1K).
    #[default]
    Share,
    /// Σ over pixels and channels of the squared change that its removal alone would make. Neighbours of one colour
    /// replace each other, and may all go.
    Change,
    /// The geometric mean of both in each view: neither covering Gaussians nor those that differ from the background
    /// are pruned first.
    Both,
    /// Opacity at every time at which a view shows it (3DGS).
    Opacity,
    /// The share, times min(V/V₉₀, 1)^0.1 of the volume: the global significance of LightGaussian (Fan et al. 2024).
    LightGaussian,
    /// The sixth root of the determinant of the 6x6 Fisher block of mean and scale over all views: the rank of its
    /// logarithm, by which PUP 3D-GS (Hanson et al. 2025) prunes in rounds. Gaussians in a single view have no full
    /// block and are pruned first.
    Pup,
    /// Σ over pixels and channels of the squared gradient to the bare bell (Speedy-Splat, Hanson et al. 2025).
    Speedy,
}

/// Combination of spatial and temporal score.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Combine {
    /// Their product, time by time.
    #[default]
    Product,
    /// Their sum, each over its mean, the temporal one over the times at which the Gaussian is seen.
    Sum,
    /// The temporal score alone, over the times at which the Gaussian is seen.
    TemporalAlone,
}

macro_rules! names {
    ($type:ident, $what:literal, $($variant:ident $name:literal),*) => {
        impl $type {
            /// Every one, the default first.
            pub const ALL: &'static [Self] = &[$(Self::$variant),*];

            /// The name in recipes and on the command line.
            pub fn name(self) -> &'static str {
                match self { $(Self::$variant => $name),* }
            }
        }

        impl FromStr for $type {
            type Err = Error;

            fn from_str(name: &str) -> Result<Self> {
                let names: Vec<&str> = Self::ALL.iter().map(|v| v.name()).collect();
                Self::ALL.iter().copied().find(|v| v.name() == name).ok_or_else(|| {
                    let near = nearest(name, &names).map(|n| format!("; did you mean `{n}`?")).unwrap_or_default();
                    Error::input(format!(concat!("there is no ", $what, " `{}`"), name))
                        .remedy(format!("Use one of {}{near}", names.join(", ")))
                })
            }
        }

        impl TryFrom<String> for $type {
            type Error = Error;

            fn try_from(name: String) -> Result<Self> {
                name.parse()
            }
        }

        impl From<$type> for String {
            fn from(value: $type) -> Self {
                value.name().to_owned()
            }
        }

        impl std::fmt::Display for $type {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(self.name())
            }
        }
    };
}

names!(
    Temporal, "temporal score",
    InstantAbs "instant-abs", LiteralSignedClamped "literal-signed-clamped", FirstDerivative "first-derivative",
    Width "width", ActiveFraction "active-fraction", None "none"
);
names!(
    Spatial, "spatial score",
    Share "share", Change "change", Both "both", Opacity "opacity", LightGaussian "light-gaussian", Pup "pup",
    Speedy "speedy"
);
names!(Combine, "way to combine scores", Product "product", Sum "sum", TemporalAlone "temporal-alone");

/// The lifespans of a layer's Gaussians on a clock of its own unit.
pub(super) struct Lives {
    kind: LifeKind,
    rows: Vec<[f64; 3]>,
    /// The layer is seen from, to (seconds).
    span: [f64; 2],
    /// Seconds of the clip.
    clip: f64,
    /// Seconds of a unit of time.
    unit: f64,
}

impl Lives {
    pub(super) fn new(layer: &Layer<f32>, clip: f64, unit: f64) -> Self {
        let (kind, rows) = layer.lifespans();
        Self { kind, rows, span: layer.span, clip, unit }
    }

    /// The score of a time at which the Gaussian is seen; 1 where the score is one of the whole lifespan.
    pub(super) fn instant(&self, temporal: Temporal, row: usize, t: Time) -> f64 {
        let row = self.rows[row];
        let steepness = match temporal {
            Temporal::InstantAbs => self.kind.d2_time(row, t) * self.unit * self.unit,
            Temporal::FirstDerivative => self.kind.eval(row, t).d_time * self.unit,
            _ => return 1.0,
        };
        1.0 / (0.5 * steepness.abs().tanh() + 0.5)
    }

    /// The score of the whole lifespan, of which `times` are the times; 1 where the score is one of times.
    pub(super) fn whole(&self, temporal: Temporal, row: usize, times: &[Time]) -> f64 {
        let row = self.rows[row];
        let seen = || times.iter().filter(|t| self.span[0] <= t.0 && t.0 < self.span[1]);
        match temporal {
            Temporal::LiteralSignedClamped => seen()
                .map(|&t| {
                    let p2 = self.kind.d2_time(row, t) * self.unit * self.unit;
                    1.0 / (0.5 * p2.clamp(-LITERAL_LIMIT, LITERAL_LIMIT).tanh() + 0.5)
                })
                .sum(),
            Temporal::ActiveFraction => {
                seen().map(|&t| self.kind.eval(row, t).sigma).sum::<f64>() / times.len().max(1) as f64
            }
            Temporal::Width => {
                let deviation = self.deviation(row);
                deviation * deviation
            }
            Temporal::InstantAbs | Temporal::FirstDerivative | Temporal::None => 1.0,
        }
    }

    /// The lifespan's scale in time, units, at most the clip: a Gaussian's standard deviation; of an interval its half
    /// plus its softness.
    pub(super) fn scale(&self, row: usize) -> f64 {
        self.deviation(self.rows[row])
    }

    fn deviation(&self, [_, log_width, log_softness]: [f64; 3]) -> f64 {
        let seconds = match self.kind {
            LifeKind::Infinite => f64::INFINITY,
            LifeKind::GaussHalf => log_width.exp(),
            LifeKind::GaussOne => log_width.exp() / 2.0.sqrt(),
            LifeKind::Interval => log_width.exp() + log_softness.exp(),
        };
        seconds.min(self.clip) / self.unit
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::layers::ALWAYS;

    /// One life of this standard deviation (frames at 30 a second) in the middle of 300 frames, between two of them,
    /// time in seconds.
    fn life(frames: f64) -> (Lives, Vec<Time>) {
        let row = [149.5 / 30.0, (frames / 30.0).ln(), 0.0];
        let lives = Lives { kind: LifeKind::GaussHalf, rows: vec![row], span: ALWAYS, clip: 10.0, unit: 1.0 };
        (lives, (0..300).map(|i| Time(f64::from(i) / 30.0)).collect())
    }

    const LIVES: [f64; 7] = [1.0, 3.0, 7.0, 15.0, 30.0, 67.0, 212.0];

    /// The default score of lifespans whose spatial score at a time is p.
    #[test]
    fn the_default_score_grows_with_lifespan() {
        let score = |frames: f64| {
            let (lives, times) = life(frames);
            let at = |t: &Time| lives.instant(Temporal::InstantAbs, 0, *t) * lives.kind.eval(lives.rows[0], *t).sigma;
            times.iter().map(at).sum::<f64>()
        };
        let scores = LIVES.map(score);
        assert!(scores.windows(2).all(|w| w[0] < w[1]), "{scores:?}");
        // Computed apart from this code, from the formula; where a short lifespan is between frames matters by 3 %.
        for (s, expected) in scores.iter().zip([2.5, 7.5, 18.2, 41.8, 106.0, 296.0, 545.0]) {
            assert!((s / expected - 1.0).abs() < 0.04, "{scores:?}");
        }
    }

    /// Why the printed score is not the default.
    #[test]
    fn the_published_score_overflows_and_prefers_short_lifespans() {
        let sum = |frames: f64, term: &dyn Fn(f64) -> f64| {
            let (lives, times) = life(frames);
            times.iter().map(|t| term(lives.kind.d2_time(lives.rows[0], *t))).sum::<f64>()
        };
        // f32, as the original computes.
        let signed = LIVES.map(|f| sum(f, &|p| f64::from(1.0 / (0.5 * (p as f32).tanh() + 0.5))));
        assert!(signed[..3].iter().all(|s| *s > 1e6), "{signed:?}");
        assert!(signed[3..].windows(2).all(|w| w[0] > w[1]), "shorter is better: {signed:?}");
        let absolute = LIVES.map(|f| sum(f, &|p| 1.0 / (0.5 * p.abs().tanh() + 0.5)));
        assert!(absolute[0] > absolute[3] && absolute[3] < absolute[6], "not monotone: {absolute:?}");
        // Cut, it is finite, and still the wrong way round.
        let cut = LIVES.map(|f| {
            let (lives, times) = life(f);
            lives.whole(Temporal::LiteralSignedClamped, 0, &times)
        });
        assert!(cut.iter().all(|s| s.is_finite()) && cut[1] > 100.0 * cut[6], "{cut:?}");
    }

    #[test]
    fn variants_by_lifespan_grow_with_lifespan() {
        for temporal in [Temporal::Width, Temporal::ActiveFraction] {
            let scores = LIVES.map(|f| {
                let (lives, times) = life(f);
                lives.whole(temporal, 0, &times)
            });
            assert!(scores.windows(2).all(|w| w[0] < w[1]), "{temporal}: {scores:?}");
        }
        let (lives, _) = life(30.0);
        assert!(
            (lives.instant(Temporal::FirstDerivative, 0, Time(149.5 / 30.0)) - 2.0).abs() < 1e-12,
            "flat at its peak"
        );
        assert!(lives.instant(Temporal::FirstDerivative, 0, Time(6.0)) < 1.5);
        let endless = Lives { kind: LifeKind::Infinite, rows: vec![[0.0; 3]], span: ALWAYS, clip: 3.0, unit: 1.5 };
        assert_eq!((endless.instant(Temporal::InstantAbs, 0, Time(1.0)), endless.scale(0)), (2.0, 2.0));
    }

    #[test]
    fn names_round_trip_and_wrong_ones_get_a_suggestion() {
        for t in Temporal::ALL {
            assert_eq!(t.name().parse::<Temporal>().unwrap(), *t);
        }
        for c in Combine::ALL {
            assert_eq!(c.to_string().parse::<Combine>().unwrap(), *c);
        }
        assert!("instant_abs".parse::<Temporal>().unwrap_err().to_string().contains("`instant-abs`"));
        assert!("x".parse::<Combine>().unwrap_err().to_string().contains("product, sum"));
    }
}
