//! Fine-tuning through the file's quantisation: images are rendered from the decoded file, and the values before
//! rounding learn (straight-through estimation: Bengio et al. 2013).
//!
//! From the first step of such a stage the scene *is* the file: a layer per page, rows in the file's order. Spherical
//! harmonics above degree 0 are entries of a palette, whose gradient is the sum over their rows.

mod shared;
mod state;
#[cfg(test)]
mod tests;

use crate::loss::terms::Codec;
use crate::maintenance::Strategy;
use crate::methods::spacetime::SpacetimeMethod;
use crate::methods::{EVERY, Group, Method, Rate, RateSettings, SpacetimeSettings, Stage, TrainContext};
use crate::recipe::Recipe;
use crate::{Error, Result};
use rayon::prelude::*;
use shared::Shared;
use splat4d::format::playback::{BLOCK_GAUSSIANS, Coder, Depths, Meta, Pages, Palette};
use splat4d::layers::{Layer, Scene};
use splat4d::scene::LifeKind;
use splat4d::scene::{BLOCK, Grads, SH, Space, Table, Time};
use std::sync::{Arc, Mutex, MutexGuard};

/// Rates of fine-tuning fall to this share of themselves, so that numbers settle on one side of a rounding threshold.
const FALL: f64 = 0.1;
/// The palette's entries learn this much slower than base colours, as rows' own coefficients do (Kerbl et al. 2023).
const SH_SLOWDOWN: f64 = 20.0;

/// A codec that is the playback file. Before its stage begins it holds nothing; [`begin`](Self::begin) belongs into the
/// stage's start.
#[derive(Debug)]
pub(crate) struct Quantised {
    coder: Coder,
    rate: Rate,
    memory: Mutex<Option<Memory>>,
}

/// State kept from step to step.
#[derive(Debug)]
struct Memory {
    /// One per layer: its rows' entries of the palette.
    labels: Vec<Vec<u16>>,
    /// One per layer: how important the page is, 0 the most.
    tiers: Vec<u16>,
    /// Spherical harmonics above degree 0; none: base colours only.
    shared: Option<Shared>,
    /// One per layer: blocks of the file whose rows have changed since they were shown.
    dirty: Vec<Vec<bool>>,
}

impl Quantised {
    /// A codec of codes of this many bits; `rate`: how fast the palette learns. Errors: depths out of range.
    pub(crate) fn new(depths: Depths, rate: Rate) -> Result<Arc<Self>> {
        depths.check()?;
        Ok(Arc::new(Self { coder: Coder { depths }, rate, memory: Mutex::new(None) }))
    }

    /// Makes the scene the pages of a file.
    pub(crate) fn begin(&self, pages: Pages, scene: &mut Scene<f32>) {
        *scene = Scene { head: scene.head, ..pages.scene() };
        let Pages { layers, labels, palette, tiers, .. } = pages;
        let dirty = layers.iter().map(fresh).collect();
        let shared = palette.as_ref().map(Shared::new);
        *self.memory() = Some(Memory { labels, tiers, shared, dirty });
    }

    /// The pages to write: what a reader decodes of them is [`whole`](Codec::whole) of the scene, bit for bit. `scene`
    /// is the one that learns. Errors: the codec's stage has not begun.
    pub(crate) fn pages(&self, scene: &Scene<f32>, meta: Meta) -> Result<Pages> {
        let mut memory = self.memory();
        let Some(m) = memory.as_mut() else {
            return Err(Error::input("this scene has not been quantised yet").remedy("Run it through all stages"));
        };
        let palette = m.shared.as_mut().map(|s| s.packed().clone());
        Ok(Pages { meta, layers: scene.layers.clone(), labels: m.labels.clone(), palette, tiers: m.tiers.clone() })
    }

    fn memory(&self) -> MutexGuard<'_, Option<Memory>> {
        self.memory.lock().expect("nothing panics while it holds the codec's memory")
    }
}

/// All blocks of a layer are still to be shown.
fn fresh(layer: &Layer<f32>) -> Vec<bool> {
    vec![true; layer.params.len().div_ceil(BLOCK_GAUSSIANS)]
}

impl Codec<f32> for Quantised {
    fn name(&self) -> &str {
        "quantised"
    }

    fn show(&self, scene: &Scene<f32>, times: &[Time], shown: &mut Scene<f32>) {
        let mut memory = self.memory();
        let m = memory.as_mut().expect("a stage with this codec begins with `begin`");
        assert_eq!(m.dirty.len(), scene.layers.len(), "pages stay the pages that they were");
        for ((layer, dirty), shown) in scene.layers.iter().zip(&mut m.dirty).zip(&mut shown.layers) {
            if dirty.iter().any(|d| *d) {
                self.coder.show(layer, &[], None, &|block| dirty[block], shown);
                dirty.fill(false);
            }
        }
        // A step changes some entries, and with them perhaps the range of all: of colours above degree 0 only those are
        // kept up that are about to be examined.
        let Some(shared) = &mut m.shared else { return };
        let palette = shared.packed();
        let mut ids = Vec::new();
        for (layer, labels) in shown.layers.iter_mut().zip(&m.labels) {
            let mut wanted = vec![false; labels.len().div_ceil(BLOCK_GAUSSIANS)];
            for &t in times {
                if layer.active(t, &mut ids) {
                    wanted.fill(true);
                }
                ids.iter().for_each(|&i| wanted[i as usize / BLOCK_GAUSSIANS] = true);
            }
            paint(&mut layer.params[SH], labels, palette, &wanted);
        }
    }

    fn whole(&self, scene: &Scene<f32>) -> Scene<f32> {
        let mut memory = self.memory();
        let m = memory.as_mut().expect("a stage with this codec begins with `begin`");
        let mut out = scene.clone();
        let palette = m.shared.as_mut().map(|s| s.packed());
        for ((layer, labels), shown) in scene.layers.iter().zip(&m.labels).zip(&mut out.layers) {
            self.coder.show(layer, labels, palette, &|_| true, shown);
        }
        out
    }

    fn learn(&self, d: &mut [Grads<f32>], progress: f64, scale: f64) -> bool {
        let mut memory = self.memory();
        let m = memory.as_mut().expect("a stage with this codec begins with `begin`");
        for (d, dirty) in d.iter().zip(&mut m.dirty) {
            let rows = d.active(Space::Gaussians).chunks(BLOCK_GAUSSIANS);
            dirty.iter_mut().zip(rows).for_each(|(dirty, rows)| *dirty |= rows.contains(&true));
        }
        let Some(shared) = &mut m.shared else { return true };
        shared.learn(d, &m.labels, self.rate.at(progress) * scale)
    }

    fn reset(&self) {
        if let Some(m) = self.memory().as_mut() {
            m.dirty.iter_mut().for_each(|blocks| blocks.fill(true));
        }
    }

    fn state(&self) -> Vec<u32> {
        self.memory().as_ref().map_or_else(Vec::new, state::words)
    }

    fn restore(&self, words: &[u32]) -> Result<()> {
        let memory = if words.is_empty() { None } else { Some(state::memory(words)?) };
        *self.memory() = memory;
        Ok(())
    }
}

/// Gives rows of requested blocks of the file the coefficients above degree 0 of their entries.
fn paint(table: &mut Table<f32>, labels: &[u16], palette: &Palette, wanted: &[bool]) {
    let chunks: Vec<_> = table.chunks_mut(BLOCK_GAUSSIANS / BLOCK).zip(wanted).filter(|(_, w)| **w).collect();
    chunks.into_par_iter().for_each(|(view, _)| {
        for (i, label) in labels[view.first..view.first + view.rows].iter().enumerate() {
            for plane in 0..palette.width() {
                let place = (i / BLOCK * view.width + 3 + plane) * BLOCK + i % BLOCK;
                view.data[place] = palette.value(usize::from(*label), plane);
            }
        }
    });
}

/// Rates with which a trained scene is tuned: those with which its training ended, times `share`, falling on.
pub(crate) fn tuned(groups: Vec<Group>, share: f64) -> Vec<Group> {
    let fall = |rate: Rate| Rate { start: share * rate.end, end: FALL * share * rate.end };
    groups.into_iter().map(|g| Group { rate: fall(g.rate), ..g }).collect()
}

/// The rate of a palette for [`tuned`].
pub(crate) fn palette_rate(rates: &RateSettings, share: f64) -> Rate {
    let rate = share * rates.feature * rates.decay / SH_SLOWDOWN;
    Rate { start: rate, end: FALL * rate }
}

/// A stage on the pages of a file, whatever model they were baked from: all groups of kinematic primitives with a
/// lifespan, in every layer. Its `start` is still to be set: it ends with [`Quantised::begin`].
pub(crate) fn stage(
    recipe: &Recipe,
    plan: &TrainContext,
    iterations: usize,
    share: f64,
    codec: Arc<Quantised>,
) -> Stage {
    let rotates = recipe.program().is_ok_and(|p| p.capabilities(plan).rotates);
    let spacetime = SpacetimeSettings {
        order: 1,
        // A turn that no model requested would cost two bytes per Gaussian.
        rotation_rate: recipe.spacetime.rotation_rate || rotates,
        ..recipe.spacetime.clone()
    };
    let mut plan = TrainContext { iterations, ..plan.clone() };
    let c = &mut plan.common;
    c.life.kind = Some(LifeKind::Interval);
    c.densify.strategy = Strategy::None;
    c.appearance.sh_degree = 0;
    (c.loss.opacity_life, c.loss.velocity) = (0.0, 0.0);
    let base = SpacetimeMethod { spacetime }.stages(&plan).remove(0);
    Stage {
        name: "quantised".into(),
        iterations,
        groups: tuned(base.groups, share).into_iter().map(|g| Group { layer: EVERY, ..g }).collect(),
        // Pages encode a single time as a lifespan of nearly zero width.
        min_log_life: None,
        half_size_steps: 0,
        sh_interval: 0,
        // Added or removed rows would not match the file's labels.
        maintenance: Vec::new(),
        codec: Some(codec),
        ..base
    }
}
