//! Checkpoints store the whole state: scene, moments, statistics, exposure, corrections of cameras, the state of
//! losses, codecs and maintenance, and the progress of the run. Random numbers and samplers are functions of the step
//! and need no saving. A resumed run equals an uninterrupted one, bit for bit.
//!
//! The file is a scene file with more arrays (`moments.L.TABLE`, `stats.L`, `exposure…`), so that every reader of
//! scenes opens it too.

use crate::optim::Moments;
use crate::step::trainer::{Position, Trainer};
use crate::train_state::{Stats, TrainState};
use crate::{Error, ErrorKind, Result};
use serde_json::{Value, json};
use splat4d::format::safetensors::{self, SafeTensors, Tensor};
use splat4d::format::scene::{self, METADATA};
use splat4d::layers::Layer;
use splat4d::scene::{Key, Params, Table};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

pub use crate::output::{write_atomically, write_atomically_with};

/// Version of the checkpoint's own metadata.
const VERSION: u64 = 3;
/// The metadata's key.
const CHECKPOINT: &str = "splat4d-checkpoint";

/// The capture and recipe of a checkpoint; a run must not continue on another capture or recipe.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Identity {
    /// Fingerprint of the capture: names, sizes, poses, times.
    pub capture: String,
    /// Fingerprint of the recipe.
    pub recipe: String,
}

/// The state of the run that is not the trainer's.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RunState {
    /// Seconds of training. Never affects a result.
    pub seconds: f64,
    /// Smoothed loss, PSNR for progress. Never reach a result.
    pub smooth: [f64; 2],
}

/// A run's checkpoint as bytes.
pub fn write(trainer: &Trainer<'_>, identity: &Identity, state: &RunState) -> Result<Vec<u8>> {
    let mut arrays: Vec<(String, Vec<usize>, Vec<f32>)> =
        scene::arrays(trainer.scene()).into_iter().map(|a| (a.name, a.shape, a.data)).collect();
    let mut push = |name: String, table: &Table<f32>| {
        if table.width() > 0 {
            arrays.push((name, vec![table.rows(), table.width()], table.column_to_rows(0, table.width())));
        }
    };
    for (l, (layer, moments)) in trainer.scene().layers.iter().zip(trainer.train_state.moments()).enumerate() {
        for key in layer.params.keys() {
            // Moments of a page that does not learn have no rows, and are not in the file.
            if moments.table(key).rows() == layer.params[key].rows() {
                push(moments_name(l, &layer.params, key), moments.table(key));
            }
        }
        push(format!("stats.{l}"), &trainer.train_state.stats().tables[l]);
    }
    if let Some(e) = &trainer.train_state.exposure {
        push("exposure".into(), &e.params[e.key()]);
        push("exposure.moments".into(), e.moments.table(e.key()));
    }
    for (name, table) in trainer.train_state.corrections.iter().flat_map(|c| c.tables()) {
        push(name.into(), table);
    }
    let mut memories: Vec<(String, Vec<u32>)> = trainer
        .stages
        .iter()
        .enumerate()
        .flat_map(|(s, stage)| {
            let params = stage.params.iter().enumerate().map(move |(k, l)| (format!("memory.{s}.{k}"), l.state()));
            let probes = stage.probes.iter().enumerate().map(move |(k, l)| (probe_name(s, k), l.state()));
            let maintenance = stage.maintenance.iter().map(move |u| (maintenance_name(s, u.name()), u.state()));
            params.chain(probes).chain(maintenance)
        })
        .filter(|(_, state)| !state.is_empty())
        .collect();
    let codecs = trainer.stages.iter().enumerate().filter_map(|(s, stage)| Some((s, stage.codec.as_ref()?.state())));
    memories.extend(codecs.filter(|(_, state)| !state.is_empty()).map(|(s, state)| (codec_name(s), state)));
    let mut tensors: Vec<Tensor<'_>> =
        arrays.iter().map(|(n, shape, data)| Tensor::f32(n.clone(), shape, data)).collect();
    tensors.extend(scene::masks(trainer.scene()));
    tensors.extend(memories.iter().map(|(n, data)| Tensor::u32(n.clone(), &[data.len()], data)));
    let p = trainer.progress;
    let frozen = |l: &Layer<f32>| -> Vec<String> {
        let infos = l.params.keys().map(|k| l.params.info(k));
        infos.filter(|i| !i.trainable).map(|i| i.name.clone()).collect()
    };
    let meta = json!({
        "frozen": trainer.scene().layers.iter().map(frozen).collect::<Vec<_>>(),
        "version": VERSION,
        "iteration": p.iteration,
        "stage": p.stage,
        "stage_step": p.stage_step,
        "taken": p.taken,
        "rests": p.rests,
        "replans": trainer.replans_before(p.iteration),
        "rate_scale": p.rate_scale,
        "strikes": p.strikes,
        "seconds": state.seconds,
        "smooth": state.smooth,
        "capture": identity.capture,
        "recipe": identity.recipe,
    });
    let metadata = BTreeMap::from([
        (METADATA.to_owned(), scene::metadata(trainer.scene()).to_string()),
        (CHECKPOINT.to_owned(), meta.to_string()),
    ]);
    let mut bytes = Vec::new();
    safetensors::write(&tensors, &metadata, &mut bytes)?;
    Ok(bytes)
}

/// Puts a checkpoint's state into a trainer of the same program. Errors: another version, capture or recipe; damage.
pub fn read(bytes: &[u8], trainer: &mut Trainer<'_>, identity: &Identity) -> Result<RunState> {
    let file = SafeTensors::read(bytes)?;
    let meta = metadata(&file)?;
    for (key, mine, what) in [("capture", &identity.capture, "capture"), ("recipe", &identity.recipe, "recipe")] {
        if meta[key].as_str() != Some(mine) {
            return Err(Error::input(format!("the checkpoint belongs to another {what}"))
                .remedy(format!("Its {what} changed since the run began: put it back, or start a new run with -o")));
        }
    }
    let mut scene = scene::from_tensors(&file)?;
    for (l, layer) in scene.layers.iter_mut().enumerate() {
        for key in layer.params.keys() {
            let info = layer.params.info_mut(key);
            let frozen = meta["frozen"][l].as_array();
            info.trainable = !frozen.is_some_and(|names| names.iter().any(|n| n.as_str() == Some(&info.name)));
        }
    }
    let mut moments = Vec::new();
    let mut stats = Stats::new(&scene);
    for (l, layer) in scene.layers.iter().enumerate() {
        let mut m = Moments::new(&layer.params);
        for key in layer.params.keys().collect::<Vec<Key>>() {
            let name = moments_name(l, &layer.params, key);
            if layer.params.info(key).page.is_none() || file.get(&name).is_some() {
                load(&file, &name, m.table_mut(key))?;
            }
        }
        moments.push(m);
        load(&file, &format!("stats.{l}"), &mut stats.tables[l])?;
    }
    if let Some(e) = &mut trainer.train_state.exposure {
        let key = e.key();
        load(&file, "exposure", &mut e.params[key])?;
        load(&file, "exposure.moments", e.moments.table_mut(key))?;
    }
    for (name, table) in trainer.train_state.corrections.iter_mut().flat_map(|c| c.tables_mut()) {
        load(&file, name, table)?;
    }
    for (s, stage) in trainer.stages.iter_mut().enumerate() {
        for (k, loss) in stage.params.iter().enumerate() {
            match file.get(&format!("memory.{s}.{k}")) {
                Some(t) => loss.restore(&t.as_u32()?),
                None => loss.restore(&[]),
            }
        }
        for (k, loss) in stage.probes.iter().enumerate() {
            let state = file.get(&probe_name(s, k)).map_or_else(|| Ok(Vec::new()), |t| t.as_u32())?;
            loss.restore(&state);
        }
        for operation in &mut stage.maintenance {
            let state =
                file.get(&maintenance_name(s, operation.name())).map_or_else(|| Ok(Vec::new()), |t| t.as_u32())?;
            operation.restore(&state);
        }
        if let Some(codec) = &stage.codec {
            let state = file.get(&codec_name(s)).map_or_else(|| Ok(Vec::new()), |t| t.as_u32())?;
            codec.restore(&state)?;
        }
    }
    let count = |key: &str| {
        let n = meta[key].as_u64().and_then(|n| usize::try_from(n).ok());
        n.ok_or_else(|| damaged(format!("`{key}` is missing")))
    };
    let number = |v: &Value, key: &str| v.as_f64().ok_or_else(|| damaged(format!("`{key}` is missing")));
    let progress = Position {
        iteration: count("iteration")?,
        stage: count("stage")?,
        stage_step: count("stage_step")?,
        // Files from before replanning do not state it: there a step is one of the schedule.
        taken: if meta["taken"].is_null() { count("stage_step")? } else { count("taken")? },
        rests: meta["rests"].as_bool().unwrap_or(false),
        rate_scale: number(&meta["rate_scale"], "rate_scale")?,
        strikes: count("strikes")?,
    };
    let followed = json!(trainer.replans_before(progress.iteration));
    if followed != *meta.get("replans").unwrap_or(&json!([])) {
        // No damage: an older checkpoint, from before the first of them, would continue as if nothing were wrong.
        let what = "the checkpoint followed other changes of plan than those in `run.replans` of recipe.toml";
        return Err(Error::new(ErrorKind::Unsupported, what)
            .remedy("Put recipe.toml back as the run wrote it, or start a new run with -o"));
    }
    let fits = progress.stage <= trainer.stages.len()
        && trainer.stages.get(progress.stage).is_none_or(|s| progress.stage_step < s.iterations.max(1));
    if !fits {
        return Err(damaged("it is beyond the recipe's last step".into()));
    }
    let mut train_state = TrainState::resumed(scene, moments, stats);
    train_state.exposure = trainer.train_state.exposure.take();
    train_state.corrections = trainer.train_state.corrections.take();
    trainer.restore(train_state, progress);
    Ok(RunState {
        seconds: number(&meta["seconds"], "seconds")?,
        smooth: [number(&meta["smooth"][0], "smooth")?, number(&meta["smooth"][1], "smooth")?],
    })
}

/// The array of a table's moments. Tables are identified by name: a reader may make them in another order than training
/// did.
fn moments_name(layer: usize, params: &Params<f32>, key: Key) -> String {
    format!("moments.{layer}.{}", params.info(key).name)
}

/// The array that stores the state of a stage's loss over several times.
fn probe_name(stage: usize, loss: usize) -> String {
    format!("memory.{stage}.probe.{loss}")
}

/// The array that stores the state of a stage's maintenance operation.
fn maintenance_name(stage: usize, operation: &str) -> String {
    format!("upkeep.{stage}.{operation}")
}

/// A checkpoint's name for the memory of a stage's codec.
fn codec_name(stage: usize) -> String {
    format!("codec.{stage}")
}

fn metadata(file: &SafeTensors<'_>) -> Result<Value> {
    let Some(meta) = file.metadata().get(CHECKPOINT) else {
        return Err(Error::input("not a checkpoint").remedy("Give the run's folder: its newest checkpoint is found"));
    };
    let meta: Value = serde_json::from_str(meta).map_err(|e| damaged(format!("its metadata is not JSON ({e})")))?;
    match meta["version"].as_u64() {
        Some(VERSION) => Ok(meta),
        Some(v) => Err(Error::new(
            ErrorKind::Unsupported,
            format!("the checkpoint has version {v}, this splat4d continues version {VERSION}"),
        )
        .remedy("Continue with the splat4d that wrote it; its scene can still be rendered and exported")),
        None => Err(damaged("its metadata has no version".into())),
    }
}

fn damaged(what: String) -> Error {
    Error::input(format!("the checkpoint is damaged: {what}"))
        .remedy("Delete it; the run continues from the one before")
}

fn load(file: &SafeTensors<'_>, name: &str, table: &mut Table<f32>) -> Result<()> {
    if table.width() == 0 {
        return Ok(());
    }
    let tensor = file.tensor(name)?;
    if tensor.shape() != [table.rows(), table.width()] {
        return Err(damaged(format!(
            "array `{name}` has shape {:?}, not [{}, {}]",
            tensor.shape(),
            table.rows(),
            table.width()
        )));
    }
    table.column_from_rows(0, table.width(), &tensor.as_f32()?);
    Ok(())
}

/// The run's checkpoints, oldest first.
pub fn list(run: &Path) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = std::fs::read_dir(folder(run))
        .into_iter()
        .flatten()
        .flatten()
        .map(|e| e.path())
        .filter(|p| p.extension().is_some_and(|e| e == "safetensors"))
        .filter(|p| p.file_name().is_some_and(|n| !n.to_string_lossy().starts_with('.')))
        .collect();
    found.sort();
    found
}

/// The folder of a run's checkpoints.
pub(crate) fn folder(run: &Path) -> PathBuf {
    run.join("checkpoints")
}

/// The file of the checkpoint after `iteration` steps.
pub fn path(run: &Path, iteration: usize) -> PathBuf {
    folder(run).join(format!("{iteration:08}.safetensors"))
}
