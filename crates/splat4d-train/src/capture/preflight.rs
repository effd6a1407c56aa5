//! Checks of a capture before training: few cameras, narrow coverage, uneven timestamps.

use super::account::{Severity, first_names};
use super::{Aspect, Capture, Frame};
use splat4d::math::mat3::nearest_to_lines;
use splat4d::math::se3::{dot, norm, normalize, sub};

/// Something about a capture that will show in the result.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// Severity.
    pub severity: Severity,
    /// Related remark of reading the capture; `None`: of something else.
    pub aspect: Option<Aspect>,
    /// The finding, a sentence.
    pub what: String,
    /// The remedy, a sentence; empty where the finding states all.
    pub remedy: String,
}

/// Below this many views of a time, surfaces are not pinned down between them.
const FEW_CAMERAS: usize = 6;
/// Narrower rigs see little parallax, degrees.
const NARROW_DEGREES: f64 = 20.0;
/// Seconds from which f32 has steps of a millisecond.
const FAR_CLOCK: f64 = 1e4;
/// Images of a moving camera, at least, and how many times as long its path is in the order of times as in that of image names,
/// from which times are in disorder.
const PATH: (usize, f64) = (10, 3.0);
/// Gaps between times may differ by this factor before the clock is called uneven.
const UNEVEN: f64 = 1.5;
/// Share of a frame's duration below which two times count as one: cameras that run together differ by that much once
/// their time offsets are measured.
const SAME_TIME: f64 = 0.05;
/// Angle and relative distance below which two cameras add little to each other.
const CLOSE_DEGREES: f64 = 0.5;

/// Between these angles to the nearest training camera new views end to hold, degrees: half the gap between
/// neighbouring cameras, whose middle is seen from both sides, but nowhere less than what any two images share, and
/// nowhere more than what was seen to hold (docs/priors.md).
const REACH_DEGREES: [f64; 2] = [5.0, 15.0];
/// Of the nearest and of the farthest training camera's distance: nearer than half of it a pixel shows what no image
/// did.
const REACH_DISTANCE: [f64; 2] = [0.5, 2.0];
/// Training views that determine the reach, at most, evenly chosen.
const REACH_VIEWS: usize = 200;

/// Range around the training cameras in which new views are reliable: a rule, not a measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reach {
    /// The common target of the cameras.
    pub center: [f64; 3],
    /// The angle there to the nearest training camera, degrees.
    pub degrees: f64,
    /// Distances from there, scene units.
    pub distances: [f64; 2],
    /// Cameras with held-out frames, and those of them that have one beyond the reach.
    pub held: [usize; 2],
}

impl Capture {
    /// Range around the training cameras in which new views are reliable; `None`: there is only one camera.
    pub fn reach(&self) -> Option<Reach> {
        let all = self.training_views();
        let views: Vec<&Frame> = all.iter().step_by(all.len().div_ceil(REACH_VIEWS).max(1)).copied().collect();
        if views.len() < 2 {
            return None;
        }
        let center = look_at(&views);
        let ray = |f: &Frame| normalize(sub(f.view.center(), center));
        let rays: Vec<[f64; 3]> = views.iter().map(|f| ray(f)).collect();
        let angle = |a: [f64; 3], b: [f64; 3]| dot(a, b).clamp(-1.0, 1.0).acos().to_degrees();
        let nearest = |from: [f64; 3], but: Option<usize>| {
            let others = rays.iter().enumerate().filter(|(j, _)| Some(*j) != but);
            others.map(|(_, r)| angle(from, *r)).fold(f64::INFINITY, f64::min)
        };
        let mut gaps: Vec<f64> = rays.iter().enumerate().map(|(i, r)| nearest(*r, Some(i))).collect();
        let middle = gaps.len() / 2;
        let gap = *gaps.select_nth_unstable_by(middle, f64::total_cmp).1;
        let degrees = (0.5 * gap).clamp(REACH_DEGREES[0], REACH_DEGREES[1]);
        let far = |f: &Frame| norm(sub(f.view.center(), center));
        let range = views.iter().map(|f| far(f)).fold([f64::INFINITY, 0.0], |[l, h], d| [d.min(l), d.max(h)]);
        let distances = [REACH_DISTANCE[0] * range[0], REACH_DISTANCE[1] * range[1]];
        let mut held = vec![[false; 2]; self.cameras.len()];
        for frame in self.held.iter().map(|&i| &self.frames[i]) {
            let beyond = nearest(ray(frame), None) > degrees || !(distances[0]..=distances[1]).contains(&far(frame));
            held[frame.camera] = [true, held[frame.camera][1] || beyond];
        }
        let held = [0, 1].map(|k| held.iter().filter(|h| h[k]).count());
        Some(Reach { center, degrees, distances, held })
    }

    /// Checks for common causes of bad results. Cheap: opens a few depth maps, and no image.
    pub fn preflight(&self) -> Vec<Finding> {
        let mut findings = Vec::new();
        let aspect = |text: &String| self.account.iter().find(|r| r.what == *text).map(|r| r.aspect);
        for warning in &self.warnings {
            let remedy = match aspect(warning) {
                // The remark states what to do.
                Some(_) => "",
                None => "See docs/capture-format.md for the layout.",
            };
            let found = finding(Severity::Warning, warning.clone(), remedy);
            findings.push(Finding { aspect: aspect(warning), ..found });
        }
        for note in &self.notes {
            let found = finding(Severity::Note, note.clone(), "");
            findings.push(Finding { aspect: Some(aspect(note).unwrap_or(Aspect::Assumed)), ..found });
        }
        let views = self.training_views();
        self.check_views(&views, &mut findings);
        self.check_clock(&mut findings);
        self.check_completeness(&mut findings);
        findings.extend(self.check_points());
        if self.points.is_none() {
            findings.push(finding(
                Severity::Note,
                "The capture has no initial points: training finds points in its images.".into(),
                "A sparse cloud (COLMAP, or any coloured .ply) gives a better start.",
            ));
        }
        if self.held.is_empty() {
            findings.push(finding(
                Severity::Note,
                "No frame is held out: quality on new views cannot be measured.".into(),
                "Hold out a camera (camera=0) or every 8th image (every=8).",
            ));
        }
        findings
    }

    /// One frame per fixed training camera; all training frames of moving ones.
    fn training_views(&self) -> Vec<&Frame> {
        let mut seen = vec![false; self.cameras.len()];
        let frames = self.train.iter().map(|&i| &self.frames[i]);
        frames.filter(|f| !(self.cameras[f.camera].fixed && std::mem::replace(&mut seen[f.camera], true))).collect()
    }

    fn check_views(&self, views: &[&Frame], findings: &mut Vec<Finding>) {
        if !self.fixed_cameras() {
            return;
        }
        if views.len() < FEW_CAMERAS {
            findings.push(finding(
                Severity::Warning,
                match views.len() {
                    1 => "Only 1 camera sees the scene: extrapolated views are unreliable.".into(),
                    n => format!("Only {n} cameras see the scene: extrapolated views are unreliable."),
                },
                "Judge the result near the recorded views, or add cameras (six or more all round the scene).",
            ));
        }
        let target = look_at(views);
        let rays: Vec<[f64; 3]> = views.iter().map(|f| normalize(sub(f.view.center(), target))).collect();
        let mut widest: f64 = 0.0;
        let mut closest: Option<(f64, usize, usize)> = None;
        for (i, a) in rays.iter().enumerate() {
            for (j, b) in rays.iter().enumerate().skip(i + 1) {
                let angle = dot(*a, *b).clamp(-1.0, 1.0).acos().to_degrees();
                widest = widest.max(angle);
                if closest.is_none_or(|c| angle < c.0) {
                    closest = Some((angle, i, j));
                }
            }
        }
        if widest < NARROW_DEGREES && views.len() > 1 {
            findings.push(finding(
                Severity::Warning,
                format!("The cameras cover only {widest:.0}° around the scene: depth is poorly determined."),
                "Spread the cameras, or expect good quality only between them.",
            ));
        }
        if let Some((angle, i, j)) = closest.filter(|c| c.0 < CLOSE_DEGREES) {
            let name = |i: usize| &self.cameras[views[i].camera].name;
            findings.push(finding(
                Severity::Note,
                format!("Cameras {} and {} see the scene from directions only {angle:.2}° apart.", name(i), name(j)),
                "Check that their poses are not copies of one another.",
            ));
        }
    }

    fn check_clock(&self, findings: &mut Vec<Finding>) {
        let mut times = self.times();
        if let Some(first) = times.first().filter(|first| first.abs() > FAR_CLOCK) {
            let what = format!("The first image is at {first} s: f32 lifespans resolve milliseconds no more there.");
            findings.push(finding(Severity::Warning, what, "Give times from the start of the clip."));
        }
        self.check_ranges(findings);
        self.check_paths(findings);
        times.dedup_by(|later, earlier| *later - *earlier < SAME_TIME / self.fps);
        let gaps: Vec<f64> = times.windows(2).map(|w| w[1] - w[0]).collect();
        let (low, high) = gaps.iter().fold((f64::INFINITY, 0.0f64), |(l, h), &g| (l.min(g), h.max(g)));
        if !self.fixed_cameras() || gaps.len() < 2 || high <= UNEVEN * low {
            return;
        }
        findings.push(finding(
            Severity::Note,
            format!("The times are unevenly spaced: gaps from {low:.4} s to {high:.4} s."),
            "Check frame numbers and time offsets; missing frames and unsynchronised cameras blur fast motion.",
        ));
    }

    /// Moving cameras that jump to and fro in the order of their times, and not in that of their image names.
    fn check_paths(&self, findings: &mut Vec<Finding>) {
        for (c, camera) in self.cameras.iter().enumerate().filter(|(_, camera)| !camera.fixed) {
            let mut frames: Vec<&Frame> = self.frames.iter().filter(|f| f.camera == c).collect();
            let length = |frames: &[&Frame]| -> f64 {
                frames.windows(2).map(|w| norm(sub(w[0].source.center(), w[1].source.center()))).sum()
            };
            frames.sort_by(|a, b| a.time.0.total_cmp(&b.time.0).then(a.image.cmp(&b.image)));
            let by_time = length(&frames);
            let times = frames.windows(2).filter(|w| w[0].time != w[1].time).count() + 1;
            frames.sort_by(|a, b| a.image.cmp(&b.image));
            let by_name = length(&frames);
            if times >= PATH.0 && by_name > 0.0 && by_time >= PATH.1 * by_name {
                findings.push(finding(
                    Severity::Warning,
                    format!(
                        "The times of camera {} are probably in disorder: in their order its path is {:.0} times as long as in \
                         that of image names.",
                        camera.name,
                        by_time / by_name
                    ),
                    "Check which time belongs to which image.",
                ));
            }
        }
    }

    /// Fixed cameras whose images are all before or after those of most others.
    fn check_ranges(&self, findings: &mut Vec<Finding>) {
        let mut ranges = vec![[f64::INFINITY, f64::NEG_INFINITY]; self.cameras.len()];
        for frame in &self.frames {
            let range = &mut ranges[frame.camera];
            *range = [range[0].min(frame.time.0), range[1].max(frame.time.0)];
        }
        let films: Vec<usize> =
            (0..ranges.len()).filter(|&c| self.cameras[c].fixed && ranges[c][0] < ranges[c][1]).collect();
        let apart = |&&c: &&usize| {
            let others = films.iter().filter(|&&o| ranges[o][0] > ranges[c][1] || ranges[o][1] < ranges[c][0]);
            2 * others.count() > films.len()
        };
        let late: Vec<&str> = films.iter().filter(apart).map(|&c| self.cameras[c].name.as_str()).collect();
        if films.len() > 2 && !late.is_empty() {
            findings.push(finding(
                Severity::Warning,
                format!("Cameras recorded at other times than most others: {}.", first_names(&late)),
                "Check their clocks: they have no time in common with the other cameras.",
            ));
        }
    }

    fn check_completeness(&self, findings: &mut Vec<Finding>) {
        let mut counts = vec![0usize; self.cameras.len()];
        self.frames.iter().for_each(|f| counts[f.camera] += 1);
        let most = counts.iter().copied().max().unwrap_or(0);
        let short: Vec<String> = (0..counts.len())
            .filter(|&c| counts[c] < most)
            .map(|c| format!("{} ({})", self.cameras[c].name, counts[c]))
            .collect();
        if !short.is_empty() {
            findings.push(finding(
                Severity::Note,
                format!("Some cameras have fewer than {most} frames: {}.", short.join(", ")),
                "Check that no frames were lost when they were extracted.",
            ));
        }
    }
}

fn finding(severity: Severity, what: String, remedy: &str) -> Finding {
    Finding { severity, aspect: None, what, remedy: remedy.into() }
}

/// The point nearest to all optical axes (least squares); the cameras' centroid moved ahead if they are parallel.
fn look_at(views: &[&Frame]) -> [f64; 3] {
    let mut center = [0.0; 3];
    for c in views.iter().map(|frame| frame.view.center()) {
        (0..3).for_each(|i| center[i] += c[i] / views.len() as f64);
    }
    nearest_to_lines(views.iter().map(|f| (f.view.center(), f.view.forward()))).unwrap_or_else(|| {
        let ahead = views.first().map_or([0.0, 0.0, 1.0], |f| f.view.forward());
        let reach = views.iter().map(|f| norm(sub(f.view.center(), center))).fold(1.0, f64::max);
        std::array::from_fn(|k| center[k] + 3.0 * reach * ahead[k])
    })
}
