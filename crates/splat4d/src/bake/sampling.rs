//! Lengths in the world as the cameras see them, in pixels: the unit of every error.

use crate::math::median;
use crate::math::se3::{norm, sub};
use crate::scene::Camera;

/// Most cameras that are used: more of a rig add no information.
const MAX_CAMERAS: usize = 32;
/// A camera counts as no nearer than this share of the median distance to the middle: what drifts before a lens must
/// not be followed to the hundredth of its own width.
const NEAREST: f64 = 0.2;
/// Focal length and distance (in radii of the cloud) where no camera is given: a 1080p image that the cloud fills.
const FOCAL: f64 = 1000.0;
const DISTANCE: f64 = 2.0;

/// Positions and resolutions of the cameras.
#[derive(Clone, Debug)]
pub(super) struct Viewpoints {
    /// Centre and larger focal length.
    eyes: Vec<([f64; 3], f64)>,
    /// Distances are not below this.
    nearest: f64,
    /// Pixels a unit where there is no camera.
    fallback: f64,
}

impl Viewpoints {
    /// From cameras (may be none) and the means of the scene.
    pub(super) fn new(cameras: &[Camera], means: &[[f64; 3]]) -> Self {
        let median = |mut values: Vec<f64>| median(&mut values).unwrap_or(0.0);
        let middle: [f64; 3] = std::array::from_fn(|k| median(means.iter().map(|m| m[k]).collect()));
        let radius = median(means.iter().map(|&m| norm(sub(m, middle))).collect());
        let stride = cameras.len().div_ceil(MAX_CAMERAS).max(1);
        let eye = |c: &Camera| (c.center(), c.intrinsics.fx.max(c.intrinsics.fy));
        let eyes: Vec<_> = cameras.iter().step_by(stride).map(eye).filter(|e| e.1 > 0.0).collect();
        let nearest = NEAREST * median(eyes.iter().map(|e| norm(sub(e.0, middle))).collect());
        let fallback = FOCAL / (DISTANCE * radius).max(f64::MIN_POSITIVE.sqrt());
        Self { eyes, nearest: nearest.max(f64::MIN_POSITIVE.sqrt()), fallback }
    }

    /// Pixels that a unit of length at x fills at most.
    pub(super) fn pixels(&self, x: [f64; 3]) -> f64 {
        if self.eyes.is_empty() {
            return self.fallback;
        }
        self.eyes.iter().map(|(c, f)| f / norm(sub(x, *c)).max(self.nearest)).fold(0.0, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Se3;

    #[test]
    fn the_nearest_camera_sees_a_length_largest() {
        let camera = |z: f64| {
            let pose = Se3::look_at([0.0, 0.0, z], [0.0; 3], [0.0, 1.0, 0.0]);
            let mut camera = Camera::with_fov_y(pose, 0.5, 100, 100);
            camera.intrinsics.fx = 200.0;
            camera.intrinsics.fy = 100.0;
            camera
        };
        let sampling = Viewpoints::new(&[camera(-4.0), camera(10.0)], &[[0.0; 3]; 5]);
        assert!((sampling.pixels([0.0; 3]) - 50.0).abs() < 1e-9);
        assert!(sampling.pixels([0.0, 0.0, 10.0]) < 200.0, "nearness is bounded");
        assert!(Viewpoints::new(&[], &[[0.0; 3], [1.0, 0.0, 0.0]]).pixels([0.0; 3]).is_finite());
        assert!(Viewpoints::new(&[], &[]).pixels([0.0; 3]).is_finite());
    }
}
