//! Local frames of points that turn with the points: principal axes of each point's neighbourhood, with signs by the
//! third moment. Quantities in such frames do not change when the scene rotates.
//!
//! Axes are ill-defined where two moments nearly agree, and signs where the neighbourhood is symmetric. There a point
//! takes what it lacks from its parent in a spanning forest of the neighbour graph (in flat space parallel transport
//! leaves axes unchanged), and a root from the principal axes of all points. Frames are right-handed, so that mirrored
//! scenes are not mirrored by them. They are piecewise smooth in the points at best, hence computed when the set of
//! points changes and held fixed otherwise.

use crate::math::knn::knn;
use crate::math::sym3;
use crate::math::vec3::{cross, dot};
use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// Neighbours whose offsets make a frame.
pub(crate) const NEIGHBOURS: usize = 12;
/// Relative gap of moments (of the largest) below which an axis is ill-defined; the same for third moments.
const LEAST_GAP: f64 = 0.05;

/// A frame: row i of the matrix holds the world component i of the three axes (world = frame · local).
pub(crate) type Frame = [[f64; 3]; 3];

/// The world's own axes.
pub(crate) const WORLD: Frame = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

/// The `count` nearest other points' offsets, nearest first, row after row; zero where there are too few points.
pub(crate) fn offsets(points: &[[f64; 3]], count: usize) -> Vec<[f64; 3]> {
    let near = knn(&single(points), count);
    near.iter().enumerate().map(|(i, &j)| minus(points[j as usize], points[i / count])).collect()
}

/// A frame a point.
pub(crate) fn local_frames(points: &[[f64; 3]]) -> Vec<Frame> {
    let near = knn(&single(points), NEIGHBOURS);
    let own: Vec<Axes> = near.chunks_exact(NEIGHBOURS).enumerate().map(|(i, n)| Axes::of(points, i, n)).collect();
    let center = mean(points);
    let all: Vec<[f64; 3]> = points.iter().map(|p| minus(*p, center)).collect();
    let whole = Axes::new(&all, &vec![1.0; all.len()]).complete(&WORLD);
    let mut frames = vec![WORLD; points.len()];
    let mut done = vec![false; points.len()];
    // Roots in the order of how well-defined their axes are; the index decides ties.
    let mut roots: Vec<usize> = (0..points.len()).collect();
    roots.sort_by(|&a, &b| own[b].certainty().total_cmp(&own[a].certainty()).then(a.cmp(&b)));
    let around = symmetric(&near, points.len());
    for root in roots {
        let mut edges = BinaryHeap::from([Edge { square: 0.0, to: root, parent: None }]);
        // Prim's algorithm: the shortest edge to a new point next.
        while let Some(Edge { to, parent, .. }) = edges.pop() {
            if std::mem::replace(&mut done[to], true) {
                continue;
            }
            frames[to] = own[to].complete(parent.map_or(&whole, |p| &frames[p]));
            for &next in &around[to] {
                let away = minus(points[next], points[to]);
                edges.push(Edge { square: dot(away, away), to: next, parent: Some(to) });
            }
        }
    }
    frames
}

/// The mean of the points.
pub(crate) fn mean(points: &[[f64; 3]]) -> [f64; 3] {
    [0, 1, 2].map(|k| points.iter().map(|p| p[k]).sum::<f64>() / points.len().max(1) as f64)
}

fn single(points: &[[f64; 3]]) -> Vec<[f32; 3]> {
    points.iter().map(|p| p.map(|x| x as f32)).collect()
}

fn symmetric(near: &[u32], count: usize) -> Vec<Vec<usize>> {
    let mut around = vec![Vec::new(); count];
    for (i, &j) in near.iter().enumerate() {
        around[i / NEIGHBOURS].push(j as usize);
        around[j as usize].push(i / NEIGHBOURS);
    }
    around
}

/// An edge that waits; the heap's greatest is the shortest, of equally long ones that with the smallest indices.
struct Edge {
    square: f64,
    to: usize,
    parent: Option<usize>,
}

impl Ord for Edge {
    fn cmp(&self, other: &Self) -> Ordering {
        let order = other.square.total_cmp(&self.square);
        order.then_with(|| (other.to, other.parent).cmp(&(self.to, self.parent)))
    }
}

impl PartialOrd for Edge {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Edge {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Edge {}

/// Axes of a neighbourhood and their certainty.
struct Axes {
    /// Unit eigenvectors, of the largest moment first.
    vectors: [[f64; 3]; 3],
    /// Relative gaps between the first and second, second and third moment.
    gaps: [f64; 2],
    /// Third moments along the vectors over those of the absolute values.
    skews: [f64; 3],
}

impl Axes {
    /// Of a point's neighbours; near ones weigh more, w = exp(−d²/2d̄²).
    fn of(points: &[[f64; 3]], i: usize, near: &[u32]) -> Self {
        let away: Vec<[f64; 3]> = near.iter().map(|&j| minus(points[j as usize], points[i])).collect();
        let square = away.iter().map(|o| dot(*o, *o)).sum::<f64>() / near.len().max(1) as f64;
        let weights: Vec<f64> =
            away.iter().map(|o| if square > 0.0 { (-0.5 * dot(*o, *o) / square).exp() } else { 0.0 }).collect();
        Self::new(&away, &weights)
    }

    fn new(away: &[[f64; 3]], weights: &[f64]) -> Self {
        let mut cov = [0.0; 6];
        for (o, w) in away.iter().zip(weights) {
            let products = [o[0] * o[0], o[0] * o[1], o[0] * o[2], o[1] * o[1], o[1] * o[2], o[2] * o[2]];
            (0..6).for_each(|k| cov[k] += w * products[k]);
        }
        let finite = cov.iter().all(|x| x.is_finite());
        let (values, frame) = if finite { sym3::eigen(cov) } else { ([0.0; 3], WORLD) };
        let vectors = [0, 1, 2].map(|axis| [0, 1, 2].map(|k| frame[k][axis]));
        let gap = |a: f64, b: f64| if values[0] > 0.0 { (a - b) / values[0] } else { 0.0 };
        let skews = vectors.map(|v| {
            let cubes = away.iter().zip(weights).map(|(o, w)| w * dot(*o, v).powi(3));
            let (sum, size) = cubes.fold((0.0, 0.0), |(s, a): (f64, f64), x| (s + x, a + x.abs()));
            if size > 0.0 && size.is_finite() { sum / size } else { 0.0 }
        });
        Self { vectors, gaps: [gap(values[0], values[1]), gap(values[1], values[2])], skews }
    }

    /// Distance of the least certain part from being ill-defined.
    fn certainty(&self) -> f64 {
        self.gaps[0].min(self.gaps[1]).min(self.skews[0].abs()).min(self.skews[1].abs())
    }

    /// The frame, with axes that the neighbourhood leaves undefined taken from `parent`.
    fn complete(&self, parent: &Frame) -> Frame {
        let column = |f: &Frame, axis: usize| [0, 1, 2].map(|k| f[k][axis]);
        let sure = self.gaps.map(|g| g >= LEAST_GAP);
        let signed = |axis: usize| {
            let (v, skew) = (self.vectors[axis], self.skews[axis]);
            let side = if skew.abs() >= LEAST_GAP { skew } else { dot(v, column(parent, axis)) };
            if side < 0.0 { v.map(|x| -x) } else { v }
        };
        let (first, second) = match sure {
            [true, true] => (signed(0), signed(1)),
            // One axis is known: the parent's others are turned into the plane across it.
            [true, false] => {
                let first = signed(0);
                (first, across(column(parent, 1), first).unwrap_or_else(|| across_any(parent, first)))
            }
            [false, true] => {
                // The third axis has no use but to define the plane; its sign follows from the other two.
                let third = signed(2);
                let first = across(column(parent, 0), third).unwrap_or_else(|| across_any(parent, third));
                (first, cross(third, first))
            }
            [false, false] => (column(parent, 0), column(parent, 1)),
        };
        let third = cross(first, second);
        [0, 1, 2].map(|k| [first[k], second[k], third[k]])
    }
}

/// The unit vector of v's part across a unit vector; none if v points along it.
fn across(v: [f64; 3], axis: [f64; 3]) -> Option<[f64; 3]> {
    let along = dot(v, axis);
    let rest = [0, 1, 2].map(|k| v[k] - along * axis[k]);
    let size = dot(rest, rest).sqrt();
    // A tenth of the length: below, the direction is mostly rounding and noise.
    (size > 0.1).then(|| rest.map(|x| x / size))
}

/// Of three axes one always has a part across a unit vector.
fn across_any(frame: &Frame, axis: [f64; 3]) -> [f64; 3] {
    let columns = [0, 1, 2].map(|a| [0, 1, 2].map(|k| frame[k][a]));
    columns.into_iter().find_map(|c| across(c, axis)).unwrap_or([1.0, 0.0, 0.0])
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|k| a[k] - b[k])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::{Rng, quat};

    fn cloud(n: usize, flat: f64, seed: u64) -> Vec<[f64; 3]> {
        let rng = Rng::new(seed, "cloud", 0);
        (0..n as u64).map(|i| [0, 1, 2].map(|k| rng.fork(i).normal(k) * if k == 2 { flat } else { 1.0 })).collect()
    }

    fn turned(r: &Frame, p: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|i| dot(r[i], p))
    }

    fn largest_difference(a: &[Frame], b: &[Frame]) -> f64 {
        let pairs = a.iter().zip(b).map(|(a, b)| (0..9).map(|k| (a[k / 3][k % 3] - b[k / 3][k % 3]).abs()));
        pairs.flatten().fold(0.0, f64::max)
    }

    #[test]
    fn frames_are_right_handed_and_turn_with_the_points() {
        let rng = Rng::new(8, "turns", 0);
        for (n, flat) in [(60, 1.0), (60, 0.2), (60, 0.0), (5, 1.0), (14, 1.0)] {
            let points = cloud(n, flat, n as u64);
            let frames = local_frames(&points);
            for f in &frames {
                let pose = crate::math::Se3 { rotation: *f, translation: [0.0; 3] };
                assert!(pose.orthogonality_error() < 1e-9 && (pose.det() - 1.0).abs() < 1e-9, "{f:?}");
            }
            for i in 0..10 {
                let r = quat::to_rotation(quat::normalize(std::array::from_fn(|k| rng.fork(i).normal(k as u64))).0);
                let moved: Vec<_> = points.iter().map(|p| turned(&r, *p).map(|x| x + 0.5)).collect();
                let expected: Vec<Frame> = frames
                    .iter()
                    .map(|f| {
                        let columns = [0, 1, 2].map(|a| turned(&r, [0, 1, 2].map(|k| f[k][a])));
                        [0, 1, 2].map(|k| [0, 1, 2].map(|a| columns[a][k]))
                    })
                    .collect();
                let worst = largest_difference(&local_frames(&moved), &expected);
                assert!(worst < 1e-5, "{n} points, flatness {flat}: frames differ by {worst}");
            }
        }
    }

    #[test]
    fn symmetric_and_degenerate_points_have_frames_too() {
        for points in [vec![], vec![[1.0; 3]], vec![[0.5; 3]; 40], (0..30).map(|i| [f64::from(i), 0.0, 0.0]).collect()]
        {
            for f in local_frames(&points) {
                let pose = crate::math::Se3 { rotation: f, translation: [0.0; 3] };
                assert!(pose.orthogonality_error() < 1e-9, "{f:?}");
            }
        }
        // A lattice: every inner point has a symmetric neighbourhood. Its frame is that of its neighbours.
        let lattice: Vec<[f64; 3]> =
            (0..125).map(|i| [f64::from(i % 5), f64::from(i / 5 % 5), f64::from(i / 25)]).collect();
        assert!(local_frames(&lattice).iter().flatten().flatten().all(|x| x.is_finite()));
    }

    #[test]
    fn nearly_coinciding_points_use_the_parents_axes() {
        // Two of three moments agree up to noise: without the fallback the axes would be those of the noise.
        let ring: Vec<[f64; 3]> = (0..12)
            .map(|i| {
                let a = f64::from(i) * std::f64::consts::TAU / 12.0;
                [a.cos(), a.sin(), 0.1 * a.cos() * a.cos()]
            })
            .collect();
        let weights = vec![1.0; 12];
        let parent = quat::to_rotation(quat::normalize([1.0, 0.1, 0.2, 0.3]).0);
        let frame = |tilt: f64| {
            let mut points = ring.clone();
            points[0][0] += tilt;
            Axes::new(&points, &weights).complete(&parent)
        };
        assert!(largest_difference(&[frame(1e-3)], &[frame(-1e-3)]) < 0.05);
    }
}
