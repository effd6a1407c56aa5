//! Reads and writes binary glTF 2.0 (.glb): the JSON, the binary chunk and its accessors, every index checked.

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

const MAGIC: u32 = 0x4654_6C67; // "glTF"
const CHUNK_JSON: u32 = 0x4E4F_534A;
const CHUNK_BIN: u32 = 0x004E_4942;
const FLOAT: u64 = 5126;
const UNSIGNED_BYTE: u64 = 5121;
const UNSIGNED_SHORT: u64 = 5123;
const UNSIGNED_INT: u64 = 5125;

/// A parsed .glb file.
pub(crate) struct Glb {
    /// The JSON chunk.
    pub json: Value,
    /// The binary chunk.
    pub bin: Vec<u8>,
}

impl Glb {
    /// Parses the container. Errors: not a glTF 2 binary, truncated chunks, broken JSON.
    pub(crate) fn parse(bytes: &[u8]) -> Result<Glb> {
        let word = |at: usize| -> Result<u32> {
            let four = bytes.get(at..at + 4).with_context(|| format!("GLB ends before byte {}", at + 4))?;
            Ok(u32::from_le_bytes(four.try_into().expect("four bytes")))
        };
        ensure!(word(0)? == MAGIC && word(4)? == 2, "not a binary glTF 2.0 file");
        let (mut json, mut bin, mut at) = (None, Vec::new(), 12);
        while at < bytes.len() {
            let (length, kind) = (word(at)? as usize, word(at + 4)?);
            let body = bytes.get(at + 8..at + 8 + length).with_context(|| format!("chunk at byte {at} is cut off"))?;
            match kind {
                CHUNK_JSON => json = Some(serde_json::from_slice(body).context("JSON chunk")?),
                CHUNK_BIN => bin = body.to_vec(),
                _ => {}
            }
            at += 8 + length;
        }
        Ok(Glb { json: json.context("GLB without a JSON chunk")?, bin })
    }

    /// The file's bytes; both chunks padded to four bytes as the format requires.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        let mut json = self.json.to_string().into_bytes();
        json.resize(json.len().next_multiple_of(4), b' ');
        let mut bin = self.bin.clone();
        bin.resize(bin.len().next_multiple_of(4), 0);
        let total = 12 + 8 + json.len() + 8 + bin.len();
        let mut out = Vec::with_capacity(total);
        for word in [MAGIC, 2, total as u32, json.len() as u32, CHUNK_JSON] {
            out.extend(word.to_le_bytes());
        }
        out.extend(json);
        out.extend((bin.len() as u32).to_le_bytes());
        out.extend(CHUNK_BIN.to_le_bytes());
        out.extend(bin);
        out
    }

    /// The array `name` of the JSON; empty if absent.
    pub(crate) fn list(&self, name: &str) -> &[Value] {
        self.json.get(name).and_then(Value::as_array).map_or(&[], Vec::as_slice)
    }

    /// The bytes of one buffer view.
    pub(crate) fn view(&self, index: usize) -> Result<&[u8]> {
        let view = self.list("bufferViews").get(index).with_context(|| format!("no bufferView {index}"))?;
        let start = number(view, "byteOffset").unwrap_or(0);
        let length = number(view, "byteLength").with_context(|| format!("bufferView {index} without byteLength"))?;
        let end = start.checked_add(length).context("bufferView overflows")?;
        self.bin.get(start..end).with_context(|| format!("bufferView {index} leaves the binary chunk"))
    }

    /// One accessor as numbers, row by row, with its components per row. Errors: sparse or strided accessors,
    /// normalised integers, data beyond the buffer view.
    pub(crate) fn accessor(&self, index: usize) -> Result<(Vec<f64>, usize)> {
        let accessor = self.list("accessors").get(index).with_context(|| format!("no accessor {index}"))?;
        ensure!(accessor.get("sparse").is_none(), "accessor {index} is sparse, which this reader does not know");
        let width = match accessor["type"].as_str() {
            Some("SCALAR") => 1,
            Some("VEC2") => 2,
            Some("VEC3") => 3,
            Some("VEC4") => 4,
            Some("MAT4") => 16,
            other => bail!("accessor {index} has the unknown type {other:?}"),
        };
        let kind = accessor["componentType"].as_u64().unwrap_or(0);
        let size = match kind {
            FLOAT | UNSIGNED_INT => 4,
            UNSIGNED_SHORT => 2,
            UNSIGNED_BYTE => 1,
            _ => bail!("accessor {index} has the unknown componentType {kind}"),
        };
        let normalized = accessor.get("normalized").and_then(Value::as_bool).unwrap_or(false);
        ensure!(!normalized, "accessor {index} is normalised, which this reader does not know");
        let view = number(accessor, "bufferView").with_context(|| format!("accessor {index} without bufferView"))?;
        let stride = number(&self.list("bufferViews").get(view).cloned().unwrap_or_default(), "byteStride");
        ensure!(stride.is_none_or(|s| s == width * size), "accessor {index} is interleaved");
        let count = number(accessor, "count").with_context(|| format!("accessor {index} without count"))?;
        let start = number(accessor, "byteOffset").unwrap_or(0);
        let length = count.checked_mul(width * size).context("accessor overflows")?;
        let bytes = self
            .view(view)?
            .get(start..start.saturating_add(length))
            .with_context(|| format!("accessor {index} ({count} rows) leaves bufferView {view}"))?;
        let numbers = bytes.chunks_exact(size).map(|c| match kind {
            FLOAT => f64::from(f32::from_le_bytes(c.try_into().expect("four bytes"))),
            UNSIGNED_INT => f64::from(u32::from_le_bytes(c.try_into().expect("four bytes"))),
            UNSIGNED_SHORT => f64::from(u16::from_le_bytes(c.try_into().expect("two bytes"))),
            _ => f64::from(c[0]),
        });
        Ok((numbers.collect(), width))
    }
}

/// A non-negative integer member of a JSON object.
pub(crate) fn number(value: &Value, name: &str) -> Option<usize> {
    value.get(name)?.as_u64().and_then(|n| usize::try_from(n).ok())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn tiny(count: usize) -> Glb {
        let bin: Vec<u8> = [1.0f32, 2.0, 3.0, 4.0, 5.0, 6.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        let json = json!({
            "asset": {"version": "2.0"},
            "bufferViews": [{"buffer": 0, "byteLength": 24}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}],
        });
        Glb { json, bin }
    }

    #[test]
    fn round_trip_keeps_the_numbers() {
        let again = Glb::parse(&tiny(2).to_bytes()).expect("parses");
        assert_eq!(again.accessor(0).expect("reads"), (vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0], 3));
    }

    #[test]
    fn accessors_cannot_leave_their_view() {
        for count in [3, usize::MAX / 2, usize::MAX] {
            assert!(tiny(count).accessor(0).is_err(), "{count} rows of 12 bytes do not fit into 24");
        }
        assert!(tiny(2).accessor(1).is_err(), "there is one accessor");
        let mut wild = tiny(2);
        wild.json["bufferViews"][0]["byteOffset"] = json!(u64::MAX);
        assert!(wild.accessor(0).is_err());
    }

    #[test]
    fn cut_files_are_errors() {
        let bytes = tiny(2).to_bytes();
        for length in [0, 3, 11, 15, 19, bytes.len() - 1] {
            let cut = Glb::parse(&bytes[..length]);
            assert!(cut.is_err(), "{length} bytes");
        }
    }
}
