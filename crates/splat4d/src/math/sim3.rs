//! Similarities of space in f64: rotation, translation and scale.

use super::se3::{mat_mul, mat_vec, transpose};
use super::{Real, Se3};

/// A rotation, a scale and a translation, named by direction at the use (`world_from_layer`): y = s R x + t.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sim3 {
    /// s > 0
    pub scale: f64,
    /// Rows of the rotation matrix R.
    pub rotation: [[f64; 3]; 3],
    /// t, in the target's unit of length.
    pub translation: [f64; 3],
}

/// Largest |R Rᵀ − I| and |det R − 1| of a rotation: products of matrices and decimal text stay far below.
const ORTHOGONAL: f64 = 1e-6;

impl Default for Sim3 {
    fn default() -> Self {
        Self::IDENTITY
    }
}

impl Sim3 {
    /// The similarity that moves nothing.
    pub(crate) const IDENTITY: Self =
        Self { scale: 1.0, rotation: Se3::IDENTITY.rotation, translation: Se3::IDENTITY.translation };

    /// A rotation (rows) alone.
    pub fn from_rotation(rotation: [[f64; 3]; 3]) -> Self {
        Self { rotation, ..Self::IDENTITY }
    }

    /// Whether it is exactly the identity.
    pub fn is_identity(&self) -> bool {
        *self == Self::IDENTITY
    }

    /// Whether its numbers are finite, the scale positive and the matrix a rotation.
    pub(crate) fn is_sound(&self) -> bool {
        let pose = Se3 { rotation: self.rotation, translation: self.translation };
        self.scale.is_finite()
            && self.scale > 0.0
            && self.translation.iter().all(|x| x.is_finite())
            && pose.orthogonality_error() <= ORTHOGONAL
            && (pose.det() - 1.0).abs() <= ORTHOGONAL
    }

    /// s R x + t
    pub fn apply(&self, x: [f64; 3]) -> [f64; 3] {
        let (r, t) = (self.vector(x), self.translation);
        [r[0] + t[0], r[1] + t[1], r[2] + t[2]]
    }

    /// s R v: what becomes of a difference of points, or of a velocity.
    pub fn vector(&self, v: [f64; 3]) -> [f64; 3] {
        mat_vec(&self.rotation, v).map(|x| self.scale * x)
    }

    /// `self` after `first`: x ↦ self(first(x)).
    pub(crate) fn after(&self, first: &Self) -> Self {
        Self {
            scale: self.scale * first.scale,
            rotation: mat_mul(&self.rotation, &first.rotation),
            translation: self.apply(first.translation),
        }
    }

    /// x = Rᵀ (y − t) / s
    pub(crate) fn inverse(&self) -> Self {
        let (scale, rotation) = (1.0 / self.scale, transpose(&self.rotation));
        let translation = mat_vec(&rotation, self.translation).map(|x| -scale * x);
        Self { scale, rotation, translation }
    }

    /// The pose `cam_from_world` of a camera in the world that this leads to.
    pub fn pose(&self, pose: &Se3) -> Se3 {
        let center = self.apply(pose.inverse().translation);
        let rotation = mat_mul(&pose.rotation, &transpose(&self.rotation));
        let translation = mat_vec(&rotation, center).map(|v| -v);
        Se3 { rotation, translation }
    }

    /// The matrix s R.
    pub(crate) fn linear<F: Real>(&self) -> [[F; 3]; 3] {
        self.rotation.map(|row| row.map(|x| F::of(self.scale * x)))
    }

    /// Rᵀ, which takes directions of the target back to the source; none where R is the identity.
    pub(crate) fn directions<F: Real>(&self) -> Option<[[F; 3]; 3]> {
        let r = &self.rotation;
        (*r != Self::IDENTITY.rotation).then(|| std::array::from_fn(|i| std::array::from_fn(|j| F::of(r[j][i]))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::quat;

    #[test]
    fn a_composition_is_one_after_the_other() {
        let rotation = |q| quat::to_rotation(quat::normalize(q).0);
        let a = Sim3 { scale: 2.0, rotation: rotation([0.9, 0.1, -0.4, 0.3]), translation: [1.0, -2.0, 0.5] };
        let b = Sim3 { scale: 0.3, rotation: rotation([0.2, 0.7, 0.1, -0.5]), translation: [-0.4, 0.1, 3.0] };
        let x = [0.3, -1.2, 0.8];
        let (one, two) = (a.after(&b).apply(x), a.apply(b.apply(x)));
        assert!((0..3).all(|k| (one[k] - two[k]).abs() < 1e-12));
        assert!(a.is_sound() && a.after(&b).is_sound() && Sim3::default().is_identity());
        let back = a.directions::<f64>().unwrap();
        let there = mat_vec(&back, a.vector(x).map(|v| v / a.scale));
        assert!((0..3).all(|k| (there[k] - x[k]).abs() < 1e-12));
    }

    #[test]
    fn non_similarities_are_recognised() {
        let mirror = [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        assert!(!Sim3::from_rotation(mirror).is_sound());
        assert!(!Sim3::from_rotation([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]).is_sound());
        for scale in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(!Sim3 { scale, ..Sim3::IDENTITY }.is_sound());
        }
        assert!(!Sim3 { translation: [0.0, f64::NAN, 0.0], ..Sim3::IDENTITY }.is_sound());
    }
}
