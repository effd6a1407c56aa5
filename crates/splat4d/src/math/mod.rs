//! Small mathematics: vectors, quaternions, medians, Fourier transforms, image halving, symmetric 3x3 matrices, rigid motions, similarities, spherical harmonics, counter-based random
//! numbers, and the [`Real`] trait that lets every kernel run in f32 and be checked in f64.

pub mod align;
pub mod cholesky;
pub mod fft;
pub mod image;
pub mod jacobi;
pub mod knn;
mod logit;
pub mod mat3;
mod median;
pub mod quat;
pub(crate) mod real;
pub(crate) mod rng;
pub mod se3;
pub mod sh;
pub(crate) mod sh_rotation;
pub(crate) mod sim3;
pub mod spd;
pub mod sym3;
pub(crate) mod twist;
pub mod vec3;

pub use logit::logit;
pub use median::{median, median_by};
pub use real::Real;
pub use rng::Rng;
pub use se3::Se3;
pub use sim3::Sim3;
