//! `still`: static 3D Gaussian Splatting (Kerbl et al. 2023). The activation of means, quaternions, scales and opacity
//! stands here, for every model that ends in an ordinary Gaussian.

use super::{At, Cache, Motion, Spec, Tape, fill_rows, for_rows};
use crate::math::{Real, sym3};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::{GEOMETRY, Grads, SplatGrads};

/// Nothing moves; dL/dt is zero.
#[derive(Clone, Copy, Debug)]
pub struct Still;

impl<F: Real> Motion<F> for Still {
    fn spec(&self) -> Spec {
        Spec::Still
    }

    fn at(&self, q: &At<'_, F>, _cache: &Cache, tape: &mut Tape<F>) {
        tape.start(q.len());
        let geometry = &q.p[GEOMETRY];
        fill_rows(&mut tape.out, q.rows, |id| activate(geometry.read::<11>(id, 0)));
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
        let geometry = &q.p[GEOMETRY];
        for_rows(d.of([GEOMETRY]), q.rows, |j, id, [d_geometry]| {
            let d_row = activate_backward(geometry.read::<11>(id, 0), d_out.out.read::<10>(j, 0));
            d_geometry.add(id, 0, d_row);
            0.0
        })
    }
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
        std::array::from_fn(|k| d[COV + k]),
    );
    let o = g[OPACITY].sigmoid();
    let d_logit = d[SPLAT_OPACITY] * o * (F::ONE - o);
    [d[0], d[1], d[2], d_quat[0], d_quat[1], d_quat[2], d_quat[3], d_log[0], d_log[1], d_log[2], d_logit]
}
