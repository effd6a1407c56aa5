//! Known flow of a capture on disk reaches the motion.

use crate::capture::frames::{Frames, Picture};
use crate::run::tests::{Place, recipe};
use crate::run::training_frames;
use crate::step::tests::Made;
use image::{ImageBuffer, Rgb};
use serde_json::{Value, json};
use splat4d::flow::{Shot, render_flow};
use splat4d::math::se3::{dot, normalize, sub};
use splat4d::render::{RenderConfig, Renderer};
use splat4d::scene::Camera;

/// Displacement of the ball's pixel in a frame; `None`: it shows the sky.
fn way(made: &Made, camera: &Camera, p: [f64; 2], from: f64, to: f64) -> Option<[f64; 2]> {
    let (eye, center) = (camera.center(), made.object_at(from));
    let ray = normalize(sub(camera.unproject(p, 1.0), eye));
    let along = dot(sub(center, eye), ray);
    let miss = dot(sub(center, eye), sub(center, eye)) - along * along;
    let depth = along - (Made::RADIUS * Made::RADIUS - miss).max(0.0).sqrt();
    let then = made.object_at(to);
    let hit: [f64; 3] = std::array::from_fn(|k| eye[k] + depth * ray[k] + then[k] - center[k]);
    let q = camera.project(hit)?.0;
    (miss < Made::RADIUS * Made::RADIUS).then_some([q[0] - p[0], q[1] - p[1]])
}

/// Adds the flow of all cameras to the capture on disk.
fn write(place: &Place, made: &Made) {
    let capture = place.open(&recipe(&[]));
    let marker = capture.root.join("capture.json");
    let mut json: Value = serde_json::from_slice(&std::fs::read(&marker).unwrap()).unwrap();
    for (k, camera) in json["cameras"].as_array_mut().unwrap().iter_mut().enumerate() {
        camera["flow"] = json!(format!("flow/{k}/%04d.png"));
        std::fs::create_dir_all(capture.root.join(format!("flow/{k}"))).unwrap();
        for frame in 0..2 {
            let view = made.camera(k);
            let code = |v: f64| (v * 64.0 + 32768.0).round() as u16;
            let pixel = |x: u32, y: u32| {
                let p = [f64::from(x) + 0.5, f64::from(y) + 0.5];
                let [from, to] = [frame, frame + 1].map(|f| made.time_of(f));
                way(made, view, p, from, to).map_or(Rgb([0u16; 3]), |[u, v]| Rgb([code(u), code(v), 1]))
            };
            let picture = ImageBuffer::from_fn(view.width as u32, view.height as u32, pixel);
            picture.save(capture.root.join(format!("flow/{k}/{frame:04}.png"))).unwrap();
        }
    }
    std::fs::write(&marker, json.to_string()).unwrap();
}

#[test]
fn known_flow_teaches_motion() {
    let (place, made) = (Place::new(), Made::new(4, 3, 24));
    let refused = place.train("none", &recipe(&["lambda_flow=1"])).unwrap_err().to_string();
    assert!(refused.contains("loss.flow") && refused.contains("capture.json"), "{refused}");
    write(&place, &made);
    let error = |lambda: f64| {
        let r = recipe(&["strategy=none", "num_pts=200", "half_size_until=0.3", "velocity_lr_init=0.03"])
            .with(|r| r.loss.flow = lambda);
        let name = format!("{lambda}");
        place.train(&name, &r).unwrap();
        let scene = splat4d::format::scene::read(&place.scene(&name)).unwrap();
        let frames = training_frames(place.open(&r), &r).unwrap();
        let mut renderer = Renderer::new(RenderConfig::default());
        let (mut picture, mut sum, mut count) = (Picture::default(), 0.0, 0.0);
        for i in 0..frames.len() {
            frames.load(i, &mut picture).unwrap();
            let from = Shot { camera: frames.camera(i), t: frames.time(i) };
            let Some(flow) = &picture.flow else {
                assert!(frames.time(i).0 > 0.15, "only the last frame leads nowhere");
                continue;
            };
            assert!((flow.to.0 - frames.time(i).0 - 0.1).abs() < 1e-9);
            let to = Shot { camera: &flow.camera, t: flow.to };
            let drawn = render_flow(&scene, from, to, &mut renderer).vectors;
            for p in (0..flow.vectors.pixels()).filter(|&p| flow.vectors.plane(2)[p] == 1.0) {
                sum += (0..2).map(|c| f64::from((drawn.plane(c)[p] - flow.vectors.plane(c)[p]).abs())).sum::<f64>();
                count += 1.0;
            }
        }
        sum / f64::max(count, 1.0)
    };
    // With so little weight the loss is read and does nothing.
    let [little, much] = [1e-6, 3.0].map(error);
    assert!(much < 0.8 * little, "{much} px with the loss, {little} px without");
    let unread = training_frames(place.open(&recipe(&[])), &recipe(&[])).unwrap();
    let mut picture = Picture::default();
    unread.load(0, &mut picture).unwrap();
    assert!(picture.flow.is_none(), "without the loss nobody decodes it");
}

#[test]
fn computed_flow_is_cached_in_the_run() {
    let place = Place::new();
    let own = recipe(&["lambda_flow=1", "capture.flow=own"]);
    place.train("own", &own).unwrap();
    let folder = place.run("own").join("flow");
    let mark = std::fs::read(folder.join("of.txt")).unwrap();
    let opened = place.open(&own);
    let camera = opened.frames[opened.train[0]].camera;
    let picture = folder.join(format!("{camera:03}/000000.png"));
    let first = std::fs::read(&picture).unwrap();
    assert!(!folder.join(format!("{camera:03}/000002.png")).exists(), "the last frame leads nowhere");
    // As long as the mark is of the same capture the files are taken at their word.
    let frames = training_frames(place.open(&own), &own).unwrap();
    let camera = frames.camera(0);
    ImageBuffer::from_fn(camera.width as u32, camera.height as u32, |_, _| Rgb([32768u16 + 64, 32768, 1]))
        .save(&picture)
        .unwrap();
    let (_, capture) = crate::run::open_run(&place.run("own")).unwrap();
    let capture = std::sync::Arc::new(capture);
    let store = crate::capture::ImageStore::new(capture.clone(), 0);
    let flow = store.load(capture.train[0]).unwrap().to_picture().flow.unwrap();
    assert!(flow.plane(0).iter().all(|u| *u == 1.0) && flow.plane(2).iter().all(|k| *k == 1.0));
    std::fs::remove_dir_all(place.run("own").join("checkpoints")).unwrap();
    place.train("own", &own).unwrap();
    assert_ne!(std::fs::read(&picture).unwrap(), first, "it was kept");
    std::fs::write(folder.join("of.txt"), b"another capture").unwrap();
    std::fs::remove_dir_all(place.run("own").join("checkpoints")).unwrap();
    place.train("own", &own).unwrap();
    assert_eq!(std::fs::read(&picture).unwrap(), first, "it is followed anew");
    assert_eq!(std::fs::read(folder.join("of.txt")).unwrap(), mark);
}

#[test]
fn flow_that_runs_backwards_is_refused_by_file_and_frame() {
    let place = Place::new();
    let all = recipe(&["lambda_flow=1"]);
    // Images of noise, each the one before moved by three pixels to the right.
    let capture = place.open(&recipe(&[]));
    let marker = capture.root.join("capture.json");
    let mut json: Value = serde_json::from_slice(&std::fs::read(&marker).unwrap()).unwrap();
    for (k, camera) in json["cameras"].as_array_mut().unwrap().iter_mut().enumerate() {
        camera["flow"] = json!(format!("flow/{k}/%04d.png"));
        std::fs::create_dir_all(capture.root.join(format!("flow/{k}"))).unwrap();
    }
    std::fs::write(&marker, json.to_string()).unwrap();
    let write = |[u, v]: [f64; 2]| {
        for frame in &capture.frames {
            let noise = splat4d::math::Rng::new(frame.camera as u64, "noise", 0);
            let pixel = |x: u32, y: u32| {
                let at = u64::from(y) * 1000 + (u64::from(x) + 500 - 3 * frame.index as u64);
                Rgb([0, 1, 2].map(|c| (255.0 * noise.uniform(3 * at + c)) as u8))
            };
            let size = [frame.view.width as u32, frame.view.height as u32];
            ImageBuffer::from_fn(size[0], size[1], pixel).save(&frame.image).unwrap();
            let code = |v: f64| (v * 64.0 + 32768.0).round() as u16;
            let path = capture.root.join(format!("flow/{}/{:04}.png", frame.camera, frame.index));
            ImageBuffer::from_fn(size[0], size[1], |_, _| Rgb([code(u), code(v), 1])).save(path).unwrap();
        }
    };
    write([-3.0, 0.0]);
    let text = place.train("back", &all).unwrap_err().to_string();
    assert!(["reversed", "0000.png", "frame 0", "camera"].iter().all(|word| text.contains(word)), "{text}");
    write([0.0, 3.0]);
    let text = place.train("turned", &all).unwrap_err().to_string();
    assert!(["u and v", "0000.png", "frame 0"].iter().all(|word| text.contains(word)), "{text}");
}
