//! `capture.json`: images, poses and times.

use super::{Masks, Pictures};
use crate::sync::graph::Offset;
use serde_json::{Map, Value, json};
use splat4d::math::Se3;
use splat4d::scene::{Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::run::checkpoint::write_atomically;
use std::path::{Path, PathBuf};

/// Times are written to this many parts of a second: cameras' clocks are no finer, and people can read them.
const TICKS: f64 = 1e6;

/// Pose of a camera.
#[derive(Clone, Debug, PartialEq)]
pub enum Poses {
    /// One pose for all shots: `cam_from_world`.
    Fixed(Se3),
    /// A pose for every shot; shots whose pose is not known are left out.
    Moving(Vec<Option<Se3>>),
}

/// A camera whose clock, lens and position are known.
#[derive(Clone, Debug)]
pub struct Placed {
    /// Its images.
    pub pictures: Pictures,
    /// Its clock.
    pub offset: Offset,
    /// Pixels of the stored images.
    pub intrinsics: Intrinsics,
    /// Of the stored images, which are not undistorted.
    pub lens: Lens,
    /// Its pose.
    pub poses: Poses,
    /// Mask of its images.
    pub masks: Option<Masks>,
}

/// Data of the whole recording.
#[derive(Clone, Debug, Default)]
pub struct Recording {
    /// A short name; the folder's if there is none.
    pub name: Option<String>,
    /// Upwards in the world.
    pub up: Option<[f64; 3]>,
    /// The initial cloud, from the folder on.
    pub points: Option<PathBuf>,
    /// The file of its sound, from the folder on, and the second at which it begins.
    pub sound: Option<(PathBuf, f64)>,
    /// Cameras that are kept from training. None: of a rig of fixed cameras all train, because each was placed with
    /// care.
    pub hold_out: Vec<String>,
    /// Anything else for those who read the file; training does not.
    pub extra: Map<String, Value>,
}

/// Writes `capture.json` into the folder that holds the images; the file.
///
/// Errors: no cameras, no images of one, poses that are not as many as shots, no space.
pub fn capture(folder: &Path, take: &Recording, cameras: &[Placed]) -> Result<PathBuf> {
    if cameras.is_empty() {
        return Err(Error::input("no camera has a known position").remedy("See the report for why."));
    }
    // The median rate of all; each camera's own times are more accurate.
    let mut intervals: Vec<f64> = cameras.iter().map(|c| c.pictures.clock.interval).filter(|i| *i > 0.0).collect();
    intervals.sort_by(f64::total_cmp);
    let interval = intervals.get(intervals.len() / 2).copied();
    let list = cameras.iter().map(camera).collect::<Result<Vec<Value>>>()?;
    let mut top = json!({"version": 1, "cameras": list});
    let mut set = |key: &str, value: Value| drop(top.as_object_mut().expect("it is one").insert(key.into(), value));
    if let Some(interval) = interval {
        set("fps", json!((1e3 / interval).round() / 1e3));
    }
    if let Some(name) = &take.name {
        set("name", json!(name));
    }
    if let Some(up) = take.up {
        set("up", json!(up));
    }
    if let Some(points) = &take.points {
        set("points", json!(points.to_string_lossy().replace('\\', "/")));
    }
    if let Some((file, start)) = &take.sound {
        let start = (start * TICKS).round() / TICKS;
        set("sound", json!({"file": file.to_string_lossy().replace('\\', "/"), "start": start}));
    }
    let is_rig = cameras.len() > 1 && cameras.iter().all(|c| matches!(c.poses, Poses::Fixed(_)));
    if !take.hold_out.is_empty() {
        set("hold_out", json!({"cameras": take.hold_out}));
    } else if is_rig {
        set("hold_out", json!("none"));
    }
    if !take.extra.is_empty() {
        set("extra", Value::Object(take.extra.clone()));
    }
    let path = folder.join("capture.json");
    write_atomically(&path, format!("{top:#}\n").as_bytes())?;
    Ok(path)
}

fn camera(camera: &Placed) -> Result<Value> {
    let Placed { pictures, offset, intrinsics, lens, poses, masks } = camera;
    let place = |e: Error| e.at(format!("camera {}", pictures.name));
    if pictures.shots.is_empty() {
        return Err(place(Error::input("there are no images of it").remedy("Leave the camera out.")));
    }
    let matrix = |p: &Se3| {
        let row = |i: usize| {
            let r = p.rotation[i];
            [r[0], r[1], r[2], p.translation[i]]
        };
        [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
    };
    let world_to_camera = match poses {
        Poses::Fixed(pose) => json!(matrix(pose)),
        Poses::Moving(all) if all.len() == pictures.shots.len() => {
            json!(all.iter().flatten().map(matrix).collect::<Vec<_>>())
        }
        Poses::Moving(all) => {
            let what = format!("there are {} poses for {} images", all.len(), pictures.shots.len());
            return Err(place(Error::input(what).remedy("Import it again.")));
        }
    };
    let (model, terms) = lens.terms().ok_or_else(|| {
        place(Error::new(ErrorKind::Unsupported, "panoramas of moving scenes are not imported"))
            .remedy("Cut perspective videos out of them first (ffmpeg's filter v360).")
    })?;
    let mut distortion = json!({"model": model});
    ["k", "p", "s"].iter().zip(terms).filter(|(_, t)| !t.is_empty()).for_each(|(key, t)| distortion[key] = json!(t));
    let tick = |t: f64| (t * TICKS).round() / TICKS;
    let known: Vec<usize> = match poses {
        Poses::Fixed(_) => (0..pictures.shots.len()).collect(),
        Poses::Moving(all) => (0..all.len()).filter(|&k| all[k].is_some()).collect(),
    };
    if known.is_empty() {
        return Err(place(Error::input("it has no known position").remedy("Leave the camera out.")));
    }
    let times: Vec<f64> = known.iter().map(|&k| tick(pictures.shots[k].time * (1.0 + offset.rate))).collect();
    let images = if known.len() == pictures.shots.len() {
        json!(pictures.pattern)
    } else {
        json!(known.iter().map(|&k| pictures.file(k).to_string_lossy().replace('\\', "/")).collect::<Vec<_>>())
    };
    let mut out = json!({
        "name": pictures.name,
        "width": pictures.size[0],
        "height": pictures.size[1],
        "fx": intrinsics.fx,
        "fy": intrinsics.fy,
        "cx": intrinsics.cx,
        "cy": intrinsics.cy,
        "distortion": distortion,
        "world_to_camera": world_to_camera,
        "time_offset": tick(offset.seconds),
        "times": times,
        "images": images,
        "frames": known.len(),
    });
    if let Some(masks) = masks {
        let path = |&k: &usize| masks.files[k].to_string_lossy().replace('\\', "/");
        out["masks"] = json!(known.iter().map(path).collect::<Vec<_>>());
    }
    Ok(out)
}
