//! A depth map with its camera, as initial points are made of it.

use crate::Result;
use crate::capture::DepthKind;
use crate::capture::frames::{Frames, Picture};
use splat4d::scene::{Camera, Planes};

/// An image sees through a point if its depth there is larger by more than this share: beyond the noise of sensors and
/// the slant of surfaces within a pixel.
const THROUGH: f64 = 0.05;
/// Images whose longer side exceeds this many pixels are halved until it does not: they have more pixels than there are
/// seeds, and a hundred maps of that size fit into any memory.
const LONGEST_SIDE: usize = 640;

/// An image's map.
pub(super) struct Map {
    pub frame: usize,
    pub camera: Camera,
    pub time: f64,
    /// [1, h, w]; 0: not known.
    pub depth: Planes<f32>,
}

impl Map {
    /// The frame's metric map, its image made small in `picture`; nothing where it has none.
    pub(super) fn load(frames: &dyn Frames, frame: usize, picture: &mut Picture) -> Result<Option<Self>> {
        frames.load(frame, picture)?;
        if picture.depth.as_ref().is_none_or(|d| d.kind != DepthKind::Metric) {
            return Ok(None);
        }
        let mut camera = frames.camera(frame).clone();
        while camera.width.max(camera.height) > LONGEST_SIDE {
            picture.halve();
            camera = camera.downscaled(2);
        }
        let depth = picture.depth.as_ref().expect("just seen").values.clone();
        Ok(Some(Self { frame, camera, time: frames.time(frame).0, depth }))
    }

    /// Whether it sees a larger depth at the point.
    pub(super) fn sees_through(&self, point: [f64; 3]) -> bool {
        let Some(([u, v], z)) = self.camera.project(point) else { return false };
        let (w, h) = (self.depth.width as f64, self.depth.height as f64);
        if !(0.0..w).contains(&u) || !(0.0..h).contains(&v) {
            return false;
        }
        f64::from(self.depth.get(0, v as usize, u as usize)) > z * (1.0 + THROUGH)
    }
}
