//! The checks. Thresholds are of the project's own study of captures ("Doctor": what is seen in results) where no other
//! source is named: the first of two is a warning, the second is bad. Those of flicker, dark and clipped images are
//! chosen by eye.

use super::finding::{FindingList, grade};
use super::look::CameraObservations;
use super::{CameraReport, Finding, Grade, Options, Report, alone, between, clocks, volume};
use splat4d::scene::Camera;
use splat4d_train::capture::Capture;
use splat4d_train::event::Progress;
use splat4d_train::vision::triangulate::angle_at;

/// Angle to the nearest other camera, degrees.
const ANGLE: [f64; 2] = [25.0, 45.0];
/// Fewer cameras than the first are limited, than the second poor.
const CAMERAS: [usize; 2] = [6, 4];
/// Part of the space in which something moves that three cameras see; less than the first is a warning, than the second
/// bad.
const VOLUME: [f64; 2] = [0.8, 0.5];
/// Part of the memory that training takes: the system and other programs need theirs, and what does not fit is swapped.
const MEMORY: [f64; 2] = [0.8, 1.0];
/// Cameras with one fault become one finding from this part of all on.
const MOST: f64 = 0.5;

/// Makes all checks and adds what they find.
pub(super) fn all(
    capture: &Capture,
    seen: &[CameraObservations],
    options: &Options,
    report: &mut Report,
    progress: &mut Progress<'_>,
) {
    report.cameras = (capture.cameras.iter().zip(seen))
        .map(|(c, s)| CameraReport {
            name: c.name.clone(),
            fixed: c.fixed,
            picture: s.viewpoints.first().map(|s| s.picture.clone()).unwrap_or_default(),
            ..CameraReport::default()
        })
        .collect();
    between::between(capture, seen, options, report, progress);
    clocks::clocks(capture, seen, report, progress);
    for (camera, s) in seen.iter().enumerate() {
        alone::alone(capture, camera, s, report);
    }
    take(capture, seen, report);
    // Leaving out loses a view: only for faults that training cannot correct, and only if enough are left.
    let gross = |f: &&Finding| f.grade == Grade::Bad && ["epipolar", "moved", "sharpness", "focus"].contains(&f.check);
    let mut out: Vec<String> = report.findings.iter().filter(gross).filter_map(|f| f.camera.clone()).collect();
    out.sort();
    out.dedup();
    gather(report, capture.cameras.len());
    if capture.cameras.len() > 1 && 2 * out.len() < capture.cameras.len() {
        report.leave_out = out;
    }
}

/// Makes one finding of the same fault of most cameras: the worst one's, which states how many there are.
fn gather(report: &mut Report, cameras: usize) {
    let mut out: Vec<Finding> = Vec::new();
    for f in std::mem::take(&mut report.findings) {
        let alike = |g: &&mut Finding| g.check == f.check && g.camera.is_some() && f.camera.is_some();
        let Some(kept) = out.iter_mut().find(alike) else {
            out.push(f);
            continue;
        };
        // Held together behind the first; split again below where they are few.
        kept.alike.push(f);
    }
    for mut first in out {
        let all = first.alike.len() + 1;
        if all < 3 || (all as f64) < MOST * cameras as f64 {
            let rest = std::mem::take(&mut first.alike);
            report.findings.push(first);
            report.findings.extend(rest);
            continue;
        }
        let mut rest = std::mem::take(&mut first.alike);
        rest.push(first);
        let size = |f: &Finding| (f.grade, f.amount.map_or(0.0, f64::abs));
        rest.sort_by(|a, b| size(a).partial_cmp(&size(b)).unwrap_or(std::cmp::Ordering::Equal));
        let mut worst = rest.pop().expect("there are at least three");
        worst.what = format!("{all} of {cameras} cameras ({}), for instance: {}", worst.check, worst.what);
        worst.alike = rest;
        report.findings.push(worst);
    }
}

/// Findings of the whole rig.
fn take(capture: &Capture, seen: &[CameraObservations], report: &mut Report) {
    let fixed: Vec<usize> =
        (0..seen.len()).filter(|&c| capture.cameras[c].fixed && !seen[c].viewpoints.is_empty()).collect();
    if fixed.len() < seen.len() {
        report.left.push(
            "Moving cameras: movement, flicker, frames and time offset are checked for fixed cameras only.".into(),
        );
        return;
    }
    if fixed.len() < CAMERAS[0] {
        let g = if fixed.len() < CAMERAS[1] { Grade::Bad } else { Grade::Warning };
        let word = if g == Grade::Bad { "poor" } else { "limited" };
        let what = format!("{} cameras: what can be learnt is {word}.", fixed.len());
        FindingList { report }.add(
            (g, "cameras"),
            None,
            (fixed.len() as f64, "cameras"),
            what,
            ("Good quality only near the cameras.", "Six and more, all round the scene."),
        );
    }
    if fixed.len() < 2 {
        return;
    }
    let views: Vec<&Camera> = fixed.iter().map(|&c| &seen[c].viewpoints[0].view).collect();
    let Some(target) = volume::target(&views) else {
        report.left.push(
            "Angles between cameras and what three of them see were not judged: the cameras have no common view."
                .into(),
        );
        return;
    };
    for (k, view) in views.iter().enumerate() {
        let others = views.iter().enumerate().filter(|(j, _)| *j != k);
        let nearest =
            others.map(|(_, o)| angle_at(target, view.center(), o.center()).to_degrees()).fold(f64::MAX, f64::min);
        if let Some(g) = grade(nearest, ANGLE) {
            let name = &capture.cameras[fixed[k]].name;
            let what = format!("Camera {name} is {nearest:.0}° from its nearest neighbour.");
            FindingList { report }.add(
                (g.min(Grade::Warning), "angle"),
                Some(name),
                (nearest, "°"),
                what,
                ("Floaters and wrong shape between them.", "A camera in the gap."),
            );
        }
    }
    if fixed.iter().all(|&c| seen[c].row < 2) {
        return;
    }
    let own: Vec<&CameraObservations> = fixed.iter().map(|&c| &seen[c]).collect();
    volume_of(&own, target, report);
}

/// Share of dynamic regions around a point that three cameras see.
pub(super) fn volume_of(seen: &[&CameraObservations], target: [f64; 3], report: &mut Report) {
    report.seen_by_three = volume::seen_by_three(seen, target);
    let Some(share) = report.seen_by_three else {
        report.left.push(
            "Coverage of the dynamic region by three cameras was not judged: two cameras see too little motion.".into(),
        );
        return;
    };
    if let Some(g) = grade(1.0 / share.max(f64::MIN_POSITIVE), VOLUME.map(|v| 1.0 / v)) {
        let what = format!("Three cameras see {:.0} % of the space in which something moves.", 100.0 * share);
        let words =
            ("Moving objects dissolve between the views.", "Turn the cameras to the action, or film with more.");
        FindingList { report }.add((g, "volume"), None, (100.0 * share, "%"), what, words);
    }
}

/// Whether training with all defaults fits into the memory there is.
pub(super) fn memory(needed: u64, there: Option<u64>, report: &mut Report) {
    let Some(there) = there else {
        report
            .left
            .push("Whether training fits into memory was not judged: the system does not report its memory.".into());
        return;
    };
    if let Some(g) = grade(needed as f64 / there.max(1) as f64, MEMORY) {
        let mega = |bytes: u64| bytes.div_ceil(1 << 20);
        let what = format!("Training takes about {} MB of memory, and there are {}.", mega(needed), mega(there));
        FindingList { report }.add(
            (g, "memory"),
            None,
            (mega(needed) as f64, "MB"),
            what,
            (
                "Training that is slow, or ends without a message.",
                "Train with --downscale 2, with fewer Gaussians (--set densify.max_cap), or a long take in chunks (--memory-limit).",
            ),
        );
    }
}
