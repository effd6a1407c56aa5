//! Labels of a trained scene, learnt from masks of labels in its training images with all else fixed.
//!
//! A Gaussian has a probability of each label, p_i. A pixel shows P = Σ w_i p_i / Σ w_i, w_i = α_i T_i, and the
//! cross-entropy −Σ_pixels ln P_y, y the pixel's label, is minimised by expectation-maximisation: p_ik becomes the
//! share of label k in Σ_pixels with y = k of w_i p_ik / P_k. That is exact for blended probabilities, has no rate, and
//! never makes the loss larger. The first round, from even probabilities, is the vote of FlashSplat (Shen et al. 2024);
//! the following ones give a pixel to those of its Gaussians that others agree with. The sums are the renderer's
//! gradient to the blended probabilities, with 1/P_y at label y as the image's gradient.
//!
//! Shapes and places learn nothing from labels: they are those that make the best images.

use crate::blended::{Blended, SEEN};
use crate::capture::Capture;
use crate::capture::labels::{UNKNOWN, read};
use crate::{Error, Result};
use splat4d::channels::label_columns;
use splat4d::flow::divided;
use splat4d::layers::Scene;
use splat4d::scene::labels::{self, LABEL_LOGITS};
use splat4d::scene::{Planes, Table};

/// Rounds by default: the cross-entropy of the bundled capture then changes by less than a percent a round.
pub const ROUNDS: usize = 4;
/// Most images of a round, evenly chosen: more add no information.
pub const MOST_PICTURES: usize = 240;
/// Weight in pixels of the even vote that every Gaussian has: what no image shows keeps no label.
const PRIOR: f64 = 1e-3;
/// Probabilities are kept this far from 0: a wrong mask must not forbid a label forever.
const LEAST: f64 = 1e-6;

/// Quality of learnt labels.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelScores {
    /// The labels' names.
    pub names: Vec<String>,
    /// Images that were measured.
    pub pictures: usize,
    /// Share of the labelled pixels that show something whose likeliest label is right.
    pub accuracy: f64,
    /// By label: pixels in both over pixels in either; `None`: it is in no image, neither true nor rendered.
    pub iou: Vec<Option<f64>>,
    /// Their mean over the labels that there are.
    pub mean_iou: f64,
}

/// Frames of a list that have labels, at most this many, evenly chosen.
fn labelled(capture: &Capture, frames: &[usize], most: usize) -> Vec<usize> {
    let all: Vec<usize> = frames.iter().copied().filter(|&i| capture.frames[i].labels.is_some()).collect();
    let step = all.len().div_ceil(most.max(1)).max(1);
    all.into_iter().step_by(step).collect()
}

/// Learns the labels of the capture's training images into the scene, in place of those it had. Returns the mean
/// cross-entropy of a pixel before each round, nats. `progress` receives how many images of how many are done, and may
/// end the work.
///
/// Errors: those of `progress`; no training image has labels; a mask that cannot be read.
pub fn learn(
    scene: &mut Scene<f32>,
    capture: &Capture,
    rounds: usize,
    progress: &mut dyn FnMut(usize, usize) -> Result<()>,
) -> Result<Vec<f64>> {
    let frames = labelled(capture, &capture.train, MOST_PICTURES);
    if frames.is_empty() || capture.labels.is_empty() {
        return Err(Error::input("no training image of the capture has labels")
            .at(capture.root.display())
            .remedy("Give capture.json `labels` (names) and its cameras `labels` (masks): docs/labels.md"));
    }
    let count = capture.labels.len();
    let evenly: Vec<Option<usize>> = (0..count).map(|_| None).collect();
    scene.labels = capture.labels.clone();
    for layer in &mut scene.layers {
        match labels::key(&layer.params) {
            Some(key) => {
                labels::renumber(&mut layer.params, &evenly);
                layer.params[key].fill(0.0);
            }
            None => drop(labels::claim(&mut layer.params, count)?),
        }
    }
    let mut work = Blended::default();
    let total = rounds * frames.len();
    let mut losses = Vec::with_capacity(rounds);
    for round in 0..rounds {
        let mut votes: Vec<Table<f64>> =
            scene.layers.iter().map(|l| Table::new(&[(LABEL_LOGITS, count)], l.params.len())).collect();
        let (mut loss, mut pixels) = (0.0, 0usize);
        for (i, &frame) in frames.iter().enumerate() {
            progress(round * frames.len() + i, total)?;
            let truth = read(&capture.frames[frame], capture)?.expect("only frames with labels were chosen");
            let (sum, seen) = vote(&mut work, scene, capture, frame, &truth, &mut votes);
            (loss, pixels) = (loss + sum, pixels + seen);
        }
        losses.push(loss / pixels.max(1) as f64);
        for (layer, votes) in scene.layers.iter_mut().zip(&votes) {
            let key = labels::key(&layer.params).expect("every layer has labels now");
            for row in 0..votes.rows() {
                let even = PRIOR / count as f64;
                let all: f64 = (0..count).map(|k| votes.get(row, k) + even).sum();
                for k in 0..count {
                    let p = ((votes.get(row, k) + even) / all).max(LEAST);
                    layer.params[key].set(row, k, p.ln() as f32);
                }
            }
        }
    }
    progress(total, total)?;
    Ok(losses)
}

/// Measures a scene's labels on frames of its capture; `None`: none of them has labels, or the scene has none.
///
/// Errors: a mask that cannot be read; the scene's labels are not the capture's.
pub fn measure(scene: &Scene<f32>, capture: &Capture, frames: &[usize]) -> Result<Option<LabelScores>> {
    let frames = labelled(capture, frames, MOST_PICTURES);
    if frames.is_empty() || scene.labels.is_empty() {
        return Ok(None);
    }
    if scene.labels != capture.labels {
        return Err(Error::input(format!(
            "the scene's labels ({}) are not the capture's ({})",
            scene.labels.join(", "),
            capture.labels.join(", ")
        ))
        .remedy("Learn them again: splat4d label RUN"));
    }
    let count = scene.labels.len();
    let (mut right, mut all) = (0usize, 0usize);
    let (mut both, mut drawn, mut true_) = (vec![0usize; count], vec![0usize; count], vec![0usize; count]);
    let mut work = Blended::default();
    for &frame in &frames {
        let truth = read(&capture.frames[frame], capture)?.expect("only frames with labels were chosen");
        draw(&mut work, scene, capture, frame);
        for (p, &y) in truth.iter().enumerate().filter(|(_, y)| **y != UNKNOWN) {
            let Some(best) = best(&work.image.extra, p) else { continue };
            let y = usize::from(y);
            all += 1;
            right += usize::from(best == y);
            both[y] += usize::from(best == y);
            drawn[best] += 1;
            true_[y] += 1;
        }
    }
    let iou = (0..count).map(|k| {
        let either = drawn[k] + true_[k] - both[k];
        (either > 0).then(|| both[k] as f64 / either as f64)
    });
    let iou: Vec<Option<f64>> = iou.collect();
    let there = iou.iter().flatten();
    let mean_iou = there.clone().sum::<f64>() / there.count().max(1) as f64;
    let accuracy = right as f64 / all.max(1) as f64;
    Ok(Some(LabelScores { names: scene.labels.clone(), pictures: frames.len(), accuracy, iou, mean_iou }))
}

/// The likeliest label of a pixel of blended probabilities; `None`: it shows next to nothing that has one.
pub fn best(extra: &Planes<f32>, p: usize) -> Option<usize> {
    let count = extra.channels - 1;
    let likelier = |&a: &usize, &b: &usize| extra.plane(a)[p].total_cmp(&extra.plane(b)[p]).then(b.cmp(&a));
    (extra.plane(count)[p] >= SEEN).then(|| (0..count).max_by(likelier)).flatten()
}

/// Renders the blended probabilities of a frame's view.
fn draw(work: &mut Blended, scene: &Scene<f32>, capture: &Capture, frame: usize) {
    work.draw(scene, capture, frame, |instant| label_columns(scene, instant).expect("the scene has labels"));
}

/// Adds an image's votes; returns its cross-entropy and how many pixels that is of.
fn vote(
    work: &mut Blended,
    scene: &Scene<f32>,
    capture: &Capture,
    frame: usize,
    truth: &[u8],
    votes: &mut [Table<f64>],
) -> (f64, usize) {
    draw(work, scene, capture, frame);
    let count = scene.labels.len();
    let (shares, weight) = divided(&work.image.extra);
    let mut d_extra = Planes::new(count + 1, shares.height, shares.width);
    let (mut loss, mut seen) = (0.0, 0);
    for (p, &y) in truth.iter().enumerate() {
        if y == UNKNOWN || weight.data[p] < SEEN {
            continue;
        }
        let share = f64::from(shares.plane(usize::from(y))[p]).max(LEAST);
        loss -= share.ln();
        seen += 1;
        // Σ w p_y is the share times Σ w.
        d_extra.plane_mut(usize::from(y))[p] = (1.0 / (share * f64::from(weight.data[p]))) as f32;
    }
    work.back(scene, capture, frame, &d_extra, |[layer, row], j, d, columns| {
        for k in 0..count {
            *votes[layer].get_mut(row, k) += f64::from(d.get(j, k)) * f64::from(columns.get(j, k));
        }
    });
    (loss, seen)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::CaptureOptions;
    use splat4d::layers::Layer;
    use splat4d::motion::{Spec, build};
    use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
    use splat4d::scene::{GEOMETRY, LifeKind, Params};
    use std::path::Path;

    const SIDE: u32 = 32;

    /// Two cameras look at a wall at z = 0 from z = 4, one a little to the side; its left half is labelled 0, its right
    /// half 1. One pixel in nine of the first camera's mask is wrong.
    fn capture(folder: &Path) -> Capture {
        let mut cameras = Vec::new();
        for (c, shift) in [0.0, 0.4].into_iter().enumerate() {
            let picture = image::RgbImage::from_pixel(SIDE, SIDE, image::Rgb([90, 90, 90]));
            picture.save(folder.join(format!("{c}.png"))).unwrap();
            // The camera at x = shift sees the wall's middle at column 16 − 40 shift / 4.
            let middle = 16.0 - 10.0 * shift;
            let mask = image::GrayImage::from_fn(SIDE, SIDE, |x, y| {
                let right = f64::from(x) + 0.5 > middle;
                let wrong = c == 0 && x % 3 == 0 && y % 3 == 0;
                image::Luma([if y < 2 { 255 } else { u8::from(right != wrong) }])
            });
            mask.save(folder.join(format!("l{c}.png"))).unwrap();
            cameras.push(format!(
                r#"{{"name": "c{c}", "width": {SIDE}, "height": {SIDE}, "fx": 40, "fy": 40, "cx": 16, "cy": 16,
                "images": ["{c}.png"], "labels": ["l{c}.png"],
                "world_to_camera": [[1, 0, 0, {}], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}}"#,
                -shift
            ));
        }
        let text = format!(
            r#"{{"version": 1, "labels": ["left", "right"], "hold_out": "none", "cameras": [{}]}}"#,
            cameras.join(", ")
        );
        std::fs::write(folder.join("capture.json"), text).unwrap();
        Capture::open(folder, &CaptureOptions::default()).unwrap()
    }

    fn wall() -> Scene<f32> {
        let mut p = Params::new(401, 1, &[]);
        let motion = build(&Spec::Still, &mut p).unwrap();
        for r in 0..400 {
            let at = |k: usize| (k as f32 / 19.0 - 0.5) * 4.0;
            p[GEOMETRY].write(r, 0, [at(r % 20), at(r / 20), 0.0]);
        }
        // No view ever sees the last one.
        p[GEOMETRY].write(400, 0, [0.0, 0.0, -9.0]);
        for r in 0..401 {
            p[GEOMETRY].write(r, QUAT, [1.0, 0.0, 0.0, 0.0]);
            p[GEOMETRY].write(r, LOG_SCALE, [-1.9; 3]);
            p[GEOMETRY].set(r, OPACITY, 4.0);
        }
        let layers = vec![Layer::new("wall", p, motion, LifeKind::Infinite)];
        Scene { layers, clip: [0.0, 0.0], fps: 10.0, ..Scene::default() }
    }

    #[test]
    fn gaussians_get_labels_and_rounds_never_increase_the_error() {
        let folder = tempfile::tempdir().unwrap();
        let (capture, mut scene) = (capture(folder.path()), wall());
        let before = scene.layers[0].params[GEOMETRY].clone();
        let losses = learn(&mut scene, &capture, 4, &mut |_, _| Ok(())).unwrap();
        assert!((losses[0] - std::f64::consts::LN_2).abs() < 1e-3, "at first all is as likely: {losses:?}");
        assert!(losses.windows(2).all(|w| w[1] <= w[0] + 1e-6) && losses[3] < 0.3, "{losses:?}");
        assert_eq!(scene.layers[0].params[GEOMETRY], before, "shapes stay as they are");
        let of = labels::of(&scene.layers[0].params);
        let mut right = 0;
        for r in 0..400 {
            let [x, y] = before.read::<2>(r, 0);
            // Those on the border may be of either, those at the image's edge of none.
            let asked = x.abs() > 0.3 && x.abs() < 1.4 && y.abs() < 1.3;
            right += usize::from(!asked || of[r] == Some(usize::from(x > 0.0)));
        }
        assert!(right > 392, "{right} of 400");
        assert_eq!(of[400], None, "what nobody sees has no label");
        let scores = measure(&scene, &capture, &capture.train).unwrap().unwrap();
        // One pixel in nine of one mask of two is wrong.
        assert!(scores.accuracy > 0.92 && scores.mean_iou > 0.85, "{scores:?}");
        assert_eq!(scores.names, ["left", "right"]);
        // Learning again begins again.
        let again = learn(&mut scene, &capture, 1, &mut |_, _| Ok(())).unwrap();
        assert!((again[0] - losses[0]).abs() < 1e-9);
        let mut other = scene.clone();
        other.labels = vec!["a".into(), "b".into()];
        assert!(measure(&other, &capture, &capture.train).unwrap_err().to_string().contains("a, b"));
    }

    #[test]
    fn missing_masks_are_reported() {
        let folder = tempfile::tempdir().unwrap();
        let mut capture = capture(folder.path());
        capture.frames.iter_mut().for_each(|f| f.labels = None);
        let error = learn(&mut wall(), &capture, 1, &mut |_, _| Ok(())).unwrap_err().to_string();
        assert!(error.contains("no training image") && error.contains("docs/labels.md"), "{error}");
    }
}
