//! One frame of a transforms file: its picture, pose, lens and time. What a frame says of itself goes before what the
//! file says for all.

use super::super::json::Node;
use super::super::{DepthFile, DepthKind, Split, panorama, picture, pose, rig};
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};
use std::f64::consts::PI;
use std::path::{Path, PathBuf};

/// One entry of `frames`.
pub(super) struct Entry {
    /// `file_path` as it is written.
    pub name: String,
    /// The picture.
    pub image: PathBuf,
    /// Pose, intrinsics and lens.
    pub source: Camera,
    /// Whether the focal length is an angle of view and no number of pixels: Blender's way.
    pub by_angle: bool,
    /// As it is written.
    pub time: Option<f64>,
    /// The mask.
    pub mask: Option<PathBuf>,
    /// The depth map.
    pub depth: Option<DepthFile>,
    /// What it is for.
    pub split: Split,
}

/// Reads `node`, a frame of the file `top`.
pub(super) fn read(root: &Path, top: &Node<'_>, node: &Node<'_>) -> Result<Entry> {
    let name = node.get("file_path")?.text()?;
    let image = image_path(root, name)?;
    let (source, by_angle) = camera(top, node, &|| Ok(image.clone()))?;
    let time = node.opt("time")?.map(|n| n.number()).transpose()?;
    let mask = node.opt("mask_path")?.map(|n| Ok(root.join(n.text()?))).transpose()?;
    let depth = node.opt("depth_file_path")?.map(|n| depth(root, top, node, n.text()?)).transpose()?;
    Ok(Entry { name: name.into(), image, source, by_angle, time, mask, depth, split: Split::Train })
}

/// Nerfstudio's name for equirectangular panoramas, whose focal lengths say nothing.
const PANORAMA: &str = "EQUIRECTANGULAR";

/// Units of the scene a stored number of a depth map where a file does not say: thousandths, as Nerfstudio has it.
const DEPTH_UNIT: f64 = 1e-3;

/// A depth map in units of `depth_unit_scale_factor`, whatever its kind of file (Nerfstudio).
fn depth(root: &Path, top: &Node<'_>, node: &Node<'_>, name: &str) -> Result<DepthFile> {
    let key = "depth_unit_scale_factor";
    let scale = number(top, node, key)?.unwrap_or(DEPTH_UNIT);
    if scale <= 0.0 {
        let what = format!("{key} is {scale}");
        return Err(node.error(what).remedy("Give the scene units of a stored number, for instance 0.001"));
    }
    Ok(DepthFile { path: root.join(name), scale, kind: DepthKind::Metric })
}

/// The name and camera of a frame whose picture need not be there where the size is stated.
pub(super) fn posed(root: &Path, top: &Node<'_>, node: &Node<'_>) -> Result<(String, Camera)> {
    let name = node.get("file_path")?.text()?;
    Ok((name.to_owned(), camera(top, node, &|| image_path(root, name))?.0))
}

/// Pose, intrinsics and lens, and whether the focal length is an angle of view. `image` is asked where no size is stated.
fn camera(top: &Node<'_>, node: &Node<'_>, image: &dyn Fn() -> Result<PathBuf>) -> Result<(Camera, bool)> {
    let matrix = node.get("transform_matrix")?;
    let cam_from_world = pose::from_opengl(&matrix.matrix4()?).map_err(|e| matrix.at(e))?;
    let (width, height) = size(top, node, image)?;
    let model = value(top, node, "camera_model")?.map(|n| n.text()).transpose()?;
    if model == Some(PANORAMA) {
        let (intrinsics, lens) = panorama::whole([width, height]);
        return Ok((Camera { cam_from_world, intrinsics, lens, width, height, near: Camera::NEAR }, false));
    }
    let fx = focal(top, node, ["fl_x", "camera_angle_x", "x_fov"], width)?;
    let (fx, by_angle) = fx.ok_or_else(|| {
        node.error("neither fl_x nor camera_angle_x is given")
            .remedy("Add one of them, to the frame or to the whole file.")
    })?;
    let fy = focal(top, node, ["fl_y", "camera_angle_y", "y_fov"], height)?.map_or(fx, |(fy, _)| fy);
    let cx = number(top, node, "cx")?.unwrap_or(0.5 * width as f64);
    let cy = number(top, node, "cy")?.unwrap_or(0.5 * height as f64);
    let intrinsics = Intrinsics { fx, fy, cx, cy };
    pose::check_intrinsics(&intrinsics, width, height).map_err(|e| node.at(e))?;
    let lens = lens(top, node)?;
    Ok((Camera { cam_from_world, intrinsics, lens, width, height, near: Camera::NEAR }, by_angle))
}

/// The frame's own value, else that of the file.
fn value<'a>(top: &Node<'a>, node: &Node<'a>, key: &str) -> Result<Option<Node<'a>>> {
    Ok(node.opt(key)?.or(top.opt(key)?))
}

fn number(top: &Node<'_>, node: &Node<'_>, key: &str) -> Result<Option<f64>> {
    value(top, node, key)?.map(|n| n.number()).transpose()
}

/// The size that the intrinsics are for: as it is stated, else the picture's.
fn size(top: &Node<'_>, node: &Node<'_>, image: &dyn Fn() -> Result<PathBuf>) -> Result<(usize, usize)> {
    let side = |key: &str| value(top, node, key)?.map(|n| n.count()).transpose();
    if let (Some(width), Some(height)) = (side("w")?, side("h")?) {
        return Ok((width, height));
    }
    let header = picture::header(&image()?)?;
    Ok((header.width, header.height))
}

/// The focal length along a side, pixels, and whether it comes from an angle of view. `keys`: pixels, radians, degrees
/// (instant-ngp).
fn focal(top: &Node<'_>, node: &Node<'_>, keys: [&str; 3], side: usize) -> Result<Option<(f64, bool)>> {
    let [pixels, radians, degrees] = keys;
    for level in [node, top] {
        if let Some(focal) = level.opt(pixels)? {
            return Ok(Some((focal.number()?, false)));
        }
        for (key, unit) in [(radians, 1.0), (degrees, PI / 180.0)] {
            let Some(angle) = level.opt(key)? else { continue };
            let fov = unit * angle.number()?;
            if !(fov > 0.0 && fov < PI) {
                return Err(angle
                    .error(format!("the field of view is {fov} rad"))
                    .remedy("It must lie between 0 and π."));
            }
            return Ok(Some((0.5 * side as f64 / (0.5 * fov).tan(), true)));
        }
    }
    Ok(None)
}

fn lens(top: &Node<'_>, node: &Node<'_>) -> Result<Lens> {
    let term = |key: &str| -> Result<f64> { Ok(number(top, node, key)?.unwrap_or(0.0)) };
    let k = [term("k1")?, term("k2")?, term("k3")?, term("k4")?];
    let p = [term("p1")?, term("p2")?];
    // instant-ngp's word for it.
    let fisheye = value(top, node, "is_fisheye")?.is_some_and(|n| n.value.as_bool() == Some(true));
    let model = value(top, node, "camera_model")?.map(|n| n.text()).transpose()?;
    let unsupported = |what: String| {
        node.at(Error::new(ErrorKind::Unsupported, what))
            .remedy("Undistort the pictures to pinhole ones first (colmap image_undistorter).")
    };
    match model.unwrap_or(if fisheye { "OPENCV_FISHEYE" } else { "OPENCV" }) {
        "OPENCV_FISHEYE" => Ok(Lens::Fisheye { k }),
        "PINHOLE" | "SIMPLE_PINHOLE" | "OPENCV" | "SIMPLE_RADIAL" | "RADIAL" | "PERSPECTIVE" => {
            if k == [0.0; 4] && p == [0.0; 2] {
                return Ok(Lens::Pinhole);
            }
            if k[3] != 0.0 {
                // Nerfstudio's k4 multiplies r⁸ there, which OpenCV's model (ours) does not have.
                return Err(unsupported("k4 of the perspective camera is not zero".into()));
            }
            Ok(Lens::Brown { k: [k[0], k[1], k[2], 0.0, 0.0, 0.0], p, s: [0.0; 4] })
        }
        other => Err(unsupported(format!("the camera model {other:.40} is not read"))),
    }
}

/// `file_path` with or without its ending, and with either slash.
fn image_path(root: &Path, text: &str) -> Result<PathBuf> {
    let path = root.join(text.strip_prefix("./").unwrap_or(text));
    let slashes = root.join(text.replace('\\', "/"));
    if let Some(found) = [&path, &slashes].into_iter().find(|p| p.is_file()) {
        return Ok(found.clone());
    }
    let named = |ending: &&str| PathBuf::from(format!("{}.{ending}", path.display()));
    let found = rig::IMAGE_ENDINGS.iter().map(named).find(|p| p.is_file());
    found.ok_or_else(|| {
        Error::input("the picture is missing (also with .png, .jpg, .jpeg and .webp)")
            .at(path.display())
            .remedy("Restore the file, or take the frame out of the transforms file.")
    })
}
