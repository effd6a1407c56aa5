//! One chunk: a run on its frames, whose scene has the shared layer next to the one that learns.

use super::shared::{self, Shared};
use super::tie::{Neighbour, Tie};
use super::{Chunked, MADE_BY, Part, SCENE};
use crate::Result;
use crate::capture::Capture;
use crate::event::Event;
use crate::init::{FarShell, Seeds};
use crate::methods::{TrainContext, stages};
use crate::recipe::Recipe;
use crate::run::checkpoint;
use crate::run::flows;
use crate::run::open::{OpenCapture, check_flow, open_frames};
use crate::run::points;
use crate::run::refine::{Refine, refine};
use crate::run::session::{Outcome, TrainOptions};
use splat4d::layers::{Layer, Scene, freeze_rows};
use splat4d::math::Rng;
use splat4d::math::knn::mean_square_distance;
use splat4d::math::sh::dc_to_rgb;
use splat4d::render::{Antialias, RenderConfig};
use splat4d::scene::{GEOMETRY, Params, SH, Time};
use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// A point within this many Gaussians' spacings of the shared layer shows what that shows.
const COVERED: f64 = 2.0;
/// Share of the number of Gaussians that those of neighbours may take at the start.
const TAKEN_OVER: f64 = 0.5;

/// Trains a chunk, or continues with it.
pub(super) fn train(
    chunked: &Chunked,
    chunk: usize,
    options: &TrainOptions,
    stop: &AtomicBool,
    listen: &mut dyn FnMut(&Event),
) -> Result<Outcome> {
    let mut listen = listen;
    let pace = chunked.pace(Part::Chunk(chunk), options);
    let folder = chunked.folder(Part::Chunk(chunk));
    let recipe = of_frames(&chunked.recipe, chunked.plan.frames(chunk));
    let capture = Arc::new(open_frames(&chunked.source, &recipe, vec![chunked.plan.frames(chunk)], &chunked.lenses)?);
    let opened = OpenCapture::new(capture, &recipe)?.on(options.device);
    check_flow(&opened.capture, &recipe)?;
    let program = recipe.program()?;
    program.check(&opened.plan(&recipe))?;
    let opened = points::complete(opened, &recipe, &folder, &mut listen)?;
    let opened = flows::complete(opened, &recipe, &folder, &mut listen)?;
    let plan = opened.plan(&recipe);
    let shared = shared::read(&chunked.folder(Part::Shared))?;
    let neighbours = neighbours(chunked, chunk, &opened.capture)?;
    let scene = if checkpoint::list(&folder).is_empty() {
        listen(&Event::Phase { name: "initial points".into(), done: 0, total: 0 });
        first_scene(&opened, &recipe, &plan, &shared, &neighbours)?
    } else {
        // It is in the checkpoint.
        opened.scene(&recipe, &plan, program.as_ref(), &Seeds::default(), shared.background)?
    };
    let prints: Vec<&str> =
        std::iter::once(&shared.print).chain(neighbours.iter().map(|n| &n.print)).map(String::as_str).collect();
    let identity = format!("chunk {chunk} of {:?}, after {}", chunked.plan.cuts, prints.join(" "));
    let tied = Arc::new(neighbours);
    let exposure = shared.exposure(&opened.capture).map(Arc::new);
    let antialias = if recipe.appearance.antialias { Antialias::On } else { Antialias::Off };
    let config = RenderConfig { antialias, simd: opened.simd, ..RenderConfig::default() };
    let mut stages = stages(program.as_ref(), &plan);
    for stage in &mut stages {
        stage.freeze_exposure = exposure.is_some();
        if !tied.is_empty() && recipe.chunks.consistency > 0.0 {
            let tie = Tie::new(recipe.chunks.consistency, tied.clone(), exposure.clone(), config);
            stage.pictures.push(Box::new(tie));
        }
    }
    let exposure = shared.exposure(&opened.capture);
    let frames = opened.frames.clone();
    let budget = pace.map(|(pacing, [now, due])| pacing.budget(now, due));
    let job = Refine { made_by: MADE_BY.into(), scene, stages, frames, recipe, exposure, identity, budget };
    Ok(refine(job, &folder, options, stop, listen)?.outcome)
}

/// The recipe of a part of the capture.
pub(super) fn of_frames(recipe: &Recipe, frames: Range<usize>) -> Recipe {
    recipe.clone().with(|r| {
        (r.capture.first_frame, r.capture.max_frames) = (frames.start, frames.len());
        // The static background is a layer already, and what is far is a part of it.
        (r.split.reach, r.init.shell) = (0.0, FarShell::Off);
    })
}

/// First and last second of some frames.
pub(super) fn seconds(capture: &Capture, frames: &Range<usize>) -> [f64; 2] {
    let within = capture.train.iter().map(|&i| &capture.frames[i]).filter(|f| frames.contains(&f.index));
    within.fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], f| [a.min(f.time.0), b.max(f.time.0)])
}

/// The finished chunks that this one starts from.
fn neighbours(chunked: &Chunked, chunk: usize, capture: &Capture) -> Result<Vec<Neighbour>> {
    let one = |n: usize| {
        let window = seconds(capture, &chunked.plan.shared(n.min(chunk)));
        Neighbour::read(&chunked.folder(Part::Chunk(n)).join(SCENE), window)
    };
    chunked.neighbours(chunk).map(one).collect()
}

/// The scene that a chunk begins with: its own first Gaussians where the shared layer shows nothing, those of its
/// neighbours in the middle of what they share, and the shared layer, which does not learn.
fn first_scene(
    opened: &OpenCapture,
    recipe: &Recipe,
    plan: &TrainContext,
    shared: &Shared,
    neighbours: &[Neighbour],
) -> Result<Scene<f32>> {
    let program = recipe.program()?;
    let mut seeds = opened.seeds(recipe, plan)?;
    let still = shared.still.as_ref();
    if let Some(still) = still {
        let covered = Covered::new(still);
        let own: Vec<usize> =
            (0..seeds.len()).filter(|&i| seeds.times[i].is_some() || !covered.holds(seeds.points[i])).collect();
        if !own.is_empty() {
            let all = std::mem::take(&mut seeds);
            own.into_iter().for_each(|i| seeds.push(all.points[i], all.colors[i], all.times[i]));
        }
    }
    let room = plan.common.densify.max_cap.saturating_sub(still.map_or(0, |l| l.params.len())).max(1);
    // A Gaussian with an infinite lifespan starts at its position in the middle of the chunk, of which neighbours know
    // nothing.
    let mut taken: Vec<Params<f32>> = Vec::new();
    if !program.one_time(plan) {
        let share = (TAKEN_OVER * room as f64) as usize / neighbours.len().max(1);
        for n in neighbours {
            taken.push(alive(&n.scene, 0.5 * (n.window[0] + n.window[1]), share, plan.seed));
        }
    }
    let count: usize = taken.iter().map(Params::len).sum();
    seeds.truncate_evenly(room.saturating_sub(count).max(1), Rng::new(plan.seed, "chunk", 0));
    let first = seeds.len();
    for (params, n) in taken.iter().zip(neighbours) {
        let time = 0.5 * (n.window[0] + n.window[1]);
        for row in 0..params.len() {
            let color = params[SH].read::<3>(row, 0).map(dc_to_rgb);
            seeds.push(params[GEOMETRY].read::<3>(row, 0).map(f64::from), color, Some(time));
        }
    }
    let mut scene = opened.scene(recipe, plan, program.as_ref(), &seeds, shared.background)?;
    let own = &mut scene.layers[0].params;
    let mut row = first;
    for params in &taken {
        for from in 0..params.len() {
            own[GEOMETRY].write(row, 0, params[GEOMETRY].read::<11>(from, 0));
            (0..own[SH].width().min(params[SH].width())).for_each(|k| {
                let value = params[SH].get(from, k);
                own[SH].set(row, k, value);
            });
            row += 1;
        }
    }
    if let Some(still) = still {
        let mut still = still.clone();
        for key in still.params.keys().collect::<Vec<_>>() {
            still.params.info_mut(key).trainable = false;
        }
        scene.layers.push(still);
    }
    Ok(scene)
}

/// At most this many of the Gaussians of a chunk that are alive at a time, without the shared layer, at that time.
fn alive(scene: &Scene<f32>, time: f64, most: usize, seed: u64) -> Params<f32> {
    let layer = &scene.layers[0];
    let mut rows = Vec::new();
    if layer.active(Time(time), &mut rows) {
        rows = (0..layer.params.len() as u32).collect();
    }
    if rows.len() > most {
        let mut order = Rng::new(seed, "taken over", 0).permutation(rows.len());
        order.truncate(most);
        order.sort_unstable();
        rows = order.into_iter().map(|i| rows[i as usize]).collect();
    }
    freeze_rows(layer, &rows, Time(time))
}

/// The places that a still layer shows: cubes about its Gaussians.
struct Covered {
    side: f64,
    cells: BTreeSet<[i64; 3]>,
}

impl Covered {
    fn new(layer: &Layer<f32>) -> Self {
        let means: Vec<[f32; 3]> = layer.means().map(|m| m.map(|x| x as f32)).collect();
        let mut spacing = mean_square_distance(&means);
        spacing.sort_by(f32::total_cmp);
        let middle = spacing.get(spacing.len() / 2).map_or(0.0, |s| f64::from(*s).sqrt());
        let side = (COVERED * middle).max(f64::MIN_POSITIVE);
        let cells = means.iter().map(|m| Self::cell(side, m.map(f64::from))).collect();
        Self { side, cells }
    }

    fn cell(side: f64, place: [f64; 3]) -> [i64; 3] {
        place.map(|x| (x / side).floor() as i64)
    }

    fn holds(&self, place: [f64; 3]) -> bool {
        self.cells.contains(&Self::cell(self.side, place))
    }
}
