//! `native4d`: Gaussians of space and time, sliced at t (Yang et al. 2024, "Real-time 4DGS").
//!
//! A Gaussian has a mean (μ, μ_t), scales in space and time and a rotation of four dimensions, a pair of quaternions: X
//! ↦ l X r̄ (`quats` holds l). Its slice at t is an ordinary Gaussian that moves at constant velocity; its opacity is
//! o·exp(−½(t − μ_t)²/Σ_tt): the model has its own lifespan, which [`Motion::life`] returns. Two equal quaternions
//! rotate only space: the Gaussian is then static. See `slice` for the mathematics, `crate::layers::to_spacetime` for
//! the same motion in another parametrisation.
//!
//! Colour may change with time: block n of the spherical harmonics has the factor cos(2πn(μ_t − t)/T) (the same source,
//! §4.2).

mod slice;
mod sliced;
#[cfg(test)]
mod tests;

use super::lanes::{Batch, Lane, Work, fill, scatter};
use super::{At, Cache, Capabilities, Model, Motion, Slices, Spec, Tape, fill_rows};
use crate::math::{Real, Rng, Sim3, quat};
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, Born, Color, GEOMETRY, Grads, Key, Params, RowEdit, SH, Space, SplatGrads, Table};
use crate::simd::each;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use slice::{Frame, OWN, RIGHT};
use std::f64::consts::TAU;
use std::sync::Arc;

pub(crate) use sliced::Sliced;

/// Most blocks of spherical harmonics beyond the first (Yang et al. 2024 use n = 0, 1, 2).
pub const MAX_HARMONICS: usize = 2;
/// Columns of the model's own table.
pub(crate) const COLUMNS: [(&str, usize); 3] = [("time_means", 1), ("log_time_scales", 1), ("right_quats", 4)];
/// Its name.
pub const TABLE: &str = "native4d";
/// The parts of a split have lifespans shorter by this factor: Kerbl et al. 2023 divide scales by 1.6, Yang et al. 2024
/// all four.
const SPLIT_SHRINK: f64 = 1.6;
/// The shortest lifespan within the number range, seconds.
pub(crate) const SHORTEST: f64 = 1e-6;
/// The longest: a day.
pub(crate) const LONGEST: f64 = 86_400.0;
/// κ is between the inverse of this and this, so that its square is a number in f32.
const FASTEST: f64 = 1e9;

/// The model as plain data.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Native4dSpec {
    /// κ: how many scene units are as far as a second. Rotations mix space with κt, so that a velocity of κ is 45°.
    pub speed: f64,
    /// No Gaussian's lifespan has a smaller standard deviation than this, seconds.
    pub min_life: f64,
    /// No scale in time counts as more than this, seconds.
    pub max_life: f64,
    /// Blocks of spherical harmonics that change with time, 0 to [`MAX_HARMONICS`].
    pub harmonics: usize,
    /// T of those blocks, seconds.
    pub period: f64,
    /// Whether the parts of a split also are apart in time, along the parent's path, and have shorter lifespans.
    pub split_time: bool,
}

impl Default for Native4dSpec {
    /// One unit a second, nearly no bounds, colours that stay.
    fn default() -> Self {
        Self { speed: 1.0, min_life: SHORTEST, max_life: LONGEST, harmonics: 0, period: 1.0, split_time: true }
    }
}

impl Native4dSpec {
    fn check(&self) -> Result<()> {
        let lives = self.min_life >= 0.0 && self.min_life <= self.max_life && self.max_life <= LONGEST;
        let speed = self.speed >= 1.0 / FASTEST && self.speed <= FASTEST;
        let period = self.period >= SHORTEST && self.period <= LONGEST;
        if lives && speed && period && self.harmonics <= MAX_HARMONICS {
            return Ok(());
        }
        Err(Error::input(format!("the numbers of native4d are out of their ranges: {self:?}"))
            .remedy("The file is damaged or was written by another program; export it again"))
    }

    fn frame<F: Real>(&self) -> Frame<F> {
        Frame {
            speed: F::of(self.speed),
            floor: F::of((self.speed * self.min_life.max(SHORTEST)).powi(2)),
            ceiling: F::of(self.max_life.max(SHORTEST).ln()),
        }
    }
}

/// See the module's documentation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Native4d {
    spec: Native4dSpec,
    own: Key,
}

impl Model for Native4dSpec {
    fn build<F: Real>(&self, p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
        Ok(Arc::new(Native4d::new(*self, p)?))
    }

    fn capabilities(&self) -> Capabilities {
        let color_blocks = self.harmonics.min(MAX_HARMONICS) + 1;
        Capabilities { own_life: true, color_blocks, ..Capabilities::default() }
    }
}

/// Gives a Gaussian, which may move, another velocity at the middle of its lifespan, scene units per second: its slice
/// there and its lifespan stay. Panics: the model has not made its table.
pub fn set_velocity(spec: &Native4dSpec, params: &mut Params<f32>, row: usize, velocity: [f64; 3]) {
    let own = params.find(TABLE).expect("the model has made its table");
    let slice = Sliced::of(spec, params, own, row);
    Sliced { velocity, ..slice }.write(spec, params, own, row);
}

impl Native4d {
    /// New Gaussians are static and alive for a second around t = 0. With harmonics, the layer's SH table grows by
    /// their blocks, which start at zero.
    ///
    /// Errors: numbers of the spec out of their ranges; loaded arrays of the wrong shape.
    pub(crate) fn new<F: Real>(spec: Native4dSpec, p: &mut Params<F>) -> Result<Self> {
        spec.check()?;
        let rows = p.len();
        let quats: Vec<[F; 4]> = (0..rows).map(|row| p[GEOMETRY].read(row, crate::scene::params::QUAT)).collect();
        let own = p.entry(TABLE, Space::Gaussians, &COLUMNS, rows, |table| {
            quats.iter().enumerate().for_each(|(row, q)| table.write(row, RIGHT, *q));
        })?;
        widen(p, spec.harmonics + 1)?;
        Ok(Self { spec, own })
    }

    /// Key of the table of `COLUMNS`.
    pub(crate) fn own(&self) -> Key {
        self.own
    }
}

/// Allocates `blocks` blocks of SH coefficients. A table of one block differs from one of several by its width: 1, 4, 9
/// and 16 coefficients are no whole number of blocks of one another, but for one block.
fn widen<F: Real>(p: &mut Params<F>, blocks: usize) -> Result<()> {
    let (rows, width) = (p.len(), p[SH].width());
    let whole = |width: usize| matches!(width, 3 | 12 | 27 | 48);
    if width == 0
        || (blocks > 1 && width.is_multiple_of(blocks) && whole(width / blocks))
        || blocks == 1 && whole(width)
    {
        return Ok(());
    }
    if !whole(width) {
        return Err(Error::input(format!("{width} numbers a colour are no {blocks} blocks of spherical harmonics"))
            .remedy("The file does not fit its own metadata; export it again"));
    }
    let mut wide = Table::new(&[("sh", width * blocks)], rows);
    for row in 0..rows {
        for col in 0..width {
            wide.set(row, col, p[SH].get(row, col));
        }
    }
    p[SH] = wide;
    Ok(())
}

/// Weights of the blocks of colours, [splats, harmonics + 1].
#[derive(Default)]
struct Weights<F>(Table<F>);

/// The columns of [`Weights`], by the number of harmonics.
const WEIGHT_COLUMNS: [[(&str, usize); 1]; MAX_HARMONICS + 1] = [[("weights", 1)], [("weights", 2)], [("weights", 3)]];

impl<F: Real> Motion<F> for Native4d {
    fn spec(&self) -> Spec {
        Spec::Native4d(self.spec)
    }

    /// Q(l X r̄)Q̄ = (Ql) X (Qr)̄: the right quaternion of a rotation of four dimensions rotates as the left one does.
    /// A scale is not supported, since it would change κ.
    fn apply_transform(&self, p: &mut Params<F>, frame: &Sim3) -> bool {
        if frame.scale != 1.0 {
            return false;
        }
        let (table, q) = (&mut p[self.own], quat::from_rotation(&frame.rotation));
        for row in 0..table.rows() {
            table.write(row, RIGHT, quat::rotated(q, table.read(row, RIGHT)));
        }
        true
    }

    fn slices(&self) -> Option<Slices> {
        let Frame { speed, floor, ceiling } = self.spec.frame();
        let Native4dSpec { harmonics, period, .. } = self.spec;
        Some(Slices { own: self.own, speed, floor, ceiling, harmonics, period })
    }

    fn scratch_bytes(&self, _p: &Params<F>, _rows: usize) -> u64 {
        0
    }

    fn at(&self, q: &At<'_, F>, _cache: &Cache, tape: &mut Tape<F>) {
        tape.start(q.len());
        fill(&Forward(Reader::new(self, q)), [&mut tape.out], q.rows);
        if self.spec.harmonics > 0 {
            let weights = &mut tape.own.get_or_default::<Weights<F>>().0;
            if weights.width() != self.spec.harmonics + 1 {
                *weights = Table::new(&WEIGHT_COLUMNS[self.spec.harmonics], 0);
            }
            weights.resize(q.len());
            fill(&Waves(Reader::new(self, q)), [weights], q.rows);
        }
    }

    fn color<'a>(&self, q: &At<'a, F>, tape: &'a Tape<F>) -> Color<'a, F> {
        let weights = tape.own.get::<Weights<F>>().filter(|_| self.spec.harmonics > 0);
        Color::Sh { table: &q.p[SH], rows: q.rows, weights: weights.map(|w| &w.0), base: true }
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
        let reader = Reader::new(self, q);
        let mut d_time = scatter(&Backward { reader, d_out: d_out.out }, d.of([GEOMETRY, self.own]), q.rows);
        if let Some(weights) = d_out.weights.filter(|_| self.spec.harmonics > 0) {
            d_time += scatter(&WavesBackward { reader, weights }, d.of([self.own]), q.rows);
        }
        d_time
    }

    /// The parts of a split are apart in time as a Gaussian of four dimensions does: δt ~ N(0, Σ_tt), and the mean
    /// moves along its path; a split adds what lies across it.
    fn on_edit(&self, p: &mut Params<F>, edit: &RowEdit, rng: &Rng) {
        if edit.space != Space::Gaussians || !self.spec.split_time {
            return;
        }
        for (row, _) in edit.born.iter().enumerate().filter(|(_, b)| **b == Born::Split) {
            let mut g = Sliced::of(&self.spec, p, self.own, row);
            let shift = g.width * rng.fork(row as u64).normal(0);
            g.time += shift;
            for k in 0..3 {
                g.mean[k] += g.velocity[k] * shift;
            }
            g.width /= SPLIT_SHRINK;
            g.write(&self.spec, p, self.own, row);
        }
    }

    /// The slice grows; velocity and lifespan stay.
    fn resize(&self, p: &mut Params<F>, row: usize, factor: f64) {
        let mut g = Sliced::of(&self.spec, p, self.own, row);
        g.cov = g.cov.map(|x| x * factor * factor);
        g.write(&self.spec, p, self.own, row);
    }

    fn life(&self, p: &Params<F>, out: &mut Table<F>) -> bool {
        out.resize(p.len());
        let work = Life { geometry: &p[GEOMETRY], own: &p[self.own], frame: self.spec.frame() };
        fill(&work, [out], crate::scene::Rows::All);
        true
    }

    fn velocity(&self, q: &At<'_, F>, out: &mut Table<F>) {
        *out = Table::new(&[("velocity", 3)], q.len());
        let frame = self.spec.frame::<F>();
        fill_rows(out, q.rows, |id| {
            let slope = slice::slope(&q.p[GEOMETRY].read(id, 0), &q.p[self.own].read(id, 0), &frame);
            slope.map(|x| x * frame.speed)
        });
    }
}

/// One query's parameters, read sixteen rows at a time.
struct Reader<'a, F> {
    geometry: &'a Table<F>,
    own: &'a Table<F>,
    frame: Frame<F>,
    t: F,
    /// 2π/T.
    pace: F,
    harmonics: usize,
}

impl<F: Copy> Clone for Reader<'_, F> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<F: Copy> Copy for Reader<'_, F> {}

impl<'a, F: Real> Reader<'a, F> {
    fn new(model: &Native4d, q: &At<'a, F>) -> Self {
        Self {
            geometry: &q.p[GEOMETRY],
            own: &q.p[model.own],
            frame: model.spec.frame(),
            t: F::of(q.t.0),
            pace: F::of(TAU / model.spec.period),
            harmonics: model.spec.harmonics,
        }
    }

    #[inline(always)]
    fn rows(&self, batch: &Batch) -> ([Lane<F>; 11], [Lane<F>; OWN]) {
        (batch.ids.read(self.geometry, 0), batch.ids.read(self.own, 0))
    }
}

#[inline(always)]
fn lane<F: Real, const W: usize>(lanes: &[Lane<F>; W], l: usize) -> [F; W] {
    each(|c| lanes[c][l])
}

struct Forward<'a, F>(Reader<'a, F>);

impl<F: Real> Work<F, 1> for Forward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let (g, own) = self.0.rows(batch);
        let mut rows = [[F::ZERO; BLOCK]; 10];
        for l in 0..BLOCK {
            let row = slice::slice(&lane(&g, l), &lane(&own, l), self.0.t, &self.0.frame);
            for c in 0..10 {
                rows[c][l] = row[c];
            }
        }
        batch.write(out, 0, &rows);
        0.0
    }
}

struct Backward<'a, F> {
    reader: Reader<'a, F>,
    d_out: &'a Table<F>,
}

impl<F: Real> Work<F, 2> for Backward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_geometry, d_own]: &mut [TableMut<'_, F>; 2]) -> f64 {
        let (g, own) = self.reader.rows(batch);
        let d: [Lane<F>; 10] = batch.at.read(self.d_out, 0);
        let mut rows = [[F::ZERO; BLOCK]; 11];
        let mut own_rows = [[F::ZERO; BLOCK]; OWN];
        let mut d_time = [F::ZERO; BLOCK];
        for l in 0..BLOCK {
            let (row, own_row, time) =
                slice::slice_backward(&lane(&g, l), &lane(&own, l), self.reader.t, &self.reader.frame, &lane(&d, l));
            for c in 0..11 {
                rows[c][l] = row[c];
            }
            for c in 0..OWN {
                own_rows[c][l] = own_row[c];
            }
            d_time[l] = time;
        }
        batch.add(d_geometry, 0, &rows);
        batch.add(d_own, 0, &own_rows);
        batch.sum(d_time)
    }
}

/// Weights cos(2πn(μ_t − t)/T) of the blocks of colours.
struct Waves<'a, F>(Reader<'a, F>);

impl<F: Real> Work<F, 1> for Waves<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let [mean] = batch.ids.read::<F, 1>(self.0.own, 0);
        for n in 0..=self.0.harmonics {
            let pace = F::of(n as f64) * self.0.pace;
            batch.write(out, n, &[each(|l| (pace * (mean[l] - self.0.t)).cos())]);
        }
        0.0
    }
}

struct WavesBackward<'a, F> {
    reader: Reader<'a, F>,
    weights: &'a Table<F>,
}

impl<F: Real> Work<F, 1> for WavesBackward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_own]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let r = &self.reader;
        let [mean] = batch.ids.read::<F, 1>(r.own, 0);
        let mut d_mean = [F::ZERO; BLOCK];
        for n in 1..=r.harmonics {
            let pace = F::of(n as f64) * r.pace;
            let [d] = batch.at.read::<F, 1>(self.weights, n);
            for l in 0..BLOCK {
                d_mean[l] += -pace * (pace * (mean[l] - r.t)).sin() * d[l];
            }
        }
        batch.add(d_own, 0, &[d_mean]);
        -batch.sum(d_mean)
    }
}

/// Centre and log width of the lifespans.
struct Life<'a, F> {
    geometry: &'a Table<F>,
    own: &'a Table<F>,
    frame: Frame<F>,
}

impl<F: Real> Work<F, 1> for Life<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let g: [Lane<F>; 11] = batch.ids.read(self.geometry, 0);
        let own: [Lane<F>; OWN] = batch.ids.read(self.own, 0);
        let unit = F::HALF * (self.frame.speed * self.frame.speed).ln();
        let width = each(|l| F::HALF * slice::variance(&lane(&g, l), &lane(&own, l), &self.frame).lane_ln() - unit);
        batch.write(out, 0, &[own[0], width]);
        0.0
    }
}
