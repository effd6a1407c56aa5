//! Motion JPEG in AVI without any program: what some sports cameras and most frame grabbers write. Each frame is a
//! JPEG; the rest of the file is a list.

use super::folder::scaled;
use super::{Color, Frame, Info, Range, Reader, Rgb8, Selection, Source, Transfer, fingerprint_of_file, fnv1a, stem};
use splat4d::{Error, ErrorKind, Result};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Largest JPEG that is believed, bytes.
const MAX_FRAME: u32 = 64 << 20;
/// Largest header that is believed, bytes.
const MAX_HEADER: u32 = 1 << 20;
/// Lists in lists that are believed; real files have three.
const MAX_DEPTH: usize = 8;

/// An AVI file of JPEGs.
#[derive(Debug)]
pub(super) struct Avi {
    path: PathBuf,
    info: Info,
    /// Position and length of each frame; a length of 0 repeats the frame before.
    frames: Vec<(u64, u32)>,
    /// Seconds a frame.
    interval: f64,
}

/// Result of reading the file's structure.
#[derive(Default)]
struct AviContents {
    /// Kind and codec of each stream, and seconds a sample.
    streams: Vec<([u8; 4], [u8; 4], f64)>,
    frames: Vec<(u64, u32)>,
    /// Whether the file ends in the middle of something.
    cut: bool,
}

impl Avi {
    /// Walks through the file. Errors: of kind `Unsupported` where it is something else; damage.
    pub(super) fn open(path: &Path) -> Result<Self> {
        let fail = |e| Error::io("cannot be read", e).at(path.display());
        let other =
            || Error::new(ErrorKind::Unsupported, "only motion JPEG in AVI is read without ffmpeg").at(path.display());
        let mut file = BufReader::new(splat4d_train::files::open(path)?);
        let end = file.get_ref().metadata().map_err(fail)?.len();
        let mut head = [0; 12];
        if end < 12 {
            return Err(other());
        }
        file.read_exact(&mut head).map_err(fail)?;
        if &head[..4] != b"RIFF" || &head[8..] != b"AVI " {
            return Err(other());
        }
        let mut found = AviContents::default();
        // Long files are several RIFF lists in a row (OpenDML).
        let mut at = 0;
        while at + 12 <= end {
            at = list(&mut file, at, end, &mut found, 0).map_err(fail)?;
        }
        let film = found.streams.iter().find(|s| &s.0 == b"vids");
        let Some((_, codec, interval)) = film.copied() else { return Err(other()) };
        if !(codec.eq_ignore_ascii_case(b"MJPG") && interval.is_finite() && interval > 0.0) {
            return Err(other());
        }
        let mut warnings = Vec::new();
        if found.cut {
            warnings.push(format!("Its file is truncated; there are {} frames.", found.frames.len()));
        }
        let first = found.frames.iter().position(|f| f.1 > 0);
        let Some(first) = first else {
            return Err(Error::input("there is no frame in it")
                .at(path.display())
                .remedy("Copy it again from the camera."));
        };
        found.frames.drain(..first);
        let mut avi =
            Self { path: path.to_owned(), info: info(path, interval, warnings), frames: found.frames, interval };
        let picture = avi.decode(0)?;
        avi.info.size = [picture.width, picture.height];
        avi.info.stored = avi.info.size;
        avi.info.frames = Some(avi.frames.len());
        avi.info.duration = Some(avi.frames.len() as f64 * interval);
        Ok(avi)
    }

    fn decode(&self, number: usize) -> Result<Rgb8> {
        let (at, length) = self.frames[number];
        let fail = |e| Error::io("cannot be read", e).at(self.path.display());
        let mut bytes = vec![0; length as usize];
        let mut file = File::open(&self.path).map_err(fail)?;
        file.seek(SeekFrom::Start(at)).map_err(fail)?;
        file.read_exact(&mut bytes).map_err(fail)?;
        Rgb8::decode(&bytes, &self.path).map_err(|e| e.at(format!("frame {number}")))
    }
}

fn info(path: &Path, interval: f64, warnings: Vec<String>) -> Info {
    Info {
        name: stem(path),
        size: [0; 2],
        stored: [0; 2],
        rotation: 0,
        nominal_rate: Some(1.0 / interval),
        average_rate: Some(1.0 / interval),
        time_base: Some(interval),
        duration: None,
        frames: None,
        codec: "mjpeg".into(),
        pixels: "yuvj420p".into(),
        interlaced: false,
        color: Color { matrix: Some("bt601"), tagged: true, range: Range::Full, transfer: Transfer::Standard },
        sound: false,
        alpha: false,
        warnings,
    }
}

/// Reads the list at a position; returns the position after it.
fn list(file: &mut BufReader<File>, at: u64, end: u64, found: &mut AviContents, depth: usize) -> std::io::Result<u64> {
    file.seek(SeekFrom::Start(at))?;
    let mut head = [0; 12];
    file.read_exact(&mut head)?;
    let size = u64::from(u32::from_le_bytes([head[4], head[5], head[6], head[7]]));
    let stop = (at + 8 + size).min(end);
    found.cut |= at + 8 + size > end;
    let mut place = at + 12;
    while place + 8 <= stop {
        file.seek(SeekFrom::Start(place))?;
        let mut chunk = [0; 8];
        file.read_exact(&mut chunk)?;
        let length = u32::from_le_bytes([chunk[4], chunk[5], chunk[6], chunk[7]]);
        if &chunk[..4] == b"LIST" && depth < MAX_DEPTH && place + 12 <= stop {
            place = list(file, place, stop, found, depth + 1)?;
            continue;
        }
        let whole = place + 8 + u64::from(length) <= stop;
        found.cut |= !whole;
        match &chunk[..4] {
            b"strh" if whole && (36..MAX_HEADER).contains(&length) => {
                let mut header = vec![0; 36];
                file.read_exact(&mut header)?;
                let word = |i: usize| u32::from_le_bytes([header[i], header[i + 1], header[i + 2], header[i + 3]]);
                let four = |i: usize| [header[i], header[i + 1], header[i + 2], header[i + 3]];
                // dwScale / dwRate: seconds a sample.
                found.streams.push((four(0), four(4), f64::from(word(20)) / f64::from(word(24))));
            }
            // "00dc" is compressed video of stream 0.
            [a, b, b'd', b'c' | b'b'] if whole && length <= MAX_FRAME => {
                let stream = found.streams.iter().position(|s| &s.0 == b"vids");
                let told = [a, b].iter().all(|d| d.is_ascii_digit()).then(|| usize::from((a - b'0') * 10 + (b - b'0')));
                if told.is_some() && told == stream {
                    found.frames.push((place + 8, length));
                }
            }
            _ => {}
        }
        // Chunks begin at even positions.
        place += 8 + u64::from(length) + u64::from(length % 2);
    }
    Ok((at + 8 + size + size % 2).max(at + 12))
}

impl Source for Avi {
    fn info(&self) -> &Info {
        &self.info
    }

    fn frames(&self, selection: &Selection) -> Result<Box<dyn Reader + '_>> {
        selection.check_for(self.info())?;
        let times = (0..self.frames.len()).map(|i| i as f64 * self.interval).collect();
        Ok(Box::new(Pictures { avi: self, selection: selection.clone(), next: 0, counted: 0, times }))
    }

    /// None: without ffmpeg, sound is not read.
    fn sound(&self) -> Result<Option<Vec<f32>>> {
        Ok(None)
    }

    fn fingerprint(&self) -> Result<String> {
        Ok(format!("{:016x}", fnv1a(&fingerprint_of_file(&self.path)?.to_le_bytes())))
    }
}

struct Pictures<'a> {
    avi: &'a Avi,
    selection: Selection,
    next: usize,
    counted: usize,
    times: Vec<f64>,
}

impl Reader for Pictures<'_> {
    fn next(&mut self, frame: &mut Frame) -> Result<bool> {
        while self.next < self.avi.frames.len() {
            let number = self.next;
            self.next += 1;
            if !self.selection.holds(self.times[number]) {
                continue;
            }
            self.counted += 1;
            if !(self.counted - 1).is_multiple_of(self.selection.every) {
                continue;
            }
            // An empty frame shows the one before again; the first one is never empty.
            let shown = (0..=number).rev().find(|&i| self.avi.frames[i].1 > 0).expect("the first frame is not empty");
            let picture = scaled(self.avi.decode(shown)?, &self.selection);
            *frame = Frame { number, time: self.times[number], picture, alpha: Vec::new() };
            return Ok(true);
        }
        if self.counted == 0 {
            let what = "the chosen part contains no frame";
            return Err(Error::input(what).at(self.avi.path.display()).remedy("Choose another part."));
        }
        Ok(false)
    }

    fn times(&self) -> &[f64] {
        &self.times[..self.next]
    }

    fn warnings(&self) -> &[String] {
        &self.avi.info.warnings
    }
}

#[cfg(test)]
mod tests {
    use super::super::open_with;
    use super::*;

    fn chunk(name: &[u8; 4], body: &[u8]) -> Vec<u8> {
        let mut out = [name.as_slice(), &(body.len() as u32).to_le_bytes(), body].concat();
        out.resize(out.len().next_multiple_of(2), 0);
        out
    }

    /// An AVI of flat images at 25 frames per second; `None` repeats.
    fn film(shades: &[Option<u8>]) -> Vec<u8> {
        let mut header = vec![0; 56];
        header[..8].copy_from_slice(b"vidsMJPG");
        header[20..24].copy_from_slice(&1u32.to_le_bytes());
        header[24..28].copy_from_slice(&25u32.to_le_bytes());
        let stream = chunk(b"LIST", &[b"strl".to_vec(), chunk(b"strh", &header)].concat());
        let headers = chunk(b"LIST", &[b"hdrl".to_vec(), stream].concat());
        let mut frames = b"movi".to_vec();
        for shade in shades {
            let jpeg = shade.map_or(Vec::new(), |shade| {
                let mut bytes = Vec::new();
                let picture = image::RgbImage::from_pixel(24, 16, image::Rgb([shade; 3]));
                image::codecs::jpeg::JpegEncoder::new(&mut bytes).encode_image(&picture).unwrap();
                bytes
            });
            frames.extend(chunk(b"00dc", &jpeg));
            frames.extend(chunk(b"01wb", &[0; 5]));
        }
        chunk(b"RIFF", &[b"AVI ".to_vec(), headers, chunk(b"LIST", &frames)].concat())
    }

    fn open(bytes: &[u8]) -> Result<Box<dyn Source>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.avi");
        std::fs::write(&path, bytes).unwrap();
        let opened = open_with(&path, 30.0, Err(Error::input("there is no ffmpeg")))?;
        // Frames are read when they are requested.
        std::mem::forget(folder);
        Ok(opened)
    }

    fn read(source: &dyn Source) -> Vec<(usize, f64, u8)> {
        let mut frames = source.frames(&Selection::default()).unwrap();
        let (mut frame, mut seen) = (Frame::default(), Vec::new());
        while frames.next(&mut frame).unwrap() {
            seen.push((frame.number, frame.time, frame.picture.data[0]));
        }
        seen
    }

    #[test]
    fn motion_jpeg_needs_no_program() {
        let source = open(&film(&[Some(10), Some(90), None, Some(200)])).unwrap();
        assert_eq!((source.info().size, source.info().frames), ([24, 16], Some(4)));
        assert_eq!(read(&*source), [(0, 0.0, 10), (1, 0.04, 90), (2, 0.08, 90), (3, 0.12, 200)]);
    }

    #[test]
    fn truncation_is_reported_and_the_rest_is_read() {
        let whole = film(&[Some(10), Some(90), Some(200)]);
        let source = open(&whole[..whole.len() - 40]).unwrap();
        assert_eq!(read(&*source).len(), 2);
        assert!(source.info().warnings[0].contains("2 frames"));
        // Whatever is damaged, nothing panics.
        for length in (0..whole.len()).step_by(17) {
            let mut bytes = whole.clone();
            bytes[length] ^= 0xFF;
            let _ = open(&bytes).map(|s| s.frames(&Selection::default()).map(|mut f| f.next(&mut Frame::default())));
            let _ = open(&whole[..length]);
        }
    }

    #[test]
    fn other_formats_require_ffmpeg() {
        for bytes in [&b"RIFFxxxxWAVE"[..], b"\0\0\0\x18ftypmp42 and so on"] {
            let error = open(bytes).err().unwrap().to_string();
            assert!(error.contains("no ffmpeg") && error.contains("film.avi"), "{error}");
        }
        assert!(open(b"").err().unwrap().to_string().contains("empty"));
    }
}
