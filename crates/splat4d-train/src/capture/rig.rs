//! Names and files: which images are in a folder, and what an image's name states about camera and frame number.

use std::cell::OnceCell;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Endings of images that can be decoded.
pub(super) const IMAGE_ENDINGS: &[&str] = &["png", "jpg", "jpeg", "webp"];

/// Prefix of the files that macOS adds on foreign disks.
const APPLE_DOUBLE: &str = "._";

/// Sorted names of the files and folders directly in `folder`; empty where it cannot be read.
pub(super) fn file_names(folder: &Path) -> Vec<String> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let names = entries.flatten().filter_map(|e| e.file_name().into_string().ok());
    let mut names: Vec<String> = names.filter(|n| !n.starts_with(APPLE_DOUBLE)).collect();
    names.sort();
    names
}

/// A folder whose names are listed once, when the first name is requested that has no exact match.
pub(super) struct Folder<'a> {
    path: &'a Path,
    names: OnceCell<Vec<String>>,
}

impl<'a> Folder<'a> {
    pub(super) fn new(path: &'a Path) -> Self {
        Self { path, names: OnceCell::new() }
    }

    /// A file or folder below this one, whichever letter case its names have; where it should be if it is missing. Of
    /// several spellings the exact one has priority, and none is taken if two others fit.
    pub(super) fn spelled(&self, name: &str) -> PathBuf {
        let exact = self.path.join(name);
        if exact.exists() {
            return exact;
        }
        let (part, below) = name.split_once('/').map_or((name, None), |(part, below)| (part, Some(below)));
        let names = self.names.get_or_init(|| file_names(self.path));
        let mut fitting = names.iter().filter(|n| n.eq_ignore_ascii_case(part));
        let (Some(only), None) = (fitting.next(), fitting.next()) else { return exact };
        let found = self.path.join(only);
        let Some(below) = below else { return found };
        let inner = spelled(&found, below);
        if inner.exists() { inner } else { exact }
    }
}

/// [`Folder::spelled`] of one name.
pub(super) fn spelled(folder: &Path, name: &str) -> PathBuf {
    Folder::new(folder).spelled(name)
}

/// Whether a folder has one of these files, whichever letter case its name has.
pub(super) fn has_any(folder: &Path, names: &[&str]) -> bool {
    let folder = Folder::new(folder);
    names.iter().any(|name| folder.spelled(name).is_file())
}

/// Whether a name ends like an image.
pub(super) fn is_image(name: &str) -> bool {
    let ending = Path::new(name).extension();
    !name.starts_with('.') && ending.is_some_and(|e| IMAGE_ENDINGS.iter().any(|v| e.eq_ignore_ascii_case(v)))
}

/// Sorted names of the images directly in `folder`.
pub(super) fn image_names(folder: &Path) -> Vec<String> {
    file_names(folder).into_iter().filter(|n| is_image(n)).collect()
}

/// The number at the end of a name without its ending: `frame_00012.png` → 12.
pub(super) fn trailing_number(name: &str) -> Option<usize> {
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    let digits = stem.len() - stem.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    stem[stem.len() - digits..].parse().ok()
}

/// The cameras and frames that the names of all images give together.
pub(super) struct Naming {
    /// Camera names, sorted.
    pub cameras: Vec<String>,
    /// For each image its camera and its frame number, counted from the smallest.
    pub frames: Vec<(usize, usize)>,
    /// Whether the names separate cameras (`cam/frame`, `cam_frameN`), or all belong to one.
    pub stated: bool,
    /// The place of each image among those of its camera, where no camera's numbers reach into those of another.
    pub ranks: Option<Vec<usize>>,
}

/// Widest range of numbers that are frame numbers, not time stamps: nine hours at 30 frames per second.
pub(super) const MAX_SPAN: usize = 1_000_000;
/// Folders that hold images but name no camera.
const PLAIN_FOLDERS: &[&str] = &["images", "image", "frames", "rgb", "input", "train", "test", "val", "."];

/// Whether a folder holds images but names no camera.
pub(super) fn is_plain(folder: &str) -> bool {
    // ns-process-data writes reduced copies to images_2, images_4, images_8.
    let reduced = folder.strip_prefix("images_").is_some_and(|n| n.parse::<usize>().is_ok());
    reduced || folder.is_empty() || PLAIN_FOLDERS.contains(&folder)
}

/// The camera in `cam/frame.png`, `cam/images/frame.png` or `cam_frame12.png`.
fn camera_of(name: &str) -> Option<&str> {
    let (folders, file) = name.rsplit_once('/').unwrap_or(("", name));
    if let Some(folder) = folders.rsplit('/').find(|folder| !is_plain(folder)) {
        return Some(folder);
    }
    let stem = file.rsplit_once('.').map_or(file, |(stem, _)| stem);
    let (camera, number) = stem.rsplit_once("_frame").or_else(|| stem.rsplit_once("-frame"))?;
    let number = number.trim_start_matches(['_', '-']);
    (!camera.is_empty() && !number.is_empty() && number.bytes().all(|b| b.is_ascii_digit())).then_some(camera)
}

/// Finds cameras and frame numbers in image names. Where names carry no usable numbers, their order counts.
pub(super) fn naming(names: &[&str]) -> Naming {
    let stated = !names.is_empty() && names.iter().all(|n| camera_of(n).is_some());
    let camera = |n: &str| if stated { camera_of(n).unwrap_or_default().to_string() } else { "moving".to_string() };
    let mut groups: BTreeMap<String, Vec<usize>> = BTreeMap::new();
    for (i, name) in names.iter().enumerate() {
        groups.entry(camera(name)).or_default().push(i);
    }
    let numbers: Vec<Option<usize>> = names.iter().map(|n| trailing_number(n)).collect();
    let first = numbers.iter().flatten().min().copied().unwrap_or(0);
    let last = numbers.iter().flatten().max().copied().unwrap_or(0);
    let distinct = last - first <= MAX_SPAN
        && groups.values().all(|members| {
            let found: BTreeSet<usize> = members.iter().filter_map(|&i| numbers[i]).collect();
            found.len() == members.len()
        });
    let range = |members: &Vec<usize>| {
        let numbers = || members.iter().filter_map(|&i| numbers[i]);
        Some((numbers().min()?, numbers().max()?))
    };
    let mut ranges: Vec<(usize, usize)> = groups.values().filter_map(range).collect();
    ranges.sort_unstable();
    let apart = distinct && groups.len() > 1 && ranges.windows(2).all(|w| w[0].1 < w[1].0);
    let mut ranks = vec![0; names.len()];
    let mut frames = vec![(0, 0); names.len()];
    for (c, members) in groups.values().enumerate() {
        let mut ordered = members.clone();
        ordered.sort_by_key(|&i| names[i]);
        for (rank, i) in ordered.into_iter().enumerate() {
            ranks[i] = rank;
            frames[i] = (c, numbers[i].filter(|_| distinct).map_or(rank, |n| n - first));
        }
    }
    Naming { cameras: groups.into_keys().collect(), frames, stated, ranks: apart.then_some(ranks) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_give_cameras_and_frames() {
        let n = naming(&["cam02/0007.png", "images/cam01/0005.jpg", "cam01/images/0006.png"]);
        assert_eq!((n.cameras.as_slice(), n.stated), (&["cam01".to_string(), "cam02".into()][..], true));
        assert_eq!(n.frames, [(1, 2), (0, 0), (0, 1)]);
        let n = naming(&["cam01_frame000003.jpg", "cam02_frame_000004.jpg"]);
        assert_eq!(
            (n.cameras.as_slice(), n.frames),
            (&["cam01".to_string(), "cam02".into()][..], vec![(0, 0), (1, 1)])
        );
        let n = naming(&["images/IMG_12.jpg", "images/IMG_10.jpg"]);
        assert_eq!((n.cameras.len(), n.stated, n.frames), (1, false, vec![(0, 2), (0, 0)]));
        let n = naming(&["b.png", "a.png"]);
        assert_eq!(n.frames, [(0, 1), (0, 0)]);
        let n = naming(&["1700000000500.png", "1700009000000.png"]);
        assert_eq!(n.frames, [(0, 0), (0, 1)], "time stamps count by their order");
    }
}
