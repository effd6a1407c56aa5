//! One frame of a transforms file: its image, pose, lens and time. Values of a frame have priority over those of the
//! file states for all.

use super::super::convention::{Convention, Poses};
use super::super::json::Node;
use super::super::lookup::Lookup;
use super::super::{DepthFile, DepthKind, Split, panorama, picture, pose};
use splat4d::math::Se3;
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};
use std::collections::BTreeSet;
use std::f64::consts::PI;
use std::path::{Path, PathBuf};

/// One entry of `frames`.
pub(super) struct Entry {
    /// `file_path` as written.
    pub name: String,
    /// The image.
    pub image: PathBuf,
    /// Pose, intrinsics and lens.
    pub source: Camera,
    /// Whether the focal length is an angle of view instead of pixels: Blender's way.
    pub by_angle: bool,
    /// As written.
    pub time: Option<f64>,
    /// The mask.
    pub mask: Option<PathBuf>,
    /// The depth map.
    pub depth: Option<DepthFile>,
    /// Its purpose.
    pub split: Split,
}

/// A transforms file that is being read.
pub(super) struct File<'a> {
    /// Its folder, and how its files are found.
    pub lookup: &'a Lookup,
    /// Lookup of images.
    pub bases: &'a [PathBuf],
    /// The whole file.
    pub top: &'a Node<'a>,
    /// Convention of the poses.
    pub poses: Poses,
    /// The size of an image that is there: that of missing ones where none is stated.
    pub size: Option<(usize, usize)>,
}

/// Reads `node`, a frame of the file.
pub(super) fn read(file: &File<'_>, node: &Node<'_>) -> Result<Entry> {
    let name = node.needed("file_path")?.text()?;
    let image = file.lookup.image_or_place(file.bases, name).map_err(|e| node.at(e))?;
    let (source, by_angle) = camera(file, node, &image)?;
    let time = node.opt("time")?.map(|n| n.number()).transpose()?;
    let beside = |n: Node<'_>| file.lookup.file(n.text()?).map_err(|e| n.at(e));
    // An empty path is none.
    let path = |key: &str| Ok::<_, Error>(node.opt(key)?.filter(|n| n.value.as_str() != Some("")));
    let mask = path("mask_path")?.map(beside).transpose()?;
    let depth = path("depth_file_path")?.map(|n| depth(file.top, node, beside(n)?)).transpose()?;
    // Names separate cameras by forward slashes.
    Ok(Entry { name: name.replace('\\', "/"), image, source, by_angle, time, mask, depth, split: Split::Train })
}

/// Names for equirectangular panoramas, whose focal lengths say nothing: Nerfstudio's, and that of other programs.
const PANORAMAS: [&str; 2] = ["EQUIRECTANGULAR", "SPHERICAL"];

/// Scene units per stored number of a depth map where a file does not state it: thousandths, as in Nerfstudio.
const DEPTH_UNIT: f64 = 1e-3;

/// A depth map in units of `depth_unit_scale_factor`, whatever its kind of file (Nerfstudio).
fn depth(top: &Node<'_>, node: &Node<'_>, path: PathBuf) -> Result<DepthFile> {
    let key = "depth_unit_scale_factor";
    let scale = number(top, node, key)?.unwrap_or(DEPTH_UNIT);
    if scale <= 0.0 {
        let what = format!("{key} is {scale}");
        return Err(node.error(what).remedy("Give the scene units of a stored number, for instance 0.001"));
    }
    Ok(DepthFile { path, scale, kind: DepthKind::Metric, fit: None })
}

/// The name and camera of a frame whose image need not be there where the size is stated.
pub(super) fn posed(file: &File<'_>, node: &Node<'_>) -> Result<(String, Camera)> {
    let name = node.get("file_path")?.text()?;
    let image = file.lookup.image_or_place(file.bases, name).map_err(|e| node.at(e))?;
    Ok((name.replace('\\', "/"), camera(file, node, &image)?.0))
}

/// Pose, intrinsics and lens, and whether the focal length is an angle of view. `image` is examined where no size is
/// stated.
fn camera(file: &File<'_>, node: &Node<'_>, image: &Path) -> Result<(Camera, bool)> {
    let top = file.top;
    let matrix = node.needed("transform_matrix")?;
    let raw = pose::checked(Se3::from_rows(&matrix.pose4(file.poses)?)).map_err(|e| matrix.at(e))?;
    let cam_from_world = Convention::NERF.read_as(raw, file.poses)?;
    let (width, height) = size(file, node, image)?;
    let model = value(top, node, "camera_model")?.map(|n| n.text()).transpose()?;
    if model.is_some_and(|m| PANORAMAS.iter().any(|name| m.eq_ignore_ascii_case(name))) {
        let (intrinsics, lens) = panorama::whole([width, height]);
        return Ok((Camera { cam_from_world, intrinsics, lens, width, height, near: Camera::NEAR }, false));
    }
    let fx = focal(top, node, ["fl_x", "camera_angle_x", "x_fov"], width)?;
    let fy = focal(top, node, ["fl_y", "camera_angle_y", "y_fov"], height)?;
    // A single angle of view is a choice of its writer, and pixels are then square; fl_y alone has lost its fl_x.
    let (fx, by_angle) = fx.or(fy.filter(|(_, by_angle)| *by_angle)).ok_or_else(|| {
        node.error("neither fl_x nor camera_angle_x is given")
            .remedy("Add one of them, to the frame or to the whole file.")
    })?;
    let fy = fy.map_or(fx, |(fy, _)| fy);
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

/// The size that the intrinsics belong to: as stated, else the image's.
fn size(file: &File<'_>, node: &Node<'_>, image: &Path) -> Result<(usize, usize)> {
    let side = |key: &str| value(file.top, node, key)?.map(|n| n.count()).transpose();
    if let (Some(width), Some(height)) = (side("w")?, side("h")?) {
        return Ok((width, height));
    }
    if let Some(size) = file.size.filter(|_| !image.is_file()) {
        return Ok(size);
    }
    if !image.is_file() {
        return Err(Error::input("the image is missing, and no size (w, h) is stated")
            .at(image.display())
            .remedy("Restore the image, or state the size."));
    }
    picture::header(image).map(|header| header.upright())
}

/// The focal length along a side, pixels, and whether it is derived from an angle of view. `keys`: pixels, radians,
/// degrees (instant-ngp).
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
                    .error(format!("invalid field of view {fov} rad"))
                    .remedy("It must lie between 0 and π."));
            }
            return Ok(Some((0.5 * side as f64 / (0.5 * fov).tan(), true)));
        }
    }
    Ok(None)
}

/// By how much an angle of view and a focal length in pixels may differ: angles are sometimes of undistorted images.
const SAME_FOCAL: f64 = 1.1;

/// The remark if the file's angle of view contradicts its focal length in pixels, which is the one that is read.
pub(super) fn contradiction(top: &Node<'_>, entries: &[Entry]) -> Result<Option<String>> {
    let (Some(angle), Some(entry)) = (top.opt("camera_angle_x")?, entries.first()) else { return Ok(None) };
    let (angle, camera) = (angle.number()?, &entry.source);
    let by_angle = 0.5 * camera.width as f64 / (0.5 * angle).tan();
    let ratio = by_angle / camera.intrinsics.fx;
    let equal = (1.0 / SAME_FOCAL..=SAME_FOCAL).contains(&ratio) || entry.by_angle;
    Ok((!equal && ratio > 0.0).then(|| {
        format!(
            "camera_angle_x and fl_x differ: {angle:.4} rad of an image {} px wide is a focal length of {by_angle:.1} px, and fl_x is \
             {:.1} px, which is read. One of them is of another image size.",
            camera.width, camera.intrinsics.fx
        )
    }))
}

fn lens(top: &Node<'_>, node: &Node<'_>) -> Result<Lens> {
    let term = |key: &str| -> Result<f64> { Ok(number(top, node, key)?.unwrap_or(0.0)) };
    let mut k = [term("k1")?, term("k2")?, term("k3")?, term("k4")?, term("k5")?, term("k6")?];
    let mut p = [term("p1")?, term("p2")?];
    let s = [term("s1")?, term("s2")?, term("s3")?, term("s4")?];
    if let Some(list) = value(top, node, "distortion_params")? {
        // Nerfstudio: k1 k2 k3 k4 p1 p2, in place of the single keys.
        let given = list.numbers::<6>()?;
        k = [given[0], given[1], given[2], given[3], 0.0, 0.0];
        p = [given[4], given[5]];
    }
    let unsupported = |what: String| {
        node.at(Error::new(ErrorKind::Unsupported, what))
            .remedy("Undistort the images to pinhole ones first (colmap image_undistorter).")
    };
    let other = FOREIGN_LENSES.iter().find(|key| {
        let given = value(top, node, key).ok().flatten();
        given.is_some_and(|n| n.value.as_bool() == Some(true) || n.value.as_f64().is_some_and(|x| x != 0.0))
    });
    if let Some(key) = other {
        return Err(unsupported(format!("the lens of \"{key}\" is not read")));
    }
    // instant-ngp's word for it.
    let fisheye = match value(top, node, "is_fisheye")? {
        None => false,
        Some(n) => n
            .value
            .as_bool()
            .or_else(|| n.value.as_f64().map(|x| x != 0.0))
            .ok_or_else(|| n.error("is_fisheye is neither true nor false").remedy("Write true or false."))?,
    };
    let model = value(top, node, "camera_model")?.map(|n| n.text()).transpose()?.map(str::to_ascii_uppercase);
    let model = model.as_deref();
    match model.unwrap_or(if fisheye { "OPENCV_FISHEYE" } else { "OPENCV" }) {
        "OPENCV_FISHEYE" if k[4..] != [0.0; 2] || p != [0.0; 2] || s != [0.0; 4] => {
            Err(unsupported("a fisheye lens has k1 to k4; k5, k6, p1, p2 or s1 to s4 are not zero".into()))
        }
        "OPENCV_FISHEYE" => Ok(Lens::Fisheye { k: [k[0], k[1], k[2], k[3]] }),
        "PINHOLE" | "SIMPLE_PINHOLE" | "OPENCV" | "FULL_OPENCV" | "SIMPLE_RADIAL" | "RADIAL" | "PERSPECTIVE" => {
            if k == [0.0; 6] && p == [0.0; 2] && s == [0.0; 4] {
                return Ok(Lens::Pinhole);
            }
            // With k5 or k6 the terms are those of OpenCV's rational lens.
            let rational = k[4..] != [0.0; 2] || model == Some("FULL_OPENCV");
            if k[3] != 0.0 && !rational {
                // Nerfstudio's k4 multiplies r⁸ there, which OpenCV's model (ours) does not have.
                return Err(unsupported("k4 of the perspective camera is not zero".into()));
            }
            Ok(Lens::Brown { k, p, s })
        }
        other => Err(unsupported(format!("the camera model {other:.40} is not read"))),
    }
}

/// Keys of lenses that are not modelled: instant-ngp's, and OpenCV's tilted sensor.
const FOREIGN_LENSES: &[&str] = &[
    "latlong",
    "is_latlong",
    "equirectangular",
    "is_equirectangular",
    "orthographic",
    "ftheta_p0",
    "ftheta_p1",
    "ftheta_p2",
    "ftheta_p3",
    "ftheta_p4",
    "tx",
    "ty",
    "taux",
    "tauy",
];
/// Keys that are read, at the top or in a frame.
const READ: &[&str] = &[
    "frames",
    "file_path",
    "transform_matrix",
    "fl_x",
    "fl_y",
    "camera_angle_x",
    "camera_angle_y",
    "x_fov",
    "y_fov",
    "cx",
    "cy",
    "w",
    "h",
    "camera_model",
    "is_fisheye",
    "k1",
    "k2",
    "k3",
    "k4",
    "k5",
    "k6",
    "p1",
    "p2",
    "s1",
    "s2",
    "s3",
    "s4",
    "distortion_params",
    "time",
    "mask_path",
    "depth_file_path",
    "depth_unit_scale_factor",
    "fps",
    "train_filenames",
    "test_filenames",
    "val_filenames",
    "ply_file_path",
    "applied_transform",
];
/// Keys that carry no information about poses, lenses and times: sizes of other programs' volumes, statistics, names.
const HARMLESS: &[&str] = &[
    "aabb_scale",
    "aabb",
    "scale",
    "offset",
    "sharpness",
    "colmap_im_id",
    "camera_id",
    "id",
    "name",
    "applied_scale",
    "orientation_override",
    "rotation",
    "render_aabb",
    "up",
    "from_na",
    "n_extra_learnable_dims",
    "comment",
];

/// Words of other programs for keys that are read.
const OTHER_WORDS: &[(&str, &str)] = &[
    ("width", "w"),
    ("height", "h"),
    ("fx", "fl_x"),
    ("fy", "fl_y"),
    ("focal_x", "fl_x"),
    ("focal_y", "fl_y"),
    ("focal", "fl_x"),
    ("focal_length", "fl_x"),
    ("px", "cx"),
    ("py", "cy"),
    ("fov", "camera_angle_x"),
    ("fov_x", "camera_angle_x"),
    ("fovx", "camera_angle_x"),
    ("model", "camera_model"),
    ("distortion", "distortion_params"),
    ("distortion_coeffs", "distortion_params"),
    ("mask", "mask_path"),
    ("mask_file_path", "mask_path"),
    ("ply_path", "ply_file_path"),
    ("train_files", "train_filenames"),
    ("test_files", "test_filenames"),
    ("split", "train_filenames"),
    ("train_ids", "train_filenames"),
    ("train_split", "train_filenames"),
    ("test_ids", "test_filenames"),
    ("test_split", "test_filenames"),
    ("timestamp", "time"),
    ("timestep", "time"),
    ("timestep_index", "time"),
    ("time_index", "time"),
    ("time_id", "time"),
    ("frame_id", "time"),
    ("frame_index", "time"),
    ("frame_number", "time"),
    ("framerate", "fps"),
    ("frame_rate", "fps"),
];

/// Keys that are not read and are like others that are, which are missing there: each with the one that it is like.
pub(super) fn mistaken(top: &Node<'_>) -> Vec<String> {
    let frames = top.value.get("frames").and_then(|v| v.as_array()).map_or(&[][..], Vec::as_slice);
    let folded = |key: &str| key.to_ascii_lowercase().replace(['_', '-'], "");
    let mut found = BTreeSet::new();
    for object in frames.iter().chain([top.value]).filter_map(|v| v.as_object()) {
        for key in object.keys().filter(|key| !READ.contains(&key.as_str())) {
            let other = OTHER_WORDS.iter().find(|(word, _)| folded(word) == folded(key)).map(|(_, meant)| *meant);
            let meant = READ.iter().find(|read| folded(read) == folded(key)).copied().or(other);
            let missing = |meant: &&str| !object.contains_key(*meant) && top.value.get(*meant).is_none();
            if let Some(meant) = meant.filter(missing) {
                found.insert(format!("{key:.40} (meant {meant}?)"));
            }
        }
    }
    found.into_iter().collect()
}

/// Keys of a file that are not read and might matter, each once.
pub(super) fn unread(top: &Node<'_>) -> Vec<String> {
    let frames = top.value.get("frames").and_then(|v| v.as_array()).map_or(&[][..], Vec::as_slice);
    let objects = frames.iter().chain([top.value]).filter_map(|v| v.as_object());
    let known = |key: &&String| [READ, HARMLESS, FOREIGN_LENSES].iter().any(|keys| keys.contains(&key.as_str()));
    let keys: BTreeSet<&String> = objects.flat_map(|o| o.keys()).filter(|k| !known(k)).collect();
    keys.into_iter().map(|k| format!("{k:.40}")).collect()
}
