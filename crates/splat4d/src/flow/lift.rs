//! Lifts optical flow to scene flow with depth.

use crate::scene::Camera;

/// Two points on a pixel ray: the start by its depth z, the end by the flow and its own depth. World, scene units.
///
/// `pixel`, `flow`: pixels in the first and from the first to the second image.
pub fn lift(from: &Camera, to: &Camera, pixel: [f64; 2], flow: [f64; 2], depth: f64, depth_to: f64) -> [f64; 3] {
    let a = from.unproject(pixel, depth);
    let b = to.unproject([pixel[0] + flow[0], pixel[1] + flow[1]], depth_to);
    std::array::from_fn(|k| b[k] - a[k])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Se3;

    fn camera(degrees: f64) -> Camera {
        // On a circle of radius 4 around the origin, looking inwards.
        let (s, c) = degrees.to_radians().sin_cos();
        let rotation = [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]];
        Camera::with_fov_y(Se3 { rotation, translation: [0.0, 0.0, 4.0] }, 0.8, 320, 240)
    }

    fn near(a: [f64; 3], b: [f64; 3], by: f64) -> bool {
        (0..3).all(|k| (a[k] - b[k]).abs() < by)
    }

    #[test]
    fn lifting_undoes_projecting() {
        let (a, b) = (camera(10.0), camera(40.0));
        let (x, s) = ([0.3, -0.2, 0.4], [0.1, 0.05, -0.2]);
        let y = std::array::from_fn(|k| x[k] + s[k]);
        let ((p, za), (q, zb)) = (a.project(x).unwrap(), b.project(y).unwrap());
        assert!(near(lift(&a, &b, p, [q[0] - p[0], q[1] - p[1]], za, zb), s, 1e-12));
    }
}
