//! `control`: Gaussians skinned to sparse control nodes (Huang et al. 2024, "SC-GS"), which one of several trajectories
//! drives: a network, keys in time, or a few motions that all nodes share.
//!
//! The skin is in [`super::skin`]; here are the trajectories. Time is the share of the clip that has passed; before and
//! after the clip nodes rest where they were at its end.

mod keys;
mod low_rank;
mod network;

pub(crate) use keys::{Keys, Timeline};
pub(crate) use low_rank::LowRank;
pub(crate) use network::{Network, NetworkShape};

use super::skin::{Skin, SkinSpec, Skinned, Trajectory};
use super::{Capabilities, Model, Motion, Spec};
use crate::math::Real;
use crate::scene::Params;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Most keys in time.
const MAX_KEYS: usize = 4096;
/// Most shared motions.
const MAX_BASES: usize = 256;
/// Most numbers of one table of a trajectory: a bound for files (2^24 numbers are 64 MiB).
const MAX_NUMBERS: usize = 1 << 24;

/// Interpolation of keys in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Curve {
    /// A uniform cubic B-spline of shifts and quaternion residuals: acceleration is continuous.
    Cubic,
    /// Straight lines between keys.
    Linear,
    /// Straight lines for shifts, great arcs for rotations.
    Slerp,
}

/// The trajectory of the nodes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
#[non_exhaustive]
pub enum TrajectorySpec {
    /// Every node has its own poses at keys in time.
    Keys {
        /// Interpolation.
        curve: Curve,
        /// Number of keys, at least two; at least four for a cubic curve.
        keys: usize,
    },
    /// Nodes mix few motions that all share (DynMF: Kratimenos et al. 2024).
    LowRank {
        /// Number of motions, 1 to 256.
        bases: usize,
        /// Keys of each, of a cubic curve: at least four.
        keys: usize,
    },
    /// A perceptron of position and time (SC-GS).
    Network {
        /// Numbers in a hidden layer.
        width: usize,
        /// Hidden layers.
        layers: usize,
        /// Levels of the encoding of positions.
        position_levels: usize,
        /// Levels of the encoding of time.
        time_levels: usize,
    },
}

/// The model as plain data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ControlSpec {
    /// Seed of what starts at random.
    pub seed: u64,
    /// First and last second of the clip.
    pub clip: [f64; 2],
    /// Nodes and how Gaussians follow them.
    pub skin: SkinSpec,
    /// The trajectory of the nodes.
    pub trajectory: TrajectorySpec,
}

impl Default for ControlSpec {
    /// The default skin on a cubic curve of ten keys over one second.
    fn default() -> Self {
        Self {
            seed: 0,
            clip: [0.0, 1.0],
            skin: SkinSpec::default(),
            trajectory: TrajectorySpec::Keys { curve: Curve::Cubic, keys: 10 },
        }
    }
}

impl Model for ControlSpec {
    fn build<F: Real>(&self, p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
        Ok(Arc::new(skinned(self, p)?))
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities::default()
    }
}

/// The model with more than motion: node poses, the skin.
///
/// Errors: as `Model::build`.
pub fn skinned<F: Real>(spec: &ControlSpec, p: &mut Params<F>) -> Result<Skinned<F>> {
    let skin = Skin::new(spec.skin, spec.seed, p)?;
    let trajectory: Box<dyn Trajectory<F>> = match spec.trajectory {
        TrajectorySpec::Keys { curve, keys } => Box::new(Keys::new(Timeline::new(curve, keys, spec.clip)?, &skin, p)?),
        TrajectorySpec::LowRank { bases, keys } => {
            Box::new(LowRank::new(Timeline::new(Curve::Cubic, keys, spec.clip)?, bases, &skin, p)?)
        }
        TrajectorySpec::Network { width, layers, position_levels, time_levels } => {
            let shape = NetworkShape { width, layers, levels: [position_levels, time_levels] };
            Timeline::new(Curve::Linear, 2, spec.clip)?;
            Box::new(Network::new(shape, spec.clip, spec.seed, &skin, p)?)
        }
    };
    Ok(Skinned::new(skin, trajectory, Spec::Control(spec.clone())))
}

/// A spec that cannot be.
fn refuse(what: String) -> Error {
    Error::input(what).remedy("The file is damaged or was written by another program; export it again")
}

/// Errors: a table of `rows` times `width` numbers would be too large.
fn check_size(name: &str, rows: usize, width: usize) -> Result<()> {
    if rows.saturating_mul(width) > MAX_NUMBERS {
        return Err(refuse(format!("table `{name}` of {rows} times {width} numbers is too large")));
    }
    Ok(())
}

#[cfg(test)]
mod tests;
