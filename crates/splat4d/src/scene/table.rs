//! [`Table`]: the container of everything with a row per Gaussian, per node, or a single row.
//!
//! Rows are stored in blocks `[row/16][column][16]`: a block is one AVX-512 register (or two AVX2 ones) a column, and a
//! range of rows is one slice. A table of one column is therefore contiguous, so that a matrix product can read it.

use crate::math::Real;
use crate::simd::each;
use std::borrow::Cow;

/// Rows in a block.
pub const BLOCK: usize = 16;

/// A named group of columns.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Column {
    /// The array's name in a scene file.
    pub name: Cow<'static, str>,
    /// Numbers per row.
    pub width: usize,
}

/// Named column groups of rows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Table<F = f32> {
    rows: usize,
    width: usize,
    columns: Vec<Column>,
    data: Vec<F>,
}

impl<F: Real> Table<F> {
    /// `rows` rows of zeros.
    pub fn new(columns: &[(&'static str, usize)], rows: usize) -> Self {
        let columns = columns.iter().map(|&(n, width)| Column { name: Cow::Borrowed(n), width }).collect();
        Self::with_columns(columns, rows)
    }

    /// `rows` rows of zeros.
    pub fn with_columns(columns: Vec<Column>, rows: usize) -> Self {
        let width = columns.iter().map(|c| c.width).sum();
        Self { rows, width, columns, data: vec![F::ZERO; rows.div_ceil(BLOCK) * BLOCK * width] }
    }

    /// A table of the same columns, all zero.
    pub fn zeros_like(&self) -> Self {
        Self::with_columns(self.columns.clone(), self.rows)
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Numbers per row.
    pub fn width(&self) -> usize {
        self.width
    }

    /// The column groups.
    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    /// First column of the group `name`, and its width.
    pub fn column(&self, name: &str) -> Option<(usize, usize)> {
        let mut first = 0;
        for c in &self.columns {
            if c.name == name {
                return Some((first, c.width));
            }
            first += c.width;
        }
        None
    }

    #[inline(always)]
    fn index(&self, row: usize, col: usize) -> usize {
        debug_assert!(row < self.rows && col < self.width);
        (row / BLOCK * self.width + col) * BLOCK + row % BLOCK
    }

    /// One number.
    #[inline(always)]
    pub fn get(&self, row: usize, col: usize) -> F {
        self.data[self.index(row, col)]
    }

    /// One number, to write.
    #[inline(always)]
    pub fn get_mut(&mut self, row: usize, col: usize) -> &mut F {
        let i = self.index(row, col);
        &mut self.data[i]
    }

    /// Writes one number.
    #[inline(always)]
    pub fn set(&mut self, row: usize, col: usize, value: F) {
        *self.get_mut(row, col) = value;
    }

    /// `N` neighbouring columns of one row.
    #[inline(always)]
    pub fn read<const N: usize>(&self, row: usize, col: usize) -> [F; N] {
        let i = self.index(row, col);
        let s = &self.data[i..i + (N - 1) * BLOCK + 1];
        each(|k| s[k * BLOCK])
    }

    /// Writes `N` neighbouring columns of one row.
    #[inline(always)]
    pub fn write<const N: usize>(&mut self, row: usize, col: usize, values: [F; N]) {
        let i = self.index(row, col);
        let s = &mut self.data[i..i + (N - 1) * BLOCK + 1];
        for k in 0..N {
            s[k * BLOCK] = values[k];
        }
    }

    /// Adds to `N` neighbouring columns of one row.
    #[inline(always)]
    pub fn add<const N: usize>(&mut self, row: usize, col: usize, values: [F; N]) {
        let i = self.index(row, col);
        let s = &mut self.data[i..i + (N - 1) * BLOCK + 1];
        for k in 0..N {
            s[k * BLOCK] += values[k];
        }
    }

    /// All blocks, `[row/16][column][16]`; numbers past the last row mean nothing.
    pub fn data(&self) -> &[F] {
        &self.data
    }

    /// All blocks, to write.
    pub fn data_mut(&mut self) -> &mut [F] {
        &mut self.data
    }

    /// The block that holds rows `16·b ..`: `[width][16]`.
    pub(crate) fn block(&self, b: usize) -> &[F] {
        &self.data[b * self.width * BLOCK..(b + 1) * self.width * BLOCK]
    }

    /// Chunks of `blocks` blocks as [`TableMut`] views for independent tasks, in row order.
    pub fn chunks_mut(&mut self, blocks: usize) -> impl ExactSizeIterator<Item = TableMut<'_, F>> {
        let (width, rows) = (self.width, self.rows);
        // A table without columns still has row chunks, of empty slices.
        let count = rows.div_ceil(BLOCK).div_ceil(blocks);
        let mut rest = self.data.as_mut_slice();
        (0..count).map(move |i| {
            let first = i * blocks * BLOCK;
            let len = (blocks * BLOCK * width).min(rest.len());
            let (head, tail) = std::mem::take(&mut rest).split_at_mut(len);
            rest = tail;
            TableMut { first, rows: rows.min(first + blocks * BLOCK) - first, width, data: head }
        })
    }

    /// The whole table as one view, to be split among tasks.
    pub fn view_mut(&mut self) -> TableMut<'_, F> {
        TableMut { first: 0, rows: self.rows, width: self.width, data: &mut self.data }
    }

    /// Makes the table `rows` long; new rows are zero. Keeps the allocation.
    pub fn resize(&mut self, rows: usize) {
        let old = self.rows;
        self.data.resize(rows.div_ceil(BLOCK) * BLOCK * self.width, F::ZERO);
        self.rows = rows;
        for row in old..rows.min(old.div_ceil(BLOCK) * BLOCK) {
            for col in 0..self.width {
                self.set(row, col, F::ZERO);
            }
        }
    }

    /// Sets every number.
    pub fn fill(&mut self, value: F) {
        self.data.fill(value);
    }

    /// The table whose row j is this table's row `parents[j]`.
    pub fn gather(&self, parents: &[u32]) -> Self {
        let mut out = Self::with_columns(self.columns.clone(), parents.len());
        let width = self.width;
        if width == 0 {
            return out;
        }
        par_split([out.view_mut()], &|[view]| {
            for (j, &parent) in parents[view.first..view.first + view.rows].iter().enumerate() {
                let i = parent as usize;
                assert!(i < self.rows, "a row's parent is one of the {} rows", self.rows);
                let from = self.data[i / BLOCK * width * BLOCK + i % BLOCK..].iter().step_by(BLOCK);
                let to = view.data[j / BLOCK * width * BLOCK + j % BLOCK..].iter_mut().step_by(BLOCK);
                to.zip(from).take(width).for_each(|(to, from)| *to = *from);
            }
            0.0
        });
        out
    }

    /// Sets all numbers of a row to zero.
    pub fn clear_row(&mut self, row: usize) {
        for col in 0..self.width {
            self.set(row, col, F::ZERO);
        }
    }

    /// The same numbers in another precision.
    pub(crate) fn cast<G: Real>(&self) -> Table<G> {
        Table {
            rows: self.rows,
            width: self.width,
            columns: self.columns.clone(),
            data: self.data.iter().map(|x| G::of(x.f64())).collect(),
        }
    }

    /// One column group as a row-major array [rows, width], the form in which files hold it.
    pub fn column_to_rows(&self, first: usize, width: usize) -> Vec<F> {
        let mut out = Vec::with_capacity(self.rows * width);
        for row in 0..self.rows {
            out.extend((first..first + width).map(|col| self.get(row, col)));
        }
        out
    }

    /// Fills one column group from a row-major array. Panics: its length is not rows·width.
    pub fn column_from_rows(&mut self, first: usize, width: usize, values: &[F]) {
        assert_eq!(values.len(), self.rows * width, "a column group needs rows·width values");
        for row in 0..self.rows {
            for k in 0..width {
                self.set(row, first + k, values[row * width + k]);
            }
        }
    }

    /// The first (row, column) that is NaN or infinite.
    pub fn first_non_finite(&self) -> Option<(usize, usize)> {
        if self.rows.is_multiple_of(BLOCK) && self.data.iter().all(|x| x.is_finite()) {
            return None;
        }
        (0..self.rows).flat_map(|r| (0..self.width).map(move |c| (r, c))).find(|&(r, c)| !self.get(r, c).is_finite())
    }
}

/// A run of whole blocks of a table, rows `first .. first + rows`, owned by one task.
#[derive(Debug)]
pub struct TableMut<'a, F = f32> {
    /// The table's row that is this view's row 0.
    pub first: usize,
    /// Rows in the view.
    pub rows: usize,
    /// Numbers per row.
    pub width: usize,
    /// `[row/16][column][16]`
    pub data: &'a mut [F],
}

impl<F> TableMut<'_, F> {
    /// Blocks in the view, the last one perhaps not full.
    pub(crate) fn blocks(&self) -> usize {
        self.rows.div_ceil(BLOCK)
    }

    /// The first `blocks` blocks, and the rest. Panics: there are not this many.
    pub(crate) fn split_at(self, blocks: usize) -> (Self, Self) {
        let rows = (blocks * BLOCK).min(self.rows);
        let (head, tail) = self.data.split_at_mut(blocks * BLOCK * self.width);
        let a = Self { first: self.first, rows, width: self.width, data: head };
        (a, Self { first: self.first + rows, rows: self.rows - rows, width: self.width, data: tail })
    }
}

impl<F: Real> TableMut<'_, F> {
    #[inline(always)]
    fn index(&self, row: usize, col: usize) -> usize {
        let local = row - self.first;
        debug_assert!(local < self.rows && col < self.width);
        (local / BLOCK * self.width + col) * BLOCK + local % BLOCK
    }

    /// Writes `N` neighbouring columns of the table's row `row` (numbered as in the table).
    #[inline(always)]
    pub fn write<const N: usize>(&mut self, row: usize, col: usize, values: [F; N]) {
        let i = self.index(row, col);
        let s = &mut self.data[i..i + (N - 1) * BLOCK + 1];
        for k in 0..N {
            s[k * BLOCK] = values[k];
        }
    }

    /// Adds to `N` neighbouring columns of the table's row `row`.
    #[inline(always)]
    pub fn add<const N: usize>(&mut self, row: usize, col: usize, values: [F; N]) {
        let i = self.index(row, col);
        let s = &mut self.data[i..i + (N - 1) * BLOCK + 1];
        for k in 0..N {
            s[k * BLOCK] += values[k];
        }
    }

    /// `N` neighbouring columns of the table's row `row`.
    #[inline(always)]
    pub fn read<const N: usize>(&self, row: usize, col: usize) -> [F; N] {
        let i = self.index(row, col);
        let s = &self.data[i..i + (N - 1) * BLOCK + 1];
        each(|k| s[k * BLOCK])
    }
}

/// Work on runs of the blocks of `N` tables, for [`par_split`].
pub(crate) type SplitFn<'f, F, const N: usize> = dyn Fn([TableMut<'_, F>; N]) -> f64 + Sync + 'f;

/// Blocks of rows a task takes: 1024 rows are some hundreds of kilobytes of parameters, enough to hide task costs.
const TASK_BLOCKS: usize = 64;

/// Splits tables that have as many rows into runs of blocks and calls `f` with each run, in parallel and without
/// allocating. Returns the sum of its results, added up in a tree that depends on the number of rows alone.
///
/// `f` is called through a pointer, once for a thousand rows: the splitting is then compiled once, and not for each of
/// its some hundred callers.
pub fn par_split<F: Real, const N: usize>(views: [TableMut<'_, F>; N], f: &SplitFn<'_, F, N>) -> f64 {
    let tasks = views[0].blocks().div_ceil(TASK_BLOCKS);
    if tasks <= 1 {
        return if tasks == 0 { 0.0 } else { f(views) };
    }
    let mut parts = views.map(|v| {
        let (a, b) = v.split_at(tasks / 2 * TASK_BLOCKS);
        (Some(a), Some(b))
    });
    let left: [_; N] = std::array::from_fn(|i| parts[i].0.take().expect("every view was cut in two"));
    let right: [_; N] = std::array::from_fn(|i| parts[i].1.take().expect("every view was cut in two"));
    let (a, b) = rayon::join(|| par_split(left, f), || par_split(right, f));
    a + b
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn read_write_gather_resize() {
        let mut t = Table::<f32>::new(&[("a", 3), ("b", 2)], 37);
        for r in 0..37 {
            t.write(r, 0, [r as f32, 1.0, 2.0]);
            t.write(r, 3, [3.0, -(r as f32)]);
        }
        assert_eq!(t.column("b"), Some((3, 2)));
        assert_eq!(t.read::<2>(20, 3), [3.0, -20.0]);
        let g = t.gather(&[5, 5, 36]);
        assert_eq!(g.rows(), 3);
        assert_eq!(g.read::<3>(2, 0), [36.0, 1.0, 2.0]);
        t.resize(10);
        t.resize(40);
        assert_eq!(t.read::<3>(9, 0), [9.0, 1.0, 2.0]);
        assert_eq!(t.read::<3>(10, 0), [0.0; 3], "rows that come back must be zero");
        let rows = t.column_to_rows(3, 2);
        let mut u = t.zeros_like();
        u.column_from_rows(3, 2, &rows);
        assert_eq!(u.column_to_rows(3, 2), rows);
    }

    #[test]
    fn chunks_cover_every_row_once() {
        let mut t = Table::<f32>::new(&[("a", 2)], 100);
        for mut c in t.chunks_mut(2) {
            for r in c.first..c.first + c.rows {
                c.add(r, 0, [r as f32, 1.0]);
            }
        }
        assert!((0..100).all(|r| t.read::<2>(r, 0) == [r as f32, 1.0]));
    }

    #[test]
    fn one_column_is_contiguous() {
        let mut t = Table::<f32>::new(&[("w", 1)], 33);
        for r in 0..33 {
            t.set(r, 0, r as f32);
        }
        assert!(t.data()[..33].iter().enumerate().all(|(i, &x)| x == i as f32));
    }
}
