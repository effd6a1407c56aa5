//! Blending one bin of 32² pixels, and the backward pass.
//!
//! Its 16 tiles of 8² pixels stay in cache while a batch of splats passes: for each tile the batch's bit map states
//! which splats can touch it, and for each of these its rows of pixels are processed by one loop over eight lanes.
//!
//! α = min(α_max, o·g), g = exp(−½ dᵀ conic d); α < α_min is skipped; a pixel stops before T(1−α) would fall below
//! T_min. Source: Kerbl et al. 2023; gradients are 0 where α is at its maximum, as in gsplat.
//!
//! Backward walks in the same order as forward, so that it meets the same α, T and stops: the colour behind a splat is
//! the pixel's colour minus the sum up to it (as in Taming 3DGS, Mallick et al. 2024). It needs no record of the last
//! splat of a pixel, which would cost the forward pass two memory accesses a pixel and splat.

#[cfg(test)]
mod tests;

use super::RenderConfig;
use super::gather::{CHANNELS, Record, SIDE, TILE, TILES};
use super::simd::{Kernel, each, greatest, least, select};
use crate::math::Real;
use std::f64::consts::LN_2;
use std::ops::Range;

/// Splats whose bit maps are made at once: one a bit.
pub(super) const BATCH: usize = 64;
/// Splats of one transposition of bits.
const GROUP: usize = 16;
/// Splats between two tests whether all pixels of a tile have stopped.
const EXIT_EVERY: usize = 16;
/// The smallest T that differs from 0: the backward pass divides by it.
const T_FLOOR: f64 = 1e-30;

/// Lanes of a strip where a register holds one row of pixels, and where it holds two.
pub(super) const ROW: usize = TILE;
pub(super) const PAIR_OF_ROWS: usize = 2 * TILE;

/// A number of each of a tile's 64 pixels, row by row.
pub(super) type Plane<F> = [F; TILE * TILE];

/// The pixels of a tile.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug)]
pub(super) struct Tile<F> {
    /// Transmittance; negated once per pixel has stopped.
    pub t: Plane<F>,
    /// Σ channel·α·T.
    pub color: [Plane<F>; CHANNELS],
}

impl<F: Real> Default for Tile<F> {
    fn default() -> Self {
        Self { t: [F::ZERO; TILE * TILE], color: [[F::ZERO; TILE * TILE]; CHANNELS] }
    }
}

/// Strips of `N` lanes of a plane.
#[inline(always)]
pub(super) fn strips<F, const N: usize>(plane: &mut Plane<F>, range: Range<usize>) -> &mut [[F; N]] {
    &mut plane.as_chunks_mut().0[range]
}

/// The strips that hold these rows.
#[inline(always)]
pub(super) fn strip_range<const N: usize>(rows: Range<usize>) -> Range<usize> {
    rows.start / (N / TILE)..rows.end.div_ceil(N / TILE)
}

/// The blend's limits.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits<F> {
    /// log₂ of α's cut-off.
    log_min: F,
    /// log₂ of α's ceiling.
    log_max: F,
    t_min: F,
}

impl<F: Real> Limits<F> {
    pub(super) fn new(config: &RenderConfig) -> Self {
        let [least, most] = config.alpha_limits();
        Self {
            log_min: F::of(least.log2()),
            log_max: F::of(most.log2()),
            t_min: F::of(config.transmittance_min.max(T_FLOOR)),
        }
    }

    /// α's ceiling as the blend computes it.
    #[inline(always)]
    pub(crate) fn ceiling<const FMA: bool>(&self) -> F {
        self.log_max.blend_exp2::<FMA>()
    }
}

/// Visitor of splats and tiles, front to back.
pub(super) trait Visit<F: Real> {
    /// Blends record `i` of the batch into tile `t`.
    fn splat<const FMA: bool>(&mut self, t: usize, i: usize, record: &Record<F>);
    /// Whether every pixel of tile `t` has stopped.
    fn stopped(&self, t: usize) -> bool;
    /// A batch that begins at record `first` has passed through all tiles.
    fn passed(&mut self, first: usize, count: usize);
}

/// Shows every record to every tile that it may touch, front to back, until all pixels have stopped. Bit t of `open`:
/// tile t has a pixel that has not.
#[inline(always)]
pub(super) fn walk<F: Real, V: Visit<F>, const FMA: bool>(records: &[Record<F>], mut open: u32, visit: &mut V) {
    for (k, batch) in records.chunks(BATCH).enumerate() {
        if open == 0 {
            break;
        }
        let maps = bit_maps(batch);
        for (t, &map) in maps.iter().enumerate() {
            if open >> t & 1 == 0 {
                continue;
            }
            let (mut rest, mut until_test) = (map, EXIT_EVERY);
            while rest != 0 {
                let i = rest.trailing_zeros() as usize;
                rest &= rest - 1;
                visit.splat::<FMA>(t, i, &batch[i]);
                until_test -= 1;
                if until_test == 0 || rest == 0 {
                    until_test = EXIT_EVERY;
                    if visit.stopped(t) {
                        open &= !(1 << t);
                        break;
                    }
                }
            }
        }
        visit.passed(k * BATCH, batch.len());
    }
}

/// For each tile the splats of a batch that may touch it: a transposition of bits, sixteen splats at a time.
/// Source: Warren, Hacker's Delight, 7-3.
#[inline(always)]
fn bit_maps<F>(batch: &[Record<F>]) -> [u64; TILES] {
    debug_assert!(batch.len() <= BATCH && GROUP == TILES);
    let mut maps = [0; TILES];
    for (g, group) in batch.chunks(GROUP).enumerate() {
        let mut bits = [0u16; GROUP];
        for (bits, r) in bits.iter_mut().zip(group) {
            *bits = r.mask;
        }
        let (mut width, mut keep) = (GROUP / 2, u16::MAX >> (GROUP / 2));
        while width > 0 {
            for first in (0..GROUP).step_by(2 * width) {
                for j in first..first + width {
                    let swap = ((bits[j] >> width) ^ bits[j + width]) & keep;
                    bits[j + width] ^= swap;
                    bits[j] ^= swap << width;
                }
            }
            width /= 2;
            keep ^= keep << width;
        }
        for (map, bits) in maps.iter_mut().zip(bits) {
            *map |= u64::from(bits) << (g * GROUP);
        }
    }
    maps
}

/// log₂ of o·g along the strips of one splat in one tile.
pub(super) struct Exponent<F, const N: usize> {
    /// log₂ o + a dx².
    ax: [F; N],
    /// b dx + c dy of the strip in hand.
    q: [F; N],
    /// dy of the strip in hand, once a lane: adding is cheaper than broadcasting.
    pub dy: [F; N],
    /// Decrements of q and dy from strip to strip.
    pub steps: [F; 2],
    /// The exponent's ceiling: log₂ of min(o, α_max). Rounding may take a needle's above its top.
    pub top: F,
}

/// x offsets of a row's pixels from the splat's centre, strip after strip.
#[inline(always)]
pub(super) fn offsets<F: Real, const N: usize>(r: &Record<F>, tx: usize) -> [F; N] {
    each(|l| r.x - (F::of((tx * TILE + l % TILE) as f64) + F::HALF))
}

impl<F: Real, const N: usize> Exponent<F, N> {
    /// At strip `strip` of the tile.
    #[inline(always)]
    pub(crate) fn new<const FMA: bool>(r: &Record<F>, tx: usize, ty: usize, strip: usize, limits: &Limits<F>) -> Self {
        let log_opacity = limits.log_min + r.log_ratio;
        let rows = N / TILE;
        let first = r.y - (F::of((ty * TILE + strip * rows) as f64) + F::HALF);
        let dx: [F; N] = offsets(r, tx);
        let dy: [F; N] = each(|l| first - F::of((l / TILE) as f64));
        let (mut ax, mut q) = ([F::ZERO; N], [F::ZERO; N]);
        for l in 0..N {
            ax[l] = (r.a * dx[l]).fma::<FMA>(dx[l], log_opacity);
            q[l] = r.c.fma::<FMA>(dy[l], r.b * dx[l]);
        }
        let down = F::of(rows as f64);
        Self { ax, q, dy, steps: [r.c * down, down], top: least(log_opacity, limits.log_max) }
    }

    /// The exponent at lane `l`, not yet under its ceiling.
    #[inline(always)]
    pub(crate) fn raw<const FMA: bool>(&self, l: usize) -> F {
        self.q[l].fma::<FMA>(self.dy[l], self.ax[l])
    }

    /// On to the next strip.
    #[inline(always)]
    pub(crate) fn step(&mut self, l: usize) {
        self.q[l] -= self.steps[0];
        self.dy[l] -= self.steps[1];
    }
}

/// α at an exponent that is under its ceiling: 0 below the cut-off.
#[inline(always)]
pub(super) fn alpha<F: Real, const FMA: bool>(power: F, limits: &Limits<F>) -> F {
    select(power >= limits.log_min, power.blend_exp2::<FMA>(), F::ZERO)
}

/// T after a splat of this α, its weight α·T, and whether the pixel is still open. Both directions call this, so that
/// they agree to the last bit.
#[inline(always)]
pub(super) fn pass<F: Real>(t: F, alpha: F, limits: &Limits<F>) -> (F, F, bool) {
    let weight = alpha * t;
    // A pixel that has stopped has a negative T and stays below the limit.
    let kept = t - weight;
    let open = kept >= limits.t_min;
    (select(open, kept, -t.abs()), select(open, weight, F::ZERO), open)
}

/// Forward over one bin.
pub(super) struct Blend<'a, F> {
    pub records: &'a [Record<F>],
    pub tiles: &'a mut [Tile<F>],
    /// Pixels from the bin's corner to the image's right and lower ends.
    pub inside: [usize; 2],
    pub limits: Limits<F>,
}

impl<F: Real> Kernel for Blend<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        self.walk::<FMA, ROW>();
    }
    #[inline(always)]
    fn run_wide<const FMA: bool>(self) {
        self.walk::<FMA, PAIR_OF_ROWS>();
    }
}

impl<F: Real> Blend<'_, F> {
    #[inline(always)]
    fn walk<const FMA: bool, const N: usize>(self) {
        let open = begin(self.tiles, self.inside);
        walk::<F, _, FMA>(self.records, open, &mut Forward::<F, N> { tiles: self.tiles, limits: self.limits });
    }
}

/// Tiles before the first splat; bit t of the result: tile t is in the image.
#[inline(always)]
pub(super) fn begin<F: Real>(tiles: &mut [Tile<F>], inside: [usize; 2]) -> u32 {
    let mut open = 0;
    for (t, tile) in tiles.iter_mut().enumerate() {
        let nx = inside[0].saturating_sub(t % SIDE * TILE);
        let ny = inside[1].saturating_sub(t / SIDE * TILE);
        *tile = Tile { t: [F::ONE; TILE * TILE], ..Tile::default() };
        if nx < TILE || ny < TILE {
            // Pixels outside the image have stopped from the start.
            for (y, row) in tile.t.chunks_mut(TILE).enumerate() {
                row[if y < ny { nx.min(TILE) } else { 0 }..].fill(-F::ONE);
            }
        }
        open |= u32::from(nx > 0 && ny > 0) << t;
    }
    open
}

/// Blends into tiles, `N` pixels at a time.
pub(super) struct Forward<'a, F, const N: usize> {
    pub tiles: &'a mut [Tile<F>],
    pub limits: Limits<F>,
}

impl<F: Real, const N: usize> Visit<F> for Forward<'_, F, N> {
    #[inline(always)]
    fn splat<const FMA: bool>(&mut self, t: usize, _: usize, r: &Record<F>) {
        let (tx, ty) = (t % SIDE, t / SIDE);
        let range = strip_range::<N>(r.tile_rows(tx, ty));
        let mut e = Exponent::<F, N>::new::<FMA>(r, tx, ty, range.start, &self.limits);
        // Copies, so that LLVM can assume that no store changes them.
        let ([red, green, blue], limits) = (r.channels, self.limits);
        let Tile { t, color } = &mut self.tiles[t];
        let [reds, greens, blues] = color.each_mut().map(|plane| strips::<F, N>(plane, range.clone()));
        let ts = strips::<F, N>(t, range);
        for (((t, reds), greens), blues) in ts.iter_mut().zip(reds).zip(greens).zip(blues) {
            let mut weight = [F::ZERO; N];
            let mut after = *t;
            for l in 0..N {
                let power = least(e.raw::<FMA>(l), e.top);
                (after[l], weight[l], _) = pass(after[l], alpha::<F, FMA>(power, &limits), &limits);
                e.step(l);
            }
            *t = after;
            for (sums, channel) in [(reds, red), (greens, green), (blues, blue)] {
                let mut sum = *sums;
                for l in 0..N {
                    sum[l] = weight[l].fma::<FMA>(channel, sum[l]);
                }
                *sums = sum;
            }
        }
    }

    #[inline(always)]
    fn stopped(&self, t: usize) -> bool {
        highest(&self.tiles[t].t) < F::ZERO
    }

    #[inline(always)]
    fn passed(&mut self, _: usize, _: usize) {}
}

/// The largest of 64 transmittances, lanes first.
#[inline(always)]
pub(super) fn highest<F: Real>(plane: &Plane<F>) -> F {
    let mut lanes = [-F::ONE; PAIR_OF_ROWS];
    for rows in plane.as_chunks::<PAIR_OF_ROWS>().0 {
        for l in 0..PAIR_OF_ROWS {
            lanes[l] = greatest(rows[l], lanes[l]);
        }
    }
    lanes.iter().fold(lanes[0], |m, &v| greatest(v, m))
}

/// Places in a gradient record of a (bin, splat) pair: Σ over pixels of v = dL/d ln α …
const V: usize = 0;
/// … times dx, dx², dy, dx·dy, dy² …
const VX: usize = 1;
const VXX: usize = 2;
const VY: usize = 3;
const VXY: usize = 4;
const VYY: usize = 5;
/// … the channels' gradients …
const LIGHT: usize = 6;
/// … and, where requested, the absolute gradients to the centre.
const ABS: usize = LIGHT + CHANNELS;
/// Numbers in a record.
const NUMBERS: usize = ABS + 2;

/// Gradients to the image of one pass; `None` is zero.
#[derive(Clone, Copy, Debug)]
pub struct PixelGrads<'a, F = f32> {
    /// To the channels with background, [height, width] each.
    pub channels: [Option<&'a [F]>; CHANNELS],
    /// To alpha = 1 − T.
    pub alpha: Option<&'a [F]>,
}

/// Gradients of a (bin, splat) pair.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pair<F>([F; NUMBERS]);

impl<F: Real> Default for Pair<F> {
    fn default() -> Self {
        Self([F::ZERO; NUMBERS])
    }
}

impl<F: Real> Pair<F> {
    /// Adds another bin's.
    #[inline(always)]
    pub(crate) fn add(&mut self, other: &Self) {
        for k in 0..NUMBERS {
            self.0[k] += other.0[k];
        }
    }

    /// Σ of dL/d ln α.
    #[inline(always)]
    pub(crate) fn log_alpha(&self) -> F {
        self.0[V]
    }

    /// To the centre, for a conic xx, xy, yy.
    #[inline(always)]
    pub(crate) fn center(&self, [a, b, c]: [F; 3]) -> [F; 2] {
        let (vx, vy) = (self.0[VX], self.0[VY]);
        [-(a * vx + b * vy), -(b * vx + c * vy)]
    }

    /// Σ of |gradient to the centre|, 0 where it was not requested.
    #[inline(always)]
    pub(crate) fn center_abs(&self) -> [F; 2] {
        // The records' conic is in powers of 2.
        [F::of(LN_2) * self.0[ABS], F::of(LN_2) * self.0[ABS + 1]]
    }

    /// To the conic xx, xy, yy.
    #[inline(always)]
    pub(crate) fn conic(&self) -> [F; 3] {
        [-F::HALF * self.0[VXX], -self.0[VXY], -F::HALF * self.0[VYY]]
    }

    /// To the channels.
    #[inline(always)]
    pub(super) fn channels(&self) -> [F; CHANNELS] {
        std::array::from_fn(|c| self.0[LIGHT + c])
    }
}

/// Backward over one bin, after [`Blend`] of the same; returns the gradient to the background.
pub(super) struct Backward<'a, F> {
    pub records: &'a [Record<F>],
    pub tiles: &'a [Tile<F>],
    pub grads: &'a PixelGrads<'a, F>,
    pub background: [F; CHANNELS],
    /// The bin's first pixel.
    pub corner: [usize; 2],
    /// The image's width and height.
    pub size: [usize; 2],
    pub limits: Limits<F>,
    /// Whether absolute gradients are needed.
    pub abs: bool,
    /// One a record; those that no pixel meets are not written.
    pub out: &'a mut [Pair<F>],
}

impl<F: Real> Kernel for Backward<'_, F> {
    type Out = [f64; CHANNELS];
    #[inline(always)]
    fn run<const FMA: bool>(self) -> [f64; CHANNELS] {
        if self.abs { self.walk::<FMA, ROW, true>() } else { self.walk::<FMA, ROW, false>() }
    }
    #[inline(always)]
    fn run_wide<const FMA: bool>(self) -> [f64; CHANNELS] {
        if self.abs { self.walk::<FMA, PAIR_OF_ROWS, true>() } else { self.walk::<FMA, PAIR_OF_ROWS, false>() }
    }
}

/// State of the backward pass in the pixels of a tile.
#[repr(C, align(64))]
#[derive(Clone, Copy)]
struct Back<F> {
    /// Transmittance in front of the splat in hand; negated once per pixel has stopped.
    t: Plane<F>,
    /// Σ_ch g_ch·(remaining light): one number serves all channels and alpha.
    rest: Plane<F>,
    /// Gradient to the channels.
    g: [Plane<F>; CHANNELS],
}

impl<F: Real> Backward<'_, F> {
    #[inline(always)]
    fn walk<const FMA: bool, const N: usize, const WITH_ABS: bool>(self) -> [f64; CHANNELS] {
        let mut d_background = [0.0; CHANNELS];
        let zero = [F::ZERO; TILE * TILE];
        let mut backs = [Back { t: [-F::ONE; TILE * TILE], rest: zero, g: [zero; CHANNELS] }; TILES];
        let mut open = 0;
        for (t, back) in backs.iter_mut().enumerate() {
            let (x0, y0) = (self.corner[0] + t % SIDE * TILE, self.corner[1] + t / SIDE * TILE);
            if x0 < self.size[0] && y0 < self.size[1] {
                self.begin(t, [x0, y0], back, &mut d_background);
                open |= 1 << t;
            }
        }
        let (limits, out) = (self.limits, self.out);
        let alpha_max = limits.log_max.blend_exp2::<FMA>();
        let sums = [[[F::ZERO; TILE]; NUMBERS]; BATCH];
        let mut visit =
            Returning::<F, N, WITH_ABS> { backs: &mut backs, limits, alpha_max, alphas: zero, odds: zero, sums, out };
        walk::<F, _, FMA>(self.records, open, &mut visit);
        d_background
    }

    /// Reads the pixels of tile `t` and adds their share of the background's gradient.
    #[inline(always)]
    fn begin(&self, t: usize, [x0, y0]: [usize; 2], back: &mut Back<F>, d_background: &mut [f64; CHANNELS]) {
        let (nx, ny) = ((self.size[0] - x0).min(TILE), (self.size[1] - y0).min(TILE));
        let mut alpha = [F::ZERO; TILE * TILE];
        for y in 0..ny {
            let (at, row) = ((y0 + y) * self.size[0] + x0, y * TILE..y * TILE + nx);
            back.t[row.clone()].fill(F::ONE);
            if let Some(plane) = self.grads.alpha {
                alpha[row.clone()].copy_from_slice(&plane[at..at + nx]);
            }
            for (g, plane) in back.g.iter_mut().zip(self.grads.channels) {
                if let Some(plane) = plane {
                    g[row.clone()].copy_from_slice(&plane[at..at + nx]);
                }
            }
        }
        let tile = &self.tiles[t];
        let mut ends = [[F::ZERO; TILE]; CHANNELS];
        for i in 0..TILE * TILE {
            let end = tile.t[i].abs();
            let (mut behind, mut light) = (-alpha[i], F::ZERO);
            for c in 0..CHANNELS {
                behind += self.background[c] * back.g[c][i];
                light += tile.color[c][i] * back.g[c][i];
                ends[c][i % TILE] += end * back.g[c][i];
            }
            back.rest[i] = light + end * behind;
        }
        for c in 0..CHANNELS {
            d_background[c] += ends[c].iter().map(|v| v.f64()).sum::<f64>();
        }
    }
}

/// The backward pass through the tiles.
struct Returning<'a, F, const N: usize, const WITH_ABS: bool> {
    backs: &'a mut [Back<F>; TILES],
    limits: Limits<F>,
    /// α's ceiling as the blend computes it.
    alpha_max: F,
    /// α and α/(1−α) of the splat in hand.
    alphas: Plane<F>,
    odds: Plane<F>,
    /// Sums of a batch's splats over all tiles, column by column.
    sums: [[[F; TILE]; NUMBERS]; BATCH],
    out: &'a mut [Pair<F>],
}

/// Sums of the lanes of one column.
#[inline(always)]
pub(super) fn columns<F: Real, const N: usize>(lanes: [F; N]) -> [F; TILE] {
    let mut out = [F::ZERO; TILE];
    for (k, row) in lanes.as_chunks::<TILE>().0.iter().enumerate() {
        for l in 0..TILE {
            out[l] = if k == 0 { row[l] } else { out[l] + row[l] };
        }
    }
    out
}

impl<F: Real, const N: usize, const WITH_ABS: bool> Visit<F> for Returning<'_, F, N, WITH_ABS> {
    #[inline(always)]
    fn splat<const FMA: bool>(&mut self, t: usize, i: usize, r: &Record<F>) {
        let (tx, ty, limits) = (t % SIDE, t / SIDE, self.limits);
        let range = strip_range::<N>(r.tile_rows(tx, ty));
        let mut e = Exponent::<F, N>::new::<FMA>(r, tx, ty, range.start, &limits);
        // Copies, so that LLVM can assume that no store changes them.
        let (channels, [a, b, c], alpha_max) = (r.channels, [r.a, r.b, r.c], self.alpha_max);
        let (mut dy, dx) = (e.dy, offsets::<F, N>(r, tx));
        // In two loops: the second waits for T from splat to splat, and while it does the first, which waits for
        // nothing, fills the core's pipelines. In one loop a row's chain of operations is too long for that.
        let odds = strips::<F, N>(&mut self.odds, range.clone());
        for (alphas, odds) in strips::<F, N>(&mut self.alphas, range.clone()).iter_mut().zip(odds) {
            for l in 0..N {
                let a = alpha::<F, FMA>(least(e.raw::<FMA>(l), e.top), &limits);
                alphas[l] = a;
                odds[l] = a / (F::ONE - a);
                e.step(l);
            }
        }
        // Sums down each column; dx is the same for all rows, so its powers wait until the end.
        let zero = [F::ZERO; N];
        let (mut v0, mut v1, mut v2, mut abs_x, mut abs_y) = (zero, zero, zero, zero, zero);
        let mut light = [zero; CHANNELS];
        let Back { t, rest, g } = &mut self.backs[t];
        let [g0, g1, g2] = g.each_mut().map(|plane| &*strips::<F, N>(plane, range.clone()));
        let pixels = strips::<F, N>(t, range.clone()).iter_mut().zip(strips::<F, N>(rest, range.clone()));
        let alphas = strips::<F, N>(&mut self.alphas, range.clone());
        let splats = alphas.iter().zip(&*strips::<F, N>(&mut self.odds, range));
        for (((((ts, rests), (alphas, odds)), g0), g1), g2) in pixels.zip(splats).zip(g0).zip(g1).zip(g2) {
            let (mut t, mut rest, g) = (*ts, *rests, [*g0, *g1, *g2]);
            for l in 0..N {
                let (after, weight, open) = pass(t[l], alphas[l], &limits);
                t[l] = after;
                let mut s = channels[0] * g[0][l];
                for c in 1..CHANNELS {
                    s = channels[c].fma::<FMA>(g[c][l], s);
                }
                for c in 0..CHANNELS {
                    light[c][l] = weight.fma::<FMA>(g[c][l], light[c][l]);
                }
                rest[l] = (-weight).fma::<FMA>(s, rest[l]);
                // dL/d ln α = w s − α/(1−α)·rest; nothing passes where α is at its maximum.
                let v = (-odds[l]).fma::<FMA>(rest[l], weight * s);
                let v = select(open & (alphas[l] < alpha_max), v, F::ZERO);
                let vy = v * dy[l];
                v0[l] += v;
                v1[l] += vy;
                v2[l] = vy.fma::<FMA>(dy[l], v2[l]);
                if WITH_ABS {
                    let gx = F::TWO * a * dx[l] + b * dy[l];
                    let gy = b * dx[l] + F::TWO * c * dy[l];
                    abs_x[l] += v.abs() * gx.abs();
                    abs_y[l] += v.abs() * gy.abs();
                }
                dy[l] -= e.steps[1];
            }
            (*ts, *rests) = (t, rest);
        }
        let (v0, v1, v2) = (columns(v0), columns(v1), columns(v2));
        // Not `light.map`: see `each`.
        let (light, dx): ([_; CHANNELS], _) = (each(|c| columns(light[c])), offsets::<F, TILE>(r, tx));
        let sums = &mut self.sums[i];
        for l in 0..TILE {
            let vx = v0[l] * dx[l];
            sums[V][l] += v0[l];
            sums[VX][l] += vx;
            sums[VXX][l] += vx * dx[l];
            sums[VY][l] += v1[l];
            sums[VXY][l] += v1[l] * dx[l];
            sums[VYY][l] += v2[l];
        }
        for c in 0..CHANNELS {
            for l in 0..TILE {
                sums[LIGHT + c][l] += light[c][l];
            }
        }
        if WITH_ABS {
            let (x, y) = (columns(abs_x), columns(abs_y));
            for l in 0..TILE {
                sums[ABS][l] += x[l];
                sums[ABS + 1][l] += y[l];
            }
        }
    }

    #[inline(always)]
    fn stopped(&self, t: usize) -> bool {
        highest(&self.backs[t].t) < F::ZERO
    }

    #[inline(always)]
    fn passed(&mut self, first: usize, count: usize) {
        // Lanes are summed once a splat, not once a tile.
        let numbers = if WITH_ABS { NUMBERS } else { ABS };
        for (out, sums) in self.out[first..].iter_mut().zip(&mut self.sums[..count]) {
            for k in 0..numbers {
                out.0[k] = sum_lanes(sums[k]);
                sums[k] = [F::ZERO; TILE];
            }
        }
    }
}

/// Sum of eight lanes, always by the same tree.
#[inline(always)]
pub(super) fn sum_lanes<F: Real>(v: [F; TILE]) -> F {
    ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]))
}
