//! Pruning by importance during training: repeatedly a share of the Gaussians is removed, and the rest trains on.
//! Source: 4DGS-1K (Yuan et al. 2025), there once, after training.

use super::importance::{ScoreConfig, Scores, Spatial, prune, score};
use super::{At, Change, Context, Maintenance, RunOrder};
use crate::Result;
use crate::settings::{Choice, settings};
use crate::train_state::TrainState;

impl Choice for Spatial {
    const NAMES: &'static [(&'static str, Self)] = &[
        ("share", Self::Share),
        ("change", Self::Change),
        ("both", Self::Both),
        ("opacity", Self::Opacity),
        ("light-gaussian", Self::LightGaussian),
        ("pup", Self::Pup),
        ("speedy", Self::Speedy),
    ];
}

settings! {
    /// Settings of pruning by importance in space and time during training.
    #[derive(Copy)]
    pub struct PruneSettings
    when (On("prune.interval")) {
        /// Iterations between prunings by importance in space and time (4DGS-1K), with any strategy; 0: never.
        interval: usize = 0 => any().unit("iterations").switch();
        /// Share of the Gaussians that each pruning removes.
        ratio: f64 = 0.3 => share();
        /// Training views that each pruning uses; at least one per frame of the capture.
        views: usize = 60;
        /// Score of the pruning: share, change, both, opacity, light-gaussian, pup or speedy.
        spatial: Spatial = Spatial::Change;
    }
}

/// See the module's documentation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Prune {
    /// How, and when.
    pub settings: PruneSettings,
}

impl Prune {
    /// With these settings; `None`: never.
    pub(crate) fn of(settings: PruneSettings) -> Option<Self> {
        (settings.interval > 0).then_some(Self { settings })
    }

    /// The scores that it uses.
    fn scores(&self, train_state: &TrainState, c: &Context<'_>) -> Result<Scores> {
        let PruneSettings { views, spatial, .. } = self.settings;
        let every = c.frames.len().div_ceil(views.max(1)).max(1);
        // As `compress` does by default; docs/benchmarks.md has what it won.
        let config = ScoreConfig { spatial, volume: false, every, antialias: c.antialias, ..ScoreConfig::default() };
        score(train_state.scene(), c.frames, &config, &mut |_, _| {})
    }
}

impl Maintenance for Prune {
    fn name(&self) -> &str {
        "prune"
    }

    fn order(&self) -> RunOrder {
        RunOrder::Remove
    }

    /// Not if fewer than half an interval is left, in which the scene would not recover.
    fn due(&self, at: &At) -> bool {
        let interval = self.settings.interval;
        at.step.is_multiple_of(interval) && at.steps.saturating_sub(at.step) >= interval.div_ceil(2)
    }

    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        let before = train_state.scene().len();
        let scores = self.scores(train_state, c)?;
        let edits = prune(train_state.scene(), &scores, self.settings.ratio);
        for layer in train_state.learning() {
            train_state.apply(layer, &edits[layer], &c.rng("prune"));
        }
        Ok(Change { removed: before - train_state.scene().len(), ..Change::default() })
    }
}

#[cfg(test)]
mod tests {
    use super::super::Limits;
    use super::super::tests::{context, due_steps, scene};
    use super::*;
    use crate::step::tests::Made;

    fn pruning() -> Prune {
        Prune { settings: PruneSettings { interval: 20, ratio: 0.25, views: 4, spatial: Spatial::Opacity } }
    }

    #[test]
    fn the_given_share_of_gaussians_is_pruned() {
        let (frames, mut train_state) = (Made::new(4, 1, 16), TrainState::new(scene(40)));
        let limits = Limits { cap: 40, extent: 4.0, min_opacity: 0.005 };
        let c = Context { frames: &frames, ..context(limits, 0, 0) };
        let change = pruning().run(&mut train_state, &c).unwrap();
        assert_eq!((change, train_state.scene().len()), (Change { removed: 10, ..Change::default() }, 30));
    }

    #[test]
    fn pruning_ends_early_enough_to_recover() {
        assert_eq!(due_steps(&pruning(), 70), [20, 40, 60]);
        assert_eq!(due_steps(&pruning(), 69), [20, 40]);
    }
}
