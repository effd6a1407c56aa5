//! Initial points: which part is in front of the cameras and in their images, and whether their colours are those there.

use super::super::lens::Distortion;
use super::super::preflight::{Finding, Severity};
use super::super::{Aspect, Capture};
use super::look::{Look, pixel_of};
use super::pairs;
use splat4d::math::Se3;

/// Cameras and points that are asked, at most, evenly chosen.
const CAMERAS: usize = 24;
const POINTS: usize = 400;
/// Share of points in images, and gain of colours, from which poses are right.
const CONVINCES: (f64, f64) = (0.03, 0.12);
/// Share of points that another convention shows at least, and how many times that of the poses as read.
const SHOWN: (f64, f64) = (0.25, 4.0);
/// The same without colours that say anything.
const ALONE: f64 = 10.0;
/// By how much another convention's colours fit better at least, where points in images already say so; else alone.
pub(super) const BETTER: f64 = 0.05;
const COLOURS_ALONE: f64 = 0.15;
/// Colours that are compared at least.
const ENOUGH: usize = 60;

/// What points say of one convention.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Measure {
    /// Points that were asked.
    pub(super) asked: usize,
    /// Part of (camera, point) in front and inside.
    pub(super) seen: f64,
    /// How much nearer colours are to the image there than to that at other points: 0 by chance, 1 at best.
    pub(super) gain: Option<f64>,
}

impl Measure {
    /// The finding where no camera sees a point.
    pub(super) fn elsewhere(&self) -> Finding {
        Finding {
            severity: Severity::Warning,
            aspect: Some(Aspect::Assumed),
            what: format!(
                "Initial points and poses do not fit: none of {} points is in front of a camera and inside its image, and no \
                 other convention of poses fits either. One of the two is wrong, or in another unit.",
                self.asked
            ),
            remedy:
                "Export poses and points from one program together, or find points in the images: --set init=pictures."
                    .into(),
        }
    }

    /// Whether poses are right by this.
    pub(super) fn convinces(&self) -> bool {
        self.seen >= CONVINCES.0 && self.gain.is_some_and(|g| g >= CONVINCES.1)
    }
}

/// The training frames whose cameras are asked.
pub(super) fn frames(capture: &Capture) -> Vec<usize> {
    let step = capture.train.len().div_ceil(CAMERAS).max(1);
    capture.train.iter().step_by(step).copied().collect()
}

/// Measures one convention: `spread` are frames with their poses in it, `looks` images with theirs.
pub(super) fn measure(
    capture: &Capture,
    (frames, poses): (&[usize], &[Se3]),
    (looks, look_poses): (&[Look], &[Se3]),
) -> Measure {
    let Some(cloud) = &capture.points else { return Measure::default() };
    let step = cloud.points.len().div_ceil(POINTS).max(1);
    let chosen: Vec<usize> = (0..cloud.points.len()).step_by(step).collect();
    let mut seen = 0;
    for (&i, pose) in frames.iter().zip(poses) {
        let camera = &capture.frames[i].source;
        let lens = Distortion::new(camera.lens);
        seen += chosen.iter().filter(|&&p| pixel_of(camera, &lens, pose, cloud.points[p]).is_some()).count();
    }
    let share = seen as f64 / (chosen.len() * frames.len()).max(1) as f64;
    Measure { asked: chosen.len(), seen: share, gain: gain(capture, &chosen, looks, look_poses) }
}

/// How much nearer colours of some points are to the images there than to those at other points.
pub(super) fn gain_of(capture: &Capture, looks: &[Look], poses: &[Se3]) -> Option<f64> {
    let count = capture.points.as_ref()?.points.len();
    let chosen: Vec<usize> = (0..count).step_by(count.div_ceil(POINTS).max(1)).collect();
    gain(capture, &chosen, looks, poses)
}

/// How much nearer colours are to the image there than to that at other points. `None`: points have one colour, or too few
/// are in images.
fn gain(capture: &Capture, chosen: &[usize], looks: &[Look], poses: &[Se3]) -> Option<f64> {
    let cloud = capture.points.as_ref()?;
    let apart = |a: &[f32; 3], b: &[f32; 3]| a.iter().zip(b).map(|(x, y)| f64::from((x - y).abs())).sum::<f64>();
    let (mut own, mut other, mut count) = (0.0, 0.0, 0);
    for (look, pose) in looks.iter().zip(poses) {
        let pairs: Vec<([f32; 3], [f32; 3])> =
            chosen.iter().filter_map(|&p| Some((cloud.colors[p], look.color_of(pose, cloud.points[p])?))).collect();
        let n = pairs.len();
        if n < 2 {
            continue;
        }
        for (i, (color, there)) in pairs.iter().enumerate() {
            own += apart(color, there);
            // Every point is compared with what is at several others.
            for shift in [n / 4, n / 2, 3 * n / 4] {
                other += apart(color, &pairs[(i + shift.max(1)) % n].1) / 3.0;
            }
        }
        count += n;
    }
    (count >= ENOUGH && other > 1e-3 * count as f64).then(|| 1.0 - own / other)
}

/// Whether points say that poses are written in the convention of `m`, and not as `stated`.
pub(super) fn prefers(m: &Measure, stated: &Measure, pairs: &pairs::Measure) -> bool {
    if m.asked == 0 || pairs.contradicts() {
        return false;
    }
    let gain = |m: &Measure| m.gain.unwrap_or(0.0);
    let shown = m.seen >= SHOWN.0 && m.seen >= SHOWN.1 * stated.seen;
    let better = gain(m) >= gain(stated) + BETTER;
    let without_colours = m.gain.is_none() && m.seen >= ALONE * stated.seen;
    let by_colours = gain(m) >= COLOURS_ALONE && gain(stated) <= 0.4 * gain(m) && m.seen >= 0.5 * stated.seen;
    shown && (better || without_colours) || by_colours
}
