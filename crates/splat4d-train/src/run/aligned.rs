//! Depth maps that are known up to a scale and a shift become metric: each is fitted to the capture's points.
//!
//! Gaussians begin on metric maps only, which is what maps gain (studies/records/2026-11-28-models.md). A single image
//! determines its shift badly where its points are at similar depths, so contrasts of a camera's maps are fused: how much the
//! inverse depth varies over an image changes slowly from frame to frame. Smooth errors, which no scale and shift removes, are
//! a field over the image where points that were left out agree with it.
//!
//! A map's number is what has the error, so it is explained by the depth and not the depth by it: the other regression's
//! contrast is too large, by 17 % at errors of 10 %, and what is far from the points then has a wrong depth.

use super::open::{OpenCapture, training_frames};
use crate::Result;
use crate::capture::depth_field::{self as field, Field};
use crate::capture::{Capture, DepthFit, DepthKind, depth_map};
use crate::recipe::Recipe;
use rayon::prelude::*;
use splat4d::math::cholesky::Cholesky;
use splat4d::math::{Rng, median};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Fewest points with which a map is fitted.
const FEW: usize = 20;
/// Points of the capture that are compared, at most.
const POINTS: usize = 4000;
/// Fewest maps of all that have to fit: else none is used as metric.
const MOST: f64 = 0.5;
/// Pairs of points that are tried as a map's scale and shift.
const TRIES: usize = 300;
/// Relative errors from this one on count alike in the search: points that something hides. Three times a large error of a
/// map: 0.1 found lines through maps with errors of 10 % that were a third of the true contrast.
const HIDDEN: f64 = 0.3;
/// A falling line that leaves less than this share of the rising one's errors: the map is upside down.
const FALLING: f64 = 0.7;
/// Share of the points in an image that nothing hides, at least: fits are judged by the closest this many, whose largest error
/// is this share of a standard deviation.
const VISIBLE: f64 = 0.3;
const OF_DEVIATION: f64 = 0.385;
/// Deviations from which on a pair has no weight (Tukey's biweight).
const TUKEY: f64 = 4.7;
/// Rounds of reweighting.
const ROUNDS: usize = 20;
/// Least spread of errors that reweighting assumes.
const SHARPEST: f64 = 1e-3;
/// How much contrasts of one camera's maps vary over time, relative.
const CHANGES: f64 = 0.2;
/// Typical size of smooth errors, relative, and of their second differences from node to node: those of networks.
const SMOOTH: f64 = 0.1;
/// Least spread of the other errors that a field of smooth ones assumes: less would be noise of pixels.
const NOISE: f64 = 0.02;
/// A field is used where it leaves at most this share of the errors of points that it has not seen.
const GAIN: f64 = 0.9;
/// Errors of neighbouring pixels are alike: an image has as many independent ones, at most.
const INDEPENDENT: f64 = 16.0;
/// A map whose errors have more than this standard deviation (relative) does not show the points at any scale and shift.
const FOREIGN: f64 = 0.2;
/// Depths outside of those of the points by more than this factor are guesses, and count as unknown.
const BEYOND: f64 = 4.0;

/// A point in an image.
#[derive(Clone, Copy, Debug)]
struct Pair {
    /// Standardised number of the map.
    x: f64,
    /// What it is to become.
    y: f64,
    /// Where, from 0 to 1 over the image.
    place: [f64; 2],
}

/// What a map and the points in its image have in common.
struct Sample {
    /// Of [`Capture::frames`].
    frame: usize,
    /// Median and spread of the map.
    center: f64,
    spread: f64,
    pairs: Vec<Pair>,
    /// Nearest and farthest of the points.
    range: [f64; 2],
}

/// x = `contrast` y (1 + field) + `level`, and the standard deviation of relative errors of what is visible.
#[derive(Clone, Copy, Debug)]
struct Fit {
    contrast: f64,
    level: f64,
    field: Field,
    off: f64,
}

/// The capture with maps as metric ones where they fit its points, and what is to be reported. Maps stay as they are where
/// there are too few points.
pub(super) fn aligned(opened: OpenCapture, recipe: &Recipe) -> Result<(OpenCapture, Option<String>)> {
    if recipe.loss.depth <= 0.0 {
        return Ok((opened, None));
    }
    let (samples, asked) = samples(&opened)?;
    if samples.is_empty() {
        return Ok((opened, None));
    }
    let first: Vec<Option<Fit>> = samples.par_iter().map(|s| search(&s.pairs, s.frame)).collect();
    let camera = |sample: &Sample| opened.capture.frames[sample.frame].camera;
    let mut contrasts: BTreeMap<usize, Vec<f64>> = BTreeMap::new();
    for (sample, line) in samples.iter().zip(&first) {
        contrasts.entry(camera(sample)).or_default().extend(line.map(|l| l.contrast));
    }
    let usual: BTreeMap<usize, f64> =
        contrasts.iter_mut().filter_map(|(camera, contrasts)| Some((*camera, median(contrasts)?))).collect();
    let fitted = |(sample, line): (&Sample, &Option<Fit>)| {
        let fit = smooth(&sample.pairs, *line, *usual.get(&camera(sample))?)?;
        let kind = opened.capture.frames[sample.frame].depth.as_ref().map(|d| d.kind);
        let scale = 1.0 / (fit.contrast * sample.spread);
        let depth = DepthFit {
            inverse: kind == Some(DepthKind::Inverse),
            scale,
            shift: -fit.level / fit.contrast - scale * sample.center,
            field: fit.field,
            range: [sample.range[0] / BEYOND, sample.range[1] * BEYOND],
        };
        Some((sample.frame, depth))
    };
    let fits: Vec<Option<(usize, DepthFit)>> = samples.par_iter().zip(&first).map(fitted).collect();
    let fits: BTreeMap<usize, DepthFit> = fits.into_iter().flatten().collect();
    if (fits.len() as f64) < MOST * asked as f64 {
        let what = format!(
            "{} of {asked} depth maps fit the capture's points at some scale and shift: maps are compared with the scene up to \
             scale and shift only, and no Gaussians begin on them",
            fits.len()
        );
        return Ok((opened, Some(what)));
    }
    let mut capture = Capture::clone(&opened.capture);
    let mut left_out = 0;
    for &i in &opened.capture.train {
        let Some(depth) = capture.frames[i].depth.as_mut().filter(|d| d.kind != DepthKind::Metric) else { continue };
        match fits.get(&i) {
            Some(fit) => (depth.kind, depth.fit) = (DepthKind::Metric, Some(*fit)),
            None => {
                capture.frames[i].depth = None;
                left_out += 1;
            }
        }
    }
    let what = (left_out > 0).then(|| {
        format!(
            "{left_out} of {asked} depth maps do not fit the capture's points at any scale and shift: they are left out"
        )
    });
    let frames = training_frames(Arc::new(capture), recipe)?;
    Ok((OpenCapture::with(frames).on(opened.device), what))
}

/// The maps of training frames without a unit, with the points in them; and how many such maps there are.
fn samples(opened: &OpenCapture) -> Result<(Vec<Sample>, usize)> {
    let capture = &opened.capture;
    let without = |i: &usize| capture.frames[*i].depth.as_ref().is_some_and(|d| d.kind != DepthKind::Metric);
    let places: Vec<usize> = capture.train.iter().copied().filter(without).collect();
    let cloud = capture.points.as_ref().map_or_else(Vec::new, |c| {
        (0..c.points.len()).filter(|&i| c.times[i].is_none()).map(|i| c.points[i]).collect()
    });
    if places.is_empty() || cloud.len() < FEW {
        return Ok((Vec::new(), places.len()));
    }
    let step = cloud.len().div_ceil(POINTS);
    let still: Vec<[f64; 3]> = cloud.into_iter().step_by(step).collect();
    let found: Vec<Option<Sample>> =
        places.par_iter().map(|&frame| sample(capture, frame, &still)).collect::<Result<_>>()?;
    Ok((found.into_iter().flatten().collect(), places.len()))
}

/// What a frame's map and points have in common; `None`: too little. Errors: as when it is loaded.
fn sample(capture: &Capture, frame: usize, still: &[[f64; 3]]) -> Result<Option<Sample>> {
    let (of, camera) = (&capture.frames[frame], &capture.frames[frame].view);
    let Some(file) = &of.depth else { return Ok(None) };
    let place = |e: splat4d::Error| e.at(format!("camera {}, frame {}", capture.cameras[of.camera].name, of.index));
    let values = depth_map(file, of, capture.downscale).map_err(place)?;
    let mut known: Vec<f64> = values.iter().filter(|v| **v != 0.0).map(|v| f64::from(*v)).collect();
    let count = known.len().max(1) as f64;
    let mean = known.iter().sum::<f64>() / count;
    let spread = (known.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / count).sqrt();
    let Some(center) = median(&mut known).filter(|_| spread > 0.0) else { return Ok(None) };
    let (mut pairs, mut range) = (Vec::new(), [f64::INFINITY, 0.0f64]);
    for &point in still {
        let Some(([u, v], z)) = camera.project(point) else { continue };
        let inside = (0.0..camera.width as f64).contains(&u) && (0.0..camera.height as f64).contains(&v);
        let value = if inside { f64::from(values[v as usize * camera.width + u as usize]) } else { 0.0 };
        if value != 0.0 && z > 0.0 {
            pairs.push(Pair {
                x: (value - center) / spread,
                y: if file.kind == DepthKind::Inverse { 1.0 / z } else { z },
                place: [u / camera.width as f64, v / camera.height as f64],
            });
            range = [range[0].min(z), range[1].max(z)];
        }
    }
    Ok((pairs.len() >= FEW).then_some(Sample { frame, center, spread, pairs, range }))
}

/// The rising line on which most pairs are: of two of them, then refined. `None`: no two rise.
fn search(pairs: &[Pair], frame: usize) -> Option<Fit> {
    let rng = Rng::new(frame as u64, "depth alignment", 0);
    let (mut best, mut falling): (Option<(f64, Fit)>, f64) = (None, f64::INFINITY);
    for k in 0..TRIES {
        let [a, b] = [2 * k, 2 * k + 1].map(|i| pairs[rng.below(i as u64, pairs.len())]);
        let contrast = (a.x - b.x) / (a.y - b.y);
        if !contrast.is_finite() || contrast == 0.0 {
            continue;
        }
        let line = Fit::line(contrast, a.x - contrast * a.y);
        let cost = line.cost(pairs.iter());
        if contrast < 0.0 {
            falling = falling.min(cost);
        } else if best.is_none_or(|(least, _)| cost < least) {
            best = Some((cost, line));
        }
    }
    best.filter(|(cost, _)| falling >= FALLING * cost).map(|(_, line)| refined(pairs, line, None, false))
}

/// The fit from a line on (none: that of the usual contrast), with a field where it predicts points that it has not seen.
/// `None`: the map does not show the points.
fn smooth(pairs: &[Pair], line: Option<Fit>, usual: f64) -> Option<Fit> {
    let mut levels: Vec<f64> = pairs.iter().map(|p| p.x - usual * p.y).collect();
    let level = median(&mut levels)?;
    let begin = line.filter(|l| (usual / l.contrast - 1.0).abs() < CHANGES).unwrap_or(Fit::line(usual, level));
    let fit = |pairs: &[Pair], field: bool| refined(pairs, begin, Some(usual), field);
    let line = fit(pairs, false);
    if line.off > FOREIGN || line.contrast <= 0.0 {
        return None;
    }
    let halves = [0, 1].map(|half| pairs.iter().copied().skip(half).step_by(2).collect::<Vec<_>>());
    let left = |field: bool| fit(&halves[0], field).cost(&halves[1]) + fit(&halves[1], field).cost(&halves[0]);
    let with = if left(true) <= GAIN * left(false) { fit(pairs, true) } else { line };
    Some(if with.contrast > 0.0 && with.field.is_small() { with } else { line })
}

impl Fit {
    fn line(contrast: f64, level: f64) -> Self {
        Self { contrast, level, field: Field::ZERO, off: 0.0 }
    }

    /// Of the map's number, relative to what the pair is to become.
    fn error(&self, pair: &Pair) -> f64 {
        (pair.x - self.level) / (self.contrast * pair.y) - 1.0 - self.field.at(pair.place)
    }

    /// The sum of errors, those of hidden points alike.
    fn cost<'a>(&self, pairs: impl IntoIterator<Item = &'a Pair>) -> f64 {
        pairs.into_iter().map(|p| self.error(p).abs().min(HIDDEN)).sum()
    }

    /// The standard deviation of the errors of what is visible.
    fn deviation(&self, pairs: &[Pair]) -> f64 {
        let mut errors: Vec<f64> = pairs.iter().map(|p| self.error(p).abs()).collect();
        let at = (VISIBLE * errors.len() as f64) as usize;
        *errors.select_nth_unstable_by(at, f64::total_cmp).1 / OF_DEVIATION
    }
}

/// Least squares with Tukey's weights from a fit on. `usual`: the contrast that other frames have. The deviation only falls:
/// else what is hidden gains weight round by round.
///
/// Unknown are contrast and level by the contrast of the start, c, and the nodes times the contrast by c:
/// x / (c y) = a + b / y + Σ w g.
fn refined(pairs: &[Pair], mut fit: Fit, usual: Option<f64>, field: bool) -> Fit {
    let (count, mut deviation) = (pairs.len() as f64, f64::INFINITY);
    let unknown = if field { 2 + field::COUNT } else { 2 };
    let rough = field::roughness();
    let start = usual.unwrap_or(fit.contrast);
    for _ in 0..ROUNDS {
        deviation = fit.deviation(pairs).min(deviation).max(SHARPEST);
        let (mut matrix, mut side) = (vec![0.0; unknown * unknown], vec![0.0; unknown]);
        for p in pairs {
            let off = fit.error(p) / (TUKEY * deviation);
            let weight = (1.0 - off * off).max(0.0).powi(2);
            let nodes = field::weights(p.place).map(|(node, w)| (2 + node, w));
            let row = [(0, 1.0), (1, 1.0 / p.y)].into_iter().chain(nodes.into_iter().filter(|_| field));
            for (i, v) in row.clone() {
                side[i] += weight * v * p.x / (start * p.y);
                row.clone().for_each(|(j, w)| matrix[i * unknown + j] += weight * v * w);
            }
        }
        if field {
            let least = (deviation.max(NOISE) / SMOOTH).powi(2);
            for (i, j) in (0..field::COUNT).flat_map(|i| (0..field::COUNT).map(move |j| (i, j))) {
                let own = if i == j { 1.0 } else { 0.0 };
                matrix[(2 + i) * unknown + 2 + j] += least * (own + rough[i * field::COUNT + j]);
            }
        }
        if usual.is_some() {
            let trust = (deviation / CHANGES).powi(2) * count / count.min(INDEPENDENT);
            matrix[0] += trust;
            side[0] += trust;
        }
        let Some(solved) = Cholesky::with_pivots(unknown, matrix, f64::EPSILON).map(|c| c.solve(side)) else { break };
        fit.contrast = solved[0] * start;
        fit.level = solved[1] * start;
        if field {
            fit.field = Field::new(std::array::from_fn(|node| solved[2 + node] / solved[0]));
        }
    }
    fit.off = fit.deviation(pairs);
    fit
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pairs(seed: u64, hidden: f64) -> Vec<Pair> {
        let rng = Rng::new(seed, "pairs", 0);
        let one = |k: usize| {
            let [x, off, u, v] = [0, 1, 2, 3].map(|i| rng.uniform((4 * k + i) as u64));
            let x = 2.0 * x - 1.0;
            let y = (0.1 * x + 0.4) * (1.0 + 0.02 * (2.0 * off - 1.0));
            // What hides a point is nearer, so that the point is farther than the map shows.
            Pair { x, y: if (k as f64) < 100.0 * hidden { 0.5 * y } else { y }, place: [u, v] }
        };
        (0..100).map(one).collect()
    }

    #[test]
    fn lines_are_found_although_a_third_is_hidden() {
        for seed in 0..8 {
            let line = search(&pairs(seed, 0.33), seed as usize).unwrap();
            assert!((line.contrast - 10.0).abs() < 1.0 && (line.level + 4.0).abs() < 0.4, "{line:?}");
        }
    }

    #[test]
    fn upside_down_is_not_accepted() {
        let turned: Vec<Pair> = pairs(1, 0.0).into_iter().map(|p| Pair { x: -p.x, ..p }).collect();
        assert!(search(&turned, 0).is_none());
    }

    #[test]
    fn other_frames_determine_the_contrast_of_points_at_one_depth() {
        let flat: Vec<Pair> = (0..60)
            .map(|k| Pair { x: 0.05 * f64::from(k % 7) - 0.15, y: 0.4 + 0.01 * f64::from(k % 5 - 2), place: [0.5; 2] })
            .collect();
        let line = refined(&flat, Fit::line(10.0, -4.0), Some(10.0), false);
        assert!((line.contrast / 10.0 - 1.0).abs() < 0.3 && (line.level + 10.0 * 0.4).abs() < 1.3, "{line:?}");
    }

    /// Points on a floor and a wall; the map is x = 10 y (1 + smooth error) − 4.
    fn uneven(smooth: f64, seed: u64) -> Vec<Pair> {
        let rng = Rng::new(seed, "uneven", 0);
        let one = |k: usize| {
            let [u, v, off] = [0, 1, 2].map(|i| rng.uniform((3 * k + i) as u64));
            let y = if v > 0.7 { 0.2 + 0.6 * (v - 0.7) } else { 0.2 };
            let error = smooth * (3.0 * u + seed as f64).sin() * (4.0 * v).cos() + 0.02 * (2.0 * off - 1.0);
            Pair { x: 10.0 * y * (1.0 + error) - 4.0, y, place: [u, v] }
        };
        (0..300).map(one).collect()
    }

    #[test]
    fn smooth_errors_become_a_field_and_noise_does_not() {
        for seed in 0..4 {
            let tilted = uneven(0.15, seed);
            let [line, fit] =
                [refined(&tilted, Fit::line(10.0, -4.0), Some(10.0), false), smooth(&tilted, None, 10.0).unwrap()];
            assert!(fit.off < 0.03 && line.off > 0.05, "{} {}", fit.off, line.off);
            // Something near, at which there are no points.
            for u in [0.2, 0.5, 0.8] {
                let (y, place) = (0.5, [u, 0.5]);
                let x = 10.0 * y * (1.0 + 0.15 * (3.0 * u + seed as f64).sin() * 2.0f64.cos()) - 4.0;
                let off = fit.error(&Pair { x, y, place });
                assert!(off.abs() < 0.06, "seed {seed}, {u}: {off}");
            }
        }
        let even = smooth(&uneven(0.0, 1), None, 10.0).unwrap();
        assert_eq!(even.field, Field::ZERO);
    }
}
