//! `filtered`: any program with a temporal filter around its model, and the transport losses on any model.
//!
//! The inner program's stages are not changed; the filter is there from the start, switched off, and is switched on in
//! the middle of the stage that runs then, without effect on schedules. Hooks of the inner method get its own model:
//! the filter is removed around them. At the end the filter is disabled and the network kept, unless the recipe states
//! otherwise: the filter has then taught the model to move steadily, and playing costs no more than without.

use super::{Group, Hook, InitialMotion, Method, Stage, TrainContext};
use crate::Result;
use crate::loss::TransportSettings;
use crate::loss::transport::{Align, Transport, TransportConfig};
use crate::maintenance::Once;
use crate::settings::{Choice, settings};
use splat4d::layers::{Layer, Scene};
use splat4d::motion::filtered::{Filtered, FilteredSpec, Fusion, GAINS, MAX_BASELINE, MAX_HISTORY, Predictor};
use splat4d::motion::{Motion, Spec, build};
use splat4d::scene::params::LoadedArray;
use splat4d::scene::{LifeKind, Params, SH};
use std::sync::Arc;

settings! {
    /// Settings of the temporal filter around a motion model.
    pub struct FilterSettings
    when (On("filter.fusion")) {
        /// Fusion of prediction and the motion's result: off, geodesic (a learned share) or literal (as published).
        fusion: Fusion = Fusion::Off => any().switch();
        /// Prediction of shapes: wasserstein (log and exp), euclidean (linear) or hold (constant).
        predictor: Predictor = Predictor::Wasserstein
            => any().switch().when(Any(&[On("filter.fusion"), On("transport.metric")]));
        /// Share of the iterations after which the filter is switched on.
        start: f64 = 0.2 => share();
        /// Share of the iterations after which the filter is removed and the motion continues to learn; 1: never.
        until: f64 = 1.0 => share();
        /// Initial share of the motion's result; the rest is the prediction.
        gain: f64 = 0.5 => inside_share();
        /// Rate of the gains' logits.
        lr: f64 = 0.01;
        /// Frames between the two states that give a velocity.
        baseline: usize = 1 => within(1, MAX_BASELINE).unit("frames");
        /// Frames of history that the filter processes for every result; 0: it predicts from the motion's results.
        history: usize = 0 => within(0, MAX_HISTORY).unit("frames");
        /// Squared Mahalanobis distance above which a prediction is dropped; 0: never.
        gate: f64 = 11.3;
        /// Whether the gradient stops at earlier frames.
        stop_gradient: bool = true;
        /// Whether the saved scene includes the filter; otherwise only the motion is saved, which plays faster.
        keep: bool = false;
    }
}

impl Choice for Fusion {
    const NAMES: &'static [(&'static str, Self)] = &Self::ALL;
}

impl Choice for Predictor {
    const NAMES: &'static [(&'static str, Self)] = &Self::ALL;
}

/// The program with a filter and transport losses around it; unchanged if both are off.
pub(crate) fn wrap(inner: Box<dyn Method>, filter: &FilterSettings, transport: &TransportSettings) -> Box<dyn Method> {
    if filter.fusion == Fusion::Off && transport.metric.is_none() {
        return inner;
    }
    Box::new(FilteredMethod { inner, filter: filter.clone(), transport: transport.clone() })
}

/// See the module's documentation.
pub(crate) struct FilteredMethod {
    inner: Box<dyn Method>,
    filter: FilterSettings,
    transport: TransportSettings,
}

impl Method for FilteredMethod {
    fn spec(&self, plan: &TrainContext) -> Spec {
        let filter = &self.filter;
        let inner = self.inner.spec(plan);
        if filter.fusion == Fusion::Off {
            return inner;
        }
        Spec::Filtered(FilteredSpec {
            predictor: filter.predictor,
            gain: filter.gain,
            baseline: filter.baseline,
            history: filter.history,
            gate: filter.gate,
            stop_gradient: filter.stop_gradient,
            ..FilteredSpec::around(inner, 1.0 / plan.fps, plan.clip[0])
        })
    }

    fn build(&self, plan: &TrainContext, params: &mut Params) -> Result<Arc<dyn Motion>> {
        let inner = self.inner.build(plan, params)?;
        match self.spec(plan) {
            Spec::Filtered(spec) => Ok(Arc::new(Filtered::around(inner, spec, params)?)),
            _ => Ok(inner),
        }
    }

    fn life(&self, plan: &TrainContext) -> LifeKind {
        self.inner.life(plan)
    }

    fn check(&self, plan: &TrainContext) -> Result<()> {
        let filter = &self.filter;
        let off_early = filter.until < 1.0;
        if filter.fusion != Fusion::Off && off_early && (filter.until <= filter.start || filter.keep) {
            return Err(crate::Error::input(format!("the filter is taken off at filter.until={}", filter.until))
                .remedy("Lower filter.start, and leave filter.keep out"));
        }
        self.inner.check(plan)
    }

    fn one_time(&self, plan: &TrainContext) -> bool {
        self.inner.one_time(plan)
    }

    fn first(&self, plan: &TrainContext) -> TrainContext {
        self.inner.first(plan)
    }

    fn allows_layers(&self) -> bool {
        self.inner.allows_layers()
    }

    fn has_features(&self) -> bool {
        self.inner.has_features()
    }

    fn nodes(&self, plan: &TrainContext) -> usize {
        self.inner.nodes(plan)
    }

    fn growth_bytes(&self, plan: &TrainContext, rows: usize) -> u64 {
        self.inner.growth_bytes(plan, rows)
    }

    fn init(&self, plan: &TrainContext, beginnings: &[InitialMotion], params: &mut Params) {
        self.inner.init(plan, beginnings, params);
    }

    fn tuning(&self, plan: &TrainContext) -> Stage {
        self.inner.tuning(plan)
    }

    fn stages(&self, plan: &TrainContext) -> Vec<Stage> {
        let filter = &self.filter;
        let mut stages = self.inner.stages(plan);
        if let Some(settings) = self.transport(plan) {
            for stage in &mut stages {
                stage.probes.push(Box::new(Transport::new(settings, 0)));
                if settings.align > 0.0 {
                    stage.params.push(Box::new(Align::new(settings, 0)));
                }
            }
        }
        let fusion = filter.fusion;
        if fusion == Fusion::Off {
            return stages;
        }
        for stage in &mut stages {
            stage.groups.push(Group { layer: super::EVERY, ..Group::new(GAINS, plan.common.rates.falling(filter.lr)) });
            stage.start = stage.start.take().map(around);
            stage.end = stage.end.take().map(around);
        }
        switch(&mut stages, filter.start, fusion);
        if filter.until < 1.0 {
            switch(&mut stages, filter.until, Fusion::Off);
        }
        if let (Some(last), false) = (stages.last_mut(), filter.keep) {
            let before = last.end.take();
            last.end = Some(Box::new(move |scene, progress| {
                if let Some(hook) = &before {
                    hook(scene, progress)?;
                }
                scene.layers.iter_mut().try_for_each(take_off)
            }));
        }
        stages
    }
}

/// Switches the filter after a share of all steps, in the stage that runs then.
fn switch(stages: &mut [Stage], share: f64, fusion: Fusion) {
    let total: usize = stages.iter().map(|s| s.iterations).sum();
    let mut left = (share * total as f64).round() as usize;
    for stage in stages {
        if left >= stage.iterations.max(1) {
            left -= stage.iterations;
            continue;
        }
        let set = move |scene: &mut Scene<f32>| scene.layers.iter_mut().try_for_each(|l| set_fusion(l, fusion));
        stage.keep(Once { at: left, change: set });
        return;
    }
}

impl FilteredMethod {
    /// The transport loss, where the settings switch it on.
    fn transport(&self, plan: &TrainContext) -> Option<TransportConfig> {
        let transport = &self.transport;
        Some(TransportConfig {
            metric: transport.metric?,
            predictor: self.filter.predictor,
            temporal: transport.temporal,
            second: transport.second,
            align: transport.align,
            covariance: transport.covariance,
            extent: plan.extent,
            clip: plan.clip,
            frame: 1.0 / plan.fps,
            every: transport.every,
            start: transport.start,
            ramp: transport.ramp,
        })
    }
}

fn set_fusion(layer: &mut Layer, fusion: Fusion) -> Result<()> {
    let Some(filter) = Filtered::of(layer.motion.as_ref()) else { return Ok(()) };
    let spec = FilteredSpec { fusion, ..filter.settings().clone() };
    layer.motion = Arc::new(Filtered::around(filter.inner().clone(), spec, &mut layer.params)?);
    Ok(())
}

/// A hook of the inner program: layers show it the model inside, and get their filter back.
fn around(hook: Hook) -> Hook {
    Box::new(move |scene: &mut Scene<f32>, progress| {
        let mut kept = Vec::new();
        for layer in &mut scene.layers {
            let Some(filter) = Filtered::of(layer.motion.as_ref()) else { continue };
            kept.push(filter.settings().clone());
            layer.motion = filter.inner().clone();
        }
        hook(scene, progress)?;
        // Layers that a hook adds or replaces are filtered as the others are.
        let Some(spec) = kept.first() else { return Ok(()) };
        for layer in &mut scene.layers {
            let spec = FilteredSpec { inner: Box::new(layer.motion.spec()), ..spec.clone() };
            layer.motion = Arc::new(Filtered::around(layer.motion.clone(), spec, &mut layer.params)?);
        }
        Ok(())
    })
}

/// Leaves the model inside, and none of the filter's numbers, as if it had been read from a file without them.
fn take_off(layer: &mut Layer) -> Result<()> {
    let Some(filter) = Filtered::of(layer.motion.as_ref()) else { return Ok(()) };
    let (spec, old) = (filter.inner().spec(), &layer.params);
    let mut loaded = Vec::new();
    for key in old.keys().filter(|&k| old.info(k).name != GAINS) {
        let table = &old[key];
        let mut first = 0;
        for column in table.columns().iter().filter(|c| c.width > 0) {
            let (name, width) = (column.name.to_string(), column.width);
            loaded.push(LoadedArray { name, rows: table.rows(), width, data: table.column_to_rows(first, width) });
            first += width;
        }
    }
    let mut params = Params::build(loaded, old.len(), old[SH].width() / 3, layer.life.columns())?;
    layer.motion = build(&spec, &mut params)?;
    layer.params = params;
    Ok(())
}
