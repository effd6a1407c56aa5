//! General 3x3 matrices: equations, the rotation nearest to one.

use super::jacobi::jacobi;
use super::se3::{cross, dot, norm, transpose};
use super::{Real, quat};

/// Share of the matrix's size that is added along the identity, so that of several equally near rotations (points on a
/// line or at one point leave some free) the one that turns least is taken. Rounding of f64 is some thousand times
/// smaller, and the result elsewhere moves by no more than this.
const LEAST_TURN: f64 = 1e-12;
/// Sweeps of the Jacobi iteration, at most; it converges quadratically, four or five are usual for 4x4.
const SWEEPS: usize = 12;

/// Solves a x = b by Cramer's rule; `None` where a is nearly singular, whatever its unit.
pub fn solve(a: [[f64; 3]; 3], b: [f64; 3]) -> Option<[f64; 3]> {
    /// Of the product of the rows' lengths, which the determinant reaches where rows are at right angles.
    const SINGULAR: f64 = 1e-12;
    let columns = transpose(&a);
    let det = dot(columns[0], cross(columns[1], columns[2]));
    let largest = a.iter().map(|&row| norm(row)).product::<f64>();
    if det.abs() <= SINGULAR * largest || det.is_nan() {
        return None;
    }
    Some([
        dot(b, cross(columns[1], columns[2])) / det,
        dot(columns[0], cross(b, columns[2])) / det,
        dot(columns[0], cross(columns[1], b)) / det,
    ])
}

/// The point nearest to several lines (least squares), each given by one of its points and its unit direction: the solution of
/// Σ (I − d dᵀ) x = Σ (I − d dᵀ) c. `None` where all are nearly parallel.
pub fn nearest_to_lines(lines: impl IntoIterator<Item = ([f64; 3], [f64; 3])>) -> Option<[f64; 3]> {
    let (mut a, mut b) = ([[0.0; 3]; 3], [0.0; 3]);
    for (c, d) in lines {
        for i in 0..3 {
            for j in 0..3 {
                let m = f64::from(u8::from(i == j)) - d[i] * d[j];
                a[i][j] += m;
                b[i] += m * c[j];
            }
        }
    }
    solve(a, b)
}

/// The rotation R (det +1, never a reflection) that maximises Σ_ij R_ij cov_ij, so that for cov = Σ w a bᵀ it minimises
/// Σ w ‖a − R b‖² (the orthogonal Procrustes or Wahba problem).
///
/// Points on a line or at one point leave a choice: of the nearest rotations it is the one that turns least; the zero
/// matrix gives the identity, and so does one that is not finite. Computed in f64: the unit quaternion of the largest
/// eigenvalue of Davenport's 4x4 matrix, by cyclic Jacobi rotations.
/// Source: Davenport 1968; Horn 1987, "Closed-form solution of absolute orientation using unit quaternions".
pub fn procrustes<F: Real>(cov: [[F; 3]; 3]) -> [[F; 3]; 3] {
    let mut b = cov.map(|row| row.map(F::f64));
    let size = b.as_flattened().iter().fold(0.0, |m: f64, x| m.max(x.abs()));
    let sound = b.as_flattened().iter().all(|x| x.is_finite());
    if !sound || size == 0.0 {
        return std::array::from_fn(|i| std::array::from_fn(|j| if i == j { F::ONE } else { F::ZERO }));
    }
    // Relative to its largest entry nothing below can overflow.
    b = b.map(|row| row.map(|x| x / size));
    (0..3).for_each(|k| b[k][k] += LEAST_TURN);
    let mut k = [[0.0; 4]; 4];
    k[0][0] = b[0][0] + b[1][1] + b[2][2];
    k[1][1] = b[0][0] - b[1][1] - b[2][2];
    k[2][2] = b[1][1] - b[0][0] - b[2][2];
    k[3][3] = b[2][2] - b[0][0] - b[1][1];
    (k[0][1], k[0][2], k[0][3]) = (b[2][1] - b[1][2], b[0][2] - b[2][0], b[1][0] - b[0][1]);
    (k[1][2], k[1][3], k[2][3]) = (b[0][1] + b[1][0], b[0][2] + b[2][0], b[1][2] + b[2][1]);
    for i in 1..4 {
        for j in 0..i {
            k[i][j] = k[j][i];
        }
    }
    quat::to_rotation(quat::normalize(top_eigenvector(k)).0).map(|row| row.map(F::of))
}

/// The unit eigenvector of the largest eigenvalue; the first of equals.
fn top_eigenvector(a: [[f64; 4]; 4]) -> [f64; 4] {
    // An entry that rounding cannot see next to both of its diagonal's does not turn anything.
    let negligible =
        |x: f64, [p, q]: [f64; 2]| x.abs() <= f64::EPSILON * 0.25 * p.abs().min(q.abs()) || x.abs() < 1e-300;
    let (values, vectors) = jacobi(a, SWEEPS, negligible);
    let best = (1..4).fold(0, |best, i| if values[i] > values[best] { i } else { best });
    vectors.map(|row| row[best])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::se3::{add, normalize, scale, sub};
    use crate::math::{Rng, Se3};

    fn random(purpose: &str, i: u64) -> [[f64; 3]; 3] {
        let rng = Rng::new(8, purpose, i);
        std::array::from_fn(|r| std::array::from_fn(|c| rng.normal((3 * r + c) as u64)))
    }

    fn turn(i: u64) -> [[f64; 3]; 3] {
        let rng = Rng::new(9, "turn", i);
        quat::to_rotation(quat::normalize(std::array::from_fn(|k| rng.normal(k as u64))).0)
    }

    fn gain(r: &[[f64; 3]; 3], cov: &[[f64; 3]; 3]) -> f64 {
        r.as_flattened().iter().zip(cov.as_flattened()).map(|(a, b)| a * b).sum()
    }

    fn is_rotation(r: [[f64; 3]; 3]) -> bool {
        let pose = Se3 { rotation: r, translation: [0.0; 3] };
        pose.orthogonality_error() < 1e-12 && (pose.det() - 1.0).abs() < 1e-12
    }

    #[test]
    fn no_point_is_nearer_to_lines() {
        let lines: Vec<_> = (0..5).map(|i| (random("lines", i)[0], normalize(random("lines", i)[1]))).collect();
        let off =
            |x: [f64; 3]| -> f64 { lines.iter().map(|&(c, d)| dot(cross(sub(x, c), d), cross(sub(x, c), d))).sum() };
        let x = nearest_to_lines(lines.iter().copied()).unwrap();
        for k in 0..6 {
            let mut near = x;
            near[k / 2] += if k % 2 == 0 { 1e-3 } else { -1e-3 };
            assert!(off(near) > off(x), "{near:?} is nearer than {x:?}");
        }
        let through = [0.3, -0.2, 0.9];
        let met = nearest_to_lines(lines.iter().map(|&(_, d)| (add(through, scale(d, 2.0)), d))).unwrap();
        assert!(norm(sub(met, through)) < 1e-12, "{met:?}");
        assert_eq!(nearest_to_lines(lines.iter().map(|&(c, _)| (c, [0.0, 0.6, 0.8]))), None);
    }

    #[test]
    fn no_rotation_is_nearer_also_to_a_reflection() {
        for i in 0..200 {
            let mut cov = random("cov", i);
            if i % 2 == 0 {
                // Mirrored: the nearest orthogonal matrix would be a reflection.
                cov[0] = cov[0].map(|x| -x);
            }
            let r = procrustes(cov);
            assert!(is_rotation(r), "{r:?}");
            let best = gain(&r, &cov);
            for j in 0..40 {
                let other = turn(1000 * i + j);
                assert!(gain(&other, &cov) <= best + 1e-12, "{cov:?}");
            }
            // Nor one close by.
            for axis in 0..6 {
                let mut q = [1.0, 0.0, 0.0, 0.0];
                q[1 + axis % 3] = if axis < 3 { 1e-3 } else { -1e-3 };
                let step = quat::to_rotation(quat::normalize(q).0);
                let near: [[f64; 3]; 3] =
                    std::array::from_fn(|a| std::array::from_fn(|b| (0..3).map(|k| step[a][k] * r[k][b]).sum()));
                assert!(gain(&near, &cov) <= best + 1e-12);
            }
        }
    }

    #[test]
    fn the_rotation_between_two_sets_of_points_is_found_exactly() {
        for i in 0..50 {
            let r = turn(i);
            let mut cov = [[0.0; 3]; 3];
            for p in 0..5 {
                let b = random("points", 10 * i + p)[0];
                let a: [f64; 3] = std::array::from_fn(|k| (0..3).map(|l| r[k][l] * b[l]).sum());
                (0..9).for_each(|k| cov[k / 3][k % 3] += a[k / 3] * b[k % 3]);
            }
            let got = procrustes(cov);
            let error =
                got.as_flattened().iter().zip(r.as_flattened()).fold(0.0, |m: f64, (a, b)| m.max((a - b).abs()));
            assert!(error < 1e-10, "{error}");
        }
    }

    #[test]
    fn an_ambiguous_rotation_is_the_smallest() {
        let identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        assert_eq!(procrustes([[0.0f32; 3]; 3]), identity.map(|r| r.map(|x| x as f32)));
        assert_eq!(procrustes([[f64::NAN; 3]; 3]), identity);
        // Points on a line that did not move: any turn about it is as good.
        for i in 0..20 {
            let v = random("line", i)[0];
            let r = procrustes(v.map(|a| v.map(|b| a * b)));
            let error =
                r.as_flattened().iter().zip(identity.as_flattened()).fold(0.0, |m: f64, (a, b)| m.max((a - b).abs()));
            assert!(error < 1e-3, "{error}");
            // In a plane the result is one, without a reflection.
            let w = random("plane", i)[0];
            let r = procrustes(std::array::from_fn(|k| std::array::from_fn(|l| v[k] * v[l] + w[k] * w[l])));
            let error =
                r.as_flattened().iter().zip(identity.as_flattened()).fold(0.0, |m: f64, (a, b)| m.max((a - b).abs()));
            assert!(error < 1e-9, "{error}");
        }
        for scale in [1e-30, 1e30] {
            let r = procrustes(random("scale", 1).map(|row| row.map(|x| x * scale)));
            assert!(is_rotation(r) && gain(&r, &procrustes(random("scale", 1))) > 3.0 - 1e-9);
        }
    }
}
