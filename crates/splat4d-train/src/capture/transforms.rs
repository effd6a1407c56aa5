//! `transforms_train.json` (with `_val` and `_test`) and `transforms.json`: the poses of D-NeRF, Blender, instant-ngp and
//! Nerfstudio, OpenGL axes, camera to world; intrinsics of all frames or of each, times or none.
//!
//! `ply_file_path` and the poses are both written after `applied_transform`, so neither needs it here: the scene keeps
//! the file's own world.

mod clock;
mod frame;

use super::json::{self, Node};
use super::points::read_ply;
use super::sequence::{self, Order};
use super::{CaptureKind, CaptureOptions, Extent, PointCloud, RawFrame, Sequence, Split, Take, colmap};
use frame::Entry;
use splat4d::Result;
use splat4d::scene::Camera;
use splat4d::scene::time::DEFAULT_FPS;
use std::path::Path;

/// The training frames of captures that come in several files.
pub(super) const TRAIN: &str = "transforms_train.json";
/// All frames of captures in one file.
pub(super) const ALL: &str = "transforms.json";
/// Frames that lie beside, and what they are for. The test set is what papers measure.
const OTHERS: [(&str, Split); 2] = [("transforms_val.json", Split::Validation), ("transforms_test.json", Split::Held)];
/// Blender's world has z up.
const BLENDER_UP: [f64; 3] = [0.0, 0.0, 1.0];

/// Reads the marker and what lies beside it. Cameras are told apart by picture names (`cam/frame`), else by repeated
/// poses; times come from `time`, else from what `sequence` makes of the names.
pub(super) fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<Take> {
    let several = marker.file_name().is_some_and(|name| name == TRAIN);
    let (mut warnings, mut notes) = (Vec::new(), Vec::new());
    let value = json::read(marker)?;
    let first = Document::read(root, &Node::root(&value), Split::Train, options).map_err(|e| e.at(marker.display()))?;
    if several && first.entries.is_empty() {
        let remedy = "Check that it was exported completely.";
        return Err(splat4d::Error::input("the capture has no frames").at(marker.display()).remedy(remedy));
    }
    let mut entries = first.entries;
    for (name, split) in OTHERS {
        let path = root.join(name);
        if !path.exists() {
            continue;
        }
        let value = json::read(&path)?;
        let more = Document::read(root, &Node::root(&value), split, options).map_err(|e| e.at(path.display()))?;
        add(&mut entries, more.entries, several);
    }
    let order = match clock::told(&entries, first.fps, options, several, (&mut warnings, &mut notes)) {
        Some(order) => order,
        None => untimed(&entries, options, several, (&mut warnings, &mut notes), first.fps),
    };
    let Order { cameras, frames: places, named, timing } = order;
    let blender = several && entries.iter().all(|e| e.by_angle);
    let frame = |(entry, (camera, index, time)): (Entry, (usize, usize, f64))| RawFrame {
        camera,
        source: entry.source,
        time,
        index,
        image: entry.image,
        mask: entry.mask,
        depth: entry.depth,
        flow: None,
        labels: None,
        features: None,
        tracks: None,
        split: entry.split,
    };
    let frames: Vec<RawFrame> = entries.into_iter().zip(places).map(frame).collect();
    let points = match first.points {
        Some(points) => Some(points),
        None => colmap::points_beside(root, marker, &frames, &mut warnings, &mut notes),
    };
    warnings.extend(first.warning);
    Ok(Take {
        name: None,
        root: root.to_path_buf(),
        kind: if several { CaptureKind::DNerf } else { CaptureKind::Nerfstudio },
        cameras,
        frames,
        take: Extent::default(),
        named,
        timing,
        hold_out: None,
        fps: first.fps,
        points,
        background: None,
        up: blender.then_some(BLENDER_UP),
        labels: Vec::new(),
        warnings,
        notes,
    })
}

/// Names and cameras of all frames of a file; no picture is looked at that states its size.
pub(super) fn posed_frames(root: &Path, top: &Node<'_>) -> Result<Vec<(String, Camera)>> {
    top.get("frames")?.list()?.iter().map(|node| frame::posed(root, top, node)).collect()
}

/// Adds the frames of a file beside. One file with all frames may list them too, for the same purpose or none.
fn add(entries: &mut Vec<Entry>, more: Vec<Entry>, several: bool) {
    for entry in more {
        match entries.iter_mut().find(|e| !several && e.image == entry.image) {
            Some(known) => known.split = entry.split,
            None => entries.push(entry),
        }
    }
}

/// NeRF's own scenes in several files stand still where they state no times.
fn untimed(
    entries: &[Entry],
    options: &CaptureOptions,
    several: bool,
    (warnings, notes): (&mut Vec<String>, &mut Vec<String>),
    fps: f64,
) -> Order {
    let names: Vec<&str> = entries.iter().map(|e| e.name.as_str()).collect();
    let poses: Vec<_> = entries.iter().map(|e| e.source.cam_from_world).collect();
    if several && options.sequence == Sequence::Auto {
        notes.push(format!(
            "{TRAIN} states no times: its pictures are one moment. If they are frames of a film, say --set \
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
    points: Option<PointCloud>,
    warning: Option<String>,
}

impl Document {
    fn read(root: &Path, top: &Node<'_>, split: Split, options: &CaptureOptions) -> Result<Self> {
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
            let mut entry = frame::read(root, top, &node)?;
            entry.split = if split == Split::Train { splits.of(&entry.name) } else { split };
            entries.push(entry);
        }
        let (mut points, mut warning) = (None, None);
        if let Some(name) = top.opt("ply_file_path")? {
            let path = root.join(name.text()?);
            if path.is_file() {
                points = Some(read_ply(&path)?);
            } else {
                warning = Some(format!("The initial points that ply_file_path names are missing: {}.", path.display()));
            }
        }
        Ok(Self { entries, fps, points, warning })
    }
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
