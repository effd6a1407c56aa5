//! Training of `ssm`. One joint stage, as of `control`, whose nodes, losses on nodes and maintenance it shares; before
//! it, if the recipe specifies it, a still warm-up, after which nodes are placed again on what became of the cloud.

use super::{ControlSettings, Group, Hook, Method, Rate, Stage, TrainContext, control, still};
use crate::maintenance::NodeSettings;
use crate::settings::{Choice, settings};
use crate::{Error, Result};
use splat4d::layers::Layer;
use splat4d::math::knn::mean_square_distance;
use splat4d::motion::Spec;
use splat4d::motion::skin::{NODE_LOG_RADIUS, Skin, farthest_points};
use splat4d::motion::ssm::{Equivariance, Mode, Output, SsmSpec, refresh};
use splat4d::scene::GEOMETRY;
use splat4d::scene::params::OPACITY;

settings! {
    /// Settings of `ssm`, whose nodes are those of `[control]`.
    pub struct SsmSettings
    when (Is("run.motion", &["ssm"])) {
        /// Ticks of the scan over the clip; 0: one per ten distinct times, 16 to 96.
        ticks: usize = 0;
        /// Channels.
        width: usize = 32;
        /// Complex states per channel.
        states: usize = 8;
        /// Residual blocks.
        blocks: usize = 2;
        /// Bidirectional (to reconstruct) or causal (to forecast).
        mode: Mode = Mode::Bidirectional;
        /// Absolute (poses) or twist (rates of poses, composed from tick to tick).
        output: Output = Output::Absolute;
        /// None, frames (equivariant to rotations) or vector (and to reflections).
        equivariance: Equivariance = Equivariance::None;
        /// Share of the iterations, from the first, in which the scene is static; nodes are placed after it.
        warm_up: f64 = 0.0 => share();
        /// Rate of the network's maps at the start.
        lr_init: f64 = 5e-4;
        /// Rate of the network's maps at the end.
        lr_final: f64 = 1e-5;
        /// Rate of the state space's decays, frequencies and steps.
        dynamics_lr: f64 = 5e-4;
        /// Rate of the nodes' embeddings.
        embedding_lr: f64 = 3e-2;
    }
}

impl Choice for Mode {
    const NAMES: &'static [(&'static str, Self)] = &[("bidirectional", Self::Bidirectional), ("causal", Self::Causal)];
}

impl Choice for Output {
    const NAMES: &'static [(&'static str, Self)] = &[("absolute", Self::Absolute), ("twist", Self::Twist)];
}

impl Choice for Equivariance {
    const NAMES: &'static [(&'static str, Self)] =
        &[("none", Self::None), ("frames", Self::Frames), ("vector", Self::Vector)];
}

/// Control nodes driven by a diagonal state-space model.
#[derive(Clone, Debug)]
pub(crate) struct SsmMethod {
    pub ssm: SsmSettings,
    pub control: ControlSettings,
    pub nodes: NodeSettings,
}

/// Distinct times a tick, where the recipe leaves the choice: on mutant (150 times) 16 ticks gained 1.5 dB over 75.
const TIMES_PER_TICK: usize = 10;
/// Ticks of a clip, where the recipe leaves the choice.
const TICKS: std::ops::RangeInclusive<usize> = 16..=96;
/// Gaussians less opaque than this hold no node: what is about to die carries no information of the shape.
const SOLID_LOGIT: f32 = -2.2;

impl Method for SsmMethod {
    fn spec(&self, plan: &TrainContext) -> Spec {
        let ticks = if self.ssm.ticks > 0 { self.ssm.ticks } else { plan.times.div_ceil(TIMES_PER_TICK) };
        Spec::Ssm(SsmSpec {
            seed: plan.seed,
            skin: control::skin(&self.control),
            clip: plan.clip,
            ticks: if self.ssm.ticks > 0 { ticks.max(2) } else { ticks.clamp(*TICKS.start(), *TICKS.end()) },
            width: self.ssm.width,
            states: self.ssm.states,
            blocks: self.ssm.blocks,
            extent: plan.extent,
            mode: self.ssm.mode,
            octaves: if self.ssm.mode == Mode::Causal { 0 } else { SsmSpec::default().octaves },
            output: self.ssm.output,
            equivariance: self.ssm.equivariance,
            ..SsmSpec::default()
        })
    }

    fn check(&self, plan: &TrainContext) -> Result<()> {
        if plan.times < 2 {
            return Err(Error::input(
                "a state-space model learns from motion, but all images of the capture have the same time",
            )
            .remedy("Use --motion still"));
        }
        Ok(())
    }

    fn one_time(&self, _plan: &TrainContext) -> bool {
        true
    }

    fn nodes(&self, _plan: &TrainContext) -> usize {
        control::most_nodes(&self.control, &self.nodes)
    }

    fn stages(&self, plan: &TrainContext) -> Vec<Stage> {
        let warm = (self.ssm.warm_up * plan.iterations as f64) as usize;
        let mut stages = Vec::new();
        if warm > 0 {
            let mut first = still::stage("ssm warm-up", plan).part(0, warm);
            still::learn_life(&mut first, plan, self.life(plan));
            stages.push(first);
        }
        let mut all = still::stage("ssm", plan).part(warm, plan.iterations);
        still::learn_life(&mut all, plan, self.life(plan));
        control::add_nodes(&mut all, plan, &self.control, self.nodes);
        all.groups.extend(groups(self.spec(plan), plan, &self.ssm));
        if warm > 0 {
            all.start = Some(place_nodes());
        }
        stages.push(all);
        stages
    }
}

/// The network's groups.
fn groups(spec: Spec, plan: &TrainContext, ssm: &SsmSettings) -> Vec<Group> {
    let maps = Rate { start: ssm.lr_init, end: ssm.lr_final };
    let mut groups = vec![Group::new("node_embeddings", plan.common.rates.falling(ssm.embedding_lr))];
    // A model of an empty layer has the same columns as any other.
    let Spec::Ssm(spec) = spec else { return groups };
    if let Ok((dynamics, others)) = splat4d::motion::ssm::columns(&spec) {
        groups.extend(dynamics.iter().map(|c| Group::new(c, Rate::constant(ssm.dynamics_lr))));
        groups.extend(others.iter().map(|c| Group::new(c, maps)));
    }
    groups
}

/// Puts the nodes where the solid Gaussians are.
fn place_nodes() -> Hook {
    Box::new(|scene, _| {
        for layer in &mut scene.layers {
            place(layer);
        }
        Ok(())
    })
}

fn place(layer: &mut Layer) {
    let Spec::Ssm(spec) = layer.motion.spec() else { return };
    let p = &mut layer.params;
    let Some(skin) = Skin::find(p) else { return };
    let count = skin.count(p);
    let solid: Vec<u32> = (0..p.len() as u32).filter(|&i| p[GEOMETRY].get(i as usize, OPACITY) > SOLID_LOGIT).collect();
    let centers = farthest_points(&p[GEOMETRY].gather(&solid), count);
    // A file and its times have as many nodes as at the start: where the cloud is too small they stay where they are.
    if centers.len() < count {
        return;
    }
    let spacing = mean_square_distance(&centers);
    let nodes = &mut p[skin.nodes];
    for (k, (center, square)) in centers.iter().zip(spacing).enumerate() {
        nodes.write(k, 0, *center);
        nodes.set(k, NODE_LOG_RADIUS, 0.5 * square.max(f32::MIN_POSITIVE).ln());
    }
    skin.bind(p);
    refresh(spec.equivariance, p);
}
