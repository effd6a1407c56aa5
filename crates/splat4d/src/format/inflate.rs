//! Packed streams of a known length: zlib and zstd, with no more memory than that length.

use flate2::read::ZlibDecoder;
use ruzstd::decoding::StreamingDecoder;
use std::io::Read;

/// Largest zstd window that is granted, bytes: what RFC 8878 (3.1.1.1.2) requires every decoder to support. A larger one is
/// granted up to the plain length.
const WINDOW: u64 = 8 << 20;

/// A zstd frame of exactly `length` plain bytes. Errors: what is wrong, as a clause.
pub(super) fn zstd(packed: &[u8], length: usize) -> Result<Vec<u8>, String> {
    let broken = |e: &dyn std::fmt::Display| format!("a zstd stream cannot be read ({e})");
    let window = WINDOW.max(length as u64);
    let unzip = StreamingDecoder::new_with_max_window_size(packed, window).map_err(|e| broken(&e))?;
    exactly(unzip, length)
}

/// A zlib stream of exactly `length` plain bytes. Errors: what is wrong, as a clause.
pub(super) fn zlib(packed: &[u8], length: usize) -> Result<Vec<u8>, String> {
    exactly(ZlibDecoder::new(packed), length)
}

fn exactly(stream: impl Read, length: usize) -> Result<Vec<u8>, String> {
    let mut plain = Vec::new();
    let read = stream.take(length as u64 + 1).read_to_end(&mut plain);
    read.map_err(|e| format!("a packed stream cannot be read ({e})"))?;
    if plain.len() != length {
        return Err(format!("a stream of {length} bytes has {}", if plain.len() > length { "more" } else { "fewer" }));
    }
    Ok(plain)
}
