//! Densification: its strategy and its steps.

use super::Every;
use crate::settings::{choices, settings};

choices! {
    /// Strategy of density control.
    pub enum Strategy {
        /// Adaptive density control: clone, split, prune.
        Adc = "adc",
        /// Markov chain Monte Carlo: relocate, grow, noise.
        Mcmc = "mcmc",
        /// Not at all.
        None = "none",
    }
}

settings! {
    /// Density control: how Gaussians are added and removed.
    pub struct DensifySettings {
        /// Densification: adc, mcmc or none.
        strategy: Strategy = Strategy::Adc;
        /// Largest number of Gaussians; 0: from the pixels of all distinct views, the steps and the memory, at least
        /// 30,000.
        max_cap: usize = 0;
        /// Factor on the number of Gaussians that follows from the capture; without effect if `max_cap` is set.
        count_scale: f64 = 1.0 => positive();
        /// Iterations between densifications; 0: iterations/60, at least 50.
        interval: usize = 0
            => any().unit("iterations").when(Any(&[On("densify.strategy"), On("relocate.interval"), On("nodes.adapt_interval")]));
        /// First iteration that densifies; 0: iterations/20.
        from: usize = 0
            => any().unit("iterations").when(Any(&[On("densify.strategy"), On("relocate.interval"), On("nodes.adapt_interval")]));
        /// Last iteration that densifies; 0: 3/4 of iterations.
        until: usize = 0
            => any().unit("iterations").when(Any(&[On("densify.strategy"), On("relocate.interval"), On("nodes.adapt_interval")]));
        /// Opacity below which a Gaussian is removed; 0: 0.02 for adc, 0.005 for mcmc.
        min_opacity: f64 = 0.0 => share().when(On("densify.strategy"));
    }
}

/// Opacity below which MCMC relocates (Kheradmand et al. 2024).
const MCMC_DEAD_OPACITY: f64 = 0.005;
/// Opacity below which ADC prunes: four times the original's, +0.5 dB in a 1,500-step comparison on the bundled
/// capture.
const ADC_DEAD_OPACITY: f64 = 0.02;

/// Gaussians that small captures are tuned for (docs/suite.md); what a capture's own number never falls below, and what
/// applies without a capture.
pub(crate) const LEAST: usize = 30_000;

impl DensifySettings {
    /// Fills what follows from the strategy, and the number of Gaussians if no capture has set it.
    pub(crate) fn resolve(&mut self) {
        if self.max_cap == 0 {
            self.max_cap = ((self.count_scale * LEAST as f64) as usize).max(1);
        }
        if self.min_opacity == 0.0 {
            self.min_opacity = if self.strategy == Strategy::Mcmc { MCMC_DEAD_OPACITY } else { ADC_DEAD_OPACITY };
        }
    }

    /// Whether Gaussians are added by Markov chain Monte Carlo.
    pub(crate) fn is_mcmc(&self) -> bool {
        self.strategy == Strategy::Mcmc
    }

    /// The steps at which Gaussians are added and removed.
    pub(crate) fn steps(&self) -> Every {
        Every { first: self.from, last: self.until, interval: self.interval }
    }
}
