//! Text files as programs of all systems write them.

use splat4d::{Error, Result};
use std::borrow::Cow;

/// UTF-8's byte-order mark, which Notepad, PowerShell and .NET write.
const UTF8_MARK: &[u8] = &[0xEF, 0xBB, 0xBF];
/// UTF-16's marks: little endian (PowerShell's `>`) and big endian.
const UTF16_MARKS: [[u8; 2]; 2] = [[0xFF, 0xFE], [0xFE, 0xFF]];

/// The text of a file's bytes, without byte-order mark. Errors: neither UTF-8 nor UTF-16 with a mark.
pub fn decode(bytes: &[u8]) -> Result<Cow<'_, str>> {
    let not_text = || Error::input("the file is not text (UTF-8)").remedy("Save it as UTF-8.");
    if let Some(wide) = UTF16_MARKS.iter().position(|mark| bytes.starts_with(mark)) {
        let unit = |pair: &[u8]| match wide {
            0 => u16::from_le_bytes([pair[0], pair[1]]),
            _ => u16::from_be_bytes([pair[0], pair[1]]),
        };
        let units: Vec<u16> = bytes[2..].chunks_exact(2).map(unit).collect();
        return String::from_utf16(&units).map(Cow::Owned).map_err(|_| not_text());
    }
    std::str::from_utf8(bytes.strip_prefix(UTF8_MARK).unwrap_or(bytes)).map(Cow::Borrowed).map_err(|_| not_text())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_are_no_part_of_a_text() {
        let wide = |big: bool| -> Vec<u8> {
            let units = "\u{feff}ü{1}".encode_utf16();
            units.flat_map(|u| if big { u.to_be_bytes() } else { u.to_le_bytes() }).collect()
        };
        for bytes in ["ü{1}".as_bytes().to_vec(), "\u{feff}ü{1}".as_bytes().to_vec(), wide(false), wide(true)] {
            assert_eq!(decode(&bytes).unwrap(), "ü{1}", "{bytes:?}");
        }
        assert_eq!(decode(b"").unwrap(), "");
        assert!(decode(&[0xFF, 0xC0, 0x80]).unwrap_err().to_string().contains("UTF-8"));
    }
}
