//! Counts what the blend loop did: a slow pass over the lists of the last render, for benchmarks.

use super::{BATCH, BIN, CHANNELS, EXIT_EVERY, Limits, SIDE, TILE, TILES};
use super::{Lists, Raster, Record, Tile, blend_splat, most, tile_rows};
use crate::math::Real;
use crate::render::RenderConfig;
use rayon::prelude::*;

/// Pairs of a pixel and a splat.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PairCounts {
    /// That the blend loop evaluates, lanes outside the picture and pixels that have stopped included.
    pub tested: usize,
    /// Of these: whose α reaches the cut-off before the pixel stops. No blend could do with fewer.
    pub contributing: usize,
}

impl<F: Real> Raster<F> {
    /// What [`Raster::blend`] does with the pairs that are held (all of them, but for absurd scenes).
    pub fn count_pairs(&self, config: &RenderConfig) -> PairCounts {
        let limits = Limits::new(config);
        let counts = self.bins.starts.par_windows(2).enumerate().map(|(bin, pair)| {
            let records = &self.records[pair[0] as usize..pair[1] as usize];
            let (x, y) = (bin % self.bins.across * BIN, bin / self.bins.across * BIN);
            count_bin(records, [self.width - x, self.height - y], &limits)
        });
        counts.reduce(PairCounts::default, |a, b| PairCounts {
            tested: a.tested + b.tested,
            contributing: a.contributing + b.contributing,
        })
    }
}

fn count_bin<F: Real>(records: &[Record<F>], inside: [usize; 2], limits: &Limits<F>) -> PairCounts {
    let mut out = PairCounts::default();
    // As the blend begins: pixels outside the picture have stopped from the start.
    let mut tiles: [Tile<F>; TILES] = std::array::from_fn(|t| {
        let one = |y: usize, x: usize| t % SIDE * TILE + x < inside[0] && t / SIDE * TILE + y < inside[1];
        let t = std::array::from_fn(|y| std::array::from_fn(|x| if one(y, x) { F::ONE } else { -F::ONE }));
        Tile { t, ..Tile::default() }
    });
    let mut open = tiles.map(|tile| most(&tile.t) > F::ZERO);
    let mut lists = Lists::new();
    for batch in records.chunks(BATCH) {
        lists.fill(batch);
        for (t, (tile, open)) in tiles.iter_mut().zip(&mut open).enumerate().filter(|(_, (_, open))| **open) {
            for run in lists.of(t).chunks(EXIT_EVERY) {
                for &i in run {
                    // White light alone: where it grew, the splat was seen.
                    let mut record = batch[usize::from(i)];
                    record.channels = [F::ZERO; CHANNELS];
                    record.channels[0] = F::ONE;
                    tile.color[0] = [[F::ZERO; TILE]; TILE];
                    blend_splat::<F, false>(tile, &record, F::ONE, t % SIDE, t / SIDE, limits);
                    out.tested += tile_rows(&record, t % SIDE, t / SIDE).len() * TILE;
                    out.contributing += tile.color[0].iter().flatten().filter(|v| **v > F::ZERO).count();
                }
                if most(&tile.t) < F::ZERO {
                    *open = false;
                    break;
                }
            }
        }
    }
    out
}
