//! LAS 1.0 to 1.4 without compression. Source: ASPRS LAS specification 1.4 R15.

use super::surface::{Sink, Surface};
use splat4d::{Error, ErrorKind, Result};

/// Bytes of the shortest header, that of version 1.0.
const HEADER: usize = 227;
/// Bytes of the header of version 1.4, which counts points in 64 bits.
const HEADER_14: usize = 255;
/// Bytes of a record of formats 0 to 10, and where its colour begins.
const FORMATS: [(usize, Option<usize>); 11] = [
    (20, None),
    (28, None),
    (26, Some(20)),
    (34, Some(28)),
    (57, None),
    (63, Some(28)),
    (30, None),
    (36, Some(30)),
    (38, Some(30)),
    (59, None),
    (67, Some(30)),
];
/// Classes of noise, which scanners mark: low and high.
const NOISE: [u8; 2] = [7, 18];

/// Reads the points; those that are withheld or classified as noise are left out.
///
/// Errors: LAZ; fewer bytes than the header claims; a record format that is not known.
pub(super) fn read(bytes: &[u8]) -> Result<Surface> {
    let damaged = |what: String| Error::input(what).remedy("Copy or export the file again");
    if bytes.len() < HEADER {
        return Err(damaged(format!("the LAS header has {HEADER} bytes, the file {}", bytes.len())));
    }
    let [u16_at, u32_at] = [2, 4].map(|n| move |at: usize| little(&bytes[at..at + n]));
    let f64_at = |at: usize| f64::from_bits(little(&bytes[at..at + 8]));
    let (version, format) = ([bytes[24], bytes[25]], bytes[104]);
    if format & 0x80 != 0 {
        return Err(Error::new(ErrorKind::Unsupported, "the points are compressed (LAZ)").remedy(
            "Convert the file: `pdal translate scan.laz scan.las`, `las2las -i scan.laz -o scan.las`, or CloudCompare",
        ));
    }
    let Some(&(least, color)) = FORMATS.get(usize::from(format & 0x3f)) else {
        return Err(Error::new(ErrorKind::Unsupported, format!("LAS point format {format} is not known"))
            .remedy("Save the scan in a point format from 0 to 10 (LAS 1.0 to 1.4)"));
    };
    let (start, length, legacy) = (u32_at(96), u16_at(105) as usize, u32_at(107));
    let long = version >= [1, 4] && bytes.len() >= HEADER_14;
    let count = if long && little(&bytes[247..255]) > 0 { little(&bytes[247..255]) } else { legacy };
    let [scale, offset] = [131, 155].map(|at| [0, 1, 2].map(|k| f64_at(at + 8 * k)));
    if length < least {
        return Err(damaged(format!(
            "a point of format {format} has at least {least} bytes, the header claims {length}"
        )));
    }
    if scale.iter().any(|s| !s.is_finite() || *s == 0.0) || offset.iter().any(|o| !o.is_finite()) {
        return Err(damaged(format!("invalid scale {scale:?} or offset {offset:?} in the LAS header")));
    }
    let there = (bytes.len() as u64).saturating_sub(start);
    if count.checked_mul(length as u64).is_none_or(|all| all > there) {
        return Err(damaged(format!(
            "the header claims {count} points of {length} bytes from byte {start} on, and {there} bytes follow"
        )));
    }
    // A file without points may claim to begin behind its end.
    let first = start.min(bytes.len() as u64) as usize;
    let records = || bytes[first..].chunks_exact(length).take(count as usize);
    let rgb = |record: &[u8], at: usize| [0, 2, 4].map(|k| little(&record[at + k..at + k + 2]) as f32);
    // Some programs write colours of 8 bits as they are.
    let white = match color {
        Some(at) if records().any(|r| rgb(r, at).iter().any(|c| *c > 255.0)) => 65_535.0,
        _ => 255.0,
    };
    let mut sink = Sink::new(count, color.is_some());
    for record in records() {
        let (class, withheld) = match format & 0x3f {
            0..6 => (record[15] & 31, record[15] & 0x80 != 0),
            _ => (record[16], record[15] & 4 != 0),
        };
        if withheld || NOISE.contains(&class) {
            continue;
        }
        let place = |k: usize| f64::from(little(&record[4 * k..4 * k + 4]) as u32 as i32) * scale[k] + offset[k];
        sink.push([0, 1, 2].map(place), color.map_or([0.5; 3], |at| rgb(record, at).map(|c| c / white)));
    }
    Ok(sink.finish())
}

/// A whole number of at most eight bytes, the lowest first.
fn little(bytes: &[u8]) -> u64 {
    bytes.iter().rev().fold(0, |n, b| n << 8 | u64::from(*b))
}

/// A file of these points, in format 2 where they have colours, else 0; coordinates in millimetres.
#[cfg(test)]
pub(super) fn write(points: &[[f64; 3]], colors: &[[u8; 3]], offset: [f64; 3]) -> Vec<u8> {
    let format = if colors.is_empty() { 0u8 } else { 2 };
    let length = FORMATS[usize::from(format)].0;
    let mut out = vec![0u8; HEADER];
    out[..4].copy_from_slice(b"LASF");
    (out[24], out[25], out[104]) = (1, 2, format);
    out[94..96].copy_from_slice(&(HEADER as u16).to_le_bytes());
    out[96..100].copy_from_slice(&(HEADER as u32).to_le_bytes());
    out[105..107].copy_from_slice(&(length as u16).to_le_bytes());
    out[107..111].copy_from_slice(&(points.len() as u32).to_le_bytes());
    for k in 0..3 {
        out[131 + 8 * k..139 + 8 * k].copy_from_slice(&1e-3f64.to_le_bytes());
        out[155 + 8 * k..163 + 8 * k].copy_from_slice(&offset[k].to_le_bytes());
    }
    for (i, p) in points.iter().enumerate() {
        let mut record = vec![0u8; length];
        for k in 0..3 {
            let code = ((p[k] - offset[k]) * 1e3).round() as i32;
            record[4 * k..4 * k + 4].copy_from_slice(&code.to_le_bytes());
        }
        if let Some(c) = colors.get(i) {
            (0..3).for_each(|k| record[20 + 2 * k..22 + 2 * k].copy_from_slice(&(u16::from(c[k]) * 257).to_le_bytes()));
        }
        out.extend(record);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_far_from_the_origin_keep_their_millimetres_and_colours() {
        let points = [[5_400_000.123, -0.5, 12.25], [5_400_001.0, 3.0, 4.0]];
        let file = write(&points, &[[255, 0, 51], [0, 255, 0]], [5_400_000.0, 0.0, 0.0]);
        let read = read(&file).unwrap();
        assert!(read.points.iter().flatten().zip(points.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-6));
        assert_eq!(read.colors, [[1.0, 0.0, 0.2], [0.0, 1.0, 0.0]]);
        // Noise and withheld points are left out.
        let mut marked = write(&points, &[], [0.0; 3]);
        marked[HEADER + 15] = 7;
        marked[HEADER + 20 + 15] = 0x80;
        let read = super::read(&marked).unwrap();
        assert!(read.points.is_empty() && read.colors.is_empty());
    }

    #[test]
    fn damage_and_compression_are_errors_that_name_the_remedy() {
        let good = write(&[[1.0; 3]; 4], &[], [0.0; 3]);
        let with = |change: &dyn Fn(&mut Vec<u8>)| {
            let mut bytes = good.clone();
            change(&mut bytes);
            read(&bytes).unwrap_err().to_string()
        };
        assert!(with(&|b| b[104] |= 0x80).contains("pdal translate"));
        assert!(with(&|b| b[104] = 11).contains("point format 11"));
        assert!(with(&|b| b.truncate(HEADER + 30)).contains("claims 4 points of 20 bytes"));
        assert!(with(&|b| b.truncate(100)).contains("header"));
        assert!(with(&|b| b[107..111].fill(255)).contains("4294967295"));
        assert!(with(&|b| b[105] = 3).contains("at least 20"));
        assert!(with(&|b| b[131..139].fill(0)).contains("scale"));
        // Without points it does not matter where they would begin.
        let mut none = good.clone();
        none[107..111].fill(0);
        none[96..100].fill(255);
        assert!(read(&none).unwrap().points.is_empty());
    }
}
