//! Numbered files, one a frame: finding them, naming them, and the moments they stand for.

use crate::files::{cannot_read, either};
use splat4d::format::dialect;
use splat4d::layers::Scene;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

/// Most files of a sequence.
const MAX_FILES: f64 = 100_000.0;
/// Most digits of a padded number in a pattern.
const MAX_DIGITS: usize = 9;
/// The name of a frame in a folder, without a pattern.
const DEFAULT_NAME: &str = "frame_%05d.ply";
/// The folder of results in an output folder of 3DGS and of what grew out of it.
const RESULTS: &str = "point_cloud";
/// A folder there: `iteration_30000`.
const ITERATION: &str = "iteration_";
/// The Gaussians of an iteration.
const GAUSSIANS: &str = "point_cloud.ply";

/// A file name with a place for a number: `frame_%05d.ply`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Pattern {
    folder: PathBuf,
    before: String,
    digits: usize,
    after: String,
}

impl Pattern {
    /// The pattern in a path, `None` where there is no `%d` or `%05d` in its file name.
    pub(crate) fn of(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_str()?;
        let (before, rest) = name.split_once('%')?;
        let (digits, after) = rest.split_once('d')?;
        let digits = if digits.is_empty() { 0 } else { digits.strip_prefix('0')?.parse().ok()? };
        let folder = path.parent().unwrap_or(Path::new("")).to_owned();
        (digits <= MAX_DIGITS).then(|| Self { folder, before: before.into(), digits, after: after.into() })
    }

    /// Frames of a folder that gave no pattern.
    pub(crate) fn in_folder(folder: &Path) -> Self {
        Self::of(&folder.join(DEFAULT_NAME)).expect("the default name is a pattern")
    }

    /// The folder of all files.
    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }

    /// The file of a frame.
    pub(crate) fn file(&self, frame: usize) -> PathBuf {
        self.folder.join(format!("{}{frame:0width$}{}", self.before, self.after, width = self.digits))
    }

    fn number(&self, name: &str) -> Option<u64> {
        let digits = name.strip_prefix(&self.before)?.strip_suffix(&self.after)?;
        (digits.bytes().all(|b| b.is_ascii_digit()) && digits.len() >= self.digits).then(|| digits.parse().ok())?
    }
}

/// The frames that a folder or a pattern stands for, in the order of their numbers.
///
/// Errors: none are there, or a folder holds several kinds.
pub(crate) fn frames(path: &Path) -> Result<Vec<PathBuf>> {
    let pattern = Pattern::of(path);
    let folder = match &pattern {
        Some(p) if p.folder().as_os_str().is_empty() => Path::new("."),
        Some(p) => p.folder(),
        None => path,
    };
    let mut found: Vec<(u64, String)> = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| cannot_read(folder, e))? {
        let name = entry.map_err(|e| cannot_read(folder, e))?.file_name();
        let Some(name) = name.to_str() else { continue };
        let number = pattern.as_ref().map_or_else(|| number_in(name), |p| p.number(name));
        found.extend(number.map(|n| (n, name.to_owned())));
    }
    if found.is_empty() && pattern.is_none() {
        found = folders(folder);
    }
    found.sort();
    let ending = |name: &str| Path::new(name).extension().map(|e| e.to_ascii_lowercase());
    if let Some((_, other)) = found.iter().find(|(_, name)| ending(name) != ending(&found[0].1)) {
        return Err(Error::input(format!("holds frames of several kinds, such as {} and {other}", found[0].1))
            .at(path.display())
            .remedy("Give a pattern, for instance 'FOLDER/frame_%05d.ply'."));
    }
    if found.is_empty() {
        let kinds = either(&endings());
        return Err(Error::input(format!("holds neither a run, nor a SOG scene, nor numbered {kinds} files"))
            .at(path.display())
            .remedy("Give a run folder, a scene file, or a folder with frame_00000.ply and so on."));
    }
    Ok(found.into_iter().map(|(_, name)| folder.join(name)).collect())
}

/// Numbered folders with a frame in each, as `000/point_cloud.ply`.
fn folders(folder: &Path) -> Vec<(u64, String)> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let frame = |entry: std::fs::DirEntry| {
        let name = entry.file_name().into_string().ok()?;
        let number = name[name.trim_end_matches(|c: char| c.is_ascii_digit()).len()..].parse().ok()?;
        let file = only_scene(&entry.path(), &endings())?;
        Some((number, file.strip_prefix(folder).ok()?.to_str()?.to_owned()))
    };
    entries.flatten().filter_map(frame).collect()
}

/// The file of the newest iteration below an output folder, its folder of results, or one iteration.
pub(crate) fn newest(folder: &Path) -> Option<(PathBuf, Option<u64>)> {
    let iterations = |results: &Path| {
        let entries = std::fs::read_dir(results).ok()?;
        let number = |name: &str| name.strip_prefix(ITERATION)?.parse::<u64>().ok();
        let found = entries.flatten().filter_map(|e| {
            let (number, file) = (number(e.file_name().to_str()?)?, e.path().join(GAUSSIANS));
            file.is_file().then_some((file, Some(number)))
        });
        found.max_by_key(|(_, number)| *number)
    };
    let alone = folder.join(GAUSSIANS);
    iterations(&folder.join(RESULTS))
        .or_else(|| iterations(folder))
        .or_else(|| alone.is_file().then_some((alone, None)))
}

/// The scene file that stands for a folder in a sequence of folders: a result of 3DGS, or the only scene file in it.
fn only_scene(folder: &Path, endings: &[&str]) -> Option<PathBuf> {
    if let Some((file, _)) = newest(folder) {
        return Some(file);
    }
    let fits = |path: &PathBuf| {
        let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
        !name.starts_with('.') && endings.iter().any(|e| name.to_ascii_lowercase().ends_with(e)) && path.is_file()
    };
    let mut found = std::fs::read_dir(folder).ok()?.flatten().map(|e| e.path()).filter(fits);
    found.next().filter(|_| found.next().is_none())
}

/// Endings of files that may be frames: those of one moment, of the kinds that `--frames` writes.
pub(crate) fn endings() -> Vec<&'static str> {
    dialect::extensions(|d| !d.moves && d.is_written())
}

/// The last number in the name of a file that may be a frame.
fn number_in(name: &str) -> Option<u64> {
    let (stem, ending) = name.split_at(name.rfind('.')?);
    if name.starts_with('.') || !endings().iter().any(|e| ending.eq_ignore_ascii_case(e)) {
        return None;
    }
    // `frame_12.compressed.ply` is a frame too.
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = stem[..end].rfind(|c: char| !c.is_ascii_digit()).map_or(0, |i| i + 1);
    stem.get(start..end)?.parse().ok()
}

/// The moments, in seconds, of a sequence of a scene: `fps` a second from `from` to `to`.
///
/// Errors: there are none, or too many.
pub fn moments(scene: &Scene<f32>, fps: Option<f64>, range: [Option<f64>; 2]) -> Result<(f64, Vec<f64>)> {
    let fps = fps.unwrap_or(if scene.fps > 0.0 { scene.fps } else { DEFAULT_FPS });
    let [from, to] = [range[0].unwrap_or(scene.clip[0]), range[1].unwrap_or(scene.clip[1])];
    let count = ((to - from) * fps + 1e-6).floor() + 1.0;
    if !(1.0..=MAX_FILES).contains(&count) {
        return Err(Error::input(format!("from {from} s to {to} s at {fps} a second are {count} files")).remedy(
            format!(
                "The scene lasts from {} to {} s; at most {MAX_FILES} files are written.",
                scene.clip[0], scene.clip[1]
            ),
        ));
    }
    Ok((fps, (0..count as usize).map(|i| from + i as f64 / fps).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_name_files_and_know_them_again() {
        let p = Pattern::of(Path::new("out/f_%04d.spz")).unwrap();
        assert_eq!(p.file(7), Path::new("out/f_0007.spz"));
        assert_eq!((p.number("f_0007.spz"), p.number("f_7.spz"), p.number("g_0007.spz")), (Some(7), None, None));
        assert_eq!(Pattern::of(Path::new("%d.ply")).unwrap().file(12), Path::new("12.ply"));
        assert_eq!(Pattern::in_folder(Path::new("x")).file(3), Path::new("x/frame_00003.ply"));
        for no in ["a.ply", "100%.ply", "%s.ply", "%5d.ply", "%099d.ply"] {
            assert_eq!(Pattern::of(Path::new(no)), None, "{no}");
        }
    }

    #[test]
    fn frames_come_in_the_order_of_their_numbers() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["f10.ply", "f9.ply", "f100.compressed.ply", "notes.txt", "cover.ply", ".9.ply"] {
            std::fs::write(folder.path().join(name), b"").unwrap();
        }
        let names = |path: &Path| -> Vec<String> {
            let files = frames(path).unwrap();
            files.iter().map(|f| f.file_name().unwrap().to_string_lossy().into_owned()).collect()
        };
        assert_eq!(names(folder.path()), ["f9.ply", "f10.ply", "f100.compressed.ply"]);
        assert_eq!(names(&folder.path().join("f%d.ply")), ["f9.ply", "f10.ply"]);
        std::fs::write(folder.path().join("f3.spz"), b"").unwrap();
        assert!(frames(folder.path()).unwrap_err().to_string().contains("several kinds"));
        let empty = tempfile::tempdir().unwrap();
        assert!(frames(empty.path()).unwrap_err().to_string().contains("numbered"));
    }
}
