//! The fast Fourier transform of a power of two of values, radix 2, decimation in time (Cooley and Tukey 1965).
//!
//! Our own, because those of crates choose instructions by the machine and therefore round differently on others. What a value is
//! (one number, or sixteen columns of an image at once) is the caller's.

use super::Real;

/// cos and −sin of 2πk/n for k < n/2.
pub fn twiddles<F: Real>(n: usize) -> Vec<[F; 2]> {
    assert!(n.is_power_of_two(), "a transform has a power of two of values, not {n}");
    let step = -std::f64::consts::TAU / n as f64;
    (0..n / 2).map(|k| [F::of((step * k as f64).cos()), F::of((step * k as f64).sin())]).collect()
}

/// The position of value `i` of `n`, a power of two, in the order in which [`butterflies`] takes them: reversed bits.
#[inline]
pub fn reversed(i: usize, n: usize) -> usize {
    match n.trailing_zeros() {
        0 => 0,
        bits => i.reverse_bits() >> (usize::BITS - bits),
    }
}

/// X_k = Σ_j x_j e^(−2πijk/n) in place, without a factor, of values in reversed order. `butterfly(a, b, [c, s])` replaces
/// (a, b) by (a + wb, a − wb), w = c + is.
#[inline(always)]
pub fn butterflies<T, F: Real>(x: &mut [T], twiddles: &[[F; 2]], mut butterfly: impl FnMut(&mut T, &mut T, [F; 2])) {
    let n = x.len();
    assert_eq!(n / 2, twiddles.len(), "values are as many as the twiddles are for");
    let mut half = 1;
    while half < n {
        let stride = n / (2 * half);
        for block in x.chunks_exact_mut(2 * half) {
            let (low, high) = block.split_at_mut(half);
            for (k, (a, b)) in low.iter_mut().zip(high).enumerate() {
                butterfly(a, b, twiddles[k * stride]);
            }
        }
        half *= 2;
    }
}
