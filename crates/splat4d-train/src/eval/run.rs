//! Evaluation of a scene on a capture: every held-out view is rendered and compared with its image, a few training
//! views too; scores, images and a summary are written in the files of 3DGS.
//!
//! | file | content |
//! |---|---|
//! | `results.json` | [`Report::results`], with `dynamic-share` and `conditions` (split, background, step,
//! instructions, device) in addition; other entries are kept |
//! | `per_view.json` | `Report::per_view`, with `camera` and `time` of every image in addition |
//! | `test/ours_N/{renders,gt,errors}/00000.png` | held-out views, in the capture's order |
//!
//! Other views or another background than the run's own ([`EvalOptions::place`]) are next to: in both files under an
//! entry of that name, as `train` does, and their images in a folder of that name.
//!
//! PSNR is clamped to `[0,1]`, not rounded, per image, then the mean. `PSNR-cc` is the same after the affine colour
//! matrix
//! that suits all measured views of the image's camera best: what remains is not a matter of white balance. It is
//! reported next to the plain one and never instead of it, for it has seen the truth. The dynamic region (pixels that
//! leave their
//! camera's temporal mean) and flicker are defined for fixed cameras only. `PSNR-dynamic-still` is that of this mean in
//! place of the render: what a static image of the camera reaches. Where an image was undistorted, pixels
//! without an original take the truth's colour, so that they count as right in every metric.

use super::align::Align;
use super::colour::{ColourSums, IDENTITY};
use super::metrics::{self, Flicker, TemporalMean};
use super::report::METHOD;
use super::{CameraScores, Conditions, InputScaling, Lpips, Report, Score, Split, View, ViewContext, score_view};
use crate::capture::{Capture, ImageStore, StoredPicture};
use crate::encode::{self, Pixels};
use crate::event::Event;
use crate::run::checkpoint::write_atomically;
use crate::run::corrected;
use crate::step::shutter::{self, Taken};
use crate::train_state::{EXPOSURE_COLUMNS, expose};
use crate::{Error, ErrorKind, Result};
use rayon::prelude::*;
use serde_json::{Value, json};
use splat4d::device::{self, Device, Opened};
use splat4d::format::safetensors::SafeTensors;
use splat4d::layers::{Evaluation, Scene};
use splat4d::render::{Antialias, Backend, Image, RenderConfig, Shot, Simd};
use splat4d::scene::Planes;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Training views that are measured: their mean moves by less than 0.1 dB beyond that.
const TRAIN_VIEWS: usize = 24;
/// A mean difference of the channels as large as this is the last colour of an error image.
const ERROR_FULL: f32 = 0.25;
/// The renderer: figures are the CPU renderer's, which defines the result of the others.
const DEVICE: &str = "CPU";
/// Mask values above this are foreground.
const FOREGROUND: f32 = 0.5;

/// Which of a capture's views are measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Measured {
    /// All that were held out to measure; some training views too.
    #[default]
    Test,
    /// The data set's own validation views.
    Validation,
    /// All training views.
    Train,
}

impl Measured {
    /// `test`, `val` or `train`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Test => "test",
            Self::Validation => "val",
            Self::Train => "train",
        }
    }

    /// Its frames in a capture.
    pub fn frames(self, capture: &Capture) -> &[usize] {
        match self {
            Self::Test => &capture.held,
            Self::Validation => &capture.validation,
            Self::Train => &capture.train,
        }
    }
}

/// Options of an evaluation.
#[derive(Clone, Debug)]
pub struct EvalOptions {
    /// The run's folder.
    pub folder: PathBuf,
    /// Antialiased mode, as the scene was trained.
    pub antialias: bool,
    /// Weights of LPIPS (safetensors); `None`: not computed.
    pub lpips_weights: Option<PathBuf>,
    /// Whether images are written.
    pub pictures: bool,
    /// Most training views measured next to the held-out ones.
    pub train_views: usize,
    /// The views that are measured.
    pub measured: Measured,
    /// Prefix of results and images in their files: `None` for the held-out views on the run's own background, which
    /// are what a run is judged by; otherwise the name of an entry, such as `val` or `test-black`.
    pub place: Option<String>,
    /// How held-out views are aligned, to be measured a second time (`PSNR-aligned`); `None`: not.
    pub align: Option<Align>,
    /// The run whose learnt exposures of photos are applied to what is rendered; `None`: none.
    pub exposures_of: Option<PathBuf>,
    /// The renderer; the metrics are the CPU's.
    pub device: Device,
}

impl Default for EvalOptions {
    fn default() -> Self {
        Self {
            folder: PathBuf::new(),
            antialias: false,
            lpips_weights: None,
            pictures: true,
            train_views: TRAIN_VIEWS,
            measured: Measured::Test,
            place: None,
            align: None,
            exposures_of: None,
            device: Device::Cpu,
        }
    }
}

impl EvalOptions {
    /// The entry of `results.json` that holds the still baseline's scores.
    pub const STILL: &'static str = "still";
}

/// The scores of a scene on a capture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores {
    /// Scores of the held-out views and of some training views.
    pub report: Report,
    /// Share of the held-out pixels that are dynamic; `None` without fixed held-out cameras.
    pub dynamic_share: Option<f64>,
    /// How far held-out cameras were moved for `PSNR-aligned`; `None`: they were not aligned.
    pub aligned: Option<Value>,
}

impl Scores {
    /// A mean over the held-out views; `None` where it is not defined.
    pub fn held(&self, metric: &str) -> Option<f64> {
        mean(&self.report.test, metric)
    }

    /// A mean over the training views that were measured; `None` where it is not defined.
    pub fn train(&self, metric: &str) -> Option<f64> {
        self.report.train.as_ref().and_then(|split| mean(split, metric))
    }
}

fn mean(split: &Split, metric: &str) -> Option<f64> {
    match split.means().0.get(metric) {
        Some(Score::Value(value)) => Some(*value),
        _ => None,
    }
}

/// The purpose of a list's images.
#[derive(Clone, Copy, Debug)]
enum Views<'a> {
    /// All of a split, of which images may be written here.
    Whole(Option<&'a Path>),
    /// Some that were trained on.
    Train,
}

/// Renders and measures the held-out views of `capture` (and a few training views), and writes the files above.
///
/// Errors: an image that cannot be read, weights that do not fit, a folder that cannot be written; `stop` was raised,
/// which is checked before each view.
pub fn evaluate(
    scene: &Scene<f32>,
    capture: &Capture,
    store: &Arc<ImageStore>,
    iteration: usize,
    options: &EvalOptions,
    stop: &AtomicBool,
    listen: &mut dyn FnMut(&Event),
) -> Result<Scores> {
    let evaluation = assess(scene, capture, store, iteration, options, stop, listen)?;
    let Scores { report, dynamic_share, aligned } = &evaluation;
    let (mut results, mut views) = (report.results(), report.per_view());
    let (ours, frames) = (report.method(), options.measured.frames(capture));
    results[&ours]["dynamic-share"] = json!(dynamic_share);
    if let Some(aligned) = aligned {
        results[&ours]["aligned"] = aligned.clone();
    }
    results[&ours]["conditions"] = json!(report.conditions);
    results[&ours]["conditions"]["step"] = json!(report.iteration);
    views[&ours]["camera"] = by_file(frames, |f| json!(capture.cameras[capture.frames[f].camera].name));
    views[&ours]["time"] = by_file(frames, |f| json!(capture.frames[f].time.0));
    if let Some(place) = &options.place {
        (results, views) = (json!({ place: results }), json!({ place: views }));
    }
    merge(&options.folder.join("results.json"), results)?;
    merge(&options.folder.join("per_view.json"), views)?;
    Ok(evaluation)
}

/// The same without the two JSON files; images only if the options request them.
///
/// Errors: those of [`evaluate`].
pub fn assess(
    scene: &Scene<f32>,
    capture: &Capture,
    store: &Arc<ImageStore>,
    iteration: usize,
    options: &EvalOptions,
    stop: &AtomicBool,
    listen: &mut dyn FnMut(&Event),
) -> Result<Scores> {
    let lpips = options.lpips_weights.as_deref().map(load_lpips).transpose()?;
    let place = options.place.as_deref().unwrap_or(Measured::Test.name());
    let folder = options.folder.join(place).join(format!("ours_{iteration}"));
    let exposures = options.exposures_of.as_deref().map(|run| corrected::exposures(capture, run)).transpose()?;
    let mut judge = Judge::new(scene, capture, store, lpips, exposures.unwrap_or_default(), options, stop, listen);
    let whole = Views::Whole(options.pictures.then_some(folder.as_path()));
    let name = match options.measured {
        Measured::Test => "evaluating held-out views",
        Measured::Validation => "evaluating validation views",
        Measured::Train => "evaluating all training views",
    };
    let mut test = judge.split(options.measured.frames(capture), whole, name, listen)?;
    let dynamic_share = judge.dynamic_share();
    let frames = options.measured.frames(capture);
    // Training views keep the poses of training.
    let align = options.align.as_ref().filter(|_| options.measured != Measured::Train && !frames.is_empty());
    let aligned = align.map(|align| judge.align(align, frames, &mut test, listen)).transpose()?;
    let some =
        if options.measured == Measured::Test { spread(&capture.train, options.train_views) } else { Vec::new() };
    let train = judge.split(&some, Views::Train, "evaluating training views", listen)?;
    let conditions = Conditions {
        split: options.measured.name(),
        background: capture.background.map(|_| scene.background),
        simd: Simd::detect().name(),
        device: judge.device,
    };
    let train = (!some.is_empty()).then_some(train);
    std::iter::from_fn(|| judge.backend.notice()).for_each(|message| listen(&Event::Warning { message }));
    let report = Report { iteration: iteration as u64, conditions, test, train };
    Ok(Scores { report, dynamic_share, aligned })
}

struct Judge<'a> {
    scene: &'a Scene<f32>,
    capture: &'a Capture,
    store: &'a Arc<ImageStore>,
    lpips: Option<Lpips>,
    /// By frame.
    exposures: Vec<[f32; EXPOSURE_COLUMNS]>,
    stop: &'a AtomicBool,
    backend: Box<dyn Backend>,
    /// It in words.
    device: String,
    instant: Evaluation<f32>,
    image: Image<f32>,
    /// Pixels seen and dynamic pixels among them.
    dynamic: [usize; 2],
}

impl<'a> Judge<'a> {
    fn new(
        scene: &'a Scene<f32>,
        capture: &'a Capture,
        store: &'a Arc<ImageStore>,
        lpips: Option<Lpips>,
        exposures: Vec<[f32; EXPOSURE_COLUMNS]>,
        options: &EvalOptions,
        stop: &'a AtomicBool,
        listen: &mut dyn FnMut(&Event),
    ) -> Self {
        let antialias = if options.antialias { Antialias::On } else { Antialias::Off };
        let config = RenderConfig { antialias, ..RenderConfig::default() };
        let Opened { backend, name, why, fell_back } = device::open_to_train(options.device, config);
        let why = why.replacen("training", "measuring", 1).replacen("rendering", "measuring", 1);
        match options.device {
            Device::Cpu => {}
            Device::Gpu if fell_back => listen(&Event::Warning { message: why }),
            _ => listen(&Event::Device { name: name.clone(), why }),
        }
        let on_cpu = options.device == Device::Cpu || fell_back;
        Self {
            scene,
            capture,
            store,
            lpips,
            exposures,
            stop,
            backend,
            device: if on_cpu { DEVICE.into() } else { name },
            instant: Evaluation::default(),
            image: Image::default(),
            dynamic: [0; 2],
        }
    }

    fn dynamic_share(&self) -> Option<f64> {
        (self.dynamic[0] > 0).then(|| self.dynamic[1] as f64 / self.dynamic[0] as f64)
    }

    /// Measures the frames, camera by camera in time, so that one temporal mean and one earlier frame are in memory.
    fn split(
        &mut self,
        frames: &[usize],
        kind: Views<'_>,
        name: &str,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Split> {
        self.dynamic = [0; 2];
        let held = matches!(kind, Views::Whole(_));
        let mut views: Vec<Option<View>> = vec![None; frames.len()];
        let (mut flicker, mut by_camera): (Vec<Flicker>, Vec<CameraScores>) = (Vec::new(), Vec::new());
        let mut done = 0;
        for camera in cameras(self.capture, frames) {
            // Temporal means and flicker are scores of new views: training views are a subset, out of order.
            let fixed = held && self.capture.cameras[camera.id].fixed && camera.places.len() > 1;
            let mean = if fixed { Some(self.temporal_mean(frames, &camera.places)?) } else { None };
            let (mut changes, mut colours) = (Flicker::default(), Vec::with_capacity(camera.places.len()));
            self.store.prefetch(&camera.places.iter().map(|&p| frames[p]).collect::<Vec<_>>());
            for &place in &camera.places {
                if self.stop.load(Ordering::SeqCst) {
                    return Err(Error::new(ErrorKind::Interrupted, "evaluation was stopped")
                        .remedy("Run the same command again."));
                }
                let Drawn { view, image, truth, sums } = self.view(&file_name(place), frames[place], mean.as_ref())?;
                colours.push(sums);
                if fixed {
                    changes.push(&image, &truth);
                }
                views[place] = Some(view);
                if let Views::Whole(Some(folder)) = kind {
                    write_images(folder, place, &image, &truth)?;
                }
                done += 1;
                listen(&Event::Phase { name: name.into(), done, total: frames.len() });
            }
            flicker.push(changes);
            let name = &self.capture.cameras[camera.id].name;
            by_camera.push(correct_colours(name, &camera.places, &colours, &mut views));
        }
        let views = views.into_iter().flatten().collect();
        let mut split = Split { views, cameras: by_camera, ..Split::default() };
        if held {
            let reason = "not defined: no held-out camera is fixed and has two frames";
            split.whole.insert("flicker".into(), Score::or(Flicker::over(&flicker), reason));
        }
        Ok(split)
    }

    /// Measures `PSNR-aligned` and `PSNR-dynamic-aligned` of frames that `split` holds. Returns how far they were
    /// moved.
    fn align(
        &mut self,
        align: &Align,
        frames: &[usize],
        split: &mut Split,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Value> {
        let mut progress =
            |done, total| listen(&Event::Phase { name: "aligning held-out cameras".into(), done, total });
        let (scene, store, backend) = (self.scene, self.store, self.backend.as_mut());
        let (capture, report) = align.fit(scene, self.capture, store, frames, backend, &mut progress)?;
        for camera in cameras(&capture, frames) {
            let fixed = capture.cameras[camera.id].fixed && camera.places.len() > 1;
            let mean = if fixed { Some(self.temporal_mean(frames, &camera.places)?) } else { None };
            for place in camera.places {
                let (image, truth, _) = self.draw(&capture, frames[place])?;
                let view = &mut split.views[place];
                view.set("PSNR-aligned", Score::or(metrics::psnr(&image, &truth), "the image has no pixels"));
                if let Some(region) = mean.as_ref().map(|mean| metrics::dynamic_region(&truth, mean)) {
                    let moving = metrics::psnr_region(&image, &truth, &region);
                    view.set("PSNR-dynamic-aligned", Score::or(moving, "not defined: no pixel moves"));
                }
            }
        }
        Ok(report)
    }

    fn temporal_mean(&self, frames: &[usize], places: &[usize]) -> Result<Planes<f32>> {
        let (mut mean, mut truth) = (TemporalMean::default(), Planes::default());
        for &place in places {
            self.store.load(frames[place])?.color_into(&mut truth);
            mean.push(&truth);
        }
        Ok(mean.mean().expect("a camera has at least one frame"))
    }

    /// Renders a frame from where `capture` has it: the render, clean of pixels without truth, the truth, and the sums
    /// of both.
    fn draw(&mut self, capture: &Capture, frame: usize) -> Result<(Planes<f32>, Planes<f32>, ColourSums)> {
        let stored = self.store.load(frame)?;
        let (info, mut truth) = (&capture.frames[frame], Planes::default());
        stored.color_into(&mut truth);
        let (scene, backend) = (self.scene, self.backend.as_mut());
        match &info.shutter {
            None => {
                scene.at(info.time, &mut self.instant);
                let splats = scene.splats(&self.instant);
                backend.render(&Shot::new(&splats, &info.view, scene.background), &mut self.image)?;
            }
            Some(shutter) => {
                let taken = Taken { camera: &info.view, t: info.time, shutter };
                shutter::render(scene, taken, &mut self.instant, backend, &mut self.image)?;
            }
        }
        let mut image = self.image.color.clone();
        if let Some(row) = self.exposures.get(frame) {
            expose(row, &mut image);
        }
        let mut known = Planes::default();
        let known = stored.valid_into(&mut known).then_some(&known);
        let sums = ColourSums::of(&image, &truth, known);
        if let Some(known) = known {
            hide_unknown(&mut image, &truth, known);
        }
        Ok((image, truth, sums))
    }

    /// Renders one frame and measures it.
    fn view(&mut self, name: &str, frame: usize, mean: Option<&Planes<f32>>) -> Result<Drawn> {
        let (image, truth, sums) = self.draw(self.capture, frame)?;
        let stored = self.store.load(frame)?;
        let foreground = foreground(&stored);
        let dynamic = mean.map(|m| metrics::dynamic_region(&truth, m));
        if let Some(region) = &dynamic {
            self.dynamic[0] += region.len();
            self.dynamic[1] += region.iter().filter(|d| **d).count();
        }
        let context = ViewContext {
            foreground: foreground.as_deref(),
            dynamic: dynamic.as_deref(),
            lpips: self.lpips.as_ref().map(|l| (l, InputScaling::Signed)),
        };
        let mut view = score_view(name, &image, &truth, &context);
        if let (Some(mean), Some(region)) = (mean, &dynamic) {
            let still = metrics::psnr_region(mean, &truth, region);
            view.set("PSNR-dynamic-still", Score::or(still, "not defined: no pixel moves"));
        }
        Ok(Drawn { view, image, truth, sums })
    }
}

/// A frame that was rendered and measured.
struct Drawn {
    view: View,
    /// The render, clean of pixels without truth.
    image: Planes<f32>,
    truth: Planes<f32>,
    /// Of the render and the truth.
    sums: ColourSums,
}

/// Fits a camera's colours over all its views (`sums`, one a position), and sets `PSNR-cc` of each of them.
fn correct_colours(name: &str, places: &[usize], sums: &[ColourSums], views: &mut [Option<View>]) -> CameraScores {
    let mut all = ColourSums::default();
    sums.iter().for_each(|view| all.add(view));
    let colour = all.fit();
    let matrix = colour.unwrap_or(IDENTITY);
    for (&place, sums) in places.iter().zip(sums) {
        let view = views[place].as_mut().expect("a camera's views are measured before its colours");
        view.set("PSNR-cc", Score::or(sums.psnr(&matrix), "the image has no pixels"));
    }
    CameraScores { name: name.into(), places: places.to_vec(), colour }
}

/// A camera and the positions of its frames in a list, in time.
struct CameraFrames {
    id: usize,
    places: Vec<usize>,
}

fn cameras(capture: &Capture, frames: &[usize]) -> Vec<CameraFrames> {
    let mut out: Vec<CameraFrames> = Vec::new();
    for (place, &frame) in frames.iter().enumerate() {
        let id = capture.frames[frame].camera;
        match out.iter_mut().find(|c| c.id == id) {
            Some(camera) => camera.places.push(place),
            None => out.push(CameraFrames { id, places: vec![place] }),
        }
    }
    for camera in &mut out {
        camera.places.sort_by(|&a, &b| capture.frames[frames[a]].time.0.total_cmp(&capture.frames[frames[b]].time.0));
    }
    out
}

/// Pixels that the original image does not cover take the truth's colour.
fn hide_unknown(render: &mut Planes<f32>, truth: &Planes<f32>, known: &Planes<f32>) {
    for c in 0..render.channels {
        for ((r, t), v) in render.plane_mut(c).iter_mut().zip(truth.plane(c)).zip(&known.data) {
            *r = *r * v + t * (1.0 - v);
        }
    }
}

fn foreground(stored: &StoredPicture) -> Option<Vec<bool>> {
    let mut mask = Planes::default();
    stored.mask_into(&mut mask).then(|| mask.data.iter().map(|m| *m > FOREGROUND).collect())
}

fn load_lpips(path: &Path) -> Result<Lpips> {
    let bytes = crate::files::read(path).map_err(|e| e.at("the LPIPS weights"))?;
    let file = SafeTensors::read(&bytes).map_err(|e| e.at(path.display()))?;
    let tensor = |name: &str| {
        let tensor = file.tensor(name).ok()?;
        Some((tensor.shape().to_vec(), tensor.as_f32().ok()?.to_vec()))
    };
    Lpips::load(tensor).map_err(|e| e.at(path.display()))
}

fn file_name(place: usize) -> String {
    format!("{place:05}.png")
}

fn write_images(folder: &Path, place: usize, render: &Planes<f32>, truth: &Planes<f32>) -> Result<()> {
    let error = metrics::error_map(render, truth, ERROR_FULL);
    let all = [("renders", render), ("gt", truth), ("errors", &error)];
    all.into_par_iter()
        .try_for_each(|(kind, picture)| write_atomically(&folder.join(kind).join(file_name(place)), &png(picture)))
}

fn png(picture: &Planes<f32>) -> Vec<u8> {
    let data: Vec<u8> = picture.interleaved().iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    encode::png(Pixels::Eight(&data), [picture.width, picture.height], 3)
}

/// One value an image, by its file name.
fn by_file(frames: &[usize], value: impl Fn(usize) -> Value) -> Value {
    frames.iter().enumerate().map(|(place, &frame)| (file_name(place), value(frame))).collect()
}

/// Puts entries into a JSON file that may hold others.
pub(super) fn merge(path: &Path, entries: Value) -> Result<()> {
    // A damaged file is replaced: everything in it can be measured again.
    let old = crate::files::read_text(path).ok().and_then(|text| serde_json::from_str::<Value>(&text).ok());
    let mut all = old.filter(Value::is_object).unwrap_or_else(|| json!({}));
    if let (Value::Object(all), Value::Object(entries)) = (&mut all, entries) {
        for (name, entry) in entries {
            match (all.get_mut(&name), entry) {
                // Entries next to the run's own hold one for each step, of which the others stay.
                (Some(Value::Object(old)), Value::Object(new)) if !name.starts_with(METHOD) => old.extend(new),
                (_, entry) => drop(all.insert(name, entry)),
            }
        }
    }
    write_atomically(path, format!("{all:#}\n").as_bytes())
}

/// At most `count` of these, spread evenly.
fn spread(frames: &[usize], count: usize) -> Vec<usize> {
    let n = frames.len();
    if n <= count {
        return frames.to_vec();
    }
    (0..count).map(|i| frames[i * n / count]).collect()
}
