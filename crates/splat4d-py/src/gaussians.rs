//! The scene at one moment.

use crate::arrays::{rows, shaped};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use splat4d::layers::{self, Evaluation};
use splat4d::scene::Time;
use splat4d_cli::source::Source;
use std::sync::Arc;

/// The Gaussians alive at one time as NumPy arrays, activated, as gsplat's `rasterization` takes them.
#[pyclass(frozen, module = "splat4d")]
pub(crate) struct Gaussians {
    /// Second of the scene.
    #[pyo3(get)]
    time: f64,
    /// [N, 3] world, float32.
    #[pyo3(get)]
    means: Py<PyAny>,
    /// [N, 4] unit, wxyz.
    #[pyo3(get)]
    quats: Py<PyAny>,
    /// [N, 3] standard deviations, scene units.
    #[pyo3(get)]
    scales: Py<PyAny>,
    /// [N] in (0, 1), lifespan applied.
    #[pyo3(get)]
    opacities: Py<PyAny>,
    count: usize,
    source: Arc<Source>,
    seen: Evaluation,
    sh: PyOnceLock<Py<PyAny>>,
}

impl Gaussians {
    pub(crate) fn at(py: Python<'_>, source: &Arc<Source>, t: f64) -> PyResult<Self> {
        let (all, seen) = py.detach(|| {
            let mut seen = Evaluation::default();
            source.scene.at(Time(t), &mut seen);
            (layers::Gaussians::of(&source.scene, &seen), seen)
        });
        let count = all.means.len();
        Ok(Self {
            time: t,
            means: rows(py, all.means)?,
            quats: rows(py, all.quats)?,
            scales: rows(py, all.scales)?,
            opacities: shaped(py, all.opacities, &[count])?,
            count,
            source: source.clone(),
            seen,
            sh: PyOnceLock::new(),
        })
    }
}

#[pymethods]
impl Gaussians {
    /// [N, K, 3] spherical harmonics, float32; gathered on first access.
    #[getter]
    fn sh(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let made = self.sh.get_or_try_init(py, || {
            let (sh, k) = py.detach(|| layers::Gaussians::sh(&self.source.scene, &self.seen));
            shaped(py, sh, &[self.count, k, 3])
        })?;
        Ok(made.clone_ref(py))
    }

    /// Number of Gaussians.
    fn __len__(&self) -> usize {
        self.count
    }

    fn __repr__(&self) -> String {
        format!("Gaussians({} at {} s)", self.count, self.time)
    }
}
