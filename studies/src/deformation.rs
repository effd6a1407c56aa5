//! E00: what a deformation network is. Fifty points move by sinusoids, straight lines and circles; a perceptron of
//! 4,546 numbers learns their displacement from noisy positions, against the best that being at rest can do. A penalty
//! on speed trades fidelity for smoothness; a sharp edge between two motions and a jump in time are what it cannot
//! follow.

use splat4d::math::Rng;
use splat4d::nn::mlp::{InputGrad, Mlp, MlpShape, Passed};
use splat4d::scene::{Grads, Params};
use splat4d_train::optim::Moments;

/// Parameters that the experiment varies.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Settings {
    /// Points.
    pub points: usize,
    /// Times, evenly over [0, 1].
    pub frames: usize,
    /// Standard deviation of the noise on every observed position.
    pub noise: f64,
    /// Steps of Adam, each over all points and times.
    pub steps: usize,
    /// λ of the mean squared displacement from one time to the next.
    pub lambda_velocity: f64,
    /// Seed of positions, noise and network.
    pub seed: u64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { points: 50, frames: 20, noise: 0.05, steps: 3000, lambda_velocity: 0.0, seed: 0 }
    }
}

/// Amplitude of sinusoids and radius of circles.
const AMPLITUDE: f64 = 0.3;
/// Length of the straight ways.
const WAY: f64 = 0.6;
/// The network: (x, y, t) to (dx, dy) through two hidden layers of 64.
const SHAPE: MlpShape = MlpShape { inputs: 3, width: 64, layers: 2, skip: None, outputs: 2 };
/// The last layer starts at this share of the usual size: hardly any displacement.
const LAST_LAYER: f64 = 0.05;
/// Adam's rate at the start and at the end of a cosine.
const RATES: [f64; 2] = [1e-2, 1e-4];
/// Values of λ in the sweep.
pub(crate) const LAMBDAS: [f64; 6] = [0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0];
/// Points nearer to the edge between two motions than this count as at it.
const NEAR_EDGE: f64 = 0.03;
/// When the jump is; times from this much before it on count as at it, for a smooth network begins early.
const JUMP: (f64, f64) = (0.5, 0.1);
/// Points that it takes to see an edge or a jump: fewer can be learnt by heart.
pub(crate) const MANY_POINTS: usize = 200;

type Path = Vec<[f64; 2]>;

/// How the points of a scene move.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Scene {
    /// A third each: sinusoids along x, straight lines, circles.
    Mixed,
    /// Points left of x = 0 are static, those right of it move up: the edge of an occluding object.
    Edge,
    /// Every second point is somewhere else from t = ½ on: one appears, one vanishes.
    Jump,
}

/// Results of the experiment.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Findings {
    /// Numbers of the network.
    pub parameters: usize,
    /// Mean squared distance to the noise-free truth at every time: of every point's mean position.
    pub still_mse: Vec<f64>,
    /// Of the network.
    pub moving_mse: Vec<f64>,
    /// Mean distance at every time, of the mean position and of the network.
    pub distances: [Vec<f64>; 2],
    /// Mean length of the third difference of the network's positions.
    pub jerk: f64,
    /// Mean squared distance of the network over all times.
    pub mse: f64,
    /// The same at the edge or the jump and elsewhere, where the scene has one.
    pub parts: Option<[f64; 2]>,
    /// Truth and network's positions of every point at every time, to plot.
    pub paths: [Vec<Path>; 2],
}

impl Findings {
    /// 1 − e/e_still at every time.
    pub(crate) fn improvements(&self) -> Vec<f64> {
        self.moving_mse.iter().zip(&self.still_mse).map(|(a, b)| 1.0 - a / b).collect()
    }

    /// The smallest of them.
    pub(crate) fn worst(&self) -> f64 {
        self.improvements().into_iter().fold(f64::INFINITY, f64::min)
    }
}

/// Runs it.
pub(crate) fn run(scene: Scene, s: &Settings) -> Findings {
    assert!(s.points > 0 && s.frames > 3, "a third difference needs four times");
    let rng = Rng::new(s.seed, "e00", 0);
    let truth = truth(scene, s, rng);
    let noisy =
        |i: usize, n: usize, k: usize| truth[i][n][k] + s.noise * rng.fork(100 + i as u64).normal((2 * n + k) as u64);
    let observed: Vec<Path> =
        (0..s.points).map(|i| (0..s.frames).map(|n| [noisy(i, n, 0), noisy(i, n, 1)]).collect()).collect();
    let (found, parameters) = learn(&start(s, rng), &observed, s);
    let still: Vec<Path> = observed
        .iter()
        .map(|path| vec![[0, 1].map(|k| path.iter().map(|x| x[k]).sum::<f64>() / s.frames as f64); s.frames])
        .collect();
    let [still_mse, moving_mse] = [&still, &found].map(|f| by_time(f, &truth, |e| e * e));
    let distances = [&still, &found].map(|f| by_time(f, &truth, |e| e));
    let square = |i: usize, n: usize| distance(found[i][n], truth[i][n]).powi(2);
    let parts = part(scene, s, rng).map(|at| {
        let mean = |want: bool| {
            let all: Vec<f64> = (0..s.points)
                .flat_map(|i| (0..s.frames).map(move |n| (i, n)))
                .filter(|&(i, n)| at(i, n) == want)
                .map(|(i, n)| square(i, n))
                .collect();
            all.iter().sum::<f64>() / all.len().max(1) as f64
        };
        [mean(true), mean(false)]
    });
    Findings {
        parameters,
        mse: moving_mse.iter().sum::<f64>() / s.frames as f64,
        jerk: jerk(&found),
        still_mse,
        moving_mse,
        distances,
        parts,
        paths: [truth, found],
    }
}

/// Rest positions of points: evenly random in [−1, 1]².
fn start(s: &Settings, rng: Rng) -> Vec<[f64; 2]> {
    (0..s.points).map(|i| [0, 1].map(|k| 2.0 * rng.fork(1).uniform((2 * i + k) as u64) - 1.0)).collect()
}

fn time(s: &Settings, n: usize) -> f64 {
    n as f64 / (s.frames - 1) as f64
}

fn truth(scene: Scene, s: &Settings, rng: Rng) -> Vec<Path> {
    let tau = std::f64::consts::TAU;
    let place = |i: usize, x: [f64; 2], t: f64| match scene {
        Scene::Mixed => {
            let phase = tau * rng.fork(2).uniform(i as u64);
            let (sin, cos) = (tau * t + phase).sin_cos();
            match i % 3 {
                0 => [x[0] + AMPLITUDE * (sin - phase.sin()), x[1]],
                1 => [x[0] + WAY * phase.cos() * t, x[1] + WAY * phase.sin() * t],
                _ => [x[0] + AMPLITUDE * (cos - phase.cos()), x[1] + AMPLITUDE * (sin - phase.sin())],
            }
        }
        Scene::Edge => [x[0], x[1] + if x[0] < 0.0 { 0.0 } else { WAY * t }],
        Scene::Jump => [x[0] + if i % 2 == 1 && t >= JUMP.0 { WAY } else { 0.0 }, x[1]],
    };
    start(s, rng).iter().enumerate().map(|(i, x)| (0..s.frames).map(|n| place(i, *x, time(s, n))).collect()).collect()
}

/// Which (point, time) is at the scene's edge or jump.
fn part(scene: Scene, s: &Settings, rng: Rng) -> Option<Box<dyn Fn(usize, usize) -> bool>> {
    let (start, s) = (start(s, rng), s.clone());
    match scene {
        Scene::Mixed => None,
        Scene::Edge => Some(Box::new(move |i, _| start[i][0].abs() < NEAR_EDGE)),
        Scene::Jump => Some(Box::new(move |_, n| time(&s, n) > JUMP.0 - JUMP.1)),
    }
}

/// Fits the network to observed positions; its positions, and how many numbers it has.
fn learn(start: &[[f64; 2]], observed: &[Path], s: &Settings) -> (Vec<Path>, usize) {
    let mut p = Params::<f32>::new(0, 1, &[]);
    let mlp = Mlp::new("displacement", SHAPE, LAST_LAYER, Rng::new(s.seed, "e00 network", 0), &mut p)
        .expect("the shape is a constant");
    let keys: Vec<_> = p.keys().skip(3).collect();
    let parameters = keys.iter().map(|&k| p[k].rows()).sum();
    let mut rates: Vec<Option<Vec<f64>>> = vec![None; p.keys().count()];
    let (mut moments, mut d) = (Moments::new(&p), Grads::new(&p));
    let rows = s.points * s.frames;
    let mut x = vec![0.0f32; 3 * rows];
    for (i, at) in start.iter().enumerate() {
        for n in 0..s.frames {
            let row = i * s.frames + n;
            x[3 * row..][..3].copy_from_slice(&[at[0] as f32, at[1] as f32, time(s, n) as f32]);
        }
    }
    let mut out = vec![0.0f32; 2 * rows];
    let mut d_out = vec![0.0f32; 2 * rows];
    for step in 0..s.steps {
        mlp.forward(&p, &x, &mut out);
        for i in 0..s.points {
            for n in 0..s.frames {
                for k in 0..2 {
                    let at = |n: usize| f64::from(out[2 * (i * s.frames + n) + k]);
                    // Mean over points and times of ‖x + d − observed‖² …
                    let mut g = 2.0 * (start[i][k] + at(n) - observed[i][n][k]) / rows as f64;
                    // … and of λ‖d(t+1) − d(t)‖².
                    let speed = 2.0 * s.lambda_velocity / (s.points * (s.frames - 1)) as f64;
                    if n > 0 {
                        g += speed * (at(n) - at(n - 1));
                    }
                    if n + 1 < s.frames {
                        g -= speed * (at(n + 1) - at(n));
                    }
                    d_out[2 * (i * s.frames + n) + k] = g as f32;
                }
            }
        }
        mlp.backward(&p, Passed::of(&x), &d_out, InputGrad::Skip, &mut d);
        let share = 0.5 * (1.0 + (std::f64::consts::PI * step as f64 / s.steps as f64).cos());
        let rate = RATES[1] + (RATES[0] - RATES[1]) * share;
        keys.iter().for_each(|k| rates[k.0 as usize] = Some(vec![rate]));
        let bad = moments.step(&mut p, &mut d, &rates, &[]);
        assert!(bad.is_empty(), "bounded inputs and a falling rate keep every number finite");
        d.clear(&p);
    }
    mlp.forward(&p, &x, &mut out);
    let place = |i: usize, n: usize| [0, 1].map(|k| start[i][k] + f64::from(out[2 * (i * s.frames + n) + k]));
    ((0..s.points).map(|i| (0..s.frames).map(|n| place(i, n)).collect()).collect(), parameters)
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Mean over points of `f`(distance to the truth), at every time.
fn by_time(found: &[Path], truth: &[Path], f: impl Fn(f64) -> f64) -> Vec<f64> {
    let mean = |n: usize| found.iter().zip(truth).map(|(a, b)| f(distance(a[n], b[n]))).sum::<f64>();
    (0..truth[0].len()).map(|n| mean(n) / truth.len() as f64).collect()
}

fn jerk(paths: &[Path]) -> f64 {
    let third = |w: &[[f64; 2]]| {
        let of = |k: usize| w[3][k] - 3.0 * w[2][k] + 3.0 * w[1][k] - w[0][k];
        of(0).hypot(of(1))
    };
    let all: Vec<f64> = paths.iter().flat_map(|p| p.windows(4).map(third)).collect();
    all.iter().sum::<f64>() / all.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::OnceLock;

    /// The default experiment, which several tests look at.
    fn mixed() -> &'static Findings {
        static FOUND: OnceLock<Findings> = OnceLock::new();
        FOUND.get_or_init(|| run(Scene::Mixed, &Settings::default()))
    }

    #[test]
    fn a_network_of_4546_parameters_beats_the_static_baseline_at_every_time() {
        let f = mixed();
        assert_eq!(f.parameters, 4546);
        assert!(f.worst() >= 0.39, "{:?}", f.improvements());
        // The observations' own noise is the measure: 2σ² is what copying one of them would cost.
        let noise = 2.0 * Settings::default().noise.powi(2);
        assert!(f.mse < 2.0 * noise, "{} against {noise}", f.mse);
    }

    #[test]
    fn a_penalty_on_speed_makes_it_smoother_and_worse() {
        let (free, calm) = (mixed(), run(Scene::Mixed, &Settings { lambda_velocity: 10.0, ..Settings::default() }));
        assert!(calm.jerk < 0.9 * free.jerk, "{:?}", [free.jerk, calm.jerk]);
        assert!(calm.mse > 1.5 * free.mse, "{:?}", [free.mse, calm.mse]);
    }

    #[test]
    fn edges_and_jumps_are_where_it_fails() {
        let s = Settings { points: MANY_POINTS, steps: 500, noise: 0.02, ..Settings::default() };
        for scene in [Scene::Edge, Scene::Jump] {
            let [there, elsewhere] = run(scene, &s).parts.unwrap();
            assert!(there > 3.0 * elsewhere, "{scene:?}: {there} there, {elsewhere} elsewhere");
        }
    }
}
