//! Files of clips that are not finished: sections are appended, and a new index behind them; then the header names the
//! new index. A reader of the old header continues with the old index, of which nothing was touched. What is finished
//! is written again as any other file, its index in front.

use super::index::broken;
use super::write::GENERATOR;
use super::{Entry, GROWING, HEADER_BYTES, Index, Kind, Meta, Sound};
use crate::{Error, Result};
use std::io::{Read, Seek, SeekFrom, Write};

/// Bytes that are copied at a time.
const COPIED: usize = 1 << 20;

/// A file that grows.
pub struct Growing<F> {
    file: F,
    index: Index,
}

impl<F: Read + Write + Seek> Growing<F> {
    /// Begins a file without a section. Errors: metadata out of range, the file's.
    pub fn begin(file: F, meta: Meta) -> Result<Self> {
        meta.check()?;
        let index = Index { version: GROWING, file_len: HEADER_BYTES as u64, meta, sections: Vec::new() };
        let mut growing = Self { file, index };
        growing.commit(HEADER_BYTES as u64)?;
        Ok(growing)
    }

    /// Continues a file. Errors: not a growing file, or damaged; those of the file.
    pub fn open(mut file: F) -> Result<Self> {
        let index = read_index(&mut file)?;
        if index.version[0] != GROWING[0] {
            return Err(Error::input("the playback file is finished, and grows no more"));
        }
        Ok(Self { file, index })
    }

    /// Its present content.
    pub fn index(&self) -> &Index {
        &self.index
    }

    /// The file itself.
    #[cfg(test)]
    pub(crate) fn file(&mut self) -> &mut F {
        &mut self.file
    }

    /// Adds the pages of a whole playback file, their palettes, masks and labels, and states `meta`, of which
    /// `gaussians` is counted. `sync` is called before the header names what was added: until then the file is what it
    /// was.
    ///
    /// Errors: `part` is not a complete file; metadata out of range; the file's. After an error the file is what it
    /// was.
    pub fn append(
        &mut self,
        part: &[u8],
        meta: Meta,
        sync: &mut dyn FnMut(&mut F) -> std::io::Result<()>,
    ) -> Result<()> {
        meta.check()?;
        let before = self.index.clone();
        let added = self.add(part, meta, sync);
        if added.is_err() {
            self.index = before;
        }
        added
    }

    fn add(&mut self, part: &[u8], meta: Meta, sync: &mut dyn FnMut(&mut F) -> std::io::Result<()>) -> Result<()> {
        let theirs = Index::parse(part, Some(part.len() as u64))?;
        let wanted = |e: &&Entry| matches!(e.kind, Kind::Page | Kind::Palette | Kind::Masks | Kind::Labels);
        // Sections are named by their positions, which change.
        let mut places = vec![0u32; theirs.sections.len()];
        let mut next = self.index.sections.len() as u32;
        for (place, e) in places.iter_mut().zip(&theirs.sections) {
            *place = next;
            next += u32::from(wanted(&e));
        }
        let mut at = self.index.file_len;
        self.file.seek(SeekFrom::Start(at)).map_err(unwritten)?;
        for e in theirs.sections.iter().filter(wanted) {
            let first = e.offset as usize;
            let body = part.get(first..first + e.stored as usize).ok_or_else(|| broken("it is cut short".into()))?;
            self.file.write_all(body).map_err(unwritten)?;
            let [palette, page] = [e.palette, e.page].map(|p| p.map(|p| places[p as usize]));
            self.index.sections.push(Entry { offset: at, palette, page, ..e.clone() });
            at += u64::from(e.stored);
        }
        self.index.meta = meta;
        self.index.meta.gaussians = self.index.pages().map(|(_, e)| e.count as usize).sum();
        let (header, index) = self.index.growing(at, GENERATOR);
        self.file.write_all(&index).and_then(|()| self.file.flush()).map_err(unwritten)?;
        sync(&mut self.file).map_err(unwritten)?;
        self.put(&header)
    }

    fn commit(&mut self, at: u64) -> Result<()> {
        let (header, index) = self.index.growing(at, GENERATOR);
        self.file.seek(SeekFrom::Start(at)).map_err(unwritten)?;
        self.file.write_all(&index).map_err(unwritten)?;
        self.put(&header)
    }

    /// Writes the header at once.
    fn put(&mut self, header: &[u8; HEADER_BYTES]) -> Result<()> {
        self.file.seek(SeekFrom::Start(0)).map_err(unwritten)?;
        self.file.write_all(header).and_then(|()| self.file.flush()).map_err(unwritten)
    }
}

/// Writes a file that grew as a finished one: an index in front, then sections in the order in which a player needs
/// them, whatever the order in which they were added. `gaussians` of `meta` is counted; `poster` as in
/// [`write()`](super::write()); `sound` comes last. Returns the file's length, bytes.
///
/// Errors: `source` does not grow, or is damaged or cut short; metadata out of range; either file's.
pub fn finish(
    source: &mut (impl Read + Seek),
    meta: Meta,
    (poster, sound): (Option<&[u8]>, Option<&Sound>),
    out: &mut dyn Write,
) -> Result<u64> {
    meta.check()?;
    let grown = read_index(source)?;
    let order = order(&grown);
    let mut places = vec![u32::MAX; grown.sections.len()];
    let posters = usize::from(poster.is_some());
    order.iter().enumerate().for_each(|(place, &i)| places[i] = (place + posters) as u32);
    let mut sections: Vec<Entry> = poster.map(|p| Entry::plain(Kind::Poster, p)).into_iter().collect();
    for &i in &order {
        let e = &grown.sections[i];
        let [palette, page] = [e.palette, e.page].map(|p| p.map(|p| places[p as usize]));
        sections.push(Entry { palette, page, ..e.clone() });
    }
    let sound = sound.map(Sound::section).transpose()?;
    sections.extend(sound.iter().map(|(entry, _)| entry.clone()));
    let meta = Meta { gaussians: grown.meta.gaussians, parts: Vec::new(), missing: Vec::new(), ..meta };
    let mut index = Index { version: [0; 2], file_len: 0, meta, sections };
    index.version = index.least_version();
    let head = index.bytes(GENERATOR);
    out.write_all(&head).map_err(unwritten)?;
    poster.map_or(Ok(()), |p| out.write_all(p)).map_err(unwritten)?;
    let mut buffer = Vec::new();
    for &i in &order {
        let e = &grown.sections[i];
        source.seek(SeekFrom::Start(e.offset)).map_err(unread)?;
        let mut left = e.stored as usize;
        while left > 0 {
            buffer.resize(left.min(COPIED), 0);
            source.read_exact(&mut buffer).map_err(unread)?;
            out.write_all(&buffer).map_err(unwritten)?;
            left -= buffer.len();
        }
    }
    sound.map_or(Ok(()), |(_, mp4)| out.write_all(&mp4)).map_err(unwritten)?;
    Ok(index.file_len)
}

/// Sections of the first image: the first tier of its pages, what colours them, the rest of them; then time continues.
/// Palettes come before the first page that names them, masks behind their page, labels behind everything. Equal ones
/// are ordered by their bytes, so that the order of additions does not change the file.
fn order(index: &Index) -> Vec<usize> {
    let start = index.meta.clip[0];
    let holds = |e: &Entry| e.span[0] <= start && start < e.span[1];
    let mut pages: Vec<(usize, &Entry)> = index.pages().collect();
    pages.sort_by(|(_, a), (_, b)| {
        let by_time = a.span[0].total_cmp(&b.span[0]).then(b.span[1].total_cmp(&a.span[1]));
        let (first_a, first_b) = (holds(a), holds(b));
        let by_tier = a.tier.cmp(&b.tier);
        let order = if first_a && first_b { by_tier.then(by_time) } else { by_time.then(by_tier) };
        first_b.cmp(&first_a).then(order).then((a.crc, a.stored).cmp(&(b.crc, b.stored)))
    });
    let before = pages.iter().take_while(|(_, e)| e.tier == 0 && holds(e)).count();
    let masks = index.masks();
    let (mut order, mut named) = (Vec::new(), vec![false; index.sections.len()]);
    let mut color = |order: &mut Vec<usize>, page: &Entry| {
        let palette = page.palette.map(|p| p as usize).filter(|&p| !std::mem::replace(&mut named[p], true));
        order.extend(palette);
    };
    for (place, &(i, page)) in pages.iter().enumerate() {
        if place >= before {
            color(&mut order, page);
        }
        order.push(i);
        if let Ok(at) = masks.binary_search_by_key(&(i as u32), |(page, _)| *page) {
            order.push(masks[at].1);
        }
        if place + 1 == before {
            pages[..before].iter().for_each(|(_, page)| color(&mut order, page));
        }
    }
    let labels = index.of_pages(Kind::Labels);
    for (page, _) in &pages {
        if let Ok(at) = labels.binary_search_by_key(&(*page as u32), |(page, _)| *page) {
            order.push(labels[at].1);
        }
    }
    order
}

/// The index of a file, at any position. Errors: not a playback file, damage, those of the file.
fn read_index(file: &mut (impl Read + Seek)) -> Result<Index> {
    let mut header = [0; HEADER_BYTES];
    file.seek(SeekFrom::Start(0)).and_then(|_| file.read_exact(&mut header)).map_err(unread)?;
    let place = Index::place(&header)?;
    let mut bytes = Vec::new();
    file.seek(SeekFrom::Start(place.start)).map_err(unread)?;
    file.take(place.end - place.start).read_to_end(&mut bytes).map_err(unread)?;
    Index::of(&header, &bytes)
}

fn unread(e: std::io::Error) -> Error {
    Error::io("the playback file cannot be read", e).remedy("Delete it: it is made again of the chunks")
}

fn unwritten(e: std::io::Error) -> Error {
    Error::environment("the scene could not be written", e)
        .remedy("Check that there is space, and run the same command again")
}
