//! Captures as people have them: intrinsics in either file, resized images, several layouts in one folder, points
//! next to
//! poses, and no times.

use super::super::*;
use super::bad_input::assert_says;
use super::samples::{self, FOCAL, HEIGHT, Sample, WIDTH};
use serde_json::json;
use splat4d::math::Sim3;
use splat4d::math::se3::{norm, sub};
use splat4d::scene::Lens;

fn open(sample: &Sample) -> Capture {
    Capture::open(sample.root(), &CaptureOptions::default()).unwrap()
}

fn refuse(sample: &Sample) -> String {
    Capture::open(sample.root(), &CaptureOptions::default()).unwrap_err().to_string()
}

fn open_as(sample: &Sample, sequence: Sequence) -> Capture {
    Capture::open(sample.root(), &CaptureOptions { sequence, ..CaptureOptions::default() }).unwrap()
}

fn says(list: &[String], parts: &[&str]) -> bool {
    list.iter().any(|text| parts.iter().all(|part| text.contains(part)))
}

fn cam(c: usize) -> String {
    format!("cam{c:02}.png")
}

#[test]
fn split_files_with_intrinsics_in_pixels() {
    let sample = samples::dnerf();
    for name in &sample.files {
        sample.edit(name, |v| {
            v.as_object_mut().unwrap().remove("camera_angle_x");
            let shared = json!({"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL + 2.0, "cx": 11.5, "k1": -0.1});
            shared.as_object().unwrap().iter().for_each(|(key, value)| v[key] = value.clone());
        });
    }
    sample.edit("transforms_train.json", |v| {
        v["frames"][1]["fl_x"] = json!(30);
        v["frames"][1]["k1"] = json!(0);
        v["frames"][2]["camera_angle_x"] = json!(std::f64::consts::FRAC_PI_2);
    });
    let capture = open(&sample);
    assert_eq!((capture.kind, capture.timing), (CaptureKind::DNerf, Timing::Told));
    assert_eq!((&capture.train[..], &capture.validation[..], &capture.held[..]), (&[0, 1, 2][..], &[3][..], &[4][..]));
    let k: Vec<_> = capture.frames.iter().map(|f| f.source.intrinsics).collect();
    assert_eq!((k[0].fx, k[0].fy, k[0].cx, k[0].cy), (FOCAL, FOCAL + 2.0, 11.5, 8.0));
    assert_eq!((k[1].fx, k[1].fy, k[4].fx), (30.0, FOCAL + 2.0, FOCAL), "a frame's own value goes first");
    assert!((k[2].fx - 12.0).abs() < 1e-12, "a frame's own angle goes before the file's pixels");
    assert!(matches!(capture.frames[0].source.lens, Lens::Brown { k, .. } if k[0] == -0.1));
    assert_eq!(capture.frames[1].source.lens, Lens::Pinhole);
    // Blender's z is up only where Blender's angle represents the lens.
    assert!(capture.up != [0.0, 0.0, 1.0] && open(&samples::dnerf()).up == [0.0, 0.0, 1.0]);
    for (key, value, lens) in [("is_fisheye", json!(true), true), ("camera_model", json!("OPENCV_FISHEYE"), true)] {
        sample.edit("transforms_test.json", |v| v[key] = value);
        assert_eq!(matches!(open(&sample).frames[4].source.lens, Lens::Fisheye { .. }), lens, "{key}");
    }
}

#[test]
fn times_above_one_are_seconds_and_poses_identify_cameras() {
    let sample = samples::dnerf();
    sample.edit("transforms_train.json", |v| {
        let of = |c: usize, t: usize| {
            sample.rgb(&format!("train/cam{c:02}_{t:04}.png"), c, t);
            json!({"file_path": format!("train/cam{c:02}_{t:04}"), "time": 0.5 * t as f64,
                   "transform_matrix": samples::opengl(c + 5)})
        };
        v["frames"] = (0..6).map(|i| of(i / 3, i % 3 + 1)).collect();
    });
    let capture = open(&sample);
    let times: Vec<f64> = capture.train.iter().map(|&i| capture.frames[i].time.0).collect();
    assert_eq!(times, [0.5, 1.0, 1.5, 0.5, 1.0, 1.5]);
    assert_eq!(capture.frames[2].index, 2);
    assert_eq!(capture.held.len(), 1);
}

#[test]
fn one_file_with_a_test_set_next_to_it() {
    let sample = samples::photos(9, cam, None);
    let frames = |v: &serde_json::Value| v["frames"].as_array().unwrap().clone();
    let all: serde_json::Value =
        serde_json::from_slice(&std::fs::read(sample.path("transforms.json")).unwrap()).unwrap();
    let mut test = all.clone();
    test["frames"] = json!(frames(&all)[2..4]);
    sample.write("transforms_test.json", test.to_string().as_bytes());
    let capture = open(&sample);
    assert_eq!((capture.frames.len(), capture.held.as_slice()), (9, &[2, 3][..]));
}

#[test]
fn resized_images_scale_their_intrinsics_and_cropped_ones_are_refused() {
    let sample = samples::photos(9, cam, None);
    sample.edit("transforms.json", |v| {
        let double =
            json!({"w": 2 * WIDTH, "h": 2 * HEIGHT, "fl_x": 2.0 * FOCAL, "fl_y": 2.0 * FOCAL, "cx": 24, "cy": 16});
        double.as_object().unwrap().iter().for_each(|(key, value)| v[key] = value.clone());
    });
    let capture = open(&sample);
    let view = &capture.frames[3].view;
    assert_eq!((view.width, view.height, view.intrinsics.fx, view.intrinsics.cy), (WIDTH, HEIGHT, FOCAL, 8.0));
    assert!(says(&capture.notes, &["9 images", "cam00.png is 24x16, not 48x32"]), "{:?}", capture.notes);
    sample.edit("transforms.json", |v| v["h"] = json!(2 * HEIGHT + 6));
    assert_says(&refuse(&sample), &["cam00", "24x16", "48x38"]);
    // Any image is examined, not only the first.
    let sample = samples::photos(9, cam, None);
    sample.save("images/cam07.png", image::ImageBuffer::from_fn(16, 24, |_, _| image::Luma([9u8])));
    assert_says(&refuse(&sample), &["cam07.png", "16x24", "24x16"]);
}

#[test]
fn points_of_a_model_next_to_the_poses() {
    let near = |capture: &Capture| {
        let points = &capture.points.as_ref().unwrap().points;
        assert!(points.len() == 1 && norm(sub(points[0], [0.1, 0.2, 0.3])) < 1e-9, "{points:?}");
    };
    let sample = samples::photos(9, cam, Some(&Sim3::default()));
    let capture = open(&sample);
    assert_eq!(capture.kind, CaptureKind::Nerfstudio);
    assert!(says(&capture.notes, &["initial points", "agree with transforms.json"]), "{:?}", capture.notes);
    assert!(capture.warnings.is_empty(), "{:?}", capture.warnings);
    near(&capture);
    let turned = Sim3 { scale: 3.0, rotation: samples::pose(2).rotation, translation: [1.0, -7.0, 2.0] };
    let capture = open(&samples::photos(9, cam, Some(&turned)));
    assert!(says(&capture.notes, &["turned, moved and scaled"]), "{:?}", capture.notes);
    near(&capture);
    // A model of other places is not used, nor one that is damaged.
    sample
        .edit("transforms.json", |v| (0..9).for_each(|c| v["frames"][c]["transform_matrix"] = samples::opengl(8 - c)));
    let capture = open(&sample);
    assert!(capture.points.is_none() && says(&capture.warnings, &["sparse", "do not agree", "ply_file_path"]));
    let sample = samples::photos(9, cam, Some(&Sim3::default()));
    sample.write("sparse/0/points3D.txt", b"7 0.1 0.2");
    let capture = open(&sample);
    assert!(capture.points.is_none() && says(&capture.warnings, &["points3D.txt", "line 1"]));
    // Named points go first; a name that leads nowhere is no reason to stop.
    sample.write("own.ply", samples::PLY.as_bytes());
    sample.edit("transforms.json", |v| v["ply_file_path"] = json!("own.ply"));
    assert_eq!(open(&sample).points.unwrap().points.len(), 2);
    sample.edit("transforms.json", |v| v["ply_file_path"] = json!("gone.ply"));
    assert!(says(&open(&sample).warnings, &["gone.ply", "missing"]));
}

#[test]
fn one_of_several_layouts_is_read_and_reported() {
    let sample = samples::own();
    sample.write("transforms.json", br#"{"fl_x": 20, "frames": []}"#);
    std::fs::create_dir_all(sample.path("sparse")).unwrap();
    let capture = open(&sample);
    assert_eq!(capture.kind, CaptureKind::Own);
    let parts = ["capture.json is read", "transforms.json, sparse not", "comes first in the order", "give its path"];
    assert!(says(&capture.warnings, &parts), "{:?}", capture.warnings);
    let told = |path: &str| Capture::open(&sample.path(path), &CaptureOptions::default());
    assert!(told("capture.json").unwrap().warnings.is_empty(), "who names a file has chosen");
    assert_says(&told("transforms.json").unwrap_err().to_string(), &["no frames"]);
    let sample = samples::dnerf();
    sample.write("transforms.json", b"{}");
    let capture = open(&sample);
    assert!(capture.warnings.is_empty() && says(&capture.notes, &["transforms_train.json is read", "held-out images"]));
    let sample = samples::photos(9, cam, Some(&Sim3::default()));
    for path in ["sparse", "sparse/0"] {
        let capture = Capture::open(&sample.path(path), &CaptureOptions::default()).unwrap();
        assert_eq!((capture.kind, capture.frames.len()), (CaptureKind::Colmap, 9), "{path}");
    }
}

#[test]
fn photos_without_times_are_one_time() {
    let sample = samples::photos(20, cam, Some(&Sim3::default()));
    for path in [sample.root().to_owned(), sample.path("sparse")] {
        let capture = Capture::open(&path, &CaptureOptions::default()).unwrap();
        assert_eq!((capture.timing, capture.times()), (Timing::Moment, vec![0.0]));
        assert!(capture.cameras.len() == 20 && capture.fixed_cameras());
        assert_eq!((capture.cameras[7].name.as_str(), capture.held.as_slice()), ("cam07", &[0, 8, 16][..]));
        assert!(
            says(&capture.notes, &["20 images are given the same time", "capture.sequence=video"]),
            "{:?}",
            capture.notes
        );
        assert!(capture.warnings.is_empty());
    }
    let held = CaptureOptions { hold_out: Some("camera=cam00".parse().unwrap()), ..CaptureOptions::default() };
    assert_eq!(Capture::open(sample.root(), &held).unwrap().held, [0]);
    let film = open_as(&sample, Sequence::Video);
    assert_eq!((film.timing, film.times().len(), film.fixed_cameras()), (Timing::Numbers, 20, false));
    assert!(film.warnings.is_empty());
}

#[test]
fn numbered_frames_without_times_are_a_film() {
    let sample = samples::photos(20, |c| format!("frame_{:04}.png", c + 1), Some(&Sim3::default()));
    for path in [sample.root().to_owned(), sample.path("sparse")] {
        let capture = Capture::open(&path, &CaptureOptions::default()).unwrap();
        assert_eq!((capture.timing, capture.times().len(), capture.cameras.len()), (Timing::Numbers, 20, 1));
        let parts = ["20 images", "frame_0001.png", "video of one moving camera", "capture.sequence=photos"];
        assert!(says(&capture.warnings, &parts), "{:?}", capture.warnings);
    }
    let photos = open_as(&sample, Sequence::Photos);
    assert_eq!((photos.timing, photos.times(), photos.cameras.len()), (Timing::Moment, vec![0.0], 20));
    assert!(photos.warnings.is_empty());
    // Given times are not in query.
    sample.edit("transforms.json", |v| (0..20).for_each(|c| v["frames"][c]["time"] = json!(0.1 * c as f64)));
    for sequence in [Sequence::Auto, Sequence::Photos] {
        let capture = open_as(&sample, sequence);
        assert_eq!((capture.timing, capture.times().len()), (Timing::Told, 20));
        assert_eq!(says(&capture.warnings, &["sequence"]), sequence == Sequence::Photos, "{:?}", capture.warnings);
    }
}

#[test]
fn split_files_without_times_are_one_time_even_where_they_share_poses() {
    let sample = samples::dnerf();
    for name in &sample.files {
        sample.edit(name, |v| {
            v["frames"]
                .as_array_mut()
                .unwrap()
                .iter_mut()
                .for_each(|f| drop(f.as_object_mut().unwrap().remove("time")));
        });
    }
    sample.edit("transforms_test.json", |v| v["frames"][0]["transform_matrix"] = samples::opengl(1));
    let capture = open(&sample);
    assert_eq!((capture.timing, capture.times(), capture.cameras.len()), (Timing::Moment, vec![0.0], 5));
    assert_eq!((capture.train.len(), capture.held.as_slice()), (3, &[4][..]));
    assert!(says(&capture.warnings, &["1 frames of the training", "agree"]), "{:?}", capture.warnings);
}

#[test]
fn broken_transforms_are_errors_with_key_and_file() {
    let broken = |change: &dyn Fn(&mut serde_json::Value)| {
        let sample = samples::photos(9, cam, None);
        sample.edit("transforms.json", change);
        refuse(&sample)
    };
    let rows = broken(&|v| v["frames"][4]["transform_matrix"] = json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]]));
    assert_says(&rows, &["transforms.json", "frames[4].transform_matrix", "4x4 matrix"]);
    let missing = broken(&|v| (0..5).for_each(|i| v["frames"][i]["file_path"] = json!(format!("images/gone{i}.png"))));
    assert_says(&missing, &["5 of 9 images are missing", "images/gone0.png", "capture.max_missing=0.56"]);
    assert_says(&broken(&|v| v["fl_x"] = json!(0)), &["frames[0]", "focal length 0 x 20", "above zero"]);
    assert_says(&broken(&|v| v["frames"][3]["fl_y"] = json!(-2)), &["frames[3]", "focal length", "-2"]);
    assert_says(
        &broken(&|v| v["frames"][2]["transform_matrix"][0][3] = json!(null)),
        &["frames[2].transform_matrix", "not finite"],
    );
    assert_says(&broken(&|v| drop(v.as_object_mut().unwrap().remove("fl_x"))), &["frames[0]", "camera_angle_x"]);
    let sample = samples::photos(9, cam, None);
    let text = std::fs::read_to_string(sample.path("transforms.json")).unwrap();
    sample.write("transforms.json", text.replacen("[[", "[[NaN,", 1).as_bytes());
    assert_says(&refuse(&sample), &["transforms.json", "NaN"]);
    sample.write("transforms.json", &text.as_bytes()[..text.len() / 2]);
    assert_says(&refuse(&sample), &["transforms.json", "truncated"]);
}
