//! `train`: a capture becomes a run: trained, measured, filmed and reported.

use crate::console::Console;
use crate::device::Device;
use crate::interrupt;
use crate::measuring::MeasureArgs;
use crate::serving::{self, Control, Place, Watch};
use serde_json::json;
use splat4d::{Error, ErrorKind};
use splat4d_import::shipped;
use splat4d_train::capture::{Capture, Lenses, Severity, Timing};
use splat4d_train::event::{Event, Progress};
use splat4d_train::output::{FolderContent, OutputFolder, Owner};
use splat4d_train::path_text::in_command;
use splat4d_train::recipe::{MotionName, Quality, Recipe};
use splat4d_train::run::chunks::{ChunkEstimate, Chunked, look_ahead};
use splat4d_train::run::{self, Outcome, Stopwatch, TrainOptions};
use splat4d_train::run::{memory_estimate, open_capture, open_frames};
use splat4d_train::settings::{Setting, nearest};
use splat4d_workflow::chunked::{self, ChunkSelection};
use splat4d_workflow::deadline::Deadline;
use splat4d_workflow::device::chosen;
use splat4d_workflow::files::{self, human_bytes, parse_bytes};
use splat4d_workflow::run_folder::{self, Run, RunRequest, write_cameras};
use splat4d_workflow::{evaluating, labelling};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// A new image of the learning scene about so often: shorter than a user would wait before reloading, longer than a
/// page needs to update.
const SNAPSHOT_INTERVAL: Duration = Duration::from_secs(3);

/// Time between two looks whether the worker that begins a long take is done with that.
const WAIT: Duration = Duration::from_millis(200);
/// What an owner's record calls this verb, and `join`.
const TRAIN: &str = "train";
const JOIN: &str = "join";
/// What the first Ctrl-C is answered with in training.
const SAVING: &str = "stopping: a checkpoint is being saved";

const EXAMPLES: &str = "\
Examples:
  splat4d train examples/knight                     default recipe, into runs/knight
  splat4d train my-take -o runs/first --minutes 10  finish within ten minutes
  splat4d train my-take --quality draft             a first look, after minutes
  splat4d train my-take --view                      watch it learn in the browser
  splat4d train my-take --motion still              a static scene: checks the calibration
  splat4d train my-take --downscale 4 --set iterations=1000 --set sh_degree=0
  splat4d train my-take --hold-out camera=0,10      measure on these cameras
  splat4d train my-take --observe 0.8               keep the last fifth for `predict`
  splat4d train concert -o runs/concert --chunk-frames 60    a long capture in chunks
  splat4d train my-take --device auto               on a GPU, if there is one
  splat4d train --resume runs/first                 continue exactly

A capture is a folder with one of these: capture.json (write it for your own rig), transforms_train.json (D-NeRF, \
Blender), transforms.json (Nerfstudio), sparse/ (COLMAP), train_meta.json (PanopticSports), dataset.json (HyperNeRF) or \
poses_bounds.npy (N3DV). `splat4d info CAPTURE` checks one. `--help-knobs` lists all settings.";

/// The settings that most runs change, for `--help`.
const IMPORTANT: [&str; 12] = [
    "run.iterations",
    "run.half_size_until",
    "densify.max_cap",
    "densify.strategy",
    "appearance.sh_degree",
    "appearance.exposure",
    "init.source",
    "init.count",
    "life.kind",
    "capture.max_frames",
    "capture.white_background",
    "loss.dssim",
];

/// Train a scene from a capture, measure it, film it and write a report
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = long_help())]
pub struct Args {
    /// The capture: a folder, or its marker file
    #[arg(value_name = "CAPTURE", required_unless_present_any = ["resume", "source", "help_knobs"])]
    capture: Option<PathBuf>,
    /// Output folder [default: runs/NAME, or runs/NAME-2 ... if it exists]
    #[arg(short, long, value_name = "RUN", short_alias = 'm', alias = "model_path", alias = "model-path")]
    output: Option<PathBuf>,
    /// Continue this run from its newest checkpoint
    #[arg(long, value_name = "RUN", conflicts_with_all = ["capture", "output", "motion", "minutes", "quality", "recipe", "set",
        "downscale", "hold_out", "images", "poses", "observe", "chunk_frames", "overlap", "chunk", "image_memory", "memory_limit", "seed", "source", "iterations", "force"])]
    resume: Option<PathBuf>,
    /// Replace the run in the -o folder (only files that splat4d wrote) once the new run has begun
    #[arg(long)]
    force: bool,
    /// Motion model: auto (chosen by the capture), still, spacetime, deform-mlp, hexplane, tracked, native4d, control
    /// or ssm [default: auto, or the recipe's]
    #[arg(long, value_name = "MODEL", help_heading = "Training")]
    motion: Option<String>,
    /// Finish within M minutes, evaluation and report included. The step count is planned and re-planned to fit, and
    /// recorded in the recipe
    #[arg(long, value_name = "M", value_parser = minutes, help_heading = "Training")]
    minutes: Option<f64>,
    /// draft (half-size images, 2,500 steps, half the Gaussians), standard (the default: 7,000 steps) or best (20,000
    /// steps, twice the Gaussians). Prints the expected time first. Settings have priority over it, and --minutes over
    /// its steps
    #[arg(long, value_name = "QUALITY", help_heading = "Training")]
    quality: Option<Quality>,
    /// Start from this recipe (TOML); a run's recipe.toml repeats that run
    #[arg(long, value_name = "FILE", help_heading = "Training")]
    recipe: Option<PathBuf>,
    /// List all settings, or those of a table or with a word in their name
    #[arg(long, value_name = "TOPIC", num_args = 0..=1, default_missing_value = "", help_heading = "Training")]
    help_knobs: Option<String>,
    /// Change a setting, repeatable
    #[arg(long, value_name = "KEY=VALUE", help_heading = "Training")]
    set: Vec<String>,
    /// Seed of every random choice
    #[arg(long, value_name = "N", help_heading = "Training")]
    seed: Option<u64>,
    /// Reduce images by k: the mean of k x k boxes
    #[arg(long, value_name = "K", short_alias = 'r', alias = "resolution", help_heading = "Input")]
    downscale: Option<usize>,
    /// Views kept from training: camera=0,10 or every=8 or none [default: the data set's convention]
    #[arg(long, value_name = "RULE", help_heading = "Input")]
    hold_out: Option<String>,
    /// Folder of images instead of the capture's, such as images_4
    #[arg(long, value_name = "NAME", help_heading = "Input")]
    images: Option<String>,
    /// Convention of poses if it differs from the layout's: opencv or opengl (camera axes), inverse, transposed or xyzw
    /// (quaternions), or several joined by +
    #[arg(long, value_name = "CONVENTION", help_heading = "Input")]
    poses: Option<String>,
    /// Train on the first SHARE of the clip only; later frames score `predict` [default: 1]
    #[arg(long, value_name = "SHARE", help_heading = "Input")]
    observe: Option<f64>,
    /// Train longer captures in chunks of N frames [default: 60 if fixed cameras have more than 300 frames]
    #[arg(long, value_name = "N", help_heading = "Long captures")]
    chunk_frames: Option<usize>,
    /// Frames that neighbouring chunks share, an even number [default: 16]
    #[arg(long, value_name = "N", help_heading = "Long captures")]
    overlap: Option<usize>,
    /// Train one part and end: shared, then even chunks by number, then odd ones; or all, in parallel with other
    /// workers on the same RUN. Finished parts are skipped; `splat4d join RUN` ends the run
    #[arg(long, value_name = "PART", help_heading = "Long captures", requires = "output", conflicts_with = "force")]
    chunk: Option<ChunkSelection>,
    /// Memory for decoded images [default: 1GiB]
    #[arg(long, value_name = "SIZE", value_parser = parse_bytes, help_heading = "Input")]
    image_memory: Option<u64>,
    /// Memory limit of training: long captures get shorter chunks with fewer Gaussians
    #[arg(long, value_name = "SIZE", value_parser = parse_bytes, help_heading = "Input")]
    memory_limit: Option<u64>,
    /// Device to train on. The CPU runs whatever the GPU does not support. Not part of the recipe: a run can be resumed
    /// on another device
    #[arg(long, value_enum, default_value = "cpu", help_heading = "Device")]
    device: Device,
    #[command(flatten)]
    measure: MeasureArgs,
    /// Show the scene in the browser during training, and on a terminal afterwards until Ctrl-C
    #[arg(long, help_heading = "Serving")]
    view: bool,
    #[command(flatten)]
    place: Place,
    /// Only train and bake; skip evaluation, film and report
    #[arg(long, help_heading = "Evaluation")]
    no_eval: bool,

    // What users of other systems type.
    #[arg(
        short = 's',
        long = "source-path",
        alias = "source_path",
        alias = "data",
        hide = true,
        conflicts_with = "capture"
    )]
    source: Option<PathBuf>,
    #[arg(long, alias = "total-steps", hide = true)]
    iterations: Option<usize>,
    #[arg(long, alias = "max_cap", alias = "max-splats", hide = true)]
    max_cap: Option<usize>,
    #[arg(long, alias = "sh_degree", hide = true)]
    sh_degree: Option<usize>,
    #[arg(long = "eval", hide = true)]
    _eval: bool,
}

pub fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    if let Some(topic) = &args.help_knobs {
        console.result(setting_list(topic)?.trim_end());
        return Ok(());
    }
    let stop = interrupt::flag(SAVING);
    let control = Control::new(stop.clone());
    let clock = control.clock();
    args.measure.check()?;
    if !args.view && args.place.is_told() {
        return Err(Error::input("--port, --host and --no-open need --view").remedy("Add --view.").into());
    }
    interrupt::stop_not_polled("training had not begun, and the same command begins it");
    let watch = |title: &str, capture: Option<&Arc<Capture>>| {
        Watch::start(title, capture.cloned(), args.view.then_some(&args.place), &control, console)
    };
    // The images of a run that is continued; without its capture the resume itself reports the reason.
    let images = |run: &Run| args.view.then(|| run.open_capture().ok()).flatten().map(|(capture, _)| Arc::new(capture));
    let snapshots = |watch: &Watch| watch.is_on().then_some(SNAPSHOT_INTERVAL);
    let listen = |event: &Event, watch: &Watch| {
        watch.on_event(event);
        console.event(event);
    };
    if let Some(run) = args.resume.as_ref().filter(|run| Chunked::is(run)) {
        let opened = Run::open(run)?;
        let watch = watch(&opened.name(), images(&opened).as_ref());
        let _folder = OutputFolder::shared(run)?;
        let chunked = Chunked::open(run)?;
        return in_chunks(args, run, &chunked, clock, &stop, &watch, console);
    }
    // A run that ended before its first checkpoint begins again, as it was asked for.
    let again = args.resume.as_ref().and_then(|run| Some((run.clone(), RunRequest::unbegun(run)?)));
    let (folder, run, watch, trained) = if let Some(run) = args.resume.as_ref().filter(|_| again.is_none()) {
        let opened = Run::open(run)?;
        let watch = watch(&opened.name(), images(&opened).as_ref());
        let folder = OutputFolder::amend(run, "train --resume")?;
        let device = chosen(args.device.into(), "training", console);
        let clock = clock.clone();
        let options = TrainOptions { device, snapshots: snapshots(&watch), clock, ..TrainOptions::default() };
        interrupt::stop_polled(SAVING);
        let trained = run::resume_with(run, &options, &stop, &mut |event| listen(event, &watch));
        (folder, run.clone(), watch, trained)
    } else {
        let (source, recipe, minutes, predict) = match &again {
            Some((_, asked)) => (asked.capture.clone(), asked.recipe()?, asked.minutes, asked.predict),
            None => {
                let source = args.capture.as_ref().or(args.source.as_ref()).expect("clap asks for a capture");
                (source.clone(), recipe(args)?, args.minutes, args.quality.is_some())
            }
        };
        let typed = args.set.iter().filter_map(|a| Some(a.split_once('=')?.0));
        recipe.refuse_unused(typed).map_err(|e| e.at("--set"))?;
        if again.is_none() {
            extract(&source, &stop, console)?;
        }
        console.phase("reading the capture", 0, 0);
        // Of a long take no more is listed than is needed to recognise it.
        let capture = Arc::new(open_frames(&source, &recipe, look_ahead(&recipe), &Lenses::default())?);
        let output = again.as_ref().map(|(run, _)| run).or(args.output.as_ref());
        let asked = RunRequest::of(&capture, &recipe, minutes, predict);
        let place = || place(args, output, &capture, &asked, console);
        // A capture without requested chunks keeps to its minutes directly.
        let at_once = minutes.is_some() && recipe.chunks.frames == 0;
        let is_begun = || output.filter(|run| Chunked::is(run) && !args.force);
        // Steps that were fitted to minutes are those of the worker that began.
        let (recipe, minutes) = match is_begun().filter(|_| minutes.is_some() && !at_once) {
            None => (recipe, minutes),
            Some(run) => {
                let steps = Chunked::open(run)?.recipe().run.iterations;
                (recipe.unresolved().with(|r| r.run.iterations = steps), None)
            }
        };
        let outlook = match at_once {
            true => None,
            false => {
                let finish = evaluating::steps(&capture, &recipe, args.no_eval);
                let listen = &mut |event: &Event| console.event(event);
                ChunkEstimate::new(&capture, &recipe, minutes, finish, false, &clock, listen)?
            }
        };
        console.clear();
        if let Some(outlook) = outlook {
            // Of workers that start at the same time one begins, and the others find it begun.
            let busy = |run: &Path| Owner::holder(run).flatten().is_some_and(|who| who.command == TRAIN);
            let folder = loop {
                if let Some(run) = is_begun() {
                    break Err(OutputFolder::shared(run)?);
                }
                match place() {
                    Ok((folder, _)) => break Ok(folder),
                    Err(_) if output.is_some_and(|run| busy(run)) && !args.force => std::thread::sleep(WAIT),
                    Err(error) => return Err(error),
                }
            };
            let run = folder.as_ref().unwrap_or_else(|shared| shared).path().to_owned();
            describe(&capture, outlook.memory, console);
            console.say(&chunked::in_words(&outlook));
            let watch = watch(&capture.name, Some(&capture));
            let begun = Chunked::begin(&capture, &outlook.recipe, &run, &mut |event| listen(event, &watch))?;
            let chunked = begun.expect("a capture with a plan is trained by it").paced(outlook.pacing);
            let _folder = match folder {
                Ok(own) => {
                    write_cameras(&run, &once(&capture))?;
                    own.share()
                }
                Err(shared) => shared,
            };
            return in_chunks(args, &run, &chunked, clock, &stop, &watch, console);
        }
        let whole = match capture.frames.len() < capture.take.pictures {
            true => Arc::new(open_capture(&source, &recipe)?),
            false => capture.clone(),
        };
        if args.chunk.is_some() {
            return Err(Error::input("the capture fits into one chunk")
                .at("--chunk")
                .remedy("Train it without --chunk, or set shorter chunks with --chunk-frames")
                .into());
        }
        let (folder, found) = place()?;
        let run = folder.path().to_owned();
        describe(&whole, memory_estimate(&whole, &recipe), console);
        let watch = watch(&whole.name, Some(&whole));
        let options = TrainOptions {
            device: chosen(args.device.into(), "training", console),
            minutes,
            finish: evaluating::steps(&whole, &recipe, args.no_eval),
            predict,
            clock: clock.clone(),
            own_loss: None,
            snapshots: snapshots(&watch),
        };
        let mut on_event = |event: &Event| {
            run_folder::on_event(&folder, event);
            listen(event, &watch);
        };
        interrupt::stop_polled(SAVING);
        let trained = if found == FolderContent::Unfinished {
            console.say(&format!("{} contains an unfinished run of the same command: it is continued", run.display()));
            run::resume_with(&run, &options, &stop, &mut on_event)
        } else {
            // The recipe first: whatever comes to pass from here on, the folder is known for what it is.
            files::write(&run.join("recipe.toml"), recipe.to_toml().as_bytes())?;
            write_cameras(&run, &whole)?;
            run::train(whole, recipe, &run, &options, &stop, &mut on_event)
        };
        match run_folder::left(folder, &run, &trained) {
            Some(folder) => (folder, run, watch, trained),
            None => {
                console.clear();
                return Err(trained.expect_err("only what failed leaves nothing").into());
            }
        }
    };
    console.clear();
    let outcome: Outcome = trained?;
    evaluating::amend(&run, [("notes".into(), json!(console.warnings()))])?;
    if outcome.interrupted {
        let resume = format!("splat4d train --resume {}", in_command(&run));
        watch.stopped(outcome.iteration, &resume);
        return Err(Error::new(
            ErrorKind::Interrupted,
            format!("training was stopped after step {} and saved", outcome.iteration),
        )
        .remedy(format!("Continue with: {resume}"))
        .into());
    }
    let name = in_command(&run);
    interrupt::stop_not_polled(format!(
        "the scene is trained and saved: splat4d eval {name} makes the scores, the film and the report"
    ));
    console.say(&format!("wrote {}", run.join("scene.safetensors").display()));
    evaluating::say_refined(&run, console)?;
    if labelling::has_any(&Run::open(&run)?.open_capture()?.0) {
        labelling::learn_into(&run, None, None, console)?;
    }
    let deadline = match &args.resume {
        Some(run) => evaluating::rest_of(&Run::open(run)?, clock),
        None => Deadline::of(clock, args.minutes),
    };
    if args.no_eval {
        evaluating::playback_by(&run, &deadline, console)?;
    } else {
        evaluating::all(&run, &args.measure.options(), &deadline, console)?;
    }
    folder.finished();
    watch.show(&run, outcome.iteration);
    console.next("view", &run);
    console.emit(&json!({"type": "done", "run": run.to_string_lossy()}));
    if watch.is_on() && console.terminal() {
        console.say("the player keeps running until Ctrl-C");
        interrupt::stop_polled("stopping");
        serving::wait(&stop);
    }
    Ok(())
}

/// Does what is wanted of a long take, and joins it where that is all.
fn in_chunks(
    args: &Args,
    run: &Path,
    chunked: &Chunked,
    clock: Stopwatch,
    stop: &AtomicBool,
    watch: &Watch,
    console: &Console,
) -> anyhow::Result<()> {
    let options = TrainOptions {
        device: chosen(args.device.into(), "training", console),
        clock: clock.clone(),
        minutes: args.minutes,
        snapshots: watch.is_on().then_some(SNAPSHOT_INTERVAL),
        ..TrainOptions::default()
    };
    let wanted = args.chunk.unwrap_or(ChunkSelection::All);
    interrupt::stop_polled(SAVING);
    let outcome = chunked::work(run, chunked, wanted, &options, stop, console, &mut |event| {
        watch.on_event(event);
        console.event(event);
    });
    console.clear();
    if outcome?.is_some_and(|o| o.interrupted) {
        let resume = format!("splat4d train --resume {}", in_command(run));
        watch.stopped(0, &resume);
        return Err(Error::new(ErrorKind::Interrupted, "training was stopped and saved")
            .remedy(format!("Continue with: {resume}"))
            .into());
    }
    match args.chunk {
        Some(_) => console.emit(&json!({"type": "done", "run": run.to_string_lossy()})),
        None => {
            interrupt::stop_not_polled(format!("all parts are kept: splat4d join {} joins them", in_command(run)));
            // The other workers are done with it, or wait for the same.
            let _owner = Owner::wait(run, JOIN, &mut |_| !stop.load(Ordering::Relaxed))?;
            let deadline = Deadline::of(clock, args.minutes);
            chunked::join(run, chunked, args.no_eval, &args.measure.options(), &deadline, stop, console)?;
            console.next("view", run);
            console.emit(&json!({"type": "done", "run": run.to_string_lossy()}));
        }
    }
    Ok(())
}

/// The recipe file, then the quality, then the options, then every --set.
fn recipe(args: &Args) -> anyhow::Result<Recipe> {
    let mut recipe = match &args.recipe {
        // What the capture is, is seen better than guessed: the library's default is one model.
        None => Recipe::default().with(|r| r.run.motion = MotionName::AUTO),
        Some(path) => Recipe::from_toml(&files::read_text(path)?).map_err(|e| e.at(path.display()))?,
    };
    if let Some(quality) = args.quality {
        recipe = recipe.of_quality(quality);
    }
    let typed = |name: &str| {
        args.set.iter().any(|a| a.split_once('=').is_some_and(|(key, _)| Recipe::key_of(key.trim()) == name))
    };
    // Another length than the file's is gone through in its own way.
    if (args.iterations.is_some() || typed("run.iterations")) && args.quality.is_none() {
        recipe = recipe.unresolved();
    }
    let mut set =
        |setting: &str, value: Option<String>| value.map_or(Ok(()), |v| recipe.set(&format!("{setting}={v}")));
    let quoted = |text: &String| toml::Value::String(text.clone()).to_string();
    set("motion", args.motion.as_ref().map(quoted))?;
    set("seed", args.seed.map(|v| v.to_string()))?;
    set("downscale", args.downscale.map(|v| v.to_string()))?;
    set("hold_out", args.hold_out.as_ref().map(quoted))?;
    set("capture.images", args.images.as_ref().map(quoted))?;
    set("capture.poses", args.poses.as_ref().map(quoted))?;
    set("capture.observe", args.observe.map(|v| v.to_string()))?;
    set("chunks.frames", args.chunk_frames.map(|v| v.to_string()))?;
    set("chunks.overlap", args.overlap.map(|v| v.to_string()))?;
    set("image_memory", args.image_memory.map(|v| v.to_string()))?;
    set("memory_limit", args.memory_limit.map(|v| v.to_string()))?;
    set("iterations", args.iterations.map(|v| v.to_string()))?;
    set("max_cap", args.max_cap.map(|v| v.to_string()))?;
    set("sh_degree", args.sh_degree.map(|v| v.to_string()))?;
    for assignment in &args.set {
        recipe.set(assignment).map_err(|e| e.at("--set"))?;
    }
    Ok(recipe)
}

/// Extracts the frames of a capture that is shipped as videos with poses.
fn extract(source: &Path, stop: &AtomicBool, console: &Console) -> anyhow::Result<()> {
    let root = if source.is_file() { source.parent().unwrap_or(Path::new(".")) } else { source };
    if shipped::videos(root).is_empty() {
        return Ok(());
    }
    let mut tell = |event: &Event| console.event(event);
    let found = shipped::extract(root, &mut Progress(&mut tell), &|| stop.load(Ordering::SeqCst))?;
    console.clear();
    let Some(found) = found else { return Ok(()) };
    found.warnings.iter().for_each(|w| console.warn(w));
    console.say(&format!(
        "frames of {} videos are in {}: {} of {}x{}",
        found.cameras,
        root.join("images").display(),
        files::grouped(found.frames),
        found.size[0],
        found.size[1]
    ));
    Ok(())
}

/// Takes the folder of the run. One that the user named is never silently taken over.
fn place(
    args: &Args,
    output: Option<&PathBuf>,
    capture: &Capture,
    asked: &RunRequest,
    console: &Console,
) -> anyhow::Result<(OutputFolder, FolderContent)> {
    if let Some(run) = output {
        return Ok(asked.begin(run, args.force, TRAIN)?);
    }
    let wanted = run_folder::usual_folder(&capture.name);
    let run = run_folder::free_folder(&wanted);
    if run != wanted {
        let hint = if Run::is(&wanted) && !Run::is_finished(&wanted) {
            format!(" (it is unfinished: --resume {} would continue it)", in_command(&wanted))
        } else {
            String::new()
        };
        console.say(&format!("{} exists{hint}: this run is written to {}", wanted.display(), run.display()));
    }
    Ok(asked.begin(&run, args.force, TRAIN)?)
}

/// Every fixed camera once: a long take has too many images to name them all.
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

fn describe(capture: &Capture, memory: u64, console: &Console) {
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
    console.say(&format!(
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
    console.detail(&format!("memory estimate: {}", human_bytes(memory)));
    let poses = capture.check_poses();
    for finding in capture.preflight().into_iter().chain([poses.finding]).chain(poses.more) {
        let text = format!("{} {}", finding.what, finding.remedy).trim_end().to_owned();
        match finding.severity {
            Severity::Warning => console.warn(&text),
            Severity::Note => console.detail(&text),
        }
    }
}

fn minutes(text: &str) -> Result<f64, String> {
    /// A week: longer is a slip.
    const MOST: f64 = 7.0 * 24.0 * 60.0;
    let value: f64 = text.parse().map_err(|_| "expected minutes, for instance 10 or 2.5".to_owned())?;
    if value > 0.0 && value <= MOST { Ok(value) } else { Err(format!("expected minutes above 0, at most {MOST}")) }
}

/// The examples, and the settings that most runs change.
fn long_help() -> String {
    let settings = Recipe::settings();
    let lines: String = IMPORTANT
        .iter()
        .map(|key| line(settings.iter().find(|k| k.key() == *key).expect("IMPORTANT lists settings of the recipe")))
        .collect();
    format!("{EXAMPLES}\n\nSettings (--set KEY=VALUE, or a TOML file for --recipe; --help-knobs: all):\n{lines}")
}

/// Every setting, those of a table, or those with the topic in their name. Errors: there is none.
fn setting_list(topic: &str) -> Result<String, Error> {
    let settings = Recipe::settings();
    let named = |k: &Setting| k.key().contains(topic) || Recipe::flat_name(&k.key()).is_some_and(|n| n.contains(topic));
    let of_table = settings.iter().any(|k| k.table == topic);
    let mut text = String::new();
    let mut table = "";
    for setting in settings.iter().filter(|k| if of_table { k.table == topic } else { named(k) }) {
        if setting.table != table {
            table = setting.table;
            let needs = Recipe::needs(table).map_or_else(String::new, |n| format!(" In effect with {n}."));
            text += &format!("[{table}] {}{needs}\n", Recipe::about(table));
        }
        text += &line(setting);
    }
    if text.is_empty() {
        let mut tables: Vec<&str> = settings.iter().map(|k| k.table).collect();
        tables.dedup();
        let near = nearest(topic, &tables).map_or_else(String::new, |n| format!("Did you mean `{n}`? "));
        return Err(Error::input(format!("no setting or table has `{topic}` in its name"))
            .at("--help-knobs")
            .remedy(format!("{near}Tables are: {}", tables.join(", "))));
    }
    Ok(text)
}

/// A setting in a line of help: its names, meaning, unit and default.
fn line(setting: &Setting) -> String {
    let default = if setting.default == "\"\"" { "empty" } else { &setting.default };
    let unit = if setting.rule.unit.is_empty() { String::new() } else { format!(" {}", setting.rule.unit) };
    let alone = Recipe::flat_name(&setting.key())
        .filter(|n| *n != setting.field)
        .map_or_else(String::new, |n| format!(" ({n})"));
    let name = format!("{}{alone}", setting.key());
    format!("  {name:<42} {} [{default}{unit}]\n", setting.doc.trim_end_matches('.'))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(clap::Parser)]
    struct Typed {
        #[command(flatten)]
        args: Args,
    }

    /// What the recipe becomes with these words.
    fn typed(words: &[&str]) -> Recipe {
        recipe(&Typed::parse_from([&["train", "take"], words].concat()).args).unwrap()
    }

    #[test]
    fn explicit_settings_override_quality_and_length_sets_schedules() {
        let steps = |r: &Recipe| [r.run.iterations, r.densify.max_cap, r.capture.downscale];
        let draft = steps(&typed(&["--quality", "draft"]));
        assert_eq!(draft, steps(&Recipe::default().of_quality(Quality::Draft)));
        let own = typed(&["--set", "iterations=90", "--downscale", "1", "--quality", "draft"]);
        assert_eq!(steps(&own), [90, draft[1], 1]);
        assert_eq!(steps(&typed(&[])), steps(&Recipe::default()));
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("recipe.toml");
        std::fs::write(&file, "[run]\niterations = 300\nreplans = [[7, 200]]\n[densify]\nuntil = 225\nfrom = 9\n")
            .unwrap();
        let of_file = |words: &[&str]| typed(&[&["--recipe", file.to_str().unwrap()], words].concat());
        assert_eq!((of_file(&[]).run.replans.rows().len(), of_file(&[]).densify.until), (1, 225));
        for words in [&["--set", "iterations=600"][..], &["--iterations", "600"], &["--set", "run.iterations=600"]] {
            let r = of_file(words).resolve();
            assert_eq!((r.run.replans.rows().len(), r.densify.until, r.densify.from), (0, 450, 9));
        }
    }

    #[test]
    fn settings_are_listed_by_topic() {
        let all = setting_list("").unwrap();
        assert!(Recipe::settings().iter().all(|k| all.contains(&k.key())));
        let merge = setting_list("merge").unwrap();
        assert!(merge.starts_with("[merge]") && merge.lines().count() == 4, "{merge}");
        assert!(setting_list("velocity").unwrap().contains("spacetime.velocity_lr_init"));
        assert!(setting_list("crowding").unwrap().contains("merge.pair (crowding)"));
        assert!(setting_list("spacetme").unwrap_err().to_string().contains("`spacetime`"));
        assert!(long_help().contains("densify.max_cap"));
    }
}
