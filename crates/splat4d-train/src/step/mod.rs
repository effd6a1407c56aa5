//! A training step: the fixed chain, the engine that takes it, and the trainer that repeats it.

mod batch;
pub(crate) mod chain;
mod channels;
pub(crate) mod clocks;
pub(crate) mod emphasis;
pub mod engine;
pub(crate) mod lens;
pub mod loss;
pub(crate) mod pace;
pub mod replans;
pub(crate) mod resident;
pub(crate) mod shutter;
pub mod trainer;

#[cfg(test)]
pub(crate) mod tests;
