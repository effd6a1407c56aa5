//! Two people in two cameras: whether they are one person, how the cameras then are to each other, and how their clocks.

use super::Cameras;
use super::track::{Track, has_moved};
use crate::sfm::lens::Lens;
use crate::sfm::two_view::{Pair, depths, essential_of, five, motions, polish_motion, sampson};
use splat4d::math::{Rng, Se3};

/// Times of two people that are compared, at most; and at least, each after a movement: people who stay in place fit any
/// pose.
const TIMES: usize = 20;
pub(super) const LEAST_TIMES: usize = 5;
/// Common keypoints, at least.
const LEAST: usize = 40;
/// Samples of five keypoints.
const SAMPLES: usize = 60;
/// Distance from which on a keypoint hardly counts, errors (12 px of 1920).
pub(super) const SCALE: f64 = 2.0;
/// Mean loss ln(1 + (distance/[`SCALE`])²) that separates one person (Pose2Sim's demo: 0.3 to 0.4) from two (0.7 to 1.3).
pub(super) const LOSS: f64 = 0.55;
/// Time offsets of cameras whose clocks are unknown: searched for within this, seconds, in such steps, then in halves.
const LAGS: i32 = 5;
const LAG: f64 = 0.1;
const HALVES: usize = 3;
/// The focal length at which time offsets are searched for, of the larger side: between those of wide and usual lenses.
const TRIAL: f64 = 0.83;
/// Focal lengths that are tried, of the larger side of the image: from wide action cameras to a short telephoto lens.
const FOCALS: [f64; 5] = [0.55, 0.7, 0.9, 1.2, 1.7];

/// Two people who may be one.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fit {
    /// Cameras and the numbers of their tracks.
    pub cameras: [usize; 2],
    pub tracks: [usize; 2],
    /// The second camera's offset minus the first one's, seconds.
    pub lag: f64,
    /// Mean loss of a keypoint.
    pub loss: f64,
    /// Keypoints.
    pub count: usize,
    /// Focal length, of the larger side, and the motion from the first camera to the second.
    pub focal: f64,
    pub motion: Se3,
}

impl Fit {
    /// How much evidence it is that they are one person.
    pub(super) fn gain(&self) -> f64 {
        self.count as f64 * (LOSS - self.loss)
    }
}

/// The best fit for every focal length, the best one first; none: too little in common, or two people.
pub(super) fn fits(all: &Cameras<'_>, cameras: [usize; 2], tracks: [usize; 2]) -> Vec<Fit> {
    let [a, b] = cameras;
    let [x, y] = [&all.tracks[a][tracks[0]], &all.tracks[b][tracks[1]]];
    let rng =
        Rng::new(0, "pairs of people", (a * all.tracks.len() + b) as u64).fork((64 * tracks[0] + tracks[1]) as u64);
    let [known_a, known_b] = cameras.map(|c| all.of[c].offset);
    let start = known_b.unwrap_or(0.0) - known_a.unwrap_or(0.0);
    let loss_at = |lag: f64| {
        let pairs = common(x, y, lag);
        let [p, q] = cameras.map(|c| all.lens(c, TRIAL));
        best(&pairs, [&p, &q], rng).map_or(f64::INFINITY, |found| found.0)
    };
    let mut lag = start;
    if known_a.is_none() || known_b.is_none() {
        let search = |candidates: Vec<f64>| {
            let all: Vec<(f64, f64)> = candidates.into_iter().map(|lag| (loss_at(lag), lag)).collect();
            // Of equals the one nearest to the start.
            all.into_iter()
                .min_by(|p, q| p.0.total_cmp(&q.0).then((p.1 - start).abs().total_cmp(&(q.1 - start).abs())))
                .map_or(start, |found| found.1)
        };
        lag = search((-LAGS..=LAGS).map(|k| start + LAG * f64::from(k)).collect());
        let mut step = LAG;
        for _ in 0..HALVES {
            step *= 0.5;
            lag = search(vec![lag, lag - step, lag + step]);
        }
    }
    let pairs = common(x, y, lag);
    let focals = if cameras.iter().all(|&c| all.of[c].focal.is_some()) { &FOCALS[..1] } else { &FOCALS[..] };
    let fit = |&focal: &f64| {
        let [p, q] = cameras.map(|c| all.lens(c, focal));
        let (loss, motion) = best(&pairs, [&p, &q], rng)?;
        Some(Fit { cameras, tracks, lag, loss, count: pairs.len(), focal, motion })
    };
    let mut found: Vec<Fit> = focals.iter().filter_map(fit).filter(|f| f.loss < LOSS).collect();
    found.sort_by(|p, q| p.loss.total_cmp(&q.loss));
    found
}

/// Positions of common keypoints at times between which one of the two moved; none: too few.
fn common(x: &Track, y: &Track, lag: f64) -> Vec<Pair> {
    let ([from_x, to_x], [from_y, to_y]) = (x.span(), y.span());
    let (from, to) = (from_x.max(from_y + lag), to_x.min(to_y + lag));
    let (mut out, mut times, mut last) = (Vec::new(), 0, None);
    if from > to {
        return out;
    }
    for k in 0..TIMES {
        let time = from + (to - from) * (k as f64 + 0.5) / TIMES as f64;
        let (Some(here), Some(there)) = (x.near(time), y.near(time - lag)) else { continue };
        if last.is_some_and(|(p, q)| !has_moved(p, here) && !has_moved(q, there)) {
            continue;
        }
        (last, times) = (Some((here, there)), times + 1);
        let both = |k: usize| Some([x.seen(time, k)?.pixel, y.seen(time - lag, k)?.pixel]);
        out.extend((0..x.keypoints().min(y.keypoints())).filter_map(both));
    }
    if times < LEAST_TIMES || out.len() < LEAST {
        out.clear();
    }
    out
}

/// The motion between two cameras of these lenses that fits pairs best, and its mean loss.
fn best(pairs: &[Pair], lenses: [&Lens; 2], rng: Rng) -> Option<(f64, Se3)> {
    if pairs.is_empty() {
        return None;
    }
    let ray = |k: usize, pixel: [f64; 2]| {
        let [x, y, _] = lenses[k].ray(pixel);
        [x, y]
    };
    let rays: Vec<Pair> = pairs.iter().map(|&[p, q]| [ray(0, p), ray(1, q)]).collect();
    let square = lenses[0].focal * lenses[1].focal / (SCALE * SCALE);
    let loss = |e: &_| rays.iter().map(|r| (sampson(e, r) * square).ln_1p()).sum::<f64>() / rays.len() as f64;
    let mut found: Option<(f64, [[f64; 3]; 3])> = None;
    for k in 0..SAMPLES {
        let draws = rng.fork(k as u64);
        let sample: [usize; 5] = std::array::from_fn(|i| draws.below(i as u64, rays.len()));
        for e in five(&sample.map(|i| rays[i])) {
            let loss = loss(&e);
            if loss.is_finite() && found.is_none_or(|f| loss < f.0) {
                found = Some((loss, e));
            }
        }
    }
    let (mut least, mut e) = found?;
    // Least squares of those that fit.
    let near: Vec<Pair> = rays.iter().filter(|r| sampson(&e, r) * square < 1.0).copied().collect();
    if near.len() > 5 {
        let polished = essential_of(&polish_motion(&motions(&e)[0], &near));
        let after = loss(&polished);
        if after < least {
            (least, e) = (after, polished);
        }
    }
    // Of the four motions of the matrix that of most points before both cameras.
    let before = |m: &Se3| rays.iter().filter(|r| depths(m, r).iter().all(|z| *z > 0.0)).count();
    let motion = motions(&e).into_iter().max_by_key(|m| before(m)).expect("there are four");
    Some((least, motion))
}
