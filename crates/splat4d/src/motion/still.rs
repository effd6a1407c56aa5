//! `still`: static 3D Gaussian Splatting (Kerbl et al. 2023). The activation of means, quaternions, scales and opacity
//! is here, for every model that ends in an ordinary Gaussian.

use super::lanes::{Batch, Lane, Work, fill, scatter};
use super::{At, Cache, Capabilities, Model, Motion, Polynomial, Spec, Tape};
use crate::Result;
use crate::math::{Real, Sim3, sym3};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, GEOMETRY, Grads, Params, SplatGrads, Table};
use crate::simd::each;
use std::sync::Arc;

/// Nothing moves; dL/dt is zero.
#[derive(Clone, Copy, Debug)]
pub struct Still;

impl Model for Still {
    fn build<F: Real>(&self, _p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
        Ok(Arc::new(Still))
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities { moves: false, rotates: false, causal: true, ..Capabilities::default() }
    }
}

impl<F: Real> Motion<F> for Still {
    fn spec(&self) -> Spec {
        Spec::Still
    }

    fn apply_transform(&self, _p: &mut Params<F>, _frame: &Sim3) -> bool {
        true
    }

    fn polynomial(&self) -> Option<Polynomial> {
        Some(Polynomial { order: 0, velocities: None, rotation_rates: None, origin: 0.0, detached: false })
    }

    fn scratch_bytes(&self, _p: &Params<F>, _rows: usize) -> u64 {
        0
    }

    fn at(&self, q: &At<'_, F>, _cache: &Cache, tape: &mut Tape<F>) {
        tape.start(q.len());
        fill(&Forward(&q.p[GEOMETRY]), [&mut tape.out], q.rows);
    }

    fn backward(
        &self,
        q: &At<'_, F>,
        _cache: &Cache,
        _tape: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        _d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        scatter(&Backward { geometry: &q.p[GEOMETRY], d_out: d_out.out }, d.of([GEOMETRY]), q.rows)
    }
}

struct Forward<'a, F>(&'a Table<F>);

impl<F: Real> Work<F, 1> for Forward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, F>; 1]) -> f64 {
        batch.write(out, 0, &activate_lanes(&batch.ids.read(self.0, 0)));
        0.0
    }
}

struct Backward<'a, F> {
    geometry: &'a Table<F>,
    d_out: &'a Table<F>,
}

impl<F: Real> Work<F, 1> for Backward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_geometry]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let rows = activate_backward_lanes(&batch.ids.read(self.geometry, 0), &batch.at.read(self.d_out, 0));
        batch.add(d_geometry, 0, &rows);
        0.0
    }
}

/// [`activate`] of sixteen rows.
#[inline(always)]
pub(crate) fn activate_lanes<F: Real>(g: &[Lane<F>; 11]) -> [Lane<F>; 10] {
    let mut out = [[F::ZERO; BLOCK]; 10];
    for l in 0..BLOCK {
        let row = activate(each(|c| g[c][l]));
        for c in 0..10 {
            out[c][l] = row[c];
        }
    }
    out
}

/// [`activate_backward`] of sixteen rows.
#[inline(always)]
pub(crate) fn activate_backward_lanes<F: Real>(g: &[Lane<F>; 11], d: &[Lane<F>; 10]) -> [Lane<F>; 11] {
    let mut out = [[F::ZERO; BLOCK]; 11];
    for l in 0..BLOCK {
        let row = activate_backward(each(|c| g[c][l]), each(|c| d[c][l]));
        for c in 0..11 {
            out[c][l] = row[c];
        }
    }
    out
}

/// A learnable row (mean 3, raw quaternion 4, log scales 3, opacity logit) as a splat (mean 3, covariance 6, opacity).
#[inline(always)]
pub fn activate<F: Real>(g: [F; 11]) -> [F; 10] {
    let cov = sym3::from_quat_log_scales(
        [g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]],
        [g[LOG_SCALE], g[LOG_SCALE + 1], g[LOG_SCALE + 2]],
    );
    [g[0], g[1], g[2], cov[0], cov[1], cov[2], cov[3], cov[4], cov[5], g[OPACITY].sigmoid()]
}

/// VJP of [`activate`].
#[inline(always)]
pub fn activate_backward<F: Real>(g: [F; 11], d: [F; 10]) -> [F; 11] {
    let (d_quat, d_log) = sym3::from_quat_log_scales_backward(
        [g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]],
        [g[LOG_SCALE], g[LOG_SCALE + 1], g[LOG_SCALE + 2]],
        each(|k| d[COV + k]),
    );
    let o = g[OPACITY].sigmoid();
    let d_logit = d[SPLAT_OPACITY] * o * (F::ONE - o);
    [d[0], d[1], d[2], d_quat[0], d_quat[1], d_quat[2], d_quat[3], d_log[0], d_log[1], d_log[2], d_logit]
}
