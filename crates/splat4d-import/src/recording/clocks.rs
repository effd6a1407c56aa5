//! Time offsets of all cameras before poses are known: by sound, then by motion, then from their files.

use super::cache::Cache;
use super::poses::Solved;
use super::stored::Stored;
use super::{Camera, PLACED_LEAST, Report};
use crate::sync::Refusal;
use crate::sync::graph::{self, Evidence, Kind, Offset, Solution};
use crate::sync::motion::{self, Motion};
use crate::sync::sound::{self, SoundTrack};
use crate::video::Selection;
use crate::{Error, ErrorKind, Result};
use rayon::prelude::*;
use splat4d_train::event::Progress;

/// Assumed distance of cameras for sound, metres, if unknown: that of a room; 15 ms.
pub(super) const WAY: f64 = 5.0;
/// Least seconds that all cameras must film at once.
const LEAST_SHARED: f64 = 0.1;
/// Frames a second of cameras that do not state them.
const USUAL_RATE: f64 = 30.0;

/// All pairs of this many.
fn pairs(n: usize) -> Vec<[usize; 2]> {
    (0..n).flat_map(|a| (a + 1..n).map(move |b| [a, b])).collect()
}

/// Lags of all pairs of cameras with sound.
pub(super) fn by_sound(
    cameras: &[Camera],
    cache: &Cache,
    progress: &mut Progress<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<Vec<Evidence>> {
    let prints = cameras.iter().map(|c| c.source.fingerprint()).collect::<Result<Vec<_>>>()?;
    let pairs = pairs(cameras.len());
    let found = cache.pairs("sound", &pairs, &prints, |missing| heard(cameras, missing, progress, stop))?;
    let of = |(cameras, e): (&[usize; 2], Option<Evidence>)| e.map(|e| Evidence { cameras: *cameras, ..e });
    Ok(pairs.iter().zip(found).filter_map(of).collect())
}

/// Lags of some pairs of cameras.
fn heard(
    cameras: &[Camera],
    pairs: &[[usize; 2]],
    progress: &mut Progress<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<Vec<Option<Evidence>>> {
    let mut tracks = Vec::new();
    for (k, camera) in cameras.iter().enumerate() {
        progress.phase("sound", k, cameras.len());
        if stop() {
            return Err(Error::new(ErrorKind::Interrupted, "stopped while sound was read"));
        }
        if !pairs.iter().flatten().any(|c| *c == k) {
            tracks.push(None);
            continue;
        }
        match camera.source.sound() {
            Ok(track) => tracks.push(track.map(SoundTrack::new)),
            Err(e) => {
                progress.warn(format!("camera {}: {e}", camera.name));
                tracks.push(None);
            }
        }
    }
    let of = |&[a, b]: &[usize; 2]| {
        let (x, y) = (tracks[a].as_ref()?, tracks[b].as_ref()?);
        let lag = sound::lag(x, y, None).ok()?;
        // Sound needs time for its way, and its source is not known yet: part of the uncertainty.
        let sigma = lag.sigma.hypot(0.5 * sound::way(WAY));
        Some(Evidence { cameras: [a, b], lag: lag.at_zero(), sigma, drift: lag.drift, kind: Kind::Sound })
    };
    Ok(pairs.par_iter().map(of).collect())
}

/// Evidence of motion.
pub(super) struct Guessed {
    /// Lags that are guessed.
    pub evidence: Vec<Evidence>,
    /// Whether anything moves in two cameras, one of them open, as far as a short recording shows: then clocks matter.
    pub moves: bool,
}

/// Lags by how much moves, of cameras that sound leaves open with all others.
pub(super) fn by_motion(
    stored: &Stored<'_>,
    clock: &Solution,
    cache: &Cache,
    progress: &mut Progress<'_>,
    report: &mut Report,
) -> Result<Guessed> {
    let open = |k: usize| clock.offsets[k].is_none();
    let pairs: Vec<[usize; 2]> =
        pairs(stored.pictures.len()).into_iter().filter(|&[a, b]| open(a) || open(b)).collect();
    let prints: Vec<String> = stored.pictures.iter().map(|p| p.fingerprint.clone()).collect();
    let found = cache.pairs("motion", &pairs, &prints, |missing| seen(stored, missing, progress))?;
    let still = Refusal::Still.to_string();
    let several = stored.pictures.iter().filter(|p| p.shots.len() > 1).count() > 1;
    let moves = several && found.iter().any(|f| f.as_ref().err() != Some(&still));
    let mut out = Vec::new();
    for ([a, b], found) in pairs.into_iter().zip(found) {
        match found {
            Ok([lag, sigma]) => out.push(Evidence { cameras: [a, b], lag, sigma, drift: None, kind: Kind::Motion }),
            Err(why) => {
                let [a, b] = [a, b].map(|c| stored.pictures[c].name.as_str());
                report.motion.push(format!("{a} and {b}: {why}"));
            }
        }
    }
    Ok(Guessed { evidence: out, moves })
}

/// Refuses a take in which something moves and too few clocks are known: it would be seen at other times by every
/// camera, and nothing later could show. How much moves is a guess that other evidence has to confirm, and counts for
/// nothing here.
pub(super) fn check(names: &[&str], solved: &Solved, told: &[Option<f64>], motion: &[String]) -> Result<()> {
    let known = |c: usize| {
        let measured = |o: &Offset| o.kinds.iter().any(|k| *k != Kind::Motion);
        told.get(c).copied().flatten().is_some() || solved.offsets[c].as_ref().is_some_and(measured)
    };
    let placed: Vec<usize> = (0..names.len()).filter(|&c| solved.cameras[c].is_ok()).collect();
    let open: Vec<usize> = placed.iter().copied().filter(|&c| !known(c)).collect();
    if placed.len() < 2 || (placed.len() - open.len()) as f64 >= PLACED_LEAST * placed.len() as f64 {
        return Ok(());
    }
    let guess = |&c: &usize| {
        let o = solved.offsets[c].as_ref().filter(|o| o.sigma > 0.0)?;
        Some(format!("{} {:+.0} ± {:.0} ms", names[c], 1e3 * o.seconds, 1e3 * o.sigma))
    };
    let guesses: Vec<String> = open.iter().filter_map(guess).collect();
    // Clocks of three cameras that are not calibrated are not adjusted: they cannot be separated from positions.
    let seen = match placed.len() {
        ..4 => {
            "geometry gives the time offsets of at least four cameras, or of calibrated ones that see the same motion"
        }
        _ => "too few cameras see the same motion",
    };
    let mut why = vec!["sound agrees of no two of them".to_owned(), seen.to_owned()];
    if let Some(first) = motion.first() {
        why.push(format!("the amount of motion gives no time offset of {first}"));
    }
    if !guesses.is_empty() {
        why.push(format!("it lets guess {}, which nothing confirms", guesses.join(", ")));
    }
    let open: Vec<&str> = open.iter().map(|&c| names[c]).collect();
    Err(Error::input(format!(
        "the time offsets of these cameras are unknown, and something moves: {} ({})",
        open.join(", "),
        why.join("; ")
    ))
    .remedy(
        "If one trigger drives all cameras, use --synchronous. Otherwise set offsets in import.toml (offset, \
         keep_offset = true) and run the same command again: existing results are kept. Or mark one event in all \
         cameras (--assist, docs/assist.md). Next time record sound and clap, or let two cameras at most 20 degrees \
         apart see the same motion for a second.",
    ))
}

/// Lag and standard deviation of some pairs, or why there is none.
fn seen(
    stored: &Stored<'_>,
    pairs: &[[usize; 2]],
    progress: &mut Progress<'_>,
) -> Result<Vec<Result<[f64; 2], String>>> {
    let n = stored.pictures.len();
    let mut moved = Vec::with_capacity(n);
    for (k, pictures) in stored.pictures.iter().enumerate() {
        progress.phase("motion", k, n);
        if !pairs.iter().flatten().any(|c| *c == k) {
            moved.push(Motion::default());
            continue;
        }
        let mut motion = Motion::default();
        for (i, shot) in pictures.shots.iter().enumerate() {
            motion.push(shot.time, &stored.rgb(k, i)?);
        }
        moved.push(motion);
    }
    let of = |&[a, b]: &[usize; 2]| {
        motion::lag(&moved[a], &moved[b], None).map(|f| [f.seconds, f.sigma]).map_err(|why| why.to_string())
    };
    Ok(pairs.iter().map(of).collect())
}

/// Offsets of all cameras from the lags of pairs.
pub(super) fn solve(cameras: &[Camera], evidence: &[Evidence], told: &[Option<f64>]) -> Solution {
    let rate = |c: &Camera| c.source.info().average_rate.or(c.source.info().nominal_rate).unwrap_or(USUAL_RATE);
    let slowest = cameras.iter().map(rate).fold(f64::INFINITY, f64::min);
    graph::solve(cameras.len(), evidence, told, 0.5 / slowest)
}

/// The stored part of each camera: the common time span of the chosen part, on the first camera's clock.
pub(super) fn shared(
    cameras: &[Camera],
    clock: &Solution,
    selection: &Selection,
    report: &mut Report,
) -> Result<Vec<Selection>> {
    let known: Option<Vec<(f64, f64)>> = cameras
        .iter()
        .zip(&clock.offsets)
        .map(|(c, o)| Some((o.as_ref()?.seconds, c.source.info().duration?)))
        .collect();
    let Some(known) = known.filter(|_| cameras.len() > 1) else {
        if cameras.len() > 1 && (selection.from.is_some() || selection.to.is_some()) {
            report.guesses.push(
                "The time range is cut by each file's own clock, because sound does not give the time offsets.".into(),
            );
        }
        return Ok(vec![selection.clone(); cameras.len()]);
    };
    let begin = known.iter().map(|(o, _)| *o).fold(f64::NEG_INFINITY, f64::max);
    let end = known.iter().map(|(o, d)| o + d).fold(f64::INFINITY, f64::min);
    let from = selection.from.map_or(begin, |f| f.max(begin));
    let to = selection.to.map_or(end, |t| t.min(end));
    if to - from < LEAST_SHARED {
        let spans: Vec<String> =
            cameras.iter().zip(&known).map(|(c, (o, d))| format!("{} {:.1} to {:.1} s", c.name, o, o + d)).collect();
        return Err(Error::input(format!("the cameras film nothing at the same time: {}", spans.join(", ")))
            .remedy("Leave out the camera that is apart (use = false in import.toml), or choose another part."));
    }
    let cut = |(offset, duration): &(f64, f64)| Selection {
        from: (from - offset > 0.0).then_some(from - offset),
        to: (to - offset < *duration).then_some(to - offset),
        ..selection.clone()
    };
    Ok(known.iter().map(cut).collect())
}

/// Rejected measurements, a line each.
pub(super) fn refusals(names: &[&str], evidence: &[Evidence], clock: &Solution) -> Vec<String> {
    let line = |r: &graph::Refused| {
        let e = &evidence[r.evidence];
        let off = r.off?;
        let [a, b] = e.cameras.map(|c| names[c]);
        Some(format!("{a} and {b}: {} contradicts the rest by {:.0} ms", e.kind.name(), 1e3 * off.abs()))
    };
    clock.refused.iter().filter_map(line).collect()
}
