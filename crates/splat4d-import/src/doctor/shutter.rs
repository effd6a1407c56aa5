//! Rolling shutters: a camera that reads its images row by row captures the lower rows later than the upper ones, and
//! what moves leaves its epipolar line by as much.

use super::look::CameraObservations;
use crate::sync::epipolar::{EpipolarLag, sampson};
use crate::sync::{NORMAL_MAD, median};
use splat4d::math::cholesky::Cholesky;

/// Seconds from the first to the last row that cameras usually have: telephones 10 to 30 ms, film cameras less.
const USUAL: f64 = 0.02;
/// Part of the interval between frames over which the speed of leaving a line is measured.
const STEP: f64 = 0.25;
/// Rounds of weights by Cauchy's function.
const ROUNDS: usize = 4;
/// Pixels that corners are off at least.
const EXACT: f64 = 0.02;
/// Pairs of tracks that a camera needs.
const TRACKS: usize = 12;

/// Two cameras and the tracks of what both see.
pub(super) struct Pair {
    pub(super) cameras: [usize; 2],
    pub(super) f: [[f64; 3]; 3],
    pub(super) found: EpipolarLag,
}

/// A time of a pair of tracks: distance from the line, how fast it grows with the lag, rows of both cameras (−½ to ½).
struct Sighting {
    off: f64,
    speed: f64,
    rows: [f64; 2],
}

/// Seconds between the first and the last row of each camera's images with their standard deviations; None where too
/// few
/// tracks show. Shutters that all cameras share alike show less than their differences, which the deviation states.
///
/// Of one event the cameras a and b have the times t and s with `s − t = lag + r_a·ρ_a − r_b·ρ_b` (r: seconds over the
/// image, ρ: row from −½ to ½), so that at `s = t + lag` the distance from the line and its speed times what is missing
/// sum to nothing, to first order. Least squares over all r and a correction of each lag; deviations by clusters of
/// tracks (White 1980), for what is wrong with a track is wrong at all of its times.
pub(super) fn shutters(pairs: &[Pair], seen: &[CameraObservations], interval: f64) -> Vec<Option<[f64; 2]>> {
    let clusters: Vec<(usize, Vec<Sighting>)> = (pairs.iter().enumerate())
        .flat_map(|(k, p)| p.found.matches.iter().map(move |m| (k, sightings(p, *m, seen, STEP * interval))))
        .filter(|(_, s)| !s.is_empty())
        .collect();
    let n = seen.len();
    let all = n + pairs.len();
    let scale = |pair: usize| {
        let own = clusters.iter().filter(|(k, _)| *k == pair).flat_map(|(_, s)| s.iter().map(|s| s.off.abs()));
        (NORMAL_MAD * median(&mut own.collect::<Vec<_>>())).max(EXACT)
    };
    let mut values = vec![0.0; all];
    let prior = |k: usize| if k < n { USUAL.powi(-2) } else { interval.powi(-2) };
    let row = |pair: usize, s: &Sighting| {
        let [a, b] = pairs[pair].cameras;
        [(a, s.speed * s.rows[0]), (b, -s.speed * s.rows[1]), (n + pair, s.speed)]
    };
    let scales: Vec<f64> = (0..pairs.len()).map(scale).collect();
    let mut deviations = vec![0.0; n];
    for round in 0..ROUNDS {
        let mut matrix = vec![0.0; all * all];
        let mut right = vec![0.0; all];
        let mut pulls = Vec::with_capacity(clusters.len());
        (0..all).for_each(|k| matrix[k * all + k] = prior(k));
        for (pair, moments) in &clusters {
            // The times of a track count as one.
            let part = 1.0 / moments.len() as f64;
            let mut pull = Vec::<(usize, f64)>::new();
            for s in moments {
                let j = row(*pair, s);
                let rest = s.off + j.iter().map(|(k, v)| v * values[*k]).sum::<f64>();
                let weight = part / (scales[*pair].powi(2) * (1.0 + (rest / scales[*pair]).powi(2)));
                for (k, v) in j {
                    right[k] -= weight * v * s.off;
                    pull.push((k, weight * v * rest));
                    j.iter().for_each(|(l, w)| matrix[k * all + l] += weight * v * w);
                }
            }
            pulls.push(pull);
        }
        let Some(factor) = Cholesky::new(all, matrix) else { return vec![None; n] };
        values = factor.solve(right);
        if round + 1 == ROUNDS {
            for (c, deviation) in deviations.iter_mut().enumerate() {
                let mut one = vec![0.0; all];
                one[c] = 1.0;
                let column = factor.solve(one);
                let of = |pull: &Vec<(usize, f64)>| pull.iter().map(|(k, v)| v * column[*k]).sum::<f64>().powi(2);
                let told: f64 = pulls.iter().map(of).sum();
                // And the prior, which pulls towards zero.
                let drawn: f64 = (0..all).map(|k| prior(k) * column[k] * column[k]).sum();
                *deviation = (told + drawn).sqrt();
            }
        }
    }
    let tracks = |c: usize| clusters.iter().filter(|(k, _)| pairs[*k].cameras.contains(&c)).count();
    (0..n).map(|c| (tracks(c) >= TRACKS).then(|| [values[c], deviations[c]])).collect()
}

fn sightings(pair: &Pair, [i, j]: [usize; 2], seen: &[CameraObservations], step: f64) -> Vec<Sighting> {
    let [a, b] = pair.cameras;
    let (one, other) = (&seen[a].tracks[i], &seen[b].tracks[j]);
    let height = |c: usize| seen[c].viewpoints[0].view.height as f64;
    let lag = pair.found.seconds;
    let of = |&(t, _): &(f64, [f64; 2])| {
        let x = one.smooth(t)?;
        let at = |l: f64| other.smooth(t + l).map(|y| (y, sampson(&pair.f, x, y)));
        let (before, (y, off), after) = (at(lag - step)?.1, at(lag)?, at(lag + step)?.1);
        let speed = (after - before) / (2.0 * step);
        Some(Sighting { off, speed, rows: [x[1] / height(a) - 0.5, y[1] / height(b) - 0.5] })
    };
    one.samples.iter().filter_map(of).collect()
}
