//! The logit.

use super::Real;

/// ln(o / (1 − o)) of an opacity that is kept `margin` away from 0 and 1, where it is infinite. NaN stays.
#[inline]
pub fn logit<F: Real>(o: F, margin: F) -> F {
    let most = F::ONE - margin;
    let o = if o < margin {
        margin
    } else if o > most {
        most
    } else {
        o
    };
    (o / (F::ONE - o)).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_are_finite_and_the_middle_is_exact() {
        assert_eq!((logit(0.5, 1e-6), logit(0.25f32, 1e-6)), (0.0, (1.0f32 / 3.0).ln()));
        assert!(logit(f64::NAN, 1e-6).is_nan() && logit(7.0, 1e-4) == logit(1.0 - 1e-4, 1e-4));
    }
}
