//! Requirements of docs/format.md on writers that readers need not check: [`strict`] lists how a file deviates from it.

use super::index::{broken, raw_entry};
use super::page::{Header, at, seen_widths};
use super::{BLOCK_GAUSSIANS, Codec, Index, Kind, Page, VERSION, decode_page, provenance, read, sound};
use crate::Result;

/// Bits of words that no field has, by word.
const SPARE: [(usize, u32); 3] = [(4, 3 << 30), (5, 3 << 30), (7, 0xFF << 24)];
/// Ranges of a block header: name, position of the least number, distance to the greatest.
const RANGES: [(&str, usize, usize); 11] = [
    ("x", at::BOX, 3),
    ("y", at::BOX + 1, 3),
    ("z", at::BOX + 2, 3),
    ("the centres", at::CENTER, 1),
    ("the life", at::ALIVE, 1),
    ("the scales", at::SCALE, 1),
    ("the half-widths", at::WIDTH, 1),
    ("the softness", at::SOFTNESS, 1),
    ("red", at::COLOR, 3),
    ("green", at::COLOR + 1, 3),
    ("blue", at::COLOR + 2, 3),
];
/// Largest difference of `up` from a unit vector, and of numbers that are written as f32.
const NEAR: f64 = 1e-4;
/// First bytes of JPEG and PNG files.
const IMAGES: [&[u8]; 2] = [b"\xFF\xD8\xFF", b"\x89PNG\r\n\x1a\n"];

/// How a file deviates from docs/format.md although readers accept it; empty: not at all.
///
/// Errors: what [`read`] refuses, and provenance or sound that is damaged.
pub fn strict(bytes: &[u8]) -> Result<Vec<String>> {
    read(bytes)?;
    provenance(bytes)?;
    sound(bytes)?;
    let index = Index::parse(bytes, Some(bytes.len() as u64))?;
    let mut out = Vec::new();
    of_header(bytes, &index, &mut out);
    of_meta(&index, &mut out);
    for i in 0..index.sections.len() {
        let mut found = Vec::new();
        of_section(bytes, &index, i, &mut found)?;
        out.extend(found.into_iter().map(|what| format!("section {i}: {what}")));
    }
    Ok(out)
}

fn of_header(bytes: &[u8], index: &Index, out: &mut Vec<String>) {
    let [major, minor] = index.version;
    let grows = Index::grows(bytes);
    let (first, what) = if grows { (36, "bytes 36 to 59") } else { (28, "bytes 28 to 59") };
    if bytes[first..60].iter().any(|&b| b != 0) {
        out.push(format!("{what} of the header are not zero"));
    }
    let least = index.least_version();
    if !grows && minor > VERSION[1] {
        out.push(format!("the minor version is {minor}, this splat4d supports {}", VERSION[1]));
    } else if !grows && minor > least[1] {
        let [a, b] = least;
        out.push(format!("the version is {major}.{minor}, and nothing in the file needs more than {a}.{b}"));
    } else if !grows && minor < least[1] {
        let [a, b] = least;
        out.push(format!("the version is {major}.{minor}, and the file has sections of {a}.{b}"));
    }
    let more = bytes.len() as u64 - index.file_len;
    if more > 0 && !grows {
        out.push(format!("{more} bytes after the end that the header states"));
    }
}

fn of_meta(index: &Index, out: &mut Vec<String>) {
    let meta = &index.meta;
    let length = meta.up.iter().map(|x| x * x).sum::<f64>().sqrt();
    if (length - 1.0).abs() > NEAR {
        out.push(format!("`up` has length {length:.4}"));
    }
    if !meta.background.iter().all(|x| (0.0..=1.0).contains(x)) {
        out.push("`background` is outside 0 to 1".into());
    }
    let degrees = index.sections.iter().filter(|e| e.kind == Kind::Palette).map(|e| usize::from(e.degree));
    if let Some(degree) = degrees.max().filter(|&d| d > meta.sh_degree) {
        out.push(format!("a palette has degree {degree}, `sh_degree` is {}", meta.sh_degree));
    }
    for (k, rung) in meta.ladder.iter().enumerate() {
        let most = index.bits_per_second(rung.tiers).into_iter().fold(0.0, f64::max);
        if most > rung.rate * (1.0 + NEAR) {
            out.push(format!(
                "rung {} of the ladder needs {most:.0} bits per second, its `rate` is {}",
                k + 1,
                rung.rate
            ));
        }
    }
    let damaged = meta.cameras.iter().filter(|c| c.camera().is_none());
    out.extend(damaged.map(|c| format!("camera `{}` has a pose or a lens that is not valid", c.name)));
    for (kind, name, empty) in
        [(Kind::Labels, "labels", meta.labels.is_empty()), (Kind::Features, "features", meta.features.is_empty())]
    {
        if empty && index.sections.iter().any(|e| e.kind == kind) {
            out.push(format!("there are sections of {name}, and no `{name}` in the JSON"));
        }
    }
}

fn of_section(bytes: &[u8], index: &Index, i: usize, out: &mut Vec<String>) -> Result<()> {
    let entry = &index.sections[i];
    let name = entry.kind.name();
    let raw = raw_entry(bytes, i).ok_or_else(|| broken("its table is cut short".into()))?;
    if raw[60..].iter().any(|&b| b != 0) {
        out.push("bytes 60 to 63 of its entry are not zero".into());
    }
    if raw[4] & !1 != 0 || raw[5..8].iter().any(|&b| b != 0) {
        out.push("unknown flags".into());
    }
    if entry.required != matches!(entry.kind, Kind::Page | Kind::Palette) && !matches!(entry.kind, Kind::Other(_)) {
        out.push(format!("`{name}` is {}marked as required", if entry.required { "" } else { "not " }));
    }
    let body = &bytes[entry.offset as usize..][..entry.stored as usize];
    let before = i.checked_sub(1).map(|i| i as u32);
    match entry.kind {
        Kind::Poster if !entry.is_intact(bytes) => out.push("the checksum of the poster is wrong".into()),
        Kind::Other(_) => out.push(format!("`{name}` is not known")),
        Kind::Poster if entry.codec != Codec::Raw || !IMAGES.iter().any(|magic| body.starts_with(magic)) => {
            out.push("the poster is neither JPEG nor PNG".into());
        }
        Kind::Masks if entry.page != before => out.push("masks do not follow their page".into()),
        Kind::Provenance | Kind::Sound if index.sections[..i].iter().any(|e| e.kind == entry.kind) => {
            out.push(format!("a second `{name}`"));
        }
        Kind::Page => of_page(&decode_page(entry, body)?, out),
        _ => {}
    }
    Ok(())
}

fn of_page(page: &Page, out: &mut Vec<String>) {
    if page.words.iter().any(|w| SPARE.iter().any(|(word, bits)| w[*word] & bits != 0)) {
        out.push("spare bits of words are not zero".into());
    }
    for (k, header) in page.headers.iter().enumerate() {
        let wrong = RANGES.iter().filter(|(_, place, step)| header[*place] > header[place + step]);
        out.extend(wrong.map(|(name, ..)| format!("block {k}: the range of {name} ends before it begins")));
        let rows = BLOCK_GAUSSIANS * k..page.len().min(BLOCK_GAUSSIANS * (k + 1));
        if let Some(row) = rows.clone().find(|&row| !inside(page, header, row)) {
            out.push(format!("block {k}: visible outside its life, Gaussian {row}"));
        }
        let finite = |row: usize| {
            let r = page.record(row);
            r.velocity.iter().chain(&r.turn).all(|x| x.is_finite())
        };
        if let Some(row) = rows.clone().find(|&row| !finite(row)) {
            out.push(format!("block {k}: the motion of Gaussian {row} is not finite"));
        }
    }
}

/// Whether a Gaussian is visible, within its page's span, only while its block is alive.
fn inside(page: &Page, header: &Header, row: usize) -> bool {
    let r = page.record(row);
    let code = (r.opacity * 255.0).round() as usize;
    let tail = seen_widths()[code];
    if tail < 0.0 {
        return true;
    }
    let seen = if r.half_width.is_infinite() { f64::INFINITY } else { r.half_width + tail * r.softness };
    let [from, to] = [(r.center - seen).max(page.span[0]), (r.center + seen).min(page.span[1])];
    let [alive, dead] = [header[at::ALIVE], header[at::ALIVE + 1]].map(f64::from);
    let slack = NEAR * (to - from).abs();
    from > to || alive <= from + slack && to <= dead + slack
}
