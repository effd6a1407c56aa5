//! Attribute streams: bins as zigzag symbols of 1, 2 or 4 bytes, each byte in a plane of its own, packed.

use super::damaged;
use crate::format::bytes::Cursor;
use crate::format::inflate::{zlib, zstd};
use crate::{Error, ErrorKind, Result};
use flate2::Compression;
use flate2::write::ZlibEncoder;
use std::io::Write;

/// Decoding of an attribute's symbols into bins.
const RAW: u8 = 0;
const DELTA: u8 = 1;
const CONSTANT: u8 = 2;
/// Codecs.
const DEFLATE: u8 = 0;
const ZSTD: u8 = 1;

/// Bins of an attribute, row-major.
pub(super) struct Stream {
    pub(super) attribute: u8,
    pub(super) channels: usize,
    pub(super) bins: Vec<i32>,
}

/// The next stream, which must have `count` rows of the channels that `wanted` states; others are skipped.
pub(super) fn read(c: &mut Cursor<'_>, count: usize, wanted: impl Fn(u8) -> Option<usize>) -> Result<Stream> {
    let (attribute, width, mode, codec) = (c.u8()?, usize::from(c.u8()?), c.u8()?, c.u8()?);
    let (channels, rows) = (usize::from(c.u8()?), c.u32()? as usize);
    let length = usize::try_from(c.u64()?).map_err(|_| damaged("a stream is longer than the file"))?;
    let packed = c.take(length)?;
    let Some(expected) = wanted(attribute) else { return Ok(Stream { attribute, channels, bins: Vec::new() }) };
    let bad = |what: String| damaged(format!("attribute {attribute}: {what}"));
    if ![1, 2, 4].contains(&width) || channels != expected || mode > CONSTANT {
        return Err(bad(format!("{channels} channels of {width} bytes in mode {mode}, expected {expected} channels")));
    }
    if rows != count {
        return Err(bad(format!("{rows} rows, expected {count}")));
    }
    if rows == 0 {
        return Ok(Stream { attribute, channels, bins: Vec::new() });
    }
    let symbols = if mode == CONSTANT { channels } else { rows * channels };
    let plain = match codec {
        DEFLATE => zlib(packed, symbols * width),
        ZSTD => zstd(packed, symbols * width),
        other => {
            return Err(Error::new(ErrorKind::Unsupported, format!("codec {other} of .4dgs"))
                .remedy("Write the file again with deflate or zstd."));
        }
    };
    let plain = plain.map_err(bad)?;
    let symbol = |i: usize| {
        let u = (0..width).fold(0u64, |u, plane| u | u64::from(plain[plane * symbols + i]) << (8 * plane));
        ((u >> 1) as i64 ^ -((u & 1) as i64)) as i32
    };
    let mut bins: Vec<i32> = match mode {
        CONSTANT => (0..rows * channels).map(|i| symbol(i % channels)).collect(),
        _ => (0..symbols).map(symbol).collect(),
    };
    if mode == DELTA {
        for i in channels..bins.len() {
            let sum = bins[i].checked_add(bins[i - channels]);
            bins[i] = sum.ok_or_else(|| damaged(format!("attribute {attribute}: a number beyond 31 bits")))?;
        }
    }
    Ok(Stream { attribute, channels, bins })
}

/// Appends a stream. Errors: a bin beyond 31 bits.
pub(super) fn write(attribute: u8, channels: usize, bins: &[i64], out: &mut Vec<u8>) -> Result<()> {
    let rows = bins.len() / channels;
    let constant = rows > 1 && bins.chunks_exact(channels).all(|row| row == &bins[..channels]);
    let mut candidates: Vec<(u8, Vec<i64>)> = Vec::new();
    if constant {
        candidates.push((CONSTANT, bins[..channels].to_vec()));
    } else {
        let steps = (0..bins.len()).map(|i| bins[i] - if i < channels { 0 } else { bins[i - channels] });
        candidates.push((DELTA, steps.collect()));
        candidates.push((RAW, bins.to_vec()));
    }
    let mut best: Option<(u8, usize, Vec<u8>)> = None;
    for (mode, bins) in candidates {
        let symbols: Vec<u64> = bins.iter().map(|x| ((x << 1) ^ (x >> 63)) as u64).collect();
        let width = match symbols.iter().copied().max().unwrap_or(0) {
            0..=0xFF => 1,
            0x100..=0xFFFF => 2,
            0x1_0000..=0xFFFF_FFFF => 4,
            // Steps may need a bit more than the bins.
            _ => continue,
        };
        let planes = (0..width).flat_map(|plane| symbols.iter().map(move |u| (u >> (8 * plane)) as u8));
        let mut zip = ZlibEncoder::new(Vec::new(), Compression::default());
        zip.write_all(&planes.collect::<Vec<u8>>()).expect("memory takes all bytes");
        let packed = zip.finish().expect("memory takes all bytes");
        if best.as_ref().is_none_or(|(.., other)| packed.len() < other.len()) {
            best = Some((mode, width, packed));
        }
    }
    let Some((mode, width, packed)) = best else {
        return Err(Error::new(ErrorKind::Unsupported, "numbers of more than 31 bits at the steps of .4dgs")
            .remedy("Write .s4d, or leave far Gaussians out (edit)."));
    };
    out.extend([attribute, width as u8, mode, DEFLATE, channels as u8]);
    out.extend((rows as u32).to_le_bytes());
    out.extend((packed.len() as u64).to_le_bytes());
    out.extend(packed);
    Ok(())
}
