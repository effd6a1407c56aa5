//! The stages of a compression: rounds of pruning in floats, then the file itself.

use super::quantise::{self, Quantised, palette_rate};
use super::{Compression, draft};
use crate::Result;
use crate::capture::frames::Frames;

use crate::event::Progress;
use crate::loss::scene::MeanOpacity;
use crate::loss::terms::ParamLoss;
use crate::maintenance::importance::{MaskConfig, ScoreConfig, key_masks, prune, score};
use crate::methods::{Hook, Rate, Stage, TrainContext, tuning};
use crate::output::write_atomically_with;
use crate::recipe::Recipe;
use splat4d::format::playback::{WriteConfig, read_pages, write};
use splat4d::format::scene as scene_file;
use splat4d::layers::Scene;
use splat4d::math::Rng;
use splat4d::render::Antialias;
use splat4d::scene::{Camera, RowEdit};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Fine-tuning begins where a run's rates were after this share of it: the remaining Gaussians are already in position.
const REWIND: f64 = 0.8;
/// Rates that training keeps constant fall to this share of themselves, so that the scene converges.
const REST: f64 = 0.1;
/// Rates of fine-tuning through the file, of those with which training ended.
const FILE_RATES: f64 = 0.5;

/// All that hooks need next to the scene; they outlive the call that makes them.
#[derive(Clone)]
pub(super) struct Prepared {
    pub frames: Arc<dyn Frames>,
    pub plan: TrainContext,
    pub recipe: Recipe,
    pub cameras: Vec<Camera>,
    pub settings: Compression,
    /// Gaussians of the scene that is compressed.
    pub(super) count: usize,
    /// The run's folder, where what is removed is kept, a scene per round; `None`: nowhere.
    pub(super) dir: Option<PathBuf>,
}

impl Prepared {
    fn antialias(&self) -> Antialias {
        if self.plan.common.appearance.antialias { Antialias::On } else { Antialias::Off }
    }

    /// Scoring by the settings. Errors: unknown names.
    pub(super) fn score_config(&self) -> Result<ScoreConfig> {
        let s = &self.settings;
        Ok(ScoreConfig {
            spatial: s.spatial.parse()?,
            temporal: s.temporal.parse()?,
            combine: s.combine.parse()?,
            volume: s.volume,
            cost: s.cost,
            every: s.every,
            antialias: self.antialias(),
            ..ScoreConfig::default()
        })
    }
}

/// Rounds of pruning and fine-tuning in floats; none where there is nothing to do.
pub(super) fn float_stages(prepared: &Prepared) -> Result<Vec<Stage>> {
    let s = &prepared.settings;
    let filter = !s.codec && s.mask_interval > 0;
    if s.prune == 0.0 && s.fine_tune == 0 && !filter {
        return Ok(Vec::new());
    }
    let rounds = s.pruning_rounds();
    (0..rounds)
        .map(|round| {
            let steps = s.fine_tune * (round + 1) / rounds - s.fine_tune * round / rounds;
            let mut stage = host_stage(prepared, steps)?;
            stage.name = format!("pruned {}/{rounds}", round + 1);
            // Equal shares of what is left; the last round leaves the requested number.
            let last = round + 1 == rounds;
            let left = (1.0 - s.prune).powf((round + 1) as f64 / rounds as f64);
            let removed = if last { s.prune } else { 1.0 - left };
            let keep = prepared.count - (removed * prepared.count as f64).round() as usize;
            let removed = prepared.dir.as_ref().map(|dir| dir.join(format!("removed-{}.safetensors", round + 1)));
            stage.start = Some(pruning(prepared.clone(), keep.max(1), filter && last, removed));
            Ok(stage)
        })
        .collect()
}

/// The stage that the model learns by, at rates that settle.
fn host_stage(prepared: &Prepared, steps: usize) -> Result<Stage> {
    let mut stage = tuning(prepared.recipe.program()?.as_ref(), &prepared.plan);
    stage.iterations = steps;
    stage.groups.iter_mut().for_each(|g| g.rate = settling(g.rate, prepared.settings.first_rates()));
    stage.params.extend(fading(&prepared.settings));
    Ok(stage)
}

/// A rate of training, converted for fine-tuning.
fn settling(rate: Rate, share: f64) -> Rate {
    let start = share * rate.at(REWIND);
    Rate { start, end: (share * rate.end).min(start * REST) }
}

/// The loss that lets Gaussians fade that no view needs.
fn fading(settings: &Compression) -> Option<Box<dyn ParamLoss<f32>>> {
    let weight = settings.opacity_reg;
    (weight > 0.0).then(|| Box::new(MeanOpacity { weight }) as Box<dyn ParamLoss<f32>>)
}

/// Scores, prunes to `keep` Gaussians, and makes masks where they are needed already. What is removed becomes the file
/// `removed`.
fn pruning(prepared: Prepared, keep: usize, filter: bool, removed: Option<PathBuf>) -> Hook {
    Box::new(move |scene: &mut Scene<f32>, progress| {
        if keep < scene.len() {
            let share = 1.0 - keep as f64 / scene.len() as f64;
            let scores = score(scene, prepared.frames.as_ref(), &prepared.score_config()?, &mut |done, total| {
                progress.phase("scoring Gaussians", done, total);
            })?;
            let edits = prune(scene, &scores, share);
            if let Some(file) = &removed {
                write_removed(scene, &edits, file)?;
            }
            for (layer, edit) in edits.into_iter().enumerate() {
                scene.layers[layer].edit(&edit, &Rng::new(prepared.plan.seed, "prune", layer as u64));
            }
        }
        if filter { masks(scene, &prepared, progress) } else { Ok(()) }
    })
}

/// The scene of the rows that these edits drop.
fn write_removed(scene: &Scene<f32>, edits: &[RowEdit], file: &Path) -> Result<()> {
    let mut removed = scene.clone();
    for (layer, edit) in removed.layers.iter_mut().zip(edits) {
        let mut dropped = vec![true; layer.params.len()];
        edit.parent.iter().for_each(|row| dropped[*row as usize] = false);
        layer.edit(&RowEdit::prune(edit.space, dropped.into_iter()), &Rng::new(0, "removed", 0));
    }
    removed.layers.retain(|layer| !layer.params.is_empty());
    write_atomically_with(file, &mut |out| scene_file::write(&removed, &mut &mut *out))
}

/// Masks at the settings' interval.
fn masks(scene: &mut Scene<f32>, prepared: &Prepared, progress: &mut Progress<'_>) -> Result<()> {
    let config = MaskConfig { interval: prepared.settings.mask_interval, antialias: prepared.antialias() };
    key_masks(scene, prepared.frames.as_ref(), &config, &mut |done, total| {
        progress.phase("searching visible Gaussians", done, total);
    })
}

/// Fine-tuning through the file, and the codec that is it.
pub(super) fn file_stage(prepared: &Prepared) -> Result<(Stage, Arc<Quantised>)> {
    let s = &prepared.settings;
    let codec = Quantised::new(s.depths, palette_rate(&prepared.plan.common.rates, FILE_RATES * s.first_rates()))?;
    let mut stage =
        quantise::stage(&prepared.recipe, &prepared.plan, s.quantise, FILE_RATES * s.first_rates(), codec.clone());
    stage.params.extend(fading(s));
    let (own, begun) = (prepared.clone(), codec.clone());
    stage.start = Some(Box::new(move |scene: &mut Scene<f32>, progress| {
        let draft = draft(scene, &own.settings, &own.cameras, &mut |done, total| {
            progress.phase("baking", done, total);
        })?;
        let s = &own.settings;
        let seed = own.plan.seed;
        let config = WriteConfig { depths: s.depths, palette: s.palette, seed, ..WriteConfig::default() };
        let mut bytes = Vec::new();
        write(&draft, &config, &mut bytes)?;
        begun.begin(read_pages(&bytes)?, scene);
        if s.mask_interval > 0 { masks(scene, &own, progress) } else { Ok(()) }
    }));
    Ok((stage, codec))
}
