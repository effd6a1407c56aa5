//! Times playback of a scene on the CPU, rendered to memory: evaluation of the motion, and the renderer's stages.
//!
//! `cargo run --release -p splat4d --example playback_speed FILE CAMERAS.json [SIZE [FRAMES]]`: a scene or playback file from the
//! places of its cameras, a picture of SIZE², time running.

use serde_json::Value;
use splat4d::math::Se3;
use splat4d::play::Player;
use splat4d::render::{Image, RenderConfig, Renderer, Simd};
use splat4d::scene::{Camera, Time};
use std::time::Instant;

fn main() -> splat4d::Result<()> {
    let mut args = std::env::args().skip(1);
    let path = args.next().expect("name a scene");
    let bytes = std::fs::read(&path).expect("the scene cannot be read");
    let scene = match bytes.starts_with(&splat4d::format::playback::MAGIC) {
        true => splat4d::format::playback::read(&bytes)?,
        false => splat4d::format::scene::read(&bytes)?,
    };
    let (clip, background, gaussians) = (scene.clip, scene.background, scene.len());
    let mut player = Player::of_scene(&scene);
    let cameras = std::fs::read_to_string(args.next().expect("name cameras.json")).expect("cameras cannot be read");
    let cameras: Vec<Value> = serde_json::from_str(&cameras).expect("cameras.json is a list");
    let size: usize = args.next().and_then(|a| a.parse().ok()).unwrap_or(800);
    let frames: usize = args.next().and_then(|a| a.parse().ok()).unwrap_or(120);
    let mut times = vec![];
    let (mut renderer, mut image) = (Renderer::new(RenderConfig::default()), Image::default());
    let (mut sums, mut lookup) = ([0.0f64; 5], 0.0);
    let (mut visible, mut pairs, mut work, mut active) = (0, 0, 0, 0);
    for frame in 0..frames + 5 {
        let u = frame as f64 / frames as f64;
        let camera = camera(&cameras[frame * 7 % cameras.len()], size);
        let t = clip[0] + (clip[1] - clip[0]) * (u * 3.0).fract();
        let start = Instant::now();
        player.alive(Time(t));
        let looked_up = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let splats = player.at(Time(t))?;
        let evaluated = start.elapsed().as_secs_f64();
        renderer.render(&splats, &camera, background, None, &mut image);
        let total = start.elapsed().as_secs_f64();
        if frame < 5 {
            continue;
        }
        times.push(total);
        lookup += looked_up;
        let s = renderer.stage_seconds();
        for (sum, v) in sums.iter_mut().zip([evaluated, s.project, s.shade, s.bin, s.blend]) {
            *sum += v;
        }
        let stats = renderer.stats();
        visible += stats.visible;
        pairs += stats.pairs;
        work += renderer.blend_work();
        active += stats.splats;
    }
    times.sort_by(f64::total_cmp);
    let n = frames as f64;
    println!(
        "{:?} {size}² {} Gaussians: median {:.2} ms, mean {:.2} ms, {:.1} frames/s",
        Simd::detect(),
        gaussians,
        times[frames / 2] * 1e3,
        times.iter().sum::<f64>() / n * 1e3,
        1.0 / times[frames / 2]
    );
    println!(
        "active set {:.3}, within motion {:.2}  project {:.2}  shade {:.2}  bin {:.2}  blend {:.2} ms",
        lookup / n * 1e3,
        sums[0] / n * 1e3,
        sums[1] / n * 1e3,
        sums[2] / n * 1e3,
        sums[3] / n * 1e3,
        sums[4] / n * 1e3
    );
    println!(
        "active {}, visible {}, pairs {}, tested pixels {:.1} M, {:.0} M/s",
        active / frames,
        visible / frames,
        pairs / frames,
        work as f64 / n / 1e6,
        work as f64 / 1e6 / sums[4]
    );
    Ok(())
}

/// One camera of a run, its picture `size`² with the same horizontal field of view.
fn camera(from: &Value, size: usize) -> Camera {
    let number = |v: &Value| v.as_f64().expect("a number");
    let position: [f64; 3] = std::array::from_fn(|k| number(&from["position"][k]));
    // Columns of world_from_camera are the camera's axes: rows of the inverse.
    let rotation: [[f64; 3]; 3] = std::array::from_fn(|r| std::array::from_fn(|c| number(&from["rotation"][c][r])));
    let translation = rotation.map(|r| -(r[0] * position[0] + r[1] * position[1] + r[2] * position[2]));
    let fov = 2.0 * (0.5 * number(&from["width"]) / number(&from["fx"])).atan();
    Camera::with_fov_y(Se3 { rotation, translation }, fov, size, size)
}
