//! The recipe: every setting of a run, a table a subject. It is TOML on disk; the effective one is saved with the run,
//! and a run repeats bit for bit from it (on the same SIMD level).
//!
//! Tables are declared next to what they set (`settings!`); here they are only put together. Learning rates of
//! positions are in units of the scene's extent; everything with time in it is stated per clip length. Iteration
//! settings left at 0 follow from `run.iterations` (see [`Recipe::resolve`]). Names without a table (`max_cap` for
//! `densify.max_cap`), which recipes had before they had tables, are read as well.

mod chunks;
mod flat;
mod follow;
pub(crate) mod parts;
mod quality;
mod run;
#[cfg(test)]
mod tests;
mod text;

use crate::capture::CaptureSettings;
use crate::init::InitSettings;
use crate::loss::{LossSettings, TransportSettings};
use crate::maintenance::{DensifySettings, LEAST, RelocateSettings, operations};
use crate::methods::{AppearanceSettings, LifeSettings, RateSettings, methods, still};
use crate::settings::Table;
use crate::step::replans::ScheduleChanges;
use crate::train_state::RefineSettings;
pub use chunks::ChunkSettings;
pub use follow::FollowSettings;
pub use quality::Quality;
pub use run::{MotionName, RunSettings};

macro_rules! recipe {
    ($($table:ident: $settings:ty,)*) => {
        /// All settings of a run.
        #[derive(Clone, Debug, Default, PartialEq)]
        pub struct Recipe {
            $(#[doc = concat!("The table `[", stringify!($table), "]`.")] pub $table: $settings,)*
        }

        impl Recipe {
            fn tables(&self) -> Vec<(&'static str, &dyn Table)> {
                vec![$((stringify!($table), &self.$table)),*]
            }

            fn table_mut(&mut self, name: &str) -> Option<&mut dyn Table> {
                match name {
                    $(stringify!($table) => Some(&mut self.$table),)*
                    _ => None,
                }
            }
        }
    };
}

// The tables of motion models and of maintenance are listed where these are; here they get their place.
macro_rules! with_maintenance {
    ($($tables:tt)*) => { operations! { tables recipe { $($tables)* } { chunks: ChunkSettings, follow: FollowSettings, } } };
}

methods! { tables with_maintenance {
    run: RunSettings,
    capture: CaptureSettings,
    init: InitSettings,
    appearance: AppearanceSettings,
    rates: RateSettings,
    refine: RefineSettings,
    life: LifeSettings,
} {
    transport: TransportSettings,
    loss: LossSettings,
} }

impl Recipe {
    /// This recipe, changed.
    #[must_use]
    pub fn with(mut self, change: impl FnOnce(&mut Self)) -> Self {
        change(&mut self);
        self
    }

    /// The largest number of Gaussians, of the least that small captures have: what grows or shrinks with many
    /// Gaussians is divided by it. At least 1, and 1 for dynamic scenes, for which other values were not measured.
    pub(crate) fn crowd(&self) -> f64 {
        let many = self.run.motion == still::NAME && self.densify.max_cap > LEAST;
        if many { self.densify.max_cap as f64 / LEAST as f64 } else { 1.0 }
    }

    /// Lets schedules with the default for their length follow another length: what a run saved of them is set back,
    /// what was chosen otherwise stays.
    #[must_use]
    pub fn unresolved(&self) -> Self {
        let follows = Self {
            appearance: AppearanceSettings { sh_degree_interval: 0, ..self.appearance.clone() },
            densify: DensifySettings { interval: 0, from: 0, until: 0, ..self.densify.clone() },
            relocate: RelocateSettings { from: 0, ..self.relocate },
            run: RunSettings { checkpoint_interval: 0, ..self.run.clone() },
            ..self.clone()
        }
        .resolve();
        let mut r = self.clone();
        let back = |setting: &mut usize, follows: usize| {
            if *setting == follows {
                *setting = 0;
            }
        };
        back(&mut r.appearance.sh_degree_interval, follows.appearance.sh_degree_interval);
        back(&mut r.densify.interval, follows.densify.interval);
        back(&mut r.densify.from, follows.densify.from);
        back(&mut r.densify.until, follows.densify.until);
        back(&mut r.relocate.from, follows.relocate.from);
        back(&mut r.run.checkpoint_interval, follows.run.checkpoint_interval);
        r.run.replans = ScheduleChanges::default();
        r
    }

    /// Fills every setting that is 0 and follows from others, so that the saved recipe states all.
    #[must_use]
    pub fn resolve(&self) -> Self {
        let mut r = self.clone();
        let fill = |setting: &mut usize, value: usize| {
            if *setting == 0 {
                *setting = value.max(1);
            }
        };
        if r.spacetime.has_features() {
            r.appearance.sh_degree = 0;
        }
        r.densify.resolve();
        let iterations = r.run.iterations;
        fill(&mut r.appearance.sh_degree_interval, iterations / 10);
        fill(&mut r.densify.interval, (iterations / 60).max(50));
        fill(&mut r.densify.from, iterations / 20);
        fill(&mut r.densify.until, iterations * 3 / 4);
        fill(&mut r.relocate.from, iterations / 15);
        fill(&mut r.run.checkpoint_interval, (iterations / 10).max(50));
        r
    }
}
