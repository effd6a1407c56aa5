//! NumPy's `.npy` arrays: any shape; f16/f32/f64, integers and bool; both byte orders; versions 1-3.
//!
//! Source: NumPy documentation, "NPY format" (numpy.lib.format). Structured and object arrays are refused: an object
//! array is a pickle, that is, a program.

use super::half::f16_to_f32;
use crate::{Error, ErrorKind, Result};
use std::io::Write;

/// First bytes of every file.
const MAGIC: &[u8; 6] = b"\x93NUMPY";
/// The writer pads its header so that the data begins at a multiple of this (NumPy's ARRAY_ALIGN).
const ALIGN: usize = 64;
/// Longest header that is accepted; NumPy itself refuses headers above 10,000 bytes.
const MAX_HEADER: usize = 1 << 16;
/// Longest array of an archive that is inflated, bytes: as long as a file may be that is not compressed.
const MAX_MEMBER: usize = 512 << 20;
/// Most axes; NumPy allows 64.
const MAX_AXES: usize = 64;

/// Numbers of an array, widened without loss to one of four types.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Values {
    /// u8 and bool (0 or 1 where the file keeps to its format).
    U8(Vec<u8>),
    /// All other integers.
    I64(Vec<i64>),
    /// f16 and f32.
    F32(Vec<f32>),
    /// f64.
    F64(Vec<f64>),
}

/// An array from a `.npy` file.
#[derive(Clone, Debug, PartialEq)]
pub struct Npy {
    /// Length of each axis; empty for a single number.
    pub shape: Vec<usize>,
    /// The numbers, row-major (last axis fastest), whatever order the file had.
    pub values: Values,
}

impl Npy {
    /// Reads an array. Bytes after the array are ignored, as NumPy does.
    ///
    /// Errors: not a `.npy` file, truncated, a shape larger than the data, or a type other than plain numbers.
    pub fn read(bytes: &[u8]) -> Result<Self> {
        let header = Header::read(bytes)?;
        let count = header.shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
        let size = header.kind.size();
        let have = bytes.len() - header.body;
        let Some(count) = count.filter(|&n| n.checked_mul(size).is_some_and(|b| b <= have)) else {
            return Err(broken(format!(
                "the array is cut short: shape {:?} of {size}-byte numbers does not fit the {have} bytes that follow",
                header.shape
            )));
        };
        let body = &bytes[header.body..header.body + count * size];
        let values = match header.kind {
            Kind::U8 => Values::U8(body.to_vec()),
            Kind::I8 => Values::I64(body.iter().map(|&b| i64::from(b as i8)).collect()),
            Kind::U16 => Values::I64(numbers(body, header.big, |b| u16::from_le_bytes(b).into())),
            Kind::I16 => Values::I64(numbers(body, header.big, |b| i16::from_le_bytes(b).into())),
            Kind::U32 => Values::I64(numbers(body, header.big, |b| u32::from_le_bytes(b).into())),
            Kind::I32 => Values::I64(numbers(body, header.big, |b| i32::from_le_bytes(b).into())),
            Kind::I64 => Values::I64(numbers(body, header.big, i64::from_le_bytes)),
            Kind::U64 => {
                let wide = numbers(body, header.big, u64::from_le_bytes);
                let narrow: Result<Vec<i64>, _> = wide.into_iter().map(i64::try_from).collect();
                Values::I64(narrow.map_err(|_| unsupported("an unsigned number is above 2^63"))?)
            }
            Kind::F16 => Values::F32(numbers(body, header.big, |b| f16_to_f32(u16::from_le_bytes(b)))),
            Kind::F32 => Values::F32(numbers(body, header.big, f32::from_le_bytes)),
            Kind::F64 => Values::F64(numbers(body, header.big, f64::from_le_bytes)),
        };
        let values = match values {
            v if !header.fortran => v,
            Values::U8(v) => Values::U8(row_major(&header.shape, &v)),
            Values::I64(v) => Values::I64(row_major(&header.shape, &v)),
            Values::F32(v) => Values::F32(row_major(&header.shape, &v)),
            Values::F64(v) => Values::F64(row_major(&header.shape, &v)),
        };
        Ok(Self { shape: header.shape, values })
    }

    /// Reads the array `name` of an `.npz` archive, as `numpy.savez` and `savez_compressed` write them.
    ///
    /// Errors: no zip archive, damaged, or without that array; those of [`read`](Self::read).
    pub fn read_member(archive: &[u8], name: &str) -> Result<Self> {
        let files = super::zip::Archive::open(archive)?;
        let file = files.file(&format!("{name}.npy"), MAX_MEMBER).ok_or_else(|| {
            let have: Vec<String> = files.names().iter().map(|n| n.trim_end_matches(".npy").to_owned()).collect();
            Error::input(format!("the archive has no array `{name}`, but {}", have.join(", ")))
                .remedy(format!("Save it with numpy.savez(path, {name}=...)"))
        })?;
        Self::read(&file?)
    }

    /// Number of elements.
    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        match &self.values {
            Values::U8(v) => v.len(),
            Values::I64(v) => v.len(),
            Values::F32(v) => v.len(),
            Values::F64(v) => v.len(),
        }
    }

    /// All numbers as f64 (exact but for integers above 2^53).
    pub fn to_f64(&self) -> Vec<f64> {
        match &self.values {
            Values::U8(v) => v.iter().map(|&x| x.into()).collect(),
            Values::I64(v) => v.iter().map(|&x| x as f64).collect(),
            Values::F32(v) => v.iter().map(|&x| x.into()).collect(),
            Values::F64(v) => v.clone(),
        }
    }

    /// All numbers as f32, rounded.
    pub fn to_f32(&self) -> Vec<f32> {
        match &self.values {
            Values::U8(v) => v.iter().map(|&x| x.into()).collect(),
            Values::I64(v) => v.iter().map(|&x| x as f32).collect(),
            Values::F32(v) => v.clone(),
            Values::F64(v) => v.iter().map(|&x| x as f32).collect(),
        }
    }
}

/// Writes arrays of f32 numbers as an .npz (what `np.savez` writes): names, shapes, row-major numbers.
///
/// Errors: more than 4 GiB; the sink's. Panics: as [`write_f32`].
pub fn write_archive(arrays: &[(&str, &[usize], &[f32])], out: &mut impl Write) -> Result<()> {
    let member = |(name, shape, data): &(&str, &[usize], &[f32])| {
        let mut bytes = Vec::new();
        write_f32(shape, data, &mut bytes).map(|()| (format!("{name}.npy"), bytes))
    };
    let members = arrays.iter().map(member).collect::<Result<Vec<_>>>()?;
    let files: Vec<(&str, &[u8])> = members.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice())).collect();
    super::zip::write(&files, 1, out)
}

/// Writes f32 numbers of any shape, row-major, as version 1 (what `np.save` writes).
///
/// Errors: the sink's. Panics: the shape does not hold `data.len()` numbers.
pub fn write_f32(shape: &[usize], data: &[f32], out: &mut impl Write) -> Result<()> {
    let count: usize = shape.iter().product();
    assert_eq!(count, data.len(), "an array of shape {shape:?} holds another count of numbers than were given");
    assert!(shape.len() <= MAX_AXES, "an array has at most {MAX_AXES} axes");
    // A tuple of one needs its comma in Python.
    let axes = match shape {
        [one] => format!("{one},"),
        _ => shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", "),
    };
    let mut dict = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({axes}), }}");
    let prefix = MAGIC.len() + 4;
    let total = (prefix + dict.len() + 1).next_multiple_of(ALIGN);
    dict.extend(std::iter::repeat_n(' ', total - prefix - dict.len() - 1));
    dict.push('\n');
    let length = u16::try_from(dict.len()).expect("64 axes fit in 64 KiB of header");
    let mut write = |bytes: &[u8]| out.write_all(bytes).map_err(|e| Error::io("the array could not be written", e));
    write(MAGIC)?;
    write(&[1, 0])?;
    write(&length.to_le_bytes())?;
    write(dict.as_bytes())?;
    let mut buffer = Vec::with_capacity(data.len().min(1 << 16) * 4);
    for chunk in data.chunks(1 << 16) {
        buffer.clear();
        buffer.extend(chunk.iter().flat_map(|x| x.to_le_bytes()));
        write(&buffer)?;
    }
    Ok(())
}

#[derive(Clone, Copy)]
enum Kind {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F16,
    F32,
    F64,
}

impl Kind {
    fn size(self) -> usize {
        match self {
            Kind::U8 | Kind::I8 => 1,
            Kind::U16 | Kind::I16 | Kind::F16 => 2,
            Kind::U32 | Kind::I32 | Kind::F32 => 4,
            Kind::U64 | Kind::I64 | Kind::F64 => 8,
        }
    }

    /// Big-endian and type of a NumPy descriptor such as `<f4`.
    fn parse(descr: &str) -> Result<(bool, Self)> {
        let (order, name) = match descr.as_bytes().first() {
            Some(b'<' | b'>' | b'=' | b'|') => descr.split_at(1),
            _ => ("=", descr),
        };
        let kind = match name {
            "u1" | "b1" | "?" => Kind::U8,
            "i1" => Kind::I8,
            "u2" => Kind::U16,
            "i2" => Kind::I16,
            "u4" => Kind::U32,
            "i4" => Kind::I32,
            "u8" => Kind::U64,
            "i8" => Kind::I64,
            "f2" => Kind::F16,
            "f4" => Kind::F32,
            "f8" => Kind::F64,
            _ => return Err(unsupported(format!("the array holds `{descr}`, not plain numbers"))),
        };
        Ok((order == ">", kind))
    }
}

struct Header {
    kind: Kind,
    big: bool,
    fortran: bool,
    shape: Vec<usize>,
    /// Offset of the numbers.
    body: usize,
}

impl Header {
    fn read(bytes: &[u8]) -> Result<Self> {
        if bytes.len() < 10 || &bytes[..6] != MAGIC {
            return Err(broken("this is not a NumPy array: it does not begin with \\x93NUMPY"));
        }
        let (length, start) = match (bytes[6], bytes.get(8..12)) {
            (1, _) => (usize::from(u16::from_le_bytes([bytes[8], bytes[9]])), 10),
            (2 | 3, Some(b)) => (u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize, 12),
            (2 | 3, None) => return Err(broken("the header is cut short")),
            (v, _) => return Err(unsupported(format!("NumPy format version {v} is not known"))),
        };
        if length > MAX_HEADER || length > bytes.len() - start {
            return Err(broken(format!("the header claims {length} bytes, which is more than there are or could be")));
        }
        let body = start + length;
        let Ok(text) = std::str::from_utf8(&bytes[start..body]) else {
            return Err(broken("the header is not text"));
        };
        let mut p = Parser { rest: text };
        let (mut kind, mut fortran, mut shape) = (None, None, None);
        p.expect('{')?;
        while !p.eat('}') {
            let key = p.string()?.to_owned();
            p.expect(':')?;
            match key.as_str() {
                "descr" => kind = Some(Kind::parse(p.string().map_err(|_| unsupported("the array is structured"))?)?),
                "fortran_order" => fortran = Some(p.boolean()?),
                "shape" => shape = Some(p.tuple()?),
                _ => return Err(broken(format!("the header has an unknown key `{key}`"))),
            }
            if !p.eat(',') {
                p.expect('}')?;
                break;
            }
        }
        let (Some((big, kind)), Some(fortran), Some(shape)) = (kind, fortran, shape) else {
            return Err(broken("the header lacks one of `descr`, `fortran_order` and `shape`"));
        };
        Ok(Self { kind, big, fortran, shape, body })
    }
}

/// Reads the Python literals of a header.
struct Parser<'a> {
    rest: &'a str,
}

impl<'a> Parser<'a> {
    fn eat(&mut self, c: char) -> bool {
        self.rest = self.rest.trim_start();
        match self.rest.strip_prefix(c) {
            Some(rest) => {
                self.rest = rest;
                true
            }
            None => false,
        }
    }

    fn expect(&mut self, c: char) -> Result<()> {
        if self.eat(c) { Ok(()) } else { Err(broken(format!("the header is malformed: `{c}` expected"))) }
    }

    fn string(&mut self) -> Result<&'a str> {
        for quote in ['\'', '"'] {
            if self.eat(quote) {
                let Some((text, rest)) = self.rest.split_once(quote) else { break };
                self.rest = rest;
                return Ok(text);
            }
        }
        Err(broken("the header is malformed: a string expected"))
    }

    fn boolean(&mut self) -> Result<bool> {
        self.rest = self.rest.trim_start();
        for (word, value) in [("True", true), ("False", false)] {
            if let Some(rest) = self.rest.strip_prefix(word) {
                self.rest = rest;
                return Ok(value);
            }
        }
        Err(broken("the header is malformed: True or False expected"))
    }

    fn tuple(&mut self) -> Result<Vec<usize>> {
        self.expect('(')?;
        let mut out = Vec::new();
        while !self.eat(')') {
            self.rest = self.rest.trim_start();
            let digits = self.rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(self.rest.len());
            let (number, rest) = self.rest.split_at(digits);
            let Ok(number) = number.parse() else {
                return Err(broken("the shape is not a list of sizes"));
            };
            // Python 2 wrote long integers as `3L`.
            self.rest = rest.strip_prefix('L').unwrap_or(rest);
            out.push(number);
            if out.len() > MAX_AXES {
                return Err(unsupported(format!("the array has more than {MAX_AXES} axes")));
            }
            if !self.eat(',') {
                self.expect(')')?;
                break;
            }
        }
        Ok(out)
    }
}

fn numbers<const N: usize, T>(body: &[u8], big: bool, of: impl Fn([u8; N]) -> T) -> Vec<T> {
    let (items, _) = body.as_chunks::<N>();
    let swapped = |mut b: [u8; N]| {
        b.reverse();
        b
    };
    if big { items.iter().map(|&b| of(swapped(b))).collect() } else { items.iter().map(|&b| of(b)).collect() }
}

/// Numbers in column-major order, put in row-major order.
fn row_major<T: Copy>(shape: &[usize], data: &[T]) -> Vec<T> {
    let mut index = vec![0; shape.len()];
    let mut out = Vec::with_capacity(data.len());
    for _ in 0..data.len() {
        let (mut at, mut stride) = (0, 1);
        for (i, n) in index.iter().zip(shape) {
            at += i * stride;
            stride *= n;
        }
        out.push(data[at]);
        for axis in (0..shape.len()).rev() {
            index[axis] += 1;
            if index[axis] < shape[axis] {
                break;
            }
            index[axis] = 0;
        }
    }
    out
}

fn broken(what: impl Into<String>) -> Error {
    Error::input(what).remedy("The file is damaged or not a .npy file; save it again with numpy.save")
}

fn unsupported(what: impl Into<String>) -> Error {
    Error::new(ErrorKind::Unsupported, what).remedy("Save it as a plain array, e.g. numpy.save(path, a.astype('f4'))")
}

#[cfg(test)]
mod tests;
