//! Playback of a scene on this machine's CPU: Gaussians alive, bytes, and frames per second from the capture's cameras
//! over its clip. Compared variants are measured alternately, image by image, so that a machine that is busy for a
//! while slows all of them.

use crate::draw::color_into;
use crate::paths::View;
use crate::run_folder::Run;
use crate::source::Source;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use splat4d::Result;
use splat4d::format::{playback, scene as scene_file};
use splat4d::layers::{Evaluation, Scene};
use splat4d::play::{DEFAULT_BUDGET, Player, ReadAt};
use splat4d::render::{Antialias, Image, RenderConfig, Renderer, Shot};
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::scene::{Camera, Time};
use splat4d_train::eval::run::Scores;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Instant;

/// Width and height of the images by default: the frame rates of docs/benchmarks.md are at this size.
pub const SIZE: [usize; 2] = [800, 800];
/// Images of a round: enough that every side of the scene and all parts of the clip take part.
const VIEWS: usize = 24;
/// Rounds of which the best of every image counts, after a warm-up round.
const ROUNDS: usize = 5;
/// Times that the first image is rendered from bytes; the best counts.
const DECODES: usize = 3;
/// Most times at which Gaussians are counted: ten seconds at 30 frames per second.
const COUNTED: usize = 300;

/// One side of a comparison. Its JSON is part of `compress.json` and of what `bench --playback` prints.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Side {
    pub gaussians: usize,
    /// Gaussians alive (and admitted by masks) at a frame of the clip, mean and most.
    pub active_mean: f64,
    pub active_max: usize,
    /// Of the file: a playback file, or the scene file with its 32-bit floats.
    pub bytes: u64,
    /// `bytes` over the clip's length, 10⁶ bits per second; `None` for a clip without length.
    pub mbit_per_s: Option<f64>,
    /// Four bytes for every number of every table.
    pub float_bytes: u64,
    /// Means over the held-out views, dB; `None` where they were not measured or are not defined.
    pub psnr: Option<f64>,
    pub ssim: Option<f64>,
    /// Of dynamic regions, dB.
    pub psnr_dynamic: Option<f64>,
    /// Mean difference between the change from frame to frame and the truth's, in 1/255.
    pub flicker: Option<f64>,
    /// Mean over some training views, dB.
    pub psnr_train: Option<f64>,
    /// Images a second of the blend stage alone.
    pub raster_fps: f64,
    /// Images a second end to end: who is alive, motion, rendering, 8-bit colours.
    pub fps: f64,
    /// From bytes in memory to the first image, milliseconds.
    pub decode_ms: f64,
    /// Pairs of pixel and Gaussian that the blend loop tests, mean over the images.
    pub pairs: f64,
}

impl Side {
    /// Takes over the scores of an evaluation.
    pub fn scored(mut self, evaluation: &Scores) -> Self {
        [self.psnr, self.ssim, self.psnr_dynamic, self.flicker] =
            ["PSNR", "SSIM", "PSNR-dynamic", "flicker"].map(|name| evaluation.held(name));
        self.psnr_train = evaluation.train("PSNR");
        self
    }

    /// Takes over the newest scores that a run's files hold.
    pub fn scored_by(mut self, run: &Run) -> Self {
        [self.psnr, self.ssim, self.psnr_dynamic, self.flicker] =
            ["PSNR", "SSIM", "PSNR-dynamic", "flicker"].map(|name| run.score(name));
        let train = run.all_results.get("train").and_then(Value::as_object);
        let newest = train.and_then(|t| t.get(&format!("ours_{}", run.iteration()?)));
        self.psnr_train = newest.and_then(|t| t.get("PSNR")).and_then(Value::as_f64);
        self
    }
}

/// Scene or file that is measured.
#[derive(Clone, Debug)]
pub enum What<'a> {
    /// A scene in memory, with its 32-bit floats; played unchanged.
    Scene(&'a Scene<f32>),
    /// The bytes of a playback file; played page by page.
    File(Arc<[u8]>),
}

/// Scene or file that is measured, and how it must be rendered.
#[derive(Clone, Debug)]
pub struct Subject<'a> {
    pub what: What<'a>,
    pub antialias: Antialias,
}

/// A camera and a time.
#[derive(Clone, Debug)]
pub struct MeasuredView {
    pub camera: Camera,
    pub time: Time,
}

/// The source's own cameras over its clip, or an orbit where it names none.
pub fn measured_views_of(source: &Source, size: [usize; 2]) -> Result<Vec<MeasuredView>> {
    let views = source.views()?;
    if !views.is_empty() {
        return Ok(measured_views(&views, source.scene.clip, size));
    }
    let stage = source.stage(&views);
    let orbit =
        |i: usize| View { camera: stage.orbit(i as f64 / VIEWS as f64), name: i.to_string(), time: 0.0, held: false };
    Ok(measured_views(&(0..VIEWS).map(orbit).collect::<Vec<_>>(), source.scene.clip, size))
}

/// Times in the middle of equal parts of the clip, each from another camera: images of this size with the camera's
/// vertical field of view. Panics: no views.
pub fn measured_views(views: &[View], clip: [f64; 2], [width, height]: [usize; 2]) -> Vec<MeasuredView> {
    let mut seen = BTreeSet::new();
    let cameras: Vec<&Camera> = views.iter().filter(|v| seen.insert(v.name.as_str())).map(|v| &v.camera).collect();
    let step = stride(cameras.len());
    let look = |i: usize| {
        let camera = cameras[i * step % cameras.len()];
        let fov_y = 2.0 * (0.5 * camera.height as f64 / camera.intrinsics.fy).atan();
        let time = clip[0] + (clip[1] - clip[0]) * (i as f64 + 0.5) / VIEWS as f64;
        MeasuredView { camera: Camera::with_fov_y(camera.cam_from_world, fov_y, width, height), time: Time(time) }
    };
    (0..VIEWS).map(look).collect()
}

/// From camera to camera: about the golden section of the rig, so that neighbours in time differ in viewpoint, and
/// coprime to their number, so that all take part.
fn stride(cameras: usize) -> usize {
    const GOLDEN: f64 = 0.382;
    let gcd = |mut a: usize, mut b: usize| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let first = ((cameras as f64 * GOLDEN) as usize).max(1);
    (first..).find(|s| gcd(*s, cameras) == 1).expect("a number above the cameras' is coprime to theirs")
}

/// Measures all subjects alternately, with all threads of the current pool; one [`Side`] each, without scores.
/// Panics: no samples.
///
/// Errors: those of the file.
pub fn in_turns(
    subjects: &[Subject<'_>],
    measured_views: &[MeasuredView],
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<Side>> {
    assert!(!measured_views.is_empty(), "a measurement needs at least one view");
    let mut seats = subjects.iter().map(|s| Seat::new(s, measured_views.len())).collect::<Result<Vec<_>>>()?;
    let total = DECODES + ROUNDS + 1;
    for round in 0..DECODES {
        for (seat, subject) in seats.iter_mut().zip(subjects) {
            seat.decode_ms = seat.decode_ms.min(1e3 * first_picture(subject, &seat.stored, &measured_views[0])?);
        }
        progress(round + 1, total);
    }
    for round in 0..=ROUNDS {
        for (i, look) in measured_views.iter().enumerate() {
            for seat in &mut seats {
                let seconds = seat.draw(look)?;
                if round == 0 {
                    seat.pairs += seat.renderer.count_pairs().tested as f64 / measured_views.len() as f64;
                } else {
                    let best = &mut seat.best[i];
                    *best = [best[0].min(seconds[0]), best[1].min(seconds[1])];
                }
            }
        }
        progress(DECODES + round + 1, total);
    }
    seats.into_iter().map(Seat::side).collect()
}

/// A subject while it plays.
struct Seat<'a> {
    side: Side,
    player: Player<'a>,
    /// Stored bytes that a first image is rendered from.
    stored: Arc<[u8]>,
    background: [f32; 3],
    renderer: Renderer<f32>,
    image: Image<f32>,
    rgb: Vec<u8>,
    /// Seconds of the blend stage and of the whole image, by image.
    best: Vec<[f64; 2]>,
    decode_ms: f64,
    pairs: f64,
}

impl<'a> Seat<'a> {
    fn new(subject: &Subject<'a>, measured_views: usize) -> Result<Self> {
        let (side, stored, player) = match &subject.what {
            What::Scene(scene) => {
                let mut stored = Vec::new();
                scene_file::write(scene, &mut stored)?;
                (weighed(scene, stored.len()), Arc::from(stored), Player::of_scene(scene))
            }
            What::File(bytes) => (weighed(&playback::read(bytes)?, bytes.len()), bytes.clone(), open(bytes)?),
        };
        let background = player.meta().background;
        Ok(Self {
            side,
            player,
            stored,
            background,
            renderer: renderer(subject),
            image: Image::default(),
            rgb: Vec::new(),
            best: vec![[f64::INFINITY; 2]; measured_views],
            decode_ms: f64::INFINITY,
            pairs: 0.0,
        })
    }

    /// Renders one image; seconds of the blend stage and of all.
    fn draw(&mut self, look: &MeasuredView) -> Result<[f64; 2]> {
        let clock = Instant::now();
        let splats = self.player.at(look.time)?;
        self.renderer.render(&Shot::new(&splats, &look.camera, self.background), &mut self.image);
        color_into(&self.image.color, &mut self.rgb);
        let all = clock.elapsed().as_secs_f64();
        Ok([self.renderer.stage_seconds().blend, all])
    }

    fn side(mut self) -> Result<Side> {
        let counts = frames(self.player.meta().clip, self.player.meta().fps)
            .into_iter()
            // The pages of a time are loaded with its image.
            .map(|t| self.player.at(t).map(|_| ()).map(|()| self.player.alive(t)))
            .collect::<Result<Vec<usize>>>()?;
        let rate = |k: usize| self.best.len() as f64 / self.best.iter().map(|b| b[k]).sum::<f64>().max(f64::EPSILON);
        Ok(Side {
            active_mean: counts.iter().sum::<usize>() as f64 / counts.len() as f64,
            active_max: counts.iter().copied().max().unwrap_or(0),
            raster_fps: rate(0),
            fps: rate(1),
            decode_ms: self.decode_ms,
            pairs: self.pairs,
            ..self.side
        })
    }
}

/// Sizes and counts that are known without rendering.
fn weighed(scene: &Scene<f32>, bytes: usize) -> Side {
    let numbers = |l: &splat4d::layers::Layer| l.params.keys().map(|k| l.params[k].data().len()).sum::<usize>();
    let seconds = scene.clip[1] - scene.clip[0];
    Side {
        gaussians: scene.len(),
        bytes: bytes as u64,
        mbit_per_s: (seconds > 0.0).then(|| 8e-6 * bytes as f64 / seconds),
        float_bytes: scene.layers.iter().map(|l| 4 * numbers(l) as u64).sum(),
        ..Side::default()
    }
}

/// The times of the clip's frames, thinned evenly where they are many.
pub(crate) fn frames(clip: [f64; 2], fps: f64) -> Vec<Time> {
    let fps = if fps.is_finite() && fps > 0.0 { fps } else { DEFAULT_FPS };
    let last = ((clip[1] - clip[0]) * fps).round().max(0.0);
    let count = last.min((COUNTED - 1) as f64) as usize + 1;
    let share = |i: usize| if count > 1 { i as f64 / (count - 1) as f64 } else { 0.0 };
    (0..count).map(|i| Time(clip[0] + (clip[1] - clip[0]) * share(i))).collect()
}

fn renderer(subject: &Subject<'_>) -> Renderer<f32> {
    Renderer::new(RenderConfig { antialias: subject.antialias, ..RenderConfig::default() })
}

/// Seconds from bytes in memory to an image in 8 bits, by a renderer that has no memory yet.
fn first_picture(subject: &Subject<'_>, stored: &Arc<[u8]>, look: &MeasuredView) -> Result<f64> {
    let clock = Instant::now();
    let (mut renderer, mut image, mut rgb) = (renderer(subject), Image::default(), Vec::new());
    match &subject.what {
        What::Scene(_) => {
            let (scene, mut moment) = (scene_file::read(stored)?, Evaluation::default());
            // A player would first look up which Gaussians are alive, which pays from the second image on.
            scene.at(look.time, &mut moment);
            renderer.render(&Shot::new(&scene.splats(&moment), &look.camera, scene.background), &mut image);
        }
        What::File(_) => {
            let mut player = open(stored)?;
            let background = player.meta().background;
            renderer.render(&Shot::new(&player.at(look.time)?, &look.camera, background), &mut image);
        }
    }
    color_into(&image.color, &mut rgb);
    Ok(clock.elapsed().as_secs_f64())
}

/// A file's bytes that several players share.
struct Shared(Arc<[u8]>);

impl ReadAt for Shared {
    fn read_at(&mut self, offset: u64, out: &mut [u8]) -> Result<()> {
        (&*self.0).read_at(offset, out)
    }
}

fn open<'a>(bytes: &Arc<[u8]>) -> Result<Player<'a>> {
    Player::open(Box::new(Shared(bytes.clone())), bytes.len() as u64, DEFAULT_BUDGET)
}

#[cfg(test)]
mod tests;
