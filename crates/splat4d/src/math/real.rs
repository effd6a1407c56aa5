//! [`Real`]: f32 for computation, f64 for gradient checks.

use std::f32::consts::{FRAC_1_SQRT_2, LN_2};
use std::fmt::{Debug, Display};
use std::iter::Sum;
use std::ops::{Add, AddAssign, Div, DivAssign, Mul, MulAssign, Neg, Sub, SubAssign};

/// A floating-point number; kernels are generic over it so that the same code is checked in f64.
pub trait Real:
    Copy
    + Send
    + Sync
    + 'static
    + Default
    + Debug
    + Display
    + PartialEq
    + PartialOrd
    + Neg<Output = Self>
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + AddAssign
    + SubAssign
    + MulAssign
    + DivAssign
    + Sum
{
    /// 0
    const ZERO: Self;
    /// 1
    const ONE: Self;
    /// ½
    const HALF: Self;
    /// 2
    const TWO: Self;
    /// Rounds to this type.
    fn of(x: f64) -> Self;
    /// Widens to f64 (exact).
    fn f64(self) -> f64;
    /// Square root.
    fn sqrt(self) -> Self;
    /// e^self. In f32 it is our own, within 2 units in the last place over the whole range, without a call or a branch:
    /// loops over lanes vectorise, and every machine and SIMD level gives the same bits. In f64 it is the platform's.
    fn exp(self) -> Self;
    /// Natural logarithm.
    fn ln(self) -> Self;
    /// Sine.
    fn sin(self) -> Self;
    /// Cosine.
    fn cos(self) -> Self;
    /// |self|
    fn abs(self) -> Self;
    /// Largest integer not above.
    fn floor(self) -> Self;
    /// Integer part; saturates, NaN is 0.
    fn i32(self) -> i32;
    /// The whole number that self is, for |self| < 2^22, without a branch; anything else gives any number.
    fn lane_i32(self) -> i32;
    /// Smaller of two; NaN loses.
    fn min(self, other: Self) -> Self;
    /// Larger of two; NaN loses.
    fn max(self, other: Self) -> Self;
    /// Neither NaN nor infinite.
    fn is_finite(self) -> bool;
    /// self·b + c, fused only where the instruction set has it (the caller sets `FMA`).
    fn fma<const FMA: bool>(self, b: Self, c: Self) -> Self;
    /// 2^self for self in [-126, 0]: a branch-free polynomial in f32 (relative error ≤ 5e-6, 1 only at 0), exact in
    /// f64. Below the range the result is any number.
    fn blend_exp2<const FMA: bool>(self) -> Self;

    /// Natural logarithm of a positive normal number without a branch: in f32 within 3e-7 of max(1, |ln|), and
    /// relative near 1; exact in f64. Of anything else it is any number.
    fn lane_ln(self) -> Self;

    /// 1/(1+e^-self), without a branch: where e^-self overflows, the quotient is 0 as it should be.
    #[inline(always)]
    fn sigmoid(self) -> Self {
        Self::ONE / (Self::ONE + (-self).exp())
    }
}

macro_rules! common {
    ($t:ty) => {
        const ZERO: Self = 0.0;
        const ONE: Self = 1.0;
        const HALF: Self = 0.5;
        const TWO: Self = 2.0;
        #[inline(always)]
        fn of(x: f64) -> Self {
            x as $t
        }
        #[inline(always)]
        fn f64(self) -> f64 {
            self as f64
        }
        #[inline(always)]
        fn sqrt(self) -> Self {
            <$t>::sqrt(self)
        }
        #[inline(always)]
        fn ln(self) -> Self {
            <$t>::ln(self)
        }
        #[inline(always)]
        fn sin(self) -> Self {
            <$t>::sin(self)
        }
        #[inline(always)]
        fn cos(self) -> Self {
            <$t>::cos(self)
        }
        #[inline(always)]
        fn abs(self) -> Self {
            <$t>::abs(self)
        }
        #[inline(always)]
        fn floor(self) -> Self {
            <$t>::floor(self)
        }
        #[inline(always)]
        fn i32(self) -> i32 {
            self as i32
        }
        #[inline(always)]
        fn min(self, other: Self) -> Self {
            <$t>::min(self, other)
        }
        #[inline(always)]
        fn max(self, other: Self) -> Self {
            <$t>::max(self, other)
        }
        #[inline(always)]
        fn is_finite(self) -> bool {
            <$t>::is_finite(self)
        }
        #[inline(always)]
        fn fma<const FMA: bool>(self, b: Self, c: Self) -> Self {
            if FMA { self.mul_add(b, c) } else { self * b + c }
        }
    };
}

impl Real for f64 {
    common!(f64);
    #[inline(always)]
    fn lane_i32(self) -> i32 {
        self as i32
    }
    #[inline(always)]
    fn exp(self) -> Self {
        f64::exp(self)
    }
    #[inline(always)]
    fn blend_exp2<const FMA: bool>(self) -> Self {
        self.exp2()
    }
    #[inline(always)]
    fn lane_ln(self) -> Self {
        self.ln()
    }
}

/// 2^f on [-½, ½] as 1 + c1 f + … + c4 f⁴, least largest relative error (2.8e-6) under a value of exactly 1 at 0
/// (Lawson's reweighted least squares).
const EXP2_MINIMAX: [f32; 4] = [0.693_124_196, 0.240_240_984, 0.055_906_423, 0.009_582_866_5];

/// Bits of an f32 below its exponent.
const MANTISSA_BITS: u32 = f32::MANTISSA_DIGITS - 1;

/// Adding and subtracting 1.5·2^23 rounds a number below 2^22 to an integer without a branch; in between, the low bits
/// of the sum hold that integer in two's complement.
const ROUND: f32 = 12_582_912.0;
/// ln 2 as a short number, whose product with an exponent is exact, and the rest (Cody and Waite 1980).
const LN2: [f32; 2] = [0.693_359_375, -2.121_944_4e-4];
/// (e^r − 1 − r)/r² on [−½ ln 2, ½ ln 2] from the constant term on (Moshier, Cephes 2.2, `expf`).
const EXP_MINIMAX: [f32; 6] = [
    5.000_000_120_1e-1,
    1.666_666_545_9e-1,
    4.166_579_589_4e-2,
    8.333_451_907_3e-3,
    1.398_199_950_7e-3,
    1.987_569_15e-4,
];
/// Beyond these e^x is 0 or infinite in f32.
const EXP_RANGE: [f32; 2] = [-104.0, 89.0];

impl Real for f32 {
    common!(f32);
    #[inline(always)]
    fn lane_i32(self) -> i32 {
        // A cast saturates, for which there is no vector instruction.
        ((self + ROUND).to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32)
    }
    #[inline(always)]
    fn exp(self) -> Self {
        // Phrased so that a NaN stays one. No fused multiply-add: every SIMD level must give the same bits.
        let x = if self < EXP_RANGE[0] { EXP_RANGE[0] } else { self };
        let x = if x > EXP_RANGE[1] { EXP_RANGE[1] } else { x };
        let shifted = x * std::f32::consts::LOG2_E + ROUND;
        let n = shifted - ROUND;
        let r = (x - n * LN2[0]) - n * LN2[1];
        let mut p = EXP_MINIMAX[5];
        for c in EXP_MINIMAX[..5].iter().rev() {
            p = p * r + c;
        }
        let p = p * (r * r) + r + 1.0;
        // 2^n in two factors, because 2^128 and 2^-149 alone are not normal numbers.
        let n = (shifted.to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32);
        let half = n >> 1;
        let power = |n: i32| f32::from_bits((n.wrapping_add(127) << 23) as u32);
        p * power(half) * power(n.wrapping_sub(half))
    }
    #[inline(always)]
    fn blend_exp2<const FMA: bool>(self) -> Self {
        // 2^x = 2^n · 2^f with n = round(x).
        let shifted = self + ROUND;
        let f = self - (shifted - ROUND);
        let mut p = EXP2_MINIMAX[3];
        p = p.fma::<FMA>(f, EXP2_MINIMAX[2]);
        p = p.fma::<FMA>(f, EXP2_MINIMAX[1]);
        p = p.fma::<FMA>(f, EXP2_MINIMAX[0]);
        p = p.fma::<FMA>(f, 1.0);
        // The low bits of `shifted` hold n in two's complement: move it into the exponent field.
        f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
    }
    #[inline(always)]
    fn lane_ln(self) -> Self {
        // x = 2^n·m with m in [√½, √2): taking the bits of √½ away first makes the cut there and not at 1.
        let above = self.to_bits().wrapping_sub(FRAC_1_SQRT_2.to_bits());
        let n = (above as i32 >> MANTISSA_BITS) as f32;
        let m = f32::from_bits((above & ((1 << MANTISSA_BITS) - 1)).wrapping_add(FRAC_1_SQRT_2.to_bits()));
        // ln m = 2 artanh s with s = (m − 1)/(m + 1), |s| ≤ .172: what the series leaves out is below 1e-9.
        let s = (m - 1.0) / (m + 1.0);
        let z = s * s;
        let tail = z * (2.0 / 3.0 + z * (2.0 / 5.0 + z * (2.0 / 7.0 + z * (2.0 / 9.0))));
        n * LN_2 + (s * tail + 2.0 * s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blend_exp2_is_within_its_stated_error() {
        assert_eq!((0f32.blend_exp2::<true>(), 0f32.blend_exp2::<false>()), (1.0, 1.0));
        assert!((-1e-6f32).blend_exp2::<true>() < 1.0, "α below 1 stays below 1");
        let mut worst = 0.0f64;
        for i in 0..=1_260_000 {
            let x = -(i as f32) * 1e-4;
            let truth = (x as f64).exp2();
            for got in [x.blend_exp2::<false>(), x.blend_exp2::<true>()] {
                worst = worst.max(((got as f64) / truth - 1.0).abs());
            }
        }
        assert!(worst < 5e-6, "relative error {worst}");
    }

    #[test]
    fn lane_i32_is_a_cast() {
        for i in [0, 1, -1, 2, 31, 32, 1279, 65_535, (1 << 22) - 1, -(1 << 22) + 1] {
            assert_eq!((f32::lane_i32(i as f32), f64::lane_i32(i as f64)), (i, i));
        }
    }

    #[test]
    fn lane_ln_is_within_its_stated_error() {
        assert_eq!(1f32.lane_ln(), 0.0);
        let mut worst = 0.0f64;
        // Every exponent of a normal number, and numbers close to 1.
        let spread = (0..2_000_000u32).map(|i| f32::from_bits(0x0080_0000 + i * 1063));
        let near = (1..1000u32).flat_map(|i| [1.0 + i as f32 * 1e-5, 1.0 - i as f32 * 1e-5]);
        for x in spread {
            let truth = f64::from(x).ln();
            worst = worst.max((f64::from(x.lane_ln()) - truth).abs() / truth.abs().max(1.0));
        }
        for x in near {
            let truth = f64::from(x).ln();
            worst = worst.max((f64::from(x.lane_ln()) / truth - 1.0).abs());
        }
        assert!(worst < 3e-7, "error {worst}");
    }

    #[test]
    fn exp_is_within_its_stated_error_and_keeps_special_values() {
        let mut worst = 0.0f64;
        // Every exponent and some thousand mantissas each, both signs, where the result is a normal number.
        for bits in (0..0x42b2_0000u32).step_by(7919) {
            for x in [f32::from_bits(bits), -f32::from_bits(bits)] {
                let truth = f64::exp(x.into());
                if truth < f64::from(f32::MIN_POSITIVE) || truth > f64::from(f32::MAX) {
                    continue;
                }
                // A unit in the last place of the truth.
                let unit = (truth.log2().floor() - 23.0).exp2();
                worst = worst.max((f64::from(Real::exp(x)) - truth).abs() / unit);
            }
        }
        assert!(worst < 2.0, "{worst} units in the last place");
        let e = |x: f32| Real::exp(x);
        assert_eq!(
            [e(0.0), e(f32::INFINITY), e(f32::NEG_INFINITY), e(200.0), e(-200.0)],
            [1.0, f32::INFINITY, 0.0, f32::INFINITY, 0.0]
        );
        assert!(e(f32::NAN).is_nan() && e(-f32::NAN).is_nan());
        // Numbers below the smallest normal one are as good as they can be.
        assert!((f64::from(e(-95.0)) - f64::exp(-95.0)).abs() < 3e-45);
    }

    #[test]
    fn sigmoid_is_stable() {
        assert_eq!(f32::sigmoid(1000.0), 1.0);
        assert_eq!(f32::sigmoid(-1000.0), 0.0);
        assert!((f64::sigmoid(0.3) - 1.0 / (1.0 + (-0.3f64).exp())).abs() < 1e-15);
    }
}
