//! A layer's frame, for every motion model: frame then evaluate is evaluate then frame, in numbers and in images; its
//! gradient; files, frozen times and baked scenes include it.

use crate::check::subject;
use splat4d::bake::{Options, Shown, bake, compare};
use splat4d::format::scene::{METADATA, metadata, read, write};
use splat4d::layers::{Evaluation, Layer, LayerTape, Scene, freeze};
use splat4d::math::{Real, Rng, Se3, Sim3, quat, se3};
use splat4d::motion::{Cache, Spec, build_as};
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::splats::COV;
use splat4d::scene::{Camera, Grads, LifeKind, Rows, SH, Space, SplatGrads, Table, Time};

/// Largest difference between a framed result and the result framed by hand, and of their images, in f64.
const SAME: f64 = 1e-6;
/// Largest difference between a frozen time's image and the scene's: f32, and shapes out of a decomposition.
const FROZEN: f32 = 2e-3;
/// Likeness of a baked scene and the model from which on images are the same, dB.
const ALIKE: f64 = 45.0;
/// A framed scene is baked as well as an unframed one, dB.
const AS_WELL: f64 = 3.0;
/// Half the step of the central differences.
const H: f64 = 1e-6;
/// The times that are queried.
const TIMES: [f64; 3] = [0.31, 0.7333, 1.2];

/// A frame that does all that a similarity can.
fn frame() -> Sim3 {
    let rotation = quat::to_rotation(quat::normalize([0.4, -0.3, 0.8, 0.2]).0);
    Sim3 { scale: 1.7, rotation, translation: [0.4, -0.7, 0.2] }
}

/// The camera that sees a framed scene as `pose` sees the scene itself.
fn seen_by(frame: &Sim3, pose: &Se3) -> Se3 {
    let rotation = se3::mat_mul(&pose.rotation, &se3::transpose(&frame.rotation));
    let back = se3::mat_vec(&rotation, frame.translation);
    Se3 { rotation, translation: std::array::from_fn(|k| frame.scale * pose.translation[k] - back[k]) }
}

fn scene<F: Real>(layer: Layer<F>) -> Scene<F> {
    Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 10.0, up: [0.0, 0.0, 1.0], ..Scene::default() }
}

fn draw<F: Real>(scene: &Scene<F>, pose: Se3, scale: f64, t: f64) -> Vec<F> {
    let plain = Camera::with_fov_y(pose, 0.9, 40, 32);
    let camera = Camera { near: scale * plain.near, ..plain };
    let (mut instant, mut image) = (Evaluation::default(), Image::default());
    scene.at(Time(t), &mut instant);
    let background = [F::of(0.2); 3];
    Renderer::new(RenderConfig::default()).render(&Shot::new(&scene.splats(&instant), &camera, background), &mut image);
    image.color.data
}

fn worst<F: Real>(a: &[F], b: &[F]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a.f64() - b.f64()).abs()).fold(0.0, f64::max)
}

fn ask<F: Real>(layer: &Layer<F>, t: f64) -> (Cache, LayerTape<F>) {
    let (mut cache, mut tape) = (Cache::default(), LayerTape::default());
    tape.request(Space::Gaussians, Rows::All, Time(t));
    layer.motion.prepare(&layer.params, &[tape.query(&layer.params)], &mut cache);
    layer.at(&cache, &mut tape);
    (cache, tape)
}

/// All that a frame promises, for one model.
pub(crate) fn framed(spec: &Spec, rows: usize, life: LifeKind, frozen: &[&str]) {
    let s = subject(spec, rows, life, 0.1, 6);
    let own = Layer::new("own", s.p, s.motion, life);
    let placed = Layer { frame: frame(), ..own.clone() };
    answers(&own, &placed);
    pictures(own.clone(), placed.clone());
    gradient(placed, frozen);
    let s = subject(spec, rows, life, 0.1, 6);
    let mut params = splat4d::scene::Params::<f32>::new(rows, 4, life.columns());
    let motion = build_as::<f32>(spec, &mut params).expect("the specification is sound");
    let own = Layer::new("own", s.p.cast::<f32>(), motion, life);
    let placed = Layer { frame: frame(), ..own.clone() };
    files(&own, &placed);
    frozen_moments(&placed);
    baked(&own, &placed);
}

fn answers(own: &Layer<f64>, placed: &Layer<f64>) {
    let near = |a: f64, b: f64| (a - b).abs() <= SAME * a.abs().max(1.0);
    let f = frame();
    for t in TIMES {
        let ((_, a), (_, b)) = (ask(own, t), ask(placed, t));
        for row in 0..a.out().rows() {
            let (x, y) = (a.out().read::<10>(row, 0), b.out().read::<10>(row, 0));
            let mean = f.apply([x[0], x[1], x[2]]);
            let full = |c: &[f64]| [[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]];
            let half = se3::mat_mul(&f.rotation, &full(&x[COV..]));
            let (cov, got) = (se3::mat_mul(&half, &se3::transpose(&f.rotation)), full(&y[COV..]));
            assert!((0..3).all(|k| near(mean[k], y[k])), "mean of row {row} at {t}");
            for (i, j) in (0..3).flat_map(|i| (0..3).map(move |j| (i, j))) {
                assert!(near(f.scale * f.scale * cov[i][j], got[i][j]), "covariance of row {row} at {t}");
            }
            assert_eq!(x[9], y[9], "opacity of row {row} at {t}");
        }
    }
}

fn pictures(own: Layer<f64>, placed: Layer<f64>) {
    let pose = Se3::look_at([0.5, 0.4, -6.0], [0.0; 3], [0.0, 1.0, 0.0]);
    let (own, placed) = (scene(own), scene(placed));
    let mut seen = 0;
    for t in TIMES {
        let (a, b) = (draw(&own, pose, 1.0, t), draw(&placed, seen_by(&frame(), &pose), frame().scale, t));
        assert!(worst(&a, &b) < SAME, "the picture at {t} differs by {}", worst(&a, &b));
        seen += a.iter().filter(|v| (**v - 0.2).abs() > 0.05).count();
    }
    assert!(seen > 200, "the test must look at something: {seen}");
}

/// Along a random direction of all learnable numbers the framed results change as the gradient states.
fn gradient(mut layer: Layer<f64>, frozen: &[&str]) {
    let rng = Rng::new(81, "frame", 0);
    let weights = |like: &Table<f64>| {
        let mut out = like.zeros_like();
        for (row, col) in (0..out.rows()).flat_map(|row| (0..10).map(move |col| (row, col))) {
            out.set(row, col, rng.fork(1).normal((row * 10 + col) as u64));
        }
        out
    };
    let value = |layer: &Layer<f64>| -> f64 {
        TIMES
            .iter()
            .map(|&t| {
                let (_, tape) = ask(layer, t);
                weights(tape.out()).data().iter().zip(tape.out().data()).map(|(w, x)| w * x).sum::<f64>()
            })
            .sum()
    };
    let mut d = Grads::new(&layer.params);
    for t in TIMES {
        let (mut cache, mut tape) = ask(&layer, t);
        let mut d_cache = Cache::default();
        let d_out = weights(tape.out());
        let d_out = SplatGrads { out: &d_out, color: None, weights: None };
        layer.backward(&cache, &mut tape, &d_out, &mut d_cache, &mut d);
        layer.motion.finish(&layer.params, &[tape.query(&layer.params)], &mut cache, &mut d_cache, &mut d);
    }
    let mut slope = 0.0;
    let keys: Vec<_> = layer.params.keys().filter(|&k| layer.params.info(k).trainable && k != SH).collect();
    let start = layer.params.clone();
    let mut values = [0.0; 2];
    for (side, h) in [H, -H].into_iter().enumerate() {
        layer.params = start.clone();
        for &key in &keys {
            let width = start[key].width();
            for (row, col) in (0..start[key].rows()).flat_map(|row| (0..width).map(move |col| (row, col))) {
                if !frozen.contains(&start.column_name(key, col)) {
                    let x = rng.fork(10 + u64::from(key.0)).normal((row * width + col) as u64);
                    slope += 0.5 * x * d.table(key).get(row, col);
                    *layer.params[key].get_mut(row, col) += h * x;
                }
            }
        }
        values[side] = value(&layer);
    }
    let fd = (values[0] - values[1]) / (2.0 * H);
    assert!((fd - slope).abs() <= 1e-4 * fd.abs() + 1e-5, "through a frame: differences {fd}, gradient {slope}");
}

fn files(own: &Layer<f32>, placed: &Layer<f32>) {
    let bytes = |layer: &Layer<f32>| {
        let mut scene = scene(layer.clone());
        scene.head = if splat4d::scene::HeadKeys::of(&layer.params).is_some() {
            splat4d::layers::Head::Features
        } else {
            splat4d::layers::Head::Identity
        };
        let mut out = Vec::new();
        write(&scene, &mut out).expect("memory takes every byte");
        (out, metadata(&scene))
    };
    let (with, meta) = bytes(placed);
    let back = read(&with).expect("what was written can be read");
    assert_eq!(back.layers[0].frame, frame());
    assert_eq!(meta["version"], 2, "programs that know no frame must not read it");
    let (without, meta) = bytes(own);
    assert!(meta["version"] == 1 && meta["layers"][0]["frame"].is_null());
    assert!(read(&without).expect("what was written can be read").layers[0].frame.is_identity());
    assert!(!String::from_utf8_lossy(&without).contains("\"frame\"") && !METADATA.is_empty());
}

fn frozen_moments(placed: &Layer<f32>) {
    let pose = seen_by(&frame(), &Se3::look_at([0.5, 0.4, -6.0], [0.0; 3], [0.0, 1.0, 0.0]));
    let scene = scene(placed.clone());
    for t in [0.31, 0.8] {
        let mut params = freeze(&scene, Time(t)).expect("there is no head");
        let motion = build_as(&Spec::Still, &mut params).expect("still layers need nothing");
        let still = Layer::new("still", params, motion, LifeKind::Infinite);
        let (a, b) = (draw(&scene, pose, 1.0, t), draw(&self::scene(still), pose, 1.0, 0.0));
        assert!(worst(&a, &b) < f64::from(FROZEN), "frozen at {t}: {}", worst(&a, &b));
    }
}

fn baked(own: &Layer<f32>, placed: &Layer<f32>) {
    let pose = Se3::look_at([0.5, 0.4, -6.0], [0.0; 3], [0.0, 1.0, 0.0]);
    let likeness = |layer: &Layer<f32>, pose: Se3| {
        let scene = scene(layer.clone());
        let camera = Camera::with_fov_y(pose, 0.9, 40, 32);
        let options = Options { cameras: vec![camera.clone()], ..Options::default() };
        let baked = bake(&scene, &options, &mut |_, _| {}).expect("there is no head");
        let shots = [0.0, 0.3, 0.5, 0.9].map(|t| (t, camera.clone()));
        let mut backend = splat4d::device::cpu(RenderConfig::default());
        compare(&scene, Shown::Nodes(&baked.nodes), &shots, backend.as_mut(), &mut |_, _| true)
            .expect("the CPU renders everything")
            .expect("there are pictures")
            .psnr
    };
    let (a, b) = (likeness(own, pose), likeness(placed, seen_by(&frame(), &pose)));
    assert!(b > ALIKE || b > a - AS_WELL, "baked framed {b} dB, unframed {a} dB");
}
