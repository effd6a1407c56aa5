//! `hexplane`: how it is learnt.

use super::{Plan, Program, Stage, still};
use splat4d::motion::{Spec, hexplane::HexplaneSpec};

/// A canonical cloud that six feature planes deform (Wu et al. 2024, "4DGaussians").
#[derive(Clone, Copy, Debug)]
pub struct HexplaneProgram;

impl Program for HexplaneProgram {
    fn spec(&self, plan: &Plan) -> Spec {
        Spec::Hexplane(HexplaneSpec { seed: plan.recipe.seed })
    }

    fn stages(&self, plan: &Plan) -> Vec<Stage> {
        vec![still::stage("hexplane", plan)]
    }
}
