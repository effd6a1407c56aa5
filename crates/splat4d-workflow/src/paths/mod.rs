//! Camera paths: pose and scene time of every frame.

mod keys;
mod orbit;

use crate::camera_file::{MAX_PIXELS, MAX_SIDE};
use splat4d::math::se3::mat_vec;
use splat4d::math::{Se3, quat};
use splat4d::scene::{Camera, Intrinsics};
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

pub use orbit::Stage;

/// Reads key frames and states what is wrong with them.
pub fn check_keys(text: &str) -> Result<()> {
    keys::Track::parse(text, [0.0, 1.0, 0.0]).map(drop)
}

/// One frame of a film.
#[derive(Clone, Debug)]
pub struct Shot {
    /// From where.
    pub camera: Camera,
    /// When, seconds on the scene clock.
    pub time: f64,
}

impl Shot {
    /// The shot a share of the way to another one: positions and numbers along lines, rotations along great arcs. Shares
    /// below 0 and above 1 continue them.
    pub fn towards(&self, other: &Self, share: f64) -> Self {
        let mix = |a: f64, b: f64| a + (b - a) * share;
        let (a, b) = (&self.camera, &other.camera);
        let from = quat::from_rotation(&a.cam_from_world.rotation);
        let mut to = quat::from_rotation(&b.cam_from_world.rotation);
        // q and −q are one rotation; the nearer one gives the shorter way.
        if (0..4).map(|k| from[k] * to[k]).sum::<f64>() < 0.0 {
            to = to.map(|x| -x);
        }
        let rotation = quat::to_rotation(keys::slerp(from, to, share));
        let (ca, cb) = (a.center(), b.center());
        let translation = mat_vec(&rotation, std::array::from_fn(|k| mix(ca[k], cb[k]))).map(|x| -x);
        let (i, j) = (&a.intrinsics, &b.intrinsics);
        let intrinsics =
            Intrinsics { fx: mix(i.fx, j.fx), fy: mix(i.fy, j.fy), cx: mix(i.cx, j.cx), cy: mix(i.cy, j.cy) };
        let camera = Camera { cam_from_world: Se3 { rotation, translation }, intrinsics, ..a.clone() };
        Self { camera, time: mix(self.time, other.time) }
    }
}

/// A camera of the data set that the scene was trained on.
#[derive(Clone, Debug)]
pub struct View {
    /// The camera.
    pub camera: Camera,
    /// The camera's name in the data set.
    pub name: String,
    /// Seconds on the scene clock.
    pub time: f64,
    /// Kept from training.
    pub held: bool,
}

/// A route through space.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Route {
    /// Around the scene, or to and fro within the arc of the training cameras.
    Orbit,
    /// The views that were kept from training, one frame each.
    Test,
    /// The training views, one frame each.
    Train,
    /// One camera of the data set is static while time continues.
    Camera(String),
    /// Key frames from a JSON file.
    Keys(PathBuf),
}

impl std::str::FromStr for Route {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        match text {
            "orbit" => Ok(Self::Orbit),
            "test" => Ok(Self::Test),
            "train" => Ok(Self::Train),
            _ if text.starts_with("camera=") => Ok(Self::Camera(text["camera=".len()..].to_owned())),
            _ if text.to_ascii_lowercase().ends_with(".json") => Ok(Self::Keys(text.into())),
            _ => Err("expected orbit, test, train, camera=NAME or a key frame file FILE.json".into()),
        }
    }
}

/// Which times are shown, and how fast.
#[derive(Clone, Debug)]
pub struct Clock {
    /// First second of the scene that is shown.
    pub from: f64,
    /// Last second of the scene that is shown.
    pub to: f64,
    /// Everything at this one time.
    pub freeze: Option<f64>,
    /// Slow-motion factor; `None`: that of the route.
    pub slow_motion: Option<f64>,
    /// Length of the film, in place of `slow_motion`; `None`: as the route likes.
    pub seconds: Option<f64>,
    /// Frames a second of the film.
    pub fps: f64,
}

/// Shortest film of an orbit, seconds: faster turns are hard to follow.
const ORBIT_SECONDS: f64 = 6.0;
/// Longest film of an orbit unless slow motion is requested, seconds.
const ORBIT_SECONDS_MAX: f64 = 20.0;
/// Seconds of an orbit's film of a clip that plays for so long.
pub fn orbit_seconds(playing: f64) -> f64 {
    playing.clamp(ORBIT_SECONDS, ORBIT_SECONDS_MAX)
}

/// Most frames of a film: an hour at 60 frames a second would be a slip.
const MAX_FRAMES: f64 = 200_000.0;

impl Clock {
    /// Seconds of film when the scene plays alone.
    fn playing(&self) -> f64 {
        self.seconds.unwrap_or((self.to - self.from) * self.slow_motion.unwrap_or(1.0))
    }

    /// The scene's second, `share` (0 to 1) of the film.
    fn at(&self, share: f64) -> f64 {
        self.freeze.unwrap_or(self.from + (self.to - self.from) * share)
    }

    fn frames(&self, seconds: f64) -> Result<usize> {
        let frames = (seconds * self.fps).round().max(1.0);
        if frames > MAX_FRAMES {
            return Err(Error::input(format!("the film would have {frames} frames")).remedy(format!(
                "Take a shorter time range, fewer frames per second or less slow motion: {MAX_FRAMES} is the most."
            )));
        }
        Ok(frames as usize)
    }
}

/// All frames of a film. `size` overrides the cameras' own; `stage` is the place for orbits.
pub fn shots(
    route: &Route,
    clock: &Clock,
    views: &[View],
    stage: &Stage,
    size: Option<[usize; 2]>,
) -> Result<Vec<Shot>> {
    let fit = |camera: &Camera| size.map_or_else(|| camera.clone(), |s| resized(camera, s));
    if clock.seconds.is_some() && !matches!(route, Route::Orbit | Route::Camera(_)) {
        return Err(Error::input("option `seconds` sets the length of an orbit or of the film of one camera")
            .remedy("Leave it out: views and key frames have times of their own."));
    }
    match route {
        Route::Orbit => {
            let seconds = match (clock.seconds, clock.freeze, clock.slow_motion) {
                (Some(_), ..) | (None, None, Some(_)) => clock.playing(),
                _ => orbit_seconds(clock.playing()),
            };
            let frames = clock.frames(seconds)?;
            let shot = |i: usize| {
                let share = i as f64 / frames as f64;
                let last = (frames - 1).max(1) as f64;
                Shot { camera: fit(&stage.orbit(share)), time: clock.at(i as f64 / last) }
            };
            Ok((0..frames).map(shot).collect())
        }
        Route::Test | Route::Train => {
            let held = *route == Route::Test;
            // Views outside the requested range are left out; a frozen time shows each camera once.
            let mut seen: Vec<&str> = Vec::new();
            let mut out = Vec::new();
            for view in views.iter().filter(|v| v.held == held) {
                if clock.freeze.is_some() {
                    if seen.contains(&view.name.as_str()) {
                        continue;
                    }
                    seen.push(&view.name);
                } else if view.time < clock.from - 1e-9 || view.time > clock.to + 1e-9 {
                    continue;
                }
                out.push(Shot { camera: fit(&view.camera), time: clock.freeze.unwrap_or(view.time) });
            }
            if out.is_empty() {
                let which = if held { "held-out" } else { "training" };
                return Err(Error::input(format!("there is no {which} view in that time range"))
                    .remedy("Choose another option `path`, option `from` or option `to`; `splat4d info` lists what a run holds."));
            }
            Ok(out)
        }
        Route::Camera(name) => {
            let Some(view) = views.iter().find(|v| v.name == *name) else {
                return Err(Error::input(format!("the data set has no camera `{name}`")).remedy(known_cameras(views)));
            };
            let still = clock.freeze.is_some() && clock.seconds.is_none();
            let seconds = if still { 1.0 / clock.fps } else { clock.playing() };
            // One frame more, so that both ends of the range are shown at the film's own frame times.
            let frames = clock.frames(seconds)? + usize::from(clock.freeze.is_none() && clock.to > clock.from);
            let last = (frames - 1).max(1) as f64;
            let camera = fit(&view.camera);
            Ok((0..frames).map(|i| Shot { camera: camera.clone(), time: clock.at(i as f64 / last) }).collect())
        }
        Route::Keys(file) => {
            let template = fit(&stage.template);
            let track = keys::Track::read(file, stage.up)?;
            let frames = clock.frames(track.seconds())?;
            let shot = |i: usize| {
                let film = i as f64 / clock.fps;
                let (camera, scene_time) = track.at(film, &template);
                let playing = (clock.from + film / clock.slow_motion.unwrap_or(1.0)).min(clock.to);
                Shot { camera, time: clock.freeze.or(scene_time).unwrap_or(playing) }
            };
            Ok((0..frames).map(shot).collect())
        }
    }
}

/// Frames a second that a key frame file requests.
pub fn fps_of(file: &Path) -> Result<Option<f64>> {
    Ok(keys::Track::read(file, [0.0, 1.0, 0.0])?.fps)
}

fn known_cameras(views: &[View]) -> String {
    let mut names: Vec<&str> = Vec::new();
    for view in views {
        if !names.contains(&view.name.as_str()) {
            names.push(&view.name);
        }
    }
    match names.len() {
        0 => "This file has no cameras. Use option `path` orbit or a key frame file.".into(),
        n if n > 24 => format!("There are {n}, for instance {}.", names[..24].join(", ")),
        _ => format!("There are {}.", names.join(", ")),
    }
}

/// The same view on another raster: the vertical field of view is kept.
pub fn resized(camera: &Camera, [width, height]: [usize; 2]) -> Camera {
    let k = &camera.intrinsics;
    let scale = height as f64 / camera.height as f64;
    // The principal point keeps its offset from the middle.
    let center = |c: f64, old: usize, new: usize| 0.5 * new as f64 + (c - 0.5 * old as f64) * scale;
    let intrinsics = Intrinsics {
        fx: k.fx * scale,
        fy: k.fy * scale,
        cx: center(k.cx, camera.width, width),
        cy: center(k.cy, camera.height, height),
    };
    Camera { intrinsics, width, height, ..camera.clone() }
}

/// Reads `640x480`.
pub fn parse_size(text: &str) -> std::result::Result<[usize; 2], String> {
    let (w, h) = text.split_once(['x', 'X', '×']).ok_or("write width x height, for instance 1280x720")?;
    let side = |t: &str| t.trim().parse::<usize>().ok().filter(|n| (1..=MAX_SIDE).contains(n));
    match (side(w), side(h)) {
        (Some(w), Some(h)) if w * h <= MAX_PIXELS => Ok([w, h]),
        _ => Err(format!("sides are 1 to {MAX_SIDE} pixels, at most {MAX_PIXELS} in all")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(name: &str, x: f64, time: f64, held: bool) -> View {
        let pose = Se3::look_at([x, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        View { camera: Camera::with_fov_y(pose, 0.8, 40, 30), name: name.into(), time, held }
    }

    fn clock() -> Clock {
        Clock { from: 0.0, to: 1.0, freeze: None, slow_motion: None, seconds: None, fps: 10.0 }
    }

    #[test]
    fn dataset_cameras_keep_their_times_unless_frozen() {
        let views = [view("a", 0.0, 0.0, true), view("a", 0.0, 0.5, true), view("b", 1.0, 0.5, false)];
        let stage = Stage::of_views(&views, [0.0, 1.0, 0.0]);
        let times = |c: &Clock, r: Route| -> Vec<f64> {
            shots(&r, c, &views, &stage, None).unwrap().iter().map(|s| s.time).collect()
        };
        assert_eq!(times(&clock(), Route::Test), [0.0, 0.5]);
        assert_eq!(times(&clock(), Route::Train), [0.5]);
        let frozen = Clock { freeze: Some(0.3), ..clock() };
        assert_eq!(times(&frozen, Route::Test), [0.3]);
        let playing = times(&Clock { slow_motion: Some(2.0), ..clock() }, Route::Camera("b".into()));
        assert_eq!((playing.len(), playing[0], playing[20]), (21, 0.0, 1.0));
        let short = Clock { seconds: Some(0.5), ..clock() };
        assert_eq!(times(&short, Route::Camera("b".into())).len(), 6, "both ends of the range are shown");
        let orbit = times(&short, Route::Orbit);
        assert_eq!((orbit.len(), orbit[0], orbit[4]), (5, 0.0, 1.0), "shorter than an orbit is by itself");
        assert!(
            shots(&Route::Test, &short, &views, &stage, None).unwrap_err().to_string().contains("option `seconds`")
        );
        let message = shots(&Route::Camera("c".into()), &clock(), &views, &stage, None).unwrap_err().to_string();
        assert!(message.contains("a, b"), "{message}");
        assert!(shots(&Route::Test, &Clock { from: 2.0, to: 3.0, ..clock() }, &views, &stage, None).is_err());
    }

    #[test]
    fn a_resized_camera_sees_the_same_height() {
        let camera = view("a", 0.0, 0.0, true).camera;
        let large = resized(&camera, [160, 90]);
        let (p, q) = (camera.project([0.0, 1.0, 0.0]).unwrap().0, large.project([0.0, 1.0, 0.0]).unwrap().0);
        assert!((q[1] - p[1] * 3.0).abs() < 1e-9 && (q[0] - 80.0).abs() < 1e-9);
        assert_eq!(parse_size("1280x720"), Ok([1280, 720]));
        for bad in ["", "12", "0x5", "axb", "99999x1", "16384x16384"] {
            assert!(parse_size(bad).is_err(), "{bad}");
        }
    }
}
