//! Symmetric 3x3 matrices as six numbers (xx, xy, xz, yy, yz, zz).

use super::jacobi::jacobi;
use super::{Real, quat};

/// Covariance Σ = R S S Rᵀ of a raw quaternion (wxyz) and log scales.
///
/// Source: Kerbl et al. 2023, equation 6.
#[inline(always)]
pub fn from_quat_log_scales<F: Real>(q: [F; 4], log_scales: [F; 3]) -> [F; 6] {
    let r = quat::to_rotation(quat::normalize(q).0);
    let s2: [F; 3] = std::array::from_fn(|k| {
        let s = log_scales[k].exp();
        s * s
    });
    let entry = |i: usize, j: usize| r[i][0] * r[j][0] * s2[0] + r[i][1] * r[j][1] * s2[1] + r[i][2] * r[j][2] * s2[2];
    [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)]
}

/// VJP of [`from_quat_log_scales`]: (d_quat, d_log_scales).
///
/// `d_cov` is the gradient to the six packed numbers, so that an off-diagonal holds the sum over both of its positions.
#[inline(always)]
pub(crate) fn from_quat_log_scales_backward<F: Real>(q: [F; 4], log_scales: [F; 3], d_cov: [F; 6]) -> ([F; 4], [F; 3]) {
    let (unit, norm) = quat::normalize(q);
    let r = quat::to_rotation(unit);
    let s: [F; 3] = std::array::from_fn(|k| log_scales[k].exp());
    // Full symmetric gradient G; then with M = R S: dL/dM = 2 G M.
    let h = F::HALF;
    let g = [
        [d_cov[0], h * d_cov[1], h * d_cov[2]],
        [h * d_cov[1], d_cov[3], h * d_cov[4]],
        [h * d_cov[2], h * d_cov[4], d_cov[5]],
    ];
    let mut d_r = [[F::ZERO; 3]; 3];
    let mut d_log = [F::ZERO; 3];
    for k in 0..3 {
        let m = [r[0][k] * s[k], r[1][k] * s[k], r[2][k] * s[k]];
        let mut d_s = F::ZERO;
        for i in 0..3 {
            let d_m = F::TWO * (g[i][0] * m[0] + g[i][1] * m[1] + g[i][2] * m[2]);
            d_s += r[i][k] * d_m;
            d_r[i][k] = s[k] * d_m;
        }
        d_log[k] = d_s * s[k];
    }
    (quat::normalize_backward(unit, norm, quat::to_rotation_backward(unit, d_r)), d_log)
}

/// Sweeps of the Jacobi iteration, at most: far more than 3x3 needs.
const SWEEPS: usize = 10;
/// An entry off the diagonal below this turns nothing.
const NEGLIGIBLE: f64 = 1e-300;

/// Eigenvalues (descending) and unit eigenvectors (columns, a right-handed frame) by cyclic Jacobi rotations.
pub fn eigen(m: [f64; 6]) -> ([f64; 3], [[f64; 3]; 3]) {
    let full = [[m[0], m[1], m[2]], [m[1], m[3], m[4]], [m[2], m[4], m[5]]];
    let (a, v) = jacobi(full, SWEEPS, |x, _| x.abs() < NEGLIGIBLE);
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| a[j].total_cmp(&a[i]));
    let mut vectors: [[f64; 3]; 3] = std::array::from_fn(|r| std::array::from_fn(|c| v[r][order[c]]));
    let pose = super::Se3 { rotation: vectors, translation: [0.0; 3] };
    if pose.det() < 0.0 {
        for row in &mut vectors {
            row[2] = -row[2];
        }
    }
    (order.map(|i| a[i]), vectors)
}

/// The largest eigenvalue, in closed form: some thirty times faster than [`eigen`].
///
/// Source: Smith 1961, "Eigenvalues of a symmetric 3x3 matrix".
pub fn largest(m: [f64; 6]) -> f64 {
    let [xx, xy, xz, yy, yz, zz] = m;
    let mean = (xx + yy + zz) / 3.0;
    let (a, b, c) = (xx - mean, yy - mean, zz - mean);
    let off = xy * xy + xz * xz + yz * yz;
    let p = ((a * a + b * b + c * c + 2.0 * off) / 6.0).sqrt();
    if p == 0.0 {
        return mean;
    }
    let det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz);
    let angle = (0.5 * det / (p * p * p)).clamp(-1.0, 1.0).acos() / 3.0;
    mean + 2.0 * p * angle.cos()
}

/// A unit quaternion and log scales with this covariance: from any activated Gaussian to a learnable one.
///
/// Eigenvalues below `floor²` are lifted to it.
pub fn to_quat_log_scales(cov: [f64; 6], floor: f64) -> ([f64; 4], [f64; 3]) {
    let (values, vectors) = eigen(cov);
    (quat::from_rotation(&vectors), values.map(|v| 0.5 * v.max(floor * floor).ln()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    #[test]
    fn covariance_gradient_equals_finite_differences() {
        let rng = Rng::new(2, "cov", 0);
        for i in 0..20u64 {
            let x: [f64; 7] = std::array::from_fn(|k| rng.fork(i).normal(k as u64));
            let w: [f64; 6] = std::array::from_fn(|k| rng.fork(i).normal(k as u64 + 20));
            let cov = |x: &[f64; 7]| from_quat_log_scales([x[0], x[1], x[2], x[3]], [x[4], x[5], x[6]]);
            let loss = |x: &[f64; 7]| cov(x).iter().zip(w).map(|(c, w)| c * w).sum::<f64>();
            let (dq, ds) = from_quat_log_scales_backward([x[0], x[1], x[2], x[3]], [x[4], x[5], x[6]], w);
            let grad = [dq[0], dq[1], dq[2], dq[3], ds[0], ds[1], ds[2]];
            for k in 0..7 {
                let (mut up, mut down) = (x, x);
                up[k] += 1e-6;
                down[k] -= 1e-6;
                let fd = (loss(&up) - loss(&down)) / 2e-6;
                assert!((fd - grad[k]).abs() < 1e-6 * (1.0 + fd.abs()), "{k}: {fd} {}", grad[k]);
            }
        }
    }

    #[test]
    fn closed_form_of_the_largest_eigenvalue_equals_the_iteration() {
        let rng = Rng::new(4, "largest", 0);
        for i in 0..200u64 {
            let x: [f64; 7] = std::array::from_fn(|k| 2.0 * rng.fork(i).normal(k as u64));
            let cov = from_quat_log_scales([x[0], x[1], x[2], x[3]], [x[4], x[5], x[6]]);
            let truth = eigen(cov).0[0];
            assert!((largest(cov) / truth - 1.0).abs() < 1e-12, "{cov:?}: {} {truth}", largest(cov));
        }
        assert_eq!([largest([2.0, 0.0, 0.0, 2.0, 0.0, 2.0]), largest([0.0; 6])], [2.0, 0.0]);
    }

    #[test]
    fn decomposition_rebuilds_the_covariance() {
        let rng = Rng::new(3, "eigen", 0);
        for i in 0..50u64 {
            let x: [f64; 7] = std::array::from_fn(|k| rng.fork(i).normal(k as u64));
            let cov = from_quat_log_scales([x[0], x[1], x[2], x[3]], [x[4], x[5], x[6]]);
            let (q, s) = to_quat_log_scales(cov, 1e-9);
            let back = from_quat_log_scales(q, s);
            for k in 0..6 {
                assert!((cov[k] - back[k]).abs() < 1e-9 * (1.0 + cov[0] + cov[3] + cov[5]), "{cov:?} {back:?}");
            }
        }
    }
}
