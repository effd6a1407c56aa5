//! N3DV captures (Li 2022): `poses_bounds.npy`, one row per camera, and a folder of frames per camera.

use super::account::Severity;
use super::account::{Account, Aspect, first_names};
use super::convention::{Convention, Poses};
use super::points::read_ply;
use super::stray::{ffmpeg_command, videos};
use super::{CaptureKind, CaptureOptions, PointCloud, RawFrame, Split, Take};
use super::{json, lookup, picture, pose, rig, sequence};
use splat4d::format::npy::Npy;
use splat4d::math::Se3;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, Result};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Values of a row: a 3x5 matrix [down | right | back | centre | height, width, focal], then near and far (LLFF).
const ROW: usize = 17;
/// How far the pictures' shape may differ from the stated one before the poses are taken to be of other pictures.
const MAX_ASPECT_CHANGE: f64 = 0.01;
/// Names under which prepared data sets keep their cloud.
const POINTS: &[&str] = &["points.ply", "points3D.ply", "points3D_downsample2.ply"];

/// A folder of frames: its camera's name and the pictures.
struct Folder {
    name: String,
    images: Vec<PathBuf>,
}

/// Whether this looks like an N3DV take rather than a single-camera LLFF folder.
pub(super) fn applies(root: &Path) -> bool {
    !folders(root).is_empty() || !videos(root).is_empty()
}

/// The rows of `poses_bounds.npy`.
pub(super) fn rows(marker: &Path) -> Result<Vec<Vec<f64>>> {
    let place = |e: Error| e.at(marker.display());
    let array = Npy::read(&json::read_bytes(marker)?).map_err(place)?;
    match array.shape[..] {
        [_, ROW] => Ok(array.to_f64().chunks_exact(ROW).map(<[f64]>::to_vec).collect()),
        _ => {
            let what = format!("expected an array of shape [cameras, {ROW}], found {:?}", array.shape);
            Err(place(Error::input(what).remedy("Save it as LLFF's imgs2poses does.")))
        }
    }
}

/// The cloud that prepared data sets keep beside the poses.
pub(super) fn points(root: &Path) -> Result<Option<PointCloud>> {
    POINTS.iter().map(|name| root.join(name)).find(|p| p.is_file()).map(|p| read_ply(&p)).transpose()
}

/// Reads poses and frame folders; the first camera is held out.
pub(super) fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<Take> {
    let fps = options.fps.unwrap_or(DEFAULT_FPS);
    let place = |e: Error| e.at(marker.display());
    let rows = rows(marker)?;
    let folders = folders(root);
    let films = videos(root);
    if folders.len() != rows.len() {
        return Err(place(mismatch(rows.len(), &folders, &films)));
    }
    let mut account = Account::default();
    let numbers = numbers(&folders, &mut account);
    let mut frames = Vec::new();
    for (camera, (folder, row)) in folders.iter().zip(&rows).enumerate() {
        let in_row = |e: Error| e.at(format!("{} row {camera} (camera {})", marker.display(), folder.name));
        let header = picture::header(&folder.images[0])?;
        let source = camera_of(row, header.stored, options.poses).map_err(in_row)?;
        for (&index, image) in numbers[camera].iter().zip(&folder.images) {
            let split = if camera == 0 && rows.len() > 1 { Split::Held } else { Split::Train };
            let place = (camera, index, index as f64 / fps);
            frames.push(RawFrame { split, ..RawFrame::new(place, source.clone(), image.clone()) });
        }
    }
    Ok(Take {
        cameras: folders.into_iter().map(|f| f.name).collect(),
        frames,
        named: true,
        fps,
        points: points(root)?,
        account,
        ..Take::new(root, CaptureKind::N3dv, Convention::NERF)
    })
}

/// The frame numbers of every folder's images: as named, counted from the smallest of all, so that a lost frame does not
/// shift those after it; else their order.
fn numbers(folders: &[Folder], account: &mut Account) -> Vec<Vec<usize>> {
    let named = |image: &PathBuf| rig::trailing_number(&image.file_name()?.to_string_lossy());
    let told: Option<Vec<Vec<usize>>> =
        folders.iter().map(|f| f.images.iter().map(named).collect::<Option<Vec<usize>>>()).collect();
    let in_order = || folders.iter().map(|f| (0..f.images.len()).collect()).collect();
    let Some(mut told) = told else { return in_order() };
    let all: BTreeSet<usize> = told.iter().flatten().copied().collect();
    let (Some(&first), Some(&last)) = (all.first(), all.last()) else { return in_order() };
    // Cameras that number their frames apart, or share a number, say nothing of each other's time.
    let apart = (0..told.len()).any(|c| {
        let others: BTreeSet<usize> =
            told.iter().enumerate().filter(|(k, _)| *k != c).flat_map(|(_, n)| n.clone()).collect();
        let shared = told[c].iter().filter(|n| others.contains(n)).count();
        told[c].windows(2).any(|w| w[0] == w[1]) || told.len() > 1 && 2 * shared < told[c].len()
    });
    if apart || last - first > rig::MAX_SPAN {
        return in_order();
    }
    let lost: Vec<String> = (folders.iter().zip(&told))
        .filter(|(_, numbers)| numbers.len() < all.len())
        .map(|(f, numbers)| format!("{} ({})", f.name, all.len() - numbers.len()))
        .collect();
    if !lost.is_empty() {
        let what = format!(
            "Frames that other cameras have: {}. The others keep their times: names number frames {first} to {last}.",
            first_names(&lost)
        );
        account.add(Aspect::NotFound, Severity::Warning, what);
    }
    told.iter_mut().flatten().for_each(|n| *n -= first);
    told
}

fn mismatch(rows: usize, folders: &[Folder], films: &[String]) -> Error {
    let missing: Vec<&String> =
        films.iter().filter(|v| !folders.iter().any(|f| v.starts_with(&format!("{}.", f.name)))).collect();
    let what = format!("it has {rows} cameras, but there are {} folders of frames", folders.len());
    match missing.first() {
        Some(video) => Error::input(format!("{what}; {} videos are not extracted", missing.len())).remedy(format!(
            "`splat4d train FOLDER` extracts them, or you do, for example with `{}`.",
            ffmpeg_command(video)
        )),
        None => Error::input(what).remedy(
            "Keep the frames of each camera in a folder of its own (cam00/, cam01/, ...), in the order of the rows.",
        ),
    }
}

/// Frame folders in order: `cam00/`, `cam00/images/` or `images/cam00/`.
fn folders(root: &Path) -> Vec<Folder> {
    let within = |base: PathBuf| -> Vec<Folder> {
        let named = rig::file_names(&base).into_iter().filter_map(|name| {
            let folder = base.join(&name);
            let deeper = folder.join("images");
            let folder = if deeper.is_dir() { deeper } else { folder };
            let mut images: Vec<String> = if is_other(&name) { Vec::new() } else { rig::image_names(&folder) };
            // 10.png follows 9.png, padded or not.
            images.sort_by_key(|n| (rig::trailing_number(n), n.clone()));
            let images: Vec<PathBuf> = images.iter().map(|n| folder.join(n)).collect();
            (!images.is_empty()).then_some(Folder { name, images })
        });
        let mut found: Vec<Folder> = named.collect();
        // Scripts leave folders of other images there; cameras are then those named so.
        let camera = |f: &Folder| sequence::are_cameras(std::slice::from_ref(&f.name));
        if found.iter().any(camera) {
            found.retain(camera);
        }
        found
    };
    let (direct, inner) = (within(root.to_path_buf()), within(root.join("images")));
    if direct.len() >= inner.len() { direct } else { inner }
}

/// Whether a folder's images are not the frames of one camera.
fn is_other(name: &str) -> bool {
    ["depth", "sparse", "sparse_", "colmap", "image_colmap"].contains(&name)
        || lookup::may_hold_masks(name)
        || rig::is_plain(name)
}

/// The camera of a row, for images of this size.
pub(super) fn camera_of(row: &[f64], (width, height): (usize, usize), poses: Poses) -> Result<Camera> {
    let at = |r: usize, c: usize| row[5 * r + c];
    if row.iter().any(|v| !v.is_finite()) {
        return Err(Error::input("the pose holds NaN or infinity").remedy("Calibrate that camera again."));
    }
    let [stated_height, stated_width, focal] = [at(0, 4), at(1, 4), at(2, 4)];
    // Right, up, back (OpenGL's axes) from down, right, back.
    let rotation = std::array::from_fn(|r| [at(r, 1), -at(r, 0), at(r, 2)]);
    let world_from_cam = Se3 { rotation, translation: std::array::from_fn(|r| at(r, 3)) };
    let cam_from_world = Convention::NERF.read_as(pose::checked(world_from_cam)?, poses)?;
    let aspect = (width as f64 / height as f64) / (stated_width / stated_height);
    // Sides of reduced copies are rounded.
    let rounding = 1.0 / width.min(height).max(1) as f64;
    if aspect.is_nan() || (aspect - 1.0).abs() > MAX_ASPECT_CHANGE.max(rounding) {
        let what = format!("the pose is for images of {stated_width}x{stated_height}, not {width}x{height}");
        return Err(Error::input(what).remedy("Extract the frames without cropping."));
    }
    // Frames are often extracted at half the size that the calibration states.
    let focal = focal * width as f64 / stated_width;
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: 0.5 * width as f64, cy: 0.5 * height as f64 };
    Ok(Camera { cam_from_world, intrinsics, lens: Lens::Pinhole, width, height, near: Camera::NEAR })
}
