//! The work of the `splat4d` command without parsing and printing, as functions for Rust and Python: import, inspect,
//! train, open runs and scenes, render their channels, bake, convert, export, localise, evaluate, compress, label,
//! predict, edit and report. Functions take typed options, report [`events::Event`]s and print nothing.
//!
//! ```no_run
//! use splat4d_workflow::baking::{self, Baking};
//! use splat4d_workflow::events::Event;
//! use splat4d_workflow::source::Source;
//! use std::path::Path;
//!
//! # fn main() -> splat4d::Result<()> {
//! let run = Path::new("runs/knight");
//! let source = Source::open(run)?;
//! let listen = |event: &Event<'_>| if let Event::Warning(text) = event { eprintln!("{text}") };
//! baking::bake_into(&source, "knight", Path::new("knight.s4d"), &Baking::default(), &listen)?;
//! # Ok(())
//! # }
//! ```
//!
//! # Features
//!
//! `gpu` adds the GPU renderer. `dynamics` (forecasts), `import` (captures from videos, the doctor) and `serve` (the
//! player's server) are on by default; without one its functions are missing, or return an error that names it.
//! `storage` adds runs and captures on object storage, `models` the runtime of networks.
//!
//! # Code map
//!
//! A module imports only modules above it; `xtask/tests/tidy.rs` checks the order.
//!
//! | module | content |
//! |---|---|
//! | `events.rs`, `parts.rs` | what workflows report, and listeners; parts that a small build leaves out |
//! | `files.rs`, `deadline.rs` | files and numbers in words; the time that is left of `--minutes` |
//! | `camera_file.rs`, `paths/` | camera files; orbits, data-set cameras and key-framed camera paths |
//! | `run_folder.rs`, `status.rs`, `sequence.rs` | run folders; how far a run is; numbered files |
//! | `sound.rs` | sound of captures, runs and files: converted, cut |
//! | `source.rs`, `source/` | scenes of runs and files, of other programs' folders and archives |
//! | `channels.rs`, `device.rs`, `draw.rs`, `draw/`, `video.rs`, `raw_values.rs`, `rendering.rs`, `rendering/` | normals and numbers of Gaussians as image channels; renders a scene's channels as images, films, arrays; shutter, lens, spheres, layers for compositing |
//! | `capture_page.rs` | cameras, images and points of a capture, for the player's page |
//! | `point_queries.rs` | points followed through a scene |
//! | `measure.rs`, `measure/` | how scenes and files play: frames per second, bytes, Gaussians alive |
//! | `activity.rs` | which Gaussians of a scene are active when |
//! | `folding.rs` | colours that a network makes, as spherical harmonics |
//! | `baking.rs`, `baking/` | a scene as a playback file, within bytes and likeness |
//! | `playable.rs`, `growing.rs` | anything that plays as a playback file; that of a long capture, which grows during training |
//! | `programs.rs`, `converting.rs`, `exporting.rs` | axes and units of other programs, their formats; .ply files, a page, tracks |
//! | `meshing.rs`, `meshing/` | surfaces over time as triangle meshes |
//! | `localising.rs`, `localising/` | pose and time of images |
//! | `ground_truth.rs`, `ground_truth/` | errors against tracks of points in space that a capture states |
//! | `comparing.rs`, `report/`, `comparison.rs` | scores of several runs; `report.html`, rendered without a library; tables |
//! | `evaluating.rs`, `adopting.rs`, `foreign.rs`, `still_baseline.rs` | what follows training: scores, playback file, film, report; a scene of another program as a run; scores of any scene; of a static one |
//! | `labelling.rs`, `chunked.rs`, `compressing.rs` | labels, long captures in chunks, compression with a guard |
//! | `training.rs` | a capture becomes a run, which is measured, filmed and reported |
//! | `following.rs` | captures that are still being filmed |
//! | `models/` | networks that users bring |
//! | `importing.rs`, `inspecting.rs`, `inspecting/` | videos become a capture, also matched by a network; what a capture, run or file contains |
//! | `storage/` | captures and runs on object storage |
//! | `predicting.rs`, `predicting/` | forecasts, compared with the later images |
//! | `editing.rs`, `picking.rs`, `editor.rs` | lists of edits; edits from a page of the player |
//! | `aligning.rs` | points clicked in a page, for an import |
//! | `priors.rs`, `priors/` | depth, flow, masks and tracks from networks |
//! | `recipe_schema.rs` | a JSON Schema of recipes, for editors |
//! | `texts.rs` | texts that users write, for the fuzz targets |

#![cfg_attr(docsrs, feature(doc_cfg))] // docs.rs marks what needs a feature
#![allow(missing_docs)] // its interface is not stable yet

pub mod activity;
pub mod adopting;
#[cfg(feature = "import")]
pub mod aligning;
pub mod baking;
pub mod camera_file;
pub mod capture_page;
mod channels;
pub mod chunked;
pub mod comparing;
pub mod comparison;
pub mod compressing;
pub mod converting;
pub mod deadline;
pub mod device;
pub mod draw;
pub mod editing;
pub mod editor;
pub mod evaluating;
pub mod events;
pub mod exporting;
pub mod files;
pub mod folding;
pub mod following;
pub mod foreign;
pub mod ground_truth;
pub mod growing;
#[cfg(feature = "import")]
pub mod importing;
pub mod inspecting;
pub mod labelling;
pub mod localising;
pub mod measure;
pub mod meshing;
pub mod models;
pub mod parts;
pub mod paths;
mod picking;
pub mod playable;
pub mod point_queries;
#[cfg(feature = "dynamics")]
pub mod predicting;
pub mod priors;
pub mod programs;
pub mod raw_values;
pub mod recipe_schema;
pub mod rendering;
pub mod report;
pub mod run_folder;
pub mod sequence;
mod sound;
pub mod source;
pub mod status;
pub mod still_baseline;
#[cfg(any(test, feature = "storage"))]
pub mod storage;
pub mod texts;
pub mod training;
pub mod video;

pub use splat4d::{Error, ErrorKind, Result};
