//! Videos become a capture; what a capture, a run or a file contains.

use crate::capture::Capture;
use crate::errors::{OrRaise, bad_input};
use crate::plain::plain;
use crate::settings::set;
use crate::workflows;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde_json::{Value, json};
use splat4d_import::board::Board;
use splat4d_import::recording::{FPS, Request, Rig, SIZE};
use splat4d_import::video::{Crop, Cropping, Selection};
use splat4d_import::write::Format;
use splat4d_train::recipe::Recipe;
use splat4d_workflow::importing;
use splat4d_workflow::inspecting::{self, InspectOptions};
use std::path::PathBuf;

/// Makes a capture in the folder `out` from videos, folders of videos, or folders of images, one per camera: frames,
/// synchronisation, poses, lenses and points (docs/own-videos.md). Returns the capture; its folder has `import.toml`, in which
/// results can be corrected before the same call is repeated.
///
/// `rig`: "fixed", "moving" or "auto". `every` keeps each n-th frame; `start` and `end` are seconds of the first camera's video;
/// `size` is the shorter side of the images. `crop`: "auto" cuts off black bars, or (width, height, x, y) in pixels of the videos.
/// `apart`: two cameras and their distance in metres. `board`: tags, such as "36h11:0.16:floor". `camera_height`: a camera and its
/// height above the floor in metres. `calibration`: lenses and poses from a file or folder of another program. `colmap`: finds them
/// by the COLMAP program. `points`: a file of points that were clicked in the page of `splat4d import --assist`. `keypoints`:
/// keypoints of people, a folder as of `--keypoints` or a network (`.onnx`) that finds them. `matcher`: a network (`.onnx`)
/// that matches two images, for cameras whose features do not match (docs/networks.md), with the name of a ready-made description in
/// `described` or a file next to it. `masks`: a folder, white where images count. `check`: examine the finished capture too, and write
/// `import/doctor.html`. Ctrl-C stops; stored results are kept.
#[pyfunction]
#[pyo3(signature = (
    videos, out, *, rig="auto", every=1, start=None, end=None, size=SIZE, fps=FPS, sound=true, synchronous=false, crop=None,
    apart=None, board=None, camera_height=None, calibration=None, colmap=false, points=None, keypoints=None, matcher=None, described=None, masks=None, deinterlace=false, png=false,
    check=true
))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn import_videos(
    py: Python<'_>,
    videos: Vec<PathBuf>,
    out: PathBuf,
    rig: &str,
    every: usize,
    start: Option<f64>,
    end: Option<f64>,
    size: usize,
    fps: f64,
    sound: bool,
    synchronous: bool,
    crop: Option<&Bound<'_, PyAny>>,
    apart: Option<(String, String, f64)>,
    board: Option<&str>,
    camera_height: Option<(String, f64)>,
    calibration: Option<PathBuf>,
    colmap: bool,
    points: Option<PathBuf>,
    keypoints: Option<PathBuf>,
    matcher: Option<PathBuf>,
    described: Option<&str>,
    masks: Option<PathBuf>,
    deinterlace: bool,
    png: bool,
    check: bool,
) -> PyResult<Capture> {
    let metres = apart.as_ref().map(|a| a.2).into_iter().chain(camera_height.as_ref().map(|h| h.1));
    if metres.into_iter().any(|m| !m.is_finite() || m <= 0.0) {
        return Err(bad_input("a length is not above 0 m", "Give metres"));
    }
    let request = Request {
        selection: Selection { every, from: start, to: end, size: Some(size), deinterlace, crop: None },
        crop: crop.map(cropping).transpose()?,
        fps,
        rig: match rig {
            "auto" => Rig::Auto,
            "fixed" => Rig::Fixed,
            "moving" => Rig::Moving,
            _ => return Err(bad_input(format!("there is no rig `{rig}`"), "Give auto, fixed or moving")),
        },
        sound,
        format: if png { Format::Png } else { Format::default() },
        apart: apart.map(|(a, b, metres)| ([a, b], metres)),
        board: board.map(str::parse::<Board>).transpose().or_raise()?,
        camera_height,
        calibration,
        colmap,
        points,
        keypoints: keypoints.map(|path| importing::keypoints(&path, described)).transpose().or_raise()?,
        matcher: matcher.map(|network| importing::matcher(&network, described)).transpose().or_raise()?,
        masks,
        synchronous,
        ..Request::new(videos, out)
    };
    workflows::run(py, |listener, stop| importing::import(&request, check, stop, listener))?;
    Capture::open(py, request.folder, &Recipe::default(), None)
}

fn cropping(crop: &Bound<'_, PyAny>) -> PyResult<Cropping> {
    if crop.extract::<&str>().is_ok_and(|text| text == "auto") {
        return Ok(Cropping::Auto);
    }
    match crop.extract::<(usize, usize, usize, usize)>() {
        Ok((width, height, x, y)) if width > 0 && height > 0 => Ok(Cropping::At(Crop { width, height, x, y })),
        _ => Err(bad_input("invalid crop", "Give \"auto\" or (width, height, x, y)")),
    }
}

/// What a capture, a run or a scene file contains, a dict as `splat4d info --json` prints it: `healthy`, and in `troubles` what is
/// wrong. `doctor`: a folder; a capture's images and poses are checked too, and `doctor.html` and `doctor.json` are written there.
/// `settings` are how a capture is read: `downscale=2`, `hold_out="every=8"`.
#[pyfunction]
#[pyo3(signature = (path, *, doctor=None, **settings))]
pub(crate) fn info(
    py: Python<'_>,
    path: PathBuf,
    doctor: Option<PathBuf>,
    settings: Option<&Bound<'_, PyDict>>,
) -> PyResult<Py<PyAny>> {
    let mut options = InspectOptions { doctor, ..InspectOptions::default() };
    set(&mut options.recipe, settings)?;
    let (found, _) = workflows::run(py, |listener, _| inspecting::inspect(&path, &options, listener))?;
    let healthy = found.is_healthy();
    let mut value: Value = found.json;
    value["healthy"] = json!(healthy);
    value["troubles"] = json!([found.troubles, found.listed].concat());
    plain(py, &value)
}
