//! Content of a playback file's index: sections, sizes, and the bytes that a player needs before the first frame.

use super::line;
use crate::baking::ladder;
use crate::files::{grouped, human_bytes};
use serde_json::{Value, json};
use splat4d::format::playback::{Codec, Entry, HEADER_BYTES, Index, Kind, MAGIC, strict};
use splat4d::{Error, Result};
use std::fmt::Write;
use std::path::Path;

/// Sections that are listed; `--json` has them all.
const LISTED: usize = 24;
/// Times of the clip that are examined.
const MOMENTS: usize = 5;

/// The index in words and as JSON.
pub(super) struct IndexSummary {
    pub text: String,
    pub json: Value,
}

pub(super) fn of_index(index: &Index) -> IndexSummary {
    let (meta, sections) = (&index.meta, &index.sections);
    let stored = |kind: Kind| sections.iter().filter(|e| e.kind == kind).map(|e| u64::from(e.stored)).sum::<u64>();
    let known: u64 = sections.iter().map(|e| u64::from(e.stored)).sum();
    let seconds = meta.clip[1] - meta.clip[0];
    let rate = (seconds > 0.0).then(|| index.file_len as f64 * 8e-6 / seconds);
    let mut text = String::new();
    line(&mut text, "version", &format!("{}.{}", index.version[0], index.version[1]));
    if !meta.title.is_empty() {
        line(&mut text, "title", &meta.title);
    }
    if !meta.labels.is_empty() {
        line(&mut text, "labels", &meta.labels.join(", "));
    }
    line(&mut text, "degree", &format!("{} of the spherical harmonics", meta.sh_degree));
    let extras = [("cameras", meta.cameras.len()), ("keys of a camera path", meta.path.len())];
    for (name, count) in extras.into_iter().filter(|(_, count)| *count > 0) {
        line(&mut text, "contains", &format!("{count} {name}"));
    }
    let _ = writeln!(
        text,
        "{:<16} {:<5} {:>4} {:>18} {:>10} {:>11}",
        "sections", "kind", "tier", "seconds", "count", "bytes"
    );
    for (i, e) in sections.iter().enumerate().take(LISTED) {
        let (tier, span) = match e.kind {
            Kind::Page => (e.tier.to_string(), format!("{:.3} to {:.3}", e.span[0], e.span[1])),
            Kind::Masks | Kind::Sound => (String::new(), format!("{:.3} to {:.3}", e.span[0], e.span[1])),
            _ => (String::new(), String::new()),
        };
        let (count, bytes) = (grouped(e.count as usize), grouped(e.stored as usize));
        let _ = writeln!(text, "{i:>16} {:<5} {tier:>4} {span:>18} {count:>10} {bytes:>11}", e.kind.name());
    }
    if sections.len() > LISTED {
        line(&mut text, "", &format!("and {} more", grouped(sections.len() - LISTED)));
    }
    let sizes = [Kind::Page, Kind::Palette, Kind::Poster, Kind::Masks, Kind::Labels, Kind::Sound]
        .map(|kind| (kind, stored(kind)));
    let head = index.file_len.saturating_sub(known);
    let parts =
        ["pages", "palettes", "poster", "masks", "labels", "sound"].iter().zip(&sizes).map(|(n, (_, b))| (*n, *b));
    let parts: Vec<String> = parts
        .chain([("index", head)])
        .filter(|(_, bytes)| *bytes > 0)
        .map(|(name, bytes)| format!("{name} {}", human_bytes(bytes)))
        .collect();
    line(&mut text, "bytes", &parts.join(", "));
    line(&mut text, "first image", &format!("after {}", human_bytes(first_picture(index))));
    if let Some(rate) = rate {
        line(&mut text, "stream", &format!("{rate:.1} Mbit/s over {seconds:.3} s"));
    }
    let rungs = ladder::rungs(index);
    for (i, words) in ladder::in_words(&rungs).iter().enumerate() {
        line(&mut text, if i == 0 { "ladder" } else { "" }, words);
    }
    let moments = moments(index);
    for (i, m) in moments.iter().enumerate() {
        let name = if i == 0 { "at" } else { "" };
        let what = format!("{} Gaussians in {} pages, {}", grouped(m.gaussians), m.pages, human_bytes(m.bytes));
        line(&mut text, name, &format!("{:>8.3} s  {what}", m.time));
    }
    let mut json = json!({
        "version": index.version, "meta": meta, "sections": sections.iter().map(section).collect::<Vec<_>>(),
        "page_bytes": sizes[0].1, "palette_bytes": sizes[1].1, "poster_bytes": sizes[2].1, "mask_bytes": sizes[3].1,
        "sound_bytes": sizes[5].1, "index_bytes": head,
        "first_picture_bytes": first_picture(index), "megabits_per_second": rate,
        "moments": moments.iter().map(|m| json!({"time": m.time, "gaussians": m.gaussians, "pages": m.pages,
            "bytes": m.bytes})).collect::<Vec<_>>(),
    });
    if !rungs.is_empty() {
        json["ladder"] = json!(rungs);
    }
    IndexSummary { text, json }
}

/// Deviations of a playback file from its specification.
#[derive(Clone, Debug)]
pub struct Conformance {
    /// Version of the format that the file states: major, minor.
    pub version: [u16; 2],
    /// Each deviation, in words; none if the file conforms.
    pub deviations: Vec<String>,
}

/// Checks a playback file against the whole specification of its format.
///
/// Errors: it cannot be read, it is not a playback file, readers refuse it.
pub fn conformance(path: &Path) -> Result<Conformance> {
    let bytes = std::fs::read(path).map_err(|e| Error::io("cannot be read", e).at(path.display()))?;
    if !bytes.starts_with(&MAGIC) {
        return Err(Error::input("only .s4d files have this specification")
            .at(path.display())
            .remedy("Give a .s4d file, or leave option `strict` out."));
    }
    let deviations = strict(&bytes).map_err(|e| e.at(path.display()))?;
    Ok(Conformance { version: Index::parse(&bytes, Some(bytes.len() as u64))?.version, deviations })
}

fn section(e: &Entry) -> Value {
    let mut v = json!({"kind": e.kind.name(), "required": e.required, "offset": e.offset, "stored": e.stored,
        "bytes": e.bytes, "crc": e.crc, "deflated": e.codec == Codec::Deflate});
    if e.kind == Kind::Page {
        v["tier"] = json!(e.tier);
        v["gaussians"] = json!(e.count);
        v["span"] = json!(e.span);
        v["palette"] = json!(e.palette);
    }
    if e.kind == Kind::Masks {
        v["gaussians"] = json!(e.count);
        v["span"] = json!(e.span);
        v["page"] = json!(e.page);
    }
    if e.kind == Kind::Sound {
        v["span"] = json!(e.span);
    }
    if e.kind == Kind::Labels {
        v["gaussians"] = json!(e.count);
        v["page"] = json!(e.page);
    }
    if e.kind == Kind::Palette {
        v["degree"] = json!(e.degree);
        v["entries"] = json!(e.count);
    }
    v
}

/// Bytes from the file's start to the end of the first tier of the clip's start, and of the palettes before it.
fn first_picture(index: &Index) -> u64 {
    let start = index.pages_at(index.meta.clip[0]);
    let first = start.iter().filter(|(_, e)| e.tier == 0).map(|(_, e)| e.offset + u64::from(e.stored)).max();
    first.unwrap_or(HEADER_BYTES as u64)
}

struct Moment {
    time: f64,
    gaussians: usize,
    pages: usize,
    bytes: u64,
}

fn moments(index: &Index) -> Vec<Moment> {
    let [from, to] = index.meta.clip;
    let count = if to > from { MOMENTS } else { 1 };
    let one = |i: usize| {
        let time = from + (to - from) * i as f64 / (count - 1).max(1) as f64;
        let pages = index.pages_at(time);
        let gaussians = pages.iter().map(|(_, e)| e.count as usize).sum();
        Moment { time, gaussians, pages: pages.len(), bytes: pages.iter().map(|(_, e)| u64::from(e.stored)).sum() }
    };
    (0..count).map(one).collect()
}
