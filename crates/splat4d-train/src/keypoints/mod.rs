//! Keypoints of images and the image filters that they need. Cameras are unknown here: captures check poses with
//! keypoints, and `vision` finds points in posed images.

pub mod features;
pub mod raster;
