//! How the streams are in the file: one gzip stream (versions 2, 3) or a table of contents and zstd frames (version 4).

use super::axes::{self, Axes};
use super::streams::{STREAMS, Streams, lengths};
use super::{EXTENDED, GZIP_MAGIC, Header, MAGIC, damaged};
use crate::format::bytes::Cursor;
use crate::format::inflate::zstd;
use crate::format::warnings::Warnings;
use crate::{Error, Result};
use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};
use std::borrow::Cow;
use std::io::{Read, Write};

/// Length of the header of versions 2 and 3, which is inside the gzip stream.
const OLD_HEADER: usize = 16;
/// Length of the plain header of version 4.
const NEW_HEADER: usize = 32;
/// Bytes of an entry of the table of contents: u64 compressed, u64 plain length.
const ENTRY: usize = 16;
/// Most Gaussians that are accepted, a byte of the file: real ones take eight bytes and more each. (Deflate and zstd
/// would allow a thousand times that.)
const PER_BYTE: usize = 1;
/// Gaussians that are accepted in any case, so that small files of equal Gaussians can be read.
const ALWAYS: usize = 1 << 16;
/// Bytes of extensions behind the streams that are inflated to get to the checksum.
const MOST_TAIL: u64 = 1 << 20;
/// Content of a file.
pub(super) struct Opened<'a> {
    pub(super) header: Header,
    pub(super) streams: Streams<'a>,
    /// Its axes, if it names them.
    pub(super) axes: Option<Axes>,
}

/// Header, plain streams and axes of a file. Nothing is allocated that the length of the file does not bear out.
pub(super) fn open<'a>(bytes: &'a [u8], warnings: &mut Warnings) -> Result<Opened<'a>> {
    if bytes.starts_with(&GZIP_MAGIC) {
        let mut unzip = GzDecoder::new(bytes);
        let mut start = [0; OLD_HEADER];
        unzip.read_exact(&mut start).map_err(|e| damaged(format!("its gzip stream cannot be read ({e})")))?;
        let header = old_header(&start)?;
        let body: u64 = lengths(&header).iter().map(|&n| n as u64).sum();
        believe(&header, bytes.len())?;
        let mut plain = Vec::new();
        let broken = |e| damaged(format!("its gzip stream cannot be read ({e})"));
        (&mut unzip).take(body).read_to_end(&mut plain).map_err(broken)?;
        let streams = split(&header, Cow::Owned(plain))?;
        // The checksum is compared at the end of the stream, behind extensions if there are any.
        let mut tail = Vec::new();
        unzip.take(MOST_TAIL).read_to_end(&mut tail).map_err(broken)?;
        let axes = extensions(&header, &tail, warnings);
        return Ok(Opened { header, streams, axes });
    }
    if !bytes.starts_with(&MAGIC) {
        return Err(Error::input("this is not an .spz file: it begins neither with gzip's bytes nor with `NGSP`")
            .remedy("Give a file that Scaniverse, splat-transform or splat4d wrote."));
    }
    let mut cursor = Cursor::new(bytes, ".spz file");
    cursor.take(MAGIC.len())?;
    if matches!(cursor.u32()?, 2 | 3) {
        // These versions should have gzip, but test data of the field has none.
        let header = old_header(cursor_start(bytes)?)?;
        let body = &bytes[OLD_HEADER..];
        let streams = split(&header, Cow::Borrowed(body))?;
        let tail = &body[lengths(&header).iter().sum::<usize>()..];
        return Ok(Opened { axes: extensions(&header, tail, warnings), header, streams });
    }
    new_streams(bytes, warnings)
}

fn cursor_start(bytes: &[u8]) -> Result<&[u8; OLD_HEADER]> {
    bytes.first_chunk().ok_or_else(|| damaged("it ends within its header"))
}

fn old_header(bytes: &[u8; OLD_HEADER]) -> Result<Header> {
    let mut c = Cursor::new(bytes, "header");
    if c.take(4)? != MAGIC {
        return Err(Error::input("this is a gzip file without an .spz file in it")
            .remedy("Unpack it (`gunzip FILE`) and give what is inside."));
    }
    let (version, count) = (c.u32()?, c.u32()? as usize);
    let (degree, fraction_bits, flags) = (usize::from(c.u8()?), c.u8()?, c.u8()?);
    let header = Header { version, count, degree, fraction_bits, flags }.checked()?;
    if header.version > 3 {
        return Err(damaged(format!("version {version} is not stored in gzip")));
    }
    Ok(header)
}

/// Errors where `bytes` cannot hold as many Gaussians as the header claims.
fn believe(header: &Header, bytes: usize) -> Result<()> {
    if header.count > ALWAYS + PER_BYTE * bytes {
        return Err(damaged(format!("it claims {} Gaussians, more than {bytes} bytes can hold", header.count)));
    }
    Ok(())
}

/// The axes that the extensions name, where the header states that there are extensions.
fn extensions(header: &Header, bytes: &[u8], warnings: &mut Warnings) -> Option<Axes> {
    if header.flags & EXTENDED == 0 { None } else { axes::read(bytes, warnings) }
}

/// Cuts a plain body into its streams.
fn split<'a>(header: &Header, body: Cow<'a, [u8]>) -> Result<Streams<'a>> {
    let lengths = lengths(header);
    let total: usize = lengths.iter().sum();
    if body.len() < total {
        return Err(damaged(format!("{} Gaussians take {total} bytes, but {} are there", header.count, body.len())));
    }
    let mut at = 0;
    Ok(lengths.map(|n| {
        let range = at..at + n;
        at += n;
        match &body {
            Cow::Borrowed(b) => Cow::Borrowed(&b[range]),
            Cow::Owned(b) => Cow::Owned(b[range].to_vec()),
        }
    }))
}

/// Version 4.
fn new_streams<'a>(bytes: &'a [u8], warnings: &mut Warnings) -> Result<Opened<'a>> {
    let mut c = Cursor::new(bytes, ".spz header");
    c.take(MAGIC.len())?;
    let (version, count) = (c.u32()?, c.u32()? as usize);
    let (degree, fraction_bits, flags) = (usize::from(c.u8()?), c.u8()?, c.u8()?);
    let header = Header { version, count, degree, fraction_bits, flags }.checked()?;
    let stated = usize::from(c.u8()?);
    let contents = c.u32()? as usize;
    let lengths = lengths(&header);
    believe(&header, bytes.len())?;
    // Streams without bytes are not in the file.
    let wanted = lengths.iter().filter(|&&n| n > 0).count();
    if stated != wanted {
        return Err(damaged(format!("it has {stated} streams, but {wanted} are needed for degree {degree}")));
    }
    if contents < NEW_HEADER {
        return Err(damaged(format!("its table of contents begins at byte {contents}, within the header")));
    }
    let axes = extensions(&header, bytes.get(NEW_HEADER..contents).unwrap_or_default(), warnings);
    let table = bytes.get(contents..).and_then(|b| b.get(..wanted * ENTRY));
    let table = table.ok_or_else(|| damaged("it ends within its table of contents"))?;
    let mut entries = Cursor::new(table, "table of contents");
    let mut data = Cursor::new(&bytes[contents + table.len()..], ".spz file");
    let mut streams: Streams<'a> = [const { Cow::Borrowed(&[]) }; STREAMS];
    for (stream, &length) in streams.iter_mut().zip(&lengths).filter(|(_, n)| **n > 0) {
        let (packed, plain) = (entries.u64()?, entries.u64()?);
        if plain != length as u64 {
            return Err(damaged(format!("expected a stream of {length} bytes, but its entry states {plain}")));
        }
        let packed = usize::try_from(packed).map_err(|_| damaged("a stream is longer than the file"))?;
        *stream = Cow::Owned(zstd(data.take(packed)?, length).map_err(damaged)?);
    }
    Ok(Opened { header, streams, axes })
}

/// The whole file. `extensions`: their records, where the header's flags say that there are any.
pub(super) fn close(header: &Header, streams: &Streams<'_>, extensions: &[u8]) -> Vec<u8> {
    let mut out = MAGIC.to_vec();
    out.extend(header.version.to_le_bytes());
    out.extend((header.count as u32).to_le_bytes());
    out.extend([header.degree as u8, header.fraction_bits, header.flags]);
    if header.version < 4 {
        out.push(0);
        streams.iter().for_each(|s| out.extend_from_slice(s));
        out.extend_from_slice(extensions);
        let mut zip = GzEncoder::new(Vec::new(), Compression::default());
        zip.write_all(&out).expect("memory takes all bytes");
        return zip.finish().expect("memory takes all bytes");
    }
    let there: Vec<&[u8]> = streams.iter().map(|s| &**s).filter(|s| !s.is_empty()).collect();
    out.push(there.len() as u8);
    out.extend(((NEW_HEADER + extensions.len()) as u32).to_le_bytes());
    out.resize(NEW_HEADER, 0);
    out.extend_from_slice(extensions);
    let packed: Vec<Vec<u8>> = there.iter().map(|s| compress_to_vec(*s, CompressionLevel::Fastest)).collect();
    for (plain, packed) in there.iter().zip(&packed) {
        out.extend((packed.len() as u64).to_le_bytes());
        out.extend((plain.len() as u64).to_le_bytes());
    }
    packed.iter().for_each(|p| out.extend_from_slice(p));
    out
}
