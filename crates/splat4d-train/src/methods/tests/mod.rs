//! The contract of stages, layers and motion models, proven by synthetic models: each is trained a few steps by the
//! ordinary trainer and checked against f64 finite differences through the whole chain, the oracle as the forward.

mod channels;
mod control;
mod edits;
mod features;
mod filtered;
mod guests;
mod hexplane;
mod layers;
mod lobes;
mod maintenance;
mod nodes;
mod pruned;
mod refine;
mod scan;
mod shutter;
mod split;
mod triple;
mod wrapper;

use super::*;
use crate::capture::frames::{Frames, Picture};
use crate::loss::image::{ImageTerm, LossGrads, Shown};
use crate::maintenance::Limits;
use crate::recipe::Recipe;
use crate::recipe::parts::PROGRAMS;
use crate::step::chain::{Chain, Losses, Step, StepInfo, StepReport, View};
use crate::step::loss::TrainLoss;
use crate::step::tests::Made;
use crate::step::trainer::{Settings, Trainer};
use splat4d::layers::Layer;
use splat4d::math::sh::MAX_DEGREE;
use splat4d::math::{Real, Rng};
use splat4d::motion::{MODELS, Motion, SpacetimeSpec, build_as};
use splat4d::render::{
    self, Abilities, Backend, Image, ImageGrads, PartGrads, RenderConfig, RenderGrads, Renderer, oracle,
};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{Camera, GEOMETRY, Grads, Key, LIFE, Params, Planes, SH, Space, Table, Time};
use std::sync::Arc;

#[test]
fn every_built_in_model_has_a_program() {
    let mut all: Vec<&str> = PROGRAMS.iter().map(|p| p.0).collect();
    all.sort_unstable();
    let mut models = MODELS.to_vec();
    models.sort_unstable();
    assert_eq!(all, models, "a model has mathematics and a program");
    let plan = filtered::made_plan(&Recipe::default());
    for (name, make) in PROGRAMS {
        assert_eq!(make(&Recipe::default()).spec(&plan).name(), name, "a program is listed under its model's name");
    }
    assert!(Recipe::default().program_of("wobble").is_err_and(|e| e.to_string().contains("spacetime")));
}

#[test]
fn models_of_lasting_gaussians_get_lifespans_only_with_fixed_cameras() {
    let life = |motion: &str, fixed_cameras: usize, change: &dyn Fn(&mut Recipe)| {
        let recipe = Recipe::default().with(|r| {
            r.run.motion = crate::recipe::MotionName::of(motion);
            change(r);
        });
        let plan = TrainContext { fixed_cameras, ..filtered::made_plan(&recipe) };
        recipe.program().unwrap().life(&plan)
    };
    for motion in ["control", "ssm", "deform-mlp", "hexplane"] {
        assert_eq!(life(motion, 1, &|_| ()), LifeKind::Interval, "{motion}");
        assert_eq!(life(motion, 0, &|_| ()), LifeKind::Infinite, "{motion} of a moving camera");
        assert_eq!(life(motion, 1, &|r| r.capture.observe = 0.8), LifeKind::Infinite, "{motion}, to be predicted");
        let told = |r: &mut Recipe| r.life.kind = Some(LifeKind::GaussOne);
        assert_eq!(life(motion, 0, &told), LifeKind::GaussOne, "{motion} as it is told");
    }
    assert_eq!(life("still", 3, &|_| ()), LifeKind::Infinite);
    assert_eq!(life("tracked", 3, &|_| ()), LifeKind::Infinite);
    assert_eq!(life("spacetime", 3, &|_| ()), LifeKind::GaussHalf);
}

#[test]
fn rates_are_log_linear() {
    let r = Rate { start: 1e-2, end: 1e-4 };
    assert!((r.at(0.0) - 1e-2).abs() < 1e-12 && (r.at(0.5) - 1e-3).abs() < 1e-12 && (r.at(1.0) - 1e-4).abs() < 1e-12);
    assert_eq!(Rate::constant(0.0).at(0.3), 0.0);
}

/// Half the step of the central differences.
const H: f64 = 1e-5;
/// Analytic against central differences in f64: relative, and a floor for what is nearly zero.
const FD_TOLERANCE: (f64, f64) = (2e-6, 2e-9);

/// No thresholds: the image is a smooth function of every parameter.
fn smooth() -> RenderConfig {
    RenderConfig { alpha_min: 1e-14, alpha_max: 1.0 - 1e-9, transmittance_min: 0.0, ..RenderConfig::default() }
}

/// The oracle as a rendering device: a forward without gradients.
struct Oracle(RenderConfig);

impl Backend<f64> for Oracle {
    fn can(&self, _: &Abilities) -> Result<()> {
        Ok(())
    }

    fn render(&mut self, shot: &render::Shot<'_, f64>, out: &mut Image<f64>) -> Result<()> {
        *out = oracle::render(shot, &self.0);
        Ok(())
    }

    fn vjp(
        &mut self,
        shot: &render::Shot<'_, f64>,
        _: &ImageGrads<'_, f64>,
        _: &mut [Option<&mut Table<f64>>],
        d: &mut RenderGrads<f64>,
    ) -> Result<()> {
        let part = |out: &Table<f64>| PartGrads { out: out.zeros_like(), color: None, weights: None };
        d.parts = shot.splats.parts.iter().map(|p| part(p.out)).collect();
        d.mean2d = vec![0.0; shot.splats.len()];
        Ok(())
    }

    fn radii(&self) -> &[f64] {
        // Finite differences are not observed; enough zeros for every test scene.
        &[0.0; 512]
    }

    fn config(&self) -> &RenderConfig {
        &self.0
    }

    fn name(&self) -> &str {
        "the oracle, with gradients of zero"
    }
}

/// Mean squared error.
struct Squared;

impl ImageTerm<f64> for Squared {
    fn eval(&mut self, _: &StepInfo, view: &View<'_, f64>, shown: &Shown<'_, f64>, d: &mut LossGrads<f64>) -> f64 {
        let n = shown.color.data.len() as f64;
        let d_color = d.color.overwrite().expect("there is one term");
        d_color.clone_from(shown.color);
        for (d, t) in d_color.data.iter_mut().zip(&view.truth.data) {
            *d = (*d - t) * 2.0 / n;
        }
        d_color.data.iter().map(|d| d * d * n / 4.0).sum()
    }
}

/// One posed image at any time.
#[derive(Clone)]
struct Shot {
    camera: Camera,
    t: f64,
    truth: Planes<f64>,
    shutter: Option<crate::capture::shutter::Shutter>,
}

/// Images of the synthetic capture, in f64, at times of our choice: (camera, seconds).
fn shots(list: &[(usize, f64)]) -> Vec<Shot> {
    let made = Made::new(3, 1, 12);
    let mut picture = Picture::default();
    let shot = |&(camera, t): &(usize, f64)| {
        made.load(camera, &mut picture).unwrap();
        let truth = &picture.color;
        let data = truth.data.iter().map(|&x| f64::from(x)).collect();
        let truth = Planes { channels: 3, height: truth.height, width: truth.width, data };
        Shot { camera: made.camera(camera).clone(), t, truth, shutter: None }
    };
    list.iter().map(shot).collect()
}

/// The losses of a check next to the images.
type Probes = Vec<Box<dyn ProbeLoss<f64>>>;

/// One step of the chain with any rendering device.
fn step(
    scene: &Scene<f64>,
    shots: &[Shot],
    probes: &Probes,
    backend: &mut dyn Backend<f64>,
) -> (StepReport, Vec<Grads<f64>>, usize) {
    let views: Vec<View<'_, f64>> = shots
        .iter()
        .map(|s| View {
            camera: &s.camera,
            t: Time(s.t),
            background: [0.2, 0.3, 0.6],
            truth: &s.truth,
            mask: None,
            weight: None,
            depth: None,
            flow: None,
            measured: None,
            tracks: None,
            frame: 0,
            rig: 0,
            shutter: s.shutter,
        })
        .collect();
    let info = StepInfo { iteration: 0, times: views.iter().map(|v| v.t).collect(), seed: 0, progress: 0.0 };
    let mut d: Vec<Grads<f64>> = scene.layers.iter().map(|l| Grads::new(&l.params)).collect();
    let mut chain = Chain::default();
    let mut losses = Losses { image: &mut Squared, probes, params: &[] };
    let step = Step { scene, views: &views, info: &info, sh_degree: MAX_DEGREE };
    let report = chain.step(&step, backend, &mut losses, &mut d, &mut |_| {}).unwrap();
    (report, d, chain.at_calls)
}

fn value(scene: &Scene<f64>, shots: &[Shot], probes: &Probes) -> f64 {
    step(scene, shots, probes, &mut Oracle(smooth())).0.loss
}

fn assert_close(got: f64, fd: f64, what: &str) {
    let (relative, floor) = FD_TOLERANCE;
    assert!((got - fd).abs() <= floor + relative * fd.abs(), "{what}: chain {got:e}, differences {fd:e}");
}

/// Every column of a few rows of every trainable table, and dL/dt and dL/d pose of every view, against central
/// differences. Returns the largest gradient of every table of every layer, so that a test can say which parameters
/// must be reached.
fn check_gradients(scene: &Scene<f64>, shots: &[Shot], probes: &Probes) -> Vec<Vec<(String, f64)>> {
    let (report, d, _) = step(scene, shots, probes, &mut Renderer::new(smooth()));
    assert_close(report.loss, value(scene, shots, probes), "the loss");
    let mut reached = Vec::new();
    for (index, layer) in scene.layers.iter().enumerate() {
        let mut tables = Vec::new();
        for key in layer.params.keys() {
            let info = layer.params.info(key);
            let (rows, width) = (layer.params[key].rows(), layer.params[key].width());
            let mut largest = 0.0f64;
            for row in 0..rows {
                for col in 0..width {
                    largest = largest.max(d[index].table(key).get(row, col).abs());
                }
            }
            tables.push((info.name.clone(), largest));
            if !info.trainable {
                continue;
            }
            for row in (0..rows).step_by((rows / 3).max(1)) {
                for col in 0..width {
                    let moved = |by: f64| {
                        let mut s = scene.clone();
                        *s.layers[index].params[key].get_mut(row, col) += by;
                        value(&s, shots, probes)
                    };
                    let fd = (moved(H) - moved(-H)) / (2.0 * H);
                    let what = format!("layer {index} {} row {row} column {col}", info.name);
                    assert_close(d[index].table(key).get(row, col), fd, &what);
                }
            }
        }
        reached.push(tables);
    }
    // The gradient to a moving camera's pose neglects that its motion turns with it.
    let still = |s: &Shot| s.shutter.is_none_or(|s| s.twist == [0.0; 6]);
    if probes.is_empty() && shots.iter().all(still) {
        for (i, shot) in shots.iter().enumerate() {
            // Views at one time share its derivative: they move together.
            let moved = |by: f64| {
                let mut s = shots.to_vec();
                s.iter_mut().filter(|s| s.t == shot.t).for_each(|s| s.t += by);
                value(scene, &s, probes)
            };
            assert_close(report.d_times[i], (moved(H) - moved(-H)) / (2.0 * H), "dL/dt");
            for k in 0..6 {
                let turned = |by: f64| {
                    let mut s = shots.to_vec();
                    let twist = std::array::from_fn(|j| if j == k { by } else { 0.0 });
                    s[i].camera.cam_from_world = crate::train_state::moved(&shot.camera.cam_from_world, twist);
                    value(scene, &s, probes)
                };
                let fd = (turned(H) - turned(-H)) / (2.0 * H);
                assert_close(report.d_cameras[i][k], fd, &format!("view {i}: dL/d pose {k}"));
            }
        }
    }
    reached
}

/// Panics unless every named table of a layer has a gradient.
fn assert_reached(reached: &[(String, f64)], names: &[&str]) {
    for name in names {
        let (_, largest) = reached.iter().find(|(n, _)| n == name).unwrap_or_else(|| panic!("no table {name}"));
        assert!(*largest > 1e-7, "no gradient reaches `{name}`: {largest:e}");
    }
}

/// Random Gaussians near the origin, large enough to be seen, their colours away from the clamp.
fn cloud<F: Real>(rows: usize, life: LifeKind, seed: u64) -> Params<F> {
    let rng = Rng::new(seed, "cloud", 0);
    let mut p = Params::new(rows, 4, life.columns());
    for r in 0..rows {
        let rng = rng.fork(r as u64);
        let f = |x: f64| F::of(x);
        p[GEOMETRY].write(r, 0, [0u64, 1, 2].map(|k| f(1.2 * rng.uniform(k) - 0.6)));
        p[GEOMETRY].write(r, QUAT, [3u64, 4, 5, 6].map(|k| f(rng.normal(k))));
        p[GEOMETRY].write(r, LOG_SCALE, [7u64, 8, 9].map(|k| f(-1.6 + 0.3 * rng.normal(k))));
        p[GEOMETRY].set(r, OPACITY, f(0.4 * rng.normal(10)));
        p[SH].write(r, 0, [11u64, 12, 13].map(|k| f(0.6 * rng.uniform(k))));
        (3..12).for_each(|c| p[SH].set(r, c, f(0.05 * rng.normal(20 + c as u64))));
        if life != LifeKind::Infinite {
            p[LIFE].write(r, 0, [f(0.3 * rng.uniform(40)), f(-0.5 + 0.2 * rng.normal(41))]);
        }
    }
    p
}

fn one_layer<F: Real>(params: Params<F>, motion: Arc<dyn Motion<F>>, life: LifeKind) -> Scene<F> {
    let layer = Layer::new("made up", params, motion, life);
    Scene { layers: vec![layer], clip: [0.0, 0.2], fps: 10.0, background: [0.2, 0.3, 0.6], ..Scene::default() }
}

/// Fills a table with small random numbers.
fn shake<F: Real>(p: &mut Params<F>, key: Key, size: f64, seed: u64) {
    let rng = Rng::new(seed, "shake", u64::from(key.0));
    for r in 0..p[key].rows() {
        for c in 0..p[key].width() {
            *p[key].get_mut(r, c) += F::of(size * rng.normal((r * 64 + c) as u64));
        }
    }
}

/// An ordinary trainer on the synthetic capture: 4 cameras, 3 times, 16 pixels.
fn trainer(scene: Scene<f32>, stages: Vec<Stage>, cap: usize) -> Trainer<'static> {
    trainer_on(Arc::new(Made::new(4, 3, 16)), scene, stages, cap)
}

fn trainer_on(frames: Arc<dyn Frames>, scene: Scene<f32>, stages: Vec<Stage>, cap: usize) -> Trainer<'static> {
    let settings = Settings {
        seed: 5,
        limits: Limits { cap, extent: 4.0, min_opacity: 0.005 },
        background: [0.2, 0.3, 0.6],
        sh_degree: 1,
        exposure_lr: 0.0,
    };
    let draw = Box::new(Renderer::new(RenderConfig::default()));
    Trainer::new(scene, stages, frames, draw, TrainLoss::photometric(0.2), settings)
}

/// Rates at which a tiny scene learns in tens of steps.
fn groups(columns: &[(&str, f64)]) -> Vec<Group> {
    columns.iter().map(|&(column, rate)| Group::new(column, Rate::constant(rate))).collect()
}

const ORDINARY: [(&str, f64); 5] =
    [("means", 0.01), ("quats", 0.01), ("log_scales", 0.02), ("opacity_logits", 0.05), ("sh", 0.02)];

/// Steps the current stage to its end; returns its losses.
fn finish_stage(trainer: &mut Trainer<'_>) -> Vec<f64> {
    let stage = trainer.progress.stage;
    let mut losses = Vec::new();
    while trainer.progress.stage == stage && !trainer.is_done() {
        losses.push(trainer.step().unwrap().expect("no fault").report.loss);
    }
    losses
}

/// Panics unless the last loss is below `share` of the first.
fn assert_falls(losses: &[f64], share: f64, what: &str) {
    let (first, last) = (losses[0], losses[losses.len() - 1]);
    assert!(last < share * first, "{what}: the loss went from {first} to {last}");
}
