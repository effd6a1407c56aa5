//! `eval`: measures a run again, perhaps next to a scene that stands still.

use crate::console::Console;
use crate::finish;
use crate::run_folder::{Run, cameras_json};
use crate::source::read_scene;
use serde_json::{Value, json};
use splat4d::ErrorKind;
use splat4d_train::eval::run::EvalOptions;
use splat4d_train::recipe::MotionName;
use splat4d_train::train::{self, TrainOptions};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const EXAMPLES: &str = "\
Examples:
  splat4d eval runs/knight                 scores, pictures, film and report again
  splat4d eval runs/knight --baseline      how much does motion gain over a still scene?
  splat4d eval runs/knight --lpips-weights vgg.safetensors --json

Results are in RUN/results.json and RUN/per_view.json (keys as 3DGS writes them), pictures in RUN/test/ours_N.";

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
    #[command(flatten)]
    measure: finish::Measure,

    #[arg(short = 'm', long = "model-path", alias = "model_path", hide = true, conflicts_with = "run")]
    model: Option<PathBuf>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    args.measure.check()?;
    let path = args.run.as_ref().or(args.model.as_ref()).expect("clap asks for a run");
    let run = Run::open(path)?;
    run.scene_file()?;
    if args.baseline {
        baseline(path, &run, args, console)?;
    }
    if args.no_film {
        let scene = read_scene(&run.scene_file()?)?;
        finish::scores(path, &scene, &args.measure, console)?;
        return finish::write_report(path, console);
    }
    finish::all(path, &args.measure, console)
}

/// Trains the still scene unless it is there, and measures it.
fn baseline(path: &Path, run: &Run, args: &Args, console: &Console) -> anyhow::Result<()> {
    let folder = path.join("baseline");
    let recipe = run.recipe()?.with(|r| r.run.motion = MotionName::of("still"));
    let cached = Run::is_finished(&folder)
        && Run::open(&folder).and_then(|b| b.recipe()).is_ok_and(|b| b.resolve() == recipe.resolve());
    if !cached {
        console.say("training a still scene with the same recipe, to compare");
        crate::run_folder::clear(&folder)?;
        let (capture, _) = run.open_capture()?;
        crate::files::make_folder(&folder)?;
        crate::files::write(&folder.join("cameras.json"), &serde_json::to_vec(&cameras_json(&capture))?)?;
        let stop = crate::interrupt::flag("stopping");
        let options = TrainOptions::default();
        let outcome =
            train::train(Arc::new(capture), recipe, &folder, &options, &stop, &mut |event| console.event(event))?;
        console.clear();
        if outcome.interrupted {
            return Err(splat4d::Error::new(ErrorKind::Interrupted, "the still scene is unfinished")
                .remedy("Run `splat4d eval --baseline` again; it trains anew.")
                .into());
        }
    }
    let scene = read_scene(&Run::open(&folder)?.scene_file()?)?;
    let evaluation = finish::scores(&folder, &scene, &args.measure, console)?;
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
