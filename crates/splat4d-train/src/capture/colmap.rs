//! COLMAP reconstructions: `sparse/0/{cameras,images,points3D}.{bin,txt}` and the pictures in `images/`.
//!
//! COLMAP knows no time. Picture names `cam/frame` or `cam_frameN` give camera and frame number; where each camera has
//! only one registered picture, the other pictures of that camera on disk share its pose: the usual way to calibrate a
//! fixed rig is to reconstruct one instant.

use super::colmap_files::{self, Point, Registered};
use super::{CaptureKind, CaptureOptions, Extent, PointCloud, RawFrame, Split, Take, beside, rig, sequence};
use splat4d::math::{Se3, quat};
use splat4d::scene::Camera;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::{Error, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// The folder of models: the marker.
pub(super) const SPARSE: &str = "sparse";
/// Where a model may lie beside poses of another layout: COLMAP's habit and Nerfstudio's.
const BESIDE: [&str; 2] = [SPARSE, "colmap/sparse"];
/// Below this part of registered pictures the reconstruction is probably incomplete, and below the second broken.
const FEW_REGISTERED: [f64; 2] = [0.9, 0.7];
/// Mean reprojection error above which poses blur the result, pixels.
const LARGE_ERROR: f64 = 1.5;

/// Reads the reconstruction below `marker` (the folder `sparse`) with the most pictures.
pub(super) fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<Take> {
    let fps = options.fps.unwrap_or(DEFAULT_FPS);
    let mut warnings = Vec::new();
    let (folder, registered) = best_model(marker, &mut warnings)?;
    let points = colmap_files::points(&folder)?;
    let base = image_folder(root, &registered);
    let mut shots = sources(&folder, &registered)?;
    let listed = shots.len();
    add_siblings(&base, &mut shots);
    if shots.len() == listed {
        check_registration(&base, &registered, &mut warnings);
    }
    check_errors(&points, &mut warnings);
    let names: Vec<&str> = shots.iter().map(|(name, _)| name.as_str()).collect();
    let poses: Vec<Se3> = shots.iter().map(|(_, source)| source.cam_from_world).collect();
    let mut notes = Vec::new();
    let order = sequence::order(&names, &poses, options.sequence, fps, &mut warnings, &mut notes);
    let mut frames: Vec<RawFrame> = shots
        .iter()
        .zip(&order.frames)
        .map(|((name, source), &(camera, index, time))| RawFrame {
            camera,
            source: source.clone(),
            time,
            index,
            image: base.join(name),
            mask: mask_of(root, name),
            depth: None,
            flow: None,
            labels: None,
            features: None,
            tracks: None,
            split: Split::Train,
        })
        .collect();
    frames.sort_by(|a, b| (a.camera, a.index, &a.image).cmp(&(b.camera, b.index, &b.image)));
    Ok(Take {
        name: None,
        root: root.to_path_buf(),
        kind: CaptureKind::Colmap,
        cameras: order.cameras,
        frames,
        take: Extent::default(),
        named: order.named,
        timing: order.timing,
        hold_out: None,
        fps,
        points: cloud(&points),
        background: None,
        up: None,
        labels: Vec::new(),
        warnings,
        notes,
    })
}

/// A picture's name and its camera.
pub(super) type Shot = (String, Camera);

/// Name and camera of every registered picture.
fn sources(folder: &Path, registered: &[Registered]) -> Result<Vec<Shot>> {
    let optics = colmap_files::cameras(folder)?;
    let mut shots = Vec::with_capacity(registered.len());
    for picture in registered {
        let place = |e: Error| e.at(format!("{}: picture {:.200}", folder.display(), picture.name));
        let camera = optics.get(&picture.camera).ok_or_else(|| {
            place(Error::input(format!("its camera {} is not in the cameras file", picture.camera)))
                .remedy("Export the reconstruction again.")
        })?;
        let cam_from_world = pose_of(picture).map_err(place)?;
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

/// The registered pictures of the largest model in a folder, and its points; no picture is looked at.
pub(super) fn shots(folder: &Path) -> Result<(Vec<Shot>, Option<PointCloud>)> {
    let (folder, registered) = best_model(folder, &mut Vec::new())?;
    Ok((sources(&folder, &registered)?, cloud(&colmap_files::points(&folder)?)))
}

/// Whether a folder is a model, or holds some.
pub(super) fn is_model(folder: &Path) -> bool {
    has_cameras(folder) || rig::file_names(folder).iter().any(|n| has_cameras(&folder.join(n)))
}

fn has_cameras(folder: &Path) -> bool {
    ["cameras.bin", "cameras.txt"].iter().any(|n| folder.join(n).is_file())
}

/// The model folder (`sparse` itself or a numbered one in it) with the most registered pictures.
fn best_model(sparse: &Path, warnings: &mut Vec<String>) -> Result<(PathBuf, Vec<Registered>)> {
    let mut candidates = vec![sparse.to_path_buf()];
    candidates.extend(rig::file_names(sparse).iter().filter(|n| n.parse::<u32>().is_ok()).map(|n| sparse.join(n)));
    candidates.retain(|c| has_cameras(c));
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
        warnings.push(format!(
            "COLMAP split the pictures into {count} separate models; {} is used ({} pictures).",
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
            .remedy("Reconstruct again, or remove that picture."));
    }
    Ok(Se3 { rotation: quat::to_rotation(unit), translation: picture.translation })
}

/// `images/`, unless the pictures lie elsewhere.
fn image_folder(root: &Path, registered: &[Registered]) -> PathBuf {
    let Some(first) = registered.first() else { return root.join("images") };
    let folders = ["images", "input", "."].map(|f| root.join(f));
    let found = folders.iter().find(|f| f.join(&first.name).is_file());
    found.unwrap_or(&folders[0]).clone()
}

/// Where every camera has exactly one registered picture, adds the other pictures of its folder (or, for `cam_frameN`,
/// of its prefix).
fn add_siblings(base: &Path, shots: &mut Vec<(String, Camera)>) {
    let names: Vec<&str> = shots.iter().map(|(n, _)| n.as_str()).collect();
    let naming = rig::naming(&names);
    if !naming.told || naming.cameras.len() != shots.len() {
        return;
    }
    let mut listings: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let registered = shots.clone();
    for (i, (name, source)) in registered.iter().enumerate() {
        let folder = name.rsplit_once('/').map_or("", |(folder, _)| folder);
        let listing = listings.entry(folder.to_string()).or_insert_with(|| rig::image_names(&base.join(folder)));
        let camera = &naming.cameras[naming.frames[i].0];
        for file in listing {
            let path = if folder.is_empty() { file.clone() } else { format!("{folder}/{file}") };
            let same = rig::naming(&[&path]);
            if path != *name && same.told && same.cameras[0] == *camera {
                shots.push((path, source.clone()));
            }
        }
    }
}

/// Warns where pictures on disk were not registered.
fn check_registration(base: &Path, registered: &[Registered], warnings: &mut Vec<String>) {
    let folders: BTreeSet<&str> = registered.iter().map(|r| r.name.rsplit_once('/').map_or("", |(f, _)| f)).collect();
    let on_disk: usize = folders.iter().map(|f| rig::image_names(&base.join(f)).len()).sum();
    let part = registered.len() as f64 / on_disk.max(1) as f64;
    if part >= FEW_REGISTERED[0] {
        return;
    }
    let advice =
        if part < FEW_REGISTERED[1] { "the reconstruction is probably broken" } else { "parts may be missing" };
    warnings.push(format!("COLMAP registered only {} of {on_disk} pictures: {advice}.", registered.len()));
}

fn check_errors(points: &[Point], warnings: &mut Vec<String>) {
    let errors: Vec<f64> = points.iter().map(|p| p.error).filter(|e| e.is_finite() && *e >= 0.0).collect();
    let mean = errors.iter().sum::<f64>() / errors.len().max(1) as f64;
    if mean > LARGE_ERROR {
        warnings
            .push(format!("COLMAP's mean reprojection error is {mean:.2} px: poses are inexact, results will blur."));
    }
}

/// The points of a COLMAP model that lies beside `marker`, whose frames are `frames`: in their world, if the cameras
/// agree. What came of it is told.
pub(super) fn points_beside(
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
    let mut cloud = cloud(&colmap_files::points(&folder)?)
        .ok_or_else(|| Error::input("it has no points").remedy("Triangulate them (colmap point_triangulator)."))?;
    let model: BTreeMap<String, Se3> =
        registered.iter().map(|r| Ok((beside::key(Path::new(&r.name)), pose_of(r)?))).collect::<Result<_>>()?;
    let key = |frame: &RawFrame| beside::key(frame.image.strip_prefix(root).unwrap_or(&frame.image));
    let pairs: Vec<(Se3, Se3)> =
        frames.iter().filter_map(|f| Some((f.source.cam_from_world, *model.get(&key(f))?))).collect();
    let world_from_model = beside::align(&pairs)?;
    cloud.points.iter_mut().for_each(|p| *p = world_from_model.apply(*p));
    let how = match world_from_model.is_identity() {
        true => "whose cameras agree with",
        false => "turned, moved and scaled to the cameras of",
    };
    Ok((cloud, how))
}

fn cloud(points: &[Point]) -> Option<PointCloud> {
    let mut cloud = PointCloud::default();
    for point in points {
        cloud.push(point.position, point.color.map(|v| f32::from(v) / 255.0), None);
    }
    (!cloud.points.is_empty()).then_some(cloud)
}

/// `masks/name.jpg.png` (COLMAP's habit) or `masks/name.png`.
fn mask_of(root: &Path, name: &str) -> Option<PathBuf> {
    let masks = root.join("masks");
    let appended = masks.join(format!("{name}.png"));
    [appended, masks.join(name).with_extension("png")].into_iter().find(|p| p.is_file())
}
