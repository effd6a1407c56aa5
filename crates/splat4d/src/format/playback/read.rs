//! A whole playback file as a scene.

use super::index::broken;
use super::{Index, Kind, Meta, Palette, decode_masks, decode_page, decode_palette, features, labels};
use crate::layers::{Layer, Scene};
use crate::{Error, ErrorKind, Result};
use std::sync::Arc;

/// A whole file may unpack to this many times its length, and [`SMALL`] more, before it is taken for a trap: what a
/// scene is made of hardly shrinks, deflated zeros shrink a thousandfold.
const MOST_GROWTH: u64 = 64;
/// Bytes that any file may unpack to.
const SMALL: u64 = 64 << 20;

/// Reads a whole file: a layer a page, in the file's order. Gaussians are expanded from the palette.
///
/// Errors: not a playback file, a newer version, damage anywhere, a file that is cut short.
pub fn read(bytes: &[u8]) -> Result<Scene<f32>> {
    let Parts { meta, pages, .. } = Parts::read(bytes)?;
    let layers = pages.into_iter().map(|p| p.layer).collect();
    Ok(meta.scene(layers))
}

/// All that a file holds.
pub(super) struct Parts {
    pub meta: Meta,
    /// By section.
    pub palettes: Vec<(u32, Palette)>,
    pub pages: Vec<PagePart>,
}

/// A page of a file.
pub(super) struct PagePart {
    pub layer: Layer<f32>,
    pub labels: Vec<u16>,
    pub palette: Option<u32>,
    pub tier: u16,
}

impl Parts {
    /// Errors: as [`read`].
    pub(super) fn read(bytes: &[u8]) -> Result<Self> {
        let index = Index::parse(bytes, Some(bytes.len() as u64))?;
        if index.file_len > bytes.len() as u64 {
            return Err(broken(format!("it is cut short, {} of {} bytes are there", bytes.len(), index.file_len)));
        }
        let unpacked: u64 = index.sections.iter().map(|e| u64::from(e.bytes)).sum();
        if unpacked > MOST_GROWTH * bytes.len() as u64 + SMALL {
            let what = format!("the file has {} bytes and claims to unpack to {unpacked}", bytes.len());
            return Err(
                Error::new(ErrorKind::Unsupported, what).remedy("Bake the scene again; no program writes such files")
            );
        }
        let mut palettes: Vec<(u32, Palette)> = Vec::new();
        for (i, entry) in index.sections.iter().enumerate().filter(|(_, e)| e.kind == Kind::Palette) {
            let palette = decode_palette(entry, stored(bytes, entry)).map_err(|e| e.at(format!("section {i}")))?;
            palettes.push((i as u32, palette));
        }
        let (masks, labelled) = (index.masks(), index.of_pages(Kind::Labels));
        let featured = index.of_pages(Kind::Features);
        let names = index.meta.labels.len();
        let mut pages = Vec::new();
        for (i, entry) in index.pages() {
            let palette = entry.palette.and_then(|p| palettes.iter().find(|(at, _)| *at == p)).map(|(_, p)| p);
            let page = decode_page(entry, stored(bytes, entry)).map_err(|e| e.at(format!("section {i}")))?;
            let mut layer = page.layer(palette).map_err(|e| e.at(format!("section {i}")))?;
            layer.name = format!("page {}", pages.len());
            if let Ok(at) = masks.binary_search_by_key(&(i as u32), |(page, _)| *page) {
                let (i, entry) = (masks[at].1, &index.sections[masks[at].1]);
                let masks = decode_masks(entry, stored(bytes, entry)).map_err(|e| e.at(format!("section {i}")))?;
                layer.masks = Some(Arc::new(masks));
            }
            if let Ok(at) = labelled.binary_search_by_key(&(i as u32), |(page, _)| *page) {
                let (i, entry) = (labelled[at].1, &index.sections[labelled[at].1]);
                labels::decode(entry, stored(bytes, entry), names, &mut layer.params)
                    .map_err(|e| e.at(format!("section {i}")))?;
            }
            if let Ok(at) = featured.binary_search_by_key(&(i as u32), |(page, _)| *page) {
                let (i, entry) = (featured[at].1, &index.sections[featured[at].1]);
                features::decode(entry, stored(bytes, entry), &index.meta.features, &mut layer.params)
                    .map_err(|e| e.at(format!("section {i}")))?;
            }
            pages.push(PagePart { layer, labels: page.labels(), palette: entry.palette, tier: entry.tier });
        }
        Ok(Self { meta: index.meta, palettes, pages })
    }
}

/// A section's bytes. The index has seen that they are within the file.
fn stored<'a>(bytes: &'a [u8], entry: &super::Entry) -> &'a [u8] {
    let first = entry.offset as usize;
    &bytes[first..first + entry.stored as usize]
}
