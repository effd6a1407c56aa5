//! Records: header, steps, windows and chunks with their streams.

use super::streams::{self, Stream};
use super::{CHUNK, FOOTER, HEADER, MAGIC, MODEL, QUANTIZATION, SCHEME, SH_BAND, WINDOWS, damaged};
use crate::format::bytes::Cursor;
use crate::format::inflate::{zlib, zstd};
use crate::format::warnings::Warnings;
use crate::{Error, ErrorKind, Result};
use std::collections::BTreeMap;

/// Most Gaussians that are believed in any case; beyond them one in this many bytes of the file. (Constant streams take none.)
const ALWAYS: usize = 1 << 16;
const BYTES: usize = 8;
/// Longest block of a chunk that is unpacked: bytes, and times its packed bytes.
const MOST_SMALL: usize = 1 << 20;
const MOST_RATIO: usize = 64;
/// Bytes of a window.
const WINDOW: usize = 16;
/// Records that are not read, by code, and what they hold.
const UNREAD: [(u8, u8, &str); 3] =
    [(0x09, 0x09, "sound"), (0x11, 0x12, "sound"), (0x25, 0x25, "rigid motions of objects")];

/// Content of the header.
#[derive(Debug, Default)]
pub(super) struct Header {
    pub(super) seconds: f64,
    pub(super) cutoff: f64,
    pub(super) degree: usize,
    pub(super) attributes: BTreeMap<String, String>,
}

/// Steps of the bins.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Steps {
    pub(super) origin: [f64; 3],
    pub(super) position: f64,
    pub(super) log_scale: f64,
    pub(super) rotation: f64,
    pub(super) color: f64,
    pub(super) opacity: f64,
    pub(super) motion: f64,
    pub(super) time: f64,
    pub(super) log_sigma: f64,
}

/// Gaussians of a time span.
pub(super) struct Chunk {
    pub(super) rows: usize,
    /// By attribute.
    pub(super) streams: BTreeMap<u8, Stream>,
    /// By band, from 1.
    pub(super) bands: BTreeMap<u8, Stream>,
}

/// A file.
pub(super) struct File {
    pub(super) header: Header,
    pub(super) steps: Steps,
    pub(super) windows: Vec<[f64; 2]>,
    pub(super) chunks: Vec<Chunk>,
}

fn f64_of(c: &mut Cursor<'_>) -> Result<f64> {
    c.u64().map(f64::from_bits)
}

fn text(c: &mut Cursor<'_>) -> Result<String> {
    let length = c.u32()? as usize;
    Ok(String::from_utf8_lossy(c.take(length)?).into_owned())
}

fn map(c: &mut Cursor<'_>) -> Result<BTreeMap<String, String>> {
    let length = c.u32()? as usize;
    let block = c.take(length)?;
    let (mut inner, mut out) = (Cursor::new(block, "map of .4dgs"), BTreeMap::new());
    while let Ok(key) = text(&mut inner) {
        out.insert(key, text(&mut inner)?);
    }
    Ok(out)
}

fn unsupported(what: String, remedy: &str) -> Error {
    Error::new(ErrorKind::Unsupported, what).remedy(remedy)
}

/// Reads all records from the first one to the footer.
pub(super) fn read(bytes: &[u8], warnings: &mut Warnings) -> Result<File> {
    if !bytes.starts_with(&MAGIC) {
        let what = format!("version {:?} of .4dgs", bytes.get(5).map(|b| char::from(*b)).unwrap_or('?'));
        return Err(unsupported(what, "Write it again as version 1 with the fourdgs libraries."));
    }
    let mut c = Cursor::new(&bytes[MAGIC.len()..], ".4dgs file");
    let (mut header, mut steps, mut windows) = (None, None, None);
    let mut chunks: Vec<Chunk> = Vec::new();
    let most = ALWAYS + bytes.len() / BYTES;
    let mut total = 0;
    loop {
        let (code, length) = (c.u8()?, usize::try_from(c.u64()?).map_err(|_| damaged("a record is longer than it"))?);
        let content = c.take(length)?;
        let mut inner = Cursor::new(content, "record of .4dgs");
        match code {
            FOOTER => break,
            HEADER => once(&mut header, header_of(&mut inner)?, "header")?,
            QUANTIZATION => once(&mut steps, steps_of(&mut inner)?, "quantization")?,
            WINDOWS => once(&mut windows, windows_of(&mut inner)?, "window table")?,
            CHUNK => {
                let chunk = chunk_of(&mut inner, most - total)?;
                total += chunk.rows;
                chunks.push(chunk);
            }
            SH_BAND => {
                let chunk = chunks.last_mut().ok_or_else(|| damaged("colours stand before Gaussians"))?;
                let band = inner.u8()?;
                let channels = 3 * (2 * usize::from(band.min(3)) + 1);
                chunk.bands.insert(band, streams::read(&mut inner, chunk.rows, |_| Some(channels))?);
            }
            _ => {
                if let Some((.., what)) = UNREAD.iter().find(|(from, to, _)| (*from..=*to).contains(&code)) {
                    let said = format!("{what} (record 0x{code:02X}) is not read");
                    warnings.drop(&said);
                    warnings.add(said);
                }
            }
        }
    }
    Ok(File {
        header: header.ok_or_else(|| damaged("it has no header"))?,
        steps: steps.ok_or_else(|| damaged("it has no steps (record 0x03)"))?,
        windows: windows.filter(|w: &Vec<_>| !w.is_empty()).unwrap_or_else(|| vec![[0.0; 2]]),
        chunks,
    })
}

fn once<T>(place: &mut Option<T>, value: T, what: &str) -> Result<()> {
    if place.replace(value).is_some() {
        return Err(damaged(format!("it has two records `{what}`")));
    }
    Ok(())
}

fn header_of(c: &mut Cursor<'_>) -> Result<Header> {
    let _profile_and_library = [text(c)?, text(c)?];
    let (seconds, _count, cutoff) = (f64_of(c)?, c.u64()?, f64_of(c)?);
    let model = text(c)?;
    if model != MODEL {
        let what = format!("a .4dgs with the temporal model `{}`", crate::text::in_line(&model));
        return Err(unsupported(
            what,
            "Files of the model `gaussian-birth` are read. Convert it with the fourdgs libraries.",
        ));
    }
    for _ in 0..6 {
        f64_of(c)?;
    }
    let (degree, _flags) = (usize::from(c.u8()?), c.u8()?);
    if !(seconds.is_finite() && seconds >= 0.0 && cutoff > 0.0 && cutoff <= 1.0) || degree > 3 {
        return Err(damaged(format!("{seconds} s, cutoff {cutoff}, degree {degree}")));
    }
    Ok(Header { seconds, cutoff, degree, attributes: map(c)? })
}

fn steps_of(c: &mut Cursor<'_>) -> Result<Steps> {
    let scheme = text(c)?;
    if scheme != SCHEME {
        let what = format!("a .4dgs with bins of `{}`", crate::text::in_line(&scheme));
        return Err(unsupported(what, "Write it again with the scheme uniform-v1."));
    }
    let mut numbers = [0.0; 11];
    for x in &mut numbers {
        *x = f64_of(c)?;
    }
    if !numbers.iter().all(|x| x.is_finite()) || numbers[3..].iter().any(|x| *x <= 0.0) {
        return Err(damaged("a step of its bins is not a positive number"));
    }
    let [x, y, z, position, log_scale, rotation, color, opacity, motion, time, log_sigma] = numbers;
    Ok(Steps { origin: [x, y, z], position, log_scale, rotation, color, opacity, motion, time, log_sigma })
}

fn windows_of(c: &mut Cursor<'_>) -> Result<Vec<[f64; 2]>> {
    let count = c.u32()? as usize;
    let bytes = count.checked_mul(WINDOW).ok_or_else(|| damaged("its window table is longer than it"))?;
    let mut inner = Cursor::new(c.take(bytes)?, "window table");
    (0..count).map(|_| Ok([f64_of(&mut inner)?, f64_of(&mut inner)?])).collect()
}

/// `most`: Gaussians that are accepted.
fn chunk_of(c: &mut Cursor<'_>, most: usize) -> Result<Chunk> {
    let _span = [f64_of(c)?, f64_of(c)?];
    let (_level, rows) = (c.u32()?, c.u32()? as usize);
    if rows > most {
        return Err(damaged(format!("a chunk claims {rows} Gaussians, more than the file can hold")));
    }
    let (codec, plain) = (text(c)?, usize::try_from(c.u64()?).unwrap_or(usize::MAX));
    let length = usize::try_from(c.u64()?).map_err(|_| damaged("a chunk is longer than the file"))?;
    let packed = c.take(length)?;
    let unpacked;
    let block = match codec.as_str() {
        "" => packed,
        "deflate" | "zstd" => {
            if plain > MOST_SMALL.saturating_add(MOST_RATIO.saturating_mul(packed.len())) {
                return Err(damaged(format!("a chunk of {} bytes claims {plain}", packed.len())));
            }
            let made = if codec == "zstd" { zstd(packed, plain) } else { zlib(packed, plain) };
            unpacked = made.map_err(damaged)?;
            &unpacked
        }
        other => {
            let what = format!("a .4dgs packed with `{}`", crate::text::in_line(other));
            return Err(unsupported(what, "Write the file again with deflate or zstd."));
        }
    };
    let mut inner = Cursor::new(block, "chunk of .4dgs");
    let mut streams = BTreeMap::new();
    let known = |attribute: u8| super::WIDTHS.get(usize::from(attribute)).copied();
    let mut left = block.len();
    while left > 0 {
        let stream = streams::read(&mut inner, rows, known)?;
        left = inner.left();
        if known(stream.attribute).is_some() {
            streams.insert(stream.attribute, stream);
        }
    }
    if streams.len() < super::WIDTHS.len() && rows > 0 {
        return Err(damaged(format!("a chunk has {} of {} attributes", streams.len(), super::WIDTHS.len())));
    }
    Ok(Chunk { rows, streams, bands: BTreeMap::new() })
}
