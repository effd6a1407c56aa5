//! `import` of four cameras at right angles whose images show nothing in common but people.

use super::super::{Request, import};
use super::{BATCH, Detector, Keypoints};
use crate::clicks::Frames;
use crate::clicks::tests::{FRAME, Scene, Studio};
use serde_json::{Value, json};
use splat4d::ErrorKind;
use splat4d::math::Se3;
use splat4d::math::align::apart;
use splat4d_train::capture::{Capture, CaptureOptions, Rgb8};
use splat4d_train::event::Progress;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

const NAMES: [&str; 4] = ["east", "north", "south", "west"];
/// The studio's images are 1920x1080. Videos are smaller, and stored images smaller again.
const VIDEO: [u32; 2] = [640, 360];
const STORED: usize = 270;

/// A folder of images of each camera: plain, each camera's brightness another.
fn filmed(to: &Path, frames: usize) {
    for (c, name) in NAMES.iter().enumerate() {
        let folder = to.join(name);
        std::fs::create_dir_all(&folder).unwrap();
        let plain = image::RgbImage::from_pixel(VIDEO[0], VIDEO[1], image::Rgb([60 + 40 * c as u8; 3]));
        plain.save(folder.join("0000.jpg")).unwrap();
        for k in 1..frames {
            std::fs::copy(folder.join("0000.jpg"), folder.join(format!("{k:04}.jpg"))).unwrap();
        }
    }
}

/// A list of results of a camera, as detectors write it for the videos' pixels; the first pixel's centre is at 0.
fn results(frames: &Frames) -> Value {
    let by = f64::from(VIDEO[0]) / 1920.0;
    let person = |k: usize, person: &Vec<[f64; 3]>| {
        let numbers: Vec<f64> = person.iter().flat_map(|p| [p[0] * by - 0.5, p[1] * by - 0.5, p[2]]).collect();
        json!({"image_id": k, "category_id": 1, "keypoints": numbers})
    };
    frames.iter().flat_map(|(&k, people)| people.iter().map(move |p| person(k, p))).collect()
}

fn imported(request: &Request) -> crate::Result<super::Report> {
    import(request, &mut Progress(&mut |_| ()), &|| false)
}

/// Poses of an imported capture are those of the studio.
fn agrees(found: &Capture, studio: &Studio) {
    let camera = |name: &&str| &found.frames.iter().find(|f| found.cameras[f.camera].name == **name).unwrap().view;
    let poses: Vec<Se3> = NAMES.iter().map(|name| camera(name).cam_from_world).collect();
    for (off, name) in apart(&poses, &studio.poses).unwrap().iter().zip(NAMES) {
        assert!(off.degrees < 2.0 && off.center < 0.04, "{name}: {off:?}");
    }
}

#[test]
fn keypoints_of_two_people_place_and_synchronise_four_cameras() {
    let studio = Studio::new(3);
    let (first, second) = ([0.1, 0.0], [-0.4, 0.5]);
    let order = |c: usize| if c.is_multiple_of(2) { vec![first, second] } else { vec![second, first] };
    let detections = Scene::of(std::array::from_fn(order)).detections(&studio, 3.0);
    let dir = tempfile::tempdir().unwrap();
    let [films, keypoints, take] = ["films", "keypoints", "take"].map(|name| dir.path().join(name));
    filmed(&films, detections[0].len());
    std::fs::create_dir(&keypoints).unwrap();
    for (name, frames) in NAMES.iter().zip(&detections) {
        std::fs::write(keypoints.join(format!("{name}.json")), results(frames).to_string()).unwrap();
    }
    let mut request = Request::new(vec![films], take.clone());
    (request.sound, request.keypoints, request.selection.size) =
        (false, Some(Keypoints::Given(keypoints)), Some(STORED));
    let report = imported(&request).unwrap();
    assert!(report.guesses.iter().any(|g| g.contains("keypoints of 2 people")), "{:?}", report.guesses);

    let found = Capture::open(&take, &CaptureOptions::default()).unwrap();
    let camera = |name: &&str| &found.frames.iter().find(|f| found.cameras[f.camera].name == **name).unwrap().view;
    agrees(&found, &studio);
    for (c, name) in NAMES.iter().enumerate() {
        let focal = studio.lenses[c].focal * STORED as f64 / 1080.0;
        assert!(
            (camera(name).intrinsics.fx / focal - 1.0).abs() < 0.1,
            "{name}: {} of {focal}",
            camera(name).intrinsics.fx
        );
        let offset = |k: usize| report.cameras[k].offset.unwrap() - studio.offsets[k];
        assert!((offset(c) - offset(0)).abs() < 0.5 * FRAME, "{name}: {} s", offset(c) - offset(0));
    }

    request.calibration = Some(take.join("capture.json"));
    let twice = imported(&request).unwrap_err().to_string();
    assert!(twice.contains("by a calibration and by keypoints of people"), "{twice}");
}

/// A detector that recognises cameras by their brightness, and gets their frames in order.
struct Eyes {
    detections: Vec<Frames>,
    next: Mutex<[usize; 4]>,
    calls: AtomicUsize,
}

impl Detector for Eyes {
    fn identity(&self) -> &str {
        "eyes"
    }

    fn people(&self, image: &Rgb8) -> crate::Result<Vec<Vec<[f64; 3]>>> {
        self.calls.fetch_add(1, Ordering::SeqCst);
        let camera = (usize::from(image.data[0]).saturating_sub(50)) / 40;
        let mut next = self.next.lock().unwrap();
        let people = &self.detections[camera][&next[camera]];
        next[camera] += 1;
        let by = image.height as f64 / 1080.0;
        Ok(people.iter().map(|person| person.iter().map(|p| [p[0] * by, p[1] * by, p[2]]).collect()).collect())
    }
}

#[test]
fn a_detector_calibrates_cameras_and_what_it_found_is_kept() {
    let studio = Studio::new(3);
    let walker = [0.1, 0.0];
    let detections = Scene::of(std::array::from_fn(|_| vec![walker, [-0.4, 0.5]])).detections(&studio, 3.0);
    let frames = detections[0].len();
    let dir = tempfile::tempdir().unwrap();
    let [films, take] = ["films", "take"].map(|name| dir.path().join(name));
    filmed(&films, frames);
    let eyes = Arc::new(Eyes { detections, next: Mutex::default(), calls: AtomicUsize::new(0) });
    let mut request = Request::new(vec![films], take.clone());
    (request.sound, request.selection.size) = (false, Some(STORED));
    request.keypoints = Some(Keypoints::By(eyes.clone()));
    // Stopped in the second batch of the first camera.
    let stop = || eyes.calls.load(Ordering::SeqCst) == BATCH + 3;
    let stopped = import(&request, &mut Progress(&mut |_| ()), &stop).unwrap_err();
    assert_eq!(stopped.kind(), ErrorKind::Interrupted);
    *eyes.next.lock().unwrap() = [BATCH, 0, 0, 0];
    eyes.calls.store(0, Ordering::SeqCst);
    let report = imported(&request).unwrap();
    assert_eq!(eyes.calls.load(Ordering::SeqCst), 4 * frames - BATCH, "the first batch is kept");
    assert!(report.guesses.iter().any(|g| g.contains("keypoints of 2 people")), "{:?}", report.guesses);
    agrees(&Capture::open(&take, &CaptureOptions::default()).unwrap(), &studio);
}
