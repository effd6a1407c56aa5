//! The capture that comes out: pictures of all cameras with their times, and `capture.json` (docs/capture-format.md).
//!
//! Pictures come first, because poses are found in them. A folder that was left half way is gone on with: every file is
//! written under another name and renamed, and [`pictures`] notes beside them what they were made of.

mod capture;
mod masks;
mod pictures;

pub use capture::{Placed, Poses, Take, capture};
pub use masks::{Begin, Masks, masks};
pub use pictures::{Clip, Format, Pictures, Shot, camera_names, pictures};

#[cfg(test)]
mod tests;
