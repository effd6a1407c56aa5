//! `control`: one joint stage. SC-GS learns for 80,000 steps in stages (a still cloud, then the nodes as Gaussians of their
//! own, then Gaussians on nodes); in a run of minutes the half-size pictures of the first steps do what those stages are
//! for, and nodes start at farthest points of the initial cloud.

pub mod losses;

use super::auto::Seen;
use super::{Group, Plan, Program, Rate, Stage, still};
use crate::recipe::Recipe;
use crate::upkeep::AdaptNodes;
use crate::{Error, Result};
use losses::{MaskSize, NodeAcceleration, NodeArap, NodeElastic, Sparse};
use splat4d::motion::Spec;
use splat4d::motion::control::{ControlSpec, Curve, TrajectorySpec};
use splat4d::motion::skin::SkinSpec;

/// One key of a trajectory about every so many frames. Four is usual for B-splines on SE(3); with one moving camera fewer
/// keys tell motion from shape sooner: 12 keys reach 31.9 dB on D-NeRF's mutant after 1,000 steps, 41 keys 29.0 dB.
const FRAMES_PER_KEY: usize = 12;
/// A cubic curve has three keys more than segments.
const CUBIC_EXTRA: usize = 3;
/// Most keys that are chosen without being asked for: more than a minute of capture at one key in four frames.
const MOST_KEYS: usize = 512;
/// Levels of the encoding of node positions and of time (SC-GS: 10 and 6; nodes are few, so that fewer suffice).
const LEVELS: (usize, usize) = (4, 6);

/// Gaussians skinned to sparse control nodes (Huang et al. 2024, "SC-GS").
#[derive(Clone, Copy, Debug)]
pub struct ControlProgram;

impl Program for ControlProgram {
    fn spec(&self, plan: &Plan) -> Spec {
        let r = &plan.recipe;
        Spec::Control(ControlSpec { seed: r.seed, clip: plan.clip, skin: skin(r), trajectory: trajectory(plan) })
    }

    fn check(&self, plan: &Plan) -> Result<()> {
        if plan.times < 2 {
            return Err(Error::input("control nodes learn from motion, and the capture has one moment only")
                .remedy("Use --motion still"));
        }
        Ok(())
    }

    fn one_moment(&self, _plan: &Plan) -> bool {
        true
    }

    fn suits(&self, seen: &Seen) -> Option<String> {
        let one = seen.masks && !seen.is_long();
        one.then(|| {
            format!("{} a moment, and masks show one object: few nodes move all of it", seen.cameras_in_words())
        })
    }

    fn nodes(&self, plan: &Plan) -> usize {
        most_nodes(&plan.recipe)
    }

    fn stages(&self, plan: &Plan) -> Vec<Stage> {
        let mut stage = still::stage("control", plan);
        still::learn_life(&mut stage, plan, self.life(plan));
        add_nodes(&mut stage, plan);
        add_trajectory(&mut stage, plan);
        vec![stage]
    }
}

/// Most nodes that training may have.
pub fn most_nodes(r: &Recipe) -> usize {
    if r.control_adapt_interval > 0 { r.control_max_nodes.max(r.control_nodes) } else { r.control_nodes }
}

/// The skin that the recipe asks for.
pub fn skin(r: &Recipe) -> SkinSpec {
    SkinSpec { nodes: r.control_nodes, neighbours: r.control_neighbours, hyper: r.control_hyper, mask: r.control_mask }
}

/// What every model of control nodes learns of them, and how they adapt: groups of the skin, losses on nodes, upkeep.
pub fn add_nodes(stage: &mut Stage, plan: &Plan) {
    let r = &plan.recipe;
    let positions = r.falling(r.control_node_lr * plan.extent);
    stage.groups.push(Group::new("node_means", positions));
    stage.groups.push(Group::new("node_log_radii", r.falling(r.control_weight_lr)));
    stage.groups.push(Group::new("node_logits", r.falling(r.control_weight_lr)));
    let hyper = r.falling(r.control_hyper_lr * plan.extent);
    stage.groups.push(Group::new("node_hyper", hyper));
    stage.groups.push(Group::new("hyper", hyper));
    stage.groups.push(Group::new("motion_mask", r.falling(r.control_mask_lr)));
    let extent = plan.extent;
    if r.lambda_node_arap > 0.0 {
        stage.probes.push(Box::new(NodeArap { weight: r.lambda_node_arap, extent, clip: plan.clip }));
    }
    if r.lambda_node_elastic > 0.0 {
        stage.probes.push(Box::new(NodeElastic { weight: r.lambda_node_elastic, clip: plan.clip }));
    }
    if r.lambda_node_acceleration > 0.0 {
        let step = 1.0 / plan.fps;
        stage.probes.push(Box::new(NodeAcceleration { weight: r.lambda_node_acceleration, clip: plan.clip, step }));
    }
    if r.lambda_motion_mask > 0.0 && r.control_mask {
        stage.params.push(Box::new(MaskSize { weight: r.lambda_motion_mask }));
    }
    stage.keep(AdaptNodes::of(r));
}

fn trajectory(plan: &Plan) -> TrajectorySpec {
    let r = &plan.recipe;
    let auto = plan.times.div_ceil(FRAMES_PER_KEY).clamp(1, MOST_KEYS);
    let straight = if r.control_keys == 0 { auto + 1 } else { r.control_keys };
    let cubic = if r.control_keys == 0 { auto + CUBIC_EXTRA } else { r.control_keys };
    match r.control_trajectory.as_str() {
        "linear" => TrajectorySpec::Keys { curve: Curve::Linear, keys: straight },
        "slerp" => TrajectorySpec::Keys { curve: Curve::Slerp, keys: straight },
        "low-rank" => TrajectorySpec::LowRank { bases: r.control_bases, keys: cubic },
        "network" => TrajectorySpec::Network {
            width: r.control_width,
            layers: r.control_layers,
            position_levels: LEVELS.0,
            time_levels: LEVELS.1,
        },
        _ => TrajectorySpec::Keys { curve: Curve::Cubic, keys: cubic },
    }
}

/// The trajectory's groups.
fn add_trajectory(stage: &mut Stage, plan: &Plan) {
    let r = &plan.recipe;
    let shifts = Rate { start: r.control_shift_lr_init * plan.extent, end: r.control_shift_lr_final * plan.extent };
    let turns = Rate { start: r.control_turn_lr_init, end: r.control_turn_lr_final };
    let network = Rate { start: r.control_network_lr_init, end: r.control_network_lr_final };
    match trajectory(plan) {
        TrajectorySpec::LowRank { .. } => {
            stage.groups.push(Group::new("shift_coefficients", shifts));
            stage.groups.push(Group::new("turn_coefficients", turns));
            stage.groups.push(Group::new("bases", turns));
            if r.lambda_sparse > 0.0 {
                stage.params.push(Box::new(Sparse { weight: r.lambda_sparse, table: "node_coefficients" }));
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
