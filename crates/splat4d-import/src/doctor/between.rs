//! Findings of pairs of cameras: poses, exposure, white balance and sharpness, by features that two of them see.

use super::finding::{AGREE, EXPOSURE, FindingList, GAMMA, MATCHES, SHARPNESS, grade, unit};
use super::look::{CameraObservations, Viewpoint, detail};
use super::vignetting::{self, Sighting};
use super::{Options, PairReport, Report};
use crate::sfm::pictures::{CameraView, Feature};
use crate::sfm::tracks::{Pairing, links};
use crate::sync::epipolar::{fundamental, sampson};
use crate::sync::grey::Grey;
use crate::sync::median;
use rayon::prelude::*;
use splat4d::math::cholesky::Cholesky;
use splat4d::math::se3::dot;
use splat4d::scene::Planes;
use splat4d_train::capture::Capture;
use splat4d_train::event::Progress;
use splat4d_train::vision::features::{Limits, find};
use splat4d_train::vision::raster::grey;

/// Distance of matches from their epipolar lines, pixels of an image 1920 wide.
pub(super) const EPIPOLAR: [f64; 2] = [1.0, 2.0];
/// And at least this many of the image's own: of the bundled capture, whose poses are exact, up to 0.8 were measured.
pub(super) const OWN_PIXELS: [f64; 2] = [1.0, 2.0];
/// And of poses: of pairs with fewer many are chance (measured on a hall and on the bundled capture), of cameras whose
/// axes are farther apart most, degrees.
const SURE: usize = 20;
const APART: f64 = 60.0;
const TELL: usize = 3;
/// Median over lower quartile of the size of a normal error: 0.6745 / 0.3186.
const QUARTILE_TO_MEDIAN: f64 = 2.117;
/// Medians of the distance from the epipolar line within which a match is one, and pixels that lines are off at least.
const LINE: f64 = 4.0;
const EXACT: f64 = 0.1;
/// Differences of pairs, in stops and as a logarithm of sharpness, that are off by more contradict the others.
const STOPS: f64 = 0.1;
const TIMES: f64 = 0.15;
/// Half the side of what is compared for sharpness, pixels.
const PATCH: usize = 8;

fn planes(viewpoint: &Viewpoint) -> Planes<f32> {
    let values: Vec<f32> = viewpoint.picture.data.iter().map(|v| f32::from(*v) / 255.0).collect();
    Planes::from_interleaved(3, viewpoint.picture.height, viewpoint.picture.width, &values)
}

fn sight(name: &str, number: usize, viewpoint: &Viewpoint, most: usize) -> CameraView {
    /// Least contrast of a feature, as structure from motion takes it.
    const CONTRAST: f64 = 0.004;
    let found = find(&grey(&planes(viewpoint)), Limits { contrast: CONTRAST, most }, &|_, _| true);
    let feature = |f: &splat4d_train::vision::features::Feature| Feature {
        pixel: f.pixel,
        velocity: [0.0; 2],
        moment: 0,
        descriptor: f.descriptor,
        color: [0; 3],
    };
    CameraView {
        learned: 0,
        name: name.to_owned(),
        size: [viewpoint.picture.width, viewpoint.picture.height],
        factor: 1.0,
        focal: None,
        exact: false,
        pose: None,
        lens: number,
        frame: 0.0,
        features: found.iter().map(feature).collect(),
        shown: Vec::new(),
    }
}

/// The mean of a channel around a position, and the patch's detail relative to its brightness.
fn around(viewpoint: &Viewpoint, [u, v]: [f64; 2]) -> Option<([f64; 3], f64)> {
    let p = &viewpoint.picture;
    let (x, y) = (u as usize, v as usize);
    if x < PATCH || y < PATCH || x + PATCH >= p.width || y + PATCH >= p.height {
        return None;
    }
    let side = 2 * PATCH + 1;
    let mut sums = [0.0; 3];
    let mut data = Vec::with_capacity(side * side);
    for row in y - PATCH..=y + PATCH {
        for pixel in p.data[3 * (row * p.width + x - PATCH)..][..3 * side].chunks_exact(3) {
            (0..3).for_each(|c| sums[c] += f64::from(pixel[c]));
            data.push(pixel.iter().map(|v| f32::from(*v)).sum::<f32>() / (3.0 * 255.0));
        }
    }
    let mean = f64::from(data.iter().sum::<f32>()) / data.len() as f64;
    let fine = detail(&Grey { width: side, height: side, data });
    (mean > 0.0).then(|| (sums.map(|s| s / (side * side) as f64), fine / mean))
}

/// Findings of a pair of camera positions.
struct Pair {
    viewpoints: [usize; 2],
    matches: usize,
    /// Pixels of 1920, and own ones.
    off: [f64; 2],
    /// Stops by which the second is brighter.
    gain: [f64; 3],
    /// Logarithm of how much sharper it is.
    sharper: f64,
    /// Brightness of single features.
    sightings: Vec<Sighting>,
}

fn pair(
    capture: &Capture,
    viewpoints: &[(usize, &Viewpoint)],
    sights: &[CameraView],
    [a, b]: [usize; 2],
    matches: &[([usize; 2], f32)],
) -> Option<Pair> {
    /// Values between which ratios of brightness mean something, of 255.
    const EXPOSED: [f64; 2] = [12.0, 240.0];
    let (p, q) = (viewpoints[a].1, viewpoints[b].1);
    let f = fundamental(&p.view, &q.view);
    let (mut off, mut gains, mut sharper) = (Vec::new(), [Vec::new(), Vec::new(), Vec::new()], Vec::new());
    let mut sightings = Vec::new();
    for ([i, j], _) in matches {
        let (x, y) = (sights[a].features[*i].pixel, sights[b].features[*j].pixel);
        let distance = sampson(&f, x, y).abs();
        off.push(distance);
        let (Some(one), Some(two)) = (around(p, x), around(q, y)) else { continue };
        let exposed = |v: f64| (EXPOSED[0]..EXPOSED[1]).contains(&v);
        let ratio = |c: usize| {
            let good = exposed(one.0[c]) && exposed(two.0[c]);
            good.then(|| GAMMA * (two.0[c] / one.0[c]).log2())
        };
        let stops = [0, 1, 2].map(ratio);
        (0..3).for_each(|c| gains[c].extend(stops[c]));
        if let ([Some(red), Some(green), Some(blue)], Some(first), Some(second)) =
            (stops, vignetting::radius(capture, p, x), vignetting::radius(capture, q, y))
        {
            let sighting = Sighting { viewpoints: [a, b], radii: [first, second], stops: (red + green + blue) / 3.0 };
            sightings.push((distance, sighting));
        }
        sharper.push((two.1.max(1e-9) / one.1.max(1e-9)).ln());
    }
    let near = dot(p.view.forward(), q.view.forward()) > APART.to_radians().cos();
    if off.len() < SURE || !near {
        return None;
    }
    // Chance matches only add large distances: the lower quartile, as the median that it implies of normal errors.
    off.sort_by(f64::total_cmp);
    let own = QUARTILE_TO_MEDIAN * off[off.len() / 4];
    // Chance matches are of other points.
    sightings.retain(|(distance, _)| *distance <= LINE * own.max(EXACT));
    Some(Pair {
        sightings: sightings.into_iter().map(|(_, sighting)| sighting).collect(),
        viewpoints: [a, b],
        matches: off.len(),
        off: [own * 0.5 * (unit(&p.view) + unit(&q.view)), own],
        gain: gains.map(|mut g| if g.len() < MATCHES { f64::NAN } else { median(&mut g) }),
        sharper: median(&mut sharper),
    })
}

/// A number for each camera from pairwise differences, about the median of the cameras that are connected; None for
/// those without a pair. Least squares, in which pairs of many features count more and those that contradict little
/// (Cauchy's weights at `scale`).
fn relative(cameras: usize, told: &[([usize; 2], f64, f64)], scale: f64) -> Vec<Option<f64>> {
    /// Of the weight of one feature: it only makes the equations of what nothing connects solvable.
    const RIDGE: f64 = 1e-9;
    const ROUNDS: usize = 10;
    let told: Vec<_> = told.iter().filter(|(c, difference, _)| c[0] != c[1] && difference.is_finite()).collect();
    let mut values = vec![0.0; cameras];
    for _ in 0..ROUNDS {
        let (mut matrix, mut right) = (vec![0.0; cameras * cameras], vec![0.0; cameras]);
        (0..cameras).for_each(|c| matrix[c * cameras + c] = RIDGE);
        for ([a, b], difference, features) in told.iter().copied() {
            let rest = values[*b] - values[*a] - difference;
            let weight = features / (1.0 + (rest / scale).powi(2));
            for (i, j, sign) in [(*a, *a, 1.0), (*b, *b, 1.0), (*a, *b, -1.0), (*b, *a, -1.0)] {
                matrix[i * cameras + j] += sign * weight;
            }
            right[*b] += weight * difference;
            right[*a] -= weight * difference;
        }
        let Some(factor) = Cholesky::new(cameras, matrix) else { return vec![None; cameras] };
        values = factor.solve(right);
    }
    let mut part: Vec<usize> = (0..cameras).collect();
    for ([a, b], ..) in told.iter().copied() {
        let (from, to) = (part[*a].max(part[*b]), part[*a].min(part[*b]));
        part.iter_mut().filter(|p| **p == from).for_each(|p| *p = to);
    }
    let middle =
        |c: usize| median(&mut (0..cameras).filter(|&o| part[o] == part[c]).map(|o| values[o]).collect::<Vec<_>>());
    (0..cameras).map(|c| told.iter().any(|(pair, ..)| pair.contains(&c)).then(|| values[c] - middle(c))).collect()
}

/// Error of a camera by its most reliable pairs: pixels of 1920, and own ones.
fn poses(pairs: &[Pair], viewpoints: &[(usize, &Viewpoint)], camera: usize) -> Option<(f64, f64)> {
    let mut own: Vec<&Pair> =
        pairs.iter().filter(|p| p.viewpoints.iter().any(|&k| viewpoints[k].0 == camera)).collect();
    own.sort_by(|p, q| p.off[0].total_cmp(&q.off[0]));
    (own.len() >= TELL).then(|| (own[AGREE - 1].off[0], own[AGREE - 1].off[1]))
}

pub(super) fn between(
    capture: &Capture,
    seen: &[CameraObservations],
    options: &Options,
    report: &mut Report,
    progress: &mut Progress<'_>,
) {
    let viewpoints: Vec<(usize, &Viewpoint)> =
        seen.iter().enumerate().flat_map(|(c, s)| s.viewpoints.iter().map(move |viewpoint| (c, viewpoint))).collect();
    progress.phase("features", 0, viewpoints.len());
    let name = |c: usize| capture.cameras[c].name.as_str();
    let sights: Vec<CameraView> =
        viewpoints.par_iter().enumerate().map(|(k, (c, s))| sight(name(*c), k, s, options.features)).collect();
    let found = links(&sights, Pairing::All, 0, progress);
    let mut pairs: Vec<Pair> =
        found.iter().filter_map(|l| pair(capture, &viewpoints, &sights, l.sights, &l.matches)).collect();
    if pairs.is_empty() {
        report
            .left
            .push("No two images have enough in common: poses, exposure and sharpness were not compared.".into());
        return;
    }
    let told = |p: &Pair| PairReport {
        cameras: p.viewpoints.map(|k| name(viewpoints[k].0).to_owned()),
        matches: p.matches,
        epipolar: p.off[0],
        gain: p.gain,
        sharper: p.sharper.exp(),
    };
    report.pairs = pairs.iter().map(told).collect();
    report.pairs.sort_by(|a, b| b.epipolar.total_cmp(&a.epipolar));
    let sightings: Vec<Sighting> = pairs.iter_mut().flat_map(|p| std::mem::take(&mut p.sightings)).collect();
    vignetting::vignetting(capture, &viewpoints, &sightings, report);
    let rig = seen.iter().filter(|s| !s.viewpoints.is_empty()).count();
    let by_camera = |value: &dyn Fn(&Pair) -> f64, scale: f64| {
        let of = |p: &Pair| (p.viewpoints.map(|k| viewpoints[k].0), value(p), p.matches as f64);
        relative(seen.len(), &pairs.iter().map(of).collect::<Vec<_>>(), scale)
    };
    let gains = [0, 1, 2].map(|c| by_camera(&move |p| p.gain[c], STOPS));
    let sharper = by_camera(&|p| p.sharper, TIMES);
    for camera in 0..seen.len() {
        let (off, own) = poses(&pairs, &viewpoints, camera).unzip();
        let gain = [0, 1, 2].map(|c| gains[c][camera]);
        let sharp = sharper[camera].map(f64::exp);
        let row = &mut report.cameras[camera];
        row.epipolar = off;
        if rig > 1 {
            if let [Some(r), Some(g), Some(b)] = gain {
                row.exposure = Some([r, g, b]);
            }
            row.sharpness = sharp;
        }
        let (exposure, sharpness) = (row.exposure, row.sharpness);
        let mut told = FindingList { report };
        if let (Some(off), Some(own)) = (off, own)
            && let Some(g) = grade(off, EPIPOLAR).min(grade(own, OWN_PIXELS))
        {
            let what = format!(
                "Camera {}: its features are {off:.1} px (at 1920 px) from where its pose and lens project them.",
                name(camera)
            );
            let words = (
                "Doubled edges and blur in all views that show the same.",
                "Calibrate again, or refine its pose; else leave it out.",
            );
            told.add((g, "epipolar"), Some(name(camera)), (off, "px"), what, words);
        }
        if let Some([r, green, b]) = exposure {
            if let Some(g) = grade(green.abs(), EXPOSURE) {
                let way = if green > 0.0 { "brighter" } else { "darker" };
                let what = format!("Camera {} is {:.2} stops {way} than the others.", name(camera), green.abs());
                let words = (
                    "Brightness that changes with the view, and fog that explains it.",
                    "Lock exposure, correct its images, or keep exposure learnt.",
                );
                told.add((g, "exposure"), Some(name(camera)), (green, "stops"), what, words);
            }
            let tint = if (r - green).abs() > (b - green).abs() { r - green } else { b - green };
            if let Some(g) = grade(tint.abs(), EXPOSURE) {
                let what = format!(
                    "Camera {}: white balance differs by {:.2} stops (red {:+.2}, blue {:+.2} against green).",
                    name(camera),
                    tint.abs(),
                    r - green,
                    b - green
                );
                let words = (
                    "Colours that change with the view.",
                    "Lock white balance, correct its images, or keep exposure learnt.",
                );
                told.add((g, "white-balance"), Some(name(camera)), (tint, "stops"), what, words);
            }
        }
        if let Some(sharp) = sharpness
            && let Some(g) = grade(1.0 / sharp, SHARPNESS.map(|s| 1.0 / s))
        {
            let what =
                format!("Camera {} is {sharp:.2} times as sharp as the others at the same places.", name(camera));
            let words = ("Soft texture in the views around it.", "Focus it again; where it is bad, leave it out.");
            told.add((g, "sharpness"), Some(name(camera)), (sharp, "times"), what, words);
        }
    }
    let alone: Vec<&str> = (0..seen.len())
        .filter(|&c| rig > 1 && report.cameras[c].epipolar.is_none() && !seen[c].viewpoints.is_empty())
        .map(name)
        .collect();
    if !alone.is_empty() {
        report.left.push(format!(
            "Poses of these cameras were not checked, for fewer than {TELL} others show enough of the same: {}.",
            alone.join(", ")
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_of_pairs_become_numbers_of_cameras() {
        let truth = [0.0, 0.2, -0.3, 0.1, 0.0];
        let pair = |a: usize, b: usize, off: f64| ([a, b], truth[b] - truth[a] + off, 20.0);
        // One pair is wrong by a stop, and camera 5 has none.
        let told =
            [pair(0, 1, 0.0), pair(1, 2, 0.0), pair(2, 3, 0.0), pair(3, 4, 0.0), pair(4, 0, 0.0), pair(0, 2, 1.0)];
        let found = relative(6, &told, 0.1);
        for (c, v) in truth.iter().enumerate() {
            assert!((found[c].unwrap() - v).abs() < 0.02, "camera {c}: {found:?}");
        }
        assert_eq!(found[5], None);
        // Two groups that nothing connects each have a middle of their own.
        let apart = relative(4, &[([0, 1], 0.4, 20.0), ([2, 3], -0.2, 20.0)], 0.1);
        assert!((apart[1].unwrap() - apart[0].unwrap() - 0.4).abs() < 1e-6, "{apart:?}");
    }
}
