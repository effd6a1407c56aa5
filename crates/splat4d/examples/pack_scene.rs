//! Packs a scene into a playback file, and prints its size and loss.
//!
//! `cargo run --release -p splat4d-core --example pack_scene [FILE [OUT.s4d [CAMERAS.json]]]`: FILE is a scene.safetensors
//! whose layers move linearly, or a 3DGS .ply. Without one it packs 120,000 synthetic moving Gaussians with spherical
//! harmonics of degree 3. Nothing is pruned: the figures are those of the format alone.

use serde_json::Value;
use splat4d::format::playback::{self, Draft, Meta, NamedCamera, Node, Primitive, Viewpoint, WriteConfig};
use splat4d::layers::{ALPHA_MIN, Evaluation, Layer, Scene};
use splat4d::math::{Rng, Se3, quat, sh};
use splat4d::motion::{Spacetime, SpacetimeSpec, Still};
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{Camera, GEOMETRY, LIFE, LifeKind, Params, SH, Time};
use std::sync::Arc;

/// Shortest span of time that gets a node of its own, seconds.
const SHORTEST: f64 = 0.2;
/// Synthetic Gaussians.
const COUNT: usize = 120_000;
/// Pixels across and down of the images that are compared.
const SIZE: [usize; 2] = [480, 360];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let mut scene = match args.first() {
        Some(path) => load(&std::fs::read(path)?)?,
        None => made_up(),
    };
    if scene.fps <= 0.0 {
        scene.fps = 30.0;
    }
    let mut draft = draft(&scene)?;
    if let Some(path) = args.get(2) {
        draft.meta.cameras = cameras(&serde_json::from_slice(&std::fs::read(path)?)?);
    }
    let floats: usize = scene.layers.iter().map(|l| floats(l) * l.params.len()).sum();
    let clock = std::time::Instant::now();
    let mut bytes = Vec::new();
    let summary = playback::write(&draft, &WriteConfig::default(), &mut bytes)?;
    let seconds = clock.elapsed().as_secs_f64();
    println!(
        "{} Gaussians, {} pages, {} palette entries in {seconds:.2} s: {} bytes (pages {}, palette {}), {:.1} a Gaussian",
        summary.gaussians,
        summary.pages,
        summary.palette_entries,
        summary.bytes,
        summary.page_bytes,
        summary.palette_bytes,
        summary.bytes as f64 / summary.gaussians as f64
    );
    println!("{:.2} times smaller than {} bytes of f32", (4 * floats) as f64 / summary.bytes as f64, 4 * floats);
    for (name, e) in summary.errors.named() {
        println!("{name:<20} rms {:.2e}, largest {:.2e}", e.rms, e.max);
    }
    let clock = std::time::Instant::now();
    let back = playback::read(&bytes)?;
    println!("read in {:.2} s", clock.elapsed().as_secs_f64());
    compare(&scene, &back, &draft);
    if let Some(out) = args.get(1) {
        let temporary = format!("{out}.part");
        std::fs::write(&temporary, &bytes)?;
        std::fs::rename(&temporary, out)?;
    }
    Ok(())
}

fn load(bytes: &[u8]) -> splat4d::Result<Scene<f32>> {
    if !bytes.starts_with(b"ply") {
        return splat4d::format::scene::read(bytes);
    }
    let (params, _) = splat4d::format::ply::read(bytes)?;
    let layer = Layer::new("ply", params, Arc::new(Still), LifeKind::Infinite);
    Ok(Scene { layers: vec![layer], up: [0.0, -1.0, 0.0], ..Scene::default() })
}

/// Learnt numbers per Gaussian.
fn floats(layer: &Layer<f32>) -> usize {
    layer.params.keys().map(|k| layer.params[k].width()).sum()
}

/// Gaussians on a few moving balls, coloured smoothly with some noise, living for a while.
fn made_up() -> Scene<f32> {
    let rng = Rng::new(7, "balls", 0);
    let life = LifeKind::GaussHalf;
    let mut params = Params::new(COUNT, sh::MAX_COEFFS, life.columns());
    let spec = SpacetimeSpec { order: 1, rotation: true, detach: false, origin: 0.5, features: None };
    let motion = Spacetime::new(spec, &mut params).expect("new tables");
    let [geometry, colors, lives, velocities, rates] =
        params.get_mut([GEOMETRY, SH, LIFE, motion.velocities(), motion.rates()]);
    for i in 0..COUNT {
        let r = rng.fork(i as u64);
        let ball = r.below(0, 8);
        let b = rng.fork(u64::MAX - ball as u64);
        let direction = quat::normalize([0.0, r.normal(1), r.normal(2), r.normal(3)]).0;
        let radius = 0.2 + 0.4 * b.uniform(0);
        let mean: [f64; 3] = std::array::from_fn(|k| 1.5 * b.normal(1 + k as u64) + radius * direction[1 + k]);
        geometry.write(i, 0, mean.map(|x| x as f32));
        geometry.write(i, QUAT, std::array::from_fn::<f32, 4, _>(|k| r.normal(4 + k as u64) as f32));
        let size = -4.6 + 0.5 * r.normal(8);
        geometry.write(
            i,
            LOG_SCALE,
            std::array::from_fn::<f32, 3, _>(|k| (size + 0.6 * r.normal(9 + k as u64)) as f32),
        );
        geometry.set(i, OPACITY, (0.5 + 1.5 * r.normal(12)) as f32);
        for c in 0..3 {
            colors.set(
                i,
                c,
                (0.6 * b.normal(5 + c as u64) + 0.4 * direction[1 + c] + 0.1 * r.normal(13 + c as u64)) as f32,
            );
            for k in 1..sh::MAX_COEFFS {
                // A highlight that goes round the ball, fainter with the degree, and what training leaves as noise.
                let smooth = (3.0 * direction[1 + k % 3] + b.normal((20 + k) as u64)).sin() / (k as f64).sqrt();
                colors.set(i, 3 * k + c, (0.12 * smooth + 0.02 * r.normal((20 + 3 * k + c) as u64)) as f32);
            }
        }
        lives.write(i, 0, [r.uniform(80) as f32, (0.05f64.ln() + 1.2 * r.normal(81)) as f32]);
        velocities.write(
            i,
            0,
            std::array::from_fn::<f32, 3, _>(|k| (b.normal(40 + k as u64) + 0.05 * r.normal(82 + k as u64)) as f32),
        );
        rates.write(i, 0, std::array::from_fn::<f32, 4, _>(|k| 0.3 * r.normal(86 + k as u64) as f32));
    }
    let layer = Layer::new("balls", params, Arc::new(motion), life);
    Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, up: [0.0, -1.0, 0.0], ..Scene::default() }
}

/// All Gaussians as primitives, each in the deepest node of a binary tree that holds its lifespan.
fn draft(scene: &Scene<f32>) -> Result<Draft, String> {
    let end = scene.clip[1] + 1.0 / scene.fps;
    let mut nodes = vec![Node { from: scene.clip[0], to: end, primitives: Vec::new() }];
    let mut i = 0;
    while i < nodes.len() {
        let (from, to) = (nodes[i].from, nodes[i].to);
        if to - from >= 2.0 * SHORTEST {
            let middle = 0.5 * (from + to);
            nodes.push(Node { from, to: middle, primitives: Vec::new() });
            nodes.push(Node { from: middle, to, primitives: Vec::new() });
        }
        i += 1;
    }
    let mut degree = 0;
    for layer in &scene.layers {
        let spans = layer.spans();
        degree = degree.max(sh::degree_of(layer.params[SH].width() / 3).unwrap_or(0));
        for (row, [from, to]) in spans.into_iter().enumerate().filter(|(_, [from, to])| from <= to) {
            let primitive = primitive(layer, row)?;
            let (from, to) = (from.max(scene.clip[0]), to.min(scene.clip[1]));
            let node = nodes.iter_mut().rfind(|n| n.from <= from && to < n.to).ok_or("a life outside of the clip")?;
            node.primitives.push(primitive);
        }
    }
    nodes.retain(|n| !n.primitives.is_empty());
    let means = || nodes.iter().flat_map(|n| &n.primitives).map(|p| p.mean);
    let bounds = [f64::min as fn(f64, f64) -> f64, f64::max]
        .map(|pick| std::array::from_fn(|k| means().map(|m| m[k]).reduce(pick).unwrap_or(0.0)));
    let (eye, middle, _) = stage(&nodes, scene.up);
    let meta = Meta {
        clip: scene.clip,
        fps: scene.fps,
        up: scene.up,
        background: scene.background,
        sh_degree: degree,
        title: "packed".into(),
        bounds: Some(bounds),
        view: Some(Viewpoint { position: eye, target: middle, up: scene.up, fov_y: 45.0 }),
        ..Meta::default()
    };
    Ok(Draft { meta, nodes, poster: None })
}

fn primitive(layer: &Layer<f32>, row: usize) -> Result<Primitive, String> {
    let p = &layer.params;
    let geometry = &p[GEOMETRY];
    let column = |name: &str| p.find(name).map(|k| &p[k]).filter(|t| t.width() > 0);
    let (velocities, rates) = (column("velocities"), column("rotation_rates"));
    let Some(path) = layer.motion.polynomial().filter(|path| path.order <= 1) else {
        return Err(format!("{} of this kind is not a straight line", layer.motion.spec().name()));
    };
    let origin = path.origin;
    let life = &p[LIFE];
    let (center, half_width, softness) = match layer.life {
        LifeKind::Infinite => (origin, f64::INFINITY, 1.0),
        LifeKind::GaussHalf => (f64::from(life.get(row, 0)), 0.0, f64::from(life.get(row, 1)).exp()),
        LifeKind::GaussOne => (f64::from(life.get(row, 0)), 0.0, f64::from(life.get(row, 1)).exp() / 2f64.sqrt()),
        LifeKind::Interval => {
            let [c, w, s] = life.read::<3>(row, 0).map(f64::from);
            (c, w.exp(), s.exp())
        }
    };
    let raw = geometry.read::<4>(row, QUAT).map(f64::from);
    let (q, norm) = quat::normalize(raw);
    // dq/dt = ½(0, ω)⊗q, so that ω is twice the vector part of dq/dt ⊗ q̄.
    let turn = rates.map_or([0.0; 3], |t| {
        let [w, x, y, z] = t.read::<4>(row, 0).map(|r| f64::from(r) / norm);
        let [a, b, c, d] = q;
        [a * x - b * w - c * z + d * y, a * y + b * z - c * w - d * x, a * z - b * y + c * x - d * w].map(|v| 2.0 * v)
    });
    let mut sh_rest = [0.0; 45];
    let colors = &p[SH];
    (3..colors.width()).for_each(|c| sh_rest[c - 3] = colors.get(row, c));
    let scales = geometry.read::<3>(row, LOG_SCALE).map(f32::exp);
    let opacity = 1.0 / (1.0 + (-geometry.get(row, OPACITY)).exp());
    let area = scales[0].max(scales[1]) * scales[1].max(scales[2]);
    let seconds = LifeKind::Interval.reach(
        [0.0, half_width.min(1.0).ln(), softness.min(1.0).ln()],
        f64::from(opacity).max(ALPHA_MIN),
        ALPHA_MIN,
    );
    Ok(Primitive {
        mean: geometry.read::<3>(row, 0).map(f64::from),
        center,
        half_width,
        softness,
        quat: q.map(|x| x as f32),
        scales,
        opacity,
        velocity: velocities.map_or([0.0; 3], |t| t.read::<3>(row, 0)),
        turn: turn.map(|w| w as f32),
        base_color: colors.read::<3>(row, 0).map(sh::dc_to_rgb),
        sh_rest,
        importance: opacity * area * seconds.max(0.01) as f32,
        label: None,
        features: Vec::new(),
    })
}

/// An eye, the middle of what is there and its radius (medians, so that floaters do not count).
fn stage(nodes: &[Node], up: [f64; 3]) -> ([f64; 3], [f64; 3], f64) {
    let median = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    let all = || nodes.iter().flat_map(|n| &n.primitives);
    let middle: [f64; 3] = std::array::from_fn(|k| median(all().map(|p| p.mean[k]).collect()));
    let distance = |m: [f64; 3]| (0..3).map(|k| (m[k] - middle[k]).powi(2)).sum::<f64>().sqrt();
    let radius = 2.0 * median(all().map(|p| distance(p.mean)).collect()).max(1e-6);
    let side = if up[2].abs() < 0.9 { [0.0, 0.0, 1.0] } else { [1.0, 0.0, 0.0] };
    (std::array::from_fn(|k| middle[k] + radius * (0.4 * up[k] - 2.0 * side[k])), middle, radius)
}

/// PSNR of the packed scene's images against the scene's, over several views and times.
fn compare(scene: &Scene<f32>, back: &Scene<f32>, draft: &Draft) {
    let (_, middle, radius) = stage(&draft.nodes, scene.up);
    let (mut worst, mut sum, mut count) = (f64::INFINITY, 0.0, 0.0);
    for i in 0..8 {
        let t = Time(scene.clip[0] + (scene.clip[1] - scene.clip[0]) * f64::from(i) / 7.0);
        let (s, c) = (f64::from(i) * 0.8).sin_cos();
        let flat = if scene.up[1].abs() > 0.9 { [s, 0.0, c] } else { [s, c, 0.0] };
        let eye = std::array::from_fn(|k| middle[k] + radius * (0.3 * scene.up[k] + 2.0 * flat[k]));
        let camera = Camera::with_fov_y(Se3::look_at(eye, middle, scene.up), 0.8, SIZE[0], SIZE[1]);
        let draw = |scene: &Scene<f32>| {
            let (mut instant, mut image) = (Evaluation::default(), Image::default());
            scene.at(t, &mut instant);
            let splats = scene.splats(&instant);
            Renderer::new(RenderConfig::default()).render(&Shot::new(&splats, &camera, scene.background), &mut image);
            image.color.data
        };
        let (a, b) = (draw(scene), draw(back));
        let square = |(a, b): (&f32, &f32)| f64::from(a.clamp(0.0, 1.0) - b.clamp(0.0, 1.0)).powi(2);
        let error = a.iter().zip(&b).map(square).sum::<f64>() / a.len() as f64;
        let psnr = -10.0 * error.log10();
        (worst, sum, count) = (f64::min(worst, psnr), sum + psnr, count + 1.0);
    }
    println!("images against the floats: mean {:.2} dB, worst {worst:.2} dB", sum / count);
}

/// The cameras of a cameras.json as 3DGS programs write it, each name once.
fn cameras(json: &Value) -> Vec<NamedCamera> {
    let mut out: Vec<NamedCamera> = Vec::new();
    for c in json.as_array().into_iter().flatten() {
        let number = |key: &str| c[key].as_f64().unwrap_or(0.0);
        let name = c["img_name"].as_str().unwrap_or_default().to_owned();
        if out.iter().any(|o| o.name == name) {
            continue;
        }
        let world_from_camera = std::array::from_fn(|i| {
            let (row, col) = (i / 4, i % 4);
            let cell = if col < 3 { &c["rotation"][row][col] } else { &c["position"][row] };
            cell.as_f64().unwrap_or(0.0)
        });
        let (width, height) = (number("width") as usize, number("height") as usize);
        let (fx, fy, cx, cy) = (number("fx"), number("fy"), number("cx"), number("cy"));
        out.push(NamedCamera { name, world_from_camera, width, height, fx, fy, cx, cy, ..NamedCamera::default() });
    }
    out
}
