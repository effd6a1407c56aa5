//! Depth, flow, masks and tracks that `splat4d priors` wrote into a capture's `priors/`, for every layout: its list,
//! `priors.json`, names the file of each image. What the capture itself names has priority.

use super::depth::{DepthFile, DepthKind};
use super::json::{self, Node};
use super::{RawCapture, Tracks};
use splat4d::{Error, Result};
use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

/// Their folder in the capture's.
const FOLDER: &str = "priors";
/// Their list.
const LIST: &str = "priors.json";
/// The version of the list.
const VERSION: usize = 1;
/// Keys of the list.
const KEYS: [&str; 6] = ["version", "writer", "depth", "flow", "masks", "tracks"];

/// Gives frames what is listed for their images and they do not have. Errors: a damaged list; files that are missing.
pub(super) fn fill(take: &mut RawCapture) -> Result<()> {
    let list = take.root.join(FOLDER).join(LIST);
    if !list.is_file() {
        return Ok(());
    }
    let value = json::read(&list)?;
    fill_by(take, &Node::root(&value)).map_err(|e| e.at(list.display()))
}

fn fill_by(take: &mut RawCapture, top: &Node<'_>) -> Result<()> {
    let version = top.get("version")?.count()?;
    if version != VERSION {
        return Err(Error::input(format!("expected version {VERSION}, found {version}"))
            .remedy("Use a newer splat4d, or remove the folder priors"));
    }
    top.only(&KEYS)?;
    let files = |key: &str| top.opt(key)?.map_or_else(|| Ok(BTreeMap::new()), |node| listed(&take.root, &node));
    let (depth, flow, masks, tracks) = (files("depth")?, files("flow")?, files("masks")?, files("tracks")?);
    let kind = top.opt("depth")?.map(|node| depth_kind(&node)).transpose()?;
    let mut counts = [0; 4];
    let mut sizes: BTreeMap<usize, ([usize; 2], usize)> = BTreeMap::new();
    for frame in &take.frames {
        let entry = sizes.entry(frame.camera).or_insert(([frame.source.width, frame.source.height], 0));
        entry.1 = entry.1.max(frame.index + 1);
    }
    let mut of_cameras: BTreeMap<usize, Arc<Tracks>> = BTreeMap::new();
    for (camera, name) in take.cameras.iter().enumerate() {
        if let (Some(file), Some((size, count))) = (tracks.get(name), sizes.get(&camera)) {
            of_cameras.insert(camera, Arc::new(Tracks::read(file, *size, *count)?));
        }
    }
    for frame in &mut take.frames {
        let key = key_of(&take.root, &frame.image);
        if let (None, Some(path), Some((kind, scale))) = (&frame.depth, depth.get(&key), kind) {
            frame.depth = Some(DepthFile { path: path.clone(), scale, kind, fit: None });
            counts[0] += 1;
        }
        if let (None, Some(path)) = (&frame.flow, flow.get(&key)) {
            frame.flow = Some(path.clone());
            counts[1] += 1;
        }
        if let (None, Some(path)) = (&frame.mask, masks.get(&key)) {
            frame.mask = Some(path.clone());
            counts[2] += 1;
        }
        if let (None, Some(of_camera)) = (&frame.tracks, of_cameras.get(&frame.camera)) {
            frame.tracks = Some(of_camera.clone());
            counts[3] += 1;
        }
    }
    let words = ["depth", "flow", "masks", "tracks"];
    let used: Vec<String> =
        words.iter().zip(counts).filter(|(_, n)| *n > 0).map(|(word, n)| format!("{word} of {n}")).collect();
    if !used.is_empty() {
        take.notes.push(format!("From {FOLDER}/, which splat4d priors wrote: {} images.", used.join(", ")));
    }
    Ok(())
}

/// An image's name in the list: its path below the capture's folder, with slashes.
fn key_of(root: &Path, image: &Path) -> String {
    image.strip_prefix(root).unwrap_or(image).to_string_lossy().replace('\\', "/")
}

/// Files of a part of the list. Errors: a path that leads out of the folder.
fn listed(root: &Path, node: &Node<'_>) -> Result<BTreeMap<String, PathBuf>> {
    let files = node.get("files")?;
    let object = files.value.as_object().ok_or_else(|| files.error("expected an object { image: file }"))?;
    let mut out = BTreeMap::new();
    for (image, file) in object {
        let path = file
            .as_str()
            .map(Path::new)
            .filter(|p| p.components().next().is_some() && p.components().all(|c| matches!(c, Component::Normal(_))));
        let Some(path) = path else {
            return Err(files
                .error(format!("the file of \"{image:.80}\" is not a path below {FOLDER}/"))
                .remedy("Write it again: splat4d priors CAPTURE --force"));
        };
        out.insert(image.clone(), root.join(FOLDER).join(path));
    }
    Ok(out)
}

/// Kind and scale of the depth maps.
fn depth_kind(node: &Node<'_>) -> Result<(DepthKind, f64)> {
    let word = node.get("kind")?;
    let text = word.text()?;
    let kind = DepthKind::NAMES.iter().find(|(name, _)| *name == text).map(|(_, kind)| *kind);
    let kind = kind.ok_or_else(|| {
        word.error(format!("unknown kind of depth \"{text:.30}\"")).remedy("Write metric, relative or inverse")
    })?;
    let scale = node.opt("scale")?.map_or(Ok(1.0), |n| n.number())?;
    if scale <= 0.0 {
        return Err(node
            .error(format!("expected a positive scale, found {scale}"))
            .remedy("Write it again: splat4d priors"));
    }
    Ok((kind, scale))
}

#[cfg(test)]
mod tests {
    use super::super::{Capture, CaptureOptions};
    use super::*;
    use splat4d::format::npy;

    fn capture(folder: &Path, own: bool) {
        for k in 0..2 {
            image::RgbImage::from_pixel(8, 6, image::Rgb([90, 90, 90])).save(folder.join(format!("{k}.png"))).unwrap();
        }
        let own = if own { r#""depth": ["a.npy", "b.npy"], "depth_kind": "metric", "# } else { "" };
        let text = format!(
            r#"{{"version": 1, "hold_out": "none", "cameras": [{{"name": "c", "width": 8, "height": 6, "fx": 8, "fy": 8, "cx": 4,
            "cy": 3, "images": ["0.png", "1.png"], {own}
            "world_to_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}}]}}"#
        );
        std::fs::write(folder.join("capture.json"), text).unwrap();
        let mut file = Vec::new();
        npy::write_f32(&[6, 8], &[2.0; 48], &mut file).unwrap();
        std::fs::create_dir_all(folder.join("priors/depth")).unwrap();
        for name in ["a.npy", "b.npy", "priors/depth/0.npy"] {
            std::fs::write(folder.join(name), &file).unwrap();
        }
    }

    fn open(folder: &Path, list: &str) -> Result<Capture> {
        std::fs::write(folder.join("priors/priors.json"), list).unwrap();
        Capture::open(folder, &CaptureOptions::default())
    }

    #[test]
    fn listed_maps_are_used_where_the_capture_names_none() {
        let folder = tempfile::tempdir().unwrap();
        let list = r#"{"version": 1, "depth": {"kind": "inverse", "files": {"0.png": "depth/0.npy"}}}"#;
        capture(folder.path(), false);
        let read = open(folder.path(), list).unwrap();
        let kinds: Vec<Option<DepthKind>> = read.frames.iter().map(|f| f.depth.as_ref().map(|d| d.kind)).collect();
        assert_eq!(kinds, [Some(DepthKind::Inverse), None]);
        assert!(read.notes.iter().any(|n| n.contains("depth of 1 images")), "{:?}", read.notes);
        capture(folder.path(), true);
        let read = open(folder.path(), list).unwrap();
        assert!(read.frames.iter().all(|f| f.depth.as_ref().is_some_and(|d| d.kind == DepthKind::Metric)));
    }

    #[test]
    fn damaged_lists_are_errors_with_their_place() {
        let folder = tempfile::tempdir().unwrap();
        capture(folder.path(), false);
        for (list, words) in [
            ("{", "not valid JSON"),
            (r#"{"version": 2}"#, "expected version 1, found 2"),
            (r#"{"version": 1, "deep": {}}"#, "deep"),
            (r#"{"version": 1, "depth": {"kind": "far", "files": {}}}"#, "unknown kind of depth"),
            (
                r#"{"version": 1, "depth": {"kind": "inverse", "files": {"0.png": "../a.npy"}}}"#,
                "not a path below priors/",
            ),
            (r#"{"version": 1, "depth": {"kind": "inverse", "files": {"0.png": 3}}}"#, "not a path below priors/"),
            (r#"{"version": 1, "depth": {"kind": "inverse", "files": {"0.png": "depth/gone.npy"}}}"#, "is missing"),
        ] {
            let text = open(folder.path(), list).unwrap_err().to_string();
            assert!(text.contains(words) && text.contains("priors"), "{text}");
        }
    }
}
