//! Masks of other images: the outline of a mask is on edges of its own image. Where another image's mask fits better, and that
//! image's own mask does not, masks are exchanged.

use super::super::account::{Severity, first_names};
use super::super::preflight::Finding;
use super::super::{Aspect, Capture};
use super::look::{SHOWN, Shown, SmallImage};

/// Pixels of an outline, at least, that shows where a mask belongs.
const OUTLINE: usize = 60;
/// How many times as strong edges are along another image's mask as along the own one at least, and as in the whole image.
const BETTER: f64 = 1.3;
const STRONG: f64 = 1.5;
/// Images with masks of others, at least.
const SEVERAL: usize = 2;

/// Pixels on the outline of what a mask shows, away from the border of the image.
fn outline(shown: &Shown, width: usize) -> Vec<usize> {
    let height = shown.weights.len() / width.max(1);
    let white = |p: usize| shown.weights[p] >= SHOWN;
    let mut out = Vec::new();
    for y in 2..height.saturating_sub(2) {
        for x in 2..width.saturating_sub(2) {
            let p = y * width + x;
            if white(p) && [p - 1, p + 1, p - width, p + width].iter().any(|&q| !white(q)) {
                out.push(p);
            }
        }
    }
    out
}

/// Strength of the edges of an image along each outline, of that in the whole image: 1 by chance.
struct Edges {
    strongest: Vec<f32>,
    mean: f64,
}

impl Edges {
    fn new(look: &SmallImage) -> Self {
        let (width, height) = look.size();
        let edges = look.edges();
        let mut strongest = vec![0.0f32; width * height];
        // Outlines are right to a pixel.
        for y in 1..height.saturating_sub(1) {
            for x in 1..width.saturating_sub(1) {
                let rows = (y - 1..=y + 1).map(|v| &edges[v * width + x - 1..=v * width + x + 1]);
                strongest[y * width + x] = rows.flatten().copied().fold(0.0, f32::max);
            }
        }
        let sum: f64 = strongest.iter().map(|v| f64::from(*v)).sum();
        let mean = sum / (width * height).max(1) as f64;
        Self { strongest, mean }
    }

    fn along(&self, outline: &[usize]) -> f64 {
        let sum: f64 = outline.iter().map(|&p| f64::from(self.strongest[p])).sum();
        sum / outline.len().max(1) as f64 / self.mean.max(f64::MIN_POSITIVE)
    }
}

/// A warning where masks belong to other images.
pub(super) fn check(capture: &Capture, images: &[SmallImage]) -> Option<Finding> {
    let masked: Vec<(&SmallImage, &Shown)> =
        images.iter().filter_map(|l| Some((l, l.shown.as_ref().filter(|s| s.of_mask)?))).collect();
    let size = masked.first()?.0.size();
    let masked: Vec<(&SmallImage, &Shown)> = masked.into_iter().filter(|(l, _)| l.size() == size).collect();
    let outlines: Vec<Vec<usize>> = masked.iter().map(|(_, shown)| outline(shown, size.0)).collect();
    let edges: Vec<Edges> = masked.iter().map(|(look, _)| Edges::new(look)).collect();
    let fit = |image: usize, mask: usize| edges[image].along(&outlines[mask]);
    let long: Vec<usize> = (0..masked.len()).filter(|&k| outlines[k].len() >= OUTLINE).collect();
    let mut foreign = Vec::new();
    for &image in &long {
        let own = fit(image, image);
        let others = long.iter().copied().filter(|&mask| mask != image).map(|mask| (fit(image, mask), mask));
        let Some((best, mask)) = others.max_by(|a, b| a.0.total_cmp(&b.0)) else { continue };
        // The mask that fits must not be right where it is.
        if best >= STRONG && best >= BETTER * own && best >= BETTER * fit(mask, mask) {
            foreign.push((image, mask, [best, own]));
        }
    }
    let mut claimed: Vec<usize> = foreign.iter().map(|(_, mask, _)| *mask).collect();
    claimed.sort_unstable();
    claimed.dedup();
    if claimed.len() < SEVERAL {
        return None;
    }
    let frame = |k: usize| &capture.frames[masked[k].0.frame];
    let names: Vec<String> = foreign.iter().map(|(image, ..)| frame(*image).image.display().to_string()).collect();
    let (_, mask, [best, own]) = foreign[0];
    let mask = frame(mask).mask.as_ref().map_or_else(String::new, |m| m.display().to_string());
    Some(Finding {
        severity: Severity::Warning,
        aspect: Some(Aspect::Assumed),
        what: format!(
            "Masks of {} of {} images that were looked at probably belong to other images: {}. Edges of the first are {best:.1} times as \
             strong as elsewhere along the outline of {mask}, and {own:.1} times along that of its own mask.",
            names.len(),
            long.len(),
            first_names(&names)
        ),
        remedy: "Check which mask belongs to which image and camera.".into(),
    })
}
