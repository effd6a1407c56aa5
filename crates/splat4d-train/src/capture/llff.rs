//! LLFF captures: `poses_bounds.npy`, one row per image, and the images of one camera in a folder, in the order of the
//! rows.

use super::account::Account;
use super::convention::Convention;
use super::lookup::{Lookup, Twins};
use super::{CaptureKind, CaptureOptions, RawCapture, RawFrame};
use super::{n3dv, picture, rig, sequence};
use splat4d::math::Se3;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

/// Reads poses and images; names specify whether they show one time.
pub(super) fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    let fps = options.fps.unwrap_or(DEFAULT_FPS);
    let rows = n3dv::rows(marker)?;
    let lookup = Lookup::new(root, options)?;
    let mut folders: Vec<(PathBuf, Vec<PathBuf>, Twins)> = Vec::new();
    for folder in lookup.folders() {
        let mut twins = Twins::default();
        let images = rig::image_names(&folder).iter().map(|name| folder.join(name)).collect();
        let images = twins.single(images)?;
        folders.push((folder, images, twins));
    }
    let Some((folder, images, twins)) = folders.iter().find(|(_, images, _)| images.len() == rows.len()) else {
        let found: Vec<String> =
            folders.iter().map(|(f, images, _)| format!("{} ({})", f.display(), images.len())).collect();
        let what = format!("it has {} poses, but no folder has as many images: {}", rows.len(), found.join(", "));
        return Err(Error::input(what).at(marker.display()).remedy(
            "Keep one image per row, in the order of the rows; or the frames of each camera in a folder of its own (cam00/).",
        ));
    };
    let mut account = Account::default();
    twins.report(root, &mut account);
    let name = |image: &PathBuf| image.strip_prefix(folder).unwrap_or(image).to_string_lossy().into_owned();
    let names: Vec<String> = images.iter().map(name).collect();
    let mut shots = Vec::new();
    for ((name, image), row) in names.iter().zip(images).zip(&rows) {
        let size = picture::header(image)?.stored;
        let source = n3dv::camera_of(row, size, options.poses)
            .map_err(|e| e.at(format!("{} row {} ({name})", marker.display(), shots.len())))?;
        shots.push((image.clone(), source));
    }
    let (mut warnings, mut notes) = (Vec::new(), Vec::new());
    let short: Vec<&str> = names.iter().map(String::as_str).collect();
    let poses: Vec<Se3> = shots.iter().map(|(_, source)| source.cam_from_world).collect();
    let order = sequence::order(&short, &poses, options.sequence, fps, &mut warnings, &mut notes);
    let frame = |((image, source), &place): ((PathBuf, _), &_)| RawFrame::new(place, source, image);
    Ok(RawCapture {
        cameras: order.cameras,
        frames: shots.into_iter().zip(&order.frames).map(frame).collect(),
        named: order.named,
        timing: order.timing,
        fps,
        points: n3dv::points(root)?,
        warnings,
        notes,
        account,
        ..RawCapture::new(root, CaptureKind::Llff, Convention::NERF)
    })
}
