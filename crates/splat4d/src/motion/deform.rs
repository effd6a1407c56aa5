//! `deform-mlp`: A canonical cloud that a perceptron or a hash grid deforms (Yang et al. 2024, "Deformable 3D Gaussians").

use super::Motion;
use crate::math::Real;
use crate::scene::Params;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The model as plain data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeformSpec {
    /// Seed of what starts at random.
    pub seed: u64,
}

/// Makes the model, and in `p` the tables it needs (or claims the loaded ones).
pub fn build<F: Real>(_spec: &DeformSpec, _p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
    Err(Error::input("scaffold"))
}
