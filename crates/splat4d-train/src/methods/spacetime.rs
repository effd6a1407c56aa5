//! `spacetime`: one stage; velocities, lifespans, rotation rates and, if set in the recipe, features and their head
//! learn next to geometry and colour.

use super::auto::CaptureStats;
use super::still;
use super::{Group, InitialMotion, Method, Rate, Stage, TrainContext};
use crate::loss::scene::{LivingOpacity, VelocitySmoothness};
use crate::maintenance::Guided;
use crate::settings::{choices, settings};
use splat4d::motion::spacetime::{FeatureSpec, TIME_FEATURES, VELOCITIES, VIEW_FEATURES};
use splat4d::motion::{SpacetimeSpec, Spec};
use splat4d::scene::head::{HEAD_IN, HEAD_OUT};
use splat4d::scene::{LifeKind, Params};

/// Cameras at a time from which on a scene is seen from all sides at once.
const MANY_CAMERAS: f64 = 3.0;

choices! {
    /// Features of Gaussians next to their base colour.
    pub enum Features {
        /// None.
        None = "none",
        /// Those of STG's full model.
        Full = "full",
    }
}

settings! {
    /// Settings of `spacetime`.
    pub struct SpacetimeSettings
    when (Is("run.motion", &["spacetime"])) {
        /// Order of the motion polynomial, 0 to 3.
        order: usize = 1 => within(0, 3);
        /// Whether rotations change with time.
        rotation_rate: bool = false;
        /// The lifespan's centre learns from opacity only (STG).
        detach: bool = false => any().when(IsNot("life.kind", &["infinite"]));
        /// Rate of velocities at the start, extents per clip.
        velocity_lr_init: f64 = 0.01 => positive().unit("extents/clip").when(On("spacetime.order"));
        /// Rate of velocities at the end, extents per clip.
        velocity_lr_final: f64 = 5e-4 => positive().unit("extents/clip").when(On("spacetime.order"));
        /// Rate of quaternion rates, 1/clip.
        rotation_rate_lr: f64 = 1e-3 => any().unit("1/clip").when(On("spacetime.rotation_rate"));
        /// Features in addition to the base colour, which a small network turns into colour per pixel: none or full
        /// (the full model of STG; replaces spherical harmonics, sh_degree becomes 0). Playback files and
        /// exports have spherical harmonics in its place.
        features: Features = Features::None;
        /// Rate of view features (STG, 30,000 steps: 0.0025).
        view_features_lr: f64 = 0.01 => any().when(On("spacetime.features"));
        /// Rate of time features, 1/clip (STG: 0.001).
        time_features_lr: f64 = 0.02 => any().unit("1/clip").when(On("spacetime.features"));
        /// Rate of the network's weights (STG: 0.0001).
        head_lr: f64 = 3e-3 => any().when(On("spacetime.features"));
    }
}

impl SpacetimeSettings {
    /// Whether a network makes colour of features, in place of spherical harmonics.
    pub(crate) fn has_features(&self) -> bool {
        self.features == Features::Full
    }
}

/// Explicit kinematics (STG, FreeTimeGS).
#[derive(Clone, Debug)]
pub(crate) struct SpacetimeMethod {
    pub spacetime: SpacetimeSettings,
}

impl Method for SpacetimeMethod {
    fn spec(&self, plan: &TrainContext) -> Spec {
        Spec::Spacetime(SpacetimeSpec {
            order: self.spacetime.order,
            rotation: self.spacetime.rotation_rate,
            detach: self.spacetime.detach,
            origin: 0.5 * (plan.clip[0] + plan.clip[1]),
            features: (self.spacetime.has_features()).then_some(FeatureSpec { seed: plan.seed }),
        })
    }

    fn life(&self, plan: &TrainContext) -> LifeKind {
        plan.common.life.kind.unwrap_or(LifeKind::GaussHalf)
    }

    fn init(&self, _plan: &TrainContext, beginnings: &[InitialMotion], params: &mut Params) {
        let Some(key) = params.find(VELOCITIES) else { return };
        if params[key].width() > 0 {
            beginnings.iter().enumerate().for_each(|(row, b)| params[key].write(row, 0, b.velocity.map(|v| v as f32)));
        }
    }

    fn has_features(&self) -> bool {
        true
    }

    fn suits(&self, seen: &CaptureStats) -> Option<String> {
        if seen.depth && !seen.masks && !seen.predicted {
            let cameras = seen.cameras_in_words();
            return Some(format!(
                "{cameras} each frame, and depth maps give positions at that time, from which Gaussians start"
            ));
        }
        let moving =
            seen.changing.map_or_else(String::new, |share| format!(", {:.1} % of the pixels move", 100.0 * share));
        (seen.cameras >= MANY_CAMERAS).then(|| {
            let cameras = seen.cameras;
            format!("{cameras:.0} cameras record every frame{moving}: enough for explicit motion with lifespans")
        })
    }

    fn stages(&self, plan: &TrainContext) -> Vec<Stage> {
        let c = &plan.common;
        let clip = plan.seconds();
        // Velocities are there to compare (`VelocitySmoothness`), which costs no further time.
        let mut base = plan.clone();
        base.common.loss.velocity = 0.0;
        let mut stage = still::stage("spacetime", &base);
        // Rates of v_k are extents per clip^k: in seconds they shrink by clip^k.
        for k in 0..self.spacetime.order {
            let unit = plan.extent / clip.powi(k as i32 + 1);
            let rate =
                Rate { start: self.spacetime.velocity_lr_init * unit, end: self.spacetime.velocity_lr_final * unit };
            stage.groups.push(Group { part: Some((3 * k, 3)), ..Group::new("velocities", rate) });
        }
        if self.spacetime.rotation_rate {
            stage.groups.push(Group::new("rotation_rates", c.rates.falling(self.spacetime.rotation_rate_lr / clip)));
        }
        if self.spacetime.has_features() {
            stage.groups.push(Group::new(VIEW_FEATURES, c.rates.falling(self.spacetime.view_features_lr)));
            // Time features are per clip in the recipe, per second in the model.
            stage.groups.push(Group::new(TIME_FEATURES, c.rates.falling(self.spacetime.time_features_lr / clip)));
            stage.groups.push(Group::new(HEAD_IN, c.rates.falling(self.spacetime.head_lr)));
            stage.groups.push(Group::new(HEAD_OUT, c.rates.falling(self.spacetime.head_lr)));
        }
        if let Some(guided) = Guided::of(c.guided) {
            stage.keep(guided);
        }
        still::learn_life(&mut stage, plan, self.life(plan));
        if c.loss.opacity_life > 0.0 {
            stage.params.push(Box::new(LivingOpacity { weight: c.loss.opacity_life }));
        }
        if c.loss.velocity > 0.0 && self.spacetime.order > 0 {
            stage.params.push(Box::new(VelocitySmoothness::new(c.loss.velocity, clip / plan.extent)));
        }
        vec![stage]
    }
}
