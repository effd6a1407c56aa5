//! [`HashGrid`]: features on grids of several resolutions, blended between the corners of a cell; fine grids share
//! their entries by a hash.
//!
//! Level l has R_l = ⌊base·g^l⌋ cells a side with g = (finest/base)^{1/(levels−1)}. A point u in \[0,1\]^d is at u·(R_l
//! − 1) + ½, so that corners of no two levels coincide at 0. A level with (R_l + 1)^d ≤ 2^log2_size corners has an
//! entry for each, any other finds its corners at (⊕ c_k π_k) mod 2^log2_size. A level's gradient is scattered by one
//! task in the order of the rows: the bits do not depend on the number of threads.
//! Source: Müller et al. 2022 (Instant-NGP) §3 and its conventions in tiny-cuda-nn.

use crate::math::{Real, Rng};
use crate::scene::{Grads, Key, Params};
use crate::simd::{Kernel, Simd, dispatch};
use crate::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// π_k of the hash (Müller et al. 2022, equation 4; the fourth as in tiny-cuda-nn).
const PRIMES: [u32; MAX_DIMS] = [1, 2_654_435_761, 805_459_861, 3_674_653_429];
/// Entries start uniform in ± this (Müller et al. 2022 §4).
const INITIAL: f64 = 1e-4;
/// Most axes of a grid.
pub(crate) const MAX_DIMS: usize = 4;
/// Most features of an entry.
const MAX_FEATURES: usize = 8;
/// Most levels, features an entry, cells a side and, as a power of two, entries per level.
const LIMITS: [usize; 4] = [24, MAX_FEATURES, 1 << 16, 22];
/// Most numbers of a grid: 64 MB in f32.
const MAX_NUMBERS: usize = 1 << 24;
/// Rows that are looked up together, level by level, so that a level stays in the cache.
const ROWS: usize = 512;

/// Sizes of a grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HashShape {
    /// Resolutions.
    pub levels: usize,
    /// Numbers an entry.
    pub features: usize,
    /// Log₂ of the most entries of a level.
    pub log2_size: usize,
    /// Cells a side of the coarsest level.
    pub base: usize,
    /// Cells a side of the finest.
    pub finest: usize,
}

impl HashShape {
    /// Numbers that [`HashGrid::forward`] gives a row.
    pub fn outputs(&self) -> usize {
        self.levels * self.features
    }

    /// Cells a side and entries of every level of a grid with this many axes. Errors: sizes that are not possible.
    fn sizes(&self, dims: usize) -> Result<Vec<(usize, usize)>> {
        let given = [self.levels, self.features, self.finest, self.log2_size];
        let sound = given.iter().zip(LIMITS).all(|(&n, most)| (1..=most).contains(&n))
            && (2..=self.finest).contains(&self.base)
            && (1..=MAX_DIMS).contains(&dims);
        let bad = || {
            Error::input(format!("invalid hash grid: {self:?}"))
                .remedy("The file is damaged or was written by another program; export it again")
        };
        if !sound {
            return Err(bad());
        }
        let growth = (self.finest as f64 / self.base as f64).powf(1.0 / (self.levels.max(2) - 1) as f64);
        let level = |l: usize| {
            let cells = (self.base as f64 * growth.powi(l as i32) + 1e-6).floor() as usize;
            let corners = (cells + 1).checked_pow(dims as u32).unwrap_or(usize::MAX);
            (cells, corners.min(1 << self.log2_size))
        };
        let out: Vec<(usize, usize)> = (0..self.levels).map(level).collect();
        if out.iter().map(|(_, n)| n * self.features).sum::<usize>() > MAX_NUMBERS {
            return Err(bad());
        }
        Ok(out)
    }
}

#[derive(Clone, Copy, Debug)]
struct Level {
    cells: usize,
    entries: usize,
    dense: bool,
}

/// A grid whose entries are in a layer's [`Params`].
#[derive(Clone, Debug)]
pub struct HashGrid {
    shape: HashShape,
    axes: Vec<usize>,
    stride: usize,
    levels: Vec<Level>,
    keys: Vec<Key>,
    columns: Vec<String>,
}

impl HashGrid {
    /// Makes or claims the tables `{name}.{level}` ([entries, features] in one column, `Space::Fixed`) of a grid over
    /// the numbers `axes` of points of `stride` numbers.
    ///
    /// Errors: sizes that are not possible; loaded arrays of the wrong shape. Panics: an axis beyond the point.
    pub fn new<F: Real>(
        name: &str,
        shape: HashShape,
        axes: &[usize],
        stride: usize,
        rng: Rng,
        p: &mut Params<F>,
    ) -> Result<Self> {
        assert!(axes.iter().all(|&a| a < stride), "axes {axes:?} are not all among {stride} numbers");
        let (mut levels, mut keys, mut columns) = (Vec::new(), Vec::new(), Vec::new());
        for (l, (cells, entries)) in shape.sizes(axes.len())?.into_iter().enumerate() {
            let column = format!("{name}.{l}");
            let rng = rng.fork(l as u64);
            keys.push(p.array(&column, entries * shape.features, |grid| {
                for (i, x) in grid.iter_mut().enumerate() {
                    *x = F::of(INITIAL * (2.0 * rng.uniform(i as u64) - 1.0));
                }
            })?);
            columns.push(column);
            let dense = (cells + 1).checked_pow(axes.len() as u32).is_some_and(|n| n <= entries);
            levels.push(Level { cells, entries, dense });
        }
        Ok(Self { shape, axes: axes.to_vec(), stride, levels, keys, columns })
    }

    /// Names of the column groups that learn, level by level: coarse ones first.
    pub(crate) fn columns(&self) -> &[String] {
        &self.columns
    }

    /// The sizes.
    pub(crate) fn shape(&self) -> HashShape {
        self.shape
    }

    /// Points [n, stride] → out, columns `first ..` of rows of `width`: level after level.
    ///
    /// Coordinates are clamped to [0, 1]. Panics: lengths that are not n rows; columns beyond `width`.
    pub fn forward<F: Real>(&self, p: &Params<F>, points: &[F], out: &mut [F], first: usize, width: usize) {
        match self.axes.len() {
            1 => self.forward_in::<F, 1>(p, points, out, first, width),
            2 => self.forward_in::<F, 2>(p, points, out, first, width),
            3 => self.forward_in::<F, 3>(p, points, out, first, width),
            _ => self.forward_in::<F, 4>(p, points, out, first, width),
        }
    }

    /// The VJP of [`forward`](Self::forward): adds to the entries' gradients in `d`, and to d_points [n, stride] if
    /// requested.
    pub fn backward<F: Real>(
        &self,
        p: &Params<F>,
        points: &[F],
        (d_out, first, width): (&[F], usize, usize),
        d_points: Option<&mut [F]>,
        d: &mut Grads<F>,
    ) {
        let d_out = Columns { data: d_out, first, width };
        match self.axes.len() {
            1 => self.backward_in::<F, 1>(p, points, d_out, d_points, d),
            2 => self.backward_in::<F, 2>(p, points, d_out, d_points, d),
            3 => self.backward_in::<F, 3>(p, points, d_out, d_points, d),
            _ => self.backward_in::<F, 4>(p, points, d_out, d_points, d),
        }
    }

    fn forward_in<F: Real, const D: usize>(
        &self,
        p: &Params<F>,
        points: &[F],
        out: &mut [F],
        first: usize,
        width: usize,
    ) {
        assert!(first + self.shape.outputs() <= width, "columns {first} and on do not fit into {width}");
        assert_eq!(points.len() / self.stride, out.len() / width, "a point has a row");
        let simd = Simd::detect();
        points.par_chunks(ROWS * self.stride).zip(out.par_chunks_mut(ROWS * width)).for_each(|(points, out)| {
            for (l, (level, &key)) in self.levels.iter().zip(&self.keys).enumerate() {
                let rows = self.rows::<F, D>(level, points, l);
                run(simd, self.shape.features, Forward { rows, grid: p[key].data(), out: &mut *out, first, width });
            }
        });
    }

    fn backward_in<F: Real, const D: usize>(
        &self,
        p: &Params<F>,
        points: &[F],
        d_out: Columns<'_, F>,
        d_points: Option<&mut [F]>,
        d: &mut Grads<F>,
    ) {
        assert_eq!(points.len() / self.stride, d_out.data.len() / d_out.width, "a point has a row");
        let simd = Simd::detect();
        d.many(&self.keys).into_par_iter().zip(&self.levels).enumerate().for_each(|(l, (table, level))| {
            run(
                simd,
                self.shape.features,
                Scatter { rows: self.rows::<F, D>(level, points, l), d_out, grid: table.data_mut() },
            );
        });
        let Some(d_points) = d_points else { return };
        assert_eq!(d_points.len(), points.len(), "a gradient has the shape of its value");
        let chunks = points.par_chunks(ROWS * self.stride).zip(d_out.data.par_chunks(ROWS * d_out.width));
        chunks.zip(d_points.par_chunks_mut(ROWS * self.stride)).for_each(|((points, data), d_points)| {
            for (l, (level, &key)) in self.levels.iter().zip(&self.keys).enumerate() {
                let (rows, d_out) = (self.rows::<F, D>(level, points, l), Columns { data, ..d_out });
                run(simd, self.shape.features, Slopes { rows, d_out, grid: p[key].data(), d_points: &mut *d_points });
            }
        });
    }

    fn rows<'a, F, const D: usize>(&'a self, level: &'a Level, points: &'a [F], l: usize) -> Points<'a, F, D> {
        let axes = std::array::from_fn(|k| self.axes[k]);
        Points {
            level,
            axes,
            points,
            stride: self.stride,
            features: self.shape.features,
            from: l * self.shape.features,
        }
    }
}

/// Work on the rows of one level, with `N` features an entry; 0: as many as it states.
trait LevelPass: Sized {
    fn pass<const N: usize>(self);
}

/// A pass as the SIMD dispatch takes it: a floor is an instruction there, and a call in baseline code.
struct Fixed<P, const N: usize>(P);

impl<P: LevelPass, const N: usize> Kernel for Fixed<P, N> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        self.0.pass::<N>();
    }
}

/// Two features per entry, the usual number, are a constant for the compiler.
fn run(simd: Simd, features: usize, pass: impl LevelPass) {
    match features {
        2 => dispatch(simd, Fixed::<_, 2>(pass)),
        _ => dispatch(simd, Fixed::<_, 0>(pass)),
    }
}

/// Points to look up in one level, whose features are columns `from ..` of the grid's.
#[derive(Clone, Copy)]
struct Points<'a, F, const D: usize> {
    level: &'a Level,
    axes: [usize; D],
    points: &'a [F],
    stride: usize,
    features: usize,
    from: usize,
}

/// A level's features of some points.
struct Forward<'a, F, const D: usize> {
    rows: Points<'a, F, D>,
    grid: &'a [F],
    /// Columns `first ..` of rows of `width`.
    out: &'a mut [F],
    first: usize,
    width: usize,
}

impl<F: Real, const D: usize> LevelPass for Forward<'_, F, D> {
    #[inline(always)]
    fn pass<const N: usize>(self) {
        let Self { rows: Points { level, axes, points, stride, features, from }, grid, out, first, width } = self;
        let features = if N > 0 { N } else { features };
        for (point, row) in points.chunks_exact(stride).zip(out.chunks_exact_mut(width)) {
            let mut sum = [F::ZERO; MAX_FEATURES];
            let cell = level.cell::<F, D>(&axes, point);
            for corner in 0..1 << D {
                let (at, w) = (level.entry(&cell, corner) * features, cell.weight(corner));
                for (to, x) in sum[..features].iter_mut().zip(&grid[at..at + features]) {
                    *to += w * *x;
                }
            }
            row[first + from..first + from + features].copy_from_slice(&sum[..features]);
        }
    }
}

/// Adds a level's gradient to its entries.
struct Scatter<'a, F, const D: usize> {
    rows: Points<'a, F, D>,
    d_out: Columns<'a, F>,
    grid: &'a mut [F],
}

impl<F: Real, const D: usize> LevelPass for Scatter<'_, F, D> {
    #[inline(always)]
    fn pass<const N: usize>(self) {
        let Self { rows: Points { level, axes, points, stride, features, from }, d_out, grid } = self;
        let features = if N > 0 { N } else { features };
        let from = d_out.first + from;
        for (point, row) in points.chunks_exact(stride).zip(d_out.data.chunks_exact(d_out.width)) {
            let g = &row[from..from + features];
            if g.iter().all(|g| *g == F::ZERO) {
                continue;
            }
            let cell = level.cell::<F, D>(&axes, point);
            for corner in 0..1 << D {
                let (at, w) = (level.entry(&cell, corner) * features, cell.weight(corner));
                for (sum, g) in grid[at..at + features].iter_mut().zip(g) {
                    *sum += w * *g;
                }
            }
        }
    }
}

/// Adds what a level states to the gradient of the points.
struct Slopes<'a, F, const D: usize> {
    rows: Points<'a, F, D>,
    d_out: Columns<'a, F>,
    grid: &'a [F],
    d_points: &'a mut [F],
}

impl<F: Real, const D: usize> LevelPass for Slopes<'_, F, D> {
    #[inline(always)]
    fn pass<const N: usize>(self) {
        let Self { rows: Points { level, axes, points, stride, features, from }, d_out, grid, d_points } = self;
        let features = if N > 0 { N } else { features };
        let from = d_out.first + from;
        let rows = points.chunks_exact(stride).zip(d_out.data.chunks_exact(d_out.width));
        for ((point, row), d_point) in rows.zip(d_points.chunks_exact_mut(stride)) {
            let g = &row[from..from + features];
            let cell = level.cell::<F, D>(&axes, point);
            for corner in 0..1 << D {
                let at = level.entry(&cell, corner) * features;
                let mut along = F::ZERO;
                for (x, g) in grid[at..at + features].iter().zip(g) {
                    along += *x * *g;
                }
                for k in 0..D {
                    d_point[axes[k]] += along * cell.slope(corner, k);
                }
            }
        }
    }
}

/// Columns `first ..` of rows of `width`.
#[derive(Clone, Copy)]
struct Columns<'a, F> {
    data: &'a [F],
    first: usize,
    width: usize,
}

/// Place of a point in a level.
struct Cell<F, const D: usize> {
    /// Its lowest corner.
    low: [u32; D],
    /// How far it is from there, in [0, 1].
    share: [F; D],
    /// d share / d coordinate: 0 where the coordinate was clamped.
    scale: [F; D],
}

impl Level {
    #[inline(always)]
    fn cell<F: Real, const D: usize>(&self, axes: &[usize; D], point: &[F]) -> Cell<F, D> {
        let mut cell = Cell { low: [0; D], share: [F::ZERO; D], scale: [F::ZERO; D] };
        let span = F::of((self.cells - 1) as f64);
        for k in 0..D {
            let u = point[axes[k]];
            let inside = u.max(F::ZERO).min(F::ONE);
            let at = inside * span + F::HALF;
            let low = at.floor();
            cell.low[k] = low.i32() as u32;
            cell.share[k] = at - low;
            cell.scale[k] = if inside == u { span } else { F::ZERO };
        }
        cell
    }

    /// The entry of a corner; bit k of `corner` states which end of axis k.
    #[inline(always)]
    fn entry<F: Real, const D: usize>(&self, cell: &Cell<F, D>, corner: usize) -> usize {
        let c = |k: usize| cell.low[k] + (corner >> k & 1) as u32;
        if self.dense {
            return (0..D).rev().fold(0, |at, k| at * (self.cells + 1) + c(k) as usize);
        }
        let hash = (0..D).fold(0, |hash, k| hash ^ c(k).wrapping_mul(PRIMES[k]));
        hash as usize & (self.entries - 1)
    }
}

impl<F: Real, const D: usize> Cell<F, D> {
    #[inline(always)]
    fn side(&self, corner: usize, k: usize) -> F {
        if corner >> k & 1 == 1 { self.share[k] } else { F::ONE - self.share[k] }
    }

    /// The weight of a corner; they sum to 1.
    #[inline(always)]
    fn weight(&self, corner: usize) -> F {
        (0..D).fold(F::ONE, |w, k| w * self.side(corner, k))
    }

    /// d weight / d coordinate of axis k.
    #[inline(always)]
    fn slope(&self, corner: usize, k: usize) -> F {
        let others = (0..D).filter(|&j| j != k).fold(self.scale[k], |w, j| w * self.side(corner, j));
        if corner >> k & 1 == 1 { others } else { -others }
    }
}

#[cfg(test)]
mod tests;
