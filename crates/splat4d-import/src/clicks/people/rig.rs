//! Growing a rig: it starts with one person in two cameras, and gains each camera that shows one of its people, and each
//! person that its cameras show.

use super::bundle::{BEFORE, How};
use super::pairs::Fit;
use super::{Cameras, Identity, LEAST, Rig, Spot};
use crate::sfm::lens::Lens;
use crate::sfm::resection::{Known, place};
use splat4d::math::{Rng, Se3};

/// Distance within which a keypoint fits a camera on trial, errors (36 px of 1920): its focal length is still wrong. And
/// the share of keypoints that must fit.
const ROUGH: f64 = 6.0;
const SHARE: f64 = 0.6;
/// Mean loss ln(1 + (distance/[`SCALE`])²) of a keypoint below which people are one (Pose2Sim's demo: 0.4), and keypoints
/// that show it.
pub(super) const MEETS: f64 = 0.7;
const MEETINGS: usize = 15;
/// Times of a person in trials.
pub(super) const TRIALS: usize = 10;

/// A camera that joins a rig by a person that its track shows.
struct Joining {
    camera: usize,
    person: usize,
    track: usize,
    pose: Se3,
    offset: f64,
}

impl Cameras<'_> {
    /// The rig that a pair starts, with all cameras that follow; none: the pair is none.
    pub(super) fn grown(&self, start: &Fit, fits: &[Fit]) -> Option<Rig> {
        let n = self.of.len();
        let [a, b] = start.cameras;
        let mut person: Identity = vec![Vec::new(); n];
        (person[a], person[b]) = (vec![start.tracks[0]], vec![start.tracks[1]]);
        let mut rig = Rig {
            poses: vec![None; n],
            lenses: (0..n).map(|c| self.lens(c, start.focal)).collect(),
            offsets: self.of.iter().map(|c| c.offset.unwrap_or(0.0)).collect(),
            people: vec![person],
            gain: 0.0,
        };
        (rig.poses[a], rig.poses[b]) = (Some(Se3::IDENTITY), Some(start.motion));
        match (self.of[a].offset, self.of[b].offset) {
            (None, Some(known)) => rig.offsets[a] = known - start.lag,
            _ => rig.offsets[b] = rig.offsets[a] + start.lag,
        }
        let mut spots = self.spots(&rig, TRIALS);
        self.adjusted(&mut rig, &mut spots, How::TRIAL)?;
        loop {
            if let Some(Joining { camera, person, track, pose, offset }) = self.next(&rig, &spots, fits) {
                (rig.poses[camera], rig.offsets[camera]) = (Some(pose), offset);
                rig.lenses[camera].focal =
                    self.of[camera].focal.map_or(rig.lenses[a].focal, |_| rig.lenses[camera].focal);
                rig.people[person][camera].push(track);
                self.anchor(&mut rig);
            } else if !self.extend(&mut rig) {
                break;
            }
            spots = self.spots(&rig, TRIALS);
            let focal = rig.placed().len() > 2;
            self.adjusted(&mut rig, &mut spots, How { focal, ..How::TRIAL })?;
        }
        rig.gain = self.loss(&rig, &spots).map_or(0.0, |[mean, count]| count * (MEETS - mean));
        Some(rig)
    }

    /// Brings the clocks of a rig to that of a camera whose offset is known.
    fn anchor(&self, rig: &mut Rig) {
        let placed = rig.placed();
        if let Some(by) = placed.iter().find_map(|&c| Some(self.of[c].offset? - rig.offsets[c])) {
            placed.into_iter().for_each(|c| rig.offsets[c] += by);
        }
    }

    /// The camera and track that fit the people of a rig best.
    fn next(&self, rig: &Rig, spots: &[Spot], fits: &[Fit]) -> Option<Joining> {
        let mut best: Option<(f64, Joining)> = None;
        for c in (0..self.of.len()).filter(|&c| rig.poses[c].is_none()) {
            for k in 0..self.tracks[c].len() {
                for (p, person) in rig.people.iter().enumerate() {
                    let anchored = rig.placed().iter().any(|&o| self.of[o].offset.is_some());
                    let given = self.of[c].offset.filter(|_| anchored);
                    let Some(offset) = given.or_else(|| clock(rig, person, [c, k], fits)) else { continue };
                    let known = spots.iter().filter(|s| s.person == p).filter_map(|spot| {
                        let seen = self.tracks[c][k].seen(spot.time - offset, spot.keypoint)?;
                        Some(Known { point: spot.place?, pixel: seen.pixel })
                    });
                    let known: Vec<Known> = known.collect();
                    if known.len() < LEAST {
                        continue;
                    }
                    let first = rig.placed()[0];
                    let focal = self.of[c].focal.map_or(rig.lenses[first].focal, |_| rig.lenses[c].focal);
                    let lens = Lens { focal, ..rig.lenses[c] };
                    let rng = Rng::new(0, "cameras of people", c as u64).fork((64 * k + p) as u64);
                    let Some(found) = place(&known, &[lens], false, ROUGH, rng) else { continue };
                    let share = found.inliers.len() as f64 / known.len() as f64;
                    if share >= SHARE && best.as_ref().is_none_or(|b| share > b.0) {
                        let joining = Joining { camera: c, person: p, track: k, pose: found.model.pose, offset };
                        best = Some((share, joining));
                    }
                }
            }
        }
        best.map(|b| b.1)
    }

    /// Adds people that placed cameras show: another track of a known person, or a further person. False: there is none.
    pub(super) fn extend(&self, rig: &mut Rig) -> bool {
        let placed = rig.placed();
        let free = |c: usize, rig: &Rig| (0..self.tracks[c].len()).filter(|&k| !rig.has(c, k)).collect::<Vec<_>>();
        for &c in &placed {
            for k in free(c, rig) {
                let mut best: Option<(f64, usize)> = None;
                for p in (0..rig.people.len()).filter(|&p| !self.overlaps(c, k, &rig.people[p][c])) {
                    let mut wider = rig.people[p].clone();
                    wider[c] = vec![k];
                    let loss = self.meets(rig, wider, c);
                    if loss.is_some_and(|loss| best.is_none_or(|b| loss < b.0)) {
                        best = Some((loss.expect("just seen"), p));
                    }
                }
                if let Some((_, p)) = best {
                    rig.people[p][c].push(k);
                    return true;
                }
            }
        }
        let mut best: Option<(f64, Identity)> = None;
        for (i, &a) in placed.iter().enumerate() {
            for &b in &placed[i + 1..] {
                for (j, k) in free(a, rig).into_iter().flat_map(|j| free(b, rig).into_iter().map(move |k| (j, k))) {
                    // Two who stay in place meet by chance.
                    if self.tracks[a][j].active.min(self.tracks[b][k].active) < super::pairs::LEAST_TIMES {
                        continue;
                    }
                    let mut pair: Identity = vec![Vec::new(); self.of.len()];
                    (pair[a], pair[b]) = (vec![j], vec![k]);
                    let loss = self.meets(rig, pair.clone(), a);
                    if loss.is_some_and(|loss| best.as_ref().is_none_or(|b| loss < b.0)) {
                        best = Some((loss.expect("just seen"), pair));
                    }
                }
            }
        }
        best.map(|(_, pair)| rig.people.push(pair)).is_some()
    }

    fn overlaps(&self, camera: usize, track: usize, others: &[usize]) -> bool {
        let [from, to] = self.tracks[camera][track].span();
        others.iter().map(|&o| self.tracks[camera][o].span()).any(|[begin, end]| begin <= to && from <= end)
    }

    /// The mean loss of a person's keypoints that a camera shows; none: they do not meet.
    fn meets(&self, rig: &Rig, person: Identity, camera: usize) -> Option<f64> {
        let alone = Rig { people: vec![person], ..rig.clone() };
        let mut spots = self.spots(&alone, TRIALS);
        spots.retain(|s| s.seen.iter().any(|(c, _)| *c == camera));
        self.triangulate(&alone, &mut spots);
        let [mean, _] = self.loss(&alone, &spots).filter(|_| spots.len() >= MEETINGS)?;
        let before = spots.iter().filter(|s| s.place.is_some()).count();
        (mean < MEETS && before as f64 >= BEFORE * spots.len() as f64).then_some(mean)
    }
}

/// The offset of a camera's clock by the person that it shows: of the best fit with a placed camera.
fn clock(rig: &Rig, person: &Identity, [camera, track]: [usize; 2], fits: &[Fit]) -> Option<f64> {
    let of = |f: &Fit| {
        let k = (0..2).find(|&k| f.cameras[k] == camera && f.tracks[k] == track)?;
        let other = f.cameras[1 - k];
        (rig.poses[other].is_some() && person[other].contains(&f.tracks[1 - k])).then(|| {
            let lag = if k == 1 { f.lag } else { -f.lag };
            (f.loss, rig.offsets[other] + lag)
        })
    };
    fits.iter().filter_map(of).min_by(|a, b| a.0.total_cmp(&b.0)).map(|f| f.1)
}
