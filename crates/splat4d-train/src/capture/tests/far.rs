//! Captures far from the origin, and panoramas.

use super::super::*;
use super::samples::{self, Sample};
use image::{ImageBuffer, Rgb};
use serde_json::json;
use splat4d::math::Sim3;
use splat4d::math::se3::{norm, sub};

/// Metres of a map (UTM).
const SHIFT: [f64; 3] = [4e5, 5e6, 3e2];

fn cam(c: usize) -> String {
    format!("cam{c:02}.png")
}

fn open(sample: &Sample, path: &str) -> Capture {
    Capture::open(&sample.path(path), &CaptureOptions::default()).unwrap()
}

/// How far cameras and points are from where they were without the shift.
fn apart(far: &Capture, near: &Capture) -> f64 {
    let moved = |x: [f64; 3]| sub(std::array::from_fn(|k| x[k] + far.offset[k]), SHIFT);
    let centers = |c: &Capture| c.frames.iter().map(|f| f.view.center()).collect::<Vec<_>>();
    let points = |c: &Capture| c.points.as_ref().map_or(Vec::new(), |p| p.points.clone());
    let pairs = centers(far).into_iter().zip(centers(near)).chain(points(far).into_iter().zip(points(near)));
    pairs.map(|(a, b)| norm(sub(moved(a), b))).fold(0.0, f64::max)
}

#[test]
fn maps_coordinates_become_small_and_the_offset_is_kept() {
    let moved = Sim3 { translation: SHIFT, ..Sim3::default() };
    let (near, far) = (samples::photos(9, cam, Some(&Sim3::default())), samples::photos(9, cam, Some(&moved)));
    // The file of poses next to the model, in the same world: its points are aligned before the offset is subtracted.
    far.edit("transforms.json", |v| {
        for frame in v["frames"].as_array_mut().unwrap() {
            for (row, shift) in SHIFT.iter().enumerate() {
                let x = frame["transform_matrix"][row][3].as_f64().unwrap();
                frame["transform_matrix"][row][3] = json!(x + shift);
            }
        }
    });
    for layout in ["sparse", "transforms.json"] {
        let (near, far) = (open(&near, layout), open(&far, layout));
        assert_eq!(near.offset, [0.0; 3], "{layout}: near the origin every bit stays");
        assert!(!near.notes.iter().any(|n| n.contains("offset")));
        assert!(near.points.is_some() && far.points.is_some(), "{layout}");
        assert!(apart(&far, &near) < 1e-6, "{layout}: {}", apart(&far, &near));
        assert!(far.frames.iter().all(|f| norm(f.view.center()) < 20.0), "{layout}: f32 resolves them well");
        assert!(far.notes.iter().any(|n| n.contains("far from the origin")), "{layout}: {:?}", far.notes);
        let near = |c: &Capture| c.frames[3].view.near;
        assert!(
            (near(&far) / near(&open(&samples::photos(9, cam, Some(&Sim3::default())), layout)) - 1.0).abs() < 1e-6
        );
    }
}

#[test]
fn a_run_in_world_coordinates_is_measured_there_with_a_precision_warning() {
    let far = samples::photos(9, cam, Some(&Sim3 { translation: SHIFT, ..Sim3::default() }));
    let run = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(run.path().join(name), text).unwrap();
    write("recipe.toml", &crate::recipe::Recipe::default().to_toml());
    write("run.json", &json!({"capture": crate::path_text::to_text(&far.path("sparse"))}).to_string());
    let capture = || crate::run::open_run(run.path()).unwrap().1;
    let read = capture();
    assert!(read.offset != [0.0; 3] && read.coarse().is_none(), "there is no scene yet");
    // The scenes of earlier versions have no offset.
    for offset in [[0.0; 3], read.offset, [4e5, 5e6, 0.0]] {
        let scene = splat4d::layers::Scene::<f32> { offset, ..Default::default() };
        let mut bytes = Vec::new();
        splat4d::format::scene::write(&scene, &mut bytes).unwrap();
        std::fs::write(run.path().join("scene.safetensors"), bytes).unwrap();
        let moved = capture();
        assert_eq!((moved.offset, moved.coarse().is_some()), (offset, offset == [0.0; 3]));
        for (a, b) in moved.frames.iter().zip(&read.frames) {
            let world = |c: &Camera, offset: [f64; 3]| std::array::from_fn(|k| c.center()[k] + offset[k]);
            for (a, b) in [(&a.view, &b.view), (&a.source, &b.source)] {
                assert!(norm(sub(world(a, offset), world(b, read.offset))) < 1e-6);
            }
        }
        let point = |c: &Capture| std::array::from_fn(|k| c.points.as_ref().unwrap().points[0][k] + c.offset[k]);
        assert!(norm(sub(point(&moved), point(&read))) < 1e-6);
    }
}

/// The colour of a direction.
fn sky([x, y, z]: [f64; 3]) -> [u8; 3] {
    let length = norm([x, y, z]);
    [x, y, z].map(|v| (255.0 * (0.5 + 0.5 * v / length)).round() as u8)
}

#[test]
fn panoramas_become_the_faces_of_a_cube() {
    const SIZE: [usize; 2] = [256, 128];
    let sample = samples::photos(9, cam, None);
    let picture = ImageBuffer::from_fn(SIZE[0] as u32, SIZE[1] as u32, |u, v| {
        let longitude = ((f64::from(u) + 0.5) / SIZE[0] as f64 - 0.5) * std::f64::consts::TAU;
        let latitude = ((f64::from(v) + 0.5) / SIZE[1] as f64 - 0.5) * std::f64::consts::PI;
        Rgb(sky([latitude.cos() * longitude.sin(), latitude.sin(), latitude.cos() * longitude.cos()]))
    });
    (0..9).for_each(|c| sample.save(&format!("images/{}", cam(c)), picture.clone()));
    sample.edit("transforms.json", |v| {
        ["fl_x", "fl_y", "cx", "cy"].iter().for_each(|key| drop(v.as_object_mut().unwrap().remove(*key)));
        v["camera_model"] = json!("EQUIRECTANGULAR");
        // Of images that were reduced since.
        (v["w"], v["h"]) = (json!(2 * SIZE[0]), json!(2 * SIZE[1]));
    });
    let capture = Arc::new(open(&sample, ""));
    assert_eq!((capture.frames.len(), capture.held.len(), capture.cameras.len()), (54, 12, 54));
    assert!(capture.held.iter().all(|&i| i / 6 == 0 || i / 6 == 8), "whole panoramas are held out");
    assert_eq!(capture.cameras[1].name, "cam00/right");
    assert!(capture.notes.iter().any(|n| n.contains("9 panoramas")), "{:?}", capture.notes);
    // Faces share the panorama's image, and none is without one.
    let said = |w: &String| w.contains("another pose") || w.contains("left out");
    assert!(!capture.warnings.iter().any(said), "{:?}", capture.warnings);
    let store = ImageStore::new(capture.clone(), 1 << 20);
    for face in 0..6 {
        let (view, loaded) = (&capture.frames[6 + face].view, store.load(6 + face).unwrap().to_picture());
        assert_eq!((view.width, loaded.color.width, loaded.color.height), (SIZE[0] / 4, SIZE[0] / 4, SIZE[0] / 4));
        assert!(loaded.valid.is_none(), "a panorama shows all directions");
        for (x, y) in [(32, 32), (5, 50), (60, 9)] {
            let k = &view.intrinsics;
            let ray = [(x as f64 + 0.5 - k.cx) / k.fx, (y as f64 + 0.5 - k.cy) / k.fy, 1.0];
            // Into the world by the face's pose, and back by the panorama's.
            let r = view.cam_from_world.rotation;
            let world: [f64; 3] = std::array::from_fn(|j| (0..3).map(|i| r[i][j] * ray[i]).sum());
            let wanted = sky(splat4d::math::se3::mat_vec(&samples::pose(1).rotation, world));
            for c in 0..3 {
                let own = 255.0 * loaded.color.get(c, y, x);
                assert!((own - f32::from(wanted[c])).abs() < 3.0, "face {face} at {x} {y}: {own} {wanted:?}");
            }
        }
    }
    sample.edit("transforms.json", |v| v["h"] = json!(SIZE[1]));
    let odd = Capture::open(sample.root(), &CaptureOptions::default()).unwrap_err().to_string();
    assert!(odd.contains("not twice as wide"), "{odd}");
}
