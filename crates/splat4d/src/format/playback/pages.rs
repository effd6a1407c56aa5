//! A playback file taken apart into layers that can be changed, and put together again: the same pages, rows in the
//! same order, labels and palette unchanged.

use super::block::turn_over;
use super::coder::{Encode, Rows};
use super::layer::keys;
use super::page::page_of;
use super::read::Parts;
use super::write::{PageEntry, Sections};
use super::{
    BLOCK_GAUSSIANS, MAX_PAGE_GAUSSIANS, Meta, PAGE_WORDS, Palette, Summary, WriteConfig, features_of, labels_of,
};
use crate::layers::{Layer, Scene};
use crate::scene::SH;
use crate::simd::{Simd, dispatch};
use crate::{Error, ErrorKind, Result};
use rayon::prelude::*;
use std::io::Write;

/// Contents of a playback file, apart from its poster.
#[derive(Clone, Debug)]
pub struct Pages {
    /// About the scene.
    pub meta: Meta,
    /// One per page, in the file's order, rows as in the file; they hold the palette's coefficients.
    pub layers: Vec<Layer<f32>>,
    /// Of every page its Gaussians' entries of the palette.
    pub labels: Vec<Vec<u16>>,
    /// Spherical harmonics above degree 0; none: base colours only.
    pub palette: Option<Palette>,
    /// Of every page how important it is, 0 the most.
    pub tiers: Vec<u16>,
}

impl Pages {
    /// The pages as a scene.
    pub fn scene(&self) -> Scene<f32> {
        self.meta.scene(self.layers.clone())
    }

    /// The same, to be written.
    pub fn draft<'a>(&'a self, poster: Option<&'a [u8]>) -> PagesDraft<'a> {
        let Self { meta, layers, labels, palette, tiers } = self;
        PagesDraft { meta, layers, labels, palette: palette.as_ref(), tiers, poster }
    }
}

/// The input of [`write_pages`].
#[derive(Clone, Copy, Debug)]
pub struct PagesDraft<'a> {
    /// About the scene; `gaussians` is counted by the writer.
    pub meta: &'a Meta,
    /// One per page with its span and, where it has some, its masks, in the order of the file. A layer without rows is
    /// left out.
    pub layers: &'a [Layer<f32>],
    /// Of every layer its rows' entries of the palette.
    pub labels: &'a [Vec<u16>],
    /// The entries that the labels number; none: base colours only, and labels are not examined.
    pub palette: Option<&'a Palette>,
    /// Of every layer.
    pub tiers: &'a [u16],
    /// A JPEG or PNG image.
    pub poster: Option<&'a [u8]>,
}

/// Reads a whole file as pages to work on.
///
/// Errors: those of [`read`](super::read()); a file with several palettes.
pub fn read_pages(bytes: &[u8]) -> Result<Pages> {
    let Parts { meta, mut palettes, pages } = Parts::read(bytes)?;
    let several = palettes.len() > 1;
    let mixed = !palettes.is_empty() && pages.iter().any(|p| p.palette.is_none());
    if several || mixed {
        let what = if several { "several palettes" } else { "pages with a palette and pages without" };
        return Err(Error::new(ErrorKind::Unsupported, format!("the file has {what}, which cannot be changed here"))
            .remedy("Bake the scene again with this splat4d, which writes one palette"));
    }
    let palette = palettes.pop().map(|(_, p)| p);
    let mut out = Pages { meta, layers: Vec::new(), labels: Vec::new(), palette, tiers: Vec::new() };
    for page in pages {
        out.layers.push(page.layer);
        out.labels.push(page.labels);
        out.tiers.push(page.tier);
    }
    Ok(out)
}

/// Writes pages in the order in which they are given; of `config` only depths and the effort of deflate count. What
/// [`read`](super::read()) gives back is what [`Coder::show`](super::Coder::show) shows of these layers, bit for bit.
/// The errors in the summary are not measured.
///
/// Errors: numbers that are not finite, labels beyond the palette, spans, depths or metadata out of range, a page with
/// too many rows, the sink's. Panics: lists of different lengths, a layer that is none that a page gives.
pub fn write_pages(draft: &PagesDraft<'_>, config: &WriteConfig, out: &mut dyn Write) -> Result<Summary> {
    let n = draft.layers.len();
    assert!(draft.tiers.len() == n, "{} tiers of {n} layers", draft.tiers.len());
    assert!(draft.palette.is_none() || draft.labels.len() == n, "{} lists of labels of {n}", draft.labels.len());
    config.depths.check()?;
    for (i, layer) in draft.layers.iter().enumerate() {
        check(layer, draft, i).map_err(|e| e.at(format!("layer {i}")))?;
    }
    let gaussians = draft.layers.iter().map(|l| l.params.len()).sum();
    let sh_degree = draft.palette.map_or(0, |p| p.degree);
    // Rates of a ladder belong to the pages that they were measured of.
    let meta = Meta { gaussians, sh_degree, ladder: Vec::new(), ..draft.meta.clone() };
    let start = meta.clip[0];
    let mut file = Sections::new(meta, draft.poster, config.deflate_level)?;
    let pages: Vec<usize> = (0..n).filter(|&i| !draft.layers[i].params.is_empty()).collect();
    // As in `write`: before the palette come the important Gaussians of the clip's start, in their base colours.
    let first =
        |i: &&usize| draft.tiers[**i] == 0 && draft.layers[**i].span[0] <= start && start < draft.layers[**i].span[1];
    let before = pages.iter().take_while(first).count();
    let masked = pages[..before].iter().filter(|i| draft.layers[**i].masks.is_some()).count();
    let palette_at = draft.palette.map(|_| (file.file.sections.len() + before + masked) as u32);
    for place in 0..=pages.len() {
        if let Some(p) = draft.palette.filter(|_| place == before) {
            file.palette(p);
        }
        let Some(&i) = pages.get(place) else { break };
        let layer = &draft.layers[i];
        let labels = if draft.palette.is_some() { draft.labels[i].as_slice() } else { &[] };
        let body = encode(layer, labels, config);
        let entry =
            PageEntry { tier: draft.tiers[i], count: layer.params.len(), span: layer.span, palette: palette_at };
        file.page(body, &entry);
        if let Some(masks) = &layer.masks {
            file.masks(masks).map_err(|e| e.at(format!("layer {i}")))?;
        }
        if !draft.meta.labels.is_empty() {
            file.labels(labels_of(&layer.params).into_iter());
        }
        file.features(features_of(&layer.params).iter().map(Vec::as_slice));
    }
    file.finish(out)
}

/// The decoded bytes of a page.
fn encode(layer: &Layer<f32>, labels: &[u16], config: &WriteConfig) -> Vec<u8> {
    let keys = keys(layer);
    let mut words = vec![[0; PAGE_WORDS]; layer.params.len()];
    let block = |(k, words): (usize, &mut [[u32; PAGE_WORDS]])| {
        let (first, count) = (k * BLOCK_GAUSSIANS, words.len());
        let labels = labels.get(first..first + count).unwrap_or(&[]);
        let source = Rows { layer, keys, labels, first, count };
        let mut columns = [[0; BLOCK_GAUSSIANS]; PAGE_WORDS];
        let header = dispatch(Simd::detect(), Encode { source, depths: &config.depths, words: &mut columns });
        turn_over(&columns, words);
        header
    };
    let headers: Vec<_> = words.par_chunks_mut(BLOCK_GAUSSIANS).enumerate().map(block).collect();
    page_of(&headers, &words)
}

/// Refuses what cannot be written.
fn check(layer: &Layer<f32>, draft: &PagesDraft<'_>, i: usize) -> Result<()> {
    let (keys, [from, to], rows) = (keys(layer), layer.span, layer.params.len());
    if !(from.is_finite() && to.is_finite() && from < to) {
        return Err(Error::input(format!("a part of a scene cannot last from {from} to {to} s")));
    }
    if rows > MAX_PAGE_GAUSSIANS {
        return Err(Error::input(format!("{rows} Gaussians in one page"))
            .remedy(format!("A page holds {MAX_PAGE_GAUSSIANS}; bake the scene again")));
    }
    if let Some(masks) = layer.masks.as_ref().filter(|m| m.rows() != rows) {
        return Err(Error::input(format!("masks of {} Gaussians for {rows}", masks.rows())));
    }
    for key in keys.into_iter().filter(|k| *k != SH) {
        if let Some((row, _)) = layer.params[key].first_non_finite() {
            return Err(not_finite(row));
        }
    }
    if let Some(row) = (0..rows).find(|&r| layer.params[SH].read::<3>(r, 0).iter().any(|x| !x.is_finite())) {
        return Err(not_finite(row));
    }
    let Some(palette) = draft.palette else { return Ok(()) };
    let labels = &draft.labels[i];
    if labels.len() != rows {
        return Err(Error::input(format!("{} labels of {rows} Gaussians", labels.len())));
    }
    match labels.iter().position(|l| usize::from(*l) >= palette.entries) {
        Some(row) => {
            let what = format!("Gaussian {row} has entry {} of a palette of {}", labels[row], palette.entries);
            Err(Error::input(what))
        }
        None => Ok(()),
    }
}

fn not_finite(row: usize) -> Error {
    Error::input(format!("Gaussian {row} holds NaN or infinity"))
        .remedy("Leave it out, or train or export the scene again")
}
