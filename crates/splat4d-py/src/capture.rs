//! Captures: posed, timed images on disk.

use crate::arrays::{picture, plane, rows, shaped};
use crate::camera::Camera;
use crate::errors::{OrRaise, bad_input, warn};
use crate::from_arrays::{Arrays, write};
use crate::plain::plain;
use crate::settings::set;
use crate::workflows;
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use splat4d_train::capture::{self, CaptureSettings, ImageStore, Split};
use splat4d_train::recipe::Recipe;
use splat4d_train::run::open_capture;
use splat4d_workflow::priors::{self, Part, Priors};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

/// Memory for decoded images that were requested lately.
const STORE_BYTES: usize = 64 << 20;

/// Images with poses and times, in any layout that `splat4d info` reads.
#[pyclass(frozen, module = "splat4d")]
pub(crate) struct Capture {
    /// Its folder or marker file.
    #[pyo3(get)]
    pub(crate) path: PathBuf,
    /// How it was opened; training on it begins with the same.
    pub(crate) settings: CaptureSettings,
    capture: Arc<capture::Capture>,
    store: ImageStore,
    _temporary: Option<Temporary>,
}

/// A temporary folder (Python's), removed with its content when this is dropped.
pub(crate) struct Temporary(Py<PyAny>);

impl Drop for Temporary {
    fn drop(&mut self) {
        // What cannot be removed the system clears away some day.
        let _ = Python::attach(|py| self.0.call_method0(py, "cleanup"));
    }
}

impl Capture {
    pub(crate) fn open(py: Python<'_>, path: PathBuf, recipe: &Recipe, temporary: Option<Temporary>) -> PyResult<Self> {
        let capture = Arc::new(py.detach(|| open_capture(&path, recipe)).or_raise()?);
        warn(py, &capture.warnings)?;
        let store = ImageStore::new(capture.clone(), STORE_BYTES);
        Ok(Self { path, settings: recipe.capture.clone(), capture, store, _temporary: temporary })
    }

    fn load(&self, py: Python<'_>, i: isize) -> PyResult<capture::Picture> {
        let at = self.frame_at(i)?;
        py.detach(|| self.store.load(at).map(|stored| stored.to_picture())).or_raise()
    }

    fn frame_at(&self, i: isize) -> PyResult<usize> {
        let count = self.capture.frames.len();
        let at = if i < 0 { i + count as isize } else { i };
        usize::try_from(at)
            .ok()
            .filter(|at| *at < count)
            .ok_or_else(|| PyIndexError::new_err(format!("there is no frame {i}: the capture has {count}")))
    }
}

#[pymethods]
impl Capture {
    /// `settings`: settings of the table `capture`, such as `downscale=2` or `hold_out="camera=0"`.
    #[new]
    #[pyo3(signature = (path, **settings))]
    fn new(py: Python<'_>, path: PathBuf, settings: Option<&Bound<'_, PyDict>>) -> PyResult<Self> {
        let mut recipe = Recipe::default();
        for name in set(&mut recipe, settings)? {
            if !Recipe::key_of(&name).starts_with("capture.") {
                return Err(bad_input(format!("`{name}` names no capture"), "Give it to train"));
            }
        }
        Self::open(py, path, &recipe, None)
    }

    /// Makes a capture of images in memory. `images`: for each camera its frames [h, w, 3], float32 in [0, 1] or uint8
    /// (a list, or an array [T, h, w, 3]); `cameras`: one Camera each, or a list with one per frame; `times`: seconds,
    /// for all cameras or a list for each; `points`: [N, 3], with `colors` [N, 3] in [0, 1]; `hold_out`: names of
    /// held-out cameras.
    ///
    /// Images are stored as lossless files in `folder`, so that runs can be resumed; without one, in a temporary folder
    /// that is deleted with the capture.
    #[classmethod]
    #[pyo3(signature = (images, cameras, times=None, points=None, *, colors=None, names=None, fps=None, up=None,
                        hold_out=None, folder=None))]
    #[allow(clippy::too_many_arguments)]
    fn from_arrays(
        _class: &Bound<'_, PyType>,
        py: Python<'_>,
        images: &Bound<'_, PyAny>,
        cameras: &Bound<'_, PyAny>,
        times: Option<&Bound<'_, PyAny>>,
        points: Option<&Bound<'_, PyAny>>,
        colors: Option<&Bound<'_, PyAny>>,
        names: Option<Vec<String>>,
        fps: Option<f64>,
        up: Option<&Bound<'_, PyAny>>,
        hold_out: Option<Vec<String>>,
        folder: Option<PathBuf>,
    ) -> PyResult<Self> {
        let (folder, temporary) = match folder {
            Some(folder) => (folder, None),
            None => {
                let made = py.import("tempfile")?.call_method0("TemporaryDirectory")?;
                (made.getattr("name")?.extract()?, Some(Temporary(made.unbind())))
            }
        };
        let arrays = Arrays { images, cameras, times, points, colors, names, fps, up, hold_out };
        write(py, &arrays, &folder)?;
        Self::open(py, folder, &Recipe::default(), temporary)
    }

    /// Runs networks, `{"depth": "d.onnx"}` (docs/networks.md), and returns figures. A capture that is opened later has the results.
    #[pyo3(signature = (networks, described=None, force=false))]
    fn priors(
        &self,
        py: Python<'_>,
        networks: BTreeMap<String, PathBuf>,
        described: Option<BTreeMap<String, String>>,
        force: bool,
    ) -> PyResult<Py<PyAny>> {
        let part = |word: &str| {
            let found = Part::ALL.into_iter().find(|part| part.name() == word);
            found.ok_or_else(|| {
                bad_input(format!("\"{word:.40}\" names no use of a network"), "Write depth, flow, masks or tracks")
            })
        };
        let networks = networks.into_iter().map(|(word, path)| Ok((part(&word)?, path))).collect::<PyResult<_>>()?;
        let described = described
            .unwrap_or_default()
            .into_iter()
            .map(|(word, name)| Ok((part(&word)?, name)))
            .collect::<PyResult<_>>()?;
        let request = Priors { capture: self.path.clone(), networks, described, force };
        let (made, _) = workflows::run(py, |listener, stop| priors::priors(&request, stop, listener))?;
        plain(py, &made.json())
    }

    /// Name of the capture.
    #[getter]
    fn name(&self) -> &str {
        &self.capture.name
    }

    /// Names of the cameras.
    #[getter]
    fn cameras(&self) -> Vec<String> {
        self.capture.cameras.iter().map(|c| c.name.clone()).collect()
    }

    /// All distinct times, seconds.
    #[getter]
    fn times(&self) -> Vec<f64> {
        self.capture.times()
    }

    /// Frames per second.
    #[getter]
    fn fps(&self) -> f64 {
        self.capture.fps
    }

    /// Up direction in the world.
    #[getter]
    fn up(&self) -> [f64; 3] {
        self.capture.up
    }

    /// World coordinates of the origin; zero unless the capture is far from it.
    #[getter]
    fn offset(&self) -> [f64; 3] {
        self.capture.offset
    }

    /// What was assumed or looks wrong, a sentence or two each.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.capture.warnings.clone()
    }

    /// The initial points: positions [N, 3] float64 and colours [N, 3] float32 in [0, 1], or None.
    #[getter]
    fn points(&self, py: Python<'_>) -> PyResult<Option<(Py<PyAny>, Py<PyAny>)>> {
        let Some(cloud) = &self.capture.points else { return Ok(None) };
        let flat: Vec<f64> = cloud.points.iter().flatten().copied().collect();
        Ok(Some((shaped(py, flat, &[cloud.points.len(), 3])?, rows(py, cloud.colors.clone())?)))
    }

    /// Number of images.
    fn __len__(&self) -> usize {
        self.capture.frames.len()
    }

    /// Image i with its camera and time.
    fn __getitem__(&self, i: isize) -> PyResult<Frame> {
        let at = self.frame_at(i)?;
        let frame = &self.capture.frames[at];
        let split = match self.capture.split(at) {
            Split::Train => "train",
            Split::Held => "test",
            Split::Validation => "val",
            Split::Future => "future",
        };
        Ok(Frame {
            number: at,
            name: self.capture.cameras[frame.camera].name.clone(),
            camera: Camera(frame.view.clone()),
            time: frame.time.0,
            index: frame.index,
            split,
            file: frame.image.clone(),
        })
    }

    /// Image i as in training, [h, w, 3] float32 from 0 to 1: undistorted, reduced, on the background.
    fn image<'py>(&self, py: Python<'py>, i: isize) -> PyResult<Bound<'py, PyAny>> {
        picture(py, self.load(py, i)?.color)
    }

    /// The foreground mask of image i, [h, w] float32 from 0 to 1, or None.
    fn mask(&self, py: Python<'_>, i: isize) -> PyResult<Option<Py<PyAny>>> {
        self.load(py, i)?.mask.map(|m| plane(py, m)).transpose()
    }

    fn __repr__(&self) -> String {
        let c = &self.capture;
        format!("Capture({:?}, {} cameras, {} images)", c.name, c.cameras.len(), c.frames.len())
    }
}

/// One image of a capture.
#[pyclass(frozen, get_all, module = "splat4d")]
pub(crate) struct Frame {
    /// Its place in the capture.
    number: usize,
    /// The camera's name.
    name: String,
    /// Camera of the image, as training uses it.
    camera: Camera,
    /// Seconds.
    time: f64,
    /// Frame number in the capture.
    index: usize,
    /// `train`, `test`, `val` or `future`.
    split: &'static str,
    /// The image file.
    file: PathBuf,
}
