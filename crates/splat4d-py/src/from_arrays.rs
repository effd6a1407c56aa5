//! Images in memory become a capture on disk: lossless files and a `capture.json`.

use crate::arrays::{Kind, finite, finite_rows, numbers, pixels};
use crate::camera::Camera;
use crate::errors::{OrRaise, bad_input};
use numpy::PyUntypedArrayMethods;
use pyo3::prelude::*;
use serde_json::{Value, json};
use splat4d::{Result, scene};
use splat4d_train::capture::PointCloud;
use splat4d_train::encode::{self, Pixels};
use splat4d_train::run::checkpoint::write_atomically;
use std::path::{Path, PathBuf};

/// Steps of a float image in its file: 16 bits a sample, whose rounding is far below a camera's resolution.
const LEVELS: f32 = 65535.0;

/// Arguments of the caller.
pub(crate) struct Arrays<'a, 'py> {
    pub(crate) images: &'a Bound<'py, PyAny>,
    pub(crate) cameras: &'a Bound<'py, PyAny>,
    pub(crate) times: Option<&'a Bound<'py, PyAny>>,
    pub(crate) points: Option<&'a Bound<'py, PyAny>>,
    pub(crate) colors: Option<&'a Bound<'py, PyAny>>,
    pub(crate) names: Option<Vec<String>>,
    pub(crate) fps: Option<f64>,
    pub(crate) up: Option<&'a Bound<'py, PyAny>>,
    pub(crate) hold_out: Option<Vec<String>>,
}

/// An image's samples, row by row.
enum Samples {
    Eight(Vec<u8>),
    Sixteen(Vec<u16>),
}

/// Writes the capture. Errors, which leave nothing behind: shapes that do not fit each other, numbers that are none, a
/// folder that holds a capture already.
pub(crate) fn write(py: Python<'_>, arrays: &Arrays<'_, '_>, folder: &Path) -> PyResult<()> {
    let mut written = Vec::new();
    let done = write_all(py, arrays, folder, &mut written);
    if done.is_err() {
        for path in &written {
            let _ = std::fs::remove_file(path);
            // Folders are removed when empty; those of the user are not empty.
            path.ancestors().skip(1).take_while(|f| *f != folder).for_each(|f| drop(std::fs::remove_dir(f)));
        }
    }
    done
}

fn write_all(py: Python<'_>, arrays: &Arrays<'_, '_>, folder: &Path, written: &mut Vec<PathBuf>) -> PyResult<()> {
    if folder.join("capture.json").exists() {
        let what = format!("{} holds a capture already", folder.display());
        return Err(bad_input(what, "Open it with Capture(path), or give another folder"));
    }
    let of_cameras: Vec<Bound<'_, PyAny>> = items(arrays.cameras, "cameras")?;
    let of_images: Vec<Bound<'_, PyAny>> = items(arrays.images, "images")?;
    if of_cameras.is_empty() || of_cameras.len() != of_images.len() {
        let what = format!("there are {} cameras and the images of {}", of_cameras.len(), of_images.len());
        return Err(bad_input(what, "Give one list of images for each camera"));
    }
    let names = match &arrays.names {
        Some(names) if names.len() == of_cameras.len() => names.clone(),
        Some(names) => {
            return Err(bad_input(
                format!("there are {} names for {} cameras", names.len(), of_cameras.len()),
                "Give one each",
            ));
        }
        None => (0..of_cameras.len()).map(|i| format!("cam{i:02}")).collect(),
    };
    if let Some(bad) =
        names.iter().find(|n| n.is_empty() || n.contains(['/', '\\', '%', '\0']) || *n == "." || *n == "..")
    {
        return Err(bad_input(format!("invalid name of a camera: \"{bad}\""), "Use letters, digits and dashes"));
    }
    let mut entries = Vec::new();
    for (c, name) in names.iter().enumerate() {
        let camera = Filmed { folder, number: c, name, cameras: &of_cameras[c], images: &of_images[c] };
        entries.push(camera.write(py, arrays, written)?);
    }
    let mut top = json!({"version": 1, "cameras": entries});
    if let Some(fps) = arrays.fps {
        top["fps"] = json!(fps);
    }
    if let Some(up) = arrays.up {
        top["up"] = json!(finite::<3>(up, "up")?);
    }
    if let Some(hold_out) = &arrays.hold_out {
        top["hold_out"] = json!({"cameras": hold_out});
    }
    if let Some(points) = arrays.points {
        let cloud = cloud(points, arrays.colors)?;
        let path = free(folder.join("points.ply"))?;
        write_atomically(&path, &cloud.to_ply("comment from arrays")).or_raise()?;
        written.push(path);
        top["points"] = json!("points.ply");
    }
    write_atomically(&folder.join("capture.json"), format!("{top:#}\n").as_bytes()).or_raise()
}

/// The path, where nothing is there yet.
fn free(path: PathBuf) -> PyResult<PathBuf> {
    if std::fs::symlink_metadata(&path).is_ok() {
        let what = format!("{} exists already", path.display());
        return Err(bad_input(what, "Give a folder without images and points"));
    }
    Ok(path)
}

/// One camera as the caller gave it.
struct Filmed<'a, 'py> {
    folder: &'a Path,
    number: usize,
    name: &'a str,
    cameras: &'a Bound<'py, PyAny>,
    images: &'a Bound<'py, PyAny>,
}

impl Filmed<'_, '_> {
    /// Its positions: one, or one per frame.
    fn views(&self) -> PyResult<Vec<Camera>> {
        if let Ok(fixed) = self.cameras.extract::<Camera>() {
            return Ok(vec![fixed]);
        }
        let what = format!("cameras[{}]", self.number);
        let one = |camera: &Bound<'_, PyAny>| {
            let wrong = || bad_input(format!("{what}: expected Camera objects"), "Give splat4d.Camera objects");
            camera.extract::<Camera>().map_err(|_| wrong())
        };
        items(self.cameras, &what)?.iter().map(one).collect()
    }

    /// Writes its images; its entry.
    fn write(&self, py: Python<'_>, arrays: &Arrays<'_, '_>, written: &mut Vec<PathBuf>) -> PyResult<Value> {
        let Self { folder, number, name, .. } = *self;
        let (images, views) = (items(self.images, &format!("images[{number}]"))?, self.views()?);
        let moving = !self.cameras.is_instance_of::<Camera>();
        let Some(Camera(first)) = views.first().filter(|_| !images.is_empty()) else {
            return Err(bad_input(format!("camera {name} has no images"), "Leave it out"));
        };
        if moving && views.len() != images.len() {
            let what = format!("camera {name} has {} poses for {} images", views.len(), images.len());
            return Err(bad_input(what, "Give one Camera a frame, or one for all"));
        }
        let lens = |c: &scene::Camera| (c.intrinsics, c.width, c.height);
        if views.iter().any(|v| lens(&v.0) != lens(first)) {
            return Err(bad_input(format!("the lens or size of camera {name} changes"), "Make two cameras of it"));
        }
        let times = times(arrays.times, number, images.len(), arrays.fps)?;
        let files: Vec<String> = (0..images.len()).map(|k| format!("images/{name}/{k:06}.png")).collect();
        for (k, image) in images.iter().enumerate() {
            let samples = samples(image, &format!("images[{number}][{k}]"), first)?;
            let path = free(folder.join(&files[k]))?;
            py.detach(|| store(&samples, first, &path)).or_raise()?;
            written.push(path);
        }
        let pose = |c: &scene::Camera| {
            let (r, t) = (c.cam_from_world.rotation, c.cam_from_world.translation);
            let row = |i: usize| if i < 3 { [r[i][0], r[i][1], r[i][2], t[i]] } else { [0.0, 0.0, 0.0, 1.0] };
            [0, 1, 2, 3].map(row)
        };
        let poses: Vec<_> = views.iter().map(|v| pose(&v.0)).collect();
        let k = &first.intrinsics;
        let mut entry = json!({
            "name": name, "width": first.width, "height": first.height,
            "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "images": files,
            "world_to_camera": if moving { json!(poses) } else { json!(poses[0]) },
        });
        if let Some(times) = times {
            entry["times"] = json!(times);
        }
        Ok(entry)
    }
}

/// The elements of a list, a tuple or an array's first axis.
fn items<'py>(value: &Bound<'py, PyAny>, what: &str) -> PyResult<Vec<Bound<'py, PyAny>>> {
    let all = value.try_iter().and_then(|all| all.collect::<PyResult<Vec<_>>>());
    all.map_err(|e| {
        bad_input(format!("{what} cannot be iterated ({e})"), "Give a list, or an array with one axis more")
    })
}

fn times(
    times: Option<&Bound<'_, PyAny>>,
    camera: usize,
    count: usize,
    fps: Option<f64>,
) -> PyResult<Option<Vec<f64>>> {
    let Some(times) = times else {
        // One frame needs no times, and a frame rate gives all others.
        return match count > 1 && fps.is_none() {
            true => Err(bad_input("there are no times", "Give times in seconds, or fps")),
            false => Ok(None),
        };
    };
    let own = times.get_item(0).ok().filter(|first| first.extract::<f64>().is_err()).is_some();
    let (list, what) = match own {
        true => {
            let lists = items(times, "times")?;
            let list = lists.get(camera).cloned();
            let list =
                list.ok_or_else(|| bad_input(format!("no times are given for camera {camera}"), "Give a list each"))?;
            (list, format!("times[{camera}]"))
        }
        false => (times.clone(), "times".to_owned()),
    };
    let all: Vec<f64> = numbers::<f64>(&list, &what)?.as_array().iter().copied().collect();
    if all.len() != count {
        return Err(bad_input(
            format!("{what} are {}, but there are {count} images", all.len()),
            "Give one time a frame",
        ));
    }
    if let Some(k) = all.iter().position(|t| !t.is_finite()) {
        return Err(bad_input(format!("{what}[{k}] is {}", all[k]), "Give seconds"));
    }
    Ok(Some(all))
}

fn cloud(points: &Bound<'_, PyAny>, colors: Option<&Bound<'_, PyAny>>) -> PyResult<PointCloud> {
    let points = finite_rows::<3>(points, "points")?;
    let colors = match colors {
        Some(colors) => finite_rows::<3>(colors, "colors")?.into_iter().map(|c| c.map(|x| x as f32)).collect(),
        None => vec![[0.5; 3]; points.len()],
    };
    if colors.len() != points.len() || colors.iter().flatten().any(|x| !(0.0..=1.0).contains(x)) {
        let what = format!("colors are {} of {} points, or not within 0 to 1", colors.len(), points.len());
        return Err(bad_input(what, "Give [N, 3] from 0 to 1"));
    }
    let times = vec![None; points.len()];
    Ok(PointCloud { points, colors, times, left_out: 0 })
}

/// An image [h, w, 3] of a camera's size as samples for a file.
fn samples(image: &Bound<'_, PyAny>, what: &str, camera: &scene::Camera) -> PyResult<Samples> {
    let fits = |shape: &[usize]| match shape == [camera.height, camera.width, 3] {
        true => Ok(()),
        false => {
            let wanted = format!("Its camera has [{}, {}, 3]", camera.height, camera.width);
            Err(bad_input(format!("{what} has the shape {shape:?}"), &wanted))
        }
    };
    if !image.hasattr("__array__")? {
        return Err(bad_input(format!("{what} is not an array"), "Give NumPy arrays"));
    }
    let (image, kind) = pixels(image, what)?;
    match kind {
        Kind::Bytes => {
            let array = numbers::<u8>(&image, what)?;
            fits(array.shape())?;
            Ok(Samples::Eight(array.as_array().iter().copied().collect()))
        }
        Kind::Floats => {
            let array = numbers::<f32>(&image, what)?;
            fits(array.shape())?;
            let mut out = Vec::with_capacity(array.len());
            for (i, x) in array.as_array().iter().enumerate() {
                if !(0.0..=1.0).contains(x) {
                    let pixel = i / 3;
                    let place = format!("row {}, column {}", pixel / camera.width, pixel % camera.width);
                    return Err(bad_input(format!("{what} is {x} at {place}"), "Give floats from 0 to 1, or uint8"));
                }
                out.push((x * LEVELS).round() as u16);
            }
            Ok(Samples::Sixteen(out))
        }
    }
}

fn store(samples: &Samples, camera: &scene::Camera, path: &Path) -> Result<()> {
    let pixels = match samples {
        Samples::Eight(samples) => Pixels::Eight(samples),
        Samples::Sixteen(samples) => Pixels::Sixteen(samples),
    };
    write_atomically(path, &encode::png(pixels, [camera.width, camera.height], 3))
}
