//! 4DGaussians' "multipleview" layout: a folder of frames per camera (`cam01/frame_00001.jpg`), and a COLMAP model of
//! the first frames in `sparse_/` whose images are called `image1.jpg` by the number of their camera's folder.

use super::super::account::Severity;
use super::super::account::{Account, Aspect};
use super::super::points::read_cloud;
use super::super::{PointCloud, rig};
use super::Shot;
use splat4d::Result;
use std::collections::BTreeMap;
use std::path::Path;

/// Prefixes of the model's images and of the cameras' folders.
const IMAGE: &str = "image";
const CAMERA: &str = "cam";
/// Path of the dense cloud of the layout's scripts.
const POINTS: &str = "points3D_multipleview.ply";

/// Camera folders by their numbers.
fn folders(root: &Path) -> BTreeMap<usize, String> {
    let number = |name: &str| name.strip_prefix(CAMERA)?.parse().ok();
    let named = rig::file_names(root).into_iter().filter_map(|name| Some((number(&name)?, name)));
    named.filter(|(_, name)| !rig::image_names(&root.join(name)).is_empty()).collect()
}

/// Whether a folder has cameras of this layout.
pub(super) fn applies(root: &Path) -> bool {
    folders(root).len() > 1
}

/// Puts all frames of the cameras in the place of the model's images, if these are named as in this layout; states so.
pub(super) fn rename(root: &Path, shots: &mut Vec<Shot>, account: &mut Account) -> bool {
    let folders = folders(root);
    let number = |name: &str| {
        let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
        stem.strip_prefix(IMAGE)?.parse::<usize>().ok()
    };
    let numbers: Option<Vec<usize>> = shots.iter().map(|(name, _)| number(name)).collect();
    let Some(numbers) = numbers.filter(|n| !n.is_empty() && folders.len() > 1) else { return false };
    // By the numbers of the folders; where these do not fit, image N is the Nth folder.
    let by_number = numbers.iter().all(|n| folders.contains_key(n));
    let nth: Vec<&String> = folders.values().collect();
    let folder = |n: &usize| if by_number { folders.get(n) } else { nth.get(n.checked_sub(1)?).copied() };
    let Some(found) = numbers.iter().map(folder).collect::<Option<Vec<&String>>>() else { return false };
    let posed = std::mem::take(shots);
    for ((_, source), folder) in posed.into_iter().zip(&found) {
        let frames = rig::image_names(&root.join(folder));
        shots.extend(frames.into_iter().map(|frame| (format!("{folder}/{frame}"), source.clone())));
    }
    let what = format!(
        "{} fixed cameras: image N of the model is the first frame of the camera folder {}.",
        found.len(),
        if by_number { "with that number" } else { "in that place" }
    );
    account.add(Aspect::Assumed, Severity::Note, what);
    true
}

/// The layout's own cloud.
pub(super) fn points(root: &Path) -> Result<Option<PointCloud>> {
    let path = root.join(POINTS);
    path.is_file().then(|| read_cloud(&path)).transpose()
}
