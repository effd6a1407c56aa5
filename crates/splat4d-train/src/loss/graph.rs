//! The graph of nearest neighbours that the losses on rigid motion share.

use rayon::prelude::*;
use splat4d::math::Real;
use splat4d::math::knn::knn;

/// Below this mean weight a graph ties almost nothing: its β does not fit the scene's unit.
pub(crate) const LEAST_MEAN_WEIGHT: f64 = 0.05;

/// The weight of an edge, given its length at rest d0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Weigh {
    /// All alike.
    Uniform,
    /// exp(−c d0²/median(d0²)): whatever the scene's unit, the median edge counts e^−c.
    Median(f64),
    /// exp(−β d0²), β in 1/(scene units)² (Luiten et al. 2024: 2000 a square metre).
    Beta(f64),
}

/// The k nearest neighbours of every point, with the edges' lengths and weights at rest, walkable from both ends.
///
/// Edge e = i·k + n leads from point i to its n-th nearest. Where there are fewer than k other points an edge leads to
/// itself: it weighs nothing and is not counted.
/// Source: Luiten et al. 2024 (w = exp(−β d0²)); β from the median is ours, for scenes in any unit.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Graph<F = f32> {
    k: usize,
    near: Vec<u32>,
    d0: Vec<F>,
    weights: Vec<F>,
    /// Edges that lead to point j are `back[first[j]..first[j + 1]]`, ascending.
    first: Vec<u32>,
    back: Vec<u32>,
    edges: usize,
}

impl<F: Real> Graph<F> {
    /// Of the `k` nearest other points. Panics: more than u32 edges.
    pub(crate) fn new(points: &[[F; 3]], k: usize, weigh: Weigh) -> Self {
        let rounded: Vec<[f32; 3]> = points.iter().map(|p| p.map(|x| x.f64() as f32)).collect();
        Self::of(points, knn(&rounded, k), weigh)
    }

    /// Of given neighbours, row-major [points, k]; a point's own index fills up. Panics: neighbours that are no points.
    pub(crate) fn of(points: &[[F; 3]], near: Vec<u32>, weigh: Weigh) -> Self {
        let n = points.len();
        let k = near.len().checked_div(n).unwrap_or(0);
        assert!(near.len() == n * k && u32::try_from(near.len()).is_ok(), "{} edges of {n} points", near.len());
        assert!(near.iter().all(|&j| (j as usize) < n), "neighbours are points of the graph");
        let d0: Vec<F> = (0..near.len())
            .into_par_iter()
            .with_min_len(4096)
            .map(|e| length(sub(points[near[e] as usize], points[e / k])))
            .collect();
        let is_edge = |e: &usize| near[*e] as usize != e / k;
        let edges = (0..near.len()).filter(is_edge).count();
        let beta = match weigh {
            Weigh::Uniform => 0.0,
            Weigh::Beta(beta) => beta,
            Weigh::Median(c) => {
                let mut squares: Vec<f64> =
                    (0..near.len()).filter(is_edge).map(|e| d0[e].f64() * d0[e].f64()).collect();
                let middle = squares.len() / 2;
                // Points that coincide leave a median of 0; their edges count in full.
                let median =
                    if squares.is_empty() { 1.0 } else { *squares.select_nth_unstable_by(middle, f64::total_cmp).1 };
                c / median.max(f64::MIN_POSITIVE.sqrt())
            }
        };
        let weights = (0..near.len())
            .map(|e| if is_edge(&e) { F::of((-beta * d0[e].f64() * d0[e].f64()).exp()) } else { F::ZERO })
            .collect();
        // Counting sort by the edge's end.
        let mut first = vec![0u32; n + 1];
        (0..near.len()).filter(is_edge).for_each(|e| first[near[e] as usize + 1] += 1);
        (0..n).for_each(|j| first[j + 1] += first[j]);
        let mut next = first.clone();
        let mut back = vec![0u32; edges];
        for e in (0..near.len()).filter(is_edge) {
            let place = &mut next[near[e] as usize];
            back[*place as usize] = e as u32;
            *place += 1;
        }
        Self { k, near, d0, weights, first, back, edges }
    }

    /// Points.
    pub(crate) fn len(&self) -> usize {
        self.first.len().saturating_sub(1)
    }

    /// Whether there is no point.
    #[cfg(test)]
    pub(crate) fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Neighbours a point.
    pub(crate) fn k(&self) -> usize {
        self.k
    }

    /// Edges that tie two points.
    pub(crate) fn edges(&self) -> usize {
        self.edges
    }

    /// Target of each edge, with its length at rest and its weight.
    pub(crate) fn all(&self) -> impl Iterator<Item = (u32, F, F)> + '_ {
        (0..self.near.len()).map(|e| (self.near[e], self.d0[e], self.weights[e]))
    }

    /// By point the first of the edges that lead to it, with one past the last; and those edges.
    pub(crate) fn all_to(&self) -> [&[u32]; 2] {
        [&self.first, &self.back]
    }

    /// Lengths at rest, scene units, an edge.
    pub(crate) fn lengths(&self) -> &[F] {
        &self.d0
    }

    /// Weights in [0, 1], an edge.
    pub(crate) fn weights(&self) -> &[F] {
        &self.weights
    }

    /// Mean weight of the edges that tie two points; below [`LEAST_MEAN_WEIGHT`] nothing is held together. 0 without
    /// any.
    pub(crate) fn mean_weight(&self) -> f64 {
        self.weights.iter().map(|w| w.f64()).sum::<f64>() / self.edges.max(1) as f64
    }

    /// Numbers of the edges that lead from point i, with the points they lead to; fill-ups are left out.
    #[inline]
    pub(crate) fn edges_from(&self, i: usize) -> impl Iterator<Item = (usize, usize)> + '_ {
        (i * self.k..(i + 1) * self.k).map(|e| (e, self.near[e] as usize)).filter(move |&(_, j)| j != i)
    }

    /// Numbers of the edges that lead to point j, with the points they come from.
    #[inline]
    pub(crate) fn edges_to(&self, j: usize) -> impl Iterator<Item = (usize, usize)> + '_ {
        let k = self.k;
        self.back[self.first[j] as usize..self.first[j + 1] as usize].iter().map(move |&e| (e as usize, e as usize / k))
    }
}

/// Points whose work is one task and one partial sum: fixed, so that sums do not depend on threads.
const CHUNK: usize = 256;

/// Calls `node(i, &mut out[i])` for every point in parallel and returns the sum of the results in a fixed order.
pub(crate) fn over_points<T: Send>(out: &mut [T], node: impl Fn(usize, &mut T) -> f64 + Sync) -> f64 {
    let sums: Vec<f64> = out
        .par_chunks_mut(CHUNK)
        .enumerate()
        .map(|(c, part)| part.iter_mut().enumerate().map(|(i, out)| node(c * CHUNK + i, out)).sum())
        .collect();
    sums.iter().sum()
}

/// Every edge once, then both its ends. `near(i, &mut out[i], forces)` computes point i's edges, of which edge i·k + n
/// has its place n in `forces`, and receives their forces; `far(&mut out[j], force)` takes what an edge does to its far
/// end. Returns the sum of what `near` returned, in a fixed order.
pub(crate) fn over_edges<F: Real, T: Send, const N: usize>(
    graph: &Graph<F>,
    out: &mut [T],
    near: impl Fn(usize, &mut T, &mut [[F; N]]) -> f64 + Sync,
    far: impl Fn(&mut T, [F; N]) + Sync,
) -> f64 {
    let k = graph.k();
    if k == 0 {
        return 0.0;
    }
    let mut forces = vec![[F::ZERO; N]; out.len() * k];
    let parts = out.par_chunks_mut(CHUNK).zip(forces.par_chunks_mut(CHUNK * k)).enumerate();
    let sums: Vec<f64> = parts
        .map(|(c, (out, forces))| {
            let points = out.iter_mut().zip(forces.chunks_exact_mut(k)).enumerate();
            points.map(|(i, (out, forces))| near(c * CHUNK + i, out, forces)).sum()
        })
        .collect();
    over_points(out, |j, out| {
        graph.edges_to(j).for_each(|(e, _)| far(out, forces[e]));
        0.0
    });
    sums.iter().sum()
}

#[inline(always)]
pub(crate) fn sub<F: Real>(a: [F; 3], b: [F; 3]) -> [F; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
pub(crate) fn add_to<F: Real, const N: usize>(to: &mut [F; N], by: [F; N], times: F) {
    (0..N).for_each(|k| to[k] += by[k] * times);
}

#[inline(always)]
pub(crate) fn square<F: Real, const N: usize>(a: [F; N]) -> F {
    a.iter().fold(F::ZERO, |sum, &x| sum + x * x)
}

#[inline(always)]
pub(crate) fn length<F: Real>(a: [F; 3]) -> F {
    square(a).sqrt()
}

/// m·v
#[inline(always)]
pub(crate) fn turn<F: Real>(m: &[[F; 3]; 3], v: [F; 3]) -> [F; 3] {
    std::array::from_fn(|r| m[r][0] * v[0] + m[r][1] * v[1] + m[r][2] * v[2])
}

/// mᵀ·v
#[inline(always)]
pub(crate) fn turn_back<F: Real>(m: &[[F; 3]; 3], v: [F; 3]) -> [F; 3] {
    std::array::from_fn(|c| m[0][c] * v[0] + m[1][c] * v[1] + m[2][c] * v[2])
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    fn cloud(n: usize) -> Vec<[f64; 3]> {
        let rng = Rng::new(3, "graph", 0);
        (0..n as u64).map(|i| std::array::from_fn(|a| rng.fork(i).normal(a as u64))).collect()
    }

    #[test]
    fn edges_are_the_nearest_and_walk_both_ways() {
        let points = cloud(60);
        let g = Graph::new(&points, 5, Weigh::Median(1.0));
        for i in 0..60 {
            let mut all: Vec<(f64, usize)> =
                (0..60).filter(|&j| j != i).map(|j| (length(sub(points[j], points[i])), j)).collect();
            all.sort_by(|a, b| a.0.total_cmp(&b.0));
            let out: Vec<usize> = g.edges_from(i).map(|(_, j)| j).collect();
            assert_eq!(out, all[..5].iter().map(|x| x.1).collect::<Vec<_>>());
            for (n, (e, j)) in g.edges_from(i).enumerate() {
                assert!((g.lengths()[e] - all[n].0).abs() < 1e-12);
                assert!(g.edges_to(j).any(|(back, from)| (back, from) == (e, i)));
                assert!(n == 0 || g.weights()[e] <= g.weights()[e - 1], "a longer edge never counts more");
            }
        }
        assert_eq!((0..60).map(|j| g.edges_to(j).count()).sum::<usize>(), 300);
    }

    #[test]
    fn weights_ignore_the_unit_unless_set() {
        let points = cloud(50);
        let large: Vec<[f64; 3]> = points.iter().map(|p| p.map(|x| 4096.0 * x)).collect();
        let [a, b] = [&points, &large].map(|p| Graph::new(p, 8, Weigh::Median(1.0)));
        assert!(a.weights().iter().zip(b.weights()).all(|(a, b)| (a - b).abs() < 1e-12));
        assert!(a.mean_weight() > 0.3 && a.mean_weight() < 0.7, "{}", a.mean_weight());
        let [a, b] = [&points, &large].map(|p| Graph::new(p, 8, Weigh::Beta(1.0)).mean_weight());
        assert!(a > LEAST_MEAN_WEIGHT && b < LEAST_MEAN_WEIGHT, "{a} {b}");
        assert_eq!(Graph::new(&points, 8, Weigh::Uniform).mean_weight(), 1.0);
    }

    #[test]
    fn few_and_coinciding_points_are_supported() {
        let g = Graph::<f64>::new(&[], 4, Weigh::Median(1.0));
        assert!(g.is_empty() && g.mean_weight() == 0.0);
        let g = Graph::new(&[[1.0, 2.0, 3.0]], 4, Weigh::Median(1.0));
        assert_eq!((g.len(), g.edges(), g.edges_from(0).count(), g.mean_weight()), (1, 0, 0, 0.0));
        let g = Graph::new(&[[1.0, 2.0, 3.0]; 3], 4, Weigh::Median(1.0));
        assert_eq!((g.edges(), g.mean_weight()), (6, 1.0));
    }
}
