//! `still`: one stage, every group of static 3DGS. Also the base that other programs add to.

use super::auto::Seen;
use super::{CommonSettings, Group, Plan, Program, Rate, Stage};
use crate::capture::Agreement;
use crate::loss::LossSettings;
use crate::loss::neighbourhood::{MotionWeights, Neighbourhood};
use crate::loss::scene::{MeanOpacity, MeanScale, OpacityEntropy};
use crate::loss::terms::{ParamLoss, ProbeLoss};
use crate::optim::{MCMC_EXTENT, Noise};
use crate::settings::{Choice, settings};
use crate::upkeep::{LEAST, Strategy};
use splat4d::motion::Spec;
use splat4d::scene::LifeKind;

/// The higher SH degrees learn this much slower than the base colour (Kerbl et al. 2023).
const SH_REST_SLOWDOWN: f64 = 20.0;

/// A capture in which less than this share of the pixels moves is of a still scene.
const MOVING: f64 = 2e-4;

settings! {
    /// Colour of Gaussians and of cameras' images.
    pub struct AppearanceSettings {
        /// Highest degree of the spherical harmonics, 0 to 3.
        sh_degree: usize = 1 => within(0, 3);
        /// Iterations before each further SH degree is unlocked; 0: iterations/10.
        sh_degree_interval: usize = 0 => any().unit("iterations").when(On("appearance.sh_degree"));
        /// Learn a colour matrix and an offset per camera, if there are several cameras and each is named or has
        /// several images; their mean stays the identity.
        exposure: bool = true;
        /// The same for photos with automatic exposure: colours between them become more accurate, except those of
        /// held-out photos (studies/records/2026-11-26-recipe-trials.md).
        exposure_single: bool = false => any().when(On("appearance.exposure"));
        /// Rate of the exposure (Luiten et al., 10,000 steps: 1e-4).
        exposure_lr: f64 = 1e-3 => any().when(On("appearance.exposure"));
        /// Antialiased mode (opacity compensation).
        antialias: bool = false;
    }
}

settings! {
    /// Learning rates of parameters that all Gaussians have.
    pub struct RateSettings {
        /// Rate of positions at the start, of the extent; 0: 0.002, and less in proportion if `densify.max_cap` is above
        /// 30,000.
        position_init: f64 = 0.0 => any().unit("extents");
        /// Rate of positions at the end, of the extent; 0: 0.00005, and less in the same way.
        position_final: f64 = 0.0 => any().unit("extents");
        /// Share to which rates without a final value (colour, opacity, scale, rotation, lifespan) decay.
        decay: f64 = 1.0 => positive();
        /// Rate of base colour; higher SH degrees learn 20 times more slowly.
        feature: f64 = 6e-3 => positive();
        /// Rate of opacity logits.
        opacity: f64 = 0.05 => positive();
        /// Rate of log scales.
        scaling: f64 = 0.015 => positive();
        /// Rate of quaternions.
        rotation: f64 = 1e-3 => positive();
    }
}

/// Rates of positions at the start and at the end for up to [`LEAST`] Gaussians, of the extent. Kerbl et al. 2023 use 1.6e-4
/// and 1.6e-6 for runs of 30,000 steps; ours are several times shorter. Stated before and not measured against them.
const POSITIONS: [f64; 2] = [2e-3, 5e-5];
/// Lowest share of them, with many Gaussians: the rate of Kerbl et al. 2023, who have some millions.
const FINEST: f64 = 0.08;

impl RateSettings {
    /// A rate that falls to `decay` of itself over the stage.
    pub(crate) fn falling(&self, rate: f64) -> Rate {
        Rate { start: rate, end: rate * self.decay }
    }

    /// Rates of positions at the start and at the end, of the extent. More Gaussians are smaller and lie closer, and the
    /// steps of the few throw them about: a real room with 70,000 gains 0.4 dB with a third of the rates, an object with 90,000
    /// neither gains nor loses (studies/records/2026-11-26-real-size.md).
    fn positions(&self, cap: usize) -> [f64; 2] {
        let share = (LEAST as f64 / cap.max(1) as f64).clamp(FINEST, 1.0);
        let [start, end] = POSITIONS.map(|rate| rate * if cap == 0 { 1.0 } else { share });
        let stated = |rate: f64, by_count: f64| if rate > 0.0 { rate } else { by_count };
        [stated(self.position_init, start), stated(self.position_final, end)]
    }
}

settings! {
    /// The lifespan of a Gaussian (temporal opacity).
    pub struct LifeSettings
    when (Any(&[IsNot("run.motion", &["still", "tracked"]), Is("life.kind", &["gauss-half", "gauss-one", "interval"])])) {
        /// Kind of lifespan: auto (spacetime: gauss-half; control, ssm, deform-mlp and hexplane with fixed cameras:
        /// interval; else infinite), infinite, gauss-half, gauss-one, interval.
        kind: Option<LifeKind> = None => any().switch().when(IsNot("run.motion", &["still"]));
        /// Rate of lifespan centres, clips.
        center_lr: f64 = 1e-3 => any().unit("clips");
        /// Rate of log lifespan widths.
        width_lr: f64 = 0.02;
        /// Smallest lifespan width, frames.
        min_frames: f64 = 0.5 => any().unit("frames");
    }
}

/// `auto`, the first, is the motion model's own choice.
impl Choice for Option<LifeKind> {
    const NAMES: &'static [(&'static str, Self)] = &[
        ("auto", None),
        ("infinite", Some(LifeKind::Infinite)),
        ("gauss-half", Some(LifeKind::GaussHalf)),
        ("gauss-one", Some(LifeKind::GaussOne)),
        ("interval", Some(LifeKind::Interval)),
    ];
}

/// Static 3D Gaussian Splatting.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StillProgram;

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
        if let Some(agreement) = seen.agreement.filter(Agreement::is_static) {
            return Some(format!(
                "{:.1} % of the {} features that match over time agree with a static scene, filmed by a moving camera",
                100.0 * agreement.share,
                agreement.matches
            ));
        }
        let percent = 100.0 * seen.changing.filter(|share| *share < MOVING)?;
        Some(format!("cameras stand still and only {percent:.3} % of their pixels ever change"))
    }

    fn stages(&self, plan: &Plan) -> Vec<Stage> {
        vec![stage("still", plan)]
    }
}

/// The groups of geometry and colour.
pub(crate) fn groups(c: &CommonSettings, extent: f64) -> Vec<Group> {
    let [start, end] = c.rates.positions(c.densify.max_cap).map(|rate| rate * extent);
    let positions = Rate { start, end };
    let mut groups = vec![
        Group::new("means", positions),
        Group::new("quats", c.rates.falling(c.rates.rotation)),
        Group::new("log_scales", c.rates.falling(c.rates.scaling)),
        Group::new("opacity_logits", c.rates.falling(c.rates.opacity)),
        Group { part: Some((0, 3)), ..Group::new("sh", c.rates.falling(c.rates.feature)) },
    ];
    let rest = 3 * ((c.appearance.sh_degree + 1) * (c.appearance.sh_degree + 1) - 1);
    if rest > 0 {
        let rate = c.rates.falling(c.rates.feature / SH_REST_SLOWDOWN);
        groups.push(Group { part: Some((3, rest)), ..Group::new("sh", rate) });
    }
    groups
}

/// Lets a stage learn its Gaussians' lives: birth and death, for any model.
pub(crate) fn learn_life(stage: &mut Stage, plan: &Plan, life: LifeKind) {
    let c = &plan.common;
    if life != LifeKind::Infinite {
        stage.groups.push(Group::new("life_centers", c.rates.falling(c.life.center_lr * plan.seconds())));
        stage.groups.push(Group::new("life_log_widths", c.rates.falling(c.life.width_lr)));
        stage.min_log_life = Some((c.life.min_frames / plan.fps).max(1e-6).ln());
    }
    if life == LifeKind::Interval {
        stage.groups.push(Group::new("life_log_softness", c.rates.falling(c.life.width_lr)));
    }
}

/// Weights of the losses on motion.
fn motion_weights(loss: &LossSettings) -> MotionWeights {
    MotionWeights {
        rigid: loss.rigid,
        rot: loss.rot,
        iso: loss.iso,
        arap: loss.arap,
        elastic: loss.elastic,
        velocity: loss.velocity,
        jerk: loss.jerk,
        acceleration: loss.acceleration,
        least: loss.least_motion,
    }
}

/// A stage with the upkeep and the regularisers that every motion model has.
pub fn stage(name: &str, plan: &Plan) -> Stage {
    let c = &plan.common;
    let mut params: Vec<Box<dyn ParamLoss<f32>>> = Vec::new();
    // These two belong to MCMC: they make room; under ADC they only dim.
    if c.densify.strategy == Strategy::Mcmc {
        if c.mcmc.opacity_reg > 0.0 {
            params.push(Box::new(MeanOpacity { weight: c.mcmc.opacity_reg }));
        }
        if c.mcmc.scale_reg > 0.0 {
            // Sizes are in scene units: their weight is against the extent.
            params.push(Box::new(MeanScale { weight: c.mcmc.scale_reg * MCMC_EXTENT / plan.extent }));
        }
    }
    if c.loss.opacity_entropy > 0.0 {
        params.push(Box::new(OpacityEntropy { weight: c.loss.opacity_entropy }));
    }
    let mut probes: Vec<Box<dyn ProbeLoss<f32>>> = Vec::new();
    let weights = motion_weights(&c.loss);
    if !weights.is_off() {
        probes.push(Box::new(Neighbourhood::new(weights, plan.extent, plan.clip, plan.fps)));
    }
    Stage {
        batch: plan.batch_size,
        groups: groups(c, plan.extent),
        probes,
        params,
        upkeep: c.upkeep(),
        noise: c.densify.is_mcmc().then(|| Noise::new(c.mcmc.noise_lr, c.densify.until, plan.extent)),
        sh_interval: c.appearance.sh_degree_interval,
        half_size_steps: (plan.half_size_until * plan.iterations as f64) as usize,
        ..Stage::new(name, plan.iterations)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::Recipe;

    #[test]
    fn many_gaussians_take_smaller_steps_unless_told() {
        let of = |words: &[&str]| {
            let plan = Recipe::of(words).unwrap().plan();
            groups(&plan.common, 2.0).iter().find(|g| g.column == "means").map(|g| [g.rate.start, g.rate.end]).unwrap()
        };
        let near = |a: [f64; 2], b: [f64; 2]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(near(of(&["max_cap=500"]), [4e-3, 1e-4]) && near(of(&[]), [4e-3, 1e-4]));
        assert!(near(of(&["max_cap=120000"]), [1e-3, 2.5e-5]));
        assert!(near(of(&["max_cap=5000000"]), [3.2e-4, 8e-6]), "not without end");
        assert!(near(of(&["max_cap=120000", "rates.position_init=0.002"]), [4e-3, 2.5e-5]), "a stated rate stays");
    }
}
