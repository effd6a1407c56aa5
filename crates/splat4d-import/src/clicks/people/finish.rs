//! The rig that explains most keypoints: adjusted with time offsets and lenses, and refused where it may be wrong.

use super::bundle::{ALIKE, How, STRANGERS};
use super::check::{Calibrated, DISTINCT, STEPS, TIMES};
use super::pairs::{Fit, LEAST_TIMES, fits};
use super::rig::MEETS;
use super::track::{PEOPLE, linked};
use super::{Cameras, Rig, Spot, error_of};
use crate::clicks::keypoints::Frames;
use crate::clicks::solve::Camera;
use crate::{Error, Result};
use rayon::prelude::*;

/// Pairs that start a rig, and rigs that are adjusted to the end.
const STARTS: usize = 4;
const RIGS: usize = 3;
/// Rounds of time offsets and poses; they end where no offset changes by more, seconds.
const ROUNDS: usize = 6;
const SETTLED: f64 = 1e-4;
/// Error of offsets that are searched for, seconds.
const OPEN: f64 = 0.1;
/// Share of the loss that different focal lengths must save before they are believed.
const DIFFERENT: f64 = 0.1;

/// Finds poses, lenses and time offsets of cameras by the people that they show.
///
/// Errors: no start, cameras without a pose, and rigs that may be wrong: people who do not meet, several rigs that fit, a
/// rig that depends on which keypoints are used.
pub(crate) fn calibrate(names: &[&str], cameras: &[Camera], frames: &[Frames]) -> Result<Calibrated> {
    let tracks = frames.iter().zip(cameras).map(|(f, c)| linked(f, c.interval, error_of(c))).collect();
    let all = Cameras { of: cameras, tracks };
    if let Some(c) = (0..names.len()).find(|&c| all.tracks[c].iter().all(|t| t.active < LEAST_TIMES)) {
        return Err(Error::input(format!("no person moves in the images of camera {}", names[c])).remedy(
            "Record a person who walks through the space that all cameras show. Or leave the camera out (use = false in \
             import.toml), or align it by hand (--assist).",
        ));
    }
    let mut pairs: Vec<[usize; 4]> = Vec::new();
    for (a, b) in (0..names.len()).flat_map(|a| (a + 1..names.len()).map(move |b| (a, b))) {
        let of = |c: usize| 0..all.tracks[c].len().min(PEOPLE);
        pairs.extend(of(a).flat_map(|i| of(b).map(move |j| [a, b, i, j])));
    }
    let found: Vec<Vec<Fit>> = pairs.par_iter().map(|&[a, b, i, j]| fits(&all, [a, b], [i, j])).collect();
    let mut starts: Vec<&Vec<Fit>> = found.iter().filter(|f| !f.is_empty()).collect();
    starts.sort_by(|x, y| y[0].gain().total_cmp(&x[0].gain()));
    starts.truncate(STARTS);
    if starts.is_empty() {
        return Err(Error::input("no two cameras show the same person").remedy(
            "Give keypoints of a time in which all cameras show one person who walks, set time offsets that differ by more \
             than half a second in import.toml, or align the cameras by hand (--assist).",
        ));
    }
    let known: Vec<Fit> = found.iter().filter_map(|f| f.first().copied()).collect();
    let starts: Vec<&Fit> = starts.into_iter().flatten().collect();
    let mut rigs: Vec<Rig> = starts.par_iter().filter_map(|start| all.grown(start, &known)).collect();
    rigs.sort_by(|x, y| y.placed().len().cmp(&x.placed().len()).then(y.gain.total_cmp(&x.gain)));
    let mut distinct: Vec<Rig> = Vec::new();
    for rig in rigs {
        if distinct.len() < RIGS && distinct.iter().all(|d| all.apart(&rig, d).iter().any(|a| *a > DISTINCT)) {
            distinct.push(rig);
        }
    }
    let mut rigs: Vec<(Rig, Vec<Spot>)> = distinct.into_iter().filter_map(|r| all.finished(r)).collect();
    rigs.sort_by(|(x, _), (y, _)| y.placed().len().cmp(&x.placed().len()).then(y.gain.total_cmp(&x.gain)));
    all.checked(names, &rigs)
}

impl Cameras<'_> {
    /// Adjusts a rig to the end, with all people.
    fn finished(&self, mut rig: Rig) -> Option<(Rig, Vec<Spot>)> {
        while self.extend(&mut rig) {}
        let mut spots = self.spots(&rig, TIMES);
        let how = How { steps: STEPS, focal: true, center: true, k1: false, family: ALIKE, clocks: None };
        self.adjusted(&mut rig, &mut spots, how)?;
        if self.of.iter().any(|c| !c.keep_offset) {
            for _ in 0..ROUNDS {
                let taus = self.adjusted(&mut rig, &mut spots, How { clocks: Some(OPEN), ..how })?;
                rig.offsets.iter_mut().zip(&taus).for_each(|(o, tau)| *o -= tau);
                spots = self.spots(&rig, TIMES);
                if taus.iter().all(|t| t.abs() < SETTLED) {
                    break;
                }
            }
        }
        self.adjusted(&mut rig, &mut spots, how)?;
        let [mean, count] = self.loss(&rig, &spots)?;
        let (mut other, mut same) = (rig.clone(), self.spots(&rig, TIMES));
        if self.of.iter().all(|c| c.focal.is_none()) && rig.placed().len() > 2 {
            self.adjusted(&mut other, &mut same, How { family: STRANGERS, ..how })?;
            if self.loss(&other, &same)?[0] < (1.0 - DIFFERENT) * mean {
                (rig, spots) = (other, same);
            }
        }
        rig.gain = self.loss(&rig, &spots).map_or(0.0, |[mean, _]| count * (MEETS - mean));
        Some((rig, spots))
    }
}
