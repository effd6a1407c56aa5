//! Python's camera class.

use crate::arrays::{finite, numbers, shaped};
use crate::errors::{OrRaise, bad_input};
use numpy::PyUntypedArrayMethods;
use pyo3::prelude::*;
use splat4d::math::Se3;
use splat4d::scene::{self, Intrinsics, Lens};
use splat4d_train::capture::{check_intrinsics, rigid};

/// A pinhole camera: OpenCV axes (x right, y down, z forward), pixels, pixel centres at +0.5.
#[pyclass(frozen, from_py_object, module = "splat4d")]
#[derive(Clone)]
pub(crate) struct Camera(pub(crate) scene::Camera);

#[pymethods]
impl Camera {
    /// Defaults: fy is fx; cx, cy the centre; world_to_camera (4x4) the identity.
    #[new]
    #[pyo3(signature = (width, height, fx, fy=None, cx=None, cy=None, world_to_camera=None, near=scene::Camera::NEAR))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        width: usize,
        height: usize,
        fx: f64,
        fy: Option<f64>,
        cx: Option<f64>,
        cy: Option<f64>,
        world_to_camera: Option<&Bound<'_, PyAny>>,
        near: f64,
    ) -> PyResult<Self> {
        let cam_from_world = world_to_camera.map_or(Ok(Se3::IDENTITY), pose)?;
        let (cx, cy) = (cx.unwrap_or(0.5 * width as f64), cy.unwrap_or(0.5 * height as f64));
        let intrinsics = Intrinsics { fx, fy: fy.unwrap_or(fx), cx, cy };
        checked(scene::Camera { cam_from_world, intrinsics, lens: Lens::Pinhole, width, height, near })
    }

    /// A camera at `position` that looks at `target`; `fov_y`: degrees.
    #[staticmethod]
    #[pyo3(signature = (position, target, up, *, width=800, height=600, fov_y=45.0, near=scene::Camera::NEAR))]
    fn look_at(
        position: &Bound<'_, PyAny>,
        target: &Bound<'_, PyAny>,
        up: &Bound<'_, PyAny>,
        width: usize,
        height: usize,
        fov_y: f64,
        near: f64,
    ) -> PyResult<Self> {
        if !(fov_y > 0.0 && fov_y < 180.0) {
            return Err(bad_input(format!("fov_y is {fov_y}"), "Give degrees between 0 and 180"));
        }
        let pose = Se3::look_at(finite(position, "position")?, finite(target, "target")?, finite(up, "up")?);
        checked(scene::Camera { near, ..scene::Camera::with_fov_y(pose, fov_y.to_radians(), width, height) })
    }

    /// Pixels of the image, left to right.
    #[getter]
    fn width(&self) -> usize {
        self.0.width
    }

    /// Pixels of the image, top to bottom.
    #[getter]
    fn height(&self) -> usize {
        self.0.height
    }

    /// Horizontal focal length, pixels.
    #[getter]
    fn fx(&self) -> f64 {
        self.0.intrinsics.fx
    }

    /// Vertical focal length, pixels.
    #[getter]
    fn fy(&self) -> f64 {
        self.0.intrinsics.fy
    }

    /// Horizontal position of the principal point, pixels.
    #[getter]
    fn cx(&self) -> f64 {
        self.0.intrinsics.cx
    }

    /// Vertical position of the principal point, pixels.
    #[getter]
    fn cy(&self) -> f64 {
        self.0.intrinsics.cy
    }

    /// Smallest depth that is rendered, scene units.
    #[getter]
    fn near(&self) -> f64 {
        self.0.near
    }

    /// 4x4, row by row (gsplat's viewmat).
    #[getter]
    fn world_to_camera(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let Se3 { rotation, translation } = self.0.cam_from_world;
        let row = |i: usize| {
            if i < 3 { [rotation[i][0], rotation[i][1], rotation[i][2], translation[i]] } else { [0., 0., 0., 1.] }
        };
        shaped(py, (0..4).flat_map(row).collect(), &[4, 4])
    }

    /// 3x3 intrinsics (gsplat's K).
    #[getter(K)]
    fn intrinsics(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let Intrinsics { fx, fy, cx, cy } = self.0.intrinsics;
        shaped(py, vec![fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], &[3, 3])
    }

    /// Position of the camera in the world.
    #[getter]
    fn position(&self) -> [f64; 3] {
        self.0.center()
    }

    /// The same view with pixels k times larger.
    fn downscaled(&self, k: usize) -> PyResult<Self> {
        if k == 0 {
            return Err(bad_input("k is 0", "Give 1 or more"));
        }
        checked(self.0.downscaled(k))
    }

    fn __repr__(&self) -> String {
        let [x, y, z] = self.0.center();
        format!("Camera({}x{} at [{x:.3}, {y:.3}, {z:.3}])", self.0.width, self.0.height)
    }
}

fn checked(camera: scene::Camera) -> PyResult<Camera> {
    check_intrinsics(&camera.intrinsics, camera.width, camera.height).or_raise()?;
    if !(camera.near > 0.0 && camera.near.is_finite()) {
        return Err(bad_input(format!("near is {}", camera.near), "Give a distance above zero, in scene units"));
    }
    let cam_from_world = rigid(camera.cam_from_world).or_raise()?;
    Ok(Camera(scene::Camera { cam_from_world, ..camera }))
}

fn pose(matrix: &Bound<'_, PyAny>) -> PyResult<Se3> {
    let array = numbers::<f64>(matrix, "world_to_camera")?;
    if array.shape() != [4, 4] {
        let what = format!("world_to_camera has the shape {:?}", array.shape());
        return Err(bad_input(what, "Give a 4x4 matrix, row by row, the last row 0 0 0 1"));
    }
    let view = array.as_array();
    let rows: [[f64; 4]; 4] = std::array::from_fn(|i| std::array::from_fn(|j| view[[i, j]]));
    if rows[3] != [0.0, 0.0, 0.0, 1.0] {
        return Err(bad_input(
            "the last row of world_to_camera is not 0 0 0 1",
            "A transposed matrix has its translation there",
        ));
    }
    rigid(Se3::from_rows(&rows)).or_raise()
}
