//! The network of a node: sixteen nodes in, a shift and a rotation vector a tick out.

use super::context::{Around, VECTORS};
use super::{Equivariance, Mode, SsmSpec};
use crate::Result;
use crate::math::{Real, Rng};
use crate::nn::encoding::{encode, encoded};
use crate::nn::sequence::{self, Block, BlockTape, Layout, Scans, clear, linear, linear_backward, uniform};
use crate::nn::ssm::{Direction, Discrete, LANES, Lane};
use crate::nn::vector::{VectorBlock, VectorTape};
use crate::scene::{Grads, Key, Params};
use std::ops::Range;

/// Octaves of the encoding of a node's position (without equivariance): down to 0.4 radii of the cloud.
const PLACE_OCTAVES: usize = 5;
/// Numbers of a tick of the clock next to γ: the impulses at the first and the last tick.
const IMPULSES: usize = 2;

/// Positions of the weights and their tables.
#[derive(Clone, Debug)]
pub(crate) struct Net {
    keys: Vec<Key>,
    layout: Layout,
    width: usize,
    own: usize,
    clock: usize,
    /// W \[H, clock\], W \[H, own\], b \[H\]
    entry: [Range<usize>; 3],
    body: Body,
}

#[derive(Clone, Debug)]
enum Body {
    /// Blocks of scalars, a gate \[H, own\] and a head \[6, H\], \[6\]. The gate is what a node multiplies the last
    /// channels by, 1 + gate·own, so that nodes choose among the motions that all share.
    Scalar { blocks: Vec<Block>, gate: Range<usize>, head: [Range<usize>; 2] },
    /// Coefficients \[C·VECTORS, H\], \[C·VECTORS\] that make C vectors of the node's, blocks of vectors, and a head:
    /// the shift and two vectors whose cross product is the rotation, \[C\] each.
    Vector { channels: usize, coefficients: [Range<usize>; 2], blocks: Vec<VectorBlock>, head: [Range<usize>; 3] },
}

/// Values common to all nodes in a step.
#[derive(Clone, Debug)]
pub(crate) struct Prepared<F> {
    w: Vec<F>,
    layers: Vec<Discrete<F>>,
    /// \[ticks, clock\]
    clock: Vec<F>,
    /// \[H, ticks\]
    beat: Vec<F>,
    ticks: usize,
}

/// Working memory of sixteen nodes; the backward reads what the forward left.
#[derive(Clone, Debug, Default)]
pub(crate) struct NetTape<F> {
    own: Vec<Lane<F>>,
    first: Vec<Lane<F>>,
    bent: Vec<Lane<F>>,
    last: Vec<Lane<F>>,
    gate: Vec<Lane<F>>,
    scalar: Vec<BlockTape<F>>,
    vector: Vec<VectorTape<F>>,
    /// The two vectors of the rotation's cross product, \[6, ticks\].
    arms: Vec<Lane<F>>,
}

/// dL/d weights of some nodes.
#[derive(Clone, Debug)]
pub(crate) struct NetGrads<F> {
    w: Vec<F>,
    layers: Vec<Discrete<F>>,
    beat: Vec<F>,
}

impl<F: Real> NetGrads<F> {
    /// Adds another gradient.
    pub(crate) fn add(&mut self, other: &Self) {
        self.w.iter_mut().zip(&other.w).for_each(|(a, b)| *a += *b);
        self.beat.iter_mut().zip(&other.beat).for_each(|(a, b)| *a += *b);
        self.layers.iter_mut().zip(&other.layers).for_each(|(a, b)| a.add(b));
    }
}

impl Net {
    /// Makes or claims the weights' tables in `p`. Errors: loaded arrays of the wrong shape.
    pub(super) fn new<F: Real>(spec: &SsmSpec, p: &mut Params<F>) -> Result<Self> {
        let mut layout = Layout::default();
        let width = spec.width;
        let own = spec.embedding
            + match spec.equivariance {
                Equivariance::None => encoded(3, PLACE_OCTAVES),
                Equivariance::Frames => super::context::width(spec.equivariance) - 9,
                Equivariance::Vector => 0,
            };
        let clock = IMPULSES + if spec.octaves > 0 { encoded(1, spec.octaves) } else { 0 };
        let mut push = |name: &str, n: usize| layout.push(format!("ssm.{name}"), n);
        let entry = [push("entry.clock", width * clock), push("entry.own", width * own), push("entry.bias", width)];
        let ways: &[Direction] = match spec.mode {
            Mode::Bidirectional => &[Direction::Forward, Direction::Backward],
            Mode::Causal => &[Direction::Forward],
        };
        let numbers = (0..spec.blocks).map(|i| (format!("ssm.{i}"), i * ways.len()));
        let body = if spec.equivariance == Equivariance::Vector {
            let channels = width.div_ceil(2);
            let made = channels * VECTORS;
            let coefficients = [push("coefficients.weight", made * width), push("coefficients.bias", made)];
            let blocks = numbers
                .map(|(name, first)| VectorBlock::new(&name, channels, spec.states, ways, first, &mut layout))
                .collect();
            let head = ["shift", "arm", "lever"].map(|part| layout.push(format!("ssm.head.{part}"), channels));
            Body::Vector { channels, coefficients, blocks, head }
        } else {
            let blocks =
                numbers.map(|(name, first)| Block::new(&name, width, spec.states, ways, first, &mut layout)).collect();
            let gate = layout.push("ssm.gate".into(), width * own);
            let head = [("weight", 6 * width), ("bias", 6)].map(|(part, n)| layout.push(format!("ssm.head.{part}"), n));
            Body::Scalar { blocks, gate, head }
        };
        let mut net = Self { keys: Vec::new(), layout, width, own, clock, entry, body };
        let w = net.init::<F>(spec);
        net.keys = net
            .layout
            .parts()
            .iter()
            .map(|(name, at)| p.array(name, at.len(), |x| x.copy_from_slice(&w[at.clone()])))
            .collect::<Result<_>>()?;
        Ok(net)
    }

    /// First weights. All that leads to the output starts at zero.
    fn init<F: Real>(&self, spec: &SsmSpec) -> Vec<F> {
        let mut w = vec![F::ZERO; self.layout.len()];
        let rng = Rng::new(spec.seed, "ssm weights", 0);
        uniform(&mut w[self.entry[0].clone()], self.clock, rng.fork(0));
        uniform(&mut w[self.entry[1].clone()], self.own, rng.fork(1));
        match &self.body {
            Body::Scalar { blocks, gate, .. } => {
                uniform(&mut w[gate.clone()], self.own, rng.fork(5));
                blocks.iter().zip(10..).for_each(|(b, i)| b.init(spec.ticks, rng.fork(i), &mut w));
            }
            Body::Vector { blocks, coefficients, head, channels } => {
                uniform(&mut w[coefficients[0].clone()], self.width, rng.fork(2));
                uniform(&mut w[coefficients[1].clone()], VECTORS, rng.fork(3));
                uniform(&mut w[head[2].clone()], *channels, rng.fork(4));
                blocks.iter().zip(10..).for_each(|(b, i)| b.init(spec.ticks, rng.fork(i), &mut w));
            }
        }
        w
    }

    /// Names of the columns of Λ and Δ, and of all others.
    pub(crate) fn columns(&self) -> (Vec<String>, Vec<String>) {
        let names = self.layout.parts().iter().map(|(name, _)| name.clone());
        names.partition(|n| ["log_decay", "frequency", "log_step"].iter().any(|end| n.ends_with(end)))
    }

    fn scans(&self) -> Vec<&Scans> {
        match &self.body {
            Body::Scalar { blocks, .. } => blocks.iter().map(Block::scans).collect(),
            Body::Vector { blocks, .. } => blocks.iter().map(VectorBlock::scans).collect(),
        }
    }

    /// Values common to all nodes, for the first `ticks` ticks.
    pub(super) fn prepare<F: Real>(&self, p: &Params<F>, spec: &SsmSpec, ticks: usize) -> Prepared<F> {
        let mut w = Vec::with_capacity(self.layout.len());
        for (key, (_, at)) in self.keys.iter().zip(self.layout.parts()) {
            w.extend_from_slice(&p[*key].data()[..at.len()]);
        }
        let layers = self.scans().iter().flat_map(|s| s.discrete(&w, &[1.0])).collect();
        let mut clock = vec![F::ZERO; ticks * self.clock];
        for (t, beat) in clock.chunks_exact_mut(self.clock).enumerate() {
            beat[0] = if t == 0 { F::ONE } else { F::ZERO };
            let end = spec.mode == Mode::Bidirectional && t + 1 == spec.ticks;
            beat[1] = if end { F::ONE } else { F::ZERO };
            if spec.octaves > 0 {
                // The slowest octave makes half a turn in the clip.
                let share = t as f64 / (spec.ticks - 1) as f64 - 0.5;
                encode(&[F::of(std::f64::consts::PI * share)], spec.octaves, &mut beat[IMPULSES..]);
            }
        }
        let mut beat = vec![F::ZERO; self.width * ticks];
        let [by_clock, ..] = &self.entry;
        for (row, w) in w[by_clock.clone()].chunks_exact(self.clock).enumerate() {
            for (t, clock) in clock.chunks_exact(self.clock).enumerate() {
                beat[row * ticks + t] = w.iter().zip(clock).map(|(a, b)| *a * *b).sum();
            }
        }
        Prepared { w, layers, clock, beat, ticks }
    }

    /// Shift and rotation vector \[6, ticks\] of sixteen nodes, in the network's own axes.
    pub(crate) fn forward<F: Real>(
        &self,
        net: &Prepared<F>,
        embedding: &[Lane<F>],
        around: &Around<F>,
        tape: &mut NetTape<F>,
    ) -> Vec<Lane<F>> {
        let (w, ticks) = (&net.w, net.ticks);
        self.own_features(embedding, around, &mut tape.own);
        let mut own = vec![[F::ZERO; LANES]; self.width];
        linear(&w[self.entry[1].clone()], &w[self.entry[2].clone()], self.own, &tape.own, &mut own);
        clear(&mut tape.first, self.width * ticks);
        for (i, x) in tape.first.iter_mut().enumerate() {
            (0..LANES).for_each(|l| x[l] = net.beat[i] + own[i / ticks][l]);
        }
        let mut out = vec![[F::ZERO; LANES]; 6 * ticks];
        match &self.body {
            Body::Scalar { blocks, gate, head } => {
                tape.last.clone_from(&tape.first);
                tape.scalar.resize_with(blocks.len(), BlockTape::default);
                for (block, tape_of) in blocks.iter().zip(&mut tape.scalar) {
                    block.forward(w, &net.layers, &mut tape.last, tape_of);
                }
                tape.gate.clear();
                tape.gate.resize(self.width, [F::ZERO; LANES]);
                linear(&w[gate.clone()], &[], self.own, &tape.own, &mut tape.gate);
                tape.bent.clone_from(&tape.last);
                by_row(&mut tape.bent, ticks, |x, row, _| (0..LANES).for_each(|l| x[l] *= F::ONE + tape.gate[row][l]));
                linear(&w[head[0].clone()], &w[head[1].clone()], self.width, &tape.bent, &mut out);
            }
            Body::Vector { channels, coefficients, blocks, head } => {
                clear(&mut tape.bent, tape.first.len());
                sequence::gelu(&tape.first, &mut tape.bent);
                let mut shares = vec![[F::ZERO; LANES]; channels * VECTORS * ticks];
                let [weight, bias] = coefficients.clone();
                linear(&w[weight], &w[bias], self.width, &tape.bent, &mut shares);
                clear(&mut tape.last, channels * 3 * ticks);
                mix(&shares, &around.vectors, ticks, &mut tape.last);
                tape.vector.resize_with(blocks.len(), VectorTape::default);
                for (block, tape_of) in blocks.iter().zip(&mut tape.vector) {
                    block.forward(w, &net.layers, &mut tape.last, tape_of);
                }
                clear(&mut tape.arms, 6 * ticks);
                let (shift, turn) = out.split_at_mut(3 * ticks);
                let (arm, lever) = tape.arms.split_at_mut(3 * ticks);
                linear(&w[head[0].clone()], &[], *channels, &tape.last, shift);
                linear(&w[head[1].clone()], &[], *channels, &tape.last, arm);
                linear(&w[head[2].clone()], &[], *channels, &tape.last, lever);
                cross(arm, lever, ticks, |i, x| turn[i] = x);
            }
        }
        out
    }

    fn own_features<F: Real>(&self, embedding: &[Lane<F>], around: &Around<F>, own: &mut Vec<Lane<F>>) {
        own.clear();
        own.extend_from_slice(embedding);
        let missing = self.own - embedding.len();
        if missing == around.scalars.len() {
            own.extend_from_slice(&around.scalars);
            return;
        }
        let first = own.len();
        own.resize(self.own, [F::ZERO; LANES]);
        let mut gamma = vec![F::ZERO; missing];
        for l in 0..LANES {
            let place = [0, 1, 2].map(|k| around.scalars[k][l]);
            encode(&place, PLACE_OCTAVES, &mut gamma);
            gamma.iter().enumerate().for_each(|(i, g)| own[first + i][l] = *g);
        }
    }

    /// No gradient yet.
    pub(crate) fn no_gradient<F: Real>(&self, net: &Prepared<F>) -> NetGrads<F> {
        let layers = net.layers.iter().map(Discrete::none).collect();
        NetGrads { w: vec![F::ZERO; net.w.len()], layers, beat: vec![F::ZERO; net.beat.len()] }
    }

    /// VJP of [`forward`](Self::forward): the gradients to the weights and to the embedding.
    pub(crate) fn backward<F: Real>(
        &self,
        net: &Prepared<F>,
        tape: &NetTape<F>,
        around: &Around<F>,
        d_out: &[Lane<F>],
    ) -> (NetGrads<F>, Vec<Lane<F>>) {
        let (w, ticks, zero) = (&net.w, net.ticks, [F::ZERO; LANES]);
        let mut d = self.no_gradient(net);
        let mut d_first = vec![zero; tape.first.len()];
        let mut d_features = vec![zero; self.own];
        match &self.body {
            Body::Scalar { blocks, gate, head } => {
                let [d_weight, d_bias] = d.w.get_disjoint_mut(head.clone()).expect("a layout's parts are apart");
                let weight = &w[head[0].clone()];
                linear_backward(weight, self.width, &tape.bent, d_out, (d_weight, d_bias), &mut d_first);
                let mut d_gate = vec![zero; self.width];
                by_row(&mut d_first, ticks, |d, row, at| {
                    (0..LANES).for_each(|l| d_gate[row][l] += d[l] * tape.last[at][l]);
                    (0..LANES).for_each(|l| d[l] *= F::ONE + tape.gate[row][l]);
                });
                let d_w = (&mut d.w[gate.clone()], &mut [][..]);
                linear_backward(&w[gate.clone()], self.own, &tape.own, &d_gate, d_w, &mut d_features);
                for (block, tape) in blocks.iter().zip(&tape.scalar).rev() {
                    block.backward(w, &net.layers, tape, &mut d_first, (&mut d.w, &mut d.layers));
                }
            }
            Body::Vector { channels, coefficients, blocks, head } => {
                let (d_shift, d_turn) = d_out.split_at(3 * ticks);
                let (arm, lever) = tape.arms.split_at(3 * ticks);
                // θ = a × b: da = b × g, db = g × a.
                let (mut d_arm, mut d_lever) = (vec![zero; 3 * ticks], vec![zero; 3 * ticks]);
                cross(lever, d_turn, ticks, |i, x| d_arm[i] = x);
                cross(d_turn, arm, ticks, |i, x| d_lever[i] = x);
                let mut d_last = vec![zero; tape.last.len()];
                for (at, d_part) in head.iter().zip([d_shift, &d_arm, &d_lever]) {
                    let d_w = (&mut d.w[at.clone()], &mut [][..]);
                    linear_backward(&w[at.clone()], *channels, &tape.last, d_part, d_w, &mut d_last);
                }
                for (block, tape) in blocks.iter().zip(&tape.vector).rev() {
                    block.backward(w, &net.layers, tape, &mut d_last, (&mut d.w, &mut d.layers));
                }
                let mut d_shares = vec![zero; channels * VECTORS * ticks];
                mix_backward(&d_last, &around.vectors, ticks, &mut d_shares);
                let [d_weight, d_bias] =
                    d.w.get_disjoint_mut(coefficients.clone()).expect("a layout's parts are apart");
                let weight = &w[coefficients[0].clone()];
                linear_backward(weight, self.width, &tape.bent, &d_shares, (d_weight, d_bias), &mut d_first);
                sequence::gelu_backward(&tape.first, &mut d_first);
            }
        }
        let mut d_own = vec![zero; self.width];
        for (row, d_first) in d_first.chunks_exact(ticks).enumerate() {
            for (t, x) in d_first.iter().enumerate() {
                d.beat[row * ticks + t] += crate::simd::total(*x);
                (0..LANES).for_each(|l| d_own[row][l] += x[l]);
            }
        }
        let [_, own, bias] = self.entry.clone();
        let [d_weight, d_bias] = d.w.get_disjoint_mut([own.clone(), bias]).expect("a layout's parts are apart");
        linear_backward(&w[own], self.own, &tape.own, &d_own, (d_weight, d_bias), &mut d_features);
        (d, d_features)
    }

    /// Brings the gradient of all nodes to the tables.
    pub(super) fn finish<F: Real>(&self, net: &Prepared<F>, mut sum: NetGrads<F>, d: &mut Grads<F>) {
        let [by_clock, ..] = &self.entry;
        for (row, d_w) in sum.w[by_clock.clone()].chunks_exact_mut(self.clock).enumerate() {
            for (t, clock) in net.clock.chunks_exact(self.clock).enumerate() {
                let g = sum.beat[row * net.ticks + t];
                d_w.iter_mut().zip(clock).for_each(|(d, c)| *d += g * *c);
            }
        }
        for scans in self.scans() {
            scans.discrete_backward(&net.w, &[1.0], &sum.layers, &mut sum.w);
        }
        for (key, (_, at)) in self.keys.iter().zip(self.layout.parts()) {
            let [table] = d.of([*key]);
            table.data_mut()[..at.len()].iter_mut().zip(&sum.w[at.clone()]).for_each(|(a, b)| *a += *b);
        }
    }
}

/// Calls `f(&mut x[at], row, at)` for x \[rows, ticks\].
fn by_row<F: Real>(x: &mut [Lane<F>], ticks: usize, mut f: impl FnMut(&mut Lane<F>, usize, usize)) {
    for (row, x) in x.chunks_exact_mut(ticks).enumerate() {
        x.iter_mut().enumerate().for_each(|(t, x)| f(x, row, row * ticks + t));
    }
}

/// V_c = Σ_j share_cj o_j: shares \[C·J, ticks\], vectors \[J, 3\], out \[C, 3, ticks\].
fn mix<F: Real>(shares: &[Lane<F>], vectors: &[Lane<F>], ticks: usize, out: &mut [Lane<F>]) {
    for (row, out) in out.chunks_exact_mut(ticks).enumerate() {
        let (channel, axis) = (row / 3, row % 3);
        for j in 0..VECTORS {
            let o = &vectors[3 * j + axis];
            let shares = &shares[(channel * VECTORS + j) * ticks..][..ticks];
            for (out, share) in out.iter_mut().zip(shares) {
                (0..LANES).for_each(|l| out[l] += share[l] * o[l]);
            }
        }
    }
}

/// VJP of [`mix`] to the shares.
fn mix_backward<F: Real>(d_out: &[Lane<F>], vectors: &[Lane<F>], ticks: usize, d_shares: &mut [Lane<F>]) {
    for (row, d_out) in d_out.chunks_exact(ticks).enumerate() {
        let (channel, axis) = (row / 3, row % 3);
        for j in 0..VECTORS {
            let o = &vectors[3 * j + axis];
            let d_shares = &mut d_shares[(channel * VECTORS + j) * ticks..][..ticks];
            for (d_share, d_out) in d_shares.iter_mut().zip(d_out) {
                (0..LANES).for_each(|l| d_share[l] += d_out[l] * o[l]);
            }
        }
    }
}

/// a × b of vectors \[3, ticks\].
fn cross<F: Real>(a: &[Lane<F>], b: &[Lane<F>], ticks: usize, mut give: impl FnMut(usize, Lane<F>)) {
    for axis in 0..3 {
        let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
        for t in 0..ticks {
            let [ai, aj, bi, bj] = [&a[i * ticks + t], &a[j * ticks + t], &b[i * ticks + t], &b[j * ticks + t]];
            give(axis * ticks + t, std::array::from_fn(|l| ai[l] * bj[l] - aj[l] * bi[l]));
        }
    }
}
