//! Depth maps on disk.

use super::bad_input::assert_says;
use super::samples::{self, HEIGHT, Sample, WIDTH};
use crate::capture::{Capture, CaptureOptions, DepthKind, ImageStore};
use image::{ImageBuffer, Luma};
use serde_json::json;
use splat4d::format::npy;
use splat4d::scene::Planes;
use std::sync::Arc;

fn open(sample: &Sample, downscale: usize) -> splat4d::Result<Arc<Capture>> {
    Capture::open(sample.root(), &CaptureOptions { downscale, ..CaptureOptions::default() }).map(Arc::new)
}

fn load(sample: &Sample, downscale: usize, frame: usize) -> splat4d::Result<Option<(Planes<f32>, DepthKind)>> {
    Ok(ImageStore::new(open(sample, downscale)?, 1 << 20).load(frame)?.to_picture().depth)
}

/// Names of the maps of camera 1, as this ending has them.
fn name(frame: usize, ending: &str) -> String {
    format!("depth/cam01/{:04}.{ending}", 5 + frame)
}

/// Camera 1 has depth of 16 bits: 1000 + 10 x + y codes, nothing in the last column.
fn sample() -> Sample {
    let sample = samples::own();
    for frame in 0..2 {
        let code = |x: u32, y: u32| Luma([if x as usize == WIDTH - 1 { 0 } else { (1000 + 10 * x + y) as u16 }]);
        sample.save(&name(frame, "png"), ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, code));
    }
    sample.edit("capture.json", |v| {
        v["cameras"][1]["depth"] = json!("depth/cam01/%04d.png");
        v["cameras"][1]["depth_scale"] = json!(0.001);
    });
    sample
}

fn write_npy(sample: &Sample, shape: &[usize], values: &[f32]) {
    let mut bytes = Vec::new();
    npy::write_f32(shape, values, &mut bytes).unwrap();
    (0..2).for_each(|frame| sample.write(&name(frame, "npy"), &bytes));
    sample.edit("capture.json", |v| v["cameras"][1]["depth"] = json!("depth/cam01/%04d.npy"));
}

#[test]
fn maps_are_read_in_scene_units_and_reduced_on_one_surface_only() {
    let sample = sample();
    let (depth, kind) = load(&sample, 1, 2).unwrap().unwrap();
    assert_eq!((kind, depth.width, depth.height), (DepthKind::Metric, WIDTH, HEIGHT));
    assert!((depth.get(0, 3, 7) - 1.073).abs() < 1e-6);
    assert_eq!(depth.get(0, 3, WIDTH - 1), 0.0, "not known");
    assert!(load(&sample, 1, 0).unwrap().is_none(), "camera 0 has none");
    let (half, _) = load(&sample, 2, 2).unwrap().unwrap();
    assert!((half.get(0, 1, 3) - 1.0675).abs() < 1e-6 && half.get(0, 1, WIDTH / 2 - 1) == 0.0);
    // An edge between a near and a far surface is no surface's depth.
    let edge: Vec<f32> = (0..WIDTH * HEIGHT).map(|p| if p % WIDTH < 7 { 1.0 } else { 3.0 }).collect();
    write_npy(&sample, &[HEIGHT, WIDTH], &edge);
    sample.edit("capture.json", |v| v["cameras"][1]["depth_scale"] = json!(2.0));
    let (half, _) = load(&sample, 2, 2).unwrap().unwrap();
    assert_eq!([2, 3, 4].map(|x| half.get(0, 1, x)), [2.0, 0.0, 6.0]);
    // A sensor's map is smaller; its pixels are repeated.
    let small: Vec<f32> = (0..WIDTH * HEIGHT / 4).map(|p| 1.0 + p as f32).collect();
    write_npy(&sample, &[HEIGHT / 2, WIDTH / 2], &small);
    let (depth, _) = load(&sample, 1, 2).unwrap().unwrap();
    assert_eq!(depth.get(0, 5, 9), 2.0 * (1.0 + (2 * WIDTH / 2 + 4) as f32));
    // Up to scale and shift, with no scale to state.
    sample.edit("capture.json", |v| {
        v["cameras"][1]["depth_scale"] = json!(null);
        v["depth_kind"] = json!("inverse");
    });
    assert_eq!(load(&sample, 1, 2).unwrap().unwrap().1, DepthKind::Inverse);
}

#[test]
fn openexr_is_read_by_its_depth_channel() {
    use exr::prelude::*;
    let sample = sample();
    let size = Vec2(WIDTH, HEIGHT);
    let z: Vec<f32> = (0..WIDTH * HEIGHT).map(|p| if p == 0 { 1e10 } else { 1.0 + p as f32 }).collect();
    let channel = |name: &str, values: Vec<f32>| AnyChannel::new(name, FlatSamples::F32(values));
    let write = |channels: Vec<AnyChannel<FlatSamples>>| {
        let layer = Layer::new(
            size,
            LayerAttributes::named("depth"),
            Encoding::SMALL_LOSSLESS,
            AnyChannels::sort(channels.into_iter().collect()),
        );
        for frame in 0..2 {
            let mut bytes = std::io::Cursor::new(Vec::new());
            Image::from_layer(layer.clone()).write().non_parallel().to_buffered(&mut bytes).unwrap();
            sample.write(&name(frame, "exr"), &bytes.into_inner());
        }
    };
    write(vec![channel("A", vec![1.0; z.len()]), channel("Z", z.clone())]);
    sample.edit("capture.json", |v| {
        v["cameras"][1]["depth"] = json!("depth/cam01/%04d.exr");
        v["cameras"][1]["depth_scale"] = json!(1.0);
    });
    let (depth, _) = load(&sample, 1, 2).unwrap().unwrap();
    assert_eq!((depth.data[0], depth.data[9]), (0.0, 10.0), "10¹⁰ is where nothing is");
    write(vec![channel("A", z.clone()), channel("N", z)]);
    assert_says(&load(&sample, 1, 2).unwrap_err().to_string(), &["cam01", "0005.exr", "A, N", "channel Z"]);
    sample.write(&name(0, "exr"), b"\x76\x2f\x31\x01 and no more");
    assert_says(&load(&sample, 1, 2).unwrap_err().to_string(), &["cam01", "frame 0", "0005.exr", "OpenEXR"]);
}

/// Places of "i32 right, i32 bottom" of the data window and the display window of an OpenEXR file.
fn windows(bytes: &[u8]) -> Vec<usize> {
    let name = b"Window\0box2i\0\x10\0\0\0";
    (0..bytes.len() - name.len()).filter(|&at| bytes[at..].starts_with(name)).map(|at| at + name.len() + 8).collect()
}

#[test]
fn sizes_are_compared_with_the_image_before_decoding() {
    use exr::prelude::*;
    let sample = sample();
    let mut bytes = std::io::Cursor::new(Vec::new());
    let channel = AnyChannel::new("Z", FlatSamples::F32(vec![1.0; WIDTH * HEIGHT]));
    let channels = AnyChannels::sort([channel].into_iter().collect());
    let layer = Layer::new((WIDTH, HEIGHT), LayerAttributes::named("depth"), Encoding::SMALL_LOSSLESS, channels);
    Image::from_layer(layer).write().non_parallel().to_buffered(&mut bytes).unwrap();
    let mut bytes = bytes.into_inner();
    let places = windows(&bytes);
    assert_eq!(places.len(), 2, "data and display window");
    // A width of 2²⁹ would take 2 GB a scan line.
    places.iter().for_each(|&at| bytes[at..at + 4].copy_from_slice(&(1i32 << 29).to_le_bytes()));
    (0..2).for_each(|frame| sample.write(&name(frame, "exr"), &bytes));
    sample.edit("capture.json", |v| v["cameras"][1]["depth"] = json!("depth/cam01/%04d.exr"));
    assert_says(&load(&sample, 1, 2).unwrap_err().to_string(), &["0005.exr", "536870913x", "its image"]);
    // The same for PNG.
    let mut png = std::io::Cursor::new(Vec::new());
    let side = 9 * WIDTH as u32;
    ImageBuffer::<Luma<u16>, _>::new(side, 1).write_to(&mut png, image::ImageFormat::Png).unwrap();
    (0..2).for_each(|frame| sample.write(&name(frame, "png"), png.get_ref()));
    sample.edit("capture.json", |v| v["cameras"][1]["depth"] = json!("depth/cam01/%04d.png"));
    assert_says(&load(&sample, 1, 2).unwrap_err().to_string(), &["0005.png", "its image", "8 times"]);
}

#[test]
fn nerfstudio_maps_are_thousandths() {
    let sample = samples::nerfstudio();
    let map = ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, |_, _| Luma([2500u16]));
    sample.save("depth/0.png", map);
    sample.edit("transforms.json", |v| v["frames"][0]["depth_file_path"] = json!("depth/0.png"));
    let (depth, kind) = load(&sample, 1, 0).unwrap().unwrap();
    assert_eq!((kind, depth.data[5]), (DepthKind::Metric, 2.5));
    sample.edit("transforms.json", |v| v["depth_unit_scale_factor"] = json!(0.01));
    assert_eq!(load(&sample, 1, 0).unwrap().unwrap().0.data[5], 25.0);
    sample.edit("transforms.json", |v| v["depth_unit_scale_factor"] = json!(-1));
    assert_says(&open(&sample, 1).unwrap_err().to_string(), &["depth_unit_scale_factor is -1"]);
}

#[test]
fn invalid_depth_maps_are_refused_by_file_and_frame() {
    let message = |sample: &Sample| match load(sample, 1, 2) {
        Err(e) => e.to_string(),
        Ok(depth) => panic!("{depth:?} is read"),
    };
    let all = |value: f32| vec![value; WIDTH * HEIGHT];
    let sample = sample();
    std::fs::remove_file(sample.path(&name(0, "png"))).unwrap();
    assert_says(&message(&sample), &["depth", "cam01", "frame 0", "0005.png", "Restore"]);
    let mut values = all(2.0);
    values[WIDTH + 3] = f32::NAN;
    write_npy(&sample, &[HEIGHT, WIDTH], &values);
    assert_says(&message(&sample), &["cam01", "frame 0", "0005.npy", "(3, 1) is NaN", "Write 0"]);
    values[WIDTH + 3] = -1.0;
    write_npy(&sample, &[HEIGHT, WIDTH], &values);
    assert_says(&message(&sample), &["0005.npy", "(3, 1) is -0.001"]);
    write_npy(&sample, &[HEIGHT, WIDTH], &all(0.0));
    assert_says(&message(&sample), &["0005.npy", "depth map is empty"]);
    write_npy(&sample, &[WIDTH, HEIGHT], &all(2.0));
    assert_says(&message(&sample), &["0005.npy", "16x24", "24x16"]);
    write_npy(&sample, &[2, HEIGHT, WIDTH / 2], &all(2.0));
    assert_says(&message(&sample), &["0005.npy", "[2, 16, 12]", "one map a file"]);
    sample.write(&name(0, "npy"), b"\x93NUMPY");
    assert_says(&message(&sample), &["cam01", "frame 0", "0005.npy"]);
    sample.edit("capture.json", |v| v["cameras"][1]["depth"] = json!("depth/cam01/%04d.png"));
    sample.mask(&name(0, "png"), |_, _| 9);
    assert_says(&message(&sample), &["0005.png", "8 bits, not 16"]);
    sample.rgb(&name(0, "png"), 0, 0);
    assert_says(&message(&sample), &["0005.png", "3 channels"]);
    sample.edit("capture.json", |v| v["cameras"][1]["depth_scale"] = json!(null));
    assert_says(&message(&sample), &["cam01", "depth_scale"]);
    sample.edit("capture.json", |v| v["cameras"][1]["depth_scale"] = json!(-2));
    assert_says(&message(&sample), &["cam01", "depth_scale -2"]);
    sample.edit("capture.json", |v| v["cameras"][1]["depth_kind"] = json!("metres"));
    assert_says(&message(&sample), &["cam01", "metres", "inverse"]);
    sample.edit("capture.json", |v| {
        v["cameras"][1]["depth_kind"] = json!(null);
        v["cameras"][1]["depth_scale"] = json!(1);
        v["cameras"][1]["depth"] = json!(["a.png"]);
        v["frames"] = json!(2);
    });
    assert_says(&message(&sample), &["\"depth\" lists 1 files for 2 frames"]);
}
