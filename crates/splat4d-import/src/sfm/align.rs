//! Where one set of cameras stands in the world of another, and how far they are apart there.

use super::two_view::turn_between;
use splat4d::math::Se3;
use splat4d::math::mat3::procrustes;
use splat4d::math::se3::{dot, mat_mul, mat_vec, norm, normalize, sub, transpose};

/// A similarity: x ↦ s R x + t.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// s
    pub scale: f64,
    /// Rows of R.
    pub rotation: [[f64; 3]; 3],
    /// t
    pub translation: [f64; 3],
}

impl Similarity {
    /// s R x + t
    pub fn apply(&self, x: [f64; 3]) -> [f64; 3] {
        let r = mat_vec(&self.rotation, x);
        std::array::from_fn(|k| self.scale * r[k] + self.translation[k])
    }

    /// The pose `cam_from_world` of a camera in the world that this leads to.
    pub fn pose(&self, pose: &Se3) -> Se3 {
        let center = self.apply(pose.inverse().translation);
        let rotation = mat_mul(&pose.rotation, &transpose(&self.rotation));
        let translation = mat_vec(&rotation, center).map(|v| -v);
        Se3 { rotation, translation }
    }
}

fn mean(points: &[[f64; 3]]) -> [f64; 3] {
    let n = points.len() as f64;
    points.iter().fold([0.0; 3], |sum, p| std::array::from_fn(|k| sum[k] + p[k] / n))
}

/// The similarity of least squares that takes points to others (Umeyama 1991). `None`: fewer than two, or all in one place.
pub fn similarity(from: &[[f64; 3]], to: &[[f64; 3]]) -> Option<Similarity> {
    assert_eq!(from.len(), to.len(), "every point has one that it is taken to");
    if from.len() < 2 {
        return None;
    }
    let (here, there) = (mean(from), mean(to));
    let mut cov = [[0.0; 3]; 3];
    let mut spread = 0.0;
    for (a, b) in from.iter().zip(to) {
        let (a, b) = (sub(*a, here), sub(*b, there));
        (0..9).for_each(|k| cov[k / 3][k % 3] += b[k / 3] * a[k % 3]);
        spread += dot(a, a);
    }
    if spread <= 0.0 {
        return None;
    }
    let rotation = procrustes(cov);
    let scale = (0..9).map(|k| rotation[k / 3][k % 3] * cov[k / 3][k % 3]).sum::<f64>() / spread;
    if scale <= 0.0 || !scale.is_finite() {
        return None;
    }
    let turned = mat_vec(&rotation, here);
    Some(Similarity { scale, rotation, translation: std::array::from_fn(|k| there[k] - scale * turned[k]) })
}

/// How far a camera is from its truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Apart {
    /// Of the rotations, degrees.
    pub degrees: f64,
    /// Of the centres, of the rig's radius: the root mean square distance of the true centres from their mean.
    pub center: f64,
}

/// How far cameras are from their truth, once the similarity between their centres is taken away. `None`: there is none.
pub fn apart(poses: &[Se3], truth: &[Se3]) -> Option<Vec<Apart>> {
    let centers = |p: &[Se3]| p.iter().map(|q| q.inverse().translation).collect::<Vec<_>>();
    let (from, to) = (centers(poses), centers(truth));
    let by = similarity(&from, &to)?;
    let middle = mean(&to);
    let square = |x: [f64; 3]| dot(sub(x, middle), sub(x, middle));
    let radius = (to.iter().map(|&x| square(x)).sum::<f64>() / to.len() as f64).sqrt();
    let of = |(pose, truth): (&Se3, &Se3)| {
        let moved = by.pose(pose);
        let degrees = turn_between(&moved.rotation, &truth.rotation).to_degrees();
        let center = norm(sub(moved.inverse().translation, truth.inverse().translation)) / radius;
        Apart { degrees, center }
    };
    Some(poses.iter().zip(truth).map(of).collect())
}

/// The direction that most cameras hold upwards: the mean of their −y axes.
pub fn up_of(poses: &[Se3]) -> [f64; 3] {
    let sum = poses.iter().fold([0.0; 3], |s, p| std::array::from_fn(|k| s[k] - p.rotation[1][k]));
    normalize(sum)
}

/// The median distance of the cameras from what they look at: of each, the median distance of the points that it sees. With it
/// as the unit, a scene is of a size that is known, where no length is.
pub fn median_distance(distances: &mut [Vec<f64>]) -> Option<f64> {
    let middle = |v: &mut Vec<f64>| {
        let at = v.len() / 2;
        *v.select_nth_unstable_by(at, f64::total_cmp).1
    };
    let mut each: Vec<f64> = distances.iter_mut().filter(|d| !d.is_empty()).map(middle).collect();
    (!each.is_empty()).then(|| middle(&mut each))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sfm::algebra::rotation;

    #[test]
    fn a_similarity_is_found_and_taken_away() {
        let truth = Similarity { scale: 3.0, rotation: rotation([0.4, -1.0, 0.3]), translation: [5.0, -2.0, 9.0] };
        let place = |k: usize| [k as f64, (k * k % 5) as f64, (3 * k % 7) as f64];
        let poses: Vec<Se3> = (0..6).map(|k| Se3::look_at(place(k), [2.0, 9.0, 4.0], [0.0, 0.0, 1.0])).collect();
        let mut moved: Vec<Se3> = poses.iter().map(|p| truth.pose(p)).collect();
        let exact = apart(&poses, &moved).unwrap();
        assert!(exact.iter().all(|a| a.degrees < 1e-9 && a.center < 1e-11), "{exact:?}");
        moved[2].rotation = mat_mul(&rotation([0.0, 0.02, 0.0]), &moved[2].rotation);
        let turned = apart(&poses, &moved).unwrap();
        assert!(turned[2].degrees > 0.5 && turned.iter().any(|a| a.center > 1e-3));
        assert!(similarity(&[[1.0; 3]; 3], &[[2.0; 3]; 3]).is_none());
        let up = up_of(&poses);
        assert!(up[2] > 0.5, "cameras were held upright: {up:?}");
    }
}
