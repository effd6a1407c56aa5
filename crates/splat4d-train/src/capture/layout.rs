//! Which layout a folder has: markers in a stated order, what lies beside the one that is taken, and what to do where there
//! is none.

use super::{CaptureOptions, Take, colmap, foreign, n3dv, nerfies, own, panoptic, rig, transforms};
use crate::path_text::in_command;
use splat4d::{Error, ErrorKind, Result};
use std::path::Path;

/// A reader: the capture's folder and the marker file that was found, to what the files say.
type Reader = fn(&Path, &Path, &CaptureOptions) -> Result<Take>;

/// Marker files (or folders) in the order in which they are looked for, with their readers.
const READERS: &[(&str, Reader)] = &[
    ("capture.json", own::read),
    (transforms::TRAIN, transforms::read),
    ("train_meta.json", panoptic::read),
    (transforms::ALL, transforms::read),
    (nerfies::MARKER, nerfies::read),
    (BOUNDS, n3dv::read),
    (colmap::SPARSE, colmap::read),
    (colmap::NESTED, colmap::read),
    (colmap::MULTIVIEW, colmap::read),
    ("cameras.bin", colmap::read),
    ("cameras.txt", colmap::read),
];

/// Markers of COLMAP models; poses of another layout use them for their points.
const MODELS: &[&str] = &[colmap::SPARSE, colmap::NESTED, colmap::MULTIVIEW, "cameras.bin", "cameras.txt"];

/// N3DV's marker, which single-camera LLFF folders have too.
const BOUNDS: &str = "poses_bounds.npy";

/// Markers of layouts that this version does not read, and what to do.
const FOREIGN: &[(&str, &str)] =
    &[("reconstruction.json", "OpenSfM reconstructions"), ("sfm_data.json", "OpenMVG reconstructions")];

/// Where the videos of a rig often lie.
const VIDEO_FOLDER: &str = "videos";
const VIDEO_ENDINGS: &[&str] = &["mp4", "mov", "mkv", "avi", "webm"];

/// Reads the capture in a folder, or that of a marker file or of a COLMAP model's folder.
pub(super) fn read(path: &Path, options: &CaptureOptions) -> Result<Take> {
    if !path.exists() {
        return Err(Error::input("there is no such file or folder")
            .at(path.display())
            .remedy("Give the folder that holds the capture."));
    }
    if path.is_file() {
        let root = path.parent().unwrap_or(Path::new("."));
        let known = READERS.iter().find(|(marker, _)| path.file_name().is_some_and(|name| name == *marker));
        let Some((_, reader)) = known else {
            return foreign::read(path, options).unwrap_or_else(|| Err(unknown_layout(root, path)));
        };
        return reader(root, path, options);
    }
    // The folder of models itself (`sparse`), or one of them with numbered folders.
    if MODELS[..3].iter().any(|name| path.ends_with(name)) && colmap::is_model(path) {
        return colmap::read(path, path, options);
    }
    let there: Vec<&(&str, Reader)> = READERS.iter().filter(|(marker, _)| is_there(path, marker)).collect();
    let Some(((marker, reader), others)) = there.split_first() else {
        return foreign::read(path, options).unwrap_or_else(|| Err(unknown_layout(path, path)));
    };
    let mut take = reader(path, &path.join(marker), options)?;
    // Of several models the first is the capture's.
    let models = |m: &&str| MODELS.contains(m) && MODELS.contains(marker);
    let others: Vec<&str> = others.iter().map(|(marker, _)| *marker).filter(|m| !models(m)).collect();
    remark(&mut take, path, marker, &others);
    Ok(take)
}

fn is_there(path: &Path, marker: &str) -> bool {
    // A single camera's LLFF folder (LLFF, Mip-NeRF 360) is read from its COLMAP model.
    let llff = || MODELS.iter().any(|model| path.join(model).exists()) && !n3dv::applies(path);
    // Others call their files so too.
    let foreign = marker == nerfies::MARKER && !nerfies::applies(path);
    let model = !MODELS.contains(&marker) || colmap::is_marker(&path.join(marker));
    path.join(marker).exists() && !(marker == BOUNDS && llff()) && !foreign && model
}

/// Says which of several layouts was read, why, and how to choose another.
fn remark(take: &mut Take, path: &Path, marker: &str, others: &[&str]) {
    // Files of one family tell of the same pictures, and a model beside poses was asked for its points.
    let family = [transforms::TRAIN, transforms::ALL];
    let (same, foreign): (Vec<&str>, Vec<&str>) = others
        .iter()
        .filter(|other| !(family.contains(&marker) && MODELS.contains(other)))
        .partition(|other| family.contains(&marker) && family.contains(other));
    let list = |names: &[&str]| names.join(", ");
    let choose = |other: &str| format!("To read another, give its path: {}.", path.join(other).display());
    if let Some(other) = same.first() {
        let what = format!("{marker} is read and {other} is not: the former says which pictures are held out.");
        take.notes.push(format!("{what} {}", choose(other)));
    }
    if let Some(other) = foreign.first() {
        let order: Vec<&str> = READERS.iter().map(|(marker, _)| *marker).collect();
        take.warnings.push(format!(
            "The folder has several layouts: {marker} is read and {} not, because it comes first in the order {}. {}",
            list(&foreign),
            list(&order),
            choose(other)
        ));
    }
}
/// Why a folder is no capture, and what to do about it.
fn unknown_layout(root: &Path, named: &Path) -> Error {
    for (marker, what) in FOREIGN {
        if root.join(marker).exists() {
            return Error::new(ErrorKind::Unsupported, format!("{what} ({marker}) are not read"))
                .at(named.display())
                .remedy("Export the poses as COLMAP or Nerfstudio, or write a capture.json (docs/capture-format.md).");
        }
    }
    let markers: Vec<&str> = READERS.iter().map(|(marker, _)| *marker).collect();
    let mut error =
        Error::input(format!("is not a capture: none of {} is there", markers.join(", "))).at(named.display());
    let below = videos(&root.join(VIDEO_FOLDER)).into_iter().map(|name| format!("{VIDEO_FOLDER}/{name}"));
    if let Some(video) = videos(root).into_iter().chain(below).next() {
        error = error.remedy(format!(
            "It holds videos, but no camera poses that are known here. Make a capture of them with `splat4d import {} -o TAKE`, \
             which finds clocks and poses, or reads a calibration that you have (docs/filming.md); or extract frames with `{}` \
             and write a capture.json (docs/capture-format.md).",
            in_command(named),
            ffmpeg_command(&video)
        ));
    } else if holds_images(root) {
        error = error.remedy(format!(
            "It holds images without camera poses. Make a capture of them with `splat4d import {} -o TAKE`.",
            in_command(named)
        ));
    }
    error.remedy(
        "Write a capture.json with your cameras (docs/capture-format.md), or give the folder of a known layout.",
    )
}

/// Whether image files lie in a folder, or in one directly below it.
fn holds_images(folder: &Path) -> bool {
    let below = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).filter(|p| p.is_dir());
    std::iter::once(folder.to_owned()).chain(below).any(|f| !rig::image_names(&f).is_empty())
}

/// Names of the video files in a folder, sorted.
pub(super) fn videos(folder: &Path) -> Vec<String> {
    let mut found: Vec<String> = rig::file_names(folder)
        .into_iter()
        .filter(|n| Path::new(n).extension().is_some_and(|e| VIDEO_ENDINGS.iter().any(|v| e.eq_ignore_ascii_case(v))))
        .collect();
    found.sort();
    found
}

/// The command that turns one video into a folder of frames named as the readers expect.
pub(super) fn ffmpeg_command(video: &str) -> String {
    let stem = Path::new(video).file_stem().and_then(|s| s.to_str()).unwrap_or("cam00");
    let folder = in_command(&Path::new("images").join(stem));
    let frames = in_command(&Path::new("images").join(stem).join("%06d.jpg"));
    let video = in_command(Path::new(video));
    format!("mkdir -p {folder} && ffmpeg -i {video} -start_number 0 -qscale:v 2 {frames}")
}
