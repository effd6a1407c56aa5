//! Runs that start from a scene instead of points: a list of stages with the same checkpoints and rollbacks as
//! training.

#[cfg(test)]
mod tests;

use super::budget::Budget;
use super::checkpoint;
use super::dataset::Dataset;
use super::identity::identity;
use super::info::read_text;
use super::memory::memory_estimate;
use super::open::OpenCapture;
use super::session::{Outcome, Session, TrainOptions};
use crate::event::Event;
use crate::methods::Stage;
use crate::recipe::Recipe;
use crate::step::replans::ScheduleChanges;
use crate::train_state::Exposure;
use crate::{Error, Result};
use splat4d::layers::Scene;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// A refinement of a scene.
pub(crate) struct Refine {
    /// The verb that requests it: run.json names it, and errors suggest to continue with it.
    pub made_by: String,
    /// The scene before the first stage.
    pub scene: Scene<f32>,
    /// The stages, in order. Their hooks may replace the scene.
    pub stages: Vec<Stage>,
    /// The frames that the scene is compared with (`training_frames`).
    pub frames: Arc<Dataset>,
    /// Losses, background, SH degree, seed, thresholds, steps between checkpoints. Its motion model and its iterations
    /// do not count: the scene and the stages have theirs.
    pub recipe: Recipe,
    /// Exposures of the cameras; none: they show what is rendered, unless the recipe lets them learn.
    pub exposure: Option<Exposure>,
    /// All else that the result depends on, as text: settings and a fingerprint of the scene. A run is only continued
    /// with the same.
    pub identity: String,
    /// The time that it is to keep to.
    pub budget: Option<Budget>,
}

/// The result of a refinement.
#[derive(Debug)]
pub(crate) struct Refined {
    /// End of the run.
    pub outcome: Outcome,
    /// The scene that learns. If the last stage has a codec, the decoded scene differs: it is in the run's
    /// `scene.safetensors`.
    pub scene: Scene<f32>,
}

/// Begins the run in the folder `run`, or continues it, exactly, where that holds one.
///
/// A stage's start is not run again once a checkpoint holds a step of the stage: what codecs, losses and layers store
/// is read from the checkpoint. Errors: the folder holds another run; what stages and files may say.
pub(crate) fn refine(
    job: Refine,
    run: &Path,
    options: &TrainOptions,
    stop: &AtomicBool,
    listen: &mut dyn FnMut(&Event),
) -> Result<Refined> {
    job.recipe.check()?;
    if job.stages.is_empty() {
        return Err(Error::input("there is no stage to run").remedy("Request at least one step"));
    }
    let total: usize = job.stages.iter().map(|s| s.iterations).sum();
    let begun = !checkpoint::list(run).is_empty();
    // The plan of this run, not that of the run that produced the scene.
    let replans = if begun { followed(run)? } else { ScheduleChanges::default() };
    let recipe = job
        .recipe
        .with(|r| {
            r.run.iterations = total.max(1);
            r.run.replans = replans;
        })
        .resolve();
    let opened = OpenCapture::with(job.frames).on(options.device);
    let plan = opened.plan(&recipe);
    let held = recipe.clone().with(|r| r.densify.max_cap = job.scene.len().max(1));
    let mut session = Session {
        run,
        opened: &opened,
        recipe: &recipe,
        identity: identity(&opened.capture, &recipe, &format!("\n{}\n{}", job.made_by, job.identity)),
        made_by: &job.made_by,
        estimate: memory_estimate(&opened.capture, &held),
        snapshots: options.snapshots,
        clock: options.clock.clone(),
        budget: job.budget,
        own_loss: false,
        stop,
    };
    let mut trainer = opened.trainer_of(&plan, job.scene, job.stages);
    trainer.replan(recipe.run.replans.rows());
    if job.exposure.is_some() {
        trainer.train_state.exposure = job.exposure;
    }
    let state = if begun {
        let state = session.restore(&mut trainer, listen)?;
        // The budget is that of this command: earlier training does not count.
        let before = options.clock.seconds() - state.seconds;
        session.budget = session.budget.map(|b| Budget { before, ..b });
        state
    } else {
        trainer.check_not_empty()?;
        session.begin(&trainer, listen)?
    };
    let outcome = session.drive(&mut trainer, state, listen)?;
    Ok(Refined { outcome, scene: trainer.train_state.into_scene() })
}

/// The changes of plan that a run in a folder has followed. Errors: its recipe cannot be read.
fn followed(run: &Path) -> Result<ScheduleChanges> {
    let file = run.join("recipe.toml");
    Ok(Recipe::from_toml(&read_text(&file)?).map_err(|e| e.at(file.display()))?.run.replans)
}
