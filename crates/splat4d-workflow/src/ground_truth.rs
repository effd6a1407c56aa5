//! Errors of a scene against ground truth that lies in its capture's folder: tracks of points in space, and where and
//! whether cameras see them.

pub mod points;
pub mod tracks;
