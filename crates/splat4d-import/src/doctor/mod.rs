//! Checks a capture before training: problem, camera, size, effect and remedy. Reads images and poses of any layout and
//! writes nothing.
//!
//! Matches between cameras are found without the capture's poses, so that wrong poses cannot hide themselves.

mod alone;
mod between;
mod check;
mod clocks;
mod finding;
mod look;
mod shutter;
#[cfg(test)]
mod tests;
mod vignetting;
mod volume;

use crate::{Error, Result};
use serde::Serialize;
use splat4d::scene::Camera;
use splat4d_train::capture::{Capture, ImageStore, Rgb8, Severity};
use splat4d_train::event::Progress;
use splat4d_train::run::forecast;
use std::sync::Arc;

/// How bad a [`Finding`] is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Grade {
    /// For information.
    Note,
    /// It will probably be seen.
    Warning,
    /// It will spoil the result.
    Bad,
}

/// Something that will show in the result.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// How bad it is.
    pub grade: Grade,
    /// Which check found it: a word that stays the same.
    pub check: &'static str,
    /// The camera; none: the whole recording.
    pub camera: Option<String>,
    /// How much, in `unit`.
    pub amount: Option<f64>,
    /// The unit of `amount`.
    pub unit: &'static str,
    /// The finding, a sentence.
    pub what: String,
    /// Its visible effect, a sentence; empty if it is stated already.
    pub looks: &'static str,
    /// The remedy, a sentence.
    pub remedy: String,
    /// The same of other cameras, where it is a fault of most.
    pub alike: Vec<Finding>,
}

/// Measurements of a camera, and an image of it.
#[derive(Clone, Debug, Default, Serialize)]
pub struct CameraReport {
    /// Its name.
    pub name: String,
    /// Whether it is static.
    pub fixed: bool,
    /// Distance of matches from their epipolar lines, pixels of an image 1920 wide.
    pub epipolar: Option<f64>,
    /// Seconds that its clock is off, and their standard deviation.
    pub offset: Option<[f64; 2]>,
    /// Brightness relative to other cameras, stops: red, green, blue.
    pub exposure: Option<[f64; 3]>,
    /// Sharpness relative to other cameras, at positions that both see.
    pub sharpness: Option<f64>,
    /// Pixels (of 1920) that the background moved between the first and the last images.
    pub moved: Option<f64>,
    /// Detail of the recording's last third relative to its first.
    pub focus: Option<f64>,
    /// Seconds from the first to the last row of an image, and their standard deviation.
    pub shutter: Option<[f64; 2]>,
    /// Share of light that the corners of its images lose, and its standard deviation.
    pub vignetting: Option<[f64; 2]>,
    /// Its image.
    #[serde(skip)]
    pub picture: Rgb8,
}

impl CameraReport {
    /// Limits of one of its numbers, by the name of its field, for images of this camera: beyond the first is a
    /// warning, beyond the second bad. Of sharpness and focus, below.
    pub fn limits(field: &str, view: &Camera) -> Option<[f64; 2]> {
        // Small images resolve less: their own pixels count.
        let or_pixels = |limits, pixels: [f64; 2]| finding::worse(limits, pixels.map(|p| p * finding::unit(view)));
        Some(match field {
            "epipolar" => or_pixels(between::EPIPOLAR, between::OWN_PIXELS),
            "exposure" => finding::EXPOSURE,
            "sharpness" | "focus" => finding::SHARPNESS,
            "moved" => or_pixels(alone::MOVED, alone::MOVED_PIXELS),
            "shutter" => clocks::SHUTTER,
            _ => return None,
        })
    }
}

/// Findings of a pair of cameras.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PairReport {
    /// Their names.
    pub cameras: [String; 2],
    /// Features that both see.
    pub matches: usize,
    /// How far those are from their epipolar lines, pixels of an image 1920 wide.
    pub epipolar: f64,
    /// Stops by which the second is brighter: red, green, blue.
    pub gain: [f64; 3],
    /// How many times as sharp the second is.
    pub sharper: f64,
}

/// Cost of training with all defaults.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Training {
    /// The motion model that suits.
    pub motion: &'static str,
    /// Bytes of memory at most, estimated.
    pub memory: u64,
}

/// The result of [`examine`].
#[derive(Clone, Debug, Default, Serialize)]
pub struct Report {
    /// The capture's name.
    pub capture: String,
    /// Findings, worst first.
    pub findings: Vec<Finding>,
    /// All cameras.
    pub cameras: Vec<CameraReport>,
    /// Pairs of cameras that see the same, the worst poses first.
    pub pairs: Vec<PairReport>,
    /// Part of the space in which something moves that three cameras see.
    pub seen_by_three: Option<f64>,
    /// Cost of training with all defaults.
    pub training: Option<Training>,
    /// Cameras that should be left out.
    pub leave_out: Vec<String>,
    /// Checks that could not be made, and why.
    pub left: Vec<String>,
}

/// Level of detail.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Consecutive images of a camera that are followed.
    pub window: usize,
    /// Features of an image.
    pub features: usize,
    /// Corners of a camera that are followed.
    pub tracks: usize,
    /// Bytes of memory that training may take; none: all that the machine has, where it reports that.
    pub memory: Option<u64>,
}

impl Default for Options {
    fn default() -> Self {
        // 31 cameras of 30 images at 640x360 are to take about a minute.
        Self { window: 30, features: 900, tracks: 50, memory: None }
    }
}

/// Bytes of decoded images that are kept at once: each is examined once or twice, so that more gains nothing.
const STORE: usize = 64 << 20;

/// Bytes of memory that the machine has, or less where it is a container that may take less; none: it does not report
/// it (it is not Linux).
fn machine_memory() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let all = text.lines().find_map(|l| l.strip_prefix("MemTotal:"))?.trim().strip_suffix("kB")?;
    let all = all.trim().parse::<u64>().ok()? << 10;
    let container = std::fs::read_to_string("/sys/fs/cgroup/memory.max").ok().and_then(|t| t.trim().parse().ok());
    Some(container.map_or(all, |c: u64| c.min(all)))
}

/// Checks for all common causes of bad results.
///
/// Errors: a capture without images, images that cannot be read.
pub fn examine(capture: &Capture, options: &Options, progress: &mut Progress<'_>) -> Result<Report> {
    if capture.frames.is_empty() {
        return Err(Error::input("the capture has no images").at(capture.root.display()).remedy("Add some."));
    }
    let store = ImageStore::new(Arc::new(capture.clone()), STORE);
    let mut report = Report { capture: capture.name.clone(), ..Report::default() };
    let poses = capture.check_poses();
    let misread = poses.written_as.is_some();
    let checked = |f: &splat4d_train::capture::Finding| f.severity == Severity::Warning;
    for finding in
        capture.preflight().into_iter().chain(std::iter::once(poses.finding).chain(poses.more).filter(checked))
    {
        let grade = if finding.severity == Severity::Warning { Grade::Warning } else { Grade::Note };
        report.findings.push(Finding {
            grade,
            check: "capture",
            camera: None,
            amount: None,
            unit: "",
            what: finding.what,
            looks: "",
            remedy: finding.remedy,
            alike: Vec::new(),
        });
    }
    let mut seen = Vec::new();
    for camera in 0..capture.cameras.len() {
        progress.phase("examining cameras", camera, capture.cameras.len());
        seen.push(look::camera(capture, &store, camera, options)?);
    }
    check::all(capture, &seen, options, &mut report, progress);
    match forecast(Arc::new(capture.clone()), progress.0) {
        Ok(forecast) => {
            report.training = Some(Training { motion: forecast.motion, memory: forecast.memory });
            check::memory(forecast.memory, options.memory.or_else(machine_memory), &mut report);
        }
        Err(e) => report.left.push(format!("Memory of training could not be estimated: {e}")),
    }
    if misread {
        // Cameras that are read in another convention are not bad ones.
        report.findings.retain(|f| f.check != "epipolar");
        report.leave_out.clear();
    }
    report.findings.sort_by_key(|f| std::cmp::Reverse(f.grade));
    Ok(report)
}
