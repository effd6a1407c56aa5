//! Results and their accuracy.

use super::poses::SolvedCamera;
use super::spacing::Gap;
use crate::Result;
use crate::sync::graph::Offset;
use crate::write::Pictures;
use serde::Serialize;
use splat4d_train::run::checkpoint::write_atomically;
use std::path::{Path, PathBuf};

/// The file in the capture's folder.
const FILE: &str = "import/report.json";

/// Result of an import.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Report {
    /// The capture's file.
    #[serde(serialize_with = "splat4d_train::path_text::lossy")]
    pub capture: PathBuf,
    /// A row for each camera.
    pub cameras: Vec<CameraReport>,
    /// Neighbouring cameras and the angles between them; empty for cameras that move.
    pub gaps: Vec<Gap>,
    /// Points that cameras agree on.
    pub points: usize,
    /// Assumptions, a sentence each.
    pub guesses: Vec<String>,
    /// Pairs of cameras whose lag was measured and contradicts the rest.
    pub refused: Vec<String>,
    /// Pairs of cameras for which motion determines no lag, and why.
    pub motion: Vec<String>,
    /// Nothing moves in cameras whose clocks are unknown: they do not matter.
    pub still: bool,
}

/// Result for a camera.
#[derive(Clone, Debug, Serialize)]
pub struct CameraReport {
    /// Its name.
    pub name: String,
    /// Stored frames.
    pub frames: usize,
    /// Pixels across and down.
    pub size: [usize; 2],
    /// Frames per second.
    pub rate: f64,
    /// Missing and doubled frames.
    pub lost: [usize; 2],
    /// Seconds that are added to its clock; none: its file's clock was taken.
    pub offset: Option<f64>,
    /// Their standard deviation.
    pub sigma: Option<f64>,
    /// Source of the offset.
    pub by: Vec<&'static str>,
    /// Why it could not be placed.
    pub trouble: Option<String>,
    /// Points that it sees consistently.
    pub sightings: usize,
    /// Median distance of points from where they are seen, pixels.
    pub error: Option<f64>,
    /// Focal length, pixels.
    pub focal: Option<f64>,
    /// Distance of its content from the position by the calibration, pixels; none: no calibration, or too few matches.
    pub calibration: Option<f64>,
    /// Remarks about its file.
    pub warnings: Vec<String>,
}

impl CameraReport {
    pub(super) fn of(pictures: &Pictures, placed: &Result<SolvedCamera, String>, offset: Option<&Offset>) -> Self {
        let stand = placed.as_ref().ok();
        Self {
            name: pictures.name.clone(),
            frames: pictures.shots.len(),
            size: pictures.size,
            rate: pictures.clock.rate(),
            lost: [pictures.clock.missing(), pictures.clock.doubled.len()],
            offset: offset.map(|o| o.seconds),
            sigma: offset.map(|o| o.sigma),
            by: offset.map_or_else(Vec::new, |o| o.kinds.iter().map(|k| k.name()).collect()),
            trouble: placed.as_ref().err().cloned(),
            sightings: stand.map_or(0, |s| s.sightings),
            error: stand.filter(|s| s.sightings > 0).map(|s| s.error),
            focal: stand.map(|s| s.intrinsics.fx),
            calibration: None,
            warnings: pictures.warnings.clone(),
        }
    }
}

impl Report {
    pub(super) fn write(&self, folder: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self).expect("a report is plain data");
        write_atomically(&folder.join(FILE), format!("{text}\n").as_bytes())
    }
}
