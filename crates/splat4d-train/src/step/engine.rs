//! [`Engine`]: takes training steps. [`CpuEngine`] runs on the CPU. An engine with tables on a device can replace it,
//! because a plan describes the whole step and the training state records its changes between steps.

use super::chain::{Chain, ImageTerm, Losses, Step, StepInfo, StepReport, View};
use super::loss::TrainLoss;
use crate::Result;
use crate::maintenance::Change;
use crate::methods::Stage;
use crate::optim::Floor;
use crate::train_state::{Parts, TrainState};
use splat4d::device;
use splat4d::layers::Scene;
use splat4d::math::Rng;
use splat4d::render::{Abilities, Antialias, Backend};
use splat4d::scene::life::LOG_WIDTH;
use splat4d::scene::{Grads, Key, LIFE, SH};
use std::time::{Duration, Instant as Clock};

/// All that one step is of.
pub struct StepPlan<'a> {
    /// The stage: learnable groups, their rates and losses.
    pub stage: &'a mut Stage,
    /// Compares images.
    pub loss: &'a mut TrainLoss,
    /// Images and their truth.
    pub views: &'a [View<'a, f32>],
    /// Stage and step.
    pub info: &'a StepInfo,
    /// Steps of the stage that were taken before.
    pub stage_step: usize,
    /// Highest SH degree rendered.
    pub sh_degree: usize,
    /// Every rate is multiplied by this.
    pub rate_scale: f64,
    /// Rate of the exposure.
    pub exposure_lr: f64,
    /// Opacity below which a Gaussian is dead.
    pub min_opacity: f64,
}

/// Measurements of a step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Measured {
    /// Number of the step, from 1.
    pub iteration: usize,
    /// Everything that it minimised.
    pub loss: f64,
    /// L1 of the last view.
    pub l1: f64,
    /// SSIM of the last view.
    pub ssim: f64,
    /// Mean squared error over the step's views.
    pub mse: f64,
}

/// The result of a step.
#[derive(Clone, Debug, Default)]
pub struct Stepped {
    /// Timings and gradients to times and cameras; losses too, where the step is done.
    pub report: StepReport,
    /// Measurements of the steps that finished since the last call: this one, or, if the device is still busy, earlier
    /// ones.
    pub measured: Vec<Measured>,
    /// Loading images.
    pub load: Duration,
    /// Adam.
    pub adam: Duration,
    /// Maintenance, noise and the rest.
    pub other: Duration,
    /// Gaussians added, moved, removed.
    pub change: Change,
    /// A message for the user about the rendering device.
    pub notices: Vec<String>,
    /// Whether nothing was done, because images are needed that were left out as a device held them ([`Engine::holds`]).
    pub needs_images: bool,
}

/// Cause of an invalid step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Blame {
    /// A number that is not finite: smaller steps may help.
    Numbers,
    /// A device that failed: the same steps, taken elsewhere, are as good as ever.
    Device,
}

/// A step that was spoilt, so that nothing of the learner is to be trusted any more: what and where, by what, and the
/// numbers of the frames that it examined, where it is not the last one that was begun.
#[derive(Clone, Debug)]
pub struct Fault(pub String, pub Blame, pub Option<Vec<usize>>);

/// Takes steps on a learner.
pub trait Engine: Send {
    /// One step: evaluate, render, compare, backward, Adam, noise. A device may still be busy with it afterwards. Inner
    /// error: it, or one before it, was spoilt. Errors: those of what renders.
    fn step(&mut self, train_state: &mut TrainState, plan: &mut StepPlan<'_>) -> Result<Result<Stepped, Fault>>;

    /// The learner was changed in other ways than by a step (it was settled before), or another stage begins: what is
    /// remembered of it is stale.
    fn changed(&mut self, train_state: &TrainState);

    /// Waits for the steps that a device is still at: what they measured. Errors: one was spoilt.
    fn catch_up(&mut self, _learner: &TrainState) -> Result<Vec<Measured>, Fault> {
        Ok(Vec::new())
    }

    /// The same, and brings the learner up to date, where its numbers are kept elsewhere: called before they are read.
    /// Errors: they are lost.
    fn settle(&mut self, _learner: &mut TrainState) -> Result<Vec<Measured>, Fault> {
        Ok(Vec::new())
    }

    /// Whether a step needs only the shape of a frame's truth and weights, in this size (width, height): a device took the
    /// last step, and keeps them.
    fn holds(&mut self, _frame: usize, _size: [usize; 2], _weighted: bool) -> bool {
        false
    }

    /// Milliseconds of the stages of the last view that is done, where a device that takes whole steps reports them.
    fn stages(&mut self) -> Vec<(&'static str, f64)> {
        Vec::new()
    }

    /// As it renders.
    fn antialias(&self) -> Antialias;
}

/// A rate a column, by layer and table; none: the table rests.
pub(super) type Rates = Vec<Vec<Option<Vec<f64>>>>;

/// The rates of a step.
pub(super) fn rates_of(scene: &Scene<f32>, plan: &StepPlan<'_>, all: &mut Rates) {
    let (stage, progress) = (&*plan.stage, plan.info.progress);
    let scale = plan.rate_scale * stage.settled(progress);
    all.resize_with(scene.layers.len(), Vec::new);
    for (index, (layer, rates)) in scene.layers.iter().zip(all).enumerate() {
        rates.resize(layer.params.keys().count(), None);
        rates.iter_mut().flatten().for_each(|table| table.fill(0.0));
        for group in stage.groups.iter().filter(|g| g.is_of(index) && g.from <= plan.stage_step) {
            let found = layer.params.keys().find_map(|k| layer.params[k].column(&group.column).map(|c| (k, c)));
            let Some((key, (first, width))) = found else { continue };
            let (from, count) = group.part.unwrap_or((0, width));
            let table = rates[key.0 as usize].get_or_insert_default();
            table.resize(layer.params[key].width(), 0.0);
            let end = (first + from + count).min(first + width);
            table[first + from..end].fill(group.rate_at(plan.stage_step, progress) * scale);
        }
    }
}

/// Share of a stage after which exposures are frozen: before it they learn at a constant rate, since a rate that falls
/// from the start leaves them short in runs of a few dozen images a camera (docs/suite.md).
const EXPOSURE_RESTS: f64 = 0.7;
/// Remaining share of their rate at the end: Adam moves a camera's colours by up to the rate a step whatever the
/// gradient, and at the full rate images end a thousandth off.
const EXPOSURE_END: f64 = 0.01;

/// Remaining share of the exposures' rate at a point of the stage.
fn rests(progress: f64) -> f64 {
    EXPOSURE_END.powf(((progress - EXPOSURE_RESTS) / (1.0 - EXPOSURE_RESTS)).max(0.0))
}

/// The rate of the cameras' exposures; 0: they rest.
pub(super) fn exposure_rate(plan: &StepPlan<'_>) -> f64 {
    if plan.stage.freeze_exposure { 0.0 } else { plan.exposure_lr * plan.rate_scale * rests(plan.info.progress) }
}

/// Adam on the cameras' exposures.
fn learn_exposure(train_state: &mut TrainState, plan: &StepPlan<'_>) {
    if let Some(exposure) = train_state.parts_mut().exposure {
        match plan.stage.freeze_exposure {
            true => exposure.rest(),
            false => {
                let _ = exposure.step(exposure_rate(plan));
            }
        }
    }
}

/// The rate of a layer's positions, which scales their noise; none: they are frozen.
pub(super) fn noise_rate(plan: &StepPlan<'_>, layer: usize) -> Option<f64> {
    let group = plan.stage.groups.iter().find(|g| g.is_of(layer) && g.column == "means")?;
    Some(group.rate.at(plan.info.progress) * plan.stage.settled(plan.info.progress))
}

/// The step's random numbers for that noise; a layer has a fork.
pub(super) fn noise_stream(plan: &StepPlan<'_>) -> Rng {
    Rng::new(plan.info.seed, "noise", plan.info.iteration as u64)
}

/// Steps on the processor, with whatever renders.
pub struct CpuEngine<'a> {
    backend: Box<dyn Backend<f32> + 'a>,
    chain: Chain<f32>,
    grads: Vec<Grads<f32>>,
    /// Scratch.
    rates: Rates,
    /// The scene as the stage's codec shows it.
    shown: Scene<f32>,
    /// Whether `shown` is to be copied from the scene again.
    stale: bool,
    /// Whether it was reported that images are compared on the CPU.
    reported: bool,
}

impl<'a> CpuEngine<'a> {
    /// An engine that renders with `backend`.
    pub fn new(backend: Box<dyn Backend<f32> + 'a>) -> Self {
        Self {
            backend,
            chain: Chain::default(),
            grads: Vec::new(),
            rates: Vec::new(),
            shown: Scene::default(),
            stale: true,
            reported: false,
        }
    }

    /// The renderer.
    pub(super) fn backend(&mut self) -> &mut (dyn Backend<f32> + 'a) {
        self.backend.as_mut()
    }

    /// Renders on the processor from now on, by the same limits.
    pub(super) fn leave_device(&mut self) {
        self.backend = device::cpu(*self.backend.config());
    }

    /// Brings what the stage's codec shows up to date.
    fn show(&mut self, scene: &Scene<f32>, plan: &StepPlan<'_>) {
        let Some(codec) = &plan.stage.codec else { return };
        if std::mem::take(&mut self.stale) {
            self.shown = scene.clone();
            codec.reset();
        }
        codec.show(scene, &plan.info.times, &mut self.shown);
    }

    /// Evaluate, render, compare, and all the backward pass: fills the gradients.
    fn evaluate(&mut self, train_state: &mut TrainState, plan: &mut StepPlan<'_>, out: &mut Stepped) -> Result<()> {
        let Parts { scene, stats, exposure, .. } = train_state.parts_mut();
        let scene = if plan.stage.codec.is_some() { &self.shown } else { &*scene };
        let Stage { pictures, probes, params, .. } = &mut *plan.stage;
        let mut image = plan.loss.of_step(pictures, exposure);
        if !self.reported && compares(self.backend.as_ref()) && plan.views.iter().any(|v| image.target(v).is_none()) {
            out.notices.push("the CPU compares images: the recipe's loss on them is more than L1 and D-SSIM".into());
            self.reported = true;
        }
        let mut losses = Losses { image: &mut image, probes, params };
        let step = Step { scene, views: plan.views, info: plan.info, sh_degree: plan.sh_degree };
        let (backend, grads) = (self.backend.as_mut(), &mut self.grads);
        out.report = self.chain.step(&step, backend, &mut losses, grads, &mut |o| stats.observe(o))?;
        out.notices.extend(std::iter::from_fn(|| self.backend.notice()));
        let (iteration, loss) = (plan.info.iteration + 1, out.report.loss);
        let TrainLoss { l1, ssim, .. } = *plan.loss;
        out.measured = vec![Measured { iteration, loss, l1, ssim, mse: plan.loss.mse() }];
        Ok(())
    }

    /// Adam on every group of the stage. Returns what was not finite.
    fn adam(&mut self, train_state: &mut TrainState, plan: &StepPlan<'_>) -> Vec<(usize, Key)> {
        let (stage, scale, progress) = (&*plan.stage, plan.rate_scale, plan.info.progress);
        let mut bad = Vec::new();
        if let Some(codec) = &stage.codec
            && !codec.learn(&mut self.grads, progress, scale)
        {
            bad.push((0, SH));
        }
        rates_of(train_state.scene(), plan, &mut self.rates);
        let Parts { scene, moments, .. } = train_state.parts_mut();
        for (index, layer) in scene.layers.iter_mut().enumerate() {
            let floor = stage.min_log_life.filter(|_| layer.params[LIFE].width() > LOG_WIDTH);
            let floor = floor.map(|least| Floor { key: LIFE, column: LOG_WIDTH, least });
            let (d, rates) = (&mut self.grads[index], &self.rates[index]);
            let keys = moments[index].step(&mut layer.params, d, rates, floor.as_slice());
            bad.extend(keys.into_iter().map(|k| (index, k)));
        }
        learn_exposure(train_state, plan);
        bad
    }

    /// Names the first number that is not finite, if the step was not sound.
    fn sound(&self, scene: &Scene<f32>, report: &StepReport, bad: &[(usize, Key)]) -> Result<(), Fault> {
        let Some(&(layer, key)) = bad.first() else {
            let fault = || Fault(format!("the loss is {}", report.loss), Blame::Numbers, None);
            return if report.loss.is_finite() { Ok(()) } else { Err(fault()) };
        };
        let params = &scene.layers[layer].params;
        let place = self.grads[layer].table(key).first_non_finite().or_else(|| params[key].first_non_finite());
        let (row, col) = place.unwrap_or((0, 0));
        let column = params.column_name(key, col);
        Err(Fault(format!("`{column}` of Gaussian {row} of layer {layer} is not finite"), Blame::Numbers, None))
    }

    /// Noise on positions, if the stage has it.
    fn add_noise(&self, train_state: &mut TrainState, plan: &StepPlan<'_>) {
        let Some(noise) = plan.stage.noise else { return };
        let (rate, rng) = (|layer: usize| noise_rate(plan, layer), noise_stream(plan));
        noise.add(train_state.parts_mut().scene, &self.grads, rate, plan.min_opacity, rng);
    }
}

/// Whether a backend compares images, where the loss lets it.
fn compares(backend: &dyn Backend) -> bool {
    backend.can(&Abilities { compare: true, ..Abilities::default() }).is_ok()
}

impl Engine for CpuEngine<'_> {
    fn step(&mut self, train_state: &mut TrainState, plan: &mut StepPlan<'_>) -> Result<Result<Stepped, Fault>> {
        let mut out = Stepped::default();
        let clock = Clock::now();
        self.show(train_state.scene(), plan);
        out.other = clock.elapsed();
        self.evaluate(train_state, plan, &mut out)?;
        let clock = Clock::now();
        let bad = self.adam(train_state, plan);
        out.adam = clock.elapsed();
        if let Err(fault) = self.sound(train_state.scene(), &out.report, &bad) {
            return Ok(Err(fault));
        }
        let clock = Clock::now();
        self.add_noise(train_state, plan);
        for (d, layer) in self.grads.iter_mut().zip(&train_state.scene().layers) {
            d.clear(&layer.params);
        }
        out.other += clock.elapsed();
        Ok(Ok(out))
    }

    fn changed(&mut self, train_state: &TrainState) {
        self.stale = true;
        self.grads = train_state.scene().layers.iter().map(|l| Grads::new(&l.params)).collect();
    }

    fn antialias(&self) -> Antialias {
        self.backend.config().antialias
    }
}
