//! One file per command: its options, its help and its work.

pub(crate) mod bake;
pub(crate) mod compare;
pub(crate) mod completions;
pub(crate) mod compress;
pub(crate) mod convert;
pub(crate) mod edit;
pub(crate) mod eval;
pub(crate) mod export;
#[cfg(feature = "import")]
pub(crate) mod import;
pub(crate) mod info;
pub(crate) mod join;
pub(crate) mod label;
#[cfg(not(all(feature = "dynamics", feature = "import")))]
pub(crate) mod left_out;
pub(crate) mod localise;
#[cfg(feature = "dynamics")]
pub(crate) mod predict;
pub(crate) mod priors;
pub(crate) mod recipe;
pub(crate) mod render;
pub(crate) mod status;
pub mod train;
pub(crate) mod view;
