//! A synthetic capture: a ring of cameras around a shaded ball that moves in front of a striped sky.

mod bed;
mod depth;
mod flow;
mod geometry;
#[cfg(feature = "gpu")]
mod gpu;
#[cfg(feature = "gpu")]
mod kept;
mod limits;
mod refine;
#[cfg(feature = "gpu")]
pub(crate) mod resident;
mod resume;
mod switches;

use crate::Result;
use crate::capture::frames::{Frames, Picture};
use splat4d::math::Se3;
use splat4d::math::se3::{dot, norm, normalize, sub};
use splat4d::scene::{Camera, Planes, Time};

/// See the module's documentation.
pub(crate) struct Made {
    cameras: Vec<Camera>,
    times: usize,
}

impl Made {
    /// The ball's radius.
    pub(crate) const RADIUS: f64 = 0.5;

    /// `cameras` square images of `size` pixels at each of `times` times, 10 per second.
    pub(crate) fn new(cameras: usize, times: usize, size: usize) -> Self {
        let camera = |i: usize| {
            let a = std::f64::consts::TAU * i as f64 / cameras as f64;
            let pose = Se3::look_at([4.0 * a.cos(), 0.6 * (i % 2) as f64, 4.0 * a.sin()], [0.0; 3], [0.0, 1.0, 0.0]);
            Camera::with_fov_y(pose, 0.7, size, size)
        };
        Self { cameras: (0..cameras).map(camera).collect(), times }
    }

    /// The k-th time, seconds.
    pub(crate) fn time_of(&self, k: usize) -> f64 {
        k as f64 * 0.1
    }

    /// The ball's centre at time t.
    pub(crate) fn object_at(&self, t: f64) -> [f64; 3] {
        [-0.3 + 2.0 * t, 0.1, 0.2 - 1.5 * t]
    }

    fn at(&self, i: usize) -> (&Camera, f64) {
        (&self.cameras[i % self.cameras.len()], self.time_of(i / self.cameras.len()))
    }
}

impl Frames for Made {
    fn len(&self) -> usize {
        self.cameras.len() * self.times
    }

    fn camera(&self, i: usize) -> &Camera {
        self.at(i).0
    }

    fn time(&self, i: usize) -> Time {
        Time(self.at(i).1)
    }

    fn rig(&self, i: usize) -> usize {
        i % self.cameras.len()
    }

    fn name(&self, i: usize) -> String {
        format!("camera {}, frame {}", i % self.cameras.len(), i / self.cameras.len())
    }

    fn has_masks(&self) -> bool {
        true
    }

    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        let (camera, t) = self.at(i);
        let center = self.object_at(t);
        let eye = camera.center();
        out.color.reset(3, camera.height, camera.width);
        let mut mask = Planes::new(1, camera.height, camera.width);
        for y in 0..camera.height {
            for x in 0..camera.width {
                let ray = normalize(sub(camera.unproject([x as f64 + 0.5, y as f64 + 0.5], 1.0), eye));
                let to = sub(center, eye);
                let along = dot(to, ray);
                let miss = dot(to, to) - along * along;
                let p = y * camera.width + x;
                let color = if miss < Self::RADIUS * Self::RADIUS {
                    let depth = along - (Self::RADIUS * Self::RADIUS - miss).sqrt();
                    let hit: [f64; 3] = std::array::from_fn(|k| eye[k] + depth * ray[k]);
                    let normal = normalize(sub(hit, center));
                    mask.data[p] = 1.0;
                    [0.5 + 0.4 * normal[0], 0.5 + 0.4 * normal[1], 0.3]
                } else {
                    [0.2, 0.3 + 0.2 * ray[1], 0.6]
                };
                for c in 0..3 {
                    out.color.plane_mut(c)[p] = color[c] as f32;
                }
            }
        }
        out.mask = Some(mask);
        out.weight = None;
        assert!(norm(center) < 2.0, "the ball stays in sight");
        Ok(())
    }
}
