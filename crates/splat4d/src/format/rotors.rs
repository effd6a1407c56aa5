//! Checkpoints of 3DGS (Kerbl et al. 2023) and of 4d-gaussian-splatting (Yang et al. 2024, Fudan), read: a tuple of a training's
//! tensors without names, whose length identifies the program.
//!
//! Gaussians of space and time become [`crate::motion::native4d`]. Their rotation X ↦ l X r̄ has X = t + zi + yj + xk, ours
//! t + xi + yj + zk: swapping i and k reverses products, so that our left quaternion is their right one with x and z swapped,
//! conjugated, and vice versa. Their renderer leaves out what has faded below 0.05, ours below 1/255 of opacity.
//! Sources: graphdeco-inria/gaussian-splatting and fudan-zvg/4d-gaussian-splatting (MIT), scene/gaussian_model.py, read for facts.

use super::dialect::{Opened, Y_DOWN};
use super::torch::{Torch, Value};
use super::warnings::Warnings;
use crate::layers::{Layer, Scene};
use crate::motion::Model;
use crate::motion::native4d::{LONGEST, MAX_HARMONICS, Native4dSpec, SHORTEST, TABLE};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::time::DEFAULT_FPS;
use crate::scene::{GEOMETRY, LifeKind, Params, SH};
use crate::{Error, ErrorKind, Result};

/// Entries of the tuple of 3DGS and of 4d-gaussian-splatting.
const STATIC: usize = 12;
const MOVING: usize = 19;
/// Entries of the latter: times, log scales in time, right quaternions, whether Gaussians rotate in space and time.
const TIMES: usize = 13;
const TIME_SCALES: usize = 14;
const RIGHT: usize = 15;
const ROTATES: usize = 16;
/// Coefficients of one block of spherical harmonics where there are several.
const BLOCK: usize = 16;
/// Centres start within the clip and a tenth of it on both sides.
const SPREAD: f64 = 1.2;
/// Share of the centres that may lie outside on each side.
const OUTSIDE: f64 = 0.01;

/// Reads a checkpoint; `clip`: first and last second, where these are known. `None`: it is of another program.
///
/// Errors: tensors of other shapes, settings that are not read.
pub(super) fn read(torch: &Torch<'_>, clip: Option<[f64; 2]>) -> Result<Option<Opened>> {
    let root = torch.items(torch.root());
    let entries = root.first().map(|tuple| torch.items(tuple)).unwrap_or_default();
    if root.len() != 2 || ![STATIC, MOVING].contains(&entries.len()) || !matches!(entries[1], Value::Tensor(_)) {
        return Ok(None);
    }
    let file = Tuple { torch, entries };
    let mut params = file.gaussians()?;
    if file.entries.len() == STATIC {
        return Ok(Some(Opened::from((params, Warnings::default()))));
    }
    if !matches!(file.entries[ROTATES], Value::Bool(true)) {
        return Err(unsupported("the checkpoint was trained without rot_4d, which is not read")
            .remedy("Train with rot_4d: True, as the configurations of 4d-gaussian-splatting do."));
    }
    let mut warnings = Warnings::default();
    let rows = params.len();
    let (times, scales) = (file.numbers(TIMES, rows, 1)?, file.numbers(TIME_SCALES, rows, 1)?);
    let right = file.numbers(RIGHT, rows, 4)?;
    let range = range_of(&times);
    let clip = clip.filter(|[from, to]| to > from).unwrap_or_else(|| {
        let [from, to] = range;
        warnings.add(format!(
            "the checkpoint does not state its time_duration: {from} to {to} is assumed by the Gaussians' times"
        ));
        [0.0, to - from]
    });
    // Seconds of one unit of the file's time.
    let unit = (clip[1] - clip[0]) / (range[1] - range[0]);
    let harmonics = (params[SH].width() / 3 / BLOCK).saturating_sub(1);
    let (min_life, max_life) = (SHORTEST, LONGEST);
    let spec =
        Native4dSpec { speed: 1.0 / unit, min_life, max_life, harmonics, period: clip[1] - clip[0], split_time: true };
    let motion = spec.build(&mut params)?;
    let own = params.find(TABLE).expect("the model has made its table");
    for row in 0..rows {
        let left = params[GEOMETRY].read::<4>(row, QUAT);
        let theirs: [f32; 4] = std::array::from_fn(|k| right[4 * row + k]);
        params[GEOMETRY].write(row, QUAT, swapped(theirs));
        let time = clip[0] + (f64::from(times[row]) - range[0]) * unit;
        params[own].write(row, 0, [time as f32, (f64::from(scales[row]) + unit.ln()) as f32]);
        params[own].write(row, 2, swapped(left));
    }
    let layer = Layer::new("4d-gaussian-splatting", params, motion, LifeKind::Infinite);
    let scene = Scene { layers: vec![layer], clip, fps: DEFAULT_FPS, up: Y_DOWN, ..Scene::default() };
    Ok(Some(Opened::from((scene, warnings))))
}

/// x and z swapped, conjugated.
fn swapped([w, x, y, z]: [f32; 4]) -> [f32; 4] {
    [w, -z, -y, -x]
}

/// The range of time that Gaussians were trained on, by their centres: of whole units, from 0 or around it.
fn range_of(times: &[f32]) -> [f64; 2] {
    let mut all: Vec<f64> = times.iter().map(|t| f64::from(*t)).filter(|t| t.is_finite()).collect();
    all.sort_by(f64::total_cmp);
    let out = (all.len() as f64 * OUTSIDE) as usize;
    let (Some(low), Some(high)) = (all.get(out), all.get(all.len().wrapping_sub(1 + out))) else { return [0.0, 1.0] };
    let length = ((high - low) / SPREAD).round().clamp(1.0, LONGEST);
    if (low + high).abs() < 0.5 * length { [-0.5 * length, 0.5 * length] } else { [0.0, length] }
}

fn unsupported(what: impl Into<String>) -> Error {
    Error::new(ErrorKind::Unsupported, what)
}

/// Entries of the tuple.
struct Tuple<'a> {
    torch: &'a Torch<'a>,
    entries: Vec<&'a Value>,
}

impl Tuple<'_> {
    fn shape(&self, i: usize) -> Result<&[usize]> {
        match self.entries[i] {
            Value::Tensor(tensor) => Ok(&tensor.shape),
            _ => Err(Error::input(format!("entry {i} of the checkpoint is not a tensor")).remedy("Save it again.")),
        }
    }

    /// Numbers of `rows` rows of `width`.
    fn numbers(&self, i: usize, rows: usize, width: usize) -> Result<Vec<f32>> {
        let shape = self.shape(i)?;
        let count = shape.iter().try_fold(1usize, |n, d| n.checked_mul(*d));
        let Value::Tensor(tensor) = self.entries[i] else { unreachable!("it has a shape") };
        if shape.first() != Some(&rows) || count != rows.checked_mul(width) {
            return Err(Error::input(format!(
                "entry {i} of the checkpoint has shape {shape:?}, expected {rows} rows of {width}"
            ))
            .remedy("The checkpoint is damaged; save it again."));
        }
        self.torch.numbers(tensor)
    }

    fn gaussians(&self) -> Result<Params> {
        let rows = self.shape(1)?.first().copied().unwrap_or(0);
        let further = self.shape(3)?.get(1).copied().unwrap_or(0);
        let blocks = (1..=MAX_HARMONICS + 1).any(|n| 1 + further == BLOCK * n);
        if ![1, 4, 9].contains(&(1 + further)) && !blocks {
            return Err(unsupported(format!("the checkpoint has {} coefficients of colour a Gaussian", 1 + further))
                .remedy("Train with spherical harmonics of degree 3 or less, and of degree 2 in time or less."));
        }
        let [means, scales, quats] = [(1, 3), (4, 3), (5, 4)].map(|(i, width)| self.numbers(i, rows, width));
        let (means, scales, quats) = (means?, scales?, quats?);
        let (opacities, base) = (self.numbers(6, rows, 1)?, self.numbers(2, rows, 3)?);
        let rest = if further > 0 { self.numbers(3, rows, 3 * further)? } else { Vec::new() };
        let mut params = Params::new(rows, 1 + further, &[]);
        let [geometry, sh] = params.get_mut([GEOMETRY, SH]);
        for row in 0..rows {
            geometry.write(row, 0, std::array::from_fn::<f32, 3, _>(|k| means[3 * row + k]));
            geometry.write(row, QUAT, std::array::from_fn::<f32, 4, _>(|k| quats[4 * row + k]));
            geometry.write(row, LOG_SCALE, std::array::from_fn::<f32, 3, _>(|k| scales[3 * row + k]));
            geometry.set(row, OPACITY, opacities[row]);
            (0..3).for_each(|k| sh.set(row, k, base[3 * row + k]));
            (0..3 * further).for_each(|k| sh.set(row, 3 + k, rest[3 * further * row + k]));
        }
        Ok(params)
    }
}

#[cfg(test)]
mod tests;
