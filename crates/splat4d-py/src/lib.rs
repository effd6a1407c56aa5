//! The extension module of the Python package `splat4d` (docs/python.md): scenes as NumPy arrays, captures, training,
//! and the command. The interpreter lock is released during long work; errors become `splat4d.Error` with their own
//! text.
//!
//! # Code map
//!
//! A module imports only modules above it; `xtask/tests/tidy.rs` checks the order.
//!
//! | module | content |
//! |---|---|
//! | `errors.rs`, `workflows.rs`, `arrays.rs`, `plain.rs`, `settings.rs` | errors, workflows with Python's signals, NumPy in and out, plain values, settings by name |
//! | `camera.rs`, `scene_arrays.rs`, `gaussians.rs` | cameras, arrays into scenes, Gaussians at a time |
//! | `from_arrays.rs` | images in memory become a capture on disk |
//! | `metrics.rs`, `loss.rs`, `motion.rs` | metrics; losses and motion models written in Python |
//! | `rendering.rs`, `scene.rs` | renders with gradients, scenes |
//! | `run.rs`, `capture.rs`, `recording.rs`, `train.rs` | runs, captures, videos as captures, training |

mod arrays;
mod camera;
mod capture;
mod errors;
mod from_arrays;
mod gaussians;
mod loss;
mod metrics;
mod motion;
mod plain;
mod recording;
mod rendering;
mod run;
mod scene;
mod scene_arrays;
mod settings;
mod train;
mod workflows;

use pyo3::prelude::*;

/// Native part of splat4d; `import splat4d` instead.
#[pymodule]
mod _native {
    #[pymodule_export]
    use crate::camera::Camera;
    #[pymodule_export]
    use crate::capture::{Capture, Frame};
    #[pymodule_export]
    use crate::errors::Error;
    #[pymodule_export]
    use crate::gaussians::Gaussians;
    #[pymodule_export]
    use crate::loss::{View, photometric};
    #[pymodule_export]
    use crate::metrics::metrics;
    #[pymodule_export]
    use crate::recording::{import_videos, info};
    #[pymodule_export]
    use crate::rendering::Rendering;
    #[pymodule_export]
    use crate::run::{Run, compare};
    #[pymodule_export]
    use crate::scene::{Scene, Tracks, open};
    #[pymodule_export]
    use crate::train::{resume, train};

    use super::*;
    use crate::errors::OrRaise;
    use std::ffi::OsString;
    use std::path::PathBuf;

    #[pymodule_init]
    fn init(m: &Bound<'_, PyModule>) -> PyResult<()> {
        m.add("__version__", env!("CARGO_PKG_VERSION"))
    }

    /// Runs the command with these words, the first its name; returns its exit code.
    #[pyfunction]
    fn main(py: Python<'_>, words: Vec<OsString>) -> u8 {
        py.detach(|| splat4d_cli::main_from(words))
    }

    /// Runs one command with its options, quietly: `command("bake", "runs/knight", "-o", "knight.s4d")`. Returns the objects that
    /// the command prints with `--json` (docs/events.md), a list of dicts.
    #[pyfunction]
    #[pyo3(signature = (*words))]
    fn command(py: Python<'_>, words: Vec<PathBuf>) -> PyResult<Py<PyAny>> {
        let words: Vec<OsString> = words.into_iter().map(PathBuf::into_os_string).collect();
        let objects = py.detach(|| splat4d_cli::call(&words)).or_raise()?;
        plain::plain(py, &serde_json::Value::Array(objects))
    }
}
