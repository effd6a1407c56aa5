//! Which files and folders are cameras.

use crate::video::PICTURE_ENDINGS;
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Endings of videos.
const VIDEOS: [&str; 14] =
    ["mp4", "mov", "m4v", "mkv", "avi", "webm", "mts", "m2ts", "ts", "mpg", "mpeg", "mxf", "3gp", "wmv"];

/// The cameras that paths stand for: a video is one, a folder of pictures is one, and a folder of those is all of them, by
/// name.
///
/// Errors: a path that is not there, a folder with neither, nothing at all.
pub fn find(paths: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut out = Vec::new();
    for path in paths {
        if !path.is_dir() {
            out.push(path.clone());
            continue;
        }
        let inside = entries(path)?;
        let videos: Vec<PathBuf> = inside.iter().filter(|p| p.is_file() && ends(p, &VIDEOS)).cloned().collect();
        if !videos.is_empty() {
            out.extend(videos);
        } else if inside.iter().any(|p| p.is_file() && ends(p, &PICTURE_ENDINGS)) {
            out.push(path.clone());
        } else {
            let mut folders = Vec::new();
            for folder in inside.iter().filter(|p| p.is_dir()) {
                if entries(folder)?.iter().any(|p| p.is_file() && ends(p, &PICTURE_ENDINGS)) {
                    folders.push(folder.clone());
                }
            }
            if folders.is_empty() {
                return Err(Error::input("there is neither a video nor a picture in it").at(path.display()).remedy(
                    "Give videos, a folder of them, a folder of pictures, or a folder with a folder of pictures for each camera.",
                ));
            }
            out.extend(folders);
        }
    }
    if out.is_empty() {
        return Err(Error::input("there is nothing to import").remedy("Give the videos of a take."));
    }
    Ok(out)
}

/// What is in a folder, by name; nothing hidden.
fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let read = std::fs::read_dir(folder).map_err(|e| Error::io("the folder cannot be read", e).at(folder.display()))?;
    let hidden = |p: &PathBuf| p.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
    let mut all: Vec<PathBuf> = read.filter_map(|e| e.ok().map(|e| e.path())).filter(|p| !hidden(p)).collect();
    all.sort();
    Ok(all)
}

fn ends(path: &Path, with: &[&str]) -> bool {
    path.extension().is_some_and(|e| with.contains(&e.to_string_lossy().to_ascii_lowercase().as_str()))
}
