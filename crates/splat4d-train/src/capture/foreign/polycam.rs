//! Polycam's raw data (Export, Raw data): `keyframes/` with images, cameras and depth.
//!
//! `cameras/TIMESTAMP.json` has the intrinsics and `t_00` to `t_23`, the rows of camera to world in ARKit's axes (x right, y
//! up, z backward in the camera; y up in the world). `corrected_images/` and `corrected_cameras/` are those that Polycam
//! optimised; they are preferred. `depth/TIMESTAMP.png` is in millimetres. Source: PolyCam/polyform's description.

use super::{Convention, Export, Said, Shot, only_points, take};
use crate::capture::json::{self, Node};
use crate::capture::{CaptureKind, CaptureOptions, DepthFile, DepthKind, RawCapture, Sequence, pose, rig};
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

pub(super) const EXPORT: Export = Export { find, is: |_| false, read };

/// The folder that such an export has.
const KEYFRAMES: &str = "keyframes";
/// Folders of images and cameras, the better ones first.
const PAIRS: [[&str; 2]; 2] = [["corrected_images", "corrected_cameras"], ["images", "cameras"]];
/// Scene units (metres) a stored number of a depth map.
const DEPTH_UNIT: f64 = 1e-3;
const Y_UP: [f64; 3] = [0.0, 1.0, 0.0];

/// The capture's folder holds `keyframes`, or is it.
fn find(root: &Path) -> Option<PathBuf> {
    let folders = [root.join(KEYFRAMES), root.to_owned()];
    folders.into_iter().find(|f| f.file_name().is_some_and(|n| n == KEYFRAMES) && pair(f).is_some())
}

fn pair(folder: &Path) -> Option<[PathBuf; 2]> {
    let there = |names: &[&str; 2]| names.map(|n| folder.join(n));
    PAIRS
        .iter()
        .map(there)
        .find(|[images, cameras]| !rig::image_names(images).is_empty() && !camera_names(cameras).is_empty())
}

/// Names of the cameras in a folder, without endings.
fn camera_names(folder: &Path) -> Vec<String> {
    rig::file_names(folder).iter().filter_map(|n| n.strip_suffix(".json").map(str::to_owned)).collect()
}

fn read(root: &Path, folder: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    let [images, cameras] = pair(folder).ok_or_else(|| {
        Error::input("it has no images with cameras").at(folder.display()).remedy("Export the raw data again.")
    })?;
    let (names, doubled) = super::images_of(&images)?;
    let mut by_stem: BTreeMap<String, String> = names
        .into_iter()
        .map(|name| (name.rsplit_once('.').map_or(name.as_str(), |(stem, _)| stem).to_owned(), name))
        .collect();
    let mut shots = Vec::new();
    for stem in camera_names(&cameras) {
        // An image that is missing is counted with those of other layouts.
        let name = by_stem.remove(&stem).unwrap_or_else(|| format!("{stem}.jpg"));
        let camera = cameras.join(format!("{stem}.json"));
        let value = json::read(&camera)?;
        let source = camera_of(&Node::root(&value)).map_err(|e| e.at(camera.display()))?;
        let depth = folder.join("depth").join(format!("{stem}.png"));
        let depth =
            depth.is_file().then_some(DepthFile { path: depth, scale: DEPTH_UNIT, kind: DepthKind::Metric, fit: None });
        shots.push(Shot { name: name.clone(), image: images.join(&name), source, time: None, depth });
    }
    let (mut warnings, mut notes) = (doubled.into_iter().collect(), Vec::new());
    super::without_pose(by_stem.len(), by_stem.len() + shots.len(), &mut warnings);
    if !images.ends_with(PAIRS[0][0]) {
        warnings.push("There are no corrected cameras: poses are those of the telephone, not optimised ones.".into());
    }
    if options.sequence == Sequence::Auto {
        notes.push(
            "Keyframes are read as photos of one time. If they are a video, use --set capture.sequence=video.".into(),
        );
    }
    let points = only_points(root, &mut notes)?;
    let said = Said {
        kind: CaptureKind::Polycam,
        convention: Convention::NERF,
        fps: None,
        points,
        up: Some(Y_UP),
        warnings,
        notes,
    };
    // Names are time stamps, and what is scanned is static.
    let sequence = match options.sequence {
        Sequence::Auto => Sequence::Photos,
        stated => stated,
    };
    take(root, shots, said, &CaptureOptions { sequence, ..options.clone() })
}

fn camera_of(node: &Node<'_>) -> Result<Camera> {
    let number = |key: &str| node.get(key)?.number();
    let mut rows = [[0.0, 0.0, 0.0, 1.0]; 4];
    for (i, row) in rows.iter_mut().take(3).enumerate() {
        for (j, cell) in row.iter_mut().enumerate() {
            *cell = number(&format!("t_{i}{j}"))?;
        }
    }
    let cam_from_world = super::opengl_pose(&rows).map_err(|e| node.at(e))?;
    let (width, height) = (node.get("width")?.count()?, node.get("height")?.count()?);
    let intrinsics = Intrinsics { fx: number("fx")?, fy: number("fy")?, cx: number("cx")?, cy: number("cy")? };
    pose::check_intrinsics(&intrinsics, width, height).map_err(|e| node.at(e))?;
    Ok(Camera { cam_from_world, intrinsics, lens: Lens::Pinhole, width, height, near: Camera::NEAR })
}
