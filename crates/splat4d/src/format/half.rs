//! The two 16-bit floating-point types of files: widened exactly, and binary16 rounded to.

/// Widens an IEEE 754 binary16 number, given by its bits; exact, NaN and infinity included.
pub(super) fn f16_to_f32(bits: u16) -> f32 {
    let sign = if bits & 0x8000 == 0 { 1.0 } else { -1.0 };
    let (exponent, fraction) = (i32::from(bits >> 10 & 0x1F), f32::from(bits & 0x3FF));
    match exponent {
        0 => sign * fraction * 2.0f32.powi(-24),
        31 if fraction == 0.0 => sign * f32::INFINITY,
        31 => f32::NAN,
        _ => sign * (1.0 + fraction / 1024.0) * 2.0f32.powi(exponent - 15),
    }
}

/// Rounds to the nearest binary16 number, ties to even; beyond ±65504 to the largest finite one. NaN gives NaN.
pub(super) fn f32_to_f16(x: f32) -> u16 {
    let sign = ((x.to_bits() >> 16) & 0x8000) as u16;
    let size = x.abs();
    if size.is_nan() {
        return sign | 0x7E00;
    }
    // Steps of the binade: 2^(e−10), and 2^-24 below 2^-14, where numbers are no longer normal.
    let exponent = ((size.to_bits() >> 23) as i32 - 127).max(-14);
    if exponent > 15 {
        return sign | 0x7BFF;
    }
    let steps = (size * 2.0f32.powi(10 - exponent)).round_ties_even() as u16;
    // A normal number has 1024..2048 steps; one that rounds up to 2048 carries into the exponent by itself.
    let bits = ((exponent + 14) as u16) * 1024 + steps;
    sign | bits.min(0x7BFF)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn landmarks_of_binary16() {
        // Values from the IEEE 754 tables: largest finite, smallest normal, smallest subnormal.
        let table =
            [(0x3C00, 1.0), (0xC000, -2.0), (0x7BFF, 65504.0), (0x0400, 6.103_515_6e-5), (0x0001, 5.960_464_5e-8)];
        for (bits, value) in table {
            assert_eq!(f16_to_f32(bits), value, "{bits:#x}");
        }
        assert_eq!(f16_to_f32(0x7C00), f32::INFINITY);
        assert!(f16_to_f32(0x7C01).is_nan());
        assert!(f16_to_f32(0x8000).is_sign_negative() && f16_to_f32(0x8000) == 0.0);
    }

    #[test]
    fn every_binary16_number_round_trips_and_others_are_rounded() {
        for bits in 0..=u16::MAX {
            let x = f16_to_f32(bits);
            if x.is_nan() {
                assert!(f16_to_f32(f32_to_f16(x)).is_nan());
            } else if x.is_finite() {
                assert_eq!(f32_to_f16(x), bits, "{bits:#x}");
                let next = f16_to_f32(bits + 1);
                if next.is_finite() && bits & 0x7FFF < 0x7BFF {
                    let (low, high) = (x + 0.4 * (next - x), x + 0.6 * (next - x));
                    assert_eq!((f32_to_f16(low), f32_to_f16(high)), (bits, bits + 1), "{bits:#x}");
                    assert_eq!(f32_to_f16(0.5 * (x + next)) & 1, 0, "ties go to even: {bits:#x}");
                }
            }
        }
        assert_eq!((f32_to_f16(1e9), f32_to_f16(f32::NEG_INFINITY)), (0x7BFF, 0xFBFF));
    }
}
