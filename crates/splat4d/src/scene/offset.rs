//! Coordinates far from the origin. f32 has 24 bits: at 5,000,000 m (UTM) its steps are half a metre. Readers subtract an
//! offset in f64 before f32 begins; a scene stores it ([`Scene::offset`](crate::layers::Scene::offset)) as metadata.

use crate::math::se3::{norm, sub};

/// Coordinates above this many sizes of the scene are coarse in f32: a step (2⁻²³ of the coordinate) then exceeds 2⁻¹⁹ of
/// the size, which is about the last position step of training (1.6·10⁻⁶ extents; Kerbl 2023), so that steps are lost.
const FAR: f64 = 16.0;
/// Coordinates up to here are never coarse, scene units: f32 resolves 2⁻¹⁷ of a unit. Scenes whose size is not known (one
/// camera, no points) keep their coordinates too.
const NEAR: f64 = 64.0;

/// The offset to subtract from positions in f64 before they become f32; zero where f32 resolves them well.
///
/// `fixed`: positions that count in full (cameras); `loose`: positions with outliers (points), of which the median distance
/// counts. The offset is rounded to a power of two below the size, so that it is exact and that captures of one place with
/// slightly different cameras have the same one.
pub fn offset_of(fixed: &[[f64; 3]], loose: &[[f64; 3]]) -> [f64; 3] {
    let all = if fixed.is_empty() { loose } else { fixed };
    let middle: [f64; 3] = std::array::from_fn(|k| {
        let mut values: Vec<f64> = all.iter().map(|p| p[k]).filter(|x| x.is_finite()).collect();
        if values.is_empty() {
            return 0.0;
        }
        if fixed.is_empty() {
            let at = values.len() / 2;
            return *values.select_nth_unstable_by(at, f64::total_cmp).1;
        }
        let (low, high) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &x| (l.min(x), h.max(x)));
        0.5 * (low + high)
    });
    let distance = |p: &[f64; 3]| norm(sub(*p, middle));
    let mut far: Vec<f64> = loose.iter().map(distance).filter(|d| d.is_finite()).collect();
    let at = far.len() / 2;
    let inner = if far.is_empty() { 0.0 } else { *far.select_nth_unstable_by(at, f64::total_cmp).1 };
    let size = fixed.iter().map(distance).filter(|d| d.is_finite()).fold(inner, f64::max);
    let most = middle.iter().fold(0.0f64, |m, x| m.max(x.abs()));
    if most <= NEAR || most <= FAR * size {
        return [0.0; 3];
    }
    // Steps of at least 1e-3 keep the offset short in text.
    let step = size.clamp(1e-3, most).log2().floor().exp2();
    middle.map(|x| (x / step).round() * step)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ring(center: [f64; 3], radius: f64) -> Vec<[f64; 3]> {
        let at = |i: i32| f64::from(i).sin_cos();
        (0..12).map(|i| [center[0] + radius * at(i).0, center[1] + radius * at(i).1, center[2]]).collect()
    }

    #[test]
    fn near_scenes_keep_their_coordinates_and_far_ones_get_a_round_offset() {
        for center in [[0.0; 3], [3.0, -2.0, 60.0], [500.0, 0.0, 0.0]] {
            assert_eq!(offset_of(&ring(center, 40.0), &[]), [0.0; 3], "{center:?}");
        }
        let center = [431_234.5, 5_412_345.6, 310.2];
        let offset = offset_of(&ring(center, 4.0), &[]);
        assert!((0..3).all(|k| (offset[k] - center[k]).abs() <= 4.0 && offset[k].fract() == 0.0), "{offset:?}");
        let moved = ring([center[0] + 0.1, center[1], center[2]], 4.1);
        assert_eq!(offset_of(&moved, &[]), offset, "one place has one offset");
        assert_eq!(
            offset_of(&ring([100.0, 0.0, 0.0], 1.0), &ring([100.0, 0.0, 0.0], 9.0)),
            [0.0; 3],
            "points are size"
        );
        // One far outlier is not the size, nor does it move the middle of a cloud.
        let mut cloud = ring(center, 4.0);
        cloud.push([1e9; 3]);
        cloud.push([f64::NAN; 3]);
        let offset = offset_of(&[], &cloud);
        assert!((0..3).all(|k| (offset[k] - center[k]).abs() <= 8.0), "{offset:?}");
        assert_eq!(offset_of(&[], &[]), [0.0; 3]);
        let one = offset_of(&[[1e6, 0.0, 0.0]], &[]);
        assert!((one[0] - 1e6).abs() < 1e-2, "{one:?}");
    }
}
