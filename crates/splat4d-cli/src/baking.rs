//! A scene becomes a playback file: baked, written, read back and compared with its model.

use crate::console::Console;
use crate::draw::{Painter, color_rgb};
use crate::files::{self, grouped, human_bytes};
use crate::paths::{Stage, View};
use crate::run_folder::Run;
use crate::source::Source;
use image::codecs::jpeg::JpegEncoder;
use serde_json::{Value, json};
use splat4d::bake::{self, Options, Shown, bake};
use splat4d::device;
use splat4d::format::playback::{self, Draft, Meta, NamedCamera, Pages, PathKey, Viewpoint, WriteConfig};
use splat4d::layers::Scene;
use splat4d::render::{Antialias, RenderConfig};
use splat4d::scene::{Camera, GEOMETRY};
use std::path::Path;
use std::time::Instant;

/// Cameras and moments at which baked and model are compared; every one costs two pictures.
const COMPARED_CAMERAS: usize = 4;
const COMPARED_TIMES: usize = 6;
/// Longer side of those pictures, pixels.
const COMPARED_SIDE: usize = 800;
/// Most bytes of a poster: it comes before everything else.
const POSTER_BYTES: usize = 30 << 10;
/// Longer side of a poster and JPEG qualities, tried in turn until it is small enough.
const POSTERS: [(usize, u8); 5] = [(640, 85), (640, 70), (480, 70), (320, 60), (160, 50)];
/// Most cameras that the file names: a player lists them.
const NAMED_CAMERAS: usize = 200;
/// Keys of the default path, an orbit, and seconds from key to key.
const PATH_KEYS: usize = 16;
const PATH_STEP: f64 = 0.75;

/// Settings of baking and packing a scene.
#[derive(Clone, Debug)]
pub(crate) struct Baking {
    pub options: Options,
    /// Most entries of the palette.
    pub palette: usize,
    pub poster: bool,
}

impl Default for Baking {
    fn default() -> Self {
        Self { options: Options::default(), palette: WriteConfig::default().palette, poster: true }
    }
}

/// A baked scene as a file's bytes, and what became of it.
pub(crate) struct Packed {
    pub bytes: Vec<u8>,
    baked: bake::Baked,
    summary: playback::Summary,
    antialias: bool,
}

/// Bakes a scene and packs it, without a look at how well. The options' cameras are the source's.
pub(crate) fn pack(source: &Source, title: &str, baking: &Baking, console: &Console) -> anyhow::Result<Packed> {
    let scene = &source.scene;
    let views = source.views()?;
    let stage = source.stage(&views);
    let cameras = distinct(&views);
    let options = Options { cameras: cameras.iter().map(|v| v.camera.clone()).collect(), ..baking.options.clone() };
    let mut baked = bake(scene, &options, &mut |done, total| console.phase("baking", done, total))?;
    if scene.layers.iter().any(|l| l.masks.is_some()) {
        console.warn("the scene's masks are not baked along: whom they leave out is drawn. Its own .splat4d has them.");
    }
    let antialias = source.run.as_ref().and_then(|r| r.recipe().ok()).is_some_and(|r| r.appearance.antialias);
    let meta = Meta { title: title.to_owned(), ..meta(scene, &Outline::of_baked(&baked), &stage, &cameras) };
    let poster = baking.poster.then(|| poster(scene, &stage, antialias)).flatten();
    console.phase("writing", 0, 0);
    let draft = Draft { meta, nodes: std::mem::take(&mut baked.nodes), poster };
    let config = WriteConfig { palette: baking.palette, ..WriteConfig::default() };
    let mut bytes = Vec::new();
    let summary = playback::write(&draft, &config, &mut bytes)?;
    Ok(Packed { bytes, baked, summary, antialias })
}

/// Bakes into the file `out` and says how well; returns the report. The options' cameras are the source's.
pub(crate) fn bake_into(
    source: &Source,
    title: &str,
    out: &Path,
    baking: &Baking,
    console: &Console,
) -> anyhow::Result<Value> {
    let started = Instant::now();
    let scene = &source.scene;
    let Packed { bytes, baked, summary, antialias } = pack(source, title, baking, console)?;
    files::write(out, &bytes)?;
    let seconds = started.elapsed().as_secs_f64();
    let views = source.views()?;
    let (stage, cameras) = (source.stage(&views), distinct(&views));

    let likeness = compare(scene, &bytes, &stage, &cameras, antialias, console)?;
    console.clear();
    let report = &baked.report;
    let quantised: serde_json::Map<String, Value> = summary
        .errors
        .named()
        .iter()
        .map(|(name, e)| ((*name).to_owned(), json!({"rms": e.rms, "max": e.max})))
        .collect();
    let value = json!({
        "type": "baked", "file": out, "bytes": summary.bytes, "seconds": seconds, "clip": baked.clip,
        "bytes_per_primitive": summary.bytes as f64 / report.primitives.max(1) as f64,
        "pages": summary.pages, "page_bytes": summary.page_bytes, "palette_entries": summary.palette_entries,
        "palette_bytes": summary.palette_bytes, "poster_bytes": summary.poster_bytes, "baking": report,
        "likeness": likeness, "quantisation": quantised,
    });
    say(report, likeness.as_ref(), summary.bytes, seconds, console);
    if antialias {
        console.warn(
            "the run was trained with antialias = true, which playback files cannot hold: thin things look stronger \
             in the player.",
        );
    }
    console.emit(&value);
    console.written(out);
    Ok(value)
}

fn say(report: &bake::Report, likeness: Option<&bake::Likeness>, bytes: u64, seconds: f64, console: &Console) {
    let mut words = format!(
        "{} Gaussians became {} primitives in {} spans of time, {} in {seconds:.1} s",
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
    console.say(&words);
    let e = &report.errors;
    if e.worst > 0.0 {
        console.say(&format!(
            "error a Gaussian: median {:.3} px, 99 of 100 below {:.3} px, worst {:.3} px (tolerance {} px)",
            e.median, e.p99, e.worst, report.tolerance
        ));
    }
    if let Some(l) = likeness {
        console.say(&format!(
            "the file against its model: {:.2} dB over {} pictures, {:.2} dB in the worst ({:.2} s)",
            l.psnr, l.pictures, l.worst_psnr, l.worst_time
        ));
    }
}

/// Reads the file back and compares what it shows with what the model shows.
fn compare(
    scene: &Scene<f32>,
    bytes: &[u8],
    stage: &Stage,
    views: &[&View],
    antialias: bool,
    console: &Console,
) -> anyhow::Result<Option<bake::Likeness>> {
    let played = playback::read(bytes)?;
    let mut cameras: Vec<Camera> = views
        .iter()
        .step_by(views.len().div_ceil(COMPARED_CAMERAS).max(1))
        .map(|v| v.camera.downscaled(v.camera.width.max(v.camera.height).div_ceil(COMPARED_SIDE).max(1)))
        .collect();
    if cameras.is_empty() {
        cameras = (0..COMPARED_CAMERAS).map(|i| stage.orbit(i as f64 / COMPARED_CAMERAS as f64)).collect();
    }
    let [from, to] = scene.clip;
    // In the middle of equal parts: neither only on frames nor only between them.
    let mut times: Vec<f64> =
        (0..COMPARED_TIMES).map(|i| from + (to - from) * (i as f64 + 0.5) / COMPARED_TIMES as f64).collect();
    times.dedup();
    let antialias = if antialias { Antialias::On } else { Antialias::Off };
    let mut cpu = device::cpu(RenderConfig { antialias, ..RenderConfig::default() });
    Ok(bake::compare(scene, Shown::File(&played), &cameras, &times, cpu.as_mut(), &mut |done, total| {
        console.phase("comparing with the model", done, total);
    })?)
}

/// Every camera once, by name, spread over the rig where there are too many.
pub(crate) fn distinct(views: &[View]) -> Vec<&View> {
    let mut seen = std::collections::BTreeSet::new();
    let all: Vec<&View> = views.iter().filter(|v| seen.insert(v.name.as_str())).collect();
    let stride = all.len().div_ceil(NAMED_CAMERAS).max(1);
    all.into_iter().step_by(stride).collect()
}

/// Properties that a file states of its Gaussians as a whole.
pub(crate) struct Outline {
    pub clip: [f64; 2],
    pub sh_degree: usize,
    /// Least and greatest corner of the means.
    pub bounds: Option<[[f64; 3]; 2]>,
}

impl Outline {
    fn of_baked(baked: &bake::Baked) -> Self {
        let means = baked.nodes.iter().flat_map(|n| &n.primitives).map(|p| p.mean);
        Self { clip: baked.clip, sh_degree: baked.sh_degree, bounds: bounds(means) }
    }

    /// Of pages that are to be written.
    pub(crate) fn of_pages(pages: &Pages) -> Self {
        let tables = pages.layers.iter().map(|l| &l.params[GEOMETRY]);
        let means = tables.flat_map(|t| (0..t.rows()).map(|row| t.read::<3>(row, 0).map(f64::from)));
        let sh_degree = pages.palette.as_ref().map_or(0, |p| p.degree);
        Self { clip: pages.meta.clip, sh_degree, bounds: bounds(means) }
    }
}

/// Metadata of the scene, as the file states it.
pub(crate) fn meta(scene: &Scene<f32>, outline: &Outline, stage: &Stage, views: &[&View]) -> Meta {
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
        background: scene.background,
        sh_degree: outline.sh_degree,
        bounds: outline.bounds,
        view: Some(look(0.0)),
        cameras: views.iter().map(|v| NamedCamera::new(&v.name, &v.camera)).collect(),
        // The last key is the first again, so that the orbit closes.
        path: (0..=PATH_KEYS).map(key).collect(),
        ..Meta::default()
    }
}

/// Least and greatest corner.
fn bounds(means: impl Iterator<Item = [f64; 3]>) -> Option<[[f64; 3]; 2]> {
    means.fold(None, |b: Option<[[f64; 3]; 2]>, m| {
        let [low, high] = b.unwrap_or([m, m]);
        Some([std::array::from_fn(|k| low[k].min(m[k])), std::array::from_fn(|k| high[k].max(m[k]))])
    })
}

/// The first view at the clip's start as a JPEG that is small enough.
pub(crate) fn poster(scene: &Scene<f32>, stage: &Stage, antialias: bool) -> Option<Vec<u8>> {
    let mut painter = Painter::new(scene, scene.background, antialias, false);
    let camera = stage.orbit(0.0);
    POSTERS.iter().find_map(|&(side, quality)| {
        let shrink = camera.width.max(camera.height).div_ceil(side).max(1);
        painter.draw(&camera.downscaled(shrink), scene.clip[0]);
        let rgb = color_rgb(&painter.image.color);
        let picture = image::RgbImage::from_raw(rgb.width as u32, rgb.height as u32, rgb.data)?;
        let mut bytes = Vec::new();
        JpegEncoder::new_with_quality(&mut bytes, quality).encode_image(&picture).ok()?;
        (bytes.len() <= POSTER_BYTES).then_some(bytes)
    })
}

/// Title of the scene for people: the capture's name, or the file's.
pub(crate) fn title(source: &Source, path: &Path) -> String {
    let stem = || path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    source.run.as_ref().map_or_else(stem, Run::name)
}
