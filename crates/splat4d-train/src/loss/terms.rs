//! The contracts of losses that do not look at a picture: on splats at several times, and on raw parameters.

use splat4d::layers::Scene;
use splat4d::math::Real;
use splat4d::scene::{Grads, Space, Table, Time};

/// Where in training a loss is asked.
#[derive(Clone, Debug)]
pub struct StepInfo {
    /// Steps taken before this one.
    pub iteration: usize,
    /// The times of the step's views.
    pub times: Vec<Time>,
    /// Seed of the run.
    pub seed: u64,
    /// Share of the stage that is done, in [0, 1).
    pub progress: f64,
}

/// What a loss over several times wants to see.
#[derive(Clone, Debug)]
pub struct Probe {
    /// Which layer.
    pub layer: usize,
    /// Gaussians or nodes.
    pub of: Space,
    /// Which rows (strictly increasing); `None`: all.
    pub rows: Option<Vec<u32>>,
    /// At which times.
    pub times: Vec<Time>,
}

/// A loss over splats at several times (rigidity pairs, velocities, transport triples).
pub trait ProbeLoss<F: Real>: Send + Sync {
    /// Its name, in recipes and metrics.
    fn name(&self) -> &str;
    /// What it looks at in this step; empty: nothing.
    fn probes(&self, scene: &Scene<F>, info: &StepInfo) -> Vec<Probe>;
    /// The loss. `seen[i][k]` is [rows, 10] of probe i at its k-th time; adds its gradient to `d[i][k]`, of like shape.
    fn eval(&self, scene: &Scene<F>, probes: &[Probe], seen: &[Vec<Table<F>>], d: &mut [Vec<Table<F>>]) -> f64;
}

/// A loss on raw parameters; must add only to rows that are active in `d`.
pub trait ParamLoss<F: Real>: Send + Sync {
    /// Its name, in recipes and metrics.
    fn name(&self) -> &str;
    /// The loss; adds to one `Grads` a layer.
    fn eval(&self, scene: &Scene<F>, info: &StepInfo, d: &mut [Grads<F>]) -> f64;
    /// Rows were edited: whatever was remembered of rows is stale.
    fn on_edit(&self) {}
    /// What a checkpoint must hold of it, if it remembers anything from step to step.
    fn state(&self) -> Vec<u32> {
        Vec::new()
    }
    /// Takes back what [`state`](Self::state) gave.
    fn restore(&self, _state: &[u32]) {}
}
