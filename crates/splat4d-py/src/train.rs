//! Training from Python: the command's `train` without its console. The same recipe gives the same bits.

use crate::capture::Capture;
use crate::errors::{OrRaise, in_python, warn};
use crate::loss::{Raised, own_loss};
use crate::motion::Hook;
use crate::plain::plain;
use crate::run::Run;
use crate::scene::named;
use crate::settings::set;
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict};
use splat4d::Result;
use splat4d_train::event::Event;
use splat4d_train::output::{FolderContent, OutputFolder};
use splat4d_train::recipe::{MotionName, Quality, Recipe};
use splat4d_train::run::{self, Outcome, Stopwatch, TrainOptions, open_capture};
use splat4d_workflow::run_folder;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Trains a scene of a capture (a Capture, or its path) into the folder `out` [runs/NAME] and returns the run.
///
/// `settings` are those of docs/recipe.md: `iterations=300`, `downscale=2`; a setting of a table has two underscores,
/// `densify__max_cap=20000`. `motion` is the name of a motion model or a `Motion` of your own; without one, the capture
/// decides. `progress` is called with every event, a dict as in docs/events.md; without one, a bar is shown on terminals and in
/// notebooks, and with `progress=False` nothing is. `loss(image, truth, view)` gets arrays [h, w, 3] and returns (value,
/// gradient), which are added to the recipe's losses; in the first 40 % of the steps the arrays have half of the size, with
/// `half_size_until=0` always the full one. `force` replaces a run that is in `out` already. Ctrl-C, or an exception in a
/// function of yours, stops with a checkpoint; `resume` continues from there.
#[pyfunction]
#[pyo3(signature = (
    capture, out=None, *, motion=None, progress=None, loss=None, minutes=None, quality=None, device="cpu", force=false,
    **settings
))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train(
    py: Python<'_>,
    capture: &Bound<'_, PyAny>,
    out: Option<PathBuf>,
    motion: Option<&Bound<'_, PyAny>>,
    progress: Option<Py<PyAny>>,
    loss: Option<Py<PyAny>>,
    minutes: Option<f64>,
    quality: Option<&str>,
    device: &str,
    force: bool,
    settings: Option<&Bound<'_, PyDict>>,
) -> PyResult<Run> {
    let mut recipe = Recipe::default().with(|r| r.run.motion = MotionName::AUTO);
    let path = match capture.cast::<Capture>() {
        Ok(capture) => {
            recipe.capture = capture.get().settings.clone();
            capture.get().path.clone()
        }
        Err(_) => capture.extract::<PathBuf>()?,
    };
    if let Some(quality) = quality {
        recipe = recipe.of_quality(quality.parse::<Quality>().or_raise()?);
    }
    let mut raised = Arc::<Raised>::default();
    if let Some(motion) = motion {
        let name = match motion.extract::<String>() {
            Ok(name) => name,
            Err(_) => {
                let hook = Hook::register(motion)?;
                raised = hook.raised.clone();
                hook.name().to_owned()
            }
        };
        recipe.set(&format!("motion={name}")).or_raise()?;
    }
    let names = set(&mut recipe, settings)?;
    recipe.refuse_unused(names.iter().map(String::as_str)).or_raise()?;
    let options =
        TrainOptions { device: named(device)?, minutes, clock: Stopwatch::start(), ..TrainOptions::default() };
    let listener = Listener::new(py, progress, loss, raised)?;
    listener.drive(py, options, |options, listen| {
        let capture = open_capture(&path, &recipe)?;
        let run = out.unwrap_or_else(|| run_folder::free_folder(&run_folder::usual_folder(&capture.name)));
        let asked = run_folder::RunRequest::of(&capture, &recipe, minutes, false);
        let (folder, found) = asked.begin(&run, force, "train (Python)")?;
        let stop = &listener.raised.stop;
        let mut on_event = |event: &Event| {
            run_folder::on_event(&folder, event);
            listen(event);
        };
        let trained = if found == FolderContent::Unfinished {
            run::resume_with(&run, options, stop, &mut on_event)
        } else {
            run::checkpoint::write_atomically(&run.join("recipe.toml"), recipe.to_toml().as_bytes())?;
            let cameras = run_folder::cameras_json(&capture).to_string();
            run::checkpoint::write_atomically(&run.join("cameras.json"), cameras.as_bytes())?;
            run::train(Arc::new(capture), recipe, &run, options, stop, &mut on_event)
        };
        if let Some(folder) = run_folder::left(folder, &run, &trained)
            && trained.as_ref().is_ok_and(|outcome| !outcome.interrupted)
        {
            folder.finished();
        }
        trained
    })
}

/// Continues the run in a folder from its newest checkpoint. A run that started with a `loss` or a `Motion` needs it again.
#[pyfunction]
#[pyo3(signature = (run, *, motion=None, progress=None, loss=None, device="cpu"))]
pub(crate) fn resume(
    py: Python<'_>,
    run: &Bound<'_, PyAny>,
    motion: Option<&Bound<'_, PyAny>>,
    progress: Option<Py<PyAny>>,
    loss: Option<Py<PyAny>>,
    device: &str,
) -> PyResult<Run> {
    let path = match run.cast::<Run>() {
        Ok(run) => run.get().path.clone(),
        Err(_) => run.extract::<PathBuf>()?,
    };
    let options = TrainOptions { device: named(device)?, clock: Stopwatch::start(), ..TrainOptions::default() };
    let raised = motion.map(Hook::register).transpose()?.map_or_else(Arc::default, |hook| hook.raised.clone());
    let listener = Listener::new(py, progress, loss, raised)?;
    listener.drive(py, options, |options, listen| {
        // A folder that is no run is refused below, and nothing is written into it.
        let is_run = path.join("recipe.toml").is_file();
        let _folder = is_run.then(|| OutputFolder::amend(&path, "resume (Python)")).transpose()?;
        run::resume_with(&path, options, &listener.raised.stop, listen)
    })
}

/// Who hears of a run, and may end it.
struct Listener {
    progress: Option<Py<PyAny>>,
    /// Whether the caller's own function hears of warnings; they are Python's otherwise.
    told: bool,
    loss: Option<Py<PyAny>>,
    raised: Arc<Raised>,
}

impl Listener {
    /// `progress`: a function, False for none, or nothing for a bar on a terminal or in a notebook.
    fn new(
        py: Python<'_>,
        progress: Option<Py<PyAny>>,
        loss: Option<Py<PyAny>>,
        raised: Arc<Raised>,
    ) -> PyResult<Self> {
        let silent = progress.as_ref().is_some_and(|p| p.bind(py).is(&*PyBool::new(py, false)));
        let (told, progress) = match progress {
            Some(_) if silent => (false, None),
            Some(function) => (true, Some(function)),
            None => (false, py.import("splat4d.progress")?.call_method0("shown")?.extract::<Option<Py<PyAny>>>()?),
        };
        Ok(Self { progress, told, loss, raised })
    }

    /// Does the work without Python's lock, hears its events with it, and raises what was raised meanwhile.
    fn drive(
        &self,
        py: Python<'_>,
        options: TrainOptions,
        work: impl FnOnce(&TrainOptions, &mut dyn FnMut(&Event)) -> Result<Outcome> + Send,
    ) -> PyResult<Run> {
        let own_loss = self.loss.as_ref().map(|f| own_loss(f.clone_ref(py), &self.raised));
        let options = TrainOptions { own_loss, ..options };
        let done = py.detach(|| {
            work(&options, &mut |event| {
                if let Err(error) = Python::attach(|py| self.on_event(py, event)) {
                    self.raised.raise(error);
                }
            })
        });
        match (done, self.raised.take()) {
            (Ok(outcome), None) => Ok(Run { path: outcome.run }),
            (Ok(outcome), Some(error)) => {
                note(py, &error, &outcome.run);
                Err(error)
            }
            (Err(_), Some(error)) => Err(error),
            (Err(error), None) => Err(in_python(&error)),
        }
    }

    fn on_event(&self, py: Python<'_>, event: &Event) -> PyResult<()> {
        // Ctrl-C, and whatever other signals have Python functions.
        py.check_signals()?;
        if let Some(progress) = &self.progress {
            let value = serde_json::to_value(event).expect("events are plain data");
            progress.call1(py, (plain(py, &value)?,))?;
        }
        match event {
            Event::Warning { message } if !self.told => warn(py, std::slice::from_ref(message)),
            _ => Ok(()),
        }
    }
}

/// Adds to an exception where the run is saved, where Python has room for that (3.11).
fn note(py: Python<'_>, error: &PyErr, run: &Path) {
    let text = format!("The run is saved in {0}; go on with splat4d.resume({0:?})", run.display());
    let _ = error.value(py).call_method1("add_note", (text,));
}
