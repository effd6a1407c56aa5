//! Just enough of zip for `.sog`, `.npz` and `.usdz`: stored and deflated files, named in the central directory, are
//! read; stored ones are written.
//!
//! [`Archive::open`] reads the directory alone and refuses files whose bytes overlap; a file is inflated when it is
//! requested, up to the length that its format needs. An archive of 200 kB whose files share one body would otherwise
//! become 200 GB.
//!
//! Source: PKWARE's APPNOTE 6.3.10, sections 4.3 and 4.4. Own code, because a general crate brings ciphers and ten
//! other compressions, and this is a page.

use super::bytes::Cursor;
use crate::{Error, ErrorKind, Result};
use flate2::read::DeflateDecoder;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::ops::Range;

/// The files of an archive: name → bytes.
pub type Files<'a> = BTreeMap<String, Cow<'a, [u8]>>;

/// First bytes of a zip file with something in it.
pub const MAGIC: [u8; 4] = *b"PK\x03\x04";
/// First bytes of an entry of the central directory.
const ENTRY: [u8; 4] = *b"PK\x01\x02";
/// First bytes of the end record.
const END: [u8; 4] = *b"PK\x05\x06";
/// Length of a local header without name and extra field.
const LOCAL_HEADER: usize = 30;
/// Length of the end record without its comment, and the longest comment.
const END_LENGTH: usize = 22;
const MOST_COMMENT: usize = 65_535;
/// Refers to the zip64 record.
const ZIP64: u32 = u32::MAX;
/// Deflate shrinks 1032:1 at the very most (zlib technical details).
const MOST_RATIO: usize = 1032;
/// Most files that are examined: a SOG scene has eight, an archive of arrays an array each.
const MOST_FILES: u16 = 4096;

/// An archive's directory.
pub struct Archive<'a> {
    bytes: &'a [u8],
    entries: BTreeMap<String, Entry>,
}

/// A file of the directory.
struct Entry {
    /// Position of its packed bytes.
    body: Range<usize>,
    /// Length that the directory states for the plain bytes.
    plain: usize,
    flags: u16,
    method: u16,
}

impl<'a> Archive<'a> {
    /// Reads the directory. Errors: damaged, too many files, files whose bytes overlap or whose names are equal.
    pub fn open(bytes: &'a [u8]) -> Result<Self> {
        let tail = bytes.len().saturating_sub(END_LENGTH + MOST_COMMENT);
        let end = bytes[tail..].windows(END.len()).rposition(|w| w == END);
        let end = tail + end.ok_or_else(|| damaged("the zip file has no end: it is cut short"))?;
        let mut c = Cursor::new(&bytes[end..], "zip file");
        c.take(10)?;
        let count = c.u16()?;
        let (length, offset) = (c.u32()?, c.u32()?);
        if count == u16::MAX || length == ZIP64 || offset == ZIP64 || count > MOST_FILES {
            return Err(Error::new(ErrorKind::Unsupported, format!("the zip file holds {count} files or is a zip64"))
                .remedy("Fewer files and less than 4 GiB are read; save it again."));
        }
        let directory = bytes.get(offset as usize..end);
        let mut c = Cursor::new(directory.ok_or_else(|| damaged("the zip's directory lies outside"))?, "zip directory");
        let (mut entries, mut places) = (BTreeMap::new(), Vec::new());
        for _ in 0..count {
            if c.take(4)? != ENTRY {
                return Err(damaged("the zip's directory has a wrong entry"));
            }
            c.take(4)?;
            let (flags, method) = (c.u16()?, c.u16()?);
            c.take(8)?;
            let (packed, plain) = (c.u32()? as usize, c.u32()? as usize);
            let (name, extra, comment) = (c.u16()?, c.u16()?, c.u16()?);
            c.take(8)?;
            let start = c.u32()? as usize;
            let name = String::from_utf8_lossy(c.take(name.into())?).into_owned();
            c.take(usize::from(extra) + usize::from(comment))?;
            if [packed, plain, start].contains(&(ZIP64 as usize)) {
                let error = Error::new(ErrorKind::Unsupported, "a file of 2 GiB or more in a zip64 archive");
                return Err(error.at(&name).remedy("Smaller files are read; save it in parts."));
            }
            let body = body(bytes, start, packed).map_err(|e| e.at(&name))?;
            places.push(start..body.end);
            if entries.contains_key(&name) {
                return Err(damaged(format!("it has two files `{name}`")));
            }
            entries.insert(name, Entry { body, plain, flags, method });
        }
        places.sort_by_key(|p| p.start);
        // The directory follows the last file.
        let ends = places.iter().skip(1).map(|p| p.start).chain([offset as usize]);
        if places.iter().zip(ends).any(|(place, next)| place.end > next) {
            return Err(damaged("its files overlap"));
        }
        Ok(Self { bytes, entries })
    }

    /// Names of all files.
    pub fn names(&self) -> Vec<String> {
        self.entries.keys().cloned().collect()
    }

    /// Name of the file whose bytes are first.
    pub(crate) fn first(&self) -> Option<&str> {
        self.entries.iter().min_by_key(|(_, e)| e.body.start).map(|(name, _)| name.as_str())
    }

    /// Length of a file in the archive, bytes.
    pub fn packed(&self, name: &str) -> Option<usize> {
        self.entries.get(name).map(|e| e.body.len())
    }

    /// A file of at most `most` plain bytes. `None`: no such file. Errors: damaged, encrypted, or longer.
    pub fn file(&self, name: &str, most: usize) -> Option<Result<Cow<'a, [u8]>>> {
        let entry = self.entries.get(name)?;
        Some(entry.unpack(&self.bytes[entry.body.clone()], most).map_err(|e| e.at(name)))
    }
}

/// Position of the packed bytes of the file whose local header is at `offset`.
fn body(bytes: &[u8], offset: usize, packed: usize) -> Result<Range<usize>> {
    let mut c = Cursor::new(bytes.get(offset..).unwrap_or_default(), "zip file");
    if c.take(4)? != MAGIC {
        return Err(damaged("the zip's directory points to no file"));
    }
    // Lengths may be missing here, those of the directory count; only the two of names are needed.
    c.take(22)?;
    let (name, extra) = (c.u16()?, c.u16()?);
    c.take(usize::from(name) + usize::from(extra))?;
    let start = offset + LOCAL_HEADER + usize::from(name) + usize::from(extra);
    c.take(packed)?;
    Ok(start..start + packed)
}

impl Entry {
    fn unpack<'a>(&self, body: &'a [u8], most: usize) -> Result<Cow<'a, [u8]>> {
        let Self { plain, flags, method, .. } = *self;
        if flags & 1 != 0 {
            return Err(
                Error::new(ErrorKind::Unsupported, "the file is encrypted").remedy("Unzip it with its password.")
            );
        }
        if plain.max(if method == 0 { body.len() } else { 0 }) > most {
            return Err(damaged(format!("a file of {plain} bytes is longer than the {most} that it can need")));
        }
        match method {
            0 => Ok(Cow::Borrowed(body)),
            8 => {
                if plain > MOST_RATIO * body.len() + 1 {
                    return Err(damaged(format!("a file of {} bytes cannot become one of {plain}", body.len())));
                }
                let mut out = Vec::new();
                let read = DeflateDecoder::new(body).take(plain as u64 + 1).read_to_end(&mut out);
                read.map_err(|e| damaged(format!("a file cannot be inflated ({e})")))?;
                if out.len() != plain {
                    return Err(damaged(format!("a file should have {plain} bytes, but has {}", out.len())));
                }
                Ok(Cow::Owned(out))
            }
            other => Err(Error::new(ErrorKind::Unsupported, format!("the file is compressed by zip method {other}"))
                .remedy("Zip it again with deflate, or save it again.")),
        }
    }
}

/// Version 2.0 of the format, which stored files need.
const VERSION: [u8; 2] = [20, 0];
/// No time, and 1 January 1980, the earliest day of the format.
const TIME: [u8; 4] = [0, 0, 0x21, 0];
/// Extra field that fills up to an alignment (usdz specification; Android's zipalign has the same).
const FILL: u16 = 0x1986;
/// Length of an extra field's own header.
const EXTRA: usize = 4;

/// Writes files uncompressed; the bytes of each begin at a multiple of `align`.
///
/// Errors: more than 4 GiB; the sink's.
pub(super) fn write(files: &[(&str, &[u8])], align: usize, out: &mut dyn Write) -> Result<()> {
    let failed = |e| Error::io("the archive could not be written", e);
    let (mut at, mut directory) = (0usize, Vec::new());
    let count = (files.len() as u16).to_le_bytes();
    for (name, bytes) in files {
        let mut crc = flate2::Crc::new();
        crc.update(bytes);
        let length = u32::try_from(bytes.len()).ok().filter(|_| at + bytes.len() < ZIP64 as usize);
        let length = length.ok_or_else(too_long)?.to_le_bytes();
        let body = at + LOCAL_HEADER + name.len();
        let gap = body.next_multiple_of(align) - body;
        let gap = if gap == 0 || gap >= EXTRA { gap } else { gap + align.max(EXTRA) };
        let mut extra = Vec::new();
        if gap > 0 {
            extra.extend(FILL.to_le_bytes());
            extra.extend(((gap - EXTRA) as u16).to_le_bytes());
            extra.resize(gap, 0);
        }
        let shared = [&[0; 4][..], &TIME, &crc.sum().to_le_bytes(), &length, &length].concat();
        let name_length = (name.len() as u16).to_le_bytes();
        let head = [&MAGIC[..], &VERSION, &shared, &name_length, &(gap as u16).to_le_bytes(), name.as_bytes(), &extra];
        let head = head.concat();
        let place = (at as u32).to_le_bytes();
        let entry = [&ENTRY[..], &VERSION, &VERSION, &shared, &name_length, &[0; 12], &place, name.as_bytes()];
        directory.extend(entry.concat());
        out.write_all(&head).and_then(|()| out.write_all(bytes)).map_err(failed)?;
        at += head.len() + bytes.len();
    }
    let place = u32::try_from(at).map_err(|_| too_long())?.to_le_bytes();
    let length = (directory.len() as u32).to_le_bytes();
    let end = [&END[..], &[0; 4], &count, &count, &length, &place, &[0; 2]].concat();
    out.write_all(&directory).and_then(|()| out.write_all(&end)).map_err(failed)
}

fn too_long() -> Error {
    Error::input("the archive would be longer than 4 GiB")
        .remedy("Write fewer frames (--from, --to) or fewer Gaussians.")
}

fn damaged(what: impl std::fmt::Display) -> Error {
    Error::input(format!("the zip archive is damaged: {what}")).remedy("Copy or save it again.")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_archives_are_read_and_aligned() {
        let files: [(&str, &[u8]); 3] = [("scene.usda", b"#usda 1.0\n"), ("b/c.bin", &[7; 300]), ("empty", b"")];
        for align in [1, 4, 64] {
            let mut zip = Vec::new();
            write(&files, align, &mut zip).unwrap();
            let archive = Archive::open(&zip).unwrap();
            assert_eq!(archive.first(), Some("scene.usda"));
            for (name, bytes) in files {
                assert_eq!(&archive.file(name, 300).unwrap().unwrap()[..], bytes);
                assert!(archive.entries[name].body.start.is_multiple_of(align), "{name} at {align}");
            }
        }
    }
}
