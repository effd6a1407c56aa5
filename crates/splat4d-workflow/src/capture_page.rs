//! Cameras, images and points of a capture, for the player's page: `view` of a capture or a run, and `train --view`.

use crate::draw::{Rgb, color_rgb};
use serde_json::{Value, json};
use splat4d::format::playback::NamedCamera;
use splat4d::layers::{Layer, Scene};
use splat4d::motion::Still;
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, LifeKind, Params, SH};
use splat4d_serve::{Photo, PhotoQuery, Photos};
use splat4d_train::capture::{Capture, ImageStore, PointCloud, Split};
use splat4d_train::encode;
use std::sync::Arc;

/// Most cameras that a page draws and lists.
const MOST_CAMERAS: usize = 200;
/// Memory for decoded images, bytes.
const MEMORY: usize = 64 << 20;
/// JPEG quality: no artefact that could be taken for one of the photo's.
const QUALITY: u8 = 88;
/// Time offsets below this are none, seconds.
const SAME_CLOCK: f64 = 1e-5;
/// Standard deviation of a point's dot, of the mean distance between points on a surface as large as the cloud.
const DOT: f64 = 0.3;
/// Raw opacity of a dot: 0.95.
const DOT_OPACITY: f32 = 3.0;
/// The constant of the zeroth spherical harmonic (Y₀₀ = 1/(2√π)): colour = 0.5 + Y₀₀ · coefficient.
const Y00: f32 = 0.282_094_8;

/// A camera of the page, and the frames whose images it has.
struct Listed {
    /// Indices into [`Capture::frames`], by time. A camera that moves has one entry per frame.
    frames: Vec<usize>,
}

/// The cameras that a page shows: fixed ones once, moving ones at even steps.
fn listed(capture: &Capture) -> Vec<Listed> {
    let mut frames: Vec<Vec<usize>> = vec![Vec::new(); capture.cameras.len()];
    for (i, frame) in capture.frames.iter().enumerate() {
        frames[frame.camera].push(i);
    }
    let mut all = Vec::new();
    for (camera, mut list) in frames.into_iter().enumerate().filter(|(_, list)| !list.is_empty()) {
        list.sort_by(|a, b| capture.frames[*a].time.0.total_cmp(&capture.frames[*b].time.0));
        match capture.cameras[camera].fixed {
            true => all.push(Listed { frames: list }),
            false => all.extend(list.into_iter().map(|i| Listed { frames: vec![i] })),
        }
    }
    let stride = all.len().div_ceil(MOST_CAMERAS).max(1);
    all.into_iter().step_by(stride).collect()
}

/// Seconds by which a camera's clock differs from its frame numbers.
fn clock(capture: &Capture, listed: &Listed) -> Option<f64> {
    let first = &capture.frames[listed.frames[0]];
    (capture.fps > 0.0 && listed.frames.len() > 1).then(|| first.time.0 - first.index as f64 / capture.fps)
}

/// The list of a page, and the images of its cameras.
pub fn cameras(capture: Arc<Capture>) -> (Value, Photos) {
    let list = listed(&capture);
    let offsets: Vec<Option<f64>> = list.iter().map(|l| clock(&capture, l)).collect();
    let reference = offsets.iter().flatten().copied().next().unwrap_or(0.0);
    let entry = |(l, offset): (&Listed, &Option<f64>)| {
        let frame = &capture.frames[l.frames[0]];
        let name = &capture.cameras[frame.camera].name;
        let mut value = serde_json::to_value(NamedCamera::new(name, &frame.view)).expect("plain data");
        value["frames"] = json!(l.frames.len());
        value["held"] = json!(capture.split(l.frames[0]) == Split::Held);
        let offset = offset.map(|o| o - reference).filter(|o| o.abs() > SAME_CLOCK);
        value["offset"] = json!(offset);
        if !capture.cameras[frame.camera].fixed {
            value["time"] = json!(frame.time.0);
        }
        value
    };
    let entries = list.iter().zip(&offsets).map(entry).collect();
    let store = ImageStore::new(capture, MEMORY);
    (entries, Photos::new(move |wanted| find(&store, &list, wanted)))
}

fn find(store: &ImageStore, list: &[Listed], wanted: &PhotoQuery) -> Option<Photo> {
    let frames = &store.capture().frames;
    let away = |i: &usize| (frames[*i].time.0 - wanted.time).abs();
    let nearest = list.get(wanted.view)?.frames.iter().copied().min_by(|a, b| away(a).total_cmp(&away(b)))?;
    let rgb = color_rgb(&store.load(nearest).ok()?.to_picture().color);
    let Rgb { width, height, data } = reduced(rgb, wanted.side);
    let jpeg = encode::jpeg(&data, [width, height], QUALITY).ok()?;
    Some(Photo { jpeg, time: frames[nearest].time.0 })
}

/// An image whose longer side has at most this many pixels.
fn reduced(picture: Rgb, side: usize) -> Rgb {
    let longest = picture.width.max(picture.height);
    if longest <= side {
        return picture;
    }
    let size = [picture.width, picture.height];
    let [width, height] = size.map(|x| (x * side / longest).max(1));
    Rgb { width, height, data: encode::resample(&picture.data, 3, size, [width, height]) }
}

/// The points of a capture as a static scene of dots over the capture's time; a capture without points has one dot
/// where its cameras point.
pub fn points(capture: &Capture) -> Scene<f32> {
    let none = PointCloud::default();
    let cloud = capture.points.as_ref().unwrap_or(&none);
    let middle = [middle(capture)];
    let (places, colors) = match cloud.points.is_empty() {
        true => (&middle[..], &[[0.5; 3]][..]),
        false => (&cloud.points[..], &cloud.colors[..]),
    };
    let size = spacing(places) * DOT;
    let mut p = Params::new(places.len(), 1, LifeKind::Infinite.columns());
    for (row, (x, rgb)) in places.iter().zip(colors).enumerate() {
        p[GEOMETRY].write(row, 0, x.map(|x| x as f32));
        p[GEOMETRY].write(row, QUAT, [1.0, 0.0, 0.0, 0.0]);
        p[GEOMETRY].write(row, LOG_SCALE, [size.ln() as f32; 3]);
        p[GEOMETRY].set(row, OPACITY, DOT_OPACITY);
        p[SH].write(row, 0, rgb.map(|c| (c - 0.5) / Y00));
    }
    let layer = Layer::new("points", p, Arc::new(Still), LifeKind::Infinite);
    let (first, last) = capture.time_range();
    Scene {
        layers: vec![layer],
        clip: if first <= last { [first, last] } else { [0.0; 2] },
        fps: capture.fps,
        up: capture.up,
        offset: capture.offset,
        ..Scene::default()
    }
}

/// Mean distance between points if they lay evenly on a surface as large as the cloud.
fn spacing(points: &[[f64; 3]]) -> f64 {
    let n = points.len() as f64;
    let mean: [f64; 3] = std::array::from_fn(|k| points.iter().map(|x| x[k]).sum::<f64>() / n);
    let square = |x: &[f64; 3]| (0..3).map(|k| (x[k] - mean[k]).powi(2)).sum::<f64>();
    let spread = (points.iter().map(square).sum::<f64>() / n).sqrt();
    if spread > 0.0 { spread / n.sqrt() } else { 0.01 }
}

/// The middle of the cameras, one distance between neighbours ahead of them.
fn middle(capture: &Capture) -> [f64; 3] {
    let n = capture.frames.len().max(1) as f64;
    let mean = |of: &dyn Fn(usize) -> [f64; 3]| -> [f64; 3] {
        std::array::from_fn(|k| (0..capture.frames.len()).map(|i| of(i)[k]).sum::<f64>() / n)
    };
    let (center, ahead) = (mean(&|i| capture.frames[i].view.center()), mean(&|i| capture.frames[i].view.forward()));
    std::array::from_fn(|k| center[k] + ahead[k])
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d_train::recipe::Recipe;
    use splat4d_train::run::open_capture;
    use std::path::Path;

    fn knight() -> Arc<Capture> {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/knight");
        Arc::new(open_capture(&root, &Recipe::default()).unwrap())
    }

    #[test]
    fn a_capture_is_shown_by_its_cameras_their_images_and_its_points() {
        let capture = knight();
        let scene = points(&capture);
        assert_eq!(scene.len(), capture.points.as_ref().map_or(1, |p| p.points.len()));
        assert_eq!(scene.clip, <[f64; 2]>::from(capture.time_range()));
        let (list, _) = cameras(capture.clone());
        let list = list.as_array().unwrap().clone();
        assert_eq!(list.len(), capture.cameras.len(), "fixed cameras are listed once");
        let held = list.iter().filter(|c| c["held"] == true).count();
        assert!(held > 0 && held < list.len());
        assert!(list.iter().all(|c| c["frames"].as_u64().unwrap() > 1 && c["world_from_camera"].is_array()));
    }

    #[test]
    fn the_image_nearest_in_time_is_found_and_reduced() {
        let capture = knight();
        let list = listed(&capture);
        let store = ImageStore::new(capture.clone(), MEMORY);
        let (first, last) = capture.time_range();
        let find = |view, time| find(&store, &list, &PhotoQuery { view, time, side: 40 });
        let photo = find(1, last + 5.0).unwrap();
        assert_eq!(photo.time, last);
        let picture = image::load_from_memory(&photo.jpeg).unwrap();
        assert_eq!(picture.width().max(picture.height()), 40);
        assert_eq!(find(1, first).unwrap().time, first);
        assert!(find(list.len(), first).is_none());
    }
}
