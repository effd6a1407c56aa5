//! `tracked`: how it is learnt.

use super::{Plan, Program, Stage, still};
use splat4d::motion::{Spec, tracked::TrackedSpec};

/// Positions and rotations of the same Gaussians at every frame (Luiten et al. 2024, "Dynamic 3D Gaussians").
#[derive(Clone, Copy, Debug)]
pub struct TrackedProgram;

impl Program for TrackedProgram {
    fn spec(&self, plan: &Plan) -> Spec {
        Spec::Tracked(TrackedSpec { seed: plan.recipe.seed })
    }

    fn stages(&self, plan: &Plan) -> Vec<Stage> {
        vec![still::stage("tracked", plan)]
    }
}
