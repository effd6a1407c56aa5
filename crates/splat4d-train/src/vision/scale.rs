//! Size and nearest distance of a scene, from the points that its cameras see.

use splat4d::scene::Camera;

/// Lengths of a scene, in its own unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Scale {
    /// Nothing that at least two cameras see is nearer to any of them.
    pub near: f64,
    /// Median over the cameras of the median depth of the points that they see.
    pub depth: f64,
}

/// Points nearer than this share of all that a camera sees may be outliers.
const STRAY: f64 = 1e-3;
/// Of the distance of the nearest points: surfaces continue a little before them.
const BEFORE: f64 = 0.5;
/// Cameras that must see a point.
const SEEN_BY: usize = 2;

impl Scale {
    /// `None`: no point is seen by two of the cameras.
    pub(crate) fn of(cameras: &[&Camera], points: &[[f64; 3]]) -> Option<Self> {
        let sees = |c: &Camera, x: [f64; 3]| {
            let ([u, v], z) = c.project(x)?;
            let inside = (0.0..c.width as f64).contains(&u) && (0.0..c.height as f64).contains(&v);
            inside.then_some(z)
        };
        let mut of_camera: Vec<Vec<f64>> = vec![Vec::new(); cameras.len()];
        for &x in points {
            let seen: Vec<Option<f64>> = cameras.iter().map(|c| sees(c, x)).collect();
            if seen.iter().flatten().count() >= SEEN_BY {
                of_camera.iter_mut().zip(seen).for_each(|(depths, z)| depths.extend(z));
            }
        }
        let mut all: Vec<f64> = of_camera.iter().flatten().copied().collect();
        let mut medians: Vec<f64> = of_camera.iter_mut().filter(|d| !d.is_empty()).map(|d| at_share(d, 0.5)).collect();
        if all.is_empty() {
            return None;
        }
        Some(Self { near: BEFORE * at_share(&mut all, STRAY), depth: at_share(&mut medians, 0.5) })
    }
}

/// The quantile of this share.
fn at_share(values: &mut [f64], share: f64) -> f64 {
    let at = (share * values.len() as f64) as usize;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::{Rng, Se3};

    #[test]
    fn near_and_depth_follow_the_points_in_any_unit() {
        for unit in [1e-3, 1.0, 1e3] {
            let camera = |x: f64| {
                let pose = Se3::look_at([x * unit, 0.0, -4.0 * unit], [0.0; 3], [0.0, -1.0, 0.0]);
                Camera::with_fov_y(pose, 0.9, 64, 48)
            };
            let cameras = [camera(-0.5), camera(0.5)];
            let rng = Rng::new(1, "scale", 0);
            let place = |i: u64, k: u64| (2.0 * rng.uniform(3 * i + k) - 1.0) * unit;
            let mut points: Vec<[f64; 3]> = (0..4000).map(|i| [place(i, 0), place(i, 1), place(i, 2)]).collect();
            // One wrong point before the lens, and one that only one camera sees.
            points.push([0.5 * unit, 0.0, -3.99 * unit]);
            let scale = Scale::of(&[&cameras[0], &cameras[1]], &points).unwrap();
            assert!((1.3..1.6).contains(&(scale.near / unit)), "{scale:?}");
            assert!((3.8..4.2).contains(&(scale.depth / unit)), "{scale:?}");
            assert!(Scale::of(&[&cameras[0]], &points).is_none(), "one camera measures nothing");
        }
    }
}
