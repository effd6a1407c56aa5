//! The JSON of a playback file.

use super::rungs::{Rung, is_ladder};
use crate::layers::{Head, Layer, Scene};
use crate::math::Se3;
use crate::scene::features::MOST_CHANNELS;
use crate::scene::{Camera, Intrinsics, Lens, labels};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Metadata of the scene, from the file's JSON. Seconds, scene units, world axes as captured.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Meta {
    /// First and last second.
    pub clip: [f64; 2],
    /// Frames a second of the capture.
    pub fps: f64,
    /// The direction that is up, unit.
    pub up: [f64; 3],
    /// World coordinates of the scene's origin; zero unless they are far from the origin of their world.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub offset: [f64; 3],
    /// Colour behind everything, 0 to 1.
    pub background: [f32; 3],
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: usize,
    /// Records in all pages.
    pub gaussians: usize,
    /// Metres a scene unit, where known.
    #[serde(default)]
    pub unit: Option<f64>,
    /// From when on the scene shows what was predicted, seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub predicted: Option<f64>,
    /// The scene's title.
    #[serde(default)]
    pub title: String,
    /// Least and greatest corner of the means.
    #[serde(default, rename = "box", skip_serializing_if = "Option::is_none")]
    pub bounds: Option<[[f64; 3]; 2]>,
    /// The first view.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub view: Option<Viewpoint>,
    /// Cameras of the capture.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cameras: Vec<NamedCamera>,
    /// The default camera path.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub path: Vec<PathKey>,
    /// Names of the labels that pages number.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub labels: Vec<String>,
    /// Least and greatest number of each feature channel, between which pages count in steps.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub features: Vec<[f32; 2]>,
    /// Rungs of a bitrate ladder, the coarsest first; the last one has everything.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ladder: Vec<Rung>,
    /// Of a file that grows: the parts that are in it, as their maker names them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub parts: Vec<String>,
    /// Of a growing file: spans of the clip, seconds, of which only the part shared by all is present yet.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub missing: Vec<[f64; 2]>,
}

/// A viewpoint.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Viewpoint {
    /// The eye.
    pub position: [f64; 3],
    /// The point in the middle of the image.
    pub target: [f64; 3],
    /// Upwards in the image.
    pub up: [f64; 3],
    /// Vertical field of view, degrees.
    pub fov_y: f64,
}

/// A camera of the capture; its images are without distortion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NamedCamera {
    /// As the capture calls it.
    pub name: String,
    /// 3x4, row-major: takes camera points (x right, y down, z forward) into the world.
    pub world_from_camera: [f64; 12],
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// Horizontal focal length, pixels.
    pub fx: f64,
    /// Vertical focal length, pixels.
    pub fy: f64,
    /// Principal point, pixels; the centre of the first pixel is at 0.5.
    pub cx: f64,
    /// Principal point, pixels.
    pub cy: f64,
    /// Nothing as near as this or nearer is rendered, scene units; readers without support for it render a little more.
    #[serde(default = "nothing_nearer")]
    pub near: f64,
}

fn is_zero(offset: &[f64; 3]) -> bool {
    *offset == [0.0; 3]
}

fn nothing_nearer() -> f64 {
    Camera::NEAR
}

impl Default for NamedCamera {
    /// No camera, but for the near distance.
    fn default() -> Self {
        let (name, world_from_camera) = (String::new(), [0.0; 12]);
        let [fx, fy, cx, cy] = [0.0; 4];
        Self { name, world_from_camera, width: 0, height: 0, fx, fy, cx, cy, near: Camera::NEAR }
    }
}

/// A key of a camera path.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PathKey {
    /// Seconds from the path's start.
    pub at: f64,
    /// The eye.
    pub position: [f64; 3],
    /// The point in the middle of the image.
    pub target: [f64; 3],
    /// Upwards in the image.
    pub up: [f64; 3],
    /// Vertical field of view, degrees.
    pub fov_y: f64,
    /// Second of the scene; none: time runs.
    #[serde(default)]
    pub time: Option<f64>,
}

/// Largest distance of a camera's rotation from an orthogonal matrix, per element: six digits of text are enough.
const NOT_A_ROTATION: f64 = 1e-3;

impl NamedCamera {
    /// The camera of the renderer with this name.
    pub fn new(name: &str, camera: &Camera) -> Self {
        let world = camera.cam_from_world.inverse();
        let cell = |i: usize| if i % 4 < 3 { world.rotation[i / 4][i % 4] } else { world.translation[i / 4] };
        let Intrinsics { fx, fy, cx, cy } = camera.intrinsics;
        let (width, height) = (camera.width, camera.height);
        let (name, near) = (name.to_owned(), camera.near);
        Self { name, world_from_camera: std::array::from_fn(cell), width, height, fx, fy, cx, cy, near }
    }

    /// For the renderer; none where the numbers are no camera.
    pub fn camera(&self) -> Option<Camera> {
        let m = &self.world_from_camera;
        let world = Se3 {
            rotation: std::array::from_fn(|i| std::array::from_fn(|j| m[4 * i + j])),
            translation: [m[3], m[7], m[11]],
        };
        let finite = m.iter().chain([&self.fx, &self.fy, &self.cx, &self.cy, &self.near]).all(|x| x.is_finite());
        let rigid = world.orthogonality_error() <= NOT_A_ROTATION && world.det() > 0.0;
        let sound = finite && rigid && self.fx > 0.0 && self.fy > 0.0 && self.width > 0 && self.height > 0;
        sound.then(|| Camera {
            cam_from_world: world.inverse(),
            intrinsics: Intrinsics { fx: self.fx, fy: self.fy, cx: self.cx, cy: self.cy },
            lens: Lens::Pinhole,
            width: self.width,
            height: self.height,
            near: self.near,
        })
    }
}

impl Meta {
    /// Refuses what no reader could render. Errors: the first field that is out of range, by name.
    pub(super) fn check(&self) -> Result<()> {
        let wrong = |what: &str| Err(Error::input(format!("the playback file's {what}")));
        let finite = |values: &[f64]| values.iter().all(|x| x.is_finite());
        if !finite(&self.clip) || self.clip[0] > self.clip[1] {
            return wrong("`clip` is not a first and a last second");
        }
        if !(self.fps.is_finite() && self.fps > 0.0) {
            return wrong("`fps` is not a positive number");
        }
        if !finite(&self.up) || self.up == [0.0; 3] {
            return wrong("`up` is not a direction");
        }
        if !finite(&self.offset) {
            return wrong("`offset` is not finite");
        }
        if !self.background.iter().all(|x| x.is_finite()) {
            return wrong("`background` is not a colour");
        }
        if self.sh_degree > crate::math::sh::MAX_DEGREE {
            return wrong("`sh_degree` is above 3");
        }
        if self.unit.is_some_and(|u| !(u.is_finite() && u > 0.0)) {
            return wrong("`unit` is not a positive number");
        }
        if self.bounds.is_some_and(|b| !finite(b.as_flattened())) {
            return wrong("`box` is not finite");
        }
        if !is_ladder(&self.ladder) {
            return wrong("`ladder` is not a list of rungs with rising rates and tiers");
        }
        let sound = |[low, high]: &[f32; 2]| low.is_finite() && high.is_finite() && low <= high;
        if self.features.len() > MOST_CHANNELS || !self.features.iter().all(sound) {
            return wrong("`features` are not ranges of 1 to 64 channels");
        }
        if self.labels.is_empty() { Ok(()) } else { labels::check(&self.labels) }
    }

    /// Layers as the scene that this is about.
    pub(super) fn scene(&self, layers: Vec<Layer<f32>>) -> Scene<f32> {
        let Self { background, clip, fps, up, offset, .. } = *self;
        Scene { layers, background, clip, fps, up, offset, head: Head::Identity, labels: self.labels.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_round_trips_and_invalid_text_is_refused() {
        let pose = Se3::look_at([1.0, -2.0, 3.0], [0.2, 0.1, 0.0], [0.0, -1.0, 0.0]);
        let camera = Camera::with_fov_y(pose, 0.7, 320, 200);
        let named = NamedCamera::new("left", &camera);
        assert_eq!(
            [3, 7, 11].map(|i| (named.world_from_camera[i] * 1e9).round() / 1e9),
            [1.0, -2.0, 3.0],
            "its centre"
        );
        let back = named.camera().unwrap();
        let x = [0.3, 0.4, 0.5];
        let (a, b) = (camera.cam_from_world.apply(x), back.cam_from_world.apply(x));
        assert!((0..3).all(|k| (a[k] - b[k]).abs() < 1e-12), "{a:?} {b:?}");
        assert_eq!((back.intrinsics, back.width, back.height), (camera.intrinsics, 320, 200));
        let near = NamedCamera::new("near", &Camera { near: 0.3, ..camera.clone() });
        let text = serde_json::to_string(&near).unwrap();
        assert_eq!(serde_json::from_str::<NamedCamera>(&text).unwrap().camera().unwrap().near, 0.3);
        let without = serde_json::from_str::<NamedCamera>(&text.replace(",\"near\":0.3", "")).unwrap();
        assert_eq!(without.near, Camera::NEAR, "files of older writers say nothing of it");
        let mut flat = named.clone();
        flat.world_from_camera[0] += 0.1;
        assert!(flat.camera().is_none() && NamedCamera { fx: -1.0, ..named }.camera().is_none());
    }
}
