//! Learnable functions: perceptrons, positional encodings and hash grids, each with its hand-written backward.
//!
//! Weights are `Space::Fixed` tables of one column, which matrix products read in place. Results are the same bits for
//! any number of threads: work is split by sizes alone, and partial gradients are added in a fixed order.

pub(crate) mod encoding;
pub(crate) mod frames;
pub(crate) mod hashgrid;
pub mod hexplane;
pub mod matmul;
pub mod mlp;
pub(crate) mod sequence;
pub(crate) mod ssm;
#[cfg(test)]
mod tests;
pub(crate) mod vector;

pub use hashgrid::{HashGrid, HashShape};
pub use mlp::{InputGrad, LayerOutputs, Mlp, MlpShape, Passed};
