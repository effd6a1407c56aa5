//! Cameras of a reconstruction without its images: for other images of the same rig.

use super::json::{self, Node};
use super::transforms::posed_frames;
use super::{PointCloud, colmap, rig};
use splat4d::math::Se3;
use splat4d::scene::{Camera, Intrinsics};
use splat4d::{Error, Result};
use std::path::Path;

/// A named camera with its pose, intrinsics, lens and image size.
#[derive(Clone, Debug, PartialEq)]
pub struct PosedCamera {
    /// The folder of its images, or the name of its only one without the ending.
    pub name: String,
    /// The camera.
    pub camera: Camera,
}

/// Largest difference of the numbers of poses that are one pose: rounding of text files.
const SAME: f64 = 1e-6;

/// The cameras of a COLMAP reconstruction (the folder of its files, or one above), and its points.
///
/// Errors: no reconstruction, damage, a camera with several positions.
pub fn colmap_cameras(folder: &Path) -> Result<(Vec<PosedCamera>, Option<PointCloud>)> {
    let (shots, points) = colmap::shots(folder)?;
    Ok((of_images(&shots).map_err(|e| e.at(folder.display()))?, points))
}

/// Whether a folder holds a COLMAP reconstruction, itself or in numbered folders.
pub fn is_colmap(folder: &Path) -> bool {
    colmap::is_model(folder)
}

/// The cameras of a `transforms.json` (Nerfstudio, instant-ngp, Blender), whose images need not be there.
///
/// Errors: no such file, keys that are missing or wrong, a camera with several positions.
pub fn transforms_cameras(path: &Path) -> Result<Vec<PosedCamera>> {
    let value = json::read(path)?;
    let root = path.parent().unwrap_or(Path::new("."));
    let shots = posed_frames(root, &Node::root(&value)).and_then(|shots| of_images(&shots));
    shots.map_err(|e| e.at(path.display()))
}

/// A pose whose rounding is removed. Errors: NaN, mirrored, scaled or sheared.
pub fn rigid(pose: Se3) -> Result<Se3> {
    super::pose::checked(pose)
}

/// An error unless focal lengths and size are possible.
pub fn check_intrinsics(k: &Intrinsics, width: usize, height: usize) -> Result<()> {
    super::pose::check_intrinsics(k, width, height)
}

fn of_images(shots: &[(String, Camera)]) -> Result<Vec<PosedCamera>> {
    let names: Vec<&str> = shots.iter().map(|(name, _)| name.as_str()).collect();
    let naming = rig::naming(&names);
    let mut out: Vec<PosedCamera> = Vec::new();
    for ((path, camera), (number, _)) in shots.iter().zip(&naming.frames) {
        let name = if naming.stated { naming.cameras[*number].clone() } else { stem(path).to_owned() };
        match out.iter().find(|c| c.name == name) {
            None => out.push(PosedCamera { name, camera: camera.clone() }),
            Some(known) if alike(&known.camera, camera) => {}
            Some(_) => {
                return Err(Error::input(format!("camera {name:.80} has several positions, as {path:.200} shows"))
                    .remedy("A calibration describes fixed cameras: give a reconstruction of one time."));
            }
        }
    }
    Ok(out)
}

fn alike(a: &Camera, b: &Camera) -> bool {
    let (p, q) = (&a.cam_from_world, &b.cam_from_world);
    let numbers = |s: &Se3| s.rotation.iter().flatten().chain(&s.translation).copied().collect::<Vec<f64>>();
    let size = 1.0 + p.translation.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let same = numbers(p).iter().zip(numbers(q)).all(|(x, y)| (x - y).abs() <= SAME * size);
    same && a.intrinsics == b.intrinsics && a.lens == b.lens && (a.width, a.height) == (b.width, b.height)
}

/// A file's name without folders and ending.
fn stem(path: &str) -> &str {
    let file = path.rsplit(['/', '\\']).next().unwrap_or(path);
    file.rsplit_once('.').map_or(file, |(stem, _)| stem)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn cameras_are_read_without_their_images() {
        let dir = tempfile::tempdir().unwrap();
        let frame = |path: &str, x: f64| {
            json!({"file_path": path,
                   "transform_matrix": [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]})
        };
        let path = dir.path().join("transforms.json");
        let write = |frames: Vec<serde_json::Value>| {
            let top = json!({"fl_x": 500.0, "w": 640, "h": 480, "frames": frames});
            std::fs::write(&path, top.to_string()).unwrap();
        };
        write(vec![frame("images/left.jpg", 1.0), frame("images/right.jpg", 2.0)]);
        let cameras = transforms_cameras(&path).unwrap();
        let names: Vec<&str> = cameras.iter().map(|c| c.name.as_str()).collect();
        assert_eq!(names, ["left", "right"]);
        assert_eq!((cameras[1].camera.center(), cameras[1].camera.intrinsics.fx), ([2.0, 0.0, 0.0], 500.0));
        write(vec![frame("a/0.jpg", 1.0), frame("a/1.jpg", 1.0), frame("b/0.jpg", 2.0)]);
        assert_eq!(transforms_cameras(&path).unwrap().len(), 2);
        write(vec![frame("a/0.jpg", 1.0), frame("a/1.jpg", 1.5), frame("b/0.jpg", 2.0)]);
        assert!(transforms_cameras(&path).unwrap_err().to_string().contains("several positions"));
        let top = json!({"fl_x": 500.0, "frames": [frame("a.jpg", 1.0)]});
        std::fs::write(&path, top.to_string()).unwrap();
        let lost = transforms_cameras(&path).unwrap_err().to_string();
        assert!(lost.contains("a.jpg") && lost.contains("missing"), "{lost}");
    }
}
