//! Poses in every convention, with and without points: named, and right ones not.

use super::super::tests::samples::Sample;
use super::super::{CaptureKind, CaptureOptions, Convention, DepthFile, DepthKind};
use super::*;
use image::{ImageBuffer, Rgb, Rgba};
use serde_json::json;
use splat4d::math::se3::{add, dot, mat_mul, norm, scale, sub, transpose};
use splat4d::scene::{Camera, Lens};
use std::sync::OnceLock;

mod silent;

const WIDTH: u32 = 160;
const HEIGHT: u32 = 120;
const FOCAL: f64 = 140.0;
/// Cameras, and degrees between them.
const CAMERAS: usize = 12;
const STEP: f64 = 9.0;

/// Noise from 0 to 1 that is smooth over a unit.
fn noise(p: [f64; 3], salt: u64) -> f64 {
    let lattice = |c: [i64; 3]| {
        let mut h = salt.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        for v in c {
            h = (h ^ v as u64).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            h ^= h >> 29;
        }
        (h >> 40) as f64 / (1u64 << 24) as f64
    };
    let base = p.map(f64::floor);
    let part: [f64; 3] = std::array::from_fn(|k| p[k] - base[k]);
    let mut out = 0.0;
    for corner in 0..8 {
        let bit: [usize; 3] = std::array::from_fn(|k| corner >> k & 1);
        let weight: f64 = (0..3).map(|k| if bit[k] == 1 { part[k] } else { 1.0 - part[k] }).product();
        out += weight * lattice(std::array::from_fn(|k| base[k] as i64 + bit[k] as i64));
    }
    out
}

fn texture(p: [f64; 3]) -> [f32; 3] {
    std::array::from_fn(|c| (0.6 * noise(scale(p, 4.0), c as u64) + 0.4 * noise(scale(p, 11.0), 9 + c as u64)) as f32)
}

/// What a ray shows: a ball on a floor; and whether it is the ball.
fn hit(center: [f64; 3], ray: [f64; 3]) -> Option<([f64; 3], bool)> {
    let (a, b, c) = (dot(ray, ray), dot(center, ray), dot(center, center) - 1.0);
    let root = b * b - a * c;
    if root > 0.0 && -b > root.sqrt() {
        return Some((add(center, scale(ray, (-b - root.sqrt()) / a)), true));
    }
    let t = (-1.0 - center[2]) / ray[2];
    (t > 0.0).then(|| (add(center, scale(ray, t)), false))
}

fn pose(i: usize) -> Se3 {
    let angle = (i as f64 * STEP).to_radians();
    let up_and_down = 1.2 + 0.35 * (i % 3) as f64;
    Se3::look_at([4.0 * angle.cos(), 4.0 * angle.sin(), up_and_down], [0.1, 0.0, -0.2], [0.05, 0.0, 1.0])
}

/// The point of a pixel.
fn shown(i: usize, x: u32, y: u32) -> Option<([f64; 3], bool)> {
    let back = pose(i).inverse();
    let at = [(f64::from(x) + 0.5 - 80.0) / FOCAL, (f64::from(y) + 0.5 - 60.0) / FOCAL, 1.0];
    hit(back.translation, sub(back.apply(at), back.translation))
}

/// Photos of the scene, with initial points or without: rendered once.
fn photos(points: bool) -> Capture {
    static MADE: OnceLock<(Sample, Capture)> = OnceLock::new();
    let (_, made) = MADE.get_or_init(|| capture(true, false, CAMERAS));
    Capture { points: made.points.clone().filter(|_| points), ..made.clone() }
}

/// Photos of the scene in a transforms.json; `cut`: the ball alone, with alpha.
fn capture(points: bool, cut: bool, cameras: usize) -> (Sample, Capture) {
    let sample = Sample::new(&["transforms.json"]);
    let mut frames = Vec::new();
    let mut ply = String::new();
    let mut count = 0;
    for i in 0..cameras {
        let byte = |v: f32| (v * 255.0).round() as u8;
        let color = |x: u32, y: u32| shown(i, x, y).map_or([90, 120, 200], |(p, _)| texture(p).map(byte));
        let name = format!("images/cam{i:02}.png");
        if cut {
            let pixel = |x: u32, y: u32| {
                let [r, g, b] = color(x, y);
                Rgba([r, g, b, if shown(i, x, y).is_some_and(|(_, ball)| ball) { 255 } else { 0 }])
            };
            sample.save(&name, ImageBuffer::from_fn(WIDTH, HEIGHT, pixel));
        } else {
            sample.save(&name, ImageBuffer::from_fn(WIDTH, HEIGHT, |x, y| Rgb(color(x, y))));
        }
        for k in (0..WIDTH * HEIGHT).step_by(997).filter(|_| points) {
            if let Some((p, _)) = shown(i, k % WIDTH, k / WIDTH) {
                let [r, g, b] = color(k % WIDTH, k / WIDTH);
                ply += &format!("{} {} {} {r} {g} {b}\n", p[0], p[1], p[2]);
                count += 1;
            }
        }
        let world_from_cam = pose(i).inverse();
        let row = |k: usize| {
            let r = world_from_cam.rotation[k];
            json!([r[0], -r[1], -r[2], world_from_cam.translation[k]])
        };
        frames.push(json!({"file_path": name, "transform_matrix": [row(0), row(1), row(2), [0, 0, 0, 1]]}));
    }
    let mut top = json!({"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": 80, "cy": 60, "frames": frames});
    if points {
        top["ply_file_path"] = json!("points.ply");
        let header = "property float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\n\
                      property uchar blue\nend_header\n";
        let text = format!("ply\nformat ascii 1.0\nelement vertex {count}\n{header}{ply}");
        sample.write("points.ply", text.as_bytes());
    }
    sample.write("transforms.json", top.to_string().as_bytes());
    let capture = Capture::open(sample.root(), &CaptureOptions::default()).unwrap();
    assert_eq!((capture.kind, capture.frames.len()), (CaptureKind::Nerfstudio, cameras));
    (sample, capture)
}

/// How far relative poses are from those of the truth: what no convention of the whole world changes.
fn apart(poses: &[Se3]) -> f64 {
    let relative = |p: &[Se3], i: usize| p[i].after(&p[0].inverse());
    let truth: Vec<Se3> = (0..poses.len()).map(pose).collect();
    let one = |i: usize| {
        let (a, b) = (relative(poses, i), relative(&truth, i));
        let turn = mat_mul(&a.rotation, &transpose(&b.rotation));
        norm(sub(a.translation, b.translation)) + (3.0 - turn[0][0] - turn[1][1] - turn[2][2]).abs()
    };
    (0..poses.len()).map(one).fold(0.0, f64::max)
}

/// The capture as if its files were of another layout and written as `poses` specify.
fn misread(capture: &Capture, stated: Convention, poses: Poses) -> Capture {
    let mut out = Capture { convention: stated, ..capture.clone() };
    for (i, frame) in out.frames.iter_mut().enumerate() {
        frame.source.cam_from_world = stated.misread(&pose(i), poses);
    }
    out
}

/// The verdict by these images and all points.
fn judged(capture: &Capture, images: &mut [SmallImage], matches: &mut Option<Vec<pairs::Match>>) -> PoseCheck {
    capture.judge(&points::frames(capture), images, matches)
}

/// Conventions that are named right, of how many, and how many are named that are right.
fn named(capture: &Capture, conventions: &[Convention]) -> (usize, usize) {
    let mut images = look::take(capture, &capture.looked_at(CAMERAS), look::COARSE);
    let mut matches = None;
    let (mut right, mut all) = (0, 0);
    for &stated in conventions {
        let good = judged(&misread(capture, stated, Poses::STATED), &mut images, &mut matches);
        assert_eq!(good.written_as, None, "{stated:?}: {}", good.finding.what);
        assert_eq!(good.finding.severity, Severity::Note);
        assert!(good.finding.what.contains("agree"), "{}", good.finding.what);
        for poses in stated.others() {
            let wrong = misread(capture, stated, poses);
            let before: Vec<Se3> = wrong.frames.iter().map(|f| f.source.cam_from_world).collect();
            let moved = capture.points.is_some() || apart(&before) > 1e-3;
            if !moved {
                continue;
            }
            all += 1;
            let verdict = judged(&wrong, &mut images, &mut matches);
            let Some(found) = verdict.written_as else {
                eprintln!("{stated:?} {poses}: {}", verdict.finding.what);
                continue;
            };
            let after: Vec<Se3> = before.iter().map(|p| stated.reread(p, found).unwrap()).collect();
            if apart(&after) < 1e-6 {
                right += 1;
                assert!(verdict.finding.remedy.contains(&format!("--poses {found}")));
            } else {
                eprintln!("{stated:?} {poses} taken for {found}: {}", verdict.finding.what);
            }
        }
    }
    (right, all)
}

/// A film of the scene by one camera that moves; `speed`: the ball turns by this many radians from frame to frame.
fn film(speed: f64) -> (Sample, Capture) {
    const FRAMES: usize = 13;
    let sample = Sample::new(&["transforms.json"]);
    let pose = |i: usize| {
        let angle = (4.0 * i as f64).to_radians();
        Se3::look_at([4.0 * angle.cos(), 4.0 * angle.sin(), 1.5], [0.1, 0.0, -0.2], [0.0, 0.0, 1.0])
    };
    let mut frames = Vec::new();
    for i in 0..FRAMES {
        let back = pose(i).inverse();
        let (sin, cos) = (speed * i as f64).sin_cos();
        let color = |x: u32, y: u32| {
            let at = [(f64::from(x) + 0.5 - 80.0) / FOCAL, (f64::from(y) + 0.5 - 60.0) / FOCAL, 1.0];
            let Some((p, ball)) = hit(back.translation, sub(back.apply(at), back.translation)) else {
                return Rgb([90, 120, 200]);
            };
            let turned = [cos * p[0] - sin * p[2], p[1], sin * p[0] + cos * p[2]];
            Rgb(texture(if ball { turned } else { p }).map(|v| (v * 255.0).round() as u8))
        };
        let name = format!("images/f{i:02}.png");
        sample.save(&name, ImageBuffer::from_fn(WIDTH, HEIGHT, color));
        let row = |k: usize| {
            let r = back.rotation[k];
            json!([r[0], -r[1], -r[2], back.translation[k]])
        };
        let time = i as f64 / 10.0;
        let matrix = [row(0), row(1), row(2), json!([0, 0, 0, 1])];
        frames.push(json!({"file_path": name, "transform_matrix": matrix, "time": time}));
    }
    let top = json!({"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": 80, "cy": 60, "frames": frames});
    sample.write("transforms.json", top.to_string().as_bytes());
    let capture = Capture::open(sample.root(), &CaptureOptions::default()).unwrap();
    (sample, capture)
}

#[test]
fn motion_in_front_of_a_moving_camera_is_detected() {
    let (_folder, still) = film(0.0);
    let found = still.agreement().expect("the scene is full of features");
    assert!(found.is_static() && found.share > 0.99, "{found:?}");
    let (_folder, moving) = film(0.12);
    let found = moving.agreement().expect("the floor is full of features");
    assert!(!found.is_static() && found.share < 0.98, "{found:?}");
    assert_eq!(photos(true).agreement(), None, "one moment");
}

const ALL: [Convention; 3] = [Convention::NERF, Convention::COLMAP, Convention::OPENCV];

#[test]
fn conventions_are_named_by_points() {
    let capture = photos(true);
    let (right, all) = named(&capture, &ALL);
    assert!(all >= 20 && right == all, "{right} of {all}");
}

#[test]
fn conventions_are_named_by_features() {
    let capture = photos(false);
    let (right, all) = named(&capture, &ALL);
    assert!(all >= 20 && right == all, "{right} of {all}");
}

#[test]
fn conventions_are_named_by_foregrounds() {
    let (_sample, mut capture) = capture(false, true, CAMERAS);
    // What is seen of the ball alone by cameras far apart has no features in common.
    capture.train.retain(|i| i % 2 == 1);
    let mut images = look::take(&capture, &capture.looked_at(CAMERAS), look::COARSE);
    let flipped: Poses = "opencv".parse().unwrap();
    let wrong = misread(&capture, Convention::NERF, flipped);
    assert_eq!(judged(&wrong, &mut images, &mut Some(Vec::new())).written_as, Some(flipped));
    let right = judged(&misread(&capture, Convention::NERF, Poses::STATED), &mut images, &mut Some(Vec::new()));
    assert!(right.written_as.is_none() && right.finding.what.contains("foregrounds"), "{}", right.finding.what);
}

#[test]
fn a_fixed_camera_is_no_evidence_for_its_pose() {
    let capture = photos(false);
    let mut images = look::take(&capture, &[0, 1, 1], look::COARSE);
    look::describe(&mut images, look::COARSE);
    let matches = pairs::matches(&images);
    assert!(matches.len() > 20 && matches.iter().all(|m| m.images()[0] == 0), "features agree with themselves");
}

#[test]
fn points_of_another_world_are_no_evidence_of_health() {
    let mut capture = photos(true);
    // Far below all cameras.
    capture.points.as_mut().unwrap().points.iter_mut().for_each(|p| p[2] -= 1e4);
    let check = capture.check_poses();
    assert_eq!((check.written_as, check.finding.severity), (None, Severity::Warning));
    assert!(check.finding.what.contains("points and poses do not fit"), "{}", check.finding.what);
}

#[test]
fn points_without_colours_raise_no_alarm() {
    let mut capture = photos(true);
    capture.points.as_mut().unwrap().colors.iter_mut().for_each(|c| *c = [0.5; 3]);
    assert_eq!(warned(&capture), [""; 0]);
}

#[test]
fn weak_evidence_is_not_checked() {
    let mut capture = photos(false);
    capture.train.truncate(1);
    let check = capture.check_poses();
    assert_eq!((check.written_as, check.finding.aspect), (None, Some(Aspect::NotChecked)));
}

#[test]
fn exchanged_images_do_not_fit_their_points() {
    let mut capture = photos(true);
    let images: Vec<_> = capture.frames.iter().map(|f| f.image.clone()).collect();
    let count = images.len();
    capture.frames.iter_mut().enumerate().for_each(|(i, f)| f.image.clone_from(&images[(5 * i + 3) % count]));
    let check = capture.check_poses();
    assert_eq!((check.written_as, check.finding.severity), (None, Severity::Warning), "{}", check.finding.what);
    assert!(check.finding.what.contains("Initial points and images do not fit"), "{}", check.finding.what);
}

#[test]
fn a_camera_that_sees_no_point_is_named() {
    let mut capture = photos(true);
    assert!(capture.check_points().is_empty());
    let frame = capture.train[4];
    capture.frames[frame].source.cam_from_world.translation[0] += 1e3;
    let found = capture.check_points();
    let name = capture.frames[frame].image.display().to_string();
    assert!(
        found.len() == 1 && found[0].what.contains("1 images see none") && found[0].what.contains(&name),
        "{found:?}"
    );
}

#[test]
fn depth_maps_in_another_unit_are_named() {
    let mut capture = photos(true);
    let folder = tempfile::tempdir().unwrap();
    for i in capture.train.clone() {
        let z = |x: u32, y: u32| shown(i, x, y).map_or(0.0, |(p, _)| pose(i).apply(p)[2]);
        let map = ImageBuffer::from_fn(WIDTH, HEIGHT, |x, y| image::Luma([(1e3 * z(x, y)).round() as u16]));
        let path = folder.path().join(format!("{i}.png"));
        map.save(&path).unwrap();
        capture.frames[i].depth = Some(DepthFile { path, scale: 1e-3, kind: DepthKind::Metric, fit: None });
    }
    assert!(capture.check_points().is_empty(), "millimetres");
    for frame in &mut capture.frames {
        frame.depth.as_mut().into_iter().for_each(|d| d.scale = 1.0);
    }
    let found = capture.check_points();
    assert!(found.len() == 1 && found[0].what.contains("initial points do not fit: these are 1.000e-3"), "{found:?}");
    // Disparities grow where depths fall.
    let write = |i: usize, of: &dyn Fn(f64) -> f64| {
        let z = |x: u32, y: u32| shown(i, x, y).map_or(0.0, |(p, _)| of(pose(i).apply(p)[2]));
        let map = ImageBuffer::from_fn(WIDTH, HEIGHT, |x, y| image::Luma([z(x, y).round() as u16]));
        map.save(folder.path().join(format!("{i}.png"))).unwrap();
    };
    capture.train.iter().for_each(|&i| write(i, &|z| 9e3 / z));
    let found = capture.check_points();
    assert!(found.len() == 1 && found[0].what.contains("inverse depths") && found[0].remedy.contains("depth_kind"));
    capture.train.iter().for_each(|&i| write(i, &|z| 1e3 * z));
    // Without points, maps of other views give the same result.
    let points = capture.points.take();
    let found = capture.check_points();
    assert!(found.len() == 1 && found[0].what.contains("depth maps of other views do not fit"), "{found:?}");
    assert!(found[0].what.contains("probably 1.000e-3 scene units"), "{found:?}");
    capture.frames.iter_mut().filter_map(|f| f.depth.as_mut()).for_each(|d| d.scale = 1e-3);
    assert!(capture.check_points().is_empty(), "millimetres");
    // Lengths in 255 steps are refused by training.
    capture.points = points;
    let path = capture.frames[capture.train[0]].depth.as_ref().unwrap().path.clone();
    ImageBuffer::from_fn(WIDTH, HEIGHT, |x, _| image::Luma([x as u8])).save(path).unwrap();
    let found = capture.check_points();
    assert!(found.len() == 1 && found[0].what.contains("8 bits"), "{found:?}");
}

/// What images show about single poses, focal lengths and masks: warnings.
fn warned(capture: &Capture) -> Vec<String> {
    let check = capture.check_poses();
    let all = check.more.into_iter().chain([check.finding]);
    all.filter(|f| f.severity == Severity::Warning).map(|f| f.what).collect()
}

#[test]
fn one_wrong_pose_among_right_ones_is_named() {
    let axes = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]];
    let identity = Se3 { rotation: axes, translation: [0.0; 3] };
    let away = Se3::look_at([1.0, 3.5, 1.0], [9.0, 9.0, 2.0], [0.0, 0.0, 1.0]);
    for (wrong, sign) in [(identity, "is the identity"), (pose(9), "exactly this pose"), (away, "")] {
        for points in [true, false] {
            let mut capture = photos(points);
            assert_eq!(warned(&capture), [""; 0]);
            let frame = capture.train[3];
            capture.frames[frame].source.cam_from_world = wrong;
            let found = warned(&capture);
            let name = capture.frames[frame].image.display().to_string();
            let said = found
                .iter()
                .any(|w| w.contains("pose of 1 image is probably wrong") && w.contains(&name) && w.contains(sign));
            assert!(said, "{sign} {points}: {found:?}");
        }
    }
}

#[test]
fn an_identity_pose_that_cannot_be_compared_is_not_checked() {
    let mut capture = photos(false);
    // Two images far apart have no features in common.
    capture.held = Vec::new();
    capture.frames = vec![capture.frames[0].clone(), capture.frames[11].clone()];
    capture.train = vec![0, 1];
    capture.cameras.truncate(2);
    capture.frames[1].camera = capture.frames[1].camera.min(1);
    capture.frames[1].source.cam_from_world = Se3::IDENTITY;
    let check = capture.check_poses();
    let said = |f: &Finding| f.aspect == Some(Aspect::NotChecked) && f.what.contains("identity is the pose of 1 of 2");
    assert!(check.more.iter().any(said), "{check:?}");
    // Nor is any other pose of them.
    capture.frames[1].source.cam_from_world = pose(5);
    let check = capture.check_poses();
    let said =
        |f: &Finding| f.aspect == Some(Aspect::NotChecked) && f.what.contains("nor matches with the images around");
    assert!(check.more.iter().any(said), "{check:?}");
}

/// Poses that no convention explains, of images that match well.
#[test]
fn poses_that_matches_contradict_are_named() {
    let mut capture = photos(false);
    let spin = |k: usize| {
        Se3::look_at([0.0; 3], [(5 * k) as f64, (k * k % 7) as f64 - 3.0, 1.0 + (k % 3) as f64], [0.0, 0.0, 1.0])
    };
    for (k, frame) in capture.frames.iter_mut().enumerate() {
        frame.source.cam_from_world = spin(k).after(&frame.source.cam_from_world);
    }
    let check = capture.check_poses();
    assert_eq!((check.written_as, check.finding.severity), (None, Severity::Warning), "{}", check.finding.what);
    assert!(check.finding.what.contains("Poses and images do not fit"), "{}", check.finding.what);
}

/// A capture of which the first images are right and the others are not.
#[test]
fn a_part_that_does_not_fit_is_named() {
    const COUNT: usize = 28;
    let (_sample, made) = capture(true, false, COUNT);
    let name = |i: usize| made.frames[i].image.display().to_string();
    for points in [true, false] {
        let right = Capture { points: made.points.clone().filter(|_| points), ..made.clone() };
        assert_eq!(warned(&right), [""; 0], "points: {points}");
        let mut flipped = right.clone();
        let poses: Poses = "opencv".parse().unwrap();
        for i in COUNT / 2..COUNT {
            flipped.frames[i].source.cam_from_world = Convention::NERF.misread(&pose(i), poses);
        }
        let found = warned(&flipped);
        let said = |w: &String| {
            w.contains("another convention") && w.contains("a part of the images") && w.contains(&name(27))
        };
        assert!(found.iter().any(said), "points: {points}: {found:?}");
        let mut lenses = right.clone();
        for frame in &mut lenses.frames[COUNT / 2..] {
            frame.source.intrinsics.fx *= 1.8;
            frame.source.intrinsics.fy *= 1.8;
        }
        let found = warned(&lenses);
        let said = |w: &String| w.contains("14 images with another lens");
        assert!(!points || found.iter().any(said), "{found:?}");
    }
}

#[test]
fn focal_lengths_are_named_by_points_and_by_matches() {
    let focal = |factor: f64, points: bool| {
        let mut capture = photos(points);
        for frame in &mut capture.frames {
            let k = &mut frame.source.intrinsics;
            (k.fx, k.fy) = (k.fx * factor, k.fy * factor);
        }
        let check = capture.check_poses();
        let all = check.more.into_iter().chain([check.finding]);
        all.filter(|f| f.what.to_lowercase().contains("focal lengths are")).collect::<Vec<_>>()
    };
    let warns = |found: &[Finding]| found.iter().any(|f| f.severity == Severity::Warning);
    for points in [true, false] {
        assert!(!warns(&focal(1.0, points)), "what is right is not called wrong");
        for factor in [0.5, 2.0] {
            let found = focal(factor, points);
            // Points determine the length; matches may fit others as well, which is reported.
            assert!(if points { warns(&found) } else { !found.is_empty() }, "{factor} {points}: {found:?}");
            let told = |f: &Finding| f.what.split(" if they are ").nth(1)?.split(' ').next()?.parse::<f64>().ok();
            if let Some(times) = found.iter().find_map(told) {
                // Within a step of the search.
                assert!((times * factor - 1.0).abs() < 0.25, "{factor} {points}: {found:?}");
            }
        }
    }
}

#[test]
fn crops_stretched_images_and_foreign_distortion_are_named_by_points() {
    let warned_of = |change: &dyn Fn(&mut Camera)| {
        let mut capture = photos(true);
        capture.frames.iter_mut().for_each(|f| change(&mut f.source));
        let words = ["Focal lengths are", "focal length across", "distortion of the lenses"];
        let found = warned(&capture);
        words.map(|words| found.iter().any(|w| w.contains(words)))
    };
    assert_eq!(warned_of(&|_| ()), [false; 3]);
    // A crop that was scaled back to the size of the image.
    let zoomed = |c: &mut Camera| {
        (c.intrinsics.fx, c.intrinsics.fy) = (c.intrinsics.fx / 1.35, c.intrinsics.fy / 1.35);
    };
    assert_eq!(warned_of(&zoomed), [true, false, false]);
    assert_eq!(warned_of(&|c| c.intrinsics.fx *= 0.6), [false, true, false]);
    // Between two factors that are tried.
    assert_eq!(warned_of(&|c| c.intrinsics.fx /= 1.3), [false, true, false]);
    let k = [-0.5, 0.2, 0.0, 0.0, 0.0, 0.0];
    assert_eq!(warned_of(&|c| c.lens = Lens::Brown { k, p: [0.0; 2], s: [0.0; 4] }), [false, false, true]);
}

#[test]
fn black_turned_and_copied_images_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    ImageBuffer::from_pixel(WIDTH, HEIGHT, Rgb([0u8; 3])).save(at("black.png")).unwrap();
    let original = photos(true);
    let frame = original.train[4];
    image::open(&original.frames[frame].image).unwrap().rotate180().save(at("turned.png")).unwrap();
    for name in ["black.png", "turned.png"] {
        let mut capture = photos(true);
        capture.frames[frame].image = at(name);
        let found = warned(&capture);
        let words = ["do not fit the initial points", "pose of 1 image is probably wrong"];
        let said = found.iter().any(|w| w.contains(name) && words.iter().any(|words| w.contains(words)));
        assert!(said, "{name}: {found:?}");
    }
    std::fs::copy(&original.frames[original.train[1]].image, at("copy.png")).unwrap();
    for points in [true, false] {
        let mut capture = photos(points);
        capture.frames[frame].image = at("copy.png");
        let found = warned(&capture);
        assert!(
            found.iter().any(|w| w.contains("1 images are copies of others") && w.contains("copy.png")),
            "{found:?}"
        );
    }
    // A copy with the same pose is the same view: it must not be held out.
    let mut capture = photos(true);
    let first = capture.frames[capture.train[1]].clone();
    capture.cameras.push(capture.cameras[0].clone());
    capture.frames.push(Frame { image: at("copy.png"), camera: capture.cameras.len() - 1, ..first });
    capture.held.push(capture.frames.len() - 1);
    let found = warned(&capture);
    assert!(found.iter().any(|w| w.contains("1 held-out images are copies of training images")), "{found:?}");
    capture.train.push(capture.held.pop().unwrap());
    assert!(!warned(&capture).iter().any(|w| w.contains("copies")));
    // A fixed camera may show the same again.
    let mut capture = photos(true);
    let first = capture.frames[0].clone();
    capture.frames[1] = Frame { image: at("same.png"), ..first };
    std::fs::copy(&capture.frames[0].image, at("same.png")).unwrap();
    assert!(!warned(&capture).iter().any(|w| w.contains("copies of others")));
}

#[test]
fn inverted_masks_are_named_and_right_ones_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let masked = |inverted: bool| {
        let mut capture = photos(true);
        for (i, frame) in capture.frames.iter_mut().enumerate() {
            let white = |x: u32, y: u32| shown(i, x, y).is_some_and(|(_, ball)| ball) != inverted;
            let path = folder.path().join(format!("{i}.png"));
            // At half the size of the images.
            let map =
                ImageBuffer::from_fn(WIDTH / 2, HEIGHT / 2, |x, y| image::Luma([255 * u8::from(white(2 * x, 2 * y))]));
            map.save(&path).unwrap();
            frame.mask = Some(path);
        }
        capture
    };
    assert_eq!(warned(&masked(false)), [""; 0]);
    let found = warned(&masked(true));
    assert!(found.len() == 1 && found[0].contains("Masks are probably inverted"), "{found:?}");
    // Masks of the camera's own mount are the same in all images.
    let mut capture = masked(true);
    let first = capture.frames[0].mask.clone();
    capture.frames.iter_mut().for_each(|f| f.mask.clone_from(&first));
    assert_eq!(warned(&capture), [""; 0]);
    let said = |f: &Finding| f.aspect == Some(Aspect::NotChecked) && f.what.contains("Whether masks are inverted");
    assert!(capture.check_poses().more.iter().any(said));
    // Numbers of classes: all above 0 count.
    let classes = folder.path().join("classes.png");
    ImageBuffer::from_fn(WIDTH, HEIGHT, |x, _| image::Luma([1 + (x % 2) as u8])).save(&classes).unwrap();
    capture.frames.iter_mut().for_each(|f| f.mask = Some(classes.clone()));
    assert!(capture.check_poses().more.iter().any(|f| f.what.contains("Masks hide nothing")));
}

#[test]
fn a_camera_that_stopped_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = photos(false);
    let frame = |(t, c): (usize, usize)| {
        let image = folder.path().join(format!("{t}-{c}.png"));
        let (from, frame) = (if c == 1 { 1 } else { (t + c) % 5 }, &capture.frames[c]);
        std::fs::copy(&capture.frames[from].image, &image).unwrap();
        Frame { index: t, time: splat4d::scene::Time(t as f64), image, ..frame.clone() }
    };
    let frames: Vec<Frame> = (0..4).flat_map(|t| (0..3).map(move |c| (t, c))).map(frame).collect();
    capture.frames = frames;
    capture.train = (0..capture.frames.len()).collect();
    capture.held = Vec::new();
    let said =
        |c: &Capture| warned(c).into_iter().filter(|w| w.contains("same image all the time")).collect::<Vec<_>>();
    assert!(said(&capture).len() == 1 && said(&capture)[0].ends_with(&format!("not: {}.", capture.cameras[1].name)));
    capture.frames[10].image = capture.frames[9].image.clone();
    assert_eq!(said(&capture), [""; 0]);
}

#[test]
fn images_of_fixed_cameras_are_checked_once() {
    let mut capture = photos(false);
    let frame = |(t, c): (usize, usize)| Frame { index: t, ..capture.frames[c].clone() };
    capture.frames = (0..4).flat_map(|t| (0..3).map(move |c| (t, c))).map(frame).collect();
    capture.train = (0..capture.frames.len()).collect();
    let cameras: Vec<usize> = capture.looked_at(3).iter().map(|&i| capture.frames[i].camera).collect();
    assert_eq!(cameras, [0, 1, 2]);
}

/// Points that walls hide have other colours than the images there; matches show that poses are right.
#[test]
fn hidden_points_raise_no_alarm_where_matches_fit() {
    let shuffled = |keep: usize| {
        let mut capture = photos(true);
        let cloud = capture.points.as_mut().unwrap();
        let count = cloud.colors.len();
        let before = cloud.colors.clone();
        for i in (0..count).filter(|i| i % 20 >= keep) {
            cloud.colors[i] = before[(7 * i + 101) % count];
        }
        let seen = look::take(&capture, &capture.looked_at(CAMERAS), look::COARSE);
        (points::gain_of_all(&capture, &seen).unwrap(), warned(&capture))
    };
    let (gain, found) = shuffled(6);
    assert!((0.1..0.2).contains(&gain), "{gain}");
    assert_eq!(found, [""; 0], "{gain}");
    // Points of another scene.
    let (gain, found) = shuffled(0);
    assert!(gain < 0.1 && found.iter().any(|w| w.contains("Initial points and images do not fit")), "{gain} {found:?}");
}

/// Points next to the images that a shorter focal length brings into view, with colours that agree there by chance.
#[test]
fn too_few_points_in_view_do_not_decide_on_focal_lengths() {
    let mut capture = photos(true);
    let cloud = capture.points.as_mut().unwrap();
    (cloud.points, cloud.colors) =
        cloud.points.iter().zip(&cloud.colors).step_by(cloud.points.len() / 5).take(5).unzip();
    for i in 0..CAMERAS {
        for k in 0..12u32 {
            // 0.3 units in front of one camera, no other has it in view.
            let at = [f64::from(180 + 12 * (k % 3)), f64::from(20 + 25 * (k / 3))];
            let ray = [(at[0] - 80.0) / FOCAL, (at[1] - 60.0) / FOCAL, 1.0];
            let half = [0.5 * (at[0] - 80.0) + 80.0, 0.5 * (at[1] - 60.0) + 60.0];
            let color = shown(i, half[0] as u32, half[1] as u32).map_or([0.35, 0.47, 0.78], |(p, _)| texture(p));
            cloud.points.push(pose(i).inverse().apply(scale(ray, 0.3)));
            cloud.colors.push(color);
        }
    }
    cloud.times = Vec::new();
    let seen = look::take(&capture, &capture.looked_at(CAMERAS), look::COARSE);
    assert_eq!(points::gain_of_all(&capture, &seen), None, "too few are in the images as read");
    let found = warned(&capture);
    assert!(!found.iter().any(|w| w.contains("ocal length")), "{found:?}");
}

/// Most points in one image are those that only this camera has in view, with other colours than the image there.
#[test]
fn an_image_with_hidden_points_is_believed_by_its_matches() {
    let mut capture = photos(true);
    let frame = capture.train[4];
    let cloud = capture.points.as_mut().unwrap();
    let some = cloud.points.len() / 120;
    cloud.points = cloud.points.iter().step_by(some).copied().collect();
    cloud.colors = cloud.colors.iter().step_by(some).copied().collect();
    for k in 0..280u32 {
        let (x, y) = (8 * (k % 20) + 3, 8 * (k / 20) + 3);
        let ray = [(f64::from(x) + 0.5 - 80.0) / FOCAL, (f64::from(y) + 0.5 - 60.0) / FOCAL, 1.0];
        cloud.points.push(pose(frame).inverse().apply(scale(ray, 0.3)));
        let color = shown(frame, x, y).map_or([0.35, 0.47, 0.78], |(p, _)| texture(p));
        cloud.colors.push(color.map(|v| 1.0 - v));
    }
    let gain = points::gain_of_all(&capture, &look::take(&capture, &[frame], look::COARSE)).unwrap();
    assert!(gain < 0.1, "{gain}");
    assert_eq!(warned(&capture), [""; 0]);
}
