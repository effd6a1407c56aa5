//! Quantisers: from a number to an integer code and back, each with its error bound.
//!
//! They are shared by every compact format. Encoding clamps, so that no input gives a code out of range.

use crate::math::quat;
use crate::simd::greatest;
use std::f64::consts::FRAC_1_SQRT_2;

/// Code 0..=`levels` of a number in [min, max].
///
/// Error of the round trip: at most (max − min)/(2·levels). A range that is empty, or a NaN, gives code 0.
#[cfg(test)]
pub(crate) fn linear_code(value: f64, min: f64, max: f64, levels: u32) -> u32 {
    coarse_code(value, min, max, levels, 1)
}

/// As [`linear_code`], but only multiples of `step`, a power of two.
///
/// Error of the round trip: at most `step` times as large, and as much again above the largest multiple.
#[inline(always)]
pub(crate) fn coarse_code(value: f64, min: f64, max: f64, levels: u32, step: u32) -> u32 {
    // A division by a power of two is exact: a step of 1 changes no bit.
    let (range, each, last) = (max - min, 1.0 / f64::from(step), f64::from(levels / step));
    // By way of i32, since vectors of f64 become nothing else in one instruction.
    let code = ((value - min) / range * f64::from(levels) * each).round().clamp(0.0, last) as i32 as u32 * step;
    if range > 0.0 { code } else { 0 }
}

/// The number behind a [`linear_code`]: min + (max − min)·code/levels. Codes are below 2³¹.
#[inline(always)]
pub(crate) fn linear(code: u32, min: f64, max: f64, levels: u32) -> f64 {
    min + (max - min) * (f64::from(code as i32) / f64::from(levels))
}

/// Code 0..=`levels` of a positive number whose logarithm is in [min, max].
///
/// Relative error of the round trip: at most exp((max − min)/(2·levels)) − 1. Zero and less give code 0.
#[cfg(test)]
pub(crate) fn log_code(value: f64, min: f64, max: f64, levels: u32) -> u32 {
    linear_code(value.ln(), min, max, levels)
}

/// The number behind a [`log_code`].
pub(crate) fn log(code: u32, min: f64, max: f64, levels: u32) -> f64 {
    linear(code, min, max, levels).exp()
}

/// Code 0..=2·`half` of a number within ± `most`; zero is `half` exactly.
///
/// Error of the round trip: at most most/(2·half).
#[cfg(test)]
pub(crate) fn signed_code(value: f64, most: f64, half: u32) -> u32 {
    coarse_signed_code(value, most, half, 1)
}

/// As [`signed_code`], but only `half` and what lies multiples of `step`, a power of two, next to it.
#[inline(always)]
pub(crate) fn coarse_signed_code(value: f64, most: f64, half: u32, step: u32) -> u32 {
    let share = if most > 0.0 { value / most } else { 0.0 };
    let (each, last) = (1.0 / f64::from(step), f64::from(half / step));
    // A NaN is zero here as well, which 0 as its code would not be.
    let steps = (share * f64::from(half) * each).round().clamp(-last, last) as i32;
    (half as i32 + steps * step as i32) as u32
}

/// The number behind a [`signed_code`]: most·(code − half)/half.
#[inline(always)]
pub(crate) fn signed(code: u32, most: f64, half: u32) -> f64 {
    most * ((f64::from(code as i32) - f64::from(half)) / f64::from(half))
}

/// A rotation as (which of w x y z is largest, codes 0..=2·`half` of the three others in that order): "smallest three".
/// The sign is chosen so that the largest is positive; q need not be normalised.
///
/// Error of the round trip: at most 1/(2√2·half) in each of the three, and so at most 2.5/half radians of rotation.
#[cfg(test)]
pub(crate) fn quat_codes(q: [f64; 4], half: u32) -> (usize, [u32; 3]) {
    coarse_quat_codes(q, half, 1)
}

/// As [`quat_codes`] with codes as those of [`coarse_signed_code`].
#[inline(always)]
pub(crate) fn coarse_quat_codes(q: [f64; 4], half: u32, step: u32) -> (usize, [u32; 3]) {
    let (q, _) = quat::normalize(q);
    let mut largest = 0;
    for i in 1..4 {
        largest = if q[i].abs() > q[largest].abs() { i } else { largest };
    }
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    let code = |i: usize| coarse_signed_code(sign * q[i], FRAC_1_SQRT_2, half, step);
    let [a, b, c] = others(largest);
    (largest, [code(a), code(b), code(c)])
}

/// The unit quaternion wxyz behind [`quat_codes`]. Three codes that together exceed 1 give the largest component 0, and
/// are normalised. Panics: largest > 3.
#[inline(always)]
pub(crate) fn quat(largest: usize, codes: [u32; 3], half: u32) -> [f64; 4] {
    assert!(largest < 4, "a quaternion has four components");
    let [a, b, c] = [
        signed(codes[0], FRAC_1_SQRT_2, half),
        signed(codes[1], FRAC_1_SQRT_2, half),
        signed(codes[2], FRAC_1_SQRT_2, half),
    ];
    quat_of(largest as u32, a, b, c)
}

/// The unit quaternion of which component `largest` is missing, and positive.
#[inline(always)]
pub(super) fn quat_of(largest: u32, a: f64, b: f64, c: f64) -> [f64; 4] {
    let rest = 1.0 - a * a - b * b - c * c;
    let big = greatest(rest, 0.0).sqrt();
    let w = if largest == 0 { big } else { a };
    let x = if largest == 0 { a } else { b };
    let x = if largest == 1 { big } else { x };
    let y = if largest <= 1 { b } else { c };
    let y = if largest == 2 { big } else { y };
    let z = if largest == 3 { big } else { c };
    quat::normalize([w, x, y, z]).0
}

/// The components but one, in order.
#[inline(always)]
fn others(largest: usize) -> [usize; 3] {
    [usize::from(largest == 0), 1 + usize::from(largest <= 1), 2 + usize::from(largest <= 2)]
}

/// Bits an axis of [`morton`].
pub const MORTON_BITS: u32 = 21;

/// Place of a cell in Morton order: bits of x, y and z interleaved, x lowest. Coordinates have [`MORTON_BITS`] bits;
/// higher ones are cut off.
pub fn morton(cell: [u32; 3]) -> u64 {
    let spread = |x: u32| {
        // Moves bit i to bit 3i by doubling the gaps: blocks of 32, 16, 8, 4, 2 and 1 bits.
        let mut x = u64::from(x) & 0x1F_FFFF;
        x = (x | x << 32) & 0x001F_0000_0000_FFFF;
        x = (x | x << 16) & 0x001F_0000_FF00_00FF;
        x = (x | x << 8) & 0x100F_00F0_0F00_F00F;
        x = (x | x << 4) & 0x10C3_0C30_C30C_30C3;
        (x | x << 2) & 0x1249_2492_4924_9249
    };
    spread(cell[0]) | spread(cell[1]) << 1 | spread(cell[2]) << 2
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    #[test]
    fn every_code_stays_within_its_declared_error() {
        let rng = Rng::new(1, "quant", 0);
        let mut worst = [0.0f64; 4];
        for i in 0..20_000 {
            let r = rng.fork(i);
            let (a, b) = (4.0 * r.normal(0), 4.0 * r.normal(1));
            let (min, max) = (a.min(b), a.max(b));
            let levels = [15, 253, 255, 1022, 65_535][r.below(2, 5)];
            let x = min + (max - min) * r.uniform(3);
            let back = linear(linear_code(x, min, max, levels), min, max, levels);
            worst[0] = worst[0].max((back - x).abs() / ((max - min) / (2.0 * f64::from(levels))));
            let back = log(log_code(x.exp(), min, max, levels), min, max, levels);
            worst[1] = worst[1].max((back / x.exp()).ln().abs() / ((max - min) / (2.0 * f64::from(levels))));
            let half = [7, 127, 511][r.below(4, 3)];
            let y = max.abs() * (2.0 * r.uniform(5) - 1.0);
            let back = signed(signed_code(y, max.abs(), half), max.abs(), half);
            worst[2] = worst[2].max((back - y).abs() / (max.abs() / (2.0 * f64::from(half))));
            let q: [f64; 4] = std::array::from_fn(|k| r.normal(6 + k as u64));
            let (largest, codes) = quat_codes(q, half);
            let (unit, back) = (quat::normalize(q).0, quat(largest, codes, half));
            // Near 1 an arccosine has no digits left: the angle of a difference of unit vectors is 4·asin(|d|/2).
            let distance = |s: f64| (0..4).map(|k| (unit[k] - s * back[k]).powi(2)).sum::<f64>().sqrt();
            let angle = 4.0 * (distance(1.0).min(distance(-1.0)) / 2.0).asin();
            worst[3] = worst[3].max(angle * f64::from(half) / 2.5);
        }
        // Each bound holds, and is no more than twice too careful.
        assert!(worst.iter().all(|w| (0.5..1.0 + 1e-9).contains(w)), "{worst:?}");
    }

    #[test]
    fn ends_zero_and_nonsense() {
        assert_eq!((linear_code(-9.0, 1.0, 2.0, 255), linear_code(9.0, 1.0, 2.0, 255)), (0, 255));
        assert_eq!((linear_code(f64::NAN, 1.0, 2.0, 255), linear_code(3.0, 2.0, 2.0, 255)), (0, 0));
        assert_eq!((log_code(0.0, -1.0, 1.0, 255), linear(255, -3.0, 7.0, 255)), (0, 7.0));
        assert_eq!((signed_code(0.0, 0.0, 511), signed(511, 5.0, 511)), (511, 0.0));
        assert_eq!((signed_code(-9.0, 1.0, 511), signed_code(9.0, 1.0, 511)), (0, 1022));
        assert!(quat(2, [0; 3], 511).iter().all(|x| x.is_finite()), "codes that no rotation has");
    }

    #[test]
    fn morton_interleaves_bits() {
        let slow = |cell: [u32; 3]| {
            (0..MORTON_BITS as u64)
                .flat_map(|bit| (0..3).map(move |axis| (bit, axis)))
                .map(|(bit, axis)| (u64::from(cell[axis as usize]) >> bit & 1) << (3 * bit + axis))
                .sum::<u64>()
        };
        for i in 0..1000 {
            let cell = std::array::from_fn(|k| Rng::new(2, "morton", i).bits(k as u64) as u32);
            assert_eq!(morton(cell), slow(cell));
        }
    }
}
