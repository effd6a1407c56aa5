//! The codec's memory as words of a checkpoint: degree, entries, layers; a layer's rows, tier and labels (two a word);
//! the palette's entries and their moments as the bits of f32.

use super::Memory;
use super::shared::Shared;
use crate::{Error, Result};
use splat4d::format::playback::{BLOCK_GAUSSIANS, MAX_PALETTE};

/// Most degrees of spherical harmonics.
const MAX_DEGREE: u32 = 3;

/// The memory as words.
pub(super) fn words(m: &Memory) -> Vec<u32> {
    let (degree, entries) = m.shared.as_ref().map_or((0, 0), |s| (s.degree(), s.entries()));
    let mut out = vec![degree as u32, entries as u32, m.dirty.len() as u32];
    for (i, tier) in m.tiers.iter().enumerate() {
        let labels = &m.labels[i];
        out.extend([labels.len() as u32, u32::from(*tier)]);
        let pair = |two: &[u16]| u32::from(two[0]) | two.get(1).map_or(0, |&high| u32::from(high) << 16);
        out.extend(labels.chunks(2).map(pair));
    }
    for table in m.shared.iter().flat_map(Shared::tables) {
        out.extend(table.column_to_rows(0, table.width()).into_iter().map(f32::to_bits));
    }
    out
}

/// The memory in words; all blocks are to be shown. Errors: words that no memory gives.
pub(super) fn memory(words: &[u32]) -> Result<Memory> {
    let mut rest = Words(words);
    let [degree, entries, layers] = rest.take(3)?.try_into().expect("three words were taken");
    let sound = degree <= MAX_DEGREE && entries as usize <= MAX_PALETTE && (degree == 0) == (entries == 0);
    if !sound {
        return Err(damaged());
    }
    let mut out = Memory { labels: Vec::new(), tiers: Vec::new(), shared: None, dirty: Vec::new() };
    for _ in 0..layers {
        let [rows, tier] = rest.take(2)?.try_into().expect("two words were taken");
        let pairs = rest.take(rows.div_ceil(2) as usize)?;
        let labels: Vec<u16> = pairs.iter().flat_map(|w| [*w as u16, (w >> 16) as u16]).take(rows as usize).collect();
        if entries > 0 && labels.iter().any(|l| u32::from(*l) >= entries) {
            return Err(damaged());
        }
        out.tiers.push(u16::try_from(tier).map_err(|_| damaged())?);
        out.dirty.push(vec![true; (rows as usize).div_ceil(BLOCK_GAUSSIANS)]);
        out.labels.push(labels);
    }
    if entries > 0 {
        let mut shared = Shared::empty(degree as usize, entries as usize);
        for table in shared.tables_mut() {
            let numbers: Vec<f32> =
                rest.take(table.rows() * table.width())?.iter().map(|&w| f32::from_bits(w)).collect();
            table.column_from_rows(0, table.width(), &numbers);
        }
        out.shared = Some(shared);
    }
    if rest.0.is_empty() { Ok(out) } else { Err(damaged()) }
}

/// Words that are still to be read.
struct Words<'a>(&'a [u32]);

impl<'a> Words<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [u32]> {
        let (head, tail) = self.0.split_at_checked(count).ok_or_else(damaged)?;
        self.0 = tail;
        Ok(head)
    }
}

fn damaged() -> Error {
    Error::input("the checkpoint is damaged: its quantised scene is inconsistent")
        .remedy("Delete it; the run continues from the one before")
}
