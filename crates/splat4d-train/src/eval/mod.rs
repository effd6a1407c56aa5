//! Measures how good a render is, and writes it down in the files that 3DGS users know.

pub(crate) mod conv;
pub mod lpips;
pub mod metrics;
