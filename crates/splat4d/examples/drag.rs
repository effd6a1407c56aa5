//! Drags the control nodes of a trained scene, as rigidly as possible, and renders it before and after into PPM images.
//!
//! `cargo run --release -p splat4d-core --example drag SCENE.safetensors BEFORE.ppm AFTER.ppm [SECONDS]`. The lower half of
//! the nodes is pinned, the topmost tenth moves sideways. Without arguments it drags a synthetic rod. The scene keeps
//! its trained motion; only its nodes are displaced.

use splat4d::format;
use splat4d::layers::{Evaluation, Layer, Scene};
use splat4d::math::{Rng, Se3};
use splat4d::motion::arap::{Handle, drag};
use splat4d::motion::control::{ControlSpec, skinned};
use splat4d::motion::skin::{Skinned, node_frame};
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::params::{LOG_SCALE, QUAT};
use splat4d::scene::{Camera, GEOMETRY, LifeKind, Params, Time};
use std::any::Any;
use std::sync::Arc;

/// Rounds of turning and moving: after these no eye sees a difference.
const ROUNDS: usize = 8;

/// A rod of grey Gaussians that is upright, on control nodes.
fn sample() -> splat4d::Result<Scene<f32>> {
    let mut params = Params::new(4000, 1, LifeKind::Infinite.columns());
    for i in 0..4000 {
        let r = Rng::new(3, "rod", 0).fork(i as u64);
        let place = [0.1 * r.normal(0), 0.1 * r.normal(1), 2.0 * r.uniform(2) - 1.0];
        params[GEOMETRY].write(i, 0, place.map(|x| x as f32));
        params[GEOMETRY].write(i, QUAT, [1.0, 0.0, 0.0, 0.0]);
        params[GEOMETRY].write(i, LOG_SCALE, [-3.5; 3]);
    }
    let motion = Arc::new(skinned::<f32>(&ControlSpec::default(), &mut params)?);
    let life = LifeKind::Infinite;
    let layer = Layer::new("rod", params, motion, life);
    Ok(Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, up: [0.0, 0.0, 1.0], ..Scene::default() })
}

fn draw(scene: &Scene<f32>, t: Time, camera: &Camera) -> Vec<u8> {
    let mut instant = Evaluation::default();
    scene.at(t, &mut instant);
    let mut image = Image::default();
    let mut renderer = Renderer::new(RenderConfig::default());
    renderer.render(&Shot::new(&scene.splats(&instant), camera, [1.0; 3]), &mut image);
    let bytes: Vec<u8> = image.color.interleaved().iter().map(|c| (c.clamp(0.0, 1.0) * 255.0) as u8).collect();
    [format!("P6\n{} {}\n255\n", camera.width, camera.height).into_bytes(), bytes].concat()
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let mut scene = match args.first() {
        Some(path) => format::scene::read(&std::fs::read(path)?)?,
        None => sample()?,
    };
    let t = Time(args.get(3).map_or(Ok(scene.clip[0]), |s| s.parse())?);
    let up = scene.up;
    let layer = &mut scene.layers[0];
    let motion: &dyn Any = layer.motion.as_ref();
    let Some(motion) = motion.downcast_ref::<Skinned<f32>>() else {
        return Err("the scene has no control nodes: train it with --motion control".into());
    };

    // Nodes at this time.
    let poses = motion.poses(&layer.params, t);
    let nodes = &layer.params[motion.skin.nodes];
    let now: Vec<[f64; 3]> =
        (0..nodes.rows()).map(|k| node_frame(nodes.read::<3>(k, 0), poses.read(k, 0)).0.map(f64::from)).collect();
    let height = |x: &[f64; 3]| (0..3).map(|k| x[k] * up[k]).sum::<f64>();
    let mut order: Vec<usize> = (0..now.len()).collect();
    order.sort_by(|&a, &b| height(&now[a]).total_cmp(&height(&now[b])));
    let span = order.first().zip(order.last()).map_or(0.0, |(&a, &b)| height(&now[b]) - height(&now[a]));
    let sideways = if up[0].abs() < 0.9 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
    let handle = |node: usize, by: f64| Handle {
        node,
        target: std::array::from_fn(|k| now[node][k] + by * sideways[k]),
        rotation: None,
    };
    let held = order[..now.len() / 2].iter().map(|&k| handle(k, 0.0));
    let dragged = order[now.len() - now.len() / 10..].iter().map(|&k| handle(k, 0.4 * span));
    let clock = std::time::Instant::now();
    let result = drag(&now, &held.chain(dragged).collect::<Vec<_>>(), ROUNDS)?;
    println!("{} nodes dragged in {:.1?}, energy {:?}", now.len(), clock.elapsed(), result.energies);

    let center: [f64; 3] = std::array::from_fn(|k| now.iter().map(|x| x[k]).sum::<f64>() / now.len().max(1) as f64);
    let aside = splat4d::math::se3::cross(up, sideways);
    let eye = std::array::from_fn(|k| center[k] - 2.5 * span * aside[k] + 0.3 * span * up[k]);
    let camera = Camera::with_fov_y(Se3::look_at(eye, center, up), 0.7, 320, 320);
    let displaced = Arc::new(motion.with_offsets(result.poses(&now)));
    let before = draw(&scene, t, &camera);
    scene.layers[0].motion = displaced;
    let after = draw(&scene, t, &camera);
    for (path, picture) in args.iter().skip(1).zip([before, after]) {
        std::fs::write(path, picture)?;
    }
    Ok(())
}
