//! Training of this crate's networks: Adam with a cosine schedule, gradient clipping and weight decay.

use splat4d::math::Real;
use splat4d::scene::{Grads, Key, LifeKind, Params};
use splat4d_train::optim::Moments;

/// Rates at the start and at the end.
const RATES: [f64; 2] = [1e-3, 1e-5];
/// Longest gradient, over all weights.
const CLIP: f64 = 1.0;
/// Decay of weights, of the rate.
const DECAY: f64 = 1e-4;

/// Weights and their training state.
pub(crate) struct Optimiser<F> {
    moments: Moments<F>,
    grads: Grads<F>,
    keys: Vec<Key>,
}

/// Parameters without any Gaussian.
pub(crate) fn no_gaussians<F: Real>() -> Params<F> {
    Params::new(0, 1, LifeKind::Infinite.columns())
}

impl<F: Real> Optimiser<F> {
    /// For the arrays of `p`.
    pub(crate) fn new(p: &Params<F>) -> Self {
        let keys = p.keys().filter(|&k| p[k].rows() > 0).collect();
        Self { moments: Moments::new(p), grads: Grads::new(p), keys }
    }

    /// One step along the gradient that `backward` adds; `done` of all steps have been taken. Returns whether it was
    /// finite: a step that is not is left out.
    pub(crate) fn step(
        &mut self,
        p: &mut Params<F>,
        done: f64,
        backward: impl FnOnce(&Params<F>, &mut Grads<F>),
    ) -> bool {
        self.grads.clear(p);
        backward(p, &mut self.grads);
        let norm = self.norm();
        if !norm.is_finite() {
            return false;
        }
        let share = if norm > CLIP { CLIP / norm } else { 1.0 };
        let rate = RATES[1] + 0.5 * (RATES[0] - RATES[1]) * (1.0 + (std::f64::consts::PI * done).cos());
        let mut rates = vec![None; p.keys().count()];
        for &key in &self.keys {
            let [gradient] = self.grads.of([key]);
            gradient.data_mut().iter_mut().for_each(|g| *g *= F::of(share));
            p[key].data_mut().iter_mut().for_each(|w| *w *= F::of(1.0 - rate * DECAY));
            rates[key.0 as usize] = Some(vec![rate; p[key].width()]);
        }
        self.moments.step(p, &mut self.grads, &rates, &[]).is_empty()
    }

    /// Length of the gradient.
    fn norm(&self) -> f64 {
        let of = |&key: &Key| self.grads.table(key).data().iter().map(|g| g.f64() * g.f64()).sum::<f64>();
        self.keys.iter().map(of).sum::<f64>().sqrt()
    }
}
