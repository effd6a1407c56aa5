//! How motion models are learned: one [`Method`] per model, which makes the list of [`Stage`]s that the trainer runs.
//!
//! `splat4d::motion::x` holds a model's mathematics, `methods::x` its stages, rates, losses and what it needs of a
//! capture.

/// The list of methods: how a motion model is trained is its file and an entry here, which names its table of settings
/// and makes it from the recipe `r`. `auto` tries them in this order.
macro_rules! methods {
    // Tables of settings, between those before and after in the recipe.
    (tables $then:ident { $($before:tt)* } { $($after:tt)* }) => {
        $then! {
            $($before)*
            spacetime: $crate::methods::SpacetimeSettings,
            deform: $crate::methods::DeformSettings,
            hexplane: $crate::methods::HexplaneSettings,
            tracked: $crate::methods::TrackedSettings,
            native4d: $crate::methods::Native4dSettings,
            control: $crate::methods::ControlSettings,
            nodes: $crate::maintenance::NodeSettings,
            ssm: $crate::methods::SsmSettings,
            filter: $crate::methods::FilterSettings,
            $($after)*
        }
    };
    (makers) => {{
        use $crate::methods::*;
        [
            ("still", |_| Box::new(still::StillMethod)),
            ("tracked", |r| Box::new(tracked::TrackedMethod { tracked: r.tracked.clone() })),
            ("spacetime", |r| Box::new(spacetime::SpacetimeMethod { spacetime: r.spacetime.clone() })),
            ("control", |r| Box::new(control::ControlMethod { control: r.control.clone(), nodes: r.nodes })),
            ("deform-mlp", |r| Box::new(deform::DeformMethod { deform: r.deform.clone() })),
            ("hexplane", |r| Box::new(hexplane::HexplaneMethod { hexplane: r.hexplane.clone() })),
            ("native4d", |r| Box::new(native4d::Native4dMethod { native4d: r.native4d.clone() })),
            ("ssm", |r| Box::new(ssm::SsmMethod { ssm: r.ssm.clone(), control: r.control.clone(), nodes: r.nodes })),
        ]
    }};
}
pub(crate) use methods;

pub(crate) mod auto;
mod common;
pub(crate) mod control;
pub(crate) mod deform;
pub(crate) mod filtered;
pub(crate) mod hexplane;
pub(crate) mod native4d;
pub(crate) mod own;
pub(crate) mod spacetime;
pub(crate) mod ssm;
pub mod still;
#[cfg(test)]
mod tests;
pub(crate) mod tracked;

pub use common::CommonSettings;
pub(crate) use common::{AppearanceSettings, LifeSettings, RateSettings};
pub(crate) use control::ControlSettings;
pub(crate) use deform::DeformSettings;
pub(crate) use filtered::FilterSettings;
pub(crate) use hexplane::HexplaneSettings;
pub(crate) use native4d::Native4dSettings;
pub use own::OwnMotion;
pub(crate) use spacetime::SpacetimeSettings;
pub(crate) use ssm::SsmSettings;
pub(crate) use tracked::TrackedSettings;

use crate::Result;
use crate::event::Progress;
use crate::loss::image::ImageTerm;
use crate::loss::terms::{Codec, ParamLoss, ProbeLoss};
use crate::maintenance::split::STILL_COLUMNS;
use crate::maintenance::{Maintenance, Split};
use crate::optim::Noise;
use crate::sampler::Sampler;
use auto::CaptureStats;
use splat4d::layers::Scene;
use splat4d::motion::{Capabilities, Motion, Phase, Spec, build};
use splat4d::scene::{LifeKind, Params};
use std::ops::Range;
use std::sync::Arc;

/// The capture and the user's settings, as far as programs may depend on them.
#[derive(Clone, Debug, Default)]
pub struct TrainContext {
    /// Settings that every motion model is trained with, resolved.
    pub common: CommonSettings,
    /// Seed of the run.
    pub seed: u64,
    /// Steps of the run.
    pub iterations: usize,
    /// Views per step.
    pub batch_size: usize,
    /// Share of the steps, from the first, that use images at half size.
    pub half_size_until: f64,
    /// Bytes of images that a device keeps; 0: a share of its free memory.
    pub device_images: u64,
    /// Whether the end of the clip is kept from training, to be predicted.
    pub predicted: bool,
    /// 1.1 times the largest distance of a camera from the cameras' centroid, scene units (Kerbl et al. 2023).
    pub extent: f64,
    /// The cameras' centroid, scene units.
    pub center: [f64; 3],
    /// First and last second of the clip.
    pub clip: [f64; 2],
    /// Frames a second.
    pub fps: f64,
    /// Distinct times in the capture; of a rig of fixed cameras whose shutters do not open at once, its times.
    pub times: usize,
    /// Cameras with training images that do not move.
    pub fixed_cameras: usize,
    /// Distinct times, seconds, ascending, and how many fixed cameras have a training image at each.
    pub moments: Vec<(f64, usize)>,
    /// Whether training images have masks.
    pub masks: bool,
    /// Distance of the far shell from the cameras' centroid, extents; `None`: there is none.
    pub shell: Option<f64>,
}

impl TrainContext {
    /// Seconds of the clip, its last frame's duration included: the unit in which recipes state time.
    pub(crate) fn seconds(&self) -> f64 {
        self.clip[1] - self.clip[0] + 1.0 / self.fps
    }
}

/// A learning rate over a stage: log-linear from `start` to `end`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate {
    /// At the stage's first step.
    pub start: f64,
    /// At its last.
    pub end: f64,
}

impl Rate {
    /// One rate throughout.
    pub fn constant(rate: f64) -> Self {
        Self { start: rate, end: rate }
    }

    /// The rate after the share `progress` of the stage.
    pub(crate) fn at(&self, progress: f64) -> f64 {
        if self.start <= 0.0 || self.end <= 0.0 {
            return self.start.max(0.0) * (1.0 - progress) + self.end.max(0.0) * progress;
        }
        (self.start.ln() * (1.0 - progress) + self.end.ln() * progress).exp()
    }
}

/// Remaining share of the rates at the end of a settling stage.
const SETTLED: f64 = 0.1;

/// A group of this layer is one of every layer that has its columns.
pub(crate) const EVERY: usize = usize::MAX;

/// A learnable group: one column group of one table. Columns without a group are frozen.
#[derive(Clone, Debug, PartialEq)]
pub struct Group {
    /// The layer, or `EVERY`.
    pub layer: usize,
    /// The column group's name; it is unique in a layer.
    pub column: String,
    /// Columns of the group that it covers (first, count); `None`: all.
    pub part: Option<(usize, usize)>,
    /// Learning rate.
    pub rate: Rate,
    /// Frozen for this many steps of the stage (networks and fine grids that start later).
    pub from: usize,
    /// The rate rises linearly over this many of its first steps; 0: all at once.
    pub warm_up: usize,
}

impl Group {
    /// All columns of a group of layer 0.
    pub fn new(column: &str, rate: Rate) -> Self {
        Self { layer: 0, column: column.to_owned(), part: None, rate, from: 0, warm_up: 0 }
    }

    /// The rate of a step of the stage, at the share `progress` of it.
    pub(crate) fn rate_at(&self, stage_step: usize, progress: f64) -> f64 {
        let taken = (stage_step + 1).saturating_sub(self.from);
        let share = if taken < self.warm_up { taken as f64 / self.warm_up as f64 } else { 1.0 };
        self.rate.at(progress) * share
    }

    /// Whether it is a group of the layer with this number.
    pub(crate) fn is_of(&self, layer: usize) -> bool {
        self.layer == EVERY || self.layer == layer
    }
}

/// Annealed smoothing: one random shift of time a step, which keeps a network from learning the pose errors of single
/// frames. t + N(0, 1)·β, β falling linearly to zero (Yang et al. 2024, §3.3); evaluation is never shifted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TimeNoise {
    /// β at the first step, seconds; 0: none.
    pub start: f64,
    /// Steps until it is zero.
    pub steps: usize,
}

impl TimeNoise {
    /// β after this many steps of the stage.
    pub(crate) fn width(&self, step: usize) -> f64 {
        if step >= self.steps { 0.0 } else { self.start * (1.0 - step as f64 / self.steps as f64) }
    }
}

/// A change of the scene at a stage's start or end: add pages, replace the cloud, build a graph. A layer that it
/// replaces needs another name: rows of a layer that keeps its name and its shape keep their moments.
pub(crate) type Hook = Box<dyn Fn(&mut Scene<f32>, &mut Progress<'_>) -> Result<()> + Send + Sync>;

/// One stage of training.
pub struct Stage {
    /// Name in progress and metrics.
    pub name: String,
    /// Steps.
    pub iterations: usize,
    /// Which frames.
    pub sampler: Sampler,
    /// Views a step.
    pub batch: usize,
    /// Learnable groups and their rates.
    pub groups: Vec<Group>,
    /// The part of the stage, in shares of it, over which all rates fall linearly to a tenth; empty: they do not.
    ///
    /// A step uses one image, and moves parameters towards that image alone. At full rates a run therefore ends some
    /// tenths of a decibel short of what it has learned; small rates from the start would learn less.
    pub settling: Range<f64>,
    /// Losses over several times.
    pub probes: Vec<Box<dyn ProbeLoss<f32>>>,
    /// Losses on raw parameters.
    pub params: Vec<Box<dyn ParamLoss<f32>>>,
    /// Maintenance between steps, in any order: it runs in that of [`RunOrder`](crate::maintenance::RunOrder).
    pub maintenance: Vec<Box<dyn Maintenance>>,
    /// Noise on positions after every step; none: positions only learn.
    pub noise: Option<Noise>,
    /// Steps before each further SH degree; 0: all at once.
    pub sh_interval: usize,
    /// Steps of earlier stages that count for it.
    pub sh_from: usize,
    /// The first steps, this many, use images at half size: coarse structure first, and four times faster.
    pub half_size_steps: usize,
    /// Lower bound of log life widths, by layer; learnt values are lifted to it.
    pub min_log_life: Option<f64>,
    /// Noise on the times of the step's views.
    pub time_noise: TimeNoise,
    /// Losses on images, after the run's own.
    pub pictures: Vec<Box<dyn ImageTerm>>,
    /// Whether the cameras' exposures are frozen.
    pub freeze_exposure: bool,
    /// The codec between the parameters and the images; none: nothing.
    pub codec: Option<Arc<dyn Codec<f32>>>,
    /// The phase that it sets for the models of all layers; none: unchanged.
    pub phase: Option<Phase>,
    /// Before the first step.
    pub start: Option<Hook>,
    /// After the last.
    pub end: Option<Hook>,
}

impl Stage {
    /// A stage that learns nothing yet.
    pub fn new(name: &str, iterations: usize) -> Self {
        Self {
            name: name.to_owned(),
            iterations,
            sampler: Sampler::Uniform,
            batch: 1,
            groups: Vec::new(),
            settling: 1.0..1.0,
            probes: Vec::new(),
            params: Vec::new(),
            maintenance: Vec::new(),
            noise: None,
            sh_interval: 0,
            sh_from: 0,
            half_size_steps: 0,
            min_log_life: None,
            time_noise: TimeNoise::default(),
            pictures: Vec::new(),
            freeze_exposure: false,
            codec: None,
            phase: None,
            start: None,
            end: None,
        }
    }

    /// Adds an operation of maintenance.
    pub fn keep(&mut self, operation: impl Maintenance + 'static) {
        self.maintenance.push(Box::new(operation));
    }

    /// The factor of all rates after the share `progress` of the stage.
    pub(crate) fn settled(&self, progress: f64) -> f64 {
        let Range { start, end } = self.settling;
        if progress <= start || end <= start {
            return 1.0;
        }
        1.0 - (1.0 - SETTLED) * ((progress - start) / (end - start)).min(1.0)
    }

    /// The steps `from..to` as a stage of its own: rates, densification, degrees of SH and images at half size are
    /// as they
    /// would have been then.
    #[must_use]
    pub(crate) fn part(mut self, from: usize, to: usize) -> Self {
        let share = |step: usize| step as f64 / self.iterations.max(1) as f64;
        let [start, end] = [from, to].map(share);
        for group in &mut self.groups {
            group.rate = Rate { start: group.rate.at(start), end: group.rate.at(end) };
        }
        let place = |at: f64| (at - start) / (end - start).max(f64::MIN_POSITIVE);
        self.settling = place(self.settling.start)..place(self.settling.end);
        for schedule in self.maintenance.iter_mut().filter_map(|u| u.densification()) {
            *schedule = schedule.part(from, to);
        }
        self.noise = self.noise.and_then(|n| n.part(from, to));
        self.half_size_steps = self.half_size_steps.saturating_sub(from);
        self.sh_from += from;
        self.iterations = to - from;
        self
    }

    /// The highest SH degree that is rendered after this many steps, of `most`.
    pub(crate) fn sh_degree(&self, step: usize, most: usize) -> usize {
        (self.sh_from + step).checked_div(self.sh_interval).map_or(most, |unlocked| unlocked.min(most))
    }

    /// Notifies every loss that rows were edited.
    pub(crate) fn on_edit(&self) {
        self.params.iter().for_each(|l| l.on_edit());
        self.probes.iter().for_each(|l| l.on_edit());
    }
}

/// Initial lifespan and velocity of a Gaussian, where its seed states them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InitialMotion {
    /// Centre and width of its lifespan, seconds.
    pub life: (f64, f64),
    /// At the centre of its lifespan, scene units per second.
    pub velocity: [f64; 3],
}

/// Training method of a motion model.
pub trait Method: Send + Sync {
    /// The model that training starts with.
    fn spec(&self, plan: &TrainContext) -> Spec;
    /// Constructs it, and its tables in `params`: the constructor of a model from outside the library.
    fn build(&self, plan: &TrainContext, params: &mut Params) -> Result<Arc<dyn Motion>> {
        build(&self.spec(plan), params)
    }
    /// The lifespan its Gaussians have: the recipe's. Where it leaves the choice to the model, those of a cloud that
    /// lasts ([`one_time`](Self::one_time)) may appear and vanish with fixed cameras, which see that a position is
    /// empty before an object appears there (docs/models.md); a camera that moves sees every position at few times, and
    /// lifespans gain nothing. Others, and those whose future is to be predicted, are there forever.
    fn life(&self, plan: &TrainContext) -> LifeKind {
        let lasting = self.one_time(plan) && plan.fixed_cameras > 0 && !plan.predicted;
        plan.common.life.kind.unwrap_or(if lasting { LifeKind::Interval } else { LifeKind::Infinite })
    }
    /// The plan of the initial points: the whole clip, or its part that is learnt first.
    fn first(&self, plan: &TrainContext) -> TrainContext {
        plan.clone()
    }
    /// Fills what the model's own tables start with, row by row.
    fn init(&self, _plan: &TrainContext, _beginnings: &[InitialMotion], _params: &mut Params) {}
    /// Reports before training, and not after an hour, that the model cannot work on a capture.
    fn check(&self, _plan: &TrainContext) -> Result<()> {
        Ok(())
    }
    /// Whether all Gaussians are alive during the whole clip, so that training should start from one time's cloud and
    /// not from the clouds of many times together.
    fn one_time(&self, _plan: &TrainContext) -> bool {
        false
    }
    /// Properties of the model.
    fn capabilities(&self, plan: &TrainContext) -> Capabilities {
        self.spec(plan).capabilities().unwrap_or_default()
    }
    /// The reason for which `auto` takes it for such a capture; none: it is taken where it is requested.
    fn suits(&self, _seen: &CaptureStats) -> Option<String> {
        None
    }
    /// Whether a scene may have static layers next to the one that it trains.
    fn allows_layers(&self) -> bool {
        true
    }
    /// Whether its Gaussians can have features for a pixel head.
    fn has_features(&self) -> bool {
        false
    }
    /// Most nodes that training will have.
    fn nodes(&self, _plan: &TrainContext) -> usize {
        0
    }
    /// Bytes that stages add to the tables of the model that training starts with.
    fn growth_bytes(&self, _plan: &TrainContext, _rows: usize) -> u64 {
        0
    }
    /// The stages.
    fn stages(&self, plan: &TrainContext) -> Vec<Stage>;
    /// The stage that tunes a trained scene further on all frames alike.
    fn tuning(&self, plan: &TrainContext) -> Stage {
        self.stages(plan).pop().expect("a program has a stage")
    }
}

/// The stages of a program: with a static split, still Gaussians move into a layer of their own
/// after that share of the last stage.
pub(crate) fn stages(program: &dyn Method, plan: &TrainContext) -> Vec<Stage> {
    let mut stages = program.stages(plan);
    if let Some(last) = stages.last_mut()
        && program.capabilities(plan).moves
        && let Some(split) = Split::of(plan.common.split, plan.extent, last.iterations)
    {
        last.keep(split);
        share_groups(last);
    }
    if let Some(distance) = plan.shell {
        stages.iter_mut().for_each(|stage| shell_groups(stage, distance));
    }
    stages
}

/// The layer of the far shell, where a scene has one.
pub(crate) const SHELL_LAYER: usize = 1;

/// Lets the far shell learn as the first layer does, but with positions in proportion to its distance (extents): a step
/// then turns the ray to a Gaussian as far as a step of a near one does. The groups are last, so that they apply and not
/// those of every layer.
fn shell_groups(stage: &mut Stage, distance: f64) {
    let of_first = |g: &&Group| g.is_of(0) && STILL_COLUMNS.contains(&g.column.as_str());
    let groups: Vec<Group> = stage.groups.iter().filter(of_first).cloned().collect();
    stage.groups.extend(groups.into_iter().map(|g| {
        let factor = if g.column == "means" { distance } else { 1.0 };
        let rate = Rate { start: factor * g.rate.start, end: factor * g.rate.end };
        Group { layer: SHELL_LAYER, rate, ..g }
    }));
}

/// Lets what a still layer has learn in all layers.
fn share_groups(stage: &mut Stage) {
    let common = |g: &&mut Group| STILL_COLUMNS.contains(&g.column.as_str());
    stage.groups.iter_mut().filter(common).for_each(|g| g.layer = EVERY);
}

/// A stage that tunes a trained scene on all frames alike: the plan's losses and rates, and nothing that adds, moves or
/// replaces Gaussians.
pub(crate) fn tuning(program: &dyn Method, plan: &TrainContext) -> Stage {
    let mut stage = program.tuning(plan);
    share_groups(&mut stage);
    stage.maintenance.retain(|u| u.in_tuning());
    stage.noise = None;
    (stage.sh_interval, stage.half_size_steps) = (0, 0);
    (stage.start, stage.end) = (None, None);
    stage.time_noise = TimeNoise::default();
    // Parts that start late in training are enabled now.
    stage.groups.iter_mut().for_each(|g| (g.from, g.warm_up) = (0, 0));
    stage
}
