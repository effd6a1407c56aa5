//! Throws bytes at every reader of the playback file. `cargo fuzz run playback` (needs a nightly compiler); start it with
//! `crates/splat4d/tests/data/tiny.s4d` in its corpus.
#![no_main]

use libfuzzer_sys::fuzz_target;
use splat4d::format::playback::{HEADER_BYTES, Index, Kind, decode_masks, decode_page, decode_palette, read};

/// Bytes of an entry of the table of sections, and the places of offset, stored bytes and checksum in it.
const ENTRY: usize = 64;

fuzz_target!(|bytes: &[u8]| {
    look(bytes);
    // Checksums would stop almost every input at the door: with them mended, what lies behind them is reached.
    let mut mended = bytes.to_vec();
    mend(&mut mended);
    look(&mended);
});

fn look(bytes: &[u8]) {
    let _ = Index::needed(bytes);
    if let Ok(index) = Index::parse(bytes, Some(bytes.len() as u64)) {
        for e in &index.sections {
            let (first, end) = (e.offset as usize, (e.offset + u64::from(e.stored)) as usize);
            let Some(stored) = bytes.get(first..end) else { continue };
            match e.kind {
                Kind::Page => drop(decode_page(e, stored)),
                Kind::Palette => drop(decode_palette(e, stored)),
                Kind::Masks => drop(decode_masks(e, stored)),
                Kind::Provenance => drop(splat4d::format::playback::provenance(bytes)),
                Kind::Labels | Kind::Poster | Kind::Other(_) => {} // labels are decoded with the whole, below
            }
        }
    }
    let _ = read(bytes);
}

fn crc(bytes: &[u8]) -> [u8; 4] {
    let mut crc = flate2::Crc::new();
    crc.update(bytes);
    crc.sum().to_le_bytes()
}

fn mend(bytes: &mut [u8]) {
    let number = |b: &[u8], at: usize| b.get(at..at + 4).map(|x| u32::from_le_bytes([x[0], x[1], x[2], x[3]]) as usize);
    let Some(index) = number(bytes, 12) else { return };
    if bytes.len() < HEADER_BYTES || index > bytes.len() - HEADER_BYTES {
        return;
    }
    let end = HEADER_BYTES + index;
    let table = number(bytes, HEADER_BYTES).and_then(|json| json.checked_add(HEADER_BYTES + 8)).unwrap_or(end);
    for at in (table..(end + 1).saturating_sub(ENTRY)).step_by(ENTRY) {
        let (Some(offset), Some(size)) = (number(bytes, at + 8), number(bytes, at + 16)) else { continue };
        if let Some(sum) = bytes.get(offset..offset.saturating_add(size)).map(crc) {
            bytes[at + 24..at + 28].copy_from_slice(&sum);
        }
    }
    let sum = crc(&bytes[HEADER_BYTES..end]);
    bytes[24..28].copy_from_slice(&sum);
    let sum = crc(&bytes[..HEADER_BYTES - 4]);
    bytes[HEADER_BYTES - 4..HEADER_BYTES].copy_from_slice(&sum);
}
