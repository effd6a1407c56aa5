//! Pruning while a scene is trained.

use super::{ScoreConfig, Scores, Spatial, score};
use crate::Result;
use crate::capture::frames::Frames;
use crate::recipe::Recipe;
use splat4d::layers::Scene;
use splat4d::render::Antialias;

/// Takes away a share of the Gaussians again and again; what remains learns on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Periodic {
    /// Steps of the stage between two times.
    pub interval: usize,
    /// Share of the Gaussians that goes each time.
    pub ratio: f64,
    /// About the most views looked at each time; never fewer than one at every moment of the capture.
    pub views: usize,
    /// What of a view counts.
    pub spatial: Spatial,
}

impl Periodic {
    /// As the recipe has it; `None`: never.
    pub fn of(r: &Recipe) -> Option<Self> {
        // A recipe that was checked has a name that is one.
        let spatial = r.prune_score.parse().unwrap_or(Spatial::Change);
        let some = Self { interval: r.prune_interval, ratio: r.prune_ratio, views: r.prune_views, spatial };
        (r.prune_interval > 0).then_some(some)
    }

    /// Whether it is time after so many steps of a stage of `iterations`: not if fewer than half an interval is left,
    /// in which the scene would not recover.
    pub fn is_due(&self, steps: usize, iterations: usize) -> bool {
        steps.is_multiple_of(self.interval) && iterations.saturating_sub(steps) >= self.interval.div_ceil(2)
    }

    /// The scores that it goes by.
    pub fn scores(&self, scene: &Scene<f32>, frames: &dyn Frames, antialias: Antialias) -> Result<Scores> {
        let every = frames.len().div_ceil(self.views.max(1)).max(1);
        // As `compress` does by default; docs/benchmarks.md has what it won.
        let config = ScoreConfig { spatial: self.spatial, volume: false, every, antialias, ..ScoreConfig::default() };
        score(scene, frames, &config, &mut |_, _| {})
    }
}
