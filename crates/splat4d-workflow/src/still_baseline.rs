//! A static scene of the same recipe, trained once next to a run, to compare with.

use crate::evaluating::{self, Measure};
use crate::events::Listener;
use crate::run_folder::{Run, write_cameras};
use crate::source::read_scene;
use crate::{camera_file, files};
use serde_json::{Value, json};
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::eval::run::EvalOptions;
use splat4d_train::output::OutputFolder;
use splat4d_train::recipe::MotionName;
use splat4d_train::run::{self, TrainOptions};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Folder of the still scene, in the run.
const BASELINE: &str = "baseline";

/// Trains the still scene unless it is there, and measures it.
///
/// Errors: those of training and measuring; `stop` was raised.
pub fn baseline(
    out: &OutputFolder,
    run: &Run,
    measure: &Measure,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<()> {
    let path = out.path();
    let folder = path.join(BASELINE);
    let recipe = run.recipe()?.with(|r| r.run.motion = MotionName::of("still"));
    let cached = Run::is_finished(&folder)
        && Run::open(&folder).and_then(|b| b.recipe()).is_ok_and(|b| b.resolve() == recipe.resolve());
    if !cached {
        console.result("training a static scene with the same recipe, to compare");
        out.clear_inner(BASELINE)?;
        let (capture, _) = run.open_capture()?;
        files::make_folder(&folder)?;
        write_cameras(&folder, &capture)?;
        console.stop_polled("stopping");
        let options = TrainOptions::default();
        let outcome =
            run::train(Arc::new(capture), recipe, &folder, &options, stop, &mut |event| console.event(event))?;
        console.clear();
        if outcome.interrupted {
            return Err(Error::new(ErrorKind::Interrupted, "the static scene is unfinished")
                .remedy("Run `splat4d eval --baseline` again; it trains again."));
        }
        console.stop_not_polled("the static scene is kept, and the same command makes the rest");
    }
    let scene = read_scene(&Run::open(&folder)?.scene_file()?)?;
    let evaluation = evaluating::scores(&folder, &scene, measure, stop, console)?;
    let scores: Value = evaluation.report.results()[evaluation.report.method()].clone();
    let results = path.join("results.json");
    let mut all = if results.is_file() {
        camera_file::json(&files::read_text(&results)?).map_err(|e| e.at(results.display()))?
    } else {
        json!({})
    };
    if let Some(map) = all.as_object_mut() {
        map.insert(EvalOptions::STILL.into(), scores);
    }
    let text = serde_json::to_string_pretty(&all).expect("results are plain data");
    files::write(&results, text.as_bytes())
}
