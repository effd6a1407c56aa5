//! Masks that are next to the images of any layout: found by the usual names, and those that fit nothing are counted.
//!
//! For the image `cam0/a.jpg` these are, in `masks/` or `mask/`: `cam0/a.jpg.png` (COLMAP), `cam0/a.png`,
//! `cam0/a_mask.png`, `cam0/mask_a.png` and `cam0/a.mask.png` (Metashape), with any ending of images.

use super::account::Severity;
use super::account::{Aspect, first_names};
use super::lookup::{fold, is_image_folder, key, may_hold_masks, without_ending};
use super::{CaptureKind, RawCapture, RawFrame, rig};
use splat4d::{Error, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Folders of masks, in any letter case.
const FOLDERS: [&str; 2] = ["masks", "mask"];
/// Suffixes of mask names.
const SUFFIXES: [&str; 4] = ["_mask", "-mask", ".mask", "_seg"];
const PREFIXES: [&str; 2] = ["mask_", "mask-"];
/// Search depth in folders of masks.
const MOST_LEVELS: usize = 4;

/// Gives frames without a mask theirs. Errors: two masks of one image.
pub(super) fn fill(take: &mut RawCapture) -> Result<()> {
    let folders: Vec<String> = rig::file_names(&take.root).into_iter().filter(|n| take.root.join(n).is_dir()).collect();
    let named = |known: &&str| folders.iter().find(|n| fold(n) == **known);
    let Some(name) = FOLDERS.iter().find_map(named) else {
        report_others(take, &folders);
        return Ok(());
    };
    let folder = take.root.join(name);
    let mut files = Vec::new();
    list(&folder, String::new(), 0, &mut files);
    if files.is_empty() {
        let others: Vec<String> = rig::file_names(&folder).into_iter().filter(|n| folder.join(n).is_file()).collect();
        if !others.is_empty() {
            let what = format!(
                "{} files in {name}/, none of which is an image ({}): training runs without masks. Write them as PNG.",
                others.len(),
                first_names(&others)
            );
            take.account.add(Aspect::NotRead, Severity::Warning, what);
        }
        let others: Vec<String> = folders.iter().filter(|n| *n != name).cloned().collect();
        report_others(take, &others);
        return Ok(());
    }
    let stated: BTreeSet<PathBuf> = take.frames.iter().filter_map(|f| f.mask.clone()).collect();
    let unused = |name: &String| !stated.contains(&folder.join(name));
    if take.kind == CaptureKind::Own {
        // What a capture.json does not name is not used: it names masks camera by camera.
        let unused: Vec<&String> = files.iter().filter(|n| unused(n)).collect();
        if !unused.is_empty() && stated.is_empty() {
            let what =
                format!("{} files in {}: capture.json names no masks (key \"masks\").", unused.len(), folder.display());
            take.account.add(Aspect::NotRead, Severity::Note, what);
        }
        return Ok(());
    }
    let mut by_name: BTreeMap<String, Vec<&String>> = BTreeMap::new();
    for file in files.iter().filter(|n| unused(n)) {
        by_name.entry(image_key(file)).or_default().push(file);
    }
    // Where folders differ (`rgb/1x`), a name that only one image has is enough.
    let short = |image: &Path| fold(without_ending(&image.file_name().unwrap_or_default().to_string_lossy()));
    let mut by_file: BTreeMap<String, Vec<&String>> = BTreeMap::new();
    for (key, masks) in &by_name {
        by_file.entry(key.rsplit('/').next().unwrap_or(key).to_owned()).or_default().extend(masks);
    }
    let mut names: BTreeMap<String, usize> = BTreeMap::new();
    take.frames.iter().for_each(|f| *names.entry(short(&f.image)).or_default() += 1);
    let mut used: BTreeSet<&String> = BTreeSet::new();
    let mut filled = 0;
    for frame in take.frames.iter_mut().filter(|f| f.mask.is_none()) {
        let relative = below(&take.root, &frame.image);
        let alone = || by_file.get(&short(&frame.image)).filter(|_| names.get(&short(&frame.image)) == Some(&1));
        let Some(fitting) = by_name.get(&key(&relative)).or_else(alone) else { continue };
        let name = relative.rsplit(['/', '\\']).next().unwrap_or_default();
        let rank = |mask: &str| rank(mask, name);
        let best = fitting.iter().map(|m| rank(m)).min().unwrap_or(0);
        let mut first = fitting.iter().filter(|m| rank(m) == best);
        let (Some(mask), None) = (first.next(), first.next()) else {
            let names: Vec<&str> = fitting.iter().map(|m| m.as_str()).collect();
            return Err(Error::input(format!("several masks fit one image: {}", names.join(", ")))
                .at(frame.image.display())
                .remedy(format!("Keep one of them in {}.", folder.display())));
        };
        frame.mask = Some(folder.join(mask));
        used.extend(fitting.iter().copied());
        filled += 1;
    }
    report(take, &folder, (files.len(), &by_name, &used, filled));
    Ok(())
}

/// An image's path below the capture's folder.
fn below(root: &Path, image: &Path) -> String {
    image.strip_prefix(root).unwrap_or(image).to_string_lossy().into_owned()
}

/// Names folders that may hold masks and are not read, where no frame has one.
fn report_others(take: &mut RawCapture, folders: &[String]) {
    let others: Vec<&String> = folders.iter().filter(|n| may_hold_masks(n)).collect();
    let images: BTreeSet<String> = take.frames.iter().map(|f| image_key(&below(&take.root, &f.image))).collect();
    let fits = |folder: &&&String| {
        let mut files = Vec::new();
        list(&take.root.join(folder), String::new(), 0, &mut files);
        files.iter().filter(|file| images.contains(&image_key(file))).count() >= take.frames.len().div_ceil(2)
    };
    let read = |folder: &String| {
        let folder = take.root.join(folder);
        let maps = |f: &RawFrame| {
            let (depth, flow) = (f.depth.as_ref().map(|d| d.path.clone()), f.flow.clone());
            [depth, flow, f.mask.clone(), f.labels.clone(), f.features.clone()]
        };
        take.frames
            .iter()
            .any(|f| f.image.starts_with(&folder) || maps(f).iter().flatten().any(|p| p.starts_with(&folder)))
    };
    let usual =
        |n: &&String| !may_hold_masks(n) && !is_image_folder(&fold(n)) && !n.starts_with('.') && !rig::is_plain(n);
    let like: Vec<&String> = folders.iter().filter(usual).filter(|n| !read(n)).filter(|n| fits(&n)).collect();
    if !like.is_empty() {
        let what = format!(
            "Folders whose files are named like the images: {}. Masks are read from a folder called masks; capture.json names \
             depth, labels and others.",
            first_names(&like)
        );
        take.account.add(Aspect::NotRead, Severity::Note, what);
    }
    if others.is_empty() || take.frames.iter().any(|f| f.mask.is_some()) {
        return;
    }
    let (severity, what) = match others.iter().find(fits) {
        Some(folder) => (
            Severity::Warning,
            format!(
                "The files in {folder}/ are named like the images and are probably masks, which are not read. To use them (white \
                 counts), call the folder masks."
            ),
        ),
        None => (
            Severity::Note,
            format!("Folders that may hold masks: {}. To use one, call it masks.", first_names(&others)),
        ),
    };
    take.account.add(Aspect::NotRead, severity, what);
}

/// Reports how many masks and images have no counterpart.
fn report(
    take: &mut RawCapture,
    folder: &Path,
    (all, by_name, used, filled): (usize, &BTreeMap<String, Vec<&String>>, &BTreeSet<&String>, usize),
) {
    let idle: Vec<&String> = by_name.values().flatten().filter(|m| !used.contains(*m)).copied().collect();
    let name = folder.strip_prefix(&take.root).unwrap_or(folder).display();
    if filled == 0 && used.is_empty() && idle.len() == all {
        let example =
            take.frames.first().map(|f| f.image.file_name().unwrap_or_default().to_string_lossy().into_owned());
        let example = example.unwrap_or_default();
        let stem = without_ending(&example);
        let what = format!(
            "None of the {all} files in {name}/ fits an image ({}). Expected for instance {example}.png, {stem}.png or \
             {stem}_mask.png: training runs without masks.",
            first_names(&idle)
        );
        take.account.add(Aspect::NotRead, Severity::Warning, what);
    } else if !idle.is_empty() && idle.len() == take.frames.iter().filter(|f| f.mask.is_none()).count() {
        let bare: Vec<String> =
            take.frames.iter().filter(|f| f.mask.is_none()).map(|f| below(&take.root, &f.image)).collect();
        let what = format!(
            "Masks probably have other numbers than their images: {} of {} images have none ({}), and as many files in {name}/ fit \
             no image ({}). Where one counts from 0 and the other from 1, every mask is one frame off: rename them.",
            bare.len(),
            take.frames.len(),
            first_names(&bare),
            first_names(&idle)
        );
        take.account.add(Aspect::Assumed, Severity::Warning, what);
    } else if !idle.is_empty() {
        let what =
            format!("{} of {all} files in {name}/ fit no image of the capture: {}.", idle.len(), first_names(&idle));
        take.account.add(Aspect::NotRead, Severity::Note, what);
    }
    let without = take.frames.iter().filter(|f| f.mask.is_none()).count();
    if filled > 0 && without > 0 {
        let what = format!("Masks of {without} of {} images.", take.frames.len());
        take.account.add(Aspect::NotFound, Severity::Note, what);
    }
}

/// Priority among several masks of an image: COLMAP's name, the image's own, then the others.
fn rank(mask: &str, image: &str) -> usize {
    let file = mask.rsplit('/').next().unwrap_or(mask);
    let (own, appended) = (fold(without_ending(file)), fold(file));
    match () {
        () if own == fold(image) => 0,
        () if appended == format!("{}.png", fold(without_ending(image))) => 1,
        () if own == fold(without_ending(image)) => 2,
        () => 3,
    }
}

/// Names of the images below a folder, relative to it, with forward slashes.
fn list(folder: &Path, below: String, level: usize, out: &mut Vec<String>) {
    for name in rig::file_names(folder) {
        let path = folder.join(&name);
        if rig::is_image(&name) {
            out.push(format!("{below}{name}"));
        } else if level < MOST_LEVELS && path.is_dir() {
            list(&path, format!("{below}{name}/"), level + 1, out);
        }
    }
}

/// The [`key`] of the image that a mask is named after.
fn image_key(mask: &str) -> String {
    let whole = key(mask);
    let (folders, file) = whole.rsplit_once('/').map_or(("", whole.as_str()), |(folders, file)| (folders, file));
    // `a.jpg.png` is of `a.jpg`.
    let mut stem = without_ending(file);
    if let Some(short) = SUFFIXES.iter().find_map(|s| stem.strip_suffix(s)) {
        stem = without_ending(short);
    } else if let Some(short) = PREFIXES.iter().find_map(|p| stem.strip_prefix(p)) {
        stem = short;
    }
    if folders.is_empty() { stem.to_owned() } else { format!("{folders}/{stem}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_with_usual_names_are_matched_to_images() {
        let names = [
            "cam0/a.jpg.png",
            "cam0/a.png",
            "cam0/a.jpg",
            "cam0/A.PNG",
            "cam0/a_mask.png",
            "cam0/mask_a.png",
            "cam0/a.mask.png",
            "images/cam0/a.png",
            "cam0/a.jpg_mask.png",
        ];
        for name in names {
            assert_eq!(image_key(name), "cam0/a", "{name}");
        }
        assert_ne!(image_key("cam0/b.png"), "cam0/a");
        assert!(
            rank("a.jpg.png", "a.jpg") < rank("a.png", "a.jpg") && rank("a.png", "a.jpg") < rank("a_mask.png", "a.jpg")
        );
    }
}
