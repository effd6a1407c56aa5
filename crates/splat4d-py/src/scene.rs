//! Scenes: anything that `splat4d view` opens.

use crate::arrays::{finite, numbers, picture, plane, shaped};
use crate::camera::Camera;
use crate::errors::{OrRaise, bad_input};
use crate::gaussians::Gaussians;
use pyo3::prelude::*;
use splat4d::device;
use splat4d::flow::tracks;
use splat4d::layers::{Evaluation, Head};
use splat4d::render::{Image, RenderConfig, Shot, Tables, Wanted};
use splat4d::scene::{Planes, Time};
use splat4d_cli::draw::{Channel, Painter, antialias};
use splat4d_cli::paths::View;
use splat4d_cli::sequence::moments;
use splat4d_cli::source::Source;
use std::ffi::OsString;
use std::path::PathBuf;
use std::sync::Arc;

/// Alpha below which a pixel has no depth (the faintest splat that is drawn).
const DEPTH_ALPHA: f32 = 1.0 / 255.0;

/// A scene in space and time.
#[pyclass(frozen, module = "splat4d")]
pub(crate) struct Scene {
    path: PathBuf,
    source: Arc<Source>,
    views: Vec<View>,
}

/// Opens a run folder, a playback file, a scene file, or a file or folder of another program's Gaussians.
#[pyfunction]
pub(crate) fn open(py: Python<'_>, path: PathBuf) -> PyResult<Scene> {
    Scene::open(py, path)
}

impl Scene {
    pub(crate) fn open(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let source = py.detach(|| Source::open(&path)).or_raise()?;
        let views = source.views().or_raise()?;
        let warnings: Vec<String> = source.warnings.lines().iter().map(ToString::to_string).collect();
        crate::errors::warn(py, &warnings)?;
        Ok(Self { path, source: Arc::new(source), views })
    }
}

/// Errors: not a number.
fn time(t: f64) -> PyResult<Time> {
    if t.is_finite() { Ok(Time(t)) } else { Err(bad_input(format!("the time is {t}"), "Give seconds of the scene")) }
}

#[pymethods]
impl Scene {
    /// First and last second.
    #[getter]
    fn clip(&self) -> (f64, f64) {
        (self.source.scene.clip[0], self.source.scene.clip[1])
    }

    /// Frames per second.
    #[getter]
    fn fps(&self) -> f64 {
        self.source.scene.fps
    }

    /// Up direction in the world.
    #[getter]
    fn up(&self) -> [f64; 3] {
        self.source.scene.up
    }

    /// World coordinates of the scene's origin; zero unless they are far from it.
    #[getter]
    fn offset(&self) -> [f64; 3] {
        self.source.scene.offset
    }

    /// Colour behind the scene.
    #[getter]
    fn background(&self) -> [f32; 3] {
        self.source.scene.background
    }

    /// Names of the labels that its Gaussians have, in the order of their numbers; empty: none.
    #[getter]
    fn labels(&self) -> Vec<String> {
        self.source.scene.labels.clone()
    }

    /// The capture's cameras, (name, camera); empty where the file brings none.
    #[getter]
    fn cameras(&self) -> Vec<(String, Camera)> {
        let mut seen = std::collections::BTreeSet::new();
        let first = self.views.iter().filter(|v| seen.insert(v.name.as_str()));
        first.map(|v| (v.name.clone(), Camera(v.camera.clone()))).collect()
    }

    /// The Gaussians alive at second t as NumPy arrays.
    fn at(&self, py: Python<'_>, t: f64) -> PyResult<Gaussians> {
        time(t)?;
        self.source.scene.without_head("an array of Gaussians").or_raise()?;
        Gaussians::at(py, &self.source, t)
    }

    /// Renders at second t: `color` [h, w, 3] over the background, `alpha` [h, w], or expected `depth` [h, w] along the
    /// camera's z in scene units; or, as in `splat4d render --channel`, `flow` [h, w, 2] in pixels to the scene's next
    /// frame, `velocity` [h, w, 3] in scene units per second, unit `normal` [h, w, 3] in camera axes, number of the
    /// `label` [h, w] (-1: none), `feature` [h, w, C], `life` [h, w] in seconds, `uncertainty` [h, w] in scene units
    /// (of a run). float32, NaN where empty. `device`: `cpu`, `gpu` or `auto`, for colour, alpha and depth; the CPU
    /// renders the others.
    #[pyo3(signature = (camera, t, *, channel="color", background=None, device="cpu"))]
    fn render<'py>(
        &self,
        py: Python<'py>,
        camera: &Camera,
        t: f64,
        channel: &str,
        background: Option<&Bound<'py, PyAny>>,
        device: &str,
    ) -> PyResult<Bound<'py, PyAny>> {
        let t = time(t)?;
        let Some(kind) = Channel::named(channel) else {
            return Err(bad_input(
                format!("there is no channel `{channel}`"),
                "Give color, alpha, depth, flow, velocity, normal, label, feature, life or uncertainty",
            ));
        };
        let device = named(device)?;
        let background = background.map(|b| finite::<3>(b, "background")).transpose()?;
        let scene = &self.source.scene;
        let background = background.map_or(scene.background, |b| b.map(|x| x as f32));
        let depth = channel == "depth";
        let smooth = self.source.run.as_ref().and_then(|r| r.recipe().ok()).is_some_and(|r| r.appearance.antialias);
        if kind.is_field() {
            let drawn = py.detach(|| {
                let painter = Painter::new(scene, background, smooth, false);
                let mut painter = painter.of_channel(kind, &self.views, &mut |_, _| {})?;
                painter.draw(&camera.0, t.0);
                Ok::<Planes<f32>, splat4d::Error>(painter.raw())
            });
            let drawn = drawn.or_raise()?;
            return if drawn.channels > 1 { picture(py, drawn) } else { Ok(plane(py, drawn)?.into_bound(py)) };
        }
        let (image, trouble) = py.detach(|| {
            let config = RenderConfig { antialias: antialias(smooth), ..RenderConfig::default() };
            let wanted = Wanted { head: scene.head != Head::Identity, ..Wanted::default() };
            let mut opened = device::open(device, config, &wanted, Tables::Changing);
            let (mut seen, mut image) = (Evaluation::default(), Image::default());
            scene.at(t, &mut seen);
            let splats = scene.splats(&seen);
            let shot = Shot { depth, ..Shot::new(&splats, &camera.0, background) };
            let mut trouble: Vec<String> = opened.fell_back.then_some(opened.why).into_iter().collect();
            let failed = device::draw(&mut opened.backend, &shot, &mut image);
            trouble.extend(failed.map(|e| format!("drawn on the CPU: {}", e.cause())));
            (image, trouble)
        });
        if device == device::Device::Gpu {
            crate::errors::warn(py, &trouble)?;
        }
        match channel {
            "color" => picture(py, image.color),
            "alpha" => Ok(plane(py, image.alpha)?.into_bound(py)),
            _ => Ok(plane(py, expected(image.depth, &image.alpha))?.into_bound(py)),
        }
    }

    /// Paths of every n-th Gaussian, at the given times or at the scene's frames.
    #[pyo3(signature = (every=1, times=None))]
    fn tracks(&self, py: Python<'_>, every: usize, times: Option<&Bound<'_, PyAny>>) -> PyResult<Tracks> {
        if every == 0 {
            return Err(bad_input("every is 0", "Give 1 or more"));
        }
        let scene = &self.source.scene;
        let times: Vec<f64> = match times {
            Some(times) => numbers::<f64>(times, "times")?.as_array().iter().copied().collect(),
            None => moments(scene, None, [None, None]).or_raise()?.1,
        };
        times.iter().try_for_each(|t| time(*t).map(drop))?;
        let followed = py.detach(|| tracks::Tracks::follow(scene, &tracks::every(scene, every), &times));
        let points: Vec<f32> = followed.points.iter().flat_map(|p| p.unwrap_or([f32::NAN; 3])).collect();
        let (count, moments) = (followed.members.len(), followed.times.len());
        let (layers, rows): (Vec<u32>, Vec<u32>) = followed.members.iter().map(|m| (m.layer as u32, m.row)).unzip();
        Ok(Tracks {
            times: shaped(py, followed.times, &[moments])?,
            points: shaped(py, points, &[count, moments, 3])?,
            layers: shaped(py, layers, &[count])?,
            rows: shaped(py, rows, &[count])?,
        })
    }

    /// Writes one seekable file that plays anywhere (.s4d); `tolerance`: largest error of a Gaussian, pixels.
    #[pyo3(signature = (path, *, tolerance=None))]
    fn bake(&self, py: Python<'_>, path: PathBuf, tolerance: Option<f64>) -> PyResult<()> {
        let mut words = vec!["bake".into(), self.path.clone().into_os_string(), "-o".into(), path.into_os_string()];
        words.extend(tolerance.map(|px| OsString::from(format!("--tolerance={px}"))));
        py.detach(|| splat4d_cli::call(&words)).or_raise()
    }

    /// Writes a file in the format of its extension: .html (player and scene as one page), .ply (at time t, in the
    /// scene's axes), or a format of `splat4d convert`.
    #[pyo3(signature = (path, t=None))]
    fn export(&self, py: Python<'_>, path: PathBuf, t: Option<f64>) -> PyResult<()> {
        t.map(time).transpose()?;
        let from = self.path.clone().into_os_string();
        let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        let out = path.into_os_string();
        let mut words = match ending.as_deref() {
            Some("html") => vec!["export".into(), from, "--html".into(), "-o".into(), out],
            Some("ply") => vec!["export".into(), from, "-o".into(), out],
            _ => vec!["convert".into(), from, out],
        };
        words.extend(t.map(|t| OsString::from(format!("--time={t}"))));
        py.detach(|| splat4d_cli::call(&words)).or_raise()
    }

    /// Number of Gaussians, alive or not.
    fn __len__(&self) -> usize {
        self.source.scene.len()
    }

    fn __repr__(&self) -> String {
        let [from, to] = self.source.scene.clip;
        format!("Scene({:?}, {} Gaussians, {from} to {to} s)", self.path, self.source.scene.len())
    }
}

/// Paths of Gaussians over time.
#[pyclass(frozen, module = "splat4d")]
pub(crate) struct Tracks {
    /// [T] seconds.
    #[pyo3(get)]
    times: Py<PyAny>,
    /// [M, T, 3] scene units, float32; NaN where a Gaussian is not alive.
    #[pyo3(get)]
    points: Py<PyAny>,
    /// [M] the layer of each.
    #[pyo3(get)]
    layers: Py<PyAny>,
    /// [M] the row of each in its layer.
    #[pyo3(get)]
    rows: Py<PyAny>,
}

/// The device with this name.
pub(crate) fn named(device: &str) -> PyResult<device::Device> {
    match device {
        "auto" => Ok(device::Device::Auto),
        "cpu" => Ok(device::Device::Cpu),
        "gpu" => Ok(device::Device::Gpu),
        _ => Err(bad_input(format!("there is no device `{device}`"), "Give cpu, gpu or auto")),
    }
}

/// Σ z α T over alpha.
fn expected(mut depth: Planes<f32>, alpha: &Planes<f32>) -> Planes<f32> {
    let pixels = depth.data.iter_mut().zip(&alpha.data);
    pixels.for_each(|(d, a)| *d = if *a < DEPTH_ALPHA { f32::NAN } else { *d / a });
    depth
}
