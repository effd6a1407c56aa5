//! Files and folders that commands write: no user file is lost, and no two processes write into one folder.
//!
//! - `write`: a file appears whole or not at all.
//! - [`Owner`]: one process at a time writes into a folder. Readers take no part in it.
//! - [`OutputFolder`]: what a command may find in its folder, the list of its own files, their replacement, and the
//!   continuation of an unfinished command.
//!
//! All of it is kept in the subfolder [`STATE`] of the output folder.

mod date;
mod folder;
mod legacy;
mod list;
mod owner;
mod place;
mod temporary;
#[cfg(test)]
mod tests;
mod write;

pub use date::rfc3339;
pub use folder::{FolderContent, Mixes, OutputFolder, Request};
pub use list::{note, written};
pub use owner::{Owner, Standing, check_free};
pub use place::{Input, check_apart, check_file};
pub use write::{Staged, write_atomically, write_atomically_with};

use crate::{Error, Result};
use std::path::Path;

/// Subfolder of an output folder with its lock, its owner and the list of its files.
pub const STATE: &str = ".splat4d";
/// What to do about a file that cannot be written.
const NO_SPACE: &str = "Check that the folder exists, that you may write there and that the disk is not full";

/// The error of a failed write.
fn cannot_write(path: &Path, error: std::io::Error) -> Error {
    Error::environment("cannot be written", error).at(path.display()).remedy(NO_SPACE)
}

/// Refuses a link, folder, pipe or device in the place of a file of an output folder's state: it would lead elsewhere, or wait.
fn check_plain(path: &Path) -> Result<()> {
    match std::fs::symlink_metadata(path) {
        Ok(there) if !there.is_file() => Err(Error::input("is not a regular file, but a link, folder, pipe or device")
            .at(path.display())
            .remedy("Remove it: splat4d keeps a file of its own there")),
        _ => Ok(()),
    }
}
