//! Correction by new images: predict, render, compare, update.
//!
//! A forecast of the next frame is rendered from the cameras and compared with their images; some steps of gradient
//! descent on the nodes' poses alone make an observation of it. Forecast and observation are fused node by node with a
//! scalar gain (the Kalman form with separate variances): K = P/(P + R), x ← x + K (x_o − x), P ← (1 − K) P, and before
//! the next frame P ← P + Q, where Q is what an ensemble's variance grows by in a frame, and R the variance of an
//! observation.

use crate::future::{Clock, predicted};
use crate::nodes::Observed;
use crate::paths::{Moment, Neighbours, Pose};
use crate::{Error, Result};
use splat4d::layers::{PREDICTED, Scene};
use splat4d::math::quat;
use splat4d::math::se3::{add, norm, scale, sub};
use splat4d::render::Backend;
use splat4d::scene::Key;
use splat4d_train::capture::frames::Frames;
use splat4d_train::maintenance::Limits;
use splat4d_train::methods::{Group, Rate, Stage};
use splat4d_train::step::loss::TrainLoss;
use splat4d_train::step::trainer::{Settings, Trainer};
use std::sync::Arc;

/// Steps on the nodes for a new frame.
const STEPS: usize = 50;
/// Their rates: of shifts, of the scene's size, and of quaternions.
const RATES: [f64; 2] = [4e-3, 5e-3];
/// Weight of D-SSIM next to L1 (Kerbl et al. 2023).
const DSSIM: f64 = 0.2;
/// Standard deviation of an observation, of the scene's size: what a pixel is, about.
const OBSERVED: f64 = 2e-3;
/// Least growth of the variance in a frame, of the observation's: no model is certain.
const LEAST_GROWTH: f64 = 0.25;

/// A filter over the nodes of a scene.
pub struct Filter<'a> {
    scene: &'a Scene<f32>,
    observed: &'a Observed,
    clock: Clock,
    /// P of every node.
    variance: Vec<f64>,
}

impl<'a> Filter<'a> {
    /// At the last observed time, of which everything is known.
    pub fn new(scene: &'a Scene<f32>, observed: &'a Observed, clock: Clock) -> Self {
        Self { scene, observed, clock, variance: vec![0.0; observed.paths.nodes()] }
    }

    /// R.
    fn noise(&self) -> f64 {
        (OBSERVED * self.observed.size).powi(2)
    }

    /// The time of the frame that [`update`](Self::update) compares with, whatever its own: poses are given, not
    /// evaluated by time.
    pub fn time(&self) -> f64 {
        self.clock.at(1)
    }

    /// The forecast of a frame, corrected by its images (`frames`, all at [`time`](Self::time)), which `backend`
    /// renders. `growth`: how much the variance of each node's forecast grew since the frame before, (scene units)².
    ///
    /// Errors: images that cannot be read, a scene that cannot be carried, a step that is not finite.
    pub fn update(
        &mut self,
        forecast: &Moment,
        growth: &[f64],
        frames: Arc<dyn Frames>,
        backend: Box<dyn Backend>,
    ) -> Result<Moment> {
        let seen = self.measure(forecast, frames, backend)?;
        let noise = self.noise();
        let mut out = Vec::with_capacity(forecast.len());
        for ((p, (x, y)), q) in self.variance.iter_mut().zip(forecast.iter().zip(&seen)).zip(growth) {
            let prior = *p + q.max(LEAST_GROWTH * noise);
            let gain = prior / (prior + noise);
            *p = (1.0 - gain) * prior;
            out.push(Pose { x: add(x.x, scale(sub(y.x, x.x), gain)), q: x.q });
        }
        let rest = self.observed.paths.last();
        Neighbours::new(rest).turn(rest, &mut out);
        Ok(out)
    }

    /// The nodes where the images have them: the forecast after some steps on its poses alone.
    fn measure(&self, forecast: &Moment, frames: Arc<dyn Frames>, backend: Box<dyn Backend>) -> Result<Moment> {
        let scene = predicted(self.scene, self.observed, std::slice::from_ref(forecast), self.clock)?;
        let rates = [("node_shifts", RATES[0] * self.observed.size), ("node_turns", RATES[1])];
        let of = |layer| rates.map(|(column, rate)| Group { layer, ..Group::new(column, Rate::constant(rate)) });
        let groups = carried(&scene).flat_map(|(layer, _)| of(layer)).collect();
        let stage = Stage { groups, ..Stage::new("nodes", STEPS) };
        let settings = Settings {
            seed: 0,
            limits: Limits { cap: scene.len(), extent: self.observed.size, min_opacity: 0.0 },
            background: scene.background,
            sh_degree: splat4d::math::sh::MAX_DEGREE,
            exposure_lr: 0.0,
        };
        let loss = TrainLoss::photometric(DSSIM);
        let mut trainer = Trainer::new(scene, vec![stage], frames, backend, loss, settings);
        while !trainer.is_done() {
            trainer.step()?.map_err(|fault| {
                Error::input("a correction of the prediction is not finite")
                    .remedy(format!("Predict without --assimilate ({})", fault.0))
            })?;
        }
        let rest = self.observed.paths.last();
        let mut sums = vec![([0.0; 3], [0.0; 4], 0.0); rest.len()];
        // A layer's nodes are moved by the images of its own Gaussians: they count by how many these are.
        for (index, keys) in carried(trainer.train_state.scene()) {
            let layer = &trainer.train_state.scene().layers[index];
            let weight = layer.params.len() as f64;
            for (k, sum) in sums.iter_mut().enumerate() {
                // Two keys: shifts 3 + 3, then turns 4 + 4.
                let shift = layer.params[keys].read::<3>(k, 3).map(f64::from);
                let turn = layer.params[keys].read::<4>(k, 10).map(f64::from);
                sum.0 = add(sum.0, scale(shift, weight));
                (0..4).for_each(|c| sum.1[c] += weight * (turn[c] + if c == 0 { 1.0 } else { 0.0 }));
                sum.2 += weight;
            }
        }
        let pose = |(k, (shift, q, weight)): (usize, ([f64; 3], [f64; 4], f64))| Pose {
            x: add(rest[k].x, scale(shift, 1.0 / weight)),
            q: quat::normalize(q).0,
        };
        let out: Moment = sums.into_iter().enumerate().map(pose).collect();
        assert!(out.iter().all(|p| norm(p.x).is_finite()), "a predicted scene has a layer that nodes carry");
        Ok(out)
    }
}

/// Layers of a predicted scene that nodes carry, and their tables of keys.
fn carried(scene: &Scene<f32>) -> impl Iterator<Item = (usize, Key)> + '_ {
    let layers = scene.layers.iter().enumerate().filter(|(_, l)| l.name.starts_with(PREDICTED));
    layers.filter_map(|(i, l)| Some((i, l.params.find("node_keys")?)))
}

#[cfg(test)]
mod tests;
