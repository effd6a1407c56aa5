//! Cameras of which the lens is known, or the lens and the position: features are straightened once, and the rest is
//! found about them.

use super::lens::{Known, Lens as Plain, unit};
use super::mapper::{Ground, Mapped, Mapping};
use super::pictures::{CameraView, Feature};
use super::tracks::{self, Link};
use crate::sync::epipolar::{fundamental, sampson};
use splat4d::math::Se3;
use splat4d::math::se3::dot;
use splat4d::scene::{Camera, Intrinsics};
use splat4d_train::capture::Distortion;
use splat4d_train::event::Progress;

/// Rays farther off the axis than this (tangent; 72 degrees) are left out: a straightened pixel there is wide, and of
/// little use.
const WIDEST: f64 = 3.0;

/// Takes pixels of images to those of the pinhole camera with its principal point in the middle.
pub(crate) struct Straight {
    from: Intrinsics,
    lens: Distortion,
    to: Plain,
}

impl Known {
    /// For images of this size, which are `factor` times smaller than the files'.
    pub(crate) fn straight(&self, [width, height]: [usize; 2], factor: f64) -> Straight {
        let k = &self.intrinsics;
        let from = Intrinsics { fx: k.fx / factor, fy: k.fy / factor, cx: k.cx / factor, cy: k.cy / factor };
        Straight { from, lens: Distortion::new(self.lens), to: Plain::plain((from.fx * from.fy).sqrt(), width, height) }
    }
}

impl Straight {
    /// Of the camera without distortion, pixels.
    pub(crate) fn focal(&self) -> f64 {
        self.to.focal
    }

    /// The camera without distortion.
    pub(crate) fn camera(&self, pose: Se3, [width, height]: [usize; 2]) -> Camera {
        self.to.pinhole(pose, width, height)
    }

    /// The undistorted position of a pixel; none where no ray leads there.
    pub(crate) fn pixel(&self, [u, v]: [f64; 2]) -> Option<[f64; 2]> {
        let k = &self.from;
        let ray = self.lens.undistort([(u - k.cx) / k.fx, (v - k.cy) / k.fy])?;
        let near = ray[0].hypot(ray[1]) < WIDEST;
        near.then(|| std::array::from_fn(|a| self.to.focal * ray[a] + self.to.center[a]))
    }

    /// Straightens a feature; false where it cannot be.
    pub(crate) fn feature(&self, f: &mut Feature) -> bool {
        /// Pixels over which the change of a moving feature is taken.
        const STEP: f64 = 0.5;
        let Some(here) = self.pixel(f.pixel) else { return false };
        let speed = f.velocity[0].hypot(f.velocity[1]);
        if speed > 0.0 {
            let seconds = STEP / speed;
            let moved = |way: f64| self.pixel(std::array::from_fn(|a| f.pixel[a] + way * seconds * f.velocity[a]));
            let (Some(before), Some(after)) = (moved(-1.0), moved(1.0)) else { return false };
            f.velocity = std::array::from_fn(|a| (after[a] - before[a]) / (2.0 * seconds));
        }
        f.pixel = here;
        true
    }
}

/// Points and clocks of cameras whose poses and lenses are given. `links` were found without them, and measure their
/// errors.
///
/// Moving objects are off their epipolar lines as long as time offsets are wrong: first, offsets are estimated from
/// matches, within wide bounds; then points of what is on the lines, which it is at any clock, so that they determine
/// none.
pub(crate) fn about(sights: &[CameraView], links: &[Link], how: &Mapping, progress: &mut Progress<'_>) -> Mapped {
    /// Of the tolerance: two frames of what is followed at all, in images 1920 across.
    const WIDE: f64 = 8.0;
    /// Of what moves and was matched, the least share that must fit a clock: of matches by chance few do.
    const CLOCK_SHARE: f64 = 0.5;
    let wide = Mapping { tolerance: WIDE * how.tolerance, ..how.clone() };
    let first = tracks::join(sights, links);
    let ground = Ground::new(sights, &first, links, &wide);
    let mut map = ground.given(None);
    map.renew();
    map.settle();
    let mut clocks = map.result();
    let ground = Ground::new(sights, &first, links, how);
    let mut map = ground.given(Some(&clocks));
    map.renew();
    for (s, (camera, moving)) in clocks.cameras.iter_mut().zip(&mut clocks.moving).enumerate() {
        let moves = |&&(t, k): &&(usize, usize)| sights[s].features[first[t].seen[k].1].moment > 0;
        let matched = ground.shows[s].iter().filter(moves).count();
        *moving = map.moving(s);
        if (*moving as f64) < CLOCK_SHARE * matched as f64 {
            *moving = 0;
            camera.iter_mut().for_each(|c| c.tau = 0.0);
        }
    }
    let fixed = Mapping { clocks: false, ..how.clone() };
    let ground = Ground::new(sights, &[], links, &fixed);
    let along = ground.given(Some(&clocks)).guided(links, progress);
    let joined = tracks::join(sights, &along);
    let ground = Ground::new(sights, &joined, links, &fixed);
    let mut map = ground.given(Some(&clocks));
    map.renew();
    map.settle();
    Mapped { contradiction: errors(sights, links), moving: clocks.moving, ..map.result() }
}

/// Matches of the static background that a pair of cameras must have before it shows whether poses are right.
const SURE: usize = 12;
/// Cameras whose axes are farther apart see other sides of objects: matches there are chance, degrees.
const APART: f64 = 70.0;
/// Median over lower quartile of the size of a normal error: 0.6745 / 0.3186.
const QUARTILE_TO_MEDIAN: f64 = 2.117;
/// This many of a camera's pairs must agree on its error, where this many measure it: a neighbour may be the one that
/// is wrong.
const AGREE: usize = 2;
const TELL: usize = 3;

/// Distance of each camera's features from their positions by the given poses, pixels of the files' images.
///
/// Links must have been found without these poses. Distances are epipolar, as the doctor takes them: the lower quartile
/// of a pair, as the median that it implies, for chance matches only add large ones; of a camera the second least of
/// its pairs.
fn errors(sights: &[CameraView], links: &[Link]) -> Vec<Option<f64>> {
    let camera = |s: &CameraView| {
        let lens = Plain::plain(s.focal?, s.size[0], s.size[1]);
        Some(lens.pinhole(s.pose?, s.size[0], s.size[1]))
    };
    let cameras: Vec<Option<Camera>> = sights.iter().map(camera).collect();
    let mut pairs: Vec<Vec<f64>> = vec![Vec::new(); sights.len()];
    for link in links {
        let [a, b] = link.sights;
        let (Some(p), Some(q)) = (&cameras[a], &cameras[b]) else { continue };
        if dot(p.forward(), q.forward()) < APART.to_radians().cos() {
            continue;
        }
        let f = fundamental(p, q);
        let still = |&&([i, _], _): &&([usize; 2], f32)| sights[a].features[i].moment == 0;
        let mut off: Vec<f64> = link
            .matches
            .iter()
            .filter(still)
            .map(|&([i, j], _)| sampson(&f, sights[a].features[i].pixel, sights[b].features[j].pixel).abs())
            .collect();
        if off.len() >= SURE {
            off.sort_by(f64::total_cmp);
            let own = QUARTILE_TO_MEDIAN * off[off.len() / 4];
            pairs[a].push(own * sights[a].factor);
            pairs[b].push(own * sights[b].factor);
        }
    }
    let of = |mut own: Vec<f64>| {
        own.sort_by(f64::total_cmp);
        if own.len() >= TELL { own.get(AGREE - 1).copied() } else { own.first().copied() }
    };
    pairs.into_iter().map(of).collect()
}

/// Pixels of a camera's files for one of an image 1920 across, but no less than half a pixel.
pub(crate) fn pixel_unit([width, height]: [usize; 2]) -> f64 {
    unit(width.max(height) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::scene::Lens;

    fn known(pose: Option<Se3>) -> Known {
        let lens = Lens::Brown { k: [-0.2, 0.05, 0.0, 0.0, 0.0, 0.0], p: [1e-3, -5e-4], s: [0.0; 4] };
        Known { intrinsics: Intrinsics { fx: 500.0, fy: 510.0, cx: 330.0, cy: 228.0 }, lens, pose }
    }

    /// Projection of a point in the distorted camera's axes.
    fn seen(k: &Known, p: [f64; 3]) -> [f64; 2] {
        let [x, y] = Distortion::new(k.lens).distort([p[0] / p[2], p[1] / p[2]]).unwrap();
        [k.intrinsics.fx * x + k.intrinsics.cx, k.intrinsics.fy * y + k.intrinsics.cy]
    }

    #[test]
    fn straightened_features_are_where_a_pinhole_camera_sees_them() {
        let k = known(None);
        let straight = k.straight([320, 240], 2.0);
        let at = |t: f64| [0.3 + 0.4 * t, -0.2 + 0.1 * t, 2.0];
        let pinhole = |p: [f64; 3]| {
            let lens = Plain::plain(straight.focal(), 320, 240);
            lens.project(p).unwrap()
        };
        let pixel = |t: f64| seen(&k, at(t)).map(|v| v / 2.0);
        let h = 1e-4;
        let slope = |f: &dyn Fn(f64) -> [f64; 2]| [0, 1].map(|a| (f(h)[a] - f(-h)[a]) / (2.0 * h));
        let mut f =
            Feature { pixel: pixel(0.0), velocity: slope(&pixel), moment: 1, descriptor: [0; 128], color: [0; 3] };
        assert!(straight.feature(&mut f));
        let (place, speed) = (pinhole(at(0.0)), slope(&|t| pinhole(at(t))));
        assert!((0..2).all(|a| (f.pixel[a] - place[a]).abs() < 1e-6), "{f:?} {place:?}");
        assert!((0..2).all(|a| (f.velocity[a] - speed[a]).abs() < 1e-2 * speed[0].abs()), "{f:?} {speed:?}");
        let mut out = Feature { pixel: [1e5, 1e5], ..f };
        assert!(!straight.feature(&mut out));
    }
}
