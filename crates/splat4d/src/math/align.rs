//! Alignment of one set of cameras with another, and their distances after it.

use super::mat3::procrustes;
use super::se3::{dot, mat_mul, mat_vec, norm, sub, transpose};
use super::{Se3, Sim3};

/// The angle of the rotation between two rotations (rows), radians.
pub fn turn_between(a: &[[f64; 3]; 3], b: &[[f64; 3]; 3]) -> f64 {
    let r = mat_mul(a, &transpose(b));
    let axis = [r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]];
    norm(axis).atan2(r[0][0] + r[1][1] + r[2][2] - 1.0)
}

fn mean(points: &[[f64; 3]]) -> [f64; 3] {
    let n = points.len() as f64;
    points.iter().fold([0.0; 3], |sum, p| std::array::from_fn(|k| sum[k] + p[k] / n))
}

/// The similarity of least squares that takes points to others (Umeyama 1991). `None`: fewer than two, or all in one
/// position.
/// Panics: not as many points as others.
pub fn similarity(from: &[[f64; 3]], to: &[[f64; 3]]) -> Option<Sim3> {
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
    Some(Sim3 { scale, rotation, translation: std::array::from_fn(|k| there[k] - scale * turned[k]) })
}

/// Error of a camera pose against the truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Apart {
    /// Of the rotations, degrees.
    pub degrees: f64,
    /// Of the centres, of the rig's radius: the root mean square distance of the true centres from their mean.
    pub center: f64,
}

/// How far cameras are from their truth, once the similarity between their centres is taken away. `None`: there is
/// none.
pub fn apart(poses: &[Se3], truth: &[Se3]) -> Option<Vec<Apart>> {
    Trajectory::of(poses, truth, &[]).map(|t| t.apart)
}

/// How far cameras are from their truth, all together (Sturm et al. 2012).
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    /// By camera.
    pub apart: Vec<Apart>,
    /// The similarity that was taken away: true world from that of the poses.
    pub by: Sim3,
    /// Root mean square distance of the true centres from their mean, true units.
    pub radius: f64,
    /// Absolute trajectory error: root mean square distance of centres, true units.
    pub ate: f64,
    /// Relative pose error, root mean square over pairs: of the motion from one camera to the next, its rotation in
    /// degrees and its translation in true units. `None`: there are no pairs.
    pub rpe: Option<[f64; 2]>,
}

impl Trajectory {
    /// Compares poses with their truth; `pairs` of cameras are neighbours on a path. `None`: no similarity leads from
    /// one to the other, since there are fewer than two centres or they are all at one point. Panics: not as many poses
    /// as truths.
    pub fn of(poses: &[Se3], truth: &[Se3], pairs: &[[usize; 2]]) -> Option<Self> {
        let centers = |p: &[Se3]| p.iter().map(|q| q.inverse().translation).collect::<Vec<_>>();
        let (from, to) = (centers(poses), centers(truth));
        let by = similarity(&from, &to)?;
        let middle = mean(&to);
        let rms = |squares: Vec<f64>| (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt();
        let square = |x: [f64; 3]| dot(x, x);
        let radius = rms(to.iter().map(|&x| square(sub(x, middle))).collect());
        let moved: Vec<Se3> = poses.iter().map(|pose| by.pose(pose)).collect();
        let off: Vec<f64> = moved.iter().zip(&to).map(|(p, &c)| norm(sub(p.inverse().translation, c))).collect();
        let turned = moved.iter().zip(truth).map(|(p, q)| turn_between(&p.rotation, &q.rotation).to_degrees());
        let apart = turned.zip(&off).map(|(degrees, off)| Apart { degrees, center: off / radius }).collect();
        let step = |path: &[Se3], [a, b]: [usize; 2]| path[b].after(&path[a].inverse());
        let wrong = |&pair: &[usize; 2]| {
            let error = step(truth, pair).inverse().after(&step(&moved, pair));
            let turn = turn_between(&error.rotation, &Se3::IDENTITY.rotation).to_degrees();
            (turn * turn, square(error.translation))
        };
        let (turns, shifts): (Vec<f64>, Vec<f64>) = pairs.iter().map(wrong).unzip();
        let rpe = (!pairs.is_empty()).then(|| [rms(turns), rms(shifts)]);
        Some(Self { apart, by, radius, ate: rms(off.iter().map(|d| d * d).collect()), rpe })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::quat;

    fn rotation(q: [f64; 4]) -> [[f64; 3]; 3] {
        quat::to_rotation(quat::normalize(q).0)
    }

    fn path() -> Vec<Se3> {
        let place = |k: usize| [k as f64, (k * k % 5) as f64, (3 * k % 7) as f64];
        (0..6).map(|k| Se3::look_at(place(k), [2.0, 9.0, 4.0], [0.0, 0.0, 1.0])).collect()
    }

    #[test]
    fn a_similarity_between_trajectories_is_estimated_and_removed() {
        let truth = Sim3 { scale: 3.0, rotation: rotation([0.9, 0.3, -0.6, 0.2]), translation: [5.0, -2.0, 9.0] };
        let poses = path();
        let pairs = [[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]];
        let mut moved: Vec<Se3> = poses.iter().map(|p| truth.pose(p)).collect();
        let exact = Trajectory::of(&poses, &moved, &pairs).unwrap();
        assert!(exact.apart.iter().all(|a| a.degrees < 1e-6 && a.center < 1e-11), "{exact:?}");
        assert!((exact.by.scale - 3.0).abs() < 1e-12 && exact.ate < 1e-10, "{exact:?}");
        assert!(exact.rpe.unwrap().iter().all(|e| *e < 1e-6), "{exact:?}");
        // A camera that turns about its own centre moves no centre, and spoils the steps to and from it.
        let (turn, center) = (rotation([0.02f64.cos(), 0.0, 0.02f64.sin(), 0.0]), moved[2].inverse().translation);
        moved[2].rotation = mat_mul(&turn, &moved[2].rotation);
        moved[2].translation = mat_vec(&moved[2].rotation, center).map(|x| -x);
        let turned = Trajectory::of(&poses, &moved, &pairs).unwrap();
        let degrees = 0.04f64.to_degrees();
        assert!((turned.apart[2].degrees - degrees).abs() < 1e-9 && turned.ate < 1e-10, "{turned:?}");
        assert!((turned.rpe.unwrap()[0] - degrees * (2.0f64 / 5.0).sqrt()).abs() < 1e-6, "{turned:?}");
        assert_eq!(Trajectory::of(&poses, &moved, &[]).unwrap().rpe, None);
        assert!(similarity(&[[1.0; 3]; 3], &[[2.0; 3]; 3]).is_none());
    }

    #[test]
    fn errors_that_no_similarity_explains_remain() {
        // A square whose corners move outwards and inwards in turn: no similarity comes nearer than leaving it.
        let corners = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]];
        let pose = |c: [f64; 3]| Se3::look_at(c, [0.0, 0.0, 3.0], [1.0, 1.0, 0.0]);
        let off = |k: usize, by: f64| corners[k].map(|x| x * if k.is_multiple_of(2) { 1.0 + by } else { 1.0 - by });
        let truth: Vec<Se3> = corners.map(pose).to_vec();
        let found: Vec<Se3> = (0..4).map(|k| pose(off(k, 0.1))).collect();
        let t = Trajectory::of(&found, &truth, &[]).unwrap();
        // Least squares: the scale is 1/(1 + 0.1²), and what is left of 0.1 is 0.1/√(1 + 0.1²).
        assert!((t.ate - 0.1 / 1.01f64.sqrt()).abs() < 1e-9 && (t.radius - 1.0).abs() < 1e-12, "{t:?}");
    }
}
