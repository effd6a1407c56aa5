//! [`Evaluation`]: the scene at these times, forward and backward.
//!
//! A motion model needs all queries of a step at once (`prepare`), then computes them one by one (`at`); in the
//! backward pass it takes a gradient a query (`backward`) and is notified after the last one (`finish`). That order is
//! written here, once, for training, playback, freezing, flow and baking.

#[cfg(test)]
mod tests;

use super::{Layer, LayerTape, Scene};
use crate::math::Real;
use crate::motion::{At, Cache};
use crate::scene::table::par_split;
use crate::scene::{Grads, Rows, Space, SplatGrads, Splats, Table, Time};

/// Queries to the layers of a scene, their results, and the gradients to these. No two queries have the same layer,
/// space and time. All memory is used again after [`begin`](Self::begin).
#[derive(Debug, Default)]
pub struct Evaluation<F: Real = f32> {
    queries: Vec<Query<F>>,
    spare: Vec<Query<F>>,
    /// By layer: what the motion model prepared, and the gradient to it.
    caches: Vec<(Cache, Cache)>,
}

#[derive(Debug, Default)]
struct Query<F: Real> {
    layer: usize,
    tape: LayerTape<F>,
    /// Whether the rows alive at that time are among those requested.
    alive: bool,
    /// Whether the gradients below belong to the result; otherwise they are those of an earlier one.
    begun: bool,
    d_out: Table<F>,
    d_color: Option<Table<F>>,
    d_weights: Option<Table<F>>,
    d_time: f64,
}

impl<F: Real> Evaluation<F> {
    /// A query's result: these rows of one layer at one time.
    pub fn of_layer(layer: &Layer<F>, of: Space, rows: Rows<'_>, t: Time) -> Self {
        let mut out = Self::default();
        out.request(0, of, rows, t);
        out.evaluate(std::slice::from_ref(layer));
        out
    }

    /// Forgets all queries.
    pub fn begin(&mut self) {
        self.spare.append(&mut self.queries);
    }

    /// Requests rows of a layer at a time, next to those that were requested already. Returns the query's number.
    pub fn request(&mut self, layer: usize, of: Space, rows: Rows<'_>, t: Time) -> usize {
        match self.find(layer, of, t) {
            Some(i) => {
                self.widen(i, rows);
                i
            }
            None => self.push(layer, |tape| tape.request(of, rows, t)),
        }
    }

    /// Requests the Gaussians of a layer that are alive at t, next to those that were requested already. `of` is that
    /// layer.
    /// Returns the query's number.
    pub fn request_active(&mut self, layer: usize, of: &Layer<F>, t: Time) -> usize {
        let i = match self.find(layer, Space::Gaussians, t) {
            Some(i) if self.queries[i].alive => i,
            Some(i) => {
                let mut ids = Vec::new();
                let all = of.active(t, &mut ids);
                self.widen(i, if all { Rows::All } else { Rows::Some(&ids) });
                i
            }
            None => self.push(layer, |tape| tape.request_active(of, t)),
        };
        self.queries[i].alive = true;
        i
    }

    /// Requests the rows of query i at another time. Returns the number of that query.
    pub fn request_again(&mut self, i: usize, t: Time) -> usize {
        let Query { layer, tape, .. } = &self.queries[i];
        let (layer, of) = (*layer, tape.space());
        match tape.rows() {
            Rows::All => self.request(layer, of, Rows::All, t),
            Rows::Some(ids) => {
                let ids = ids.to_vec();
                self.request(layer, of, Rows::Some(&ids), t)
            }
        }
    }

    fn push(&mut self, layer: usize, ask: impl FnOnce(&mut LayerTape<F>)) -> usize {
        let mut query = self.spare.pop().unwrap_or_default();
        (query.layer, query.alive) = (layer, false);
        ask(&mut query.tape);
        self.queries.push(query);
        self.queries.len() - 1
    }

    /// Adds rows to a query.
    fn widen(&mut self, i: usize, rows: Rows<'_>) {
        let tape = &mut self.queries[i].tape;
        match (tape.rows(), rows) {
            (Rows::All, _) => {}
            (_, Rows::All) => tape.request(tape.space(), Rows::All, tape.time()),
            (Rows::Some(a), Rows::Some(b)) => {
                let both = union(a, b);
                tape.request(tape.space(), Rows::Some(&both), tape.time());
            }
        }
    }

    /// Computes the results of all queries: `prepare` once per layer, `at` once per query. Gradients are reset.
    pub fn evaluate(&mut self, layers: &[Layer<F>]) {
        self.caches.resize_with(layers.len(), Default::default);
        for (index, (layer, (cache, d_cache))) in layers.iter().zip(&mut self.caches).enumerate() {
            *d_cache = Cache::default();
            layer.motion.prepare(&layer.params, &of_layer(&self.queries, index, layer), cache);
        }
        for q in &mut self.queries {
            layers[q.layer].at(&self.caches[q.layer].0, &mut q.tape);
            (q.begun, q.d_time) = (false, 0.0);
        }
    }

    /// Number of distinct queries.
    pub fn len(&self) -> usize {
        self.queries.len()
    }

    /// Whether nothing was queried.
    pub fn is_empty(&self) -> bool {
        self.queries.is_empty()
    }

    /// The number of the query for a layer, a space and a time.
    pub fn find(&self, layer: usize, of: Space, t: Time) -> Option<usize> {
        self.queries.iter().position(|q| q.layer == layer && q.tape.space() == of && same(q.tape.time(), t))
    }

    /// Query i and its result.
    pub fn tape(&self, i: usize) -> &LayerTape<F> {
        &self.queries[i].tape
    }

    /// All queries and results, in the order of the first requests.
    pub fn tapes(&self) -> impl ExactSizeIterator<Item = &LayerTape<F>> {
        self.queries.iter().map(|q| &q.tape)
    }

    /// The splats of a time at which all layers of `scene` were queried.
    pub fn splats<'a>(&'a self, scene: &'a Scene<F>, t: Time) -> Splats<'a, F> {
        let part = |(index, layer): (usize, &'a Layer<F>)| {
            let i = self.find(index, Space::Gaussians, t).expect("every layer was queried at the time of these splats");
            layer.part(&self.queries[i].tape)
        };
        Splats { parts: scene.layers.iter().enumerate().map(part).collect(), head: scene.head_weights() }
    }

    /// Marks the rows requested as active in `d`, the gradients of the layers.
    pub fn activate(&self, d: &mut [Grads<F>]) {
        for q in &self.queries {
            d[q.layer].activate(q.tape.space(), q.tape.rows());
        }
    }

    /// The gradient to result i, [splats, 10], to be added to.
    pub fn d_out(&mut self, i: usize) -> &mut Table<F> {
        let q = &mut self.queries[i];
        q.begin_gradient();
        &mut q.d_out
    }

    /// Adds to the gradient of result i: that of [`Part::out`](crate::scene::Part::out), of direct colours, and of
    /// weights of colours. Tables may be replaced by others with undefined numbers.
    pub(crate) fn add_gradient(
        &mut self,
        i: usize,
        out: &mut Table<F>,
        color: &mut Option<Table<F>>,
        weights: &mut Option<Table<F>>,
    ) {
        let q = &mut self.queries[i];
        if q.begun {
            add_table(&mut q.d_out, out);
            add_optional(&mut q.d_color, color.as_ref());
            add_optional(&mut q.d_weights, weights.as_ref());
        } else {
            // Nothing to add to: the caller gets the old tables to overwrite.
            q.begun = true;
            std::mem::swap(&mut q.d_out, out);
            std::mem::swap(&mut q.d_color, color);
            std::mem::swap(&mut q.d_weights, weights);
        }
    }

    /// The VJP of [`answer`](Self::evaluate): `backward` once per query, `finish` once per layer. Adds to `d`, one per
    /// layer.
    pub fn backward(&mut self, layers: &[Layer<F>], d: &mut [Grads<F>]) {
        assert_eq!(d.len(), layers.len(), "a gradient a layer is needed");
        for q in &mut self.queries {
            q.begin_gradient();
            let (cache, d_cache) = &mut self.caches[q.layer];
            let d_out = SplatGrads { out: &q.d_out, color: q.d_color.as_ref(), weights: q.d_weights.as_ref() };
            q.d_time = layers[q.layer].backward(cache, &mut q.tape, &d_out, d_cache, &mut d[q.layer]);
        }
        for (index, (layer, (cache, d_cache))) in layers.iter().zip(&mut self.caches).enumerate() {
            let queries = of_layer(&self.queries, index, layer);
            layer.motion.finish(&layer.params, &queries, cache, d_cache, &mut d[index]);
        }
    }

    /// dL/dt of a time at which Gaussians were requested, all layers together, after [`backward`](Self::backward).
    pub fn d_time(&self, t: Time) -> f64 {
        let at_t = |q: &&Query<F>| q.tape.space() == Space::Gaussians && same(q.tape.time(), t);
        self.queries.iter().filter(at_t).map(|q| q.d_time).sum()
    }
}

impl<F: Real> Query<F> {
    /// Zeros, unless there is a gradient already.
    fn begin_gradient(&mut self) {
        if !self.begun {
            reset_like(&mut self.d_out, self.tape.out());
            (self.d_color, self.d_weights, self.begun) = (None, None, true);
        }
    }
}

/// Passes the results of many queries for the Gaussians of one layer to a callback, one at a time, however many there
/// are. The motion model is notified of all of them first, so that one that scans through time does so once.
pub(crate) fn sweep<F: Real>(layer: &Layer<F>, asked: &[(Rows<'_>, Time)], mut show: impl FnMut(usize, &LayerTape<F>)) {
    let (p, of) = (&layer.params, Space::Gaussians);
    let (mut cache, mut tape) = (Cache::default(), LayerTape::default());
    let queries: Vec<At<'_, F>> = asked.iter().map(|&(rows, t)| At { p, of, rows, t }).collect();
    layer.motion.prepare(p, &queries, &mut cache);
    for (i, &(rows, t)) in asked.iter().enumerate() {
        tape.request(of, rows, t);
        layer.at(&cache, &mut tape);
        show(i, &tape);
    }
}

/// Whether two times are one, NaN included.
fn same(a: Time, b: Time) -> bool {
    a == b || (a.0.is_nan() && b.0.is_nan())
}

fn of_layer<'a, F: Real>(queries: &'a [Query<F>], index: usize, layer: &'a Layer<F>) -> Vec<At<'a, F>> {
    queries.iter().filter(|q| q.layer == index).map(|q| q.tape.query(&layer.params)).collect()
}

fn union(a: &[u32], b: &[u32]) -> Vec<u32> {
    let mut out = Vec::with_capacity(a.len() + b.len());
    let (mut i, mut j) = (0, 0);
    while i < a.len() || j < b.len() {
        let next = match (a.get(i), b.get(j)) {
            (Some(&x), Some(&y)) => x.min(y),
            (Some(&x), None) => x,
            (None, Some(&y)) => y,
            (None, None) => unreachable!("the loop's condition holds one of them"),
        };
        i += usize::from(a.get(i) == Some(&next));
        j += usize::from(b.get(j) == Some(&next));
        out.push(next);
    }
    out
}

/// Makes `d` an all-zero table in the shape of `like`, keeping the allocation.
fn reset_like<F: Real>(d: &mut Table<F>, like: &Table<F>) {
    if d.width() == like.width() {
        d.resize(like.rows());
        d.fill(F::ZERO);
    } else {
        *d = like.zeros_like();
    }
}

fn add_table<F: Real>(to: &mut Table<F>, from: &Table<F>) {
    assert_eq!((to.rows(), to.width()), (from.rows(), from.width()), "gradients of one result have one shape");
    par_split([to.view_mut()], &|[to]| {
        let from = &from.data()[to.first * to.width..];
        to.data.iter_mut().zip(from).for_each(|(a, b)| *a += *b);
        0.0
    });
}

fn add_optional<F: Real>(to: &mut Option<Table<F>>, from: Option<&Table<F>>) {
    match (to, from) {
        (Some(to), Some(from)) => add_table(to, from),
        (to @ None, Some(from)) => *to = Some(from.clone()),
        (_, None) => {}
    }
}
