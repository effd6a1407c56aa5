//! Shared parts of checks: thresholds, grades, and the report that they write findings to.

use super::{Finding, Grade, Report};
use splat4d::scene::Camera;

/// Sharpness relative to other cameras.
pub(super) const SHARPNESS: [f64; 2] = [0.6, 0.35];
/// Exposure, one channel against green, and corners against the middle of images, stops.
pub(super) const EXPOSURE: [f64; 2] = [0.15, 0.5];
/// sRGB values are this power of light, about.
pub(super) const GAMMA: f64 = 2.2;
/// Matches that are needed to judge a pair.
pub(super) const MATCHES: usize = 12;
/// This many of a camera's pairs must agree on its error at least, of this many that measure it; chance only makes
/// errors larger.
pub(super) const AGREE: usize = 2;

pub(super) fn grade(value: f64, [warning, bad]: [f64; 2]) -> Option<Grade> {
    match value {
        v if v >= bad => Some(Grade::Bad),
        v if v >= warning => Some(Grade::Warning),
        _ => None,
    }
}

pub(super) fn worse([a, b]: [f64; 2], [c, d]: [f64; 2]) -> [f64; 2] {
    [a.max(c), b.max(d)]
}

/// Pixels of an image 1920 wide for each of its own.
pub(super) fn unit(view: &Camera) -> f64 {
    /// The image's longer side that thresholds refer to.
    const WIDE: f64 = 1920.0;
    WIDE / view.width.max(view.height) as f64
}

/// Destination of findings.
pub(super) struct FindingList<'a> {
    pub(super) report: &'a mut Report,
}

impl FindingList<'_> {
    pub(super) fn add(
        &mut self,
        (grade, check): (Grade, &'static str),
        camera: Option<&str>,
        (amount, unit): (f64, &'static str),
        what: String,
        (looks, remedy): (&'static str, &str),
    ) {
        self.report.findings.push(Finding {
            grade,
            check,
            camera: camera.map(str::to_owned),
            amount: Some(amount),
            unit,
            what,
            looks,
            remedy: remedy.to_owned(),
            alike: Vec::new(),
        });
    }
}
