//! The settings of a run as a whole.

use crate::settings::{Value, among, settings};
use crate::step::replans::ScheduleChanges;
use splat4d::motion::MODELS;

settings! {
    /// The run: model, length, memory.
    pub struct RunSettings {
        /// Motion model: still, spacetime, deform-mlp, hexplane, tracked, native4d, control or ssm; auto: chosen by the
        /// capture.
        motion: MotionName = MotionName::of("spacetime");
        /// Seed of every random choice.
        seed: u64 = 0;
        /// Total training steps.
        iterations: usize = 7000 => at_least(1);
        /// Changes of the run's length, [step, total steps]: from that step on, the rest of the schedule of
        /// `iterations` steps is spread over the remaining steps. `--minutes` writes them.
        replans: ScheduleChanges = ScheduleChanges::default();
        /// Views per step.
        batch_size: usize = 1 => at_least(1);
        /// Share of the iterations, from the first, that use images at half size.
        half_size_until: f64 = 0.4 => share();
        /// Iterations between checkpoints; 0: iterations/10.
        checkpoint_interval: usize = 0 => any().unit("iterations");
        /// Bytes of decoded images in memory.
        image_memory: u64 = 1 << 30 => any().unit("bytes");
        /// Bytes of images that a GPU keeps; others are sent in every step. 0: 60 % of a graphics card's free memory, at
        /// least 1 GiB; 2 GiB where the GPU shares the CPU's memory.
        device_images: u64 = 0 => any().unit("bytes");
        /// Memory limit of training; 0: no limit. Checked before the start, then enforced by the cap.
        memory_limit: u64 = 0 => any().unit("bytes");
    }
}

/// The name of a motion model that trains by itself, or `auto`: chosen by what the capture is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MotionName(&'static str);

/// The word that leaves the choice to the capture.
const AUTO: &str = "auto";

impl MotionName {
    /// The choice that is left to the capture.
    pub const AUTO: Self = Self(AUTO);

    /// The model with this name, built-in or registered. Panics: there is none.
    pub fn of(name: &str) -> Self {
        Self::find(name).unwrap_or_else(|| panic!("there is no motion model `{name}`"))
    }

    /// Whether the capture has yet to choose.
    pub(crate) fn is_auto(self) -> bool {
        self.0 == AUTO
    }

    /// The name.
    pub fn as_str(self) -> &'static str {
        self.0
    }

    fn find(name: &str) -> Option<Self> {
        let built_in = Self::choices().into_iter().find(|known| *known == name);
        built_in.or_else(|| crate::methods::own::name(name)).map(Self)
    }
}

impl PartialEq<&str> for MotionName {
    fn eq(&self, name: &&str) -> bool {
        self.0 == *name
    }
}

impl std::fmt::Display for MotionName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.0)
    }
}

impl Value for MotionName {
    fn to_toml(&self) -> toml::Value {
        toml::Value::String(self.0.to_owned())
    }

    fn from_toml(value: &toml::Value) -> Result<Self, String> {
        value.as_str().and_then(Self::find).ok_or_else(|| among(value, &Self::choices()))
    }

    fn choices() -> Vec<&'static str> {
        std::iter::once(AUTO).chain(MODELS.iter().copied()).collect()
    }
}
