//! Scenes: anything that `splat4d view` opens.

use crate::arrays::{finite, numbers, picture, plane, shaped};
use crate::camera::Camera;
use crate::errors::{OrRaise, bad_input};
use crate::gaussians::Gaussians;
use crate::motion::{Hook, raise};
use crate::plain::plain;
use crate::rendering::{self, Rendering};
use crate::scene_arrays::{self, About, Moving, Shapes};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use splat4d::bake::{Options, TOLERANCE};
use splat4d::device;
use splat4d::flow::tracks;
use splat4d::layers::{Evaluation, Head};
use splat4d::render::{Abilities, Image, RenderConfig, Shot, Tables};
use splat4d::scene::{Planes, Time};
use splat4d_workflow::baking::{self, Baking};
use splat4d_workflow::converting::{self, Conversion};
use splat4d_workflow::draw::{Channel, Painter, Transfer, antialias};
use splat4d_workflow::editing::{EditOptions, edit};
use splat4d_workflow::events::{Event, Listener};
use splat4d_workflow::exporting::{self, Frames, PlyOptions, TrackOptions};
use splat4d_workflow::localising::{LocaliseOptions, localise};
use splat4d_workflow::meshing::{self, MeshOptions};
use splat4d_workflow::paths::{Route, View};
use splat4d_workflow::rendering::{self as films, Focus, Photo, Projection, RenderOptions, Stereo};
use splat4d_workflow::sequence::timestamps;
use splat4d_workflow::source::{Source, not_empty, read_scene};
use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Alpha below which a pixel has no depth (the faintest splat that is rendered).
const DEPTH_ALPHA: f32 = 1.0 / 255.0;

/// A scene in space and time.
#[pyclass(frozen, module = "splat4d")]
pub(crate) struct Scene {
    /// Path of an opened scene; none: it was made here.
    path: Option<PathBuf>,
    source: Arc<Source>,
    views: Vec<View>,
}

/// Name of the file that a scene without one is written to, in a folder of its own, for the commands that read files.
const SCENE: &str = "scene.safetensors";

/// Opens a run folder, a playback file, a scene file, or a file or folder of another program's Gaussians. A scene that
/// was trained with a `Motion` of your own needs it again.
#[pyfunction]
#[pyo3(signature = (path, *, motion=None))]
pub(crate) fn open(py: Python<'_>, path: PathBuf, motion: Option<&Bound<'_, PyAny>>) -> PyResult<Scene> {
    motion.map(Hook::register).transpose()?;
    Scene::open(py, path)
}

impl Scene {
    pub(crate) fn open(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let source = py.detach(|| Source::open(&path)).or_raise()?;
        let views = source.views().or_raise()?;
        let warnings: Vec<String> = source.warnings.lines().iter().map(ToString::to_string).collect();
        crate::errors::warn(py, &warnings)?;
        Ok(Self { path: Some(path), source: Arc::new(source), views })
    }

    /// A scene that is in no file.
    fn made(scene: splat4d::layers::Scene<f32>, views: Vec<View>) -> Self {
        Self { path: None, source: Arc::new(Source::own(scene)), views }
    }

    /// Runs `work` on the file of the scene: its own or, where it has none, one in a folder that is deleted afterwards.
    fn with_file<T>(&self, py: Python<'_>, work: impl FnOnce(&Path, &Path) -> anyhow::Result<T> + Send) -> PyResult<T>
    where
        T: Send,
    {
        py.detach(|| {
            let folder =
                tempfile::tempdir().map_err(|e| splat4d::Error::environment("no temporary folder could be made", e))?;
            let own = folder.path().join(SCENE);
            if self.path.is_none() {
                let mut bytes = Vec::new();
                splat4d::format::scene::write(&self.source.scene, &mut bytes)?;
                std::fs::write(&own, bytes)
                    .map_err(|e| splat4d::Error::environment("the scene could not be written", e))?;
            }
            work(self.path.as_deref().unwrap_or(&own), folder.path())
        })
        .or_raise()
    }
}

/// Runs a workflow and returns its warnings.
fn listening(work: impl FnOnce(&dyn Listener) -> splat4d::Result<()>) -> anyhow::Result<Vec<String>> {
    let warnings = RefCell::new(Vec::new());
    let listen = |event: &Event<'_>| {
        if let Event::Warning(text) = event {
            warnings.borrow_mut().push((*text).to_owned());
        }
    };
    work(&listen)?;
    Ok(warnings.into_inner())
}

/// The scene's parameters. Errors: it is a playback file's.
fn learnable(scene: &Scene) -> PyResult<&splat4d::layers::Scene<f32>> {
    rendering::check(&scene.source.scene)?;
    Ok(&scene.source.scene)
}

/// How far outside of the clip a time may be without a warning, frames: the first and the last frame last so long.
const OUTSIDE: f64 = 1.0;

impl Scene {
    /// The time, with a warning where nothing was seen then. Errors: not a number.
    fn time(&self, py: Python<'_>, t: f64) -> PyResult<Time> {
        let scene = &self.source.scene;
        let ([from, to], frame) = (scene.clip, OUTSIDE / scene.fps.max(f64::MIN_POSITIVE));
        if scene.is_moving() && t.is_finite() && !(from - frame..=to + frame).contains(&t) {
            let message = format!("{t} s is outside of the scene's clip, {from:.3} to {to:.3} s: no image shows it");
            crate::errors::warn(py, &[message])?;
        }
        time(t)
    }
}

/// Errors: not a number.
fn time(t: f64) -> PyResult<Time> {
    if t.is_finite() { Ok(Time(t)) } else { Err(bad_input(format!("invalid time {t}"), "Give seconds of the scene")) }
}

#[pymethods]
impl Scene {
    /// A scene of Gaussians of your own, given as `Gaussians(...)` takes them.
    ///
    /// Static: [N, ...] each. With a pose for each of several times: `means` [T, N, 3], `quats` [T, N, 4] or both, at
    /// `times` [T] seconds [k/fps]; between them positions and rotations are interpolated. With kinematics:
    /// `velocities` [N, 3], or [N, P, 3] for the first P powers of time (P at most 3, scene units / s^p), and
    /// `rotation_rates` [N, 4] (1/s, added to `quats`), both around `centers` [N] seconds, or around second 0 where
    /// there are none; with `durations` [N] seconds the opacity is multiplied by exp(−½((t − center)/duration)²).
    /// `clip`: first and last second; `up` [0, 1, 0]; `background` [black].
    #[staticmethod]
    #[pyo3(signature = (
        means, quats, scales, opacities, *, sh=None, colors=None, times=None, velocities=None, rotation_rates=None,
        centers=None, durations=None, fps=30.0, clip=None, up=None, background=None
    ))]
    #[allow(clippy::too_many_arguments)]
    fn from_arrays(
        means: &Bound<'_, PyAny>,
        quats: &Bound<'_, PyAny>,
        scales: &Bound<'_, PyAny>,
        opacities: &Bound<'_, PyAny>,
        sh: Option<&Bound<'_, PyAny>>,
        colors: Option<&Bound<'_, PyAny>>,
        times: Option<&Bound<'_, PyAny>>,
        velocities: Option<&Bound<'_, PyAny>>,
        rotation_rates: Option<&Bound<'_, PyAny>>,
        centers: Option<&Bound<'_, PyAny>>,
        durations: Option<&Bound<'_, PyAny>>,
        fps: f64,
        clip: Option<[f64; 2]>,
        up: Option<&Bound<'_, PyAny>>,
        background: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let about = About { clip, fps, up, background };
        let fps = about.checked_fps()?;
        let shapes = Shapes::new(means, quats, scales, opacities, sh, colors, true)?;
        let moving = Moving { times, velocities, rotation_rates, centers, durations, fps };
        let (layer, seen) = scene_arrays::layer(&shapes, &moving)?;
        Ok(Self::made(about.scene(vec![layer], seen)?, Vec::new()))
    }

    /// A scene of independent frames, each a `Gaussians`: frame k is visible around k/fps seconds.
    #[staticmethod]
    #[pyo3(signature = (frames, *, fps=30.0, up=None, background=None))]
    fn from_frames(
        py: Python<'_>,
        frames: Vec<PyRef<'_, Gaussians>>,
        fps: f64,
        up: Option<&Bound<'_, PyAny>>,
        background: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let about = About { clip: None, fps, up, background };
        let fps = about.checked_fps()?;
        let params = frames.iter().map(|g| Ok(g.shapes(py)?.params(splat4d::scene::LifeKind::Infinite)));
        let params = params.collect::<PyResult<Vec<_>>>()?;
        let joined = splat4d::format::sequence::join(&params, fps, [0.0, 1.0, 0.0]).or_raise()?;
        Ok(Self::made(about.scene(joined.layers, joined.clip)?, Vec::new()))
    }

    /// All learnable arrays of the scene by their names in `scene.safetensors`: `layers.0.means` [N, 3],
    /// `layers.0.log_scales` [N, 3], `layers.0.opacity_logits` [N], `layers.0.sh` [N, K, 3], … and those of its motion
    /// model. The arrays are copies. Playback files have none: an error.
    fn parameters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        rendering::parameters(py, learnable(self)?)
    }

    /// The scene with these of its arrays replaced, in no file yet. Names and shapes are those of `parameters()`.
    fn with_parameters(&self, parameters: &Bound<'_, PyDict>) -> PyResult<Self> {
        let scene = rendering::with_parameters(learnable(self)?, parameters)?;
        Ok(Self::made(scene, self.views.clone()))
    }

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
        self.time(py, t)?;
        self.source.scene.without_head("an array of Gaussians").or_raise()?;
        let now = Gaussians::at(py, &self.source, t)?;
        raise(&self.source.scene)?;
        Ok(now)
    }

    /// Renders at second t: `color` [h, w, 3] over the background, `alpha` [h, w], or expected `depth` [h, w] along the
    /// camera's z in scene units; or, as in `splat4d render --channel`, `flow` [h, w, 2] in pixels to the scene's next
    /// frame, `velocity` [h, w, 3] in scene units per second, unit `normal` [h, w, 3] in camera axes, number of the
    /// `label` [h, w] (-1: none), `feature` [h, w, C], `life` [h, w] in seconds, `uncertainty` [h, w] of depth in
    /// scene units. float32, NaN where empty. `device`: `cpu`, `gpu` or `auto`, for colour, alpha and depth; the CPU
    /// renders the others.
    ///
    /// With `requires_grad`, renders colour, alpha and depth on the CPU and returns a `Rendering`, whose
    /// `backward(d_color)` takes the gradient of any function of the image to the scene's `parameters()`, the camera
    /// and the time.
    #[pyo3(signature = (camera, t, *, channel="color", background=None, device="cpu", requires_grad=false))]
    #[allow(clippy::too_many_arguments)]
    fn render<'py>(
        &self,
        py: Python<'py>,
        camera: &Camera,
        t: f64,
        channel: &str,
        background: Option<&Bound<'py, PyAny>>,
        device: &str,
        requires_grad: bool,
    ) -> PyResult<Bound<'py, PyAny>> {
        let t = self.time(py, t)?;
        let Some(kind) = Channel::named(channel) else {
            return Err(bad_input(
                format!("there is no channel `{channel}`"),
                &format!("Give one of: {}", Channel::ALL.map(Channel::name).join(", ")),
            ));
        };
        let device = named(device)?;
        let background = background.map(|b| finite::<3>(b, "background")).transpose()?;
        let scene = &self.source.scene;
        let background = background.map_or(scene.background, |b| b.map(|x| x as f32));
        let depth = channel == "depth";
        let smooth = self.smooth();
        if requires_grad {
            if channel != "color" {
                let remedy = "Leave `channel` out: the Rendering has color, alpha and depth";
                return Err(bad_input(format!("the channel {channel} has no gradients"), remedy));
            }
            learnable(self)?;
            let config = RenderConfig { antialias: antialias(smooth), ..RenderConfig::default() };
            let (scene, camera) = (Arc::new(scene.clone()), camera.0.clone());
            let rendering = Rendering::new(py, scene, camera, t, background, config)?;
            raise(&self.source.scene)?;
            return Ok(Bound::new(py, rendering)?.into_any());
        }
        if kind.is_field() {
            let drawn = py.detach(|| {
                let painter = Painter::new(scene, background, smooth, false);
                let mut painter = painter.of_channel(kind)?;
                painter.draw(&camera.0, t.0);
                Ok::<Planes<f32>, splat4d::Error>(painter.raw())
            });
            raise(scene)?;
            let drawn = drawn.or_raise()?;
            return if drawn.channels > 1 { picture(py, drawn) } else { Ok(plane(py, drawn)?.into_bound(py)) };
        }
        let (image, trouble) = py.detach(|| {
            let config = RenderConfig { antialias: antialias(smooth), ..RenderConfig::default() };
            let abilities = Abilities { head: scene.head != Head::Identity, ..Abilities::default() };
            let mut opened = device::open(device, config, &abilities, Tables::Changing);
            let (mut seen, mut image) = (Evaluation::default(), Image::default());
            scene.at(t, &mut seen);
            let splats = scene.splats(&seen);
            let shot = Shot { depth, ..Shot::new(&splats, &camera.0, background) };
            let mut trouble: Vec<String> = opened.fell_back.then_some(opened.why).into_iter().collect();
            let failed = device::draw(&mut opened.backend, &shot, &mut image);
            trouble.extend(failed.map(|e| format!("rendered on the CPU: {}", e.cause())));
            (image, trouble)
        });
        raise(scene)?;
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
            None => timestamps(scene, None, [None, None]).or_raise()?.1,
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

    /// Writes one seekable file that plays anywhere (.s4d); `tolerance`: largest error of a Gaussian, pixels; `ladder`:
    /// rates in Mbit/s, rising, among which players choose.
    #[pyo3(signature = (path, *, tolerance=None, ladder=None))]
    fn bake(&self, py: Python<'_>, path: PathBuf, tolerance: Option<f64>, ladder: Option<Vec<f64>>) -> PyResult<()> {
        let options = Options { tolerance: tolerance.unwrap_or(TOLERANCE), ..Options::default() };
        let baking = Baking { options, tolerance, ladder: ladder.unwrap_or_default(), ..Baking::default() };
        let work =
            |file: &Path, _: &Path| listening(|listener| baking::bake(file, &path, None, &baking, listener).map(drop));
        crate::errors::warn(py, &self.with_file(py, work)?)
    }

    /// Writes a file in the format of its extension: .html (player and scene as one page), .ply (at time t, in the
    /// scene's axes), or a format of `splat4d convert`, .safetensors (everything, to continue with) and .s4d among
    /// them.
    #[pyo3(signature = (path, t=None))]
    fn export(&self, py: Python<'_>, path: PathBuf, t: Option<f64>) -> PyResult<()> {
        t.map(time).transpose()?;
        let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        let export = |file: &Path, listener: &dyn Listener| match (ending.as_deref(), t) {
            (Some("html"), Some(_)) => {
                Err(splat4d::Error::input("a page holds the whole scene").at(path.display()).remedy("Leave t out"))
            }
            (Some("html"), None) => exporting::page(file, &path, None, listener),
            (Some("ply"), _) => {
                let mut source = Source::open(file)?;
                source.keep(file, &path, &[])?;
                not_empty(&source.scene, file)?;
                exporting::fold(&mut source, listener)?;
                let scene = &source.scene;
                let t = t.unwrap_or(scene.clip[0]);
                let count = exporting::moment(scene, t, PlyOptions::default(), &path)?;
                exporting::warn_of_empty(scene, t, count, listener);
                Ok(())
            }
            _ => converting::run(&Conversion { time: t, ..Conversion::new(file, &path) }, listener),
        };
        let work = |file: &Path, _: &Path| listening(|listener| export(file, listener));
        crate::errors::warn(py, &self.with_file(py, work)?)
    }

    /// Writes a .ply per frame, `frame_00000.ply` and so on, into a folder; returns how many. `fps` [the scene's];
    /// `start` and `end` [the clip's] are seconds. `world`: in the capture's world, in double precision. `force`
    /// replaces such a sequence.
    #[pyo3(signature = (folder, *, fps=None, start=None, end=None, world=false, force=false))]
    #[allow(clippy::too_many_arguments)]
    fn export_frames(
        &self,
        py: Python<'_>,
        folder: PathBuf,
        fps: Option<f64>,
        start: Option<f64>,
        end: Option<f64>,
        world: bool,
        force: bool,
    ) -> PyResult<usize> {
        let frames = Frames { fps, from: start, to: end };
        let mut count = 0;
        let work = |file: &Path, _: &Path| {
            listening(|listener| {
                let mut source = exporting::open(file, None)?;
                exporting::fold(&mut source, listener)?;
                count = exporting::frames(
                    file,
                    &source,
                    &folder,
                    &frames,
                    (PlyOptions { world, velocities: false }, force),
                    listener,
                )?;
                Ok(())
            })
        };
        crate::errors::warn(py, &self.with_file(py, work)?)?;
        Ok(count)
    }

    /// Writes the surfaces that the cameras see as triangle meshes: one at second t [the clip's start] to a .glb, .obj or
    /// .ply, or one per frame to a folder or a name with `%05d`; returns how many. `voxel`: scene units; `watertight`
    /// closes the surface; `collision` also fills the floor and leaves colours out (docs/meshes.md). Times as in
    /// `export_frames`. `force` replaces meshes.
    #[pyo3(signature = (
        path, t=None, *, voxel=0.02, watertight=false, collision=false, fps=None, start=None, end=None, force=false
    ))]
    #[allow(clippy::too_many_arguments)]
    fn export_mesh(
        &self,
        py: Python<'_>,
        path: PathBuf,
        t: Option<f64>,
        voxel: f64,
        watertight: bool,
        collision: bool,
        fps: Option<f64>,
        start: Option<f64>,
        end: Option<f64>,
        force: bool,
    ) -> PyResult<usize> {
        t.map(time).transpose()?;
        let frames = Frames { fps, from: start, to: end };
        let options = MeshOptions { voxel, watertight, collision, time: t, frames, force };
        let mut count = 0;
        let work = |file: &Path, _: &Path| {
            listening(|listener| {
                count = meshing::write(file, &Source::open(file)?, &path, &options, listener)?;
                Ok(())
            })
        };
        crate::errors::warn(py, &self.with_file(py, work)?)?;
        Ok(count)
    }

    /// Writes positions over time to a .csv or .json file: of every n-th Gaussian, of the `count` ones nearest to
    /// `near` at the first time, of those with a `label`, or of the points that the file `points` lists
    /// (docs/track-points.md), with their visibility. Times as in `export_frames`.
    #[pyo3(signature = (path, *, every=1, near=None, count=1, label=None, points=None, fps=None, start=None, end=None, world=false))]
    #[allow(clippy::too_many_arguments)]
    fn export_tracks(
        &self,
        py: Python<'_>,
        path: PathBuf,
        every: usize,
        near: Option<[f64; 3]>,
        count: usize,
        label: Option<String>,
        points: Option<PathBuf>,
        fps: Option<f64>,
        start: Option<f64>,
        end: Option<f64>,
        world: bool,
    ) -> PyResult<()> {
        if points.is_some() && (every != 1 || near.is_some() || label.is_some() || world) {
            return Err(bad_input("points are tracked instead of Gaussians", "Leave every, near, label and world out"));
        }
        let frames = Frames { fps, from: start, to: end };
        let options = TrackOptions { frames, every, near: near.map(|p| (p, count)), label, world };
        let work = |file: &Path, _: &Path| {
            listening(|listener| {
                let source = exporting::open(file, None)?;
                source.keep(file, &path, &points.iter().map(PathBuf::as_path).collect::<Vec<_>>())?;
                match &points {
                    Some(points) => exporting::points(&source, points, &frames, &path, listener),
                    None => exporting::tracks(&source.scene, &options, &path, listener),
                }
            })
        };
        crate::errors::warn(py, &self.with_file(py, work)?)
    }

    /// Films a camera path through space and time (docs/render.md): an .mp4 where ffmpeg is installed, an animated
    /// .png, or a folder of images. `route`: "orbit", "train", "test", "camera=NAME" or a key-frame file. `start` and
    /// `end` are seconds of the scene; `freeze` stops time there. `shutter`: degrees; `aperture`: diameter of the lens;
    /// `focus`: a distance or a pixel (x, y); `samples`: images per frame; `projection`: "perspective" or
    /// "equirectangular"; `stereo`: "side-by-side" or "over-under", with `eye_distance`; `transparent`: PNG files with
    /// alpha; `transfer`: "linear" or "srgb" colours of .exr files.
    #[pyo3(signature = (
        path, *, route=None, size=None, start=None, end=None, freeze=None, slow_motion=None, seconds=None, fps=None,
        channel="color", shutter=None, aperture=None, focus=None, samples=None, projection="perspective", stereo=None,
        eye_distance=None, transparent=false, transfer=None, force=false, device="auto"
    ))]
    #[allow(clippy::too_many_arguments)]
    fn film(
        &self,
        py: Python<'_>,
        path: PathBuf,
        route: Option<&str>,
        size: Option<[usize; 2]>,
        start: Option<f64>,
        end: Option<f64>,
        freeze: Option<f64>,
        slow_motion: Option<f64>,
        seconds: Option<f64>,
        fps: Option<f64>,
        channel: &str,
        shutter: Option<f64>,
        aperture: Option<f64>,
        focus: Option<&Bound<'_, PyAny>>,
        samples: Option<usize>,
        projection: &str,
        stereo: Option<&str>,
        eye_distance: Option<f64>,
        transparent: bool,
        transfer: Option<&str>,
        force: bool,
        device: &str,
    ) -> PyResult<()> {
        let numbers = [start, end, freeze, slow_motion, seconds, fps, shutter, aperture, eye_distance];
        if numbers.into_iter().flatten().any(|v| !v.is_finite()) {
            return Err(bad_input("a number is not finite", "Give seconds, a factor or frames per second"));
        }
        let channel = Channel::ALL.into_iter().find(|c| c.name() == channel).ok_or_else(|| {
            let names = Channel::ALL.map(Channel::name).join(", ");
            bad_input(format!("there is no channel `{channel}`"), &format!("Give one of {names}"))
        })?;
        let route = route.map(str::parse::<Route>).transpose();
        let options = RenderOptions {
            output: Some(path),
            path: route.map_err(|what| bad_input(what, "docs/render.md lists camera paths"))?,
            size,
            from: start,
            to: end,
            freeze,
            slow_motion,
            seconds,
            fps,
            channel,
            photo: Photo {
                shutter,
                aperture,
                focus: focus.map(focused).transpose()?,
                samples,
                projection: one_of(&Projection::ALL, Projection::name, projection, "projection")?,
                stereo: stereo.map(|s| one_of(&Stereo::ALL, Stereo::name, s, "stereo layout")).transpose()?,
                eye_distance,
                transparent,
                transfer: transfer.map(|t| one_of(&Transfer::ALL, Transfer::name, t, "transfer")).transpose()?,
            },
            force,
            device: named(device)?,
            ..RenderOptions::default()
        };
        let work = |file: &Path, _: &Path| listening(|l| films::film(file, &options, l).map(drop));
        crate::errors::warn(py, &self.with_file(py, work)?)
    }

    /// Pose and time of images (JPEG, PNG or WebP) of the scene: a dict per image, as in `cameras.json`. `start`: a
    /// camera file or `cameras.json` near them [the run's cameras]; `lens`: also find the focal length.
    #[pyo3(signature = (images, *, start=None, lens=false))]
    fn localise(
        &self,
        py: Python<'_>,
        images: Vec<PathBuf>,
        start: Option<PathBuf>,
        lens: bool,
    ) -> PyResult<Py<PyAny>> {
        let options = LocaliseOptions { start, lens, output: None };
        let mut found = Vec::new();
        let work = |file: &Path, _: &Path| {
            listening(|listener| {
                found = localise(file, &images, &options, listener)?;
                Ok(())
            })
        };
        let warnings = self.with_file(py, work)?;
        crate::errors::warn(py, &warnings)?;
        plain(py, &serde_json::Value::Array(found))
    }

    /// The scene with a list of edits replayed (docs/edit.md), in no file yet. `edits`: the text of a list, or the path
    /// of one.
    fn edit(&self, py: Python<'_>, edits: &Bound<'_, PyAny>) -> PyResult<Self> {
        let text: Option<String> =
            edits.extract().ok().filter(|text: &String| text.contains('\n') || text.contains('='));
        let path: PathBuf = if text.is_some() { PathBuf::new() } else { edits.extract()? };
        let mut warnings = Vec::new();
        let scene = self.with_file(py, |file, folder| {
            let list = match text {
                Some(text) => {
                    let list = folder.join("edits.toml");
                    std::fs::write(&list, text)
                        .map_err(|e| splat4d::Error::environment("the list could not be written", e))?;
                    list
                }
                None => path,
            };
            let out = folder.join("edited.safetensors");
            let options = EditOptions {
                scene: file.to_owned(),
                list: Some(list),
                output: Some(out.clone()),
                ..EditOptions::default()
            };
            warnings = listening(|listener| edit(&options, listener))?;
            Ok(read_scene(&out)?)
        })?;
        crate::errors::warn(py, &warnings)?;
        Ok(Self::made(scene, self.views.clone()))
    }

    /// Number of Gaussians, alive or not.
    fn __len__(&self) -> usize {
        self.source.scene.len()
    }

    fn __repr__(&self) -> String {
        let [from, to] = self.source.scene.clip;
        let place = self.path.as_ref().map_or("in memory".into(), |path| format!("{path:?}"));
        format!("Scene({place}, {} Gaussians, {from:.3} to {to:.3} s)", self.source.scene.len())
    }
}

impl Scene {
    /// Whether its run renders thin splats dimmed.
    fn smooth(&self) -> bool {
        self.source.run.as_ref().and_then(|r| r.recipe().ok()).is_some_and(|r| r.appearance.antialias)
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

/// The value of this name.
fn one_of<T: Copy>(all: &[T], name: impl Fn(T) -> &'static str, given: &str, what: &str) -> PyResult<T> {
    all.iter().copied().find(|one| name(*one) == given).ok_or_else(|| {
        let names: Vec<&str> = all.iter().map(|one| name(*one)).collect();
        bad_input(format!("there is no {what} `{given}`"), &format!("Give one of {}", names.join(", ")))
    })
}

/// A distance, or a pixel.
fn focused(focus: &Bound<'_, PyAny>) -> PyResult<Focus> {
    let distance = focus.extract::<f64>().map(Focus::Distance);
    distance
        .or_else(|_| focus.extract::<[f64; 2]>().map(Focus::Pixel))
        .map_err(|_| bad_input("`focus` is neither a distance nor a pixel", "Give a number of scene units, or (x, y)"))
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
