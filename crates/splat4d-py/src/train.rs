//! Training from Python: the workflow of the command's `train`. The same recipe gives the same bits.

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
use splat4d_train::recipe::{MotionName, Quality, Recipe};
use splat4d_train::run::follow::Following;
use splat4d_workflow::evaluating::Measure;
use splat4d_workflow::events as workflow;
use splat4d_workflow::following;
use splat4d_workflow::training::{self, Finish, Trained, TrainingOptions};
use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Trains a scene of a capture (a Capture, or its path) into the folder `out` [runs/NAME] and returns the run.
///
/// `settings` are those of docs/recipe.md: `iterations=300`, `downscale=2`; a setting of a table has two underscores,
/// `densify__max_cap=20000`. `motion` is the name of a motion model or a `Motion` of your own; without one, the capture
/// decides. `progress` is called with every event, a dict as in docs/events.md; without one, a bar is shown on
/// terminals and in notebooks, and with `progress=False` nothing is. `loss(image, truth, view)` gets arrays [h, w, 3]
/// and returns (value, gradient), which are added to the recipe's losses; in the first 40 % of the steps the arrays
/// have half of the size, with `half_size_until=0` always the full one. `evaluate`: afterwards bake the playback file,
/// measure held-out views, film an orbit and write the report, as the command does; `minutes` includes it. `force`
/// replaces a run that is in `out` already. `follow` trains the capture while it is being filmed, frame by frame
/// (docs/follow.md); its settings are those of the table `follow`, `follow__timeout=10`. Ctrl-C, or an exception in a function of yours, stops with a checkpoint;
/// `resume` continues from there.
#[pyfunction]
#[pyo3(signature = (
    capture, out=None, *, motion=None, progress=None, loss=None, minutes=None, quality=None, device="auto", evaluate=false,
    force=false, follow=false, **settings
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
    evaluate: bool,
    force: bool,
    follow: bool,
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
    let options = TrainingOptions {
        output: out,
        force,
        minutes,
        device: named(device)?,
        measure: Measure { device: named(device)?, ..Measure::default() },
        finish: finish(evaluate),
        command: "train (Python)",
        ..TrainingOptions::default()
    };
    let listener = Listener::new(py, progress, loss, raised)?;
    listener.drive(py, options, |options, stop, listen| match follow {
        true => following::follow(&path, &recipe, options, stop, listen),
        false => training::train(&path, &recipe, options, stop, listen),
    })
}

fn finish(evaluate: bool) -> Finish {
    if evaluate { Finish::All } else { Finish::Scene }
}

/// Continues the run in a folder from its newest checkpoint. A run that started with a `loss` or a `Motion` needs it
/// again.
#[pyfunction]
#[pyo3(signature = (run, *, motion=None, progress=None, loss=None, device="auto", evaluate=false))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn resume(
    py: Python<'_>,
    run: &Bound<'_, PyAny>,
    motion: Option<&Bound<'_, PyAny>>,
    progress: Option<Py<PyAny>>,
    loss: Option<Py<PyAny>>,
    device: &str,
    evaluate: bool,
) -> PyResult<Run> {
    let path = match run.cast::<Run>() {
        Ok(run) => run.get().path.clone(),
        Err(_) => run.extract::<PathBuf>()?,
    };
    let options = TrainingOptions {
        device: named(device)?,
        measure: Measure { device: named(device)?, ..Measure::default() },
        finish: finish(evaluate),
        command: "resume (Python)",
        ..TrainingOptions::default()
    };
    let raised = motion.map(Hook::register).transpose()?.map_or_else(Arc::default, |hook| hook.raised.clone());
    let listener = Listener::new(py, progress, loss, raised)?;
    listener.drive(py, options, |options, stop, listen| match Following::is(&path) {
        true => following::resume(&path, options, stop, listen),
        false => training::resume(&path, options, stop, listen),
    })
}

/// Listeners of a run, which may end it.
struct Listener {
    progress: Option<Py<PyAny>>,
    /// Whether the caller's function gets warnings; otherwise they are Python warnings.
    listened: bool,
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
        let (listened, progress) = match progress {
            Some(_) if silent => (false, None),
            Some(function) => (true, Some(function)),
            None => (false, py.import("splat4d.progress")?.call_method0("shown")?.extract::<Option<Py<PyAny>>>()?),
        };
        Ok(Self { progress, listened, loss, raised })
    }

    /// Does the work without Python's lock, passes its events on with it, and raises what was raised meanwhile.
    fn drive(
        &self,
        py: Python<'_>,
        options: TrainingOptions,
        work: impl FnOnce(&TrainingOptions, &AtomicBool, &dyn workflow::Listener) -> Result<Trained> + Send,
    ) -> PyResult<Run> {
        let own_loss = self.loss.as_ref().map(|f| own_loss(f.clone_ref(py), &self.raised));
        let options = TrainingOptions { own_loss, ..options };
        let done = py.detach(|| {
            let listen = |event: &workflow::Event<'_>| {
                let event = match event {
                    workflow::Event::Training(event) => Cow::Borrowed(*event),
                    workflow::Event::Warning(message) => Cow::Owned(Event::Warning { message: (*message).into() }),
                    workflow::Event::Phase { name, done, total } => {
                        Cow::Owned(Event::Phase { name: (*name).into(), done: *done, total: *total })
                    }
                    _ => return,
                };
                if let Err(error) = Python::attach(|py| self.on_event(py, &event)) {
                    self.raised.raise(error);
                }
            };
            work(&options, &self.raised.stop, &listen)
        });
        match (done, self.raised.take()) {
            (Ok(trained), None) => Ok(Run { path: trained.run }),
            (Ok(trained), Some(error)) => {
                note(py, &error, &trained.run);
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
            Event::Warning { message } if !self.listened => warn(py, std::slice::from_ref(message)),
            _ => Ok(()),
        }
    }
}

/// Adds the run's folder to an exception, if Python supports notes (3.11).
fn note(py: Python<'_>, error: &PyErr, run: &Path) {
    let text = format!("The run is saved in {0}; continue with splat4d.resume({0:?})", run.display());
    let _ = error.value(py).call_method1("add_note", (text,));
}
