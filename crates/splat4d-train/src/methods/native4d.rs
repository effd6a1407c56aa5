//! `native4d`: one stage; both quaternions, scales and times learn next to geometry and colour.
//!
//! Rates follow those of `spacetime`, since the two are charts of the same Gaussians: a step of both quaternions
//! changes the velocity by twice its size in extents a clip, which is the unit of the rotation (`Native4dSpec::speed`).

use super::{Group, InitialMotion, Method, Rate, Stage, TrainContext, still};
use crate::loss::scene::LivingOpacity;
use crate::settings::{Choice, settings};
use crate::{Error, Result};
use splat4d::motion::Spec;
use splat4d::motion::native4d::{MAX_HARMONICS, Native4dSpec, TABLE, set_velocity};
use splat4d::scene::{LifeKind, Params};

/// Scales in time count up to this many clips: a Gaussian is then as good as immortal (0.5 % fainter at the clip's
/// ends).
const LONGEST_CLIPS: f64 = 10.0;

settings! {
    /// Settings of `native4d`.
    pub struct Native4dSettings
    when (Is("run.motion", &["native4d"])) {
        /// Rate at the start of the two quaternions of the rotation: together they rotate space, their difference is
        /// the velocity (1 is two extents per clip).
        rotation_lr_init: f64 = 2.5e-3 => positive();
        /// The same at the end.
        rotation_lr_final: f64 = 2.5e-4 => positive();
        /// Blocks of spherical harmonics that change with time as cos(2πn(centre − t)/clip), 0 to 2.
        harmonics: usize = 0 => within(0, MAX_HARMONICS);
        /// Whether the parts of a split are also separated in time, with shorter lifespans.
        split_time: bool = true;
    }
}

/// Gaussians of space and time, sliced at t (Yang et al. 2024, "Real-time 4DGS").
#[derive(Clone, Debug)]
pub(crate) struct Native4dMethod {
    pub native4d: Native4dSettings,
}

impl Method for Native4dMethod {
    fn spec(&self, plan: &TrainContext) -> Spec {
        let c = &plan.common;
        Spec::Native4d(Native4dSpec {
            speed: plan.extent / plan.seconds(),
            min_life: c.life.min_frames / plan.fps,
            max_life: (LONGEST_CLIPS * plan.seconds()).max(c.life.min_frames / plan.fps),
            harmonics: self.native4d.harmonics,
            period: plan.seconds(),
            split_time: self.native4d.split_time,
        })
    }

    /// The lifespan is in the model.
    fn life(&self, _plan: &TrainContext) -> LifeKind {
        LifeKind::Infinite
    }

    fn init(&self, plan: &TrainContext, beginnings: &[InitialMotion], params: &mut Params) {
        let Spec::Native4d(spec) = self.spec(plan) else { unreachable!("its own spec") };
        let key = params.find(TABLE).expect("the model has made its table");
        for (row, begin) in beginnings.iter().enumerate() {
            let (center, width) = begin.life;
            params[key].write(row, 0, [center as f32, width.ln() as f32]);
            if begin.velocity != [0.0; 3] {
                set_velocity(&spec, params, row, begin.velocity);
            }
        }
    }

    fn check(&self, plan: &TrainContext) -> Result<()> {
        if matches!(plan.common.life.kind, None | Some(LifeKind::Infinite)) {
            return Ok(());
        }
        Err(Error::input(format!(
            "native4d has its own lifespans and accepts no life=\"{}\"",
            plan.common.life.kind.word()
        ))
        .remedy("Leave life at auto, or train spacetime with it"))
    }

    fn stages(&self, plan: &TrainContext) -> Vec<Stage> {
        let c = &plan.common;
        let mut stage = still::stage("native4d", plan);
        let turning = Rate { start: self.native4d.rotation_lr_init, end: self.native4d.rotation_lr_final };
        stage.groups.iter_mut().filter(|g| g.column == "quats").for_each(|g| g.rate = turning);
        stage.groups.push(Group::new("right_quats", turning));
        stage.groups.push(Group::new("time_means", c.rates.falling(c.life.center_lr * plan.seconds())));
        stage.groups.push(Group::new("log_time_scales", c.rates.falling(c.life.width_lr)));
        if self.native4d.harmonics > 0 {
            let block = 3 * (c.appearance.sh_degree + 1) * (c.appearance.sh_degree + 1);
            let rate = c.rates.falling(c.rates.feature / still::SH_REST_SLOWDOWN);
            stage.groups.push(Group { part: Some((block, block * self.native4d.harmonics)), ..Group::new("sh", rate) });
        }
        if c.loss.opacity_life > 0.0 {
            stage.params.push(Box::new(LivingOpacity { weight: c.loss.opacity_life }));
        }
        vec![stage]
    }
}
