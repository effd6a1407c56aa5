//! The files of one frame of a capture that is still being written: which there are to be, and where.

use super::CaptureOptions;
use super::json::{self, Node};
use super::lookup::Lookup;
use super::own::Files;
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

/// The marker of the layout that can be read while it grows.
const MARKER: &str = "capture.json";
/// Files of a camera that belong to a frame.
const KEYS: [&str; 3] = ["images", "masks", "depth"];

/// The files of a frame, whether they are there or not.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct FrameFiles {
    /// Number of frames that the capture states; none: it does not.
    pub stated: Option<usize>,
    /// Each camera's name and files, the image first; none: its list of images does not reach the frame yet.
    pub cameras: Vec<(String, Option<Vec<PathBuf>>)>,
}

/// The folder of a capture that may grow. Errors: the path is not that of a `capture.json`.
pub(crate) fn growing_root(path: &Path) -> Result<&Path> {
    let file = path.file_name().is_some_and(|name| name == MARKER) && path.is_file();
    let root = if file { path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new(".")) } else { path };
    if root.join(MARKER).is_file() {
        return Ok(root);
    }
    Err(Error::input(format!("contains no {MARKER}: cameras must be known before a capture is followed"))
        .at(path.display())
        .remedy("Write capture.json with the cameras' poses first (docs/follow.md)."))
}

/// Reads which files frame `frame` has.
///
/// Errors: `capture.json` is missing or damaged, as it may be while it is replaced; cameras that move.
pub(crate) fn frame_files(root: &Path, frame: usize, options: &CaptureOptions) -> Result<FrameFiles> {
    let marker = root.join(MARKER);
    let value = json::read(&marker)?;
    files_in(root, &Node::root(&value), frame, options).map_err(|e| e.at(marker.display()))
}

fn files_in(root: &Path, top: &Node<'_>, frame: usize, options: &CaptureOptions) -> Result<FrameFiles> {
    let lookup = Lookup::new(root, options)?;
    let bases = lookup.bases();
    let mut out = FrameFiles::default();
    for camera in top.get("cameras")?.list()? {
        let shared = |key: &str| {
            let own = camera.opt(key)?;
            own.or(top.opt(key)?).map(|n| n.count()).transpose()
        };
        let moving = |key: &str| camera.value[key].pointer("/0/0/0").is_some();
        if moving("world_to_camera") || moving("camera_to_world") {
            return Err(camera.error("the camera moves, and only fixed cameras can be followed").remedy(
                "Give each camera one pose, or train the capture when it is complete (without option `follow`).",
            ));
        }
        let start = shared("start")?.unwrap_or(0);
        // The shortest camera ends the capture: a frame needs all of them.
        out.stated = [out.stated, shared("frames")?].into_iter().flatten().min();
        let mut files = Some(Vec::new());
        for key in KEYS {
            let node = if key == KEYS[0] { Some(camera.get(key)?) } else { camera.opt(key)? };
            let Some(node) = node else { continue };
            let names = Files::read(&node)?;
            let path = match key == KEYS[0] {
                true => names.text(start, frame).map(|name| {
                    let found = lookup.image(&bases, &name).map_err(|e| node.at(e))?;
                    Ok::<_, Error>(found.unwrap_or_else(|| bases[0].join(&name)))
                }),
                false => names.path(&lookup, start, frame).transpose(),
            };
            match (path.transpose()?, &mut files) {
                (Some(path), Some(list)) => list.push(path),
                _ => files = None,
            }
        }
        out.cameras.push((camera.get("name")?.text()?.to_owned(), files));
    }
    if out.cameras.is_empty() {
        return Err(top.error("there are no cameras").remedy("List them under \"cameras\"."));
    }
    Ok(out)
}
