//! Which files and folders are cameras.

use crate::video::{Chapter, PICTURE_ENDINGS};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// A camera that was found: its file or folder, or the chapters of its recording in their order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Input {
    /// One, or several chapters.
    pub files: Vec<PathBuf>,
    /// The camera's name, where it is not that of its file.
    pub name: Option<String>,
}

impl From<PathBuf> for Input {
    fn from(path: PathBuf) -> Self {
        Self { files: vec![path], name: None }
    }
}

/// Endings of videos.
const VIDEOS: [&str; 14] =
    ["mp4", "mov", "m4v", "mkv", "avi", "webm", "mts", "m2ts", "ts", "mpg", "mpeg", "mxf", "3gp", "wmv"];

/// The cameras that paths represent: a video is one, or the chapters of a recording; a folder of images is one, and a
/// folder of those is all of them, by name. A folder with folders of videos has a camera in each.
///
/// Errors: a path that is not there, a folder with neither, nothing at all.
pub(crate) fn find(paths: &[PathBuf]) -> Result<Vec<Input>> {
    let mut out: Vec<Input> = Vec::new();
    let mut alone = Vec::new();
    for path in paths {
        if !path.is_dir() {
            alone.push(path.clone());
            continue;
        }
        let inside = entries(path)?;
        let videos: Vec<PathBuf> = inside.iter().filter(|p| p.is_file() && ends(p, &VIDEOS)).cloned().collect();
        if !videos.is_empty() {
            out.extend(recordings(videos));
        } else if inside.iter().any(|p| p.is_file() && ends(p, &PICTURE_ENDINGS)) {
            out.push(path.clone().into());
        } else {
            let mut folders = Vec::new();
            for folder in inside.iter().filter(|p| p.is_dir()) {
                let inside = entries(folder)?;
                let videos: Vec<PathBuf> = inside.iter().filter(|p| p.is_file() && ends(p, &VIDEOS)).cloned().collect();
                match &mut recordings(videos)[..] {
                    [] if inside.iter().any(|p| p.is_file() && ends(p, &PICTURE_ENDINGS)) => {
                        folders.push(folder.clone().into());
                    }
                    [] => {}
                    [one] => {
                        one.name = folder.file_name().map(|n| n.to_string_lossy().into_owned());
                        folders.push(one.clone());
                    }
                    several => {
                        let what = format!("there are {} recordings in a camera's folder", several.len());
                        return Err(Error::input(what)
                            .at(folder.display())
                            .remedy("Keep one in it; chapters of one recording (GX01…, GX02…) are joined."));
                    }
                }
            }
            if folders.is_empty() {
                return Err(Error::input("there is neither a video nor an image in it").at(path.display()).remedy(
                    "Give videos, a folder of them, a folder of images, or a folder with a folder of images for each \
                     camera.",
                ));
            }
            out.extend(folders);
        }
    }
    out.extend(recordings(alone));
    if out.is_empty() {
        return Err(Error::input("there is nothing to import").remedy("Give the videos of one recording."));
    }
    Ok(out)
}

/// Files as cameras, in the order of their first files: chapters of one recording are one, and small copies of chapters
/// that are there are passed over.
fn recordings(files: Vec<PathBuf>) -> Vec<Input> {
    let mut out: Vec<Input> = Vec::new();
    let chapter = |file: &PathBuf| Chapter::of(file).map(|c| (file.parent().map(Path::to_owned), c));
    let known: Vec<(Option<PathBuf>, Chapter)> = files.iter().filter_map(chapter).filter(|c| !c.1.copy).collect();
    let id = |c: &Chapter| c.recording.trim_start_matches(|c: char| c.is_ascii_alphabetic()).to_owned();
    for file in files {
        let Some((folder, own)) = chapter(&file) else {
            out.push(file.into());
            continue;
        };
        let copied = |(f, c): &(Option<PathBuf>, Chapter)| *f == folder && id(c) == id(&own) && c.number == own.number;
        if own.copy && known.iter().any(copied) {
            continue;
        }
        let of = |p: &PathBuf| chapter(p).is_some_and(|(f, c)| f == folder && c.recording == own.recording);
        match out.iter_mut().find(|input| input.files.iter().any(of)) {
            Some(input) => input.files.push(file),
            None => out.push(file.into()),
        }
    }
    for input in out.iter_mut().filter(|i| i.files.len() > 1) {
        input.files.sort_by_key(|f| Chapter::of(f).map(|c| c.number));
    }
    out
}

/// Entries of a folder, by name, without hidden ones.
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

#[cfg(test)]
mod tests {
    use super::*;

    fn found(names: &[&str]) -> Vec<(Vec<String>, Option<String>)> {
        let dir = tempfile::tempdir().unwrap();
        for name in names {
            let path = dir.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, b"x").unwrap();
        }
        let inputs = find(&[dir.path().to_owned()]).unwrap();
        let plain = |p: &PathBuf| p.file_name().unwrap().to_string_lossy().into_owned();
        inputs.iter().map(|i| (i.files.iter().map(plain).collect(), i.name.clone())).collect()
    }

    #[test]
    fn chapters_are_one_camera_and_small_copies_are_passed_over() {
        let flat =
            ["GX020012.MP4", "GX010012.MP4", "GL010012.LRV", "GX010012.THM", "GL020012.MP4", "GX010034.MP4", "a.mov"];
        let own = |files: &[&str]| (files.iter().map(|f| (*f).to_owned()).collect::<Vec<_>>(), None);
        assert_eq!(found(&flat), [own(&["GX010012.MP4", "GX020012.MP4"]), own(&["GX010034.MP4"]), own(&["a.mov"])]);
        let nested = found(&["left/GX010001.MP4", "left/GX020001.MP4", "right/GX010001.MP4"]);
        assert_eq!(nested.iter().map(|n| n.1.as_deref()).collect::<Vec<_>>(), [Some("left"), Some("right")]);
        assert_eq!(nested[0].0.len(), 2);
        let dir = tempfile::tempdir().unwrap();
        for name in ["cam/GX010001.MP4", "cam/GX010002.MP4"] {
            std::fs::create_dir_all(dir.path().join("cam")).unwrap();
            std::fs::write(dir.path().join(name), b"x").unwrap();
        }
        assert!(find(&[dir.path().to_owned()]).unwrap_err().to_string().contains("2 recordings"));
    }
}
