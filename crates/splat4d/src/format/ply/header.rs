//! The text header of a PLY file.
//!
//! Source: Greg Turk, "The PLY Polygon File Format", 1994; the sized type names (`float32`) as later tools write them.

use crate::{Error, ErrorKind, Result};
use std::borrow::Cow;

/// Longest header that is accepted. The header of a degree-3 Gaussian file has 1.5 kB.
const MAX_HEADER: usize = 1 << 20;
/// UTF-8's byte-order mark, with which editors begin text files.
const BOM: &[u8] = b"\xef\xbb\xbf";
/// Lines that carry no information about the body.
const COMMENTS: [&str; 2] = ["comment", "obj_info"];

/// Whether bytes begin as a PLY file does.
pub(super) fn is_ply(bytes: &[u8]) -> bool {
    bytes.strip_prefix(BOM).unwrap_or(bytes).starts_with(b"ply")
}

/// Encoding of the body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    Little,
    Big,
}

/// A number's type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    pub(super) fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return None,
        })
    }
}

/// One number of a row, or a list (its length's type, then its items').
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Scalar(Scalar),
    List(Scalar, Scalar),
}

/// A named part of a row.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Property {
    pub(super) name: String,
    pub(super) kind: Kind,
}

/// A table of the file. `count` is what the header claims; nothing may be allocated by it before it was compared with
/// the bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) count: usize,
    pub(super) properties: Vec<Property>,
}

impl Element {
    /// The index of a scalar property.
    pub(super) fn find(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name && matches!(p.kind, Kind::Scalar(_)))
    }

    /// The number that represents full colour in a property: 1 in floating point (no other range is written), the
    /// type's range in integers.
    pub(super) fn white(&self, property: usize) -> f64 {
        match self.properties[property].kind {
            Kind::Scalar(Scalar::F32 | Scalar::F64) => 1.0,
            Kind::Scalar(Scalar::U16 | Scalar::I16) => 65_535.0,
            _ => 255.0,
        }
    }
}

/// Contents of the header.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Header {
    pub(super) encoding: Encoding,
    pub(super) comments: Vec<String>,
    pub(super) elements: Vec<Element>,
    /// Offset of the body.
    pub(super) body: usize,
}

impl Header {
    pub(super) fn read(bytes: &[u8]) -> Result<Self> {
        let bom = if bytes.starts_with(BOM) { BOM.len() } else { 0 };
        let mut lines = Lines { bytes: &bytes[..bytes.len().min(MAX_HEADER)], at: bom };
        if lines.next() != Some(Ok("ply".into())) {
            return Err(broken("this is not a PLY file: it does not begin with a line `ply`"));
        }
        let mut header = Self { encoding: Encoding::Ascii, comments: Vec::new(), elements: Vec::new(), body: 0 };
        let mut has_format = false;
        for number in 2.. {
            let line = match lines.next() {
                None => return Err(broken("the header has no `end_header` line")),
                Some(Err(())) => return Err(broken("the header is not text").at(format_args!("line {number}"))),
                Some(Ok(line)) => line,
            };
            let line = &*line;
            let at = |e: Error| e.at(format_args!("header line {number}"));
            let mut words = line.split_ascii_whitespace();
            match words.next() {
                Some("end_header") => break,
                Some("format") => {
                    header.encoding = match words.next() {
                        Some("ascii") => Encoding::Ascii,
                        Some("binary_little_endian") => Encoding::Little,
                        Some("binary_big_endian") => Encoding::Big,
                        _ => return Err(at(broken(format!("the format `{line}` is not known")))),
                    };
                    has_format = true;
                }
                Some("comment" | "obj_info") => {
                    header.comments.push(line.split_once(' ').map_or("", |(_, text)| text).to_owned());
                }
                Some("element") => header.elements.push(element(line, words).map_err(at)?),
                Some("property") => {
                    let Some(element) = header.elements.last_mut() else {
                        return Err(at(broken("a property precedes the first element")));
                    };
                    element.properties.push(property(line, words).map_err(at)?);
                }
                None => {}
                Some(other) => return Err(at(broken(format!("the keyword `{other}` is not known")))),
            }
        }
        if !has_format {
            return Err(broken("the header has no `format` line"));
        }
        header.body = lines.at;
        if let Some(name) = repeated(header.elements.iter().map(|e| &*e.name)) {
            return Err(broken(format!("there are two elements called `{name}`")));
        }
        for element in &header.elements {
            if let Some(name) = repeated(element.properties.iter().map(|p| &*p.name)) {
                return Err(broken(format!("the element `{}` has two properties called `{name}`", element.name)));
            }
        }
        Ok(header)
    }
}

/// A name that occurs twice. By sorting, since a false header may hold a hundred thousand.
fn repeated<'a>(names: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let mut names: Vec<&str> = names.collect();
    names.sort_unstable();
    names.windows(2).find(|w| w[0] == w[1]).map(|w| w[0])
}

fn element<'a>(line: &str, mut words: impl Iterator<Item = &'a str>) -> Result<Element> {
    let (Some(name), Some(count), None) = (words.next(), words.next(), words.next()) else {
        return Err(broken(format!("`{line}` should be `element <name> <count>`")));
    };
    let Ok(count) = count.parse::<usize>() else {
        return Err(broken(format!("the element `{name}` has the count `{count}`, which is not a number of rows")));
    };
    Ok(Element { name: name.to_owned(), count, properties: Vec::new() })
}

fn property<'a>(line: &str, mut words: impl Iterator<Item = &'a str>) -> Result<Property> {
    let malformed = || broken(format!("`{line}` should be `property <type> <name>`"));
    let scalar = |word: Option<&str>| {
        let word = word.ok_or_else(malformed)?;
        Scalar::parse(word).ok_or_else(|| {
            Error::new(ErrorKind::Unsupported, format!("the type `{word}` is not known"))
                .remedy("PLY has char, short, int, their unsigned kinds, float and double")
        })
    };
    let first = words.next();
    let kind = if first == Some("list") {
        Kind::List(scalar(words.next())?, scalar(words.next())?)
    } else {
        Kind::Scalar(scalar(first)?)
    };
    let (Some(name), None) = (words.next(), words.next()) else { return Err(malformed()) };
    Ok(Property { name: name.to_owned(), kind })
}

/// Lines that end with LF or CR LF; the last one must end too.
struct Lines<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Iterator for Lines<'a> {
    type Item = Result<Cow<'a, str>, ()>;

    fn next(&mut self) -> Option<Self::Item> {
        let rest = &self.bytes[self.at..];
        let end = rest.iter().position(|&b| b == b'\n')?;
        self.at += end + 1;
        let line = rest[..end].strip_suffix(b"\r").unwrap_or(&rest[..end]);
        let text = match std::str::from_utf8(line) {
            Ok(text) => Ok(text.into()),
            // Comments hold paths and names in whatever encoding the system had.
            Err(_) if COMMENTS.iter().any(|word| line.starts_with(word.as_bytes())) => {
                Ok(String::from_utf8_lossy(line))
            }
            Err(_) => Err(()),
        };
        Some(text)
    }
}

/// An error about a damaged file.
pub(super) fn broken(what: impl Into<String>) -> Error {
    Error::input(what).remedy("The file is damaged, cut short or not a PLY file; copy or export it again")
}
