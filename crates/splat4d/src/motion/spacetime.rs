//! `spacetime`: the unified kinematic primitive. Around the centre c of its lifespan (Δ = t − c, seconds) a Gaussian
//! has μ(t) = μ + v₁Δ + v₂Δ² + v₃Δ³ and q(t) = normalize(q + ωΔ).
//!
//! It covers static 3DGS (order 0), FreeTimeGS (order 1, life `GaussHalf`), STG-lite (order 3, rotation rate, life
//! `GaussOne`, detached) and native 4D Gaussians in the Cholesky chart. With [`FeatureSpec`] it is the full STG: a
//! Gaussian has a base colour b (its SH coefficient of degree 0), view features f and time features g, and shows the
//! nine channels [b, f, g·Δ], which the scene's head turns into colour pixel by pixel (`render/head.rs`).
//! Source: Li et al. 2024 (STG) §3; Wang et al. 2025 (FreeTimeGS) §3.

use super::lanes::{Batch, Lane, Work, fill, scatter};
use super::registry::MAX_ORDER;
use super::still::{activate_backward_lanes, activate_lanes};
use super::{At, Cache, Capabilities, Model, Motion, Polynomial, Spec, Tape, fill_rows};
use crate::math::{Real, Sim3, quat, sh};
use crate::scene::head::{BASE, FEATURES, FURTHER};
use crate::scene::params::QUAT;
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, Color, GEOMETRY, Grads, HeadKeys, Key, LIFE, Params, SH, Space, SplatGrads, Table};
use crate::simd::each;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The model as plain data.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpacetimeSpec {
    /// Order of the polynomial in Δ, 0 to `MAX_ORDER`.
    pub order: usize,
    /// Whether quaternions have a rate.
    pub rotation: bool,
    /// Whether Δ is a constant in position and rotation, so that the lifespan's centre learns from opacity alone (STG).
    pub detach: bool,
    /// Origin of Δ for Gaussians that have infinite lifespans: the clip's centre, seconds.
    pub origin: f64,
    /// Features for a head (STG's full model), of which spherical harmonics above degree 0 are no part; none: colours
    /// unchanged.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub features: Option<FeatureSpec>,
}

/// Features next to the base colour, and the head that reads them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FeatureSpec {
    /// Seed of what the head's weights start with.
    pub seed: u64,
}

impl Default for SpacetimeSpec {
    /// Order 1, no rotation rate, not detached: FreeTimeGS.
    fn default() -> Self {
        Self { order: 1, rotation: false, detach: false, origin: 0.0, features: None }
    }
}

impl Model for SpacetimeSpec {
    fn build<F: Real>(&self, p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
        Ok(Arc::new(Spacetime::new(*self, p)?))
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities { rotates: self.rotation, ..Capabilities::default() }
    }
}

/// See the module's documentation.
#[derive(Clone, Copy, Debug)]
pub struct Spacetime {
    spec: SpacetimeSpec,
    velocities: Key,
    rates: Key,
    features: Option<Key>,
}

/// Name of the table of features, [N, 6].
pub const FEATURE_TABLE: &str = "features";
/// View features, 3 columns of [`FEATURE_TABLE`].
pub const VIEW_FEATURES: &str = "view_features";
/// Time features, 3 columns of [`FEATURE_TABLE`], 1/s.
pub const TIME_FEATURES: &str = "time_features";
/// Name of the table of polynomial coefficients, [N, 3·order]: column 3(k−1) + axis, scene units / s^k.
pub const VELOCITIES: &str = "velocities";
/// Name of the table of quaternion rates, [N, 4 or 0], 1/s.
pub const ROTATION_RATES: &str = "rotation_rates";

/// Column layouts by order; entry 0 has no columns.
const VELOCITY_COLUMNS: [&[(&str, usize)]; MAX_ORDER + 1] =
    [&[], &[("velocities", 3)], &[("velocities", 6)], &[("velocities", 9)]];

impl Spacetime {
    /// Makes or claims the model's tables in `p`. Errors: an order above 3, loaded arrays of the wrong shape.
    pub fn new<F: Real>(spec: SpacetimeSpec, p: &mut Params<F>) -> Result<Self> {
        if spec.order > MAX_ORDER {
            return Err(Error::input(format!("motion order {} is not 0 to {MAX_ORDER}", spec.order))
                .remedy("The file is damaged or was written by another program; export it again"));
        }
        let rows = p.len();
        let velocities = p.entry(VELOCITIES, Space::Gaussians, VELOCITY_COLUMNS[spec.order], rows, |_| {})?;
        let columns: &[_] = if spec.rotation { &[("rotation_rates", 4)] } else { &[] };
        let rates = p.entry(ROTATION_RATES, Space::Gaussians, columns, rows, |_| {})?;
        let features = spec.features.map(|f| Self::featured(f, p)).transpose()?;
        Ok(Self { spec, velocities, rates, features })
    }

    /// The table of features, and the head's weights.
    fn featured<F: Real>(spec: FeatureSpec, p: &mut Params<F>) -> Result<Key> {
        if p[SH].width() < BASE {
            return Err(Error::input("a layer with features has no base colours")
                .remedy("The file is damaged or was written by another program; export it again"));
        }
        let columns = [(VIEW_FEATURES, 3), (TIME_FEATURES, 3)];
        let key = p.entry(FEATURE_TABLE, Space::Gaussians, &columns, p.len(), |_| {})?;
        HeadKeys::new(spec.seed, p)?;
        Ok(key)
    }

    /// Key of the table of polynomial coefficients.
    pub fn velocities(&self) -> Key {
        self.velocities
    }

    /// Key of the table of quaternion rates.
    pub fn rates(&self) -> Key {
        self.rates
    }

    /// The same motion on a clock that runs `rate` times as fast: inside it is rate·t + offset. Changes the model's own
    /// tables; lifespans are the layer's.
    pub(crate) fn retimed<F: Real>(&self, rate: f64, offset: f64, p: &mut Params<F>) -> Self {
        let (velocities, rates) = (&mut p[self.velocities], F::of(rate));
        for row in 0..velocities.rows() {
            let mut power = F::ONE;
            for k in 0..self.spec.order {
                power *= rates;
                let v = velocities.read::<3>(row, 3 * k);
                velocities.write(row, 3 * k, v.map(|x| x * power));
            }
        }
        p[self.rates].data_mut().iter_mut().for_each(|x| *x *= rates);
        if let Some(key) = self.features {
            let table = &mut p[key];
            for row in 0..table.rows() {
                let slopes = table.read::<3>(row, 3);
                table.write(row, 3, slopes.map(|x| x * rates));
            }
        }
        Self { spec: SpacetimeSpec { origin: (self.spec.origin - offset) / rate, ..self.spec }, ..*self }
    }

    #[inline(always)]
    fn delta<F: Real>(&self, life: &Table<F>, id: usize, t: f64) -> F {
        if life.width() == 0 { F::of(t - self.spec.origin) } else { F::of(t) - life.get(id, 0) }
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

    fn apply_transform(&self, p: &mut Params<F>, frame: &Sim3) -> bool {
        let table = &mut p[self.velocities];
        for row in 0..table.rows() {
            for k in 0..self.spec.order {
                let v = frame.vector(table.read::<3>(row, 3 * k).map(|x| x.f64()));
                table.write(row, 3 * k, v.map(F::of));
            }
        }
        // q(t) = q + ωΔ is linear, so that a rate rotates as the quaternion does.
        let (table, q) = (&mut p[self.rates], quat::from_rotation(&frame.rotation));
        for row in 0..if self.spec.rotation { table.rows() } else { 0 } {
            let rate = quat::product(q, table.read::<4>(row, 0).map(|x| x.f64()));
            table.write(row, 0, rate.map(F::of));
        }
        true
    }

    fn without_features(&self) -> Option<Arc<dyn Motion<F>>> {
        self.features?;
        let spec = SpacetimeSpec { features: None, ..self.spec };
        // The tables of features are the last ones: the keys of the others stay.
        Some(Arc::new(Self { spec, features: None, ..*self }))
    }

    fn polynomial(&self) -> Option<Polynomial> {
        Some(Polynomial {
            order: self.spec.order,
            velocities: (self.spec.order > 0).then_some(self.velocities),
            rotation_rates: self.spec.rotation.then_some(self.rates),
            origin: self.spec.origin,
            detached: self.spec.detach,
        })
    }

    fn scratch_bytes(&self, _p: &Params<F>, _rows: usize) -> u64 {
        0
    }

    fn at(&self, q: &At<'_, F>, _cache: &Cache, tape: &mut Tape<F>) {
        tape.start(q.len());
        fill(&Forward(Reader::new(self, q)), [&mut tape.out], q.rows);
        if let Some(key) = self.features {
            let Channels(out) = tape.own.get_or_default::<Channels<F>>();
            out.resize(q.len());
            let (reader, features) = (Reader::new(self, q), &q.p[key]);
            fill(&Paint { reader, base: &q.p[SH], features }, [out], q.rows);
        }
    }

    fn color<'a>(&self, q: &At<'a, F>, tape: &'a Tape<F>) -> Color<'a, F> {
        match self.features {
            Some(_) => Color::Direct { table: &tape.own.get::<Channels<F>>().expect("`at` came first").0 },
            None => Color::Sh { table: &q.p[SH], rows: q.rows, weights: None, base: true },
        }
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
        let tables = d.of([GEOMETRY, self.velocities, self.rates, LIFE]);
        let mut d_time = scatter(&Backward { reader: Reader::new(self, q), d_out: d_out.out }, tables, q.rows);
        if let (Some(key), Some(d_color)) = (self.features, d_out.color) {
            let work = PaintBack { reader: Reader::new(self, q), features: &q.p[key], d_color };
            d_time += scatter(&work, d.of([SH, key, LIFE]), q.rows);
        }
        d_time
    }

    fn velocity(&self, q: &At<'_, F>, out: &mut Table<F>) {
        let (life, v) = (&q.p[LIFE], &q.p[self.velocities]);
        *out = Table::new(&[("velocity", 3)], q.len());
        fill_rows(out, q.rows, |id| self.speed(v, id, self.delta(life, id, q.t.0)));
    }
}

/// One query's parameters, read sixteen rows at a time.
struct Reader<'a, F> {
    spec: SpacetimeSpec,
    geometry: &'a Table<F>,
    life: &'a Table<F>,
    v: &'a Table<F>,
    w: &'a Table<F>,
    t: f64,
}

impl<'a, F: Real> Reader<'a, F> {
    fn new(model: &Spacetime, q: &At<'a, F>) -> Self {
        let p = q.p;
        Self {
            spec: model.spec,
            geometry: &p[GEOMETRY],
            life: &p[LIFE],
            v: &p[model.velocities],
            w: &p[model.rates],
            t: q.t.0,
        }
    }

    #[inline(always)]
    fn delta(&self, batch: &Batch) -> Lane<F> {
        if self.life.width() == 0 {
            return [F::of(self.t - self.spec.origin); BLOCK];
        }
        let [center] = batch.ids.read::<F, 1>(self.life, 0);
        each(|l| F::of(self.t) - center[l])
    }

    /// The learnable rows at Δ: means moved, quaternions turned, all else unchanged.
    #[inline(always)]
    fn moved(&self, batch: &Batch, delta: &Lane<F>) -> [Lane<F>; 11] {
        let mut g: [Lane<F>; 11] = batch.ids.read(self.geometry, 0);
        let mut power = [F::ONE; BLOCK];
        for k in 0..self.spec.order {
            let c: [Lane<F>; 3] = batch.ids.read(self.v, 3 * k);
            for l in 0..BLOCK {
                power[l] *= delta[l];
                for axis in 0..3 {
                    g[axis][l] += c[axis][l] * power[l];
                }
            }
        }
        if self.spec.rotation {
            let rate: [Lane<F>; 4] = batch.ids.read(self.w, 0);
            for l in 0..BLOCK {
                for i in 0..4 {
                    g[QUAT + i][l] += rate[i][l] * delta[l];
                }
            }
        }
        g
    }
}

struct Forward<'a, F>(Reader<'a, F>);

impl<F: Real> Work<F, 1> for Forward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let delta = self.0.delta(batch);
        batch.write(out, 0, &activate_lanes(&self.0.moved(batch, &delta)));
        0.0
    }
}

struct Backward<'a, F> {
    reader: Reader<'a, F>,
    d_out: &'a Table<F>,
}

impl<F: Real> Work<F, 4> for Backward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_geometry, d_v, d_w, d_life]: &mut [TableMut<'_, F>; 4]) -> f64 {
        let r = &self.reader;
        let delta = r.delta(batch);
        let d_rows = activate_backward_lanes(&r.moved(batch, &delta), &batch.at.read(self.d_out, 0));
        batch.add(d_geometry, 0, &d_rows);
        let mut d_delta = [F::ZERO; BLOCK];
        let mut power = [F::ONE; BLOCK];
        for k in 0..r.spec.order {
            // d/dΔ of v_k Δ^k is k v_k Δ^(k−1).
            let c: [Lane<F>; 3] = batch.ids.read(r.v, 3 * k);
            let factor = F::of((k + 1) as f64);
            let mut d_c = [[F::ZERO; BLOCK]; 3];
            for l in 0..BLOCK {
                let slope = factor * power[l];
                power[l] *= delta[l];
                for axis in 0..3 {
                    d_delta[l] += c[axis][l] * slope * d_rows[axis][l];
                    d_c[axis][l] = d_rows[axis][l] * power[l];
                }
            }
            batch.add(d_v, 3 * k, &d_c);
        }
        if r.spec.rotation {
            let rate: [Lane<F>; 4] = batch.ids.read(r.w, 0);
            let mut d_rate = [[F::ZERO; BLOCK]; 4];
            for l in 0..BLOCK {
                for i in 0..4 {
                    d_rate[i][l] = d_rows[QUAT + i][l] * delta[l];
                    d_delta[l] += rate[i][l] * d_rows[QUAT + i][l];
                }
            }
            batch.add(d_w, 0, &d_rate);
        }
        if r.life.width() > 0 && !r.spec.detach {
            batch.add(d_life, 0, &[each(|l| -d_delta[l])]);
        }
        batch.sum(d_delta)
    }
}

/// Colour channels of Gaussians, [splats, 9]: base colour, view features, time features times Δ.
#[derive(Debug)]
struct Channels<F>(Table<F>);

impl<F: Real> Default for Channels<F> {
    fn default() -> Self {
        Self(Table::new(&[("channels", FEATURES)], 0))
    }
}

struct Paint<'a, F> {
    reader: Reader<'a, F>,
    base: &'a Table<F>,
    features: &'a Table<F>,
}

impl<F: Real> Work<F, 1> for Paint<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let delta = self.reader.delta(batch);
        let base: [Lane<F>; BASE] = batch.ids.read(self.base, 0);
        let features: [Lane<F>; FURTHER] = batch.ids.read(self.features, 0);
        let mut channels = [[F::ZERO; BLOCK]; FEATURES];
        for k in 0..3 {
            for l in 0..BLOCK {
                channels[k][l] = F::of(sh::C0) * base[k][l] + F::of(sh::COLOR_OFFSET);
                channels[3 + k][l] = features[k][l];
                channels[6 + k][l] = features[3 + k][l] * delta[l];
            }
        }
        batch.write(out, 0, &channels);
        0.0
    }
}

struct PaintBack<'a, F> {
    reader: Reader<'a, F>,
    features: &'a Table<F>,
    d_color: &'a Table<F>,
}

impl<F: Real> Work<F, 3> for PaintBack<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_base, d_features, d_life]: &mut [TableMut<'_, F>; 3]) -> f64 {
        let r = &self.reader;
        let delta = r.delta(batch);
        let d: [Lane<F>; FEATURES] = batch.at.read(self.d_color, 0);
        let time: [Lane<F>; 3] = batch.ids.read(self.features, 3);
        let mut base = [[F::ZERO; BLOCK]; BASE];
        let mut features = [[F::ZERO; BLOCK]; FURTHER];
        let mut d_delta = [F::ZERO; BLOCK];
        for k in 0..3 {
            for l in 0..BLOCK {
                base[k][l] = F::of(sh::C0) * d[k][l];
                features[k][l] = d[3 + k][l];
                features[3 + k][l] = d[6 + k][l] * delta[l];
                d_delta[l] += d[6 + k][l] * time[k][l];
            }
        }
        batch.add(d_base, 0, &base);
        batch.add(d_features, 0, &features);
        if r.life.width() > 0 && !r.spec.detach {
            batch.add(d_life, 0, &[each(|l| -d_delta[l])]);
        }
        batch.sum(d_delta)
    }
}
