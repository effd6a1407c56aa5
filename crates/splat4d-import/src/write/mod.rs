//! Writes the capture: images of all cameras with their times, and `capture.json` (docs/capture-format.md).
//!
//! Images are written first because poses are found in them. An interrupted folder is continued: every file is written
//! under another name and renamed, and `pictures` records their source.

mod capture;
mod masks;
mod pictures;

pub use capture::{Placed, Poses, Recording, capture};
pub use masks::Masks;
pub(crate) use masks::{Begin, masks};
pub(crate) use pictures::{Clip, camera_names, pictures};
pub use pictures::{Format, Pictures, Shot};

#[cfg(test)]
mod tests;
