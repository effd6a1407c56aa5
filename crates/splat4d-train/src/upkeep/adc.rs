//! Adaptive density control: clone small and split large Gaussians whose screen position still wants to move; prune the
//! transparent and the huge. Source: Kerbl et al. 2023 §5.2 and appendix B; the split's opacity as revised by Bulò 2024.

use super::{Change, Limits, Stats, apply, covariances, is_dead, logit, opacity, sample};
use crate::optim::Moments;
use rayon::prelude::*;
use splat4d::layers::Scene;
use splat4d::math::{Rng, sym3};
use splat4d::scene::life::CENTER;
use splat4d::scene::params::OPACITY;
use splat4d::scene::{Born, GEOMETRY, LIFE, RowEdit, Space, Table};

/// A split's parts are this much smaller than their parent.
const SPLIT_SHRINK: f64 = 1.6;
/// Address of the random numbers of [`retime`]; those of splits are addressed by row.
const RETIME: u64 = u64::MAX;
/// Gaussians larger than this share of the extent are removed (as after the first reset in the original).
const HUGE: f64 = 0.1;

/// The strategy's settings.
#[derive(Clone, Debug, PartialEq)]
pub struct Adc {
    /// Mean 2D gradient (NDC units) above which a Gaussian is cloned or split.
    pub grad_threshold: f64,
    /// Gaussians larger than this share of the extent are split, smaller ones cloned.
    pub percent_dense: f64,
    /// Whether the centre of a clone's life is drawn anew from the clip (Li et al. 2024, STG).
    pub retime_clones: bool,
}

impl Adc {
    pub(super) fn run(
        &self,
        scene: &mut Scene<f32>,
        moments: &mut [Moments<f32>],
        stats: &mut Stats,
        limits: &Limits,
        layer: usize,
        spare: &mut usize,
        rng: Rng,
    ) -> Change {
        let rows = scene.layers[layer].params.len();
        let covs = covariances(scene, layer);
        let spans = scene.layers[layer].spans();
        let sizes: Vec<f64> = covs.par_iter().map(|&c| sym3::largest(c).max(0.0).sqrt()).collect();
        let keep: Vec<bool> = (0..rows)
            .map(|r| !is_dead(scene, layer, r, limits.min_opacity, spans[r]) && sizes[r] <= HUGE * limits.extent)
            .collect();
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
        apply(scene, moments, stats, layer, &edit, &rng);
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
            if grows[r] {
                // Two halves in one place are as opaque as the whole: 1 − √(1 − o) each.
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

/// Lowers every opacity to at most `ceiling`, and forgets its moments (Kerbl et al. 2023).
pub fn reset_opacity(scene: &mut Scene<f32>, moments: &mut [Moments<f32>], ceiling: f64) {
    for (layer, moments) in scene.layers.iter_mut().zip(moments) {
        let geometry = &mut layer.params[GEOMETRY];
        let width = geometry.width();
        for row in 0..geometry.rows() {
            let o = geometry.get(row, OPACITY);
            geometry.set(row, OPACITY, o.min(logit(ceiling)));
            moments.table_mut(GEOMETRY).set(row, OPACITY, 0.0);
            moments.table_mut(GEOMETRY).set(row, width + OPACITY, 0.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::scene;
    use super::*;
    use crate::densify::Densify;
    use splat4d::scene::LifeKind;

    #[test]
    fn clones_the_small_splits_the_large_prunes_the_dead_under_the_cap() {
        let mut s = scene(20);
        {
            let g = &mut s.layers[0].params[GEOMETRY];
            (0..20).for_each(|r| g.write(r, 7, [-6.0f32; 3])); // small: clone
            g.write(1, 7, [-1.0f32; 3]); // large: split
            g.set(2, OPACITY, -9.0); // dead
        }
        let mut moments: Vec<_> = s.layers.iter().map(|l| Moments::new(&l.params)).collect();
        let mut stats = Stats::new(&s);
        for r in [0, 1, 2, 3] {
            stats.tables[0].write(r, 0, [1.0 + r as f32, 2.0, 5.0]);
        }
        let adc = Densify::Adc(Adc { grad_threshold: 0.1, percent_dense: 0.05, retime_clones: false });
        let mut capped = s.clone();
        let limits = Limits { cap: 100, extent: 4.0, min_opacity: 0.005 };
        let change = adc.run(&mut s, &mut moments, &mut stats.clone(), &limits, 1, 0);
        assert_eq!((change.added, change.removed, s.len()), (3, 1, 22));
        let g = &s.layers[0].params[GEOMETRY];
        assert!((g.get(1, 7) - (-1.0 - 1.6f32.ln())).abs() < 1e-5, "the split parent shrinks");
        let mut moments: Vec<_> = capped.layers.iter().map(|l| Moments::new(&l.params)).collect();
        let change = adc.run(&mut capped, &mut moments, &mut stats, &Limits { cap: 21, ..limits }, 1, 0);
        assert_eq!((change.added, capped.len()), (2, 21));
    }
    #[test]
    fn clones_are_born_anywhere_in_the_clip_and_nobody_else_is_moved_in_time() {
        let mut s = scene(400);
        s.clip = [2.0, 3.0];
        let layer = &mut s.layers[0];
        layer.life = LifeKind::GaussHalf;
        layer.params[LIFE] = Table::new(LifeKind::GaussHalf.columns(), 400);
        (0..400).for_each(|r| layer.params[LIFE].write(r, 0, [2.5, 0.0]));
        (0..400).for_each(|r| layer.params[GEOMETRY].write(r, 7, [-6.0f32; 3]));
        let mut moments: Vec<_> = s.layers.iter().map(|l| Moments::new(&l.params)).collect();
        let mut stats = Stats::new(&s);
        (0..400).for_each(|r| stats.tables[0].write(r, 0, [1.0, 2.0, 5.0]));
        let adc = Densify::Adc(Adc { grad_threshold: 0.1, percent_dense: 0.05, retime_clones: true });
        let limits = Limits { cap: 800, extent: 4.0, min_opacity: 0.005 };
        assert_eq!(adc.run(&mut s, &mut moments, &mut stats, &limits, 1, 0).added, 400);
        let life = &s.layers[0].params[LIFE];
        assert!((0..400).all(|r| life.get(r, 0) == 2.5), "those who were there keep their time");
        let times: Vec<f32> = (400..800).map(|r| life.get(r, 0)).collect();
        assert!(times.iter().all(|t| (2.0..=3.0).contains(t)));
        for quarter in 0..4 {
            let from = 2.0 + 0.25 * quarter as f32;
            let count = times.iter().filter(|t| (from..from + 0.25).contains(*t)).count();
            assert!((60..140).contains(&count), "{count} of 400 in a quarter of the clip");
        }
    }
}
