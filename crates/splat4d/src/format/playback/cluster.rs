//! Weighted k-means for palettes, in two levels so that thousands of entries take seconds: coarse clusters first, then
//! each is divided alone, and finally every point searches the coarse clusters nearest to it for its entry.
//!
//! Identical points are merged into one with the sum of their weights first: the segments of a Gaussian share its
//! colours. Points are assigned in parallel, and every cluster is summed in the order of its points: any number of
//! threads gives the same bits.

use crate::math::Rng;
use rayon::prelude::*;
use std::collections::HashMap;

/// Numbers in a point are padded to a multiple of this, one AVX2 register.
const LANES: usize = 8;
/// Up to this many entries one level is fast enough.
const ONE_LEVEL: usize = 256;
/// Coarse clusters a square root of the entries: with fewer than √k the fine level costs more than it wins.
const COARSE: f64 = 0.7;
/// Rounds of the coarse level, which only has to divide the work.
const COARSE_ROUNDS: usize = 4;
/// Coarse clusters in which every point searches for its entry finally.
const NEAREST: usize = 3;
/// Points a task assigns.
const TASK: usize = 1024;
/// Clusters a task sums. Every task reads all labels, so that fewer clusters would cost more than they spread.
const SUMMED: usize = 64;

/// Result of the clustering.
pub(in crate::format) struct Clusters {
    /// [k, width]
    pub centroids: Vec<f32>,
    /// The entry of every point.
    pub labels: Vec<u32>,
}

/// Divides `points` into at most `k` clusters that minimise Σ weight·distance². Weights are positive. Memory: that of
/// the points that differ.
///
/// Panics: no point, k = 0, or lengths that do not fit.
pub(in crate::format) fn cluster<'a>(
    points: impl Iterator<Item = (&'a [f32], f32)>,
    width: usize,
    k: usize,
    rounds: usize,
    rng: Rng,
) -> Clusters {
    let stride = width.next_multiple_of(LANES);
    let Merged { data, weights, places } = merge(points, width, stride);
    let n = weights.len();
    assert!(n > 0 && k > 0, "{n} points in {k} clusters");
    let set = Set { data: &data, stride, weights: &weights };
    let all: Vec<u32> = (0..n as u32).collect();
    let (centroids, labels) = if k <= ONE_LEVEL {
        let level = set.lloyd(&all, k, rounds, rng);
        (level.centroids, level.nearest.iter().map(|&(c, _)| c).collect())
    } else {
        set.two_levels(&all, k, rounds, rng)
    };
    let (centroids, labels) = set.settle(centroids, labels);
    Clusters {
        centroids: centroids.chunks_exact(stride).flat_map(|c| &c[..width]).copied().collect(),
        labels: places.iter().map(|&place| labels[place as usize]).collect(),
    }
}

/// Distinct points, in the order of their first occurrence.
struct Merged {
    /// [points, stride], padded with zeros.
    data: Vec<f32>,
    /// Sums of the weights of identical points.
    weights: Vec<f32>,
    /// Of every point that was given, which of these it is.
    places: Vec<u32>,
}

/// Merges points of the same bits.
fn merge<'a>(points: impl Iterator<Item = (&'a [f32], f32)>, width: usize, stride: usize) -> Merged {
    let mut known: HashMap<Vec<u32>, u32> = HashMap::new();
    let (mut data, mut sums, mut places) = (Vec::new(), Vec::<f64>::new(), Vec::new());
    for (point, weight) in points {
        assert!(point.len() == width, "a point of {} numbers among those of {width}", point.len());
        let next = sums.len() as u32;
        let place = *known.entry(point.iter().map(|x| x.to_bits()).collect()).or_insert(next);
        if place == next {
            data.extend_from_slice(point);
            data.resize(sums.len() * stride + stride, 0.0);
            sums.push(0.0);
        }
        sums[place as usize] += f64::from(weight);
        places.push(place);
    }
    Merged { data, weights: sums.into_iter().map(|w| w as f32).collect(), places }
}

struct Set<'a> {
    data: &'a [f32],
    stride: usize,
    weights: &'a [f32],
}

/// Clusters of some points.
struct Level {
    /// [k, stride]
    centroids: Vec<f32>,
    /// Cluster of every point and its squared distance.
    nearest: Vec<(u32, f32)>,
}

impl Set<'_> {
    fn point(&self, id: u32) -> &[f32] {
        &self.data[id as usize * self.stride..(id as usize + 1) * self.stride]
    }

    /// Half the squared lengths: |x − c|² = |x|² − 2(x·c − ½|c|²).
    fn half_norms(&self, centroids: &[f32]) -> Vec<f32> {
        centroids.chunks_exact(self.stride).map(|c| 0.5 * dot(c, c)).collect()
    }

    /// The nearest centroid, the first among equals, and how near: x·c − ½|c|².
    fn nearest(&self, x: &[f32], centroids: &[f32], half_norms: &[f32]) -> (u32, f32) {
        let mut best = (0, f32::NEG_INFINITY);
        for (i, (c, half)) in centroids.chunks_exact(self.stride).zip(half_norms).enumerate() {
            let score = dot(x, c) - half;
            if score > best.1 {
                best = (i as u32, score);
            }
        }
        best
    }

    fn assign(&self, ids: &[u32], centroids: &[f32]) -> Vec<(u32, f32)> {
        let half_norms = self.half_norms(centroids);
        let one = |&id: &u32| {
            let x = self.point(id);
            let (c, score) = self.nearest(x, centroids, &half_norms);
            (c, (dot(x, x) - 2.0 * score).max(0.0))
        };
        ids.par_iter().with_min_len(TASK).map(one).collect()
    }

    /// Weighted means of the clusters; a cluster without points keeps its centroid. Returns how many points each has.
    fn means(&self, ids: &[u32], labels: impl Iterator<Item = u32>, centroids: &mut [f32]) -> Vec<u32> {
        let labels: Vec<u32> = labels.collect();
        let part = |(part, centroids): (usize, &mut [f32])| {
            let (first, k) = (part * SUMMED, centroids.len() / self.stride);
            let mut sums = vec![0.0f64; k * self.stride];
            let (mut mass, mut counts) = (vec![0.0f64; k], vec![0; k]);
            for (&id, label) in ids.iter().zip(&labels) {
                let label = (*label as usize).wrapping_sub(first);
                if label >= k {
                    continue;
                }
                let w = f64::from(self.weights[id as usize]);
                mass[label] += w;
                counts[label] += 1;
                for (s, x) in sums[label * self.stride..(label + 1) * self.stride].iter_mut().zip(self.point(id)) {
                    *s += w * f64::from(*x);
                }
            }
            for i in (0..k).filter(|&i| counts[i] > 0) {
                let range = i * self.stride..(i + 1) * self.stride;
                for (c, s) in centroids[range.clone()].iter_mut().zip(&sums[range]) {
                    *c = (s / mass[i]) as f32;
                }
            }
            counts
        };
        let parts: Vec<Vec<u32>> = centroids.par_chunks_mut(SUMMED * self.stride).enumerate().map(part).collect();
        parts.concat()
    }

    /// Lloyd's rounds. Starts from points drawn by weight; a cluster that runs empty moves to the point with the
    /// largest error.
    fn lloyd(&self, ids: &[u32], k: usize, rounds: usize, rng: Rng) -> Level {
        let k = k.min(ids.len());
        // Drawing by weight without replacement: the largest of ln(u)/w (Efraimidis, Spirakis 2006).
        let key = |&id: &u32| (1.0 - rng.uniform(u64::from(id))).ln() / f64::from(self.weights[id as usize]);
        let mut drawn: Vec<(f64, u32)> = ids.iter().map(|id| (key(id), *id)).collect();
        drawn.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut centroids: Vec<f32> = drawn[..k].iter().flat_map(|&(_, id)| self.point(id)).copied().collect();
        let mut nearest = self.assign(ids, &centroids);
        for _ in 0..rounds {
            let counts = self.means(ids, nearest.iter().map(|n| n.0), &mut centroids);
            let empty: Vec<usize> = (0..k).filter(|&i| counts[i] == 0).collect();
            if !empty.is_empty() {
                let error = |i: usize| nearest[i].1 * self.weights[ids[i] as usize];
                let mut worst: Vec<usize> = (0..ids.len()).filter(|&i| error(i) > 0.0).collect();
                let worse = |a: &usize, b: &usize| error(*b).total_cmp(&error(*a)).then(a.cmp(b));
                if worst.len() > empty.len() {
                    worst.select_nth_unstable_by(empty.len(), worse);
                    worst.truncate(empty.len());
                }
                worst.sort_unstable_by(worse);
                for (c, i) in empty.into_iter().zip(worst) {
                    centroids[c * self.stride..(c + 1) * self.stride].copy_from_slice(self.point(ids[i]));
                }
            }
            nearest = self.assign(ids, &centroids);
        }
        Level { centroids, nearest }
    }

    fn two_levels(&self, ids: &[u32], k: usize, rounds: usize, rng: Rng) -> (Vec<f32>, Vec<u32>) {
        let coarse = self.lloyd(ids, ((k as f64).sqrt() * COARSE).round() as usize, COARSE_ROUNDS, rng.fork(0));
        let count = coarse.centroids.len() / self.stride;
        let mut members = vec![Vec::new(); count];
        let mut errors = vec![0.0f64; count];
        for (&id, &(c, d)) in ids.iter().zip(&coarse.nearest) {
            members[c as usize].push(id);
            errors[c as usize] += f64::from(d * self.weights[id as usize]);
        }
        // In many dimensions an error hardly shrinks with entries, and shares in proportion to it are the best ones.
        let total: f64 = errors.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        let share = |c: usize| ((errors[c] / total * k as f64) as usize).clamp(1, members[c].len().max(1));
        let fine: Vec<Level> = (0..count)
            .into_par_iter()
            .with_max_len(1)
            .map(|c| {
                if members[c].is_empty() {
                    return Level { centroids: Vec::new(), nearest: Vec::new() };
                }
                self.lloyd(&members[c], share(c), rounds, rng.fork(1 + c as u64))
            })
            .collect();
        let firsts: Vec<u32> = fine
            .iter()
            .scan(0, |next, level| {
                let first = *next;
                *next += (level.centroids.len() / self.stride) as u32;
                Some(first)
            })
            .collect();
        let half_coarse = self.half_norms(&coarse.centroids);
        let half_fine: Vec<Vec<f32>> = fine.iter().map(|l| self.half_norms(&l.centroids)).collect();
        let find = |&id: &u32| {
            let x = self.point(id);
            let score = |c: usize| dot(x, &coarse.centroids[c * self.stride..(c + 1) * self.stride]) - half_coarse[c];
            // The best few, best first; of equals the first stays before the later one.
            let mut near = [(f32::NEG_INFINITY, usize::MAX); NEAREST];
            for c in 0..count {
                let score = score(c);
                let place = near.iter().position(|n| score.total_cmp(&n.0).is_gt());
                if let Some(place) = place {
                    near[place..].rotate_right(1);
                    near[place] = (score, c);
                }
            }
            let mut best = (0, f32::NEG_INFINITY);
            for &(_, c) in near.iter().filter(|n| n.1 < count) {
                let (i, score) = self.nearest(x, &fine[c].centroids, &half_fine[c]);
                if score > best.1 {
                    best = (firsts[c] + i, score);
                }
            }
            best.0
        };
        let labels: Vec<u32> = ids.par_iter().with_min_len(TASK).map(find).collect();
        (fine.into_iter().flat_map(|l| l.centroids).collect(), labels)
    }

    /// Means of the final clusters, those without points left out.
    fn settle(&self, mut centroids: Vec<f32>, mut labels: Vec<u32>) -> (Vec<f32>, Vec<u32>) {
        let ids: Vec<u32> = (0..labels.len() as u32).collect();
        let counts = self.means(&ids, labels.iter().copied(), &mut centroids);
        let mut place = vec![0u32; counts.len()];
        let mut kept = Vec::with_capacity(centroids.len());
        for (c, centroid) in centroids.chunks_exact(self.stride).enumerate().filter(|(c, _)| counts[*c] > 0) {
            place[c] = (kept.len() / self.stride) as u32;
            kept.extend_from_slice(centroid);
        }
        labels.iter_mut().for_each(|l| *l = place[*l as usize]);
        (kept, labels)
    }
}

/// a·b with one fixed order of additions, lane by lane.
#[inline(always)]
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; LANES];
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        for lane in 0..LANES {
            sums[lane] += a[lane] * b[lane];
        }
    }
    (sums[0] + sums[4]) + (sums[1] + sums[5]) + ((sums[2] + sums[6]) + (sums[3] + sums[7]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn clouds(n: usize, width: usize, centers: usize, spread: f64) -> Vec<f32> {
        let rng = Rng::new(3, "clouds", 0);
        let number = |i: usize, d: usize| {
            let c = rng.fork(1).below(i as u64, centers);
            rng.fork(2).normal((c * width + d) as u64) + spread * rng.fork(3).normal((i * width + d) as u64)
        };
        (0..n).flat_map(|i| (0..width).map(move |d| number(i, d) as f32)).collect()
    }

    fn cluster(points: &[f32], width: usize, weights: &[f32], k: usize, rounds: usize, rng: Rng) -> Clusters {
        super::cluster(points.chunks_exact(width).zip(weights.iter().copied()), width, k, rounds, rng)
    }

    fn error(points: &[f32], width: usize, weights: &[f32], c: &Clusters) -> f64 {
        let one = |(i, x): (usize, &[f32])| {
            let e = &c.centroids[c.labels[i] as usize * width..][..width];
            f64::from(weights[i]) * x.iter().zip(e).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>()
        };
        points.chunks_exact(width).enumerate().map(one).sum()
    }

    #[test]
    fn clear_clusters_are_found() {
        let points = clouds(4000, 9, 12, 0.01);
        let c = cluster(&points, 9, &[1.0; 4000], 40, 8, Rng::new(1, "k", 0));
        assert!(error(&points, 9, &[1.0; 4000], &c) / 4000.0 < 1.5 * 9.0 * 0.01 * 0.01);
    }

    #[test]
    fn two_levels_lose_little_and_any_threads_give_the_same_bits() {
        let points = clouds(6000, 24, 3000, 0.2);
        let weights: Vec<f32> = (0..6000).map(|i| 0.1 + (i % 7) as f32).collect();
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| cluster(&points, 24, &weights, 300, 5, Rng::new(1, "k", 0)))
        };
        let (one, three) = (run(1), run(3));
        assert!(one.labels == three.labels && one.centroids == three.centroids, "any number of threads, the same bits");
        assert!(one.centroids.len() / 24 > 280);
        let whole: Vec<u32> = (0..6000).collect();
        assert!(merge(points.chunks_exact(24).zip(weights.iter().copied()), 24, 24).data == points, "none are equal");
        let set = Set { data: &points, stride: 24, weights: &weights };
        let flat = set.lloyd(&whole, 300, 5, Rng::new(1, "k", 0));
        let (centroids, labels) = set.settle(flat.centroids, flat.nearest.iter().map(|n| n.0).collect());
        let flat = error(&points, 24, &weights, &Clusters { centroids, labels });
        let two = error(&points, 24, &weights, &one);
        assert!(two < 1.1 * flat, "two levels {two}, one {flat}");
    }

    #[test]
    fn equal_points_and_more_entries_than_points() {
        let c = cluster(&[0.5; 45 * 20], 45, &[1.0; 20], 300, 4, Rng::new(1, "k", 0));
        assert_eq!(c.centroids, [0.5; 45]);
        let points: Vec<f32> = (0..20).map(|i| i as f32).collect();
        let c = cluster(&points, 1, &[1.0; 20], 8192, 4, Rng::new(1, "k", 0));
        assert_eq!(error(&points, 1, &[1.0; 20], &c), 0.0);
    }

    /// The segments of a Gaussian have its colours: they count as one point of their weight, wherever they are listed.
    #[test]
    fn identical_points_are_one_point_of_their_weight() {
        let points = clouds(900, 9, 900, 0.5);
        let weights: Vec<f32> = (0..900).map(|i| 1.0 + (i % 3) as f32).collect();
        let merged = cluster(&points, 9, &weights, 300, 4, Rng::new(1, "k", 0));
        let copies: Vec<usize> = (0..3).flat_map(|round| (0..900).filter(move |i| i % 3 >= round)).collect();
        let many: Vec<f32> = copies.iter().flat_map(|&i| &points[9 * i..9 * i + 9]).copied().collect();
        let apart = cluster(&many, 9, &vec![1.0; copies.len()], 300, 4, Rng::new(1, "k", 0));
        assert_eq!(merged.centroids, apart.centroids);
        assert!(copies.iter().zip(&apart.labels).all(|(&i, label)| merged.labels[i] == *label));
        let Merged { data, weights, places } = merge(many.chunks_exact(9).map(|p| (p, 1.0)), 9, 16);
        assert!(data.len() == 16 * 900 && weights.len() == 900 && places.len() == copies.len());
    }

    #[test]
    fn heavy_points_get_smaller_errors() {
        let points = clouds(3000, 9, 3000, 0.0);
        let weights: Vec<f32> = (0..3000).map(|i| if i < 300 { 50.0 } else { 1.0 }).collect();
        let c = cluster(&points, 9, &weights, 400, 6, Rng::new(1, "k", 0));
        let of = |range: std::ops::Range<usize>| {
            let labels = c.labels[range.clone()].to_vec();
            let part = Clusters { centroids: c.centroids.clone(), labels };
            error(&points[9 * range.start..9 * range.end], 9, &[1.0; 3000], &part) / range.len() as f64
        };
        assert!(of(0..300) < 0.5 * of(300..3000), "{} {}", of(0..300), of(300..3000));
    }
}
