//! The work behind `train`: a capture becomes a run: trained, baked, measured, filmed and reported. Long captures are
//! trained in chunks, and runs are continued.

use crate::chunked::{self, ChunkSelection};
use crate::deadline::Deadline;
use crate::device::chosen;
use crate::evaluating::{self, Measure};
use crate::events::{Listener, Recorded};
use crate::files::{self, human_bytes};
use crate::labelling;
use crate::run_folder::{self, Run, RunRequest, write_cameras};
use serde_json::json;
use splat4d::device::Device;
use splat4d::{Error, ErrorKind, Result};
#[cfg(feature = "import")]
use splat4d_import::{generated, shipped};
use splat4d_train::capture::{Capture, Lenses, Severity, Timing};
use splat4d_train::event::Event;
#[cfg(feature = "import")]
use splat4d_train::event::Progress;
use splat4d_train::output::{FolderContent, OutputFolder, Owner};
use splat4d_train::path_text::in_command;
use splat4d_train::recipe::Recipe;
use splat4d_train::run::chunks::{ChunkEstimate, Chunked, look_ahead};
use splat4d_train::run::{self, Outcome, OwnLoss, Stopwatch, TrainOptions, memory_estimate, open_capture, open_frames};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Time between two checks whether the worker that begins a long capture has begun it.
const WAIT: Duration = Duration::from_millis(200);
/// Name of this work in an owner's record.
const TRAIN: &str = "train";
/// The same of joining chunks.
const JOIN: &str = "join";
/// Message when training is stopped.
const SAVING: &str = "stopping: a checkpoint is being saved";

/// Work after training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Finish {
    /// Nothing: the run has its scene.
    Scene,
    /// Labels and features, if the capture has them, and the playback file.
    Playback,
    /// These, and scores of held-out views, an orbit film and the report.
    #[default]
    All,
}

/// Options of [`train`] and [`resume`].
#[derive(Clone, Debug)]
pub struct TrainingOptions {
    /// Output folder; none: `runs/NAME`, or `runs/NAME-2` ... if it exists.
    pub output: Option<PathBuf>,
    /// Replace the run in the output folder once the new run has begun.
    pub force: bool,
    /// Finish within this many minutes of the clock, whatever follows training included.
    pub minutes: Option<f64>,
    /// Report the expected time first.
    pub predict: bool,
    /// Train one part of a long capture and end; none: all parts, which are joined.
    pub chunk: Option<ChunkSelection>,
    /// Append finished parts of a long capture to the run's playback file.
    pub grow: bool,
    /// Device to train on.
    pub device: Device,
    /// Options of the evaluation.
    pub measure: Measure,
    /// Work after training. With [`Finish::Scene`] a long capture is trained as a whole unless the recipe states
    /// chunks.
    pub finish: Finish,
    /// The clock of `minutes`; its zero is when these options were made.
    pub clock: Stopwatch,
    /// A loss of the caller in addition to the recipe's.
    pub own_loss: Option<OwnLoss>,
    /// The owner named by the folder's lock, for other programs.
    pub command: &'static str,
}

impl Default for TrainingOptions {
    fn default() -> Self {
        Self {
            output: None,
            force: false,
            minutes: None,
            predict: false,
            chunk: None,
            grow: true,
            device: Device::Auto,
            measure: Measure::default(),
            finish: Finish::default(),
            clock: Stopwatch::start(),
            own_loss: None,
            command: TRAIN,
        }
    }
}

/// A run that was trained.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Trained {
    /// Its folder.
    pub run: PathBuf,
    /// Steps taken; none: those of a run in chunks, whose chunks have their own.
    pub iteration: Option<usize>,
    /// Whether it was stopped and saved; [`resume`] continues it.
    pub interrupted: bool,
}

/// Trains a scene of a capture by a recipe, and does what follows training. Frames of captures that are shipped as
/// videos are extracted first. The same request continues a run that it began.
///
/// Errors: the capture cannot be read; the output folder contains something else, or belongs to another process;
/// training diverged.
///
/// ```no_run
/// use splat4d_train::recipe::Recipe;
/// use splat4d_workflow::training::{TrainingOptions, train};
/// use std::sync::atomic::AtomicBool;
///
/// # fn main() -> splat4d::Result<()> {
/// let mut recipe = Recipe::default();
/// recipe.set("run.motion=auto")?;
/// let (options, stop) = (TrainingOptions::default(), AtomicBool::new(false));
/// let trained = train("examples/knight".as_ref(), &recipe, &options, &stop, &splat4d_workflow::events::ignore)?;
/// println!("{}", trained.run.display());
/// # Ok(())
/// # }
/// ```
pub fn train(
    capture: &Path,
    recipe: &Recipe,
    options: &TrainingOptions,
    stop: &AtomicBool,
    listener: &dyn Listener,
) -> Result<Trained> {
    let listener = &Recorded::new(listener);
    let work = Work::new(options, stop, listener)?;
    extract(capture, stop, listener)?;
    let recipe = &refined(capture, recipe, listener);
    let (minutes, predict, output) = (options.minutes, options.predict, options.output.as_deref());
    work.begin(&Begin { capture, recipe, minutes, predict, output, resumed: false })
}

/// Continues a run from its newest checkpoint, and does what follows training. Of the options only `device`, `measure`,
/// `finish`, `clock`, `own_loss` and `chunk` count.
///
/// Errors: no such run; it belongs to another process; those of training.
pub fn resume(run: &Path, options: &TrainingOptions, stop: &AtomicBool, listener: &dyn Listener) -> Result<Trained> {
    let listener = &Recorded::new(listener);
    let work = Work::new(options, stop, listener)?;
    if Chunked::is(run) {
        work.begun(&Run::open(run)?.name(), run, None);
        let _folder = OutputFolder::shared(run)?;
        return work.in_chunks(run, &Chunked::open(run)?);
    }
    // A run that ended before its first checkpoint begins again, as it was requested.
    if let Some(asked) = RunRequest::unbegun(run) {
        let (capture, recipe) = (&asked.capture, &asked.recipe()?);
        let (minutes, predict, output) = (asked.minutes, asked.predict, Some(run));
        return work.begin(&Begin { capture, recipe, minutes, predict, output, resumed: true });
    }
    let name = Run::open(run)?.name();
    work.begun(&name, run, None);
    let folder = OutputFolder::amend(run, options.command)?;
    let training = work.options(None, 0.0, false);
    work.listener.stop_polled(SAVING);
    let trained = run::resume_with(run, &training, stop, &mut |event| work.listener.event(event));
    work.finish(folder, run, trained, true)
}

/// A training that begins.
struct Begin<'a> {
    capture: &'a Path,
    recipe: &'a Recipe,
    minutes: Option<f64>,
    predict: bool,
    output: Option<&'a Path>,
    /// Whether it continues a run that ended before its first checkpoint.
    resumed: bool,
}

struct Work<'a> {
    options: &'a TrainingOptions,
    stop: &'a AtomicBool,
    listener: &'a dyn Listener,
    recorded: &'a Recorded<'a>,
}

impl<'a> Work<'a> {
    fn new(options: &'a TrainingOptions, stop: &'a AtomicBool, recorded: &'a Recorded<'a>) -> Result<Self> {
        options.measure.check()?;
        let listener: &dyn Listener = recorded;
        listener.stop_not_polled("training had not begun, and the same command begins it");
        Ok(Self { options, stop, listener, recorded })
    }

    /// Reports that the run has its folder.
    fn begun(&self, title: &str, run: &Path, capture: Option<&Arc<Capture>>) {
        self.listener.on_event(&crate::events::Event::Begun { title, run, capture });
    }

    /// Options of the trainer. `finish`: what follows training takes as long as about this many steps.
    fn options(&self, minutes: Option<f64>, finish: f64, predict: bool) -> TrainOptions {
        TrainOptions {
            device: chosen(self.options.device, "training", self.listener),
            minutes,
            finish,
            predict,
            clock: self.options.clock.clone(),
            own_loss: self.options.own_loss.clone(),
            snapshots: self.listener.snapshots(),
        }
    }

    /// Work after training, in training steps.
    fn finish_steps(&self, capture: &Capture, recipe: &Recipe) -> f64 {
        match self.options.finish {
            Finish::Scene => 0.0,
            finish => evaluating::steps(capture, recipe, finish == Finish::Playback),
        }
    }

    fn begin(&self, begin: &Begin<'_>) -> Result<Trained> {
        let (options, listener) = (self.options, self.listener);
        let (minutes, output) = (begin.minutes, begin.output);
        listener.phase("reading the capture", 0, 0);
        // Of a long capture only as many frames are listed as show that it is one.
        let look = look_ahead(begin.recipe);
        let capture = Arc::new(open_frames(begin.capture, begin.recipe, look, &Lenses::default())?);
        let asked = RunRequest::of(&capture, begin.recipe, minutes, begin.predict);
        let place = || self.place(output, &capture, &asked);
        // A capture for which no chunks are stated keeps to its minutes at once.
        let at_once = begin.recipe.chunks.frames == 0 && (minutes.is_some() || options.finish == Finish::Scene);
        let is_begun = || output.filter(|run| Chunked::is(run) && !options.force);
        // Steps that were fitted to minutes are those of the worker that began.
        let (recipe, minutes) = match is_begun().filter(|_| minutes.is_some() && !at_once) {
            None => (begin.recipe.clone(), minutes),
            Some(run) => {
                let steps = Chunked::open(run)?.recipe().run.iterations;
                (begin.recipe.clone().unresolved().with(|r| r.run.iterations = steps), None)
            }
        };
        let estimate = match at_once {
            true => None,
            false => {
                let finish = self.finish_steps(&capture, &recipe);
                let listen = &mut |event: &Event| listener.event(event);
                ChunkEstimate::new(&capture, &recipe, minutes, finish, false, &options.clock, listen)?
            }
        };
        listener.clear();
        if let Some(estimate) = estimate {
            // Of workers that start at the same time one begins, and the others find it begun.
            let busy = |run: &Path| Owner::holder(run).flatten().is_some_and(|who| who.command == options.command);
            let folder = loop {
                if let Some(run) = is_begun() {
                    break Err(OutputFolder::shared(run)?);
                }
                match place() {
                    Ok((folder, _)) => break Ok(folder),
                    Err(_) if output.is_some_and(busy) && !options.force => std::thread::sleep(WAIT),
                    Err(error) => return Err(error),
                }
            };
            let run = folder.as_ref().unwrap_or_else(|shared| shared).path().to_owned();
            describe(&capture, estimate.memory, listener);
            listener.result(&chunked::in_words(&estimate));
            self.begun(&capture.name, &run, Some(&capture));
            let begun = Chunked::begin(&capture, &estimate.recipe, &run, &mut |event| listener.event(event))?;
            let chunked = begun.expect("a capture that has a plan is trained by it").paced(estimate.pacing);
            let _folder = match folder {
                Ok(own) => {
                    write_cameras(&run, &once(&capture))?;
                    own.share()
                }
                Err(shared) => shared,
            };
            return self.in_chunks(&run, &chunked);
        }
        let whole = match capture.frames.len() < capture.take.pictures {
            true => Arc::new(open_capture(begin.capture, &recipe)?),
            false => capture.clone(),
        };
        if options.chunk.is_some() {
            return Err(Error::input("the capture fits into one chunk")
                .at("option `chunk`")
                .remedy("Train it without option `chunk`, or set shorter chunks with option `chunk_frames`"));
        }
        let (folder, found) = place()?;
        let run = folder.path().to_owned();
        describe(&whole, memory_estimate(&whole, &recipe), listener);
        self.begun(&whole.name, &run, Some(&whole));
        let training = self.options(minutes, self.finish_steps(&whole, &recipe), begin.predict);
        let mut on_event = |event: &Event| {
            run_folder::on_event(&folder, event);
            listener.event(event);
        };
        listener.stop_polled(SAVING);
        let trained = if found == FolderContent::Unfinished {
            listener
                .result(&format!("{} contains an unfinished run of the same command: it is continued", run.display()));
            run::resume_with(&run, &training, self.stop, &mut on_event)
        } else {
            // The recipe first: whatever happens from here on, the folder is recognised as a run.
            files::write(&run.join("recipe.toml"), recipe.to_toml().as_bytes())?;
            write_cameras(&run, &whole)?;
            run::train(whole, recipe, &run, &training, self.stop, &mut on_event)
        };
        match run_folder::left(folder, &run, &trained) {
            Some(folder) => self.finish(folder, &run, trained, begin.resumed),
            None => {
                listener.clear();
                Err(trained.expect_err("only what failed leaves nothing"))
            }
        }
    }

    /// Does what follows training.
    fn finish(&self, folder: OutputFolder, run: &Path, trained: Result<Outcome>, resumed: bool) -> Result<Trained> {
        let listener = self.listener;
        listener.clear();
        let outcome = trained?;
        evaluating::amend(run, [("notes".into(), json!(self.recorded.warnings()))])?;
        let (iteration, interrupted) = (Some(outcome.iteration), outcome.interrupted);
        let trained = Trained { run: run.to_owned(), iteration, interrupted };
        if interrupted {
            return Ok(trained);
        }
        let kept = format!(
            "the scene is trained and saved: splat4d eval {} makes the scores, the film and the report",
            in_command(run)
        );
        listener.stop_not_polled(&kept);
        listener.result(&format!("wrote {}", run.join("scene.safetensors").display()));
        evaluating::print_refined(run, listener)?;
        self.follow(run, resumed).map_err(|e| match e.kind() {
            ErrorKind::Interrupted => Error::new(ErrorKind::Interrupted, format!("stopped: {kept}")),
            _ => e,
        })?;
        folder.finished();
        Ok(trained)
    }

    /// Labels, playback file, scores, film and report.
    fn follow(&self, run: &Path, resumed: bool) -> Result<()> {
        let listener = self.listener;
        if self.options.finish != Finish::Scene {
            if labelling::has_any(&Run::open(run)?.open_capture()?.0) {
                labelling::learn_into(run, None, None, self.stop, listener)?;
            }
            let clock = self.options.clock.clone();
            let deadline = match resumed {
                true => evaluating::rest_of(&Run::open(run)?, clock),
                false => Deadline::of(clock, self.options.minutes),
            };
            match self.options.finish {
                Finish::All => evaluating::all(run, &self.options.measure, &deadline, self.stop, listener)?,
                _ => evaluating::playback_by(run, &deadline, listener)?,
            }
        }
        Ok(())
    }

    /// Trains the selected parts of a long capture, and joins them where these are all.
    fn in_chunks(&self, run: &Path, chunked: &Chunked) -> Result<Trained> {
        let (options, listener) = (self.options, self.listener);
        let training = self.options(options.minutes, 0.0, false);
        let wanted = options.chunk.unwrap_or(ChunkSelection::All);
        listener.stop_polled(SAVING);
        let outcome =
            chunked::work(run, chunked, (wanted, options.grow), &training, self.stop, listener, &mut |event| {
                listener.event(event);
            });
        listener.clear();
        let interrupted = outcome?.is_some_and(|o| o.interrupted);
        let trained = Trained { run: run.to_owned(), iteration: None, interrupted };
        if interrupted || options.chunk.is_some() {
            return Ok(trained);
        }
        listener.stop_not_polled(&format!("all parts are kept: splat4d join {} joins them", in_command(run)));
        // The other workers are done with it, or wait for the same.
        let _owner = Owner::wait(run, JOIN, &mut |_| !self.stop.load(Ordering::Relaxed))?;
        let deadline = Deadline::of(options.clock.clone(), options.minutes);
        let no_eval = options.finish != Finish::All;
        chunked::join(run, chunked, no_eval, &options.measure, &deadline, self.stop, listener)?;
        Ok(trained)
    }

    /// Takes the folder of the run. One that the user named is never silently replaced.
    fn place(
        &self,
        output: Option<&Path>,
        capture: &Capture,
        asked: &RunRequest,
    ) -> Result<(OutputFolder, FolderContent)> {
        let options = self.options;
        if let Some(run) = output {
            return asked.begin(run, options.force, options.command);
        }
        let wanted = run_folder::usual_folder(&capture.name);
        let run = run_folder::free_folder(&wanted);
        if run != wanted {
            let hint = if Run::is(&wanted) && !Run::is_finished(&wanted) {
                format!(" (it is unfinished: option `resume` {} would continue it)", in_command(&wanted))
            } else {
                String::new()
            };
            let text = format!("{} exists{hint}: this run is written to {}", wanted.display(), run.display());
            self.listener.result(&text);
        }
        asked.begin(&run, options.force, options.command)
    }
}

/// The recipe for a capture whose poses a network predicted or was given: it refines them.
fn refined(source: &Path, recipe: &Recipe, listener: &dyn Listener) -> Recipe {
    let root = if source.is_file() { source.parent().unwrap_or(Path::new(".")) } else { source };
    let file = root.join("capture.json");
    let text = file.is_file().then(|| files::read_text(&file).ok()).flatten();
    let value: Option<serde_json::Value> = text.and_then(|text| serde_json::from_str(&text).ok());
    let by = value.and_then(|v| v["extra"]["predicted_poses"].as_str().map(str::to_owned));
    match by {
        Some(by) if !recipe.refine.poses => {
            listener.result(&format!("poses of {by} are refined during training (refine.poses)"));
            recipe.clone().with(|r| r.refine.poses = true)
        }
        _ => recipe.clone(),
    }
}

/// Without the importer a capture's frames must be there.
#[cfg(not(feature = "import"))]
fn extract(_: &Path, _: &AtomicBool, _: &dyn Listener) -> Result<()> {
    Ok(())
}

/// Extracts the frames of a capture that is shipped as videos with poses.
#[cfg(feature = "import")]
fn extract(source: &Path, stop: &AtomicBool, listener: &dyn Listener) -> Result<()> {
    let root = if source.is_file() { source.parent().unwrap_or(Path::new(".")) } else { source };
    let mut listen = |event: &Event| listener.event(event);
    let (progress, stopped) = (&mut Progress(&mut listen), || stop.load(Ordering::SeqCst));
    let found = match generated::extract(root, progress, &stopped)? {
        None => shipped::extract(root, progress, &stopped)?,
        found => found,
    };
    listener.clear();
    let Some(found) = found else { return Ok(()) };
    found.warnings.iter().for_each(|w| listener.warn(w));
    listener.result(&format!(
        "frames of {} videos are in {}: {} of {}x{}",
        found.cameras,
        root.join("images").display(),
        files::grouped(found.frames),
        found.size[0],
        found.size[1]
    ));
    Ok(())
}

/// Every fixed camera once: a long capture has too many images to name them all.
fn once(capture: &Capture) -> Capture {
    let mut seen = vec![false; capture.cameras.len()];
    let mut new = |i: &usize| {
        let camera = capture.frames[*i].camera;
        !(capture.cameras[camera].fixed && std::mem::replace(&mut seen[camera], true))
    };
    let train = capture.train.iter().copied().filter(&mut new).collect();
    let held = capture.held.iter().copied().filter(&mut new).collect();
    Capture { train, held, ..capture.clone() }
}

/// Reports what the capture contains, and findings.
fn describe(capture: &Capture, memory: u64, listener: &dyn Listener) {
    let in_part = capture.frames.len() < capture.take.pictures;
    let (first, last) = match capture.time_range() {
        (first, _) if in_part => (first, first + (capture.take.frames.len() as f64 - 1.0) / capture.fps),
        whole => whole,
    };
    let size = capture.frames.first().map_or([0, 0], |f| [f.view.width, f.view.height]);
    let span = match capture.timing {
        Timing::Moment => "at one time".to_owned(),
        _ => format!("over {:.2} s", last - first),
    };
    listener.result(&format!(
        "{}: {} camera{}, {} images of {}x{} {span}{}",
        capture.name,
        capture.cameras.len(),
        if capture.cameras.len() == 1 { "" } else { "s" },
        capture.take.pictures,
        size[0],
        size[1],
        match in_part {
            true => String::new(),
            false => format!("; {} train, {} held out", capture.train.len(), capture.held.len()),
        }
    ));
    listener.detail(&format!("memory estimate: {}", human_bytes(memory)));
    let poses = capture.check_poses();
    for finding in capture.preflight().into_iter().chain([poses.finding]).chain(poses.more) {
        let text = format!("{} {}", finding.what, finding.remedy).trim_end().to_owned();
        match finding.severity {
            Severity::Warning => listener.warn(&text),
            Severity::Note => listener.detail(&text),
        }
    }
}
