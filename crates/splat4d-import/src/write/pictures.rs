//! Frames of videos as image files, and a table of their times.

use crate::video::{Clock, Frame, Gap, Rgb8, Selection, Source, fnv1a, mean_difference};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::encode::{self, Pixels};
use splat4d_train::event::Progress;
use splat4d_train::output::{write_atomically, written};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Version of the notes; others are made again.
const VERSION: u32 = 1;
/// Folder of the notes, next to that of the images.
const NOTES: &str = "import";
/// Folder of the images, in one for each camera.
const IMAGES: &str = "images";
/// Images that are compressed at a time: eight of 4K are 200 MB.
const BATCH: usize = 8;
/// Least quality of JPEG files: below, blocks are seen that training would learn.
const MIN_QUALITY: u8 = 95;
/// Longest name of a camera, characters.
const MAX_NAME: usize = 60;

/// How images are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// JPEG of this quality, 95 to 100, colours in full resolution.
    Jpeg(u8),
    /// PNG: every bit, four times as large.
    Png,
}

impl Default for Format {
    fn default() -> Self {
        Self::Jpeg(MIN_QUALITY)
    }
}

impl Format {
    fn ending(self) -> &'static str {
        match self {
            Self::Jpeg(_) => "jpg",
            Self::Png => "png",
        }
    }

    fn encode(self, picture: &Rgb8, alpha: &[u8]) -> Result<Vec<u8>> {
        let size = [picture.width, picture.height];
        if !alpha.is_empty() {
            let pixels = picture.data.chunks_exact(3).zip(alpha);
            let rgba: Vec<u8> = pixels.flat_map(|(rgb, a)| [rgb[0], rgb[1], rgb[2], *a]).collect();
            return Ok(encode::png(Pixels::Eight(&rgba), size, 4));
        }
        match self {
            Self::Jpeg(quality) => encode::jpeg(&picture.data, size, quality),
            Self::Png => Ok(encode::png(Pixels::Eight(&picture.data), size, 3)),
        }
    }
}

/// Stored part of a source, and its name.
pub(crate) struct Clip<'a> {
    /// The camera's name; see `camera_names`.
    pub name: String,
    /// Source of frames.
    pub source: &'a dyn Source,
    /// Which of them, on the source's own clock.
    pub selection: Selection,
}

/// A stored frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shot {
    /// Its number among the frames that were read.
    pub number: usize,
    /// Seconds on the camera's clock.
    pub time: f64,
}

/// The stored images of a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Pictures {
    /// The camera's name.
    pub name: String,
    /// Pixels across and down.
    pub size: [usize; 2],
    /// The pattern of the files, from the capture's folder on; the number is the position in `shots`.
    pub pattern: String,
    /// The frames, in the order of time.
    pub shots: Vec<Shot>,
    /// The camera's clock.
    pub clock: Clock,
    /// Remarks, a sentence or two each.
    pub warnings: Vec<String>,
    /// Changes with everything that the images were made of.
    pub fingerprint: String,
}

impl Pictures {
    /// The file of a shot, from the capture's folder on.
    pub(crate) fn file(&self, shot: usize) -> PathBuf {
        let (before, after) = self.pattern.split_once("%06d").expect("we wrote the pattern");
        PathBuf::from(format!("{before}{shot:06}{after}"))
    }
}

/// The notes next to a camera's images.
#[derive(Default, Serialize, Deserialize)]
struct Note {
    version: u32,
    /// Of everything that the images depend on.
    fingerprint: String,
    /// Whether all are there.
    complete: bool,
    size: [usize; 2],
    shots: Vec<Shot>,
    interval: f64,
    variable: bool,
    still: bool,
    /// After which frame, how many.
    dropped: Vec<[usize; 2]>,
    doubled: Vec<usize>,
    warnings: Vec<String>,
}

/// Names for cameras that are folders, too: of their sources' names what all systems allow, each once.
pub(crate) fn camera_names(wanted: &[&str]) -> Vec<String> {
    let mut taken = BTreeSet::new();
    let one = |name: &&str| {
        let allowed = |c: char| if c.is_alphanumeric() || "-_".contains(c) { c } else { '_' };
        let plain: String = name.chars().take(MAX_NAME).map(allowed).collect();
        // A dash at the beginning is an option to other programs.
        let plain = plain.trim_start_matches('-');
        let plain = if plain.is_empty() { "camera" } else { plain };
        // Some systems do not distinguish large letters from small ones.
        let numbered = (2..).map(|k| format!("{plain}_{k}"));
        std::iter::once(plain.to_owned()).chain(numbered).find(|n| taken.insert(n.to_lowercase())).expect("one is free")
    };
    wanted.iter().map(one).collect()
}

/// Stores the frames of all cameras below `folder`, as `images/NAME/000000.jpg` and so on. What is there already, made
/// of the same and in the same way, is kept; `stop` is called after every few frames.
///
/// Errors: a source that cannot be read, no space; of kind `Interrupted` if `stop` requested it.
pub(crate) fn pictures(
    folder: &Path,
    clips: &[Clip<'_>],
    format: Format,
    progress: &mut Progress<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<Vec<Pictures>> {
    if let Format::Jpeg(quality) = format
        && !(MIN_QUALITY..=100).contains(&quality)
    {
        return Err(Error::input(format!("invalid JPEG quality {quality}"))
            .remedy(format!("Take {MIN_QUALITY} to 100: training learns the blocks of lower ones.")));
    }
    let mut out = Vec::new();
    for (k, clip) in clips.iter().enumerate() {
        progress.phase("frames", k, clips.len());
        out.push(camera(folder, clip, format, stop).map_err(|e| e.at(format!("camera {}", clip.name)))?);
    }
    progress.phase("frames", clips.len(), clips.len());
    Ok(out)
}

/// Pixels of the shorter side for the search for transparent ones in a video.
const LOOKED_AT: usize = 32;

/// Whether any pixel of a clip is transparent: many formats have alpha, and few files use it.
fn is_transparent(clip: &Clip<'_>) -> Result<bool> {
    if !clip.source.info().alpha {
        return Ok(false);
    }
    let mut reader = clip.source.frames(&Selection { size: Some(LOOKED_AT), ..clip.selection.clone() })?;
    let mut frame = Frame::default();
    while reader.next(&mut frame)? {
        if frame.alpha.iter().any(|a| *a < u8::MAX) {
            return Ok(true);
        }
    }
    Ok(false)
}

fn camera(folder: &Path, clip: &Clip<'_>, format: Format, stop: &dyn Fn() -> bool) -> Result<Pictures> {
    let transparent = is_transparent(clip)?;
    // Nothing else holds alpha.
    let format = if transparent { Format::Png } else { format };
    let place = folder.join(IMAGES).join(&clip.name);
    let notes = folder.join(NOTES).join(format!("{}.json", clip.name));
    let made_of = format!("{} {:?} {format:?} {VERSION}", clip.source.fingerprint()?, clip.selection);
    let fingerprint = format!("{:016x}", fnv1a(made_of.as_bytes()));
    let pattern = format!("{IMAGES}/{}/%06d.{}", clip.name, format.ending());
    let known = read(&notes).filter(|n| n.version == VERSION && n.fingerprint == fingerprint);
    let file = |number: usize| place.join(format!("{number:06}.{}", format.ending()));
    if let Some(note) = &known
        && note.complete
        && (0..note.shots.len()).all(|i| file(i).is_file())
    {
        return Ok(note.pictures(clip, pattern));
    }
    if known.is_none() {
        // What was made of something else must not be taken for this.
        clear(folder, &place, read(&notes).is_some())?;
        let begun = Note { version: VERSION, fingerprint: fingerprint.clone(), ..Note::default() };
        begun.write(&notes)?;
    }
    let mut reader = clip.source.frames(&clip.selection)?;
    let mut note = Note { version: VERSION, fingerprint, complete: true, ..Note::default() };
    let mut differences = Vec::new();
    let mut batch: Vec<Frame> = Vec::new();
    let mut last: Option<Frame> = None;
    loop {
        let mut frame = Frame::default();
        let more = reader.next(&mut frame)?;
        if !transparent {
            frame.alpha.clear();
        }
        if more {
            if let Some(last) = &last
                && frame.number == last.number + 1
            {
                differences.push((frame.number, mean_difference(&frame.picture, &last.picture)));
            }
            note.size = [frame.picture.width, frame.picture.height];
            last = Some(frame.clone());
            batch.push(frame);
        }
        if batch.len() == BATCH || !more {
            let first = note.shots.len();
            note.shots.extend(batch.iter().map(|f| Shot { number: f.number, time: f.time }));
            batch.par_iter().enumerate().try_for_each(|(i, frame)| {
                let path = file(first + i);
                // A file under this name is a whole one of the same making.
                if path.is_file() {
                    Ok(())
                } else {
                    write_atomically(&path, &format.encode(&frame.picture, &frame.alpha)?)
                }
            })?;
            batch.clear();
        }
        if !more {
            break;
        }
        if stop() {
            return Err(Error::new(ErrorKind::Interrupted, "stopped while frames were stored")
                .remedy("Run the same command again to continue."));
        }
    }
    let clock = Clock::of(reader.times(), &differences);
    (note.interval, note.variable, note.still) = (clock.interval, clock.variable, clock.still);
    note.dropped = clock.dropped.iter().map(|g| [g.after, g.missing]).collect();
    note.doubled = clock.doubled;
    note.warnings = reader.warnings().to_vec();
    if transparent {
        note.warnings.push("Some of its pixels are transparent: its images are stored as PNG with alpha.".into());
    }
    // Left from a time when more of the same could be read.
    let mut number = note.shots.len();
    while file(number).is_file() {
        remove(&file(number))?;
        number += 1;
    }
    note.write(&notes)?;
    Ok(note.pictures(clip, pattern))
}

impl Note {
    fn write(&self, path: &Path) -> Result<()> {
        let text = serde_json::to_string(self).expect("notes are plain data");
        write_atomically(path, text.as_bytes())
    }

    fn pictures(&self, clip: &Clip<'_>, pattern: String) -> Pictures {
        let clock = Clock {
            interval: self.interval,
            variable: self.variable,
            dropped: self.dropped.iter().map(|&[after, missing]| Gap { after, missing }).collect(),
            doubled: self.doubled.clone(),
            still: self.still,
        };
        Pictures {
            name: clip.name.clone(),
            size: self.size,
            pattern,
            shots: self.shots.clone(),
            clock,
            warnings: self.warnings.clone(),
            fingerprint: self.fingerprint.clone(),
        }
    }
}

/// Notes that can be read; others are as good as none.
fn read(path: &Path) -> Option<Note> {
    serde_json::from_slice(&splat4d_train::files::read(path).ok()?).ok()
}

/// Removes the images that were written into a folder of a capture before. `noted`: whether a note records such images,
/// which captures without a list of their files are read by. Errors: it holds images of such names without a note;
/// nothing is removed then.
fn clear(capture: &Path, folder: &Path, noted: bool) -> Result<()> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Ok(()) };
    let numbered = |path: &PathBuf| {
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        name.split_once('.').is_some_and(|(stem, ending)| {
            stem.len() == 6 && stem.bytes().all(|b| b.is_ascii_digit()) && ["jpg", "png"].contains(&ending)
        })
    };
    let there: Vec<PathBuf> = entries.filter_map(|e| e.ok().map(|e| e.path())).filter(numbered).collect();
    let listed = written(capture);
    // A folder from before lists existed is identified by its note, any other by the list.
    let inside = |file: &PathBuf| folder.strip_prefix(capture).is_ok_and(|own| file.starts_with(own));
    let noted = noted && !listed.iter().any(inside);
    let ours = |path: &PathBuf| noted || path.strip_prefix(capture).is_ok_and(|file| listed.contains(file));
    if let Some(foreign) = there.iter().find(|path| !ours(path)) {
        return Err(Error::input("there is no record that splat4d wrote this image, which would be replaced")
            .at(foreign.display())
            .remedy("Move the folder's images away, or give another folder with -o."));
    }
    there.iter().try_for_each(|path| remove(path))
}

fn remove(path: &Path) -> Result<()> {
    std::fs::remove_file(path).map_err(|e| Error::environment("an old image cannot be removed", e).at(path.display()))
}
