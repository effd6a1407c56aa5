//! Masks of labels on disk.

use super::bad_input::assert_says;
use super::samples::{self, HEIGHT, Sample, WIDTH};
use crate::capture::labels::{UNKNOWN, read};
use crate::capture::{Capture, CaptureOptions};
use image::{ImageBuffer, Luma};
use serde_json::json;

const MASK: &str = "labels/cam01/0005.png";

/// Camera 1 has masks of two labels: the left half is 0, the right half 1, the first row is unknown.
fn sample() -> Sample {
    let sample = samples::own();
    for name in [MASK, "labels/cam01/0006.png"] {
        sample.mask(name, |x, y| if y == 0 { 255 } else { u8::from(x >= WIDTH as u32 / 2) });
    }
    sample.edit("capture.json", |v| {
        v["labels"] = json!(["floor", "hand"]);
        v["cameras"][1]["labels"] = json!("labels/cam01/%04d.png");
    });
    sample
}

fn open(sample: &Sample, downscale: usize) -> splat4d::Result<Capture> {
    Capture::open(sample.root(), &CaptureOptions { downscale, ..CaptureOptions::default() })
}

#[test]
fn mask_values_are_label_numbers_and_the_largest_is_unlabelled() {
    let sample = sample();
    let capture = open(&sample, 1).unwrap();
    assert_eq!(capture.labels, ["floor", "hand"]);
    assert!(capture.frames.iter().enumerate().all(|(i, f)| f.labels.is_some() == (i == 2 || i == 3)));
    assert_eq!(read(&capture.frames[0], &capture).unwrap(), None);
    let labels = read(&capture.frames[2], &capture).unwrap().unwrap();
    let at = |x: usize, y: usize| labels[y * WIDTH + x];
    assert_eq!([at(3, 0), at(11, 1), at(12, 1), at(23, 15)], [UNKNOWN, 0, 1, 1]);
    // A pixel of four that do not agree has no label.
    let half = read(&open(&sample, 2).unwrap().frames[2], &open(&sample, 2).unwrap()).unwrap().unwrap();
    assert_eq!((half.len(), half[0], half[WIDTH / 2 + 5], half[WIDTH / 2 + 6]), (WIDTH * HEIGHT / 4, UNKNOWN, 0, 1));
    // The same in 16 bits.
    let wide = ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, |x, _| Luma([if x == 0 { u16::MAX } else { 1 }]));
    sample.save(MASK, wide);
    let labels = read(&capture.frames[2], &capture).unwrap().unwrap();
    assert_eq!(labels[..2], [UNKNOWN, 1]);
}

#[test]
fn invalid_labels_are_named() {
    let sample = sample();
    let say = |sample: &Sample| {
        let capture = match open(sample, 1) {
            Ok(capture) => capture,
            Err(e) => return e.to_string(),
        };
        read(&capture.frames[2], &capture).unwrap_err().to_string()
    };
    sample.mask(MASK, |x, y| if (x, y) == (7, 4) { 9 } else { 0 });
    assert_says(&say(&sample), &["camera cam01, frame 0", "0005.png", "pixel (7, 4) has label 9", "names 2"]);
    sample.save(MASK, ImageBuffer::from_pixel(10, 10, Luma([0u8])));
    assert_says(&say(&sample), &["camera cam01, frame 0", "10x10", "24x16"]);
    sample.rgb(MASK, 1, 0);
    assert_says(&say(&sample), &["in colour", "0005.png"]);
    std::fs::remove_file(sample.path(MASK)).unwrap();
    assert_says(&say(&sample), &["mask of labels", "cam01", "0005.png"]);
    sample.edit("capture.json", |v| v["labels"] = json!(["floor", "floor"]));
    assert_says(&say(&sample), &["label 1", "floor"]);
    sample.edit("capture.json", |v| drop(v.as_object_mut().unwrap().remove("labels")));
    assert_says(&say(&sample), &["cam01", "no names", "labels"]);
}
