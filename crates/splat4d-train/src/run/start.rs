//! Starts runs, and continues them from their folders.

use super::aligned::aligned;
use super::budget::{Budget, PROBES};
use super::checkpoint;
use super::count::settled;
use super::far;
use super::flows;
use super::follow::Following;
use super::identity::identity;
use super::info::{read_info, read_text};
use super::measured;
use super::memory::memory_estimate;
use super::minutes::Timing;
use super::open::{OpenCapture, capture_options, check_flow, open_with};
use super::points;
use super::priors;
use super::session::{Outcome, Session, TrainOptions};
use crate::capture::{Capture, CaptureOptions};
use crate::event::Event;
use crate::init::Seeds;
use crate::path_text::of_text;
use crate::recipe::Recipe;
use crate::{Error, ErrorKind, Result};
use serde_json::Value;
use splat4d::device::{self, Device};
use splat4d::render::RenderConfig;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Seconds that steps are timed for, where a run is not kept to its minutes and is only to be foretold.
const PREDICTION: f64 = 4.0;
/// The scene of a finished run.
const SCENE: &str = "scene.safetensors";
/// The verb that makes runs from points.
pub(super) const TRAIN: &str = "train";

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
    let opened = OpenCapture::new(capture, &recipe)?.on(options.device);
    check_flow(&opened.capture, &recipe)?;
    let mut listen = listen;
    // Before the model is chosen by what maps indicate; again where points have to be found first.
    let (opened, early) = priors::believed(opened, &recipe)?;
    let recipe = if recipe.run.motion.is_auto() {
        // Maps without a unit are fitted to all points, below; the capture's own determine whether they will be metric.
        let (fitted, _) = aligned(OpenCapture::with(opened.frames.clone()).on(opened.device), &recipe)?;
        fitted.choose(recipe, &mut listen)?
    } else {
        recipe
    };
    recipe.program()?.check(&opened.plan(&recipe))?;
    recipe.without_effect().iter().for_each(|idle| listen(&Event::Warning { message: idle.to_string() }));
    let opened = points::complete(opened, &recipe, run, &mut listen)?;
    let opened = flows::complete(opened, &recipe, run, &mut listen)?;
    measured::before(&opened)?;
    let (opened, unfitted) = aligned(opened, &recipe)?;
    let (opened, warning) = priors::believed(opened, &recipe)?;
    for message in priors::before(&opened, &recipe)?.into_iter().chain(early).chain(unfitted).chain(warning) {
        listen(&Event::Warning { message });
    }
    let recipe = far::decided(&opened, recipe, &mut listen)?;
    let timed = timed(&opened, recipe, options, &mut listen)?;
    let recipe = timed.recipe.resolve();
    let plan = opened.plan(&recipe);
    let estimate = memory_estimate(&opened.capture, &recipe);
    if let Some(seconds) = timed.seconds {
        let view = &opened.capture.frames[opened.capture.train[0]].view;
        listen(&Event::Predicted {
            iterations: recipe.run.iterations,
            gaussians: recipe.densify.max_cap,
            size: [view.width, view.height],
            seconds,
            memory_estimate: estimate,
        });
    }
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
    let scene = opened.initial_scene(&recipe, &plan)?;
    let mut trainer = opened.trainer(&recipe, &plan, scene)?;
    trainer.check_not_empty()?;
    options.add_loss(&mut trainer);
    let session = Session {
        run,
        opened: &opened,
        recipe: &recipe,
        identity: identity(&opened.capture, &recipe, ""),
        made_by: TRAIN,
        estimate,
        snapshots: options.snapshots,
        clock: options.clock.clone(),
        budget: timed.budget.map(|b| Budget { before: options.clock.seconds(), ..b }),
        own_loss: options.own_loss.is_some(),
        stop,
    };
    let state = session.begin(&trainer, &mut listen)?;
    session.drive(&mut trainer, state, &mut listen)
}

/// A recipe and its estimated time.
struct Timed {
    recipe: Recipe,
    /// From the command's start to its end.
    seconds: Option<f64>,
    budget: Option<Budget>,
}

/// Times steps where the options request it, and fits the recipe to its minutes.
fn timed(
    opened: &OpenCapture,
    recipe: Recipe,
    options: &TrainOptions,
    listen: &mut dyn FnMut(&Event),
) -> Result<Timed> {
    let TrainOptions { minutes, finish, predict, ref clock, .. } = *options;
    let mut listen = listen;
    if minutes.is_none() && !predict {
        return Ok(Timed { recipe: opened.counted(recipe, &mut listen)?, seconds: None, budget: None });
    }
    if let Some(m) = minutes.filter(|m| !(*m > 0.0 && m.is_finite())) {
        return Err(Error::input(format!("--minutes cannot be {m}")).remedy("Give a positive number, for instance 3"));
    }
    // How many steps there will be follows from the minutes, and is not known yet.
    let steps = minutes.map_or(recipe.run.iterations as f64, |_| f64::INFINITY);
    let needed = if recipe.densify.max_cap == 0 { Some(opened.needed(&recipe, steps)?) } else { None };
    let with = |count: usize| recipe.clone().with(|r| r.densify.max_cap = count);
    let most = needed.as_ref().map_or(recipe.densify.max_cap, |n| n.0);
    let seconds = minutes.map_or(PREDICTION, |m| 60.0 * PROBES * m);
    let timing = Timing::measure(opened, &with(most), clock, seconds, &mut listen)?;
    let before = clock.seconds() + timing.scene;
    let fit = |count: usize| match minutes {
        Some(m) => timing.fit(opened, &with(count), 60.0 * m - before, finish),
        None => Ok(with(count)),
    };
    let count = match (&needed, minutes) {
        (Some(_), Some(_)) => settled(most, recipe.densify.count_scale, |n| Ok(fit(n)?.run.iterations))?,
        _ => most,
    };
    if let Some((_, why)) = needed {
        let more = if count < most { ", and the steps that fit the minutes cannot train more" } else { "" };
        listen(&Event::Counted { gaussians: count, why: why + more });
    }
    let recipe = fit(count)?;
    let [steps, last] = timing.of(opened, &recipe)?;
    let budget = minutes.map(|minutes| Budget { minutes, before, finish, timing });
    Ok(Timed { recipe, seconds: Some(before + steps + finish * last), budget })
}

/// Continues the run in the folder `run`, exactly.
pub fn resume(run: &Path, stop: &AtomicBool, listen: &mut dyn FnMut(&Event)) -> Result<Outcome> {
    resume_with(run, &TrainOptions::default(), stop, listen)
}

/// Estimated cost of training with all defaults.
#[derive(Clone, Debug, PartialEq)]
pub struct Forecast {
    /// The motion model that would be learnt.
    pub motion: &'static str,
    /// Why it is that one, a sentence.
    pub why: String,
    /// Steps.
    pub iterations: usize,
    /// Gaussians at most.
    pub gaussians: usize,
    /// Bytes of memory at most, estimated.
    pub memory: u64,
}

/// Examines a capture as `train` would before its first step.
///
/// Errors: what `train` would refuse the capture for, images that cannot be read.
pub fn forecast(capture: Arc<Capture>, listen: &mut dyn FnMut(&Event)) -> Result<Forecast> {
    let recipe = Recipe::default();
    let opened = OpenCapture::new(capture, &recipe)?;
    let (recipe, choice) = opened.chosen(recipe, listen)?;
    let (gaussians, _) = opened.needed(&recipe, recipe.run.iterations as f64)?;
    let recipe = recipe.with(|r| r.densify.max_cap = gaussians).resolve();
    let memory = memory_estimate(&opened.capture, &recipe);
    Ok(Forecast { motion: choice.motion, why: choice.why, iterations: recipe.run.iterations, gaussians, memory })
}

/// As [`resume`]; of the options only `device`, `own_loss`, `snapshots` and `clock` count, the rest was settled at the
/// start. A run with `minutes` keeps to what is left of them: time between the commands does not count.
pub fn resume_with(
    run: &Path,
    options: &TrainOptions,
    stop: &AtomicBool,
    listen: &mut dyn FnMut(&Event),
) -> Result<Outcome> {
    let (recipe, capture) = open_run(run)?;
    if let Some(message) = capture.coarse() {
        listen(&Event::Warning { message: message.into() });
    }
    let info = read_info(run)?;
    let own_loss = info["own_loss"].as_bool().unwrap_or(false);
    if own_loss != options.own_loss.is_some() {
        let what =
            if own_loss { "was trained with a loss of its own program" } else { "was trained without a loss of yours" };
        return Err(Error::input(format!("this run {what}"))
            .at(run.display())
            .remedy("Continue it with the losses it began with, or begin a new run"));
    }
    if let Some(other) = info["made_by"].as_str().filter(|m| *m != TRAIN) {
        return Err(Error::input(format!("this run was made by `{other}`"))
            .at(run.display())
            .remedy(format!("Continue it with `splat4d {other}` and the options it began with")));
    }
    let opened = OpenCapture::new(Arc::new(capture), &recipe)?.on(same_device(options.device, &info));
    // As it was settled at the start.
    let (opened, _) = aligned(opened, &recipe)?;
    let (opened, _) = priors::believed(opened, &recipe)?;
    let plan = opened.plan(&recipe);
    let empty = opened.scene(&recipe, &plan, recipe.program()?.as_ref(), &Seeds::default(), opened.background()?)?;
    let mut trainer = opened.trainer(&recipe, &plan, empty)?;
    options.add_loss(&mut trainer);
    let session = Session {
        run,
        opened: &opened,
        recipe: &recipe,
        identity: identity(&opened.capture, &recipe, ""),
        made_by: TRAIN,
        estimate: memory_estimate(&opened.capture, &recipe),
        snapshots: options.snapshots,
        clock: options.clock.clone(),
        // An older run, without budgets, has none.
        budget: serde_json::from_value(info["budget"].clone()).ok(),
        own_loss,
        stop,
    };
    let mut listen = listen;
    let state = session.restore(&mut trainer, &mut listen)?;
    session.drive(&mut trainer, state, &mut listen)
}

/// The device to continue a run on: `auto` keeps the CPU, and with it the bits of an uninterrupted run.
fn same_device(device: Device, info: &Value) -> Device {
    let on_cpu = info["device"].as_str() == Some(device::cpu(RenderConfig::default()).name());
    if device == Device::Auto && on_cpu { Device::Cpu } else { device }
}

/// The options with which a run opens its capture. `recipe`: that of the run. A followed run needs only the images of the
/// frames that it took, as its capture may have ended early or may still be recorded.
pub fn run_options(run: &Path, recipe: &Recipe) -> Result<CaptureOptions> {
    let frames = Following::taken(run);
    Ok(CaptureOptions { gaps: !frames.is_empty(), frames, ..capture_options(recipe)? })
}

/// A run's recipe and its capture, relative to the offset of the run's scene. Errors: not a run; the capture is
/// missing.
pub fn open_run(run: &Path) -> Result<(Recipe, Capture)> {
    let text = read_text(&run.join("recipe.toml"))?;
    let recipe = Recipe::from_toml(&text).map_err(|e| e.at(run.join("recipe.toml").display()))?;
    let info = read_info(run)?;
    let path = info["capture"].as_str().ok_or_else(|| {
        Error::input("it does not name its capture").at(run.join("run.json").display()).remedy("Train again")
    })?;
    let mut capture = open_with(&of_text(path), &recipe, run_options(run, &recipe)?)
        .map_err(|e| e.remedy("The run needs its capture where it was when it was trained"))?;
    if capture.offset != [0.0; 3]
        && let Some(offset) = offset_of_scene(run)?
    {
        capture.relocate(offset);
    }
    let capture = flows::with_found(points::with_found(capture, &recipe, run)?, &recipe, run);
    Ok((recipe, capture))
}

/// The offset of a run's scene; `None`: there is no scene yet. Runs of earlier versions have none, which is zero.
fn offset_of_scene(run: &Path) -> Result<Option<[f64; 3]>> {
    let finished = Some(run.join(SCENE)).filter(|path| path.is_file());
    let Some(path) = finished.or_else(|| checkpoint::list(run).pop()) else { return Ok(None) };
    let place = |e: Error| e.at(path.display());
    let bytes = crate::files::read(&path)?;
    Ok(Some(splat4d::format::scene::read(&bytes).map_err(place)?.offset))
}
