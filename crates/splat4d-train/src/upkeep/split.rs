//! The static/dynamic split: late in training, Gaussians that turned out not to move become a layer of their own that
//! cannot (as in Swift4D, Wu et al. 2025, and Ex4DGS, Lee et al. 2024). They are then free to play, cannot flicker, and
//! what is left for the motion model is what moves.

use super::{EVERY, Group, Plan, Program, Stage};
use crate::Result;
use splat4d::layers::{ALWAYS, Layer, LayerTape, Scene, freeze_rows};
use splat4d::math::Rng;
use splat4d::motion::{Cache, Spec, build};
use splat4d::scene::splats::COV;
use splat4d::scene::{LifeKind, RowEdit, Rows, Space, Time};

/// Times at which rows are looked at, evenly over the clip: an odd number has the middle.
const LOOKS: usize = 17;
/// A row whose life falls below this share anywhere in the clip comes or goes, and is not still.
const LASTING: f64 = 0.9;
/// Change of the covariance, of its trace, from which on a shape counts as changed.
const SAME_SHAPE: f64 = 0.05;
/// Column groups that a still layer has.
const COMMON: [&str; 5] = ["means", "quats", "log_scales", "opacity_logits", "sh"];
/// What the layer is called.
pub const STILL_LAYER: &str = "still";

/// The stages of a program as the recipe has them: with `static_split`, still Gaussians move into a layer of their own
/// after that share of the last stage.
pub fn stages(program: &dyn Program, plan: &Plan) -> Vec<Stage> {
    let r = &plan.recipe;
    let mut stages = program.stages(plan);
    let Some(last) = stages.last_mut().filter(|_| r.static_split > 0.0 && r.motion != "still") else { return stages };
    let reach = r.static_split * plan.extent;
    let at = (last.iterations as f64 * r.static_split_from) as usize;
    last.switches.push((at, Box::new(move |scene, _| split(scene, reach).map(|_| ()))));
    share_groups(last);
    stages
}

/// Lets what every layer has learn in all of them.
pub fn share_groups(stage: &mut Stage) {
    let common = |g: &&mut Group| COMMON.contains(&g.column.as_str());
    stage.groups.iter_mut().filter(common).for_each(|g| g.layer = EVERY);
}

/// Moves rows whose mean stays within `reach` (scene units) of its middle, whose shape stays and whose life lasts, into a
/// still layer behind the others; returns how many. A scene whose rows all move is left as it is.
pub fn split(scene: &mut Scene<f32>, reach: f64) -> Result<usize> {
    let mut moved = 0;
    for index in 0..scene.layers.len() {
        if scene.layers[index].motion.spec() == Spec::Still {
            continue;
        }
        let still = still_rows(&scene.layers[index], scene.clip, reach);
        let count = still.iter().filter(|s| **s).count();
        if count == 0 {
            continue;
        }
        let layer = &mut scene.layers[index];
        let rows: Vec<u32> = (0..still.len() as u32).filter(|&r| still[r as usize]).collect();
        let mut params = freeze_rows(layer, &rows, Time(0.5 * (scene.clip[0] + scene.clip[1])));
        let motion = build(&Spec::Still, &mut params)?;
        let name = format!("{} {STILL_LAYER}", layer.name);
        let part = Layer { name, params, motion, life: LifeKind::Infinite, span: layer.span, masks: None };
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
        (0..LOOKS).map(|k| Time(clip[0] + (clip[1] - clip[0]) * k as f64 / (LOOKS - 1) as f64)).collect();
    let look = |t: Time| {
        let (mut tape, mut cache) = (LayerTape::default(), Cache::default());
        tape.ask(Space::Gaussians, Rows::All, t);
        layer.motion.prepare(&layer.params, &[tape.question(&layer.params)], &mut cache);
        layer.at(&cache, &mut tape);
        tape
    };
    let middle = look(times[LOOKS / 2]);
    let (kind, lives) = layer.lives();
    for t in times {
        let now = look(t);
        for (row, still) in still.iter_mut().enumerate() {
            let (a, b) = (middle.out().read::<9>(row, 0), now.out().read::<9>(row, 0));
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
    use crate::methods::program;
    use crate::recipe::Recipe;
    use splat4d::motion::SpacetimeSpec;
    use splat4d::scene::{GEOMETRY, LIFE, SH};

    fn plan(recipe: Recipe) -> Plan {
        Plan {
            recipe: recipe.resolve(),
            extent: 1.0,
            clip: [0.0, 1.0],
            fps: 30.0,
            times: 30,
            fixed_cameras: 4,
            moments: Vec::new(),
            masks: false,
        }
    }

    #[test]
    fn the_last_stage_splits_where_it_is_asked_to() {
        let at = |static_split, motion: &str| {
            let motion = motion.to_owned();
            let plan = plan(Recipe { iterations: 1000, static_split, motion, ..Recipe::default() });
            let stages = stages(program(&plan.recipe.motion).unwrap().as_ref(), &plan);
            let last = stages.last().unwrap();
            let shared = last.groups.iter().filter(|g| g.layer == EVERY).count();
            (last.switches.iter().map(|s| s.0).collect::<Vec<_>>(), shared)
        };
        assert_eq!(at(0.01, "spacetime"), (vec![750], 6));
        assert_eq!(at(0.0, "spacetime"), (vec![], 0));
        assert_eq!(at(0.01, "still"), (vec![], 0), "nothing is left to split");
    }

    #[test]
    fn what_stands_still_gets_a_layer_of_its_own_and_looks_the_same() {
        let life = LifeKind::GaussHalf;
        let mut params = splat4d::scene::Params::<f32>::new(40, 1, life.columns());
        let spec = Spec::Spacetime(SpacetimeSpec::default());
        let motion = build(&spec, &mut params).unwrap();
        let velocities = params.find("velocities").unwrap();
        for row in 0..40 {
            let g = &mut params[GEOMETRY];
            g.write(row, 0, [row as f32, 0.5, 0.0, 1.0]);
            g.write(row, 7, [-2.0, -2.5, -1.5, 0.3]);
            // A third moves, a third comes and goes, a third stands.
            params[velocities].write(row, 0, [if row % 3 == 0 { 0.5 } else { 0.001 }, 0.0, 0.0]);
            params[LIFE].write(row, 0, [0.5, if row % 3 == 1 { -2.0 } else { 2.0 }]);
            params[SH].write(row, 0, [row as f32, 1.0, 2.0]);
        }
        let layer = Layer { name: "scene".into(), params, motion, life, span: ALWAYS, masks: None };
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
