//! The work behind `predict`: nodes of the observed part, forecasts of all models, their scenes, and their scores on
//! images that training did not use.

mod assimilate;
mod score;
mod write;

use score::{Views, scores};

use crate::deadline::unless_stopped;
use crate::events::Listener;
use crate::files::human_seconds;
use crate::report::predict::Summary;
use crate::run_folder::Run;
use crate::source::read_scene;
use crate::{files, report};
use splat4d::layers::Scene;
use splat4d::{Error, Result};
use splat4d_dynamics::actions::Actions;
use splat4d_dynamics::future::{Clock, predicted};
use splat4d_dynamics::learnt::Training;
use splat4d_dynamics::models::{Fitted, Model, Settings};
use splat4d_dynamics::nodes::{Observed, follow, observe};
use splat4d_dynamics::paths::{Moment, Neighbours, Paths};
use splat4d_dynamics::score::{calibration, diverged, ensemble, node_errors};
use splat4d_train::capture::{Capture, ImageStore};
use splat4d_train::output::OutputFolder;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Shares of the observed ticks at which trial forecasts for the choice of a model start, and their length. Models are
/// fitted to what is before the first of them: at a single start a wrong model may be right by chance, for example on a
/// swing's turning point.
const STARTS: [f64; 3] = [0.6, 0.7, 0.8];
const AHEAD: f64 = 0.2;
/// Output folder in the run.
const FOLDER: &str = "predict";

/// Nodes on dynamic regions unless others are requested.
pub const NODES: usize = 48;
/// Steps of training unless others are requested.
pub const STEPS: usize = 1500;

/// Options of [`predict`].
#[derive(Debug)]
pub struct PredictOptions {
    /// The run, trained with `capture.observe`; its capture must still be at its place.
    pub run: PathBuf,
    /// Frames to predict. `None`: as many as have images.
    pub horizon: Option<usize>,
    /// Models to try. The scene is that of the best at forecasting what was observed.
    pub models: Vec<Model>,
    /// Known actions, one row per frame from the first of the clip.
    pub actions: Option<Actions>,
    /// Members of the ensembles of the trained models.
    pub seeds: u64,
    /// Largest number of nodes on dynamic regions.
    pub nodes: usize,
    /// Training of the models that are trained.
    pub training: Training,
    /// Give the trained models the down direction.
    pub gravity: bool,
    /// Correct the prediction by each new frame.
    pub assimilate: bool,
    /// A run of the same capture that saw all of it: the upper bound.
    pub oracle: Option<PathBuf>,
    /// Write films of truth and prediction.
    pub film: bool,
}

impl PredictOptions {
    /// All models, as far as there are images, with films.
    pub fn new(run: impl Into<PathBuf>) -> Self {
        Self {
            run: run.into(),
            horizon: None,
            models: Model::ALL.to_vec(),
            actions: None,
            seeds: 1,
            nodes: NODES,
            training: Training { steps: STEPS, seed: 0 },
            gravity: false,
            assimilate: false,
            oracle: None,
            film: true,
        }
    }
}

/// Forecasts a scene and compares with the part of its capture that was kept from training. Returns the folder of the
/// report, the forecasts and the predicted scene.
///
/// Errors: a run that is unfinished or was trained on its whole clip; too few observed frames; actions that are too
/// short; nothing moves; another command writes the run; `stop` was raised, which is checked between models and images.
///
/// ```no_run
/// use splat4d_workflow::events::ignore;
/// use splat4d_workflow::predicting::{PredictOptions, predict};
/// use std::sync::atomic::AtomicBool;
///
/// # fn main() -> splat4d::Result<()> {
/// let options = PredictOptions { horizon: Some(90), ..PredictOptions::new("runs/seen") };
/// let folder = predict(options, &AtomicBool::new(false), &ignore)?;
/// println!("{}", folder.join("report.html").display());
/// # Ok(())
/// # }
/// ```
pub fn predict(options: PredictOptions, stop: &AtomicBool, listener: &dyn Listener) -> Result<PathBuf> {
    Run::open(&options.run)?;
    let _folder = OutputFolder::amend(&options.run, "predict")?;
    let folder = options.run.join(FOLDER);
    Work::open(options, listener)?.run(stop, listener)?;
    Ok(folder)
}

/// Everything that is known before the first forecast.
struct Work {
    order: PredictOptions,
    run: Run,
    antialias: bool,
    capture: Arc<Capture>,
    store: Arc<ImageStore>,
    scene: Scene<f32>,
    clock: Clock,
    horizon: usize,
    ticks: usize,
    observed: Observed,
}

/// A model's forecast.
struct Forecast {
    pub model: Model,
    pub fitted: Vec<Fitted>,
    pub moments: Vec<Moment>,
    pub spread: Option<Vec<Vec<f64>>>,
    pub scene: Scene<f32>,
    pub seconds: [f64; 2],
    pub backtest: Option<f64>,
}

impl Work {
    /// Opens the run and finds its nodes.
    ///
    /// Errors: a run that is unfinished or saw all of its take, too few observed frames, actions that are too short,
    /// nothing that moves.
    fn open(order: PredictOptions, console: &dyn Listener) -> Result<Self> {
        let run = Run::open(&order.run)?;
        let place = order.run.display().to_string();
        if !Run::is_finished(&order.run) {
            return Err(Run::unfinished(&order.run, "the run is unfinished"));
        }
        let recipe = run.recipe()?;
        if recipe.capture.observe >= 1.0 {
            return Err(Error::input("the run was trained on its whole clip, so nothing is left to predict")
                .at(&place)
                .remedy("Train without the end of the clip: splat4d train CAPTURE --observe 0.8"));
        }
        console.phase("reading the run", 0, 0);
        let (capture, recipe) = run.open_capture()?;
        let scene = read_scene(&run.scene_file()?)?;
        let fps = if capture.fps > 0.0 { capture.fps } else { scene.fps };
        let clock = Clock { until: scene.clip[1], fps };
        let ticks = ((scene.clip[1] - scene.clip[0]) * fps).round() as usize + 1;
        let last = capture.future.iter().map(|&i| capture.frames[i].time.0).fold(clock.until, f64::max);
        let pictured = ((last - clock.until) * fps).round() as usize;
        let horizon = order.horizon.unwrap_or(pictured.max(1));
        if let Some(actions) = &order.actions {
            actions.check(ticks, horizon)?;
        }
        console.phase("tracking moving parts", 0, 0);
        let times: Vec<f64> = (0..ticks).map(|i| clock.until - (ticks - 1 - i) as f64 / fps).collect();
        let observed = observe(&scene, &times, order.nodes).map_err(|e| e.at(&place))?;
        console.clear();
        let capture = Arc::new(capture);
        let store = Arc::new(ImageStore::new(capture.clone(), recipe.run.image_memory as usize));
        let antialias = recipe.appearance.antialias;
        Ok(Self { order, run, antialias, capture, store, scene, clock, horizon, ticks, observed })
    }

    fn run(&self, stop: &AtomicBool, console: &dyn Listener) -> Result<()> {
        let folder = self.order.run.join(FOLDER);
        files::make_folder(&folder)?;
        console.result(&format!(
            "{} nodes on {} moving Gaussians, {} frames observed, {} to predict",
            self.observed.paths.nodes(),
            files::grouped(self.moving()),
            self.ticks,
            self.horizon
        ));
        let (views, oracle) = (Views::new(self)?, self.oracle()?);
        // All others are compared with freeze and constant velocity, requested or not.
        let mut models = vec![Model::Freeze, Model::Velocity];
        models.extend(self.order.models.iter().filter(|m| !models.contains(m)).copied().collect::<Vec<_>>());
        let mut forecasts: Vec<Forecast> = Vec::new();
        for (i, &model) in models.iter().enumerate() {
            console.phase(&format!("forecasting: {}", model.name()), i, models.len());
            unless_stopped(stop)?;
            forecasts.push(self.forecast(model)?);
        }
        console.clear();
        let truth = oracle.as_ref().map(|scene| self.follow(scene));
        let mut cases = Vec::new();
        for (i, f) in forecasts.iter().enumerate() {
            console.phase("comparing with images", i, forecasts.len());
            cases.push(views.cases(self, &f.scene, stop)?);
        }
        console.clear();
        let mut scored = Vec::new();
        for (f, own) in forecasts.iter().zip(&cases) {
            let mut model_scores = scores(f.model.name(), own, [&cases[0], &cases[1]], self.horizon);
            model_scores.seconds_fit = f.seconds[0];
            model_scores.seconds_rollout = f.seconds[1];
            model_scores.backtest = f.backtest;
            model_scores.diverged = diverged(&f.moments, self.observed.paths.last(), self.observed.size);
            model_scores.node_error = truth.as_ref().map(|t| node_errors(&f.moments, t));
            model_scores.calibration =
                truth.as_ref().zip(f.spread.as_ref()).and_then(|(t, s)| calibration(&f.moments, s, t));
            model_scores.track_error = views.track_errors(self, &f.moments);
            scored.push(model_scores);
        }
        let oracle = match &oracle {
            Some(scene) => {
                let own = views.cases(self, scene, stop)?;
                let mut model_scores = scores("oracle", &own, [&cases[0], &cases[1]], self.horizon);
                model_scores.track_error = truth.as_ref().and_then(|t| views.track_errors(self, t));
                Some(model_scores)
            }
            None => None,
        };
        let best = self.chosen(&forecasts);
        let assimilated = match self.order.assimilate {
            true => Some(assimilate::run(self, best, &views, [&cases[0], &cases[1]], stop, console)?),
            false => None,
        };
        let summary = Summary {
            run: self.order.run.clone(),
            until: self.clock.until,
            fps: self.clock.fps,
            observed_frames: self.ticks,
            horizon: self.horizon,
            pictured: views.pictured(),
            views: views.len(),
            nodes: self.observed.paths.nodes(),
            moving_gaussians: self.moving(),
            size: self.observed.size,
            actions: self.order.actions.as_ref().map_or_else(Vec::new, |a| a.names.clone()),
            seeds: self.order.seeds,
            models: scored,
            oracle,
            assimilated,
            scene: best.model.name(),
        };
        write::all(self, &folder, &summary, &forecasts, best, console)?;
        let films = if self.order.film { views.films(self, &folder, best, stop, console)? } else { Vec::new() };
        let page = report::predict::write(&folder, &self.run.name(), &summary, &films)?;
        print_summary(&summary, console);
        console.written(&page);
        Ok(())
    }

    fn moving(&self) -> usize {
        self.observed.moving.iter().flatten().filter(|m| **m).count()
    }

    /// Fits a model and lets it continue.
    fn forecast(&self, model: Model) -> Result<Forecast> {
        let (paths, actions) = (&self.observed.paths, self.order.actions.as_ref());
        let started = Instant::now();
        if model == Model::Extrapolate {
            let mut scene = self.scene.clone();
            scene.clip[1] = self.clock.at(self.horizon);
            let moments = self.follow(&scene);
            let seconds = [0.0, started.elapsed().as_secs_f64()];
            return Ok(Forecast { model, fitted: Vec::new(), moments, spread: None, scene, seconds, backtest: None });
        }
        let fitted = self.fit(model, paths)?;
        let fit = started.elapsed().as_secs_f64();
        let started = Instant::now();
        let (moments, spread) = self.rollout(&fitted, paths, actions, self.horizon);
        let scene = predicted(&self.scene, &self.observed, &moments, self.clock)?;
        let rollout = started.elapsed().as_secs_f64();
        let backtest = if self.order.models.len() > 1 { self.backtest(model)? } else { None };
        Ok(Forecast { model, fitted, moments, spread, scene, seconds: [fit, rollout], backtest })
    }

    /// The mean node error of forecasts of what was observed; `None`: too little was.
    fn backtest(&self, model: Model) -> Result<Option<f64>> {
        let (paths, actions) = (&self.observed.paths, self.order.actions.as_ref());
        let tick = |share: f64| ((share * self.ticks as f64).round() as usize).min(self.ticks);
        if tick(STARTS[0]) < splat4d_dynamics::learnt::LEAST_TICKS {
            return Ok(None);
        }
        let fitted = self.fit(model, &paths.first(tick(STARTS[0])))?;
        let mut errors = Vec::new();
        for (start, end) in STARTS.map(|s| (tick(s), tick(s + AHEAD))) {
            let moments = self.rollout(&fitted, &paths.first(start), actions, end - start).0;
            errors.extend(node_errors(&moments, &paths.moments[start..end]));
        }
        Ok(Some(errors.iter().sum::<f64>() / errors.len().max(1) as f64))
    }

    fn fit(&self, model: Model, paths: &Paths) -> Result<Vec<Fitted>> {
        let seeds = if model.is_trained() { self.order.seeds } else { 1 };
        let one = |seed| {
            let training = Training { seed, ..self.order.training.clone() };
            let gravity = self.order.gravity.then(|| self.scene.up.map(|x| -x));
            Fitted::fit(model, paths, self.order.actions.as_ref(), &Settings { training, gravity, floor: None })
        };
        (0..seeds).map(one).collect()
    }

    /// The mean of an ensemble's forecasts, and its spread where it is one.
    fn rollout(
        &self,
        fitted: &[Fitted],
        paths: &Paths,
        actions: Option<&Actions>,
        horizon: usize,
    ) -> (Vec<Moment>, Option<Vec<Vec<f64>>>) {
        let mut members: Vec<Vec<Moment>> = fitted.iter().map(|f| f.rollout(paths, actions, horizon)).collect();
        if members.len() == 1 {
            return (members.swap_remove(0), None);
        }
        let (mut mean, spread) = ensemble(&members);
        let frames = Neighbours::new(paths.last());
        mean.iter_mut().for_each(|m| frames.turn(paths.last(), m));
        (mean, Some(spread))
    }

    /// The nodes in another scene's future, as far as it is known.
    fn follow(&self, scene: &Scene<f32>) -> Vec<Moment> {
        let end = scene.clip[1] + 0.5 / self.clock.fps;
        let ticks: Vec<f64> = (0..=self.horizon).map(|h| self.clock.at(h)).take_while(|t| *t < end).collect();
        follow(scene, self.observed.paths.last(), &ticks).split_off(1)
    }

    /// The scene of the run that saw everything. Errors: it is of another capture, or did not see more.
    fn oracle(&self) -> Result<Option<Scene<f32>>> {
        let Some(path) = &self.order.oracle else { return Ok(None) };
        let run = Run::open(path)?;
        let same =
            run.capture().and_then(|c| c.canonicalize().ok()) == self.run.capture().and_then(|c| c.canonicalize().ok());
        let scene = read_scene(&run.scene_file()?)?;
        if !same || scene.clip[1] <= self.clock.until {
            return Err(Error::input(
                "invalid oracle: expected a run of the same capture that was trained on more of it",
            )
            .at(path.display())
            .remedy("Train it on the same capture with the same recipe, without option `observe`"));
        }
        Ok(Some(scene))
    }

    /// The model whose scene is written: the requested one if there is only one, else the best at forecasting what was
    /// observed.
    fn chosen<'a>(&self, forecasts: &'a [Forecast]) -> &'a Forecast {
        let asked = |f: &&Forecast| self.order.models.contains(&f.model);
        let error = |f: &Forecast| f.backtest.unwrap_or(f64::INFINITY);
        let all = forecasts.iter().filter(asked);
        all.min_by(|a, b| error(a).total_cmp(&error(b))).expect("at least one model was requested")
    }
}

/// The figures in the terminal.
fn print_summary(summary: &Summary, console: &dyn Listener) {
    let number = |x: Option<f64>, digits: usize| x.map_or("–".to_owned(), |x| report::predict::rounded(x, digits));
    console.result("model          PSNR  dynamic regions     skill over freeze  over velocity");
    for m in summary.models.iter().chain(&summary.assimilated).chain(&summary.oracle) {
        console.result(&format!(
            "{:<13}{:>6}{:>12} dB{:>18}{:>17}   fitted in {}",
            m.name,
            number(m.psnr, 2),
            number(m.psnr_dynamic, 2),
            number(m.skill_over_freeze, 3),
            number(m.skill_over_velocity, 3),
            human_seconds(m.seconds_fit)
        ));
    }
}
