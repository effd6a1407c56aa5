//! Optimal transport over time, for any model: displacement of Gaussians from frame to frame, or deviation from
//! constant velocity, as distances between Gaussians instead of between parameters.
//!
//! | term | value over consecutive frames a, b, c, mean over rows |
//! |---|---|
//! | temporal | ½ (D(a, b) + D(b, c)): small motion |
//! | second | D(c, P(b, a)), P at constant velocity (log and exp): steady motion, fast or slow, costs nothing |
//! | align | D(o, F) between the model's own result o and the state F that the filter makes of it (`align.rs`) |
//!
//! D = (‖Δμ‖² + m·B²)/extent² with B² the covariances' part of W₂², or ‖Δμ‖²/extent² alone in the linear variant. The
//! multiplier m is needed because motion is 10² to 10⁴ times what shapes change (squared). Frames are those around a
//! view's own, so that one of three results already exists, in a share of the steps whose terms weigh that much more.
//!
//! Source: Deng et al. 2024 ("Wasserstein 4DGS"); second order and normalisation are ours.

mod align;

pub(crate) use align::Align;

use super::terms::{Probe, ProbeLoss, StepInfo};
use crate::settings::{Choice, settings};
use splat4d::layers::Scene;
use splat4d::math::spd::{Mat3, bures};
use splat4d::math::{Real, Rng};
use splat4d::motion::filtered::{Normal, Prediction, Predictor};
use splat4d::scene::table::par_split;
use splat4d::scene::{Space, Table, Time};
use std::sync::atomic::{AtomicU64, Ordering};

settings! {
    /// Settings of the transport losses: distances over time that training minimises.
    pub struct TransportSettings
    when (On("transport.metric")) {
        /// Distances over time that training minimises: off, linear (means) or wasserstein (Gaussians).
        metric: Option<Metric> = None => any().switch();
        /// Weight of small motion (first order), per squared extent.
        temporal: f64 = 0.0 => any().unit("1/extents²");
        /// Weight of constant velocity (second order), per squared extent.
        second: f64 = 10.0 => any().unit("1/extents²");
        /// Weight of the distance between the motion's result and the filtered one, per squared extent.
        align: f64 = 0.0 => any().unit("1/extents²").when(All(&[On("transport.metric"), On("filter.fusion")]));
        /// Weight of shapes relative to positions.
        covariance: f64 = 100.0;
        /// Share of the steps that use three frames.
        every: f64 = 0.25 => share();
        /// Share of a stage after which the loss begins.
        start: f64 = 0.2 => share();
        /// Share of a stage over which the loss reaches its weight.
        ramp: f64 = 0.13 => share();
    }
}

/// The quantities that distances are between.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Metric {
    /// Means alone.
    Linear,
    /// Gaussians.
    Wasserstein,
}

impl Choice for Option<Metric> {
    const NAMES: &'static [(&'static str, Self)] =
        &[("off", None), ("linear", Some(Metric::Linear)), ("wasserstein", Some(Metric::Wasserstein))];
}

/// Weights, metric and schedule.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct TransportConfig {
    /// The quantities that distances are between.
    pub metric: Metric,
    /// Prediction of shapes at constant velocity.
    pub predictor: Predictor,
    /// Weight of the temporal term.
    pub temporal: f64,
    /// Weight of the second-order term.
    pub second: f64,
    /// Weight of the alignment of observation and state.
    pub align: f64,
    /// m: what covariances count for, against means.
    pub covariance: f64,
    /// Lengths count in this, scene units.
    pub extent: f64,
    /// First and last second of the clip.
    pub clip: [f64; 2],
    /// Seconds between frames.
    pub frame: f64,
    /// Share of the steps in which it is computed, above 0.
    pub every: f64,
    /// Share of the stage after which the loss begins.
    pub start: f64,
    /// Share of the stage over which it then grows to its weight.
    pub ramp: f64,
}

impl TransportConfig {
    /// The weight's factor after the share `progress` of the stage.
    pub(crate) fn factor(&self, progress: f64) -> f64 {
        let past = progress - self.start;
        if past < 0.0 {
            0.0
        } else if self.ramp > 0.0 {
            (past / self.ramp).min(1.0)
        } else {
            1.0
        }
    }

    /// D and its gradients.
    pub(crate) fn distance(&self, x: &Normal, y: &Normal) -> (f64, Normal, Normal) {
        let unit = 1.0 / (self.extent * self.extent);
        let delta: [f64; 3] = std::array::from_fn(|k| x.mean[k] - y.mean[k]);
        let mut value = unit * delta.iter().map(|v| v * v).sum::<f64>();
        let mut d_x = Normal { mean: delta.map(|v| 2.0 * unit * v), ..Normal::ZERO };
        let mut d_y = Normal { mean: delta.map(|v| -2.0 * unit * v), ..Normal::ZERO };
        if self.metric == Metric::Wasserstein && self.covariance > 0.0 {
            let (b, to_x, to_y) = bures(&x.cov, &y.cov);
            let m = self.covariance * unit;
            value += m * b;
            (d_x.cov, d_y.cov) = (scaled(m, &to_x), scaled(m, &to_y));
        }
        (value, d_x, d_y)
    }
}

/// The loss; see the module's documentation.
#[derive(Debug)]
pub(crate) struct Transport {
    settings: TransportConfig,
    layer: usize,
    /// The schedule's factor in the step whose probes were queried last, as bits.
    now: AtomicU64,
}

impl Transport {
    /// On the layer of this number.
    pub(crate) fn new(settings: TransportConfig, layer: usize) -> Self {
        Self { settings, layer, now: AtomicU64::new(0) }
    }

    /// The three times of a step, if it has any.
    fn times(&self, info: &StepInfo) -> Option<[Time; 3]> {
        let s = &self.settings;
        let idle = s.temporal == 0.0 && s.second == 0.0;
        if idle || s.clip[1] - s.clip[0] < 2.0 * s.frame * (1.0 - 1e-9) || s.factor(info.progress) == 0.0 {
            return None;
        }
        let rng = Rng::new(info.seed, "transport", info.iteration as u64).fork(self.layer as u64);
        if rng.uniform(0) >= s.every {
            return None;
        }
        let own = info.times.first().map_or(s.clip[0], |t| t.0);
        // A view's time stays the number it is, so that its query is shared.
        let middle = own.max(s.clip[0] + s.frame).min(s.clip[1] - s.frame);
        Some([middle - s.frame, middle, middle + s.frame].map(Time))
    }

    /// The loss of one row in three frames, before weights by schedule and rows: value and gradients.
    pub(crate) fn row(&self, [a, b, c]: [&Normal; 3]) -> (f64, [Normal; 3]) {
        let s = &self.settings;
        let mut value = 0.0;
        let mut d = [Normal::ZERO; 3];
        if s.temporal > 0.0 {
            for (i, [x, y]) in [[a, b], [b, c]].into_iter().enumerate() {
                let (v, d_x, d_y) = s.distance(x, y);
                value += 0.5 * s.temporal * v;
                add(&mut d[i], 0.5 * s.temporal, &d_x);
                add(&mut d[i + 1], 0.5 * s.temporal, &d_y);
            }
        }
        if s.second > 0.0 {
            let predicted = Prediction::new(s.predictor, b, a, 1);
            let (v, d_seen, d_predicted) = s.distance(c, &predicted.point);
            value += s.second * v;
            add(&mut d[2], s.second, &d_seen);
            let (d_last, d_before) = predicted.backward(&d_predicted);
            add(&mut d[1], s.second, &d_last);
            add(&mut d[0], s.second, &d_before);
        }
        (value, d)
    }
}

fn scaled(factor: f64, m: &Mat3) -> Mat3 {
    m.map(|row| row.map(|x| factor * x))
}

fn add(to: &mut Normal, factor: f64, d: &Normal) {
    for k in 0..3 {
        to.mean[k] += factor * d.mean[k];
        for l in 0..3 {
            to.cov[k][l] += factor * d.cov[k][l];
        }
    }
}

impl<F: Real> ProbeLoss<F> for Transport {
    fn name(&self) -> &str {
        "transport"
    }

    fn probes(&self, scene: &Scene<F>, info: &StepInfo) -> Vec<Probe> {
        let Some(times) = self.times(info) else { return Vec::new() };
        let Some(layer) = scene.layers.get(self.layer) else { return Vec::new() };
        self.now.store(self.settings.factor(info.progress).to_bits(), Ordering::Relaxed);
        // Gaussians that no view sees in the middle frame need no smoothing.
        let mut ids = Vec::new();
        let rows = if layer.active(times[1], &mut ids) { None } else { Some(ids) };
        vec![Probe { layer: self.layer, of: Space::Gaussians, rows, times: times.to_vec() }]
    }

    fn eval(&self, _: &Scene<F>, _: &[Probe], seen: &[Vec<Table<F>>], d: &mut [Vec<Table<F>>]) -> f64 {
        let [a, b, c] = &seen[0][..] else { unreachable!("the loss requested three times") };
        if a.rows() == 0 {
            return 0.0;
        }
        let factor = f64::from_bits(self.now.load(Ordering::Relaxed));
        let weight = factor / (self.settings.every.min(1.0) * a.rows() as f64);
        let [d_a, d_b, d_c] = &mut d[0][..] else { unreachable!("a gradient has its results' shape") };
        par_split([d_a, d_b, d_c].map(Table::view_mut), &|mut views| {
            let mut sum = 0.0;
            for j in views[0].first..views[0].first + views[0].rows {
                let normals = [a, b, c].map(|t| Normal::of_splat(t.read::<9>(j, 0)));
                let (value, d) = self.row([&normals[0], &normals[1], &normals[2]]);
                sum += weight * value;
                for (view, mut d) in views.iter_mut().zip(d) {
                    d.mean = d.mean.map(|x| weight * x);
                    d.cov = scaled(weight, &d.cov);
                    view.add(j, 0, d.gradient::<F>());
                }
            }
            sum
        })
    }
}

#[cfg(test)]
mod tests;
