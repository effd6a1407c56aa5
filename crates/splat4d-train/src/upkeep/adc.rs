//! Adaptive density control: clone small and split large Gaussians whose screen position still wants to move; prune the
//! transparent. Source: Kerbl et al. 2023 §5.2 and appendix B; the clone's opacity as revised by Bulò 2024.
//!
//! The original also removes Gaussians larger than a tenth of the extent. The extent is the spread of the cameras, and a
//! wall before a forward-facing rig needs larger ones: removal cost 1.3 dB in a kitchen, 0.3 to 1.6 dB on four other
//! captures and nothing on an object (docs/suite.md).

use super::{
    At, Change, Context, Every, Limits, Order, Strategy, Upkeep, covariances, grow, is_dead, logit, opacity, sample,
};
use crate::Result;
use crate::learner::Learner;
use crate::recipe::Recipe;
use crate::settings::settings;
use rayon::prelude::*;
use splat4d::math::{Rng, sym3};
use splat4d::scene::life::CENTER;
use splat4d::scene::params::OPACITY;
use splat4d::scene::{Born, GEOMETRY, LIFE, RowEdit, Space, Table};

/// A split's parts are this much smaller than their parent.
const SPLIT_SHRINK: f64 = 1.6;
/// Address of the random numbers of [`retime`]; those of splits are addressed by row.
const RETIME: u64 = u64::MAX;

/// About how much a densification by gradients adds on real captures, until the cap.
const GROWTH: f64 = 1.2;

settings! {
    /// Settings of adaptive density control (Kerbl et al. 2023).
    #[derive(Copy)]
    pub struct AdcSettings
    when (Is("densify.strategy", &["adc"])) {
        /// Whether the centre of a clone's life is drawn anew from the clip (STG).
        retime_clones: bool = false;
        /// Mean 2D gradient above which a Gaussian is cloned or split (NDC units).
        grad_threshold: f64 = 2e-4;
        /// Gaussians larger than this share of the extent are split, smaller ones cloned.
        percent_dense: f64 = 0.01 => any().unit("extents");
    }
}

/// Adaptive density control (Kerbl et al. 2023).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Adc {
    /// How.
    pub settings: AdcSettings,
    /// When.
    pub steps: Every,
}

impl Upkeep for Adc {
    fn name(&self) -> &str {
        "adc"
    }

    fn order(&self) -> Order {
        Order::Grow
    }

    fn due(&self, at: &At) -> bool {
        self.steps.is_due(at.step)
    }

    fn run(&mut self, learner: &mut Learner, c: &Context<'_>) -> Result<Change> {
        let settings = self.settings;
        Ok(grow(learner, c, |learner, layer, spare, rng| settings.layer(learner, &c.limits, layer, spare, rng)))
    }

    fn densification(&mut self) -> Option<&mut Every> {
        Some(&mut self.steps)
    }

    fn growth(&self, at: &At) -> f64 {
        if self.due(at) { GROWTH } else { 1.0 }
    }
}

impl Adc {
    /// As a recipe has it; `None`: another strategy.
    pub(crate) fn of(r: &Recipe) -> Option<Self> {
        let some = || Self { settings: r.adc, steps: r.densify.steps() };
        (r.densify.strategy == Strategy::Adc).then(some)
    }
}

impl AdcSettings {
    fn layer(&self, learner: &mut Learner, limits: &Limits, layer: usize, spare: &mut usize, rng: Rng) -> Change {
        let (scene, stats) = (learner.scene(), learner.stats());
        let rows = scene.layers[layer].params.len();
        let covs = covariances(scene, layer);
        let spans = scene.layers[layer].spans();
        let sizes: Vec<f64> = covs.par_iter().map(|&c| sym3::largest(c).max(0.0).sqrt()).collect();
        let keep: Vec<bool> = (0..rows).map(|r| !is_dead(scene, layer, r, limits.min_opacity, spans[r])).collect();
        let removed = keep.iter().filter(|k| !**k).count();
        *spare += removed;
        // Those that want it most come first when the cap leaves no room for all.
        let mut wanting: Vec<(f32, u32)> = (0..rows)
            .filter(|&r| keep[r] && f64::from(stats.gradient(layer, r)) >= self.grad_threshold)
            .map(|r| (stats.gradient(layer, r), r as u32))
            .collect();
        wanting.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        wanting.truncate(*spare);
        *spare -= wanting.len();
        let mut grows = vec![false; rows];
        wanting.iter().for_each(|&(_, r)| grows[r as usize] = true);
        let splits: Vec<bool> = (0..rows).map(|r| grows[r] && sizes[r] > self.percent_dense * limits.extent).collect();
        let mut edit = RowEdit { space: Space::Gaussians, parent: Vec::new(), born: Vec::new() };
        for r in (0..rows).filter(|&r| keep[r]) {
            edit.push(r as u32, if splits[r] { Born::Split } else { Born::Kept });
        }
        for r in (0..rows).filter(|&r| grows[r]) {
            edit.push(r as u32, if splits[r] { Born::Split } else { Born::Clone });
        }
        let old_opacity: Vec<f64> = edit.parent.iter().map(|&r| opacity(scene, layer, r as usize)).collect();
        learner.apply(layer, &edit, &rng);
        let scene = learner.scene_mut();
        let clip = scene.clip;
        let layer = &mut scene.layers[layer];
        if self.retime_clones {
            retime(&mut layer.params[LIFE], &edit, clip, rng.fork(RETIME));
        }
        for (j, (&parent, born)) in edit.parent.iter().zip(&edit.born).enumerate() {
            let r = parent as usize;
            if *born == Born::Split {
                let offset = sample(covs[r], rng.fork(j as u64));
                layer.params[GEOMETRY].add(j, 0, offset.map(|x| x as f32));
                layer.resize(j, 1.0 / SPLIT_SHRINK);
            }
            if grows[r] && !splits[r] {
                // Two halves in one place are as opaque as the whole: 1 − √(1 − o) each. Parts of a split are smaller and
                // lie beside each other; as faint as this they let training views fall by up to 2 dB (docs/suite.md).
                layer.params[GEOMETRY].set(j, OPACITY, logit(1.0 - (1.0 - old_opacity[j]).sqrt()));
            }
        }
        Change { added: wanting.len(), moved: 0, removed }
    }
}

/// Draws the centre of every clone's life from the clip, uniformly.
fn retime(life: &mut Table, edit: &RowEdit, [first, last]: [f64; 2], rng: Rng) {
    if life.width() == 0 {
        return;
    }
    for (row, _) in edit.born.iter().enumerate().filter(|(_, b)| **b == Born::Clone) {
        life.set(row, CENTER, (first + (last - first) * rng.uniform(row as u64)) as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{context, scene};
    use super::*;
    use splat4d::layers::Scene;
    use splat4d::scene::LifeKind;

    /// Runs it on a scene whose rows `seen` have the gradient 0.5, 1, ….
    fn run(s: Scene<f32>, settings: AdcSettings, seen: std::ops::Range<usize>, limits: Limits) -> (Change, Scene<f32>) {
        let mut learner = Learner::new(s);
        for (k, row) in seen.enumerate() {
            learner.stats_mut().tables[0].write(row, 0, [1.0 + k as f32, 2.0, 5.0]);
        }
        let mut adc = Adc { settings, steps: Every::NEVER };
        let change = adc.run(&mut learner, &context(limits, 1, 0)).unwrap();
        (change, learner.into_scene())
    }

    #[test]
    fn clones_the_small_splits_the_large_prunes_the_dead_under_the_cap() {
        let mut s = scene(20);
        {
            let g = &mut s.layers[0].params[GEOMETRY];
            (0..20).for_each(|r| g.write(r, 7, [-6.0f32; 3])); // small: clone
            g.write(1, 7, [-1.0f32; 3]); // large: split
            g.set(2, OPACITY, -9.0); // dead
        }
        let settings = AdcSettings { grad_threshold: 0.1, percent_dense: 0.05, retime_clones: false };
        let limits = Limits { cap: 100, extent: 4.0, min_opacity: 0.005 };
        let (change, all) = run(s.clone(), settings, 0..4, limits);
        assert_eq!((change.added, change.removed, all.len()), (3, 1, 22));
        let g = &all.layers[0].params[GEOMETRY];
        assert!((g.get(1, 7) - (-1.0 - 1.6f32.ln())).abs() < 1e-5, "the split parent shrinks");
        let [before, clone, half] =
            [s.layers[0].params[GEOMETRY].get(0, OPACITY), g.get(0, OPACITY), g.get(1, OPACITY)];
        assert!(clone < before && half == before, "clones share their opacity, halves keep it");
        let (change, capped) = run(s, settings, 0..4, Limits { cap: 21, ..limits });
        assert_eq!((change.added, capped.len()), (2, 21));
    }

    #[test]
    fn clones_are_born_anywhere_in_the_clip_and_no_other_row_moves_in_time() {
        let mut s = scene(400);
        s.clip = [2.0, 3.0];
        let layer = &mut s.layers[0];
        layer.life = LifeKind::GaussHalf;
        layer.params[LIFE] = Table::new(LifeKind::GaussHalf.columns(), 400);
        (0..400).for_each(|r| layer.params[LIFE].write(r, 0, [2.5, 0.0]));
        (0..400).for_each(|r| layer.params[GEOMETRY].write(r, 7, [-6.0f32; 3]));
        let settings = AdcSettings { grad_threshold: 0.1, percent_dense: 0.05, retime_clones: true };
        let (change, s) = run(s, settings, 0..400, Limits { cap: 800, extent: 4.0, min_opacity: 0.005 });
        assert_eq!(change.added, 400);
        let life = &s.layers[0].params[LIFE];
        assert!((0..400).all(|r| life.get(r, 0) == 2.5), "those that were there keep their time");
        let times: Vec<f32> = (400..800).map(|r| life.get(r, 0)).collect();
        assert!(times.iter().all(|t| (2.0..=3.0).contains(t)));
        for quarter in 0..4 {
            let from = 2.0 + 0.25 * quarter as f32;
            let count = times.iter().filter(|t| (from..from + 0.25).contains(*t)).count();
            assert!((60..140).contains(&count), "{count} of 400 in a quarter of the clip");
        }
    }
}
