//! Masks: which Gaussians of a page are rendered when, a bit a Gaussian and key time (docs/format.md, "Masks").

use super::index::{MASK_HEAD, MAX_KEYS, broken, mask_keys};
use super::page::unpack;
use super::{Entry, Kind};
use crate::scene::KeyMasks;
use crate::scene::masks::WORD;
use crate::{Error, Result};

/// Bytes of a word of [`KeyMasks`].
const WORD_BYTES: usize = WORD / 8;

/// Decodes masks from their stored bytes. Errors: they are not the entry's, or do not hold together.
pub(crate) fn decode_masks(entry: &Entry, stored: &[u8]) -> Result<KeyMasks> {
    assert!(entry.kind == Kind::Masks, "only masks are decoded as such");
    parse(&unpack(entry, stored)?, entry)
}

fn parse(bytes: &[u8], entry: &Entry) -> Result<KeyMasks> {
    let rows = entry.count as usize;
    let stated = u32::from_le_bytes(std::array::from_fn(|b| bytes[b])) as usize;
    let keys = mask_keys(rows, bytes.len()).filter(|k| *k == stated);
    let keys = keys.ok_or_else(|| broken(format!("masks claim {stated} key times in {} bytes", bytes.len())))?;
    let (times, rest) = bytes[MASK_HEAD..].split_at(8 * keys);
    let times: Vec<f64> = times.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
    let rising = times.windows(2).all(|w| w[0] < w[1]) && times.iter().all(|t| t.is_finite());
    if !rising || [times[0], times[keys - 1]] != entry.span {
        return Err(broken("the key times of masks do not rise from the first to the last that is stated".into()));
    }
    let width = rows.div_ceil(8);
    let mut words = Vec::with_capacity(keys * rows.div_ceil(WORD));
    let mut row = vec![0u8; width];
    for key in rest.chunks_exact(width) {
        row.iter_mut().zip(key).for_each(|(bits, change)| *bits ^= change);
        let word = |bytes: &[u8]| bytes.iter().enumerate().fold(0, |word, (i, b)| word | u32::from(*b) << (8 * i));
        words.extend(row.chunks(WORD_BYTES).map(word));
        // Bits beyond the last Gaussian mean nothing.
        if let Some(last) = words.last_mut().filter(|_| !rows.is_multiple_of(WORD)) {
            *last &= !(!0 << (rows % WORD));
        }
    }
    Ok(KeyMasks::from_words(times, rows, words).expect("as many words as the size states, none with a spare bit"))
}

/// The decoded bytes. Errors: more key times than a file holds.
pub(super) fn bytes(masks: &KeyMasks) -> Result<Vec<u8>> {
    let (keys, rows) = (masks.times().len(), masks.rows());
    if keys > MAX_KEYS {
        return Err(Error::input(format!("{keys} key times of masks"))
            .remedy(format!("A file holds at most {MAX_KEYS}: let more frames lie between them")));
    }
    let (stride, width) = (rows.div_ceil(WORD), rows.div_ceil(8));
    let mut out = Vec::with_capacity(MASK_HEAD + keys * (8 + width));
    out.extend_from_slice(&(keys as u32).to_le_bytes());
    out.extend_from_slice(&0u32.to_le_bytes());
    masks.times().iter().for_each(|t| out.extend_from_slice(&t.to_le_bytes()));
    // What changes from key to key is little, and that little deflates well.
    let mut before = vec![0u32; stride];
    for key in 0..keys {
        let now = &masks.words()[key * stride..(key + 1) * stride];
        let start = out.len();
        now.iter().zip(&before).for_each(|(a, b)| out.extend_from_slice(&(a ^ b).to_le_bytes()));
        out.truncate(start + width);
        before.copy_from_slice(now);
    }
    Ok(out)
}
