//! Focal lengths: the one that right poses need for matches to lie on their epipolar lines.

use super::super::account::Severity;
use super::super::preflight::Finding;
use super::Aspect;
use super::look::Look;
use super::pairs::{self, Match};
use splat4d::math::Se3;

/// Factors that are tried are powers of this, up to so many both ways: a quarter to four times.
const STEP: f64 = 1.189_207_115_002_721;
const STEPS: i32 = 8;
/// Steps from the focal length as read within which it is right: between them a few more matches fit by chance.
const RIGHT: i32 = 2;
/// How many times as many matches fit another focal length, where that is right; and how many at least, of all.
const BETTER: f64 = 1.5;
const ENOUGH: usize = 30;
const SHARE: f64 = 0.2;
/// Of the matches that fit, how many may fit half and twice the focal length where matches tell it.
const FLAT: f64 = 0.7;

/// A warning where matches need another focal length; a note where they fit any. `None`: it is right, or too few match.
pub(super) fn check(matches: &[Match], looks: &[Look], poses: &[Se3]) -> Option<Finding> {
    let steps: Vec<i32> = (-STEPS..=STEPS).collect();
    let factors: Vec<f64> = steps.iter().map(|&k| STEP.powi(k)).collect();
    let fitting = pairs::by_focal(matches, looks, poses, &factors);
    let of = |step: i32| fitting[(step + STEPS) as usize];
    // The nearest of equals.
    let best = steps.iter().copied().max_by_key(|&k| (of(k), -k.abs()))?;
    if of(best) < ENOUGH.max((SHARE * matches.len() as f64) as usize) {
        return None;
    }
    let octave = 4;
    if best.abs() > RIGHT && of(best) as f64 >= BETTER * of(0) as f64 {
        let own = looks[0].camera.intrinsics.fx;
        let what = format!(
            "Focal lengths are probably wrong: of {} matches between images {} fit if they are {:.2} times as long ({:.0} px in \
             place of {own:.0} px), and {} as read.",
            matches.len(),
            of(best),
            STEP.powi(best),
            STEP.powi(best) * own,
            of(0)
        );
        let remedy = "State the focal length for images of this size, in pixels of these images.".into();
        return Some(Finding { severity: Severity::Warning, aspect: Some(Aspect::Assumed), what, remedy });
    }
    let flat = of(octave).min(of(-octave)) as f64 >= FLAT * of(0) as f64;
    flat.then(|| Finding {
        severity: Severity::Note,
        aspect: Some(Aspect::NotChecked),
        what: format!(
            "Whether focal lengths are right: of {} matches between images {} fit as read, {} at half and {} at twice the length.",
            matches.len(),
            of(0),
            of(-octave),
            of(octave)
        ),
        remedy: String::new(),
    })
}
