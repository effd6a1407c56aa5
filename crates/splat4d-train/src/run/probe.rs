//! Reads checkpoints without a run, whatever their bytes: for tests of damaged files.

use super::checkpoint::{self, Identity, RunState};
use super::identity::identity;
use super::open::OpenCapture;
use crate::Result;
use crate::capture::Capture;
use crate::event::Progress;
use crate::recipe::Recipe;
use crate::step::trainer::Trainer;
use std::sync::Arc;

/// A capture, opened for training as a recipe specifies.
pub struct Probe {
    trainer: Trainer<'static>,
    identity: Identity,
}

impl Probe {
    /// Opens it. Errors: those of training's start.
    pub fn new(capture: Arc<Capture>, recipe: &Recipe) -> Result<Self> {
        let recipe = recipe.resolve();
        let identity = identity(&capture, &recipe, "");
        let opened = OpenCapture::new(capture, &recipe)?;
        let plan = opened.plan(&recipe);
        let trainer = opened.trainer(&recipe, &plan, opened.initial_scene(&recipe, &plan)?)?;
        Ok(Self { trainer, identity })
    }

    /// A checkpoint as training writes it.
    pub fn checkpoint(&self) -> Result<Vec<u8>> {
        checkpoint::write(&self.trainer, &self.identity, &RunState::default())
    }

    /// Reads a checkpoint and takes a step from there, as `train --resume` does. Errors: it is damaged, or of something
    /// else.
    pub fn resume(&mut self, bytes: &[u8]) -> Result<()> {
        checkpoint::read(bytes, &mut self.trainer, &self.identity)?;
        self.trainer.enter(&mut Progress(&mut |_| {}))?;
        if !self.trainer.is_done() {
            // Values that are not finite are a fault of the step, which rolls back.
            drop(self.trainer.step()?);
        }
        Ok(())
    }
}
