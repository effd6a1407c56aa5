use super::super::tests::{FRAME, Studio};
use super::*;
use splat4d::math::Rng;

/// Frames of the videos, and joints of a person.
const FRAMES: usize = 60;
const JOINTS: usize = 15;

/// A joint of a walking person who begins at `start`, at a second of the common clock.
fn joint(k: usize, start: [f64; 2], t: f64) -> [f64; 3] {
    let side = if k.is_multiple_of(2) { 1.0 } else { -1.0 };
    let swing = side * (4.0 * t).sin();
    let turn = 0.7 * t;
    let [x, y, z] = [0.12 * side + 0.02 * k as f64, 0.3 * swing * (k % 3) as f64 / 2.0, 0.1 + 0.12 * k as f64];
    let [cos, sin] = [turn.cos(), turn.sin()];
    [start[0] + 0.5 * cos + x * cos - y * sin, start[1] + 0.5 * sin + x * sin + y * cos, z]
}

/// What detectors find: in every camera the first person; in the first two one more, listed now first, now last.
fn detections(studio: &Studio, noise: f64) -> Vec<Frames> {
    let rng = Rng::new(2, "detections", 0);
    let person = |camera: usize, frame: usize, start: [f64; 2], number: u64| -> Person {
        let t = frame as f64 * FRAME + studio.offsets[camera];
        let draws = rng.fork((1000 * camera + frame) as u64).fork(number);
        let keypoint = |k: usize| {
            let at = studio.lenses[camera].project(studio.poses[camera].apply(joint(k, start, t))).unwrap();
            let hidden = draws.below(100 + k as u64, 8) == 0;
            let off = |a: usize| (noise + if hidden { 60.0 } else { 0.0 }) * draws.normal((2 * k + a) as u64);
            [at[0] + off(0), at[1] + off(1), if hidden { 0.2 } else { 0.8 }]
        };
        (0..JOINTS).map(keypoint).collect()
    };
    let camera = |c: usize| {
        let people = |frame: usize| {
            let mut all = vec![person(c, frame, [0.0, 0.0], 0)];
            if c < 2 {
                all.push(person(c, frame, [1.1, -0.9], 1));
            }
            if frame % 2 == 1 {
                all.reverse();
            }
            all
        };
        (0..FRAMES).map(|frame| (frame, people(frame))).collect()
    };
    (0..4).map(camera).collect()
}

fn cameras(studio: &Studio) -> Vec<Camera> {
    studio.cameras.iter().map(|c| Camera { noise: 6.0, ..c.clone() }).collect()
}

#[test]
fn people_calibrate_cameras_at_right_angles() {
    let studio = Studio::new(3);
    let people = People::new(&detections(&studio, 3.0));
    assert_eq!(people.tracks.iter().map(Vec::len).collect::<Vec<_>>(), [2, 2, 1, 1]);
    let cameras = cameras(&studio);
    let who = people.identities(&cameras).unwrap();
    assert_eq!(who.len(), 2, "{who:?}");
    assert!(who[0].iter().all(Option::is_some));
    assert_eq!(who[1][2..], [None; 2]);
    let found = solve(&cameras, &points_of(&people.all(&cameras, &who)));
    let [degrees, center] = studio.error(&found);
    assert!(degrees < 2.0 && center < 0.04, "{degrees} degrees, {center} of the radius");
    for c in 1..4 {
        let off = (found.offsets[c] - found.offsets[0]) - (studio.offsets[c] - studio.offsets[0]);
        assert!(off.abs() < FRAME, "camera {c}: {off} s");
    }
}

#[test]
fn people_who_are_seen_by_one_camera_give_nothing() {
    let studio = Studio::new(3);
    let mut frames = detections(&studio, 3.0);
    frames.iter_mut().skip(1).for_each(Frames::clear);
    let people = People::new(&frames);
    assert_eq!(people.missing().collect::<Vec<_>>(), [1, 2, 3]);
    assert!(people.identities(&cameras(&studio)).is_none());
    // At other times they are other positions.
    let mut late = detections(&studio, 3.0);
    let moved = |frames: &Frames| frames.iter().map(|(k, p)| (k + 100_000, p.clone())).collect();
    late.iter_mut().skip(1).for_each(|f| *f = moved(f));
    late.iter_mut().skip(2).for_each(|f| *f = moved(f));
    late.iter_mut().skip(3).for_each(|f| *f = moved(f));
    assert!(People::new(&late).identities(&cameras(&studio)).is_none());
}

#[test]
fn tracks_survive_short_gaps_and_crossing_lists() {
    let at = |x: f64| -> Person { (0..5).map(|k| [x + 10.0 * k as f64, 20.0 * k as f64, 0.9]).collect() };
    let mut frames = Frames::new();
    for k in 0..40 {
        let (a, b) = (at(100.0 + k as f64), at(400.0 - k as f64));
        let people = match k {
            10..14 => vec![b],
            _ if k % 3 == 0 => vec![b, a],
            _ => vec![a, b],
        };
        frames.insert(k, people);
    }
    let tracks = linked(&frames);
    assert_eq!(tracks.iter().map(Vec::len).collect::<Vec<_>>(), [40, 36]);
    assert!(tracks[0].windows(2).all(|w| w[0].1[0][0] > w[1].1[0][0]), "the first one goes left");
}
