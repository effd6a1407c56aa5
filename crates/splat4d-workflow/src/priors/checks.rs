//! Whether what networks wrote fits the capture: depth its points, flow its images, all of it itself over time.

use super::Part;
use crate::deadline::unless_stopped;
use crate::events::Listener;
use serde_json::{Value, json};
use splat4d::Result;
use splat4d::math::median;
use splat4d::scene::Planes;
use splat4d_train::capture::{Capture, DepthKind, ImageStore};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Images of a camera that are examined, in pairs of neighbours that are evenly spread.
const LOOKED_AT: usize = 24;
/// Points of the capture that are compared.
const POINTS: usize = 4000;
/// Fewest points or pixels for a figure.
const FEW: usize = 20;
/// Correlation of a map with the points' depths from which on, below zero, it is upside down, and below which it is weak.
const INVERTED: f64 = -0.3;
const WEAK: f64 = 0.5;
/// Metric maps and points differ by this factor or more.
const OTHER_UNIT: f64 = 1.1;
/// Change of a map from frame to frame, of its spread, from which on it flickers.
const FLICKER: f64 = 0.15;
/// Share of flow whose two directions agree, below which it is doubtful.
const AGREES: f64 = 0.3;
/// Overlap of masks of neighbouring frames below which they flicker.
const OVERLAP: f64 = 0.7;
/// Flow shorter than this has no direction, pixels.
const SHORT: f32 = 1.0;

/// Results of a network for a camera.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Row {
    /// The kind.
    pub part: Part,
    /// The camera's name.
    pub camera: String,
    /// Images that have a file of the folder.
    pub images: usize,
    /// Figures by name.
    pub figures: BTreeMap<&'static str, f64>,
    /// What looks wrong, sentences.
    pub warnings: Vec<String>,
}

impl Row {
    pub(super) fn json(&self) -> Value {
        json!({
            "part": self.part.name(), "camera": self.camera, "images": self.images, "figures": self.figures,
            "warnings": self.warnings,
        })
    }
}

/// A table of all rows.
pub(super) fn table(rows: &[Row]) -> String {
    let mut lines = vec![["kind".to_owned(), "camera".into(), "images".into(), "checks".into()]];
    for row in rows {
        let figure = |(name, value): (&&str, &f64)| format!("{name} {}", short(*value));
        let figures: Vec<String> = row.figures.iter().map(figure).collect();
        let checks = if figures.is_empty() { "none possible".into() } else { figures.join(", ") };
        lines.push([row.part.name().into(), row.camera.clone(), row.images.to_string(), checks]);
    }
    let width = |k: usize| lines.iter().map(|l| l[k].chars().count()).max().unwrap_or(0);
    let widths = [width(0), width(1), width(2)];
    let line = |l: &[String; 4]| {
        format!("{:<a$}  {:<b$}  {:>c$}  {}", l[0], l[1], l[2], l[3], a = widths[0], b = widths[1], c = widths[2])
    };
    lines.iter().map(line).collect::<Vec<_>>().join("\n")
}

fn short(value: f64) -> String {
    if value.abs() >= 100.0 { format!("{value:.0}") } else { format!("{value:.2}") }
}

/// Examines a part of the capture, camera by camera.
pub(super) fn check(
    capture: &Capture,
    part: Part,
    folder: &Path,
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<Vec<Row>> {
    let mut cameras: BTreeMap<usize, BTreeMap<usize, usize>> = BTreeMap::new();
    let ours = |i: &usize| {
        let frame = &capture.frames[*i];
        let path = match part {
            Part::Depth => frame.depth.as_ref().map(|d| &d.path),
            Part::Flow => frame.flow.as_ref().map(|f| &f.path),
            Part::Masks => frame.mask.as_ref(),
            Part::Tracks => frame.tracks.as_ref().map(|t| &t.path),
        };
        path.is_some_and(|p| p.starts_with(folder))
    };
    for i in (0..capture.frames.len()).filter(ours) {
        let frame = &capture.frames[i];
        cameras.entry(frame.camera).or_default().insert(frame.index, i);
    }
    let store = ImageStore::new(Arc::new(capture.clone()), 64 << 20);
    let mut rows = Vec::new();
    for (done, (&camera, frames)) in cameras.iter().enumerate() {
        console.phase("checks", done, cameras.len());
        unless_stopped(stop)?;
        let mut row = Row {
            part,
            camera: capture.cameras[camera].name.clone(),
            images: frames.len(),
            figures: BTreeMap::new(),
            warnings: Vec::new(),
        };
        match part {
            Part::Depth => depth(capture, &store, frames, &mut row)?,
            Part::Flow => flow(capture, &store, frames, &mut row)?,
            Part::Masks => masks(&store, frames, &mut row)?,
            Part::Tracks => {}
        }
        let place = format!("{} of camera {}: ", part.name(), row.camera);
        row.warnings.iter_mut().for_each(|w| w.insert_str(0, &place));
        rows.push(row);
    }
    Ok(rows)
}

/// Neighbouring frames, evenly spread.
fn pairs(frames: &BTreeMap<usize, usize>) -> Vec<[usize; 2]> {
    let all: Vec<[usize; 2]> = frames.iter().filter_map(|(index, &i)| Some([i, *frames.get(&(index + 1))?])).collect();
    let step = all.len().div_ceil(LOOKED_AT / 2).max(1);
    all.into_iter().step_by(step).collect()
}

/// Evenly spread frames.
fn some(frames: &BTreeMap<usize, usize>) -> impl Iterator<Item = usize> {
    frames.values().copied().step_by(frames.len().div_ceil(LOOKED_AT).max(1))
}

fn depth(capture: &Capture, store: &ImageStore, frames: &BTreeMap<usize, usize>, row: &mut Row) -> Result<()> {
    let cloud = capture.points.as_ref();
    let still: Vec<[f64; 3]> = cloud.map_or_else(Vec::new, |c| {
        let step = c.points.len().div_ceil(POINTS).max(1);
        (0..c.points.len()).step_by(step).filter(|&i| c.times[i].is_none()).map(|i| c.points[i]).collect()
    });
    let (mut correlations, mut errors, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
    for i in some(frames) {
        let Some((map, kind)) = store.load(i)?.to_picture().depth else { continue };
        let camera = &capture.frames[i].view;
        let mut seen: Vec<[f64; 2]> = Vec::new();
        for &point in &still {
            let Some(([u, v], z)) = camera.project(point) else { continue };
            if (0.0..camera.width as f64).contains(&u) && (0.0..camera.height as f64).contains(&v) {
                let value = f64::from(map.get(0, v as usize, u as usize));
                if value != 0.0 && z > 0.0 {
                    seen.push([value, if kind == DepthKind::Inverse { 1.0 / z } else { z }]);
                }
            }
        }
        if seen.len() < FEW {
            continue;
        }
        if kind == DepthKind::Metric {
            ratios.push(median(&mut seen.iter().map(|[d, z]| z / d).collect::<Vec<_>>()).expect("there are some"));
        }
        if let Some((correlation, error)) = line(&seen) {
            correlations.push(correlation);
            errors.push(error);
        }
    }
    if let Some(correlation) = median(&mut correlations) {
        row.figures.insert("correlation", correlation);
        if correlation < INVERTED {
            row.warnings.push(format!(
                "the maps are the opposite of what the points show (correlation {correlation:.2}): exchange depth and \
                 inverse-depth in output.kind"
            ));
        } else if correlation < WEAK {
            row.warnings
                .push(format!("the maps hardly follow the points (correlation {correlation:.2}): check some of them"));
        }
    }
    row.figures.extend(median(&mut errors).map(|e| ("error %", 100.0 * e)));
    if let Some(ratio) = median(&mut ratios) {
        row.figures.insert("scale", ratio);
        if ratio.max(1.0 / ratio) > OTHER_UNIT {
            row.warnings.push(format!(
                "the points are {ratio:.2} times as far away as in the maps: set output.scale to {ratio:.4} times its value, or \
                 metric = false"
            ));
        }
    }
    let mut changes = Vec::new();
    for [a, b] in pairs(frames) {
        let [a, b] = [store.load(a)?.to_picture().depth, store.load(b)?.to_picture().depth];
        let (Some((a, _)), Some((b, _))) = (a, b) else { continue };
        changes.extend(change(&a, &b));
    }
    if let Some(change) = median(&mut changes) {
        row.figures.insert("change over time", change);
        if change > FLICKER {
            row.warnings
                .push(format!("the maps change by {:.0} % of their spread from frame to frame", 100.0 * change));
        }
    }
    Ok(())
}

/// Correlation of pairs, and the median error of the line through them, relative.
fn line(pairs: &[[f64; 2]]) -> Option<(f64, f64)> {
    let n = pairs.len() as f64;
    let mean = |k: usize| pairs.iter().map(|p| p[k]).sum::<f64>() / n;
    let [a, b] = [mean(0), mean(1)];
    let of = |f: &dyn Fn(&[f64; 2]) -> f64| pairs.iter().map(f).sum::<f64>();
    let [xx, yy, xy] = [of(&|p| (p[0] - a).powi(2)), of(&|p| (p[1] - b).powi(2)), of(&|p| (p[0] - a) * (p[1] - b))];
    if xx <= 0.0 || yy <= 0.0 {
        return None;
    }
    let slope = xy / xx;
    let mut errors: Vec<f64> = pairs.iter().map(|[x, y]| ((slope * (x - a) + b) / y - 1.0).abs()).collect();
    Some((xy / (xx * yy).sqrt(), median(&mut errors)?))
}

/// Median change between maps, each less its median and over its spread.
fn change(a: &Planes<f32>, b: &Planes<f32>) -> Option<f64> {
    if a.data.len() != b.data.len() {
        return None;
    }
    let standard = |map: &Planes<f32>| {
        let mut known: Vec<f64> = map.data.iter().filter(|v| **v != 0.0).map(|v| f64::from(*v)).collect();
        let center = median(&mut known)?;
        let spread = (known.iter().map(|v| (v - center).powi(2)).sum::<f64>() / known.len() as f64).sqrt();
        (spread > 0.0).then_some((center, spread))
    };
    let ((ca, sa), (cb, sb)) = (standard(a)?, standard(b)?);
    let both = a.data.iter().zip(&b.data).filter(|(x, y)| **x != 0.0 && **y != 0.0);
    let mut changes: Vec<f64> =
        both.map(|(x, y)| ((f64::from(*x) - ca) / sa - (f64::from(*y) - cb) / sb).abs()).collect();
    median(&mut changes)
}

fn flow(capture: &Capture, store: &ImageStore, frames: &BTreeMap<usize, usize>, row: &mut Row) -> Result<()> {
    let (mut known, mut all, mut lengths) = (0usize, 0usize, Vec::new());
    // Difference of the images along the flow, without it, and against it.
    let mut sums = [0.0f64; 3];
    for i in some(frames) {
        let picture = store.load(i)?.to_picture();
        let (Some(flow), Some(file)) = (&picture.flow, &capture.frames[i].flow) else { continue };
        let next = store.load(file.to)?.to_picture().color;
        let (w, h, n) = (flow.width, flow.height, flow.pixels());
        if (next.width, next.height) != (w, h) {
            continue;
        }
        all += n;
        for p in (0..n).filter(|&p| flow.data[2 * n + p] > 0.0) {
            known += 1;
            let [u, v] = [flow.data[p], flow.data[n + p]];
            if u.hypot(v) < SHORT {
                continue;
            }
            lengths.push(f64::from(u.hypot(v)));
            let at = |f: f32| {
                let (x, y) = ((p % w) as f32 + 0.5 + f * u, (p / w) as f32 + 0.5 + f * v);
                ((0.0..w as f32).contains(&x) && (0.0..h as f32).contains(&y)).then(|| y as usize * w + x as usize)
            };
            let Some(places) = [1.0, 0.0, -1.0].iter().map(|f| at(*f)).collect::<Option<Vec<_>>>() else { continue };
            for (q, sum) in places.into_iter().zip(&mut sums) {
                *sum += (0..3).map(|c| f64::from((picture.color.plane(c)[p] - next.plane(c)[q]).abs())).sum::<f64>();
            }
        }
    }
    if all == 0 {
        return Ok(());
    }
    let share = known as f64 / all as f64;
    row.figures.insert("both directions agree %", 100.0 * share);
    if share < AGREES {
        row.warnings.push(format!("in only {:.0} % of the pixels both directions agree", 100.0 * share));
    }
    let many = lengths.len() >= FEW;
    row.figures.extend(median(&mut lengths).map(|l| ("pixels", l)));
    if many && sums[1] > 0.0 {
        row.figures.insert("difference to the next image, of that without flow", sums[0] / sums[1]);
        if sums[2] < sums[0] {
            row.warnings.push("the opposite of the flow fits the images better: exchange input.names".into());
        } else if sums[0] > sums[1] {
            row.warnings
                .push("the flow predicts the next image worse than no flow: check input.range and output.scale".into());
        }
    }
    Ok(())
}

fn masks(store: &ImageStore, frames: &BTreeMap<usize, usize>, row: &mut Row) -> Result<()> {
    let mut shares = Vec::new();
    for i in some(frames) {
        let Some(mask) = store.load(i)?.to_picture().mask else { continue };
        shares.push(mask.data.iter().map(|v| f64::from(*v)).sum::<f64>() / mask.data.len() as f64);
    }
    let mut overlaps = Vec::new();
    for [a, b] in pairs(frames) {
        let [a, b] = [store.load(a)?.to_picture().mask, store.load(b)?.to_picture().mask];
        let (Some(a), Some(b)) = (a, b) else { continue };
        let count = |f: &dyn Fn(bool, bool) -> bool| {
            a.data.iter().zip(&b.data).filter(|(x, y)| f(**x > 0.5, **y > 0.5)).count() as f64
        };
        let either = count(&|x, y| x || y);
        if either > 0.0 {
            overlaps.push(count(&|x, y| x && y) / either);
        }
    }
    if let Some(share) = median(&mut shares) {
        row.figures.insert("share of the image %", 100.0 * share);
        if share <= 0.0 || share >= 1.0 {
            let what = if share <= 0.0 { "empty" } else { "full" };
            row.warnings.push(format!("most masks are {what}: check output.threshold, output.channel and the input"));
        }
    }
    if let Some(overlap) = median(&mut overlaps) {
        row.figures.insert("overlap over time", overlap);
        if overlap < OVERLAP {
            row.warnings.push(format!("masks of neighbouring frames overlap by {:.0} % only", 100.0 * overlap));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_through_pairs_have_a_sign() {
        let pairs: Vec<[f64; 2]> = (0..50).map(|k| [f64::from(k), 4.0 + 0.1 * f64::from(k)]).collect();
        let (correlation, error) = line(&pairs).unwrap();
        assert!(correlation > 0.999 && error < 1e-9);
        let turned: Vec<[f64; 2]> = pairs.iter().map(|[x, y]| [-x, *y]).collect();
        assert!(line(&turned).unwrap().0 < -0.999);
        assert_eq!(line(&[[1.0, 2.0], [1.0, 3.0]]), None);
    }
}
