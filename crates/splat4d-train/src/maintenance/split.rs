//! The static/dynamic split: late in training, Gaussians that hardly move become a static layer (as in Swift4D, Wu et
//! al. 2025, and Ex4DGS, Lee et al. 2024). They then cost no motion in playback and cannot flicker, and the motion
//! model keeps the moving ones only.

use super::{At, Change, Context, Maintenance};
use crate::Result;
use crate::settings::settings;
use crate::train_state::TrainState;
use splat4d::layers::{ALWAYS, Evaluation, Layer, Scene, freeze_rows};
use splat4d::math::Rng;
use splat4d::motion::Still;
use splat4d::scene::splats::COV;
use splat4d::scene::{LifeKind, RowEdit, Rows, Space, Time};
use std::sync::Arc;

/// Times at which rows are examined, evenly over the clip: an odd number has the middle.
const TIMES: usize = 17;
/// A row whose lifespan falls below this share anywhere in the clip appears or vanishes, and is not static.
const LASTING: f64 = 0.9;
/// Change of the covariance, of its trace, from which on a shape counts as changed.
const SAME_SHAPE: f64 = 0.05;
/// Column groups that a still layer has.
pub(crate) const STILL_COLUMNS: [&str; 5] = ["means", "quats", "log_scales", "opacity_logits", "sh"];
/// Name of the layer.
pub(crate) const STILL_LAYER: &str = "still";

settings! {
    /// The split of static Gaussians into a separate layer.
    #[derive(Copy)]
    pub struct SplitSettings
    when (On("split.reach")) {
        /// Gaussians that move less than this share of the extent become a static layer; 0: never.
        reach: f64 = 0.0 => any().unit("extents").switch().when(IsNot("run.motion", &["still"]));
        /// Time of the split, as a share of the last stage.
        from: f64 = 0.75 => share();
    }
}

/// See the module's documentation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Split {
    /// The number of the step before which it is done.
    pub at: usize,
    /// Rows that stay within this of their middle are still, scene units.
    pub reach: f64,
}

impl Split {
    /// The setting of a recipe for a last stage of `steps`, in which Gaussians move; `None`: never.
    pub(crate) fn of(settings: SplitSettings, extent: f64, steps: usize) -> Option<Self> {
        let some = || Self { at: (steps as f64 * settings.from) as usize, reach: settings.reach * extent };
        (settings.reach > 0.0).then(some)
    }
}

impl Maintenance for Split {
    fn name(&self) -> &str {
        "split"
    }

    fn due(&self, at: &At) -> bool {
        at.step == self.at && at.step < at.steps
    }

    fn once(&self) -> bool {
        true
    }

    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        train_state.rebuild(c.learns, |scene| split(scene, self.reach).map(drop))?;
        Ok(Change::default())
    }
}

/// Moves rows whose mean stays within `reach` (scene units) of its middle, whose shape stays and whose lifespan lasts,
/// into a still layer behind the others; returns how many. A scene whose rows all move is not changed.
pub(crate) fn split(scene: &mut Scene<f32>, reach: f64) -> Result<usize> {
    let mut moved = 0;
    for index in 0..scene.layers.len() {
        if !scene.layers[index].motion.capabilities().moves {
            continue;
        }
        let still = still_rows(&scene.layers[index], scene.clip, reach);
        let count = still.iter().filter(|s| **s).count();
        if count == 0 {
            continue;
        }
        let layer = &mut scene.layers[index];
        let rows: Vec<u32> = (0..still.len() as u32).filter(|&r| still[r as usize]).collect();
        let params = freeze_rows(layer, &rows, Time(0.5 * (scene.clip[0] + scene.clip[1])));
        let name = format!("{} {STILL_LAYER}", layer.name);
        let fixed = Layer::new(name, params, Arc::new(Still), LifeKind::Infinite);
        let part = Layer { span: layer.span, ..fixed };
        let edit = RowEdit::prune(Space::Gaussians, still.iter().map(|s| !s));
        layer.edit(&edit, &Rng::new(0, "split", index as u64));
        scene.layers.push(part);
        moved += count;
    }
    Ok(moved)
}

/// Which rows of a layer do not move.
fn still_rows(layer: &Layer<f32>, clip: [f64; 2], reach: f64) -> Vec<bool> {
    let n = layer.params.len();
    let mut still = vec![layer.span == ALWAYS && layer.masks.is_none(); n];
    let times: Vec<Time> =
        (0..TIMES).map(|k| Time(clip[0] + (clip[1] - clip[0]) * k as f64 / (TIMES - 1) as f64)).collect();
    let look = |t: Time| Evaluation::of_layer(layer, Space::Gaussians, Rows::All, t);
    let middle = look(times[TIMES / 2]);
    let (kind, lives) = layer.lifespans();
    for t in times {
        let now = look(t);
        for (row, still) in still.iter_mut().enumerate() {
            let (a, b) = (middle.tape(0).out().read::<9>(row, 0), now.tape(0).out().read::<9>(row, 0));
            let far: f32 = (0..3).map(|k| (a[k] - b[k]).powi(2)).sum();
            let trace = a[COV] + a[COV + 3] + a[COV + 5];
            let shape: f32 = (COV..9).map(|k| (a[k] - b[k]).powi(2)).sum();
            *still &= f64::from(far).sqrt() <= reach
                && f64::from(shape.sqrt()) <= SAME_SHAPE * f64::from(trace)
                && kind.eval(lives[row], t).sigma >= LASTING;
        }
    }
    still
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::motion::{SpacetimeSpec, Spec, build};
    use splat4d::scene::{GEOMETRY, LIFE, SH};

    #[test]
    fn static_gaussians_move_to_a_layer_and_the_render_stays() {
        let life = LifeKind::GaussHalf;
        let mut params = splat4d::scene::Params::<f32>::new(40, 1, life.columns());
        let spec = Spec::Spacetime(SpacetimeSpec::default());
        let motion = build(&spec, &mut params).unwrap();
        let velocities = params.find("velocities").unwrap();
        for row in 0..40 {
            let g = &mut params[GEOMETRY];
            g.write(row, 0, [row as f32, 0.5, 0.0, 1.0]);
            g.write(row, 7, [-2.0, -2.5, -1.5, 0.3]);
            // A third moves, a third appears and disappears, a third is static.
            params[velocities].write(row, 0, [if row % 3 == 0 { 0.5 } else { 0.001 }, 0.0, 0.0]);
            params[LIFE].write(row, 0, [0.5, if row % 3 == 1 { -2.0 } else { 2.0 }]);
            params[SH].write(row, 0, [row as f32, 1.0, 2.0]);
        }
        let layer = Layer::new("scene", params, motion, life);
        let mut scene = Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, ..Scene::default() };
        assert_eq!(split(&mut scene, 0.01).unwrap(), 13);
        assert_eq!(scene.layers.iter().map(|l| l.params.len()).collect::<Vec<_>>(), [27, 13]);
        let part = &scene.layers[1];
        assert_eq!((part.motion.spec(), part.name.as_str()), (Spec::Still, "scene still"));
        for row in 0..13 {
            let [x, y, ..] = part.params[GEOMETRY].read::<4>(row, 0);
            assert!((x - (2 + 3 * row) as f32).abs() < 1e-3 && y == 0.5);
            assert_eq!(part.params[SH].get(row, 0), (2 + 3 * row) as f32);
        }
        assert_eq!(split(&mut scene, 0.01).unwrap(), 0, "twice changes nothing");
    }
}
