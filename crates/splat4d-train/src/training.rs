//! Training from a program: a capture becomes a run folder, and the run is measured, in a few calls. The command's
//! verbs `train` and `eval` use the same functions of [`train`](crate::run) and [`eval`](crate::eval).

use crate::Result;
use crate::capture::{Capture, ImageStore};
use crate::eval::run::{EvalOptions, Scores, evaluate};
use crate::event::Event;
use crate::recipe::Recipe;
use crate::run::open_capture;
use crate::run::{Outcome, TrainOptions, train, with_found};
use splat4d::format;
use splat4d::layers::Scene;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// A training run before it starts.
pub struct Training<'a> {
    capture: Arc<Capture>,
    recipe: Recipe,
    options: TrainOptions,
    listen: Box<dyn FnMut(&Event) + 'a>,
    stop: Option<&'a AtomicBool>,
}

impl<'a> Training<'a> {
    /// Opens a capture (a folder or its marker file) as the recipe states: scale, split, frames.
    ///
    /// Errors: the folder is not a capture; files that are missing or broken; a recipe out of range.
    pub fn open(capture: impl AsRef<Path>, recipe: Recipe) -> Result<Self> {
        recipe.check()?;
        let capture = Arc::new(open_capture(capture.as_ref(), &recipe)?);
        Ok(Self { capture, recipe, options: TrainOptions::default(), listen: Box::new(|_| {}), stop: None })
    }

    /// Keeps training to this many minutes from its opening, on a machine that turns slower or faster as well.
    #[must_use]
    pub fn minutes(mut self, minutes: f64) -> Self {
        self.options.minutes = Some(minutes);
        self
    }

    /// Calls `listen` with every event: progress, checkpoints, warnings.
    #[must_use]
    pub fn listen(mut self, listen: impl FnMut(&Event) + 'a) -> Self {
        self.listen = Box::new(listen);
        self
    }

    /// Stops after the step in which `flag` becomes true; the run can then be resumed.
    #[must_use]
    pub fn stop_at(mut self, flag: &'a AtomicBool) -> Self {
        self.stop = Some(flag);
        self
    }

    /// Trains into the folder `run`.
    ///
    /// Errors: the folder holds a run already; the model does not suit the capture; training diverged; files.
    pub fn run(mut self, run: impl AsRef<Path>) -> Result<Trained> {
        let never = AtomicBool::new(false);
        let stop = self.stop.unwrap_or(&never);
        let (capture, run) = (self.capture, run.as_ref());
        let antialias = self.recipe.appearance.antialias;
        let outcome = train(capture.clone(), self.recipe.clone(), run, &self.options, stop, &mut self.listen)?;
        let capture = Arc::new(with_found(Capture::clone(&capture), &self.recipe, run)?);
        Ok(Trained { outcome, capture, antialias })
    }
}

/// A run that has been trained, and its capture.
pub struct Trained {
    /// End of the run.
    pub outcome: Outcome,
    capture: Arc<Capture>,
    antialias: bool,
}

impl Trained {
    /// The learnt scene. Errors: the run was stopped before its last step; its file cannot be read.
    pub fn scene(&self) -> Result<Scene<f32>> {
        let path: PathBuf = self.outcome.run.join("scene.safetensors");
        let bytes = crate::files::read_with(&path, "Resume the run to its last step, which writes its scene")?;
        format::scene::read(&bytes).map_err(|e| e.at(path.display()))
    }

    /// Renders the held-out views, compares them with their images and writes `results.json` and `per_view.json`.
    ///
    /// Errors: those of [`scene`](Self::scene); an image that cannot be read.
    pub fn evaluate(&self) -> Result<Scores> {
        let store = Arc::new(ImageStore::new(self.capture.clone(), STORE_BYTES));
        let options = EvalOptions {
            folder: self.outcome.run.clone(),
            antialias: self.antialias,
            pictures: false,
            ..EvalOptions::default()
        };
        let (scene, never) = (self.scene()?, AtomicBool::new(false));
        evaluate(&scene, &self.capture, &store, self.outcome.iteration, &options, &never, &mut |_| {})
    }
}

/// Memory for decoded images while they are measured: each is examined once.
const STORE_BYTES: usize = 64 << 20;
