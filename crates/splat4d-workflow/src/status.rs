//! Progress and workers of a run; of a long capture in chunks, part by part.

use crate::files::{grouped, human_seconds};
use crate::run_folder::Run;
use serde::Serialize;
use splat4d::Result;
use splat4d::text::in_line;
use splat4d_train::output::Owner;
use splat4d_train::path_text::in_command;
use splat4d_train::run::chunks::{Chunked, Part};
#[cfg(any(test, feature = "storage"))]
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

/// Progress of a part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    Done,
    /// A worker is training it.
    Training,
    /// It begins where other parts end that are not done.
    Waiting,
    /// It was begun, and no worker is training it.
    Stopped,
    /// It can be begun.
    Open,
}

/// A part of a run: a chunk, the static background, or all of it.
#[derive(Clone, Debug, Serialize)]
pub struct PartStatus {
    /// Its name for `train --chunk`; `all`: the run is not in chunks.
    part: String,
    /// First frame and the one after the last.
    frames: Option<[usize; 2]>,
    state: State,
    /// Its owner: command, process, host, start.
    worker: Option<String>,
    /// Parts that it waits for.
    waits_for: Vec<String>,
    iteration: Option<usize>,
    iterations: Option<usize>,
    gaussians: Option<usize>,
    /// Of training.
    seconds: Option<f64>,
    seconds_left: Option<f64>,
    /// Bytes.
    peak_memory: Option<u64>,
}

/// Progress of a run.
#[derive(Clone, Debug, Serialize)]
pub struct Status {
    #[serde(rename = "type")]
    kind: &'static str,
    run: String,
    /// Whether all is trained and, of chunks, joined.
    pub finished: bool,
    pub chunked: bool,
    done: usize,
    total: usize,
    /// With as many workers as there are now, at least one.
    seconds_left: Option<f64>,
    parts: Vec<PartStatus>,
    /// Parts that were begun and that no worker has.
    failures: Vec<String>,
    /// The next command.
    next: Option<String>,
}

/// Reads how far a run is. Errors: it is not a run, or damaged.
pub fn of(path: &Path) -> Result<Status> {
    named(path, path, &|_| None)
}

/// The same of a copy of a run, whose own path is `name`. `workers`: of parts, by their names.
#[cfg(any(test, feature = "storage"))]
pub(crate) fn of_copy(path: &Path, name: &Path, workers: &BTreeMap<String, String>) -> Result<Status> {
    named(path, name, &|part| workers.get(part).cloned())
}

fn named(path: &Path, own: &Path, worker: &dyn Fn(&str) -> Option<String>) -> Result<Status> {
    let run = Run::open(path)?;
    let mut parts = if Chunked::is(path) { of_chunks(&Chunked::open(path)?) } else { vec![whole(path, &run)] };
    for part in parts.iter_mut().filter(|p| p.state != State::Done) {
        if let Some(worker) = worker(&part.part) {
            (part.state, part.worker) = (State::Training, Some(worker));
        }
    }
    // A step takes as long as in the parts of which that is known.
    let known =
        |f: fn(&PartStatus) -> Option<f64>| parts.iter().filter(|p| pace(p).is_some()).filter_map(f).sum::<f64>();
    let (seconds, steps) = (known(|p| p.seconds), known(|p| p.iteration.map(|n| n as f64)));
    let usual = parts.iter().filter(|p| p.frames.is_some()).find_map(|p| p.iterations);
    for part in &mut parts {
        let all = part.iterations.or(usual);
        let rate = pace(part).or_else(|| (steps > 0.0).then(|| seconds / steps));
        part.seconds_left = match (part.state, all, rate) {
            (State::Done, ..) => Some(0.0),
            (_, Some(all), Some(rate)) => Some(rate * all.saturating_sub(part.iteration.unwrap_or(0)) as f64),
            _ => None,
        };
    }
    let (done, total) = (parts.iter().filter(|p| p.state == State::Done).count(), parts.len());
    let workers = parts.iter().filter(|p| p.state == State::Training).count().max(1);
    let left: Option<f64> = parts.iter().map(|p| p.seconds_left).sum();
    let failures = parts.iter().filter(|p| p.state == State::Stopped).map(PartStatus::failure).collect();
    let (finished, chunked) = (Run::is_finished(path), Chunked::is(path));
    let name = in_command(own);
    let next = match () {
        () if finished => Some(format!("splat4d view {name}")),
        () if parts.iter().any(|p| p.state == State::Training) => None,
        () if chunked && done == total => Some(format!("splat4d join {name}")),
        // Workers on a storage repeat their command.
        () if own != path => None,
        () => Some(format!("splat4d train --resume {name}")),
    };
    Ok(Status {
        kind: "status",
        run: own.to_string_lossy().into_owned(),
        finished,
        chunked,
        done,
        total,
        seconds_left: left.map(|s| s / workers as f64),
        parts,
        failures,
        next,
    })
}

/// Seconds of a step.
fn pace(part: &PartStatus) -> Option<f64> {
    let (seconds, steps) = (part.seconds?, part.iteration.filter(|n| *n > 0)?);
    (seconds > 0.0).then(|| seconds / steps as f64)
}

fn of_chunks(chunked: &Chunked) -> Vec<PartStatus> {
    let chunks = (0..chunked.plan().len()).map(Part::Chunk);
    std::iter::once(Part::Shared).chain(chunks).map(|part| of_part(chunked, part)).collect()
}

fn of_part(chunked: &Chunked, part: Part) -> PartStatus {
    let folder = chunked.folder(part);
    let frames = match part {
        Part::Shared => None,
        Part::Chunk(c) => Some(chunked.plan().frames(c)).map(|f| [f.start, f.end]),
    };
    let waits_for: Vec<String> =
        chunked.needs(part).iter().filter(|p| !chunked.is_done(**p)).map(ToString::to_string).collect();
    let read = PartStatus { part: part.to_string(), frames, waits_for, ..begun(&folder) };
    let state = match read.state {
        _ if chunked.is_done(part) => State::Done,
        State::Open if !read.waits_for.is_empty() => State::Waiting,
        state => state,
    };
    PartStatus { state, ..read }
}

/// A run that is not in chunks.
fn whole(path: &Path, run: &Run) -> PartStatus {
    let read = begun(path);
    let planned = run.recipe().ok().map(|r| r.run.iterations);
    let state = if Run::is_finished(path) && read.state != State::Training { State::Done } else { read.state };
    PartStatus { part: "all".into(), state, iterations: read.iterations.or(planned), ..read }
}

/// Reads the status of a part from its folder.
fn begun(folder: &Path) -> PartStatus {
    let run = Run::is(folder).then(|| Run::open(folder).ok()).flatten();
    let number = |key: &str| run.as_ref()?.number(key).filter(|n| *n >= 0.0);
    let holder = Owner::holder(folder);
    let iteration = run.as_ref().and_then(Run::iteration);
    let state = match (&holder, iteration) {
        (Some(_), _) => State::Training,
        (None, Some(_)) => State::Stopped,
        (None, None) => State::Open,
    };
    PartStatus {
        part: String::new(),
        frames: None,
        state,
        worker: holder.map(|who| who.map_or_else(|| "unknown".to_owned(), |who| who.to_string())),
        waits_for: Vec::new(),
        iteration,
        iterations: number("iterations").map(|n| n as usize),
        gaussians: number("gaussians").map(|n| n as usize),
        seconds: number("seconds"),
        seconds_left: None,
        peak_memory: number("peak_memory").filter(|n| *n > 0.0).map(|n| n as u64),
    }
}

impl PartStatus {
    fn name(&self) -> String {
        if self.frames.is_some() { format!("chunk {}", self.part) } else { self.part.clone() }
    }

    fn failure(&self) -> String {
        format!(
            "{} stopped at step {}, and no worker is training it",
            self.name(),
            grouped(self.iteration.unwrap_or(0))
        )
    }

    fn text(&self) -> String {
        let of = self.iterations.map(|n| format!(" of {}", grouped(n))).unwrap_or_default();
        let step = format!("step {}{of}", grouped(self.iteration.unwrap_or(0)));
        let mut words = match self.state {
            State::Done => "done".to_owned(),
            State::Training => format!("{step}, {}", self.worker.as_deref().unwrap_or_default()),
            State::Waiting => format!("waits for {}", self.waits_for.join(", ")),
            State::Stopped => format!("stopped at {step}: no worker is training it"),
            State::Open => "not begun".to_owned(),
        };
        if let Some([from, to]) = self.frames {
            let _ = write!(words, "; frames {from} to {}", to.saturating_sub(1));
        }
        if let Some(n) = self.gaussians.filter(|n| *n > 0) {
            let _ = write!(words, "; {} Gaussians", grouped(n));
        }
        if let Some(seconds) = self.seconds.filter(|s| *s > 0.0) {
            let _ = write!(words, "; {}", human_seconds(seconds));
        }
        words
    }
}

impl Status {
    /// `3 of 5 parts done, about 4 min left`
    pub fn progress(&self) -> String {
        let mut words = match (self.chunked, self.finished) {
            (true, true) => format!("finished, {} parts joined", self.total),
            (false, true) => "finished".to_owned(),
            (true, false) => format!("unfinished, {} of {} parts done", self.done, self.total),
            (false, false) => "unfinished".to_owned(),
        };
        if let Some(left) = self.seconds_left.filter(|s| *s > 0.0 && !self.finished) {
            let _ = write!(words, ", about {} of training left", human_seconds(left));
        }
        words
    }

    /// Steps of all parts.
    pub fn steps(&self) -> usize {
        self.parts.iter().filter_map(|p| p.iteration).sum()
    }

    /// Seconds of training of all parts.
    pub fn seconds(&self) -> f64 {
        self.parts.iter().filter_map(|p| p.seconds).sum()
    }

    /// The most that a part needed, bytes.
    pub fn peak_memory(&self) -> Option<u64> {
        self.parts.iter().filter_map(|p| p.peak_memory).max()
    }

    /// The report, a line per part.
    pub fn text(&self) -> String {
        let mut text = String::new();
        let mut line = |name: &str, value: &str| {
            let _ = writeln!(text, "{name:<16} {}", in_line(value));
        };
        line("run", &self.run);
        line("progress", &self.progress());
        self.parts.iter().for_each(|part| line(&part.name(), &part.text()));
        if let Some(next) = &self.next {
            line("next", next);
        }
        text
    }
}
