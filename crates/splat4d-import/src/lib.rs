//! Makes captures of videos: frames with their times, a clock that all cameras share, poses from pictures alone, and a folder that
//! training takes.

pub mod board;
pub mod calibration;
pub mod corrections;
pub mod doctor;
pub mod sfm;
pub mod shipped;
pub mod sync;
pub mod take;
pub mod video;
pub mod write;

pub use splat4d::{Error, ErrorKind, Result};
