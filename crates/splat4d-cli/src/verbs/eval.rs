//! `eval`: measures a run again, perhaps next to a scene that stands still.

use crate::console::Console;
use crate::deadline::Deadline;
use crate::device::{self, Device};
use crate::finish;
use crate::run_folder::{Run, cameras_json};
use crate::source::read_scene;
use serde_json::{Value, json};
use splat4d::ErrorKind;
use splat4d_train::eval::run::{EvalOptions, Measured};
use splat4d_train::output::OutputFolder;
use splat4d_train::recipe::MotionName;
use splat4d_train::run::{self, TrainOptions};
use std::path::PathBuf;
use std::sync::Arc;

const EXAMPLES: &str = "\
Examples:
  splat4d eval runs/knight                 scores, pictures, film and report again
  splat4d eval runs/knight --baseline      how much does motion gain over a still scene?
  splat4d eval runs/knight --lpips-weights vgg.safetensors --json
  splat4d eval runs/mutant --background both   on white and on black
  splat4d eval runs/mutant --split val         on views to choose by; the test views are for the end
  splat4d eval runs/take --truth calibrated    how far are its cameras from where they truly stood?

Results are in RUN/results.json and RUN/per_view.json (keys as 3DGS writes them), pictures in RUN/test/ours_N. With --split
or --background only scores are made; what is not the test split on the run's own background stands under an entry and in a
folder of its own, such as `val` or `test-black`.";

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
    /// The views that were held out
    Test,
    /// The data set's validation views
    Val,
    /// All views that were trained on
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

/// Measure a run on the views that training never saw
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run
    #[arg(value_name = "RUN", required_unless_present = "model")]
    run: Option<PathBuf>,
    /// Train a still scene with the same recipe and steps (once; kept in RUN/baseline) and compare
    #[arg(long)]
    baseline: bool,
    /// Only scores and report, no orbit film
    #[arg(long)]
    no_film: bool,
    /// Measure these views, and make nothing but scores [default: test]
    #[arg(long, value_enum, conflicts_with = "baseline", help_heading = "What is measured")]
    split: Option<Split>,
    /// Composite transparent pixels of pictures and renders on this, and make nothing but scores [default: as the run]
    #[arg(long, value_enum, conflicts_with = "baseline", help_heading = "What is measured")]
    background: Option<Background>,
    /// Compare the training cameras, as the run has them, with this capture's, which are right, and make nothing but that:
    /// absolute and relative trajectory error after a similarity, and clocks
    #[arg(long, value_name = "CAPTURE", conflicts_with_all = ["baseline", "split", "background"],
          help_heading = "What is measured")]
    truth: Option<PathBuf>,
    /// What draws the views; the metrics are computed on the CPU
    #[arg(long, value_enum, default_value = "cpu", help_heading = "What computes")]
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
                .remedy("Run `splat4d eval --baseline` again; it trains anew.")
                .into());
        }
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
