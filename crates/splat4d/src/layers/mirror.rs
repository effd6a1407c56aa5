//! Mirrors static Gaussians along an axis, for left-handed programs.

use crate::scene::params::QUAT;
use crate::scene::{GEOMETRY, Params, SH};

/// Coefficients of spherical harmonics that change sign with x, y and z: those with an odd power of it.
const ODD: [[usize; 6]; 3] = [[3, 4, 7, 10, 13, 15], [1, 4, 5, 9, 10, 11], [2, 5, 7, 10, 12, 14]];

/// Mirrors means, rotations and spherical harmonics along axis 0, 1 or 2. Panics: another axis.
pub(crate) fn mirror(params: &mut Params, axis: usize) {
    let [geometry, sh] = params.get_mut([GEOMETRY, SH]);
    for row in 0..geometry.rows() {
        geometry.set(row, axis, -geometry.get(row, axis));
        // A reflection keeps the component of its own axis, because rotations are axial.
        for k in (0..3).filter(|k| *k != axis) {
            geometry.set(row, QUAT + 1 + k, -geometry.get(row, QUAT + 1 + k));
        }
        let width = sh.width();
        for k in ODD[axis].into_iter().filter(|k| 3 * k < width) {
            (3 * k..3 * k + 3).for_each(|c| sh.set(row, c, -sh.get(row, c)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::{Rng, quat, sh};

    #[test]
    fn a_mirrored_world_shows_mirrored_shapes_and_colours() {
        let mut before = Params::new(9, 16, &[]);
        let rng = Rng::new(5, "mirror", 0);
        for key in [GEOMETRY, SH] {
            let width = before[key].width();
            for (row, col) in (0..9).flat_map(|r| (0..width).map(move |c| (r, c))) {
                before[key].set(row, col, rng.fork(width as u64).normal((row * 64 + col) as u64) as f32);
            }
        }
        for axis in 0..3 {
            let flip = |v: [f64; 3]| std::array::from_fn::<f64, 3, _>(|k| if k == axis { -v[k] } else { v[k] });
            let mut after = before.clone();
            mirror(&mut after, axis);
            for row in 0..9 {
                let [a, b] = [&before, &after].map(|p| p[GEOMETRY].read::<3>(row, 0).map(f64::from));
                assert_eq!(flip(a), b);
                let rotation =
                    |p: &Params| quat::to_rotation(quat::normalize(p[GEOMETRY].read::<4>(row, QUAT).map(f64::from)).0);
                let [r, s] = [&before, &after].map(rotation);
                for k in 0..3 {
                    let [a, b] = [r, s].map(|m| [m[0][k], m[1][k], m[2][k]]);
                    let dot: f64 = flip(a).iter().zip(b).map(|(a, b)| a * b).sum();
                    assert!((dot.abs() - 1.0).abs() < 1e-5, "axis {axis}: {a:?} {b:?}");
                }
                let seen = |p: &Params, d: [f64; 3]| {
                    let (basis, f) = (sh::basis(d), p[SH].read::<48>(row, 0));
                    (0..16).map(|k| basis[k] * f64::from(f[3 * k])).sum::<f64>()
                };
                let direction = [0.48, -0.6, 0.64];
                assert!((seen(&before, direction) - seen(&after, flip(direction))).abs() < 1e-5, "axis {axis}");
            }
        }
    }
}
