//! Writes files so that no reader ever finds half of one, also after a power failure: under a temporary name in the same
//! folder, flushed to the disk, then renamed. All files of the workspace are written here (`xtask/tests/tidy/writers.rs`).

use super::owner::check_free;
use super::temporary::{remove, remove_leftovers_once, temporary_name};
use super::{NO_SPACE, cannot_write, list};
use crate::{Error, Result};
use std::io::Write;
use std::path::{Path, PathBuf};

/// A file under a temporary name next to its place; [`keep`](Self::keep) renames it, dropping it removes it. Who
/// needs a place for several files may create a folder at [`path`](Self::path), which is not kept.
#[derive(Debug)]
pub struct Staged {
    temporary: Option<PathBuf>,
    target: PathBuf,
}

impl Staged {
    /// Prepares to write `path`. A link is followed, so that the file behind it is replaced and not the link; a device
    /// or a pipe is written to. In an output folder the link itself is replaced: folders may be from other people.
    ///
    /// Errors: a folder is there; the list of the folder's files cannot be written.
    pub fn new(path: &Path) -> Result<Self> {
        if path.is_symlink() && list::keeps(path) {
            return Self::at(path.to_owned(), path);
        }
        Self::at(std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned()), path)
    }

    fn at(target: PathBuf, named: &Path) -> Result<Self> {
        if target.is_dir() {
            return Err(Error::input("is a folder").at(named.display()).remedy("Give the name of a file."));
        }
        let Some(name) = target.file_name() else {
            return Err(Error::input("is not a file name").at(named.display()).remedy("Give the name of a file."));
        };
        // A device or pipe (/dev/stdout, /dev/null) must not be replaced by a file.
        if target.metadata().is_ok_and(|m| !m.is_file()) {
            return Ok(Self { temporary: None, target });
        }
        if !list::note_folder(&target)? {
            check_free(&target)?;
            remove_leftovers_once(&target);
        }
        let temporary = target.with_file_name(temporary_name(name));
        Ok(Self { temporary: Some(temporary), target })
    }

    /// Current target of the write.
    pub fn path(&self) -> &Path {
        self.temporary.as_deref().unwrap_or(&self.target)
    }

    /// Flushes the file to the disk and gives it its name. Errors: no space; it cannot be renamed or listed.
    pub fn keep(mut self) -> Result<()> {
        if let Some(temporary) = &self.temporary {
            // A name must never be on the disk before the bytes.
            let file = std::fs::OpenOptions::new().write(true).open(temporary);
            file.and_then(|f| f.sync_all()).map_err(|e| cannot_write(&self.target, e))?;
            list::note(&self.target)?;
            std::fs::rename(temporary, &self.target).map_err(|e| cannot_write(&self.target, e))?;
            self.temporary = None;
        }
        Ok(())
    }
}

impl Drop for Staged {
    fn drop(&mut self) {
        if let Some(temporary) = &self.temporary {
            remove(temporary);
        }
    }
}

/// Writes a file so that a crash leaves the old one or the new one, never half, and the result is flushed to disk.
/// Folders on the path are created. A device or a pipe is written to and never replaced. Errors: missing rights, no
/// space.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<()> {
    write_atomically_with(path, &mut |file| {
        file.write_all(bytes).map_err(|e| Error::environment("the file cannot be written", e).remedy(NO_SPACE))
    })
}

/// The same for what need not be in memory as a whole. Errors: those of `write`, and as [`write_atomically`].
pub fn write_atomically_with(path: &Path, write: &mut dyn FnMut(&mut dyn Write) -> Result<()>) -> Result<()> {
    let place = |e: std::io::Error, what: &str| Error::environment(what, e).at(path.display()).remedy(NO_SPACE);
    let failed = |e| place(e, "the file cannot be written");
    if std::fs::metadata(path).is_ok_and(|m| !m.is_file() && !m.is_dir()) {
        let mut file = std::fs::OpenOptions::new().write(true).open(path).map_err(failed)?;
        return write(&mut file).map_err(|e| e.at(path.display()));
    }
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder).map_err(|e| place(e, "the folder cannot be created"))?;
    if path.is_dir() {
        return Err(failed(std::io::ErrorKind::IsADirectory.into()));
    }
    let staged = Staged::at(path.to_owned(), path)?;
    let mut file = std::io::BufWriter::new(std::fs::File::create(staged.path()).map_err(failed)?);
    write(&mut file).map_err(|e| e.at(path.display()))?;
    drop(file.into_inner().map_err(|e| failed(e.into_error()))?);
    staged.keep()
}

#[cfg(test)]
mod tests {
    use super::super::temporary::{ENDING, machine};
    use super::*;
    use std::fs::File;
    use std::time::SystemTime;

    #[test]
    fn only_temporary_files_of_dead_processes_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: String| folder.path().join(name);
        let own = std::process::id();
        let left = [format!(".a.ply.{}-{}-7{ENDING}", machine(), u32::MAX), format!(".b.0badcafe-1-0{ENDING}")];
        let stays = [
            format!(".a.ply.{}-{own}-7{ENDING}", machine()),
            format!(".b.0badcafe-1-1{ENDING}"),
            format!("a{ENDING}"),
            ".a.ply.123.tmp".into(),
            "a.ply".into(),
        ];
        for name in left.iter().chain(&stays) {
            std::fs::write(at(name.clone()), b"x").unwrap();
        }
        File::options().write(true).open(at(left[1].clone())).unwrap().set_modified(SystemTime::UNIX_EPOCH).unwrap();
        let work = format!(".film.mp4.{}-{}-3{ENDING}", machine(), u32::MAX);
        std::fs::create_dir(at(work.clone())).unwrap();
        std::fs::write(at(work.clone()).join("film"), b"x").unwrap();
        let staged = Staged::new(&at("new.ply".into())).unwrap();
        std::fs::write(staged.path(), b"new").unwrap();
        for name in left.iter().chain([&work]) {
            assert!(!at(name.clone()).exists(), "{name}");
        }
        for name in &stays {
            assert!(at(name.clone()).exists() || name.contains("0badcafe-1-1"), "{name}");
        }
        let half = staged.path().to_owned();
        drop(staged);
        assert!(!half.exists() && !at("new.ply".into()).exists());
    }

    #[test]
    fn long_names_are_written() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["x".repeat(250), "ü".repeat(120)] {
            write_atomically(&folder.path().join(&name), b"x").unwrap();
            assert!(folder.path().join(&name).is_file());
        }
    }

    #[cfg(unix)]
    #[test]
    fn names_that_are_not_text_are_written() {
        use std::ffi::OsStr;
        use std::os::unix::ffi::OsStrExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(OsStr::from_bytes(b"sc\xffne.ply"));
        write_atomically(&path, b"x").unwrap();
        let staged = Staged::new(&path).unwrap();
        std::fs::write(staged.path(), b"y").unwrap();
        staged.keep().unwrap();
        assert_eq!(
            (std::fs::read(&path).unwrap(), std::fs::read_dir(folder.path()).unwrap().count()),
            (b"y".to_vec(), 1)
        );
    }
}
