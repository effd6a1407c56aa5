//! Archives, written: seeds of readers of zip files.

use flate2::Compression;
use flate2::write::DeflateEncoder;
use std::io::Write;

/// A zip of these files (APPNOTE 4.3), stored or deflated; its checksums are 0, which no reader checks.
pub(crate) fn zip(files: &[(&str, &[u8])], deflate: bool) -> Vec<u8> {
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for (name, plain) in files {
        let mut packed = plain.to_vec();
        if deflate {
            let mut zip = DeflateEncoder::new(Vec::new(), Compression::fast());
            zip.write_all(plain).expect("memory takes all bytes");
            packed = zip.finish().expect("memory takes all bytes");
        }
        let mut shared = vec![20, 0, 0, 0, if deflate { 8 } else { 0 }, 0];
        shared.extend([0; 8]);
        shared.extend((packed.len() as u32).to_le_bytes());
        shared.extend((plain.len() as u32).to_le_bytes());
        shared.extend((name.len() as u16).to_le_bytes());
        shared.extend([0, 0]);
        let offset = (out.len() as u32).to_le_bytes();
        out.extend([b"PK\x03\x04", &shared[..], name.as_bytes(), &packed].concat());
        directory.extend([b"PK\x01\x02\x14\0", &shared[..], &[0; 10], &offset, name.as_bytes()].concat());
    }
    let at = out.len() as u32;
    out.extend(&directory);
    out.extend(b"PK\x05\x06\0\0\0\0");
    (0..2).for_each(|_| out.extend((files.len() as u16).to_le_bytes()));
    out.extend((directory.len() as u32).to_le_bytes());
    out.extend(at.to_le_bytes());
    out.extend([0, 0]);
    out
}
