//! Opens the user's files: regular files only, read no further than their length.

use crate::text;
use splat4d::{Error, Result};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// How a file begins that Git LFS left in the place of the real one, and how long it is at most.
const POINTER: &[u8] = b"version https://git-lfs";
const POINTER_BYTES: u64 = 1024;

/// Remedy for an unreadable file.
const CHECK: &str = "Check that the file exists and may be read by you.";

/// Opens a file to read. Errors: none is there; a folder, pipe or device, on which reading could wait or never end; an
/// empty file.
pub fn open(path: &Path) -> Result<File> {
    // Files of the kernel, such as /proc/kmsg, claim to be regular and empty; reading them may wait or never end.
    match length(path, CHECK)? {
        0 => {
            Err(Error::input("is empty").at(path.display()).remedy("Give a file that holds something; write it again."))
        }
        _ => File::open(path).map_err(|e| cannot_read(path, e, CHECK)),
    }
}

/// The length of a regular file, bytes. Errors: none is there; it is a folder, pipe or device.
fn length(path: &Path, remedy: &str) -> Result<u64> {
    // Before it is opened: that alone waits, where a pipe has no writer.
    let file = std::fs::metadata(path).map_err(|e| cannot_read(path, e, remedy))?;
    if !file.is_file() {
        return Err(Error::input("is not a regular file, but a folder, pipe or device")
            .at(path.display())
            .remedy("Give a file; write what comes through a pipe to one first."));
    }
    Ok(file.len())
}

fn cannot_read(path: &Path, error: std::io::Error, remedy: &str) -> Error {
    Error::io("cannot be read", error).at(path.display()).remedy(remedy)
}

/// Reads a file. Errors: those of [`open`], but an empty file is no error; it does not fit into memory; the disk's.
pub fn read(path: &Path) -> Result<Vec<u8>> {
    read_with(path, CHECK)
}

/// The same, with what to do about a file that is not there.
pub(crate) fn read_with(path: &Path, remedy: &str) -> Result<Vec<u8>> {
    let (length, mut bytes) = (length(path, remedy)?, Vec::new());
    let file = File::open(path).map_err(|e| cannot_read(path, e, remedy))?;
    if length == 0 {
        return Ok(bytes);
    }
    if usize::try_from(length).ok().is_none_or(|n| bytes.try_reserve_exact(n).is_err()) {
        return Err(Error::input(format!("has {length} bytes, which do not fit into memory"))
            .at(path.display())
            .remedy(CHECK));
    }
    file.take(length).read_to_end(&mut bytes).map_err(|e| cannot_read(path, e, remedy))?;
    if length <= POINTER_BYTES && bytes.starts_with(POINTER) {
        return Err(Error::input("is a pointer of Git LFS, not the file itself")
            .at(path.display())
            .remedy("Fetch the files of its repository with `git lfs pull`."));
    }
    Ok(bytes)
}

/// Reads a text file, with or without byte-order mark. Errors: those of [`read`] and of [`text::decode`].
pub fn read_text(path: &Path) -> Result<String> {
    read_text_with(path, CHECK)
}

/// The same, with what to do about a file that is not there.
pub(crate) fn read_text_with(path: &Path, remedy: &str) -> Result<String> {
    let bytes = read_with(path, remedy)?;
    Ok(text::decode(&bytes).map_err(|e| e.at(path.display()))?.into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_regular_files_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.txt");
        std::fs::write(&file, "text").unwrap();
        assert_eq!(read_text(&file).unwrap(), "text");
        std::fs::write(&file, "version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 9\n").unwrap();
        assert!(read(&file).unwrap_err().to_string().contains("git lfs pull"));
        std::fs::write(&file, b"a\xff").unwrap();
        assert!(read_text(&file).unwrap_err().to_string().contains("UTF-8"));
        let mut odd = vec![folder.path().to_owned()];
        if cfg!(unix) {
            odd.push("/dev/zero".into());
            let pipe = folder.path().join("pipe");
            if std::process::Command::new("mkfifo").arg(&pipe).status().is_ok_and(|s| s.success()) {
                odd.push(pipe);
            }
        }
        for path in odd {
            let error = read(&path).unwrap_err().to_string();
            assert!(error.contains("regular file"), "{error}");
        }
    }

    /// The kernel's files claim to be regular and empty. One of these has no end, one waits where the reader may open
    /// it.
    #[test]
    fn files_of_the_kernel_are_read_as_long_as_they_claim_to_be() {
        for path in ["/proc/self/status", "/proc/self/pagemap", "/proc/kmsg"].map(Path::new) {
            if path.exists() {
                assert!(read(path).is_ok_and(|bytes| bytes.is_empty()) || File::open(path).is_err(), "{path:?}");
                assert!(open(path).unwrap_err().to_string().contains("is empty"), "{path:?}");
            }
        }
    }
}
