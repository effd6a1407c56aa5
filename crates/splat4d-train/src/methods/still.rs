//! `still`: one stage, every group of static 3DGS. Also the base that other programs add to.

use super::auto::Seen;
use super::{Group, Plan, Program, Rate, Stage};
use crate::loss::neighbourhood::{MotionWeights, Neighbourhood};
use crate::loss::scene::{MeanOpacity, MeanScale, OpacityEntropy};
use crate::loss::terms::{ParamLoss, ProbeLoss};
use crate::optim::Noise;
use crate::recipe::Recipe;
use crate::upkeep;
use splat4d::motion::Spec;
use splat4d::scene::LifeKind;

/// The higher SH degrees learn this much slower than the base colour (Kerbl et al. 2023).
const SH_REST_SLOWDOWN: f64 = 20.0;

/// A capture in which less than this share of the pixels moves is of a still scene.
const MOVING: f64 = 2e-4;

/// Static 3D Gaussian Splatting.
#[derive(Clone, Copy, Debug)]
pub struct StillProgram;

impl Program for StillProgram {
    fn spec(&self, _plan: &Plan) -> Spec {
        Spec::Still
    }

    fn life(&self, _plan: &Plan) -> LifeKind {
        LifeKind::Infinite
    }

    fn suits(&self, seen: &Seen) -> Option<String> {
        if seen.times <= 1 {
            return Some("all pictures are of one moment".into());
        }
        let percent = 100.0 * seen.changing.filter(|share| *share < MOVING)?;
        Some(format!("cameras stand still and only {percent:.3} % of their pixels ever change"))
    }

    fn stages(&self, plan: &Plan) -> Vec<Stage> {
        vec![stage("still", plan)]
    }
}

/// The groups of geometry and colour.
pub fn groups(r: &Recipe, extent: f64) -> Vec<Group> {
    let positions = Rate { start: r.position_lr_init * extent, end: r.position_lr_final * extent };
    let mut groups = vec![
        Group::new("means", positions),
        Group::new("quats", r.falling(r.rotation_lr)),
        Group::new("log_scales", r.falling(r.scaling_lr)),
        Group::new("opacity_logits", r.falling(r.opacity_lr)),
        Group { part: Some((0, 3)), ..Group::new("sh", r.falling(r.feature_lr)) },
    ];
    let rest = 3 * ((r.sh_degree + 1) * (r.sh_degree + 1) - 1);
    if rest > 0 {
        let rate = r.falling(r.feature_lr / SH_REST_SLOWDOWN);
        groups.push(Group { part: Some((3, rest)), ..Group::new("sh", rate) });
    }
    groups
}

/// Lets a stage learn its Gaussians' lives: birth and death, for any model.
pub fn learn_life(stage: &mut Stage, plan: &Plan, life: LifeKind) {
    let r = &plan.recipe;
    if life != LifeKind::Infinite {
        stage.groups.push(Group::new("life_centers", r.falling(r.life_center_lr * plan.seconds())));
        stage.groups.push(Group::new("life_log_widths", r.falling(r.life_width_lr)));
        stage.min_log_life = Some((r.min_life_frames / plan.fps).max(1e-6).ln());
    }
    if life == LifeKind::Interval {
        stage.groups.push(Group::new("life_log_softness", r.falling(r.life_width_lr)));
    }
}

/// What the recipe asks of how Gaussians move.
pub fn motion_weights(r: &Recipe) -> MotionWeights {
    MotionWeights {
        rigid: r.lambda_rigid,
        rot: r.lambda_rot,
        iso: r.lambda_iso,
        arap: r.lambda_arap,
        elastic: r.lambda_elastic,
        velocity: r.lambda_velocity,
        jerk: r.lambda_jerk,
    }
}

/// A stage with the recipe's upkeep and regularisers.
pub fn stage(name: &str, plan: &Plan) -> Stage {
    let r = &plan.recipe;
    let mut params: Vec<Box<dyn ParamLoss<f32>>> = Vec::new();
    // These two belong to MCMC: they make room; under ADC they only dim.
    if r.strategy == "mcmc" {
        if r.opacity_reg > 0.0 {
            params.push(Box::new(MeanOpacity { weight: r.opacity_reg }));
        }
        if r.scale_reg > 0.0 {
            params.push(Box::new(MeanScale { weight: r.scale_reg }));
        }
    }
    if r.lambda_opacity_entropy > 0.0 {
        params.push(Box::new(OpacityEntropy { weight: r.lambda_opacity_entropy }));
    }
    let mut probes: Vec<Box<dyn ProbeLoss<f32>>> = Vec::new();
    let weights = motion_weights(r);
    if !weights.is_off() {
        probes.push(Box::new(Neighbourhood::new(weights, plan.extent, plan.clip, plan.fps)));
    }
    Stage {
        batch: r.batch_size,
        groups: groups(r, plan.extent),
        probes,
        params,
        upkeep: upkeep::of(r),
        noise: Noise::of(r),
        sh_interval: r.sh_degree_interval,
        half_size_steps: (r.half_size_until * r.iterations as f64) as usize,
        ..Stage::new(name, r.iterations)
    }
}
