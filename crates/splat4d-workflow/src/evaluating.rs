//! Work after training: scores and renders of held-out views, the playback file, an orbit film and the report, within
//! what is left of `--minutes`.

use crate::baking::{Baking, bake_into};
use crate::deadline::{Deadline, unless_stopped};
use crate::device::present;
use crate::draw::{Channel, Painter};
use crate::events::Listener;
use crate::files::{self, human_seconds};
use crate::folding::fold;
use crate::ground_truth::points::point_errors;
use crate::ground_truth::tracks::track_error;
use crate::paths::{Clock, Route, Stage, orbit_seconds, shots};
use crate::playable;
use crate::report::{self, refined_in_words};
use crate::run_folder::{ORDER, Run};
use crate::source::{Source, not_empty, read_scene};
use crate::video::{Film, have_ffmpeg};
use serde_json::{Value, json};
use splat4d::bake;
use splat4d::device::Device;
use splat4d::layers::Scene;
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::capture::{Capture, CaptureKind, CaptureOptions, ImageStore, Timing};
use splat4d_train::eval::Align;
use splat4d_train::eval::flow::flow_error;
use splat4d_train::eval::run::{self as eval, EvalOptions, Measured, Scores};
use splat4d_train::eval::trajectory::trajectory_error;
use splat4d_train::event::Event;
use splat4d_train::output::OutputFolder;
use splat4d_train::path_text::in_command;
use splat4d_train::recipe::{MotionName, Recipe};
use splat4d_train::run::chunks::Chunked;
use splat4d_train::run::follow::Following;
use splat4d_train::run::{Stopwatch, corrected, run_options};
use splat4d_train::{features, labels};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Frames a second of the orbit film: cinema's, and a fifth less work than 30.
const ORBIT_FPS: f64 = 24.0;
/// The same where the film is an animated PNG, which grows ten times as large.
const ORBIT_FPS_PNG: f64 = 10.0;
/// Longer side of an animated PNG, pixels.
const ORBIT_SIDE_PNG: usize = 400;

/// Training steps that take as long as what follows training: a held-out view rendered, measured and written; a frame
/// of the film; the playback file, baked and compared with the scene. By the knight's 120 held-out views and 144
/// frames: 8 s where a step takes 25 ms (docs/benchmarks.md), and the same shares on a machine that hardly got any
/// time.
const HELD_STEPS: f64 = 1.5;
/// See [`HELD_STEPS`].
const FILM_STEPS: f64 = 0.5;
/// See [`HELD_STEPS`].
const BAKE_STEPS: f64 = 60.0;
/// The same of a model whose motion is not straight: a time sample of it, and all that follows sampling.
const SAMPLE_STEPS: f64 = 0.4;
/// See [`SAMPLE_STEPS`].
const CUT_STEPS: f64 = 100.0;
/// Motion models whose motion is straight, or nearly.
const STRAIGHT: [&str; 3] = ["still", "spacetime", "native4d"];

/// See [`HELD_STEPS`]: an image with a mask of labels or an image of features, rendered and backpropagated once.
const LABEL_STEPS: f64 = 1.0;

/// The time of the work after training, in training steps at full size: `--minutes` includes it.
pub fn steps(capture: &Capture, recipe: &Recipe, only_playback: bool) -> f64 {
    let frames = || capture.train.iter().map(|&i| &capture.frames[i]);
    let masks = frames().filter(|f| f.labels.is_some()).count().min(labels::MOST_PICTURES);
    let featured = frames().filter(|f| f.features.is_some()).count().min(features::MOST_PICTURES);
    let labels = (labels::ROUNDS * masks + (features::ROUNDS + 1) * featured) as f64 * LABEL_STEPS;
    let (first, last) = capture.time_range();
    // What `auto` chooses where cameras move is a network.
    let motion = recipe.run.motion;
    let moves = capture.cameras.iter().any(|c| !c.fixed) && capture.timing != Timing::Moment;
    let straight = STRAIGHT.iter().any(|name| motion == *name) || motion == MotionName::AUTO.as_str() && !moves;
    let samples = ((last - first) * capture.fps.max(bake::SAMPLE_RATE)).max(0.0);
    let bake = if straight { BAKE_STEPS } else { CUT_STEPS + SAMPLE_STEPS * samples };
    if only_playback {
        return bake + labels;
    }
    let fps = if have_ffmpeg() { ORBIT_FPS } else { ORBIT_FPS_PNG };
    labels + capture.held.len() as f64 * HELD_STEPS + orbit_seconds(last - first) * fps * FILM_STEPS + bake
}

/// Options of measuring.
#[derive(Clone, Debug, Default)]
pub struct Measure {
    /// Weights (safetensors) for LPIPS; without them it is not computed.
    pub lpips_weights: Option<PathBuf>,
    /// Device that renders the views.
    pub device: Device,
}

impl Measure {
    /// Finds missing files before hours of training.
    pub fn check(&self) -> Result<()> {
        match &self.lpips_weights {
            Some(path) if !path.is_file() => Err(Error::input("there is no such file")
                .at(path.display())
                .remedy("Name the LPIPS weights as a .safetensors file, or leave option `lpips_weights` out.")),
            _ => Ok(()),
        }
    }
}

/// Scores, playback file, film and report, as far as the time allows: the file always, within what is left.
///
/// Errors: the run has no scene; files that cannot be written; `stop` was raised.
pub fn all(
    run: &Path,
    measure: &Measure,
    deadline: &Deadline,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<()> {
    let opened = Run::open(run)?;
    let scene = read_scene(&opened.scene_file()?)?;
    let time = Times::estimate(&opened, &scene, deadline)?;
    if Times::leaves("the held-out views are not scored", [time.scores, time.playback], run, deadline, console) {
        let started = deadline.now();
        scores(run, &scene, measure, stop, console)?;
        amend(run, [("evaluation_seconds".into(), json!(deadline.now() - started))])?;
    }
    unless_stopped(stop)?;
    playback_by(run, deadline, console)?;
    if Times::leaves("the orbit film is missing", [time.film, 0.0], run, deadline, console) {
        let started = deadline.now();
        match orbit(run, &scene, stop, console) {
            Ok(film) => {
                console.written(&film);
                amend(run, [("orbit_seconds".into(), json!(deadline.now() - started))])?;
            }
            Err(error) if error.kind() == ErrorKind::Interrupted => return Err(error),
            // The scene and its scores are valid without the film.
            Err(error) => console.warn(&format!("the orbit film was not written: {error}")),
        }
    }
    write_report(run, console)
}

/// Remaining minutes of a resumed run: the time of earlier commands until the end of training counts once, and time
/// between commands does not count.
pub fn rest_of(run: &Run, clock: Stopwatch) -> Deadline {
    let budget = &run.info["budget"];
    let left = || Some(60.0 * budget["minutes"].as_f64()? - budget["before"].as_f64()? - run.number("seconds")?);
    match left() {
        Some(left) => Deadline::of(clock.clone(), Some((clock.seconds() + left) / 60.0)),
        None => Deadline::of(clock, None),
    }
}

/// Seconds that parts of what follows training take, by a render that is timed; zero where it is not needed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Times {
    scores: f64,
    playback: f64,
    film: f64,
}

impl Times {
    fn estimate(run: &Run, scene: &Scene<f32>, deadline: &Deadline) -> Result<Self> {
        if !deadline.is_set() {
            return Ok(Self::default());
        }
        let views = run.views()?;
        let Some(view) = views.iter().find(|v| v.held).or(views.first()) else { return Ok(Self::default()) };
        let mut painter = Painter::new(scene, scene.background, false, false);
        // The first one is a warm-up.
        painter.draw(&view.camera, view.time);
        let began = deadline.now();
        painter.draw(&view.camera, view.time);
        let step = (deadline.now() - began) / FILM_STEPS;
        let held = views.iter().filter(|v| v.held).count() + EvalOptions::default().train_views;
        let frames =
            orbit_seconds(scene.clip[1] - scene.clip[0]) * if have_ffmpeg() { ORBIT_FPS } else { ORBIT_FPS_PNG };
        Ok(Self {
            scores: step * HELD_STEPS * held as f64,
            // That of a long capture already exists.
            playback: if Chunked::is(&run.path) { 0.0 } else { step * BAKE_STEPS },
            film: step * FILM_STEPS * frames,
        })
    }

    /// Whether what takes `seconds` fits, and what is kept for later with it; states so in one line where it does not.
    fn leaves(
        missing: &str,
        [seconds, kept]: [f64; 2],
        run: &Path,
        deadline: &Deadline,
        console: &dyn Listener,
    ) -> bool {
        let left = deadline.left();
        if !deadline.is_set() || seconds + kept <= left {
            return true;
        }
        console.warn(&format!(
            "{missing}: it takes about {}, and {} are left of option `minutes`. `splat4d eval {}` does it later.",
            human_seconds(seconds),
            human_seconds(left - kept),
            in_command(run)
        ));
        false
    }
}

/// Bakes the run into `scene.s4d`, at any size. Errors are reported and never fail the run.
pub fn playback(run: &Path, console: &dyn Listener) -> Result<()> {
    playback_by(run, &Deadline::default(), console)
}

/// The same, within a time.
pub fn playback_by(run: &Path, deadline: &Deadline, console: &dyn Listener) -> Result<()> {
    // The file of a compression is what was learnt: baking again would lose its codes, palette and masks.
    // That of a long capture was made chunk by chunk, that of a followed one frame by frame.
    if run.join(ORDER).is_file() || Chunked::is(run) || Following::is(run) {
        return Ok(());
    }
    let baked = Source::open(run).and_then(|mut source| {
        not_empty(&source.scene, run)?;
        let folded = fold(&mut source, "a playback file", deadline, console)?;
        let title = Run::open(run)?.name();
        let baking = Baking { deadline: deadline.clone(), ..Baking::default() };
        bake_into(&source, &title, &run.join(playable::FILE), &baking, console).map(|report| (report, folded))
    });
    console.clear();
    match baked {
        Ok((report, folded)) => {
            if let Some(l) = folded {
                amend(run, [("playback_head_psnr".into(), json!(l.psnr))])?;
            }
            amend(
                run,
                [
                    ("playback_bytes".into(), report["bytes"].clone()),
                    ("playback_psnr".into(), report["likeness"]["psnr"].clone()),
                    ("playback_seconds".into(), report["seconds"].clone()),
                ],
            )
        }
        Err(error) => {
            console.warn(&format!("the playback file was not written: {error}"));
            Ok(())
        }
    }
}

/// Measures a run on its held-out views again: renders and scores them, and writes `results.json`, `per_view.json`, the
/// images and the report.
///
/// Errors: no scene yet; the capture has moved; another command writes the run; `stop` was raised.
///
/// ```no_run
/// use splat4d_workflow::evaluating::{Measure, evaluate};
/// use std::sync::atomic::AtomicBool;
///
/// # fn main() -> splat4d::Result<()> {
/// let (measure, stop) = (Measure::default(), AtomicBool::new(false));
/// let scores = evaluate("runs/knight".as_ref(), &measure, &stop, &splat4d_workflow::events::ignore)?;
/// println!("{:?} dB", scores.held("PSNR"));
/// # Ok(())
/// # }
/// ```
pub fn evaluate(run: &Path, measure: &Measure, stop: &AtomicBool, console: &dyn Listener) -> Result<Scores> {
    measure.check()?;
    let scene = read_scene(&Run::open(run)?.scene_file()?)?;
    let _folder = OutputFolder::amend(run, "eval")?;
    let scores = scores(run, &scene, measure, stop, console)?;
    write_report(run, console)?;
    Ok(scores)
}

/// Renders and scores the held-out views. The caller holds the run.
pub fn scores(
    run: &Path,
    scene: &Scene<f32>,
    measure: &Measure,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<Scores> {
    let opened = Run::open(run)?;
    let (mut capture, recipe) = opened.open_capture()?;
    capture.coarse().into_iter().for_each(|w| console.warn(w));
    corrected::apply(&mut capture, run)?;
    let capture = Arc::new(capture);
    let measuring = Measuring { opened: &opened, recipe: &recipe, measure, stop };
    let evaluation = measuring.evaluate(scene, &capture, Measured::Test, None, console)?;
    amend(run, [("lives".into(), json!(lifespans(scene)))])?;
    tracks(run, scene, &capture, console)?;
    flow(run, scene, &capture, &recipe, console)?;
    if capture.held.is_empty() {
        console.warn(
            "no view was held out, so quality on new views is not measured. Hold out a camera (option `hold_out` camera=0) \
             or every 8th image (option `hold_out` every=8).",
        );
    }
    Ok(evaluation)
}

/// Scores one split of a run's capture on some backgrounds, states them, and writes them next to those that the run is
/// judged
/// by. `backgrounds` with their names; none: the run's own.
///
/// Errors: the capture has no such views; images without alpha, which are composited on nothing; those of measuring.
pub fn scores_on(
    run: &Path,
    measured: Measured,
    backgrounds: &[(&str, [f32; 3])],
    measure: &Measure,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<()> {
    let opened = Run::open(run)?;
    let mut scene = read_scene(&opened.scene_file()?)?;
    let (mut capture, recipe) = opened.open_capture()?;
    capture.coarse().into_iter().for_each(|w| console.warn(w));
    corrected::apply(&mut capture, run)?;
    let split = measured.name();
    if measured.frames(&capture).is_empty() {
        return Err(Error::input(format!("the run's capture has no views of the split `{split}`"))
            .at(run.display())
            .remedy("A data set has `val` if it contains a list of these views, such as transforms_val.json."));
    }
    if !backgrounds.is_empty() && capture.background.is_none() {
        return Err(Error::input("the run's images have no transparent pixels, so there is no background to choose")
            .at(run.display())
            .remedy("Leave option `background` out."));
    }
    let own = capture.background;
    let all = on_backgrounds(own, backgrounds);
    let measuring = Measuring { opened: &opened, recipe: &recipe, measure, stop };
    for (name, background) in all {
        let place = if background == own { split.to_owned() } else { format!("{split}-{name}") };
        let judged = measured == Measured::Test && background == own;
        if let Some(background) = background {
            scene.background = background;
        }
        let capture = Arc::new(Capture { background, ..capture.clone() });
        let place = (!judged).then_some(place);
        let scores = measuring.evaluate(&scene, &capture, measured, place, console)?;
        print_split(&scores, measured, name, console);
    }
    Ok(())
}

/// Backgrounds with their names; where none are requested, the capture's own.
pub(crate) fn on_backgrounds<'a>(
    own: Option<[f32; 3]>,
    asked: &[(&'a str, [f32; 3])],
) -> Vec<(&'a str, Option<[f32; 3]>)> {
    match asked {
        [] => vec![("", own)],
        chosen => chosen.iter().map(|(name, color)| (*name, Some(*color))).collect(),
    }
}

pub(crate) fn print_split(scores: &Scores, measured: Measured, background: &str, console: &dyn Listener) {
    let on = if background.is_empty() { String::new() } else { format!(" on {background}") };
    let views = match measured {
        Measured::Test => "held-out views",
        Measured::Validation => "validation views",
        Measured::Train => "training views",
    };
    console.result(&format!("{views}{on}: {}", in_words(|key| scores.held(key))));
    let entry = &scores.report.results()[scores.report.method()];
    console.emit(&json!({
        "type": "results", "iteration": scores.report.iteration, "conditions": scores.report.conditions, "results": entry,
    }));
}

/// Reports and writes the distances of a run's cameras from those of a capture with ground truth.
///
/// Errors: captures that cannot be read, or have no cameras in common.
pub fn trajectory(run: &Path, truth: &Path, console: &dyn Listener) -> Result<()> {
    let (mut capture, recipe) = Run::open(run)?.open_capture()?;
    corrected::apply(&mut capture, run)?;
    let fps = (recipe.capture.fps > 0.0).then_some(recipe.capture.fps);
    let truth = Capture::open(truth, &CaptureOptions { fps, ..CaptureOptions::default() })?;
    let found = trajectory_error(&capture, &truth)?;
    found.write(run)?;
    let t = &found.poses;
    let worst = (0..t.apart.len()).max_by(|&a, &b| t.apart[a].center.total_cmp(&t.apart[b].center));
    let worst = worst.map_or("", |k| found.names[k].0.as_str());
    let mut words = format!(
        "{} cameras: ATE {:.5} units, {:.3} % of the rig's radius (worst: {worst})",
        t.apart.len(),
        t.ate,
        100.0 * t.ate / t.radius
    );
    if let Some([turn, shift]) = t.rpe {
        let _ = write!(words, "; RPE {turn:.3}°, {shift:.5} units");
    }
    if let Some([middle, most]) = found.clock_errors() {
        let _ = write!(words, "; time offsets wrong by {:.2} ms (median), {:.2} ms at most", 1e3 * middle, 1e3 * most);
    }
    console.result(&words);
    console.emit(&json!({"type": "trajectory", "results": found.report()}));
    Ok(())
}

/// A run that is measured, and how.
struct Measuring<'a> {
    opened: &'a Run,
    recipe: &'a Recipe,
    measure: &'a Measure,
    stop: &'a AtomicBool,
}

impl Measuring<'_> {
    /// Measures and writes under the entry `place` ([`EvalOptions::place`]).
    fn evaluate(
        &self,
        scene: &Scene<f32>,
        capture: &Arc<Capture>,
        measured: Measured,
        place: Option<String>,
        console: &dyn Listener,
    ) -> Result<Scores> {
        not_empty(scene, &self.opened.path)?;
        let memory = usize::try_from(self.recipe.run.image_memory).unwrap_or(usize::MAX);
        let store = Arc::new(ImageStore::new(capture.clone(), memory));
        let options = EvalOptions {
            folder: self.opened.path.clone(),
            antialias: self.recipe.appearance.antialias,
            lpips_weights: self.measure.lpips_weights.clone(),
            measured,
            place,
            align: Align::of(capture, self.recipe),
            exposures_of: Some(self.opened.path.clone()),
            device: present(self.measure.device),
            ..EvalOptions::default()
        };
        let iteration = self.opened.iteration().unwrap_or(0);
        let mut listen = |event: &Event| console.event(event);
        let scores = eval::evaluate(scene, capture, &store, iteration, &options, self.stop, &mut listen)?;
        console.clear();
        Ok(scores)
    }
}

/// Bins of the histogram of lifespans.
const LIFE_BINS: usize = 10;

/// How many Gaussians can be seen for how much of the clip: in tenths, those that are never seen left out.
fn lifespans(scene: &Scene<f32>) -> [usize; LIFE_BINS] {
    let length = (scene.clip[1] - scene.clip[0]).max(f64::MIN_POSITIVE);
    let mut counts = [0; LIFE_BINS];
    for seconds in crate::channels::lifetimes(scene).into_iter().flatten().filter(|s| *s > 0.0) {
        let share = f64::from(seconds) / length;
        counts[((share * LIFE_BINS as f64) as usize).min(LIFE_BINS - 1)] += 1;
    }
    counts
}

/// Measures tracks in space if the capture contains true ones.
fn tracks(run: &Path, scene: &Scene<f32>, capture: &Capture, console: &dyn Listener) -> Result<()> {
    let Some(e) = track_error(scene, capture)? else { return Ok(()) };
    console.result(&format!(
        "tracks of {} points in space: median error {:.4} units, {:.2} % of a character's height ({:.1} % of the \
         times tracked); nearest Gaussian at {:.4} units, {:.4} in the first frame",
        e.points,
        e.median,
        e.percent(),
        100.0 * e.followed,
        e.nearest,
        e.first
    ));
    let entry = json!({
        "points": e.points, "median": e.median, "mean": e.mean, "nearest": e.nearest, "first": e.first,
        "height": e.height,
        "percent": e.percent(), "followed": e.followed,
    });
    amend(run, [("tracks".into(), entry)])?;
    let Some(e) = point_errors(scene, capture)? else { return Ok(()) };
    let percent = |shares: &[f64]| shares.iter().map(|s| format!("{:.1}", 100.0 * s)).collect::<Vec<_>>().join(", ");
    let mut words = format!(
        "points tracked in space: median error {:.4} units, {} % within 1, 2, 4, 8, 16 % of their height, {:.1} % lost",
        e.median,
        percent(&e.within),
        100.0 * e.lost
    );
    if let Some(slope) = e.slope {
        let _ = write!(words, ", drift slope {slope:.2}");
    }
    console.result(&words);
    if let Some(p) = &e.pictures {
        let mut words = format!(
            "in {} views: median error {:.2} px, {} % within 1, 2, 4, 8, 16 px (mean {:.1} %)",
            p.cameras,
            p.median,
            percent(&p.within),
            100.0 * p.average()
        );
        if let Some(slope) = p.slope {
            let _ = write!(words, ", drift slope {slope:.2}");
        }
        if let Some(right) = p.visibility {
            let _ = write!(words, ", visibility correct for {:.1} %", 100.0 * right);
        }
        console.result(&words);
    }
    let pictures = e.pictures.as_ref().map(|p| {
        json!({
            "cameras": p.cameras, "median_px": p.median, "within_px": p.within, "delta_avg": p.average(),
            "slope": p.slope, "visibility": p.visibility,
        })
    });
    let entry = json!({
        "points": e.points, "median": e.median, "within_height": e.within, "lost": e.lost, "slope": e.slope,
        "pictures": pictures,
    });
    amend(run, [("point_tracks".into(), entry)])
}

/// Measures rendered flow where the capture has flow files.
fn flow(run: &Path, scene: &Scene<f32>, capture: &Capture, recipe: &Recipe, console: &dyn Listener) -> Result<()> {
    if capture.kind != CaptureKind::Own {
        return Ok(());
    }
    // A run that does not train on flow has left the files out.
    let mut whole = Capture::open(&capture.root, &run_options(run, recipe)?)?;
    corrected::apply(&mut whole, run)?;
    whole.held.retain(|i| capture.held.contains(i));
    whole.train.retain(|i| capture.train.contains(i));
    let Some(e) = flow_error(scene, &whole)? else { return Ok(()) };
    let mut words = format!(
        "flow of {} {} views: end-point error mean {:.3} px, median {:.3} px, {:.1} % within 1 px",
        e.pictures,
        if e.held { "held-out" } else { "training" },
        e.mean,
        e.median,
        100.0 * e.within[0]
    );
    if let (Some(moving), Some(length)) = (e.moving, e.length) {
        let _ = write!(words, "; in dynamic regions {moving:.3} px of {length:.2}");
    }
    console.result(&words);
    let entry = json!({
        "pictures": e.pictures, "held": e.held, "mean": e.mean, "median": e.median, "moving": e.moving,
        "length": e.length, "within_px": e.within, "drawn": e.drawn,
    });
    amend(run, [("flow".into(), entry)])
}

/// The report, and the scores on the console.
pub fn write_report(run: &Path, console: &dyn Listener) -> Result<()> {
    write_page(run, console)?;
    print_scores(&Run::open(run)?, console);
    Ok(())
}

/// The report alone.
pub fn write_page(run: &Path, console: &dyn Listener) -> Result<()> {
    console.written(&report::write(&Run::open(run)?)?);
    Ok(())
}

/// Scores in one line.
pub(crate) fn in_words(score: impl Fn(&str) -> Option<f64>) -> String {
    let mut words = Vec::new();
    for (key, name, digits, unit) in [
        ("PSNR", "PSNR", 2, " dB"),
        ("PSNR-aligned", "aligned", 2, " dB"),
        ("PSNR-cc", "colour-corrected", 2, " dB"),
        ("PSNR-dynamic", "dynamic regions", 2, " dB"),
        ("PSNR-dynamic-aligned", "dynamic regions, aligned", 2, " dB"),
        ("PSNR-foreground", "foreground", 2, " dB"),
        ("SSIM", "SSIM", 4, ""),
        ("MS-SSIM", "MS-SSIM", 4, ""),
        ("LPIPS-vgg", "LPIPS (VGG)", 4, ""),
        ("LPIPS-alex", "LPIPS (AlexNet)", 4, ""),
        ("LPIPS-squeeze", "LPIPS (SqueezeNet)", 4, ""),
        ("flicker", "flicker", 3, "/255"),
    ] {
        if let Some(value) = score(key) {
            words.push(format!("{name} {value:.digits$}{unit}"));
        }
    }
    words.join(", ")
}

/// Reports how far training moved the cameras, naming the one that moved most.
pub fn print_refined(run: &Path, console: &dyn Listener) -> Result<()> {
    if let Some(words) = corrected::read(run)?.and_then(|refined| refined_in_words(&refined)) {
        console.result(&words);
    }
    Ok(())
}

/// The scores in one line.
fn print_scores(run: &Run, console: &dyn Listener) {
    let words = in_words(|key| run.score(key));
    if !words.is_empty() {
        console.result(&format!("held-out views: {words}"));
    }
    if let (Some(ours), Some(still)) = (run.score("PSNR-dynamic"), run.baseline("PSNR-dynamic")) {
        console.result(&format!("dynamic regions: {:+.2} dB over a static scene ({still:.2} dB)", ours - still));
    }
    if let Some(results) = &run.results {
        let still = run.all_results.get(EvalOptions::STILL);
        let iteration = run.iteration();
        console.emit(&json!({"type": "results", "iteration": iteration, "results": results, "still": still}));
    }
}

/// Films an orbit through space and time: mp4 where ffmpeg is found, an animated PNG otherwise.
fn orbit(run: &Path, scene: &Scene<f32>, stop: &AtomicBool, console: &dyn Listener) -> Result<PathBuf> {
    let opened = Run::open(run)?;
    let views = opened.views()?;
    let stage = Stage::of_views(&views, scene.up);
    let mp4 = have_ffmpeg();
    let (name, other, fps) =
        if mp4 { ("orbit.mp4", "orbit.png", ORBIT_FPS) } else { ("orbit.png", "orbit.mp4", ORBIT_FPS_PNG) };
    let clock = Clock { from: scene.clip[0], to: scene.clip[1], freeze: None, slow_motion: None, seconds: None, fps };
    let size = (!mp4).then(|| small([stage.template.width, stage.template.height]));
    let shots = shots(&Route::Orbit, &clock, &views, &stage, size)?;
    let antialias = opened.recipe().is_ok_and(|r| r.appearance.antialias);
    let mut painter = Painter::new(scene, scene.background, antialias, false);
    let path = run.join(name);
    let first = &shots[0].camera;
    let mut film = Film::create(&path, [first.width, first.height], fps, shots.len(), None)?;
    for (i, shot) in shots.iter().enumerate() {
        unless_stopped(stop)?;
        painter.draw(&shot.camera, shot.time);
        film.frame(&painter.rgb(Channel::Color, [0.0, 1.0]))?;
        console.phase("rendering the orbit film", i + 1, shots.len());
    }
    film.finish()?;
    console.clear();
    let _ = std::fs::remove_file(run.join(other));
    Ok(path)
}

fn small([width, height]: [usize; 2]) -> [usize; 2] {
    let long = width.max(height).max(1);
    let side = |s: usize| if long > ORBIT_SIDE_PNG { (s * ORBIT_SIDE_PNG / long).max(1) } else { s };
    [side(width), side(height)]
}

/// Adds entries to `run.json`.
pub fn amend<const N: usize>(run: &Path, entries: [(String, Value); N]) -> Result<()> {
    let path = run.join("run.json");
    let mut info = if path.is_file() {
        crate::camera_file::json(&files::read_text(&path)?).map_err(|e| e.at(path.display()))?
    } else {
        json!({})
    };
    if let Some(map) = info.as_object_mut() {
        map.extend(entries);
    }
    let text = serde_json::to_string_pretty(&info).expect("run.json is plain data");
    files::write(&path, text.as_bytes())
}
