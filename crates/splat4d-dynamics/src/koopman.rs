//! M1: a linear model of all nodes together by optimised dynamic mode decomposition (Askham and Kutz 2018), stable by
//! construction.
//!
//! Poses of all nodes at a tick are one vector y: positions, and rotation matrices times a length, so that a turn
//! weighs as what it moves; a steady rotation has the frequency of its positions, and its quaternion half of it. The
//! model is y(t) = b + Σ_j e^(−a_j² t) (c_j cos ω_j t + s_j sin ω_j t): every eigenvalue e^(−a² ± iω) is within the
//! unit circle, so that no rollout grows. Decays and frequencies are fitted to all observed ticks at once by variable
//! projection (Golub and Pereyra 1973, with Kaufman's Jacobian 1975) on the principal components of y, pair by pair,
//! each from the frequency that explains most of what is left. Regression from tick to tick, with delays or without, is
//! biased towards decay by noise (Dawson et al. 2016), which nodes that were learnt from images have; a fit of whole
//! paths is not. How many pairs there are is chosen by forecasts from several ticks of the past. The residual of the
//! last tick decays as earlier residuals did.

use crate::matrix::{Matrix, solve};
use crate::paths::{Moment, Paths, Pose, nearest};
use splat4d::math::cholesky::Cholesky;
use splat4d::math::mat3::procrustes;
use splat4d::math::median;
use splat4d::math::quat;
use splat4d::math::se3::{norm, sub};

/// Share of the variance that components keep, and most components.
const KEPT: f64 = 0.999;
const COMPONENTS: usize = 16;
/// Most pairs of eigenvalues.
const PAIRS: usize = 8;
/// Ticks that there must be for every number that is fitted to a path.
const TICKS_A_NUMBER: usize = 3;
/// Shares of the observed ticks at whose ends trial forecasts start, their length, and the fewest ticks to start from.
/// The median decides: a fit to half of the ticks can miss by far.
const STARTS: [f64; 7] = [0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8];
const AHEAD: f64 = 0.2;
const FEWEST: usize = 4;
/// The shortest period, ticks: faster swings are noise, or are sampled too rarely to be distinguished.
const SHORTEST: f64 = 4.0;
/// Frequencies that are tried for a new pair, to a resolution (2π over the ticks).
const FINENESS: usize = 4;
/// √ of the decay a tick that a new pair starts with.
const DECAY: f64 = 0.01;
/// Of the squares of a fitted column: regularises columns that are nearly equal.
const RIDGE: f64 = 1e-9;
/// Steps of Levenberg and Marquardt, the damping that they begin with and what it changes by, and the gain that ends
/// them.
const STEPS: usize = 60;
const DAMPING: f64 = 1e-3;
const DAMPING_CHANGE: f64 = 10.0;
const MOST_DAMPING: f64 = 1e8;
const LEAST_GAIN: f64 = 1e-12;
/// Neighbours from which the distance of a node's Gaussians is estimated.
const NEIGHBOURS: usize = 6;

/// A pair of eigenvalues e^(−root² ± i turn) a tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pair {
    pub root: f64,
    pub turn: f64,
}

/// A fitted model: its eigenvalues. Their amplitudes at each node follow from the paths that it continues.
#[derive(Clone, Debug)]
pub(crate) struct Koopman {
    pub(crate) pairs: Vec<Pair>,
}

impl Koopman {
    /// The model with as many pairs as forecast best from earlier ticks.
    pub(crate) fn fit(paths: &Paths) -> Self {
        let ticks = paths.len();
        let ahead = ((AHEAD * ticks as f64).round() as usize).max(1);
        let starts: Vec<usize> = STARTS.iter().map(|s| (s * ticks as f64).round() as usize).collect();
        let mut errors = vec![Vec::new(); most_pairs(starts.iter().copied().min().unwrap_or(0))];
        for start in starts.into_iter().filter(|&s| s >= FEWEST && s < ticks) {
            let seen = paths.first(start);
            let components = components(&numbers(&seen));
            let mut model = Self { pairs: Vec::new() };
            for errors in &mut errors {
                model.pairs = grown(&model.pairs, &components);
                let truth = &paths.moments[start..ticks.min(start + ahead)];
                errors.push(distance(&model.rollout(&seen, truth.len()), truth));
            }
        }
        let medians: Vec<f64> = errors.into_iter().map(|mut of| median(&mut of).unwrap_or(0.0)).collect();
        let best = (0..medians.len()).min_by(|&a, &b| medians[a].total_cmp(&medians[b])).map_or(1, |i| i + 1);
        Self::with(paths, best)
    }

    /// The model of this many pairs.
    pub(crate) fn with(paths: &Paths, count: usize) -> Self {
        let components = components(&numbers(paths));
        Self { pairs: (0..count).fold(Vec::new(), |pairs, _| grown(&pairs, &components)) }
    }

    /// The times after the last of `paths`.
    pub(crate) fn rollout(&self, paths: &Paths, horizon: usize) -> Vec<Moment> {
        let (y, ticks) = (numbers(paths), paths.len());
        let basis = columns(&self.pairs, ticks + horizon);
        let seen = basis.rows(0..ticks);
        let amounts = Projection::new(seen.clone()).amounts(&y);
        let rest = &y - &(&seen * &amounts);
        let (before, after) = (rest.rows(0..ticks - 1), rest.rows(1..ticks));
        // The rest is taken for an autoregression of the first order, one for all.
        let fading = (before.dot(&after) / before.norm_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        let later = &basis.rows(ticks..ticks + horizon) * &amounts;
        let length = reach(paths);
        (0..horizon)
            .map(|h| {
                let share = fading.powi(h as i32 + 1);
                let y: Vec<f64> = later.row(h).iter().zip(rest.row(ticks - 1)).map(|(l, r)| l + share * r).collect();
                (0..paths.nodes()).map(|k| pose(&y, k, length)).collect()
            })
            .collect()
    }
}

/// How many pairs this many ticks determine: one at least.
fn most_pairs(ticks: usize) -> usize {
    ((ticks / TICKS_A_NUMBER).saturating_sub(1) / 2).clamp(1, PAIRS)
}

/// \[ticks, 1 + 2 pairs]: ones, and a fading cosine and sine of each pair.
fn columns(pairs: &[Pair], ticks: usize) -> Matrix {
    Matrix::from_fn(ticks, 1 + 2 * pairs.len(), |t, c| {
        let Some(i) = c.checked_sub(1) else { return 1.0 };
        let (pair, t) = (pairs[i / 2], t as f64);
        let phase = pair.turn * t;
        (-pair.root * pair.root * t).exp() * if i % 2 == 0 { phase.cos() } else { phase.sin() }
    })
}

/// Least squares on columns.
struct Projection {
    a: Matrix,
    gram: Cholesky,
}

impl Projection {
    fn new(a: Matrix) -> Self {
        let mut gram = &a.transpose() * &a;
        // Sines of nothing are nothing: of the mean square, not of their own.
        let ridge = RIDGE * gram.trace() / gram.height() as f64;
        (0..gram.height()).for_each(|i| gram[(i, i)] += ridge);
        let gram = gram.cholesky().expect("a Gram matrix with a ridge is positive");
        Self { a, gram }
    }

    /// Coefficients of each column for each column of y.
    fn amounts(&self, y: &Matrix) -> Matrix {
        solve(&self.gram, &(&self.a.transpose() * y))
    }

    /// Residual of y after the columns.
    fn rest(&self, y: &Matrix) -> Matrix {
        y - &(&self.a * &self.amounts(y))
    }
}

/// The pairs and one more, all fitted to `y` \[ticks, components].
fn grown(pairs: &[Pair], y: &Matrix) -> Vec<Pair> {
    let ticks = y.height();
    let unit = std::f64::consts::TAU / (FINENESS * ticks) as f64;
    let tries = ((std::f64::consts::TAU / SHORTEST) / unit) as usize;
    let with = |i: usize| [pairs, &[Pair { root: DECAY, turn: i as f64 * unit }]].concat();
    let left = |i: &usize| Projection::new(columns(&with(*i), ticks)).rest(y).norm_squared();
    let first = (1..=tries.max(1)).map(|i| (left(&i), i)).min_by(|a, b| a.0.total_cmp(&b.0)).map_or(1, |b| b.1);
    fitted(with(first), y)
}

/// Levenberg and Marquardt over roots and turns.
fn fitted(mut pairs: Vec<Pair>, y: &Matrix) -> Vec<Pair> {
    let ticks = y.height();
    let mut damping = DAMPING;
    let mut projection = Projection::new(columns(&pairs, ticks));
    let mut rest = projection.rest(y);
    for _ in 0..STEPS {
        let jacobian = jacobian(&pairs, &projection, y);
        let n = jacobian.len();
        let normal = Matrix::from_fn(n, n, |i, j| jacobian[i].dot(&jacobian[j]));
        let slope: Vec<f64> = jacobian.iter().map(|of| of.dot(&rest)).collect();
        let before = rest.norm_squared();
        let after = loop {
            let mut damped = normal.clone();
            (0..n).for_each(|i| damped[(i, i)] += damping * normal[(i, i)].max(f64::MIN_POSITIVE));
            let step = damped.cholesky().map(|c| c.solve(slope.clone()));
            if let Some(step) = step.filter(|s| s.iter().all(|x| x.is_finite())) {
                let moved =
                    |(i, p): (usize, &Pair)| Pair { root: p.root - step[2 * i], turn: p.turn - step[2 * i + 1] };
                let next: Vec<Pair> = pairs.iter().enumerate().map(moved).collect();
                let trial = Projection::new(columns(&next, ticks));
                let left = trial.rest(y);
                if left.norm_squared() < before {
                    (pairs, projection, rest) = (next, trial, left);
                    damping = (damping / DAMPING_CHANGE).max(f64::MIN_POSITIVE);
                    break rest.norm_squared();
                }
            }
            damping *= DAMPING_CHANGE;
            if damping > MOST_DAMPING {
                return pairs;
            }
        };
        if before - after <= LEAST_GAIN * before {
            break;
        }
    }
    pairs
}

/// Derivatives of the rest with respect to each root and turn (Kaufman: −P⊥ (∂A/∂p) B).
fn jacobian(pairs: &[Pair], projection: &Projection, y: &Matrix) -> Vec<Matrix> {
    let amounts = projection.amounts(y);
    let of = |i: usize, which: usize| {
        let (c, s) = (1 + 2 * i, 2 + 2 * i);
        let changed = Matrix::from_fn(y.height(), y.width(), |t, k| {
            let (bc, bs) = (amounts[(c, k)], amounts[(s, k)]);
            let (cos, sin) = (projection.a[(t, c)], projection.a[(t, s)]);
            let slope = if which == 0 { -2.0 * pairs[i].root * (cos * bc + sin * bs) } else { cos * bs - sin * bc };
            t as f64 * slope
        });
        projection.rest(&changed).scaled(-1.0)
    };
    (0..pairs.len()).flat_map(|i| [of(i, 0), of(i, 1)]).collect()
}

/// Principal components of the numbers about their mean, \[ticks, components].
fn components(y: &Matrix) -> Matrix {
    let ticks = y.height();
    let mean: Vec<f64> = (0..y.width()).map(|c| (0..ticks).map(|t| y[(t, c)]).sum::<f64>() / ticks as f64).collect();
    let centred = Matrix::from_fn(ticks, y.width(), |t, c| y[(t, c)] - mean[c]);
    // Of the Gram matrix of the ticks: an eigenvector times its singular value is a component.
    let (eigenvalues, eigenvectors) = (&centred * &centred.transpose()).symmetric_eigen();
    let mut order: Vec<usize> = (0..ticks).collect();
    order.sort_by(|&a, &b| eigenvalues[b].total_cmp(&eigenvalues[a]));
    let values: Vec<f64> = order.iter().map(|&i| eigenvalues[i].max(0.0)).collect();
    let total: f64 = values.iter().sum();
    let mut kept = 0.0;
    let needed = values.iter().take_while(|v| {
        let more = kept < KEPT * total;
        kept += **v;
        more
    });
    let count = needed.count().clamp(1, COMPONENTS.min(order.len()));
    Matrix::from_fn(ticks, count, |t, c| eigenvectors[(order[c], t)] * values[c].sqrt())
}

/// How far a turn of a node reaches: the mean distance of nodes from their neighbours, scene units; of a single node,
/// how far it moves.
fn reach(paths: &Paths) -> f64 {
    let rest = paths.last();
    let near = nearest(rest, NEIGHBOURS);
    let all: Vec<f64> =
        near.iter().enumerate().flat_map(|(k, n)| n.iter().map(move |&j| norm(sub(rest[k].x, rest[j].x)))).collect();
    if all.is_empty() { paths.extent() } else { all.iter().sum::<f64>() / all.len() as f64 }
}

/// Numbers of a node: a position and a rotation matrix.
const WIDTH: usize = 12;

/// \[ticks, 12 nodes]: positions, and rotations (rows) times their reach.
fn numbers(paths: &Paths) -> Matrix {
    let length = reach(paths);
    Matrix::from_fn(paths.len(), WIDTH * paths.nodes(), |t, c| {
        let p = &paths.moments[t][c / WIDTH];
        match (c % WIDTH).checked_sub(3) {
            None => p.x[c % WIDTH],
            Some(i) => length * quat::to_rotation(p.q)[i / 3][i % 3],
        }
    })
}

fn pose(y: &[f64], k: usize, length: f64) -> Pose {
    let own = &y[WIDTH * k..WIDTH * (k + 1)];
    let turned = std::array::from_fn(|r| std::array::from_fn(|c| own[3 + 3 * r + c] / length.max(f64::MIN_POSITIVE)));
    let x = std::array::from_fn(|c| own[c]);
    Pose { x, q: quat::normalize(quat::from_rotation(&procrustes(turned))).0 }
}

/// Mean distance over nodes and ticks; infinite where it is not finite.
fn distance(found: &[Moment], truth: &[Moment]) -> f64 {
    let pairs = found.iter().zip(truth).flat_map(|(a, b)| a.iter().zip(b));
    let (sum, n) = pairs.fold((0.0, 0.0), |(s, n), (a, b)| (s + norm(sub(a.x, b.x)), n + 1.0));
    if f64::is_finite(sum / n) { sum / n } else { f64::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    fn circle(ticks: usize, delta: f64, noise: f64) -> Paths {
        let rng = Rng::new(2, "nodes", 0);
        let point = |t: usize, k: usize| {
            let a = delta * t as f64 + k as f64;
            let off = |c: u64| noise * rng.normal(3 * (5 * t + k) as u64 + c);
            [2.0 * a.cos() + 1.0 + off(0), 0.3 + off(1), 2.0 * a.sin() + off(2)]
        };
        Paths::of_points(&(0..ticks).map(|t| (0..5).map(|k| point(t, k)).collect()).collect::<Vec<_>>())
    }

    /// Mean distance of a forecast `ahead` ticks after 60 of a circle with noise, from the circle without.
    fn error_after(model: &Koopman, noise: f64, delta: f64, ahead: usize) -> f64 {
        let (paths, truth) = (circle(60, delta, noise), circle(60 + ahead, delta, 0.0));
        distance(&model.rollout(&paths, ahead)[ahead - 1..], &truth.moments[59 + ahead..])
    }

    #[test]
    fn eigenvalues_of_a_known_rotation_and_of_a_decay_are_recovered() {
        let delta = 0.37; // no whole number of rounds
        let pairs = Koopman::with(&circle(60, delta, 0.0), 1).pairs;
        assert_eq!(pairs.len(), 1);
        assert!((pairs[0].turn - delta).abs() < 1e-6 && pairs[0].root.powi(2) < 1e-6, "{pairs:?}");
        let point = |t: usize| {
            let (t, fading) = (t as f64, (-0.02 * t as f64).exp());
            vec![[fading * (0.5 * t).cos(), 3.0 + (0.21 * t + 1.0).sin(), 0.0]; 2]
        };
        let pairs = Koopman::with(&Paths::of_points(&(0..80).map(point).collect::<Vec<_>>()), 2).pairs;
        for (decay, turn) in [(0.02, 0.5), (0.0, 0.21)] {
            let found = |p: &Pair| (p.root.powi(2) - decay).abs() < 1e-6 && (p.turn.abs() - turn).abs() < 1e-6;
            assert!(pairs.iter().any(found), "{pairs:?}");
        }
    }

    #[test]
    fn a_circle_is_continued_and_bounded_for_a_thousand_steps() {
        let model = Koopman::fit(&circle(60, 0.11, 0.0));
        for h in [20, 1000] {
            let error = error_after(&model, 0.0, 0.11, h);
            assert!(error < 1e-4 * h as f64, "{error} after {h}");
        }
        // A growing signal: fitted without a bound, its rollout would reach e^50.
        let point = |t: usize| [(0.05 * t as f64).exp(), 0.0, (0.3 * t as f64).sin()];
        let growing = Paths::of_points(&(0..50).map(|t| vec![point(t), point(t + 3)]).collect::<Vec<_>>());
        let out = Koopman::fit(&growing).rollout(&growing, 1000);
        let far = out.iter().flatten().map(|p| norm(p.x)).fold(0.0, f64::max);
        assert!(far < 1e3, "{far}");
    }

    #[test]
    fn a_noisy_oscillation_is_forecast_within_its_noise() {
        let noise = 0.1; // of a radius of 2
        let model = Koopman::fit(&circle(60, 0.11, noise));
        let error = error_after(&model, noise, 0.11, 30);
        assert!(error < noise, "{error}");
    }

    #[test]
    fn the_jacobian_is_that_of_the_projected_rest_where_the_rest_is_small() {
        // Kaufman leaves out what is proportional to the rest, so that on exact paths it is the whole derivative.
        let truth = [Pair { root: 0.1, turn: 0.3 }, Pair { root: 0.2, turn: 0.8 }];
        let basis = columns(&truth, 40);
        let y =
            &basis * &Matrix::from_fn(5, 3, |r, c| (1 + r + 2 * c) as f64 * if (r + c) % 2 == 0 { 1.0 } else { -0.7 });
        let rest = |pairs: &[Pair]| Projection::new(columns(pairs, 40)).rest(&y);
        let found = jacobian(&truth, &Projection::new(basis), &y);
        for (j, found) in found.iter().enumerate() {
            let h = 1e-5;
            let moved = |s: f64| {
                let mut pairs = truth;
                if j % 2 == 0 {
                    pairs[j / 2].root += s
                } else {
                    pairs[j / 2].turn += s
                }
                rest(&pairs)
            };
            let numeric = (&moved(h) - &moved(-h)).scaled(1.0 / (2.0 * h));
            let (off, size) = ((&numeric - found).norm_squared().sqrt(), numeric.norm_squared().sqrt());
            assert!(off < 1e-5 * size, "{j}: {off} of {size}");
        }
    }
}
