//! The split into still and moving is requested by a recipe, in the last stage of any program.

use super::*;
use crate::maintenance::At;
use crate::recipe::MotionName;

#[test]
fn the_last_stage_splits_gaussians_if_enabled() {
    let at = |static_split: f64, motion: &str| {
        let mut recipe = Recipe::default().with(|r| {
            r.run.iterations = 1000;
            r.run.motion = MotionName::of(motion);
        });
        recipe.set(&format!("static_split={static_split}")).unwrap();
        let plan = TrainContext { extent: 1.0, clip: [0.0, 1.0], fps: 30.0, times: 30, ..recipe.plan() };
        let stages = stages(recipe.program().unwrap().as_ref(), &plan);
        let last = stages.last().unwrap();
        let shared = last.groups.iter().filter(|g| g.layer == EVERY).count();
        let splits =
            |step: &usize| last.maintenance.iter().any(|u| u.once() && u.due(&At { step: *step, steps: 1000 }));
        ((0..1000).filter(splits).collect::<Vec<_>>(), shared)
    };
    assert_eq!(at(0.01, "spacetime"), (vec![750], 6));
    assert_eq!(at(0.0, "spacetime"), (vec![], 0));
    assert_eq!(at(0.01, "still"), (vec![], 0), "nothing is left to split");
}
