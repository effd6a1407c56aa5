//! Which splats touch which 32² bin of the picture, nearest first.
//!
//! A deterministic two-pass count over fixed chunks of splats, then one sort a bin: a bin's keys stay in cache, where a
//! global sort would scatter. Order inside a bin is (depth, number of the splat).

use super::parallel::{Ragged, for_each_group};
use super::project::Projected;
use crate::math::Real;
use rayon::prelude::*;

/// Pixels across and down a bin.
pub const BIN: usize = 32;
/// Splats in a counting task; fixed, so that the result cannot depend on the number of threads.
const CHUNK: usize = 8192;
/// Bins across and down that a coverage mask holds.
const MASK_SIDE: usize = 8;

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

    /// Calls `f` with every touched bin's number, rows first.
    #[inline(always)]
    fn for_each(&self, across: usize, mut f: impl FnMut(usize)) {
        let corner = usize::from(self.y0) * across + usize::from(self.x0);
        if self.mask != 0 {
            let mut m = self.mask;
            while m != 0 {
                let bit = m.trailing_zeros() as usize;
                f(corner + bit / MASK_SIDE * across + bit % MASK_SIDE);
                m &= m - 1;
            }
            return;
        }
        for y in 0..usize::from(self.y1 - self.y0) {
            for x in 0..usize::from(self.x1 - self.x0) {
                f(corner + y * across + x);
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
    /// Bin b has pairs `starts[b] .. starts[b+1]`.
    pub starts: Vec<u32>,
    /// One a pair: depth bits (of an f32) above, number of the splat below; ascending in each bin.
    pub keys: Vec<u64>,
    /// Splat i has gradient slots `first[i] .. first[i] + count`.
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
    /// Makes the lists for a picture of `width` x `height`.
    ///
    /// Panics: more than 2³² pairs.
    pub fn build<F: Real>(
        &mut self,
        footprints: &[Footprint],
        projected: &[Projected<F>],
        width: usize,
        height: usize,
    ) {
        (self.across, self.down) = (width.div_ceil(BIN), height.div_ceil(BIN));
        let (across, bins) = (self.across, self.across * self.down);
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
                let mut slot = 0u64;
                for (foot, first) in feet.iter().zip(first) {
                    *first = slot as u32;
                    slot += foot.count() as u64;
                    foot.for_each(across, |b| counts[b] += 1);
                }
                *total = u32::try_from(slot).expect("a picture has at most 2^32 pairs of bin and splat");
            },
        );
        for chunk in 0..chunks {
            let end = self.chunk_starts[chunk].checked_add(self.chunk_starts[chunk + 1]);
            self.chunk_starts[chunk + 1] = end.expect("a picture has at most 2^32 pairs of bin and splat");
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
                *first += chunk_starts[chunk];
                let depth = (projected[base + i].depth.f64() as f32).to_bits();
                let key = u64::from(depth) << 32 | (base + i) as u64;
                footprints[base + i].for_each(across, |b| {
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

    /// Bytes held.
    pub fn memory_bytes(&self) -> usize {
        4 * (self.starts.capacity() + self.first.capacity() + self.cursors.capacity() + self.chunk_starts.capacity())
            + 8 * (self.keys.capacity() + self.staged.capacity())
    }
}
