//! Travel time of sound: once camera positions are known in metres, the delay of each is removed from clocks that only
//! sound determines.

use super::clocks::WAY;
use super::poses::Solved;
use crate::sync::graph::{self, Evidence, Kind, Offset};
use crate::sync::sound::{way, without_way};
use splat4d::math::mat3;
use splat4d::math::se3::{add, dot, norm, normalize, scale, sub};

/// Of the cameras' distance from their target, the standard deviation of the positions of sounds.
const ABOUT: f64 = 0.3;
/// Steps to the positions of sounds; lags are nearly linear in it.
const STEPS: usize = 20;
/// Standard deviations from which on a lag counts less (Huber).
const OUTLIER: f64 = 2.0;
/// A clock of geometry is sure to this many seconds at least.
const SURE: f64 = 1e-3;

/// The correction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Corrected {
    /// How many clocks.
    pub clocks: usize,
    /// By how many seconds the one that moved most.
    pub most: f64,
}

/// Removes the travel time of sound from clocks that sound alone determines. The solution's unit is the metre.
///
/// The positions of sounds are estimated from cameras whose clocks geometry found or users gave: their sound is late by
/// its travel time alone. With fewer cameras, or none, it is the common target of all.
pub(super) fn corrected(
    solved: &mut Solved,
    evidence: &[Evidence],
    told: &[Option<f64>],
    tolerance: f64,
) -> Option<Corrected> {
    let n = solved.cameras.len();
    let place = |c: usize| {
        let stand = solved.cameras[c].as_ref().ok()?;
        stand.poses.iter().flatten().next().map(|p| (p.inverse().translation, p.rotation[2]))
    };
    let places: Vec<Option<([f64; 3], [f64; 3])>> = (0..n).map(place).collect();
    let open: Vec<bool> = (0..n)
        .map(|c| places[c].is_some() && solved.offsets[c].as_ref().is_some_and(|o| by_sound_alone(o, told[c])))
        .collect();
    let heard: Vec<&Evidence> =
        evidence.iter().filter(|e| e.kind == Kind::Sound && e.cameras.iter().all(|&c| places[c].is_some())).collect();
    if !open.contains(&true) || heard.is_empty() {
        return None;
    }
    let (middle, around) = looked_at(&places)?;
    // Clocks that do not hang on sound.
    let fixed: Vec<Option<f64>> = (0..n)
        .map(|c| {
            solved.offsets[c]
                .as_ref()
                .filter(|o| !by_sound_alone(o, told[c]) && (told[c].is_some() || o.kinds.contains(&Kind::Geometry)))
        })
        .map(|o| o.map(|o| o.seconds))
        .collect();
    let source = Source { places: &places, middle, spread: ABOUT * around };
    let (from, spread) = source.heard(&heard, &fixed);
    let distance = |c: usize| norm(sub(places[c].expect("it is placed").0, from));
    let corrected: Vec<Evidence> = heard
        .iter()
        .map(|e| {
            let [a, b] = e.cameras;
            let unsure = norm(source.slope(e, from)) * spread;
            let sigma = own_sigma(e).hypot(unsure);
            Evidence { lag: without_way(e.lag, [distance(a), distance(b)]), sigma, ..(*e).clone() }
        })
        .collect();
    let mut given = fixed;
    if given.iter().all(Option::is_none) {
        // The clock of all stays the one that it was.
        given[0] = solved.offsets[0].as_ref().map(|o| o.seconds);
    }
    let clock = graph::solve(n, &corrected, &given, tolerance);
    let mut out = Corrected { clocks: 0, most: 0.0 };
    for (c, new) in clock.offsets.into_iter().enumerate() {
        let (Some(own), Some(new)) = (solved.offsets[c].as_mut().filter(|_| open[c] && given[c].is_none()), new) else {
            continue;
        };
        out.clocks += 1;
        out.most = out.most.max((new.seconds - own.seconds).abs());
        (own.seconds, own.sigma) = (new.seconds, new.sigma);
    }
    (out.clocks > 0).then_some(out)
}

fn by_sound_alone(offset: &Offset, told: Option<f64>) -> bool {
    told.is_none() && offset.kinds.contains(&Kind::Sound) && !offset.kinds.contains(&Kind::Geometry)
}

/// Whether sound alone determines a clock.
pub(super) fn hangs_on_sound(solved: &Solved, told: &[Option<f64>]) -> bool {
    solved.offsets.iter().zip(told).any(|(o, t)| o.as_ref().is_some_and(|o| by_sound_alone(o, *t)))
}

/// The standard deviation of a lag without that of its way, which was put into it.
fn own_sigma(e: &Evidence) -> f64 {
    (e.sigma.powi(2) - (0.5 * way(WAY)).powi(2)).max(SURE * SURE).sqrt()
}

/// The point nearest to the axes of all cameras, and their median distance from it.
fn looked_at(places: &[Option<([f64; 3], [f64; 3])>]) -> Option<([f64; 3], f64)> {
    let known: Vec<_> = places.iter().flatten().collect();
    let middle = mat3::nearest_to_lines(known.iter().copied().copied())?;
    let mut distances: Vec<f64> = known.iter().map(|(center, _)| norm(sub(*center, middle))).collect();
    distances.sort_by(f64::total_cmp);
    distances.get(distances.len() / 2).map(|d| (middle, *d))
}

/// Positions of sounds.
struct Source<'a> {
    places: &'a [Option<([f64; 3], [f64; 3])>],
    /// Prior position of a sound, and its standard deviation.
    middle: [f64; 3],
    spread: f64,
}

impl Source<'_> {
    /// How a lag changes with the position of the source, seconds a metre.
    fn slope(&self, e: &Evidence, from: [f64; 3]) -> [f64; 3] {
        let to = |c: usize| normalize(sub(from, self.places[c].expect("it is placed").0));
        let [a, b] = e.cameras;
        sub(to(b), to(a)).map(way)
    }

    /// The most likely position by lags of cameras whose clocks are known, and its standard deviation. (Gauss and
    /// Newton; differences of times of arrival.)
    fn heard(&self, lags: &[&Evidence], clocks: &[Option<f64>]) -> ([f64; 3], f64) {
        let known: Vec<(&Evidence, f64)> = lags
            .iter()
            .filter_map(|e| {
                let [a, b] = e.cameras;
                Some((*e, e.lag - (clocks[a]? - clocks[b]?)))
            })
            .collect();
        let mut from = self.middle;
        let mut spread = self.spread;
        for _ in 0..STEPS {
            let weight = 1.0 / self.spread.powi(2);
            let mut a = [[0.0; 3]; 3];
            let mut b = scale(sub(self.middle, from), weight);
            (0..3).for_each(|k| a[k][k] = weight);
            for (e, late) in &known {
                let distance = |c: usize| norm(sub(self.places[c].expect("it is placed").0, from));
                let off = late - way(distance(e.cameras[1]) - distance(e.cameras[0]));
                let sigma = own_sigma(e).hypot(SURE);
                let w = (OUTLIER * sigma / off.abs().max(1e-12)).min(1.0) / sigma.powi(2);
                let slope = self.slope(e, from);
                b = add(b, scale(slope, w * off));
                for r in 0..3 {
                    (0..3).for_each(|k| a[r][k] += w * slope[r] * slope[k]);
                }
            }
            let Some(step) = mat3::solve(a, b) else { break };
            from = add(from, step);
            // The root mean square over directions.
            let variance = |k: usize| {
                let mut unit = [0.0; 3];
                unit[k] = 1.0;
                mat3::solve(a, unit).map_or(self.spread.powi(2), |x| dot(x, unit))
            };
            spread = ((0..3).map(variance).sum::<f64>() / 3.0).sqrt();
        }
        (from, spread)
    }
}

#[cfg(test)]
mod tests {
    use super::super::poses::SolvedCamera;
    use super::*;
    use splat4d::math::Se3;
    use splat4d::scene::{Intrinsics, Lens};

    /// Cameras on an arc of several metres, their clocks, and what they hear of a clap somewhere.
    fn take(source: [f64; 3], geometry: usize) -> (Solved, Vec<Evidence>, Vec<f64>) {
        let n = 7;
        let place = |c: usize| {
            let angle = 0.5 * c as f64;
            let far = 4.0 + 1.5 * (c % 3) as f64;
            [far * angle.cos(), far * angle.sin(), 1.0 + 0.5 * (c % 2) as f64]
        };
        let truth: Vec<f64> = (0..n).map(|c| if c == 0 { 0.0 } else { 0.1 * c as f64 - 0.25 }).collect();
        let distance = |c: usize| norm(sub(place(c), source));
        let mut evidence = Vec::new();
        for a in 0..n {
            for b in a + 1..n {
                let lag = truth[a] - truth[b] + way(distance(b) - distance(a));
                let sigma = 3e-4f64.hypot(0.5 * way(WAY));
                evidence.push(Evidence { cameras: [a, b], lag, sigma, drift: None, kind: Kind::Sound });
            }
        }
        let heard = graph::solve(n, &evidence, &[], 0.02);
        let stand = |c: usize| {
            let pose = Se3::look_at(place(c), [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]);
            let intrinsics = Intrinsics { fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0 };
            SolvedCamera {
                poses: vec![Some(pose)],
                fixed: true,
                intrinsics,
                lens: Lens::Pinhole,
                sightings: 100,
                error: 0.3,
            }
        };
        let offsets = heard
            .offsets
            .into_iter()
            .enumerate()
            .map(|(c, o)| {
                let mut o = o.expect("all are heard");
                if c > 0 && c <= geometry {
                    o = Offset { seconds: truth[c], sigma: 2e-3, kinds: vec![Kind::Geometry, Kind::Sound], ..o };
                }
                Some(o)
            })
            .collect();
        let solved = Solved {
            cameras: (0..n).map(|c| Ok(stand(c))).collect(),
            offsets,
            points: Vec::new(),
            up: [0.0, 0.0, 1.0],
            moving: false,
            contradiction: Vec::new(),
            stray: Vec::new(),
        };
        (solved, evidence, truth)
    }

    fn worst(solved: &Solved, truth: &[f64]) -> f64 {
        let off = |(o, t): (&Option<Offset>, &f64)| (o.as_ref().expect("it has one").seconds - t).abs();
        solved.offsets.iter().zip(truth).map(off).fold(0.0, f64::max)
    }

    #[test]
    fn the_travel_time_of_sound_is_subtracted() {
        let (mut solved, evidence, truth) = take([0.3, -0.2, 1.0], 0);
        assert!(worst(&solved, &truth) > 6e-3, "the way matters here");
        let done = corrected(&mut solved, &evidence, &[None; 7], 0.02).expect("clocks hang on sound");
        // All but the one that is the clock.
        assert_eq!(done.clocks, 6);
        assert!(worst(&solved, &truth) < 2e-3, "{}", worst(&solved, &truth));
    }

    #[test]
    fn time_offsets_from_geometry_locate_the_sound() {
        let source = [1.2, 1.9, 0.5];
        let (mut alone, evidence, truth) = take(source, 0);
        corrected(&mut alone, &evidence, &[None; 7], 0.02).expect("clocks hang on sound");
        let (mut solved, evidence, _) = take(source, 4);
        let before = solved.offsets.clone();
        let mut told = [None; 7];
        told[0] = Some(0.0);
        let done = corrected(&mut solved, &evidence, &told, 0.02).expect("two clocks hang on sound");
        assert_eq!(done.clocks, 2);
        assert_eq!(solved.offsets[..5], before[..5], "what geometry found stays");
        assert!(worst(&solved, &truth) < 1e-3, "{}", worst(&solved, &truth));
        assert!(worst(&alone, &truth) > 2.0 * worst(&solved, &truth), "without them it is a guess");
    }

    #[test]
    fn time_offsets_not_from_sound_stay() {
        let (mut solved, evidence, _) = take([0.0; 3], 6);
        solved.offsets[0].as_mut().expect("it has one").kinds = vec![Kind::Geometry];
        let before = solved.offsets.clone();
        assert_eq!(corrected(&mut solved, &evidence, &[None; 7], 0.02), None);
        assert_eq!(solved.offsets, before);
    }
}
