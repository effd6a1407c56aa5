//! Learns moving Gaussian scenes from posed captures: capture → initial Gaussians → stages of training → evaluation.
//!
//! The trainer only emits [`event::Event`]s; progress bars, logs and viewers listen.

pub mod event;
pub mod recipe;

pub use splat4d::{Error, ErrorKind, Result};
