//! Lifespans of a layer's Gaussians as loops over lanes: active set, envelope, and backward pass.

use super::ALPHA_MIN;
use crate::math::Real;
use crate::motion::lanes::{Batch, Lane, Work, fill, scatter};
use crate::scene::params::OPACITY;
use crate::scene::splats::SPLAT_OPACITY;
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, LifeKind, Rows, Table, Time};
use crate::simd::{Kernel, Simd, dispatch, each};

/// Rows per task.
const TASK_ROWS: usize = 8192;

/// σ, ∂σ/∂t, ∂σ/∂log width and ∂σ/∂log softness of sixteen rows; columns that the lifespan lacks are not read.
#[inline(always)]
fn eval<F: Real>(kind: LifeKind, columns: &[Lane<F>; 3], t: Time) -> [Lane<F>; 4] {
    // The kind is distinguished outside of the loop over lanes.
    match kind {
        LifeKind::Infinite => eval_lanes(LifeKind::Infinite, columns, t),
        LifeKind::GaussHalf => eval_lanes(LifeKind::GaussHalf, columns, t),
        LifeKind::GaussOne => eval_lanes(LifeKind::GaussOne, columns, t),
        LifeKind::Interval => eval_lanes(LifeKind::Interval, columns, t),
    }
}

#[inline(always)]
fn eval_lanes<F: Real>(kind: LifeKind, columns: &[Lane<F>; 3], t: Time) -> [Lane<F>; 4] {
    let mut out = [[F::ZERO; BLOCK]; 4];
    for l in 0..BLOCK {
        let v = kind.eval([columns[0][l], columns[1][l], columns[2][l]], t);
        (out[0][l], out[1][l], out[2][l], out[3][l]) = (v.sigma, v.d_time, v.d_log_width, v.d_log_softness);
    }
    out
}

/// The lifespan's columns of a batch; those that the table lacks are zero.
#[inline(always)]
fn read_life<F: Real>(batch: &Batch, table: &Table<F>) -> [Lane<F>; 3] {
    match table.width() {
        0 => [[F::ZERO; BLOCK]; 3],
        2 => {
            let [c, w] = batch.ids.read::<F, 2>(table, 0);
            [c, w, [F::ZERO; BLOCK]]
        }
        _ => batch.ids.read(table, 0),
    }
}

/// The rows that are alive at t into `ids`, strictly increasing.
pub(super) fn active<F: Real>(geometry: &Table<F>, life: &Table<F>, kind: LifeKind, t: Time, ids: &mut Vec<u32>) {
    ids.resize(life.rows(), 0);
    let simd = Simd::detect();
    let count = find(&Alive { geometry, life, kind, t }, 0, ids, simd);
    ids.truncate(count);
}

/// Fills the front of `ids`, which has an entry for every row from `first` on; returns how many are alive.
fn find<F: Real>(alive: &Alive<'_, F>, first: usize, ids: &mut [u32], simd: Simd) -> usize {
    if ids.len() <= TASK_ROWS {
        return dispatch(simd, Find { alive, first, ids });
    }
    let mid = (ids.len() / 2).next_multiple_of(BLOCK);
    let (left, right) = ids.split_at_mut(mid);
    let (a, b) = rayon::join(|| find(alive, first, left, simd), || find(alive, first + mid, right, simd));
    ids.copy_within(mid..mid + b, a);
    a + b
}

struct Alive<'a, F> {
    geometry: &'a Table<F>,
    life: &'a Table<F>,
    kind: LifeKind,
    t: Time,
}

struct Find<'a, F> {
    alive: &'a Alive<'a, F>,
    first: usize,
    ids: &'a mut [u32],
}

impl<F: Real> Kernel for Find<'_, F> {
    type Out = usize;
    #[inline(always)]
    fn run<const FMA: bool>(self) -> usize {
        let Alive { geometry, life, kind, t } = *self.alive;
        // σ ≥ α_min needs u² ≤ 2 ln 255 (an interval: beyond its ends), which keeps out whatever overflows.
        let widest = F::of((2.0 * -ALPHA_MIN.ln()).sqrt());
        let (now, least) = (F::of(t.0), F::of(ALPHA_MIN));
        let mut count = 0;
        for from in (0..self.ids.len()).step_by(BLOCK) {
            let b = (self.first + from) / BLOCK;
            let block = life.block(b);
            let lane = |table: &[F], c: usize| -> Lane<F> { *table[c * BLOCK..].first_chunk().expect("a column") };
            let third = if life.width() > 2 { lane(block, 2) } else { [F::ZERO; BLOCK] };
            let columns = [lane(block, 0), lane(block, 1), third];
            let opacity = lane(geometry.block(b), OPACITY);
            let [sigma, ..] = eval(kind, &columns, t);
            let mut keep = [false; BLOCK];
            for l in 0..BLOCK {
                let softness = if kind == LifeKind::Interval { columns[2][l].exp() } else { F::ONE };
                let width = columns[1][l].exp();
                let reach = if kind == LifeKind::Interval { width + softness * widest } else { width * widest };
                // Phrased so that a NaN is kept and found by the trainer's guard, not hidden.
                let far = (now - columns[0][l]).abs() > reach;
                let faint = opacity[l].sigmoid() * sigma[l] < least;
                keep[l] = !(far | faint);
            }
            for (l, &keep) in keep.iter().enumerate().take(self.ids.len() - from) {
                self.ids[count] = (self.first + from + l) as u32;
                count += usize::from(keep);
            }
        }
        count
    }
}

/// Multiplies the opacity of `out` by the lifespan and fills `life`: [splats, 5], σ, its derivatives, the model's
/// opacity.
pub(super) fn forward<F: Real>(
    p: &Table<F>,
    kind: LifeKind,
    t: Time,
    rows: Rows<'_>,
    out: &mut Table<F>,
    life: &mut Table<F>,
) {
    fill(&Forward { p, kind, t }, [out, life], rows);
}

struct Forward<'a, F> {
    p: &'a Table<F>,
    kind: LifeKind,
    t: Time,
}

impl<F: Real> Work<F, 2> for Forward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out, life]: &mut [TableMut<'_, F>; 2]) -> f64 {
        let value = eval(self.kind, &read_life(batch, self.p), self.t);
        let [opacity] = batch.lanes(out, SPLAT_OPACITY);
        let [sigma, by_time, by_width, by_softness] = value;
        batch.write(life, 0, &[sigma, by_time, by_width, by_softness, opacity]);
        batch.write(out, SPLAT_OPACITY, &[each(|l| opacity[l] * value[0][l])]);
        0.0
    }
}

/// `d_motion` becomes `d_out` with the opacity's gradient times σ: the layer's opacity is o·σ, the model's is o.
pub(super) fn to_motion<F: Real>(d_out: &Table<F>, life: &Table<F>, d_motion: &mut Table<F>) {
    if d_motion.width() == d_out.width() {
        d_motion.resize(d_out.rows());
    } else {
        *d_motion = d_out.zeros_like();
    }
    fill(&ToMotion { d_out, life }, [d_motion], Rows::All);
}

struct ToMotion<'a, F> {
    d_out: &'a Table<F>,
    life: &'a Table<F>,
}

impl<F: Real> Work<F, 1> for ToMotion<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_motion]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let mut rows: [Lane<F>; SPLAT_OPACITY + 1] = batch.at.read(self.d_out, 0);
        let [sigma] = batch.at.read::<F, 1>(self.life, 0);
        for l in 0..BLOCK {
            rows[SPLAT_OPACITY][l] *= sigma[l];
        }
        batch.write(d_motion, 0, &rows);
        0.0
    }
}

/// Adds dL/dσ = o·dL/d(o·σ) times σ's derivatives to the lifespan's gradient `d_life`; returns dL/dt. o is the model's
/// opacity, which need not be the learnt one alone.
pub(super) fn backward<F: Real>(rows: Rows<'_>, d_out: &Table<F>, life: &Table<F>, d_life: &mut Table<F>) -> f64 {
    scatter(&Backward { d_out, life }, [d_life], rows)
}

struct Backward<'a, F> {
    d_out: &'a Table<F>,
    life: &'a Table<F>,
}

impl<F: Real> Work<F, 1> for Backward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_life]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let [d_opacity] = batch.at.read::<F, 1>(self.d_out, SPLAT_OPACITY);
        let [_, by_time, by_width, by_softness, opacity] = batch.at.read::<F, 5>(self.life, 0);
        let mut d = [[F::ZERO; BLOCK]; 3];
        let mut d_time = [F::ZERO; BLOCK];
        for l in 0..BLOCK {
            let g = d_opacity[l] * opacity[l];
            d_time[l] = g * by_time[l];
            (d[0][l], d[1][l], d[2][l]) = (-d_time[l], g * by_width[l], g * by_softness[l]);
        }
        match d_life.width {
            3 => batch.add(d_life, 0, &d),
            _ => batch.add(d_life, 0, &[d[0], d[1]]),
        }
        batch.sum(d_time)
    }
}
