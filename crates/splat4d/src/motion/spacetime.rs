//! `spacetime`: the unified kinematic primitive. Around the centre c of its life (Δ = t − c, seconds) a Gaussian has
//! μ(t) = μ + v₁Δ + v₂Δ² + v₃Δ³ and q(t) = normalize(q + ωΔ).
//!
//! It covers static 3DGS (order 0), FreeTimeGS (order 1, life `GaussHalf`), STG-lite (order 3, rotation rate, life
//! `GaussOne`, detached) and native 4D Gaussians in the Cholesky chart.
//! Source: Li et al. 2024 (STG) §3; Wang et al. 2025 (FreeTimeGS) §3.

use super::still::{activate, activate_backward};
use super::{At, Cache, Motion, Spec, Tape, fill_rows, for_rows};
use crate::Result;
use crate::math::Real;
use crate::scene::params::QUAT;
use crate::scene::{GEOMETRY, Grads, Key, LIFE, Params, Space, SplatGrads, Table};

/// Highest order of the polynomial.
pub const MAX_ORDER: usize = 3;

/// The model as plain data.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpacetimeSpec {
    /// Order of the polynomial in Δ, 0 to [`MAX_ORDER`].
    pub order: usize,
    /// Whether quaternions have a rate.
    pub rotation: bool,
    /// Whether Δ is a constant in position and rotation, so that the life's centre learns from opacity alone (STG).
    pub detach: bool,
    /// Origin of Δ for Gaussians that live for ever: the clip's centre, seconds.
    pub origin: f64,
}

impl Default for SpacetimeSpec {
    /// Order 1, no rotation rate, not detached: FreeTimeGS.
    fn default() -> Self {
        Self { order: 1, rotation: false, detach: false, origin: 0.0 }
    }
}

/// See the module's documentation.
#[derive(Clone, Copy, Debug)]
pub struct Spacetime {
    spec: SpacetimeSpec,
    velocities: Key,
    rates: Key,
}

/// Name of the table of polynomial coefficients, [N, 3·order]: column 3(k−1) + axis, scene units / s^k.
pub const VELOCITIES: &str = "velocities";
/// Name of the table of quaternion rates, [N, 4 or 0], 1/s.
pub const ROTATION_RATES: &str = "rotation_rates";

/// Column layouts by order; entry 0 has no columns.
const VELOCITY_COLUMNS: [&[(&str, usize)]; MAX_ORDER + 1] =
    [&[], &[("velocities", 3)], &[("velocities", 6)], &[("velocities", 9)]];

impl Spacetime {
    /// Makes or claims the model's tables in `p`. Errors: loaded arrays of the wrong shape. Panics: order above 3.
    pub fn new<F: Real>(spec: SpacetimeSpec, p: &mut Params<F>) -> Result<Self> {
        assert!(spec.order <= MAX_ORDER, "the polynomial's order is at most {MAX_ORDER}");
        let rows = p.len();
        let velocities = p.entry(VELOCITIES, Space::Gaussians, VELOCITY_COLUMNS[spec.order], rows, |_| {})?;
        let columns: &[_] = if spec.rotation { &[("rotation_rates", 4)] } else { &[] };
        let rates = p.entry(ROTATION_RATES, Space::Gaussians, columns, rows, |_| {})?;
        Ok(Self { spec, velocities, rates })
    }

    /// Key of the table of polynomial coefficients.
    pub fn velocities(&self) -> Key {
        self.velocities
    }

    /// Key of the table of quaternion rates.
    pub fn rates(&self) -> Key {
        self.rates
    }

    #[inline(always)]
    fn delta<F: Real>(&self, life: &Table<F>, id: usize, t: f64) -> F {
        if life.width() == 0 { F::of(t - self.spec.origin) } else { F::of(t) - life.get(id, 0) }
    }

    /// The learnable row at Δ: mean moved, quaternion turned, all else as it is.
    #[inline(always)]
    fn moved<F: Real>(&self, mut g: [F; 11], v: &Table<F>, w: &Table<F>, id: usize, delta: F) -> [F; 11] {
        let mut power = F::ONE;
        for k in 0..self.spec.order {
            power *= delta;
            let c = v.read::<3>(id, 3 * k);
            for axis in 0..3 {
                g[axis] += c[axis] * power;
            }
        }
        if self.spec.rotation {
            let rate = w.read::<4>(id, 0);
            for i in 0..4 {
                g[QUAT + i] += rate[i] * delta;
            }
        }
        g
    }

    /// dμ/dΔ
    #[inline(always)]
    fn speed<F: Real>(&self, v: &Table<F>, id: usize, delta: F) -> [F; 3] {
        let mut out = [F::ZERO; 3];
        let mut power = F::ONE;
        for k in 0..self.spec.order {
            let c = v.read::<3>(id, 3 * k);
            for axis in 0..3 {
                out[axis] += c[axis] * power * F::of((k + 1) as f64);
            }
            power *= delta;
        }
        out
    }
}

impl<F: Real> Motion<F> for Spacetime {
    fn spec(&self) -> Spec {
        Spec::Spacetime(self.spec)
    }

    fn at(&self, q: &At<'_, F>, _cache: &Cache, tape: &mut Tape<F>) {
        tape.start(q.len());
        let (geometry, life, v, w) = (&q.p[GEOMETRY], &q.p[LIFE], &q.p[self.velocities], &q.p[self.rates]);
        fill_rows(&mut tape.out, q.rows, |id| {
            activate(self.moved(geometry.read::<11>(id, 0), v, w, id, self.delta(life, id, q.t.0)))
        });
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
        let (geometry, life, v, w) = (&q.p[GEOMETRY], &q.p[LIFE], &q.p[self.velocities], &q.p[self.rates]);
        let tables = d.of([GEOMETRY, self.velocities, self.rates, LIFE]);
        for_rows(tables, q.rows, |j, id, [d_geometry, d_v, d_w, d_life]| {
            let delta = self.delta(life, id, q.t.0);
            let moved = self.moved(geometry.read::<11>(id, 0), v, w, id, delta);
            let d_row = activate_backward(moved, d_out.out.read::<10>(j, 0));
            d_geometry.add(id, 0, d_row);
            let speed = self.speed(v, id, delta);
            let mut d_delta = speed[0] * d_row[0] + speed[1] * d_row[1] + speed[2] * d_row[2];
            let mut power = F::ONE;
            for k in 0..self.spec.order {
                power *= delta;
                d_v.add(id, 3 * k, [d_row[0] * power, d_row[1] * power, d_row[2] * power]);
            }
            if self.spec.rotation {
                let rate = w.read::<4>(id, 0);
                let d_quat: [F; 4] = std::array::from_fn(|i| d_row[QUAT + i]);
                d_w.add(id, 0, d_quat.map(|x| x * delta));
                for i in 0..4 {
                    d_delta += rate[i] * d_quat[i];
                }
            }
            if life.width() > 0 && !self.spec.detach {
                d_life.add(id, 0, [-d_delta]);
            }
            d_delta.f64()
        })
    }

    fn velocity(&self, q: &At<'_, F>, out: &mut Table<F>) {
        let (life, v) = (&q.p[LIFE], &q.p[self.velocities]);
        *out = Table::new(&[("velocity", 3)], q.len());
        fill_rows(out, q.rows, |id| self.speed(v, id, self.delta(life, id, q.t.0)));
    }
}
