//! A perceptron of a node's rest position and of time: nearby nodes and nearby times move alike by themselves.
//!
//! pose_k(t) = MLP(γ(p̃_k), γ(τ)), p̃ the position in units of the nodes' extent at the start, τ the share of the clip.
//! The last layer starts at zero: at rest. Source: Huang et al. 2024 (SC-GS): 8 layers of 256 with the input again in
//! the middle; smaller ones learn in minutes.

use super::super::skin::{POSE, Skin, Trajectory};
use super::refuse;
use crate::Result;
use crate::math::{Real, Rng};
use crate::motion::Slot;
use crate::nn::encoding::{MAX_LEVELS, encode, encode_backward, encoded};
use crate::nn::{InputGrad, LayerOutputs, Mlp, MlpShape, Passed};
use crate::scene::{Grads, Key, Params, Space, Table, Time};

/// From this many hidden layers on the input is appended again in the middle (Mildenhall et al. 2020: after the fourth
/// of eight).
const DEEP: usize = 6;

/// Shape of the network.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct NetworkShape {
    /// Numbers in a hidden layer.
    pub width: usize,
    /// Hidden layers.
    pub layers: usize,
    /// Levels of the encoding of positions and of time.
    pub levels: [usize; 2],
}

/// A trajectory that a perceptron gives: tables `trajectory.*`, and `node_units` [4, 1] (centre and 1/extent of the
/// nodes at the start), which is not learnt.
#[derive(Clone, Debug)]
pub(crate) struct Network {
    mlp: Mlp,
    levels: [usize; 2],
    clip: [f64; 2],
    units: Key,
    nodes: Key,
}

/// One time's pass.
struct Pass<F> {
    t: Time,
    x: Vec<F>,
    out: Vec<F>,
    kept: LayerOutputs<F>,
}

/// All times of a step.
struct Passes<F>(Vec<Pass<F>>);

impl<F> Default for Passes<F> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl Network {
    /// Makes or claims the tables. Errors: a shape out of range, loaded arrays of the wrong shape.
    pub(crate) fn new<F: Real>(
        shape: NetworkShape,
        clip: [f64; 2],
        seed: u64,
        skin: &Skin,
        p: &mut Params<F>,
    ) -> Result<Self> {
        if shape.levels.iter().any(|&l| l > MAX_LEVELS) {
            return Err(refuse(format!("invalid encoding: more than {MAX_LEVELS} levels")));
        }
        let units = p.entry("node_units", Space::Fixed, &[("node_units", 1)], 4, |_| {})?;
        p.info_mut(units).trainable = false;
        if p[units].get(3, 0) == F::ZERO {
            measure(skin, p, units);
        }
        let mlp = Mlp::new(
            "trajectory",
            MlpShape {
                inputs: encoded(3, shape.levels[0]) + encoded(1, shape.levels[1]),
                width: shape.width,
                layers: shape.layers,
                skip: (shape.layers >= DEEP).then_some(shape.layers / 2),
                outputs: POSE,
            },
            0.0,
            Rng::new(seed, "trajectory", 0),
            p,
        )?;
        Ok(Self { mlp, levels: shape.levels, clip, units, nodes: skin.nodes })
    }

    /// Share of the clip that has passed, and its slope in t.
    fn time(&self, t: Time) -> (f64, f64) {
        let length = self.clip[1] - self.clip[0];
        let rate = if length > 0.0 { 1.0 / length } else { 0.0 };
        let along = (t.0 - self.clip[0]) * rate;
        let inside = along > 0.0 && along < 1.0;
        (along.clamp(0.0, 1.0), if inside { rate } else { 0.0 })
    }

    /// A node's position in units of the nodes' extent.
    #[inline(always)]
    fn position<F: Real>(&self, p: &Params<F>, node: usize) -> [F; 3] {
        let units = &p[self.units];
        let x = p[self.nodes].read::<3>(node, 0);
        std::array::from_fn(|k| (x[k] - units.get(k, 0)) * units.get(3, 0))
    }

    fn pass<F: Real>(&self, p: &Params<F>, t: Time) -> Pass<F> {
        let (count, width) = (p[self.nodes].rows(), self.mlp.shape().inputs);
        let mut pass = Pass {
            t,
            x: vec![F::ZERO; count * width],
            out: vec![F::ZERO; count * POSE],
            kept: LayerOutputs::default(),
        };
        let split = encoded(3, self.levels[0]);
        for (node, row) in pass.x.chunks_exact_mut(width).enumerate() {
            encode(&self.position(p, node), self.levels[0], &mut row[..split]);
            encode(&[F::of(self.time(t).0)], self.levels[1], &mut row[split..]);
        }
        self.mlp.forward_keeping(p, &pass.x, &mut pass.out, &mut pass.kept);
        pass
    }
}

/// Centre of the nodes and one over the largest distance from it.
fn measure<F: Real>(skin: &Skin, p: &mut Params<F>, units: Key) {
    let nodes = &p[skin.nodes];
    let n = nodes.rows();
    let center: [f64; 3] =
        std::array::from_fn(|c| (0..n).map(|k| nodes.get(k, c).f64()).sum::<f64>() / n.max(1) as f64);
    let far = (0..n).map(|k| (0..3).map(|c| (nodes.get(k, c).f64() - center[c]).powi(2)).sum::<f64>().sqrt());
    let extent = far.fold(0.0, f64::max);
    let scale = if extent > 0.0 && extent.is_finite() { 1.0 / extent } else { 1.0 };
    for (row, value) in center.into_iter().chain([scale]).enumerate() {
        p[units].set(row, 0, F::of(value));
    }
}

impl<F: Real> Trajectory<F> for Network {
    fn prepare(&self, p: &Params<F>, times: &[Time], cache: &mut Slot) {
        let passes: &mut Passes<F> = cache.get_or_default();
        passes.0 = times.iter().map(|&t| self.pass(p, t)).collect();
    }

    fn scratch_bytes(&self, _p: &Params<F>) -> u64 {
        0
    }

    fn poses(&self, _p: &Params<F>, t: Time, cache: &Slot, out: &mut Table<F>) {
        let pass = pass_of::<F>(cache, t);
        for (node, pose) in pass.out.as_chunks::<POSE>().0.iter().enumerate() {
            out.write(node, 0, *pose);
        }
    }

    fn poses_backward(
        &self,
        p: &Params<F>,
        t: Time,
        cache: &Slot,
        d_out: &Table<F>,
        _d_cache: &mut Slot,
        d: &mut Grads<F>,
    ) -> f64 {
        let pass = pass_of::<F>(cache, t);
        let d_poses = d_out.column_to_rows(0, POSE);
        let mut d_x = vec![F::ZERO; pass.x.len()];
        self.mlp.backward(p, Passed::kept(&pass.x, &pass.kept), &d_poses, InputGrad::Overwrite(&mut d_x), d);
        let (width, split) = (self.mlp.shape().inputs, encoded(3, self.levels[0]));
        let (now, slope) = self.time(t);
        let scale = p[self.units].get(3, 0);
        let [d_nodes] = d.of([self.nodes]);
        let mut d_time = 0.0;
        for (node, g) in d_x.chunks_exact(width).enumerate() {
            let (mut d_position, mut d_now) = ([F::ZERO; 3], [F::ZERO]);
            encode_backward(&self.position(p, node), self.levels[0], &g[..split], &mut d_position);
            encode_backward(&[F::of(now)], self.levels[1], &g[split..], &mut d_now);
            d_nodes.add(node, 0, d_position.map(|x| x * scale));
            d_time += d_now[0].f64() * slope;
        }
        d_time
    }
}

fn pass_of<F: Real>(cache: &Slot, t: Time) -> &Pass<F> {
    let passes: &Passes<F> = cache.get().expect("`prepare` precedes every query");
    let same = |pass: &&Pass<F>| pass.t.0.to_bits() == t.0.to_bits();
    passes.0.iter().find(same).expect("every time of a step was prepared")
}
