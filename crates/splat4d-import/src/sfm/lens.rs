//! How a camera makes pixels of positions: square pixels, one radial coefficient, a principal point.

use splat4d::math::Se3;
use splat4d::math::se3::{mat_vec, normalize, transpose};
use splat4d::scene::{Camera, Intrinsics, Lens as SceneLens};

/// Pixels across for which tolerances are stated.
const FULL: f64 = 1920.0;
/// Tolerances shrink with the image, but not below this share: features of small images are no more exact than half
/// a pixel.
const SMALLEST_UNIT: f64 = 0.5;

/// Pixels of an image of this larger side for one of an image of 1920.
pub(crate) fn unit(size: f64) -> f64 {
    (size / FULL).max(SMALLEST_UNIT)
}

/// Focal length, distortion and principal point of a camera.
///
/// A position (x, y, z) in the camera's axes is seen at f·d·(x/z, y/z) + (cx, cy) with d = 1 + k1·(x² + y²)/z².
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// f, pixels.
    pub focal: f64,
    /// k1, as OpenCV's.
    pub k1: f64,
    /// cx and cy, pixels (the first pixel's centre is at 0.5).
    pub center: [f64; 2],
}

/// A pixel position and how it changes.
pub(crate) struct LensProjection {
    pub pixel: [f64; 2],
    /// With the position in the camera's axes.
    pub by_place: [[f64; 3]; 2],
    /// With log f and k1.
    pub by_lens: [[f64; 2]; 2],
}

impl Lens {
    /// Without distortion, the principal point in the middle.
    pub(crate) fn plain(focal: f64, width: usize, height: usize) -> Self {
        Self { focal, k1: 0.0, center: [0.5 * width as f64, 0.5 * height as f64] }
    }

    /// Projection of a point in camera axes; none at or behind the camera.
    pub(crate) fn project(&self, p: [f64; 3]) -> Option<[f64; 2]> {
        if p[2] <= 0.0 || p[2].is_nan() {
            return None;
        }
        let (x, y) = (p[0] / p[2], p[1] / p[2]);
        let s = self.focal * (1.0 + self.k1 * (x * x + y * y));
        Some([s * x + self.center[0], s * y + self.center[1]])
    }

    /// As `Lens::project`, with derivatives.
    pub(crate) fn project_by(&self, p: [f64; 3]) -> Option<LensProjection> {
        let pixel = self.project(p)?;
        let (f, k, z) = (self.focal, self.k1, p[2]);
        let (x, y) = (p[0] / z, p[1] / z);
        let r2 = x * x + y * y;
        let d = 1.0 + k * r2;
        // With x/z and y/z.
        let [[uu, uv], [vu, vv]] =
            [[f * (d + 2.0 * k * x * x), f * 2.0 * k * x * y], [f * 2.0 * k * x * y, f * (d + 2.0 * k * y * y)]];
        let by_place = [[uu / z, uv / z, -(uu * x + uv * y) / z], [vu / z, vv / z, -(vu * x + vv * y) / z]];
        let by_lens = [[f * d * x, f * r2 * x], [f * d * y, f * r2 * y]];
        Some(LensProjection { pixel, by_place, by_lens })
    }

    /// The direction seen at a pixel, depth 1 (camera axes).
    pub(crate) fn ray(&self, pixel: [f64; 2]) -> [f64; 3] {
        /// Newton's method on the radius: far fewer are needed within an image.
        const STEPS: usize = 20;
        let bent = [(pixel[0] - self.center[0]) / self.focal, (pixel[1] - self.center[1]) / self.focal];
        let radius = bent[0].hypot(bent[1]);
        if radius == 0.0 || self.k1 == 0.0 {
            return [bent[0], bent[1], 1.0];
        }
        let mut r = radius;
        for _ in 0..STEPS {
            let slope = 1.0 + 3.0 * self.k1 * r * r;
            if slope <= 0.0 {
                // Beyond where the model turns back no position is seen at all: as if it did not bend.
                r = radius;
                break;
            }
            let step = (r * (1.0 + self.k1 * r * r) - radius) / slope;
            r -= step;
            if step.abs() <= f64::EPSILON * r.abs() {
                break;
            }
        }
        [bent[0] * r / radius, bent[1] * r / radius, 1.0]
    }

    /// The line on which a pixel of a posed camera lies: the camera's centre, and the unit direction (world axes).
    pub(crate) fn line(&self, pose: &Se3, pixel: [f64; 2]) -> ([f64; 3], [f64; 3]) {
        (pose.inverse().translation, normalize(mat_vec(&transpose(&pose.rotation), self.ray(pixel))))
    }

    /// Undistorted position of a pixel, for a pinhole camera of the same focal length.
    pub(crate) fn straight(&self, pixel: [f64; 2]) -> [f64; 2] {
        let ray = self.ray(pixel);
        [self.focal * ray[0] + self.center[0], self.focal * ray[1] + self.center[1]]
    }

    /// The pinhole camera of this focal length and principal point.
    pub(crate) fn pinhole(&self, pose: Se3, width: usize, height: usize) -> Camera {
        let intrinsics = Intrinsics { fx: self.focal, fy: self.focal, cx: self.center[0], cy: self.center[1] };
        Camera { cam_from_world: pose, intrinsics, lens: SceneLens::Pinhole, width, height, near: Camera::NEAR }
    }

    /// A posed camera with this lens.
    pub(crate) fn camera(&self, pose: Se3, width: usize, height: usize) -> Camera {
        let k = [self.k1, 0.0, 0.0, 0.0, 0.0, 0.0];
        let lens = if self.k1 == 0.0 { SceneLens::Pinhole } else { SceneLens::Brown { k, p: [0.0; 2], s: [0.0; 4] } };
        Camera { lens, ..self.pinhole(pose, width, height) }
    }

    /// For images `factor` times as large.
    pub(crate) fn scaled(&self, factor: f64) -> Self {
        Self { focal: self.focal * factor, k1: self.k1, center: self.center.map(|c| c * factor) }
    }
}

/// Distance in pixels of where a position of the world is seen from where it should be; infinite behind the camera.
pub(crate) fn off(lens: &Lens, pose: &Se3, x: [f64; 3], pixel: [f64; 2]) -> f64 {
    let p = mat_vec(&pose.rotation, x);
    let p = std::array::from_fn(|k| p[k] + pose.translation[k]);
    lens.project(p).map_or(f64::INFINITY, |[u, v]| (u - pixel[0]).hypot(v - pixel[1]))
}

/// Known values of a camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Known {
    /// Pixels of the files' images.
    pub intrinsics: Intrinsics,
    /// Distortion.
    pub lens: SceneLens,
    /// Takes world points into the camera's axes, where that is known too.
    pub pose: Option<Se3>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_invert_projection_and_derivatives_equal_finite_differences() {
        let lens = Lens { focal: 430.0, k1: -0.12, center: [310.0, 190.0] };
        let p = [0.4, -0.3, 1.3];
        let seen = lens.project_by(p).unwrap();
        let ray = lens.ray(seen.pixel);
        assert!((0..2).all(|k| (ray[k] - p[k] / p[2]).abs() < 1e-12));
        let h = 1e-6;
        let slope = |up: [f64; 2], down: [f64; 2], axis: usize| (up[axis] - down[axis]) / (2.0 * h);
        for axis in 0..2 {
            for k in 0..3 {
                let moved =
                    |by: f64| lens.project(std::array::from_fn(|i| p[i] + if i == k { by } else { 0.0 })).unwrap();
                assert!((slope(moved(h), moved(-h), axis) - seen.by_place[axis][k]).abs() < 1e-5);
            }
            let zoomed = |by: f64| Lens { focal: lens.focal * by.exp(), ..lens }.project(p).unwrap();
            assert!((slope(zoomed(h), zoomed(-h), axis) - seen.by_lens[axis][0]).abs() < 1e-5);
            let bent = |by: f64| Lens { k1: lens.k1 + by, ..lens }.project(p).unwrap();
            assert!((slope(bent(h), bent(-h), axis) - seen.by_lens[axis][1]).abs() < 1e-5);
        }
        assert!(lens.project([0.1, 0.1, -1.0]).is_none());
    }
}
