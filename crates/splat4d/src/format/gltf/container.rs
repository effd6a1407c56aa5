//! The two containers of glTF: `.glb` (chunks) and `.gltf` (JSON with data URIs or files next to it).

use super::{MAGIC, damaged, unsupported};
use crate::format::base64;
use crate::format::bytes::Cursor;
use crate::{Error, Result};
use serde_json::{Value, json};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::Write;

/// Version of the container and of glTF.
const VERSION: u32 = 2;
/// Chunk types of a .glb.
const JSON: u32 = 0x4E4F_534A;
const BIN: u32 = 0x004E_4942;
/// Bytes of a .glb's header, and of a chunk's.
const HEADER: usize = 12;
const CHUNK: usize = 8;
/// Chunks begin at multiples of this.
const ALIGN: usize = 4;
/// Beginning of the data URI of a buffer, up to its media type.
const DATA: &str = "data:";
/// Prefix of a data URI.
const BASE64: &str = ";base64,";
/// Media type of buffers (glTF 2.0, 3.6.1.1).
const MEDIA: &str = "data:application/octet-stream;base64,";

/// A file's JSON and its buffers.
#[derive(Debug, Default)]
pub(super) struct File<'a> {
    pub(super) json: Value,
    /// In the order of `buffers`; of a .glb the first may be the binary chunk.
    pub(super) buffers: Vec<Cow<'a, [u8]>>,
    /// Length of the file or files, bytes.
    pub(super) size: usize,
}

/// Whether bytes are a .gltf: an object with `asset`, which glTF demands and other JSON files lack.
pub(super) fn is_text(bytes: &[u8]) -> bool {
    let text = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes).trim_ascii_start();
    text.starts_with(b"{") && text[1..].trim_ascii_start().starts_with(b"\"") && contains(text, b"\"asset\"")
}

/// Whether the JSON of a .glb names an extension.
pub(super) fn names(bytes: &[u8], extension: &str) -> bool {
    let mut c = Cursor::new(bytes.get(HEADER..).unwrap_or_default(), ".glb file");
    let text = c.u32().and_then(|length| {
        c.u32()?;
        c.take(length as usize)
    });
    text.is_ok_and(|text| contains(text, format!("\"{extension}\"").as_bytes()))
}

fn contains(text: &[u8], word: &[u8]) -> bool {
    text.windows(word.len()).any(|w| w == word)
}

fn parse(text: &[u8]) -> Result<Value> {
    serde_json::from_slice(text).map_err(|e| damaged(format!("its JSON: {e}")))
}

impl<'a> File<'a> {
    /// A .glb. Errors: cut short, another version, no JSON.
    pub(super) fn binary(bytes: &'a [u8]) -> Result<Self> {
        let mut c = Cursor::new(bytes, ".glb file");
        if c.take(MAGIC.len())? != MAGIC {
            return Err(damaged("it does not begin with `glTF`"));
        }
        let version = c.u32()?;
        if version != VERSION {
            return Err(unsupported(format!("the file has version {version} of glTF, not {VERSION}")));
        }
        c.u32()?;
        let (mut at, mut json, mut bin) = (HEADER, None, None);
        while at + CHUNK <= bytes.len() {
            let mut c = Cursor::new(&bytes[at..], ".glb file");
            let (length, kind) = (c.u32()? as usize, c.u32()?);
            let chunk = c.take(length)?;
            match kind {
                JSON if json.is_none() => json = Some(parse(chunk)?),
                BIN if bin.is_none() => bin = Some(chunk),
                _ => {}
            }
            at += CHUNK + length.next_multiple_of(ALIGN);
        }
        let json = json.ok_or_else(|| damaged("it has no JSON"))?;
        static NONE: BTreeMap<String, Vec<u8>> = BTreeMap::new();
        Self::with(json, bin, &NONE, bytes.len())
    }

    /// A .gltf with the files that its buffers name ([`buffers`]). Errors: not JSON, another version, a missing file.
    pub(super) fn text(bytes: &[u8], files: &'a BTreeMap<String, Vec<u8>>) -> Result<Self> {
        let text = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
        let json = parse(text)?;
        let version = json["asset"]["version"].as_str().unwrap_or_default();
        if !version.starts_with("2.") {
            return Err(unsupported(format!("the file has version `{version}` of glTF, not 2.0")));
        }
        let size = bytes.len() + files.values().map(Vec::len).sum::<usize>();
        Self::with(json, None, files, size)
    }

    fn with(json: Value, bin: Option<&'a [u8]>, files: &'a BTreeMap<String, Vec<u8>>, size: usize) -> Result<Self> {
        let mut buffers = Vec::new();
        for (i, buffer) in json["buffers"].as_array().into_iter().flatten().enumerate() {
            buffers.push(match (buffer["uri"].as_str(), bin) {
                (None, Some(bin)) if i == 0 => Cow::Borrowed(bin),
                (None, _) => Cow::Borrowed(&[][..]),
                (Some(uri), _) if uri.starts_with(DATA) => Cow::Owned(data(uri)?),
                (Some(uri), _) => Cow::Borrowed(&files.get(uri).ok_or_else(|| elsewhere(uri))?[..]),
            });
        }
        Ok(Self { json, buffers, size })
    }

    /// Writes a .glb with the first buffer as its chunk. Errors: beyond 4 GiB; the sink's.
    pub(super) fn write_binary(mut self, out: &mut dyn Write) -> Result<()> {
        let bin = self.only_buffer();
        let mut text = self.json.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(ALIGN), b' ');
        let padding = vec![0; bin.len().next_multiple_of(ALIGN) - bin.len()];
        let total = HEADER + CHUNK + text.len() + CHUNK + bin.len() + padding.len();
        let Ok(total) = u32::try_from(total) else {
            return Err(Error::input(format!("the .glb would have {total} bytes, and it can have no more than 4 GiB"))
                .remedy("Lower the degree of spherical harmonics (--sh), or write .ply."));
        };
        let head = |length: usize, kind: u32| [(length as u32).to_le_bytes(), kind.to_le_bytes()].concat();
        let start = [MAGIC, VERSION.to_le_bytes(), total.to_le_bytes()].concat();
        let parts = [&start[..], &head(text.len(), JSON), &text, &head(bin.len() + padding.len(), BIN), &bin, &padding];
        parts.iter().try_for_each(|part| out.write_all(part)).map_err(not_written)
    }

    /// Writes a .gltf with the first buffer as a data URI. Errors: the sink's.
    pub(super) fn write_text(mut self, out: &mut dyn Write) -> Result<()> {
        let bin = self.only_buffer();
        let mut uri = String::with_capacity(MEDIA.len() + bin.len().div_ceil(3) * 4);
        uri.push_str(MEDIA);
        base64::encode(&bin, &mut uri);
        self.json["buffers"][0]["uri"] = json!(uri);
        serde_json::to_writer(&mut *out, &self.json).map_err(|e| not_written(e.into()))
    }

    /// The only buffer of a file that is written; the JSON states its length.
    fn only_buffer(&mut self) -> Cow<'a, [u8]> {
        assert!(self.buffers.len() == 1, "a file is written with one buffer");
        let bin = self.buffers.remove(0);
        self.json["buffers"] = json!([{"byteLength": bin.len()}]);
        bin
    }
}

fn not_written(e: std::io::Error) -> Error {
    Error::io("the Gaussians could not be written", e)
}

/// Names of the files next to a .gltf that its buffers need. Errors: not JSON.
pub(super) fn buffers(text: &[u8]) -> Result<Vec<String>> {
    let json = parse(text.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(text))?;
    let uris = json["buffers"].as_array().into_iter().flatten().filter_map(|b| b["uri"].as_str());
    Ok(uris.filter(|uri| !uri.starts_with(DATA)).map(str::to_owned).collect())
}

/// The bytes of a data URI.
fn data(uri: &str) -> Result<Vec<u8>> {
    let (_, text) = uri.split_once(BASE64).ok_or_else(|| damaged("a data URI is not in base64"))?;
    base64::decode(text.as_bytes()).ok_or_else(|| damaged("a data URI contains characters outside base64"))
}

fn elsewhere(uri: &str) -> Error {
    let short: String = uri.chars().take(80).collect();
    Error::input(format!("its Gaussians lie in another file, `{short}`"))
        .remedy("Give the .gltf in its folder, not alone, or export a .glb.")
}
