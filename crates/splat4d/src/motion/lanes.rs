//! Sixteen rows at a time: how models whose rows do not see one another become loops over lanes, which vectorise.
//!
//! A [`Work`] gets a [`Batch`] of rows, reads its columns as [`Lane`]s, and writes lanes back. [`fill`] walks the rows
//! of a result (compact), [`scatter`] the rows of the layer's own tables. Both run at the best SIMD level of the
//! machine; since nothing here uses fused multiply-add, every level gives the same bits.

use crate::math::Real;
use crate::scene::table::{TableMut, par_split};
use crate::scene::{BLOCK, Rows, Table};
use crate::simd::{Kernel, Simd, dispatch, each, total};

/// One number of sixteen rows.
pub(crate) type Lane<F> = [F; BLOCK];

/// Layout of a batch's rows in a table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Lie {
    /// They are one block.
    Block,
    /// They follow one another over the border of two blocks.
    Run,
    /// Anything else.
    Scattered,
}

/// Sixteen rows of a table, in increasing order; the last ones may be one row several times.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Span {
    rows: [u32; BLOCK],
    lie: Lie,
}

impl Span {
    fn block(b: usize) -> Self {
        Self { rows: each(|l| (b * BLOCK + l) as u32), lie: Lie::Block }
    }

    fn of(rows: [u32; BLOCK]) -> Self {
        // Increasing numbers that end 15 above their start leave none out, unless the last one is there repeatedly.
        let [first, last] = [rows[0], rows[BLOCK - 1]];
        let dense = last - first == BLOCK as u32 - 1 && rows[BLOCK - 2] < last;
        let lie = match (dense, first as usize % BLOCK) {
            (true, 0) => Lie::Block,
            (true, _) => Lie::Run,
            _ => Lie::Scattered,
        };
        Self { rows, lie }
    }

    /// The row of a lane.
    #[inline(always)]
    pub(crate) fn row(&self, lane: usize) -> usize {
        self.rows[lane] as usize
    }

    /// `W` neighbouring columns of the rows.
    #[inline(always)]
    pub(crate) fn read<F: Real, const W: usize>(&self, table: &Table<F>, col: usize) -> [Lane<F>; W] {
        let mut out = [[F::ZERO; BLOCK]; W];
        let (data, width) = (table.data(), table.width());
        match self.lie {
            Lie::Block => {
                let from = (self.row(0) / BLOCK * width + col) * BLOCK;
                for (out, lane) in out.iter_mut().zip(data[from..from + W * BLOCK].as_chunks().0) {
                    *out = *lane;
                }
            }
            Lie::Run => {
                // The first rows are the end of one block's column, the others the start of the next block's.
                let skip = self.row(0) % BLOCK;
                let from = (self.row(0) / BLOCK * width + col) * BLOCK + skip;
                let ends = &data[from..from + W * BLOCK];
                let from = from + (width - 1) * BLOCK;
                let starts = &data[from..from + W * BLOCK];
                for c in 0..W {
                    let ends: &Lane<F> = ends[c * BLOCK..].first_chunk().expect("as many lanes as columns");
                    let starts: &Lane<F> = starts[c * BLOCK..].first_chunk().expect("as many lanes as columns");
                    for l in 0..BLOCK {
                        out[c][l] = if l + skip < BLOCK { ends[l] } else { starts[l] };
                    }
                }
            }
            Lie::Scattered => {
                for l in 0..BLOCK {
                    let row = table.read::<W>(self.row(l), col);
                    for c in 0..W {
                        out[c][l] = row[c];
                    }
                }
            }
        }
        out
    }
}

/// Sixteen rows that are worked on together.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Batch {
    /// Rows of the layer's tables.
    pub ids: Span,
    /// Rows of the compact result.
    pub at: Span,
    /// Which lanes count; the others hold numbers that mean nothing.
    pub live: [bool; BLOCK],
    full: bool,
}

impl Batch {
    #[inline(always)]
    fn new(ids: Span, at: Span, live: [bool; BLOCK]) -> Self {
        Self { ids, at, live, full: live.iter().fold(true, |all, &one| all & one) }
    }

    /// The sum of the live lanes, as a tree.
    #[inline(always)]
    pub(crate) fn sum<F: Real>(&self, lane: Lane<F>) -> f64 {
        total(each(|l| if self.live[l] { lane[l].f64() } else { 0.0 }))
    }

    /// Writes neighbouring columns of one block of a result; only [`fill`] has whole blocks.
    #[inline(always)]
    pub(crate) fn write<F: Real, const W: usize>(&self, view: &mut TableMut<'_, F>, col: usize, values: &[Lane<F>; W]) {
        let from = self.place(view, self.at, col);
        view.data[from..from + W * BLOCK].copy_from_slice(values.as_flattened());
    }

    /// Neighbouring columns of one block of a result, with their present values.
    #[inline(always)]
    pub(crate) fn lanes<F: Real, const W: usize>(&self, view: &TableMut<'_, F>, col: usize) -> [Lane<F>; W] {
        let from = self.place(view, self.at, col);
        let lanes = view.data[from..from + W * BLOCK].as_chunks().0;
        {
            let mut out = [[F::ZERO; BLOCK]; W];
            out.copy_from_slice(&lanes[..W]);
            out
        }
    }

    /// Adds to neighbouring columns of the live rows of one of the layer's tables.
    #[inline(always)]
    pub(crate) fn add<F: Real, const W: usize>(&self, view: &mut TableMut<'_, F>, col: usize, values: &[Lane<F>; W]) {
        if self.ids.lie != Lie::Block {
            for l in (0..BLOCK).filter(|&l| self.live[l]) {
                view.add::<W>(self.ids.row(l), col, each(|c| values[c][l]));
            }
            return;
        }
        let from = self.place(view, self.ids, col);
        let old: &mut [F] = &mut view.data[from..from + W * BLOCK];
        for (old, new) in old.as_chunks_mut::<BLOCK>().0.iter_mut().zip(values) {
            for l in 0..BLOCK {
                let next = old[l] + new[l];
                old[l] = if self.full || self.live[l] { next } else { old[l] };
            }
        }
    }

    #[inline(always)]
    fn place<F>(&self, view: &TableMut<'_, F>, span: Span, col: usize) -> usize {
        assert!(span.lie == Lie::Block, "only whole blocks have a place of their own");
        ((span.row(0) - view.first) / BLOCK * view.width + col) * BLOCK
    }
}

/// Work on a batch of rows. `run` must be `#[inline(always)]`, or it would be compiled for one SIMD level only.
pub(crate) trait Work<F: Real, const N: usize>: Sync {
    /// Reads rows, and writes or adds to the tables' views; returns whatever is to be summed.
    fn run(&self, batch: &Batch, tables: &mut [TableMut<'_, F>; N]) -> f64;
}

/// Does `work` for every row of a result, whose tables these are; all 16 rows of a block are written, also those past
/// the last row, which mean nothing.
pub(crate) fn fill<F: Real, const N: usize>(work: &impl Work<F, N>, tables: [&mut Table<F>; N], rows: Rows<'_>) {
    let simd = Simd::detect();
    par_split(tables.map(Table::view_mut), &|views| dispatch(simd, Fill { work, views, rows }));
}

/// Does `work` for the requested rows of a layer's tables; returns the sum of what it returns, in a fixed order.
pub(crate) fn scatter<F: Real, const N: usize>(
    work: &impl Work<F, N>,
    tables: [&mut Table<F>; N],
    rows: Rows<'_>,
) -> f64 {
    let simd = Simd::detect();
    par_split(tables.map(Table::view_mut), &|views| dispatch(simd, Scatter { work, views, rows }))
}

struct Fill<'a, F, W, const N: usize> {
    work: &'a W,
    views: [TableMut<'a, F>; N],
    rows: Rows<'a>,
}

impl<F: Real, W: Work<F, N>, const N: usize> Kernel for Fill<'_, F, W, N> {
    type Out = f64;
    #[inline(always)]
    fn run<const FMA: bool>(mut self) -> f64 {
        let (first, blocks) = (self.views[0].first, self.views[0].blocks());
        let end = first + self.views[0].rows;
        for b in first / BLOCK..first / BLOCK + blocks {
            let at = Span::block(b);
            let last = end - 1;
            let ids = match self.rows {
                Rows::All => at,
                Rows::Some(ids) => Span::of(each(|l| ids[at.row(l).min(last)])),
            };
            let batch = Batch::new(ids, at, each(|l| at.row(l) < end));
            self.work.run(&batch, &mut self.views);
        }
        0.0
    }
}

/// If at least one row in this many of a run of rows takes part, whole blocks are worked on, idle lanes included.
const DENSE: usize = 4;

struct Scatter<'a, F, W, const N: usize> {
    work: &'a W,
    views: [TableMut<'a, F>; N],
    rows: Rows<'a>,
}

impl<F: Real, W: Work<F, N>, const N: usize> Kernel for Scatter<'_, F, W, N> {
    type Out = f64;
    #[inline(always)]
    fn run<const FMA: bool>(mut self) -> f64 {
        let (first, end) = (self.views[0].first, self.views[0].first + self.views[0].rows);
        let mut sum = 0.0;
        for batch in Batches::new(self.rows, first, end) {
            sum += self.work.run(&batch, &mut self.views);
        }
        sum
    }
}

/// All batches of the requested rows among `first..end`, where `first` is that of a block. An iterator, since a closure
/// would be compiled separately and for the baseline only.
pub(crate) struct Batches<'a> {
    rows: Rows<'a>,
    /// The next block, or position in the list of rows; and the end of these.
    next: usize,
    to: usize,
    end: usize,
    dense: bool,
}

impl<'a> Batches<'a> {
    /// Panics: a row that is requested does not exist, when its batch is read.
    #[inline(always)]
    pub(crate) fn new(rows: Rows<'a>, first: usize, end: usize) -> Self {
        let (next, to) = match rows {
            Rows::All => (first / BLOCK, end.div_ceil(BLOCK)),
            Rows::Some(ids) => {
                (ids.partition_point(|&i| (i as usize) < first), ids.partition_point(|&i| (i as usize) < end))
            }
        };
        Self { rows, next, to, end, dense: (to - next) * DENSE >= end - first }
    }
}

impl Iterator for Batches<'_> {
    type Item = Batch;

    #[inline(always)]
    fn next(&mut self) -> Option<Batch> {
        if self.next >= self.to {
            return None;
        }
        Some(match self.rows {
            Rows::All => {
                let span = Span::block(self.next);
                self.next += 1;
                Batch::new(span, span, each(|l| span.row(l) < self.end))
            }
            Rows::Some(ids) if self.dense => block_batch(&ids[..self.to], &mut self.next),
            Rows::Some(ids) => loose_batch(&ids[..self.to], &mut self.next),
        })
    }
}

/// The block of the layer's rows that holds `ids[*j]`; `j` moves past those in it.
#[inline(always)]
fn block_batch(ids: &[u32], j: &mut usize) -> Batch {
    let b = ids[*j] as usize / BLOCK;
    let from = *j;
    let whole = from + BLOCK <= ids.len() && ids[from + BLOCK - 1] as usize == b * BLOCK + BLOCK - 1;
    let mut live = [true; BLOCK];
    let mut at: [u32; BLOCK] = each(|l| (from + l) as u32);
    if whole && ids[from] as usize == b * BLOCK {
        *j += BLOCK;
        return Batch::new(Span::block(b), Span::of(at), live);
    }
    for l in 0..BLOCK {
        live[l] = *j < ids.len() && ids[*j] as usize == b * BLOCK + l;
        // An idle lane reads a neighbour's row, which is there and is not used.
        at[l] = (*j).min(ids.len() - 1) as u32;
        *j += usize::from(live[l]);
    }
    Batch::new(Span::block(b), Span::of(at), live)
}

/// The next sixteen ids, wherever they are.
#[inline(always)]
fn loose_batch(ids: &[u32], j: &mut usize) -> Batch {
    let (from, last) = (*j, ids.len() - 1);
    *j += BLOCK;
    let rows = Span::of(each(|l| ids[(from + l).min(last)]));
    let at = Span::of(each(|l| (from + l).min(last) as u32));
    Batch::new(rows, at, each(|l| from + l <= last))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    /// out = column 1 − 2·column 0, and the sum of the ids.
    struct Forth<'a>(&'a Table<f32>);

    impl Work<f32, 1> for Forth<'_> {
        #[inline(always)]
        fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, f32>; 1]) -> f64 {
            let [a, b] = batch.ids.read::<f32, 2>(self.0, 1);
            batch.write(out, 0, &[std::array::from_fn(|l| b[l] - 2.0 * a[l])]);
            0.0
        }
    }

    /// Adds the compact rows to columns 1 and 2.
    struct Back<'a>(&'a Table<f32>);

    impl Work<f32, 1> for Back<'_> {
        #[inline(always)]
        fn run(&self, batch: &Batch, [d]: &mut [TableMut<'_, f32>; 1]) -> f64 {
            let [g, h] = batch.at.read::<f32, 2>(self.0, 1);
            batch.add(d, 1, &[g, h]);
            batch.sum(g)
        }
    }

    #[test]
    fn every_kind_of_row_list_equals_row_by_row() {
        for (i, share) in [0.0, 0.02, 0.2, 0.6, 0.97, 1.0, 2.0].into_iter().enumerate() {
            check(3100, share, i as u64);
        }
        // Short lists end in every way: with gaps, over borders, in the middle of a block.
        for seed in 0..600 {
            check(20 + seed as usize % 30, 0.3 + 0.002 * (seed % 300) as f64, seed);
        }
    }

    fn check(rows: usize, share: f64, seed: u64) {
        let mut table = Table::<f32>::new(&[("x", 4)], rows);
        for r in 0..rows {
            table.write(r, 0, std::array::from_fn::<f32, 4, _>(|c| (r * 4 + c) as f32));
        }
        let rng = Rng::new(seed, "lanes", 0);
        let ids: Vec<u32> = (0..rows as u32).filter(|&i| rng.uniform(u64::from(i)) < share).collect();
        let asked = if share > 1.0 { Rows::All } else { Rows::Some(&ids) };
        let n = asked.len(rows);
        let mut out = Table::new(&[("y", 1)], n);
        fill(&Forth(&table), [&mut out], asked);
        let mut compact = Table::new(&[("g", 3)], n);
        for j in 0..n {
            let [a, b] = table.read::<2>(asked.id(j), 1);
            assert_eq!(out.get(j, 0), b - 2.0 * a, "share {share}, row {j} of {ids:?}");
            compact.write(j, 0, [0.0, j as f32, 2.0 - j as f32]);
        }
        let (mut d, mut expected) = (table.clone(), table.clone());
        let sum = scatter(&Back(&compact), [&mut d], asked);
        for j in 0..n {
            expected.add(asked.id(j), 1, compact.read::<2>(j, 1));
        }
        assert_eq!(d.column_to_rows(0, 4), expected.column_to_rows(0, 4), "share {share}");
        assert_eq!(sum, (0..n).map(|j| j as f64).sum::<f64>());
    }
}
