//! Edits of rows in the middle of a stage: every loss is notified of them, and guided sampling finds what no Gaussian
//! represents.

use super::*;
use crate::maintenance::importance::Spatial;
use crate::maintenance::merge::Pair;
use crate::maintenance::{
    AdaptNodes, Every, Guided, GuidedSettings, Merge, MergeSettings, NodeSettings, Once, Prune, PruneSettings,
    Relocate, RelocateSettings,
};
use splat4d::motion::control::{ControlSpec, Curve, TrajectorySpec};
use splat4d::motion::skin::SkinSpec;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Counts its notifications.
#[derive(Clone, Default)]
struct Ear {
    heard: Arc<AtomicUsize>,
}

impl ProbeLoss<f32> for Ear {
    fn name(&self) -> &str {
        "ear"
    }
    fn probes(&self, _: &Scene<f32>, _: &StepInfo) -> Vec<crate::step::chain::Probe> {
        Vec::new()
    }
    fn eval(
        &self,
        _: &Scene<f32>,
        _: &[crate::step::chain::Probe],
        _: &[Vec<Table<f32>>],
        _: &mut [Vec<Table<f32>>],
    ) -> f64 {
        0.0
    }
    fn on_edit(&self) {
        self.heard.fetch_add(1, Ordering::Relaxed);
    }
}

impl ParamLoss<f32> for Ear {
    fn name(&self) -> &str {
        "ear"
    }
    fn eval(&self, _: &Scene<f32>, _: &StepInfo, _: &mut [Grads<f32>]) -> f64 {
        0.0
    }
    fn on_edit(&self) {
        self.heard.fetch_add(1, Ordering::Relaxed);
    }
}

fn on_nodes() -> Scene<f32> {
    let mut p = cloud::<f32>(90, LifeKind::Infinite, 3);
    let skin = SkinSpec { nodes: 12, neighbours: 3, hyper: 2, mask: false };
    let trajectory = TrajectorySpec::Keys { curve: Curve::Cubic, keys: 5 };
    let spec = Spec::Control(ControlSpec { seed: 1, clip: [0.0, 0.2], skin, trajectory });
    let motion = build_as(&spec, &mut p).unwrap();
    one_layer(p, motion, LifeKind::Infinite)
}

#[test]
fn every_row_edit_reaches_every_loss() {
    type Change = fn(&mut Stage);
    const STEPS: Every = Every { first: 5, last: 30, interval: 5 };
    let edits: [(&str, Change); 8] = [
        ("adc", |s| (layers::STRATEGIES[0].1)(s, STEPS)),
        ("mcmc", |s| (layers::STRATEGIES[1].1)(s, STEPS)),
        ("prune", |s| {
            s.keep(Prune { settings: PruneSettings { interval: 5, ratio: 0.1, views: 8, spatial: Spatial::Opacity } });
        }),
        ("merging", |s| {
            s.keep(Merge { settings: MergeSettings { pair: Pair::Prune, distance: 10.0, interval: 5 } });
        }),
        ("relocation", |s| {
            let (from, interval, threshold, share) = (5, 5, 0.6, 0.1);
            let settings = RelocateSettings { from, interval, threshold, share, gradient_share: 0.5 };
            s.keep(Relocate { settings, densification: Every::NEVER });
        }),
        ("guided sampling", |s| s.keep(Guided { settings: GuidedSettings { from: 0.2, times: 2, share: 0.3 } })),
        ("nodes", |s| {
            let settings = NodeSettings { bind_interval: 100, adapt_interval: 5, threshold: 0.0, cap: 14 };
            s.keep(AdaptNodes { settings, span: (5, 30) });
        }),
        ("a change of the scene", |s| {
            let halve = |scene: &mut Scene<f32>| {
                let edit = splat4d::scene::RowEdit::prune(Space::Gaussians, (0..90).map(|r| r % 2 == 0));
                scene.layers[0].edit(&edit, &Rng::new(0, "half", 0));
                Ok(())
            };
            s.keep(Once { at: 5, change: halve });
        }),
    ];
    for (name, change) in edits {
        let (probe, param) = (Ear::default(), Ear::default());
        let mut stage = Stage { batch: 2, groups: groups(&ORDINARY), ..Stage::new("edits", 40) };
        stage.probes.push(Box::new(probe.clone()));
        stage.params.push(Box::new(param.clone()));
        change(&mut stage);
        // Patches of guided sampling need an image that is larger than they are.
        let mut t = sized(on_nodes(), vec![stage], 48);
        let mut edited = 0;
        while !t.is_done() {
            let (rows, nodes) = (t.scene().len(), t.scene().layers[0].params.rows_of(Space::Nodes));
            let told = || [&probe, &param].map(|e| e.heard.load(Ordering::Relaxed));
            let before = told();
            let step = t.step().unwrap().expect("no fault");
            let after = t.scene().layers[0].params.rows_of(Space::Nodes);
            let moved = step.change.moved > 0 || (rows, nodes) != (t.scene().len(), after);
            edited += usize::from(moved);
            for (before, after) in before.into_iter().zip(told()) {
                assert!(after > before || !moved, "{name}: rows were edited, and losses were not told");
            }
        }
        assert!(edited > 0, "{name} edited nothing: the test must look at something");
    }
}

/// As [`trainer`], at another size.
fn sized(scene: Scene<f32>, stages: Vec<Stage>, size: usize) -> Trainer<'static> {
    let settings = trainer(scene.clone(), vec![Stage::new("", 1)], 400).settings;
    let draw = Box::new(Renderer::new(RenderConfig::default()));
    Trainer::new(scene, stages, Arc::new(Made::new(4, 3, size)), draw, TrainLoss::photometric(0.2), settings)
}

#[test]
fn guided_sampling_finds_a_sky_without_gaussians() {
    let run = |guided: Option<GuidedSettings>| {
        // All at the ball: the sky of the capture is not the background.
        let mut p = cloud::<f32>(60, LifeKind::GaussHalf, 3);
        let motion = build_as(&Spec::Spacetime(SpacetimeSpec::default()), &mut p).unwrap();
        for r in 0..60 {
            p[LIFE].write(r, 0, [0.1, 2.0]);
            let mean = p[GEOMETRY].read::<3>(r, 0);
            p[GEOMETRY].write(r, 0, mean.map(|x| 0.3 * x));
            p[GEOMETRY].write(r, LOG_SCALE, [-2.3; 3]);
        }
        let mut scene = one_layer(p, motion, LifeKind::GaussHalf);
        scene.background = [0.9, 0.1, 0.1];
        let mut stage = Stage { batch: 2, groups: groups(&ORDINARY), ..Stage::new("guided", 50) };
        if let Some(settings) = guided {
            stage.keep(Guided { settings });
        }
        let mut t = sized(scene, vec![stage], 48);
        t.settings.background = [0.9, 0.1, 0.1];
        let (mut added, mut mse) = (0, Vec::new());
        while !t.is_done() {
            let step = t.step().unwrap().expect("no fault");
            added += step.change.added;
            mse.push(step.measured[0].mse);
        }
        (added, mse[mse.len() - 8..].iter().sum::<f64>() / mse[..8].iter().sum::<f64>())
    };
    let [(none, left), (added, mended)] = [None, Some(GuidedSettings { from: 0.1, times: 3, share: 0.5 })].map(run);
    assert!(none == 0 && added > 20, "{added} were added");
    assert!(mended < 0.99 * left, "{mended} of the error is left, {left} without");
}
