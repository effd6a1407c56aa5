//! M1: dynamic mode decomposition with delays (Schmid 2010; delays: Arbabi and Mezić 2017), a linear model of all nodes
//! together, stable by construction.
//!
//! Poses of all nodes at a tick are one vector y (positions, and quaternions times a length so that a turn weighs as what it
//! moves). Principal components c keep nearly all of it; d successive ones are a state, which again is reduced to m numbers:
//! w_{t+1} = A w_t by ridge regression. Delays make a single frequency exact from two of them on. In the real Schur form
//! A = Q T Qᵀ every diagonal block with |λ| > 1 is scaled to |λ| = 1: whatever was fitted, rollouts stay bounded.
//! d, m and the ridge are chosen by forecasting the last part of what was observed from the part before.

use crate::paths::{Moment, Paths, Pose};
use nalgebra::{DMatrix, DVector, Schur};
use splat4d::math::quat;

/// Share of the variance that components keep.
const KEPT: f64 = 0.99999;
/// Most components.
const COMPONENTS: usize = 32;
/// Numbers of delays that are tried, and sizes of the state.
const DELAYS: [usize; 4] = [2, 4, 8, 16];
const SIZES: [usize; 9] = [2, 3, 4, 6, 8, 12, 16, 24, 32];
/// Ridges that are tried, of the state's mean square.
const RIDGES: [f64; 4] = [1e-12, 1e-8, 1e-5, 1e-3];
/// Share of the observed ticks that choices are judged on, the last ones; and of the rest, how many ticks a state must have
/// been seen for each of its numbers.
const JUDGED: f64 = 0.2;
const TICKS_A_NUMBER: usize = 2;
/// Iterations of the Schur form: several a row are usual.
const SCHUR_STEPS: usize = 10_000;
/// Squarings by which the spectral radius is bounded where there is no Schur form.
const SQUARINGS: usize = 12;

/// A fitted model.
#[derive(Clone, Debug)]
pub(crate) struct Koopman {
    mean: DVector<f64>,
    /// \[7 nodes, components].
    basis: DMatrix<f64>,
    /// \[d · components, m].
    lift: DMatrix<f64>,
    /// \[m, m].
    pub(crate) step: DMatrix<f64>,
    delays: usize,
    length: f64,
}

/// What is chosen by forecasting.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Choice {
    pub delays: usize,
    pub size: usize,
    pub ridge: f64,
}

impl Koopman {
    /// The model whose choices forecast the last part of the observed ticks best.
    pub(crate) fn fit(paths: &Paths) -> Self {
        let ticks = paths.len();
        let judged = ((JUDGED * ticks as f64).round() as usize).clamp(1, ticks / 2);
        let (early, late) = (paths.first(ticks - judged), &paths.moments[ticks - judged..]);
        let length = length(paths);
        let space = Space::new(&early, length);
        let mut best = (f64::INFINITY, Choice { delays: 2, size: 2, ridge: RIDGES[0] });
        for delays in DELAYS {
            let Some(lifted) = space.lifted(delays) else { continue };
            for size in SIZES.into_iter().filter(|&m| m <= lifted.largest && TICKS_A_NUMBER * m + delays <= early.len())
            {
                for ridge in RIDGES {
                    let choice = Choice { delays, size, ridge };
                    let model = space.model(&lifted, choice);
                    let error = error(&model.rollout(&early, judged), late);
                    if error < best.0 {
                        best = (error, choice);
                    }
                }
            }
        }
        Self::with(paths, best.1)
    }

    /// The model of a choice.
    pub(crate) fn with(paths: &Paths, choice: Choice) -> Self {
        let space = Space::new(paths, length(paths));
        let delays = choice.delays.min(paths.len().saturating_sub(2)).max(1);
        let lifted = space.lifted(delays).expect("two ticks follow each other");
        let size = choice.size.min(lifted.largest);
        space.model(&lifted, Choice { delays, size, ..choice })
    }

    /// The moments after the last of `paths`, which has as many nodes as the model was fitted to.
    pub(crate) fn rollout(&self, paths: &Paths, horizon: usize) -> Vec<Moment> {
        let components = self.basis.ncols();
        let state: Vec<DVector<f64>> = (0..self.delays)
            .map(|i| self.basis.transpose() * (numbers(paths, paths.len() - 1 - i, self.length) - &self.mean))
            .collect();
        let state = DVector::from_fn(self.delays * components, |i, _| state[i / components][i % components]);
        let mut w = self.lift.transpose() * state;
        let shown = |w: &DVector<f64>| &self.basis * (self.lift.rows(0, components) * w) + &self.mean;
        // What the components do not hold of the last moment stays as it is.
        let rest = numbers(paths, paths.len() - 1, self.length) - shown(&w);
        (0..horizon)
            .map(|_| {
                w = &self.step * &w;
                let y = shown(&w) + &rest;
                (0..paths.nodes()).map(|k| pose(&y, k, self.length)).collect()
            })
            .collect()
    }
}

/// Observed ticks as components.
struct Space {
    mean: DVector<f64>,
    basis: DMatrix<f64>,
    /// \[components, ticks].
    seen: DMatrix<f64>,
    length: f64,
}

/// Delayed states, and their own principal directions.
struct Lifted {
    delays: usize,
    directions: DMatrix<f64>,
    /// \[largest, states]: all of them.
    states: DMatrix<f64>,
    largest: usize,
}

impl Space {
    fn new(paths: &Paths, length: f64) -> Self {
        let (ticks, rows) = (paths.len(), 7 * paths.nodes());
        let all: Vec<DVector<f64>> = (0..ticks).map(|t| numbers(paths, t, length)).collect();
        let mean = all.iter().fold(DVector::zeros(rows), |m, y| m + y) / ticks as f64;
        let y = DMatrix::from_fn(rows, ticks, |r, t| all[t][r] - mean[r]);
        let (directions, values) = principal(&y);
        let total: f64 = values.iter().map(|s| s * s).sum();
        let mut kept = 0.0;
        let count = values
            .iter()
            .take_while(|s| {
                let more = kept < KEPT * total;
                kept += **s * **s;
                more
            })
            .count();
        let basis = directions.columns(0, count.clamp(1, COMPONENTS.min(values.len()))).into_owned();
        Self { seen: basis.transpose() * y, mean, basis, length }
    }

    /// States of so many delays; `None` where no two follow each other.
    fn lifted(&self, delays: usize) -> Option<Lifted> {
        let (rows, ticks) = self.seen.shape();
        if ticks < delays + 1 {
            return None;
        }
        let states = ticks - delays + 1;
        let hankel = DMatrix::from_fn(delays * rows, states, |r, s| self.seen[(r % rows, s + delays - 1 - r / rows)]);
        let (directions, values) = principal(&hankel);
        let largest = values.iter().take_while(|s| **s > 1e-9 * values[0]).count().max(1).min(directions.ncols());
        let states = directions.columns(0, largest).transpose() * hankel;
        Some(Lifted { delays, directions, states, largest })
    }

    fn model(&self, lifted: &Lifted, choice: Choice) -> Koopman {
        let (m, n) = (choice.size, lifted.states.ncols());
        let (now, next) = (lifted.states.view((0, 0), (m, n - 1)), lifted.states.view((0, 1), (m, n - 1)));
        let gram = now * now.transpose();
        let ridge = choice.ridge * gram.trace() / m as f64;
        let regular = &gram + DMatrix::identity(m, m) * ridge.max(f64::MIN_POSITIVE);
        let cross = now * next.transpose();
        let step = regular.cholesky().map_or_else(|| DMatrix::identity(m, m), |c| c.solve(&cross).transpose());
        Koopman {
            mean: self.mean.clone(),
            basis: self.basis.clone(),
            lift: lifted.directions.columns(0, m).into_owned(),
            step: stable(step),
            delays: lifted.delays,
            length: self.length,
        }
    }
}

/// Left singular vectors and values, largest first.
fn principal(y: &DMatrix<f64>) -> (DMatrix<f64>, Vec<f64>) {
    // Of the smaller Gram matrix: rows are many (all nodes) or few (components).
    let wide = y.nrows() <= y.ncols();
    let eigen = if wide { y * y.transpose() } else { y.transpose() * y }.symmetric_eigen();
    let mut order: Vec<usize> = (0..eigen.eigenvalues.len()).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let values: Vec<f64> = order.iter().map(|&i| eigen.eigenvalues[i].max(0.0).sqrt()).collect();
    let mut vectors = DMatrix::zeros(y.nrows(), order.len());
    for (to, &from) in order.iter().enumerate() {
        let v = eigen.eigenvectors.column(from);
        let column = if wide { v.into_owned() } else { y * v / values[to].max(f64::MIN_POSITIVE) };
        vectors.set_column(to, &column);
    }
    (vectors, values)
}

/// The matrix with every eigenvalue outside the unit circle moved onto it.
pub(crate) fn stable(a: DMatrix<f64>) -> DMatrix<f64> {
    let n = a.nrows();
    let Some(schur) = Schur::try_new(a.clone(), f64::EPSILON, SCHUR_STEPS) else {
        // ρ ≤ ‖A^k‖^(1/k): shrunk as a whole, which is stable too.
        let mut power = a.clone();
        let mut log_norm = 0.0;
        for i in 1..=SQUARINGS {
            let norm = power.norm().max(f64::MIN_POSITIVE);
            power /= norm;
            log_norm += norm.ln() / f64::powi(2.0, i as i32 - 1);
            power = &power * &power;
        }
        return a / log_norm.exp().max(1.0);
    };
    let (q, mut t) = schur.unpack();
    let mut i = 0;
    while i < n {
        let paired = i + 1 < n && t[(i + 1, i)] != 0.0;
        let size = if paired { 2 } else { 1 };
        let radius = if paired {
            let (half, det) =
                (0.5 * (t[(i, i)] + t[(i + 1, i + 1)]), t[(i, i)] * t[(i + 1, i + 1)] - t[(i, i + 1)] * t[(i + 1, i)]);
            let inner = half * half - det;
            if inner < 0.0 { det.sqrt() } else { half.abs() + inner.sqrt() }
        } else {
            t[(i, i)].abs()
        };
        if radius > 1.0 {
            let mut block = t.view_mut((i, i), (size, size));
            block /= radius;
        }
        i += size;
    }
    &q * t * q.transpose()
}

/// The length of a turn: how far nodes are from their centre.
fn length(paths: &Paths) -> f64 {
    paths.extent()
}

/// A tick as one vector: positions 3, quaternion 4 times `length`, with signs that go on from tick to tick.
fn numbers(paths: &Paths, tick: usize, length: f64) -> DVector<f64> {
    let mut y = DVector::zeros(7 * paths.nodes());
    for k in 0..paths.nodes() {
        let mut sign = 1.0;
        for t in (tick..paths.len() - 1).rev() {
            let (a, b) = (paths.moments[t][k].q, paths.moments[t + 1][k].q);
            if (0..4).map(|i| a[i] * b[i]).sum::<f64>() < 0.0 {
                sign = -sign;
            }
        }
        let p = &paths.moments[tick][k];
        (0..3).for_each(|c| y[7 * k + c] = p.x[c]);
        (0..4).for_each(|c| y[7 * k + 3 + c] = sign * length * p.q[c]);
    }
    y
}

fn pose(y: &DVector<f64>, k: usize, length: f64) -> Pose {
    let q = std::array::from_fn(|c| y[7 * k + 3 + c] / length.max(f64::MIN_POSITIVE));
    Pose { x: std::array::from_fn(|c| y[7 * k + c]), q: quat::normalize(q).0 }
}

/// Sum of squared distances.
fn error(found: &[Moment], truth: &[Moment]) -> f64 {
    let pairs = found.iter().zip(truth).flat_map(|(a, b)| a.iter().zip(b));
    let sum: f64 = pairs.map(|(a, b)| (0..3).map(|c| (a.x[c] - b.x[c]).powi(2)).sum::<f64>()).sum();
    if sum.is_finite() { sum } else { f64::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::se3::{norm, sub};

    fn circle(ticks: usize, delta: f64) -> Paths {
        let point = |t: usize, k: usize| {
            let a = delta * t as f64 + k as f64;
            [2.0 * a.cos() + 1.0, 0.3, 2.0 * a.sin()]
        };
        Paths::of_points(&(0..ticks).map(|t| (0..5).map(|k| point(t, k)).collect()).collect::<Vec<_>>())
    }

    #[test]
    fn eigenvalues_of_a_known_rotation_are_recovered() {
        let delta = std::f64::consts::TAU * 3.0 / 60.0; // whole rounds: the mean is the centre
        let model = Koopman::with(&circle(60, delta), Choice { delays: 2, size: 2, ridge: 0.0 });
        let values = model.step.complex_eigenvalues();
        assert_eq!(values.len(), 2);
        for value in values.iter() {
            assert!((value.norm() - 1.0).abs() < 1e-6 && (value.arg().abs() - delta).abs() < 1e-6, "{value}");
        }
    }

    #[test]
    fn a_circle_goes_on_and_a_thousand_steps_stay_bounded() {
        let (paths, truth) = (circle(60, 0.11), circle(1060, 0.11));
        let out = Koopman::fit(&paths).rollout(&paths, 1000);
        for h in [20, 1000] {
            let error = (0..5).map(|k| norm(sub(out[h - 1][k].x, truth.moments[59 + h][k].x))).fold(0.0, f64::max);
            assert!(error < 1e-4 * h as f64, "{error} after {h}");
        }
        // Something that grows: fitted as it is, its rollout would reach e^50.
        let point = |t: usize| [(0.05 * t as f64).exp(), 0.0, (0.3 * t as f64).sin()];
        let growing = Paths::of_points(&(0..50).map(|t| vec![point(t), point(t + 3)]).collect::<Vec<_>>());
        let out = Koopman::fit(&growing).rollout(&growing, 1000);
        let far = out.iter().flatten().map(|p| norm(p.x)).fold(0.0, f64::max);
        assert!(far < 1e3, "{far}");
    }

    #[test]
    fn eigenvalues_outside_the_circle_go_onto_it_and_others_stay() {
        let a = DMatrix::from_row_slice(3, 3, &[0.9, -0.9, 0.4, 0.9, 0.9, 0.1, 0.0, 0.0, 0.5]);
        let mut sizes: Vec<f64> = stable(a).complex_eigenvalues().iter().map(|v| v.norm()).collect();
        sizes.sort_by(f64::total_cmp);
        assert!((sizes[0] - 0.5).abs() < 1e-12 && (sizes[1] - 1.0).abs() < 1e-12 && (sizes[2] - 1.0).abs() < 1e-12);
    }
}
