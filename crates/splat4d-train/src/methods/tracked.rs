//! Training of `tracked`. Frame 0 as a still scene; then one stage a frame, in which only that frame's poses learn,
//! starting from the extrapolation of the previous frames, tied to their neighbours.
//!
//! Source: Luiten et al. 2024 (Dynamic 3D Gaussians). Ours: who is foreground is learnt from frame 0's masks and not
//! given; lengths are in shares of the rig, so that the weights hold in any unit; the neighbours' weights do not depend
//! on the unit.

use super::auto::CaptureStats;
use super::{Group, Hook, Method, Rate, Stage, TrainContext, still};
use crate::loss::graph::{LEAST_MEAN_WEIGHT, Weigh};
use crate::loss::image::ImageTerm;
use crate::loss::image::segmentation::Segmentation;
use crate::loss::tracked::{Ties, Tracking, Weights};
use crate::sampler::Sampler;
use crate::settings::settings;
use crate::{Error, Result};
use splat4d::layers::Layer;
use splat4d::math::quat;
use splat4d::motion::tracked::{FOREGROUND, LEAST_CAMERAS, POSE, Tracked, TrackedSpec};
use splat4d::motion::{MODELS, Spec};
use splat4d::scene::GEOMETRY;
use splat4d::scene::params::{QUAT, page_name};
use std::any::Any;
use std::sync::Arc;

/// The name of the model.
const NAME: &str = "tracked";
/// The extent, in metres, of the rig that the paper's weights are for (CMU Panoptic Studio).
const PAPER_EXTENT: f64 = 3.0;
/// Share of the masks' weight that frame 0 has. The foreground is not known yet, and at full weight opacities fall to
/// make up for it: 18.3 dB instead of 29.5 on frame 0 of the bundled capture after 800 steps. The logits, which depend
/// on masks alone, learn as fast with any weight, because Adam is invariant to the scale of a gradient.
const FIRST_MASKS: f64 = 1e-3;

settings! {
    /// Settings of `tracked`.
    pub struct TrackedSettings
    when (Is("run.motion", &["tracked"])) {
        /// Share of the iterations that frame 0 gets; the other frames share the rest.
        first_share: f64 = 0.25;
        /// Rate of a frame's positions at its first step, share of the extent.
        lr_init: f64 = 3e-3 => any().unit("extents");
        /// Rate of a frame's positions at its last step, share of the extent.
        lr_final: f64 = 4e-4 => any().unit("extents");
        /// Rate of a frame's quaternions.
        rotation_lr: f64 = 6e-3;
        /// Rate of base colours after frame 0. Colours are shared, so earlier frames change too.
        feature_lr: f64 = 0.0;
        /// Longest step that a Gaussian repeats in the next frame, share of the extent.
        velocity_cap: f64 = 0.05 => any().unit("extents");
        /// Number of neighbours that each Gaussian is tied to.
        neighbours: usize = 20;
        /// A neighbour at distance d has weight exp(−β d²), β in 1/(scene units)²; 0: 1/median(d²).
        beta: f64 = 0.0 => any().unit("1/units²");
        /// Weight of neighbours keeping their offsets (rigidity). A quarter of this and of the next two follows bodies
        /// that are fast for the frame rate, which the published weights lose; slow ones are followed less exactly
        /// (studies/records/2026-11-26-dynamics.md).
        rigid: f64 = 4.0;
        /// Weight of neighbours rotating alike.
        rot: f64 = 4.0;
        /// Weight of neighbours keeping frame 0's distances.
        iso: f64 = 2.0;
        /// Weight of a static background (with masks).
        bg: f64 = 20.0;
        /// Weight of masks against the learned foreground; 0: all is foreground.
        seg: f64 = 3.0;
        /// Weight of constant colours, if they learn.
        soft_col_cons: f64 = 0.01 => any().when(On("tracked.feature_lr"));
        /// Weight of the foreground above the floor.
        floor: f64 = 2.0 => any().when(On("tracked.floor_height"));
        /// Height of the floor along the scene's up direction, scene units; empty: no floor.
        floor_height: Option<f64> = None => finite().unit("units");
    }
}

/// Positions and rotations of the same Gaussians at every frame (Luiten et al. 2024, "Dynamic 3D Gaussians").
#[derive(Clone, Debug)]
pub(crate) struct TrackedMethod {
    pub tracked: TrackedSettings,
}

impl Method for TrackedMethod {
    /// Frames are fitted one after the other, with poses of the rows of one layer.
    fn allows_layers(&self) -> bool {
        false
    }

    fn spec(&self, plan: &TrainContext) -> Spec {
        let first = plan.moments.first().map_or(plan.clip[0], |m| m.0);
        Spec::Tracked(TrackedSpec { times: vec![first], foreground: segments(plan, &self.tracked) })
    }

    fn first(&self, plan: &TrainContext) -> TrainContext {
        let t = plan.moments[0];
        TrainContext { clip: [t.0; 2], times: 1, moments: vec![t], ..plan.clone() }
    }

    fn check(&self, plan: &TrainContext) -> Result<()> {
        let least = self.capabilities(plan).fixed_cameras;
        let fewest = plan.moments.iter().min_by_key(|m| m.1).copied().unwrap_or_default();
        if fewest.1 < least {
            let others: Vec<&str> = MODELS.iter().copied().filter(|name| *name != NAME).collect();
            return Err(Error::input(format!(
                "`tracked` needs at least {least} fixed, synchronised cameras: it tracks every Gaussian from frame \
                 to frame, and fewer cameras do not determine positions in a frame. At {:.3} s this capture has {} \
                 training images of fixed cameras",
                fewest.0, fewest.1
            ))
            .remedy(format!("Use another --motion: {}", others.join(", "))));
        }
        if plan.common.prune.interval > 0 {
            return Err(Error::input("`tracked` cannot prune during training: later frames are not trained yet")
                .remedy("Leave prune_interval at 0, or prune afterwards with `splat4d compress`"));
        }
        Ok(())
    }

    fn suits(&self, seen: &CaptureStats) -> Option<String> {
        (seen.predicted && seen.fewest >= LEAST_CAMERAS && !seen.is_long()).then(|| {
            let cameras = seen.cameras_in_words();
            format!("{cameras} each frame, and prediction needs persistent Gaussians that can be tracked")
        })
    }

    fn stages(&self, plan: &TrainContext) -> Vec<Stage> {
        let tracked = &self.tracked;
        let frames = plan.moments.len();
        let first = first_steps(plan.iterations, tracked.first_share, frames);
        let tracking = Tracking::new(ties(plan, tracked));
        let mut stages = vec![self.first_stage(plan, first)];
        let rest = plan.iterations - first;
        for k in 1..frames {
            let steps = rest * k / (frames - 1) - rest * (k - 1) / (frames - 1);
            let positions = Rate { start: tracked.lr_init * plan.extent, end: tracked.lr_final * plan.extent };
            let mut groups = vec![
                Group::new(&page_name("means", k as u32), positions),
                Group::new(&page_name("quats", k as u32), Rate::constant(tracked.rotation_lr)),
            ];
            if tracked.feature_lr > 0.0 {
                groups.push(Group { part: Some((0, 3)), ..Group::new("sh", Rate::constant(tracked.feature_lr)) });
            }
            stages.push(Stage {
                sampler: Sampler::Frame(k),
                batch: plan.batch_size,
                groups,
                params: vec![Box::new(tracking.frame(k))],
                pictures: segmentation(plan, tracked, 1.0),
                freeze_exposure: true,
                start: Some(next_frame(plan, k, tracked.velocity_cap, &tracking)),
                ..Stage::new(&format!("frame {k}"), steps)
            });
        }
        stages
    }

    /// The result itself: a page a frame.
    fn growth_bytes(&self, plan: &TrainContext, rows: usize) -> u64 {
        let pages = plan.moments.len().saturating_sub(1);
        (rows * pages * POSE * size_of::<f32>()) as u64
    }

    /// Every frame's page next to what all frames share; who is foreground is settled.
    fn tuning(&self, plan: &TrainContext) -> Stage {
        let tracked = &self.tracked;
        let mut stage = still::stage("tracked", plan);
        let positions = Rate { start: tracked.lr_init * plan.extent, end: tracked.lr_final * plan.extent };
        for k in 1..plan.moments.len() as u32 {
            stage.groups.push(Group::new(&page_name("means", k), positions));
            stage.groups.push(Group::new(&page_name("quats", k), Rate::constant(tracked.rotation_lr)));
        }
        stage
    }
}

/// Whether Gaussians learn a foreground logit.
fn segments(plan: &TrainContext, tracked: &TrackedSettings) -> bool {
    plan.masks && tracked.seg > 0.0
}

/// Masks against the foreground logit, at a share of the recipe's weight.
fn segmentation(plan: &TrainContext, tracked: &TrackedSettings, share: f64) -> Vec<Box<dyn ImageTerm>> {
    let (weight, dssim) = (share * tracked.seg, plan.common.loss.dssim);
    let term = || -> Box<dyn ImageTerm> { Box::new(Segmentation::new(FOREGROUND, weight, dssim)) };
    segments(plan, tracked).then(term).into_iter().collect()
}

/// Steps of frame 0.
fn first_steps(iterations: usize, share: f64, frames: usize) -> usize {
    if frames <= 1 { iterations } else { ((iterations as f64 * share.min(1.0)) as usize).max(1) }
}

fn ties(plan: &TrainContext, tracked: &TrackedSettings) -> Ties {
    Ties {
        neighbours: tracked.neighbours,
        weigh: if tracked.beta > 0.0 { Weigh::Beta(tracked.beta) } else { Weigh::Median(1.0) },
        weights: Weights {
            rigid: tracked.rigid,
            rot: tracked.rot,
            iso: tracked.iso,
            bg: tracked.bg,
            soft_col: if tracked.feature_lr > 0.0 { tracked.soft_col_cons } else { 0.0 },
            floor: if tracked.floor_height.is_some() { tracked.floor } else { 0.0 },
        },
        floor: tracked.floor_height.unwrap_or(0.0),
        unit: plan.extent / PAPER_EXTENT,
    }
}

impl TrackedMethod {
    /// Frame 0 is a still scene; what is scheduled over all steps happens in this stage's.
    fn first_stage(&self, plan: &TrainContext, steps: usize) -> Stage {
        let share = steps as f64 / plan.iterations as f64;
        let part = |steps: &mut usize| *steps = ((*steps as f64 * share) as usize).max(1);
        let mut first = TrainContext { iterations: steps, ..plan.clone() };
        part(&mut first.common.appearance.sh_degree_interval);
        part(&mut first.common.densify.interval);
        part(&mut first.common.densify.from);
        part(&mut first.common.densify.until);
        let mut stage = still::stage("frame 0", &first);
        stage.sampler = Sampler::Frame(0);
        still::learn_life(&mut stage, &first, self.life(&first));
        if segments(plan, &self.tracked) {
            let rates = &plan.common.rates;
            stage.groups.push(Group::new(FOREGROUND, rates.falling(rates.opacity)));
            stage.pictures = segmentation(plan, &self.tracked, FIRST_MASKS);
        }
        stage
    }
}

/// Adds frame k where everything continues as it went.
fn next_frame(plan: &TrainContext, k: usize, velocity_cap: f64, tracking: &Tracking<f32>) -> Hook {
    let (t, cap) = (plan.moments[k].0, velocity_cap * plan.extent);
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

/// Frame 0's quaternions get length 1, as the others have: their difference is then only the rotation.
fn unit_quaternions(layer: &mut Layer) {
    let geometry = &mut layer.params[GEOMETRY];
    for r in 0..geometry.rows() {
        let q = quat::normalize(geometry.read::<4>(r, QUAT)).0;
        geometry.write(r, QUAT, q);
    }
}

#[cfg(test)]
mod tests;
