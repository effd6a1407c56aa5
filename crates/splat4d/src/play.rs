//! Plays a scene on the CPU: which Gaussians are alive at a time is looked up, not computed, and a playback file is
//! read as time demands, within a budget of memory.
//!
//! Like everything here it reads bytes, not paths: a file is whatever implements [`ReadAt`].

#[cfg(test)]
mod tests;

use crate::device;
use crate::format::playback::{Entry, Index, Kind, Meta, Palette, decode_masks, decode_page, decode_palette};
use crate::layers::{ALWAYS, Evaluation, Layer, Scene};
use crate::render::{Image, RenderConfig, Shot};
use crate::scene::masks::WORD;
use crate::scene::{Camera, HeadWeights, KeyMasks, Rows, Space, Splats, Time};
use crate::{Error, Result};
use rayon::prelude::*;
use std::borrow::Cow;
use std::sync::Arc;

/// Rows that share one test of whether any of them is alive: the blocks of the playback file.
const BLOCK: usize = crate::format::playback::BLOCK_GAUSSIANS;
/// Memory for unpacked pages by default, bytes.
pub const DEFAULT_BUDGET: usize = 1 << 30;

/// An image of a scene at a time, on the CPU, over the scene's own background. To render many, keep a [`Player`], a
/// [`Backend`](crate::render::Backend) and an [`Image`].
///
/// Errors: a driver's; the CPU has none.
pub fn draw(scene: &Scene<f32>, camera: &Camera, t: Time) -> Result<Image> {
    let (mut player, mut image) = (Player::of_scene(scene), Image::default());
    let splats = player.at(t)?;
    device::cpu(RenderConfig::default()).render(&Shot::new(&splats, camera, scene.background), &mut image)?;
    Ok(image)
}

/// Bytes at an offset of something long, such as a file.
pub trait ReadAt {
    /// Fills `out` from byte `offset` on. Errors: they are not there, or cannot be read.
    fn read_at(&mut self, offset: u64, out: &mut [u8]) -> Result<()>;
}

impl ReadAt for &[u8] {
    fn read_at(&mut self, offset: u64, out: &mut [u8]) -> Result<()> {
        let from = usize::try_from(offset).ok().and_then(|o| self.get(o..)).and_then(|rest| rest.get(..out.len()));
        let from = from.ok_or_else(|| {
            Error::input(format!("{} bytes at {offset} are not there: the file is cut short", out.len()))
                .remedy("Copy or download it again")
        })?;
        out.copy_from_slice(from);
        Ok(())
    }
}

/// When the rows of one layer are alive.
#[derive(Debug, Default)]
struct Alive {
    /// All Gaussians are always alive: all rows are used.
    all: bool,
    /// [from, to] of every row, seconds; from > to: never.
    spans: Vec<[f64; 2]>,
    /// [earliest, latest] of every block of rows.
    blocks: Vec<[f64; 2]>,
}

impl Alive {
    fn of(layer: &Layer) -> Self {
        // Evaluated within its span, because outside of it no Gaussian is alive.
        let inside = if layer.span[0].is_finite() { layer.span[0] } else { 0.0 };
        if layer.active(Time(inside), &mut Vec::new()) {
            return Self { all: true, ..Self::default() };
        }
        let spans = layer.spans();
        let block = |rows: &[[f64; 2]]| {
            rows.iter()
                .filter(|[from, to]| from <= to)
                .fold([f64::INFINITY, f64::NEG_INFINITY], |all, [from, to]| [all[0].min(*from), all[1].max(*to)])
        };
        let blocks = spans.chunks(BLOCK).map(block).collect();
        Self { all: false, spans, blocks }
    }

    /// The rows alive at t whom the masks admit, strictly increasing.
    fn rows(&self, t: f64, masks: Option<&KeyMasks>, ids: &mut Vec<u32>) {
        ids.clear();
        if let Some(masks) = masks {
            return self.masked(t, masks, ids);
        }
        for (b, _) in self.blocks.iter().enumerate().filter(|(_, [from, to])| *from <= t && t <= *to) {
            let first = b * BLOCK;
            let rows = &self.spans[first..self.spans.len().min(first + BLOCK)];
            let alive = rows.iter().enumerate().filter(|(_, [from, to])| *from <= t && t <= *to);
            ids.extend(alive.map(|(i, _)| (first + i) as u32));
        }
    }

    /// The same with masks: only rows whose bit is set are examined, so that masks make the lookup faster.
    fn masked(&self, t: f64, masks: &KeyMasks, ids: &mut Vec<u32>) {
        let [left, right] = masks.words_at(t);
        for (b, _) in self.blocks.iter().enumerate().filter(|(_, [from, to])| *from <= t && t <= *to) {
            let words = b * BLOCK_WORDS..left.len().min((b + 1) * BLOCK_WORDS);
            for w in words {
                let mut bits = left[w] | right[w];
                while bits != 0 {
                    let row = w * WORD + bits.trailing_zeros() as usize;
                    bits &= bits - 1;
                    let [from, to] = self.spans[row];
                    if from <= t && t <= to {
                        ids.push(row as u32);
                    }
                }
            }
        }
    }
}

/// Words of masks that a block of rows has.
const BLOCK_WORDS: usize = BLOCK / WORD;
const _: () = assert!(BLOCK.is_multiple_of(WORD));

/// A layer in memory.
#[derive(Debug)]
struct Held<'a> {
    /// Its section in the file; its number in the scene.
    section: usize,
    layer: Cow<'a, Layer>,
    alive: Alive,
    ids: Vec<u32>,
    evaluation: Evaluation,
    bytes: usize,
}

impl<'a> Held<'a> {
    fn new(section: usize, layer: Cow<'a, Layer>) -> Self {
        let alive = Alive::of(&layer);
        let numbers: usize = layer.params.keys().map(|k| layer.params[k].data().len()).sum();
        let words = layer.masks.as_ref().map_or(0, |m| m.words().len() + 2 * m.times().len());
        let bytes = 4 * (numbers + words) + 16 * alive.spans.len();
        Self { section, layer, alive, ids: Vec::new(), evaluation: Evaluation::default(), bytes }
    }

    /// Finds the Gaussians alive at t; returns their number.
    fn look_up(&mut self, t: Time) -> usize {
        if self.alive.all {
            return self.layer.params.len();
        }
        self.alive.rows(t.0, self.layer.masks.as_deref(), &mut self.ids);
        self.ids.len()
    }
}

/// Source of layers that are not in memory.
struct File {
    source: Box<dyn ReadAt + Send>,
    index: Index,
    /// Pages that have masks, and the sections of these, by page.
    masks: Vec<(u32, usize)>,
    /// By section, read on first use by a page.
    palettes: Vec<(u32, Palette)>,
}

/// Shows a scene or a playback file at any time.
pub struct Player<'a> {
    file: Option<File>,
    meta: Meta,
    held: Vec<Held<'a>>,
    head: Option<HeadWeights<'a>>,
    budget: usize,
    /// Places in `held` of what the last [`at`](Self::at) shows.
    shown: Vec<usize>,
    /// Bytes read from the source.
    bytes_read: u64,
}

impl std::fmt::Debug for Player<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Player({} layers held, {} bytes)", self.held.len(), self.held_bytes())
    }
}

impl<'a> Player<'a> {
    /// Plays a scene that is in memory.
    pub fn of_scene(scene: &'a Scene<f32>) -> Self {
        let meta = Meta {
            clip: scene.clip,
            fps: scene.fps,
            up: scene.up,
            offset: scene.offset,
            background: scene.background,
            gaussians: scene.len(),
            ..Meta::default()
        };
        let held = scene.layers.par_iter().enumerate().map(|(i, layer)| Held::new(i, Cow::Borrowed(layer))).collect();
        let (head, shown) = (scene.head_weights(), Vec::new());
        Self { file: None, meta, held, head, budget: usize::MAX, shown, bytes_read: 0 }
    }

    /// Plays a playback file of `length` bytes, of which only the index is read now. Pages stay in memory up to
    /// `budget` bytes; those that one time needs stay in any case.
    ///
    /// Errors: those of [`Index::parse`] and of the source.
    pub fn open(mut source: Box<dyn ReadAt + Send>, length: u64, budget: usize) -> Result<Self> {
        let mut prefix = Vec::new();
        loop {
            let needed = Index::needed(&prefix)? as u64;
            let have = prefix.len();
            if needed <= have as u64 {
                break;
            }
            // Beyond the end nothing is requested: reading reports the truncation.
            let want = needed.min(length) as usize;
            if want <= have {
                break;
            }
            prefix.resize(want, 0);
            source.read_at(have as u64, &mut prefix[have..])?;
        }
        let index = Index::parse(&prefix, Some(length))?;
        let meta = index.meta.clone();
        let file = File { source, masks: index.masks(), index, palettes: Vec::new() };
        let bytes_read = prefix.len() as u64;
        Ok(Self { file: Some(file), meta, held: Vec::new(), head: None, budget, shown: Vec::new(), bytes_read })
    }

    /// The scene's metadata.
    pub fn meta(&self) -> &Meta {
        &self.meta
    }

    /// Bytes read, the index included.
    #[cfg(test)]
    pub(crate) fn bytes_read(&self) -> u64 {
        self.bytes_read
    }

    /// Bytes of the layers in memory.
    pub(crate) fn held_bytes(&self) -> usize {
        self.held.iter().map(|h| h.bytes).sum()
    }

    /// Gaussians in memory that are alive at t: the lookup alone, without any of their motion.
    pub fn alive(&mut self, t: Time) -> usize {
        self.held.iter_mut().filter(|h| h.layer.spans_over(t)).map(|h| h.look_up(t)).sum()
    }

    /// The splats at time t; a playback file's time is clamped to its clip.
    ///
    /// Errors: a page that cannot be read. The previous pages stay in memory then.
    pub fn at(&mut self, t: Time) -> Result<Splats<'_>> {
        let clamp = self.file.is_some() || self.held.iter().any(|h| h.layer.span != ALWAYS);
        let t = if clamp { Time(t.0.max(self.meta.clip[0]).min(self.meta.clip[1])) } else { t };
        self.load(t)?;
        self.shown.clear();
        self.shown.extend((0..self.held.len()).filter(|&i| self.held[i].layer.spans_over(t)));
        self.held.par_iter_mut().filter(|h| h.layer.spans_over(t)).for_each(|h| {
            h.look_up(t);
            let rows = if h.alive.all { Rows::All } else { Rows::Some(&h.ids) };
            h.evaluation.begin();
            h.evaluation.request(0, Space::Gaussians, rows, t);
            h.evaluation.evaluate(std::slice::from_ref(h.layer.as_ref()));
        });
        let parts = self.shown.iter().map(|&i| self.held[i].layer.part(self.held[i].evaluation.tape(0))).collect();
        Ok(Splats { parts, head: self.head })
    }

    /// Brings the pages of t into memory, and drops those farthest in time when memory is full.
    fn load(&mut self, t: Time) -> Result<()> {
        let Some(file) = &mut self.file else { return Ok(()) };
        let wanted: Vec<(usize, Entry)> = file.index.pages_at(t.0).into_iter().map(|(i, e)| (i, e.clone())).collect();
        for (section, entry) in wanted {
            let Err(place) = self.held.binary_search_by_key(&section, |h| h.section) else { continue };
            let stored = file.stored(&entry, &mut self.bytes_read)?;
            let palette = file.palette(entry.palette, &mut self.bytes_read)?;
            let page = decode_page(&entry, &stored).map_err(|e| e.at(format!("section {section}")))?;
            let mut layer = page.layer(palette).map_err(|e| e.at(format!("section {section}")))?;
            layer.masks = file.masks(section, &mut self.bytes_read)?;
            self.held.insert(place, Held::new(section, Cow::Owned(layer)));
        }
        let distance = |h: &Held<'_>| (h.layer.span[0] - t.0).max(t.0 - h.layer.span[1]).max(0.0);
        while self.held_bytes() > self.budget {
            let idle = self.held.iter().enumerate().filter(|(_, h)| !h.layer.spans_over(t));
            let Some((far, _)) = idle.max_by(|a, b| distance(a.1).total_cmp(&distance(b.1))) else { break };
            self.held.remove(far);
        }
        Ok(())
    }
}

impl File {
    fn stored(&mut self, entry: &Entry, count: &mut u64) -> Result<Vec<u8>> {
        let mut bytes = vec![0; entry.stored as usize];
        self.source.read_at(entry.offset, &mut bytes)?;
        *count += u64::from(entry.stored);
        Ok(bytes)
    }

    fn masks(&mut self, page: usize, count: &mut u64) -> Result<Option<Arc<KeyMasks>>> {
        let Ok(at) = self.masks.binary_search_by_key(&(page as u32), |(page, _)| *page) else { return Ok(None) };
        let section = self.masks[at].1;
        let entry = self.index.sections[section].clone();
        let bytes = self.stored(&entry, count)?;
        let masks = decode_masks(&entry, &bytes).map_err(|e| e.at(format!("section {section}")))?;
        Ok(Some(Arc::new(masks)))
    }

    fn palette(&mut self, section: Option<u32>, count: &mut u64) -> Result<Option<&Palette>> {
        let Some(section) = section else { return Ok(None) };
        if !self.palettes.iter().any(|(s, _)| *s == section) {
            let entry = self.index.sections[section as usize].clone();
            assert!(entry.kind == Kind::Palette, "the index has checked that a page's palette is one");
            let bytes = self.stored(&entry, count)?;
            let palette = decode_palette(&entry, &bytes).map_err(|e| e.at(format!("section {section}")))?;
            self.palettes.push((section, palette));
        }
        Ok(self.palettes.iter().find(|(s, _)| *s == section).map(|(_, p)| p))
    }
}
