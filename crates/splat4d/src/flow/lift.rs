//! Lifts optical flow to scene flow with one camera's depth; integrates it over frames and measures the drift.
//!
//! One camera cannot observe motion along its rays: with the depth of one frame alone ([`lift_in_plane`]) that part is
//! left out, with both frames' depths ([`lift`]) it is there.

use crate::scene::Camera;

/// Two points on a pixel ray: the start by its depth z, the end by the flow and its own depth. World, scene units.
///
/// `pixel`, `flow`: pixels in the first and from the first to the second image.
pub fn lift(from: &Camera, to: &Camera, pixel: [f64; 2], flow: [f64; 2], depth: f64, depth_to: f64) -> [f64; 3] {
    let a = from.unproject(pixel, depth);
    let b = to.unproject([pixel[0] + flow[0], pixel[1] + flow[1]], depth_to);
    std::array::from_fn(|k| b[k] - a[k])
}

/// The same where the second depth is not known: the point is taken to keep its distance from the camera's plane, so that
/// motion along the viewing direction is missing. The camera is static.
pub fn lift_in_plane(camera: &Camera, pixel: [f64; 2], flow: [f64; 2], depth: f64) -> [f64; 3] {
    lift(camera, camera, pixel, flow, depth, depth)
}

/// Integration method of a velocity field.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Integrator {
    /// x + h·v(x): its error grows by (1 + ω²h²)^½ a step on a rotation.
    Euler,
    /// The midpoint rule: second order.
    Midpoint,
}

/// Follows `field(step, x)` (displacement of one step at x) from `start`: positions at steps 0 to `steps`.
pub fn integrate(
    start: [f64; 3],
    steps: usize,
    rule: Integrator,
    field: impl Fn(f64, [f64; 3]) -> [f64; 3],
) -> Vec<[f64; 3]> {
    let mut out = vec![start];
    for n in 0..steps {
        let x = out[n];
        let v = match rule {
            Integrator::Euler => field(n as f64, x),
            Integrator::Midpoint => {
                let half = field(n as f64, x);
                field(n as f64 + 0.5, std::array::from_fn(|k| x[k] + 0.5 * half[k]))
            }
        };
        out.push(std::array::from_fn(|k| x[k] + v[k]));
    }
    out
}

/// Root mean square distance at every step between tracks \[points\]\[steps\] and the truth.
pub fn drift(tracks: &[Vec<[f64; 3]>], truth: &[Vec<[f64; 3]>]) -> Vec<f64> {
    assert_eq!(tracks.len(), truth.len(), "a track a true track is needed");
    let steps = truth.iter().map(Vec::len).min().unwrap_or(0);
    let square = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>();
    (0..steps)
        .map(|n| {
            let sum: f64 = tracks.iter().zip(truth).map(|(a, b)| square(a[n], b[n])).sum();
            (sum / truth.len().max(1) as f64).sqrt()
        })
        .collect()
}

/// How an error grows: the slope of log error over log step by least squares, steps from 1 on. ½ is a random walk (noise
/// that averages out), 1 a bias that adds up. `None`: fewer than two steps with an error.
pub fn growth(errors: &[f64]) -> Option<f64> {
    let points: Vec<(f64, f64)> =
        errors.iter().enumerate().skip(1).filter(|(_, e)| **e > 0.0).map(|(n, e)| ((n as f64).ln(), e.ln())).collect();
    if points.len() < 2 {
        return None;
    }
    let mean = |f: &dyn Fn(&(f64, f64)) -> f64| points.iter().map(f).sum::<f64>() / points.len() as f64;
    let (mx, my) = (mean(&|p| p.0), mean(&|p| p.1));
    Some(mean(&|p| (p.0 - mx) * (p.1 - my)) / mean(&|p| (p.0 - mx).powi(2)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::se3::mat_vec;
    use crate::math::{Rng, Se3};

    fn camera(degrees: f64) -> Camera {
        // On a circle of radius 4 around the origin, looking inwards.
        let (s, c) = degrees.to_radians().sin_cos();
        let rotation = [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]];
        Camera::with_fov_y(Se3 { rotation, translation: [0.0, 0.0, 4.0] }, 0.8, 320, 240)
    }

    fn flow_of(camera: &Camera, x: [f64; 3], s: [f64; 3]) -> [f64; 2] {
        let (a, _) = camera.project(x).unwrap();
        let (b, _) = camera.project(std::array::from_fn(|k| x[k] + s[k])).unwrap();
        [b[0] - a[0], b[1] - a[1]]
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
        // Without the second depth the part along the viewing direction is missing, and nothing else.
        let turned = mat_vec(&a.cam_from_world.inverse().rotation, [0.1, 0.05, 0.0]);
        let flow = flow_of(&a, x, turned);
        assert!(near(lift_in_plane(&a, p, flow, za), turned, 1e-12));
    }

    #[test]
    fn euler_spirals_outwards_as_it_must_and_the_midpoint_rule_less() {
        let w = 0.1;
        let field = |_: f64, x: [f64; 3]| [-w * x[1], w * x[0], 0.0];
        let radius = |rule| {
            let end = integrate([1.0, 0.0, 0.0], 50, rule, field)[50];
            (end[0] * end[0] + end[1] * end[1]).sqrt()
        };
        let expected = (1.0f64 + w * w).powf(25.0);
        assert!((radius(Integrator::Euler) - expected).abs() < 1e-9);
        assert!((radius(Integrator::Midpoint) - 1.0).abs() < 0.05 * (expected - 1.0));
    }

    #[test]
    fn slopes_distinguish_noise_from_bias() {
        let rng = Rng::new(3, "walk", 0);
        let truth = vec![vec![[0.0; 3]; 101]; 2000];
        let walk = |i: u64| {
            let noise = |n: f64, _: [f64; 3]| -> [f64; 3] {
                std::array::from_fn(|k| rng.fork(i).normal((3.0 * n) as u64 + k as u64))
            };
            integrate([0.0; 3], 100, Integrator::Euler, noise)
        };
        let walks: Vec<_> = (0..2000).map(walk).collect();
        let random = growth(&drift(&walks, &truth)).unwrap();
        assert!((random - 0.5).abs() < 0.1, "{random}");
        let biased = vec![integrate([0.0; 3], 100, Integrator::Euler, |_, _| [0.01, 0.0, 0.0]); 2000];
        let bias = growth(&drift(&biased, &truth)).unwrap();
        assert!((bias - 1.0).abs() < 0.1, "{bias}");
        assert_eq!(growth(&[0.0, 0.0, 0.0]), None);
    }
}
