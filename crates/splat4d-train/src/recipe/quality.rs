//! `--quality`: presets of steps, Gaussians and image size.

use super::Recipe;
use crate::{Error, Result};

/// A quality: steps, Gaussians and size of images at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quality {
    /// A quick check whether a capture works: images of half the size, few steps, half as many Gaussians.
    Draft,
    /// The default recipe.
    Standard,
    /// For long runs: many steps and Gaussians.
    Best,
}

/// Steps of a draft: at half the size of its images a kitchen has 31.2 dB after 2,500 steps where 7,000 have 31.0
/// (docs/suite.md).
const DRAFT_STEPS: usize = 2500;
/// Factor on the number of Gaussians of a draft.
const DRAFT_COUNT: f64 = 0.5;
/// Times that a draft's images are reduced, in addition to what the recipe does.
const DRAFT_DOWNSCALE: usize = 2;
/// Steps and the factor on the number of Gaussians of the best: basketball gains 1.5 dB by 20,000 and 60,000 over 8,000
/// and 30,000 (docs/benchmarks.md).
const BEST_STEPS: usize = 20_000;
/// See [`BEST_STEPS`].
const BEST_COUNT: f64 = 2.0;

impl Quality {
    /// All, from the fastest on.
    pub(crate) const ALL: [Self; 3] = [Self::Draft, Self::Standard, Self::Best];

    /// The word for it.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Draft => "draft",
            Self::Standard => "standard",
            Self::Best => "best",
        }
    }
}

impl std::str::FromStr for Quality {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let found = Self::ALL.into_iter().find(|q| q.name() == text);
        found.ok_or_else(|| {
            let names: Vec<&str> = Self::ALL.iter().map(|q| q.name()).collect();
            Error::input(format!("`{text}` is not a quality")).remedy(format!("Use one of: {}", names.join(", ")))
        })
    }
}

impl Recipe {
    /// This recipe with a quality's steps, number of Gaussians and image size. The number follows from the capture,
    /// whatever the recipe states. Schedules that followed from the length follow from the new one.
    #[must_use]
    pub fn of_quality(&self, quality: Quality) -> Self {
        let standard = Self::default();
        self.unresolved().with(|r| {
            r.densify.max_cap = standard.densify.max_cap;
            (r.run.iterations, r.densify.count_scale) = match quality {
                Quality::Draft => (DRAFT_STEPS, DRAFT_COUNT),
                Quality::Standard => (standard.run.iterations, standard.densify.count_scale),
                Quality::Best => (BEST_STEPS, BEST_COUNT),
            };
            if quality == Quality::Draft {
                r.capture.downscale *= DRAFT_DOWNSCALE;
            }
        })
    }
}
