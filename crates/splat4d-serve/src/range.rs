//! The `Range` header of a request (RFC 9110, section 14).

/// Part of a file of known length that is needed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Requested {
    /// All of it: no range, another unit, several ranges or nonsense, all of which a server may ignore.
    Whole,
    /// `start..end`, not empty, within the file.
    Part {
        /// First byte.
        start: u64,
        /// One behind the last byte.
        end: u64,
    },
    /// A range that begins behind the end: 416.
    Nothing,
}

/// Reads a `Range` header for a file of `length` bytes.
///
/// Several ranges are served as the whole file, which RFC 9110 allows: a list of them is the classic way to make a
/// server do much work for a small request.
pub(crate) fn parse(header: &str, length: u64) -> Requested {
    let Some((unit, list)) = header.trim().split_once('=') else { return Requested::Whole };
    let list = list.trim();
    let Some((first, last)) = list.split_once('-') else { return Requested::Whole };
    if !unit.trim().eq_ignore_ascii_case("bytes") || list.contains(',') {
        return Requested::Whole;
    }
    let (start, end) = match (number(first), number(last)) {
        _ if first.is_empty() && last.is_empty() => return Requested::Whole,
        // The last n bytes.
        (None, Some(n)) if first.is_empty() => (length.saturating_sub(n), if n == 0 { 0 } else { length }),
        (Some(a), None) if last.is_empty() => (a, length),
        (Some(a), Some(b)) if a <= b => (a, b.saturating_add(1).min(length)),
        _ => return Requested::Whole,
    };
    if start < end { Requested::Part { start, end } } else { Requested::Nothing }
}

/// A number of plain digits. One too large for u64 is behind the end of every file, and so is `u64::MAX`.
fn number(text: &str) -> Option<u64> {
    let plain = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    plain.then(|| text.parse().unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_forms_are_read() {
        let part = |start, end| Requested::Part { start, end };
        for (header, wanted) in [
            ("bytes=0-0", part(0, 1)),
            ("bytes=0-9", part(0, 10)),
            ("bytes=3-5", part(3, 6)),
            ("bytes=3-", part(3, 10)),
            ("bytes=3-999", part(3, 10)),
            ("bytes=9-99999999999999999999999999", part(9, 10)),
            ("bytes=-4", part(6, 10)),
            ("bytes=-40", part(0, 10)),
            (" Bytes = 1-2 ", part(1, 3)),
            ("bytes=10-", Requested::Nothing),
            ("bytes=10-12", Requested::Nothing),
            ("bytes=99999999999999999999999999-", Requested::Nothing),
            ("bytes=-0", Requested::Nothing),
            ("bytes=5-3", Requested::Whole),
            ("bytes=-", Requested::Whole),
            ("bytes=", Requested::Whole),
            ("bytes", Requested::Whole),
            ("bytes=a-b", Requested::Whole),
            ("bytes=+1-2", Requested::Whole),
            ("bytes=1--2", Requested::Whole),
            ("bytes=0x1-2", Requested::Whole),
            ("bytes=0-1,3-4", Requested::Whole),
            ("lines=0-1", Requested::Whole),
            ("", Requested::Whole),
        ] {
            assert_eq!(parse(header, 10), wanted, "{header}");
        }
        for header in ["bytes=0-", "bytes=0-0", "bytes=-1"] {
            assert_eq!(parse(header, 0), Requested::Nothing, "{header} of an empty file");
        }
    }
}
