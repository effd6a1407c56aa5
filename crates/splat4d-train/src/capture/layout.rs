//! Finds the layout of a folder: markers in a stated order, warnings about further markers, and remedies where there is
//! none.

use super::account::first_names;
use super::{
    CaptureOptions, READERS, RawCapture, Reader, colmap, foreign, llff, n3dv, nerfies, rig, stray, transforms,
};
use splat4d::{Error, ErrorKind, Result};
use std::path::Path;

/// Markers of COLMAP models; poses of another layout use them for their points.
const MODELS: &[&str] = &[
    colmap::SPARSE,
    colmap::NESTED,
    colmap::MULTIVIEW,
    "cameras.bin",
    "cameras.txt",
    colmap::COLMAP,
    colmap::WORKSPACES[0],
    colmap::WORKSPACES[1],
    colmap::WORKSPACES[2],
    colmap::WORKSPACES[3],
];
/// A model's other files, which represent it as its cameras do.
const MODEL_FILES: [&str; 4] = ["images.bin", "images.txt", "points3D.bin", "points3D.txt"];

/// N3DV's marker, which single-camera LLFF folders have too.
pub(super) const BOUNDS: &str = "poses_bounds.npy";

/// Markers of layouts that this version does not read, and what to do.
const FOREIGN: &[(&str, &str)] = &[
    ("reconstruction.json", "OpenSfM reconstructions"),
    ("sfm_data.json", "OpenMVG reconstructions"),
    ("bundle.out", "Bundler reconstructions"),
];

/// Reads the capture in a folder, or that of a marker file or of a COLMAP model's folder.
pub(super) fn read(path: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    if !path.exists() {
        return Err(Error::input("there is no such file or folder")
            .at(path.display())
            .remedy("Give the folder that holds the capture."));
    }
    if path.is_file() {
        let root = path.parent().unwrap_or(Path::new("."));
        let is = |name: &str| path.file_name().is_some_and(|n| n.eq_ignore_ascii_case(name));
        let known = READERS.iter().find(|(marker, _)| is(marker));
        let Some((_, reader)) = known else {
            if MODEL_FILES.iter().any(|name| is(name)) {
                return colmap::read(root, path, options);
            }
            if stray::is_archive(path) {
                return Err(Error::input("is an archive, not a capture")
                    .at(path.display())
                    .remedy("Unpack it (it is a .zip if it ends in .r3d), and give the folder that it makes."));
            }
            if stray::is_transforms(path) {
                return transforms::read(root, path, options);
            }
            return foreign::read(path, options).unwrap_or_else(|| Err(unknown_layout(root, path)));
        };
        return reader(root, path, options);
    }
    // The folder of models itself (`sparse`), or one of them with numbered folders.
    if MODELS[..3].iter().any(|name| path.ends_with(name)) && colmap::is_model(path) {
        return colmap::read(path, path, options);
    }
    let folder = rig::Folder::new(path);
    let there: Vec<&(&str, Reader)> = READERS.iter().filter(|(marker, _)| is_there(path, &folder, marker)).collect();
    let Some(((marker, reader), others)) = there.split_first() else {
        return foreign::read(path, options).unwrap_or_else(|| Err(unknown_layout(path, path)));
    };
    let mut take = reader(path, &folder.spelled(marker), options)?;
    // Of several models the first is the capture's.
    let models = |m: &&str| MODELS.contains(m) && MODELS.contains(marker);
    let (unread, others): (Vec<&str>, Vec<&str>) = others.iter().map(|(marker, _)| *marker).partition(models);
    remark(&mut take, path, marker, &others);
    remark_models(&mut take, path, marker, &unread);
    Ok(take)
}

/// Reports which of several COLMAP models was read.
fn remark_models(take: &mut RawCapture, path: &Path, marker: &str, unread: &[&str]) {
    // One model as two files.
    let unread: Vec<&&str> =
        unread.iter().filter(|m| !(path.join(m).is_file() && path.join(marker).is_file())).collect();
    if unread.is_empty() && !colmap::WORKSPACES.contains(&marker) {
        return;
    }
    let mut note = format!("The COLMAP model in {marker} is read.");
    if let Some(first) = unread.first() {
        let names: Vec<&str> = unread.iter().map(|m| **m).collect();
        let choose = path.join(first);
        note += &format!(" Not read: {}. To read another, give its path: {}.", names.join(", "), choose.display());
    }
    take.notes.push(note);
}

fn is_there(path: &Path, folder: &rig::Folder, marker: &str) -> bool {
    // A single camera's LLFF folder (LLFF, Mip-NeRF 360) is read from its COLMAP model.
    let llff = || MODELS.iter().any(|model| colmap::is_marker(&path.join(model))) && !n3dv::applies(path);
    // Others call their files so too.
    let foreign = marker == nerfies::MARKER && !nerfies::applies(path);
    let file = folder.spelled(marker);
    file.exists() && !(marker == BOUNDS && llff()) && !foreign && is_model(path, marker, &file)
}

/// Whether a marker is no model's, or that of a model which can be the capture's.
fn is_model(path: &Path, marker: &str, file: &Path) -> bool {
    if !MODELS.contains(&marker) {
        return true;
    }
    if marker != colmap::SPARSE {
        return colmap::is_marker(file);
    }
    // An empty `sparse` is reported as empty, and one without images as having none; but workspaces with images have
    // priority.
    let own_images = |workspace: &&str| {
        let model = path.join(workspace);
        colmap::is_model(&model) && model.parent().is_some_and(|above| above != path && colmap::has_images(above))
    };
    colmap::is_model(file) && colmap::has_images(path) || !colmap::WORKSPACES.iter().any(own_images)
}

/// Whether a file's name is one that a capture's metadata can have.
pub(super) fn is_metadata(path: &Path) -> bool {
    const ENDINGS: [&str; 5] = ["json", "npy", "xml", "csv", "r3d"];
    let ending = path.extension().is_some_and(|e| ENDINGS.iter().any(|v| e.eq_ignore_ascii_case(v)));
    let name = path.file_name().unwrap_or_default();
    let model = READERS.iter().map(|(marker, _)| *marker).chain(MODEL_FILES).any(|n| name.eq_ignore_ascii_case(n));
    ending || model && path.is_file()
}

/// LLFF's poses: of the cameras of a rig with folders of frames, or of the images of one folder.
pub(super) fn read_bounds(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    if n3dv::applies(root) { n3dv::read(root, marker, options) } else { llff::read(root, marker, options) }
}

/// Whether a folder holds a capture of one of these layouts, or another program's export.
pub(super) fn is_capture(folder: &Path) -> bool {
    let names = rig::Folder::new(folder);
    READERS.iter().any(|(marker, _)| is_there(folder, &names, marker)) || foreign::is_there(folder)
}

/// Reports which of several layouts was read, why, and how to choose another.
fn remark(take: &mut RawCapture, path: &Path, marker: &str, others: &[&str]) {
    // Files of one family describe the same images, and a model next to poses was used for its points.
    let family = [transforms::TRAIN, transforms::ALL];
    let (same, foreign): (Vec<&str>, Vec<&str>) = others
        .iter()
        .filter(|other| !(family.contains(&marker) && MODELS.contains(other)))
        .partition(|other| family.contains(&marker) && family.contains(other));
    let list = |names: &[&str]| names.join(", ");
    let choose = |other: &str| format!("To read another, give its path: {}.", path.join(other).display());
    if let Some(other) = same.first() {
        let what = format!("{marker} is read and {other} is not: the former lists the held-out images.");
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
/// Why a folder is not a capture, and what to do about it.
fn unknown_layout(root: &Path, named: &Path) -> Error {
    for (marker, what) in FOREIGN {
        if root.join(marker).exists() {
            return Error::new(ErrorKind::Unsupported, format!("{what} ({marker}) are not read"))
                .at(named.display())
                .remedy("Export the poses as COLMAP or Nerfstudio, or write a capture.json (docs/capture-format.md).");
        }
    }
    let advice = stray::advice(root, named, &is_capture).unwrap_or_else(|| {
        let names: Vec<String> = rig::file_names(root).into_iter().filter(|n| !n.starts_with('.')).collect();
        let holds = match &names[..] {
            _ if named.is_file() => String::new(),
            [] => "It is empty. ".to_owned(),
            _ => format!("It holds {}. ", first_names(&names)),
        };
        format!(
            "{holds}Give the folder with the images and their poses, or write a capture.json (docs/capture-format.md)."
        )
    });
    let what = "is not a capture: it has no capture.json, transforms.json, COLMAP model (sparse/0) or other layout (docs/layouts.md)";
    Error::input(what).at(named.display()).remedy(advice)
}
