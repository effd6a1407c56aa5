//! splat4d's own `capture.json`, which users with a rig write by hand. Specification: docs/capture-format.md.

use super::account::Account;
use super::convention::Convention;
use super::geometry::Scans;
use super::json::{self, Node};
use super::lookup::Lookup;
use super::points::read_cloud;
use super::{
    CaptureKind, CaptureOptions, DepthFile, DepthKind, Extent, Geometry, HoldOut, RawCapture, RawFrame, Tracks, pose,
    shutter, vignetting,
};
use splat4d::math::Se3;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The version of the format that this reader supports.
const VERSION: usize = 1;
const TOP_KEYS: &[&str] = &[
    "version",
    "name",
    "axes",
    "fps",
    "start",
    "frames",
    "cameras",
    "hold_out",
    "points",
    "geometry",
    "background",
    "up",
    "labels",
    "sound",
    "depth_kind",
    "depth_scale",
    "comment",
    "extra",
];
const CAMERA_KEYS: &[&str] = &[
    "name",
    "width",
    "height",
    "fx",
    "fy",
    "cx",
    "cy",
    "distortion",
    "world_to_camera",
    "camera_to_world",
    "time_offset",
    "readout",
    "exposure_time",
    "vignetting",
    "times",
    "images",
    "masks",
    "depth",
    "depth_kind",
    "depth_scale",
    "flow",
    "labels",
    "features",
    "tracks",
    "start",
    "frames",
    "comment",
    "extra",
];
/// Missing images of a camera from which a stated number of frames is doubted, if most are missing.
const MOST_MISSING: usize = 100;
/// Most digits that a pattern may pad to.
const MAX_DIGITS: usize = 32;

/// Reads a `capture.json`.
pub(super) fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    let value = json::read(marker)?;
    read_value(root, &Node::root(&value), options).map_err(|e| e.at(marker.display()))
}

fn read_value(root: &Path, top: &Node<'_>, options: &CaptureOptions) -> Result<RawCapture> {
    let version = top.get("version")?.count()?;
    if version != VERSION {
        return Err(Error::new(ErrorKind::Unsupported, format!("the format version is {version}, not {VERSION}"))
            .remedy("Write version 1, or use a newer splat4d."));
    }
    top.only(TOP_KEYS)?;
    let opengl = match top.opt("axes")?.map(|a| a.text()).transpose()? {
        None | Some("opencv") => false,
        Some("opengl") => true,
        Some(other) => {
            return Err(Error::input(format!("the axes \"{other:.30}\" are not known"))
                .remedy("Write \"opencv\" (x right, y down, z forward) or \"opengl\" (x right, y up, z backward)."));
        }
    };
    let fps = match (options.fps, top.opt("fps")?) {
        (Some(fps), _) => fps,
        (None, Some(fps)) => fps.number()?,
        (None, None) => DEFAULT_FPS,
    };
    super::options::check_rate("frame rate", fps)?;
    let mut cameras: Vec<String> = Vec::new();
    let (mut frames, mut take) = (Vec::new(), Extent::default());
    let mut firsts = BTreeMap::new();
    let hold_out = top.opt("hold_out")?.map(|n| read_hold_out(&n)).transpose()?;
    let labels = top.opt("labels")?.map(|n| read_labels(&n)).transpose()?.unwrap_or_default();
    let nodes = top.get("cameras")?.list()?;
    let lookup = Lookup::new(root, options)?;
    let inverse = nodes.iter().any(|n| n.value.get("camera_to_world").is_some());
    let in_part = in_part(top, &nodes, options.hold_out.as_ref().or(hold_out.as_ref()), options)?;
    for node in nodes {
        let name = node.get("name")?.text()?.to_string();
        if cameras.contains(&name) {
            return Err(node.error(format!("the camera name \"{name:.80}\" is given twice")).remedy("Rename one."));
        }
        let context = Context { root, top, opengl, fps, camera: cameras.len(), options, in_part, lookup: &lookup };
        let count = read_camera(&context, &node, &mut frames).map_err(|e| e.at(format!("camera {name:.80}")))?;
        take.add(0..count);
        if in_part && let Some(first) = context.first_image(&node)? {
            firsts.insert(cameras.len(), first);
        }
        cameras.push(name);
    }
    let mut account = Account::default();
    lookup.report(&mut account);
    let convention = Convention { world_to_camera: !inverse, opengl, quaternions: false };
    let points = top.opt("points")?.map(|n| lookup.file(n.text()?)).transpose()?;
    let sound = top.opt("sound")?.map(|n| read_sound(root, &n)).transpose()?;
    let numbers: BTreeSet<usize> = frames.iter().map(|f: &RawFrame| f.index).collect();
    let geometry = top.opt("geometry")?.map(|n| read_geometry(&lookup, top, &n, &numbers)).transpose()?;
    let scans: Vec<PathBuf> = geometry.iter().flat_map(Geometry::files).cloned().collect();
    Ok(RawCapture {
        name: top.opt("name")?.map(|n| n.text()).transpose()?.map(str::to_string),
        cameras,
        frames,
        take: if in_part { take } else { Extent::default() },
        firsts,
        named: true,
        hold_out,
        fps,
        points: points.as_deref().map(read_cloud).transpose()?,
        files: points.into_iter().chain(sound).chain(scans).collect(),
        geometry,
        background: read_background(top)?,
        up: top.opt("up")?.map(|n| n.numbers::<3>()).transpose()?,
        labels,
        account,
        ..RawCapture::new(root, CaptureKind::Own, convention)
    })
}

/// Whether the part that is needed can be read alone: of fixed cameras, which are held out as a whole or not at all.
/// The rest can only be determined from the whole.
fn in_part(top: &Node<'_>, nodes: &[Node<'_>], stated: Option<&HoldOut>, options: &CaptureOptions) -> Result<bool> {
    let by_camera = match stated {
        None => nodes.len() > 1,
        Some(rule) => !matches!(rule, HoldOut::Every(_)),
    };
    if options.frames.is_empty() || !by_camera {
        return Ok(false);
    }
    for node in nodes {
        let one_by_one =
            ["world_to_camera", "camera_to_world"].iter().any(|k| node.value[*k].pointer("/0/0/0").is_some());
        let none = node.value["images"].as_array().is_some_and(Vec::is_empty)
            || node.opt("frames")?.or(top.opt("frames")?).is_some_and(|n| *n.value == 0);
        if one_by_one || none {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Measured geometry: a file, a pattern or a list of files, or an object of these with a transform. `frames`: numbers of
/// the frames that are listed.
fn read_geometry(lookup: &Lookup, top: &Node<'_>, node: &Node<'_>, frames: &BTreeSet<usize>) -> Result<Geometry> {
    let whole = node.value.is_object();
    if whole {
        node.only(&["files", "transform", "start"])?;
    }
    let named = if whole { node.get("files")? } else { node.clone() };
    let of = |key: &str| if whole { node.opt(key) } else { Ok(None) };
    let start = of("start")?.or(top.opt("start")?).map(|n| n.count()).transpose()?.unwrap_or(0);
    let identity = std::array::from_fn(|i| std::array::from_fn(|k| f64::from(u8::from(i == k))));
    let transform = of("transform")?.map_or(Ok(identity), |n| n.matrix4())?;
    let missing = |path: &Path| {
        let error = named.error("the file of measured geometry is missing").at(path.display());
        error.remedy("Restore it, or take \"geometry\" out of capture.json")
    };
    let single = named.value.as_str().map(|text| lookup.file(text)).transpose()?;
    let single = single.filter(|path| path.is_file() || !named.value.as_str().is_some_and(|t| t.contains('%')));
    let scans = if let Some(path) = single {
        if !path.is_file() {
            return Err(missing(&path));
        }
        Scans::Static(path)
    } else {
        let files = Files::read(&named)?;
        let mut paths = BTreeMap::new();
        for &index in frames {
            let Some(path) = files.path(lookup, start, index)? else {
                let what = format!("\"geometry\" lists no file for frame {index}");
                return Err(named.error(what).remedy("List one file per frame, or name one file for all frames"));
            };
            match (path.is_file(), &files) {
                (true, _) => drop(paths.insert(index, path)),
                // A scanner is slower than cameras.
                (false, Files::Pattern { .. }) => {}
                (false, Files::List(_)) => return Err(missing(&path)),
            }
        }
        if paths.is_empty() {
            let first = frames.first().and_then(|&i| files.path(lookup, start, i).transpose()).transpose()?;
            return Err(missing(&first.unwrap_or_default()));
        }
        Scans::Frames(paths)
    };
    Geometry::new(scans, transform).map_err(|e| node.at(e))
}

/// The file of the sound. Training does not use it, so that it may be missing.
fn read_sound(root: &Path, node: &Node<'_>) -> Result<PathBuf> {
    node.only(&["file", "start"])?;
    node.opt("start")?.map(|n| n.number()).transpose()?;
    Ok(root.join(node.get("file")?.text()?))
}

/// Names of labels, that of mask value 0 first.
fn read_labels(node: &Node<'_>) -> Result<Vec<String>> {
    let names = node.list()?.iter().map(|n| n.text().map(str::to_owned)).collect::<Result<Vec<_>>>()?;
    splat4d::scene::labels::check(&names).map_err(|e| node.at(e))?;
    Ok(names)
}

fn read_background(top: &Node<'_>) -> Result<Option<[f32; 3]>> {
    let Some(node) = top.opt("background")? else { return Ok(None) };
    let color = node.numbers::<3>()?;
    if color.iter().any(|v| !(0.0..=1.0).contains(v)) {
        return Err(node.error("the background is outside [0,1]").remedy("Give three numbers from 0 to 1."));
    }
    Ok(Some(color.map(|v| v as f32)))
}

fn read_hold_out(node: &Node<'_>) -> Result<HoldOut> {
    if let Some(text) = node.value.as_str() {
        return text.parse().map_err(|e| node.at(e));
    }
    node.only(&["cameras", "every"])?;
    match (node.opt("cameras")?, node.opt("every")?) {
        (Some(list), None) => {
            let names = list.list()?.iter().map(|n| n.text().map(str::to_string)).collect::<Result<Vec<_>>>()?;
            Ok(HoldOut::Cameras(names))
        }
        (None, Some(every)) => format!("every={}", every.count()?).parse().map_err(|e| node.at(e)),
        _ => Err(node
            .error("expected one of \"cameras\" and \"every\"")
            .remedy("For example {\"cameras\": [\"cam00\"]}.")),
    }
}

struct Context<'a> {
    root: &'a Path,
    top: &'a Node<'a>,
    opengl: bool,
    fps: f64,
    camera: usize,
    options: &'a CaptureOptions,
    /// Whether only the part of the capture that the options name is listed.
    in_part: bool,
    lookup: &'a Lookup,
}

impl Context<'_> {
    /// A camera's own value, else the one for all.
    fn shared(&self, camera: &Node<'_>, key: &str) -> Result<Option<usize>> {
        let own = camera.opt(key)?;
        own.or(self.top.opt(key)?).map(|n| n.count()).transpose()
    }

    /// The first image of a camera that is there, whatever part of its frames is listed.
    fn first_image(&self, camera: &Node<'_>) -> Result<Option<PathBuf>> {
        let (images, start) = (Files::read(&camera.get("images")?)?, self.shared(camera, "start")?.unwrap_or(0));
        let bases = self.lookup.bases();
        let found = |index: usize| self.lookup.image(&bases, &images.text(start, index)?).ok()?;
        Ok((0..=MOST_MISSING).find_map(found))
    }

    fn pose(&self, node: &Node<'_>, inverted: bool) -> Result<Se3> {
        let rows = node.pose4(self.options.poses)?;
        let pose = pose::checked(Se3::from_rows(&rows)).map_err(|e| node.at(e))?;
        let stated = Convention { world_to_camera: !inverted, opengl: self.opengl, quaternions: false };
        stated.read_as(pose, self.options.poses)
    }
}

/// Adds the frames of a camera that are listed; returns how many it has.
fn read_camera(context: &Context<'_>, node: &Node<'_>, frames: &mut Vec<RawFrame>) -> Result<usize> {
    node.only(CAMERA_KEYS)?;
    let number = |key: &str| node.get(key)?.number();
    let (width, height) = (node.get("width")?.count()?, node.get("height")?.count()?);
    let intrinsics = Intrinsics { fx: number("fx")?, fy: number("fy")?, cx: number("cx")?, cy: number("cy")? };
    pose::check_intrinsics(&intrinsics, width, height)?;
    let lens = node.opt("distortion")?.map_or(Ok(Lens::Pinhole), |n| read_lens(&n))?;
    let (poses, inverted) = match (node.opt("world_to_camera")?, node.opt("camera_to_world")?) {
        (Some(node), None) => (node, false),
        (None, Some(node)) => (node, true),
        _ => {
            return Err(node
                .error("expected one of \"world_to_camera\" and \"camera_to_world\"")
                .remedy("Give one 4x4 matrix (a list of rows), or a list with one matrix per frame."));
        }
    };
    // A list of rows of numbers is one matrix; a list of lists of rows is one matrix per frame.
    let moving = poses.value.pointer("/0/0").is_some_and(serde_json::Value::is_array);
    let poses: Vec<Se3> = if moving {
        poses.list()?.iter().map(|n| context.pose(n, inverted)).collect::<Result<_>>()?
    } else {
        vec![context.pose(&poses, inverted)?]
    };
    let offset = node.opt("time_offset")?.map_or(Ok(0.0), |n| n.number())?;
    let shutter = [read_shutter(node, "readout")?, read_shutter(node, "exposure_time")?];
    let vignetting = node.opt("vignetting")?.map(|n| read_vignetting(&n)).transpose()?;
    let times = node.opt("times")?.map(|n| read_times(&n)).transpose()?;
    let start = context.shared(node, "start")?.unwrap_or(0);
    let count = context.shared(node, "frames")?;
    let images = Files::read(&node.get("images")?)?;
    let [masks, depth, flow, labels, features] =
        ["masks", "depth", "flow", "labels", "features"].map(|key| node.opt(key)?.map(|n| Files::read(&n)).transpose());
    let (masks, depth, flow, labels, features) = (masks?, depth?, flow?, labels?, features?);
    let depth = depth.map(|files| Depth::read(context, node, files)).transpose()?;
    if labels.is_some() && context.top.opt("labels")?.is_none() {
        return Err(node
            .error("its masks of labels have no names")
            .remedy("Add \"labels\" at the top of capture.json: a list of names, that of mask value 0 first."));
    }
    let lists = [
        ("images", Some(&images)),
        ("masks", masks.as_ref()),
        ("depth", depth.as_ref().map(|d| &d.files)),
        ("flow", flow.as_ref()),
        ("labels", labels.as_ref()),
        ("features", features.as_ref()),
    ];
    for (key, files) in lists {
        let Some(Files::List(names)) = files else { continue };
        let expected = match (&images, count) {
            (_, Some(count)) => count,
            (Files::List(images), None) => images.len(),
            (Files::Pattern { .. }, None) => continue,
        };
        // The last frame leads nowhere.
        let expected = if key == "flow" { expected.saturating_sub(1) } else { expected };
        if names.len() < expected {
            let what = format!("\"{key}\" lists {} files for {expected} frames", names.len());
            return Err(node.error(what).remedy("List one file per frame, or correct \"frames\"."));
        }
    }
    let bases = context.lookup.bases();
    let path = |files: &Option<Files>, index: usize| {
        files.as_ref().map(|f| f.path(context.lookup, start, index)).transpose().map(Option::flatten)
    };
    let (first, mut there, mut missing) = (frames.len(), 0, 0);
    let most = if let Files::List(names) = &images { names.len() } else { usize::MAX };
    let needed = if context.options.gaps { context.options.frames.iter().map(|f| f.end).max().unwrap_or(0) } else { 0 };
    for index in 0..count.unwrap_or(most) {
        let listed = !context.in_part || context.options.lists(index);
        let ends = count.is_none() && matches!(images, Files::Pattern { .. }) && index > 0;
        if !listed && !ends {
            there = index + 1;
            continue;
        }
        let Some(name) = images.text(start, index) else { break };
        let found = context.lookup.image(&bases, &name).map_err(|e| node.at(e))?;
        if found.is_none() {
            // Only frames that are needed are missed before the last of them.
            match (ends, index < needed) {
                (true, false) => break,
                (true, true) if !listed => continue,
                _ => {}
            }
            missing += 1;
            // A number of frames that is a slip must not be counted through.
            if missing > MOST_MISSING && missing > index / 2 {
                return Err(Error::input(format!(
                    "the image of frame {index} is missing, like {} others",
                    missing - 1
                ))
                .at(context.root.join(&name).display())
                .remedy("Restore the files, or correct \"images\", \"start\" and \"frames\"."));
            }
        }
        let image = found.unwrap_or_else(|| bases[0].join(&name));
        there = index + 1;
        if !listed {
            continue;
        }
        let pose = if moving { poses.get(index) } else { poses.first() };
        let Some(&cam_from_world) = pose else {
            let what = format!("there are {} poses, but an image of frame {index}", poses.len());
            return Err(node.error(what).remedy("Give one pose per frame, or \"count\"."));
        };
        let time = match times.as_ref().map(|t| t.get(index)) {
            None => index as f64 / context.fps,
            Some(Some(&time)) => time,
            Some(None) => {
                let what =
                    format!("there are {} times, but an image of frame {index}", times.as_ref().map_or(0, Vec::len));
                return Err(node.error(what).remedy("Give one time per frame, in seconds, or \"frames\"."));
            }
        };
        let beside = |files: &Option<Files>| path(files, index).map_err(|e| node.at(e));
        let source = Camera { cam_from_world, intrinsics, lens, width, height, near: Camera::NEAR };
        frames.push(RawFrame {
            mask: beside(&masks)?,
            depth: depth.as_ref().map(|d| d.file(context.lookup, start, index)).transpose()?.flatten(),
            flow: beside(&flow)?,
            labels: beside(&labels)?,
            features: beside(&features)?,
            shutter,
            vignetting,
            ..RawFrame::new((context.camera, index, time + offset), source, image)
        });
    }
    // The flow of the last frame is unknown.
    if let Some(last) = frames[first..].last_mut() {
        last.flow = None;
    }
    if let Some(file) = node.opt("tracks")? {
        let tracks = Arc::new(Tracks::read(&context.lookup.file(file.text()?)?, [width, height], there)?);
        frames[first..].iter_mut().for_each(|f| f.tracks = Some(tracks.clone()));
    }
    Ok(there)
}

/// The depth maps of a camera.
struct Depth {
    files: Files,
    kind: DepthKind,
    scale: f64,
}

impl Depth {
    fn read(context: &Context<'_>, camera: &Node<'_>, files: Files) -> Result<Self> {
        let of = |key: &str| Ok::<_, Error>(camera.opt(key)?.or(context.top.opt(key)?));
        let kind = match of("depth_kind")? {
            None => DepthKind::Metric,
            Some(node) => {
                let (word, names) = (node.text()?, DepthKind::NAMES);
                let known = names.iter().find(|(name, _)| *name == word).map(|(_, kind)| *kind);
                known.ok_or_else(|| {
                    node.error(format!("the kind of depth \"{word:.30}\" is not known")).remedy(
                        "Write \"metric\" (z in scene units), \"relative\" (z up to scale and shift) or \"inverse\" (1/z up to \
                         scale and shift).",
                    )
                })?
            }
        };
        let scale = of("depth_scale")?.map(|n| n.number()).transpose()?;
        if let Some(scale) = scale.filter(|s| *s <= 0.0) {
            return Err(camera.error(format!("invalid depth_scale {scale}")).remedy("Give a positive number."));
        }
        let whole = match &files {
            Files::Pattern { after, .. } => after.to_ascii_lowercase().ends_with(".png"),
            Files::List(names) => names.iter().any(|n| n.to_ascii_lowercase().ends_with(".png")),
        };
        if scale.is_none() && whole && kind == DepthKind::Metric {
            return Err(camera.error("\"depth\" refers to integer images without a unit").remedy(
                "Give \"depth_scale\": scene units per stored number, for instance 0.001 for millimetres in metres.",
            ));
        }
        Ok(Self { files, kind, scale: scale.unwrap_or(1.0) })
    }

    fn file(&self, lookup: &Lookup, start: usize, index: usize) -> Result<Option<DepthFile>> {
        let path = self.files.path(lookup, start, index)?;
        Ok(path.map(|path| DepthFile { path, scale: self.scale, kind: self.kind, fit: None }))
    }
}

/// When a camera took its frames: seconds on its own clock, each later than the one before.
fn read_times(node: &Node<'_>) -> Result<Vec<f64>> {
    let times = node.list()?.iter().map(|n| n.number()).collect::<Result<Vec<f64>>>()?;
    if let Some(k) = times.windows(2).position(|w| w[0] >= w[1]) {
        let what = format!("time {} ({} s) is not later than the one before ({} s)", k + 1, times[k + 1], times[k]);
        return Err(node.error(what).remedy("Give the times in seconds, in the order of the images."));
    }
    Ok(times)
}

/// A camera's readout or exposure time, seconds.
fn read_shutter(node: &Node<'_>, key: &str) -> Result<Option<f64>> {
    let read = |n: Node<'_>| shutter::checked(key, n.number()?).map_err(|e| n.at(e));
    node.opt(key)?.map(read).transpose()
}

/// A camera's vignetting: up to three coefficients.
fn read_vignetting(node: &Node<'_>) -> Result<[f64; 3]> {
    let values = node.list()?.iter().map(|n| n.number()).collect::<Result<Vec<f64>>>()?;
    let mut k = [0.0; 3];
    if values.len() > k.len() {
        return Err(node.error(format!("there are {} coefficients, more than 3", values.len())));
    }
    k[..values.len()].copy_from_slice(&values);
    vignetting::checked(k).map_err(|e| node.at(e))
}

fn read_lens(node: &Node<'_>) -> Result<Lens> {
    let coefficients = |key: &str, most: usize| -> Result<Vec<f64>> {
        let Some(list) = node.opt(key)? else { return Ok(vec![0.0; most]) };
        let mut values = list.list()?.iter().map(|n| n.number()).collect::<Result<Vec<f64>>>()?;
        if values.len() > most {
            return Err(list.error(format!("there are {} coefficients, more than {most}", values.len())));
        }
        values.resize(most, 0.0);
        Ok(values)
    };
    let name = node.get("model")?.text()?;
    let name = if name == "none" { "pinhole" } else { name };
    let Some((_, most)) = Lens::MODELS.iter().find(|(known, _)| *known == name) else {
        let names: Vec<&str> = Lens::MODELS.iter().map(|(name, _)| *name).collect();
        return Err(node
            .error(format!("the distortion model \"{name:.30}\" is not known"))
            .remedy(format!("Write one of {}; docs/capture-format.md lists their coefficients.", names.join(", "))));
    };
    let keys = ["k", "p", "s"];
    let used: Vec<&str> = keys.into_iter().zip(most).filter(|(_, most)| **most > 0).map(|(key, _)| key).collect();
    node.only(&[&["model"], &used[..]].concat())?;
    let [k, p, s] = [0, 1, 2].map(|i| coefficients(keys[i], most[i]));
    Ok(Lens::of_terms(name, [&k?, &p?, &s?]).expect("the model is listed"))
}

/// The files of a camera: a printf pattern or a list.
pub(super) enum Files {
    Pattern { before: String, digits: usize, after: String },
    List(Vec<String>),
}

impl Files {
    pub(super) fn read(node: &Node<'_>) -> Result<Self> {
        let Some(text) = node.value.as_str() else {
            return Ok(Self::List(node.list()?.iter().map(|n| n.text().map(str::to_string)).collect::<Result<_>>()?));
        };
        let bad = || {
            node.error(format!("invalid file pattern \"{text:.200}\"")).remedy(
                "Write the frame number as %d or, padded with zeros, %04d; for example \"images/cam00/%04d.png\".",
            )
        };
        let (before, rest) = text.split_once('%').ok_or_else(bad)?;
        let (digits, after) = rest.split_once('d').ok_or_else(bad)?;
        let digits = match digits.strip_prefix('0') {
            Some(n) => n.parse().map_err(|_| bad())?,
            None if digits.is_empty() => 0,
            None => return Err(bad()),
        };
        if digits > MAX_DIGITS || after.contains('%') {
            return Err(bad());
        }
        Ok(Self::Pattern { before: before.into(), digits, after: after.into() })
    }

    /// The file of a frame, or where it should be.
    pub(super) fn path(&self, lookup: &Lookup, start: usize, index: usize) -> Result<Option<PathBuf>> {
        self.text(start, index).map(|name| lookup.file(&name)).transpose()
    }

    /// The file's name as the capture writes it.
    pub(super) fn text(&self, start: usize, index: usize) -> Option<String> {
        match self {
            Self::List(names) => names.get(index).cloned(),
            Self::Pattern { before, digits, after } => {
                let number = start.checked_add(index)?;
                Some(format!("{before}{number:0digits$}{after}"))
            }
        }
    }
}
