//! Position of an output folder relative to the inputs.
//!
//! Folders are compared by what the file system states they are (device and number), so that links, mounts, `..` and
//! names that only differ in case are seen through.

use super::{STATE, written};
use crate::capture;
use crate::{Error, Result};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Files of imports: the capture that they make, and their list of corrections.
const CAPTURE: &str = "capture.json";
const CORRECTIONS: &str = "import.toml";
/// Folders below an output folder that are examined for captures, two levels deep.
const MOST_FOLDERS: usize = 256;

/// A file or folder that is read.
#[derive(Clone, Copy, Debug)]
pub struct Input<'a> {
    /// Its path.
    pub path: &'a Path,
    /// Its name in errors: `the capture`.
    pub what: &'a str,
    /// Whether the output may be in it, as renders are in their run.
    pub may_hold: bool,
}

impl<'a> Input<'a> {
    /// An input that no output may be in.
    pub fn new(path: &'a Path, what: &'a str) -> Self {
        Self { path, what, may_hold: false }
    }
}

/// Refuses an output folder that equals, contains or is inside an input or any capture. An import may be continued in its
/// own folder.
pub fn check_apart(output: &Path, inputs: &[Input<'_>]) -> Result<()> {
    check_inputs(output, inputs)?;
    let is_import = written(output).iter().any(|f| f == Path::new(CAPTURE)) || output.join(CORRECTIONS).is_file();
    let own = is_import.then(|| Input { may_hold: true, ..Input::new(output, "the import") });
    check_no_capture(output, &inputs.iter().copied().chain(own).collect::<Vec<_>>())
}

/// Refuses an output folder that equals, contains or is inside an input. Missing inputs are reported by
/// their readers.
pub(super) fn check_inputs(output: &Path, inputs: &[Input<'_>]) -> Result<()> {
    let above_output = ids(output);
    for input in inputs {
        let Ok(real) = input.path.canonicalize() else { continue };
        let above_input = ids(&real);
        let [own, others] = [&above_input, &above_output];
        let (Some(input_id), Some(output_id)) = (own.first().cloned().flatten(), others.first().cloned()) else {
            continue;
        };
        // Of an output that is not there yet only the folders above it are known.
        let how = match output_id {
            Some(id) if id == input_id => "is",
            Some(id) if own.iter().any(|o| o.as_ref() == Some(&id)) => "contains",
            _ if others.contains(&Some(input_id)) && !input.may_hold => "lies inside",
            _ => continue,
        };
        return Err(Error::input(format!("the output folder {how} {} {}", input.what, input.path.display()))
            .at(output.display())
            .remedy("Choose a folder apart from everything that is read, with -o"));
    }
    Ok(())
}

/// Refuses an output folder that is any capture, contains one or is inside one: its images are the user's even if the command
/// reads none of them. An input that may hold the output, or the folder of such a file, is none of these.
pub(super) fn check_no_capture(output: &Path, inputs: &[Input<'_>]) -> Result<()> {
    let folder_of = |path: &Path| if path.is_dir() { id(path) } else { path.parent().and_then(id) };
    let holders: Vec<Option<Id>> = inputs.iter().filter(|i| i.may_hold).map(|i| folder_of(i.path)).collect();
    let is_foreign = |folder: &Path| capture::is_filmed(folder) && !holders.contains(&id(folder));
    let (real, missing) = existing_part(output);
    let around = real.ancestors().enumerate().find(|(_, folder)| is_foreign(folder));
    let own = written(&real);
    let is_own = |folder: &Path| is_written(&real, folder, &own);
    let (how, found) = match around {
        Some((0, folder)) if missing == 0 => ("is", folder.to_owned()),
        Some((_, folder)) => ("lies inside", folder.to_owned()),
        None if missing > 0 => return Ok(()),
        None => match folders_below(&real).into_iter().find(|folder| is_foreign(folder) && !is_own(folder)) {
            Some(folder) => ("contains", folder),
            None => return Ok(()),
        },
    };
    Err(Error::input(format!("the output folder {how} the capture {}", found.display()))
        .at(output.display())
        .remedy("Choose a folder apart from all captures, with -o"))
}

/// Whether all images and videos of a folder below an output are on the output's list of files: those that an import made for
/// COLMAP are, also where it was cut off.
fn is_written(output: &Path, folder: &Path, own: &BTreeSet<PathBuf>) -> bool {
    let filmed = capture::films(folder);
    let listed = |file: &PathBuf| file.strip_prefix(output).is_ok_and(|below| own.contains(below));
    !filmed.is_empty() && filmed.iter().all(listed)
}

/// Folders below one, up to two levels deep, except those of splat4d's own state.
fn folders_below(folder: &Path) -> Vec<PathBuf> {
    let inner = |of: &Path| -> Vec<PathBuf> {
        let entries = std::fs::read_dir(of).into_iter().flatten().flatten();
        let mut found: Vec<PathBuf> = entries
            .filter(|e| e.file_name() != STATE && e.file_type().is_ok_and(|t| t.is_dir()))
            .map(|e| e.path())
            .take(MOST_FOLDERS)
            .collect();
        found.sort();
        found
    };
    let first = inner(folder);
    let second = first.iter().flat_map(|f| inner(f));
    first.iter().cloned().chain(second).take(MOST_FOLDERS).collect()
}

/// Refuses to replace a file that is read, or one in a folder that is read. New files, devices and pipes are no loss.
pub fn check_file(output: &Path, inputs: &[Input<'_>]) -> Result<()> {
    if !output.is_file() {
        return Ok(());
    }
    let above = ids(output);
    for input in inputs {
        let Some(read) = id(input.path) else { continue };
        let how = match above.iter().position(|o| o.as_ref() == Some(&read)) {
            Some(0) => "is",
            Some(_) if !input.may_hold => "is a file of",
            _ => continue,
        };
        return Err(Error::input(format!("the output {how} {} {}", input.what, input.path.display()))
            .at(output.display())
            .remedy("Choose another name: what is read is never replaced"));
    }
    Ok(())
}

/// Identity of a file or folder in the file system.
#[cfg(unix)]
type Id = (u64, u64);
#[cfg(not(unix))]
type Id = String;

#[cfg(unix)]
fn id(path: &Path) -> Option<Id> {
    use std::os::unix::fs::MetadataExt;
    std::fs::metadata(path).ok().map(|m| (m.dev(), m.ino()))
}

/// The real path in lower case: systems without numbers of files mostly ignore case.
#[cfg(not(unix))]
fn id(path: &Path) -> Option<Id> {
    path.canonicalize().ok().map(|p| p.to_string_lossy().to_lowercase())
}

/// A path's identity and those of all folders above it, nearest first; `None` where nothing is there yet.
fn ids(path: &Path) -> Vec<Option<Id>> {
    let (real, missing) = existing_part(path);
    std::iter::repeat_n(None, missing).chain(real.ancestors().map(id)).collect()
}

/// The real path of the deepest part of a path that is there, and how many names of it are not there yet. Behind links and `..`
/// the real folders count.
fn existing_part(path: &Path) -> (PathBuf, usize) {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let mut there: PathBuf = path.clone();
    let mut missing = 0;
    loop {
        if let Ok(real) = there.canonicalize() {
            return (real, missing);
        }
        missing += 1;
        if !there.pop() {
            return (path, missing);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_output_inside_or_around_an_input_is_refused() {
        let work = tempfile::tempdir().unwrap();
        let at = |name: &str| work.path().join(name);
        std::fs::create_dir_all(at("capture/images")).unwrap();
        std::fs::create_dir_all(at("other/deep")).unwrap();
        let capture = at("capture");
        let check = |output: &Path, may_hold: bool| {
            let input = Input { may_hold, ..Input::new(&capture, "the capture") };
            check_inputs(output, &[input]).map_err(|e| e.to_string())
        };
        let refused = |output: &Path, how: &str| {
            let text = check(output, false).unwrap_err();
            assert!(text.contains(how) && text.contains("the capture"), "{}: {text}", output.display());
        };
        refused(&capture, "is the capture");
        refused(&at("capture/../capture/."), "is the capture");
        refused(&at("other/../capture"), "is the capture");
        refused(work.path(), "contains");
        refused(&at("capture/images"), "lies inside");
        refused(&at("capture/new/run"), "lies inside");
        for apart in ["other", "other/deep/run", "capture-2", "new"] {
            assert_eq!(check(&at(apart), false), Ok(()), "{apart}");
        }
        assert_eq!(check(&at("capture/new"), true), Ok(()), "renders may lie in their run");
        assert!(check(&capture, true).is_err() && check(work.path(), true).is_err());
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(&capture, at("link")).unwrap();
            std::os::unix::fs::symlink(work.path(), at("other/up")).unwrap();
            refused(&at("link"), "is the capture");
            refused(&at("link/run"), "lies inside");
            refused(&at("other/up"), "contains");
            // The capture behind a link, the output at its real place.
            let link = at("link");
            let input = [Input::new(&link, "the capture")];
            assert!(check_inputs(&capture, &input).is_err() && check_inputs(&at("capture/run"), &input).is_err());
        }
        std::fs::write(capture.join("points.ply"), b"x").unwrap();
        let file = |output: &Path, may_hold: bool| {
            check_file(output, &[Input { may_hold, ..Input::new(&capture, "the capture") }]).map_err(|e| e.to_string())
        };
        let read = at("other/../capture/points.ply");
        assert!(file(&read, false).unwrap_err().contains("is a file of the capture"));
        assert_eq!([file(&read, true), file(&capture.join("new.ply"), false)], [Ok(()), Ok(())]);
        let error = check_file(&read, &[Input::new(&capture.join("points.ply"), "the scene")]).unwrap_err().to_string();
        assert!(error.contains("the output is the scene"), "{error}");
        assert!(check_inputs(&at("x"), &[Input::new(&at("nowhere"), "the capture")]).is_ok(), "readers say that");
    }

    #[test]
    fn an_output_inside_or_around_any_capture_is_refused() {
        let work = tempfile::tempdir().unwrap();
        let at = |name: &str| work.path().join(name);
        std::fs::create_dir_all(at("sets/a/images")).unwrap();
        std::fs::create_dir_all(at("sets/runs")).unwrap();
        let check = |name: &str| check_no_capture(&at(name), &[]).map_err(|e| e.to_string());
        // A file that is called like a capture's is none without images.
        std::fs::write(at("sets/a/transforms.json"), "{}").unwrap();
        std::fs::remove_dir(at("sets/a/images")).unwrap();
        assert_eq!([check("sets/a"), check("sets/a/run"), check("sets")], [Ok(()), Ok(()), Ok(())]);
        std::fs::write(at("sets/a/0001.jpg"), "x").unwrap();
        for (name, how) in [("sets/a", "is"), ("sets/a/run", "lies inside"), ("sets", "contains"), ("", "contains")] {
            let text = check(name).unwrap_err();
            assert!(text.contains(&format!("the output folder {how} the capture")), "{name}: {text}");
        }
        assert_eq!([check("sets/runs"), check("sets/runs/a"), check("new")], [Ok(()), Ok(()), Ok(())]);
        // An import is continued in its own folder.
        assert!(check_apart(&at("sets/a"), &[]).is_err());
        std::fs::write(at("sets/a/import.toml"), "").unwrap();
        assert!(check_apart(&at("sets/a"), &[]).is_ok() && check("sets/a").is_err());
        // A model that an import made is its own, whatever it is called; with another image it is the user's.
        for name in ["import/colmap/images/cam0.png", "import/colmap/transforms.json", ".splat4d/files"] {
            let path = at("take").join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "import/colmap/images/\nimport/colmap/images/cam0.png\n").unwrap();
        }
        assert_eq!(check("take"), Ok(()));
        std::fs::write(at("take/import/colmap/images/mine.png"), "x").unwrap();
        assert!(check("take").unwrap_err().contains("contains the capture"));
        std::fs::remove_file(at("take/import/colmap/images/mine.png")).unwrap();
        std::fs::remove_file(at("take/.splat4d/files")).unwrap();
        assert!(check("take").is_err(), "no list, no import");
        // The folder of a calibration may hold what is imported with it.
        for calibration in ["sets/a", "sets/a/transforms.json"] {
            let path = at(calibration);
            let inputs = [Input { may_hold: true, ..Input::new(&path, "the calibration") }];
            assert!(check_no_capture(&at("sets/a/take"), &inputs).is_ok(), "{calibration}");
            let inputs = [Input::new(&path, "the calibration")];
            assert!(check_no_capture(&at("sets/a/take"), &inputs).is_err(), "{calibration}");
        }
    }
}
