//! NumPy arrays (.npy) and uncompressed archives of them (.npz, as `numpy.savez` writes).

use splat4d::{Error, Result};

/// A numeric array, row-major.
#[derive(Debug)]
pub(super) struct Array {
    /// Size along each axis.
    pub shape: Vec<usize>,
    /// All values.
    pub data: Vec<f64>,
}

/// Parses a .npy file of little-endian f32, f64, or integers, in C order.
pub(super) fn parse(bytes: &[u8]) -> Result<Array> {
    let bad = |what: String| Error::input(format!("the NumPy array is damaged: {what}")).remedy("Save it again.");
    let rest = bytes.strip_prefix(b"\x93NUMPY").ok_or_else(|| bad("it does not start with \\x93NUMPY".into()))?;
    let truncated = || bad("it is truncated".into());
    let major = *rest.first().ok_or_else(truncated)?;
    let (length, start) = match (major, rest.get(2..6)) {
        (1, Some(b)) => (usize::from(u16::from_le_bytes([b[0], b[1]])), 4),
        (2 | 3, Some(b)) => (u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize, 6),
        _ => return Err(bad(format!("its version {major} is not known"))),
    };
    let header = rest.get(start..start + length).ok_or_else(truncated)?;
    let header = std::str::from_utf8(header).map_err(|_| bad("its header is no text".into()))?;
    let body = &rest[start + length..];
    let field = |name: &str| header.split_once(&format!("'{name}':")).map(|(_, after)| after.trim_start());
    let kind = field("descr").and_then(|f| f.split('\'').nth(1)).ok_or_else(|| bad("it states no type".into()))?;
    if field("fortran_order").is_none_or(|f| !f.starts_with("False")) {
        return Err(bad("it is in Fortran order".into()).remedy("Save numpy.ascontiguousarray(...) of it."));
    }
    let shape =
        field("shape").and_then(|f| f.strip_prefix('(')?.split_once(')')).ok_or_else(|| bad("no shape".into()))?.0;
    let sizes = shape.split(',').map(str::trim).filter(|s| !s.is_empty());
    let shape: Vec<usize> =
        sizes.map(|s| s.parse().map_err(|_| bad(format!("{s:.20} is no size")))).collect::<Result<_>>()?;
    let (width, read): (usize, fn(&[u8]) -> f64) = match kind {
        "<f8" => (8, |b| f64::from_le_bytes(b.try_into().unwrap_or_default())),
        "<f4" => (4, |b| f64::from(f32::from_le_bytes(b.try_into().unwrap_or_default()))),
        "<i8" => (8, |b| i64::from_le_bytes(b.try_into().unwrap_or_default()) as f64),
        "<i4" => (4, |b| f64::from(i32::from_le_bytes(b.try_into().unwrap_or_default()))),
        "|u1" => (1, |b| f64::from(b[0])),
        other => return Err(bad(format!("the type {other:.20} is not read")).remedy("Save it as float64.")),
    };
    let count = shape.iter().try_fold(1usize, |n, &s| n.checked_mul(s)).unwrap_or(usize::MAX);
    if count > body.len() / width {
        let holds = body.len() / width;
        return Err(bad(format!("it claims the shape {shape:?}, but holds {holds} values: it is truncated")));
    }
    Ok(Array { shape, data: body.chunks_exact(width).take(count).map(read).collect() })
}

/// The first member of an uncompressed .npz archive whose name starts with `name`.
pub(super) fn member<'a>(bytes: &'a [u8], name: &str) -> Result<&'a [u8]> {
    let bad = |what: &str| Error::input(format!("the .npz archive is damaged or compressed: {what}"));
    let u16_at = |at: usize| bytes.get(at..at.checked_add(2)?).map(|b| usize::from(u16::from_le_bytes([b[0], b[1]])));
    let u32_at = |at: usize| {
        let b = bytes.get(at..at.checked_add(4)?)?;
        Some(u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize)
    };
    // The directory at the end holds the sizes; files being written as a stream leave them open in front.
    let end = bytes.windows(4).rposition(|w| w == b"PK\x05\x06").ok_or_else(|| bad("it has no directory"))?;
    let (count, mut at) = u16_at(end + 10).zip(u32_at(end + 16)).ok_or_else(|| bad("its end is truncated"))?;
    for _ in 0..count {
        let entry = || -> Option<_> {
            let signature = bytes.get(at..at.checked_add(4)?)? == b"PK\x01\x02";
            let lengths = u16_at(at + 28)? + u16_at(at + 30)? + u16_at(at + 32)?;
            let file = bytes.get(at + 46..at + 46 + u16_at(at + 28)?)?;
            signature.then_some((u16_at(at + 10)?, u32_at(at + 24)?, u32_at(at + 42)?, lengths, file))
        };
        let (method, size, offset, lengths, file) = entry().ok_or_else(|| bad("its directory is truncated"))?;
        at += 46 + lengths;
        if !file.starts_with(name.as_bytes()) {
            continue;
        }
        if method != 0 {
            return Err(bad("its members are compressed").remedy("Save it with numpy.savez, not savez_compressed."));
        }
        let start = u16_at(offset + 26).zip(u16_at(offset + 28)).map(|(n, extra)| offset + 30 + n + extra);
        let found = start.and_then(|s| bytes.get(s..s.checked_add(size)?));
        return found.ok_or_else(|| bad("a member is truncated"));
    }
    Err(bad(&format!("it has no member \"{name}\"")))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Vec<u8> {
        let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }\n";
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        (0..6).for_each(|i| bytes.extend((i as f32 * 0.5).to_le_bytes()));
        bytes
    }

    #[test]
    fn arrays_are_read_and_absurd_ones_refused() {
        let bytes = sample();
        let array = parse(&bytes).unwrap();
        assert_eq!((array.shape.as_slice(), array.data[5]), (&[2, 3][..], 2.5));
        assert!(parse(&bytes[..bytes.len() - 1]).unwrap_err().to_string().contains("holds 5 values"));
        let text = String::from_utf8_lossy(&bytes[10..69]).replace("(2, 3)", "(9999999999999999, 99999999)");
        let mut huge = b"\x93NUMPY\x01\x00".to_vec();
        huge.extend((text.len() as u16).to_le_bytes());
        huge.extend(text.as_bytes());
        assert!(parse(&huge).unwrap_err().to_string().contains("truncated"));
        assert!((0..bytes.len()).all(|n| parse(&bytes[..n]).is_err()));
    }

    #[test]
    fn archive_members_are_found() {
        let body = sample();
        let mut zip = b"PK\x03\x04".to_vec();
        zip.extend([0; 22]);
        zip.extend([8, 0, 0, 0]);
        zip.extend(b"data.npy");
        zip.extend(&body);
        let directory = zip.len() as u32;
        zip.extend(b"PK\x01\x02");
        zip.extend([0; 16]);
        zip.extend((body.len() as u32).to_le_bytes());
        zip.extend((body.len() as u32).to_le_bytes());
        zip.extend([8, 0]);
        zip.extend([0; 16]);
        zip.extend(b"data.npy");
        zip.extend(b"PK\x05\x06\0\0\0\0\x01\0\x01\0");
        zip.extend((zip.len() as u32 - directory).to_le_bytes());
        zip.extend(directory.to_le_bytes());
        zip.extend([0; 2]);
        assert_eq!(member(&zip, "data").unwrap(), body);
        assert!(member(&zip, "other").is_err());
        assert!((0..zip.len() - 2).all(|n| member(&zip[..n], "data").is_err()));
    }
}
