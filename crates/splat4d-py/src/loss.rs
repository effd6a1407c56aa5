//! A loss written in Python next to the recipe's: it gets the image and the truth, and returns a value and a gradient.

use crate::arrays::{numbers, pair, picture};
use crate::errors::bad_input;
use numpy::PyUntypedArrayMethods;
use pyo3::prelude::*;
use splat4d::scene::Planes;
use splat4d_train::loss::Photometric;
use splat4d_train::loss::image::{self, ImageTerm, LossGrads, Needs, Shown};
use splat4d_train::loss::terms::StepInfo;
use splat4d_train::run::OwnLoss;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

/// Exceptions of a run's Python functions, and its stop flag. The first exception counts.
#[derive(Default)]
pub(crate) struct Raised {
    pub(crate) stop: AtomicBool,
    error: Mutex<Option<PyErr>>,
}

impl Raised {
    pub(crate) fn raise(&self, error: PyErr) {
        self.error.lock().unwrap_or_else(|e| e.into_inner()).get_or_insert(error);
        self.stop.store(true, Ordering::Relaxed);
    }

    pub(crate) fn take(&self) -> Option<PyErr> {
        self.error.lock().unwrap_or_else(|e| e.into_inner()).take()
    }
}

/// The view that a loss function compares.
#[pyclass(frozen, get_all, module = "splat4d")]
pub(crate) struct View {
    /// Second of the scene.
    time: f64,
    /// Index of the image among the training images.
    frame: usize,
    /// Index of its camera in the capture.
    camera: usize,
    /// Steps taken before this one.
    iteration: usize,
}

/// The term that calls the function.
struct RunRequest {
    function: Py<PyAny>,
    raised: Arc<Raised>,
}

/// The function as a loss of a run.
pub(crate) fn own_loss(function: Py<PyAny>, raised: &Arc<Raised>) -> OwnLoss {
    let raised = raised.clone();
    OwnLoss(Arc::new(move || {
        let function = Python::attach(|py| function.clone_ref(py));
        Box::new(RunRequest { function, raised: raised.clone() })
    }))
}

impl ImageTerm for RunRequest {
    fn needs(&self, _: &image::View<'_>) -> Needs {
        Needs::default()
    }

    fn eval(&mut self, info: &StepInfo, view: &image::View<'_>, shown: &Shown<'_>, d: &mut LossGrads) -> f64 {
        let seen = View { time: view.t.0, frame: view.frame, camera: view.rig, iteration: info.iteration };
        let answer = Python::attach(|py| self.request(py, seen, shown.color, view.truth, d.color.add()));
        answer.unwrap_or_else(|error| {
            self.raised.raise(error);
            // Not a finite number: the step counts for nothing.
            f64::NAN
        })
    }
}

impl RunRequest {
    /// The value; the gradient is added to `d`.
    fn request(
        &self,
        py: Python<'_>,
        view: View,
        shown: &Planes<f32>,
        truth: &Planes<f32>,
        d: &mut Planes<f32>,
    ) -> PyResult<f64> {
        // Copies, because Python may keep its arguments.
        let answer = self.function.call1(py, (picture(py, shown.clone())?, picture(py, truth.clone())?, view))?;
        let wrong = "the loss did not return a value and a gradient";
        let remedy = "Return (float, array [h, w, 3])";
        let (value, gradient): (f64, Bound<'_, PyAny>) = answer.extract(py).map_err(|_| bad_input(wrong, remedy))?;
        let gradient = numbers::<f32>(&gradient, "the loss's gradient")?;
        if gradient.shape() != [shown.height, shown.width, shown.channels] {
            let what = format!("the loss's gradient has the shape {:?}", gradient.shape());
            let wanted = format!("Return that of the image, [{}, {}, {}]", shown.height, shown.width, shown.channels);
            return Err(bad_input(what, &wanted));
        }
        let all = gradient.as_array();
        if !value.is_finite() || all.iter().any(|x| !x.is_finite()) {
            return Err(bad_input("the loss's value or gradient is NaN or infinity", "Return finite numbers"));
        }
        for (c, plane) in d.data.chunks_exact_mut(shown.pixels().max(1)).enumerate() {
            let channel = all.index_axis(numpy::ndarray::Axis(2), c);
            plane.iter_mut().zip(channel.iter()).for_each(|(d, x)| *d += x);
        }
        Ok(value)
    }
}

/// The image loss of training, (1 − λ)·L1 + λ·(1 − SSIM) with λ = `lambda_dssim`, of two images [h, w, 3]: value, and
/// gradient to `render` [h, w, 3].
#[pyfunction]
#[pyo3(signature = (render, truth, lambda_dssim=0.2))]
pub(crate) fn photometric<'py>(
    py: Python<'py>,
    render: &Bound<'py, PyAny>,
    truth: &Bound<'py, PyAny>,
    lambda_dssim: f32,
) -> PyResult<(f64, Bound<'py, PyAny>)> {
    if !(0.0..=1.0).contains(&lambda_dssim) {
        return Err(bad_input(format!("lambda_dssim is {lambda_dssim}"), "Give 0 (L1 alone) to 1 (SSIM alone)"));
    }
    let (a, b) = pair(render, truth)?;
    let (value, gradient) = py.detach(|| {
        let mut gradient = Planes::default();
        let value = Photometric::<f32>::new(lambda_dssim).loss_and_grad(&a, &b, None, &mut gradient);
        (value.total, gradient)
    });
    Ok((value, picture(py, gradient)?))
}
