//! `eval`: measures a run again, perhaps next to a scene that stands still.

use crate::console::Console;
use crate::deadline::Deadline;
use crate::device::{self, Device};
use crate::finish;
use crate::run_folder::{Run, cameras_json};
use crate::source::{Source, not_empty, read_scene};
use serde_json::{Value, json};
use splat4d::ErrorKind;
use splat4d_train::eval::run::{EvalOptions, Measured};
use splat4d_train::output::{Input, Mixes, OutputFolder, Request};
use splat4d_train::recipe::{MotionName, Recipe};
use splat4d_train::run::{self, TrainOptions, open_capture};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const EXAMPLES: &str = "\
Examples:
  splat4d eval runs/knight                     scores, images, film and report again
  splat4d eval runs/knight --baseline          compare with a static scene
  splat4d eval runs/knight --lpips-weights vgg.safetensors --json
  splat4d eval runs/mutant --background both   on white and on black
  splat4d eval runs/mutant --split val         validation views
  splat4d eval runs/take --truth calibrated    distance of its cameras from ground truth
  splat4d eval other.ply --capture my-take     any scene on a capture's held-out views

Results are in RUN/results.json and RUN/per_view.json (keys as in 3DGS), images in RUN/test/ours_N. --split and \
--background only compute scores; results of another split or background have their own entry and folder, such as \
`val` or `test-black`.";

/// Folder of the still scene, in the run.
const BASELINE: &str = "baseline";

/// What transparent pixels are composited on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Background {
    /// Black
    Black,
    /// White
    White,
    /// White, then black
    Both,
}

impl Background {
    fn colors(self) -> &'static [(&'static str, [f32; 3])] {
        const ALL: [(&str, [f32; 3]); 2] = [("white", [1.0; 3]), ("black", [0.0; 3])];
        match self {
            Self::White => &ALL[..1],
            Self::Black => &ALL[1..],
            Self::Both => &ALL,
        }
    }
}

/// The views to measure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Split {
    /// Held-out views
    Test,
    /// The data set's validation views
    Val,
    /// All training views
    Train,
}

impl Split {
    fn measured(self) -> Measured {
        match self {
            Self::Test => Measured::Test,
            Self::Val => Measured::Validation,
            Self::Train => Measured::Train,
        }
    }
}

/// Measure a run on held-out views
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run; with --capture any scene: a file, numbered files, a run
    #[arg(value_name = "RUN", required_unless_present = "model")]
    run: Option<PathBuf>,
    /// Score any scene on the held-out views of this capture
    #[arg(long, value_name = "CAPTURE", conflicts_with_all = ["baseline", "no_film", "truth", "model"], help_heading = "Any scene")]
    capture: Option<PathBuf>,
    /// Views to measure with --capture, as `train` takes them [default: the capture's convention]
    #[arg(long, value_name = "VIEWS", requires = "capture", help_heading = "Any scene")]
    hold_out: Option<String>,
    /// Divide the images' size by this with --capture
    #[arg(long, value_name = "K", requires = "capture", help_heading = "Any scene")]
    downscale: Option<usize>,
    /// Folder for the scores and images of --capture [default: they are only printed]
    #[arg(short, long, value_name = "FOLDER", requires = "capture", help_heading = "Any scene")]
    output: Option<PathBuf>,
    /// Replace an earlier output of this command in the folder
    #[arg(long, requires = "output", help_heading = "Any scene")]
    force: bool,
    /// Train a static scene with the same recipe and steps (once, in RUN/baseline) and compare
    #[arg(long)]
    baseline: bool,
    /// Only scores and report, no orbit film
    #[arg(long)]
    no_film: bool,
    /// Measure these views, scores only [default: test]
    #[arg(long, value_enum, conflicts_with = "baseline", help_heading = "Evaluation")]
    split: Option<Split>,
    /// Background of transparent pixels, scores only [default: the run's]
    #[arg(long, value_enum, conflicts_with = "baseline", help_heading = "Evaluation")]
    background: Option<Background>,
    /// Compare the run's training cameras with the ground truth of this capture, and only that: absolute and relative
    /// trajectory error after a similarity, and time offsets
    #[arg(long, value_name = "CAPTURE", conflicts_with_all = ["baseline", "split", "background"],
          help_heading = "Evaluation")]
    truth: Option<PathBuf>,
    /// Device that renders the views; the CPU computes the metrics
    #[arg(long, value_enum, default_value = "cpu", help_heading = "Device")]
    device: Device,
    #[command(flatten)]
    measure: finish::Measure,

    #[arg(short = 'm', long = "model-path", alias = "model_path", hide = true, conflicts_with = "run")]
    model: Option<PathBuf>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    args.measure.check()?;
    let lpips_weights = args.measure.lpips_weights.clone();
    let measure = finish::Measure { lpips_weights, device: device::chosen(args.device, "measuring", console) };
    let path = args.run.as_ref().or(args.model.as_ref()).expect("clap asks for a run");
    if let Some(capture) = &args.capture {
        return on_capture(args, path, capture, &measure, console);
    }
    let run = Run::open(path)?;
    run.scene_file()?;
    let folder = OutputFolder::amend(path, "eval")?;
    if let Some(truth) = &args.truth {
        return finish::trajectory(path, truth, console);
    }
    if args.split.is_some() || args.background.is_some() {
        let split = args.split.unwrap_or(Split::Test).measured();
        let backgrounds = args.background.map_or(&[][..], Background::colors);
        finish::scores_on(path, split, backgrounds, &measure, console)?;
        return finish::write_page(path, console);
    }
    if args.baseline {
        baseline(&folder, &run, &measure, console)?;
    }
    if args.no_film {
        let scene = read_scene(&run.scene_file()?)?;
        finish::scores(path, &scene, &measure, console)?;
        return finish::write_report(path, console);
    }
    finish::all(path, &measure, &Deadline::default(), console)
}

/// Scores any scene on the views of a capture.
fn on_capture(
    args: &Args,
    path: &Path,
    capture: &Path,
    measure: &finish::Measure,
    console: &Console,
) -> anyhow::Result<()> {
    let mut recipe = Recipe::default();
    let wanted = [
        ("hold_out", args.hold_out.as_ref().map(|v| format!("{v:?}"))),
        ("downscale", args.downscale.map(|k| k.to_string())),
    ];
    for (name, value) in wanted {
        value.map_or(Ok(()), |value| recipe.set(&format!("{name}={value}")))?;
    }
    let source = Source::open(path)?.finite();
    not_empty(&source.scene, path)?;
    source.warnings.lines().iter().for_each(|w| console.warn(&format!("{w}.")));
    if let Some(run) = &source.run {
        recipe.appearance.antialias = run.recipe()?.appearance.antialias;
    }
    let folder = args.output.as_ref().map(|output| {
        let inputs = [
            Input { may_hold: source.run.is_some(), ..Input::new(path, "the scene") },
            Input::new(capture, "the capture"),
        ];
        let asked = format!("{} on {}", path.display(), capture.display());
        let request =
            Request { command: "eval", inputs: &inputs, asked: &asked, force: args.force, mixes: Mixes::Anything };
        OutputFolder::begin(output, &request).map(|(folder, _)| folder)
    });
    let folder = folder.transpose()?;
    let split = args.split.unwrap_or(Split::Test).measured();
    let backgrounds = args.background.map_or(&[][..], Background::colors);
    let out = folder.as_ref().map(OutputFolder::path);
    finish::foreign_scores(
        source.scene,
        &open_capture(capture, &recipe)?,
        &recipe,
        out,
        split,
        backgrounds,
        measure,
        console,
    )?;
    if let Some(folder) = folder {
        folder.finished();
    }
    Ok(())
}

/// Trains the still scene unless it is there, and measures it.
fn baseline(out: &OutputFolder, run: &Run, measure: &finish::Measure, console: &Console) -> anyhow::Result<()> {
    let path = out.path();
    let folder = path.join(BASELINE);
    let recipe = run.recipe()?.with(|r| r.run.motion = MotionName::of("still"));
    let cached = Run::is_finished(&folder)
        && Run::open(&folder).and_then(|b| b.recipe()).is_ok_and(|b| b.resolve() == recipe.resolve());
    if !cached {
        console.say("training a still scene with the same recipe, to compare");
        out.clear_inner(BASELINE)?;
        let (capture, _) = run.open_capture()?;
        crate::files::make_folder(&folder)?;
        crate::files::write(&folder.join("cameras.json"), &serde_json::to_vec(&cameras_json(&capture))?)?;
        let stop = crate::interrupt::flag("stopping");
        let options = TrainOptions::default();
        let outcome =
            run::train(Arc::new(capture), recipe, &folder, &options, &stop, &mut |event| console.event(event))?;
        console.clear();
        if outcome.interrupted {
            return Err(splat4d::Error::new(ErrorKind::Interrupted, "the still scene is unfinished")
                .remedy("Run `splat4d eval --baseline` again; it trains again.")
                .into());
        }
        crate::interrupt::ends("the still scene is kept, and the same command makes what is missing");
    }
    let scene = read_scene(&Run::open(&folder)?.scene_file()?)?;
    let evaluation = finish::scores(&folder, &scene, measure, console)?;
    let scores: Value = evaluation.report.results()[evaluation.report.method()].clone();
    let results = path.join("results.json");
    let mut all = if results.is_file() {
        crate::camera_file::json(&crate::files::read_text(&results)?).map_err(|e| e.at(results.display()))?
    } else {
        json!({})
    };
    if let Some(map) = all.as_object_mut() {
        map.insert(EvalOptions::STILL.into(), scores);
    }
    crate::files::write(&results, serde_json::to_string_pretty(&all)?.as_bytes())?;
    Ok(())
}
