//! Refuses rigs that may be wrong.

use super::bundle::{ALIKE, How};
use super::{Cameras, NOISE, Rig, Spot, error_of};
use crate::sfm::lens::{Lens, off};
use crate::{Error, Result};
use splat4d::math::align::turn_between;
use splat4d::math::se3::{dot, normalize};
use splat4d::math::{Se3, median};

/// Times of a person.
pub(super) const TIMES: usize = 24;
/// Evaluations of the last adjustments.
pub(super) const STEPS: usize = 60;
/// Two rigs whose relative rotations or directions differ by more are different ones, degrees.
pub(super) const DISTINCT: f64 = 10.0;
/// Another rig that explains more than this share of what the best one explains cannot be excluded.
const AMBIGUOUS: f64 = 0.8;
/// Largest median distance of keypoints, errors (12 px of 1920).
const MOST_ERROR: f64 = 2.0;
/// A keypoint is explained within this many errors (24 px of 1920); share of a camera's keypoints that must be.
const EXPLAINED: f64 = 4.0;
const LEAST_EXPLAINED: f64 = 0.7;
/// A camera contradicts the others where its median distance exceeds this many errors (7 px of 1920) and this many times
/// the median of the others. Cameras that showed another person (Pose2Sim's demo, synthetic people): 1.4 to 1.8 errors,
/// 2.4 to 3.1 times; cameras that showed the same one: at most 1.0 and 1.2.
const ODD: f64 = 1.2;
const ODD_RATIO: f64 = 1.8;
/// Rigs of two halves of the keypoints that differ by more, degrees, determine no rig: each half is less accurate than
/// all. Pose2Sim's demo: halves 4 degrees apart, the rig of all within 1.6.
const MOST_APART: f64 = 8.0;

/// Cameras that people calibrated.
#[derive(Debug)]
pub(crate) struct Calibrated {
    /// Pose and lens of each camera. The unit is the median distance of cameras from people.
    pub cameras: Vec<(Se3, Lens)>,
    /// Seconds that are added to each camera's clock.
    pub offsets: Vec<f64>,
    /// People, positions in images, and their median distance, pixels of an image 1920 across.
    pub people: usize,
    pub positions: usize,
    pub error: f64,
    /// Degrees by which the rigs of two halves of the keypoints differ, at worst.
    pub apart: f64,
}

/// A camera whose keypoints contradict the others, errors.
struct Odd {
    camera: usize,
    /// Median distance, and that of the other cameras.
    median: f64,
    others: f64,
    /// Share of keypoints that are explained.
    explained: f64,
}

/// Distances of keypoints from where a rig sees them, errors, by camera.
fn distances(rig: &Rig, spots: &[Spot]) -> Vec<Vec<f64>> {
    let mut all = vec![Vec::new(); rig.poses.len()];
    for spot in spots {
        let Some(x) = spot.place else { continue };
        for (c, seen) in &spot.seen {
            if let Some(pose) = &rig.poses[*c] {
                all[*c].push(off(&rig.lenses[*c], pose, x, seen.pixel));
            }
        }
    }
    all
}

/// The camera that contradicts the others most; none: they agree.
fn odd(distances: &[Vec<f64>]) -> Option<Odd> {
    let medians: Vec<f64> = distances.iter().map(|d| median(&mut d.clone()).unwrap_or(f64::INFINITY)).collect();
    let of = |camera: usize| {
        let mut others: Vec<f64> = (0..medians.len()).filter(|&o| o != camera).map(|o| medians[o]).collect();
        let others = median(&mut others).unwrap_or(f64::INFINITY);
        let all = &distances[camera];
        let explained = all.iter().filter(|d| **d < EXPLAINED).count() as f64 / all.len().max(1) as f64;
        Odd { camera, median: medians[camera], others, explained }
    };
    let contradicts = |o: &Odd| o.explained < LEAST_EXPLAINED || o.median > ODD && o.median > ODD_RATIO * o.others;
    (0..medians.len()).map(of).filter(contradicts).max_by(|a, b| a.median.total_cmp(&b.median))
}

impl Cameras<'_> {
    /// For each camera the median over other cameras of the degrees by which relative rotations or directions differ.
    pub(super) fn apart(&self, x: &Rig, y: &Rig) -> Vec<f64> {
        let both: Vec<usize> = (0..self.of.len()).filter(|&c| x.poses[c].is_some() && y.poses[c].is_some()).collect();
        if both.len() < x.placed().len().max(2) {
            return vec![f64::INFINITY; self.of.len()];
        }
        let between = |rig: &Rig, a: usize, b: usize| {
            let [a, b] = [a, b].map(|c| rig.poses[c].expect("it is placed"));
            b.after(&a.inverse())
        };
        let of = |c: usize| {
            let all = both.iter().filter(|&&o| o != c).map(|&o| {
                let (p, q) = (between(x, c, o), between(y, c, o));
                let cos = dot(normalize(p.translation), normalize(q.translation)).clamp(-1.0, 1.0);
                turn_between(&p.rotation, &q.rotation).max(cos.acos()).to_degrees()
            });
            median(&mut all.collect::<Vec<_>>()).unwrap_or(0.0)
        };
        (0..self.of.len()).map(|c| if both.contains(&c) { of(c) } else { 0.0 }).collect()
    }

    /// The best rig, unless it may be wrong.
    pub(super) fn checked(&self, names: &[&str], rigs: &[(Rig, Vec<Spot>)]) -> Result<Calibrated> {
        const BY_HAND: &str = "or align the cameras by hand (--assist)";
        let whole = |(r, s): &(Rig, Vec<Spot>)| r.placed().len() == names.len() && odd(&distances(r, s)).is_none();
        let Some((rig, spots)) = rigs.iter().find(|r| whole(r)).or(rigs.first()) else {
            return Err(Error::input("the keypoints of people give no poses to the cameras")
                .remedy(format!("Give keypoints of people who walk through the shared space, {BY_HAND}.")));
        };
        let missing: Vec<&str> = (0..names.len()).filter(|&c| rig.poses[c].is_none()).map(|c| names[c]).collect();
        if !missing.is_empty() {
            return Err(Error::input(format!("the keypoints of people give no pose to {}", missing.join(", ")))
                .remedy(format!(
                    "No person in these images meets one that other cameras show. Check that the keypoints and frame \
                     numbers belong to the videos, set the time offset in import.toml, leave the cameras out \
                     (use = false), {BY_HAND}."
                )));
        }
        let by_camera = distances(rig, spots);
        let positions = by_camera.iter().map(Vec::len).sum();
        let error = median(&mut by_camera.concat()).unwrap_or(f64::INFINITY);
        let pixels = |errors: f64| errors * NOISE;
        if let Some(odd) = odd(&by_camera) {
            return Err(Error::input(format!(
                "the keypoints of camera {} contradict those of the others: half of {} positions are more than {:.0} px (of \
                 1920) from where the others see them ({:.0} px in the other cameras), {:.0} % more than {:.0} px",
                names[odd.camera],
                by_camera[odd.camera].len(),
                pixels(odd.median),
                pixels(odd.others),
                100.0 * (1.0 - odd.explained),
                pixels(EXPLAINED)
            ))
            .remedy(format!(
                "Check that its keypoints and frame numbers belong to its video and show a person of the other cameras, set \
                 its time offset in import.toml, leave it out (use = false), {BY_HAND}."
            )));
        }
        if error > MOST_ERROR {
            return Err(Error::input(format!(
                "the keypoints of people contradict each other: half of them are more than {:.0} px (of 1920) from where \
                 they meet",
                pixels(error)
            ))
            .remedy(format!("Use a more accurate detector, set time offsets in import.toml, {BY_HAND}.")));
        }
        let rivals = rigs.iter().filter(|r| r.0.gain > AMBIGUOUS * rig.gain && whole(r));
        for (rival, _) in rivals.filter(|r| !std::ptr::eq(&r.0, rig)) {
            let apart = self.apart(rig, rival);
            let worst = (0..names.len()).max_by(|&a, &b| apart[a].total_cmp(&apart[b])).unwrap_or(0);
            if apart[worst] > DISTINCT {
                return Err(Error::input(format!(
                    "another rig explains the keypoints of people about as well: camera {} is {:.0} degrees elsewhere in it",
                    names[worst], apart[worst]
                ))
                .remedy(format!("Give keypoints of a longer time, in which people walk and turn, {BY_HAND}.")));
            }
        }
        let apart = self.halves(rig).unwrap_or_else(|| vec![f64::INFINITY; names.len()]);
        let worst = (0..names.len()).max_by(|&a, &b| apart[a].total_cmp(&apart[b])).unwrap_or(0);
        if apart[worst] > MOST_APART {
            return Err(Error::input(format!(
                "the keypoints of people do not determine the rig: by two halves of them camera {} differs by {:.0} degrees",
                names[worst], apart[worst]
            ))
            .remedy(format!("Give keypoints of a longer time, in which people walk through the whole space, {BY_HAND}.")));
        }
        let mut depths = Vec::new();
        for spot in spots {
            let Some(x) = spot.place else { continue };
            depths.extend(spot.seen.iter().map(|(c, _)| rig.poses[*c].expect("all are placed").apply(x)[2]));
        }
        let by = 1.0 / median(&mut depths).filter(|d| *d > 0.0).unwrap_or(1.0);
        let camera = |c: usize| {
            let pose = rig.poses[c].expect("all are placed");
            let pose = Se3 { rotation: pose.rotation, translation: pose.translation.map(|v| v * by) };
            (pose, rig.lenses[c].scaled(error_of(&self.of[c])))
        };
        Ok(Calibrated {
            cameras: (0..names.len()).map(camera).collect(),
            offsets: rig.offsets.clone(),
            people: rig.people.len(),
            positions,
            error: pixels(error),
            apart: apart[worst],
        })
    }

    /// By how much the rigs of two halves of the keypoints differ, for each camera.
    fn halves(&self, rig: &Rig) -> Option<Vec<f64>> {
        let half = |odd: usize| {
            let (mut part, mut spots) = (rig.clone(), self.spots(rig, TIMES));
            spots.retain(|s| s.keypoint % 2 == odd);
            let how = How { steps: STEPS, focal: true, center: false, k1: false, family: ALIKE, clocks: None };
            self.adjusted(&mut part, &mut spots, how).map(|_| part)
        };
        let (even, odd) = (half(0)?, half(1)?);
        Some(self.apart(&even, &odd))
    }
}
