//! Clocks of cameras against each other, by motion.

use super::Report;
use super::finding::{AGREE, FindingList, MATCHES, grade, unit};
use super::look::CameraObservations;
use super::shutter::{self, Pair};
use crate::sync::epipolar::{Range, fundamental, lag, neighbours};
use crate::sync::graph::{Evidence, Kind, solve};
use crate::sync::median;
use rayon::prelude::*;
use splat4d_train::capture::Capture;
use splat4d_train::event::Progress;

/// Blur of dynamic regions by a wrong clock, pixels of 1920.
const OFFSET: [f64; 2] = [0.5, 1.5];
/// Standard deviations from which an offset is one, and the least part of a frame: of a hall whose cameras one clock
/// drives up to 0.59 frames were found, other cameras with other settings, so that less than this is no evidence.
const OFFSET_SIGMAS: f64 = 4.0;
const OFFSET_FRAMES: f64 = 0.75;
/// Seconds from the first to the last row of an image, and standard deviations from which on they are believed.
pub(super) const SHUTTER: [f64; 2] = [0.004, 0.010];
const SHUTTER_SIGMAS: f64 = 4.0;
/// Neighbours with which a camera's clock is compared.
const NEIGHBOURS: usize = 3;
/// Range of the search for a time offset, frames, and as a part of the examined ones: right lags are recognised as
/// peaks among many.
const WITHIN: f64 = 10.0;
const WITHIN_PART: f64 = 1.0 / 3.0;

pub(super) fn clocks(capture: &Capture, seen: &[CameraObservations], report: &mut Report, progress: &mut Progress<'_>) {
    let ready: Vec<usize> =
        (0..seen.len()).filter(|&c| capture.cameras[c].fixed && seen[c].tracks.len() >= MATCHES).collect();
    if ready.len() < 2 {
        report.left.push(
            "Clocks were not compared: that needs fixed cameras in which something moves over several frames.".into(),
        );
        return;
    }
    let view = |c: usize| &seen[c].viewpoints[0].view;
    let centers: Vec<_> = (0..seen.len()).map(|c| ready.contains(&c).then(|| view(c).center())).collect();
    let chosen = neighbours(&centers, NEIGHBOURS);
    progress.phase("comparing clocks", 0, chosen.len());
    let interval = ready.iter().map(|&c| seen[c].clock.interval).fold(0.0, f64::max);
    let pairs: Vec<Pair> = chosen
        .par_iter()
        .filter_map(|&[a, b]| {
            let f = fundamental(view(a), view(b));
            let frames = WITHIN.min(WITHIN_PART * seen[a].row.min(seen[b].row) as f64);
            let range = Range { around: 0.0, within: frames * interval };
            let found = lag(&f, [&seen[a].tracks, &seen[b].tracks], None, range).ok()?;
            Some(Pair { cameras: [a, b], f, found })
        })
        .collect();
    let told = |p: &Pair| Evidence {
        cameras: p.cameras,
        lag: p.found.seconds,
        sigma: p.found.sigma,
        drift: None,
        kind: Kind::Geometry,
    };
    let evidence: Vec<Evidence> = pairs.iter().map(told).collect();
    let mut known: Vec<usize> = evidence.iter().flat_map(|e| e.cameras).collect();
    known.sort_unstable();
    known.dedup();
    let Some(&first) = known.first() else {
        report.left.push("Clocks were not compared: no two cameras show the same motion.".into());
        return;
    };
    // The clock of one that is connected, then of the median: whichever camera is off, it is that one.
    let mut given = vec![None; seen.len()];
    given[first] = Some(0.0);
    let solution = solve(seen.len(), &evidence, &given, 0.5 * interval);
    // A lag alone is not checked by any other; the camera that is the clock has a deviation too.
    let kept = |k: &usize| solution.refused.iter().all(|r| r.evidence != *k);
    let sigma = |c: usize| {
        let own = (0..evidence.len()).filter(kept).filter(|&k| evidence[k].cameras.contains(&c));
        let mut all: Vec<f64> = own.map(|k| evidence[k].sigma).collect();
        (all.len() >= AGREE).then(|| median(&mut all))
    };
    let offsets: Vec<(usize, f64, f64)> = (0..seen.len())
        .filter_map(|c| solution.offsets[c].as_ref().zip(sigma(c)).map(|(o, s)| (c, o.seconds, s)))
        .collect();
    let middle = median(&mut offsets.iter().map(|o| o.1).collect::<Vec<_>>());
    for (c, seconds, sigma) in offsets {
        let off = seconds - middle;
        report.cameras[c].offset = Some([off, sigma]);
        let speeds =
            seen[c].tracks.iter().flat_map(|t| t.samples.windows(2)).map(|w| {
                (w[1].1[0] - w[0].1[0]).hypot(w[1].1[1] - w[0].1[1]) / (w[1].0 - w[0].0).max(f64::MIN_POSITIVE)
            });
        let speed = median(&mut speeds.collect::<Vec<_>>()) * unit(view(c));
        let blur = off.abs() * speed;
        let sure = off.abs() > (OFFSET_SIGMAS * sigma).max(OFFSET_FRAMES * interval);
        if let Some(g) = grade(blur, OFFSET).filter(|_| sure) {
            let name = &capture.cameras[c].name;
            let way = if off > 0.0 { "early" } else { "late" };
            let what = format!(
                "Camera {name}: its time offset is {:.1} ± {:.1} ms {way}: motion is displaced by {blur:.1} px (of 1920).",
                1e3 * off.abs(),
                1e3 * sigma
            );
            let remedy = format!("Add {:+.4} s to its times.", off);
            FindingList { report }.add(
                (g, "offset"),
                Some(name),
                (1e3 * off, "ms"),
                what,
                ("Moving objects are blurred or doubled.", &remedy),
            );
        }
    }
    let sound: Vec<Pair> = pairs.into_iter().enumerate().filter(|(k, _)| kept(k)).map(|(_, pair)| pair).collect();
    for (c, shutter) in shutter::shutters(&sound, seen, interval).into_iter().enumerate() {
        report.cameras[c].shutter = shutter;
        let Some([seconds, sigma]) = shutter.filter(|[v, s]| v.abs() > SHUTTER_SIGMAS * s) else { continue };
        if let Some(g) = grade(seconds.abs(), SHUTTER) {
            let name = &capture.cameras[c].name;
            let what = format!(
                "Camera {name} has a rolling shutter: the last row is {:.0} ± {:.0} ms later than the first.",
                1e3 * seconds,
                1e3 * sigma
            );
            let remedy = format!(
                "Give it \"readout\": {seconds:.4} in capture.json: training then renders every row at its own time. A \
                 higher frame rate reads rows faster."
            );
            let words = ("Fast motion leans, and differently in each view.", remedy.as_str());
            FindingList { report }.add((g, "rolling-shutter"), Some(name), (1e3 * seconds, "ms"), what, words);
        }
    }
}
