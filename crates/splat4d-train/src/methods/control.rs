//! `control`: one joint stage. SC-GS learns for 80,000 steps in stages (a still cloud, then the nodes as Gaussians of
//! their own, then Gaussians on nodes); in a run of minutes the half-size images of the first steps do what those
//! stages are for, and nodes start at farthest points of the initial cloud.

pub(crate) mod losses;

use super::auto::CaptureStats;
use super::{Group, Method, Rate, Stage, TrainContext, still};
use crate::maintenance::{AdaptNodes, NodeSettings};
use crate::settings::{choices, settings};
use crate::{Error, Result};
use losses::{MaskSize, NodeAcceleration, NodeArap, NodeElastic, Sparse};
use splat4d::motion::Spec;
use splat4d::motion::control::{ControlSpec, Curve, TrajectorySpec};
use splat4d::motion::skin::{MAX_NEIGHBOURS, MAX_NODES, SkinSpec};

/// One key of a trajectory about every n frames. Four is usual for B-splines on SE(3); with one moving camera fewer
/// keys separate motion from shape sooner: 12 keys reach 31.9 dB on D-NeRF's mutant after 1,000 steps, 41 keys 29.0 dB.
const FRAMES_PER_KEY: usize = 12;
/// A cubic curve has three keys more than segments.
const CUBIC_EXTRA: usize = 3;
/// Most keys that are chosen without being requested: more than a minute of capture at one key in four frames.
const MOST_KEYS: usize = 512;
/// Levels of the encoding of node positions and of time (SC-GS: 10 and 6; nodes are few, so that fewer suffice).
const LEVELS: (usize, usize) = (4, 6);

choices! {
    /// Trajectories of control nodes.
    pub enum Trajectory {
        /// Cubic B-splines on SE(3).
        Spline = "spline",
        /// Straight lines between keys.
        Linear = "linear",
        /// Great arcs between keys.
        Slerp = "slerp",
        /// Shares of a few common motions.
        LowRank = "low-rank",
        /// A network, as in SC-GS.
        Network = "network",
    }
}

settings! {
    /// Settings of control nodes, and of their trajectories in `control`.
    pub struct ControlSettings
    when (Is("run.motion", &["control", "ssm"])) {
        /// Control nodes at the start.
        nodes: usize = 512 => within(1, MAX_NODES);
        /// Nodes that move each Gaussian, 1 to 8.
        neighbours: usize = 3 => within(1, MAX_NEIGHBOURS);
        /// Hyper coordinates, which separate touching parts with different motion.
        hyper: usize = 2;
        /// Whether every Gaussian learns how much it follows its nodes.
        mask: bool = false;
        /// Model of node trajectories: spline, linear, slerp, low-rank or network.
        trajectory: Trajectory = Trajectory::Spline => any().when(Is("run.motion", &["control"]));
        /// Keys of a trajectory in time; 0: about every 12 frames.
        keys: usize = 0
            => any().when(All(&[Is("run.motion", &["control"]), IsNot("control.trajectory", &["network"])]));
        /// Motions that nodes of a low-rank trajectory share.
        bases: usize = 16
            => any().when(All(&[Is("run.motion", &["control"]), Is("control.trajectory", &["low-rank"])]));
        /// Width of the hidden layers of a network.
        width: usize = 128
            => any().when(All(&[Is("run.motion", &["control"]), Is("control.trajectory", &["network"])]));
        /// Hidden layers of a network.
        layers: usize = 4
            => any().when(All(&[Is("run.motion", &["control"]), Is("control.trajectory", &["network"])]));
        /// Rate of node shifts at the start, extents.
        shift_lr_init: f64 = 5e-4
            => any().unit("extents").when(All(&[Is("run.motion", &["control"]), IsNot("control.trajectory", &["network"])]));
        /// Rate of node shifts at the end, extents.
        shift_lr_final: f64 = 1e-5
            => any().unit("extents").when(All(&[Is("run.motion", &["control"]), IsNot("control.trajectory", &["network"])]));
        /// Rate of node quaternions at the start.
        turn_lr_init: f64 = 2e-3
            => any().when(All(&[Is("run.motion", &["control"]), IsNot("control.trajectory", &["network"])]));
        /// Rate of node quaternions at the end.
        turn_lr_final: f64 = 5e-5
            => any().when(All(&[Is("run.motion", &["control"]), IsNot("control.trajectory", &["network"])]));
        /// Rate of a network's weights at the start.
        network_lr_init: f64 = 1e-3
            => any().when(All(&[Is("run.motion", &["control"]), Is("control.trajectory", &["network"])]));
        /// Rate of a network's weights at the end.
        network_lr_final: f64 = 2e-5
            => any().when(All(&[Is("run.motion", &["control"]), Is("control.trajectory", &["network"])]));
        /// Rate of node positions at rest, extents.
        node_lr: f64 = 1e-4 => any().unit("extents");
        /// Rate of node log radii and weight logits.
        weight_lr: f64 = 5e-3;
        /// Rate of hyper coordinates, extents.
        hyper_lr: f64 = 1e-4 => any().unit("extents").when(On("control.hyper"));
        /// Rate of motion masks' logits.
        mask_lr: f64 = 0.02 => any().when(On("control.mask"));
        /// Weight of as-rigid-as-possible motion of nodes.
        arap: f64 = 0.0;
        /// Weight of neighbouring nodes keeping their distance.
        elastic: f64 = 0.0;
        /// Weight of nodes' acceleration.
        acceleration: f64 = 0.0;
        /// Weight of the mean motion mask.
        motion_mask: f64 = 0.01 => any().when(On("control.mask"));
        /// Weight of the sparsity of a low-rank trajectory.
        sparse: f64 = 0.0
            => any().when(All(&[Is("run.motion", &["control"]), Is("control.trajectory", &["low-rank"])]));
    }
}

/// Gaussians skinned to sparse control nodes (Huang et al. 2024, "SC-GS").
#[derive(Clone, Debug)]
pub(crate) struct ControlMethod {
    pub control: ControlSettings,
    pub nodes: NodeSettings,
}

impl Method for ControlMethod {
    fn spec(&self, plan: &TrainContext) -> Spec {
        let (skin, trajectory) = (skin(&self.control), trajectory(plan, &self.control));
        Spec::Control(ControlSpec { seed: plan.seed, clip: plan.clip, skin, trajectory })
    }

    fn check(&self, plan: &TrainContext) -> Result<()> {
        if plan.times < 2 {
            return Err(Error::input(
                "control nodes learn from motion, but all images of the capture have the same time",
            )
            .remedy("Use --motion still"));
        }
        Ok(())
    }

    fn one_time(&self, _plan: &TrainContext) -> bool {
        true
    }

    fn suits(&self, seen: &CaptureStats) -> Option<String> {
        let one = seen.masks && !seen.is_long();
        one.then(|| {
            format!("{} each frame, and masks show one object: few nodes move all of it", seen.cameras_in_words())
        })
    }

    fn nodes(&self, _plan: &TrainContext) -> usize {
        most_nodes(&self.control, &self.nodes)
    }

    fn stages(&self, plan: &TrainContext) -> Vec<Stage> {
        let mut stage = still::stage("control", plan);
        still::learn_life(&mut stage, plan, self.life(plan));
        add_nodes(&mut stage, plan, &self.control, self.nodes);
        add_trajectory(&mut stage, plan, &self.control);
        vec![stage]
    }
}

/// Most nodes that training may have.
pub(crate) fn most_nodes(control: &ControlSettings, nodes: &NodeSettings) -> usize {
    if nodes.adapt_interval > 0 { nodes.cap.max(control.nodes) } else { control.nodes }
}

/// The skin of the control nodes.
pub(crate) fn skin(control: &ControlSettings) -> SkinSpec {
    SkinSpec { nodes: control.nodes, neighbours: control.neighbours, hyper: control.hyper, mask: control.mask }
}

/// Adds the parts that every model of control nodes shares: groups of the skin, losses on nodes, maintenance.
pub(crate) fn add_nodes(stage: &mut Stage, plan: &TrainContext, control: &ControlSettings, nodes: NodeSettings) {
    let c = &plan.common;
    let positions = c.rates.falling(control.node_lr * plan.extent);
    stage.groups.push(Group::new("node_means", positions));
    stage.groups.push(Group::new("node_log_radii", c.rates.falling(control.weight_lr)));
    stage.groups.push(Group::new("node_logits", c.rates.falling(control.weight_lr)));
    let hyper = c.rates.falling(control.hyper_lr * plan.extent);
    stage.groups.push(Group::new("node_hyper", hyper));
    stage.groups.push(Group::new("hyper", hyper));
    stage.groups.push(Group::new("motion_mask", c.rates.falling(control.mask_lr)));
    let extent = plan.extent;
    if control.arap > 0.0 {
        stage.probes.push(Box::new(NodeArap { weight: control.arap, extent, clip: plan.clip }));
    }
    if control.elastic > 0.0 {
        stage.probes.push(Box::new(NodeElastic { weight: control.elastic, clip: plan.clip }));
    }
    if control.acceleration > 0.0 {
        let step = 1.0 / plan.fps;
        stage.probes.push(Box::new(NodeAcceleration { weight: control.acceleration, clip: plan.clip, step }));
    }
    if control.motion_mask > 0.0 && control.mask {
        stage.params.push(Box::new(MaskSize { weight: control.motion_mask }));
    }
    stage.keep(AdaptNodes::of(nodes, &c.densify));
}

fn trajectory(plan: &TrainContext, control: &ControlSettings) -> TrajectorySpec {
    let auto = plan.times.div_ceil(FRAMES_PER_KEY).clamp(1, MOST_KEYS);
    let straight = if control.keys == 0 { auto + 1 } else { control.keys };
    let cubic = if control.keys == 0 { auto + CUBIC_EXTRA } else { control.keys };
    match control.trajectory {
        Trajectory::Linear => TrajectorySpec::Keys { curve: Curve::Linear, keys: straight },
        Trajectory::Slerp => TrajectorySpec::Keys { curve: Curve::Slerp, keys: straight },
        Trajectory::LowRank => TrajectorySpec::LowRank { bases: control.bases, keys: cubic },
        Trajectory::Network => TrajectorySpec::Network {
            width: control.width,
            layers: control.layers,
            position_levels: LEVELS.0,
            time_levels: LEVELS.1,
        },
        Trajectory::Spline => TrajectorySpec::Keys { curve: Curve::Cubic, keys: cubic },
    }
}

/// The trajectory's groups.
fn add_trajectory(stage: &mut Stage, plan: &TrainContext, control: &ControlSettings) {
    let shifts = Rate { start: control.shift_lr_init * plan.extent, end: control.shift_lr_final * plan.extent };
    let turns = Rate { start: control.turn_lr_init, end: control.turn_lr_final };
    let network = Rate { start: control.network_lr_init, end: control.network_lr_final };
    match trajectory(plan, control) {
        TrajectorySpec::LowRank { .. } => {
            stage.groups.push(Group::new("shift_coefficients", shifts));
            stage.groups.push(Group::new("turn_coefficients", turns));
            stage.groups.push(Group::new("bases", turns));
            if control.sparse > 0.0 {
                stage.params.push(Box::new(Sparse { weight: control.sparse, table: "node_coefficients" }));
            }
        }
        TrajectorySpec::Network { layers, .. } => {
            for map in 0..=layers {
                for part in ["weight", "bias"] {
                    stage.groups.push(Group::new(&format!("trajectory.{map}.{part}"), network));
                }
            }
        }
        _ => {
            stage.groups.push(Group::new("node_shifts", shifts));
            stage.groups.push(Group::new("node_turns", turns));
        }
    }
}
