//! Linear blend skinning of 100,000 Gaussians over 512 nodes, weights included, next to the bytes
//! that skinning reads and writes: `cargo bench -p splat4d-core --bench skin`.

use divan::{Bencher, black_box};
use splat4d::math::Rng;
use splat4d::motion::control::ControlSpec;
use splat4d::motion::{At, Cache, Motion, Spec, Tape, build};
use splat4d::scene::{GEOMETRY, Grads, Params, Rows, Space, SplatGrads, Time};
use std::sync::Arc;

const GAUSSIANS: usize = 100_000;
const THREADS: [usize; 2] = [1, 2];
/// Timed calls of each.
const SAMPLES: u32 = 20;
/// The time that is requested, seconds.
const T: Time = Time(0.37);

fn main() {
    divan::main();
}

fn pool(threads: usize) -> rayon::ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be started")
}

/// A ball of Gaussians in Morton-like order, as training leaves them, and nodes that have learnt something.
fn made() -> (Params<f32>, Arc<dyn Motion<f32>>) {
    let rng = Rng::new(1, "bench", 0);
    let mut p = Params::<f32>::new(GAUSSIANS, 4, &[]);
    let mut means: Vec<[f32; 3]> =
        (0..GAUSSIANS as u64).map(|i| [0, 1, 2].map(|k| rng.normal(3 * i + k) as f32 * 0.3)).collect();
    means.sort_by_key(|m| {
        let cell = m.map(|x| ((x + 1.0) * 128.0).clamp(0.0, 255.0) as u32);
        (0..8).fold(0, |key, bit| (0..3).fold(key, |key, k| key | (cell[k] >> bit & 1) << (3 * bit + k)))
    });
    for (row, mean) in means.into_iter().enumerate() {
        p[GEOMETRY].write(row, 0, mean);
        p[GEOMETRY].write(row, 3, [1.0, 0.1, 0.0, 0.2, -4.0, -4.2, -3.9]);
    }
    let model = build(&Spec::Control(ControlSpec::default()), &mut p).expect("the default model is sound");
    for key in p.keys().skip(3).filter(|&k| p.info(k).trainable).collect::<Vec<_>>() {
        for (i, x) in p[key].data_mut().iter_mut().enumerate() {
            *x += (0.02 * rng.fork(u64::from(key.0)).normal(i as u64)) as f32;
        }
    }
    (p, model)
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn forward(bencher: Bencher<'_, '_>, threads: usize) {
    let ((p, model), mut tape, mut cache) = (made(), Tape::default(), Cache::default());
    let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: T };
    let pool = pool(threads);
    bencher.bench_local(|| {
        pool.install(|| {
            model.prepare(&p, &[q], &mut cache);
            model.at(&q, &cache, &mut tape);
        });
    });
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn forward_and_backward(bencher: Bencher<'_, '_>, threads: usize) {
    let ((p, model), mut tape, mut cache) = (made(), Tape::default(), Cache::default());
    let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: T };
    model.prepare(&p, &[q], &mut cache);
    model.at(&q, &cache, &mut tape);
    let (d_out, mut d, mut d_cache, pool) = (tape.out.clone(), Grads::new(&p), Cache::default(), pool(threads));
    bencher.bench_local(|| {
        pool.install(|| {
            model.prepare(&p, &[q], &mut cache);
            model.at(&q, &cache, &mut tape);
            let d_out = SplatGrads { out: &d_out, color: None, weights: None };
            model.backward(&q, &cache, &mut tape, &d_out, &mut d_cache, &mut d);
            model.finish(&p, &[q], &mut cache, &mut d_cache, &mut d);
        });
    });
}

/// Minimum memory traffic of skinning: 11 numbers, 2 hyper coordinates and 8 candidates of every Gaussian in, 10 out,
/// twice for the backward.
#[divan::bench(sample_count = SAMPLES)]
fn ceiling_bytes(bencher: Bencher<'_, '_>) {
    const BYTES: usize = GAUSSIANS * (11 + 2 + 8 + 10) * 4 * 2;
    let from = vec![1u8; BYTES / 2];
    let mut to = vec![0u8; BYTES / 2];
    bencher.bench_local(|| black_box(&mut to).copy_from_slice(black_box(&from)));
}
