//! Training of `hexplane`. A coarse stage in which nothing moves, then a fine one in which planes and networks learn
//! with the canonical cloud. The box of the planes is that of the cloud when the fine stage begins.
//!
//! The original multiplies every rate by the scene's extent. Here the networks' inputs are in the box [0, 1]³ and their
//! outputs in half boxes, so the rates of planes and networks have no unit; the cloud's positions keep theirs.
//! Source: Wu et al. 2024 ("4DGaussians") §4 and the released configurations.

use super::{Group, Hook, Method, Rate, Stage, TrainContext, still};
use crate::loss::planes::{PlaneWeights, SmoothPlanes};
use crate::settings::settings;
use crate::{Error, Result};
use splat4d::layers::Scene;
use splat4d::math::Real;
use splat4d::motion::hexplane::{Heads, Hexplane, HexplaneSpec};
use splat4d::motion::{Phase, Spec};
use splat4d::nn::hexplane::PlaneShape;
use splat4d::scene::{GEOMETRY, Table};
use std::any::Any;
use std::sync::Arc;

settings! {
    /// Settings of `hexplane`.
    pub struct HexplaneSettings
    when (Is("run.motion", &["hexplane"])) {
        /// Steps of the coarse, static stage; 0: iterations/10.
        coarse_iterations: usize = 0 => any().unit("iterations");
        /// Features per level of the planes; a multiple of 16.
        plane_channels: usize = 32;
        /// Grid points of a plane along a spatial axis, at multiple 1.
        plane_resolution: usize = 64;
        /// Grid points of a plane along time; 0: one every 4 frames, at least 8.
        time_resolution: usize = 0;
        /// Levels of the planes, as multiples of the resolution.
        multires: Vec<usize> = vec![1, 2];
        /// Steps of the fine stage before each further level is unlocked; 0: all from the start.
        unlock_interval: usize = 0 => any().unit("iterations");
        /// Width of the networks.
        net_width: usize = 64;
        /// Linear maps between planes and heads; 0 is 1.
        defor_depth: usize = 0;
        /// Positions do not move.
        no_dx: bool = false;
        /// Scales do not change.
        no_ds: bool = false;
        /// Rotations do not change.
        no_dr: bool = false;
        /// Opacities do not change.
        no_do: bool = true;
        /// Colours do not change.
        no_dshs: bool = true;
        /// Rate of the planes at the start.
        grid_lr_init: f64 = 2e-2;
        /// Rate of the planes at the end.
        grid_lr_final: f64 = 2e-3;
        /// Rate of the networks at the start.
        deformation_lr_init: f64 = 1e-3;
        /// Rate of the networks at the end.
        deformation_lr_final: f64 = 1e-4;
        /// Weight of the squared second differences of the planes over space.
        plane_tv_weight: f64 = 1e-4;
        /// Weight of the squared second differences of the time planes along time.
        time_smoothness_weight: f64 = 0.01;
        /// Weight of the mean distance of the time planes from 1 (1: no dependence on time).
        l1_time_planes: f64 = 1e-4;
        /// Weight of the squared first differences (total variation) of the planes over space.
        plane_variation_weight: f64 = 0.0;
    }
}

/// A canonical cloud that six feature planes deform (Wu et al. 2024, "4DGaussians").
#[derive(Clone, Debug)]
pub(crate) struct HexplaneMethod {
    pub hexplane: HexplaneSettings,
}

/// Frames a time step of the planes: half of the frames where the original reads half of its time axis.
const FRAMES_PER_STEP: usize = 4;
/// Fewest time steps, for short clips.
const LEAST_STEPS: usize = 8;
/// Share of the Gaussians that may be outside the box on each side of an axis: strays must not coarsen the planes.
const OUTSIDE: f64 = 0.002;
/// The box is this much larger on every side than the cloud, of its longest side, because objects move.
const MARGIN: f64 = 0.1;
/// Smallest side of the box, of its longest: a flat cloud may still move out of its plane.
const FLATTEST: f64 = 0.1;
/// The coarse stage takes one of this many steps if the recipe leaves it open.
const COARSE_PART: usize = 10;

impl Method for HexplaneMethod {
    fn spec(&self, plan: &TrainContext) -> Spec {
        Spec::Hexplane(self.spec_of(plan))
    }

    fn one_time(&self, _plan: &TrainContext) -> bool {
        true
    }

    fn check(&self, plan: &TrainContext) -> Result<()> {
        self.planes(plan).check()
    }

    fn stages(&self, plan: &TrainContext) -> Vec<Stage> {
        let coarse = self.coarse_steps(plan.iterations).min(plan.iterations);
        let mut stages = Vec::new();
        if coarse > 0 {
            let mut stage = self.whole(plan, self.hexplane.multires.len()).part(0, coarse);
            stage.name = "coarse".into();
            stage.groups.retain(|g| !g.column.starts_with("hexplane."));
            stage.params.retain(|l| l.name() != SmoothPlanes::NAME);
            stage.phase = Some(Phase { rests: true, levels: None });
            stages.push(stage);
        }
        let ends = self.unlocks(plan.iterations, coarse);
        for (i, end) in ends.windows(2).enumerate() {
            let all = self.hexplane.multires.len();
            let levels = if ends.len() > 2 { all.min(i + 1) } else { all };
            let mut stage = self.whole(plan, levels).part(end[0], end[1]);
            stage.name = if ends.len() > 2 { format!("fine {}", i + 1) } else { "fine".into() };
            stage.phase = Some(Phase { rests: false, levels: Some(levels) });
            stage.start = (i == 0).then(place_box);
            stages.push(stage);
        }
        stages
    }
}

impl HexplaneMethod {
    fn planes(&self, plan: &TrainContext) -> PlaneShape {
        let time_resolution = match self.hexplane.time_resolution {
            0 => plan.times.div_ceil(FRAMES_PER_STEP).max(LEAST_STEPS),
            n => n,
        };
        PlaneShape {
            channels: self.hexplane.plane_channels,
            resolution: self.hexplane.plane_resolution,
            time_resolution,
            multires: self.hexplane.multires.clone(),
        }
    }

    fn spec_of(&self, plan: &TrainContext) -> HexplaneSpec {
        HexplaneSpec {
            seed: plan.seed,
            low: [-plan.extent; 3],
            high: [plan.extent; 3],
            clip: plan.clip,
            planes: self.planes(plan),
            net_width: self.hexplane.net_width,
            defor_depth: self.hexplane.defor_depth,
            heads: Heads {
                position: !self.hexplane.no_dx,
                scale: !self.hexplane.no_ds,
                rotation: !self.hexplane.no_dr,
                opacity: !self.hexplane.no_do,
                sh: !self.hexplane.no_dshs,
            },
            ..HexplaneSpec::default()
        }
    }

    /// Steps of the coarse stage.
    fn coarse_steps(&self, iterations: usize) -> usize {
        if self.hexplane.coarse_iterations == 0 { iterations / COARSE_PART } else { self.hexplane.coarse_iterations }
    }

    /// First steps of the fine stages, and the end.
    fn unlocks(&self, iterations: usize, coarse: usize) -> Vec<usize> {
        let mut ends = vec![coarse];
        if self.hexplane.unlock_interval > 0 {
            let more = (1..self.hexplane.multires.len()).map(|k| coarse + k * self.hexplane.unlock_interval);
            ends.extend(more.filter(|&step| step < iterations));
        }
        if coarse < iterations {
            ends.push(iterations);
        }
        ends
    }

    /// Everything in one stage, with this many levels; the others are parts of it.
    fn whole(&self, plan: &TrainContext, levels: usize) -> Stage {
        let c = &plan.common;
        let mut stage = still::stage("hexplane", plan);
        still::learn_life(&mut stage, plan, self.life(plan));
        let spec = self.spec_of(plan);
        let grids = Rate { start: self.hexplane.grid_lr_init, end: self.hexplane.grid_lr_final };
        for level in 0..spec.planes.multires.len() {
            for plane in 0..6 {
                stage.groups.push(Group::new(&PlaneShape::name(level, plane), grids));
            }
        }
        let networks = Rate { start: self.hexplane.deformation_lr_init, end: self.hexplane.deformation_lr_final };
        // The names follow from the spec; an empty layer is quickly made.
        let mut empty =
            splat4d::scene::Params::<f32>::new(0, (c.appearance.sh_degree + 1) * (c.appearance.sh_degree + 1), &[]);
        if let Ok(model) = Hexplane::new(spec.clone(), &mut empty) {
            stage.groups.extend(model.network_columns().iter().map(|name| Group::new(name, networks)));
        }
        let weights = PlaneWeights {
            smoothness: self.hexplane.plane_tv_weight,
            time_smoothness: self.hexplane.time_smoothness_weight,
            l1_time: self.hexplane.l1_time_planes,
            variation: self.hexplane.plane_variation_weight,
        };
        if weights.any() {
            stage.params.push(Box::new(SmoothPlanes::new(spec.planes, levels, weights)));
        }
        stage
    }
}

/// A hook that lays the box of every hexplane layer around its cloud.
fn place_box() -> Hook {
    Box::new(|scene: &mut Scene<f32>, _| {
        for layer in &mut scene.layers {
            let model: &dyn Any = layer.motion.as_ref();
            let (Some(model), Some(corners)) = (model.downcast_ref::<Hexplane>(), around(&layer.params[GEOMETRY]))
            else {
                continue;
            };
            let model = model.with_box(corners).map_err(|e: Error| e.at("the cloud after the coarse stage"))?;
            layer.motion = Arc::new(model);
        }
        Ok(())
    })
}

/// The box of (nearly) all means, with a margin; `None` if there is none or it has no size.
fn around<F: Real>(geometry: &Table<F>) -> Option<[[f64; 3]; 2]> {
    let mut out = [[0.0; 3]; 2];
    for axis in 0..3 {
        let mut x: Vec<f64> =
            (0..geometry.rows()).map(|row| geometry.get(row, axis).f64()).filter(|x| x.is_finite()).collect();
        x.sort_by(f64::total_cmp);
        let strays = (x.len() as f64 * OUTSIDE) as usize;
        (out[0][axis], out[1][axis]) = (*x.get(strays)?, *x.get(x.len() - 1 - strays)?);
    }
    let [low, high] = out;
    let longest = (0..3).map(|k| high[k] - low[k]).fold(0.0, f64::max);
    if longest <= 0.0 {
        return None;
    }
    for k in 0..3 {
        let wider = MARGIN * longest + 0.5 * (FLATTEST * longest - (high[k] - low[k])).max(0.0);
        out[0][k] -= wider;
        out[1][k] += wider;
    }
    Some(out)
}
