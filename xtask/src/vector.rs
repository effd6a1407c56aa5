//! Vectors, quaternions, affine matrices and angles in f64, built from + − × ÷ √ alone: those are exact by IEEE 754, so
//! the images are the same bits on every machine (the platform's `sin` and `pow` are not).

use std::ops::{Add, Mul, Neg, Sub};

/// A point, direction or linear colour.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct V3 {
    /// First component.
    pub x: f64,
    /// Second component.
    pub y: f64,
    /// Third component.
    pub z: f64,
}

/// Shorthand for a vector.
pub(crate) const fn v3(x: f64, y: f64, z: f64) -> V3 {
    V3 { x, y, z }
}

impl V3 {
    /// Scalar product.
    pub(crate) fn dot(self, o: V3) -> f64 {
        self.x * o.x + self.y * o.y + self.z * o.z
    }

    /// Vector product.
    pub(crate) fn cross(self, o: V3) -> V3 {
        v3(self.y * o.z - self.z * o.y, self.z * o.x - self.x * o.z, self.x * o.y - self.y * o.x)
    }

    /// Euclidean length.
    pub(crate) fn length(self) -> f64 {
        self.dot(self).sqrt()
    }

    /// Unit vector; the zero vector stays zero.
    pub(crate) fn unit(self) -> V3 {
        let length = self.length();
        if length > 0.0 { self * (1.0 / length) } else { self }
    }

    /// Component-wise product (colours).
    pub(crate) fn scaled_by(self, o: V3) -> V3 {
        v3(self.x * o.x, self.y * o.y, self.z * o.z)
    }

    /// `self` at s = 0, `o` at s = 1.
    pub(crate) fn lerp(self, o: V3, s: f64) -> V3 {
        self + (o - self) * s
    }

    /// The components as an array.
    pub(crate) fn array(self) -> [f64; 3] {
        [self.x, self.y, self.z]
    }
}

impl Add for V3 {
    type Output = V3;
    fn add(self, o: V3) -> V3 {
        v3(self.x + o.x, self.y + o.y, self.z + o.z)
    }
}

impl Sub for V3 {
    type Output = V3;
    fn sub(self, o: V3) -> V3 {
        v3(self.x - o.x, self.y - o.y, self.z - o.z)
    }
}

impl Mul<f64> for V3 {
    type Output = V3;
    fn mul(self, s: f64) -> V3 {
        v3(self.x * s, self.y * s, self.z * s)
    }
}

impl Neg for V3 {
    type Output = V3;
    fn neg(self) -> V3 {
        v3(-self.x, -self.y, -self.z)
    }
}

/// Quaternion (x, y, z, w), the glTF order.
pub(crate) type Quat = [f64; 4];

/// Normalised linear interpolation along the shorter arc. At the clips' 30 keys per second it differs from slerp by
/// less than 1e-3 rad, and it needs no arc cosine.
pub(crate) fn nlerp(a: Quat, b: Quat, s: f64) -> Quat {
    let dot: f64 = (0..4).map(|i| a[i] * b[i]).sum();
    let sign = if dot < 0.0 { -1.0 } else { 1.0 };
    let q: [f64; 4] = std::array::from_fn(|i| a[i] * (1.0 - s) + sign * b[i] * s);
    let norm = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    if norm > 0.0 { q.map(|c| c / norm) } else { a }
}

/// Affine map: columns `x y z` (images of the axes) and the origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Affine {
    /// Image of the x axis.
    pub x: V3,
    /// Image of the y axis.
    pub y: V3,
    /// Image of the z axis.
    pub z: V3,
    /// Image of the origin.
    pub origin: V3,
}

impl Affine {
    /// The identity.
    pub(crate) const IDENTITY: Affine =
        Affine { x: v3(1.0, 0.0, 0.0), y: v3(0.0, 1.0, 0.0), z: v3(0.0, 0.0, 1.0), origin: v3(0.0, 0.0, 0.0) };

    /// Translation · rotation · scale, the glTF node order.
    pub(crate) fn from_trs(translation: V3, rotation: Quat, scale: V3) -> Affine {
        let [x, y, z, w] = rotation;
        Affine {
            x: v3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)) * scale.x,
            y: v3(2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)) * scale.y,
            z: v3(2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)) * scale.z,
            origin: translation,
        }
    }

    /// A standing placement: the +z axis turned to (sin a, 0, cos a), then moved to `origin`.
    pub(crate) fn standing(origin: V3, angle: f64) -> Affine {
        let (sin, cos) = sin_cos(angle);
        Affine { x: v3(cos, 0.0, -sin), y: v3(0.0, 1.0, 0.0), z: v3(sin, 0.0, cos), origin }
    }

    /// From 16 column-major numbers (glTF).
    pub(crate) fn from_columns(m: &[f64]) -> Affine {
        let column = |i: usize| v3(m[4 * i], m[4 * i + 1], m[4 * i + 2]);
        Affine { x: column(0), y: column(1), z: column(2), origin: column(3) }
    }

    /// `self` after `o`.
    pub(crate) fn compose(&self, o: &Affine) -> Affine {
        Affine { x: self.turn(o.x), y: self.turn(o.y), z: self.turn(o.z), origin: self.point(o.origin) }
    }

    /// Maps a point.
    pub(crate) fn point(&self, p: V3) -> V3 {
        self.turn(p) + self.origin
    }

    /// Maps a direction (no translation).
    pub(crate) fn turn(&self, d: V3) -> V3 {
        self.x * d.x + self.y * d.y + self.z * d.z
    }

    /// Σ weight · map, for linear blend skinning.
    pub(crate) fn add_scaled(&mut self, o: &Affine, weight: f64) {
        self.x = self.x + o.x * weight;
        self.y = self.y + o.y * weight;
        self.z = self.z + o.z * weight;
        self.origin = self.origin + o.origin * weight;
    }
}

/// Sine and cosine by Taylor series after reduction to ±π/4 (error below 1e-15 for |a| < 100).
pub(crate) fn sin_cos(a: f64) -> (f64, f64) {
    let quarter = (a / std::f64::consts::FRAC_PI_2).round();
    let r = a - quarter * std::f64::consts::FRAC_PI_2;
    let (mut sin, mut cos, mut term) = (0.0, 0.0, 1.0);
    // Terms rⁿ/n!, the signs in pairs: + + − −.
    for n in 0..20 {
        let signed = if n % 4 < 2 { term } else { -term };
        if n % 2 == 0 {
            cos += signed;
        } else {
            sin += signed;
        }
        term *= r / f64::from(n + 1);
    }
    match (quarter as i64).rem_euclid(4) {
        0 => (sin, cos),
        1 => (cos, -sin),
        2 => (-sin, -cos),
        _ => (-cos, sin),
    }
}

/// Angle of the direction (sin a, cos a) = (s, c), for headings; Newton steps on [`sin_cos`] from a coarse guess.
pub(crate) fn heading(s: f64, c: f64) -> f64 {
    let norm = (s * s + c * c).sqrt();
    let (s, c) = (s / norm, c / norm);
    let mut a = if c >= 0.0 { s } else { std::f64::consts::PI * (if s < 0.0 { -1.0 } else { 1.0 }) - s };
    for _ in 0..8 {
        let (sin, cos) = sin_cos(a);
        a += s * cos - c * sin;
    }
    a
}

/// 0 below `from`, 1 above `to`, 3s² − 2s³ between.
pub(crate) fn smooth_step(from: f64, to: f64, x: f64) -> f64 {
    let s = ((x - from) / (to - from)).clamp(0.0, 1.0);
    s * s * (3.0 - 2.0 * s)
}

/// A fixed number in [0, 1) for a pair of integers (SplitMix64 finaliser, Steele et al. 2014).
pub(crate) fn hash01(a: i64, b: i64) -> f64 {
    let mut z = (a as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (b as u64).wrapping_mul(0xD134_2543_DE82_EF95);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_match_the_standard_library() {
        for i in -200..200 {
            let a = f64::from(i) * 0.0731;
            let (sin, cos) = sin_cos(a);
            assert!((sin - a.sin()).abs() < 1e-14 && (cos - a.cos()).abs() < 1e-14, "at {a}");
            let back = heading(sin, cos);
            assert!((back.sin() - sin).abs() < 1e-12 && (back.cos() - cos).abs() < 1e-12, "heading at {a}");
        }
    }

    #[test]
    fn trs_is_translation_after_rotation_after_scale() {
        let (s, c) = sin_cos(0.4);
        let map = Affine::from_trs(v3(1.0, 2.0, 3.0), [0.0, s, 0.0, c], v3(2.0, 2.0, 2.0));
        let expect = Affine::standing(v3(1.0, 2.0, 3.0), 0.8).point(v3(0.6, 0.2, -1.0));
        assert!((map.point(v3(0.3, 0.1, -0.5)) - expect).length() < 1e-12);
    }
}
