//! The seam between a scene that learns and a device that keeps its tables: [`Resident`].

use super::{Comparison, Target};
use crate::Result;
use crate::scene::{Camera, LifeKind, Time};

/// Tables of a layer that a device keeps, in this order: geometry, life, velocities, rotation rates, SH.
pub const KEPT: usize = 5;

/// How the rows of a layer move, of what [`Spacetime`](crate::motion::SpacetimeSpec) can; order 0 without rotation: not at all.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Moves {
    /// Order of the polynomial.
    pub order: usize,
    /// Whether quaternions have a rate.
    pub rotation: bool,
    /// Whether the life's centre learns from opacity alone.
    pub detach: bool,
    /// Origin of time for Gaussians that live for ever, seconds.
    pub origin: f64,
}

/// A table on the CPU, as [`Table::data`](crate::scene::Table::data) has it; nothing where a layer has no such table.
#[derive(Clone, Copy, Debug, Default)]
pub struct KeptTable<'a> {
    /// Columns.
    pub width: usize,
    /// Its numbers.
    pub params: &'a [f32],
    /// First and second moments and step counts, 2·width + 1 columns.
    pub moments: &'a [f32],
}

/// A layer on the CPU.
#[derive(Clone, Copy, Debug)]
pub struct KeptLayer<'a> {
    /// Gaussians.
    pub rows: usize,
    /// How they move.
    pub moves: Moves,
    /// How they live.
    pub life: LifeKind,
    /// See [`KEPT`].
    pub tables: [KeptTable<'a>; KEPT],
    /// Sum of |dL/dmean2d|, number of views that drew it, largest radius: three columns.
    pub stats: &'a [f32],
}

/// What one table learns by.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct KeptRule {
    /// A rate a column; 0: frozen.
    pub rates: Vec<f64>,
    /// A column, and the least number in it.
    pub floor: Option<(usize, f64)>,
}

/// One picture of a step.
#[derive(Clone, Copy, Debug)]
pub struct KeptView<'a> {
    /// From where.
    pub camera: &'a Camera,
    /// When.
    pub t: Time,
    /// Colour behind the scene.
    pub background: [f32; 3],
    /// What it is compared with.
    pub target: Target<'a>,
}

/// All that a step is of.
#[derive(Clone, Copy, Debug)]
pub struct KeptStep<'a> {
    /// Pictures, one after the other.
    pub views: &'a [KeptView<'a>],
    /// Highest degree of spherical harmonics.
    pub sh_degree: usize,
    /// Opacity times life from which on a row is alive.
    pub alpha_min: f64,
    /// By layer and table; none: it rests.
    pub rules: &'a [[Option<KeptRule>; KEPT]],
}

/// The result of a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct KeptStepped {
    /// By view.
    pub comparisons: Vec<Comparison>,
    /// Layer, table and row of a number that is not finite; nothing kept is to be trusted then.
    pub bad: Option<[usize; 3]>,
}

/// The numbers of a layer, as [`KeptLayer`] has them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct KeptNumbers {
    /// Of the tables.
    pub params: [Vec<f32>; KEPT],
    /// Of their moments.
    pub moments: [Vec<f32>; KEPT],
    /// Of the statistics.
    pub stats: Vec<f32>,
}

/// Keeps a scene's tables and takes steps on them: evaluate, draw, compare, back, Adam.
pub trait Resident {
    /// Takes over all layers, in place of whatever was kept. `corrections`: Adam's 1/(1 − β₁ⁿ) and 1/(1 − β₂ⁿ) by step count n, the
    /// last for all that follow.
    ///
    /// Errors: they are too large for the device, or it failed.
    fn keep(&mut self, layers: &[KeptLayer<'_>], corrections: &[[f32; 2]]) -> Result<()>;

    /// One step. `None`: a picture must be drawn in bands, or no pixel of it counts; of what is kept only statistics were changed.
    ///
    /// Errors: the device failed, and nothing kept is to be trusted. Panics: nothing is kept.
    fn step(&mut self, step: &KeptStep<'_>) -> Result<Option<KeptStepped>>;

    /// The numbers of a layer as they are now. Errors: the device failed. Panics: as of `step`.
    fn fetch(&mut self, layer: usize) -> Result<KeptNumbers>;
}
