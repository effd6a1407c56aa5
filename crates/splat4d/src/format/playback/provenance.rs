//! Provenance of a file: an optional section of JSON, which readers without support skip.

use super::index::{broken, crc};
use super::write::GENERATOR;
use super::{Codec, Entry, Index, Kind};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Most bytes of the section (docs/format.md, "Provenance").
const MOST_BYTES: usize = 1 << 20;

/// Provenance of a file. Unknown fields are left out.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Provenance {
    /// Program and version.
    pub made_with: String,
    /// Time of making, RFC 3339 in UTC.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub when: Option<String>,
    /// Hash of the capture's names, poses and times, 16 hexadecimal digits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub capture: Option<String>,
    /// Edits that were made, in order, as in docs/edit.md.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub edits: Vec<serde_json::Value>,
    /// The maker's own words: whom it shows, who may use it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub words: Option<String>,
}

/// The provenance in a whole file; none where it has none.
///
/// Errors: not a playback file, a file that is cut short, a section that is damaged.
pub fn provenance(bytes: &[u8]) -> Result<Option<Provenance>> {
    let index = Index::parse(bytes, Some(bytes.len() as u64))?;
    let Some(entry) = index.sections.iter().find(|e| e.kind == Kind::Provenance) else { return Ok(None) };
    let first = entry.offset as usize;
    let stored = bytes.get(first..first + entry.stored as usize).ok_or_else(|| broken("it is cut short".into()))?;
    if crc(stored) != entry.crc {
        return Err(broken("the checksum of its provenance is wrong".into()));
    }
    if entry.codec != Codec::Raw {
        return Err(broken("its provenance has an unknown encoding".into()));
    }
    let wrong = |e| broken(format!("its provenance is invalid: {e}"));
    serde_json::from_slice(stored).map(Some).map_err(wrong)
}

/// With this provenance alone.
pub(super) fn with_provenance(bytes: &[u8], new: Option<&Provenance>) -> Result<Vec<u8>> {
    let section = new.map(|new| {
        let json = serde_json::to_vec(new).expect("plain texts are JSON");
        if json.len() > MOST_BYTES {
            return Err(Error::input(format!("{} bytes of provenance", json.len()))
                .remedy(format!("A file holds {MOST_BYTES}: shorten the words, or leave the edits out")));
        }
        Ok((Entry::plain(Kind::Provenance, &json), json))
    });
    with_section(bytes, Kind::Provenance, section.transpose()?)
}

/// The same file with this section in place of its own of the kind, or without any; all other sections keep their bytes.
///
/// Errors: not a playback file, a file that is cut short.
pub(super) fn with_section(bytes: &[u8], kind: Kind, new: Option<(Entry, Vec<u8>)>) -> Result<Vec<u8>> {
    let mut index = Index::parse(bytes, Some(bytes.len() as u64))?;
    if index.file_len > bytes.len() as u64 {
        return Err(broken("it is cut short".into()));
    }
    let mut parts: Vec<Vec<u8>> = Vec::with_capacity(index.sections.len() + 1);
    // Sections are named by their positions, which move up after a removed one.
    let places: Vec<u32> = index
        .sections
        .iter()
        .scan(0, |next, e| {
            let place = *next;
            *next += u32::from(e.kind != kind);
            Some(place)
        })
        .collect();
    index.sections.retain_mut(|e| {
        if e.kind == kind {
            return false;
        }
        parts.push(bytes[e.offset as usize..(e.offset + u64::from(e.stored)) as usize].to_vec());
        e.palette = e.palette.map(|p| places[p as usize]);
        e.page = e.page.map(|p| places[p as usize]);
        true
    });
    if let Some((entry, body)) = new {
        index.sections.push(entry);
        parts.push(body);
    }
    let mut out = index.bytes(GENERATOR);
    parts.iter().for_each(|p| out.extend_from_slice(p));
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::super::{Draft, Meta, Node, Primitive, WriteConfig, read, write};
    use super::*;

    /// A file with a palette, pages and a poster.
    fn file() -> Vec<u8> {
        let one = |i: usize| Primitive {
            mean: [i as f64 * 0.1, 0.0, 1.0],
            center: 0.5,
            half_width: f64::INFINITY,
            softness: 1.0,
            quat: [1.0, 0.0, 0.0, 0.0],
            scales: [0.1; 3],
            opacity: 0.8,
            velocity: [0.0; 3],
            turn: [0.0; 3],
            base_color: [0.5; 3],
            sh_rest: std::array::from_fn(|k| if k < 9 { 0.01 * (i + k) as f32 } else { 0.0 }),
            importance: 1.0,
            label: None,
            features: Vec::new(),
        };
        let node = |from: f64| Node { from, to: from + 1.0, primitives: (0..40).map(one).collect() };
        let meta = Meta { clip: [0.0, 2.0], fps: 30.0, up: [0.0, 1.0, 0.0], sh_degree: 1, ..Meta::default() };
        let draft = Draft { meta, nodes: vec![node(0.0), node(1.0)], poster: Some(vec![7; 70_000]) };
        let mut out = Vec::new();
        write(&draft, &WriteConfig::default(), &mut out).unwrap();
        out
    }

    fn words() -> Provenance {
        Provenance {
            made_with: "splat4d 0.1.0".into(),
            when: Some("2026-11-23T10:00:00Z".into()),
            edits: vec![serde_json::json!({"do": "delete", "select": "all"})],
            words: Some("Anna, who agreed; for research".into()),
            ..Provenance::default()
        }
    }

    #[test]
    fn provenance_round_trips_and_is_removed_exactly() {
        let plain = file();
        assert_eq!(provenance(&plain).unwrap(), None);
        let with = with_provenance(&plain, Some(&words())).unwrap();
        assert_eq!(provenance(&with).unwrap(), Some(words()));
        let other = Provenance { words: None, ..words() };
        let replaced = with_provenance(&with, Some(&other)).unwrap();
        assert_eq!(provenance(&replaced).unwrap(), Some(other));
        assert_eq!(with_provenance(&with, None).unwrap(), plain, "removed, the file is what it was");
        let (a, b) = (read(&plain).unwrap(), read(&with).unwrap());
        assert_eq!(a.layers.len(), b.layers.len());
        assert!(a.layers.iter().zip(&b.layers).all(|(a, b)| a.params == b.params && a.span == b.span));
    }

    #[test]
    fn provenance_is_found_at_any_position_in_the_file() {
        // As another program might write it: before the pages, whose palette then has another number.
        let with = with_provenance(&file(), Some(&words())).unwrap();
        let mut index = Index::parse(&with, None).unwrap();
        let mut parts: Vec<&[u8]> =
            index.sections.iter().map(|e| &with[e.offset as usize..][..e.stored as usize]).collect();
        index.sections.rotate_right(1);
        parts.rotate_right(1);
        index.sections.iter_mut().for_each(|e| e.palette = e.palette.map(|p| p + 1));
        let moved = [index.bytes(GENERATOR), parts.concat()].concat();
        assert_eq!(provenance(&moved).unwrap(), Some(words()));
        assert_eq!(with_provenance(&moved, None).unwrap(), file());
    }

    #[test]
    fn damage_is_reported() {
        let with = with_provenance(&file(), Some(&words())).unwrap();
        let mut broken = with.clone();
        *broken.last_mut().unwrap() ^= 1;
        assert!(provenance(&broken).unwrap_err().to_string().contains("checksum"));
        assert!(provenance(&with[..with.len() - 3]).is_err());
        let long = Provenance { words: Some("x".repeat(MOST_BYTES)), ..words() };
        assert!(with_provenance(&file(), Some(&long)).is_err());
    }
}
