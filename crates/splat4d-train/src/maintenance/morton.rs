//! Morton order: after the last densification rows are sorted by the places of their means, for the rest of the run.
//! Neighbours in space become neighbours in memory, which every later step reads faster.

use super::{At, Change, Context, DensifySettings, Every, Maintenance, RunOrder, Strategy};
use crate::Result;
use crate::train_state::TrainState;
use splat4d::format::quant::{MORTON_BITS, morton};
use splat4d::layers::Scene;
use splat4d::scene::{Born, GEOMETRY, RowEdit, Space};

/// See the module's documentation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct MortonOrder {
    /// When the cloud is densified.
    pub densification: Every,
}

impl MortonOrder {
    /// With these settings; `None`: nothing is densified.
    pub(crate) fn of(densify: &DensifySettings) -> Option<Self> {
        (densify.strategy != Strategy::None).then(|| Self { densification: densify.steps() })
    }
}

impl Maintenance for MortonOrder {
    fn name(&self) -> &str {
        "morton order"
    }

    fn order(&self) -> RunOrder {
        RunOrder::Sort
    }

    fn due(&self, at: &At) -> bool {
        self.densification.is_last(at.step)
    }

    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        for layer in train_state.learning() {
            let edit = sorted(train_state.scene(), layer);
            train_state.apply(layer, &edit, &c.rng("order"));
        }
        Ok(Change::default())
    }

    fn densification(&mut self) -> Option<&mut Every> {
        Some(&mut self.densification)
    }
}

/// The rows of a layer by the Morton order of their means.
fn sorted(scene: &Scene<f32>, layer: usize) -> RowEdit {
    let geometry = &scene.layers[layer].params[GEOMETRY];
    let rows = geometry.rows();
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for r in 0..rows {
        let m = geometry.read::<3>(r, 0);
        for k in 0..3 {
            low[k] = low[k].min(m[k]);
            high[k] = high[k].max(m[k]);
        }
    }
    let most = f64::from((1u32 << MORTON_BITS) - 1);
    let code = |r: usize| {
        let m = geometry.read::<3>(r, 0);
        morton(std::array::from_fn(|k| {
            let u = (m[k] - low[k]) / (high[k] - low[k]).max(f32::MIN_POSITIVE);
            (f64::from(u.clamp(0.0, 1.0)) * most) as u32
        }))
    };
    let mut order: Vec<(u64, u32)> = (0..rows).map(|r| (code(r), r as u32)).collect();
    order.sort_unstable();
    let parent: Vec<u32> = order.into_iter().map(|(_, r)| r).collect();
    RowEdit { space: Space::Gaussians, born: vec![Born::Kept; parent.len()], parent }
}

#[cfg(test)]
mod tests {
    use super::super::Limits;
    use super::super::tests::{context, due_steps, scene};
    use super::*;

    #[test]
    fn it_is_a_permutation_that_brings_neighbours_together() {
        let s = scene(500);
        let mut parents = sorted(&s, 0).parent;
        parents.sort_unstable();
        assert!(parents.iter().enumerate().all(|(i, &r)| i == r as usize));
        let distance = |s: &Scene<f32>| {
            let g = &s.layers[0].params[GEOMETRY];
            (1..500).map(|r| (g.get(r, 0) - g.get(r - 1, 0)).abs() + (g.get(r, 1) - g.get(r - 1, 1)).abs()).sum::<f32>()
        };
        let before = distance(&s);
        let mut train_state = TrainState::new(s);
        let limits = Limits { cap: 500, extent: 1.0, min_opacity: 0.0 };
        let mut order = MortonOrder { densification: Every { first: 1, last: 10, interval: 4 } };
        order.run(&mut train_state, &context(limits, 0, 0)).unwrap();
        assert!(distance(train_state.scene()) < 0.6 * before);
        assert_eq!(due_steps(&order, 20), [8], "after the last densification");
    }
}
