//! Images that are copies of one another although their cameras differ: one was overwritten, or a name leads to the
//! wrong file. Poses and points can be right then, and a few such images hardly change measurements over all images.

use super::super::account::{Severity, first_names};
use super::super::pose::same_pose;
use super::super::preflight::Finding;
use super::super::{Capture, Split};
use super::Aspect;
use std::collections::BTreeMap;
use std::path::Path;

/// Pairs of equally long files that are compared, at most; and the longest such files, bytes: it bounds the time.
const PAIRS: usize = 200;
const LONGEST: u64 = 32 << 20;
/// Images of a camera, at least, that can show whether its recording stopped.
const FROZEN: usize = 3;

/// Warnings that name them: copies whose poses differ, and copies of held-out images among those to train on. Compares contents
/// only where files are equally long, which images of two views hardly ever are.
pub(super) fn check(capture: &Capture) -> Vec<Finding> {
    let mut by_length: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
    for (i, frame) in capture.frames.iter().enumerate() {
        let Ok(file) = std::fs::metadata(&frame.image) else { continue };
        if file.is_file() && (1..=LONGEST).contains(&file.len()) {
            by_length.entry(file.len()).or_default().push(i);
        }
    }
    let name = |i: usize| capture.frames[i].image.as_path();
    let copies = |of: &dyn Fn(usize, usize) -> bool| -> Vec<[usize; 2]> {
        let next = |group: &[usize]| -> Option<[usize; 2]> {
            let (&last, before) = group.split_last()?;
            let of = |&&other: &&usize| name(other) != name(last) && of(other, last);
            before.iter().rev().find(of).map(|&other| [other, last])
        };
        let pairs = by_length.values().flat_map(|group| (2..=group.len()).filter_map(|n| next(&group[..n])));
        pairs.take(PAIRS).filter(|&[a, b]| equal(name(a), name(b))).collect()
    };
    let shown = |copies: &[[usize; 2]]| {
        let names: Vec<String> =
            copies.iter().map(|&[a, b]| format!("{} and {}", name(a).display(), name(b).display())).collect();
        first_names(&names)
    };
    let frame = |i: usize| &capture.frames[i];
    let same = |a: usize, b: usize| same_pose(&frame(a).source, &frame(b).source);
    let differing = copies(&|a, b| !same(a, b));
    // What one camera shows at one time is compared when the capture is opened.
    let trains = |i: usize| capture.split(i) == Split::Train;
    let leaking = copies(&|a, b| {
        same(a, b) && frame(a).time == frame(b).time && frame(a).camera != frame(b).camera && trains(a) != trains(b)
    });
    let warning = |what: String, remedy: &str| Finding {
        severity: Severity::Warning,
        aspect: Some(Aspect::Assumed),
        what,
        remedy: remedy.into(),
    };
    let mut out = Vec::new();
    if !differing.is_empty() {
        let what = format!(
            "{} images are copies of others, although their poses differ: {}.",
            differing.len(),
            shown(&differing)
        );
        out.push(warning(what, "Restore the image that was overwritten, or take one of the two out."));
    }
    if !leaking.is_empty() {
        let what = format!(
            "{} held-out images are copies of training images, with the same pose: {}. Scores on them do not measure new \
             views.",
            leaking.len(),
            shown(&leaking)
        );
        out.push(warning(what, "Take the copies out of the capture."));
    }
    out.extend(frozen(capture));
    out
}

/// Fixed cameras whose images are all the same, where most others' are not: their recording stopped.
fn frozen(capture: &Capture) -> Option<Finding> {
    let mut images: BTreeMap<usize, Vec<(f64, &Path)>> = BTreeMap::new();
    for frame in capture.frames.iter().filter(|f| capture.cameras[f.camera].fixed) {
        images.entry(frame.camera).or_default().push((frame.time.0, &frame.image));
    }
    images.retain(|_, films| films.len() >= FROZEN);
    images.values_mut().for_each(|films| films.sort_by(|a, b| a.0.total_cmp(&b.0)));
    let length = |path: &Path| std::fs::metadata(path).map_or(0, |m| m.len());
    let is_frozen = |films: &[(f64, &Path)]| {
        let [first, middle, last] = [0, films.len() / 2, films.len() - 1].map(|k| films[k].1);
        let alike = |other: &Path| (1..=LONGEST).contains(&length(first)) && length(first) == length(other);
        alike(middle) && alike(last) && equal(first, middle) && equal(first, last)
    };
    let names: Vec<&str> =
        images.iter().filter(|(_, f)| is_frozen(f)).map(|(c, _)| capture.cameras[*c].name.as_str()).collect();
    let few = !names.is_empty() && 2 * names.len() < images.len();
    few.then(|| Finding {
        severity: Severity::Warning,
        aspect: Some(Aspect::Assumed),
        what: format!("Cameras that show the same image all the time, as others do not: {}.", first_names(&names)),
        remedy: "Extract their frames again, or take these cameras out.".into(),
    })
}

fn equal(a: &Path, b: &Path) -> bool {
    match (crate::files::read(a), crate::files::read(b)) {
        (Ok(a), Ok(b)) => a == b,
        _ => false,
    }
}
