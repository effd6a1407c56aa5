//! A scene becomes a playback file: baked, written, read back and compared with its model.
//!
//! The number of segments follows from the size limit and the requested PSNR against the model. The model is sampled
//! once, [`Curve`] gives segments and error at every price of a segment, and one comparison of renders calibrates it.

use crate::deadline::Deadline;
use crate::draw::{Painter, color_rgb};
use crate::events::Listener;
use crate::files::{self, grouped, human_bytes};
use crate::folding::fold;
use crate::paths::{Stage, View};
use crate::run_folder::Run;
use crate::sound;
pub use crate::sound::SoundChoice;
use crate::source::{Source, Surroundings, not_empty};
use serde_json::{Value, json};
use splat4d::bake::{self, Bakery, Curve, Cut, Options, Shown};
use splat4d::device;
use splat4d::format::playback::{
    self, Draft, Meta, NamedCamera, Pages, PathKey, Viewpoint, WriteConfig, feature_ranges,
};
use splat4d::layers::{Evaluation, Scene};
use splat4d::render::{Antialias, RenderConfig};
use splat4d::scene::{Camera, GEOMETRY, Time};
use splat4d::{Error, Result};
use splat4d_train::encode;
use std::path::Path;

/// Cameras that are static and times at which baked and model are compared; every one costs two renders.
const COMPARED_CAMERAS: usize = 4;
const COMPARED_TIMES: usize = 6;
/// The same of poses of a camera that moves, each at its own time; and of fixed cameras next to it.
const COMPARED_POSES: usize = 12;
const COMPARED_BESIDE: usize = 2;
/// Longer side of those renders, pixels.
const COMPARED_SIDE: usize = 800;
/// Most bytes of a poster: it is first in the file.
const POSTER_BYTES: usize = 30 << 10;
/// Longer side of a poster and JPEG qualities, tried in turn until it is small enough.
const POSTERS: [(usize, u8); 5] = [(640, 85), (640, 70), (480, 70), (320, 60), (160, 50)];
/// Most cameras that the file names: a player lists them.
const NAMED_CAMERAS: usize = 200;
/// Keys of the default path, an orbit, and seconds from key to key.
const PATH_KEYS: usize = 16;
const PATH_STEP: f64 = 0.75;

/// A file is to be so like its model, dB: what is lost by baking then hides behind what training leaves.
pub const LIKE: f64 = 40.0;
/// Target of a cut beyond that, dB.
const MARGIN: f64 = 0.3;
/// A file may have the bytes of the learned scene and this many for each second of the clip: 12 Mbit/s, the rate of a
/// streamed film of 1080 to 2160 lines.
const BYTES_A_SECOND: f64 = 1.5e6;
/// Bytes of a primitive, its share of the palette included, until the first file is written (docs/format.md: 32 before
/// deflate).
const BYTES_A_PRIMITIVE: f64 = 28.0;
/// Cuts that are tried: the first, one that is calibrated by it, and one that corrects its error.
const CUTS: usize = 3;
/// A file this much larger than it may be is cut again.
const TOO_LARGE: f64 = 1.03;
/// A finer cut is tried where it may have this many times the primitives.
const FINER: f64 = 1.05;
/// A file this much more like its model than requested, dB, is cut again, coarser.
const SPARE: f64 = 2.0;
/// Of the seconds that are left for baking, what the first sampling of the model may take. Sampling between frames,
/// fitting, packing and comparing take the rest.
const SAMPLING: f64 = 0.25;
/// The same of renders that measure how strongly images react to errors, of fixed cameras and of one that moves; and
/// how many ordinary renders one of them takes.
const WEIGHING: f64 = 0.1;
/// See [`WEIGHING`].
const WEIGHING_RENDERS: f64 = 3.0;
/// Seconds in which a primitive is fitted and packed, on a slow machine; and the share of the remaining time for it.
const SECONDS_A_PRIMITIVE: f64 = 4e-5;
const FITTING: f64 = 0.4;
/// Another cut takes about as long as the last one took, and this many times it is kept for it.
const AGAIN: f64 = 1.3;

/// Settings of baking and packing a scene.
#[derive(Clone, Debug)]
pub struct Baking {
    pub options: Options,
    /// Split by this error, pixels, whatever it costs. None: by bytes and likeness.
    pub tolerance: Option<f64>,
    /// Most bytes of the file. None: [`budget`].
    pub bytes: Option<u64>,
    /// Most entries of the palette.
    pub palette: usize,
    pub poster: bool,
    /// Rates of a bitrate ladder, Mbit/s, rising; empty: none.
    pub ladder: Vec<f64>,
    /// What is heard; only [`bake`](fn@bake) uses it.
    pub sound: SoundChoice,
    /// When it is to be done.
    pub deadline: Deadline,
}

impl Default for Baking {
    fn default() -> Self {
        Self {
            options: Options::default(),
            tolerance: None,
            bytes: None,
            palette: WriteConfig::default().palette,
            poster: true,
            ladder: Vec::new(),
            sound: SoundChoice::Kept,
            deadline: Deadline::default(),
        }
    }
}

/// Bytes that the file of a scene may have: those of its tables in 32-bit floats, and a rate for its clip.
pub fn budget(scene: &Scene<f32>) -> u64 {
    let numbers =
        |l: &splat4d::layers::Layer| l.params.keys().map(|k| l.params[k].rows() * l.params[k].width()).sum::<usize>();
    let learned = 4 * scene.layers.iter().map(numbers).sum::<usize>();
    let seconds = scene.clip[1] - scene.clip[0];
    learned as u64 + if seconds > 0.0 { (BYTES_A_SECOND * seconds) as u64 } else { 0 }
}

/// A baked scene as a file's bytes, and what became of it.
pub struct Packed {
    pub bytes: Vec<u8>,
    pub baked: bake::Baked,
    summary: playback::Summary,
    antialias: bool,
    /// The price of a segment, and what the curve states of it: primitives and error.
    at: Option<(f64, [f64; 2])>,
}

/// Bakes a scene and packs it, without comparing the result. The options' cameras are the source's.
pub fn pack(source: &Source, title: &str, baking: &Baking, console: &dyn Listener) -> Result<Packed> {
    pack_scene(&source.scene, source, title, baking, console)
}

/// The same of another scene in the source's place.
pub fn pack_scene(
    scene: &Scene<f32>,
    source: &Source,
    title: &str,
    baking: &Baking,
    console: &dyn Listener,
) -> Result<Packed> {
    let views = source.views()?;
    let options = options(scene, baking, &views);
    let kitchen = Kitchen { scene, source, views: &views, title, baking, console };
    let mut bakery = Bakery::new(scene, &options)?;
    let curve = kitchen.curve(&mut bakery)?;
    let price = curve.as_ref().map(|curve| kitchen.first_price(curve));
    kitchen.pack(&bakery, curve.as_ref(), price)
}

/// The options with the source's cameras, and as many samples and renders of the model as the time allows.
fn options(scene: &Scene<f32>, baking: &Baking, views: &[View]) -> Options {
    let Cameras { still, path } = Cameras::of(views);
    let cameras = still.iter().map(|v| v.camera.clone()).collect();
    let path = path.iter().map(|v| (v.time, v.camera.clone())).collect();
    let mut options = Options { cameras, path, ..baking.options.clone() };
    let deadline = &baking.deadline;
    if deadline.is_set() {
        let mut instant = Evaluation::default();
        let middle = Time(0.5 * (scene.clip[0] + scene.clip[1]));
        // The first one is a warm-up.
        scene.at(middle, &mut instant);
        let began = deadline.now();
        scene.at(middle, &mut instant);
        let seconds = (deadline.now() - began).max(f64::MIN_POSITIVE);
        let most = SAMPLING * deadline.left().max(0.0) / seconds * scene.len() as f64;
        options.samples = options.samples.min(most as usize);
        if let Some(view) = views.first() {
            let mut painter = Painter::new(scene, scene.background, false, false);
            let began = deadline.now();
            painter.draw(&view.camera, view.time);
            let each = WEIGHING_RENDERS * (deadline.now() - began).max(f64::MIN_POSITIVE);
            options.renders = options.renders.min((WEIGHING * deadline.left().max(0.0) / each) as usize);
        }
    }
    options
}

/// A scene that is made into files.
struct Kitchen<'a> {
    scene: &'a Scene<f32>,
    source: &'a Source,
    views: &'a [View],
    title: &'a str,
    baking: &'a Baking,
    console: &'a dyn Listener,
}

impl Kitchen<'_> {
    /// Price of segments, unless cut by a tolerance.
    fn curve(&self, bakery: &mut Bakery<'_>) -> Result<Option<Curve>> {
        match self.baking.tolerance {
            Some(_) => Ok(None),
            None => bakery.measure(&mut |done, total| self.console.phase("sampling the motion", done, total)),
        }
    }

    /// Most primitives of a file, by its bytes and by the time that is left.
    fn most(&self, bytes_a_primitive: f64) -> f64 {
        let bytes = self.baking.bytes.unwrap_or_else(|| budget(self.scene)) as f64;
        let left = self.baking.deadline.left().max(0.0);
        (bytes / bytes_a_primitive).min(FITTING * left / SECONDS_A_PRIMITIVE)
    }

    /// The price that the curve requests, before anything was compared.
    fn first_price(&self, curve: &Curve) -> f64 {
        let wanted = curve.price_for(mse(LIKE + MARGIN)).unwrap_or(0.0);
        wanted.max(curve.price_of(self.most(BYTES_A_PRIMITIVE)))
    }

    fn pack(&self, bakery: &Bakery<'_>, curve: Option<&Curve>, price: Option<f64>) -> Result<Packed> {
        let (scene, console, baking) = (self.scene, self.console, self.baking);
        let cut = match price {
            Some(price) => Cut::Price(price),
            None => Cut::Tolerance(baking.tolerance.unwrap_or(baking.options.tolerance)),
        };
        let mut baked = bakery.bake(cut, &mut |done, total| console.phase("baking", done, total))?;
        if scene.layers.iter().any(|l| l.masks.is_some()) {
            console.warn(
                "the scene's masks are not baked: Gaussians that they leave out are rendered. Its own .s4d has them.",
            );
        }
        let antialias = self.source.antialias();
        let (stage, named) = (self.source.stage(self.views), distinct(self.views));
        let meta = meta(scene, &Outline::of_baked(&baked, scene), &stage, &named);
        let poster = baking.poster.then(|| poster(scene, &stage, antialias)).flatten();
        console.phase("writing", 0, 0);
        let draft = Draft {
            meta: Meta { title: self.title.to_owned(), ..meta },
            nodes: std::mem::take(&mut baked.nodes),
            poster,
        };
        let config = WriteConfig {
            palette: baking.palette,
            ladder: baking.ladder.iter().map(|rate| ladder::MEGA * rate).collect(),
            later: self.source.sound.as_ref().map_or(0, |s| s.mp4.len() as u64),
            ..WriteConfig::default()
        };
        let mut bytes = Vec::new();
        let summary = playback::write(&draft, &config, &mut bytes)?;
        let at = price.zip(curve).map(|(price, curve)| (price, curve.at(price)));
        Ok(Packed { bytes, baked, summary, antialias, at })
    }
}

/// The mean squared error of a PSNR.
fn mse(psnr: f64) -> f64 {
    10f64.powf(-0.1 * psnr)
}

/// Bakes a run or a scene file into the file `out`, and writes how well as JSON into `report`; returns the same.
///
/// Errors: a name that is not one of a playback file; no scene; an empty one; files of the input in the place of
/// outputs.
pub fn bake(from: &Path, out: &Path, report: Option<&Path>, baking: &Baking, listener: &dyn Listener) -> Result<Value> {
    if !files::is_playback(out) && !files::is_stream(out) {
        return Err(Error::input("the name does not end in .s4d")
            .at(out.display())
            .remedy("Use option `output` NAME.s4d."));
    }
    ladder::check(&baking.ladder)?;
    let mut source = Source::open(from)?;
    not_empty(&source.scene, from)?;
    let read = if let SoundChoice::File(file) = &baking.sound { vec![file.as_path()] } else { Vec::new() };
    source.keep_all(from, &std::iter::once(out).chain(report).collect::<Vec<_>>(), &read)?;
    source.sound = sound::chosen(source.sound.take(), &baking.sound, &source.scene, out, listener)?;
    fold(&mut source, "a playback file", &baking.deadline, listener)?;
    if baking.options.repeat > 1 && source.sound.take().is_some() {
        listener.result("the sound is left out: option `repeat` repeats the clip, and would need it repeated");
    }
    let value = bake_into(&source, &title(&source, from), out, baking, listener)?;
    if let Some(path) = report {
        files::write(path, format!("{value:#}").as_bytes())?;
        listener.written(path);
    }
    Ok(value)
}

/// Bytes of a file that uses the highest rate of a ladder; none without one, or where [`budget`] is more.
fn highest(scene: &Scene<f32>, baking: &Baking) -> Option<u64> {
    let frame = if scene.fps > 0.0 && scene.fps.is_finite() { 1.0 / scene.fps } else { 0.0 };
    let seconds = (scene.clip[1] - scene.clip[0] + frame) * baking.options.repeat as f64;
    let bytes = (baking.ladder.last()? * ladder::MEGA / 8.0 * seconds.max(1.0)) as u64;
    Some(bytes.max(budget(scene)))
}

/// Bakes into the file `out` and states how well; returns the report. The options' cameras are the source's.
pub fn bake_into(source: &Source, title: &str, out: &Path, baking: &Baking, console: &dyn Listener) -> Result<Value> {
    let started = baking.deadline.now();
    ladder::check(&baking.ladder)?;
    let bytes = baking.bytes.or_else(|| highest(&source.scene, baking));
    let peel = baking.options.peel || !baking.ladder.is_empty();
    let baking = &Baking { bytes, options: Options { peel, ..baking.options.clone() }, ..baking.clone() };
    let baking = &Baking { bytes: sound::left(source.sound.as_ref(), baking.bytes)?, ..baking.clone() };
    let Cooked { packed, likeness, needs } = bake_like(source, title, baking, console)?;
    let Packed { mut bytes, baked, summary, antialias, .. } = packed;
    if source.provenance.is_some() || source.sound.is_some() {
        bytes = playback::with_extras(&bytes, source.provenance.as_ref(), source.sound.as_ref())?;
    }
    let rungs = if baking.ladder.is_empty() {
        Vec::new()
    } else {
        ladder::report(&bytes, &compared(source)?, &baking.deadline, console)?
    };
    files::write(out, &bytes)?;
    let seconds = baking.deadline.now() - started;
    console.clear();
    let report = &baked.report;
    let quantised: serde_json::Map<String, Value> = summary
        .errors
        .named()
        .iter()
        .map(|(name, e)| ((*name).to_owned(), json!({"rms": e.rms, "max": e.max})))
        .collect();
    let mut value = json!({
        "type": "baked", "file": out.to_string_lossy(), "bytes": bytes.len(), "seconds": seconds, "clip": baked.clip,
        "bytes_per_primitive": summary.bytes as f64 / report.primitives.max(1) as f64,
        "pages": summary.pages, "page_bytes": summary.page_bytes, "palette_entries": summary.palette_entries,
        "palette_bytes": summary.palette_bytes, "poster_bytes": summary.poster_bytes, "baking": report,
        "sound_bytes": source.sound.as_ref().map_or(0, |s| s.mp4.len()),
        "likeness": likeness, "needs": needs, "quantisation": quantised,
    });
    if !rungs.is_empty() {
        value["ladder"] = json!(rungs);
    }
    print_summary(report, likeness.as_ref(), summary.bytes, seconds, console);
    ladder::in_words(&rungs).iter().for_each(|line| console.result(line));
    ladder::notes(&rungs, &baking.ladder).iter().for_each(|line| console.result(line));
    if let Some(sound) = &source.sound {
        console.result(&format!("sound: {}", sound::in_words(sound)));
    }
    if report.primitives == 0 {
        console.warn("no Gaussian of the scene is visible at any time of the clip: the file renders as background.");
    }
    if let (Some(needs), Some(l)) = (needs, &likeness) {
        console.result(&needs.in_words(l.psnr, summary.bytes));
    }
    if antialias {
        console.warn(
            "the run was trained with antialias = true, which playback files cannot store: thin structures look \
             stronger in the player.",
        );
    }
    console.emit(&value);
    console.written(out);
    Ok(value)
}

/// Requirements of a file that is less like its model than requested.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Needs {
    /// dB.
    psnr: f64,
    /// Bytes of such a file, about.
    bytes: u64,
    /// Whether it needs more than that: the curve ends before.
    more: bool,
}

impl Needs {
    fn in_words(self, psnr: f64, bytes: u64) -> String {
        let more = if self.more { "more than" } else { "about" };
        format!(
            "{psnr:.1} dB against the model at {}; {} dB needs {more} {} (option `size`)",
            human_bytes(bytes),
            self.psnr,
            human_bytes(self.bytes)
        )
    }
}

/// A file, how like its model it is, and what it would take to be as like it as requested, where it is not.
pub struct Cooked {
    pub packed: Packed,
    pub likeness: Option<bake::Likeness>,
    pub needs: Option<Needs>,
}

impl Cooked {
    /// Greater is better: within its bytes, then as like its model as requested, then small.
    fn rank(&self, most: f64) -> [f64; 3] {
        let bytes = self.packed.bytes.len() as f64;
        let psnr = self.likeness.as_ref().map_or(0.0, |l| l.psnr);
        [f64::from(u8::from(bytes <= TOO_LARGE * most)), psnr.min(LIKE), -bytes]
    }
}

/// Bakes and packs a scene within its bytes and time, and compares it with its model. Cuts it again where the first cut
/// was further off than a comparison can measure, without sampling the model again.
pub fn bake_like(source: &Source, title: &str, baking: &Baking, console: &dyn Listener) -> Result<Cooked> {
    let (scene, deadline) = (&source.scene, &baking.deadline);
    let views = source.views()?;
    let stage = source.stage(&views);
    let options = options(scene, baking, &views);
    let kitchen = Kitchen { scene, source, views: &views, title, baking, console };
    let mut bakery = Bakery::new(scene, &options)?;
    let curve = kitchen.curve(&mut bakery)?;
    let mut price = curve.as_ref().map(|curve| kitchen.first_price(curve));
    let mut best: Option<Cooked> = None;
    let most = baking.bytes.unwrap_or_else(|| budget(scene)) as f64;
    for round in 1..=CUTS {
        let began = deadline.now();
        let packed = kitchen.pack(&bakery, curve.as_ref(), price)?;
        let likeness = compare(scene, &packed.bytes, &stage, &views, packed.antialias, deadline, console)?;
        let bytes = packed.bytes.len() as f64;
        let mut needs = None;
        let mut next = None;
        if let (Some(curve), Some((at, [pieces, error])), Some(like)) = (&curve, packed.at, &likeness) {
            // The difference beyond that of the segments is due to rounding, and stays.
            let scale = mse(like.psnr) / error.max(f64::MIN_POSITIVE);
            let wanted = curve.price_for(mse(LIKE + MARGIN) / scale);
            let each = bytes / packed.baked.report.primitives.max(1) as f64;
            let affordable = curve.price_of(kitchen.most(each));
            let then = wanted.unwrap_or(0.0).max(affordable);
            let [more, _] = curve.at(then);
            let coarser = bytes > TOO_LARGE * most || like.psnr > LIKE + SPARE;
            if coarser && FINER * more < pieces || like.psnr < LIKE && more > FINER * pieces {
                next = Some(then).filter(|then| *then != at);
            }
            if like.psnr < LIKE {
                let [pieces, _] = curve.at(wanted.unwrap_or(0.0));
                needs = Some(Needs { psnr: LIKE, bytes: (each * pieces) as u64, more: wanted.is_none() });
            }
        }
        let cooked = Cooked { packed, likeness, needs };
        if best.as_ref().is_none_or(|b| cooked.rank(most) > b.rank(most)) {
            best = Some(cooked);
        }
        let Some(then) = next.filter(|_| round < CUTS && deadline.left() > AGAIN * (deadline.now() - began)) else {
            break;
        };
        price = Some(then);
    }
    Ok(best.expect("one file was packed"))
}

fn print_summary(
    report: &bake::Report,
    likeness: Option<&bake::Likeness>,
    bytes: u64,
    seconds: f64,
    console: &dyn Listener,
) {
    let mut words = format!(
        "{} Gaussians became {} primitives in {} time segments, {} in {seconds:.1} s",
        grouped(report.gaussians),
        grouped(report.primitives),
        grouped(report.nodes),
        human_bytes(bytes)
    );
    for (count, what) in [
        (report.split, "were split"),
        (report.key_states, "primitives last one frame only"),
        (report.unseen, "are never seen"),
    ] {
        if count > 0 {
            words += &format!("; {} {what}", grouped(count));
        }
    }
    console.result(&words);
    let e = &report.errors;
    if e.worst > 0.0 {
        let tolerance = report.tolerance.map(|t| format!(" (tolerance {t:.3} px)")).unwrap_or_default();
        console.result(&format!(
            "error per Gaussian: median {:.3} px, 99 of 100 below {:.3} px, worst {:.3} px{tolerance}",
            e.median, e.p99, e.worst
        ));
    }
    if let Some(l) = likeness {
        console.result(&format!(
            "the file against its model: {:.2} dB over {} renders, {:.2} dB in the worst ({:.2} s)",
            l.psnr, l.pictures, l.worst_psnr, l.worst_time
        ));
    }
}

/// Reads the file back and compares what it shows with what the model shows, as far as there is time.
fn compare(
    scene: &Scene<f32>,
    bytes: &[u8],
    stage: &Stage,
    views: &[View],
    antialias: bool,
    deadline: &Deadline,
    console: &dyn Listener,
) -> Result<Option<bake::Likeness>> {
    if deadline.left() <= 0.0 {
        console.result("the file is not compared with its model: no time is left of option `minutes`");
        return Ok(None);
    }
    likeness(scene, &playback::read(bytes)?, &shots(scene, stage, views), antialias, &mut |done, total| {
        console.phase("comparing with the model", done, total);
        deadline.left() > 0.0
    })
}

/// Compares what a file shows with what its scene shows, until `go_on` states no; it is given how many renders are
/// done, of how many.
pub fn likeness(
    scene: &Scene<f32>,
    played: &Scene<f32>,
    shots: &[(f64, Camera)],
    antialias: bool,
    go_on: &mut dyn FnMut(usize, usize) -> bool,
) -> Result<Option<bake::Likeness>> {
    let antialias = if antialias { Antialias::On } else { Antialias::Off };
    let mut cpu = device::cpu(RenderConfig { antialias, ..RenderConfig::default() });
    bake::compare(scene, Shown::File(played), shots, cpu.as_mut(), go_on)
}

/// Cameras and times by which a file is compared with its scene: those of the data set, else an orbit.
pub fn compared(source: &Source) -> Result<Vec<(f64, Camera)>> {
    let views = source.views()?;
    Ok(shots(&source.scene, &source.stage(&views), &views))
}

/// Cameras and times of a comparison: fixed cameras at times over the clip, one that moves where it was at each.
fn shots(scene: &Scene<f32>, stage: &Stage, views: &[View]) -> Vec<(f64, Camera)> {
    let small = |c: &Camera| c.downscaled(c.width.max(c.height).div_ceil(COMPARED_SIDE).max(1));
    let Cameras { still, path } = Cameras::of(views);
    let most = if path.is_empty() { COMPARED_CAMERAS } else { COMPARED_BESIDE };
    let mut cameras: Vec<Camera> =
        still.iter().step_by(still.len().div_ceil(most).max(1)).map(|v| small(&v.camera)).collect();
    if views.is_empty() {
        cameras = (0..COMPARED_CAMERAS).map(|i| stage.orbit(i as f64 / COMPARED_CAMERAS as f64)).collect();
    }
    let [from, to] = scene.clip;
    // In the middle of equal parts: neither only on frames nor only between them.
    let mut times: Vec<f64> =
        (0..COMPARED_TIMES).map(|i| from + (to - from) * (i as f64 + 0.5) / COMPARED_TIMES as f64).collect();
    times.dedup();
    let mut shots: Vec<(f64, Camera)> =
        times.iter().flat_map(|t| cameras.iter().map(|camera| (*t, camera.clone()))).collect();
    // The same of poses: every second one on its way to the next frame.
    let part = if scene.fps > 0.0 && scene.fps.is_finite() { 0.5 / scene.fps } else { 0.0 };
    let poses = path.iter().step_by(path.len().div_ceil(COMPARED_POSES).max(1)).enumerate();
    shots.extend(poses.map(|(i, v)| ((v.time + part * (i % 2) as f64).min(to), small(&v.camera))));
    shots.sort_by(|a, b| a.0.total_cmp(&b.0));
    shots
}

/// Cameras that are static, each once, and the poses of cameras that move, by time.
#[derive(Debug)]
struct Cameras<'a> {
    still: Vec<&'a View>,
    path: Vec<&'a View>,
}

impl<'a> Cameras<'a> {
    fn of(views: &'a [View]) -> Self {
        let mut first = std::collections::BTreeMap::new();
        let mut moves = std::collections::BTreeSet::new();
        for view in views {
            let pose = view.camera.cam_from_world;
            if *first.entry(view.name.as_str()).or_insert(pose) != pose {
                moves.insert(view.name.as_str());
            }
        }
        let still = distinct(views).into_iter().filter(|v| !moves.contains(v.name.as_str())).collect();
        let mut path: Vec<&View> = views.iter().filter(|v| moves.contains(v.name.as_str())).collect();
        path.sort_by(|a, b| a.time.total_cmp(&b.time));
        Self { still, path }
    }
}

/// Every camera once, by name, spread over the rig where there are too many.
pub fn distinct(views: &[View]) -> Vec<&View> {
    let mut seen = std::collections::BTreeSet::new();
    let all: Vec<&View> = views.iter().filter(|v| seen.insert(v.name.as_str())).collect();
    let stride = all.len().div_ceil(NAMED_CAMERAS).max(1);
    all.into_iter().step_by(stride).collect()
}

/// Properties that a file states of its Gaussians as a whole.
pub struct Outline {
    pub clip: [f64; 2],
    pub sh_degree: usize,
    /// Least and greatest corner of the means, without those of a far shell.
    pub bounds: Option<[[f64; 3]; 2]>,
}

impl Outline {
    fn of_baked(baked: &bake::Baked, scene: &Scene<f32>) -> Self {
        let means = baked.nodes.iter().flat_map(|n| &n.primitives).map(|p| p.mean);
        Self { clip: baked.clip, sh_degree: baked.sh_degree, bounds: bounds(means, scene) }
    }

    /// Of pages of a scene that are to be written.
    pub fn of_pages(pages: &Pages, scene: &Scene<f32>) -> Self {
        let tables = pages.layers.iter().map(|l| &l.params[GEOMETRY]);
        let means = tables.flat_map(|t| (0..t.rows()).map(|row| t.read::<3>(row, 0).map(f64::from)));
        let sh_degree = pages.palette.as_ref().map_or(0, |p| p.degree);
        Self { clip: pages.meta.clip, sh_degree, bounds: bounds(means, scene) }
    }
}

/// Metadata of the scene, as the file states it.
pub fn meta(scene: &Scene<f32>, outline: &Outline, stage: &Stage, views: &[&View]) -> Meta {
    let look = |share: f64| {
        let camera = stage.orbit(share);
        let fov = 2.0 * (0.5 * camera.height as f64 / camera.intrinsics.fy).atan();
        Viewpoint { position: camera.center(), target: stage.center, up: stage.up, fov_y: fov.to_degrees() }
    };
    let key = |i: usize| {
        let Viewpoint { position, target, up, fov_y } = look(i as f64 / PATH_KEYS as f64);
        PathKey { at: i as f64 * PATH_STEP, position, target, up, fov_y, time: None }
    };
    let fps = if scene.fps > 0.0 && scene.fps.is_finite() { scene.fps } else { splat4d::scene::time::DEFAULT_FPS };
    Meta {
        clip: outline.clip,
        fps,
        up: scene.up,
        offset: scene.offset,
        background: scene.background,
        sh_degree: outline.sh_degree,
        bounds: outline.bounds,
        predicted: scene.predicted_from(),
        labels: scene.labels.clone(),
        features: feature_ranges(scene),
        view: Some(look(0.0)),
        cameras: views.iter().map(|v| NamedCamera::new(&v.name, &v.camera)).collect(),
        // The last key is the first again, so that the orbit closes.
        path: (0..=PATH_KEYS).map(key).collect(),
        ..Meta::default()
    }
}

/// Least and greatest corner of the means that do not belong to the scene's far shell.
fn bounds(means: impl Iterator<Item = [f64; 3]>, scene: &Scene<f32>) -> Option<[[f64; 3]; 2]> {
    let near = Surroundings::of(scene);
    means.filter(|m| near.is_none_or(|near| near.holds(*m))).fold(None, |b: Option<[[f64; 3]; 2]>, m| {
        let [low, high] = b.unwrap_or([m, m]);
        Some([std::array::from_fn(|k| low[k].min(m[k])), std::array::from_fn(|k| high[k].max(m[k]))])
    })
}

/// The first view at the clip's start as a JPEG that is small enough.
pub fn poster(scene: &Scene<f32>, stage: &Stage, antialias: bool) -> Option<Vec<u8>> {
    let mut painter = Painter::new(scene, scene.background, antialias, false);
    let camera = stage.orbit(0.0);
    POSTERS.iter().find_map(|&(side, quality)| {
        let shrink = camera.width.max(camera.height).div_ceil(side).max(1);
        painter.draw(&camera.downscaled(shrink), scene.clip[0]);
        let rgb = color_rgb(&painter.image.color);
        let bytes = encode::jpeg(&rgb.data, [rgb.width, rgb.height], quality).ok()?;
        (bytes.len() <= POSTER_BYTES).then_some(bytes)
    })
}

/// Title of the scene for people: the capture's name, or the file's.
pub fn title(source: &Source, path: &Path) -> String {
    let stem = || path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    source.run.as_ref().map_or_else(stem, Run::name)
}

pub(crate) mod ladder;
#[cfg(test)]
mod tests;
