//! Which splats touch which 32² bin of the picture, nearest first.
//!
//! A deterministic two-pass count over fixed chunks of splats, then one sort a bin: a bin's keys stay in cache, where a
//! global sort would scatter. Order inside a bin is (depth, number of the splat).

use super::parallel::{Ragged, for_each_group};
use super::project::Projected;
use crate::math::Real;
use rayon::prelude::*;
use std::ops::Range;

/// Pixels across and down a bin.
pub const BIN: usize = 32;
/// Splats in a counting task; fixed, so that the result cannot depend on the number of threads.
const CHUNK: usize = 8192;
/// Bins across and down that a coverage mask holds.
const MASK_SIDE: usize = 8;

/// Pairs of bin and splat that are held at once. A picture with more is drawn in runs of bins, each of at most this
/// many pairs (or a single bin, whose pairs are at most the splats). A pair holds about 130 bytes in f32 with
/// gradients, so this is about 2 GiB; ordinary scenes of a million splats have a fifth of it.
pub const PAIR_BUDGET: usize = 1 << 24;

/// The bins one splat can touch. Plain old data, 16 bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Footprint {
    /// First bin, x.
    pub x0: u16,
    /// One past the last bin, x.
    pub x1: u16,
    /// First bin, y.
    pub y0: u16,
    /// One past the last bin, y.
    pub y1: u16,
    /// Bit 8·row + column of the rectangle: the ellipse holds a pixel centre of that bin. 0: all of the rectangle,
    /// which is larger than 8x8.
    pub mask: u64,
}

impl Footprint {
    /// Number of bins touched; 0 for a culled splat.
    #[inline(always)]
    pub fn count(&self) -> usize {
        if self.mask != 0 {
            return self.mask.count_ones() as usize;
        }
        usize::from(self.x1 - self.x0) * usize::from(self.y1 - self.y0)
    }

    /// How many touched bins come before bin (x, y), which is one of them.
    #[inline(always)]
    pub fn rank(&self, x: usize, y: usize) -> usize {
        let (x, y) = (x - usize::from(self.x0), y - usize::from(self.y0));
        if self.mask != 0 {
            return (self.mask & ((1u64 << (y * MASK_SIDE + x)) - 1)).count_ones() as usize;
        }
        y * usize::from(self.x1 - self.x0) + x
    }

    /// How many touched bins have a number below `bin`, bins being numbered by rows of `across`.
    #[inline(always)]
    fn below(&self, bin: usize, across: usize) -> usize {
        // The two cases of a run of all bins come first, without a division.
        if bin <= usize::from(self.y0) * across {
            return 0;
        }
        if bin >= usize::from(self.y1) * across {
            return self.count();
        }
        let (x, y) = (bin % across, bin / across);
        let (column, row) = (x.clamp(self.x0.into(), self.x1.into()) - usize::from(self.x0), y - usize::from(self.y0));
        if self.mask != 0 {
            return (u128::from(self.mask) & ((1 << (row * MASK_SIDE + column)) - 1)).count_ones() as usize;
        }
        row * usize::from(self.x1 - self.x0) + column
    }

    /// Calls `f` with the number of every touched bin of `run`, ascending.
    #[inline(always)]
    fn for_each(&self, across: usize, run: &Range<usize>, mut f: impl FnMut(usize)) {
        let corner = usize::from(self.y0) * across + usize::from(self.x0);
        if self.mask != 0 {
            let mut m = self.mask;
            while m != 0 {
                let bit = m.trailing_zeros() as usize;
                let bin = corner + bit / MASK_SIDE * across + bit % MASK_SIDE;
                if run.contains(&bin) {
                    f(bin);
                }
                m &= m - 1;
            }
            return;
        }
        let rows = usize::from(self.y0).max(run.start / across)..usize::from(self.y1).min(run.end.div_ceil(across));
        for y in rows {
            let (x0, x1) = (y * across + usize::from(self.x0), y * across + usize::from(self.x1));
            for bin in x0.max(run.start)..x1.min(run.end) {
                f(bin);
            }
        }
    }
}

/// Sorted lists of splats, one a bin; every buffer is kept from step to step.
#[derive(Debug, Default)]
pub struct Bins {
    /// Bins across.
    pub across: usize,
    /// Bins down.
    pub down: usize,
    /// All bins in parts of which one at a time is held; one part but for absurd scenes.
    pub runs: Vec<Range<usize>>,
    /// Number of the run that is held.
    pub current: usize,
    /// Pairs of all runs together.
    pub total: u64,
    /// Bin b has pairs `starts[b] .. starts[b+1]`: none outside the current run.
    pub starts: Vec<u32>,
    /// One a pair: depth bits (of an f32) above, number of the splat below; ascending in each bin.
    pub keys: Vec<u64>,
    /// The pair of splat i in the bin of rank r has gradient slot `first[i] + r`, wrapping.
    pub first: Vec<u32>,
    /// Pairs of each chunk of splats by bin: first counts, then the end of that bin's run in `staged`.
    cursors: Vec<u32>,
    /// Where each chunk's pairs start.
    chunk_starts: Vec<u32>,
    /// Pairs by chunk, by bin in the chunk.
    staged: Vec<u64>,
}

/// The splat a key names.
#[inline(always)]
pub fn id(key: u64) -> usize {
    (key & u64::from(u32::MAX)) as usize
}

impl Bins {
    /// Divides a picture of `width` x `height` into runs of bins of at most `budget` pairs each.
    pub fn count(&mut self, footprints: &[Footprint], width: usize, height: usize, budget: usize) {
        assert!(u32::try_from(footprints.len()).is_ok(), "a key holds the number of a splat in 32 bits");
        (self.across, self.down) = (width.div_ceil(BIN), height.div_ceil(BIN));
        let bins = self.bins();
        self.total = footprints.par_iter().with_min_len(CHUNK).map(|f| f.count() as u64).sum();
        self.runs.clear();
        if self.total <= budget as u64 {
            self.runs.push(0..bins);
            return;
        }
        let mut first = 0;
        let mut held = 0;
        for (bin, pairs) in self.pairs_by_bin(footprints).into_iter().enumerate() {
            if bin > first && held + pairs > budget as u64 {
                self.runs.push(first..bin);
                (first, held) = (bin, 0);
            }
            held += pairs;
        }
        self.runs.push(first..bins);
    }

    /// Pairs of every bin, in time that does not grow with the size of large footprints.
    fn pairs_by_bin(&self, footprints: &[Footprint]) -> Vec<u64> {
        let (across, stride) = (self.across, self.across + 1);
        let mut counts = vec![0u64; self.bins()];
        // A large rectangle is four corners of a table of differences; sums wrap back.
        let mut corners = vec![0u64; stride * (self.down + 1)];
        for foot in footprints {
            if foot.mask != 0 {
                foot.for_each(across, &(0..self.bins()), |b| counts[b] += 1);
                continue;
            }
            let [x0, x1, y0, y1] = [foot.x0, foot.x1, foot.y0, foot.y1].map(usize::from);
            for (x, y, step) in [(x0, y0, 1), (x1, y1, 1), (x1, y0, u64::MAX), (x0, y1, u64::MAX)] {
                corners[y * stride + x] = corners[y * stride + x].wrapping_add(step);
            }
        }
        for y in 0..self.down {
            let mut row = 0u64;
            for x in 0..across {
                row = row.wrapping_add(corners[y * stride + x]);
                // What has been summed so far stands where the next row looks.
                let above = if y > 0 { corners[(y - 1) * stride + x] } else { 0 };
                corners[y * stride + x] = row.wrapping_add(above);
                counts[y * across + x] += corners[y * stride + x];
            }
        }
        counts
    }

    /// Number of bins.
    pub fn bins(&self) -> usize {
        self.across * self.down
    }

    /// Makes the lists of run `run`.
    pub fn fill<F: Real>(&mut self, footprints: &[Footprint], projected: &[Projected<F>], run: usize) {
        self.current = run;
        let run = self.runs[run].clone();
        let (across, bins) = (self.across, self.bins());
        let chunks = footprints.len().div_ceil(CHUNK);
        self.cursors.clear();
        self.cursors.resize(chunks * bins, 0);
        self.first.resize(footprints.len(), 0);
        self.starts.clear();
        self.starts.resize(bins + 1, 0);
        self.chunk_starts.clear();
        self.chunk_starts.resize(chunks + 1, 0);
        if bins == 0 || chunks == 0 {
            self.keys.clear();
            return;
        }
        // First pass: count by chunk and bin; slots are numbered from 0 in each chunk.
        let counting = self.cursors.par_chunks_mut(bins).zip(self.chunk_starts[1..].par_iter_mut());
        counting.zip(footprints.par_chunks(CHUNK).zip(self.first.par_chunks_mut(CHUNK))).for_each(
            |((counts, total), (feet, first))| {
                let mut slot = 0u32;
                for (foot, first) in feet.iter().zip(first) {
                    let before = foot.below(run.start, across) as u32;
                    *first = slot.wrapping_sub(before);
                    slot += foot.below(run.end, across) as u32 - before;
                    foot.for_each(across, &run, |b| counts[b] += 1);
                }
                *total = slot;
            },
        );
        for chunk in 0..chunks {
            self.chunk_starts[chunk + 1] += self.chunk_starts[chunk];
        }
        for counts in self.cursors.chunks(bins) {
            for (start, count) in self.starts[1..].iter_mut().zip(counts) {
                *start += count;
            }
        }
        for b in 0..bins {
            self.starts[b + 1] += self.starts[b];
        }
        let pairs = self.starts[bins] as usize;
        self.staged.resize(pairs, 0);
        self.keys.resize(pairs, 0);
        // Second pass: each chunk fills its own run, by bin.
        let chunk_starts = &self.chunk_starts;
        let data = (
            Ragged(&mut self.staged),
            (super::parallel::Even(&mut self.cursors, bins), super::parallel::Even(&mut self.first, CHUNK)),
        );
        for_each_group(chunk_starts, data, &|chunk, (staged, (cursors, first))| {
            let mut sum = 0;
            for c in cursors.0.iter_mut() {
                sum += std::mem::replace(c, sum);
            }
            let base = chunk * CHUNK;
            for (i, first) in first.0.iter_mut().enumerate() {
                *first = first.wrapping_add(chunk_starts[chunk]);
                let depth = (projected[base + i].depth.f64() as f32).to_bits();
                let key = u64::from(depth) << 32 | (base + i) as u64;
                footprints[base + i].for_each(across, &run, |b| {
                    staged.0[cursors.0[b] as usize] = key;
                    cursors.0[b] += 1;
                });
            }
        });
        // Each bin collects its runs and sorts them.
        let (staged, cursors) = (&self.staged, &self.cursors);
        for_each_group(&self.starts, Ragged(&mut self.keys), &|bin, keys| {
            let mut at = 0;
            for chunk in 0..chunks {
                let ends = &cursors[chunk * bins..(chunk + 1) * bins];
                let begin = if bin == 0 { 0 } else { ends[bin - 1] as usize };
                let base = chunk_starts[chunk] as usize;
                let run = &staged[base + begin..base + ends[bin] as usize];
                keys.0[at..at + run.len()].copy_from_slice(run);
                at += run.len();
            }
            keys.0.sort_unstable();
        });
    }

    /// Gradient slots of a splat in the current run.
    #[inline(always)]
    pub fn slots(&self, splat: usize, foot: &Footprint) -> Range<usize> {
        let run = &self.runs[self.current];
        let (before, end) = (foot.below(run.start, self.across), foot.below(run.end, self.across));
        let first = self.first[splat].wrapping_add(before as u32) as usize;
        first..first + (end - before)
    }

    /// Bytes held.
    pub fn memory_bytes(&self) -> usize {
        4 * (self.starts.capacity() + self.first.capacity() + self.cursors.capacity() + self.chunk_starts.capacity())
            + 8 * (self.keys.capacity() + self.staged.capacity())
    }
}
