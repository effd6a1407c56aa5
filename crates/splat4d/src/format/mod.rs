//! What is on disk: every reader takes bytes and every writer fills an [`std::io::Write`], so that nothing here knows
//! a path.
//!
//! **Readers never panic, hang or allocate more than a small multiple of the bytes they were given**, whatever the
//! bytes say: counts and lengths are compared with what is really there before anything is allocated.

pub mod arrays;
pub mod dialect;
mod half;
mod kinematic;
#[cfg(test)]
mod mutate;
pub mod npy;
mod octets;
pub mod playback;
pub mod ply;
pub mod quant;
pub mod safetensors;
#[cfg(test)]
mod samples;
pub mod scene;
pub mod sequence;
pub mod sog;
pub mod splat;
pub mod splatv;
pub mod spz;
pub mod warnings;
mod zip;

pub use arrays::{params_to_arrays, tensors_to_loaded};
pub use dialect::Dialect;
pub use warnings::Warnings;
