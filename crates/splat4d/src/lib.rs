//! Moving 3D Gaussian scenes: tables, motion models and a differentiable renderer.
//!
//! The chain is `motion.at → render → loss → render.backward → motion.backward`. A motion model answers one
//! question (which [`scene::Splats`] at time t), the renderer never sees time, a motion model never sees a pixel.
//! This crate reads bytes, not paths; it knows no loss, no optimiser and no data set.

pub mod bake;
pub mod device;
pub mod error;
pub mod flow;
pub mod format;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod layers;
pub mod math;
pub mod motion;
pub mod nn;
pub mod play;
pub mod render;
pub mod scene;
pub mod simd;
pub mod wgsl;

pub use error::{Error, ErrorKind, Result};
