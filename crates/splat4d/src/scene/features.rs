//! Feature channels: numbers per Gaussian learnt from images of features (outputs of a network on an image, or any
//! other numbers per pixel), in a table of the layer that follows every edit of rows.

use super::{Key, Params, Space, Table};
use crate::Result;
use crate::math::Real;

/// Name of the table and of its column group, as files show it: `feature_channels` [N, channels].
pub const FEATURES: &str = "feature_channels";
/// Most channels of a scene: a row then weighs as much as four times its spherical harmonics.
pub const MOST_CHANNELS: usize = 64;

/// Adds the table of `count` channels, filled from what was loaded, else with zeros.
///
/// Errors: loaded numbers of another shape. Panics: the layer has the table already.
pub fn claim<F: Real>(params: &mut Params<F>, count: usize) -> Result<Key> {
    let rows = params.len();
    params.entry(FEATURES, Space::Gaussians, &[(FEATURES, count)], rows, |_| {})
}

/// Gives the layer `count` channels of zeros, in place of those that it had.
///
/// Errors: as [`claim`].
pub fn reset<F: Real>(params: &mut Params<F>, count: usize) -> Result<Key> {
    let Some(key) = key(params) else { return claim(params, count) };
    let empty = Table::new(&[(FEATURES, count)], params.len());
    params.replace(key, empty);
    Ok(key)
}

/// The table of a layer; `None`: its Gaussians have no features.
pub fn key<F: Real>(params: &Params<F>) -> Option<Key> {
    params.find(FEATURES)
}

/// How like two rows' features are: the cosine of the angle between them; 0 where either has none.
pub fn likeness(a: &[f32], b: &[f32]) -> f64 {
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum::<f64>();
    let lengths = (dot(a, a) * dot(b, b)).sqrt();
    if lengths > 0.0 { dot(a, b) / lengths } else { 0.0 }
}

/// The features of a row.
pub fn row<F: Real>(params: &Params<F>, key: Key, row: usize) -> Vec<f32> {
    (0..params[key].width()).map(|k| params[key].get(row, k).f64() as f32).collect()
}
