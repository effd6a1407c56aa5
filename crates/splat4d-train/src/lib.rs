//! Learns moving Gaussian scenes from posed captures: capture → initial Gaussians → stages of training → evaluation.
//!
//! ```
//! use splat4d_train::prelude::*;
//!
//! # fn main() -> Result<()> {
//! # let folder = tempfile::tempdir().expect("there is room for a run");
//! # let run = folder.path().join("run");
//! let mut recipe = Recipe::default();
//! for setting in ["motion=spacetime", "iterations=20", "downscale=8", "max_frames=2"] {
//!     recipe.set(setting)?;
//! }
//! let training = Training::open("../../examples/knight", recipe)?;
//! let trained = training.listen(|event| if let Event::Warning { message } = event { eprintln!("{message}") }).run(&run)?;
//! let psnr = trained.evaluate()?.held("PSNR").expect("the capture holds views out");
//! println!("{} Gaussians, {psnr:.2} dB", trained.scene()?.len());
//! # assert!(psnr > 5.0, "{psnr}");
//! # Ok(())
//! # }
//! ```
//!
//! The trainer only emits [`event::Event`]s; progress bars, logs and viewers listen.

mod blended;
pub mod capture;
pub mod compress;
pub mod eval;
pub mod event;
pub mod features;
pub mod files;
pub mod init;
pub mod keypoints;
pub mod labels;
pub mod learner;
pub mod loss;
pub mod methods;
pub mod optim;
pub mod output;
pub mod path_text;
pub mod recipe;
pub mod run;
pub mod sampler;
pub mod settings;
pub mod step;
pub mod text;
pub mod training;
pub mod upkeep;
pub mod vision;

pub use splat4d::{Error, ErrorKind, Result};

/// The names that most programs need.
pub mod prelude {
    pub use crate::capture::{Capture, CaptureOptions};
    pub use crate::eval::run::Scores;
    pub use crate::event::Event;
    pub use crate::recipe::Recipe;
    pub use crate::run::{Outcome, TrainOptions, resume};
    pub use crate::training::{Trained, Training};
    pub use crate::{Error, ErrorKind, Result};
}
