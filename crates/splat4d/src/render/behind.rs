//! A walk as forward's that knows, at every pixel, the light of all that lies behind each splat: whoever sums something
//! over the pixels that show a splat says what, in a [`Tally`].

use super::blend::{
    BATCH, Exponent, Limits, PAIR_OF_ROWS, ROW, Tile, Visit, alpha, begin, columns, highest, offsets, pass,
    strip_range, strips, sum_lanes, walk,
};
use super::gather::{Record, SIDE, TILE, TILES};
use super::rasterize::CHANNELS;
use super::simd::{Kernel, least, select};
use crate::math::Real;
use std::marker::PhantomData;

/// A splat in a pixel.
pub(super) struct Pixel<F> {
    /// α
    pub(super) alpha: F,
    /// α T c, c the splat's colour.
    pub(super) own: [F; CHANNELS],
    /// α/(1 − α) times what the pixel shows of all that lies behind: α T b. 0 where the pixel has stopped.
    pub(super) hidden: [F; CHANNELS],
    /// Whether α follows the splat here: it does not where nothing is drawn or α is at its ceiling.
    pub(super) felt: bool,
    /// The splat's centre less the pixel's, pixels.
    pub(super) offset: [F; 2],
}

/// `NUMBERS` sums a splat.
pub(super) trait Tally<F, const NUMBERS: usize> {
    /// What one pixel adds.
    fn of(pixel: &Pixel<F>) -> [F; NUMBERS];
}

/// The sums of one bin.
pub(super) struct Behind<'a, F, T, const NUMBERS: usize> {
    pub(super) records: &'a [Record<F>],
    /// As the blend left them.
    pub(super) tiles: &'a [Tile<F>],
    pub(super) background: [F; CHANNELS],
    /// Pixels from the bin's corner to the picture's right and lower ends.
    pub(super) inside: [usize; 2],
    pub(super) limits: Limits<F>,
    /// One a record; those that no pixel meets are not written.
    pub(super) out: &'a mut [[F; NUMBERS]],
    pub(super) tally: PhantomData<T>,
}

impl<F: Real, T: Tally<F, NUMBERS>, const NUMBERS: usize> Kernel for Behind<'_, F, T, NUMBERS> {
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

impl<F: Real, T: Tally<F, NUMBERS>, const NUMBERS: usize> Behind<'_, F, T, NUMBERS> {
    #[inline(always)]
    fn walk<const FMA: bool, const N: usize>(self) {
        let mut tiles = [Tile::default(); TILES];
        let open = begin(&mut tiles, self.inside);
        // From here on a tile's colour is the light that is still to come.
        for (tile, drawn) in tiles.iter_mut().zip(self.tiles) {
            for (c, rest) in tile.color.iter_mut().enumerate() {
                for (rest, (light, t)) in rest.iter_mut().zip(drawn.color[c].iter().zip(&drawn.t)) {
                    *rest = *light + t.abs() * self.background[c];
                }
            }
        }
        let alpha_max = self.limits.ceiling::<FMA>();
        let sums = [[[F::ZERO; TILE]; NUMBERS]; BATCH];
        let (limits, tally, out) = (self.limits, self.tally, self.out);
        let mut visit = Passing::<F, T, N, NUMBERS> { tiles, limits, alpha_max, tally, sums, out };
        walk::<F, _, FMA>(self.records, open, &mut visit);
    }
}

struct Passing<'a, F, T, const N: usize, const NUMBERS: usize> {
    tiles: [Tile<F>; TILES],
    limits: Limits<F>,
    alpha_max: F,
    tally: PhantomData<T>,
    /// Sums of a batch's splats over all tiles, column by column.
    sums: [[[F; TILE]; NUMBERS]; BATCH],
    out: &'a mut [[F; NUMBERS]],
}

impl<F: Real, T: Tally<F, NUMBERS>, const N: usize, const NUMBERS: usize> Visit<F> for Passing<'_, F, T, N, NUMBERS> {
    #[inline(always)]
    fn splat<const FMA: bool>(&mut self, t: usize, i: usize, r: &Record<F>) {
        let (tx, ty, limits) = (t % SIDE, t / SIDE, self.limits);
        let range = strip_range::<N>(r.tile_rows(tx, ty));
        let mut e = Exponent::<F, N>::new::<FMA>(r, tx, ty, range.start, &limits);
        let (channels, mut dy, dx) = (r.channels, e.dy, offsets::<F, N>(r, tx));
        let Tile { t, color } = &mut self.tiles[t];
        let [reds, greens, blues] = color.each_mut().map(|plane| strips::<F, N>(plane, range.clone()));
        let ts = strips::<F, N>(t, range);
        let mut sums = [[F::ZERO; N]; NUMBERS];
        for (((ts, reds), greens), blues) in ts.iter_mut().zip(reds).zip(greens).zip(blues) {
            let (mut after, mut rest) = (*ts, [*reds, *greens, *blues]);
            for l in 0..N {
                let a = alpha::<F, FMA>(least(e.raw::<FMA>(l), e.top), &limits);
                let (kept, weight, open) = pass(after[l], a, &limits);
                after[l] = kept;
                let odds = select(open, a / (F::ONE - a), F::ZERO);
                let (mut own, mut hidden) = ([F::ZERO; CHANNELS], [F::ZERO; CHANNELS]);
                for c in 0..CHANNELS {
                    own[c] = weight * channels[c];
                    rest[c][l] -= own[c];
                    hidden[c] = odds * rest[c][l];
                }
                let felt = open & (a > F::ZERO) & (a < self.alpha_max);
                let adds = T::of(&Pixel { alpha: a, own, hidden, felt, offset: [dx[l], dy[l]] });
                sums.iter_mut().zip(adds).for_each(|(sum, x)| sum[l] += x);
                dy[l] -= e.steps[1];
                e.step(l);
            }
            *ts = after;
            [*reds, *greens, *blues] = rest;
        }
        for (totals, sum) in self.sums[i].iter_mut().zip(sums) {
            for (total, v) in totals.iter_mut().zip(columns(sum)) {
                *total += v;
            }
        }
    }

    #[inline(always)]
    fn stopped(&self, t: usize) -> bool {
        highest(&self.tiles[t].t) < F::ZERO
    }

    #[inline(always)]
    fn passed(&mut self, first: usize, count: usize) {
        for (out, sums) in self.out[first..].iter_mut().zip(&mut self.sums[..count]) {
            *out = std::mem::replace(sums, [[F::ZERO; TILE]; NUMBERS]).map(sum_lanes);
        }
    }
}
