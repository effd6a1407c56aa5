//! Lags by motion, of cameras with known poses: features need no match across viewpoints.

use super::cache::Cache;
use super::stored::Stored;
use crate::Result;
use crate::sync::epipolar::{Range, fundamental, lag, neighbours};
use crate::sync::graph::{Evidence, Kind, Solution};
use crate::sync::grey::Grey;
use crate::sync::tracks::{APART, Track, Tracker, moving, small};
use rayon::prelude::*;
use splat4d::scene::Camera;
use splat4d_train::event::Progress;

/// Frames in a row in which corners are followed.
const WINDOW: usize = 90;
/// Part of them for the search of a time offset: right lags are recognised as peaks among many.
const WITHIN: f64 = 1.0 / 3.0;
/// Corners of a camera that are followed, as in the doctor.
const TRACKS: usize = 60;
/// Frames that it takes: among fewer lags, a wrong one can be a peak as well (of 14 frames of the bundled capture, one
/// was a frame off).
const SHORTEST: usize = 30;
/// Neighbours that each camera is compared with.
const NEIGHBOURS: usize = 3;

/// A fixed camera, as a pinhole camera, and corners that move in it, by its own clock.
struct FixedCamera {
    camera: Camera,
    tracks: Vec<Track>,
    frames: usize,
}

/// Lags of neighbouring cameras. `clock` gives the approximate lag.
pub(super) fn by_geometry(
    stored: &Stored<'_>,
    clock: &Solution,
    cache: &Cache,
    progress: &mut Progress<'_>,
) -> Result<Vec<Evidence>> {
    let offsets: Vec<Option<f64>> = clock.offsets.iter().map(|o| o.as_ref().map(|o| o.seconds)).collect();
    let made_of = format!("{} {offsets:?}", stored.fingerprint());
    cache.or("geometry", &made_of, || measured(stored, clock, progress))
}

fn measured(stored: &Stored<'_>, clock: &Solution, progress: &mut Progress<'_>) -> Result<Vec<Evidence>> {
    let n = stored.pictures.len();
    let offset = |c: usize| clock.offsets[c].as_ref().map_or(0.0, |o| o.seconds);
    let ends = |c: usize| {
        let shots = &stored.pictures[c].shots;
        (shots[0].time + offset(c), shots[shots.len() - 1].time + offset(c))
    };
    let first = (0..n).map(|c| ends(c).0).fold(f64::NEG_INFINITY, f64::max);
    let last = (0..n).map(|c| ends(c).1).fold(f64::INFINITY, f64::min);
    let middle = 0.5 * (first + last);
    let mut seen = Vec::with_capacity(n);
    for c in 0..n {
        progress.phase("tracking moving parts", c, n);
        seen.push(camera(stored, c, middle - offset(c))?);
    }
    let centers: Vec<_> = seen.iter().map(|s| s.as_ref().map(|s| s.camera.center())).collect();
    let pairs = neighbours(&centers, NEIGHBOURS);
    let of = |&[a, b]: &[usize; 2]| {
        let (p, q) = (seen[a].as_ref()?, seen[b].as_ref()?);
        let interval = stored.pictures[a].clock.interval.max(stored.pictures[b].clock.interval);
        let within = WITHIN * p.frames.min(q.frames) as f64 * interval;
        let range = Range { around: offset(a) - offset(b), within };
        let found = lag(&fundamental(&p.camera, &q.camera), [&p.tracks, &q.tracks], None, range).ok()?;
        Some(Evidence { cameras: [a, b], lag: found.seconds, sigma: found.sigma, drift: None, kind: Kind::Geometry })
    };
    Ok(pairs.par_iter().filter_map(of).collect())
}

fn camera(stored: &Stored<'_>, c: usize, middle: f64) -> Result<Option<FixedCamera>> {
    let Some((known, pose)) = stored.known(c).and_then(|k| Some((k, k.pose?))) else { return Ok(None) };
    let shots = &stored.pictures[c].shots;
    let count = shots.len();
    if count < SHORTEST {
        return Ok(None);
    }
    let still = stored.median(c, |picture| small(picture).0)?;
    let still = Grey::of(&still);
    let nearest = shots.partition_point(|s| s.time < middle).min(count - 1);
    let row = count.min(WINDOW);
    let first = nearest.saturating_sub(row / 2).min(count - row);
    let mut tracker = Tracker::new(TRACKS, APART);
    let (mut size, mut factor) = ([0, 0], 1.0);
    for (k, shot) in shots.iter().enumerate().skip(first).take(row) {
        let (picture, by) = small(stored.rgb(c, k)?);
        (size, factor) = ([picture.width, picture.height], by);
        let grey = Grey::of(&picture);
        let mask = moving(&grey, &still);
        tracker.push(shot.time, grey, Some(&mask));
    }
    let straight = known.straight(size, factor);
    let mut tracks = tracker.finish();
    for track in &mut tracks {
        track.samples = track.samples.iter().map_while(|(t, p)| Some((*t, straight.pixel(*p)?))).collect();
    }
    tracks.retain(|t| !t.samples.is_empty());
    Ok(Some(FixedCamera { camera: straight.camera(pose, size), tracks, frames: row }))
}
