//! E01: scene flow lifted from optical flow. A sphere moves along x, a cube turns about y, a wall is static; exact flow
//! of 20 frames is lifted with the depth of one frame and added up. It beats repeating frame 0 by far, and drifts:
//! turning moves points along the viewing direction, which flow with one depth does not see.

use splat4d::flow::lift::lift;
use splat4d::math::{Rng, Se3};
use splat4d::scene::Camera;
use splat4d::scene::camera::{Intrinsics, Lens};

/// Parameters that the experiment varies.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Settings {
    /// Frames.
    pub frames: usize,
    /// The sphere's speed along x, units per frame.
    pub speed: f64,
    /// The cube's turn about y, degrees a frame.
    pub degrees: f64,
    /// Standard deviation of the noise on every flow vector, pixels.
    pub noise: f64,
    /// Seed of the noise.
    pub seed: u64,
}

impl Default for Settings {
    /// 20 frames, .08 units and 4° a frame: repeating frame 0 is then 28 times worse than following the flow.
    fn default() -> Self {
        Self { frames: 20, speed: 0.08, degrees: 4.0, noise: 0.0, seed: 0 }
    }
}

/// Focal length, pixels, of an image of [`SIZE`].
const FOCAL: f64 = 300.0;
/// Width and height, pixels.
const SIZE: [usize; 2] = [320, 240];
/// Points on the sphere, its centre and radius.
const SPHERE: (usize, [f64; 3], f64) = (200, [-1.0, 0.0, 5.0], 0.5);
/// The cube's centre and side.
const CUBE: ([f64; 3], f64) = ([1.2, 0.0, 5.0], 1.0);
/// Points on each edge of the cube between its corners.
const EDGE_POINTS: usize = 4;
/// Points a side of the wall, its depth, and half its width and height.
const WALL: (usize, f64, [f64; 2]) = (10, 8.0, [3.0, 2.0]);
/// Highest power of t in the curve that is fitted to every point's positions: that of the spacetime model.
const FITTED_ORDER: usize = 3;

/// Results of the experiment.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Findings {
    /// Mean squared error at the last frame of repeating frame 0, units².
    pub still_mse: f64,
    /// Of following the flow lifted with the depth of the first of two frames.
    pub lifted_mse: f64,
    /// Of following the flow lifted with both depths.
    pub both_depths_mse: f64,
    /// Of a cubic curve a point, fitted to where the frames themselves (with the same noise) show it.
    pub fitted_mse: f64,
    /// Root mean square error of the lifted tracks at every frame: the drift curve.
    pub drift: Vec<f64>,
    /// The same of the tracks lifted with both depths.
    pub both_depths_drift: Vec<f64>,
    /// The same of the fitted curves.
    pub fitted_drift: Vec<f64>,
    /// Slope of log error over log frame: 1 is a bias, ½ a random walk.
    pub growth: Option<f64>,
    /// Smoothing the lifted flow over time, this many passes: what it does at the first step and at the last.
    pub smoothing: Vec<Smoothed>,
    /// Mean length of true and of lifted scene flow, units per frame.
    pub flow_lengths: [f64; 2],
}

impl Findings {
    /// How many times worse repeating frame 0 is at the last frame.
    pub(crate) fn ratio(&self) -> f64 {
        self.still_mse / self.lifted_mse
    }
}

/// A moving average of every point's flow over three frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Smoothed {
    /// Times that it was applied.
    pub passes: usize,
    /// Root mean square error of a single step's flow, units.
    pub step_rmse: f64,
    /// Root mean square error after the first step, units.
    pub first_rmse: f64,
    /// Mean squared error at the last frame, units².
    pub last_mse: f64,
}

/// Runs it.
pub(crate) fn run(s: &Settings) -> Findings {
    assert!(s.frames >= 2, "flow needs two frames");
    let camera = camera();
    let truth = truth(s);
    let rng = Rng::new(s.seed, "flow noise", 0);
    let seen = |x: [f64; 3]| camera.project(x).expect("all points stand before the camera");
    let noise = |i: usize, n: usize| -> [f64; 2] {
        std::array::from_fn(|k| s.noise * rng.fork(i as u64).normal((2 * n + k) as u64))
    };
    let mut flows = Vec::new();
    let mut exact = Vec::new();
    let mut shown = Vec::new();
    for (i, path) in truth.iter().enumerate() {
        let (mut plane, mut both) = (Vec::new(), Vec::new());
        for n in 0..s.frames - 1 {
            let ((p, z), (q, z_next)) = (seen(path[n]), seen(path[n + 1]));
            let e = noise(i, n);
            let flow = [q[0] - p[0] + e[0], q[1] - p[1] + e[1]];
            plane.push(lift_in_plane(&camera, p, flow, z));
            both.push(lift(&camera, &camera, p, flow, z, z_next));
        }
        // What every frame shows by itself, as far off as a flow vector is.
        let points = (0..s.frames).map(|n| {
            let (p, z) = seen(path[n]);
            let e = noise(i, s.frames + n);
            camera.unproject([p[0] + e[0], p[1] + e[1]], z)
        });
        shown.push(points.collect::<Vec<_>>());
        flows.push(plane);
        exact.push(both);
    }
    let follow = |flows: &[Vec<[f64; 3]>]| -> Vec<Vec<[f64; 3]>> {
        let track = |(path, flow): (&Vec<[f64; 3]>, &Vec<[f64; 3]>)| integrate(path[0], s.frames - 1, |n, _| flow[n]);
        truth.iter().zip(flows).map(track).collect()
    };
    let still: Vec<Vec<[f64; 3]>> = truth.iter().map(|path| vec![path[0]; s.frames]).collect();
    let fitted: Vec<Vec<[f64; 3]>> = shown.iter().map(|points| fit(points)).collect();
    let curves = [&follow(&flows), &follow(&exact), &fitted].map(|tracks| drift(tracks, &truth));
    let last = |d: &[f64]| d[s.frames - 1].powi(2);
    let mut smoothing = Vec::new();
    let mut smooth = flows.clone();
    for passes in 0..=2 {
        if passes > 0 {
            smooth.iter_mut().for_each(|f| *f = average(f));
        }
        let d = drift(&follow(&smooth), &truth);
        smoothing.push(Smoothed {
            passes,
            step_rmse: step_error(&smooth, &truth),
            first_rmse: d[1],
            last_mse: last(&d),
        });
    }
    let length = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let mean = |flows: &[Vec<[f64; 3]>]| {
        let all: Vec<f64> = flows.iter().flatten().map(|v| length(*v)).collect();
        all.iter().sum::<f64>() / all.len() as f64
    };
    let true_flows: Vec<Vec<[f64; 3]>> = truth.iter().map(|p| steps(p)).collect();
    let [lifted, both, fitted] = curves;
    Findings {
        still_mse: last(&drift(&still, &truth)),
        lifted_mse: last(&lifted),
        both_depths_mse: last(&both),
        fitted_mse: last(&fitted),
        growth: growth(&lifted),
        smoothing,
        flow_lengths: [mean(&true_flows), mean(&flows)],
        drift: lifted,
        both_depths_drift: both,
        fitted_drift: fitted,
    }
}

/// The same where the second depth is not known: the point is taken to keep its distance from the camera's plane, so that
/// motion along the viewing direction is missing. The camera is static.
fn lift_in_plane(camera: &Camera, pixel: [f64; 2], flow: [f64; 2], depth: f64) -> [f64; 3] {
    lift(camera, camera, pixel, flow, depth, depth)
}

/// Follows `field(step, x)` (displacement of one step at x) from `start` by Euler's rule: positions at steps 0 to `steps`.
fn integrate(start: [f64; 3], steps: usize, field: impl Fn(usize, [f64; 3]) -> [f64; 3]) -> Vec<[f64; 3]> {
    let mut out = vec![start];
    for n in 0..steps {
        let (x, v) = (out[n], field(n, out[n]));
        out.push(std::array::from_fn(|k| x[k] + v[k]));
    }
    out
}

/// Root mean square distance at every step between tracks \[points\]\[steps\] and the truth.
fn drift(tracks: &[Vec<[f64; 3]>], truth: &[Vec<[f64; 3]>]) -> Vec<f64> {
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
fn growth(errors: &[f64]) -> Option<f64> {
    let points: Vec<(f64, f64)> =
        errors.iter().enumerate().skip(1).filter(|(_, e)| **e > 0.0).map(|(n, e)| ((n as f64).ln(), e.ln())).collect();
    if points.len() < 2 {
        return None;
    }
    let mean = |f: &dyn Fn(&(f64, f64)) -> f64| points.iter().map(f).sum::<f64>() / points.len() as f64;
    let (mx, my) = (mean(&|p| p.0), mean(&|p| p.1));
    Some(mean(&|p| (p.0 - mx) * (p.1 - my)) / mean(&|p| (p.0 - mx).powi(2)))
}

fn camera() -> Camera {
    let identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let [width, height] = SIZE;
    let intrinsics = Intrinsics { fx: FOCAL, fy: FOCAL, cx: 0.5 * width as f64, cy: 0.5 * height as f64 };
    let cam_from_world = Se3 { rotation: identity, translation: [0.0; 3] };
    Camera { cam_from_world, intrinsics, lens: Lens::Pinhole, width, height, near: Camera::NEAR }
}

/// Position of every point at every frame.
fn truth(s: &Settings) -> Vec<Vec<[f64; 3]>> {
    let mut out = Vec::new();
    let frames = 0..s.frames;
    let (count, center, radius) = SPHERE;
    // A Fibonacci lattice: evenly spread, and the same every time.
    let golden = std::f64::consts::PI * (3.0 - 5.0f64.sqrt());
    for i in 0..count {
        let y = 1.0 - 2.0 * (i as f64 + 0.5) / count as f64;
        let (ring, angle) = ((1.0 - y * y).sqrt(), golden * i as f64);
        let at = [ring * angle.cos(), y, ring * angle.sin()];
        let start: [f64; 3] = std::array::from_fn(|k| center[k] + radius * at[k]);
        out.push(frames.clone().map(|n| [start[0] + s.speed * n as f64, start[1], start[2]]).collect());
    }
    let (center, side) = CUBE;
    for p in cube() {
        let path = frames.clone().map(|n| {
            let (sin, cos) = (s.degrees * n as f64).to_radians().sin_cos();
            let q = [cos * p[0] + sin * p[2], p[1], cos * p[2] - sin * p[0]];
            std::array::from_fn(|k| center[k] + 0.5 * side * q[k])
        });
        out.push(path.collect());
    }
    let (count, z, half) = WALL;
    let place = |i: usize, k: usize| half[k] * (2.0 * i as f64 / (count - 1) as f64 - 1.0);
    for i in 0..count * count {
        out.push(vec![[place(i % count, 0), place(i / count, 1), z]; s.frames]);
    }
    out
}

/// Corners and edge points of a cube of side 2 about the origin.
fn cube() -> Vec<[f64; 3]> {
    let mut out = Vec::new();
    for i in 0..8 {
        out.push(std::array::from_fn(|k| if i >> k & 1 == 0 { -1.0 } else { 1.0 }));
    }
    for axis in 0..3 {
        for i in 0..4 {
            for n in 1..=EDGE_POINTS {
                let mut p = [0.0; 3];
                p[axis] = 2.0 * n as f64 / (EDGE_POINTS + 1) as f64 - 1.0;
                p[(axis + 1) % 3] = if i & 1 == 0 { -1.0 } else { 1.0 };
                p[(axis + 2) % 3] = if i & 2 == 0 { -1.0 } else { 1.0 };
                out.push(p);
            }
        }
    }
    out
}

fn steps(path: &[[f64; 3]]) -> Vec<[f64; 3]> {
    path.windows(2).map(|w| std::array::from_fn(|k| w[1][k] - w[0][k])).collect()
}

/// Mean of every three neighbours in time, of two at the ends; the sum over all steps is unchanged except for the ends.
fn average(flow: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let mean = |n: usize| {
        let near = &flow[n.saturating_sub(1)..(n + 2).min(flow.len())];
        std::array::from_fn(|k| near.iter().map(|v| v[k]).sum::<f64>() / near.len() as f64)
    };
    (0..flow.len()).map(mean).collect()
}

fn step_error(flows: &[Vec<[f64; 3]>], truth: &[Vec<[f64; 3]>]) -> f64 {
    let mut sum = 0.0;
    let mut count = 0;
    for (flow, path) in flows.iter().zip(truth) {
        for (a, b) in flow.iter().zip(steps(path)) {
            sum += (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>();
            count += 1;
        }
    }
    (sum / f64::from(count)).sqrt()
}

/// Least squares of a polynomial in time through a point's positions; its values at the frames.
fn fit(points: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let n = points.len();
    let order = FITTED_ORDER.min(n - 1);
    // Orthogonal polynomials on the frames, by Gram-Schmidt: no equations to solve.
    let mut basis: Vec<Vec<f64>> = Vec::new();
    for power in 0..=order {
        let u = |i: usize| 2.0 * i as f64 / (n - 1) as f64 - 1.0;
        let mut v: Vec<f64> = (0..n).map(|i| u(i).powi(power as i32)).collect();
        for b in &basis {
            let along: f64 = v.iter().zip(b).map(|(x, y)| x * y).sum();
            v.iter_mut().zip(b).for_each(|(x, y)| *x -= along * y);
        }
        let norm = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        v.iter_mut().for_each(|x| *x /= norm);
        basis.push(v);
    }
    let mut out = vec![[0.0; 3]; n];
    for b in &basis {
        for k in 0..3 {
            let along: f64 = b.iter().zip(points).map(|(x, p)| x * p[k]).sum();
            out.iter_mut().zip(b).for_each(|(o, x)| o[k] += along * x);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn following_the_flow_beats_repeating_frame_0_by_25_to_31() {
        let f = run(&Settings::default());
        assert!((25.0..=31.0).contains(&f.ratio()), "{}", f.ratio());
        // The error is a bias that adds up, all of it motion along the viewing direction: both depths remove it.
        assert!((f.growth.unwrap() - 1.0).abs() < 0.1, "{:?}", f.growth);
        assert!(f.both_depths_mse < 1e-20, "{}", f.both_depths_mse);
        // Faster turning makes the missing part larger, faster moving the baseline.
        let slow = run(&Settings { degrees: 3.0, speed: 0.1, ..Settings::default() });
        let turning = run(&Settings { speed: 0.05, ..Settings::default() });
        assert!(slow.ratio() > f.ratio() && f.ratio() > turning.ratio());
    }

    #[test]
    fn smoothing_makes_flow_calmer_and_the_end_no_better() {
        let noisy = Settings { noise: 0.5, ..Settings::default() };
        let f = run(&noisy);
        assert!((20.0..=31.0).contains(&f.ratio()), "{}", f.ratio());
        let [none, once, twice] = [0, 1, 2].map(|i| f.smoothing[i]);
        assert!(once.step_rmse < none.step_rmse && twice.step_rmse < once.step_rmse, "{:?}", f.smoothing);
        assert!((twice.last_mse / none.last_mse - 1.0).abs() < 0.02, "integration telescopes: {:?}", f.smoothing);
        // Noise alone is a random walk; using every frame has no random walk.
        assert!(f.both_depths_mse * 8.0 < f.lifted_mse);
        assert!(f.fitted_mse < f.both_depths_mse, "{} {}", f.fitted_mse, f.both_depths_mse);
        assert_eq!(run(&noisy), f, "the same seed, the same numbers");
        assert_ne!(run(&Settings { seed: 1, ..noisy }), f);
    }

    #[test]
    fn one_depth_lifts_all_but_motion_along_the_viewing_direction() {
        let camera = camera();
        let (x, moved) = ([0.3, -0.2, 4.4], [0.1, 0.05, 0.0]);
        let ((a, z), (b, _)) =
            (camera.project(x).unwrap(), camera.project(std::array::from_fn(|k| x[k] + moved[k])).unwrap());
        let lifted = lift_in_plane(&camera, a, [b[0] - a[0], b[1] - a[1]], z);
        assert!((0..3).all(|k| (lifted[k] - moved[k]).abs() < 1e-12), "{lifted:?}");
    }

    #[test]
    fn integration_spirals_outwards_as_eulers_rule_must() {
        let w = 0.1;
        let end = integrate([1.0, 0.0, 0.0], 50, |_, x| [-w * x[1], w * x[0], 0.0])[50];
        let radius = (end[0] * end[0] + end[1] * end[1]).sqrt();
        assert!((radius - (1.0f64 + w * w).powf(25.0)).abs() < 1e-9);
    }

    #[test]
    fn slopes_distinguish_noise_from_bias() {
        let rng = Rng::new(3, "walk", 0);
        let truth = vec![vec![[0.0; 3]; 101]; 2000];
        let walk = |i: u64| {
            let noise =
                |n: usize, _: [f64; 3]| -> [f64; 3] { std::array::from_fn(|k| rng.fork(i).normal((3 * n + k) as u64)) };
            integrate([0.0; 3], 100, noise)
        };
        let walks: Vec<_> = (0..2000).map(walk).collect();
        let random = growth(&drift(&walks, &truth)).unwrap();
        assert!((random - 0.5).abs() < 0.1, "{random}");
        let biased = vec![integrate([0.0; 3], 100, |_, _| [0.01, 0.0, 0.0]); 2000];
        let bias = growth(&drift(&biased, &truth)).unwrap();
        assert!((bias - 1.0).abs() < 0.1, "{bias}");
        assert_eq!(growth(&[0.0, 0.0, 0.0]), None);
    }
}
