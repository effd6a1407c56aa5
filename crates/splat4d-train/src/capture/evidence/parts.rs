//! Parts of large captures: images of another lens, and a run far from the images that are examined first. A capture that was
//! joined of two, or whose later images have other poses or focal lengths, agrees with its images at the beginning.

use super::super::account::Severity;
use super::super::preflight::Finding;
use super::super::{Capture, Frame};
use super::look;
use super::{STRIDE, focal, pairs};
use splat4d::math::Se3;
use splat4d::scene::Lens;
use std::collections::BTreeMap;

/// Parts that are examined; one where images are large.
const PARTS: usize = 2;
/// Pixels of an image from which it is large: each that is decoded takes a twentieth of a second and more.
const LARGE: usize = 2_000_000;
/// Images of a part: three pairs of neighbours.
const IMAGES: usize = 3;
/// Focal lengths that differ by less than this factor belong to one lens: zoom and focus change them less.
const ONE_LENS: f64 = 1.25;

/// A part.
struct Part {
    /// The frames that are examined.
    frames: Vec<usize>,
    /// Images of its lens, where it is one of several.
    of_lens: Option<usize>,
}

/// What distinguishes lenses: the model, and steps of the focal length over the width.
type Kind = (u8, i32);

fn kind(frame: &Frame) -> Kind {
    let camera = &frame.source;
    let model = match camera.lens {
        Lens::Pinhole => 0,
        Lens::Brown { .. } => 1,
        _ => 2,
    };
    (model, ((camera.intrinsics.fx / camera.width.max(1) as f64).ln() / ONE_LENS.ln()).round() as i32)
}

/// The parts of a capture whose places are `order`; `seen` are the frames that were examined first.
fn parts(capture: &Capture, order: &[usize], seen: &[usize]) -> Vec<Part> {
    let of = |i: usize| &capture.frames[i];
    let mut kinds: BTreeMap<Kind, Vec<usize>> = BTreeMap::new();
    order.iter().for_each(|&i| kinds.entry(kind(of(i))).or_default().push(i));
    kinds.retain(|kind_of, frames| {
        let known = seen.iter().filter(|&&i| kind(of(i)) == *kind_of).count();
        known < IMAGES && frames.len() >= IMAGES
    });
    let mut others: Vec<Vec<usize>> = kinds.into_values().collect();
    others.sort_by_key(|frames| std::cmp::Reverse(frames.len()));
    // Frames of a film in a row are nearly the same.
    let stride = if capture.fixed_cameras() { 1 } else { order.len().div_ceil(STRIDE) };
    let run = |frames: &[usize], start: usize| -> Vec<usize> {
        frames[start..].iter().step_by(stride).take(IMAGES).copied().collect()
    };
    let lenses = others.iter().map(|frames| {
        let start = (frames.len() / 2).saturating_sub(IMAGES * stride / 2);
        Part { frames: run(frames, start), of_lens: Some(frames.len()) }
    });
    let last = Part { frames: run(order, order.len().saturating_sub(IMAGES * stride)), of_lens: None };
    let size = capture.frames.first().map_or(0, |f| f.source.width * f.source.height);
    let most = if size >= LARGE { 1 } else { PARTS };
    lenses.chain([last]).filter(|p| p.frames.iter().all(|i| !seen.contains(i))).take(most).collect()
}

/// Warnings about parts that do not fit, where the images that were examined first do.
pub(super) fn check(capture: &Capture, order: &[usize], seen: &[usize]) -> Vec<Finding> {
    parts(capture, order, seen).iter().filter_map(|part| part.check(capture)).collect()
}

impl Part {
    fn check(&self, capture: &Capture) -> Option<Finding> {
        let mut images = look::take(capture, &self.frames, look::COARSE);
        if images.len() < 2 {
            return None;
        }
        let mut matches = None;
        let verdict = capture.judge(&self.frames, &mut images, &mut matches);
        if verdict.misread {
            let remedy = "Correct the poses of that part, or read it as a capture of its own.";
            return Some(self.located(capture, Finding { remedy: remedy.into(), ..verdict.finding }));
        }
        let poses: Vec<Se3> = images.iter().map(|l| capture.frames[l.frame].source.cam_from_world).collect();
        // Wrong focal lengths make points miss their colours too: they say more.
        let focal = focal::check(capture, matches.as_deref(), &images, &poses).filter(|f| f.severity > Severity::Note);
        let doubt = Some(verdict.finding).filter(|f| f.severity > Severity::Note);
        let found = focal.or(doubt).or_else(|| pairs::contradiction(&matches?, &images, &poses))?;
        Some(self.located(capture, found))
    }

    /// The finding with the images that it was found in.
    fn located(&self, capture: &Capture, finding: Finding) -> Finding {
        let name = |i: &usize| capture.frames[*i].image.display().to_string();
        let (first, last) = (self.frames.first().map(name), self.frames.last().map(name));
        let between = format!("{} to {}", first.unwrap_or_default(), last.unwrap_or_default());
        let part = match self.of_lens {
            Some(count) => format!(
                "{count} images with another lens or focal length than the first ones ({between} were examined)"
            ),
            None => format!("a part of the images ({between} were examined)"),
        };
        Finding { what: format!("{} This concerns {part}; the first images fit.", finding.what), ..finding }
    }
}
