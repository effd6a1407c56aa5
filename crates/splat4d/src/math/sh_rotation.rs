//! Rotation of spherical harmonics: which coefficients show the same colours when a Gaussian is turned.
//!
//! Turned by R, a function f of directions becomes g(d) = f(Rᵀd). Its coefficients are inner products of g with the basis,
//! and a product quadrature computes those exactly, so that no table of Wigner matrices is needed.

use super::sh::{MAX_COEFFS, basis};

/// Nodes of the Gauss-Legendre rule of four points on [-1, 1], exact to degree 7 (Abramowitz and Stegun, table 25.4).
const NODES: [f64; 4] =
    [-0.861_136_311_594_052_6, -0.339_981_043_584_856_3, 0.339_981_043_584_856_3, 0.861_136_311_594_052_6];
/// Weights of [`NODES`].
const WEIGHTS: [f64; 4] =
    [0.347_854_845_137_453_9, 0.652_145_154_862_546_1, 0.652_145_154_862_546_1, 0.347_854_845_137_453_9];
/// Equally spaced azimuths: exact for trigonometric polynomials of degree 7. A product of two basis functions has 6.
const AZIMUTHS: usize = 8;

/// M with c' = M c: the coefficients (one channel, in the order of [`basis`]) after a turn by the rotation `r` (rows).
/// Orthogonal, and a block a degree: lower degrees turn by its upper left part.
pub(crate) fn sh_rotation(r: &[[f64; 3]; 3]) -> [[f64; MAX_COEFFS]; MAX_COEFFS] {
    let mut m = [[0.0; MAX_COEFFS]; MAX_COEFFS];
    for (z, weight) in NODES.into_iter().zip(WEIGHTS) {
        let across = (1.0 - z * z).sqrt();
        for i in 0..AZIMUTHS {
            let angle = std::f64::consts::TAU * i as f64 / AZIMUTHS as f64;
            let d = [across * angle.cos(), across * angle.sin(), z];
            let back = std::array::from_fn(|k| r[0][k] * d[0] + r[1][k] * d[1] + r[2][k] * d[2]);
            let (here, there) = (basis(d), basis(back));
            let area = weight * std::f64::consts::TAU / AZIMUTHS as f64;
            for a in 0..MAX_COEFFS {
                for b in 0..MAX_COEFFS {
                    m[a][b] += area * here[a] * there[b];
                }
            }
        }
    }
    m
}

/// Rotates the coefficients of one Gaussian by the matrix of [`sh_rotation`]: `block` holds coefficient k of channel c at
/// 3k + c. Degree 0 is the same from everywhere; its bits stay.
pub(crate) fn rotate_coefficients(m: &[[f64; MAX_COEFFS]; MAX_COEFFS], block: &mut [f32]) {
    let count = (block.len() / 3).min(MAX_COEFFS);
    for c in 0..3 {
        let old: [f64; MAX_COEFFS] = std::array::from_fn(|k| if k < count { f64::from(block[3 * k + c]) } else { 0.0 });
        for k in 1..count {
            block[3 * k + c] = (0..count).map(|l| m[k][l] * old[l]).sum::<f64>() as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::{Rng, quat, se3};

    #[test]
    fn turned_coefficients_show_the_same_colours_in_turned_directions() {
        let rng = Rng::new(8, "sh turn", 0);
        for i in 0..20u64 {
            let r = quat::to_rotation(quat::normalize(std::array::from_fn(|k| rng.fork(i).normal(k as u64))).0);
            let c: [f64; MAX_COEFFS] = std::array::from_fn(|k| rng.fork(i).normal(9 + k as u64));
            let m = sh_rotation(&r);
            let turned: [f64; MAX_COEFFS] = std::array::from_fn(|a| (0..MAX_COEFFS).map(|b| m[a][b] * c[b]).sum());
            for j in 0..50u64 {
                let d = se3::normalize(std::array::from_fn(|k| rng.fork(i).fork(j).normal(k as u64)));
                let there: [f64; 3] = std::array::from_fn(|k| (0..3).map(|l| r[k][l] * d[l]).sum());
                let dot = |c: &[f64], d| -> f64 { c.iter().zip(basis(d)).map(|(c, y)| c * y).sum() };
                assert!((dot(&c, d) - dot(&turned, there)).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn degrees_do_not_mix() {
        let m = sh_rotation(&quat::to_rotation(quat::normalize([0.3, -0.5, 0.7, 0.1]).0));
        let degree = |k: usize| k.isqrt();
        for a in 0..MAX_COEFFS {
            for b in 0..MAX_COEFFS {
                assert!(degree(a) == degree(b) || m[a][b].abs() < 1e-14, "{a} {b}: {}", m[a][b]);
            }
        }
    }
}
