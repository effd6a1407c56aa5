//! `transforms_train.json` (with `_val` and `_test`) and `transforms.json`: the poses of D-NeRF, Blender, instant-ngp
//! and Nerfstudio, OpenGL axes, camera to world; intrinsics of all frames or of each, times or none.
//!
//! `ply_file_path` and the poses are both written after `applied_transform`, so neither needs it here: the scene keeps
//! the file's own world.

mod clock;
mod frame;

use super::account::Severity;
use super::account::{Account, Aspect, first_names};
use super::convention::{Convention, Poses};
use super::json::{self, Node};
use super::lookup::Lookup;
use super::points::read_cloud;
use super::sequence::{self, FrameOrder};
use super::splits::Lists;
use super::{CaptureKind, CaptureOptions, PointCloud, RawCapture, RawFrame, Sequence, Split, colmap, picture};
use frame::Entry;
use splat4d::Result;
use splat4d::scene::Camera;
use splat4d::scene::time::DEFAULT_FPS;
use std::path::{Path, PathBuf};

/// The training frames of captures that come in several files.
pub(super) const TRAIN: &str = "transforms_train.json";
/// All frames of captures in one file.
pub(super) const ALL: &str = "transforms.json";
/// Further files of frames, and their purpose. The test set is what papers measure.
const OTHERS: [(&str, Split); 2] = [("transforms_val.json", Split::Validation), ("transforms_test.json", Split::Held)];
/// Blender's world has z up.
const BLENDER_UP: [f64; 3] = [0.0, 0.0, 1.0];

/// Reads the marker and what is next to it. Cameras are distinguished by image names (`cam/frame`), else by repeated
/// poses; times are read from `time`, else derived from the names by `sequence`.
pub(super) fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    let several = marker.file_name().is_some_and(|name| name == TRAIN);
    let (mut warnings, mut notes, mut account) = (Vec::new(), Vec::new(), Account::default());
    let lookup = Lookup::new(root, options)?;
    let mut size = None;
    let mut read = |path: &Path, split: Split| {
        let value = json::read(path)?;
        let read = Document::read((&lookup, &mut size), &Node::root(&value), split, options, &mut account);
        read.map_err(|e| e.at(path.display()))
    };
    let first = read(marker, Split::Train)?;
    if several && first.entries.is_empty() {
        let remedy = "Check that it was exported completely.";
        return Err(splat4d::Error::input("the capture has no frames").at(marker.display()).remedy(remedy));
    }
    let mut entries = first.entries;
    for (name, split) in OTHERS {
        let path = root.join(name);
        if path.exists() {
            add(&mut entries, read(&path, split)?.entries, several);
        }
    }
    let rate = clock::Rate { fps: first.fps, stated: first.stated };
    let (order, fps) = match clock::read_times(&entries, rate, options, several, &mut account) {
        Some(read) => read,
        None => (untimed(&entries, options, several, (&mut warnings, &mut notes), first.fps), first.fps),
    };
    let FrameOrder { cameras, frames: places, named, timing } = order;
    let blender = several && entries.iter().all(|e| e.by_angle);
    let frame = |(entry, place): (Entry, _)| RawFrame {
        mask: entry.mask,
        depth: entry.depth,
        split: entry.split,
        ..RawFrame::new(place, entry.source, entry.image)
    };
    let frames: Vec<RawFrame> = entries.into_iter().zip(places).map(frame).collect();
    let (file, stated) = first.points.unzip();
    let points = match stated {
        Some(points) => Some(points),
        None => colmap::companion_points(root, marker, &frames, &mut warnings, &mut notes),
    };
    warnings.extend(first.warning);
    lookup.report(&mut account);
    let kind = if several { CaptureKind::DNerf } else { CaptureKind::Nerfstudio };
    Ok(RawCapture {
        cameras,
        frames,
        named,
        timing,
        fps,
        points,
        files: file.into_iter().collect(),
        up: blender.then_some(BLENDER_UP),
        warnings,
        notes,
        account,
        ..RawCapture::new(root, kind, Convention::NERF)
    })
}

/// Names and cameras of all frames of a file; no image is examined that states its size.
pub(super) fn posed_frames(root: &Path, top: &Node<'_>) -> Result<Vec<(String, Camera)>> {
    let lookup = Lookup::new(root, &CaptureOptions::default())?;
    let file = frame::File { lookup: &lookup, bases: &lookup.bases(), top, poses: Poses::STATED, size: None };
    top.get("frames")?.list()?.iter().map(|node| frame::posed(&file, node)).collect()
}

/// Adds the frames of a file next to. One file with all frames may list them too, for the same purpose or none.
fn add(entries: &mut Vec<Entry>, more: Vec<Entry>, several: bool) {
    for entry in more {
        match entries.iter_mut().find(|e| !several && e.image == entry.image) {
            Some(known) => known.split = entry.split,
            None => entries.push(entry),
        }
    }
}

/// NeRF's own scenes in several files are static where they state no times.
fn untimed(
    entries: &[Entry],
    options: &CaptureOptions,
    several: bool,
    (warnings, notes): (&mut Vec<String>, &mut Vec<String>),
    fps: f64,
) -> FrameOrder {
    let names: Vec<&str> = entries.iter().map(|e| e.name.as_str()).collect();
    let poses: Vec<_> = entries.iter().map(|e| e.source.cam_from_world).collect();
    if several && options.sequence == Sequence::Auto {
        notes.push(format!(
            "{TRAIN} has no times: its images are given the same time. If they are frames of a video, use --set \
             capture.sequence=video."
        ));
        return sequence::moment(&names);
    }
    sequence::order(&names, &poses, options.sequence, fps, warnings, notes)
}

/// A transforms file, read.
struct Document {
    entries: Vec<Entry>,
    fps: f64,
    /// Whether the file, or the user, states the rate.
    stated: bool,
    /// The points that it names, and their file.
    points: Option<(PathBuf, PointCloud)>,
    warning: Option<String>,
}

impl Document {
    fn read(
        (lookup, size): (&Lookup, &mut Option<(usize, usize)>),
        top: &Node<'_>,
        split: Split,
        options: &CaptureOptions,
        account: &mut Account,
    ) -> Result<Self> {
        let stated = options.fps.is_some() || top.opt("fps")?.is_some();
        let fps = match (options.fps, top.opt("fps")?) {
            (Some(fps), _) => fps,
            (None, Some(fps)) => fps.number()?,
            (None, None) => DEFAULT_FPS,
        };
        super::options::check_rate("frame rate", fps)?;
        if let Some(applied) = top.opt("applied_transform")? {
            applied.matrix4()?;
        }
        let nodes = top.get("frames")?.list()?;
        let bases = lookup.bases();
        // Where no size is stated, an image that is there gives that of missing ones.
        let there = |node: &Node<'_>| {
            let name = node.value.get("file_path")?.as_str()?;
            picture::header(&lookup.image(&bases, name).ok()??).ok()
        };
        *size = nodes.iter().find_map(there).map(|header| header.upright()).or(*size);
        let file = frame::File { lookup, bases: &bases, top, poses: options.poses, size: *size };
        let mut entries = nodes.iter().map(|node| frame::read(&file, node)).collect::<Result<Vec<_>>>()?;
        match split {
            Split::Train => {
                let names: Vec<&str> = entries.iter().map(|e| e.name.as_str()).collect();
                let settled = Lists::of_transforms(top)?.settle(&names, account)?;
                let kept = entries.into_iter().zip(settled);
                entries = kept.filter_map(|(e, split)| Some(Entry { split: split?, ..e })).collect();
            }
            other => entries.iter_mut().for_each(|e| e.split = other),
        }
        let unread = frame::unread(top);
        if !unread.is_empty() {
            let what = format!("{} keys of the transforms file: {}.", unread.len(), first_names(&unread));
            account.add(Aspect::NotRead, Severity::Note, what);
        }
        let mistaken = frame::mistaken(top);
        if !mistaken.is_empty() {
            let what =
                format!("Keys of the transforms file that are not read: {}. Rename them.", first_names(&mistaken));
            account.add(Aspect::NotRead, Severity::Warning, what);
        }
        if let Some(what) = frame::contradiction(top, &entries)? {
            account.add(Aspect::Assumed, Severity::Warning, what);
        }
        let (mut points, mut warning) = (None, None);
        if let Some(name) = top.opt("ply_file_path")? {
            let path = lookup.file(name.text()?)?;
            if path.is_file() {
                let cloud = read_cloud(&path)?;
                points = Some((path, cloud));
            } else {
                warning = Some(format!("The initial points that ply_file_path names are missing: {}.", path.display()));
            }
        }
        Ok(Self { entries, fps, stated, points, warning })
    }
}
