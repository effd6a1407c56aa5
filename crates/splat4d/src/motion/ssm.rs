//! `ssm`: control nodes driven by a diagonal state-space model (our design on S4D, Gu et al. 2022).
//!
//! The clip is cut into M ticks. Every node is a sequence: a clock γ(t) and an impulse at the ends, a learnt embedding,
//! and its surroundings. A stack of residual blocks (`nn::sequence`) scans the sequence, one scan serving every time of
//! a step, and a head that starts at zero gives a shift ρ and a rotation vector θ a tick. Between ticks both are
//! interpolated (Catmull-Rom); the node moves to p + ρ and turns by exp(θ) about itself. Gaussians follow by skinning
//! (`motion::skin`).
//!
//! - `mode`: scans in both directions to reconstruct; the past alone to forecast, with ticks past the clip as
//!   requested.
//! - `output`: poses, or their rates, which are composed from tick to tick (drifts, but carries on).
//! - `equivariance`: none; `frames`: inputs and outputs of the network are in local frames of the nodes
//!   (`nn::frames`), so that a turned scene is a turned scene; `vector`: vector neurons (`nn::vector`), which mirror
//!   exactly, too.
//!
//! A node's context (positions, frames, neighbours) is taken when nodes are placed or edited and held fixed: no
//! gradient is propagated through it to the nodes' positions.

mod context;
mod net;
mod pose;
#[cfg(test)]
mod tests;

use super::skin::{Skin, SkinSpec, Skinned, Trajectory};
use super::{Capabilities, Model, Motion, Slot, Spec};
use crate::math::{Real, Rng};
use crate::nn::ssm::{LANES, Lane};
use crate::scene::{BLOCK, Grads, Key, Params, RowEdit, Space, Table, Time};
use crate::{Error, Result};
use net::{Net, NetGrads, NetTape, Prepared};
use pose::Knots;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

pub use context::refresh;

/// Which ticks a node's pose may depend on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// All of the clip's: to reconstruct.
    Bidirectional,
    /// Those before it: to forecast.
    Causal,
}

/// Meaning of the network's output at a tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Output {
    /// The pose.
    Absolute,
    /// The pose's rate, a clip; poses are composed from tick to tick.
    Twist,
}

/// Which motions of the whole scene the model follows exactly.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Equivariance {
    /// None: positions are inputs.
    None,
    /// Translations and rotations, by local frames.
    Frames,
    /// Translations, rotations and reflections, by vector neurons.
    Vector,
}

/// The model as plain data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SsmSpec {
    /// Seed of what starts at random.
    pub seed: u64,
    /// Skinning of Gaussians to nodes.
    pub skin: SkinSpec,
    /// First and last tick, seconds.
    pub clip: [f64; 2],
    /// Ticks in the clip, M.
    pub ticks: usize,
    /// Channels, H.
    pub width: usize,
    /// Complex states a channel, N.
    pub states: usize,
    /// Residual blocks.
    pub blocks: usize,
    /// Numbers of a node's learnt embedding.
    pub embedding: usize,
    /// Octaves of the clock; 0: no clock, only the impulse at the ends.
    pub octaves: usize,
    /// Scene units that a node moves where the network states 1.
    pub extent: f64,
    /// Which ticks a pose may depend on.
    pub mode: Mode,
    /// Meaning of the network's output at a tick.
    pub output: Output,
    /// Which motions of the whole scene are followed exactly.
    pub equivariance: Equivariance,
}

/// Most numbers that one scan may give, nodes times ticks: a bound for files.
const MAX_SCANNED: usize = 1 << 26;

impl Default for SsmSpec {
    /// A clip of one second in 48 ticks; two blocks of 32 channels with 8 states.
    fn default() -> Self {
        Self {
            seed: 0,
            skin: SkinSpec::default(),
            clip: [0.0, 1.0],
            ticks: 48,
            width: 32,
            states: 8,
            blocks: 2,
            embedding: 32,
            octaves: 6,
            extent: 1.0,
            mode: Mode::Bidirectional,
            output: Output::Absolute,
            equivariance: Equivariance::None,
        }
    }
}

impl SsmSpec {
    /// Errors: a number out of its range.
    pub(crate) fn check(&self) -> Result<()> {
        self.skin.check()?;
        let broken = |what: String| {
            Err(Error::input(what).remedy("The file is damaged or was written by another program; export it again"))
        };
        let ranges = [
            ("ticks", self.ticks, 2, 1 << 14),
            ("width", self.width, 1, 512),
            ("states", self.states, 1, 64),
            ("blocks", self.blocks, 1, 8),
            ("embedding", self.embedding, 1, 256),
            ("octaves", self.octaves, 0, 16),
        ];
        for (name, value, low, high) in ranges {
            if !(low..=high).contains(&value) {
                return broken(format!("invalid state-space model: {name} = {value}, expected {low} to {high}"));
            }
        }
        let span = self.clip[1] - self.clip[0];
        if !(span > 0.0 && span.is_finite() && self.extent.is_finite()) {
            return broken(format!("a state-space model needs a clip that lasts, and this one's is {:?} s", self.clip));
        }
        Ok(())
    }
}

/// The trajectory of the nodes.
#[derive(Clone, Debug)]
pub(crate) struct Field {
    spec: SsmSpec,
    net: Net,
    /// Nodes: `node_embeddings` D.
    embeddings: Key,
    /// Nodes: `node_context`, see [`refresh`]; not learnt.
    context: Key,
}

/// Name of the table of embeddings, \[nodes, D\].
pub(crate) const EMBEDDINGS: &str = "node_embeddings";
/// Name of the table of the nodes' context.
pub(crate) const CONTEXT: &str = "node_context";
/// Numbers a node has at a tick of a scan: its pose and the gradient to it, raw and intermediate.
const TICK: usize = 32;
/// Spread of the embeddings at the start.
const EMBEDDING_NOISE: f64 = 0.1;

impl Model for SsmSpec {
    fn build<F: Real>(&self, p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
        self.check()?;
        let skin = Skin::new(self.skin, self.seed, p)?;
        let field = Field::new(self, skin.nodes, p)?;
        Ok(Skinned::shared(skin, Box::new(field), Spec::Ssm(self.clone())))
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities { causal: self.mode == Mode::Causal && self.octaves == 0, ..Capabilities::default() }
    }
}

/// Names of the network's learnable column groups: those of Λ and Δ, and all others. Errors: as `Model::build`.
pub fn columns(spec: &SsmSpec) -> Result<(Vec<String>, Vec<String>)> {
    spec.check()?;
    Ok(Net::new(spec, &mut Params::<f32>::new(0, 1, &[]))?.columns())
}

impl Field {
    /// Makes or claims the tables in `p`; `nodes` is the table of the skin. Errors: as [`build`](super::build).
    pub(crate) fn new<F: Real>(spec: &SsmSpec, nodes: Key, p: &mut Params<F>) -> Result<Self> {
        spec.check()?;
        let count = p[nodes].rows();
        if count.saturating_mul(2 * spec.ticks) > MAX_SCANNED {
            return Err(Error::input(format!("{count} control nodes over {} ticks are too many", spec.ticks))
                .remedy("Use fewer nodes or fewer ticks"));
        }
        let rng = Rng::new(spec.seed, "ssm", 0);
        let noise = |t: &mut Table<F>| {
            for row in 0..t.rows() {
                for col in 0..t.width() {
                    t.set(row, col, F::of(EMBEDDING_NOISE * rng.fork(row as u64).normal(col as u64)));
                }
            }
        };
        let embeddings = p.entry(EMBEDDINGS, Space::Nodes, &[(EMBEDDINGS, spec.embedding)], count, noise)?;
        let mut fresh = false;
        let columns = [(CONTEXT, context::width(spec.equivariance))];
        let context = p.entry(CONTEXT, Space::Nodes, &columns, count, |_| fresh = true)?;
        p.info_mut(context).trainable = false;
        let net = Net::new(spec, p)?;
        if fresh {
            refresh(spec.equivariance, p);
        }
        Ok(Self { spec: spec.clone(), net, embeddings, context })
    }

    /// Position of t among the ticks.
    fn knots<F: Real>(&self, t: Time) -> Knots<F> {
        let [first, last] = self.spec.clip;
        let per_second = (self.spec.ticks - 1) as f64 / (last - first);
        Knots::new((t.0 - first) * per_second, per_second, self.last_tick())
    }

    /// The last tick there is: the clip's, or as many again to forecast; later times use it.
    fn last_tick(&self) -> usize {
        match self.spec.mode {
            Mode::Bidirectional => self.spec.ticks - 1,
            Mode::Causal => 2 * self.spec.ticks - 1,
        }
    }

    /// Ticks that must be scanned for these times.
    fn needed(&self, times: &[Time]) -> usize {
        match self.spec.mode {
            Mode::Bidirectional => self.spec.ticks,
            Mode::Causal => times.iter().map(|t| self.knots::<f64>(*t).last() + 1).max().unwrap_or(1),
        }
    }

    /// Numbers per tick and node.
    fn tick_width(&self) -> usize {
        if self.spec.output == Output::Twist { 7 } else { 6 }
    }

    /// The network over the first `ticks` ticks: \[nodes, ticks, 6 or 7\], shift and rotation vector or quaternion.
    fn scan<F: Real>(&self, p: &Params<F>, ticks: usize) -> Scan<F> {
        let prepared = self.net.prepare(p, &self.spec, ticks);
        let (count, width) = (p[self.context].rows(), self.tick_width());
        let mut out = vec![F::ZERO; count * ticks * width];
        // Sixteen nodes a task, each with working memory of its own.
        let tasks = out.par_chunks_mut(LANES * ticks * width).enumerate();
        tasks.for_each_init(NetTape::default, |tape, (block, out)| {
            let said = self.node_poses(p, &prepared, block, tape);
            for (lane, out) in out.chunks_exact_mut(ticks * width).enumerate() {
                for (t, out) in out.chunks_exact_mut(width).enumerate() {
                    (0..width).for_each(|k| out[k] = said[k * ticks + t][lane]);
                }
            }
        });
        Scan { prepared: Some(prepared), ticks, out }
    }

    /// Poses of sixteen nodes at all ticks in the world's coordinates, \[6 or 7, ticks\].
    fn node_poses<F: Real>(
        &self,
        p: &Params<F>,
        net: &Prepared<F>,
        block: usize,
        tape: &mut NetTape<F>,
    ) -> Vec<Lane<F>> {
        let around = context::of_block(self.spec.equivariance, &p[self.context], block);
        let mut local = self.net.forward(net, &embedding_lanes(&p[self.embeddings], block), &around, tape);
        context::to_world(self.spec.equivariance, &around, self.spec.extent, &mut local);
        if self.spec.output == Output::Twist {
            return pose::compose(&local, self.tick_share());
        }
        local
    }

    /// Clips a tick.
    fn tick_share(&self) -> f64 {
        1.0 / (self.spec.ticks - 1) as f64
    }
}

fn embedding_lanes<F: Real>(table: &Table<F>, block: usize) -> Vec<Lane<F>> {
    // Numbers of lanes past the last row mean nothing, but must not be NaN: a weight's gradient sums over lanes, and
    // what such lanes get from above is zero.
    table.block(block).as_chunks::<BLOCK>().0.to_vec()
}

/// Values that a step computes once.
#[derive(Default)]
struct Scan<F> {
    prepared: Option<Prepared<F>>,
    ticks: usize,
    out: Vec<F>,
}

/// dL/d [`Scan::out`].
#[derive(Default)]
struct Pending<F>(Vec<F>);

impl<F: Real> Trajectory<F> for Field {
    fn prepare(&self, p: &Params<F>, times: &[Time], cache: &mut Slot) {
        *cache.get_or_default::<Scan<F>>() = self.scan(p, self.needed(times));
    }

    /// The scan's poses at all ticks, and the gradients to them.
    fn scratch_bytes(&self, p: &Params<F>) -> u64 {
        (p[self.embeddings].rows() * self.spec.ticks * TICK * size_of::<F>()) as u64
    }

    fn poses(&self, _p: &Params<F>, t: Time, cache: &Slot, out: &mut Table<F>) {
        let scan: &Scan<F> = cache.get().expect("`prepare` precedes every query");
        let (knots, width) = (self.knots(t), self.tick_width());
        for node in 0..out.rows() {
            let own = &scan.out[node * scan.ticks * width..(node + 1) * scan.ticks * width];
            out.write(node, 0, pose::at(own, width, &knots).0);
        }
    }

    fn poses_backward(
        &self,
        _p: &Params<F>,
        t: Time,
        cache: &Slot,
        d_out: &Table<F>,
        d_cache: &mut Slot,
        _d: &mut Grads<F>,
    ) -> f64 {
        let scan: &Scan<F> = cache.get().expect("`prepare` precedes every query");
        let d_scan = &mut d_cache.get_or_default::<Pending<F>>().0;
        d_scan.resize(scan.out.len(), F::ZERO);
        let (knots, width) = (self.knots(t), self.tick_width());
        let mut d_time = 0.0;
        for node in 0..d_out.rows() {
            let own = node * scan.ticks * width..(node + 1) * scan.ticks * width;
            d_time += pose::at_backward(&scan.out[own.clone()], width, &knots, d_out.read(node, 0), &mut d_scan[own]);
        }
        d_time
    }

    fn finish(&self, p: &Params<F>, _: &[Time], cache: &mut Slot, d_cache: &mut Slot, d: &mut Grads<F>) {
        let (Some(scan), Some(Pending(d_scan))) = (cache.get::<Scan<F>>(), d_cache.get::<Pending<F>>()) else { return };
        let Some(net) = &scan.prepared else { return };
        let (ticks, width) = (scan.ticks, self.tick_width());
        let tasks = d_scan.par_chunks(LANES * ticks * width).enumerate();
        // Activations are made again, sixteen nodes at a time: that is cheaper than to keep them all.
        let found: Vec<(NetGrads<F>, Vec<Lane<F>>)> = tasks
            .map_init(NetTape::default, |tape, (block, d_scan)| {
                let mut d_said = vec![[F::ZERO; LANES]; width * ticks];
                for (lane, d) in d_scan.chunks_exact(ticks * width).enumerate() {
                    for (t, d) in d.chunks_exact(width).enumerate() {
                        (0..width).for_each(|k| d_said[k * ticks + t][lane] = d[k]);
                    }
                }
                let around = context::of_block(self.spec.equivariance, &p[self.context], block);
                let own = embedding_lanes(&p[self.embeddings], block);
                let mut local = self.net.forward(net, &own, &around, tape);
                context::to_world(self.spec.equivariance, &around, self.spec.extent, &mut local);
                let mut d_local = d_said;
                if self.spec.output == Output::Twist {
                    d_local = pose::compose_backward(&local, self.tick_share(), &d_local);
                }
                context::to_world_backward(self.spec.equivariance, &around, self.spec.extent, &mut d_local);
                self.net.backward(net, tape, &around, &d_local)
            })
            .collect();
        let mut sum = self.net.no_gradient(net);
        let [d_embeddings] = d.of([self.embeddings]);
        let rows = d_embeddings.rows();
        for (block, (grads, d_own)) in found.iter().enumerate() {
            sum.add(grads);
            for row in block * LANES..rows.min((block + 1) * LANES) {
                // The embedding is first among a node's inputs; the rest has no gradient.
                (0..d_embeddings.width()).for_each(|k| *d_embeddings.get_mut(row, k) += d_own[k][row % LANES]);
            }
        }
        self.net.finish(net, sum, d);
    }

    /// Added or removed nodes change the context of their neighbours.
    fn on_edit(&self, p: &mut Params<F>, _: &RowEdit) {
        refresh(self.spec.equivariance, p);
    }
}
