//! Entropy of opacities and of the rendered alpha: minimised, they become 0 or 1.

use super::{ImageTerm, LossGrads, Shown, View};
use crate::loss::terms::StepInfo;
use splat4d::math::Real;
use splat4d::scene::Planes;

/// [`mask_entropy`] of alpha, times a weight.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MaskEntropy(pub f64);

impl<F: Real> ImageTerm<F> for MaskEntropy {
    fn eval(&mut self, _: &StepInfo, _: &View<'_, F>, shown: &Shown<'_, F>, d: &mut LossGrads<F>) -> f64 {
        mask_entropy(shown.alpha, self.0, d.alpha.add())
    }
}

/// Probabilities are kept this far from 0 and 1, where the slope would be infinite.
const MARGIN: f64 = 1e-4;

/// −p ln p − (1−p) ln(1−p), nats, and its slope ln((1−p)/p); beyond the margin the slope is 0.
pub(crate) fn binary_entropy<F: Real>(p: F) -> (F, F) {
    let held = p.max(F::of(MARGIN)).min(F::of(1.0 - MARGIN));
    let (q, slope) = (F::ONE - held, if held == p { ((F::ONE - p) / p).ln() } else { F::ZERO });
    (-(held * held.ln()) - q * q.ln(), slope)
}

/// Mean over pixels of the binary entropy of alpha, nats: foreground and background, and no haze between them.
///
/// Source: the opacity entropy of SuGaR (Guédon and Lepetit 2024) on what a pixel shows.
pub(crate) fn mask_entropy<F: Real>(alpha: &Planes<F>, weight: f64, d_alpha: &mut Planes<F>) -> f64 {
    assert_eq!(alpha.data.len(), d_alpha.data.len(), "a gradient has its image's shape");
    let scale = weight / alpha.data.len().max(1) as f64;
    scale
        * super::over_rows(&mut d_alpha.data, alpha.width, |y, d| {
            let mut sum = 0.0;
            for (d, &a) in d.iter_mut().zip(&alpha.data[y * alpha.width..]) {
                let (value, slope) = binary_entropy(a);
                sum += value.f64();
                *d += F::of(scale) * slope;
            }
            sum
        })
}

#[cfg(test)]
mod tests {
    use super::super::check;
    use super::*;

    #[test]
    fn gradient_equals_finite_differences_and_alpha_of_0_or_1_has_no_loss() {
        let alpha = check::planes("alpha", [1, 6, 9], 0.01, 0.99);
        let run = |p: &[Planes<f64>], d: &mut [Planes<f64>]| mask_entropy(&p[0], 0.7, &mut d[0]);
        let value = |p: &[Planes<f64>]| run(p, &mut [Planes::new(1, 6, 9)]);
        check::gradients(&[alpha], run, value);
        let sure = Planes { channels: 1, height: 1, width: 2, data: vec![0.0f32, 1.0] };
        let mut d = Planes::new(1, 1, 2);
        assert!(mask_entropy(&sure, 1.0, &mut d) < 2e-3);
        assert_eq!(d.data, [0.0, 0.0]);
        assert!((binary_entropy(0.5f64).0 - std::f64::consts::LN_2).abs() < 1e-12);
    }
}
