//! Vignetting: features that two images show at different distances from their middles are darker in the one that shows
//! them farther out.

use super::Report;
use super::finding::{EXPOSURE, FindingList, grade};
use super::look::Viewpoint;
use crate::sync::{NORMAL_MAD, median};
use splat4d::math::cholesky::Cholesky;
use splat4d_train::capture::{Capture, Distortion};

/// Terms in r², r⁴ of the logarithm of light: as many as data of some hundred features determine.
const TERMS: usize = 2;
/// Coefficients of `vignetting` in `capture.json`: r², r⁴, r⁶ of light itself.
const STATED: usize = 3;
/// Radii at which the stated polynomial is fitted to the measured one.
const FITTED: usize = 64;
/// Images of one size whose focal lengths differ by less than this share have one lens.
const SAME_FOCAL: f64 = 0.02;
/// Features that a lens needs: fewer are noise of reflections.
const FEATURES: usize = 200;
/// Standard deviations from which on it is reported, as of rolling shutters.
const SIGMAS: f64 = 4.0;
/// Rounds of weights by Cauchy's function.
const ROUNDS: usize = 10;
/// Stops that features differ by at least, and stops that coefficients and brightness of images usually have: priors.
const EXACT: f64 = 0.01;
const USUAL: [f64; 2] = [1.0, 10.0];
/// Names of cameras that a finding lists.
const NAMED: usize = 4;

/// A feature that two viewpoints show: squared distances from the middles of their images, 1 in the corners, and stops
/// by which the second is brighter.
pub(super) struct Sighting {
    pub(super) viewpoints: [usize; 2],
    pub(super) radii: [f64; 2],
    pub(super) stops: f64,
}

/// The squared distance of a pixel of a viewpoint from the middle of its image file, 1 in the corners; `None`: the file
/// does not show it.
pub(super) fn radius(capture: &Capture, viewpoint: &Viewpoint, [u, v]: [f64; 2]) -> Option<f64> {
    let (k, source) = (&viewpoint.view.intrinsics, &capture.frames[viewpoint.frame].source);
    let [x, y] = Distortion::new(source.lens).distort([(u - k.cx) / k.fx, (v - k.cy) / k.fy])?;
    let half = [0.5 * source.width as f64, 0.5 * source.height as f64];
    let [x, y] = [
        source.intrinsics.fx * x + source.intrinsics.cx - half[0],
        source.intrinsics.fy * y + source.intrinsics.cy - half[1],
    ];
    Some((x * x + y * y) / (half[0] * half[0] + half[1] * half[1]))
}

/// A lens's vignetting: stops of light at the powers of the squared radius, and their standard deviation in the corners.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Falloff {
    terms: [f64; TERMS],
    sigma: f64,
    features: usize,
}

impl Falloff {
    fn stops(&self, r2: f64) -> f64 {
        self.terms.iter().rev().fold(0.0, |sum, term| (sum + term) * r2)
    }

    /// Share of light that corners lose, and its standard deviation.
    fn loss(&self) -> [f64; 2] {
        let light = self.stops(1.0).exp2();
        [1.0 - light, std::f64::consts::LN_2 * light * self.sigma]
    }

    /// Coefficients as `capture.json` states them, of this and what is removed already.
    fn stated(&self, removed: Option<[f64; STATED]>) -> [f64; STATED] {
        let powers = |r2: f64| [r2, r2 * r2, r2 * r2 * r2];
        let (mut matrix, mut right) = (vec![0.0; STATED * STATED], vec![0.0; STATED]);
        for n in 1..=FITTED {
            let r2 = (n as f64 / FITTED as f64).powi(2);
            let p = powers(r2);
            let removed = 1.0 + removed.map_or(0.0, |k| (0..STATED).map(|i| k[i] * p[i]).sum());
            let light = removed * self.stops(r2).exp2();
            for i in 0..STATED {
                right[i] += p[i] * (light - 1.0);
                (0..STATED).for_each(|j| matrix[i * STATED + j] += p[i] * p[j]);
            }
        }
        let solved = Cholesky::new(STATED, matrix).map(|factor| factor.solve(right));
        // Four digits are far more exact than the measurement.
        solved.map_or([0.0; STATED], |k| std::array::from_fn(|i| (1e4 * k[i]).round() / 1e4))
    }
}

/// The vignetting of each lens, of what features of pairs show; `lenses`: the lens of each viewpoint. Least squares over
/// the brightness of every viewpoint and the terms of every lens; deviations by clusters of pairs of viewpoints (White
/// 1980), for what is wrong with a pair is wrong with all of its features.
fn falloffs(sightings: &[Sighting], lenses: &[usize]) -> Vec<Option<Falloff>> {
    let (n, count) = (lenses.len(), lenses.iter().max().map_or(0, |l| l + 1));
    let all = n + TERMS * count;
    let row = |s: &Sighting| {
        let [a, b] = s.viewpoints;
        let power = |end: usize, k: usize| s.radii[end].powi(k as i32 + 1);
        let mut out = [(0, 0.0); 2 + 2 * TERMS];
        (out[0], out[1]) = ((a, -1.0), (b, 1.0));
        for k in 0..TERMS {
            out[2 + 2 * k] = (n + TERMS * lenses[a] + k, -power(0, k));
            out[3 + 2 * k] = (n + TERMS * lenses[b] + k, power(1, k));
        }
        out
    };
    let prior = |k: usize| USUAL[usize::from(k < n)].powi(-2);
    let mut values = vec![0.0; all];
    let mut sigmas = vec![0.0; count];
    for round in 0..ROUNDS {
        let rest = |s: &Sighting| s.stops - row(s).iter().map(|(k, v)| v * values[*k]).sum::<f64>();
        let scale = (NORMAL_MAD * median(&mut sightings.iter().map(|s| rest(s).abs()).collect::<Vec<_>>())).max(EXACT);
        let mut matrix = vec![0.0; all * all];
        let mut right = vec![0.0; all];
        (0..all).for_each(|k| matrix[k * all + k] = prior(k));
        let weight = |s: &Sighting| 1.0 / (scale * scale * (1.0 + (rest(s) / scale).powi(2)));
        for s in sightings {
            let (j, weight) = (row(s), weight(s));
            for (k, v) in j {
                right[k] += weight * v * s.stops;
                j.iter().for_each(|(l, w)| matrix[k * all + l] += weight * v * w);
            }
        }
        let Some(factor) = Cholesky::new(all, matrix) else { return vec![None; count] };
        if round + 1 == ROUNDS {
            for (lens, sigma) in sigmas.iter_mut().enumerate() {
                let mut corner = vec![0.0; all];
                corner[n + TERMS * lens..][..TERMS].fill(1.0);
                let column = factor.solve(corner);
                let pull = |s: &Sighting| weight(s) * rest(s) * row(s).iter().map(|(k, v)| v * column[*k]).sum::<f64>();
                let clusters = sightings.chunk_by(|a, b| a.viewpoints == b.viewpoints);
                let pulled: f64 = clusters.map(|cluster| cluster.iter().map(pull).sum::<f64>().powi(2)).sum();
                let drawn: f64 = (0..all).map(|k| prior(k) * column[k] * column[k]).sum();
                *sigma = (pulled + drawn).sqrt();
            }
        }
        values = factor.solve(right);
    }
    let features = |lens: usize| sightings.iter().filter(|s| s.viewpoints.iter().any(|&v| lenses[v] == lens)).count();
    (0..count)
        .map(|lens| {
            let terms = std::array::from_fn(|k| values[n + TERMS * lens + k]);
            let found = Falloff { terms, sigma: sigmas[lens], features: features(lens) };
            (found.features >= FEATURES).then_some(found)
        })
        .collect()
}

/// Reports the vignetting of all lenses.
pub(super) fn vignetting(
    capture: &Capture,
    viewpoints: &[(usize, &Viewpoint)],
    sightings: &[Sighting],
    report: &mut Report,
) {
    if sightings.len() < FEATURES {
        return;
    }
    // By lens: a frame of it.
    let mut known: Vec<usize> = Vec::new();
    let alike = |a: usize, b: usize| {
        let (a, b) = (&capture.frames[a], &capture.frames[b]);
        let near = |x: f64, y: f64| (x / y - 1.0).abs() < SAME_FOCAL;
        (a.source.width, a.source.height, a.vignetting) == (b.source.width, b.source.height, b.vignetting)
            && near(a.source.intrinsics.fx, b.source.intrinsics.fx)
    };
    let mut lens = |frame: usize| {
        known.iter().position(|&other| alike(frame, other)).unwrap_or_else(|| {
            known.push(frame);
            known.len() - 1
        })
    };
    let lenses: Vec<usize> = viewpoints.iter().map(|(_, v)| lens(v.frame)).collect();
    for (lens, falloff) in falloffs(sightings, &lenses).into_iter().enumerate() {
        let Some(falloff) = falloff else { continue };
        let [loss, sigma] = falloff.loss();
        let mut cameras: Vec<usize> =
            viewpoints.iter().zip(&lenses).filter(|(_, l)| **l == lens).map(|((c, _), _)| *c).collect();
        cameras.dedup();
        cameras.iter().for_each(|&c| report.cameras[c].vignetting = Some([loss, sigma]));
        let stops = -falloff.stops(1.0);
        let Some(g) = grade(stops, EXPOSURE).filter(|_| stops > SIGMAS * falloff.sigma) else { continue };
        let names: Vec<&str> = cameras.iter().take(NAMED).map(|&c| capture.cameras[c].name.as_str()).collect();
        let who = match (cameras.len(), capture.cameras.len()) {
            (1, _) => format!("Camera {}", names[0]),
            (some, all) if some == all => format!("All {all} cameras"),
            (some, _) => format!("{some} cameras ({}{})", names.join(", "), if some > NAMED { ", …" } else { "" }),
        };
        let what = format!(
            "{who}: the corners of images lose {:.1} ± {:.1} % of their light ({} features that two images show).",
            100.0 * loss,
            100.0 * sigma,
            falloff.features
        );
        let k = falloff.stated(capture.frames[known[lens]].vignetting);
        let remedy = format!(
            "Give these cameras \"vignetting\": {k:?} in capture.json, or train with --set capture.vignetting={}: images are \
             then corrected.",
            k.map(|v| v.to_string()).join(",")
        );
        let words = ("Dark corners in renders, and brightness that changes with the view.", remedy.as_str());
        let camera = (cameras.len() == 1).then(|| names[0]);
        FindingList { report }.add((g, "vignetting"), camera, (100.0 * loss, "%"), what, words);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    /// Features in pairs of twelve viewpoints, of which some are reflections; the second half has another lens.
    fn drawn(light: [fn(f64) -> f64; 2]) -> (Vec<Sighting>, Vec<usize>) {
        const VIEWPOINTS: usize = 12;
        let lenses: Vec<usize> = (0..VIEWPOINTS).map(|v| usize::from(2 * v >= VIEWPOINTS)).collect();
        let mut out = Vec::new();
        for a in 0..VIEWPOINTS {
            for b in a + 1..VIEWPOINTS {
                for n in 0..20 {
                    let rng = Rng::new(8, "vignetting", ((a * VIEWPOINTS + b) * 20 + n) as u64);
                    let radii = [rng.uniform(0), rng.uniform(1)];
                    let of = |end: usize, v: usize| light[lenses[v]](radii[end]).log2() + 0.2 * (v as f64).sin();
                    let noise = if n % 8 == 0 { 2.0 * rng.uniform(2) } else { 0.1 * rng.normal(3) };
                    out.push(Sighting { viewpoints: [a, b], radii, stops: of(1, b) - of(0, a) + noise });
                }
            }
        }
        (out, lenses)
    }

    #[test]
    fn each_lens_is_found_among_reflections() {
        let (sightings, lenses) = drawn([|r2| 1.0 - 0.3 * r2 - 0.1 * r2 * r2, |_| 1.0]);
        let found = falloffs(&sightings, &lenses);
        let [dark, even] = [0, 1].map(|lens| found[lens].unwrap());
        assert!((dark.loss()[0] - 0.4).abs() < 0.02 && dark.loss()[1] < 0.02, "{dark:?} {:?}", dark.loss());
        assert!(even.loss()[0].abs() < 0.03 && even.loss()[0].abs() < SIGMAS * even.loss()[1], "{:?}", even.loss());
        let k = dark.stated(None);
        assert!((k.iter().sum::<f64>() + dark.loss()[0]).abs() < 0.002, "{k:?}");
        // What is removed already is kept.
        let more = dark.stated(Some([-0.2, 0.0, 0.0]));
        assert!((1.0 + more.iter().sum::<f64>() - 0.8 * (1.0 - dark.loss()[0])).abs() < 0.005, "{more:?}");
    }

    #[test]
    fn features_at_one_radius_show_nothing() {
        let (mut sightings, lenses) = drawn([|r2| 1.0 - 0.4 * r2, |_| 1.0]);
        sightings.iter_mut().for_each(|s| s.radii = [0.5; 2]);
        for found in falloffs(&sightings, &lenses).into_iter().flatten() {
            assert!(found.loss()[0].abs() < SIGMAS * found.loss()[1], "{found:?}");
        }
        sightings.truncate(FEATURES - 1);
        assert!(falloffs(&sightings, &lenses).iter().all(Option::is_none));
    }
}
