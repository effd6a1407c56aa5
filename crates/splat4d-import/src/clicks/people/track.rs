//! People of one camera, linked over time, and where their keypoints are between frames.

use super::super::keypoints::{Frames, Person};
use splat4d::math::median;

/// Keypoints below this confidence are not used: detectors that are unsure mostly report the other side or a hidden joint.
const CONFIDENT: f64 = 0.4;
/// Largest distance of a person in two frames, of its size, and longest gap, seconds.
const STEP: f64 = 0.3;
const GAP: f64 = 0.5;
/// Keypoints that begin a track, and frames that a track has at least.
const BEGINS: usize = 3;
const FRAMES: usize = 5;
/// Half the time over which a line is fitted to a keypoint, seconds, but at least this many frames: over it joints move
/// straight enough (an acceleration of 10 m/s² bends the line by 4 mm), and the detector's jitter averages out.
const WINDOW: f64 = 0.05;
const WINDOW_FRAMES: f64 = 1.1;
/// Detections farther from the line than this many times the median are left out, but none within this many errors.
const STRAY: f64 = 3.0;
const STRAY_LEAST: f64 = 1.0;
/// Distance of the nearest frame, frames, from which on a time at the end of a track counts as not seen.
const OUTSIDE: f64 = 0.6;
/// A person has moved if its keypoints did by this many errors (median; 15 px of 1920): less is the detector's jitter.
const MOVED: f64 = 2.5;
/// People of a camera that are distinguished at most, those who move most.
pub(super) const PEOPLE: usize = 4;

/// A person in the images of one camera. Lengths of images are in units of a keypoint's error.
pub(super) struct Track {
    /// Second of the camera's own clock, and keypoints; in the order of time.
    frames: Vec<(f64, Person)>,
    /// Seconds between two frames (median).
    step: f64,
    /// Times at which it had moved since the one before.
    pub active: usize,
}

/// Where a keypoint is, and how it moves, per second.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Seen {
    pub pixel: [f64; 2],
    pub velocity: [f64; 2],
}

/// Links the people of a camera over time: each continues the nearest one of the frames before. Those who move most
/// come first. `interval`: seconds between frames of the video; `error`: pixels of a keypoint's error.
pub(super) fn linked(frames: &Frames, interval: f64, error: f64) -> Vec<Track> {
    let mut tracks: Vec<Vec<(f64, Person)>> = Vec::new();
    for (&number, people) in frames {
        let time = number as f64 * interval;
        let scaled = |p: &Person| p.iter().map(|&[x, y, sure]| [x / error, y / error, sure]).collect::<Person>();
        let people: Vec<Person> = people.iter().map(scaled).collect();
        let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
        for (t, track) in tracks.iter().enumerate() {
            let (last, person) = &track[track.len() - 1];
            if time - last > GAP.max(interval) {
                continue;
            }
            let apart = |q: usize| Some(moved(person, &people[q])? / extent(person).max(1.0));
            pairs.extend((0..people.len()).filter_map(|q| Some((apart(q)?, t, q))).filter(|p| p.0 < STEP));
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        let (mut continued, mut taken) = (vec![false; tracks.len()], vec![false; people.len()]);
        for (_, t, q) in pairs {
            if !continued[t] && !taken[q] {
                (continued[t], taken[q]) = (true, true);
                tracks[t].push((time, people[q].clone()));
            }
        }
        let new = (0..people.len()).filter(|&q| !taken[q] && confident(&people[q]).count() >= BEGINS);
        tracks.extend(new.map(|q| vec![(time, people[q].clone())]));
    }
    let mut tracks: Vec<Track> = tracks.into_iter().filter(|t| t.len() >= FRAMES).map(Track::new).collect();
    tracks.sort_by_key(|t| std::cmp::Reverse((t.active, t.frames.len())));
    tracks.truncate(PEOPLE);
    tracks
}

impl Track {
    fn new(frames: Vec<(f64, Person)>) -> Self {
        let step = median(&mut frames.windows(2).map(|w| w[1].0 - w[0].0).collect::<Vec<_>>()).unwrap_or(0.0);
        let (mut active, mut last) = (0, &frames[0].1);
        for (_, person) in &frames[1..] {
            if has_moved(last, person) {
                active += 1;
                last = person;
            }
        }
        Self { step, active, frames }
    }

    /// First and last second.
    pub(super) fn span(&self) -> [f64; 2] {
        [self.frames[0].0, self.frames[self.frames.len() - 1].0]
    }

    /// Keypoints of a person.
    pub(super) fn keypoints(&self) -> usize {
        self.frames.iter().map(|f| f.1.len()).max().unwrap_or(0)
    }

    /// All keypoints at the frame nearest to a second of its clock.
    pub(super) fn near(&self, time: f64) -> Option<&Person> {
        let at = self.frames.partition_point(|f| f.0 < time);
        let around = [at.checked_sub(1), Some(at)].into_iter().flatten().filter_map(|k| self.frames.get(k));
        let nearest = around.min_by(|a, b| (a.0 - time).abs().total_cmp(&(b.0 - time).abs()))?;
        ((nearest.0 - time).abs() <= OUTSIDE * self.step).then_some(&nearest.1)
    }

    /// A keypoint at a second of its clock, of a line through the frames around.
    pub(super) fn seen(&self, time: f64, keypoint: usize) -> Option<Seen> {
        let window = WINDOW.max(WINDOW_FRAMES * self.step);
        let from = self.frames.partition_point(|f| f.0 < time - window);
        let around = self.frames[from..].iter().take_while(|f| f.0 <= time + window);
        let sure = around.filter_map(|(t, person)| {
            let p = person.get(keypoint).filter(|p| p[2] >= CONFIDENT)?;
            Some((t - time, [p[0], p[1]]))
        });
        let mut sure: Vec<(f64, [f64; 2])> = sure.collect();
        let nearest = sure.iter().map(|s| s.0.abs()).fold(f64::INFINITY, f64::min);
        let inside = sure.iter().any(|s| s.0 <= 0.0) && sure.iter().any(|s| s.0 >= 0.0);
        if !inside && nearest > OUTSIDE * self.step {
            return None;
        }
        let line = fitted(&sure)?;
        let off = |s: &(f64, [f64; 2])| {
            let [u, v] = [0, 1].map(|a| line.pixel[a] + line.velocity[a] * s.0 - s.1[a]);
            u.hypot(v)
        };
        let usual = median(&mut sure.iter().map(off).collect::<Vec<_>>())?;
        sure.retain(|s| off(s) <= STRAY * usual.max(STRAY_LEAST));
        fitted(&sure)
    }
}

/// The line of least squares through positions at times, at time 0.
fn fitted(points: &[(f64, [f64; 2])]) -> Option<Seen> {
    let n = points.len() as f64;
    if points.is_empty() {
        return None;
    }
    let time = points.iter().map(|p| p.0).sum::<f64>() / n;
    let mean = [0, 1].map(|a| points.iter().map(|p| p.1[a]).sum::<f64>() / n);
    let spread: f64 = points.iter().map(|p| (p.0 - time).powi(2)).sum();
    let slope = |a: usize| points.iter().map(|p| (p.0 - time) * (p.1[a] - mean[a])).sum::<f64>() / spread;
    let velocity = if spread > 0.0 { [slope(0), slope(1)] } else { [0.0; 2] };
    Some(Seen { pixel: [0, 1].map(|a| mean[a] - velocity[a] * time), velocity })
}

fn confident(person: &Person) -> impl Iterator<Item = [f64; 2]> + '_ {
    person.iter().filter(|p| p[2] >= CONFIDENT).map(|p| [p[0], p[1]])
}

/// Diagonal of the box around a person.
fn extent(person: &Person) -> f64 {
    let corner = |pick: fn(f64, f64) -> f64, start: f64, k: usize| confident(person).map(|p| p[k]).fold(start, pick);
    let side = |k: usize| corner(f64::max, f64::NEG_INFINITY, k) - corner(f64::min, f64::INFINITY, k);
    let diagonal = side(0).hypot(side(1));
    if diagonal.is_finite() { diagonal } else { 0.0 }
}

/// Median distance of keypoints of a person in two frames; `None`: they share none.
fn moved(a: &Person, b: &Person) -> Option<f64> {
    let sure = |p: &&[f64; 3]| p[2] >= CONFIDENT;
    let both = a.iter().zip(b).filter(|(p, q)| sure(p) && sure(q)).map(|(p, q)| (p[0] - q[0]).hypot(p[1] - q[1]));
    median(&mut both.collect::<Vec<_>>())
}

/// Whether a person moved between two frames.
pub(super) fn has_moved(a: &Person, b: &Person) -> bool {
    moved(a, b).is_some_and(|d| d >= MOVED)
}
