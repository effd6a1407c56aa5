//! Training: the fixed chain of a step, the trainer that repeats it, and the run that keeps it safe on disk.

mod batch;
pub mod chain;
mod channels;
pub mod checkpoint;
pub mod dataset;
pub mod engine;
pub mod loss;
pub mod memory;
pub mod minutes;
pub mod refine;
pub mod run;
mod snapshot;
pub mod trainer;

#[cfg(test)]
pub(crate) mod tests;

pub use crate::capture::frames;
pub use crate::sampler;
pub use refine::{Refine, Refined, refine};
pub use run::{Outcome, TrainOptions, resume, resume_with, train};
