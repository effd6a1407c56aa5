//! COLMAP reconstructions: `sparse/0/{cameras,images,points3D}.{bin,txt}` and the images in `images/`.
//!
//! COLMAP models have no times. Image names `cam/frame` or `cam_frameN` give camera and frame number; where each camera
//! has only one registered image, the other images of that camera on disk share its pose: the usual way to calibrate a
//! fixed rig is to reconstruct one time.

mod multiview;
mod unregistered;

use super::account::Severity;
use super::account::{Account, Aspect};
use super::colmap_files::{self, Point, Registered};
use super::convention::{Convention, Poses};
use super::lookup::{self, Lookup};
use super::points::read_cloud;
use super::splits::Lists;
use super::{CaptureKind, CaptureOptions, PointCloud, RawCapture, RawFrame, Split, extra_model, rig, sequence};
use splat4d::math::{Se3, quat};
use splat4d::scene::Camera;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::{Error, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The folder of models: the marker.
pub(super) const SPARSE: &str = "sparse";
/// The same, where Nerfstudio keeps it.
pub(super) const NESTED: &str = "colmap/sparse";
/// The model of 4DGaussians' "multipleview" layout.
pub(super) const MULTIVIEW: &str = "sparse_";
/// Folder of a model's files if there is no folder for several.
pub(super) const COLMAP: &str = "colmap";
/// Models of workspaces next to the images, or with images of their own: those of `image_undistorter`, and last the
/// model from which the converter of 3DGS undistorts.
pub(super) const WORKSPACES: [&str; 4] = ["undistorted/sparse", "dense/sparse", "dense/0/sparse", "distorted/sparse"];
/// A model's points as .ply: 3DGS writes it next to the others, and other programs in place of them.
const POINTS: &str = "points3D.ply";
/// Folders of a model next to poses of another layout: COLMAP's habit and Nerfstudio's.
const BESIDE: [&str; 2] = [SPARSE, NESTED];
/// Names of folders between a capture's folder and a model's files, in addition to numbers.
const MODEL_FOLDERS: [&str; 6] = [SPARSE, MULTIVIEW, COLMAP, "distorted", "undistorted", "dense"];
/// Mean reprojection error above which poses blur the result, pixels.
const LARGE_ERROR: f64 = 1.5;

/// Reads the reconstruction at `marker`: a folder with models, of which the one with most images is taken, or a model's
/// own file.
pub(super) fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    let fps = options.fps.unwrap_or(DEFAULT_FPS);
    let (mut warnings, mut notes, mut account) = (Vec::new(), Vec::new(), Account::default());
    let models = if marker.is_file() { marker.parent().unwrap_or(root) } else { marker };
    let root = &capture_folder(models);
    let lookup = Lookup::new(root, options)?;
    let (folder, registered) = best_model(models, &mut warnings)?;
    if ["bin", "txt"].iter().all(|ending| folder.join(format!("images.{ending}")).is_file()) {
        notes.push(format!("{} has its model as .bin and as .txt: the .bin files are read.", folder.display()));
    }
    let points = colmap_files::points(&folder)?;
    let mut shots = sources(&folder, &registered, options.poses)?;
    let of_rig = multiview::rename(root, &mut shots, &mut account);
    let names: Vec<&str> = shots.iter().map(|(name, _)| name.as_str()).collect();
    let base = if of_rig { root.clone() } else { lookup.folder_of(&names) };
    let mut files = files(&lookup, &base, &names)?;
    // Names separate cameras by forward slashes.
    shots.iter_mut().for_each(|(name, _)| *name = name.replace('\\', "/"));
    if !of_rig {
        unregistered::settle(&base, &mut shots, &mut files, options, &mut account);
    }
    check_errors(&points, &mut warnings);
    let names: Vec<&str> = shots.iter().map(|(name, _)| name.as_str()).collect();
    let poses: Vec<Se3> = shots.iter().map(|(_, source)| source.cam_from_world).collect();
    let order = sequence::order(&names, &poses, options.sequence, fps, &mut warnings, &mut notes);
    let splits = Lists::next_to_model(root, &folder)?.settle(&names, &mut account)?;
    let frame = |(((split, image), (_, source)), &place): (((Option<Split>, PathBuf), &Shot), &_)| {
        Some(RawFrame { split: split?, ..RawFrame::new(place, source.clone(), image) })
    };
    let mut frames: Vec<RawFrame> =
        splits.into_iter().zip(files).zip(&shots).zip(&order.frames).filter_map(frame).collect();
    if !lookup.folders().contains(&base) && !of_rig && base.is_dir() {
        let what = format!("Images are those in {}.", base.strip_prefix(root).unwrap_or(&base).display());
        account.add(Aspect::Assumed, Severity::Note, what);
    }
    frames.sort_by(|a, b| (a.camera, a.index, &a.image).cmp(&(b.camera, b.index, &b.image)));
    lookup.report(&mut account);
    let mut cloud = cloud_of(&points, &folder)?;
    if cloud.is_none() {
        cloud = multiview::points(root)?;
    }
    if let (Some(cloud), true) = (&cloud, points.is_empty()) {
        notes.push(format!(
            "The model has no file of points; the {} initial points are those of a .ply file.",
            cloud.points.len()
        ));
    }
    Ok(RawCapture {
        cameras: order.cameras,
        frames,
        named: order.named,
        timing: order.timing,
        fps,
        points: cloud,
        warnings,
        notes,
        account,
        ..RawCapture::new(root, CaptureKind::Colmap, Convention::COLMAP)
    })
}

/// The capture's folder of a model: the nearest one with images, of itself and those above while they are named as
/// folders of models are.
fn capture_folder(models: &Path) -> PathBuf {
    let mut folder = models.to_path_buf();
    loop {
        if has_images(&folder) {
            return folder;
        }
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let of_models = MODEL_FOLDERS.iter().any(|n| name.eq_ignore_ascii_case(n)) || name.parse::<u32>().is_ok();
        if folder != models && !of_models {
            // A folder of results next to the images, such as `output/sparse/0`.
            // Loose images there may be anything.
            let above = folder.parent().filter(|p| !p.as_os_str().is_empty() && has_image_folder(p));
            return above.map_or(folder.clone(), Path::to_path_buf);
        }
        folder = match folder.parent() {
            Some(above) if !above.as_os_str().is_empty() => above.to_path_buf(),
            Some(_) if folder.is_relative() && folder != Path::new(".") => PathBuf::from("."),
            _ => return folder,
        };
    }
}

/// Whether a folder has images where captures have them.
pub(super) fn has_images(folder: &Path) -> bool {
    has_image_folder(folder) || !rig::image_names(folder).is_empty() || multiview::applies(folder)
}

/// Whether a folder has one that is named after images.
fn has_image_folder(folder: &Path) -> bool {
    rig::file_names(folder).iter().any(|n| lookup::is_image_folder(n) && folder.join(n).is_dir())
}

/// The image of every shot, or where it should be.
fn files(lookup: &Lookup, base: &Path, names: &[&str]) -> Result<Vec<PathBuf>> {
    let bases = [base.to_path_buf()];
    let found: Vec<Option<PathBuf>> = names.iter().map(|name| lookup.image(&bases, name)).collect::<Result<_>>()?;
    if found.iter().all(Option::is_none) && names.iter().all(|name| !name.contains(['/', '\\'])) {
        let found = names.iter().map(|name| lookup.anywhere(name)).collect::<Result<Option<Vec<_>>>>()?;
        if let Some(found) = found {
            return Ok(found);
        }
    }
    if found.iter().all(Option::is_none) && lookup::is_reduced(base) {
        // LLFF's reduced copies are numbered again, in the order of the originals.
        let images = rig::image_names(base);
        if images.len() == names.len() {
            let mut order: Vec<usize> = (0..names.len()).collect();
            order.sort_by_key(|&i| names[i]);
            let mut out = vec![PathBuf::new(); names.len()];
            order.into_iter().zip(images).for_each(|(i, image)| out[i] = base.join(image));
            return Ok(out);
        }
    }
    let place = |(found, name): (Option<PathBuf>, &&str)| found.unwrap_or_else(|| base.join(name));
    Ok(found.into_iter().zip(names).map(place).collect())
}

/// An image's name and its camera.
pub(super) type Shot = (String, Camera);

/// Name and camera of every registered image.
fn sources(folder: &Path, registered: &[Registered], poses: Poses) -> Result<Vec<Shot>> {
    let used = registered.iter().map(|r| r.camera).collect();
    let optics = colmap_files::cameras(folder, &used)?;
    let mut shots = Vec::with_capacity(registered.len());
    for picture in registered {
        let place = |e: Error| e.at(format!("{}: image {:.200}", folder.display(), picture.name));
        let camera = optics.get(&picture.camera).ok_or_else(|| {
            place(Error::input(format!("its camera {} is not in the cameras file", picture.camera)))
                .remedy("Export the reconstruction again.")
        })?;
        let cam_from_world = pose_of(picture).and_then(|p| Convention::COLMAP.read_as(p, poses)).map_err(place)?;
        let source = Camera {
            cam_from_world,
            intrinsics: camera.intrinsics,
            lens: camera.lens,
            width: camera.width,
            height: camera.height,
            near: Camera::NEAR,
        };
        shots.push((picture.name.clone(), source));
    }
    Ok(shots)
}

/// The registered images of the largest model in a folder, and its points; no image is examined.
pub(super) fn shots(folder: &Path) -> Result<(Vec<Shot>, Option<PointCloud>)> {
    let (folder, registered) = best_model(folder, &mut Vec::new())?;
    Ok((sources(&folder, &registered, Poses::STATED)?, cloud_of(&colmap_files::points(&folder)?, &folder)?))
}

/// Whether a folder is a model, or holds some.
pub(super) fn is_model(folder: &Path) -> bool {
    has_cameras(folder) || rig::file_names(folder).iter().any(|n| has_cameras(&folder.join(n)))
}

/// Whether a marker of models is one: a folder that holds some, or a model's file with the other two.
pub(super) fn is_marker(marker: &Path) -> bool {
    let with_images = |folder: &Path| rig::has_any(folder, &["images.bin", "images.txt"]);
    match marker.is_file() {
        true => marker.parent().is_some_and(with_images),
        false => is_model(marker),
    }
}

fn has_cameras(folder: &Path) -> bool {
    rig::has_any(folder, &["cameras.bin", "cameras.txt"])
}

/// The model folder (`sparse` itself, or one in it: a numbered one, else one of any name) with the most registered images.
fn best_model(sparse: &Path, warnings: &mut Vec<String>) -> Result<(PathBuf, Vec<Registered>)> {
    let (numbered, named): (Vec<String>, Vec<String>) =
        rig::file_names(sparse).into_iter().partition(|n| n.parse::<u32>().is_ok());
    let mut candidates = vec![sparse.to_path_buf()];
    candidates.extend(numbered.iter().map(|n| sparse.join(n)));
    candidates.retain(|c| has_cameras(c));
    let split = !candidates.is_empty();
    if candidates.is_empty() {
        candidates.extend(named.iter().map(|n| sparse.join(n)).filter(|c| has_cameras(c)));
    }
    let mut models = Vec::new();
    for folder in candidates {
        let images = colmap_files::images(&folder)?;
        models.push((folder, images));
    }
    let count = models.len();
    // The first of equals: `max_by_key` would take the last.
    let best = models.into_iter().rev().max_by_key(|(_, images)| images.len()).ok_or_else(|| {
        Error::input("there is no cameras.bin or cameras.txt")
            .at(sparse.display())
            .remedy("Point to a finished COLMAP reconstruction (sparse/0).")
    })?;
    if count > 1 {
        let what = if split { "COLMAP split the images into" } else { "There are" };
        warnings.push(format!(
            "{what} {count} separate models; {} is used ({} images). To read another, give its path.",
            best.0.display(),
            best.1.len()
        ));
    }
    Ok(best)
}

fn pose_of(picture: &Registered) -> Result<Se3> {
    let (unit, length) = quat::normalize(picture.quat);
    if !(length.is_finite() && length > 1e-6) || picture.translation.iter().any(|v| !v.is_finite()) {
        return Err(Error::input("the pose holds NaN, infinity or a zero quaternion")
            .remedy("Reconstruct again, or remove that image."));
    }
    Ok(Se3 { rotation: quat::to_rotation(unit), translation: picture.translation })
}

fn check_errors(points: &[Point], warnings: &mut Vec<String>) {
    let errors: Vec<f64> = points.iter().map(|p| p.error).filter(|e| e.is_finite() && *e >= 0.0).collect();
    let mean = errors.iter().sum::<f64>() / errors.len().max(1) as f64;
    if mean > LARGE_ERROR {
        warnings
            .push(format!("COLMAP's mean reprojection error is {mean:.2} px: poses are inexact, results will blur."));
    }
}

/// The points of a COLMAP model that is next to `marker`, whose frames are `frames`: in their world, if the cameras
/// agree. The result is reported.
pub(super) fn companion_points(
    root: &Path,
    marker: &Path,
    frames: &[RawFrame],
    warnings: &mut Vec<String>,
    notes: &mut Vec<String>,
) -> Option<PointCloud> {
    let sparse = BESIDE.iter().map(|name| root.join(name)).find(|folder| is_model(folder))?;
    let poses = marker.file_name().unwrap_or_default().to_string_lossy();
    match aligned_points(root, &sparse, frames) {
        Ok((cloud, how)) => {
            let count = cloud.points.len();
            notes.push(format!("The {count} initial points are those of {}, {how} {poses}.", sparse.display()));
            Some(cloud)
        }
        Err(why) => {
            warnings.push(format!("{} is not used for initial points: {why}", sparse.display()));
            None
        }
    }
}

fn aligned_points(root: &Path, sparse: &Path, frames: &[RawFrame]) -> Result<(PointCloud, &'static str)> {
    let (folder, registered) = best_model(sparse, &mut Vec::new())?;
    let mut cloud = cloud_of(&colmap_files::points(&folder)?, &folder)?
        .ok_or_else(|| Error::input("it has no points").remedy("Triangulate them (colmap point_triangulator)."))?;
    let model: BTreeMap<String, Se3> =
        registered.iter().map(|r| Ok((extra_model::key(Path::new(&r.name)), pose_of(r)?))).collect::<Result<_>>()?;
    let key = |frame: &RawFrame| extra_model::key(frame.image.strip_prefix(root).unwrap_or(&frame.image));
    let pairs: Vec<(Se3, Se3)> =
        frames.iter().filter_map(|f| Some((f.source.cam_from_world, *model.get(&key(f))?))).collect();
    let world_from_model = extra_model::align(&pairs)?;
    cloud.points.iter_mut().for_each(|p| *p = world_from_model.apply(*p));
    let how = match world_from_model.is_identity() {
        true => "whose cameras agree with",
        false => "turned, moved and scaled to the cameras of",
    };
    Ok((cloud, how))
}

/// A model's points, which some programs write as .ply alone.
fn cloud_of(points: &[Point], model: &Path) -> Result<Option<PointCloud>> {
    let ply = model.join(POINTS);
    match cloud(points) {
        None if ply.is_file() => read_cloud(&ply).map(Some),
        cloud => Ok(cloud),
    }
}

fn cloud(points: &[Point]) -> Option<PointCloud> {
    let mut cloud = PointCloud::default();
    for point in points {
        cloud.push(point.position, point.color.map(|v| f32::from(v) / 255.0), None);
    }
    (!cloud.points.is_empty()).then_some(cloud)
}
