//! Eigenvalues of small symmetric matrices by cyclic Jacobi rotations (Golub and Van Loan, "Matrix Computations", §8.5).

/// The eigenvalues of a symmetric matrix and its unit eigenvectors (columns), in no particular order.
///
/// It ends after a sweep that turned nothing, and at the latest after `sweeps`: convergence is quadratic, four or five
/// are usual. An entry off the diagonal is left where `negligible` holds of it and its two entries on the diagonal.
pub fn jacobi<const N: usize>(
    mut a: [[f64; N]; N],
    sweeps: usize,
    negligible: impl Fn(f64, [f64; 2]) -> bool,
) -> ([f64; N], [[f64; N]; N]) {
    let mut v: [[f64; N]; N] = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
    for _ in 0..sweeps {
        let mut turned = false;
        for (p, q) in (0..N).flat_map(|p| (p + 1..N).map(move |q| (p, q))) {
            if negligible(a[p][q], [a[p][p], a[q][q]]) {
                continue;
            }
            turned = true;
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            let turn = |x: f64, y: f64| (c * x - s * y, s * x + c * y);
            a.iter_mut().for_each(|row| (row[p], row[q]) = turn(row[p], row[q]));
            (0..N).for_each(|k| (a[p][k], a[q][k]) = turn(a[p][k], a[q][k]));
            v.iter_mut().for_each(|row| (row[p], row[q]) = turn(row[p], row[q]));
        }
        if !turned {
            break;
        }
    }
    (std::array::from_fn(|i| a[i][i]), v)
}
