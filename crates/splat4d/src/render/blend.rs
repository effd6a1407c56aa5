//! Blending one bin of 32² pixels, and the way back.
//!
//! Its 16 tiles of 8² pixels stay in cache while a batch of splats passes: for each tile the batch's bit map says which
//! splats can touch it, and for each of these its rows of pixels go through one loop over eight lanes.
//!
//! α = min(α_max, o·g), g = exp(−½ dᵀ conic d); α < α_min is skipped; a pixel stops before T(1−α) would fall below
//! T_min. Source: Kerbl et al. 2023; gradients are 0 where α is at its ceiling, as in gsplat.
//!
//! Backward walks in the same order as forward, so that it meets the same α, T and stops: what lies behind a splat is
//! what the picture holds less what has passed (as in Taming 3DGS, Mallick et al. 2024). It needs no record of the
//! last splat of a pixel, which would cost the forward pass two memory accesses a pixel and splat.

use super::RenderConfig;
use super::gather::{Record, SIDE, TILE, TILES, greatest, least};
use super::project::ALPHA_FLOOR;
use super::rasterize::{CHANNELS, PixelGrads};
use super::simd::Kernel;
use crate::math::Real;
use std::f64::consts::LN_2;

/// Splats whose bit maps are made at once: one a bit.
const BATCH: usize = 64;
/// Splats of one transposition of bits.
const GROUP: usize = 16;
/// Splats between two tests whether all pixels of a tile have stopped.
const EXIT_EVERY: usize = 16;
/// α never reaches 1, whatever the configuration: T must stay recoverable.
const ALPHA_CEILING: f64 = 1.0 - 1e-6;
/// The smallest T that is told from 0: the way back divides by it.
const T_FLOOR: f64 = 1e-30;

/// A row of pixels.
type Row<F> = [F; TILE];

/// Eight pixels during a pass. In this order, so that neighbouring stores go to the same cache line.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Pixels<F> {
    /// Transmittance; negated once a pixel has stopped.
    pub t: Row<F>,
    /// Σ channel·α·T.
    pub color: [Row<F>; CHANNELS],
}

/// The 64 pixels of a tile.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Tile<F> {
    pub rows: [Pixels<F>; TILE],
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
    pub fn new(config: &RenderConfig) -> Self {
        let log_max = F::of(config.alpha_max.min(ALPHA_CEILING).log2());
        Self {
            log_min: F::of(config.alpha_min.max(ALPHA_FLOOR).log2()),
            log_max,
            t_min: F::of(config.transmittance_min.max(T_FLOOR)),
        }
    }
}

/// One of two values that are both at hand. Without the hint LLVM makes a branch of it, and of the branch a masked
/// store, which costs tens of cycles.
#[inline(always)]
fn select<F: Real>(condition: bool, yes: F, no: F) -> F {
    std::hint::select_unpredictable(condition, yes, no)
}

/// What happens to a splat in a tile.
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

/// log₂ of o·g along the rows of one splat in one tile.
struct Exponent<F> {
    /// x offsets of a row's pixels from the splat's centre.
    dx: Row<F>,
    /// log₂ o + a dx².
    ax: Row<F>,
    /// b dx + c dy of the row in hand.
    q: Row<F>,
    /// dy of the row in hand, once a lane: adding is cheaper than broadcasting.
    dy: Row<F>,
    c: F,
    /// The exponent's ceiling: log₂ of min(o, α_max). Rounding may take a needle's above its top.
    top: F,
}

impl<F: Real> Exponent<F> {
    /// At the first of the tile's rows that are to be visited.
    #[inline(always)]
    fn new<const FMA: bool>(r: &Record<F>, tx: usize, ty: usize, row: usize, limits: &Limits<F>) -> Self {
        let log_opacity = limits.log_min + r.log_ratio;
        let dx: Row<F> = std::array::from_fn(|l| r.x - (F::of((tx * TILE + l) as f64) + F::HALF));
        let dy = r.y - (F::of((ty * TILE + row) as f64) + F::HALF);
        let (mut ax, mut q) = ([F::ZERO; TILE], [F::ZERO; TILE]);
        for l in 0..TILE {
            ax[l] = (r.a * dx[l]).fma::<FMA>(dx[l], log_opacity);
            q[l] = r.c.fma::<FMA>(dy, r.b * dx[l]);
        }
        Self { dx, ax, q, dy: [dy; TILE], c: r.c, top: least(log_opacity, limits.log_max) }
    }

    /// The exponent at lane `l`, not yet under its ceiling.
    #[inline(always)]
    fn raw<const FMA: bool>(&self, l: usize) -> F {
        self.q[l].fma::<FMA>(self.dy[l], self.ax[l])
    }

    /// On to the next row.
    #[inline(always)]
    fn step(&mut self, l: usize) {
        self.q[l] -= self.c;
        self.dy[l] -= F::ONE;
    }
}

/// α at an exponent that is under its ceiling: 0 below the cut-off.
#[inline(always)]
fn alpha<F: Real, const FMA: bool>(power: F, limits: &Limits<F>) -> F {
    select(power >= limits.log_min, power.blend_exp2::<FMA>(), F::ZERO)
}

/// T after a splat of this α, its weight α·T, and whether the pixel is still open. Both directions call this, so that
/// they agree to the last bit.
#[inline(always)]
fn pass<F: Real>(t: F, alpha: F, limits: &Limits<F>) -> (F, F, bool) {
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
    /// Pixels from the bin's corner to the picture's right and lower ends.
    pub inside: [usize; 2],
    pub limits: Limits<F>,
}

impl<F: Real> Kernel for Blend<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let open = begin(self.tiles, self.inside);
        walk::<F, _, FMA>(self.records, open, &mut Forward { tiles: self.tiles, limits: self.limits });
    }
}

/// Tiles before the first splat; bit t of the result: tile t lies in the picture.
#[inline(always)]
pub(super) fn begin<F: Real>(tiles: &mut [Tile<F>], inside: [usize; 2]) -> u32 {
    let mut open = 0;
    for (t, tile) in tiles.iter_mut().enumerate() {
        let nx = inside[0].saturating_sub(t % SIDE * TILE);
        let ny = inside[1].saturating_sub(t / SIDE * TILE);
        for (y, row) in tile.rows.iter_mut().enumerate() {
            *row = Pixels { t: [F::ONE; TILE], ..Pixels::default() };
            // Pixels outside the picture have stopped from the start.
            row.t[if y < ny { nx.min(TILE) } else { 0 }..].fill(-F::ONE);
        }
        open |= u32::from(nx > 0 && ny > 0) << t;
    }
    open
}

/// Blends into tiles.
pub(super) struct Forward<'a, F> {
    pub tiles: &'a mut [Tile<F>],
    pub limits: Limits<F>,
}

impl<F: Real> Visit<F> for Forward<'_, F> {
    #[inline(always)]
    fn splat<const FMA: bool>(&mut self, t: usize, _: usize, r: &Record<F>) {
        let (tx, ty, limits) = (t % SIDE, t / SIDE, &self.limits);
        let rows = r.tile_rows(tx, ty);
        let mut e = Exponent::new::<FMA>(r, tx, ty, rows.start, limits);
        // Copies, of which LLVM knows that no store changes them.
        let (channels, limits) = (r.channels, *limits);
        for px in &mut self.tiles[t].rows[rows] {
            let (mut t, mut weight) = (px.t, [F::ZERO; TILE]);
            for l in 0..TILE {
                let power = least(e.raw::<FMA>(l), e.top);
                (t[l], weight[l], _) = pass(t[l], alpha::<F, FMA>(power, &limits), &limits);
                e.step(l);
            }
            px.t = t;
            for c in 0..CHANNELS {
                let mut color = px.color[c];
                for l in 0..TILE {
                    color[l] = weight[l].fma::<FMA>(channels[c], color[l]);
                }
                px.color[c] = color;
            }
        }
    }

    #[inline(always)]
    fn stopped(&self, t: usize) -> bool {
        highest(self.tiles[t].rows.iter().map(|row| &row.t)) < F::ZERO
    }

    #[inline(always)]
    fn passed(&mut self, _: usize, _: usize) {}
}

/// The largest of 64 transmittances, lanes first.
#[inline(always)]
fn highest<'a, F: Real>(rows: impl Iterator<Item = &'a Row<F>>) -> F {
    let mut lanes = [-F::ONE; TILE];
    for row in rows {
        for l in 0..TILE {
            lanes[l] = greatest(row[l], lanes[l]);
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
/// … and, where asked for, the absolute gradients to the centre.
const ABS: usize = LIGHT + CHANNELS;
/// Numbers in a record.
const NUMBERS: usize = ABS + 2;

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
    pub fn add(&mut self, other: &Self) {
        for k in 0..NUMBERS {
            self.0[k] += other.0[k];
        }
    }

    /// Σ of dL/d ln α.
    #[inline(always)]
    pub fn log_alpha(&self) -> F {
        self.0[V]
    }

    /// To the centre, for a conic xx, xy, yy.
    #[inline(always)]
    pub fn center(&self, [a, b, c]: [F; 3]) -> [F; 2] {
        let (vx, vy) = (self.0[VX], self.0[VY]);
        [-(a * vx + b * vy), -(b * vx + c * vy)]
    }

    /// Σ of |gradient to the centre|, 0 where it was not asked for.
    #[inline(always)]
    pub fn center_abs(&self) -> [F; 2] {
        // The records' conic is in powers of 2.
        [F::of(LN_2) * self.0[ABS], F::of(LN_2) * self.0[ABS + 1]]
    }

    /// To the conic xx, xy, yy.
    #[inline(always)]
    pub fn conic(&self) -> [F; 3] {
        [-F::HALF * self.0[VXX], -self.0[VXY], -F::HALF * self.0[VYY]]
    }

    /// To the channels.
    #[inline(always)]
    pub fn channels(&self) -> [F; CHANNELS] {
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
    /// The picture's width and height.
    pub size: [usize; 2],
    pub limits: Limits<F>,
    /// Whether absolute gradients are wanted.
    pub abs: bool,
    /// One a record; those that no pixel meets are not written.
    pub out: &'a mut [Pair<F>],
}

impl<F: Real> Kernel for Backward<'_, F> {
    type Out = [f64; CHANNELS];
    #[inline(always)]
    fn run<const FMA: bool>(self) -> [f64; CHANNELS] {
        if self.abs { self.walk::<FMA, true>() } else { self.walk::<FMA, false>() }
    }
}

/// What the way back carries for eight pixels.
#[repr(C)]
#[derive(Clone, Copy, Default)]
struct Back<F> {
    /// Transmittance in front of the splat in hand; negated once a pixel has stopped.
    t: Row<F>,
    /// Σ_ch g_ch·(light that is still to come): one number serves all channels and alpha.
    rest: Row<F>,
    /// Gradient to the channels.
    g: [Row<F>; CHANNELS],
}

impl<F: Real> Backward<'_, F> {
    #[inline(always)]
    fn walk<const FMA: bool, const WITH_ABS: bool>(self) -> [f64; CHANNELS] {
        let mut d_background = [0.0; CHANNELS];
        let mut backs = [[Back::<F>::default(); TILE]; TILES];
        let mut open = 0;
        for (t, back) in backs.iter_mut().enumerate() {
            let (x0, y0) = (self.corner[0] + t % SIDE * TILE, self.corner[1] + t / SIDE * TILE);
            if x0 < self.size[0] && y0 < self.size[1] {
                self.begin(t, [x0, y0], back, &mut d_background);
                open |= 1 << t;
            }
        }
        let sums = [[[F::ZERO; TILE]; NUMBERS]; BATCH];
        let rows = [[F::ZERO; TILE]; TILE];
        let (limits, out) = (self.limits, self.out);
        let alpha_max = limits.log_max.blend_exp2::<FMA>();
        let mut visit =
            Behind::<F, WITH_ABS> { backs: &mut backs, limits, alpha_max, alphas: rows, odds: rows, sums, out };
        walk::<F, _, FMA>(self.records, open, &mut visit);
        d_background
    }

    /// Reads the pixels of tile `t` and adds their share of the background's gradient.
    #[inline(always)]
    fn begin(&self, t: usize, [x0, y0]: [usize; 2], back: &mut [Back<F>; TILE], d_background: &mut [f64; CHANNELS]) {
        let (nx, ny) = ((self.size[0] - x0).min(TILE), (self.size[1] - y0).min(TILE));
        let mut ends = [[F::ZERO; TILE]; CHANNELS];
        for (y, (back, px)) in back.iter_mut().zip(&self.tiles[t].rows).enumerate() {
            back.t = [-F::ONE; TILE];
            if y >= ny {
                continue;
            }
            back.t[..nx].fill(F::ONE);
            let at = (y0 + y) * self.size[0] + x0;
            let mut alpha = [F::ZERO; TILE];
            if let Some(plane) = self.grads.alpha {
                alpha[..nx].copy_from_slice(&plane[at..at + nx]);
            }
            for (g, plane) in back.g.iter_mut().zip(self.grads.channels) {
                if let Some(plane) = plane {
                    g[..nx].copy_from_slice(&plane[at..at + nx]);
                }
            }
            for l in 0..TILE {
                let end = px.t[l].abs();
                let mut behind = -alpha[l];
                let mut light = F::ZERO;
                for c in 0..CHANNELS {
                    behind += self.background[c] * back.g[c][l];
                    light += px.color[c][l] * back.g[c][l];
                    ends[c][l] += end * back.g[c][l];
                }
                back.rest[l] = light + end * behind;
            }
        }
        for c in 0..CHANNELS {
            d_background[c] += ends[c].iter().map(|v| v.f64()).sum::<f64>();
        }
    }
}

struct Behind<'a, F, const WITH_ABS: bool> {
    backs: &'a mut [[Back<F>; TILE]; TILES],
    limits: Limits<F>,
    /// α's ceiling as the blend computes it.
    alpha_max: F,
    /// α and α/(1−α) of the splat in hand.
    alphas: [Row<F>; TILE],
    odds: [Row<F>; TILE],
    /// Sums of a batch's splats over all tiles, lane by lane.
    sums: [[Row<F>; NUMBERS]; BATCH],
    out: &'a mut [Pair<F>],
}

impl<F: Real, const WITH_ABS: bool> Visit<F> for Behind<'_, F, WITH_ABS> {
    #[inline(always)]
    fn splat<const FMA: bool>(&mut self, t: usize, i: usize, r: &Record<F>) {
        let (tx, ty, limits) = (t % SIDE, t / SIDE, self.limits);
        let rows = r.tile_rows(tx, ty);
        let mut e = Exponent::new::<FMA>(r, tx, ty, rows.start, &limits);
        // Copies, of which LLVM knows that no store changes them.
        let (channels, b, alpha_max) = (r.channels, r.b, self.alpha_max);
        let (zero, dy0) = ([F::ZERO; TILE], e.dy);
        let mut ex = zero;
        for l in 0..TILE {
            ex[l] = F::TWO * r.a * e.dx[l];
        }
        // In two loops: the second waits for T from splat to splat, and while it does the first, which waits for
        // nothing, fills the core's pipelines. In one loop a row's chain of operations is too long for that.
        for (alphas, odds) in self.alphas.iter_mut().zip(&mut self.odds).take(rows.len()) {
            for l in 0..TILE {
                let a = alpha::<F, FMA>(least(e.raw::<FMA>(l), e.top), &limits);
                alphas[l] = a;
                odds[l] = a / (F::ONE - a);
                e.step(l);
            }
        }
        // Sums down each column; dx is the same for all rows, so its powers wait until the end.
        let (mut v0, mut v1, mut v2, mut abs_x, mut abs_y) = (zero, zero, zero, zero, zero);
        let mut light = [zero; CHANNELS];
        let mut dy = dy0;
        for ((px, alphas), odds) in self.backs[t][rows].iter_mut().zip(&self.alphas).zip(&self.odds) {
            let (mut t, mut rest, g) = (px.t, px.rest, px.g);
            for l in 0..TILE {
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
                // dL/d ln α = w s − α/(1−α)·rest; nothing passes where α is at its ceiling.
                let v = (-odds[l]).fma::<FMA>(rest[l], weight * s);
                let v = select(open & (alphas[l] < alpha_max), v, F::ZERO);
                let vy = v * dy[l];
                v0[l] += v;
                v1[l] += vy;
                v2[l] = vy.fma::<FMA>(dy[l], v2[l]);
                if WITH_ABS {
                    let gx = b.fma::<FMA>(dy[l], ex[l]);
                    let gy = e.c.fma::<FMA>(dy[l] + dy[l], b * e.dx[l]);
                    abs_x[l] = v.abs().fma::<FMA>(gx.abs(), abs_x[l]);
                    abs_y[l] = v.abs().fma::<FMA>(gy.abs(), abs_y[l]);
                }
                dy[l] -= F::ONE;
            }
            (px.t, px.rest) = (t, rest);
        }
        let (dx, sums) = (e.dx, &mut self.sums[i]);
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
            for l in 0..TILE {
                sums[ABS][l] += abs_x[l];
                sums[ABS + 1][l] += abs_y[l];
            }
        }
    }

    #[inline(always)]
    fn stopped(&self, t: usize) -> bool {
        highest(self.backs[t].iter().map(|row| &row.t)) < F::ZERO
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
fn sum_lanes<F: Real>(v: Row<F>) -> F {
    ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]))
}
