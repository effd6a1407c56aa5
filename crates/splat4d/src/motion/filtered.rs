//! `filtered`: a Kalman-like filter in Wasserstein geometry around any model.
//!
//! The result of the model inside at t is an observation Nₒ. From its results one frame (and one baseline more) earlier
//! follows a prediction Nₚ at constant velocity, Exp(−Log) (see [`Predictor`]). The state that is rendered is between:
//!
//! | fusion | state |
//! |---|---|
//! | `geodesic` | μ = μₚ + κ(μₒ−μₚ), Σ at κ on the geodesic from Σₚ to Σₒ; κ = 1 − w(1−K), K learnt, one per Gaussian |
//! | `literal` | K = Σₚ(Σₚ+Σₒ+εI)⁻¹, μ = μₚ + K(μₒ−μₚ), Σ = (I−K)Σₚ, scaled by w |
//!
//! w = trust · gate. Trust rises from 0 to 1 over the frame in which the clip has become long enough to predict from;
//! the gate closes where the innovation δᵀ(Σₚ+Σₒ)⁻¹δ leaves what chance explains, so that a sudden motion is followed
//! at once. All is continuous in t, between frames too. With `history` the earlier states are filtered themselves, that
//! many frames back: sequential inference with random access. Opacity and colour are the observation's.
//!
//! Gradients: exact, through all of `history`; with `stop_gradient` (the default) earlier results are constants. Nodes
//! are evaluated by the inner model.
//!
//! Source: Deng et al. 2024 ("Wasserstein 4DGS", arXiv 2412.00333); the scalar gain, the geodesic fusion, the gate's
//! fading and the baseline are ours.

mod row;
#[cfg(test)]
mod tests;

pub(crate) use row::Fused;
pub use row::{Fusion, Normal, Prediction, Predictor};

use super::{At, Cache, Capabilities, Model, Motion, Phase, Spec, Tape};
use crate::math::{Real, Rng};
use crate::scene::splats::SPLAT_COLUMNS;
use crate::scene::table::par_split;
use crate::scene::{Color, Grads, Key, Params, RowEdit, Rows, Space, SplatGrads, Table, Time};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::any::Any;
use std::sync::Arc;

/// χ² with three degrees of freedom is larger once in a hundred times.
pub(crate) const GATE: f64 = 11.3;
/// Most frames between the two states that a velocity is taken from: half a second at 30 frames per second.
pub const MAX_BASELINE: usize = 16;
/// Most frames of history: two seconds at 30 frames per second; every one is a result of the model inside.
pub const MAX_HISTORY: usize = 64;
/// Name of the table, and of its column, with the logit of every Gaussian's gain.
pub const GAINS: &str = "filter_gains";

/// The model as plain data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FilteredSpec {
    /// The model inside; never a filter itself.
    pub inner: Box<Spec>,
    /// Fusion of prediction and observation.
    pub fusion: Fusion,
    /// Method of prediction.
    pub predictor: Predictor,
    /// Share of the observation that Gaussians start with, above 0 and below 1 (geodesic fusion).
    pub gain: f64,
    /// Seconds between two frames.
    pub frame: f64,
    /// First second of the clip: nothing earlier is requested.
    pub start: f64,
    /// Frames between the two states that the velocity is taken from, 1 (as published) to [`MAX_BASELINE`]: more
    /// predicts more steadily, and later.
    pub baseline: usize,
    /// Frames before t through which the filter runs, up to [`MAX_HISTORY`]; 0: it predicts from the results of the
    /// inner model.
    pub history: usize,
    /// Squared innovation at which the prediction is dropped; 0: never.
    pub gate: f64,
    /// Whether earlier results are constants to the gradient.
    pub stop_gradient: bool,
}

impl FilteredSpec {
    /// A filter around a model, switched off, with the default of everything else.
    pub fn around(inner: Spec, frame: f64, start: f64) -> Self {
        Self {
            inner: Box::new(inner),
            fusion: Fusion::Off,
            predictor: Predictor::Wasserstein,
            gain: 0.5,
            frame,
            start,
            baseline: 1,
            history: 0,
            gate: GATE,
            stop_gradient: true,
        }
    }

    fn check(&self) -> Result<()> {
        let bad = |what: String| {
            Err(Error::input(format!("the filter's {what}"))
                .remedy("The file is damaged or was written by another program; export it again"))
        };
        if matches!(*self.inner, Spec::Filtered(_)) {
            return bad("model is a filter too; one is enough".into());
        }
        if !(self.gain > 0.0 && self.gain < 1.0) {
            return bad(format!("gain is {}, not between 0 and 1", self.gain));
        }
        if !(self.frame > 0.0 && self.frame.is_finite() && self.start.is_finite()) {
            return bad(format!("frames take {} s from {} s on", self.frame, self.start));
        }
        if !(1..=MAX_BASELINE).contains(&self.baseline) || self.history > MAX_HISTORY {
            return bad(format!(
                "baseline is {} and its history {} frames, not 1 to {MAX_BASELINE} and at most {MAX_HISTORY}",
                self.baseline, self.history
            ));
        }
        if !(self.gate >= 0.0 && self.gate.is_finite()) {
            return bad(format!("gate is {}", self.gate));
        }
        Ok(())
    }
}

impl Model for FilteredSpec {
    /// Makes the model inside, then the filter's own table.
    fn build<F: Real>(&self, p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
        self.check()?;
        let inner = super::build_as(&self.inner, p)?;
        Ok(Arc::new(Filtered::around(inner, self.clone(), p)?))
    }

    /// Those of the inner model: the filter uses only earlier times.
    fn capabilities(&self) -> Capabilities {
        self.inner.capabilities().unwrap_or_default()
    }
}

/// See the module's documentation.
pub struct Filtered<F: Real = f32> {
    spec: FilteredSpec,
    inner: Arc<dyn Motion<F>>,
    gains: Key,
}

impl<F: Real> Filtered<F> {
    /// Wraps a model that is there already, with the layer's gains if it has some. Errors: settings out of range, a
    /// loaded table of the wrong shape.
    pub fn around(inner: Arc<dyn Motion<F>>, spec: FilteredSpec, p: &mut Params<F>) -> Result<Self> {
        spec.check()?;
        let logit = F::of((spec.gain / (1.0 - spec.gain)).ln());
        let gains = match p.find(GAINS) {
            Some(key) => key,
            None => p.entry(GAINS, Space::Gaussians, &[(GAINS, 1)], p.len(), |t| t.fill(logit))?,
        };
        // Only the geodesic fusion reads it.
        p.info_mut(gains).trainable = spec.fusion == Fusion::Geodesic;
        Ok(Self { spec, inner, gains })
    }

    /// The filter that a layer moves by, if it does.
    pub fn of(motion: &dyn Motion<F>) -> Option<&Self> {
        (motion as &dyn Any).downcast_ref()
    }

    /// The model inside.
    pub fn inner(&self) -> &Arc<dyn Motion<F>> {
        &self.inner
    }

    /// The filter's settings; `inner` is as it was when the filter was made.
    pub fn settings(&self) -> &FilteredSpec {
        &self.spec
    }

    /// Weight of predictions at t, and its slope.
    fn trust(&self, t: f64) -> [f64; 2] {
        let x = (t - self.spec.start) / self.spec.frame - self.spec.baseline as f64;
        if x > 0.0 && x < 1.0 { [x, 1.0 / self.spec.frame] } else { [x.clamp(0.0, 1.0), 0.0] }
    }

    /// Whether the inner model computes the query alone.
    fn passes(&self, q: &At<'_, F>) -> bool {
        self.spec.fusion == Fusion::Off || q.of != Space::Gaussians || self.trust(q.t.0)[0] == 0.0
    }

    /// The query `frames` earlier.
    fn earlier<'a>(&self, q: &At<'a, F>, frames: usize) -> At<'a, F> {
        At { t: Time(q.t.0 - frames as f64 * self.spec.frame), ..*q }
    }

    /// How many frames earlier a fused query reads in addition to t itself.
    fn frames(&self) -> impl Iterator<Item = usize> + use<F> {
        let (baseline, history) = (self.spec.baseline, self.spec.history);
        (1..=history + 1 + baseline).filter(move |&k| k <= history + 1 || k > baseline)
    }

    /// Queries to the model inside in a step; one query a time, for all rows where queries differ in theirs.
    fn queries<'a>(&self, q: &[At<'a, F>]) -> Vec<At<'a, F>> {
        let mut all: Vec<At<'a, F>> = Vec::with_capacity(3 * q.len());
        let mut add = |new: At<'a, F>| match all.iter_mut().find(|old| old.of == new.of && old.t == new.t) {
            Some(old) => {
                let same = match (old.rows, new.rows) {
                    (Rows::Some(a), Rows::Some(b)) => a == b,
                    (Rows::All, Rows::All) => true,
                    _ => false,
                };
                if !same {
                    old.rows = Rows::All;
                }
            }
            None => all.push(new),
        };
        for q in q {
            add(*q);
            if !self.passes(q) {
                self.frames().for_each(|k| add(self.earlier(q, k)));
            }
        }
        all
    }

    fn gain(&self, q: &At<'_, F>, j: usize) -> f64 {
        q.p[self.gains].get(q.rows.id(j), 0).sigmoid().f64()
    }

    /// One row's prediction and state.
    fn row(&self, [seen, last, before]: [&Normal; 3], gain: f64, trust: f64) -> (Prediction, Fused) {
        let s = &self.spec;
        let prediction = Prediction::new(s.predictor, last, before, s.baseline);
        (prediction, Fused::new(s.fusion, seen, &prediction.point, gain, trust, s.gate))
    }

    /// Fuses all rows of a query at one time into `out`.
    fn fuse(&self, q: &At<'_, F>, [seen, last, before]: [&Table<F>; 3], out: &mut Table<F>) {
        let [trust, _] = self.trust(q.t.0);
        // Opacities, and unchanged observations, stay so to the last bit.
        out.data_mut().copy_from_slice(seen.data());
        par_split([out.view_mut()], &|[mut view]| {
            for j in view.first..view.first + view.rows {
                let [a, b, c] = [seen, last, before].map(|t| Normal::of_splat(t.read::<9>(j, 0)));
                let state = self.row([&a, &b, &c], self.gain(q, j), trust).1;
                if state.open > 0.0 {
                    view.write(j, 0, state.point.splat::<F>());
                }
            }
            0.0
        });
    }
}

/// Values that the model inside computes for a step.
#[derive(Default)]
struct Shared {
    inner: Cache,
}

/// State that a fused result keeps for its backward.
struct Own<F> {
    /// The observation.
    seen: Tape<F>,
    /// Earlier results of the model inside, by frames; unused places are empty.
    earlier: Vec<Tape<F>>,
    /// States at t and earlier, where the filter runs through its history; entry 0 is unused.
    states: Vec<Table<F>>,
    /// Gradients to the states, by frames earlier; unused places are empty.
    d: Vec<Table<F>>,
    d_gains: Table<F>,
}

impl<F> Default for Own<F>
where
    F: Real,
{
    fn default() -> Self {
        Self {
            seen: Tape::default(),
            earlier: Vec::new(),
            states: Vec::new(),
            d: Vec::new(),
            d_gains: Table::new(&[(GAINS, 1)], 0),
        }
    }
}

impl<F: Real> Own<F> {
    /// The state `frames` earlier.
    fn state(&self, frames: usize, history: usize) -> &Table<F> {
        if frames <= history { &self.states[frames] } else { &self.earlier[frames].out }
    }
}

fn inner_of<'a>(cache: &'a Cache, empty: &'a Cache) -> &'a Cache {
    cache.get::<Shared>().map_or(empty, |s| &s.inner)
}

impl<F: Real> Motion<F> for Filtered<F> {
    fn spec(&self) -> Spec {
        Spec::Filtered(FilteredSpec { inner: Box::new(self.inner.spec()), ..self.spec.clone() })
    }

    fn capabilities(&self) -> Capabilities {
        self.inner.capabilities()
    }

    fn with_phase(&self, phase: &Phase) -> Option<Arc<dyn Motion<F>>> {
        let inner = self.inner.with_phase(phase)?;
        Some(Arc::new(Self { spec: self.spec.clone(), inner, gains: self.gains }))
    }

    /// The results of the model inside, now and earlier; a state of each, and the gradients to them.
    fn scratch_bytes(&self, p: &Params<F>, rows: usize) -> u64 {
        let earlier = 1 + self.spec.history.max(self.spec.baseline + 1);
        let numbers = 3 * SPLAT_COLUMNS.iter().map(|c| c.1).sum::<usize>();
        earlier as u64 * (self.inner.scratch_bytes(p, rows) + (rows * numbers * size_of::<F>()) as u64)
    }

    fn prepare(&self, p: &Params<F>, q: &[At<'_, F>], cache: &mut Cache) {
        if self.spec.fusion == Fusion::Off {
            return self.inner.prepare(p, q, cache);
        }
        self.inner.prepare(p, &self.queries(q), &mut cache.get_or_default::<Shared>().inner);
    }

    fn at(&self, q: &At<'_, F>, cache: &Cache, tape: &mut Tape<F>) {
        if self.spec.fusion == Fusion::Off {
            return self.inner.at(q, cache, tape);
        }
        let empty = Cache::default();
        let cache = inner_of(cache, &empty);
        if self.passes(q) {
            return self.inner.at(q, cache, tape);
        }
        tape.start(q.len());
        let own = tape.own.get_or_default::<Own<F>>();
        let (baseline, history) = (self.spec.baseline, self.spec.history);
        own.earlier.resize_with(history + 2 + baseline, Tape::default);
        own.states.resize_with(history + 1, Table::default);
        self.inner.at(q, cache, &mut own.seen);
        for k in self.frames() {
            self.inner.at(&self.earlier(q, k), cache, &mut own.earlier[k]);
        }
        for k in (1..=history).rev() {
            let mut state = std::mem::take(&mut own.states[k]);
            if state.width() == 0 {
                state = tape.out.zeros_like();
            }
            state.resize(q.len());
            let tables = [&own.earlier[k].out, own.state(k + 1, history), own.state(k + 1 + baseline, history)];
            self.fuse(&self.earlier(q, k), tables, &mut state);
            own.states[k] = state;
        }
        let tables = [&own.seen.out, own.state(1, history), own.state(1 + baseline, history)];
        self.fuse(q, tables, &mut tape.out);
    }

    fn color<'a>(&self, q: &At<'a, F>, tape: &'a Tape<F>) -> Color<'a, F> {
        if self.passes(q) {
            return self.inner.color(q, tape);
        }
        self.inner.color(q, &tape.own.get::<Own<F>>().expect("`at` came first").seen)
    }

    fn backward(
        &self,
        q: &At<'_, F>,
        cache: &Cache,
        tape: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        if self.spec.fusion == Fusion::Off {
            return self.inner.backward(q, cache, tape, d_out, d_cache, d);
        }
        let empty = Cache::default();
        let cache = inner_of(cache, &empty);
        let d_cache = &mut d_cache.get_or_default::<Shared>().inner;
        if self.passes(q) {
            return self.inner.backward(q, cache, tape, d_out, d_cache, d);
        }
        let own = tape.own.get_or_default::<Own<F>>();
        let (baseline, history) = (self.spec.baseline, self.spec.history);
        let back = !self.spec.stop_gradient;
        // Gradients to states by frames earlier; each becomes that to the observation of its frame along the backward
        // chain.
        let mut d_states = std::mem::take(&mut own.d);
        d_states.resize_with(history + 2 + baseline, Table::default);
        for (k, table) in d_states.iter_mut().enumerate().filter(|(k, _)| back || [0, 1, 1 + baseline].contains(k)) {
            if table.width() == 0 {
                *table = d_out.out.zeros_like();
            }
            table.resize(q.len());
            if k > 0 {
                table.fill(F::ZERO);
            }
        }
        d_states[0].data_mut().copy_from_slice(d_out.out.data());
        let mut d_gains = std::mem::take(&mut own.d_gains);
        d_gains.resize(q.len());
        d_gains.fill(F::ZERO);
        let mut d_time = 0.0;
        for k in 0..=if back { history } else { 0 } {
            let asked = self.earlier(q, k);
            let seen = if k == 0 { &own.seen.out } else { &own.earlier[k].out };
            let [last, before] = [k + 1, k + 1 + baseline].map(|k| own.state(k, history));
            let [trust, slope] = self.trust(asked.t.0);
            let (now, earlier) = d_states[k..].split_at_mut(1);
            let (near, far) = earlier.split_at_mut(baseline);
            let views = [&mut now[0], &mut near[0], &mut far[0], &mut d_gains].map(Table::view_mut);
            d_time += slope
                * par_split(views, &|[mut d_state, mut d_last, mut d_before, mut d_gains]| {
                    let mut d_trust = 0.0;
                    for j in d_state.first..d_state.first + d_state.rows {
                        let [a, b, c] = [seen, last, before].map(|t| Normal::of_splat(t.read::<9>(j, 0)));
                        let gain = self.gain(q, j);
                        let (prediction, state) = self.row([&a, &b, &c], gain, trust);
                        let g = state.backward(&a, &Normal::of_gradient(d_state.read::<9>(j, 0)));
                        d_state.write(j, 0, g.seen.gradient::<F>());
                        d_gains.add(j, 0, [F::of(g.gain * gain * (1.0 - gain))]);
                        d_trust += g.trust;
                        if back {
                            let (to_last, to_before) = prediction.backward(&g.predicted);
                            d_last.add(j, 0, to_last.gradient::<F>());
                            d_before.add(j, 0, to_before.gradient::<F>());
                        }
                    }
                    d_trust
                });
        }
        let [to_gains] = d.of([self.gains]);
        for j in 0..q.len() {
            to_gains.add(q.rows.id(j), 0, [d_gains.get(j, 0)]);
        }
        let grads = SplatGrads { out: &d_states[0], ..*d_out };
        d_time += self.inner.backward(q, cache, &mut own.seen, &grads, d_cache, d);
        if back {
            for k in self.frames() {
                let grads = SplatGrads { out: &d_states[k], color: None, weights: None };
                d_time += self.inner.backward(&self.earlier(q, k), cache, &mut own.earlier[k], &grads, d_cache, d);
            }
        }
        (own.d, own.d_gains) = (d_states, d_gains);
        d_time
    }

    fn finish(&self, p: &Params<F>, q: &[At<'_, F>], cache: &mut Cache, d_cache: &mut Cache, d: &mut Grads<F>) {
        if self.spec.fusion == Fusion::Off {
            return self.inner.finish(p, q, cache, d_cache, d);
        }
        let cache = &mut cache.get_or_default::<Shared>().inner;
        let d_cache = &mut d_cache.get_or_default::<Shared>().inner;
        self.inner.finish(p, &self.queries(q), cache, d_cache, d);
    }

    fn on_edit(&self, p: &mut Params<F>, edit: &RowEdit, rng: &Rng) {
        self.inner.on_edit(p, edit, rng);
    }

    fn resize(&self, p: &mut Params<F>, row: usize, factor: f64) {
        self.inner.resize(p, row, factor);
    }

    fn life(&self, p: &Params<F>, out: &mut Table<F>) -> bool {
        self.inner.life(p, out)
    }

    fn velocity(&self, q: &At<'_, F>, out: &mut Table<F>) {
        if self.passes(q) { self.inner.velocity(q, out) } else { super::central_velocity(self, q, out) }
    }
}
