//! Times of a transforms file, and the cameras that took its frames.

use super::super::sequence::{Order, Timing};
use super::super::{CaptureOptions, Sequence, assemble, rig};
use super::frame::Entry;
use splat4d::math::Se3;
use std::collections::BTreeMap;

/// Rounding that a time of 1 may have.
const ROUNDING: f64 = 1e-6;

/// Cameras, frame numbers and seconds where every frame has a time: parts of the take from 0 to 1, seconds where any is
/// above. `None`: not every frame has one.
pub(super) fn told(
    entries: &[Entry],
    fps: f64,
    options: &CaptureOptions,
    several: bool,
    (warnings, notes): (&mut Vec<String>, &mut Vec<String>),
) -> Option<Order> {
    let told: Option<Vec<f64>> = entries.iter().map(|e| e.time).collect();
    let Some(times) = told.filter(|t| !t.is_empty()) else {
        if entries.iter().any(|e| e.time.is_some()) {
            warnings.push("Some frames have a time and some have none: no time is used.".into());
        }
        return None;
    };
    if options.sequence != Sequence::Auto {
        warnings.push("The capture states its times: capture.sequence changes nothing.".into());
    }
    // Files of their own for what is held out: the clock is that of the training frames (D-NeRF).
    let counts = |e: &Entry| !several || e.split == super::Split::Train;
    let mut instants: Vec<f64> = entries.iter().zip(&times).filter(|(e, _)| counts(e)).map(|(_, t)| *t).collect();
    instants.sort_by(f64::total_cmp);
    instants.dedup();
    let unit = times.iter().all(|t| (-ROUNDING..=1.0 + ROUNDING).contains(t));
    let scale = match (unit, options.unit_time_seconds) {
        (true, Some(seconds)) => seconds,
        (true, None) => instants.len().saturating_sub(1) as f64 / fps,
        (false, _) => 1.0,
    };
    if unit && options.unit_time_seconds.is_none() && instants.len() > 1 {
        notes.push(format!(
            "Times run from 0 to 1; they are taken as parts of a take of {} instants at {fps} frames per second \
             ({scale:.3} s).",
            instants.len()
        ));
    }
    let (cameras, of, named) = cameras(entries, &times);
    let frames = of.into_iter().zip(&times).map(|(camera, &t)| (camera, nearest(&instants, t), t * scale)).collect();
    Some(Order { cameras, frames, named, timing: Timing::Told })
}

/// The number of the instant that is nearest to `t`, of two the later.
fn nearest(instants: &[f64], t: f64) -> usize {
    let after = instants.partition_point(|&i| i < t);
    let earlier = after > 0 && instants.get(after).is_none_or(|&i| t - instants[after - 1] < i - t);
    if earlier { after - 1 } else { after }
}

/// The cameras' names, the camera of every frame, and whether the data set tells cameras apart.
fn cameras(entries: &[Entry], times: &[f64]) -> (Vec<String>, Vec<usize>, bool) {
    let names: Vec<&str> = entries.iter().map(|e| e.name.as_str()).collect();
    let naming = rig::naming(&names);
    let of: Vec<usize> = naming.frames.iter().map(|f| f.0).collect();
    if naming.told && naming.cameras.len() > 1 && !crowded(entries, times, &of) {
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
        !assemble::same_pose(&other.source, &entry.source)
    })
}

/// Frames that share a pose to the last bit come from one fixed camera, provided that there are clearly fewer poses than
/// frames.
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
