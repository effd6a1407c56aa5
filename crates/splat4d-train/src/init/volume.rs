//! The volume that the cameras share, and random points in it.

use super::{Seeds, UNKNOWN_COLOR};
use crate::capture::frames::Frames;
use splat4d::math::Rng;
use splat4d::math::mat3::solve;
use splat4d::math::se3::{norm, sub};
use splat4d::scene::Camera;

/// The cameras' target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Volume {
    /// The point nearest to all optical axes.
    pub center: [f64; 3],
    /// Half the edge of the box around it, scene units.
    pub radius: f64,
}

/// The box reaches this share of the distance from its centre to the nearest camera's: 3 m of a rig of radius 4 m.
const REACH: f64 = 0.75;

/// The least-squares meeting point of the optical axes, and a box around it that stops short of the cameras.
///
/// Where axes are nearly parallel the depth is taken from the spread of the cameras.
pub(crate) fn common(frames: &dyn Frames) -> Volume {
    // Σ (I − d dᵀ) x = Σ (I − d dᵀ) c, slightly pulled to a point in front of the cameras so that parallel axes meet.
    let mut a = [[0.0; 3]; 3];
    let mut b = [0.0; 3];
    let n = frames.len().max(1) as f64;
    let centers: Vec<[f64; 3]> = (0..frames.len()).map(|i| frames.camera(i).center()).collect();
    let centroid: [f64; 3] = std::array::from_fn(|k| centers.iter().map(|c| c[k]).sum::<f64>() / n);
    let spread = centers.iter().map(|&c| norm(sub(c, centroid))).fold(0.0, f64::max).max(1e-3);
    let pull = 1e-3;
    for (i, c) in centers.iter().enumerate() {
        let d = frames.camera(i).forward();
        let ahead: [f64; 3] = std::array::from_fn(|k| c[k] + d[k] * spread);
        for r in 0..3 {
            for s in 0..3 {
                let m = f64::from(u8::from(r == s)) - d[r] * d[s];
                a[r][s] += m;
                b[r] += m * c[s];
            }
            a[r][r] += pull;
            b[r] += pull * ahead[r];
        }
    }
    let center = solve(a, b).unwrap_or(centroid);
    let nearest = centers.iter().map(|&c| norm(sub(c, center))).fold(f64::INFINITY, f64::min);
    let radius = if nearest.is_finite() { (REACH * nearest).max(1e-3 * spread) } else { 1.0 };
    Volume { center, radius }
}

/// Cameras that are tested for a candidate's visibility.
const ASKED: usize = 100;
/// A random point must be seen by this share of the cameras that see the best seen one: a point that few see is hardly
/// learnt, and hangs as haze in front of views that were not trained on.
const SEEN_SHARE: f64 = 0.25;
/// Candidates per requested point, at most.
const CANDIDATES: usize = 32;

/// Uniform points of the box that the cameras see; with `clip`, each at a random time of it. Fewer than `count` if
/// cameras see hardly any of the box.
pub(crate) fn random(frames: &dyn Frames, volume: &Volume, count: usize, clip: Option<[f64; 2]>, rng: Rng) -> Seeds {
    let asked = frames.len().min(ASKED);
    let cameras: Vec<&Camera> = (0..asked).map(|k| frames.camera(k * frames.len() / asked)).collect();
    let sees = |camera: &Camera, x: [f64; 3]| {
        let inside = |p: f64, size: usize| p >= 0.0 && p < size as f64;
        camera.project(x).is_some_and(|([u, v], _)| inside(u, camera.width) && inside(v, camera.height))
    };
    let place = |i: u64| -> [f64; 3] {
        std::array::from_fn(|k| volume.center[k] + volume.radius * (2.0 * rng.uniform(3 * i + k as u64) - 1.0))
    };
    let views = |i: u64| cameras.iter().filter(|c| sees(c, place(i))).count();
    let best = (0..count as u64).map(views).max().unwrap_or(0);
    let needed = (SEEN_SHARE * best as f64).ceil() as usize;
    let mut out = Seeds::default();
    for i in (0..(CANDIDATES * count) as u64).filter(|&i| views(i) >= needed).take(count) {
        let time = clip.map(|[from, to]| from + (to - from) * rng.fork(9).uniform(i));
        out.push(place(i), UNKNOWN_COLOR, time);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::step::tests::Made;

    #[test]
    fn a_ring_of_cameras_meets_at_its_center() {
        let v = common(&Made::new(6, 2, 8));
        assert!(norm(v.center) < 0.02, "{v:?}");
        assert!(v.radius > 1.0 && v.radius < 4.0);
    }

    #[test]
    fn random_points_are_where_many_cameras_see() {
        let frames = Made::new(6, 2, 8);
        let volume = common(&frames);
        let seeds = random(&frames, &volume, 300, None, Rng::new(1, "random", 0));
        assert_eq!(seeds.len(), 300);
        for x in &seeds.points {
            let inside = |([u, v], _): ([f64; 2], f64)| (0.0..8.0).contains(&u) && (0.0..8.0).contains(&v);
            let seen = (0..6).filter(|&i| frames.camera(i).project(*x).is_some_and(inside)).count();
            assert!(seen >= 2, "{x:?} is seen by {seen} of 6 cameras");
        }
        let wide = |k: usize| seeds.points.iter().map(|x| (x[k] - volume.center[k]).abs()).fold(0.0, f64::max);
        assert!(wide(0) > 0.5 && wide(1) > 0.5, "they fill the volume that the cameras share");
    }
}
