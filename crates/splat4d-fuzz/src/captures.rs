//! Files of captures: one of a sound capture's files holds the bytes, and the capture is opened.

use crate::Reader;
use crate::zip::zip;
use image::{ImageBuffer, ImageFormat, Luma, Rgb};
use serde_json::json;
use splat4d::format::npy;
use splat4d::math::Se3;
use splat4d::scene::Camera;
use splat4d_train::capture::{Capture, CaptureOptions, ImageStore, Rgb8, check_scan};
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;
use std::sync::Arc;
use tempfile::TempDir;

pub(crate) const READERS: &[Reader] = &[
    Reader { name: "capture_json", seeds: || vec![own().into()], read: |b| open("own", "capture.json", b) },
    Reader { name: "priors_json", seeds: || vec![PRIORS.into()], read: |b| open("priors", "priors/priors.json", b) },
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
    Reader { name: "nerfies_dataset", seeds: || vec![DATASET.into()], read: |b| open("nerfies", "dataset.json", b) },
    Reader { name: "nerfies_metadata", seeds: || vec![METADATA.into()], read: |b| open("nerfies", "metadata.json", b) },
    Reader { name: "nerfies_camera", seeds: || vec![nerfies().into()], read: |b| open("nerfies", "camera/0.json", b) },
    Reader { name: "nerfies_scene", seeds: || vec![FRAMING.into()], read: |b| open("nerfies", "scene.json", b) },
    Reader { name: "nerfies_points", seeds: || vec![floats(&[4, 3])], read: |b| open("nerfies", "points.npy", b) },
    Reader { name: "nerfies_split", seeds: || vec![SPLIT.into()], read: |b| open("nerfies", "splits/train.json", b) },
    Reader { name: "import_note", seeds: || vec![NOTE.into()], read: |b| open("n3dv", "import/cam00.json", b) },
    Reader { name: "panoptic_points", seeds: panoptic_points, read: |b| open("panoptic", "init_pt_cld.npz", b) },
    Reader { name: "split_list", seeds: || vec![b"0.png\n".into()], read: |b| open("colmap", "sparse/0/test.txt", b) },
    Reader { name: "metashape_xml", seeds: || vec![metashape().into()], read: |b| open("metashape", "cameras.xml", b) },
    Reader { name: "realityscan_csv", seeds: realityscan, read: |b| open("realityscan", "cameras.csv", b) },
    Reader {
        name: "polycam_json",
        seeds: || vec![polycam().into()],
        read: |b| open("polycam", "keyframes/cameras/0.json", b),
    },
    Reader { name: "record3d_json", seeds: || vec![record3d().into()], read: |b| open("record3d", "metadata.json", b) },
    Reader { name: "colmap_cameras", seeds: || vec![cameras()], read: |b| open("colmap", "sparse/0/cameras.bin", b) },
    Reader { name: "colmap_images", seeds: || vec![images()], read: |b| open("colmap", "sparse/0/images.bin", b) },
    Reader { name: "colmap_points", seeds: || vec![points()], read: |b| open("colmap", "sparse/0/points3D.bin", b) },
    Reader {
        name: "colmap_cameras_txt",
        seeds: || vec![CAMERAS_TXT.into()],
        read: |b| open("colmap_txt", "sparse/0/cameras.txt", b),
    },
    Reader {
        name: "colmap_images_txt",
        seeds: || vec![IMAGES_TXT.into()],
        read: |b| open("colmap_txt", "sparse/0/images.txt", b),
    },
    Reader {
        name: "colmap_points_txt",
        seeds: || vec![POINTS_TXT.into()],
        read: |b| open("colmap_txt", "sparse/0/points3D.txt", b),
    },
    Reader { name: "image_file", seeds: image_files, read: |b| open("own", "images/0.png", b) },
    Reader { name: "mask_png", seeds: || vec![grey(255)], read: |b| open("beside", "mask.png", b) },
    Reader { name: "labels_png", seeds: || vec![grey(1)], read: |b| open("beside", "labels.png", b) },
    Reader { name: "features_npy", seeds: || vec![floats(&[6, 8, 2])], read: |b| open("beside", "features.npy", b) },
    Reader { name: "tracks_npz", seeds: tracks_npz, read: |b| open("tracks_npz", "tracks.npz", b) },
    Reader { name: "tracks_csv", seeds: || vec![TRACKS.into()], read: |b| open("beside", "tracks.csv", b) },
    Reader { name: "flow_png", seeds: || vec![flow_png()], read: |b| open("flow_png", "flow.png", b) },
    Reader { name: "flow_flo", seeds: || vec![flo()], read: |b| open("flow_flo", "flow.flo", b) },
    Reader { name: "flow_npy", seeds: || vec![floats(&[6, 8, 2])], read: |b| open("flow_npy", "flow.npy", b) },
    Reader { name: "depth_npy", seeds: || vec![floats(&[6, 8])], read: |b| open("npy", "depth.npy", b) },
    Reader { name: "depth_exr", seeds: || vec![exr()], read: |b| open("exr", "depth.exr", b) },
    Reader { name: "depth_png", seeds: || vec![depth_png()], read: |b| open("png", "depth.png", b) },
    Reader { name: "scan_las", seeds: || vec![las()], read: |b| scan("scan_las", "scan.las", b) },
    Reader { name: "scan_pcd", seeds: pcds, read: |b| scan("scan_pcd", "scan.pcd", b) },
    Reader { name: "scan_e57", seeds: || vec![e57_scan()], read: |b| scan("scan_e57", "scan.e57", b) },
    Reader { name: "scan_obj", seeds: || vec![OBJ.into()], read: |b| scan("scan_obj", "scan.obj", b) },
    Reader { name: "scan_ply", seeds: || vec![MESH.into()], read: |b| scan("scan_ply", "scan.ply", b) },
    Reader { name: "picture", seeds: pictures, read: |b| drop(Rgb8::decode(b, Path::new("picture"))) },
];

/// The list of what networks wrote.
const PRIORS: &str = r#"{"version": 1, "writer": "splat4d", "depth": {"kind": "inverse", "scale": 1.0, "files": {"images/0.png": "depth/0.npy"}},
"masks": {"files": {"images/0.png": "masks/0.png"}}, "tracks": {"files": {"a": "tracks.csv"}}}"#;
/// Of as many sums of the bytes of a scan, one opens a capture, which takes fifty times as long as reading the scan.
const OPENED: u32 = 64;
const WIDTH: u32 = 8;
const HEIGHT: u32 = 6;

thread_local! {
    /// A folder for each layout, made when it is first requested.
    static FOLDERS: RefCell<BTreeMap<&'static str, TempDir>> = const { RefCell::new(BTreeMap::new()) };
}

/// Opens the capture of this layout in which one file has other bytes, and reads its first image with what is next
/// to.
fn open(layout: &'static str, file: &str, bytes: &[u8]) {
    FOLDERS.with_borrow_mut(|folders| {
        let folder = folders.entry(layout).or_insert_with(|| made(layout));
        write(folder.path(), file, bytes);
        if let Ok(capture) = Capture::open(folder.path(), &CaptureOptions::default()) {
            let _ = capture.check_labels(&capture.frames[0]);
            let store = ImageStore::new(Arc::new(capture), 1 << 20);
            let _ = store.load(0);
        }
    });
}

/// Reads a scan and renders its depth; with some bytes in a capture, which draws initial points on it.
fn scan(layout: &'static str, file: &str, bytes: &[u8]) {
    let pose = Se3::look_at([0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
    let camera = Camera::with_fov_y(pose, 0.8, WIDTH as usize, HEIGHT as usize);
    let _ = check_scan(bytes, Path::new(file), &camera);
    if bytes.iter().map(|b| u32::from(*b)).sum::<u32>().is_multiple_of(OPENED) {
        open(layout, file, bytes);
    }
}

/// A rig of two cameras and two frames.
pub(crate) fn rig() -> (TempDir, Capture) {
    let folder = made("own");
    let camera = |c: usize| {
        let mut pose = POSE;
        pose[0][3] = 0.2 * c as f64;
        json!({"name": format!("c{c}"), "width": WIDTH, "height": HEIGHT, "fx": 8.0, "fy": 8.0, "cx": 4.0, "cy": 3.0,
            "world_to_camera": pose, "images": "images/%d.png"})
    };
    let text = json!({"version": 1, "fps": 30, "cameras": [camera(0), camera(1)]}).to_string();
    write(folder.path(), "capture.json", text.as_bytes());
    let options = CaptureOptions { hold_out: Some("none".parse().expect("it is a word")), ..CaptureOptions::default() };
    let capture = Capture::open(folder.path(), &options).unwrap_or_else(|e| panic!("{e}"));
    (folder, capture)
}

fn write(folder: &Path, file: &str, bytes: &[u8]) {
    let path = folder.join(file);
    std::fs::create_dir_all(path.parent().expect("it lies in the folder")).expect("the folder can be made");
    std::fs::write(path, bytes).expect("the disk takes a file");
}

fn made(layout: &str) -> TempDir {
    let folder = tempfile::tempdir().expect("there is a place for temporary files");
    let put = |file: &str, bytes: &[u8]| write(folder.path(), file, bytes);
    // Only what the layout needs: opening a capture lists its folders, which costs more than most readers.
    let files: &[&str] = match layout {
        "panoptic" => &["ims/0/0.png"],
        "n3dv" => &["cam00/images/0000.png", "cam01/images/0000.png"],
        "nerfies" => &["rgb/1x/0.png", "rgb/1x/1.png"],
        "metashape" | "realityscan" => &["images/p0.png", "images/p1.png"],
        "polycam" => &["keyframes/images/0.png", "keyframes/images/1.png"],
        "record3d" => &["rgb/0.png", "rgb/1.png"],
        _ => &["images/0.png", "images/1.png"],
    };
    files.iter().for_each(|name| put(name, &png()));
    match layout {
        "own" => put("capture.json", own().as_bytes()),
        "priors" => {
            put("capture.json", own().as_bytes());
            put("priors/depth/0.npy", &floats(&[6, 8]));
            put("priors/masks/0.png", &grey(255));
            put("priors/tracks.csv", TRACKS.as_bytes());
        }
        "nerf" => put("transforms.json", transforms().as_bytes()),
        "panoptic" => put("train_meta.json", panoptic().as_bytes()),
        "n3dv" => put("poses_bounds.npy", &poses_bounds()),
        "colmap" => {
            put("sparse/0/cameras.bin", &cameras());
            put("sparse/0/images.bin", &images());
            put("sparse/0/points3D.bin", &points());
        }
        "colmap_txt" => {
            put("sparse/0/cameras.txt", CAMERAS_TXT.as_bytes());
            put("sparse/0/images.txt", IMAGES_TXT.as_bytes());
            put("sparse/0/points3D.txt", POINTS_TXT.as_bytes());
        }
        "nerfies" => {
            put("dataset.json", DATASET.as_bytes());
            put("metadata.json", METADATA.as_bytes());
            put("scene.json", FRAMING.as_bytes());
            for i in 0..2 {
                put(&format!("camera/{i}.json"), nerfies().as_bytes());
            }
        }
        "metashape" => put("cameras.xml", metashape().as_bytes()),
        "realityscan" => put("cameras.csv", &realityscan()[0]),
        "polycam" => (0..2).for_each(|i| put(&format!("keyframes/cameras/{i}.json"), polycam().as_bytes())),
        "record3d" => put("metadata.json", record3d().as_bytes()),
        "beside" => {
            put("mask.png", &grey(255));
            put("labels.png", &grey(1));
            put("features.npy", &floats(&[6, 8, 2]));
            put("tracks.csv", TRACKS.as_bytes());
            put("capture.json", beside().as_bytes());
        }
        "tracks_npz" => {
            put("tracks.npz", &tracks_npz()[0]);
            put("capture.json", own().replacen("\"name\"", "\"tracks\":\"tracks.npz\",\"name\"", 1).as_bytes());
        }
        scan if scan.starts_with("scan_") => {
            let file = scan.replace('_', ".");
            let bytes: Vec<u8> = match scan {
                "scan_las" => las(),
                "scan_pcd" => pcds().remove(0),
                "scan_e57" => e57_scan(),
                "scan_obj" => OBJ.into(),
                _ => MESH.into(),
            };
            put(&file, &bytes);
            // A second camera is held out, so that the first one's image is loaded with its depth.
            let geometry = format!("\"geometry\":\"{file}\",\"hold_out\":\"none\",\"version\"");
            put("capture.json", own().replacen("\"version\"", &geometry, 1).as_bytes());
        }
        flow if flow.starts_with("flow_") => {
            let file = flow.replace('_', ".");
            let key = format!("\"flow\":[\"{file}\"],\"name\"");
            put(
                &file,
                &[flow_png(), flo(), floats(&[6, 8, 2])]
                    [["flow_png", "flow_flo"].iter().position(|f| *f == flow).unwrap_or(2)],
            );
            put("capture.json", own().replacen("\"name\"", &key, 1).as_bytes());
        }
        ending => {
            put("depth.exr", &exr());
            put("depth.png", &depth_png());
            put("depth.npy", &floats(&[6, 8]));
            let scale = if ending == "png" { "\"depth_scale\":0.001," } else { "" };
            let depth = format!("\"depth\":[\"depth.{ending}\",\"depth.{ending}\"],{scale}\"name\"");
            put("capture.json", own().replacen("\"name\"", &depth, 1).as_bytes());
        }
    }
    folder
}

/// A square one unit in front of the world's origin, as triangles.
const OBJ: &str = "v -1 -1 0 1 0 0\nv 1 -1 0 0 1 0\nv 1 1 0 0 0 1\nv -1 1 0 1 1 1\nf 1 2 3\nf 1/1 3/2/1 -1\n";
const MESH: &str = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
                    element face 1\nproperty list uchar int vertex_indices\nend_header\n-1 -1 0\n1 -1 0\n1 1 0\n-1 1 0\n\
                    4 0 1 2 3\n";

/// Points of such a square.
fn square() -> impl Iterator<Item = [f32; 3]> {
    (0..36).map(|i| [(i % 6) as f32 * 0.4 - 1.0, (i / 6) as f32 * 0.4 - 1.0, 0.0])
}

/// A LAS file of version 1.2 in format 0.
fn las() -> Vec<u8> {
    const HEADER: usize = 227;
    let mut out = vec![0u8; HEADER];
    out[..4].copy_from_slice(b"LASF");
    (out[24], out[25]) = (1, 2);
    out[96..100].copy_from_slice(&(HEADER as u32).to_le_bytes());
    out[105] = 20;
    out[107] = 36;
    (0..3).for_each(|k| out[131 + 8 * k..139 + 8 * k].copy_from_slice(&0.01f64.to_le_bytes()));
    for p in square() {
        p.iter().for_each(|v| out.extend(((v * 100.0) as i32).to_le_bytes()));
        out.extend([0; 8]);
    }
    out
}

/// A PCD file of every encoding.
fn pcds() -> Vec<Vec<u8>> {
    let header = |data: &str| {
        format!(
            "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 36\nHEIGHT 1\nPOINTS \
             36\nDATA {data}\n"
        )
    };
    let rows: Vec<u8> = square()
        .flat_map(|p| [p[0].to_bits(), p[1].to_bits(), p[2].to_bits(), 0xff_8040])
        .flat_map(u32::to_le_bytes)
        .collect();
    let text: String = square().map(|p| format!("{} {} {} 16744512\n", p[0], p[1], p[2])).collect();
    let columns: Vec<u8> =
        (0..4).flat_map(|k| rows.chunks(16).flat_map(move |r| r[4 * k..4 * k + 4].to_vec())).collect();
    let mut packed: Vec<u8> = Vec::new();
    columns.chunks(32).for_each(|c| {
        packed.push(c.len() as u8 - 1);
        packed.extend(c);
    });
    let sizes = [packed.len(), columns.len()].map(|n| (n as u32).to_le_bytes()).concat();
    vec![
        [header("ascii").as_bytes(), text.as_bytes()].concat(),
        [header("binary").as_bytes(), &rows].concat(),
        [header("binary_compressed").as_bytes(), &sizes, &packed].concat(),
    ]
}

fn e57_scan() -> Vec<u8> {
    use e57::{E57Writer, Record, RecordValue};
    let mut out = Cursor::new(Vec::new());
    let mut writer = E57Writer::new(&mut out, "file").expect("memory takes a file");
    let prototype = vec![Record::CARTESIAN_X_F32, Record::CARTESIAN_Y_F32, Record::CARTESIAN_Z_F32];
    let mut scan = writer.add_pointcloud("scan", prototype).expect("it is a scan");
    square().for_each(|p| scan.add_point(p.map(RecordValue::Single).to_vec()).expect("memory takes a point"));
    scan.finalize().expect("the scan is whole");
    writer.finalize().expect("the file is whole");
    drop(writer);
    out.into_inner()
}

const POSE: [[f64; 4]; 4] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]];

fn own() -> String {
    let camera = json!({
        "name": "a", "width": WIDTH, "height": HEIGHT, "fx": 8.0, "fy": 8.0, "cx": 4.0, "cy": 3.0,
        "world_to_camera": POSE, "images": "images/%d.png", "time_offset": 0.01,
    });
    json!({"version": 1, "fps": 30, "cameras": [camera]}).to_string()
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
    // Two cameras side by side.
    let row = |x: f32| [1.0, 0.0, 0.0, x, 6.0, 0.0, 1.0, 0.0, 0.0, 8.0, 0.0, 0.0, 1.0, 4.0, 8.0, 0.5, 9.0];
    let mut out = Vec::new();
    npy::write_f32(&[2, 17], &[row(0.0), row(0.5)].concat(), &mut out).expect("memory takes all bytes");
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
        // One point of the image.
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

/// COLMAP's text files.
const CAMERAS_TXT: &str = "# Camera list\n1 PINHOLE 8 6 8 8 4 3\n";
const IMAGES_TXT: &str = "# Image list\n1 1 0 0 0 0 0 4 1 0.png\n1.5 2.5 1\n2 1 0 0 0 0.1 0 4 1 1.png\n1.5 2.5 1\n";
const POINTS_TXT: &str = "# 3D point list\n1 0.1 0.2 0.3 255 0 9 0.5 1 0 2 0\n";

/// Nerfies' files.
const DATASET: &str = r#"{"count": 2, "ids": ["0", "1"], "train_ids": ["0"], "val_ids": ["1"]}"#;
const METADATA: &str = r#"{"0": {"warp_id": 0, "appearance_id": 0, "camera_id": 0}, "1": {"warp_id": 1, "appearance_id": 1, "camera_id": 0}}"#;
const FRAMING: &str = r#"{"scale": 0.5, "center": [0.0, 0.1, 0.2], "near": 0.1, "far": 9.0}"#;

fn nerfies() -> String {
    json!({"orientation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "position": [0.0, 0.0, -4.0], "focal_length": 8.0,
        "pixel_aspect_ratio": 1.0, "principal_point": [4.0, 3.0], "radial_distortion": [0.01, 0, 0],
        "tangential_distortion": [0, 0], "skew": 0.0, "image_size": [WIDTH, HEIGHT]})
    .to_string()
}

fn metashape() -> String {
    let camera = |i: u32| {
        format!(
            "<camera id=\"{i}\" sensor_id=\"0\" label=\"p{i}\"><transform>1 0 0 0 0 1 0 0 0 0 1 -4 0 0 0 1</transform></camera>"
        )
    };
    format!(
        "<?xml version=\"1.0\"?>\n<document version=\"2.0.0\"><chunk label=\"a\" enabled=\"true\"><sensors><sensor id=\"0\" \
         type=\"frame\"><resolution width=\"{WIDTH}\" height=\"{HEIGHT}\"/><calibration type=\"frame\" class=\"adjusted\"><f>8</f>\
         <cx>0.5</cx><cy>-0.25</cy><b1>1</b1><k1>-0.1</k1><p1>0.001</p1></calibration></sensor></sensors><components>\
         <component id=\"0\"><transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>1 2 3</translation><scale>2</scale>\
         </transform></component></components><cameras>{}{}</cameras></chunk></document>",
        camera(0),
        camera(1)
    )
}

/// With commas, and as a spreadsheet with decimal commas.
fn realityscan() -> Vec<Vec<u8>> {
    let head = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n";
    let rows =
        "p0.png,1,2,3,10,20,30,36,0.75,-0.3,0.01,0,0,0,0,0\np1.png,1.5,2,3,11,20,30,36,0.75,-0.3,0.01,0,0,0,0,0\n";
    let text = format!("{head}{rows}");
    let other = text.replace(',', ";").replace('.', ",").replace(",png", ".png");
    vec![text.into(), other.into()]
}

fn polycam() -> String {
    json!({"fx": 8, "fy": 8, "cx": 4, "cy": 3, "width": WIDTH, "height": HEIGHT, "timestamp": 1_700_000, "blur_score": 50,
        "t_00": 1, "t_01": 0, "t_02": 0, "t_03": 0, "t_10": 0, "t_11": 1, "t_12": 0, "t_13": 0, "t_20": 0, "t_21": 0,
        "t_22": 1, "t_23": 4})
    .to_string()
}

fn record3d() -> String {
    json!({"w": WIDTH, "h": HEIGHT, "fps": 20, "K": [8, 0, 0, 0, 8, 0, 4, 3, 1], "frameTimestamps": [100.0, 100.05],
        "poses": [[0, 0, 0, 1, 0, 0, 4], [0, 0, 0, 1, 0.1, 0, 4]],
        "perFrameIntrinsicCoeffs": [[8, 8, 4, 3], [8.1, 8, 4, 3]]})
    .to_string()
}

/// A capture with everything that may be next to its first image.
fn beside() -> String {
    let files = "\"masks\":[\"mask.png\",\"mask.png\"],\"labels\":[\"labels.png\",\"labels.png\"],\
                 \"features\":[\"features.npy\",\"features.npy\"],\"tracks\":\"tracks.csv\",\"name\"";
    own().replacen("\"name\"", files, 1).replacen("\"fps\"", "\"labels\":[\"a\",\"b\"],\"fps\"", 1)
}

/// DyCheck's `splits/train.json`, and a note of extracted frames.
const SPLIT: &str = r#"{"frame_names": ["0"], "camera_ids": [0], "time_ids": [0]}"#;
const NOTE: &str = r#"{"interval": 0.04}"#;

fn panoptic_points() -> Vec<Vec<u8>> {
    [false, true].map(|deflate| zip(&[("data.npy", &floats(&[5, 7]))], deflate)).into()
}

const TRACKS: &str = "point,frame,x,y\n0,0,1.5,2\n0,1,2.5,2\n1,1,3,4\n";

fn tracks_npz() -> Vec<Vec<u8>> {
    let (tracks, seen) = (floats(&[2, 3, 2]), floats(&[2, 3]));
    [false, true].map(|deflate| zip(&[("tracks.npy", &tracks), ("visibility.npy", &seen)], deflate)).into()
}

/// Alternating columns of 0 and of this value.
fn grey(value: u8) -> Vec<u8> {
    encoded(&ImageBuffer::from_fn(WIDTH, HEIGHT, |x, _| Luma([value * (x % 2) as u8])), ImageFormat::Png)
}

fn flow_png() -> Vec<u8> {
    let code = |x: u32, y: u32| Rgb([(32768 + 64 * (x % 2)) as u16, (32768 + 32 * y) as u16, 1]);
    encoded(&ImageBuffer::from_fn(WIDTH, HEIGHT, code), ImageFormat::Png)
}

fn flo() -> Vec<u8> {
    let mut out = 202_021.25f32.to_le_bytes().to_vec();
    [WIDTH, HEIGHT].iter().for_each(|x| out.extend(x.to_le_bytes()));
    (0..2 * WIDTH * HEIGHT).for_each(|i| out.extend((0.25 * (i % 3) as f32).to_le_bytes()));
    out
}

fn floats(shape: &[usize]) -> Vec<u8> {
    let data: Vec<f32> = (0..shape.iter().product()).map(|i| 1.0 + 0.1 * i as f32).collect();
    let mut out = Vec::new();
    npy::write_f32(shape, &data, &mut out).expect("memory takes all bytes");
    out
}

/// A JPEG with its orientation in EXIF, and a PNG.
fn image_files() -> Vec<Vec<u8>> {
    let plain = include_bytes!("../seeds/few.jpg");
    // APP1 with a big-endian TIFF of one entry: tag 0x0112 (orientation), a short, 6.
    let exif = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0";
    let length = (exif.len() as u16 + 2).to_be_bytes();
    vec![[&plain[..2], b"\xFF\xE1", &length, exif, &plain[2..]].concat(), png()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_are_sound() {
        let layouts = [
            "own",
            "nerf",
            "panoptic",
            "n3dv",
            "colmap",
            "colmap_txt",
            "nerfies",
            "metashape",
            "realityscan",
            "polycam",
            "record3d",
            "beside",
            "tracks_npz",
            "flow_png",
            "flow_flo",
            "flow_npy",
            "exr",
            "png",
            "npy",
        ];
        for layout in layouts {
            let folder = made(layout);
            let capture = Capture::open(folder.path(), &CaptureOptions::default());
            let capture = capture.unwrap_or_else(|e| panic!("{layout}: {e}"));
            capture.check_labels(&capture.frames[0]).unwrap();
            let store = ImageStore::new(Arc::new(capture), 1 << 20);
            assert!(store.load(0).is_ok(), "{layout}: {:?}", store.load(0).err().map(|e| e.to_string()));
        }
        for image in image_files() {
            assert!(Rgb8::decode(&image, Path::new("image")).is_ok());
        }
    }
}
