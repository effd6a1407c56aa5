//! Measured geometry in `capture.json`: its depth in training images, its points, and what is wrong with it.

use super::samples::{Sample, own, pose};
use crate::capture::{Capture, CaptureOptions, ImageStore, PointCloud};
use serde_json::{Value, json};
use splat4d::scene::Planes;
use std::sync::Arc;

/// A floor z = 0 of points at random, moved by `by`.
fn floor(by: [f64; 3]) -> PointCloud {
    let rng = splat4d::math::Rng::new(6, "floor", 0);
    let mut cloud = PointCloud::default();
    for i in 0..4000 {
        let at = [4.0 * rng.uniform(2 * i) - 2.0, 4.0 * rng.uniform(2 * i + 1) - 2.0, 0.0];
        cloud.points.push(std::array::from_fn(|k| at[k] + by[k]));
        cloud.colors.push(if i % 2 == 0 { [0.2, 0.4, 0.6] } else { [0.6, 0.4, 0.2] });
        cloud.times.push(None);
    }
    cloud
}

fn with(sample: &Sample, geometry: Value) {
    sample.edit("capture.json", |c| c["geometry"] = geometry);
}

fn open(sample: &Sample) -> Capture {
    Capture::open(sample.root(), &CaptureOptions::default()).unwrap()
}

fn error(sample: &Sample) -> String {
    Capture::open(sample.root(), &CaptureOptions::default()).unwrap_err().to_string()
}

/// Measured depth of the k-th training image.
fn measured(capture: &Capture, k: usize) -> Option<Planes<f32>> {
    let (number, mut out) = (capture.train[k], Planes::default());
    let store = ImageStore::new(Arc::new(capture.clone()), 1 << 20);
    store.load(number).unwrap().measured_into(&mut out).then_some(out)
}

/// Share of the pixels that have a depth, and the largest relative error against the floor.
fn against_floor(capture: &Capture, k: usize) -> (f64, f64) {
    let map = measured(capture, k).expect("the floor is in the image");
    let frame = &capture.frames[capture.train[k]];
    // The pose that the file states: captures may be relative to an offset.
    let view = splat4d::scene::Camera { cam_from_world: pose(frame.camera), ..frame.view.clone() };
    let (mut known, mut worst) = (0, 0.0f64);
    for (p, z) in map.data.iter().enumerate().filter(|(_, z)| **z > 0.0) {
        let at = [(p % map.width) as f64 + 0.5, (p / map.width) as f64 + 0.5];
        let (eye, far) = (view.center(), view.unproject(at, 1.0));
        let truth = eye[2] / (eye[2] - far[2]);
        (known, worst) = (known + 1, worst.max((f64::from(*z) / truth - 1.0).abs()));
    }
    (known as f64 / map.data.len() as f64, worst)
}

#[test]
fn a_scan_gives_points_and_the_depth_of_training_images() {
    let sample = own();
    sample.write("scan.ply", &floor([0.0; 3]).to_ply("comment a floor"));
    let plain = open(&sample);
    with(&sample, json!("scan.ply"));
    let capture = open(&sample);
    let own_points = plain.points.as_ref().unwrap().points.len();
    let cloud = capture.points.as_ref().unwrap();
    assert!(
        cloud.points.len() > own_points + 500 && cloud.colors.iter().any(|c| (c[1] - 0.4).abs() < 1e-6 && c[0] != 0.5)
    );
    assert!(capture.notes.iter().any(|n| n.contains("scan.ply") && n.contains("4000 points")), "{:?}", capture.notes);
    for k in 0..2 {
        let (share, worst) = against_floor(&capture, k);
        assert!(share > 0.1 && worst < 5e-3, "{share} {worst}");
    }
    assert_eq!(measured(&plain, 0), None);
    // Images that are held out are not decoded with it.
    let held = ImageStore::new(Arc::new(capture.clone()), 1 << 20).load(capture.held[0]).unwrap();
    assert!(!held.measured_into(&mut Planes::default()));
    // A transform takes the scan to the poses: it was in millimetres, with another origin.
    let mut moved = floor([1.0, 2.0, 3.0]);
    moved.points.iter_mut().flatten().for_each(|v| *v *= 1e3);
    sample.write("scan.ply", &moved.to_ply("comment a floor"));
    let rows = json!([[1e-3, 0, 0, -1], [0, 1e-3, 0, -2], [0, 0, 1e-3, -3], [0, 0, 0, 1]]);
    with(&sample, json!({"files": "scan.ply", "transform": rows}));
    assert!(against_floor(&open(&sample), 0).1 < 5e-3);
}

#[test]
fn a_scan_far_from_the_origin_keeps_its_precision() {
    let (sample, far) = (own(), [5_400_000.0, 320_000.0, 100.0]);
    sample.write("scan.ply", &floor(far).to_ply("comment a floor"));
    sample.edit("capture.json", |c| {
        c.as_object_mut().unwrap().remove("points");
        for (i, camera) in c["cameras"].as_array_mut().unwrap().iter_mut().enumerate() {
            let p = pose(i);
            let turned = splat4d::math::se3::mat_vec(&p.rotation, far);
            for k in 0..3 {
                camera["world_to_camera"][k][3] = json!(p.translation[k] - turned[k]);
            }
        }
    });
    with(&sample, json!("scan.ply"));
    let mut capture = open(&sample);
    assert_ne!(capture.offset, [0.0; 3]);
    let (share, worst) = against_floor(&capture, 0);
    assert!(share > 0.1 && worst < 5e-3, "{share} {worst}");
    // It follows the capture to another offset.
    let before = measured(&capture, 0).unwrap();
    capture.relocate([capture.offset[0] + 7.0, capture.offset[1], capture.offset[2]]);
    let after = measured(&capture, 0).unwrap();
    let off =
        before.data.iter().zip(&after.data).filter(|(a, b)| **a > 0.0 && **b > 0.0 && (*a / *b - 1.0).abs() > 1e-3);
    assert_eq!(off.count(), 0);
}

#[test]
fn scans_of_single_frames_belong_to_their_frames() {
    let sample = own();
    // Frame 0 is number 5. The second frame has no scan.
    sample.write("scans/0005.ply", &floor([0.0; 3]).to_ply("comment a floor"));
    with(&sample, json!("scans/%04d.ply"));
    let capture = open(&sample);
    let maps: Vec<bool> = (0..capture.train.len()).map(|k| measured(&capture, k).is_some()).collect();
    let first: Vec<bool> = capture.train.iter().map(|&i| capture.frames[i].index == 0).collect();
    assert_eq!(maps, first);
    sample.write("scans/0006.ply", &floor([0.0, 0.0, 0.2]).to_ply("comment a floor, later"));
    let both = open(&sample);
    assert!((0..both.train.len()).all(|k| measured(&both, k).is_some()));
    let times = &both.points.as_ref().unwrap().times;
    assert!(times.contains(&Some(both.frames[both.train[0]].time.0)), "what differs has a time");
    with(&sample, json!(["scans/0005.ply"]));
    assert!(error(&sample).contains("no file for frame 1"), "{}", error(&sample));
    with(&sample, json!({"files": "none/%04d.ply"}));
    assert!(error(&sample).contains("0005.ply") && error(&sample).contains("missing"), "{}", error(&sample));
}

#[test]
fn what_is_wrong_with_a_scan_is_an_error_that_names_it() {
    let sample = own();
    with(&sample, json!("scan.ply"));
    assert!(error(&sample).contains("scan.ply") && error(&sample).contains("geometry"), "{}", error(&sample));
    // In millimetres: no camera sees it.
    let mut large = floor([0.0; 3]);
    large.points.iter_mut().for_each(|p| p[2] = 5e3);
    sample.write("scan.ply", &large.to_ply("comment a floor"));
    let text = error(&sample);
    assert!(text.contains("transform") && text.contains("scan.ply") && text.contains("5000.0000"), "{text}");
    sample.write("scan.ply", b"LASF");
    assert!(error(&sample).contains("LAS header"), "{}", error(&sample));
    with(&sample, json!({"files": "scan.ply", "transforms": []}));
    assert!(error(&sample).contains("Did you mean \"transform\""), "{}", error(&sample));
    let flat = json!([[0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]);
    with(&sample, json!({"files": "scan.ply", "transform": flat}));
    assert!(error(&sample).contains("determinant"), "{}", error(&sample));
}
