//! Images that are copies of one another although their cameras differ: one was overwritten, or a name leads to the
//! wrong file. Poses and points can be right then, and a few such images hardly change measurements over all images.

use super::super::Capture;
use super::super::account::{Severity, first_names};
use super::super::pose::same_pose;
use super::super::preflight::Finding;
use super::Aspect;
use std::collections::BTreeMap;
use std::path::Path;

/// Pairs of equally long files that are compared, at most; and the longest such files, bytes: it bounds the time.
const PAIRS: usize = 200;
const LONGEST: u64 = 32 << 20;

/// A warning that names them. Compares contents only where files are equally long, which images of two views hardly ever are.
pub(super) fn check(capture: &Capture) -> Option<Finding> {
    let mut by_length: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
    for (i, frame) in capture.frames.iter().enumerate() {
        let Ok(file) = std::fs::metadata(&frame.image) else { continue };
        if file.is_file() && (1..=LONGEST).contains(&file.len()) {
            by_length.entry(file.len()).or_default().push(i);
        }
    }
    let name = |i: usize| capture.frames[i].image.as_path();
    let differ =
        |a: usize, b: usize| name(a) != name(b) && !same_pose(&capture.frames[a].source, &capture.frames[b].source);
    let next = |group: &[usize]| -> Option<[usize; 2]> {
        let (&last, before) = group.split_last()?;
        before.iter().rev().find(|&&other| differ(other, last)).map(|&other| [other, last])
    };
    let pairs = by_length.values().flat_map(|group| (2..=group.len()).filter_map(|n| next(&group[..n])));
    let copies: Vec<[usize; 2]> = pairs.take(PAIRS).filter(|&[a, b]| equal(name(a), name(b))).collect();
    let shown: Vec<String> =
        copies.iter().map(|&[a, b]| format!("{} and {}", name(a).display(), name(b).display())).collect();
    (!copies.is_empty()).then(|| Finding {
        severity: Severity::Warning,
        aspect: Some(Aspect::Assumed),
        what: format!(
            "{} images are copies of others, although their poses differ: {}.",
            copies.len(),
            first_names(&shown)
        ),
        remedy: "Restore the image that was overwritten, or take one of the two out.".into(),
    })
}

fn equal(a: &Path, b: &Path) -> bool {
    match (crate::files::read(a), crate::files::read(b)) {
        (Ok(a), Ok(b)) => a == b,
        _ => false,
    }
}
