//! From pixels of several cameras to points of the world.

use splat4d::math::mat3::{nearest_to_lines, solve};
use splat4d::math::se3::{cross, dot, mat_mul, mat_vec, normalize, sub, transpose};
use splat4d::scene::Camera;

/// The rows of K: pixel = K·x / z.
fn calibration(camera: &Camera) -> [[f64; 3]; 3] {
    let k = &camera.intrinsics;
    [[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]]
}

/// A pixel as the direction that is seen there, depth 1 (camera axes).
fn ray(camera: &Camera, [u, v]: [f64; 2]) -> [f64; 3] {
    let k = &camera.intrinsics;
    [(u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0]
}

/// Takes pixels and inverse depths of one camera to pixels of another: q ~ `turn`·(u, v, 1) + `shift`/z.
#[derive(Clone, Copy, Debug)]
pub struct Transfer {
    /// K₂ R K₁⁻¹
    pub turn: [[f64; 3]; 3],
    /// K₂ t
    pub shift: [f64; 3],
}

impl Transfer {
    /// Of two cameras (pinhole).
    pub fn new(from: &Camera, to: &Camera) -> Self {
        let (a, b) = (&from.cam_from_world, &to.cam_from_world);
        let rotation = mat_mul(&b.rotation, &transpose(&a.rotation));
        let shift = sub(b.translation, mat_vec(&rotation, a.translation));
        let i = &from.intrinsics;
        let inverse = [[1.0 / i.fx, 0.0, -i.cx / i.fx], [0.0, 1.0 / i.fy, -i.cy / i.fy], [0.0, 0.0, 1.0]];
        let k = calibration(to);
        Self { turn: mat_mul(&mat_mul(&k, &rotation), &inverse), shift: mat_vec(&k, shift) }
    }

    /// Position of the pixel in the other image at an inverse depth; none behind that camera.
    pub(crate) fn at(&self, pixel: [f64; 2], inverse: f64) -> Option<[f64; 2]> {
        let q = mat_vec(&self.turn, [pixel[0], pixel[1], 1.0]);
        let q: [f64; 3] = std::array::from_fn(|k| q[k] + inverse * self.shift[k]);
        (q[2] > 0.0).then(|| [q[0] / q[2], q[1] / q[2]])
    }

    /// The pixel's epipolar line in the other image: a, b, c with a² + b² = 1, so that a u + b v + c is a distance in
    /// pixels. Nothing where it has no direction.
    pub fn line(&self, pixel: [f64; 2]) -> Option<[f64; 3]> {
        let l = cross(self.shift, mat_vec(&self.turn, [pixel[0], pixel[1], 1.0]));
        let length = l[0].hypot(l[1]);
        (length > 0.0 && length.is_finite()).then(|| l.map(|v| v / length))
    }
}

/// A point seen by a camera.
#[derive(Clone, Copy, Debug)]
pub struct PixelObservation<'a> {
    /// By which camera (pinhole).
    pub camera: &'a Camera,
    /// Position in its image.
    pub pixel: [f64; 2],
}

impl PixelObservation<'_> {
    /// Distance of a world point's image from where it was seen, pixels; infinite behind the camera.
    pub fn error(&self, x: [f64; 3]) -> f64 {
        let off = |([u, v], _): ([f64; 2], f64)| (u - self.pixel[0]).hypot(v - self.pixel[1]);
        self.camera.project(x).map_or(f64::INFINITY, off)
    }
}

/// The angle at a point between the directions to two positions, radians.
pub fn angle_at(x: [f64; 3], a: [f64; 3], b: [f64; 3]) -> f64 {
    dot(normalize(sub(a, x)), normalize(sub(b, x))).clamp(-1.0, 1.0).acos()
}

/// Gauss-Newton steps after the linear guess: reprojection errors then change no more.
const STEPS: usize = 3;

/// The point that several cameras see: the point nearest to their rays, then least squares of the reprojection errors.
/// Nothing where the rays are parallel or meet behind a camera.
pub fn triangulate(sights: &[PixelObservation<'_>]) -> Option<[f64; 3]> {
    // About the first camera, for the sake of digits far from the world's origin.
    let origin = sights.first()?.camera.center();
    let line = |s: &PixelObservation<'_>| {
        let ahead = normalize(mat_vec(&transpose(&s.camera.cam_from_world.rotation), ray(s.camera, s.pixel)));
        (sub(s.camera.center(), origin), ahead)
    };
    let start = nearest_to_lines(sights.iter().map(line))?;
    let mut x: [f64; 3] = std::array::from_fn(|k| start[k] + origin[k]);
    for _ in 0..STEPS {
        let mut h = [[0.0; 3]; 3];
        let mut g = [0.0; 3];
        for s in sights {
            let p = s.camera.cam_from_world.apply(x);
            if p[2] <= 0.0 {
                return None;
            }
            let (k, r) = (&s.camera.intrinsics, &s.camera.cam_from_world.rotation);
            let off = [k.fx * p[0] / p[2] + k.cx - s.pixel[0], k.fy * p[1] / p[2] + k.cy - s.pixel[1]];
            for (axis, focal) in [k.fx, k.fy].into_iter().enumerate() {
                let row: [f64; 3] = std::array::from_fn(|c| focal / p[2] * (r[axis][c] - p[axis] / p[2] * r[2][c]));
                for i in 0..3 {
                    (0..3).for_each(|j| h[i][j] += row[i] * row[j]);
                    g[i] -= row[i] * off[axis];
                }
            }
        }
        let step = solve(h, g)?;
        (0..3).for_each(|k| x[k] += step[k]);
    }
    let seen = |s: &PixelObservation<'_>| s.camera.cam_from_world.apply(x)[2] > 0.0;
    (x.iter().all(|v| v.is_finite()) && sights.iter().all(seen)).then_some(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Se3;
    use splat4d::math::se3::norm;

    fn camera(x: f64, unit: f64) -> Camera {
        let pose = Se3::look_at([x * unit, 0.1 * unit, -4.0 * unit], [0.0; 3], [0.0, -1.0, 0.0]);
        Camera::with_fov_y(pose, 0.8, 320, 240)
    }

    #[test]
    fn points_are_triangulated_in_any_unit() {
        for unit in [1e-3, 1.0, 1e3] {
            let cameras = [-1.0, 0.2, 1.0].map(|x| camera(x, unit));
            let x = [0.3, -0.2, 0.5].map(|v| v * unit);
            let sights: Vec<PixelObservation<'_>> =
                cameras.iter().map(|c| PixelObservation { camera: c, pixel: c.project(x).unwrap().0 }).collect();
            let found = triangulate(&sights).unwrap();
            assert!(norm(sub(found, x)) < 1e-9 * unit, "{found:?}");
            let transfer = Transfer::new(&cameras[0], &cameras[1]);
            let (pixel, z) = cameras[0].project(x).unwrap();
            let there = transfer.at(pixel, 1.0 / z).unwrap();
            assert!((0..2).all(|k| (there[k] - sights[1].pixel[k]).abs() < 1e-9));
            let l = transfer.line(pixel).unwrap();
            assert!((l[0] * there[0] + l[1] * there[1] + l[2]).abs() < 1e-9, "it lies on its line");
        }
    }

    #[test]
    fn equal_positions_and_diverging_rays_give_no_point() {
        let one = camera(0.5, 1.0);
        let same = [PixelObservation { camera: &one, pixel: [10.0, 20.0] }; 2];
        assert!(triangulate(&same).is_none());
        let (left, right) = (camera(-1.0, 1.0), camera(1.0, 1.0));
        let parting = [
            PixelObservation { camera: &left, pixel: [0.0, 120.0] },
            PixelObservation { camera: &right, pixel: [320.0, 120.0] },
        ];
        assert!(triangulate(&parting).is_none());
    }
}
