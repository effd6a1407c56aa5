//! The same Gaussians in the chart of `spacetime` and back. A Gaussian of space and time is a slice (mean, covariance)
//! that moves at a constant velocity, and a life: exactly a `spacetime` one of order 1 with a `GaussHalf` life.

use super::slice::{self, LOG_TIME_SCALE, OWN, RIGHT};
use super::{LONGEST, Native4d, Native4dSpec, SHORTEST};
use crate::layers::Layer;
use crate::math::{Real, quat, sym3};
use crate::motion::{Motion, Spacetime, SpacetimeSpec, Spec};
use crate::scene::life::{CENTER, LOG_WIDTH};
use crate::scene::params::{LOG_SCALE, QUAT};
use crate::scene::splats::COV;
use crate::scene::{GEOMETRY, Key, LIFE, LifeKind, Params, SH};
use crate::{Error, Result};
use std::f64::consts::FRAC_1_SQRT_2;
use std::sync::Arc;

/// No scale is written smaller than this, scene units: its logarithm must be a number.
const SMALLEST: f64 = 1e-12;
/// Sweeps of the decomposition; convergence is quadratic, six are usual for 4x4.
const SWEEPS: usize = 12;

/// A Gaussian as its slice, in f64.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sliced {
    /// At `time`.
    pub mean: [f64; 3],
    /// Scene units a second.
    pub velocity: [f64; 3],
    /// Of the slice.
    pub cov: [f64; 6],
    /// Middle of the life, seconds.
    pub time: f64,
    /// Standard deviation of the life, seconds.
    pub width: f64,
}

impl Sliced {
    /// A row as it is drawn: floors and ceilings applied.
    pub fn of<F: Real>(spec: &Native4dSpec, p: &Params<F>, own: Key, row: usize) -> Self {
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
    pub fn write<F: Real>(&self, spec: &Native4dSpec, p: &mut Params<F>, own: Key, row: usize) {
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

/// Scales and axes (columns, a rotation) of BBᵀ by one-sided Jacobi rotations of B's rows, so that small scales keep their
/// digits beside large ones (Demmel and Veselić 1992). The last axis is the one closest to t, and points forward.
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

fn cannot(what: &str, remedy: &str) -> Error {
    Error::input(what.to_owned()).remedy(remedy.to_owned())
}

/// A `native4d` layer as a `spacetime` one of order 1 with a `GaussHalf` life: the same picture at every time.
///
/// Errors: the layer moves otherwise; its colours change with time, or it has another life besides its own.
pub fn to_spacetime<F: Real>(layer: &Layer<F>) -> Result<Layer<F>> {
    let Spec::Native4d(spec) = layer.motion.spec() else {
        return Err(cannot("this layer is not of the model native4d", "Give one that is"));
    };
    if spec.harmonics > 0 {
        return Err(cannot(
            "colours that change with time have no place in spacetime",
            "Train with sh_harmonics=0, or bake the scene",
        ));
    }
    if layer.life != LifeKind::Infinite {
        return Err(cannot("this layer has a life besides native4d's own", "Bake the scene"));
    }
    let own = layer.params.find(super::TABLE).expect("a native4d layer has its table");
    let rows = layer.params.len();
    let mut p = Params::<F>::new(rows, layer.params[SH].width() / 3, LifeKind::GaussHalf.columns());
    let motion = Spacetime::new(SpacetimeSpec::default(), &mut p)?;
    p[GEOMETRY] = layer.params[GEOMETRY].clone();
    p[SH] = layer.params[SH].clone();
    for row in 0..rows {
        let g = Sliced::of(&spec, &layer.params, own, row);
        let (q, logs) = sym3::to_quat_log_scales(g.cov, SMALLEST);
        p[GEOMETRY].write(row, QUAT, q.map(F::of));
        p[GEOMETRY].write(row, LOG_SCALE, logs.map(F::of));
        p[motion.velocities()].write(row, 0, g.velocity.map(F::of));
        p[LIFE].set(row, CENTER, F::of(g.time));
        p[LIFE].set(row, LOG_WIDTH, F::of(g.width.ln()));
    }
    Ok(Layer { params: p, motion: Arc::new(motion), life: LifeKind::GaussHalf, ..layer.clone() })
}

/// A `spacetime` layer as a `native4d` one with the given spec (its harmonics start at zero): the same picture at every
/// time, where the lives are within the spec's bounds.
///
/// Errors: the layer moves otherwise, along curves, turns, or its life is no Gaussian; a spec out of its ranges.
pub fn from_spacetime<F: Real>(layer: &Layer<F>, spec: Native4dSpec) -> Result<Layer<F>> {
    let own_spec = match layer.motion.spec() {
        Spec::Spacetime(s) if s.order <= 1 && !s.rotation => s,
        _ => {
            return Err(cannot(
                "only a spacetime layer of motion order 0 or 1 without rotation rates is one of native4d",
                "Train with motion_order=1 and rotation_rate=false",
            ));
        }
    };
    // exp(−u²) is the same life as exp(−½u²) with a width √2 times as large.
    let unit = match layer.life {
        LifeKind::GaussHalf => 1.0,
        LifeKind::GaussOne => FRAC_1_SQRT_2,
        _ => {
            return Err(cannot(
                "only a Gaussian life is one of native4d",
                "Train with life=gauss-half or life=gauss-one",
            ));
        }
    };
    let rows = layer.params.len();
    let mut p = Params::<F>::new(rows, layer.params[SH].width() / 3, &[]);
    p[GEOMETRY] = layer.params[GEOMETRY].clone();
    p[SH] = layer.params[SH].clone();
    let motion = Native4d::new(spec, &mut p)?;
    let velocities = layer.params.find(crate::motion::spacetime::VELOCITIES).filter(|_| own_spec.order == 1);
    for row in 0..rows {
        let g = layer.params[GEOMETRY].read::<11>(row, 0).map(Real::f64);
        let [time, log_width] = layer.params[LIFE].read::<2>(row, 0).map(Real::f64);
        let q = quat::normalize([g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]]).0;
        let sliced = Sliced {
            mean: [g[0], g[1], g[2]],
            velocity: velocities.map_or([0.0; 3], |v| layer.params[v].read::<3>(row, 0).map(Real::f64)),
            cov: sym3::from_quat_log_scales(q, [g[LOG_SCALE], g[LOG_SCALE + 1], g[LOG_SCALE + 2]]),
            time,
            width: (log_width.exp() * unit).clamp(SHORTEST, LONGEST),
        };
        sliced.write(&motion.spec, &mut p, motion.own(), row);
    }
    let life = LifeKind::Infinite;
    Ok(Layer { params: p, motion: Arc::new(motion) as Arc<dyn Motion<F>>, life, ..layer.clone() })
}
