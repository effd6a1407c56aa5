//! `ssm`: how it is learnt.

use super::{Plan, Program, Stage, still};
use splat4d::motion::{Spec, ssm::SsmSpec};

/// Control nodes driven by a diagonal state-space model.
#[derive(Clone, Copy, Debug)]
pub struct SsmProgram;

impl Program for SsmProgram {
    fn spec(&self, plan: &Plan) -> Spec {
        Spec::Ssm(SsmSpec { seed: plan.recipe.seed })
    }

    fn stages(&self, plan: &Plan) -> Vec<Stage> {
        vec![still::stage("ssm", plan)]
    }
}
