//! Settings that every motion model is trained with.

use super::{AppearanceSettings, LifeSettings, RateSettings};
use crate::loss::LossSettings;
use crate::upkeep::{
    Adc, AdcSettings, DensifySettings, FloaterSettings, Floaters, Mcmc, McmcSettings, Merge, MergeSettings,
    MortonOrder, OpacityReset, OpacityResetSettings, Prune, PruneSettings, Relocate, RelocateSettings, SplitSettings,
    Upkeep,
};

/// The tables of settings that every motion model is trained with, resolved; [`still::stage`](super::still::stage) makes a
/// stage of them. What one model alone needs is its method's own.
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
    /// Density control.
    pub densify: DensifySettings,
    /// Adaptive density control.
    pub adc: AdcSettings,
    /// Opacity reset.
    pub opacity_reset: OpacityResetSettings,
    /// Markov chain Monte Carlo.
    pub mcmc: McmcSettings,
    /// Relocation.
    pub relocate: RelocateSettings,
    /// Removal of floaters.
    pub floaters: FloaterSettings,
    /// Pruning.
    pub prune: PruneSettings,
    /// Merging.
    pub merge: MergeSettings,
    /// The split into a static and a dynamic layer.
    pub split: SplitSettings,
}

impl CommonSettings {
    /// The maintenance operations that these settings switch on.
    pub(crate) fn upkeep(&self) -> Vec<Box<dyn Upkeep>> {
        let all = [
            boxed(Adc::of(self.adc, &self.densify)),
            boxed(Mcmc::of(self.mcmc, self.relocate.gradient_share, &self.densify)),
            boxed(MortonOrder::of(&self.densify)),
            boxed(Relocate::of(self.relocate, &self.densify)),
            boxed(Floaters::of(self.floaters, &self.densify)),
            boxed(Prune::of(self.prune)),
            boxed(Merge::of(self.merge)),
            boxed(OpacityReset::of(self.opacity_reset, &self.densify)),
        ];
        all.into_iter().flatten().collect()
    }
}

fn boxed(operation: Option<impl Upkeep + 'static>) -> Option<Box<dyn Upkeep>> {
    operation.map(|o| Box::new(o) as Box<dyn Upkeep>)
}
