//! In place of a verb whose part this build leaves out: takes any words, so that the error names the part and not them.

use std::ffi::OsString;

/// Left out of this build
#[derive(Debug, clap::Args)]
#[command(disable_help_flag = true)]
pub(crate) struct Args {
    #[arg(num_args = 0.., trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    _words: Vec<OsString>,
}
