//! Metrics of two images.

use crate::arrays::pair;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat4d_train::eval::{Score, ViewContext, score_view};

/// PSNR (dB), SSIM, MS-SSIM and D-SSIM of two images [h, w, 3] as in `splat4d eval`; metrics that are undefined for
/// images of this size are left out.
#[pyfunction]
pub(crate) fn metrics<'py>(
    py: Python<'py>,
    render: &Bound<'py, PyAny>,
    truth: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyDict>> {
    let (a, b) = pair(render, truth)?;
    let view = py.detach(|| score_view("", &a, &b, &ViewContext::default()));
    let out = PyDict::new(py);
    for (key, score) in view.scores {
        if let Score::Value(value) = score {
            out.set_item(key, value)?;
        }
    }
    Ok(out)
}
