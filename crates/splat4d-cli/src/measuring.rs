//! Options of measuring, of several commands.

use splat4d::Result;
use splat4d_workflow::evaluating::Measure;
use std::path::PathBuf;

/// Options of measuring.
#[derive(Debug, Default, clap::Args)]
pub(crate) struct MeasureArgs {
    /// Weights (safetensors) for LPIPS; without them it is not computed
    #[arg(long, value_name = "FILE", help_heading = "Evaluation")]
    lpips_weights: Option<PathBuf>,
}

impl MeasureArgs {
    /// Options of the evaluation.
    pub(crate) fn options(&self) -> Measure {
        Measure { lpips_weights: self.lpips_weights.clone(), ..Measure::default() }
    }

    /// Finds missing files before hours of training.
    pub(crate) fn check(&self) -> Result<()> {
        self.options().check()
    }
}
