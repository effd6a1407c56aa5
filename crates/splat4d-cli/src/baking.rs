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
use splat4d::format::playback::{
    self, Draft, Meta, NamedCamera, Pages, PathKey, Viewpoint, WriteConfig, feature_ranges,
};
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

/// A file is to be so like its model, dB: what is lost by baking then hides behind what training leaves.
pub(crate) const LIKE: f64 = 40.0;
/// Bakings that are tried for it, each with a smaller tolerance.
const TRIES: usize = 5;
/// What a smaller tolerance aims at beyond that, dB.
const MARGIN: f64 = 0.3;
/// dB gained for each that the tolerance is reduced by (20 log₁₀): of the first try, and the bounds of what is believed
/// of earlier ones. 1 where every Gaussian errs as much as it may; most err less. Measured on networks: 0.46 to 0.58.
const SLOPE: f64 = 0.55;
const SLOPES: [f64; 2] = [0.25, 1.0];
/// Most by which a tolerance is reduced at once.
const REDUCED: f64 = 0.15;
/// Where one primitive of so many lasts one look at the model only, a smaller tolerance has nothing left to split there: the
/// model is looked at twice as often instead. Measured on a network that a hand-held camera's take taught (docs/suite.md).
const SHORT_LIVED: usize = 10;
/// A smaller tolerance that gains less than this, dB, costs more than it is worth: what is missing is the rounding's.
const WORTH: f64 = 0.5;

/// Settings of baking and packing a scene.
#[derive(Clone, Debug)]
pub(crate) struct Baking {
    pub options: Options,
    /// How like its model the file is to be, dB: the tolerance is reduced for it. None: the tolerance as it is.
    pub like: Option<f64>,
    /// Most entries of the palette.
    pub palette: usize,
    pub poster: bool,
}

impl Default for Baking {
    fn default() -> Self {
        Self { options: Options::default(), like: Some(LIKE), palette: WriteConfig::default().palette, poster: true }
    }
}

/// A baked scene as a file's bytes, and what became of it.
pub(crate) struct Packed {
    pub bytes: Vec<u8>,
    pub baked: bake::Baked,
    summary: playback::Summary,
    antialias: bool,
}

/// Bakes a scene and packs it, without a look at how well. The options' cameras are the source's.
pub(crate) fn pack(source: &Source, title: &str, baking: &Baking, console: &Console) -> anyhow::Result<Packed> {
    pack_scene(&source.scene, source, title, baking, console)
}

/// The same of another scene in the source's place.
pub(crate) fn pack_scene(
    scene: &Scene<f32>,
    source: &Source,
    title: &str,
    baking: &Baking,
    console: &Console,
) -> anyhow::Result<Packed> {
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
    let (packed, likeness) = bake_like(source, title, baking, console)?;
    let Packed { mut bytes, baked, summary, antialias } = packed;
    if source.provenance.is_some() {
        bytes = playback::with_provenance(&bytes, source.provenance.as_ref())?;
    }
    files::write(out, &bytes)?;
    let seconds = started.elapsed().as_secs_f64();
    console.clear();
    let report = &baked.report;
    let quantised: serde_json::Map<String, Value> = summary
        .errors
        .named()
        .iter()
        .map(|(name, e)| ((*name).to_owned(), json!({"rms": e.rms, "max": e.max})))
        .collect();
    let value = json!({
        "type": "baked", "file": out.to_string_lossy(), "bytes": bytes.len(), "seconds": seconds, "clip": baked.clip,
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

/// Bakes and packs a scene, again with a smaller tolerance where the file is less like its model than is wanted.
pub(crate) fn bake_like(
    source: &Source,
    title: &str,
    baking: &Baking,
    console: &Console,
) -> anyhow::Result<(Packed, Option<bake::Likeness>)> {
    let scene = &source.scene;
    let views = source.views()?;
    let (stage, cameras) = (source.stage(&views), distinct(&views));
    let packed = pack(source, title, baking, console)?;
    let likeness = compare(scene, &packed.bytes, &stage, &cameras, packed.antialias, console)?;
    let mut tried = vec![(packed, likeness)];
    let mut looks = baking.options.looks;
    while tried.len() < TRIES {
        let known: Vec<(f64, f64)> =
            tried.iter().filter_map(|(p, like)| Some((p.baked.report.tolerance, like.as_ref()?.psnr))).collect();
        // What is straight already has no pieces to add.
        let splits = tried[0].0.baked.report.errors.worst > 0.0;
        let Some(tolerance) = closer(baking.like.filter(|_| splits), &known) else { break };
        let last = &tried[tried.len() - 1].0.baked.report;
        let mut strict = baking.clone();
        strict.options.tolerance = tolerance;
        if SHORT_LIVED * last.key_states >= last.primitives {
            looks *= 2.0;
        }
        strict.options.looks = looks;
        let packed = pack(source, title, &strict, console)?;
        let likeness = compare(scene, &packed.bytes, &stage, &cameras, packed.antialias, console)?;
        let gained = likeness.zip(tried[tried.len() - 1].1).is_some_and(|(new, old)| new.psnr >= old.psnr + WORTH);
        if !gained {
            break;
        }
        // One file at a time: those before are not needed again.
        let last = tried.len() - 1;
        tried[last].0.bytes = Vec::new();
        tried.push((packed, likeness));
    }
    Ok(tried.pop().expect("one file was packed"))
}

/// The tolerance with which a file that is less like its model than wanted is baked again, by what tolerances (pixels) came
/// to so far (dB). Errors that many Gaussians share, as of a wall that is carried along by the motion of a camera, shift
/// the whole picture and cost more than those of Gaussians that err on their own: what a tolerance costs is known
/// afterwards only. None: the last one is good enough.
fn closer(like: Option<f64>, tried: &[(f64, f64)]) -> Option<f64> {
    let &(tolerance, psnr) = tried.last()?;
    let missing = like? - psnr;
    let slope = match tried {
        [.., (before, less), _] => (psnr - less) / (20.0 * (before / tolerance).log10()),
        _ => SLOPE,
    };
    let slope = if slope.is_finite() { slope.clamp(SLOPES[0], SLOPES[1]) } else { SLOPE };
    let reduced = 10f64.powf(-(missing + MARGIN) / (20.0 * slope)).max(REDUCED);
    (missing > 0.0).then_some(tolerance * reduced)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_is_not_like_its_model_is_baked_again_with_less_tolerance() {
        // A model of files: so many dB for each of the tolerance's, up to what rounding leaves.
        for (slope, ceiling) in [(0.5, 60.0), (0.9, 60.0), (0.3, 60.0), (1.0, 45.0)] {
            let file = |tolerance: f64| f64::min(34.0 + slope * 20.0 * (0.25 / tolerance).log10(), ceiling);
            let mut tried = vec![(0.25, file(0.25))];
            while let Some(tolerance) = closer(Some(LIKE), &tried).filter(|_| tried.len() < TRIES) {
                tried.push((tolerance, file(tolerance)));
            }
            let (tolerance, psnr) = tried[tried.len() - 1];
            assert!((LIKE..LIKE + 6.0).contains(&psnr), "{slope}: {psnr} dB with {tolerance} px");
        }
        assert!(closer(Some(LIKE), &[(0.25, 0.0)]).unwrap() > 0.03, "never too much at once");
        assert_eq!(closer(Some(LIKE), &[(0.25, 40.1)]), None, "good enough");
        assert_eq!(closer(None, &[(0.25, 30.0)]), None, "a tolerance that was asked for stays");
        assert_eq!(closer(Some(LIKE), &[]), None, "nothing was compared");
    }
}
