//! `deform-mlp`: a static warm-up, then the network learns next to geometry and colour.

use super::auto::CaptureStats;
use super::{Group, Method, Rate, Stage, TimeNoise, TrainContext, still};
use crate::settings::{choices, settings};
use crate::{Error, Result};
use splat4d::motion::Spec;
use splat4d::motion::deform::{Deform, DeformSpec, Input};
use splat4d::nn::HashShape;
use splat4d::scene::Params;

/// Hidden layers and width of the large trunk, and the layer after which its input is appended again (Yang et al.
/// 2024).
const LARGE: (usize, usize, usize) = (8, 256, 4);
/// Levels of positions with the large trunk, at least (Yang et al. 2024).
const LARGE_X_LEVELS: usize = 10;
/// Grids learn so much faster than networks: an entry is met by few Gaussians.
const GRID_SPEEDUP: f64 = 50.0;
/// Canonical positions start with this share of the recipe's rate, which suits short-lived Gaussians: a cloud that is
/// seen at every time has to settle. Chosen next to other settings in runs of 400 steps; not measured alone.
const CANONICAL_SLOWDOWN: f64 = 4.0;
/// Share of the iterations until the noise on time is zero: 20,000 of 40,000 (Yang et al. 2024).
const NOISE_STEPS: f64 = 0.5;
/// Steps over which the rates of networks and grids rise. Adam's first step is as long as the rate whatever the
/// gradient, and at once it threw a settled cloud 25 pixels about: training views of a hand-held take fell by 4.6 dB in
/// one step. With it 0.2 dB more are held out there (docs/suite.md). Source of linear warm-up: Goyal et al. 2017, §2.2.
pub(super) const WARM_UP: usize = 50;
/// Short runs have no time for it: at most this part of the iterations.
pub(super) const WARM_UP_SHARE: usize = 20;
/// The grid over space: a sixteenth of the published entries, since Gaussians are thousands and not millions of
/// samples.
const SPACE: HashShape = HashShape { levels: 8, features: 2, log2_size: 15, base: 8, finest: 256 };
/// The grids over two axes and time.
const TIME: HashShape = HashShape { levels: 6, features: 2, log2_size: 15, base: 4, finest: 128 };

choices! {
    /// The network that deforms.
    pub enum Trunk {
        /// Small where all cameras move and masks show one object; else hash.
        Auto = "auto",
        /// The published perceptron, 8x256.
        Mlp = "mlp",
        /// A small perceptron.
        Small = "small",
        /// Hash grids and a small network.
        Hash = "hash",
        /// Hash grids and one linear map.
        HashLinear = "hash-linear",
    }
}

settings! {
    /// Settings of `deform-mlp`.
    pub struct DeformSettings
    when (Is("run.motion", &["deform-mlp"])) {
        /// Network: mlp (8x256), small, hash (grids and a small network) or hash-linear; auto: small where all cameras
        /// move and masks show one object, else hash.
        trunk: Trunk = Trunk::Auto;
        /// Width of the small and hash networks.
        width: usize = 128 => any().when(IsNot("deform.trunk", &["mlp"]));
        /// Hidden layers of the small and hash networks.
        layers: usize = 2 => any().when(IsNot("deform.trunk", &["mlp", "hash-linear"]));
        /// Levels of the positional encoding of positions (the published 10 suits mlp).
        x_levels: usize = 4 => any().when(Is("deform.trunk", &["auto", "mlp", "small"]));
        /// Levels of the positional encoding of time (published: 6 with deform_time_net, else 10).
        t_levels: usize = 3 => any().when(Is("deform.trunk", &["auto", "mlp", "small"]));
        /// Whether time passes through a small network first (published for synthetic scenes).
        time_net: bool = false => any().when(Is("deform.trunk", &["auto", "mlp", "small"]));
        /// Positions move by screw motions (6 degrees of freedom) instead of offsets.
        rigid: bool = false;
        /// Rate of networks at the start; hash grids learn 50 times faster.
        lr_init: f64 = 2e-3;
        /// Rate of networks at the end.
        lr_final: f64 = 1e-4;
        /// Share of the iterations in which only the Gaussians learn, before the networks do.
        warmup: f64 = 0.05 => share();
        /// Share of the iterations after which every level of the hash grids learns; 0: all from the start.
        unlock: f64 = 0.3 => share().when(Is("deform.trunk", &["auto", "hash", "hash-linear"]));
        /// Annealed smoothing noise on time at the start, frames; it is zero by half the iterations. 0.1 for real
        /// captures with uncertain poses.
        time_noise: f64 = 0.0 => any().unit("frames");
    }
}

/// A canonical cloud that a perceptron or a hash grid deforms (Yang et al. 2024, "Deformable 3D Gaussians").
#[derive(Clone, Debug)]
pub(crate) struct DeformMethod {
    pub deform: DeformSettings,
}

impl Method for DeformMethod {
    fn spec(&self, plan: &TrainContext) -> Spec {
        Spec::DeformMlp(spec(plan, &self.deform))
    }

    fn check(&self, plan: &TrainContext) -> Result<()> {
        check(plan, &self.deform)
    }

    fn one_time(&self, _plan: &TrainContext) -> bool {
        true
    }

    fn suits(&self, seen: &CaptureStats) -> Option<String> {
        let times = if seen.is_long() { format!("each of {} times", seen.times) } else { "each time".to_owned() };
        Some(format!(
            "{} {times}: one set of Gaussians, deformed by a network, uses all times together",
            seen.cameras_in_words()
        ))
    }

    fn stages(&self, plan: &TrainContext) -> Vec<Stage> {
        let deform = &self.deform;
        let warmup = (deform.warmup * plan.iterations as f64) as usize;
        let mut out = Vec::new();
        if warmup > 0 {
            let mut first = self.stage(plan, 0, warmup);
            first.name = "deform-mlp, still".into();
            // A network that is frozen is not evaluated.
            first.start = Some(learns(false));
            first.end = Some(learns(true));
            out.push(first);
        }
        if warmup < plan.iterations {
            let mut second = self.stage(plan, warmup, plan.iterations);
            networks(&mut second, plan, deform);
            let noise = ((NOISE_STEPS * plan.iterations as f64) as usize).saturating_sub(warmup);
            second.time_noise = TimeNoise { start: deform.time_noise / plan.fps, steps: noise };
            out.push(second);
        }
        out
    }
}

fn check(plan: &TrainContext, deform: &DeformSettings) -> Result<()> {
    if plan.times < 2 {
        return Err(Error::input("all images of the capture have the same time: there is nothing to deform")
            .remedy("Train it with --motion still"));
    }
    Deform::new(spec(plan, deform), &mut Params::<f32>::new(0, 1, &[])).map(drop).map_err(|e| {
        Error::input(format!("the recipe's network is invalid: {e}"))
            .remedy("Change deform_width, deform_layers, deform_x_levels or deform_t_levels")
    })
}

fn spec(plan: &TrainContext, deform: &DeformSettings) -> DeformSpec {
    let encoded = |x_levels| Input::Encoded { x_levels, t_levels: deform.t_levels, time_net: deform.time_net };
    let trunk = match deform.trunk {
        // Grids follow more motion: by a small network a ball before a wall is lost, and a hand-held take has 1.9 dB
        // less (docs/suite.md). Of one object alone, seen once per time, the network generalises better
        // (docs/models.md).
        Trunk::Auto if plan.masks && plan.fixed_cameras == 0 => Trunk::Small,
        Trunk::Auto => Trunk::Hash,
        chosen => chosen,
    };
    let (input, layers, width, skip) = match trunk {
        Trunk::Mlp => (encoded(LARGE_X_LEVELS.max(deform.x_levels)), LARGE.0, LARGE.1, Some(LARGE.2)),
        Trunk::Hash => (Input::Hashed { space: SPACE, time: TIME }, deform.layers.max(1), deform.width, None),
        Trunk::HashLinear => (Input::Hashed { space: SPACE, time: TIME }, 0, deform.width, None),
        Trunk::Small | Trunk::Auto => (encoded(deform.x_levels), deform.layers, deform.width, None),
    };
    DeformSpec { seed: plan.seed, clip: plan.clip, input, width, layers, skip, rigid: deform.rigid }
}

impl DeformMethod {
    /// Steps `from .. to` of the recipe's one schedule as a stage of its own.
    fn stage(&self, plan: &TrainContext, from: usize, to: usize) -> Stage {
        let mut stage = still::stage("deform-mlp", plan);
        still::learn_life(&mut stage, plan, self.life(plan));
        canonical(&mut stage);
        stage.part(from, to)
    }
}

/// Lets positions start as slowly as those of a cloud must that is seen at every time.
pub(super) fn canonical(stage: &mut Stage) {
    for group in stage.groups.iter_mut().filter(|g| g.column == "means") {
        group.rate.start /= CANONICAL_SLOWDOWN;
        group.rate.end = group.rate.end.min(group.rate.start);
    }
}

/// Lets the networks of every deformable layer learn, or not.
fn learns(learns: bool) -> super::Hook {
    Box::new(move |scene, _| {
        for layer in &mut scene.layers {
            if let Spec::DeformMlp(spec) = layer.motion.spec() {
                set_learns(&spec, &mut layer.params, learns)?;
            }
        }
        Ok(())
    })
}

fn set_learns(spec: &DeformSpec, p: &mut Params<f32>, learns: bool) -> Result<()> {
    // The names are those of a model of this spec, wherever its tables are.
    for column in Deform::new(spec.clone(), &mut Params::<f32>::new(0, 1, &[]))?.network_columns() {
        if let Some(key) = p.find(&column) {
            p.info_mut(key).trainable = learns;
        }
    }
    Ok(())
}

/// The groups of networks and grids.
fn networks(stage: &mut Stage, plan: &TrainContext, deform: &DeformSettings) {
    let rate = Rate { start: deform.lr_init, end: deform.lr_final };
    let warm_up = WARM_UP.min(plan.iterations / WARM_UP_SHARE);
    let made = Deform::new(spec(plan, deform), &mut Params::<f32>::new(0, 1, &[]));
    let model = made.expect("a recipe's network can be built: its settings were checked");
    stage.groups.extend(model.network_columns().iter().map(|c| Group { warm_up, ..Group::new(c, rate) }));
    let fast = Rate { start: GRID_SPEEDUP * rate.start, end: GRID_SPEEDUP * rate.end };
    let levels = model.grid_columns();
    // The coarse half learns from the start, then level after level (SC-GS begins with 6 of 12 to 16).
    let first = levels.len().div_ceil(2);
    for (l, columns) in levels.iter().enumerate() {
        let waits = (l + 1).saturating_sub(first) as f64 / (levels.len() - first).max(1) as f64;
        let from = (waits * deform.unlock * plan.iterations as f64) as usize;
        stage.groups.extend(columns.iter().map(|c| Group { from, warm_up, ..Group::new(c, fast) }));
    }
}

#[cfg(test)]
mod tests;
