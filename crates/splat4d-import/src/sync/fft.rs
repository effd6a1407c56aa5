//! Fourier transforms of sound, and correlations by them.

use splat4d::math::fft;

/// A transform of one length.
pub(super) struct Fft {
    /// e^(−2πik/n), k < n/2.
    turns: Vec<[f64; 2]>,
}

/// Complex numbers, real part first.
pub(super) type Complex = [f64; 2];

pub(super) fn times(a: Complex, b: Complex) -> Complex {
    [a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]]
}

impl Fft {
    /// For `n` numbers, a power of two.
    pub(super) fn new(n: usize) -> Self {
        Self { turns: fft::twiddles(n) }
    }

    /// X_k = Σ_j x_j e^(−2πijk/n), in place.
    pub(super) fn forward(&self, x: &mut [Complex]) {
        let n = x.len();
        for i in 0..n {
            let j = fft::reversed(i, n);
            if i < j {
                x.swap(i, j);
            }
        }
        fft::butterflies(x, &self.turns, |a, b, turn| {
            let t = times(*b, turn);
            *b = [a[0] - t[0], a[1] - t[1]];
            *a = [a[0] + t[0], a[1] + t[1]];
        });
    }

    /// The inverse of [`forward`](Self::forward).
    pub(super) fn inverse(&self, x: &mut [Complex]) {
        let scale = 1.0 / x.len() as f64;
        x.iter_mut().for_each(|v| v[1] = -v[1]);
        self.forward(x);
        x.iter_mut().for_each(|v| *v = [v[0] * scale, -v[1] * scale]);
    }
}

/// Σ_i a[i] b[i + lag] for every lag from −(a.len() − 1) to b.len() − 1; lag 0 is at a.len() − 1.
pub(super) fn correlate(a: &[f64], b: &[f64]) -> Vec<f64> {
    let count = a.len() + b.len() - 1;
    let n = count.next_power_of_two();
    let fft = Fft::new(n);
    // Both are real: one transform takes a as the real part and b as the imaginary one.
    let mut z = vec![[0.0; 2]; n];
    a.iter().enumerate().for_each(|(i, v)| z[i][0] = *v);
    b.iter().enumerate().for_each(|(i, v)| z[i][1] = *v);
    fft.forward(&mut z);
    let mut product = vec![[0.0; 2]; n];
    for (k, p) in product.iter_mut().enumerate() {
        let (x, y) = (z[k], z[(n - k) % n]);
        // A = (X + Y*)/2, B = (X − Y*)/2i; conj(A)·B.
        let a = [0.5 * (x[0] + y[0]), 0.5 * (x[1] - y[1])];
        let b = [0.5 * (x[1] + y[1]), -0.5 * (x[0] - y[0])];
        *p = times([a[0], -a[1]], b);
    }
    fft.inverse(&mut product);
    (0..count).map(|i| product[(i + n + 1 - a.len()) % n][0]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn a_transform_equals_its_definition() {
        for n in [1, 2, 8, 32] {
            let x: Vec<Complex> = (0..n).map(|i| [(i as f64 * 1.7).sin(), (i as f64 * 0.3).cos()]).collect();
            let mut fast = x.clone();
            let fft = Fft::new(n);
            fft.forward(&mut fast);
            for (k, found) in fast.iter().enumerate() {
                let mut sum = [0.0; 2];
                for (j, v) in x.iter().enumerate() {
                    let angle = -TAU * (j * k) as f64 / n as f64;
                    let term = times(*v, [angle.cos(), angle.sin()]);
                    sum = [sum[0] + term[0], sum[1] + term[1]];
                }
                assert!((sum[0] - found[0]).abs() + (sum[1] - found[1]).abs() < 1e-12);
            }
            fft.inverse(&mut fast);
            assert!(fast.iter().zip(&x).all(|(a, b)| (a[0] - b[0]).abs() + (a[1] - b[1]).abs() < 1e-13));
        }
    }

    #[test]
    fn a_correlation_equals_its_definition() {
        let a: Vec<f64> = (0..5).map(|i| (f64::from(i) * 2.3).sin()).collect();
        let b: Vec<f64> = (0..7).map(|i| (f64::from(i) * 1.1).cos()).collect();
        for (at, found) in correlate(&a, &b).into_iter().enumerate() {
            let lag = at as isize - 4;
            let term = |i: usize| b.get(i.checked_add_signed(lag)?).map(|v| v * a[i]);
            let sum: f64 = (0..a.len()).filter_map(term).sum();
            assert!((sum - found).abs() < 1e-12, "{lag}");
        }
    }
}
