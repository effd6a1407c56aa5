//! Importance of Gaussians: which to keep (`score()`, `prune`) and which to render when (`key_masks`).
//!
//! After 4DGS-1K (Yuan et al. 2025), for layers of any motion model: the importance of a Gaussian is its effect on the
//! training images, combined with its lifespan. Nothing is learned here; a scene recovers by further training.

mod masks;
mod score;
mod temporal;
#[cfg(test)]
mod tests;
mod weighing;

pub(crate) use masks::{MaskConfig, key_masks};
pub use score::Scores;
pub(crate) use score::{ScoreConfig, score};
pub use temporal::{Combine, Spatial, Temporal};

use splat4d::layers::Scene;
use splat4d::scene::{RowEdit, Space};

/// One edit a layer that takes away the share `ratio` (to the nearest whole number) of all Gaussians: those with the
/// lowest scores, the earlier layer and row first among equals. One always stays.
///
/// Apply it with [`TrainState::apply`](crate::train_state::TrainState::apply), which carries moments and statistics along, or with
/// `Layer::edit`. Panics: scores of
/// another scene, a ratio outside of 0 to 1.
pub(crate) fn prune(scene: &Scene<f32>, scores: &Scores, ratio: f64) -> Vec<RowEdit> {
    assert!((0.0..=1.0).contains(&ratio), "expected a share between 0 and 1, found {ratio}");
    let sizes =
        |rows: usize, layer: usize| assert_eq!(rows, scene.layers[layer].params.len(), "scores of layer {layer}");
    assert_eq!(scores.layers.len(), scene.layers.len(), "scores by layer");
    scores.layers.iter().enumerate().for_each(|(layer, s)| sizes(s.len(), layer));
    let count = ((ratio * scene.len() as f64).round() as usize).min(scene.len().saturating_sub(1));
    let mut order: Vec<(f64, usize, usize)> = Vec::with_capacity(scene.len());
    for (layer, scores) in scores.layers.iter().enumerate() {
        order.extend(scores.iter().enumerate().map(|(row, &s)| (s, layer, row)));
    }
    order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut keep: Vec<Vec<bool>> = scores.layers.iter().map(|s| vec![true; s.len()]).collect();
    for &(_, layer, row) in &order[..count] {
        keep[layer][row] = false;
    }
    keep.into_iter().map(|k| RowEdit::prune(Space::Gaussians, k.into_iter())).collect()
}
