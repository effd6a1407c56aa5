//! Images of a ball in a dome, ray-cast: a dome that is far is a sky, one that is near a wall without points.

use super::*;
use splat4d::math::Se3;
use splat4d::math::se3::normalize;
use splat4d::scene::{Planes, Time};

const SIZE: [usize; 2] = [160, 120];
const FOCAL: f64 = 140.0;
const CAMERAS: usize = 8;
const BALL: ([f64; 3], f64) = ([0.0, 0.5, 0.0], 0.8);
/// Radii of the dome, distances of the cameras.
pub(in crate::init) const FAR: f64 = 100.0;
const NEAR: f64 = 2.0;

/// Cameras on an arc of radius 4 before the ball.
pub(in crate::init) struct Film {
    cameras: Vec<Camera>,
    dome: f64,
}

impl Film {
    pub(in crate::init) fn new(dome: f64) -> Self {
        Self::on_arc(0.9, dome)
    }

    /// `half`: half of the arc, radians.
    fn on_arc(half: f64, dome: f64) -> Self {
        let camera = |i: usize| {
            let a = half * (2.0 * i as f64 / (CAMERAS - 1) as f64 - 1.0);
            let eye = [4.0 * a.sin(), [1.1, 1.9][i % 2], 4.0 * a.cos()];
            let pose = Se3::look_at(eye, [0.0, 0.7, -0.3], [0.0, 1.0, 0.0]);
            let mut camera = Camera::with_fov_y(pose, 0.8, SIZE[0], SIZE[1]);
            (camera.intrinsics.fx, camera.intrinsics.fy) = (FOCAL, FOCAL);
            camera
        };
        Self { cameras: (0..CAMERAS).map(camera).collect(), dome: 4.0 * dome }
    }

    /// Centroid and extent of the cameras.
    pub(in crate::init) fn center_and_extent(&self) -> ([f64; 3], f64) {
        let all: Vec<[f64; 3]> = self.cameras.iter().map(Camera::center).collect();
        let center = std::array::from_fn(|k| all.iter().map(|c| c[k]).sum::<f64>() / CAMERAS as f64);
        (center, 1.1 * all.iter().map(|&c| norm(sub(c, center))).fold(0.0, f64::max))
    }

    /// Points on the ball; the dome has none.
    pub(in crate::init) fn points(&self) -> Vec<[f64; 3]> {
        let on = |k: usize| {
            let z = 1.0 - (2 * k + 1) as f64 / 400.0;
            let (r, a) = ((1.0 - z * z).sqrt(), 2.4 * k as f64);
            [r * a.cos(), z, r * a.sin()]
        };
        (0..400).map(|k| std::array::from_fn(|c| BALL.0[c] + BALL.1 * on(k)[c])).collect()
    }

    /// The colour at a pixel, and whether it is the dome's.
    pub(in crate::init) fn at(&self, camera: &Camera, pixel: [f64; 2]) -> ([f32; 3], bool) {
        let eye = camera.center();
        let ray = normalize(sub(camera.unproject(pixel, 1.0), eye));
        let hit = |center: [f64; 3], radius: f64, side: f64| {
            let from = sub(eye, center);
            let (b, c) = (dot(ray, from), dot(from, from) - radius * radius);
            (b * b > c).then(|| -b + side * (b * b - c).sqrt()).filter(|s| *s > 0.0)
        };
        let (center, radius, wave, ball) = match hit(BALL.0, BALL.1, -1.0) {
            Some(s) => (BALL.0, BALL.1, 9.0, Some(s)),
            None => ([0.0; 3], self.dome, 7.0, None),
        };
        let s = ball.or_else(|| hit([0.0; 3], self.dome, 1.0)).expect("the camera is in the dome");
        let u: [f64; 3] = std::array::from_fn(|k| (eye[k] + s * ray[k] - center[k]) / radius);
        let color = |c: usize| {
            let [a, b, d] = [u[c], u[(c + 1) % 3], u[(c + 2) % 3]];
            (0.5 + 0.25 * (wave * a + 3.0 * b).sin() + 0.15 * (2.4 * wave * d).sin()) as f32
        };
        (std::array::from_fn(color), ball.is_none())
    }

    fn sky(&self) -> Sky {
        let (center, extent) = self.center_and_extent();
        Sky::open(self, &self.points(), center, extent).unwrap()
    }

    /// The sky at a distance, scene units.
    pub(in crate::init) fn sky_at(&self, radius: f64) -> Sky {
        let mut sky = self.sky();
        sky.mark(radius);
        sky
    }
}

impl Frames for Film {
    fn len(&self) -> usize {
        CAMERAS
    }

    fn camera(&self, i: usize) -> &Camera {
        &self.cameras[i]
    }

    fn time(&self, _: usize) -> Time {
        Time(0.0)
    }

    fn rig(&self, i: usize) -> usize {
        i
    }

    fn name(&self, i: usize) -> String {
        format!("camera {i}")
    }

    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        let [w, h] = SIZE;
        *out = Picture { color: Planes::new(3, h, w), ..Picture::default() };
        for p in 0..w * h {
            let (color, _) = self.at(&self.cameras[i], [(p % w) as f64 + 0.5, (p / w) as f64 + 0.5]);
            (0..3).for_each(|c| out.color.plane_mut(c)[p] = color[c]);
        }
        Ok(())
    }
}

#[test]
fn a_far_dome_is_far_and_a_near_one_is_not() {
    let film = Film::new(FAR);
    let mut sky = film.sky();
    let evidence = sky.fit();
    assert!(evidence.is_far(), "{evidence:?}");
    assert!((100.0..1000.0).contains(&sky.radius), "a dome at 400 is found at {}", sky.radius);
    assert!((0.6..0.95).contains(&sky.share()), "{}", sky.share());
    let wall = Film::new(NEAR).sky().fit();
    assert!(wall.is_open() && !wall.is_far(), "{wall:?}");
    assert!(evidence.errors[1] < 0.5 * evidence.errors[0] && wall.errors[0] < 0.9 * wall.errors[1]);
}

#[test]
fn images_full_of_near_points_are_not_open() {
    let film = Film::new(FAR);
    let (center, extent) = film.center_and_extent();
    let before = |camera: &Camera| {
        let at = |k: usize| [(k % 16) as f64 * 10.0 + 5.0, (k / 16) as f64 * 10.0 + 5.0];
        (0..16 * 12).map(|k| camera.unproject(at(k), 3.0)).collect::<Vec<_>>()
    };
    let points: Vec<[f64; 3]> = film.cameras.iter().flat_map(before).collect();
    let evidence = Sky::open(&film, &points, center, extent).unwrap().fit();
    assert!(!evidence.is_open() && !evidence.is_far(), "{evidence:?}");
    // Those on the dome, as matching finds them, are far.
    let far: Vec<[f64; 3]> = points.iter().step_by(4).map(|&x| normalize(x).map(|v| 400.0 * v)).collect();
    let evidence = Sky::open(&film, &[film.points(), far].concat(), center, extent).unwrap().fit();
    assert!(evidence.is_far(), "{evidence:?}");
}

#[test]
fn points_before_the_sky_are_hidden_ones_on_objects_are_not() {
    let film = Film::new(FAR);
    let sky = film.sky_at(400.0);
    let camera = &film.cameras[4];
    for depth in [3.0, 8.0, 50.0] {
        assert!(sky.hides(camera.unproject([12.5, 12.5], depth)), "{depth}");
    }
    assert!(film.points().iter().all(|&x| !sky.hides(x)));
    let far = sky.of_camera(camera);
    let sees = |pixel: [f64; 2]| far(pixel, film.at(camera, pixel).0);
    assert!(sees([12.5, 12.5]) && sees([150.5, 60.5]) && !sees([80.5, 60.5]));
    assert!(!far([12.5, 12.5], [1.0, 0.0, 1.0]), "something of another colour is before it");
}

#[test]
fn cameras_at_one_place_measure_nothing() {
    let film = Film::new(FAR);
    let one = Film { cameras: vec![film.cameras[3].clone(); CAMERAS], dome: film.dome };
    let evidence = Sky::open(&one, &[], one.cameras[0].center(), 1.0).unwrap().fit();
    assert!(!evidence.is_far(), "{evidence:?}");
}

#[test]
fn wrong_points_before_the_sky_are_cleared() {
    // Several cameras have the same part of the sky in their images.
    let film = Film::on_arc(0.25, FAR);
    let camera = &film.cameras[4];
    // As wrong matches are: near, and left and right of the ball, where cameras see sky.
    let pixel = |k: u32| [if k < 15 { 20.0 } else { 80.0 } + 2.0 * f64::from(k), 12.5];
    let wrong: Vec<[f64; 3]> = (0..30).map(|k| camera.unproject(pixel(k), 3.0 + 0.1 * f64::from(k))).collect();
    let (center, extent) = film.center_and_extent();
    let mut sky = Sky::open(&film, &[film.points(), wrong.clone()].concat(), center, extent).unwrap();
    let is_near = |c: Cell| c == Cell::Near;
    let before = sky.cells(is_near).len();
    sky.mark(400.0);
    let ([after, alone], hidden) =
        ([&sky, &film.sky()].map(|s| s.cells(is_near).len()), wrong.iter().filter(|x| sky.hides(**x)).count());
    assert!(hidden >= 20, "{hidden} of 30; {before} cells with near points became {after}, of the ball alone {alone}");
    assert!(after < (before + alone) / 2, "{before} cells with near points became {after}, of the ball alone {alone}");
    let lost = film.points().iter().filter(|&&x| sky.hides(x)).count();
    assert_eq!(lost, 0, "points of the ball");
}
