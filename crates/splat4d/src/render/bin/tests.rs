//! Lists against a plain sort of all pairs.

use super::*;
use crate::math::Rng;

/// Footprints of every kind on `size` bins: none, single bins, masks, rectangles larger than a mask.
fn footprints(n: usize, size: [usize; 2]) -> Vec<Footprint> {
    let rng = Rng::new(3, "footprints", 0);
    let foot = |i: usize| {
        let r = rng.fork(i as u64);
        let within = |k: u64, size: usize| (r.uniform(k) * size as f64) as usize;
        // Few depths, so that many are equal.
        let depth = 0.5 + 0.25 * within(0, 40) as f32;
        let first = [within(1, size[0]), within(2, size[1])];
        match i % 5 {
            0 => Footprint::default(),
            1 => Footprint::masked(first, 1, depth),
            2 if first[0] + 9 < size[0] => Footprint::rectangle([first[0], first[0] + 9, first[1], size[1]], depth),
            _ => {
                let inside = |bit: &usize| first[0] + bit % 8 < size[0] && first[1] + bit / 8 < size[1];
                let bits = (0..64).filter(inside).filter(|&bit| r.uniform(10 + bit as u64) < 0.3);
                Footprint::masked(first, bits.fold(0, |mask, bit| mask | 1 << bit), depth)
            }
        }
    };
    (0..n).map(foot).collect()
}

/// Whether `foot` touches bin (x, y), from what it holds.
fn touches(foot: &Footprint, x: usize, y: usize) -> bool {
    let (x0, y0) = (usize::from(foot.x0 & !LARGE), usize::from(foot.y0));
    if x < x0 || y < y0 {
        return false;
    }
    if foot.x0 & LARGE != 0 {
        return x < (foot.cover & 0xffff) as usize && y < (foot.cover >> 16) as usize;
    }
    x - x0 < 8 && y - y0 < 8 && foot.cover >> (8 * (y - y0) + x - x0) & 1 == 1
}

#[test]
fn lists_equal_a_stable_sort_of_all_pairs() {
    let [across, down] = [21, 11];
    let feet = footprints(CHUNK + 700, [across, down]);
    let mut bins = Bins::default();
    for budget in [usize::MAX, 30_000, 1] {
        bins.prepare(&feet, across * BIN - 5, down * BIN, budget);
        assert_eq!((bins.across, bins.down), (across, down));
        assert_eq!(bins.total, feet.iter().map(|f| f.count() as u64).sum::<u64>());
        let mut taken = 0;
        for run in 0..bins.runs.len() {
            bins.fill(&feet, run);
            let held = bins.runs[run].clone();
            let mut slots = vec![false; bins.keys.len()];
            for bin in 0..across * down {
                let keys = &bins.keys[bins.starts[bin] as usize..bins.starts[bin + 1] as usize];
                let (x, y) = (bin % across, bin / across);
                let mut truth: Vec<usize> = (0..feet.len()).filter(|&i| touches(&feet[i], x, y)).collect();
                truth.sort_by(|&a, &b| f32::from_bits(feet[a].depth).total_cmp(&f32::from_bits(feet[b].depth)));
                if !held.contains(&bin) {
                    truth.clear();
                }
                assert!(keys.iter().map(|&k| id(k)).eq(truth), "bin {x}, {y} of run {held:?}");
                for &k in keys {
                    let slot = bins.first[id(k)].wrapping_add(feet[id(k)].rank(x, y) as u32) as usize;
                    assert!(bins.slots(id(k), &feet[id(k)]).contains(&slot), "a slot is its splat's");
                    assert!(!std::mem::replace(&mut slots[slot], true), "a slot is one pair's");
                }
            }
            taken += bins.keys.len() as u64;
        }
        assert_eq!(taken, bins.total, "the runs hold every pair once");
    }
}

#[test]
fn sort_is_a_sort() {
    let rng = Rng::new(4, "sort", 0);
    // Spread evenly, all equal, one far away, in reverse, close together but for one: insertions alone would take
    // forever over the last.
    let depths: [fn(f64, usize, usize) -> f32; 5] = [
        |u, _, _| 0.3 + 4.0 * u as f32,
        |_, _, _| 2.5,
        |u, i, _| if i == 7 { 1e30 } else { 1.0 + u as f32 },
        |_, i, n| 1.0 + (n - i) as f32,
        |_, i, n| if i == 0 { 1e-30 } else { f32::from_bits(1f32.to_bits() + (n - i) as u32) },
    ];
    for (kind, depth) in depths.iter().enumerate() {
        for n in [0, 1, 2, FEW, FEW + 1, 700, MANY, 20_000] {
            let bits = |i: usize| u64::from(depth(rng.uniform(i as u64), i, n).to_bits());
            let keys: Vec<u64> = (0..n).map(|i| bits(i) << 32 | i as u64).collect();
            let staged: Vec<AtomicU64> = keys.iter().map(|&k| AtomicU64::new(k)).collect();
            let (mut out, mut truth) = (vec![0; n], keys);
            sort(&staged, &mut out);
            truth.sort();
            assert!(out == truth, "depths of kind {kind}, {n} keys");
        }
    }
}
