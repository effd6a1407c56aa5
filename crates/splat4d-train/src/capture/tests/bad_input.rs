//! Bad input: every error names the file, frame or camera and the remedy, in one paragraph.

use super::super::*;
use super::samples::{self, HEIGHT, Sample, WIDTH};
use serde_json::json;
use splat4d::ErrorKind;
use std::sync::Arc;

/// The message of opening the sample and, if that works, of loading its first image.
fn message(sample: &Sample) -> String {
    message_with(sample, &CaptureOptions::default())
}

fn message_with(sample: &Sample, options: &CaptureOptions) -> String {
    let capture = match Capture::open(sample.root(), options) {
        Ok(capture) => capture,
        Err(e) => return e.to_string(),
    };
    let store = ImageStore::new(Arc::new(capture), 1 << 20);
    store.load(0).expect_err("the capture must be refused").to_string()
}

/// Asserts that the message is one paragraph with all of `parts`.
pub(super) fn assert_says(message: &str, parts: &[&str]) {
    assert!(!message.contains('\n'), "one paragraph: {message}");
    for part in parts {
        assert!(message.contains(part), "\"{part}\" must be in: {message}");
    }
}

#[test]
fn no_capture_and_no_frames() {
    let empty = tempfile::tempdir().unwrap();
    let say = |path: &Path| Capture::open(path, &CaptureOptions::default()).unwrap_err().to_string();
    assert_says(&say(&empty.path().join("nowhere")), &["nowhere", "no such file"]);
    assert_says(&say(empty.path()), &["not a capture", "capture.json", "docs/capture-format.md"]);
    std::fs::write(empty.path().join("cam00.mp4"), b"").unwrap();
    assert_says(&say(empty.path()), &["videos", "ffmpeg -i cam00.mp4", "`splat4d import "]);
    let photos = tempfile::tempdir().unwrap();
    let folder = photos.path().join("my photos/cam 1");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("1.jpg"), b"").unwrap();
    let quoted = format!("`splat4d import '{}' -o TAKE`", folder.parent().unwrap().display());
    assert_says(&say(folder.parent().unwrap()), &["images, but no camera poses", &quoted]);
    std::fs::write(folder.join("cam 1.mp4"), b"").unwrap();
    assert_says(&say(&folder), &["ffmpeg -i 'cam 1.mp4'", "'images/cam 1/%06d.jpg'"]);
    std::fs::write(empty.path().join("sfm_data.json"), b"{}").unwrap();
    assert_says(&say(empty.path()), &["OpenMVG", "COLMAP"]);
    let sample = samples::own();
    sample.edit("capture.json", |v| v["cameras"] = json!([]));
    assert_says(&message(&sample), &["no frames"]);
    let sample = samples::dnerf();
    sample.edit("transforms_train.json", |v| v["frames"] = json!([]));
    assert_says(&message(&sample), &["transforms_train.json", "no frames"]);
}

#[test]
fn missing_and_truncated_images() {
    let sample = samples::own();
    for name in ["0005", "0006"] {
        std::fs::remove_file(sample.path(&format!("images/cam00/{name}.png"))).unwrap();
    }
    sample.edit("capture.json", |v| v["frames"] = json!(2));
    assert_says(&message(&sample), &["2 of 6 images", "images/cam00/0005.png", "Restore", "capture.max_missing=0.34"]);
    let sample = samples::own();
    std::fs::remove_file(sample.path("masks/cam01/0006.png")).unwrap();
    assert_says(&message(&sample), &["mask", "cam01", "0006.png"]);
    for name in ["images/cam00/0005.png", "images/a.jpg"] {
        let sample = samples::own();
        sample.write("images/a.jpg", include_bytes!("tiny.jpg"));
        if name.ends_with("jpg") {
            sample
                .edit("capture.json", |v| v["cameras"][0]["images"] = json!(["images/a.jpg", "images/cam00/0006.png"]));
        }
        let bytes = std::fs::read(sample.path(name)).unwrap();
        for keep in [0, 10, bytes.len() / 2, bytes.len() - if name.ends_with("png") { 40 } else { 1 }] {
            sample.write(name, &bytes[..keep]);
            assert_says(&message(&sample), &[name, if keep == 0 { "empty" } else { "truncated" }, "again"]);
        }
    }
}

#[test]
fn sizes_that_differ() {
    let sample = samples::own();
    sample.edit("capture.json", |v| v["cameras"][1]["width"] = json!(25));
    assert_says(&message(&sample), &["camera cam01", "0005.png", "24x16", "25x16"]);
    let sample = samples::own();
    let small = image::ImageBuffer::from_fn(8, 8, |_, _| image::Luma([255u8]));
    sample.save("masks/cam00/0005.png", small);
    assert_says(&message(&sample), &["masks/cam00/0005.png", "8x8", "24x16"]);
    let sample = samples::own();
    sample.edit("capture.json", |v| v["cameras"][0]["height"] = json!(4_000_000_000u64));
    assert_says(&message(&sample), &["cam00", "not possible"]);
    let sample = samples::own();
    let options = CaptureOptions { downscale: 17, ..CaptureOptions::default() };
    assert_says(&message_with(&sample, &options), &["24x16", "downscale 17"]);
    let options = CaptureOptions { downscale: 0, ..CaptureOptions::default() };
    assert_says(&message_with(&sample, &options), &["downscale is 0"]);
    let sample = samples::n3dv();
    let frame = image::ImageBuffer::from_fn(WIDTH as u32, 12, |_, _| image::Luma([255u8]));
    sample.save("cam01/images/0000.png", frame);
    assert_says(&message(&sample), &["cam01", "48x32", "24x12"]);
}

#[test]
fn bad_poses_and_focal_lengths() {
    let own = |change: fn(&mut serde_json::Value)| {
        let sample = samples::own();
        sample.edit("capture.json", |v| change(&mut v["cameras"][1]));
        message(&sample)
    };
    assert_says(&own(|c| c["fx"] = json!(0)), &["camera cam01", "focal length"]);
    assert_says(&own(|c| c["world_to_camera"][1][2] = json!(null)), &["cam01", "world_to_camera", "not finite"]);
    let mirrored = own(|c| {
        let row = c["world_to_camera"][0].clone();
        c["world_to_camera"][0] = c["world_to_camera"][1].clone();
        c["world_to_camera"][1] = row;
    });
    assert_says(&mirrored, &["cam01", "mirrored", "determinant −1", "OpenGL"]);
    assert_says(&own(|c| c["world_to_camera"][3][0] = json!(2.5)), &["cam01", "last row"]);
    let sample = samples::own();
    let text = std::fs::read_to_string(sample.path("capture.json")).unwrap().replace("\"fx\":20.0", "\"fx\":NaN");
    sample.write("capture.json", text.as_bytes());
    assert_says(&message(&sample), &["capture.json", "NaN"]);
    let sample = samples::dnerf();
    sample.edit("transforms_val.json", |v| {
        let rows = v["frames"][0]["transform_matrix"].as_array_mut().unwrap();
        rows.swap(0, 1);
    });
    assert_says(&message(&sample), &["transforms_val.json", "frames[0].transform_matrix", "mirrored"]);
    let sample = samples::colmap_bin();
    let mut bytes = std::fs::read(sample.path("sparse/0/images.bin")).unwrap();
    bytes[12..20].copy_from_slice(&f64::NAN.to_le_bytes());
    sample.write("sparse/0/images.bin", &bytes);
    assert_says(&message(&sample), &["cam0/0000.png", "NaN"]);
    let sample = samples::n3dv();
    let mut bytes = std::fs::read(sample.path("poses_bounds.npy")).unwrap();
    let start = bytes.len() - 17 * 8;
    bytes[start..start + 8].copy_from_slice(&f64::NAN.to_le_bytes());
    sample.write("poses_bounds.npy", &bytes);
    assert_says(&message(&sample), &["poses_bounds.npy", "row 1", "cam01", "NaN"]);
}

#[test]
fn duplicate_poses_and_times_are_reported() {
    let sample = samples::own();
    sample.edit("capture.json", |v| v["cameras"][2]["world_to_camera"] = v["cameras"][1]["world_to_camera"].clone());
    assert_says(&message(&sample), &["cam01 and cam02", "same pose"]);
    let sample = samples::nerfstudio();
    sample.edit("transforms.json", |v| v["frames"][1]["time"] = json!(0.0));
    assert_says(&message(&sample), &["cam0", "two images", "0000.png", "0001.png"]);
    let sample = samples::panoptic();
    sample.edit("train_meta.json", |v| v["cam_id"][0][1] = json!(1));
    let text = message(&sample);
    assert!(text.contains("two images"), "{text}");
    let sample = samples::own();
    sample.edit("capture.json", |v| v["cameras"][2]["name"] = json!("cam00"));
    assert_says(&message(&sample), &["cam00", "given twice"]);
}

#[test]
fn damaged_metadata() {
    let sample = samples::own();
    sample.edit("capture.json", |v| v["cameras"][0]["focal_x"] = json!(3));
    assert_says(&message(&sample), &["cameras[0]", "unknown key \"focal_x\""]);
    sample.edit("capture.json", |v| {
        v["cameras"][0].as_object_mut().unwrap().remove("focal_x");
        v["backgrond"] = json!([0, 0, 0]);
    });
    assert_says(&message(&sample), &["backgrond", "Did you mean \"background\"?"]);
    sample.edit("capture.json", |v| {
        v.as_object_mut().unwrap().remove("backgrond");
        v["cameras"][0]["masks"] = json!(["masks/cam00/0005.png"]);
        v["cameras"][0]["frames"] = json!(2);
    });
    assert_says(&message(&sample), &["cam00", "\"masks\" lists 1 files for 2 frames"]);
    sample.edit("capture.json", |v| v["version"] = json!(2));
    assert_says(&message(&sample), &["version is 2"]);
    for (name, sample) in samples::all() {
        for file in &sample.files {
            let bytes = std::fs::read(sample.path(file)).unwrap();
            for keep in [0, 3, bytes.len() / 2, bytes.len() - 2] {
                sample.write(file, &bytes[..keep]);
                // A text cut between two lines can still be a smaller capture.
                let text = match Capture::open(sample.root(), &CaptureOptions::default()) {
                    Err(e) => e.to_string(),
                    Ok(_) => {
                        assert!(file.ends_with(".txt") || file.ends_with(".ply"), "{name}: {file} cut at {keep}");
                        continue;
                    }
                };
                assert!(!text.contains('\n') && text.len() > 40, "{text}");
                let place = if file.ends_with(".txt") { "sparse" } else { file };
                assert!(text.contains(place) || text.contains("no frames"), "{name}: {file} cut at {keep}: {text}");
            }
            sample.write(file, &bytes);
        }
    }
}

#[test]
fn absurd_counts() {
    for name in ["cameras", "images", "points3D"] {
        let (file, sample) = (&format!("sparse/0/{name}.bin"), samples::colmap_bin());
        let mut bytes = std::fs::read(sample.path(file)).unwrap();
        bytes[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        sample.write(file, &bytes);
        assert_says(&message(&sample), &[file, "claims 18446744073709551615 entries", "truncated"]);
    }
    let sample = samples::own();
    sample.edit("capture.json", |v| v["frames"] = json!(1_000_000_000_000u64));
    assert_says(&message(&sample), &["cam00", "0107.png", "frame 102", "missing", "\"frames\""]);
    let sample = samples::own();
    let ply = std::fs::read_to_string(sample.path("points.ply")).unwrap().replace("vertex 2", "vertex 99999999999");
    sample.write("points.ply", ply.as_bytes());
    assert_says(&message(&sample), &["points.ply", "claims 99999999999 rows"]);
    // A PNG header that claims 60000x60000 pixels.
    let sample = samples::own();
    let mut png = std::fs::read(sample.path("images/cam00/0005.png")).unwrap();
    png[16..20].copy_from_slice(&60000u32.to_be_bytes());
    png[20..24].copy_from_slice(&60000u32.to_be_bytes());
    sample.write("images/cam00/0005.png", &png);
    assert!(message(&sample).contains("0005.png"));
}

#[test]
fn masks_that_exclude_everything() {
    let sample = samples::own();
    for (c, t) in (0..3).flat_map(|c| (5..7).map(move |t| (c, t))) {
        sample.mask(&format!("masks/cam{c:02}/{t:04}.png"), |_, _| 0);
    }
    assert_says(&message(&sample), &["masks", "exclude everything", "invert"]);
    sample.mask("masks/cam02/0006.png", |x, _| if x == 0 { 255 } else { 0 });
    assert!(Capture::open(sample.root(), &CaptureOptions::default()).is_ok(), "one foreground pixel is enough");
    let sample = samples::dnerf();
    for name in ["train/r_000", "train/r_001", "train/r_002", "val/r_000", "test/r_000"] {
        sample.rgba(&format!("{name}.png"), |_, _| [9, 9, 9, 0]);
    }
    assert_says(&message(&sample), &["exclude everything"]);
}

#[test]
fn missing_files_of_a_layout_are_named() {
    let sample = samples::n3dv();
    std::fs::remove_dir_all(sample.path("cam01")).unwrap();
    // With numbers in names the rows are known, and what is missing is noted; without, nothing states whose poses are whose.
    std::fs::rename(sample.path("cam00"), sample.path("front")).unwrap();
    assert_says(&message(&sample), &["2 cameras", "1 folders"]);
    sample.write("cam01.mp4", b"");
    assert_says(&message(&sample), &["1 videos are not extracted", "ffmpeg -i cam01.mp4"]);
    let sample = samples::colmap_txt();
    let text = std::fs::read_to_string(sample.path("sparse/0/cameras.txt")).unwrap();
    sample
        .write("sparse/0/cameras.txt", text.replace("2 OPENCV", "2 SPLINED").replace("-0.001", "0 0 0 0 0").as_bytes());
    let error = Capture::open(sample.root(), &CaptureOptions::default()).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Unsupported);
    assert_says(&error.to_string(), &["SPLINED", "image_undistorter"]);
    let hold = CaptureOptions { hold_out: Some("camera=left".parse().unwrap()), ..CaptureOptions::default() };
    assert_says(&message_with(&samples::own(), &hold), &["left", "cam00, cam01, cam02"]);
    let all = CaptureOptions { hold_out: Some("camera=0,1,2".parse().unwrap()), ..CaptureOptions::default() };
    assert_says(&message_with(&samples::own(), &all), &["every frame is held out"]);
    assert_eq!((WIDTH, HEIGHT), (24, 16));
}
