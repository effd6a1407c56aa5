//! Times of rendering: the motion at a time, the renderer's stages, and their backward pass.

use super::roofline::{Roofline, bytes};
use super::rows::Row;
use super::scenes::{Pinned, View};
use splat4d::Result;
use splat4d::play::Player;
use splat4d::render::{Image, ImageGrads, RenderConfig, RenderGrads, Renderer, Shot, Simd};
use splat4d::scene::{Color, Planes, Splats, Table};
use std::time::Instant;

/// How often, with what, on how many threads.
#[derive(Clone, Copy, Debug)]
pub(super) struct Way {
    pub threads: usize,
    pub simd: Simd,
    /// Rounds over all views, after a warm-up round.
    pub rounds: usize,
}

/// Stages in the order in which they run. `motion` includes the lookup of who is alive; `forward` is what
/// `Renderer::render` takes, without the motion; `forward+backward` adds `Renderer::backward`.
const STAGES: [&str; 10] = [
    "who is alive",
    "motion",
    "project",
    "shade",
    "bin",
    "blend",
    "forward",
    "blend backward",
    "splats backward",
    "forward+backward",
];

/// Best time of each stage for one view, seconds, and the work in it.
#[derive(Clone, Copy)]
struct Seen {
    best: [f64; STAGES.len()],
    /// The least that each could take, seconds.
    floor: [f64; STAGES.len()],
    tested: usize,
    contributing: usize,
}

/// The name of a level, as `--simd` takes it.
pub(super) fn simd_name(simd: Simd) -> &'static str {
    match simd {
        Simd::Scalar => "scalar",
        Simd::Avx2 => "avx2",
        Simd::Avx512 => "avx512",
    }
}

/// A gradient to an image: always the same numbers, small and of both signs.
pub(super) fn gradient(view: &View) -> Planes<f32> {
    let mut grad = Planes::new(3, view.camera.height, view.camera.width);
    for (i, g) in grad.data.iter_mut().enumerate() {
        *g = ((i * 7919 % 1000) as f32 - 500.0) * 1e-6;
    }
    grad
}

/// One table per part, where its colours are the layer's own.
pub(super) fn zeros(splats: &Splats<'_, f32>) -> Vec<Option<Table<f32>>> {
    let table = |color: Color<'_, f32>| match color {
        Color::Sh { table, base: true, .. } => Some(table.zeros_like()),
        _ => None,
    };
    splats.parts.iter().map(|p| table(p.color)).collect()
}

/// Renders every view again and again. Call it inside a pool of `way.threads` threads.
pub(super) fn measure(pinned: &Pinned, way: Way, roofline: &Roofline) -> Result<Vec<Row>> {
    let config = RenderConfig { simd: way.simd, ..RenderConfig::default() };
    let (mut renderer, mut image) = (Renderer::new(config), Image::default());
    let (mut d, mut d_sh) = (RenderGrads::default(), Vec::new());
    let mut player = Player::of_scene(&pinned.scene);
    let background = pinned.scene.background;
    let nothing = [f64::MAX; STAGES.len()];
    let mut seen =
        vec![Seen { best: nothing, floor: [0.0; STAGES.len()], tested: 0, contributing: 0 }; pinned.views.len()];
    for round in 0..=way.rounds {
        for (view, seen) in pinned.views.iter().zip(&mut seen) {
            let clock = Instant::now();
            player.alive(view.time);
            let alive = clock.elapsed().as_secs_f64();
            let clock = Instant::now();
            let splats = player.at(view.time)?;
            let motion = clock.elapsed().as_secs_f64();
            let clock = Instant::now();
            renderer.render(&Shot::new(&splats, &view.camera, background), &mut image);
            let forward = clock.elapsed().as_secs_f64();
            if round == 0 {
                let counts = renderer.count_pairs();
                (seen.tested, seen.contributing) = (counts.tested, counts.contributing);
                seen.floor = floor(pinned, &splats, &renderer, counts.tested, roofline);
            }
            let grad = gradient(view);
            if d_sh.len() != splats.parts.len() {
                d_sh = zeros(&splats);
            }
            let mut d_sh: Vec<Option<&mut Table<f32>>> = d_sh.iter_mut().map(Option::as_mut).collect();
            let grads = ImageGrads { color: &grad, alpha: None, depth: None, extra: None };
            let clock = Instant::now();
            renderer.backward(&Shot::new(&splats, &view.camera, background), &grads, &mut d_sh, &mut d);
            let backward = clock.elapsed().as_secs_f64();
            if round > 0 {
                let s = renderer.stage_seconds();
                let (b, p) = (s.blend_backward, s.splats_backward);
                let now = [alive, motion, s.project, s.shade, s.bin, s.blend, forward, b, p, forward + backward];
                seen.best.iter_mut().zip(now).for_each(|(best, now)| *best = best.min(now));
            }
        }
    }
    Ok(rows(pinned, way, &seen))
}

fn floor(
    pinned: &Pinned,
    splats: &Splats<'_, f32>,
    renderer: &Renderer,
    tested: usize,
    roofline: &Roofline,
) -> [f64; STAGES.len()] {
    let stats = renderer.stats();
    let moved = |bytes: usize| bytes as f64 / roofline.bytes;
    let blend = tested as f64 / roofline.pairs;
    let motion = moved(bytes::motion(&pinned.scene, splats.len()));
    let project = moved(bytes::project(stats.splats));
    let shade = moved(bytes::shade(splats, stats.visible));
    let bin = moved(bytes::bin(stats.pairs));
    let back = moved(bytes::splats_backward(splats, stats.visible));
    let forward = project + shade + bin + blend;
    [0.0, motion, project, shade, bin, blend, forward, blend, back, forward + blend + back]
}

fn rows(pinned: &Pinned, way: Way, seen: &[Seen]) -> Vec<Row> {
    let n = seen.len() as f64;
    let mean = |f: &dyn Fn(&Seen) -> f64| seen.iter().map(f).sum::<f64>() / n;
    let row = |(k, stage): (usize, &&str)| {
        let (ms, floor) = (1e3 * mean(&|s| s.best[k]), 1e3 * mean(&|s| s.floor[k]));
        let blends = stage.contains("blend") || stage.contains("forward");
        Row {
            scene: pinned.name.clone(),
            stage: (*stage).into(),
            threads: way.threads,
            simd: simd_name(way.simd).into(),
            ms,
            ceiling_share: (floor > 0.0 && ms > 0.0).then_some(floor / ms),
            tested_pairs: blends.then_some(mean(&|s| s.tested as f64) as u64),
            contributing_pairs: blends.then_some(mean(&|s| s.contributing as f64) as u64),
            ..Row::default()
        }
    };
    STAGES.iter().enumerate().map(row).collect()
}
