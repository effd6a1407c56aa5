//! `spacetime`: one stage; velocities, lives, rotation rates and, where the recipe has them, features and their head learn
//! beside geometry and colour.

use super::auto::Seen;
use super::still;
use super::{Group, Plan, Program, Rate, Stage};
use crate::loss::scene::{LivingOpacity, VelocitySmoothness};
use crate::recipe::{FULL, Recipe};
use crate::upkeep::Guided;
use splat4d::motion::spacetime::{FeatureSpec, TIME_FEATURES, VIEW_FEATURES};
use splat4d::motion::{SpacetimeSpec, Spec};
use splat4d::scene::LifeKind;
use splat4d::scene::head::{HEAD_IN, HEAD_OUT};

/// Cameras at a moment from which on a scene is seen from all sides at once.
const MANY_CAMERAS: f64 = 3.0;

/// Explicit kinematics (STG, FreeTimeGS).
#[derive(Clone, Copy, Debug)]
pub struct SpacetimeProgram;

impl Program for SpacetimeProgram {
    fn spec(&self, plan: &Plan) -> Spec {
        let r = &plan.recipe;
        Spec::Spacetime(SpacetimeSpec {
            order: r.motion_order,
            rotation: r.rotation_rate,
            detach: r.detach,
            origin: 0.5 * (plan.clip[0] + plan.clip[1]),
            features: (r.features == FULL).then_some(FeatureSpec { seed: r.seed }),
        })
    }

    fn life(&self, plan: &Plan) -> LifeKind {
        LifeKind::from_name(&plan.recipe.life).unwrap_or(LifeKind::GaussHalf)
    }

    fn has_features(&self) -> bool {
        true
    }

    fn suits(&self, seen: &Seen) -> Option<String> {
        let moving =
            seen.changing.map_or_else(String::new, |share| format!(", {:.1} % of the pixels move", 100.0 * share));
        (seen.cameras >= MANY_CAMERAS).then(|| {
            let cameras = seen.cameras;
            format!("{cameras:.0} cameras see every moment{moving}: explicit motion with lives needs no network")
        })
    }

    fn stages(&self, plan: &Plan) -> Vec<Stage> {
        let r = &plan.recipe;
        let clip = plan.seconds();
        // Velocities are there to compare (`VelocitySmoothness`), which costs no further instant.
        let base = Recipe { lambda_velocity: 0.0, ..r.clone() };
        let mut stage = still::stage("spacetime", &Plan { recipe: base, ..plan.clone() });
        // Rates of v_k are extents per clip^k: in seconds they shrink by clip^k.
        for k in 0..r.motion_order {
            let unit = plan.extent / clip.powi(k as i32 + 1);
            let rate = Rate { start: r.velocity_lr_init * unit, end: r.velocity_lr_final * unit };
            stage.groups.push(Group { part: Some((3 * k, 3)), ..Group::new("velocities", rate) });
        }
        if r.rotation_rate {
            stage.groups.push(Group::new("rotation_rates", r.falling(r.rotation_rate_lr / clip)));
        }
        if r.features == FULL {
            stage.groups.push(Group::new(VIEW_FEATURES, r.falling(r.view_features_lr)));
            // Time features are per clip in the recipe, per second in the model.
            stage.groups.push(Group::new(TIME_FEATURES, r.falling(r.time_features_lr / clip)));
            stage.groups.push(Group::new(HEAD_IN, r.falling(r.head_lr)));
            stage.groups.push(Group::new(HEAD_OUT, r.falling(r.head_lr)));
        }
        if let Some(guided) = Guided::of(r) {
            stage.keep(guided);
        }
        still::learn_life(&mut stage, plan, self.life(plan));
        if r.lambda_opacity_life > 0.0 {
            stage.params.push(Box::new(LivingOpacity { weight: r.lambda_opacity_life }));
        }
        if r.lambda_velocity > 0.0 && r.motion_order > 0 {
            stage.params.push(Box::new(VelocitySmoothness::new(r.lambda_velocity, clip / plan.extent)));
        }
        vec![stage]
    }
}
