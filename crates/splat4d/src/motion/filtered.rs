//! `filtered`: A Kalman-like filter in Wasserstein geometry around any model (Deng et al. 2024).

use super::Motion;
use crate::math::Real;
use crate::scene::Params;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The model as plain data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FilteredSpec {
    /// The model inside.
    pub inner: Box<super::Spec>,
}

/// Makes the model, and in `p` the tables it needs (or claims the loaded ones).
pub fn build<F: Real>(_spec: &FilteredSpec, _p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
    Err(Error::input("scaffold"))
}
