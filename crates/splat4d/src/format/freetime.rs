//! Gaussians of FreeTimeGS (Wang et al. 2025) as FreeTimeGsVanilla stores them, in checkpoints and `.ftgs.ply`.
//!
//! On a clock from 0 (first frame) to 1 (last frame): μ(t) = μ + v (t − c), opacity · exp(−½((t − c)/e^d)²), e^d at
//! least 0.02. All else is 3DGS with spherical harmonics. Files do not state seconds: 30 frames per second are assumed.
//! Source: OpsiClear-4DGS/FreeTimeGsVanilla, README, "FTGS PLY layout, version 1".

use super::dialect::Y_DOWN;
use super::warnings::Warnings;
use crate::Result;
use crate::layers::{Layer, Scene};
use crate::motion::{Spacetime, SpacetimeSpec};
use crate::scene::time::DEFAULT_FPS;
use crate::scene::{GEOMETRY, LIFE, LifeKind, Params, SH};
use std::sync::Arc;

/// Shortest duration, clips.
pub(super) const SHORTEST: f64 = 0.02;
/// Length that is assumed where no number of frames is stated, seconds.
const UNKNOWN_CLIP: f64 = 1.0;

/// Columns in addition to 3DGS, one row per Gaussian.
pub(super) struct Moves {
    pub(super) times: Vec<f32>,
    pub(super) log_durations: Vec<f32>,
    /// [rows, 3] units per clip; empty: nothing moves.
    pub(super) velocities: Vec<f32>,
}

/// The seconds of a clip of this many frames.
pub(super) fn duration(frames: Option<usize>, warnings: &mut Warnings) -> f64 {
    match frames.filter(|n| *n > 1) {
        Some(n) => {
            warnings
                .add(format!("the file states {n} frames, but no frame rate: {DEFAULT_FPS} per second are assumed"));
            (n - 1) as f64 / DEFAULT_FPS
        }
        None => {
            warnings.add("the file does not state its duration: one second is assumed");
            UNKNOWN_CLIP
        }
    }
}

/// The scene of static parameters and what moves them. Panics: rows that do not fit.
pub(super) fn scene(base: &Params, moves: &Moves, duration: f64) -> Result<Scene<f32>> {
    let (rows, kind) = (base.len(), LifeKind::GaussHalf);
    assert!(moves.times.len() == rows && moves.log_durations.len() == rows, "a time and a duration a row");
    let mut params = Params::new(rows, base[SH].width() / 3, kind.columns());
    let spec = SpacetimeSpec { order: 1, rotation: false, detach: false, origin: 0.5 * duration, features: None };
    let motion = Spacetime::new(spec, &mut params)?;
    params[GEOMETRY] = base[GEOMETRY].clone();
    params[SH] = base[SH].clone();
    let [life, path] = params.get_mut([LIFE, motion.velocities()]);
    for row in 0..rows {
        let width = f64::from(moves.log_durations[row]).exp().max(SHORTEST) * duration;
        life.write(row, 0, [(f64::from(moves.times[row]) * duration) as f32, width.ln() as f32]);
        if let Some(v) = moves.velocities.get(3 * row..3 * row + 3) {
            path.write(row, 0, [v[0], v[1], v[2]].map(|v| (f64::from(v) / duration) as f32));
        }
    }
    let layer = Layer::new("moving", params, Arc::new(motion), kind);
    Ok(Scene { layers: vec![layer], clip: [0.0, duration], fps: DEFAULT_FPS, up: Y_DOWN, ..Scene::default() })
}
