//! Focal lengths and distortion: those at which matches are on their epipolar lines and colours of points are those of
//! the images.

use super::super::Capture;
use super::super::account::Severity;
use super::super::lens::Distortion;
use super::super::preflight::Finding;
use super::Aspect;
use super::look::{SmallImage, Trial, bent};
use super::pairs::{self, Match};
use super::points;
use splat4d::math::Se3;

/// Factors that are tried are powers of this, up to this many both ways: a quarter to four times.
const STEP: f64 = 1.189_207_115_002_721;
const STEPS: i32 = 8;
/// Steps to half and to twice the length.
const OCTAVE: i32 = 4;
/// Steps from the focal length as read within which it is right by matches.
const RIGHT: i32 = 1;
/// Distance from its epipolar line at which a match counts nothing, pixels of the small image; nearer ones count more.
const REACH: f64 = 1.0;
/// How many times as well matches fit another focal length, where that is right; and their least weight and share.
const BETTER: f64 = 1.5;
const ENOUGH: f64 = 30.0;
const SHARE: f64 = 0.15;
/// Largest share of the error as read that matches may have at half or twice the focal length, where they determine it.
const FLAT: f64 = 0.7;
/// First radial terms that are tried: barrels of action cameras and of wide lenses, and a cushion.
const BENDS: [f64; 4] = [-0.3, -0.2, -0.12, 0.15];
/// By how much colours of points fit another focal length better, where that is right.
const COLOURS: f64 = 0.1;
/// The same where distortion is left out or added: fewer alternatives agree by chance.
const STRAIGHTER: f64 = 0.05;
/// The same where the points are compared that distortion moves.
const OUTER: f64 = 0.1;
/// How many times as well matches fit distorted images, where images are distorted.
const BENT: f64 = 1.3;

/// Results for the tried factors of focal lengths, by steps.
struct Tried(Vec<f64>);

impl Tried {
    fn new(of: impl Fn(f64) -> f64) -> Self {
        Self((-STEPS..=STEPS).map(|k| of(STEP.powi(k))).collect())
    }

    fn at(&self, step: i32) -> f64 {
        self.0[(step + STEPS) as usize]
    }

    /// The best step; the nearest of equals.
    fn best(&self) -> i32 {
        let better = |a: &i32, b: &i32| self.at(*a).total_cmp(&self.at(*b)).then(b.abs().cmp(&a.abs()));
        (-STEPS..=STEPS).max_by(better).unwrap_or(0)
    }
}

/// A warning where points or matches need other focal lengths; a note where matches fit any. `None`: they are right, or
/// there is no evidence. `matches`: none were searched for where points have shown that poses are right.
pub(super) fn check(
    capture: &Capture,
    matches: Option<&[Match]>,
    images: &[SmallImage],
    poses: &[Se3],
) -> Option<Finding> {
    by_points(capture, matches, images, poses).or_else(|| by_matches(matches?, images, poses))
}

fn by_points(capture: &Capture, matches: Option<&[Match]>, images: &[SmallImage], poses: &[Se3]) -> Option<Finding> {
    capture.points.as_ref()?;
    let measured = |trial: Trial| points::gain_if(capture, images, poses, trial);
    let own = measured(Trial::AS_READ);
    // Where too few points are in the images as read, those that come into view with shorter focal lengths may be hidden by
    // what the images show: colours then agree by chance.
    let few = own.is_none();
    let gain = |trial: Trial| match measured(trial) {
        Some((gain, compared)) if !few || compared >= points::MANY => gain,
        _ => 0.0,
    };
    let own = own.map_or(0.0, |(gain, _)| gain);
    let least = if few { points::GOOD + COLOURS } else { points::CONVINCES.1 };
    let percent = |gain: f64| 100.0 * gain.max(0.0);
    let as_read = format!("by {:.0} % as read", percent(own));
    let how = |gain: f64| format!("colours of initial points fit their images by {:.0} %", percent(gain));
    let matched = || {
        let [of, all] = matches.map_or([0; 2], |m| [pairs::fitting(m, images, poses), m.len()]);
        pairs::are_right(of, all)
    };
    let better = |gain: f64, by: f64| gain >= least && gain >= own + by && !(few && matched());
    let wrong = |gain: f64| better(gain, COLOURS);
    // Images that were undistorted, with the cameras of the originals.
    if images.iter().any(SmallImage::is_distorted) {
        let straight = gain(Trial { straight: true, ..Trial::AS_READ });
        if better(straight, STRAIGHTER) {
            let what = format!(
                "The distortion of the lenses probably does not apply to these images: {} without it, {as_read}.",
                how(straight)
            );
            let remedy =
                "If the images are undistorted, export the undistorted cameras, or set the distortion to zero.";
            return Some(warned(what, remedy));
        }
    }
    let (both, longer) = best(&|times| gain(Trial { times: [times; 2], ..Trial::AS_READ }));
    let (across, wider) = best(&|times| gain(Trial { times: [times, 1.0], ..Trial::AS_READ }));
    if !images.iter().any(SmallImage::is_distorted) {
        let whole = BENDS.map(|bend| (gain(Trial { bend, ..Trial::AS_READ }), bend));
        let (bent, bend) = whole.into_iter().max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, 0.0));
        if better(bent, STRAIGHTER) && bent >= both.max(across) {
            return Some(distorted(bend, &format!("{}, {as_read}", how(bent))));
        }
        // Distortion hardly moves the points in the middle of images, which are most.
        let outer = |(whole, bend): (f64, f64)| {
            let trial = Trial { bend, ..Trial::AS_READ };
            let ([read, bent], count) = points::gain_of_moved(capture, images, poses, trial)?;
            let fits = bent >= points::CONVINCES.1 && bent >= read + OUTER && whole >= both.max(across).max(own);
            (fits && !few).then_some((bent - read, bend, [read, bent], count))
        };
        let best = whole.into_iter().filter_map(outer).max_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((_, bend, [read, bent], count)) = best {
            let how = format!(
                "colours of the {count} points that this moves fit their images by {:.0} %, by {:.0} % as read",
                percent(bent),
                percent(read)
            );
            return Some(distorted(bend, &how));
        }
    }
    if wrong(across) && across >= both + COLOURS {
        let what = format!(
            "The focal length across (fx) is probably wrong: {} if it is {wider:.2} times as long, {as_read}.",
            how(across)
        );
        let remedy = "Images that were stretched, such as to 16:9, have another focal length across than down.";
        return Some(warned(what, remedy));
    }
    (longer != 1.0 && wrong(both)).then(|| warning(&how(both), longer, images, &as_read))
}

/// The warning about distorted images of pinhole cameras.
fn distorted(bend: f64, how: &str) -> Finding {
    let what = format!("The images are probably distorted, and the cameras are not: with k1 = {bend} {how}.");
    warned(what, "Undistort the images, or export the cameras with their distortion.")
}

/// The best result over the factors that are tried, refined by half a step, and its factor.
fn best(of: &dyn Fn(f64) -> f64) -> (f64, f64) {
    let coarse = Tried::new(of);
    let step = coarse.best();
    [0.0, -0.5, 0.5]
        .map(|half| {
            let times = STEP.powf(f64::from(step) + half);
            (if half == 0.0 { coarse.at(step) } else { of(times) }, times)
        })
        .into_iter()
        .reduce(|best, next| if next.0 > best.0 { next } else { best })
        .unwrap_or((0.0, 1.0))
}

fn by_matches(matches: &[Match], images: &[SmallImage], poses: &[Se3]) -> Option<Finding> {
    let weight = |residual: f64| (1.0 - (residual / REACH).powi(2)).max(0.0);
    let fitting = |times: f64, lens: Option<&Distortion>| -> f64 {
        pairs::residuals(matches, images, poses, times, lens).into_iter().map(weight).sum()
    };
    let fit = Tried::new(|times| fitting(times, None));
    let best = fit.best();
    let bent = BENDS.map(|bend| (fitting(1.0, Some(&bent(bend))), bend));
    let (bent, bend) = bent.into_iter().max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, 0.0));
    let enough = bent >= ENOUGH.max(SHARE * matches.len() as f64);
    if enough && bent >= BENT * fit.at(0) && bent >= fit.at(best) && !images.iter().any(SmallImage::is_distorted) {
        let how = format!("matches between images fit {:.1} times as well as read", bent / fit.at(0).max(1.0));
        return Some(distorted(bend, &how));
    }
    if fit.at(best) < ENOUGH.max(SHARE * matches.len() as f64) {
        return None;
    }
    if best.abs() > RIGHT && fit.at(best) >= BETTER * fit.at(0) {
        let how = format!("matches between images fit {:.1} times as well", fit.at(best) / fit.at(0).max(1.0));
        return Some(warning(&how, STEP.powi(best), images, "than as read"));
    }
    let flat = fit.at(OCTAVE).max(fit.at(-OCTAVE)) >= FLAT * fit.at(0);
    let percent = |step: i32| 100.0 * fit.at(step) / fit.at(0).max(1.0);
    flat.then(|| Finding {
        severity: Severity::Note,
        aspect: Some(Aspect::NotChecked),
        what: format!(
            "Whether focal lengths are right: {} matches between images fit half the length {:.0} %, and twice the length {:.0} % \
             as well as the lengths as read.",
            matches.len(),
            percent(-OCTAVE),
            percent(OCTAVE)
        ),
        remedy: String::new(),
    })
}

fn warning(how: &str, times: f64, images: &[SmallImage], as_read: &str) -> Finding {
    let own = images[0].camera.intrinsics.fx;
    let what = format!(
        "Focal lengths are probably wrong: {how} if they are {times:.2} times as long ({:.0} px in place of {own:.0} px), {as_read}.",
        times * own
    );
    warned(what, "State the focal length for images of this size, in pixels of these images.")
}

fn warned(what: String, remedy: &str) -> Finding {
    Finding { severity: Severity::Warning, aspect: Some(Aspect::Assumed), what, remedy: remedy.into() }
}
