//! `train`: a capture becomes a run: trained, measured, filmed and reported.

use crate::console::Console;
use crate::device::Device;
use crate::interrupt;
use crate::measuring::MeasureArgs;
use crate::serving::{self, Control, Place, Watched};
use crate::storage::{self, StorageArgs};
use serde_json::json;
use splat4d::{Error, ErrorKind};
use splat4d_train::path_text::in_command;
use splat4d_train::recipe::{MotionName, Quality, Recipe};
use splat4d_train::run::follow::Following;
use splat4d_train::settings::{Setting, nearest};
use splat4d_workflow::chunked::ChunkSelection;
use splat4d_workflow::evaluating::Measure;
use splat4d_workflow::files::{self, parse_bytes};
use splat4d_workflow::following;
use splat4d_workflow::parts::left_out;
use splat4d_workflow::training::{self, Finish, Trained, TrainingOptions};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Owner named by a run's lock while it is continued.
const RESUME: &str = "train --resume";
/// Message for the first Ctrl-C in training.
const SAVING: &str = "stopping: a checkpoint is being saved";

const EXAMPLES: &str = "\
Examples:
  splat4d train examples/knight                     default recipe, into runs/knight
  splat4d train my-take -o runs/first --minutes 10  finish within ten minutes
  splat4d train my-take --quality draft             a first look, after minutes
  splat4d train my-take --view                      watch it learn in the browser
  splat4d train my-take --motion still              a static scene: checks the calibration
  splat4d train my-take --downscale 4 --set iterations=1000 --set sh_degree=0
  splat4d train concert -o runs/concert --chunk-frames 60    a long capture in chunks
  splat4d train live-take --follow --view           while it is being filmed
  splat4d train s3://takes/concert -o s3://takes/run --chunk all    workers on object storage
  splat4d train my-take --device cpu                not on the GPU
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
    /// The capture: a folder, or its marker file; or s3://BUCKET/FOLDER
    #[arg(value_name = "CAPTURE", required_unless_present_any = ["resume", "source", "help_knobs"])]
    capture: Option<PathBuf>,
    /// Output folder [default: runs/NAME, or runs/NAME-2 ... if it exists]
    #[arg(short, long, value_name = "RUN", short_alias = 'm', alias = "model_path", alias = "model-path")]
    output: Option<PathBuf>,
    /// Continue this run from its newest checkpoint
    #[arg(long, value_name = "RUN", conflicts_with_all = ["capture", "output", "motion", "minutes", "quality", "recipe", "set",
        "downscale", "hold_out", "images", "poses", "observe", "chunk_frames", "overlap", "chunk", "image_memory", "memory_limit", "seed", "source", "iterations", "force", "follow"])]
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
    /// Train the capture while it is being filmed, frame by frame as its images arrive. Only Gaussians whose pixels change
    /// learn, and the playback file grows. Ends with the file `capture.end` in its folder, or after --follow-timeout
    #[arg(long, help_heading = "Live captures", conflicts_with_all = ["minutes", "chunk", "chunk_frames", "observe", "quality"])]
    follow: bool,
    /// Seconds without a complete frame after which the capture counts as finished [default: 60]
    #[arg(long, value_name = "SECONDS", help_heading = "Live captures", requires = "follow")]
    follow_timeout: Option<f64>,
    #[command(flatten, next_help_heading = "Long captures")]
    storage: StorageArgs,
    /// Memory for decoded images [default: 1GiB]
    #[arg(long, value_name = "SIZE", value_parser = parse_bytes, help_heading = "Input")]
    image_memory: Option<u64>,
    /// Memory limit of training: long captures get shorter chunks with fewer Gaussians
    #[arg(long, value_name = "SIZE", value_parser = parse_bytes, help_heading = "Input")]
    memory_limit: Option<u64>,
    /// Device to train on. The CPU runs whatever the GPU does not support. Not part of the recipe: a run can be resumed
    /// on another device; with auto, a run of the CPU stays on it
    #[arg(long, value_enum, default_value = "auto", help_heading = "Device")]
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
    if args.view && !cfg!(feature = "serve") {
        return Err(left_out("--view", "serve").into());
    }
    let stop = interrupt::flag(SAVING);
    let control = Control::new(stop.clone());
    args.measure.check()?;
    if !args.view && args.place.is_printed() {
        return Err(Error::input("--port, --host and --no-open need --view").remedy("Add --view.").into());
    }
    let watched = Watched::new(args.view.then_some(&args.place), &control, console);
    let options = TrainingOptions {
        output: args.output.clone(),
        force: args.force,
        minutes: args.minutes,
        predict: args.quality.is_some(),
        chunk: args.chunk,
        device: args.device.into(),
        measure: Measure { device: args.device.into(), ..args.measure.options() },
        finish: if args.no_eval { Finish::Playback } else { Finish::All },
        clock: control.clock(),
        ..TrainingOptions::default()
    };
    let source = args.capture.as_ref().or(args.source.as_ref());
    let paths = [source, args.output.as_ref(), args.resume.as_ref()];
    let on_storage = paths.into_iter().flatten().any(|path| storage::is_address(path));
    let trained = match &args.resume {
        Some(_) if on_storage => {
            return Err(Error::input("--resume needs a local run")
                .remedy("On object storage run the command that began the run again: it continues")
                .into());
        }
        Some(run) => {
            let options = TrainingOptions { command: RESUME, ..options };
            match Following::is(run) {
                true => following::resume(run, &options, &stop, &watched)?,
                false => training::resume(run, &options, &stop, &watched)?,
            }
        }
        None => {
            let source = source.expect("clap requires a capture");
            let recipe = recipe(args)?;
            let typed = args.set.iter().filter_map(|a| Some(a.split_once('=')?.0));
            recipe.refuse_unused(typed).map_err(|e| e.at("--set"))?;
            if args.follow && on_storage {
                return Err(Error::input("--follow needs a local capture and a local run")
                    .remedy("Copy the images to a local folder while they are recorded.")
                    .into());
            }
            if args.follow {
                following::follow(source, &recipe, &options, &stop, &watched)?
            } else if on_storage {
                train_on_storage(args, source, &recipe, &options, &stop, &watched)?
            } else {
                training::train(source, &recipe, &options, &stop, &watched)?
            }
        }
    };
    let run = &trained.run;
    if trained.interrupted && storage::is_address(run) {
        return Err(Error::new(ErrorKind::Interrupted, "training was stopped, and its checkpoint is uploaded")
            .remedy("Run the same command again to continue")
            .into());
    }
    if trained.interrupted {
        let what = if Following::is(run) { "following" } else { "training" };
        let resume = format!("splat4d train --resume {}", in_command(run));
        watched.stopped(trained.iteration.unwrap_or(0), &resume);
        let after = trained.iteration.map_or_else(String::new, |n| format!(" after step {n}"));
        return Err(Error::new(ErrorKind::Interrupted, format!("{what} was stopped{after} and saved"))
            .remedy(format!("Continue with: {resume}"))
            .into());
    }
    if let Some(iteration) = trained.iteration {
        watched.show(run, iteration);
    }
    console.next(if args.chunk.is_some() { "status" } else { "view" }, run);
    console.emit(&json!({"type": "done", "run": run.to_string_lossy()}));
    if trained.iteration.is_some() && watched.is_on() && console.terminal() {
        console.print_line("the player keeps running until Ctrl-C");
        interrupt::stop_polled("stopping");
        serving::wait(&stop);
    }
    Ok(())
}

#[cfg(feature = "storage")]
fn train_on_storage(
    args: &Args,
    source: &Path,
    recipe: &Recipe,
    options: &TrainingOptions,
    stop: &AtomicBool,
    watched: &Watched<'_>,
) -> anyhow::Result<Trained> {
    Ok(splat4d_workflow::storage::train(source, recipe, options, &args.storage.open(), stop, watched)?)
}

#[cfg(not(feature = "storage"))]
fn train_on_storage(
    Args { storage: _, .. }: &Args,
    _: &Path,
    _: &Recipe,
    _: &TrainingOptions,
    _: &AtomicBool,
    _: &Watched<'_>,
) -> anyhow::Result<Trained> {
    storage::refused()
}

/// The recipe file, then the quality, then the options, then every --set.
fn recipe(args: &Args) -> anyhow::Result<Recipe> {
    let mut recipe = match &args.recipe {
        // The model is chosen by the capture; the library's default is one model.
        None => Recipe::default().with(|r| r.run.motion = MotionName::AUTO),
        Some(path) => {
            // An empty one, or one of the kernel that claims to be, would silently be the defaults.
            files::open(path)?;
            Recipe::from_toml(&files::read_text(path)?).map_err(|e| e.at(path.display()))?
        }
    };
    if let Some(quality) = args.quality {
        recipe = recipe.of_quality(quality);
    }
    let typed = |name: &str| {
        args.set.iter().any(|a| a.split_once('=').is_some_and(|(key, _)| Recipe::key_of(key.trim()) == name))
    };
    // A length other than the file's gets its own schedule.
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
    set("follow.timeout", args.follow_timeout.map(|v| v.to_string()))?;
    set("max_cap", args.max_cap.map(|v| v.to_string()))?;
    set("sh_degree", args.sh_degree.map(|v| v.to_string()))?;
    for assignment in &args.set {
        recipe.set(assignment).map_err(|e| e.at("--set"))?;
    }
    Ok(recipe)
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
        .map(|key| settings.iter().find(|k| k.key() == *key).expect("IMPORTANT lists settings of the recipe"))
        .map(|setting| format!("  {}\n      {}\n", names(setting), meaning(setting)))
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

/// A setting in one line: its names, meaning, unit and default.
fn line(setting: &Setting) -> String {
    format!("  {:<42} {}\n", names(setting), meaning(setting))
}

/// The key of a setting, and the name by which it is also known.
fn names(setting: &Setting) -> String {
    let alone = Recipe::flat_name(&setting.key())
        .filter(|n| *n != setting.field)
        .map_or_else(String::new, |n| format!(" ({n})"));
    format!("{}{alone}", setting.key())
}

/// The meaning, unit and default of a setting.
fn meaning(setting: &Setting) -> String {
    let default = if setting.default == "\"\"" { "empty" } else { &setting.default };
    let unit = if setting.rule.unit.is_empty() { String::new() } else { format!(" {}", setting.rule.unit) };
    format!("{} [{default}{unit}]", setting.doc.trim_end_matches('.'))
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

    /// The recipe after these arguments.
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
