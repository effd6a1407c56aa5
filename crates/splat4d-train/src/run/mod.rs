//! The run on disk: a folder with its recipe, checkpoints, metrics and scene; resume, rollback, `--minutes`.

mod aligned;
mod budget;
pub mod checkpoint;
pub mod chunks;
mod clock;
pub mod corrected;
mod count;
pub mod dataset;
mod far;
mod flows;
pub mod follow;
mod identity;
mod info;
mod left;
mod measured;
mod memory;
mod metrics;
mod minutes;
mod open;
mod points;
mod priors;
pub mod probe;
mod refine;
mod session;
mod snapshot;
mod start;

#[cfg(test)]
pub(crate) mod tests;

pub use clock::Stopwatch;
pub use info::recorded_elsewhere;
pub use memory::{available_memory, memory_estimate, peak_memory};
#[cfg(test)]
pub(crate) use open::OpenCapture;
pub(crate) use open::training_frames;
pub(crate) use open::{learnable, scale};
pub use open::{open_capture, open_frames, plan};
pub use points::with_found;
pub(crate) use refine::{Refine, refine};
pub use session::{Outcome, OwnLoss, TrainOptions};
pub use start::{Forecast, forecast, open_run, resume, resume_with, run_options, train};
