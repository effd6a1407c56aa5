//! The rig that keypoints of people give: those of files, or those that a network finds in the stored images.

use super::assist::Placed;
use super::cache::Cache;
use super::given;
use super::interrupted;
use super::report::Report;
use super::stored::Stored;
use super::world::Origin;
use crate::Result;
use crate::clicks::{self, Frames, calibrate, read_keypoints};
use crate::sfm::known::Straight;
use crate::sfm::lens::Known;
use crate::sync::graph;
use crate::write::Pictures;
use splat4d_train::capture::Rgb8;
use splat4d_train::event::Progress;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Frames of a camera in which people are detected at most: ten seconds, in which a person crosses a room twice.
const MOST: usize = 300;
/// Frames per second in which people are detected at most: joints move straight between two of them (`clicks/people/track.rs`).
const RATE: f64 = 30.0;
/// Images whose people are found at a time, and kept if the import is stopped: half a minute of a usual network.
const BATCH: usize = 25;

/// Finds people in images.
pub trait Detector: Send + Sync {
    /// Distinguishes it from others.
    fn identity(&self) -> &str;

    /// The people in an image: of each its keypoints, in an order that is the same for all people, as column and row in pixels
    /// (the first pixel's centre is 0.5) and confidence from 0 to 1. Errors: the detector cannot process the image.
    fn people(&self, image: &Rgb8) -> Result<Vec<Vec<[f64; 3]>>>;
}

impl std::fmt::Debug for dyn Detector {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Detector").field(&self.identity()).finish()
    }
}

/// Where keypoints of people come from.
#[derive(Clone, Debug)]
pub enum Keypoints {
    /// A folder of files, for frames of the videos.
    Given(PathBuf),
    /// What finds them in the stored images.
    By(Arc<dyn Detector>),
}

/// Keypoints of people in the images of all cameras.
pub(super) struct People {
    /// By camera, in pixels of the stored images.
    frames: Vec<Frames>,
    /// Seconds between two frame numbers, by camera.
    intervals: Vec<f64>,
    /// What errors name.
    place: String,
}

/// Reads the keypoints of a folder. Errors: those of reading; stored images of another shape than the videos.
pub(super) fn given(folder: &Path, cameras: &[super::Camera], pictures: &[Pictures]) -> Result<People> {
    let names: Vec<&str> = pictures.iter().map(|p| p.name.as_str()).collect();
    let mut frames = read_keypoints(folder, &names)?;
    let mut intervals = Vec::with_capacity(names.len());
    for (c, p) in pictures.iter().enumerate() {
        let info = cameras[c].source.info();
        let by = given::factors("people were detected", info.size, p, "Import without --crop.")?;
        for point in frames[c].values_mut().flatten().flatten() {
            (point[0], point[1]) = (point[0] * by[0], point[1] * by[1]);
        }
        let rate = info.average_rate.or(info.nominal_rate).filter(|rate| *rate > 0.0);
        intervals.push(rate.map_or(p.clock.interval, |rate| 1.0 / rate));
    }
    Ok(People { frames, intervals, place: folder.display().to_string() })
}

/// Seconds between frames; of a single one, those of most videos.
fn interval_of(p: &Pictures) -> f64 {
    if p.clock.interval > 0.0 { p.clock.interval } else { 1.0 / RATE }
}

/// Frames of a camera in which people are looked for, from the middle of the recording: what continues for a while shows
/// who is who.
fn looked_at(p: &Pictures) -> Vec<usize> {
    let count = p.shots.len();
    let seconds = p.shots.last().map_or(0.0, |last| last.time - p.shots[0].time);
    let rate = if seconds > 0.0 { (count - 1) as f64 / seconds } else { 0.0 };
    let step = ((rate / RATE).round() as usize).max(1);
    let kept = count.div_ceil(step).min(MOST);
    let first = (count - ((kept - 1) * step + 1)) / 2;
    (0..kept).map(|k| first + k * step).collect()
}

/// Detects people in the stored images of all cameras. What was found is kept, and found again after an interruption.
///
/// Errors: images that cannot be read; those of the detector; `stop` requested it.
pub(super) fn detected(
    detector: &dyn Detector,
    stored: &Stored<'_>,
    cache: &Cache,
    progress: &mut Progress<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<People> {
    let shots: Vec<Vec<usize>> = stored.pictures.iter().map(looked_at).collect();
    let (mut done, total) = (0, shots.iter().map(Vec::len).sum());
    let mut frames = Vec::with_capacity(shots.len());
    for (c, shots) in shots.iter().enumerate() {
        let p = &stored.pictures[c];
        let interval = interval_of(p);
        let mut found = Frames::new();
        for (k, batch) in shots.chunks(BATCH).enumerate() {
            let made_of = format!("{} {} {batch:?}", detector.identity(), p.fingerprint);
            let all = cache.or(&format!("people{c}x{k}"), &made_of, || {
                let of = |(i, shot): (usize, &usize)| {
                    progress.phase("finding people by the network", done + i, total);
                    if stop() {
                        return Err(interrupted());
                    }
                    detector.people(&stored.rgb(c, *shot)?)
                };
                batch.iter().enumerate().map(of).collect::<Result<Vec<_>>>()
            })?;
            done += batch.len();
            for (shot, people) in batch.iter().zip(all) {
                found.insert((p.shots[*shot].time / interval).round().max(0.0) as usize, people);
            }
        }
        frames.push(found);
    }
    let intervals = stored.pictures.iter().map(interval_of).collect();
    Ok(People { frames, intervals, place: "people that the network found".into() })
}

/// Finds the rig by keypoints of people, and puts lenses and poses among the known ones.
///
/// Errors: people who give no rig, or one that may be wrong.
pub(super) fn placed(
    people: People,
    pictures: &[Pictures],
    known: &mut [Option<Known>],
    clock: &graph::Solution,
    kept: &[bool],
    report: &mut Report,
) -> Result<Placed> {
    let names: Vec<&str> = pictures.iter().map(|p| p.name.as_str()).collect();
    let People { mut frames, intervals, place } = people;
    let mut rig = Vec::with_capacity(names.len());
    for (c, p) in pictures.iter().enumerate() {
        let straight = known[c].map(|k| k.straight(p.size, 1.0));
        if let Some(straight) = &straight {
            straightened(&mut frames[c], straight);
        }
        rig.push(clicks::Camera {
            size: p.size,
            focal: straight.as_ref().map(Straight::focal),
            interval: intervals[c],
            offset: clock.offsets[c].as_ref().map(|o| o.seconds),
            keep_offset: kept[c],
        });
    }
    let found = calibrate(&names, &rig, &frames).map_err(|e| e.at(place))?;
    for (c, own) in known.iter_mut().enumerate() {
        let (pose, lens) = found.cameras[c];
        given::place(own, pose, lens, pictures[c].size);
    }
    report.guesses.push(format!(
        "Poses and focal lengths are those of keypoints of {} people: {} positions in images, {:.1} px (of 1920) off at the \
         median; two halves of the keypoints agree within {:.1} degrees.",
        found.people, found.positions, found.error, found.apart
    ));
    let offsets = (0..names.len()).map(|c| (!kept[c]).then_some(found.offsets[c])).collect();
    Ok(Placed { offsets, origin: Origin::Clicked { floor: None, metres: false } })
}

/// Takes the distortion of a known lens out of keypoints.
fn straightened(frames: &mut Frames, straight: &Straight) {
    for point in frames.values_mut().flatten().flatten() {
        match straight.pixel([point[0], point[1]]) {
            Some([x, y]) => (point[0], point[1]) = (x, y),
            None => point[2] = 0.0,
        }
    }
}

#[cfg(test)]
mod tests;
