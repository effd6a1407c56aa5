//! Trains dynamic Gaussian scenes from posed captures: capture → initial Gaussians → stages of training → evaluation.
//!
//! ```
//! use splat4d_train::prelude::*;
//!
//! # fn main() -> Result<()> {
//! # let folder = tempfile::tempdir().expect("there is space for a run");
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
//!
//! # Code map
//!
//! A module imports only modules above it; `xtask/tests/tidy.rs` checks the order.
//!
//! | module | content |
//! |---|---|
//! | `settings.rs`, `settings/` | `settings!`: typed settings with defaults, ranges, units and documentation, declared next to what they set |
//! | `event.rs` | events that the trainer emits |
//! | `path_text.rs`, `files.rs` | paths that are not UTF-8 as text; opens regular files only |
//! | `encode.rs` | images as PNG and JPEG files, and in another size |
//! | `keypoints/` | SIFT keypoints and the image filters that they need |
//! | `capture/` | layouts read into one `Capture`, chosen by `layout.rs`; file lookup (`lookup.rs`), masks, findings (`account.rs`), pose conventions (`convention.rs`), depth, flow and tracks, photos or videos without times (`sequence.rs`), a model next to other poses (`beside.rs`), the image store with a byte budget, captures far from the origin (`offset.rs`), panoramas |
//! | `capture/foreign/`, `capture/colmap/`, `capture/transforms/`, `capture/evidence/`, `capture/lookup/`, `capture/geometry/` | exports of Metashape, RealityScan, Polycam, Record3D; unregistered COLMAP images and 4DGaussians' multipleview; frames and times of `transforms*.json`; whether poses can be right; images of one name with two endings; scans and meshes (.las, .pcd, .e57, .obj, .ply) and their depth from cameras |
//! | `vision/` | computer vision on posed images: temporal medians (`view.rs`), matching along epipolar lines, triangulation, plane sweep, scale, dense flow |
//! | `sampler.rs` | frames of a step, a pure function of seed, stage and step |
//! | `optim/` | Adam, sparse over the active set, sixteen rows at a time; position noise of MCMC |
//! | `loss/` | L1 + D-SSIM in one fused pass, contracts of losses (`terms.rs`), and every regulariser once, for any model: rigidity, rotation, isometry, ARAP, elastic, velocity, jerk, planes, tracking |
//! | `loss/image/`, `loss/transport/` | image losses as a list of `ImageTerm`s; transport losses with and without a filter |
//! | `train_state.rs`, `train_state/` | `TrainState`: scene, moments, statistics, and what cameras learn (exposure, poses, focal lengths, lenses, time offsets), which change together or not at all |
//! | `maintenance/` | maintenance between steps, one operation per file: ADC with splits in time, MCMC, relocation, guided sampling, pruning, merging, nodes, opacity reset, Morton order, the split into static and dynamic layers |
//! | `maintenance/importance/` | importance of every Gaussian in space and time, key masks |
//! | `methods/`, `methods/control/` | how each motion model is learned: a `Method` with its `Stage`s; settings of all models (`common.rs`); the automatic choice (`auto.rs`), the filter around any model, losses on nodes |
//! | `init/` | first Gaussians: points, depth maps and their velocities, points added along surfaces (`fill.rs`), visual hulls, random points in the common volume; the far shell (`shell.rs`) |
//! | `init/sky/` | cells of images that show far surroundings |
//! | `step/` | one step: the fixed chain (`chain.rs`), channels for losses, rolling shutter and motion blur (`shutter.rs`), lenses that are learnt (`lens.rs`), pixel weights (`emphasis.rs`), image losses, the engines on CPU and device (`engine.rs`, `resident.rs`), the trainer, the search of time offsets (`clocks.rs`), the schedule (`pace.rs`) |
//! | `recipe.rs`, `recipe/` | all settings of a run, and the programs and plans built from them (`parts.rs`); TOML, `--set`, old names without tables |
//! | `output/` | files and folders that commands write: atomic writes (`write.rs`), one owner per folder by lock and heartbeat (`owner.rs`), the list of our files (`list.rs`), what a command may find and `--force` (`folder.rs`), separation from inputs (`place.rs`), runs without a list (`legacy.rs`) |
//! | `blended.rs` | values of Gaussians as images blend them |
//! | `run/` | the run on disk: open, start and resume, from checkpoint to checkpoint, rollback, points and flow found in images, checks of priors and of measured geometry, memory estimate, `--minutes`, identity, metrics |
//! | `run/chunks/` | long captures in chunks: budget, plan, shared layer, training of a chunk, ties to neighbours, join |
//! | `run/follow/` | captures that are still being filmed: arrival of frames, changed Gaussians, the files of frames, nodes of the playback file |
//! | `labels.rs`, `features.rs` | labels from masks by expectation-maximisation; feature channels by conjugate gradients |
//! | `eval/` | metrics, colour matrices of cameras, LPIPS, errors of flow, alignment of held-out cameras, trajectory errors, floaters, `results.json` and `per_view.json` |
//! | `compress/`, `compress/quantise/` | settings, rounds of pruning, settings for a size; fine-tuning through the file's quantisation (straight-through) |

#![cfg_attr(docsrs, feature(doc_cfg))] // docs.rs marks what needs a feature

mod blended;
pub mod capture;
pub mod compress;
pub mod encode;
pub mod eval;
pub mod event;
pub mod features;
pub mod files;
pub mod init;
pub mod keypoints;
pub mod labels;
pub mod loss;
pub mod maintenance;
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
pub mod train_state;
pub mod training;
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
