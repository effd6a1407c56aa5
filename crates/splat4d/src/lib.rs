//! Moving 3D Gaussian scenes: tables, motion models and a differentiable renderer.
//!
//! From the bytes of a file to a picture at a time:
//!
//! ```
//! use splat4d::prelude::*;
//!
//! # fn main() -> Result<()> {
//! let bytes = std::fs::read("../../examples/knight.s4d").expect("the file is there");
//! let scene = splat4d::open(&bytes)?; // also .ply, .spz, .splatv, SOG and scene.safetensors
//! let pose = Se3::look_at([3.0, 3.0, 1.5], [0.0, 0.0, 0.8], scene.up);
//! let camera = Camera::with_fov_y(pose, 0.8, 160, 120);
//! let image = splat4d::draw(&scene, &camera, Time(0.5))?;
//! assert_eq!(image.color.data.len(), 3 * 160 * 120); // red, then green, then blue, in [0, 1]
//! # assert!(image.alpha.data.iter().any(|a| *a > 0.9), "something is seen");
//! # Ok(())
//! # }
//! ```
//!
//! The chain behind it is `motion.at → render`, and in training on through `loss → render.vjp → motion.backward`. A motion
//! model answers one question (which [`scene::Splats`] at time t), the renderer never sees time, a motion model never sees
//! a pixel. [`layers::Evaluation`] asks many such questions together and takes gradients back; [`render::Backend`] is
//! whatever draws; [`play::Player`] plays long scenes within a budget of memory.
//!
//! This crate reads bytes, not paths; it knows no loss, no optimiser and no data set (those are in `splat4d-train`).

pub mod bake;
pub mod channels;
pub mod device;
pub mod edit;
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
pub mod text;
pub mod wgsl;

pub use error::{Error, ErrorKind, Result};
pub use format::open;
pub use play::draw;

/// The names that most programs need.
pub mod prelude {
    pub use crate::device::{self, Device};
    pub use crate::layers::{Evaluation, Layer, Scene};
    pub use crate::math::Se3;
    pub use crate::motion::{Motion, Spec};
    pub use crate::play::Player;
    pub use crate::render::{Backend, Image, RenderConfig, Shot};
    pub use crate::scene::{Camera, LifeKind, Params, Time};
    pub use crate::{Error, ErrorKind, Result, draw, open};
}
