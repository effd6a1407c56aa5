//! Compression: removes the least important Gaussians of a trained scene, writes it as a playback file, and fine-tunes
//! it through that file's quantisation.
//!
//! 1. Rounds of pruning in floats, each followed by fine-tuning with the model's own losses (4DGS-1K, Yuan et
//!    al. 2025).
//! 2. The scene is baked and written, and the decoded file replaces it: a layer per page, rows in the file's order,
//!    from any model. Masks state which Gaussians the training views show around which key time.
//! 3. Fine-tuning through the file's codes: renders show the decoded file, gradients go to the values before rounding
//!    (straight-through). The final file equals the last render's scene, bit for bit.
//!
//! It is a run like any other: [`compress`] starts it or continues it exactly.

mod fit;
pub(crate) mod quantise;
mod settings;
mod stages;
#[cfg(test)]
mod tests;

pub use fit::{Trial, fit};
pub use settings::{Compression, Level, MOST_PRUNED};

use crate::capture::Capture;
use crate::event::Event;
use crate::maintenance::Strategy;
use crate::maintenance::importance::{Scores, score};
use crate::recipe::Recipe;
use crate::run::{Outcome, TrainOptions, corrected};
use crate::run::{Refine, refine};
use crate::run::{plan, training_frames};
use crate::train_state::Exposure;
use crate::{Error, Result};
use splat4d::bake::{self, bake};
use splat4d::format::playback::{Draft, Meta, Pages, feature_ranges};
use splat4d::layers::Scene;
use splat4d::scene::Camera;
use stages::Prepared;
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// The verb that makes and continues such runs.
pub(crate) const VERB: &str = "compress";

/// The inputs of a compression.
#[derive(Clone)]
pub struct Job<'a> {
    /// A trained scene.
    pub source: &'a Scene<f32>,
    /// The capture it was trained on, its cameras where the training has moved them ([`corrected::apply`]).
    pub capture: Arc<Capture>,
    /// Record of its training.
    pub recipe: &'a Recipe,
    /// The settings of compression.
    pub settings: &'a Compression,
    /// The run that learnt the scene: its corrections of cameras are handed on, and its exposures of photos are learnt on. `None`: there are
    /// no corrections, and exposures begin from the identity.
    pub run: Option<&'a Path>,
}

/// The result of a compression.
#[derive(Debug)]
pub struct Compressed {
    /// End of the run.
    pub outcome: Outcome,
    /// The file to write, once the last step is done; none where the settings have no codec.
    pub pages: Option<Pages>,
}

/// Compresses into the run folder `dir`, or continues there. The folder's `scene.safetensors` is what a reader of the
/// file decodes; with a codec, `removed-K.safetensors` has the Gaussians that round K of pruning removed,
/// as they were then.
///
/// Errors: settings out of range, a capture without training views, a folder that holds another run, a scene that
/// cannot be baked.
pub fn compress(
    job: &Job<'_>,
    dir: &Path,
    options: &TrainOptions,
    stop: &AtomicBool,
    listen: &mut dyn FnMut(&Event),
) -> Result<Compressed> {
    job.settings.check()?;
    let prepared = Prepared { dir: job.settings.codec.then(|| dir.to_owned()), ..prepared(job)? };
    let mut stages = stages::float_stages(&prepared)?;
    let file = job.settings.codec.then(|| stages::file_stage(&prepared)).transpose()?;
    let (stage, codec) = file.unzip();
    stages.extend(stage);
    if stages.is_empty() {
        return Err(Error::input("no operation is selected").remedy("Prune, filter or quantise."));
    }
    let exposures = job.run.map(|run| corrected::exposures(&job.capture, run)).transpose()?.unwrap_or_default();
    let exposure = (!exposures.is_empty()).then(|| Exposure::learnt(&job.capture, &exposures));
    let refined = refine(
        Refine {
            made_by: VERB.into(),
            scene: job.source.clone(),
            stages,
            frames: training_frames(job.capture.clone(), job.recipe)?,
            recipe: job.recipe.clone().with(|r| r.densify.strategy = Strategy::None),
            exposure,
            identity: job.settings.to_toml(),
            budget: None,
        },
        dir,
        options,
        stop,
        listen,
    )?;
    if let Some(run) = job.run {
        corrected::inherit(dir, run)?;
    }
    let done = !refined.outcome.interrupted;
    let pages = codec.filter(|_| done).map(|codec| codec.pages(&refined.scene, meta(&refined.scene))).transpose()?;
    Ok(Compressed { outcome: refined.outcome, pages })
}

/// Scores all Gaussians of the job's scene, for [`fit`].
pub fn scores(job: &Job<'_>, progress: &mut dyn FnMut(usize, usize)) -> Result<Scores> {
    let prepared = prepared(job)?;
    score(job.source, prepared.frames.as_ref(), &prepared.score_config()?, progress)
}

fn prepared(job: &Job<'_>) -> Result<Prepared> {
    job.source.without_head("a playback file")?;
    let frames = training_frames(job.capture.clone(), job.recipe)?;
    Ok(Prepared {
        frames,
        plan: plan(&job.capture, job.recipe),
        recipe: job.recipe.clone(),
        cameras: cameras(&job.capture),
        settings: job.settings.clone(),
        count: job.source.len(),
        dir: None,
    })
}

/// The cameras of the training views, each once: whose pixels baking counts.
pub fn cameras(capture: &Capture) -> Vec<Camera> {
    let mut seen = BTreeSet::new();
    let views = capture.train.iter().map(|&i| &capture.frames[i]);
    views.filter(|f| seen.insert(f.camera)).map(|f| f.view.clone()).collect()
}

/// The scene as a file's draft. Progress: Gaussians done and in all.
fn draft(
    scene: &Scene<f32>,
    settings: &Compression,
    cameras: &[Camera],
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Draft> {
    let options = bake::Options { cameras: cameras.to_vec(), ..bake::Options::default() };
    let baked = bake(scene, &options, progress)?;
    let meta = Meta { clip: baked.clip, sh_degree: baked.sh_degree.min(settings.sh_degree), ..meta(scene) };
    Ok(Draft { meta, nodes: baked.nodes, poster: None })
}

/// The scene's own metadata.
fn meta(scene: &Scene<f32>) -> Meta {
    let Scene { clip, fps, up, offset, background, .. } = *scene;
    let (labels, features) = (scene.labels.clone(), feature_ranges(scene));
    Meta { clip, fps, up, offset, background, labels, features, ..Meta::default() }
}
