//! One row of a deformation: from a learnable Gaussian and what the network states of it to a splat, and back.

use crate::math::twist::{move_point, move_point_backward};
use crate::math::{Real, quat, sym3};
use crate::motion::lanes::{Batch, Lane, Work};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, Table};
use rayon::prelude::*;

/// Numbers of a Gaussian's geometry.
pub(crate) const GEOMETRY_WIDTH: usize = 11;
/// Outputs a Gaussian of a network without screws: δx 3, δq 4, δs 3.
pub(crate) const HEADS: usize = 10;
/// Numbers per row of the gradient: to the geometry, then to the heads (with a screw: 13).
const D_ROW: usize = GEOMETRY_WIDTH + HEADS + 3;
/// Scales never fall below this, scene units: what is added after the activation may be negative.
const MIN_SCALE: f64 = 1e-6;
/// Units of δx (or v), w, δq and δs: of the half box, radians, of a unit quaternion, of the half box. All
/// weights learn at one rate, and a Gaussian is some hundred times smaller than the box it moves in.
pub(crate) const GAINS: [f64; 4] = [0.25, 1.0, 0.25, 0.01];
/// Rows of a task.
const ROWS: usize = 1024;

/// The box that makes coordinates unit ones, and how positions move in it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bounds<F> {
    /// Centre, scene units.
    pub center: [F; 3],
    /// Half the largest side, scene units.
    pub radius: F,
    /// Whether positions move by a screw.
    pub rigid: bool,
}

impl Bounds<f64> {
    /// Centre and half side of a cube around (almost) all means; the unit cube for no points.
    pub(crate) fn around<F: Real>(geometry: &Table<F>, outside: f64, margin: f64) -> [f64; 4] {
        let n = geometry.rows();
        let mut out = [0.0, 0.0, 0.0, 1.0];
        if n == 0 {
            return out;
        }
        let mut radius = 0.0f64;
        for k in 0..3 {
            let mut values: Vec<f64> = (0..n).map(|i| geometry.get(i, k).f64()).collect();
            values.sort_by(f64::total_cmp);
            let skip = (outside * n as f64) as usize;
            let (low, high) = (values[skip], values[n - 1 - skip]);
            out[k] = 0.5 * (low + high);
            radius = radius.max(0.5 * (high - low));
        }
        if radius > 0.0 && radius.is_finite() {
            out[3] = margin * radius;
        }
        if out.iter().all(|x| x.is_finite()) { out } else { [0.0, 0.0, 0.0, 1.0] }
    }
}

impl<F: Real> Bounds<F> {
    /// x̂
    #[inline(always)]
    pub(crate) fn unit(&self, x: [F; 3]) -> [F; 3] {
        std::array::from_fn(|k| (x[k] - self.center[k]) / self.radius)
    }

    /// Width of dynamic regions a position, and the gains of δq and δs.
    #[inline(always)]
    fn layout(&self) -> (usize, F, F) {
        (if self.rigid { 6 } else { 3 }, F::of(GAINS[2]), F::of(GAINS[3]) * self.radius)
    }

    #[inline(always)]
    fn screw(&self, h: &[F]) -> ([F; 3], [F; 3]) {
        let at = |i: usize, gain: f64| F::of(gain) * h[i];
        ([0, 1, 2].map(|k| at(k, GAINS[1])), [3, 4, 5].map(|k| at(k, GAINS[0])))
    }

    #[inline(always)]
    fn moved(&self, x: [F; 3], h: &[F]) -> [F; 3] {
        if self.rigid {
            let (w, v) = self.screw(h);
            let y = move_point(w, v, self.unit(x));
            return std::array::from_fn(|k| self.center[k] + self.radius * y[k]);
        }
        let gain = F::of(GAINS[0]) * self.radius;
        std::array::from_fn(|k| x[k] + gain * h[k])
    }

    /// The splat of a Gaussian.
    #[inline(always)]
    fn splat(&self, g: &[F; GEOMETRY_WIDTH], h: &[F]) -> [F; 10] {
        let (q, log_s, _) = self.shape(g, h);
        let x = self.moved([g[0], g[1], g[2]], h);
        let c = sym3::from_quat_log_scales(q, log_s);
        [x[0], x[1], x[2], c[0], c[1], c[2], c[3], c[4], c[5], g[OPACITY].sigmoid()]
    }

    /// q_t, ln s_t, and whether s_t is above its bound.
    #[inline(always)]
    fn shape(&self, g: &[F; GEOMETRY_WIDTH], h: &[F]) -> ([F; 4], [F; 3], [bool; 3]) {
        let (first, turn, grow) = self.layout();
        let unit = quat::normalize([g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]]).0;
        let q = [0, 1, 2, 3].map(|k| unit[k] + turn * h[first + k]);
        let least = F::of(MIN_SCALE);
        let (mut log_s, mut free) = ([F::ZERO; 3], [true; 3]);
        for k in 0..3 {
            let s = g[LOG_SCALE + k].exp() + grow * h[first + 4 + k];
            // A NaN is not below: it stays one, so that the trainer's guard finds it.
            let below = s < least;
            free[k] = !below;
            log_s[k] = (if free[k] { s } else { least }).ln();
        }
        (q, log_s, free)
    }

    /// VJP of [`splat`](Self::splat): gradients to the geometry and to the heads.
    #[inline(always)]
    fn splat_backward(&self, g: &[F; GEOMETRY_WIDTH], h: &[F], d: &[F; 10]) -> [F; D_ROW] {
        let (first, turn, grow) = self.layout();
        let mut out = [F::ZERO; D_ROW];
        let (to_g, to_h) = out.split_at_mut(GEOMETRY_WIDTH);
        let d_x = [d[0], d[1], d[2]];
        if self.rigid {
            let (w, v) = self.screw(h);
            let d_y = d_x.map(|d| d * self.radius);
            let (d_w, d_v, d_p) = move_point_backward(w, v, self.unit([g[0], g[1], g[2]]), d_y);
            for k in 0..3 {
                to_h[k] = F::of(GAINS[1]) * d_w[k];
                to_h[3 + k] = F::of(GAINS[0]) * d_v[k];
                to_g[k] = d_p[k] / self.radius;
            }
        } else {
            for k in 0..3 {
                to_g[k] = d_x[k];
                to_h[k] = F::of(GAINS[0]) * self.radius * d_x[k];
            }
        }
        let (q, log_s, free) = self.shape(g, h);
        let d_cov = [0, 1, 2, 3, 4, 5].map(|k| d[COV + k]);
        let (d_q, d_log) = sym3::from_quat_log_scales_backward(q, log_s, d_cov);
        let (unit, norm) = quat::normalize([g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]]);
        let d_quat = quat::normalize_backward(unit, norm, d_q);
        for k in 0..4 {
            to_g[QUAT + k] = d_quat[k];
            to_h[first + k] = turn * d_q[k];
        }
        for k in 0..3 {
            let d_s = if free[k] { d_log[k] / log_s[k].exp() } else { F::ZERO };
            to_g[LOG_SCALE + k] = d_s * g[LOG_SCALE + k].exp();
            to_h[first + 4 + k] = grow * d_s;
        }
        let o = g[OPACITY].sigmoid();
        to_g[OPACITY] = d[SPLAT_OPACITY] * o * (F::ONE - o);
        out
    }
}

/// Splats of a result.
pub(crate) struct Written<'a, F> {
    /// The layer's.
    pub geometry: &'a Table<F>,
    /// [rows, width] of the network.
    pub heads: &'a [F],
    /// Heads a row.
    pub width: usize,
    /// Motion of positions.
    pub bounds: Bounds<F>,
}

impl<F: Real> Work<F, 1> for Written<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let g: [Lane<F>; GEOMETRY_WIDTH] = batch.ids.read(self.geometry, 0);
        let mut lanes = [[F::ZERO; BLOCK]; 10];
        for l in (0..BLOCK).filter(|&l| batch.live[l]) {
            let row = self.bounds.splat(&column(&g, l), &self.heads[batch.at.row(l) * self.width..][..self.width]);
            for c in 0..10 {
                lanes[c][l] = row[c];
            }
        }
        batch.write(out, 0, &lanes);
        0.0
    }
}

/// Gradients of a result's rows, [rows, [`D_ROW`]].
pub(crate) struct Gradient<'a, F> {
    /// The layer's.
    pub geometry: &'a Table<F>,
    /// [rows, width] of the network; none: all zero.
    pub heads: Option<&'a [F]>,
    /// Heads a row.
    pub width: usize,
    /// Motion of positions.
    pub bounds: Bounds<F>,
    /// [rows, 10]
    pub d_out: &'a Table<F>,
}

impl<F: Real> Work<F, 1> for Gradient<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let g: [Lane<F>; GEOMETRY_WIDTH] = batch.ids.read(self.geometry, 0);
        let d: [Lane<F>; 10] = batch.at.read(self.d_out, 0);
        let mut lanes = [[F::ZERO; BLOCK]; D_ROW];
        let none = [F::ZERO; HEADS + 3];
        for l in (0..BLOCK).filter(|&l| batch.live[l]) {
            let heads = self.heads.map_or(&none[..], |h| &h[batch.at.row(l) * self.width..][..self.width]);
            let row = self.bounds.splat_backward(&column(&g, l), heads, &column(&d, l));
            for c in 0..D_ROW {
                lanes[c][l] = row[c];
            }
        }
        batch.write(out, 0, &lanes);
        0.0
    }
}

#[inline(always)]
fn column<F: Real, const W: usize>(lanes: &[Lane<F>; W], l: usize) -> [F; W] {
    let mut out = [F::ZERO; W];
    for c in 0..W {
        out[c] = lanes[c][l];
    }
    out
}

/// Adds compact rows to the layer's geometry.
pub(crate) struct Spread<'a, F>(pub &'a Table<F>);

impl<F: Real> Work<F, 1> for Spread<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_geometry]: &mut [TableMut<'_, F>; 1]) -> f64 {
        batch.add::<F, GEOMETRY_WIDTH>(d_geometry, 0, &batch.at.read(self.0, 0));
        0.0
    }
}

/// Makes rows of the heads' gradients.
pub(crate) struct Gather<'a, F> {
    /// [rows, [`D_ROW`]]
    pub d_rows: &'a Table<F>,
    /// Heads a row.
    pub width: usize,
}

impl<F: Real> Gather<'_, F> {
    /// d_heads [rows, width], overwritten.
    pub(crate) fn run(&self, d_heads: &mut [F]) {
        d_heads.par_chunks_mut(ROWS * self.width).enumerate().for_each(|(c, rows)| {
            for (j, row) in rows.chunks_exact_mut(self.width).enumerate() {
                for (k, x) in row.iter_mut().enumerate() {
                    *x = self.d_rows.get(c * ROWS + j, GEOMETRY_WIDTH + k);
                }
            }
        });
    }
}
