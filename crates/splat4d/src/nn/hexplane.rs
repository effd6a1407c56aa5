//! Six planes of features over space and time: xy, xz, xt, yz, yt, zt, at several resolutions (levels).
//!
//! f(x, t) = concat over levels m of Π over the six planes p of bilinear(P_{m,p}; the point's two coordinates on p), C
//! channels a level. Sources: Cao and Johnson 2023 (HexPlane); Fridovich-Keil et al. 2023 (K-Planes); Wu et al. 2024
//! ("4DGaussians"), whose released code multiplies the planes and concatenates the levels.
//!
//! Coordinates run over [0, 1]: 0 is the first grid point, 1 the last, and points outside get the border's value and no
//! gradient. (The released code sends t in [0, 1] to a grid over [-1, 1] and so never reads half of it; here the whole
//! grid is time, and half as many time steps are as fine.)
//!
//! A plane is one `Space::Fixed` column of H·W·C numbers, `[second axis][first axis][channel]`, so that the channels of
//! a grid point are adjacent: a lookup is four short runs of memory. All points of a query have one t, hence a time
//! plane is first blended to the [`Lines`] of that t: 2 runs from the first-level cache instead of 4 from memory.
//!
//! Gradients of grid points are scattered by one task a plane, over rows in order: the same bits for any number of
//! threads.

use crate::math::{Real, Rng};
use crate::scene::{Grads, Key, Params};
use crate::simd::{Kernel, Simd, dispatch, each, total};
use crate::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// The two axes of every plane, first axis contiguous; axis 3 is time.
pub(crate) const AXES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];
/// Names of the planes, in the order of `AXES`.
pub const NAMES: [&str; 6] = ["xy", "xz", "xt", "yz", "yt", "zt"];
/// The planes without time.
pub const SPATIAL: [usize; 3] = [0, 1, 3];
/// The planes over x and t, y and t, z and t.
pub const TEMPORAL: [usize; 3] = [2, 4, 5];

/// Channels are worked on this many at a time.
pub(crate) const LANES: usize = 16;
/// Most channels: four times what anyone uses.
const MAX_CHANNELS: usize = 128;
/// Most levels.
const MAX_LEVELS: usize = 8;
/// Most grid points along an axis.
const MAX_RESOLUTION: usize = 4096;
/// Most numbers in all planes, 1 GiB of f32: a file must not request more.
const MAX_NUMBERS: usize = 1 << 28;
/// Planes start between these: about 1, so that a product of six is neither lost nor overwhelming.
const START: [f64; 2] = [0.5, 1.5];
/// Random grid points along an axis for the start of the first level's planes; twice as many for the second's.
const START_POINTS: usize = 3;
/// Rows that a task of the backward looks up before they are scattered; 128 rows of 12 planes of 32 channels are 200
/// kB.
const PART_ROWS: usize = 128;
/// Parts whose gradients wait to be scattered at a time: 3 MB, within the last-level cache.
const PARTS: usize = 16;

type Lane<F> = [F; LANES];

/// Sizes of the planes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlaneShape {
    /// Features a level, C; a multiple of `LANES`.
    pub channels: usize,
    /// Grid points along a spatial axis at multiple 1.
    pub resolution: usize,
    /// Grid points along time, the same at every level.
    pub time_resolution: usize,
    /// The levels: multiples of `resolution`.
    pub multires: Vec<usize>,
}

impl PlaneShape {
    /// Errors: no level or too many, sizes out of bounds or absurd together.
    pub fn check(&self) -> Result<()> {
        let bad = |what: String| {
            Err(Error::input(format!("feature planes: {what}"))
                .remedy("Common sizes are 16 or 32 channels, resolution 64, multires [1, 2]"))
        };
        if self.channels == 0 || !self.channels.is_multiple_of(LANES) || self.channels > MAX_CHANNELS {
            return bad(format!("{} channels are not a multiple of {LANES} up to {MAX_CHANNELS}", self.channels));
        }
        if self.multires.is_empty() || self.multires.len() > MAX_LEVELS {
            return bad(format!("{} levels are not 1 to {MAX_LEVELS}", self.multires.len()));
        }
        let sides = self.multires.iter().map(|&m| self.resolution.saturating_mul(m));
        for side in sides.chain([self.time_resolution]) {
            if !(2..=MAX_RESOLUTION).contains(&side) {
                return bad(format!("an axis of {side} grid points is not 2 to {MAX_RESOLUTION}"));
            }
        }
        if self.numbers() > MAX_NUMBERS {
            return bad(format!("{} numbers are more than {MAX_NUMBERS}", self.numbers()));
        }
        Ok(())
    }

    /// Features of a point: C a level.
    pub(crate) fn features(&self) -> usize {
        self.channels * self.multires.len()
    }

    /// Grid points of a plane along its two axes, first axis first.
    pub fn size(&self, level: usize, plane: usize) -> [usize; 2] {
        AXES[plane].map(|a| if a == 3 { self.time_resolution } else { self.resolution * self.multires[level] })
    }

    /// Numbers in all planes: Σ over levels of 3·C·R²m² + 3·C·R·m·T.
    pub(crate) fn numbers(&self) -> usize {
        (0..self.multires.len())
            .flat_map(|l| (0..6).map(move |p| (l, p)))
            .map(|(l, p)| self.size(l, p).iter().product::<usize>() * self.channels)
            .sum()
    }

    /// The name of a plane's table and column.
    pub fn name(level: usize, plane: usize) -> String {
        format!("hexplane.{level}.{}", NAMES[plane])
    }
}

/// The planes' tables.
#[derive(Clone, Debug)]
pub struct Planes {
    shape: PlaneShape,
    keys: Vec<[Key; 6]>,
}

/// The time planes at one t, and the indices for their backward.
pub struct Lines<F> {
    /// By level: x, y, z; [resolution][channel].
    lines: Vec<[Vec<Lane<F>>; 3]>,
    /// The time step before t.
    step: usize,
    /// How far t is from it to the next, in [0, 1].
    share: F,
    /// dshare/dt: 0 outside the clip.
    slope: F,
}

impl Planes {
    /// Makes or claims the tables. Errors: a shape that cannot be, loaded arrays of another one.
    pub fn new<F: Real>(shape: PlaneShape, rng: Rng, p: &mut Params<F>) -> Result<Self> {
        shape.check()?;
        let mut keys = Vec::new();
        for level in 0..shape.multires.len() {
            let mut of_level = [Key(0); 6];
            for (plane, key) in of_level.iter_mut().enumerate() {
                let numbers = shape.size(level, plane).iter().product::<usize>() * shape.channels;
                let stream = rng.fork((level * 6 + plane) as u64);
                let size = shape.size(level, plane);
                *key = p.array(&PlaneShape::name(level, plane), numbers, |data| {
                    smooth(data, size, shape.channels, START_POINTS * (level + 1), stream);
                })?;
            }
            keys.push(of_level);
        }
        Ok(Self { shape, keys })
    }

    /// Sizes.
    #[cfg(test)]
    pub(crate) fn shape(&self) -> &PlaneShape {
        &self.shape
    }

    /// Keys by level, in the order of `AXES`.
    pub fn keys(&self) -> &[[Key; 6]] {
        &self.keys
    }

    /// Blends the time planes at `t` in [0, 1].
    pub fn lines<F: Real>(&self, p: &Params<F>, t: F) -> Lines<F> {
        let steps = self.shape.time_resolution;
        let inside = t > F::ZERO && t < F::ONE;
        let [at, share] = place(t, steps);
        let step = at.i32() as usize;
        let blend = |level: usize, plane: usize| -> Vec<Lane<F>> {
            let data = lanes(p[self.keys[level][plane]].data());
            let row = self.shape.size(level, plane)[0] * self.blocks();
            let (before, after) = (&data[step * row..(step + 1) * row], &data[(step + 1) * row..(step + 2) * row]);
            before.iter().zip(after).map(|(a, b)| each(|c| a[c] + share * (b[c] - a[c]))).collect()
        };
        let lines = (0..self.keys.len()).map(|level| TEMPORAL.map(|plane| blend(level, plane))).collect();
        let slope = if inside { F::of((steps - 1) as f64) } else { F::ZERO };
        Lines { lines, step, share, slope }
    }

    /// Runs of [`LANES`] channels at a grid point.
    fn blocks(&self) -> usize {
        self.shape.channels / LANES
    }

    fn levels<'a, F: Real>(&self, p: &'a Params<F>, lines: &'a Lines<F>, count: usize) -> Vec<Level<'a, F>> {
        let level = |level: usize| Level {
            side: self.shape.resolution * self.shape.multires[level],
            blocks: self.blocks(),
            planes: SPATIAL.map(|plane| lanes(p[self.keys[level][plane]].data())),
            lines: [0, 1, 2].map(|axis| lines.lines[level][axis].as_slice()),
        };
        (0..count.min(self.keys.len())).map(level).collect()
    }

    /// Features at the lines' time: x \[n\] in [0, 1]³ → out [n, C·levels]. Levels from `unlocked` on give zeros.
    pub fn forward<F: Real>(&self, p: &Params<F>, lines: &Lines<F>, unlocked: usize, x: &[[F; 3]], out: &mut [F]) {
        let width = self.shape.features();
        assert_eq!(out.len(), x.len() * width, "features of {} points need as many rows of {width}", x.len());
        let levels = self.levels(p, lines, unlocked);
        let simd = Simd::detect();
        let tasks = out.par_chunks_mut(PART_ROWS * width).zip(x.par_chunks(PART_ROWS));
        tasks.for_each(|(out, x)| {
            let (out, _) = out.as_chunks_mut();
            dispatch(simd, Forward { levels: &levels, x, out, width: width / LANES });
        });
    }

    /// VJP of [`forward`](Self::forward) and [`lines`](Self::lines): adds to `d` and to `d_x`; returns dL/dt. `waiting`
    /// is scratch, whatever is in it.
    pub fn backward<F: Real>(
        &self,
        p: &Params<F>,
        lines: &Lines<F>,
        unlocked: usize,
        x: &[[F; 3]],
        d_out: &[F],
        d_x: &mut [[F; 3]],
        waiting: &mut Vec<[F; LANES]>,
        d: &mut Grads<F>,
    ) -> F {
        let width = self.shape.features();
        assert!(d_out.len() == x.len() * width && d_x.len() == x.len(), "gradients have the shapes of their values");
        let (levels, blocks, simd) = (self.levels(p, lines, unlocked), self.blocks(), Simd::detect());
        let keys: Vec<Key> = self.keys[..levels.len()].as_flattened().to_vec();
        let mut tables = d.many(&keys);
        let mut sinks: Vec<Sink<'_, F>> = Vec::new();
        for (i, table) in tables.iter_mut().enumerate() {
            let (level, plane) = (i / 6, i % 6);
            let side = levels[level].side;
            let [u, v] = AXES[plane];
            let line = if v == 3 { vec![[F::ZERO; LANES]; side * blocks] } else { Vec::new() };
            let data = table.data_mut().as_chunks_mut().0;
            // Of a time plane only the two steps around t get anything.
            let data =
                if v == 3 { &mut data[lines.step * side * blocks..(lines.step + 2) * side * blocks] } else { data };
            sinks.push(Sink { level, plane, side, axes: [u, v], data, line });
        }
        let run = levels.len() * 6 * blocks;
        waiting.resize((PARTS * PART_ROWS).min(x.len()) * run, [F::ZERO; LANES]);
        let some = PARTS * PART_ROWS;
        for ((x, d_out), d_x) in x.chunks(some).zip(d_out.chunks(some * width)).zip(d_x.chunks_mut(some)) {
            let parts = waiting.par_chunks_mut(PART_ROWS * run).zip(x.par_chunks(PART_ROWS));
            let parts = parts.zip(d_out.par_chunks(PART_ROWS * width)).zip(d_x.par_chunks_mut(PART_ROWS));
            parts.for_each(|(((waiting, x), d_out), d_x)| {
                let d_out = lanes(d_out);
                dispatch(simd, Backward { levels: &levels, x, d_out, width: width / LANES, waiting, d_x });
            });
            let waiting = &*waiting;
            sinks.par_iter_mut().with_max_len(1).for_each(|sink| {
                dispatch(simd, Scatter { sink, x, waiting, run, blocks });
            });
        }
        let slopes: Vec<F> = sinks
            .par_iter_mut()
            .with_max_len(1)
            .filter(|s| s.axes[1] == 3)
            .map(|sink| sink.finish(lanes(p[keys[sink.level * 6 + sink.plane]].data()), lines))
            .collect();
        slopes.into_iter().fold(F::ZERO, |a, b| a + b)
    }
}

/// Fills a plane with bilinear blends of `points` by `points` random numbers per channel. Independent grid points, as
/// in the released code, give neighbours unrelated features, and networks train for long before they can separate a
/// motion of a region from noise: mutant at 200x200 reached 25.9 dB after 600 steps, and 30.1 dB from smooth planes.
fn smooth<F: Real>(data: &mut [F], size: [usize; 2], channels: usize, points: usize, stream: Rng) {
    let counts = size.map(|n| points.min(n));
    // The random point before a grid point, and the fraction towards the next.
    let near = |at: usize, axis: usize| {
        let g = at as f64 / (size[axis] - 1) as f64 * (counts[axis] - 1) as f64;
        let before = (g as usize).min(counts[axis] - 2);
        (before, g - before as f64)
    };
    for (i, x) in data.iter_mut().enumerate() {
        let (channel, cell) = (i % channels, i / channels);
        let ((a, s), (b, r)) = (near(cell % size[0], 0), near(cell / size[0], 1));
        let random = |a: usize, b: usize| stream.uniform(((b * counts[0] + a) * channels + channel) as u64);
        let along = |b: usize| (1.0 - s) * random(a, b) + s * random(a + 1, b);
        *x = F::of(START[0] + (START[1] - START[0]) * ((1.0 - r) * along(b) + r * along(b + 1)));
    }
}

fn lanes<F: Real>(data: &[F]) -> &[Lane<F>] {
    data.as_chunks().0
}

/// The grid point before a coordinate in [0, 1] (as a number), and how far it is to the next, in [0, 1].
#[inline(always)]
fn place<F: Real>(x: F, count: usize) -> [F; 2] {
    let g = x.max(F::ZERO).min(F::ONE) * F::of((count - 1) as f64);
    let at = g.floor().min(F::of((count - 2) as f64));
    [at, g - at]
}

/// One level of the planes, to read.
struct Level<'a, F> {
    side: usize,
    blocks: usize,
    /// xy, xz, yz.
    planes: [&'a [Lane<F>]; 3],
    /// x, y, z.
    lines: [&'a [Lane<F>]; 3],
}

/// Axes of [`Level::planes`].
const PAIRS: [[usize; 2]; 3] = [[0, 1], [0, 2], [1, 2]];

/// A point in a level's grid.
struct Cell<F> {
    at: [usize; 3],
    share: [F; 3],
}

impl<F: Real> Cell<F> {
    #[inline(always)]
    fn new(x: [F; 3], side: usize) -> Self {
        let places: [[F; 2]; 3] = each(|k| place(x[k], side));
        Self { at: each(|k| places[k][0].i32() as usize), share: each(|k| places[k][1]) }
    }
}

/// Four grid points around a position, of one run of channels: their blend and its slopes along the first and second
/// axis.
#[inline(always)]
fn bilinear<F: Real>(plane: &[Lane<F>], first: usize, block: usize, row: usize, s: [F; 2]) -> [Lane<F>; 3] {
    let (a, b) = (&plane[first], &plane[first + block]);
    let (c, d) = (&plane[first + row], &plane[first + row + block]);
    let mut out = [[F::ZERO; LANES]; 3];
    for k in 0..LANES {
        let (along, above) = (b[k] - a[k], d[k] - c[k]);
        let (low, high) = (a[k] + s[0] * along, c[k] + s[0] * above);
        out[0][k] = low + s[1] * (high - low);
        out[1][k] = along + s[1] * (above - along);
        out[2][k] = high - low;
    }
    out
}

/// Two grid points around a position on a line: their blend and its slope.
#[inline(always)]
fn linear<F: Real>(line: &[Lane<F>], first: usize, block: usize, s: F) -> [Lane<F>; 2] {
    let (a, b) = (&line[first], &line[first + block]);
    let mut out = [[F::ZERO; LANES]; 2];
    for k in 0..LANES {
        out[1][k] = b[k] - a[k];
        out[0][k] = a[k] + s * out[1][k];
    }
    out
}

struct Forward<'a, F> {
    levels: &'a [Level<'a, F>],
    x: &'a [[F; 3]],
    out: &'a mut [Lane<F>],
    /// Runs of channels in a row of `out`.
    width: usize,
}

impl<F: Real> Kernel for Forward<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        for (x, out) in self.x.iter().zip(self.out.chunks_exact_mut(self.width)) {
            for (l, level) in self.levels.iter().enumerate() {
                let (cell, blocks) = (Cell::new(*x, level.side), level.blocks);
                let row = level.side * blocks;
                for b in 0..blocks {
                    let mut f = [F::ONE; LANES];
                    for (plane, [u, v]) in level.planes.iter().zip(PAIRS) {
                        let first = cell.at[v] * row + cell.at[u] * blocks + b;
                        let [s, ..] = bilinear(plane, first, blocks, row, [cell.share[u], cell.share[v]]);
                        f = each(|k| f[k] * s[k]);
                    }
                    for axis in 0..3 {
                        let first = cell.at[axis] * blocks + b;
                        let [s, _] = linear(level.lines[axis], first, blocks, cell.share[axis]);
                        f = each(|k| f[k] * s[k]);
                    }
                    out[l * blocks + b] = f;
                }
            }
            out[self.levels.len() * self.levels.first().map_or(0, |l| l.blocks)..].fill([F::ZERO; LANES]);
        }
    }
}

struct Backward<'a, F> {
    levels: &'a [Level<'a, F>],
    x: &'a [[F; 3]],
    d_out: &'a [Lane<F>],
    /// Runs of channels in a row of `d_out`.
    width: usize,
    /// Gradients to the six lookups: [level][plane][row][block].
    waiting: &'a mut [Lane<F>],
    d_x: &'a mut [[F; 3]],
}

impl<F: Real> Kernel for Backward<'_, F> {
    type Out = ();
    /// Every factor's gradient is the product of the five others: no division, since a factor may be zero.
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let rows = self.x.len();
        for (j, (x, d_x)) in self.x.iter().zip(self.d_x.iter_mut()).enumerate() {
            let mut slopes = [[F::ZERO; LANES]; 3];
            for (l, level) in self.levels.iter().enumerate() {
                let (cell, blocks) = (Cell::new(*x, level.side), level.blocks);
                let row = level.side * blocks;
                // From grid steps to the unit interval.
                let steps = F::of((level.side - 1) as f64);
                for b in 0..blocks {
                    let [xy, xz, yz]: [[Lane<F>; 3]; 3] = each(|p| {
                        let [u, v] = PAIRS[p];
                        let first = cell.at[v] * row + cell.at[u] * blocks + b;
                        bilinear(level.planes[p], first, blocks, row, [cell.share[u], cell.share[v]])
                    });
                    let [xt, yt, zt]: [[Lane<F>; 2]; 3] =
                        each(|axis| linear(level.lines[axis], cell.at[axis] * blocks + b, blocks, cell.share[axis]));
                    let g = &self.d_out[j * self.width + l * blocks + b];
                    let mut to = [[F::ZERO; LANES]; 6];
                    for k in 0..LANES {
                        let (xy_xz, yz_g) = (xy[0][k] * xz[0][k], yz[0][k] * g[k]);
                        let (xt_yt, zt_g) = (xt[0][k] * yt[0][k], zt[0][k] * g[k]);
                        let (moving, still) = (xt_yt * zt_g, xy_xz * yz_g);
                        to[0][k] = xz[0][k] * yz[0][k] * moving;
                        to[1][k] = xy[0][k] * yz[0][k] * moving;
                        to[3][k] = xy_xz * moving;
                        to[2][k] = yt[0][k] * zt[0][k] * still;
                        to[4][k] = xt[0][k] * zt[0][k] * still;
                        to[5][k] = xt_yt * still;
                        let along_x = xy[1][k] * to[0][k] + xz[1][k] * to[1][k] + xt[1][k] * to[2][k];
                        let along_y = xy[2][k] * to[0][k] + yz[1][k] * to[3][k] + yt[1][k] * to[4][k];
                        let along_z = xz[2][k] * to[1][k] + yz[2][k] * to[3][k] + zt[1][k] * to[5][k];
                        slopes[0][k] += steps * along_x;
                        slopes[1][k] += steps * along_y;
                        slopes[2][k] += steps * along_z;
                    }
                    for (p, to) in to.iter().enumerate() {
                        self.waiting[((l * 6 + p) * rows + j) * blocks + b] = *to;
                    }
                }
            }
            for axis in 0..3 {
                // Beyond the border nothing changes.
                let inside = x[axis] > F::ZERO && x[axis] < F::ONE;
                let sum = total(slopes[axis]);
                d_x[axis] += if inside { sum } else { F::ZERO };
            }
        }
    }
}

/// Target of the gradient of one plane.
struct Sink<'a, F> {
    level: usize,
    plane: usize,
    side: usize,
    axes: [usize; 2],
    /// The plane's gradient; of a time plane the two steps around t.
    data: &'a mut [Lane<F>],
    /// The gradient to a time plane's line.
    line: Vec<Lane<F>>,
}

impl<F: Real> Sink<'_, F> {
    /// Shares the line's gradient out to the two time steps around t; returns dL/dt.
    fn finish(&mut self, plane: &[Lane<F>], lines: &Lines<F>) -> F {
        let n = self.line.len();
        let (before, after) = self.data.split_at_mut(n);
        let (low, high) = (&plane[lines.step * n..(lines.step + 1) * n], &plane[(lines.step + 1) * n..]);
        let mut slope = [F::ZERO; LANES];
        for (i, d) in self.line.iter().enumerate() {
            for k in 0..LANES {
                before[i][k] += d[k] * (F::ONE - lines.share);
                after[i][k] += d[k] * lines.share;
                slope[k] += d[k] * (high[i][k] - low[i][k]);
            }
        }
        total(slope) * lines.slope
    }
}

struct Scatter<'a, 'b, F> {
    sink: &'a mut Sink<'b, F>,
    x: &'a [[F; 3]],
    /// Parts of [level][plane][row][block].
    waiting: &'a [Lane<F>],
    /// Runs of channels a row of all planes.
    run: usize,
    blocks: usize,
}

impl<F: Real> Kernel for Scatter<'_, '_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let Self { sink, x, waiting, run, blocks } = self;
        let ([u, v], side) = (sink.axes, sink.side);
        for (part, x) in x.chunks(PART_ROWS).enumerate() {
            let first = part * PART_ROWS * run + (sink.level * 6 + sink.plane) * x.len() * blocks;
            let from = waiting[first..first + x.len() * blocks].chunks_exact(blocks);
            for (x, from) in x.iter().zip(from) {
                let [at, s] = place(x[u], side);
                let near = at.i32() as usize * blocks;
                if v == 3 {
                    add(&mut sink.line[near..near + 2 * blocks], from, s, F::ONE);
                } else {
                    let [row, s_row] = place(x[v], side);
                    let low = row.i32() as usize * side * blocks + near;
                    let high = low + side * blocks;
                    add(&mut sink.data[low..low + 2 * blocks], from, s, F::ONE - s_row);
                    add(&mut sink.data[high..high + 2 * blocks], from, s, s_row);
                }
            }
        }
    }
}

/// Adds weight·(1−s) of a run of channels to a grid point and weight·s to the next.
#[inline(always)]
fn add<F: Real>(to: &mut [Lane<F>], from: &[Lane<F>], s: F, weight: F) {
    let (near, next) = to.split_at_mut(from.len());
    let (a, b) = (weight * (F::ONE - s), weight * s);
    for ((near, next), from) in near.iter_mut().zip(next).zip(from) {
        // Whole lanes at once: two interleaved loops are compiled number by number.
        *near = each(|k| near[k] + a * from[k]);
        *next = each(|k| next[k] + b * from[k]);
    }
}

#[cfg(test)]
mod tests;
