//! `native4d`: Gaussians of space and time, sliced at t (Yang et al. 2024, "Real-time 4DGS").

use super::Motion;
use crate::math::Real;
use crate::scene::Params;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The model as plain data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Native4dSpec {
    /// Seed of what starts at random.
    pub seed: u64,
}

/// Makes the model, and in `p` the tables it needs (or claims the loaded ones).
pub fn build<F: Real>(_spec: &Native4dSpec, _p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
    Err(Error::input("scaffold"))
}
