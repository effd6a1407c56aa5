//! Depth maps of a capture on disk reach the scene, and are held against it.

use crate::capture::PointCloud;
use crate::capture::frames::Frames;
use crate::event::Event;
use crate::init::Source;
use crate::run::tests::{Place, recipe};
use crate::run::{TrainOptions, train};
use crate::step::tests::Made;
use image::{ImageBuffer, Luma};
use serde_json::{Value, json};
use splat4d::math::Rng;
use splat4d::math::se3::{dot, normalize, sub};
use std::sync::atomic::AtomicBool;

/// Codes a scene unit.
const CODES: f64 = 4096.0;

/// Adds the depth of the ball to the capture on disk, as maps that are `scale` times too large.
fn write(place: &Place, made: &Made, scale: f64) {
    let capture = place.open(&recipe(&[]));
    let marker = capture.root.join("capture.json");
    let mut json: Value = serde_json::from_slice(&std::fs::read(&marker).unwrap()).unwrap();
    for (k, camera) in json["cameras"].as_array_mut().unwrap().iter_mut().enumerate() {
        camera["depth"] = json!(format!("depth/{k}/%04d.png"));
        camera["depth_scale"] = json!(scale / CODES);
        std::fs::create_dir_all(capture.root.join(format!("depth/{k}"))).unwrap();
        for frame in 0..3 {
            let (view, center) = (made.camera(k), made.object_at(made.time_of(frame)));
            let eye = view.center();
            let pixel = |x: u32, y: u32| {
                let ray = normalize(sub(view.unproject([f64::from(x) + 0.5, f64::from(y) + 0.5], 1.0), eye));
                let along = dot(sub(center, eye), ray);
                let hit = Made::RADIUS * Made::RADIUS - (dot(sub(center, eye), sub(center, eye)) - along * along);
                let z = (along - hit.max(0.0).sqrt()) * dot(ray, view.forward());
                Luma([if hit > 0.0 { (z * CODES).round() as u16 } else { 0 }])
            };
            let picture = ImageBuffer::from_fn(view.width as u32, view.height as u32, pixel);
            picture.save(capture.root.join(format!("depth/{k}/{frame:04}.png"))).unwrap();
        }
    }
    std::fs::write(&marker, json.to_string()).unwrap();
}

#[test]
fn a_map_that_the_images_contradict_is_reported() {
    let (place, made) = (Place::new(), Made::new(4, 3, 24));
    // Gaussians begin on the ball, so that so short a run has its depth.
    let mut cloud = PointCloud::default();
    for k in 0..600 {
        let (time, rng) = (made.time_of(k % 3), Rng::new(5, "ball", k as u64));
        let (center, way) = (made.object_at(time), normalize([0, 1, 2].map(|c| rng.normal(c))));
        cloud.points.push([0, 1, 2].map(|c| center[c] + Made::RADIUS * way[c]));
        cloud.colors.push([0.5; 3]);
        cloud.times.push(Some(time));
    }
    let points = place.run("ball.ply");
    std::fs::write(&points, cloud.to_ply("comment a ball")).unwrap();
    let warnings = |name: &str, scale: f64| {
        write(&place, &made, scale);
        let r = recipe(&["strategy=none", "loss.depth=0.01", "iterations=120"])
            .with(|r| r.init.source = Source::File(points.clone()));
        let mut told = Vec::new();
        let mut listen = |event: &Event| {
            if let Event::Warning { message } = event {
                told.push(message.clone());
            }
        };
        let options = TrainOptions::default();
        train(place.open(&r), r.clone(), &place.run(name), &options, &AtomicBool::new(false), &mut listen).unwrap();
        told.into_iter().filter(|m| m.contains("depth maps")).collect::<Vec<_>>()
    };
    let wrong = warnings("wrong", 2.0);
    assert!(wrong.len() == 1 && wrong[0].contains("contradicts") && wrong[0].contains("frame"), "{wrong:?}");
    let ratio = wrong[0].split("it renders ").nth(1).and_then(|s| s.split(' ').next()).unwrap().parse::<f64>().unwrap();
    assert!((0.4..0.6).contains(&ratio), "{wrong:?}");
    assert_eq!(warnings("right", 1.0), Vec::<String>::new());
}
