//! The `hexplane` model on 40,000 Gaussians (32 channels, 2 levels, networks 64 wide), its planes alone, and the same
//! matrix products and as many bytes by themselves: `cargo bench -p splat4d-core --bench hexplane`.

use divan::{Bencher, black_box};
use splat4d::math::Rng;
use splat4d::motion::hexplane::{Hexplane, HexplaneSpec};
use splat4d::motion::{At, Cache, Motion, Tape};
use splat4d::nn::matmul::{Matrix, product};
use splat4d::scene::{GEOMETRY, Grads, Params, Rows, Space, SplatGrads, Time};

const GAUSSIANS: usize = 40_000;
const THREADS: [usize; 2] = [1, 2];
/// Timed calls of each.
const SAMPLES: u32 = 20;

fn main() {
    divan::main();
}

fn pool(threads: usize) -> rayon::ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be started")
}

/// A ball of Gaussians in Morton-like order, as training leaves them, and a model that has learnt something.
fn made() -> (Params<f32>, Hexplane) {
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
    let model = Hexplane::new(HexplaneSpec::default(), &mut p).expect("the default model is sound");
    for key in p.keys().skip(3).collect::<Vec<_>>() {
        for (i, x) in p[key].data_mut().iter_mut().enumerate() {
            *x += (0.02 * rng.fork(u64::from(key.0)).normal(i as u64)) as f32;
        }
    }
    (p, model)
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn forward(bencher: Bencher<'_, '_>, threads: usize) {
    let ((p, model), mut tape) = (made(), Tape::default());
    let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: Time(0.37) };
    let pool = pool(threads);
    bencher.bench_local(|| pool.install(|| model.at(&q, &Cache::default(), &mut tape)));
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn forward_and_backward(bencher: Bencher<'_, '_>, threads: usize) {
    let ((p, model), mut tape) = (made(), Tape::default());
    let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: Time(0.37) };
    model.at(&q, &Cache::default(), &mut tape);
    let (d_out, mut d, pool) = (tape.out.clone(), Grads::new(&p), pool(threads));
    bencher.bench_local(|| {
        pool.install(|| {
            model.at(&q, &Cache::default(), &mut tape);
            let d_out = SplatGrads { out: &d_out, color: None, weights: None };
            model.backward(&q, &Cache::default(), &mut tape, &d_out, &mut Cache::default(), &mut d)
        })
    });
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn planes_forward_and_backward(bencher: Bencher<'_, '_>, threads: usize) {
    let (p, model) = made();
    let (x, mut d, pool) = (positions(&p), Grads::new(&p), pool(threads));
    let (mut f, mut d_x) = (vec![0.0f32; GAUSSIANS * 64], vec![[0.0f32; 3]; GAUSSIANS]);
    let mut waiting = Vec::new();
    bencher.bench_local(|| {
        pool.install(|| {
            let lines = model.planes().lines(&p, 0.37f32);
            model.planes().forward(&p, &lines, 2, &x, &mut f);
            model.planes().backward(&p, &lines, 2, &x, &f, &mut d_x, &mut waiting, &mut d)
        })
    });
}

fn positions(p: &Params<f32>) -> Vec<[f32; 3]> {
    (0..GAUSSIANS).map(|row| p[GEOMETRY].read::<3>(row, 0).map(|x| 0.5 * x + 0.5)).collect()
}

/// The ceiling of the networks: their twelve products of [rows, 64] and [64, 64] by themselves, on one thread.
#[divan::bench(sample_count = SAMPLES)]
fn ceiling_products(bencher: Bencher<'_, '_>) {
    let (a, w) = (vec![0.5f32; 1024 * 64], vec![0.25f32; 64 * 64]);
    let mut out = vec![0.0f32; 1024 * 64];
    bencher.bench_local(|| {
        for _ in 0..12 * GAUSSIANS / 1024 {
            product(Matrix::new(&a, 1024, 64, 64), Matrix::new(&w, 64, 64, 64).t(), &mut out, 64, false);
        }
        black_box(&out);
    });
}

/// The ceiling of the planes: the bytes that forward and backward read and write of them, as copies within the
/// last-level cache: 40,000 rows · 2 levels · (12 corners · 2 reads, 12 additions, 6 lookups out and in) · 128 bytes.
#[divan::bench(sample_count = SAMPLES)]
fn ceiling_bytes(bencher: Bencher<'_, '_>) {
    const BYTES: usize = GAUSSIANS * 2 * (12 * 2 + 12 * 2 + 6 * 2) * 128;
    let from = vec![1u8; 4 << 20];
    let mut to = vec![0u8; 4 << 20];
    bencher.bench_local(|| {
        for _ in 0..BYTES / 2 / from.len() {
            black_box(&mut to).copy_from_slice(black_box(&from));
        }
    });
}
