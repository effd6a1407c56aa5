//! Runs of versions without a file list: their markers, and the files that certainly are not the user's.

use super::STATE;
use crate::recipe::Recipe;
use std::path::{Path, PathBuf};

/// Files of a run's folder that nothing but a run has there.
const FILES: [&str; 15] = [
    "recipe.toml",
    "run.json",
    "scene.safetensors",
    "scene.splat4d",
    "still.safetensors",
    "metrics.csv",
    "results.json",
    "refined.json",
    "per_view.json",
    "compress.json",
    "compress.toml",
    "cameras.json",
    "orbit.mp4",
    "orbit.png",
    "report.html",
];
/// Files of `predict/`.
const PREDICTED: [&str; 5] =
    ["report.html", "predict.json", "dynamics.safetensors", "scene.safetensors", "scene.splat4d"];
/// Folders of images and results by split, perhaps with a background's name behind.
const SPLITS: [&str; 3] = ["test", "val", "train"];
/// Runs within a run.
const INNER: [&str; 2] = ["baseline", "unpruned"];
/// Start of the comment that points found in images have.
const FOUND_POINTS: &[u8] = b"comment of ";
/// Bytes of such a file in which it is searched for.
const HEAD: usize = 512;

/// Whether a folder is a run: its `recipe.toml` or `run.json` is one that we wrote.
pub(super) fn is_run(folder: &Path) -> bool {
    let text = |name: &str| crate::files::read_text(&folder.join(name)).ok();
    let recipe = text("recipe.toml").is_some_and(|t| !t.trim().is_empty() && Recipe::from_toml(&t).is_ok());
    let info = || {
        let value: serde_json::Value = serde_json::from_str(&text("run.json")?).ok()?;
        Some(value["capture"].is_string() && value["version"].is_string())
    };
    recipe || info() == Some(true)
}

/// The files of a run, relative to it, that only splat4d can have written. What might be the user's stays.
pub(super) fn files(folder: &Path) -> Vec<PathBuf> {
    let mut out = Vec::new();
    collect(folder, Path::new(""), &mut out);
    out
}

fn collect(root: &Path, at: &Path, out: &mut Vec<PathBuf>) {
    let own = |names: &[&str], sub: &str, out: &mut Vec<PathBuf>| {
        let there = names.iter().map(|n| at.join(sub).join(n)).filter(|p| is_file(&root.join(p)));
        out.extend(there);
    };
    own(&FILES, "", out);
    own(&PREDICTED, "predict", out);
    out.extend(matching(root, &at.join("checkpoints"), |n| numbered(n, 8, ".safetensors")));
    for name in children(&root.join(at)) {
        let split = name.split_once('-').map_or(name.as_str(), |(split, _)| split);
        if SPLITS.contains(&split) {
            for run in children(&root.join(at).join(&name)).into_iter().filter(|n| n.starts_with("ours_")) {
                for kind in ["renders", "gt", "errors"] {
                    let folder = at.join(&name).join(&run).join(kind);
                    out.extend(matching(root, &folder, |n| numbered(n, 5, ".png")));
                }
            }
        }
        if INNER.contains(&name.as_str()) && is_run(&root.join(at).join(&name)) {
            collect(root, &at.join(&name), out);
        }
    }
    let points = at.join("points.ply");
    if crate::files::read(&root.join(&points))
        .is_ok_and(|b| b[..b.len().min(HEAD)].windows(FOUND_POINTS.len()).any(|w| w == FOUND_POINTS))
    {
        out.push(points);
    }
    let flow = at.join("flow");
    if is_file(&root.join(&flow).join("of.txt")) {
        out.push(flow.join("of.txt"));
        for camera in children(&root.join(&flow)).into_iter().filter(|n| numbered(n, 3, "")) {
            out.extend(matching(root, &flow.join(camera), |n| numbered(n, 6, ".png")));
        }
    }
    let chunks = at.join("chunks");
    if is_file(&root.join(&chunks).join("plan.json")) {
        out.push(chunks.join("plan.json"));
        for part in children(&root.join(&chunks)) {
            if part == "shared" || numbered(&part, 2, "") {
                collect(root, &chunks.join(&part), out);
                out.extend(matching(root, &chunks.join(&part), |n| n == "lock"));
            }
        }
        // The medians of the static background, a capture of our own.
        all(root, &chunks.join("shared/capture"), out);
    }
}

/// All files below a folder.
fn all(root: &Path, at: &Path, out: &mut Vec<PathBuf>) {
    for name in children(&root.join(at)) {
        let path = at.join(name);
        match std::fs::symlink_metadata(root.join(&path)) {
            Ok(m) if m.is_dir() => all(root, &path, out),
            Ok(m) if m.is_file() => out.push(path),
            _ => {}
        }
    }
}

fn matching(root: &Path, folder: &Path, which: impl Fn(&str) -> bool) -> Vec<PathBuf> {
    let names = children(&root.join(folder)).into_iter().filter(|n| which(n));
    names.map(|n| folder.join(n)).filter(|p| is_file(&root.join(p))).collect()
}

/// The names in a folder that is none of a link's.
fn children(folder: &Path) -> Vec<String> {
    if std::fs::symlink_metadata(folder).is_ok_and(|m| m.is_symlink()) {
        return Vec::new();
    }
    let names =
        std::fs::read_dir(folder).into_iter().flatten().flatten().filter_map(|e| e.file_name().into_string().ok());
    let mut names: Vec<String> = names.filter(|n| n != STATE).collect();
    names.sort();
    names
}

fn is_file(path: &Path) -> bool {
    std::fs::symlink_metadata(path).is_ok_and(|m| m.is_file())
}

/// At least this many digits, then this ending.
fn numbered(name: &str, digits: usize, ending: &str) -> bool {
    name.strip_suffix(ending).is_some_and(|n| n.len() >= digits && n.bytes().all(|b| b.is_ascii_digit()))
}
