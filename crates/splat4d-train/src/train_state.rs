//! [`TrainState`]: the trained parameters with their per-row state (moments, statistics).
//!
//! A step changes numbers. Everything else that happens to a learner (rows are added, removed and moved, a hook
//! replaces the scene, opacities are lowered) uses the methods here, so that scene, moments and statistics cannot get
//! apart, and all that keep data of rows are notified: the learner notes how far it was `Touched`.

mod corrections;
mod exposure;

pub(crate) use corrections::Scale;
pub use corrections::moved;
pub use corrections::{Corrections, RefineSettings};
pub(crate) use corrections::{Origin, SearchDue, StepGrads, corner, zoomed};
pub(crate) use exposure::{COLUMNS as EXPOSURE_COLUMNS, Exposure, expose};

use crate::Result;
use crate::optim::Moments;
use splat4d::layers::Scene;
use splat4d::math::{Real, Rng};
use splat4d::motion::for_rows;
use splat4d::scene::{Born, RowEdit, Rows, Space, Table};

/// The observable quantities of one view of one layer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Observation<'a, F> {
    /// The layer.
    pub layer: usize,
    /// Its rows that were rendered: splat j is row `rows.id(j)`.
    pub rows: Rows<'a>,
    /// |dL/dmean2d| a splat, NDC units.
    pub mean2d: &'a [F],
    /// Pixel radius a splat, 0 where culled.
    pub radii: &'a [F],
}

/// Columns of a layer's statistics.
const STATS_COLUMNS: [(&str, usize); 3] = [("gradient_sum", 1), ("gradient_count", 1), ("radius_max", 1)];

/// Statistics of every Gaussian since the last densification.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Stats {
    /// One per layer, [N, 3]: sum of |dL/dmean2d| (NDC units), number of views that rendered it, largest radius
    /// (pixels).
    pub tables: Vec<Table<f32>>,
}

impl Stats {
    /// Nothing seen.
    pub(crate) fn new<F: Real>(scene: &Scene<F>) -> Self {
        Self { tables: scene.layers.iter().map(|l| Table::new(&STATS_COLUMNS, l.params.len())).collect() }
    }

    /// Adds one view's news.
    pub(crate) fn observe<F: Real>(&mut self, o: Observation<'_, F>) {
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

    /// Mean gradient of a row, 0 where never rendered.
    pub(crate) fn gradient(&self, layer: usize, row: usize) -> f32 {
        let [sum, count] = self.tables[layer].read::<2>(row, 0);
        if count > 0.0 { sum / count } else { 0.0 }
    }

    /// Follows a row edit of a layer: rows that are not `Kept` have not been seen yet.
    fn edit(&mut self, layer: usize, edit: &RowEdit) {
        if edit.space == Space::Gaussians {
            let table = &mut self.tables[layer];
            *table = table.gather(&edit.parent);
            for (row, _) in edit.born.iter().enumerate().filter(|(_, b)| **b != Born::Kept) {
                table.clear_row(row);
            }
        }
    }
}

/// Extent of changes of the training state other than by steps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Touched {
    /// Not at all.
    #[default]
    Nothing,
    /// Numbers, tables or layers, but every row is the row that it was: copies of the scene are stale.
    Values,
    /// Rows as well, or which rows are whose neighbours: whatever was remembered of rows is stale.
    Rows,
}

/// See the module's documentation.
pub struct TrainState {
    scene: Scene<f32>,
    moments: Vec<Moments<f32>>,
    stats: Stats,
    touched: Touched,
    /// Learnable exposures of the cameras; none: they show what is rendered.
    pub exposure: Option<Exposure>,
    /// Learnable corrections of poses and clocks; none: they are what the capture states.
    pub corrections: Option<Corrections>,
}

/// All parts of a learner, for a step.
pub(crate) struct Parts<'a> {
    pub scene: &'a mut Scene<f32>,
    pub moments: &'a mut [Moments<f32>],
    pub stats: &'a mut Stats,
    pub exposure: Option<&'a mut Exposure>,
}

impl TrainState {
    /// A scene that has learnt nothing yet.
    pub(crate) fn new(scene: Scene<f32>) -> Self {
        let moments = scene.layers.iter().map(|l| Moments::new(&l.params)).collect();
        Self { stats: Stats::new(&scene), moments, scene, touched: Touched::Values, exposure: None, corrections: None }
    }

    /// A learner from a checkpoint. Panics: moments and statistics of another scene.
    pub(crate) fn resumed(scene: Scene<f32>, moments: Vec<Moments<f32>>, stats: Stats) -> Self {
        let layers = scene.layers.len();
        assert_eq!([moments.len(), stats.tables.len()], [layers; 2], "moments and statistics by layer");
        Self { scene, moments, stats, touched: Touched::Values, exposure: None, corrections: None }
    }

    /// The scene that learns.
    pub fn scene(&self) -> &Scene<f32> {
        &self.scene
    }

    /// The scene, to change numbers in place. Its layers, tables and rows are fixed: rows change through
    /// [`apply`](Self::apply), all else through `rebuild`.
    pub fn scene_mut(&mut self) -> &mut Scene<f32> {
        self.touch(Touched::Values);
        &mut self.scene
    }

    /// The scene alone; all else is forgotten.
    pub(crate) fn into_scene(self) -> Scene<f32> {
        self.scene
    }

    /// The layers with learnable parts; rows of the other, fixed layers are left alone.
    pub(crate) fn learning(&self) -> Vec<usize> {
        let learns = |p: &splat4d::scene::Params<f32>| p.keys().any(|key| p.info(key).trainable);
        (0..self.scene.layers.len()).filter(|&l| learns(&self.scene.layers[l].params)).collect()
    }

    /// Adam's moments, by layer.
    pub(crate) fn moments(&self) -> &[Moments<f32>] {
        &self.moments
    }

    /// Scene and moments, to change numbers in place; as [`scene_mut`](Self::scene_mut).
    pub(crate) fn tables_mut(&mut self) -> (&mut Scene<f32>, &mut [Moments<f32>]) {
        self.touch(Touched::Values);
        (&mut self.scene, &mut self.moments)
    }

    /// Statistics of Gaussians since the last densification.
    pub(crate) fn stats(&self) -> &Stats {
        &self.stats
    }

    /// Statistics, to make some up.
    #[cfg(test)]
    pub(crate) fn stats_mut(&mut self) -> &mut Stats {
        &mut self.stats
    }

    /// Forgets what was seen of Gaussians.
    pub(crate) fn clear_stats(&mut self) {
        self.stats = Stats::new(&self.scene);
    }

    /// Applies one row edit to a layer, its moments and its statistics: the only way in which rows change.
    pub fn apply(&mut self, layer: usize, edit: &RowEdit, rng: &Rng) {
        self.moments[layer].edit(&self.scene.layers[layer].params, edit);
        self.stats.edit(layer, edit);
        self.scene.layers[layer].edit(edit, rng);
        self.touch(Touched::Rows);
    }

    /// Changes the scene freely: layers, models, tables. Moments that still fit are kept, but for layers of another
    /// name; those of pages for which `learns` (of a layer and one of its column groups) does not hold are forgotten,
    /// and statistics begin again.
    pub(crate) fn rebuild(
        &mut self,
        learns: &dyn Fn(usize, &str) -> bool,
        change: impl FnOnce(&mut Scene<f32>) -> Result<()>,
    ) -> Result<()> {
        let rows = |scene: &Scene<f32>| -> Vec<(String, usize)> {
            scene.layers.iter().map(|l| (l.name.clone(), l.params.len())).collect()
        };
        let before = rows(&self.scene);
        change(&mut self.scene)?;
        let after = rows(&self.scene);
        for ((moments, old), new) in self.moments.iter_mut().zip(&before).zip(&after) {
            if old.0 != new.0 {
                *moments = Moments::default();
            }
        }
        self.moments.resize_with(self.scene.layers.len(), Moments::default);
        for (index, (layer, moments)) in self.scene.layers.iter().zip(&mut self.moments).enumerate() {
            let old = std::mem::replace(moments, Moments::new(&layer.params));
            moments.adopt(old);
            moments.forget_pages(&layer.params, |column| learns(index, column));
        }
        self.clear_stats();
        self.touch(if before == after { Touched::Values } else { Touched::Rows });
        Ok(())
    }

    /// Notes that who is near whom was looked up again, although no row was edited.
    pub(crate) fn neighbours_changed(&mut self) {
        self.touch(Touched::Rows);
    }

    /// Extent of its changes since the last call.
    pub(crate) fn take_touched(&mut self) -> Touched {
        std::mem::take(&mut self.touched)
    }

    /// All parts at once, for a step: it changes numbers as steps do, and nothing is noted.
    pub(crate) fn parts_mut(&mut self) -> Parts<'_> {
        let Self { scene, moments, stats, exposure, .. } = self;
        Parts { scene, moments, stats, exposure: exposure.as_mut() }
    }

    fn touch(&mut self, how: Touched) {
        self.touched = self.touched.max(how);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::maintenance::tests::scene;
    use splat4d::scene::GEOMETRY;

    #[test]
    fn stats_count_rendered_gaussians() {
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

    #[test]
    fn every_change_of_a_learner_is_recorded_by_kind() {
        let mut train_state = TrainState::new(scene(20));
        assert_eq!(train_state.take_touched(), Touched::Values, "nothing has been copied of a new one");
        assert_eq!(train_state.take_touched(), Touched::Nothing);
        train_state.scene_mut().layers[0].params[GEOMETRY].set(3, 0, 1.0);
        assert_eq!(train_state.take_touched(), Touched::Values);
        let edit = RowEdit::prune(Space::Gaussians, (0..20).map(|r| r > 4));
        train_state.apply(0, &edit, &Rng::new(0, "prune", 0));
        train_state.scene_mut();
        assert_eq!(train_state.take_touched(), Touched::Rows, "the more counts");
        assert_eq!([train_state.scene().len(), train_state.moments()[0].table(GEOMETRY).rows()], [15; 2]);
        assert_eq!(train_state.stats().tables[0].rows(), 15);
        train_state.rebuild(&|_, _| true, |_| Ok(())).unwrap();
        assert_eq!(train_state.take_touched(), Touched::Values);
        let halve = |s: &mut Scene<f32>| {
            s.layers[0].edit(&RowEdit::prune(Space::Gaussians, (0..15).map(|r| r < 7)), &Rng::new(0, "half", 0));
            Ok(())
        };
        train_state.rebuild(&|_, _| true, halve).unwrap();
        assert_eq!(train_state.take_touched(), Touched::Rows);
        assert_eq!(train_state.moments()[0].table(GEOMETRY).rows(), 7);
        train_state.neighbours_changed();
        assert_eq!(train_state.take_touched(), Touched::Rows);
    }

    #[test]
    fn moments_survive_a_rebuild_of_their_own_layer_only() {
        let mut train_state = TrainState::new(scene(20));
        train_state.tables_mut().1[0].table_mut(GEOMETRY).fill(2.0);
        train_state.rebuild(&|_, _| true, |_| Ok(())).unwrap();
        assert_eq!(train_state.moments()[0].table(GEOMETRY).get(3, 3), 2.0);
        let rename = |s: &mut Scene<f32>| {
            s.layers[0].name = "another".into();
            Ok(())
        };
        train_state.rebuild(&|_, _| true, rename).unwrap();
        assert_eq!(train_state.moments()[0].table(GEOMETRY).get(3, 3), 0.0);
    }
}
