//! Measured geometry against the images: before training, whether any image shows it; after training, how far the scene
//! is from it, by camera, in `geometry.json`.

use super::checkpoint::write_atomically;
use super::open::OpenCapture;
use super::priors::draw;
use crate::capture::frames::{Frames, Picture};
use crate::event::Event;
use crate::loss::image::SEEN;
use crate::recipe::Recipe;
use crate::{Error, Result};
use serde_json::json;
use splat4d::layers::Scene;
use splat4d::math::median;
use splat4d::render::{Antialias, Image, RenderConfig, Renderer};
use std::path::Path;

/// The file in the run.
const FILE: &str = "geometry.json";
/// Images of which one at least must show the geometry, evenly chosen.
const LOOKED_AT: usize = 8;
/// Images of a camera that are compared after training, evenly chosen, and of all cameras.
const OF_CAMERA: usize = 4;
const OF_ALL: usize = 64;
/// Pixels of a camera that are compared, at least.
const ENOUGH: usize = 20;
/// A camera whose depth is off by more than this (median) contradicts the geometry.
const OFF: f64 = 0.1;

/// Errors: no training image has a measurement.
pub(super) fn before(opened: &OpenCapture) -> Result<()> {
    if opened.capture.geometry.is_none() {
        return Ok(());
    }
    let (n, mut picture) = (opened.frames.len(), Picture::default());
    for i in (0..n).step_by(n.div_ceil(LOOKED_AT).max(1)) {
        opened.frames.load(i, &mut picture)?;
        if picture.measured.is_some() {
            return Ok(());
        }
    }
    // Scans of single frames may be few.
    for i in 0..n {
        opened.frames.load(i, &mut picture)?;
        if picture.measured.is_some() {
            return Ok(());
        }
    }
    Err(Error::input("the measured geometry covers no pixel of any training image")
        .at(opened.capture.root.display())
        .remedy(
            "It must be in the coordinates and units of the poses (\"transform\" in capture.json, docs/priors.md), and show \
             surfaces: at least three neighbouring points",
        ))
}

/// What a camera's images and the geometry have in common.
struct Row {
    camera: usize,
    frames: usize,
    /// Share of pixels with a measurement.
    measured: f64,
    /// Medians of |D / D* − 1| and of D / D*; `None`: too few pixels are compared.
    errors: Option<[f64; 2]>,
}

/// Compares the trained scene with the geometry, writes [`FILE`] and returns the event and a warning of cameras that
/// contradict it. `None`: the capture has none.
pub(super) fn after(
    opened: &OpenCapture,
    scene: &Scene<f32>,
    recipe: &Recipe,
    run: &Path,
) -> Result<Option<(Event, Option<String>)>> {
    let capture = &opened.capture;
    if capture.geometry.is_none() {
        return Ok(None);
    }
    let rows = rows(opened, scene, recipe)?;
    let frames: usize = rows.iter().map(|r| r.frames).sum();
    let measured = rows.iter().map(|r| r.measured * r.frames as f64).sum::<f64>() / frames.max(1) as f64;
    let compared: Vec<(&Row, f64)> = rows.iter().filter_map(|r| Some((r, r.errors?[0]))).collect();
    let error = median(&mut compared.iter().map(|c| c.1).collect::<Vec<_>>());
    let worst = compared.iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.camera.cmp(&a.0.camera)));
    let worst = worst.map(|(row, error)| (capture.cameras[row.camera].name.clone(), *error));
    let cameras: Vec<serde_json::Value> = rows
        .iter()
        .map(|r| {
            json!({
                "camera": capture.cameras[r.camera].name,
                "frames": r.frames,
                "measured": r.measured,
                "error": r.errors.map(|e| e[0]),
                "ratio": r.errors.map(|e| e[1]),
            })
        })
        .collect();
    let text = json!({
        "measured": measured,
        "error": error,
        "worst": worst.as_ref().map(|w| &w.0),
        "worst_error": worst.as_ref().map(|w| w.1),
        "cameras": cameras,
    });
    let text = serde_json::to_string_pretty(&text).expect("plain data is JSON");
    write_atomically(&run.join(FILE), text.as_bytes())?;
    let off = compared.iter().filter(|c| c.1 > OFF).count();
    let warning = worst.as_ref().filter(|_| off > 0).map(|(name, error)| {
        let ratio = compared.iter().find(|c| c.1 == *error).and_then(|c| c.0.errors).map_or(1.0, |e| e[1]);
        format!(
            "images and measured geometry disagree for {off} of {} cameras, most for {name}: by {:.0} % of the depth in the \
             median (the scene is {ratio:.2} times as far). The geometry may be misplaced (\"transform\"), of another time, or \
             the camera's pose may be wrong",
            compared.len(),
            100.0 * error
        )
    });
    let (worst, worst_error) = worst.unzip();
    Ok(Some((Event::Geometry { measured, error, worst, worst_error }, warning)))
}

/// One row per training camera.
fn rows(opened: &OpenCapture, scene: &Scene<f32>, recipe: &Recipe) -> Result<Vec<Row>> {
    let capture = &opened.capture;
    let antialias = if recipe.appearance.antialias { Antialias::On } else { Antialias::Off };
    let mut renderer = Renderer::new(RenderConfig { antialias, simd: opened.simd, ..RenderConfig::default() });
    let (mut picture, mut image) = (Picture::default(), Image::default());
    let mut of_camera = vec![Vec::new(); capture.cameras.len()];
    capture.train.iter().enumerate().for_each(|(i, &f)| of_camera[capture.frames[f].camera].push(i));
    let cameras = of_camera.iter().filter(|f| !f.is_empty()).count();
    let most = if cameras == 1 { OF_ALL / OF_CAMERA } else { (OF_ALL / cameras.max(1)).clamp(1, OF_CAMERA) };
    let mut rows = Vec::new();
    for (camera, frames) in of_camera.iter().enumerate().filter(|(_, f)| !f.is_empty()) {
        let chosen: Vec<usize> = frames.iter().step_by(frames.len().div_ceil(most)).copied().collect();
        let (mut shares, mut ratios) = (0.0, Vec::new());
        for &i in &chosen {
            opened.frames.load(i, &mut picture)?;
            let Some(truth) = picture.measured() else { continue };
            let known = truth.values.data.iter().filter(|z| **z > 0.0).count();
            shares += known as f64 / truth.values.data.len().max(1) as f64;
            draw(scene, opened, i, &mut renderer, &mut image);
            let pixels = image.depth.data.iter().zip(&image.alpha.data).zip(&truth.values.data);
            let shown = pixels.filter(|((_, alpha), known)| f64::from(**alpha) >= SEEN && **known > 0.0);
            ratios.extend(shown.map(|((depth, alpha), known)| depth / alpha / known));
        }
        let errors = (ratios.len() >= ENOUGH).then(|| {
            let middle = ratios.len() / 2;
            let ratio = f64::from(*ratios.select_nth_unstable_by(middle, f32::total_cmp).1);
            ratios.iter_mut().for_each(|r| *r = (*r - 1.0).abs());
            [f64::from(*ratios.select_nth_unstable_by(middle, f32::total_cmp).1), ratio]
        });
        rows.push(Row { camera, frames: chosen.len(), measured: shares / chosen.len() as f64, errors });
    }
    Ok(rows)
}
