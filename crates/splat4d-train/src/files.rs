//! Files of the user, opened: regular ones only.

use crate::text;
use splat4d::{Error, Result};
use std::fs::File;
use std::path::Path;

/// What to do about a file that cannot be read.
const CHECK: &str = "Check that the file exists and may be read by you.";

/// Opens a file to read. Errors: none is there; a folder, pipe or device, on which reading could wait or never end.
pub fn open(path: &Path) -> Result<File> {
    open_with(path, CHECK)
}

fn open_with(path: &Path, remedy: &str) -> Result<File> {
    let fail = |e| Error::io("cannot be read", e).at(path.display()).remedy(remedy);
    // Before it is opened: that alone waits, where a pipe has no writer.
    if !std::fs::metadata(path).map_err(fail)?.is_file() {
        return Err(Error::input("is not a regular file, but a folder, pipe or device")
            .at(path.display())
            .remedy("Give a file; write what comes through a pipe to one first."));
    }
    File::open(path).map_err(fail)
}

/// Reads a file. Errors: those of [`open`]; the disk's.
pub fn read(path: &Path) -> Result<Vec<u8>> {
    read_with(path, CHECK)
}

/// The same, with what to do about a file that is not there.
pub(crate) fn read_with(path: &Path, remedy: &str) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let length = std::io::Read::read_to_end(&mut open_with(path, remedy)?, &mut bytes);
    length.map_err(|e| Error::io("cannot be read", e).at(path.display()))?;
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
}
