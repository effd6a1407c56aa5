//! Labels: what each Gaussian of a page is part of, a byte a Gaussian (docs/format.md, "Labels").

use super::index::broken;
use super::page::unpack;
use super::{Entry, Kind};
use crate::Result;
use crate::scene::{Params, labels};

/// The byte of a Gaussian that has no label.
const NONE: u8 = u8::MAX;

/// Gives the rows of a page their labels, of `count`. Errors: the section is damaged, or numbers a label that there is not.
pub(super) fn decode(entry: &Entry, stored: &[u8], count: usize, params: &mut Params<f32>) -> Result<()> {
    assert!(entry.kind == Kind::Labels, "only labels are decoded as such");
    let bytes = unpack(entry, stored)?;
    if let Some(row) = bytes.iter().position(|&b| b != NONE && usize::from(b) >= count) {
        return Err(broken(format!("Gaussian {row} has label {} of {count}", bytes[row])));
    }
    let all: Vec<Option<usize>> = bytes.iter().map(|&b| (b != NONE).then_some(usize::from(b))).collect();
    labels::state(params, count, &all);
    Ok(())
}

/// The decoded bytes; `None`: no Gaussian has a label.
pub(super) fn bytes(labels: impl Iterator<Item = Option<u8>>) -> Option<Vec<u8>> {
    let out: Vec<u8> = labels.map(|l| l.unwrap_or(NONE)).collect();
    out.iter().any(|&b| b != NONE).then_some(out)
}

/// The labels of a layer's rows as a file holds them.
pub(crate) fn of_layer(params: &Params<f32>) -> Vec<Option<u8>> {
    labels::of(params).into_iter().map(|l| l.and_then(|l| u8::try_from(l).ok()).filter(|&l| l != NONE)).collect()
}
