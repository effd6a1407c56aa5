//! Long takes in chunks: the work behind `train --chunk` and `join`.

use crate::deadline::Deadline;
use crate::events::Listener;
use crate::files::{grouped, human_bytes, human_seconds};
use crate::{evaluating, growing};
use serde_json::json;
use splat4d::Result;
use splat4d_train::event::Event;
use splat4d_train::run::chunks::{ChunkEstimate, Chunked, Joined, Part, Seams};
use splat4d_train::run::{self, Outcome, TrainOptions};
use std::path::Path;
use std::str::FromStr;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Of the time that is left, the share that baking may take, over all parts that are not in the file yet.
const BAKING: f64 = 0.25;
/// The same of measuring how chunks meet.
const SEAMS: f64 = 0.25;

/// The value of `--chunk`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChunkSelection {
    /// Whatever there is to do, until nothing is.
    All,
    /// One part.
    One(Part),
}

impl FromStr for ChunkSelection {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        match text {
            "all" => Ok(Self::All),
            "shared" => Ok(Self::One(Part::Shared)),
            _ => text.parse().map(|c| Self::One(Part::Chunk(c))).map_err(|_| "expected shared, a number or all".into()),
        }
    }
}

/// The plan in a line.
pub fn in_words(outlook: &ChunkEstimate) -> String {
    let ChunkEstimate { recipe, plan, seconds, memory, .. } = outlook;
    let longest = (0..plan.len()).map(|c| plan.frames(c).len()).max().unwrap_or(0);
    let mut words = format!(
        "{} chunks of at most {longest} frames and {} Gaussians, {} frames of overlap, {} steps each, after a shared \
         layer; about {} at a time",
        plan.len(),
        grouped(recipe.densify.max_cap),
        plan.overlap,
        recipe.run.iterations,
        human_bytes(*memory)
    );
    if let Some(seconds) = seconds {
        words += &format!(", {} on this machine", human_seconds(*seconds));
    }
    words
}

/// Does the requested work on a capture, and, if `grow`, appends what is finished to its playback file, within the
/// options' minutes. `None`: nothing was to do.
pub fn work(
    run: &Path,
    chunked: &Chunked,
    (wanted, grow): (ChunkSelection, bool),
    options: &TrainOptions,
    stop: &AtomicBool,
    console: &dyn Listener,
    listen: &mut dyn FnMut(&Event),
) -> Result<Option<Outcome>> {
    let deadline = Deadline::of(options.clock.clone(), options.minutes);
    // Its errors never fail a chunk, and are corrected at the join.
    let append = || {
        if grow && let Err(e) = growing::append(run, chunked, &baking(chunked, &deadline), stop, console) {
            console.warn(&format!("the playback file does not grow: {e}"));
        }
    };
    let outcome = match wanted {
        ChunkSelection::One(part) => chunked.work(part, options, stop, listen),
        ChunkSelection::All => {
            let mut finished = || {
                append();
                Ok(())
            };
            chunked.work_all(options, stop, &mut finished, listen)
        }
    }?;
    if !outcome.as_ref().is_some_and(|o| o.interrupted) && chunked.is_done(Part::Shared) {
        append();
    }
    Ok(outcome)
}

/// The end of baking what is finished: parts that are still to be trained have as much.
fn baking(chunked: &Chunked, deadline: &Deadline) -> Deadline {
    let open = chunked.parts().into_iter().filter(|p| !chunked.is_done(*p)).count();
    deadline.part(BAKING / (1 + open) as f64)
}

/// Puts the chunks of a run together, measures how they meet, and does what follows training.
pub fn join(
    run: &Path,
    chunked: &Chunked,
    no_eval: bool,
    measure: &evaluating::Measure,
    deadline: &Deadline,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<()> {
    let joined = chunked.join()?;
    let Joined { chunks, gaussians, seconds, peak_memory, .. } = joined;
    console.result(&format!(
        "{chunks} chunks, {} Gaussians, {:.1} minutes of training, {} at most in a part",
        grouped(gaussians),
        seconds / 60.0,
        human_bytes(peak_memory)
    ));
    let path = run.join("scene.safetensors");
    let seams = seams(chunked, &deadline.part(SEAMS), console)?;
    console.clear();
    if let Some(seams) = &seams {
        let whose = if seams.held_out { "held-out" } else { "training" };
        console.result(&format!(
            "flicker at chunk boundaries: {:.3}/255, within chunks {:.3}/255 ({whose} cameras, {} boundaries)",
            seams.across, seams.inside, seams.cuts
        ));
    }
    evaluating::amend(run, [("seams".into(), json!(seams)), ("chunk_peak_memory".into(), json!(peak_memory))])?;
    console.result(&format!("wrote {}", path.display()));
    let started = Instant::now();
    let bytes = growing::complete(run, chunked, &baking(chunked, deadline), stop, console)?;
    console.result(&format!("the playback file has {}", human_bytes(bytes)));
    evaluating::amend(
        run,
        [
            ("playback_bytes".into(), json!(bytes)),
            ("playback_seconds".into(), json!(started.elapsed().as_secs_f64())),
            ("join_peak_memory".into(), json!(run::peak_memory())),
        ],
    )?;
    if no_eval { Ok(()) } else { evaluating::all(run, measure, deadline, stop, console) }
}

/// How chunks meet, at as many cuts as the time allows: the next one takes about as long as the last one.
fn seams(chunked: &Chunked, deadline: &Deadline, console: &dyn Listener) -> Result<Option<Seams>> {
    let (mut began, mut ended) = (deadline.now(), None);
    let found = chunked.seams(
        &mut |done| {
            let now = deadline.now();
            let last = if done > 0 { now - began } else { 0.0 };
            began = now;
            let fits = deadline.left() > last;
            ended = (!fits).then_some(done);
            fits
        },
        &mut |event| console.event(event),
    )?;
    if let Some(done) = ended {
        console.result(&format!(
            "flicker at chunk boundaries is measured at {done} of them: option `minutes` leaves no time for more"
        ));
    }
    Ok(found)
}
