//! Streamed SOG (PlayCanvas), version 1: `lod-meta.json` and a folder of SOG files for each part of each level of
//! detail.
//!
//! `filenames` are the `meta.json` of the parts, relative to the index; a leaf of `tree` names for each level (`lods`,
//! 0 is the finest) the `file` and the Gaussians `offset..offset + count` of it; `environment` is one more part.
//! Source: developer.playcanvas.com, "The Streamed SOG Format".

use super::damaged;
use crate::scene::{GEOMETRY, Params, SH};
use crate::{Error, ErrorKind, Result};
use serde_json::Value;
use std::collections::BTreeMap;
use std::ops::Range;

/// The name of the index.
pub const LEVELS: &str = "lod-meta.json";
/// The version this library reads.
const VERSION: u64 = 1;

/// The parts of a scene in its finest level.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Finest {
    /// `meta.json` of each part, relative to the index, and its Gaussians; none: all.
    pub pieces: Vec<(String, Option<Vec<Range<usize>>>)>,
    /// Levels that the scene has.
    pub levels: usize,
}

/// Reads the index. Errors: not JSON, another version, no parts.
pub fn finest(index: &[u8]) -> Result<Finest> {
    let index: Value = serde_json::from_slice(index).map_err(|e| damaged(format!("its {LEVELS} is not JSON: {e}")))?;
    let version = index["version"].as_u64().unwrap_or(VERSION);
    if version != VERSION {
        let what = format!("the scene has version {version} of streamed SOG, this splat4d reads version {VERSION}");
        return Err(Error::new(ErrorKind::Unsupported, what)
            .remedy("Install a newer splat4d, or convert the scene to .ply with splat-transform."));
    }
    let names: Vec<&str> = index["filenames"].as_array().into_iter().flatten().filter_map(Value::as_str).collect();
    let mut found: BTreeMap<usize, Vec<Range<usize>>> = BTreeMap::new();
    let mut nodes = vec![&index["tree"]];
    while let Some(node) = nodes.pop() {
        nodes.extend(node["children"].as_array().into_iter().flatten());
        let Some(lods) = node["lods"].as_object() else { continue };
        let level = |name: &String| name.parse::<u32>().unwrap_or(u32::MAX);
        let Some((_, lod)) = lods.iter().min_by_key(|(name, _)| level(name)) else { continue };
        let number = |key: &str| lod[key].as_u64().and_then(|n| usize::try_from(n).ok());
        let (Some(file), Some(offset), Some(count)) = (number("file"), number("offset"), number("count")) else {
            return Err(damaged(format!("a leaf of its {LEVELS} has no file, offset and count")));
        };
        let end = offset.checked_add(count).filter(|_| file < names.len());
        let end = end.ok_or_else(|| damaged(format!("a leaf of its {LEVELS} names file {file} of {}", names.len())))?;
        found.entry(file).or_default().push(offset..end);
    }
    let mut pieces: Vec<_> = found.into_iter().map(|(file, ranges)| (names[file].to_owned(), Some(ranges))).collect();
    pieces.extend(index["environment"].as_str().map(|name| (name.to_owned(), None)));
    if pieces.is_empty() {
        return Err(damaged(format!("its {LEVELS} names no Gaussians")));
    }
    let levels = index["lodLevels"].as_u64().and_then(|n| usize::try_from(n).ok()).unwrap_or(1);
    Ok(Finest { pieces, levels })
}

/// The chosen Gaussians of all parts in order. Errors: ranges beyond a part.
pub fn join(pieces: &[(Params, Option<Vec<Range<usize>>>)]) -> Result<Params> {
    let mut rows: Vec<(usize, usize)> = Vec::new();
    for (i, (params, ranges)) in pieces.iter().enumerate() {
        let all = 0..params.len();
        for range in ranges.as_deref().unwrap_or(std::slice::from_ref(&all)) {
            if range.end > params.len() {
                let what = format!("its {LEVELS} names Gaussians {range:?} of a piece of {}", params.len());
                return Err(damaged(what));
            }
            rows.extend(range.clone().map(|row| (i, row)));
        }
        // Ranges that overlap must not make much of little.
        if rows.len() > pieces.iter().map(|(p, _)| p.len()).sum::<usize>() {
            return Err(damaged(format!("its {LEVELS} names Gaussians twice")));
        }
    }
    let width = pieces.iter().map(|(p, _)| p[SH].width()).max().unwrap_or(3);
    let mut out = Params::new(rows.len(), width / 3, &[]);
    let [geometry, sh] = out.get_mut([GEOMETRY, SH]);
    for (to, (piece, from)) in rows.into_iter().enumerate() {
        let params = &pieces[piece].0;
        geometry.write(to, 0, params[GEOMETRY].read::<11>(from, 0));
        (0..params[SH].width()).for_each(|k| sh.set(to, k, params[SH].get(from, k)));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::samples::gaussians;
    use serde_json::json;

    fn index() -> Value {
        let leaf = |file: usize, offset: usize| {
            json!({"bound": {}, "lods": {"1": {"file": 2, "offset": 0, "count": 1},
                "0": {"file": file, "offset": offset, "count": 2}}})
        };
        json!({"version": 1, "count": 9, "lodLevels": 2, "environment": "env/meta.json",
            "filenames": ["0_0/meta.json", "0_1/meta.json", "1_0/meta.json"],
            "tree": {"bound": {}, "children": [leaf(0, 0), {"children": [leaf(1, 1), leaf(0, 3)]}]}})
    }

    #[test]
    fn the_finest_level_is_joined_from_its_parts() {
        let found = finest(index().to_string().as_bytes()).unwrap();
        assert_eq!(found.levels, 2);
        let names: Vec<&str> = found.pieces.iter().map(|(n, _)| n.as_str()).collect();
        assert_eq!(names, ["0_0/meta.json", "0_1/meta.json", "env/meta.json"]);
        let params = [gaussians(5, 4), gaussians(3, 1), gaussians(2, 9)];
        let pieces: Vec<_> = params.iter().cloned().zip(found.pieces.into_iter().map(|p| p.1)).collect();
        let joined = join(&pieces).unwrap();
        assert_eq!((joined.len(), joined[SH].width()), (4 + 2 + 2, 27));
        let mut firsts: Vec<[f32; 3]> = (0..8).map(|r| joined[GEOMETRY].read::<3>(r, 0)).collect();
        let rows = [(0, 0), (0, 1), (0, 3), (0, 4), (1, 1), (1, 2), (2, 0), (2, 1)];
        let mut wanted: Vec<[f32; 3]> =
            rows.iter().map(|&(p, r): &(usize, usize)| params[p][GEOMETRY].read(r, 0)).collect();
        firsts.sort_by(|a, b| a.partial_cmp(b).unwrap());
        wanted.sort_by(|a, b| a.partial_cmp(b).unwrap());
        assert_eq!(firsts, wanted);
    }

    #[test]
    fn damaged_indices_are_refused() {
        let with = |pointer: &str, value: Value| {
            let mut index = index();
            *index.pointer_mut(pointer).unwrap() = value;
            finest(index.to_string().as_bytes())
        };
        assert!(with("/version", json!(2)).unwrap_err().to_string().contains("version 2"));
        assert!(with("/tree/children/0/lods/0/file", json!(7)).unwrap_err().to_string().contains("file 7 of 3"));
        assert!(with("/tree/children/0/lods/0/count", json!(-1)).is_err());
        assert!(finest(b"{").is_err() && finest(b"{}").is_err());
        let far = with("/tree/children/0/lods/0/count", json!(9)).unwrap();
        let pieces: Vec<_> = far.pieces.into_iter().map(|p| (gaussians(5, 1), p.1)).collect();
        assert!(join(&pieces).unwrap_err().to_string().contains("piece of 5"));
        let twice = [(gaussians(2, 1), Some(vec![0..2, 0..2]))];
        assert!(join(&twice).unwrap_err().to_string().contains("twice"));
    }
}
