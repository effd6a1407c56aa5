//! The start of a playback file: header, JSON, and the table of sections.

use super::{
    BLOCK_GAUSSIANS, BLOCK_HEADER, FIRST_VERSION, GROWING, HEADER_BYTES, MAGIC, MASKED, MAX_PAGE_GAUSSIANS,
    MAX_PALETTE, Meta, PAGE_WORDS, VERSION,
};
use crate::math::sh;
use crate::scene::features::MOST_CHANNELS;
use crate::{Error, ErrorKind, Result};
use std::ops::Range;

/// Bytes of an entry of the table.
pub(super) const ENTRY_BYTES: usize = 64;
/// Largest index (docs/format.md, "Layout").
pub(super) const MAX_INDEX: usize = 64 << 20;
/// Most sections (docs/format.md, "Layout").
pub(super) const MAX_SECTIONS: usize = 1_000_000;
/// Deflate shrinks at most 1032 times: 258 bytes from 2 bits (RFC 1951, §3.2.5).
pub(super) const MAX_DEFLATE: u64 = 1032;
/// A page that has base colours only.
pub(super) const NO_PALETTE: u32 = u32::MAX;
/// Bytes of masks before their key times, and most of these (docs/format.md, "Masks").
pub(super) const MASK_HEAD: usize = 8;
pub(super) const MAX_KEYS: usize = 65_535;
/// Most bytes of sound (docs/format.md, "Sound"): an hour at 128 kbit/s; and most seconds, a day: more is damage.
pub(super) const MOST_SOUND: usize = 64 << 20;
pub(super) const MOST_SECONDS: f64 = 86_400.0;
/// Flag of an entry: readers that do not support the kind refuse the file.
const REQUIRED: u32 = 1;

/// The kind of a section.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Gaussians of one span of time.
    Page,
    /// Spherical harmonics above degree 0.
    Palette,
    /// Which Gaussians of a page are rendered when.
    Masks,
    /// Labels of the Gaussians of a page.
    Labels,
    /// Feature channels of the Gaussians of a page.
    Features,
    /// An image.
    Poster,
    /// The file's provenance.
    Provenance,
    /// What is heard.
    Sound,
    /// Something newer, which is skipped.
    Other([u8; 4]),
}

impl Kind {
    pub(super) fn tag(self) -> [u8; 4] {
        match self {
            Kind::Page => *b"PAGE",
            Kind::Palette => *b"PALT",
            Kind::Masks => *b"MASK",
            Kind::Labels => *b"LABL",
            Kind::Features => *b"FEAT",
            Kind::Poster => *b"POST",
            Kind::Provenance => *b"PROV",
            Kind::Sound => *b"SOUN",
            Kind::Other(tag) => tag,
        }
    }

    fn of(tag: [u8; 4]) -> Self {
        let of_pages = [Kind::Page, Kind::Palette, Kind::Masks, Kind::Labels, Kind::Features];
        let mut known = of_pages.into_iter().chain([Kind::Poster, Kind::Provenance, Kind::Sound]);
        known.find(|k| k.tag() == tag).unwrap_or(Kind::Other(tag))
    }

    /// The four characters that the file has, others as dots.
    pub fn name(self) -> String {
        self.tag().iter().map(|&b| if b.is_ascii_graphic() { b as char } else { '.' }).collect()
    }
}

/// Encoding of a section.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Codec {
    /// As it is.
    Raw,
    /// RFC 1951 without a wrapper.
    Deflate,
    /// Something newer.
    Other(u16),
}

impl Codec {
    pub(super) fn code(self) -> u16 {
        match self {
            Codec::Raw => 0,
            Codec::Deflate => 1,
            Codec::Other(code) => code,
        }
    }
}

/// One section of the table.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// Kind of its contents.
    pub kind: Kind,
    /// Whether readers that do not support the kind must refuse the file.
    pub required: bool,
    /// First byte in the file.
    pub offset: u64,
    /// Bytes in the file.
    pub stored: u32,
    /// Bytes after decoding.
    pub bytes: u32,
    /// CRC-32 of the stored bytes.
    pub crc: u32,
    /// Encoding.
    pub codec: Codec,
    /// Page: the tier, 0 the most important.
    pub tier: u16,
    /// Palette: the degree of its spherical harmonics, 1 to 3.
    pub degree: u16,
    /// Page: Gaussians. Palette: entries. Masks, labels, features: Gaussians of their page.
    pub count: u32,
    /// Page: it is rendered for from ≤ t < to, seconds. Masks: first and last key time. Sound: its first and last second.
    pub span: [f64; 2],
    /// Page: position of its palette in the table of sections; none: base colour only.
    pub palette: Option<u32>,
    /// Masks, labels, features: position of their page in the table of sections.
    pub page: Option<u32>,
}

/// The start of a file, understood and checked.
#[derive(Clone, Debug, PartialEq)]
pub struct Index {
    /// Major and minor version of the format.
    pub version: [u16; 2],
    /// Bytes of the whole file, as its header states.
    pub file_len: u64,
    /// The JSON.
    pub meta: Meta,
    /// All sections in the order in which a player needs them.
    pub sections: Vec<Entry>,
}

/// The fixed header.
struct Header {
    version: [u16; 2],
    /// Position of the index: behind the header, except in growing files.
    index_at: u64,
    index_bytes: usize,
    file_len: u64,
    index_crc: u32,
}

impl Index {
    /// Bytes from the start that [`parse`](Self::parse) needs: 64 as long as `prefix` is shorter, then the exact
    /// number. Of a file that grows that is nearly all of it: a reader with random access uses its
    /// [`place`](Self::place).
    ///
    /// Errors: not a playback file, a newer major version, a damaged header.
    pub(crate) fn needed(prefix: &[u8]) -> Result<usize> {
        if prefix.len() < HEADER_BYTES {
            let known = prefix.len().min(MAGIC.len());
            return if prefix[..known] == MAGIC[..known] { Ok(HEADER_BYTES) } else { Err(foreign()) };
        }
        Ok(Self::place(prefix)?.end as usize)
    }

    /// Whether a file's first bytes mark its clip as unfinished.
    pub(super) fn grows(header: &[u8]) -> bool {
        header.get(..10).is_some_and(|h| h[..8] == MAGIC && h[8..] == GROWING[0].to_le_bytes())
    }

    /// The bytes of the file that contain its index, by its first [`HEADER_BYTES`].
    ///
    /// Errors: not a playback file, a newer major version, a damaged header.
    pub fn place(header: &[u8]) -> Result<Range<u64>> {
        if header.len() < HEADER_BYTES {
            return Err(broken(format!("it has {} bytes, its header alone {HEADER_BYTES}", header.len())));
        }
        let header = Header::parse(header)?;
        Ok(header.index_at..header.index_at + header.index_bytes as u64)
    }

    /// Understands the start of a file; `prefix` holds all bytes up to the end of its index ([`place`](Self::place)).
    /// `file_len`, where it is known, is how long the file really is: a shorter one is cut short, which is no error here.
    ///
    /// Errors: not a playback file, a newer major version, damage, a required section of an unknown kind.
    pub fn parse(prefix: &[u8], file_len: Option<u64>) -> Result<Self> {
        let end = Self::needed(prefix)?;
        if prefix.len() < end {
            let have = file_len.unwrap_or(prefix.len() as u64);
            return Err(broken(format!("its index ends at byte {end}, but there are only {have}")));
        }
        let place = Self::place(prefix)?;
        Self::of(prefix, &prefix[place.start as usize..end])
    }

    /// The same of a file's first [`HEADER_BYTES`] and the bytes of its [`place`](Self::place). Errors: as
    /// [`parse`](Self::parse).
    pub fn of(header: &[u8], index: &[u8]) -> Result<Self> {
        let place = Self::place(header)?;
        let header = Header::parse(header)?;
        if index.len() as u64 != place.end - place.start || crc(index) != header.index_crc {
            return Err(broken("the checksum of its index is wrong".into()));
        }
        let json_len = read_u32(index, 0).ok_or_else(short)? as usize;
        let json = index.get(4..).and_then(|rest| rest.get(..json_len)).ok_or_else(short)?;
        let meta: Meta = serde_json::from_slice(json).map_err(|e| broken(format!("its JSON is invalid: {e}")))?;
        meta.check()?;
        let rest = &index[4 + json_len..];
        let count = read_u32(rest, 0).ok_or_else(short)? as usize;
        let table = rest[4..].get(..count.saturating_mul(ENTRY_BYTES)).filter(|_| count <= MAX_SECTIONS);
        let table = table.ok_or_else(|| broken(format!("its table claims {count} sections")))?;
        let sections: Vec<Entry> = table
            .chunks_exact(ENTRY_BYTES)
            .enumerate()
            .map(|(i, bytes)| Entry::parse(bytes).map_err(|e| e.at(format!("section {i}"))))
            .collect::<Result<_>>()?;
        let mut index = Self { version: header.version, file_len: header.file_len, meta, sections };
        index.check(place)?;
        index.measure_rungs();
        Ok(index)
    }

    /// The pages (with their positions in the table) that are rendered at second t, most important tier first. Clamps t
    /// to the clip.
    pub fn pages_at(&self, t: f64) -> Vec<(usize, &Entry)> {
        let t = t.max(self.meta.clip[0]).min(self.meta.clip[1]);
        let mut pages: Vec<_> = self.pages().filter(|(_, e)| e.span[0] <= t && t < e.span[1]).collect();
        pages.sort_by_key(|(_, e)| e.tier);
        pages
    }

    /// All pages with their positions in the table.
    pub(crate) fn pages(&self) -> impl Iterator<Item = (usize, &Entry)> {
        self.sections.iter().enumerate().filter(|(_, e)| e.kind == Kind::Page)
    }

    /// Pages that have masks, and the sections of these, by page.
    pub(crate) fn masks(&self) -> Vec<(u32, usize)> {
        self.of_pages(Kind::Masks)
    }

    /// Pages that have a section of this kind next to them, and these sections, by page.
    pub(crate) fn of_pages(&self, kind: Kind) -> Vec<(u32, usize)> {
        let sections = self.sections.iter().enumerate().filter(|(_, e)| e.kind == kind);
        let mut all: Vec<(u32, usize)> = sections.filter_map(|(i, e)| Some((e.page?, i))).collect();
        all.sort_unstable();
        all
    }

    /// Checks that sections fit each other, the file and its index.
    fn check(&self, place: Range<u64>) -> Result<()> {
        let mut order: Vec<usize> = (0..self.sections.len()).collect();
        order.sort_by_key(|&i| (self.sections[i].offset, self.sections[i].stored));
        // Behind the header, and on either side of the index.
        let mut free = if place.start == HEADER_BYTES as u64 { place.end } else { HEADER_BYTES as u64 };
        for i in order {
            let e = &self.sections[i];
            if e.offset < place.end && place.start < e.offset.saturating_add(u64::from(e.stored)) {
                return Err(broken("it overlaps the index".into()).at(format!("section {i}")));
            }
            let end = e.offset.checked_add(u64::from(e.stored)).filter(|&end| end <= self.file_len);
            let end = end.ok_or_else(|| broken("it ends beyond the file".into()).at(format!("section {i}")))?;
            if e.offset < free {
                return Err(broken("it overlaps another".into()).at(format!("section {i}")));
            }
            free = end;
        }
        for (kind, name) in [(Kind::Masks, "masks"), (Kind::Labels, "labels"), (Kind::Features, "features")] {
            let beside = self.of_pages(kind);
            if let Some(pair) = beside.windows(2).find(|pair| pair[0].0 == pair[1].0) {
                let what = format!("section {} has {name} already", pair[0].0);
                return Err(broken(what).at(format!("section {}", pair[1].1)));
            }
            for (page, i) in beside {
                let count = self.sections[i].count;
                if self.sections.get(page as usize).is_none_or(|e| e.kind != Kind::Page || e.count != count) {
                    let what = format!("its page, section {page}, is not a page of {count} Gaussians");
                    return Err(broken(what).at(format!("section {i}")));
                }
            }
        }
        let mut gaussians = 0u64;
        for (i, page) in self.pages() {
            gaussians += u64::from(page.count);
            let Some(p) = page.palette else { continue };
            if self.sections.get(p as usize).is_none_or(|e| e.kind != Kind::Palette) {
                return Err(broken(format!("its palette, section {p}, is not a palette")).at(format!("section {i}")));
            }
        }
        if gaussians != self.meta.gaussians as u64 {
            let claimed = self.meta.gaussians;
            return Err(broken(format!("its pages hold {gaussians} Gaussians, its JSON states {claimed}")));
        }
        Ok(())
    }

    /// The least version that has all these sections.
    pub(super) fn least_version(&self) -> [u16; 2] {
        let has = |kind: Kind| self.sections.iter().any(|e| e.kind == kind);
        match (has(Kind::Labels) || has(Kind::Features), has(Kind::Masks)) {
            (true, _) => VERSION,
            (false, true) => MASKED,
            (false, false) => FIRST_VERSION,
        }
    }

    /// Header and index of a file with these sections; `offset`s are moved behind the index, and the file's length is
    /// set. `generator` is the program that writes.
    ///
    /// Panics: more sections, or a larger index, than the format allows.
    pub(super) fn bytes(&mut self, generator: &str) -> Vec<u8> {
        assert!(self.sections.len() <= MAX_SECTIONS, "a file has at most {MAX_SECTIONS} sections");
        let json = self.json(generator);
        let index_bytes = 8 + json.len() + ENTRY_BYTES * self.sections.len();
        let mut offset = (HEADER_BYTES + index_bytes) as u64;
        for e in &mut self.sections {
            e.offset = offset;
            offset += u64::from(e.stored);
        }
        self.file_len = offset;
        let index = self.table(&json);
        [&self.header(HEADER_BYTES as u64, &index)[..], &index].concat()
    }

    /// The start of a file that grows, and its index, which is to be behind everything else, `at`; sections stay where
    /// they are. Panics: as [`bytes`](Self::bytes).
    pub(super) fn growing(&mut self, at: u64, generator: &str) -> ([u8; HEADER_BYTES], Vec<u8>) {
        let index = self.table(&self.json(generator));
        (self.version, self.file_len) = (GROWING, at + index.len() as u64);
        (self.header(at, &index), index)
    }

    fn json(&self, generator: &str) -> Vec<u8> {
        let mut json = serde_json::to_value(&self.meta).expect("plain numbers and texts are JSON");
        json["generator"] = generator.into();
        let mut json = json.to_string().into_bytes();
        json.resize(json.len().next_multiple_of(4), b' ');
        json
    }

    /// The bytes of an index.
    fn table(&self, json: &[u8]) -> Vec<u8> {
        assert!(self.sections.len() <= MAX_SECTIONS, "a file has at most {MAX_SECTIONS} sections");
        let index_bytes = 8 + json.len() + ENTRY_BYTES * self.sections.len();
        assert!(index_bytes <= MAX_INDEX, "an index has at most {MAX_INDEX} bytes");
        let mut out = Vec::with_capacity(index_bytes);
        out.extend_from_slice(&(json.len() as u32).to_le_bytes());
        out.extend_from_slice(json);
        out.extend_from_slice(&(self.sections.len() as u32).to_le_bytes());
        self.sections.iter().for_each(|e| e.append(&mut out));
        out
    }

    /// The header of a file whose index is at `at`.
    fn header(&self, at: u64, index: &[u8]) -> [u8; HEADER_BYTES] {
        let mut out = [0; HEADER_BYTES];
        out[..8].copy_from_slice(&MAGIC);
        out[8..10].copy_from_slice(&self.version[0].to_le_bytes());
        out[10..12].copy_from_slice(&self.version[1].to_le_bytes());
        out[12..16].copy_from_slice(&(index.len() as u32).to_le_bytes());
        out[16..24].copy_from_slice(&self.file_len.to_le_bytes());
        out[24..28].copy_from_slice(&crc(index).to_le_bytes());
        if self.version == GROWING {
            out[28..36].copy_from_slice(&at.to_le_bytes());
        }
        let header_crc = crc(&out[..60]);
        out[60..64].copy_from_slice(&header_crc.to_le_bytes());
        out
    }
}

/// Writes both checksums of a file's start, whose index is behind its header. Panics: fewer bytes than header and index
/// have.
#[cfg(test)]
pub(super) fn seal(file: &mut [u8]) {
    let index_bytes = read_u32(file, 12).expect("a header") as usize;
    let index_crc = crc(&file[HEADER_BYTES..HEADER_BYTES + index_bytes]);
    file[24..28].copy_from_slice(&index_crc.to_le_bytes());
    let header_crc = crc(&file[..60]);
    file[60..64].copy_from_slice(&header_crc.to_le_bytes());
}

impl Header {
    /// Panics: fewer than 64 bytes.
    fn parse(bytes: &[u8]) -> Result<Self> {
        if bytes[..8] != MAGIC {
            return Err(foreign());
        }
        let [major, minor] = [8, 10].map(|at| u16::from_le_bytes([bytes[at], bytes[at + 1]]));
        // Checked first: a newer format may have another header behind these bytes.
        if major != VERSION[0] && major != GROWING[0] {
            return Err(Error::new(
                ErrorKind::Unsupported,
                format!("this playback file has version {major}.{minor}, this splat4d reads version {}", VERSION[0]),
            )
            .remedy("Install a newer splat4d, or bake the scene again with this one"));
        }
        let u32_at = |at| read_u32(bytes, at).expect("64 bytes");
        if u32_at(60) != crc(&bytes[..60]) {
            return Err(broken("the checksum of its header is wrong".into()));
        }
        let index_bytes = u32_at(12) as usize;
        let file_len = u64::from(u32_at(16)) | u64::from(u32_at(20)) << 32;
        let index_at = match major == GROWING[0] {
            true => u64::from(u32_at(28)) | u64::from(u32_at(32)) << 32,
            false => HEADER_BYTES as u64,
        };
        let end = index_at.checked_add(index_bytes as u64).filter(|_| index_at >= HEADER_BYTES as u64);
        if index_bytes > MAX_INDEX || end.is_none_or(|end| end > file_len) {
            return Err(broken(format!("its header claims an index of {index_bytes} bytes in a file of {file_len}")));
        }
        Ok(Self { version: [major, minor], index_at, index_bytes, file_len, index_crc: u32_at(24) })
    }
}

impl Entry {
    /// Whether the section is in these bytes of its file, with its checksum.
    pub fn is_intact(&self, file: &[u8]) -> bool {
        let first = usize::try_from(self.offset).ok();
        let stored = first.and_then(|first| file.get(first..)?.get(..self.stored as usize));
        stored.is_some_and(|stored| crc(stored) == self.crc)
    }

    /// An optional section of exactly these bytes, at any position.
    pub(super) fn plain(kind: Kind, bytes: &[u8]) -> Self {
        let length = u32::try_from(bytes.len()).expect("a section has less than 4 GiB");
        Self {
            kind,
            required: false,
            offset: 0,
            stored: length,
            bytes: length,
            crc: crc(bytes),
            codec: Codec::Raw,
            tier: 0,
            degree: 0,
            count: 0,
            span: [0.0; 2],
            palette: None,
            page: None,
        }
    }

    /// Panics: fewer than 64 bytes.
    fn parse(b: &[u8]) -> Result<Self> {
        let u32_at = |at| read_u32(b, at).expect("64 bytes");
        let u16_at = |at: usize| u16::from_le_bytes([b[at], b[at + 1]]);
        let u64_at = |at| u64::from(u32_at(at)) | u64::from(u32_at(at + 4)) << 32;
        let kind = Kind::of([b[0], b[1], b[2], b[3]]);
        let required = u32_at(4) & REQUIRED != 0;
        let entry = Self {
            kind,
            required,
            offset: u64_at(8),
            stored: u32_at(16),
            bytes: u32_at(20),
            crc: u32_at(24),
            codec: match u16_at(28) {
                0 => Codec::Raw,
                1 => Codec::Deflate,
                other => Codec::Other(other),
            },
            tier: if kind == Kind::Page { u16_at(30) } else { 0 },
            degree: if kind == Kind::Palette { u16_at(30) } else { 0 },
            count: u32_at(32),
            span: [f64::from_bits(u64_at(40)), f64::from_bits(u64_at(48))],
            palette: Some(u32_at(56)).filter(|&p| kind == Kind::Page && p != NO_PALETTE),
            page: Some(u32_at(56)).filter(|_| matches!(kind, Kind::Masks | Kind::Labels | Kind::Features)),
        };
        if let Kind::Other(_) = kind {
            if required {
                let what = format!("the file cannot be played without a section `{}`", kind.name());
                return Err(Error::new(ErrorKind::Unsupported, what).remedy("Install a newer splat4d"));
            }
            return Ok(entry);
        }
        entry.check(u32_at(36) as usize)?;
        Ok(entry)
    }

    /// Checks that the fields of an entry of a known kind fit together.
    pub(super) fn check(&self, words: usize) -> Result<()> {
        let most = match self.codec {
            Codec::Raw => u64::from(self.stored),
            Codec::Deflate => u64::from(self.stored) * MAX_DEFLATE,
            Codec::Other(code) => {
                return Err(Error::new(ErrorKind::Unsupported, format!("codec {code} is not known"))
                    .remedy("Install a newer splat4d"));
            }
        };
        if u64::from(self.bytes) > most {
            return Err(broken(format!("{} bytes cannot be stored in {}", self.bytes, self.stored)));
        }
        let count = self.count as usize;
        match self.kind {
            Kind::Page => {
                if words != PAGE_WORDS {
                    let what = format!("a page has {words} words a Gaussian, this splat4d supports {PAGE_WORDS}");
                    return Err(Error::new(ErrorKind::Unsupported, what).remedy("Install a newer splat4d"));
                }
                if !(1..=MAX_PAGE_GAUSSIANS).contains(&count) || self.bytes as usize != page_bytes(count) {
                    return Err(broken(format!("a page of {count} Gaussians does not have {} bytes", self.bytes)));
                }
                if !(self.span.iter().all(|t| t.is_finite()) && self.span[0] < self.span[1]) {
                    return Err(broken(format!("a page cannot be played from {} to {} s", self.span[0], self.span[1])));
                }
            }
            Kind::Palette => {
                let degree = usize::from(self.degree);
                if !(1..=sh::MAX_DEGREE).contains(&degree) {
                    return Err(broken(format!("a palette has degree {degree}")));
                }
                if !(1..=MAX_PALETTE).contains(&count) || self.bytes as usize != palette_bytes(degree, count) {
                    return Err(broken(format!("a palette of {count} entries does not have {} bytes", self.bytes)));
                }
            }
            Kind::Masks => {
                if !(1..=MAX_PAGE_GAUSSIANS).contains(&count) || mask_keys(count, self.bytes as usize).is_none() {
                    return Err(broken(format!("masks of {count} Gaussians do not have {} bytes", self.bytes)));
                }
                if !(self.span.iter().all(|t| t.is_finite()) && self.span[0] <= self.span[1]) {
                    let [from, to] = self.span;
                    return Err(broken(format!("key times cannot go from {from} to {to} s")));
                }
            }
            Kind::Labels => {
                if !(1..=MAX_PAGE_GAUSSIANS).contains(&count) || self.bytes as usize != count {
                    return Err(broken(format!("labels of {count} Gaussians do not have {} bytes", self.bytes)));
                }
            }
            Kind::Features => {
                let bytes = self.bytes as usize;
                let fits = bytes.is_multiple_of(count.max(1)) && (1..=MOST_CHANNELS).contains(&(bytes / count.max(1)));
                if !(1..=MAX_PAGE_GAUSSIANS).contains(&count) || !fits {
                    return Err(broken(format!("features of {count} Gaussians do not have {bytes} bytes")));
                }
            }
            Kind::Sound => {
                let [from, to] = self.span;
                if self.codec != Codec::Raw || self.bytes != self.stored || self.bytes as usize > MOST_SOUND {
                    return Err(broken(format!(
                        "sound of {} bytes, expected at most {MOST_SOUND} raw ones",
                        self.stored
                    )));
                }
                if !(from.is_finite() && to.is_finite() && from < to && to - from <= MOST_SECONDS) {
                    return Err(broken(format!("sound cannot be played from {from} to {to} s")));
                }
            }
            Kind::Poster | Kind::Provenance | Kind::Other(_) => {}
        }
        Ok(())
    }

    fn append(&self, out: &mut Vec<u8>) {
        let start = out.len();
        out.extend_from_slice(&self.kind.tag());
        out.extend_from_slice(&(if self.required { REQUIRED } else { 0 }).to_le_bytes());
        out.extend_from_slice(&self.offset.to_le_bytes());
        for x in [self.stored, self.bytes, self.crc] {
            out.extend_from_slice(&x.to_le_bytes());
        }
        out.extend_from_slice(&self.codec.code().to_le_bytes());
        out.extend_from_slice(&(self.tier | self.degree).to_le_bytes());
        let words = if self.kind == Kind::Page { PAGE_WORDS as u32 } else { 0 };
        out.extend_from_slice(&self.count.to_le_bytes());
        out.extend_from_slice(&words.to_le_bytes());
        self.span.iter().for_each(|t| out.extend_from_slice(&t.to_le_bytes()));
        let other = match self.kind {
            Kind::Page => self.palette.unwrap_or(NO_PALETTE),
            Kind::Masks | Kind::Labels | Kind::Features => self.page.expect("they are those of a page"),
            _ => 0,
        };
        out.extend_from_slice(&other.to_le_bytes());
        out.resize(start + ENTRY_BYTES, 0);
    }
}

/// Decoded bytes of a page.
pub(super) fn page_bytes(gaussians: usize) -> usize {
    gaussians.div_ceil(BLOCK_GAUSSIANS) * 4 * BLOCK_HEADER + gaussians * 4 * PAGE_WORDS
}

/// Decoded bytes of a palette.
pub(super) fn palette_bytes(degree: usize, entries: usize) -> usize {
    12 + 3 * (sh::coeffs(degree) - 1) * entries
}

/// Key times of the masks of this many Gaussians, whose decoded bytes are this many; none where no number fits.
pub(super) fn mask_keys(gaussians: usize, bytes: usize) -> Option<usize> {
    let (rest, key) = (bytes.checked_sub(MASK_HEAD)?, 8 + gaussians.div_ceil(8));
    (rest.is_multiple_of(key) && (1..=MAX_KEYS).contains(&(rest / key))).then_some(rest / key)
}

/// CRC-32 as in zip.
pub(super) fn crc(bytes: &[u8]) -> u32 {
    let mut crc = flate2::Crc::new();
    crc.update(bytes);
    crc.sum()
}

fn read_u32(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}

/// The bytes of entry `i` in a file that was parsed; none: the file has no such entry.
pub(super) fn raw_entry(file: &[u8], i: usize) -> Option<&[u8]> {
    let place = Index::place(file).ok()?;
    let index = file.get(place.start as usize..place.end as usize)?;
    let first = 8 + read_u32(index, 0)? as usize + ENTRY_BYTES * i;
    index.get(first..first + ENTRY_BYTES)
}

fn short() -> Error {
    broken("its index is shorter than stated".into())
}

fn foreign() -> Error {
    Error::input("this is not a playback file: it does not begin as one")
        .remedy("Give a .s4d file; `splat4d bake` makes one from a run")
}

/// A file that does not hold together.
pub(super) fn broken(what: String) -> Error {
    Error::input(format!("this playback file is damaged: {what}")).remedy("Copy or download it again, or bake it again")
}
