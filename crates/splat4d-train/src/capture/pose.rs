//! Poses as data sets write them, checked and brought to `cam_from_world` in OpenCV axes.

use splat4d::math::Se3;
use splat4d::math::se3::{mat_mul, norm, sub, transpose};
use splat4d::scene::{Camera, Intrinsics};
use splat4d::{Error, Result};

/// Poses closer than this, relative to the distance from the origin, are one pose.
pub(super) const SAME_POSE: f64 = 1e-9;

/// Largest |R Rᵀ − I| of a rotation that is accepted: poses typed with three decimals stay below it, scaled or sheared
/// ones do not.
const MAX_SHEAR: f64 = 0.02;
/// Newton-Schulz steps that make an accepted matrix a rotation: the error squares with each, 0.02 → 1e-15 in three.
const POLAR_STEPS: usize = 4;
/// Longest side of an image, pixels: twice the largest sensors in use.
pub(super) const MAX_SIDE: usize = 1 << 15;
/// Farthest coordinate of a camera or a point that is accepted, scene units: sums of squares and cubes of it still fit
/// 32-bit floats. Metres of a map are a hundred thousand times smaller.
pub(super) const FARTHEST: f64 = 1e12;
/// Shortest and longest focal length that is accepted, and farthest principal point, pixels: their products with
/// [`FARTHEST`] and their reciprocals stay finite in 32-bit floats.
const FOCAL: std::ops::RangeInclusive<f64> = 1e-3..=1e9;
/// Latest time of an image that is accepted, seconds (thirty thousand years): frames of it remain distinct.
pub(super) const LATEST: f64 = 1e12;
/// Most pixels of an image (134 million): decoding one takes below 1 GiB.
pub(super) const MAX_PIXELS: usize = 1 << 27;

/// Checks that `pose` is a rigid motion and removes rounding from its rotation.
pub(super) fn checked(pose: Se3) -> Result<Se3> {
    let finite = pose.rotation.iter().flatten().chain(&pose.translation).all(|x| x.is_finite());
    if !finite {
        return Err(Error::input("the pose holds NaN or infinity")
            .remedy("Calibrate that camera again or leave its frames out."));
    }
    if let Some(far) = pose.translation.iter().find(|x| x.abs() > FARTHEST) {
        return Err(Error::input(format!("invalid pose: a coordinate is {far:e}, beyond {FARTHEST:e}"))
            .remedy("Calibrate that camera again or leave its frames out."));
    }
    if pose.det() < 0.0 {
        return Err(Error::input("the pose is mirrored (its rotation has determinant −1)").remedy(
            "One axis has the wrong sign: check whether the file's axes are OpenCV (x right, y down, z forward) or \
             OpenGL (y up, z backward), and that no two axes are exchanged.",
        ));
    }
    let shear = pose.orthogonality_error();
    if shear > MAX_SHEAR {
        return Err(Error::input(format!("invalid pose: not a rigid motion (its rotation is off by {shear:.3})"))
            .remedy("Remove scale and shear from the matrix, and write it row by row with at least four decimals."));
    }
    Ok(Se3 { rotation: nearest_rotation(pose.rotation), ..pose })
}

/// R ← R (3 I − Rᵀ R) / 2, the Newton-Schulz iteration for the orthogonal polar factor.
fn nearest_rotation(mut r: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    for _ in 0..POLAR_STEPS {
        let gram = mat_mul(&transpose(&r), &r);
        let step: [[f64; 3]; 3] =
            std::array::from_fn(|i| std::array::from_fn(|j| 1.5 * f64::from(u8::from(i == j)) - 0.5 * gram[i][j]));
        r = mat_mul(&r, &step);
    }
    r
}

/// Checks focal lengths, principal point and size.
pub(super) fn check_intrinsics(k: &Intrinsics, width: usize, height: usize) -> Result<()> {
    let [fx, fy] = [k.fx, k.fy];
    if ![fx, fy].iter().all(|f| FOCAL.contains(f)) {
        return Err(Error::input(format!("invalid focal length {} x {}", short(fx), short(fy)))
            .remedy("Give focal lengths in pixels, above zero."));
    }
    if ![k.cx, k.cy].iter().all(|c| c.abs() <= *FOCAL.end()) {
        return Err(Error::input(format!("invalid principal point {} {}", short(k.cx), short(k.cy)))
            .remedy("Give it in pixels; the middle of the image is width/2, height/2."));
    }
    check_size(width, height)
}

/// A number in a message: not three hundred digits of one that is absurd.
pub(super) fn short(x: f64) -> String {
    if x == 0.0 || (1e-3..1e9).contains(&x.abs()) { x.to_string() } else { format!("{x:e}") }
}

/// Checks that an image of this size can be handled at all.
pub(super) fn check_size(width: usize, height: usize) -> Result<()> {
    let fits = (1..=MAX_SIDE).contains(&width) && (1..=MAX_SIDE).contains(&height) && width * height <= MAX_PIXELS;
    if fits {
        return Ok(());
    }
    Err(Error::input(format!("the image size {width}x{height} is not possible"))
        .remedy(format!("Sides must be 1 to {MAX_SIDE} pixels, at most {MAX_PIXELS} in all.")))
}

/// Whether two cameras have one position and one orientation.
pub(super) fn same_pose(a: &Camera, b: &Camera) -> bool {
    let (p, q) = (&a.cam_from_world, &b.cam_from_world);
    let turn = p.rotation.iter().flatten().zip(q.rotation.iter().flatten()).map(|(x, y)| (x - y).abs());
    let moved = norm(sub(p.translation, q.translation));
    turn.fold(0.0, f64::max) <= SAME_POSE && moved <= SAME_POSE * (1.0 + norm(p.translation))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bad_poses_are_named_and_rounded_ones_repaired() {
        let good = Se3::look_at([1.0, 2.0, 3.0], [0.0; 3], [0.0, 0.0, 1.0]);
        let mut rounded = good;
        rounded.rotation.iter_mut().flatten().for_each(|x| *x = (*x * 1e3).round() / 1e3);
        assert!(rounded.orthogonality_error() > 1e-5);
        assert!(checked(rounded).unwrap().orthogonality_error() < 1e-13);
        let mut mirrored = good;
        mirrored.rotation[0] = mirrored.rotation[0].map(|x| -x);
        assert!(checked(mirrored).unwrap_err().to_string().contains("mirrored"));
        let mut scaled = good;
        scaled.rotation.iter_mut().flatten().for_each(|x| *x *= 2.0);
        assert!(checked(scaled).unwrap_err().to_string().contains("not a rigid motion"));
        let mut nan = good;
        nan.translation[1] = f64::NAN;
        assert!(checked(nan).unwrap_err().to_string().contains("NaN"));
    }

    #[test]
    fn cameras_that_cannot_be_computed_with_are_refused() {
        let good = Se3::look_at([1.0, 2.0, 3.0], [0.0; 3], [0.0, 0.0, 1.0]);
        for far in [1e13, -1e39, 1e308] {
            let mut pose = good;
            pose.translation[0] = far;
            assert!(checked(pose).unwrap_err().to_string().contains(&format!("a coordinate is {far:e}")));
        }
        let k = Intrinsics { fx: 50.0, fy: 50.0, cx: 16.0, cy: 12.0 };
        assert!(check_intrinsics(&k, 32, 24).is_ok());
        for fx in [0.0, -1e308, 1e-320, 1e39, f64::NAN, f64::INFINITY] {
            let text = check_intrinsics(&Intrinsics { fx, ..k }, 32, 24).unwrap_err().to_string();
            assert!(text.contains("focal length") && text.len() < 120, "{text}");
        }
        for cy in [-1e308, 1e39, f64::NAN] {
            assert!(
                check_intrinsics(&Intrinsics { cy, ..k }, 32, 24).unwrap_err().to_string().contains("principal point")
            );
        }
    }
}
