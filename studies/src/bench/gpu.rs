//! Times of a GPU: every stage of an image and of its backward pass by the GPU's own clock, and whole training steps in
//! which it renders.

use super::roofline::bytes;
use super::rows::Row;
use super::scenes::Pinned;
use super::stages::{Way, gradient, zeros};
use super::training::{self, Held};
use splat4d::Result;
use splat4d::device::ResidentMotion;
use splat4d::gpu::{Adapters, Gpu, GpuRenderer, GpuRoofline, GpuStats, GpuTimings, StageClock, Tuning};
use splat4d::layers::{ALPHA_MIN, Layer};
use splat4d::math::Se3;
use splat4d::play::Player;
use splat4d::render::{Backend, Image, ImageGrads, RenderConfig, RenderGrads, ResidentLayer, ResidentTable, Shot};
use splat4d::scene::{Camera, Splats, Table, Time};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Bytes of a splat's geometry, of what is made of it, of its place in a list, and of what returns to the CPU.
const GEOMETRY: usize = 40;
const SHAPE: usize = 48;
const NUMBER: usize = 4;
const BACK: usize = 80;
/// Planes of an image (colours, alpha, depth), and those that have a gradient.
const PLANES: usize = 5;
const COLORS: usize = 3;
/// Bytes of a pair in the lists: key, number, owner; and of its record.
const PAIR: usize = 12;
const RECORD: usize = 48;
/// A pass of a sort reads keys twice and values once, and writes both.
const SORT: usize = 20;
/// Passes over depths, and over tiles of images of up to 65,535 of them.
const DEPTH_PASSES: usize = 4;
const TILE_PASSES: usize = 2;

/// Stages in the order in which they run. The last of a way, `memory to memory`, is the whole call, with the upload and
/// what is read back.
const STAGES: [&str; 13] = [
    "upload",
    "project",
    "compact",
    "sort splats",
    "tiles",
    "sort pairs",
    "rasterize",
    "forward, memory to memory",
    "rasterize backward",
    "gather",
    "splats backward",
    "backward, memory to memory",
    "forward+backward",
];

fn times(t: &GpuTimings) -> [f64; STAGES.len()] {
    let (forward, back) = (t.total, t.back_total);
    let lists = [t.upload, t.project, t.compact, t.sort_splats, t.tiles, t.sort_pairs, t.rasterize, forward];
    let mut out = [0.0; STAGES.len()];
    out[..lists.len()].copy_from_slice(&lists);
    out[lists.len()..].copy_from_slice(&[t.rasterize_back, t.gather, t.splats_back, back, forward + back]);
    out
}

/// The least milliseconds that each stage could take.
fn floors(
    splats: &Splats<'_, f32>,
    pixels: usize,
    s: GpuStats,
    evaluations: u64,
    best: &GpuRoofline,
) -> [f64; STAGES.len()] {
    let moved = |bytes: usize| 1e3 * bytes as f64 / best.bytes;
    let [up, down] = best.bus.map(|a_second| move |bytes: usize| 1e3 * bytes as f64 / a_second);
    let blend = 1e3 * evaluations as f64 / best.pairs;
    let mut out = [0.0; STAGES.len()];
    out[1] = moved(s.splats * (GEOMETRY + NUMBER) + bytes::shade(splats, s.visible) + s.visible * SHAPE);
    out[2] = moved(s.splats * 3 * NUMBER + s.visible * 2 * NUMBER);
    out[3] = moved(s.visible * SORT * DEPTH_PASSES);
    out[4] = moved(s.visible * (SHAPE + 4 * NUMBER) + s.pairs * PAIR);
    out[5] = moved(s.pairs * (SORT * TILE_PASSES + NUMBER));
    out[6] = blend;
    out[8] = blend + moved(2 * s.pairs * RECORD);
    out[9] = moved(s.pairs * RECORD + s.visible * RECORD);
    out[10] = moved(s.splats * (GEOMETRY + NUMBER + BACK) + s.visible * (SHAPE + RECORD));
    // What passes the bus: tables and planes, their gradients the other way.
    out[0] = up(s.splats * GEOMETRY + bytes::shade(splats, s.splats));
    out[7] = out[..7].iter().sum::<f64>() + down(pixels * PLANES * NUMBER);
    out[11] = out[8..11].iter().sum::<f64>() + up(pixels * COLORS * NUMBER) + down(s.splats * BACK);
    out[12] = out[7] + out[11];
    out
}

/// Those of an image that stays there, and of its backward pass.
const LISTS: [&str; 6] = ["project", "compact", "sort splats", "tiles", "sort pairs", "rasterize"];
const BACKWARD: [&str; 3] = ["rasterize backward", "gather", "splats backward"];
/// A whole training step; a frame of a film.
const STEP: &str = "step";
/// The CPU's part of it: what the caller of a step waits for while the GPU is behind.
const HOST: &str = "step, on the CPU";
const FILM: &str = "frame, nothing read back";
/// Frames of a film, times the rounds, of which there are five by default; and how often it is rendered at most: the
/// best counts.
const FRAMES: usize = 200;
const FILMS: usize = 3;
/// How far a camera turns to either side, radians: five degrees.
const SWING: f64 = 0.087;
/// Stages that only whole training steps on the GPU have.
const OF_STEPS: [&str; 4] = ["answer", "loss", "answer backward", "adam"];

/// A GPU of any kind whose kernels are compiled with these constants.
fn renderer(tuning: Tuning) -> Result<GpuRenderer> {
    let mut renderer = GpuRenderer::new(Gpu::open(Adapters::Any)?.tuned(tuning), RenderConfig::default())?;
    renderer.for_training()?;
    if renderer.clock == StageClock::Off {
        renderer.clock = StageClock::Wall;
    }
    Ok(renderer)
}

/// Renders every view of every scene and takes it back, and trains a few steps, with each of these constants of the
/// kernels; the defaults come first. Errors: there is no GPU of any kind.
pub(super) fn measure(
    scenes: &[Pinned],
    way: Way,
    tunings: &[Tuning],
    pool: &rayon::ThreadPool,
    note: &dyn Fn(&str),
) -> Result<Vec<Row>> {
    let first = renderer(Tuning::default())?;
    let (name, r) = (first.gpu().describe(), first.roofline()?);
    drop(first);
    let best = r;
    note(&format!("{name}: at best {:.2} G pairs/s and {:.1} GB/s", best.pairs * 1e-9, best.bytes * 1e-9));
    let mut rows: Vec<Row> = Vec::new();
    for pinned in scenes {
        // Truth is rendered by the CPU, once.
        let held = Arc::new(pool.install(|| Held::of(pinned, way)));
        for tuning in tunings {
            let changes = tuning.changes();
            let with = changes.as_ref().map_or_else(String::new, |c| format!(" with {c}"));
            note(&format!("scene {} on {name}{with} ...", pinned.name));
            let mut here = pool.install(|| stages(pinned, way, &mut renderer(*tuning)?, &best))?;
            here.extend(pool.install(|| steps(pinned, &held, way, renderer(*tuning)?, (&best, &here)))?);
            if changes.is_none() {
                here.extend(pool.install(|| film(pinned, way, &mut renderer(*tuning)?, &here))?);
            }
            for row in here.iter_mut().filter(|_| changes.is_some()) {
                let default = rows.iter().find(|r| r.scene == row.scene && r.stage == row.stage && r.tuning.is_none());
                row.against = default.filter(|d| d.ms > 0.0).map(|d| row.ms / d.ms);
                row.tuning.clone_from(&changes);
            }
            rows.append(&mut here);
        }
    }
    for row in &mut rows {
        row.device = Some(name.clone());
        row.simd = "gpu".into();
    }
    Ok(rows)
}

/// Trains still scenes as other programs do whose runs are in a folder, and leaves there what they need for it.
pub(super) fn other_programs(
    scenes: &[Pinned],
    folder: &Path,
    way: Way,
    pool: &rayon::ThreadPool,
    note: &dyn Fn(&str),
) -> Result<Vec<Row>> {
    let one = |pinned: &Pinned| {
        let mut renderer = renderer(Tuning::default())?;
        renderer.config = super::other_programs::config();
        let name = renderer.gpu().describe();
        note(&format!("scene {} on {name}, against others ...", pinned.name));
        let measured = pool.install(|| super::other_programs::measure(pinned, folder, way, Box::new(renderer), &name));
        let (row, verdicts) = measured?;
        verdicts.iter().for_each(|verdict| note(&format!("scene {}: {verdict}", pinned.name)));
        Ok(Row { device: Some(name), simd: "gpu".into(), ..row })
    };
    scenes.iter().map(one).collect()
}

fn stages(pinned: &Pinned, way: Way, renderer: &mut GpuRenderer, best: &GpuRoofline) -> Result<Vec<Row>> {
    let (mut image, mut d, mut d_sh) = (Image::default(), RenderGrads::default(), Vec::new());
    let mut player = Player::of_scene(&pinned.scene);
    let mut seen = vec![[f64::MAX; STAGES.len()]; pinned.views.len()];
    let mut floor = vec![[0.0; STAGES.len()]; pinned.views.len()];
    let mut counted = 0;
    for round in 0..=way.rounds {
        for ((view, seen), floor) in pinned.views.iter().zip(&mut seen).zip(&mut floor) {
            let splats = player.at(view.time)?;
            let shot = Shot::new(&splats, &view.camera, pinned.scene.background);
            Backend::render(renderer, &shot, &mut image)?;
            let grad = gradient(view);
            if d_sh.len() != splats.parts.len() {
                d_sh = zeros(&splats);
            }
            let mut targets: Vec<Option<&mut Table<f32>>> = d_sh.iter_mut().map(Option::as_mut).collect();
            let grads = ImageGrads { color: &grad, alpha: None, depth: None, extra: None };
            renderer.vjp(&shot, &grads, &mut targets, &mut d)?;
            if round == 0 {
                let evaluations = renderer.evaluations()?;
                counted += evaluations;
                let pixels = view.camera.width * view.camera.height;
                *floor = floors(&splats, pixels, renderer.stats(), evaluations, best);
                continue;
            }
            seen.iter_mut().zip(times(&renderer.timings())).for_each(|(best, now)| *best = best.min(now));
        }
    }
    let n = seen.len() as f64;
    let row = |(k, stage): (usize, &&str)| {
        let mean = |all: &[[f64; STAGES.len()]]| all.iter().map(|s| s[k]).sum::<f64>() / n;
        let (ms, floor) = (mean(&seen), mean(&floor));
        Row {
            scene: pinned.name.clone(),
            stage: (*stage).into(),
            threads: way.threads,
            ms,
            ceiling_share: (floor > 0.0 && ms > 0.0).then_some(floor / ms),
            tested_pairs: stage.starts_with("rasterize").then_some((counted as f64 / n) as u64),
            ..Row::default()
        }
    };
    Ok(STAGES.iter().enumerate().map(row).collect())
}

/// Whole training steps on the GPU: those of their stages that rendering alone does not have, of steps that are waited
/// for one by one; and the whole, of rounds in which the GPU is never waited for but at their ends.
fn steps(
    pinned: &Pinned,
    held: &Arc<Held>,
    way: Way,
    renderer: GpuRenderer,
    (best, drawn): (&GpuRoofline, &[Row]),
) -> Result<Vec<Row>> {
    let mut trainer = training::trainer_on(pinned.scene.clone(), held.clone(), Box::new(renderer))?;
    let mut seen = vec![[f64::MAX; OF_STEPS.len()]; pinned.views.len()];
    let (mut step, mut host) = (f64::MAX, f64::MAX);
    for round in 0..=way.rounds {
        for _ in 0..seen.len() {
            training::step(&mut trainer)?;
            training::catch_up(&mut trainer)?;
            if round > 0 {
                let stages = trainer.stages();
                let of = |stage: &str| stages.iter().find(|s| s.0 == stage).map_or(0.0, |s| s.1);
                seen[held.last()].iter_mut().zip(OF_STEPS.map(of)).for_each(|(best, now)| *best = best.min(now));
            }
        }
        let clock = Instant::now();
        for _ in 0..seen.len() {
            training::step(&mut trainer)?;
        }
        let begun = clock.elapsed();
        training::catch_up(&mut trainer)?;
        if round > 0 {
            host = host.min(1e3 * begun.as_secs_f64() / seen.len() as f64);
            step = step.min(1e3 * clock.elapsed().as_secs_f64() / seen.len() as f64);
        }
    }
    let mean = |k: usize| seen.iter().map(|s| s[k]).sum::<f64>() / seen.len() as f64;
    let mut player = Player::of_scene(&pinned.scene);
    let mut alive = 0;
    for view in &pinned.views {
        alive += player.at(view.time)?.len();
    }
    let (alive, camera) = (alive / pinned.views.len(), &pinned.views[0].camera);
    let moved = [
        bytes::motion(&pinned.scene, alive),
        bytes::loss(camera.width * camera.height),
        bytes::motion_backward(&pinned.scene, alive),
        bytes::adam(&pinned.scene, alive),
    ];
    let row = |stage: &str, ms: f64| Row {
        scene: pinned.name.clone(),
        stage: stage.into(),
        threads: way.threads,
        ms,
        ..Row::default()
    };
    let of_stage = |(k, stage): (usize, &&str)| {
        let (ms, floor) = (mean(k), 1e3 * moved[k] as f64 / best.bytes);
        Row { ceiling_share: (ms > 0.0).then(|| floor / ms), ..row(stage, ms) }
    };
    let mut rows: Vec<Row> = OF_STEPS.iter().enumerate().map(of_stage).collect();
    let floor = floor_of(drawn, &[&LISTS[..], &BACKWARD].concat()) + floor_of(&rows, &OF_STEPS);
    rows.push(Row { ceiling_share: Some(floor / step), ..row(STEP, step) });
    rows.push(row(HOST, host));
    Ok(rows)
}

/// The least milliseconds of some stages together.
fn floor_of(rows: &[Row], stages: &[&str]) -> f64 {
    let floor = |r: &Row| r.ceiling_share.map_or(0.0, |share| share * r.ms);
    rows.iter().filter(|r| stages.contains(&r.stage.as_str())).map(floor).sum()
}

/// Frames of a moving camera at moving times, none read back; `stages`: rows of what a frame is made of.
fn film(pinned: &Pinned, way: Way, renderer: &mut GpuRenderer, stages: &[Row]) -> Result<Vec<Row>> {
    let frames = FRAMES * way.rounds;
    let path: Vec<(Camera, Time)> = (0..frames).map(|i| along(pinned, i as f64 / frames as f64)).collect();
    let mut best = f64::MAX;
    let times: Vec<Time> = path.iter().map(|p| p.1).collect();
    let known: Option<Vec<_>> = pinned.scene.layers.iter().map(|l| ResidentMotion::new(l, &times)).collect();
    let Some(known) = known else { return Ok(Vec::new()) };
    // Three columns per row, in blocks of sixteen.
    let stats: Vec<Vec<f32>> =
        pinned.scene.layers.iter().map(|l| vec![0.0; 3 * l.params.len().next_multiple_of(16)]).collect();
    fn kept<'a>(((layer, known), stats): ((&'a Layer, &ResidentMotion), &'a Vec<f32>)) -> ResidentLayer<'a> {
        let tables = known.keys.map(|key| {
            key.map_or(ResidentTable::default(), |key| {
                let table = &layer.params[key];
                ResidentTable { width: table.width(), params: table.data(), moments: &[] }
            })
        });
        ResidentLayer { rows: layer.params.len(), moves: known.moves, life: layer.life, tables, stats, ties: None }
    }
    let layers: Vec<ResidentLayer<'_>> = pinned.scene.layers.iter().zip(&known).zip(&stats).map(kept).collect();
    for _ in 0..way.rounds.min(FILMS) {
        let film = renderer.film(&layers, ALPHA_MIN, pinned.scene.background, &path)?;
        let Some(seconds) = film else { return Ok(Vec::new()) };
        best = best.min(1e3 * seconds / frames as f64);
    }
    let floor = floor_of(stages, &LISTS) + floor_of(stages, &OF_STEPS[..1]);
    let row = Row { scene: pinned.name.clone(), stage: FILM.into(), threads: way.threads, ms: best, ..Row::default() };
    Ok(vec![Row { ceiling_share: Some(floor / best), ..row }])
}

/// The camera and the time after a share of the film: every view in turn, of which each turns from side to side,
/// through the whole clip.
fn along(pinned: &Pinned, share: f64) -> (Camera, Time) {
    let place = share * pinned.views.len() as f64;
    let mut camera = pinned.views[place as usize].camera.clone();
    let (sin, cos) = (SWING * (std::f64::consts::TAU * place).sin()).sin_cos();
    let turn = Se3 { rotation: [[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]], translation: [0.0; 3] };
    camera.cam_from_world = turn.after(&camera.cam_from_world);
    let [first, last] = pinned.scene.clip;
    (camera, Time(first + share * (last - first)))
}

#[cfg(test)]
mod tests {
    use super::super::scenes::made_up;
    use super::*;
    use splat4d::render::Simd;

    #[test]
    fn every_stage_has_a_time() {
        let pinned = made_up("small", 400, [40, 30]);
        // One of the sweep's values is enough to compare with the defaults: each compiles all kernels again.
        let tunings = [Tuning::default(), Tuning { batch: 64, ..Tuning::default() }];
        let way = Way { threads: 1, simd: Simd::detect(), rounds: 1 };
        let pool = super::super::pool(way.threads).unwrap();
        let rows = match measure(&[pinned], way, &tunings, &pool, &|_| {}) {
            Ok(rows) => rows,
            Err(e) => {
                assert!(std::env::var_os("REQUIRE_GPU").is_none(), "REQUIRE_GPU is set: {e}");
                return println!("skipped: {e}");
            }
        };
        let all = [&STAGES[..], &OF_STEPS, &[STEP, HOST]].concat();
        let (films, others): (Vec<&Row>, Vec<&Row>) = rows.iter().partition(|r| r.stage == FILM);
        assert!(films.len() == 1 && films[0].tuning.is_none(), "one film, at the defaults");
        let stages: Vec<&str> = others.iter().map(|r| r.stage.as_str()).collect();
        assert_eq!(stages, all.repeat(tunings.len()));
        for row in &rows {
            assert!(row.ms > 0.0 && row.ms.is_finite() && row.device.is_some() && row.simd == "gpu", "{row:?}");
            assert!(row.stage == HOST || row.ceiling_share.is_some_and(|share| share > 0.0), "{row:?}");
            assert_eq!(row.tuning.is_some(), row.against.is_some(), "{row:?}");
        }
        let ms = |stage: &str| rows.iter().find(|r| r.stage == stage).expect("it is there").ms;
        assert!(ms("rasterize") < ms("forward, memory to memory") && ms("gather") < ms("backward, memory to memory"));
    }
}
