//! N3DV captures (Li 2022): `poses_bounds.npy`, one row per camera, and a folder of frames per camera.

use super::account::Severity;
use super::account::{Account, Aspect, first_names};
use super::convention::{Convention, Poses};
use super::lookup::Twins;
use super::points::read_cloud;
use super::stray::{ffmpeg_command, videos};
use super::{CaptureKind, CaptureOptions, PointCloud, RawCapture, RawFrame, Split};
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
/// How far the images' shape may differ from the stated one before the poses are taken to be of other images.
const MAX_ASPECT_CHANGE: f64 = 0.01;
/// Names under which prepared data sets keep their cloud.
const POINTS: &[&str] = &["points.ply", "points3D.ply", "points3D_downsample2.ply"];

/// Folder of the notes of extracted frames (`splat4d_import::shipped`).
const NOTES: &str = "import";
/// Rates are stated in steps of this, frames per second: intervals in files are rounded.
const WHOLE_RATE: f64 = 0.01;

/// A folder of frames: its camera's name and the images.
struct Folder {
    name: String,
    images: Vec<PathBuf>,
}

/// Whether this is probably an N3DV take and not a single-camera LLFF folder.
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

/// The cloud that prepared data sets keep next to the poses.
pub(super) fn points(root: &Path) -> Result<Option<PointCloud>> {
    POINTS.iter().map(|name| root.join(name)).find(|p| p.is_file()).map(|p| read_cloud(&p)).transpose()
}

/// Reads poses and frame folders; the first camera is held out.
pub(super) fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    let place = |e: Error| e.at(marker.display());
    let rows = rows(marker)?;
    let mut folders = folders(root);
    let mut twins = Twins::default();
    for folder in &mut folders {
        folder.images = twins.single(std::mem::take(&mut folder.images))?;
    }
    let films = videos(root);
    let fps = options.fps.or_else(|| extracted_rate(root, &folders.first()?.name)).unwrap_or(DEFAULT_FPS);
    let names: Vec<String> = folders.iter().map(|f| f.name.clone()).collect();
    let Some(which) = rows_of(&names, rows.len()) else {
        return Err(place(mismatch(rows.len(), &folders, &films)));
    };
    let mut account = Account::default();
    twins.report(root, &mut account);
    for (severity, what) in about_rows(&names, &which, rows.len()) {
        let aspect = if which.len() < rows.len() { Aspect::NotFound } else { Aspect::Assumed };
        account.add(aspect, severity, what);
    }
    let numbers = numbers(&folders, &mut account);
    let mut frames = Vec::new();
    for (camera, folder) in folders.iter().enumerate() {
        let row = &rows[which[camera]];
        let in_row = |e: Error| e.at(format!("{} row {} (camera {})", marker.display(), which[camera], folder.name));
        let header = picture::header(&folder.images[0])?;
        let source = camera_of(row, header.stored, options.poses).map_err(in_row)?;
        for (&index, image) in numbers[camera].iter().zip(&folder.images) {
            let split = if camera == 0 && folders.len() > 1 { Split::Held } else { Split::Train };
            let place = (camera, index, index as f64 / fps);
            frames.push(RawFrame { split, ..RawFrame::new(place, source.clone(), image.clone()) });
        }
    }
    Ok(RawCapture {
        cameras: folders.into_iter().map(|f| f.name).collect(),
        frames,
        named: true,
        fps,
        points: points(root)?,
        account,
        ..RawCapture::new(root, CaptureKind::N3dv, Convention::NERF)
    })
}

/// Frames a second of a camera whose frames `train` extracted, by the notes that it keeps of that.
fn extracted_rate(root: &Path, camera: &str) -> Option<f64> {
    let note = crate::files::read(&root.join(NOTES).join(format!("{camera}.json"))).ok()?;
    let note: serde_json::Value = serde_json::from_slice(&note).ok()?;
    let rate = 1.0 / note.get("interval")?.as_f64()?;
    let whole = (rate / WHOLE_RATE).round() * WHOLE_RATE;
    let rate = if (rate - whole).abs() < WHOLE_RATE { whole } else { rate };
    super::options::check_rate("frame rate", rate).ok().map(|()| rate)
}

/// The row of poses that each camera has, of this many: in the order of names; or, where cameras are missing, by the
/// number in the name, which counts from 0. `None`: they do not fit.
pub fn rows_of(names: &[String], rows: usize) -> Option<Vec<usize>> {
    if names.len() == rows {
        return Some((0..rows).collect());
    }
    let numbers: Vec<usize> = names.iter().map(|name| rig::trailing_number(name)).collect::<Option<_>>()?;
    let distinct: BTreeSet<usize> = numbers.iter().copied().collect();
    let fit = distinct.len() == names.len() && distinct.first() == Some(&0) && numbers.iter().all(|n| *n < rows);
    (fit && names.len() < rows).then_some(numbers)
}

/// Remarks about the rows that cameras have.
pub fn about_rows(names: &[String], which: &[usize], rows: usize) -> Vec<(Severity, String)> {
    let mut out = Vec::new();
    if which.len() < rows {
        let gone: Vec<String> = (0..rows).filter(|row| !which.contains(row)).map(|row| row.to_string()).collect();
        let what = format!(
            "{} of {rows} cameras of poses_bounds.npy are missing: rows {} (counted from 0). Rows are taken by the numbers in names.",
            gone.len(),
            first_names(&gone)
        );
        out.push((Severity::Warning, what));
    } else {
        let numbers: Vec<Option<usize>> = names.iter().map(|name| rig::trailing_number(name)).collect();
        if let Some(k) = numbers.windows(2).position(|w| w[0].zip(w[1]).is_some_and(|(a, b)| a > b)) {
            let what = format!(
                "Rows of poses_bounds.npy are given to cameras in the order of the letters of their names, as LLFF's scripts sort \
                 them: {} comes before {}. Otherwise pad the numbers with zeros.",
                names[k],
                names[k + 1]
            );
            out.push((Severity::Warning, what));
        }
    }
    out
}

/// The frame numbers of every folder's images: as named, counted from the smallest of all, so that a lost frame does
/// not shift those after it; else their order.
fn numbers(folders: &[Folder], account: &mut Account) -> Vec<Vec<usize>> {
    let named = |image: &PathBuf| rig::trailing_number(&image.file_name()?.to_string_lossy());
    let numbers: Option<Vec<Vec<usize>>> =
        folders.iter().map(|f| f.images.iter().map(named).collect::<Option<Vec<usize>>>()).collect();
    let in_order = || folders.iter().map(|f| (0..f.images.len()).collect()).collect();
    let Some(mut numbers) = numbers else { return in_order() };
    let all: BTreeSet<usize> = numbers.iter().flatten().copied().collect();
    let (Some(&first), Some(&last)) = (all.first(), all.last()) else { return in_order() };
    // Cameras that number their frames apart, or share a number, carry no information about each other's time.
    let apart = (0..numbers.len()).any(|c| {
        let others: BTreeSet<usize> =
            numbers.iter().enumerate().filter(|(k, _)| *k != c).flat_map(|(_, n)| n.clone()).collect();
        let shared = numbers[c].iter().filter(|n| others.contains(n)).count();
        numbers[c].windows(2).any(|w| w[0] == w[1]) || numbers.len() > 1 && 2 * shared < numbers[c].len()
    });
    if apart || last - first > rig::MAX_SPAN {
        return in_order();
    }
    let lost: Vec<String> = (folders.iter().zip(&numbers))
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
    numbers.iter_mut().flatten().for_each(|n| *n -= first);
    numbers
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_those_of_the_order_or_where_cameras_are_missing_of_the_numbers() {
        let names = |list: &[&str]| list.iter().map(|n| (*n).to_owned()).collect::<Vec<String>>();
        let said = |names: &[String], rows: usize| about_rows(names, &rows_of(names, rows).unwrap(), rows);
        // Captures are shipped with gaps in their numbers.
        let all = names(&["cam00", "cam01", "cam04"]);
        assert_eq!((rows_of(&all, 3), said(&all, 3).len()), (Some(vec![0, 1, 2]), 0));
        let lost = names(&["cam00", "cam01", "cam03"]);
        assert_eq!(rows_of(&lost, 4), Some(vec![0, 1, 3]));
        assert!(said(&lost, 4)[0].1.contains("1 of 4 cameras"), "{:?}", said(&lost, 4));
        // Numbers that cannot be rows, or do not count from 0, carry no information.
        assert_eq!(rows_of(&all, 4), None);
        assert_eq!(rows_of(&names(&["cam01", "cam02"]), 3), None);
        assert_eq!(rows_of(&names(&["left", "right"]), 3), None);
        assert_eq!(rows_of(&all, 2), None);
        let unpadded = names(&["cam_0", "cam_1", "cam_10", "cam_2"]);
        assert!(said(&unpadded, 4)[0].1.contains("cam_10 comes before cam_2"));
    }
}
