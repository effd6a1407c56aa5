//! Rigs that a network generated: 4DAnyone's output folder, with `cameras.json` (poses of its views) and a video per view
//! in `videos/dense`. Frames are extracted once, and `capture.json` is written next to them.
//!
//! Layout: `cameras.json` is {`camera_model`: "OPENCV", `cameras`: [{`camera_id`, `K` 3x3 (pixels), `camera_to_world` 4x4
//! (x right, y down, z forward), `image_width`, `image_height`, `video`}]}; videos have no sound and one frame rate.
//! Source: ant-research/4DAnyone, `fdanyone/output_writer.py` and `docs/output.md`, commit 8dc687af. Which pixel has
//! coordinates (0, 0) is not documented: the first pixel's corner is taken.

use crate::shipped::Extracted;
use crate::sync::graph::Offset;
use crate::video::{self, Selection, Source};
use crate::write::{self, Clip, Format, Placed, Poses, Recording};
use serde_json::{Value, json};
use splat4d::math::Se3;
use splat4d::scene::{Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::event::Progress;
use std::path::{Path, PathBuf};

/// The poses.
const CAMERAS: &str = "cameras.json";
/// Folder of the videos that are trained on.
const VIDEOS: &str = "videos/dense";
/// What is written.
const CAPTURE: &str = "capture.json";
/// Key of `extra` in the capture: poses come from a network, and training refines them.
pub(crate) const PREDICTED_POSES: &str = "predicted_poses";

/// Whether a folder is the output of 4DAnyone whose frames are not extracted yet.
fn is_rig(root: &Path) -> bool {
    root.join(CAMERAS).is_file() && root.join(VIDEOS).is_dir() && !root.join(CAPTURE).is_file()
}

/// One view.
struct View {
    name: String,
    video: PathBuf,
    size: [usize; 2],
    intrinsics: Intrinsics,
    pose: Se3,
}

/// Extracts the frames of such a rig and writes its `capture.json`; work that was interrupted continues. `None`: not
/// such a rig. `stop` is called after every few frames.
///
/// Errors: `cameras.json` is damaged or of another camera model, a video that is missing or of another size, no space;
/// of kind `Interrupted` if `stop` requested it.
pub fn extract(root: &Path, progress: &mut Progress<'_>, stop: &dyn Fn() -> bool) -> Result<Option<Extracted>> {
    if !is_rig(root) {
        return Ok(None);
    }
    let file = root.join(CAMERAS);
    let bytes = splat4d_train::files::read(&file)?;
    let views = views(root, &bytes).map_err(|e| e.at(file.display()))?;
    let sources = views.iter().map(|v| video::open(&v.video, 1.0)).collect::<Result<Vec<Box<dyn Source>>>>()?;
    let clips: Vec<Clip<'_>> = views
        .iter()
        .zip(&sources)
        .map(|(view, source)| Clip { name: view.name.clone(), source: &**source, selection: Selection::default() })
        .collect();
    let pictures = write::pictures(root, &clips, Format::default(), progress, stop).map_err(|e| match e.kind() {
        ErrorKind::Interrupted => e,
        _ => {
            e.remedy("Frames are stored in the folder `images`: copy the rig to a disk with space where you may write.")
        }
    })?;
    let mut placed = Vec::new();
    for (view, pictures) in views.iter().zip(&pictures) {
        if pictures.size != view.size {
            let what = format!("the video has {:?} pixels, and {CAMERAS} states {:?}", pictures.size, view.size);
            return Err(Error::input(what).at(view.video.display()).remedy("Use the videos of the same run."));
        }
        let offset = Offset { seconds: 0.0, sigma: 0.0, rate: 0.0, kinds: Vec::new(), checked: false };
        let (intrinsics, poses) = (view.intrinsics, Poses::Fixed(view.pose));
        placed.push(Placed { pictures: pictures.clone(), offset, intrinsics, lens: Lens::Pinhole, poses, masks: None });
    }
    let name = root.file_name().map(|n| n.to_string_lossy().into_owned());
    let extra = json!({ PREDICTED_POSES: "4DAnyone" }).as_object().cloned().unwrap_or_default();
    write::capture(root, &Recording { name, extra, ..Recording::default() }, &placed)?;
    Ok(Some(Extracted {
        cameras: pictures.len(),
        frames: pictures.iter().map(|p| p.shots.len()).sum(),
        size: pictures[0].size,
        warnings: pictures.iter().flat_map(|p| p.warnings.iter().map(|w| format!("{}: {w}", p.name))).collect(),
    }))
}

/// Checks the bytes of a `cameras.json`. Errors: as [`extract`], videos aside.
#[doc(hidden)]
pub fn check_cameras(bytes: &[u8]) -> Result<usize> {
    views(Path::new("."), bytes).map(|views| views.len())
}

fn views(root: &Path, bytes: &[u8]) -> Result<Vec<View>> {
    let text = splat4d_train::text::decode(bytes)?;
    let top: Value = serde_json::from_str(&text).map_err(|e| Error::input(format!("is not valid JSON: {e}")))?;
    if top["camera_model"] != "OPENCV" {
        return Err(Error::new(
            ErrorKind::Unsupported,
            format!("the camera model is {:.40}", top["camera_model"].to_string()),
        )
        .remedy("Expected \"OPENCV\": the cameras.json of 4DAnyone's output folder."));
    }
    let list = top["cameras"].as_array().filter(|list| !list.is_empty());
    let list = list.ok_or_else(|| Error::input("it lists no cameras"))?;
    let views =
        list.iter().enumerate().map(|(i, camera)| view(root, camera).map_err(|e| e.at(format!("cameras[{i}]"))));
    views.collect()
}

fn view(root: &Path, camera: &Value) -> Result<View> {
    let bad = |what: &str| Error::input(format!("invalid or missing {what}")).remedy("Generate the rig again.");
    let whole = |key: &str| camera[key].as_u64().filter(|n| (1..=1 << 16).contains(n)).ok_or_else(|| bad(key));
    let size = [whole("image_width")? as usize, whole("image_height")? as usize];
    let number = camera["camera_id"].as_u64().ok_or_else(|| bad("camera_id"))?;
    let k: [[f64; 3]; 3] = rows(&camera["K"]).ok_or_else(|| bad("K"))?;
    let intrinsics = Intrinsics { fx: k[0][0], fy: k[1][1], cx: k[0][2], cy: k[1][2] };
    splat4d_train::capture::check_intrinsics(&intrinsics, size[0], size[1])?;
    let m: [[f64; 4]; 4] = rows(&camera["camera_to_world"]).ok_or_else(|| bad("camera_to_world"))?;
    let world = splat4d_train::capture::rigid(Se3::from_rows(&m))?;
    let name = format!("{number:02}");
    let video = camera["video"].as_str().map_or_else(|| format!("{VIDEOS}/{name}.mp4"), str::to_owned);
    // A file from elsewhere may name any path.
    let inside = Path::new(&video).components().all(|c| matches!(c, std::path::Component::Normal(_)));
    if !inside {
        return Err(bad("video"));
    }
    Ok(View { name, video: root.join(video), size, intrinsics, pose: world.inverse() })
}

/// A matrix of finite numbers.
fn rows<const R: usize, const C: usize>(value: &Value) -> Option<[[f64; C]; R]> {
    let row = |v: &Value| -> Option<[f64; C]> {
        let numbers: Vec<f64> = v.as_array()?.iter().filter_map(Value::as_f64).filter(|x| x.is_finite()).collect();
        numbers.try_into().ok()
    };
    let all: Vec<[f64; C]> = value.as_array()?.iter().filter_map(row).collect();
    all.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;

    fn cameras() -> Value {
        let camera = |id: usize, x: f64| {
            json!({
                "camera_id": id, "layer_index": 0, "pitch": 0, "yaw": 15.0, "K": [[60.0, 0, 32.0], [0, 60.0, 24.0], [0, 0, 1]],
                "camera_to_world": [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, -3], [0, 0, 0, 1]], "image_width": 64,
                "image_height": 48, "video": format!("videos/dense/{id:02}.mp4"), "skeleton_video": "skeletons/00.mp4",
            })
        };
        json!({"camera_model": "OPENCV", "world_frame": "y_up", "cameras": [camera(0, 0.5), camera(1, -0.5)]})
    }

    #[test]
    fn poses_and_lenses_are_read_and_damage_is_named() {
        let good = cameras();
        let views = views(Path::new("/rig"), good.to_string().as_bytes()).unwrap();
        let center = |v: &View| v.pose.inverse().translation;
        assert_eq!((views.len(), center(&views[0]), center(&views[1])), (2, [0.5, 0.0, -3.0], [-0.5, 0.0, -3.0]));
        assert_eq!((views[1].intrinsics.fx, views[1].size), (60.0, [64, 48]));
        assert_eq!(views[1].video, Path::new("/rig/videos/dense/01.mp4"));
        let spoilt = |key: &str, value: Value| {
            let mut top = good.clone();
            top["cameras"][1][key] = value;
            check_cameras(top.to_string().as_bytes()).unwrap_err().to_string()
        };
        assert!(spoilt("K", json!([[1, 2]])).contains("cameras[1]"));
        assert!(
            spoilt("camera_to_world", json!([[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]))
                .contains("cameras[1]")
        );
        assert!(spoilt("video", json!("../../secret.mp4")).contains("video"));
        assert!(spoilt("image_width", json!(0)).contains("image_width"));
        assert!(
            check_cameras(b"{\"camera_model\": \"FISHEYE\", \"cameras\": []}")
                .unwrap_err()
                .to_string()
                .contains("FISHEYE")
        );
        assert!(check_cameras(b"[").is_err() && check_cameras(b"{}").is_err());
    }

    #[test]
    fn a_rig_becomes_a_capture_once() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path();
        std::fs::create_dir_all(root.join(VIDEOS)).unwrap();
        assert!(!is_rig(root));
        std::fs::write(root.join(CAMERAS), cameras().to_string()).unwrap();
        assert!(is_rig(root));
        let make = |name: &str| {
            let input = "-v error -f lavfi -i testsrc=s=64x48:r=10:d=0.5 -c:v mpeg4 -y".split_whitespace();
            let out = root.join(VIDEOS).join(name);
            Command::new("ffmpeg").args(input).arg(out).status().is_ok_and(|s| s.success())
        };
        if !make("00.mp4") {
            eprintln!("skipped: there is no ffmpeg here");
            return;
        }
        let mut told = |_: &splat4d_train::event::Event| {};
        let mut progress = Progress(&mut told);
        assert!(extract(root, &mut progress, &|| false).is_err(), "a video is missing");
        assert!(make("01.mp4"));
        let found = extract(root, &mut progress, &|| false).unwrap().unwrap();
        assert_eq!((found.cameras, found.frames, found.size), (2, 10, [64, 48]));
        let text = std::fs::read_to_string(root.join(CAPTURE)).unwrap();
        let capture: Value = serde_json::from_str(&text).unwrap();
        assert_eq!((&capture["extra"][PREDICTED_POSES], &capture["fps"]), (&json!("4DAnyone"), &json!(10.0)));
        assert_eq!(capture["cameras"][0]["frames"], 5);
        assert!(extract(root, &mut progress, &|| false).unwrap().is_none());
    }
}
