//! Results of networks that predict poses and depth of images together, in one `.npz`: VGGT's `predictions.npz` and Depth
//! Anything 3's `results.npz`. They become a capture of photos with depth maps, whose poses training refines.
//!
//! Arrays, N images of H x W pixels: `image` [N, H, W, 3] bytes or `images` [N, 3, H, W] from 0 to 1; `extrinsics` or
//! `extrinsic` [N, 3 or 4, 4], world to camera, OpenCV axes; `intrinsics` or `intrinsic` [N, 3, 3], pixels of these images;
//! `depth` [N, H, W] or [N, H, W, 1], z in the poses' unit. A leading axis of length 1 (a batch) is ignored. Source: VGGT's
//! `demo_gradio.py`; Depth Anything 3's `utils/export/npz.py` and `docs/API.md`. Read, not run. Depth Anything 3's `mini_npz`
//! has no images.

use crate::generated::PREDICTED_POSES;
use serde_json::{Value, json};
use splat4d::format::npy::{Npy, write_f32};
use splat4d::format::zip::Archive;
use splat4d::math::Se3;
use splat4d::scene::Intrinsics;
use splat4d::{Error, Result};
use splat4d_train::capture::{check_intrinsics, rigid};
use splat4d_train::encode::{Pixels, png};
use splat4d_train::output::write_atomically;
use std::path::Path;

/// Names of the arrays: those of VGGT and of Depth Anything 3.
const IMAGES: [&str; 2] = ["images", "image"];
const POSES: [&str; 2] = ["extrinsic", "extrinsics"];
const LENSES: [&str; 2] = ["intrinsic", "intrinsics"];
const DEPTH: &str = "depth";
/// The network, by the name of the array of images.
const NETWORKS: [&str; 2] = ["VGGT", "Depth Anything 3"];
/// Every how many images one is held out, as in captures of photos.
const HOLD_EVERY: usize = 8;
/// Colours above this are bytes.
const UNIT: f32 = 1.5;

/// One image with its camera.
struct Shot {
    rgb: Vec<u8>,
    depth: Option<Vec<f32>>,
    pose: Se3,
    intrinsics: Intrinsics,
}

/// Poses, depth and images that a network gave.
struct Predicted {
    /// The network.
    network: &'static str,
    /// Pixels across and down.
    size: [usize; 2],
    shots: Vec<Shot>,
}

/// Makes a capture of an archive in a folder. Returns the result in words.
///
/// Errors: arrays that are missing, of other shapes or not finite; poses that are not rigid; no space.
pub fn unpack(file: &Path, folder: &Path) -> Result<String> {
    let bytes = splat4d_train::files::read(file)?;
    let predicted = Predicted::read(&bytes).map_err(|e| e.at(file.display()))?;
    predicted.write(folder)?;
    let ([width, height], count) = (predicted.size, predicted.shots.len());
    Ok(format!("{count} images of {width}x{height} with the poses of {}, which training refines", predicted.network))
}

/// Checks the bytes of an archive. Errors: as [`unpack`].
#[doc(hidden)]
pub fn check_archive(bytes: &[u8]) -> Result<()> {
    Predicted::read(bytes).map(drop)
}

/// An array without a leading axis of length 1, of `rank` axes.
fn array(bytes: &[u8], name: &str, rank: usize) -> Result<Npy> {
    let mut array = Npy::read_member(bytes, name).map_err(|e| e.at(name))?;
    while array.shape.len() > rank && array.shape[0] == 1 {
        array.shape.remove(0);
    }
    if array.shape.len() != rank && !(name == DEPTH && array.shape.len() == rank + 1 && array.shape[rank] == 1) {
        return Err(Error::input(format!("expected {rank} axes, found {:?}", array.shape)).at(name).remedy(SAVE));
    }
    Ok(array)
}

const SAVE: &str = "Save the network's prediction unchanged (numpy.savez): docs/layouts.md lists the arrays.";

impl Predicted {
    /// Reads an archive. Errors: arrays that are missing, of other shapes or not finite; poses that are not rigid.
    fn read(bytes: &[u8]) -> Result<Self> {
        let names: Vec<String> =
            Archive::open(bytes)?.names().iter().map(|n| n.trim_end_matches(".npy").to_owned()).collect();
        let has = |name: &str| names.iter().any(|n| n == name);
        let of = |either: [&'static str; 2]| {
            either.into_iter().find(|name| has(name)).ok_or_else(|| {
                let what = format!("the archive has no array `{}`, but {}", either.join("` or `"), names.join(", "));
                Error::input(what).remedy(SAVE)
            })
        };
        let name = of(IMAGES)?;
        let network = NETWORKS[usize::from(name == IMAGES[1])];
        let images = array(bytes, name, 4)?;
        let [n, a, b, c] = [0, 1, 2, 3].map(|i| images.shape[i]);
        let (height, width, planar) = match (a, c) {
            (_, 3) => (a, b, false),
            (3, _) => (b, c, true),
            _ => {
                return Err(Error::input(format!("expected colours, found shape {:?}", images.shape))
                    .at(name)
                    .remedy(SAVE));
            }
        };
        let pixels = height * width;
        if n == 0 || pixels == 0 {
            return Err(Error::input("there are no images").at(name));
        }
        let values = images.to_f32();
        let scale = if values.iter().copied().fold(0.0, f32::max) > UNIT { 1.0 } else { 255.0 };
        let (poses, lenses) = (array(bytes, of(POSES)?, 3)?, array(bytes, of(LENSES)?, 3)?);
        let depth = has(DEPTH).then(|| array(bytes, DEPTH, 3)).transpose()?;
        let rows = poses.shape[1];
        let fits = poses.shape[0] == n && (3..=4).contains(&rows) && poses.shape[2] == 4 && lenses.shape == [n, 3, 3];
        if !fits || depth.as_ref().is_some_and(|d| d.shape[..3] != [n, height, width]) {
            let what = format!(
                "arrays do not fit each other: images {:?}, poses {:?}, lenses {:?}, depth {:?}",
                images.shape,
                poses.shape,
                lenses.shape,
                depth.as_ref().map(|d| &d.shape)
            );
            return Err(Error::input(what).remedy(SAVE));
        }
        let (poses, lenses, depth) = (poses.to_f64(), lenses.to_f64(), depth.map(|d| d.to_f32()));
        let shot = |i: usize| -> Result<Shot> {
            let at = |p: usize, k: usize| if planar { (3 * i + k) * pixels + p } else { 3 * (i * pixels + p) + k };
            let byte = |v: f32| (v * scale).round().clamp(0.0, 255.0) as u8;
            let mut matrix = [[0.0; 4]; 4];
            matrix[3][3] = 1.0;
            for (r, row) in matrix.iter_mut().enumerate().take(3) {
                row.copy_from_slice(&poses[4 * (rows * i + r)..][..4]);
            }
            let k = &lenses[9 * i..9 * i + 9];
            let intrinsics = Intrinsics { fx: k[0], fy: k[4], cx: k[2], cy: k[5] };
            check_intrinsics(&intrinsics, width, height)?;
            // 0 is unknown, as in every depth map.
            let known = |z: &f32| if z.is_finite() && *z > 0.0 { *z } else { 0.0 };
            Ok(Shot {
                rgb: (0..3 * pixels).map(|j| byte(values[at(j / 3, j % 3)])).collect(),
                depth: depth.as_ref().map(|d| d[i * pixels..(i + 1) * pixels].iter().map(known).collect()),
                pose: rigid(Se3::from_rows(&matrix))?,
                intrinsics,
            })
        };
        let shots = (0..n).map(|i| shot(i).map_err(|e| e.at(format!("image {i}")))).collect::<Result<Vec<Shot>>>()?;
        Ok(Self { network, size: [width, height], shots })
    }

    /// Writes images, depth maps and, last, `capture.json` into a folder. Errors: no space.
    fn write(&self, folder: &Path) -> Result<()> {
        let [width, height] = self.size;
        let mut cameras = Vec::new();
        for (i, shot) in self.shots.iter().enumerate() {
            let (image, depth) = (format!("images/{i:04}.png"), format!("depth/{i:04}.npy"));
            write_atomically(&folder.join(&image), &png(Pixels::Eight(&shot.rgb), self.size, 3))?;
            let (pose, k) = (&shot.pose, &shot.intrinsics);
            let row = |r: usize| [pose.rotation[r][0], pose.rotation[r][1], pose.rotation[r][2], pose.translation[r]];
            let mut camera = json!({
                "name": format!("{i:04}"), "width": width, "height": height, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy,
                "world_to_camera": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]], "images": [image], "frames": 1,
            });
            if let Some(values) = &shot.depth {
                let mut bytes = Vec::new();
                write_f32(&[height, width], values, &mut bytes)?;
                write_atomically(&folder.join(&depth), &bytes)?;
                (camera["depth"], camera["depth_kind"]) = (json!([depth]), json!("metric"));
            }
            cameras.push(camera);
        }
        let held: Vec<Value> = cameras.iter().step_by(HOLD_EVERY).map(|c| c["name"].clone()).collect();
        let hold_out = if cameras.len() > HOLD_EVERY { json!({ "cameras": held }) } else { json!("none") };
        let top = json!({
            "version": 1, "cameras": cameras, "hold_out": hold_out, "extra": { PREDICTED_POSES: self.network },
        });
        write_atomically(&folder.join("capture.json"), format!("{top:#}\n").as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::format::npy::write_archive;
    use splat4d_train::capture::{Capture, CaptureOptions, ImageStore};
    use std::sync::Arc;

    /// Two images of 4x2 pixels; image i is red (i + 1)/4, and 2 + i away.
    /// Of an array by its name: shape and values.
    type Change<'a> = &'a dyn Fn(&str, &mut Vec<usize>, &mut Vec<f32>);

    fn archive(planar: bool, batch: bool, change: impl Fn(&str, &mut Vec<usize>, &mut Vec<f32>)) -> Vec<u8> {
        let (n, h, w) = (2, 2, 4);
        let red = |i: usize| (i + 1) as f32 / 4.0;
        let images: Vec<f32> = match planar {
            true => (0..n).flat_map(|i| (0..3 * h * w).map(move |p| if p < h * w { red(i) } else { 0.0 })).collect(),
            false => (0..n)
                .flat_map(|i| (0..3 * h * w).map(move |p| if p % 3 == 0 { 255.0 * red(i) } else { 0.0 }))
                .collect(),
        };
        let pose = |x: f32| [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 3.0];
        let lens = [5.0, 0.0, 2.0, 0.0, 5.0, 1.0, 0.0, 0.0, 1.0];
        let depth: Vec<f32> =
            (0..n).flat_map(|i| (0..h * w).map(move |p| if p == 0 { f32::NAN } else { 2.0 + i as f32 })).collect();
        let shape = if planar { vec![n, 3, h, w] } else { vec![n, h, w, 3] };
        let which = usize::from(!planar);
        let mut arrays = vec![
            (IMAGES[which], shape, images),
            (POSES[which], vec![n, 3, 4], [pose(0.0), pose(1.0)].concat()),
            (LENSES[which], vec![n, 3, 3], [lens, lens].concat()),
            (DEPTH, if planar { vec![n, h, w, 1] } else { vec![n, h, w] }, depth),
        ];
        for (name, shape, values) in &mut arrays {
            if batch {
                shape.insert(0, 1);
            }
            change(name, shape, values);
        }
        let list: Vec<(&str, &[usize], &[f32])> = arrays.iter().map(|(n, s, v)| (*n, &s[..], &v[..])).collect();
        let mut bytes = Vec::new();
        write_archive(&list, &mut bytes).unwrap();
        bytes
    }

    #[test]
    fn predictions_of_two_networks_become_captures_with_depth() {
        for (planar, batch, network) in
            [(true, false, "VGGT"), (true, true, "VGGT"), (false, false, "Depth Anything 3")]
        {
            let predicted = Predicted::read(&archive(planar, batch, |_, _, _| {})).unwrap();
            assert_eq!((predicted.network, predicted.shots.len(), predicted.size), (network, 2, [4, 2]));
            let folder = tempfile::tempdir().unwrap();
            predicted.write(folder.path()).unwrap();
            let capture = Arc::new(Capture::open(folder.path(), &CaptureOptions::default()).unwrap());
            assert_eq!((capture.train.len(), capture.frames[1].view.cam_from_world.translation), (2, [1.0, 0.0, 3.0]));
            let store = ImageStore::new(capture.clone(), 1 << 20);
            let picture = store.load(1).unwrap().to_picture();
            assert!((picture.color.get(0, 1, 1) - 0.5).abs() < 0.01 && picture.color.get(1, 1, 1) == 0.0);
            let (depth, _) = picture.depth.unwrap();
            assert_eq!((depth.get(0, 0, 0), depth.get(0, 1, 3)), (0.0, 3.0), "what is not finite is unknown");
        }
    }

    #[test]
    fn arrays_that_do_not_fit_are_named() {
        let error = |change: Change<'_>| {
            Predicted::read(&archive(true, false, change)).err().map_or_else(String::new, |e| e.to_string())
        };
        let of_poses = |name: &str| POSES.contains(&name);
        assert!(
            error(&|name, _, v| if of_poses(name) {
                v[0] = f32::NAN
            })
            .contains("image 0")
        );
        assert!(
            error(&|name, _, v| if of_poses(name) {
                v[0] = 7.0
            })
            .contains("image 0")
        );
        assert!(
            error(&|name, shape, _| if of_poses(name) {
                *shape = vec![2, 12]
            })
            .contains("axes")
        );
        assert!(
            error(&|name, shape, _| if name == DEPTH {
                *shape = vec![2, 4, 2, 1]
            })
            .contains("do not fit")
        );
        assert!(
            error(&|name, _, v| if LENSES.contains(&name) {
                v[0] = -1.0
            })
            .contains("image 0")
        );
        let mut other = Vec::new();
        write_archive(&[("depth", &[1], &[1.0])], &mut other).unwrap();
        let said = Predicted::read(&other).err().unwrap().to_string();
        assert!(said.contains("`images` or `image`") && said.contains("but depth"), "{said}");
        assert!(Predicted::read(b"PK").is_err());
    }
}
