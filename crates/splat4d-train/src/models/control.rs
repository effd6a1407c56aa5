//! `control`: how it is learnt.

use super::{Plan, Program, Stage, still};
use splat4d::motion::{Spec, control::ControlSpec};

/// Gaussians skinned to sparse control nodes (Huang et al. 2024, "SC-GS").
#[derive(Clone, Copy, Debug)]
pub struct ControlProgram;

impl Program for ControlProgram {
    fn spec(&self, plan: &Plan) -> Spec {
        Spec::Control(ControlSpec { seed: plan.recipe.seed })
    }

    fn stages(&self, plan: &Plan) -> Vec<Stage> {
        vec![still::stage("control", plan)]
    }
}
