//! The predicted scene. Up to the last observed time it is the trained scene. After it, nodes move the dynamic regions,
//! with the appearance of that time, in front of the static background.

use crate::nodes::Observed;
use crate::paths::{Moment, Paths};
use crate::{Error, Result};
use splat4d::layers::{Layer, PREDICTED, Scene, freeze_rows};
use splat4d::math::knn::mean_square_distance;
use splat4d::math::se3::sub;
use splat4d::motion::control::{ControlSpec, Curve, TrajectorySpec, skinned};
use splat4d::motion::skin::SkinSpec;
use splat4d::motion::{Motion, Still};
use splat4d::scene::params::LoadedArray;
use splat4d::scene::{GEOMETRY, LifeKind, Params, SH, Time};
use std::sync::Arc;

/// Nodes that carry a Gaussian.
const CARRIERS: usize = 4;

/// When the observed part ends and how fast time continues.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Clock {
    /// The last observed time, seconds.
    pub until: f64,
    /// Frames a second.
    pub fps: f64,
}

impl Clock {
    /// The h-th predicted time, seconds; the 0th is the last observed one.
    pub fn at(&self, h: usize) -> f64 {
        self.until + h as f64 / self.fps
    }

    /// From when on the prediction is shown: half a frame after the last observed time.
    fn cut(&self) -> f64 {
        self.until + 0.5 / self.fps
    }
}

/// The predicted scene: `moments` are the frames after the last observed one.
///
/// Its layers are the scene's, which end at the last observed time, and for each of them up to two that begin there:
/// what is static ([`PREDICTED`] and the layer's name), and what moves, as a `control` layer whose nodes have given
/// poses at every frame. Errors: colours that a pixel head makes, no time, nothing to carry.
pub fn predicted(scene: &Scene<f32>, observed: &Observed, moments: &[Moment], clock: Clock) -> Result<Scene<f32>> {
    scene.without_head("a predicted scene")?;
    if moments.is_empty() {
        return Err(Error::input("a prediction has one frame at least").remedy("Give a horizon from 1 on"));
    }
    let mut out = Scene { clip: [scene.clip[0], clock.at(moments.len())], ..scene.clone() };
    for layer in &mut out.layers {
        layer.span[1] = layer.span[1].min(clock.cut());
    }
    for (layer, moving) in scene.layers.iter().zip(&observed.moving) {
        let mut alive = Vec::new();
        if layer.active(Time(clock.until), &mut alive) {
            alive = (0..layer.params.len() as u32).collect();
        }
        let (moves, stands): (Vec<u32>, Vec<u32>) = alive.iter().partition(|i| moving[**i as usize]);
        let add = |kind: &str, (params, motion): (_, Arc<dyn Motion<f32>>)| {
            let name = format!("{PREDICTED}, {kind}: {}", layer.name);
            Layer { span: [clock.cut(), f64::INFINITY], ..Layer::new(name, params, motion, LifeKind::Infinite) }
        };
        if !stands.is_empty() {
            let params = freeze_rows(layer, &stands, Time(clock.until));
            out.layers.push(add("standing", (params, Arc::new(Still))));
        }
        if !moves.is_empty() {
            let params = freeze_rows(layer, &moves, Time(clock.until));
            out.layers.push(add("moving", carried(params, &observed.paths, moments, clock)?));
        }
    }
    Ok(out)
}

/// Gaussians at the last observed time on nodes whose motion is given.
fn carried(
    frozen: Params<f32>,
    paths: &Paths,
    moments: &[Moment],
    clock: Clock,
) -> Result<(Params<f32>, Arc<dyn Motion<f32>>)> {
    let (rest, keys) = (paths.last(), moments.len() + 1);
    let array = |name: &str, width: usize, number: &dyn Fn(usize, usize) -> f64| LoadedArray {
        name: name.into(),
        rows: rest.len(),
        width,
        data: (0..rest.len() * width).map(|i| number(i / width, i % width) as f32).collect(),
    };
    let places: Vec<[f32; 3]> = rest.iter().map(|p| p.x.map(|x| x as f32)).collect();
    let spacing = mean_square_distance(&places);
    let radius = |k: usize| if spacing[k] > 0.0 { 0.5 * f64::from(spacing[k]).ln() } else { 0.0 };
    let pose = |k: usize, key: usize| if key == 0 { rest[k] } else { moments[key - 1][k] };
    // The hemisphere of the quaternion does not matter to what it turns, but to what is between two keys.
    let turn = |k: usize, key: usize, c: usize| {
        let q = pose(k, key).q;
        let sign = if q[0] < 0.0 { -1.0 } else { 1.0 };
        sign * q[c] - if c == 0 { 1.0 } else { 0.0 }
    };
    let loaded = vec![
        array("node_means", 3, &|k, c| rest[k].x[c]),
        array("node_log_radii", 1, &|k, _| radius(k)),
        array("node_logits", 1, &|_, _| 0.0),
        array("node_shifts", 3 * keys, &|k, i| sub(pose(k, i / 3).x, rest[k].x)[i % 3]),
        array("node_turns", 4 * keys, &|k, i| turn(k, i / 4, i % 4)),
    ];
    let (rows, coefficients) = (frozen.len(), frozen[SH].width() / 3);
    let mut params = Params::build(loaded, rows, coefficients, LifeKind::Infinite.columns())?;
    params[GEOMETRY] = frozen[GEOMETRY].clone();
    params[SH] = frozen[SH].clone();
    let spec = ControlSpec {
        seed: 0,
        clip: [clock.until, clock.at(moments.len())],
        skin: SkinSpec { nodes: rest.len(), neighbours: CARRIERS, hyper: 0, mask: false },
        trajectory: TrajectorySpec::Keys { curve: Curve::Slerp, keys },
    };
    let motion = Arc::new(skinned(&spec, &mut params)?);
    Ok((params, motion))
}
