//! Where the first Gaussians come from.

pub mod knn;
