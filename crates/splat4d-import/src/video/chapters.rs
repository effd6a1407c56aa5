//! Recordings that a camera cuts into several files: GoPro's chapters (`GX010012.MP4`, `GX020012.MP4` …) as one source.
//!
//! Source: GoPro, "Camera File Naming Convention" (HERO6 and later: `GX` HEVC or `GH` AVC, two digits of the chapter,
//! four of the recording; before: `GOPR` and the recording, then `GP`, chapter, recording; `GL` is the small copy of a
//! chapter).

use super::{Frame, Info, Reader, SOUND_RATE, Selection, Source, fnv1a, open};
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

/// A part of this many frame intervals at a chapter's end is not searched for: rounding decides whether a frame is in
/// it.
const END_FRAMES: f64 = 2.0;

/// Which part of which recording a file is, by its name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Chapter {
    /// Common part of the chapters' names: `GX0012`.
    pub recording: String,
    /// The chapter, from 1 on.
    pub number: u32,
    /// Whether it is a small copy of a chapter.
    pub copy: bool,
}

impl Chapter {
    /// `None`: the name is not GoPro's.
    pub(crate) fn of(path: &Path) -> Option<Self> {
        let stem = path.file_stem()?.to_str()?.to_ascii_uppercase();
        let (prefix, digits) = stem.split_at_checked(stem.find(|c: char| c.is_ascii_digit())?)?;
        if !digits.bytes().all(|b| b.is_ascii_digit()) {
            return None;
        }
        let number = |text: &str| text.parse().ok();
        let (recording, number, copy) = match (prefix, digits.len()) {
            ("GX" | "GH" | "GL", 6) => (format!("{prefix}{}", &digits[2..]), number(&digits[..2])?, prefix == "GL"),
            ("GOPR", 4) => (format!("GP{digits}"), 1, false),
            // The first file has no chapter in its name, and the second one is 01.
            ("GP", 6) => (format!("GP{}", &digits[2..]), number(&digits[..2])? + 1, false),
            _ => return None,
        };
        Some(Self { recording, number, copy })
    }
}

/// Opens one file or folder, or the chapters of one recording in their order. Errors: those of [`open`]; chapters of
/// different sizes.
pub(crate) fn open_all(paths: &[PathBuf], fps: f64) -> Result<Box<dyn Source>> {
    if let [path] = paths {
        return open(path, fps);
    }
    let parts = paths.iter().map(|p| open(p, fps)).collect::<Result<Vec<_>>>()?;
    let missing = missing(paths);
    let mut joined = Joined::of(parts).map_err(|e| match paths.first() {
        Some(first) => e.at(first.display()),
        None => e,
    })?;
    if let Some(recording) = paths.first().and_then(|p| Chapter::of(p)).map(|c| c.recording) {
        joined.info.name = recording;
    }
    joined.info.warnings.extend(missing);
    Ok(Box::new(joined))
}

/// A sentence where numbers of chapters are not those from 1 on.
fn missing(paths: &[PathBuf]) -> Option<String> {
    let numbers: Vec<u32> = paths.iter().filter_map(|p| Chapter::of(p)).map(|c| c.number).collect();
    let gap = numbers.iter().enumerate().find(|(i, n)| **n as usize != i + 1)?;
    Some(format!(
        "Chapter {} of its recording is not there: the chapters that are there are joined without a gap.",
        gap.0 + 1
    ))
}

/// Sources one after the other.
struct Joined {
    parts: Vec<Box<dyn Source>>,
    /// The second at which each part begins.
    starts: Vec<f64>,
    info: Info,
}

impl Joined {
    fn of(parts: Vec<Box<dyn Source>>) -> Result<Self> {
        let Some(first) = parts.first() else { return Err(Error::input("there are no chapters")) };
        let mut info = first.info().clone();
        let (mut starts, mut end) = (Vec::new(), 0.0);
        info.frames = Some(0);
        for part in &parts {
            let own = part.info();
            if own.size != info.size {
                let what =
                    format!("its chapters are {}x{} and {}x{}", info.size[0], info.size[1], own.size[0], own.size[1]);
                return Err(Error::input(what).remedy("Give each of them as a recording of its own."));
            }
            starts.push(end);
            end += own.duration.ok_or_else(|| {
                Error::input("a chapter does not state its duration").remedy("Join the chapters with ffmpeg first.")
            })?;
            info.frames = info.frames.zip(own.frames).map(|(a, b)| a + b);
            info.sound |= own.sound;
            info.alpha |= own.alpha;
            info.warnings.extend(own.warnings.iter().filter(|w| !first.info().warnings.contains(w)).cloned());
        }
        info.duration = Some(end);
        Ok(Self { parts, starts, info })
    }

    fn interval(&self) -> f64 {
        self.info.average_rate.or(self.info.nominal_rate).map_or(0.0, |r| 1.0 / r)
    }

    /// The part of chapter `i` that a selection needs: on the part's clock, every frame; none: nothing.
    fn wanted(&self, i: usize, selection: &Selection) -> Option<Selection> {
        let start = self.starts[i];
        let end = self.starts.get(i + 1).copied().or(self.info.duration).unwrap_or(f64::INFINITY);
        let after =
            selection.from.is_some_and(|from| from > end - END_FRAMES * self.interval() && i + 1 < self.parts.len());
        let before = selection.to.is_some_and(|to| to <= start);
        (!after && !before).then(|| Selection {
            every: 1,
            from: selection.from.map(|from| from - start).filter(|from| *from > 0.0),
            // A part's last frames may be behind its end by rounding.
            to: selection.to.filter(|to| *to < end).map(|to| to - start),
            ..selection.clone()
        })
    }
}

impl Source for Joined {
    fn info(&self) -> &Info {
        &self.info
    }

    fn frames(&self, selection: &Selection) -> Result<Box<dyn Reader + '_>> {
        selection.check_for(self.info())?;
        let selection = selection.clone();
        let (times, warnings) = (Vec::new(), self.info.warnings.clone());
        Ok(Box::new(Pages { of: self, selection, next: 0, open: None, times, counted: 0, warnings }))
    }

    fn sound(&self) -> Result<Option<Vec<f32>>> {
        let mut out = Vec::new();
        for (i, part) in self.parts.iter().enumerate() {
            out.extend(part.sound()?.unwrap_or_default());
            // Silence where a part has none, so that the next one begins in its time.
            let end = self.starts.get(i + 1).copied().or(self.info.duration).unwrap_or(0.0);
            out.resize((end * SOUND_RATE).round() as usize, 0.0);
        }
        Ok(self.info.sound.then_some(out))
    }

    fn sounds(&self) -> Vec<(PathBuf, Option<usize>, f64)> {
        let end = |i: usize| self.starts.get(i + 1).copied().or(self.info.duration).unwrap_or(0.0);
        let silence = (PathBuf::new(), None, 0.0);
        if !self.info.sound {
            return Vec::new();
        }
        let parts = self.parts.iter().enumerate().map(|(i, part)| {
            let (path, stream, _) = part.sounds().pop().unwrap_or(silence.clone());
            (path, stream, end(i) - self.starts[i])
        });
        parts.collect()
    }

    fn fingerprint(&self) -> Result<String> {
        let prints = self.parts.iter().map(|p| p.fingerprint()).collect::<Result<Vec<_>>>()?;
        Ok(format!("{:016x}", fnv1a(prints.concat().as_bytes())))
    }
}

/// The frames of all parts.
struct Pages<'a> {
    of: &'a Joined,
    selection: Selection,
    /// The part that is opened next.
    next: usize,
    open: Option<Open<'a>>,
    times: Vec<f64>,
    /// Frames read of the chosen part.
    counted: usize,
    warnings: Vec<String>,
}

/// The part that is read.
struct Open<'a> {
    reader: Box<dyn Reader + 'a>,
    start: f64,
    /// Frames before it, and of it that are noted.
    before: usize,
    noted: usize,
}

impl Reader for Pages<'_> {
    fn next(&mut self, frame: &mut Frame) -> Result<bool> {
        loop {
            let Some(open) = &mut self.open else {
                let Some(part) = self.of.parts.get(self.next) else { return Ok(false) };
                let (i, start, before) = (self.next, self.of.starts[self.next], self.times.len());
                self.next += 1;
                if let Some(wanted) = self.of.wanted(i, &self.selection) {
                    self.open = Some(Open { reader: part.frames(&wanted)?, start, before, noted: 0 });
                }
                continue;
            };
            let more = open.reader.next(frame)?;
            let fresh = &open.reader.times()[open.noted..];
            self.times.extend(fresh.iter().map(|t| t + open.start));
            open.noted += fresh.len();
            if !more {
                let said =
                    open.reader.warnings().iter().filter(|w| !self.warnings.contains(w)).cloned().collect::<Vec<_>>();
                self.warnings.extend(said);
                self.open = None;
                continue;
            }
            frame.time += open.start;
            frame.number += open.before;
            self.counted += 1;
            if (self.counted - 1).is_multiple_of(self.selection.every) {
                return Ok(true);
            }
        }
    }

    fn times(&self) -> &[f64] {
        &self.times
    }

    fn warnings(&self) -> &[String] {
        &self.warnings
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gopro_chapter_names_are_recognised() {
        let of = |name: &str| Chapter::of(Path::new(name)).map(|c| (c.recording, c.number, c.copy));
        assert_eq!(of("a/GX020012.MP4"), Some(("GX0012".into(), 2, false)));
        assert_eq!(of("gh010345.mp4"), Some(("GH0345".into(), 1, false)));
        assert_eq!(
            (of("GOPR0007.MP4"), of("GP010007.MP4")),
            (Some(("GP0007".into(), 1, false)), Some(("GP0007".into(), 2, false)))
        );
        assert_eq!(of("GL020012.LRV"), Some(("GL0012".into(), 2, true)));
        for name in ["IMG_0012.MP4", "GX01001.MP4", "GX010012_cut.mp4", "GOPR00123.MP4", "cam01.mp4", "GX.MP4"] {
            assert_eq!(of(name), None, "{name}");
        }
        let paths = |names: &[&str]| names.iter().map(PathBuf::from).collect::<Vec<_>>();
        assert_eq!(missing(&paths(&["GX010012.MP4", "GX020012.MP4"])), None);
        assert!(missing(&paths(&["GX010012.MP4", "GX030012.MP4"])).unwrap().contains("Chapter 2"));
    }

    /// Folders of images represent chapters.
    #[test]
    fn chapters_share_one_clock() {
        let dir = tempfile::tempdir().unwrap();
        let paths: Vec<PathBuf> = (0..2).map(|k| dir.path().join(format!("part{k}"))).collect();
        for (k, path) in paths.iter().enumerate() {
            std::fs::create_dir(path).unwrap();
            for i in 0..5u8 {
                let grey = image::Luma([(50 * k) as u8 + 10 * i]);
                image::ImageBuffer::from_pixel(20, 16, grey).save(path.join(format!("{i}.png"))).unwrap();
            }
        }
        let source = open_all(&paths, 10.0).unwrap();
        assert_eq!((source.info().frames, source.info().duration.map(|d| (d * 1e6).round())), (Some(10), Some(1e6)));
        let read = |selection: Selection| {
            let mut reader = source.frames(&selection).unwrap();
            let (mut frame, mut out) = (Frame::default(), Vec::new());
            while reader.next(&mut frame).unwrap() {
                out.push((frame.number, (frame.time * 1e3).round() as u32, frame.picture.data[0]));
            }
            (out, reader.times().len())
        };
        let (all, times) = read(Selection::default());
        assert_eq!((all.len(), times, all[7]), (10, 10, (7, 700, 70)));
        let (third, _) = read(Selection { every: 3, ..Selection::default() });
        assert_eq!(third.iter().map(|f| f.2).collect::<Vec<_>>(), [0, 30, 60, 90], "counted through all chapters");
        let (late, _) = read(Selection { from: Some(0.55), to: Some(0.85), ..Selection::default() });
        assert_eq!(late.iter().map(|f| f.1).collect::<Vec<_>>(), [600, 700, 800]);
    }
}
