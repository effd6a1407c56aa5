//! Runs: folders that training writes.

use crate::errors::OrRaise;
use crate::plain::plain;
use crate::scene::Scene;
use pyo3::prelude::*;
use serde_json::Value;
use splat4d_workflow::evaluating::{self, Measure};
use splat4d_workflow::events::ignore;
use splat4d_workflow::run_folder;
use std::path::PathBuf;

/// A run: a folder with its recipe, checkpoints, scene and scores.
#[pyclass(frozen, module = "splat4d")]
pub(crate) struct Run {
    /// Its folder.
    #[pyo3(get)]
    pub(crate) path: PathBuf,
}

#[pymethods]
impl Run {
    /// Opens the run in a folder.
    #[new]
    pub(crate) fn new(path: PathBuf) -> PyResult<Self> {
        run_folder::Run::open(&path).or_raise()?;
        Ok(Self { path })
    }

    /// Whether training has ended.
    #[getter]
    fn finished(&self) -> bool {
        run_folder::Run::is_finished(&self.path)
    }

    /// Steps taken.
    #[getter]
    fn iteration(&self) -> PyResult<Option<usize>> {
        Ok(run_folder::Run::open(&self.path).or_raise()?.iteration())
    }

    /// The scene: the trained one, or that of the newest checkpoint.
    fn scene(&self, py: Python<'_>) -> PyResult<Scene> {
        Scene::open(py, self.path.clone())
    }

    /// `run.json`: device, timings, memory.
    #[getter]
    fn info(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        plain(py, &run_folder::Run::open(&self.path).or_raise()?.info)
    }

    /// Means over the held-out views, as in `results.json`, or None if not measured.
    #[getter]
    fn results(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let results = run_folder::Run::open(&self.path).or_raise()?.results;
        plain(py, &results.unwrap_or(Value::Null))
    }

    /// Renders the held-out views, compares them with their images, writes `results.json`, `per_view.json` and the
    /// renders, and returns the means.
    fn evaluate(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        py.detach(|| evaluating::evaluate(&self.path, &Measure::default(), &ignore)).or_raise()?;
        self.results(py)
    }

    fn __repr__(&self) -> String {
        format!("Run({:?})", self.path)
    }
}
