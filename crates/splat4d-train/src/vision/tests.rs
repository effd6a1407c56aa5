//! Synthetic rooms in which every point's position is known: a slanted wall and a floor with a noise texture, and a
//! panel that moves before them.

use super::*;
use crate::capture::frames::Picture;
use splat4d::math::se3::{dot, sub};
use splat4d::math::{Rng, Se3};
use splat4d::scene::{Camera, Planes, Time};

/// See the module's documentation.
struct Room {
    cameras: Vec<Camera>,
    moments: usize,
    /// Length of what is one in the descriptions below.
    unit: f64,
    textured: bool,
    /// No wall, but what is a hundred times as far away.
    far: bool,
    panel: bool,
    /// Frames of one moving camera, and not of a camera each.
    one_camera: bool,
}

/// A plane n·x = d, in units.
type Plane = ([f64; 3], f64);
const WALL: Plane = ([-0.3, 0.0, 1.0], 1.0);
const FLOOR: Plane = ([0.0, 1.0, 0.0], 1.2);
/// What is behind a room without a wall, and how much larger its texture is.
const HORIZON: Plane = ([0.0, 0.0, 1.0], 500.0);
const LARGER: f64 = 100.0;
/// Depth of the panel and half its edge, units.
const PANEL: (f64, f64) = (-0.6, 0.45);
const WIDTH: usize = 112;
const HEIGHT: usize = 84;

impl Room {
    /// Cameras in an arc before the wall.
    fn new(cameras: usize, unit: f64) -> Self {
        let place = |i: usize| {
            let a = 0.16 * (i as f64 - 0.5 * (cameras - 1) as f64);
            [4.0 * a.sin(), -0.3 * (i % 2) as f64, -4.0 * a.cos()]
        };
        let camera = |i| {
            let pose = Se3::look_at(place(i).map(|v| v * unit), [0.0, 0.2 * unit, 0.0], [0.0, -1.0, 0.0]);
            Camera::with_fov_y(pose, 0.7, WIDTH, HEIGHT)
        };
        let cameras = (0..cameras).map(camera).collect();
        Self { cameras, moments: 1, unit, textured: true, far: false, panel: false, one_camera: false }
    }

    /// The panel's middle at a time, units.
    fn panel_at(&self, moment: usize) -> [f64; 3] {
        [-1.0 + 0.4 * moment as f64, 0.0, PANEL.0]
    }

    fn time_of(&self, moment: usize) -> f64 {
        0.1 * moment as f64
    }

    /// Smooth noise in [0, 1] of a position on a surface.
    fn noise(&self, surface: u64, [u, v]: [f64; 2]) -> f64 {
        let rng = Rng::new(7, "texture", surface);
        let mut sum = 0.0;
        for octave in 0..3_u64 {
            let size = 0.5_f64.powi(octave as i32 + 1);
            let [x, y] = [u, v].map(|k| k / size + 1000.0);
            let (left, top) = (x.floor(), y.floor());
            let ease = |k: f64| k * k * (3.0 - 2.0 * k);
            let (fx, fy) = (ease(x - left), ease(y - top));
            let at = |dx: u64, dy: u64| rng.fork(octave).fork(left as u64 + dx).uniform(top as u64 + dy);
            let upper = at(0, 0) + fx * (at(1, 0) - at(0, 0));
            let lower = at(0, 1) + fx * (at(1, 1) - at(0, 1));
            sum += (upper + fy * (lower - upper)) / 3.0;
        }
        sum
    }

    fn color(&self, eye: [f64; 3], ray: [f64; 3], moment: usize) -> f32 {
        let hit = |(n, d): Plane| (d - dot(n, eye)) / dot(n, ray);
        let at = |t: f64| -> [f64; 3] { std::array::from_fn(|k| eye[k] + t * ray[k]) };
        let ahead = |t: f64| if t > 0.0 { t } else { f64::INFINITY };
        let (behind, larger) = if self.far { (HORIZON, LARGER) } else { (WALL, 1.0) };
        let (wall, floor) = (ahead(hit(behind)), ahead(hit(FLOOR)));
        let panel = hit(([0.0, 0.0, 1.0], PANEL.0));
        let middle = self.panel_at(moment);
        let off = sub(at(panel), middle);
        if !self.textured {
            return 0.5;
        }
        let value = if self.panel && off[0].abs().max(off[1].abs()) < PANEL.1 {
            1.0 - self.noise(2, [off[0], off[1]])
        } else if wall < floor {
            self.noise(0, [at(wall)[0], at(wall)[1]].map(|x| x / larger))
        } else {
            self.noise(1, [at(floor)[0], at(floor)[2]])
        };
        value as f32
    }

    /// Distance from the nearest surface of a time, or of the static background, of the depth in the first camera.
    fn off(&self, x: [f64; 3], moment: Option<usize>) -> f64 {
        let depth = self.cameras[0].project(x).map_or(f64::INFINITY, |(_, z)| z) / self.unit;
        let x = x.map(|v| v / self.unit);
        let from = |(n, d): Plane| (dot(n, x) - d).abs() / dot(n, n).sqrt();
        let still = from(WALL).min(from(FLOOR));
        let off = moment.map(|m| sub(x, self.panel_at(m)));
        let on_panel = off.filter(|o| o[0].abs().max(o[1].abs()) < 1.1 * PANEL.1).map_or(f64::INFINITY, |o| o[2].abs());
        still.min(on_panel) / depth
    }

    fn points(&self, moments: &[f64], count: usize) -> Vec<Point> {
        points(self, moments, count, &mut Progress(&mut |_| {})).unwrap()
    }
}

impl Frames for Room {
    fn len(&self) -> usize {
        self.cameras.len() * self.moments
    }

    fn camera(&self, i: usize) -> &Camera {
        &self.cameras[i % self.cameras.len()]
    }

    fn time(&self, i: usize) -> Time {
        Time(self.time_of(i / self.cameras.len()))
    }

    fn rig(&self, i: usize) -> usize {
        if self.one_camera { 0 } else { i % self.cameras.len() }
    }

    fn name(&self, i: usize) -> String {
        i.to_string()
    }

    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        let camera = self.camera(i);
        let eye = camera.center();
        out.color = Planes::new(3, HEIGHT, WIDTH);
        (out.mask, out.weight) = (None, None);
        for p in 0..HEIGHT * WIDTH {
            let pixel = [(p % WIDTH) as f64 + 0.5, (p / WIDTH) as f64 + 0.5];
            let ray = sub(camera.unproject(pixel, self.unit), eye).map(|v| v / self.unit);
            let value = self.color(eye.map(|v| v / self.unit), ray, i / self.cameras.len());
            [1.0, 0.8, 0.6].iter().enumerate().for_each(|(c, tint)| out.color.plane_mut(c)[p] = tint * value);
        }
        Ok(())
    }
}

/// Share of the points that are within a hundredth of their depth of a surface.
fn share_on(room: &Room, points: &[Point], moment: Option<usize>) -> f64 {
    points.iter().filter(|p| room.off(p.place, moment) < 0.01).count() as f64 / points.len().max(1) as f64
}

#[test]
fn points_are_on_the_surfaces_in_any_unit() {
    for unit in [1.0, 1e-3, 1e3] {
        let room = Room::new(6, unit);
        let found = room.points(&[], 300);
        assert!((150..900).contains(&found.len()), "{} points", found.len());
        let on = share_on(&room, &found, None);
        assert!(on > 0.95, "unit {unit}: {on} of {} points lie on a surface", found.len());
        assert!(found.iter().all(|p| p.time.is_none()));
        let floor = found.iter().filter(|p| p.place[1] > 1.15 * unit).count();
        assert!(floor > found.len() / 50, "the floor is seen from the side: {floor} points");
    }
}

#[test]
fn points_from_features_alone_are_on_the_surfaces() {
    let room = Room::new(6, 1.0);
    let views = Rigs::of(&room).still(&room).unwrap();
    let tracks = matching::tracks(&views);
    let on = tracks.iter().filter(|t| room.off(t.point, None) < 0.01).count();
    assert!(tracks.len() >= 40 && on as f64 > 0.95 * tracks.len() as f64, "{on} of {}", tracks.len());
    assert!(tracks.iter().any(|t| t.seen.len() > 2), "some points are seen by more than two cameras");
    assert!(tracks.iter().all(|t| t.error < 1.5));
}

#[test]
fn a_background_too_far_to_be_measured_gets_points_beyond_the_scene() {
    for unit in [1.0, 1e3] {
        let room = Room { far: true, ..Room::new(6, unit) };
        let found = room.points(&[], 300);
        let place = |p: &Point| p.place.map(|x| x / unit);
        let (floor, above): (Vec<&Point>, Vec<&Point>) =
            found.iter().partition(|p| (place(p)[1] - FLOOR.1).abs() < 0.1);
        assert!(floor.len() > 10 && above.len() > 50, "{} on the floor, {} above", floor.len(), above.len());
        let far = above.iter().filter(|p| place(p)[2] > 20.0).count();
        assert!(far * 10 > above.len() * 9, "{far} of {} lie where nothing near is", above.len());
    }
}

#[test]
fn the_same_points_with_any_number_of_threads() {
    let room = Room { moments: 3, panel: true, ..Room::new(5, 1.0) };
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| room.points(&[0.1], 100))
    };
    let one = with(1);
    assert!(!one.is_empty() && one == with(4));
}

#[test]
fn images_without_texture_and_single_cameras_give_no_points() {
    assert!(Room { textured: false, ..Room::new(4, 1.0) }.points(&[], 100).is_empty());
    assert!(Room { moments: 3, ..Room::new(1, 1.0) }.points(&[0.1], 100).is_empty());
}

#[test]
fn wrong_poses_give_few_points() {
    let right = Room::new(6, 1.0);
    let mut wrong = Room::new(6, 1.0);
    // The images are those of the right cameras: only what is stated about them is wrong.
    struct Posed<'a>(&'a Room, &'a Room);
    impl Frames for Posed<'_> {
        fn len(&self) -> usize {
            self.0.len()
        }
        fn camera(&self, i: usize) -> &Camera {
            self.0.camera(i)
        }
        fn time(&self, i: usize) -> Time {
            self.0.time(i)
        }
        fn rig(&self, i: usize) -> usize {
            self.0.rig(i)
        }
        fn name(&self, i: usize) -> String {
            self.0.name(i)
        }
        fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
            self.1.load(i, out)
        }
    }
    for (i, camera) in wrong.cameras.iter_mut().enumerate() {
        // Each looks a few degrees to another side, and rolls.
        let a = 1.7 * i as f64;
        let (eye, forward) = (camera.center(), camera.forward());
        let target: [f64; 3] = std::array::from_fn(|k| eye[k] + forward[k] + 0.15 * [a.sin(), a.cos(), 0.0][k]);
        camera.cam_from_world = Se3::look_at(eye, target, [0.1 * (2.0 * a).sin(), -1.0, 0.0]);
    }
    let count = |told: &dyn Frames| points(told, &[], 2000, &mut Progress(&mut |_| {})).unwrap().len();
    let (good, bad) = (count(&right), count(&Posed(&wrong, &right)));
    assert!(bad * 10 < good, "{bad} points with wrong poses, {good} with right ones");
}

#[test]
fn dynamic_points_keep_their_time_and_static_points_have_none() {
    let room = Room { moments: 6, panel: true, ..Room::new(6, 1.0) };
    let moment = 3;
    let found = room.points(&[room.time_of(moment)], 300);
    let (moving, still): (Vec<Point>, Vec<Point>) = found.into_iter().partition(|p| p.time.is_some());
    assert!(moving.len() >= 20 && still.len() >= 150, "{} and {}", moving.len(), still.len());
    assert!(moving.iter().all(|p| p.time == Some(room.time_of(moment))));
    let on = share_on(&room, &moving, Some(moment));
    assert!(on > 0.9, "{on} of what moves lies where the panel is, or on what it hid");
    let panel = moving.iter().filter(|p| (p.place[2] - PANEL.0).abs() < 0.05).count();
    assert!(panel * 2 > moving.len(), "{panel} of {} lie on the panel", moving.len());
    let on = share_on(&room, &still, None);
    assert!(on > 0.95, "{on} of the static points lie on the wall and the floor");
}

#[test]
fn static_points_are_found_with_one_moving_camera() {
    let room = Room { one_camera: true, ..Room::new(10, 1.0) };
    let found = room.points(&[0.0], 200);
    assert!(found.len() >= 100 && found.iter().all(|p| p.time.is_none()), "{}", found.len());
    let on = share_on(&room, &found, None);
    assert!(on > 0.9, "{on} of {} points lie on a surface", found.len());
}
