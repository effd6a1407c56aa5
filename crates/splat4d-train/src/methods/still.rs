//! `still`: one stage, every group of static 3DGS. Also the base that other programs add to.

use super::auto::CaptureStats;
use super::{CommonSettings, Group, Method, Rate, Stage, TrainContext};
use crate::capture::Agreement;
use crate::loss::motion;
use crate::loss::neighbourhood::Neighbourhood;
use crate::loss::scene::{MeanOpacity, MeanScale, OpacityEntropy};
use crate::loss::terms::{ParamLoss, ProbeLoss};
use crate::maintenance::Strategy;
use crate::optim::{MCMC_EXTENT, Noise};
use splat4d::motion::Spec;
use splat4d::scene::LifeKind;

/// Its name in recipes.
pub(crate) const NAME: &str = "still";

/// The higher SH degrees, and blocks of harmonics in time, learn this much more slowly than the base colour. Kerbl et al. 2023 and
/// Yang et al. 2024 use 20; 2 and 3 gain less (studies/records/2026-11-27-optimiser.md).
pub(super) const SH_REST_SLOWDOWN: f64 = 5.0;

/// A capture in which less than this share of the pixels moves is of a still scene.
const MOVING: f64 = 2e-4;

/// Static 3D Gaussian Splatting.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StillMethod;

impl Method for StillMethod {
    fn spec(&self, _plan: &TrainContext) -> Spec {
        Spec::Still
    }

    fn life(&self, _plan: &TrainContext) -> LifeKind {
        LifeKind::Infinite
    }

    fn suits(&self, seen: &CaptureStats) -> Option<String> {
        if seen.times <= 1 {
            return Some("all images have the same time".into());
        }
        if let Some(agreement) = seen.agreement.filter(Agreement::is_static) {
            return Some(format!(
                "{:.1} % of the {} features that match over time agree with a static scene, filmed by a moving camera",
                100.0 * agreement.share,
                agreement.matches
            ));
        }
        let percent = 100.0 * seen.changing.filter(|share| *share < MOVING)?;
        Some(format!("cameras are fixed and only {percent:.3} % of their pixels change"))
    }

    fn stages(&self, plan: &TrainContext) -> Vec<Stage> {
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

/// Lets a stage learn its Gaussians' lifespans: birth and death, for any model.
pub(crate) fn learn_life(stage: &mut Stage, plan: &TrainContext, life: LifeKind) {
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

/// A stage with the maintenance and the regularisers that every motion model has.
pub fn stage(name: &str, plan: &TrainContext) -> Stage {
    let c = &plan.common;
    let mut params: Vec<Box<dyn ParamLoss<f32>>> = Vec::new();
    // These two belong to MCMC: they free Gaussians; under ADC they only dim.
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
    if motion::is_on(&c.loss) {
        probes.push(Box::new(Neighbourhood::new(c.loss.clone(), plan.extent, plan.clip, plan.fps)));
    }
    Stage {
        batch: plan.batch_size,
        groups: groups(c, plan.extent),
        settling: 1.0 - c.rates.settle..1.0,
        probes,
        params,
        maintenance: c.maintenance(),
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
    fn rates_fall_over_the_last_part_of_a_run_and_of_its_stages() {
        let of = |words: &[&str]| stage("still", &Recipe::of(words).unwrap().plan());
        let near = |s: &Stage, at: &[(f64, f64)]| at.iter().all(|&(p, x)| (s.settled(p) - x).abs() < 1e-12);
        let whole = of(&["iterations=1000", "rates.settle=0.2"]);
        assert!(near(&whole, &[(0.0, 1.0), (0.8, 1.0), (0.9, 0.55), (1.0, 0.1)]));
        assert!(near(&of(&["rates.settle=0"]), &[(0.5, 1.0), (1.0, 1.0)]));
        assert!(near(&whole.part(0, 500), &[(0.0, 1.0), (1.0, 1.0)]), "before it begins");
        let last = of(&["iterations=1000", "rates.settle=0.2"]).part(500, 1000);
        assert!(near(&last, &[(0.6, 1.0), (0.8, 0.55), (1.0, 0.1)]));
    }

    #[test]
    fn many_gaussians_take_smaller_steps_unless_set() {
        let of = |words: &[&str]| {
            let plan = Recipe::of(words).unwrap().plan();
            groups(&plan.common, 2.0).iter().find(|g| g.column == "means").map(|g| [g.rate.start, g.rate.end]).unwrap()
        };
        let near = |a: [f64; 2], b: [f64; 2]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(near(of(&["max_cap=500"]), [2e-3, 2e-4]) && near(of(&[]), [2e-3, 2e-4]));
        assert!(near(of(&["max_cap=120000"]), [1e-3, 5e-5]));
        assert!(near(of(&["max_cap=5000000"]), [3.2e-4, 1.6e-5]), "not without end");
        assert!(near(of(&["max_cap=120000", "rates.position_init=0.002"]), [4e-3, 5e-5]), "a stated rate stays");
    }
}
