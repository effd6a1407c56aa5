//! Times the renderer on 30,000 random Gaussians with spherical harmonics of degree 3.
//!
//! `cargo run --release -p splat4d --example render_speed [COUNT [SIZE [THREADS]]]`: forward, and forward with backward, at 400² and
//! 800², on one and two threads; median of several runs. Footprints are the same share of the picture at both sizes.

use splat4d::math::{Rng, Se3, sym3};
use splat4d::render::{Image, ImageGrads, RenderConfig, RenderGrads, Renderer, Simd};
use splat4d::scene::splats::{Part, SPLAT_COLUMNS};
use splat4d::scene::{Camera, Color, Planes, Rows, Splats, Table};
use std::time::Instant;

/// Runs of which the median is printed.
const RUNS: usize = 15;

fn median(mut f: impl FnMut()) -> f64 {
    f();
    let mut times: Vec<f64> = (0..RUNS)
        .map(|_| {
            let start = Instant::now();
            f();
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[RUNS / 2]
}

fn main() {
    let n: usize = std::env::args().nth(1).and_then(|a| a.parse().ok()).unwrap_or(30_000);
    let rng = Rng::new(1, "speed", 0);
    let mut out = Table::<f32>::new(&SPLAT_COLUMNS, n);
    let mut sh = Table::<f32>::new(&[("sh", 48)], n);
    for j in 0..n {
        let r = rng.fork(j as u64);
        let mean: [f32; 3] = std::array::from_fn(|k| (2.4 * r.uniform(k as u64) - 1.2) as f32);
        let q: [f32; 4] = std::array::from_fn(|k| r.normal(10 + k as u64) as f32);
        // With f = 1.2·width and z = 4 a scale of .012 is σ = 1.4 px at 400²: 8 to 12 px across at the α cut-off.
        let s: [f32; 3] = std::array::from_fn(|k| (0.012f64.ln() + 0.4 * r.normal(20 + k as u64)) as f32);
        out.write(j, 0, mean);
        out.write(j, 3, sym3::from_quat_log_scales(q, s));
        out.set(j, 9, (0.05 + 0.9 * r.uniform(4)) as f32);
        for c in 0..48 {
            sh.set(j, c, (0.2 * r.normal(30 + c as u64)) as f32);
        }
    }
    let color = Color::Sh { table: &sh, rows: Rows::All, weights: None, base: true };
    let splats = Splats { parts: vec![Part { out: &out, color }] };
    println!("{n} Gaussians, {:?}", Simd::detect());
    for size in std::env::args().nth(2).map_or(vec![400, 800], |s| vec![s.parse().unwrap_or(400)]) {
        let pose = Se3::look_at([0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0]);
        let camera = Camera::with_fov_y(pose, 2.0 * (0.5f64 / 1.2).atan(), size, size);
        let mut grad = Planes::new(3, size, size);
        for (i, v) in grad.data.iter_mut().enumerate() {
            *v = rng.normal(i as u64) as f32;
        }
        for threads in std::env::args().nth(3).map_or(vec![1, 2], |s| vec![s.parse().unwrap_or(1)]) {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
            pool.install(|| {
                let (mut renderer, mut image) = (Renderer::new(RenderConfig::default()), Image::default());
                let (mut d, mut d_sh) = (RenderGrads::default(), sh.zeros_like());
                let forward = median(|| renderer.render(&splats, &camera, [0.0; 3], None, &mut image));
                let both = median(|| {
                    renderer.render(&splats, &camera, [0.0; 3], None, &mut image);
                    let grads = ImageGrads { color: &grad, alpha: None, depth: None, extra: None };
                    let d_sh = &mut [Some(&mut d_sh)];
                    renderer.backward(&splats, &camera, [0.0; 3], None, &grads, d_sh, &mut d);
                });
                let (stats, s) = (renderer.stats(), renderer.stage_seconds());
                println!("{size}², {threads} threads: forward {forward:.2} ms, with backward {both:.2} ms");
                let ms = [s.project, s.shade, s.bin, s.blend, s.blend_backward, s.splats_backward];
                let ms = ms.map(|v| format!("{:.2}", v * 1e3));
                println!("    project, shade, bin, blend | blend, splats backward: {} ms", ms.join("  "));
                let width = renderer.projected().iter().map(|p| p.half[0] + p.half[1]).sum::<f32>();
                let (width, work) = (width / stats.visible as f32, renderer.blend_work() as f64);
                println!(
                    "    {} visible, {width:.1} px across, {} pairs, {:.1} MB; {:.1} M pixel pairs: {:.0} M/s, back {:.0} M/s",
                    stats.visible,
                    stats.pairs,
                    renderer.memory_bytes() as f64 / 1e6,
                    work * 1e-6,
                    work * 1e-6 / s.blend,
                    work * 1e-6 / s.blend_backward
                );
            });
        }
    }
}
