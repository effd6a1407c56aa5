//! Estimated cost of a take in chunks, and the plan that stays within a memory limit and a time: shorter chunks of
//! fewer Gaussians, and the steps of a chunk. [`Pacing`] keeps the parts to that time while they are trained.

use super::shared::STEPS;
use super::{ChunkPlan, beginning, check, chosen};
use crate::capture::Capture;
use crate::event::Event;
use crate::recipe::Recipe;
use crate::run::budget::Budget;
use crate::run::clock::Stopwatch;
use crate::run::memory::memory_estimate;
use crate::run::minutes::Timing;
use crate::run::open::OpenCapture;
use crate::{Error, ErrorKind, Result};
use std::sync::Arc;

/// Share of the time that timing steps may take (as for captures that are learnt at once).
const PROBES: f64 = 0.06;
/// Seconds that timing steps takes where only the length is requested.
const PREDICTION: f64 = 6.0;
/// Fewest Gaussians of a chunk that a memory limit may leave: with fewer nothing can be recognised in the images.
const FEWEST: usize = 1000;
/// By how much the number of Gaussians falls from try to try.
const LESS: f64 = 0.8;
/// Least memory for decoded images, bytes; less makes runs slower, and no image worse.
const PICTURES: u64 = 64 << 20;
/// Shortest chunk, in overlaps: in a shorter one there is hardly a frame that is not shared.
const SHORTEST: usize = 3;
/// Share of the time that is kept for putting the capture together, and for what training takes next to its steps.
const JOIN: f64 = 0.1;

/// A take in chunks before it is begun.
#[derive(Clone, Debug)]
pub struct ChunkEstimate {
    /// The recipe, with the motion model and the steps that are chosen.
    pub recipe: Recipe,
    /// Even cuts.
    pub plan: ChunkPlan,
    /// Estimated seconds of all parts, one after the other, where steps were timed.
    pub seconds: Option<f64>,
    /// Estimated memory of a part at most, bytes.
    pub memory: u64,
    /// Keeps the parts to the minutes, where there are any.
    pub pacing: Option<Pacing>,
}

/// The time of training: each part gets its share of what is left when it begins, so that a slow part or a slow machine
/// costs later parts steps and not the user minutes.
#[derive(Clone, Copy, Debug)]
pub struct Pacing {
    /// Of a chunk.
    timing: Timing,
    /// Seconds of the clock at which training ends.
    end: f64,
}

impl Pacing {
    /// Seconds of the clock at which a part ends that begins now and is this share of the work that is left.
    pub(super) fn due(&self, now: f64, share: f64) -> f64 {
        now + share * (self.end - now).max(0.0)
    }

    /// The time of a chunk that begins now and ends by `due`.
    pub(super) fn budget(&self, now: f64, due: f64) -> Budget {
        Budget { minutes: due / 60.0, before: now, finish: 0.0, timing: self.timing }
    }
}

impl ChunkEstimate {
    /// Examines a take as `train` would before its first step, of which at least [`look_ahead`](super::look_ahead) is
    /// listed. Within `minutes`, if there are any, from the start of `clock` on, and within the recipe's memory limit.
    /// The caller's work after training takes as long as the last `finish` steps. `timed`: steps are timed even without
    /// `minutes`. `None`: the capture is learnt at once.
    ///
    /// Errors: what the recipe requests cannot be had in chunks, or not within these limits; images that cannot be
    /// read.
    pub fn new(
        capture: &Arc<Capture>,
        recipe: &Recipe,
        minutes: Option<f64>,
        finish: f64,
        timed: bool,
        clock: &Stopwatch,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Option<Self>> {
        let Some(plan) = ChunkPlan::even(capture, recipe)? else { return Ok(None) };
        let mut listen = listen;
        let mut recipe = recipe.clone();
        recipe = chosen(&Arc::new(beginning(capture, &plan)), recipe, &mut listen)?;
        recipe.check()?;
        check(&recipe)?;
        let (mut recipe, plan, memory) = within_memory(capture, recipe, plan)?;
        let (mut seconds, mut pacing) = (None, None);
        if minutes.is_some() || timed {
            let parts = (plan.len() + STEPS) as f64;
            let one = Arc::new(longest(capture, &plan));
            let opened = OpenCapture::new(one, &recipe)?;
            let probes = minutes.map_or(PREDICTION, |m| 60.0 * PROBES * m);
            let timing = Timing::measure(&opened, &recipe, clock, probes, &mut listen)?;
            if let Some(minutes) = minutes {
                let now = clock.seconds();
                let [_, last] = timing.of(&opened, &recipe)?;
                let left = (1.0 - JOIN) * (60.0 * minutes - now) - finish * last;
                recipe = timing.fit(&opened, &recipe, left / parts - timing.scene, 0.0)?;
                pacing = Some(Pacing { timing, end: now + left });
            }
            let [steps, _] = timing.of(&opened, &recipe)?;
            seconds = Some(parts * (steps + timing.scene));
        }
        Ok(Some(Self { recipe, plan, seconds, memory, pacing }))
    }
}

/// A capture with as many images to train on as the longest chunk has; those of the beginning, which are listed in
/// any case.
fn longest(capture: &Capture, plan: &ChunkPlan) -> Capture {
    let longest = (0..plan.len()).map(|c| plan.frames(c).len()).max().unwrap_or(0);
    let frames = plan.take[0]..plan.take[0] + longest;
    let train = capture.train.iter().copied().filter(|&i| frames.contains(&capture.frames[i].index)).collect();
    Capture { train, ..capture.clone() }
}

/// The recipe and plan within the recipe's memory limit: less memory for images first, then fewer Gaussians in
/// chunks that are
/// shorter by as much, so that a frame keeps as many.
fn within_memory(capture: &Capture, mut recipe: Recipe, mut plan: ChunkPlan) -> Result<(Recipe, ChunkPlan, u64)> {
    let estimate = |recipe: &Recipe, plan: &ChunkPlan| memory_estimate(&longest(capture, plan), recipe);
    let (limit, cap) = (recipe.run.memory_limit, recipe.densify.max_cap as f64);
    let length = (plan.take[1] - plan.take[0]) as f64 / plan.len() as f64;
    let mut share = 1.0;
    loop {
        let memory = estimate(&recipe, &plan);
        if limit == 0 || memory <= limit {
            return Ok((recipe, plan, memory));
        }
        if recipe.run.image_memory > PICTURES {
            recipe.run.image_memory = (recipe.run.image_memory / 2).max(PICTURES);
            continue;
        }
        share *= LESS;
        if share * cap < FEWEST as f64 {
            return Err(Error::new(
                ErrorKind::Memory,
                format!(
                    "a chunk of {FEWEST} Gaussians would take about {} MiB, and memory_limit is {} MiB",
                    memory >> 20,
                    limit >> 20
                ),
            )
            .remedy("Allow more memory, or use --downscale 2"));
        }
        recipe.densify.max_cap = (share * cap) as usize;
        let shortest = (SHORTEST * recipe.chunks.overlap).min(length as usize);
        recipe.chunks.frames = ((share * length) as usize).max(shortest);
        plan = ChunkPlan::even(capture, &recipe)?.expect("shorter chunks are chunks");
    }
}
