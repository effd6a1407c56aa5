//! Captures that are still being filmed: the first frame as a static scene, then frame by frame only the Gaussians whose
//! pixels changed, so that the scene grows while images arrive.
//!
//! A frame is a function of the capture's images, the recipe and the frames before it. Its changes are one file, written
//! when the frame is done: a run that is stopped or killed loses at most the frame that it was at.
//!
//! Source: online training frame by frame as Luiten et al. 2024 (Dynamic 3D Gaussians) and Sun et al. 2024 (3DGStream);
//! which Gaussians learn is decided by images, in the spirit of the gates of QUEEN (Girish et al. 2024). The selection
//! by tiles and weights is ours.

mod about;
mod arrival;
mod changed;
mod fit;
mod history;
mod record;
#[cfg(test)]
mod tests;

pub use arrival::Arrival;

use super::checkpoint::write_atomically;
use super::identity::{fingerprint, recipe_print};
use super::info::{ELSEWHERE, elsewhere, read_text};
use super::open::{OpenCapture, capture_options, open_with};
use super::points;
use crate::capture::{Capture, CaptureOptions, Lenses, growing_root};
use crate::event::{Event, FollowedFrame};
use crate::path_text::{of_text, to_text};
use crate::recipe::Recipe;
use crate::{Error, Result};
use about::{check, read_plan};
use changed::{Comparison, TileErrors};
use fit::{Fit, drive, first_recipe, first_record};
use history::History;
use record::Record;
use serde_json::{Value, json};
use splat4d::device::Device;
use splat4d::format::playback::Node;
use splat4d::layers::Scene;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Folder of the frames in a run.
const FOLDER: &str = "frames";
/// The file in it that states what is followed.
const PLAN: &str = "follow.json";
/// The recipe, in the run and as it was requested in the folder of the frames.
const RECIPE: &str = "recipe.toml";

/// A capture that is followed into a run folder.
pub struct Following {
    run: PathBuf,
    root: PathBuf,
    recipe: Recipe,
    options: CaptureOptions,
    device: Device,
    watch: arrival::Watch,
    lenses: Lenses,
    /// Names and views of the cameras of the first frame.
    rig: Option<String>,
    facts: Value,
    /// The next frame.
    next: usize,
    state: Option<State>,
}

/// Some frames of a followed capture.
#[derive(Clone, Debug)]
pub struct Segment {
    /// A scene without Gaussians: background, axes, rate, and the clip from the first frame to the segment's last one.
    pub shell: Scene<f32>,
    /// Degree of the spherical harmonics.
    pub sh_degree: usize,
    /// Gaussians by the span in which they are rendered.
    pub nodes: Vec<Node>,
}

/// The present scene.
struct State {
    history: History,
    exposure: Vec<f32>,
    errors: TileErrors,
    shell: Scene<f32>,
}

impl Following {
    /// Begins to follow a capture, or continues the run in the folder `run`, of which all frames are read.
    ///
    /// Errors: the folder has no `capture.json`; the folder holds the run of another capture or recipe.
    pub fn begin(capture: &Path, recipe: &Recipe, run: &Path, device: Device) -> Result<Self> {
        let root = growing_root(capture)?;
        let root = std::fs::canonicalize(root).unwrap_or_else(|_| root.to_path_buf());
        check(recipe)?;
        let plan = json!({"version": env!("CARGO_PKG_VERSION"), "capture": to_text(&root), "recipe": recipe_print(recipe, "")});
        let file = run.join(FOLDER).join(PLAN);
        if Self::is(run) {
            let begun = read_plan(&file)?;
            if let Some(key) = ["version", "capture", "recipe"].into_iter().find(|key| begun[*key] != plan[*key]) {
                return Err(Error::input(format!("the folder holds a run of another {key}"))
                    .at(run.display())
                    .remedy("Use the same command, or another folder"));
            }
        } else {
            // That of the run states later what became of it.
            for at in [run.to_owned(), run.join(FOLDER)] {
                write_atomically(&at.join(RECIPE), recipe.to_toml().as_bytes())?;
            }
            write_atomically(&file, format!("{plan:#}\n").as_bytes())?;
        }
        let mut following = Self::before(root, recipe.clone(), run.to_owned(), device)?;
        for frame in record::list(&following.folder()) {
            following.replay(frame)?;
        }
        Ok(following)
    }

    /// Before the first frame.
    fn before(root: PathBuf, recipe: Recipe, run: PathBuf, device: Device) -> Result<Self> {
        Ok(Self {
            run,
            options: capture_options(&recipe)?,
            root,
            device,
            watch: arrival::Watch::default(),
            lenses: Lenses::default(),
            rig: None,
            facts: Value::Null,
            next: recipe.capture.first_frame,
            recipe,
            state: None,
        })
    }

    /// Whether a folder is the run of a followed capture.
    pub fn is(run: &Path) -> bool {
        run.join(FOLDER).join(PLAN).is_file()
    }

    /// The capture and the recipe of a run, to [`begin`](Self::begin) it again. Errors: it is none, or damaged.
    pub fn request(run: &Path) -> Result<(PathBuf, Recipe)> {
        let plan = read_plan(&run.join(FOLDER).join(PLAN))?;
        let file = run.join(FOLDER).join(RECIPE);
        let recipe = Recipe::from_toml(&read_text(&file)?).map_err(|e| e.at(file.display()))?;
        let capture = plan["capture"].as_str().map(of_text).ok_or_else(|| {
            Error::input("it does not name its capture")
                .at(run.display())
                .remedy("Follow the capture into another folder")
        })?;
        Ok((capture, recipe))
    }

    /// The frames that a run took; empty: no frame is done, or it is a run of another kind.
    pub(crate) fn taken(run: &Path) -> Vec<Range<usize>> {
        let numbers = if Self::is(run) { record::list(&run.join(FOLDER)) } else { Vec::new() };
        numbers.chunk_by(|a, b| a + 1 == *b).map(|part| part[0]..part[part.len() - 1] + 1).collect()
    }

    fn folder(&self) -> PathBuf {
        self.run.join(FOLDER)
    }

    /// The next frame's number.
    pub fn next(&self) -> usize {
        self.next
    }

    /// The first frame's number.
    fn first(&self) -> usize {
        self.recipe.capture.first_frame
    }

    /// Checks whether a frame has arrived: the next one, or a later one. Errors: an image of another size.
    pub fn look(&mut self, frame: usize) -> Result<Arrival> {
        let most = self.recipe.capture.max_frames;
        if most > 0 && frame >= self.first().saturating_add(most) {
            return Ok(Arrival::Ended { left: None });
        }
        self.watch.look(&self.root, frame, &self.options)
    }

    /// Leaves the next frame out: the scene stays as it is for its duration.
    pub fn skip(&mut self) {
        self.next += 1;
    }

    /// One frame of the capture.
    fn capture(&self, frame: usize) -> Result<Arc<Capture>> {
        let recipe = self.recipe.clone().with(|r| (r.capture.first_frame, r.capture.max_frames) = (frame, 1));
        let (frames, lenses) = (std::iter::once(frame..frame + 1).collect(), self.lenses.clone());
        let options = CaptureOptions { frames, lenses, gaps: true, ..self.options.clone() };
        Ok(Arc::new(open_with(&self.root, &recipe, options)?))
    }

    /// Learns the next frame, which is complete. `None`: a stop was requested, and the frame is not part of the run.
    ///
    /// Errors: an image cannot be read; the cameras are not those of the first frame; training of the first frame
    /// diverged; the files cannot be written. The run can be continued after any of them.
    pub fn fit(&mut self, stop: &AtomicBool, listen: &mut dyn FnMut(&Event)) -> Result<Option<FollowedFrame>> {
        let (began, frame) = (Instant::now(), self.next);
        let mut listen = listen;
        let capture = self.capture(frame)?;
        self.check_rig(&capture)?;
        let opened = OpenCapture::new(capture.clone(), &self.recipe)?.on(self.device);
        let record = match self.state.take() {
            None => self.fit_first(opened, stop, &mut listen)?,
            Some(state) => {
                let learnt = self.fit_next(&opened, &state, stop, &mut listen);
                self.state = Some(state);
                learnt?
            }
        };
        let Some(mut record) = record else { return Ok(None) };
        if self.state.is_none() {
            record.facts = self.facts.clone();
        }
        record.write(&self.folder())?;
        let changed = record.params.len();
        self.apply(&record);
        let (gaussians, psnr) = self.score(&capture)?;
        let (at, seconds) = (self.seconds(frame), began.elapsed().as_secs_f64());
        let done = FollowedFrame { frame, at, seconds, gaussians, changed, psnr };
        listen(&Event::Frame(done.clone()));
        Ok(Some(done))
    }

    /// The first frame: as a static scene from the capture's points.
    fn fit_first(
        &mut self,
        opened: OpenCapture,
        stop: &AtomicBool,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Option<Record>> {
        let mut listen = listen;
        let recipe = first_recipe(&self.recipe);
        let opened = points::complete(opened, &recipe, &self.run, &mut listen)?;
        let recipe = opened.counted(recipe, &mut listen)?.resolve();
        let plan = opened.plan(&recipe);
        let scene = opened.initial_scene(&recipe, &plan)?;
        let mut trainer = opened.trainer(&recipe, &plan, scene)?;
        trainer.check_not_empty()?;
        if !drive(&mut trainer, "the first frame", stop, &mut listen)? {
            return Ok(None);
        }
        let exposure = trainer.train_state.exposure.take();
        let scene = trainer.train_state.into_scene();
        let (capture, frames) = (&opened.capture, &opened.frames);
        let compared =
            Comparison { scene: &scene, capture, frames, numbers: &capture.train, exposure: exposure.as_ref() };
        let (errors, _) = compared.errors()?;
        self.lenses = capture.lenses.clone();
        self.facts = json!({
            "max_cap": recipe.densify.max_cap, "background": scene.background, "up": scene.up, "offset": scene.offset,
            "fps": capture.fps, "rig": self.rig, "name": capture.name, ELSEWHERE: elsewhere(capture),
            "fingerprint": fingerprint(capture),
        });
        Ok(Some(first_record(self.next, &scene, exposure.as_ref(), errors)))
    }

    /// A later frame. One that cannot be learnt changes nothing.
    fn fit_next(
        &self,
        opened: &OpenCapture,
        state: &State,
        stop: &AtomicBool,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Option<Record>> {
        let mut listen = listen;
        let fit = Fit {
            frame: self.next,
            opened,
            recipe: &self.recipe,
            history: &state.history,
            shell: &state.shell,
            exposure: &state.exposure,
            errors: &state.errors,
        };
        match fit.learn(stop, &mut listen) {
            Err(e) if e.kind() == crate::ErrorKind::Diverged => {
                listen(&Event::Warning {
                    message: format!("frame {} keeps the scene of the one before: {e}", self.next),
                });
                Ok(Some(Record {
                    frame: self.next,
                    active: Vec::new(),
                    params: splat4d::scene::Params::new(0, state.history.coefficients(), &[]),
                    origin: Vec::new(),
                    errors: state.errors.clone(),
                    exposure: Vec::new(),
                    facts: Value::Null,
                }))
            }
            learnt => learnt,
        }
    }

    /// Gaussians of the scene, and the mean PSNR of a frame's held-out views.
    fn score(&self, capture: &Arc<Capture>) -> Result<(usize, Option<f64>)> {
        let state = self.state.as_ref().expect("a frame was applied");
        let opened = OpenCapture::new(capture.clone(), &self.recipe)?;
        let psnr = fit::held_out(&opened, &state.history, &state.shell)?;
        Ok((state.history.layer.params.len(), psnr))
    }

    /// Reads a frame that is done, and applies it.
    fn replay(&mut self, frame: usize) -> Result<()> {
        let record = Record::read(&self.folder(), frame)?;
        let known = self.state.is_some() || !record.facts.is_null();
        if frame < self.next || !known {
            return Err(Error::input("files of frames before it are missing")
                .at(self.folder().join(format!("{frame:06}.safetensors")).display())
                .remedy("Restore them, or follow the capture into another folder"));
        }
        if self.state.is_none() {
            self.facts = record.facts.clone();
            self.rig = self.facts["rig"].as_str().map(str::to_owned);
        }
        if self
            .state
            .as_ref()
            .is_some_and(|s| record.active.last().is_some_and(|r| *r as usize >= s.history.layer.params.len()))
        {
            return Err(Error::input("it replaces Gaussians that do not exist")
                .at(self.folder().join(format!("{frame:06}.safetensors")).display())
                .remedy("Delete this file and later ones of the folder: the frames are trained again"));
        }
        self.apply(&record);
        Ok(())
    }

    fn apply(&mut self, record: &Record) {
        self.next = record.frame + 1;
        match &mut self.state {
            Some(state) => {
                state.history.apply(record);
                state.errors.clone_from(&record.errors);
            }
            None => {
                let facts = &self.facts;
                let numbers =
                    |key: &str| -> [f64; 3] { std::array::from_fn(|k| facts[key][k].as_f64().unwrap_or(0.0)) };
                let shell = Scene {
                    background: numbers("background").map(|x| x as f32),
                    up: numbers("up"),
                    offset: numbers("offset"),
                    fps: facts["fps"].as_f64().unwrap_or(splat4d::scene::time::DEFAULT_FPS),
                    ..Scene::default()
                };
                if let Some(cap) = facts["max_cap"].as_u64() {
                    self.recipe.densify.max_cap = cap as usize;
                }
                let history = History::new(record.params.clone(), record.frame);
                let (exposure, errors) = (record.exposure.clone(), record.errors.clone());
                self.state = Some(State { history, exposure, errors, shell });
            }
        }
    }

    /// The seconds of a frame on the scene clock.
    fn seconds(&self, frame: usize) -> f64 {
        let fps = self.state.as_ref().map_or(splat4d::scene::time::DEFAULT_FPS, |s| s.shell.fps);
        frame as f64 / fps
    }

    /// The part of a playback file that begins with the frame `from`, if its frames are done; `all`: those that are done.
    /// Frames before it are in the file and leave the memory.
    ///
    /// Panics: no frame is done.
    pub fn part(&mut self, from: usize, all: bool) -> Option<(Range<usize>, Segment)> {
        if let Some(state) = &mut self.state {
            state.history.forget(from);
        }
        // The first frame alone, so that there is something to play.
        let begins = from == self.first();
        let length = if begins { 1 } else { self.recipe.follow.segment };
        // How Gaussians leave a frame is known with the next one.
        let known = if all || begins { self.next } else { self.next - 1 };
        if from >= known || !all && known - from < length {
            return None;
        }
        let frames = from..known.min(from + length);
        let state = self.state.as_ref().expect("a frame is done");
        let clip = [self.seconds(self.first()), self.seconds(frames.end.saturating_sub(1))];
        let sh_degree = splat4d::math::sh::degree_of(state.history.coefficients()).unwrap_or(0);
        let shell = Scene { clip, ..state.shell.clone() };
        let nodes = self.nodes(frames.clone());
        Some((frames, Segment { shell, sh_degree, nodes }))
    }

    /// All parts again, from the files of the frames, one after the other. Errors: those of `each`; a file is damaged.
    pub fn again(&self, each: &mut dyn FnMut(Range<usize>, Segment) -> Result<()>) -> Result<()> {
        let (run, recipe) = (self.run.clone(), self.recipe.clone());
        let mut past = Self::before(self.root.clone(), recipe, run, self.device)?;
        let mut from = past.first();
        let frames = record::list(&self.folder());
        for (k, &frame) in frames.iter().enumerate() {
            past.replay(frame)?;
            let all = k + 1 == frames.len();
            if all {
                past.next = self.next;
            }
            while let Some((part, segment)) = past.part(from, all) {
                from = part.end;
                each(part, segment)?;
            }
        }
        Ok(())
    }

    /// Some frames as nodes.
    fn nodes(&self, frames: Range<usize>) -> Vec<Node> {
        self.state.as_ref().map_or_else(Vec::new, |s| s.history.nodes(frames, &|f| self.seconds(f)))
    }

    /// The capture's first frame: its cameras. Errors: its images are no longer there.
    pub fn beginning(&self) -> Result<Arc<Capture>> {
        self.capture(self.first())
    }
}

/// Checks the file of a frame, whatever run it is of. Errors: it is damaged.
#[doc(hidden)]
pub fn check_frame(bytes: &[u8]) -> Result<()> {
    Record::parse(bytes, 0).map(drop)
}
