//! `eval`: measures a run again, optionally against a static scene.

use crate::console::Console;
use crate::device::Device;
use crate::interrupt;
use crate::measuring::MeasureArgs;
use splat4d_train::eval::run::Measured;
use splat4d_train::output::OutputFolder;
use splat4d_workflow::deadline::Deadline;
use splat4d_workflow::device::chosen;
use splat4d_workflow::evaluating::{self, Measure};
use splat4d_workflow::foreign::{self, ForeignOptions};
use splat4d_workflow::run_folder::Run;
use splat4d_workflow::source::read_scene;
use splat4d_workflow::still_baseline::baseline;
use std::path::PathBuf;

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

/// Background of transparent pixels.
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
    #[arg(long, value_enum, default_value = "auto", help_heading = "Device")]
    device: Device,
    #[command(flatten)]
    measure: MeasureArgs,

    #[arg(short = 'm', long = "model-path", alias = "model_path", hide = true, conflicts_with = "run")]
    model: Option<PathBuf>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    args.measure.check()?;
    let stop = interrupt::flag("stopping");
    interrupt::stop_not_polled("the same command begins again");
    let measure = Measure { device: chosen(args.device.into(), "measuring", console), ..args.measure.options() };
    let path = args.run.as_ref().or(args.model.as_ref()).expect("clap requires a run");
    if let Some(capture) = &args.capture {
        let options = ForeignOptions {
            hold_out: args.hold_out.clone(),
            downscale: args.downscale,
            output: args.output.clone(),
            force: args.force,
            measured: args.split.unwrap_or(Split::Test).measured(),
            backgrounds: args.background.map_or(&[][..], Background::colors),
        };
        foreign::score(path, capture, &options, &measure, &stop, console)?;
        options.output.iter().for_each(|folder| console.next("compare", folder));
        return Ok(());
    }
    let run = Run::open(path)?;
    run.scene_file()?;
    let folder = OutputFolder::amend(path, "eval")?;
    if let Some(truth) = &args.truth {
        return Ok(evaluating::trajectory(path, truth, console)?);
    }
    if args.split.is_some() || args.background.is_some() {
        let split = args.split.unwrap_or(Split::Test).measured();
        let backgrounds = args.background.map_or(&[][..], Background::colors);
        evaluating::scores_on(path, split, backgrounds, &measure, &stop, console)?;
        evaluating::write_page(path, console)?;
    } else {
        if args.baseline {
            baseline(&folder, &run, &measure, &stop, console)?;
        }
        if args.no_film {
            let scene = read_scene(&run.scene_file()?)?;
            evaluating::scores(path, &scene, &measure, &stop, console)?;
            evaluating::write_report(path, console)?;
        } else {
            evaluating::all(path, &measure, &Deadline::default(), &stop, console)?;
        }
    }
    console.next("view", path);
    Ok(())
}
