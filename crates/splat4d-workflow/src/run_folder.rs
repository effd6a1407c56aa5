//! Reads the files of a run folder: `recipe.toml`, `run.json`, `metrics.csv`, `results.json`, `per_view.json`,
//! `cameras.json`, `scene.safetensors` and checkpoints. Everything but the folder may be missing.

use crate::files::{self, read_text};
use crate::paths::View;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use splat4d::math::Se3;
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, Result};
use splat4d_train::capture::{Capture, Split};
use splat4d_train::event::Event;
use splat4d_train::output::{FolderContent, Input, Mixes, OutputFolder, Owner, OwnerRecord, Request, STATE};
use splat4d_train::path_text::{in_command, of_text};
use splat4d_train::recipe::Recipe;
use splat4d_train::run::chunks::Chunked;
use splat4d_train::run::follow::Following;
use splat4d_train::run::{checkpoint, recorded_elsewhere, run_options};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Files that mark a folder as a run.
const MARKERS: [&str; 4] = ["recipe.toml", "run.json", "scene.safetensors", "checkpoints"];
/// File of results that `compress` leaves next to the file that it writes, for the report and for machines.
pub const COMPRESS: &str = "compress.json";
/// File with the requested settings of `compress`.
pub const ORDER: &str = "compress.toml";
/// Start of the commands that train, in the record of who has a folder.
const TRAIN: &str = "train";
/// Files and folders of a run that no output of another command may replace; what is baked, rendered or reported is
/// made again.
const KEPT: [&str; 9] = [
    "recipe.toml",
    "run.json",
    "cameras.json",
    "metrics.csv",
    "results.json",
    "per_view.json",
    "scene.safetensors",
    "checkpoints",
    ORDER,
];

/// One row of `metrics.csv`.
#[derive(Clone, Debug, Default)]
pub struct Metrics {
    pub iteration: f64,
    pub loss: f64,
    pub psnr: f64,
    pub gaussians: f64,
    /// The stage of training.
    pub stage: String,
    /// Seconds of training.
    pub seconds: f64,
    /// Milliseconds of each of [`Run::stages`].
    pub stages: Vec<f64>,
}

/// The scores of one held-out view.
#[derive(Clone, Debug, Default)]
pub struct ViewScore {
    /// `00000.png`
    pub file: String,
    pub camera: Option<String>,
    pub time: Option<f64>,
    pub psnr: Option<f64>,
    /// After the camera's colour matrix; runs of older versions have none.
    pub corrected: Option<f64>,
}

/// A run folder's files.
#[derive(Clone, Debug, Default)]
pub struct Run {
    pub path: PathBuf,
    /// `recipe.toml`
    pub recipe: Option<String>,
    /// `run.json`
    pub info: Value,
    pub metrics: Vec<Metrics>,
    /// Names of the stages of a step.
    pub stages: Vec<String>,
    /// The newest entry of `results.json`.
    pub results: Option<Value>,
    /// All of `results.json`.
    pub all_results: Value,
    /// Held-out views, from `per_view.json`.
    pub views: Vec<ViewScore>,
    /// `compress.json`, where the run was made by compressing another.
    pub compressed: Value,
    /// `geometry.json`, where the capture has measured geometry.
    pub geometry: Value,
    /// The request of a run without checkpoints.
    asked: Option<RunRequest>,
    iteration: Option<usize>,
}

impl Run {
    /// Whether this folder is a run, also one that training has just begun.
    pub fn is(path: &Path) -> bool {
        path.is_dir() && (MARKERS.iter().any(|m| path.join(m).exists()) || is_starting(path))
    }

    /// Whether a file is one that a run cannot do without.
    pub fn needs(file: &Path) -> bool {
        let real = file.canonicalize().or_else(|_| std::path::absolute(file)).unwrap_or_else(|_| file.to_owned());
        let is_kept = |path: &Path| {
            path.parent().is_some_and(Self::is) && path.file_name().is_some_and(|n| KEPT.iter().any(|k| n == *k))
        };
        real.ancestors().take(2).any(is_kept)
    }

    /// Whether this run has trained to its end.
    pub fn is_finished(path: &Path) -> bool {
        path.join("scene.safetensors").is_file()
    }

    /// Reads the folder. Errors: it is not a run; a file in it is damaged.
    pub fn open(path: &Path) -> Result<Self> {
        if !path.exists() {
            return Err(Error::input("no such run")
                .at(path.display())
                .remedy("Give the folder that `splat4d train` wrote, for instance runs/knight."));
        }
        if !Self::is(path) {
            return Err(Error::input("is not a run: it contains neither recipe.toml nor a scene nor checkpoints")
                .at(path.display())
                .remedy("Give the folder that `splat4d train` wrote, for instance runs/knight."));
        }
        let mut run = Self { path: path.to_owned(), asked: RunRequest::unbegun(path), ..Self::default() };
        let text = |name: &str| {
            let file = path.join(name);
            if file.is_file() { read_text(&file).map(Some) } else { Ok(None) }
        };
        run.recipe = text("recipe.toml")?;
        let parse = |name: &str| -> Result<Value> {
            let Some(text) = text(name)? else { return Ok(Value::Null) };
            crate::camera_file::json(&text).map_err(|e| e.at(path.join(name).display()))
        };
        run.info = parse("run.json")?;
        if let Some(csv) = text("metrics.csv")? {
            run.read_metrics(&csv);
        }
        run.all_results = parse("results.json")?;
        if let Some((iteration, entry)) = newest(&run.all_results) {
            run.iteration = Some(iteration);
            run.results = Some(entry.clone());
        }
        run.compressed = parse(COMPRESS)?;
        run.geometry = parse("geometry.json")?;
        run.views = newest(&parse("per_view.json")?).map(|(_, entry)| view_scores(entry)).unwrap_or_default();
        Ok(run)
    }

    fn read_metrics(&mut self, csv: &str) {
        let mut table = csv::ReaderBuilder::new().flexible(true).trim(csv::Trim::All).from_reader(csv.as_bytes());
        let Ok(header) = table.headers().cloned() else { return };
        let column = |name: &str| header.iter().position(|h| h == name);
        let stages: Vec<(usize, &str)> =
            header.iter().enumerate().filter_map(|(i, h)| Some((i, h.strip_suffix("_ms")?))).collect();
        self.stages = stages.iter().map(|s| s.1.to_owned()).collect();
        let (iteration, loss, psnr, gaussians) =
            (column("iteration"), column("loss"), column("psnr"), column("gaussians"));
        for line in table.records().flatten() {
            let cells: Vec<f64> = line.iter().map(|c| c.parse().unwrap_or(f64::NAN)).collect();
            let stage = column("stage").and_then(|i| line.get(i)).unwrap_or_default().to_owned();
            let get = |i: Option<usize>| i.and_then(|i| cells.get(i).copied()).unwrap_or(f64::NAN);
            self.metrics.push(Metrics {
                iteration: get(iteration),
                loss: get(loss),
                psnr: get(psnr),
                gaussians: get(gaussians),
                stage,
                seconds: get(column("seconds")),
                stages: stages.iter().map(|s| get(Some(s.0))).collect(),
            });
        }
    }

    /// The capture's name.
    pub fn name(&self) -> String {
        let recorded = self.info.get("capture_name").and_then(Value::as_str).map(str::to_owned);
        let folder = || self.path.file_name().map(|n| n.to_string_lossy().into_owned());
        recorded.or_else(folder).unwrap_or_else(|| "run".into())
    }

    /// A number of `run.json`.
    pub fn number(&self, key: &str) -> Option<f64> {
        self.info.get(key).and_then(Value::as_f64)
    }

    /// The setting `table.field` of the recipe, as text.
    pub fn recipe_text(&self, setting: &str) -> Option<String> {
        self.recipe().ok()?.get(setting).map(|v| v.as_str().map_or_else(|| v.to_string(), str::to_owned))
    }

    /// The recipe.
    pub fn recipe(&self) -> Result<Recipe> {
        let path = self.path.join("recipe.toml");
        match (&self.recipe, &self.asked) {
            (Some(text), _) => Recipe::from_toml(text).map_err(|e| e.at(path.display())),
            (None, Some(asked)) => asked.recipe(),
            (None, None) => Err(Error::input("the run has no recipe.toml")
                .at(path.display())
                .remedy("Train again: the file is written at the start.")),
        }
    }

    /// Steps taken, where recorded.
    pub fn iteration(&self) -> Option<usize> {
        let recorded = self.number("iteration").map(|n| n as usize);
        recorded.or(self.iteration).or_else(|| self.metrics.last().map(|m| m.iteration as usize))
    }

    /// A held-out score.
    pub fn score(&self, key: &str) -> Option<f64> {
        self.results.as_ref()?.get(key).and_then(Value::as_f64)
    }

    /// A held-out score of the still baseline.
    pub fn baseline(&self, key: &str) -> Option<f64> {
        self.all_results.get("still").and_then(|b| b.get(key)).and_then(Value::as_f64)
    }

    /// The capture it was trained on.
    pub fn capture(&self) -> Option<PathBuf> {
        let recorded = self.info.get("capture").and_then(Value::as_str).map(of_text);
        recorded.or_else(|| self.asked.as_ref().map(|asked| asked.capture.clone()))
    }

    /// Its capture.
    pub fn origin(&self) -> Origin {
        let opened = || {
            let (root, recipe) = (self.capture()?, self.recipe().ok()?);
            // Also masks and maps that the recipe does not use.
            Capture::open(&root, &run_options(&self.path, &recipe).ok()?).ok()
        };
        // A capture that can no longer be opened still has the images that the run was trained on.
        let mut elsewhere = recorded_elsewhere(&self.info);
        elsewhere.extend(opened().into_iter().flat_map(|c| c.elsewhere));
        Origin { capture: self.capture(), elsewhere }
    }

    /// Warnings and notes about the run: those of the capture's reader, and those since, in that order.
    pub fn findings(&self) -> Vec<String> {
        let mut out: Vec<String> = Vec::new();
        for key in ["warnings", "notes"] {
            for entry in self.info.get(key).and_then(Value::as_array).into_iter().flatten() {
                let text = entry.as_str().map(str::to_owned).or_else(|| {
                    let what = entry.get("what")?.as_str()?;
                    let remedy = entry.get("remedy").and_then(Value::as_str).unwrap_or_default();
                    Some(format!("{what} {remedy}").trim().to_owned())
                });
                out.extend(text.filter(|t| !out.contains(t)));
            }
        }
        out
    }

    /// The folder of the newest held-out images.
    pub fn pictures(&self) -> Option<PathBuf> {
        let test = self.path.join("test");
        let recorded = self.iteration.map(|n| test.join(format!("ours_{n}")));
        recorded.filter(|p| p.is_dir()).or_else(|| {
            let folders = std::fs::read_dir(&test).ok()?.flatten().map(|e| e.path()).filter(|p| p.is_dir());
            folders.max_by_key(|p| step_of(&p.file_name()?.to_string_lossy()))
        })
    }

    /// The newest scene: `scene.safetensors`, or else the newest checkpoint.
    pub fn scene_file(&self) -> Result<PathBuf> {
        let scene = self.path.join("scene.safetensors");
        if scene.is_file() {
            return Ok(scene);
        }
        checkpoint::list(&self.path).pop().ok_or_else(|| {
            let what = if self.path.join("scene.s4d").is_file() {
                "the run has a playback file (splat4d view plays it), but no scene yet"
            } else {
                "the run has no scene and no checkpoint yet"
            };
            Self::unfinished(&self.path, what)
        })
    }

    /// Error: a run that is not finished lacks what a command needs. Who works on it decides what to do about that.
    pub fn unfinished(path: &Path, what: &str) -> Error {
        let name = in_command(path);
        let (state, remedy) = match Owner::other(path) {
            Some(who) => (
                format!("; {} works on it", who.map_or_else(|| "another process".into(), |who| who.to_string())),
                format!("Wait for it: splat4d status {name} reports its progress."),
            ),
            None if Chunked::is(path) => {
                (String::new(), format!("Finish its chunks first: splat4d status {name} lists them."))
            }
            None => (String::new(), format!("No process works on it. Continue it: splat4d train --resume {name}")),
        };
        Error::input(format!("{what}{state}")).at(path.display()).remedy(remedy)
    }

    /// Opens the capture again, as the run saw it.
    pub fn open_capture(&self) -> Result<(Capture, Recipe)> {
        let (recipe, capture) = splat4d_train::run::open_run(&self.path)?;
        Ok((capture, recipe))
    }

    /// The cameras of the data set: from `cameras.json`, or else from the capture.
    pub fn views(&self) -> Result<Vec<View>> {
        let file = self.path.join("cameras.json");
        if file.is_file() {
            return views_in(&file)?.ok_or_else(|| {
                Error::input("expected a list of cameras as splat4d writes it")
                    .at(file.display())
                    .remedy("Delete it: the cameras are then read from the capture.")
            });
        }
        Ok(views_of(&self.open_capture()?.0))
    }
}

/// Whether training has taken a folder and written none of a run's files yet.
fn is_starting(path: &Path) -> bool {
    let trains = |who: Option<OwnerRecord>| who.is_some_and(|who| who.command.starts_with(TRAIN));
    path.join(STATE).is_dir() && (RunRequest::unbegun(path).is_some() || Owner::holder(path).is_some_and(trains))
}

/// Refuses a folder that a command has taken as its output and not written to yet. Errors: another owner.
pub fn check_written(folder: &Path) -> Result<()> {
    let mut there = std::fs::read_dir(folder).into_iter().flatten().flatten();
    if !folder.join(STATE).is_dir() || there.any(|entry| entry.file_name() != STATE) {
        return Ok(());
    }
    let (what, remedy) = match Owner::other(folder) {
        Some(who) => {
            let who = who.map_or_else(|| "another process".into(), |who| who.to_string());
            (format!("is the output folder of {who}, which has written nothing yet"), "Wait for it.")
        }
        None => (
            "is the output folder of a command that ended before it wrote anything".into(),
            "Run that command again, or give another folder.",
        ),
    };
    Err(Error::input(what).at(folder.display()).remedy(remedy))
}

/// The cameras in a file such as `cameras.json`; `None`: it is JSON of another kind.
pub fn views_in(file: &Path) -> Result<Option<Vec<View>>> {
    let value = crate::camera_file::json(&read_text(file)?).map_err(|e| e.at(file.display()))?;
    let list = value.as_array().map(Vec::as_slice).unwrap_or_default();
    let views: Option<Vec<View>> = list.iter().map(read_view).collect();
    Ok(views.filter(|v| !v.is_empty()))
}

/// The images that a run uses as views, held-out ones marked.
pub fn views_of(capture: &Capture) -> Vec<View> {
    let view = |i: usize| {
        let frame = &capture.frames[i];
        View {
            camera: frame.view.clone(),
            name: capture.cameras[frame.camera].name.clone(),
            time: frame.time.0,
            held: capture.split(i) == Split::Held,
        }
    };
    // A run may use a part of the capture only: `train` and `held` name it.
    let mut used: Vec<usize> = capture.train.iter().chain(&capture.held).copied().collect();
    used.sort_unstable();
    used.into_iter().map(view).collect()
}

/// Writes `cameras.json` into a run.
pub fn write_cameras(run: &Path, capture: &Capture) -> Result<()> {
    let text = serde_json::to_vec(&cameras_json(capture)).expect("cameras are plain data");
    files::write(&run.join("cameras.json"), &text)
}

/// `cameras.json` as 3DGS viewers read it (camera-to-world position and rotation), with a few keys more.
pub fn cameras_json(capture: &Capture) -> Value {
    views_of(capture).iter().enumerate().map(|(id, view)| view_json(id, view)).collect()
}

/// One of them.
pub fn view_json(id: usize, view: &View) -> Value {
    let world = view.camera.cam_from_world.inverse();
    let k = &view.camera.intrinsics;
    json!({
        "id": id, "img_name": view.name, "width": view.camera.width, "height": view.camera.height,
        "position": world.translation, "rotation": world.rotation, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy,
        "near": view.camera.near,
        "time": view.time, "split": if view.held { "test" } else { "train" },
    })
}

fn read_view(value: &Value) -> Option<View> {
    let number = |key: &str| value.get(key).and_then(Value::as_f64).filter(|x| x.is_finite());
    let side = |key: &str| number(key).filter(|n| (1.0..=crate::camera_file::MAX_SIDE as f64).contains(n));
    let position = crate::camera_file::numbers(value.get("position")?)?;
    let rows: Vec<Vec<f64>> =
        value.get("rotation")?.as_array()?.iter().filter_map(crate::camera_file::numbers).collect();
    if position.len() != 3 || rows.len() != 3 || rows.iter().any(|r| r.len() != 3) {
        return None;
    }
    let rotation = std::array::from_fn(|i| std::array::from_fn(|j| rows[i][j]));
    let world = Se3 { rotation, translation: [position[0], position[1], position[2]] };
    let (width, height) = (side("width")? as usize, side("height")? as usize);
    let intrinsics = Intrinsics {
        fx: number("fx").filter(|f| *f > 0.0)?,
        fy: number("fy").filter(|f| *f > 0.0)?,
        cx: number("cx").unwrap_or(0.5 * width as f64),
        cy: number("cy").unwrap_or(0.5 * height as f64),
    };
    // Runs of older versions have none.
    let near = if value.get("near").is_some() { number("near").filter(|n| *n > 0.0)? } else { Camera::NEAR };
    Some(View {
        camera: Camera { cam_from_world: world.inverse(), intrinsics, lens: Lens::Pinhole, width, height, near },
        name: value.get("img_name").and_then(Value::as_str).unwrap_or_default().to_owned(),
        time: number("time").unwrap_or(0.0),
        held: value.get("split").and_then(Value::as_str) == Some("test"),
    })
}

/// Default folder of a run of the capture with this name.
pub fn usual_folder(capture: &str) -> PathBuf {
    let name: String =
        capture.chars().map(|c| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '-' }).collect();
    let name = name.trim_matches(['.', '-']);
    Path::new("runs").join(if name.is_empty() { "run" } else { name })
}

/// The folder of a capture, and what it reads from elsewhere: none of it is an output.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Origin {
    capture: Option<PathBuf>,
    elsewhere: BTreeSet<PathBuf>,
}

impl Origin {
    /// Of an opened capture.
    pub fn of(capture: &Capture) -> Self {
        Self { capture: Some(capture.root.clone()), elsewhere: capture.elsewhere.clone() }
    }

    /// All of it.
    pub fn inputs(&self) -> impl Iterator<Item = Input<'_>> {
        let what =
            |path: &PathBuf| if path.is_dir() { "a folder of the capture's images," } else { "a file of the capture," };
        let elsewhere = self.elsewhere.iter().map(move |path| Input::new(path, what(path)));
        self.capture.iter().map(|c| Input::new(c, "the capture")).chain(elsewhere)
    }
}

/// The request of a training run: the same command continues it, from whatever state a crash left.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunRequest {
    version: String,
    /// The capture's real path.
    #[serde(with = "splat4d_train::path_text")]
    pub capture: PathBuf,
    /// The recipe before anything was chosen or planned, TOML.
    recipe: String,
    /// Minutes to keep to.
    pub minutes: Option<f64>,
    /// Whether the time is foretold.
    pub predict: bool,
    /// Whether the capture is followed while it grows.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    follow: bool,
    /// Files that the capture reads from elsewhere.
    #[serde(skip)]
    elsewhere: BTreeSet<PathBuf>,
}

impl RunRequest {
    pub fn new(capture: &Path, recipe: &Recipe, minutes: Option<f64>, predict: bool) -> Self {
        let capture = capture.canonicalize().unwrap_or_else(|_| capture.to_owned());
        let (version, recipe) = (env!("CARGO_PKG_VERSION").into(), recipe.to_toml());
        Self { version, capture, recipe, minutes, predict, follow: false, elsewhere: BTreeSet::new() }
    }

    /// The same of an opened capture; what it reads from elsewhere holds no output either.
    pub fn of(capture: &Capture, recipe: &Recipe, minutes: Option<f64>, predict: bool) -> Self {
        Self { elsewhere: capture.elsewhere.clone(), ..Self::new(&capture.root, recipe, minutes, predict) }
    }

    /// The same, for a capture that is followed while it grows.
    pub fn followed(self) -> Self {
        Self { follow: true, ..self }
    }

    /// Of a run that ended before its first checkpoint, so that there is nothing else to continue from.
    pub fn unbegun(run: &Path) -> Option<Self> {
        let text = checkpoint::list(run).is_empty().then(|| OutputFolder::unfinished_request(run))??;
        serde_json::from_str(&text).ok()
    }

    pub fn recipe(&self) -> Result<Recipe> {
        Recipe::from_toml(&self.recipe)
    }

    /// Takes the folder of the run for a new training or the rest of one. The content of one that took no step is
    /// removed.
    pub fn begin(&self, run: &Path, force: bool, command: &str) -> Result<(OutputFolder, FolderContent)> {
        let asked = serde_json::to_string(self).expect("it is plain data");
        let origin = Origin { capture: Some(self.capture.clone()), elsewhere: self.elsewhere.clone() };
        let inputs: Vec<Input<'_>> = origin.inputs().collect();
        let request = Request { command, inputs: &inputs, asked: &asked, force, mixes: Mixes::Anything };
        let (folder, found) = OutputFolder::begin(run, &request)?;
        if found == FolderContent::Unfinished && checkpoint::list(run).is_empty() && !Following::is(run) {
            folder.clear()?;
            return Ok((folder, FolderContent::Nothing));
        }
        Ok((folder, found))
    }
}

/// Takes note of an event of a run that is written into a folder: from its first step on the run is kept.
pub fn on_event(folder: &OutputFolder, event: &Event) {
    match event {
        Event::Checkpoint { iteration: 1.., .. } | Event::Finished { .. } => folder.begun(),
        _ => {}
    }
}

/// Leaves the folder of a training that ended: one that failed before its first checkpoint after the start leaves
/// nothing to continue.
pub fn left<T>(folder: OutputFolder, run: &Path, trained: &Result<T>) -> Option<OutputFolder> {
    let begun = checkpoint::list(run).iter().any(|path| *path != checkpoint::path(run, 0));
    if trained.is_err() && !begun {
        folder.abandon();
        return None;
    }
    folder.begun();
    Some(folder)
}

/// Folder of a new run: the requested one, or with a number appended if that is taken.
pub fn free_folder(wanted: &Path) -> PathBuf {
    let holds = |p: &Path| std::fs::read_dir(p).is_ok_and(|d| d.flatten().any(|e| e.file_name() != STATE));
    let taken = |p: &Path| p.is_file() || holds(p) || Owner::holder(p).is_some();
    if !taken(wanted) {
        return wanted.to_owned();
    }
    let name = wanted.file_name().unwrap_or_default();
    let numbered = |i: usize| {
        let mut name = name.to_owned();
        name.push(format!("-{i}"));
        wanted.with_file_name(name)
    };
    (2usize..).map(numbered).find(|p| !taken(p)).expect("some number is free")
}

/// An entry `ours_N` of `results.json` next to the one that the run is judged by.
#[derive(Clone, Debug)]
pub struct Baseline<'a> {
    /// Its name: a split, and a background where it is not the run's own.
    pub name: &'a str,
    pub step: usize,
    pub scores: &'a Value,
}

/// The newest of each, by name.
pub fn baselines(results: &Value) -> Vec<Baseline<'_>> {
    let entries = results.as_object().into_iter().flatten();
    entries.filter_map(|(name, entry)| newest(entry).map(|(step, scores)| Baseline { name, step, scores })).collect()
}

/// The entry `ours_N` with the largest N.
pub fn newest(results: &Value) -> Option<(usize, &Value)> {
    results.as_object()?.iter().filter_map(|(k, v)| Some((step_of(k)?, v))).max_by_key(|e| e.0)
}

fn step_of(name: &str) -> Option<usize> {
    name.strip_prefix("ours_")?.parse().ok()
}

pub fn view_scores(entry: &Value) -> Vec<ViewScore> {
    let psnr = entry.get("PSNR").and_then(Value::as_object);
    let mut views: Vec<ViewScore> = psnr
        .into_iter()
        .flatten()
        .map(|(file, value)| ViewScore {
            file: file.clone(),
            camera: entry.get("camera").and_then(|c| c.get(file)).and_then(Value::as_str).map(str::to_owned),
            time: entry.get("time").and_then(|c| c.get(file)).and_then(Value::as_f64),
            psnr: value.as_f64(),
            corrected: entry.get("PSNR-cc").and_then(|c| c.get(file)).and_then(Value::as_f64),
        })
        .collect();
    views.sort_by(|a, b| a.file.cmp(&b.file));
    views
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_without_files_is_reported_with_its_owner() {
        let folder = tempfile::tempdir().unwrap();
        let (capture, run) = (folder.path().join("capture"), folder.path().join("run"));
        std::fs::create_dir(&capture).unwrap();
        let request = RunRequest::new(&capture, &Recipe::default(), None, false);
        let asked = serde_json::to_string(&request).unwrap();
        std::fs::create_dir_all(run.join(STATE)).unwrap();
        std::fs::write(run.join(STATE).join("asked"), asked).unwrap();
        std::fs::write(run.join(STATE).join("lock"), "").unwrap();
        // Killed.
        assert!(Run::is(&run));
        let opened = Run::open(&run).unwrap();
        assert_eq!((opened.capture(), opened.recipe().is_ok()), (Some(request.capture), true));
        let resume = "splat4d train --resume";
        let said = opened.scene_file().unwrap_err().to_string();
        assert!(said.contains("No process") && said.contains(resume), "{said}");
        assert!(crate::status::of(&run).unwrap().text().contains(resume));
        // Of a capture that is followed.
        std::fs::write(run.join("scene.s4d"), "").unwrap();
        let followed = opened.scene_file().unwrap_err().to_string();
        assert!(followed.contains("splat4d view plays it") && followed.contains(resume), "{followed}");
        // Of a process on another machine.
        let owner =
            r#"{"command": "train", "process": 7, "host": "elsewhere", "since": "2026", "machine": "m", "beat": "1"}"#;
        std::fs::write(run.join(STATE).join("owner.json"), owner).unwrap();
        let said = opened.scene_file().unwrap_err().to_string();
        assert!(said.contains("process 7 on elsewhere") && !said.contains(resume), "{said}");
        let said = crate::status::of(&run).unwrap().text();
        assert!(said.contains("process 7 on elsewhere") && !said.contains(resume), "{said}");
    }

    #[test]
    fn an_output_folder_without_output_is_no_capture() {
        let folder = tempfile::tempdir().unwrap();
        assert!(check_written(folder.path()).is_ok());
        std::fs::create_dir(folder.path().join(STATE)).unwrap();
        assert!(check_written(folder.path()).unwrap_err().to_string().contains("ended before"));
        std::fs::write(folder.path().join("capture.json"), "{}").unwrap();
        assert!(check_written(folder.path()).is_ok());
    }

    #[test]
    fn folders_in_use_get_a_number() {
        let folder = tempfile::tempdir().unwrap();
        let wanted = folder.path().join("knight");
        assert_eq!(free_folder(&wanted), wanted);
        std::fs::create_dir(&wanted).unwrap();
        assert_eq!(free_folder(&wanted), wanted, "an empty folder is free");
        std::fs::write(wanted.join("recipe.toml"), "").unwrap();
        assert_eq!(free_folder(&wanted), folder.path().join("knight-2"));
    }

    #[test]
    fn the_newest_results_are_found() {
        let value = json!({"ours_900": {"PSNR": 1.0}, "ours_6000": {"PSNR": 2.0}, "train_ours_6000": {}, "still": {}});
        let (iteration, entry) = newest(&value).unwrap();
        assert_eq!((iteration, entry["PSNR"].as_f64()), (6000, Some(2.0)));
    }
}
