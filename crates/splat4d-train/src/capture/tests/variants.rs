//! One capture in many spellings: names, endings, byte-order marks, missing images, EXIF, splits, times, masks and
//! standard folders. The result equals the written capture, or is an error, never silently another.

use super::super::*;
use super::samples::{self, FOCAL, HEIGHT, PLY, Sample, WIDTH};
use crate::capture::pose::same_pose;
use serde_json::{Value, json};
use std::path::PathBuf;

fn read(root: &Path, options: &CaptureOptions) -> Capture {
    Capture::open(root, options).unwrap_or_else(|e| panic!("{e}"))
}

fn open(sample: &Sample) -> Capture {
    read(sample.root(), &CaptureOptions::default())
}

fn refuse(sample: &Sample) -> String {
    Capture::open(sample.root(), &CaptureOptions::default()).err().map_or_else(String::new, |e| e.to_string())
}

/// Whether a remark of this aspect has all of `parts`.
fn said(capture: &Capture, aspect: Aspect, severity: Severity, parts: &[&str]) -> bool {
    let fits = |r: &Remark| r.aspect == aspect && r.severity == severity && parts.iter().all(|p| r.what.contains(p));
    capture.account.iter().any(fits)
}

fn assert_said(capture: &Capture, aspect: Aspect, severity: Severity, parts: &[&str]) {
    assert!(said(capture, aspect, severity, parts), "{parts:?} must be in {:?}", capture.account);
}

/// Every image of a sample, relative to its folder.
fn images(root: &Path) -> Vec<PathBuf> {
    let mut out = Vec::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for name in rig::file_names(&folder) {
            let path = folder.join(&name);
            if path.is_dir() {
                folders.push(path);
            } else if rig::is_image(&name) {
                out.push(path);
            }
        }
    }
    out.sort();
    out
}

/// Same cameras, times and purposes; which frame has a mask.
fn assert_same(name: &str, a: &Capture, b: &Capture) {
    assert_eq!(a.frames.len(), b.frames.len(), "{name}");
    for (i, (f, g)) in a.frames.iter().zip(&b.frames).enumerate() {
        assert_eq!(
            (f.time, f.index, a.split(i), f.mask.is_some()),
            (g.time, g.index, b.split(i), g.mask.is_some()),
            "{name}"
        );
        assert!(same_pose(&f.source, &g.source) && f.source.lens == g.source.lens, "{name}: frame {i}");
    }
}

/// Changes the names of images in the metadata of a sample, wherever they occur.
fn rename_in_metadata(sample: &Sample, change: &dyn Fn(&str) -> String) {
    for file in &sample.files {
        if file.ends_with("images.txt") {
            let text = std::fs::read_to_string(sample.path(file)).unwrap();
            let line = |l: &str| match l.rsplit_once(' ') {
                Some((rest, name)) if name.contains(".png") => format!("{rest} {}", change(name)),
                _ => l.to_owned(),
            };
            sample.write(file, text.lines().map(line).collect::<Vec<_>>().join("\n").as_bytes());
        } else if file.ends_with(".json") {
            sample.edit(file, |v| rename_in(v, change));
        }
    }
}

fn rename_in(value: &mut Value, change: &dyn Fn(&str) -> String) {
    match value {
        Value::String(s) if s.contains('/') && !s.ends_with(".ply") => *s = change(s),
        Value::Array(list) => list.iter_mut().for_each(|v| rename_in(v, change)),
        Value::Object(map) => map.values_mut().for_each(|v| rename_in(v, change)),
        _ => {}
    }
}

#[test]
fn names_in_every_spelling_lead_to_the_same_capture() {
    type Change = (&'static str, fn(&Sample));
    let changes: [Change; 6] = [
        ("backslashes", |s| rename_in_metadata(s, &|n| n.replace('/', "\\"))),
        ("letter case", |s| {
            for image in images(s.root()) {
                std::fs::rename(&image, image.with_extension("PNG")).unwrap();
            }
        }),
        ("the ending", |s| rename_in_metadata(s, &|n| n.replace(".png", ".jpg"))),
        ("leading folders", |s| rename_in_metadata(s, &|n| format!("/home/me/scan/{}", n.trim_start_matches("./")))),
        ("leading folders", |s| {
            rename_in_metadata(s, &|n| format!("D:\\scan\\{}", n.trim_start_matches("./").replace('/', "\\")))
        }),
        ("Unicode form", |s| {
            // Composed in the metadata, decomposed on disk, as macOS stores it.
            rename_in_metadata(s, &|n| n.replace("00", "\u{e4}00"));
            for image in images(s.root()).into_iter().rev() {
                let relative = image.strip_prefix(s.root()).unwrap().to_str().unwrap().replace("00", "a\u{308}00");
                let to = s.path(&relative);
                std::fs::create_dir_all(to.parent().unwrap()).unwrap();
                std::fs::rename(&image, to).unwrap();
            }
        }),
    ];
    for (layout, plain) in samples::all() {
        let expected = open(&plain);
        for (way, change) in &changes {
            let by_listing = ["n3dv", "nerfies", "colmap binary"].contains(&layout);
            // Layouts that list folders, or have no text to change, take part in what happens on disk.
            if by_listing && *way != "letter case" || layout == "own" && *way == "Unicode form" {
                continue;
            }
            let sample = samples::all().into_iter().find(|(name, _)| *name == layout).unwrap().1;
            change(&sample);
            let capture = open(&sample);
            assert_same(&format!("{layout}, {way}"), &expected, &capture);
            // Ending-less names of D-NeRF, and listings, have no number.
            let tells = said(&capture, Aspect::Assumed, Severity::Note, &["differ from their files", way]);
            assert!(tells || by_listing || layout == "dnerf", "{layout}, {way}: {:?}", capture.account);
        }
    }
}

#[test]
fn byte_order_marks_are_skipped_in_every_text_file() {
    for (layout, sample) in samples::all() {
        let expected = open(&sample);
        for file in sample.files.iter().filter(|f| f.ends_with(".json") || f.ends_with(".txt")) {
            let text = std::fs::read_to_string(sample.path(file)).unwrap();
            sample.write(file, format!("\u{feff}{text}").as_bytes());
        }
        assert_same(layout, &expected, &open(&sample));
    }
}

#[test]
fn a_few_missing_images_are_skipped_and_many_refused() {
    for (layout, plain) in samples::all() {
        let all = open(&plain).frames.len();
        let sample = samples::all().into_iter().find(|(name, _)| *name == layout).unwrap().1;
        let of_frames: Vec<PathBuf> = open(&sample).frames.iter().map(|f| f.image.clone()).collect();
        if layout == "n3dv" || layout == "own" {
            // Listed, or read until the first that is missing.
            continue;
        }
        std::fs::remove_file(&of_frames[1]).unwrap();
        let few = CaptureOptions { max_missing: 0.4, ..CaptureOptions::default() };
        let capture = read(sample.root(), &few);
        let siblings = layout.starts_with("colmap");
        assert_eq!(capture.frames.len(), all - 1, "{layout}");
        let name = of_frames[1].file_name().unwrap().to_str().unwrap();
        if !siblings {
            assert_said(
                &capture,
                Aspect::NotFound,
                Severity::Warning,
                &["1 of", "images are missing", name, "skipped"],
            );
        }
        of_frames[2..].iter().for_each(|f| drop(std::fs::remove_file(f)));
        let message = refuse(&sample);
        assert!(message.contains("missing") && message.contains("max_missing"), "{layout}: {message}");
    }
}

/// The tiny JPEG, whose EXIF states an orientation.
fn oriented(orientation: u8) -> Vec<u8> {
    let jpeg: &[u8] = include_bytes!("tiny.jpg");
    let mut tiff = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".to_vec();
    tiff.extend([orientation, 0, 0, 0, 0, 0, 0]);
    let mut bytes = jpeg[..2].to_vec();
    bytes.extend([0xFF, 0xE1]);
    bytes.extend((tiff.len() as u16 + 2).to_be_bytes());
    bytes.extend(tiff);
    bytes.extend(&jpeg[2..]);
    bytes
}

#[test]
fn orientations_follow_whose_pixels_the_poses_describe() {
    for orientation in 1..=8u8 {
        let turned = orientation > 1;
        // COLMAP reads pixels as stored.
        let sample = samples::colmap_txt();
        sample.write("images/cam0/0000.png", &oriented(orientation));
        let capture = open(&sample);
        assert_eq!(capture.frames[0].upright, !turned, "{orientation}");
        assert_eq!((capture.frames[0].view.width, capture.frames[0].view.height), (WIDTH, HEIGHT));
        assert_eq!(said(&capture, Aspect::Assumed, Severity::Note, &["1 of 6", "as stored"]), turned);
        let store = ImageStore::new(Arc::new(capture), 1 << 20);
        let picture = store.load(0).unwrap().to_picture();
        assert!(picture.color.get(0, 0, 0) > 0.7 && picture.color.get(2, 15, 23) > 0.7, "{orientation}: as stored");
        // Elsewhere sizes decide: the stored pixels are 24 wide.
        let sample = samples::nerfstudio();
        sample.write("images/cam0/0000.png", &oriented(orientation));
        let capture = open(&sample);
        assert_eq!(capture.frames[0].upright, orientation < 5, "{orientation}");
        let unsure = said(&capture, Aspect::Assumed, Severity::Warning, &["1 of 4", "capture.exif=stored"]);
        assert_eq!(unsure, turned && orientation < 5);
        let by_size = said(&capture, Aspect::Assumed, Severity::Note, &["1 of 4", "only the pixels as stored"]);
        assert_eq!(by_size, orientation >= 5, "{:?}", capture.account);
        let told = CaptureOptions { exif: Exif::Stored, ..CaptureOptions::default() };
        assert_eq!(read(sample.root(), &told).frames[0].upright, !turned);
    }
}

#[test]
fn poses_of_a_given_convention_are_read() {
    for (layout, sample) in samples::all() {
        let plain = open(&sample);
        let told = CaptureOptions { poses: "inverse".parse().unwrap(), ..CaptureOptions::default() };
        let Ok(other) = Capture::open(sample.root(), &told) else {
            // Cameras at one distance have the same position when their poses are inverted.
            continue;
        };
        for (f, g) in plain.frames.iter().zip(&other.frames) {
            let expected = plain.convention.reread(&f.source.cam_from_world, told.poses).unwrap();
            let expected = Camera { cam_from_world: expected, ..f.source.clone() };
            assert!(same_pose(&expected, &g.source), "{layout}");
        }
    }
    let sample = samples::photos(9, |c| format!("cam{c:02}.png"), None);
    let plain = open(&sample);
    sample.edit("transforms.json", |v| {
        for frame in v["frames"].as_array_mut().unwrap() {
            let m = frame["transform_matrix"].clone();
            frame["transform_matrix"] = (0..4).map(|c| (0..4).map(|r| m[r][c].clone()).collect::<Value>()).collect();
        }
    });
    assert!(refuse(&sample).contains("--poses transposed"), "{}", refuse(&sample));
    let told = CaptureOptions { poses: "transposed".parse().unwrap(), ..CaptureOptions::default() };
    assert_same("columns", &plain, &read(sample.root(), &told));
}

#[test]
fn lists_of_splits_are_kept() {
    let name = |c: usize| format!("cam{c:02}.png");
    let with = |lists: Value| {
        let sample = samples::photos(9, name, None);
        sample.edit("transforms.json", |v| {
            lists.as_object().unwrap().iter().for_each(|(key, list)| v[key] = list.clone());
        });
        sample
    };
    let capture = open(&with(
        json!({"train_filenames": ["/home/me/images/CAM00.png", "./images/cam02.png", "images\\cam05.png"]}),
    ));
    assert_eq!((capture.train.as_slice(), capture.held.len()), (&[0, 2, 5][..], 6));
    assert_said(&capture, Aspect::Assumed, Severity::Note, &["6 of 9", "held out"]);
    let both =
        json!({"train_filenames": ["images/cam00.png", "images/cam01"], "test_filenames": ["./images/cam03.png"]});
    let capture = open(&with(both));
    assert_eq!((capture.frames.len(), capture.held.as_slice()), (3, &[2][..]));
    assert_said(&capture, Aspect::Assumed, Severity::Note, &["6 of 9", "left out"]);
    let capture = open(&with(json!({"test_filenames": ["images/cam03.png", "images/gone.png"]})));
    assert_eq!(capture.held, [3]);
    assert_said(&capture, Aspect::NotFound, Severity::Warning, &["1 names", "gone.png"]);
    assert!(refuse(&with(json!({"train_filenames": ["gone.png"]}))).contains("none of the 1 names"));
    // Lists next to COLMAP models: 3DGS's, and Nerfstudio's, which go first.
    let sample = colmap_at("sparse/0", &["images"]);
    sample.write("sparse/0/test.txt", b"_DSC8680.png\r\n_DSC8683.png\r\n");
    let capture = open(&sample);
    assert_eq!((capture.train.len(), capture.held.as_slice()), (7, &[1, 4][..]));
    sample.write("test_list.txt", b"_DSC8681.png\n");
    sample.write("train_list.txt", "\u{feff}_DSC8679.png\n_DSC8682.png\n".as_bytes());
    let capture = open(&sample);
    assert_eq!((capture.train.as_slice(), capture.held.as_slice()), (&[0, 2][..], &[1][..]));
    assert_said(&capture, Aspect::Assumed, Severity::Note, &["6 of 9", "left out"]);
    // Lists of images at the top; not those of numbers.
    let sample = colmap_at("sparse/0", &["images"]);
    sample.write("test.txt", b"_DSC8680.png\n_DSC8683.png\n");
    sample.write("train.txt", b"1\n2\n");
    assert_eq!(open(&sample).held, [1, 4]);
    // Keys of other programs are not kept, and named.
    let other = with(json!({"train_ids": [0, 1, 2]}));
    assert_said(&open(&other), Aspect::NotRead, Severity::Warning, &["train_ids (meant train_filenames?)"]);
    // DyCheck's lists and rate, and HyperNeRF's lists without ids.
    let sample = samples::nerfies();
    sample.edit("dataset.json", |v| *v = json!({"ids": ["000000", "000001", "000002", "000003"]}));
    sample.write("splits/train.json", br#"{"frame_names": ["000000", "000003"]}"#);
    sample.write("splits/val.json", br#"{"frame_names": ["000001", "000002"]}"#);
    sample.write("extra.json", br#"{"fps": 60}"#);
    let capture = open(&sample);
    assert_eq!((capture.fps, capture.held.as_slice(), capture.time_range().1), (60.0, &[1, 2][..], 3.0 / 60.0));
    assert_said(&capture, Aspect::Assumed, Severity::Note, &["0 to 3", "60", "0.050 s"]);
    let sample = samples::nerfies();
    let ids = json!({"train_ids": ["000000", "000003"], "val_ids": ["000001"]});
    sample.edit("dataset.json", |v| *v = ids);
    let capture = open(&sample);
    assert_eq!((capture.frames.len(), capture.held.as_slice()), (3, &[1][..]));
}

#[test]
fn times_are_interpreted_by_their_unit() {
    let with = |times: &[f64], fps: Option<f64>, name: &dyn Fn(usize) -> String| {
        let sample = samples::photos(times.len(), name, None);
        sample.edit("transforms.json", |v| {
            times.iter().enumerate().for_each(|(i, t)| v["frames"][i]["time"] = json!(t));
            if let Some(fps) = fps {
                v["fps"] = json!(fps);
            }
        });
        open(&sample)
    };
    let numbered = |i: usize| format!("{:04}.png", i + 7);
    let lettered = |i: usize| format!("{}.png", char::from(b'a' + i as u8));
    let steps = |step: f64| (0..9).map(|i| step * i as f64).collect::<Vec<f64>>();
    type Case<'a> = (Vec<f64>, Option<f64>, &'a dyn Fn(usize) -> String, f64, Severity, &'a str);
    let cases: [Case<'_>; 12] = [
        // Frame numbers, by the names, and as a stated rate makes likely.
        (steps(1.0), Some(30.0), &numbered, 8.0 / 30.0, Severity::Note, "frame numbers"),
        (steps(1.0), None, &numbered, 8.0 / 30.0, Severity::Note, "frame numbers"),
        (steps(1.0), Some(30.0), &lettered, 8.0 / 30.0, Severity::Warning, "frame numbers"),
        (steps(1.0), None, &lettered, 8.0, Severity::Warning, "seconds"),
        // Shorter than a second.
        (steps(1.0 / 30.0), Some(30.0), &lettered, 8.0 / 30.0, Severity::Note, "seconds"),
        (steps(1.0 / 25.0), None, &lettered, 8.0 / 25.0, Severity::Note, "seconds"),
        // Parts of the capture.
        (steps(1.0 / 8.0), None, &lettered, 8.0 / 30.0, Severity::Note, "parts"),
        (steps(1.0 / 9.0), Some(24.0), &lettered, 8.0 / 9.0 * 8.0 / 24.0, Severity::Note, "parts"),
        // Every third frame of a second, and a clock that counts from a date.
        (steps(0.1).iter().map(|t| 0.5 * t).collect(), Some(60.0), &lettered, 0.4, Severity::Note, "seconds"),
        (steps(0.1).iter().map(|t| 1.7e9 + t).collect(), Some(10.0), &lettered, 0.8, Severity::Note, "seconds"),
        // Another rate than the one that is stated.
        (steps(2.0 / 15.0), Some(9.0), &lettered, 8.0 * 2.0 / 15.0, Severity::Warning, "do not fit"),
        // Milliseconds.
        (steps(33.5), Some(30.0), &lettered, 8.0 * 33.5, Severity::Warning, "seconds"),
    ];
    for (times, fps, name, length, severity, word) in cases {
        let capture = with(&times, fps, name);
        let (first, last) = capture.time_range();
        // A clock from a date has no more digits.
        assert!((last - first - length).abs() < 1e-6, "{times:?} at {fps:?}: {} s", last - first);
        assert!(first.abs() < 1e3, "{first}");
        assert_said(&capture, Aspect::Assumed, severity, &["Times are read as", word, "9 times"]);
    }
    let rate = with(&steps(1.0 / 25.0), None, &lettered).fps;
    assert_eq!(rate, 25.0, "steps of a known rate tell it");
    let sample = samples::photos(3, lettered, None);
    sample.edit("transforms.json", |v| (0..3).for_each(|i| v["frames"][i]["time"] = json!(i)));
    let told = CaptureOptions { times: Times::Frames, fps: Some(10.0), ..CaptureOptions::default() };
    assert!((read(sample.root(), &told).time_range().1 - 0.2).abs() < 1e-12);
}

#[test]
fn contradictions_of_focal_lengths_and_unread_clouds_are_reported() {
    let with = |angle: f64| {
        let sample = samples::photos(4, |i| format!("{i}.png"), None);
        sample.edit("transforms.json", |v| {
            v["camera_angle_x"] = json!(angle);
            v["fl_x"] = json!(FOCAL);
            v["fl_y"] = json!(FOCAL);
        });
        sample.write("sparse_pc.ply", PLY.as_bytes());
        sample
    };
    let angle = 2.0 * (0.5 * WIDTH as f64 / FOCAL).atan();
    let right = open(&with(angle));
    assert!(!right.warnings.iter().any(|w| w.contains("differ")), "{:?}", right.warnings);
    assert_said(&right, Aspect::NotRead, Severity::Note, &["Point clouds", "sparse_pc.ply"]);
    assert_said(
        &open(&with(0.5 * angle)),
        Aspect::Assumed,
        Severity::Warning,
        &["camera_angle_x and fl_x differ", "20.0 px"],
    );
}

#[test]
fn a_lens_that_folds_inside_the_image_is_reported() {
    let with = |k1: f64| {
        let sample = samples::photos(4, |i| format!("{i}.png"), None);
        sample.edit("transforms.json", |v| v["k1"] = json!(k1));
        open(&sample)
    };
    assert_said(&with(-2.0), Aspect::Assumed, Severity::Warning, &["look wrong", "the lens folds"]);
    assert!(!with(-0.1).warnings.iter().any(|w| w.contains("look wrong")));
}

#[test]
fn a_lost_frame_does_not_shift_those_after_it() {
    let sample = samples::n3dv();
    std::fs::remove_file(sample.path("cam01/images/0001.png")).unwrap();
    let capture = open(&sample);
    let of = |c: usize| capture.frames.iter().filter(|f| f.camera == c).map(|f| f.index).collect::<Vec<_>>();
    assert_eq!((of(0), of(1)), (vec![0, 1, 2], vec![0, 2]));
    assert!((capture.frames.last().unwrap().time.0 - 2.0 / 30.0).abs() < 1e-12);
    assert_said(&capture, Aspect::NotFound, Severity::Warning, &["cam01 (1)", "keep their times"]);
    // Cameras that number their frames apart share no clock by it.
    let sample = samples::n3dv();
    (0..3).for_each(|t| {
        let to = sample.path(&format!("cam01/images/{:04}.png", 500 + t));
        std::fs::rename(sample.path(&format!("cam01/images/{t:04}.png")), to).unwrap();
    });
    assert_eq!(open(&sample).frames.last().unwrap().index, 2);
}

#[test]
fn keys_of_lenses_are_used_or_refused() {
    let with = |keys: Value| {
        let sample = samples::photos(4, |c| format!("cam{c}.png"), None);
        sample.edit("transforms.json", |v| keys.as_object().unwrap().iter().for_each(|(k, x)| v[k] = x.clone()));
        sample
    };
    let lens = |keys: Value| open(&with(keys)).frames[0].source.lens;
    let brown = |k: [f64; 6], p: [f64; 2]| splat4d::scene::Lens::Brown { k, p, s: [0.0; 4] };
    let rational = json!({"k1": 0.1, "k2": 0.05, "k4": 0.2, "k5": 0.3, "k6": 0.01});
    assert_eq!(lens(rational), brown([0.1, 0.05, 0.0, 0.2, 0.3, 0.01], [0.0; 2]));
    let listed = json!({"distortion_params": [0.1, 0.02, 0.0, 0.0, 0.001, 0.002]});
    assert_eq!(lens(listed), brown([0.1, 0.02, 0.0, 0.0, 0.0, 0.0], [0.001, 0.002]));
    assert_eq!(lens(json!({"distortion_params": [0, 0, 0, 0, 0, 0]})), splat4d::scene::Lens::Pinhole);
    assert!(matches!(lens(json!({"is_fisheye": 1})), splat4d::scene::Lens::Fisheye { .. }));
    assert!(refuse(&with(json!({"is_fisheye": "yes"}))).contains("is_fisheye"));
    for keys in [
        json!({"latlong": true}),
        json!({"k4": 0.1}),
        json!({"is_fisheye": true, "k5": 0.1}),
        json!({"ftheta_p1": 0.5}),
    ] {
        assert!(refuse(&with(keys.clone())).contains("Undistort"), "{keys}");
    }
    // An angle of one side alone: pixels are square.
    let by_height = with(json!({"camera_angle_y": 2.0 * (8.0f64 / 20.0).atan()}));
    by_height
        .edit("transforms.json", |v| ["fl_x", "fl_y"].iter().for_each(|k| drop(v.as_object_mut().unwrap().remove(*k))));
    let focal = open(&by_height).frames[0].source.intrinsics;
    assert!((focal.fx - 20.0).abs() < 1e-9 && (focal.fy - 20.0).abs() < 1e-9, "{focal:?}");
    let odd = open(&with(json!({"my_key": 3, "aabb_scale": 16, "rolling_shutter": [0, 0, 0, 1]})));
    assert_said(&odd, Aspect::NotRead, Severity::Note, &["2 keys", "my_key", "rolling_shutter"]);
}

#[test]
fn masks_next_to_images_are_found_in_every_layout() {
    let names: [fn(&str) -> String; 5] = [
        |n| format!("masks/{n}.png"),
        |n| format!("masks/{}_mask.png", n.trim_end_matches(".png")),
        |n| format!("mask/{}.png", n.trim_end_matches(".png")),
        |n| format!("masks/images/{n}"),
        |n| format!("Masks/{n}"),
    ];
    for name in names {
        for sample in [samples::photos(3, |c| format!("cam{c}.png"), None), samples::colmap_txt(), samples::n3dv()] {
            let before = open(&sample);
            for frame in &before.frames {
                let relative = frame.image.strip_prefix(sample.root()).unwrap().to_str().unwrap();
                let relative = relative.trim_start_matches("images/").replace("/images/", "/");
                sample.mask(&name(&relative), |x, _| if x < 9 { 255 } else { 0 });
            }
            let capture = open(&sample);
            assert!(capture.frames.iter().all(|f| f.mask.is_some()), "{:?}: {}", capture.kind, name("a.png"));
        }
    }
    // Folders of another layout's images, and a folder of another name.
    let sample = samples::nerfies();
    (0..4).for_each(|i| sample.mask(&format!("mask/1x/{i:06}.png.png"), |x, _| if x < 9 { 255 } else { 0 }));
    assert!(open(&sample).frames.iter().all(|f| f.mask.is_some()));
    let sample = samples::photos(3, |c| format!("cam{c}.png"), None);
    sample.mask("images_masks/cam1.png", |_, _| 255);
    assert_said(&open(&sample), Aspect::NotRead, Severity::Note, &["may hold masks: images_masks"]);
    // Half the size, and a name that fits nothing.
    let sample = samples::photos(3, |c| format!("cam{c}.png"), None);
    sample.save(
        "masks/cam1.png",
        image::ImageBuffer::from_fn(12, 8, |x, _| image::Luma([if x < 6 { 255u8 } else { 0 }])),
    );
    sample.mask("masks/other.png", |_, _| 255);
    let capture = open(&sample);
    assert_said(&capture, Aspect::NotRead, Severity::Note, &["1 of 2 files in masks/", "other.png"]);
    assert_said(&capture, Aspect::NotFound, Severity::Note, &["Masks of 2 of 3"]);
    let mask = ImageStore::new(Arc::new(capture), 1 << 20).load(1).unwrap().to_picture().mask.unwrap();
    assert_eq!((mask.get(0, 3, 11), mask.get(0, 3, 12)), (1.0, 0.0));
    std::fs::remove_file(sample.path("masks/cam1.png")).unwrap();
    assert_said(
        &open(&sample),
        Aspect::NotRead,
        Severity::Warning,
        &["None of the 1 files in masks/", "cam0.png.png", "_mask"],
    );
    // Masks that are no images, and images of another folder.
    let arrays = samples::photos(3, |c| format!("cam{c}.png"), None);
    arrays.write("masks/cam1.npy", b"x");
    assert_said(&open(&arrays), Aspect::NotRead, Severity::Warning, &["1 files in masks/", "cam1.npy", "PNG"]);
    (0..3).for_each(|c| arrays.mask(&format!("sam2/cam{c}.png"), |_, _| 255));
    assert_said(&open(&arrays), Aspect::NotRead, Severity::Note, &["named like the images: sam2"]);
    // A mask in the alpha of a white image, and one of the numbers of labels.
    let half = |x: u32| if x < 12 { 255u8 } else { 0 };
    let rgba = |x, _| image::Rgba([255, 255, 255, half(x)]);
    let labels = |x, _| image::Luma([u16::from(half(x) > 0) * 3]);
    let [width, height] = [WIDTH as u32, HEIGHT as u32];
    let sample_of = |save: &dyn Fn(&Sample)| {
        let sample = samples::photos(3, |c| format!("cam{c}.png"), None);
        save(&sample);
        let store = ImageStore::new(Arc::new(open(&sample)), 1 << 20);
        let mask = store.load(1).unwrap().to_picture().mask.unwrap();
        (mask.get(0, 3, 2), mask.get(0, 3, 20))
    };
    let in_alpha = sample_of(&|s| s.save("masks/cam1.png", image::ImageBuffer::from_fn(width, height, rgba)));
    let of_labels = sample_of(&|s| s.save("masks/cam1.png", image::ImageBuffer::from_fn(width, height, labels)));
    assert_eq!([in_alpha, of_labels], [(1.0, 0.0); 2]);
    ["masks/cam1_mask.png", "masks/mask_cam1.png"].iter().for_each(|name| sample.mask(name, |_, _| 255));
    assert!(refuse(&sample).contains("several masks"), "{}", refuse(&sample));
}

#[test]
fn two_poses_of_one_image_are_reported() {
    let sample = samples::photos(4, |c| format!("cam{c}.png"), None);
    sample.edit("transforms.json", |v| v["frames"][3]["file_path"] = json!("images/cam1.png"));
    assert_said(&open(&sample), Aspect::Assumed, Severity::Warning, &["1 frames have the image", "cam1", "both have"]);
}

/// A COLMAP model of photos at `model`, and their images at `images`.
fn colmap_at(model: &str, images: &[&str]) -> Sample {
    let sample = samples::photos(9, |c| format!("_DSC{}.png", c + 8679), Some(&splat4d::math::Sim3::default()));
    std::fs::remove_file(sample.path("transforms.json")).unwrap();
    for folder in images.iter().filter(|f| **f != "images") {
        for image in rig::image_names(&sample.path("images")) {
            let half = image::ImageBuffer::from_fn(WIDTH as u32 / 2, HEIGHT as u32 / 2, |x, _| image::Luma([x as u8]));
            sample.save(&format!("{folder}/{image}"), half);
        }
    }
    if !images.contains(&"images") {
        std::fs::remove_dir_all(sample.path("images")).unwrap();
    }
    if model != "sparse/0" {
        std::fs::create_dir_all(sample.path(model)).unwrap();
        for name in ["cameras.txt", "images.txt", "points3D.txt"] {
            std::fs::rename(sample.path(&format!("sparse/0/{name}")), sample.path(model).join(name)).unwrap();
        }
        std::fs::remove_dir_all(sample.path(if model == "sparse" { "sparse/0" } else { "sparse" })).unwrap();
    }
    sample
}

#[test]
fn standard_folders_of_colmap_are_read() {
    for model in ["sparse/0", "sparse", "colmap/sparse/0", ".", "distorted/sparse/0"] {
        let sample = colmap_at(model, &["images"]);
        let named = [sample.root().to_owned(), sample.path(model)];
        for path in named.iter().skip(usize::from(model.starts_with("distorted"))) {
            let capture = read(path, &CaptureOptions::default());
            assert_eq!((capture.kind, capture.frames.len()), (CaptureKind::Colmap, 9), "{model}");
            assert!(capture.frames.iter().all(|f| f.image.is_file()) && capture.points.is_some());
        }
    }
    // Points as .ply alone.
    let sample = colmap_at("sparse/0", &["images"]);
    std::fs::remove_file(sample.path("sparse/0/points3D.txt")).unwrap();
    assert!(open(&sample).points.is_none());
    sample.write("sparse/0/points3D.ply", PLY.as_bytes());
    let capture = open(&sample);
    assert_eq!(capture.points.as_ref().unwrap().points.len(), 2);
    assert!(capture.notes.iter().any(|n| n.contains("2 initial points are those of a .ply")), "{:?}", capture.notes);
    // Images in a folder of another name; those of masks and depth are none.
    for folder in ["Images", "photos"] {
        let sample = colmap_at("sparse/0", &["images"]);
        std::fs::rename(sample.path("images"), sample.path(folder)).unwrap();
        let other = image::ImageBuffer::from_pixel(WIDTH as u32, HEIGHT as u32, image::Luma([9u8]));
        (0..9).for_each(|c| sample.save(&format!("depth/_DSC{}.png", c + 8679), other.clone()));
        let capture = open(&sample);
        assert!(capture.frames.len() == 9 && capture.frames.iter().all(|f| f.image.starts_with(sample.path(folder))));
        assert_said(&capture, Aspect::Assumed, Severity::Note, &["Images are those in", folder]);
    }
    // Mip-NeRF 360: reduced copies, and LLFF's poses next to the model.
    let sample = colmap_at("sparse/0", &["images", "images_2"]);
    std::fs::copy(samples::n3dv().path("poses_bounds.npy"), sample.path("poses_bounds.npy")).unwrap();
    let capture = open(&sample);
    assert_eq!((capture.kind, capture.frames.len(), capture.timing), (CaptureKind::Colmap, 9, Timing::Moment));
    assert!(
        capture.frames[0].image.starts_with(sample.path("images")) && capture.warnings.is_empty(),
        "{:?}",
        capture.warnings
    );
    let half = CaptureOptions { images: Some("images_2".into()), ..CaptureOptions::default() };
    for sample in [sample, colmap_at("sparse/0", &["images_2"])] {
        let capture = read(sample.root(), &half);
        let view = &capture.frames[3].view;
        assert_eq!((view.width, view.height, view.intrinsics.fx), (WIDTH / 2, HEIGHT / 2, FOCAL / 2.0));
        assert!(capture.warnings.is_empty() && capture.frames[3].image.starts_with(sample.path("images_2")));
        assert_said(&capture, Aspect::Assumed, Severity::Note, &["9 images", "12x8, not 24x16"]);
    }
    assert_eq!(open(&colmap_at("sparse/0", &["images_2"])).frames[0].view.width, WIDTH / 2);
}

#[test]
fn poses_bounds_without_camera_folders_is_llff() {
    let sample = samples::n3dv();
    for c in 0..2 {
        std::fs::remove_dir_all(sample.path(&format!("cam{c:02}"))).unwrap();
        sample.rgb(&format!("images/IMG_{c}.png"), c, 0);
        sample.rgb(&format!("images_4/image{c:03}.png"), c, 0);
    }
    let capture = open(&sample);
    assert_eq!((capture.kind, capture.frames.len(), capture.timing), (CaptureKind::Llff, 2, Timing::Moment));
    for (i, frame) in capture.frames.iter().enumerate() {
        let expected = Camera { cam_from_world: samples::pose(i), ..frame.source.clone() };
        assert!(same_pose(&frame.source, &expected) && frame.source.intrinsics.fx == FOCAL);
    }
    std::fs::remove_file(sample.path("images/IMG_1.png")).unwrap();
    std::fs::remove_dir_all(sample.path("images_4")).unwrap();
    assert!(refuse(&sample).contains("2 poses"), "{}", refuse(&sample));
}

#[test]
fn multiview_models_pose_the_folders_of_their_numbers() {
    let sample = samples::colmap_txt();
    let text = std::fs::read_to_string(sample.path("sparse/0/images.txt")).unwrap();
    std::fs::rename(sample.path("sparse/0"), sample.path("sparse_")).unwrap();
    std::fs::remove_dir(sample.path("sparse")).unwrap();
    let mut renamed = text;
    for c in 0..3 {
        renamed = renamed.replace(&format!("cam{c}/0000.png"), &format!("image{}.png", c + 1));
        std::fs::create_dir_all(sample.path(&format!("cam{:02}", c + 1))).unwrap();
        for t in 0..2 {
            let to = sample.path(&format!("cam{:02}/frame_{:05}.png", c + 1, t + 1));
            std::fs::rename(sample.path(&format!("images/cam{c}/{t:04}.png")), to).unwrap();
        }
    }
    std::fs::remove_dir_all(sample.path("images")).unwrap();
    sample.write("sparse_/images.txt", renamed.as_bytes());
    std::fs::remove_file(sample.path("sparse_/points3D.txt")).unwrap();
    sample.write("points3D_multipleview.ply", PLY.as_bytes());
    let capture = open(&sample);
    assert_eq!((capture.frames.len(), capture.cameras.len(), capture.fixed_cameras()), (6, 3, true));
    assert_eq!((capture.timing, capture.times().len()), (Timing::Numbers, 2));
    assert_eq!(capture.points.as_ref().unwrap().points.len(), 2);
    for (i, frame) in capture.frames.iter().enumerate() {
        let expected = Camera { cam_from_world: samples::pose(i / 2), ..frame.source.clone() };
        assert!(same_pose(&frame.source, &expected), "frame {i}");
    }
}

#[test]
fn images_without_lines_of_points_are_all_read() {
    let sample = samples::photos(9, |c| format!("cam{c:02}.png"), Some(&splat4d::math::Sim3::default()));
    let text = std::fs::read_to_string(sample.path("sparse/0/images.txt")).unwrap();
    let one_each: Vec<&str> = text.lines().filter(|l| !l.is_empty()).collect();
    sample.write("sparse/0/images.txt", one_each.join("\n").as_bytes());
    let capture = read(&sample.path("sparse"), &CaptureOptions::default());
    assert_eq!((capture.frames.len(), capture.warnings.len()), (9, 0), "{:?}", capture.warnings);
    // Names without endings are numbers, as coordinates of points are.
    let bare = |line: &&str| line.replace("cam0", "").replace(".png", "");
    (0..9).for_each(|c| {
        std::fs::rename(sample.path(&format!("images/cam{c:02}.png")), sample.path(&format!("images/{c}.png")))
            .unwrap();
    });
    sample.write("sparse/0/images.txt", one_each.iter().map(bare).collect::<Vec<_>>().join("\n").as_bytes());
    assert_eq!(read(&sample.path("sparse"), &CaptureOptions::default()).frames.len(), 9);
}

#[test]
fn unregistered_images_share_a_pose_in_rigs_alone() {
    let rig = open(&samples::colmap_txt());
    assert_eq!(rig.frames.len(), 6);
    assert_said(&rig, Aspect::Assumed, Severity::Note, &["3 of 6 images", "3 others share", "unregistered=leave"]);
    let sample = samples::colmap_txt();
    let mut text = std::fs::read_to_string(sample.path("sparse/0/images.txt")).unwrap();
    for (c, name) in ["left", "right", "third"].into_iter().enumerate() {
        std::fs::rename(sample.path(&format!("images/cam{c}")), sample.path(&format!("images/{name}"))).unwrap();
        text = text.replace(&format!("cam{c}/"), &format!("{name}/"));
    }
    sample.write("sparse/0/images.txt", text.as_bytes());
    let capture = open(&sample);
    assert_eq!(capture.frames.len(), 3);
    let parts = ["3 of 6 images", "3 have no pose", "left/0001.png", "unregistered=share"];
    assert_said(&capture, Aspect::NotFound, Severity::Warning, &parts);
    let told = CaptureOptions { unregistered: Unregistered::Share, ..CaptureOptions::default() };
    assert_eq!(read(sample.root(), &told).frames.len(), 6);
    let told = CaptureOptions { unregistered: Unregistered::Leave, ..CaptureOptions::default() };
    assert_eq!(read(samples::colmap_txt().root(), &told).frames.len(), 3);
}

#[test]
fn nerfstudios_frame_names_are_not_times() {
    let photos = open(&samples::photos(9, |c| format!("frame_{:05}.png", c + 1), None));
    assert_eq!((photos.timing, photos.cameras.len(), photos.warnings.len()), (Timing::Moment, 9, 0));
    assert!(photos.notes.iter().any(|n| n.contains("capture.sequence=video")));
    let film = open(&samples::photos(9, |c| format!("frame_{:04}.png", c + 1), None));
    assert_eq!(film.timing, Timing::Numbers);
}
