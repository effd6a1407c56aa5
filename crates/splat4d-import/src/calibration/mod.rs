//! Calibrations of other programs: lenses and poses.
//!
//! A dialect is a file here and a line in the list; the content of a file identifies its dialect. Names of cameras are
//! matched with names of videos (`assign`). The result is `cam_from_world` in OpenCV axes, and pixels whose first
//! centre is at 0.5.

mod capture;
mod easymocap;
mod matching;
mod opencv;
mod qualisys;
mod shape;
#[cfg(test)]
mod tests;
mod transforms;
mod tree;

pub(crate) use matching::{Video, assign};
pub use shape::Shape;
pub(crate) use shape::{bars, fitted, shape};

use splat4d::math::Se3;
use splat4d::math::se3::{norm, sub};
use splat4d::scene::{Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::capture::{PointCloud, check_intrinsics, colmap_cameras, is_colmap, rigid};
use std::path::{Path, PathBuf};
use tree::Tree;

/// A camera of a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibrated {
    /// Its names; the first is the camera's, others may be those of its video.
    pub names: Vec<String>,
    /// Pixels across and down of the images that it was calibrated with, where the file states it.
    pub size: Option<[usize; 2]>,
    /// Pixels; the first pixel's centre is at 0.5.
    pub intrinsics: Intrinsics,
    /// Distortion.
    pub lens: Lens,
    /// Takes world points into the camera's axes; none: only the lens is calibrated.
    pub pose: Option<Se3>,
}

/// The unit of a calibration's lengths.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Unit {
    /// Metres, for the format states so.
    Metre,
    /// Whatever it was made with.
    #[default]
    Unstated,
}

/// All cameras of a calibration.
#[derive(Clone, Debug, Default)]
pub struct Calibration {
    /// The dialects it is in.
    pub dialects: Vec<&'static str>,
    /// The cameras, in the order of the files.
    pub cameras: Vec<Calibrated>,
    /// The unit of lengths.
    pub unit: Unit,
    /// Its points.
    pub points: Option<PointCloud>,
    /// Remarks on omitted or odd content, a sentence each.
    pub notes: Vec<String>,
}

/// A text file of a calibration.
struct Text {
    path: PathBuf,
    tree: Tree,
}

/// A camera in a file; two files may each state a part.
#[derive(Clone, Debug, Default)]
struct Part {
    names: Vec<String>,
    size: Option<[usize; 2]>,
    optics: Option<(Intrinsics, Lens)>,
    pose: Option<Se3>,
}

/// Content of a file.
#[derive(Default)]
struct Said {
    parts: Vec<Part>,
    unit: Unit,
    notes: Vec<String>,
}

/// A way in which programs write calibrations.
struct Dialect {
    /// Its name in messages.
    name: &'static str,
    /// Whether a file is in it.
    reads: fn(&Text) -> bool,
    read: fn(&Text) -> Result<Said>,
}

/// The dialects of text files, the most particular first.
const DIALECTS: [Dialect; 5] =
    [qualisys::DIALECT, capture::DIALECT, transforms::DIALECT, easymocap::DIALECT, opencv::DIALECT];

/// Longest file that is examined, bytes: those of a hundred cameras have some hundred thousand.
const MAX_BYTES: u64 = 64 << 20;
/// Files of a folder that are examined, at most.
const MAX_FILES: usize = 1000;

/// Reads a calibration: a file, or a folder with one, with a file for each camera, or with a COLMAP reconstruction.
///
/// Errors: an unknown format; damage; missing or invalid matrices; a duplicate camera; lenses that captures cannot
/// have.
pub fn read(path: &Path) -> Result<Calibration> {
    let there = std::fs::metadata(path).map_err(|e| {
        Error::io("the calibration cannot be read", e).at(path.display()).remedy("Check the path behind --calibration.")
    })?;
    if there.is_dir() {
        for folder in [path.to_path_buf(), path.join("sparse")] {
            if is_colmap(&folder) {
                return colmap(&folder);
            }
        }
    }
    let files = if there.is_dir() { files_of(path)? } else { vec![path.to_path_buf()] };
    let mut out = Calibration { unit: Unit::Metre, ..Calibration::default() };
    let mut parts: Vec<(Part, PathBuf)> = Vec::new();
    let mut refused = Vec::new();
    for file in files {
        let text = match Text::read(&file) {
            Ok(text) => text,
            // Other files may be in the folder; a file that was named is meant.
            Err(e) if there.is_dir() => {
                refused.push(e.to_string());
                continue;
            }
            Err(e) => return Err(e),
        };
        let Some(dialect) = DIALECTS.iter().find(|d| (d.reads)(&text)) else {
            refused.push(format!("{}: it names no cameras", file.display()));
            continue;
        };
        let said = (dialect.read)(&text).map_err(|e| e.at(file.display()))?;
        if !out.dialects.contains(&dialect.name) {
            out.dialects.push(dialect.name);
        }
        if said.unit == Unit::Unstated {
            out.unit = Unit::Unstated;
        }
        out.notes.extend(said.notes);
        for part in said.parts {
            add(&mut parts, part, &file)?;
        }
    }
    if parts.is_empty() {
        let why = if refused.is_empty() { "the folder is empty".into() } else { refused.join("; ") };
        return Err(Error::new(ErrorKind::Unsupported, format!("no calibration of cameras is found ({why:.600})"))
            .at(path.display())
            .remedy(format!(
                "Supported are: a COLMAP reconstruction, {}; see docs/filming.md.",
                DIALECTS.map(|d| d.name).join(", ")
            )));
    }
    out.cameras =
        parts.into_iter().map(|(part, file)| whole(part).map_err(|e| e.at(file.display()))).collect::<Result<_>>()?;
    alike(&out.cameras).map_err(|e| e.at(path.display()))?;
    Ok(out)
}

fn colmap(folder: &Path) -> Result<Calibration> {
    let (cameras, points) = colmap_cameras(folder)?;
    let of = |c: splat4d_train::capture::PosedCamera| {
        let pose = rigid(c.camera.cam_from_world).map_err(|e| e.at(folder.display()))?;
        Ok(Calibrated {
            names: vec![c.name],
            size: Some([c.camera.width, c.camera.height]),
            intrinsics: c.camera.intrinsics,
            lens: c.camera.lens,
            pose: Some(pose),
        })
    };
    let cameras = cameras.into_iter().map(of).collect::<Result<Vec<_>>>()?;
    Ok(Calibration { dialects: vec!["COLMAP"], cameras, points, ..Calibration::default() })
}

/// Plain files of a folder that are not hidden, by name.
fn files_of(folder: &Path) -> Result<Vec<PathBuf>> {
    let all = std::fs::read_dir(folder).map_err(|e| Error::io("the folder cannot be read", e).at(folder.display()))?;
    let hidden = |p: &PathBuf| p.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
    let small = |p: &PathBuf| p.metadata().is_ok_and(|m| m.is_file() && m.len() <= MAX_BYTES);
    let mut files: Vec<PathBuf> = all.filter_map(|e| e.ok().map(|e| e.path())).collect();
    files.retain(|p| !hidden(p) && small(p));
    files.sort();
    if files.len() > MAX_FILES {
        return Err(Error::input(format!("there are {} files in it", files.len()))
            .at(folder.display())
            .remedy("Give the calibration's file, or a folder with nothing else."));
    }
    Ok(files)
}

impl Text {
    fn read(path: &Path) -> Result<Self> {
        let fail = |e| Error::io("cannot be read", e).at(path.display());
        let length = std::fs::metadata(path).map_err(fail)?.len();
        if length > MAX_BYTES {
            return Err(
                Error::input(format!("it is {length} bytes long, which is not a calibration")).at(path.display())
            );
        }
        let bytes = splat4d_train::files::read(path)?;
        let tree = splat4d_train::text::decode(&bytes)
            .map_err(|e| e.remedy("Give the calibration's own file."))
            .and_then(|body| Tree::parse(&body));
        Ok(Self { path: path.to_path_buf(), tree: tree.map_err(|e| e.at(path.display()))? })
    }

    /// The file's name without what many files of one camera are called.
    fn stem(&self) -> String {
        let whole = self.path.file_stem().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
        const WORDS: [&str; 8] =
            ["intrinsics", "intrinsic", "intri", "extrinsics", "extrinsic", "extri", "calibration", "calib"];
        let lower = whole.to_lowercase();
        for word in WORDS {
            for between in ["_", "-", "."] {
                if let Some(rest) = lower.strip_suffix(&format!("{between}{word}"))
                    && !rest.is_empty()
                    && let Some(name) = whole.get(..rest.len())
                {
                    return name.to_owned();
                }
            }
        }
        whole
    }
}

/// Whether two names are one to people.
fn same_name(a: &str, b: &str) -> bool {
    a.to_lowercase() == b.to_lowercase()
}

/// Joins what several files contain about a camera.
fn add(parts: &mut Vec<(Part, PathBuf)>, part: Part, file: &Path) -> Result<()> {
    let name = part.names.first().cloned().unwrap_or_default();
    let Some((known, first)) = parts.iter_mut().find(|(p, _)| same_name(&p.names[0], &name)) else {
        parts.push((part, file.to_path_buf()));
        return Ok(());
    };
    let twice = known.optics.is_some() && part.optics.is_some() || known.pose.is_some() && part.pose.is_some();
    if twice {
        let what = if first == file { String::new() } else { format!(" (also in {})", first.display()) };
        return Err(Error::input(format!("camera {name:.80} is there twice{what}"))
            .at(file.display())
            .remedy("Take one out: videos and cameras are matched by name."));
    }
    known.size = known.size.or(part.size);
    known.optics = known.optics.or(part.optics);
    known.pose = known.pose.or(part.pose);
    Ok(())
}

/// Sides assumed where the size is not given, to check focal lengths.
const ANY_SIDE: usize = 1;

fn whole(part: Part) -> Result<Calibrated> {
    let place = |e: Error| e.at(format!("camera {:.80}", part.names[0]));
    let Some((intrinsics, lens)) = part.optics else {
        return Err(place(
            Error::input("its camera matrix is missing").remedy(
                "Give the file with the lenses too: both files in one folder, and the folder to --calibration.",
            ),
        ));
    };
    if matches!(lens, Lens::Equirectangular { .. }) {
        return Err(place(
            Error::input("its model EQUIRECTANGULAR is not read for videos")
                .remedy("Cut perspective videos out of the panoramas first."),
        ));
    }
    let [width, height] = part.size.unwrap_or([ANY_SIDE; 2]);
    check_intrinsics(&intrinsics, width, height).map_err(place)?;
    let pose = part.pose.map(rigid).transpose().map_err(place)?;
    Ok(Calibrated { names: part.names, size: part.size, intrinsics, lens, pose })
}

/// Either all cameras are placed or none.
fn alike(cameras: &[Calibrated]) -> Result<()> {
    let without: Vec<&str> = cameras.iter().filter(|c| c.pose.is_none()).map(|c| c.names[0].as_str()).collect();
    if without.is_empty() || without.len() == cameras.len() {
        return Ok(());
    }
    Err(Error::input(format!("these cameras have no position, others have one: {}", without.join(", ")))
        .remedy("Give rotation and translation of all cameras, or of none."))
}

impl Calibration {
    /// Whether it states where the cameras stand.
    pub(crate) fn posed(&self) -> bool {
        self.cameras.iter().all(|c| c.pose.is_some())
    }

    /// Its unit of length, a sentence.
    pub(crate) fn about_lengths(&self) -> String {
        /// Cameras farther apart than this are measured in millimetres: rigs of more metres are rare, of fewer
        /// millimetres too.
        const MILLIMETRES: f64 = 200.0;
        let centers: Vec<[f64; 3]> =
            self.cameras.iter().filter_map(|c| c.pose.map(|p| p.inverse().translation)).collect();
        let mut apart: Vec<f64> = Vec::new();
        for (i, a) in centers.iter().enumerate() {
            let others = centers.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, b)| norm(sub(*a, *b)));
            apart.push(others.fold(f64::INFINITY, f64::min));
        }
        apart.retain(|d| d.is_finite());
        apart.sort_by(f64::total_cmp);
        let Some(middle) = apart.get(apart.len() / 2) else { return String::new() };
        match self.unit {
            Unit::Metre => {
                format!("Lengths are metres, as the calibration states: neighbouring cameras are {middle:.2} m apart.")
            }
            Unit::Unstated if *middle > MILLIMETRES => format!(
                "The calibration does not state its unit of length: neighbouring cameras are {middle:.0} apart, which \
                 looks like millimetres (--apart A,B=METRES converts to metres)."
            ),
            Unit::Unstated => format!(
                "The calibration does not state its unit of length: neighbouring cameras are {middle:.3} apart."
            ),
        }
    }
}
