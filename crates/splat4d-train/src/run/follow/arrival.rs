//! Whether a frame of a growing capture has arrived: all its files are there, no longer change, and can be decoded.

use crate::capture::{CaptureOptions, Rgb8, frame_files};
use crate::{Error, Result};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// The file in a capture's folder that states that no further frame will come.
pub(super) const END_MARKER: &str = "capture.end";
/// A file that was last written so long ago is taken as complete without a second look.
const SETTLED: Duration = Duration::from_secs(1);
/// Endings of files that are decoded as images; of others only the length is watched.
const DECODED: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

/// What there is of a frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// All its files.
    Complete,
    /// Not all of them.
    Incomplete {
        /// What is missing, a clause.
        what: String,
        /// Whether some files of the frame are there.
        begun: bool,
    },
    /// It will never be complete: the capture states that it has ended.
    Ended {
        /// What is left out, a clause; none: nothing.
        left: Option<String>,
    },
}

/// A file as it was seen last.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Look {
    length: u64,
    modified: Option<SystemTime>,
    /// Size of the image, once it was decoded.
    decoded: Option<[usize; 2]>,
    error: Option<String>,
}

/// Watches a capture's files.
#[derive(Debug, Default)]
pub(super) struct Watch {
    seen: BTreeMap<PathBuf, Look>,
    /// Size of every camera's images, from the first frame that was complete.
    sizes: BTreeMap<String, [usize; 2]>,
}

impl Watch {
    /// Examines the files of a frame once; a file that is new is complete at the second call at the earliest.
    ///
    /// Errors: an image of another size than its camera's first one.
    pub(super) fn look(&mut self, root: &Path, frame: usize, options: &CaptureOptions) -> Result<Arrival> {
        let files = match frame_files(root, frame, options) {
            Ok(files) => files,
            // It may be replaced at this moment.
            Err(e) => return Ok(Arrival::Incomplete { what: e.to_string(), begun: false }),
        };
        if let Some(count) = files.stated.filter(|count| frame >= *count) {
            let left = format!("capture.json states {count} frames, and {frame} were followed before");
            return Ok(Arrival::Ended { left: (frame > count).then_some(left) });
        }
        let (mut missing, mut begun) = (Vec::new(), false);
        for (camera, paths) in &files.cameras {
            let Some(paths) = paths else {
                missing.push(format!("camera {camera} lists no image of frame {frame}"));
                continue;
            };
            for path in paths {
                match std::fs::metadata(path) {
                    Ok(found) if found.is_file() => begun = true,
                    _ => missing.push(format!("camera {camera} has no {}", path.display())),
                }
            }
        }
        if let Some(first) = missing.first() {
            let what = counted(first, missing.len());
            return Ok(match root.join(END_MARKER).is_file() {
                true => Arrival::Ended { left: begun.then_some(what) },
                false => Arrival::Incomplete { what, begun },
            });
        }
        let all: Vec<PathBuf> = files.cameras.iter().flat_map(|(_, paths)| paths.iter().flatten().cloned()).collect();
        self.seen.retain(|path, _| all.contains(path));
        let looks: Vec<Look> = all.par_iter().map(|path| self.again(path)).collect();
        self.seen = all.into_iter().zip(looks).collect();
        let unready: Vec<String> = self.seen.iter().filter(|(_, look)| look.decoded.is_none()).map(unready).collect();
        if let Some(first) = unready.first() {
            return Ok(Arrival::Incomplete { what: counted(first, unready.len()), begun: true });
        }
        self.check_sizes(&files.cameras)?;
        Ok(Arrival::Complete)
    }

    /// A file as it is now, decoded if it did not change since the last look.
    fn again(&self, path: &Path) -> Look {
        let Ok(found) = std::fs::metadata(path) else { return Look::default() };
        let now = Look { length: found.len(), modified: found.modified().ok(), ..Look::default() };
        let old = now.modified.and_then(|t| t.elapsed().ok()).is_some_and(|age| age >= SETTLED);
        match self.seen.get(path) {
            Some(last) if (last.length, last.modified) == (now.length, now.modified) => match last.decoded {
                Some(_) => last.clone(),
                None => decoded(path, now),
            },
            None if old => decoded(path, now),
            _ => now,
        }
    }

    fn check_sizes(&mut self, cameras: &[(String, Option<Vec<PathBuf>>)]) -> Result<()> {
        for (camera, paths) in cameras {
            let Some((image, size)) =
                paths.as_ref().and_then(|p| Some((p.first()?, self.seen.get(p.first()?)?.decoded?)))
            else {
                continue;
            };
            let first = *self.sizes.entry(camera.clone()).or_insert(size);
            if first != size {
                let what = format!(
                    "has {}x{} pixels, and earlier images of its camera {}x{}",
                    size[0], size[1], first[0], first[1]
                );
                return Err(Error::input(what)
                    .at(image.display())
                    .remedy("Record all frames at one size. After that, the same command continues the run."));
            }
        }
        Ok(())
    }
}

/// The state of a file that does not change: its image's size, or why there is none.
fn decoded(path: &Path, now: Look) -> Look {
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    if now.length == 0 {
        return Look { error: Some("is empty".into()), ..now };
    }
    if !DECODED.iter().any(|known| ending.eq_ignore_ascii_case(known)) {
        return Look { decoded: Some([0; 2]), ..now };
    }
    match Rgb8::read(path) {
        Ok(image) => Look { decoded: Some([image.width, image.height]), ..now },
        Err(e) => Look { error: Some(e.to_string()), ..now },
    }
}

fn unready((path, look): (&PathBuf, &Look)) -> String {
    match &look.error {
        Some(error) => format!("{} is not a complete image: {error}", path.display()),
        None => format!("{} is still being written", path.display()),
    }
}

/// The first of some findings, and how many others there are.
fn counted(first: &str, count: usize) -> String {
    let others = if count > 1 { format!(" (and {} more)", count - 1) } else { String::new() };
    format!("{first}{others}")
}
