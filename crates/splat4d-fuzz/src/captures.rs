//! Files of captures: one of a sound capture's files holds the bytes, and the capture is opened.

use crate::Reader;
use image::{ImageBuffer, ImageFormat, Luma, Rgb};
use serde_json::json;
use splat4d::format::npy;
use splat4d_train::capture::{Capture, CaptureOptions, ImageStore, Rgb8};
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;
use std::sync::Arc;
use tempfile::TempDir;

pub(crate) const READERS: &[Reader] = &[
    Reader { name: "capture_json", seeds: || vec![own().into()], read: |b| open("own", "capture.json", b) },
    Reader {
        name: "transforms_json",
        seeds: || vec![transforms().into()],
        read: |b| open("nerf", "transforms.json", b),
    },
    Reader {
        name: "panoptic_json",
        seeds: || vec![panoptic().into()],
        read: |b| open("panoptic", "train_meta.json", b),
    },
    Reader { name: "poses_bounds", seeds: || vec![poses_bounds()], read: |b| open("n3dv", "poses_bounds.npy", b) },
    Reader { name: "colmap_cameras", seeds: || vec![cameras()], read: |b| open("colmap", "sparse/0/cameras.bin", b) },
    Reader { name: "colmap_images", seeds: || vec![images()], read: |b| open("colmap", "sparse/0/images.bin", b) },
    Reader { name: "colmap_points", seeds: || vec![points()], read: |b| open("colmap", "sparse/0/points3D.bin", b) },
    Reader { name: "depth_exr", seeds: || vec![exr()], read: |b| open("exr", "depth.exr", b) },
    Reader { name: "depth_png", seeds: || vec![depth_png()], read: |b| open("png", "depth.png", b) },
    Reader { name: "picture", seeds: pictures, read: |b| drop(Rgb8::decode(b, Path::new("picture"))) },
];

const WIDTH: u32 = 8;
const HEIGHT: u32 = 6;

thread_local! {
    /// A folder for each layout, made when it is first asked for.
    static FOLDERS: RefCell<BTreeMap<&'static str, TempDir>> = const { RefCell::new(BTreeMap::new()) };
}

/// Opens the capture of this layout in which one file has other bytes, and reads its first picture with what lies beside.
fn open(layout: &'static str, file: &str, bytes: &[u8]) {
    FOLDERS.with_borrow_mut(|folders| {
        let folder = folders.entry(layout).or_insert_with(|| made(layout));
        write(folder.path(), file, bytes);
        if let Ok(capture) = Capture::open(folder.path(), &CaptureOptions::default()) {
            let store = ImageStore::new(Arc::new(capture), 1 << 20);
            let _ = store.load(0);
        }
    });
}

fn write(folder: &Path, file: &str, bytes: &[u8]) {
    let path = folder.join(file);
    std::fs::create_dir_all(path.parent().expect("it lies in the folder")).expect("the folder can be made");
    std::fs::write(path, bytes).expect("the disk takes a file");
}

fn made(layout: &str) -> TempDir {
    let folder = tempfile::tempdir().expect("there is a place for temporary files");
    let put = |file: &str, bytes: &[u8]| write(folder.path(), file, bytes);
    for name in ["images/0.png", "images/1.png", "cam00/images/0000.png", "cam01/images/0000.png", "ims/0/0.png"] {
        put(name, &png());
    }
    match layout {
        "own" => put("capture.json", own().as_bytes()),
        "nerf" => put("transforms.json", transforms().as_bytes()),
        "panoptic" => put("train_meta.json", panoptic().as_bytes()),
        "n3dv" => put("poses_bounds.npy", &poses_bounds()),
        "colmap" => {
            put("sparse/0/cameras.bin", &cameras());
            put("sparse/0/images.bin", &images());
            put("sparse/0/points3D.bin", &points());
        }
        ending => {
            put("depth.exr", &exr());
            put("depth.png", &depth_png());
            let depth = format!("\"depth\":\"depth.{ending}\",\"name\"");
            put("capture.json", own().replacen("\"name\"", &depth, 1).as_bytes());
        }
    }
    folder
}

const POSE: [[f64; 4]; 4] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]];

fn own() -> String {
    let camera = json!({
        "name": "a", "width": WIDTH, "height": HEIGHT, "fx": 8.0, "fy": 8.0, "cx": 4.0, "cy": 3.0,
        "world_to_camera": POSE, "images": "images/%d.png", "time_offset": 0.01,
    });
    json!({"fps": 30, "cameras": [camera]}).to_string()
}

fn transforms() -> String {
    let frame =
        |i: u32| json!({"file_path": format!("images/{i}.png"), "transform_matrix": POSE, "time": f64::from(i)});
    json!({"fl_x": 8.0, "fl_y": 8.0, "cx": 4.0, "cy": 3.0, "w": WIDTH, "h": HEIGHT, "k1": 0.01, "fps": 1.0,
        "frames": [frame(0), frame(1)]})
    .to_string()
}

fn panoptic() -> String {
    json!({"w": WIDTH, "h": HEIGHT, "k": [[[[8.0, 0.0, 4.0], [0.0, 8.0, 3.0], [0.0, 0.0, 1.0]]]], "w2c": [[POSE]],
        "fn": [["0/0.png"]], "cam_id": [[0]]})
    .to_string()
}

fn poses_bounds() -> Vec<u8> {
    let row = [1.0, 0.0, 0.0, 0.0, 6.0, 0.0, 1.0, 0.0, 0.0, 8.0, 0.0, 0.0, 1.0, 4.0, 8.0, 0.5, 9.0f32];
    let mut out = Vec::new();
    npy::write_f32(&[2, 17], &[row, row].concat(), &mut out).expect("memory takes all bytes");
    out
}

fn cameras() -> Vec<u8> {
    let mut out = 1u64.to_le_bytes().to_vec();
    // Number 1, model 1 (PINHOLE).
    [1u32, 1].iter().for_each(|x| out.extend(x.to_le_bytes()));
    [u64::from(WIDTH), u64::from(HEIGHT)].iter().for_each(|x| out.extend(x.to_le_bytes()));
    [8.0f64, 8.0, 4.0, 3.0].iter().for_each(|x| out.extend(x.to_le_bytes()));
    out
}

fn images() -> Vec<u8> {
    let mut out = 2u64.to_le_bytes().to_vec();
    for i in 0..2u32 {
        out.extend((i + 1).to_le_bytes());
        [1.0, 0.0, 0.0, 0.0, 0.1 * f64::from(i), 0.0, 4.0].iter().for_each(|x| out.extend(x.to_le_bytes()));
        out.extend(1u32.to_le_bytes());
        out.extend(format!("{i}.png\0").as_bytes());
        // One point of the picture.
        out.extend(1u64.to_le_bytes());
        [1.0f64, 2.0].iter().for_each(|x| out.extend(x.to_le_bytes()));
        out.extend(1u64.to_le_bytes());
    }
    out
}

fn points() -> Vec<u8> {
    let mut out = 1u64.to_le_bytes().to_vec();
    out.extend(1u64.to_le_bytes());
    [0.1f64, 0.2, 0.3].iter().for_each(|x| out.extend(x.to_le_bytes()));
    out.extend([255, 0, 9]);
    out.extend(0.5f64.to_le_bytes());
    out.extend(2u64.to_le_bytes());
    [1u32, 0, 2, 0].iter().for_each(|x| out.extend(x.to_le_bytes()));
    out
}

fn encoded<P: image::PixelWithColorType>(picture: &ImageBuffer<P, Vec<P::Subpixel>>, format: ImageFormat) -> Vec<u8>
where
    [P::Subpixel]: image::EncodableLayout,
{
    let mut out = Cursor::new(Vec::new());
    picture.write_to(&mut out, format).expect("memory takes all bytes");
    out.into_inner()
}

fn colours() -> ImageBuffer<Rgb<u8>, Vec<u8>> {
    ImageBuffer::from_fn(WIDTH, HEIGHT, |x, y| Rgb([(20 * x) as u8, (30 * y) as u8, 99]))
}

fn png() -> Vec<u8> {
    encoded(&colours(), ImageFormat::Png)
}

fn depth_png() -> Vec<u8> {
    encoded(&ImageBuffer::from_fn(WIDTH, HEIGHT, |x, y| Luma([(1000 + 10 * x + y) as u16])), ImageFormat::Png)
}

fn pictures() -> Vec<Vec<u8>> {
    vec![png(), depth_png(), encoded(&colours(), ImageFormat::WebP), include_bytes!("../seeds/few.jpg").to_vec()]
}

/// A depth map of 8x6, written by `splat4d render --raw-format exr`.
fn exr() -> Vec<u8> {
    include_bytes!("../seeds/depth.exr").to_vec()
}
