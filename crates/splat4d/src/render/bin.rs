//! Which splats touch which 32² bin of the picture, nearest first.
//!
//! A deterministic two-pass count over fixed chunks of splats, then one sort a bin: a bin's keys stay in cache, where a
//! global sort would scatter. Order inside a bin is (depth, number of the splat).

use super::parallel::{Ragged, for_each_group};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

/// Pixels across and down a bin.
pub const BIN: usize = 32;
/// Splats in a counting task; fixed, so that the result cannot depend on the number of threads.
const CHUNK: usize = 8192;
/// Bins across and down that a coverage mask holds.
pub(super) const MASK_SIDE: usize = 8;
/// Set in a footprint's first column: it is a rectangle larger than a mask.
const LARGE: u16 = 1 << 15;

/// Pairs of bin and splat that are held at once. A picture with more is drawn in runs of bins, each of at most this
/// many pairs (or a single bin, whose pairs are at most the splats). A pair holds about 130 bytes in f32 with
/// gradients, so this is about 2 GiB; ordinary scenes of a million splats have a fifth of it.
pub const PAIR_BUDGET: usize = 1 << 24;

/// What the lists need of one splat: the bins that it can touch, and its depth. Plain old data, 16 bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Footprint {
    /// First column of bins; [`LARGE`] says what `cover` is.
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
    fn large(&self) -> Option<[usize; 4]> {
        let (x1, y1) = (self.cover as u16, (self.cover >> 16) as u16);
        (self.x0 & LARGE != 0).then(|| [self.x0 & !LARGE, x1, self.y0, y1].map(usize::from))
    }

    /// Number of bins touched; 0 for a culled splat.
    #[inline(always)]
    pub fn count(&self) -> usize {
        match self.large() {
            None => self.cover.count_ones() as usize,
            Some([x0, x1, y0, y1]) => (x1 - x0) * (y1 - y0),
        }
    }

    /// How many touched bins come before bin (x, y), which is one of them.
    #[inline(always)]
    pub fn rank(&self, x: usize, y: usize) -> usize {
        match self.large() {
            None => {
                let bit = (y - usize::from(self.y0)) * MASK_SIDE + x - usize::from(self.x0);
                (self.cover & ((1u64 << bit) - 1)).count_ones() as usize
            }
            Some([x0, x1, y0, _]) => (y - y0) * (x1 - x0) + x - x0,
        }
    }

    /// How many touched bins have a number below `bin`, bins being numbered by rows of `across`.
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

    /// Calls `f` with the number of every touched bin of `run`, ascending.
    #[inline(always)]
    fn for_each(&self, across: usize, run: &Range<usize>, mut f: impl FnMut(usize)) {
        if let Some([x0, x1, y0, y1]) = self.large() {
            for y in y0.max(run.start / across)..y1.min(run.end.div_ceil(across)) {
                for bin in (y * across + x0).max(run.start)..(y * across + x1).min(run.end) {
                    f(bin);
                }
            }
            return;
        }
        let corner = usize::from(self.y0) * across + usize::from(self.x0);
        let mut m = self.cover;
        while m != 0 {
            let bit = m.trailing_zeros() as usize;
            let bin = corner + bit / MASK_SIDE * across + bit % MASK_SIDE;
            if run.contains(&bin) {
                f(bin);
            }
            m &= m - 1;
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
    /// Of each chunk of splats and each bin: first the pairs, then where the next of them goes in `staged`.
    cursors: Vec<u32>,
    /// Scratch: the next place of each bin.
    next: Vec<u32>,
    /// Gradient slots before each chunk.
    chunk_starts: Vec<u32>,
    /// Keys by bin, not yet sorted. Every place is written by exactly one task.
    staged: Vec<AtomicU64>,
}

/// The splat a key names.
#[inline(always)]
pub fn id(key: u64) -> usize {
    (key & u64::from(u32::MAX)) as usize
}

/// Most buckets of a sort: their counts stay in the first-level cache.
const BUCKETS: usize = 2048;
/// Keys in a bucket above which it is sorted on its own before the last pass, whose time grows with their square.
const CROWDED: u32 = 24;

/// Writes the keys of `from`, which are all different, to `to` in ascending order.
///
/// One pass puts keys into about as many buckets of equal ranges of depth as there are keys, and a pass of insertions
/// puts right what is left. A comparison sort costs three times as much.
fn sort(from: &[AtomicU64], to: &mut [u64]) {
    let key = |k: &AtomicU64| k.load(Ordering::Relaxed);
    let (low, high) = from.iter().map(key).fold((u64::MAX, 0), |(low, high), k| (low.min(k), high.max(k)));
    // Depths from here on: low ≤ high but for an empty bin.
    let low = low >> 32;
    let spread = (high >> 32).saturating_sub(low);
    let wanted = from.len().next_power_of_two().min(BUCKETS);
    let shift = 32 + (u64::BITS - spread.leading_zeros()).saturating_sub(wanted.trailing_zeros());
    let base = low << 32;
    let bucket = |k: u64| ((k - base) >> shift) as usize % BUCKETS;
    let mut places = [0u32; BUCKETS];
    for k in from {
        places[bucket(key(k))] += 1;
    }
    let (mut sum, mut most) = (0, 0);
    for place in &mut places[..wanted] {
        most = most.max(*place);
        sum += std::mem::replace(place, sum);
    }
    for k in from {
        let k = key(k);
        let place = &mut places[bucket(k)];
        to[*place as usize] = k;
        *place += 1;
    }
    if most > CROWDED {
        let mut start = 0;
        for &end in &places[..wanted] {
            if end - start > CROWDED {
                to[start as usize..end as usize].sort_unstable();
            }
            start = end;
        }
    }
    for i in 1..to.len() {
        let k = to[i];
        let mut at = i;
        while at > 0 && to[at - 1] > k {
            to[at] = to[at - 1];
            at -= 1;
        }
        to[at] = k;
    }
}

impl Bins {
    /// Divides a picture of `width` x `height` into runs of bins of at most `budget` pairs each, and makes the lists
    /// of the first.
    pub fn prepare(&mut self, footprints: &[Footprint], width: usize, height: usize, budget: usize) {
        assert!(u32::try_from(footprints.len()).is_ok(), "a key holds the number of a splat in 32 bits");
        (self.across, self.down) = (width.div_ceil(BIN), height.div_ceil(BIN));
        assert!(self.across.max(self.down) < LARGE.into(), "a footprint holds the number of a bin in 15 bits");
        let bins = self.bins();
        self.total = footprints.par_iter().with_min_len(CHUNK).map(|f| f.count() as u64).sum();
        self.runs.clear();
        if self.total <= budget as u64 {
            self.runs.push(0..bins);
        } else {
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
        self.fill(footprints, 0);
    }

    /// Pairs of every bin, in time that does not grow with the size of large footprints.
    fn pairs_by_bin(&self, footprints: &[Footprint]) -> Vec<u64> {
        let (across, stride) = (self.across, self.across + 1);
        let mut counts = vec![0u64; self.bins()];
        // A large rectangle is four corners of a table of differences; sums wrap back.
        let mut corners = vec![0u64; stride * (self.down + 1)];
        for foot in footprints {
            let Some([x0, x1, y0, y1]) = foot.large() else {
                foot.for_each(across, &(0..self.bins()), |b| counts[b] += 1);
                continue;
            };
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
    pub fn fill(&mut self, footprints: &[Footprint], run: usize) {
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
        // First pass: count by chunk and bin.
        let counting = self.cursors.par_chunks_mut(bins).zip(&mut self.chunk_starts[1..]);
        counting.zip(footprints.par_chunks(CHUNK)).for_each(|((counts, total), feet)| {
            for foot in feet {
                foot.for_each(across, &run, |bin| {
                    counts[bin] += 1;
                    *total += 1;
                });
            }
        });
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
        // A bin's keys are those of the first chunk, then those of the second: counts become places.
        let pairs = self.starts[bins] as usize;
        let mut next = std::mem::take(&mut self.next);
        next.clear();
        next.extend_from_slice(&self.starts[..bins]);
        for counts in self.cursors.chunks_mut(bins) {
            for (next, count) in next.iter_mut().zip(counts) {
                let place = *next;
                *next += *count;
                *count = place;
            }
        }
        self.next = next;
        self.staged.resize_with(pairs, AtomicU64::default);
        self.keys.resize(pairs, 0);
        // Second pass: each chunk puts its keys where its places are.
        let staged = &self.staged;
        let placing = self.cursors.par_chunks_mut(bins).zip(self.chunk_starts.par_iter());
        let splats = footprints.par_chunks(CHUNK).zip(self.first.par_chunks_mut(CHUNK));
        placing.zip(splats).enumerate().for_each(|(chunk, ((places, &slot), (feet, first)))| {
            let mut slot = slot;
            for (i, (foot, first)) in feet.iter().zip(first).enumerate() {
                *first = slot.wrapping_sub(foot.below(run.start, across) as u32);
                let key = u64::from(foot.depth) << 32 | (chunk * CHUNK + i) as u64;
                foot.for_each(across, &run, |bin| {
                    staged[places[bin] as usize].store(key, Ordering::Relaxed);
                    places[bin] += 1;
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
    pub fn slots(&self, splat: usize, foot: &Footprint) -> Range<usize> {
        let run = &self.runs[self.current];
        let (before, end) = (foot.below(run.start, self.across), foot.below(run.end, self.across));
        let first = self.first[splat].wrapping_add(before as u32) as usize;
        first..first + (end - before)
    }

    /// Bytes held.
    pub fn memory_bytes(&self) -> usize {
        let words = [&self.starts, &self.first, &self.cursors, &self.chunk_starts, &self.next];
        4 * words.iter().map(|w| w.capacity()).sum::<usize>() + 8 * (self.keys.capacity() + self.staged.capacity())
    }
}
