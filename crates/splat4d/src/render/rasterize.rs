//! Blends sorted splats front to back into 8² tiles, four channels at a time, and the way back.
//!
//! A bin of 32² pixels is one task: its splats are gathered once into records, a 16-bit mask says which of its 16
//! tiles each can touch, and a tile's 64 pixels stay in cache while its splats pass. Any number of channels is any
//! number of passes over the same projection.
//!
//! α = min(α_max, o·g), g = exp(−½ dᵀ conic d); α < α_min is skipped; a pixel stops before T(1−α) would fall below
//! T_min. Source: Kerbl et al. 2023; gradients are 0 where α is at its ceiling, as in gsplat.

#[path = "count.rs"]
mod count;

pub use count::PairCounts;

use super::RenderConfig;
use super::bin::{BIN, Bins, Footprint, PAIR_BUDGET, id};
use super::parallel::{Even, Ragged, for_each_group};
use super::project::{ALPHA_FLOOR, Projected, ProjectedGrads, TAU_MARGIN};
use super::simd::{Kernel, Simd, dispatch};
use crate::math::Real;
use crate::scene::BLOCK;
use rayon::prelude::*;
use std::f64::consts::{LN_2, LOG2_E};
use std::sync::atomic::{AtomicU32, Ordering};

/// Channels of one pass.
pub const CHANNELS: usize = 4;
/// Pixels across and down a tile: one row is one vector.
const TILE: usize = 8;
/// Tiles in a row of a bin.
const SIDE: usize = BIN / TILE;
/// Tiles in a bin.
const TILES: usize = SIDE * SIDE;
/// Splats between two tests whether all pixels of a tile have stopped.
const EXIT_EVERY: usize = 16;
/// α never reaches 1, whatever the configuration: T must stay recoverable.
const ALPHA_CEILING: f64 = 1.0 - 1e-6;
/// Numbers in a gradient record of a (bin, splat) pair.
const PAIR: usize = 12;
/// Splats in a reduction task.
const CHUNK: usize = 2048;

/// Splats whose lists of tiles are made at once: a number in a batch is one byte.
const BATCH: usize = 128;
/// Added under the root of a row range, so that rounding never loses a row that a tangent touches.
const CHORD_MARGIN: f64 = 1e-5;

/// A row of pixels.
type Row<F> = [F; TILE];

/// The state of 64 pixels after a pass. Aligned, so that no vector straddles two cache lines.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, Default)]
pub struct Tile<F = f32> {
    color: [[Row<F>; TILE]; CHANNELS],
    /// Transmittance; negated once a pixel has stopped.
    t: [Row<F>; TILE],
    /// 1 + number in the bin's list of the last splat that a pixel met before it stopped; 0: none.
    last: [Row<F>; TILE],
}

/// One splat as the blend loop reads it: o·g = o·2^min(a dx² + b dx dy + c dy², 0).
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, Default)]
struct Record<F> {
    /// Centre relative to the bin's corner.
    x: F,
    y: F,
    /// log₂ e times −½ conic xx, −conic xy, −½ conic yy.
    a: F,
    b: F,
    c: F,
    /// log₂ of o/α_min, of which τ is the multiple: no logarithm is taken here.
    log_ratio: F,
    channels: [F; CHANNELS],
    /// Bit 4·row + column: the tile may be touched.
    mask: u16,
    /// Pixel rows of the bin that the ellipse reaches in each column of tiles: first, one past the last.
    rows: [[u8; 2]; SIDE],
}

/// The blend's limits.
#[derive(Clone, Copy, Debug)]
struct Limits<F> {
    /// log₂ of α's cut-off.
    log_min: F,
    alpha_max: F,
    t_min: F,
}

impl<F: Real> Limits<F> {
    fn new(config: &RenderConfig) -> Self {
        Self {
            log_min: F::of(config.alpha_min.max(ALPHA_FLOOR).log2()),
            alpha_max: F::of(config.alpha_max.min(ALPHA_CEILING)),
            t_min: F::of(config.transmittance_min.max(0.0)),
        }
    }
}

/// What a pass backward does with the gradient to centre, conic and opacity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Geometry {
    /// The first pass.
    Overwrite,
    /// A further pass over the same projection.
    Add,
}

/// Gradients to the picture of one pass; `None` is zero.
#[derive(Clone, Copy, Debug)]
pub struct PixelGrads<'a, F = f32> {
    /// To the channels with background, [height, width] each.
    pub channels: [Option<&'a [F]>; CHANNELS],
    /// To alpha = 1 − T.
    pub alpha: Option<&'a [F]>,
}

/// The rasteriser with all its memory.
#[derive(Debug, Default)]
pub struct Raster<F = f32> {
    /// Sorted lists.
    pub bins: Bins,
    /// Instead of [`PAIR_BUDGET`].
    pub(super) budget: Option<usize>,
    width: usize,
    height: usize,
    simd: Option<Simd>,
    records: Vec<Record<F>>,
    tiles: Vec<Tile<F>>,
    pair_grads: Vec<[F; PAIR]>,
    place: Vec<AtomicU32>,
    backgrounds: Vec<[f64; CHANNELS]>,
}

/// The smaller; unlike `f32::min` one instruction.
#[inline(always)]
fn least<F: Real>(a: F, b: F) -> F {
    if a < b { a } else { b }
}

/// The larger, in one instruction.
#[inline(always)]
fn greatest<F: Real>(a: F, b: F) -> F {
    if a > b { a } else { b }
}

/// One of two values that are both at hand. Without the hint LLVM makes a branch of it, and of the branch a masked
/// store, which costs tens of cycles.
#[inline(always)]
fn select<F: Real>(condition: bool, yes: F, no: F) -> F {
    std::hint::select_unpredictable(condition, yes, no)
}

impl<F: Real> Raster<F> {
    /// Bins, sorts and gathers the splats of a picture of `width` x `height`.
    pub fn prepare(
        &mut self,
        projected: &[Projected<F>],
        footprints: &[Footprint],
        width: usize,
        height: usize,
        simd: Simd,
    ) {
        (self.width, self.height, self.simd) = (width, height, Some(simd));
        self.bins.count(footprints, width, height, self.budget.unwrap_or(PAIR_BUDGET));
        self.tiles.resize(self.bins.bins() * TILES, Tile::default());
        self.gather(projected, footprints, 0);
    }

    /// Sees to it that lists and records are those of run `run`.
    fn hold(&mut self, projected: &[Projected<F>], footprints: &[Footprint], run: usize) {
        if self.bins.current != run {
            self.gather(projected, footprints, run);
        }
    }

    /// Makes lists and records of one run of bins.
    fn gather(&mut self, projected: &[Projected<F>], footprints: &[Footprint], run: usize) {
        let (width, height, simd) = (self.width, self.height, self.simd.unwrap_or(Simd::Scalar));
        self.bins.fill(footprints, projected, run);
        self.records.resize(self.bins.keys.len(), Record::default());
        let bins = &self.bins;
        for_each_group(&bins.starts, Ragged(&mut self.records), &|bin, records| {
            let (x0, y0) = (bin % bins.across * BIN, bin / bins.across * BIN);
            let keys = &bins.keys[bins.starts[bin] as usize..bins.starts[bin + 1] as usize];
            dispatch(simd, Gather { keys, projected, records: records.0, x0, y0, width, height });
        });
    }

    /// Blends four channels; one row of `channels` a splat, the other rows as they were prepared.
    pub fn blend(
        &mut self,
        projected: &[Projected<F>],
        footprints: &[Footprint],
        channels: &[[F; CHANNELS]],
        config: &RenderConfig,
    ) {
        for run in 0..self.bins.runs.len() {
            self.hold(projected, footprints, run);
            self.blend_run(channels, config);
        }
    }

    fn blend_run(&mut self, channels: &[[F; CHANNELS]], config: &RenderConfig) {
        let (simd, bins, limits) = (self.simd.unwrap_or(Simd::Scalar), &self.bins, Limits::new(config));
        let (width, height) = (self.width, self.height);
        let data = (Ragged(&mut self.records), Even(&mut self.tiles, TILES));
        let run = &bins.runs[bins.current];
        for_each_group(&bins.starts, data, &|bin, (records, tiles)| {
            if !run.contains(&bin) {
                return;
            }
            let keys = &bins.keys[bins.starts[bin] as usize..bins.starts[bin + 1] as usize];
            for (r, key) in records.0.iter_mut().zip(keys) {
                r.channels = channels[id(*key)];
            }
            let inside = [width - bin % bins.across * BIN, height - bin / bins.across * BIN];
            dispatch(simd, Blend { records: &*records.0, tiles: tiles.0, inside, limits });
        });
    }

    /// Writes one plane: `f(tile, y)` is row y of a tile's pixels. A row at a time, so that it is a vector's work.
    fn read(&self, plane: &mut [F], f: impl Fn(&Tile<F>, usize) -> Row<F> + Sync) {
        let (w, across) = (self.width, self.bins.across);
        if w == 0 {
            return;
        }
        plane.par_chunks_mut(BIN * w).enumerate().for_each(|(band, pixels)| {
            for (y, row) in pixels.chunks_mut(w).enumerate() {
                for (tx, run) in row.chunks_mut(TILE).enumerate() {
                    let bin = band * across + tx / SIDE;
                    let tile = &self.tiles[bin * TILES + y / TILE * SIDE + tx % SIDE];
                    let values = f(tile, y % TILE);
                    match <&mut Row<F>>::try_from(&mut *run) {
                        Ok(run) => *run = values,
                        Err(_) => run.copy_from_slice(&values[..run.len()]),
                    }
                }
            }
        });
    }

    /// Channel `c` over `background`: Σ c α T + T_end·background, [height, width].
    pub fn channel(&self, c: usize, background: F, plane: &mut [F]) {
        self.read(plane, |tile, y| std::array::from_fn(|x| tile.color[c][y][x] + tile.t[y][x].abs() * background));
    }

    /// 1 − T_end, [height, width].
    pub fn alpha(&self, plane: &mut [F]) {
        self.read(plane, |tile, y| std::array::from_fn(|x| F::ONE - tile.t[y][x].abs()));
    }

    /// VJP of the last [`Raster::blend`] with the same `channels`.
    ///
    /// `d` and `d_channels` have one row a splat. `geometry` says whether `d` is overwritten or added to;
    /// `d_channels` is overwritten. Returns the gradient to the background.
    pub fn backward(
        &mut self,
        projected: &[Projected<F>],
        footprints: &[Footprint],
        channels: &[[F; CHANNELS]],
        background: [F; CHANNELS],
        grads: &PixelGrads<'_, F>,
        config: &RenderConfig,
        geometry: Geometry,
        d: &mut [ProjectedGrads<F>],
        d_channels: &mut [[F; CHANNELS]],
    ) -> [f64; CHANNELS] {
        if geometry == Geometry::Overwrite {
            d.par_chunks_mut(CHUNK).for_each(|d| d.fill(ProjectedGrads::default()));
        }
        d_channels.fill([F::ZERO; CHANNELS]);
        self.backgrounds.clear();
        self.backgrounds.resize(self.bins.bins(), [0.0; CHANNELS]);
        for run in 0..self.bins.runs.len() {
            self.hold(projected, footprints, run);
            self.backward_run(projected, footprints, channels, background, grads, config, d, d_channels);
        }
        let mut total = [0.0; CHANNELS];
        for bin in &self.backgrounds {
            for c in 0..CHANNELS {
                total[c] += bin[c];
            }
        }
        total
    }

    /// [`Raster::backward`] of the current run, added to `d` and `d_channels`.
    fn backward_run(
        &mut self,
        projected: &[Projected<F>],
        footprints: &[Footprint],
        channels: &[[F; CHANNELS]],
        background: [F; CHANNELS],
        grads: &PixelGrads<'_, F>,
        config: &RenderConfig,
        d: &mut [ProjectedGrads<F>],
        d_channels: &mut [[F; CHANNELS]],
    ) {
        let (simd, bins, limits) = (self.simd.unwrap_or(Simd::Scalar), &self.bins, Limits::new(config));
        let (width, height, tiles) = (self.width, self.height, &self.tiles);
        let pairs = bins.keys.len();
        self.pair_grads.resize(pairs, [F::ZERO; PAIR]);
        self.place.resize_with(pairs, AtomicU32::default);
        let (place, run) = (&self.place, &bins.runs[bins.current]);
        let data = (Ragged(&mut self.records), (Ragged(&mut self.pair_grads), Even(&mut self.backgrounds, 1)));
        for_each_group(&bins.starts, data, &|bin, (records, (out, background_out))| {
            if !run.contains(&bin) {
                return;
            }
            let start = bins.starts[bin] as usize;
            let keys = &bins.keys[start..bins.starts[bin + 1] as usize];
            let (bx, by) = (bin % bins.across, bin / bins.across);
            for (i, (r, key)) in records.0.iter_mut().zip(keys).enumerate() {
                let splat = id(*key);
                r.channels = channels[splat];
                // Every slot is written by exactly one task, so that the order of writes cannot matter.
                let slot = bins.first[splat].wrapping_add(footprints[splat].rank(bx, by) as u32);
                place[slot as usize].store((start + i) as u32, Ordering::Relaxed);
            }
            out.0.fill([F::ZERO; PAIR]);
            let kernel = Backward {
                records: &*records.0,
                tiles: &tiles[bin * TILES..(bin + 1) * TILES],
                grads,
                background,
                corner: [bx * BIN, by * BIN],
                size: [width, height],
                limits,
                out: out.0,
            };
            background_out.0[0] = dispatch(simd, kernel);
        });
        // Per splat: its pairs in the order of its bins.
        let pair_grads = &self.pair_grads;
        d.par_chunks_mut(CHUNK).zip(d_channels.par_chunks_mut(CHUNK)).enumerate().for_each(|(chunk, (d, d_ch))| {
            for (i, (d, d_ch)) in d.iter_mut().zip(d_ch).enumerate() {
                let splat = chunk * CHUNK + i;
                let mut sum = [F::ZERO; PAIR];
                for slot in &place[bins.slots(splat, &footprints[splat])] {
                    let pair = &pair_grads[slot.load(Ordering::Relaxed) as usize];
                    for k in 0..PAIR {
                        sum[k] += pair[k];
                    }
                }
                let p = &projected[splat];
                if p.radius > F::ZERO {
                    let [v, vx, vxx, vy, vxy, vyy, abs_x, abs_y, ..] = sum;
                    let [a, b, c] = p.conic;
                    d.mean2d[0] -= a * vx + b * vy;
                    d.mean2d[1] -= b * vx + c * vy;
                    // The records' conic is in powers of 2.
                    d.mean2d_abs[0] += F::of(LN_2) * abs_x;
                    d.mean2d_abs[1] += F::of(LN_2) * abs_y;
                    d.conic[0] -= F::HALF * vxx;
                    d.conic[1] -= vxy;
                    d.conic[2] -= F::HALF * vyy;
                    d.opacity += v / p.opacity;
                    for c in 0..CHANNELS {
                        d_ch[c] += sum[8 + c];
                    }
                }
            }
        });
    }

    /// Pairs of bin and splat.
    pub fn pairs(&self) -> usize {
        self.bins.total as usize
    }

    /// Pixels that the blend loop evaluates for the pairs that are held, were no pixel to stop early.
    pub fn blend_work(&self) -> usize {
        let rows = |r: &Record<F>, t: usize| usize::from(r.mask >> t & 1) * tile_rows(r, t % SIDE, t / SIDE).len();
        self.records.iter().map(|r| (0..TILES).map(|t| rows(r, t)).sum::<usize>() * TILE).sum()
    }

    /// Bytes held.
    pub fn memory_bytes(&self) -> usize {
        self.bins.memory_bytes()
            + self.records.capacity() * size_of::<Record<F>>()
            + 4 * self.place.capacity()
            + self.tiles.capacity() * size_of::<Tile<F>>()
            + self.pair_grads.capacity() * size_of::<[F; PAIR]>()
            + self.backgrounds.capacity() * size_of::<[f64; CHANNELS]>()
    }
}

/// Gathers the records of one bin.
struct Gather<'a, F> {
    keys: &'a [u64],
    projected: &'a [Projected<F>],
    records: &'a mut [Record<F>],
    x0: usize,
    y0: usize,
    width: usize,
    height: usize,
}

impl<F: Real> Kernel for Gather<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let at = |v: usize| F::of(v as f64);
        let zero = [F::ZERO; BLOCK];
        let last_row = (self.height - self.y0).min(BIN) as i32;
        // Sixteen splats at once, so that every step is a loop over lanes.
        for (records, keys) in self.records.chunks_mut(BLOCK).zip(self.keys.chunks(BLOCK)) {
            let [mut x, mut y, mut a, mut b, mut c] = [zero; 5];
            let [mut half_x, mut half_y, mut tau] = [zero; 3];
            for (l, key) in keys.iter().enumerate() {
                let p = &self.projected[id(*key)];
                (x[l], y[l]) = (p.mean2d[0] - at(self.x0), p.mean2d[1] - at(self.y0));
                [a[l], b[l], c[l]] = p.conic;
                (half_x[l], half_y[l], tau[l]) = (p.half[0], p.half[1], p.tau);
            }
            // The ellipse is y = slope·dx ± reach·√(1 − (dx/half_x)²), with its lowest point at dx = summit.
            let [mut slope, mut reach, mut inverse, mut summit] = [zero; 4];
            for l in 0..BLOCK {
                slope[l] = -b[l] / c[l];
                reach[l] = (tau[l] / c[l]).sqrt();
                inverse[l] = F::ONE / half_x[l];
                summit[l] = -b[l] / a[l] * half_y[l];
            }
            let (mut mask, mut rows) = ([0u32; BLOCK], [[[0i32; BLOCK]; 2]; SIDE]);
            for k in 0..SIDE {
                let (left, right) = (k * TILE, (k * TILE + TILE).min(self.width - self.x0));
                if right <= left {
                    break;
                }
                let (left, right) = (at(left) + F::HALF, at(right) - F::HALF);
                let mut meets = [true; BLOCK];
                for (side, sign) in [(0, -F::ONE), (1, F::ONE)] {
                    // Each branch is farthest out as near to its summit as the column comes.
                    for l in 0..BLOCK {
                        let dx = least(greatest(sign * summit[l], left - x[l]), right - x[l]);
                        let u = dx * inverse[l];
                        let square = F::ONE + F::of(CHORD_MARGIN) - u * u;
                        meets[l] &= square >= F::ZERO;
                        let edge = y[l] + slope[l] * dx + sign * reach[l] * greatest(square, F::ZERO).sqrt();
                        // First row whose centre is not above the edge, or one past the last not below it.
                        let row = least(greatest((edge * sign + F::HALF).floor() * sign, F::ZERO), at(BIN));
                        rows[k][side][l] = row.i32().min(last_row);
                    }
                }
                for l in 0..BLOCK {
                    let (first, end) = (rows[k][0][l], rows[k][1][l]);
                    for ty in 0..SIDE {
                        let top = (ty * TILE) as i32;
                        let hit = meets[l] & (first < end) & (first < top + TILE as i32) & (end > top);
                        mask[l] |= u32::from(hit) << (ty * SIDE + k);
                    }
                }
            }
            for (l, record) in records.iter_mut().enumerate() {
                *record = Record {
                    x: x[l],
                    y: y[l],
                    a: F::of(-0.5 * LOG2_E) * a[l],
                    b: F::of(-LOG2_E) * b[l],
                    c: F::of(-0.5 * LOG2_E) * c[l],
                    log_ratio: F::of(0.5 * LOG2_E) * (tau[l] - F::of(TAU_MARGIN)),
                    channels: record.channels,
                    mask: mask[l] as u16,
                    rows: std::array::from_fn(|k| [rows[k][0][l] as u8, rows[k][1][l] as u8]),
                };
            }
        }
    }
}

/// For each tile the numbers of the splats of one batch that may touch it, ascending.
struct Lists {
    numbers: [[u8; BATCH]; TILES],
    counts: [usize; TILES],
}

impl Lists {
    fn new() -> Self {
        Self { numbers: [[0; BATCH]; TILES], counts: [0; TILES] }
    }

    #[inline(always)]
    fn fill<F>(&mut self, records: &[Record<F>]) {
        debug_assert!(records.len() <= BATCH);
        for (t, (numbers, count)) in self.numbers.iter_mut().zip(&mut self.counts).enumerate() {
            let mut n = 0;
            for (i, r) in records.iter().enumerate() {
                // Written always, kept only where the bit is set: no branch to guess.
                numbers[n % BATCH] = i as u8;
                n += usize::from(r.mask >> t & 1);
            }
            *count = n;
        }
    }

    #[inline(always)]
    fn of(&self, t: usize) -> &[u8] {
        &self.numbers[t][..self.counts[t]]
    }
}

/// The rows of tile (tx, ty) that a record can touch.
#[inline(always)]
fn tile_rows<F>(r: &Record<F>, tx: usize, ty: usize) -> std::ops::Range<usize> {
    let (top, [first, end]) = (ty * TILE, r.rows[tx % SIDE]);
    usize::from(first).saturating_sub(top)..usize::from(end).saturating_sub(top).min(TILE)
}

/// Exponents of α and their constants for one splat in one tile.
struct Exponent<F> {
    /// x offsets from the splat's centre.
    dx: Row<F>,
    /// Terms of the exponent along a row: without dy, and times dy.
    ax: Row<F>,
    bx: Row<F>,
    c: F,
    /// y of the centre relative to the tile's first pixel row.
    y: F,
    log_opacity: F,
    /// Row numbers of a tile as floats.
    steps: Row<F>,
}

impl<F: Real> Exponent<F> {
    #[inline(always)]
    fn new<const FMA: bool>(r: &Record<F>, tx: usize, ty: usize, limits: &Limits<F>) -> Self {
        let (dx, log_opacity) = (offsets(r.x, tx), limits.log_min + r.log_ratio);
        let (mut ax, mut bx) = ([F::ZERO; TILE], [F::ZERO; TILE]);
        for l in 0..TILE {
            ax[l] = (r.a * dx[l]).fma::<FMA>(dx[l], log_opacity);
            bx[l] = r.b * dx[l];
        }
        let y = r.y - (F::of((ty * TILE) as f64) + F::HALF);
        let steps = std::array::from_fn(|k| F::of(k as f64));
        Self { dx, ax, bx, c: r.c, y, log_opacity, steps }
    }

    /// log₂ of o·g at lane `l` of a row at offset `dy`; `cy` = c·dy. Rounding may take a needle's above its top.
    #[inline(always)]
    fn at<const FMA: bool>(&self, l: usize, dy: F, cy: F) -> F {
        least((cy + self.bx[l]).fma::<FMA>(dy, self.ax[l]), self.log_opacity)
    }
}

/// x offsets of a tile row's pixels from the splat's centre.
#[inline(always)]
fn offsets<F: Real>(x: F, tx: usize) -> Row<F> {
    std::array::from_fn(|l| x - (F::of((tx * TILE + l) as f64) + F::HALF))
}

/// Forward over one bin.
struct Blend<'a, F> {
    records: &'a [Record<F>],
    tiles: &'a mut [Tile<F>],
    /// Pixels from the bin's corner to the picture's right and lower ends.
    inside: [usize; 2],
    limits: Limits<F>,
}

impl<F: Real> Kernel for Blend<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        // Bit t: tile t has a pixel that has not stopped.
        let mut open = 0u32;
        for (t, tile) in self.tiles.iter_mut().enumerate() {
            *tile = Tile { t: [[F::ONE; TILE]; TILE], ..Tile::default() };
            let nx = self.inside[0].saturating_sub(t % SIDE * TILE);
            let ny = self.inside[1].saturating_sub(t / SIDE * TILE);
            if nx < TILE || ny < TILE {
                // Pixels outside the picture have stopped from the start.
                for (y, row) in tile.t.iter_mut().enumerate() {
                    row[if y < ny { nx.min(TILE) } else { 0 }..].fill(-F::ONE);
                }
            }
            open |= u32::from(nx > 0 && ny > 0) << t;
        }
        let mut lists = Lists::new();
        for (k, batch) in self.records.chunks(BATCH).enumerate() {
            if open == 0 {
                break;
            }
            lists.fill(batch);
            for (t, tile) in self.tiles.iter_mut().enumerate() {
                if open >> t & 1 == 0 {
                    continue;
                }
                for run in lists.of(t).chunks(EXIT_EVERY) {
                    for &i in run {
                        let number = F::of((k * BATCH + usize::from(i) + 1) as f64);
                        let record = &batch[usize::from(i)];
                        blend_splat::<F, FMA>(tile, record, number, t % SIDE, t / SIDE, &self.limits);
                    }
                    if most(&tile.t) < F::ZERO {
                        open &= !(1 << t);
                        break;
                    }
                }
            }
        }
    }
}

#[inline(always)]
fn blend_splat<F: Real, const FMA: bool>(
    tile: &mut Tile<F>,
    r: &Record<F>,
    number: F,
    tx: usize,
    ty: usize,
    limits: &Limits<F>,
) {
    let e = Exponent::new::<FMA>(r, tx, ty, limits);
    for y in tile_rows(r, tx, ty) {
        let dy = e.y - e.steps[y];
        let cy = e.c * dy;
        let (mut t, mut last) = (tile.t[y], tile.last[y]);
        let mut weight = [F::ZERO; TILE];
        for l in 0..TILE {
            let power = e.at::<FMA>(l, dy, cy);
            let alpha = least(power.blend_exp2::<FMA>(), limits.alpha_max);
            let alpha = select(power >= limits.log_min, alpha, F::ZERO);
            // A pixel that has stopped has a negative T and stays below the limit.
            let kept = t[l] * (F::ONE - alpha);
            let open = kept >= limits.t_min;
            weight[l] = select(open, alpha * t[l], F::ZERO);
            // Neither is a choice between the old value and a new one, nor a maximum: LLVM would make masked stores
            // of it, which cost tens of cycles on some machines. Sums of whole numbers are exact.
            t[l] = select(open, kept, -t[l].abs());
            last[l] += select(open, number - last[l], F::ZERO);
        }
        tile.t[y] = t;
        tile.last[y] = last;
        for c in 0..CHANNELS {
            let color = &mut tile.color[c][y];
            for l in 0..TILE {
                color[l] = weight[l].fma::<FMA>(r.channels[c], color[l]);
            }
        }
    }
}

/// Backward over one bin; returns the gradient to the background.
struct Backward<'a, F> {
    records: &'a [Record<F>],
    tiles: &'a [Tile<F>],
    grads: &'a PixelGrads<'a, F>,
    background: [F; CHANNELS],
    corner: [usize; 2],
    size: [usize; 2],
    limits: Limits<F>,
    out: &'a mut [[F; PAIR]],
}

/// What the way back carries for 64 pixels.
#[repr(C, align(64))]
#[derive(Clone, Copy, Default)]
struct Back<F> {
    /// Transmittance behind the splat in hand.
    t: [Row<F>; TILE],
    last: [Row<F>; TILE],
    /// Gradient to the channels.
    g: [[Row<F>; TILE]; CHANNELS],
    /// Σ_ch g_ch·(light from behind)/T, minus the gradient to alpha: one number serves all channels.
    behind: [Row<F>; TILE],
}

impl<F: Real> Kernel for Backward<'_, F> {
    type Out = [f64; CHANNELS];
    #[inline(always)]
    fn run<const FMA: bool>(self) -> [f64; CHANNELS] {
        let mut d_background = [0.0; CHANNELS];
        let (mut backs, mut reach) = ([Back::<F>::default(); TILES], [0; TILES]);
        for t in 0..TILES {
            self.begin(t, &mut backs[t], &mut d_background);
            reach[t] = most(&self.tiles[t].last).f64() as usize;
        }
        let mut sums = [[[F::ZERO; TILE]; PAIR]; BATCH];
        let mut lists = Lists::new();
        for (k, batch) in self.records.chunks(BATCH).enumerate().rev() {
            let first = k * BATCH;
            if reach.iter().all(|&r| r <= first) {
                continue;
            }
            lists.fill(batch);
            sums[..batch.len()].fill([[F::ZERO; TILE]; PAIR]);
            for t in 0..TILES {
                let list = lists.of(t);
                let end = list.partition_point(|&i| first + usize::from(i) < reach[t]);
                for &i in list[..end].iter().rev() {
                    let i = usize::from(i);
                    let (number, sums) = (F::of((first + i + 1) as f64), &mut sums[i]);
                    let (tx, ty) = (t % SIDE, t / SIDE);
                    backward_splat::<F, FMA>(&mut backs[t], &batch[i], number, tx, ty, &self.limits, sums);
                }
            }
            // Lanes are summed once a splat, not once a tile.
            for (out, sums) in self.out[first..].iter_mut().zip(&sums[..batch.len()]) {
                for k in 0..PAIR {
                    out[k] = sum_lanes(sums[k]);
                }
            }
        }
        d_background
    }
}

impl<F: Real> Backward<'_, F> {
    /// Reads the pixels of tile `t` and adds their share of the background's gradient.
    #[inline(always)]
    fn begin(&self, t: usize, back: &mut Back<F>, d_background: &mut [f64; CHANNELS]) {
        let (x0, y0) = (self.corner[0] + t % SIDE * TILE, self.corner[1] + t / SIDE * TILE);
        if x0 >= self.size[0] || y0 >= self.size[1] {
            return;
        }
        let tile = &self.tiles[t];
        let (nx, ny) = ((self.size[0] - x0).min(TILE), (self.size[1] - y0).min(TILE));
        let fetch = |plane: Option<&[F]>| {
            let mut out = [[F::ZERO; TILE]; TILE];
            if let Some(plane) = plane {
                for y in 0..ny {
                    let at = (y0 + y) * self.size[0] + x0;
                    out[y][..nx].copy_from_slice(&plane[at..at + nx]);
                }
            }
            out
        };
        let g: [_; CHANNELS] = std::array::from_fn(|c| fetch(self.grads.channels[c]));
        let alpha = fetch(self.grads.alpha);
        *back = Back { t: tile.t, last: tile.last, g, behind: [[F::ZERO; TILE]; TILE] };
        for y in 0..TILE {
            for x in 0..TILE {
                back.t[y][x] = tile.t[y][x].abs();
                let mut sum = -alpha[y][x];
                for c in 0..CHANNELS {
                    sum += self.background[c] * g[c][y][x];
                }
                back.behind[y][x] = sum;
            }
        }
        for c in 0..CHANNELS {
            let mut rows = [F::ZERO; TILE];
            for y in 0..TILE {
                for x in 0..TILE {
                    rows[x] += back.t[y][x] * g[c][y][x];
                }
            }
            d_background[c] += rows.iter().map(|v| v.f64()).sum::<f64>();
        }
    }
}

/// The largest of 64 values, lanes first.
#[inline(always)]
fn most<F: Real>(rows: &[Row<F>; TILE]) -> F {
    let mut lanes = rows[0];
    for row in &rows[1..] {
        for l in 0..TILE {
            lanes[l] = greatest(row[l], lanes[l]);
        }
    }
    lanes.iter().fold(lanes[0], |m, &v| greatest(v, m))
}

/// Sum of eight lanes, always by the same tree.
#[inline(always)]
fn sum_lanes<F: Real>(v: Row<F>) -> F {
    ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]))
}

#[inline(always)]
fn backward_splat<F: Real, const FMA: bool>(
    back: &mut Back<F>,
    r: &Record<F>,
    number: F,
    tx: usize,
    ty: usize,
    limits: &Limits<F>,
    sums: &mut [Row<F>; PAIR],
) {
    let zero = [F::ZERO; TILE];
    let e = Exponent::new::<FMA>(r, tx, ty, limits);
    let mut ex = zero;
    for l in 0..TILE {
        ex[l] = F::TWO * r.a * e.dx[l];
    }
    // Sums down each column; dx is the same for all rows, so its powers wait until the end.
    let (mut v0, mut v1, mut v2, mut abs_x, mut abs_y) = (zero, zero, zero, zero, zero);
    let mut light = [zero; CHANNELS];
    for y in tile_rows(r, tx, ty) {
        let dy = e.y - e.steps[y];
        let (cy, by) = (e.c * dy, r.b * dy);
        let (mut t, mut behind, last) = (back.t[y], back.behind[y], back.last[y]);
        let g = [back.g[0][y], back.g[1][y], back.g[2][y], back.g[3][y]];
        for l in 0..TILE {
            let power = e.at::<FMA>(l, dy, cy);
            let raw = power.blend_exp2::<FMA>();
            let used = (power >= limits.log_min) & (number <= last[l]);
            let alpha = select(used, least(raw, limits.alpha_max), F::ZERO);
            t[l] /= F::ONE - alpha;
            let mut s = r.channels[0] * g[0][l];
            for c in 1..CHANNELS {
                s = r.channels[c].fma::<FMA>(g[c][l], s);
            }
            let ahead = s - behind[l];
            let weight = alpha * t[l];
            for c in 0..CHANNELS {
                light[c][l] = weight.fma::<FMA>(g[c][l], light[c][l]);
            }
            behind[l] = alpha.fma::<FMA>(ahead, behind[l]);
            // dL/d ln α; nothing passes where α is at its ceiling.
            let v = select(raw <= limits.alpha_max, weight * ahead, F::ZERO);
            let vy = v * dy;
            v0[l] += v;
            v1[l] += vy;
            v2[l] = vy.fma::<FMA>(dy, v2[l]);
            abs_x[l] = v.abs().fma::<FMA>((ex[l] + by).abs(), abs_x[l]);
            abs_y[l] = v.abs().fma::<FMA>((e.bx[l] + (cy + cy)).abs(), abs_y[l]);
        }
        back.t[y] = t;
        back.behind[y] = behind;
    }
    let dx = e.dx;
    let (mut vx, mut vxx, mut vxy) = (zero, zero, zero);
    for l in 0..TILE {
        vx[l] = v0[l] * dx[l];
        vxx[l] = vx[l] * dx[l];
        vxy[l] = v1[l] * dx[l];
    }
    let lanes = [v0, vx, vxx, v1, vxy, v2, abs_x, abs_y, light[0], light[1], light[2], light[3]];
    for k in 0..PAIR {
        for l in 0..TILE {
            sums[k][l] += lanes[k][l];
        }
    }
}
