//! Rigid motions and 3-vectors in f64: poses are few, so they are kept exact.

pub use super::vec3::{cross, dot};

/// A rotation and a translation, named by direction at the use (`cam_from_world`): y = R x + t.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Se3 {
    /// Rows of the rotation matrix.
    pub rotation: [[f64; 3]; 3],
    /// Translation, in the target's frame.
    pub translation: [f64; 3],
}

impl Se3 {
    /// The motion that moves nothing.
    pub const IDENTITY: Self =
        Self { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0; 3] };

    /// From a row-major 4x4 (its last row is not read).
    pub fn from_rows(m: &[[f64; 4]; 4]) -> Self {
        let r = |i: usize| [m[i][0], m[i][1], m[i][2]];
        Self { rotation: [r(0), r(1), r(2)], translation: [m[0][3], m[1][3], m[2][3]] }
    }

    /// R x + t
    pub fn apply(&self, x: [f64; 3]) -> [f64; 3] {
        let r = mat_vec(&self.rotation, x);
        [r[0] + self.translation[0], r[1] + self.translation[1], r[2] + self.translation[2]]
    }

    /// The inverse motion.
    pub fn inverse(&self) -> Self {
        let rotation = transpose(&self.rotation);
        let t = mat_vec(&rotation, self.translation);
        Self { rotation, translation: [-t[0], -t[1], -t[2]] }
    }

    /// `self` after `first`: x ↦ self(first(x)).
    pub fn after(&self, first: &Self) -> Self {
        Self { rotation: mat_mul(&self.rotation, &first.rotation), translation: self.apply(first.translation) }
    }

    /// The pose `cam_from_world` of a camera at `eye` that looks at `target` with `up` upwards in its image
    /// (OpenCV axes: x right, y down, z forward).
    pub fn look_at(eye: [f64; 3], target: [f64; 3], up: [f64; 3]) -> Self {
        let z = normalize(sub(target, eye));
        let mut x = cross(z, up);
        if dot(x, x) < 1e-12 {
            // Looking along `up`: any horizontal will do.
            x = cross(z, if z[0].abs() < 0.9 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] });
        }
        let x = normalize(x);
        let y = cross(z, x);
        let rotation = [x, y, z];
        let t = mat_vec(&rotation, eye);
        Self { rotation, translation: [-t[0], -t[1], -t[2]] }
    }

    /// det R; +1 for a rotation, −1 for a mirror.
    pub fn det(&self) -> f64 {
        let [a, b, c] = self.rotation;
        dot(a, cross(b, c))
    }

    /// The largest |R Rᵀ − I|.
    pub fn orthogonality_error(&self) -> f64 {
        let p = mat_mul(&self.rotation, &transpose(&self.rotation));
        let mut worst = 0.0f64;
        for (i, row) in p.iter().enumerate() {
            for (j, v) in row.iter().enumerate() {
                worst = worst.max((v - f64::from(u8::from(i == j))).abs());
            }
        }
        worst
    }
}

/// Matrix times vector.
pub fn mat_vec(m: &[[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
    [dot(m[0], v), dot(m[1], v), dot(m[2], v)]
}

/// Matrix product.
pub fn mat_mul(a: &[[f64; 3]; 3], b: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

/// Transpose.
pub fn transpose(m: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    std::array::from_fn(|i| std::array::from_fn(|j| m[j][i]))
}

/// a − b
pub fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// a + b
pub fn add(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// s a
pub fn scale(a: [f64; 3], s: f64) -> [f64; 3] {
    a.map(|x| s * x)
}

/// Length.
pub fn norm(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

/// Unit vector; the zero vector stays zero.
pub fn normalize(a: [f64; 3]) -> [f64; 3] {
    let n = norm(a);
    if n > 0.0 { [a[0] / n, a[1] / n, a[2] / n] } else { a }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn look_at_puts_the_target_ahead_with_up_upwards() {
        let pose = Se3::look_at([3.0, 1.0, -2.0], [0.0, 0.5, 0.0], [0.0, 1.0, 0.0]);
        let p = pose.apply([0.0, 0.5, 0.0]);
        assert!(p[0].abs() < 1e-12 && p[1].abs() < 1e-12 && p[2] > 0.0);
        assert!(pose.apply([0.0, 1.5, 0.0])[1] < 0.0, "up must be at negative y (OpenCV)");
        assert!((pose.det() - 1.0).abs() < 1e-12 && pose.orthogonality_error() < 1e-12);
        let id = pose.inverse().after(&pose);
        assert!(norm(sub(id.apply([1.0, 2.0, 3.0]), [1.0, 2.0, 3.0])) < 1e-12);
    }
}
