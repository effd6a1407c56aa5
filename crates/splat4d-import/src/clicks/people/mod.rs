//! People as correspondences: the rig of cameras that see the same people, without clicks.
//!
//! Keypoints of a person are the same physical points for cameras at any angle. Detections are linked over time in each
//! camera (`track.rs`). Which of its people are the same is not known: for every two people of two cameras the essential
//! matrix that fits best over the whole recording decides, and with it the time offset (`pairs.rs`). The best pairs start
//! rigs, which grow by resection (`rig.rs`). The rig that explains most keypoints is adjusted (`finish.rs`) and checked (`check.rs`).

mod bundle;
mod check;
mod finish;
mod pairs;
mod rig;
mod track;

#[cfg(test)]
use check::Calibrated;
pub(crate) use finish::calibrate;

use super::solve::Camera;
use crate::sfm::lens::{Lens, unit};
use splat4d::math::Se3;
use track::{Seen, Track, has_moved};

/// Error of a keypoint, pixels of an image 1920 across: a detector's joint is inside of the body and elsewhere from every
/// side (Pose2Sim's demo: 5 px at the median).
const NOISE: f64 = 6.0;
/// The focal length of most cameras (a telephone's video), of the larger side.
const USUAL: f64 = 0.9;

/// Keypoints that carry a pose, at least.
const LEAST: usize = 20;

/// A person: its tracks in every camera, which share no time.
type Identity = Vec<Vec<usize>>;

/// A rig on trial. Lengths of images are in units of a keypoint's error.
#[derive(Clone)]
struct Rig {
    poses: Vec<Option<Se3>>,
    lenses: Vec<Lens>,
    /// Seconds that are added to each camera's clock.
    offsets: Vec<f64>,
    people: Vec<Identity>,
    /// Evidence for it: the sum over keypoints of [`rig::MEETS`] without the loss.
    gain: f64,
}

/// A keypoint of a person at a time.
struct Spot {
    person: usize,
    time: f64,
    keypoint: usize,
    /// Where cameras show it.
    seen: Vec<(usize, Seen)>,
    /// Where it is, if it is known.
    place: Option<[f64; 3]>,
}

impl Rig {
    fn placed(&self) -> Vec<usize> {
        (0..self.poses.len()).filter(|&c| self.poses[c].is_some()).collect()
    }

    fn has(&self, camera: usize, track: usize) -> bool {
        self.people.iter().any(|p| p[camera].contains(&track))
    }
}

/// What is known of the cameras, and the people in their images. Lengths of images are in units of a keypoint's error.
struct Cameras<'a> {
    of: &'a [Camera],
    tracks: Vec<Vec<Track>>,
}

/// Pixels of a keypoint's error.
fn error_of(camera: &Camera) -> f64 {
    NOISE * unit(larger(camera))
}

fn larger(camera: &Camera) -> f64 {
    camera.size[0].max(camera.size[1]) as f64
}

impl Cameras<'_> {
    /// The larger side of a camera's images.
    fn side(&self, c: usize) -> f64 {
        larger(&self.of[c]) / error_of(&self.of[c])
    }

    /// The lens of a camera whose focal length is known, or this share of the larger side.
    fn lens(&self, c: usize, focal: f64) -> Lens {
        let camera = &self.of[c];
        let focal = camera.focal.unwrap_or(focal * larger(camera));
        Lens::plain(focal, camera.size[0], camera.size[1]).scaled(1.0 / error_of(camera))
    }

    /// Keypoints of a rig's people that two or more placed cameras show, at up to `times` times of each person.
    fn spots(&self, rig: &Rig, times: usize) -> Vec<Spot> {
        let mut out = Vec::new();
        for (p, person) in rig.people.iter().enumerate() {
            let shown: Vec<(usize, &Track)> = (rig.placed().into_iter())
                .flat_map(|c| person[c].iter().map(move |&k| (c, &self.tracks[c][k])))
                .collect();
            let keypoints = shown.iter().map(|(_, t)| t.keypoints()).max().unwrap_or(0);
            for time in self.times(rig, person, times) {
                for keypoint in 0..keypoints {
                    let mut seen: Vec<(usize, Seen)> = Vec::new();
                    for (c, track) in &shown {
                        if let Some(found) = track.seen(time - rig.offsets[*c], keypoint)
                            && seen.last().is_none_or(|(last, _)| last != c)
                        {
                            seen.push((*c, found));
                        }
                    }
                    if seen.len() > 1 {
                        out.push(Spot { person: p, time, keypoint, seen, place: None });
                    }
                }
            }
        }
        out
    }

    /// Times at which two placed cameras show a person, at most `count`, each after a movement.
    fn times(&self, rig: &Rig, person: &Identity, count: usize) -> Vec<f64> {
        let placed = rig.placed();
        let span = |c: &usize| {
            let spans = person[*c].iter().map(|&k| self.tracks[*c][k].span().map(|t| t + rig.offsets[*c]));
            spans.reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])])
        };
        let spans: Vec<[f64; 2]> = placed.iter().filter_map(span).collect();
        if spans.len() < 2 {
            return Vec::new();
        }
        let [mut begins, mut ends] = [0, 1].map(|k| spans.iter().map(|s| s[k]).collect::<Vec<_>>());
        begins.sort_by(f64::total_cmp);
        ends.sort_by(f64::total_cmp);
        let (from, to) = (begins[1], ends[ends.len() - 2]);
        let mut last = vec![None; self.of.len()];
        let mut out = Vec::new();
        for k in 0..count {
            let time = from + (to - from) * (k as f64 + 0.5) / count as f64;
            let mut moved = false;
            for &c in &placed {
                let here = person[c].iter().find_map(|&k| self.tracks[c][k].near(time - rig.offsets[c]));
                let Some(here) = here else { continue };
                if last[c].is_none_or(|before| has_moved(before, here)) {
                    (moved, last[c]) = (true, Some(here));
                }
            }
            if moved {
                out.push(time);
            }
        }
        out
    }
}

#[cfg(test)]
pub(super) mod tests;
