//! Evidence for poses: initial points in front of the cameras and inside their images, their colours there, features of
//! neighbouring images on each other's epipolar lines, and foregrounds at one position.
//!
//! Each is measured for the poses as read, and as they would be in other conventions of the layout. A finding needs a
//! convention that fits clearly better; nothing else raises a warning.

mod alpha;
mod copies;
mod focal;
mod look;
mod motion;
mod outliers;
mod outlines;
mod pairs;
mod parts;
mod points;
mod silhouettes;
#[cfg(test)]
mod tests;
mod zooms;

use super::account::Severity;
use super::account::first_names;
use super::preflight::Finding;
use super::{Aspect, Capture, DepthFile, Frame, Poses};
use look::SmallImage;
pub use motion::Agreement;
use splat4d::math::Se3;
use std::collections::BTreeSet;

/// Images that are examined first: at least, where they are large, and at most.
const CHECKED: [usize; 2] = [4, 10];
/// The same at most of captures of which parts are examined too.
const CHECKED_BEFORE_PARTS: usize = 6;
/// Pixels that are decoded first, at most, unless the least images have more: a third of a second of one core. Their features
/// take longer.
const PIXELS: usize = 25_000_000;
/// Mean part of images that their masks show, from which these hide nothing: less than half a level of 8 bits.
const HIDES_NOTHING: f64 = 0.999;
/// Part of a moving camera's frames between two that are examined: neighbours overlap, and are apart.
const STRIDE: usize = 50;

/// The measures of one convention.
#[derive(Clone, Copy, Debug, Default)]
struct Measure {
    points: points::Measure,
    pairs: pairs::Measure,
    foreground: Option<f64>,
}

/// Result of [`Capture::check_poses`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PoseCheck {
    /// The convention that the poses are probably written in; `None`: as they were read, or undetermined.
    pub written_as: Option<Poses>,
    /// The finding, or the reason for none.
    pub finding: Finding,
    /// Further findings from images: single poses, focal lengths and masks.
    pub more: Vec<Finding>,
    /// Whether the finding is another convention.
    misread: bool,
}

impl Capture {
    /// Compares poses with points and images. Opens a few images; images that cannot be read are passed over.
    pub fn check_poses(&self) -> PoseCheck {
        let order = outliers::places(self);
        let mut images = look::take(self, &self.looked_at(order.len()), look::COARSE);
        let mut matches = None;
        let mut check = self.judge(&points::frames(self), &mut images, &mut matches);
        let by_points = || points::gain_of_all(self, &images).is_some_and(|gain| gain >= points::CONVINCES.1);
        if check.finding.severity == Severity::Note
            && let Some(matches) = &matches
            && (check.finding.aspect == Some(Aspect::NotChecked) || by_points())
        {
            let poses: Vec<Se3> = images.iter().map(|l| self.frames[l.frame].source.cam_from_world).collect();
            check.finding = pairs::contradiction(matches, &images, &poses).unwrap_or(check.finding);
        }
        if !check.misread {
            let poses: Vec<Se3> = images.iter().map(|l| self.frames[l.frame].source.cam_from_world).collect();
            check.more.extend(focal::check(self, matches.as_deref(), &images, &poses));
            let fits = check.more.iter().chain([&check.finding]).all(|f| f.severity == Severity::Note);
            check.more.extend(check_masks(&images, &poses));
            check.more.extend(outlines::check(self, &images));
            check.more.extend(self.clocks_unchecked());
            check.more.extend(alpha::check(images.iter().map(|l| l.fringe)));
            check.more.extend(copies::check(self));
            if order.len() > outliers::ALL && fits {
                let seen: Vec<usize> = images.iter().map(|l| l.frame).collect();
                check.more.extend(parts::check(self, &order, &seen));
            }
            let pixels: usize = images.iter().map(|l| l.camera.width * l.camera.height).sum();
            check.more.extend(outliers::check(self, &order, images, PIXELS.saturating_sub(pixels)));
        }
        check
    }

    /// Cameras that see none of the initial points where others see many, and metric depth maps in another unit than
    /// the points. Opens a few depth maps.
    pub(super) fn check_points(&self) -> Vec<Finding> {
        let mut findings = Vec::new();
        let warn = |what: String, remedy: &str| Finding {
            severity: Severity::Warning,
            aspect: Some(Aspect::Assumed),
            what,
            remedy: remedy.into(),
        };
        let blind = points::blind(self);
        if !blind.is_empty() {
            let names: Vec<String> = blind.iter().map(|&i| self.frames[i].image.display().to_string()).collect();
            let what = format!(
                "{} images see none of the initial points, which others see: {}. Their poses are probably wrong.",
                names.len(),
                first_names(&names)
            );
            findings.push(warn(what, "Correct their poses, or take these images out."));
        }
        if let Some(error) = points::unreadable_depth(self) {
            let what = format!("A depth map cannot be used, and training with depth stops there: {error}");
            findings.push(warn(what, "Without depth: --set loss.depth=0."));
            return findings;
        }
        match points::depth_unit(self) {
            points::Unit::Right => {}
            points::Unit::Unknown => findings.push(Finding {
                severity: Severity::Note,
                aspect: Some(Aspect::NotChecked),
                what: "Whether depth maps are in scene units: neither initial points nor other maps allow a check."
                    .into(),
                remedy: String::new(),
            }),
            points::Unit::Inverse(correlation, file) => {
                let what = format!(
                    "Depth maps probably hold inverse depths (disparities): their values fall where initial points are farther \
                     away (correlation {correlation:.2}; such as {}).",
                    file.path.display()
                );
                let remedy = "Write depths, or state depth_kind \"inverse\" in a capture.json (docs/priors.md).";
                findings.push(warn(what, remedy));
            }
            points::Unit::Wrong(ratio, by, file) => {
                let remedy = "State the unit (depth_unit_scale_factor; in capture.json depth_scale).";
                findings.push(warn(other_unit(ratio, by, file), remedy));
            }
        }
        findings
    }

    /// Motion shows time offsets, over more images than are examined here.
    fn clocks_unchecked(&self) -> Option<Finding> {
        let filming: BTreeSet<usize> =
            self.frames.iter().filter(|f| self.cameras[f.camera].fixed && f.index > 0).map(|f| f.camera).collect();
        (filming.len() > 1).then(|| Finding {
            severity: Severity::Note,
            aspect: Some(Aspect::NotChecked),
            what: "Whether cameras are a frame early or late: info --doctor compares what moves.".into(),
            remedy: String::new(),
        })
    }

    /// The verdict by these images, and by the points that the frames `spread` see; features are found and matched if points do not
    /// say enough.
    fn judge(&self, spread: &[usize], images: &mut [SmallImage], matches: &mut Option<Vec<pairs::Match>>) -> PoseCheck {
        let mut conventions = vec![Poses::STATED];
        conventions.extend(self.convention.others());
        let posed = |f: &Frame, p: Poses| match p {
            Poses::STATED => Some(f.source.cam_from_world),
            p => self.convention.reread(&f.source.cam_from_world, p).ok(),
        };
        let all = |frames: &[usize], p: Poses| -> Option<Vec<Se3>> {
            frames.iter().map(|&i| posed(&self.frames[i], p)).collect()
        };
        let mut measures = vec![Measure::default(); conventions.len()];
        let seen: Vec<usize> = images.iter().map(|l| l.frame).collect();
        let poses: Vec<Option<Vec<Se3>>> = conventions.iter().map(|&p| all(&seen, p)).collect();
        for ((m, &p), poses) in measures.iter_mut().zip(&conventions).zip(&poses) {
            let (Some(spread_poses), Some(poses)) = (all(spread, p), poses) else { continue };
            m.points = points::measure(self, (spread, &spread_poses), (images, poses));
            m.foreground = silhouettes::measure(images, poses);
        }
        // Points whose colours agree well suffice.
        if !measures[0].points.suffices() {
            let matches = matches.get_or_insert_with(|| {
                look::describe(images, look::COARSE);
                pairs::matches(images)
            });
            pairs::measure(matches, images, &poses).into_iter().zip(&mut measures).for_each(|(p, m)| m.pairs = p);
        }
        self.conclude(&conventions, &measures)
    }

    /// The frames that are examined first, of a capture with this number of places: cameras of one time in their order, or frames of a moving
    /// camera in a row.
    fn looked_at(&self, places: usize) -> Vec<usize> {
        let pixels = self.frames.first().map_or(1, |f| f.source.width * f.source.height).max(1);
        let most = if places > outliers::ALL { CHECKED_BEFORE_PARTS } else { CHECKED[1] };
        let most = (PIXELS / pixels).clamp(CHECKED[0], most);
        let mut counts = std::collections::BTreeMap::<usize, Vec<usize>>::new();
        for &i in &self.train {
            counts.entry(self.frames[i].index).or_default().push(i);
        }
        let fullest = counts.into_values().rev().max_by_key(Vec::len).unwrap_or_default();
        if fullest.len() >= CHECKED[0].min(self.train.len()) {
            return fullest.into_iter().take(most).collect();
        }
        if self.fixed_cameras() {
            // One image of each: more of a camera show the same again, and its mistakes would count several times.
            let instant = fullest.first().map_or(0, |&i| self.frames[i].index);
            let mut nearest: Vec<usize> = (0..self.frames.len()).collect();
            nearest.sort_by_key(|&i| (self.frames[i].index.abs_diff(instant), i));
            let mut cameras = BTreeSet::new();
            nearest.retain(|&i| cameras.insert(self.frames[i].camera));
            nearest.truncate(most);
            nearest.sort_unstable();
            return nearest;
        }
        // Two runs of frames, a little apart from one another within each.
        let mut frames = self.train.clone();
        frames.sort_by(|&a, &b| self.frames[a].time.0.total_cmp(&self.frames[b].time.0));
        let stride = frames.len().div_ceil(STRIDE);
        let run = most.div_ceil(2);
        let starts = [0, frames.len() / 2];
        let mut out: Vec<usize> = starts
            .iter()
            .flat_map(|&s| (0..run).filter_map(|k| frames.get(s + k * stride).copied()).collect::<Vec<_>>())
            .collect();
        out.sort_unstable();
        out.dedup();
        out
    }

    fn conclude(&self, conventions: &[Poses], measures: &[Measure]) -> PoseCheck {
        let stated = &measures[0];
        let found = (1..measures.len())
            .filter(|&k| {
                points::prefers(&measures[k].points, &stated.points, &measures[k].pairs)
                    || pairs::prefers(&measures[k].pairs)
                    || silhouettes::prefers(measures[k].foreground, stated.foreground)
            })
            // The first of equals has the fewest changes.
            .rev()
            .max_by(|&a, &b| measures[a].score().total_cmp(&measures[b].score()));
        let Some(best) = found.filter(|&k| measures[k].score() > stated.score()) else {
            let finding = stated.points.doubt(&stated.pairs).unwrap_or_else(|| stated.agrees());
            return PoseCheck { written_as: None, finding, more: Vec::new(), misread: false };
        };
        let (m, poses) = (&measures[best], conventions[best]);
        let mut parts = Vec::new();
        if m.points.asked > 0 {
            parts.push(format!(
                "{:.0} % of the initial points are in front of the cameras and in their images (as read {:.0} %)",
                100.0 * m.points.seen,
                100.0 * stated.points.seen
            ));
        }
        if let Some(gain) = m.points.gain {
            let own = stated.points.gain.map_or_else(String::new, |g| format!(", {:.0} % as read", 100.0 * g.max(0.0)));
            parts.push(format!("colours of points fit their images by {:.0} %{own}", 100.0 * gain));
        }
        if m.pairs.matches > 0 {
            parts.push(format!(
                "{} of {} matches between images fit (as read {})",
                m.pairs.fitting, m.pairs.matches, stated.pairs.fitting
            ));
        }
        if let (Some(here), Some(there)) = (m.foreground, stated.foreground) {
            let percent = |x: f64| 100.0 * x;
            parts.push(format!(
                "the foregrounds of {:.0} % of the images are at one place (as read {:.0} %)",
                percent(here),
                percent(there)
            ));
        }
        let what = format!(
            "Poses are probably written in another convention than the layout states: if {}, {}.",
            poses.in_words(self.convention),
            parts.join(", ")
        );
        let (written_as, remedy) = match self.poses == Poses::STATED {
            true => (Some(poses), format!("Read them so: --poses {poses}.")),
            false => (None, format!("They are read by --poses {}: leave it out, or give another.", self.poses)),
        };
        PoseCheck {
            written_as,
            finding: Finding { severity: Severity::Warning, aspect: Some(Aspect::Assumed), what, remedy },
            more: Vec::new(),
            misread: true,
        }
    }
}

/// The finding where depth maps are in another unit than `by`.
fn other_unit(ratio: f64, by: &str, file: &DepthFile) -> String {
    format!(
        "Depth maps and {by} do not fit: these are {ratio:.3e} times as far away as depth maps say (such as {}). A stored number \
         is probably {:.3e} scene units, and is read as {:.3e}.",
        file.path.display(),
        ratio * file.scale,
        file.scale
    )
}

/// Polarity of masks and alpha: white counts.
fn check_masks(images: &[SmallImage], poses: &[Se3]) -> Option<Finding> {
    let percent = |x: f64| 100.0 * x;
    let (severity, aspect, what, remedy) = match silhouettes::masks(images, poses) {
        silhouettes::Masks::Fine => return None,
        silhouettes::Masks::Inverted(part, share, of_edge) => (
            Severity::Warning,
            Aspect::Assumed,
            format!(
                "Masks are probably inverted (white counts): what they hide is at one place, which the cameras point at, in {:.0} % of \
                 the images; they show {:.0} % of the images and {:.0} % of their edges.",
                percent(part),
                percent(share),
                percent(of_edge)
            ),
            "Invert them, unless the hidden part is not needed.",
        ),
        silhouettes::Masks::Unsure(images, share) if share >= HIDES_NOTHING => (
            Severity::Note,
            Aspect::Assumed,
            format!(
                "Masks hide nothing: all {images} that were looked at are white everywhere; every value above 0 may count as white."
            ),
            "Masks of classes: set the class that is hidden to 0, and all others to 255.",
        ),
        silhouettes::Masks::Unsure(images, share) => (
            Severity::Note,
            Aspect::NotChecked,
            format!(
                "Whether masks are inverted (white counts): they show {:.0} % of {images} images, and neither that nor the rest is \
                 at one place.",
                percent(share)
            ),
            "",
        ),
    };
    Some(Finding { severity, aspect: Some(aspect), what, remedy: remedy.into() })
}

/// Whether poses describe upright images (with their EXIF orientation applied), by colours of points and by matches
/// between images; `None`: undetermined. `unsure` are frames whose sizes do not decide.
pub(super) fn upright(capture: &Capture, unsure: &[usize]) -> Option<bool> {
    let others = (0..capture.frames.len()).filter(|i| !unsure.contains(i)).take(CHECKED[0]);
    let some: Vec<usize> = unsure.iter().copied().take(CHECKED[1] - CHECKED[0]).collect();
    let measured = [true, false].map(|upright| {
        let asked = some.iter().filter_map(|&i| look::one(capture, i, upright));
        let sure = others.clone().filter_map(|i| look::one(capture, i, true));
        let mut images: Vec<SmallImage> = asked.chain(sure).collect();
        let pose = |l: &SmallImage| capture.frames[l.frame].source.cam_from_world;
        let poses: Vec<Se3> = images.iter().map(pose).collect();
        let count = images.iter().filter(|l| some.contains(&l.frame)).count();
        let gain = points::gain_of(capture, &images[..count], &poses[..count]);
        look::describe(&mut images, look::COARSE);
        let matches = pairs::matches(&images);
        (gain, pairs::measure(&matches, &images, &[Some(poses)])[0])
    });
    let [(gain, pairs), (stored_gain, stored_pairs)] = measured;
    if let (Some(a), Some(b)) = (gain, stored_gain)
        && (a - b).abs() >= points::BETTER
    {
        return Some(a > b);
    }
    let [a, b] = [&pairs, &stored_pairs].map(|p| if p.convinces() { p.fitting } else { 0 });
    (a.max(b) > 2 * a.min(b)).then_some(a > b)
}

impl Measure {
    /// Fit of a convention, for comparison with others.
    fn score(&self) -> f64 {
        let points = self.points.seen * (0.1 + self.points.gain.unwrap_or(0.0).max(0.0));
        points + self.pairs.share() + 0.5 * self.foreground.unwrap_or(0.0)
    }

    /// Evidence for the poses as read, or the reason why there is none.
    fn agrees(&self) -> Finding {
        let mut parts = Vec::new();
        if self.points.convinces() {
            parts.push(format!(
                "{:.0} % of the initial points are in front of the cameras and in their images, and colours of points fit these \
                 by {:.0} %",
                100.0 * self.points.seen,
                100.0 * self.points.gain.unwrap_or(0.0)
            ));
        }
        if self.pairs.convinces() {
            parts.push(format!("{} of {} matches between images fit", self.pairs.fitting, self.pairs.matches));
        }
        if let Some(share) = self.foreground.filter(|s| *s >= silhouettes::CONVINCES) {
            parts.push(format!("the foregrounds of {:.0} % of the images are at one place", 100.0 * share));
        }
        let (aspect, what) = match parts.is_empty() {
            false => (None, format!("Poses agree with the images: {}.", parts.join(", "))),
            true => (
                Some(Aspect::NotChecked),
                format!(
                    "Whether the poses are right: {} initial points, of which {:.0} % are in images, and {} matches between \
                     images, of which {} fit, are too few.",
                    self.points.asked,
                    100.0 * self.points.seen,
                    self.pairs.matches,
                    self.pairs.fitting
                ),
            ),
        };
        Finding { severity: Severity::Note, aspect, what, remedy: String::new() }
    }
}
