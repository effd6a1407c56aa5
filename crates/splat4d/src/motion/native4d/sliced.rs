//! A Gaussian of space and time as its slice: mean, covariance, velocity and lifespan, and the backward pass to scales
//! and quaternions. In f64, a row at a time: for edits and for conversions.

use super::Native4dSpec;
use super::slice::{self, LOG_TIME_SCALE, OWN, RIGHT};
use crate::math::{Real, sym3};
use crate::scene::params::{LOG_SCALE, QUAT};
use crate::scene::splats::COV;
use crate::scene::{GEOMETRY, Key, Params};

/// No scale is written smaller than this, scene units: its logarithm must be a number.
const SMALLEST: f64 = 1e-12;
/// Sweeps of the decomposition; convergence is quadratic, six are usual for 4x4.
const SWEEPS: usize = 12;

/// A Gaussian as its slice, in f64.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sliced {
    /// At `time`.
    pub mean: [f64; 3],
    /// Scene units per second.
    pub velocity: [f64; 3],
    /// Of the slice.
    pub cov: [f64; 6],
    /// Middle of the lifespan, seconds.
    pub time: f64,
    /// Standard deviation of the lifespan, seconds.
    pub width: f64,
}

impl Sliced {
    /// A row for rendering: lower and upper bounds applied.
    pub(crate) fn of<F: Real>(spec: &Native4dSpec, p: &Params<F>, own: Key, row: usize) -> Self {
        let g = p[GEOMETRY].read::<11>(row, 0).map(Real::f64);
        let o = p[own].read::<OWN>(row, 0).map(Real::f64);
        let frame = spec.frame();
        let splat = slice::slice(&g, &o, o[0], &frame);
        Self {
            mean: [g[0], g[1], g[2]],
            velocity: slice::slope(&g, &o, &frame).map(|x| x * spec.speed),
            cov: std::array::from_fn(|k| splat[COV + k]),
            time: o[0],
            width: slice::variance(&g, &o, &frame).sqrt() / spec.speed,
        }
    }

    /// Writes the row: the scales and quaternions of Σ₄ = BBᵀ with B = [[√Σ, u c₀], [0, c₀]], u the velocity over κ and
    /// c₀ = κ·width.
    pub(crate) fn write<F: Real>(&self, spec: &Native4dSpec, p: &mut Params<F>, own: Key, row: usize) {
        let (values, axes) = sym3::eigen(self.cov);
        let c0 = spec.speed * self.width;
        let b: [[f64; 4]; 4] = std::array::from_fn(|i| {
            std::array::from_fn(|k| match (i, k) {
                (3, 3) => c0,
                (3, _) => 0.0,
                (_, 3) => self.velocity[i] / spec.speed * c0,
                _ => axes[i][k] * values[k].max(0.0).sqrt(),
            })
        });
        let (scales, rotation) = principal(b);
        let [left, right] = slice::quaternions(rotation);
        let logs = scales.map(|s| s.max(SMALLEST).ln());
        let geometry = &mut p[GEOMETRY];
        geometry.write(row, 0, self.mean.map(F::of));
        geometry.write(row, QUAT, left.map(F::of));
        geometry.write(row, LOG_SCALE, [logs[0], logs[1], logs[2]].map(F::of));
        let table = &mut p[own];
        table.set(row, 0, F::of(self.time));
        table.set(row, LOG_TIME_SCALE, F::of(logs[3] - spec.speed.ln()));
        table.write(row, RIGHT, right.map(F::of));
    }
}

/// Scales and axes (columns, a rotation) of BBᵀ by one-sided Jacobi rotations of B's rows, so that small scales keep
/// their digits next to large ones (Demmel and Veselić 1992). The last axis is the one closest to t, and points
/// forward.
fn principal(b: [[f64; 4]; 4]) -> ([f64; 4], [[f64; 4]; 4]) {
    let mut rows = b;
    // Row i of `turns`: which sum of B's rows `rows[i]` is.
    let mut turns: [[f64; 4]; 4] = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
    let dot = |a: &[f64; 4], b: &[f64; 4]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    for _ in 0..SWEEPS {
        for (i, j) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)] {
            let (ii, jj, ij) = (dot(&rows[i], &rows[i]), dot(&rows[j], &rows[j]), dot(&rows[i], &rows[j]));
            if ij.abs() <= f64::EPSILON * f64::EPSILON.max((ii * jj).sqrt()) || ij == 0.0 {
                continue;
            }
            let theta = (jj - ii) / (2.0 * ij);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            for m in [&mut rows, &mut turns] {
                for k in 0..4 {
                    let (x, y) = (m[i][k], m[j][k]);
                    (m[i][k], m[j][k]) = (c * x - s * y, s * x + c * y);
                }
            }
        }
    }
    let last = (0..4).max_by(|&i, &j| turns[i][3].abs().total_cmp(&turns[j][3].abs())).expect("four axes");
    rows.swap(last, 3);
    turns.swap(last, 3);
    if turns[3][3] < 0.0 {
        turns[3] = turns[3].map(|x| -x);
    }
    if determinant(&turns) < 0.0 {
        turns[0] = turns[0].map(|x| -x);
    }
    let axes = std::array::from_fn(|i| std::array::from_fn(|k| turns[k][i]));
    (std::array::from_fn(|k| dot(&rows[k], &rows[k]).sqrt()), axes)
}

/// det of a 4x4 matrix, by its first row.
pub(super) fn determinant(m: &[[f64; 4]; 4]) -> f64 {
    let minor = |skip: usize| {
        let c: Vec<usize> = (0..4).filter(|&c| c != skip).collect();
        let at = |r: usize, k: usize| m[r][c[k]];
        at(1, 0) * (at(2, 1) * at(3, 2) - at(2, 2) * at(3, 1)) - at(1, 1) * (at(2, 0) * at(3, 2) - at(2, 2) * at(3, 0))
            + at(1, 2) * (at(2, 0) * at(3, 1) - at(2, 1) * at(3, 0))
    };
    m[0][0] * minor(0) - m[0][1] * minor(1) + m[0][2] * minor(2) - m[0][3] * minor(3)
}
