//! Renders a 3DGS .ply or a scene.safetensors at one time into a PPM image.
//!
//! `cargo run --release -p splat4d-core --example render_file FILE OUT.ppm [SECONDS]`. Without arguments it renders a small
//! scene from memory.

use splat4d::format;
use splat4d::layers::{Evaluation, Layer, Scene};
use splat4d::math::{Rng, Se3};
use splat4d::motion::Still;
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::params::{LOG_SCALE, QUAT};
use splat4d::scene::{Camera, GEOMETRY, LifeKind, Params, Time};
use std::sync::Arc;

/// The library reads bytes, not paths: a .ply begins with "ply", everything else is taken for a scene file.
fn load(bytes: &[u8]) -> splat4d::Result<Scene<f32>> {
    if !bytes.starts_with(b"ply") {
        return format::scene::read(bytes);
    }
    let (params, info) = format::ply::read(bytes)?;
    println!("{} Gaussians, spherical harmonics of degree {}", info.gaussians, info.sh_degree);
    let layer = Layer::new("ply", params, Arc::new(Still), LifeKind::Infinite);
    Ok(Scene { layers: vec![layer], fps: 30.0, up: [0.0, -1.0, 0.0], ..Scene::default() })
}

/// The bytes of a .ply with a ball of grey Gaussians.
fn sample() -> splat4d::Result<Vec<u8>> {
    let mut params = Params::new(500, 1, LifeKind::Infinite.columns());
    for i in 0..500 {
        let r = Rng::new(3, "ball", 0).fork(i as u64);
        params[GEOMETRY].write(i, 0, std::array::from_fn::<f32, 3, _>(|k| 0.3 * r.normal(k as u64) as f32));
        params[GEOMETRY].write(i, QUAT, [1.0, 0.0, 0.0, 0.0]);
        params[GEOMETRY].write(i, LOG_SCALE, [-3.0; 3]);
    }
    let mut bytes = Vec::new();
    format::ply::write(&params, &mut bytes)?;
    Ok(bytes)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let bytes = match args.first() {
        Some(path) => std::fs::read(path)?,
        None => sample()?,
    };
    let scene = load(&bytes)?;
    let t = Time(args.get(2).map_or(Ok(scene.clip[0]), |s| s.parse())?);

    // The motion models are evaluated at this time; the renderer gets only splats.
    let mut instant = Evaluation::default();
    scene.at(t, &mut instant);
    let splats = scene.splats(&instant);
    let mean = |k: usize| {
        let rows = splats.parts.iter().flat_map(|p| (0..p.out.rows()).map(|r| f64::from(p.out.get(r, k))));
        rows.sum::<f64>() / splats.len().max(1) as f64
    };
    let center = [mean(0), mean(1), mean(2)];

    // Look at the middle of what is there, from a little above.
    let eye: [f64; 3] = std::array::from_fn(|k| center[k] + 0.6 * scene.up[k] + [0.0, 0.0, -3.0][k]);
    let camera = Camera::with_fov_y(Se3::look_at(eye, center, scene.up), 0.8, 320, 240);
    let mut image = Image::default();
    let mut renderer = Renderer::new(RenderConfig::default());
    renderer.render(&Shot::new(&splats, &camera, scene.background), &mut image);
    println!("{} of {} splats drawn at {} s", renderer.stats().visible, splats.len(), t.0);
    if let Some(out) = args.get(1) {
        let bytes: Vec<u8> = image.color.interleaved().iter().map(|c| (c.clamp(0.0, 1.0) * 255.0) as u8).collect();
        let head = format!("P6\n{} {}\n255\n", camera.width, camera.height);
        std::fs::write(out, [head.as_bytes(), &bytes].concat())?;
    }
    Ok(())
}
