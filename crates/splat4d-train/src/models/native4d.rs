//! `native4d`: how it is learnt.

use super::{Plan, Program, Stage, still};
use splat4d::motion::{Spec, native4d::Native4dSpec};

/// Gaussians of space and time, sliced at t (Yang et al. 2024, "Real-time 4DGS").
#[derive(Clone, Copy, Debug)]
pub struct Native4dProgram;

impl Program for Native4dProgram {
    fn spec(&self, plan: &Plan) -> Spec {
        Spec::Native4d(Native4dSpec { seed: plan.recipe.seed })
    }

    fn stages(&self, plan: &Plan) -> Vec<Stage> {
        vec![still::stage("native4d", plan)]
    }
}
