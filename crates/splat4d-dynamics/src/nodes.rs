//! Nodes with identity on the dynamic regions of a scene with any motion model.
//!
//! A node is tied to the Gaussians around it. From the last observed time it is followed tick by tick: its pose is the
//! rigid motion that fits its members best. Where members fade (models with short-lived Gaussians), other Gaussians
//! around the node replace them at the tick before, so the node lasts longer than any Gaussian.

use crate::learnt::LEAST_TICKS;
use crate::paths::{Moment, Paths, Pose};
use crate::smooth::smooth;
use crate::{Error, Result};
use splat4d::layers::{Evaluation, FAR_SHELL, Scene};
use splat4d::math::knn::{knn, mean_square_distance};
use splat4d::math::mat3::procrustes;
use splat4d::math::se3::{add, mat_vec, norm, sub};
use splat4d::math::{quat, se3};
use splat4d::motion::skin::farthest_points;
use splat4d::scene::splats::SPLAT_OPACITY;
use splat4d::scene::{Rows, Space, Table, Time};

/// Most nodes.
pub const MAX_NODES: usize = 128;
/// Gaussians that carry a node.
const MEMBERS: usize = 24;
/// Fainter Gaussians carry nothing.
const OPAQUE: f32 = 0.1;
/// Gaussians slower than this share of the scene's size per second are static: Gaussians of uniform surfaces drift
/// unseen.
const SPEED: f64 = 0.03;
/// Of the opaque Gaussians: how many make up the scene's size.
const CORE: f64 = 0.9;
/// Share of its members' weight at which a node takes new ones.
const WORN: f32 = 0.5;
/// Weight of the rotation before, of the members' covariance: decides where these are on a line.
const KEEP: f64 = 1e-3;
/// A Gaussian farther from its neighbours than this multiple of the median carries no node: it floats alone.
const LONELY: f32 = 3.0;
/// Gaussians that were opaque at fewer ticks have no defined speed.
const SEEN: u32 = 3;
/// Neighbours whose majority states whether a Gaussian moves.
const VOTERS: usize = 8;

/// Everything that is known at the last observed time.
#[derive(Clone, Debug)]
pub struct Observed {
    /// Smooth paths of the nodes, up to the last observed tick.
    pub paths: Paths,
    /// By layer: which Gaussians move.
    pub moving: Vec<Vec<bool>>,
    /// The scene's size, scene units: nine tenths of its opaque Gaussians are nearer to its middle.
    pub size: f64,
}

/// The Gaussians of a scene at a time, all layers after each other.
struct Snapshot {
    x: Vec<[f32; 3]>,
    alpha: Vec<f32>,
}

fn snapshot(scene: &Scene<f32>, t: f64) -> Snapshot {
    let (mut x, mut alpha) = (Vec::new(), Vec::new());
    for layer in &scene.layers {
        let seen = Evaluation::of_layer(layer, Space::Gaussians, Rows::All, Time(t));
        // A far shell is no part of the scene's size.
        let (out, there) = (seen.tape(0).out(), layer.spans_over(Time(t)) && layer.name != FAR_SHELL);
        for row in 0..out.rows() {
            let mean = out.read::<3>(row, 0);
            let sound = there && mean.iter().all(|c| c.is_finite());
            x.push(mean);
            alpha.push(if sound { out.get(row, SPLAT_OPACITY) } else { 0.0 });
        }
    }
    Snapshot { x, alpha }
}

/// At most `count` nodes on dynamic regions over the `ticks` (seconds, ascending, one per frame), of which the last is
/// the last observed one. The scene is not evaluated at other times.
///
/// Errors: too few ticks, no nodes or more than [`MAX_NODES`], nothing that moves.
pub fn observe(scene: &Scene<f32>, ticks: &[f64], count: usize) -> Result<Observed> {
    if ticks.len() < LEAST_TICKS {
        return Err(Error::input(format!("{} observed frames are too few to predict from", ticks.len()))
            .remedy(format!("Observe {LEAST_TICKS} at least: train with a larger --observe, or a longer capture")));
    }
    if !(1..=MAX_NODES).contains(&count) {
        return Err(Error::input(format!("{count} nodes cannot be")).remedy(format!("Give 1 to {MAX_NODES}")));
    }
    let last = snapshot(scene, ticks[ticks.len() - 1]);
    let (middle, size) = extent(&last);
    let (fast, moving) = moving(scene, ticks, &last, size);
    let near = |x: &[f32; 3]| norm(sub(x.map(f64::from), middle)) <= 2.0 * size;
    let carriers: Vec<[f32; 3]> = (0..last.x.len())
        .filter(|&i| fast[i] && moving[i] && last.alpha[i] >= OPAQUE && near(&last.x[i]))
        .map(|i| last.x[i])
        .collect();
    let carriers = sociable(carriers);
    if carriers.len() < 2 {
        return Err(Error::input("nothing moves in the observed part: there is nothing to predict")
            .remedy("Give a capture with motion, or a run whose motion model represents it"));
    }
    let mut table = Table::new(&[("mean", 3)], carriers.len());
    carriers.iter().enumerate().for_each(|(i, x)| table.write(i, 0, *x));
    let start: Moment = farthest_points(&table, count).into_iter().map(|x| Pose::at(centre(x, &carriers))).collect();
    let back: Vec<f64> = ticks.iter().rev().copied().collect();
    let mut moments = follow_among(scene, &start, &back, &fast);
    moments.reverse();
    let mut first = 0;
    let moving = scene.layers.iter().map(|l| {
        first += l.params.len();
        moving[first - l.params.len()..first].to_vec()
    });
    Ok(Observed { moving: moving.collect(), paths: smooth(&Paths { moments }), size })
}

/// Follows nodes through a scene from their positions at the first of `ticks`, in either direction: one time per tick.
/// So a motion model extrapolates to later times, and a scene that saw them what was true.
pub fn follow(scene: &Scene<f32>, start: &Moment, ticks: &[f64]) -> Vec<Moment> {
    if ticks.len() < 2 {
        return vec![start.clone()];
    }
    let first = snapshot(scene, ticks[0]);
    let mut fast = moving(scene, ticks, &first, extent(&first).1).0;
    if !fast.contains(&true) {
        // Then all are static together.
        fast.fill(true);
    }
    follow_among(scene, start, ticks, &fast)
}

/// As [`follow`], carried by Gaussians for which `among` holds (all layers after each other), whether they move or not.
pub fn follow_among(scene: &Scene<f32>, start: &Moment, ticks: &[f64], among: &[bool]) -> Vec<Moment> {
    let mut out = vec![start.clone()];
    let mut ties: Vec<Option<Tie>> = vec![None; start.len()];
    let mut before = snapshot(scene, ticks[0]);
    for &t in &ticks[1..] {
        let now = snapshot(scene, t);
        let old = out.last().expect("it starts with one").clone();
        let moment = old.iter().zip(&mut ties).map(|(pose, tie)| {
            if tie.as_ref().is_none_or(|tie| tie.worn(&now)) {
                *tie = Some(Tie::new(pose, &before, &now, among));
            }
            tie.as_ref().expect("it was just made").pose(pose, &now)
        });
        out.push(moment.collect());
        before = now;
    }
    out
}

/// Carriers of a node: Gaussians at a tick, and the node there.
#[derive(Clone)]
struct Tie {
    pose: Pose,
    members: Vec<(usize, [f64; 3], f32)>,
}

impl Tie {
    fn new(pose: &Pose, before: &Snapshot, now: &Snapshot, among: &[bool]) -> Self {
        let square = |i: usize| (0..3).map(|c| (f64::from(before.x[i][c]) - pose.x[c]).powi(2)).sum::<f64>();
        let mut order: Vec<(f64, usize)> = (0..now.x.len())
            .filter(|&i| among[i] && before.alpha[i].min(now.alpha[i]) >= OPAQUE)
            .map(|i| (square(i), i))
            .collect();
        let count = MEMBERS.min(order.len());
        if count < order.len() {
            order.select_nth_unstable_by(count, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        }
        order.truncate(count);
        order.sort_by_key(|o| o.1);
        let member = |&(_, i): &(f64, usize)| (i, before.x[i].map(f64::from), before.alpha[i]);
        Self { pose: *pose, members: order.iter().map(member).collect() }
    }

    fn weight(m: &(usize, [f64; 3], f32), now: &Snapshot) -> f32 {
        if now.alpha[m.0] >= OPAQUE { m.2.min(now.alpha[m.0]) } else { 0.0 }
    }

    /// Whether too few members are left.
    fn worn(&self, now: &Snapshot) -> bool {
        let (all, left) = self.members.iter().fold((0.0, 0.0), |(a, l), m| (a + m.2, l + Self::weight(m, now)));
        left <= WORN * all
    }

    /// The node's pose by the rigid motion of its members; where there are none, as before.
    fn pose(&self, before: &Pose, now: &Snapshot) -> Pose {
        let weights: Vec<f64> = self.members.iter().map(|m| f64::from(Self::weight(m, now))).collect();
        let all: f64 = weights.iter().sum();
        if all <= 0.0 {
            return *before;
        }
        let (mut from, mut to) = ([0.0; 3], [0.0; 3]);
        for (m, w) in self.members.iter().zip(&weights) {
            from = add(from, se3::scale(m.1, w / all));
            to = add(to, se3::scale(now.x[m.0].map(f64::from), w / all));
        }
        let (mut cov, mut size) = ([[0.0; 3]; 3], 0.0);
        for (m, w) in self.members.iter().zip(&weights) {
            let (a, b) = (sub(now.x[m.0].map(f64::from), to), sub(m.1, from));
            size += w * norm(a) * norm(b);
            (0..3).for_each(|r| (0..3).for_each(|c| cov[r][c] += w * a[r] * b[c]));
        }
        let since = quat::to_rotation(quat::product(before.q, quat::conjugate(self.pose.q)));
        let rotation = if size > 0.0 {
            (0..3).for_each(|r| (0..3).for_each(|c| cov[r][c] += KEEP * size * since[r][c]));
            procrustes(cov)
        } else {
            since
        };
        Pose {
            x: add(to, mat_vec(&rotation, sub(self.pose.x, from))),
            q: quat::normalize(quat::product(quat::from_rotation(&rotation), self.pose.q)).0,
        }
    }
}

/// The middle of the opaque Gaussians (medians), and the radius that contains most of them.
fn extent(look: &Snapshot) -> ([f64; 3], f64) {
    let opaque: Vec<[f64; 3]> =
        (0..look.x.len()).filter(|&i| look.alpha[i] >= OPAQUE).map(|i| look.x[i].map(f64::from)).collect();
    let quantile = |mut v: Vec<f64>, q: f64| {
        v.sort_by(f64::total_cmp);
        v.get((q * v.len() as f64) as usize).copied().unwrap_or(0.0)
    };
    let middle: [f64; 3] = std::array::from_fn(|c| quantile(opaque.iter().map(|x| x[c]).collect(), 0.5));
    (middle, quantile(opaque.iter().map(|x| norm(sub(*x, middle))).collect(), CORE))
}

/// Which Gaussians are fast while they are opaque, and which move: of those that are opaque finally the ones most of
/// whose neighbours are fast. All Gaussians of a body move; drifting or flickering ones do so alone.
fn moving(scene: &Scene<f32>, ticks: &[f64], last: &Snapshot, size: f64) -> (Vec<bool>, Vec<bool>) {
    let n = last.x.len();
    let mut bounds = vec![[[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]]; n];
    let mut seen = vec![0u32; n];
    for &t in ticks {
        let now = snapshot(scene, t);
        for i in (0..n).filter(|&i| now.alpha[i] >= OPAQUE) {
            seen[i] += 1;
            for c in 0..3 {
                bounds[i][0][c] = bounds[i][0][c].min(now.x[i][c]);
                bounds[i][1][c] = bounds[i][1][c].max(now.x[i][c]);
            }
        }
    }
    let tick = (ticks[ticks.len() - 1] - ticks[0]) / (ticks.len() - 1) as f64;
    let fast = |i: usize| {
        let way = norm(sub(bounds[i][1].map(f64::from), bounds[i][0].map(f64::from)));
        seen[i] >= SEEN && way > SPEED * size * tick * f64::from(seen[i] - 1)
    };
    let own: Vec<bool> = (0..n).map(fast).collect();
    let mut moves = own.clone();
    let alive: Vec<usize> = (0..n).filter(|&i| last.alpha[i] >= OPAQUE).collect();
    let points: Vec<[f32; 3]> = alive.iter().map(|&i| last.x[i]).collect();
    let near = knn(&points, VOTERS);
    for (a, &i) in alive.iter().enumerate() {
        let votes = near[a * VOTERS..(a + 1) * VOTERS].iter().filter(|&&b| own[alive[b as usize]]).count();
        moves[i] = 2 * votes > VOTERS;
    }
    (own, moves)
}

/// Points without those that float alone.
fn sociable(points: Vec<[f32; 3]>) -> Vec<[f32; 3]> {
    let square = mean_square_distance(&points);
    let mut sorted = square.clone();
    sorted.sort_by(f32::total_cmp);
    let most = sorted.get(sorted.len() / 2).map_or(0.0, |m| LONELY * LONELY * m);
    points.into_iter().zip(square).filter(|(_, s)| *s <= most).map(|p| p.0).collect()
}

/// The centre of the points nearest to one: corners of dynamic regions are poor positions to carry it by.
fn centre(of: [f32; 3], points: &[[f32; 3]]) -> [f64; 3] {
    let square = |p: &[f32; 3]| (0..3).map(|c| f64::from(p[c] - of[c]).powi(2)).sum::<f64>();
    let mut order: Vec<(f64, usize)> = points.iter().enumerate().map(|(i, p)| (square(p), i)).collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    order.truncate(MEMBERS);
    let n = order.len() as f64;
    order.iter().fold([0.0; 3], |sum, o| add(sum, se3::scale(points[o.1].map(f64::from), 1.0 / n)))
}

#[cfg(test)]
mod tests;
