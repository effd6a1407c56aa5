//! Known flow on disk.

use super::bad_input::assert_says;
use super::samples::{self, FOCAL, HEIGHT, Sample, WIDTH};
use crate::capture::lens::Distortion;
use crate::capture::{Capture, CaptureOptions, ImageStore};
use image::{ImageBuffer, Rgb};
use serde_json::json;
use splat4d::scene::{Lens, Planes};
use std::sync::Arc;

const FLOW: &str = "flow/cam01/0005.png";

/// Camera 1 has flow; the last frame has none and needs no file.
fn sample(way: impl Fn(f64, f64) -> Option<[f64; 2]>) -> Sample {
    let sample = samples::own();
    let code = |v: f64| (v * 64.0 + 32768.0).round() as u16;
    let pixel = |x: u32, y: u32| {
        way(f64::from(x) + 0.5, f64::from(y) + 0.5).map_or(Rgb([0, 0, 0]), |[u, v]| Rgb([code(u), code(v), 1]))
    };
    sample.save(FLOW, ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, pixel));
    sample.edit("capture.json", |v| v["cameras"][1]["flow"] = json!("flow/cam01/%04d.png"));
    sample
}

fn open(sample: &Sample, downscale: usize) -> splat4d::Result<Arc<Capture>> {
    Capture::open(sample.root(), &CaptureOptions { downscale, ..CaptureOptions::default() }).map(Arc::new)
}

fn load(capture: &Arc<Capture>, frame: usize) -> Option<Planes<f32>> {
    ImageStore::new(capture.clone(), 1 << 20).load(frame).unwrap().to_picture().flow
}

#[test]
fn vectors_are_read_where_they_are_known() {
    let sample = sample(|x, y| (x < 20.0).then_some([0.25 * x, -3.5 + y]));
    let capture = open(&sample, 1).unwrap();
    let flow = capture.frames[2].flow.clone().unwrap();
    assert_eq!((flow.path, flow.to), (sample.path(FLOW), 3));
    assert!(capture.frames.iter().enumerate().all(|(i, f)| f.flow.is_some() == (i == 2)));
    assert!(load(&capture, 0).is_none() && load(&capture, 3).is_none());
    let vectors = load(&capture, 2).unwrap();
    assert_eq!((vectors.channels, vectors.height, vectors.width), (3, HEIGHT, WIDTH));
    for (x, y) in [(0, 0), (7, 3), (19, 15)] {
        let expected = [0.25 * (x as f32 + 0.5), -3.0 + y as f32, 1.0];
        for c in 0..3 {
            assert!(
                (vectors.get(c, y, x) - expected[c]).abs() < 0.5 / 64.0,
                "{c} at {x} {y}: {}",
                vectors.get(c, y, x)
            );
        }
    }
    assert_eq!([0, 1, 2].map(|c| vectors.get(c, 4, 21)), [0.0; 3], "unknown is nothing at all");
    // Two pixels become one that is twice as large; half known is unknown.
    let sample = self::sample(|x, y| (x < 19.0).then_some([0.25 * x, -3.5 + y]));
    let half = load(&open(&sample, 2).unwrap(), 2).unwrap();
    assert_eq!((half.height, half.width), (HEIGHT / 2, WIDTH / 2));
    assert!((half.get(0, 2, 3) - 0.125 * 7.0).abs() < 1.0 / 64.0 && (half.get(1, 2, 3) - 0.75).abs() < 1.0 / 64.0);
    assert_eq!([8, 9, 10].map(|x| half.get(2, 3, x)), [1.0, 0.0, 0.0]);
}

#[test]
fn flow_is_undistorted_with_its_image() {
    // Rays move by a constant on the pinhole's image; the distorted image shows something else.
    let lens = Lens::Brown { k: [-0.2, 0.03, 0.0, 0.0, 0.0, 0.0], p: [2e-3, -1e-3], s: [0.0; 4] };
    let distortion = Distortion::new(lens);
    let ray = |x: f64, y: f64| [(x - 12.0) / FOCAL, (y - 8.0) / FOCAL];
    let sample = sample(|x, y| {
        let from = distortion.undistort(ray(x, y))?;
        let [u, v] = distortion.distort([from[0] + 1.5 / FOCAL, from[1] - 0.75 / FOCAL])?;
        Some([FOCAL * u + 12.0 - x, FOCAL * v + 8.0 - y])
    });
    let distorted = load(&open(&sample, 1).unwrap(), 2).unwrap();
    sample.edit("capture.json", |v| {
        v["cameras"][1]["distortion"] = json!({"model": "opencv", "k": [-0.2, 0.03], "p": [0.002, -0.001]});
    });
    let straight = load(&open(&sample, 1).unwrap(), 2).unwrap();
    let (mut known, mut worst, mut before) = (0, 0.0f32, 0.0f32);
    for p in 0..WIDTH * HEIGHT {
        if straight.plane(2)[p] > 0.0 {
            known += 1;
            worst = worst.max((straight.plane(0)[p] - 1.5).abs()).max((straight.plane(1)[p] + 0.75).abs());
            before = before.max((distorted.plane(0)[p] - 1.5).abs());
        }
    }
    assert!(known > WIDTH * HEIGHT / 2, "{known} pixels");
    // The vector of the nearest pixel, half a pixel away, in code of 1/64 px.
    assert!(worst < 0.05 && before > 2.0 * worst, "off by {worst} px, {before} px without the lens");
}

#[test]
fn invalid_flow_is_refused() {
    let message = |sample: &Sample| match open(sample, 1) {
        Err(e) => e.to_string(),
        Ok(capture) => ImageStore::new(capture, 1 << 20).load(2).unwrap_err().to_string(),
    };
    let sample = sample(|_, _| Some([0.0; 2]));
    let good = std::fs::read(sample.path(FLOW)).unwrap();
    std::fs::remove_file(sample.path(FLOW)).unwrap();
    assert_says(&message(&sample), &["flow", "cam01", "frame 0", "0005.png", "Restore"]);
    sample.save(FLOW, ImageBuffer::from_fn(8, 8, |_, _| Rgb([0u16; 3])));
    assert_says(&message(&sample), &["0005.png", "8x8", "24x16"]);
    sample.rgb(FLOW, 0, 0);
    assert_says(&message(&sample), &["0005.png", "8 bits", "16-bit RGB"]);
    sample.save(FLOW, ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, |_, _| image::Luma([0u16])));
    assert_says(&message(&sample), &["0005.png", "1 channels", "16-bit RGB"]);
    sample.write(FLOW, &good[..good.len() / 2]);
    assert_says(&message(&sample), &["0005.png", "truncated"]);
    sample.write(FLOW, &good);
    // A list needs no file for the last frame.
    sample.edit("capture.json", |v| v["cameras"][1]["flow"] = json!([FLOW]));
    let capture = open(&sample, 1).unwrap();
    assert!(load(&capture, 2).unwrap().plane(2).iter().all(|&v| v == 1.0));
    sample.edit("capture.json", |v| (v["cameras"][1]["flow"], v["frames"]) = (json!([]), json!(2)));
    assert_says(&message(&sample), &["\"flow\" lists 0 files"]);
    sample.edit("capture.json", |v| v["cameras"][1]["flow"] = json!("flow.png"));
    assert_says(&message(&sample), &["flow.png", "%04d"]);
}

/// The flow file of frame 0 of camera 1, with this ending, listed.
fn write_other(sample: &Sample, ending: &str, bytes: &[u8]) {
    let name = format!("flow/cam01/0005.{ending}");
    sample.write(&name, bytes);
    sample.edit("capture.json", |v| v["cameras"][1]["flow"] = json!([name]));
}

fn flo(mark: f32, vectors: &[[f32; 2]]) -> Vec<u8> {
    let size = [WIDTH, HEIGHT].map(|s| (s as i32).to_le_bytes()).concat();
    let numbers: Vec<u8> = vectors.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    [mark.to_le_bytes().to_vec(), size, numbers].concat()
}

#[test]
fn flo_and_npy_are_read_as_images_are() {
    let sample = sample(|_, _| Some([0.0; 2]));
    let mut vectors = vec![[1.5f32, -2.25]; WIDTH * HEIGHT];
    vectors[3] = [1e10, 1e10];
    vectors[4] = [4000.0, 0.0];
    write_other(&sample, "flo", &flo(202_021.25, &vectors));
    let flow = load(&open(&sample, 1).unwrap(), 2).unwrap();
    assert_eq!([0, 3, 4].map(|p| flow.plane(2)[p]), [1.0, 0.0, 0.0], "not known, and too far for the code");
    assert_eq!([flow.plane(0)[9], flow.plane(1)[9]], [1.5, -2.25]);
    let npy = |shape: &[usize], values: &[f32]| {
        let mut bytes = Vec::new();
        splat4d::format::npy::write_f32(shape, values, &mut bytes).unwrap();
        bytes
    };
    let together: Vec<f32> = vectors.iter().flat_map(|[u, v]| [*u, *v, 1.0]).collect();
    let apart: Vec<f32> = [0, 1].iter().flat_map(|&c| vectors.iter().map(move |v| v[c])).collect();
    for bytes in [npy(&[HEIGHT, WIDTH, 3], &together), npy(&[2, HEIGHT, WIDTH], &apart)] {
        write_other(&sample, "npy", &bytes);
        assert_eq!(load(&open(&sample, 1).unwrap(), 2).unwrap(), flow);
    }
    let message = |sample: &Sample| ImageStore::new(open(sample, 1).unwrap(), 1 << 20).load(2).unwrap_err().to_string();
    write_other(&sample, "npy", &npy(&[HEIGHT * WIDTH, 2, 1], &[0.0; 2 * WIDTH * HEIGHT]));
    assert_says(&message(&sample), &["cam01", "frame 0", "0005.npy", "[height, width, 2]"]);
    write_other(&sample, "npy", &npy(&[WIDTH, HEIGHT, 2], &[0.0; 2 * WIDTH * HEIGHT]));
    assert_says(&message(&sample), &["0005.npy", "16x24", "24x16"]);
    vectors[WIDTH + 2] = [f32::NAN, 0.0];
    write_other(&sample, "flo", &flo(202_021.25, &vectors));
    assert_says(&message(&sample), &["cam01", "frame 0", "0005.flo", "(2, 1) is not a number"]);
    write_other(&sample, "flo", &flo(1.0, &vectors));
    assert_says(&message(&sample), &["0005.flo", "202021.25"]);
    write_other(&sample, "flo", &flo(202_021.25, &vectors)[..200]);
    assert_says(&message(&sample), &["0005.flo", "cut short"]);
    write_other(&sample, "flo", b"PIEH");
    assert_says(&message(&sample), &["0005.flo", "cut short"]);
}
