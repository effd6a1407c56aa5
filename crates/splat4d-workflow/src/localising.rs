//! The work behind `localise`: pose and time of images of a scene.

mod search;

use crate::camera_file;
use crate::events::Listener;
use crate::files;
use crate::paths::View;
use crate::run_folder::{view_json, views_in};
use crate::source::{Source, not_empty};
use search::{Located, Query, SURE};
use serde_json::{Value, json};
use splat4d::render::Antialias;
use splat4d::scene::{Camera, Intrinsics, Planes};
use splat4d::{Error, Result};
use splat4d_train::capture::Rgb8;
use std::path::{Path, PathBuf};

/// Largest difference of the shapes (width over height) of an image and a start's.
const SHAPE: f64 = 0.02;

/// Options of [`localise()`].
#[derive(Clone, Debug, Default)]
pub struct LocaliseOptions {
    /// Start from this camera (a camera file), or these (a `cameras.json`); none: from the run's cameras.
    pub start: Option<PathBuf>,
    /// Also find the focal length.
    pub lens: bool,
    /// Write the cameras found to this file, as `cameras.json`.
    pub output: Option<PathBuf>,
}

/// Finds pose and time of images (JPEG, PNG or WebP) of a scene, each independently; returns the cameras as entries of
/// `cameras.json`, in the order of the images.
///
/// Errors: an image was not found, after all of them were tried and those found were written; files that cannot be
/// read; a scene file without start cameras; an image whose shape is not that of a start.
///
/// ```no_run
/// use splat4d_workflow::localising::{LocaliseOptions, localise};
///
/// # fn main() -> splat4d::Result<()> {
/// let photos = ["photo.jpg".into()];
/// let listen = &splat4d_workflow::events::ignore;
/// let found = localise("runs/knight".as_ref(), &photos, &LocaliseOptions::default(), listen)?;
/// println!("{} at {} s", found[0]["position"], found[0]["time"]);
/// # Ok(())
/// # }
/// ```
pub fn localise(
    scene: &Path,
    images: &[PathBuf],
    options: &LocaliseOptions,
    console: &dyn Listener,
) -> Result<Vec<Value>> {
    let source = Source::open(scene)?;
    not_empty(&source.scene, scene)?;
    if let Some(output) = &options.output {
        let read: Vec<&Path> = images.iter().chain(&options.start).map(PathBuf::as_path).collect();
        source.keep(scene, output, &read)?;
    }
    let starts = starts(scene, options.start.as_deref(), &source)?;
    let recipe = source.run.as_ref().and_then(|run| run.recipe().ok());
    let antialias = if recipe.is_some_and(|r| r.appearance.antialias) { Antialias::On } else { Antialias::Off };
    let query = Query { antialias, lens: options.lens };
    let (mut found, mut lost): (Vec<Value>, Vec<String>) = (Vec::new(), Vec::new());
    for path in images {
        let picture = read(path)?;
        let cameras = resized(&starts, &picture).map_err(|e| e.at(path.display()))?;
        let name = path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned());
        let located = search::localise(&source.scene, &picture, &cameras, query, &mut |done, all| {
            console.phase(&format!("localising {name}"), done, all);
        })?;
        console.clear();
        let row = row(&located, &name, found.len());
        if located.sure {
            console.result(&in_words(&located, &name));
            console.emit(&json!({"type": "located", "picture": path.to_string_lossy(), "camera": row}));
            found.push(row);
        } else {
            console
                .emit(&json!({"type": "not_located", "picture": path.to_string_lossy(), "residual": located.residual,
                "share": located.share}));
            lost.push(format!("{name} ({:.0} % of a plain colour's difference)", 100.0 * located.share));
        }
    }
    if let (Some(output), false) = (&options.output, found.is_empty()) {
        let text = serde_json::to_string_pretty(&found).expect("cameras are plain data");
        files::write(output, text.as_bytes())?;
        console.written(output);
    }
    if lost.is_empty() {
        return Ok(found);
    }
    Err(Error::input(format!(
        "not found: {}; at most {:.0} % of a plain colour's difference may be left",
        lost.join(", "),
        100.0 * SURE
    ))
    .at(scene.display())
    .remedy("Give a camera nearer to it with option `start`."))
}

/// Start cameras.
fn starts(scene: &Path, start: Option<&Path>, source: &Source) -> Result<Vec<View>> {
    let mut views = match (start, &source.run) {
        (Some(path), _) => match views_in(path)? {
            Some(views) => views,
            None => {
                let (camera, _) = camera_file::read(path)?;
                vec![View { camera, name: "start".into(), time: 0.0, held: false }]
            }
        },
        (None, Some(run)) => run.views()?,
        (None, None) => {
            return Err(Error::input("a scene file has no start camera")
                .at(scene.display())
                .remedy("Add option `start` CAMERA.json, or give the run folder."));
        }
    };
    // A fixed camera's frames are one start.
    let mut seen: Vec<Camera> = Vec::new();
    views.retain(|view| {
        let new = !seen.contains(&view.camera);
        if new {
            seen.push(view.camera.clone());
        }
        new
    });
    Ok(views)
}

/// The starts with the image's size. Errors: none has its shape.
fn resized(starts: &[View], picture: &Planes<f32>) -> Result<Vec<Camera>> {
    let shape = |w: usize, h: usize| w as f64 / h as f64;
    let of_shape = |c: &&View| {
        (shape(c.camera.width, c.camera.height) / shape(picture.width, picture.height) - 1.0).abs() <= SHAPE
    };
    let sized = |view: &View| {
        let (k, c) = (view.camera.intrinsics, &view.camera);
        let (x, y) = (picture.width as f64 / c.width as f64, picture.height as f64 / c.height as f64);
        let intrinsics = Intrinsics { fx: k.fx * x, fy: k.fy * y, cx: k.cx * x, cy: k.cy * y };
        Camera { intrinsics, width: picture.width, height: picture.height, ..c.clone() }
    };
    let cameras: Vec<Camera> = starts.iter().filter(of_shape).map(sized).collect();
    if cameras.is_empty() {
        let other = starts.first().map(|v| format!("{}x{}", v.camera.width, v.camera.height)).unwrap_or_default();
        return Err(Error::input(format!(
            "the image is {}x{}, and no start camera has that aspect ratio (such as {other})",
            picture.width, picture.height
        ))
        .remedy("Crop or scale the image, or give its own camera with option `start`."));
    }
    Ok(cameras)
}

fn read(path: &Path) -> Result<Planes<f32>> {
    let picture = Rgb8::read(path)?;
    let data: Vec<f32> = picture.data.iter().map(|&b| f32::from(b) / 255.0).collect();
    Ok(Planes::from_interleaved(3, picture.height, picture.width, &data))
}

fn row(located: &Located, name: &str, id: usize) -> Value {
    let view = View { camera: located.camera.clone(), name: name.to_owned(), time: located.time.0, held: false };
    let mut row = view_json(id, &view);
    row["residual"] = json!(located.residual);
    row["share"] = json!(located.share);
    row
}

fn in_words(located: &Located, name: &str) -> String {
    let [x, y, z] = located.camera.center();
    let axis = located.camera.cam_from_world.rotation[2];
    format!(
        "{name}: at ({x:.4}, {y:.4}, {z:.4}), looking along ({:.4}, {:.4}, {:.4}), at {:.3} s; residual {:.4}, {:.0} \
         % of that of a plain colour",
        axis[0],
        axis[1],
        axis[2],
        located.time.0,
        located.residual,
        100.0 * located.share
    )
}
