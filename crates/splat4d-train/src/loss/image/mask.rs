//! Alpha against the foreground mask.

use super::{ImageTerm, LossGrads, Shown, View};
use crate::loss::terms::StepInfo;
use splat4d::math::Real;

/// Mean |alpha − mask| over the pixels of views that have a mask, times a weight.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Mask(pub f64);

impl<F: Real> ImageTerm<F> for Mask {
    fn eval(&mut self, _: &StepInfo, view: &View<'_, F>, shown: &Shown<'_, F>, d: &mut LossGrads<F>) -> f64 {
        let Some(mask) = view.mask else { return 0.0 };
        let scale = F::of(self.0) / F::of(mask.pixels() as f64);
        let mut sum = 0.0f64;
        for ((d, a), m) in d.alpha.add().data.iter_mut().zip(&shown.alpha.data).zip(&mask.data) {
            let e = *a - *m;
            sum += e.abs().f64();
            if e > F::ZERO {
                *d += scale;
            } else if e < F::ZERO {
                *d -= scale;
            }
        }
        sum * scale.f64()
    }
}
