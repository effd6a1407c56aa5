//! Times of a transforms file, and the cameras that took its frames.

use super::super::account::{Account, Aspect, Severity};
use super::super::frames::half_frame;
use super::super::sequence::{FrameOrder, Timing};
use super::super::{CaptureOptions, Sequence, Times, pose, rig};
use super::frame::Entry;
use splat4d::math::Se3;
use std::collections::BTreeMap;

/// Rounding that a time of 1 may have.
const ROUNDING: f64 = 1e-6;
/// How far steps may be from one frame, of it: rounding to two digits.
const NEAR_STEP: f64 = 0.02;
/// Part of the unit that fractions fill at least; a capture shorter than a second, in seconds, mostly does not.
const FILLED: f64 = 0.9;
/// Frame rates of cameras, frames per second.
const RATES: [f64; 13] = [23.976, 24.0, 25.0, 29.97, 30.0, 48.0, 50.0, 59.94, 60.0, 90.0, 100.0, 120.0, 240.0];
/// How much shorter than a frame the usual step of a camera may be: frame rates that vary.
const FEWER: f64 = 0.2;
/// A step of so few frames that is this far from a whole number of them is of another rate.
const FEW_FRAMES: f64 = 3.0;
const BETWEEN: f64 = 0.1;
/// Frames between neighbouring times from which another unit than seconds is likelier than a time lapse.
const MANY_FRAMES: f64 = 29.5;

/// Seconds from which the start of a clock is subtracted: lifespans are f32, which has steps of a millisecond there.
const FAR_CLOCK: f64 = 1e4;

/// Frames per second.
#[derive(Clone, Copy)]
pub(super) struct Rate {
    pub fps: f64,
    /// Whether the file, or the user, states it.
    pub stated: bool,
}

/// Unit of times, its seconds, and the reason for doubt.
struct Reading {
    times: Times,
    scale: f64,
    /// Frames per second, where the steps give them.
    fps: f64,
    doubt: Option<String>,
}

/// Cameras, frame numbers and seconds where every frame has a time, and the frame rate. `None`: not every frame has
/// one.
pub(super) fn read_times(
    entries: &[Entry],
    rate: Rate,
    options: &CaptureOptions,
    several: bool,
    account: &mut Account,
) -> Option<(FrameOrder, f64)> {
    let stated: Option<Vec<f64>> = entries.iter().map(|e| e.time).collect();
    let Some(times) = stated.filter(|t| !t.is_empty()) else {
        let without = entries.iter().filter(|e| e.time.is_none()).count();
        if without < entries.len() {
            let what = format!("{without} of {} frames have no time: no time is used.", entries.len());
            account.add(Aspect::NotRead, Severity::Warning, what);
        }
        return None;
    };
    if options.sequence != Sequence::Auto {
        let what = "The capture states its times: capture.sequence changes nothing.".into();
        account.add(Aspect::NotRead, Severity::Warning, what);
    }
    // Files of their own for what is held out: the clock is that of the training frames (D-NeRF).
    let counts = |e: &Entry| !several || e.split == super::Split::Train;
    let mut instants: Vec<f64> = entries.iter().zip(&times).filter(|(e, _)| counts(e)).map(|(_, t)| *t).collect();
    instants.sort_by(f64::total_cmp);
    instants.dedup();
    let (cameras, of, named) = cameras(entries, &times);
    let reading = read(entries, (&times, &instants, &of), rate, options);
    report(&reading, &instants, rate, account);
    let start = instants.first().map_or(0.0, |first| first * reading.scale);
    let start = if start.abs() > FAR_CLOCK { start } else { 0.0 };
    if start != 0.0 {
        let what = format!(
            "The clock begins at {start} s, as one that counts from a date: that is subtracted from all times."
        );
        account.add(Aspect::Assumed, Severity::Note, what);
    }
    let place = |(camera, &t): (usize, &f64)| (camera, nearest(&instants, t), t * reading.scale - start);
    let frames = of.into_iter().zip(&times).map(place).collect();
    Some((FrameOrder { cameras, frames, named, timing: Timing::Told }, reading.fps))
}

/// Whether a step is one frame at this rate.
fn is_frame(step: f64, fps: f64) -> bool {
    (step * fps - 1.0).abs() <= NEAR_STEP
}

/// Unit of the times.
fn read(
    entries: &[Entry],
    (times, instants, of_camera): (&[f64], &[f64], &[usize]),
    rate: Rate,
    options: &CaptureOptions,
) -> Reading {
    let fps = rate.fps;
    let step = instants.windows(2).map(|w| w[1] - w[0]).fold(f64::INFINITY, f64::min);
    let count = instants.len();
    let of = |times: Times| Reading {
        times,
        scale: match times {
            Times::Fractions => options.unit_time_seconds.unwrap_or(count.saturating_sub(1) as f64 / fps),
            Times::Frames => 1.0 / fps,
            _ => 1.0,
        },
        fps,
        doubt: None,
    };
    let doubt = |times: Times, doubt: String| Reading { doubt: Some(doubt), ..of(times) };
    match options.times {
        Times::Auto => {}
        chosen => return of(chosen),
    }
    let unit = times.iter().all(|t| (-ROUNDING..=1.0 + ROUNDING).contains(t));
    if unit {
        if options.unit_time_seconds.is_some() || count < 2 {
            return of(Times::Fractions);
        }
        if rate.stated && is_frame(step, fps) && count > 2 {
            return of(Times::Seconds);
        }
        let filled = (instants[count - 1] - instants[0]) * count as f64 / (count - 1) as f64;
        if filled >= FILLED {
            return of(Times::Fractions);
        }
        // Parts of a capture end at 1; these are a whole number of frames apart instead.
        if rate.stated && (step * fps).round() >= 1.0 && is_frame(step, fps / (step * fps).round()) {
            return of(Times::Seconds);
        }
        let usual = RATES.iter().filter(|r| is_frame(step, **r));
        let nearest = usual.min_by(|a, b| (step * *a - 1.0).abs().total_cmp(&(step * *b - 1.0).abs()));
        return match nearest {
            Some(_) if rate.stated => of(Times::Seconds),
            Some(&fps) => Reading { fps, ..of(Times::Seconds) },
            None => doubt(Times::Fractions, format!("they fill {:.0} % of the range from 0 to 1 only", 100.0 * filled)),
        };
    }
    let whole = times.iter().all(|t| t.fract() == 0.0);
    if whole {
        let offset = |(e, t): (&Entry, &f64)| rig::trailing_number(&e.name).map(|n| n as f64 - t);
        let offsets: Vec<Option<f64>> = entries.iter().zip(times).map(offset).collect();
        if offsets[0].is_some() && offsets.iter().all(|o| *o == offsets[0]) {
            return of(Times::Frames);
        }
    }
    let even = whole && step == 1.0 && count > 2;
    if even && rate.stated {
        return doubt(
            Times::Frames,
            format!("they are whole numbers in a row, and {fps} frames per second are stated"),
        );
    }
    if even {
        return doubt(Times::Seconds, "they are whole numbers in a row, like frame numbers".into());
    }
    let frames = step * fps;
    if frames.is_finite() && frames >= MANY_FRAMES {
        return doubt(
            Times::Seconds,
            format!("a step of {step:.4} s is {frames:.0} frames at {fps} frames per second"),
        );
    }
    // Cameras of a rig, whose shutters do not open at once, are compared each with itself.
    let own = 2.0 * half_frame(of_camera.iter().copied().zip(times.iter().copied()));
    let per_step = own * fps;
    let between = per_step < FEW_FRAMES && (per_step - per_step.round()).abs() > BETWEEN;
    if rate.stated && own > 0.0 && (per_step < 1.0 - FEWER || between) {
        return doubt(Times::Seconds, format!("steps of {own:.4} s do not fit {fps} frames per second"));
    }
    of(Times::Seconds)
}

/// Reports how times were read, and the alternatives.
fn report(reading: &Reading, instants: &[f64], rate: Rate, account: &mut Account) {
    let [Some(first), Some(last)] = [instants.first(), instants.last()] else { return };
    if first == last {
        let what = format!("All times are {first}: all images have one time, so the scene is static.");
        account.add(Aspect::Assumed, Severity::Note, what);
        return;
    }
    let word = match reading.times {
        Times::Fractions => "parts of the capture from 0 to 1",
        Times::Frames => "frame numbers",
        _ => "seconds",
    };
    let from = if rate.stated { "stated" } else { "not stated" };
    let doubt = reading.doubt.as_ref().map_or_else(String::new, |d| {
        format!(" This is not sure: {d}. Otherwise use --set capture.times=seconds, fractions or frames.")
    });
    // To the microsecond, without the digits of rounding.
    let [first, last, span] = [*first, *last, last - first]
        .map(|t| ((t * 1e6).round() / 1e6, t))
        .map(|(short, t)| if t.abs() < 1e9 { short } else { t });
    let what = format!(
        "Times are read as {word}: {} times from {first} to {last} at {} frames per second ({from}): {:.3} s.{doubt}",
        instants.len(),
        reading.fps,
        span * reading.scale
    );
    let severity = if doubt.is_empty() { Severity::Note } else { Severity::Warning };
    account.add(Aspect::Assumed, severity, what);
}

/// The number of the time that is nearest to `t`, of two the later.
fn nearest(instants: &[f64], t: f64) -> usize {
    let after = instants.partition_point(|&i| i < t);
    let earlier = after > 0 && instants.get(after).is_none_or(|&i| t - instants[after - 1] < i - t);
    if earlier { after - 1 } else { after }
}

/// The cameras' names, the camera of every frame, and whether the data set distinguishes cameras.
fn cameras(entries: &[Entry], times: &[f64]) -> (Vec<String>, Vec<usize>, bool) {
    let names: Vec<&str> = entries.iter().map(|e| e.name.as_str()).collect();
    let naming = rig::naming(&names);
    let of: Vec<usize> = naming.frames.iter().map(|f| f.0).collect();
    if naming.stated && naming.cameras.len() > 1 && !crowded(entries, times, &of) {
        return (naming.cameras, of, true);
    }
    match by_pose(entries) {
        Some((cameras, of)) => (cameras, of, false),
        None if naming.cameras.len() == 1 => (naming.cameras, of, false),
        None => (vec!["moving".into()], vec![0; entries.len()], false),
    }
}

/// Whether a camera would be in two places at once: then its name is only a folder's.
fn crowded(entries: &[Entry], times: &[f64], of: &[usize]) -> bool {
    let mut seen: BTreeMap<(usize, u64), &Entry> = BTreeMap::new();
    entries.iter().zip(times).zip(of).any(|((entry, time), &camera)| {
        let other = seen.entry((camera, (time + 0.0).to_bits())).or_insert(entry);
        !pose::same_pose(&other.source, &entry.source)
    })
}

/// Frames that share a pose to the last bit come from one fixed camera, provided that there are clearly fewer poses
/// than frames.
fn by_pose(entries: &[Entry]) -> Option<(Vec<String>, Vec<usize>)> {
    let key = |pose: &Se3| -> Vec<u64> {
        pose.rotation.iter().flatten().chain(&pose.translation).map(|v| v.to_bits()).collect()
    };
    let mut ids: BTreeMap<Vec<u64>, usize> = BTreeMap::new();
    let of: Vec<usize> = entries
        .iter()
        .map(|e| {
            let next = ids.len();
            *ids.entry(key(&e.source.cam_from_world)).or_insert(next)
        })
        .collect();
    let several = ids.len() >= 2 && 2 * ids.len() <= entries.len();
    several.then(|| ((0..ids.len()).map(|i| format!("view{i:03}")).collect(), of))
}
