//! What files say of a capture beside its pictures, held against these: before training what can be told at once, after it
//! what the scene made of them.

use super::open::OpenCapture;
use crate::capture::frames::{Depth, Frames, Picture};
use crate::capture::{Capture, DepthKind, ImageStore};
use crate::loss::image::depth::{Apart, apart};
use crate::recipe::Recipe;
use crate::{Error, Result};
use splat4d::layers::{Evaluation, Scene};
use splat4d::render::{Antialias, Image, RenderConfig, Renderer, Shot};

/// Frames that are looked at, evenly chosen.
const LOOKED_AT: usize = 8;
/// Flow shorter than this tells nothing of its direction, pixels.
const SHORT: f32 = 1.0;
/// Pixels from which on a picture tells something.
const ENOUGH: usize = 200;
/// Another reading of flow is the right one if it leaves less than this share of the difference between pictures.
const CLEARLY: f64 = 0.7;
/// Depths and points that are apart by more than this factor are in different units.
const OTHER_UNIT: f64 = 1.25;
/// A metric map is believed while the scene is within this share of it (median); others while they correlate by this.
const METRIC_OFF: f64 = 0.1;
const CORRELATED: f64 = 0.8;

/// Checks flow and depth before training; returns warnings. Errors: flow that runs backwards, or whose axes are exchanged.
pub(super) fn before(opened: &OpenCapture, recipe: &Recipe) -> Result<Vec<String>> {
    let capture = &opened.capture;
    let mut warnings = Vec::new();
    if recipe.loss.flow > 0.0 {
        let store = ImageStore::new(capture.clone(), 0);
        let told = |i: &&usize| capture.frames[**i].flow.as_ref().is_some_and(|f| !f.of_view);
        let all: Vec<usize> = capture.train.iter().filter(told).copied().collect();
        for &i in chosen(&all) {
            warnings.extend(flow_reads(capture, &store, i)?);
        }
    }
    warnings.truncate(1);
    if recipe.loss.depth > 0.0 {
        warnings.extend(depth_unit(opened)?);
    }
    Ok(warnings)
}

fn chosen(all: &[usize]) -> impl Iterator<Item = &usize> {
    all.iter().step_by(all.len().div_ceil(LOOKED_AT).max(1))
}

/// The place of a frame in messages.
fn name(capture: &Capture, frame: usize) -> String {
    let frame = &capture.frames[frame];
    format!("camera {}, frame {}", capture.cameras[frame.camera].name, frame.index)
}

/// Whether flow leads from pixels to like ones.
fn flow_reads(capture: &Capture, store: &ImageStore, frame: usize) -> Result<Option<String>> {
    let Some(file) = &capture.frames[frame].flow else { return Ok(None) };
    let (from, to) = (store.load(frame)?.to_picture(), store.load(file.to)?.to_picture());
    let Some(flow) = &from.flow else { return Ok(None) };
    let (w, h, n) = (flow.width, flow.height, flow.pixels());
    if (to.color.width, to.color.height) != (w, h) {
        return Ok(None);
    }
    type Reading = fn([f32; 2]) -> [f32; 2];
    let readings: [Reading; 4] = [|v| v, |_| [0.0; 2], |[u, v]| [-u, -v], |[u, v]| [v, u]];
    let (mut sums, mut count) = ([0.0f64; 4], 0);
    for p in (0..n).filter(|&p| flow.data[2 * n + p] > 0.0) {
        let vector = [flow.data[p], flow.data[n + p]];
        if vector[0].hypot(vector[1]) < SHORT {
            continue;
        }
        let place = |read: &Reading| {
            let [u, v] = read(vector);
            let (x, y) = ((p % w) as f32 + 0.5 + u, (p / w) as f32 + 0.5 + v);
            ((0.0..w as f32).contains(&x) && (0.0..h as f32).contains(&y)).then(|| y as usize * w + x as usize)
        };
        let Some(places) = readings.iter().map(place).collect::<Option<Vec<usize>>>() else { continue };
        let off =
            |q: usize| (0..3).map(|c| f64::from((from.color.plane(c)[p] - to.color.plane(c)[q]).abs())).sum::<f64>();
        places.iter().zip(&mut sums).for_each(|(q, sum)| *sum += off(*q));
        count += 1;
    }
    if count < ENOUGH {
        return Ok(None);
    }
    let [forth, none, back, turned] = sums;
    let refuse = |what: &str, remedy: &str| {
        Err(Error::input(what).at(format!("{} ({})", file.path.display(), name(capture, frame))).remedy(remedy))
    };
    if back < CLEARLY * forth && back < none {
        return refuse(
            "the flow runs backwards: pixels are found against it",
            "Flow leads from a frame to the next one of its camera: change its sign, or write that of the other direction",
        );
    }
    if turned < CLEARLY * forth && turned < none {
        return refuse(
            "u and v of the flow are exchanged",
            "The first number is to the right, the second down, in pixels",
        );
    }
    Ok((forth > none).then(|| {
        format!(
            "the flow of {} explains the next picture worse than no flow at all ({}): check its unit (pixels), its size \
             and which frame it leads to",
            name(capture, frame),
            file.path.display()
        )
    }))
}

/// Whether metric depth and the capture's points agree on the unit.
fn depth_unit(opened: &OpenCapture) -> Result<Option<String>> {
    let capture = &opened.capture;
    let Some(cloud) = capture.points.as_ref() else { return Ok(None) };
    let still: Vec<[f64; 3]> =
        (0..cloud.points.len()).filter(|&i| cloud.times[i].is_none()).map(|i| cloud.points[i]).collect();
    let places: Vec<usize> = (0..opened.frames.len()).collect();
    let (mut ratios, mut picture) = (Vec::new(), Picture::default());
    for &i in chosen(&places) {
        if capture.frames[capture.train[i]].depth.as_ref().is_none_or(|d| d.kind != DepthKind::Metric) {
            continue;
        }
        opened.frames.load(i, &mut picture)?;
        let (Some(depth), camera) = (&picture.depth, opened.frames.camera(i)) else { continue };
        for &point in &still {
            let Some(([u, v], z)) = camera.project(point) else { continue };
            let inside = (0.0..camera.width as f64).contains(&u) && (0.0..camera.height as f64).contains(&v);
            let told = if inside { depth.values.get(0, v as usize, u as usize) } else { 0.0 };
            if told > 0.0 {
                ratios.push(z / f64::from(told));
            }
        }
    }
    if ratios.len() < ENOUGH {
        return Ok(None);
    }
    let middle = ratios.len() / 2;
    // Points that something hides are further away than what is seen, so that half of them may be.
    let ratio = *ratios.select_nth_unstable_by(middle, f64::total_cmp).1;
    let apart = ratio.max(1.0 / ratio);
    Ok((apart > OTHER_UNIT).then(|| {
        format!(
            "the capture's points are {ratio:.3} times as far away as its depth maps say (median): correct depth_scale, or \
             call the maps relative (docs/priors.md)"
        )
    }))
}

/// Holds the trained scene against the depth maps that it was trained on; returns warnings of those that it contradicts.
pub(super) fn after(opened: &OpenCapture, scene: &Scene<f32>, recipe: &Recipe) -> Result<Vec<String>> {
    let capture = &opened.capture;
    let antialias = if recipe.appearance.antialias { Antialias::On } else { Antialias::Off };
    let config = RenderConfig { antialias, simd: opened.simd, ..RenderConfig::default() };
    let with: Vec<usize> =
        (0..capture.train.len()).filter(|&i| capture.frames[capture.train[i]].depth.is_some()).collect();
    let mut renderer = Renderer::new(config);
    let (mut picture, mut image) = (Picture::default(), Image::default());
    let (mut found, mut looked) = (Vec::new(), 0);
    for &i in chosen(&with) {
        opened.frames.load(i, &mut picture)?;
        let Some(depth) = &picture.depth else { continue };
        draw(scene, opened, i, &mut renderer, &mut image);
        looked += 1;
        let Some(apart) = apart([&image.depth, &image.alpha], Depth::truth(depth)) else { continue };
        let told = match apart {
            Apart::Ratio(ratio, off) if off > METRIC_OFF => {
                format!("by {:.0} % (it draws {ratio:.2} times the depth)", 100.0 * off)
            }
            Apart::Correlation(r) if r < CORRELATED => format!("(correlation {r:.2})"),
            _ => continue,
        };
        found.push(format!("{} {told}", name(capture, capture.train[i])));
    }
    let Some(first) = found.first() else { return Ok(Vec::new()) };
    let upside = "maps may be of another kind (depth_kind), unit (depth_scale) or frame, or simply wrong there";
    Ok(vec![format!(
        "the scene contradicts {} of {looked} depth maps that were looked at, first of {first}: pictures were believed, and \
         {upside}",
        found.len()
    )])
}

/// Draws a training frame with its depth.
fn draw(scene: &Scene<f32>, opened: &OpenCapture, i: usize, renderer: &mut Renderer<f32>, out: &mut Image<f32>) {
    let mut instant = Evaluation::default();
    scene.at(opened.frames.time(i), &mut instant);
    let splats = scene.splats(&instant);
    renderer.render(&Shot { depth: true, ..Shot::new(&splats, opened.frames.camera(i), scene.background) }, out);
}
