//! Poses of nodes at even ticks: what is observed, and what is predicted.

use splat4d::math::mat3::procrustes;
use splat4d::math::quat;
use splat4d::math::se3::{add, mat_vec, norm, scale, sub};

/// Below this angle (radians) the rotation vector is twice the quaternion's vector part, to 1e-13.
const SMALL_ANGLE: f64 = 1e-6;

/// Position and rotation of a node.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Position in the world, scene units.
    pub x: [f64; 3],
    /// Unit quaternion of the rotation since the last observed time.
    pub q: [f64; 4],
}

impl Pose {
    /// Unturned, at a position.
    pub fn at(x: [f64; 3]) -> Self {
        Self { x, q: [1.0, 0.0, 0.0, 0.0] }
    }
}

/// All nodes at one time.
pub type Moment = Vec<Pose>;

/// Paths of nodes at even ticks, one per frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Paths {
    /// \[ticks]\[nodes]; every tick has as many nodes.
    pub moments: Vec<Moment>,
}

impl Paths {
    /// Nodes.
    pub fn nodes(&self) -> usize {
        self.moments.first().map_or(0, Vec::len)
    }

    /// Ticks.
    pub fn len(&self) -> usize {
        self.moments.len()
    }

    /// Whether there is no tick.
    pub fn is_empty(&self) -> bool {
        self.moments.is_empty()
    }

    /// The last tick. Panics: there is none.
    pub fn last(&self) -> &Moment {
        self.moments.last().expect("paths have a tick")
    }

    /// The first `count` ticks.
    pub fn first(&self, count: usize) -> Self {
        Self { moments: self.moments[..count].to_vec() }
    }

    /// Paths of points that do not turn, \[ticks]\[nodes].
    pub fn of_points(points: &[Vec<[f64; 3]>]) -> Self {
        Self { moments: points.iter().map(|m| m.iter().map(|x| Pose::at(*x)).collect()).collect() }
    }

    /// The same with rotations derived from the positions of neighbours, relative to the last tick.
    pub fn turned_by_neighbours(mut self) -> Self {
        let rest = self.last().clone();
        let frames = Neighbours::new(&rest);
        for moment in &mut self.moments {
            frames.turn(&rest, moment);
        }
        self
    }

    /// The size of dynamic regions: the largest distance of a node from the centroid over all ticks, scene units.
    pub fn extent(&self) -> f64 {
        let all = || self.moments.iter().flatten().map(|p| p.x);
        let n = all().count().max(1) as f64;
        let center = all().fold([0.0; 3], |c, x| add(c, scale(x, 1.0 / n)));
        all().map(|x| norm(sub(x, center))).fold(0.0, f64::max)
    }

    /// Displacements from tick to tick: \[ticks − 1]\[nodes].
    pub fn velocities(&self) -> Vec<Vec<[f64; 3]>> {
        self.moments.windows(2).map(|w| w[0].iter().zip(&w[1]).map(|(a, b)| sub(b.x, a.x)).collect()).collect()
    }
}

/// The rotation vector of a unit quaternion, the short way round.
pub fn log(q: [f64; 4]) -> [f64; 3] {
    let q = if q[0] < 0.0 { q.map(|x| -x) } else { q };
    let s = norm([q[1], q[2], q[3]]);
    let angle = 2.0 * s.atan2(q[0]);
    let k = if angle < SMALL_ANGLE { 2.0 } else { angle / s };
    [k * q[1], k * q[2], k * q[3]]
}

/// The unit quaternion of a rotation vector.
pub fn exp(w: [f64; 3]) -> [f64; 4] {
    let angle = norm(w);
    let k = if angle < SMALL_ANGLE { 0.5 } else { (0.5 * angle).sin() / angle };
    quat::normalize([(0.5 * angle).cos(), k * w[0], k * w[1], k * w[2]]).0
}

/// The rotation vector that takes a to b, in the world.
pub fn turn(a: [f64; 4], b: [f64; 4]) -> [f64; 3] {
    log(quat::product(b, quat::conjugate(a)))
}

/// Neighbours of every node, by which rotations follow from positions.
pub struct Neighbours(Vec<Vec<usize>>);

/// Neighbours that determine a node's rotation.
const FRAME_NEIGHBOURS: usize = 6;
/// Weight of the rotation before, of the neighbours' covariance: decides where these are on a line.
const KEEP: f64 = 1e-3;

impl Neighbours {
    /// The nearest nodes of each at rest.
    pub fn new(rest: &Moment) -> Self {
        Self(nearest(rest, FRAME_NEIGHBOURS))
    }

    /// Turns every node as its neighbours have moved about it since `rest`: the nearest rotation, and along what they
    /// leave open as before.
    pub fn turn(&self, rest: &Moment, now: &mut Moment) {
        let before: Vec<[[f64; 3]; 3]> = now.iter().map(|p| quat::to_rotation(p.q)).collect();
        for (k, near) in self.0.iter().enumerate() {
            let mut cov = [[0.0; 3]; 3];
            let mut size = 0.0;
            for &j in near {
                let (a, b) = (sub(now[j].x, now[k].x), sub(rest[j].x, rest[k].x));
                size += norm(a) * norm(b);
                (0..3).for_each(|r| (0..3).for_each(|c| cov[r][c] += a[r] * b[c]));
            }
            if size <= 0.0 {
                continue;
            }
            (0..3).for_each(|r| (0..3).for_each(|c| cov[r][c] += KEEP * size * before[k][r][c]));
            now[k].q = quat::normalize(quat::from_rotation(&procrustes(cov))).0;
        }
    }
}

/// The `count` nearest other nodes of each, nearest first.
pub fn nearest(of: &Moment, count: usize) -> Vec<Vec<usize>> {
    (0..of.len())
        .map(|k| {
            let mut order: Vec<(f64, usize)> =
                (0..of.len()).filter(|&j| j != k).map(|j| (norm(sub(of[j].x, of[k].x)), j)).collect();
            order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            order.into_iter().take(count).map(|o| o.1).collect()
        })
        .collect()
}

/// The position of a point fixed to a node: R (x − p) + p'.
pub fn carried(x: [f64; 3], from: &Pose, to: &Pose) -> [f64; 3] {
    let turn = quat::to_rotation(quat::product(to.q, quat::conjugate(from.q)));
    add(mat_vec(&turn, sub(x, from.x)), to.x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotations_follow_from_neighbours_and_logarithms_undo_exponentials() {
        let w = [0.3, -0.9, 0.5];
        assert!(norm(sub(log(exp(w)), w)) < 1e-12 && norm(log(exp([1e-9, 0.0, 0.0]))) < 1.1e-9);
        let rest: Moment =
            (0..8).map(|i| Pose::at([f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2)])).collect();
        let r = quat::to_rotation(exp(w));
        let mut now: Moment = rest.iter().map(|p| Pose::at(add(mat_vec(&r, p.x), [5.0, 0.0, 1.0]))).collect();
        // The rotation before pulls a little; the second round starts from the result of the first.
        (0..4).for_each(|_| Neighbours::new(&rest).turn(&rest, &mut now));
        for (a, b) in rest.iter().zip(&now) {
            assert!(norm(sub(log(b.q), w)) < 1e-6);
            assert!(norm(sub(carried(add(a.x, [0.1, 0.0, 0.0]), a, b), add(b.x, mat_vec(&r, [0.1, 0.0, 0.0])))) < 1e-6);
        }
    }
}
