//! Features that two images share, and whether poses put them on each other's epipolar lines, in front of both cameras.

use super::super::Aspect;
use super::super::account::Severity;
use super::super::lens::Distortion;
use super::super::pose::same_pose;
use super::super::preflight::Finding;
use super::look::{Mark, SmallImage};
use rayon::prelude::*;
use splat4d::math::Se3;
use splat4d::math::se3::{cross, dot, mat_vec, norm, normalize, sub, transpose};
use std::collections::BTreeMap;

/// The second best match is this many times farther away (Lowe 2004).
const RATIO: f64 = 0.8;
/// The same where a wrong match would be taken for motion: half as many are wrong.
pub(super) const STRICT: f64 = 0.7;
/// Distance from an epipolar line, pixels of the small image.
const NEAR: f64 = 1.5;
/// Angle between rays below which nothing states which side of the cameras they meet on, radians.
const PARALLEL: f64 = 0.006;
/// Of the cameras' spread: cameras nearer to one another have the same position.
const ONE_PLACE: f64 = 1e-6;
/// Matches that one convention fits and the other does not, at least, and how many times as many as the other way
/// round.
const MORE: (usize, usize) = (20, 4);
/// Of its matches, how many the poses as read fit at most where another convention is right.
const RIVAL: f64 = 0.8;
/// Matches of two images that show one place, and pairs of such images from which matches contradict poses if at most this share
/// fits: what fits by chance is near its lines.
const OVERLAP: usize = 20;
const OVERLAPPING: usize = 2;
const WRONG: f64 = 0.15;
/// Share of the matches that a right convention fits at least: many are chance.
const FITTING: f64 = 0.2;

/// Two features that look alike, of these images: their rays.
#[derive(Clone, Copy)]
pub(super) struct Match {
    images: [usize; 2],
    rays: [[f64; 2]; 2],
}

#[cfg(test)]
impl Match {
    /// The two images.
    pub(super) fn images(&self) -> [usize; 2] {
        self.images
    }
}

/// Evidence of matches for one convention.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Measure {
    pub(super) matches: usize,
    pub(super) fitting: usize,
    /// Matches that it fits and the poses as read do not, and vice versa.
    gained: usize,
    lost: usize,
}

impl Measure {
    /// Part of the matches that fits.
    pub(super) fn share(&self) -> f64 {
        self.fitting as f64 / self.matches.max(1) as f64
    }

    /// Whether poses are right by this.
    pub(super) fn convinces(&self) -> bool {
        are_right(self.fitting, self.matches)
    }

    /// Whether matches indicate that the poses as read are better.
    pub(super) fn contradicts(&self) -> bool {
        self.lost >= MORE.0 && self.lost >= MORE.1 * self.gained
    }
}

/// Whether the number of fitting matches, and their share of all, show that poses are right.
pub(super) fn are_right(fitting: usize, matches: usize) -> bool {
    fitting >= MORE.0 && fitting as f64 >= FITTING * matches as f64
}

/// Whether matches indicate that poses are written in this convention.
pub(super) fn prefers(m: &Measure) -> bool {
    let stated = m.fitting + m.lost - m.gained;
    m.convinces() && m.gained >= MORE.0 && m.gained >= MORE.1 * m.lost && stated as f64 <= RIVAL * m.fitting as f64
}

/// Mutual best matches of all pairs of images except those of one pose, which agree in any convention.
pub(super) fn matches(images: &[SmallImage]) -> Vec<Match> {
    let all = (0..images.len()).flat_map(|a| (a + 1..images.len()).map(move |b| [a, b]));
    let pairs: Vec<[usize; 2]> = all.filter(|&[a, b]| !same_pose(&images[a].camera, &images[b].camera)).collect();
    pairs.par_iter().flat_map_iter(|&[a, b]| between([a, b], &images[a].marks, &images[b].marks, RATIO)).collect()
}

/// Mutual best matches of two images whose second best is 1/`ratio` times farther away.
pub(super) fn between(images: [usize; 2], from: &[Mark], to: &[Mark], ratio: f64) -> Vec<Match> {
    let mut back = vec![(u32::MAX, 0); to.len()];
    let mut forth = Vec::with_capacity(from.len());
    for (i, a) in from.iter().enumerate() {
        let (mut first, mut second) = ((u32::MAX, 0), u32::MAX);
        for (j, b) in to.iter().enumerate() {
            let d = a.feature.distance(&b.feature);
            back[j] = back[j].min((d, i));
            if d < first.0 {
                // A point may have two features, of two directions: they are not rivals.
                if first.0 < u32::MAX && to[first.1].feature.pixel != b.feature.pixel {
                    second = first.0;
                }
                first = (d, j);
            } else if d < second && to[first.1].feature.pixel != b.feature.pixel {
                second = d;
            }
        }
        forth.push((first, second));
    }
    let good = |(i, ((d, j), second)): (usize, ((u32, usize), u32))| {
        let clear = f64::from(d).sqrt() < ratio * f64::from(second).sqrt();
        (d < u32::MAX && clear && back[j].1 == i).then(|| Match { images, rays: [from[i].ray, to[j].ray] })
    };
    forth.into_iter().enumerate().filter_map(good).collect()
}

/// Measures every convention; `poses` are those of the images in each convention, the first as read.
pub(super) fn measure(matches: &[Match], images: &[SmallImage], poses: &[Option<Vec<Se3>>]) -> Vec<Measure> {
    let fits: Vec<Vec<bool>> = poses
        .iter()
        .map(|poses| match poses {
            Some(poses) => {
                let centers: Vec<[f64; 3]> = poses.iter().map(|p| p.inverse().translation).collect();
                let least = least(&centers);
                matches.iter().map(|m| fits(m, images, poses, least)).collect()
            }
            None => vec![false; matches.len()],
        })
        .collect();
    let count = |f: &dyn Fn(usize) -> bool| (0..matches.len()).filter(|&k| f(k)).count();
    fits.iter()
        .map(|own| Measure {
            matches: matches.len(),
            fitting: count(&|k| own[k]),
            gained: count(&|k| own[k] && !fits[0][k]),
            lost: count(&|k| !own[k] && fits[0][k]),
        })
        .collect()
}

/// Number of matches of two images that agree with their poses.
pub(super) fn fitting(matches: &[Match], images: &[SmallImage], poses: &[Se3]) -> usize {
    let centers: Vec<[f64; 3]> = poses.iter().map(|p| p.inverse().translation).collect();
    let least = least(&centers);
    matches.iter().filter(|m| fits(m, images, poses, least)).count()
}

/// A warning where some pairs of images match well, and these matches do not fit the poses.
pub(super) fn contradiction(matches: &[Match], images: &[SmallImage], poses: &[Se3]) -> Option<Finding> {
    let mut of_pairs: BTreeMap<[usize; 2], Vec<Match>> = BTreeMap::new();
    matches.iter().for_each(|m| of_pairs.entry(m.images).or_default().push(*m));
    of_pairs.retain(|_, of_pair| of_pair.len() >= OVERLAP);
    let shared: Vec<Match> = of_pairs.values().flatten().copied().collect();
    let (all, fitting) = (shared.len(), fitting(&shared, images, poses));
    (of_pairs.len() >= OVERLAPPING && fitting as f64 <= WRONG * all as f64).then(|| Finding {
        severity: Severity::Warning,
        aspect: Some(Aspect::Assumed),
        what: format!(
            "Poses and images do not fit: {fitting} of {all} matches between images that show one place fit the poses, and no other \
             convention fits clearly better."
        ),
        remedy: "Check that images match their names, and how poses are written: the order of quaternions, the axes, one world for \
                 all."
            .into(),
    })
}

/// Baselines from which cameras stand in two places.
fn least(centers: &[[f64; 3]]) -> f64 {
    let spread = centers.iter().map(|&c| norm(sub(c, centers[0]))).fold(0.0, f64::max);
    ONE_PLACE * (spread + norm(centers.first().copied().unwrap_or_default()))
}

/// How far every match is from its epipolar line if focal lengths are `times` as long, or images of pinholes are distorted by
/// `bend`; pixels of the small image. Infinite where the rays do not meet in front of both cameras.
pub(super) fn residuals(
    matches: &[Match],
    images: &[SmallImage],
    poses: &[Se3],
    times: f64,
    bend: Option<&Distortion>,
) -> Vec<f64> {
    let centers: Vec<[f64; 3]> = poses.iter().map(|p| p.inverse().translation).collect();
    let least = least(&centers);
    let residual = |m: &Match| {
        let rays = m.rays.map(|ray| {
            let ray = ray.map(|x| x / times);
            bend.map_or(Some(ray), |lens| lens.undistort(ray))
        });
        let [Some(p), Some(q)] = rays else { return f64::INFINITY };
        let m = Match { images: m.images, rays: [p, q] };
        let [a, b] = m.images;
        let motion = poses[b].after(&poses[a].inverse());
        let in_one_place = norm(motion.translation) <= least;
        let in_front = in_one_place || meet(&m, &motion);
        let focal = 0.5 * times * (images[a].focal() + images[b].focal());
        if in_front { focal * offset(&m, &motion, in_one_place) } else { f64::INFINITY }
    };
    matches.iter().map(residual).collect()
}

/// The distance of a match from its position or epipolar line in a static scene, pixels of the small image.
pub(super) fn distance(m: &Match, images: &[SmallImage], poses: &[Se3]) -> f64 {
    let [a, b] = m.images;
    let motion = poses[b].after(&poses[a].inverse());
    let centers = [a, b].map(|k| norm(poses[k].inverse().translation));
    let baseline = norm(motion.translation);
    let in_one_place = baseline <= ONE_PLACE * (centers[0] + centers[1] + baseline);
    0.5 * (images[a].focal() + images[b].focal()) * offset(m, &motion, in_one_place)
}

/// The Sampson distance of a match from its epipolar line, or of the turned ray where the cameras have the same
/// position; in units of the focal length.
fn offset(m: &Match, motion: &Se3, in_one_place: bool) -> f64 {
    let [p, q] = m.rays.map(|[x, y]| [x, y, 1.0]);
    let turned = mat_vec(&motion.rotation, p);
    if in_one_place {
        let at = [turned[0] / turned[2], turned[1] / turned[2]];
        return if turned[2] > 0.0 { (at[0] - q[0]).hypot(at[1] - q[1]) } else { f64::INFINITY };
    }
    let t = normalize(motion.translation);
    // q · (t × R p), to first order of the distance from the epipolar lines in both images.
    let line = cross(t, turned);
    let back = mat_vec(&transpose(&motion.rotation), cross(q, t));
    let slope = line[0].hypot(line[1]).hypot(back[0].hypot(back[1]));
    dot(q, line).abs() / slope.max(f64::MIN_POSITIVE)
}

/// Whether two rays meet, in front of both cameras.
fn fits(m: &Match, images: &[SmallImage], poses: &[Se3], least: f64) -> bool {
    let [a, b] = m.images;
    let motion = poses[b].after(&poses[a].inverse());
    let tolerance = NEAR * 2.0 / (images[a].focal() + images[b].focal());
    let in_one_place = norm(motion.translation) <= least;
    let near = offset(m, &motion, in_one_place) <= tolerance;
    near && (in_one_place || meet(m, &motion))
}

/// Whether the rays of cameras in two places meet in front of both, where that can be determined.
fn meet(m: &Match, motion: &Se3) -> bool {
    let [p, q] = m.rays.map(|[x, y]| [x, y, 1.0]);
    let t = normalize(motion.translation);
    let (from, to) = (normalize(mat_vec(&motion.rotation, p)), normalize(q));
    let normal = cross(from, to);
    if norm(normal) < PARALLEL {
        // Far away, or along the baseline: both have at least the same direction.
        return dot(from, to) > 0.0;
    }
    // t + s·from = r·to, in the plane of the rays.
    let s = dot(cross(to, t), normal);
    let r = dot(cross(from, t), normal);
    s > 0.0 && r > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intersections_in_front_and_behind_are_distinguished() {
        let motion =
            Se3 { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [-1.0, 0.0, 0.0] };
        // A point at (0.2, 0.1, 4) before the first camera is at (-0.8, 0.1, 4) before the second.
        let ([s, r], point) = ([4.0f64, 4.0], [0.2, 0.1, 4.0]);
        let (from, to) = (normalize(point), normalize([point[0] - 1.0, point[1], point[2]]));
        let (t, normal) = (motion.translation, cross(from, to));
        let depth = |v: f64| v / dot(normal, normal);
        assert!((depth(dot(cross(to, t), normal)) * from[2] - s).abs() < 1e-9);
        assert!((depth(dot(cross(from, t), normal)) * to[2] - r).abs() < 1e-9);
    }
}
