//! Interface between a scene in training and a device that keeps its tables: [`Resident`].

use super::compare::{Comparison, Target};
use crate::Result;
use crate::math::Rng;
use crate::scene::{Camera, LifeKind, Time};

/// Tables of a layer that a device keeps, in this order: geometry, life, two of the motion's own (see [`Moves`]), SH.
pub const KEPT: usize = 5;

/// Motion of the rows of a layer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Moves {
    /// As [`Spacetime`](crate::motion::SpacetimeSpec) can, by its velocities and rotation rates; order 0 without
    /// rotation: not at all.
    Along {
        /// Order of the polynomial.
        order: usize,
        /// Whether quaternions have a rate.
        rotation: bool,
        /// Whether the lifespan's centre learns from opacity alone.
        detach: bool,
        /// Origin of time for Gaussians that have infinite lifespans, seconds.
        origin: f64,
    },
    /// Not at all: positions and quaternions are those of a tracked frame, in a table of their own.
    Posed,
    /// As slices of Gaussians of space and time ([`motion::native4d`](crate::motion::native4d)), whose further columns
    /// are a table.
    Sliced {
        /// κ, scene units per second.
        speed: f64,
        /// Least c, scene units².
        floor: f64,
        /// Largest log scale in time, log seconds.
        ceiling: f64,
        /// Blocks of spherical harmonics that change with time.
        harmonics: usize,
        /// The period of their colours, seconds.
        period: f64,
    },
}

impl Moves {
    /// Blocks of spherical harmonics in the layer's SH table.
    #[cfg(feature = "gpu")]
    pub(crate) fn blocks(&self) -> usize {
        if let Self::Sliced { harmonics, .. } = self { harmonics + 1 } else { 1 }
    }
}

/// A table on the CPU, as [`Table::data`](crate::scene::Table::data) stores it; empty where a layer has no such table.
#[derive(Clone, Copy, Debug, Default)]
pub struct ResidentTable<'a> {
    /// Columns.
    pub width: usize,
    /// Its numbers.
    pub params: &'a [f32],
    /// First and second moments and step counts, 2·width + 1 columns; empty where it has not learnt.
    pub moments: &'a [f32],
}

/// A layer on the CPU.
#[derive(Clone, Copy, Debug)]
pub struct ResidentLayer<'a> {
    /// Gaussians.
    pub rows: usize,
    /// Their motion.
    pub moves: Moves,
    /// Their lifespans.
    pub life: LifeKind,
    /// See [`KEPT`].
    pub tables: [ResidentTable<'a>; KEPT],
    /// Sum of |dL/dmean2d|, number of views that rendered it, largest radius: three columns.
    pub stats: &'a [f32],
    /// Ties of the poses of a [`Moves::Posed`] layer.
    pub ties: Option<&'a ResidentTies>,
}

/// The ties of a tracked frame's poses: rigidity, rotation and isometry along the edges of a graph, a floor below its
/// points, and a background that stays where the geometry's own poses are. Weights are those of a point's or an edge's
/// share in the loss.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ResidentTies {
    /// Rows of the graph's points.
    pub points: Vec<u32>,
    /// Rows of the background.
    pub background: Vec<u32>,
    /// Edges a point; one that leads to itself is none.
    pub neighbours: usize,
    /// The point that each edge leads to, its length at rest and its weight.
    pub edges: Vec<(u32, f32, f32)>,
    /// First of `back` by point, and one past the last.
    pub first: Vec<u32>,
    /// Edges that lead to a point.
    pub back: Vec<u32>,
    /// The points' poses in the frame before.
    pub before: Vec<[f32; 7]>,
    /// Neighbours keep their offsets, turned with each point.
    pub rigid: f64,
    /// Neighbours turn alike.
    pub rot: f64,
    /// Neighbours keep their distances.
    pub iso: f64,
    /// Points stay above the floor.
    pub floor: f64,
    /// Height of the floor along `up`.
    pub height: f64,
    /// Upwards.
    pub up: [f64; 3],
    /// The background stays in place, and keeps its turn.
    pub stays: [f64; 2],
}

/// Weights of losses on the geometry of the rows that are alive, each a mean over them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RowWeights {
    /// Of the opacity.
    pub opacity: f64,
    /// Of its entropy.
    pub entropy: f64,
    /// Of the mean of the three scales.
    pub scale: f64,
}

/// Noise on the positions of the rows that are alive, after Adam (3DGS as MCMC).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ResidentNoise {
    /// Times covariance times a standard normal vector times the gate.
    pub strength: f64,
    /// Opacity at which the gate is half open.
    pub dead: f64,
    /// Slope of the gate.
    pub slope: f64,
    /// Logit of the opacity above which there is none.
    pub limit: f32,
    /// Its stream, of which row r has fork r.
    pub rng: Rng,
}

/// The cameras' colour matrices, which learn with the tables.
#[derive(Clone, Copy, Debug)]
pub struct ResidentCameras<'a> {
    /// Cameras.
    pub count: usize,
    /// A table of twelve columns per camera: its matrix without the identity, row by row, then an offset per channel.
    pub table: ResidentTable<'a>,
    /// Those whose mean is held at the identity.
    pub held: &'a [usize],
}

/// Learning rule of one table.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ResidentRule {
    /// A rate a column; 0: frozen.
    pub rates: Vec<f64>,
    /// A column, and the least number in it.
    pub floor: Option<(usize, f64)>,
}

/// One image of a step.
#[derive(Clone, Copy, Debug)]
pub struct ResidentView<'a> {
    /// From where.
    pub camera: &'a Camera,
    /// When.
    pub t: Time,
    /// Colour behind the scene.
    pub background: [f32; 3],
    /// Its comparison; a response depends on the camera's number alone.
    pub target: Target<'a>,
    /// Number of the camera, where their colour matrices are kept.
    pub rig: usize,
}

/// All that a step is of.
#[derive(Clone, Copy, Debug)]
pub struct ResidentStep<'a> {
    /// Images, one after the other.
    pub views: &'a [ResidentView<'a>],
    /// Highest degree of spherical harmonics.
    pub sh_degree: usize,
    /// Opacity times life from which on a row is alive.
    pub alpha_min: f64,
    /// By layer and table; none: it rests.
    pub rules: &'a [[Option<ResidentRule>; KEPT]],
    /// Losses on rows.
    pub rows: RowWeights,
    /// By layer.
    pub noise: &'a [Option<ResidentNoise>],
    /// Rate of the cameras' colour matrices; 0: they rest.
    pub cameras: f64,
}

/// The result of a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ResidentStepped {
    /// By view.
    pub comparisons: Vec<Comparison>,
    /// Losses on rows and ties of poses.
    pub loss: f64,
    /// Layer, table and row of a number that is not finite; nothing kept is to be trusted then.
    pub bad: Option<[usize; 3]>,
}

/// The numbers of a layer, as in [`ResidentLayer`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ResidentNumbers {
    /// Of the tables.
    pub params: [Vec<f32>; KEPT],
    /// Of their moments.
    pub moments: [Vec<f32>; KEPT],
    /// Of the statistics.
    pub stats: Vec<f32>,
}

/// Keeps a scene's tables and takes steps on them: evaluate, render, compare, backward, Adam.
///
/// Steps are asynchronous: several may be in flight, and their results are returned in order. The results do not depend
/// on the time of reading.
pub trait Resident {
    /// Takes over all layers, in place of whatever was kept; steps in flight are forgotten. `corrections`: Adam's 1/(1
    /// − β₁ⁿ) and 1/(1 − β₂ⁿ) by step count n, the last for all that follow.
    ///
    /// Errors: they are too large for the device, or it failed.
    fn keep(
        &mut self,
        layers: &[ResidentLayer<'_>],
        cameras: Option<&ResidentCameras<'_>>,
        corrections: &[[f32; 2]],
    ) -> Result<()>;

    /// Begins a step. Returns the results of steps that are done; `None`: an image is too large to be compared in one
    /// buffer, no pixel of it counts, or a truth is left out that is not kept, and nothing was begun.
    ///
    /// Errors: the device failed, and nothing kept is to be trusted. Panics: nothing is kept.
    fn step(&mut self, step: &ResidentStep<'_>) -> Result<Option<Vec<ResidentStepped>>>;

    /// Whether it keeps this truth ([`Target::picture`]) in this size (width, height), with or without weights of pixels. A
    /// step then needs only the shape of [`Target::truth`] and of [`Target::weight`], whose data may be empty.
    fn holds(&mut self, _picture: usize, _size: [usize; 2], _weighted: bool) -> bool {
        false
    }

    /// The results of all steps that were begun, and not reported yet. Errors: as of `step`.
    fn finish(&mut self) -> Result<Vec<ResidentStepped>>;

    /// Milliseconds of the stages of the last view that is done, by the device's own clock; 0 where it has none.
    fn stages(&self) -> Vec<(&'static str, f64)> {
        Vec::new()
    }

    /// The numbers of a layer, with no step in flight. Errors: the device failed. Panics: as of `step`.
    fn fetch(&mut self, layer: usize) -> Result<ResidentNumbers>;

    /// The cameras' colour matrices and their moments, in the same way; empty where none are kept. Errors: as of
    /// `fetch`.
    fn fetch_cameras(&mut self) -> Result<[Vec<f32>; 2]>;
}
