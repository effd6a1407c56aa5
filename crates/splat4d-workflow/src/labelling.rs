//! The work behind `label`, which `train` does too where a capture has labels or features: both learnt into a run's scene, and
//! measured.

use crate::deadline::unless_stopped;
use crate::evaluating::{self, amend};
use crate::events::Listener;
use crate::files;
use crate::run_folder::Run;
use crate::source::{not_empty, read_scene};
use serde_json::json;
use splat4d::Result;
use splat4d::format;
use splat4d::layers::Scene;
use splat4d_train::capture::{Capture, Frame};
use splat4d_train::features;
use splat4d_train::labels::{self, LabelScores, ROUNDS, learn, measure};
use splat4d_train::output::OutputFolder;
use splat4d_train::run::{corrected, run_options};
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Whether any image of a run's capture has a mask of labels or an image of features.
pub fn has_any(capture: &Capture) -> bool {
    capture.frames.iter().any(|f| f.labels.is_some() || f.features.is_some())
}

/// Learns a label and features of each Gaussian of a run from the masks and feature images of its capture, or of `from`, another
/// capture of the same cameras; bakes and reports again. `rounds`: passes over the images.
///
/// Errors: no training image has either; files that cannot be read; another command writes the run; `stop` was raised.
///
/// ```no_run
/// use std::sync::atomic::AtomicBool;
///
/// # fn main() -> splat4d::Result<()> {
/// let (listen, stop) = (&splat4d_workflow::events::ignore, AtomicBool::new(false));
/// splat4d_workflow::labelling::label("runs/take".as_ref(), Some("segmented".as_ref()), None, &stop, listen)
/// # }
/// ```
pub fn label(
    run: &Path,
    from: Option<&Path>,
    rounds: Option<usize>,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<()> {
    Run::open(run)?;
    let _folder = OutputFolder::amend(run, "label")?;
    learn_into(run, from, rounds, stop, console)?;
    evaluating::playback(run, console)?;
    evaluating::write_page(run, console)
}

/// Learns labels and features into the run's `scene.safetensors`, and nothing else. The caller holds the run.
///
/// Errors: no training image has either; files that cannot be read; `stop` was raised.
pub fn learn_into(
    run: &Path,
    from: Option<&Path>,
    rounds: Option<usize>,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<()> {
    let opened = Run::open(run)?;
    let file = opened.scene_file()?;
    let mut scene = read_scene(&file)?;
    not_empty(&scene, run)?;
    let (mut capture, recipe) = opened.open_capture()?;
    if let Some(from) = from {
        capture = Capture::open(from, &run_options(run, &recipe)?)?;
    }
    corrected::apply(&mut capture, run)?;
    let there = |which: fn(&Frame) -> bool| capture.train.iter().any(|&i| which(&capture.frames[i]));
    let (labelled, featured) = (there(|f| f.labels.is_some()), there(|f| f.features.is_some()));
    if featured {
        learn_features(run, &mut scene, &capture, rounds, stop, console)?;
    }
    if labelled || !featured {
        learn_labels(run, &mut scene, &capture, rounds, stop, console)?;
    }
    let mut bytes = Vec::new();
    format::scene::write(&scene, &mut bytes)?;
    files::write(&file, &bytes)?;
    console.written(&file);
    Ok(())
}

fn learn_features(
    run: &Path,
    scene: &mut Scene<f32>,
    capture: &Capture,
    rounds: Option<usize>,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<()> {
    let mut phase = |done, of| {
        console.phase("learning features", done, of);
        unless_stopped(stop)
    };
    let losses = features::learn(scene, capture, rounds.unwrap_or(features::ROUNDS), &mut phase)?;
    console.clear();
    let list: Vec<String> = losses.iter().map(|l| format!("{l:.4}")).collect();
    console.detail(&format!("half the squared error of a pixel's features, per round: {}", list.join(", ")));
    let (scores, views) = match features::measure(scene, capture, &capture.held)? {
        Some(scores) => (Some(scores), "held-out"),
        None => (features::measure(scene, capture, &capture.train)?, "training"),
    };
    if let Some(scores) = scores {
        let channels = scene.feature_channels();
        console.result(&format!(
            "{channels} feature channels: {:.1} % of the variance of {} {views} views explained, mean cosine {:.3}",
            100.0 * scores.explained,
            scores.pictures,
            scores.cosine
        ));
        let entry = json!({
            "channels": channels, "views": views, "pictures": scores.pictures, "explained": scores.explained,
            "cosine": scores.cosine, "losses": losses,
        });
        amend(run, [("features".into(), entry)])?;
    }
    console.emit(&json!({"type": "featured", "channels": scene.feature_channels()}));
    Ok(())
}

fn learn_labels(
    run: &Path,
    scene: &mut Scene<f32>,
    capture: &Capture,
    rounds: Option<usize>,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<()> {
    let mut phase = |done, of| {
        console.phase("learning labels", done, of);
        unless_stopped(stop)
    };
    let losses = learn(scene, capture, rounds.unwrap_or(ROUNDS), &mut phase)?;
    console.clear();
    let list: Vec<String> = losses.iter().map(|l| format!("{l:.4}")).collect();
    console.detail(&format!("cross-entropy of a labelled pixel before each round: {} nats", list.join(", ")));
    let held = measure(scene, capture, &capture.held)?;
    let (scores, views) = match held {
        Some(scores) => (Some(scores), "held-out"),
        None => (measure(scene, capture, &capture.train)?, "training"),
    };
    if let Some(scores) = &scores {
        console.result(&in_words(scores, views));
        amend(
            run,
            [(
                "labels".into(),
                json!({
                    "names": scores.names, "views": views, "pictures": scores.pictures, "accuracy": scores.accuracy,
                    "mean_iou": scores.mean_iou, "iou": scores.iou, "cross_entropy": losses,
                }),
            )],
        )?;
    }
    let mut counts = vec![0usize; scene.labels.len()];
    let all = scene.layers.iter().flat_map(|l| splat4d::scene::labels::of(&l.params));
    all.flatten().for_each(|k| counts[k] += 1);
    let gaussians: Vec<String> =
        scene.labels.iter().zip(&counts).map(|(name, n)| format!("{name} {}", files::grouped(*n))).collect();
    console.result(&format!("Gaussians: {}", gaussians.join(", ")));
    console.emit(&json!({
        "type": "labelled", "labels": scene.labels, "gaussians": counts, "most_pictures": labels::MOST_PICTURES,
    }));
    Ok(())
}

fn in_words(scores: &LabelScores, views: &str) -> String {
    let each = scores.names.iter().zip(&scores.iou);
    let each: Vec<String> = each.filter_map(|(name, iou)| Some(format!("{name} {:.3}", (*iou)?))).collect();
    format!(
        "labels of {} {views} views: {:.1} % of the pixels correct, mean IoU {:.3} ({})",
        scores.pictures,
        100.0 * scores.accuracy,
        scores.mean_iou,
        each.join(", ")
    )
}
