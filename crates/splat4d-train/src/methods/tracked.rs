//! `tracked`: how it is learnt. Frame 0 as a still scene; then one stage a frame, in which only that frame's poses learn,
//! from where the frames before say that everything goes on, tied to its neighbours.
//!
//! Source: Luiten et al. 2024 (Dynamic 3D Gaussians). Ours: who is foreground is learnt from frame 0's masks and not given;
//! lengths are in shares of the rig, so that the weights hold in any unit; the neighbours' weights do not know the unit.

use super::{Group, Hook, PROGRAMS, Plan, Program, Rate, Stage, still};
use crate::loss::graph::{LEAST_MEAN_WEIGHT, Weigh};
use crate::loss::image::ImageTerm;
use crate::loss::image::segmentation::Segmentation;
use crate::loss::tracked::{Ties, Tracking, Weights};
use crate::recipe::Recipe;
use crate::sampler::Sampler;
use crate::{Error, Result};
use splat4d::layers::Layer;
use splat4d::math::quat;
use splat4d::motion::Spec;
use splat4d::motion::tracked::{FOREGROUND, POSE, Tracked, TrackedSpec};
use splat4d::scene::GEOMETRY;
use splat4d::scene::params::{QUAT, page_name};
use std::any::Any;
use std::sync::Arc;

/// The extent, in metres, of the rig that the paper's weights are for (CMU Panoptic Studio).
const PAPER_EXTENT: f64 = 3.0;
/// Share of the masks' weight that frame 0 has. Nobody is known to be foreground yet, and at full weight opacities fall to
/// make up for it: 18.3 dB instead of 29.5 on frame 0 of the bundled capture after 800 steps. The logits, which see nothing
/// but masks, learn as fast with any weight, since Adam does not know the scale of a gradient.
const FIRST_MASKS: f64 = 1e-3;

/// Positions and rotations of the same Gaussians at every frame (Luiten et al. 2024, "Dynamic 3D Gaussians").
#[derive(Clone, Copy, Debug)]
pub struct TrackedProgram;

impl Program for TrackedProgram {
    fn spec(&self, plan: &Plan) -> Spec {
        let first = plan.moments.first().map_or(plan.clip[0], |m| m.0);
        Spec::Tracked(TrackedSpec { times: vec![first], foreground: segments(plan) })
    }

    fn first(&self, plan: &Plan) -> Plan {
        let t = plan.moments[0];
        Plan { clip: [t.0; 2], times: 1, moments: vec![t], ..plan.clone() }
    }

    fn check(&self, plan: &Plan) -> Result<()> {
        let least = self.capabilities(plan).fixed_cameras;
        let fewest = plan.moments.iter().min_by_key(|m| m.1).copied().unwrap_or_default();
        if fewest.1 < least {
            let others = PROGRAMS.into_iter().filter(|(_, make)| make().capabilities(plan).fixed_cameras < least);
            let others: Vec<&str> = others.map(|(name, _)| name).collect();
            return Err(Error::input(format!(
                "`tracked` needs at least {least} fixed cameras that take their pictures together: it follows \
                 every Gaussian from one moment to the next, and what fewer cameras see of one moment does not say where \
                 things are. At {:.3} s this capture has {} training pictures of fixed cameras",
                fewest.0, fewest.1
            ))
            .remedy(format!("Use another --motion: {}", others.join(", "))));
        }
        if plan.recipe.prune_interval > 0 {
            return Err(Error::input("`tracked` cannot prune while it trains: it does not know the frames to come")
                .remedy("Leave prune_interval at 0, or prune afterwards with `splat4d compress`"));
        }
        floor(&plan.recipe).map(|_| ())
    }

    fn stages(&self, plan: &Plan) -> Vec<Stage> {
        let r = &plan.recipe;
        let frames = plan.moments.len();
        let first = first_steps(r, frames);
        let tracking = Tracking::new(ties(plan));
        let mut stages = vec![first_stage(plan, first)];
        let rest = r.iterations - first;
        for k in 1..frames {
            let steps = rest * k / (frames - 1) - rest * (k - 1) / (frames - 1);
            let positions = Rate { start: r.track_lr_init * plan.extent, end: r.track_lr_final * plan.extent };
            let mut groups = vec![
                Group::new(&page_name("means", k as u32), positions),
                Group::new(&page_name("quats", k as u32), Rate::constant(r.track_rotation_lr)),
            ];
            if r.track_feature_lr > 0.0 {
                groups.push(Group { part: Some((0, 3)), ..Group::new("sh", Rate::constant(r.track_feature_lr)) });
            }
            stages.push(Stage {
                sampler: Sampler::Frame(k),
                batch: r.batch_size,
                groups,
                params: vec![Box::new(tracking.frame(k))],
                pictures: segmentation(plan, 1.0),
                freeze_exposure: true,
                start: Some(next_frame(plan, k, &tracking)),
                ..Stage::new(&format!("frame {k}"), steps)
            });
        }
        stages
    }

    /// The result itself: a page a frame.
    fn growth_bytes(&self, plan: &Plan, rows: usize) -> u64 {
        let pages = plan.moments.len().saturating_sub(1);
        (rows * pages * POSE * size_of::<f32>()) as u64
    }

    /// Every frame's page beside what all frames share; who is foreground is settled.
    fn tuning(&self, plan: &Plan) -> Stage {
        let r = &plan.recipe;
        let mut stage = still::stage("tracked", plan);
        let positions = Rate { start: r.track_lr_init * plan.extent, end: r.track_lr_final * plan.extent };
        for k in 1..plan.moments.len() as u32 {
            stage.groups.push(Group::new(&page_name("means", k), positions));
            stage.groups.push(Group::new(&page_name("quats", k), Rate::constant(r.track_rotation_lr)));
        }
        stage
    }
}

/// Whether Gaussians learn who is foreground.
fn segments(plan: &Plan) -> bool {
    plan.masks && plan.recipe.seg > 0.0
}

/// Masks against the foreground logit, at a share of the recipe's weight.
fn segmentation(plan: &Plan, share: f64) -> Vec<Box<dyn ImageTerm>> {
    let r = &plan.recipe;
    let term = || -> Box<dyn ImageTerm> { Box::new(Segmentation::new(FOREGROUND, share * r.seg, r.lambda_dssim)) };
    segments(plan).then(term).into_iter().collect()
}

/// Steps of frame 0.
fn first_steps(r: &Recipe, frames: usize) -> usize {
    if frames <= 1 { r.iterations } else { ((r.iterations as f64 * r.first_share.min(1.0)) as usize).max(1) }
}

/// Height of the floor, if there is one. Errors: not a number.
fn floor(r: &Recipe) -> Result<Option<f64>> {
    if r.floor_height.is_empty() {
        return Ok(None);
    }
    match r.floor_height.parse::<f64>() {
        Ok(height) if height.is_finite() => Ok(Some(height)),
        _ => Err(Error::input(format!("knob `floor_height` cannot be `{}`", r.floor_height))
            .remedy("Give a number of scene units along the scene's up direction, or nothing")),
    }
}

fn ties(plan: &Plan) -> Ties {
    let r = &plan.recipe;
    let floor = floor(r).ok().flatten();
    Ties {
        neighbours: r.rigid_neighbours,
        weigh: if r.rigid_beta > 0.0 { Weigh::Beta(r.rigid_beta) } else { Weigh::Median(1.0) },
        weights: Weights {
            rigid: r.rigid,
            rot: r.rot,
            iso: r.iso,
            bg: r.bg,
            soft_col: if r.track_feature_lr > 0.0 { r.soft_col_cons } else { 0.0 },
            floor: if floor.is_some() { r.floor } else { 0.0 },
        },
        floor: floor.unwrap_or(0.0),
        unit: plan.extent / PAPER_EXTENT,
    }
}

/// Frame 0 is a still scene; what the recipe schedules over all steps happens in this stage's.
fn first_stage(plan: &Plan, steps: usize) -> Stage {
    let share = steps as f64 / plan.recipe.iterations as f64;
    let part = |steps: usize| ((steps as f64 * share) as usize).max(1);
    let r = Recipe {
        iterations: steps,
        sh_degree_interval: part(plan.recipe.sh_degree_interval),
        densification_interval: part(plan.recipe.densification_interval),
        densify_from_iter: part(plan.recipe.densify_from_iter),
        densify_until_iter: part(plan.recipe.densify_until_iter),
        ..plan.recipe.clone()
    };
    let plan = Plan { recipe: r, ..plan.clone() };
    let mut stage = still::stage("frame 0", &plan);
    stage.sampler = Sampler::Frame(0);
    still::learn_life(&mut stage, &plan, TrackedProgram.life(&plan));
    if segments(&plan) {
        stage.groups.push(Group::new(FOREGROUND, plan.recipe.falling(plan.recipe.opacity_lr)));
        stage.pictures = segmentation(&plan, FIRST_MASKS);
    }
    stage
}

/// Adds frame k where everything goes on as it went.
fn next_frame(plan: &Plan, k: usize, tracking: &Tracking<f32>) -> Hook {
    let (t, cap) = (plan.moments[k].0, plan.recipe.velocity_cap * plan.extent);
    let tracking = tracking.clone();
    Box::new(move |scene, progress| {
        let layer = &mut scene.layers[0];
        if k == 1 {
            unit_quaternions(layer);
            let mean = tracking.frame0(layer).graph.mean_weight();
            if mean < LEAST_MEAN_WEIGHT {
                progress.warn(format!(
                    "neighbours hold together with a mean weight of {mean:.3} only; lower rigid_beta, or set it to 0 to \
                     fit it to the scene"
                ));
            }
        }
        let model: &dyn Any = layer.motion.as_ref();
        let Some(model) = model.downcast_ref::<Tracked>() else {
            return Err(Error::input("this scene was not made by `tracked`").remedy("Train from the start"));
        };
        let next = model.propagate(&mut layer.params, t, cap)?;
        layer.motion = Arc::new(next);
        Ok(())
    })
}

/// Frame 0's quaternions get length 1, as the others have: what they differ in is then the turn alone.
fn unit_quaternions(layer: &mut Layer) {
    let geometry = &mut layer.params[GEOMETRY];
    for r in 0..geometry.rows() {
        let q = quat::normalize(geometry.read::<4>(r, QUAT)).0;
        geometry.write(r, QUAT, q);
    }
}

#[cfg(test)]
mod tests;
