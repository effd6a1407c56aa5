//! Learns moving Gaussian scenes from posed captures: capture → initial Gaussians → stages of training → evaluation.
//!
//! The trainer only emits [`event::Event`]s; progress bars, logs and viewers listen.

pub mod capture;
pub mod compress;
pub mod eval;
pub mod event;
pub mod init;
pub mod learner;
pub mod loss;
pub mod methods;
pub mod optim;
pub mod recipe;
pub mod sampler;
pub mod train;
pub mod upkeep;

pub use splat4d::{Error, ErrorKind, Result};
