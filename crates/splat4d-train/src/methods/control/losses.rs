//! Losses on control nodes, and on what ties Gaussians to them.
//!
//! Weights: SC-GS has ARAP 1e-4 (sum over edges), elastic 1e-3 and acceleration 1e-5 in its node stage.

use crate::loss::arap::{OWN_FLOOR, acceleration, arap, elastic};
use crate::loss::graph::{Graph, Weigh};
use crate::loss::terms::{ParamLoss, Probe, ProbeLoss, StepInfo};
use splat4d::layers::Scene;
use splat4d::math::{Real, Rng};
use splat4d::scene::{Grads, Rows, Space, Table, Time};

/// Neighbours of a node in the graph of ARAP (SC-GS).
const ARAP_NEIGHBOURS: usize = 10;
/// Neighbours whose distances are to stay (SC-GS).
const ELASTIC_NEIGHBOURS: usize = 2;
/// Times that elastic distances are compared at (SC-GS).
const ELASTIC_TIMES: usize = 8;
/// Width of the window of times of ARAP and elastic distances, of the clip (SC-GS).
const WINDOW: f64 = 0.05;
/// Acceleration is taken over this many frames to both sides (SC-GS).
const ACCELERATION_FRAMES: f64 = 3.0;

/// Positions of all rows of a result.
fn positions<F: Real>(seen: &Table<F>) -> Vec<[F; 3]> {
    (0..seen.rows()).map(|r| seen.read::<3>(r, 0)).collect()
}

/// Adds gradients of positions to a result's gradient.
fn give<F: Real>(to: &mut Table<F>, d: &[[F; 3]]) {
    d.iter().enumerate().for_each(|(r, d)| to.add(r, 0, *d));
}

/// One probe of the nodes of the first layer that has any.
fn nodes_at<F: Real>(scene: &Scene<F>, times: Vec<Time>) -> Vec<Probe> {
    let layer = scene.layers.iter().position(|l| l.params.rows_of(Space::Nodes) > 1);
    layer.map(|layer| Probe { layer, of: Space::Nodes, rows: None, times }).into_iter().collect()
}

/// Draws the random numbers of one step.
fn draw(info: &StepInfo, purpose: &str) -> Rng {
    Rng::new(info.seed, purpose, info.iteration as u64)
}

/// Nodes move as rigidly as possible from the time of the view to one near it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct NodeArap {
    /// Weight of the mean squared misfit in units of the extent.
    pub weight: f64,
    /// The scene's extent.
    pub extent: f64,
    /// First and last second.
    pub clip: [f64; 2],
}

impl<F: Real> ProbeLoss<F> for NodeArap {
    fn name(&self) -> &str {
        "node_arap"
    }

    fn probes(&self, scene: &Scene<F>, info: &StepInfo) -> Vec<Probe> {
        let Some(&t) = info.times.first() else { return Vec::new() };
        let length = self.clip[1] - self.clip[0];
        let near = t.0 + WINDOW * length * (2.0 * draw(info, "node_arap").uniform(0) - 1.0);
        let near = near.clamp(self.clip[0], self.clip[1]);
        if near == t.0 { Vec::new() } else { nodes_at(scene, vec![t, Time(near)]) }
    }

    fn eval(&self, _: &Scene<F>, _: &[Probe], seen: &[Vec<Table<F>>], d: &mut [Vec<Table<F>>]) -> f64 {
        let [first, second] = [positions(&seen[0][0]), positions(&seen[0][1])];
        let graph = Graph::new(&first, ARAP_NEIGHBOURS, Weigh::Median(1.0));
        let mut grads = [vec![[F::ZERO; 3]; first.len()], vec![[F::ZERO; 3]; first.len()]];
        let [d_first, d_second] = &mut grads;
        let weight = self.weight / (self.extent * self.extent);
        let value = arap(&graph, [&first, &second], weight, [d_first, d_second]);
        grads.iter().zip(&mut d[0]).for_each(|(g, d)| give(d, g));
        value
    }
}

/// Distances between neighbouring nodes are constant over a small window of time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct NodeElastic {
    /// Weight; the loss has no unit.
    pub weight: f64,
    /// First and last second.
    pub clip: [f64; 2],
}

impl<F: Real> ProbeLoss<F> for NodeElastic {
    fn name(&self) -> &str {
        "node_elastic"
    }

    fn probes(&self, scene: &Scene<F>, info: &StepInfo) -> Vec<Probe> {
        let Some(&t) = info.times.first() else { return Vec::new() };
        let (rng, length) = (draw(info, "node_elastic"), self.clip[1] - self.clip[0]);
        let time = |i: usize| t.0 + WINDOW * length * (rng.uniform(i as u64) - 0.5);
        let times = (0..ELASTIC_TIMES).map(|i| Time(time(i).clamp(self.clip[0], self.clip[1]))).collect();
        nodes_at(scene, times)
    }

    fn eval(&self, _: &Scene<F>, _: &[Probe], seen: &[Vec<Table<F>>], d: &mut [Vec<Table<F>>]) -> f64 {
        let at: Vec<Vec<[F; 3]>> = seen[0].iter().map(positions).collect();
        let graph = Graph::new(&at[0], ELASTIC_NEIGHBOURS, Weigh::Uniform);
        let mut grads = vec![vec![[F::ZERO; 3]; at[0].len()]; at.len()];
        let views: Vec<&[[F; 3]]> = at.iter().map(Vec::as_slice).collect();
        let mut d_views: Vec<&mut [[F; 3]]> = grads.iter_mut().map(Vec::as_mut_slice).collect();
        let value = elastic(&graph, &views, OWN_FLOOR, self.weight, &mut d_views);
        grads.iter().zip(&mut d[0]).for_each(|(g, d)| give(d, g));
        value
    }
}

/// Nodes change their velocity as little as possible.
#[derive(Clone, Copy, Debug)]
pub(crate) struct NodeAcceleration {
    /// Weight; the loss has no unit.
    pub weight: f64,
    /// First and last second.
    pub clip: [f64; 2],
    /// Seconds a frame.
    pub step: f64,
}

impl<F: Real> ProbeLoss<F> for NodeAcceleration {
    fn name(&self) -> &str {
        "node_acceleration"
    }

    fn probes(&self, scene: &Scene<F>, info: &StepInfo) -> Vec<Probe> {
        let reach = (ACCELERATION_FRAMES * self.step).min(0.5 * (self.clip[1] - self.clip[0]));
        let Some(t) = info.times.first().map(|t| t.0.clamp(self.clip[0] + reach, self.clip[1] - reach)) else {
            return Vec::new();
        };
        if reach > 0.0 { nodes_at(scene, [t - reach, t, t + reach].map(Time).to_vec()) } else { Vec::new() }
    }

    fn eval(&self, _: &Scene<F>, _: &[Probe], seen: &[Vec<Table<F>>], d: &mut [Vec<Table<F>>]) -> f64 {
        let at: [Vec<[F; 3]>; 3] = std::array::from_fn(|i| positions(&seen[0][i]));
        let mut grads: [Vec<[F; 3]>; 3] = std::array::from_fn(|i| vec![[F::ZERO; 3]; at[i].len()]);
        let [a, b, c] = &mut grads;
        let value = acceleration([&at[0], &at[1], &at[2]], OWN_FLOOR, self.weight, [a, b, c]);
        grads.iter().zip(&mut d[0]).for_each(|(g, d)| give(d, g));
        value
    }
}

/// Mean of the motion mask: what need not move rests.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MaskSize {
    /// Weight.
    pub weight: f64,
}

impl<F: Real> ParamLoss<F> for MaskSize {
    fn name(&self) -> &str {
        "motion_mask"
    }

    fn eval(&self, scene: &Scene<F>, _: &StepInfo, d: &mut [Grads<F>]) -> f64 {
        let mut sum = 0.0;
        for (layer, d) in scene.layers.iter().zip(d) {
            let p = &layer.params;
            let Some(mask) = p.find("motion_mask").filter(|&k| p[k].width() > 0) else { continue };
            let active: Vec<usize> = (0..p.len()).filter(|&i| d.active(Space::Gaussians)[i]).collect();
            let weight = self.weight / active.len().max(1) as f64;
            let [d_mask] = d.of([mask]);
            for i in active {
                let m = p[mask].get(i, 0).sigmoid();
                sum += weight * m.f64();
                d_mask.add(i, 0, [F::of(weight) * m * (F::ONE - m)]);
            }
        }
        sum
    }
}

/// Mean |x| of a table of the nodes: few shared motions a node (DynMF).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sparse {
    /// Weight.
    pub weight: f64,
    /// The table.
    pub table: &'static str,
}

impl<F: Real> ParamLoss<F> for Sparse {
    fn name(&self) -> &str {
        "sparse"
    }

    fn eval(&self, scene: &Scene<F>, _: &StepInfo, d: &mut [Grads<F>]) -> f64 {
        let mut sum = 0.0;
        for (layer, d) in scene.layers.iter().zip(d) {
            let p = &layer.params;
            let Some(key) = p.find(self.table) else { continue };
            let (rows, width) = (p[key].rows(), p[key].width());
            let weight = self.weight / (rows * width).max(1) as f64;
            d.activate(Space::Nodes, Rows::All);
            let [d] = d.of([key]);
            for (row, col) in (0..rows).flat_map(|row| (0..width).map(move |col| (row, col))) {
                let x = p[key].get(row, col);
                sum += weight * x.abs().f64();
                let sign = if x == F::ZERO { F::ZERO } else { x / x.abs() };
                d.add(row, col, [F::of(weight) * sign]);
            }
        }
        sum
    }
}
