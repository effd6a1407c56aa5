//! `warp`: Gaussians follow control nodes by residuals, as networks of SC-GS (Huang et al. 2024) were trained; read from
//! their files, not trained here.
//!
//! A network of a node's position p_k and of time gives a shift T_k, a residual of the quaternion r_k, of the scale d_k and,
//! with `local`, a rotation R_k = rotation((1, 0, 0, 0) + u_k) about the node. With fixed weights w_ik (a motion mask is in
//! them: their sum may be less than 1) Gaussian i has
//!
//! > x_i(t) = x_i + Σ_k w_ik [R_k (x_i − p_k) + p_k + T_k − x_i],
//! > q_i(t) = q_i + Σ_k w_ik r_k (raw), s_i(t) = |s_i + Σ_k w_ik d_k|; opacity and SH stay.
//!
//! [`control`](super::control) is our own form of this: there R_k also rotates the Gaussian, and scales stay. Gradients reach
//! the Gaussians' geometry alone; weights, nodes and network are constants, and so is the time.
//! Source: Huang et al. 2024 §3.2; yihua7/SC-GS (MIT), utils/time_utils.py, read for its equations.

use super::skin::{MAX_NEIGHBOURS, MAX_NODES};
use super::still::{activate, activate_backward};
use super::{At, Cache, Capabilities, Model, Motion, Spec, Tape, fill_rows, for_rows};
use crate::math::{Real, Rng, quat};
use crate::nn::encoding::{MAX_LEVELS, encode, encoded};
use crate::nn::{Mlp, MlpShape};
use crate::scene::params::{LOG_SCALE, QUAT};
use crate::scene::{GEOMETRY, Grads, Key, Params, Space, SplatGrads, Time};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Hidden numbers and outputs of the network that sees time first, as in [`deform`](super::deform).
pub(crate) const TIME_NET: [usize; 2] = [super::deform::TIME_WIDTH, super::deform::TIME_OUTPUTS];
/// Names of the tables: positions of the nodes, numbers of the nodes of a Gaussian and their weights.
pub(crate) const TABLES: [&str; 3] = ["warp_nodes", "warp_links", "warp_weights"];
/// Names of the networks: of time, and of position and time.
pub(crate) const NETWORKS: [&str; 2] = ["warp_time", "warp"];
/// Outputs of a node without a rotation: T 3, r 4, d 3.
const OUTPUTS: usize = 10;
/// Scales are at least this, scene units.
const MIN_SCALE: f64 = 1e-6;

/// The model as plain data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WarpSpec {
    /// First and last second: where the network's time is 0 and 1.
    pub clip: [f64; 2],
    /// Nodes.
    pub nodes: usize,
    /// Nodes that pull each Gaussian.
    pub neighbours: usize,
    /// Numbers in a hidden layer.
    pub width: usize,
    /// Hidden layers.
    pub layers: usize,
    /// The input is appended again to the output of this hidden layer.
    pub skip: Option<usize>,
    /// Levels of the encodings of position and time.
    pub levels: [usize; 2],
    /// Whether time goes through a small network first.
    pub time_net: bool,
    /// Whether nodes rotate what is around them.
    pub local: bool,
}

impl WarpSpec {
    fn check(&self) -> Result<()> {
        let bad = |what: String| {
            Err(Error::input(format!("warp: {what}"))
                .remedy("The file is damaged or was written by another program; export it again"))
        };
        let [from, to] = self.clip;
        if !(from.is_finite() && to.is_finite() && from <= to) {
            return bad(format!("the clip reaches from {from} to {to} seconds"));
        }
        if !(1..=MAX_NODES).contains(&self.nodes) || !(1..=MAX_NEIGHBOURS).contains(&self.neighbours) {
            let what = format!("{} nodes, {} of them a Gaussian,", self.nodes, self.neighbours);
            return bad(format!("{what} are not 1 to {MAX_NODES} and 1 to {MAX_NEIGHBOURS}"));
        }
        if self.levels.iter().any(|l| *l > MAX_LEVELS) {
            return bad(format!("an encoding has more than {MAX_LEVELS} levels"));
        }
        Ok(())
    }

    /// Outputs of a node.
    fn outputs(&self) -> usize {
        OUTPUTS + if self.local { 4 } else { 0 }
    }
}

/// See the module's documentation.
#[derive(Clone, Debug)]
pub(crate) struct Warp {
    spec: WarpSpec,
    nodes: Key,
    links: Key,
    weights: Key,
    time: Option<Mlp>,
    network: Mlp,
}

/// Outputs of the network at the times of a step, [nodes, outputs] each.
struct Passes<F>(Vec<(Time, Vec<F>)>);

impl<F> Default for Passes<F> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

/// A Gaussian at a time.
struct Moved<F> {
    geometry: [F; 11],
    /// Σ_k w_k (R_k − 1): the derivative of the shift in x.
    slope: [[F; 3]; 3],
    /// The derivatives of the log scales in those of the Gaussian.
    rates: [F; 3],
}

impl Model for WarpSpec {
    fn build<F: Real>(&self, p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
        Ok(Arc::new(Warp::new(self.clone(), p)?))
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities::default()
    }
}

impl Warp {
    /// As its `Model::build`; new tables are zero.
    pub(crate) fn new<F: Real>(spec: WarpSpec, p: &mut Params<F>) -> Result<Self> {
        spec.check()?;
        let (rows, k) = (p.len(), spec.neighbours);
        let nodes = p.array(TABLES[0], 3 * spec.nodes, |_| {})?;
        let links = p.entry(TABLES[1], Space::Gaussians, &[(TABLES[1], k)], rows, |_| {})?;
        let weights = p.entry(TABLES[2], Space::Gaussians, &[(TABLES[2], k)], rows, |_| {})?;
        let mut seen = encoded(1, spec.levels[1]);
        let rng = Rng::new(0, "warp", 0);
        let mut time = None;
        if spec.time_net {
            let [width, outputs] = TIME_NET;
            let shape = MlpShape { inputs: seen, width, layers: 1, skip: None, outputs };
            time = Some(Mlp::new(NETWORKS[0], shape, 0.0, rng.fork(0), p)?);
            seen = outputs;
        }
        let WarpSpec { width, layers, skip, .. } = spec;
        let inputs = encoded(3, spec.levels[0]) + seen;
        let shape = MlpShape { inputs, width, layers, skip, outputs: spec.outputs() };
        let network = Mlp::new(NETWORKS[1], shape, 0.0, rng.fork(1), p)?;
        for key in p.keys().skip_while(|key| *key != nodes).collect::<Vec<_>>() {
            p.info_mut(key).trainable = false;
        }
        Ok(Self { spec, nodes, links, weights, time, network })
    }

    /// The network's answers at t.
    fn pass<F: Real>(&self, p: &Params<F>, t: Time) -> Vec<F> {
        let [from, to] = self.spec.clip;
        let share = if to > from { ((t.0 - from) / (to - from)).clamp(0.0, 1.0) } else { 0.0 };
        let [x_levels, t_levels] = self.spec.levels;
        let mut seen = vec![F::ZERO; encoded(1, t_levels)];
        encode(&[F::of(share)], t_levels, &mut seen);
        if let Some(time) = &self.time {
            let mut made = vec![F::ZERO; time.shape().outputs];
            time.forward(p, &seen, &mut made);
            seen = made;
        }
        let (shape, split) = (self.network.shape(), encoded(3, x_levels));
        let mut x = vec![F::ZERO; self.spec.nodes * shape.inputs];
        for (row, node) in x.chunks_exact_mut(shape.inputs).zip(p[self.nodes].data().chunks_exact(3)) {
            encode(node, x_levels, &mut row[..split]);
            row[split..].copy_from_slice(&seen);
        }
        let mut out = vec![F::ZERO; self.spec.nodes * shape.outputs];
        self.network.forward(p, &x, &mut out);
        out
    }

    /// A Gaussian at t.
    fn moved<F: Real>(&self, p: &Params<F>, heads: &[F], row: usize) -> Moved<F> {
        let g: [F; 11] = p[GEOMETRY].read(row, 0);
        let (mut out, mut slope) = (g, [[F::ZERO; 3]; 3]);
        let mut grow = [F::ZERO; 3];
        let width = self.spec.outputs();
        for k in 0..self.spec.neighbours {
            let w = p[self.weights].get(row, k);
            // A number from a file may be any.
            let node = (p[self.links].get(row, k).f64() as usize).min(self.spec.nodes - 1);
            let h = &heads[node * width..(node + 1) * width];
            (0..3).for_each(|c| out[c] += w * h[c]);
            (0..4).for_each(|c| out[QUAT + c] += w * h[3 + c]);
            (0..3).for_each(|c| grow[c] += w * h[7 + c]);
            if self.spec.local {
                let turn = quat::to_rotation(quat::normalize([F::ONE + h[10], h[11], h[12], h[13]]).0);
                let center = &p[self.nodes].data()[3 * node..3 * node + 3];
                for a in 0..3 {
                    for b in 0..3 {
                        let rate = w * (turn[a][b] - if a == b { F::ONE } else { F::ZERO });
                        slope[a][b] += rate;
                        out[a] += rate * (g[b] - center[b]);
                    }
                }
            }
        }
        let least = F::of(MIN_SCALE);
        let mut rates = [F::ZERO; 3];
        for c in 0..3 {
            let before = g[LOG_SCALE + c].exp();
            let after = before + grow[c];
            if after.abs() >= least {
                rates[c] = before / after;
            }
            out[LOG_SCALE + c] = after.abs().max(least).ln();
        }
        Moved { geometry: out, slope, rates }
    }
}

impl<F: Real> Motion<F> for Warp {
    fn spec(&self) -> Spec {
        Spec::Warp(self.spec.clone())
    }

    fn prepare(&self, p: &Params<F>, q: &[At<'_, F>], cache: &mut Cache) {
        let passes: &mut Passes<F> = cache.get_or_default();
        passes.0.clear();
        for q in q {
            if !passes.0.iter().any(|(t, _)| t.0.to_bits() == q.t.0.to_bits()) {
                passes.0.push((q.t, self.pass(p, q.t)));
            }
        }
    }

    fn at(&self, q: &At<'_, F>, cache: &Cache, tape: &mut Tape<F>) {
        if q.of != Space::Gaussians {
            tape.start(0);
            return;
        }
        tape.start(q.len());
        let heads = heads(cache, q.t);
        fill_rows(&mut tape.out, q.rows, |row| activate(self.moved(q.p, heads, row).geometry));
    }

    fn backward(
        &self,
        q: &At<'_, F>,
        cache: &Cache,
        _tape: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        _d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        if q.of != Space::Gaussians {
            return 0.0;
        }
        let heads = heads(cache, q.t);
        for_rows(d.of([GEOMETRY]), q.rows, |j, row, [d_geometry]| {
            let Moved { geometry, slope, rates } = self.moved(q.p, heads, row);
            let mut g = activate_backward(geometry, d_out.out.read(j, 0));
            let shifted = [g[0], g[1], g[2]];
            for b in 0..3 {
                (0..3).for_each(|a| g[b] += slope[a][b] * shifted[a]);
                g[LOG_SCALE + b] *= rates[b];
            }
            d_geometry.add(row, 0, g);
            0.0
        });
        0.0
    }

    fn scratch_bytes(&self, _p: &Params<F>, _rows: usize) -> u64 {
        (self.spec.nodes * self.spec.outputs() * size_of::<F>()) as u64
    }
}

fn heads<F: Real>(cache: &Cache, t: Time) -> &[F] {
    let passes: &Passes<F> = cache.get().expect("prepare runs before every query");
    let found = passes.0.iter().find(|(time, _)| time.0.to_bits() == t.0.to_bits());
    &found.expect("every time of a step was prepared").1
}

#[cfg(test)]
mod tests;
