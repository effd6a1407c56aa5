//! Tiny synthetic captures: two or three cameras round the origin, images of 24x16 pixels.

use image::{ImageBuffer, Luma, Rgb, Rgba};
use serde_json::{Value, json};
use splat4d::math::{Se3, quat};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

pub(in crate::capture) const WIDTH: usize = 24;
pub(in crate::capture) const HEIGHT: usize = 16;
pub(in crate::capture) const FOCAL: f64 = 20.0;

/// A folder and the metadata files in it.
pub(in crate::capture) struct Sample {
    pub dir: TempDir,
    pub files: Vec<&'static str>,
}

impl Sample {
    pub(in crate::capture) fn new(files: &[&'static str]) -> Self {
        Self { dir: tempfile::tempdir().unwrap(), files: files.to_vec() }
    }

    pub(in crate::capture) fn root(&self) -> &Path {
        self.dir.path()
    }

    pub(in crate::capture) fn path(&self, name: &str) -> PathBuf {
        self.root().join(name)
    }

    /// Changes a JSON file.
    pub(in crate::capture) fn edit(&self, name: &str, change: impl FnOnce(&mut Value)) {
        let mut value = serde_json::from_slice(&std::fs::read(self.path(name)).unwrap()).unwrap();
        change(&mut value);
        self.write(name, value.to_string().as_bytes());
    }

    pub(in crate::capture) fn write(&self, name: &str, bytes: &[u8]) {
        let path = self.path(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }

    /// An opaque image that distinguishes cameras and frames.
    pub(in crate::capture) fn rgb(&self, name: &str, camera: usize, frame: usize) {
        let pixel = |x: u32, y: u32| Rgb([(x * 10) as u8, (y * 15) as u8, (camera * 40 + frame * 7) as u8]);
        self.save(name, ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, pixel));
    }

    pub(in crate::capture) fn rgba(&self, name: &str, pixel: impl Fn(u32, u32) -> [u8; 4]) {
        self.save(name, ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, |x, y| Rgba(pixel(x, y))));
    }

    pub(in crate::capture) fn mask(&self, name: &str, pixel: impl Fn(u32, u32) -> u8) {
        self.save(name, ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, |x, y| Luma([pixel(x, y)])));
    }

    pub(in crate::capture) fn save<P: image::PixelWithColorType>(
        &self,
        name: &str,
        picture: ImageBuffer<P, Vec<P::Subpixel>>,
    ) where
        [P::Subpixel]: image::EncodableLayout,
    {
        let path = self.path(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        picture.save(path).unwrap();
    }
}

/// The pose of camera i.
pub(in crate::capture) fn pose(i: usize) -> Se3 {
    let angle = i as f64 * 0.9;
    Se3::look_at([4.0 * angle.cos(), 4.0 * angle.sin(), 1.0 + 0.2 * i as f64], [0.0, 0.0, 0.3], [0.0, 0.0, 1.0])
}

pub(in crate::capture) fn rows(p: &Se3) -> Value {
    let row = |i: usize| json!([p.rotation[i][0], p.rotation[i][1], p.rotation[i][2], p.translation[i]]);
    json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]])
}

/// Camera to world in OpenGL axes.
pub(in crate::capture) fn opengl(i: usize) -> Value {
    let mut p = pose(i).inverse();
    for row in &mut p.rotation {
        row[1] = -row[1];
        row[2] = -row[2];
    }
    rows(&p)
}

/// Two coloured points.
pub(in crate::capture) const PLY: &str = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
                   property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n\
                   0 0 0.3 255 0 0\n0.5 0 0 0 0 255\n";

/// Three cameras, two frames, masks, points.
pub(in crate::capture) fn own() -> Sample {
    let sample = Sample::new(&["capture.json", "points.ply"]);
    let cameras: Vec<Value> = (0..3)
        .map(|c| {
            for t in 0..2 {
                sample.rgb(&format!("images/cam{c:02}/{:04}.png", t + 5), c, t);
                sample.mask(&format!("masks/cam{c:02}/{:04}.png", t + 5), |x, _| if x < 12 { 255 } else { 0 });
            }
            json!({
                "name": format!("cam{c:02}"), "width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL,
                "cx": 12.0, "cy": 8.0, "world_to_camera": rows(&pose(c)), "time_offset": 0.01 * c as f64,
                "images": format!("images/cam{c:02}/%04d.png"), "masks": format!("masks/cam{c:02}/%04d.png"),
            })
        })
        .collect();
    let value =
        json!({"version": 1, "fps": 10, "start": 5, "cameras": cameras, "points": "points.ply", "up": [0, 0, 2]});
    sample.write("capture.json", value.to_string().as_bytes());
    sample.write("points.ply", PLY.as_bytes());
    sample
}

/// Three training images, one validation, one test.
pub(in crate::capture) fn dnerf() -> Sample {
    let sample = Sample::new(&["transforms_train.json", "transforms_val.json", "transforms_test.json"]);
    for (split, times, first) in [("train", &[0.0, 0.5, 1.0][..], 0), ("val", &[0.25], 3), ("test", &[0.75], 4)] {
        let frames: Vec<Value> = times
            .iter()
            .enumerate()
            .map(|(i, time)| {
                sample.rgba(&format!("{split}/r_{i:03}.png"), |x, _| [200, 100, 0, if x < 12 { 128 } else { 0 }]);
                let ending = if i == 1 { ".png" } else { "" };
                json!({"file_path": format!("./{split}/r_{i:03}{ending}"), "rotation": 0.04, "time": time,
                       "transform_matrix": opengl(first + i)})
            })
            .collect();
        let angle = 2.0 * (0.5 * WIDTH as f64 / FOCAL).atan();
        let value = json!({"camera_angle_x": angle, "frames": frames});
        sample.write(&format!("transforms_{split}.json"), value.to_string().as_bytes());
    }
    sample
}

/// Cameras 1, 3 train, 2 is measured; two frames.
pub(in crate::capture) fn panoptic() -> Sample {
    let sample = Sample::new(&["train_meta.json", "test_meta.json", "cloud.ply"]);
    for (name, ids) in [("train_meta.json", &[1usize, 3][..]), ("test_meta.json", &[2])] {
        let per = |value: &dyn Fn(usize, usize) -> Value| -> Value {
            (0..2).map(|t| ids.iter().map(|&c| value(c, t)).collect::<Vec<_>>()).collect::<Vec<_>>().into()
        };
        for (&c, t) in ids.iter().flat_map(|c| (0..2).map(move |t| (c, t))) {
            sample.rgb(&format!("ims/{c}/{t:06}.png"), c, t);
            if name == "train_meta.json" {
                sample.mask(&format!("seg/{c}/{t:06}.png"), |x, _| u8::from(x < 6));
            }
        }
        let value = json!({
            "w": WIDTH, "h": HEIGHT,
            "k": per(&|_, _| json!([[FOCAL, 0, 12], [0, FOCAL, 8], [0, 0, 1]])),
            "w2c": per(&|c, _| rows(&pose(c))),
            "fn": per(&|c, t| json!(format!("{c}/{t:06}.png"))),
            "cam_id": per(&|c, _| json!(c)),
        });
        sample.write(name, value.to_string().as_bytes());
    }
    sample.write("cloud.ply", PLY.as_bytes());
    sample
}

/// A camera that moves, in HyperNeRF's layout: three times to train on, one held out; the world is twice as large and
/// elsewhere.
pub(in crate::capture) fn nerfies() -> Sample {
    let sample = Sample::new(&["dataset.json", "metadata.json", "scene.json", "camera/000001.json"]);
    let mut metadata = serde_json::Map::new();
    for i in 0..4 {
        let (id, pose) = (format!("{i:06}"), pose(i));
        sample.rgb(&format!("rgb/2x/{id}.png"), 0, i);
        metadata.insert(id.clone(), json!({"warp_id": i, "appearance_id": 9, "camera_id": 0}));
        let center = pose.inverse().translation.map(|x| 2.0 * x + 1.0);
        let camera = json!({
            "orientation": pose.rotation, "position": center, "focal_length": 2.0 * FOCAL, "skew": 0.0,
            "pixel_aspect_ratio": 1.0, "principal_point": [24.0, 16.0], "image_size": [2 * WIDTH, 2 * HEIGHT],
            "radial_distortion": [if i == 3 { 0.1 } else { 0.0 }, 0.0, 0.0], "tangential_distortion": [0.0, 0.0],
        });
        sample.write(&format!("camera/{id}.json"), camera.to_string().as_bytes());
    }
    let ids: Vec<String> = metadata.keys().cloned().collect();
    let dataset = json!({"count": 4, "ids": ids, "train_ids": [ids[0], ids[1], ids[3]], "val_ids": [ids[2]]});
    sample.write("dataset.json", dataset.to_string().as_bytes());
    sample.write("metadata.json", Value::Object(metadata).to_string().as_bytes());
    sample
        .write("scene.json", json!({"scale": 0.5, "center": [1, 1, 1], "near": 0.1, "far": 9}).to_string().as_bytes());
    let mut points = Vec::new();
    splat4d::format::npy::write_f32(&[2, 3], &[1.0, 1.0, 1.0, 3.0, 1.0, f32::NAN], &mut points).unwrap();
    sample.write("points.npy", &points);
    sample
}

/// Two cameras by folder, two frames with time, one distorted.
pub(in crate::capture) fn nerfstudio() -> Sample {
    let sample = Sample::new(&["transforms.json", "sparse_pc.ply"]);
    let mut frames = Vec::new();
    for (c, t) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
        let name = format!("images/cam{c}/{t:04}.png");
        sample.rgb(&name, c, t);
        let mut frame = json!({"file_path": name, "transform_matrix": opengl(c), "time": t as f64});
        if c == 1 {
            frame["fl_x"] = json!(FOCAL + 1.0);
            frame["k1"] = json!(-0.3);
        }
        if (c, t) == (0, 0) {
            sample.mask("masks/m.png", |x, _| if x < 12 { 255 } else { 0 });
            frame["mask_path"] = json!("masks/m.png");
        }
        frames.push(frame);
    }
    let value = json!({
        "camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": 12, "cy": 8,
        "ply_file_path": "sparse_pc.ply", "applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]],
        "frames": frames,
    });
    sample.write("transforms.json", value.to_string().as_bytes());
    sample.write("sparse_pc.ply", PLY.as_bytes());
    sample
}

/// Images of `names`; three cameras whose first images are registered.
fn colmap_pictures(sample: &Sample) -> Vec<String> {
    for (c, t) in (0..3).flat_map(|c| (0..2).map(move |t| (c, t))) {
        sample.rgb(&format!("images/cam{c}/{t:04}.png"), c, t);
    }
    (0..3).map(|c| format!("cam{c}/0000.png")).collect()
}

/// Binary model of one time.
pub(in crate::capture) fn colmap_bin() -> Sample {
    let sample = Sample::new(&["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"]);
    let names = colmap_pictures(&sample);
    let mut cameras = 2u64.to_le_bytes().to_vec();
    // Camera 1: PINHOLE; camera 2: OPENCV.
    for (id, model, p) in
        [(1u32, 1u32, &[FOCAL, FOCAL, 12.0, 8.0][..]), (2, 4, &[FOCAL, FOCAL, 12.0, 8.0, -0.1, 0.01, 1e-3, -1e-3])]
    {
        cameras.extend([id.to_le_bytes(), model.to_le_bytes()].concat());
        cameras.extend([(WIDTH as u64).to_le_bytes(), (HEIGHT as u64).to_le_bytes()].concat());
        p.iter().for_each(|v| cameras.extend(v.to_le_bytes()));
    }
    let mut images = 3u64.to_le_bytes().to_vec();
    for (i, name) in names.iter().enumerate() {
        let p = pose(i);
        images.extend((i as u32 + 1).to_le_bytes());
        quat::from_rotation(&p.rotation).iter().chain(&p.translation).for_each(|v| images.extend(v.to_le_bytes()));
        images.extend((if i == 2 { 2u32 } else { 1 }).to_le_bytes());
        images.extend(name.as_bytes());
        images.push(0);
        images.extend(1u64.to_le_bytes());
        images.extend([0; 24]);
    }
    let mut points = 1u64.to_le_bytes().to_vec();
    points.extend(7u64.to_le_bytes());
    [0.1f64, 0.2, 0.3].iter().for_each(|v| points.extend(v.to_le_bytes()));
    points.extend([255, 0, 51]);
    points.extend(2.5f64.to_le_bytes());
    points.extend(1u64.to_le_bytes());
    points.extend([0; 8]);
    sample.write("sparse/0/cameras.bin", &cameras);
    sample.write("sparse/0/images.bin", &images);
    sample.write("sparse/0/points3D.bin", &points);
    sample
}

/// The same as text.
pub(in crate::capture) fn colmap_txt() -> Sample {
    let sample = Sample::new(&["sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"]);
    let names = colmap_pictures(&sample);
    let cameras = format!(
        "# comment\n1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} 12 8\n2 OPENCV {WIDTH} {HEIGHT} {FOCAL} {FOCAL} 12 8 \
         -0.1 0.01 0.001 -0.001\n"
    );
    let mut images = "# comment\n".to_string();
    for (i, name) in names.iter().enumerate() {
        let p = pose(i);
        let q = quat::from_rotation(&p.rotation);
        let numbers: Vec<String> = q.iter().chain(&p.translation).map(|v| format!("{v:.17}")).collect();
        let points = if i == 1 { "" } else { "1.0 2.0 7" };
        images += &format!("{} {} {} {name}\n{points}\n", i + 1, numbers.join(" "), if i == 2 { 2 } else { 1 });
    }
    sample.write("sparse/0/cameras.txt", cameras.as_bytes());
    sample.write("sparse/0/images.txt", images.as_bytes());
    sample.write("sparse/0/points3D.txt", b"7 0.1 0.2 0.3 255 0 51 2.5 1 0\n");
    sample
}

/// Images of one place each, by the names that `name` gives them in `images/`, in a `transforms.json` and, where
/// `model` brings that world into another, a COLMAP model of the same. No times.
pub(in crate::capture) fn photos(
    count: usize,
    name: impl Fn(usize) -> String,
    model: Option<&splat4d::math::Sim3>,
) -> Sample {
    let sample = Sample::new(&["transforms.json"]);
    let (mut frames, mut images) = (Vec::new(), String::new());
    for c in 0..count {
        let name = name(c);
        sample.rgb(&format!("images/{name}"), c, 0);
        frames.push(json!({"file_path": format!("./images/{name}"), "transform_matrix": opengl(c)}));
        let Some(s) = model else { continue };
        let world_from_cam = pose(c).inverse();
        let turned = splat4d::math::se3::mat_mul(&s.rotation, &world_from_cam.rotation);
        let p = Se3 { rotation: turned, translation: s.apply(world_from_cam.translation) }.inverse();
        let q = quat::from_rotation(&p.rotation);
        let numbers: Vec<String> = q.iter().chain(&p.translation).map(|v| format!("{v:.17}")).collect();
        images += &format!("{} {} 1 {name}\n\n", c + 1, numbers.join(" "));
    }
    let value = json!({"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": 12, "cy": 8, "frames": frames});
    sample.write("transforms.json", value.to_string().as_bytes());
    if let Some(s) = model {
        let x = s.apply([0.1, 0.2, 0.3]);
        sample.write("sparse/0/cameras.txt", format!("1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} 12 8\n").as_bytes());
        sample.write("sparse/0/images.txt", images.as_bytes());
        let point = format!("7 {:.17} {:.17} {:.17} 255 0 51 0.5 1 0\n", x[0], x[1], x[2]);
        sample.write("sparse/0/points3D.txt", point.as_bytes());
    }
    sample
}

/// Two cameras calibrated at twice the size of the frames.
pub(in crate::capture) fn n3dv() -> Sample {
    let sample = Sample::new(&["poses_bounds.npy"]);
    let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 17), }\n";
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    for c in 0..2 {
        for t in 0..3 {
            sample.rgb(&format!("cam{c:02}/images/{t:04}.png"), c, t);
        }
        let p = pose(c).inverse();
        let hwf = [2.0 * HEIGHT as f64, 2.0 * WIDTH as f64, 2.0 * FOCAL];
        for r in 0..3 {
            let row = [p.rotation[r][1], p.rotation[r][0], -p.rotation[r][2], p.translation[r], hwf[r]];
            row.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        }
        [1.0f64, 9.0].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
    }
    sample.write("poses_bounds.npy", &bytes);
    sample
}

/// One sample of every layout.
pub(in crate::capture) fn all() -> Vec<(&'static str, Sample)> {
    vec![
        ("own", own()),
        ("dnerf", dnerf()),
        ("panoptic", panoptic()),
        ("nerfstudio", nerfstudio()),
        ("colmap binary", colmap_bin()),
        ("colmap text", colmap_txt()),
        ("n3dv", n3dv()),
        ("nerfies", nerfies()),
    ]
}
