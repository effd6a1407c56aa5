//! N3DV captures (Li 2022): `poses_bounds.npy`, one row per camera, and a folder of frames per camera.

use super::layout::{ffmpeg_command, videos};
use super::points::read_ply;
use super::{CaptureKind, CaptureOptions, Extent, RawFrame, Split, Take, Timing};
use super::{json, picture, pose, rig};
use splat4d::format::npy::Npy;
use splat4d::math::Se3;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, Result};
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

/// Reads poses and frame folders; the first camera is held out.
pub(super) fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<Take> {
    let fps = options.fps.unwrap_or(DEFAULT_FPS);
    let place = |e: Error| e.at(marker.display());
    let array = Npy::read(&json::read_bytes(marker)?).map_err(place)?;
    let rows = match array.shape[..] {
        [n, ROW] => n,
        _ => {
            let what = format!("expected an array of shape [cameras, {ROW}], found {:?}", array.shape);
            return Err(place(Error::input(what).remedy("Save it as LLFF's imgs2poses does.")));
        }
    };
    let folders = folders(root);
    let films = videos(root);
    if folders.len() != rows {
        return Err(place(mismatch(rows, &folders, &films)));
    }
    let mut frames = Vec::new();
    for (camera, (folder, row)) in folders.iter().zip(array.to_f64().chunks_exact(ROW)).enumerate() {
        let in_row = |e: Error| e.at(format!("{} row {camera} (camera {})", marker.display(), folder.name));
        let header = picture::header(&folder.images[0])?;
        let source = camera_of(row, header.width, header.height).map_err(in_row)?;
        for (index, image) in folder.images.iter().enumerate() {
            frames.push(RawFrame {
                camera,
                source: source.clone(),
                time: index as f64 / fps,
                index,
                image: image.clone(),
                mask: None,
                depth: None,
                flow: None,
                labels: None,
                features: None,
                tracks: None,
                split: if camera == 0 && rows > 1 { Split::Held } else { Split::Train },
            });
        }
    }
    let points = POINTS.iter().map(|name| root.join(name)).find(|p| p.is_file());
    Ok(Take {
        name: None,
        root: root.to_path_buf(),
        kind: CaptureKind::N3dv,
        cameras: folders.into_iter().map(|f| f.name).collect(),
        frames,
        take: Extent::default(),
        named: true,
        timing: Timing::Told,
        hold_out: None,
        fps,
        points: points.map(|p| read_ply(&p)).transpose()?,
        background: None,
        up: None,
        labels: Vec::new(),
        warnings: Vec::new(),
        notes: Vec::new(),
    })
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
            let plain = ["images", "masks", "sparse", "colmap"].contains(&name.as_str());
            let deeper = folder.join("images");
            let folder = if deeper.is_dir() { deeper } else { folder };
            let mut images: Vec<String> = if plain { Vec::new() } else { rig::image_names(&folder) };
            // 10.png follows 9.png, padded or not.
            images.sort_by_key(|n| (rig::trailing_number(n), n.clone()));
            let images: Vec<PathBuf> = images.iter().map(|n| folder.join(n)).collect();
            (!images.is_empty()).then_some(Folder { name, images })
        });
        named.collect()
    };
    let (direct, inner) = (within(root.to_path_buf()), within(root.join("images")));
    if direct.len() >= inner.len() { direct } else { inner }
}

fn camera_of(row: &[f64], width: usize, height: usize) -> Result<Camera> {
    let at = |r: usize, c: usize| row[5 * r + c];
    if row.iter().any(|v| !v.is_finite()) {
        return Err(Error::input("the pose holds NaN or infinity").remedy("Calibrate that camera again."));
    }
    let [stated_height, stated_width, focal] = [at(0, 4), at(1, 4), at(2, 4)];
    // Right, down, forward from down, right, back.
    let rotation = std::array::from_fn(|r| [at(r, 1), at(r, 0), -at(r, 2)]);
    let world_from_cam = Se3 { rotation, translation: std::array::from_fn(|r| at(r, 3)) };
    let cam_from_world = pose::checked(world_from_cam)?.inverse();
    let aspect = (width as f64 / height as f64) / (stated_width / stated_height);
    if aspect.is_nan() || (aspect - 1.0).abs() > MAX_ASPECT_CHANGE {
        let what = format!("the pose is for pictures of {stated_width}x{stated_height}, not {width}x{height}");
        return Err(Error::input(what).remedy("Extract the frames without cropping."));
    }
    // Frames are often extracted at half the size that the calibration states.
    let focal = focal * width as f64 / stated_width;
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: 0.5 * width as f64, cy: 0.5 * height as f64 };
    Ok(Camera { cam_from_world, intrinsics, lens: Lens::Pinhole, width, height, near: Camera::NEAR })
}
