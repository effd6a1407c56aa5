use super::super::keypoints::{Frames, Person};
use super::super::tests::{FRAME, Studio};
use super::*;
use splat4d::math::align::apart;
use splat4d::math::{Rng, Se3};

/// Frames of the videos, and joints of a person.
const FRAMES: usize = 90;
const JOINTS: usize = 17;

/// A joint of a person who walks around a circle about `middle`, at a second of the common clock. Those on one side walk
/// the other way around a smaller circle: where everyone moves alike, a rig that confuses them fits as well.
fn joint(k: usize, middle: [f64; 2], t: f64) -> [f64; 3] {
    let side = if k.is_multiple_of(2) { 1.0 } else { -1.0 };
    let (turn, radius, tall) = if middle[0] < 0.0 { (-1.2, 0.5, 1.45) } else { (0.9, 0.8, 1.6) };
    let swing = 0.35 * side * (5.0 * t + middle[0]).sin() * ((k % 5) as f64 / 4.0);
    let angle = turn * t + 3.0 * middle[1];
    let [cos, sin] = [angle.cos(), angle.sin()];
    let [x, y] = [radius + 0.15 * side, swing];
    let height = 0.1 + tall * k as f64 / JOINTS as f64 + 0.03 * (10.0 * t).sin();
    [middle[0] + x * cos - y * sin, middle[1] + x * sin + y * cos, height]
}

/// Where people are in the middle of their ways, by camera; those who stay in place last.
pub(crate) struct Scene {
    walkers: [Vec<[f64; 2]>; 4],
    idle: [Vec<[f64; 2]>; 4],
    /// Share of the frames in which the second camera's detector takes left for right.
    swapped: f64,
}

impl Scene {
    pub(crate) fn of(walkers: [Vec<[f64; 2]>; 4]) -> Self {
        Self { walkers, idle: Default::default(), swapped: 0.0 }
    }

    /// What detectors find, listed now from the first, now from the last.
    pub(crate) fn detections(&self, studio: &Studio, noise: f64) -> Vec<Frames> {
        let rng = Rng::new(2, "detections", 0);
        let person = |camera: usize, frame: usize, middle: [f64; 2], still: bool, number: u64| -> Person {
            let t = frame as f64 * FRAME + studio.offsets[camera];
            let draws = rng.fork((1000 * camera + frame) as u64).fork(number);
            // A joint is elsewhere from every side.
            let biases = rng.fork(100_000 + camera as u64).fork(number);
            let swap = camera == 1 && draws.uniform(999) < self.swapped;
            let keypoint = |k: usize| {
                let shown = if swap { (k ^ 1).min(JOINTS - 1) } else { k };
                let place = joint(shown, middle, if still { 0.0 } else { t });
                let at = studio.lenses[camera].project(studio.poses[camera].apply(place)).unwrap();
                let hidden = draws.below(100 + k as u64, 8) == 0;
                let off = |a: usize| {
                    let bias = 2.0 * biases.normal((2 * k + a) as u64);
                    bias + (noise + if hidden { 60.0 } else { 0.0 }) * draws.normal((2 * k + a) as u64)
                };
                [at[0] + off(0), at[1] + off(1), if hidden { 0.2 } else { 0.8 }]
            };
            (0..JOINTS).map(keypoint).collect()
        };
        let camera = |c: usize| {
            let people = |frame: usize| {
                let all = self.walkers[c].iter().map(|&m| (m, false)).chain(self.idle[c].iter().map(|&m| (m, true)));
                let mut all: Vec<Person> =
                    all.enumerate().map(|(n, (m, still))| person(c, frame, m, still, n as u64)).collect();
                if frame % 2 == 1 {
                    all.reverse();
                }
                all
            };
            (0..FRAMES).map(|frame| (frame, people(frame))).collect()
        };
        (0..4).map(camera).collect()
    }
}

const NAMES: [&str; 4] = ["a", "b", "c", "d"];

/// Degrees and share of the rig's radius, at worst.
fn errors(studio: &Studio, found: &Calibrated) -> [f64; 2] {
    let poses: Vec<Se3> = found.cameras.iter().map(|c| c.0).collect();
    let all = apart(&poses, &studio.poses).unwrap();
    [all.iter().map(|a| a.degrees).fold(0.0, f64::max), all.iter().map(|a| a.center).fold(0.0, f64::max)]
}

fn check(studio: &Studio, scene: &Scene, noise: f64) -> Calibrated {
    let found = calibrate(&NAMES, &studio.cameras, &scene.detections(studio, noise)).unwrap();
    let [degrees, center] = errors(studio, &found);
    assert!(degrees < 2.0 && center < 0.04, "{degrees} degrees, {center} of the radius");
    for c in 1..4 {
        let off = (found.offsets[c] - found.offsets[0]) - (studio.offsets[c] - studio.offsets[0]);
        assert!(off.abs() < 0.5 * FRAME, "camera {c}: {off} s");
    }
    found
}

#[test]
fn a_walker_calibrates_and_synchronises_cameras_at_right_angles() {
    check(&Studio::new(3), &Scene::of(std::array::from_fn(|_| vec![[0.0, 0.0]])), 4.0);
}

#[test]
fn two_walkers_are_distinguished_and_bystanders_ignored() {
    let studio = Studio::new(5);
    let (first, second) = ([0.1, 0.0], [-0.4, 0.5]);
    // The third camera shows only the second one.
    let walkers = [vec![first, second], vec![second, first], vec![second], vec![first, second]];
    let idle = [vec![[1.4, -0.9]], vec![[1.4, -0.9]], Vec::new(), Vec::new()];
    let found = check(&studio, &Scene { idle, ..Scene::of(walkers) }, 4.0);
    assert_eq!(found.people, 2);
}

#[test]
fn swapped_sides_do_not_bend_the_rig() {
    let studio = Studio::new(6);
    check(&studio, &Scene { swapped: 0.2, ..Scene::of(std::array::from_fn(|_| vec![[0.0, 0.1]])) }, 3.0);
}

#[test]
fn given_offsets_stay() {
    let mut studio = Studio::new(7);
    for (camera, offset) in studio.cameras.iter_mut().zip(&studio.offsets) {
        (camera.offset, camera.keep_offset) = (Some(*offset), true);
    }
    let found = check(&studio, &Scene::of(std::array::from_fn(|_| vec![[0.0, 0.1]])), 4.0);
    assert_eq!(found.offsets, studio.offsets);
}

#[test]
fn a_camera_that_shows_somebody_else_is_refused_by_name() {
    let studio = Studio::new(8);
    let (first, other) = ([0.1, 0.0], [-0.4, 0.5]);
    let scene = Scene::of([vec![first], vec![first], vec![other], vec![first]]);
    let e = calibrate(&NAMES, &studio.cameras, &scene.detections(&studio, 4.0)).unwrap_err().to_string();
    assert!(e.contains("keypoints of camera c contradict those of the others"), "{e}");
    let scene =
        Scene { idle: Scene::of(std::array::from_fn(|_| vec![first])).walkers, ..Scene::of(Default::default()) };
    let e = calibrate(&NAMES, &studio.cameras, &scene.detections(&studio, 4.0)).unwrap_err().to_string();
    assert!(e.contains("no person moves in the images of camera a"), "{e}");
}

#[test]
fn tracks_survive_short_gaps_and_crossing_lists() {
    let at = |x: f64| -> Person { (0..5).map(|k| [x + 60.0 * k as f64, 90.0 * k as f64, 0.9]).collect() };
    let mut frames = Frames::new();
    for k in 0..40 {
        let (a, b) = (at(100.0 + 4.0 * k as f64), at(900.0 - 8.0 * k as f64));
        let people = match k {
            10..14 => vec![b],
            _ if k % 3 == 0 => vec![b, a],
            _ => vec![a, b],
        };
        frames.insert(k, people);
    }
    let tracks = track::linked(&frames, FRAME, 6.0);
    let shown = |t: &Track| (0..40).filter(|k| t.near(*k as f64 * FRAME).is_some()).count();
    assert_eq!(tracks.iter().map(shown).collect::<Vec<_>>(), [40, 36]);
    let seen = tracks[0].seen(20.0 * FRAME, 0).unwrap();
    assert!((seen.pixel[0] - 740.0 / 6.0).abs() < 1e-9 && (seen.velocity[0] + 40.0).abs() < 1e-9, "{seen:?}");
}
