//! Images of another zoom than their camera states, among images that fit: one camera model for photos with two focal lengths.

use super::super::account::{Severity, first_names};
use super::super::preflight::Finding;
use super::super::{Aspect, Capture};
use super::look::{SmallImage, Trial};
use super::points;
use rayon::prelude::*;

/// Factors of the focal length that are tried, both ways, are powers of this up to this many, and half a step around the best: a zoom
/// of up to 2.4.
const STEP: f64 = 1.189_207_115_002_721;
const STEPS: i32 = 5;
/// Gains of the colours of points below which an image does not fit, and from which another focal length does.
const LOW: f64 = 0.25;
const HIGH: f64 = 0.3;
/// By how much the other focal length fits better at least. Of captures of one zoom no image has one that does; of two zooms 14 to
/// 23 of 42 to 66 images (studies/records/2026-11-28-silent-inputs.md).
const BETTER: f64 = 0.15;
/// Images that fit as read, and images with one other factor (within this many steps), at least; and the share of those that are
/// examined.
const SEVERAL: usize = 2;
const ONE_ZOOM: f64 = 0.75;
const SHARE: f64 = 0.05;

/// An image that another focal length fits.
struct Zoomed {
    frame: usize,
    step: f64,
    /// Gains as read and with the other focal length.
    gains: [f64; 2],
}

/// The focal length that an image fits, where it does not fit as read; and its gain as read.
fn measure(capture: &Capture, look: &SmallImage) -> Option<(f64, Option<Zoomed>)> {
    let gain = |step: f64| points::gain_of_one(capture, look, Trial { times: [STEP.powf(step); 2], ..Trial::AS_READ });
    let own = gain(0.0)?;
    if own >= LOW {
        return Some((own, None));
    }
    let tried = |step: f64| gain(step).map_or((f64::NEG_INFINITY, step), |gain| (gain, step));
    let best = |tried: Vec<(f64, f64)>| tried.into_iter().max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((own, 0.0));
    let coarse = best((-STEPS..=STEPS).filter(|k| *k != 0).map(|k| tried(f64::from(k))).collect());
    let (high, step) = best(vec![tried(coarse.1 - 0.5), tried(coarse.1 + 0.5), coarse]);
    let fits = high >= HIGH && high >= own + BETTER;
    Some((own, fits.then_some(Zoomed { frame: look.frame, step, gains: [own, high] })))
}

/// A warning where some images fit initial points with another focal length, and others as read.
pub(super) fn check(capture: &Capture, images: &[&SmallImage]) -> Option<(Finding, Vec<usize>)> {
    capture.points.as_ref()?;
    let measured: Vec<(f64, Option<Zoomed>)> = images.par_iter().filter_map(|look| measure(capture, look)).collect();
    let fitting = measured.iter().filter(|(own, _)| *own >= HIGH).count();
    let zoomed: Vec<&Zoomed> = measured.iter().filter_map(|(_, z)| z.as_ref()).collect();
    // The factor of most.
    let of = |step: f64| zoomed.iter().copied().filter(move |z| (z.step - step).abs() <= ONE_ZOOM);
    let step = zoomed.iter().map(|z| z.step).max_by_key(|step| of(*step).count())?;
    let found: Vec<&Zoomed> = of(step).collect();
    if found.len() < SEVERAL || (found.len() as f64) < SHARE * measured.len() as f64 || fitting < SEVERAL {
        return None;
    }
    let mean = |of: &dyn Fn(&Zoomed) -> f64| found.iter().map(|z| of(z)).sum::<f64>() / found.len() as f64;
    let frames: Vec<usize> = found.iter().map(|z| z.frame).collect();
    let names: Vec<String> = frames.iter().map(|&f| capture.frames[f].image.display().to_string()).collect();
    let what = format!(
        "{} of {} images that were looked at probably have another focal length than their camera states: {}. Colours of points fit \
         these by {:.0} % if it is {:.1} times as long, and by {:.0} % as read; they fit other images as read.",
        names.len(),
        measured.len(),
        first_names(&names),
        100.0 * mean(&|z| z.gains[1]),
        STEP.powf(mean(&|z| z.step)),
        100.0 * mean(&|z| z.gains[0]).max(0.0)
    );
    let remedy =
        "Calibrate images of another zoom with a camera of their own (COLMAP: not --ImageReader.single_camera).";
    let severity = Severity::Warning;
    Some((Finding { severity, aspect: Some(Aspect::Assumed), what, remedy: remedy.into() }, frames))
}
