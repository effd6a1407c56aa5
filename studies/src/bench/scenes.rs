//! The pinned scenes: always the same Gaussians from the same places, so that figures of different days compare.

use splat4d::layers::{Layer, Scene};
use splat4d::math::{Rng, Se3, sh};
use splat4d::motion::{Spacetime, SpacetimeSpec};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{Born, Camera, GEOMETRY, LifeKind, Params, RowEdit, SH, Space, Time};
use splat4d::{Error, Result};
use splat4d_workflow::source::Source;
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Views of a scene; figures are means over them.
pub(super) const VIEWS: usize = 8;
/// The trained scene of the bundled capture, from the root of the repository.
const KNIGHT: &str = "examples/knight.s4d";
/// Between the cameras of neighbouring views of T and U: coprime to the capture's 20, so that all sides are seen.
const CAMERA_STEP: usize = 7;

/// Which scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Name {
    /// 500,000 static Gaussians with spherical harmonics of degree 3, 1280x720
    #[value(name = "S")]
    S,
    /// The bundled capture's scene, 30,000 moving Gaussians, 400x400
    #[value(name = "T")]
    T,
    /// The same, 800x800
    #[value(name = "U")]
    U,
    /// 100,000 random Gaussians with spherical harmonics of degree 3, 800x800
    #[value(name = "A")]
    A,
    /// 500,000 of them, 1920x1080
    #[value(name = "B")]
    B,
    /// 1,000,000 of them, 1920x1080
    #[value(name = "C")]
    C,
}

impl Name {
    /// Those of the CPU, the large one last: peaks of memory are those of a process that has held nothing larger.
    pub(super) const ALL: [Self; 3] = [Self::T, Self::U, Self::S];
    /// Those of a GPU.
    #[cfg(feature = "gpu")]
    pub(super) const OF_GPU: [Self; 3] = [Self::A, Self::B, Self::C];

    /// Gaussians and image of a scene that is synthetic.
    fn made(self) -> Option<(usize, [usize; 2])> {
        match self {
            Self::A => Some((100_000, [800, 800])),
            Self::B => Some((500_000, [1920, 1080])),
            Self::C => Some((1_000_000, [1920, 1080])),
            Self::S | Self::T | Self::U => None,
        }
    }

    pub(super) fn letter(self) -> &'static str {
        match self {
            Self::S => "S",
            Self::T => "T",
            Self::U => "U",
            Self::A => "A",
            Self::B => "B",
            Self::C => "C",
        }
    }
}

/// Folder of scenes, if not the usual one.
#[derive(Clone, Debug, Default)]
pub(super) struct Places {
    pub playbot: Option<PathBuf>,
    pub file: Option<PathBuf>,
}

impl Places {
    fn of(&self, name: Name) -> (Option<&Path>, &'static str) {
        match name {
            Name::S => (self.playbot.as_deref(), "--playbot FOLDER"),
            _ => (Some(self.file.as_deref().unwrap_or(Path::new(KNIGHT))), "--file FILE"),
        }
    }
}

/// From where, and when.
#[derive(Clone, Debug)]
pub(super) struct View {
    pub camera: Camera,
    pub time: Time,
}

/// A scene and how it is examined.
#[derive(Debug)]
pub(super) struct Pinned {
    pub name: String,
    pub scene: Scene<f32>,
    pub views: Vec<View>,
}

/// Why a scene is not measured.
pub(super) struct Skipped(pub String);

impl Pinned {
    /// Reads a scene. The inner error states that its file is not there, which is not a fault.
    pub(super) fn open(name: Name, places: &Places) -> Result<std::result::Result<Self, Skipped>> {
        if let Some((count, size)) = name.made() {
            return Ok(Ok(made_up(name.letter(), count, size)));
        }
        let (path, option) = places.of(name);
        let Some(path) = path.filter(|p| p.exists()) else {
            let letter = name.letter();
            let missing =
                path.map_or_else(|| "its file was not given".into(), |p| format!("{} does not exist", p.display()));
            return Ok(Err(Skipped(format!("scene {letter} is skipped: {missing}; name it with {option}"))));
        };
        let source = Source::open(path)?;
        splat4d_workflow::source::not_empty(&source.scene, path)?;
        let views = match name {
            Name::S => around(),
            Name::T => of_the_capture(&source, path, 400)?,
            _ => of_the_capture(&source, path, 800)?,
        };
        Ok(Ok(Self { name: name.letter().into(), scene: in_one_layer(source.scene), views }))
    }
}

/// Eight places around the robot, at its height.
fn around() -> Vec<View> {
    const TARGET: [f64; 3] = [0.0, -0.52, 0.0];
    const DISTANCE: f64 = 1.5;
    const FOV_Y: f64 = 50.0;
    let view = |k: usize| {
        let a = TAU * k as f64 / VIEWS as f64;
        let eye = [TARGET[0] + DISTANCE * a.sin(), TARGET[1], TARGET[2] - DISTANCE * a.cos()];
        let pose = Se3::look_at(eye, TARGET, [0.0, -1.0, 0.0]);
        View { camera: Camera::with_fov_y(pose, FOV_Y.to_radians(), 1280, 720), time: Time(0.0) }
    };
    (0..VIEWS).map(view).collect()
}

/// Random Gaussians in a box, from eight places around it. The box is covered as often whatever their number.
pub(super) fn made_up(name: &str, count: usize, [width, height]: [usize; 2]) -> Pinned {
    const BOX: [f64; 3] = [4.0, 2.2, 4.0];
    const DISTANCE: f64 = 5.0;
    const FOV_Y: f64 = 0.55;
    /// Typical scale at half a million: about two pixels of standard deviation.
    const SCALE: f64 = 0.004;
    const AT: f64 = 500_000.0;
    let (mut params, rng) = (Params::new(count, sh::MAX_COEFFS, LifeKind::Infinite.columns()), Rng::new(1, "made", 0));
    let motion = Spacetime::new(SpacetimeSpec::default(), &mut params).expect("a built-in model fits");
    let scale = (SCALE * (AT / count as f64).sqrt()).ln();
    let [geometry, colors] = params.get_mut([GEOMETRY, SH]);
    for j in 0..count {
        let r = rng.fork(j as u64);
        let mean: [f32; 3] = std::array::from_fn(|k| (BOX[k] * (r.uniform(k as u64) - 0.5)) as f32);
        geometry.write(j, 0, mean);
        geometry.write::<4>(j, QUAT, std::array::from_fn(|k| r.normal(10 + k as u64) as f32));
        geometry.write::<3>(j, LOG_SCALE, std::array::from_fn(|k| (scale + 0.5 * r.normal(20 + k as u64)) as f32));
        geometry.set(j, OPACITY, r.normal(4) as f32);
        (0..colors.width()).for_each(|c| colors.set(j, c, (0.4 * (r.uniform(30 + c as u64) - 0.5)) as f32));
    }
    let layer = Layer::new("made", params, Arc::new(motion), LifeKind::Infinite);
    let scene = Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, up: [0.0, -1.0, 0.0], ..Scene::default() };
    let view = |k: usize| {
        let a = TAU * k as f64 / VIEWS as f64;
        let pose = Se3::look_at([DISTANCE * a.sin(), 0.0, -DISTANCE * a.cos()], [0.0; 3], [0.0, -1.0, 0.0]);
        let time = Time((k as f64 + 0.5) / VIEWS as f64);
        View { camera: Camera::with_fov_y(pose, FOV_Y, width, height), time }
    };
    Pinned { name: name.into(), scene, views: (0..VIEWS).map(view).collect() }
}

/// Eight of the capture's cameras over its clip; square images with the same horizontal field of view.
fn of_the_capture(source: &Source, path: &Path, size: usize) -> Result<Vec<View>> {
    let cameras = source.views()?;
    if cameras.is_empty() {
        return Err(Error::input("it has no cameras to render from")
            .at(path.display())
            .remedy("Give a run, or a .s4d that was baked from one."));
    }
    let clip = source.scene.clip;
    let view = |k: usize| {
        let camera = &cameras[k * CAMERA_STEP % cameras.len()].camera;
        let across = 2.0 * (0.5 * camera.width as f64 / camera.intrinsics.fx).atan();
        let time = Time(clip[0] + (clip[1] - clip[0]) * (k as f64 + 0.5) / VIEWS as f64);
        View { camera: Camera::with_fov_y(camera.cam_from_world, across, size, size), time }
    };
    Ok((0..VIEWS).map(view).collect())
}

/// The pages of a playback file as the one layer that they were before they were baked. Layers that differ in their
/// motion, their lifespan or their span stay apart.
fn in_one_layer(mut scene: Scene<f32>) -> Scene<f32> {
    let [first, rest @ ..] = &scene.layers[..] else { return scene };
    let widths = |l: &Layer| l.params.keys().map(|k| l.params[k].width()).collect::<Vec<_>>();
    let alike = |l: &Layer| {
        l.motion.spec() == first.motion.spec()
            && l.life == first.life
            && l.span == first.span
            && widths(l) == widths(first)
    };
    if rest.is_empty() || !rest.iter().all(alike) {
        return scene;
    }
    let mut whole = first.clone();
    let mut edit = RowEdit::identity(Space::Gaussians, first.params.len());
    for _ in 0..rest.iter().map(|l| l.params.len()).sum() {
        edit.push(0, Born::Kept);
    }
    whole.params.apply(&edit);
    let mut row = first.params.len();
    for layer in rest {
        for key in layer.params.keys() {
            let from = &layer.params[key];
            let [to] = whole.params.get_mut([key]);
            for i in 0..layer.params.len() {
                (0..from.width()).for_each(|c| to.set(row + i, c, from.get(i, c)));
            }
        }
        row += layer.params.len();
    }
    scene.layers = vec![whole];
    scene
}
