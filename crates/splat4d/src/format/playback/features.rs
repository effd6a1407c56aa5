//! Features: the feature channels of each Gaussian of a page, a byte a channel (docs/format.md, "Features").

use super::index::broken;
use super::page::unpack;
use super::{Entry, Kind};
use crate::Result;
use crate::layers::Scene;
use crate::scene::{Params, features};

/// The byte, in all channels, of a Gaussian that has no features.
const NONE: u8 = 0;
/// Steps of a channel's range.
const STEPS: f32 = 254.0;

/// Least and greatest number of each feature channel of a scene; empty: it has none.
pub fn feature_ranges(scene: &Scene<f32>) -> Vec<[f32; 2]> {
    let mut out = vec![[f32::INFINITY, f32::NEG_INFINITY]; scene.feature_channels()];
    for layer in &scene.layers {
        let Some(key) = features::key(&layer.params) else { continue };
        for row in 0..layer.params.len() {
            for (c, [low, high]) in out.iter_mut().enumerate() {
                let x = layer.params[key].get(row, c);
                (*low, *high) = (low.min(x), high.max(x));
            }
        }
    }
    out.into_iter().map(|[low, high]| if low <= high { [low, high] } else { [0.0; 2] }).collect()
}

/// The decoded bytes, channel after channel; `None`: no Gaussian has features.
pub(super) fn bytes<'a>(ranges: &[[f32; 2]], rows: impl Iterator<Item = &'a [f32]>) -> Option<Vec<u8>> {
    let rows: Vec<&[f32]> = rows.collect();
    let has = |f: &[f32]| f.iter().any(|x| *x != 0.0);
    if ranges.is_empty() || !rows.iter().any(|f| has(f)) {
        return None;
    }
    let code = |f: &[f32], c: usize| {
        let [low, high] = ranges[c];
        if !has(f) {
            NONE
        } else if high > low {
            1 + (STEPS * ((f[c] - low) / (high - low)).clamp(0.0, 1.0)).round() as u8
        } else {
            1
        }
    };
    Some((0..ranges.len()).flat_map(|c| rows.iter().map(move |f| code(f, c))).collect())
}

/// Gives the rows of a page their features. Errors: the section is damaged, or has another number of channels than there are
/// ranges.
pub(super) fn decode(entry: &Entry, stored: &[u8], ranges: &[[f32; 2]], params: &mut Params<f32>) -> Result<()> {
    assert!(entry.kind == Kind::Features, "only features are decoded as such");
    let (bytes, rows) = (unpack(entry, stored)?, params.len());
    if bytes.len() != rows * ranges.len() {
        return Err(broken(format!(
            "features of {rows} Gaussians in {} channels have {} bytes",
            ranges.len(),
            bytes.len()
        )));
    }
    let key = features::claim(params, ranges.len())?;
    for (c, (plane, [low, high])) in bytes.chunks_exact(rows.max(1)).zip(ranges).enumerate() {
        for (row, &code) in plane.iter().enumerate().filter(|(_, code)| **code != NONE) {
            params[key].set(row, c, low + (high - low) * f32::from(code - 1) / STEPS);
        }
    }
    Ok(())
}

/// The features of a layer's rows as a file's writer takes them; empty: there are none.
pub(crate) fn of_layer(params: &Params<f32>) -> Vec<Vec<f32>> {
    let key = features::key(params);
    (0..params.len()).map(|row| key.map_or_else(Vec::new, |key| features::row(params, key, row))).collect()
}
