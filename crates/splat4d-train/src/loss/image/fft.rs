//! A discrete Fourier transform of images whose sides are powers of two.
//!
//! Sixteen columns at a time, so that every butterfly is a vector operation and the work stays in cache.

use rayon::prelude::*;
use splat4d::math::{Real, fft};

/// Columns that are transformed together.
const LANES: usize = 16;

/// A complex image [side, side], side a power of two, row by row.
#[derive(Clone, Debug, Default)]
pub(super) struct Spectrum<F> {
    pub(super) side: usize,
    pub(super) re: Vec<F>,
    pub(super) im: Vec<F>,
    scratch: (Vec<F>, Vec<F>),
    /// cos and −sin of 2πk/side for k < side/2.
    twiddles: Vec<[F; 2]>,
}

impl<F: Real> Spectrum<F> {
    /// Sizes the image and fills it with zeros. Panics: the side is not a power of two.
    pub(super) fn reset(&mut self, side: usize) {
        assert!(side.is_power_of_two() && side >= LANES, "sides are powers of two from {LANES} on, not {side}");
        if self.side != side {
            self.twiddles = fft::twiddles(side);
            self.side = side;
        }
        for plane in [&mut self.re, &mut self.im, &mut self.scratch.0, &mut self.scratch.1] {
            plane.clear();
            plane.resize(side * side, F::ZERO);
        }
    }

    /// The transform over both axes, X_uv = Σ x_yx e^(−2πi(uy+vx)/side), without a factor; index u·side + v.
    pub(super) fn forward(&mut self) {
        // Twice over columns with a transposition lands on u·side + v again.
        self.columns();
        self.columns();
    }

    /// Transforms every column and transposes.
    fn columns(&mut self) {
        let side = self.side;
        let (re, im, twiddles) = (&self.re, &self.im, &self.twiddles);
        let out = self.scratch.0.par_chunks_mut(side * LANES).zip(self.scratch.1.par_chunks_mut(side * LANES));
        out.enumerate().for_each(|(group, (out_re, out_im))| {
            let first = group * LANES;
            let mut a = vec![([F::ZERO; LANES], [F::ZERO; LANES]); side];
            for (y, a) in a.iter_mut().enumerate() {
                let from = fft::reversed(y, side) * side + first;
                a.0.copy_from_slice(&re[from..from + LANES]);
                a.1.copy_from_slice(&im[from..from + LANES]);
            }
            fft::butterflies(&mut a, twiddles, |p, q, [c, s]| {
                for l in 0..LANES {
                    let (x, y) = (q.0[l] * c - q.1[l] * s, q.0[l] * s + q.1[l] * c);
                    (q.0[l], q.1[l]) = (p.0[l] - x, p.1[l] - y);
                    (p.0[l], p.1[l]) = (p.0[l] + x, p.1[l] + y);
                }
            });
            for (y, a) in a.iter().enumerate() {
                for l in 0..LANES {
                    out_re[l * side + y] = a.0[l];
                    out_im[l * side + y] = a.1[l];
                }
            }
        });
        std::mem::swap(&mut self.re, &mut self.scratch.0);
        std::mem::swap(&mut self.im, &mut self.scratch.1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    #[test]
    fn equals_the_definition() {
        let side = 16;
        let rng = Rng::new(2, "fft", 0);
        let mut s = Spectrum::<f64>::default();
        s.reset(side);
        for i in 0..side * side {
            (s.re[i], s.im[i]) = (rng.normal(2 * i as u64), rng.normal(2 * i as u64 + 1));
        }
        let (re, im) = (s.re.clone(), s.im.clone());
        s.forward();
        for (u, v) in [(0, 0), (1, 0), (0, 3), (5, 7), (15, 9)] {
            let mut sum = [0.0; 2];
            for y in 0..side {
                for x in 0..side {
                    let angle = -std::f64::consts::TAU * (u * y + v * x) as f64 / side as f64;
                    let (a, b) = (re[y * side + x], im[y * side + x]);
                    sum[0] += a * angle.cos() - b * angle.sin();
                    sum[1] += a * angle.sin() + b * angle.cos();
                }
            }
            let got = [s.re[u * side + v], s.im[u * side + v]];
            assert!((got[0] - sum[0]).abs() < 1e-10 && (got[1] - sum[1]).abs() < 1e-10, "{u} {v}: {got:?} {sum:?}");
        }
    }
}
