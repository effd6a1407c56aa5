//! Findings from a camera's own images.

use super::finding::{FindingList, GAMMA, SHARPNESS, grade, unit, worse};
use super::look::CameraObservations;
use super::{Grade, Report};
use crate::sync::median;
use splat4d_train::capture::Capture;

/// Motion of the static background that is reported, pixels of 1920, and at least this many own ones.
pub(super) const MOVED: [f64; 2] = [0.5, 2.0];
pub(super) const MOVED_PIXELS: [f64; 2] = [0.35, 1.0];
/// Brightness that jumps from image to image, stops.
const FLICKER: [f64; 2] = [0.05, 0.15];
/// Missing and doubled frames, of all.
const FRAMES: [f64; 2] = [0.01, 0.05];
/// Part of the pixels that is clipped black or white: backgrounds of data sets are, so that only most of an image
/// reports it.
const CLIPPED: f64 = 0.6;
/// Mean below which an image is too dark, of 255.
const DARK: f64 = 20.0;
/// How much larger steps across blocks are, of 255. Images of two recordings without visible blocks have 0.9 to 1.4.
const BLOCKS: [f64; 2] = [2.5, 5.0];

/// Findings from a camera's own images.
pub(super) fn alone(capture: &Capture, camera: usize, s: &CameraObservations, report: &mut Report) {
    let name = capture.cameras[camera].name.clone();
    let who = Some(name.as_str());
    if let (Some(moved), Some(viewpoint)) = (s.moved, s.viewpoints.first()) {
        let far = moved * unit(&viewpoint.view);
        report.cameras[camera].moved = Some(far);
        let limits = worse(MOVED, MOVED_PIXELS.map(|p| p * unit(&viewpoint.view)));
        if let Some(g) = grade(far, limits) {
            let what =
                format!("Camera {name} moved: the background moved by {far:.1} px (of 1920) from first to last.");
            let words = (
                "Everything it shows is doubled.",
                "Fasten it; cut the recording where it was pushed, or leave it out.",
            );
            FindingList { report }.add((g, "moved"), who, (far, "px"), what, words);
        }
    }
    if let Some(ratio) = s.focus {
        report.cameras[camera].focus = Some(ratio);
        if let Some(g) = grade(ratio.max(1.0 / ratio.max(f64::MIN_POSITIVE)), SHARPNESS.map(|s| 1.0 / s)) {
            let what = format!(
                "Camera {name} changes its focus: from first to last its images get {ratio:.2} times as sharp."
            );
            let words = (
                "Blurred texture in one part of the clip, as if the lens had changed.",
                "Lock focus; cut the recording where it changed, or leave the camera out.",
            );
            FindingList { report }.add((g, "focus"), who, (ratio, "times"), what, words);
        }
    }
    let mut told = FindingList { report };
    let frames = capture.frames.iter().filter(|f| f.camera == camera).count();
    if frames >= 4 && capture.cameras[camera].fixed {
        let missing = s.clock.missing();
        if let Some(g) = grade(missing as f64 / (frames + missing) as f64, FRAMES) {
            let what = format!("Camera {name}: {missing} frames are missing between others.");
            told.add(
                (g, "dropped"),
                who,
                (missing as f64, "frames"),
                what,
                ("Jerks in the motion.", "Record to a faster card, or extract without a rate."),
            );
        }
        let doubled = s.clock.doubled.len();
        if let Some(g) = grade(doubled as f64 / s.row.max(1) as f64, FRAMES) {
            let what = format!("Camera {name}: {doubled} of {} images repeat the previous one.", s.row);
            told.add(
                (g, "doubled"),
                who,
                (doubled as f64, "frames"),
                what,
                ("Motion stops and jumps.", "Remove them; extract frames without changing the rate."),
            );
        }
    }
    let jumps = |w: &[f64]| (GAMMA * (w[1] / (0.5 * (w[0] + w[2])).max(1.0)).max(1e-6).log2()).abs();
    let mut steps: Vec<f64> = s.means.windows(3).map(jumps).collect();
    if steps.len() >= 4 && capture.cameras[camera].fixed {
        let flicker = median(&mut steps);
        if let Some(g) = grade(flicker, FLICKER) {
            let what = format!("Camera {name} flickers: brightness jumps by {flicker:.2} stops from frame to frame.");
            told.add(
                (g, "flicker"),
                who,
                (flicker, "stops"),
                what,
                ("A scene that flickers too.", "Lock exposure; choose a shutter that fits the lamps (1/50 or 1/60 s)."),
            );
        }
    }
    if s.detail.len() >= 5 && capture.cameras[camera].fixed {
        let usual = median(&mut s.detail.clone());
        let soft = s.detail.iter().filter(|d| **d < SHARPNESS[0] * usual).count();
        if soft > 0 {
            let what = format!("Camera {name}: {soft} of {} images are blurred, against its others.", s.detail.len());
            told.add(
                (Grade::Warning, "blurred"),
                who,
                (soft as f64, "frames"),
                what,
                ("Sharpness that varies.", "Shorter exposure, fixed focus; leave these images out."),
            );
        }
    }
    // Reduced images have their blocks at other distances.
    if let Some(g) = grade(s.blocks, BLOCKS).filter(|_| capture.downscale == 1) {
        let what = format!("Camera {name} is compressed hard: its images have edges every 8 pixels.");
        told.add(
            (g, "compression"),
            who,
            (s.blocks, "of 255"),
            what,
            ("Texture of blocks, and noise in what is flat.", "Record with a higher rate of bits."),
        );
    }
    let mean = s.means.iter().sum::<f64>() / s.means.len().max(1) as f64;
    let masked = capture.background.is_some() || capture.frames.iter().any(|f| f.mask.is_some());
    if !masked && !s.means.is_empty() && mean < DARK {
        let what = format!("Camera {name} is very dark: {mean:.0} of 255 on average.");
        told.add(
            (Grade::Warning, "dark"),
            who,
            (mean, "of 255"),
            what,
            ("Noise is learnt for texture.", "More light, or longer exposure."),
        );
    }
    for (part, word) in s.clipped.into_iter().zip(["black", "white"]) {
        if !masked && part > CLIPPED {
            let what = format!("Camera {name}: {:.0} % of its values are {word}, cut off.", 100.0 * part);
            told.add(
                (Grade::Warning, "clipped"),
                who,
                (100.0 * part, "%"),
                what,
                ("Flat patches without shape.", "Change the exposure."),
            );
        }
    }
    if s.sizes.len() > 1 {
        let what = format!("Camera {name} has images of {} sizes.", s.sizes.len());
        told.add(
            (Grade::Note, "sizes"),
            who,
            (s.sizes.len() as f64, "sizes"),
            what,
            ("", "Check that its intrinsics are given for each size."),
        );
    }
}
