//! The scene during training, as a playback file: for the live view. It only reads, so that the result stays the same
//! to the bit.

use super::metrics::psnr;
use crate::Result;
use crate::capture::{Capture, ImageStore};
use crate::event::Event;
use crate::step::trainer::Trainer;
use splat4d::bake::{Options, bake};
use splat4d::device;
use splat4d::format::playback::{Draft, Meta, NamedCamera, Viewpoint, WriteConfig, write};
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::se3::{dot, sub};
use splat4d::render::{Antialias, Backend, Image, RenderConfig, Shot};
use splat4d::scene::{Camera, time::DEFAULT_FPS};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Training continues for this many times as long as the last snapshot took: at most 2.5 % of the time.
const REST: u32 = 40;
/// Entries of the palette, rounds that fit it, effort of deflate: a snapshot is examined for seconds.
const PALETTE: usize = 256;
const ROUNDS: usize = 1;
const EFFORT: u32 = 1;
/// Most cameras that a snapshot names and is measured by.
const CAMERAS: usize = 64;
/// Held-out views that are rendered for a snapshot's score: an even choice of all.
const HELD_VIEWS: usize = 4;
/// Memory for their decoded images, bytes.
const HELD_MEMORY: usize = 64 << 20;
/// Rows whose means give the middle of the scene.
const ROWS: usize = 1000;

/// When the next snapshot is due, and what stays the same from one to the next.
pub(super) struct Snapshots {
    interval: Duration,
    due: Instant,
    title: String,
    cameras: Vec<NamedCamera>,
    poses: Vec<Camera>,
    held: Option<HeldOut>,
}

/// Held-out views that score a snapshot.
struct HeldOut {
    store: ImageStore,
    frames: Vec<usize>,
    backend: Box<dyn Backend>,
}

impl HeldOut {
    /// `None`: no view is held out.
    fn new(capture: &Arc<Capture>, antialias: Antialias) -> Option<Self> {
        let n = capture.held.len();
        let count = n.min(HELD_VIEWS);
        let frames: Vec<usize> = (0..count).map(|i| capture.held[(2 * i + 1) * n / (2 * count)]).collect();
        let backend = device::cpu(RenderConfig { antialias, ..RenderConfig::default() });
        (count > 0).then(|| Self { store: ImageStore::new(capture.clone(), HELD_MEMORY), frames, backend })
    }

    /// Mean PSNR, dB, of the views whose images can be read.
    fn score(&mut self, scene: &Scene<f32>) -> Option<f64> {
        let (mut instant, mut image) = (Evaluation::default(), Image::default());
        let mut scores = Vec::new();
        for &frame in &self.frames {
            let Ok(truth) = self.store.load(frame) else { continue };
            let (truth, frame) = (truth.to_picture(), &self.store.capture().frames[frame]);
            scene.at(frame.time, &mut instant);
            let splats = scene.splats(&instant);
            device::draw(&mut self.backend, &Shot::new(&splats, &frame.view, scene.background), &mut image);
            scores.push(psnr(mean_square(
                &image.color.data,
                &truth.color.data,
                truth.valid.as_ref().map(|v| &v.data[..]),
            )));
        }
        (!scores.is_empty()).then(|| scores.iter().sum::<f64>() / scores.len() as f64)
    }
}

impl Snapshots {
    /// The first one is due at once.
    pub(super) fn new(interval: Duration, capture: &Arc<Capture>, antialias: Antialias) -> Self {
        let mut poses: Vec<(usize, Camera)> = Vec::new();
        for frame in capture.train.iter().map(|&i| &capture.frames[i]) {
            if poses.len() < CAMERAS && poses.iter().all(|(c, _)| *c != frame.camera) {
                poses.push((frame.camera, frame.view.clone()));
            }
        }
        let named = |(camera, view): &(usize, Camera)| NamedCamera::new(&capture.cameras[*camera].name, view);
        Self {
            interval,
            due: Instant::now(),
            title: capture.name.clone(),
            cameras: poses.iter().map(named).collect(),
            poses: poses.into_iter().map(|p| p.1).collect(),
            held: HeldOut::new(capture, antialias),
        }
    }

    /// Whether one is due.
    pub(super) fn is_due(&self) -> bool {
        Instant::now() >= self.due
    }

    /// The snapshot, where one is due. One that fails is a warning.
    pub(super) fn take(&mut self, trainer: &Trainer<'_>) -> Option<Event> {
        self.is_due().then(|| self.now(trainer))
    }

    /// The snapshot, due or not.
    pub(super) fn now(&mut self, trainer: &Trainer<'_>) -> Event {
        let (started, iteration) = (Instant::now(), trainer.progress.iteration);
        let scene = trainer.shown();
        let event = match self.bytes(&scene) {
            Ok(bytes) => {
                let held_out = self.held.as_mut().and_then(|held| held.score(&scene));
                Event::Snapshot { iteration, bytes: bytes.into(), held_out }
            }
            Err(e) => Event::Warning { message: format!("step {iteration} cannot be shown: {e}") },
        };
        self.due = Instant::now() + self.interval.max(started.elapsed() * REST);
        event
    }

    fn bytes(&self, scene: &Scene<f32>) -> Result<Vec<u8>> {
        // Without a tolerance nothing is split: one sample per frame, one segment per Gaussian. A page that follows a
        // run has the whole file at once: nothing is ranked.
        let options = Options {
            tolerance: f64::INFINITY,
            sample_rate: 0.0,
            cameras: self.poses.clone(),
            rank: false,
            ..Options::default()
        };
        let baked = bake(scene, &options, &mut |_, _| {})?;
        let meta = Meta {
            clip: baked.clip,
            fps: if scene.fps > 0.0 && scene.fps.is_finite() { scene.fps } else { DEFAULT_FPS },
            up: scene.up,
            offset: scene.offset,
            background: scene.background,
            sh_degree: baked.sh_degree,
            title: self.title.clone(),
            view: self.poses.first().map(|camera| view(camera, scene)),
            cameras: self.cameras.clone(),
            ..Meta::default()
        };
        let config =
            WriteConfig { palette: PALETTE, kmeans_rounds: ROUNDS, deflate_level: EFFORT, ..WriteConfig::default() };
        let mut bytes = Vec::new();
        write(&Draft { meta, nodes: baked.nodes, poster: None }, &config, &mut bytes)?;
        Ok(bytes)
    }
}

/// The mean squared difference of two images [3, height, width], of the pixels that the lens recorded in full.
fn mean_square(a: &[f32], b: &[f32], valid: Option<&[f32]>) -> f64 {
    let pixels = a.len() / 3;
    let counts = |i: usize| valid.is_none_or(|v| v[i % pixels] >= 1.0);
    let squares = (0..a.len()).filter(|&i| counts(i)).map(|i| f64::from(a[i] - b[i]).powi(2));
    let (sum, n) = squares.fold((0.0, 0usize), |(sum, n), s| (sum + s, n + 1));
    sum / n.max(1) as f64
}

/// The camera's viewpoint, with the depth of the scene's middle as the distance of its target.
fn view(camera: &Camera, scene: &Scene<f32>) -> Viewpoint {
    let (eye, forward) = (camera.center(), camera.forward());
    let stride = scene.len().div_ceil(ROWS).max(1);
    let mut depths: Vec<f64> = scene
        .layers
        .iter()
        .flat_map(|layer| layer.means().step_by(stride))
        .map(|mean| dot(sub(mean, eye), forward))
        .filter(|z| *z > 0.0)
        .collect();
    depths.sort_by(f64::total_cmp);
    let depth = depths.get(depths.len() / 2).copied().unwrap_or(1.0);
    let fov_y = 2.0 * (0.5 * camera.height as f64 / camera.intrinsics.fy).atan().to_degrees();
    Viewpoint { position: eye, target: std::array::from_fn(|k| eye[k] + depth * forward[k]), up: scene.up, fov_y }
}
