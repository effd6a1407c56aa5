//! Parts of layers: the selected Gaussians as layers of their own, and changes around their models.

use super::Selected;
use crate::Result;
use crate::layers::{Layer, Scene};
use crate::math::{Rng, Sim3};
use crate::motion::edited::{Change, Edited, PathKey};
use crate::scene::{RowEdit, Space};
use std::sync::Arc;

/// The rows for which `which` holds.
pub(super) fn pruned(layer: &Layer<f32>, which: impl Iterator<Item = bool>) -> Layer<f32> {
    let mut out = layer.clone();
    out.edit(&RowEdit::prune(Space::Gaussians, which), &Rng::new(0, "edit", 0));
    out
}

/// Puts what `shown` makes of the selected part of every layer in its place, behind what is left of the layer. With a
/// name the parts are called so.
pub(super) fn each_part(
    scene: &mut Scene<f32>,
    selected: &Selected,
    name: Option<&String>,
    shown: &dyn Fn(&Layer<f32>) -> Vec<Layer<f32>>,
) {
    let mut layers = Vec::with_capacity(scene.layers.len() + 1);
    for (layer, selected) in std::mem::take(&mut scene.layers).into_iter().zip(selected) {
        if !selected.contains(&true) {
            layers.push(layer);
            continue;
        }
        let mut part = if selected.contains(&false) {
            layers.push(pruned(&layer, selected.iter().map(|s| !s)));
            pruned(&layer, selected.iter().copied())
        } else {
            layer
        };
        if let Some(name) = name {
            part.name.clone_from(name);
        }
        layers.extend(shown(&part));
    }
    scene.layers = layers;
}

/// Puts a change around the models of the selected Gaussians, which get layers of their own. Changes are in the world:
/// a frame is applied first.
pub(super) fn wrap(scene: &mut Scene<f32>, selected: &Selected, change: &dyn Fn(usize) -> Change) -> Result<()> {
    each_part(scene, selected, None, &|layer| vec![layer.clone()]);
    for (from, index) in parts(selected) {
        let layer = &mut scene.layers[index];
        unframe(layer)?;
        layer.motion = Arc::new(Edited::around(layer.motion.clone(), change(from), &mut layer.params)?);
    }
    Ok(())
}

/// After [`each_part`] kept every part: (number of the layer before, position of its part now).
pub(super) fn parts(selected: &Selected) -> Vec<(usize, usize)> {
    let (mut out, mut at) = (Vec::new(), 0);
    for (from, selected) in selected.iter().enumerate() {
        match (selected.contains(&true), selected.contains(&false)) {
            (true, true) => {
                out.push((from, at + 1));
                at += 2;
            }
            (part, _) => {
                if part {
                    out.push((from, at));
                }
                at += 1;
            }
        }
    }
    out
}

/// The layer's frame as a change around its model.
pub(super) fn unframe(layer: &mut Layer<f32>) -> Result<()> {
    if !layer.frame.is_identity() {
        let keys = vec![PathKey::new(0.0, &layer.frame)];
        let change = Change::Path { about: [0.0; 3], keys };
        layer.motion = Arc::new(Edited::around(layer.motion.clone(), change, &mut layer.params)?);
        layer.frame = Sim3::default();
    }
    Ok(())
}
