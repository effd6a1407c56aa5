//! Exact nearest neighbours by a balanced k-d tree; used for initial scales and neighbour lists.

use rayon::prelude::*;

/// Points in a leaf, at most: below this a scan is quicker than a descent.
const LEAF: usize = 12;
/// Neighbours whose mean squared distance gives a first scale (Kerbl 2023, `simple-knn`).
const SCALE_NEIGHBOURS: usize = 3;

/// The `k` nearest other points of every point, nearest first.
///
/// Shapes: points `[N,3]` → `[N,k]` row-major. Exact; equal distances are ordered by index, so the result does not
/// depend on threads. Distances are those of f32 arithmetic. A point is never its own neighbour, but copies of it are;
/// where there are fewer than k others, the row is filled up with the point's own index (a pair that no smoothness term
/// feels). A NaN coordinate counts as infinitely far. Cost: O(N log N) also when many points coincide.
/// Panics: N exceeds u32.
pub fn knn(points: &[[f32; 3]], k: usize) -> Vec<u32> {
    let found = search(points, k);
    let mut out = vec![0; points.len() * k];
    if k > 0 {
        out.par_chunks_exact_mut(k).zip(found.par_chunks_exact(k)).enumerate().for_each(|(i, (out, found))| {
            for (out, near) in out.iter_mut().zip(found) {
                *out = if near.index == u32::MAX { i as u32 } else { near.index };
            }
        });
    }
    out
}

/// Mean squared distance to the three nearest other points (to as many as there are; alone: 0), scene units squared.
///
/// Source: Kerbl 2023, initial scale = log √ of this.
pub fn mean_square_distance(points: &[[f32; 3]]) -> Vec<f32> {
    let found = search(points, SCALE_NEIGHBOURS);
    let mean = |near: &[Near]| {
        let n = near.iter().filter(|n| n.index != u32::MAX).count();
        near[..n].iter().map(|n| n.square).sum::<f32>() / n.max(1) as f32
    };
    found.par_chunks_exact(SCALE_NEIGHBOURS).map(mean).collect()
}

/// A candidate: squared distance and index, ordered by both.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Near {
    square: f32,
    index: u32,
}

impl Near {
    const NONE: Self = Self { square: f32::INFINITY, index: u32::MAX };

    #[inline(always)]
    fn before(self, other: Self) -> bool {
        self.square < other.square || (self.square == other.square && self.index < other.index)
    }
}

#[derive(Clone, Copy)]
struct Item {
    point: [f32; 3],
    index: u32,
}

/// A half of a split: points of the left child are ≤ `split` on `axis`, those of the right ≥.
#[derive(Clone, Copy)]
struct Node {
    axis: usize,
    split: f32,
    /// Smallest index in the left and the right child: decides ties without a visit.
    least: [u32; 2],
}

/// Level l holds 2^l nodes from position 2^l − 1 on; node i's children are 2i+1 and 2i+2. A range is halved at its
/// middle.
struct Tree {
    items: Vec<Item>,
    nodes: Vec<Node>,
    depth: u32,
}

fn search(points: &[[f32; 3]], k: usize) -> Vec<Near> {
    assert!(u32::try_from(points.len()).is_ok_and(|n| n < u32::MAX), "points are numbered by u32");
    let mut found = vec![Near::NONE; points.len() * k];
    if k == 0 || points.is_empty() {
        return found;
    }
    let tree = Tree::new(points);
    found.par_chunks_exact_mut(k).enumerate().for_each(|(i, best)| {
        let query = Query { tree: &tree, point: points[i], own: i as u32 };
        query.visit(0, 0, (0, points.len()), [0.0; 3], best);
    });
    found
}

impl Tree {
    fn new(points: &[[f32; 3]]) -> Self {
        let mut items: Vec<Item> = points.iter().zip(0..).map(|(&point, index)| Item { point, index }).collect();
        let mut depth = 0;
        let mut ranges = vec![items.len()];
        let mut nodes = Vec::new();
        // All ranges of a level differ by at most one in length, so all leaves are on one level.
        while items.len() >> depth > LEAF {
            let mut parts = Vec::with_capacity(ranges.len());
            let mut rest = items.as_mut_slice();
            for &len in &ranges {
                let (head, tail) = rest.split_at_mut(len);
                parts.push(head);
                rest = tail;
            }
            nodes.par_extend(parts.into_par_iter().map(halve));
            ranges = ranges.iter().flat_map(|&n| [n / 2, n - n / 2]).collect();
            depth += 1;
        }
        Self { items, nodes, depth }
    }
}

/// Orders a range about its middle on its longest axis.
fn halve(part: &mut [Item]) -> Node {
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for item in part.iter() {
        for a in 0..3 {
            low[a] = low[a].min(item.point[a]);
            high[a] = high[a].max(item.point[a]);
        }
    }
    let axis = (1..3).fold(0, |best, a| if high[a] - low[a] > high[best] - low[best] { a } else { best });
    let middle = part.len() / 2;
    // Index breaks ties, so that of equal points the left child holds the smaller indices.
    let (left, split, right) =
        part.select_nth_unstable_by(middle, |a, b| a.point[axis].total_cmp(&b.point[axis]).then(a.index.cmp(&b.index)));
    let least = |items: &[Item]| items.iter().map(|i| i.index).min().unwrap_or(u32::MAX);
    Node { axis, split: split.point[axis], least: [least(left), least(right).min(split.index)] }
}

struct Query<'a> {
    tree: &'a Tree,
    point: [f32; 3],
    own: u32,
}

impl Query<'_> {
    /// Searches a node's range; `offset` is the distance to its box along every axis. `best` is sorted.
    fn visit(&self, node: usize, level: u32, (start, end): (usize, usize), offset: [f32; 3], best: &mut [Near]) {
        if level == self.tree.depth {
            for item in &self.tree.items[start..end] {
                let d: [f32; 3] = std::array::from_fn(|a| self.point[a] - item.point[a]);
                let square = squared(d);
                let near = Near { square: if square.is_nan() { f32::INFINITY } else { square }, index: item.index };
                if item.index != self.own && near.before(best[best.len() - 1]) {
                    insert(best, near);
                }
            }
            return;
        }
        let Node { axis, split, least } = self.tree.nodes[node];
        let middle = start + (end - start) / 2;
        let away = self.point[axis] - split;
        let children = [(2 * node + 1, (start, middle)), (2 * node + 2, (middle, end))];
        let first = usize::from(away > 0.0);
        self.visit(children[first].0, level + 1, children[first].1, offset, best);
        let mut far = offset;
        far[axis] = away;
        // Rounding is monotone, so the box's distance as computed is never above that of a point inside.
        let bound = Near { square: squared(far), index: least[1 - first] };
        if bound.square.is_nan() || bound.before(best[best.len() - 1]) {
            self.visit(children[1 - first].0, level + 1, children[1 - first].1, far, best);
        }
    }
}

#[inline(always)]
fn squared(d: [f32; 3]) -> f32 {
    d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
}

#[inline(always)]
fn insert(best: &mut [Near], near: Near) {
    let mut i = best.len() - 1;
    while i > 0 && near.before(best[i - 1]) {
        best[i] = best[i - 1];
        i -= 1;
    }
    best[i] = near;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    fn cloud(n: usize, seed: u64) -> Vec<[f32; 3]> {
        let rng = Rng::new(seed, "cloud", 0);
        (0..n as u64).map(|i| std::array::from_fn(|a| rng.fork(i).normal(a as u64) as f32)).collect()
    }

    fn brute(points: &[[f32; 3]], k: usize) -> Vec<u32> {
        let mut out = Vec::new();
        for (i, p) in points.iter().enumerate() {
            let mut all: Vec<(f32, u32)> = (0..points.len())
                .filter(|&j| j != i)
                .map(|j| (squared(std::array::from_fn(|a| p[a] - points[j][a])), j as u32))
                .collect();
            all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            out.extend((0..k).map(|n| all.get(n).map_or(i as u32, |x| x.1)));
        }
        out
    }

    #[test]
    fn equals_brute_force_also_with_ties_and_few_points() {
        for (n, k) in [(0, 3), (1, 3), (2, 3), (4, 4), (13, 5), (500, 3), (777, 8)] {
            let points = cloud(n, n as u64);
            assert_eq!(knn(&points, k), brute(&points, k), "{n} points, k = {k}");
        }
        // A lattice is all ties.
        let lattice: Vec<[f32; 3]> =
            (0..1000).map(|i| [(i % 10) as f32, (i / 10 % 10) as f32, (i / 100) as f32]).collect();
        assert_eq!(knn(&lattice, 7), brute(&lattice, 7));
        let mut copies = cloud(100, 1);
        copies.extend_from_within(..);
        copies.extend_from_within(..50);
        assert_eq!(knn(&copies, 4), brute(&copies, 4));
    }

    #[test]
    fn coinciding_points_cost_no_more() {
        let points = vec![[1.0, 2.0, 3.0]; 50_000];
        let start = std::time::Instant::now();
        let found = knn(&points, 3);
        assert_eq!((&found[..3], &found[300..303]), (&[1, 2, 3][..], &[0, 1, 2][..]));
        assert!(mean_square_distance(&points).iter().all(|d| *d == 0.0));
        assert!(start.elapsed().as_secs() < 5, "quadratic work on equal points");
    }

    #[test]
    fn mean_distance() {
        let points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0], [50.0, 0.0, 0.0]];
        let d = mean_square_distance(&points);
        assert!((d[0] - (1.0 + 4.0 + 9.0) / 3.0).abs() < 1e-6, "{d:?}");
        assert_eq!(mean_square_distance(&points[..1]), [0.0]);
        assert_eq!(mean_square_distance(&points[..2]), [1.0, 1.0]);
        assert_eq!(knn(&[[f32::NAN; 3], [0.0; 3], [1.0; 3]], 1)[1], 2);
    }
}
