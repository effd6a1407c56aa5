//! Nerfstudio captures: one `transforms.json`, OpenGL axes, intrinsics for all frames or each.
//!
//! `ply_file_path` and the poses are both written after `applied_transform`, so neither needs it here: the scene keeps
//! the file's own world.

use super::json::{self, Node};
use super::points::read_ply;
use super::{CaptureKind, CaptureOptions, RawFrame, Split, Take, picture, pose, rig};
use splat4d::math::Se3;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};
use std::collections::BTreeMap;
use std::path::Path;

/// What one entry of `frames` says.
struct Entry<'a> {
    name: &'a str,
    source: Camera,
    time: Option<f64>,
    mask: Option<&'a str>,
    split: Split,
}

/// Reads `transforms.json`. Cameras are told apart by picture names (`cam/frame`), else by repeated poses; times come
/// from `time` (0..1 over the take, or seconds where any value is above 1), else from frame numbers.
pub(super) fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<Take> {
    let value = json::read(marker)?;
    read_value(root, &Node::root(&value), options).map_err(|e| e.at(marker.display()))
}

fn read_value(root: &Path, top: &Node<'_>, options: &CaptureOptions) -> Result<Take> {
    let fps = match (options.fps, top.opt("fps")?) {
        (Some(fps), _) => fps,
        (None, Some(fps)) => fps.number()?,
        (None, None) => DEFAULT_FPS,
    };
    super::options::check_rate("frame rate", fps)?;
    if let Some(applied) = top.opt("applied_transform")? {
        applied.matrix4()?;
    }
    let splits = Splits::read(top)?;
    let mut entries = Vec::new();
    for node in top.get("frames")?.list()? {
        entries.push(read_frame(root, top, &node, &splits)?);
    }
    let mut warnings = Vec::new();
    let names: Vec<&str> = entries.iter().map(|e| e.name).collect();
    let mut naming = rig::naming(&names);
    if !naming.told {
        name_by_pose(&entries, &mut naming);
    }
    let clock = clock(&entries, &naming, fps, options, &mut warnings);
    let frames =
        entries.into_iter().zip(naming.frames).zip(clock).map(|((entry, (camera, _)), (time, index))| RawFrame {
            camera,
            source: entry.source,
            time,
            index,
            image: root.join(entry.name),
            mask: entry.mask.map(|m| root.join(m)),
            flow: None,
            split: entry.split,
        });
    let points = top.opt("ply_file_path")?.map(|n| read_ply(&root.join(n.text()?))).transpose()?;
    Ok(Take {
        name: None,
        root: root.to_path_buf(),
        kind: CaptureKind::Nerfstudio,
        cameras: naming.cameras,
        frames: frames.collect(),
        named: naming.told,
        hold_out: None,
        fps,
        points,
        background: None,
        up: None,
        warnings,
    })
}

/// The optional lists of file names by split.
struct Splits<'a> {
    test: Vec<&'a str>,
    validation: Vec<&'a str>,
}

impl<'a> Splits<'a> {
    fn read(top: &Node<'a>) -> Result<Self> {
        let names = |key: &str| -> Result<Vec<&'a str>> {
            let list = top.opt(key)?.map(|n| n.list()).transpose()?.unwrap_or_default();
            let mut names = list.iter().map(|n| n.text()).collect::<Result<Vec<_>>>()?;
            names.sort_unstable();
            Ok(names)
        };
        let (test, validation) = (names("test_filenames")?, names("val_filenames")?);
        // Only a validation list: that is what there is to measure on.
        Ok(if test.is_empty() { Self { test: validation, validation: test } } else { Self { test, validation } })
    }

    fn of(&self, name: &str) -> Split {
        if self.test.binary_search(&name).is_ok() {
            Split::Held
        } else if self.validation.binary_search(&name).is_ok() {
            Split::Validation
        } else {
            Split::Train
        }
    }
}

fn read_frame<'a>(root: &Path, top: &Node<'a>, node: &Node<'a>, splits: &Splits<'a>) -> Result<Entry<'a>> {
    let name = node.get("file_path")?.text()?;
    let matrix = node.get("transform_matrix")?;
    let cam_from_world = pose::from_opengl(&matrix.matrix4()?).map_err(|e| matrix.at(e))?;
    let shared =
        |key: &str| -> Result<Option<f64>> { node.opt(key)?.or(top.opt(key)?).map(|n| n.number()).transpose() };
    let size = |key: &str| -> Result<Option<usize>> { node.opt(key)?.or(top.opt(key)?).map(|n| n.count()).transpose() };
    let (width, height) = match (size("w")?, size("h")?) {
        (Some(w), Some(h)) => (w, h),
        _ => {
            let header = picture::header(&root.join(name))?;
            (header.width, header.height)
        }
    };
    let fx = match (shared("fl_x")?, shared("camera_angle_x")?) {
        (Some(fx), _) => fx,
        (None, Some(angle)) => 0.5 * width as f64 / (0.5 * angle).tan(),
        (None, None) => return Err(node.error("neither fl_x nor camera_angle_x is given").remedy("Add one of them.")),
    };
    let fy = match (shared("fl_y")?, shared("camera_angle_y")?) {
        (Some(fy), _) => fy,
        (None, Some(angle)) => 0.5 * height as f64 / (0.5 * angle).tan(),
        (None, None) => fx,
    };
    let cx = shared("cx")?.unwrap_or(0.5 * width as f64);
    let cy = shared("cy")?.unwrap_or(0.5 * height as f64);
    let terms = |keys: [&str; 4]| -> Result<[f64; 4]> {
        let mut out = [0.0; 4];
        for (slot, key) in out.iter_mut().zip(keys) {
            *slot = shared(key)?.unwrap_or(0.0);
        }
        Ok(out)
    };
    let k = terms(["k1", "k2", "k3", "k4"])?;
    let [p1, p2, ..] = terms(["p1", "p2", "p1", "p2"])?;
    let model = node.opt("camera_model")?.or(top.opt("camera_model")?).map(|n| n.text()).transpose()?;
    let lens = lens(model.unwrap_or("OPENCV"), k, [p1, p2]).map_err(|e| node.at(e))?;
    let source =
        Camera { cam_from_world, intrinsics: Intrinsics { fx, fy, cx, cy }, lens, width, height, near: Camera::NEAR };
    let time = node.opt("time")?.map(|n| n.number()).transpose()?;
    let mask = node.opt("mask_path")?.map(|n| n.text()).transpose()?;
    Ok(Entry { name, source, time, mask, split: splits.of(name) })
}

fn lens(model: &str, k: [f64; 4], p: [f64; 2]) -> Result<Lens> {
    let unsupported = |what: String| {
        Error::new(ErrorKind::Unsupported, what)
            .remedy("Undistort the pictures to pinhole ones first (colmap image_undistorter).")
    };
    match model {
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
        "OPENCV_FISHEYE" => Ok(Lens::Fisheye { k }),
        other => Err(unsupported(format!("the camera model {other:.40} is not read"))),
    }
}

/// Without camera names, frames that share a pose to the last bit come from one fixed camera, provided that there are
/// clearly fewer poses than frames.
fn name_by_pose(entries: &[Entry<'_>], naming: &mut rig::Naming) {
    let key = |pose: &Se3| -> Vec<u64> {
        pose.rotation.iter().flatten().chain(&pose.translation).map(|v| v.to_bits()).collect()
    };
    let mut ids: BTreeMap<Vec<u64>, usize> = BTreeMap::new();
    let cameras: Vec<usize> = entries
        .iter()
        .map(|e| {
            let next = ids.len();
            *ids.entry(key(&e.source.cam_from_world)).or_insert(next)
        })
        .collect();
    if ids.len() < 2 || 2 * ids.len() > entries.len() || entries.iter().any(|e| e.time.is_none()) {
        return;
    }
    naming.cameras = (0..ids.len()).map(|i| format!("view{i:03}")).collect();
    for (frame, camera) in naming.frames.iter_mut().zip(cameras) {
        frame.0 = camera;
    }
}

/// (seconds, frame number) of every entry.
fn clock(
    entries: &[Entry<'_>],
    naming: &rig::Naming,
    fps: f64,
    options: &CaptureOptions,
    warnings: &mut Vec<String>,
) -> Vec<(f64, usize)> {
    let told: Option<Vec<f64>> = entries.iter().map(|e| e.time).collect();
    let Some(told) = told.filter(|t| !t.is_empty()) else {
        if entries.iter().any(|e| e.time.is_some()) {
            warnings.push("Some frames have a time and some have none; times are taken from the names instead.".into());
        }
        return naming.frames.iter().map(|&(_, number)| (number as f64 / fps, number)).collect();
    };
    let mut instants = told.clone();
    instants.sort_by(f64::total_cmp);
    instants.dedup();
    let unit = instants.iter().all(|t| (0.0..=1.0).contains(t));
    let scale = match (unit, options.unit_time_seconds) {
        (true, Some(seconds)) => seconds,
        (true, None) => ((instants.len() - 1) as f64 / fps).max(f64::MIN_POSITIVE),
        (false, _) => 1.0,
    };
    if unit && options.unit_time_seconds.is_none() && instants.len() > 1 {
        warnings.push(format!(
            "Times run from 0 to 1; they are taken as parts of a take of {} instants at {fps} frames per second \
             ({scale:.3} s).",
            instants.len()
        ));
    }
    told.iter().map(|t| (t * scale, instants.partition_point(|i| i < t))).collect()
}
