//! Blends sorted splats front to back into 8² tiles, four channels at a time, and the way back.
//!
//! A bin of 32² pixels is one task: its splats are gathered once into records, a 16-bit mask says which of its 16
//! tiles each can touch, and a tile's 64 pixels stay in cache while its splats pass. Any number of channels is any
//! number of passes over the same projection.
//!
//! α = min(α_max, o·g), g = exp(−½ dᵀ conic d); α < α_min is skipped; a pixel stops before T(1−α) would fall below
//! T_min. Source: Kerbl et al. 2023; gradients are 0 where α is at its ceiling, as in gsplat.

use super::RenderConfig;
use super::bin::{BIN, Bins, Footprint, id};
use super::parallel::{Even, Ragged, for_each_group};
use super::project::{Projected, ProjectedGrads, ellipse_distance};
use super::simd::{Kernel, Simd, dispatch};
use crate::math::Real;
use rayon::prelude::*;
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

/// Exponents are not taken below this: e^-60 is far below any cut-off, and no product becomes a slow subnormal.
const POWER_MIN: f64 = -60.0;

/// A row of pixels.
type Row<F> = [F; TILE];

/// The state of 64 pixels after a pass. Aligned, so that no vector straddles two cache lines.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, Default)]
pub struct Tile<F = f32> {
    color: [[Row<F>; TILE]; CHANNELS],
    /// Transmittance; negated once a pixel has stopped.
    t: [Row<F>; TILE],
    /// Number in the bin's list of the last splat that added to a pixel; −1: none.
    last: [Row<F>; TILE],
}

/// One splat as the blend loop reads it.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
struct Record<F> {
    /// Centre relative to the bin's corner.
    x: F,
    y: F,
    /// −½ conic xx, −conic xy, −½ conic yy.
    a: F,
    b: F,
    c: F,
    opacity: F,
    channels: [F; CHANNELS],
    /// Bit 4·row + column: the tile may be touched.
    mask: u16,
    /// Pixel rows of the bin that the ellipse's box holds.
    row0: u8,
    row1: u8,
}

/// The blend's limits.
#[derive(Clone, Copy, Debug)]
struct Limits<F> {
    alpha_min: F,
    alpha_max: F,
    t_min: F,
}

impl<F: Real> Limits<F> {
    fn new(config: &RenderConfig) -> Self {
        Self {
            alpha_min: F::of(config.alpha_min),
            alpha_max: F::of(config.alpha_max.min(ALPHA_CEILING)),
            t_min: F::of(config.transmittance_min),
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
    width: usize,
    height: usize,
    simd: Option<Simd>,
    records: Vec<Record<F>>,
    lists: Vec<u32>,
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
        self.bins.build(footprints, projected, width, height);
        self.records.resize(self.bins.keys.len(), Record::default());
        self.lists.resize(self.bins.keys.len(), 0);
        self.tiles.resize((self.bins.starts.len() - 1) * TILES, Tile::default());
        let bins = &self.bins;
        for_each_group(&bins.starts, Ragged(&mut self.records), &|bin, records| {
            let (x0, y0) = (bin % bins.across * BIN, bin / bins.across * BIN);
            let keys = &bins.keys[bins.starts[bin] as usize..bins.starts[bin + 1] as usize];
            dispatch(simd, Gather { keys, projected, records: records.0, x0, y0, width, height });
        });
    }

    /// Blends four channels; one row of `channels` a splat.
    pub fn blend(&mut self, channels: &[[F; CHANNELS]], config: &RenderConfig) {
        let (simd, bins, limits) = (self.simd.unwrap_or(Simd::Scalar), &self.bins, Limits::new(config));
        let (width, height) = (self.width, self.height);
        let data = (Ragged(&mut self.records), (Ragged(&mut self.lists), Even(&mut self.tiles, TILES)));
        for_each_group(&bins.starts, data, &|bin, (records, (lists, tiles))| {
            let keys = &bins.keys[bins.starts[bin] as usize..bins.starts[bin + 1] as usize];
            for (r, key) in records.0.iter_mut().zip(keys) {
                r.channels = channels[id(*key)];
            }
            let inside = [width - bin % bins.across * BIN, height - bin / bins.across * BIN];
            let (records, list, tiles) = (&*records.0, lists.0, tiles.0);
            dispatch(simd, Blend { records, list, tiles, inside, limits });
        });
    }

    /// Writes one plane: `f(tile state's channel value, T)` of every pixel.
    fn read(&self, plane: &mut [F], f: impl Fn(&Tile<F>, usize, usize) -> F + Sync) {
        let (w, across) = (self.width, self.bins.across);
        if w == 0 {
            return;
        }
        plane.par_chunks_mut(BIN * w).enumerate().for_each(|(band, pixels)| {
            for (y, row) in pixels.chunks_mut(w).enumerate() {
                for (tx, run) in row.chunks_mut(TILE).enumerate() {
                    let bin = band * across + tx / SIDE;
                    let tile = &self.tiles[bin * TILES + y / TILE * SIDE + tx % SIDE];
                    for (x, out) in run.iter_mut().enumerate() {
                        *out = f(tile, y % TILE, x);
                    }
                }
            }
        });
    }

    /// Channel `c` over `background`: Σ c α T + T_end·background, [height, width].
    pub fn channel(&self, c: usize, background: F, plane: &mut [F]) {
        self.read(plane, |tile, y, x| tile.color[c][y][x] + tile.t[y][x].abs() * background);
    }

    /// 1 − T_end, [height, width].
    pub fn alpha(&self, plane: &mut [F]) {
        self.read(plane, |tile, y, x| F::ONE - tile.t[y][x].abs());
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
        let (simd, bins, limits) = (self.simd.unwrap_or(Simd::Scalar), &self.bins, Limits::new(config));
        let (width, height, tiles) = (self.width, self.height, &self.tiles);
        let pairs = bins.keys.len();
        self.pair_grads.resize(pairs, [F::ZERO; PAIR]);
        self.place.resize_with(pairs, AtomicU32::default);
        self.backgrounds.resize(bins.starts.len() - 1, [0.0; CHANNELS]);
        let place = &self.place;
        let data = (
            (Ragged(&mut self.records), Ragged(&mut self.lists)),
            (Ragged(&mut self.pair_grads), Even(&mut self.backgrounds, 1)),
        );
        for_each_group(&bins.starts, data, &|bin, ((records, lists), (out, background_out))| {
            let start = bins.starts[bin] as usize;
            let keys = &bins.keys[start..bins.starts[bin + 1] as usize];
            let (bx, by) = (bin % bins.across, bin / bins.across);
            for (i, (r, key)) in records.0.iter_mut().zip(keys).enumerate() {
                let splat = id(*key);
                r.channels = channels[splat];
                // Every slot is written by exactly one task, so that the order of writes cannot matter.
                let slot = bins.first[splat] as usize + footprints[splat].rank(bx, by);
                place[slot].store((start + i) as u32, Ordering::Relaxed);
            }
            out.0.fill([F::ZERO; PAIR]);
            let kernel = Backward {
                records: &*records.0,
                list: lists.0,
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
                let first = bins.first[splat] as usize;
                for slot in &place[first..first + footprints[splat].count()] {
                    let pair = &pair_grads[slot.load(Ordering::Relaxed) as usize];
                    for k in 0..PAIR {
                        sum[k] += pair[k];
                    }
                }
                if geometry == Geometry::Overwrite {
                    *d = ProjectedGrads::default();
                }
                *d_ch = [F::ZERO; CHANNELS];
                let p = &projected[splat];
                if p.radius > F::ZERO {
                    let [v, vx, vxx, vy, vxy, vyy, abs_x, abs_y, ..] = sum;
                    let [a, b, c] = p.conic;
                    d.mean2d[0] -= a * vx + b * vy;
                    d.mean2d[1] -= b * vx + c * vy;
                    d.mean2d_abs[0] += abs_x;
                    d.mean2d_abs[1] += abs_y;
                    d.conic[0] -= F::HALF * vxx;
                    d.conic[1] -= vxy;
                    d.conic[2] -= F::HALF * vyy;
                    d.opacity += v / p.opacity;
                    d_ch.copy_from_slice(&sum[8..]);
                }
            }
        });
        let mut total = [0.0; CHANNELS];
        for bin in &self.backgrounds {
            for c in 0..CHANNELS {
                total[c] += bin[c];
            }
        }
        total
    }

    /// Pairs of bin and splat.
    pub fn pairs(&self) -> usize {
        self.bins.keys.len()
    }

    /// Pixels that the blend loop evaluates for these pairs, were no pixel to stop early.
    pub fn blend_work(&self) -> usize {
        let tiles =
            |r: &Record<F>, ty: usize| (r.mask >> (ty * SIDE) & 15).count_ones() as usize * tile_rows(r, ty).len();
        self.records.iter().map(|r| (0..SIDE).map(|ty| tiles(r, ty)).sum::<usize>() * TILE).sum()
    }

    /// Bytes held.
    pub fn memory_bytes(&self) -> usize {
        self.bins.memory_bytes()
            + self.records.capacity() * size_of::<Record<F>>()
            + 4 * (self.lists.capacity() + self.place.capacity())
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
        // First and last pixel centres of the tiles, inside the picture; tiles outside get an empty range far away.
        let ends = |corner: usize, size: usize| -> [[F; 2]; SIDE] {
            std::array::from_fn(|k| {
                let low = k * TILE;
                let high = (low + TILE).min(size - corner);
                if high > low { [at(low) + F::HALF, at(high) - F::HALF] } else { [F::ZERO, F::of(-1.0)] }
            })
        };
        let (xs, ys) = (ends(self.x0, self.width), ends(self.y0, self.height));
        let lanes = |ends: &[[F; 2]; SIDE], k: usize, of: fn(usize) -> usize| -> [F; TILES] {
            std::array::from_fn(|t| ends[of(t)][k])
        };
        let (left, right) = (lanes(&xs, 0, |t| t % SIDE), lanes(&xs, 1, |t| t % SIDE));
        let (top, bottom) = (lanes(&ys, 0, |t| t / SIDE), lanes(&ys, 1, |t| t / SIDE));
        let full: u16 = (0..TILES)
            .filter(|t| xs[t % SIDE][0] <= xs[t % SIDE][1] && ys[t / SIDE][0] <= ys[t / SIDE][1])
            .fold(0, |m, t| m | 1 << t);
        for (record, key) in self.records.iter_mut().zip(self.keys) {
            let p = &self.projected[id(*key)];
            let (x, y) = (p.mean2d[0] - at(self.x0), p.mean2d[1] - at(self.y0));
            let (y_slope, x_slope) = (-p.conic[1] / p.conic[2], -p.conic[1] / p.conic[0]);
            let mut q = [F::ZERO; TILES];
            for t in 0..TILES {
                let (rx, ry) = ([left[t] - x, right[t] - x], [top[t] - y, bottom[t] - y]);
                q[t] = ellipse_distance(p.conic, y_slope, x_slope, rx, ry);
            }
            let mut hit = [0u32; TILES];
            for t in 0..TILES {
                hit[t] = u32::from(q[t] <= p.tau) << t;
            }
            let hit = hit.iter().fold(0, |m, h| m | h) as u16;
            let row = |v: F, round: fn(f64) -> f64| round((v - F::HALF).f64()).clamp(-1.0, BIN as f64) as i32;
            *record = Record {
                x,
                y,
                a: -F::HALF * p.conic[0],
                b: -p.conic[1],
                c: -F::HALF * p.conic[2],
                opacity: p.opacity,
                channels: record.channels,
                mask: hit & full,
                row0: row(y - p.half[1], f64::ceil).max(0) as u8,
                row1: (row(y + p.half[1], f64::floor) + 1).clamp(0, BIN as i32) as u8,
            };
        }
    }
}

/// Numbers of the records that may touch tile `t`, in order.
#[inline(always)]
fn tile_list<'a, F>(records: &[Record<F>], list: &'a mut [u32], t: usize) -> &'a [u32] {
    let mut n = 0;
    for (i, r) in records.iter().enumerate() {
        // Written always, kept only where the bit is set: no branch to guess.
        list[n] = i as u32;
        n += usize::from(r.mask >> t & 1);
    }
    &list[..n]
}

/// The rows of tile row `ty` that a record can touch.
#[inline(always)]
fn tile_rows<F>(r: &Record<F>, ty: usize) -> std::ops::Range<usize> {
    let top = ty * TILE;
    usize::from(r.row0).saturating_sub(top)..usize::from(r.row1).saturating_sub(top).min(TILE)
}

/// x offsets of a tile row's pixels from the splat's centre.
#[inline(always)]
fn offsets<F: Real>(x: F, tx: usize) -> Row<F> {
    std::array::from_fn(|l| x - (F::of((tx * TILE + l) as f64) + F::HALF))
}

/// Forward over one bin.
struct Blend<'a, F> {
    records: &'a [Record<F>],
    list: &'a mut [u32],
    tiles: &'a mut [Tile<F>],
    /// Pixels from the bin's corner to the picture's right and lower ends.
    inside: [usize; 2],
    limits: Limits<F>,
}

impl<F: Real> Kernel for Blend<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        for t in 0..TILES {
            let (tx, ty) = (t % SIDE, t / SIDE);
            let tile = &mut self.tiles[t];
            *tile = Tile { t: [[F::ONE; TILE]; TILE], last: [[-F::ONE; TILE]; TILE], ..Tile::default() };
            let nx = self.inside[0].saturating_sub(tx * TILE);
            let ny = self.inside[1].saturating_sub(ty * TILE);
            if nx < TILE || ny < TILE {
                // Pixels outside the picture have stopped from the start.
                for (y, row) in tile.t.iter_mut().enumerate() {
                    row[if y < ny { nx.min(TILE) } else { 0 }..].fill(-F::ONE);
                }
            }
            let list = tile_list(self.records, self.list, t);
            for batch in list.chunks(EXIT_EVERY) {
                for &i in batch {
                    blend_splat::<F, FMA>(tile, &self.records[i as usize], F::of(f64::from(i)), tx, ty, &self.limits);
                }
                if most(&tile.t) < self.limits.t_min.max(F::ZERO) {
                    break;
                }
            }
        }
    }
}

#[inline(always)]
fn blend_splat<F: Real, const FMA: bool>(
    tile: &mut Tile<F>,
    r: &Record<F>,
    index: F,
    tx: usize,
    ty: usize,
    limits: &Limits<F>,
) {
    let dx = offsets(r.x, tx);
    let (mut ax, mut bx) = ([F::ZERO; TILE], [F::ZERO; TILE]);
    for l in 0..TILE {
        ax[l] = r.a * dx[l] * dx[l];
        bx[l] = r.b * dx[l];
    }
    let rows = tile_rows(r, ty);
    let mut center = F::of((ty * TILE + rows.start) as f64) + F::HALF;
    for y in rows {
        let dy = r.y - center;
        center += F::ONE;
        let cy = r.c * dy;
        let (mut t, mut last) = (tile.t[y], tile.last[y]);
        let mut weight = [F::ZERO; TILE];
        for l in 0..TILE {
            let power = greatest(least((cy + bx[l]).fma::<FMA>(dy, ax[l]), F::ZERO), F::of(POWER_MIN));
            let alpha = least(r.opacity * power.blend_exp::<FMA>(), limits.alpha_max);
            let visible = alpha >= limits.alpha_min;
            let open = t[l] * (F::ONE - alpha) >= limits.t_min;
            let used = select(visible & open, alpha, F::ZERO);
            weight[l] = used * t[l];
            // Neither this nor T is written as a choice between the old value and a new one: LLVM would make masked
            // stores of it, which cost tens of cycles on some machines. Sums of whole numbers are exact.
            last[l] += select(used > F::ZERO, index - last[l], F::ZERO);
            let kept = t[l] * (F::ONE - used);
            t[l] = least(kept, select(visible & !open, -kept, kept));
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
    list: &'a mut [u32],
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
        for t in 0..TILES {
            let (tx, ty) = (t % SIDE, t / SIDE);
            let (x0, y0) = (self.corner[0] + tx * TILE, self.corner[1] + ty * TILE);
            if x0 >= self.size[0] || y0 >= self.size[1] {
                continue;
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
            let mut back = Back { t: tile.t, last: tile.last, g, behind: [[F::ZERO; TILE]; TILE] };
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
            let reach = most(&tile.last);
            for c in 0..CHANNELS {
                let mut rows = [F::ZERO; TILE];
                for y in 0..TILE {
                    for x in 0..TILE {
                        rows[x] += back.t[y][x] * g[c][y][x];
                    }
                }
                d_background[c] += rows.iter().map(|v| v.f64()).sum::<f64>();
            }
            let list = tile_list(self.records, self.list, t);
            let end = list.partition_point(|&i| F::of(f64::from(i)) <= reach);
            for &i in list[..end].iter().rev() {
                let r = &self.records[i as usize];
                let index = F::of(f64::from(i));
                backward_splat::<F, FMA>(&mut back, r, index, tx, ty, &self.limits, &mut self.out[i as usize]);
            }
        }
        d_background
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
    index: F,
    tx: usize,
    ty: usize,
    limits: &Limits<F>,
    out: &mut [F; PAIR],
) {
    let zero = [F::ZERO; TILE];
    let dx = offsets(r.x, tx);
    let (mut ax, mut bx, mut ex) = (zero, zero, zero);
    for l in 0..TILE {
        ax[l] = r.a * dx[l] * dx[l];
        bx[l] = r.b * dx[l];
        ex[l] = F::TWO * r.a * dx[l];
    }
    // Sums down each column; dx is the same for all rows, so its powers wait until the end.
    let (mut v0, mut v1, mut v2, mut abs_x, mut abs_y) = (zero, zero, zero, zero, zero);
    let mut light = [zero; CHANNELS];
    let rows = tile_rows(r, ty);
    let mut center = F::of((ty * TILE + rows.start) as f64) + F::HALF;
    for y in rows {
        let dy = r.y - center;
        center += F::ONE;
        let (cy, by, ey) = (r.c * dy, r.b * dy, F::TWO * r.c * dy);
        let (mut t, mut behind, last) = (back.t[y], back.behind[y], back.last[y]);
        let g = [back.g[0][y], back.g[1][y], back.g[2][y], back.g[3][y]];
        for l in 0..TILE {
            let power = greatest(least((cy + bx[l]).fma::<FMA>(dy, ax[l]), F::ZERO), F::of(POWER_MIN));
            let raw = r.opacity * power.blend_exp::<FMA>();
            let clamped = least(raw, limits.alpha_max);
            let used = (clamped >= limits.alpha_min) & (index <= last[l]);
            let alpha = select(used, clamped, F::ZERO);
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
            // dL/d power; nothing passes where α is at its ceiling.
            let v = select(raw <= limits.alpha_max, weight * ahead, F::ZERO);
            let vy = v * dy;
            v0[l] += v;
            v1[l] += vy;
            v2[l] = vy.fma::<FMA>(dy, v2[l]);
            abs_x[l] = v.abs().fma::<FMA>((ex[l] + by).abs(), abs_x[l]);
            abs_y[l] = v.abs().fma::<FMA>((bx[l] + ey).abs(), abs_y[l]);
        }
        back.t[y] = t;
        back.behind[y] = behind;
    }
    let (mut vx, mut vxx, mut vxy) = (zero, zero, zero);
    for l in 0..TILE {
        vx[l] = v0[l] * dx[l];
        vxx[l] = vx[l] * dx[l];
        vxy[l] = v1[l] * dx[l];
    }
    let lanes = [v0, vx, vxx, v1, vxy, v2, abs_x, abs_y, light[0], light[1], light[2], light[3]];
    for k in 0..PAIR {
        out[k] += sum_lanes(lanes[k]);
    }
}
