//! Short training in memory, on the tiny capture of the tests of runs.

use crate::init::{self, Seeds};
use crate::maintenance::Change;
use crate::recipe::Recipe;
use crate::run::checkpoint::{self, Identity, RunState};
use crate::run::dataset::Dataset;
use crate::run::tests::{Place, recipe};
use crate::run::{OpenCapture, training_frames};
use crate::step::trainer::Trainer;
use splat4d::device::Device;
use splat4d::format::scene;
use splat4d::layers::{Evaluation, Scene};
use splat4d::scene::{Rows, Space, Time};
use std::sync::Arc;

/// A capture and its decoded images.
pub(super) struct Bed {
    _place: Place,
    frames: Arc<Dataset>,
}

/// The background: on the images' mean colour, the default, little of their error is there to begin with.
const BLACK: [f32; 3] = [0.0; 3];

/// The result of a short training.
pub(super) struct Ran {
    pub(super) trainer: Trainer<'static>,
    /// Mean squared error of every step.
    pub(super) mse: Vec<f64>,
    /// Rows born, moved and removed in all.
    pub(super) change: Change,
    /// Gaussians after every step.
    pub(super) rows: Vec<usize>,
}

impl Ran {
    /// Mean squared error of the last steps, of that of the first.
    pub(super) fn left(&self) -> f64 {
        const FEW: usize = 8;
        let sum = |x: &[f64]| x.iter().sum::<f64>();
        sum(&self.mse[self.mse.len() - FEW..]) / sum(&self.mse[..FEW])
    }

    pub(super) fn scene(&self) -> &Scene<f32> {
        self.trainer.scene()
    }

    /// Nodes of the first layer.
    pub(super) fn nodes(&self) -> usize {
        self.scene().layers[0].params.rows_of(Space::Nodes)
    }
}

/// The recipe with the changes in a line of `key=value`.
pub(super) fn settings(line: &str) -> Recipe {
    let changes: Vec<&str> = ["densify_grad_threshold=1e-5"].into_iter().chain(line.split_whitespace()).collect();
    recipe(&changes).resolve()
}

/// A scene as its file.
pub(super) fn bytes(scene: &Scene<f32>) -> Vec<u8> {
    let mut out = Vec::new();
    scene::write(scene, &mut out).unwrap();
    out
}

/// Positions of a layer's Gaussians or nodes at a time.
pub(super) fn places(scene: &Scene<f32>, layer: usize, of: Space, t: f64) -> Vec<[f32; 3]> {
    let layer = &scene.layers[layer];
    let seen = Evaluation::of_layer(layer, of, Rows::All, Time(t));
    let out = seen.tape(0).out();
    (0..out.rows()).map(|r| out.read(r, 0)).collect()
}

impl Bed {
    pub(super) fn new() -> Self {
        let place = Place::new();
        let base = recipe(&[]);
        let frames = training_frames(place.open(&base), &base).unwrap();
        Self { _place: place, frames }
    }

    /// The training frames.
    #[cfg(feature = "gpu")]
    pub(super) fn frames(&self) -> Arc<Dataset> {
        self.frames.clone()
    }

    /// A run that has not begun.
    pub(super) fn start(&self, recipe: &Recipe) -> Trainer<'static> {
        self.start_on(Device::Cpu, recipe)
    }

    /// The same, rendered by another device.
    pub(super) fn start_on(&self, device: Device, recipe: &Recipe) -> Trainer<'static> {
        let opened = OpenCapture::with(self.frames.clone()).on(device);
        let plan = opened.plan(recipe);
        recipe.program().unwrap().check(&plan).unwrap();
        let scene = Scene { background: BLACK, ..opened.initial_scene(recipe, &plan).unwrap() };
        opened.trainer(recipe, &plan, scene).unwrap()
    }

    /// As a resume does: an empty scene, and everything from the checkpoint.
    pub(super) fn resumed(&self, recipe: &Recipe, checkpoint: &[u8]) -> Trainer<'static> {
        self.resumed_on(Device::Cpu, recipe, checkpoint)
    }

    /// The same, rendered by another device.
    pub(super) fn resumed_on(&self, device: Device, recipe: &Recipe, checkpoint: &[u8]) -> Trainer<'static> {
        let opened = OpenCapture::with(self.frames.clone()).on(device);
        let plan = opened.plan(recipe);
        let program = recipe.program().unwrap();
        let empty =
            init::scene(&plan, &recipe.init, program.as_ref(), &Seeds::default(), BLACK, [0.0, 1.0, 0.0]).unwrap();
        let mut trainer = opened.trainer(recipe, &plan, empty).unwrap();
        checkpoint::read(checkpoint, &mut trainer, &Identity::default()).unwrap();
        trainer
    }

    /// Trains to the end, and calls `look` after every step.
    pub(super) fn watch(&self, line: &str, mut look: impl FnMut(&Trainer<'static>, Change)) -> Ran {
        let mut trainer = self.start(&settings(line));
        let (mut mse, mut rows, mut change) = (Vec::new(), Vec::new(), Change::default());
        while !trainer.is_done() {
            let step = trainer.step().unwrap().unwrap_or_else(|fault| panic!("{line}: {}", fault.0));
            look(&trainer, step.change);
            mse.push(step.measured[0].mse);
            rows.push(trainer.scene().len());
            change.added += step.change.added;
            change.moved += step.change.moved;
            change.removed += step.change.removed;
        }
        Ran { trainer, mse, change, rows }
    }

    pub(super) fn run(&self, line: &str) -> Ran {
        self.watch(line, |_, _| {})
    }
}

/// A checkpoint of a trainer.
pub(super) fn saved(trainer: &Trainer<'_>) -> Vec<u8> {
    checkpoint::write(trainer, &Identity::default(), &RunState::default()).unwrap()
}
