//! A moving scene at one moment as plain Gaussians: what a 3DGS file can hold.

use splat4d::layers::{Instant, Scene};
use splat4d::math::sh::MAX_COEFFS;
use splat4d::math::{quat, sym3};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::splats::{COV, SPLAT_OPACITY};
use splat4d::scene::{Color, GEOMETRY, LifeKind, Params, SH, Time};

/// Y00, by which the base coefficient becomes colour; colour is ½ at coefficient 0 (Kerbl et al. 2023).
const SH0: f32 = 0.282_094_79;
/// Share of the trace by which a covariance may differ before it counts as turned or stretched: f32 rounding.
const SAME: f64 = 1e-5;
/// Smallest scale that comes out of a decomposition, as a share of the largest: below it f32 covariances hold no digit.
const THINNEST: f64 = 1e-4;
/// Opacities are kept this far from 0 and 1, where logits are infinite.
const OPACITY_MARGIN: f32 = 1e-6;

/// The Gaussians that are alive at `time`, all layers together, as a still layer's parameters.
pub(crate) fn freeze(scene: &Scene<f32>, time: f64) -> Params<f32> {
    let mut instant = Instant::default();
    scene.at(Time(time), &mut instant);
    let splats = scene.splats(&instant);
    let coefficients = scene.layers.iter().map(|l| l.params[SH].width() / 3).max().unwrap_or(1).clamp(1, MAX_COEFFS);
    let mut params = Params::new(splats.len(), coefficients, LifeKind::Infinite.columns());
    let mut row = 0;
    for ((layer, tape), part) in scene.layers.iter().zip(&instant.tapes).zip(&splats.parts) {
        let raw = &layer.params[GEOMETRY];
        for j in 0..part.out.rows() {
            let id = tape.rows().id(j);
            let mean = part.out.read::<3>(j, 0);
            let cov = part.out.read::<6>(j, COV).map(f64::from);
            let opacity = part.out.get(j, SPLAT_OPACITY).clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
            let own = (raw.read::<4>(id, QUAT).map(f64::from), raw.read::<3>(id, LOG_SCALE).map(f64::from));
            // Most motion leaves shapes alone: then the learnt numbers are exact and a decomposition is not.
            let (q, s) = if unchanged(own, cov) { own } else { decomposed(cov) };
            let [geometry, sh] = params.get_mut([GEOMETRY, SH]);
            geometry.write(row, 0, mean);
            geometry.write(row, QUAT, q.map(|x| x as f32));
            geometry.write(row, LOG_SCALE, s.map(|x| x as f32));
            geometry.set(row, OPACITY, (opacity / (1.0 - opacity)).ln());
            for (k, value) in coefficients_of(&part.color, j).into_iter().enumerate().take(3 * coefficients) {
                sh.set(row, k, value);
            }
            row += 1;
        }
    }
    params
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

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::layers::{ALWAYS, Layer};
    use splat4d::math::Rng;
    use splat4d::motion::{SpacetimeSpec, Spec, build};
    use splat4d::render::{Image, RenderConfig, Renderer};
    use splat4d::scene::Camera;

    /// A cloud that moves and turns.
    fn scene() -> Scene<f32> {
        let rng = Rng::new(5, "freeze", 0);
        let life = LifeKind::GaussHalf;
        let mut params = Params::new(60, 4, life.columns());
        let spec = Spec::Spacetime(SpacetimeSpec { order: 1, rotation: true, detach: false, origin: 0.0 });
        let motion = build(&spec, &mut params).unwrap();
        for key in params.keys() {
            let table = &mut params.get_mut([key])[0];
            for row in 0..table.rows() {
                for col in 0..table.width() {
                    let noise = rng.normal((row * 64 + col) as u64 + 4096 * u64::from(key.0)) as f32;
                    table.set(row, col, 0.5 * noise);
                }
            }
        }
        let geometry = &mut params.get_mut([GEOMETRY])[0];
        for row in 0..60 {
            for k in 0..3 {
                *geometry.get_mut(row, LOG_SCALE + k) -= 2.0;
            }
        }
        let layer = Layer { name: "a".into(), params, motion, life, span: ALWAYS, masks: None };
        Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, ..Scene::default() }
    }

    #[test]
    fn a_frozen_moment_looks_like_the_scene_then() {
        let scene = scene();
        let pose = splat4d::math::Se3::look_at([0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0]);
        let camera = Camera::with_fov_y(pose, 0.9, 48, 40);
        let draw = |scene: &Scene<f32>, time: f64| {
            let (mut instant, mut image) = (Instant::default(), Image::default());
            scene.at(Time(time), &mut instant);
            let mut renderer = Renderer::new(RenderConfig::default());
            renderer.render(&scene.splats(&instant), &camera, [0.2; 3], None, &mut image);
            image.color
        };
        for time in [0.0, 0.37, 1.0] {
            let mut params = freeze(&scene, time);
            let motion = build(&Spec::Still, &mut params).unwrap();
            let still =
                Layer { name: "still".into(), params, motion, life: LifeKind::Infinite, span: ALWAYS, masks: None };
            let frozen = Scene { layers: vec![still], ..Scene::default() };
            let (a, b) = (draw(&scene, time), draw(&frozen, 0.0));
            let worst = a.data.iter().zip(&b.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 2e-3, "{time}: {worst}");
            let seen = a.data.iter().filter(|v| (**v - 0.2).abs() > 0.05).count();
            assert!(seen > 200, "the test must look at something: {seen}");
        }
    }
}
