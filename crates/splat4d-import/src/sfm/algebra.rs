//! Small linear algebra: roots of polynomials, null spaces, triangular factors, singular values of 3x3 matrices.

use splat4d::math::jacobi::jacobi;
use splat4d::math::se3::{cross, dot, mat_mul, mat_vec, normalize, transpose};

/// Rows of a 3x3 matrix.
pub(crate) type Mat3 = [[f64; 3]; 3];

/// The value of a polynomial, lowest coefficient first.
pub(crate) fn value(p: &[f64], x: f64) -> f64 {
    p.iter().rev().fold(0.0, |sum, c| sum * x + c)
}

fn derivative(p: &[f64]) -> Vec<f64> {
    p.iter().enumerate().skip(1).map(|(k, c)| k as f64 * c).collect()
}

/// The real roots of a polynomial (lowest coefficient first), ascending. A root where the curve only touches zero may
/// be missing or duplicate.
///
/// Between two neighbouring extrema a polynomial has at most one root, and the extrema are the roots of the derivative.
pub(crate) fn roots(p: &[f64]) -> Vec<f64> {
    /// Of the largest coefficient: what is less leads nothing.
    const NOTHING: f64 = 1e-14;
    let largest = p.iter().fold(0.0f64, |m, c| m.max(c.abs()));
    if largest == 0.0 || !largest.is_finite() {
        return Vec::new();
    }
    let mut p: Vec<f64> = p.iter().map(|c| c / largest).collect();
    while p.last().is_some_and(|c| c.abs() < NOTHING) {
        p.pop();
    }
    if p.len() < 2 {
        return Vec::new();
    }
    if p.len() == 2 {
        return vec![-p[0] / p[1]];
    }
    // All roots are within (Cauchy's bound).
    let lead = p[p.len() - 1].abs();
    let bound = 1.0 + p[..p.len() - 1].iter().fold(0.0f64, |m, c| m.max(c.abs())) / lead;
    let slope = derivative(&p);
    let mut ends = vec![-bound];
    ends.extend(roots(&slope));
    ends.push(bound);
    let mut out = Vec::new();
    for pair in ends.windows(2) {
        let (mut low, mut high) = (pair[0], pair[1]);
        let (at_low, at_high) = (value(&p, low), value(&p, high));
        if at_low == 0.0 {
            out.push(low);
            continue;
        }
        if at_low.signum() == at_high.signum() {
            continue;
        }
        let mut x = 0.5 * (low + high);
        for _ in 0..STEPS {
            let v = value(&p, x);
            if v == 0.0 {
                break;
            }
            if v.signum() == at_low.signum() {
                low = x
            } else {
                high = x
            }
            // Newton where it stays inside, else the middle.
            let next = x - v / value(&slope, x);
            let next = if next > low && next < high { next } else { 0.5 * (low + high) };
            if (next - x).abs() <= f64::EPSILON * x.abs() {
                x = next;
                break;
            }
            x = next;
        }
        out.push(x);
    }
    out
}

/// Steps towards a root, at most: bisection alone would reach the last bit.
const STEPS: usize = 80;

/// The product of two polynomials.
pub(crate) fn multiply(a: &[f64], b: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; a.len() + b.len() - 1];
    for (i, x) in a.iter().enumerate() {
        b.iter().enumerate().for_each(|(k, y)| out[i + k] += x * y);
    }
    out
}

/// `a + factor·b`
pub(crate) fn add(a: &[f64], factor: f64, b: &[f64]) -> Vec<f64> {
    let at = |p: &[f64], k: usize| p.get(k).copied().unwrap_or(0.0);
    (0..a.len().max(b.len())).map(|k| at(a, k) + factor * at(b, k)).collect()
}

/// The reduced row echelon form of a matrix whose first columns, as many as it has rows, are regular; by Gauss-Jordan
/// elimination with row pivots. False: they are singular.
pub(crate) fn eliminate(rows: &mut [Vec<f64>]) -> bool {
    /// Of the largest entry.
    const SINGULAR: f64 = 1e-14;
    let n = rows.len();
    let largest = rows.iter().flatten().fold(0.0f64, |m, v| m.max(v.abs()));
    for k in 0..n {
        let best = (k..n).fold(k, |b, i| if rows[i][k].abs() > rows[b][k].abs() { i } else { b });
        rows.swap(k, best);
        let pivot = rows[k][k];
        if pivot.abs() <= SINGULAR * largest || !pivot.is_finite() {
            return false;
        }
        rows[k].iter_mut().for_each(|v| *v /= pivot);
        let row = rows[k].clone();
        for (i, other) in rows.iter_mut().enumerate() {
            let factor = other[k];
            if i != k && factor != 0.0 {
                other.iter_mut().zip(&row).for_each(|(o, r)| *o -= factor * r);
            }
        }
    }
    true
}

/// An orthonormal basis of the vectors of nine numbers that all `rows` (independent, at most eight) are at right angles
/// to; by Householder reflections.
pub(crate) fn null_space(rows: &[[f64; 9]]) -> Vec<[f64; 9]> {
    // Reflections that turn the rows' span into the first axes; the other axes, turned back, are the null space.
    let mut turned: Vec<[f64; 9]> = rows.to_vec();
    let mut mirrors: Vec<[f64; 9]> = Vec::new();
    let reflect = |v: &mut [f64; 9], m: &[f64; 9]| {
        let along: f64 = 2.0 * v.iter().zip(m).map(|(a, b)| a * b).sum::<f64>();
        v.iter_mut().zip(m).for_each(|(a, b)| *a -= along * b);
    };
    for k in 0..rows.len() {
        // The longest remaining one is first.
        let left = |v: &[f64; 9]| v[k..].iter().map(|x| x * x).sum::<f64>();
        let best = (k..rows.len()).fold(k, |b, i| if left(&turned[i]) > left(&turned[b]) { i } else { b });
        turned.swap(k, best);
        let mut m = [0.0; 9];
        m[k..].copy_from_slice(&turned[k][k..]);
        m[k] += left(&turned[k]).sqrt().copysign(m[k]);
        let length = m.iter().map(|x| x * x).sum::<f64>().sqrt();
        if length == 0.0 {
            continue;
        }
        m.iter_mut().for_each(|x| *x /= length);
        turned.iter_mut().for_each(|v| reflect(v, &m));
        mirrors.push(m);
    }
    let axis = |k: usize| {
        let mut v = [0.0; 9];
        v[k] = 1.0;
        mirrors.iter().rev().for_each(|m| reflect(&mut v, m));
        v
    };
    (rows.len()..9).map(axis).collect()
}

/// The unit vector of nine numbers that a symmetric matrix lengthens least.
pub(crate) fn least_vector(a: [[f64; 9]; 9]) -> [f64; 9] {
    let (values, vectors) = eigen(a);
    let least = (1..9).fold(0, |best, k| if values[k] < values[best] { k } else { best });
    vectors.map(|row| row[least])
}

fn eigen<const N: usize>(a: [[f64; N]; N]) -> ([f64; N], [[f64; N]; N]) {
    /// Convergence is quadratic: far fewer are used.
    const SWEEPS: usize = 30;
    jacobi(a, SWEEPS, |x, [p, q]| x.abs() <= f64::EPSILON * (p.abs() * q.abs()).sqrt() || x.abs() < f64::MIN_POSITIVE)
}

/// Singular values of a 3x3 matrix, falling, with U and V (both of determinant +1; the last value may be negative for
/// it).
pub(crate) fn svd(m: &Mat3) -> (Mat3, [f64; 3], Mat3) {
    let (values, vectors) = eigen(mat_mul(&transpose(m), m));
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| values[b].total_cmp(&values[a]));
    let column = |k: usize| std::array::from_fn(|r| vectors[r][k]);
    let v0: [f64; 3] = column(order[0]);
    let v1: [f64; 3] = column(order[1]);
    let v2 = cross(v0, v1);
    let [a, b, c] = [v0, v1, v2].map(|v| mat_vec(m, v));
    let u0 = normalize(a);
    let mut rest: [f64; 3] = std::array::from_fn(|k| b[k] - dot(u0, b) * u0[k]);
    if dot(rest, rest) <= f64::MIN_POSITIVE {
        // Rank one: any direction at right angles.
        rest = cross(u0, if u0[0].abs() < 0.9 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] });
    }
    let u1 = normalize(rest);
    let u2 = cross(u0, u1);
    (transpose(&[u0, u1, u2]), [dot(u0, a), dot(u1, b), dot(u2, c)], transpose(&[v0, v1, v2]))
}

/// [v]×, with [v]× w = v × w.
pub(crate) fn skew(v: [f64; 3]) -> Mat3 {
    [[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]]
}

/// The rotation by |w| radians about w (Rodrigues).
pub(crate) fn rotation(w: [f64; 3]) -> Mat3 {
    let angle = dot(w, w).sqrt();
    let (a, b) = if angle < 1e-5 {
        // Of the series, exact to rounding.
        (1.0 - angle * angle / 6.0, 0.5 - angle * angle / 24.0)
    } else {
        (angle.sin() / angle, (1.0 - angle.cos()) / (angle * angle))
    };
    let k = skew(w);
    let kk = mat_mul(&k, &k);
    std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j)) + a * k[i][j] + b * kk[i][j]))
}

/// The same rotation with rows of length one at right angles: products lose them by rounding.
pub(crate) fn orthonormal(r: &Mat3) -> Mat3 {
    let x = normalize(r[0]);
    let z = normalize(cross(x, r[1]));
    [x, cross(z, x), z]
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    #[test]
    fn roots_of_a_product_are_those_of_its_factors() {
        let truth = [-3.0, -0.5, 0.1, 0.7, 2.0, 11.0];
        // And a factor without a real root.
        let p = truth.iter().fold(vec![1.0, 0.3, 2.0], |p, r| multiply(&p, &[-r, 1.0]));
        let found = roots(&p);
        assert_eq!(found.len(), truth.len());
        assert!(found.iter().zip(&truth).all(|(a, b)| (a - b).abs() < 1e-10), "{found:?}");
        assert!(roots(&[1.0, 0.0, 1.0]).is_empty() && roots(&[0.0, 0.0]).is_empty());
    }

    #[test]
    fn null_space_and_singular_values_satisfy_their_definitions() {
        let rng = Rng::new(1, "algebra", 0);
        let rows: Vec<[f64; 9]> = (0..5).map(|i| std::array::from_fn(|k| rng.normal((9 * i + k) as u64))).collect();
        let null = null_space(&rows);
        assert_eq!(null.len(), 4);
        for (i, n) in null.iter().enumerate() {
            let along = |v: &[f64; 9]| v.iter().zip(n).map(|(a, b)| a * b).sum::<f64>();
            assert!(rows.iter().all(|r| along(r).abs() < 1e-12));
            assert!(null.iter().enumerate().all(|(k, o)| (along(o) - f64::from(u8::from(i == k))).abs() < 1e-12));
        }
        let m: Mat3 = std::array::from_fn(|i| std::array::from_fn(|k| rng.normal((100 + 3 * i + k) as u64)));
        let (u, s, v) = svd(&m);
        let us: Mat3 = std::array::from_fn(|i| std::array::from_fn(|k| u[i][k] * s[k]));
        let back = mat_mul(&us, &transpose(&v));
        assert!((0..9).all(|k| (back[k / 3][k % 3] - m[k / 3][k % 3]).abs() < 1e-12), "{back:?} {m:?}");
        assert!(s[0] >= s[1] && s[1] >= s[2].abs());
    }
}
