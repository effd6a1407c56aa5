//! A camera path from key frames:
//!
//! ```json
//! {"fps": 30,
//!  "keys": [
//!    {"time": 0, "position": [0, 1, 4], "look_at": [0, 1, 0], "up": [0, 1, 0], "fov_y": 45, "scene_time": 0.0},
//!    {"time": 3, "world_to_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]], "scene_time": 0.8}
//! ]}
//! ```
//! `time` is the film's second; `scene_time` the scene's (left out: the scene plays along). `up` is the scene's own and
//! `fov_y` (degrees) the training cameras' by default. Positions follow a Catmull-Rom spline, rotations great arcs,
//! fields of view and scene times straight lines.

use crate::camera_file::{json, numbers, pose};
use crate::files::read_text;
use serde_json::Value;
use splat4d::math::Se3;
use splat4d::math::quat;
use splat4d::math::se3::{mat_vec, norm, sub};
use splat4d::scene::Camera;
use splat4d::{Error, Result};
use splat4d_train::settings::nearest;
use std::path::Path;

const KEYS: [&str; 7] = ["time", "scene_time", "position", "look_at", "up", "fov_y", "world_to_camera"];
/// Most keys: a key a frame for an hour.
const MAX_KEYS: usize = 200_000;

struct Pose {
    time: f64,
    scene_time: Option<f64>,
    center: [f64; 3],
    /// `cam_from_world`, wxyz.
    quat: [f64; 4],
    /// Radians.
    fov_y: Option<f64>,
}

/// Key frames in time.
pub(super) struct Track {
    /// Frames a second, where the file states so.
    pub fps: Option<f64>,
    keys: Vec<Pose>,
}

impl Track {
    pub(super) fn read(path: &Path, up: [f64; 3]) -> Result<Self> {
        Self::parse(&read_text(path)?, up).map_err(|e| e.at(path.display()))
    }

    pub(super) fn parse(text: &str, up: [f64; 3]) -> Result<Self> {
        let value = json(text)?;
        let fps = match value.get("fps").filter(|v| !v.is_null()) {
            None => None,
            Some(v) => Some(v.as_f64().filter(|f| (0.1..=1000.0).contains(f)).ok_or_else(|| {
                Error::input(format!("\"fps\" is {v}")).remedy("Give frames per second, 0.1 to 1000.")
            })?),
        };
        let list = value.get("keys").and_then(Value::as_array).filter(|k| !k.is_empty() && k.len() <= MAX_KEYS);
        let list = list.ok_or_else(|| {
            Error::input("the list \"keys\" is missing, empty or too long")
                .remedy("Write {\"keys\": [{\"time\": 0, \"position\": [0, 1, 4], \"look_at\": [0, 1, 0]}, ...]}.")
        })?;
        let mut keys: Vec<Pose> = Vec::with_capacity(list.len());
        for (i, value) in list.iter().enumerate() {
            let mut key = read_key(value, up).map_err(|e| e.at(format!("keys[{i}]")))?;
            if let Some(last) = keys.last() {
                if key.time <= last.time {
                    return Err(Error::input(format!("its time {} is not after {}", key.time, last.time))
                        .at(format!("keys[{i}]"))
                        .remedy("Put the keys in order of time, each later than the one before."));
                }
                // q and −q are one rotation; the nearer one gives the shorter way.
                if (0..4).map(|k| key.quat[k] * last.quat[k]).sum::<f64>() < 0.0 {
                    key.quat = key.quat.map(|x| -x);
                }
            }
            keys.push(key);
        }
        Ok(Self { fps, keys })
    }

    /// Seconds of film.
    pub(super) fn seconds(&self) -> f64 {
        self.keys[self.keys.len() - 1].time - self.keys[0].time
    }

    /// Camera and scene time at a second of the film (0 is the first key).
    pub(super) fn at(&self, seconds: f64, template: &Camera) -> (Camera, Option<f64>) {
        let t = self.keys[0].time + seconds;
        let n = self.keys.len();
        let after = self.keys.partition_point(|k| k.time <= t).clamp(1, (n - 1).max(1)).min(n - 1);
        let before = after.saturating_sub(1);
        let (a, b) = (&self.keys[before], &self.keys[after]);
        let u = if after > before { ((t - a.time) / (b.time - a.time)).clamp(0.0, 1.0) } else { 0.0 };
        let center = self.spline(before, after, u);
        let rotation = quat::to_rotation(slerp(a.quat, b.quat, u));
        let moved = mat_vec(&rotation, center);
        let cam_from_world = Se3 { rotation, translation: moved.map(|x| -x) };
        let default = 2.0 * (0.5 * template.height as f64 / template.intrinsics.fy).atan();
        let (fa, fb) = (a.fov_y.unwrap_or(default), b.fov_y.unwrap_or(default));
        let camera = Camera::with_fov_y(cam_from_world, fa + (fb - fa) * u, template.width, template.height);
        (camera, self.scene_time(t))
    }

    /// Cubic Hermite between two keys, tangents by the neighbours' difference (Catmull and Rom 1974, uneven times).
    fn spline(&self, i: usize, j: usize, u: f64) -> [f64; 3] {
        let (a, b) = (&self.keys[i], &self.keys[j]);
        let h = b.time - a.time;
        let tangent = |k: usize| -> [f64; 3] {
            let (p, q) = (&self.keys[k.saturating_sub(1)], &self.keys[(k + 1).min(self.keys.len() - 1)]);
            let span = (q.time - p.time).max(f64::MIN_POSITIVE);
            sub(q.center, p.center).map(|d| d / span)
        };
        let (ta, tb) = (tangent(i), tangent(j));
        let (u2, u3) = (u * u, u * u * u);
        std::array::from_fn(|k| {
            (2.0 * u3 - 3.0 * u2 + 1.0) * a.center[k]
                + (u3 - 2.0 * u2 + u) * h * ta[k]
                + (3.0 * u2 - 2.0 * u3) * b.center[k]
                + (u3 - u2) * h * tb[k]
        })
    }

    /// Straight lines between the keys that state a scene time.
    fn scene_time(&self, t: f64) -> Option<f64> {
        let timed = || self.keys.iter().filter_map(|k| k.scene_time.map(|s| (k.time, s)));
        let before = timed().take_while(|k| k.0 <= t).last();
        let after = timed().find(|k| k.0 > t);
        match (before, after) {
            (Some(a), Some(b)) => Some(a.1 + (b.1 - a.1) * (t - a.0) / (b.0 - a.0)),
            (a, b) => a.or(b).map(|k| k.1),
        }
    }
}

fn read_key(value: &Value, scene_up: [f64; 3]) -> Result<Pose> {
    let Some(object) = value.as_object() else {
        return Err(Error::input("is not an object { ... }").remedy("Write {\"time\": 0, \"position\": ...}."));
    };
    if let Some(key) = object.keys().find(|k| !KEYS.contains(&k.as_str())) {
        let near = nearest(key, &KEYS)
            .map_or_else(|| format!("Known: {}.", KEYS.join(", ")), |n| format!("Did you mean \"{n}\"?"));
        return Err(Error::input(format!("unknown key \"{key}\"")).remedy(near));
    }
    let number = |key: &str| match object.get(key).filter(|v| !v.is_null()) {
        None => Ok(None),
        Some(v) => v.as_f64().filter(|x| x.is_finite() && x.abs() < 1e9).map(Some).ok_or_else(|| {
            Error::input(format!("\"{key}\" is {v}, not a finite number")).remedy("Write a plain number.")
        }),
    };
    let vector = |key: &str| match object.get(key).filter(|v| !v.is_null()) {
        None => Ok(None),
        Some(v) => numbers(v).and_then(|n| <[f64; 3]>::try_from(n).ok()).map(Some).ok_or_else(|| {
            Error::input(format!("\"{key}\" is {v}, not three finite numbers")).remedy("Write [x, y, z].")
        }),
    };
    let time = number("time")?.ok_or_else(|| {
        Error::input("\"time\" is missing").remedy("Give the time of this key in the film, in seconds.")
    })?;
    let fov_y = number("fov_y")?;
    if let Some(fov) = fov_y.filter(|f| !(0.1..=170.0).contains(f)) {
        return Err(Error::input(format!("\"fov_y\" is {fov}")).remedy("Give degrees, 0.1 to 170."));
    }
    let cam_from_world = match (object.get("world_to_camera"), vector("position")?, vector("look_at")?) {
        (Some(matrix), None, None) => pose(matrix)?,
        (None, Some(eye), Some(target)) => {
            let up = vector("up")?.unwrap_or(scene_up);
            if norm(sub(target, eye)) < 1e-9 || norm(up) < 1e-9 {
                return Err(Error::input("position and look_at are the same point, or up is zero")
                    .remedy("Look at a point away from the camera."));
            }
            Se3::look_at(eye, target, up)
        }
        _ => {
            return Err(Error::input("the pose is incomplete or given twice")
                .remedy("Give either \"position\" and \"look_at\", or \"world_to_camera\"."));
        }
    };
    Ok(Pose {
        time,
        scene_time: number("scene_time")?,
        center: cam_from_world.inverse().translation,
        quat: quat::from_rotation(&cam_from_world.rotation),
        fov_y: fov_y.map(f64::to_radians),
    })
}

/// The great arc from a to b (Shoemake 1985); straight where they almost agree.
pub(super) fn slerp(a: [f64; 4], b: [f64; 4], u: f64) -> [f64; 4] {
    let cos = (0..4).map(|k| a[k] * b[k]).sum::<f64>().clamp(-1.0, 1.0);
    let (wa, wb) = if cos > 1.0 - 1e-9 {
        (1.0 - u, u)
    } else {
        let angle = cos.acos();
        (((1.0 - u) * angle).sin() / angle.sin(), (u * angle).sin() / angle.sin())
    };
    quat::normalize(std::array::from_fn(|k| wa * a[k] + wb * b[k])).0
}

#[cfg(test)]
mod tests {
    use super::*;

    const UP: [f64; 3] = [0.0, 1.0, 0.0];
    const PATH: &str = r#"{"fps": 24, "keys": [
        {"time": 1, "position": [0, 1, 4], "look_at": [0, 1, 0], "fov_y": 40, "scene_time": 0},
        {"time": 2, "position": [4, 1, 0], "look_at": [0, 1, 0]},
        {"time": 4, "position": [0, 1, -4], "look_at": [0, 1, 0], "fov_y": 60, "scene_time": 1.5}]}"#;

    #[test]
    fn the_path_passes_its_keys_smoothly() {
        let track = Track::parse(PATH, UP).unwrap();
        let template = Camera::with_fov_y(Se3::IDENTITY, 0.8, 64, 48);
        assert_eq!((track.fps, track.seconds()), (Some(24.0), 3.0));
        for (seconds, eye, scene) in
            [(0.0, [0.0, 1.0, 4.0], 0.0), (1.0, [4.0, 1.0, 0.0], 0.5), (3.0, [0.0, 1.0, -4.0], 1.5)]
        {
            let (camera, time) = track.at(seconds, &template);
            assert!(norm(sub(camera.center(), eye)) < 1e-9, "{seconds}: {:?}", camera.center());
            assert!((time.unwrap() - scene).abs() < 1e-12);
            let (pixel, _) = camera.project([0.0, 1.0, 0.0]).unwrap();
            assert!((pixel[0] - 32.0).abs() < 1e-6 && (pixel[1] - 24.0).abs() < 1e-6, "looks at its target");
        }
        let speed = |s: f64| {
            let (a, b) = (track.at(s - 1e-5, &template).0.center(), track.at(s + 1e-5, &template).0.center());
            sub(b, a).map(|d| d / 2e-5)
        };
        assert!(norm(sub(speed(1.0 - 1e-4), speed(1.0 + 1e-4))) < 0.01, "no jolt at a key");
    }

    #[test]
    fn one_key_is_a_static_camera() {
        let track = Track::parse(r#"{"keys": [{"time": 0, "position": [0,0,3], "look_at": [0,0,0]}]}"#, UP).unwrap();
        let template = Camera::with_fov_y(Se3::IDENTITY, 0.8, 64, 48);
        let (camera, time) = track.at(5.0, &template);
        assert!(norm(sub(camera.center(), [0.0, 0.0, 3.0])) < 1e-12 && time.is_none());
    }

    #[test]
    fn wrong_paths_are_explained() {
        for (text, reason) in [
            (r#"{"keys": []}"#, "empty"),
            (r#"{"keys": [3]}"#, "keys[0]"),
            (r#"{"keys": [{"position": [0,0,3], "look_at": [0,0,0]}]}"#, "time"),
            (r#"{"keys": [{"time": 0, "position": [0,0,3], "lookat": [0,0,0]}]}"#, "\"look_at\""),
            (r#"{"keys": [{"time": 0, "position": [0,0,3]}]}"#, "incomplete"),
            (r#"{"keys": [{"time": 0, "position": [0,0,3], "look_at": [0,0,3]}]}"#, "the same point"),
            (r#"{"keys": [{"time": 0, "position": [0,0], "look_at": [0,0,3]}]}"#, "three"),
            (r#"{"keys": [{"time": 0, "position": [0,0,3], "look_at": [0,0,0], "fov_y": 0}]}"#, "fov_y"),
            (r#"{"fps": -1, "keys": [{"time": 0, "position": [0,0,3], "look_at": [0,0,0]}]}"#, "fps"),
            (&PATH.replace("\"time\": 2", "\"time\": 1"), "order of time"),
            (&PATH[..60], "truncated"),
        ] {
            let message = Track::parse(text, UP).map(|_| ()).unwrap_err().to_string();
            assert!(message.contains(reason), "{text}: {message}");
        }
    }
}
