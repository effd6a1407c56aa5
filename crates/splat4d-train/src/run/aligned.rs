//! Depth maps that are known up to a scale and a shift become metric: each is fitted to the capture's points.
//!
//! Gaussians begin on metric maps only, which is what maps gain (studies/records/2026-11-28-models.md). A single image
//! determines its shift badly where its points are at similar depths, so contrasts of a camera's maps are fused: how much the
//! inverse depth varies over an image changes slowly from frame to frame.

use super::open::{OpenCapture, training_frames};
use crate::Result;
use crate::capture::{Capture, DepthFit, DepthKind, depth_map};
use crate::recipe::Recipe;
use rayon::prelude::*;
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
/// Errors of an inverse depth from this share on count alike in the search: points that something hides.
const HIDDEN: f64 = 0.1;
/// A falling line that leaves less than this share of the rising one's errors: the map is upside down.
const FALLING: f64 = 0.7;
/// Share of the points in an image that nothing hides, at least: fits are judged by the closest this many, whose largest error
/// is this share of a standard deviation.
const VISIBLE: f64 = 0.3;
const OF_DEVIATION: f64 = 0.385;
/// Rounds of reweighting.
const ROUNDS: usize = 20;
/// Least spread of errors that reweighting assumes.
const SHARPEST: f64 = 1e-3;
/// How much contrasts of one camera's maps vary over time, relative.
const CHANGES: f64 = 0.2;
/// Errors of neighbouring pixels are alike: an image has as many independent ones, at most.
const INDEPENDENT: f64 = 16.0;
/// A map whose errors have more than this standard deviation (relative) does not show the points at any scale and shift.
const FOREIGN: f64 = 0.2;
/// Depths outside of those of the points by more than this factor are guesses, and count as unknown.
const BEYOND: f64 = 4.0;

/// What a map and the points in its image have in common.
struct Sample {
    /// Of [`Capture::frames`].
    frame: usize,
    /// Median and spread of the map.
    center: f64,
    spread: f64,
    /// Standardised values of the map, and what they are to become.
    pairs: Vec<[f64; 2]>,
    /// Nearest and farthest of the points.
    range: [f64; 2],
}

/// Slope and value at 0 of a line, and the standard deviation of relative errors of what is visible.
#[derive(Clone, Copy, Debug)]
struct Line {
    slope: f64,
    level: f64,
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
    let first: Vec<Option<Line>> = samples.par_iter().map(|s| search(&s.pairs, s.frame)).collect();
    let mut slopes: BTreeMap<usize, Vec<f64>> = BTreeMap::new();
    for (sample, line) in samples.iter().zip(&first) {
        let camera = opened.capture.frames[sample.frame].camera;
        slopes.entry(camera).or_default().extend(line.map(|l| l.slope));
    }
    let usual: BTreeMap<usize, f64> =
        slopes.iter_mut().filter_map(|(camera, slopes)| Some((*camera, median(slopes)?))).collect();
    let mut fits: BTreeMap<usize, DepthFit> = BTreeMap::new();
    for (sample, line) in samples.iter().zip(first) {
        let camera = opened.capture.frames[sample.frame].camera;
        let Some(&usual) = usual.get(&camera) else { continue };
        let mut levels: Vec<f64> = sample.pairs.iter().map(|[x, y]| y - usual * x).collect();
        let Some(level) = median(&mut levels) else { continue };
        let begin =
            line.filter(|l| (l.slope / usual - 1.0).abs() < CHANGES).unwrap_or(Line { slope: usual, level, off: 0.0 });
        let line = refined(&sample.pairs, begin, Some(usual));
        if line.off > FOREIGN || line.slope <= 0.0 {
            continue;
        }
        let kind = opened.capture.frames[sample.frame].depth.as_ref().map(|d| d.kind);
        fits.insert(
            sample.frame,
            DepthFit {
                inverse: kind == Some(DepthKind::Inverse),
                scale: line.slope / sample.spread,
                shift: line.level - line.slope * sample.center / sample.spread,
                range: [sample.range[0] / BEYOND, sample.range[1] * BEYOND],
            },
        );
    }
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
            pairs.push([(value - center) / spread, if file.kind == DepthKind::Inverse { 1.0 / z } else { z }]);
            range = [range[0].min(z), range[1].max(z)];
        }
    }
    Ok((pairs.len() >= FEW).then_some(Sample { frame, center, spread, pairs, range }))
}

/// The rising line on which most pairs are: of two of them, then refined. `None`: no two rise.
fn search(pairs: &[[f64; 2]], frame: usize) -> Option<Line> {
    let rng = Rng::new(frame as u64, "depth alignment", 0);
    let (mut best, mut falling): (Option<(f64, Line)>, f64) = (None, f64::INFINITY);
    for k in 0..TRIES {
        let [a, b] = [2 * k, 2 * k + 1].map(|i| pairs[rng.below(i as u64, pairs.len())]);
        let slope = (a[1] - b[1]) / (a[0] - b[0]);
        if !slope.is_finite() {
            continue;
        }
        let line = Line { slope, level: a[1] - slope * a[0], off: 0.0 };
        let cost: f64 = pairs.iter().map(|p| line.error(p).abs().min(HIDDEN)).sum();
        if slope <= 0.0 {
            falling = falling.min(cost);
        } else if best.is_none_or(|(least, _)| cost < least) {
            best = Some((cost, line));
        }
    }
    best.filter(|(cost, _)| falling >= FALLING * cost).map(|(_, line)| refined(pairs, line, None))
}

impl Line {
    /// Relative to what the pair is to become.
    fn error(&self, [x, y]: &[f64; 2]) -> f64 {
        (self.slope * x + self.level) / y - 1.0
    }

    /// The standard deviation of the errors of what is visible.
    fn deviation(&self, pairs: &[[f64; 2]]) -> f64 {
        let mut errors: Vec<f64> = pairs.iter().map(|p| self.error(p).abs()).collect();
        let at = (VISIBLE * errors.len() as f64) as usize;
        *errors.select_nth_unstable_by(at, f64::total_cmp).1 / OF_DEVIATION
    }
}

/// Least squares with Cauchy's weights from a line on. `usual`: the slope that other frames have.
fn refined(pairs: &[[f64; 2]], mut line: Line, usual: Option<f64>) -> Line {
    let n = pairs.len() as f64;
    for _ in 0..ROUNDS {
        let deviation = line.deviation(pairs).max(SHARPEST);
        let [mut xx, mut x1, mut one, mut xy, mut y1] = [0.0; 5];
        for p in pairs {
            let [x, y] = *p;
            let weight = 1.0 / ((1.0 + (line.error(p) / (2.0 * deviation)).powi(2)) * y * y);
            xx += weight * x * x;
            x1 += weight * x;
            one += weight;
            xy += weight * x * y;
            y1 += weight * y;
        }
        if let Some(usual) = usual {
            let trust = (deviation / (CHANGES * usual)).powi(2) * n / n.min(INDEPENDENT);
            xx += trust;
            xy += trust * usual;
        }
        let determinant = xx * one - x1 * x1;
        if determinant <= 0.0 || !determinant.is_finite() {
            break;
        }
        line = Line { slope: (xy * one - x1 * y1) / determinant, level: (xx * y1 - x1 * xy) / determinant, off: 0.0 };
    }
    line.off = line.deviation(pairs);
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pairs(seed: u64, hidden: f64) -> Vec<[f64; 2]> {
        let rng = Rng::new(seed, "pairs", 0);
        let one = |k: usize| {
            let x = 2.0 * rng.uniform(2 * k as u64) - 1.0;
            let y = (0.1 * x + 0.4) * (1.0 + 0.02 * (2.0 * rng.uniform(2 * k as u64 + 1) - 1.0));
            // What hides a point is nearer, so that the point is farther than the map shows.
            [x, if (k as f64) < 100.0 * hidden { 0.5 * y } else { y }]
        };
        (0..100).map(one).collect()
    }

    #[test]
    fn lines_are_found_although_a_third_is_hidden() {
        for seed in 0..8 {
            let line = search(&pairs(seed, 0.33), seed as usize).unwrap();
            assert!((line.slope - 0.1).abs() < 0.01 && (line.level - 0.4).abs() < 0.01, "{line:?}");
        }
    }

    #[test]
    fn upside_down_is_not_accepted() {
        let turned: Vec<[f64; 2]> = pairs(1, 0.0).into_iter().map(|[x, y]| [-x, y]).collect();
        assert!(search(&turned, 0).is_none());
    }

    #[test]
    fn other_frames_determine_the_slope_of_points_at_one_depth() {
        let flat: Vec<[f64; 2]> =
            (0..60).map(|k| [0.05 * f64::from(k % 7) - 0.15, 0.4 + 0.01 * f64::from(k % 5 - 2)]).collect();
        let line = refined(&flat, Line { slope: 0.1, level: 0.4, off: 0.0 }, Some(0.1));
        assert!((line.slope / 0.1 - 1.0).abs() < 0.3 && (line.level - 0.4).abs() < 0.01, "{line:?}");
    }
}
