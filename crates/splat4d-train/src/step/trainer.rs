//! [`Trainer`]: the state of a run and one step of it. Module `run` handles files, progress and time.

use super::batch::Batch;
use super::chain::StepInfo;
use super::clocks::OffsetImages;
use super::emphasis::Emphasis;
use super::engine::{Blame, Engine, StepPlan};
pub use super::engine::{Fault, Measured, Stepped};
use super::loss::TrainLoss;
use super::pace::Pace;
use super::replans::ScheduleChange;
use super::resident::DeviceEngine;
use crate::capture::frames::Frames;
use crate::event::Progress;
use crate::loss::terms::Codec;
use crate::maintenance::{At, Change, Context, Limits, Maintenance};
use crate::methods::{Group, Hook, Stage};
use crate::sampler::{Draw, Timeline};
use crate::train_state::{Touched, TrainState};
use crate::{Error, ErrorKind, Result};
use splat4d::layers::Scene;
use splat4d::math::Rng;
use splat4d::render::Backend;
use splat4d::scene::GEOMETRY;
use std::borrow::Cow;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Instant as Clock;

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

/// Progress of a run. All of it is in every checkpoint.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Position {
    /// Steps taken.
    pub iteration: usize,
    /// Current stage.
    pub stage: usize,
    /// Steps of its schedule that are behind it: those taken, unless the run was planned again.
    pub stage_step: usize,
    /// Steps taken in it.
    pub taken: usize,
    /// Whether the last step left the position in the schedule as it was: what is due there was done.
    pub rests: bool,
    /// Every rate is multiplied by this; halved after a rollback.
    pub rate_scale: f64,
    /// Number of rollbacks.
    pub strikes: usize,
}

/// The device that renders.
#[derive(Clone, Debug)]
pub(crate) struct TrainedOn {
    /// It in words, its driver too.
    pub(crate) name: String,
    /// The choice and its reason, in one line.
    pub(crate) why: String,
    /// Whether it is not the one that was queried for.
    pub(crate) missed: bool,
}

/// The state of a run.
pub struct Trainer<'a> {
    /// The scene that learns, with its optimiser.
    pub train_state: TrainState,
    /// The stages, in order.
    pub stages: Vec<Stage>,
    /// Progress.
    pub progress: Position,
    /// Compares images.
    pub loss: TrainLoss,
    /// Settings that hold for all stages.
    pub settings: Settings,
    /// The renderer.
    pub(crate) device: TrainedOn,
    /// The pace through the schedule; none: a step is one of the schedule.
    pace: Option<Pace>,
    /// Whether the work before the step is done.
    entered: bool,
    frames: Arc<dyn Frames>,
    timeline: Timeline,
    engine: Box<dyn Engine + 'a>,
    batch: Batch,
}

impl<'a> Trainer<'a> {
    /// A run that has not begun, on the processor. Panics: no frames, no stages.
    pub fn new(
        scene: Scene<f32>,
        mut stages: Vec<Stage>,
        frames: Arc<dyn Frames>,
        backend: Box<dyn Backend<f32> + 'a>,
        loss: TrainLoss,
        settings: Settings,
    ) -> Self {
        assert!(!stages.is_empty(), "a program has at least one stage");
        let unframed = scene.layers.iter().all(|l| l.frame.is_identity());
        assert!(unframed, "training moves rows in the layers' own axes, which must be the world's");
        stages.iter_mut().for_each(|s| s.maintenance.sort_by_key(|u| u.order()));
        let timeline = Timeline::new(frames.as_ref());
        let name = backend.name().to_owned();
        let device = TrainedOn { why: format!("training on {name}"), name, missed: false };
        let mut trainer = Self {
            train_state: TrainState::new(scene),
            stages,
            progress: Position { rate_scale: 1.0, ..Position::default() },
            loss,
            settings,
            device,
            pace: None,
            entered: false,
            frames,
            timeline,
            engine: Box::new(DeviceEngine::new(backend)),
            batch: Batch::default(),
        };
        trainer.spread();
        trainer
    }

    /// Takes steps with another engine from now on.
    pub fn set_engine(&mut self, engine: impl Engine + 'a) {
        self.engine = Box::new(engine);
        self.engine.changed(&self.train_state);
    }

    /// Lets some pixels weigh more from now on.
    pub(crate) fn emphasise(&mut self, emphasis: Option<Emphasis>) {
        self.batch.emphasis = emphasis;
        self.batch.forget();
    }

    /// Uses other frames, of the same times, from now on.
    #[cfg(test)]
    pub(crate) fn set_frames(&mut self, frames: Arc<dyn Frames>) {
        self.frames = frames;
        self.batch.forget();
    }

    /// Steps of the run in all.
    pub(crate) fn iterations(&self) -> usize {
        self.pace.as_ref().map_or_else(|| self.schedule(), Pace::total)
    }

    /// Steps of the schedule: of all stages.
    fn schedule(&self) -> usize {
        self.stages.iter().map(|s| s.iterations).sum()
    }

    /// Follows the schedule at the pace of these changes of plan, which are all that were ever made.
    pub(crate) fn replan(&mut self, replans: &[ScheduleChange]) {
        self.pace = (!replans.is_empty()).then(|| Pace::new(self.schedule(), replans));
    }

    /// Changes of plan that were followed in the first `taken` steps: the step of each, and the steps in all.
    pub(crate) fn replans_before(&self, taken: usize) -> Vec<[usize; 2]> {
        self.pace.as_ref().map_or_else(Vec::new, |p| p.replans_before(taken))
    }

    /// Steps of the current stage's schedule that will be behind the run after this step: at most to the stage's end,
    /// so that no stage is passed over.
    fn next_place(&self) -> usize {
        let Position { iteration, stage, stage_step, .. } = self.progress;
        match &self.pace {
            None => stage_step + 1,
            Some(pace) => {
                let before: usize = self.stages[..stage].iter().map(|s| s.iterations).sum();
                let end = self.stages[stage].iterations;
                pace.done_after(iteration + 1).saturating_sub(before).clamp(stage_step, end)
            }
        }
    }

    /// Whether every stage is done.
    pub fn is_done(&self) -> bool {
        self.progress.stage >= self.stages.len()
    }

    /// The stage's name.
    pub(crate) fn stage_name(&self) -> &str {
        self.stages.get(self.progress.stage).map_or("done", |s| &s.name)
    }

    /// The scene that learns.
    pub fn scene(&self) -> &Scene<f32> {
        self.train_state.scene()
    }

    /// Takes over a checkpoint's state. The scene and all tables must belong together.
    pub(crate) fn restore(&mut self, train_state: TrainState, progress: Position) {
        (self.train_state, self.progress, self.entered) = (train_state, progress, progress.rests);
        self.batch.forget();
        self.spread();
    }

    /// Notifies those that keep data of the learner of what was done to it, steps apart: the one place where that is
    /// known.
    fn spread(&mut self) {
        let touched = self.train_state.take_touched();
        if let (Touched::Rows, Some(stage)) = (touched, self.stages.get(self.progress.stage)) {
            stage.on_edit();
        }
        if touched != Touched::Nothing {
            self.engine.changed(&self.train_state);
        }
    }

    /// Runs a hook of the current stage.
    fn run_hook(&mut self, hook: impl Fn(&Stage) -> Option<&Hook>, progress: &mut Progress<'_>) -> Result<()> {
        let stage = &self.stages[self.progress.stage];
        if let Some(hook) = hook(stage) {
            self.train_state
                .rebuild(&|layer, column| learns(&stage.groups, layer, column), |scene| hook(scene, progress))?;
            self.spread();
        }
        Ok(())
    }

    /// Does the work that is due before the next step, through stages without steps. [`step`](Self::step) does so by
    /// itself, but notifies nothing.
    pub(crate) fn enter(&mut self, progress: &mut Progress<'_>) -> Result<()> {
        while !self.entered && !self.is_done() {
            if self.progress.stage_step == 0 {
                self.run_hook(|s| s.start.as_ref(), progress)?;
                self.set_phase();
                // Of another stage's codec nothing is kept.
                self.engine.changed(&self.train_state);
            }
            if self.stages[self.progress.stage].iterations == 0 {
                self.leave_stage(progress)?;
                continue;
            }
            let at = self.progress.stage_step;
            self.keep_up(at..=at, |u| u.once())?;
            self.entered = true;
        }
        Ok(())
    }

    /// Puts the models of all layers into the stage's phase.
    fn set_phase(&mut self) {
        let Some(phase) = self.stages[self.progress.stage].phase else { return };
        for layer in &mut self.train_state.scene_mut().layers {
            if let Some(motion) = layer.motion.with_phase(&phase) {
                layer.motion = motion;
            }
        }
    }

    fn leave_stage(&mut self, progress: &mut Progress<'_>) -> Result<()> {
        self.run_hook(|s| s.end.as_ref(), progress)?;
        self.progress.stage += 1;
        (self.progress.stage_step, self.progress.taken, self.progress.rests) = (0, 0, false);
        self.entered = false;
        // Its losses may need more than the images.
        self.batch.forget();
        Ok(())
    }

    /// The codec of the stage that runs, or of the last one when all is done.
    fn codec(&self) -> Option<&Arc<dyn Codec<f32>>> {
        let begun = self.progress.stage_step > 0 || self.entered || self.is_done();
        let stage = self.progress.stage.min(self.stages.len() - 1);
        self.stages[stage].codec.as_ref().filter(|_| begun)
    }

    /// The scene as images show it: as it will be read from its file, where the stage has a codec.
    pub(crate) fn shown(&self) -> Cow<'_, Scene<f32>> {
        self.codec().map_or(Cow::Borrowed(self.scene()), |c| Cow::Owned(c.whole(self.scene())))
    }

    /// The frames of the current stage's step after `taken`, `place` steps into its schedule.
    fn draw_frames(&self, taken: usize, place: usize) -> Vec<usize> {
        let s = &self.stages[self.progress.stage];
        let (seed, stage, steps) = (self.settings.seed, self.progress.stage, s.iterations);
        self.timeline.draw(&s.sampler, s.batch, Draw { seed, stage, taken, place, steps })
    }

    /// One step. Inner error: a number was not finite, nothing is to be trusted until a rollback.
    pub fn step(&mut self) -> Result<std::result::Result<Stepped, Fault>> {
        // On a thread of the pool a task costs next to nothing; from outside, each of a step's dozens of parallel loops
        // would put this thread to sleep and wake another one.
        rayon::scope(|_| self.step_in_pool())
    }

    fn step_in_pool(&mut self) -> Result<std::result::Result<Stepped, Fault>> {
        self.enter(&mut Progress(&mut |_| {}))?;
        if self.is_done() {
            return Ok(Ok(Stepped::default()));
        }
        let clock = Clock::now();
        self.load()?;
        let load = clock.elapsed();
        let mut learnt = self.learn()?;
        if learnt.as_ref().is_ok_and(|stepped| stepped.needs_images) {
            self.batch.forget();
            self.load()?;
            learnt = self.learn()?;
        }
        let mut out = match learnt {
            Ok(stepped) => Stepped { load, ..stepped },
            Err(fault) => return Ok(Err(self.named(fault))),
        };
        self.batch.remember(&mut |frame, size, weighted| self.engine.holds(frame, size, weighted));
        self.correct(&out)?;
        let clock = Clock::now();
        let (place, next) = (self.progress.stage_step, self.next_place());
        if self.read_after(place + 1..=next) {
            match self.settle() {
                Ok(measured) => out.measured.extend(measured),
                Err(fault) => return Ok(Err(fault)),
            }
        }
        out.change = self.keep_up(place + 1..=next, |_| true)?;
        if self.scene().is_empty() {
            let what = "no Gaussian is left: all became transparent or too large";
            return Ok(Err(Fault(what.into(), Blame::Numbers, None)));
        }
        self.progress.iteration += 1;
        self.progress.taken += 1;
        (self.progress.stage_step, self.progress.rests) = (next, next == place);
        if self.progress.stage_step == self.stages[self.progress.stage].iterations {
            self.leave_stage(&mut Progress(&mut |_| {}))?;
        }
        out.other += clock.elapsed();
        Ok(Ok(out))
    }

    /// Brings the learner up to date, which a device may keep: before it is read between steps. It is so by itself at
    /// the end of every stage. Returns what steps measured that were not done yet. Errors: its numbers are lost, and
    /// the run must return to a checkpoint.
    pub(crate) fn settle(&mut self) -> std::result::Result<Vec<Measured>, Fault> {
        self.engine.settle(&mut self.train_state).map_err(|fault| self.named(fault))
    }

    /// Waits for the steps that a device is still at, and leaves the learner with it. Returns and errors: as of
    /// `settle`.
    pub fn catch_up(&mut self) -> std::result::Result<Vec<Measured>, Fault> {
        self.engine.catch_up(&self.train_state).map_err(|fault| self.named(fault))
    }

    /// Continues with the learner's state, without later steps of a failed device.
    pub(crate) fn go_on(&mut self) {
        self.engine.changed(&self.train_state);
    }

    /// Milliseconds of the stages of the last view that is done, where a device that takes whole steps reports them.
    pub fn stages(&mut self) -> Vec<(&'static str, f64)> {
        self.engine.stages()
    }

    /// A fault with the names of the frames that were examined, where they may be to blame.
    fn named(&self, fault: Fault) -> Fault {
        let Fault(what, blame, frames) = fault;
        if blame == Blame::Device {
            return Fault(what, blame, None);
        }
        let frames = frames.as_deref().unwrap_or(self.batch.seen());
        let names: Vec<String> = frames.iter().map(|&i| self.frames.name(i)).collect();
        Fault(format!("{what} ({})", names.join(", ")), blame, None)
    }

    /// Whether maintenance, a hook or another stage reads the learner after these steps of the stage's schedule.
    fn read_after(&self, mut passed: RangeInclusive<usize>) -> bool {
        let stage = &self.stages[self.progress.stage];
        let last = *passed.end() == stage.iterations;
        last || passed.any(|step| stage.maintenance.iter().any(|u| u.due(&At { step, steps: stage.iterations })))
    }

    /// Loads the images of this step; the next one's are read meanwhile.
    fn load(&mut self) -> Result<()> {
        let (Position { taken, stage_step: place, .. }, next) = (self.progress, self.next_place());
        let stage = &self.stages[self.progress.stage];
        let corrections = self.train_state.corrections.as_ref();
        let frames = self.draw_frames(taken, place);
        self.batch.load(
            self.frames.as_ref(),
            frames,
            place < stage.half_size_steps,
            corrections,
            Rng::new(self.settings.seed, "tracks", self.progress.iteration as u64),
            &mut |frame, size, weighted| self.engine.holds(frame, size, weighted),
        )?;
        if next < stage.iterations {
            let half = next < stage.half_size_steps;
            let mut frames = self.draw_frames(taken + 1, next);
            frames.retain(|&frame| !self.batch.is_kept(frame, half));
            self.frames.prefetch(&frames);
        }
        Ok(())
    }

    /// The engine's step on the images that were loaded.
    fn learn(&mut self) -> Result<std::result::Result<Stepped, Fault>> {
        let (Settings { seed, limits, background, sh_degree, exposure_lr }, at) =
            (self.settings.clone(), self.progress);
        let stage = &mut self.stages[at.stage];
        let width = stage.time_noise.width(at.stage_step);
        let shift = match width > 0.0 {
            true => width * Rng::new(seed, "time noise", at.iteration as u64).normal(0),
            false => 0.0,
        };
        let views = self.batch.views(self.frames.as_ref(), shift, background);
        let info = StepInfo {
            iteration: at.iteration,
            times: views.iter().map(|v| v.t).collect(),
            seed,
            progress: at.stage_step as f64 / stage.iterations as f64,
        };
        let mut plan = StepPlan {
            sh_degree: stage.sh_degree(at.stage_step, sh_degree),
            stage,
            loss: &mut self.loss,
            views: &views,
            info: &info,
            stage_step: at.stage_step,
            rate_scale: at.rate_scale,
            exposure_lr,
            min_opacity: limits.min_opacity,
        };
        self.engine.step(&mut self.train_state, &mut plan)
    }

    /// Corrects cameras by the gradients of the step's views, and searches their time offsets where that is due.
    fn correct(&mut self, stepped: &Stepped) -> Result<()> {
        let Position { stage, stage_step, rate_scale, .. } = self.progress;
        let before: usize = self.stages[..stage].iter().map(|s| s.iterations).sum();
        let progress = (before + stage_step) as f64 / self.schedule().max(1) as f64;
        if let Some(corrections) = &mut self.train_state.corrections {
            let report = &stepped.report;
            corrections.step(self.batch.seen(), &report.grads(), progress, rate_scale);
        }
        let after = (before + self.next_place()) as f64 / self.schedule().max(1) as f64;
        let Some(corrections) = &self.train_state.corrections else { return Ok(()) };
        if let Some(due) = corrections.search_due(progress, after) {
            let (frames, antialias) = (self.frames.as_ref(), self.engine.antialias());
            let look = OffsetImages { frames, corrections, exposure: self.train_state.exposure.as_ref(), antialias };
            let shifts = look.shifts(self.train_state.scene(), due)?;
            self.train_state.corrections.iter_mut().for_each(|c| c.shift(&shifts));
        }
        Ok(())
    }

    /// Runs the operations of `which` that are due after any of these steps of the stage's schedule, once each and
    /// where they are due last, and notifies losses of what they did.
    fn keep_up(&mut self, passed: RangeInclusive<usize>, which: impl Fn(&dyn Maintenance) -> bool) -> Result<Change> {
        let Stage { maintenance, groups, iterations, .. } = &mut self.stages[self.progress.stage];
        let at = |step| At { step, steps: *iterations };
        let context = Context {
            at: at(*passed.end()),
            iteration: self.progress.iteration,
            seed: self.settings.seed,
            limits: self.settings.limits,
            frames: self.frames.as_ref(),
            antialias: self.engine.antialias(),
            learns: &|layer, column| learns(groups, layer, column),
        };
        let mut change = Change::default();
        for operation in maintenance.iter_mut().filter(|u| which(u.as_ref())) {
            if let Some(at) = passed.clone().rev().map(at).find(|at| operation.due(at)) {
                change += operation.run(&mut self.train_state, &Context { at, ..context })?;
            }
        }
        self.spread();
        Ok(change)
    }

    /// Errors if the scene is empty: nothing could be learnt.
    pub(crate) fn check_not_empty(&self) -> Result<()> {
        if self.scene().layers.iter().all(|l| l.params[GEOMETRY].rows() == 0) {
            return Err(Error::new(ErrorKind::BadInput, "there are no initial Gaussians")
                .remedy("Give points, masks or --set init=random --set num_pts=10000"));
        }
        Ok(())
    }
}

/// Whether a column group of a layer is in one of the groups.
fn learns(groups: &[Group], layer: usize, column: &str) -> bool {
    groups.iter().any(|g| g.is_of(layer) && g.column == column)
}
