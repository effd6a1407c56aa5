//! Paths as text: file names need not be UTF-8, and JSON, TOML and messages must be.

use serde::{Deserialize, Deserializer, Serializer};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Begins the text of a path that is not UTF-8; what follows has its bytes as `escaped` does.
const BYTES: &str = "%bytes:";

/// The path as text from which [`of_text`] makes the path again: itself where it is UTF-8.
pub fn to_text(path: &Path) -> String {
    match path.to_str() {
        Some(text) if !text.starts_with(BYTES) => text.to_owned(),
        _ => escaped(path).map_or_else(|| path.to_string_lossy().into_owned(), |text| format!("{BYTES}{text}")),
    }
}

/// The path of a text that [`to_text`] made.
pub fn of_text(text: &str) -> PathBuf {
    text.strip_prefix(BYTES).and_then(of_escaped).unwrap_or_else(|| PathBuf::from(text))
}

/// The path as a word of a command that a POSIX shell takes as it is: quoted where it must be.
pub fn in_command(path: &Path) -> String {
    let text = path.to_string_lossy();
    let plain = |c: char| c.is_alphanumeric() || "/._-+=:,@%".contains(c);
    let text = if text.starts_with('-') { format!("./{text}") } else { text.into_owned() };
    if !text.is_empty() && text.chars().all(plain) { text } else { format!("'{}'", text.replace('\'', r"'\''")) }
}

/// For `#[serde(with = "…::path_text")]`: text that parses to the same path.
pub fn serialize<S: Serializer>(path: &Path, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(&to_text(path))
}

/// The other way.
pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<PathBuf, D::Error> {
    Ok(of_text(&String::deserialize(from)?))
}

/// For `#[serde(serialize_with = "…::path_text::lossy")]`: text for people and machines that only show it.
pub fn lossy<S: Serializer>(path: &Path, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(&path.to_string_lossy())
}

/// A path in printable ASCII: other bytes, and `%`, as `%XX`. `None`: the system has no bytes of it.
pub(crate) fn escaped(path: &Path) -> Option<String> {
    #[cfg(unix)]
    let bytes = std::os::unix::ffi::OsStrExt::as_bytes(path.as_os_str());
    #[cfg(not(unix))]
    let text = path.to_str()?.replace('\\', "/");
    #[cfg(not(unix))]
    let bytes = text.as_bytes();
    let mut line = String::with_capacity(bytes.len());
    for &b in bytes {
        match b {
            b'%' | 0..b' ' | 127.. => line += &format!("%{b:02X}"),
            _ => line.push(char::from(b)),
        }
    }
    Some(line)
}

/// The path of a text that `escaped` made; `None`: it did not.
pub(crate) fn of_escaped(line: &str) -> Option<PathBuf> {
    let mut bytes = Vec::with_capacity(line.len());
    let mut rest = line.as_bytes();
    while let Some((&b, after)) = rest.split_first() {
        rest = after;
        if b != b'%' {
            bytes.push(b);
            continue;
        }
        let (code, after) = rest.split_at_checked(2)?;
        bytes.push(u8::from_str_radix(std::str::from_utf8(code).ok()?, 16).ok()?);
        rest = after;
    }
    #[cfg(unix)]
    let name: OsString = std::os::unix::ffi::OsStringExt::from_vec(bytes);
    #[cfg(not(unix))]
    let name: OsString = String::from_utf8(bytes).ok()?.into();
    Some(PathBuf::from(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_words_of_commands() {
        for (path, word) in [
            ("runs/a-1.s4d", "runs/a-1.s4d"),
            ("my take/ü", "'my take/ü'"),
            ("it's", r"'it'\''s'"),
            ("-x y", "'./-x y'"),
            ("", "''"),
            ("$(rm)", "'$(rm)'"),
        ] {
            assert_eq!(in_command(Path::new(path)), word);
        }
    }

    #[test]
    fn paths_round_trip() {
        let mut paths = vec![PathBuf::from("a b/100 %.png"), PathBuf::from("ü\n"), PathBuf::from("%bytes:x")];
        #[cfg(unix)]
        paths.push(PathBuf::from(<OsString as std::os::unix::ffi::OsStringExt>::from_vec(b"/t/f_\xff%.ply".to_vec())));
        for path in &paths {
            assert_eq!(&of_text(&to_text(path)), path);
            assert_eq!(of_escaped(&escaped(path).unwrap()).as_ref(), Some(path));
        }
        assert_eq!(to_text(&paths[0]), "a b/100 %.png");
        assert!(of_escaped("%zz").is_none() && of_escaped("a%f").is_none());
    }
}
