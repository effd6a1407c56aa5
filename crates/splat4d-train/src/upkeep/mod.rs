//! Densification: where Gaussians are added, moved and removed, always under one hard cap over all layers.
//!
//! A strategy looks at what [`Stats`] gathered and at activated covariances, and acts through one `RowEdit` a layer and
//! `Motion::on_edit`, so that it works for every motion model.

pub mod adc;
pub mod guided;
pub mod mcmc;
pub mod merge;
pub mod relocate;

use crate::optim::Moments;
use splat4d::format::quant::{MORTON_BITS, morton};
use splat4d::layers::{LayerTape, Scene};
use splat4d::math::{Real, Rng, sym3};
use splat4d::motion::{Cache, for_rows};
use splat4d::scene::params::{OPACITY, QUAT};
use splat4d::scene::splats::COV;
use splat4d::scene::{Born, GEOMETRY, RowEdit, Rows, Space, Table, Time};

pub use adc::Adc;
pub use guided::Guided;
pub use mcmc::Mcmc;
pub use merge::{Crowd, Crowding};
pub use relocate::Relocate;

/// What the densifier may know of one view of one layer.
#[derive(Clone, Copy, Debug)]
pub struct Observation<'a, F> {
    /// The layer.
    pub layer: usize,
    /// Its rows that were drawn: splat j is row `rows.id(j)`.
    pub rows: Rows<'a>,
    /// |dL/dmean2d| a splat, NDC units.
    pub mean2d: &'a [F],
    /// Pixel radius a splat, 0 where culled.
    pub radii: &'a [F],
}

/// Columns of a layer's statistics.
const STATS_COLUMNS: [(&str, usize); 3] = [("gradient_sum", 1), ("gradient_count", 1), ("radius_max", 1)];

/// What was seen of every Gaussian since the last densification.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Stats {
    /// One a layer, [N, 3]: sum of |dL/dmean2d| (NDC units), number of views that drew it, largest radius (pixels).
    pub tables: Vec<Table<f32>>,
}

impl Stats {
    /// Nothing seen.
    pub fn new<F: Real>(scene: &Scene<F>) -> Self {
        Self { tables: scene.layers.iter().map(|l| Table::new(&STATS_COLUMNS, l.params.len())).collect() }
    }

    /// Adds one view's news.
    pub fn observe<F: Real>(&mut self, o: Observation<'_, F>) {
        for_rows([&mut self.tables[o.layer]], o.rows, |j, id, [table]| {
            let radius = o.radii[j];
            if radius > F::ZERO {
                let [sum, count, largest] = table.read::<3>(id, 0);
                let next = [sum + o.mean2d[j].f64() as f32, count + 1.0, largest.max(radius.f64() as f32)];
                table.write(id, 0, next);
            }
            0.0
        });
    }

    /// Mean gradient of a row, 0 where never drawn.
    pub fn gradient(&self, layer: usize, row: usize) -> f32 {
        let [sum, count] = self.tables[layer].read::<2>(row, 0);
        if count > 0.0 { sum / count } else { 0.0 }
    }

    /// Follows a row edit of a layer: rows that are not `Kept` have not been seen yet.
    pub fn edit(&mut self, layer: usize, edit: &RowEdit) {
        if edit.space == Space::Gaussians {
            let table = &mut self.tables[layer];
            *table = table.gather(&edit.parent);
            for (row, _) in edit.born.iter().enumerate().filter(|(_, b)| **b != Born::Kept) {
                table.clear_row(row);
            }
        }
    }

    /// Forgets everything; also takes over a changed number of rows.
    pub fn clear<F: Real>(&mut self, scene: &Scene<F>) {
        *self = Self::new(scene);
    }
}

/// What every strategy needs to know of the run.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Never more Gaussians than this in all layers together.
    pub cap: usize,
    /// The scene's extent, scene units.
    pub extent: f64,
    /// Opacity below which a Gaussian is dead.
    pub min_opacity: f64,
}

/// A strategy of densification.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Densify {
    /// Nothing is added or removed.
    None,
    /// Adaptive density control (Kerbl et al. 2023).
    Adc(Adc),
    /// Markov chain Monte Carlo (Kheradmand et al. 2024), relocation in space-time.
    Mcmc(Mcmc),
}

/// How many rows were born and died.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Change {
    /// New rows.
    pub added: usize,
    /// Rows moved onto another.
    pub moved: usize,
    /// Rows removed.
    pub removed: usize,
}

impl Densify {
    /// Edits every layer (scene, moments and statistics alike). `step` addresses the random numbers.
    pub fn run(
        &self,
        scene: &mut Scene<f32>,
        moments: &mut [Moments<f32>],
        stats: &mut Stats,
        limits: &Limits,
        seed: u64,
        step: u64,
    ) -> Change {
        let mut change = Change::default();
        let mut spare = limits.cap.saturating_sub(scene.len());
        let mut rest = scene.len();
        for layer in 0..scene.layers.len() {
            // What is left of the cap is shared by size, so that the first layer does not starve the others; what a
            // layer does not use goes to the next.
            let rows = scene.layers[layer].params.len();
            let mut room = (spare * rows).div_ceil(rest.max(1));
            (spare, rest) = (spare - room, rest - rows);
            let rng = Rng::new(seed, "densify", step).fork(layer as u64);
            let c = match self {
                Densify::None => Change::default(),
                Densify::Adc(adc) => adc.run(scene, moments, stats, limits, layer, &mut room, rng),
                Densify::Mcmc(mcmc) => mcmc.run(scene, moments, stats, limits, layer, &mut room, rng),
            };
            spare += room;
            change.added += c.added;
            change.moved += c.moved;
            change.removed += c.removed;
        }
        stats.clear(scene);
        change
    }
}

/// Applies one edit to a layer, its moments and its statistics.
pub fn apply(
    scene: &mut Scene<f32>,
    moments: &mut [Moments<f32>],
    stats: &mut Stats,
    layer: usize,
    edit: &RowEdit,
    rng: &Rng,
) {
    moments[layer].edit(&scene.layers[layer].params, edit);
    stats.edit(layer, edit);
    scene.layers[layer].edit(edit, rng);
}

/// Activated covariances [N, 6] of a layer's Gaussians at the clip's centre, whatever model made them.
pub fn covariances(scene: &Scene<f32>, layer: usize) -> Vec<[f64; 6]> {
    let l = &scene.layers[layer];
    let mut tape = LayerTape::default();
    tape.ask(Space::Gaussians, Rows::All, Time(0.5 * (scene.clip[0] + scene.clip[1])));
    let mut cache = Cache::default();
    l.motion.prepare(&l.params, &[tape.question(&l.params)], &mut cache);
    l.at(&cache, &mut tape);
    (0..l.params.len()).map(|r| tape.out().read::<6>(r, COV).map(f64::from)).collect()
}

/// Opacity (activated, without life) of a row.
fn opacity(scene: &Scene<f32>, layer: usize, row: usize) -> f64 {
    f64::from(scene.layers[layer].params[GEOMETRY].get(row, OPACITY)).sigmoid()
}

/// The logit of an opacity, kept finite.
fn logit(o: f64) -> f32 {
    // Just inside (0, 1): beyond it the logit's gradient is lost in f32.
    let o = o.clamp(1e-6, 1.0 - 1e-6);
    (o / (1.0 - o)).ln() as f32
}

/// Whether nothing of the row can ever be seen, or would only do harm: dead opacity, a life outside the clip, a row that
/// is not finite or a zero quaternion.
fn is_dead(scene: &Scene<f32>, layer: usize, row: usize, min_opacity: f64, span: [f64; 2]) -> bool {
    let g = scene.layers[layer].params[GEOMETRY].read::<11>(row, 0);
    let quat: f32 = (QUAT..QUAT + 4).map(|i| g[i] * g[i]).sum();
    opacity(scene, layer, row) <= min_opacity
        || span[1] < scene.clip[0]
        || span[0] > scene.clip[1]
        || !g.iter().all(|x| x.is_finite())
        || quat == 0.0
}

/// A point drawn from N(0, Σ).
fn sample(cov: [f64; 6], rng: Rng) -> [f64; 3] {
    let (values, vectors) = sym3::eigen(cov);
    let z: [f64; 3] = std::array::from_fn(|k| rng.normal(k as u64) * values[k].max(0.0).sqrt());
    std::array::from_fn(|r| vectors[r][0] * z[0] + vectors[r][1] * z[1] + vectors[r][2] * z[2])
}

/// Shuffles the rows of a layer by the Morton order of their means: neighbours in space become neighbours in memory.
pub fn morton_edit(scene: &Scene<f32>, layer: usize) -> RowEdit {
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
    use super::*;
    use splat4d::layers::{ALWAYS, Layer};
    use splat4d::motion::{Spec, build};
    use splat4d::scene::params::LOG_SCALE;
    use splat4d::scene::{LifeKind, Params};

    /// One still layer of random Gaussians of opacity one half.
    pub(super) fn scene(rows: usize) -> Scene<f32> {
        let mut params = Params::new(rows, 1, &[]);
        let motion = build(&Spec::Still, &mut params).unwrap();
        let rng = Rng::new(1, "scene", 0);
        for r in 0..rows {
            let g = &mut params[GEOMETRY];
            for c in 0..7 {
                g.set(r, c, rng.fork(c as u64).normal(r as u64) as f32);
            }
            g.write(r, LOG_SCALE, [-2.0; 3]);
        }
        let layer = Layer { name: "a".into(), params, motion, life: LifeKind::Infinite, span: ALWAYS, masks: None };
        Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, ..Scene::default() }
    }

    #[test]
    fn morton_order_is_a_permutation_that_brings_neighbours_together() {
        let mut s = scene(500);
        let edit = morton_edit(&s, 0);
        let mut sorted = edit.parent.clone();
        sorted.sort_unstable();
        assert!(sorted.iter().enumerate().all(|(i, &r)| i == r as usize));
        let distance = |s: &Scene<f32>| {
            let g = &s.layers[0].params[GEOMETRY];
            (1..500).map(|r| (g.get(r, 0) - g.get(r - 1, 0)).abs() + (g.get(r, 1) - g.get(r - 1, 1)).abs()).sum::<f32>()
        };
        let before = distance(&s);
        let mut moments: Vec<_> = s.layers.iter().map(|l| Moments::new(&l.params)).collect();
        let mut stats = Stats::new(&s);
        apply(&mut s, &mut moments, &mut stats, 0, &edit, &Rng::new(0, "m", 0));
        assert!(distance(&s) < 0.6 * before);
    }

    #[test]
    fn stats_count_what_was_drawn() {
        let s = scene(20);
        let mut stats = Stats::new(&s);
        let ids = [4, 9];
        for _ in 0..2 {
            stats.observe(Observation { layer: 0, rows: Rows::Some(&ids), mean2d: &[1.0f32, 3.0], radii: &[2.0, 0.0] });
        }
        assert_eq!(stats.tables[0].read::<3>(4, 0), [2.0, 2.0, 2.0]);
        assert_eq!(stats.gradient(0, 4), 1.0);
        assert_eq!(stats.gradient(0, 9), 0.0, "a culled splat was not seen");
    }
}
