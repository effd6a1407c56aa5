//! Counter-based random numbers: a number is a pure function of (seed, purpose, step, row), so that no generator is
//! carried about and neither resume nor the number of threads can change a run.

/// A stream of random numbers addressed by step and row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rng {
    key: u64,
}

/// One round of the SplitMix64 finaliser (Steele, Lea, Flood 2014).
fn mix(mut z: u64) -> u64 {
    z = z.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

impl Rng {
    /// A stream for `purpose` (a short fixed name) at `step`.
    pub fn new(seed: u64, purpose: &str, step: u64) -> Self {
        let mut key = mix(seed);
        for byte in purpose.bytes() {
            key = mix(key ^ u64::from(byte));
        }
        Self { key: mix(key ^ step) }
    }

    /// A stream derived from this one.
    pub fn fork(self, index: u64) -> Self {
        Self { key: mix(self.key ^ index.wrapping_mul(0xD134_2543_DE82_EF95)) }
    }

    /// State of the stream, for its twin on a GPU (gpu/numbers.wgsl).
    #[cfg(feature = "gpu")]
    pub(crate) fn key(self) -> u64 {
        self.key
    }

    /// 64 random bits for draw `i`.
    pub(crate) fn bits(self, i: u64) -> u64 {
        mix(self.key.wrapping_add(i.wrapping_mul(0x9E37_79B9_7F4A_7C15)))
    }

    /// Uniform in [0, 1) for draw `i`.
    pub fn uniform(self, i: u64) -> f64 {
        (self.bits(i) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform integer in 0..n for draw `i`. Panics: n = 0.
    pub fn below(self, i: u64, n: usize) -> usize {
        assert!(n > 0, "a random index needs a non-empty range");
        ((u128::from(self.bits(i)) * n as u128) >> 64) as usize
    }

    /// Standard normal for draw `i` (Box-Muller).
    pub fn normal(self, i: u64) -> f64 {
        let u = 1.0 - self.fork(1).uniform(i);
        let v = self.fork(2).uniform(i);
        (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    }

    /// A permutation of 0..n (Fisher-Yates).
    pub fn permutation(self, n: usize) -> Vec<u32> {
        let mut order: Vec<u32> = (0..n as u32).collect();
        for i in (1..n).rev() {
            order.swap(i, self.below(i as u64, i + 1));
        }
        order
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn random_streams_have_the_right_mean_and_variance_and_are_independent() {
        let (a, b) = (Rng::new(1, "a", 0), Rng::new(1, "b", 0));
        let n = 100_000;
        let mean: f64 = (0..n).map(|i| a.normal(i)).sum::<f64>() / n as f64;
        let var: f64 = (0..n).map(|i| a.normal(i).powi(2)).sum::<f64>() / n as f64;
        let cross: f64 = (0..n).map(|i| (a.uniform(i) - 0.5) * (b.uniform(i) - 0.5)).sum::<f64>() / n as f64;
        assert!(mean.abs() < 0.02 && (var - 1.0).abs() < 0.02 && cross.abs() < 2e-3, "{mean} {var} {cross}");
    }

    #[test]
    fn permutation_holds_every_index_once() {
        let mut p = Rng::new(3, "p", 9).permutation(1000);
        assert_ne!(p[..5], [0, 1, 2, 3, 4]);
        p.sort_unstable();
        assert!(p.iter().enumerate().all(|(i, &x)| i as u32 == x));
    }
}
