//! Numbered files, one per frame: finding them, naming them, and the times they represent.

use crate::files::{cannot_read, either};
use crate::run_folder::Run;
use splat4d::format::dialect;
use splat4d::layers::Scene;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::{Error, Result};
use splat4d_train::output::{Input, Mixes, OutputFolder, Request, check_file};
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

/// Most files of a sequence.
const MAX_FILES: f64 = 100_000.0;
/// Most digits of a padded number in a pattern.
const MAX_DIGITS: usize = 9;
/// Programs save their Gaussians every n steps (or a multiple of it; some count from 0): Brush every 5,000, 3DGS after
/// 7,000 and 30,000, OpenSplat and gsplat as documented. No film has so few of its frames.
const SNAPSHOTS: u64 = 500;
/// Gaps of a sequence that are named.
const NAMED_GAPS: usize = 8;
/// The name of a frame in a folder, without a pattern.
const DEFAULT_NAME: &str = "frame_%05d.ply";
/// The folder of results in an output folder of 3DGS and of what grew out of it.
const RESULTS: &str = "point_cloud";
/// A folder there: `iteration_30000`.
const ITERATION: &str = "iteration_";
/// The Gaussians of an iteration.
const GAUSSIANS: &str = "point_cloud.ply";

/// A file name with a place for a number: `frame_%05d.ply`. Names need not be UTF-8.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pattern {
    folder: PathBuf,
    before: OsString,
    digits: usize,
    after: OsString,
    /// Whether the user gave no pattern: then a folder is read as a whole.
    whole: bool,
}

impl Pattern {
    /// The pattern in a path, `None` where there is no `%d` or `%05d` in its file name.
    pub fn of(path: &Path) -> Option<Self> {
        let name = path.file_name()?;
        let bytes = name.as_encoded_bytes();
        let percent = bytes.iter().position(|b| *b == b'%')?;
        let d = percent + bytes[percent..].iter().position(|b| *b == b'd')?;
        let digits = std::str::from_utf8(&bytes[percent + 1..d]).ok()?;
        let digits = if digits.is_empty() { 0 } else { digits.strip_prefix('0')?.parse().ok()? };
        let (before, after) = (part(name, 0, percent)?, part(name, d + 1, bytes.len())?);
        let folder = path.parent().unwrap_or(Path::new("")).to_owned();
        (digits <= MAX_DIGITS).then_some(Self { folder, before, digits, after, whole: false })
    }

    /// Frames of a folder that gave no pattern.
    pub fn in_folder(folder: &Path) -> Self {
        Self::in_folder_as(folder, DEFAULT_NAME)
    }

    /// The same with other names. Panics: `name` is no pattern.
    pub fn in_folder_as(folder: &Path, name: &str) -> Self {
        let pattern = Self::of(&folder.join(name)).expect("the name is a pattern");
        Self { whole: true, ..pattern }
    }

    /// Numbered files with this ending, as renders are.
    pub fn plain(folder: &Path, ending: &str) -> Self {
        Self::of(&folder.join(format!("%05d.{ending}"))).expect("it is a pattern")
    }

    /// The folder of all files.
    pub fn folder(&self) -> &Path {
        if self.folder.as_os_str().is_empty() { Path::new(".") } else { &self.folder }
    }

    /// The file of a frame.
    pub fn file(&self, frame: usize) -> PathBuf {
        self.folder.join(self.name(frame))
    }

    fn name(&self, frame: usize) -> OsString {
        let mut name = self.before.clone();
        name.push(format!("{frame:0width$}", width = self.digits));
        name.push(&self.after);
        name
    }

    fn number(&self, name: &OsStr) -> Option<u64> {
        let bytes = name.as_encoded_bytes().strip_prefix(self.before.as_encoded_bytes())?;
        let digits = bytes.strip_suffix(self.after.as_encoded_bytes())?;
        let numeric = digits.iter().all(u8::is_ascii_digit) && digits.len() >= self.digits;
        numeric.then(|| std::str::from_utf8(digits).ok()?.parse().ok())?
    }

    /// Whether a file of this name would be taken for a frame.
    pub fn takes(&self, name: &OsStr) -> bool {
        self.number(name).is_some() || self.whole && number_in(name).is_some()
    }

    /// Whether it is one of the first `count` frames.
    pub fn writes(&self, name: &OsStr, count: usize) -> bool {
        self.number(name).is_some_and(|n| n < count as u64 && self.name(n as usize) == name)
    }
}

/// Bytes `from..to` of a name, where these are characters of ours or the name's ends. `None`: the system has no such
/// part.
fn part(name: &OsStr, from: usize, to: usize) -> Option<OsString> {
    #[cfg(unix)]
    {
        use std::os::unix::ffi::OsStrExt;
        Some(OsStr::from_bytes(&name.as_bytes()[from..to]).to_owned())
    }
    #[cfg(not(unix))]
    Some(name.to_str()?.get(from..to)?.into())
}

/// Inputs of a command that writes frames: none of it may be the folder of the frames. Renders may be in their run.
pub struct Read<'a> {
    /// The scene.
    pub path: &'a Path,
    /// Its run.
    pub run: Option<&'a Run>,
}

/// Takes a folder for the first `count` frames of these patterns.
///
/// Errors: another process owns it; it is an input; it holds frames of another sequence, or such as splat4d has no
/// record of.
pub fn take(patterns: &[&Pattern], count: usize, read: &Read<'_>, command: &str, force: bool) -> Result<OutputFolder> {
    let origin = read.run.map(Run::origin).unwrap_or_default();
    let mut inputs: Vec<Input<'_>> = origin.inputs().collect();
    let sources = Pattern::of(read.path).filter(|_| !read.path.exists());
    if let Some(sources) = &sources {
        inputs.push(Input { may_hold: true, ..Input::new(sources.folder(), "the folder of what is read,") });
    }
    if read.path.is_dir() {
        inputs.push(Input { may_hold: read.run.is_some(), ..Input::new(read.path, "what is read,") });
    } else {
        let own = [Input::new(read.path, "what is read,")];
        let mut frames = patterns.iter().flat_map(|p| (0..count).map(|i| p.file(i)));
        frames.try_for_each(|frame| check_file(&frame, &own))?;
    }
    let is = |name: &OsStr| patterns.iter().any(|p| p.takes(name));
    let written = |name: &OsStr| patterns.iter().any(|p| p.writes(name, count));
    let mixes = Mixes::Frames { is: &is, written: &written };
    let request = Request { command, inputs: &inputs, asked: "", force, mixes };
    OutputFolder::begin(patterns[0].folder(), &request).map(|(folder, _)| folder)
}

/// The frames that a folder or a pattern represents, by their numbers.
#[derive(Debug)]
pub struct Frames {
    /// In the order of their numbers.
    pub files: Vec<PathBuf>,
    /// Frames from the first to each, by the numbers.
    pub numbers: Vec<u64>,
    /// Numbers that are missing between them, as text.
    pub missing: Option<String>,
    /// The newest file, if the numbers are probably training steps.
    pub snapshots: Option<PathBuf>,
}

/// The frames that a folder or a pattern represents, in the order of their numbers.
///
/// Errors: none are there, two have one number, or a folder holds several kinds.
pub fn frames(path: &Path) -> Result<Frames> {
    let pattern = Pattern::of(path);
    let folder = pattern.as_ref().map_or(path, Pattern::folder);
    let mut found: Vec<(u64, OsString)> = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| cannot_read(folder, e))? {
        let name = entry.map_err(|e| cannot_read(folder, e))?.file_name();
        let number = pattern.as_ref().map_or_else(|| number_in(&name), |p| p.number(&name));
        found.extend(number.map(|n| (n, name)));
    }
    if found.is_empty() && pattern.is_none() {
        found = folders(folder);
    }
    found.sort();
    let ending = |name: &OsStr| Path::new(name).extension().map(OsStr::to_ascii_lowercase);
    if let Some((_, other)) = found.iter().find(|(_, name)| ending(name) != ending(&found[0].1)) {
        let (one, other) = (found[0].1.display(), other.display());
        return Err(Error::input(format!("contains frames of several formats, such as {one} and {other}"))
            .at(path.display())
            .remedy("Give a pattern, for instance 'FOLDER/frame_%05d.ply'."));
    }
    if found.is_empty() {
        let kinds = either(&endings());
        return Err(Error::input(format!("contains neither a run, nor a SOG scene, nor numbered {kinds} files"))
            .at(path.display())
            .remedy("Give a run folder, a scene file, or a folder with frame_00000.ply and so on."));
    }
    if let Some(twice) = found.windows(2).find(|w| w[0].0 == w[1].0) {
        let (number, one, other) = (twice[0].0, twice[0].1.display(), twice[1].1.display());
        return Err(Error::input(format!("contains two files with the number {number}: {one} and {other}"))
            .at(path.display())
            .remedy("Move one of them away, or give a pattern, for instance 'FOLDER/frame_%05d.ply'."));
    }
    let first = found[0].0;
    let last = found[found.len() - 1].0;
    // Numbers with this many of them missing are no frames of one sequence.
    let steps = || found.windows(2).map(|w| w[1].0 - w[0].0);
    // Every tenth frame is a sequence without gaps.
    let step = steps().fold(0, gcd).max(1);
    let span = (last - first) / step;
    if span as f64 >= MAX_FILES {
        return Err(Error::input(format!("frames are numbered from {first} to {last}"))
            .at(path.display())
            .remedy(format!("At most {MAX_FILES} frames are one sequence: move the others away.")));
    }
    let gap = |w: &[(u64, OsString)]| (w[1].0 > w[0].0 + step).then(|| (w[0].0 + step, w[1].0 - step));
    let gaps: Vec<(u64, u64)> = found.windows(2).filter_map(gap).collect();
    let numbers = found.iter().map(|(n, _)| (n - first) / step).collect();
    let all = |rest: u64| found.iter().all(|(n, _)| n % SNAPSHOTS == rest);
    let are_steps = found.len() > 1 && (all(0) || all(SNAPSHOTS - 1));
    let files: Vec<PathBuf> = found.into_iter().map(|(_, name)| folder.join(name)).collect();
    let snapshots = files.last().filter(|_| are_steps).cloned();
    Ok(Frames { files, numbers, missing: (!gaps.is_empty()).then(|| in_words(&gaps)), snapshots })
}

/// Greatest common divisor (Euclid).
fn gcd(a: u64, b: u64) -> u64 {
    if b == 0 { a } else { gcd(b, a % b) }
}

/// `3, 7 to 9 and 4 more gaps`
fn in_words(gaps: &[(u64, u64)]) -> String {
    let one = |&(from, to): &(u64, u64)| if from == to { from.to_string() } else { format!("{from} to {to}") };
    let mut words: Vec<String> = gaps.iter().take(NAMED_GAPS).map(one).collect();
    if gaps.len() > NAMED_GAPS {
        words.push(format!("and {} more gaps", gaps.len() - NAMED_GAPS));
    }
    words.join(", ")
}

/// Numbered folders with a frame in each, as `000/point_cloud.ply`.
fn folders(folder: &Path) -> Vec<(u64, OsString)> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let frame = |entry: std::fs::DirEntry| {
        let name = entry.file_name().into_string().ok()?;
        let number = name[name.trim_end_matches(|c: char| c.is_ascii_digit()).len()..].parse().ok()?;
        let file = only_scene(&entry.path(), &endings())?;
        Some((number, file.strip_prefix(folder).ok()?.as_os_str().to_owned()))
    };
    entries.flatten().filter_map(frame).collect()
}

/// The file of the newest iteration below an output folder, its folder of results, or one iteration.
pub fn newest(folder: &Path) -> Option<(PathBuf, Option<u64>)> {
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

/// The scene file that represents a folder in a sequence of folders: a result of 3DGS, or the only scene file in it.
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

/// Endings of files that may be frames: those of one time, of the kinds that `--frames` writes.
pub fn endings() -> Vec<&'static str> {
    dialect::extensions(|d| !d.moves && d.is_written())
}

/// The last number in the name of a file that may be a frame.
fn number_in(name: &OsStr) -> Option<u64> {
    // Digits and the ending are ASCII: the rest does not matter.
    let name = name.to_string_lossy();
    let (stem, ending) = name.split_at(name.rfind('.')?);
    if name.starts_with('.') || !endings().iter().any(|e| ending.eq_ignore_ascii_case(e)) {
        return None;
    }
    // `frame_12.compressed.ply` is a frame too.
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = stem[..end].rfind(|c: char| !c.is_ascii_digit()).map_or(0, |i| i + 1);
    stem.get(start..end)?.parse().ok()
}

/// The times, in seconds, of a sequence of a scene: `fps` a second from `from` to `to`.
///
/// Errors: there are none, or too many.
pub fn timestamps(scene: &Scene<f32>, fps: Option<f64>, range: [Option<f64>; 2]) -> Result<(f64, Vec<f64>)> {
    let fps = fps.unwrap_or(if scene.fps > 0.0 { scene.fps } else { DEFAULT_FPS });
    let [from, to] = [range[0].unwrap_or(scene.clip[0]), range[1].unwrap_or(scene.clip[1])];
    let count = ((to - from) * fps + 1e-6).floor() + 1.0;
    if !(1.0..=MAX_FILES).contains(&count) {
        return Err(Error::input(format!("from {from} s to {to} s at {fps} frames per second are {count} files"))
            .remedy(format!(
                "The scene lasts from {} to {} s; at most {MAX_FILES} files are written.",
                scene.clip[0], scene.clip[1]
            )));
    }
    Ok((fps, (0..count as usize).map(|i| from + i as f64 / fps).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_patterns_format_and_parse_names() {
        let os = OsStr::new;
        let p = Pattern::of(Path::new("out/f_%04d.spz")).unwrap();
        assert_eq!(p.file(7), Path::new("out/f_0007.spz"));
        assert_eq!(
            (p.number(os("f_0007.spz")), p.number(os("f_7.spz")), p.number(os("g_0007.spz"))),
            (Some(7), None, None)
        );
        assert_eq!(Pattern::of(Path::new("%d.ply")).unwrap().file(12), Path::new("12.ply"));
        assert_eq!(Pattern::in_folder(Path::new("x")).file(3), Path::new("x/frame_00003.ply"));
        for no in ["a.ply", "100%.ply", "%s.ply", "%5d.ply", "%099d.ply"] {
            assert_eq!(Pattern::of(Path::new(no)), None, "{no}");
        }
    }

    #[test]
    fn frames_are_ordered_by_number() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["f10.ply", "f9.ply", "f100.compressed.ply", "notes.txt", "cover.ply", ".9.ply"] {
            std::fs::write(folder.path().join(name), b"").unwrap();
        }
        let names = |path: &Path| -> Vec<String> {
            let files = frames(path).unwrap().files;
            files.iter().map(|f| f.file_name().unwrap().to_string_lossy().into_owned()).collect()
        };
        assert_eq!(names(folder.path()), ["f9.ply", "f10.ply", "f100.compressed.ply"]);
        assert_eq!(names(&folder.path().join("f%d.ply")), ["f9.ply", "f10.ply"]);
        std::fs::write(folder.path().join("f3.spz"), b"").unwrap();
        assert!(frames(folder.path()).unwrap_err().to_string().contains("several formats"));
        let empty = tempfile::tempdir().unwrap();
        assert!(frames(empty.path()).unwrap_err().to_string().contains("numbered"));
    }

    #[test]
    fn a_missing_frame_is_reported_and_keeps_its_time() {
        let folder = tempfile::tempdir().unwrap();
        for n in [1, 2, 4, 9] {
            std::fs::write(folder.path().join(format!("f{n}.ply")), b"").unwrap();
        }
        let found = frames(folder.path()).unwrap();
        assert_eq!((found.numbers, found.missing.as_deref()), (vec![0, 1, 3, 8], Some("3, 5 to 8")));
        for n in [0, 10, 30] {
            std::fs::write(folder.path().join(format!("g{n}.ply")), b"").unwrap();
        }
        let found = frames(&folder.path().join("g%d.ply")).unwrap();
        assert_eq!((found.numbers, found.missing.as_deref()), (vec![0, 1, 3], Some("20")), "every tenth");
        (0..=30).for_each(|n| drop(std::fs::remove_file(folder.path().join(format!("g{n}.ply")))));
        std::fs::write(folder.path().join("f4000000000.ply"), b"").unwrap();
        assert!(frames(folder.path()).unwrap_err().to_string().contains("from 1 to 4000000000"));
    }

    #[test]
    fn training_steps_in_names_are_not_frames() {
        let newest = |names: &[&str]| {
            let folder = tempfile::tempdir().unwrap();
            names.iter().for_each(|name| std::fs::write(folder.path().join(name), b"").unwrap());
            let file = frames(folder.path()).unwrap().snapshots?;
            Some(file.file_name().unwrap().to_str().unwrap().to_owned())
        };
        assert_eq!(newest(&["export_5000.ply", "export_10000.ply", "export_30000.ply"]).unwrap(), "export_30000.ply");
        assert_eq!(newest(&["point_cloud_6999.ply", "point_cloud_29999.ply"]).unwrap(), "point_cloud_29999.ply");
        assert_eq!(newest(&["f0.ply", "f1.ply", "f2.ply"]), None);
        assert_eq!(newest(&["f000.ply", "f010.ply", "f500.ply"]), None);
        assert_eq!(newest(&["f500.ply"]), None);
    }

    #[cfg(unix)]
    #[test]
    fn names_that_are_not_text_are_frames_too() {
        use std::os::unix::ffi::OsStrExt;
        let folder = tempfile::tempdir().unwrap();
        let pattern = Pattern::of(&folder.path().join(OsStr::from_bytes(b"f\xff_%03d.ply"))).unwrap();
        for n in 0..3 {
            std::fs::write(pattern.file(n), b"").unwrap();
        }
        let given = folder.path().join(OsStr::from_bytes(b"f\xff_%03d.ply"));
        for path in [folder.path(), given.as_path()] {
            assert_eq!(frames(path).unwrap().files, (0..3).map(|n| pattern.file(n)).collect::<Vec<_>>());
        }
        assert!(
            pattern.writes(OsStr::from_bytes(b"f\xff_002.ply"), 3)
                && !pattern.writes(OsStr::from_bytes(b"f\xff_003.ply"), 3)
        );
    }
}
