//! `deform-mlp`: a canonical cloud that a network deforms.
//!
//! With x̂ = (sg(x) − c)/r and t̂ = (t − from)/(to − from) clamped to [0, 1], a network gives every Gaussian (δx 3, δq
//! 4, δs 3), or with `rigid` a screw (w 3, v 3) in place of δx: x_t = x + r·δx or c + r·exp([w; v])((x − c)/r), q_t =
//! q/|q| + δq, s_t = max(exp(log_scales) + r·δs, 1e-6) — scales are changed after the activation — each head times its
//! constant of `GAINS`. Opacity and SH stay. `sg` stops the gradient: the network's input is detached from the mean, so
//! that dL/dx = dL/dx_t (with a screw: turned by it). The inputs of the network are γ(x̂) and γ(t̂), t̂'s perhaps
//! through a small network of its own, or hash grids over (x, y, z) and (x, y, t), (y, z, t), (x, z, t). What depends
//! on t̂ alone enters as a shift of biases, which is the same as repeating it in every row. At the start the last map
//! is zero: the result is then the canonical cloud bit for bit, as in `still`.
//! Source: Yang et al. 2024 (Deformable 3D Gaussians) §3; heads that start at zero as in SC-GS (Huang et al. 2024);
//! hash grids after Müller et al. 2022 and Grid4D (Xu et al. 2024).

mod rows;
#[cfg(test)]
mod tests;

use super::lanes::{fill, scatter};
use super::still::Still;
use super::{At, Cache, Capabilities, Model, Motion, Slot, Spec, Tape};
use crate::math::{Real, Rng};
use crate::nn::encoding::{MAX_LEVELS, encode, encode_backward, encoded};
use crate::nn::{HashGrid, HashShape, InputGrad, LayerOutputs, Mlp, MlpShape, Passed};
use crate::scene::{GEOMETRY, Grads, Key, Params, Space, SplatGrads, Table, Time};
use crate::{Error, Result};
use rayon::prelude::*;
pub(crate) use rows::GAINS;
use rows::{Bounds, Gather, Gradient, Spread, Written};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The model as plain data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeformSpec {
    /// Seed of what starts at random.
    pub seed: u64,
    /// First and last second of the clip: where t̂ is 0 and 1.
    pub clip: [f64; 2],
    /// Encoding of x̂ and t̂ for the trunk.
    pub input: Input,
    /// Numbers in a hidden layer of the trunk.
    pub width: usize,
    /// Hidden layers of the trunk; 0: features are mapped linearly.
    pub layers: usize,
    /// The input is appended again to the output of this hidden layer (from 0).
    pub skip: Option<usize>,
    /// Whether positions move by a screw motion instead of an offset.
    pub rigid: bool,
}

/// Input encoding of a trunk.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Input {
    /// Sines and cosines.
    Encoded {
        /// Levels of x̂.
        x_levels: usize,
        /// Levels of t̂.
        t_levels: usize,
        /// Whether γ(t̂) passes through a small network first (`TIME_WIDTH` → `TIME_OUTPUTS`).
        time_net: bool,
    },
    /// Hash grids.
    Hashed {
        /// Over (x, y, z).
        space: HashShape,
        /// Over (x, y, t), (y, z, t) and (x, z, t).
        time: HashShape,
    },
}

/// Hidden width of the network of time alone (Yang et al. 2024, synthetic scenes).
pub(crate) const TIME_WIDTH: usize = 256;
/// Number of its outputs, which the trunk gets.
pub(crate) const TIME_OUTPUTS: usize = 30;
/// Axes of the grids that see time, among (x, y, z, t).
const TIME_AXES: [[usize; 3]; 3] = [[0, 1, 3], [1, 2, 3], [0, 2, 3]];
/// Numbers of a point that grids see.
const POINT: usize = 4;
/// Name of the table that holds the centre and the half side of the box of the initial cloud, scene units.
pub(crate) const BOUNDS: &str = "deform_bounds";
/// Share of the points that may be outside the box on either side of an axis.
const OUTSIDE: f64 = 0.005;
/// The box is this much larger than what holds the points.
const MARGIN: f64 = 1.25;
/// Seeds of the parts.
const PURPOSE: &str = "deform";
/// Rows of a task that encodes points.
const ROWS: usize = 256;

impl Model for DeformSpec {
    fn build<F: Real>(&self, p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
        Ok(Arc::new(Deform::new(self.clone(), p)?))
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities::default()
    }
}

/// Encoding of x̂ and t̂ for the trunk.
#[derive(Clone, Debug)]
#[allow(clippy::large_enum_variant)] // one a model
enum Eyes {
    Encoded {
        x_levels: usize,
        t_levels: usize,
        /// γ(t̂) → the inputs of the shifts.
        time: Option<Mlp>,
        /// → the shift of the trunk's first map.
        enter: Mlp,
        /// → the shift of the map behind the skip, and which one that is.
        again: Option<(Mlp, usize)>,
    },
    Hashed {
        grids: Vec<HashGrid>,
    },
}

/// See the module's documentation.
#[derive(Clone, Debug)]
pub struct Deform {
    spec: DeformSpec,
    bounds: Key,
    eyes: Eyes,
    trunk: Mlp,
}

/// State that one result keeps for its backward.
#[derive(Debug)]
struct Own<F> {
    /// Whether the network was queried.
    asked: bool,
    /// Whether its result is used: false where the last map is zero.
    moves: bool,
    /// [rows, inputs] of the trunk.
    x: Vec<F>,
    /// [rows, 4]: x̂ and t̂ in [0, 1], for grids.
    points: Vec<F>,
    shifts: Vec<Vec<F>>,
    /// γ(t̂), and the inputs of the shifts.
    time: [Vec<F>; 2],
    kept: LayerOutputs<F>,
    time_kept: LayerOutputs<F>,
    /// [rows, heads]
    heads: Vec<F>,
    d_rows: Table<F>,
    d_heads: Vec<F>,
    d_x: Vec<F>,
    d_points: Vec<F>,
}

impl<F: Real> Default for Own<F> {
    fn default() -> Self {
        Self {
            asked: false,
            moves: false,
            x: Vec::new(),
            points: Vec::new(),
            shifts: Vec::new(),
            time: [Vec::new(), Vec::new()],
            kept: LayerOutputs::default(),
            time_kept: LayerOutputs::default(),
            heads: Vec::new(),
            d_rows: Table::default(),
            d_heads: Vec::new(),
            d_x: Vec::new(),
            d_points: Vec::new(),
        }
    }
}

fn refused(what: &str) -> Error {
    Error::input(format!("a deformation cannot have {what}"))
        .remedy("The file is damaged or was written by another program; export it again")
}

impl Deform {
    /// Makes or claims the model's tables in `p`. Errors: see [`build`](super::build).
    pub fn new<F: Real>(spec: DeformSpec, p: &mut Params<F>) -> Result<Self> {
        let [from, to] = spec.clip;
        if !(from.is_finite() && to.is_finite() && from <= to) {
            return Err(refused("this clip: it must be two finite times in order"));
        }
        let box_of_points = Bounds::around(&p[GEOMETRY], OUTSIDE, MARGIN);
        let bounds = p.array(BOUNDS, POINT, |b| b.copy_from_slice(&box_of_points.map(F::of)))?;
        p.info_mut(bounds).trainable = false;
        let seed = |part: u64| Rng::new(spec.seed, PURPOSE, part);
        let outputs = if spec.rigid { rows::HEADS + 3 } else { rows::HEADS };
        let trunk_of =
            |inputs: usize| MlpShape { inputs, width: spec.width, layers: spec.layers, skip: spec.skip, outputs };
        let (eyes, inputs) = match spec.input {
            Input::Encoded { x_levels, t_levels, time_net } => {
                if x_levels.max(t_levels) > MAX_LEVELS {
                    return Err(refused(&format!("encodings of more than {MAX_LEVELS} levels")));
                }
                let inputs = encoded(3, x_levels);
                // Checked before the shifts' sizes are taken from it.
                let maps = trunk_of(inputs).maps()?;
                let mut seen = encoded(1, t_levels);
                let mut time = None;
                if time_net {
                    let shape =
                        MlpShape { inputs: seen, width: TIME_WIDTH, layers: 1, skip: None, outputs: TIME_OUTPUTS };
                    time = Some(Mlp::new("deform_time", shape, 1.0, seed(1), p)?);
                    seen = TIME_OUTPUTS;
                }
                let linear = |i: usize| MlpShape { inputs: seen, width: 0, layers: 0, skip: None, outputs: maps[i].1 };
                // Where the trunk is one linear map, its shift is all that moves: it starts at zero, too.
                let size = if spec.layers == 0 { 0.0 } else { 1.0 };
                let enter = Mlp::new("deform_enter", linear(0), size, seed(2), p)?;
                let again = match spec.skip {
                    Some(s) => Some((Mlp::new("deform_again", linear(s + 1), 1.0, seed(3), p)?, s + 1)),
                    None => None,
                };
                (Eyes::Encoded { x_levels, t_levels, time, enter, again }, inputs)
            }
            Input::Hashed { space, time } => {
                let mut grids = vec![HashGrid::new("deform_xyz", space, &[0, 1, 2], POINT, seed(4), p)?];
                for (axes, name) in TIME_AXES.iter().zip(["deform_xyt", "deform_yzt", "deform_xzt"]) {
                    grids.push(HashGrid::new(name, time, axes, POINT, seed(5 + grids.len() as u64), p)?);
                }
                let inputs = grids.iter().map(|g| g.shape().outputs()).sum();
                (Eyes::Hashed { grids }, inputs)
            }
        };
        if spec.skip.is_some_and(|s| s + 1 >= spec.layers) {
            return Err(refused("a skip into its last map"));
        }
        let trunk = Mlp::new("deform_trunk", trunk_of(inputs), 0.0, seed(0), p)?;
        Ok(Self { spec, bounds, eyes, trunk })
    }

    /// Column groups of the networks.
    pub fn network_columns(&self) -> Vec<String> {
        let mut out = self.trunk.columns().to_vec();
        if let Eyes::Encoded { time, enter, again, .. } = &self.eyes {
            let parts = time.iter().chain([enter]).chain(again.iter().map(|(a, _)| a));
            out.extend(parts.flat_map(|m| m.columns().iter().cloned()));
        }
        out
    }

    /// Column groups of the grids by level, coarse ones first; empty without grids.
    pub fn grid_columns(&self) -> Vec<Vec<String>> {
        let Eyes::Hashed { grids } = &self.eyes else { return Vec::new() };
        let levels = grids.iter().map(|g| g.columns().len()).max().unwrap_or(0);
        (0..levels).map(|l| grids.iter().filter_map(|g| g.columns().get(l).cloned()).collect()).collect()
    }

    /// t̂ and dt̂/dt.
    fn unit_time(&self, t: Time) -> (f64, f64) {
        let [from, to] = self.spec.clip;
        let length = to - from;
        // A NaN becomes 0 here; nothing else of the model depends on time.
        if length > 0.0 && t.0 > from {
            if t.0 >= to { (1.0, 0.0) } else { ((t.0 - from) / length, 1.0 / length) }
        } else {
            (0.0, 0.0)
        }
    }

    fn bounds<F: Real>(&self, p: &Params<F>) -> Bounds<F> {
        let b = p[self.bounds].data();
        Bounds { center: [b[0], b[1], b[2]], radius: b[3], rigid: self.spec.rigid }
    }

    /// Evaluates the network for every row of the query.
    fn request<F: Real>(&self, q: &At<'_, F>, own: &mut Own<F>) {
        let (n, bounds, t) = (q.len(), self.bounds(q.p), F::of(self.unit_time(q.t).0));
        let geometry = &q.p[GEOMETRY];
        let place = |j: usize| bounds.unit(geometry.read::<3>(q.rows.id(j), 0));
        own.shifts.clear();
        match &self.eyes {
            Eyes::Encoded { x_levels, t_levels, time, enter, again } => {
                let inputs = encoded(3, *x_levels);
                own.x.resize(n * inputs, F::ZERO);
                own.x.par_chunks_mut(ROWS * inputs).enumerate().for_each(|(c, rows)| {
                    for (j, row) in rows.chunks_exact_mut(inputs).enumerate() {
                        encode(&place(c * ROWS + j), *x_levels, row);
                    }
                });
                own.time[0].resize(encoded(1, *t_levels), F::ZERO);
                encode(&[t], *t_levels, &mut own.time[0]);
                if let Some(time) = time {
                    own.time[1].resize(TIME_OUTPUTS, F::ZERO);
                    let [seen, made] = &mut own.time;
                    time.forward_keeping(q.p, seen, made, &mut own.time_kept);
                } else {
                    own.time[1] = own.time[0].clone();
                }
                let shift = |map: &Mlp| {
                    let mut out = vec![F::ZERO; map.shape().outputs];
                    map.forward(q.p, &own.time[1], &mut out);
                    out
                };
                own.shifts.push(shift(enter));
                if let Some((again, at)) = again {
                    own.shifts.resize(*at, Vec::new());
                    own.shifts.push(shift(again));
                }
            }
            Eyes::Hashed { grids } => {
                own.points.resize(n * POINT, F::ZERO);
                own.points.par_chunks_mut(ROWS * POINT).enumerate().for_each(|(c, rows)| {
                    for (j, row) in rows.chunks_exact_mut(POINT).enumerate() {
                        let x = place(c * ROWS + j);
                        // [−1, 1] becomes [0, 1].
                        row[..3].copy_from_slice(&x.map(|x| F::HALF * (x + F::ONE)));
                        row[3] = t;
                    }
                });
                let inputs = self.trunk.shape().inputs;
                own.x.resize(n * inputs, F::ZERO);
                let mut first = 0;
                for grid in grids {
                    grid.forward(q.p, &own.points, &mut own.x, first, inputs);
                    first += grid.shape().outputs();
                }
            }
        }
        own.heads.resize(n * self.trunk.shape().outputs, F::ZERO);
        self.trunk.forward_shifted(q.p, &own.x, &own.shifts, &mut own.heads, &mut own.kept);
    }

    /// The VJP of [`ask`](Self::request) from `own.d_heads`; returns dL/dt.
    fn request_backward<F: Real>(&self, q: &At<'_, F>, own: &mut Own<F>, d: &mut Grads<F>) -> f64 {
        let slope = self.unit_time(q.t).1;
        let Own { x, shifts, kept, d_heads, .. } = &*own;
        match &self.eyes {
            Eyes::Encoded { t_levels, time, enter, again, .. } => {
                let passed = Passed { x, shifts, kept: Some(kept) };
                let d_shifts = self.trunk.backward(q.p, passed, d_heads, InputGrad::Skip, d);
                let mut d_made = vec![F::ZERO; own.time[1].len()];
                let parts = [Some((enter, 0)), again.as_ref().map(|(map, at)| (map, *at))];
                for (map, at) in parts.into_iter().flatten() {
                    let mut part = vec![F::ZERO; d_made.len()];
                    map.backward(q.p, Passed::of(&own.time[1]), &d_shifts[at], InputGrad::Overwrite(&mut part), d);
                    d_made.iter_mut().zip(part).for_each(|(sum, x)| *sum += x);
                }
                if let Some(time) = time {
                    let mut d_seen = vec![F::ZERO; own.time[0].len()];
                    let passed = Passed::kept(&own.time[0], &own.time_kept);
                    time.backward(q.p, passed, &d_made, InputGrad::Overwrite(&mut d_seen), d);
                    d_made = d_seen;
                }
                let mut d_t = [F::ZERO];
                encode_backward(&own.time[0][..1], *t_levels, &d_made, &mut d_t);
                d_t[0].f64() * slope
            }
            Eyes::Hashed { grids } => {
                let inputs = self.trunk.shape().inputs;
                own.d_x.resize(own.x.len(), F::ZERO);
                let d_input = InputGrad::Overwrite(&mut own.d_x);
                self.trunk.backward(q.p, Passed::kept(&own.x, &own.kept), &own.d_heads, d_input, d);
                own.d_points.clear();
                own.d_points.resize(own.points.len(), F::ZERO);
                let mut first = 0;
                for (i, grid) in grids.iter().enumerate() {
                    // The grid over space does not depend on time, and x̂ is detached.
                    let d_points = (i > 0 && slope != 0.0).then_some(own.d_points.as_mut_slice());
                    grid.backward(q.p, &own.points, (&own.d_x, first, inputs), d_points, d);
                    first += grid.shape().outputs();
                }
                own.d_points.chunks_exact(POINT).map(|p| p[3].f64()).sum::<f64>() * slope
            }
        }
    }

    /// Whether all outputs are zero.
    fn rests<F: Real>(&self, p: &Params<F>) -> bool {
        let shifted = self.spec.layers == 0 && matches!(&self.eyes, Eyes::Encoded { enter, .. } if !enter.is_zero(p));
        !shifted && self.trunk.is_zero(p)
    }
}

impl<F: Real> Motion<F> for Deform {
    fn spec(&self) -> Spec {
        Spec::DeformMlp(self.spec.clone())
    }

    /// Bytes of the trunk's inputs and outputs, each with its gradient; of the hidden layers what [`LayerOutputs`]
    /// keeps.
    fn scratch_bytes(&self, _p: &Params<F>, rows: usize) -> u64 {
        let shape = self.trunk.shape();
        let number = size_of::<F>();
        let hidden = (rows * shape.layers * shape.width * number).min(LayerOutputs::<F>::BYTES);
        (rows * 2 * (shape.inputs + shape.outputs) * number + hidden) as u64
    }

    fn at(&self, q: &At<'_, F>, cache: &Cache, tape: &mut Tape<F>) {
        if q.of != Space::Gaussians {
            tape.start(0);
            return;
        }
        let rests = self.rests(q.p);
        let own: &mut Own<F> = tape.own.get_or_default();
        own.moves = !rests;
        own.asked = !rests || self.trunk.keys().any(|k| q.p.info(k).trainable);
        if own.asked {
            self.request(q, own);
        }
        if rests {
            Still.at(q, cache, tape);
            return;
        }
        tape.start(q.len());
        let own: &Own<F> = tape.own.get().expect("it was just made");
        let work = Written {
            geometry: &q.p[GEOMETRY],
            heads: &own.heads,
            width: self.trunk.shape().outputs,
            bounds: self.bounds(q.p),
        };
        fill(&work, [&mut tape.out], q.rows);
    }

    fn backward(
        &self,
        q: &At<'_, F>,
        _cache: &Cache,
        tape: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        _d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        if q.of != Space::Gaussians {
            return 0.0;
        }
        let own: &mut Own<F> = tape.own.get_or_default();
        if !own.asked {
            return Still.backward(q, &Cache::default(), &mut Tape::default(), d_out, &mut Slot::default(), d);
        }
        let (n, width) = (q.len(), self.trunk.shape().outputs);
        if own.d_rows.width() == 0 {
            own.d_rows = Table::new(&[("d_geometry", rows::GEOMETRY_WIDTH), ("d_heads", rows::HEADS + 3)], 0);
        }
        own.d_rows.resize(n);
        let heads = own.moves.then_some(own.heads.as_slice());
        let work = Gradient { geometry: &q.p[GEOMETRY], heads, width, bounds: self.bounds(q.p), d_out: d_out.out };
        fill(&work, [&mut own.d_rows], q.rows);
        let _ = scatter(&Spread(&own.d_rows), d.of([GEOMETRY]), q.rows);
        own.d_heads.resize(n * width, F::ZERO);
        Gather { d_rows: &own.d_rows, width }.run(&mut own.d_heads);
        self.request_backward(q, own, d)
    }
}
