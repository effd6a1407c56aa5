//! Gaussians for the dialects' tests, and how far two sets of them are apart.

use super::bytes::SH_C0;
use crate::math::{Rng, quat};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Params, SH};

/// Gaussians as a training leaves them: positions within some units, small scales, colours mostly inside 0..1.
pub(super) fn gaussians(rows: usize, coefficients: usize) -> Params {
    let mut p = Params::new(rows, coefficients, &[]);
    let rng = Rng::new(12, "dialects", 0);
    for row in 0..rows {
        let r = rng.fork(row as u64);
        let n = |i: u64| r.normal(i) as f32;
        p[GEOMETRY].write(row, 0, [2.0 * n(0), 3.0 * n(1), n(2)]);
        p[GEOMETRY].write(row, QUAT, [n(3), n(4), n(5), n(6)].map(|x| 1.7 * x));
        p[GEOMETRY].write(row, LOG_SCALE, [n(7) - 4.0, n(8) - 4.0, n(9) - 5.0]);
        p[GEOMETRY].set(row, OPACITY, 2.0 * n(10));
        for k in 0..3 * coefficients {
            let size = if k < 3 { 0.8 } else { 0.15 };
            p[SH].set(row, k, size * n(20 + k as u64));
        }
    }
    p
}

/// Largest differences between two sets, row by row.
#[derive(Debug, Default)]
pub(super) struct Worst {
    /// Scene units, a coordinate.
    pub(super) mean: f32,
    /// Half the angle between the rotations, radians.
    pub(super) turn: f32,
    pub(super) log_scale: f32,
    /// Activated, 0 to 1.
    pub(super) opacity: f32,
    /// Base colour's coefficient, where the colour is within 0..1.
    pub(super) dc_inside: f32,
    /// Base colour's coefficient, anywhere.
    pub(super) dc: f32,
    /// Other coefficients both have.
    pub(super) sh: f32,
}

pub(super) fn worst(a: &Params, b: &Params) -> Worst {
    assert_eq!(a.len(), b.len(), "both sets must have as many rows");
    let mut w = Worst::default();
    let (ga, gb, sa, sb) = (&a[GEOMETRY], &b[GEOMETRY], &a[SH], &b[SH]);
    for row in 0..a.len() {
        for k in 0..3 {
            w.mean = w.mean.max((ga.get(row, k) - gb.get(row, k)).abs());
            w.log_scale = w.log_scale.max((ga.get(row, LOG_SCALE + k) - gb.get(row, LOG_SCALE + k)).abs());
        }
        let unit = |t: &crate::scene::Table| quat::normalize(t.read::<4>(row, QUAT).map(f64::from)).0;
        let (p, q) = (unit(ga), unit(gb));
        // |p − q| of unit quaternions with one sign is twice the sine of a quarter of the turn between them.
        let sign = if (0..4).map(|k| p[k] * q[k]).sum::<f64>() < 0.0 { -1.0 } else { 1.0 };
        let apart = (0..4).map(|k| (p[k] - sign * q[k]).powi(2)).sum::<f64>().sqrt();
        w.turn = w.turn.max(2.0 * (apart / 2.0).asin() as f32);
        let activated = |x: f32| 1.0 / (1.0 + (-x).exp());
        w.opacity = w.opacity.max((activated(ga.get(row, OPACITY)) - activated(gb.get(row, OPACITY))).abs());
        for k in 0..sa.width().min(sb.width()) {
            let apart = (sa.get(row, k) - sb.get(row, k)).abs();
            if k >= 3 {
                w.sh = w.sh.max(apart);
                continue;
            }
            w.dc = w.dc.max(apart);
            if (0.0..=1.0).contains(&(0.5 + SH_C0 * sa.get(row, k))) {
                w.dc_inside = w.dc_inside.max(apart);
            }
        }
    }
    w
}
