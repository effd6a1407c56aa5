//! Times of a GPU: every stage of a picture and of its way back by the GPU's own clock, and whole training steps in which it
//! draws.

use super::roofline::{Roofline, bytes};
use super::rows::Row;
use super::scenes::Pinned;
use super::stages::{Way, gradient, zeros};
use super::training::{self, Held};
use splat4d::Result;
use splat4d::gpu::{Adapters, Gpu, GpuRenderer, GpuStats, GpuTimings, StageClock, Tuning};
use splat4d::play::Player;
use splat4d::render::{Backend, Image, ImageGrads, RenderConfig, RenderGrads, Shot};
use splat4d::scene::{Splats, Table};
use std::sync::Arc;

/// Bytes of a splat's geometry, of what is made of it, of its place in a list, and of what goes back to the CPU.
const GEOMETRY: usize = 40;
const SHAPE: usize = 48;
const NUMBER: usize = 4;
const BACK: usize = 80;
/// Bytes of a pair in the lists: key, number, owner; and of its record.
const PAIR: usize = 12;
const RECORD: usize = 48;
/// A pass of a sort reads keys twice and values once, and writes both.
const SORT: usize = 20;
/// Passes over depths, and over tiles of pictures of up to 65,535 of them.
const DEPTH_PASSES: usize = 4;
const TILE_PASSES: usize = 2;

/// Stages in the order in which they run. The last of a way, `memory to memory`, is the whole call, with the upload and what is
/// read back.
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

/// The least milliseconds that each stage could take; 0 where that is not known.
fn floors(splats: &Splats<'_, f32>, s: GpuStats, evaluations: u64, best: &Roofline) -> [f64; STAGES.len()] {
    let moved = |bytes: usize| 1e3 * bytes as f64 / best.bytes;
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
    out
}

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

/// Draws every view of every scene and takes it back, and trains a few steps; with `sweep` for every value of the kernels' constants.
/// Errors: there is no GPU of any kind.
pub(super) fn measure(
    scenes: &[Pinned],
    way: Way,
    sweep: bool,
    pool: &rayon::ThreadPool,
    note: &dyn Fn(&str),
) -> Result<Vec<Row>> {
    let first = renderer(Tuning::default())?;
    let (name, r) = (first.gpu().describe(), first.roofline()?);
    drop(first);
    let best = Roofline { pairs: r.pairs, bytes: r.bytes };
    note(&format!("{name}: at best {:.2} G pairs/s and {:.1} GB/s", best.pairs * 1e-9, best.bytes * 1e-9));
    let tunings = if sweep { Tuning::sweep() } else { vec![Tuning::default()] };
    let mut rows: Vec<Row> = Vec::new();
    for pinned in scenes {
        for tuning in &tunings {
            let changes = tuning.changes();
            let with = changes.as_ref().map_or_else(String::new, |c| format!(" with {c}"));
            note(&format!("scene {} on {name}{with} ...", pinned.name));
            let mut here = pool.install(|| stages(pinned, way, &mut renderer(*tuning)?, &best))?;
            here.extend(pool.install(|| steps(pinned, way, renderer(*tuning)?, &best))?);
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

fn stages(pinned: &Pinned, way: Way, renderer: &mut GpuRenderer, best: &Roofline) -> Result<Vec<Row>> {
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
                *floor = floors(&splats, renderer.stats(), evaluations, best);
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

/// Whole training steps on the GPU, and those of their stages that drawing alone does not have.
fn steps(pinned: &Pinned, way: Way, renderer: GpuRenderer, best: &Roofline) -> Result<Vec<Row>> {
    let held = Arc::new(Held::of(pinned, way));
    let mut trainer = training::trainer_on(pinned.scene.clone(), held.clone(), Box::new(renderer))?;
    // The stages, then the whole step and the time of the calls that draw.
    const ALL: usize = OF_STEPS.len() + 2;
    let mut seen = vec![[f64::MAX; ALL]; pinned.views.len()];
    for round in 0..=way.rounds {
        for _ in 0..seen.len() {
            let (stepped, seconds) = training::step(&mut trainer)?;
            if round > 0 {
                let of = |stage: &str| stepped.stages.iter().find(|s| s.0 == stage).map_or(0.0, |s| s.1);
                let drawn = stepped.report.timings.render + stepped.report.timings.render_backward;
                let whole = [1e3 * seconds, 1e3 * drawn.as_secs_f64()];
                let now = OF_STEPS.into_iter().map(of).chain(whole);
                seen[held.last()].iter_mut().zip(now).for_each(|(best, now)| *best = best.min(now));
            }
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
    let [step, drawn] = [ALL - 2, ALL - 1].map(mean);
    rows.push(Row { outside_share: Some(1.0 - drawn / step), ..row("step", step) });
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::super::scenes::made_up;
    use super::*;
    use splat4d::render::Simd;

    #[test]
    fn every_stage_has_a_time() {
        let pinned = made_up("small", 400, [40, 30]);
        let way = Way { threads: 1, simd: Simd::detect(), rounds: 1 };
        let pool = super::super::pool(way.threads).unwrap();
        let rows = match measure(&[pinned], way, true, &pool, &|_| {}) {
            Ok(rows) => rows,
            Err(e) => {
                assert!(std::env::var_os("REQUIRE_GPU").is_none(), "REQUIRE_GPU is set: {e}");
                return println!("skipped: {e}");
            }
        };
        let all = [&STAGES[..], &OF_STEPS, &["step"]].concat();
        let stages: Vec<&str> = rows.iter().map(|r| r.stage.as_str()).collect();
        assert_eq!(stages, all.repeat(Tuning::sweep().len()));
        for row in &rows {
            assert!(row.ms > 0.0 && row.ms.is_finite() && row.device.is_some() && row.simd == "gpu", "{row:?}");
            assert!(row.ceiling_share.is_none_or(|share| share > 0.0), "{row:?}");
            assert_eq!(row.tuning.is_some(), row.against.is_some(), "{row:?}");
        }
        let ms = |stage: &str| rows.iter().find(|r| r.stage == stage).expect("it is there").ms;
        assert!(ms("rasterize") < ms("forward, memory to memory") && ms("gather") < ms("backward, memory to memory"));
    }
}
