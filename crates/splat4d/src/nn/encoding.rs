//! Positional encoding γ_L(p) = [p, sin(2^k p), cos(2^k p)]_{k<L}, without a factor π.
//!
//! Source: Mildenhall et al. 2020 (NeRF) §5.1; with the raw input and without π as Yang et al. 2024 (Deformable 3D
//! Gaussians). Sines of doubled angles are computed from the previous angle, which loses a bit per level: 3e-5 in f32
//! at level 10, the precision of 2^9·p in f32.

use crate::math::Real;

/// More levels than any precision could resolve; files with more are refused.
pub(crate) const MAX_LEVELS: usize = 24;

/// Numbers that [`encode`] makes of `inputs` numbers: inputs·(2·levels + 1).
pub(crate) fn encoded(inputs: usize, levels: usize) -> usize {
    inputs * (2 * levels + 1)
}

/// γ_L of one point: x \[d\] → out [d·(2L + 1)], level after level: raw, sin of all d, cos of all d.
///
/// Panics: `out` has another length.
#[inline]
pub(crate) fn encode<F: Real>(x: &[F], levels: usize, out: &mut [F]) {
    let d = x.len();
    assert_eq!(out.len(), encoded(d, levels), "an encoding of {d} numbers to {levels} levels needs its own length");
    out[..d].copy_from_slice(x);
    for (i, x) in x.iter().enumerate() {
        let (mut s, mut c) = (x.sin(), x.cos());
        for level in out[d..].chunks_exact_mut((2 * d).max(1)) {
            (level[i], level[d + i]) = (s, c);
            (s, c) = (F::TWO * s * c, F::ONE - F::TWO * s * s);
        }
    }
}

/// VJP of [`encode`] at x: overwrites d_x \[d\] with Σ d_out·∂γ/∂x.
///
/// d sin(2^k x) = 2^k cos(2^k x) dx, d cos(2^k x) = −2^k sin(2^k x) dx. Panics: lengths differ.
#[inline]
pub(crate) fn encode_backward<F: Real>(x: &[F], levels: usize, d_out: &[F], d_x: &mut [F]) {
    let d = x.len();
    assert_eq!((d_x.len(), d_out.len()), (d, encoded(d, levels)), "a gradient has the shape of its value");
    d_x.copy_from_slice(&d_out[..d]);
    for (i, x) in x.iter().enumerate() {
        let (mut s, mut c, mut factor) = (x.sin(), x.cos(), F::ONE);
        for level in d_out[d..].chunks_exact((2 * d).max(1)) {
            d_x[i] += factor * (c * level[i] - s * level[d + i]);
            (s, c) = (F::TWO * s * c, F::ONE - F::TWO * s * s);
            factor *= F::TWO;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_equal_the_definition() {
        let mut out = vec![9.0f64; encoded(1, 2)];
        encode(&[0.0], 2, &mut out);
        assert_eq!(out, [0.0, 0.0, 1.0, 0.0, 1.0]);
        assert_eq!((encoded(3, 10), encoded(1, 10), encoded(1, 6)), (63, 21, 13));
        let x = [0.25f64, -1.3, 2.0];
        let mut out = vec![0.0; 63];
        encode(&x, 10, &mut out);
        for k in 0..10 {
            for i in 0..3 {
                let angle = f64::from(1 << k) * x[i];
                assert!((out[3 + 6 * k + i] - angle.sin()).abs() < 1e-12, "level {k}");
                assert!((out[6 + 6 * k + i] - angle.cos()).abs() < 1e-12, "level {k}");
            }
        }
        let (single, mut short) = (x.map(|x| x as f32), vec![0.0f32; 63]);
        encode(&single, 10, &mut short);
        let worst = out.iter().zip(&short).map(|(a, b)| (a - f64::from(*b)).abs()).fold(0.0, f64::max);
        assert!(worst < 2e-4, "f32 is off by {worst}");
    }

    #[test]
    fn gradient_equals_finite_differences() {
        let x = [0.3f64, -0.8];
        let weights: Vec<f64> = (0..encoded(2, 5)).map(|i| (i as f64 * 0.7).sin()).collect();
        let value = |x: &[f64]| {
            let mut out = vec![0.0; encoded(2, 5)];
            encode(x, 5, &mut out);
            out.iter().zip(&weights).map(|(a, b)| a * b).sum::<f64>()
        };
        let mut d_x = [7.0; 2];
        encode_backward(&x, 5, &weights, &mut d_x);
        for i in 0..2 {
            let (mut up, mut down) = (x, x);
            up[i] += 1e-6;
            down[i] -= 1e-6;
            let fd = (value(&up) - value(&down)) / 2e-6;
            assert!((fd - d_x[i]).abs() < 1e-7 * fd.abs().max(1.0), "{fd} {}", d_x[i]);
        }
    }
}
