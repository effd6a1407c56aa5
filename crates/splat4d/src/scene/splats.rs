//! [`Splats`]: the scene at one time, activated: the renderer's input.

use super::head::HeadWeights;
use super::rows::Rows;
use super::table::Table;
use crate::math::Real;

/// Columns of [`Part::out`].
pub const SPLAT_COLUMNS: [(&str, usize); 3] = [("mean", 3), ("cov", 6), ("opacity", 1)];
/// First column of the covariance (xx, xy, xz, yy, yz, zz) in [`Part::out`].
pub const COV: usize = 3;
/// Column of the opacity in [`Part::out`].
pub const SPLAT_OPACITY: usize = 9;

/// Source of a part's colour.
#[derive(Clone, Copy, Debug)]
pub enum Color<'a, F = f32> {
    /// Spherical harmonics, borrowed from the parameters: splat j has row `rows.id(j)`.
    Sh {
        /// [N, 3·K·blocks]; coefficient k of channel c is column 3k + c.
        table: &'a Table<F>,
        /// Which rows.
        rows: Rows<'a>,
        /// Optional weights [splats, blocks] of blocks of coefficients (time-dependent SH).
        weights: Option<&'a Table<F>>,
        /// Whether the table is the layer's own SH, whose gradient is added directly to `Grads`.
        base: bool,
    },
    /// One colour a splat.
    Direct {
        /// [splats, C]: red, green, blue, and where C is `FEATURES` the further channels that a head
        /// sees.
        table: &'a Table<F>,
    },
}

/// The splats of one layer at one time.
#[derive(Clone, Copy, Debug)]
pub struct Part<'a, F = f32> {
    /// [splats, 10]: world mean 3, world covariance 6, opacity 1 in (0,1), life and edits applied.
    pub out: &'a Table<F>,
    /// Colour.
    pub color: Color<'a, F>,
    /// Rotation (rows) that takes directions of the world to the axes of the spherical harmonics; none: they are the
    /// same.
    pub layer_from_world: Option<[[F; 3]; 3]>,
}

impl<'a, F: Real> Part<'a, F> {
    /// A part whose colours are in the axes of the world.
    pub fn new(out: &'a Table<F>, color: Color<'a, F>) -> Self {
        Self { out, color, layer_from_world: None }
    }
}

/// A scene at one time: a part a layer. Splats are numbered through all parts in order.
#[derive(Clone, Debug, Default)]
pub struct Splats<'a, F = f32> {
    /// One per layer.
    pub parts: Vec<Part<'a, F>>,
    /// Network from blended channels to colour; none: they are the colour. To it, parts without features have zeros.
    pub head: Option<HeadWeights<'a, F>>,
}

impl<F: Real> Splats<'_, F> {
    /// Splats in all parts.
    pub fn len(&self) -> usize {
        self.parts.iter().map(|p| p.out.rows()).sum()
    }

    /// Whether there is no splat.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Gradients to one [`Part`], in its own compact rows.
#[derive(Clone, Copy, Debug)]
pub struct SplatGrads<'a, F = f32> {
    /// [splats, 10]
    pub out: &'a Table<F>,
    /// Gradient to `Direct` colours or to SH that is not the layer's own, [splats, width].
    pub color: Option<&'a Table<F>>,
    /// Gradient to the SH block weights, [splats, blocks].
    pub weights: Option<&'a Table<F>>,
}
