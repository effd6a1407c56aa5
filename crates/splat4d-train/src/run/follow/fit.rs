//! One frame of a followed capture: the Gaussians whose pixels changed learn, and new ones appear among them.

use super::changed::{Comparison, TileErrors, settled};
use super::history::{History, gathered, still};
use super::record::{NEW, Record};
use crate::event::{Event, Progress};
use crate::init::{self, InitSettings, Seeds, hull};
use crate::methods::{TrainContext, still as still_method};
use crate::recipe::Recipe;
use crate::run::dataset::Dataset;
use crate::run::open::OpenCapture;
use crate::step::trainer::{Fault, Trainer};
use crate::train_state::Exposure;
use crate::{Error, ErrorKind, Result};
use serde_json::Value;
use splat4d::layers::Scene;
use splat4d::math::Rng;
use splat4d::scene::{GEOMETRY, Params, Space};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Table and column that carry a Gaussian's place among the active ones through density control.
const ORIGIN: (&str, &str) = ("follow", "origin");
/// Time between two reports of progress.
const REPORT: Duration = Duration::from_millis(250);
/// Views by which it is decided whether Gaussians continue their motion.
const LOOKS: usize = 6;
/// Longest step that a Gaussian repeats in the next frame, extents (as `tracked.velocity_cap`).
const VELOCITY_CAP: f64 = 0.05;
/// A frame may always add this many Gaussians.
const LEAST_GROWTH: usize = 64;
/// Points for what appears, by pixel that shows it in an image (mean of all views).
const PER_PIXEL: f64 = 2.0;
/// Their opacity: there is no time to grow it from [`InitSettings::opacity`].
const OPACITY: f64 = 0.5;
/// What appears may have Gaussians beyond the number of the first frame, up to this factor on it.
const ROOM: f64 = 1.25;

/// Steps until all stages are done. Returns whether they are: a stop was requested otherwise.
///
/// Errors: a number that is not finite; those of training.
pub(super) fn drive(
    trainer: &mut Trainer<'_>,
    name: &str,
    stop: &AtomicBool,
    listen: &mut dyn FnMut(&Event),
) -> Result<bool> {
    let (steps, mut reported) = (trainer.iterations(), Instant::now());
    let spoilt = |Fault(what, ..): Fault| {
        Error::new(ErrorKind::Diverged, format!("{name} cannot be learnt: {what}"))
            .remedy("Check the images of the frame; lower follow.rates")
    };
    trainer.enter(&mut Progress(listen))?;
    while !trainer.is_done() {
        if stop.load(Ordering::Relaxed) {
            return Ok(false);
        }
        trainer.step()?.map_err(spoilt)?;
        if reported.elapsed() >= REPORT {
            reported = Instant::now();
            listen(&Event::Phase { name: name.to_owned(), done: trainer.progress.iteration, total: steps });
        }
    }
    trainer.settle().map_err(spoilt)?;
    Ok(true)
}

/// A frame that is to be learnt.
pub(super) struct Fit<'a> {
    pub(super) frame: usize,
    pub(super) opened: &'a OpenCapture,
    pub(super) recipe: &'a Recipe,
    pub(super) history: &'a History,
    /// A scene without Gaussians.
    pub(super) shell: &'a Scene<f32>,
    /// Exposures of the cameras, twelve numbers each; empty: none.
    pub(super) exposure: &'a [f32],
    pub(super) errors: &'a TileErrors,
}

impl Fit<'_> {
    /// What the frame changes. `None`: a stop was requested. Errors: as of [`drive`]; an image cannot be read.
    pub(super) fn learn(&self, stop: &AtomicBool, listen: &mut dyn FnMut(&Event)) -> Result<Option<Record>> {
        let follow = &self.recipe.follow;
        let exposure = self.exposure();
        let scene = Scene { layers: vec![self.history.layer.clone()], ..self.shell.clone() };
        let (rise, share) = (follow.changed as f32, follow.share as f32);
        let active = self.compared(&scene, exposure.as_ref()).rows(self.errors, rise, share)?;
        let record = |params, origin, active, scene: &Scene<f32>| {
            let (errors, _) = self.compared(scene, exposure.as_ref()).errors()?;
            let errors = settled(self.errors, errors);
            let (frame, exposure) = (self.frame, Vec::new());
            Ok(Some(Record { frame, active, params, origin, errors, exposure, facts: Value::Null }))
        };
        let coefficients = self.history.coefficients();
        let rows = scene.len();
        let extent = self.opened.plan(&frame_recipe(self.recipe, rows)).extent;
        let mut moved_on = self.split(&active, extent, exposure.as_ref())?;
        let seeds = self.appeared(&moved_on, exposure.as_ref(), rise)?;
        // What appears may hide an empty background alone.
        if active.is_empty() && seeds.points.is_empty() {
            return record(Params::new(0, coefficients, &[]), Vec::new(), active, &scene);
        }
        let recipe = frame_recipe(self.recipe, rows + seeds.len());
        let plan = self.opened.plan(&recipe);
        let layer = &mut moved_on.layers[0];
        *layer = still(self.learning(&layer.params, &self.begun(&recipe, &plan, &seeds)?)?);
        let mut stage = still_method::stage(&format!("frame {}", self.frame), &plan);
        stage.freeze_exposure = true;
        // The first frame has unlocked all degrees.
        stage.sh_interval = 0;
        for group in &mut stage.groups {
            group.rate.start *= follow.rates;
            group.rate.end *= follow.rates;
        }
        let mut trainer = self.opened.trainer_of(&plan, moved_on, vec![stage]);
        trainer.train_state.exposure = self.exposure();
        if !drive(&mut trainer, &format!("frame {}", self.frame), stop, listen)? {
            return Ok(None);
        }
        let scene = trainer.train_state.into_scene();
        let learnt = &scene.layers[0].params;
        let key = learnt.find(ORIGIN.0).expect("the table was added before training");
        let origin = (0..learnt.len()).map(|row| learnt[key].get(row, 0) as u32).collect();
        let rows: Vec<u32> = (0..learnt.len() as u32).collect();
        record(gathered(&[(learnt, &rows)], coefficients), origin, active, &scene)
    }

    fn compared<'a>(&'a self, scene: &'a Scene<f32>, exposure: Option<&'a Exposure>) -> Comparison<'a> {
        let OpenCapture { capture, frames, .. } = self.opened;
        Comparison { scene, capture, frames, numbers: &capture.train, exposure }
    }

    fn exposure(&self) -> Option<Exposure> {
        restored(self.exposure, self.opened.capture.cameras.len())
    }

    /// Points of what appeared and is not in a scene.
    fn appeared(&self, scene: &Scene<f32>, exposure: Option<&Exposure>, rise: f32) -> Result<Seeds> {
        let views = self.compared(scene, exposure).new_here(self.errors, rise)?;
        let pixels: usize = views.iter().map(|v| v.wanted.iter().filter(|w| **w).count()).sum();
        let most = (ROOM * self.recipe.densify.max_cap as f64) as usize;
        let count = (PER_PIXEL * pixels as f64 / views.len().max(1) as f64) as usize;
        let volume = init::volume::common(self.opened.frames.as_ref());
        let rng = Rng::new(self.recipe.run.seed, "appeared", self.frame as u64);
        hull::carve_views(views, &volume, count.min(most.saturating_sub(scene.len())), rng)
    }

    /// The Gaussians that points begin as.
    fn begun(&self, recipe: &Recipe, plan: &TrainContext, seeds: &Seeds) -> Result<Params<f32>> {
        let settings = InitSettings { opacity: OPACITY, ..recipe.init.clone() };
        let program = recipe.program()?;
        let scene = init::scene(plan, &settings, program.as_ref(), seeds, self.shell.background, self.shell.up)?;
        Ok(scene.layers.into_iter().next().expect("a scene has a layer").params)
    }

    /// Active Gaussians and new ones, with the place of each among the active ones.
    fn learning(&self, active: &Params<f32>, new: &Params<f32>) -> Result<Params<f32>> {
        let [known, rows] = [active.len() as u32, (active.len() + new.len()) as u32];
        let (old, fresh): (Vec<u32>, Vec<u32>) = ((0..known).collect(), (0..rows - known).collect());
        let mut own = gathered(&[(active, &old), (new, &fresh)], self.history.coefficients());
        let key = own.entry(ORIGIN.0, Space::Gaussians, &[(ORIGIN.1, 1)], rows as usize, |_| {})?;
        let origin = |row: u32| if row < known { row } else { NEW };
        (0..rows).for_each(|row| own[key].set(row as usize, 0, origin(row) as f32));
        own.info_mut(key).trainable = false;
        Ok(own)
    }

    /// The active Gaussians in a layer that learns, moved on as they moved if that fits the images better, and all
    /// others in one that does not.
    fn split(&self, active: &[u32], extent: f64, exposure: Option<&Exposure>) -> Result<Scene<f32>> {
        let (all, coefficients) = (&self.history.layer.params, self.history.coefficients());
        let mut is_active = vec![false; all.len()];
        active.iter().for_each(|&r| is_active[r as usize] = true);
        let rest: Vec<u32> = (0..all.len() as u32).filter(|&r| !is_active[r as usize]).collect();
        let own = gathered(&[(all, active)], coefficients);
        let mut others = gathered(&[(all, &rest)], coefficients);
        for key in others.keys().collect::<Vec<_>>() {
            others.info_mut(key).trainable = false;
        }
        let mut layers = vec![still(own)];
        if !rest.is_empty() {
            layers.push(splat4d::layers::Layer { name: "unchanged".into(), ..still(others) });
        }
        let there = Scene { layers, ..self.shell.clone() };
        let cap = (VELOCITY_CAP * extent) as f32;
        let moved: Vec<_> = active.iter().map(|&r| self.history.extrapolated(r as usize, cap)).enumerate().collect();
        if moved.iter().all(|(_, pose)| pose.is_none()) {
            return Ok(there);
        }
        let mut on = there.clone();
        for (row, pose) in moved.into_iter().filter_map(|(row, pose)| Some((row, pose?))) {
            on.layers[0].params[GEOMETRY].write(row, 0, pose);
        }
        let [stays, goes] = [&there, &on].map(|scene| self.compared(scene, exposure).error(LOOKS));
        Ok(if goes? < stays? { on } else { there })
    }
}

/// The mean PSNR of a frame's held-out views, dB; none: it has none.
pub(super) fn held_out(opened: &OpenCapture, history: &History, shell: &Scene<f32>) -> Result<Option<f64>> {
    let (capture, numbers) = (&opened.capture, &opened.capture.held);
    let held = Dataset::new(opened.frames.store().clone(), numbers.clone());
    let scene = Scene { layers: vec![history.layer.clone()], ..shell.clone() };
    Ok(Comparison { scene: &scene, capture, frames: &held, numbers, exposure: None }.errors()?.1)
}

/// Exposures as twelve numbers a camera; none: none was learnt.
pub(super) fn restored(rows: &[f32], cameras: usize) -> Option<Exposure> {
    (rows.len() == cameras * crate::train_state::EXPOSURE_COLUMNS && !rows.is_empty()).then(|| {
        let mut exposure = Exposure::new(cameras, Vec::new());
        let key = exposure.key();
        exposure.params[key].column_from_rows(0, crate::train_state::EXPOSURE_COLUMNS, rows);
        exposure
    })
}

/// The recipe of the first frame: a static scene.
pub(super) fn first_recipe(recipe: &Recipe) -> Recipe {
    recipe.unresolved().with(|r| {
        r.run.motion = crate::recipe::MotionName::of(still_method::NAME);
        r.run.iterations = r.follow.first_steps;
    })
}

/// The recipe of a later frame, of a scene of `rows` Gaussians.
fn frame_recipe(recipe: &Recipe, rows: usize) -> Recipe {
    let growth = ((recipe.follow.growth * rows as f64) as usize).max(LEAST_GROWTH);
    let short = first_recipe(recipe).with(|r| {
        r.run.iterations = r.follow.frame_steps;
        r.run.half_size_until = 0.0;
        // Rates of positions depend on the largest number, which is that of the first frame. More for later frames (25 %)
        // were spread over what moves and gained nothing where an object appears.
        r.densify.max_cap = (rows + growth).min(r.densify.max_cap.max(rows));
        r.floaters.interval = 0;
        r.opacity_reset.interval = 0;
    });
    short.resolve()
}

/// The record of the first frame's scene.
pub(super) fn first_record(
    frame: usize,
    scene: &Scene<f32>,
    exposure: Option<&Exposure>,
    errors: TileErrors,
) -> Record {
    let params = &scene.layers[0].params;
    let rows: Vec<u32> = (0..params.len() as u32).collect();
    let coefficients = params[splat4d::scene::SH].width() / 3;
    let exposure = exposure.map(|e| {
        let table = &e.params[e.key()];
        table.column_to_rows(0, table.width())
    });
    Record {
        frame,
        active: Vec::new(),
        params: gathered(&[(params, &rows)], coefficients),
        origin: vec![NEW; rows.len()],
        errors,
        exposure: exposure.unwrap_or_default(),
        facts: Value::Null,
    }
}
