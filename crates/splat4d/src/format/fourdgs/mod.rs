//! `.4dgs` of the fourdgs libraries (avala-ai), major version 1, read and written: records of a code, a length and that many bytes.
//!
//! A Gaussian of the model `gaussian-birth` has position, linear scale, quaternion, RGB and opacity, a velocity, a temporal centre
//! and standard deviation (or none: it does not fade) and a window [low, high) outside which it does not exist. Numbers are bins of
//! stated steps. Here a Gaussian that fades has the lifespan `gauss-half`, one that does not `interval`.
//!
//! `streams`: bins; `records`: the file's own; `read` and `write`: between them and scenes.
//! Source: avala-ai/4dgs (Apache-2.0), specification version 1 (draft) and registry, November 2026.

mod read;
mod records;
mod streams;
#[cfg(test)]
pub(super) mod tests;
mod write;

use super::dialect::{Dialect, Writer, Y_DOWN};
use crate::Error;

/// .4dgs of the fourdgs libraries.
pub(crate) const DIALECT: Dialect = Dialect {
    name: ".4dgs",
    ending: ".4dgs",
    up: Y_DOWN,
    moves: true,
    mark: Some(|bytes| bytes.starts_with(&MAGIC[..5])),
    read: read::read,
    writer: Writer::Moving(|scene, options, out| write::write(scene, options, out)),
    world: false,
    fixed_axes: false,
    states_up: false,
};

/// First and last bytes.
const MAGIC: [u8; 8] = *b"\x894DGS1\r\n";
/// Codes of records.
const HEADER: u8 = 0x01;
const FOOTER: u8 = 0x02;
const QUANTIZATION: u8 = 0x03;
const WINDOWS: u8 = 0x04;
const CHUNK: u8 = 0x05;
const SH_BAND: u8 = 0x07;
const CHUNK_INDEX: u8 = 0x08;
/// Codes of attributes: required ones in this order, from 0 on.
const POSITION: u8 = 0;
const SCALE: u8 = 1;
const LARGEST: u8 = 2;
const ROTATION: u8 = 3;
const COLOR: u8 = 4;
const OPACITY: u8 = 5;
const MOTION: u8 = 6;
const CENTER: u8 = 7;
const SIGMA: u8 = 8;
const FLAGS: u8 = 9;
const WINDOW: u8 = 10;
/// Numbers of the required attributes.
const WIDTHS: [usize; 11] = [3, 3, 1, 3, 3, 1, 3, 1, 1, 1, 1];
/// Bit of the flags: it does not fade.
const ALWAYS: i32 = 1;
/// The temporal model that is read.
const MODEL: &str = "gaussian-birth";
/// The scheme of bins.
const SCHEME: &str = "uniform-v1";
/// Coefficients of a colour in the bands up to each degree.
const COEFFICIENTS: [usize; 4] = [0, 3, 8, 15];
/// A coefficient in a byte b is −4 + 8b/255.
const SH_REACH: f64 = 4.0;
/// Keys of the header's attributes in files of splat4d: first and last second on the scene's clock, frames a second.
const CLIP: &str = "splat4d_clip";
const FPS: &str = "splat4d_fps";

fn damaged(what: impl std::fmt::Display) -> Error {
    Error::input(format!("this .4dgs is damaged: {what}")).remedy("Copy or export it again.")
}

/// Step of a velocity: finer, the longer a Gaussian is seen (specification, 6.3). `half`: seconds to each side.
fn motion_step(step: f64, half: f64) -> f64 {
    let class = (half.clamp(0.02, 2.0) / 0.5).log2().ceil().clamp(-4.0, 2.0);
    step * (-class).exp2()
}

/// Step of a temporal centre: a fraction of the standard deviation (6.3).
fn center_step(step: f64, sigma: Option<f64>) -> f64 {
    let target = sigma.map_or(step, |sigma| step.min(0.05 * sigma));
    step * (target / step).log2().floor().clamp(-10.0, 0.0).exp2()
}

/// Seconds to each side that a Gaussian is seen: `sigma`: none if it does not fade; `window`: its length.
fn half_life(cutoff: f64, sigma: Option<f64>, window: f64) -> f64 {
    sigma.map_or(window, |sigma| (-2.0 * cutoff.ln()).sqrt() * sigma)
}
