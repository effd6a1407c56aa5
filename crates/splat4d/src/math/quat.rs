//! Quaternions (w, x, y, z): raw ones are learnt, and normalised on use.

use super::Real;

/// |q| below this is treated as the identity rotation, so that no NaN is born.
const TINY_NORM: f64 = 1e-12;

/// q/|q| and |q|. A zero quaternion gives the identity and norm 0 (its gradient is then zero).
#[inline(always)]
pub fn normalize<F: Real>(q: [F; 4]) -> ([F; 4], F) {
    let n = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
    if n > F::of(TINY_NORM) {
        let r = F::ONE / n;
        ([q[0] * r, q[1] * r, q[2] * r, q[3] * r], n)
    } else {
        ([F::ONE, F::ZERO, F::ZERO, F::ZERO], F::ZERO)
    }
}

/// VJP of [`normalize`]: (g − q̂ (q̂·g)) / |q|.
#[inline(always)]
pub fn normalize_backward<F: Real>(unit: [F; 4], norm: F, d_unit: [F; 4]) -> [F; 4] {
    if norm == F::ZERO {
        return [F::ZERO; 4];
    }
    let along = unit[0] * d_unit[0] + unit[1] * d_unit[1] + unit[2] * d_unit[2] + unit[3] * d_unit[3];
    std::array::from_fn(|i| (d_unit[i] - unit[i] * along) / norm)
}

/// The raw quaternion q of a shape after a rotation: rotation ⊗ q, rounded once. A zero q represents the identity
/// wherever it is used, and rotates as the identity does.
pub(crate) fn rotated<F: Real>(rotation: [f64; 4], q: [F; 4]) -> [F; 4] {
    let q = if q == [F::ZERO; 4] { [1.0, 0.0, 0.0, 0.0] } else { q.map(|x| x.f64()) };
    product(rotation, q).map(F::of)
}

/// Hamilton's product a ⊗ b: of rotations, first b, then a.
#[inline(always)]
pub fn product<F: Real>(a: [F; 4], b: [F; 4]) -> [F; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// The conjugate: of a unit quaternion the inverse.
#[inline(always)]
pub fn conjugate<F: Real>(q: [F; 4]) -> [F; 4] {
    [q[0], -q[1], -q[2], -q[3]]
}

/// Rotation matrix (rows) of a unit quaternion.
#[inline(always)]
pub fn to_rotation<F: Real>([w, x, y, z]: [F; 4]) -> [[F; 3]; 3] {
    let two = F::TWO;
    let one = F::ONE;
    [
        [one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)],
    ]
}

/// VJP of [`to_rotation`].
#[inline(always)]
pub fn to_rotation_backward<F: Real>([w, x, y, z]: [F; 4], d: [[F; 3]; 3]) -> [F; 4] {
    let two = F::TWO;
    [
        two * (x * (d[2][1] - d[1][2]) + y * (d[0][2] - d[2][0]) + z * (d[1][0] - d[0][1])),
        two * (w * (d[2][1] - d[1][2]) + y * (d[0][1] + d[1][0]) + z * (d[0][2] + d[2][0])
            - two * x * (d[1][1] + d[2][2])),
        two * (w * (d[0][2] - d[2][0]) + x * (d[0][1] + d[1][0]) + z * (d[1][2] + d[2][1])
            - two * y * (d[0][0] + d[2][2])),
        two * (w * (d[1][0] - d[0][1]) + x * (d[0][2] + d[2][0]) + y * (d[1][2] + d[2][1])
            - two * z * (d[0][0] + d[1][1])),
    ]
}

/// The unit quaternion of a rotation matrix (Shepperd's branch on the largest component).
pub fn from_rotation(r: &[[f64; 3]; 3]) -> [f64; 4] {
    let trace = r[0][0] + r[1][1] + r[2][2];
    let q = if trace > 0.0 {
        [1.0 + trace, r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]]
    } else if r[0][0] >= r[1][1] && r[0][0] >= r[2][2] {
        [r[2][1] - r[1][2], 1.0 + r[0][0] - r[1][1] - r[2][2], r[0][1] + r[1][0], r[0][2] + r[2][0]]
    } else if r[1][1] >= r[2][2] {
        [r[0][2] - r[2][0], r[0][1] + r[1][0], 1.0 - r[0][0] + r[1][1] - r[2][2], r[1][2] + r[2][1]]
    } else {
        [r[1][0] - r[0][1], r[0][2] + r[2][0], r[1][2] + r[2][1], 1.0 - r[0][0] - r[1][1] + r[2][2]]
    };
    normalize(q).0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    fn random(i: u64) -> [f64; 4] {
        std::array::from_fn(|k| Rng::new(5, "quat", i).normal(k as u64))
    }

    #[test]
    fn rotation_is_a_rotation_and_converts_back() {
        for i in 0..100 {
            let (q, _) = normalize(random(i));
            let r = to_rotation(q);
            let pose = crate::math::Se3 { rotation: r, translation: [0.0; 3] };
            assert!(pose.orthogonality_error() < 1e-12 && (pose.det() - 1.0).abs() < 1e-12);
            let back = from_rotation(&r);
            let dot: f64 = (0..4).map(|k| q[k] * back[k]).sum();
            assert!((dot.abs() - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn gradient_equals_finite_differences_and_is_orthogonal_to_q() {
        for i in 0..20 {
            let q = random(i);
            let weights: [[f64; 3]; 3] =
                std::array::from_fn(|a| std::array::from_fn(|b| (a * 3 + b) as f64 * 0.37 - 1.0));
            let loss = |q: [f64; 4]| {
                let r = to_rotation(normalize(q).0);
                (0..9).map(|k| r[k / 3][k % 3].powi(2) * weights[k / 3][k % 3]).sum::<f64>()
            };
            let (unit, norm) = normalize(q);
            let r = to_rotation(unit);
            let d_r = std::array::from_fn(|a| std::array::from_fn(|b| 2.0 * r[a][b] * weights[a][b]));
            let grad = normalize_backward(unit, norm, to_rotation_backward(unit, d_r));
            for k in 0..4 {
                let h = 1e-6;
                let (mut up, mut down) = (q, q);
                up[k] += h;
                down[k] -= h;
                let fd = (loss(up) - loss(down)) / (2.0 * h);
                assert!((fd - grad[k]).abs() < 1e-7 * (1.0 + fd.abs()), "{fd} {}", grad[k]);
            }
            assert!((0..4).map(|k| q[k] * grad[k]).sum::<f64>().abs() < 1e-10);
        }
    }

    #[test]
    fn zero_quaternion_is_the_identity_without_gradient() {
        let (q, n) = normalize([0.0f32; 4]);
        assert_eq!((q, n), ([1.0, 0.0, 0.0, 0.0], 0.0));
        assert_eq!(normalize_backward(q, n, [1.0; 4]), [0.0; 4]);
    }
}
