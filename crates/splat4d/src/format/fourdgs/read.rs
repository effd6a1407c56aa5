//! From records to a scene.

use super::records::{Chunk, File};
use super::{
    ALWAYS, CENTER, CLIP, COEFFICIENTS, COLOR, FLAGS, FPS, LARGEST, MOTION, OPACITY, POSITION, ROTATION, SCALE,
    SH_REACH, SIGMA, WINDOW, center_step, damaged, half_life, motion_step, records,
};
use crate::Result;
use crate::format::bytes::SH_C0;
use crate::format::dialect::Opened;
use crate::format::warnings::Warnings;
use crate::layers::{Layer, Scene};
use crate::motion::{Spacetime, SpacetimeSpec};
use crate::scene::params::{LOG_SCALE, OPACITY as ALPHA, QUAT};
use crate::scene::time::DEFAULT_FPS;
use crate::scene::{GEOMETRY, LIFE, LifeKind, Params, SH};
use std::sync::Arc;

/// Softness of the ends of a Gaussian that does not fade, seconds.
const EDGE: f64 = 1e-4;
/// Seconds beyond the clip at which windows without end are cut.
const BEYOND: f64 = 1.0;
/// Shortest lifespan, seconds.
const SHORTEST: f64 = 1e-6;
/// Alpha is kept this far from 0 and 1, where logits are infinite.
const MARGIN: f64 = 1e-6;

/// A Gaussian.
struct Row {
    mean: [f64; 3],
    quat: [f64; 4],
    log_scale: [f64; 3],
    alpha: f64,
    rgb: [f64; 3],
    velocity: [f64; 3],
    center: f64,
    /// Standard deviation, or half the window of one that does not fade.
    life: f64,
    /// [coefficient][channel], above the base colour.
    sh: Vec<f32>,
}

/// Reads a file.
pub(super) fn read(bytes: &[u8]) -> Result<Opened> {
    let mut warnings = Warnings::default();
    let file = records::read(bytes, &mut warnings)?;
    let (mut fading, mut lasting, mut cut) = (Vec::new(), Vec::new(), 0);
    for chunk in &file.chunks {
        for row in 0..chunk.rows {
            let (gaussian, window) = row_of(&file, chunk, row)?;
            let [from, to] = window.map(|t| t.clamp(-BEYOND, file.header.seconds + BEYOND));
            if bin(chunk, FLAGS, row, 0) & ALWAYS == 0 {
                let half = half_life(file.header.cutoff, Some(gaussian.life), 0.0);
                let [first, last] = [gaussian.center - half, gaussian.center + half];
                cut += usize::from(first.max(0.0) < from || last.min(file.header.seconds) > to);
                fading.push(gaussian);
            } else {
                // Its path is stated about another time than the middle of its window.
                let middle = 0.5 * (from + to);
                let mean =
                    std::array::from_fn(|k| gaussian.mean[k] + gaussian.velocity[k] * (middle - gaussian.center));
                lasting.push(Row { mean, center: middle, life: 0.5 * (to - from), ..gaussian });
            }
        }
    }
    let total = fading.len() + lasting.len();
    if total == 0 {
        return Err(damaged("it holds no Gaussians"));
    }
    warnings.counted(cut, total, "fade and are cut off by a window, which is not kept");
    let numbers = |key: &str| -> Vec<f64> {
        let text = file.header.attributes.get(key).map_or("", String::as_str);
        text.split_whitespace().map_while(|w| w.parse().ok()).collect()
    };
    let clip = match numbers(CLIP)[..] {
        [from, to] if from.is_finite() && to.is_finite() && from <= to => [from, to],
        _ => [0.0, file.header.seconds],
    };
    let fps = numbers(FPS).first().copied().filter(|f| (0.01..=1000.0).contains(f)).unwrap_or(DEFAULT_FPS);
    let kinds = [("fading", fading, LifeKind::GaussHalf), ("lasting", lasting, LifeKind::Interval)];
    let layers = kinds
        .into_iter()
        .filter(|(_, rows, _)| !rows.is_empty())
        .map(|(name, rows, kind)| layer(name, &rows, kind, clip));
    let layers = layers.collect::<Result<Vec<_>>>()?;
    Ok(Opened::from((Scene { layers, clip, fps, ..Scene::default() }, warnings)))
}

fn bin(chunk: &Chunk, attribute: u8, row: usize, channel: usize) -> i32 {
    let stream = &chunk.streams[&attribute];
    stream.bins[row * stream.channels + channel]
}

/// A Gaussian and its window.
fn row_of(file: &File, chunk: &Chunk, row: usize) -> Result<(Row, [f64; 2])> {
    let (s, header) = (&file.steps, &file.header);
    let number = |attribute: u8, k: usize, step: f64| f64::from(bin(chunk, attribute, row, k)) * step;
    let index = bin(chunk, WINDOW, row, 0);
    let window = usize::try_from(index).ok().and_then(|i| file.windows.get(i));
    let window = *window.ok_or_else(|| damaged(format!("window {index} of {}", file.windows.len())))?;
    if window.iter().any(|t| t.is_nan()) {
        return Err(damaged(format!("window {index} has a time that is not a number")));
    }
    let sigma = (bin(chunk, FLAGS, row, 0) & ALWAYS == 0).then(|| number(SIGMA, 0, s.log_sigma).exp());
    let velocity_step = motion_step(s.motion, half_life(header.cutoff, sigma, window[1] - window[0]));
    let green = number(COLOR, 0, s.color);
    let largest = usize::try_from(bin(chunk, LARGEST, row, 0)).ok().filter(|i| *i < 4);
    let largest = largest.ok_or_else(|| damaged("a rotation without its largest component"))?;
    let mut xyzw = [0.0; 4];
    let others = (0..4).filter(|i| *i != largest);
    others.enumerate().for_each(|(k, i)| xyzw[i] = number(ROTATION, k, s.rotation));
    xyzw[largest] = (1.0 - xyzw.iter().map(|x| x * x).sum::<f64>()).max(0.0).sqrt();
    let [x, y, z, w] = xyzw;
    let mut sh = Vec::new();
    for band in 1..=header.degree {
        let each = 2 * band + 1;
        let stream = chunk.bands.get(&(band as u8)).filter(|b| b.channels == 3 * each);
        let stream = stream.ok_or_else(|| damaged(format!("a chunk lacks colours of band {band}")))?;
        for (k, c) in (0..each).flat_map(|k| (0..3).map(move |c| (k, c))) {
            let code = stream.bins[row * stream.channels + c * each + k];
            sh.push((2.0 * SH_REACH * f64::from(code) / 255.0 - SH_REACH) as f32);
        }
    }
    let gaussian = Row {
        mean: std::array::from_fn(|k| s.origin[k] + number(POSITION, k, s.position)),
        quat: [w, x, y, z],
        log_scale: std::array::from_fn(|k| number(SCALE, k, s.log_scale)),
        alpha: number(OPACITY, 0, s.opacity).clamp(MARGIN, 1.0 - MARGIN),
        rgb: [green + number(COLOR, 1, s.color), green, green + number(COLOR, 2, s.color)],
        velocity: std::array::from_fn(|k| number(MOTION, k, velocity_step)),
        center: number(CENTER, 0, center_step(s.time, sigma)),
        life: sigma.unwrap_or(0.0),
        sh,
    };
    Ok((gaussian, window))
}

fn layer(name: &str, rows: &[Row], kind: LifeKind, clip: [f64; 2]) -> Result<Layer<f32>> {
    let further = rows[0].sh.len() / 3;
    debug_assert!(COEFFICIENTS.contains(&further), "a degree of colours");
    let mut params = Params::new(rows.len(), 1 + further, kind.columns());
    let origin = 0.5 * (clip[0] + clip[1]);
    let spec = SpacetimeSpec { order: 1, rotation: false, detach: false, origin, features: None };
    let motion = Spacetime::new(spec, &mut params)?;
    let [geometry, sh, life, path] = params.get_mut([GEOMETRY, SH, LIFE, motion.velocities()]);
    for (row, g) in rows.iter().enumerate() {
        geometry.write(row, 0, g.mean.map(|x| x as f32));
        geometry.write(row, QUAT, g.quat.map(|x| x as f32));
        geometry.write(row, LOG_SCALE, g.log_scale.map(|x| x as f32));
        geometry.set(row, ALPHA, (g.alpha / (1.0 - g.alpha)).ln() as f32);
        sh.write(row, 0, g.rgb.map(|x| ((x - 0.5) / f64::from(SH_C0)) as f32));
        g.sh.iter().enumerate().for_each(|(i, x)| sh.set(row, 3 + i, *x));
        // The file's clock begins at 0, a scene's clip where it says.
        life.write(row, 0, [(clip[0] + g.center) as f32, g.life.max(SHORTEST).ln() as f32]);
        if kind == LifeKind::Interval {
            life.set(row, 2, EDGE.ln() as f32);
        }
        path.write(row, 0, g.velocity.map(|x| x as f32));
    }
    Ok(Layer::new(name, params, Arc::new(motion), kind))
}
