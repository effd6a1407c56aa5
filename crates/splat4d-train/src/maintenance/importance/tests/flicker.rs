//! A still backdrop that every short lifespan repeats: four of five Gaussians are superfluous, and the score finds
//! them.

use super::*;
use crate::eval::metrics::psnr;
use crate::maintenance::{Limits, Prune, PruneSettings};
use crate::methods::{Group, Rate, Stage};
use crate::step::loss::TrainLoss;
use crate::step::trainer::{Settings, Trainer};
use crate::train_state::TrainState;
use std::sync::Arc;

/// Gaussians of the truth, and for each of them this many that only flicker.
const TRUTH: usize = 60;
const REPEATS: usize = 4;
/// Steps of training before and after pruning.
const STEPS: usize = 120;
/// The permitted loss, dB.
const BOUND: f64 = 0.1;

/// The truth's images in every frame of the synthetic capture.
struct Drawn {
    frames: Made,
    pictures: Vec<Picture>,
}

impl Frames for Drawn {
    fn len(&self) -> usize {
        self.pictures.len()
    }
    fn camera(&self, i: usize) -> &Camera {
        self.frames.camera(i)
    }
    fn time(&self, i: usize) -> Time {
        self.frames.time(i)
    }
    fn rig(&self, i: usize) -> usize {
        self.frames.rig(i)
    }
    fn name(&self, i: usize) -> String {
        self.frames.name(i)
    }
    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        out.clone_from(&self.pictures[i]);
        Ok(())
    }
}

fn trainer(scene: Scene<f32>, frames: Arc<Drawn>) -> Trainer<'static> {
    let columns = [("means", 1e-3), ("log_scales", 5e-3), ("opacity_logits", 0.02), ("sh", 5e-3)];
    let groups = columns.iter().map(|(name, rate)| Group::new(name, Rate { start: *rate, end: 0.1 * rate })).collect();
    let settings = Settings {
        seed: 2,
        limits: Limits { cap: 10_000, extent: 4.0, min_opacity: 0.005 },
        background: [0.1, 0.2, 0.3],
        sh_degree: 0,
        exposure_lr: 0.0,
    };
    let draw = Box::new(Renderer::new(RenderConfig::default()));
    let stage = Stage { groups, ..Stage::new("tune", STEPS) };
    Trainer::new(scene, vec![stage], frames, draw, TrainLoss::photometric(0.2), settings)
}

fn tune(scene: Scene<f32>, frames: Arc<Drawn>) -> Scene<f32> {
    let mut t = trainer(scene, frames);
    while !t.is_done() {
        t.step().unwrap().expect("no fault");
    }
    t.train_state.into_scene()
}

fn quality(scene: &Scene<f32>, frames: &Drawn) -> f64 {
    let one = |i: usize| psnr(&drawn(scene, frames, i).color, &frames.pictures[i].color).unwrap();
    (0..frames.len()).map(one).sum::<f64>() / frames.len() as f64
}

#[test]
fn a_flickering_copy_of_the_background_is_pruned_and_the_image_stays() {
    let still = |rows: usize, seed: u64| Scene {
        layers: vec![layer(rows, LifeKind::GaussHalf, seed)],
        clip: [0.0, 0.8],
        fps: 10.0,
        ..Scene::default()
    };
    let mut truth = still(TRUTH, 5);
    for r in 0..TRUTH {
        truth.layers[0].params[LIFE].write(r, 0, [0.4, 3f32.ln()]);
    }
    let frames = made();
    let picture = |i: usize| Picture { color: drawn(&truth, &frames, i).color, ..Picture::default() };
    let pictures = (0..frames.len()).map(picture).collect();
    let frames = Arc::new(Drawn { frames, pictures });

    // Every Gaussian of the truth lasts; in addition, faint copies of it come and go.
    let parent = (0..TRUTH * (1 + REPEATS)).map(|j| (j % TRUTH) as u32).collect::<Vec<_>>();
    let copies = RowEdit { space: Space::Gaussians, born: vec![splat4d::scene::Born::Clone; parent.len()], parent };
    let mut repeated = truth.clone();
    edit(&mut repeated, &[copies]);
    let rng = Rng::new(4, "flicker", 0);
    let params = &mut repeated.layers[0].params;
    for r in 0..params.len() {
        let rng = rng.fork(r as u64);
        let shaken = params[GEOMETRY].read::<3>(r, 0).map(|x| x + 0.01 * rng.normal(1) as f32);
        params[GEOMETRY].write(r, 0, shaken);
        if r >= TRUTH {
            params[LIFE].write(r, 0, [0.8 * rng.uniform(2) as f32, 0.05f32.ln()]);
            params[GEOMETRY].set(r, OPACITY, -1.5);
        }
    }
    let trained = tune(repeated, frames.clone());
    let before = quality(&trained, &frames);

    let ratio = REPEATS as f64 / (1 + REPEATS) as f64;
    let scores = scored(&trained, frames.as_ref(), &ScoreConfig::default());
    let edits = prune(&trained, &scores, ratio);
    assert_eq!(edits[0].len(), TRUTH);
    let lasting = edits[0].parent.iter().filter(|&&p| (p as usize) < TRUTH).count();
    assert!(lasting * 10 >= TRUTH * 9, "{lasting} of {TRUTH} that last are kept");
    let mut pruned = TrainState::new(trained.clone());
    pruned.apply(0, &edits[0], &Rng::new(0, "prune", 0));
    let after = quality(&tune(pruned.into_scene(), frames.clone()), &frames);
    assert!(after >= before - BOUND, "{before} dB before, {after} dB with a fifth of the Gaussians");

    // At random the same share costs far more.
    let keep = (0..trained.len()).map(|r| rng.fork(r as u64).uniform(9) >= ratio);
    let mut random = trained.clone();
    edit(&mut random, &[RowEdit::prune(Space::Gaussians, keep)]);
    let random = quality(&tune(random, frames.clone()), &frames);
    assert!(random < after - 1.0, "{random} dB at random, {after} dB by score");
}

/// In training: rows go at the interval's steps, and a run that is taken up again from a checkpoint's state continues
/// alike.
#[test]
fn rows_are_pruned_during_training_and_the_run_repeats() {
    let start = || Scene { layers: vec![layer(200, LifeKind::GaussHalf, 7)], clip: [0.0, 0.8], fps: 10.0, ..scene(2) };
    let frames = made();
    let pictures =
        (0..frames.len()).map(|i| Picture { color: drawn(&start(), &frames, i).color, ..Picture::default() });
    let frames = Arc::new(Drawn { pictures: pictures.collect(), frames });
    let run = |resumed: bool| {
        let fresh = || {
            let mut t = trainer(start(), frames.clone());
            let settings = PruneSettings { interval: 10, ratio: 0.3, views: 9, spatial: Spatial::Change };
            t.stages[0].keep(Prune { settings });
            t.stages[0].iterations = 34;
            t
        };
        let (mut t, mut sizes) = (fresh(), Vec::new());
        while !t.is_done() {
            let stepped = t.step().unwrap().expect("no fault");
            if stepped.change.removed > 0 {
                sizes.push((t.progress.stage_step, t.scene().len()));
            }
            if resumed && t.progress.stage_step == 15 {
                let old = std::mem::replace(&mut t, fresh());
                t.restore(old.train_state, old.progress);
            }
        }
        assert_eq!(sizes, [(10, 140), (20, 98)], "none at step 30: too few steps are left");
        assert_eq!(t.train_state.stats().tables[0].rows(), 98);
        let rows: Vec<[f32; 11]> = (0..98).map(|r| t.scene().layers[0].params[GEOMETRY].read::<11>(r, 0)).collect();
        rows
    };
    assert!(run(false) == run(true), "the same bits");
}
