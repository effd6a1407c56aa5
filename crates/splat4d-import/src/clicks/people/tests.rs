use super::super::keypoints::{Frames, Person};
use super::super::tests::{FRAME, Studio};
use super::*;
use splat4d::math::align::apart;
use splat4d::math::{Rng, Se3};

/// Frames of the videos, and joints of a person.
const FRAMES: usize = 90;
const JOINTS: usize = 17;

/// A joint of a person who walks around a circle about `middle`, at a second of the common clock.
fn joint(k: usize, middle: [f64; 2], t: f64) -> [f64; 3] {
    let side = if k.is_multiple_of(2) { 1.0 } else { -1.0 };
    let swing = 0.35 * side * (5.0 * t + middle[0]).sin() * ((k % 5) as f64 / 4.0);
    let angle = 0.9 * t + 3.0 * middle[1];
    let [cos, sin] = [angle.cos(), angle.sin()];
    let [x, y] = [0.8 + 0.15 * side, swing];
    let height = 0.1 + 1.6 * k as f64 / JOINTS as f64 + 0.03 * (10.0 * t).sin();
    [middle[0] + x * cos - y * sin, middle[1] + x * sin + y * cos, height]
}

/// Where people are in the middle of their ways, by camera; those who stay in place last.
struct Scene {
    walkers: [Vec<[f64; 2]>; 4],
    idle: [Vec<[f64; 2]>; 4],
    /// Share of the frames in which the second camera's detector takes left for right.
    swapped: f64,
}

impl Scene {
    fn of(walkers: [Vec<[f64; 2]>; 4]) -> Self {
        Self { walkers, idle: Default::default(), swapped: 0.0 }
    }

    /// What detectors find, listed now from the first, now from the last.
    fn detections(&self, studio: &Studio, noise: f64) -> Vec<Frames> {
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
    eprintln!("{degrees:.2} degrees, {:.2} %, {found:?}", 100.0 * center);
    assert!(degrees < 2.0 && center < 0.04, "{degrees} degrees, {center} of the radius");
    for c in 1..4 {
        let off = (found.offsets[c] - found.offsets[0]) - (studio.offsets[c] - studio.offsets[0]);
        assert!(off.abs() < 0.5 * FRAME, "camera {c}: {off} s");
    }
    found
}

#[test]
fn a_walker_calibrates_and_synchronises_cameras_at_right_angles() {
    for seed in [3, 4] {
        let studio = Studio::new(seed);
        check(&studio, &Scene::of(std::array::from_fn(|_| vec![[0.0, 0.0]])), 4.0);
    }
}

/// Measurement on the demo, not committed.
#[test]
#[ignore]
fn demo() {
    let folder = std::path::PathBuf::from(std::env::var("KP").unwrap());
    let names = ["cam01", "cam02", "cam03", "cam04"];
    let shift: Vec<usize> =
        std::env::var("SHIFT").unwrap_or("0,0,0,0".into()).split(',').map(|s| s.parse().unwrap()).collect();
    let frames = super::super::read_keypoints(&folder, &names).unwrap();
    let frames: Vec<Frames> = frames
        .into_iter()
        .zip(&shift)
        .map(|(f, &s)| f.into_iter().filter(|(k, _)| *k >= s).map(|(k, p)| (k - s, p)).collect())
        .collect();
    let json: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string("/work/shared/data/pose2sim-4cam/cameras.json").unwrap())
            .unwrap();
    let truth: Vec<Se3> = json["cameras"]
        .as_array()
        .unwrap()
        .iter()
        .map(|c| {
            let m = |r: usize, k: usize| c["world_to_camera"][r][k].as_f64().unwrap();
            Se3 {
                rotation: std::array::from_fn(|r| std::array::from_fn(|k| m(r, k))),
                translation: std::array::from_fn(|r| m(r, 3)),
            }
        })
        .collect();
    let kept = std::env::var("KEPT").is_ok();
    let cameras = vec![
        Camera {
            size: [1088, 1920],
            focal: None,
            interval: 1.0 / 60.0,
            offset: kept.then_some(0.0),
            keep_offset: kept
        };
        4
    ];
    let begun = std::time::Instant::now();
    let found = calibrate(&names, &cameras, &frames).unwrap();
    let took = begun.elapsed();
    let poses: Vec<Se3> = found.cameras.iter().map(|c| c.0).collect();
    for (a, c) in apart(&poses, &truth).unwrap().iter().zip(&found.cameras) {
        eprintln!("{:.2} degrees {:.2} % focal {:.0} center {:?}", a.degrees, 100.0 * a.center, c.1.focal, c.1.center);
    }
    let frames: Vec<f64> = found
        .offsets
        .iter()
        .zip(&shift)
        .map(|(o, &s)| 60.0 * (o - found.offsets[0]) - s as f64 + shift[0] as f64)
        .collect();
    eprintln!(
        "offsets off by frames {frames:.2?} people {} positions {} error {:.1} apart {:.1} took {took:?}",
        found.people, found.positions, found.error, found.apart
    );
}
