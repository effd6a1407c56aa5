//! The safetensors container: named arrays of plain numbers behind a JSON header.
//!
//! Layout: u64 little-endian header length, JSON `{"name": {"dtype", "shape", "data_offsets"}, "__metadata__": {..}}`,
//! then the arrays one behind the other without holes. Source: github.com/huggingface/safetensors, section "Format".
//!
//! Why not the `safetensors` crate (0.8.0, Apache-2.0, bounds-checked and sound when read): it keeps metadata in a
//! `HashMap`, so that the same scene gives files of different bytes (15 kinds in 20 writes of four keys), while our
//! runs must repeat byte for byte; it accepts a duplicate name silently; and its errors do not name the array.

use crate::{Error, ErrorKind, Result};
use flate2::Crc;
use serde::de::{Deserialize, Deserializer, MapAccess, Visitor};
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::Write;

/// Longest header that is accepted, as in the reference implementation.
const MAX_HEADER: usize = 100_000_000;
/// The header's key for free text.
const METADATA: &str = "__metadata__";
/// The metadata's key for checksums: JSON, a CRC-32 in hexadecimal for the bytes of every array, and under the empty
/// name for all other metadata. Other readers pass over it.
const CHECKSUMS: &str = "splat4d-crc32";
/// The header is padded with spaces to a multiple of this, so that the first array is aligned.
const ALIGN: usize = 8;

macro_rules! dtypes {
    ($($(#[$doc:meta])* $name:ident $text:literal $size:literal;)*) => {
        /// Element type of an array; names and sizes as in the format.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[non_exhaustive]
        pub(crate) enum Dtype { $($(#[$doc])* $name,)* }

        impl Dtype {
            /// The name in the header.
            pub(crate) fn name(self) -> &'static str {
                match self { $(Dtype::$name => $text,)* }
            }

            /// Bytes a number.
            pub(crate) fn size(self) -> usize {
                match self { $(Dtype::$name => $size,)* }
            }

            fn parse(text: &str) -> Option<Self> {
                match text { $($text => Some(Dtype::$name),)* _ => None }
            }
        }
    };
}

dtypes! {
    /// One byte, 0 or 1.
    Bool "BOOL" 1;
    /// Unsigned 8 bits.
    U8 "U8" 1;
    /// Signed 8 bits.
    I8 "I8" 1;
    /// Unsigned 16 bits.
    U16 "U16" 2;
    /// Signed 16 bits.
    I16 "I16" 2;
    /// IEEE binary16.
    F16 "F16" 2;
    /// The upper half of an f32.
    BF16 "BF16" 2;
    /// Unsigned 32 bits.
    U32 "U32" 4;
    /// Signed 32 bits.
    I32 "I32" 4;
    /// IEEE binary32.
    F32 "F32" 4;
    /// Unsigned 64 bits.
    U64 "U64" 8;
    /// Signed 64 bits.
    I64 "I64" 8;
    /// IEEE binary64.
    F64 "F64" 8;
}

/// A named array, read from a file (its bytes borrowed) or about to be written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tensor<'a> {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Cow<'a, [u8]>,
}

macro_rules! typed {
    ($make:ident, $as:ident, $t:ty, $dtype:ident) => {
        #[doc = concat!("An array of ", stringify!($t), ", row-major. Panics: the shape holds another count.")]
        pub fn $make(name: impl Into<String>, shape: &[usize], data: &'a [$t]) -> Self {
            let bytes = if cfg!(target_endian = "little") {
                Cow::Borrowed(bytemuck::cast_slice(data))
            } else {
                Cow::Owned(data.iter().flat_map(|x| x.to_le_bytes()).collect())
            };
            Self::new(name, Dtype::$dtype, shape, bytes)
        }

        #[doc = concat!("The numbers, bit for bit. Errors: the array is not of ", stringify!($t), ".")]
        pub fn $as(&self) -> Result<Vec<$t>> {
            self.must_be(Dtype::$dtype)?;
            Ok(self.bytes.as_chunks().0.iter().map(|&b| <$t>::from_le_bytes(b)).collect())
        }
    };
}

impl<'a> Tensor<'a> {
    /// An array from little-endian bytes, row-major. Panics: the shape holds another count of bytes.
    pub(crate) fn new(name: impl Into<String>, dtype: Dtype, shape: &[usize], bytes: Cow<'a, [u8]>) -> Self {
        let name = name.into();
        let size = shape.iter().product::<usize>() * dtype.size();
        assert_eq!(size, bytes.len(), "array {name} of shape {shape:?} needs another number of bytes");
        Self { name, dtype, shape: shape.to_vec(), bytes }
    }

    typed!(f32, as_f32, f32, F32);
    typed!(f64, as_f64, f64, F64);
    typed!(u32, as_u32, u32, U32);
    typed!(u64, as_u64, u64, U64);
    typed!(i64, as_i64, i64, I64);

    /// The name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The element type.
    pub(crate) fn dtype(&self) -> Dtype {
        self.dtype
    }

    /// Length of each axis; empty for a single number.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The numbers' little-endian bytes, row-major; unaligned.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    fn must_be(&self, dtype: Dtype) -> Result<()> {
        if self.dtype == dtype {
            return Ok(());
        }
        Err(self.wrong(format!("holds {}, but {} is needed", self.dtype.name(), dtype.name())))
    }

    fn wrong(&self, what: String) -> Error {
        Error::input(format!("array `{}` {what}", self.name)).remedy("The file was written for another purpose")
    }
}

/// A file's arrays and metadata.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SafeTensors<'a> {
    metadata: BTreeMap<String, String>,
    tensors: BTreeMap<String, Tensor<'a>>,
}

impl<'a> SafeTensors<'a> {
    /// Reads a file; the arrays borrow its bytes.
    ///
    /// Errors: a header that is too long, not JSON or names an array twice; an unknown type; a shape that does not
    /// match its bytes; arrays that overlap, leave holes, or do not end where the file ends; an array or metadata that
    /// is not what a checksum was made of.
    pub fn read(bytes: &'a [u8]) -> Result<Self> {
        let Some((length, rest)) = bytes.split_first_chunk::<8>() else {
            return Err(broken("the file is shorter than its header's length"));
        };
        let length = u64::from_le_bytes(*length);
        let Some(length) = usize::try_from(length).ok().filter(|&n| n <= MAX_HEADER.min(rest.len())) else {
            return Err(broken(format!(
                "the header claims {length} bytes, which is more than the {} that follow or the limit of {MAX_HEADER}",
                rest.len()
            )));
        };
        let (header, data) = rest.split_at(length);
        let mut header: Header =
            serde_json::from_slice(header).map_err(|e| broken(format!("the header cannot be read: {e}")))?;
        header.entries.sort_by_key(|(_, e)| e.data_offsets);
        let mut end = 0;
        let mut tensors = BTreeMap::new();
        for (name, entry) in header.entries {
            let tensor = entry.view(&name, data, &mut end)?;
            tensors.insert(name, tensor);
        }
        if end != data.len() {
            return Err(broken(format!(
                "the arrays end at byte {end} of the data, but there are {} bytes",
                data.len()
            )));
        }
        let mut file = Self { metadata: header.metadata, tensors };
        if let Some(sums) = file.metadata.remove(CHECKSUMS) {
            file.verify(&sums)?;
        }
        Ok(file)
    }

    /// Compares with the checksums that the file states.
    fn verify(&self, sums: &str) -> Result<()> {
        let sums: BTreeMap<String, String> =
            serde_json::from_str(sums).map_err(|e| broken(format!("its checksums cannot be read: {e}")))?;
        for (name, sum) in sums {
            let found = match name.as_str() {
                "" => metadata_sum(&self.metadata),
                _ => checksum(self.tensor(&name)?.bytes()),
            };
            if hexadecimal(found) != sum {
                let what = if name.is_empty() { "the metadata".to_owned() } else { format!("array `{name}`") };
                return Err(Error::input(format!(
                    "{what} is damaged: its checksum is another than when it was written"
                ))
                .remedy(format!(
                    "Copy the file again. A program that changes it on purpose leaves `{CHECKSUMS}` out of the metadata"
                )));
            }
        }
        Ok(())
    }

    /// The free text of the header.
    pub fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// All arrays, by name.
    pub fn tensors(&self) -> impl ExactSizeIterator<Item = &Tensor<'a>> {
        self.tensors.values()
    }

    /// The array of that name, if there is one.
    pub fn get(&self, name: &str) -> Option<&Tensor<'a>> {
        self.tensors.get(name)
    }

    /// The array of that name. Errors: there is none.
    pub fn tensor(&self, name: &str) -> Result<&Tensor<'a>> {
        self.get(name).ok_or_else(|| {
            Error::input(format!("array `{name}` is missing")).remedy("The file was written for another purpose")
        })
    }
}

/// Writes a file: the same arrays and metadata always give the same bytes.
///
/// Arrays are ordered by the size of their numbers, largest first, so that every array is aligned, then by name: how
/// the tables were made does not matter.
///
/// Errors: the sink's. Panics: two arrays of one name, or one called `__metadata__`.
pub fn write(tensors: &[Tensor<'_>], metadata: &BTreeMap<String, String>, out: &mut impl Write) -> Result<()> {
    let mut order: Vec<&Tensor<'_>> = tensors.iter().collect();
    order.sort_by(|a, b| b.dtype.size().cmp(&a.dtype.size()).then_with(|| a.name.cmp(&b.name)));
    let metadata = &sealed(metadata, order.iter().map(|t| (t.name.clone(), checksum(&t.bytes))));
    let head = header(order.iter().map(|t| (t.name.as_str(), t.dtype, t.shape.as_slice())), metadata);
    let mut write =
        |bytes: &[u8]| out.write_all(bytes).map_err(|e| Error::environment("the arrays could not be written", e));
    write(&head)?;
    order.iter().try_for_each(|t| write(&t.bytes))
}

/// The CRC-32 of an array's bytes.
pub(crate) fn checksum(bytes: &[u8]) -> u32 {
    let mut crc = Crc::new();
    crc.update(bytes);
    crc.sum()
}

fn metadata_sum(metadata: &BTreeMap<String, String>) -> u32 {
    let mut crc = Crc::new();
    metadata.iter().flat_map(|(k, v)| [k, v]).for_each(|text| {
        crc.update(&(text.len() as u64).to_le_bytes());
        crc.update(text.as_bytes());
    });
    crc.sum()
}

fn hexadecimal(sum: u32) -> String {
    format!("{sum:08x}")
}

/// Metadata with the checksums of a file's arrays and of itself; a file without metadata has none.
pub(crate) fn sealed(
    metadata: &BTreeMap<String, String>,
    sums: impl Iterator<Item = (String, u32)>,
) -> BTreeMap<String, String> {
    let mut out = metadata.clone();
    if !metadata.is_empty() {
        let own = (String::new(), metadata_sum(metadata));
        let all: BTreeMap<String, String> = sums.chain([own]).map(|(name, sum)| (name, hexadecimal(sum))).collect();
        out.insert(CHECKSUMS.into(), serde_json::to_string(&all).expect("a map of strings is JSON"));
    }
    out
}

/// A file whose checksums are not verified, for tests of the other checks.
#[cfg(test)]
pub(crate) fn unsealed(mut bytes: Vec<u8>) -> Vec<u8> {
    let key = CHECKSUMS.as_bytes();
    let at = bytes.windows(key.len()).position(|w| w == key).expect("it has checksums");
    bytes[at + key.len() - 1] = b'x';
    bytes
}

/// Length and header of a file of these arrays (name, type, shape) in this order.
///
/// Panics: two arrays of one name, or one called `__metadata__`.
pub(crate) fn header<'a>(
    order: impl Iterator<Item = (&'a str, Dtype, &'a [usize])>,
    metadata: &BTreeMap<String, String>,
) -> Vec<u8> {
    let mut names = BTreeSet::from([METADATA]);
    let mut header = String::from("{");
    if !metadata.is_empty() {
        let text = serde_json::to_string(metadata).expect("a map of strings is JSON");
        write!(header, "\"{METADATA}\":{text}").expect("a string grows");
    }
    let mut begin = 0;
    for (name, dtype, shape) in order {
        assert!(names.insert(name), "two arrays of one file are called {name}");
        let end = begin + shape.iter().product::<usize>() * dtype.size();
        let comma = if header.len() > 1 { "," } else { "" };
        let name = serde_json::to_string(name).expect("a string is JSON");
        let shape = serde_json::to_string(shape).expect("a list of integers is JSON");
        let dtype = dtype.name();
        write!(header, "{comma}{name}:{{\"dtype\":\"{dtype}\",\"shape\":{shape},\"data_offsets\":[{begin},{end}]}}")
            .expect("a string grows");
        begin = end;
    }
    header.push('}');
    let padding = header.len().next_multiple_of(ALIGN) - header.len();
    header.extend(std::iter::repeat_n(' ', padding));
    [&(header.len() as u64).to_le_bytes(), header.as_bytes()].concat()
}

/// The header of the file; a list, so that a name that occurs twice is seen.
#[derive(Default)]
struct Header {
    metadata: BTreeMap<String, String>,
    entries: Vec<(String, Entry)>,
}

#[derive(serde::Deserialize)]
struct Entry {
    dtype: String,
    shape: Vec<usize>,
    data_offsets: (usize, usize),
}

impl Entry {
    /// The array; `end` is where the one before it ended, and is moved on.
    fn view<'a>(&self, name: &str, data: &'a [u8], end: &mut usize) -> Result<Tensor<'a>> {
        let Some(dtype) = Dtype::parse(&self.dtype) else {
            return Err(Error::new(ErrorKind::Unsupported, format!("array `{name}` holds the type `{}`", self.dtype))
                .remedy("Convert it to F32, F16 or an integer type"));
        };
        let (first, last) = self.data_offsets;
        if first != *end {
            return Err(broken(format!("array `{name}` begins at byte {first}, but the one before it ends at {end}")));
        }
        let Some(bytes) = data.get(first..last) else {
            return Err(broken(format!("array `{name}` claims bytes {first}..{last} of {}", data.len())));
        };
        let size = self.shape.iter().try_fold(dtype.size(), |n, &d| n.checked_mul(d));
        if size != Some(bytes.len()) {
            return Err(broken(format!(
                "array `{name}` of shape {:?} and type {} claims {} bytes",
                self.shape,
                self.dtype,
                bytes.len()
            )));
        }
        *end = last;
        Ok(Tensor { name: name.to_owned(), dtype, shape: self.shape.clone(), bytes: Cow::Borrowed(bytes) })
    }
}

impl<'de> Deserialize<'de> for Header {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct HeaderVisitor;
        impl<'de> Visitor<'de> for HeaderVisitor {
            type Value = Header;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("an object of arrays")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Header, A::Error> {
                let mut header = Header::default();
                let mut names = BTreeSet::new();
                while let Some(name) = map.next_key::<String>()? {
                    if !names.insert(name.clone()) {
                        return Err(serde::de::Error::custom(format_args!("`{name}` is a duplicate")));
                    }
                    if name == METADATA {
                        header.metadata = map.next_value()?;
                    } else {
                        header.entries.push((name, map.next_value()?));
                    }
                }
                Ok(header)
            }
        }
        deserializer.deserialize_map(HeaderVisitor)
    }
}

fn broken(what: impl Into<String>) -> Error {
    Error::input(what).remedy("The file is damaged, cut short or not a safetensors file; copy or export it again")
}

#[cfg(test)]
mod tests;
