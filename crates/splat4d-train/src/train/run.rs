//! A run on disk: folder, recipe, checkpoints, metrics, resume, rollback. It emits events and never prints.

#[cfg(test)]
#[path = "run_tests.rs"]
pub(crate) mod tests;

use super::checkpoint::{self, Identity, RunState, write_atomically};
use super::dataset::Dataset;
use super::loss::TrainLoss;
pub use super::memory::{memory_estimate, peak_memory};
use super::minutes;
use super::snapshot::Snapshots;
use super::trainer::{Settings, Stepped, Trainer};
use crate::capture::{Capture, CaptureOptions, ImageStore};
use crate::event::{Event, Progress};
use crate::init::{self, Seeds, Source};
use crate::learner::Exposure;
use crate::loss::image::terms;
use crate::methods::auto;
use crate::methods::{Plan, Stage, program_of, stages};
use crate::recipe::{MotionName, Recipe};
use crate::upkeep::Limits;
use crate::{Error, ErrorKind, Result};
use serde_json::json;
use splat4d::device;
use splat4d::layers::Scene;
use splat4d::render::{Antialias, RenderConfig, Simd};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant as Clock};

/// What is asked of a run besides its recipe.
#[derive(Clone, Debug, Default)]
pub struct TrainOptions {
    /// Fix the iterations so that training takes so long.
    pub minutes: Option<f64>,
    /// Emit [`Event::Snapshot`] about so often, and at the end. They never take more than a fortieth of the time, and
    /// do not change the result.
    pub snapshots: Option<Duration>,
}

/// How a run ended.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// Its folder.
    pub run: PathBuf,
    /// Steps taken.
    pub iteration: usize,
    /// Gaussians at the end.
    pub gaussians: usize,
    /// Seconds of training, resumed ones included.
    pub seconds: f64,
    /// Whether it was stopped before its last step; `resume` continues it.
    pub interrupted: bool,
}

/// Faults at which a run is given up.
const MAX_STRIKES: usize = 3;
/// After a rollback rates are multiplied by this.
const ROLLBACK_RATE: f64 = 0.5;
/// Weight of the newest step in smoothed numbers.
const SMOOTHING: f64 = 0.05;
/// Rows of metrics.csv in a whole run, about.
const METRIC_ROWS: usize = 600;
/// Extent of cameras in a single place, scene units.
const SINGLE_PLACE: f64 = 1e-6;
/// Seconds between two progress events.
const PROGRESS_SECONDS: f64 = 0.25;
/// The options with which a recipe opens its capture.
pub fn capture_options(recipe: &Recipe) -> Result<CaptureOptions> {
    Ok(CaptureOptions {
        downscale: recipe.capture.downscale,
        hold_out: recipe.capture.hold_out.clone(),
        fps: (recipe.capture.fps > 0.0).then_some(recipe.capture.fps),
        background: (!recipe.capture.white_background).then_some([0.0; 3]),
        near: recipe.capture.near,
        ..CaptureOptions::default()
    })
}

/// Trains a scene of `capture` into the folder `run`.
pub fn train(
    capture: Arc<Capture>,
    recipe: Recipe,
    run: &Path,
    options: &TrainOptions,
    stop: &AtomicBool,
    listen: &mut dyn FnMut(&Event),
) -> Result<Outcome> {
    recipe.check()?;
    if !checkpoint::list(run).is_empty() {
        return Err(Error::input("this folder already holds a run")
            .at(run.display())
            .remedy("Continue it with `train --resume`, or give another folder with -o"));
    }
    let opened = OpenCapture::new(capture, &recipe)?;
    check_flow(&opened.capture, &recipe)?;
    let mut listen = listen;
    let recipe = if recipe.run.motion.is_auto() { opened.choose(recipe, &mut listen)? } else { recipe };
    program_of(&recipe)?.check(&opened.plan(&recipe))?;
    recipe.without_effect().iter().for_each(|idle| listen(&Event::Warning { message: idle.to_string() }));
    let recipe = match options.minutes {
        Some(m) => minutes::plan(&opened, &recipe, m, &mut listen)?,
        None => recipe,
    }
    .resolve();
    let plan = opened.plan(&recipe);
    let estimate = memory_estimate(&opened.capture, &recipe);
    if recipe.run.memory_limit > 0 && estimate > recipe.run.memory_limit {
        return Err(Error::new(
            ErrorKind::Memory,
            format!(
                "training would take about {} MiB, and memory_limit is {} MiB",
                estimate >> 20,
                recipe.run.memory_limit >> 20
            ),
        )
        .remedy("Lower max_cap or image_memory, or use --downscale 2"));
    }
    listen(&Event::Phase { name: "initial points".into(), done: 0, total: 0 });
    let scene = opened.initial_scene(&plan)?;
    let mut trainer = opened.trainer(&plan, scene)?;
    trainer.check_not_empty()?;
    let session = Session {
        run,
        opened: &opened,
        recipe: &recipe,
        identity: opened.identity(&recipe, ""),
        made_by: TRAIN,
        estimate,
        snapshots: options.snapshots,
        stop,
    };
    let state = session.begin(&trainer, &mut listen)?;
    session.drive(&mut trainer, state, &mut listen)
}

/// Continues the run in the folder `run`, exactly.
pub fn resume(run: &Path, stop: &AtomicBool, listen: &mut dyn FnMut(&Event)) -> Result<Outcome> {
    resume_with(run, &TrainOptions::default(), stop, listen)
}

/// As [`resume`]; of the options only `snapshots` counts, the rest was settled at the start.
pub fn resume_with(
    run: &Path,
    options: &TrainOptions,
    stop: &AtomicBool,
    listen: &mut dyn FnMut(&Event),
) -> Result<Outcome> {
    let (recipe, capture) = open_run(run)?;
    if let Some(other) = made_by(run)?.filter(|m| m != TRAIN) {
        return Err(Error::input(format!("this run was made by `{other}`"))
            .at(run.display())
            .remedy(format!("Continue it with `splat4d {other}` and the options it began with")));
    }
    let opened = OpenCapture::new(Arc::new(capture), &recipe)?;
    let plan = opened.plan(&recipe);
    let empty =
        init::scene(&plan, program_of(&recipe)?.as_ref(), &Seeds::default(), opened.background(), opened.capture.up)?;
    let mut trainer = opened.trainer(&plan, empty)?;
    let session = Session {
        run,
        opened: &opened,
        recipe: &recipe,
        identity: opened.identity(&recipe, ""),
        made_by: TRAIN,
        estimate: memory_estimate(&opened.capture, &recipe),
        snapshots: options.snapshots,
        stop,
    };
    let mut listen = listen;
    let state = session.restore(&mut trainer, &mut listen)?;
    session.drive(&mut trainer, state, &mut listen)
}

/// A run's recipe and its capture. Errors: not a run; the capture has gone.
pub fn open_run(run: &Path) -> Result<(Recipe, Capture)> {
    let text = read_text(&run.join("recipe.toml"))?;
    let recipe = Recipe::from_toml(&text).map_err(|e| e.at(run.join("recipe.toml").display()))?;
    let info = read_info(run)?;
    let path = info["capture"].as_str().ok_or_else(|| {
        Error::input("it does not name its capture").at(run.join("run.json").display()).remedy("Train again")
    })?;
    let capture = open_capture(Path::new(path), &recipe)
        .map_err(|e| e.remedy("The run needs its capture where it was when it was trained"))?;
    Ok((recipe, capture))
}

fn read_info(run: &Path) -> Result<serde_json::Value> {
    let path = run.join("run.json");
    serde_json::from_str(&read_text(&path)?)
        .map_err(|e| Error::input(format!("it is not JSON: {e}")).at(path.display()))
}

/// The verb that made a run. Errors: not a run.
fn made_by(run: &Path) -> Result<Option<String>> {
    Ok(read_info(run)?["made_by"].as_str().map(str::to_owned))
}

/// Opens a capture as a recipe wants it: scale, split, and the part of the take that is used.
pub fn open_capture(path: &Path, recipe: &Recipe) -> Result<Capture> {
    let mut capture = Capture::open(path, &capture_options(recipe)?)?;
    if recipe.loss.flow == 0.0 {
        // Nobody looks at it: it need not be decoded.
        capture.frames.iter_mut().for_each(|f| f.flow = None);
    }
    if recipe.capture.first_frame > 0 || recipe.capture.max_frames > 0 {
        let last = if recipe.capture.max_frames == 0 {
            usize::MAX
        } else {
            recipe.capture.first_frame.saturating_add(recipe.capture.max_frames)
        };
        let keep = |i: &usize| (recipe.capture.first_frame..last).contains(&capture.frames[*i].index);
        let (train, held) =
            (capture.train.iter().copied().filter(keep).collect(), capture.held.iter().copied().filter(keep).collect());
        let validation = capture.validation.iter().copied().filter(keep).collect();
        (capture.train, capture.held, capture.validation) = (train, held, validation);
        if capture.train.is_empty() {
            return Err(Error::input(format!(
                "no training frame is left of frames {}..{last}",
                recipe.capture.first_frame
            ))
            .remedy("Change first_frame or max_frames"));
        }
    }
    Ok(capture)
}

/// Errors: a loss on flow, and not one training picture has any.
fn check_flow(capture: &Capture, recipe: &Recipe) -> Result<()> {
    if recipe.loss.flow == 0.0 || capture.train.iter().any(|&i| capture.frames[i].flow.is_some()) {
        return Ok(());
    }
    Err(Error::input("lambda_flow compares flow, and the capture's training pictures have none")
        .remedy("Give cameras a `flow` in capture.json (docs/capture-format.md), or leave lambda_flow at 0"))
}

fn read_text(path: &Path) -> Result<String> {
    std::fs::read_to_string(path)
        .map_err(|e| Error::io("the run cannot be read", e).at(path.display()).remedy("Give the folder of a run"))
}

/// Puts the newest sound checkpoint into the trainer. A damaged newest one is skipped, and said so.
fn restore_newest(run: &Path, trainer: &mut Trainer<'_>, identity: &Identity) -> Result<(RunState, Option<String>)> {
    let mut first_error = None;
    for path in checkpoint::list(run).iter().rev() {
        let read = std::fs::read(path)
            .map_err(|e| Error::io("the checkpoint cannot be read", e))
            .and_then(|bytes| checkpoint::read(&bytes, trainer, identity))
            .map_err(|e| e.at(path.display()));
        match read {
            Ok(state) => return Ok((state, first_error.map(|e: Error| e.to_string()))),
            // Another version or capture is not damage: older ones would say the same.
            Err(e) if e.kind() == ErrorKind::Unsupported => return Err(e),
            Err(e) => first_error = first_error.or(Some(e)),
        }
    }
    Err(first_error.unwrap_or_else(|| {
        Error::input("there is no checkpoint to continue from").at(run.display()).remedy("Train from the start")
    }))
}

/// A capture opened for training: what fresh runs, resumes and probes share.
pub(super) struct OpenCapture {
    pub(super) capture: Arc<Capture>,
    frames: Arc<Dataset>,
    simd: Simd,
}

/// The training frames of a capture, with as much memory for pictures as the recipe grants. Errors: there are none.
pub fn training_frames(capture: Arc<Capture>, recipe: &Recipe) -> Result<Arc<Dataset>> {
    if capture.train.is_empty() {
        return Err(Error::input("the capture has no training frames").remedy("Hold out fewer views with --hold-out"));
    }
    let store = Arc::new(ImageStore::new(capture.clone(), recipe.run.image_memory as usize));
    Ok(Arc::new(Dataset::new(store, capture.train.clone())))
}

/// What programs may know of a capture and a recipe. Panics: the capture has no training frames.
pub fn plan(capture: &Capture, recipe: &Recipe) -> Plan {
    let mut times: Vec<f64> = capture.train.iter().map(|&i| capture.frames[i].time.0).collect();
    times.sort_by(f64::total_cmp);
    times.dedup();
    let clip = [times[0], times[times.len() - 1]];
    let fixed = |i: &&usize| capture.cameras[capture.frames[**i].camera].fixed;
    let mut seen: Vec<f64> = capture.train.iter().filter(fixed).map(|&i| capture.frames[i].time.0).collect();
    seen.sort_by(f64::total_cmp);
    let views = |t: f64| seen.partition_point(|s| *s <= t) - seen.partition_point(|s| *s < t);
    let moments = times.iter().map(|&t| (t, views(t))).collect();
    // Cameras that all stand in one place say nothing of the scene's size.
    let radius = capture.center_and_radius().1;
    Plan {
        recipe: recipe.resolve(),
        extent: if radius > SINGLE_PLACE { radius } else { 1.0 },
        clip,
        fps: capture.fps,
        times: times.len(),
        fixed_cameras: capture.cameras.iter().filter(|c| c.fixed).count(),
        moments,
        masks: capture.background.is_some() || capture.train.iter().any(|&i| capture.frames[i].mask.is_some()),
    }
}

impl OpenCapture {
    pub(super) fn new(capture: Arc<Capture>, recipe: &Recipe) -> Result<Self> {
        Ok(Self::with(training_frames(capture, recipe)?))
    }

    /// With frames that somebody else looks at too.
    pub(super) fn with(frames: Arc<Dataset>) -> Self {
        Self { capture: frames.capture().clone(), frames, simd: Simd::detect() }
    }

    pub(super) fn plan(&self, recipe: &Recipe) -> Plan {
        plan(&self.capture, recipe)
    }

    /// The recipe with a motion model that suits the capture.
    fn choose(&self, recipe: Recipe, listen: &mut dyn FnMut(&Event)) -> Result<Recipe> {
        listen(&Event::Phase { name: "looking at the capture".into(), done: 0, total: 0 });
        let choice = auto::choose(&self.plan(&recipe), self.frames.as_ref())?;
        listen(&Event::Chosen { motion: choice.motion.into(), why: choice.why });
        Ok(recipe.with(|r| r.run.motion = MotionName::of(choice.motion)))
    }

    fn background(&self) -> [f32; 3] {
        self.capture.background.unwrap_or([0.0; 3])
    }

    pub(super) fn initial_scene(&self, plan: &Plan) -> Result<Scene<f32>> {
        let program = program_of(&plan.recipe)?;
        let moving = program.capabilities(plan).moves && plan.times > 1;
        let points = if let Source::File(path) = &plan.recipe.init.source {
            let cloud = crate::capture::read_points(path)?;
            Some(Seeds { points: cloud.points, colors: cloud.colors, times: cloud.times })
        } else {
            self.capture.points.as_ref().map(|c| Seeds {
                points: c.points.clone(),
                colors: c.colors.clone(),
                times: c.times.clone(),
            })
        };
        let (first, frames) = (program.first(plan), self.frames.as_ref());
        let seeds = match moving && program.one_moment(plan) {
            true => init::one_moment(&first, frames, points)?,
            false => init::seeds(&first, frames, points, moving)?,
        };
        init::scene(plan, program.as_ref(), &seeds, self.background(), self.capture.up)
    }

    pub(super) fn trainer(&self, plan: &Plan, scene: Scene<f32>) -> Result<Trainer<'static>> {
        Ok(self.trainer_of(plan, scene, stages(program_of(&plan.recipe)?.as_ref(), plan)))
    }

    /// A trainer with stages that no program made.
    pub(super) fn trainer_of(&self, plan: &Plan, scene: Scene<f32>, stages: Vec<Stage>) -> Trainer<'static> {
        let r = &plan.recipe;
        let config = RenderConfig {
            antialias: if r.appearance.antialias { Antialias::On } else { Antialias::Off },
            simd: self.simd,
            ..RenderConfig::default()
        };
        let mut trained: Vec<usize> = self.capture.train.iter().map(|&i| self.capture.frames[i].camera).collect();
        trained.sort_unstable();
        trained.dedup();
        // A single camera's gain is its own mean, which stays the identity.
        let exposure =
            (r.appearance.exposure && trained.len() > 1).then(|| Exposure::new(self.capture.cameras.len(), trained));
        let settings = Settings {
            seed: r.run.seed,
            limits: Limits { cap: r.densify.max_cap, extent: plan.extent, min_opacity: r.densify.min_opacity },
            background: self.background(),
            sh_degree: r.appearance.sh_degree,
            exposure_lr: r.appearance.exposure_lr,
        };
        let loss = TrainLoss::new(terms(r));
        let mut trainer = Trainer::new(scene, stages, self.frames.clone(), device::cpu(config), loss, settings);
        trainer.learner.exposure = exposure;
        trainer
    }

    /// What a checkpoint is of: the recipe and, where there is more to say, `text`.
    pub(super) fn identity(&self, recipe: &Recipe, text: &str) -> Identity {
        Identity { capture: fingerprint(&self.capture), recipe: recipe_print(recipe, text) }
    }
}

/// A recipe in 16 hexadecimal digits, as it was written before it had tables: runs of then go on.
fn recipe_print(recipe: &Recipe, text: &str) -> String {
    // Knobs that only say how memory is spent never reach a result and may change between resumes.
    let neutral = recipe.clone().with(|r| {
        r.run.image_memory = 0;
        r.run.memory_limit = 0;
        r.run.checkpoint_interval = 0;
    });
    hash(&(neutral.flat_toml() + text))
}

/// Names, sizes, poses and times of a capture in 16 hexadecimal digits.
fn fingerprint(capture: &Capture) -> String {
    let mut text = String::new();
    for &i in &capture.train {
        let f = &capture.frames[i];
        let image = f.image.strip_prefix(&capture.root).unwrap_or(&f.image);
        text += &format!("{image:?} {:?} {:?};", f.view, f.time);
    }
    hash(&text)
}

/// FNV-1a, 64 bits: it guards against mistakes, not against malice.
fn hash(text: &str) -> String {
    let h = text.bytes().fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3));
    format!("{h:016x}")
}

fn save_checkpoint(
    run: &Path,
    trainer: &Trainer<'_>,
    identity: &Identity,
    state: &RunState,
    listen: &mut dyn FnMut(&Event),
) -> Result<()> {
    let path = checkpoint::path(run, trainer.progress.iteration);
    write_atomically(&path, &checkpoint::write(trainer, identity, state)?)?;
    // The one before stays, in case this one is damaged on disk.
    let all = checkpoint::list(run);
    for old in all.iter().rev().skip(2) {
        let _ = std::fs::remove_file(old);
    }
    listen(&Event::Checkpoint { iteration: trainer.progress.iteration, path });
    Ok(())
}

/// Seconds by stage of the chain, over the whole session.
#[derive(Clone, Copy, Debug, Default)]
struct Totals {
    seconds: [f64; 8],
    steps: usize,
}

/// What steps of this session take, without what stages do at their start.
#[derive(Clone, Copy, Debug, Default)]
struct Steps {
    seconds: f64,
    count: usize,
}

impl Steps {
    fn add(&mut self, time: Duration) {
        self.seconds += time.as_secs_f64();
        self.count += 1;
    }

    /// Seconds a step.
    fn mean(&self) -> f64 {
        self.seconds / self.count.max(1) as f64
    }
}

/// Names of the columns that [`Totals`] holds.
const STAGE_NAMES: [&str; 8] =
    ["motion", "render", "loss", "render_backward", "motion_backward", "adam", "load", "other"];

impl Totals {
    fn of(s: &Stepped) -> [f64; 8] {
        let t = &s.report.timings;
        [t.motion, t.render, t.loss, t.render_backward, t.motion_backward, s.adam, s.load, s.other]
            .map(|d| d.as_secs_f64())
    }

    fn add(&mut self, s: &Stepped) {
        self.steps += 1;
        for (sum, x) in self.seconds.iter_mut().zip(Self::of(s)) {
            *sum += x;
        }
    }
}

/// metrics.csv: kept in memory, written whole at every checkpoint, so that it never runs ahead of one.
struct Metrics {
    rows: Vec<(usize, String)>,
    every: usize,
}

impl Metrics {
    const HEADER: &'static str = "iteration,stage,loss,l1,ssim,psnr,gaussians,seconds,motion_ms,render_ms,loss_ms,\
        render_backward_ms,motion_backward_ms,adam_ms,load_ms,other_ms";

    fn open(run: &Path, iteration: usize, iterations: usize) -> Self {
        let text = std::fs::read_to_string(run.join("metrics.csv")).unwrap_or_default();
        let row = |line: &str| Some((line.split(',').next()?.parse::<usize>().ok()?, line.to_owned()));
        let rows = text.lines().skip(1).filter_map(row).filter(|(i, _)| *i <= iteration).collect();
        Self { rows, every: (iterations / METRIC_ROWS).max(1) }
    }

    fn push(&mut self, trainer: &Trainer<'_>, s: &Stepped, state: &RunState) {
        let i = trainer.progress.iteration;
        if !i.is_multiple_of(self.every) && !trainer.is_done() {
            return;
        }
        let ms: Vec<String> = Totals::of(s).iter().map(|t| format!("{:.3}", t * 1e3)).collect();
        let row = format!(
            "{i},{},{:.6},{:.6},{:.6},{:.4},{},{:.2},{}",
            trainer.stage_name(),
            s.report.loss,
            s.l1,
            s.ssim,
            psnr(s.mse),
            trainer.scene().len(),
            state.seconds,
            ms.join(",")
        );
        self.rows.push((i, row));
    }

    fn write(&self, run: &Path) -> Result<()> {
        let mut text = Self::HEADER.to_owned() + "\n";
        for (_, row) in &self.rows {
            text += row;
            text.push('\n');
        }
        write_atomically(&run.join("metrics.csv"), text.as_bytes())
    }
}

fn psnr(mse: f64) -> f64 {
    -10.0 * mse.max(1e-10).log10()
}

/// The verb that makes runs from points.
const TRAIN: &str = "train";

/// A run while it is driven.
pub(super) struct Session<'a> {
    pub(super) run: &'a Path,
    pub(super) opened: &'a OpenCapture,
    pub(super) recipe: &'a Recipe,
    pub(super) identity: Identity,
    /// The verb that made it, and that continues it.
    pub(super) made_by: &'a str,
    /// Bytes of memory, estimated.
    pub(super) estimate: u64,
    pub(super) snapshots: Option<Duration>,
    pub(super) stop: &'a AtomicBool,
}

impl Session<'_> {
    /// Makes the folder of a run that has not taken a step.
    pub(super) fn begin(&self, trainer: &Trainer<'_>, listen: &mut dyn FnMut(&Event)) -> Result<RunState> {
        write_atomically(&self.run.join("recipe.toml"), self.recipe.to_toml().as_bytes())?;
        let state = RunState::default();
        save_checkpoint(self.run, trainer, &self.identity, &state, listen)?;
        self.write_info(&Totals::default(), trainer, &state, false)?;
        Ok(state)
    }

    /// Goes to the newest sound checkpoint, and warns of what was skipped.
    pub(super) fn restore(&self, trainer: &mut Trainer<'_>, listen: &mut dyn FnMut(&Event)) -> Result<RunState> {
        let (state, warning) = restore_newest(self.run, trainer, &self.identity)?;
        if let Some(message) = warning {
            listen(&Event::Warning { message });
        }
        Ok(state)
    }

    /// Steps until all stages are done or somebody says stop.
    pub(super) fn drive(
        &self,
        trainer: &mut Trainer<'_>,
        mut state: RunState,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Outcome> {
        let iterations = trainer.iterations();
        let first = trainer.progress.iteration;
        listen(&Event::Started {
            run: self.run.to_owned(),
            iteration: first,
            iterations,
            gaussians: trainer.scene().len(),
            memory_estimate: self.estimate,
        });
        let mut metrics = Metrics::open(self.run, first, iterations);
        let mut totals = Totals::default();
        let shown = trainer.scene().without_head("the player");
        if let (Some(_), Err(e)) = (self.snapshots, &shown) {
            listen(&Event::Warning { message: format!("training cannot be watched: {e}") });
        }
        let interval = self.snapshots.filter(|_| shown.is_ok());
        let mut snapshots = interval.map(|interval| Snapshots::new(interval, &self.opened.capture));
        let (mut clock, mut told) = (Clock::now(), Clock::now());
        let mut steps = Steps::default();
        while !trainer.is_done() && !self.stop.load(Ordering::Relaxed) {
            let from = (trainer.progress.stage, trainer.progress.iteration);
            trainer.enter(&mut Progress(listen))?;
            state.seconds += clock.elapsed().as_secs_f64();
            clock = Clock::now();
            if trainer.is_done() {
                break;
            }
            let entered = from == (0, 0) || from.0 != trainer.progress.stage || trainer.progress.stage_step == 0;
            let step = match trainer.step()? {
                Ok(step) => step,
                Err(fault) => {
                    state = self.roll_back(trainer, &fault.0, listen)?;
                    metrics.rows.retain(|(i, _)| *i <= trainer.progress.iteration);
                    continue;
                }
            };
            steps.add(clock.elapsed());
            state.seconds += clock.elapsed().as_secs_f64();
            clock = Clock::now();
            let fresh = if trainer.progress.iteration <= 1 { 1.0 } else { SMOOTHING };
            for (old, new) in state.smooth.iter_mut().zip([step.report.loss, step.mse]) {
                *old += fresh * (new - *old);
            }
            totals.add(&step);
            metrics.push(trainer, &step, &state);
            if told.elapsed().as_secs_f64() > PROGRESS_SECONDS || trainer.is_done() {
                told = Clock::now();
                listen(&self.progress(trainer, &state, &steps));
            }
            let i = trainer.progress.iteration;
            if let Some(event) = snapshots.as_mut().and_then(|s| s.take(trainer)) {
                listen(&event);
            }
            // What the start of a later stage did may have taken long: it is not to be done twice.
            let due = i.is_multiple_of(self.recipe.run.checkpoint_interval) || entered && i > 1;
            if due && !trainer.is_done() {
                self.save(trainer, &state, &metrics, &totals, false, listen)?;
            }
        }
        let done = trainer.is_done();
        self.save(trainer, &state, &metrics, &totals, done, listen)?;
        let gaussians = trainer.scene().len();
        let iteration = trainer.progress.iteration;
        if let Some(snapshots) = &mut snapshots {
            listen(&snapshots.now(trainer));
        }
        if done {
            let mut bytes = Vec::new();
            splat4d::format::scene::write(&trainer.shown(), &mut bytes)?;
            write_atomically(&self.run.join("scene.safetensors"), &bytes)?;
            listen(&Event::Finished { iteration, seconds: state.seconds, gaussians, peak_memory: peak_memory() });
        }
        Ok(Outcome { run: self.run.to_owned(), iteration, gaussians, seconds: state.seconds, interrupted: !done })
    }

    fn progress(&self, trainer: &Trainer<'_>, state: &RunState, steps: &Steps) -> Event {
        let (iteration, iterations) = (trainer.progress.iteration, trainer.iterations());
        Event::Progress {
            iteration,
            iterations,
            stage: trainer.stage_name().to_owned(),
            loss: state.smooth[0],
            psnr: psnr(state.smooth[1]),
            gaussians: trainer.scene().len(),
            seconds: state.seconds,
            seconds_left: steps.mean() * (iterations - iteration) as f64,
        }
    }

    fn save(
        &self,
        trainer: &Trainer<'_>,
        state: &RunState,
        metrics: &Metrics,
        totals: &Totals,
        finished: bool,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<()> {
        metrics.write(self.run)?;
        save_checkpoint(self.run, trainer, &self.identity, state, listen)?;
        self.write_info(totals, trainer, state, finished)
    }

    /// run.json: what the run is and how it went.
    fn write_info(&self, totals: &Totals, trainer: &Trainer<'_>, state: &RunState, finished: bool) -> Result<()> {
        let (capture, recipe) = (&self.opened.capture, self.recipe);
        let steps = totals.steps.max(1) as f64;
        let ms: serde_json::Map<String, serde_json::Value> =
            STAGE_NAMES.iter().zip(totals.seconds).map(|(n, s)| ((*n).to_owned(), json!(s * 1e3 / steps))).collect();
        let root = std::fs::canonicalize(&capture.root).unwrap_or_else(|_| capture.root.clone());
        let info = json!({
            "version": env!("CARGO_PKG_VERSION"),
            "made_by": self.made_by,
            "capture": root,
            "capture_name": capture.name,
            "capture_fingerprint": fingerprint(capture),
            "motion": recipe.run.motion.as_str(),
            "seed": recipe.run.seed,
            "simd": format!("{:?}", self.opened.simd).to_lowercase(),
            "threads": rayon::current_num_threads(),
            "iteration": trainer.progress.iteration,
            "iterations": trainer.iterations(),
            "gaussians": trainer.scene().len(),
            "seconds": state.seconds,
            "finished": finished,
            "rollbacks": trainer.progress.strikes,
            "peak_memory": peak_memory(),
            "memory_estimate": self.estimate,
            "ms_per_step": ms,
            "warnings": capture.warnings,
        });
        let text = serde_json::to_string_pretty(&info).expect("plain data is JSON");
        write_atomically(&self.run.join("run.json"), text.as_bytes())
    }

    /// Back to the last checkpoint with half the rates; the third time the run is given up.
    fn roll_back(&self, trainer: &mut Trainer<'_>, what: &str, listen: &mut dyn FnMut(&Event)) -> Result<RunState> {
        let (failed, strikes, rate) =
            (trainer.progress.iteration + 1, trainer.progress.strikes + 1, trainer.progress.rate_scale);
        if strikes >= MAX_STRIKES {
            return Err(Error::new(
                ErrorKind::Diverged,
                format!("training diverged {strikes} times, last at iteration {failed}: {what}"),
            )
            .remedy("Look for wrong poses with `splat4d info CAPTURE`, or lower position_lr_init and scaling_lr"));
        }
        let (state, _) = restore_newest(self.run, trainer, &self.identity)?;
        trainer.progress.strikes = strikes;
        trainer.progress.rate_scale = rate * ROLLBACK_RATE;
        listen(&Event::RolledBack { iteration: failed, to: trainer.progress.iteration, what: what.to_owned() });
        Ok(state)
    }
}
