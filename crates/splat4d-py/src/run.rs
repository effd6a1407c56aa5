//! Runs: folders that training writes.

use crate::errors::OrRaise;
use crate::plain::plain;
use crate::scene::{Scene, named};
use crate::settings::assignments;
use crate::workflows;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde_json::Value;
use splat4d_dynamics::learnt::Training;
use splat4d_dynamics::models::Model;
use splat4d_workflow::compressing::{self, CompressOptions, GUARD};
use splat4d_workflow::evaluating::{self, Measure};
use splat4d_workflow::predicting::{self, NODES, PredictOptions, STEPS};
use splat4d_workflow::{comparison, files, labelling, report, run_folder, status};
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

    /// Progress and workers of the run, as `splat4d status --json` prints them.
    fn status(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let status = py.detach(|| status::of(&self.path)).or_raise()?;
        plain(py, &serde_json::to_value(&status).expect("it is plain data"))
    }

    /// Renders the held-out views, compares them with their images, writes `results.json`, `per_view.json`, the renders
    /// and the report, and returns the means. `lpips_weights`: a .safetensors file; without it LPIPS is not computed.
    #[pyo3(signature = (*, device="auto", lpips_weights=None))]
    fn evaluate(&self, py: Python<'_>, device: &str, lpips_weights: Option<PathBuf>) -> PyResult<Py<PyAny>> {
        let measure = Measure { lpips_weights, device: named(device)? };
        workflows::run(py, |listener, stop| evaluating::evaluate(&self.path, &measure, stop, listener))?;
        self.results(py)
    }

    /// Writes `report.html`, the page that shows the run, from its files; returns its path.
    fn report(&self, py: Python<'_>) -> PyResult<PathBuf> {
        py.detach(|| report::write(&run_folder::Run::open(&self.path)?)).or_raise()
    }

    /// Makes the run smaller and faster to play: prunes, masks, quantises, fine-tunes, and measures before and after
    /// (docs/compression.md). Returns the result, a run with `scene.s4d`, in the folder `out` [RUN-compressed].
    ///
    /// `max_mb` limits the file's size in megabytes. `prune` is the share of the Gaussians to remove. `guard` is the largest
    /// loss of training views in dB. `settings` change those of the level: `rounds=3`. Ctrl-C stops with a checkpoint.
    #[pyo3(signature = (out=None, *, level=2, prune=None, max_mb=None, fine_tune=None, guard=GUARD, unpruned=false,
        evaluate=true, force=false, device="auto", **settings))]
    #[allow(clippy::too_many_arguments)]
    fn compress(
        &self,
        py: Python<'_>,
        out: Option<PathBuf>,
        level: u8,
        prune: Option<f64>,
        max_mb: Option<f64>,
        fine_tune: Option<usize>,
        guard: f64,
        unpruned: bool,
        evaluate: bool,
        force: bool,
        device: &str,
        settings: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<Self> {
        let set = assignments(settings)?.into_iter().map(|(name, value)| format!("{name}={value}")).collect();
        let options = CompressOptions {
            output: out,
            force,
            level,
            prune,
            max_bytes: max_mb.map(|mb| (mb * 1e6) as u64),
            fine_tune,
            guard,
            unpruned,
            set,
            eval: evaluate,
            device: named(device)?,
            ..CompressOptions::default()
        };
        let (path, _) =
            workflows::run(py, |listener, stop| compressing::compress(&self.path, &options, stop, listener))?;
        Ok(Self { path })
    }

    /// Learns a label and features of each Gaussian from the masks and feature images of the run's capture, or of
    /// `capture`, another of the same cameras (docs/labels.md). `rounds`: passes over the images.
    #[pyo3(signature = (capture=None, *, rounds=None))]
    fn label(&self, py: Python<'_>, capture: Option<PathBuf>, rounds: Option<usize>) -> PyResult<()> {
        workflows::run(py, |listener, stop| labelling::label(&self.path, capture.as_deref(), rounds, stop, listener))?;
        Ok(())
    }

    /// Forecasts the scene of a run that was trained with `observe` below 1, and compares with the part of its capture that
    /// was kept from training (docs/dynamics.md). `models`: names, or all. Returns `RUN/predict/predict.json`.
    #[pyo3(signature = (*, models=None, horizon=None, seeds=1, nodes=NODES, steps=STEPS, film=true))]
    #[allow(clippy::too_many_arguments)]
    fn predict(
        &self,
        py: Python<'_>,
        models: Option<Vec<String>>,
        horizon: Option<usize>,
        seeds: u64,
        nodes: usize,
        steps: usize,
        film: bool,
    ) -> PyResult<Py<PyAny>> {
        let models = match models {
            None => Model::ALL.to_vec(),
            Some(names) => names.iter().map(|n| Model::from_name(n)).collect::<splat4d::Result<_>>().or_raise()?,
        };
        let training = Training { steps, seed: 0 };
        let options =
            PredictOptions { models, horizon, seeds, nodes, training, film, ..PredictOptions::new(&self.path) };
        let (folder, _) = workflows::run(py, |listener, stop| predicting::predict(options, stop, listener))?;
        let text = files::read_text(&folder.join("predict.json")).or_raise()?;
        plain(py, &serde_json::from_str(&text).unwrap_or(Value::Null))
    }

    fn __repr__(&self) -> String {
        format!("Run({:?})", self.path)
    }
}

/// Compares runs, and results.json files of other programs, by their scores of held-out views. Writes the table to each of
/// `outputs` (.csv, .md, or .html with images side by side) and returns its rows.
#[pyfunction]
#[pyo3(signature = (runs, outputs=Vec::new()))]
pub(crate) fn compare(py: Python<'_>, runs: Vec<PathBuf>, outputs: Vec<PathBuf>) -> PyResult<Py<PyAny>> {
    let ((), records) = workflows::run(py, |listener, _| comparison::compare(&runs, &outputs, listener))?;
    plain(py, records.first().map_or(&Value::Null, |record| &record["runs"]))
}
