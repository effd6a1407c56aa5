//! Shared parts of the tests of layers: numbers to feed them, and differences to check their gradients.

use super::ssm::{LANES, Lane};
use crate::math::Rng;

/// Normal numbers.
pub(super) fn random(len: usize, seed: u64) -> Vec<Lane<f64>> {
    let rng = Rng::new(seed, "numbers", 0);
    (0..len).map(|i| std::array::from_fn(|l| rng.normal((i * LANES + l) as u64))).collect()
}

/// A sum that feels every number: its gradient is `random(a.len(), seed)`.
pub(super) fn weighed(a: &[Lane<f64>], seed: u64) -> f64 {
    a.as_flattened().iter().zip(random(a.len(), seed).as_flattened()).map(|(a, b)| a * b).sum()
}

/// Central differences of f at some of the numbers of x against the gradient.
pub(super) fn check(name: &str, x: &[f64], d: &[f64], f: impl Fn(&[f64]) -> f64) {
    let mut x = x.to_vec();
    for i in (0..x.len()).step_by((x.len() / 80).max(1)) {
        let old = x[i];
        let mut at = |h: f64| {
            x[i] = old + h;
            f(&x)
        };
        let fd = (at(1e-6) - at(-1e-6)) / 2e-6;
        x[i] = old;
        assert!((fd - d[i]).abs() < 2e-6 * (1.0 + fd.abs()), "{name}[{i}]: differences {fd}, gradient {}", d[i]);
    }
}

pub(super) fn lanes(x: &[f64]) -> &[Lane<f64>] {
    x.as_chunks().0
}
