//! A point moved by a screw motion: exp([w; v]) applied to p, with its gradient. Generic, since it is learnt.
//!
//! p' = R p + V v, R = I + a\[w\] + b\[w\]², V = I + b\[w\] + c\[w\]², with s = |w|²: a = sin θ/θ, b = (1 − cos θ)/θ²,
//! c = (θ − sin θ)/θ³. Source: Murray, Li and Sastry 1994, §2.3; Park et al. 2021 (Nerfies) §3.2.

use super::Real;
use super::vec3::{cross, dot};

/// Below this |w|² the coefficients are computed by their series, whose next term is then below 1e-13.
const SERIES: f64 = 1.0;
/// Terms of the series.
const TERMS: usize = 8;

/// exp([w; v]) p. `w`: axis times angle, radians; `v`: velocity along the screw.
#[inline(always)]
pub(crate) fn move_point<F: Real>(w: [F; 3], v: [F; 3], p: [F; 3]) -> [F; 3] {
    let ([a, b, c], _) = coefficients(dot(w, w));
    let (u1, y1) = (cross(w, p), cross(w, v));
    let (u2, y2) = (cross(w, u1), cross(w, y1));
    std::array::from_fn(|k| p[k] + a * u1[k] + b * u2[k] + v[k] + b * y1[k] + c * y2[k])
}

/// VJP of [`move_point`]: (dL/dw, dL/dv, dL/dp).
#[inline(always)]
pub(crate) fn move_point_backward<F: Real>(w: [F; 3], v: [F; 3], p: [F; 3], d: [F; 3]) -> ([F; 3], [F; 3], [F; 3]) {
    let ([a, b, c], slopes) = coefficients(dot(w, w));
    let (u1, y1) = (cross(w, p), cross(w, v));
    let (u2, y2) = (cross(w, u1), cross(w, y1));
    // For z = w × x: dL/dw = x × dz, dL/dx = dz × w.
    let twice = |first: [F; 3], one: F, two: F| -> ([F; 3], [F; 3]) {
        let d2 = d.map(|d| two * d);
        let back = cross(d2, w);
        let d1: [F; 3] = std::array::from_fn(|k| one * d[k] + back[k]);
        (d1, cross(first, d2))
    };
    let (d_u1, from_u2) = twice(u1, a, b);
    let (d_y1, from_y2) = twice(y1, b, c);
    let (from_u1, from_y1) = (cross(p, d_u1), cross(v, d_y1));
    let along = dot(d, u1) * slopes[0] + (dot(d, u2) + dot(d, y1)) * slopes[1] + dot(d, y2) * slopes[2];
    let d_w = std::array::from_fn(|k| from_u1[k] + from_u2[k] + from_y1[k] + from_y2[k] + F::TWO * along * w[k]);
    let (to_p, to_v) = (cross(d_u1, w), cross(d_y1, w));
    (d_w, std::array::from_fn(|k| d[k] + to_v[k]), std::array::from_fn(|k| d[k] + to_p[k]))
}

/// a, b, c and their slopes by s = |w|².
#[inline(always)]
fn coefficients<F: Real>(s: F) -> ([F; 3], [F; 3]) {
    let (mut value, mut slope) = ([F::ZERO; 3], [F::ZERO; 3]);
    if s < F::of(SERIES) {
        // Σ_n (−s)^n/(2n + 1 + j)!, by Horner's rule from the last term on, value and slope together.
        for j in 0..3 {
            let (mut f, mut df) = (F::ONE, F::ZERO);
            for n in (1..TERMS).rev() {
                let r = F::of(-1.0 / ((2 * n + j) * (2 * n + j + 1)) as f64);
                df = r * (f + s * df);
                f = F::ONE + r * s * f;
            }
            let first = F::of([1.0, 0.5, 1.0 / 6.0][j]);
            (value[j], slope[j]) = (first * f, first * df);
        }
        return (value, slope);
    }
    let theta = s.sqrt();
    let (sin, cos) = (theta.sin(), theta.cos());
    let a = sin / theta;
    let b = (F::ONE - cos) / s;
    let c = (F::ONE - a) / s;
    let d_a = (cos - a) / (F::TWO * s);
    ([a, b, c], [d_a, (F::HALF * a - b) / s, (-d_a - c) / s])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    fn draw(i: u64) -> [f64; 3] {
        std::array::from_fn(|k| Rng::new(4, "twist", i).normal(k as u64))
    }

    #[test]
    fn a_twist_is_a_rigid_motion_and_zero_is_the_identity() {
        for i in 0..50 {
            let (p, q, v) = (draw(i), draw(100 + i), draw(200 + i));
            let w = draw(300 + i).map(|x| x * [1e-9, 1e-3, 0.5, 3.0][i as usize % 4]);
            assert_eq!(move_point([0.0; 3], [0.0; 3], p), p);
            let (a, b) = (move_point(w, v, p), move_point(w, v, q));
            let length = |x: [f64; 3], y: [f64; 3]| (0..3).map(|k| (x[k] - y[k]).powi(2)).sum::<f64>().sqrt();
            assert!((length(a, b) - length(p, q)).abs() < 1e-12, "distances stay");
            // Motions about one screw add up.
            let (half_w, half_v) = (w.map(|x| 0.5 * x), v.map(|x| 0.5 * x));
            let twice = move_point(half_w, half_v, move_point(half_w, half_v, p));
            assert!(length(a, twice) < 1e-11, "{a:?} {twice:?}");
        }
    }

    #[test]
    fn gradient_equals_finite_differences_and_both_branches_agree() {
        for i in 0..40 {
            let scale = [1e-7, 1e-2, 0.57, 1.5][i as usize % 4];
            let x: [f64; 9] =
                std::array::from_fn(|k| draw(10 + i + 7 * (k as u64 / 3))[k % 3] * [scale, 1.0, 1.0][k / 3]);
            let g = draw(500 + i);
            let split = |x: [f64; 9]| [0, 3, 6].map(|k| [x[k], x[k + 1], x[k + 2]]);
            let value = |x: [f64; 9]| {
                let [w, v, p] = split(x);
                dot(move_point(w, v, p), g)
            };
            let [w, v, p] = split(x);
            let (d_w, d_v, d_p) = move_point_backward(w, v, p, g);
            for (k, got) in [d_w, d_v, d_p].as_flattened().iter().enumerate() {
                let moved = |h: f64| {
                    let mut x = x;
                    x[k] += h;
                    value(x)
                };
                let fd = (moved(1e-5) - moved(-1e-5)) / 2e-5;
                assert!((fd - got).abs() < 1e-8 * fd.abs().max(1.0), "{k}: {fd} {got}");
            }
        }
        let (below, above) = (coefficients(SERIES - 1e-12), coefficients(SERIES + 1e-12));
        for (a, b) in below.0.iter().chain(&below.1).zip(above.0.iter().chain(&above.1)) {
            assert!((a - b).abs() < 1e-11, "{below:?} {above:?}");
        }
    }
}
