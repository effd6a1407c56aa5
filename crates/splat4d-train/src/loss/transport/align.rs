//! The alignment of observation and filter state: D(o, F), o the result of the model inside a filter, F the state that
//! the filter makes of it and of its prediction. A model that moves steadily costs nothing.
//!
//! The gradient is propagated through both: to o itself, and through the fusion (and, with
//! `filter.stop_gradient=false`, through the prediction) to everything that F is made of, the gains among it. Without a
//! filter there is no state, and no loss.

use super::TransportConfig;
use crate::loss::terms::{ParamLoss, StepInfo};
use splat4d::layers::Scene;
use splat4d::math::{Real, Rng};
use splat4d::motion::filtered::{Filtered, Fusion, Normal};
use splat4d::motion::{At, Cache, Motion, Tape};
use splat4d::scene::table::par_split;
use splat4d::scene::{Grads, Rows, Space, SplatGrads, Table};

/// The loss; see the module's documentation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Align {
    settings: TransportConfig,
    layer: usize,
}

impl Align {
    /// On the layer of this number.
    pub(crate) fn new(settings: TransportConfig, layer: usize) -> Self {
        Self { settings, layer }
    }

    /// The schedule's factor in a step, if the step is one of those that are examined.
    fn due(&self, info: &StepInfo) -> Option<f64> {
        let rng = Rng::new(info.seed, "transport align", info.iteration as u64).fork(self.layer as u64);
        let factor = self.settings.factor(info.progress);
        (factor > 0.0 && self.settings.align > 0.0 && rng.uniform(0) < self.settings.every).then_some(factor)
    }
}

impl<F: Real> ParamLoss<F> for Align {
    fn name(&self) -> &str {
        "transport_align"
    }

    fn eval(&self, scene: &Scene<F>, info: &StepInfo, d: &mut [Grads<F>]) -> f64 {
        let (Some(factor), Some(&t), Some(layer)) = (self.due(info), info.times.first(), scene.layers.get(self.layer))
        else {
            return 0.0;
        };
        let filter = Filtered::of(layer.motion.as_ref()).filter(|f| f.settings().fusion != Fusion::Off);
        let Some(filter) = filter else { return 0.0 };
        // Those that the view sees are active in the step.
        let mut ids = Vec::new();
        let rows = if layer.active(t, &mut ids) { Rows::All } else { Rows::Some(&ids) };
        let q = At { p: &layer.params, of: Space::Gaussians, rows, t };
        if q.is_empty() {
            return 0.0;
        }
        let sides = [Side::new(filter.inner().as_ref(), &q), Side::new(layer.motion.as_ref(), &q)];
        let [seen, state] = [&sides[0].tape.out, &sides[1].tape.out];
        let weight = factor * self.settings.align / (self.settings.every.min(1.0) * q.len() as f64);
        let mut grads = [seen.zeros_like(), state.zeros_like()];
        let value = par_split(grads.each_mut().map(Table::view_mut), &|mut views| {
            let mut sum = 0.0;
            for j in views[0].first..views[0].first + views[0].rows {
                let [o, f] = [seen, state].map(|t| Normal::of_splat(t.read::<9>(j, 0)));
                let (value, d_o, d_f) = self.settings.distance(&o, &f);
                sum += weight * value;
                for (view, d) in views.iter_mut().zip([d_o, d_f]) {
                    view.write(j, 0, d.gradient::<F>().map(|x| F::of(weight) * x));
                }
            }
            sum
        });
        for (side, d_out) in sides.into_iter().zip(&grads) {
            side.backward(&q, d_out, &mut d[self.layer]);
        }
        value
    }
}

/// A model and its result to one query.
struct Side<'a, F: Real> {
    model: &'a dyn Motion<F>,
    cache: Cache,
    tape: Tape<F>,
}

impl<'a, F: Real> Side<'a, F> {
    fn new(model: &'a dyn Motion<F>, q: &At<'_, F>) -> Self {
        let (mut cache, mut tape) = (Cache::default(), Tape::default());
        model.prepare(q.p, std::slice::from_ref(q), &mut cache);
        model.at(q, &cache, &mut tape);
        Self { model, cache, tape }
    }

    fn backward(mut self, q: &At<'_, F>, d_out: &Table<F>, d: &mut Grads<F>) {
        let mut d_cache = Cache::default();
        let d_out = SplatGrads { out: d_out, color: None, weights: None };
        self.model.backward(q, &self.cache, &mut self.tape, &d_out, &mut d_cache, d);
        self.model.finish(q.p, std::slice::from_ref(q), &mut self.cache, &mut d_cache, d);
    }
}
