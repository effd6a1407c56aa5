//! Keypoints of images and the image filters that they need. Nothing here knows cameras: captures check their poses with it, and
//! `vision` finds points in posed images.

pub mod features;
pub mod raster;
