//! Times of training: whole steps of the trainer on a scene that is already good, against images of itself with noise,
//! so that every gradient is small and none is zero.

use super::roofline::{Roofline, bytes};
use super::rows::Row;
use super::scenes::Pinned;
use super::stages::{Way, simd_name};
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::Rng;
use splat4d::math::sh::degree_of;
use splat4d::render::{Backend, Image, RenderConfig, Renderer, Shot};
use splat4d::scene::{Camera, Planes, SH, Time};
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::capture::frames::{Frames, Picture};
use splat4d_train::maintenance::Limits;
use splat4d_train::maintenance::Strategy;
use splat4d_train::methods::{Group, Stage, TrainContext};
use splat4d_train::recipe::{MotionName, Recipe};
use splat4d_train::run::peak_memory;
use splat4d_train::step::loss::TrainLoss;
use splat4d_train::step::trainer::{Settings, Stepped, Trainer};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// Every rate is multiplied by this: the scene does not change, the work is the same.
const STANDSTILL: f64 = 1e-6;
/// Steps of the stage: never reached.
const FOR_EVER: usize = 1 << 40;
/// Standard deviation of the noise on the truth.
const NOISE: f64 = 0.02;
/// Standard share of D-SSIM in the loss (Kerbl et al. 2023).
pub(super) const LAMBDA_DSSIM: f64 = 0.2;

/// Images in memory.
pub(super) struct Held {
    cameras: Vec<Camera>,
    times: Vec<Time>,
    pictures: Vec<Planes<f32>>,
    /// The one that was in the last step.
    last: AtomicUsize,
}

impl Held {
    /// Renders the scene from its views, with noise.
    pub(super) fn of(pinned: &Pinned, way: Way) -> Self {
        let mut renderer = Renderer::new(RenderConfig { simd: way.simd, ..RenderConfig::default() });
        let (mut image, mut moment) = (Image::default(), Evaluation::default());
        let rng = Rng::new(1, "noise on the truth", 0);
        let mut picture = |(v, view): (usize, &super::scenes::View)| {
            pinned.scene.at(view.time, &mut moment);
            let splats = pinned.scene.splats(&moment);
            renderer.render(&Shot::new(&splats, &view.camera, pinned.scene.background), &mut image);
            let own = rng.fork(v as u64);
            let mut truth = image.color.clone();
            for (i, x) in truth.data.iter_mut().enumerate() {
                *x = (*x + (NOISE * own.normal(i as u64)) as f32).clamp(0.0, 1.0);
            }
            truth
        };
        Self {
            cameras: pinned.views.iter().map(|v| v.camera.clone()).collect(),
            times: pinned.views.iter().map(|v| v.time).collect(),
            pictures: pinned.views.iter().enumerate().map(&mut picture).collect(),
            last: AtomicUsize::new(0),
        }
    }

    /// The image that was in the last step.
    pub(super) fn last(&self) -> usize {
        self.last.load(Ordering::Relaxed)
    }

    /// The images.
    pub(super) fn pictures(&self) -> &[Planes<f32>] {
        &self.pictures
    }
}

impl Frames for Held {
    fn len(&self) -> usize {
        self.pictures.len()
    }

    /// Steps read the camera of every frame, and load only images that no device keeps.
    fn camera(&self, i: usize) -> &Camera {
        self.last.store(i, Ordering::Relaxed);
        &self.cameras[i]
    }

    fn time(&self, i: usize) -> Time {
        self.times[i]
    }

    fn rig(&self, i: usize) -> usize {
        i
    }

    fn name(&self, i: usize) -> String {
        format!("view {i}")
    }

    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        out.color.clone_from(&self.pictures[i]);
        (out.mask, out.weight) = (None, None);
        Ok(())
    }
}

/// The stage in which a scene of this kind is trained, without densification and at full size.
fn stage(scene: &Scene<f32>, extent: f64) -> Result<Stage> {
    let first = &scene.layers[0];
    let Some(path) = first.motion.polynomial() else {
        return Err(Error::new(ErrorKind::Unsupported, "training steps of this motion model are not measured")
            .remedy("Give a scene of the model `still` or `spacetime`."));
    };
    let motion = first.motion.spec();
    let recipe = Recipe::default().with(|r| {
        r.run.motion = MotionName::of(motion.name());
        r.spacetime.order = path.order;
        r.spacetime.rotation_rate = path.rotation_rates.is_some();
        r.life.kind = Some(first.life);
        r.appearance.sh_degree = degree_of(first.params[SH].width() / 3).unwrap_or(0);
        r.densify.strategy = Strategy::None;
        r.run.half_size_until = 0.0;
    });
    let plan = TrainContext {
        extent,
        center: [0.0; 3],
        clip: scene.clip,
        fps: scene.fps.max(1.0),
        times: 8,
        fixed_cameras: 8,
        moments: vec![(scene.clip[0], 8)],
        masks: false,
        ..recipe.plan()
    };
    let mut stages = recipe.program()?.stages(&plan);
    let mut stage = stages.swap_remove(0);
    (stage.iterations, stage.sh_interval, stage.half_size_steps) = (FOR_EVER, 0, 0);
    // Programs refer to layer 0; here all layers learn.
    let of_first = std::mem::take(&mut stage.groups);
    for layer in 0..scene.layers.len() {
        stage.groups.extend(of_first.iter().map(|g| Group { layer, ..g.clone() }));
    }
    Ok(stage)
}

/// A trainer that continues forever and changes next to nothing.
pub(super) fn trainer(scene: Scene<f32>, frames: Arc<dyn Frames>, way: Way) -> Result<Trainer<'static>> {
    let renderer = Renderer::new(RenderConfig { simd: way.simd, ..RenderConfig::default() });
    trainer_on(scene, frames, Box::new(renderer))
}

/// The same, rendered by `backend`.
pub(super) fn trainer_on(
    scene: Scene<f32>,
    frames: Arc<dyn Frames>,
    backend: Box<dyn Backend>,
) -> Result<Trainer<'static>> {
    // Rates of positions are in units of it; any number would do.
    let extent = 1.0;
    let stage = stage(&scene, extent)?;
    let settings = Settings {
        seed: 0,
        limits: Limits { cap: scene.len(), extent, min_opacity: 0.0 },
        background: scene.background,
        sh_degree: splat4d::math::sh::MAX_DEGREE,
        exposure_lr: 0.0,
    };
    let loss = TrainLoss::photometric(LAMBDA_DSSIM);
    let mut trainer = Trainer::new(scene, vec![stage], frames, backend, loss, settings);
    trainer.progress.rate_scale = STANDSTILL;
    Ok(trainer)
}

/// One step, and its seconds.
pub(super) fn step(trainer: &mut Trainer<'_>) -> Result<(Stepped, f64)> {
    let clock = Instant::now();
    let stepped = trainer.step()?;
    let seconds = clock.elapsed().as_secs_f64();
    let stepped = stepped.map_err(|fault| Error::new(ErrorKind::Diverged, fault.0))?;
    Ok((stepped, seconds))
}

/// Waits for steps that a device is still at.
#[cfg(feature = "gpu")]
pub(super) fn catch_up(trainer: &mut Trainer<'_>) -> Result<()> {
    trainer.catch_up().map(|_| ()).map_err(|fault| Error::new(ErrorKind::Diverged, fault.0))
}

/// Parts of a step that have rows of their own, in order.
const PARTS: [&str; 5] = ["motion in a step", "loss", "motion backward", "adam", "step"];

/// Milliseconds of one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Times {
    pub motion: f64,
    pub loss: f64,
    pub motion_backward: f64,
    pub adam: f64,
    /// The renderer's forward and backward.
    pub renderer: f64,
    /// All of it.
    pub step: f64,
}

impl Times {
    fn of(stepped: &Stepped, seconds: f64) -> Self {
        let t = stepped.report.timings;
        let ms = |d: Duration| 1e3 * d.as_secs_f64();
        Self {
            motion: ms(t.motion),
            loss: ms(t.loss),
            motion_backward: ms(t.motion_backward),
            adam: ms(stepped.adam),
            renderer: ms(t.render) + ms(t.render_backward),
            step: 1e3 * seconds,
        }
    }

    fn each(self) -> [f64; 6] {
        [self.motion, self.loss, self.motion_backward, self.adam, self.renderer, self.step]
    }

    fn from(each: [f64; 6]) -> Self {
        let [motion, loss, motion_backward, adam, renderer, step] = each;
        Self { motion, loss, motion_backward, adam, renderer, step }
    }
}

/// The mean over views of each view's best step. Call it inside a pool of `way.threads` threads.
pub(super) fn times(scene: Scene<f32>, held: &Arc<Held>, way: Way) -> Result<Times> {
    times_of(trainer(scene, held.clone(), way)?, held, way)
}

/// The same of a trainer that was made.
pub(super) fn times_of(mut trainer: Trainer<'_>, held: &Held, way: Way) -> Result<Times> {
    let mut best = vec![[f64::MAX; 6]; held.len()];
    for round in 0..=way.rounds {
        for _ in 0..held.len() {
            let (stepped, seconds) = step(&mut trainer)?;
            if round > 0 {
                let seen = &mut best[held.last()];
                let now = Times::of(&stepped, seconds).each();
                seen.iter_mut().zip(now).for_each(|(best, now)| *best = best.min(now));
            }
        }
    }
    let mean = |k: usize| best.iter().map(|b| b[k]).sum::<f64>() / best.len() as f64;
    Ok(Times::from(std::array::from_fn(mean)))
}

/// Steps at every view, in parts. Call it inside a pool of `way.threads` threads.
pub(super) fn measure(pinned: &Pinned, held: &Arc<Held>, way: Way, roofline: &Roofline) -> Result<Vec<Row>> {
    forget_peak();
    let t = times(pinned.scene.clone(), held, way)?;
    let (mut alive, mut moment) = (0, Evaluation::default());
    for view in &pinned.views {
        pinned.scene.at(view.time, &mut moment);
        alive += pinned.scene.splats(&moment).len();
    }
    let (alive, camera) = (alive / pinned.views.len(), &pinned.views[0].camera);
    let moved = [
        bytes::motion(&pinned.scene, alive),
        bytes::loss(camera.width * camera.height),
        bytes::motion_backward(&pinned.scene, alive),
        bytes::adam(&pinned.scene, alive),
    ];
    let row = |((k, stage), ms): ((usize, &&str), f64)| {
        let moved = moved.get(k).map(|b| *b as f64);
        let whole = *stage == "step";
        Row {
            scene: pinned.name.clone(),
            stage: (*stage).into(),
            threads: way.threads,
            simd: simd_name(way.simd).into(),
            ms,
            ceiling_share: moved.map(|b| 1e3 * b / roofline.bytes / ms),
            gb_per_s: moved.map(|b| 1e-6 * b / ms),
            outside_share: whole.then(|| 1.0 - t.renderer / ms),
            peak_memory: whole.then(peak_memory),
            ..Row::default()
        }
    };
    let all = [t.motion, t.loss, t.motion_backward, t.adam, t.step];
    Ok(PARTS.iter().enumerate().zip(all).map(row).collect())
}

/// Starts the process's peak memory again where the system lets it (Linux); elsewhere it stays that of the whole run.
pub(super) fn forget_peak() {
    const PEAK: &str = "5"; // proc(5), /proc/pid/clear_refs
    let _ = std::fs::write("/proc/self/clear_refs", PEAK);
}
