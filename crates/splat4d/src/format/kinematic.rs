//! The Gaussians of the two moving dialects, .splatv and STG's .ply: a cubic path, a quaternion with a rate, and
//! a fade exp(−u²) **without the ½**, all on a clock of their own that runs from 0 to 1.

use super::bytes::sound_rows;
use super::dialect::Y_DOWN;
use super::fade::Visibility;
use super::warnings::Warnings;
use crate::layers::{Layer, Scene, with_polynomial};
use crate::math::{Real, quat};
use crate::motion::{Spacetime, SpacetimeSpec};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, LIFE, LifeKind, Params, SH};
use crate::{Error, ErrorKind, Result};
use std::sync::Arc;

/// Width, in clips, of a fade that represents an infinite lifespan: over the clip it dims by 1e-8.
pub(super) const FOREVER: f64 = 1e4;
/// Least logit of an opacity that was fitted: nothing is seen of it.
const LEAST_LOGIT: f64 = -20.0;
/// Narrowest fade that is accepted, in clips: narrower ones are outside the number range and invisible.
const NARROWEST: f64 = 1e-7;
/// Assumed length of a file without a clock of its own: one second.
const UNKNOWN_CLIP: f64 = 1.0;

/// The file's 0 and 1 on the scene clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Clock {
    /// First and last second of the clip.
    pub(super) clip: [f64; 2],
    /// Frames a second.
    pub(super) fps: f64,
    /// Seconds from the file's 0 to its 1.
    pub(super) duration: f64,
}

impl Clock {
    /// A file's own clock, if it states a sensible one; otherwise one second.
    pub(super) fn stated(clip: [f64; 2], fps: f64, duration: f64) -> Option<Self> {
        let sound = clip.iter().all(|t| t.is_finite()) && clip[1] >= clip[0] && duration.is_finite() && duration > 0.0;
        (sound && fps.is_finite() && fps > 0.0).then_some(Self { clip, fps, duration })
    }

    /// The clock assumed for a file that gives none.
    pub(super) fn assumed(warnings: &mut Warnings) -> Self {
        warnings.add("the file does not state its duration: one second is assumed");
        Self { clip: [0.0, UNKNOWN_CLIP], fps: crate::scene::time::DEFAULT_FPS, duration: UNKNOWN_CLIP }
    }
}

/// A Gaussian on the file's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Moving {
    pub(super) mean: [f64; 3],
    /// Unit, wxyz, at the centre.
    pub(super) quat: [f64; 4],
    pub(super) log_scale: [f32; 3],
    pub(super) opacity_logit: f32,
    /// Base colour coefficients.
    pub(super) dc: [f32; 3],
    /// Units per clip, clip², clip³.
    pub(super) path: [[f64; 3]; 3],
    /// Per clip.
    pub(super) turn: [f64; 4],
    /// Centre of the fade and origin of the motion.
    pub(super) center: f64,
    /// s of exp(−((u − centre)/s)²).
    pub(super) width: f64,
    /// Layer and row of the scene that it was taken from.
    pub(super) source: [usize; 2],
}

impl Moving {
    /// The same motion about another centre: the polynomial is expanded there, exactly. The fade moves along.
    pub(super) fn recentered(mut self, center: f64) -> Self {
        let d = center - self.center;
        let [a, b, c] = self.path;
        for k in 0..3 {
            self.mean[k] += d * (a[k] + d * (b[k] + d * c[k]));
            self.path[0][k] = a[k] + d * (2.0 * b[k] + d * 3.0 * c[k]);
            self.path[1][k] = b[k] + 3.0 * d * c[k];
        }
        for k in 0..4 {
            self.quat[k] += d * self.turn[k];
        }
        self.center = center;
        self
    }
}

/// All Gaussians of a scene on the clock of a file called `name`.
///
/// Errors: a layer's motion or life is not of this kind; the message states what to do.
pub(super) fn rows(
    scene: &Scene<f32>,
    clock: Clock,
    name: &str,
    exact: bool,
    warnings: &mut Warnings,
) -> Result<Vec<Moving>> {
    scene.without_head(name)?;
    let mut out = Vec::with_capacity(scene.len());
    let (mut shaded, mut fitted, mut unseen) = (0, 0, 0);
    let powers: [f64; 3] = std::array::from_fn(|k| clock.duration.powi(k as i32 + 1));
    for (number, layer) in scene.layers.iter().enumerate() {
        let converted = with_polynomial(layer).map_err(|e| e.at(format_args!("layer `{}`", layer.name)))?;
        let absorbed = converted.with_frame_absorbed();
        let layer = absorbed.as_ref();
        let Some(motion) = layer.motion.polynomial() else {
            return Err(cannot_hold(layer, name, &format!("the motion `{}`", layer.motion.spec().name())));
        };
        shaded += if layer.params[SH].width() > 3 { layer.params.len() } else { 0 };
        let p = &layer.params;
        for row in sound_rows(p, warnings) {
            let geometry = &p[GEOMETRY];
            // Raw numbers may be of any length; file programs differ in when they normalise, unit ones suit all.
            let (quat, norm) = quat::normalize(geometry.read::<4>(row, QUAT).map(f64::from));
            let norm = if norm > 0.0 { norm } else { 1.0 };
            let columns = layer.life.columns().len();
            let seen = Visibility {
                kind: layer.life,
                life: std::array::from_fn(|k| if k < columns { f64::from(p[LIFE].get(row, k)) } else { 0.0 }),
                opacity: f64::from(geometry.get(row, OPACITY)).sigmoid(),
                span: layer.span,
                cross_fade: layer.cross_fade,
                clip: scene.clip,
            };
            // The path is relative to the lifespan's centre, or from the layer's own origin.
            let center = if columns > 0 { seen.life[0] } else { motion.origin };
            let fade = match seen.exact() {
                Some(fade) => fade,
                None if exact => {
                    return Err(cannot_hold(layer, name, "lifespans with a flat top or a hard end"));
                }
                None => {
                    let Some(fade) = seen.fit() else {
                        unseen += 1;
                        continue;
                    };
                    fitted += 1;
                    fade
                }
            };
            let mut moving = Moving {
                mean: geometry.read::<3>(row, 0).map(f64::from),
                quat,
                log_scale: geometry.read(row, LOG_SCALE),
                opacity_logit: geometry.get(row, OPACITY),
                dc: p[SH].read(row, 0),
                path: [[0.0; 3]; 3],
                turn: [0.0; 4],
                center: (center - clock.clip[0]) / clock.duration,
                width: (fade.width / clock.duration).clamp(NARROWEST, FOREVER),
                source: [number, row],
            };
            if fade.opacity != seen.opacity {
                moving.opacity_logit = (fade.opacity / (1.0 - fade.opacity)).ln().max(LEAST_LOGIT) as f32;
            }
            if let Some(path) = motion.velocities {
                for (k, power) in powers.iter().enumerate().take(motion.order) {
                    moving.path[k] = p[path].read::<3>(row, 3 * k).map(|v| f64::from(v) * power);
                }
            }
            if let Some(rates) = motion.rotation_rates {
                let rate = p[rates].read::<4>(row, 0);
                moving.turn = rate.map(|w| f64::from(w) * clock.duration / norm);
            }
            let there = (fade.center - clock.clip[0]) / clock.duration;
            out.push(moving.recentered(there));
        }
    }
    let what =
        "have a lifespan with a flat top, or one that ends at once: smooth fades were fitted (--exact refuses them)";
    warnings.counted(fitted, scene.len(), what);
    warnings.counted(unseen, scene.len(), "are never seen within the clip and were left out");
    if shaded > 0 {
        let what = "lose their view dependence (spherical harmonics above degree 0)";
        warnings.counted(shaded, scene.len(), &format!("{what}: {name} holds one colour each"));
    }
    Ok(out)
}

fn cannot_hold(layer: &Layer<f32>, name: &str, what: &str) -> Error {
    let text = format!("{name} cannot hold layer `{}`: it has {what}", layer.name);
    Error::new(ErrorKind::Unsupported, text)
        .remedy("Write one time (--time T), a file a frame (--frames), or .s4d, which stores any motion.")
}

/// The scene of a file's Gaussians.
pub(super) fn scene(rows: &[Moving], clock: Clock) -> Result<Scene<f32>> {
    let kind = LifeKind::GaussOne;
    let origin = 0.5 * (clock.clip[0] + clock.clip[1]);
    let spec = SpacetimeSpec { order: 3, rotation: true, detach: true, origin, features: None };
    let mut params = Params::new(rows.len(), 1, kind.columns());
    let motion = Spacetime::new(spec, &mut params)?;
    let [geometry, sh, life, path, rates] = params.get_mut([GEOMETRY, SH, LIFE, motion.velocities(), motion.rates()]);
    for (row, m) in rows.iter().enumerate() {
        geometry.write(row, 0, m.mean.map(|x| x as f32));
        geometry.write(row, QUAT, m.quat.map(|x| x as f32));
        geometry.write(row, LOG_SCALE, m.log_scale);
        geometry.set(row, OPACITY, m.opacity_logit);
        sh.write(row, 0, m.dc);
        let width = m.width.max(NARROWEST) * clock.duration;
        life.write(row, 0, [(clock.clip[0] + m.center * clock.duration) as f32, width.ln() as f32]);
        for k in 0..3 {
            let power = clock.duration.powi(k as i32 + 1);
            path.write(row, 3 * k, m.path[k].map(|v| (v / power) as f32));
        }
        rates.write(row, 0, m.turn.map(|w| (w / clock.duration) as f32));
    }
    let layer = Layer::new("moving", params, Arc::new(motion), kind);
    Ok(Scene { layers: vec![layer], clip: clock.clip, fps: clock.fps, up: Y_DOWN, ..Scene::default() })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::format::samples::gaussians;
    use crate::layers::{ALWAYS, Evaluation, to_native4d};
    use crate::math::{Rng, Sim3};
    use crate::motion::native4d::Native4dSpec;
    use crate::motion::{Spec, build};
    use crate::scene::Time;
    use crate::scene::splats::SPLAT_OPACITY;

    /// A scene of one layer that flies and spins between seconds 2 and 5.
    pub(in crate::format) fn moving(rows: usize, life: LifeKind, order: usize, rotation: bool) -> Scene<f32> {
        let base = gaussians(rows, 1);
        let mut params = Params::new(rows, 1, life.columns());
        let spec = Spec::Spacetime(SpacetimeSpec { order, rotation, detach: true, origin: 3.5, features: None });
        let motion = build(&spec, &mut params).unwrap();
        let rng = Rng::new(4, "kinematic", 0);
        for key in params.keys().collect::<Vec<_>>() {
            for row in 0..rows {
                for col in 0..params[key].width() {
                    let n = rng.fork(row as u64).fork(u64::from(key.0)).normal(col as u64) as f32;
                    let x = match key {
                        GEOMETRY | SH => base[key].get(row, col),
                        LIFE if col == 0 => 3.5 + 0.8 * n,
                        LIFE => 0.3 * n,
                        _ => 0.3 * n,
                    };
                    params[key].set(row, col, x);
                }
            }
        }
        let layer = Layer::new("flying", params, motion, life);
        Scene { layers: vec![layer], clip: [2.0, 5.0], fps: 25.0, up: Y_DOWN, ..Scene::default() }
    }

    /// Largest difference of means, covariances and opacities of two scenes over the clip; all rows.
    pub(in crate::format) fn apart(a: &Scene<f32>, b: &Scene<f32>) -> [f32; 3] {
        let mut worst = [0.0f32; 3];
        for i in 0..=10 {
            let t = Time(a.clip[0] + (a.clip[1] - a.clip[0]) * f64::from(i) / 10.0);
            let all = |scene: &Scene<f32>| {
                let layer = &scene.layers[0];
                Evaluation::of_layer(layer, crate::scene::Space::Gaussians, crate::scene::Rows::All, t)
                    .tape(0)
                    .out()
                    .clone()
            };
            let (p, q) = (all(a), all(b));
            assert_eq!(p.rows(), q.rows());
            for row in 0..p.rows() {
                for col in 0..10 {
                    let group = if col < 3 { 0 } else { 1 + usize::from(col == SPLAT_OPACITY) };
                    worst[group] = worst[group].max((p.get(row, col) - q.get(row, col)).abs());
                }
            }
        }
        worst
    }

    #[test]
    fn the_round_trip_is_exact_for_every_lifespan_and_order() {
        let clock = Clock { clip: [2.0, 5.0], fps: 25.0, duration: 3.0 };
        for life in [LifeKind::Infinite, LifeKind::GaussHalf, LifeKind::GaussOne] {
            for (order, rotation) in [(0, false), (1, true), (3, true)] {
                let scene = moving(50, life, order, rotation);
                let rows = rows(&scene, clock, "x", true, &mut Warnings::default()).unwrap();
                let back = super::scene(&rows, clock).unwrap();
                let [mean, cov, opacity] = apart(&scene, &back);
                assert!(mean < 2e-5 && cov < 2e-5 && opacity < 2e-6, "{life:?} {order}: {mean} {cov} {opacity}");
                // About other centres, the motion stays; the fade must move along, so that opacity is not compared.
                let shifted: Vec<Moving> = rows.iter().map(|m| m.recentered(m.center + 0.1)).collect();
                let [mean, cov, _] = apart(&scene, &super::scene(&shifted, clock).unwrap());
                assert!(mean < 5e-5 && cov < 5e-5, "{life:?} {order}: {mean} {cov}");
            }
        }
    }

    #[test]
    fn gaussians_of_space_and_time_and_layers_with_a_frame_are_held() {
        let clock = Clock { clip: [2.0, 5.0], fps: 25.0, duration: 3.0 };
        let mut scene = moving(50, LifeKind::GaussHalf, 1, false);
        let rotation = quat::to_rotation(quat::normalize([0.4, -0.3, 0.8, 0.2]).0);
        scene.layers[0].frame = Sim3 { scale: 1.7, rotation, translation: [0.4, -0.7, 0.2] };
        let spec = Native4dSpec { max_life: 1e3, min_life: 1e-6, ..Native4dSpec::default() };
        let mut native = scene.clone();
        native.layers[0] = to_native4d(&scene.layers[0], spec).unwrap();
        for own in [scene, native] {
            let rows = rows(&own, clock, "x", true, &mut Warnings::default()).unwrap();
            let [mean, cov, opacity] = apart(&own, &super::scene(&rows, clock).unwrap());
            assert!(mean < 2e-4 && cov < 2e-4 && opacity < 2e-4, "{:?}: {mean} {cov} {opacity}", own.layers[0]);
        }
    }

    #[test]
    fn flat_tops_and_cuts_are_fitted_or_refused() {
        let clock = Clock { clip: [2.0, 5.0], fps: 25.0, duration: 3.0 };
        let mut cut = moving(30, LifeKind::Infinite, 1, true);
        cut.layers[0].span = [2.0, 3.0];
        for scene in [moving(30, LifeKind::Interval, 1, true), cut] {
            let message = rows(&scene, clock, ".splatv", true, &mut Warnings::default()).unwrap_err().to_string();
            assert!(message.contains("`flying`") && message.contains("flat top") && message.contains("--frames"));
            let mut warnings = Warnings::default();
            let rows = rows(&scene, clock, ".splatv", false, &mut warnings).unwrap();
            assert_eq!(rows.len(), 30);
            let said = warnings.lines().join("\n");
            assert!(said.contains("of 30 Gaussians have a lifespan with a flat top"), "{said}");
            // Paths and shapes are unchanged, about another centre.
            let back = super::scene(&rows, clock).unwrap();
            let whole = Scene { layers: vec![Layer { span: ALWAYS, ..scene.layers[0].clone() }], ..scene.clone() };
            let [mean, cov, _] = apart(&whole, &back);
            assert!(mean < 1e-4 && cov < 1e-4, "{mean} {cov}");
        }
    }
}
