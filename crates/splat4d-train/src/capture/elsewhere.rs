//! Files that a capture reads from outside its folder: it names files by other paths, or holds links to folders or to
//! files.

use super::Frame;
use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};

/// Real folders outside of `root` with images, masks and maps, and real files outside of it of which `others` are some.
pub(super) fn find(root: &Path, frames: &[Frame], others: &[PathBuf]) -> BTreeSet<PathBuf> {
    let Ok(real_root) = root.canonicalize() else { return BTreeSet::new() };
    let files = frames.iter().flat_map(|f| {
        let priors = [f.depth.as_ref().map(|d| &d.path), f.flow.as_ref().map(|f| &f.path)];
        let beside = [f.mask.as_ref(), f.labels.as_ref(), f.features.as_ref()];
        std::iter::once(&f.image).chain(priors.into_iter().chain(beside).flatten())
    });
    let files: BTreeSet<&Path> = files.map(PathBuf::as_path).collect();
    let folders: BTreeSet<&Path> = files.iter().filter_map(|file| file.parent()).collect();
    let below = |p: &&Path| p.starts_with(root) && !p.components().any(|c| c == Component::ParentDir);
    // A link to a folder leads to all of it.
    let above = folders.iter().copied().filter(below).flat_map(|p| p.ancestors().take_while(|above| *above != root));
    let named: BTreeSet<&Path> = above.chain(folders.iter().copied()).collect();
    let linked = files.iter().filter(|file| file.is_symlink()).filter_map(|file| file.canonicalize().ok());
    let of_links: BTreeSet<PathBuf> = linked.filter_map(|file| file.parent().map(Path::to_owned)).collect();
    let tracks = frames.iter().filter_map(|f| f.tracks.as_ref()).map(|t| &t.path);
    let single: BTreeSet<&PathBuf> = tracks.chain(others).collect();
    let real = named.into_iter().filter_map(|p| p.canonicalize().ok()).chain(of_links);
    let real = real.chain(single.into_iter().filter_map(|p| p.canonicalize().ok()));
    real.filter(|p| !p.starts_with(&real_root)).collect()
}
