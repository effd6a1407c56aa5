//! Importance scores of Gaussians: contribution to the training images, weighted by the temporal score of the lifespan.
//!
//! Source: 4DGS-1K (Yuan et al. 2025, §4.1); the volume as LightGaussian (Fan et al. 2024).

use super::super::covariances;
use super::temporal::{Combine, Lives, Spatial, Temporal};
use super::weighing::Weighing;
use crate::capture::frames::Frames;
use crate::sampler::Timeline;
use crate::{Error, Result};
use rayon::prelude::*;
use splat4d::layers::Scene;
use splat4d::math::sym3;
use splat4d::render::Antialias;
use splat4d::scene::Time;

/// The volume of this share of the Gaussians is below the one at which the volume stops to count (of two places that
/// write it down differently, LightGaussian's paper).
const VOLUME_PERCENTILE: f64 = 0.9;
/// Power of the relative volume (LightGaussian).
const VOLUME_POWER: f64 = 0.1;
/// Variances below this share of the largest are not distinguished: covariances are f32.
const THINNEST: f64 = 1e-6;
/// Frames of a unit of time: a second at the 30 frames a second of 4DGS-1K's captures.
pub(crate) const UNIT_FRAMES: f64 = 30.0;

/// Settings of importance scores.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ScoreConfig {
    /// The quantity of a view that counts.
    pub spatial: Spatial,
    /// The temporal score of the lifespan.
    pub temporal: Temporal,
    /// Combination with the spatial score.
    pub combine: Combine,
    /// Whether the temporal score is multiplied with a power of the volume in space and time.
    pub volume: bool,
    /// Power of the mean share that a Gaussian has of the pixels it touches. Above 0, haze is pruned first: it costs as
    /// much blending per pixel as solid Gaussians, and contributes less (our own addition; 0: as published).
    pub cost: f64,
    /// Frames of a unit of time, in which derivatives of the lifespan are measured (`UNIT_FRAMES`).
    pub unit: f64,
    /// Every n of the views at a time are examined, another choice at each time, and at least one.
    pub every: usize,
    /// As the scene was trained.
    pub antialias: Antialias,
}

impl Default for ScoreConfig {
    /// Per-time product of |p''| and the spatial score, with the volume, from all views.
    fn default() -> Self {
        Self {
            spatial: Spatial::default(),
            temporal: Temporal::default(),
            combine: Combine::default(),
            volume: true,
            cost: 0.0,
            unit: UNIT_FRAMES,
            every: 1,
            antialias: Antialias::Off,
        }
    }
}

/// Importance score of every Gaussian; larger is better, 0 is never seen.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores {
    /// A score a row, by layer.
    pub layers: Vec<Vec<f64>>,
    /// The spatial score over all views examined, a row, by layer.
    pub spatial: Vec<Vec<f64>>,
    /// Views examined.
    pub views: usize,
}

/// Scores all Gaussians of `scene` by the views of `frames`; no image is loaded. `progress` is called with the number
/// of views done and in all. The same bits for any number of threads.
///
/// Errors: there is no frame.
pub(crate) fn score(
    scene: &Scene<f32>,
    frames: &dyn Frames,
    config: &ScoreConfig,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Scores> {
    assert!(
        config.unit > 0.0 && config.every > 0 && config.cost >= 0.0,
        "a unit of time is positive, and views are counted from one: {config:?}"
    );
    if frames.is_empty() {
        return Err(Error::input("there are no training views to score Gaussians by")
            .remedy("Hold out fewer views with --hold-out"));
    }
    let timeline = Timeline::new(frames);
    let groups: Vec<Vec<usize>> = (0..timeline.times()).map(|k| views_at(timeline.at(k), k, config.every)).collect();
    let times: Vec<Time> = groups.iter().map(|g| frames.time(g[0])).collect();
    let fps = if scene.fps > 0.0 { scene.fps } else { splat4d::scene::time::DEFAULT_FPS };
    let clip = scene.clip[1] - scene.clip[0] + 1.0 / fps;
    let lives: Vec<Lives> = scene.layers.iter().map(|l| Lives::new(l, clip, config.unit / fps)).collect();

    let zeros = || -> Vec<Vec<f64>> { scene.layers.iter().map(|l| vec![0.0; l.params.len()]).collect() };
    // Σ_t S(t), Σ_t S(t)·T(t) and Σ of T(t) over the times at which S(t) > 0.
    let (mut spatial, mut product, mut served) = (zeros(), zeros(), zeros());
    let mut touched = zeros();
    let (mut weighing, mut done) = (Weighing::new(config.spatial, config.antialias), 0);
    let total = groups.iter().map(Vec::len).sum();
    for (group, &t) in groups.iter().zip(&times) {
        weighing.at(scene, t);
        for &frame in group {
            weighing.add(scene, frames.camera(frame));
            done += 1;
            progress(done, total);
        }
        for (layer, lives) in lives.iter().enumerate() {
            let seen = weighing.layer(layer);
            touched[layer].iter_mut().zip(weighing.pixels(layer)).for_each(|(sum, pixels)| *sum += pixels);
            let sums = spatial[layer].par_iter_mut().zip(&mut product[layer]).zip(&mut served[layer]);
            sums.zip(seen).enumerate().with_min_len(4096).for_each(|(row, (((spatial, product), served), &s))| {
                if s > 0.0 {
                    let value = lives.instant(config.temporal, row, t);
                    *spatial += s;
                    *product += s * value;
                    *served += value;
                }
            });
        }
    }

    // A score of all views together takes the place of the sum; how its times are served is as the views felt it.
    for layer in 0..scene.layers.len() {
        let Some(whole) = weighing.whole(layer) else { continue };
        for ((spatial, product), whole) in spatial[layer].iter_mut().zip(&mut product[layer]).zip(whole) {
            *product *= if *spatial > 0.0 { whole / *spatial } else { 0.0 };
            *spatial = whole;
        }
    }

    let gamma = if config.volume || config.spatial == Spatial::LightGaussian {
        volumes(scene, &lives)
    } else {
        scene.layers.iter().map(|_| Vec::new()).collect()
    };
    let temporal = |layer: usize, row: usize, instants: f64| {
        let gamma: f64 = gamma[layer].get(row).copied().unwrap_or(1.0);
        gamma * lives[layer].whole(config.temporal, row, &times) * instants
    };
    let each = |f: &(dyn Fn(usize, usize) -> f64 + Sync)| -> Vec<Vec<f64>> {
        let rows = |layer: usize| (0..spatial[layer].len()).into_par_iter().map(|row| f(layer, row)).collect();
        (0..spatial.len()).map(rows).collect()
    };
    let alone = |layer: usize, row: usize| match config.temporal {
        _ if served[layer][row] == 0.0 => 0.0,
        Temporal::InstantAbs | Temporal::FirstDerivative => temporal(layer, row, served[layer][row]),
        _ => temporal(layer, row, 1.0),
    };
    let mut layers = match config.combine {
        Combine::Product => each(&|layer, row| temporal(layer, row, product[layer][row])),
        Combine::TemporalAlone => each(&alone),
        Combine::Sum => {
            let lasting = each(&alone);
            let mean = |all: &[Vec<f64>]| {
                (all.iter().flatten().sum::<f64>() / scene.len().max(1) as f64).max(f64::MIN_POSITIVE)
            };
            let (by_time, by_space) = (mean(&lasting), mean(&spatial));
            each(&|layer, row| lasting[layer][row] / by_time + spatial[layer][row] / by_space)
        }
    };
    if config.cost > 0.0 {
        for ((scores, spatial), touched) in layers.iter_mut().zip(&spatial).zip(&touched) {
            for ((score, s), pixels) in scores.iter_mut().zip(spatial).zip(touched) {
                *score *= (s / pixels.max(1.0)).min(1.0).powf(config.cost);
            }
        }
    }
    // A Gaussian that is not finite is not rendered; its lifespan may be anything.
    layers.iter_mut().flatten().filter(|s| s.is_nan()).for_each(|s| *s = 0.0);
    Ok(Scores { layers, spatial, views: total })
}

/// Every n of the views at the k-th time, beginning elsewhere at each; at least one.
fn views_at(group: &[u32], k: usize, every: usize) -> Vec<usize> {
    let some: Vec<usize> =
        group.iter().enumerate().filter(|(i, _)| (i + k).is_multiple_of(every)).map(|(_, &f)| f as usize).collect();
    if some.is_empty() { vec![group[k % group.len()] as usize] } else { some }
}

/// min(V/V_90, 1)^0.1 of every row, V its volume in space and time: a Gaussian that fills much stays, even where it is
/// faint.
fn volumes(scene: &Scene<f32>, lives: &[Lives]) -> Vec<Vec<f64>> {
    let of_layer = |layer: usize| -> Vec<f64> {
        let spatial = covariances(scene, layer);
        spatial.par_iter().enumerate().map(|(r, c)| volume(*c) * lives[layer].scale(r)).collect()
    };
    let mut layers: Vec<Vec<f64>> = (0..scene.layers.len()).map(of_layer).collect();
    let mut sorted: Vec<f64> = layers.iter().flatten().copied().filter(|v| v.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let place = (VOLUME_PERCENTILE * sorted.len() as f64) as usize;
    let large = sorted.get(place.min(sorted.len().saturating_sub(1))).copied().unwrap_or(1.0).max(f64::MIN_POSITIVE);
    layers.iter_mut().flatten().for_each(|v| *v = (*v / large).clamp(0.0, 1.0).powf(VOLUME_POWER));
    layers
}

/// √det of a covariance; what rounding could have left of its thinnest axis does not make it vanish.
fn volume(covariance: [f64; 6]) -> f64 {
    let (values, _) = sym3::eigen(covariance);
    let largest = values.iter().fold(0.0, |m: f64, v| m.max(*v));
    values.iter().map(|v| v.max(THINNEST * largest)).product::<f64>().sqrt()
}
