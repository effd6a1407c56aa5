//! Long takes in chunks: the work behind `train --chunk` and `join`.

use crate::console::Console;
use crate::files::human_bytes;
use crate::finish;
use crate::source::read_scene;
use serde_json::json;
use splat4d::{Error, Result};
use splat4d_train::capture::Capture;
use splat4d_train::event::Event;
use splat4d_train::recipe::Recipe;
use splat4d_train::run::chunks::{ChunkPlan, Chunked, Joined, Part};
use splat4d_train::run::{self, Outcome, TrainOptions};
use std::path::Path;
use std::str::FromStr;
use std::sync::atomic::AtomicBool;

/// The value of `--chunk`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Wanted {
    /// Whatever there is to do, until nothing is.
    All,
    /// One part.
    One(Part),
}

impl FromStr for Wanted {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        match text {
            "all" => Ok(Self::All),
            "shared" => Ok(Self::One(Part::Shared)),
            _ => text.parse().map(|c| Self::One(Part::Chunk(c))).map_err(|_| "give shared, a number or all".into()),
        }
    }
}

/// The plan in a line.
pub(crate) fn in_words(plan: &ChunkPlan, recipe: &Recipe) -> String {
    let longest = (0..plan.len()).map(|c| plan.frames(c).len()).max().unwrap_or(0);
    format!(
        "{} chunks of at most {longest} frames, {} of them shared by neighbours, {} steps each, and a shared layer before them",
        plan.len(),
        plan.overlap,
        recipe.run.iterations
    )
}

/// Estimated peak memory of a take that is learnt in chunks, bytes: that of its longest chunk.
pub(crate) fn memory_estimate(capture: &Capture, plan: &ChunkPlan, recipe: &Recipe) -> u64 {
    let longest = (0..plan.len()).map(|c| plan.frames(c)).max_by_key(ExactSizeIterator::len);
    let frames = longest.expect("a plan has a chunk");
    let train = capture.train.iter().copied().filter(|&i| frames.contains(&capture.frames[i].index)).collect();
    run::memory_estimate(&Capture { train, ..capture.clone() }, recipe)
}

/// Does what is wanted of a take. `None`: nothing was to do.
pub(crate) fn work(
    chunked: &Chunked,
    wanted: Wanted,
    options: &TrainOptions,
    stop: &AtomicBool,
    listen: &mut dyn FnMut(&Event),
) -> Result<Option<Outcome>> {
    match wanted {
        Wanted::One(part) => chunked.work(part, options, stop, listen),
        Wanted::All => chunked.work_all(options, stop, listen),
    }
}

/// Puts the chunks of a run together, measures how they meet, and does what follows training.
pub(crate) fn join(
    run: &Path,
    chunked: &Chunked,
    no_eval: bool,
    measure: &finish::Measure,
    console: &Console,
) -> anyhow::Result<()> {
    let joined = chunked.join()?;
    let Joined { chunks, gaussians, seconds, peak_memory, .. } = joined;
    console.say(&format!(
        "{chunks} chunks, {gaussians} Gaussians, {:.1} minutes of training, {} at most in a part",
        seconds / 60.0,
        human_bytes(peak_memory)
    ));
    let path = run.join("scene.safetensors");
    let seams = chunked.seams(&read_scene(&path)?, &mut |event| console.event(event))?;
    console.clear();
    if let Some(seams) = &seams {
        let whose = if seams.held_out { "held-out" } else { "training" };
        console.say(&format!(
            "flicker where chunks meet: {:.3}/255, in their midst {:.3}/255 ({whose} cameras, {} cuts)",
            seams.across, seams.inside, seams.cuts
        ));
    }
    finish::amend(run, [("seams".into(), json!(seams)), ("chunk_peak_memory".into(), json!(peak_memory))])?;
    console.say(&format!("wrote {}", path.display()));
    if no_eval { Ok(finish::playback(run, console)?) } else { finish::all(run, measure, console) }
}

/// Errors: options that chunks do not know.
pub(crate) fn check(minutes: Option<f64>) -> Result<()> {
    match minutes {
        None => Ok(()),
        Some(_) => Err(Error::input("--minutes is not kept in chunks: steps are those of a chunk")
            .remedy("Use --set iterations=N, or --chunk-frames above the take's length")),
    }
}
