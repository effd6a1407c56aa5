//! Long captures in chunks: the static part is trained once, the dynamic part chunk by chunk, each in its own run
//! folder. Memory does not grow with the capture, and any number of workers on one folder can share the work.
//!
//! Order: the shared layer; then even chunks, independent of each other; then odd ones, which start from both
//! neighbours and are tied to them in the overlap. A chunk is a function of the capture, the recipe and the files
//! before it, so the schedule of workers changes nothing. Source: overlapping chunks in the practice of 4DGaussians and
//! STG (50 to 60 frames); the cross-fade and the order are ours.

mod budget;
mod join;
mod plan;
mod shared;
#[cfg(test)]
mod tests;
mod tie;
mod train;

pub use budget::{ChunkEstimate, Pacing};
pub use join::{Joined, Seams};
pub use plan::ChunkPlan;

use super::checkpoint::write_atomically;
use super::identity;
use super::info::{ELSEWHERE, elsewhere, read_info, read_text};
use super::open::{OpenCapture, learnable, open_frames};
use super::session::{Outcome, TrainOptions};
use crate::capture::{Capture, Lenses};
use crate::event::Event;
use crate::output::Owner;
use crate::path_text::{of_text, to_text};
use crate::recipe::Recipe;
use crate::{Error, ErrorKind, Result};
use serde_json::json;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Frames of a chunk where the recipe leaves it open (STG: 50).
const FRAMES: usize = 60;
/// A capture of this many frames is learnt at once where the recipe leaves it open: the cap's Gaussians are enough for
/// it.
const WHOLE: usize = 300;
/// Seconds between two checks whether other workers are done.
const POLL: Duration = Duration::from_secs(1);
/// Folder of the chunks in a run.
const FOLDER: &str = "chunks";
/// Folder in it with the lock of the playback file's writer.
const FILM: &str = "film";
/// Time between two checks whether it may be written.
const TURNS: Duration = Duration::from_millis(200);
/// File of the plan in it.
const PLAN: &str = "plan.json";
/// File of a finished run.
const SCENE: &str = "scene.safetensors";
/// Version of the code that made runs of chunks.
pub(super) const MADE_BY: &str = "train --chunk";

/// A part of the work on a capture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// The static background, and the cameras' exposures.
    Shared,
    /// A chunk.
    Chunk(usize),
}

impl std::fmt::Display for Part {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Part::Shared => f.write_str("shared"),
            Part::Chunk(c) => write!(f, "{c}"),
        }
    }
}

/// The right to write what workers share; given back when it is dropped.
pub struct Turn(#[expect(dead_code, reason = "it is held, not read")] Owner);

/// A run of a long capture.
pub struct Chunked {
    run: PathBuf,
    source: PathBuf,
    recipe: Recipe,
    plan: ChunkPlan,
    /// Recorded areas of the capture's lenses, from the part that was opened first: it is the same for all.
    lenses: Lenses,
    /// Limits this worker to its minutes.
    pacing: Option<Pacing>,
}

impl Chunked {
    /// Begins the run of a capture in the folder `run`, or finds it begun, by whichever worker. `None`: the capture is
    /// learnt at once.
    ///
    /// Errors: what the recipe requests cannot be had in chunks; the folder holds the run of another recipe, capture or
    /// version.
    pub fn begin(
        capture: &Arc<Capture>,
        recipe: &Recipe,
        run: &Path,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Option<Self>> {
        let Some(even) = ChunkPlan::even(capture, recipe)? else { return Ok(None) };
        let mut listen = listen;
        // What is examined before the first step is the capture's beginning, however much of it the caller has listed.
        let first = Arc::new(beginning(capture, &even));
        let recipe = chosen(&first, recipe.clone(), &mut listen)?;
        recipe.check()?;
        check(&recipe)?;
        let recipe = recipe.resolve();
        let stated = ChunkPlan {
            version: env!("CARGO_PKG_VERSION").into(),
            recipe: identity::recipe_print(&recipe, ""),
            capture: format!("{}-{}-{}", identity::fingerprint(&first), even.take[0], even.take[1]),
            ..even
        };
        if Self::is(run) {
            let begun = Self::open(run)?;
            begun.plan.check_same(&stated).map_err(|e| e.at(run.display()))?;
            return Ok(Some(Self { lenses: capture.lenses.clone(), ..begun }));
        }
        let source = std::fs::canonicalize(&capture.root).unwrap_or_else(|_| capture.root.clone());
        let plan = stated.at_rest(&|frames| open_frames(&source, &recipe, vec![frames], &capture.lenses), listen)?;
        write_atomically(&run.join("recipe.toml"), recipe.to_toml().as_bytes())?;
        let lenses = capture.lenses.clone();
        let begun = Self { run: run.to_owned(), source, recipe, plan, lenses, pacing: None };
        begun.write_info(&capture.name, elsewhere(capture), None)?;
        // Last: a process that finds it finds the others.
        let text = serde_json::to_string_pretty(&begun.plan).expect("a plan is plain data");
        write_atomically(&run.join(FOLDER).join(PLAN), text.as_bytes())?;
        Ok(Some(begun))
    }

    /// Whether a folder is the run of a long capture.
    pub fn is(run: &Path) -> bool {
        run.join(FOLDER).join(PLAN).is_file()
    }

    /// A run that was begun. Errors: it is none, or damaged.
    pub fn open(run: &Path) -> Result<Self> {
        let path = run.join(FOLDER).join(PLAN);
        if run.is_dir() && !path.exists() {
            return Err(Error::input(format!("contains no chunks: there is no {FOLDER}/{PLAN}"))
                .at(run.display())
                .remedy("Only runs of long captures have chunks: `splat4d status` reports what a run has"));
        }
        let plan: ChunkPlan = serde_json::from_str(&read_text(&path)?)
            .map_err(|e| Error::input(format!("invalid plan of chunks: {e}")).at(path.display()))?;
        plan.check().map_err(|e| e.at(path.display()))?;
        let file = run.join("recipe.toml");
        let recipe = Recipe::from_toml(&read_text(&file)?).map_err(|e| e.at(file.display()))?;
        let print = identity::recipe_print(&recipe, "");
        if print != plan.recipe {
            return Err(Error::input("the recipe differs from the one that its chunks were planned for")
                .at(file.display())
                .remedy("Put it back as the run wrote it, or train into another folder"));
        }
        let info = read_info(run)?;
        let source = info["capture"].as_str().map(of_text).ok_or_else(|| {
            Error::input("it does not name its capture").at(run.join("run.json").display()).remedy("Train again")
        })?;
        Ok(Self { run: run.to_owned(), source, recipe, plan, lenses: Lenses::default(), pacing: None })
    }

    /// The same, with parts that are re-planned during training, so that training ends on time.
    pub fn paced(self, pacing: Option<Pacing>) -> Self {
        Self { pacing, ..self }
    }

    /// The recipe that its chunks were planned for.
    pub fn recipe(&self) -> &Recipe {
        &self.recipe
    }

    /// Its boundaries.
    pub fn plan(&self) -> &ChunkPlan {
        &self.plan
    }

    /// All parts, in an order in which one worker can do them: an odd chunk as soon as both its neighbours are there,
    /// so that the finished part has few gaps.
    pub fn parts(&self) -> Vec<Part> {
        let count = self.plan.len();
        let chunks = (0..count).map(|k| match k {
            0 => 0,
            // 2, 1, 4, 3 ...; of an even number the last one has no neighbour behind it.
            k if k % 2 == 1 && k + 1 < count => k + 1,
            k if k % 2 == 1 => k,
            k => k - 1,
        });
        std::iter::once(Part::Shared).chain(chunks.map(Part::Chunk)).collect()
    }

    /// The folder of a part.
    pub fn folder(&self, part: Part) -> PathBuf {
        let name = match part {
            Part::Shared => "shared".to_owned(),
            Part::Chunk(c) => format!("{c:02}"),
        };
        self.run.join(FOLDER).join(name)
    }

    /// Whether a part is finished.
    pub fn is_done(&self, part: Part) -> bool {
        let file = if part == Part::Shared { shared::FILE } else { SCENE };
        self.folder(part).join(file).is_file()
    }

    /// The parts whose results this one begins with: the shared layer, and for an odd chunk its neighbours.
    pub fn needs(&self, part: Part) -> Vec<Part> {
        let Part::Chunk(c) = part else { return Vec::new() };
        std::iter::once(Part::Shared).chain(self.neighbours(c).map(Part::Chunk)).collect()
    }

    /// The parts that must be there before this one begins, of those that are not.
    fn missing(&self, part: Part) -> Vec<Part> {
        self.needs(part).into_iter().filter(|p| !self.is_done(*p)).collect()
    }

    /// The chunks that chunk c starts from.
    fn neighbours(&self, c: usize) -> impl Iterator<Item = usize> {
        let count = self.plan.len();
        [c.wrapping_sub(1), c + 1].into_iter().filter(move |n| c % 2 == 1 && *n < count)
    }

    /// Trains one part, unless it is done. Errors: parts before it are missing, another worker has it, and those of
    /// training.
    pub fn work(
        &self,
        part: Part,
        options: &TrainOptions,
        stop: &AtomicBool,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Option<Outcome>> {
        if let Part::Chunk(c) = part
            && c >= self.plan.len()
        {
            return Err(Error::input(format!("there is no chunk {c}: the take has {}", self.plan.len()))
                .at(self.run.display())
                .remedy("Chunks are counted from 0"));
        }
        if self.is_done(part) {
            return Ok(None);
        }
        let missing = self.missing(part);
        if !missing.is_empty() {
            let names: Vec<String> = missing.iter().map(|p| format!("--chunk {p}")).collect();
            return Err(Error::input(format!("chunk {part} begins where others end that are not finished"))
                .at(self.run.display())
                .remedy(format!("Do these first: {}", names.join(", "))));
        }
        let _owner = Owner::of(&self.folder(part), MADE_BY)?;
        self.claimed(part, options, stop, listen)
    }

    /// Waits for the right to write the playback file, which workers append to one at a time.
    ///
    /// Errors: the folder cannot be written; `stop` is set.
    pub fn turn(&self, stop: &AtomicBool) -> Result<Turn> {
        loop {
            if let Ok(owner) = Owner::take(&self.run.join(FOLDER).join(FILM), MADE_BY)? {
                return Ok(Turn(owner));
            }
            if stop.load(Ordering::Relaxed) {
                return Err(Error::new(
                    ErrorKind::Interrupted,
                    "stopped while another worker writes the playback file",
                )
                .remedy("Run the same command again to continue"));
            }
            std::thread::sleep(TURNS);
        }
    }

    /// Identity of a finished part: its name and a fingerprint of its file. Errors: the file cannot be read.
    pub fn print(&self, part: Part) -> Result<String> {
        let file = if part == Part::Shared { shared::FILE } else { SCENE };
        let bytes = shared::read_file(&self.folder(part).join(file))?;
        Ok(format!("{part} {}", identity::file_print(&bytes)))
    }

    /// Works on all parts until they are done, next to any number of other workers. `finished` is called with every
    /// part that this worker has finished.
    ///
    /// Errors: those of training, and of `finished`.
    pub fn work_all(
        &self,
        options: &TrainOptions,
        stop: &AtomicBool,
        finished: &mut dyn FnMut() -> Result<()>,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Option<Outcome>> {
        let mut listen = listen;
        loop {
            let open: Vec<Part> = self.parts().into_iter().filter(|p| !self.is_done(*p)).collect();
            if open.is_empty() {
                return Ok(None);
            }
            let mut busy = false;
            for part in open.into_iter().filter(|p| self.missing(*p).is_empty()) {
                let Ok(owner) = Owner::take(&self.folder(part), MADE_BY)? else { continue };
                busy = true;
                let outcome = self.claimed(part, options, stop, &mut listen)?;
                if outcome.as_ref().is_some_and(|o| o.interrupted) {
                    return Ok(outcome);
                }
                drop(owner);
                finished()?;
                // What was waited for may be there now.
                break;
            }
            if stop.load(Ordering::Relaxed) {
                return Err(Error::new(ErrorKind::Interrupted, "stopped while other workers train")
                    .remedy("Run the same command again to continue"));
            }
            if !busy {
                listen(&Event::Phase { name: "waiting for other workers".into(), done: 0, total: 0 });
                std::thread::sleep(POLL);
            }
        }
    }

    /// Does a part that this worker has claimed.
    fn claimed(
        &self,
        part: Part,
        options: &TrainOptions,
        stop: &AtomicBool,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Option<Outcome>> {
        // The one who had it may just have finished it.
        if self.is_done(part) {
            return Ok(None);
        }
        let mut listen = listen;
        let (done, total) = (self.parts().iter().filter(|p| self.is_done(**p)).count(), self.plan.len() + 1);
        listen(&Event::Phase { name: format!("chunk {part}"), done, total });
        let outcome = match part {
            Part::Shared => shared::train(self, options, stop, &mut listen)?,
            Part::Chunk(c) => Some(train::train(self, c, options, stop, &mut listen)?),
        };
        Ok(outcome)
    }

    /// The pacing of a part that begins now: its start and its end, seconds of the clock.
    fn pace(&self, part: Part, options: &TrainOptions) -> Option<(Pacing, [f64; 2])> {
        let work = |part: &Part| if *part == Part::Shared { shared::STEPS } else { 1 };
        let left: usize = self.parts().iter().filter(|p| !self.is_done(**p)).map(work).sum();
        let now = options.clock.seconds();
        let share = work(&part) as f64 / left.max(1) as f64;
        self.pacing.map(|pacing| (pacing, [now, pacing.due(now, share)]))
    }

    /// The images of some frames of the capture, as the recipe opens them.
    fn capture(&self, frames: Vec<Range<usize>>) -> Result<Capture> {
        open_frames(&self.source, &self.recipe, frames, &self.lenses)
            .map_err(|e| e.remedy("The run needs its capture where it was when it was begun"))
    }

    /// run.json of the whole; `done`: steps, Gaussians and seconds of all chunks.
    fn write_info(&self, name: &str, elsewhere: Vec<String>, done: Option<[f64; 3]>) -> Result<()> {
        let mut info = json!({
            "version": env!("CARGO_PKG_VERSION"),
            "made_by": MADE_BY,
            "capture": to_text(&self.source),
            "capture_name": name,
            ELSEWHERE: elsewhere,
            "motion": self.recipe.run.motion.as_str(),
            "seed": self.recipe.run.seed,
            "chunks": self.plan.len(),
            "finished": done.is_some(),
            "peak_memory": super::peak_memory(),
        });
        if let Some([iterations, gaussians, seconds]) = done {
            info["iteration"] = json!(iterations as usize);
            info["gaussians"] = json!(gaussians as usize);
            info["seconds"] = json!(seconds);
        }
        let text = serde_json::to_string_pretty(&info).expect("plain data is JSON");
        write_atomically(&self.run.join("run.json"), text.as_bytes())
    }
}

/// The first part of a capture, whose length does not depend on how much of the capture is listed.
fn beginning(capture: &Capture, plan: &ChunkPlan) -> Capture {
    let end = plan.take[0] + WHOLE;
    let train = capture.train.iter().copied().filter(|&i| capture.frames[i].index < end).collect();
    Capture { train, ..capture.clone() }
}

/// The frames of a capture to examine first: they show whether it is a long capture.
pub fn look_ahead(recipe: &Recipe) -> Vec<Range<usize>> {
    let first = recipe.capture.first_frame;
    let look = first..first.saturating_add(recipe.chunks.frames.max(WHOLE)).saturating_add(1);
    vec![look]
}

/// The recipe with a motion model and a number of Gaussians that suit the beginning of a capture, where it states none.
fn chosen(first: &Arc<Capture>, recipe: Recipe, listen: &mut dyn FnMut(&Event)) -> Result<Recipe> {
    if !recipe.run.motion.is_auto() && recipe.densify.max_cap > 0 {
        return Ok(recipe);
    }
    let (opened, mut listen) = (OpenCapture::new(first.clone(), &recipe)?, listen);
    let recipe = if recipe.run.motion.is_auto() { opened.choose(recipe, &mut listen)? } else { recipe };
    opened.counted(recipe, &mut listen)
}

/// Errors: what a recipe requests that chunks cannot have together.
fn check(recipe: &Recipe) -> Result<()> {
    let learnt = learnable(recipe);
    let (what, remedy) = if recipe.spacetime.has_features() {
        ("a network that makes colours (features = full)", "Use --set features=none")
    } else if learnt.any() {
        ("cameras that are refined", "Refine them on a part of the capture first (--set max_frames=60)")
    } else if recipe.capture.observe < 1.0 {
        ("an unobserved future (--observe)", "Leave --observe away")
    } else {
        return Ok(());
    };
    Err(Error::new(ErrorKind::Unsupported, format!("chunks cannot share {what}"))
        .remedy(format!("{remedy}, or train without chunks: --chunk-frames above the number of frames")))
}
