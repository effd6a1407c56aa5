pub(crate) use super::people::tests::Scene;
use super::*;
use crate::sfm::algebra::rotation;
use crate::sfm::lens::Lens;
use serde_json::json;
use splat4d::math::align::apart;
use splat4d::math::se3::mat_mul;
use splat4d::math::{Rng, Se3};

/// Seconds between frames.
pub(crate) const FRAME: f64 = 1.0 / 30.0;

/// Four cameras at right angles, about four metres from what they show.
pub(crate) struct Studio {
    pub(crate) poses: Vec<Se3>,
    pub(crate) lenses: Vec<Lens>,
    pub(super) cameras: Vec<Camera>,
    /// Seconds that are added to each clock.
    pub(crate) offsets: Vec<f64>,
}

impl Studio {
    pub(crate) fn new(seed: u64) -> Self {
        let rng = Rng::new(seed, "studio", 0);
        let pose = |c: usize| {
            let angle = std::f64::consts::FRAC_PI_2 * c as f64 + 0.1 * rng.normal(c as u64);
            let far = 4.0 + 0.3 * rng.normal(10 + c as u64);
            let eye = [far * angle.cos(), far * angle.sin(), 1.6 + 0.3 * rng.normal(20 + c as u64)];
            let pose = Se3::look_at(eye, [0.0, 0.0, 0.9], [0.0, 0.0, 1.0]);
            let turn = rotation([0.0, 0.0, 0.1 * rng.normal(30 + c as u64)]);
            Se3 {
                rotation: mat_mul(&turn, &pose.rotation),
                translation: splat4d::math::se3::mat_vec(&turn, pose.translation),
            }
        };
        let size = [1920, 1080];
        let camera = Camera { size, focal: None, interval: FRAME, offset: None, keep_offset: false };
        Self {
            poses: (0..4).map(pose).collect(),
            lenses: (0..4).map(|c| Lens::plain(1400.0 * (1.0 + 0.003 * rng.normal(40 + c)), 1920, 1080)).collect(),
            cameras: vec![camera; 4],
            offsets: (0..4).map(|c| 0.3 * rng.uniform(50 + c)).collect(),
        }
    }

    /// Clicks of a position at a second of the common clock, on each camera's nearest frame, in these cameras.
    fn clicked(&self, at: impl Fn(f64) -> [f64; 3], time: f64, noise: f64, rng: Rng, which: &[usize]) -> Vec<Sight> {
        let sight = |&camera: &usize| {
            let own = ((time - self.offsets[camera]) / FRAME).round() * FRAME;
            let place = self.poses[camera].apply(at(own + self.offsets[camera]));
            let exact = self.lenses[camera].project(place).unwrap();
            let pixel = std::array::from_fn(|a| exact[a] + noise * rng.normal((2 * camera + a) as u64));
            Sight { camera, pixel, time: own }
        };
        which.iter().map(sight).collect()
    }

    /// Static points on objects within a metre and a half.
    fn points(&self, count: usize, noise: f64, seed: u64) -> Vec<Point> {
        let rng = Rng::new(seed, "points", 0);
        let place = |k: usize| -> [f64; 3] {
            let at = |a: usize| rng.uniform((3 * k + a) as u64);
            [2.4 * at(0) - 1.2, 2.4 * at(1) - 1.2, 1.8 * at(2)]
        };
        let point = |k: usize| {
            let draws = rng.fork(k as u64);
            Point { track: None, sights: self.clicked(|_| place(k), 1.0, noise, draws, &[0, 1, 2, 3]) }
        };
        (0..count).map(point).collect()
    }

    /// Offsets as an event on each camera's nearest frame gives them.
    fn marked(&self, event: f64) -> Vec<f64> {
        let own = |o: &f64| ((event - o) / FRAME).round() * FRAME;
        let first = own(&self.offsets[0]);
        self.offsets.iter().map(|o| first - own(o)).collect()
    }

    /// The largest errors: degrees, share of the rig's radius.
    fn error(&self, found: &Solution) -> [f64; 2] {
        let poses: Vec<Se3> = found.cameras.iter().map(|c| c.as_ref().expect("all have a pose").0).collect();
        let all = apart(&poses, &self.poses).expect("cameras are apart");
        [all.iter().map(|a| a.degrees).fold(0.0, f64::max), all.iter().map(|a| a.center).fold(0.0, f64::max)]
    }
}

#[test]
fn eight_points_give_four_cameras_at_right_angles() {
    let mut errors = Vec::new();
    for seed in 0..12 {
        let studio = Studio::new(seed);
        let points = studio.points(8, 1.0, seed);
        let found = solve(&studio.cameras, &points);
        errors.push(studio.error(&found));
        let again = solve(&studio.cameras, &points);
        assert_eq!(found.residuals, again.residuals, "the same clicks give the same bits");
    }
    let good = errors.iter().filter(|e| e[0] < 1.0 && e[1] < 0.02).count();
    assert_eq!(good, errors.len(), "{errors:?}");
}

#[test]
fn a_known_focal_length_is_kept() {
    let mut studio = Studio::new(3);
    for (camera, lens) in studio.cameras.iter_mut().zip(&studio.lenses) {
        camera.focal = Some(lens.focal);
    }
    let found = solve(&studio.cameras, &studio.points(7, 1.0, 3));
    let [degrees, center] = studio.error(&found);
    assert!(degrees < 0.4 && center < 0.01, "{degrees} {center}");
    for (camera, lens) in found.cameras.iter().zip(&studio.lenses) {
        assert!((camera.as_ref().unwrap().1.focal / lens.focal - 1.0).abs() < 1e-12);
    }
}

#[test]
fn a_wrong_click_is_seen_and_does_not_bend_the_rig() {
    let studio = Studio::new(5);
    let mut points = studio.points(12, 1.0, 5);
    points[4].sights[2].pixel[0] += 90.0;
    let found = solve(&studio.cameras, &points);
    let [degrees, center] = studio.error(&found);
    assert!(degrees < 1.0 && center < 0.02, "{degrees} {center}");
    let worst = found.residuals.iter().map(|r| r.iter().flatten().copied().fold(0.0, f64::max));
    let worst: Vec<f64> = worst.collect();
    assert!(worst.iter().enumerate().all(|(p, e)| (p == 4) == (*e > 25.0)), "{worst:?}");
}

#[test]
fn a_moving_point_refines_the_offsets_of_an_event() {
    for seed in 0..4 {
        let mut studio = Studio::new(seed);
        let marked = studio.marked(0.91);
        studio.cameras.iter_mut().zip(&marked).for_each(|(c, o)| c.offset = Some(*o));
        let mut points = studio.points(8, 1.0, seed);
        // A hand on a circle, 2 m/s.
        let hand = |t: f64| [0.6 * (3.3 * t).cos(), 0.6 * (3.3 * t).sin(), 1.2 + 0.2 * (2.0 * t).sin()];
        let rng = Rng::new(seed, "hand", 0);
        for k in 0..6 {
            let sights = studio.clicked(hand, 0.8 + 0.2 * k as f64, 1.0, rng.fork(k), &[0, 1, 2, 3]);
            points.push(Point { track: Some(0), sights });
        }
        let found = solve(&studio.cameras, &points);
        let truth = |c: usize| studio.offsets[c] - studio.offsets[0];
        let worst = |of: &[f64]| (0..4).map(|c| (of[c] - of[0] - truth(c)).abs() / FRAME).fold(0.0, f64::max);
        let [before, after] = [worst(&marked), worst(&found.offsets)];
        let [degrees, center] = studio.error(&found);
        assert!(after < 0.25, "{after} of {before} frames");
        assert!(degrees < 1.0 && center < 0.02, "{degrees} {center}");
    }
}

#[test]
fn what_is_missing_is_stated() {
    let studio = Studio::new(1);
    let all = studio.points(8, 0.5, 1);
    let reason = |found: &Solution, c: usize| found.cameras[c].as_ref().err().cloned().unwrap_or_default();
    let none = solve(&studio.cameras, &[]);
    assert!(reason(&none, 0).starts_with("0 clicked points are shared") && none.error.is_none());
    let few = solve(&studio.cameras, &all[..4]);
    assert!(reason(&few, 2).contains("click 2 more"), "{}", reason(&few, 2));
    // The fourth camera shows two of them.
    let mut part = all.clone();
    part.iter_mut().skip(2).for_each(|p| p.sights.retain(|s| s.camera != 3));
    let found = solve(&studio.cameras, &part);
    assert!(found.cameras[..3].iter().all(Result::is_ok));
    assert!(reason(&found, 3).contains("2 clicked points are known") && reason(&found, 3).contains("click 2 more"));
    // All clicks of one camera in one place: no pose, and no panic.
    let mut flat = all;
    flat.iter_mut().flat_map(|p| &mut p.sights).for_each(|s| s.pixel = [500.0, 500.0]);
    let found = solve(&studio.cameras, &flat);
    assert!(found.residuals.iter().flatten().flatten().all(|r| r.is_finite()));
}

#[test]
fn a_floor_points_to_the_cameras() {
    let floor = [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 2.0, 1.0], [1.0, 1.0, 1.0]];
    let (up, mean) = plane(&floor, [3.0, 1.0, -4.0]).unwrap();
    assert!((up[2] + 1.0).abs() < 1e-12 && mean[2] == 1.0);
    assert_eq!(plane(&floor[..2], [0.0; 3]), None);
    assert_eq!(plane(&[[0.0; 3], [1.0; 3], [2.0; 3]], [0.0, 0.0, 9.0]), None, "a line spans no floor");
}

fn parsed(points: serde_json::Value, more: serde_json::Value) -> Result<Clicks> {
    let mut all = json!({"version": 1, "cameras": {"left": [640, 480], "right": [640, 480]}, "points": points});
    let object = all.as_object_mut().unwrap();
    object.extend(more.as_object().unwrap().clone());
    Clicks::of(all, &["left", "right"])
}

#[test]
fn clicks_round_trip_and_nonsense_is_explained() {
    let click = |camera: &str, x: f64| json!({"camera": camera, "x": x, "y": 7.25, "time": 0.5});
    let point = |name: &str| json!({"name": name, "clicks": [click("left", 10.5), click("right", 20.0)]});
    let good = parsed(
        json!([point("a"), point("b"), {"name": "hand", "moment": 0.5, "clicks": []}]),
        json!({"event": {"left": 0.1}, "floor": ["a"], "length": {"points": ["a", "b"], "metres": 2.0}}),
    )
    .unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("points.json");
    std::fs::write(&path, good.json()).unwrap();
    assert_eq!(Clicks::read(&path, &["left", "right"]).unwrap(), good);
    std::fs::write(&path, "{\"version\": 1").unwrap();
    let error = Clicks::read(&path, &["left"]).unwrap_err().to_string();
    assert!(error.contains("points.json") && error.contains("--assist"), "{error}");
    for (points, more, word) in [
        (json!([point("a")]), json!({"version": 2}), "expected 1, found 2"),
        (json!([point("a"), point("a")]), json!({}), "listed twice"),
        (json!([{"name": "a", "clicks": [click("up", 1.0)]}]), json!({}), "Cameras are left, right"),
        (json!([{"name": "a", "clicks": [click("left", 641.0)]}]), json!({}), "outside of the 640x480 image"),
        (json!([{"name": "a", "clicks": [click("left", 1.0), click("left", 2.0)]}]), json!({}), "shows it twice"),
        (json!([point("a")]), json!({"floor": ["b"]}), "refer to static points"),
        (json!([point("a")]), json!({"length": {"points": ["a", "a"], "metres": 1.0}}), "to itself"),
        (json!([point("a"), point("b")]), json!({"length": {"points": ["a", "b"], "metres": 0.0}}), "more than 0 m"),
        (json!([point("a")]), json!({"ground": ["a"]}), "ground"),
        (json!([point("a")]), json!({"event": {"middle": 0.0}}), "no camera \"middle\""),
        (json!([point("a")]), json!({"cameras": {"left": [640, 480]}}), "image size of camera right"),
    ] {
        let error = parsed(points, more).unwrap_err().to_string();
        assert!(error.contains(word), "{word}: {error}");
    }
}
