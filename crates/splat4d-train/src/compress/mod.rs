//! Compression of a trained scene: fewer Gaussians, fewer bits, and fine-tuning that makes up for both.

pub mod quantise;
