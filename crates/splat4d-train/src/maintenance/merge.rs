//! Merging of Gaussians at one position: near pairs are merged, or the fainter of a pair is removed (spatial-proximity
//! pruning). Pairs are mutual nearest neighbours, so each row is in at most one pair.

use super::{At, Change, Context, Maintenance, RunOrder, covariances, logit, opacity};
use crate::Result;
use crate::settings::{Choice, settings};
use crate::train_state::TrainState;
use splat4d::layers::Scene;
use splat4d::math::knn::knn;
use splat4d::math::sym3;
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{Born, GEOMETRY, RowEdit, SH, Space};

/// The fate of a pair in one place.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pair {
    /// Both stay.
    #[default]
    None,
    /// One Gaussian with the pair's mean, covariance (moments), colour and joint opacity.
    Merge,
    /// The fainter one is removed, the other unchanged.
    Prune,
}

settings! {
    /// Merging of Gaussians at one position.
    #[derive(Copy)]
    pub struct MergeSettings
    when (On("merge.pair")) {
        /// Treatment of two Gaussians at one position: none (both stay), merge (one with the moments of both), prune
        /// (the fainter one is removed).
        pair: Pair = Pair::None => any().switch();
        /// Iterations between two searches for such pairs; 0: never.
        interval: usize = 500 => any().unit("iterations");
        /// Largest distance of such a pair, share of the smaller one's standard deviation.
        distance: f64 = 0.3;
    }
}

impl Choice for Pair {
    const NAMES: &'static [(&'static str, Self)] =
        &[("none", Self::None), ("merge", Self::Merge), ("prune", Self::Prune)];
}

/// Largest difference of base colours (in SH coefficients, each channel) of a pair to merge.
const SAME_COLOR: f32 = 0.15;
/// Largest ratio of a pair's standard deviations.
const SAME_SIZE: f64 = 2.0;
/// Floor of merged standard deviations, of the larger one.
const THINNEST: f64 = 1e-4;

/// See the module's documentation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Merge {
    /// How, and when.
    pub settings: MergeSettings,
}

impl Maintenance for Merge {
    fn name(&self) -> &str {
        "merge"
    }

    fn order(&self) -> RunOrder {
        RunOrder::Merge
    }

    fn due(&self, at: &At) -> bool {
        at.step.is_multiple_of(self.settings.interval) && at.step < at.steps
    }

    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        let before = train_state.scene().len();
        for layer in train_state.learning() {
            if let Some(edit) = self.settings.edit(train_state, layer) {
                train_state.apply(layer, &edit, &c.rng("crowding"));
            }
        }
        Ok(Change { removed: before - train_state.scene().len(), ..Change::default() })
    }
}

impl Merge {
    /// With these settings; `None`: never.
    pub(crate) fn of(settings: MergeSettings) -> Option<Self> {
        (settings.pair != Pair::None && settings.interval > 0).then_some(Self { settings })
    }
}

impl MergeSettings {
    /// One round on one layer: changes the rows that stay, and states which do. `None`: there is no pair.
    fn edit(&self, train_state: &mut TrainState, layer: usize) -> Option<RowEdit> {
        let n = train_state.scene().layers[layer].params.len();
        let pairs = self.pairs(train_state.scene(), layer);
        if pairs.is_empty() {
            return None;
        }
        let scene = train_state.scene_mut();
        let covs = covariances(scene, layer);
        let mut keep = vec![true; n];
        for &(a, b) in &pairs {
            let faint = if opacity(scene, layer, a) < opacity(scene, layer, b) { a } else { b };
            let strong = a + b - faint;
            if self.pair == Pair::Merge {
                merge(scene, layer, strong, faint, [covs[strong], covs[faint]]);
            }
            keep[faint] = false;
        }
        let mut edit = RowEdit::prune(Space::Gaussians, keep.iter().copied());
        if self.pair == Pair::Merge {
            // The old moments of a merged row would push it back.
            let mut merged = vec![false; n];
            pairs.iter().for_each(|&(a, b)| (merged[a], merged[b]) = (true, true));
            for (born, row) in edit.born.iter_mut().zip(&edit.parent) {
                if merged[*row as usize] {
                    *born = Born::Moved;
                }
            }
        }
        Some(edit)
    }

    /// Pairs (a < b) of rows that are each other's nearest and alike in place, size, colour and lifespan.
    fn pairs(&self, scene: &Scene<f32>, layer: usize) -> Vec<(usize, usize)> {
        let l = &scene.layers[layer];
        let (n, g) = (l.params.len(), &l.params[GEOMETRY]);
        if n < 2 {
            return Vec::new();
        }
        let points: Vec<[f32; 3]> = (0..n).map(|r| g.read::<3>(r, 0)).collect();
        let near = knn(&points, 1);
        let size = |r: usize| {
            let s = g.read::<3>(r, LOG_SCALE);
            f64::from((s[0] + s[1] + s[2]) / 3.0).exp()
        };
        let spans = l.spans();
        let alike = |a: usize, b: usize| {
            let (sa, sb) = (size(a), size(b));
            let (pa, pb) = (points[a], points[b]);
            let far = f64::from((0..3).map(|k| (pa[k] - pb[k]).powi(2)).sum::<f32>()).sqrt();
            let (ca, cb) = (l.params[SH].read::<3>(a, 0), l.params[SH].read::<3>(b, 0));
            let overlap = spans[a][1].min(spans[b][1]) - spans[a][0].max(spans[b][0]);
            let length = (spans[a][1] - spans[a][0]).min(spans[b][1] - spans[b][0]);
            far <= self.distance * sa.min(sb)
                && sa.max(sb) <= SAME_SIZE * sa.min(sb)
                && (0..3).all(|k| (ca[k] - cb[k]).abs() <= SAME_COLOR)
                && (overlap >= 0.5 * length || !length.is_finite())
        };
        let mutual = (0..n).map(|a| (a, near[a] as usize)).filter(|&(a, b)| a < b && near[b] as usize == a);
        mutual.filter(|&(a, b)| alike(a, b)).collect()
    }
}

/// Row `a` becomes the pair: moments weighted by opacity times volume, everything else by the same weights.
fn merge(scene: &mut Scene<f32>, layer: usize, a: usize, b: usize, [ca, cb]: [[f64; 6]; 2]) {
    let (oa, ob) = (opacity(scene, layer, a), opacity(scene, layer, b));
    let params = &mut scene.layers[layer].params;
    let volume = |p: &splat4d::scene::Params<f32>, r: usize| {
        let s = p[GEOMETRY].read::<3>(r, LOG_SCALE);
        f64::from(s[0] + s[1] + s[2]).exp()
    };
    let (wa, wb) = (oa * volume(params, a), ob * volume(params, b));
    let u = wb / (wa + wb).max(f64::MIN_POSITIVE);
    let (ma, mb) = (params[GEOMETRY].read::<3>(a, 0), params[GEOMETRY].read::<3>(b, 0));
    let d: [f64; 3] = std::array::from_fn(|k| f64::from(mb[k] - ma[k]));
    let cross = [d[0] * d[0], d[0] * d[1], d[0] * d[2], d[1] * d[1], d[1] * d[2], d[2] * d[2]];
    let cov: [f64; 6] = std::array::from_fn(|k| (1.0 - u) * ca[k] + u * cb[k] + u * (1.0 - u) * cross[k]);
    let largest = sym3::largest(cov).max(0.0).sqrt();
    let (q, s) = sym3::to_quat_log_scales(cov, (THINNEST * largest).max(1e-12));
    for key in params.keys().collect::<Vec<_>>() {
        if params.info(key).space != Space::Gaussians || !params.info(key).trainable {
            continue;
        }
        for col in 0..params[key].width() {
            let (x, y) = (params[key].get(a, col), params[key].get(b, col));
            params[key].set(a, col, x + u as f32 * (y - x));
        }
    }
    let g = &mut params[GEOMETRY];
    g.write(a, QUAT, q.map(|x| x as f32));
    g.write(a, LOG_SCALE, s.map(|x| x as f32));
    g.set(a, OPACITY, logit(1.0 - (1.0 - oa) * (1.0 - ob)));
}

#[cfg(test)]
mod tests {
    use super::super::Limits;
    use super::super::tests::{context, due_steps, scene};
    use super::*;

    /// Fifty Gaussians far apart, each with a twin a tenth of its size away.
    fn twins() -> Scene<f32> {
        let mut s = scene(100);
        let params = &mut s.layers[0].params;
        for r in 0..50 {
            let mut g = params[GEOMETRY].read::<11>(r, 0);
            g[0] = r as f32;
            g[OPACITY] = 0.0;
            params[GEOMETRY].write(r, 0, g);
            g[1] += 0.1 * (-2.0f32).exp();
            g[OPACITY] = -1.0;
            params[GEOMETRY].write(50 + r, 0, g);
        }
        s
    }

    #[test]
    fn equal_neighbours_are_merged_and_others_kept() {
        for pair in [Pair::Merge, Pair::Prune] {
            let rule = MergeSettings { pair, distance: 0.5, interval: 1 };
            let before = twins();
            let mut train_state = TrainState::new(twins());
            let edit = rule.edit(&mut train_state, 0).unwrap();
            assert_eq!(edit.parent, (0..50).collect::<Vec<u32>>(), "the fainter one goes");
            let s = train_state.scene();
            let changed = s.layers[0].params[GEOMETRY] != before.layers[0].params[GEOMETRY];
            assert_eq!(changed, pair == Pair::Merge);
            if pair == Pair::Merge {
                let o = opacity(s, 0, 3);
                assert!((o - (1.0 - 0.5 * (1.0 - 1.0 / (1.0 + 1f64.exp())))).abs() < 1e-6, "{o}");
                let [y0, y] = [&before, s].map(|s| s.layers[0].params[GEOMETRY].get(3, 1));
                assert!(y > y0 && y < y0 + 0.1 * (-2.0f32).exp());
                assert!(edit.born.iter().all(|b| *b == Born::Moved));
            }
            let far = MergeSettings { distance: 0.01, ..rule };
            assert!(far.edit(&mut TrainState::new(twins()), 0).is_none());
        }
    }

    #[test]
    fn rounds_run_at_their_interval_but_not_at_the_end() {
        let settings = MergeSettings { pair: Pair::Prune, distance: 0.5, interval: 10 };
        let mut merge = Merge { settings };
        assert_eq!(due_steps(&merge, 30), [10, 20]);
        let mut train_state = TrainState::new(twins());
        let limits = Limits { cap: 100, extent: 1.0, min_opacity: 0.0 };
        let change = merge.run(&mut train_state, &context(limits, 0, 0)).unwrap();
        assert_eq!((change.removed, train_state.scene().len()), (50, 50));
    }

    #[test]
    fn gaussians_of_different_colour_or_size_are_not_merged() {
        let rule = MergeSettings { pair: Pair::Merge, distance: 0.5, interval: 1 };
        let mut s = twins();
        for r in 50..75 {
            s.layers[0].params[SH].set(r, 1, 1.0);
        }
        for r in 75..100 {
            s.layers[0].params[GEOMETRY].write(r, LOG_SCALE, [-0.5; 3]);
        }
        assert!(rule.edit(&mut TrainState::new(s), 0).is_none());
    }
}
