//! Dense matrices of f64 for the few hundred rows that forecasts have: products, equations and eigenvectors, with sums in
//! one order on every machine.

use splat4d::math::cholesky::Cholesky;
use std::ops::{Index, IndexMut, Mul, Range, Sub};

/// Sweeps of Jacobi rotations; convergence is quadratic, six or seven are usual.
const SWEEPS: usize = 40;
/// Entries off the diagonal, of the matrix's norm, that are taken for zero.
const NEGLIGIBLE: f64 = 1e-13;

/// A matrix, row-major.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Matrix {
    height: usize,
    width: usize,
    data: Vec<f64>,
}

impl Matrix {
    pub(crate) fn from_fn(height: usize, width: usize, entry: impl Fn(usize, usize) -> f64) -> Self {
        let data = (0..height * width).map(|k| entry(k / width, k % width)).collect();
        Self { height, width, data }
    }

    pub(crate) fn identity(n: usize) -> Self {
        Self::from_fn(n, n, |i, j| if i == j { 1.0 } else { 0.0 })
    }

    pub(crate) fn height(&self) -> usize {
        self.height
    }

    pub(crate) fn width(&self) -> usize {
        self.width
    }

    pub(crate) fn row(&self, r: usize) -> &[f64] {
        &self.data[r * self.width..(r + 1) * self.width]
    }

    pub(crate) fn rows(&self, range: Range<usize>) -> Self {
        let data = self.data[range.start * self.width..range.end * self.width].to_vec();
        Self { height: range.len(), width: self.width, data }
    }

    pub(crate) fn transpose(&self) -> Self {
        Self::from_fn(self.width, self.height, |r, c| self[(c, r)])
    }

    pub(crate) fn scaled(mut self, by: f64) -> Self {
        self.data.iter_mut().for_each(|x| *x *= by);
        self
    }

    /// Two rows, the first above the second.
    fn two_rows(&mut self, p: usize, q: usize) -> (&mut [f64], &mut [f64]) {
        let (above, below) = self.data.split_at_mut(q * self.width);
        (&mut above[p * self.width..(p + 1) * self.width], &mut below[..self.width])
    }

    /// Sum of products of entries.
    pub(crate) fn dot(&self, other: &Self) -> f64 {
        assert_eq!((self.height, self.width), (other.height, other.width), "matrices of one shape");
        dot(&self.data, &other.data)
    }

    pub(crate) fn norm_squared(&self) -> f64 {
        dot(&self.data, &self.data)
    }

    pub(crate) fn trace(&self) -> f64 {
        (0..self.height).map(|i| self[(i, i)]).sum()
    }

    /// The factor of a symmetric matrix; `None` if it is not positive definite.
    pub(crate) fn cholesky(&self) -> Option<Cholesky> {
        assert_eq!(self.height, self.width, "a square matrix");
        Cholesky::new(self.height, self.data.clone())
    }

    /// Eigenvalues of a symmetric matrix and its unit eigenvectors (rows), in no particular order, by cyclic Jacobi
    /// rotations (Golub and Van Loan, "Matrix Computations", §8.5).
    pub(crate) fn symmetric_eigen(&self) -> (Vec<f64>, Self) {
        assert_eq!(self.height, self.width, "a square matrix");
        let n = self.height;
        let (mut a, mut vectors) = (self.clone(), Self::identity(n));
        let least = NEGLIGIBLE * self.norm_squared().sqrt();
        for _ in 0..SWEEPS {
            let mut turned = false;
            for (p, q) in (0..n).flat_map(|p| (p + 1..n).map(move |q| (p, q))) {
                let off = a[(p, q)];
                if off.abs() <= least {
                    continue;
                }
                turned = true;
                let theta = (a[(q, q)] - a[(p, p)]) / (2.0 * off);
                let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
                let c = 1.0 / (t * t + 1.0).sqrt();
                let s = t * c;
                let turn = |x: &mut f64, y: &mut f64| (*x, *y) = (c * *x - s * *y, s * *x + c * *y);
                let (first, second) = a.two_rows(p, q);
                let [pp, qq] = [first[p] - t * off, second[q] + t * off];
                first.iter_mut().zip(second.iter_mut()).for_each(|(x, y)| turn(x, y));
                [first[p], first[q], second[p], second[q]] = [pp, 0.0, 0.0, qq];
                // The columns are the rows again; rows are contiguous, which is several times faster.
                for k in 0..n {
                    (a[(k, p)], a[(k, q)]) = (a[(p, k)], a[(q, k)]);
                }
                let (first, second) = vectors.two_rows(p, q);
                first.iter_mut().zip(second.iter_mut()).for_each(|(x, y)| turn(x, y));
            }
            if !turned {
                break;
            }
        }
        ((0..n).map(|i| a[(i, i)]).collect(), vectors)
    }
}

/// A⁻¹ B of a factor of A.
pub(crate) fn solve(a: &Cholesky, b: &Matrix) -> Matrix {
    let columns = b.transpose();
    let solved: Vec<Vec<f64>> = (0..b.width).map(|c| a.solve(columns.row(c).to_vec())).collect();
    Matrix::from_fn(b.height, b.width, |r, c| solved[c][r])
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

impl Index<(usize, usize)> for Matrix {
    type Output = f64;

    fn index(&self, (r, c): (usize, usize)) -> &f64 {
        &self.data[r * self.width + c]
    }
}

impl IndexMut<(usize, usize)> for Matrix {
    fn index_mut(&mut self, (r, c): (usize, usize)) -> &mut f64 {
        &mut self.data[r * self.width + c]
    }
}

impl Mul for &Matrix {
    type Output = Matrix;

    fn mul(self, other: Self) -> Matrix {
        assert_eq!(self.width, other.height, "factors fit together");
        let mut data = vec![0.0; self.height * other.width];
        for (r, out) in data.chunks_exact_mut(other.width.max(1)).enumerate() {
            for (k, x) in self.row(r).iter().enumerate() {
                out.iter_mut().zip(other.row(k)).for_each(|(sum, y)| *sum += x * y);
            }
        }
        Matrix { height: self.height, width: other.width, data }
    }
}

impl Sub for &Matrix {
    type Output = Matrix;

    fn sub(self, other: Self) -> Matrix {
        assert_eq!((self.height, self.width), (other.height, other.width), "matrices of one shape");
        let data = self.data.iter().zip(&other.data).map(|(x, y)| x - y).collect();
        Matrix { height: self.height, width: self.width, data }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    fn random(height: usize, width: usize) -> Matrix {
        let rng = Rng::new(3, "matrix", 0);
        Matrix::from_fn(height, width, |r, c| rng.normal((r * width + c) as u64))
    }

    #[test]
    fn equations_are_solved_for_every_column() {
        let b = random(7, 7);
        let a = &(&b * &b.transpose()) - &Matrix::identity(7).scaled(-1.0);
        let x = random(7, 3);
        let found = solve(&a.cholesky().expect("a Gram matrix and the identity"), &(&a * &x));
        assert!((&found - &x).norm_squared().sqrt() < 1e-9, "{found:?}");
        assert!((&b.transpose().transpose() - &b).norm_squared() == 0.0 && b.rows(2..4).row(1) == b.row(3));
    }

    #[test]
    fn eigenvectors_compose_the_matrix_also_below_full_rank() {
        let b = random(30, 4);
        let a = &b * &b.transpose();
        let (values, vectors) = a.symmetric_eigen();
        let scaled = Matrix::from_fn(30, 30, |i, k| values[i] * vectors[(i, k)]);
        let size = a.norm_squared().sqrt();
        assert!((&(&vectors.transpose() * &scaled) - &a).norm_squared().sqrt() < 1e-12 * size);
        let unit = &(&vectors * &vectors.transpose()) - &Matrix::identity(30);
        assert!(unit.norm_squared().sqrt() < 1e-12, "eigenvectors are orthonormal");
        assert_eq!(values.iter().filter(|v| v.abs() > 1e-9 * size).count(), 4, "{values:?}");
        assert!((values.iter().sum::<f64>() - a.trace()).abs() < 1e-12 * size);
    }
}
