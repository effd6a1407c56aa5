//! D-NeRF / Blender captures: `transforms_{train,val,test}.json`, one moving camera, OpenGL axes, time from 0 to 1.

use super::json::{self, Node};
use super::{CaptureKind, CaptureOptions, RawFrame, Split, Take, picture, pose};
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

/// The splits' files; the first must exist. The test set is what papers measure.
const SPLITS: [(&str, Split); 3] = [
    ("transforms_train.json", Split::Train),
    ("transforms_val.json", Split::Validation),
    ("transforms_test.json", Split::Held),
];
/// Blender's world has z up.
const UP: [f64; 3] = [0.0, 0.0, 1.0];

/// Reads the three files. `time` u becomes u·(N − 1)/fps seconds for N training frames, in every split.
pub(super) fn read(root: &Path, _marker: &Path, options: &CaptureOptions) -> Result<Take> {
    let fps = options.fps.unwrap_or(DEFAULT_FPS);
    let mut frames = Vec::new();
    let mut warnings = Vec::new();
    let mut length = None;
    for (name, split) in SPLITS {
        let path = root.join(name);
        if split != Split::Train && !path.exists() {
            continue;
        }
        let value = json::read(&path)?;
        let read = read_split(root, &Node::root(&value), split).map_err(|e| e.at(path.display()))?;
        if split == Split::Train && read.is_empty() {
            let remedy = "Check that it was exported completely.";
            return Err(Error::input("the capture has no frames").at(path.display()).remedy(remedy));
        }
        // (N − 1, seconds); a single frame still needs a finite clock.
        let (steps, seconds) = *length.get_or_insert_with(|| {
            let steps = (read.len() - 1) as f64;
            (steps, options.unit_time_seconds.unwrap_or(steps / fps))
        });
        for mut frame in read {
            if !(0.0..=1.0).contains(&frame.time) && warnings.is_empty() {
                let what =
                    format!("{name} holds times outside [0,1] ({}); they are scaled like all others.", frame.time);
                warnings.push(what);
            }
            frame.index = (frame.time * steps).round().max(0.0) as usize;
            frame.time *= seconds;
            frames.push(frame);
        }
    }
    Ok(Take {
        name: None,
        root: root.to_path_buf(),
        kind: CaptureKind::DNerf,
        cameras: vec!["moving".into()],
        frames,
        named: false,
        hold_out: None,
        fps,
        points: None,
        background: None,
        up: Some(UP),
        warnings,
    })
}

fn read_split(root: &Path, top: &Node<'_>, split: Split) -> Result<Vec<RawFrame>> {
    let list = top.get("frames")?.list()?;
    let Some(first) = list.first() else { return Ok(Vec::new()) };
    let angle = top.get("camera_angle_x")?;
    let fov = angle.number()?;
    if !(fov > 0.0 && fov < std::f64::consts::PI) {
        return Err(angle.error(format!("the field of view is {fov} rad")).remedy("It must lie between 0 and π."));
    }
    // The files do not say how large the pictures are.
    let header = picture::header(&image_path(root, first)?)?;
    let (width, height) = (header.width, header.height);
    let focal = 0.5 * width as f64 / (0.5 * fov).tan();
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: 0.5 * width as f64, cy: 0.5 * height as f64 };
    let read_one = |frame: &Node<'_>| -> Result<RawFrame> {
        let matrix = frame.get("transform_matrix")?;
        let cam_from_world = pose::from_opengl(&matrix.matrix4()?).map_err(|e| matrix.at(e))?;
        let time = frame.opt("time")?.map_or(Ok(0.0), |t| t.number())?;
        let source = Camera { cam_from_world, intrinsics, lens: Lens::Pinhole, width, height, near: Camera::NEAR };
        Ok(RawFrame {
            camera: 0,
            source,
            time,
            index: 0,
            image: image_path(root, frame)?,
            mask: None,
            flow: None,
            split,
        })
    };
    list.iter().map(read_one).collect()
}

/// `file_path` with or without its ending.
fn image_path(root: &Path, frame: &Node<'_>) -> Result<PathBuf> {
    let text = frame.get("file_path")?.text()?;
    let path = root.join(text.strip_prefix("./").unwrap_or(text));
    if path.is_file() {
        return Ok(path);
    }
    let named = |ending: &&str| PathBuf::from(format!("{}.{ending}", path.display()));
    let found = super::rig::IMAGE_ENDINGS.iter().map(named).find(|p| p.is_file());
    found.ok_or_else(|| {
        Error::input("the picture is missing (also with .png, .jpg, .jpeg and .webp)")
            .at(path.display())
            .remedy("Restore the file, or take the frame out of the transforms file.")
    })
}
