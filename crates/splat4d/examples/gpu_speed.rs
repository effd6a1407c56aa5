//! Times the GPU renderer on random Gaussians with spherical harmonics of degree 3, at 1920x1080.
//!
//! `cargo run --release -p splat4d-core --features gpu --example gpu_speed [COUNT [WIDTHxHEIGHT [FRAMES]]]` prints the card,
//! milliseconds of every stage, frames per second of the GPU's work alone and from tables in memory to an image in
//! memory, and the difference to the CPU's image. Works on software drivers too.

use splat4d::gpu::{Adapters, Gpu, GpuRenderer, StageClock};
use splat4d::math::{Rng, Se3, sym3};
use splat4d::render::{Backend, Image, RenderConfig, Renderer, Shot, Tables};
use splat4d::scene::splats::{Part, SPLAT_COLUMNS};
use splat4d::scene::{Camera, Color, Rows, Splats, Table};
use std::time::Instant;

fn main() -> splat4d::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let n: usize = arguments.next().and_then(|a| a.parse().ok()).unwrap_or(500_000);
    let size = arguments.next().unwrap_or_else(|| "1920x1080".into());
    let mut size = size.split('x').map(|v| v.parse::<usize>().unwrap_or(1000));
    let (width, height) = (size.next().unwrap_or(1920), size.next().unwrap_or(1080));
    let frames: usize = arguments.next().and_then(|a| a.parse().ok()).unwrap_or(50);

    let rng = Rng::new(1, "speed", 0);
    let (mut out, mut sh) = (Table::<f32>::new(&SPLAT_COLUMNS, n), Table::<f32>::new(&[("sh", 48)], n));
    // The image is covered as often whatever their number; about 2 px of standard deviation at half a million.
    let scale = 0.004 * (500_000.0 / n as f64).sqrt();
    for j in 0..n {
        let r = rng.fork(j as u64);
        let mean: [f32; 3] = std::array::from_fn(|k| ([4.0, 2.2, 2.4][k] * (r.uniform(k as u64) - 0.5)) as f32);
        let q: [f32; 4] = std::array::from_fn(|k| r.normal(10 + k as u64) as f32);
        let s: [f32; 3] = std::array::from_fn(|k| (scale.ln() + 0.5 * r.normal(20 + k as u64)) as f32);
        out.write(j, 0, mean);
        out.write(j, 3, sym3::from_quat_log_scales(q, s));
        out.set(j, 9, (0.05 + 0.9 * r.uniform(4)) as f32);
        for c in 0..48 {
            sh.set(j, c, (0.2 * r.normal(30 + c as u64)) as f32);
        }
    }
    let color = Color::Sh { table: &sh, rows: Rows::All, weights: None, base: true };
    let splats = Splats { parts: vec![Part::new(&out, color)], head: None };
    let pose = Se3::look_at([0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0]);
    let camera = Camera::with_fov_y(pose, 0.55, width, height);

    let shot = Shot { depth: true, ..Shot::new(&splats, &camera, [0.0; 3]) };
    let gpu = Gpu::open(Adapters::Any)?;
    println!("{}", gpu.describe());
    let start = Instant::now();
    let mut renderer = GpuRenderer::new(gpu, RenderConfig::default())?;
    println!("kernels compiled in {:.0} ms", start.elapsed().as_secs_f64() * 1e3);
    if renderer.clock == StageClock::Off {
        renderer.clock = StageClock::Wall;
    }
    let mut image = Image::default();
    for tables in [Tables::Constant, Tables::Changing] {
        renderer.tables = tables;
        // The first one is a warm-up.
        renderer.render(&shot, &mut image)?;
        let mut all: Vec<_> = Vec::new();
        for _ in 0..frames {
            renderer.render(&shot, &mut image)?;
            all.push(renderer.timings());
        }
        let median = |f: &dyn Fn(&splat4d::gpu::GpuTimings) -> f64| {
            let mut v: Vec<f64> = all.iter().map(f).collect();
            v.sort_by(f64::total_cmp);
            v[v.len() / 2]
        };
        let stats = renderer.stats();
        println!(
            "{tables:?} colours, {n} Gaussians, {} visible, {} pairs with 16² tiles, {width}x{height}, {} MB on the GPU",
            stats.visible,
            stats.pairs,
            renderer.memory_bytes() / 1_000_000
        );
        println!(
            "    ms: upload {:.2} | project {:.3}  compact {:.3}  sort splats {:.3}  tiles {:.3}  sort pairs {:.3}  \
             rasterize {:.3} | until it is in memory {:.2}, total {:.2}",
            median(&|t| t.upload),
            median(&|t| t.project),
            median(&|t| t.compact),
            median(&|t| t.sort_splats),
            median(&|t| t.tiles),
            median(&|t| t.sort_pairs),
            median(&|t| t.rasterize),
            median(&|t| t.wait),
            median(&|t| t.total)
        );
        println!(
            "    frames/s: blending alone {:.1}, all stages {:.1}, from memory to memory {:.1}",
            1e3 / median(&|t| t.rasterize),
            1e3 / median(&|t| t.gpu()),
            1e3 / median(&|t| t.total)
        );
    }
    let (mut cpu, mut expected) = (Renderer::new(RenderConfig::default()), Image::default());
    let start = Instant::now();
    cpu.render(&shot, &mut expected);
    let ms = start.elapsed().as_secs_f64() * 1e3;
    let squares: f64 = image.color.data.iter().zip(&expected.color.data).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    let db = -10.0 * (squares / image.color.data.len() as f64).log10();
    println!("the CPU's first image took {ms:.0} ms; the GPU's differs from it by {db:.1} dB");
    Ok(())
}
