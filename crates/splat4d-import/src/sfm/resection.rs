//! Pose and focal length of a camera that sees known points.

use super::algebra::{orthonormal, roots, rotation};
use super::lens::{Lens, off};
use super::sample::{Consensus, Data, Search, consensus};
use splat4d::math::cholesky::Cholesky;
use splat4d::math::se3::{cross, dot, mat_mul, mat_vec, norm, normalize, sub, transpose};
use splat4d::math::{Rng, Se3, mat3};

/// The poses (at most four) from which three points are seen along three rays: Grunert's solution (1841) as in Haralick
/// et al. 1994, "Review and analysis of solutions of the three point perspective pose estimation problem".
///
/// `points` in the world, `rays` in the camera's axes, of any length.
pub(crate) fn three(points: &[[f64; 3]; 3], rays: &[[f64; 3]; 3]) -> Vec<Se3> {
    let j = rays.map(normalize);
    let square = |a: [f64; 3], b: [f64; 3]| dot(sub(a, b), sub(a, b));
    let (a2, b2, c2) = (square(points[1], points[2]), square(points[0], points[2]), square(points[0], points[1]));
    if a2 <= 0.0 || b2 <= 0.0 || c2 <= 0.0 {
        return Vec::new();
    }
    let (cos_a, cos_b, cos_c) = (dot(j[1], j[2]), dot(j[0], j[2]), dot(j[0], j[1]));
    let m = (a2 - c2) / b2;
    let p = (a2 + c2) / b2;
    let quartic = [
        (1.0 + m).powi(2) - 4.0 * a2 / b2 * cos_c * cos_c,
        4.0 * (-m * (1.0 + m) * cos_b + 2.0 * a2 / b2 * cos_c * cos_c * cos_b - (1.0 - p) * cos_a * cos_c),
        2.0 * (m * m - 1.0 + 2.0 * m * m * cos_b * cos_b + 2.0 * (b2 - c2) / b2 * cos_a * cos_a
            - 4.0 * p * cos_a * cos_b * cos_c
            + 2.0 * (b2 - a2) / b2 * cos_c * cos_c),
        4.0 * (m * (1.0 - m) * cos_b - (1.0 - p) * cos_a * cos_c + 2.0 * c2 / b2 * cos_a * cos_a * cos_b),
        (m - 1.0).powi(2) - 4.0 * c2 / b2 * cos_a * cos_a,
    ];
    let mut out = Vec::new();
    for v in roots(&quartic) {
        let u = ((m - 1.0) * v * v - 2.0 * m * cos_b * v + 1.0 + m) / (2.0 * (cos_c - v * cos_a));
        let s0 = (b2 / (1.0 + v * v - 2.0 * v * cos_b)).sqrt();
        let mut s = [s0, u * s0, v * s0];
        if !s.iter().all(|x| x.is_finite() && *x > 0.0) {
            continue;
        }
        // Newton's method on the three distances wins the digits back that the quartic lost.
        for _ in 0..3 {
            let f = [
                s[1] * s[1] + s[2] * s[2] - 2.0 * s[1] * s[2] * cos_a - a2,
                s[0] * s[0] + s[2] * s[2] - 2.0 * s[0] * s[2] * cos_b - b2,
                s[0] * s[0] + s[1] * s[1] - 2.0 * s[0] * s[1] * cos_c - c2,
            ];
            let slopes = [
                [0.0, 2.0 * (s[1] - s[2] * cos_a), 2.0 * (s[2] - s[1] * cos_a)],
                [2.0 * (s[0] - s[2] * cos_b), 0.0, 2.0 * (s[2] - s[0] * cos_b)],
                [2.0 * (s[0] - s[1] * cos_c), 2.0 * (s[1] - s[0] * cos_c), 0.0],
            ];
            let Some(step) = mat3::solve(slopes, f) else { break };
            (0..3).for_each(|k| s[k] -= step[k]);
        }
        let seen: [[f64; 3]; 3] = std::array::from_fn(|k| j[k].map(|x| s[k] * x));
        let (Some(there), Some(here)) = (frame(&seen), frame(points)) else { continue };
        let rotation = mat_mul(&transpose(&there), &here);
        let translation = sub(seen[0], mat_vec(&rotation, points[0]));
        out.push(Se3 { rotation, translation });
    }
    out
}

/// Axes (rows) that a triangle spans; `None`: it is a line.
fn frame(p: &[[f64; 3]; 3]) -> Option<[[f64; 3]; 3]> {
    let x = normalize(sub(p[1], p[0]));
    let z = normalize(cross(x, sub(p[2], p[0])));
    let lengths = [norm(x), norm(z)];
    lengths.iter().all(|l| (*l - 1.0).abs() < 0.5).then(|| [x, cross(z, x), z])
}

/// A known point and where it is seen.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Known {
    pub point: [f64; 3],
    pub pixel: [f64; 2],
}

/// A camera among known points.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Placed {
    pub pose: Se3,
    pub lens: Lens,
}

struct Resection<'a> {
    known: &'a [Known],
    rays: Vec<[f64; 3]>,
    lens: Lens,
    /// Whether the focal length is searched for too.
    free: bool,
}

impl Data for Resection<'_> {
    type Model = Placed;
    const SAMPLE: usize = 3;

    fn len(&self) -> usize {
        self.known.len()
    }

    fn fit(&self, sample: &[usize]) -> Vec<Placed> {
        let points = std::array::from_fn(|k| self.known[sample[k]].point);
        let rays = std::array::from_fn(|k| self.rays[sample[k]]);
        three(&points, &rays).into_iter().map(|pose| Placed { pose, lens: self.lens }).collect()
    }

    fn error(&self, m: &Placed, k: usize) -> f64 {
        off(&m.lens, &m.pose, self.known[k].point, self.known[k].pixel).powi(2)
    }

    fn polish(&self, m: &Placed, inliers: &[usize]) -> Option<Placed> {
        let known: Vec<Known> = inliers.iter().map(|&k| self.known[k]).collect();
        // A handful of points does not separate a focal length from a distance.
        const FOCAL_FROM: usize = 12;
        Some(polish(m, &known, self.free && known.len() >= FOCAL_FROM, f64::INFINITY))
    }
}

/// Least squares of the distances from where known points are seen, by Gauss-Newton steps that are damped
/// (Levenberg-Marquardt); Cauchy's loss of this `scale` in pixels, ∞: plain squares.
pub(crate) fn polish(start: &Placed, known: &[Known], focal: bool, scale: f64) -> Placed {
    const STEPS: usize = 12;
    const N: usize = 7;
    let loss = |square: f64| {
        if scale.is_finite() { scale * scale * (square / (scale * scale)).ln_1p() } else { square }
    };
    let cost = |m: &Placed| -> f64 {
        known.iter().map(|k| loss(off(&m.lens, &m.pose, k.point, k.pixel).powi(2).min(1e12))).sum()
    };
    let mut best = *start;
    let mut least = cost(&best);
    let mut damping = 1e-4;
    for _ in 0..STEPS {
        let (mut h, mut g) = ([[0.0; N]; N], [0.0; N]);
        for k in known {
            let turned = mat_vec(&best.pose.rotation, k.point);
            let p = std::array::from_fn(|i| turned[i] + best.pose.translation[i]);
            let Some(seen) = best.lens.project_by(p) else { continue };
            let error = [seen.pixel[0] - k.pixel[0], seen.pixel[1] - k.pixel[1]];
            let square = error[0] * error[0] + error[1] * error[1];
            let weight = if scale.is_finite() { 1.0 / (1.0 + square / (scale * scale)) } else { 1.0 };
            for axis in 0..2 {
                let d = seen.by_place[axis];
                let turn = cross(turned, d);
                let zoom = if focal { seen.by_lens[axis][0] } else { 0.0 };
                let j = [turn[0], turn[1], turn[2], d[0], d[1], d[2], zoom];
                for a in 0..N {
                    (0..N).for_each(|b| h[a][b] += weight * j[a] * j[b]);
                    g[a] -= weight * j[a] * error[axis];
                }
            }
        }
        let mut better = false;
        for _ in 0..6 {
            let mut damped = h;
            (0..N).for_each(|a| damped[a][a] += damping * h[a][a] + f64::from(u8::from(h[a][a] == 0.0)));
            let Some(factor) = Cholesky::new(N, damped.as_flattened().to_vec()) else {
                damping *= 10.0;
                continue;
            };
            let s = factor.solve(g.to_vec());
            let mut next = best;
            next.pose.rotation = orthonormal(&mat_mul(&rotation([s[0], s[1], s[2]]), &best.pose.rotation));
            (0..3).for_each(|k| next.pose.translation[k] += s[3 + k]);
            next.lens.focal *= s[6].clamp(-1.0, 1.0).exp();
            let now = cost(&next);
            if now < least {
                better = least - now > 1e-12 * least;
                (best, least) = (next, now);
                damping = (damping * 0.1).max(1e-12);
                break;
            }
            damping *= 10.0;
        }
        if !better {
            break;
        }
    }
    best
}

/// Samples, at most; three clean of fifteen per cent clean data are among them.
const MOST: usize = 2000;
/// Chance of leaving too early.
const MISSED: f64 = 1e-3;

/// If such a share of the points agrees with a lens whose focal length adapts, others need not be tried.
const ENOUGH: f64 = 0.6;

/// The camera that explains most of the known points, with one of these lenses or, where `free`, one of a focal length
/// near theirs. `tolerance` in pixels.
pub(crate) fn place(
    known: &[Known],
    lenses: &[Lens],
    free: bool,
    tolerance: f64,
    rng: Rng,
) -> Option<Consensus<Placed>> {
    let search = Search { tolerance, most: MOST, missed: MISSED };
    let mut best: Option<Consensus<Placed>> = None;
    for (k, &lens) in lenses.iter().enumerate() {
        let rays = known.iter().map(|n| lens.ray(n.pixel)).collect();
        let found = consensus(&Resection { known, rays, lens, free }, search, rng.fork(k as u64));
        if let Some(found) = found
            && best.as_ref().is_none_or(|b| found.cost < b.cost)
        {
            let enough = found.inliers.len() as f64 >= ENOUGH * known.len() as f64;
            best = Some(found);
            if enough && free {
                break;
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::align::turn_between;

    fn room(step: u64, n: usize, lens: &Lens) -> (Se3, Vec<Known>) {
        let rng = Rng::new(2, "resection", step);
        let pose = Se3 {
            rotation: rotation(std::array::from_fn(|k| 0.8 * rng.normal(k as u64))),
            translation: [0.3, -0.2, 5.0],
        };
        let point = |k: usize| std::array::from_fn(|i| rng.normal((50 + 3 * k + i) as u64));
        let known = (0..n)
            .map(|k| {
                let point: [f64; 3] = point(k);
                Known { point, pixel: lens.project(pose.apply(point)).unwrap() }
            })
            .collect();
        (pose, known)
    }

    #[test]
    fn three_exact_points_give_the_pose_to_nine_digits() {
        let lens = Lens { focal: 500.0, k1: -0.1, center: [320.0, 180.0] };
        for step in 0..60 {
            let (truth, known) = room(step, 3, &lens);
            let points = std::array::from_fn(|k| known[k].point);
            let rays = std::array::from_fn(|k| lens.ray(known[k].pixel));
            let best = three(&points, &rays)
                .iter()
                .map(|m| turn_between(&m.rotation, &truth.rotation) + norm(sub(m.translation, truth.translation)))
                .fold(f64::INFINITY, f64::min);
            assert!(best < 1e-9, "scene {step}: {best:e}");
        }
        let line = [[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 3.0]];
        assert!(three(&line, &[[0.0, 0.0, 1.0]; 3]).iter().all(|p| p.translation.iter().all(|t| t.is_finite())));
    }

    #[test]
    fn pose_and_focal_length_are_found_among_outliers() {
        let lens = Lens { focal: 540.0, k1: 0.0, center: [320.0, 180.0] };
        let (truth, mut known) = room(99, 200, &lens);
        let rng = Rng::new(3, "noise", 0);
        for (k, n) in known.iter_mut().enumerate() {
            let draw = 2 * k as u64;
            let by = if k % 10 < 4 { 300.0 } else { 0.5 };
            n.pixel = [n.pixel[0] + by * rng.normal(draw), n.pixel[1] + by * rng.normal(draw + 1)];
        }
        let lenses = [0.8, 0.93, 1.08, 1.25].map(|s| Lens { focal: s * lens.focal, ..lens });
        let found = place(&known, &lenses, true, 2.0, Rng::new(4, "search", 0)).unwrap();
        assert!(found.inliers.len() > 100 && found.inliers.len() < 130, "{}", found.inliers.len());
        assert!((found.model.lens.focal / lens.focal - 1.0).abs() < 0.01, "{:?}", found.model.lens);
        assert!(turn_between(&found.model.pose.rotation, &truth.rotation) < 3e-3);
    }
}
