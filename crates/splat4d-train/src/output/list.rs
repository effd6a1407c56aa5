//! The list of the files that commands wrote into an output folder: `.splat4d/files`, a path a line, appended to.
//!
//! A file's line is written before the file gets its name, so that the list never misses one. Lines that end with a
//! slash are folders in which files were written; half-written files are searched for there.

use super::{STATE, cannot_write, check_plain};
use crate::Result;
use crate::path_text::{escaped, of_escaped};
use std::collections::BTreeSet;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Component, Path, PathBuf};
use std::sync::{Arc, Mutex, Weak};

/// Name of the list in the folder's state.
pub(super) const FILE: &str = "files";

/// The folders that this process writes into and keeps lists of. There are many writers, and each has only its file.
static KEPT: Mutex<Vec<Weak<List>>> = Mutex::new(Vec::new());

/// The list of one folder; new files in it are noted as long as this is there.
#[derive(Debug)]
pub(super) struct List {
    /// The folder's real path.
    root: PathBuf,
    file: PathBuf,
    known: Mutex<BTreeSet<PathBuf>>,
}

impl List {
    /// Opens a folder's list, or begins it. Errors: the folder cannot be read or written.
    pub(super) fn keep(folder: &Path) -> Result<Arc<Self>> {
        let fail = |e| cannot_write(folder, e);
        let root = folder.canonicalize().map_err(fail)?;
        std::fs::create_dir_all(root.join(STATE)).map_err(fail)?;
        let file = root.join(STATE).join(FILE);
        check_plain(&file)?;
        let known = Mutex::new(read(&file));
        let list = Arc::new(Self { root, file, known });
        let mut kept = KEPT.lock().unwrap_or_else(|e| e.into_inner());
        kept.retain(|k| k.strong_count() > 0);
        kept.push(Arc::downgrade(&list));
        Ok(list)
    }

    /// Notes a path below the folder. Errors: the list cannot be written.
    pub(super) fn add(&self, relative: &Path) -> Result<()> {
        let mut known = self.known.lock().unwrap_or_else(|e| e.into_inner());
        if known.contains(relative) {
            return Ok(());
        }
        let Some(mut line) = escaped(relative) else { return Ok(()) };
        line.push('\n');
        let mut append = || {
            let mut file = File::options().read(true).append(true).create(true).open(&self.file)?;
            // A line that a kill cut off is ended first.
            if file.seek(SeekFrom::End(-1)).is_ok() {
                let mut last = [b'\n'];
                file.read_exact(&mut last)?;
                if last != [b'\n'] {
                    line.insert(0, '\n');
                }
            }
            file.write_all(line.as_bytes())
        };
        append().map_err(|e| cannot_write(&self.file, e))?;
        known.insert(relative.to_owned());
        Ok(())
    }

    /// The files that it names.
    pub(super) fn files(&self) -> Vec<PathBuf> {
        let known = self.known.lock().unwrap_or_else(|e| e.into_inner());
        known.iter().filter(|p| !is_folder(p)).cloned().collect()
    }

    /// Clears it; its file is already deleted.
    pub(super) fn forget(&self) {
        self.known.lock().unwrap_or_else(|e| e.into_inner()).clear();
    }
}

/// The folders of a folder's list, itself first.
pub(super) fn folders(folder: &Path) -> Vec<PathBuf> {
    let listed = read_of(folder);
    std::iter::once(folder.to_owned()).chain(listed.iter().filter(|p| is_folder(p)).map(|p| folder.join(p))).collect()
}

/// Files that commands wrote into a folder, by its list: paths below it, folders with a slash at their end.
pub fn written(folder: &Path) -> BTreeSet<PathBuf> {
    read_of(folder)
}

/// Entries of a folder's list.
pub(super) fn read_of(folder: &Path) -> BTreeSet<PathBuf> {
    read(&folder.join(STATE).join(FILE))
}

/// Notes a file that is about to get its name, if it is in a folder of which a list is kept. Errors: the list cannot be
/// written.
pub fn note(file: &Path) -> Result<()> {
    let Some((list, folder)) = kept(file) else { return Ok(()) };
    file.file_name().map_or(Ok(()), |name| list.add(&folder.join(name)))
}

/// Whether a file is in a folder of which a list is kept.
pub(super) fn keeps(file: &Path) -> bool {
    kept(file).is_some()
}

/// Notes the folder of a file that is about to be written. Returns whether a list is kept there.
pub(super) fn note_folder(file: &Path) -> Result<bool> {
    let Some((list, folder)) = kept(file) else { return Ok(false) };
    if folder.as_os_str().is_empty() {
        return Ok(true);
    }
    list.add(&folder.join("")).map(|()| true)
}

/// The innermost folder of which a list is kept and that contains a file, and the file's folder in it.
fn kept(file: &Path) -> Option<(Arc<List>, PathBuf)> {
    let lists: Vec<Arc<List>> = {
        let kept = KEPT.lock().unwrap_or_else(|e| e.into_inner());
        kept.iter().filter_map(Weak::upgrade).collect()
    };
    if lists.is_empty() {
        return None;
    }
    let folder = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let real = folder.canonicalize().ok()?;
    let within = lists.into_iter().filter(|l| real.starts_with(&l.root));
    let list = within.max_by_key(|l| l.root.as_os_str().len())?;
    let relative = real.strip_prefix(&list.root).ok()?.to_owned();
    // The state itself is not listed.
    (!relative.starts_with(STATE)).then_some((list, relative))
}

fn is_folder(path: &Path) -> bool {
    let bytes = path.as_os_str().as_encoded_bytes();
    bytes.ends_with(b"/") || cfg!(windows) && bytes.ends_with(b"\\")
}

/// The whole lines that lead nowhere but below the folder.
fn read(file: &Path) -> BTreeSet<PathBuf> {
    let text = crate::files::read_text(file).unwrap_or_default();
    let whole = text.split_inclusive('\n').filter_map(|line| line.strip_suffix('\n'));
    let below = |p: &PathBuf| {
        let mut parts = p.components();
        p.components().next().is_some() && parts.all(|c| matches!(c, Component::Normal(n) if n != STATE))
    };
    whole.filter_map(of_escaped).filter(below).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn list_lines_round_trip_and_foreign_paths_are_dropped() {
        let folder = tempfile::tempdir().unwrap();
        let list = List::keep(folder.path()).unwrap();
        let paths = [PathBuf::from("a b/100 %.png"), PathBuf::from("ü\n.json"), PathBuf::from("test/ours_20/")];
        paths.iter().for_each(|p| list.add(p).unwrap());
        let file = folder.path().join(STATE).join(FILE);
        let before = read(&file);
        assert_eq!(before, paths.iter().cloned().collect());
        // A line that was cut off is no path, and the next one is whole.
        std::fs::OpenOptions::new().append(true).open(&file).unwrap().write_all(b"checkpoi").unwrap();
        assert_eq!(read(&file), before);
        list.add(Path::new("x")).unwrap();
        assert!(read(&file).contains(Path::new("x")));
        std::fs::write(&file, "/etc/passwd\n../up\na/../../b\n.splat4d/lock\n\n%zz\ngood\n").unwrap();
        assert_eq!(read(&file), BTreeSet::from([PathBuf::from("good")]));
    }
}
