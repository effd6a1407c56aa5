//! Sound of a file: an optional section with an MP4 file of AAC, whose span places it on the scene clock. Readers
//! without support skip it. What is inside the MP4 file is left to the decoder of the system; only its frame is checked.

use super::index::{MOST_SECONDS, MOST_SOUND, broken, crc};
use super::provenance::{with_provenance, with_section};
use super::{Entry, Index, Kind, Provenance};
use crate::{Error, Result};

/// Largest difference of the section's span and the MP4 file's length, seconds: two frames of AAC at 48 kHz.
const LENGTH_ERROR: f64 = 0.05;
/// Most boxes at one level of an MP4 file; encoders write fewer than ten.
const MOST_BOXES: usize = 64;
/// Outermost boxes of a file that has nothing but sound.
const OUTER: [&[u8; 4]; 4] = [b"ftyp", b"free", b"moov", b"mdat"];

/// Sound of a scene.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Sound {
    /// Seconds on the scene clock at which its first sample is heard and its last one ends.
    pub span: [f64; 2],
    /// An MP4 file with one track of AAC.
    pub mp4: Vec<u8>,
}

impl TryFrom<(f64, Vec<u8>)> for Sound {
    type Error = Error;

    /// From the second at which its first sample is heard, and the MP4 file. Errors: another kind of file, damage, more
    /// than a file holds.
    fn try_from((start, mp4): (f64, Vec<u8>)) -> Result<Self> {
        if mp4.len() > MOST_SOUND {
            return Err(Error::input(format!("the sound has {} bytes, a file holds {MOST_SOUND}", mp4.len()))
                .remedy("Give a shorter part of it, or one with a lower bit rate"));
        }
        if !start.is_finite() {
            return Err(Error::input("the sound's start is not a finite number of seconds"));
        }
        let seconds = length(&mp4)?;
        Ok(Self { span: [start, start + seconds], mp4 })
    }
}

/// The sound in a whole file; none where it has none.
///
/// Errors: not a playback file, a file that is cut short, a section that is damaged or no MP4 file of AAC.
pub fn sound(bytes: &[u8]) -> Result<Option<Sound>> {
    let index = Index::parse(bytes, Some(bytes.len() as u64))?;
    let Some(entry) = index.sections.iter().find(|e| e.kind == Kind::Sound) else { return Ok(None) };
    let first = entry.offset as usize;
    let stored = bytes.get(first..first + entry.stored as usize).ok_or_else(|| broken("it is cut short".into()))?;
    if crc(stored) != entry.crc {
        return Err(broken("the checksum of its sound is wrong".into()));
    }
    let sound = Sound::try_from((entry.span[0], stored.to_vec()))?;
    if (sound.span[1] - entry.span[1]).abs() > LENGTH_ERROR {
        let [from, to] = entry.span;
        return Err(broken(format!("its sound lasts {:.3} s instead of {:.3} s", sound.span[1] - from, to - from)));
    }
    Ok(Some(Sound { span: entry.span, ..sound }))
}

/// The same file with this provenance and sound in place of its own, or without; all other sections keep their bytes.
///
/// Errors: not a playback file, a file that is cut short, more of either than a file holds.
pub fn with_extras(bytes: &[u8], provenance: Option<&Provenance>, sound: Option<&Sound>) -> Result<Vec<u8>> {
    with_sound(&with_provenance(bytes, provenance)?, sound)
}

/// With this sound alone, behind all other sections.
pub(super) fn with_sound(bytes: &[u8], new: Option<&Sound>) -> Result<Vec<u8>> {
    with_section(bytes, Kind::Sound, new.map(Sound::section).transpose()?)
}

impl Sound {
    /// Its section. Errors: numbers that no reader accepts.
    pub(super) fn section(&self) -> Result<(Entry, Vec<u8>)> {
        let entry = Entry { span: self.span, ..Entry::plain(Kind::Sound, &self.mp4) };
        entry.check(0)?;
        Ok((entry, self.mp4.clone()))
    }
}

/// Seconds of an MP4 file (ISO/IEC 14496-12 and -14) with one track of AAC and nothing else.
fn length(file: &[u8]) -> Result<f64> {
    if file.get(4..8) != Some(b"ftyp") {
        return Err(wrong("it does not begin as one"));
    }
    let outer = boxes(file)?;
    if let Some((kind, _)) = outer.iter().find(|(kind, _)| !OUTER.contains(&kind)) {
        return Err(wrong(&format!("it has a box `{}`", kind.escape_ascii())));
    }
    let track = boxes(one(&boxes(one(&outer, b"moov")?)?, b"trak")?)?;
    let media = boxes(one(&track, b"mdia")?)?;
    if one(&media, b"hdlr")?.get(8..12) != Some(b"soun") {
        return Err(wrong("its track is not sound"));
    }
    let inner = boxes(one(&media, b"minf")?)?;
    // The samples are in the file itself: one reference, with the flag for that.
    let references = one(&boxes(one(&inner, b"dinf")?)?, b"dref")?;
    if references.get(4..8) != Some(&[0, 0, 0, 1]) || references.get(16..20) != Some(&[0, 0, 0, 1]) {
        return Err(wrong("its samples are in another file"));
    }
    let table = boxes(one(&inner, b"stbl")?)?;
    let kinds = one(&table, b"stsd")?;
    if kinds.get(4..8) != Some(&[0, 0, 0, 1]) || kinds.get(12..16) != Some(b"mp4a") {
        return Err(wrong("its samples are not AAC"));
    }
    // Where its chunks begin.
    let chunks = one(&table, b"stco")?.get(8..).unwrap_or_default().as_chunks::<4>().0;
    if chunks.iter().any(|at| u32::from_be_bytes(*at) as usize >= file.len()) {
        return Err(wrong("it is cut short"));
    }
    let (rate, count) = ticks(one(&media, b"mdhd")?)?;
    // An encoder's first samples are not heard; the list of edits states how many.
    let edits = track.iter().find(|(kind, _)| kind == b"edts").map(|(_, body)| boxes(body)).transpose()?;
    let skipped = edits.as_deref().map_or(Ok(0), |edits| first_sample(one(edits, b"elst")?))?;
    let seconds = count.saturating_sub(skipped) as f64 / f64::from(rate);
    if !(seconds > 0.0 && seconds <= MOST_SECONDS) {
        return Err(wrong(&format!("it lasts {seconds} s")));
    }
    Ok(seconds)
}

/// Kind and content of a box.
type Part<'a> = ([u8; 4], &'a [u8]);

/// The boxes that fill these bytes.
fn boxes(mut rest: &[u8]) -> Result<Vec<Part<'_>>> {
    let mut out = Vec::new();
    while !rest.is_empty() {
        // Lengths of 64 bits and boxes without a length are legal, and needed by no file of this size.
        let size = number(rest, 0)? as usize;
        if size < 8 || size > rest.len() || out.len() == MOST_BOXES {
            return Err(wrong("its boxes do not fit into each other"));
        }
        let (head, body) = rest[..size].split_at(8);
        out.push(([head[4], head[5], head[6], head[7]], body));
        rest = &rest[size..];
    }
    Ok(out)
}

/// The only box of a kind.
fn one<'a>(boxes: &[Part<'a>], kind: &[u8; 4]) -> Result<&'a [u8]> {
    let mut found = boxes.iter().filter(|(k, _)| k == kind);
    match (found.next(), found.next()) {
        (Some((_, body)), None) => Ok(body),
        (None, _) => Err(wrong(&format!("it has no box `{}`", kind.escape_ascii()))),
        _ => Err(wrong(&format!("it has several boxes `{}`", kind.escape_ascii()))),
    }
}

/// Ticks a second, and the length in ticks, of a media header.
fn ticks(head: &[u8]) -> Result<(u32, u64)> {
    let (rate, count) = match head.first() {
        Some(0) => (number(head, 12)?, u64::from(number(head, 16)?)),
        Some(1) => (number(head, 20)?, u64::from(number(head, 24)?) << 32 | u64::from(number(head, 28)?)),
        _ => return Err(wrong("its media header is unknown")),
    };
    if rate == 0 { Err(wrong("its clock has no ticks")) } else { Ok((rate, count)) }
}

/// The first tick that is heard: one edit of version 0.
fn first_sample(edits: &[u8]) -> Result<u64> {
    match (edits.first(), number(edits, 4)?) {
        (Some(0), 1) => Ok(u64::from(number(edits, 12)?)),
        _ => Err(wrong("it has several edits")),
    }
}

fn number(bytes: &[u8], at: usize) -> Result<u32> {
    let four = bytes.get(at..at + 4).ok_or_else(|| wrong("it is cut short"))?;
    Ok(u32::from_be_bytes([four[0], four[1], four[2], four[3]]))
}

fn wrong(what: &str) -> Error {
    Error::input(format!("the sound is not an MP4 file with one track of AAC: {what}"))
        .remedy("Let `splat4d bake --sound FILE` convert it")
}
