//! The order of the Gaussians of a page: blocks of 256 that are alike, so that a block is culled whole and its ranges
//! are narrow.
//!
//! A k-d tree over position, life and size halves the page at whole blocks, each time across what differs most; within
//! a block Gaussians are in Morton order, which deflate likes.

use super::page::lives_through;
use super::{BLOCK_GAUSSIANS, Primitive};
use crate::format::quant::{MORTON_BITS, morton};

/// Place 3, first and last second 2, logarithm of the size 1.
const FEATURES: usize = 6;
/// A spread of the whole span in time counts as much as this many standard deviations of all positions: a block that is
/// dead is skipped, one out of sight is examined rarely.
const TIME_WEIGHT: f64 = 4.0;
/// A factor e in size counts as much as this many standard deviations of all positions.
const SIZE_WEIGHT: f64 = 0.35;
/// Standard deviations of its tails at which a lifespan counts as over: o·σ is 1/255 at 3.3 of an opaque Gaussian.
const TAILS: f64 = 3.0;
/// Cells along the longest side of a block's box, within which Morton order is distinguished.
const CELLS: f64 = (1u32 << 10) as f64;
const _: () = assert!(MORTON_BITS >= 10);

/// Gaussians farther from the middle than this many times the distance of the nearest quarter are in blocks of their own:
/// a sky in the box of a block takes the bits of what is near.
const FAR: f64 = 100.0;

/// Sorts `rows` (indices into `primitives`) into the order of a page.
pub(super) fn sort(rows: &mut [u32], primitives: &[Primitive], span: [f64; 2]) {
    let near = near_first(rows, primitives);
    let (near, far) = rows.split_at_mut(near);
    sort_alike(near, primitives, span);
    sort_alike(far, primitives, span);
}

/// Moves the far Gaussians behind the others, which fill whole blocks; returns how many these are. The farthest of them
/// are with the far ones where a block would have both. Without far Gaussians nothing moves.
fn near_first(rows: &mut [u32], primitives: &[Primitive]) -> usize {
    if rows.len() <= BLOCK_GAUSSIANS {
        return rows.len();
    }
    let place = |i: u32| primitives[i as usize].mean;
    let middle: [f64; 3] = std::array::from_fn(|k| {
        let mut all: Vec<f64> = rows.iter().map(|&i| place(i)[k]).collect();
        let half = all.len() / 2;
        *all.select_nth_unstable_by(half, f64::total_cmp).1
    });
    let distance = |i: u32| (0..3).map(|k| (place(i)[k] - middle[k]).powi(2)).sum::<f64>().sqrt();
    let mut all: Vec<f64> = rows.iter().map(|&i| distance(i)).collect();
    let quarter = all.len() / 4;
    let limit = FAR * *all.select_nth_unstable_by(quarter, f64::total_cmp).1;
    let near = rows.iter().filter(|&&i| distance(i) <= limit).count();
    if near == rows.len() {
        return near;
    }
    let near = near / BLOCK_GAUSSIANS * BLOCK_GAUSSIANS;
    rows.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)).then(a.cmp(&b)));
    near
}

fn sort_alike(rows: &mut [u32], primitives: &[Primitive], span: [f64; 2]) {
    let n = rows.len().max(1) as f64;
    let mean: [f64; 3] = std::array::from_fn(|k| rows.iter().map(|&i| primitives[i as usize].mean[k]).sum::<f64>() / n);
    let variance = |k: usize| rows.iter().map(|&i| (primitives[i as usize].mean[k] - mean[k]).powi(2)).sum::<f64>() / n;
    let spread = ((variance(0) + variance(1) + variance(2)) / 3.0).sqrt().max(f64::MIN_POSITIVE);
    let features = |i: u32| {
        let p = &primitives[i as usize];
        let seconds = TIME_WEIGHT / (span[1] - span[0]);
        let reach = p.half_width + TAILS * p.softness;
        let [from, to] =
            if lives_through(p.center, p.half_width, span) { span } else { [p.center - reach, p.center + reach] };
        let place = p.mean.map(|x| x / spread);
        let size = p.scales.map(f64::from).into_iter().fold(f64::MIN_POSITIVE, f64::max).ln();
        let time = [from, to].map(|t| t.clamp(span[0], span[1]) * seconds);
        [place[0], place[1], place[2], time[0], time[1], size * SIZE_WEIGHT].map(|x| x as f32)
    };
    let mut items: Vec<(u32, [f32; FEATURES])> = rows.iter().map(|&i| (i, features(i))).collect();
    halve(&mut items);
    for block in items.chunks_mut(BLOCK_GAUSSIANS) {
        curve(block, primitives);
    }
    for (row, item) in rows.iter_mut().zip(items) {
        *row = item.0;
    }
}

fn halve(items: &mut [(u32, [f32; FEATURES])]) {
    if items.len() <= BLOCK_GAUSSIANS {
        return;
    }
    let n = items.len() as f64;
    let variance = |k: usize| {
        let mean = items.iter().map(|(_, f)| f64::from(f[k])).sum::<f64>() / n;
        items.iter().map(|(_, f)| (f64::from(f[k]) - mean).powi(2)).sum::<f64>() / n
    };
    let variances: [f64; FEATURES] = std::array::from_fn(variance);
    let widest = (1..FEATURES).fold(0, |best, k| if variances[k] > variances[best] { k } else { best });
    // The index decides between equals, so that the order is one whatever the sort does with them.
    let middle = items.len().div_ceil(BLOCK_GAUSSIANS).div_ceil(2) * BLOCK_GAUSSIANS;
    items.select_nth_unstable_by(middle, |a, b| a.1[widest].total_cmp(&b.1[widest]).then(a.0.cmp(&b.0)));
    let (a, b) = items.split_at_mut(middle);
    rayon::join(|| halve(a), || halve(b));
}

fn curve(block: &mut [(u32, [f32; FEATURES])], primitives: &[Primitive]) {
    let mean = |item: &(u32, [f32; FEATURES])| primitives[item.0 as usize].mean;
    let low: [f64; 3] = std::array::from_fn(|k| block.iter().map(|i| mean(i)[k]).fold(f64::INFINITY, f64::min));
    let side = block.iter().flat_map(|i| std::array::from_fn::<f64, 3, _>(|k| mean(i)[k] - low[k])).fold(0.0, f64::max);
    let scale = (CELLS - 1.0) / side.max(f64::MIN_POSITIVE);
    block.sort_by_key(|i| (morton(std::array::from_fn(|k| ((mean(i)[k] - low[k]) * scale) as u32)), i.0));
}
