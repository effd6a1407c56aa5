//! A moving scene at one moment as plain Gaussians: what a 3DGS file can hold.

use super::{Evaluation, Layer, LayerTape, Scene};
use crate::Result;
use crate::math::sh::MAX_COEFFS;
use crate::math::sh_rotation::{rotate_coefficients, sh_rotation};
use crate::math::{Sim3, quat, sym3};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::{Color, GEOMETRY, LifeKind, Params, Rows, SH, Space, Time};

/// Y00, by which the base coefficient becomes colour; colour is ½ at coefficient 0 (Kerbl et al. 2023).
const SH0: f32 = crate::math::sh::C0 as f32;
/// Share of the trace by which a covariance may differ before it counts as turned or stretched: f32 rounding.
const SAME: f64 = 1e-5;
/// Smallest scale that comes out of a decomposition, as a share of the largest: below it f32 covariances hold no digit.
const THINNEST: f64 = 1e-4;
/// Opacities are kept this far from 0 and 1, where logits are infinite.
const OPACITY_MARGIN: f32 = 1e-6;

/// The Gaussians that are alive at `time`, all layers together, in the world, as a still layer's parameters.
///
/// Errors: the scene has a head, without which its Gaussians look different.
pub fn freeze(scene: &Scene<f32>, time: Time) -> Result<Params<f32>> {
    scene.without_head("plain Gaussians")?;
    let mut instant = Evaluation::default();
    scene.at(time, &mut instant);
    let coefficients = scene.layers.iter().map(|l| l.params[SH].width() / 3).max().unwrap_or(1).clamp(1, MAX_COEFFS);
    let rows = instant.tapes().map(|t| t.out().rows()).sum();
    let mut params = Params::new(rows, coefficients, LifeKind::Infinite.columns());
    let mut first = 0;
    for (layer, tape) in scene.layers.iter().zip(instant.tapes()) {
        write(layer, tape, coefficients, first, &mut params);
        first += tape.out().rows();
    }
    Ok(params)
}

/// The same, but what stands still anyway keeps its very bits.
pub fn moment(scene: &Scene<f32>, time: Time) -> Result<Params<f32>> {
    scene.without_head("plain Gaussians")?;
    match &scene.layers[..] {
        [only] if !scene.is_moving() && only.frame.is_identity() => Ok(only.params.clone()),
        _ => freeze(scene, time),
    }
}

/// These rows of a layer (strictly increasing) as they are at `time`, life and frame included, as a still layer's
/// parameters; of Gaussians with features only the base colour is left.
pub fn freeze_rows(layer: &Layer<f32>, rows: &[u32], time: Time) -> Params<f32> {
    let seen = Evaluation::of_layer(layer, Space::Gaussians, Rows::Some(rows), time);
    let coefficients = (layer.params[SH].width() / 3).clamp(1, MAX_COEFFS);
    let mut params = Params::new(rows.len(), coefficients, LifeKind::Infinite.columns());
    write(layer, seen.tape(0), coefficients, 0, &mut params);
    params
}

/// Writes what a tape holds into rows of a still layer, from `first` on.
fn write(layer: &Layer<f32>, tape: &LayerTape<f32>, coefficients: usize, first: usize, params: &mut Params<f32>) {
    let (raw, part) = (&layer.params[GEOMETRY], layer.part(tape));
    let sh_matrix = part.layer_from_world.map(|_| sh_rotation(&layer.frame.rotation));
    for j in 0..part.out.rows() {
        let (id, row) = (tape.rows().id(j), first + j);
        let mean = part.out.read::<3>(j, 0);
        let cov = part.out.read::<6>(j, COV).map(f64::from);
        let opacity = part.out.get(j, SPLAT_OPACITY).clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
        let own = framed_shape(&layer.frame, raw.read(id, QUAT), raw.read(id, LOG_SCALE));
        // Most motion leaves shapes alone: then the learnt numbers are exact and a decomposition is not.
        let (q, s) = if unchanged(own, cov) { own } else { decomposed(cov) };
        let [geometry, sh] = params.get_mut([GEOMETRY, SH]);
        geometry.write(row, 0, mean);
        geometry.write(row, QUAT, q.map(|x| x as f32));
        geometry.write(row, LOG_SCALE, s.map(|x| x as f32));
        geometry.set(row, OPACITY, (opacity / (1.0 - opacity)).ln());
        let mut colors = coefficients_of(&part.color, j);
        if let Some(m) = &sh_matrix {
            rotate_coefficients(m, &mut colors);
        }
        for (k, value) in colors.into_iter().enumerate().take(3 * coefficients) {
            sh.set(row, k, value);
        }
    }
}

/// A learnt shape (raw quaternion and log scales) as the frame shows it.
pub(crate) fn framed_shape(frame: &Sim3, q: [f32; 4], log_scales: [f32; 3]) -> ([f64; 4], [f64; 3]) {
    let own = (q.map(f64::from), log_scales.map(f64::from));
    if frame.is_identity() {
        return own;
    }
    (quat::product(quat::from_rotation(&frame.rotation), own.0), own.1.map(|s| s + frame.scale.ln()))
}

fn unchanged((q, s): ([f64; 4], [f64; 3]), cov: [f64; 6]) -> bool {
    let own = sym3::from_quat_log_scales(quat::normalize(q).0, s);
    let trace = (cov[0] + cov[3] + cov[5]).abs();
    own.iter().zip(cov).all(|(a, b)| (a - b).abs() <= SAME * trace)
}

fn decomposed(cov: [f64; 6]) -> ([f64; 4], [f64; 3]) {
    let largest = cov[0].max(cov[3]).max(cov[5]).max(0.0).sqrt();
    sym3::to_quat_log_scales(cov, (THINNEST * largest).max(1e-12))
}

/// The SH coefficients [K·3] of one splat.
fn coefficients_of(color: &Color<'_>, j: usize) -> Vec<f32> {
    match color {
        Color::Sh { table, rows, weights, .. } => {
            let id = rows.id(j);
            let blocks = weights.map_or(1, |w| w.width().max(1));
            let width = table.width() / blocks;
            let weight = |b: usize| weights.map_or(1.0, |w| w.get(j, b));
            (0..width).map(|k| (0..blocks).map(|b| weight(b) * table.get(id, b * width + k)).sum()).collect()
        }
        Color::Direct { table } => (0..3.min(table.width())).map(|k| (table.get(j, k) - 0.5) / SH0).collect(),
    }
}
