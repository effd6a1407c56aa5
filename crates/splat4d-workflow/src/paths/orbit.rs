//! The place where a scene is filmed, found from its training cameras (or, without any, from its Gaussians), and an
//! orbit that shows only sides that cameras saw.

use super::View;
use splat4d::math::Se3;
use splat4d::math::se3::{cross, dot, norm, normalize, sub};
use splat4d::scene::Camera;
use std::f64::consts::{PI, TAU};

/// A gap between neighbouring cameras (seen from the middle, around the upward axis) wider than this ends the arc: the
/// side behind it was not seen. A third of a circle, so that three cameras all around still count as a circle.
const GAP: f64 = TAU / 3.0 + 0.1;
/// Share of the cameras' arc that the sway uses: its ends are seen by one camera only.
const ARC_SHARE: f64 = 0.85;
/// Share of the cameras that must have the middle in front of them.
const FACING: f64 = 0.8;
/// Longer side of an orbit image by default, pixels.
const LONG_SIDE: usize = 960;
/// Vertical field of view where there is no camera to copy: 45°.
const FOV_Y: f64 = PI / 4.0;
/// Half-widths of the sway when the training cameras are in one spot: 6°.
const SMALL_SWAY: f64 = 0.1;

/// Middle, distance, height and arc of an orbit.
#[derive(Clone, Debug)]
pub struct Stage {
    /// Point that is examined.
    pub center: [f64; 3],
    /// Upwards (unit).
    pub up: [f64; 3],
    /// Distance from the upward axis through the middle.
    radius: f64,
    /// Height above the middle.
    height: f64,
    /// Middle of the arc, radians around `up`.
    azimuth: f64,
    /// Half the arc that may be shown; π: all around.
    reach: f64,
    /// Field of view and size of the images.
    pub template: Camera,
}

impl Stage {
    /// From the training cameras. Panics: no view.
    pub fn of_views(views: &[View], up: [f64; 3]) -> Self {
        assert!(!views.is_empty(), "a stage needs at least one view");
        let cameras = distinct(views);
        let center = look_at_point(&cameras);
        let (e1, e2) = basis(up);
        let polar = |c: &Camera| {
            let d = sub(c.center(), center);
            let (x, y, h) = (dot(d, e1), dot(d, e2), dot(d, up));
            (x.hypot(y), y.atan2(x), h)
        };
        let rig: Vec<(f64, f64, f64)> = cameras.iter().map(|c| polar(c)).collect();
        let n = rig.len() as f64;
        let radius = rig.iter().map(|r| r.0).sum::<f64>() / n;
        let height = rig.iter().map(|r| r.2).sum::<f64>() / n;
        let (azimuth, reach) = arc(rig.iter().map(|r| r.1).collect());
        let template = template(cameras[0]);
        Self { center, up, radius: radius.max(1e-6), height, azimuth, reach, template }
    }

    /// Around a cloud: its middle and the radius that holds most of it.
    pub fn of_cloud(center: [f64; 3], extent: f64, up: [f64; 3]) -> Self {
        let template = Camera::with_fov_y(Se3::IDENTITY, FOV_Y, 800, 600);
        let distance = extent.max(1e-6) / (0.5 * FOV_Y).tan();
        let (height, radius) = (0.35 * distance, 0.94 * distance);
        Self { center, up, radius, height, azimuth: 0.0, reach: PI, template }
    }

    /// Whether the orbit goes all around.
    pub fn full(&self) -> bool {
        self.reach >= PI
    }

    /// The camera at `share` (0 to 1) of the orbit; it ends where it began.
    pub fn orbit(&self, share: f64) -> Camera {
        let turn = if self.full() { TAU * share } else { self.reach * (TAU * share).sin() };
        let angle = self.azimuth + turn;
        let (e1, e2) = basis(self.up);
        let flat = add(scale(e1, self.radius * angle.cos()), scale(e2, self.radius * angle.sin()));
        let eye = add(add(self.center, flat), scale(self.up, self.height));
        Camera { cam_from_world: Se3::look_at(eye, self.center, self.up), ..self.template.clone() }
    }
}

/// Every training camera once; held-out ones if there is no other.
fn distinct(views: &[View]) -> Vec<&Camera> {
    let mut out: Vec<&Camera> = Vec::new();
    for wanted in [false, true] {
        for view in views.iter().filter(|v| v.held == wanted) {
            if out.len() < 512 && !out.iter().any(|c| c.cam_from_world == view.camera.cam_from_world) {
                out.push(&view.camera);
            }
        }
        if !out.is_empty() {
            break;
        }
    }
    out
}

/// The point nearest to all optical axes (least squares); where the axes do not meet in front of the cameras, a point
/// ahead of their mean.
fn look_at_point(cameras: &[&Camera]) -> [f64; 3] {
    // Σ (I − d dᵀ) x = Σ (I − d dᵀ) c; a little of the mean view keeps it solvable for parallel axes.
    let mean = scale(cameras.iter().fold([0.0; 3], |s, c| add(s, c.center())), 1.0 / cameras.len() as f64);
    let spread = cameras.iter().map(|c| norm(sub(c.center(), mean))).fold(0.0, f64::max).max(1e-3);
    let ahead = cameras.iter().fold([0.0; 3], |s, c| add(s, c.forward()));
    let fallback =
        add(mean, scale(if norm(ahead) > 1e-9 { normalize(ahead) } else { cameras[0].forward() }, 2.0 * spread));
    let (mut a, mut b) = ([[0.0; 3]; 3], [0.0; 3]);
    for camera in cameras {
        let (c, d) = (camera.center(), camera.forward());
        for i in 0..3 {
            for j in 0..3 {
                let m = f64::from(u8::from(i == j)) - d[i] * d[j];
                a[i][j] += m;
                b[i] += m * c[j];
            }
        }
    }
    let ridge = 1e-3 * cameras.len() as f64;
    for i in 0..3 {
        a[i][i] += ridge;
        b[i] += ridge * fallback[i];
    }
    let det = dot(a[0], cross(a[1], a[2]));
    let column = |j: usize| [a[0][j], a[1][j], a[2][j]];
    let x = [
        dot(b, cross(column(1), column(2))) / det,
        dot(column(0), cross(b, column(2))) / det,
        dot(column(0), cross(column(1), b)) / det,
    ];
    let facing = cameras.iter().filter(|c| dot(sub(x, c.center()), c.forward()) > 0.0).count();
    if det.abs() > 1e-12 && facing as f64 >= FACING * cameras.len() as f64 { x } else { fallback }
}

/// Middle and half-width of the arc that the azimuths cover.
fn arc(mut azimuths: Vec<f64>) -> (f64, f64) {
    azimuths.sort_by(f64::total_cmp);
    let n = azimuths.len();
    let gap = |i: usize| (azimuths[(i + 1) % n] - azimuths[i]).rem_euclid(TAU);
    let widest = (0..n).max_by(|&i, &j| gap(i).total_cmp(&gap(j))).expect("there is a camera");
    let width = if n == 1 { TAU } else { gap(widest) };
    if width < GAP {
        return (azimuths[0], PI);
    }
    let covered = TAU - width;
    let start = azimuths[(widest + 1) % n];
    (start + 0.5 * covered, (0.5 * ARC_SHARE * covered).max(SMALL_SWAY))
}

/// Two unit vectors that span the ground.
fn basis(up: [f64; 3]) -> ([f64; 3], [f64; 3]) {
    let other = if up[0].abs() < 0.9 { [1.0, 0.0, 0.0] } else { [0.0, 0.0, 1.0] };
    let e1 = normalize(cross(other, up));
    (e1, cross(up, e1))
}

fn add(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

fn scale(a: [f64; 3], s: f64) -> [f64; 3] {
    a.map(|x| x * s)
}

/// The size and field of view of `camera`, at most [`LONG_SIDE`], even, its principal point in the middle.
fn template(camera: &Camera) -> Camera {
    let long = camera.width.max(camera.height);
    let shrink = (LONG_SIDE as f64 / long as f64).min(1.0);
    let even = |side: usize| ((side as f64 * shrink / 2.0).round() as usize * 2).max(2);
    let fov_y = 2.0 * (0.5 * camera.height as f64 / camera.intrinsics.fy).atan();
    Camera::with_fov_y(Se3::IDENTITY, fov_y, even(camera.width), even(camera.height))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rig(angles: &[f64]) -> Vec<View> {
        let view = |(i, a): (usize, &f64)| {
            let eye = [5.0 * a.cos(), 1.5, 5.0 * a.sin()];
            let pose = Se3::look_at(eye, [0.0, 0.5, 0.0], [0.0, 1.0, 0.0]);
            View { camera: Camera::with_fov_y(pose, 0.7, 401, 301), name: format!("{i}"), time: 0.0, held: false }
        };
        angles.iter().enumerate().map(view).collect()
    }

    #[test]
    fn a_ring_of_cameras_gives_a_full_circle_through_them() {
        let views = rig(&[0.0, 1.5, 3.0, 4.5]);
        let stage = Stage::of_views(&views, [0.0, 1.0, 0.0]);
        assert!(stage.full());
        assert!(norm(sub(stage.center, [0.0, 0.5, 0.0])) < 0.05, "{:?}", stage.center);
        for i in 0..12 {
            let camera = stage.orbit(f64::from(i) / 12.0);
            let flat = camera.center()[0].hypot(camera.center()[2]);
            assert!((flat - 5.0).abs() < 0.1 && (camera.center()[1] - 1.5).abs() < 0.05);
            let (pixel, _) = camera.project(stage.center).unwrap();
            assert!((pixel[0] - 0.5 * camera.width as f64).abs() < 1e-6, "the middle stays in the middle");
        }
        assert_eq!((stage.template.width % 2, stage.template.height % 2), (0, 0));
    }

    #[test]
    fn an_arc_of_cameras_is_never_left() {
        for middle in [0.3, 3.1, 6.1] {
            let angles: Vec<f64> = (-4..=4).map(|i| middle + 0.15 * f64::from(i)).collect();
            let stage = Stage::of_views(&rig(&angles), [0.0, 1.0, 0.0]);
            assert!(!stage.full());
            for i in 0..40 {
                let c = stage.orbit(f64::from(i) / 40.0).center();
                let off = (c[2].atan2(c[0]) - middle + PI).rem_euclid(TAU) - PI;
                assert!(off.abs() < 0.6 + 1e-3, "{middle}: {off}");
            }
        }
    }

    #[test]
    fn parallel_and_outward_cameras_still_get_a_stage() {
        let mut views = rig(&[0.0, 0.0]);
        views[1].camera.cam_from_world.translation[0] += 0.5;
        assert!(Stage::of_views(&views, [0.0, 1.0, 0.0]).orbit(0.3).center().iter().all(|x| x.is_finite()));
        for view in &mut views {
            let eye = view.camera.center();
            view.camera.cam_from_world = Se3::look_at(eye, scale(eye, 2.0), [0.0, 1.0, 0.0]);
        }
        assert!(Stage::of_views(&views[..1], [0.0, 1.0, 0.0]).orbit(0.3).center().iter().all(|x| x.is_finite()));
    }
}
