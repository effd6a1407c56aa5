//! The scene at one time.

use crate::arrays::{rows, shaped};
use crate::errors::bad_input;
use crate::scene_arrays::Shapes;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use splat4d::layers::{self, Evaluation};
use splat4d::scene::Time;
use splat4d_workflow::source::Source;
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
    /// Source of spherical harmonics; none: they were given.
    seen: Option<(Arc<Source>, Evaluation)>,
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
            seen: Some((source.clone(), seen)),
            sh: PyOnceLock::new(),
        })
    }

    /// The arrays as a scene takes them.
    pub(crate) fn shapes(&self, py: Python<'_>) -> PyResult<Shapes> {
        let [means, quats, scales, opacities] =
            [&self.means, &self.quats, &self.scales, &self.opacities].map(|array| array.bind(py));
        let sh = self.sh(py)?;
        Shapes::new(means, quats, scales, opacities, Some(sh.bind(py)), None, false)
    }
}

#[pymethods]
impl Gaussians {
    /// Gaussians of your own: `means` [N, 3], `quats` [N, 4] (wxyz, of any length), `scales` [N, 3] and `opacities` [N]
    /// from 0 to 1 (standard deviations and opacities themselves, not logarithms and logits), and either `sh` [N, K, 3]
    /// with K 1, 4, 9 or 16, or `colors` [N, 3] from 0 to 1.
    #[new]
    #[pyo3(signature = (means, quats, scales, opacities, *, sh=None, colors=None, time=0.0))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        means: &Bound<'_, PyAny>,
        quats: &Bound<'_, PyAny>,
        scales: &Bound<'_, PyAny>,
        opacities: &Bound<'_, PyAny>,
        sh: Option<&Bound<'_, PyAny>>,
        colors: Option<&Bound<'_, PyAny>>,
        time: f64,
    ) -> PyResult<Self> {
        if !time.is_finite() {
            return Err(bad_input(format!("invalid time {time}"), "Give seconds"));
        }
        let shapes = Shapes::new(means, quats, scales, opacities, sh, colors, false)?;
        let count = shapes.means.rows;
        let coefficients = shapes.sh.width / 3;
        let gathered = PyOnceLock::new();
        let _ = gathered.set(py, shaped(py, shapes.sh.data, &[count, coefficients, 3])?);
        Ok(Self {
            time,
            means: shaped(py, shapes.means.data, &[count, 3])?,
            quats: shaped(py, unit(shapes.quats.data), &[count, 4])?,
            scales: shaped(py, shapes.scales.data, &[count, 3])?,
            opacities: shaped(py, shapes.opacities.data, &[count])?,
            count,
            seen: None,
            sh: gathered,
        })
    }

    /// [N, K, 3] spherical harmonics, float32; gathered on first access.
    #[getter]
    fn sh(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let made = self.sh.get_or_try_init(py, || {
            let (source, seen) = self.seen.as_ref().expect("colours that were given are stored");
            let (sh, k) = py.detach(|| layers::Gaussians::sh(&source.scene, seen));
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

/// Quaternions of length 1. Their lengths are not 0.
fn unit(mut quats: Vec<f32>) -> Vec<f32> {
    for q in quats.chunks_exact_mut(4) {
        let length = q.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt();
        q.iter_mut().for_each(|x| *x = (f64::from(*x) / length) as f32);
    }
    quats
}
