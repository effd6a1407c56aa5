//! Lists of the splats that touch each 32² bin of the image, nearest first.
//!
//! A deterministic two-pass count over fixed chunks of splats, then one sort a bin: a bin's keys stay in cache, where a
//! global sort would scatter. Order inside a bin is (depth, number of the splat).

use super::parallel::{Ragged, for_each_group};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

#[cfg(test)]
mod tests;

/// Pixels across and down a bin.
pub(crate) const BIN: usize = 32;
/// Splats in a counting task; fixed, so that the result cannot depend on the number of threads.
const CHUNK: usize = 8192;
/// Bins across and down that a coverage mask holds.
pub(super) const MASK_SIDE: usize = 8;
/// Set in a footprint's first column: it is a rectangle larger than a mask.
const LARGE: u16 = 1 << 15;

/// Pairs of bin and splat that are held at once. An image with more is rendered in runs of bins, each of at most this
/// many pairs (or a single bin, whose pairs are at most the splats). A pair holds about 130 bytes in f32 with
/// gradients, so this is about 2 GiB; ordinary scenes of a million splats have a fifth of it.
pub(crate) const PAIR_BUDGET: usize = 1 << 24;

/// One splat's entry for the lists: the bins that it can touch, and its depth. Plain old data, 16 bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Footprint {
    /// First column of bins; [`LARGE`] states what `cover` is.
    x0: u16,
    /// First row of bins.
    y0: u16,
    /// Bits of the depth as an f32, which is positive: they sort as it does.
    depth: u32,
    /// Bit 8·row + column: the ellipse holds a pixel centre of that bin. Of a rectangle larger than 8x8: one past its
    /// last column, and from bit 16 on one past its last row.
    cover: u64,
}

impl Footprint {
    /// The bins of `mask` (bit 8·row + column) from bin `first` on.
    #[inline(always)]
    pub(super) fn masked(first: [usize; 2], mask: u64, depth: f32) -> Self {
        Self { x0: first[0] as u16, y0: first[1] as u16, depth: depth.to_bits(), cover: mask }
    }

    /// All bins of columns `x0..x1` and rows `y0..y1`.
    #[inline(always)]
    pub(super) fn rectangle([x0, x1, y0, y1]: [usize; 4], depth: f32) -> Self {
        Self { x0: x0 as u16 | LARGE, y0: y0 as u16, depth: depth.to_bits(), cover: (x1 | y1 << 16) as u64 }
    }

    /// Columns and rows of a rectangle larger than a mask.
    #[inline(always)]
    pub(super) fn large(&self) -> Option<[usize; 4]> {
        let (x1, y1) = (self.cover as u16, (self.cover >> 16) as u16);
        (self.x0 & LARGE != 0).then(|| [self.x0 & !LARGE, x1, self.y0, y1].map(usize::from))
    }

    /// Whether no bin is touched.
    #[inline(always)]
    pub(crate) fn is_empty(&self) -> bool {
        self.cover == 0
    }

    /// Number of bins touched; 0 for a culled splat.
    #[inline(always)]
    pub(crate) fn count(&self) -> usize {
        match self.large() {
            None => self.cover.count_ones() as usize,
            Some([x0, x1, y0, y1]) => (x1 - x0) * (y1 - y0),
        }
    }

    /// Number of touched bins before bin (x, y), which is one of them.
    #[inline(always)]
    pub(crate) fn rank(&self, x: usize, y: usize) -> usize {
        match self.large() {
            None => {
                let bit = (y - usize::from(self.y0)) * MASK_SIDE + x - usize::from(self.x0);
                (self.cover & ((1u64 << bit) - 1)).count_ones() as usize
            }
            Some([x0, x1, y0, _]) => (y - y0) * (x1 - x0) + x - x0,
        }
    }

    /// Number of touched bins that have a number below `bin`, bins being numbered by rows of `across`.
    #[inline(always)]
    fn below(&self, bin: usize, across: usize) -> usize {
        let y0 = usize::from(self.y0);
        // The two cases of a run of all bins come first, without a division.
        if bin <= y0 * across {
            return 0;
        }
        let large = self.large();
        let end = large.map_or(y0 + MASK_SIDE, |[.., y1]| y1);
        if bin >= end * across {
            return self.count();
        }
        let (x, row) = (bin % across, bin / across - y0);
        match large {
            None => {
                let x0 = usize::from(self.x0);
                let bit = row * MASK_SIDE + x.clamp(x0, x0 + MASK_SIDE) - x0;
                (u128::from(self.cover) & ((1 << bit) - 1)).count_ones() as usize
            }
            Some([x0, x1, ..]) => row * (x1 - x0) + x.clamp(x0, x1) - x0,
        }
    }

    /// The numbers of all touched bins of an image.
    #[cfg(test)]
    pub(super) fn numbers(&self, across: usize, down: usize) -> Vec<usize> {
        let (mut all, mut out) = ((0..across * down).collect::<Vec<usize>>(), Vec::new());
        self.for_each(across, 0, &mut all, |bin| out.push(*bin));
        out
    }

    /// Calls `f` with what `cells` has for every touched bin, ascending; `cells` holds the bins from `first` on, other
    /// bins are left out.
    #[inline(always)]
    fn for_each<T>(&self, across: usize, first: usize, cells: &mut [T], mut f: impl FnMut(&mut T)) {
        if let Some([x0, x1, y0, y1]) = self.large() {
            let end = first + cells.len();
            for y in y0.max(first / across)..y1.min(end.div_ceil(across)) {
                let (from, to) = ((y * across + x0).max(first), (y * across + x1).min(end));
                if from < to {
                    cells[from - first..to - first].iter_mut().for_each(&mut f);
                }
            }
            return;
        }
        // A bin before the first one wraps to a number that `cells` does not have.
        let corner = (usize::from(self.y0) * across + usize::from(self.x0)).wrapping_sub(first);
        let mut mask = self.cover;
        while mask != 0 {
            let bit = mask.trailing_zeros() as usize;
            if let Some(cell) = cells.get_mut(corner.wrapping_add(bit / MASK_SIDE * across + bit % MASK_SIDE)) {
                f(cell);
            }
            mask &= mask - 1;
        }
    }
}

/// Sorted lists of splats, one per bin; every buffer is kept from step to step.
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
    /// Of each chunk of splats and each bin: first the pairs, then the index of the next one in `staged`.
    cursors: Vec<u32>,
    /// Scratch: the next position of each bin.
    next: Vec<u32>,
    /// Gradient slots before each chunk.
    chunk_starts: Vec<u32>,
    /// Keys by bin, not yet sorted. Every position is written by exactly one task.
    staged: Vec<AtomicU64>,
}

/// The splat a key names.
#[inline(always)]
pub(crate) fn id(key: u64) -> usize {
    (key & u64::from(u32::MAX)) as usize
}

/// Bits of a digit by which a bin of few keys, and of many, is sorted: the counts stay in the first-level cache.
const DIGIT_BITS: [u32; 2] = [8, 11];
/// Keys from which digits are wide: the counts cost less than what they save.
const MANY: usize = 4096;
/// Keys up to which a sort is insertions only.
const FEW: usize = 24;
/// Moves a key that insertions may take on the whole before a comparison sort takes over, whose time has a bound.
const MOVES: usize = 16;

/// Writes the keys of `staged`, which are all different, to `out` in ascending order; `staged` is scratch afterwards.
///
/// Two stable passes sort by the two highest digits in which depths differ, which leaves next to nothing for the last
/// pass, of insertions, by the whole key. Three times as fast as a comparison sort.
fn sort(staged: &[AtomicU64], out: &mut [u64]) {
    let key = |k: &AtomicU64| k.load(Ordering::Relaxed);
    if out.len() > FEW {
        if out.len() < MANY {
            by_digits::<{ DIGIT_BITS[0] }, { 1 << DIGIT_BITS[0] }>(staged, out);
        } else {
            by_digits::<{ DIGIT_BITS[1] }, { 1 << DIGIT_BITS[1] }>(staged, out);
        }
    }
    let mut moves = 0;
    for (i, k) in staged.iter().enumerate() {
        let k = key(k);
        let mut at = i;
        while at > 0 && out[at - 1] > k {
            out[at] = out[at - 1];
            at -= 1;
        }
        out[at] = k;
        moves += i - at;
        if moves > MOVES * out.len() {
            for (out, k) in out.iter_mut().zip(staged).skip(i + 1) {
                *out = key(k);
            }
            return out.sort_unstable();
        }
    }
}

/// Sorts `staged` stably by the 2·BITS highest bits of those in which the depths differ; `scratch` is as long.
fn by_digits<const BITS: u32, const SIZE: usize>(staged: &[AtomicU64], scratch: &mut [u64]) {
    let key = |k: &AtomicU64| k.load(Ordering::Relaxed);
    let (low, high) = staged.iter().map(key).fold((u64::MAX, 0), |(low, high), k| (low.min(k), high.max(k)));
    let base = low >> u32::BITS << u32::BITS;
    let shift = (u64::BITS - (high - base).leading_zeros()).max(u32::BITS + 2 * BITS) - 2 * BITS;
    let digits = |k: u64| {
        let v = ((k - base) >> shift) as usize;
        [v % SIZE, v / SIZE % SIZE]
    };
    let mut places = [[0u32; SIZE]; 2];
    for k in staged {
        let d = digits(key(k));
        places[0][d[0]] += 1;
        places[1][d[1]] += 1;
    }
    for places in &mut places {
        let mut sum = 0;
        for place in places {
            sum += std::mem::replace(place, sum);
        }
    }
    for k in staged {
        let k = key(k);
        let place = &mut places[0][digits(k)[0]];
        scratch[*place as usize] = k;
        *place += 1;
    }
    for &k in &*scratch {
        let place = &mut places[1][digits(k)[1]];
        staged[*place as usize].store(k, Ordering::Relaxed);
        *place += 1;
    }
}

impl Bins {
    /// Divides an image of `width` x `height` into runs of bins of at most `budget` pairs each, and makes the lists
    /// of the first.
    pub(crate) fn prepare(&mut self, footprints: &[Footprint], width: usize, height: usize, budget: usize) {
        assert!(u32::try_from(footprints.len()).is_ok(), "a key holds the number of a splat in 32 bits");
        (self.across, self.down) = (width.div_ceil(BIN), height.div_ceil(BIN));
        assert!(self.across.max(self.down) < LARGE.into(), "a footprint holds the number of a bin in 15 bits");
        let bins = self.bins();
        self.runs.clear();
        self.runs.push(0..bins);
        self.total = self.count(footprints, 0..bins);
        if self.total <= budget as u64 {
            return self.place(footprints, 0);
        }
        self.runs.clear();
        let (mut first, mut held) = (0, 0);
        for bin in 0..bins {
            let pairs = self.cursors.iter().skip(bin).step_by(bins).map(|&c| u64::from(c)).sum::<u64>();
            if bin > first && held + pairs > budget as u64 {
                self.runs.push(first..bin);
                (first, held) = (bin, 0);
            }
            held += pairs;
        }
        self.runs.push(first..bins);
        self.fill(footprints, 0);
    }

    /// Makes the lists of run `run`.
    pub(crate) fn fill(&mut self, footprints: &[Footprint], run: usize) {
        self.count(footprints, self.runs[run].clone());
        self.place(footprints, run);
    }

    /// Counts the pairs of every chunk of splats with every bin of `run`; returns how many there are.
    fn count(&mut self, footprints: &[Footprint], run: Range<usize>) -> u64 {
        let across = self.across;
        self.cursors.clear();
        self.cursors.resize(footprints.len().div_ceil(CHUNK) * run.len(), 0);
        if run.is_empty() {
            return 0;
        }
        let chunks = self.cursors.par_chunks_mut(run.len()).zip(footprints.par_chunks(CHUNK));
        let pairs = chunks.map(|(counts, feet)| {
            for foot in feet {
                foot.for_each(across, run.start, counts, |count| *count += 1);
            }
            counts.iter().map(|&c| u64::from(c)).sum::<u64>()
        });
        pairs.sum()
    }

    /// Number of bins.
    pub(crate) fn bins(&self) -> usize {
        self.across * self.down
    }

    /// Makes the lists of run `run`, which has been counted.
    fn place(&mut self, footprints: &[Footprint], run: usize) {
        self.current = run;
        let (across, bins, run) = (self.across, self.bins(), self.runs[run].clone());
        self.starts.clear();
        self.starts.resize(bins + 1, 0);
        self.first.resize(footprints.len(), 0);
        self.chunk_starts.clear();
        if run.is_empty() {
            return self.keys.clear();
        }
        // A bin's keys are those of the first chunk, then those of the second, and so on: counts become positions.
        let starts = &mut self.starts[run.start..];
        for counts in self.cursors.chunks(run.len()) {
            for (start, &count) in starts[1..].iter_mut().zip(counts) {
                *start += count;
            }
        }
        let mut pairs = 0;
        for start in &mut *starts {
            pairs += *start;
            *start = pairs;
        }
        let mut slot = 0;
        self.next.clear();
        self.next.extend_from_slice(&starts[..run.len()]);
        for counts in self.cursors.chunks_mut(run.len()) {
            self.chunk_starts.push(slot);
            for (next, count) in self.next.iter_mut().zip(counts) {
                slot += *count;
                *next += std::mem::replace(count, *next);
            }
        }
        self.staged.resize_with(pairs as usize, AtomicU64::default);
        self.keys.resize(pairs as usize, 0);
        let staged = &self.staged;
        let placing = self.cursors.par_chunks_mut(run.len()).zip(self.chunk_starts.par_iter());
        let splats = footprints.par_chunks(CHUNK).zip(self.first.par_chunks_mut(CHUNK));
        placing.zip(splats).enumerate().for_each(|(chunk, ((places, &slot), (feet, first)))| {
            let mut slot = slot;
            for (i, (foot, first)) in feet.iter().zip(first).enumerate() {
                *first = slot.wrapping_sub(foot.below(run.start, across) as u32);
                let key = u64::from(foot.depth) << u32::BITS | (chunk * CHUNK + i) as u64;
                foot.for_each(across, run.start, places, |place| {
                    staged[*place as usize].store(key, Ordering::Relaxed);
                    *place += 1;
                    slot += 1;
                });
            }
        });
        let starts = &self.starts;
        for_each_group(starts, Ragged(&mut self.keys), &|bin, keys| {
            sort(&staged[starts[bin] as usize..starts[bin + 1] as usize], keys.0);
        });
    }

    /// Gradient slots of a splat in the current run.
    #[inline(always)]
    pub(crate) fn slots(&self, splat: usize, foot: &Footprint) -> Range<usize> {
        let run = &self.runs[self.current];
        let (before, end) = (foot.below(run.start, self.across), foot.below(run.end, self.across));
        let first = self.first[splat].wrapping_add(before as u32) as usize;
        first..first + (end - before)
    }

    /// Bytes held.
    pub(crate) fn memory_bytes(&self) -> usize {
        let words = [&self.starts, &self.first, &self.cursors, &self.chunk_starts, &self.next];
        4 * words.iter().map(|w| w.capacity()).sum::<usize>() + 8 * (self.keys.capacity() + self.staged.capacity())
    }
}
