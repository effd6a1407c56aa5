//! `deform-mlp`: how it is learnt.

use super::{Plan, Program, Stage, still};
use splat4d::motion::{Spec, deform::DeformSpec};

/// A canonical cloud that a perceptron or a hash grid deforms (Yang et al. 2024, "Deformable 3D Gaussians").
#[derive(Clone, Copy, Debug)]
pub struct DeformProgram;

impl Program for DeformProgram {
    fn spec(&self, plan: &Plan) -> Spec {
        Spec::DeformMlp(DeformSpec { seed: plan.recipe.seed })
    }

    fn stages(&self, plan: &Plan) -> Vec<Stage> {
        vec![still::stage("deform-mlp", plan)]
    }
}
