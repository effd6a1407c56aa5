//! What the `splat4d` command does beyond parsing and printing, as functions for Rust and Python: open runs and scenes, render
//! their channels, bake, convert and export. Functions report [`events::Event`]s and print nothing.
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
//! # Code map
//!
//! A module imports only modules above it; `xtask/tests/tidy.rs` checks the order.
//!
//! | module | content |
//! |---|---|
//! | `events.rs` | what workflows report, and listeners |
//! | `files.rs`, `deadline.rs` | files and numbers in words; the time that is left of `--minutes` |
//! | `camera_file.rs`, `paths/` | camera files; orbits, data-set cameras and key-framed camera paths |
//! | `run_folder.rs`, `sequence.rs` | run folders; numbered files |
//! | `source.rs`, `source/` | scenes of runs and files, of other programs' folders and archives |
//! | `draw.rs` | renders a scene's channels as images |
//! | `baking.rs`, `baking/` | a scene as a playback file, within bytes and likeness |
//! | `playable.rs` | anything that plays as a playback file |
//! | `converting.rs`, `exporting.rs` | formats of other programs; one time as .ply, the whole as a page |

#![allow(missing_docs)] // its interface is not stable yet

pub mod baking;
pub mod camera_file;
pub mod converting;
pub mod deadline;
pub mod draw;
pub mod events;
pub mod exporting;
pub mod files;
pub mod paths;
pub mod playable;
pub mod run_folder;
pub mod sequence;
pub mod source;

pub use splat4d::{Error, ErrorKind, Result};
