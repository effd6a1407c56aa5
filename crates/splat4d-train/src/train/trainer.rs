//! [`Trainer`]: the state of a run and one step of it. Files, progress and clocks are the business of `run`.

use super::chain::{Chain, Draw, Losses, StepInfo, StepReport, View};
use super::loss::TrainLoss;
use crate::capture::frames::{FlowTruth, Frames, Picture};
use crate::event::Progress;
use crate::learner::{Learner, Touched};
use crate::loss::terms::Codec;
use crate::methods::{Group, Hook, Stage};
use crate::optim::Floor;
use crate::sampler::Timeline;
use crate::upkeep::{At, Change, Context, Limits, Upkeep};
use crate::{Error, ErrorKind, Result};
use splat4d::layers::Scene;
use splat4d::math::Rng;
use splat4d::scene::life::LOG_WIDTH;
use splat4d::scene::{Camera, GEOMETRY, Grads, LIFE, SH, Time};
use std::borrow::Cow;
use std::sync::Arc;
use std::time::{Duration, Instant as Clock};

/// Settings that hold for all stages.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Seed of every random choice.
    pub seed: u64,
    /// Cap, extent and dead opacity.
    pub limits: Limits,
    /// Colour behind the scene.
    pub background: [f32; 3],
    /// Highest SH degree.
    pub sh_degree: usize,
    /// Rate of the exposure.
    pub exposure_lr: f64,
}

/// How far a run is. All of it is in every checkpoint.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Position {
    /// Steps taken.
    pub iteration: usize,
    /// Current stage.
    pub stage: usize,
    /// Steps taken in it.
    pub stage_step: usize,
    /// Every rate is multiplied by this; halved after a rollback.
    pub rate_scale: f64,
    /// Rollbacks so far.
    pub strikes: usize,
}

/// What a step did.
#[derive(Clone, Debug, Default)]
pub struct Stepped {
    /// Losses, timings and gradients to times and cameras.
    pub report: StepReport,
    /// L1 of the last view.
    pub l1: f64,
    /// SSIM of the last view.
    pub ssim: f64,
    /// Mean squared error over the step's views.
    pub mse: f64,
    /// Loading pictures.
    pub load: Duration,
    /// Adam.
    pub adam: Duration,
    /// Densification, noise and the rest.
    pub other: Duration,
    /// Gaussians born, moved, removed.
    pub change: Change,
}

/// A number that was not finite: what, where, when.
#[derive(Clone, Debug)]
pub struct Fault(pub String);

/// The state of a run.
pub struct Trainer<'a> {
    /// What learns.
    pub learner: Learner,
    /// What to do, in order.
    pub stages: Vec<Stage>,
    /// How far.
    pub progress: Position,
    /// Compares pictures.
    pub loss: TrainLoss,
    /// Settings that hold for all stages.
    pub settings: Settings,
    /// What the stage's codec shows of the scene.
    shown: Scene<f32>,
    /// Whether `shown` is to be copied from the scene anew.
    stale: bool,
    /// Whether what comes before the step is done already.
    entered: bool,
    frames: Arc<dyn Frames>,
    timeline: Timeline,
    draw: Box<dyn Draw<f32> + 'a>,
    grads: Vec<Grads<f32>>,
    /// Scratch: a rate a column, by layer and table.
    rates: Vec<Vec<Option<Vec<f64>>>>,
    chain: Chain<f32>,
    pictures: Vec<Picture>,
}

impl<'a> Trainer<'a> {
    /// A run that has not begun. Panics: no frames, no stages.
    pub fn new(
        scene: Scene<f32>,
        mut stages: Vec<Stage>,
        frames: Arc<dyn Frames>,
        draw: Box<dyn Draw<f32> + 'a>,
        loss: TrainLoss,
        settings: Settings,
    ) -> Self {
        assert!(!stages.is_empty(), "a program has at least one stage");
        stages.iter_mut().for_each(|s| s.upkeep.sort_by_key(|u| u.order()));
        let timeline = Timeline::new(frames.as_ref());
        let mut trainer = Self {
            learner: Learner::new(scene),
            stages,
            progress: Position { rate_scale: 1.0, ..Position::default() },
            loss,
            settings,
            shown: Scene::default(),
            stale: true,
            entered: false,
            frames,
            timeline,
            draw,
            grads: Vec::new(),
            rates: Vec::new(),
            chain: Chain::default(),
            pictures: Vec::new(),
        };
        trainer.spread();
        trainer
    }

    /// Draws with another device from now on.
    #[cfg(test)]
    pub(super) fn set_draw(&mut self, draw: Box<dyn Draw<f32> + 'a>) {
        self.draw = draw;
    }

    /// Looks at other frames, of the same times, from now on.
    #[cfg(test)]
    pub(super) fn set_frames(&mut self, frames: Arc<dyn Frames>) {
        self.frames = frames;
    }

    /// Steps of all stages.
    pub fn iterations(&self) -> usize {
        self.stages.iter().map(|s| s.iterations).sum()
    }

    /// Whether every stage is done.
    pub fn is_done(&self) -> bool {
        self.progress.stage >= self.stages.len()
    }

    /// The stage's name.
    pub fn stage_name(&self) -> &str {
        self.stages.get(self.progress.stage).map_or("done", |s| &s.name)
    }

    /// The scene that learns.
    pub fn scene(&self) -> &Scene<f32> {
        self.learner.scene()
    }

    /// Takes over a checkpoint's state. The scene and all tables must belong together.
    pub fn restore(&mut self, learner: Learner, progress: Position) {
        (self.learner, self.progress, self.entered) = (learner, progress, false);
        self.spread();
    }

    /// Tells those that remember something of the learner what was done to it, steps apart: the one place where that is
    /// known.
    fn spread(&mut self) {
        let touched = self.learner.take_touched();
        if let (Touched::Rows, Some(stage)) = (touched, self.stages.get(self.progress.stage)) {
            stage.on_edit();
        }
        if touched != Touched::Nothing {
            self.stale = true;
            self.grads = self.scene().layers.iter().map(|l| Grads::new(&l.params)).collect();
        }
    }

    /// Runs a hook of the current stage.
    fn run_hook(&mut self, hook: impl Fn(&Stage) -> Option<&Hook>, progress: &mut Progress<'_>) -> Result<()> {
        let stage = &self.stages[self.progress.stage];
        if let Some(hook) = hook(stage) {
            self.learner
                .rebuild(&|layer, column| learns(&stage.groups, layer, column), |scene| hook(scene, progress))?;
            self.spread();
        }
        Ok(())
    }

    /// Does what is due before the next step, through stages without steps. [`step`](Self::step) does so by itself, but
    /// tells nobody.
    pub fn enter(&mut self, progress: &mut Progress<'_>) -> Result<()> {
        while !self.entered && !self.is_done() {
            if self.progress.stage_step == 0 {
                self.run_hook(|s| s.start.as_ref(), progress)?;
                // Of another stage's codec nothing is kept.
                self.stale = true;
            }
            if self.stages[self.progress.stage].iterations == 0 {
                self.leave_stage(progress)?;
                continue;
            }
            self.keep_up(self.progress.stage_step, |u| u.once())?;
            self.entered = true;
        }
        Ok(())
    }

    fn leave_stage(&mut self, progress: &mut Progress<'_>) -> Result<()> {
        self.run_hook(|s| s.end.as_ref(), progress)?;
        self.progress.stage += 1;
        self.progress.stage_step = 0;
        self.entered = false;
        Ok(())
    }

    /// The codec of the stage that runs, or of the last one when all is done.
    fn codec(&self) -> Option<&Arc<dyn Codec<f32>>> {
        let begun = self.progress.stage_step > 0 || self.entered || self.is_done();
        let stage = self.progress.stage.min(self.stages.len() - 1);
        self.stages[stage].codec.as_ref().filter(|_| begun)
    }

    /// The scene as pictures show it: as it will be read from its file, where the stage has a codec.
    pub fn shown(&self) -> Cow<'_, Scene<f32>> {
        self.codec().map_or(Cow::Borrowed(self.scene()), |c| Cow::Owned(c.whole(self.scene())))
    }

    /// The frames that step `stage_step` of the current stage will see.
    fn draw_frames(&self, stage_step: usize) -> Vec<usize> {
        let s = &self.stages[self.progress.stage];
        let (seed, stage) = (self.settings.seed, self.progress.stage);
        self.timeline.draw(&s.sampler, s.batch, seed, stage, stage_step, s.iterations)
    }

    /// One step. Inner error: a number was not finite, nothing is to be trusted until a rollback.
    pub fn step(&mut self) -> Result<std::result::Result<Stepped, Fault>> {
        // On a thread of the pool a task costs next to nothing; from outside, each of a step's dozens of parallel loops
        // would put this thread to sleep and wake another one.
        rayon::scope(|_| self.step_in_pool())
    }

    fn step_in_pool(&mut self) -> Result<std::result::Result<Stepped, Fault>> {
        self.enter(&mut Progress(&mut |_| {}))?;
        let mut out = Stepped::default();
        if self.is_done() {
            return Ok(Ok(out));
        }
        let clock = Clock::now();
        let seen = self.draw_frames(self.progress.stage_step);
        self.pictures.resize_with(seen.len(), Picture::default);
        for (&i, picture) in seen.iter().zip(&mut self.pictures) {
            self.frames.load(i, picture)?;
        }
        if self.progress.stage_step + 1 < self.stages[self.progress.stage].iterations {
            self.frames.prefetch(&self.draw_frames(self.progress.stage_step + 1));
        }
        out.load = clock.elapsed();
        self.forward_backward(&seen, &mut out);
        let clock = Clock::now();
        let bad = self.learn();
        out.adam = clock.elapsed();
        if let Some(fault) = self.fault(&out.report, &bad, &seen) {
            return Ok(Err(fault));
        }
        let clock = Clock::now();
        self.shake();
        for (d, layer) in self.grads.iter_mut().zip(&self.learner.scene().layers) {
            d.clear(&layer.params);
        }
        out.change = self.keep_up(self.progress.stage_step + 1, |_| true)?;
        if self.scene().is_empty() {
            return Ok(Err(Fault("not one Gaussian is left: all of them became transparent or huge".into())));
        }
        self.progress.iteration += 1;
        self.progress.stage_step += 1;
        if self.progress.stage_step == self.stages[self.progress.stage].iterations {
            self.leave_stage(&mut Progress(&mut |_| {}))?;
        }
        out.other += clock.elapsed();
        Ok(Ok(out))
    }

    fn forward_backward(&mut self, seen: &[usize], out: &mut Stepped) {
        let stage = &self.stages[self.progress.stage];
        let background = self.settings.background;
        let half = self.progress.stage_step < stage.half_size_steps;
        let cameras: Vec<Camera> = seen
            .iter()
            .zip(&mut self.pictures)
            .map(|(&i, picture)| {
                let camera = self.frames.camera(i);
                if half && camera.width > 1 && camera.height > 1 {
                    picture.halve();
                    camera.downscaled(2)
                } else {
                    camera.clone()
                }
            })
            .collect();
        let width = stage.time_noise.width(self.progress.stage_step);
        let shift = match width > 0.0 {
            true => width * Rng::new(self.settings.seed, "time noise", self.progress.iteration as u64).normal(0),
            false => 0.0,
        };
        let views: Vec<View<'_, f32>> = seen
            .iter()
            .zip(&self.pictures)
            .zip(&cameras)
            .map(|((&i, picture), camera)| View {
                camera,
                t: Time(self.frames.time(i).0 + shift),
                background,
                truth: &picture.color,
                mask: picture.mask.as_ref(),
                weight: picture.weight.as_ref(),
                flow: picture.flow.as_ref().map(|f| FlowTruth { to: Time(f.to.0 + shift), ..f.truth() }),
                frame: i,
                rig: self.frames.rig(i),
            })
            .collect();
        let info = StepInfo {
            iteration: self.progress.iteration,
            times: views.iter().map(|v| v.t).collect(),
            seed: self.settings.seed,
            progress: self.progress.stage_step as f64 / stage.iterations as f64,
        };
        self.draw.config().sh_degree = match (stage.sh_from + self.progress.stage_step).checked_div(stage.sh_interval) {
            Some(unlocked) => unlocked.min(self.settings.sh_degree),
            None => self.settings.sh_degree,
        };
        self.loss.progress = info.progress;
        let clock = Clock::now();
        if let Some(codec) = &stage.codec {
            if std::mem::take(&mut self.stale) {
                self.shown = self.learner.scene().clone();
                codec.reset();
            }
            codec.show(self.learner.scene(), &info.times, &mut self.shown);
        }
        out.other += clock.elapsed();
        self.loss.segmentation = stage.segmentation.clone();
        let (scene, _, stats) = self.learner.parts_mut();
        let scene = if stage.codec.is_some() { &self.shown } else { &*scene };
        let mut mse = Mse { inner: &mut self.loss, sum: 0.0 };
        let mut losses = Losses { image: &mut mse, probes: &stage.probes, params: &stage.params };
        out.report =
            self.chain.step(scene, &views, &info, self.draw.as_mut(), &mut losses, &mut self.grads, &mut |o| {
                stats.observe(o)
            });
        out.mse = mse.sum / views.len().max(1) as f64;
        (out.l1, out.ssim) = (self.loss.l1, self.loss.ssim);
    }

    /// Adam on every group of the stage. Returns what was not finite.
    fn learn(&mut self) -> Vec<(usize, splat4d::scene::Key)> {
        let stage = &self.stages[self.progress.stage];
        let progress = self.progress.stage_step as f64 / stage.iterations as f64;
        let mut bad = Vec::new();
        if let Some(codec) = &stage.codec
            && !codec.learn(&mut self.grads, progress, self.progress.rate_scale)
        {
            bad.push((0, SH));
        }
        let (scene, moments, _) = self.learner.parts_mut();
        self.rates.resize_with(scene.layers.len(), Vec::new);
        for (index, layer) in scene.layers.iter_mut().enumerate() {
            let rates = &mut self.rates[index];
            rates.resize(layer.params.keys().count(), None);
            rates.iter_mut().flatten().for_each(|table| table.fill(0.0));
            let step = self.progress.stage_step;
            for group in stage.groups.iter().filter(|g| g.is_of(index) && g.from <= step) {
                let found = layer.params.keys().find_map(|k| layer.params[k].column(&group.column).map(|c| (k, c)));
                let Some((key, (first, width))) = found else { continue };
                let (from, count) = group.part.unwrap_or((0, width));
                let table = rates[key.0 as usize].get_or_insert_default();
                table.resize(layer.params[key].width(), 0.0);
                let end = (first + from + count).min(first + width);
                table[first + from..end].fill(group.rate.at(progress) * self.progress.rate_scale);
            }
            let floor = stage.min_log_life.filter(|_| layer.params[LIFE].width() > LOG_WIDTH);
            let floor = floor.map(|least| Floor { key: LIFE, column: LOG_WIDTH, least });
            let floors = floor.as_slice();
            let keys = moments[index].step(&mut layer.params, &mut self.grads[index], rates, floors);
            bad.extend(keys.into_iter().map(|k| (index, k)));
        }
        if let Some(exposure) = &mut self.loss.exposure {
            match stage.freeze_exposure {
                true => exposure.rest(),
                false => {
                    let _ = exposure.step(self.settings.exposure_lr * self.progress.rate_scale);
                }
            }
        }
        bad
    }

    /// Names the first number that is not finite, if the step was not sound.
    fn fault(&self, report: &StepReport, bad: &[(usize, splat4d::scene::Key)], seen: &[usize]) -> Option<Fault> {
        let views = || seen.iter().map(|&i| self.frames.name(i)).collect::<Vec<_>>().join(", ");
        let (layer, key) = match bad.first() {
            Some(&place) => place,
            None if report.loss.is_finite() => return None,
            None => return Some(Fault(format!("the loss is {} ({})", report.loss, views()))),
        };
        let params = &self.scene().layers[layer].params;
        let (row, col) = self.grads[layer]
            .table(key)
            .first_non_finite()
            .or_else(|| params[key].first_non_finite())
            .unwrap_or((0, 0));
        let column = params.column_name(key, col);
        Some(Fault(format!("`{column}` of Gaussian {row} of layer {layer} is not finite ({})", views())))
    }

    /// Noise on positions, where the stage has it.
    fn shake(&mut self) {
        let stage = &self.stages[self.progress.stage];
        let Some(noise) = stage.noise else { return };
        let progress = self.progress.stage_step as f64 / stage.iterations as f64;
        let rate = |layer: usize| {
            let group = stage.groups.iter().find(|g| g.is_of(layer) && g.column == "means")?;
            Some(group.rate.at(progress))
        };
        let rng = Rng::new(self.settings.seed, "noise", self.progress.iteration as u64);
        let (scene, ..) = self.learner.parts_mut();
        noise.add(scene, &self.grads, rate, self.settings.limits.min_opacity, rng);
    }

    /// Runs the operations of `which` that are due after `step` steps of the stage, and tells losses what they did.
    fn keep_up(&mut self, step: usize, which: impl Fn(&dyn Upkeep) -> bool) -> Result<Change> {
        let Stage { upkeep, groups, iterations, .. } = &mut self.stages[self.progress.stage];
        let context = Context {
            at: At { step, steps: *iterations },
            iteration: self.progress.iteration,
            seed: self.settings.seed,
            limits: self.settings.limits,
            frames: self.frames.as_ref(),
            antialias: self.draw.config().antialias,
            learns: &|layer, column| learns(groups, layer, column),
        };
        let mut change = Change::default();
        for operation in upkeep.iter_mut().filter(|u| which(u.as_ref()) && u.due(&context.at)) {
            change += operation.run(&mut self.learner, &context)?;
        }
        self.spread();
        Ok(change)
    }

    /// Errors if the scene is empty: nothing could be learnt.
    pub fn check_not_empty(&self) -> Result<()> {
        if self.scene().layers.iter().all(|l| l.params[GEOMETRY].rows() == 0) {
            return Err(Error::new(ErrorKind::BadInput, "there is not one Gaussian to start from")
                .remedy("Give points, masks or --set init=random --set num_pts=10000"));
        }
        Ok(())
    }
}

/// Whether a column group of a layer is in one of the groups.
fn learns(groups: &[Group], layer: usize, column: &str) -> bool {
    groups.iter().any(|g| g.is_of(layer) && g.column == column)
}

/// Passes a loss through and sums the mean squared errors of the step's views.
struct Mse<'a> {
    inner: &'a mut TrainLoss,
    sum: f64,
}

impl super::chain::ImageLoss<f32> for Mse<'_> {
    fn wanted(&self) -> super::chain::Wanted {
        self.inner.wanted()
    }

    fn share(&self) -> Option<&str> {
        self.inner.share()
    }

    fn eval(
        &mut self,
        view: &View<'_, f32>,
        image: &splat4d::render::Image<f32>,
        d: &mut super::chain::PictureGrads<f32>,
    ) -> f64 {
        let out = self.inner.eval(view, image, d);
        self.sum += self.inner.mse;
        out
    }
}
