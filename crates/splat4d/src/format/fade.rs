//! Smooth fades for Gaussians whose opacity has a flat top in time or ends at once: what playback files hold, and the
//! moving dialects of other programs cannot express.
//!
//! A Gaussian's opacity over time becomes A·exp(−((t − centre)/width)²), least squares over the clip. One that is cut
//! off within the clip, because its path continues as another Gaussian, fades over half its length to either side of
//! the cut, so that the two give way to each other; the fading is that of layers (1 − (1 − o)^w).

use crate::scene::LifeKind;
use crate::scene::Time;

/// Times at which the opacity is examined.
const SAMPLES: usize = 32;
/// An end counts as cut where this share of the opacity is lost at once.
const CUT: f64 = 0.02;
/// Opacity above which a fit is capped: the renderers' ceiling is 0.99.
const MOST: f64 = 0.9999;
/// Halvings of the steps in centre and log width, of which the first is half the length.
const HALVINGS: usize = 10;
/// Steps of one size that are taken at most: a slope that never ends is followed no further.
const MOST_STEPS: usize = 24;
/// Tails reach this many of their own widths: exp(−½·3²) = 1 %.
const TAILS: f64 = 3.0;
/// Width, in lengths of the clip, from which a fade counts as none.
const FLAT: f64 = 1e4;

/// When a Gaussian is seen. Seconds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Visibility {
    pub(super) kind: LifeKind,
    /// Its columns, as [`LifeKind::eval`] takes them.
    pub(super) life: [f64; 3],
    /// Opacity at the lifespan's top.
    pub(super) opacity: f64,
    /// Outside of it, nothing is rendered.
    pub(super) span: [f64; 2],
    /// Seconds in which the layer fades in and out.
    pub(super) cross_fade: [f64; 2],
    pub(super) clip: [f64; 2],
}

/// The fitted fade: opacity·exp(−((t − centre)/width)²), seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Fade {
    pub(super) center: f64,
    pub(super) width: f64,
    pub(super) opacity: f64,
}

impl Visibility {
    fn sigma(&self, t: f64) -> f64 {
        self.kind.eval(self.life, Time(t)).sigma
    }

    /// Whether the span's end `k` (0: first, 1: last) cuts off what would be seen beyond it within the clip.
    fn is_cut(&self, k: usize) -> bool {
        let [first, last] = self.clip;
        if [self.span[0] <= first, self.span[1] >= last][k] {
            return false;
        }
        // Most is seen at the centre, where that is beyond the end.
        let center = self.life[0];
        let beyond = self.kind != LifeKind::Infinite && [center < self.span[0], center > self.span[1]][k];
        self.sigma(if beyond { center.max(first).min(last) } else { self.span[k] }) > CUT
    }

    /// The fade that states the same exactly. `None`: there is none.
    pub(super) fn exact(&self) -> Option<Fade> {
        let [first, last] = self.clip;
        let [center, log_width, log_softness] = self.life;
        if self.cross_fade != [0.0; 2] || self.is_cut(0) || self.is_cut(1) {
            return None;
        }
        let fade = |center: f64, width: f64| Some(Fade { center, width, opacity: self.opacity });
        match self.kind {
            LifeKind::Infinite => fade(0.5 * (first + last), FLAT * (last - first).max(1.0)),
            // exp(−½(Δ/w)²) = exp(−(Δ/s)²) at s = √2·w.
            LifeKind::GaussHalf => fade(center, log_width.exp() * std::f64::consts::SQRT_2),
            LifeKind::GaussOne => fade(center, log_width.exp()),
            LifeKind::Interval => {
                let (half, softness) = (log_width.exp(), log_softness.exp());
                if center - half <= first && center + half >= last {
                    return fade(0.5 * (first + last), FLAT * (last - first).max(1.0));
                }
                // A top that is narrow next to its tails is that of a Gaussian.
                (half <= CUT * softness).then(|| fade(center, softness * std::f64::consts::SQRT_2)).flatten()
            }
        }
    }

    /// The fade that is nearest over the clip. `None`: the Gaussian is never seen.
    pub(super) fn fit(&self) -> Option<Fade> {
        let [first, last] = self.clip;
        // Where anything is seen at all: the top and its tails, within span and clip.
        let reach = self.kind.reach(self.life, self.opacity, crate::layers::ALPHA_MIN);
        let center = if self.kind == LifeKind::Infinite { 0.5 * (first + last) } else { self.life[0] };
        let low = first.max(self.span[0]).max(center - reach);
        let high = last.min(self.span[1]).min(center + reach);
        if low > high || (low + high).is_nan() {
            return None;
        }
        let length = (high - low).max(f64::MIN_POSITIVE);
        let cut = [0, 1].map(|k| self.cross_fade[k] == 0.0 && self.is_cut(k));
        let beyond = |cut: bool| if cut { 0.5 * length } else { TAILS * length };
        let (from, to) = ((low - beyond(cut[0])).max(first), (high + beyond(cut[1])).min(last));
        let wanted = |t: f64| {
            let ramp = |k: usize| {
                let inward = [t - self.span[0], self.span[1] - t][k];
                let share = match () {
                    () if cut[k] => 0.5 + inward / length,
                    () if self.cross_fade[k] > 0.0 => inward / self.cross_fade[k],
                    () if inward < 0.0 => 0.0,
                    () => 1.0,
                };
                share.clamp(0.0, 1.0)
            };
            1.0 - (1.0 - self.opacity.min(MOST) * self.sigma(t)).powf(ramp(0).min(ramp(1)))
        };
        let at = |i: usize| if to > from { from + (to - from) * (i as f64 + 0.5) / SAMPLES as f64 } else { from };
        let samples: [[f64; 2]; SAMPLES] = std::array::from_fn(|i| [at(i), wanted(at(i))]);
        Some(nearest(&samples, length))
    }
}

/// Least squares: for every centre and width the best height is known, and these two are sought in steps that halve.
fn nearest(samples: &[[f64; 2]; SAMPLES], length: f64) -> Fade {
    let mass: f64 = samples.iter().map(|s| s[1]).sum();
    let middle = samples.iter().map(|s| s[0] * s[1]).sum::<f64>() / mass.max(f64::MIN_POSITIVE);
    let middle = if middle.is_finite() && mass > 0.0 { middle } else { samples[SAMPLES / 2][0] };
    let error = |center: f64, log_width: f64| {
        let inverse = (-log_width).exp();
        let shape = |t: f64| (-((t - center) * inverse).powi(2)).exp();
        let (mut product, mut square) = (0.0, 0.0);
        for [t, wanted] in samples {
            let g = shape(*t);
            (product, square) = (product + g * wanted, square + g * g);
        }
        let height = (product / square.max(f64::MIN_POSITIVE)).clamp(0.0, MOST);
        let miss: f64 = samples.iter().map(|[t, wanted]| (height * shape(*t) - wanted).powi(2)).sum();
        (miss, height)
    };
    let mut best = [middle, (0.5 * length).ln()];
    let mut least = error(best[0], best[1]);
    let (mut step, mut ratio) = (0.5 * length, 1.0);
    for _ in 0..HALVINGS {
        for _ in 0..MOST_STEPS {
            let mut better = false;
            for [x, y] in [[step, 0.0], [-step, 0.0], [0.0, ratio], [0.0, -ratio]] {
                let there = [best[0] + x, best[1] + y];
                let found = error(there[0], there[1]);
                if found.0 < least.0 * (1.0 - 1e-9) {
                    (best, least, better) = (there, found, true);
                }
            }
            if !better {
                break;
            }
        }
        (step, ratio) = (0.5 * step, 0.5 * ratio);
    }
    Fade { center: best[0], width: best[1].exp(), opacity: least.1 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn interval(center: f64, half: f64, softness: f64) -> Visibility {
        Visibility {
            kind: LifeKind::Interval,
            life: [center, half.ln(), softness.ln()],
            opacity: 0.6,
            span: [f64::NEG_INFINITY, f64::INFINITY],
            cross_fade: [0.0; 2],
            clip: [0.0, 2.0],
        }
    }

    impl Fade {
        fn at(&self, t: f64) -> f64 {
            self.opacity * (-((t - self.center) / self.width).powi(2)).exp()
        }
    }

    fn rms(count: usize, clip: [f64; 2], difference: impl Fn(f64) -> f64) -> f64 {
        let at = |i: usize| clip[0] + (clip[1] - clip[0]) * (i as f64 + 0.5) / count as f64;
        ((0..count).map(|i| difference(at(i)).powi(2)).sum::<f64>() / count as f64).sqrt()
    }

    #[test]
    fn gaussian_fades_stay_exact() {
        let thin = interval(0.7, 1e-9, 0.2).exact().unwrap();
        assert!((thin.at(0.9) - 0.6 * (-0.5f64).exp()).abs() < 1e-12);
        let long = interval(1.0, 1e9, 0.1).exact().unwrap();
        assert!((long.at(0.0) - 0.6).abs() < 1e-7);
        // A span that holds the whole lifespan cuts nothing.
        let held = Visibility { span: [0.0, 1.5], ..interval(0.7, 1e-9, 0.1) };
        assert_eq!(held.exact().unwrap().center, 0.7);
        assert!(interval(1.0, 0.3, 0.05).exact().is_none());
        assert!(Visibility { span: [0.5, 1.5], ..interval(1.0, 1e9, 0.1) }.exact().is_none());
    }

    #[test]
    fn a_flat_top_is_fitted_by_least_squares() {
        let seen = interval(1.0, 0.3, 0.05);
        let fade = seen.fit().unwrap();
        let miss = rms(400, seen.clip, |t| fade.at(t) - seen.opacity * seen.sigma(t));
        assert!((fade.center - 1.0).abs() < 0.01 && miss < 0.1, "{fade:?}: {miss}");
        // Neither a wider nor a narrower one is nearer.
        for factor in [0.9, 1.1] {
            let other = Fade { width: fade.width * factor, ..fade };
            assert!(rms(400, seen.clip, |t| other.at(t) - seen.opacity * seen.sigma(t)) > miss);
        }
        // A segment in the tail of a lifespan must not bring the whole lifespan along.
        let tail = Visibility { span: [0.0, 0.3], ..interval(1.0, 1e-9, 0.25) };
        assert_eq!(tail.exact(), None);
        assert!(tail.fit().is_none_or(|f| f.at(1.0) < 0.05), "{:?}", tail.fit());
        let never = Visibility { span: [3.0, 4.0], ..seen };
        assert_eq!(never.fit(), None);
    }

    #[test]
    fn segments_of_one_path_fade_into_each_other() {
        // One Gaussian with an infinite lifespan, cut into four segments: together they must stay near 0.6.
        let pieces: Vec<Fade> = (0..4)
            .map(|i| {
                let span = [0.5 * f64::from(i), 0.5 * f64::from(i + 1)];
                Visibility { span, ..interval(1.0, 1e9, 1.0) }.fit().unwrap()
            })
            .collect();
        let together = |t: f64| 1.0 - pieces.iter().map(|p| 1.0 - p.at(t)).product::<f64>();
        let miss = rms(200, [0.0, 2.0], |t| together(t) - 0.6);
        assert!(miss < 0.03, "{miss}: {pieces:?}");
    }
}
