//! Real spherical harmonics up to degree 3: basis, evaluation to colour, and their gradients.
//!
//! Signs, order and the +½ offset are those of 3D Gaussian Splatting (Kerbl et al. 2023), so that its files read
//! unchanged. A direction is a unit vector from the camera to the Gaussian.

use super::Real;

/// Highest degree there is.
pub const MAX_DEGREE: usize = 3;
/// Coefficients a channel at [`MAX_DEGREE`].
pub const MAX_COEFFS: usize = 16;
/// Added to the sum, so that all-zero coefficients are mid-grey.
pub(crate) const COLOR_OFFSET: f64 = 0.5;

/// The basis function of degree 0: ½√(1/π).
pub const C0: f64 = 0.282_094_791_773_878_14;
/// √(3/4π)
const C1: f64 = 0.488_602_511_902_919_9;
/// Degree 2, in the order xy, yz, 2zz−xx−yy, xz, xx−yy.
const C2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
/// Degree 3, in the order y(3xx−yy), xyz, y(4zz−xx−yy), z(2zz−3xx−3yy), x(4zz−xx−yy), z(xx−yy), x(xx−3yy).
const C3: [f64; 7] = [
    -0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    -0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_8,
    1.445_305_721_320_277,
    -0.590_043_589_926_643_5,
];

/// Coefficients a channel of a degree: (degree+1)².
pub const fn coeffs(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// The highest degree whose coefficients fit in `count` a channel; `None` when not even degree 0 does.
pub const fn degree_of(count: usize) -> Option<usize> {
    match count {
        0 => None,
        1..=3 => Some(0),
        4..=8 => Some(1),
        9..=15 => Some(2),
        _ => Some(3),
    }
}

/// The degree-0 coefficient that shows as `rgb` (one channel).
#[inline(always)]
pub fn rgb_to_dc<F: Real>(rgb: F) -> F {
    (rgb - F::of(COLOR_OFFSET)) / F::of(C0)
}

/// Colour of a degree-0 coefficient (one channel, not clamped).
#[inline(always)]
pub fn dc_to_rgb<F: Real>(dc: F) -> F {
    dc * F::of(C0) + F::of(COLOR_OFFSET)
}

/// All 16 basis functions at unit direction `d`.
#[inline(always)]
pub(crate) fn basis<F: Real>(d: [F; 3]) -> [F; MAX_COEFFS] {
    let [x, y, z] = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (c, two, three, four) = (F::of, F::TWO, F::of(3.0), F::of(4.0));
    [
        c(C0),
        -c(C1) * y,
        c(C1) * z,
        -c(C1) * x,
        c(C2[0]) * x * y,
        c(C2[1]) * y * z,
        c(C2[2]) * (two * zz - xx - yy),
        c(C2[3]) * x * z,
        c(C2[4]) * (xx - yy),
        c(C3[0]) * y * (three * xx - yy),
        c(C3[1]) * x * y * z,
        c(C3[2]) * y * (four * zz - xx - yy),
        c(C3[3]) * z * (two * zz - three * xx - three * yy),
        c(C3[4]) * x * (four * zz - xx - yy),
        c(C3[5]) * z * (xx - yy),
        c(C3[6]) * x * (xx - three * yy),
    ]
}

/// Derivatives (16 rows of 3) of [`basis`] by x, y and z, taken as polynomials of three free variables.
#[inline(always)]
pub(crate) fn basis_gradient<F: Real>(d: [F; 3]) -> [[F; 3]; MAX_COEFFS] {
    let [x, y, z] = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (c, o, two, three, four) = (F::of, F::ZERO, F::TWO, F::of(3.0), F::of(4.0));
    let (six, eight) = (F::of(6.0), F::of(8.0));
    [
        [o, o, o],
        [o, -c(C1), o],
        [o, o, c(C1)],
        [-c(C1), o, o],
        [c(C2[0]) * y, c(C2[0]) * x, o],
        [o, c(C2[1]) * z, c(C2[1]) * y],
        [-two * c(C2[2]) * x, -two * c(C2[2]) * y, four * c(C2[2]) * z],
        [c(C2[3]) * z, o, c(C2[3]) * x],
        [two * c(C2[4]) * x, -two * c(C2[4]) * y, o],
        [six * c(C3[0]) * x * y, three * c(C3[0]) * (xx - yy), o],
        [c(C3[1]) * y * z, c(C3[1]) * x * z, c(C3[1]) * x * y],
        [-two * c(C3[2]) * x * y, c(C3[2]) * (four * zz - xx - three * yy), eight * c(C3[2]) * y * z],
        [-six * c(C3[3]) * x * z, -six * c(C3[3]) * y * z, c(C3[3]) * (six * zz - three * xx - three * yy)],
        [c(C3[4]) * (four * zz - three * xx - yy), -two * c(C3[4]) * x * y, eight * c(C3[4]) * x * z],
        [two * c(C3[5]) * x * z, -two * c(C3[5]) * y * z, c(C3[5]) * (xx - yy)],
        [three * c(C3[6]) * (xx - yy), -six * c(C3[6]) * x * y, o],
    ]
}

/// Which numbers of [`basis_gradient`] are not 0 everywhere.
pub(crate) const GRADIENT_TERMS: [[bool; 3]; MAX_COEFFS] = {
    const XYZ: [bool; 3] = [true; 3];
    const XY: [bool; 3] = [true, true, false];
    const YZ: [bool; 3] = [false, true, true];
    const XZ: [bool; 3] = [true, false, true];
    let (none, x, y, z) = ([false; 3], [true, false, false], [false, true, false], [false, false, true]);
    [none, y, z, x, XY, YZ, XYZ, XZ, XY, XY, XYZ, XYZ, XYZ, XYZ, XYZ, XY]
};

/// Colour max(0, Σ_k Y_k(d) f_k + ½) of a Gaussian seen along unit direction `d`.
///
/// Shapes: coefficients [K, 3] with K one of 1, 4, 9, 16 → rgb.
pub(crate) fn evaluate<F: Real>(coeffs: &[[F; 3]], d: [F; 3]) -> [F; 3] {
    let y = basis(d);
    let mut rgb = [F::of(COLOR_OFFSET); 3];
    for (f, y) in coeffs.iter().zip(y) {
        for c in 0..3 {
            rgb[c] += y * f[c];
        }
    }
    rgb.map(|v| v.max(F::ZERO))
}

/// VJP of [`evaluate`]: writes d_coeffs [K, 3] and returns the gradient to the direction (not yet made tangential: see
/// [`direction_backward`]). A channel that was clamped at 0 passes nothing.
#[cfg(test)]
pub(crate) fn evaluate_backward<F: Real>(
    coeffs: &[[F; 3]],
    d: [F; 3],
    d_rgb: [F; 3],
    d_coeffs: &mut [[F; 3]],
) -> [F; 3] {
    let (y, dy, rgb) = (basis(d), basis_gradient(d), evaluate(coeffs, d));
    let v: [F; 3] = std::array::from_fn(|c| if rgb[c] > F::ZERO { d_rgb[c] } else { F::ZERO });
    let mut d_dir = [F::ZERO; 3];
    for k in 0..coeffs.len().min(MAX_COEFFS) {
        let along = coeffs[k][0] * v[0] + coeffs[k][1] * v[1] + coeffs[k][2] * v[2];
        for c in 0..3 {
            d_coeffs[k][c] = y[k] * v[c];
            d_dir[c] += dy[k][c] * along;
        }
    }
    d_dir
}

/// Gradient through d = v/‖v‖: (I − d dᵀ) d_dir / ‖v‖.
#[inline(always)]
pub(crate) fn direction_backward<F: Real>(d: [F; 3], inverse_length: F, d_dir: [F; 3]) -> [F; 3] {
    let along = d[0] * d_dir[0] + d[1] * d_dir[1] + d[2] * d_dir[2];
    std::array::from_fn(|k| (d_dir[k] - d[k] * along) * inverse_length)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    fn direction(rng: Rng, i: u64) -> [f64; 3] {
        let v: [f64; 3] = std::array::from_fn(|k| rng.fork(i).normal(k as u64));
        crate::math::se3::normalize(v)
    }

    #[test]
    fn basis_is_orthonormal() {
        // Gauss-Legendre would be exact; 200k random directions leave about 1/√n.
        let (rng, n) = (Rng::new(5, "sh", 0), 200_000u64);
        let mut gram = [[0.0; MAX_COEFFS]; MAX_COEFFS];
        for i in 0..n {
            let y = basis(direction(rng, i));
            for a in 0..MAX_COEFFS {
                for b in 0..MAX_COEFFS {
                    gram[a][b] += y[a] * y[b] * 4.0 * std::f64::consts::PI / n as f64;
                }
            }
        }
        for (a, row) in gram.iter().enumerate() {
            for (b, v) in row.iter().enumerate() {
                let truth = f64::from(u8::from(a == b));
                assert!((v - truth).abs() < 0.02, "∫ Y{a} Y{b} = {v}");
            }
        }
    }

    #[test]
    fn gradient_terms_are_those_that_are_not_zero() {
        let gradient = basis_gradient([0.3, -0.5, 0.8]);
        for (terms, gradient) in GRADIENT_TERMS.iter().zip(gradient) {
            assert_eq!(*terms, gradient.map(|v| v != 0.0));
        }
    }

    #[test]
    fn gradients_equal_finite_differences() {
        let rng = Rng::new(6, "sh gradient", 0);
        for i in 0..10u64 {
            let r = rng.fork(100 + i);
            let coeffs: [[f64; 3]; 16] =
                std::array::from_fn(|k| std::array::from_fn(|c| 0.3 * r.normal((3 * k + c) as u64)));
            let w: [f64; 3] = std::array::from_fn(|c| r.normal(60 + c as u64));
            let v: [f64; 3] = std::array::from_fn(|k| r.normal(70 + k as u64));
            let loss = |f: &[[f64; 3]; 16], v: [f64; 3]| {
                let c = evaluate(f, crate::math::se3::normalize(v));
                c[0] * w[0] + c[1] * w[1] + c[2] * w[2]
            };
            let (d, inverse) = (crate::math::se3::normalize(v), 1.0 / crate::math::se3::norm(v));
            let mut d_coeffs = [[0.0; 3]; 16];
            let d_dir = evaluate_backward(&coeffs, d, w, &mut d_coeffs);
            let d_v = direction_backward(d, inverse, d_dir);
            for k in 0..3 {
                let (mut up, mut down) = (v, v);
                up[k] += 1e-6;
                down[k] -= 1e-6;
                let fd = (loss(&coeffs, up) - loss(&coeffs, down)) / 2e-6;
                assert!((fd - d_v[k]).abs() < 1e-7 * (1.0 + fd.abs()), "direction {k}: {fd} {}", d_v[k]);
            }
            for k in 0..16 {
                for c in 0..3 {
                    let (mut up, mut down) = (coeffs, coeffs);
                    up[k][c] += 1e-6;
                    down[k][c] -= 1e-6;
                    let fd = (loss(&up, v) - loss(&down, v)) / 2e-6;
                    assert!((fd - d_coeffs[k][c]).abs() < 1e-7 * (1.0 + fd.abs()), "coefficient {k} {c}");
                }
            }
        }
    }

    #[test]
    fn dc_round_trip_and_clamp() {
        assert!((dc_to_rgb(rgb_to_dc(0.8f64)) - 0.8).abs() < 1e-15);
        assert_eq!(evaluate(&[[-9.0f64, 0.0, 9.0]], [0.0, 0.0, 1.0])[0], 0.0);
        let mut d = [[1.0; 3]];
        evaluate_backward(&[[-9.0f64, 0.0, 9.0]], [0.0, 0.0, 1.0], [1.0; 3], &mut d);
        assert!(d[0][0] == 0.0 && d[0][1] > 0.0, "a clamped channel passes no gradient");
    }
}
