//! What a device does with the tables that it keeps in addition to rendering them, against the CPU: ties of tracked
//! poses, losses on rows and noise on positions. The camera points away, so that a step has no other gradient.

use crate::loss::graph::Weigh;
use crate::loss::scene::{MeanOpacity, MeanScale, OpacityEntropy};
use crate::loss::terms::{ParamLoss, ResidentLoss, StepInfo};
use crate::loss::tracked::{Ties, Tracking, Weights};
use crate::optim::{GAUSSIANS, Noise, corrections};
use crate::train_state::TrainState;
use splat4d::device::{self, Device};
use splat4d::layers::{Layer, Scene};
use splat4d::math::{Rng, Se3};
use splat4d::motion::tracked::{FOREGROUND, POSE, TrackedSpec, page_of};
use splat4d::motion::{Spec, build};
use splat4d::render::{
    KEPT, Moves, RenderConfig, ResidentLayer, ResidentNoise, ResidentNumbers, ResidentRule, ResidentStep,
    ResidentStepped, ResidentTable, ResidentTies, ResidentView, RowWeights, Target,
};
use splat4d::scene::params::OPACITY;
use splat4d::scene::{Camera, GEOMETRY, Grads, Key, LifeKind, Params, Planes, Rows, SH, Space, Time};

/// Largest relative difference of a gradient, or of what noise adds, as a vector: roundings of 32 bits.
const VECTOR: f64 = 1e-5;
/// Adam's share of a gradient in the first moment.
const FIRST: f64 = 0.2;
const ROWS: usize = 700;
const NO_VIEW: [f32; 3] = [0.2, 0.5, 0.9];

/// Two frames of Gaussians about the origin, of which a third are the background.
fn scene() -> Scene<f32> {
    let mut p = Params::new(ROWS, 1, LifeKind::Infinite.columns());
    let spec = Spec::Tracked(TrackedSpec { times: vec![0.0, 1.0], foreground: true });
    let motion = build(&spec, &mut p).unwrap();
    let (rng, page) = (Rng::new(7, "kept", 0), page_of(&p, 1).unwrap());
    let front = p.find(FOREGROUND).unwrap();
    for row in 0..ROWS {
        let r = rng.fork(row as u64);
        let wide = |k: u64| r.normal(k) as f32;
        p[GEOMETRY].write(row, 0, std::array::from_fn::<f32, 11, _>(|c| wide(c as u64)));
        p[GEOMETRY].write(row, 7, [0, 1, 2].map(|k| -3.0 + 0.5 * wide(20 + k)));
        let pose: [f32; POSE] = p[GEOMETRY].read(row, 0);
        let next = std::array::from_fn::<f32, POSE, _>(|c| pose[c] + 0.1 * wide(30 + c as u64));
        // Either sign of a quaternion is the same turn.
        let sign = if row % 5 == 0 { -1.0 } else { 1.0 };
        p[page].write(row, 0, std::array::from_fn::<f32, POSE, _>(|c| if c < 3 { next[c] } else { sign * next[c] }));
        p[front].set(row, 0, if row % 3 == 0 { -1.0 } else { 1.0 });
    }
    let layer = Layer::new("tracked", p, motion, LifeKind::Infinite);
    Scene { layers: vec![layer], clip: [0.0, 1.0], up: [0.0, 0.6, 0.8], ..Scene::default() }
}

/// One step at these rates of the geometry and the poses, with a camera that sees nothing; none without a GPU.
fn step(
    scene: &Scene<f32>,
    rate: f64,
    ties: Option<&ResidentTies>,
    rows: RowWeights,
    noise: Option<ResidentNoise>,
) -> Option<(ResidentStepped, ResidentNumbers)> {
    let opened = device::open_to_train(Device::Gpu, RenderConfig::default());
    let mut backend = opened.backend;
    let Some(resident) = backend.resident() else {
        assert!(std::env::var_os("REQUIRE_GPU").is_none(), "REQUIRE_GPU is set: {}", opened.why);
        println!("skipped: {}", opened.why);
        return None;
    };
    let (train_state, layer) = (TrainState::new(scene.clone()), &scene.layers[0]);
    let page = page_of(&layer.params, 1).unwrap();
    let tables = [Some(GEOMETRY), None, Some(page), None, Some(SH)].map(|key: Option<Key>| {
        key.map_or(ResidentTable::default(), |key| {
            let (params, moments) = (&layer.params[key], train_state.moments()[0].table(key));
            ResidentTable { width: params.width(), params: params.data(), moments: moments.data() }
        })
    });
    let stats = train_state.stats().tables[0].data();
    let kept = ResidentLayer { rows: ROWS, moves: Moves::Posed, life: LifeKind::Infinite, tables, stats, ties };
    resident.keep(&[kept], None, &corrections::<f32>(GAUSSIANS)).unwrap();
    let away = Se3::look_at([0.0, 0.0, 50.0], [0.0, 0.0, 90.0], [0.0, 1.0, 0.0]);
    let camera = Camera::with_fov_y(away, 0.8, 32, 24);
    let truth = Planes::new(3, 24, 32);
    let target = Target { truth: &truth, weight: None, picture: 0, dssim: 0.2, response: None };
    let view = ResidentView { camera: &camera, t: Time(1.0), background: NO_VIEW, target, rig: 0 };
    let rule = |width: usize| Some(ResidentRule { rates: vec![rate; width], floor: None });
    let rules: [Option<ResidentRule>; KEPT] = [rule(11), None, rule(POSE), None, None];
    let step = ResidentStep {
        views: &[view],
        sh_degree: 0,
        alpha_min: splat4d::layers::ALPHA_MIN,
        rules: &[rules],
        rows,
        noise: &[noise],
        cameras: 0.0,
    };
    assert!(resident.step(&step).unwrap().expect("a small picture").is_empty(), "it is under way");
    let stepped = resident.finish().unwrap().remove(0);
    Some((stepped, resident.fetch(0).unwrap()))
}

/// |a - b| / |b| of vectors.
fn apart(a: &[f64], b: &[f64]) -> f64 {
    let off: f64 = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum();
    let all: f64 = b.iter().map(|b| b * b).sum();
    assert!(all > 0.0, "there is something to compare");
    (off / all).sqrt()
}

/// Some columns of a table in blocks of sixteen rows, row after row.
fn columns(data: &[f32], width: usize, wanted: std::ops::Range<usize>) -> Vec<f64> {
    let at = |row: usize, c: usize| f64::from(data[(row / 16 * width + c) * 16 + row % 16]);
    (0..ROWS).flat_map(|row| wanted.clone().map(move |c| at(row, c))).collect()
}

fn info() -> StepInfo {
    StepInfo { iteration: 0, times: vec![Time(1.0)], seed: 0, progress: 0.0 }
}

#[test]
fn ties_pull_as_on_the_cpu() {
    let scene = scene();
    let page = page_of(&scene.layers[0].params, 1).unwrap();
    let all = Weights { rigid: 4.0, rot: 3.0, iso: 2.0, bg: 5.0, soft_col: 0.0, floor: 2.0 };
    let none = Weights::default();
    let some = [
        all,
        Weights { rigid: 4.0, ..none },
        Weights { rot: 4.0, ..none },
        Weights { iso: 4.0, ..none },
        Weights { bg: 4.0, ..none },
        Weights { floor: 4.0, ..none },
    ];
    for weights in some {
        let ties = Ties { neighbours: 6, weigh: Weigh::Median(1.0), weights, floor: 0.3, unit: 1.7 };
        let tied = Tracking::new(ties).frame(1);
        let mut d = vec![Grads::new(&scene.layers[0].params)];
        d[0].activate(Space::Gaussians, Rows::All);
        let expected_loss = tied.eval(&scene, &info(), &mut d);
        assert_eq!(ParamLoss::<f32>::kept(&tied), Some(ResidentLoss::Ties));
        let ties = tied.ties(&scene).unwrap();
        let Some((stepped, numbers)) = step(&scene, 1e-3, Some(&ties), RowWeights::default(), None) else { return };
        assert!((stepped.loss - expected_loss).abs() < VECTOR * expected_loss, "{} {expected_loss}", stepped.loss);
        let first = columns(&numbers.moments[2], 2 * POSE + 1, 0..POSE);
        let expected: Vec<f64> =
            d[0].table(page).column_to_rows(0, POSE).iter().map(|g| FIRST * f64::from(*g)).collect();
        let off = apart(&first, &expected);
        println!("{weights:?}: {off:.1e}");
        assert!(off < VECTOR, "{weights:?}: {off:.1e}");
        assert_eq!(stepped.bad, None);
    }
}

#[test]
fn losses_on_rows_pull_as_on_the_cpu() {
    let scene = scene();
    let losses: [Box<dyn ParamLoss<f32>>; 3] = [
        Box::new(MeanOpacity { weight: 0.7 }),
        Box::new(OpacityEntropy { weight: 0.6 }),
        Box::new(MeanScale { weight: 0.5 }),
    ];
    for loss in losses {
        let mut d = vec![Grads::new(&scene.layers[0].params)];
        d[0].activate(Space::Gaussians, Rows::All);
        let expected_loss = loss.eval(&scene, &info(), &mut d);
        let Some(ResidentLoss::Rows(weights)) = loss.kept() else { panic!("{} is known", loss.name()) };
        let Some((stepped, numbers)) = step(&scene, 1e-3, None, weights, None) else { return };
        assert!((stepped.loss - expected_loss).abs() < VECTOR * expected_loss, "{} {expected_loss}", stepped.loss);
        let first = columns(&numbers.moments[0], 23, 0..11);
        let expected: Vec<f64> =
            d[0].table(GEOMETRY).column_to_rows(0, 11).iter().map(|g| FIRST * f64::from(*g)).collect();
        let off = apart(&first, &expected);
        assert!(off < VECTOR, "{}: {off:.1e}", loss.name());
    }
}

#[test]
fn noise_moves_as_on_the_cpu() {
    let mut scene = scene();
    // Half of them are nearly transparent; noise is for these.
    for row in 0..ROWS {
        scene.layers[0].params[GEOMETRY].set(row, OPACITY, if row % 2 == 0 { 3.0 } else { -5.0 - 0.01 * row as f32 });
    }
    let (dead, rate, rng) = (0.005, 0.02, Rng::new(11, "noise", 5));
    let noise = Noise { strength: 4e4, until: usize::MAX };
    let mut moved = scene.clone();
    let mut d = vec![Grads::new(&scene.layers[0].params)];
    d[0].activate(Space::Gaussians, Rows::All);
    noise.add(&mut moved, &d, |_| Some(rate), dead, rng);
    let kept = noise.kept(rate, dead, rng.fork(0)).unwrap();
    let Some((_, numbers)) = step(&scene, 0.0, None, RowWeights::default(), Some(kept)) else { return };
    let before = scene.layers[0].params[GEOMETRY].column_to_rows(0, 11);
    let shift = |after: Vec<f64>| -> Vec<f64> { after.iter().zip(&before).map(|(a, b)| a - f64::from(*b)).collect() };
    let on_gpu = shift(columns(&numbers.params[0], 11, 0..11));
    let on_cpu = shift(moved.layers[0].params[GEOMETRY].column_to_rows(0, 11).into_iter().map(f64::from).collect());
    let off = apart(&on_gpu, &on_cpu);
    assert!(off < VECTOR, "noise differs by {off:.1e}");
    let rests = |row: &[f64]| row.iter().all(|x| *x == 0.0);
    assert!(on_gpu.chunks(11).zip(on_cpu.chunks(11)).all(|(a, b)| rests(a) == rests(b)), "the opaque rest");
}
