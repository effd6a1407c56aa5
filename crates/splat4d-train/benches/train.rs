//! The stages of training outside the renderer, and searches and measures that training uses, on synthetic data:
//! `cargo bench -p splat4d-train`. `studies bench` measures whole steps on real scenes.

use divan::Bencher;
use splat4d::layers::{Layer, LayerTape};
use splat4d::math::Rng;
use splat4d::math::knn::knn;
use splat4d::motion::{Cache, SpacetimeSpec, Spec, build};
use splat4d::scene::life::LOG_WIDTH;
use splat4d::scene::params::{LOG_SCALE, QUAT};
use splat4d::scene::{GEOMETRY, Grads, LIFE, LifeKind, Params, Planes, Rows, SH, Space, SplatGrads, Table, Time};
use splat4d_train::eval::{InputScaling, Lpips};
use splat4d_train::loss::Photometric;
use splat4d_train::optim::Moments;

const GAUSSIANS: usize = 30_000;
const THREADS: [usize; 2] = [1, 2];
/// Timed calls of each; few of what takes long.
const SAMPLES: u32 = 30;
const FEW: u32 = 5;

fn main() {
    divan::main();
}

fn pool(threads: usize) -> rayon::ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be started")
}

fn picture(height: usize, width: usize, seed: u64) -> Planes<f32> {
    let rng = Rng::new(seed, "picture", 0);
    Planes { channels: 3, height, width, data: (0..3 * height * width).map(|i| rng.uniform(i as u64) as f32).collect() }
}

fn fill(table: &mut Table<f32>, seed: u64) {
    let rng = Rng::new(seed, "table", 0);
    table.data_mut().iter_mut().enumerate().for_each(|(i, x)| *x = 0.1 * rng.normal(i as u64) as f32);
}

/// L1 + D-SSIM with its gradient.
#[divan::bench(args = [(400, 1), (400, 2), (800, 1), (800, 2)], sample_count = SAMPLES)]
fn loss(bencher: Bencher<'_, '_>, (size, threads): (usize, usize)) {
    let (a, b, pool) = (picture(size, size, 1), picture(size, size, 2), pool(threads));
    let (mut loss, mut d) = (Photometric::<f32>::new(0.2), Planes::default());
    bencher.bench_local(|| pool.install(|| loss.loss_and_grad(&a, &b, None, &mut d)));
}

/// Moving Gaussians, all alive at time 0, with spherical harmonics of degree 1.
fn layer() -> Layer {
    let mut params = Params::new(GAUSSIANS, 4, LifeKind::GaussHalf.columns());
    let spec = Spec::Spacetime(SpacetimeSpec::default());
    let motion = build(&spec, &mut params).expect("a built-in model fits new parameters");
    for key in params.keys().collect::<Vec<_>>() {
        let [table] = params.get_mut([key]);
        fill(table, key.0.into());
    }
    for row in 0..GAUSSIANS {
        params.get_mut([GEOMETRY])[0].set(row, QUAT, 1.0);
        params.get_mut([GEOMETRY])[0].write(row, LOG_SCALE, [-4.0; 3]);
        params.get_mut([LIFE])[0].set(row, LOG_WIDTH, 0.0);
    }
    Layer::new("made", params, motion, LifeKind::GaussHalf)
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn motion(bencher: Bencher<'_, '_>, threads: usize) {
    let (layer, pool) = (layer(), pool(threads));
    let mut tape = LayerTape::default();
    bencher.bench_local(|| {
        pool.install(|| {
            tape.request_active(&layer, Time(0.0));
            layer.at(&Cache::default(), &mut tape);
        })
    });
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn motion_backward(bencher: Bencher<'_, '_>, threads: usize) {
    let (layer, pool) = (layer(), pool(threads));
    let (mut tape, cache, mut d_cache) = (LayerTape::default(), Cache::default(), Cache::default());
    tape.request_active(&layer, Time(0.0));
    layer.at(&cache, &mut tape);
    let mut d_out = tape.out().zeros_like();
    fill(&mut d_out, 9);
    let mut d = Grads::new(&layer.params);
    bencher.bench_local(|| {
        pool.install(|| {
            let d_splats = SplatGrads { out: &d_out, color: None, weights: None };
            layer.backward(&cache, &mut tape, &d_splats, &mut d_cache, &mut d)
        })
    });
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn adam(bencher: Bencher<'_, '_>, threads: usize) {
    let (mut layer, pool) = (layer(), pool(threads));
    let (mut moments, mut d) = (Moments::new(&layer.params), Grads::new(&layer.params));
    d.activate(Space::Gaussians, Rows::All);
    for table in d.of([GEOMETRY, SH, LIFE]) {
        fill(table, 5);
    }
    let rates: Vec<Option<Vec<f64>>> = layer.params.keys().map(|k| Some(vec![1e-9; layer.params[k].width()])).collect();
    // A step leaves gradients of zero; times do not depend on the values.
    bencher.bench_local(|| {
        d.of([GEOMETRY, SH, LIFE]);
        pool.install(|| moments.step(&mut layer.params, &mut d, &rates, &[]))
    });
}

/// Nearest neighbours among 100,000 points.
#[divan::bench(args = [3, 8, 20], sample_count = FEW)]
fn neighbours(bencher: Bencher<'_, '_>, k: usize) {
    let rng = Rng::new(5, "cloud", 0);
    let point = |i: u64| std::array::from_fn(|c| rng.fork(i).normal(c as u64) as f32);
    let points: Vec<[f32; 3]> = (0..100_000).map(point).collect();
    bencher.bench_local(|| knn(&points, k));
}

/// AlexNet's layers: number in the network's list, inputs, outputs, side of the window.
const ALEX: [(usize, usize, usize, usize); 5] =
    [(0, 3, 64, 11), (3, 64, 192, 5), (6, 192, 384, 3), (8, 384, 256, 3), (10, 256, 256, 3)];

/// LPIPS with synthetic weights of AlexNet's shapes.
#[divan::bench(sample_count = FEW)]
fn lpips(bencher: Bencher<'_, '_>) {
    let made = |name: &str, shape: Vec<usize>, scale: f64| {
        let rng = Rng::new(3, name, 0);
        let n: usize = shape.iter().product();
        (shape, (0..n as u64).map(|i| (scale * (rng.uniform(i) - 0.5)) as f32).collect())
    };
    let tensor = |name: &str| {
        let number = |part: &str| part.parse::<usize>().ok();
        let parts: Vec<&str> = name.split('.').collect();
        match parts[..] {
            ["features", i, kind] => {
                let &(_, inputs, outputs, side) = ALEX.iter().find(|l| Some(l.0) == number(i))?;
                Some(match kind {
                    "weight" => {
                        made(name, vec![outputs, inputs, side, side], (24.0 / (inputs * side * side) as f64).sqrt())
                    }
                    _ => made(name, vec![outputs], 0.1),
                })
            }
            [lin, "model", "1", "weight"] => {
                let &(_, _, outputs, _) = ALEX.get(number(lin.strip_prefix("lin")?)?)?;
                Some(made(name, vec![1, outputs, 1, 1], 1.0))
            }
            _ => None,
        }
    };
    let lpips = Lpips::load(tensor).expect("the names and shapes are AlexNet's");
    let (a, b) = (picture(400, 400, 1), picture(400, 400, 2));
    bencher.bench_local(|| lpips.distance(&a, &b, InputScaling::Signed));
}
