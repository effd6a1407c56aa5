//! What training minimises: the picture loss and the regularisers, each with its gradient.
//!
//! Every function returns its value and writes or adds its gradient; none keeps state that a result depends on.

pub mod arap;
pub mod graph;
pub mod image;
mod kernel;
pub mod motion;
mod near;
pub mod neighbourhood;
pub mod photometric;
pub mod planes;
pub mod rigid;
pub mod scene;
pub mod terms;
pub mod tracked;
pub mod transport;

pub use photometric::{LossValue, Photometric};
