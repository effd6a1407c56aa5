//! Files and folders that commands write: nothing of the user's is lost, and no two processes write into one folder.
//!
//! - [`write`](mod@write): a file appears whole or not at all.
//! - [`Owner`]: one process at a time writes into a folder. Readers take no part in it.
//! - [`OutputFolder`]: what a command may find in its folder, which files are its own (it keeps a list), how they are
//!   replaced, and how an unfinished command is continued.
//!
//! All of it is kept in the subfolder [`STATE`] of the output folder.

mod date;
mod folder;
mod legacy;
mod list;
mod owner;
mod place;
#[cfg(test)]
mod tests;
mod write;

pub use date::rfc3339;
pub use folder::{Found, Mixes, OutputFolder, Request};
pub use list::note;
pub use owner::{Owner, Standing, check_free};
pub use place::{Input, check_apart, check_file};
pub use write::{Staged, write_atomically, write_atomically_with};

/// Subfolder of an output folder with its lock, its owner and the list of its files.
pub const STATE: &str = ".splat4d";
