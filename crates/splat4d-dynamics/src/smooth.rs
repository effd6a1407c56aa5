//! Smoothing of observed paths: a cubic smoothing spline on even ticks, with the strength of generalised
//! cross-validation.
//!
//! z = argmin ‖y − z‖² + λ‖D³z‖² (Whittaker 1923, Eilers 2003), whose ends stay free: parabolas pass unchanged, so that
//! the velocity at the last observed time is not pulled to zero. λ minimises n·RSS/(n − tr H)² (Craven and Wahba 1978)
//! over all nodes together. Ticks after the last observed one are not read.

use crate::matrix::{Matrix, solve};
use crate::paths::{Moment, Paths};
use splat4d::math::quat;

/// Order of the differences.
const ORDER: usize = 3;
/// Strengths that are tried: 10^(i/2), from nothing that is seen to whole clips as parabolas.
const STRENGTHS: std::ops::Range<i32> = -8..11;

/// Smooth paths. With too few ticks for differences they are unchanged.
pub(crate) fn smooth(paths: &Paths) -> Paths {
    let (ticks, nodes) = (paths.len(), paths.nodes());
    if ticks <= ORDER + 1 || nodes == 0 {
        return paths.clone();
    }
    let places = Matrix::from_fn(ticks, 3 * nodes, |t, c| paths.moments[t][c / 3].x[c % 3]);
    let turns = Matrix::from_fn(ticks, 4 * nodes, |t, c| aligned(paths, t, c / 4)[c % 4]);
    let (places, turns) = (smoothed(&places), smoothed(&turns));
    let moment = |t: usize| -> Moment {
        let node = |k: usize| crate::paths::Pose {
            x: std::array::from_fn(|c| places[(t, 3 * k + c)]),
            q: quat::normalize(std::array::from_fn(|c| turns[(t, 4 * k + c)])).0,
        };
        (0..nodes).map(node).collect()
    };
    Paths { moments: (0..ticks).map(moment).collect() }
}

/// A quaternion with the sign that is nearest to the last tick's, counted back tick by tick.
fn aligned(paths: &Paths, t: usize, k: usize) -> [f64; 4] {
    let mut sign = 1.0;
    for s in (t..paths.len() - 1).rev() {
        let (a, b) = (paths.moments[s][k].q, paths.moments[s + 1][k].q);
        if (0..4).map(|i| a[i] * b[i]).sum::<f64>() < 0.0 {
            sign = -sign;
        }
    }
    paths.moments[t][k].q.map(|x| sign * x)
}

/// Every column smoothed with one strength.
fn smoothed(y: &Matrix) -> Matrix {
    let n = y.height();
    let third = [-1.0, 3.0, -3.0, 1.0];
    let differences =
        Matrix::from_fn(n - ORDER, n, |r, c| c.checked_sub(r).and_then(|i| third.get(i)).copied().unwrap_or(0.0));
    let penalty = &differences.transpose() * &differences;
    let mut best: Option<(f64, Matrix)> = None;
    for power in STRENGTHS {
        let lambda = 10f64.powf(0.5 * f64::from(power));
        let system = Matrix::from_fn(n, n, |i, j| f64::from(u8::from(i == j)) + lambda * penalty[(i, j)]);
        let Some(factor) = system.cholesky() else { continue };
        let z = solve(&factor, y);
        let free = n as f64 - solve(&factor, &Matrix::identity(n)).trace();
        let score = (y - &z).norm_squared() / (free * free);
        if best.as_ref().is_none_or(|(s, _)| score < *s) {
            best = Some((score, z));
        }
    }
    best.map_or_else(|| y.clone(), |b| b.1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::paths::Pose;
    use splat4d::math::Rng;

    #[test]
    fn smoothing_removes_noise_and_keeps_parabolas() {
        let truth = |t: f64| [(0.2 * t).sin(), 0.01 * t * t - 0.3 * t, 1.0];
        let rng = Rng::new(1, "noise", 0);
        let path = |noise: f64| Paths {
            moments: (0..60u64)
                .map(|t| {
                    let x = truth(t as f64);
                    vec![Pose::at(std::array::from_fn(|c| x[c] + noise * rng.normal(3 * t + c as u64)))]
                })
                .collect(),
        };
        let error = |p: &Paths| -> f64 {
            let of = |t: usize, c: usize| (p.moments[t][0].x[c] - truth(t as f64)[c]).powi(2);
            ((0..60).map(|t| (0..3).map(|c| of(t, c)).sum::<f64>()).sum::<f64>() / 60.0).sqrt()
        };
        let (raw, smooth_) = (error(&path(0.05)), error(&smooth(&path(0.05))));
        assert!(smooth_ < 0.6 * raw, "{smooth_} of {raw}");
        assert!(error(&smooth(&path(0.0))) < 1e-3, "nothing is lost where nothing is to be smoothed");
        let few = path(0.05).first(4);
        assert_eq!(smooth(&few), few);
    }
}
