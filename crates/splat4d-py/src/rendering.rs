//! Differentiable renders: a scene at a camera and a time, and the gradients of its parameters.

use crate::arrays::{numbers, picture, plane, shaped};
use crate::errors::{OrRaise, bad_input};
use numpy::PyUntypedArrayMethods;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat4d::backward::sh_grads;
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::sh::MAX_COEFFS;
use splat4d::render::{Image, ImageGrads, RenderConfig, RenderGrads, Renderer, Shot};
use splat4d::scene::{Camera, Grads, Params, Planes, SH, Time};
use std::sync::{Arc, Mutex};

/// Rows and numbers of the arrays of parameters that hold no coefficients of spherical harmonics.
fn shape(p: &Params<f32>, key: splat4d::scene::Key, width: usize) -> Vec<usize> {
    let rows = p[key].rows();
    match width {
        1 => vec![rows],
        _ if key == SH && width.is_multiple_of(3) && width <= 3 * MAX_COEFFS => vec![rows, width / 3, 3],
        _ => vec![rows, width],
    }
}

/// The arrays of a scene by their names in `scene.safetensors`: layer, table, first column, width.
fn named(scene: &Scene<f32>) -> Vec<(String, usize, splat4d::scene::Key, usize, usize)> {
    let mut all = Vec::new();
    for (index, layer) in scene.layers.iter().enumerate() {
        for key in layer.params.keys() {
            let mut first = 0;
            for column in layer.params[key].columns() {
                if column.width > 0 {
                    all.push((format!("layers.{index}.{}", column.name), index, key, first, column.width));
                }
                first += column.width;
            }
        }
    }
    all
}

/// All learnable arrays of a scene.
pub(crate) fn parameters<'py>(py: Python<'py>, scene: &Scene<f32>) -> PyResult<Bound<'py, PyDict>> {
    let out = PyDict::new(py);
    for (name, layer, key, first, width) in named(scene) {
        let params = &scene.layers[layer].params;
        let data = params[key].column_to_rows(first, width);
        out.set_item(name, shaped(py, data, &shape(params, key, width))?)?;
    }
    Ok(out)
}

/// The scene with some of its arrays replaced. Errors: a name or a shape that it does not have, numbers that are not
/// finite.
pub(crate) fn with_parameters(scene: &Scene<f32>, new: &Bound<'_, PyDict>) -> PyResult<Scene<f32>> {
    let names = named(scene);
    let mut out = scene.clone();
    for (name, value) in new.iter() {
        let name: String = name.extract()?;
        let Some((_, layer, key, first, width)) = names.iter().find(|n| n.0 == name) else {
            let known: Vec<&str> = names.iter().map(|n| n.0.as_str()).collect();
            let remedy = format!("The scene's arrays are {}", known.join(", "));
            return Err(bad_input(format!("the scene has no array `{name}`"), &remedy));
        };
        let params = &mut out.layers[*layer].params;
        let array = numbers::<f32>(&value, "the array")?;
        let wanted = shape(params, *key, *width);
        if array.shape() != wanted {
            let remedy = format!("Give the shape {wanted:?}, that of `parameters()`");
            return Err(bad_input(format!("`{name}` has the shape {:?}", array.shape()), &remedy));
        }
        let data: Vec<f32> = array.as_array().iter().copied().collect();
        if let Some(bad) = data.iter().position(|x| !x.is_finite()) {
            return Err(bad_input(
                format!("row {} of `{name}` holds NaN or infinity", bad / width),
                "Give finite numbers",
            ));
        }
        params[*key].column_from_rows(*first, *width, &data);
    }
    Ok(out)
}

/// A render that stores its inputs, so that a gradient to its image becomes gradients to the scene's parameters, the
/// camera and the time.
#[pyclass(frozen, module = "splat4d")]
pub(crate) struct Rendering {
    scene: Arc<Scene<f32>>,
    camera: Camera,
    time: Time,
    background: [f32; 3],
    /// [h, w, 3] float32 over the background, not clamped.
    #[pyo3(get)]
    color: Py<PyAny>,
    /// [h, w] float32, from 0 to 1.
    #[pyo3(get)]
    alpha: Py<PyAny>,
    /// [h, w] float32: Σ z α T, depth along the camera's z in scene units times what each Gaussian contributes; divide
    /// it by `alpha` for expected depth.
    #[pyo3(get)]
    depth: Py<PyAny>,
    state: Mutex<(Renderer, Evaluation)>,
}

impl Rendering {
    pub(crate) fn new(
        py: Python<'_>,
        scene: Arc<Scene<f32>>,
        camera: Camera,
        time: Time,
        background: [f32; 3],
        config: RenderConfig,
    ) -> PyResult<Self> {
        let (renderer, seen, image) = py.detach(|| {
            let (mut renderer, mut seen, mut image) = (Renderer::new(config), Evaluation::default(), Image::default());
            scene.at(time, &mut seen);
            let splats = scene.splats(&seen);
            renderer.render(&Shot { depth: true, ..Shot::new(&splats, &camera, background) }, &mut image);
            (renderer, seen, image)
        });
        Ok(Self {
            scene,
            camera,
            time,
            background,
            color: picture(py, image.color)?.unbind(),
            alpha: plane(py, image.alpha)?,
            depth: plane(py, image.depth)?,
            state: Mutex::new((renderer, seen)),
        })
    }
}

/// A gradient [h, w, channels], or [h, w], as planes. Errors: another shape, numbers that are not finite.
fn gradient(value: &Bound<'_, PyAny>, what: &str, channels: usize, camera: &Camera) -> PyResult<Planes<f32>> {
    let array = numbers::<f32>(value, what)?;
    let mut wanted = vec![camera.height, camera.width];
    wanted.extend((channels > 1).then_some(channels));
    if array.shape() != wanted {
        let remedy = format!("Give the shape of the render, {wanted:?}");
        return Err(bad_input(format!("{what} has the shape {:?}", array.shape()), &remedy));
    }
    let mut out = Planes::new(channels, camera.height, camera.width);
    let pixels = camera.height * camera.width;
    for (i, x) in array.as_array().iter().enumerate() {
        if !x.is_finite() {
            let pixel = i / channels;
            let place = format!("row {}, column {}", pixel / camera.width, pixel % camera.width);
            return Err(bad_input(format!("{what} holds NaN or infinity at {place}"), "Give finite numbers"));
        }
        out.data[i % channels * pixels + i / channels] = *x;
    }
    Ok(out)
}

#[pymethods]
impl Rendering {
    /// Gradients of a scalar L, given dL/d`color` [h, w, 3] and, where L depends on them, dL/d`alpha` and dL/d`depth`
    /// [h, w]: a dict of arrays with the names and shapes of `Scene.parameters()`, and next to them `time` (dL/dt, a
    /// float; 0 before and after a Gaussian's path), `camera` ([6]: a translation and a rotation of the camera's axes,
    /// applied from the left to `world_to_camera`) and `background` ([3]).
    #[pyo3(signature = (color=None, alpha=None, depth=None))]
    fn backward<'py>(
        &self,
        py: Python<'py>,
        color: Option<&Bound<'py, PyAny>>,
        alpha: Option<&Bound<'py, PyAny>>,
        depth: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let of = |value: Option<&Bound<'py, PyAny>>, what: &str, channels: usize| {
            value.map(|v| gradient(v, what, channels, &self.camera)).transpose()
        };
        let color = of(color, "the gradient to color", 3)?;
        let (alpha, depth) = (of(alpha, "the gradient to alpha", 1)?, of(depth, "the gradient to depth", 1)?);
        let color = color.unwrap_or_else(|| Planes::new(3, self.camera.height, self.camera.width));
        let (grads, d_time, d) = py.detach(|| {
            let mut state = self.state.lock().unwrap_or_else(|e| e.into_inner());
            let (renderer, seen) = &mut *state;
            let scene = &*self.scene;
            let mut grads: Vec<Grads<f32>> = scene.layers.iter().map(|l| Grads::new(&l.params)).collect();
            let mut d = RenderGrads::default();
            {
                let splats = scene.splats(seen);
                let shot = Shot { depth: true, ..Shot::new(&splats, &self.camera, self.background) };
                let pixels = ImageGrads { color: &color, alpha: alpha.as_ref(), depth: depth.as_ref(), extra: None };
                let mut d_sh = sh_grads(&splats, &mut grads);
                renderer.backward(&shot, &pixels, &mut d_sh, &mut d);
            }
            // Another call backpropagates another gradient through the same results.
            scene.at(self.time, seen);
            seen.activate(&mut grads);
            d.add_to(scene, self.time, seen, &mut grads);
            seen.backward(&scene.layers, &mut grads);
            (grads, seen.d_time(self.time), d)
        });
        let out = PyDict::new(py);
        for (name, layer, key, first, width) in named(&self.scene) {
            let params = &self.scene.layers[layer].params;
            let table = grads[layer].table(key);
            let data = match table.rows() == params[key].rows() {
                true => table.column_to_rows(first, width),
                false => vec![0.0; params[key].rows() * width], // a page that nothing reaches
            };
            out.set_item(name, shaped(py, data, &shape(params, key, width))?)?;
        }
        out.set_item("time", d_time)?;
        out.set_item("camera", shaped(py, d.camera.to_vec(), &[6])?)?;
        out.set_item("background", shaped(py, d.background.to_vec(), &[3])?)?;
        Ok(out)
    }

    fn __repr__(&self) -> String {
        format!("Rendering({}x{} at {} s)", self.camera.width, self.camera.height, self.time.0)
    }
}

/// Renders for gradients. Errors: a scene without arrays to take them to.
pub(crate) fn check(scene: &Scene<f32>) -> PyResult<()> {
    if scene.layers.iter().any(|l| l.span != splat4d::layers::ALWAYS) {
        let error = splat4d::Error::new(
            splat4d::ErrorKind::Unsupported,
            "a playback file stores the baked segments of a scene, not its parameters",
        );
        return Err(error.remedy("Open the run or its scene.safetensors")).or_raise();
    }
    Ok(())
}
