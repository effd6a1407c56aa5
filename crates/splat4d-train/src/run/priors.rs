//! Checks of priors (depth, flow): against the images before training, against the trained scene after it.

use super::open::{OpenCapture, training_frames};
use crate::capture::frames::{Depth, Frames, Picture};
use crate::capture::{Capture, DepthKind, ImageStore};
use crate::loss::image::depth::{Apart, apart};
use crate::recipe::Recipe;
use crate::{Error, Result};
use splat4d::layers::{Evaluation, Scene};
use splat4d::render::{Antialias, Image, RenderConfig, Renderer, Shot};
use std::sync::Arc;

/// Frames that are examined, evenly chosen.
const LOOKED_AT: usize = 8;
/// Flow shorter than this has no reliable direction, pixels.
const SHORT: f32 = 1.0;
/// Fewest points with which a map is evaluated.
const FEW: usize = 20;
/// Fewest pixels with which an image is evaluated.
const ENOUGH: usize = 200;
/// Another reading of flow is the right one if it leaves less than this share of the difference between images.
const CLEARLY: f64 = 0.7;
/// Logarithm of the factor beyond which depths and points are at different scales: more than the points' own noise
/// leaves of the median of hundreds.
const OTHER_SCALE: f64 = 0.02;
/// Share of the points that what is in front of them hides from an image at most but for this: the scale is that of the
/// closest this many ratios.
const VISIBLE: f64 = 0.3;
/// Depths whose closest ratios to the points are spread by more than this either way (logarithm) are not theirs, at
/// whatever scale: noise of a quarter of the depth does as much, and single-image networks have less.
const FOREIGN: f64 = 0.1;
/// Share of the points that are before what a metric map shows, by more than [`METRIC_OFF`], from which on it is
/// reported: surfaces in front of a point hide it, and nothing can be in front of the point's own surface.
const BEFORE: f64 = 0.1;
/// A metric map is believed while the scene is within this share of it (median); others while they correlate by this.
const METRIC_OFF: f64 = 0.1;
const CORRELATED: f64 = 0.8;

/// Checks flow and depth before training; returns warnings. Errors: flow that runs backwards, or whose axes are
/// exchanged.
pub(super) fn before(opened: &OpenCapture, recipe: &Recipe) -> Result<Vec<String>> {
    let capture = &opened.capture;
    let mut warnings = Vec::new();
    if recipe.loss.flow > 0.0 {
        let store = ImageStore::new(capture.clone(), 0);
        let of_files = |i: &&usize| capture.frames[**i].flow.as_ref().is_some_and(|f| !f.of_view);
        let all: Vec<usize> = capture.train.iter().filter(of_files).copied().collect();
        for &i in chosen(&all) {
            warnings.extend(flow_reads(capture, &store, i)?);
        }
    }
    warnings.truncate(1);
    if recipe.loss.depth > 0.0 {
        warnings.extend(points_before(opened)?);
    }
    Ok(warnings)
}

/// Report about metric maps with surfaces behind points that were seen in front of them.
fn points_before(opened: &OpenCapture) -> Result<Option<String>> {
    let looked = ratios(opened)?;
    let conflict = |(i, ratios): &(usize, Vec<f64>)| {
        let before = ratios.iter().filter(|r| **r < (1.0 - METRIC_OFF).ln()).count() as f64 / ratios.len() as f64;
        (before > BEFORE).then_some((*i, before))
    };
    let found: Vec<(usize, f64)> = looked.iter().filter(|(_, r)| r.len() >= FEW).filter_map(conflict).collect();
    Ok(found.first().map(|&(i, before)| {
        format!(
            "{} of {} checked depth maps have surfaces behind the capture's points, first that of {}: {:.0} % of the points in \
             this image are in front of the map. Maps may be mirrored, of other frames, or of another kind (depth_kind, \
             docs/priors.md); without them: --set loss.depth=0",
            found.len(),
            looked.len(),
            name(&opened.capture, opened.capture.train[i]),
            100.0 * before
        )
    }))
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
            "the flow is reversed: the opposite direction fits the images",
            "Flow points from a frame to the next one of its camera: change its sign, or write the flow of the other direction",
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
            "the flow of {} predicts the next image worse than no flow ({}): check its unit (pixels), its size and \
             its target frame",
            name(capture, frame),
            file.path.display()
        )
    }))
}

/// Ratio of metric depth to the capture's points.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Depths {
    /// They agree, or cannot be compared.
    Fit,
    /// The points are this many times as far away, everywhere.
    Scaled(f64),
    /// Even the closest scatter about the points by this (logarithm): no unit corrects that.
    Foreign(f64),
}

/// By training frame with a metric map, of those that are examined: ln(z/D) of the points that are static in it.
fn ratios(opened: &OpenCapture) -> Result<Vec<(usize, Vec<f64>)>> {
    let capture = &opened.capture;
    let Some(cloud) = capture.points.as_ref() else { return Ok(Vec::new()) };
    let still: Vec<[f64; 3]> =
        (0..cloud.points.len()).filter(|&i| cloud.times[i].is_none()).map(|i| cloud.points[i]).collect();
    let places: Vec<usize> = (0..opened.frames.len()).filter(|&i| is_metric(capture, capture.train[i])).collect();
    let (mut all, mut picture) = (Vec::new(), Picture::default());
    for &i in chosen(&places) {
        opened.frames.load(i, &mut picture)?;
        let (Some(depth), camera) = (&picture.depth, opened.frames.camera(i)) else { continue };
        let ratio = |&point: &[f64; 3]| {
            let ([u, v], z) = camera.project(point)?;
            let inside = (0.0..camera.width as f64).contains(&u) && (0.0..camera.height as f64).contains(&v);
            let stored = if inside { depth.values.get(0, v as usize, u as usize) } else { 0.0 };
            (stored > 0.0).then(|| (z / f64::from(stored)).ln())
        };
        all.push((i, still.iter().filter_map(ratio).collect()));
    }
    Ok(all)
}

/// How the metric depth maps of a capture relate to its points: by where their ratios are densest, since a point that
/// something hides is farther away than what is seen there.
fn depths(opened: &OpenCapture) -> Result<Depths> {
    let mut ratios: Vec<f64> = ratios(opened)?.into_iter().flat_map(|(_, ratios)| ratios).collect();
    if ratios.len() < ENOUGH {
        return Ok(Depths::Fit);
    }
    ratios.sort_by(f64::total_cmp);
    let few = (VISIBLE * ratios.len() as f64).ceil() as usize;
    let closest = ratios.windows(few).min_by(|a, b| (a[few - 1] - a[0]).total_cmp(&(b[few - 1] - b[0])));
    let closest = closest.expect("there are as many");
    let (ratio, scatter) = (closest[few / 2], 0.5 * (closest[few - 1] - closest[0]));
    Ok(match (scatter, ratio.abs()) {
        (scatter, _) if scatter > FOREIGN => Depths::Foreign(scatter),
        (_, off) if off > OTHER_SCALE => Depths::Scaled(ratio.exp()),
        _ => Depths::Fit,
    })
}

fn is_metric(capture: &Capture, frame: usize) -> bool {
    capture.frames[frame].depth.as_ref().is_some_and(|d| d.kind == DepthKind::Metric && d.fit.is_none())
}

/// The capture with its metric depth in the unit of its points, or without it where it contradicts them, and what is to
/// be reported of that: poses and points are of one unit, and images were matched to find them.
pub(super) fn believed(opened: OpenCapture, recipe: &Recipe) -> Result<(OpenCapture, Option<String>)> {
    if recipe.loss.depth <= 0.0 || !opened.capture.train.iter().any(|&i| is_metric(&opened.capture, i)) {
        return Ok((opened, None));
    }
    let found = depths(&opened)?;
    let message = match found {
        Depths::Fit => return Ok((opened, None)),
        Depths::Scaled(ratio) => format!(
            "the capture's points are {ratio:.3} times as far away as in its depth maps: maps are multiplied by \
             {ratio:.3}; correct depth_scale (docs/priors.md)"
        ),
        Depths::Foreign(scatter) => format!(
            "the capture's depth maps and points contradict each other at any scale, the closest by {:.0} % either way: maps are left \
             out; they may be mirrored, of other frames or cameras, or not metric (depth_kind, docs/priors.md)",
            100.0 * (scatter.exp() - 1.0)
        ),
    };
    let mut capture = Capture::clone(&opened.capture);
    for frame in &mut capture.frames {
        if frame.depth.as_ref().is_none_or(|d| d.kind != DepthKind::Metric || d.fit.is_some()) {
            continue;
        }
        match (found, &mut frame.depth) {
            (Depths::Scaled(ratio), Some(depth)) => depth.scale *= ratio,
            _ => frame.depth = None,
        }
    }
    let frames = training_frames(Arc::new(capture), recipe)?;
    Ok((OpenCapture::with(frames).on(opened.device), Some(message)))
}

/// Holds the trained scene against the depth maps that it was trained on; returns warnings of those that it
/// contradicts.
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
        let difference = match apart {
            Apart::Ratio(ratio, off) if off > METRIC_OFF => {
                format!("by {:.0} % (it renders {ratio:.2} times the depth)", 100.0 * off)
            }
            Apart::Correlation(r) if r < CORRELATED => format!("(correlation {r:.2})"),
            _ => continue,
        };
        found.push(format!("{} {difference}", name(capture, capture.train[i])));
    }
    let Some(first) = found.first() else { return Ok(Vec::new()) };
    let upside = "maps may be of another kind (depth_kind), unit (depth_scale) or frame, or wrong";
    Ok(vec![format!(
        "the scene contradicts {} of {looked} checked depth maps, first that of {first}: the images were used, and \
         {upside}",
        found.len()
    )])
}

/// Renders a training frame with its depth.
pub(super) fn draw(
    scene: &Scene<f32>,
    opened: &OpenCapture,
    i: usize,
    renderer: &mut Renderer<f32>,
    out: &mut Image<f32>,
) {
    let mut instant = Evaluation::default();
    scene.at(opened.frames.time(i), &mut instant);
    let splats = scene.splats(&instant);
    renderer.render(&Shot { depth: true, ..Shot::new(&splats, opened.frames.camera(i), scene.background) }, out);
}

#[cfg(test)]
mod tests {
    use super::super::aligned::aligned;
    use super::*;
    use crate::capture::{CaptureOptions, PointCloud};
    use splat4d::format::npy;
    use std::path::Path;

    const SIDE: usize = 32;
    /// Focal length, pixels.
    const FOCAL: f64 = 40.0;

    /// Depth of the slanted wall z = 4 + x at (x/z, y/z).
    fn wall(u: f64) -> f64 {
        4.0 / (1.0 - u)
    }

    /// The wall's depth in a column.
    fn depth(x: usize) -> f64 {
        wall((x as f64 + 0.5 - 16.0) / FOCAL)
    }

    /// Two cameras in one place look at the wall, with points on it; maps report `depth_of` for a column.
    fn opened(folder: &Path, kind: &str, depth_of: &dyn Fn(usize) -> f64) -> OpenCapture {
        let mut cameras = Vec::new();
        for c in 0..2 {
            let picture = image::RgbImage::from_pixel(SIDE as u32, SIDE as u32, image::Rgb([90, 90, 90]));
            picture.save(folder.join(format!("{c}.png"))).unwrap();
            let values: Vec<f32> = (0..SIDE * SIDE).map(|p| depth_of(p % SIDE) as f32).collect();
            let mut file = Vec::new();
            npy::write_f32(&[SIDE, SIDE], &values, &mut file).unwrap();
            std::fs::write(folder.join(format!("d{c}.npy")), file).unwrap();
            cameras.push(format!(
                r#"{{"name": "c{c}", "width": {SIDE}, "height": {SIDE}, "fx": {FOCAL}, "fy": {FOCAL}, "cx": 16, "cy": 16,
                "images": ["{c}.png"], "depth": ["d{c}.npy"], "depth_kind": "{kind}",
                "world_to_camera": [[1, 0, 0, {}], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}}"#,
                1e-3 * f64::from(c)
            ));
        }
        let text = format!(r#"{{"version": 1, "hold_out": "none", "cameras": [{}]}}"#, cameras.join(", "));
        std::fs::write(folder.join("capture.json"), text).unwrap();
        let mut capture = Capture::open(folder, &CaptureOptions::default()).unwrap();
        let mut cloud = PointCloud::default();
        for k in 0..400 {
            let (u, v) = (0.7 * (f64::from(k % 20) / 19.0 - 0.5), 0.7 * (f64::from(k / 20) / 19.0 - 0.5));
            let z = wall(u);
            // The wall hides as many others behind it.
            for z in [z, z * (1.3 + f64::from(k) / 400.0)] {
                cloud.points.push([u * z, v * z, z]);
                cloud.colors.push([0.5; 3]);
                cloud.times.push(None);
            }
        }
        capture.points = Some(cloud);
        OpenCapture::new(Arc::new(capture), &Recipe::default()).unwrap()
    }

    #[test]
    fn depth_maps_are_scaled_to_the_points_and_ignored_if_they_contradict() {
        let folder = tempfile::tempdir().unwrap();
        let recipe = Recipe::default();
        let scales = |o: &OpenCapture| -> Vec<Option<f64>> {
            o.capture.frames.iter().map(|f| f.depth.as_ref().map(|d| d.scale)).collect()
        };
        let (exact, said) = believed(opened(folder.path(), "metric", &depth), &recipe).unwrap();
        assert_eq!((scales(&exact), said), (vec![Some(1.0); 2], None));
        let (scaled, said) = believed(opened(folder.path(), "metric", &|x| depth(x) / 1.3), &recipe).unwrap();
        assert!(scales(&scaled).iter().all(|s| s.is_some_and(|s| (s - 1.3).abs() < 0.03)), "{:?}", scales(&scaled));
        assert!(said.is_some_and(|s| s.contains("1.3") && s.contains("depth_scale")));
        let (again, said) = believed(scaled, &recipe).unwrap();
        assert!(said.is_none() && scales(&again)[0].is_some_and(|s| s > 1.2), "what was mended fits");
        let (mirrored, said) = believed(opened(folder.path(), "metric", &|x| depth(SIDE - 1 - x)), &recipe).unwrap();
        assert_eq!(scales(&mirrored), [None, None]);
        assert!(said.is_some_and(|s| s.contains("contradict") && s.contains("mirrored")));
        // Two thirds of a map fit, and the rest shows something behind the points there.
        let behind = |x: usize| depth(x) * if x < 21 { 1.0 } else { 1.5 };
        let (behind, said) = believed(opened(folder.path(), "metric", &behind), &recipe).unwrap();
        assert_eq!((scales(&behind), said), (vec![Some(1.0); 2], None));
        let said = before(&behind, &recipe).unwrap();
        assert!(said.len() == 1 && said[0].contains("2 of 2") && said[0].contains("camera c0, frame 0"), "{said:?}");
        // Something before the points hides them.
        let (hidden, _) =
            believed(opened(folder.path(), "metric", &|x| depth(x) * if x < 21 { 1.0 } else { 0.5 }), &recipe).unwrap();
        assert_eq!(before(&hidden, &recipe).unwrap(), Vec::<String>::new());
        // Maps without a unit are compared with the scene alone, and unread ones are not examined.
        let relative = opened(folder.path(), "relative", &|x| depth(SIDE - 1 - x));
        assert_eq!(believed(relative, &recipe).unwrap().1, None);
        let off = recipe.with(|r| r.loss.depth = 0.0);
        assert_eq!(believed(opened(folder.path(), "metric", &|x| depth(x) / 1.3), &off).unwrap().1, None);
    }

    #[test]
    fn maps_without_a_unit_are_fitted_to_the_points() {
        let (folder, recipe) = (tempfile::tempdir().unwrap(), Recipe::default());
        let maps: [(&str, &dyn Fn(usize) -> f64); 2] =
            [("inverse", &|x| 30.0 / depth(x) + 2.0), ("relative", &|x| 7.0 * depth(x) + 3.0)];
        for (kind, map) in maps {
            let (fitted, said) = aligned(opened(folder.path(), kind, map), &recipe).unwrap();
            assert_eq!(said, None);
            let mut picture = Picture::default();
            fitted.frames.load(0, &mut picture).unwrap();
            let map = picture.depth.unwrap();
            assert_eq!(map.kind, DepthKind::Metric);
            let off = |x: usize| (f64::from(map.values.get(0, 16, x)) / depth(x) - 1.0).abs();
            assert!((0..SIDE).all(|x| off(x) < 0.01), "{kind}: {:?}", (0..SIDE).map(off).collect::<Vec<_>>());
            // Nothing is fitted twice, or to a unit of its own.
            assert_eq!(believed(fitted, &recipe).unwrap().1, None);
        }
        let (mirrored, said) =
            aligned(opened(folder.path(), "inverse", &|x| 30.0 / depth(SIDE - 1 - x) + 2.0), &recipe).unwrap();
        assert!(said.is_some_and(|s| s.contains("0 of 2 depth maps fit")));
        assert!(mirrored.capture.frames.iter().all(|f| f.depth.as_ref().is_some_and(|d| d.kind == DepthKind::Inverse)));
    }
}
