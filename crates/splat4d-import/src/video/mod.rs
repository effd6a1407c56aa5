//! Images with timestamps: videos through the ffmpeg program, folders of images, motion JPEG without any program.
//!
//! A [`Source`] describes its content ([`Info`]) and returns its frames one by one with their timestamps in the file:
//! frame rates vary and frames get lost, so frame numbers are not times. Frames are upright, have square pixels and are
//! in sRGB; one frame is in memory at a time.

mod avi;
mod chapters;
mod clock;
mod crop;
mod ffmpeg;
mod filters;
mod folder;
mod probe;
mod program;
mod soundtrack;

pub(crate) use chapters::{Chapter, open_all};
pub(crate) use clock::mean_difference;
pub use clock::{Clock, Gap};
pub(crate) use crop::without_bars;
pub use crop::{Crop, Cropping};
pub(crate) use ffmpeg::samples;
pub(crate) use folder::ENDINGS as PICTURE_ENDINGS;
pub(crate) use folder::Folder;
pub use probe::{Color, Info, Range, Transfer};
pub use program::Tools;
pub(crate) use soundtrack::encode;
pub use soundtrack::write_sound;
pub use splat4d_train::capture::Rgb8;

use splat4d::{Error, ErrorKind, Result};
use std::path::{Path, PathBuf};

/// Samples per second of what [`Source::sound`] gives: 62 µs a sample, an 18th of what a metre of way makes, and above
/// twice the highest frequency that sound is compared at.
pub(crate) const SOUND_RATE: f64 = 16_000.0;

/// Which frames of a source, and how large.
#[derive(Clone, Debug, PartialEq)]
pub struct Selection {
    /// Every n frames, from the first one on; at least 1.
    pub every: usize,
    /// No frame before this second of the source's clock.
    pub from: Option<f64>,
    /// No frame at or after this second.
    pub to: Option<f64>,
    /// Pixels of the shorter side; smaller images are kept.
    pub size: Option<usize>,
    /// Whether interlaced videos are taken, and their lines filled in.
    pub deinterlace: bool,
    /// The part of images that is kept, before they are scaled.
    pub crop: Option<Crop>,
}

impl Default for Selection {
    fn default() -> Self {
        Self { every: 1, from: None, to: None, size: None, deinterlace: false, crop: None }
    }
}

impl Selection {
    /// An error unless the numbers make sense.
    pub(crate) fn check(&self) -> Result<()> {
        let bad = |what: String, remedy: &str| Err(Error::input(what).remedy(remedy));
        if self.every == 0 {
            return bad("every 0th frame was requested".into(), "Take every frame (1), every second (2) and so on.");
        }
        if self.size.is_some_and(|s| s < MIN_SIDE) {
            return bad(format!("images of less than {MIN_SIDE} pixels are requested"), "Take 1080, for example.");
        }
        for second in [self.from, self.to].into_iter().flatten() {
            if !second.is_finite() || second < 0.0 {
                return bad(
                    format!("invalid second of a video: {second}"),
                    "Give seconds from its beginning, 3.2 or so.",
                );
            }
        }
        if let (Some(from), Some(to)) = (self.from, self.to)
            && from >= to
        {
            return bad(format!("the part from {from} s to {to} s is empty"), "Give an end after the beginning.");
        }
        Ok(())
    }

    /// The same for a source.
    pub(crate) fn check_for(&self, info: &Info) -> Result<()> {
        self.check()?;
        self.crop.map_or(Ok(()), |crop| crop.check(info.size))
    }

    /// The size that images of `size` get: cropped, their shorter side as requested.
    pub(crate) fn scaled(&self, size: [usize; 2]) -> [usize; 2] {
        let [width, height] = self.crop.map_or(size, |c| [c.width, c.height]);
        match self.size {
            Some(side) if side < width.min(height) => {
                let scale = side as f64 / width.min(height) as f64;
                [width, height].map(|s| (s as f64 * scale).round() as usize)
            }
            _ => [width, height],
        }
    }

    /// [`EXAMINED`] frames or a few more, evenly over the chosen part.
    pub(crate) fn spread(&self, info: &Info) -> Self {
        let rate = info.average_rate.or(info.nominal_rate).unwrap_or(GUESSED[0]);
        let span = self.to.or(info.duration).unwrap_or(GUESSED[1]) - self.from.unwrap_or(0.0);
        Self { every: ((span * rate) as usize / EXAMINED).max(1), ..self.clone() }
    }

    /// Whether a time is in the chosen part.
    fn holds(&self, time: f64) -> bool {
        self.from.is_none_or(|from| time >= from) && self.to.is_none_or(|to| time < to)
    }
}

/// Frames in which black bars, and motion of the camera, are searched for.
pub(crate) const EXAMINED: usize = 12;
/// Frames per second and seconds where a file states none.
const GUESSED: [f64; 2] = [30.0, 10.0];
/// Shorter side of the smallest images that anything can be made of.
const MIN_SIDE: usize = 16;

/// An image and when it was taken.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Frame {
    /// Its number among the frames that were passed, chosen or not; an index into [`Reader::times`].
    pub number: usize,
    /// Seconds on the source's clock.
    pub time: f64,
    /// Its pixels.
    pub picture: Rgb8,
    /// How opaque each of them is, 0 to 255; empty: all are.
    pub alpha: Vec<u8>,
}

/// Frames in the order of time, one in memory at a time.
pub trait Reader {
    /// The next chosen frame, in place of the last one; false at the end.
    ///
    /// Errors: nothing can be decoded at all, an image is damaged or of another size. What can be decoded in part ends
    /// early, and a warning states so.
    fn next(&mut self, frame: &mut Frame) -> Result<bool>;

    /// Times of all frames read, chosen or not, seconds, ascending.
    fn times(&self) -> &[f64];

    /// Remarks on the input, a sentence or two each.
    fn warnings(&self) -> &[String];
}

/// Source of images.
pub trait Source: Send + Sync {
    /// Its kind.
    fn info(&self) -> &Info;

    /// Its frames. Errors: nonsense in the selection, interlaced, a program that cannot be started.
    fn frames(&self, selection: &Selection) -> Result<Box<dyn Reader + '_>>;

    /// Its sound as one channel at `SOUND_RATE`; the first sample at second 0 of the clock that frames have. None where
    /// there is none.
    fn sound(&self) -> Result<Option<Vec<f32>>>;

    /// Where its sound is: files one after the other from second 0 of its clock on, each with the number of the stream
    /// (none: it is silent) and its length, seconds. Empty where there is none.
    fn sounds(&self) -> Vec<(PathBuf, Option<usize>, f64)> {
        Vec::new()
    }

    /// Fingerprint of the content: 16 hexadecimal digits.
    fn fingerprint(&self) -> Result<String>;
}

/// Opens a video file or a folder of images. Images of folders are `1/fps` seconds apart.
///
/// Errors: no such file; no ffmpeg, and no format that is read without it; no image stream; damage.
pub fn open(path: &Path, fps: f64) -> Result<Box<dyn Source>> {
    open_with(path, fps, Tools::find())
}

/// [`open`] with certain programs, or with the error of not having them.
pub fn open_with(path: &Path, fps: f64, tools: Result<Tools>) -> Result<Box<dyn Source>> {
    let kind = std::fs::metadata(path).map_err(|e| {
        Error::io("cannot be read", e).at(path.display()).remedy("Check that the file exists and may be read by you.")
    })?;
    if kind.is_dir() {
        return Ok(Box::new(Folder::open(path, fps)?));
    }
    if kind.len() == 0 {
        return Err(Error::input("the file is empty").at(path.display()).remedy("Copy it again from the camera."));
    }
    match tools {
        Ok(tools) => Ok(Box::new(ffmpeg::Video::open(path, tools)?)),
        // Without the program, what is simple enough; its absence is reported where the file is not.
        Err(missing) => match avi::Avi::open(path) {
            Ok(avi) => Ok(Box::new(avi)),
            Err(e) if e.kind() == ErrorKind::Unsupported => Err(missing.at(path.display())),
            Err(e) => Err(e),
        },
    }
}

/// A name for a camera that films this: the file's or folder's, without its ending.
fn stem(path: &Path) -> String {
    let whole = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let name = if whole.is_dir() { whole.file_name() } else { whole.file_stem() };
    name.map_or_else(|| "camera".into(), |n| n.to_string_lossy().into_owned())
}

/// Distinguishes two files: FNV-1a of length, beginning, middle and end, against mistakes and not against malice.
fn fingerprint_of_file(path: &Path) -> Result<u64> {
    use std::io::{Read, Seek, SeekFrom};
    /// Bytes of each of the three positions: a video's tables and some of its images.
    const PIECE: u64 = 64 << 10;
    let fail = |e| Error::io("cannot be read", e).at(path.display());
    let mut file = splat4d_train::files::open(path)?;
    let length = file.metadata().map_err(fail)?.len();
    let mut bytes = length.to_le_bytes().to_vec();
    for at in [0, (length / 2).saturating_sub(PIECE / 2), length.saturating_sub(PIECE)] {
        file.seek(SeekFrom::Start(at)).map_err(fail)?;
        file.by_ref().take(PIECE).read_to_end(&mut bytes).map_err(fail)?;
    }
    Ok(fnv1a(&bytes))
}

/// FNV-1a with 64 bits (Fowler, Noll, Vo).
pub(crate) fn fnv1a(bytes: &[u8]) -> u64 {
    const OFFSET: u64 = 0xcbf2_9ce4_8422_2325;
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    bytes.iter().fold(OFFSET, |h, b| (h ^ u64::from(*b)).wrapping_mul(PRIME))
}

#[cfg(test)]
mod tests;
