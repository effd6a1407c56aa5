//! What each splat is to a picture, in walks as forward's that sum one number a splat.
//!
//! Its share is Σ over pixels of α_i T_i, T_i = Π_{j<i} (1 − α_j): the gradient of a channel's sum to that channel,
//! which the way back would compute together with eleven other numbers. The change that its removal makes is Σ over
//! pixels and channels of (α_i T_i (b_i − c_i))², b_i being the colour of all that lies behind: exact for one splat
//! alone (pixels that had stopped stay stopped). A splat before others of its colour has a large share and changes
//! little.

use super::RenderConfig;
use super::behind::{Behind, Pixel, Tally};
use super::bin::{BIN, Footprint, id};
use super::blend::{
    BATCH, Exponent, Limits, PAIR_OF_ROWS, Plane, ROW, Tile, Visit, alpha, begin, columns, highest, pass, strip_range,
    strips, sum_lanes, walk,
};
use super::gather::{Record, SIDE, TILE, TILES};
use super::parallel::{Ragged, for_each_group};
use super::project::Projected;
use super::rasterize::{CHANNELS, CHUNK, Raster};
use super::simd::{Kernel, Simd, dispatch, least};
use crate::math::Real;
use rayon::prelude::*;
use std::marker::PhantomData;
use std::sync::atomic::Ordering;

impl<F: Real> Raster<F> {
    /// Σ α T over the picture of every splat that was prepared, into `out` [splats], which is overwritten. With
    /// `light`, the channels of every splat and the background, of the last [`Raster::blend`]: the squared change if it
    /// were not there.
    pub(super) fn weigh(
        &mut self,
        projected: &[Projected<F>],
        footprints: &[Footprint],
        light: Option<(&[[F; CHANNELS]], [F; CHANNELS])>,
        config: &RenderConfig,
        out: &mut [F],
    ) {
        out.fill(F::ZERO);
        for run in 0..self.bins.runs.len() {
            self.hold(projected, footprints, run);
            self.weigh_run(footprints, light, config, out);
        }
    }

    /// [`Raster::weigh`] of the current run, added to `out`.
    fn weigh_run(
        &mut self,
        footprints: &[Footprint],
        light: Option<(&[[F; CHANNELS]], [F; CHANNELS])>,
        config: &RenderConfig,
        out: &mut [F],
    ) {
        let (simd, bins, limits) = (self.simd.unwrap_or(Simd::Scalar), &self.bins, Limits::new(config));
        let (width, height, tiles) = (self.width, self.height, &self.tiles);
        let pairs = bins.keys.len();
        self.pair_weights.resize(pairs, F::ZERO);
        self.place.resize_with(pairs, Default::default);
        let (place, run) = (&self.place, &bins.runs[bins.current]);
        let data = (Ragged(&mut self.records), Ragged(&mut self.pair_weights));
        for_each_group(&bins.starts, data, &|bin, (records, weights)| {
            if !run.contains(&bin) {
                return;
            }
            let (start, end) = (bins.starts[bin] as usize, bins.starts[bin + 1] as usize);
            let (bx, by) = (bin % bins.across, bin / bins.across);
            for (i, (r, key)) in records.0.iter_mut().zip(&bins.keys[start..end]).enumerate() {
                let splat = id(*key);
                if let Some((channels, _)) = light {
                    r.channels = channels[splat];
                }
                // Every slot is written by exactly one task, so that the order of writes cannot matter.
                let slot = bins.first[splat].wrapping_add(footprints[splat].rank(bx, by) as u32);
                place[slot as usize].store((start + i) as u32, Ordering::Relaxed);
            }
            weights.0.fill(F::ZERO);
            let (records, out) = (&*records.0, weights.0);
            match light {
                None => {
                    let inside = [width - bx * BIN, height - by * BIN];
                    dispatch(simd, Weigh { records, inside, limits, out });
                }
                Some((_, background)) => {
                    let tiles = &tiles[bin * TILES..(bin + 1) * TILES];
                    let inside = [width - bx * BIN, height - by * BIN];
                    let (out, tally) = (out.as_chunks_mut::<1>().0, PhantomData::<Removed>);
                    dispatch(simd, Behind { records, tiles, background, inside, limits, out, tally });
                }
            }
        });
        // Per splat: its pairs in the order of its bins.
        let weights = &self.pair_weights;
        out.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, out)| {
            for (i, out) in out.iter_mut().enumerate() {
                let splat = chunk * CHUNK + i;
                for slot in &place[bins.slots(splat, &footprints[splat])] {
                    *out += weights[slot.load(Ordering::Relaxed) as usize];
                }
            }
        });
    }
}

/// Weighs the splats of one bin.
struct Weigh<'a, F> {
    records: &'a [Record<F>],
    /// Pixels from the bin's corner to the picture's right and lower ends.
    inside: [usize; 2],
    limits: Limits<F>,
    /// One a record; those that no pixel meets are not written.
    out: &'a mut [F],
}

impl<F: Real> Kernel for Weigh<'_, F> {
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

impl<F: Real> Weigh<'_, F> {
    #[inline(always)]
    fn walk<const FMA: bool, const N: usize>(self) {
        let mut tiles = [Tile::default(); TILES];
        let open = begin(&mut tiles, self.inside);
        let ts = tiles.map(|tile| tile.t);
        let sums = [[F::ZERO; TILE]; BATCH];
        let mut visit = Weighing::<F, N> { ts, limits: self.limits, sums, out: self.out };
        walk::<F, _, FMA>(self.records, open, &mut visit);
    }
}

struct Weighing<'a, F, const N: usize> {
    ts: [Plane<F>; TILES],
    limits: Limits<F>,
    /// Sums of a batch's splats over all tiles, column by column.
    sums: [[F; TILE]; BATCH],
    out: &'a mut [F],
}

impl<F: Real, const N: usize> Visit<F> for Weighing<'_, F, N> {
    #[inline(always)]
    fn splat<const FMA: bool>(&mut self, t: usize, i: usize, r: &Record<F>) {
        let (tx, ty, limits) = (t % SIDE, t / SIDE, self.limits);
        let range = strip_range::<N>(r.tile_rows(tx, ty));
        let mut e = Exponent::<F, N>::new::<FMA>(r, tx, ty, range.start, &limits);
        let mut sum = [F::ZERO; N];
        for ts in strips::<F, N>(&mut self.ts[t], range) {
            let mut after = *ts;
            for l in 0..N {
                let power = least(e.raw::<FMA>(l), e.top);
                let weight;
                (after[l], weight, _) = pass(after[l], alpha::<F, FMA>(power, &limits), &limits);
                sum[l] += weight;
                e.step(l);
            }
            *ts = after;
        }
        for (total, v) in self.sums[i].iter_mut().zip(columns(sum)) {
            *total += v;
        }
    }

    #[inline(always)]
    fn stopped(&self, t: usize) -> bool {
        highest(&self.ts[t]) < F::ZERO
    }

    #[inline(always)]
    fn passed(&mut self, first: usize, count: usize) {
        for (out, sums) in self.out[first..].iter_mut().zip(&mut self.sums[..count]) {
            *out = sum_lanes(std::mem::replace(sums, [F::ZERO; TILE]));
        }
    }
}

/// What a pixel would change by without a splat, squared: what lies behind shines through, (1 − α) T b becomes T b.
struct Removed;

impl<F: Real> Tally<F, 1> for Removed {
    #[inline(always)]
    fn of(pixel: &Pixel<F>) -> [F; 1] {
        let mut sum = F::ZERO;
        for c in 0..CHANNELS {
            let change = pixel.hidden[c] - pixel.own[c];
            sum += change * change;
        }
        [sum]
    }
}
