//! Nerfies and HyperNeRF captures (Park et al. 2021): `dataset.json`, `metadata.json`, a camera an image in `camera/`,
//! `scene.json`, `points.npy`, and images in `rgb/1x` or smaller.
//!
//! A camera file holds `orientation` (world to camera, OpenCV axes), `position` (its centre), `focal_length`,
//! `pixel_aspect_ratio`, `principal_point`, `radial_distortion`, `tangential_distortion` and `image_size` [width,
//! height] of the images at 1x. `scene.json` brings the world to about a unit: x becomes (x − center)·scale, cameras
//! and points alike.

use super::account::Severity;
use super::account::{Account, Aspect, first_names};
use super::convention::{Convention, Poses};
use super::json::{self, Node};
use super::lookup::Lookup;
use super::{CaptureKind, CaptureOptions, PointCloud, RawCapture, RawFrame, Split, pose};
use splat4d::format::npy::Npy;
use splat4d::math::Se3;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, Result};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Marker of the layout, and the file without which it is another's.
pub(super) const MARKER: &str = "dataset.json";
const METADATA: &str = "metadata.json";
/// By how much the images of each folder are reduced, finest first.
const SCALES: [usize; 5] = [1, 2, 4, 8, 16];
/// DyCheck's folder of split lists.
const SPLITS: &str = "splits";
/// Folders that DyCheck and HyperNeRF add.
const UNREAD: [&str; 5] = ["depth", "covisible", "keypoint", "resized_mask", "camera-paths"];
/// Skew above this bends images visibly, and is not modelled, pixels.
const MOST_SKEW: f64 = 0.5;
/// Colour of points, which the layout gives none.
const GREY: f32 = 0.5;

/// Whether a folder with the marker is of this layout.
pub(super) fn applies(root: &Path) -> bool {
    root.join(METADATA).is_file() && root.join("camera").is_dir()
}

/// Similarity from the files' world to the scene's.
struct Framing {
    center: [f64; 3],
    scale: f64,
}

impl Framing {
    fn read(root: &Path) -> Result<Self> {
        let path = root.join("scene.json");
        if !path.is_file() {
            return Ok(Self { center: [0.0; 3], scale: 1.0 });
        }
        let value = json::read(&path)?;
        let node = Node::root(&value);
        let read = || -> Result<Self> {
            let out = Self { center: node.get("center")?.numbers::<3>()?, scale: node.get("scale")?.number()? };
            if out.scale > 0.0 { Ok(out) } else { Err(node.get("scale")?.error("the scale is not above 0")) }
        };
        read().map_err(|e| e.at(path.display()))
    }

    fn apply(&self, x: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|k| (x[k] - self.center[k]) * self.scale)
    }
}

/// The lists of a capture's images: all of them, those to train on, those to hold out.
struct Lists {
    ids: Vec<String>,
    train: Vec<String>,
    held: Vec<String>,
}

impl Lists {
    /// From `dataset.json`, and DyCheck's `splits/train.json` and `splits/val.json`, which have priority.
    fn read(root: &Path, marker: &Path, account: &mut Account) -> Result<Self> {
        let list = |path: &Path, key: &str| -> Result<Vec<String>> {
            let value = json::read(path)?;
            let names = |n: Node<'_>| n.list()?.iter().map(|n| n.text().map(str::to_owned)).collect();
            Node::root(&value).opt(key)?.map_or(Ok(Vec::new()), names).map_err(|e: Error| e.at(path.display()))
        };
        let split = |name: &str, key: &str| -> Result<Vec<String>> {
            let path = root.join(SPLITS).join(format!("{name}.json"));
            if path.is_file() { list(&path, "frame_names") } else { list(marker, key) }
        };
        let mut ids = list(marker, "ids")?;
        let (train, held) = (split("train", "train_ids")?, split("val", "val_ids")?);
        if ids.is_empty() {
            // HyperNeRF's own scenes, and others', list splits alone.
            ids = train.iter().chain(&held).cloned().collect::<BTreeSet<_>>().into_iter().collect();
        }
        let known: BTreeSet<&String> = ids.iter().collect();
        let lost: Vec<&String> = train.iter().chain(&held).filter(|id| !known.contains(id)).collect();
        if !lost.is_empty() {
            let name = marker.file_name().unwrap_or_default().to_string_lossy();
            let names = first_names(&lost);
            let what = format!("{} names of the split lists are not among the ids of {name}: {names}.", lost.len());
            account.add(Aspect::NotFound, Severity::Warning, what);
        }
        Ok(Self { ids, train, held })
    }
}

/// The frame rate of DyCheck's captures.
fn stated_rate(root: &Path) -> Result<Option<f64>> {
    let path = root.join("extra.json");
    if !path.is_file() {
        return Ok(None);
    }
    let value = json::read(&path)?;
    let fps = Node::root(&value).opt("fps")?.map(|n| n.number()).transpose().map_err(|e| e.at(path.display()))?;
    if let Some(fps) = fps {
        super::options::check_rate("frame rate", fps).map_err(|e| e.at(path.display()))?;
    }
    Ok(fps)
}

/// Reads a capture.
pub(super) fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    let lookup = Lookup::new(root, options)?;
    let mut account = Account::default();
    let stated = stated_rate(root)?;
    let fps = options.fps.or(stated).unwrap_or(DEFAULT_FPS);
    let Lists { ids, train, held } = Lists::read(root, marker, &mut account)?;
    let framing = Framing::read(root)?;
    let path = root.join(METADATA);
    let metadata = json::read(&path)?;
    let about = Node::root(&metadata);
    let [for_train, for_held]: [BTreeSet<&String>; 2] = [&train, &held].map(|l| l.iter().collect());
    let (folder, smaller) = pictures(root, options)?;
    let folders = [folder];
    let (mut frames, mut cameras) = (Vec::new(), Vec::<u64>::new());
    let mut left_out = 0;
    let mut without_camera = Vec::new();
    for id in &ids {
        let split = match (for_train.contains(id), for_held.contains(id)) {
            (_, true) => Split::Held,
            (true, false) => Split::Train,
            (false, false) if train.is_empty() => Split::Train,
            (false, false) => {
                left_out += 1;
                continue;
            }
        };
        let of = |key: &str| -> Result<Option<usize>> {
            let own = about.get(id).and_then(|n| n.opt(key)?.map(|n| n.count()).transpose());
            own.map_err(|e| e.at(path.display()))
        };
        // Warp codes count times; later takes state it explicitly.
        let index = match (of("time_id")?, of("warp_id")?, of("appearance_id")?) {
            (Some(n), ..) | (_, Some(n), _) | (.., Some(n)) => n,
            _ => {
                return Err(Error::input(format!("image \"{id:.80}\" has no time_id, warp_id or appearance_id"))
                    .at(path.display())
                    .remedy("Give each image its time index."));
            }
        };
        let number = of("camera_id")?.unwrap_or(0) as u64;
        let camera = cameras.iter().position(|c| *c == number).unwrap_or_else(|| {
            cameras.push(number);
            cameras.len() - 1
        });
        let file = root.join("camera").join(format!("{id}.json"));
        if !file.exists() {
            without_camera.push(format!("{id}.json"));
            continue;
        }
        let value = json::read(&file)?;
        let source = camera_of(&Node::root(&value), &framing, options.poses);
        let source = source.map_err(|e| e.at(file.display()))?.downscaled(smaller);
        let image = lookup.image(&folders, id)?.unwrap_or_else(|| folders[0].join(format!("{id}.png")));
        let time = index as f64 / fps;
        frames.push(RawFrame { split, ..RawFrame::new((camera, index, time), source, image) });
    }
    skip_without_camera(&without_camera, ids.len(), root, options, &mut account)?;
    let last = frames.iter().map(|f| f.index).max().unwrap_or(0);
    let first = frames.iter().map(|f| f.index).min().unwrap_or(0);
    let length = (last - first) as f64 / fps;
    let rate = match (options.fps, stated) {
        (None, None) => format!("The layout states no frame rate: frames {first} to {last} at {fps} frames per second"),
        (None, Some(_)) => format!("Frames {first} to {last} at the {fps} frames per second of extra.json"),
        (Some(_), _) => format!("Frames {first} to {last} at {fps} frames per second, as given"),
    };
    account.add(Aspect::Assumed, Severity::Note, format!("{rate}: {length:.3} s."));
    if left_out > 0 {
        let what =
            format!("{left_out} of {} images are neither trained on nor held out by the split lists.", ids.len());
        account.add(Aspect::NotRead, Severity::Note, what);
    }
    lookup.report(&mut account);
    let others: Vec<&str> = UNREAD.into_iter().filter(|name| root.join(name).is_dir()).collect();
    if !others.is_empty() {
        let what = format!("Folders of the layout: {}. capture.json names depth, masks and others.", others.join(", "));
        account.add(Aspect::NotRead, Severity::Note, what);
    }
    let named = cameras.len() > 1;
    Ok(RawCapture {
        cameras: cameras.iter().map(|c| format!("camera{c}")).collect(),
        frames,
        named,
        fps,
        points: points(root, &framing)?,
        account,
        ..RawCapture::new(root, CaptureKind::Nerfies, Convention::NERFIES)
    })
}

/// Reports images whose camera file is missing, which are left out. Errors: too many are.
fn skip_without_camera(
    files: &[String],
    all: usize,
    root: &Path,
    options: &CaptureOptions,
    account: &mut Account,
) -> Result<()> {
    if files.is_empty() {
        return Ok(());
    }
    let what = format!("{} of {all} camera files are missing: {}", files.len(), first_names(files));
    if files.len() as f64 > options.max_missing * all as f64 {
        return Err(Error::input(what)
            .at(root.join("camera").display())
            .remedy("Copy them too, or take their ids out of dataset.json."));
    }
    account.add(Aspect::NotFound, Severity::Warning, format!("{what}. Their images are left out."));
    Ok(())
}

/// The finest folder of images, and by how much they are reduced. Errors: there is none.
fn pictures(root: &Path, options: &CaptureOptions) -> Result<(PathBuf, usize)> {
    if let Some(name) = &options.images {
        let smaller = Path::new(name).file_name().and_then(|n| n.to_str()?.strip_suffix('x')?.parse().ok());
        return Ok((root.join(name), smaller.filter(|k| *k > 0).unwrap_or(1)));
    }
    let all = SCALES.map(|k| (root.join("rgb").join(format!("{k}x")), k));
    all.into_iter().find(|(p, _)| p.is_dir()).ok_or_else(|| {
        Error::input("there are no images: none of 1x, 2x, 4x, 8x and 16x is there")
            .at(root.join("rgb").display())
            .remedy("Copy the data set's rgb folder here.")
    })
}

fn camera_of(node: &Node<'_>, framing: &Framing, poses: Poses) -> Result<Camera> {
    let rotation = node.get("orientation")?.matrix3()?;
    let center = framing.apply(node.get("position")?.numbers::<3>()?);
    let translation = std::array::from_fn(|r| -(0..3).map(|c| rotation[r][c] * center[c]).sum::<f64>());
    let stated = pose::checked(Se3 { rotation, translation }).map_err(|e| node.at(e))?;
    let cam_from_world = match poses {
        Poses::STATED => stated,
        poses => Convention::NERFIES.reread(&stated, poses)?,
    };
    let [width, height] = node.get("image_size")?.numbers::<2>()?;
    let [cx, cy] = node.get("principal_point")?.numbers::<2>()?;
    let focal = node.get("focal_length")?.number()?;
    let aspect = node.opt("pixel_aspect_ratio")?.map_or(Ok(1.0), |n| n.number())?;
    let skew = node.opt("skew")?.map_or(Ok(0.0), |n| n.number())?;
    if skew.abs() > MOST_SKEW {
        return Err(node
            .error(format!("the pixels are skewed by {skew} px, which is not modelled"))
            .remedy("Calibrate without skew."));
    }
    let numbers = |key: &str| -> Result<Vec<f64>> {
        node.opt(key)?.map_or(Ok(Vec::new()), |n| n.list()?.iter().map(|n| n.number()).collect())
    };
    let (radial, tangential) = (numbers("radial_distortion")?, numbers("tangential_distortion")?);
    if radial.len() > 3 || tangential.len() > 2 {
        return Err(node
            .error("more than three radial or two tangential coefficients")
            .remedy("Give k1 k2 k3 and p1 p2."));
    }
    let at = |list: &[f64], i: usize| list.get(i).copied().unwrap_or(0.0);
    let k = [at(&radial, 0), at(&radial, 1), at(&radial, 2), 0.0, 0.0, 0.0];
    let p = [at(&tangential, 0), at(&tangential, 1)];
    let straight = k.iter().chain(&p).all(|x| *x == 0.0);
    let lens = if straight { Lens::Pinhole } else { Lens::Brown { k, p, s: [0.0; 4] } };
    let side = |x: f64| if x >= 1.0 && x.fract() == 0.0 && x < f64::from(u32::MAX) { x as usize } else { 0 };
    let intrinsics = Intrinsics { fx: focal, fy: focal * aspect, cx, cy };
    let (width, height) = (side(width), side(height));
    pose::check_intrinsics(&intrinsics, width, height).map_err(|e| node.at(e))?;
    Ok(Camera { cam_from_world, intrinsics, lens, width, height, near: Camera::NEAR })
}

/// `points.npy`, [N, 3] in the files' world.
fn points(root: &Path, framing: &Framing) -> Result<Option<PointCloud>> {
    let path = root.join("points.npy");
    if !path.is_file() {
        return Ok(None);
    }
    let array = Npy::read(&json::read_bytes(&path)?).map_err(|e| e.at(path.display()))?;
    if array.shape.len() != 2 || array.shape[1] != 3 {
        return Err(Error::input(format!("the points have shape {:?}, not [N, 3]", array.shape))
            .at(path.display())
            .remedy("Delete the file: points are then found in the images."));
    }
    let mut cloud = PointCloud::default();
    for x in array.to_f64().chunks_exact(3) {
        cloud.push(framing.apply([x[0], x[1], x[2]]), [GREY; 3], None);
    }
    Ok(Some(cloud))
}
