//! Captures that are still being filmed: the work behind `train --follow`. Waits for frames, trains each when it is
//! complete, and appends to a playback file that can be played meanwhile.

use crate::baking::{Outline, distinct, meta, poster};
use crate::deadline::Deadline;
use crate::device::chosen;
use crate::evaluating;
use crate::events::{Listener, Recorded};
use crate::files::{self, grouped, human_bytes};
use crate::growing::{Film, union};
use crate::playable::FILE;
use crate::run_folder::{self, Run, RunRequest, write_cameras};
use crate::sound;
use crate::source::Source;
use crate::training::{Finish, Trained, TrainingOptions};
use serde_json::json;
use splat4d::format::playback::{self, Draft, Growing, Meta, Sound, WriteConfig};
use splat4d::format::scene;
use splat4d::layers::Scene;
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::event::{Event, FollowedFrame};
use splat4d_train::output::OutputFolder;
use splat4d_train::path_text::in_command;
use splat4d_train::recipe::Recipe;
use splat4d_train::run::follow::{Arrival, Following, Segment};
use std::cell::Cell;
use std::io::Cursor;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Time between two checks whether a frame is there.
const POLL: Duration = Duration::from_millis(100);
/// Message when following is stopped.
const SAVING: &str = "stopping: finished frames are kept";
/// Frames after a missing one among which the next complete one is searched for.
const GAP: usize = 30;
/// Entries of the palette of a part, rounds that fit it and effort of deflate while frames wait.
const PALETTE: usize = 1024;
/// See [`PALETTE`].
const ROUNDS: usize = 2;
/// See [`PALETTE`].
const EFFORT: u32 = 4;
/// Table of the frames in the run.
pub const TABLE: &str = "frames.csv";
/// Its first line.
const HEADER: &str = "frame,at,seconds,changed,gaussians,psnr,bytes";

/// Follows a capture that is being filmed, until it ends, and does what follows training. The same request continues a
/// run that it began.
///
/// A frame is trained when all its files are there. The capture ends when `capture.json` states its number of frames,
/// when the file `capture.end` is in its folder, or when no frame was completed for `follow.timeout` seconds.
///
/// Errors: no `capture.json`, or no complete frame in time; images of another size, other cameras; the output folder
/// contains something else. Frames that are done are kept.
pub fn follow(
    capture: &Path,
    recipe: &Recipe,
    options: &TrainingOptions,
    stop: &AtomicBool,
    listener: &dyn Listener,
) -> Result<Trained> {
    check(options)?;
    let listener = &Recorded::new(listener);
    let asked = RunRequest::new(capture, recipe, None, false).followed();
    let run = match &options.output {
        Some(run) => run.clone(),
        None => {
            let name = asked.capture.file_name().map(|n| n.to_string_lossy().into_owned());
            run_folder::free_folder(&run_folder::usual_folder(&name.unwrap_or_default()))
        }
    };
    let (folder, _) = asked.begin(&run, options.force, options.command)?;
    let kept = Cell::new(Following::is(&run));
    let device = chosen(options.device, "training", listener);
    let followed = Following::begin(capture, recipe, &run, device).and_then(|following| {
        let (run, folder, kept, film, rows) = (&run, &folder, &kept, None, Vec::new());
        Live { following, capture, recipe, run, folder, options, stop, listener, film, rows, kept }.work()
    });
    match followed {
        Ok(interrupted) => {
            if !interrupted {
                finish(&run, options, stop, listener, listener)?;
                folder.finished();
            }
            Ok(Trained { run, iteration: None, interrupted })
        }
        Err(error) => {
            // Without a frame there is nothing to continue.
            if !kept.get() {
                folder.abandon();
            }
            Err(error)
        }
    }
}

/// Continues a run that [`follow`] began. Of the options only `device`, `measure` and `finish` count.
///
/// Errors: it is not such a run; those of [`follow`].
pub fn resume(run: &Path, options: &TrainingOptions, stop: &AtomicBool, listener: &dyn Listener) -> Result<Trained> {
    let (capture, recipe) = Following::request(run)?;
    let options = TrainingOptions { output: Some(run.to_owned()), force: false, ..options.clone() };
    follow(&capture, &recipe, &options, stop, listener)
}

/// Errors: options that a capture without a known length cannot have.
fn check(options: &TrainingOptions) -> Result<()> {
    options.measure.check()?;
    let refused = [
        (options.minutes.is_some(), "`minutes`", "Its time is that of the recording: set follow.frame_steps instead."),
        (options.chunk.is_some(), "`chunk`", "Leave it out: memory does not grow with the capture."),
        (options.own_loss.is_some(), "`loss`", "Leave it out, or train the capture when it is complete."),
    ];
    match refused.into_iter().find(|(given, ..)| *given) {
        Some((_, option, remedy)) => {
            Err(Error::input(format!("option {option} does not apply to a capture that is followed")).remedy(remedy))
        }
        None => Ok(()),
    }
}

/// A capture that is followed.
struct Live<'a> {
    following: Following,
    capture: &'a Path,
    recipe: &'a Recipe,
    run: &'a Path,
    folder: &'a OutputFolder,
    options: &'a TrainingOptions,
    stop: &'a AtomicBool,
    listener: &'a dyn Listener,
    film: Option<Film>,
    /// Lines of the table, and the frames of those whose bytes are not known yet.
    rows: Vec<(FollowedFrame, Option<u64>)>,
    /// Whether there is a frame, with which the run can be continued.
    kept: &'a Cell<bool>,
}

/// What came after waiting for a frame.
enum Next {
    Frame,
    End,
    Stopped,
}

impl Live<'_> {
    /// Follows to the end. Returns whether a stop was requested before.
    fn work(mut self) -> Result<bool> {
        let listener = self.listener;
        listener.stop_polled(SAVING);
        if self.following.next() > self.recipe.capture.first_frame {
            let done = self.following.next() - self.recipe.capture.first_frame;
            listener.result(&format!("{done} frames are done: the run continues with frame {}", self.following.next()));
            self.start()?;
        }
        let interrupted = loop {
            match self.wait()? {
                Next::Stopped => break true,
                Next::End => break false,
                Next::Frame => {}
            }
            let frame = self.following.fit(self.stop, &mut |event| listener.event(event))?;
            listener.clear();
            let Some(frame) = frame else { break true };
            self.folder.begun();
            self.kept.set(true);
            if self.film.is_none() {
                self.start()?;
            }
            self.report(frame);
            self.grow(false)?;
        };
        if self.film.is_some() {
            self.grow(true)?;
        }
        if interrupted {
            return Ok(true);
        }
        self.complete()
    }

    /// Waits for the next frame, and leaves out frames that never come.
    fn wait(&mut self) -> Result<Next> {
        let (listener, began) = (self.listener, Instant::now());
        loop {
            if self.stop.load(Ordering::Relaxed) {
                return Ok(Next::Stopped);
            }
            let next = self.following.next();
            let (what, ended, begun) = match self.following.look(next)? {
                Arrival::Complete => {
                    listener.clear();
                    return Ok(Next::Frame);
                }
                Arrival::Ended { left } => (left.clone().unwrap_or_default(), true, left.is_some()),
                Arrival::Incomplete { what, begun } => (what, false, begun),
            };
            let patience = self.recipe.follow.timeout;
            if !ended && began.elapsed().as_secs_f64() < patience {
                listener.phase(&format!("waiting for frame {next}"), 0, 0);
                std::thread::sleep(POLL);
                continue;
            }
            listener.clear();
            if let Some(later) = self.later(next)? {
                listener.warn(&format!("frames {next} to {} are left out: {what}", later - 1));
                (next..later).for_each(|_| self.following.skip());
                continue;
            }
            if next == self.recipe.capture.first_frame {
                let waited = if ended { String::new() } else { format!(" within {patience} s") };
                return Err(Error::input(format!("no frame of the capture is complete{waited}: {what}"))
                    .at(self.capture.display())
                    .remedy("Start the recording, or raise option `follow_timeout`."));
            }
            if begun {
                listener.warn(&format!("frame {next} is left out: {what}"));
            } else if !ended {
                listener.result(&format!("no new frame for {patience} s: the capture counts as finished"));
            }
            return Ok(Next::End);
        }
    }

    /// The first complete frame after one that is not; none: there is none.
    fn later(&mut self, next: usize) -> Result<Option<usize>> {
        for frame in next + 1..=next + GAP {
            // New files are complete at the second look.
            for _ in 0..2 {
                if self.following.look(frame)? == Arrival::Complete {
                    return Ok(Some(frame));
                }
                if matches!(self.following.look(frame)?, Arrival::Incomplete { begun: true, .. }) {
                    std::thread::sleep(POLL);
                }
            }
        }
        Ok(None)
    }

    /// Once there is a frame: the run's cameras, and its playback file.
    fn start(&mut self) -> Result<()> {
        let capture = self.following.beginning()?;
        write_cameras(self.run, &capture)?;
        self.following.write_info(self.options.clock.seconds(), false)?;
        let name = capture.name.clone();
        let on_event = crate::events::Event::Begun { title: &name, run: self.run, capture: Some(&capture) };
        self.listener.on_event(&on_event);
        let run = Run::open(self.run)?;
        let views = run.views()?;
        let first = self.recipe.capture.first_frame;
        let (_, Segment { shell, sh_degree, nodes }) = self.following.part(first, false).expect("a frame is done");
        let outline = Outline { clip: shell.clip, sh_degree, bounds: bounds(&nodes) };
        let stage = Source::own(shell.clone()).stage(&views);
        let about = Meta { title: name, ..meta(&shell, &outline, &stage, &distinct(&views)) };
        let film = Film::open(&self.run.join(FILE), about, self.following.next())?;
        self.film = Some(film);
        Ok(())
    }

    /// States a frame, and keeps its line of the table.
    fn report(&mut self, frame: FollowedFrame) {
        let psnr = frame.psnr.map_or_else(String::new, |db| format!(", {db:.2} dB on held-out views"));
        self.listener.result(&format!(
            "frame {}: {:.2} s, {} of {} Gaussians changed{psnr}",
            frame.frame,
            frame.seconds,
            grouped(frame.changed),
            grouped(frame.gaussians)
        ));
        self.rows.push((frame, None));
    }

    /// Appends the frames that are not in the playback file yet: as many as make a part, or all.
    fn grow(&mut self, all: bool) -> Result<()> {
        let first = self.recipe.capture.first_frame;
        let film = self.film.as_mut().expect("it is opened with the first frame");
        let mut grown = false;
        while let Some((frames, segment)) = self.following.part(film.frames(first), all) {
            let (from, to) = (frames.start, frames.end);
            let (bytes, meta) = part(&film.about, segment, &quick())?;
            film.append(&bytes, frames, meta)?;
            let each = (bytes.len() as u64).div_ceil((to - from) as u64);
            self.rows
                .iter_mut()
                .filter(|(f, b)| b.is_none() && (from..to).contains(&f.frame))
                .for_each(|r| r.1 = Some(each));
            self.listener.emit(&json!({
                "type": "grown", "file": film.path().to_string_lossy(), "frames": [from, to], "bytes": bytes.len(),
            }));
            self.listener.detail(&format!(
                "{}: frames {from} to {}, {} more",
                film.path().display(),
                to - 1,
                human_bytes(bytes.len() as u64)
            ));
            grown = true;
        }
        self.write_table()?;
        if grown {
            self.following.write_info(self.options.clock.seconds(), false)?;
            self.show()?;
        }
        Ok(())
    }

    /// Shows what there is to a page that watches the run.
    fn show(&self) -> Result<()> {
        if self.listener.snapshots().is_none() {
            return Ok(());
        }
        let film = self.film.as_ref().expect("it was appended to");
        let bytes = film.finished()?;
        let held_out = self.rows.last().and_then(|(frame, _)| frame.psnr);
        let iteration = self.following.next() - self.recipe.capture.first_frame;
        self.listener.event(&Event::Snapshot { iteration, bytes: bytes.into(), held_out });
        Ok(())
    }

    /// Lines of earlier commands stay.
    fn write_table(&self) -> Result<()> {
        let path = self.run.join(TABLE);
        let before = if path.is_file() { files::read_text(&path)? } else { String::new() };
        let number = |line: &str| line.split(',').next().and_then(|n| n.parse::<usize>().ok());
        let own = self.rows.first().map_or(usize::MAX, |(frame, _)| frame.frame);
        let mut text = format!("{HEADER}\n");
        for line in before.lines().filter(|line| number(line).is_some_and(|n| n < own)) {
            text += &format!("{line}\n");
        }
        for (frame, bytes) in &self.rows {
            let FollowedFrame { frame, at, seconds, gaussians, changed, psnr } = frame;
            let psnr = psnr.map_or_else(String::new, |db| format!("{db:.4}"));
            let bytes = bytes.map_or_else(String::new, |b| b.to_string());
            text += &format!("{frame},{at},{seconds:.3},{changed},{gaussians},{psnr},{bytes}\n");
        }
        files::write(&path, text.as_bytes())
    }

    /// The run's scene, and its playback file as a finished one. Returns whether a stop was requested before.
    fn complete(self) -> Result<bool> {
        let film = self.film.as_ref().expect("a frame is done");
        let run = Run::open(self.run)?;
        let (first, end) = (self.recipe.capture.first_frame, self.following.next());
        // There is time now for palettes that fit.
        let mut store = Cursor::new(Vec::new());
        let mut about = film.about.clone();
        let mut whole = Growing::begin(&mut store, Meta { clip: [about.clip[0]; 2], gaussians: 0, ..about.clone() })?;
        let written = self.following.again(&mut |frames, segment| {
            if self.stop.load(Ordering::Relaxed) {
                return Err(Error::new(ErrorKind::Interrupted, "stopped"));
            }
            self.listener.phase("the playback file, frame", frames.start - first, end - first);
            let (bytes, meta) = part(&about, segment, &WriteConfig::default())?;
            about.bounds = meta.bounds;
            whole.append(&bytes, meta, &mut |_| Ok(()))
        });
        self.listener.clear();
        match written {
            Err(e) if e.kind() == ErrorKind::Interrupted => return Ok(true),
            written => written?,
        }
        let meta = whole.index().meta.clone();
        let mut packed = |sections: (Option<&[u8]>, Option<&Sound>)| -> Result<Vec<u8>> {
            let mut bytes = Vec::new();
            playback::finish(&mut store, meta.clone(), sections, &mut bytes)?;
            Ok(bytes)
        };
        let scene = playback::read(&packed((None, None))?)?;
        let stage = Source::own(scene.clone()).stage(&run.views()?);
        let poster = poster(&scene, &stage, false);
        let sound = sound::of_run(&run).unwrap_or_else(|e| {
            self.listener.warn(&format!("the sound is left out: {e}"));
            None
        });
        let bytes = packed((poster.as_deref(), sound.as_ref()))?;
        let mut own = Vec::new();
        scene::write(&scene, &mut own)?;
        self.following.write_info(self.options.clock.seconds(), true)?;
        files::write(&self.run.join("scene.safetensors"), &own)?;
        // Later than the scene, of which it therefore is the file.
        files::write(&self.run.join(FILE), &bytes)?;
        self.listener.written(&self.run.join(FILE));
        self.listener.result(&format!("the playback file has {}", human_bytes(bytes.len() as u64)));
        Ok(false)
    }
}

/// How a part is written while frames wait.
fn quick() -> WriteConfig {
    WriteConfig { palette: PALETTE, kmeans_rounds: ROUNDS, deflate_level: EFFORT, ..WriteConfig::default() }
}

/// Frames as a playback file of their own, and the metadata of the whole with them.
fn part(about: &Meta, segment: Segment, config: &WriteConfig) -> Result<(Vec<u8>, Meta)> {
    let Segment { shell: Scene { clip, .. }, sh_degree, nodes } = segment;
    let bounds = union(about.bounds, bounds(&nodes));
    let meta = Meta { clip, sh_degree, ..about.clone() };
    let mut bytes = Vec::new();
    playback::write(&Draft { meta: meta.clone(), nodes, poster: None }, config, &mut bytes)?;
    Ok((bytes, Meta { bounds, ..meta }))
}

/// Least and greatest corner of the means.
fn bounds(nodes: &[playback::Node]) -> Option<[[f64; 3]; 2]> {
    let boxes = nodes.iter().flat_map(|n| &n.primitives).map(|p| Some([p.mean; 2]));
    boxes.fold(None, union)
}

/// Scores, film and report of a run whose capture has ended.
fn finish(
    run: &Path,
    options: &TrainingOptions,
    stop: &AtomicBool,
    listener: &dyn Listener,
    recorded: &Recorded<'_>,
) -> Result<()> {
    evaluating::amend(run, [("notes".into(), json!(recorded.warnings()))])?;
    let kept =
        format!("the scene is trained and saved: splat4d eval {} makes the scores and the report", in_command(run));
    listener.stop_not_polled(&kept);
    if options.finish != Finish::All {
        return Ok(());
    }
    evaluating::all(run, &options.measure, &Deadline::default(), stop, listener).map_err(|e| match e.kind() {
        ErrorKind::Interrupted => Error::new(ErrorKind::Interrupted, format!("stopped: {kept}")),
        _ => e,
    })
}

#[cfg(test)]
mod tests;
