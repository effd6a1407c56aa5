//! Writing files so that no reader ever finds half of one.

use splat4d::format::playback::{EXTENSION, OLD_EXTENSION};
use splat4d::{Error, Result};
pub use splat4d_train::files::{open, read, read_text};
use splat4d_train::output::Staged;
use std::path::Path;

/// Remedy when a file cannot be written.
pub const WRITE_REMEDY: &str = "Check that the folder exists, that you may write there and that the disk is not full.";

/// Writes a file by [`Staged`]. Devices and pipes are written directly.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let out = Staged::new(path)?;
    let fail = |e| cannot_write(path, e);
    std::fs::write(out.path(), bytes).map_err(fail)?;
    out.keep()
}

/// Makes a folder and its parents.
pub fn make_folder(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path)
        .map_err(|e| Error::environment("the folder cannot be created", e).at(path.display()))
        .map_err(|e| {
            e.remedy("Choose another place with -o: one where you may write, below a folder and not below a file.")
        })
}

/// The error of a failed write.
pub fn cannot_write(path: &Path, error: std::io::Error) -> Error {
    Error::environment("cannot be written", error).at(path.display()).remedy(WRITE_REMEDY)
}

/// The error of a failed read.
pub fn cannot_read(path: &Path, error: std::io::Error) -> Error {
    Error::io("cannot be read", error).at(path.display()).remedy("Check that the file exists and may be read by you.")
}

/// Standard base64 (RFC 4648) with padding, for data URIs.
pub fn base64(bytes: &[u8]) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let word = chunk.iter().enumerate().fold(0u32, |w, (i, &b)| w | u32::from(b) << (16 - 8 * i));
        for i in 0..4 {
            let digit = ALPHABET[(word >> (18 - 6 * i) & 63) as usize];
            out.push(if i <= chunk.len() { digit as char } else { '=' });
        }
    }
    out
}

/// Distinguishes two contents, in 16 hexadecimal digits: FNV-1a, against mistakes and not against malice.
pub fn fingerprint(bytes: impl AsRef<[u8]>) -> String {
    const OFFSET: u64 = 0xcbf2_9ce4_8422_2325;
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    let h = bytes.as_ref().iter().fold(OFFSET, |h, b| (h ^ u64::from(*b)).wrapping_mul(PRIME));
    format!("{h:016x}")
}

/// `1.5 GiB` for people.
pub fn human_bytes(bytes: u64) -> String {
    const UNITS: [&str; 5] = ["B", "KiB", "MiB", "GiB", "TiB"];
    let mut value = bytes as f64;
    let mut unit = 0;
    while value >= 1024.0 && unit + 1 < UNITS.len() {
        value /= 1024.0;
        unit += 1;
    }
    if unit == 0 { format!("{bytes} B") } else { format!("{value:.1} {}", UNITS[unit]) }
}

/// Bytes from `512MiB`, `1.5G`, `800000000`. Both 1 MB and 1 MiB count 2²⁰ bytes: the difference never matters here.
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    let text = text.trim();
    let split = text.find(|c: char| !(c.is_ascii_digit() || c == '.')).unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let power = match unit.trim().to_ascii_lowercase().as_str() {
        "" | "b" => 0,
        "k" | "kb" | "kib" => 1,
        "m" | "mb" | "mib" => 2,
        "g" | "gb" | "gib" => 3,
        "t" | "tb" | "tib" => 4,
        _ => return Err(format!("unknown unit of memory `{unit}`; write for instance 512MiB or 1.5GiB")),
    };
    let value: f64 =
        number.parse().map_err(|_| format!("invalid size `{text}`; write for instance 512MiB or 1.5GiB"))?;
    let bytes = value * 1024f64.powi(power);
    if bytes < 1.0 || bytes > 2f64.powi(50) {
        return Err(format!("`{text}` is not between 1 byte and 1024 TiB"));
    }
    Ok(bytes as u64)
}

/// `1:23` or `1:02:03`.
pub fn human_seconds(seconds: f64) -> String {
    let s = seconds.max(0.0).round() as u64;
    if s >= 3600 {
        format!("{}:{:02}:{:02}", s / 3600, s / 60 % 60, s % 60)
    } else {
        format!("{}:{:02}", s / 60, s % 60)
    }
}

/// A choice for people: "a, b or c".
pub fn either(words: &[&str]) -> String {
    match words {
        [rest @ .., last] if !rest.is_empty() => format!("{} or {last}", rest.join(", ")),
        _ => words.concat(),
    }
}

/// `30,000`
pub fn grouped(n: usize) -> String {
    let digits = n.to_string();
    let mut out = String::new();
    for (i, c) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(c);
    }
    out
}

/// Whether a path is named as a playback file.
pub fn is_playback(path: &Path) -> bool {
    path.extension().is_some_and(|e| [EXTENSION, OLD_EXTENSION].iter().any(|known| e.eq_ignore_ascii_case(known)))
}

/// Whether a path is a pipe or a device, such as `/dev/stdout` or `/dev/null`: its name has no rules, and nothing is lost
/// when several outputs go there. Files in `/dev/shm` are files.
pub fn is_stream(path: &Path) -> bool {
    path.metadata().is_ok_and(|there| !there.is_file() && !there.is_dir())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_are_streams_and_files_are_not() {
        let folder = tempfile::tempdir().unwrap();
        assert!(!is_stream(folder.path()) && !is_stream(&folder.path().join("new.s4d")));
        // Also in `/dev/shm`, where scratch files often are.
        assert!(!is_stream(Path::new("/dev/shm/new.s4d")));
        #[cfg(unix)]
        assert!(is_stream(Path::new("/dev/null")));
    }

    #[test]
    fn base64_as_in_rfc_4648() {
        for (plain, coded) in [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")] {
            assert_eq!(base64(plain.as_bytes()), coded);
        }
    }

    #[test]
    fn sizes_and_numbers_are_read_and_written_for_people() {
        assert_eq!(parse_bytes("128MiB"), Ok(128 << 20));
        assert_eq!(parse_bytes("1.5 g"), Ok(3 << 29));
        assert_eq!(parse_bytes("1000"), Ok(1000));
        for bad in ["", "GiB", "1.2.3M", "-3M", "0", "5 parsecs", "1e9T"] {
            assert!(parse_bytes(bad).is_err(), "{bad}");
        }
        assert_eq!(human_bytes(3 << 29), "1.5 GiB");
        assert_eq!(human_seconds(3723.4), "1:02:03");
        assert_eq!((grouped(999), grouped(1234567)), ("999".into(), "1,234,567".into()));
    }

    #[test]
    fn choices_are_read_as_sentences() {
        assert_eq!([either(&["a"]), either(&["a", "b"]), either(&["a", "b", "c"])], ["a", "a or b", "a, b or c"]);
    }

    #[test]
    fn a_full_device_is_an_error_and_stays_a_device() {
        if !Path::new("/dev/full").exists() {
            return;
        }
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("out.png");
        std::os::unix::fs::symlink("/dev/full", &link).unwrap();
        let message = write(&link, b"pixels").unwrap_err().to_string();
        assert!(message.contains("out.png") && message.contains("disk"), "{message}");
        assert!(!Path::new("/dev/full").metadata().unwrap().is_file());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing half-written stays");
    }
}
