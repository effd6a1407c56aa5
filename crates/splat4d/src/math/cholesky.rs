//! Symmetric positive definite equations, by Cholesky's factor.

/// The factor of a symmetric positive definite matrix, to solve equations with.
#[derive(Clone, Debug)]
pub struct Cholesky {
    n: usize,
    /// L, row-major; A = L Lᵀ.
    lower: Vec<f64>,
}

impl Cholesky {
    /// Of a matrix [n, n], row-major, of which the lower triangle is read. `None`: it is not positive definite.
    pub fn new(n: usize, a: Vec<f64>) -> Option<Self> {
        Self::with_pivots(n, a, 0.0)
    }

    /// As [`new`](Self::new); `None` also where what is left of a number of the diagonal is at most this share of it, so that
    /// rounding decides.
    pub fn with_pivots(n: usize, mut a: Vec<f64>, least: f64) -> Option<Self> {
        assert_eq!(a.len(), n * n, "a square matrix");
        for i in 0..n {
            let (above, row) = a.split_at_mut(i * n);
            for j in 0..i {
                let other = &above[j * n..j * n + j + 1];
                let sum: f64 = row[..j].iter().zip(other).map(|(x, y)| x * y).sum();
                row[j] = (row[j] - sum) / other[j];
            }
            let left = row[i] - row[..i].iter().map(|x| x * x).sum::<f64>();
            if left <= least * row[i] || !left.is_finite() {
                return None;
            }
            row[i] = left.sqrt();
        }
        Some(Self { n, lower: a })
    }

    /// A⁻¹ b; `b`: `[n]`.
    pub fn solve(&self, mut b: Vec<f64>) -> Vec<f64> {
        let n = self.n;
        for i in 0..n {
            let row = &self.lower[i * n..];
            let sum: f64 = row[..i].iter().zip(&b).map(|(x, y)| x * y).sum();
            b[i] = (b[i] - sum) / row[i];
        }
        for i in (0..n).rev() {
            b[i] /= self.lower[i * n + i];
            let x = b[i];
            (0..i).for_each(|j| b[j] -= self.lower[i * n + j] * x);
        }
        b
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    #[test]
    fn equations_are_solved_unless_not_positive_definite() {
        let (n, rng) = (6, Rng::new(1, "cholesky", 0));
        let b: Vec<f64> = (0..n * n).map(|k| rng.normal(200 + k as u64)).collect();
        let at = |i: usize, j: usize| (0..n).map(|k| b[i * n + k] * b[j * n + k]).sum::<f64>();
        let mut a: Vec<f64> = (0..n * n).map(|k| at(k / n, k % n)).collect();
        let x: Vec<f64> = (0..n).map(|k| rng.normal(300 + k as u64)).collect();
        let right = (0..n).map(|i| (0..n).map(|k| a[i * n + k] * x[k]).sum()).collect();
        let got = Cholesky::new(n, a.clone()).unwrap().solve(right);
        assert!(got.iter().zip(&x).all(|(g, t)| (g - t).abs() < 1e-9), "{got:?} {x:?}");
        let nearly = vec![1.0, 1.0, 1.0, 1.0 + 1e-9];
        assert!(Cholesky::new(2, nearly.clone()).is_some() && Cholesky::with_pivots(2, nearly, 1e-6).is_none());
        a[0] = -1.0;
        assert!(Cholesky::new(n, a.clone()).is_none(), "not positive");
        a[0] = f64::NAN;
        assert!(Cholesky::new(n, a).is_none(), "not a number");
    }
}
