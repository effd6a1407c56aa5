//! Exports of capture programs and telephones: Metashape, RealityScan, Polycam, Record3D. Each is a file that states
//! where poses and images are; shared code is here. They were built from public documentation and synthetic samples.

mod metashape;
mod polycam;
mod realityscan;
mod record3d;
#[cfg(test)]
mod tests;

use super::convention::{Convention, Poses};
use super::lookup::Twins;
use super::points::read_cloud;
use super::{CaptureKind, CaptureOptions, DepthFile, PointCloud, RawCapture, RawFrame, Timing, rig, sequence};
use super::{lookup, pose};
use splat4d::math::Se3;
use splat4d::scene::Camera;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::{Error, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A kind of export.
struct Export {
    /// Its file (or folder) in a capture's folder; `None`: it is not there.
    find: fn(&Path) -> Option<PathBuf>,
    /// Whether a given path is such a file.
    is: fn(&Path) -> bool,
    /// Reads the capture in a folder from that file.
    read: fn(&Path, &Path, &CaptureOptions) -> Result<RawCapture>,
}

/// In the order in which they are searched for: those that are recognised by their content are last.
const EXPORTS: [Export; 4] = [polycam::EXPORT, record3d::EXPORT, metashape::EXPORT, realityscan::EXPORT];

/// Reads the export in a folder, or that a file is. `None`: it is none.
pub(super) fn read(path: &Path, options: &CaptureOptions) -> Option<Result<RawCapture>> {
    if path.is_file() {
        let root = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        return EXPORTS.iter().find(|e| (e.is)(path)).map(|e| (e.read)(root, path, options));
    }
    EXPORTS.iter().find_map(|e| (e.find)(path).map(|file| (e.read)(path, &file, options)))
}

/// Whether there is an export in a folder.
pub(super) fn is_there(folder: &Path) -> bool {
    EXPORTS.iter().any(|e| (e.find)(folder).is_some())
}

/// A posed image.
struct Shot {
    /// Its name, for messages and for the order of images without times.
    name: String,
    image: PathBuf,
    source: Camera,
    /// Seconds; all shots have one, or none.
    time: Option<f64>,
    depth: Option<DepthFile>,
}

/// Data of an export next to its shots.
struct Said {
    kind: CaptureKind,
    /// Convention of its poses.
    convention: Convention,
    fps: Option<f64>,
    points: Option<PointCloud>,
    up: Option<[f64; 3]>,
    warnings: Vec<String>,
    notes: Vec<String>,
}

/// Sorted names of a folder's images, one of each name whatever its ending, and a remark about those left out. Errors:
/// images of one name differ in size.
fn images_of(folder: &Path) -> Result<(Vec<String>, Option<String>)> {
    let mut twins = Twins::default();
    let kept = twins.single(rig::image_names(folder).iter().map(|name| folder.join(name)).collect())?;
    let name = |image: &PathBuf| image.file_name().unwrap_or_default().to_string_lossy().into_owned();
    Ok((kept.iter().map(name).collect(), twins.in_words(folder)))
}

/// `cam_from_world` of a camera-to-world matrix in OpenGL axes.
fn opengl_pose(rows: &[[f64; 4]; 4]) -> Result<Se3> {
    Convention::NERF.read_as(pose::checked(Se3::from_rows(rows))?, Poses::STATED)
}

/// The capture of some shots: of one moving camera where they have times, else as their names specify.
fn take(root: &Path, mut shots: Vec<Shot>, said: Said, options: &CaptureOptions) -> Result<RawCapture> {
    let Said { kind, convention, fps, points, up, mut warnings, mut notes } = said;
    let fps = options.fps.or(fps).unwrap_or(DEFAULT_FPS);
    for shot in &mut shots {
        let pose = &mut shot.source.cam_from_world;
        *pose = convention.reread(pose, options.poses).map_err(|e| e.at(shot.image.display()))?;
    }
    let timed = !shots.is_empty() && shots.iter().all(|s| s.time.is_some());
    shots.sort_by(|a, b| a.time.partial_cmp(&b.time).unwrap_or(std::cmp::Ordering::Equal).then(a.name.cmp(&b.name)));
    let names: Vec<&str> = shots.iter().map(|s| s.name.as_str()).collect();
    let order = if timed {
        let first = shots[0].time.unwrap_or_default();
        let frame = |(index, s): (usize, &Shot)| (0, index, s.time.unwrap_or_default() - first);
        let frames = shots.iter().enumerate().map(frame).collect();
        sequence::FrameOrder { cameras: vec!["moving".into()], frames, named: false, timing: Timing::Told }
    } else {
        let poses: Vec<Se3> = shots.iter().map(|s| s.source.cam_from_world).collect();
        sequence::order(&names, &poses, options.sequence, fps, &mut warnings, &mut notes)
    };
    let sequence::FrameOrder { cameras, frames: places, named, timing } = order;
    let frame =
        |(shot, place): (Shot, _)| RawFrame { depth: shot.depth, ..RawFrame::new(place, shot.source, shot.image) };
    Ok(RawCapture {
        cameras,
        frames: shots.into_iter().zip(places).map(frame).collect(),
        named,
        timing,
        fps,
        points,
        up,
        warnings,
        notes,
        ..RawCapture::new(root, kind, convention)
    })
}

/// How folders begin whose images are not the photos, in addition to those of masks: depth, reduced copies.
const OTHERS: [&str; 3] = ["depth", "images_", "."];

/// Images by their names without endings, however these are spelled; from a folder, and folders down to two levels
/// below.
struct Images {
    found: BTreeMap<String, Vec<PathBuf>>,
    root: PathBuf,
}

impl Images {
    fn below(root: &Path) -> Self {
        let mut found = BTreeMap::new();
        let mut add = |folder: &Path| {
            for name in rig::image_names(folder) {
                found.entry(key(&name)).or_insert_with(Vec::new).push(folder.join(name));
            }
        };
        add(root);
        let folders = |of: &Path| -> Vec<PathBuf> {
            let names = rig::file_names(of)
                .into_iter()
                .filter(|n| !lookup::may_hold_masks(n) && !OTHERS.iter().any(|o| n.starts_with(o)));
            names.map(|n| of.join(n)).filter(|p| p.is_dir()).collect()
        };
        for folder in folders(root) {
            add(&folder);
            folders(&folder).iter().for_each(|inner| add(inner));
        }
        Self { found, root: root.to_path_buf() }
    }

    /// The image that an export calls `name`, with or without folders and ending; where it should be if it is missing.
    /// Errors: several fit.
    fn named(&self, name: &str) -> Result<PathBuf> {
        match self.found.get(&key(name)).map_or(&[][..], Vec::as_slice) {
            [one] => Ok(one.clone()),
            [] => Ok(self.root.join(name.replace('\\', "/"))),
            [first, second, ..] => {
                let what = format!(
                    "there are several images of the name {name:.200}: {} and {}",
                    first.display(),
                    second.display()
                );
                // A copy in another size would be as good; the user must state which one is meant.
                Err(Error::input(what).remedy("Move the others out of the capture's folder."))
            }
        }
    }
}

/// A name without folders and ending, composed and in lower case.
fn key(name: &str) -> String {
    let file = name.rsplit(['/', '\\']).next().unwrap_or(name);
    let stem = match file.rsplit_once('.') {
        Some((stem, ending)) if rig::IMAGE_ENDINGS.iter().any(|e| ending.eq_ignore_ascii_case(e)) => stem,
        _ => file,
    };
    lookup::fold(stem)
}

/// The only point cloud in a folder; several are none, and a note states so.
fn only_points(root: &Path, notes: &mut Vec<String>) -> Result<Option<PointCloud>> {
    let clouds: Vec<String> =
        rig::file_names(root).into_iter().filter(|n| n.to_lowercase().ends_with(".ply")).collect();
    match &clouds[..] {
        [] => Ok(None),
        [one] => {
            notes.push(format!("The initial points are those of {one}."));
            read_cloud(&root.join(one)).map(Some)
        }
        several => {
            notes.push(format!(
                "There are {} point clouds ({}): none is taken. Name one with --set init=FILE.",
                several.len(),
                several.join(", ")
            ));
            Ok(None)
        }
    }
}

/// Reports how many images of an export have no pose.
fn without_pose(count: usize, of: usize, warnings: &mut Vec<String>) {
    if count > 0 {
        warnings.push(format!("{count} of {of} images have no pose and are left out: they were not aligned."));
    }
}
