//! The contracts of losses without images: on splats at several times, and on raw parameters; and of what may be
//! between parameters and images, a [`Codec`].

use crate::Result;
use splat4d::layers::Scene;
use splat4d::math::Real;
use splat4d::render::{ResidentTies, RowWeights};
use splat4d::scene::{Grads, Space, Table, Time};

/// Stage and step of a loss.
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

/// The rows and times that a loss over several times needs to see.
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
    /// The probes of this step; empty: nothing.
    fn probes(&self, scene: &Scene<F>, info: &StepInfo) -> Vec<Probe>;
    /// The loss. `seen[i][k]` is [rows, 10] of probe i at its k-th time; adds its gradient to `d[i][k]`, of like shape.
    fn eval(&self, scene: &Scene<F>, probes: &[Probe], seen: &[Vec<Table<F>>], d: &mut [Vec<Table<F>>]) -> f64;
    /// Rows were edited: whatever was remembered of rows is stale.
    fn on_edit(&self) {}
    /// The state for a checkpoint, if it keeps any from step to step.
    fn state(&self) -> Vec<u32> {
        Vec::new()
    }
    /// Restores the result of [`state`](Self::state) gave.
    fn restore(&self, _state: &[u32]) {}
}

/// A loss on raw parameters that a device can take which keeps them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ResidentLoss {
    /// Means over the rows that are active.
    Rows(RowWeights),
    /// Ties of poses, from [`ParamLoss::ties`].
    Ties,
}

/// A loss on raw parameters; must add only to rows that are active in `d`.
pub trait ParamLoss<F: Real>: Send + Sync {
    /// Its name, in recipes and metrics.
    fn name(&self) -> &str;
    /// The loss; adds to one `Grads` a layer.
    fn eval(&self, scene: &Scene<F>, info: &StepInfo, d: &mut [Grads<F>]) -> f64;
    /// The same for a device; none: the CPU must compute it.
    fn kept(&self) -> Option<ResidentLoss> {
        None
    }
    /// The ties of [`ResidentLoss::Ties`].
    fn ties(&self, _scene: &Scene<F>) -> Option<ResidentTies> {
        None
    }
    /// Rows were edited: whatever was remembered of rows is stale.
    fn on_edit(&self) {}
    /// The state for a checkpoint, if it keeps any from step to step.
    fn state(&self) -> Vec<u32> {
        Vec::new()
    }
    /// Restores the result of [`state`](Self::state) gave.
    fn restore(&self, _state: &[u32]) {}
}

/// A codec between the parameters that learn and the images they are judged by: a file that will hold them coarsely.
/// Images are rendered from the decoded values, and the gradient is passed to the parameters as if there were no
/// difference (the straight-through estimator: Bengio et al. 2013).
pub trait Codec<F: Real>: Send + Sync {
    /// Its name, in messages.
    fn name(&self) -> &str;
    /// Brings `shown` up to date, as far as splats at the given times allow: it is as the last call left it, or, after
    /// [`reset`](Self::reset), a copy of `scene`.
    fn show(&self, scene: &Scene<F>, times: &[Time], shown: &mut Scene<F>);
    /// All of `scene` as a reader would see it. Changes nothing of what `show` remembers.
    fn whole(&self, scene: &Scene<F>) -> Scene<F>;
    /// After a step's gradients, before the parameters' own optimiser: learns what rows share and is notified which
    /// rows are about to change. `progress` is the share of the stage that is done; every rate is multiplied by
    /// `scale`. Returns whether all numbers are finite.
    fn learn(&self, d: &mut [Grads<F>], progress: f64, scale: f64) -> bool;
    /// The scene changed in other ways than by a step: whatever was shown of it is stale.
    fn reset(&self) {}
    /// The state for a checkpoint; nothing for a codec that has not begun.
    fn state(&self) -> Vec<u32> {
        Vec::new()
    }
    /// Restores the result of [`state`](Self::state) gave. Errors: words that cannot be such a state.
    fn restore(&self, _state: &[u32]) -> Result<()> {
        Ok(())
    }
}
