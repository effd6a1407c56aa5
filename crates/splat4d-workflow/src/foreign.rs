//! Any scene, of a run or of another program, scored on the views of a capture.

use crate::adopting::OnCapture;
use crate::device::present;
use crate::evaluating::{Measure, on_backgrounds, print_split};
use crate::events::Listener;
use crate::source::{Source, not_empty};
use splat4d::layers::Scene;
use splat4d::{Error, Result};
use splat4d_train::capture::{Capture, ImageStore};
use splat4d_train::eval::run::{EvalOptions, Measured, assess, evaluate};
use splat4d_train::event::Event;
use splat4d_train::output::{Input, Mixes, OutputFolder, Request};
use splat4d_train::recipe::Recipe;
use splat4d_train::run::open_capture;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Options of [`score`].
#[derive(Clone, Debug)]
pub struct ForeignOptions<'a> {
    /// Views to measure, as `train` takes them. `None`: the capture's convention.
    pub hold_out: Option<String>,
    /// Divide the images' size by this.
    pub downscale: Option<usize>,
    /// Folder for scores and images. `None`: they are only reported.
    pub output: Option<PathBuf>,
    /// Replace an earlier output in the folder.
    pub force: bool,
    /// The split to measure.
    pub measured: Measured,
    /// Background of transparent pixels, by name. None: the capture's own background.
    pub backgrounds: &'a [(&'a str, [f32; 3])],
}

impl Default for ForeignOptions<'_> {
    fn default() -> Self {
        Self { hold_out: None, downscale: None, output: None, force: false, measured: Measured::Test, backgrounds: &[] }
    }
}

/// Scores any scene (a file, numbered files, a run) on the views of a capture.
///
/// Errors: the capture has no such views; images without alpha, which are composited on nothing; no scene; `stop` was
/// raised.
pub fn score(
    path: &Path,
    capture: &Path,
    options: &ForeignOptions<'_>,
    measure: &Measure,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<()> {
    let shown =
        OnCapture { capture: capture.to_owned(), hold_out: options.hold_out.clone(), downscale: options.downscale };
    let mut recipe = shown.recipe()?;
    let on = open_capture(capture, &recipe)?;
    let (first, last) = on.time_range();
    let source = Source::open_on(path, [first, last])?.finite();
    not_empty(&source.scene, path)?;
    source.warnings.lines().iter().for_each(|w| console.warn(&format!("{w}.")));
    if let Some(run) = &source.run {
        recipe.appearance.antialias = run.recipe()?.appearance.antialias;
    }
    let folder = options.output.as_ref().map(|output| {
        let inputs = [
            Input { may_hold: source.run.is_some(), ..Input::new(path, "the scene") },
            Input::new(capture, "the capture"),
        ];
        let asked = format!("{} on {}", path.display(), capture.display());
        let request =
            Request { command: "eval", inputs: &inputs, asked: &asked, force: options.force, mixes: Mixes::Anything };
        OutputFolder::begin(output, &request).map(|(folder, _)| folder)
    });
    let folder = folder.transpose()?;
    let out = folder.as_ref().map(OutputFolder::path);
    foreign_scores(source.scene, &on, &recipe, out, options.measured, options.backgrounds, measure, stop, console)?;
    if let Some(folder) = folder {
        folder.finished();
    }
    Ok(())
}

/// Scores a scene that is not a run's on views of a capture, and writes scores and images into `out`, if there is such
/// a folder.
///
/// Errors: the capture has no such views; images without alpha, which are composited on nothing; those of measuring.
#[allow(clippy::too_many_arguments)]
fn foreign_scores(
    mut scene: Scene<f32>,
    capture: &Capture,
    recipe: &Recipe,
    out: Option<&Path>,
    measured: Measured,
    backgrounds: &[(&str, [f32; 3])],
    measure: &Measure,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<()> {
    let mut capture = capture.clone();
    capture.coarse().into_iter().for_each(|w| console.warn(w));
    if capture.offset != scene.offset {
        capture.relocate(scene.offset);
    }
    if measured.frames(&capture).is_empty() {
        return Err(Error::input(format!("the capture has no views of the split `{}`", measured.name()))
            .remedy("Choose them with option `hold_out`, for instance option `hold_out` every=8, or measure option `split` train."));
    }
    if !backgrounds.is_empty() && capture.background.is_none() {
        return Err(Error::input("the capture's images have no transparent pixels, and so no background to choose")
            .remedy("Leave option `background` out."));
    }
    for (name, background) in on_backgrounds(capture.background, backgrounds) {
        scene.background = background.unwrap_or(scene.background);
        let capture = Arc::new(Capture { background, ..capture.clone() });
        let memory = usize::try_from(recipe.run.image_memory).unwrap_or(usize::MAX);
        let store = Arc::new(ImageStore::new(capture.clone(), memory));
        let options = EvalOptions {
            folder: out.map(Path::to_owned).unwrap_or_default(),
            antialias: recipe.appearance.antialias,
            lpips_weights: measure.lpips_weights.clone(),
            pictures: out.is_some(),
            train_views: 0,
            measured,
            place: (!name.is_empty()).then(|| format!("{}-{name}", measured.name())),
            device: present(measure.device),
            ..EvalOptions::default()
        };
        let mut listen = |event: &Event| console.event(event);
        let scores = match out {
            Some(_) => evaluate(&scene, &capture, &store, 0, &options, stop, &mut listen)?,
            None => assess(&scene, &capture, &store, 0, &options, stop, &mut listen)?,
        };
        console.clear();
        print_split(&scores, measured, name, console);
    }
    Ok(())
}
