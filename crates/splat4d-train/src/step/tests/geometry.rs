//! A scan of a capture on disk reaches the scene, and is held against it.

use crate::capture::PointCloud;
use crate::event::Event;
use crate::init::Source;
use crate::run::tests::{Place, recipe};
use crate::run::{TrainOptions, train};
use crate::step::tests::Made;
use serde_json::{Value, json};
use splat4d::math::Rng;
use splat4d::math::se3::normalize;
use std::sync::atomic::AtomicBool;

/// Noise of the scans, scene units: 5 mm.
const NOISE: f64 = 0.005;

/// Scans of the ball at every frame, with noise and a hole, moved by `by`.
fn write(place: &Place, made: &Made, by: [f64; 3]) {
    let root = place.open(&recipe(&[])).root.clone();
    std::fs::create_dir_all(root.join("scans")).unwrap();
    for frame in 0..3 {
        let (center, rng) = (made.object_at(made.time_of(frame)), Rng::new(7, "scan", frame as u64));
        let mut cloud = PointCloud::default();
        for k in 0..3000u64 {
            let way = normalize([0, 1, 2].map(|c| rng.normal(4 * k + c)));
            if way[1] > 0.8 {
                continue;
            }
            let radius = Made::RADIUS + NOISE * rng.normal(4 * k + 3);
            cloud.points.push([0, 1, 2].map(|c| center[c] + radius * way[c] + by[c]));
            cloud.colors.push([0.5; 3]);
            cloud.times.push(None);
        }
        std::fs::write(root.join(format!("scans/{frame}.ply")), cloud.to_ply("comment a scan")).unwrap();
    }
    let marker = root.join("capture.json");
    let mut json: Value = serde_json::from_slice(&std::fs::read(&marker).unwrap()).unwrap();
    json["geometry"] = json!("scans/%d.ply");
    std::fs::write(&marker, json.to_string()).unwrap();
}

#[test]
fn a_scan_of_every_frame_is_met_and_one_elsewhere_is_reported() {
    let (place, made) = (Place::new(), Made::new(4, 3, 24));
    let trained = |name: &str, by: [f64; 3], sets: &[&str], source: Source| {
        write(&place, &made, by);
        let r = recipe(&[&["strategy=none", "iterations=120"], sets].concat()).with(|r| r.init.source = source);
        let (mut found, mut told) = (None, Vec::new());
        let mut listen = |event: &Event| match event {
            Event::Geometry { measured, error, worst_error, .. } => found = Some((*measured, *error, *worst_error)),
            Event::Warning { message } => told.push(message.clone()),
            _ => {}
        };
        let (run, options) = (place.run(name), TrainOptions::default());
        train(place.open(&r), r.clone(), &run, &options, &AtomicBool::new(false), &mut listen).unwrap();
        told.retain(|m| m.contains("measured geometry"));
        let text = std::fs::read_to_string(run.join("geometry.json")).ok();
        (found, told, text.map(|t| serde_json::from_str::<Value>(&t).unwrap()))
    };
    // The capture has no points of its own: those of the scans are where the ball is, at each time.
    let (found, told, file) = trained("right", [0.0; 3], &["num_pts=600", "max_cap=1500"], Source::Points);
    let (measured, error, _) = found.expect("the capture has geometry");
    assert!((0.01..0.3).contains(&measured) && error.is_some_and(|e| e < 0.03), "{measured} {error:?}");
    assert_eq!(told, Vec::<String>::new());
    let file = file.expect("a file with the cameras");
    assert!(file["cameras"].as_array().is_some_and(|c| c.len() == 3 && c[0]["measured"].is_f64()), "{file}");
    // The images put the ball where it is, whatever a scan with little weight states.
    let ball = place.run("ball.ply");
    let mut cloud = PointCloud::default();
    for k in 0..600 {
        let (time, rng) = (made.time_of(k % 3), Rng::new(5, "ball", k as u64));
        let (center, way) = (made.object_at(time), normalize([0, 1, 2].map(|c| rng.normal(c))));
        cloud.points.push([0, 1, 2].map(|c| center[c] + Made::RADIUS * way[c]));
        cloud.colors.push([0.5; 3]);
        cloud.times.push(Some(time));
    }
    std::fs::write(&ball, cloud.to_ply("comment a ball")).unwrap();
    let sets = ["loss.geometry=0.001"];
    let (found, told, _) = trained("wrong", [0.6, 0.0, 0.6], &sets, Source::File(ball.clone()));
    assert!(found.is_some_and(|f| f.2.is_some_and(|e| e > 0.1)), "{found:?}");
    assert!(told.len() == 1 && told[0].contains("disagree") && told[0].contains("transform"), "{told:?}");
    let (found, _, file) = trained("off", [0.0; 3], &["loss.geometry=0"], Source::File(ball));
    assert!(found.is_none() && file.is_none(), "a scan without a weight is not compared");
}
