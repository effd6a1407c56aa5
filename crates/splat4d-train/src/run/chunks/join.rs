//! Joins finished chunks into one scene, and measures the transitions between them.

use super::shared::{LAYER, read_scene};
use super::train::{of_frames, seconds};
use super::{Chunked, Part, SCENE, shared};
use crate::Result;
use crate::capture::{Capture, ImageStore};
use crate::event::Event;
use crate::path_text::to_text;
use crate::recipe::Recipe;
use crate::run::checkpoint::write_atomically_with;
use crate::run::identity::recipe_print;
use crate::run::info::{read_info, read_text, recorded_elsewhere};
use crate::vision::view::spread;
use splat4d::device;
use splat4d::layers::{Evaluation, Layer, Scene};
use splat4d::render::{Antialias, Image, RenderConfig, Shot};
use splat4d::scene::{Planes, Time};
use splat4d::{Error, ErrorKind};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

/// Cuts at which it is measured how well chunks meet, at most.
const MEASURED: usize = 16;
/// Cameras per cut.
const CAMERAS: usize = 2;
/// 8-bit steps in [0, 1]: the unit of flicker.
const LEVELS: f64 = 255.0;

/// A capture that was put together.
#[derive(Clone, Debug, PartialEq)]
pub struct Joined {
    /// Its chunks.
    pub chunks: usize,
    /// Steps of all of them.
    pub iterations: usize,
    /// Gaussians in all layers.
    pub gaussians: usize,
    /// Seconds of training, all workers together.
    pub seconds: f64,
    /// Largest memory that one of its parts took, bytes.
    pub peak_memory: u64,
}

/// Flicker (mean over neighbouring frames of |(R' − R) − (G' − G)|·255) where chunks meet, and for as many frames in
/// their midst.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Seams {
    /// Their overlap.
    pub across: f64,
    /// In the middle of chunks.
    pub inside: f64,
    /// Cuts that were examined.
    pub cuts: usize,
    /// Whether held-out cameras were used.
    pub held_out: bool,
}

impl Chunked {
    /// Puts finished chunks together: writes `scene.safetensors` and `run.json` of the whole.
    ///
    /// Errors: parts that are missing, or were made by another version or recipe; files that cannot be read or written.
    pub fn join(&self) -> Result<Joined> {
        let missing: Vec<String> =
            self.parts().into_iter().filter(|p| !self.is_done(*p)).map(|p| format!("--chunk {p}")).collect();
        if !missing.is_empty() {
            return Err(Error::input("parts of the capture are not finished")
                .at(self.run.display())
                .remedy(format!("Train these first: {}", missing.join(", "))));
        }
        let mut joined = Joined { chunks: self.plan.len(), iterations: 0, gaussians: 0, seconds: 0.0, peak_memory: 0 };
        for chunk in 0..self.plan.len() {
            self.check_made(chunk)?;
            let info = read_info(&self.folder(Part::Chunk(chunk)))?;
            joined.iterations += info["iteration"].as_u64().unwrap_or(0) as usize;
            joined.seconds += info["seconds"].as_f64().unwrap_or(0.0);
            joined.peak_memory = joined.peak_memory.max(info["peak_memory"].as_u64().unwrap_or(0));
        }
        // A chunk at a time is in memory. Of each there is one layer that learnt.
        let last = self.plan.len() - 1;
        let still = shared::read(&self.folder(Part::Shared))?.still;
        let whole = Scene { clip: self.shell()?.clip, layers: Vec::new(), ..self.alone(last)? };
        let count = self.plan.len() + usize::from(still.is_some());
        let mut gaussians = BTreeMap::new();
        let mut layer = |i: usize| {
            let layer = match (i <= last, &still) {
                (false, Some(still)) => still.clone(),
                _ => self.alone(i)?.layers.remove(0),
            };
            gaussians.insert(i, layer.params.len());
            Ok(layer)
        };
        write_atomically_with(&self.run.join(SCENE), &mut |file| {
            splat4d::format::scene::write_by_layer(&whole, count, &mut layer, file)
        })?;
        joined.gaussians = gaussians.values().sum();
        let done = [joined.iterations as f64, joined.gaussians as f64, joined.seconds];
        let info = read_info(&self.run)?;
        let name = info["capture_name"].as_str().unwrap_or_default();
        let elsewhere = recorded_elsewhere(&info).iter().map(|path| to_text(path)).collect();
        self.write_info(name, elsewhere, Some(done))?;
        Ok(joined)
    }

    /// The whole capture without what was learnt. Errors: the capture, or what chunks share, cannot be read.
    pub fn shell(&self) -> Result<Scene<f32>> {
        let [first, end] = self.plan.take;
        let ends = self.capture(vec![first..first + 1, end - 1..end])?;
        let background = shared::read(&self.folder(Part::Shared))?.background;
        let (clip, fps, up, offset) = (seconds(&ends, &(first..end)), ends.fps, ends.up, ends.offset);
        Ok(Scene { clip, fps, up, offset, background, ..Scene::default() })
    }

    /// The seconds in which a cut's neighbours fade into each other.
    fn fade(&self, cut: usize) -> Result<[f64; 2]> {
        let shared = self.plan.shared(cut);
        let capture = self.capture(vec![shared.clone()])?;
        let [from, to] = seconds(&capture, &shared);
        Ok([from - 0.5 / capture.fps, to + 0.5 / capture.fps])
    }

    /// A finished chunk as a scene of one layer, visible as in the whole capture; the shared part is left out.
    ///
    /// Errors: files that cannot be read.
    pub fn alone(&self, chunk: usize) -> Result<Scene<f32>> {
        let path = self.folder(Part::Chunk(chunk)).join(SCENE);
        let scene = read_scene(&path)?;
        let before = (chunk > 0).then(|| self.fade(chunk - 1)).transpose()?;
        let after = (chunk + 1 < self.plan.len()).then(|| self.fade(chunk)).transpose()?;
        let layer = scene.layers.into_iter().find(|l| l.name != LAYER).ok_or_else(|| {
            Error::input("the chunk has no layer of its own")
                .at(path.display())
                .remedy("Delete its folder, train it again")
        })?;
        let layer = Layer {
            name: format!("chunk {chunk:02}"),
            span: [before.map_or(f64::NEG_INFINITY, |w| w[0]), after.map_or(f64::INFINITY, |w| w[1])],
            cross_fade: [before, after].map(|w| w.map_or(0.0, |w| w[1] - w[0])),
            ..layer
        };
        Ok(Scene { layers: vec![layer], ..scene })
    }

    /// Some neighbouring chunks and what all share, as the whole capture shows them. Errors: files that cannot be read.
    pub fn some(&self, chunks: Range<usize>) -> Result<Scene<f32>> {
        let mut whole = Scene::default();
        for chunk in chunks {
            let mut one = self.alone(chunk)?;
            if !whole.layers.is_empty() {
                one.clip[0] = whole.clip[0];
            }
            whole.layers.append(&mut one.layers);
            one.layers = whole.layers;
            whole = one;
        }
        whole.layers.extend(self.still()?);
        Ok(whole)
    }

    /// The shared part of all chunks; none: nothing is static. Errors: the file cannot be read.
    pub fn still(&self) -> Result<Option<Layer<f32>>> {
        Ok(shared::read(&self.folder(Part::Shared))?.still)
    }

    /// Errors: a chunk that another version or another recipe made.
    fn check_made(&self, chunk: usize) -> Result<()> {
        let folder = self.folder(Part::Chunk(chunk));
        let other = |what: String| {
            Error::new(ErrorKind::Unsupported, format!("chunk {chunk} was made by another {what} than the capture's"))
                .at(folder.display())
                .remedy("Delete its folder and train it again")
        };
        let version = read_info(&folder)?["version"].as_str().unwrap_or("unknown").to_owned();
        if version != self.plan.version {
            return Err(other(format!("version ({version})")));
        }
        let wanted = of_frames(&self.recipe, self.plan.frames(chunk));
        let file = folder.join("recipe.toml");
        let made = Recipe::from_toml(&read_text(&file)?).map_err(|e| e.at(file.display()))?;
        // Stages count the steps of a chunk again.
        let made = made.with(|r| r.run.iterations = wanted.run.iterations);
        if recipe_print(&made, "") != recipe_print(&wanted, "") {
            return Err(other("recipe".into()));
        }
        Ok(())
    }

    /// How well chunks meet, by fixed cameras: those that training never saw, where there are any. `None`: there is no
    /// such camera, or no time. Before each cut `go_on` is called with the number of finished ones. Errors: chunks or
    /// images that cannot be read.
    pub fn seams(&self, go_on: &mut dyn FnMut(usize) -> bool, listen: &mut dyn FnMut(&Event)) -> Result<Option<Seams>> {
        let antialias = if self.recipe.appearance.antialias { Antialias::On } else { Antialias::Off };
        let config = RenderConfig { antialias, ..RenderConfig::default() };
        let cuts: Vec<usize> = spread(self.plan.cuts.len(), MEASURED).collect();
        let (mut sums, mut held_out, mut measured) = ([[0.0; 2]; 2], false, 0);
        for (done, &cut) in cuts.iter().enumerate() {
            if !go_on(done) {
                break;
            }
            measured = done + 1;
            listen(&Event::Phase { name: "how chunks meet".into(), done, total: cuts.len() });
            let seam = self.plan.shared(cut);
            // The step into the overlap and the one out of it are part of it.
            let seam = seam.start - 1..seam.end + 1;
            let chunk = self.plan.frames(cut);
            let middle = (chunk.start + chunk.end - seam.len()) / 2;
            let windows = [seam.clone(), middle..middle + seam.len()];
            let capture = Arc::new(self.capture(windows.to_vec())?);
            let fixed = |i: &usize| capture.cameras[capture.frames[*i].camera].fixed;
            held_out = capture.held.iter().any(fixed);
            let all = if held_out { &capture.held } else { &capture.train };
            let mut cameras: Vec<usize> = all.iter().copied().filter(fixed).map(|i| capture.frames[i].camera).collect();
            cameras.sort_unstable();
            cameras.dedup();
            let scene = self.some(cut..cut + 2)?;
            let mut look = CameraRenders {
                store: ImageStore::new(capture.clone(), 0),
                backend: device::cpu(config),
                capture: &capture,
                frames: all,
                scene: &scene,
            };
            for (sum, window) in sums.iter_mut().zip(windows) {
                for k in spread(cameras.len(), CAMERAS) {
                    let [total, pairs] = look.flicker(cameras[k], window.clone())?;
                    *sum = [sum[0] + total, sum[1] + pairs];
                }
            }
        }
        if sums.iter().any(|[_, pairs]| *pairs == 0.0) {
            return Ok(None);
        }
        let [across, inside] = sums.map(|[total, pairs]| total / pairs);
        Ok(Some(Seams { across, inside, cuts: measured, held_out }))
    }
}

/// Renders what cameras saw.
struct CameraRenders<'a> {
    store: ImageStore,
    backend: Box<dyn splat4d::render::Backend<f32>>,
    capture: &'a Capture,
    frames: &'a [usize],
    scene: &'a Scene<f32>,
}

impl CameraRenders<'_> {
    /// The sum over neighbouring frames of a window of the mean |(R' − R) − (G' − G)|·255, and their number.
    fn flicker(&mut self, camera: usize, window: Range<usize>) -> Result<[f64; 2]> {
        let (mut sum, mut pairs) = (0.0, 0.0);
        let mut before: Option<Vec<f32>> = None;
        for index in window {
            let frame = self.frames.iter().find(|&&i| {
                let f = &self.capture.frames[i];
                f.camera == camera && f.index == index
            });
            let Some(&frame) = frame else {
                before = None;
                continue;
            };
            let off = self.error(frame)?;
            if let Some(before) = before.filter(|b| b.len() == off.len()) {
                let total: f64 = before.iter().zip(&off).map(|(a, b)| f64::from((b - a).abs())).sum();
                sum += LEVELS * total / off.len().max(1) as f64;
                pairs += 1.0;
            }
            before = Some(off);
        }
        Ok([sum, pairs])
    }

    /// Render less truth of one frame, clamped as metrics are.
    fn error(&mut self, frame: usize) -> Result<Vec<f32>> {
        let f = &self.capture.frames[frame];
        let (mut seen, mut image, mut truth) = (Evaluation::default(), Image::default(), Planes::default());
        self.scene.at(Time(f.time.0), &mut seen);
        let splats = self.scene.splats(&seen);
        self.backend.render(&Shot::new(&splats, &f.view, self.scene.background), &mut image)?;
        self.store.load(frame)?.color_into(&mut truth);
        Ok(image.color.data.iter().zip(&truth.data).map(|(r, g)| r.clamp(0.0, 1.0) - g).collect())
    }
}
