//! The quality of a forecast: node errors by horizon, skill over freezing, win rates, divergence, calibration.

use crate::paths::Moment;
use splat4d::math::se3::{norm, sub};

/// A forecast that leaves this multiple of the scene's size has diverged.
const DIVERGED: f64 = 2.0;

/// Mean distance of nodes from the truth, scene units, a number per frame as far as there is truth.
pub fn node_errors(found: &[Moment], truth: &[Moment]) -> Vec<f64> {
    let mean = |(a, b): (&Moment, &Moment)| {
        a.iter().zip(b).map(|(a, b)| norm(sub(a.x, b.x))).sum::<f64>() / a.len().max(1) as f64
    };
    found.iter().zip(truth).map(mean).collect()
}

/// 1 − error/baseline of mean squared errors: 1 is perfect, 0 no better than the baseline, which is 0 exactly. Where
/// the baseline makes no error, 0 for none and −∞ for any.
pub fn skill(error: f64, baseline: f64) -> f64 {
    if error == baseline { 0.0 } else { 1.0 - error / baseline }
}

/// Share of the cases in which `a` is smaller than `b`; a draw is half a win. `None`: no case.
pub fn win_rate(a: &[f64], b: &[f64]) -> Option<f64> {
    let win = |(a, b): (&f64, &f64)| {
        if a < b {
            1.0
        } else if a == b {
            0.5
        } else {
            0.0
        }
    };
    (!a.is_empty()).then(|| a.iter().zip(b).map(win).sum::<f64>() / a.len() as f64)
}

/// The first frame (from 1) at which a node is not finite, or twice as far from where the nodes started as `size`.
pub fn diverged(found: &[Moment], start: &Moment, size: f64) -> Option<usize> {
    let near = |far: f64| far <= DIVERGED * size; // false of what is not finite
    let gone = |m: &Moment| m.iter().zip(start).any(|(a, b)| !near(norm(sub(a.x, b.x))));
    found.iter().position(gone).map(|i| i + 1)
}

/// The mean of an ensemble, and its spread: a standard deviation a frame and node, over the three axes together.
pub fn ensemble(members: &[Vec<Moment>]) -> (Vec<Moment>, Vec<Vec<f64>>) {
    let n = members.len() as f64;
    let mut mean = members[0].clone();
    let mut spread = Vec::new();
    for (h, moment) in mean.iter_mut().enumerate() {
        let mut sigmas = Vec::new();
        for (k, pose) in moment.iter_mut().enumerate() {
            let all = || members.iter().map(|m| m[h][k].x);
            let x: [f64; 3] = std::array::from_fn(|c| all().map(|x| x[c]).sum::<f64>() / n);
            let square = all().map(|y| norm(sub(y, x)).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
            pose.x = x;
            sigmas.push(square.sqrt());
        }
        spread.push(sigmas);
    }
    (mean, spread)
}

/// Calibration of an ensemble: its spread against its errors.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Calibration {
    /// Root mean square of the error over that of the spread: 1 is right, above 1 is overconfident.
    pub ratio: f64,
    /// Share of the nodes and frames whose error is at most the spread, and at most twice the spread.
    pub within: [f64; 2],
}

/// The calibration of an ensemble; `None`: nothing to compare with.
pub fn calibration(mean: &[Moment], spread: &[Vec<f64>], truth: &[Moment]) -> Option<Calibration> {
    let mut cases = Vec::new();
    for ((found, sigma), truth) in mean.iter().zip(spread).zip(truth) {
        cases.extend(found.iter().zip(sigma).zip(truth).map(|((f, s), t)| (norm(sub(f.x, t.x)), *s)));
    }
    if cases.is_empty() {
        return None;
    }
    let n = cases.len() as f64;
    let square = |f: fn(&(f64, f64)) -> f64| cases.iter().map(|c| f(c).powi(2)).sum::<f64>();
    let within = [1.0, 2.0].map(|k| cases.iter().filter(|c| c.0 <= k * c.1).count() as f64 / n);
    Some(Calibration { ratio: (square(|c| c.0) / square(|c| c.1).max(f64::MIN_POSITIVE)).sqrt(), within })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::paths::Pose;
    use splat4d::math::Rng;

    #[test]
    fn the_baseline_has_zero_skill() {
        for error in [0.0, 1e-300, 0.1, 7.3] {
            assert_eq!(skill(error, error), 0.0);
        }
        assert!(skill(1e-6, 1.0) > 0.999 && skill(2.0, 1.0) == -1.0 && skill(1.0, 0.0) == f64::NEG_INFINITY);
        assert_eq!((win_rate(&[1.0, 2.0, 3.0], &[2.0, 2.0, 1.0]), win_rate(&[], &[])), (Some(0.5), None));
    }

    #[test]
    fn an_ensemble_that_errs_as_it_spreads_is_calibrated() {
        let rng = Rng::new(3, "ensemble", 0);
        let drawn = |i: u64| Pose::at([0, 1, 2].map(|c| rng.normal(3 * i + c)));
        let moments = |m: u64| -> Vec<Moment> { (0..300).map(|h| vec![drawn(300 * m + h)]).collect() };
        let (mean, spread) = ensemble(&(0..3).map(moments).collect::<Vec<_>>());
        let c = calibration(&mean, &spread, &moments(3)).unwrap();
        // The mean of three errs by √(1 + 1/3) of what one does.
        assert!((c.ratio - (4.0f64 / 3.0).sqrt()).abs() < 0.1, "{c:?}");
        assert!(c.within[0] < c.within[1] && c.within[1] > 0.8);
        let far = vec![vec![Pose::at([0.5, 0.0, 0.0])], vec![Pose::at([3.0, 0.0, 0.0])]];
        let start = vec![Pose::at([0.0; 3])];
        assert_eq!((diverged(&far, &start, 1.0), diverged(&far, &start, 2.0)), (Some(2), None));
        assert_eq!(diverged(&[vec![Pose::at([f64::NAN; 3])]], &start, 1.0), Some(1));
    }
}
