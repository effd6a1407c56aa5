//! Maintenance of a learner between steps: Gaussians are added, moved, merged and removed, control nodes follow,
//! opacities are lowered, rows are sorted.
//!
//! A stage has a list of [`Maintenance`] operations; after every step those that are due run, in the order of
//! [`RunOrder`]. An operation changes rows only through [`TrainState::apply`], so it works for every motion model, and
//! losses are notified. A new one is a file here and its entries in `operations!`: its table of settings, and how it is
//! made of it.

/// The list of operations. The recipe, and the settings that every motion model is trained with, get their tables from
/// it.
macro_rules! operations {
    // Tables of settings, between those before and after in the recipe.
    (tables $then:ident { $($before:tt)* } { $($after:tt)* }) => {
        $then! {
            $($before)*
            densify: $crate::maintenance::DensifySettings,
            adc: $crate::maintenance::AdcSettings,
            opacity_reset: $crate::maintenance::OpacityResetSettings,
            mcmc: $crate::maintenance::McmcSettings,
            relocate: $crate::maintenance::RelocateSettings,
            guided: $crate::maintenance::GuidedSettings,
            floaters: $crate::maintenance::FloaterSettings,
            prune: $crate::maintenance::PruneSettings,
            merge: $crate::maintenance::MergeSettings,
            split: $crate::maintenance::SplitSettings,
            $($after)*
        }
    };
    // Those that the tables of `$of` switch on and every stage has, in the order in which a stage gets them.
    (made $of:expr) => {{
        use $crate::maintenance::*;
        let c = $of;
        [
            boxed(Adc::of(c.adc, &c.densify)),
            boxed(Mcmc::of(c.mcmc, c.relocate.gradient_share, &c.densify)),
            boxed(MortonOrder::of(&c.densify)),
            boxed(Relocate::of(c.relocate, &c.densify)),
            boxed(Floaters::of(c.floaters, &c.densify)),
            boxed(Prune::of(c.prune)),
            boxed(Merge::of(c.merge)),
            boxed(OpacityReset::of(c.opacity_reset, &c.densify)),
        ]
    }};
}
pub(crate) use operations;

pub(crate) mod adc;
pub(crate) mod densify;
pub(crate) mod floaters;
pub(crate) mod guided;
pub mod importance;
pub(crate) mod mcmc;
pub(crate) mod merge;
pub(crate) mod morton;
pub(crate) mod nodes;
pub(crate) mod once;
pub(crate) mod opacity_reset;
pub(crate) mod prune;
pub(crate) mod relocate;
pub(crate) mod split;
#[cfg(test)]
pub(crate) mod tests;

pub(crate) use adc::{Adc, AdcSettings, DENSE, FINEST};
pub(crate) use densify::LEAST;
pub use densify::{DensifySettings, Strategy};
pub(crate) use floaters::{FloaterSettings, Floaters};
pub(crate) use guided::{Guided, GuidedSettings};
pub(crate) use mcmc::{Mcmc, McmcSettings};
pub(crate) use merge::{Merge, MergeSettings};
pub(crate) use morton::MortonOrder;
pub(crate) use nodes::{AdaptNodes, NodeSettings};
pub(crate) use once::Once;
pub(crate) use opacity_reset::{OpacityReset, OpacityResetSettings};
pub(crate) use prune::{Prune, PruneSettings};
pub(crate) use relocate::{Relocate, RelocateSettings};
pub(crate) use split::{Split, SplitSettings};

use crate::Result;
use crate::capture::frames::Frames;
use crate::train_state::TrainState;
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::{self, Real, Rng, sym3};
use splat4d::render::Antialias;
use splat4d::scene::params::{OPACITY, QUAT};
use splat4d::scene::splats::COV;
use splat4d::scene::{GEOMETRY, Rows, Space, Time};

/// An operation that a stage can have, where its settings switch it on.
pub(crate) fn boxed(operation: Option<impl Maintenance + 'static>) -> Option<Box<dyn Maintenance>> {
    operation.map(|o| Box::new(o) as Box<dyn Maintenance>)
}

/// Limits that hold for every operation of a run.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Never more Gaussians than this in all layers together.
    pub cap: usize,
    /// The scene's extent, scene units.
    pub extent: f64,
    /// Opacity below which a Gaussian is dead.
    pub min_opacity: f64,
}

/// A place in a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct At {
    /// Steps of the stage that are done.
    pub step: usize,
    /// Steps of the stage in all.
    pub steps: usize,
}

/// Steps of a stage at which something is done: the multiples of `interval` from `first` to `last`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Every {
    /// Not before this step.
    pub first: usize,
    /// Not after this step.
    pub last: usize,
    /// Steps between two times; 0: never.
    pub interval: usize,
}

impl Every {
    /// At no step.
    pub(crate) const NEVER: Self = Self { first: 0, last: 0, interval: 0 };

    /// Whether it is time after this many steps.
    pub(crate) fn is_due(&self, step: usize) -> bool {
        self.interval > 0 && step >= self.first && step <= self.last && step.is_multiple_of(self.interval)
    }

    /// Whether it is time, and for the last time.
    pub(crate) fn is_last(&self, step: usize) -> bool {
        self.is_due(step) && step + self.interval > self.last
    }

    /// The same as the steps `from..to` of the stage see it, counted from `from`.
    #[must_use]
    pub(crate) fn part(self, from: usize, to: usize) -> Self {
        Self { first: self.first.saturating_sub(from).max(1), last: self.last.min(to).saturating_sub(from), ..self }
    }
}

/// Numbers of added and removed rows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Change {
    /// New rows.
    pub added: usize,
    /// Rows moved onto another.
    pub moved: usize,
    /// Rows removed.
    pub removed: usize,
}

impl std::ops::AddAssign for Change {
    fn add_assign(&mut self, other: Self) {
        self.added += other.added;
        self.moved += other.moved;
        self.removed += other.removed;
    }
}

/// Inputs of an operation next to the learner.
#[derive(Clone, Copy)]
pub struct Context<'a> {
    /// Position in the stage.
    pub at: At,
    /// Steps of the run that were done before this one: it addresses the random numbers.
    pub iteration: usize,
    /// Seed of the run.
    pub seed: u64,
    /// Cap, extent and dead opacity.
    pub limits: Limits,
    /// The frames that the scene is compared with.
    pub frames: &'a dyn Frames,
    /// As the scene is rendered.
    pub antialias: Antialias,
    /// Whether a column group of a layer learns in this stage.
    pub learns: &'a dyn Fn(usize, &str) -> bool,
}

impl Context<'_> {
    /// The random numbers of this step for a purpose.
    pub fn rng(&self, purpose: &str) -> Rng {
        Rng::new(self.seed, purpose, self.iteration as u64)
    }
}

/// The order in which operations of one step run, whatever the order in which they were added; those of one place run
/// in that one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RunOrder {
    /// Nodes, while statistics of the Gaussians that follow them are still there.
    Nodes,
    /// Gaussians are put where images need them; before densification, which begins the statistics again.
    Place,
    /// The cloud grows.
    Grow,
    /// Rows are put in order.
    Sort,
    /// Removal of what has little importance.
    Remove,
    /// Merging of what is in one place.
    Merge,
    /// Numbers are set back.
    Reset,
    /// All else.
    Last,
}

/// Something that is done to a learner between steps.
///
/// `run` takes `&mut self`: an operation's state between calls is its own, and is saved in checkpoints by
/// [`state`](Self::state).
pub trait Maintenance: Send + Sync {
    /// Its name, which is its own among the operations of a stage that remember anything: checkpoints use it.
    fn name(&self) -> &str;

    /// When it runs among those that are due at one step.
    fn order(&self) -> RunOrder {
        RunOrder::Last
    }

    /// Whether it is to run after this many steps of the stage; see [`once`](Self::once) for the time before the first
    /// one.
    fn due(&self, at: &At) -> bool;

    /// Does it.
    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change>;

    /// Whether it is done once in a stage, perhaps before the first step (`at.step` is 0 then). After a resume at that
    /// very step it runs again, and must then change nothing.
    fn once(&self) -> bool {
        false
    }

    /// The schedule of densification, where it follows that one: it continues over the parts of a stage that is
    /// divided. All other operations state their steps in the stage's own.
    fn densification(&mut self) -> Option<&mut Every> {
        None
    }

    /// About how many Gaussians there are after a place in the stage, of `count` and at most `cap`: what an estimate of
    /// time passes.
    fn grown(&self, _at: &At, count: f64, _cap: f64) -> f64 {
        count
    }

    /// Whether it belongs into a stage that only tunes a trained scene: it keeps up what the model needs, and adds,
    /// moves and removes no Gaussian.
    fn in_tuning(&self) -> bool {
        false
    }

    /// The state for a checkpoint, if it keeps any.
    fn state(&self) -> Vec<u32> {
        Vec::new()
    }

    /// Restores the result of [`state`](Self::state); empty from a checkpoint without the operation.
    fn restore(&mut self, _state: &[u32]) {}
}

/// Lets every layer grow under the one cap: `layer` gets a layer's number, how many rows it may add (to be lowered by
/// those it adds) and its random numbers. Statistics begin again.
fn grow(
    train_state: &mut TrainState,
    c: &Context<'_>,
    layer: impl Fn(&mut TrainState, usize, &mut usize, Rng) -> Change,
) -> Change {
    let mut change = Change::default();
    let mut spare = c.limits.cap.saturating_sub(train_state.scene().len());
    let learning = train_state.learning();
    let mut rest: usize = learning.iter().map(|&l| train_state.scene().layers[l].params.len()).sum();
    for index in learning {
        // What is left of the cap is shared by size, so that the first layer does not starve the others; what a
        // layer does not use goes to the next.
        let rows = train_state.scene().layers[index].params.len();
        let mut room = (spare * rows).div_ceil(rest.max(1));
        (spare, rest) = (spare - room, rest - rows);
        change += layer(train_state, index, &mut room, c.rng("densify").fork(index as u64));
        spare += room;
    }
    train_state.clear_stats();
    change
}

/// Activated covariances [N, 6] of a layer's Gaussians at the clip's centre, whatever model made them.
fn covariances(scene: &Scene<f32>, layer: usize) -> Vec<[f64; 6]> {
    let l = &scene.layers[layer];
    let center = Time(0.5 * (scene.clip[0] + scene.clip[1]));
    let seen = Evaluation::of_layer(l, Space::Gaussians, Rows::All, center);
    (0..l.params.len()).map(|r| seen.tape(0).out().read::<6>(r, COV).map(f64::from)).collect()
}

/// Opacity (activated, without life) of a row.
fn opacity(scene: &Scene<f32>, layer: usize, row: usize) -> f64 {
    f64::from(scene.layers[layer].params[GEOMETRY].get(row, OPACITY)).sigmoid()
}

/// The logit of an opacity, kept finite.
fn logit(o: f64) -> f32 {
    /// Just inside (0, 1): beyond it the logit's gradient is lost in f32.
    const MARGIN: f64 = 1e-6;
    math::logit(o, MARGIN) as f32
}

/// Whether nothing of the row can ever be seen, or would only do harm: dead opacity, a lifespan outside the clip, a row
/// that is not finite or a zero quaternion.
fn is_dead(scene: &Scene<f32>, layer: usize, row: usize, min_opacity: f64, span: [f64; 2]) -> bool {
    let g = scene.layers[layer].params[GEOMETRY].read::<11>(row, 0);
    let quat: f32 = (QUAT..QUAT + 4).map(|i| g[i] * g[i]).sum();
    opacity(scene, layer, row) <= min_opacity
        || span[1] < scene.clip[0]
        || span[0] > scene.clip[1]
        || !g.iter().all(|x| x.is_finite())
        || quat == 0.0
}

/// A point drawn from N(0, Σ).
fn sample(cov: [f64; 6], rng: Rng) -> [f64; 3] {
    let (values, vectors) = sym3::eigen(cov);
    let z: [f64; 3] = std::array::from_fn(|k| rng.normal(k as u64) * values[k].max(0.0).sqrt());
    std::array::from_fn(|r| vectors[r][0] * z[0] + vectors[r][1] * z[1] + vectors[r][2] * z[2])
}
