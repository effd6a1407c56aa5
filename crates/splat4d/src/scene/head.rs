//! The feature head: a tiny network that turns nine blended channels of a pixel into its colour.
//!
//! This file defines its weights and their shapes; its function and rendering are in `render/head.rs`.
//! Source: Li et al. 2024 (Spacetime Gaussians) §4.1 and its released code.

use super::{Key, Params};
use crate::Result;
use crate::math::{Real, Rng};

/// Channels that a splat with features has: base colour 3, view features 3, time features 3.
pub(crate) const FEATURES: usize = BASE + FURTHER;
/// Those of them that are the base colour.
pub(crate) const BASE: usize = 3;
/// Those of them that are blended next to the base colour.
pub const FURTHER: usize = 6;
/// Inputs of the network per pixel: its further channels, its ray's origin and direction.
pub const INPUTS: usize = FURTHER + 6;
/// Width of the network's hidden layer.
pub(crate) const HIDDEN: usize = 6;
/// Name of the table of W₁, `HIDDEN` x [`INPUTS`], row-major, one column.
pub const HEAD_IN: &str = "head.in";
/// Name of the table of W₂, 3 x `HIDDEN`, row-major, one column.
pub const HEAD_OUT: &str = "head.out";

/// Location of a head's weights: two `Fixed` tables in the parameters of a layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HeadKeys {
    /// W₁
    pub first: Key,
    /// W₂
    pub second: Key,
}

impl HeadKeys {
    /// Makes the weights, or claims the loaded ones: W₁ uniform within ±√(6/[`INPUTS`]) (He et al. 2015), W₂ zero, so
    /// that the head starts as the identity. Errors: loaded arrays of the wrong shape.
    pub(crate) fn new<F: Real>(seed: u64, p: &mut Params<F>) -> Result<Self> {
        let bound = (6.0 / INPUTS as f64).sqrt();
        let rng = Rng::new(seed, HEAD_IN, 0);
        let first = p.array(HEAD_IN, HIDDEN * INPUTS, |w| {
            w.iter_mut().enumerate().for_each(|(i, w)| *w = F::of(bound * (2.0 * rng.uniform(i as u64) - 1.0)));
        })?;
        let second = p.array(HEAD_OUT, 3 * HIDDEN, |_| {})?;
        Ok(Self { first, second })
    }

    /// Those of a layer that has some.
    pub fn of<F: Real>(p: &Params<F>) -> Option<Self> {
        Some(Self { first: p.find(HEAD_IN)?, second: p.find(HEAD_OUT)? })
    }

    /// The weights themselves.
    pub(crate) fn weights<F: Real>(self, p: &Params<F>) -> HeadWeights<'_, F> {
        HeadWeights { first: p[self.first].data(), second: p[self.second].data() }
    }
}

/// The weights of a head, borrowed from a layer's parameters.
#[derive(Clone, Copy, Debug)]
pub struct HeadWeights<'a, F = f32> {
    /// W₁: entry [h, i] is number h·[`INPUTS`] + i. Longer where a table rounds its rows up; the rest means nothing.
    pub first: &'a [F],
    /// W₂: entry [c, h] is number c·`HIDDEN` + h. Longer likewise.
    pub second: &'a [F],
}

/// Gradients to the weights of a head, in the same order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HeadGrads<F = f32> {
    /// To W₁, `HIDDEN`·[`INPUTS`] numbers.
    pub first: Vec<F>,
    /// To W₂, 3·`HIDDEN` numbers.
    pub second: Vec<F>,
}
