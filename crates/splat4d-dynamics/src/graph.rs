//! M3: accelerations of nodes by messages along edges, equivariant under rotations and translations of the whole scene
//! (after Satorras et al. 2021, "E(n) equivariant graph neural networks").
//!
//! With r = x_j − x_k, ℓ = |r|, w = v_j − v_k along an edge, unit gravity g and vectors u of actions, invariants s =
//! (ℓ/L, (ℓ − rest)/S, |w|²/S², r·w/(ℓS), r·g/L) of edges and (|v|²/S², v·g/S, height/L, |u|², u·v/S, scalars) of
//! nodes:
//!
//! > h⁰ = φ_in(e, node's invariants), m_kj = φ_e(h_k, h_j, s), h_k ← h_k + φ_h(h_k, Σ_j m_kj / √8),
//! > a_k / A = Σ_j (r/ℓ·c₁ + w/S·c₂) + v_k/S·c₃ + g·c₄ + Σ u·c₅, (c₁, c₂) = φ_x(h_k + h_j, s₁₋₄), (c₃…) = φ_v(h_k).
//!
//! φ_x uses only features that both ends share, so that forces along edges are opposite and equal; without the node's
//! terms (`momentum`) Σ v is conserved. Time is counted in frames: v ← v + a, x ← x + v (semi-implicit Euler). L, S and
//! A are the scales of positions, velocities and accelerations as observed. Positions enter only as differences, and as
//! height over a floor.

#[cfg(test)]
mod tests;

use crate::learnt::{Action, InputGrads, Network, Scales, State, put, row};
use crate::optimise::no_gaussians;
use crate::paths::{Moment, nearest};
use splat4d::Result;
use splat4d::math::se3::{norm, sub};
use splat4d::math::vec3::dot;
use splat4d::math::{Real, Rng};
use splat4d::nn::{InputGrad, LayerOutputs, Mlp, MlpShape, Passed};
use splat4d::scene::{Grads, Key, Params};

/// Neighbours at rest.
const NEIGHBOURS: usize = 8;
/// Nodes nearer than this share of L are neighbours whatever they were at rest: contact.
const CONTACT: f64 = 0.1;
/// Learnt numbers of a node.
const EMBEDDING: usize = 16;
/// Invariants of an edge; the first [`SHARED`] are the same seen from either end.
const INVARIANTS: usize = 5;
const SHARED: usize = 4;
/// Invariants of a node, without actions.
const OWN: usize = 3;
/// The last maps start at this share: nearly no force.
const FIRST: f64 = 0.1;
/// Added to lengths, of L: coinciding nodes have no direction.
const SOFT: f64 = 1e-6;

/// Shape and physics of the network.
#[derive(Clone, Debug, PartialEq)]
pub struct GraphSpec {
    /// Hidden numbers.
    pub width: usize,
    /// Rounds of messages.
    pub layers: usize,
    /// Unit vector of gravity.
    pub gravity: Option<[f64; 3]>,
    /// Height of the floor against gravity, scene units.
    pub floor: Option<f64>,
    /// Only forces along edges: momentum is conserved.
    pub momentum: bool,
    /// Vectors and scalars of an action.
    pub actions: [usize; 2],
}

impl Default for GraphSpec {
    /// 64 numbers, four rounds, no prior knowledge of the world.
    fn default() -> Self {
        Self { width: 64, layers: 4, gravity: None, floor: None, momentum: false, actions: [0, 0] }
    }
}

/// The network. Weights are in a [`Params`].
#[derive(Clone, Debug)]
pub struct GraphNet {
    spec: GraphSpec,
    scales: Scales,
    /// \[nodes]: neighbours at rest with their distances; both ends list an edge.
    ties: Vec<Vec<(usize, f64)>>,
    embedding: Key,
    first: Mlp,
    edges: Vec<Mlp>,
    nodes: Vec<Mlp>,
    along: Mlp,
    own: Mlp,
}

/// A forward step, for its backward.
#[derive(Clone, Debug, Default)]
pub struct Step<F> {
    state: State<F>,
    actions: Vec<Action<F>>,
    edges: Vec<Edge<F>>,
    inputs: Vec<(Vec<F>, LayerOutputs<F>)>,
    along: Vec<F>,
    own: Vec<F>,
}

#[derive(Clone, Copy, Debug)]
struct Edge<F> {
    k: usize,
    j: usize,
    r: [F; 3],
    w: [F; 3],
    length: F,
    rest: F,
}

impl GraphNet {
    /// A network for nodes positioned like `rest`, and its weights.
    ///
    /// Errors: a width or a number of layers that no perceptron has.
    pub fn new<F: Real>(spec: GraphSpec, scales: Scales, rest: &Moment, seed: u64) -> Result<(Self, Params<F>)> {
        let mut p = no_gaussians();
        let rng = |part: u64| Rng::new(seed, "graph", part);
        let embedding = p.array("embedding", EMBEDDING * rest.len(), |e| {
            e.iter_mut().enumerate().for_each(|(i, e)| *e = F::of(0.1 * rng(0).normal(i as u64)));
        })?;
        let w = spec.width;
        let shape = |inputs, outputs| MlpShape { inputs, width: w, layers: 1, skip: None, outputs };
        let [vectors, scalars] = spec.actions;
        let inputs = EMBEDDING + OWN + 2 * vectors + scalars;
        let first = Mlp::new("first", shape(inputs, w), 1.0, rng(1), &mut p)?;
        let (mut edges, mut nodes) = (Vec::new(), Vec::new());
        for l in 0..spec.layers as u64 {
            edges.push(Mlp::new(&format!("edges.{l}"), shape(2 * w + INVARIANTS, w), 1.0, rng(2 + 2 * l), &mut p)?);
            nodes.push(Mlp::new(&format!("nodes.{l}"), shape(2 * w, w), FIRST, rng(3 + 2 * l), &mut p)?);
        }
        let last = 2 + 2 * spec.layers as u64;
        let along = Mlp::new("along", shape(w + SHARED, 2), FIRST, rng(last), &mut p)?;
        let own = Mlp::new("own", shape(w, 2 + vectors), FIRST, rng(last + 1), &mut p)?;
        let mut ties = vec![Vec::new(); rest.len()];
        for (k, near) in nearest(rest, NEIGHBOURS).into_iter().enumerate() {
            for j in near {
                let d = norm(sub(rest[j].x, rest[k].x));
                ties[k].push((j, d));
                ties[j].push((k, d));
            }
        }
        for tie in &mut ties {
            tie.sort_by_key(|t| t.0);
            tie.dedup_by_key(|t| t.0);
        }
        Ok((Self { spec, scales, ties, embedding, first, edges, nodes, along, own }, p))
    }

    fn gravity<F: Real>(&self) -> [F; 3] {
        self.spec.gravity.unwrap_or([0.0; 3]).map(F::of)
    }

    /// Edges of all graphs: those at rest, and nodes that are near now.
    fn find_edges<F: Real>(&self, s: &State<F>, out: &mut Vec<Edge<F>>) {
        out.clear();
        let n = self.ties.len();
        let (reach, soft) = (CONTACT * self.scales.length, F::of((SOFT * self.scales.length).powi(2)));
        for first in (0..s.x.len() / 3).step_by(n) {
            for k in 0..n {
                let mut tie = self.ties[k].iter().peekable();
                for j in (0..n).filter(|&j| j != k) {
                    let tied = tie.next_if(|t| t.0 == j).map(|t| t.1);
                    let (a, b) = (row(&s.x, first + k), row(&s.x, first + j));
                    let r: [F; 3] = std::array::from_fn(|c| b[c] - a[c]);
                    let length = (dot(r, r) + soft).sqrt();
                    if tied.is_none() && length.f64() > reach {
                        continue;
                    }
                    let (a, b) = (row(&s.v, first + k), row(&s.v, first + j));
                    let w = std::array::from_fn(|c| b[c] - a[c]);
                    let rest = F::of(tied.unwrap_or(reach));
                    out.push(Edge { k: first + k, j: first + j, r, w, length, rest });
                }
            }
        }
    }

    fn invariants<F: Real>(&self, e: &Edge<F>) -> [F; INVARIANTS] {
        let [l, s] = [self.scales.length, self.scales.velocity].map(|x| F::of(1.0 / x));
        [
            e.length * l,
            (e.length - e.rest) * s,
            dot(e.w, e.w) * s * s,
            dot(e.r, e.w) / e.length * s,
            dot(e.r, self.gravity()) * l,
        ]
    }

    /// Adds the gradient of [`invariants`](Self::invariants) to those of r and w.
    fn invariants_backward<F: Real>(&self, e: &Edge<F>, d: &[F], d_r: &mut [F; 3], d_w: &mut [F; 3]) {
        let [l, s] = [self.scales.length, self.scales.velocity].map(|x| F::of(1.0 / x));
        let g = self.gravity();
        let closing = dot(e.r, e.w) / e.length;
        let along = d[0] * l + d[1] * s - d[3] * s * closing / e.length;
        for c in 0..3 {
            d_r[c] += along * e.r[c] / e.length + d[3] * s * e.w[c] / e.length;
            d_w[c] += F::TWO * d[2] * s * s * e.w[c] + d[3] * s * e.r[c] / e.length;
            if d.len() > SHARED {
                d_r[c] += d[4] * l * g[c];
            }
        }
    }

    /// Input of the first map, a row per node.
    fn own_inputs<F: Real>(&self, p: &Params<F>, s: &State<F>, actions: &[Action<F>]) -> Vec<F> {
        let (n, [vectors, _]) = (self.ties.len(), self.spec.actions);
        let [l, v1] = [self.scales.length, self.scales.velocity].map(|x| F::of(1.0 / x));
        let g = self.gravity();
        let mut out = Vec::new();
        for i in 0..s.x.len() / 3 {
            let (x, v) = (row(&s.x, i), row(&s.v, i));
            out.extend_from_slice(&p[self.embedding].data()[EMBEDDING * (i % n)..][..EMBEDDING]);
            let height = self.spec.floor.map_or(F::ZERO, |f| (-dot(x, g) - F::of(f)) * l);
            out.extend([dot(v, v) * v1 * v1, dot(v, g) * v1, height]);
            let action = &actions[i / n];
            for u in 0..vectors {
                let u = row(action, u);
                out.extend([dot(u, u), dot(u, v) * v1]);
            }
            out.extend_from_slice(&action[3 * vectors..]);
        }
        out
    }

    fn sum<F: Real>(&self, s: &State<F>, actions: &[Action<F>], step: &Step<F>) -> Vec<F> {
        let (rows, [vectors, _]) = (s.x.len() / 3, self.spec.actions);
        let (big, v1, g) = (F::of(self.scales.acceleration), F::of(1.0 / self.scales.velocity), self.gravity());
        let mut a = vec![F::ZERO; 3 * rows];
        for (e, c) in step.edges.iter().zip(step.along.chunks_exact(2)) {
            put(&mut a, e.k, big * c[0] / e.length, e.r);
            put(&mut a, e.k, big * c[1] * v1, e.w);
        }
        for (i, c) in step.own.chunks_exact(2 + vectors).enumerate() {
            put(&mut a, i, big * c[0] * v1, row(&s.v, i));
            put(&mut a, i, big * c[1], g);
            (0..vectors).for_each(|u| put(&mut a, i, big * c[2 + u], row(&actions[i / self.ties.len()], u)));
        }
        a
    }

    fn own_inputs_backward<F: Real>(&self, step: &Step<F>, d_x: &[F], to: InputGrads<'_, F>, d: &mut Grads<F>) {
        let InputGrads { state: d_state, actions: d_actions } = to;
        let (n, [vectors, scalars]) = (self.ties.len(), self.spec.actions);
        let [l, v1] = [self.scales.length, self.scales.velocity].map(|x| F::of(1.0 / x));
        let g = self.gravity();
        let [d_embedding] = d.of([self.embedding]);
        for (i, d_x) in d_x.chunks_exact(EMBEDDING + OWN + 2 * vectors + scalars).enumerate() {
            let sum = &mut d_embedding.data_mut()[EMBEDDING * (i % n)..][..EMBEDDING];
            sum.iter_mut().zip(d_x).for_each(|(s, g)| *s += *g);
            let own = &d_x[EMBEDDING..];
            put(&mut d_state.v, i, F::TWO * own[0] * v1 * v1, row(&step.state.v, i));
            put(&mut d_state.v, i, own[1] * v1, g);
            if self.spec.floor.is_some() {
                put(&mut d_state.x, i, -own[2] * l, g);
            }
            let (action, d_action) = (&step.actions[i / n], &mut d_actions[i / n]);
            for u in 0..vectors {
                let [d_square, d_along] = [own[OWN + 2 * u], own[OWN + 2 * u + 1]];
                put(&mut d_state.v, i, d_along * v1, row(action, u));
                put(d_action, u, F::TWO * d_square, row(action, u));
                put(d_action, u, d_along * v1, row(&step.state.v, i));
            }
            d_action[3 * vectors..].iter_mut().zip(&own[OWN + 2 * vectors..]).for_each(|(d, g)| *d += *g);
        }
    }
}

impl Network for GraphNet {
    type Tape<F: Real> = Step<F>;

    fn nodes(&self) -> usize {
        self.ties.len()
    }

    fn scales(&self) -> Scales {
        self.scales
    }

    fn accelerations<F: Real>(
        &self,
        p: &Params<F>,
        s: &State<F>,
        actions: &[Action<F>],
        _hidden: &mut Vec<F>,
        step: &mut Step<F>,
    ) -> Vec<F> {
        let (rows, w) = (s.x.len() / 3, self.spec.width);
        step.state = s.clone();
        step.actions = actions.to_vec();
        self.find_edges(s, &mut step.edges);
        let count = step.edges.len();
        step.inputs.clear();
        let mut pass = |mlp: &Mlp, x: Vec<F>, rows: usize| {
            let mut out = vec![F::ZERO; rows * mlp.shape().outputs];
            let mut kept = LayerOutputs::default();
            mlp.forward_keeping(p, &x, &mut out, &mut kept);
            step.inputs.push((x, kept));
            out
        };
        let mut h = pass(&self.first, self.own_inputs(p, s, actions), rows);
        let invariants: Vec<[F; INVARIANTS]> = step.edges.iter().map(|e| self.invariants(e)).collect();
        for (edges, nodes) in self.edges.iter().zip(&self.nodes) {
            let mut x = Vec::with_capacity(count * (2 * w + INVARIANTS));
            for (e, s) in step.edges.iter().zip(&invariants) {
                x.extend_from_slice(&h[e.k * w..][..w]);
                x.extend_from_slice(&h[e.j * w..][..w]);
                x.extend_from_slice(s);
            }
            let messages = pass(edges, x, count);
            let mut x = vec![F::ZERO; rows * 2 * w];
            (0..rows).for_each(|i| x[2 * w * i..][..w].copy_from_slice(&h[w * i..][..w]));
            for (e, m) in step.edges.iter().zip(messages.chunks_exact(w)) {
                let sum = &mut x[2 * w * e.k + w..][..w];
                sum.iter_mut().zip(m).for_each(|(s, m)| *s += share::<F>() * *m);
            }
            let change = pass(nodes, x, rows);
            h.iter_mut().zip(&change).for_each(|(h, c)| *h += *c);
        }
        let mut x = Vec::with_capacity(count * (w + SHARED));
        for (e, s) in step.edges.iter().zip(&invariants) {
            x.extend((0..w).map(|i| h[e.k * w + i] + h[e.j * w + i]));
            x.extend_from_slice(&s[..SHARED]);
        }
        step.along = pass(&self.along, x, count);
        step.own = if self.spec.momentum { Vec::new() } else { pass(&self.own, h, rows) };
        self.sum(s, actions, step)
    }

    fn backward<F: Real>(
        &self,
        p: &Params<F>,
        step: &Step<F>,
        d_a: &[F],
        d_inputs: InputGrads<'_, F>,
        _d_hidden: &mut Vec<F>,
        d: &mut Grads<F>,
    ) {
        let InputGrads { state: d_state, actions: d_actions } = d_inputs;
        let (s, w, rows) = (&step.state, self.spec.width, step.state.x.len() / 3);
        let [vectors, _] = self.spec.actions;
        let (big, v1, g) = (F::of(self.scales.acceleration), F::of(1.0 / self.scales.velocity), self.gravity());
        let mut at = step.inputs.len();
        let mut back = |mlp: &Mlp, d_out: &[F], d: &mut Grads<F>| {
            at -= 1;
            let (x, kept) = &step.inputs[at];
            let mut d_x = vec![F::ZERO; x.len()];
            mlp.backward(p, Passed::kept(x, kept), d_out, InputGrad::Overwrite(&mut d_x), d);
            d_x
        };
        let mut d_h = vec![F::ZERO; rows * w];
        if !step.own.is_empty() {
            let mut d_own = vec![F::ZERO; step.own.len()];
            for (i, (c, d_c)) in step.own.chunks_exact(2 + vectors).zip(d_own.chunks_exact_mut(2 + vectors)).enumerate()
            {
                let d_a = row(d_a, i);
                d_c[0] = big * v1 * dot(d_a, row(&s.v, i));
                d_c[1] = big * dot(d_a, g);
                for u in 0..vectors {
                    d_c[2 + u] = big * dot(d_a, row(&step.actions[i / self.ties.len()], u));
                    put(&mut d_actions[i / self.ties.len()], u, big * c[2 + u], d_a);
                }
                put(&mut d_state.v, i, big * v1 * c[0], d_a);
            }
            d_h = back(&self.own, &d_own, d);
        }
        let mut d_rw = vec![[[F::ZERO; 3]; 2]; step.edges.len()];
        let mut d_along = Vec::with_capacity(step.along.len());
        for ((e, c), [d_r, d_w]) in step.edges.iter().zip(step.along.chunks_exact(2)).zip(&mut d_rw) {
            let d_a = row(d_a, e.k);
            let onto = dot(d_a, e.r) / e.length;
            d_along.extend([big * onto, big * v1 * dot(d_a, e.w)]);
            for i in 0..3 {
                d_r[i] += big * c[0] / e.length * (d_a[i] - onto * e.r[i] / e.length);
                d_w[i] += big * v1 * c[1] * d_a[i];
            }
        }
        let d_x = back(&self.along, &d_along, d);
        for ((e, d_x), [d_r, d_w]) in step.edges.iter().zip(d_x.chunks_exact(w + SHARED)).zip(&mut d_rw) {
            for i in 0..w {
                d_h[e.k * w + i] += d_x[i];
                d_h[e.j * w + i] += d_x[i];
            }
            self.invariants_backward(e, &d_x[w..], d_r, d_w);
        }
        for (edges, nodes) in self.edges.iter().zip(&self.nodes).rev() {
            let d_x = back(nodes, &d_h, d);
            let d_messages: Vec<F> =
                step.edges.iter().flat_map(|e| d_x[2 * w * e.k + w..][..w].iter().map(|g| share::<F>() * *g)).collect();
            for i in 0..rows {
                d_h[w * i..][..w].iter_mut().zip(&d_x[2 * w * i..][..w]).for_each(|(h, g)| *h += *g);
            }
            let d_x = back(edges, &d_messages, d);
            for ((e, d_x), [d_r, d_w]) in step.edges.iter().zip(d_x.chunks_exact(2 * w + INVARIANTS)).zip(&mut d_rw) {
                for i in 0..w {
                    d_h[e.k * w + i] += d_x[i];
                    d_h[e.j * w + i] += d_x[w + i];
                }
                self.invariants_backward(e, &d_x[2 * w..], d_r, d_w);
            }
        }
        for (e, [d_r, d_w]) in step.edges.iter().zip(&d_rw) {
            for (of, g) in [(&mut d_state.x, d_r), (&mut d_state.v, d_w)] {
                put(of, e.j, F::ONE, *g);
                put(of, e.k, -F::ONE, *g);
            }
        }
        let d_x = back(&self.first, &d_h, d);
        self.own_inputs_backward(step, &d_x, InputGrads { state: d_state, actions: d_actions }, d);
    }
}

/// Messages are as many as neighbours at rest: their sum keeps the size of one.
fn share<F: Real>() -> F {
    F::of(1.0 / (NEIGHBOURS as f64).sqrt())
}
