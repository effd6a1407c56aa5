//! Networks on 50,000 rows, forward and backward, next to the speed of one large matrix product on as many threads:
//! `cargo bench -p splat4d-core --bench nn`. Items are floating-point operations, of which a product of [m, k] and [k, n] has
//! 2mkn: items a second of a network against those of `ceiling` is the share of the machine that it uses.

use divan::Bencher;
use divan::counter::ItemsCount;
use rayon::prelude::*;
use splat4d::math::Rng;
use splat4d::nn::matmul::{Matrix, product};
use splat4d::nn::{HashGrid, HashShape, InputGrad, LayerOutputs, Mlp, MlpShape, Passed};
use splat4d::scene::{Grads, Params};

const ROWS: usize = 50_000;
const THREADS: [usize; 2] = [1, 2];
/// Timed calls of each.
const SAMPLES: u32 = 7;
/// The published trunk (Yang et al. 2024) and the small one; inputs are those of an encoding of 10 levels.
const LARGE: MlpShape = MlpShape { inputs: 63, width: 256, layers: 8, skip: Some(4), outputs: 10 };
const SMALL: MlpShape = MlpShape { inputs: 63, width: 64, layers: 2, skip: None, outputs: 10 };
/// Side of the matrices of the ceiling: they fit into the second-level cache as the networks' chunks do.
const SIDE: usize = 256;

fn main() {
    divan::main();
}

fn pool(threads: usize) -> rayon::ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be started")
}

fn numbers(n: usize) -> Vec<f32> {
    let rng = Rng::new(1, "bench", 0);
    (0..n as u64).map(|i| rng.normal(i) as f32).collect()
}

/// Forward and backward as training does it: activations are kept, the input has no gradient.
fn network(bencher: Bencher<'_, '_>, threads: usize, shape: MlpShape) {
    let mut p = Params::<f32>::new(0, 1, &[]);
    let mlp = Mlp::new("net", shape, 1.0, Rng::new(1, "bench", 1), &mut p).expect("the shape is sound");
    let (x, d_out) = (numbers(ROWS * shape.inputs), numbers(ROWS * shape.outputs));
    let (mut out, mut kept, mut d) = (vec![0.0; d_out.len()], LayerOutputs::default(), Grads::new(&p));
    // Forward, gradient to weights, gradient to inputs of all maps but the first.
    let products: usize = shape.maps().expect("sound").iter().map(|(i, o)| 3 * i * o).sum();
    let flops = 2 * ROWS * (products - shape.inputs * shape.width);
    let pool = pool(threads);
    bencher.counter(ItemsCount::new(flops)).bench_local(|| {
        pool.install(|| {
            mlp.forward_keeping(&p, &x, &mut out, &mut kept);
            mlp.backward(&p, Passed::kept(&x, &kept), &d_out, InputGrad::Skip, &mut d);
        });
    });
}

#[divan::bench(args = THREADS, sample_count = SAMPLES, sample_size = 1)]
fn mlp_8x256(bencher: Bencher<'_, '_>, threads: usize) {
    network(bencher, threads, LARGE);
}

#[divan::bench(args = THREADS, sample_count = SAMPLES, sample_size = 1)]
fn mlp_2x64(bencher: Bencher<'_, '_>, threads: usize) {
    network(bencher, threads, SMALL);
}

#[divan::bench(args = THREADS, sample_count = SAMPLES, sample_size = 1)]
fn ceiling(bencher: Bencher<'_, '_>, threads: usize) {
    const TIMES: usize = 200;
    let (a, b) = (numbers(SIDE * SIDE), numbers(SIDE * SIDE));
    let pool = pool(threads);
    let flops = 2 * SIDE * SIDE * SIDE * TIMES * threads;
    bencher.counter(ItemsCount::new(flops)).bench_local(|| {
        pool.install(|| {
            (0..threads).into_par_iter().for_each(|_| {
                let mut out = vec![0.0; SIDE * SIDE];
                for _ in 0..TIMES {
                    let (a, b) = (Matrix::new(&a, SIDE, SIDE, SIDE), Matrix::new(&b, SIDE, SIDE, SIDE));
                    product(a, b, &mut out, SIDE, false);
                }
                divan::black_box(out);
            });
        });
    });
}

#[divan::bench(args = THREADS, sample_count = SAMPLES, sample_size = 1)]
fn hash_grid(bencher: Bencher<'_, '_>, threads: usize) {
    let shape = HashShape { levels: 8, features: 2, log2_size: 15, base: 8, finest: 256 };
    let mut p = Params::<f32>::new(0, 1, &[]);
    let grid = HashGrid::new("grid", shape, &[0, 1, 2], 3, Rng::new(1, "bench", 2), &mut p).expect("sound");
    let x: Vec<f32> = numbers(3 * ROWS).iter().map(|x| 0.5 + 0.15 * x).collect();
    let (mut out, mut d, pool) = (vec![0.0; ROWS * shape.outputs()], Grads::new(&p), pool(threads));
    bencher.counter(ItemsCount::new(ROWS)).bench_local(|| {
        pool.install(|| {
            grid.forward(&p, &x, &mut out, 0, shape.outputs());
            grid.backward(&p, &x, (&out, 0, shape.outputs()), None, &mut d);
        });
    });
}
