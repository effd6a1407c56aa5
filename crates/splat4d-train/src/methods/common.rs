//! Settings that every motion model is trained with.

use super::Rate;
use crate::loss::LossSettings;
use crate::maintenance::{LEAST, Maintenance, operations};
use crate::settings::{Choice, settings};
use splat4d::scene::LifeKind;

settings! {
    /// Colour of Gaussians and of cameras' images.
    pub struct AppearanceSettings {
        /// Highest degree of the spherical harmonics, 0 to 3.
        sh_degree: usize = 2 => within(0, 3);
        /// Iterations before each further SH degree is unlocked; 0: iterations/10.
        sh_degree_interval: usize = 0 => any().unit("iterations").when(On("appearance.sh_degree"));
        /// Learn a colour matrix and an offset per camera, if there are several; their mean stays the identity.
        exposure: bool = true;
        /// The same for photos, each of which is a camera with its own automatic exposure. A held-out photo has the mean of the photos
        /// before and after it, as far as neighbours are alike.
        exposure_single: bool = true => any().when(On("appearance.exposure"));
        /// Rate of the exposure (Luiten et al., 10,000 steps: 1e-4).
        exposure_lr: f64 = 1e-3 => any().when(On("appearance.exposure"));
        /// Times at which the exposure of a camera that films is learned; it changes linearly between them. 1: it is constant.
        exposure_knots: usize = 1 => at_least(1).when(On("appearance.exposure"));
        /// Antialiased mode (opacity compensation).
        antialias: bool = false;
    }
}

settings! {
    /// Learning rates of parameters that all Gaussians have.
    pub struct RateSettings {
        /// Rate of positions at the start, share of the extent; 0: 0.001, and less in proportion if `densify.max_cap`
        /// is above 60,000.
        position_init: f64 = 0.0 => any().unit("extents");
        /// Rate of positions at the end, share of the extent; 0: 0.0001, and less in proportion if `densify.max_cap` is
        /// above 30,000.
        position_final: f64 = 0.0 => any().unit("extents");
        /// Share to which rates without a final value (colour, opacity, scale, rotation, lifespan) decay.
        decay: f64 = 1.0 => positive();
        // Colours, scales and rotations learn two to five times as fast as in Kerbl et al. 2023, whose runs have 30,000
        // steps; chosen on seven captures together with the fall at the end (studies/records/2026-11-27-rates.md).
        /// Share of the steps at the end over which all rates fall to a tenth; 0: they do not.
        settle: f64 = 0.15 => share();
        /// Rate of base colour; higher SH degrees learn 5 times more slowly.
        feature: f64 = 0.012 => positive();
        /// Rate of opacity logits.
        opacity: f64 = 0.1 => positive();
        /// Rate of log scales.
        scaling: f64 = 0.03 => positive();
        /// Rate of quaternions.
        rotation: f64 = 4e-3 => positive();
    }
}

/// Rates of positions at the start and at the end for up to [`LEAST`] Gaussians, of the extent. Kerbl et al. 2023 use 1.6e-4
/// and 1.6e-6 for runs of 30,000 steps; ours are several times shorter (studies/records/2026-11-27-optimiser.md).
const POSITIONS: [f64; 2] = [2e-3, 1e-4];
/// Highest rate at the start: twice as much loses 0.2 dB with few Gaussians.
const FASTEST: f64 = 1e-3;
/// Lowest share of them, with many Gaussians: the rate of Kerbl et al. 2023, who have some millions.
const FINEST: f64 = 0.08;

impl RateSettings {
    /// A rate that decays by the factor `decay` over the stage.
    pub(crate) fn falling(&self, rate: f64) -> Rate {
        Rate { start: rate, end: rate * self.decay }
    }

    /// Rates of positions at the start and at the end, of the extent. More Gaussians are smaller and lie closer, so that the steps
    /// of few would scatter them (studies/records/2026-11-26-real-size.md).
    pub(super) fn positions(&self, cap: usize) -> [f64; 2] {
        let share = (LEAST as f64 / cap.max(1) as f64).clamp(FINEST, 1.0);
        let [start, end] = POSITIONS.map(|rate| rate * if cap == 0 { 1.0 } else { share });
        let stated = |rate: f64, by_count: f64| if rate > 0.0 { rate } else { by_count };
        [stated(self.position_init, start.min(FASTEST)), stated(self.position_final, end)]
    }
}

settings! {
    /// The lifespan of a Gaussian (temporal opacity).
    pub struct LifeSettings
    when (Any(&[IsNot("run.motion", &["still", "tracked"]), Is("life.kind", &["gauss-half", "gauss-one", "interval"])])) {
        /// Kind of lifespan: auto (spacetime: gauss-half; control, ssm, deform-mlp and hexplane with fixed cameras:
        /// interval; else infinite), infinite, gauss-half, gauss-one, interval.
        kind: Option<LifeKind> = None => any().switch().when(IsNot("run.motion", &["still"]));
        /// Rate of lifespan centres, clips.
        center_lr: f64 = 1e-3 => any().unit("clips");
        /// Rate of log lifespan widths.
        width_lr: f64 = 0.04;
        /// Smallest lifespan width, frames.
        min_frames: f64 = 0.5 => any().unit("frames");
    }
}

/// `auto`, the first, is the motion model's own choice.
impl Choice for Option<LifeKind> {
    const NAMES: &'static [(&'static str, Self)] = &[
        ("auto", None),
        ("infinite", Some(LifeKind::Infinite)),
        ("gauss-half", Some(LifeKind::GaussHalf)),
        ("gauss-one", Some(LifeKind::GaussOne)),
        ("interval", Some(LifeKind::Interval)),
    ];
}

macro_rules! common_settings {
    ($($table:ident: $settings:ty,)*) => {
        /// The tables of settings that every motion model is trained with, resolved;
        /// [`still::stage`](super::still::stage) makes a stage of them. Settings of a single model belong to its
        /// method.
        #[derive(Clone, Debug, Default, PartialEq)]
        pub struct CommonSettings {
            /// Colours of Gaussians and cameras.
            pub appearance: AppearanceSettings,
            /// Learning rates.
            pub rates: RateSettings,
            /// Lifespans.
            pub life: LifeSettings,
            /// Weights of losses.
            pub loss: LossSettings,
            $(#[doc = concat!("Maintenance: the table `[", stringify!($table), "]`.")] pub $table: $settings,)*
        }
    };
}

operations! { tables common_settings {} {} }

impl CommonSettings {
    /// The maintenance operations that these settings switch on.
    pub(crate) fn maintenance(&self) -> Vec<Box<dyn Maintenance>> {
        operations!(made self).into_iter().flatten().collect()
    }
}
