//! Record3D's export as images and EXR depth: `metadata.json`, `rgb/0.jpg` …, `depth/0.exr` …; also an unpacked `.r3d`
//! (`metadata`, `rgbd/0.jpg` …), whose depth is not read.
//!
//! `poses` are quaternions x y z w and centres, camera to world in ARKit's axes (y up; x right, y up, z backward in the
//! camera), one an image; `K` is column-major; `perFrameIntrinsicCoeffs` are fx fy cx cy of each image. It is the film
//! of one moving camera. Source: record3d's documentation of its formats.

use super::{Convention, Export, Said, Shot, only_points, take};
use crate::capture::json::{self, Node};
use crate::capture::{CaptureKind, CaptureOptions, DepthFile, DepthKind, RawCapture, picture, pose, rig};
use splat4d::math::quat;
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

pub(super) const EXPORT: Export = Export { find, is, read };

/// Names of the file of poses.
const NAMES: [&str; 2] = ["metadata.json", "metadata"];
/// Folders of images.
const FOLDERS: [&str; 3] = ["rgb", "rgbd", "color"];
/// Frames per second where the file does not state it.
const FPS: f64 = 60.0;
const Y_UP: [f64; 3] = [0.0, 1.0, 0.0];

fn find(root: &Path) -> Option<PathBuf> {
    NAMES.iter().map(|n| root.join(n)).find(|p| is(p))
}

fn is(path: &Path) -> bool {
    let named = path.file_name().is_some_and(|n| NAMES.iter().any(|known| n == *known));
    let has = |root: &Path| FOLDERS.iter().any(|f| root.join(f).is_dir());
    named && path.is_file() && path.parent().is_some_and(has)
        // Nerfies' captures have a metadata.json too, with other keys.
        && json::read(path).is_ok_and(|v| v["poses"].is_array() && v["K"].is_array())
}

fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    let value = json::read(marker)?;
    let place = |e: Error| e.at(marker.display());
    let top = Node::root(&value);
    let folder = FOLDERS.iter().map(|f| root.join(f)).find(|f| !rig::image_names(f).is_empty());
    let folder = folder.ok_or_else(|| {
        Error::input("there are no images in rgb/").at(root.display()).remedy("Export again as EXR and RGB images.")
    })?;
    let (mut images, doubled) = super::images_of(&folder)?;
    images.sort_by_key(|n| (rig::trailing_number(n), n.clone()));
    let size = picture::header(&folder.join(&images[0]))?.upright();
    let fps = top.opt("fps").map_err(place)?.map_or(Ok(FPS), |n| n.number()).map_err(place)?;
    let poses = top.get("poses").and_then(|n| n.list()).map_err(place)?;
    let times = top.opt("frameTimestamps").map_err(place)?.map(|n| n.list()).transpose().map_err(place)?;
    let own = top.opt("perFrameIntrinsicCoeffs").map_err(place)?.map(|n| n.list()).transpose().map_err(place)?;
    // Images are numbered: one that is missing leaves its pose, and is counted later.
    if poses.len() > images.len() {
        let ending = images[0].rsplit_once('.').map_or_else(String::new, |(_, e)| e.to_owned());
        let all: Vec<String> = (0..poses.len()).map(|i| format!("{i}.{ending}")).collect();
        if images.iter().all(|name| all.contains(name)) {
            images = all;
        }
    }
    if poses.len() != images.len() {
        return Err(place(Error::input(format!("it has {} poses for {} images", poses.len(), images.len())))
            .remedy("Export the recording again, with all of its images."));
    }
    let shared: [f64; 9] = top.get("K").and_then(|n| n.numbers()).map_err(place)?;
    let side = |key: &str, own: usize| top.opt(key)?.map_or(Ok(own), |n| n.count());
    let (width, height) = (side("w", size.0).map_err(place)?, side("h", size.1).map_err(place)?);
    let mut shots = Vec::with_capacity(images.len());
    for (i, name) in images.iter().enumerate() {
        let [fx, fy, cx, cy] = match own.as_ref().and_then(|o| o.get(i)) {
            Some(node) => node.numbers::<4>().map_err(place)?,
            None => [shared[0], shared[4], shared[6], shared[7]],
        };
        let intrinsics = Intrinsics { fx, fy, cx, cy };
        pose::check_intrinsics(&intrinsics, width, height).map_err(|e| place(poses[i].at(e)))?;
        let [x, y, z, w, px, py, pz] = poses[i].numbers::<7>().map_err(place)?;
        let (q, length) = quat::normalize([w, x, y, z]);
        if length.is_nan() || length < 1e-6 {
            return Err(place(poses[i].error("the pose has a zero quaternion")).remedy("Record again."));
        }
        let r = quat::to_rotation(q);
        let t = [px, py, pz];
        let row = |i: usize| [r[i][0], r[i][1], r[i][2], t[i]];
        let cam_from_world = super::opengl_pose(&[row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]).map_err(place)?;
        let time = match times.as_ref().and_then(|t| t.get(i)) {
            Some(node) => node.number().map_err(place)?,
            None => i as f64 / fps,
        };
        let stem = name.rsplit_once('.').map_or(name.as_str(), |(stem, _)| stem);
        let depth = root.join("depth").join(format!("{stem}.exr"));
        let depth =
            depth.is_file().then_some(DepthFile { path: depth, scale: 1.0, kind: DepthKind::Metric, fit: None });
        let source = Camera { cam_from_world, intrinsics, lens: Lens::Pinhole, width, height, near: Camera::NEAR };
        shots.push(Shot { name: name.clone(), image: folder.join(name), source, time: Some(time), depth });
    }
    let (warnings, mut notes) = (doubled.into_iter().collect(), Vec::new());
    let points = only_points(root, &mut notes)?;
    let said = Said {
        kind: CaptureKind::Record3d,
        convention: Convention::NERF,
        fps: Some(fps),
        points,
        up: Some(Y_UP),
        warnings,
        notes,
    };
    take(root, shots, said, options)
}
