//! `hexplane`: a canonical cloud that six feature planes deform (Wu et al. 2024, "4DGaussians").
//!
//! f = planes(x, t) (see [`nn::hexplane`](crate::nn::hexplane)), h = ReLU(trunk(f)), and a head each for
//! x_t = x + s·δx, log s_t = log s + δs, q_t = q + δq (raw, before it is normalised), logit o_t = logit o + δo and
//! SH_t = SH + δSH; any may be missing. s is half the longest side of the box, so that learning rates need no unit.
//! trunk = Linear then D − 1 times (ReLU, Linear), D = `defor_depth`, 0 and 1 alike; head = Linear, ReLU, Linear.
//!
//! The canonical positions are not detached: dL/dx has the planes' Jacobian too. The box [low, high] is stretched to
//! the planes' [0, 1]³, the clip to [0, 1]; points and times outside see the border. Heads start as zero, so the
//! deformation starts as the identity, whatever the planes are. In a resting [`Phase`] it is not evaluated.

use super::lanes::{Batch, Lane, Work, fill, scatter};
use super::still::{Still, activate_backward_lanes, activate_lanes};
use super::{At, Cache, Capabilities, Model, Motion, Phase, Spec, Tape};
use crate::math::{Real, Rng};
use crate::nn::hexplane::{LANES, Lines, PlaneShape, Planes};
use crate::nn::{InputGrad, LayerOutputs, Mlp, MlpShape, Passed};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, Color, GEOMETRY, Grads, Params, Rows, SH, SplatGrads, Table};
use crate::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Widest network and deepest trunk: four times and more what anyone uses.
const MAX_NET: [usize; 2] = [1024, 16];
/// Rows whose features are in memory at a time; more are computed again in the backward, to the same bits.
const ROWS: usize = 1 << 16;
/// Rows of a task that turns one layout into the other.
const TASK_ROWS: usize = 1024;
/// Numbers of a task that adds or masks: 128 kB in f32.
const TASK_NUMBERS: usize = 1 << 15;

/// Attributes that the planes may change.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Heads {
    /// Positions.
    pub position: bool,
    /// Log scales.
    pub scale: bool,
    /// Raw quaternions.
    pub rotation: bool,
    /// Opacity logits.
    pub opacity: bool,
    /// All spherical-harmonic coefficients.
    pub sh: bool,
}

impl Default for Heads {
    /// Position, scale and rotation, as on D-NeRF and HyperNeRF.
    fn default() -> Self {
        Self { position: true, scale: true, rotation: true, opacity: false, sh: false }
    }
}

/// The model as plain data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HexplaneSpec {
    /// Seed of planes and weights.
    pub seed: u64,
    /// Lower corner of the box that the planes cover, world.
    pub low: [f64; 3],
    /// Upper corner.
    pub high: [f64; 3],
    /// First and last second that the planes cover.
    pub clip: [f64; 2],
    /// Sizes of the planes.
    pub planes: PlaneShape,
    /// Width of the networks.
    pub net_width: usize,
    /// Linear maps of the trunk; 0 is 1.
    pub defor_depth: usize,
    /// Attributes that the planes may change.
    pub heads: Heads,
    /// [`Phase::levels`] of a scene whose training is not over; the features of the other levels are zero.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unlocked: Option<usize>,
    /// [`Phase::rests`] of a scene whose training is not over.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub coarse: bool,
}

impl Default for HexplaneSpec {
    /// The D-NeRF sizes: 32 channels, 64 and 128 grid points, 64 wide networks; a unit box and clip, not coarse.
    fn default() -> Self {
        Self {
            seed: 0,
            low: [-1.0; 3],
            high: [1.0; 3],
            clip: [0.0, 1.0],
            planes: PlaneShape { channels: 32, resolution: 64, time_resolution: 38, multires: vec![1, 2] },
            net_width: 64,
            defor_depth: 0,
            heads: Heads::default(),
            unlocked: None,
            coarse: false,
        }
    }
}

impl HexplaneSpec {
    fn check(&self) -> Result<()> {
        let bad = |what: String| {
            Err(Error::input(format!("hexplane: {what}"))
                .remedy("The file is damaged or was written by another program; export it again"))
        };
        self.planes.check()?;
        for k in 0..3 {
            let (low, high) = (self.low[k], self.high[k]);
            if !(low.is_finite() && high.is_finite() && low < high) {
                return bad(format!("the box reaches from {low} to {high} along axis {k}"));
            }
        }
        let [first, last] = self.clip;
        if !(first.is_finite() && last.is_finite() && first <= last) {
            return bad(format!("the clip reaches from {first} to {last} seconds"));
        }
        let [width, depth] = MAX_NET;
        if !(1..=width).contains(&self.net_width) || self.defor_depth > depth {
            return bad(format!(
                "a network of {} x {} is not 1 to {width} wide and up to {depth} deep",
                self.net_width, self.defor_depth
            ));
        }
        let levels = self.planes.multires.len();
        if self.levels() == 0 || self.levels() > levels {
            return bad(format!("{} of {levels} levels cannot be in use", self.levels()));
        }
        Ok(())
    }

    /// Levels of the planes in use.
    fn levels(&self) -> usize {
        self.unlocked.unwrap_or(self.planes.multires.len())
    }

    /// Displacement of a position for a head's output 1, scene units: half the longest side of the box.
    pub(crate) fn reach(&self) -> f64 {
        (0..3).map(|k| 0.5 * (self.high[k] - self.low[k])).fold(0.0, f64::max)
    }
}

/// A head that changes columns of the geometry: its name, the first column and how many there are.
const GEOMETRY_HEADS: [(&str, usize, usize); 4] =
    [("position", 0, 3), ("scale", LOG_SCALE, 3), ("rotation", QUAT, 4), ("opacity", OPACITY, 1)];

/// See the module's documentation.
#[derive(Clone, Debug)]
pub struct Hexplane {
    spec: HexplaneSpec,
    planes: Planes,
    trunk: Mlp,
    /// In the order of [`GEOMETRY_HEADS`].
    heads: [Option<Mlp>; 4],
    sh: Option<Mlp>,
}

impl Model for HexplaneSpec {
    fn build<F: Real>(&self, p: &mut Params<F>) -> Result<Arc<dyn Motion<F>>> {
        Ok(Arc::new(Hexplane::new(self.clone(), p)?))
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities::default()
    }
}

impl Hexplane {
    /// As its `Model::build`.
    pub fn new<F: Real>(spec: HexplaneSpec, p: &mut Params<F>) -> Result<Self> {
        spec.check()?;
        let rng = Rng::new(spec.seed, "hexplane", 0);
        let planes = Planes::new(spec.planes.clone(), rng.fork(0), p)?;
        let width = spec.net_width;
        let trunk = MlpShape {
            inputs: spec.planes.features(),
            width,
            layers: spec.defor_depth.max(1) - 1,
            skip: None,
            outputs: width,
        };
        let trunk = Mlp::new("hexplane.trunk", trunk, 1.0, rng.fork(1), p)?;
        let mut head = |name: &str, outputs: usize, stream: u64| {
            let shape = MlpShape { inputs: width, width, layers: 1, skip: None, outputs };
            Mlp::new(&format!("hexplane.{name}"), shape, 0.0, rng.fork(2 + stream), p)
        };
        let Heads { position, scale, rotation, opacity, sh } = spec.heads;
        let mut heads = [None, None, None, None];
        for (i, on) in [position, scale, rotation, opacity].into_iter().enumerate() {
            let (name, _, outputs) = GEOMETRY_HEADS[i];
            if on {
                heads[i] = Some(head(name, outputs, i as u64)?);
            }
        }
        let coefficients = p[SH].width();
        let sh = if sh && coefficients > 0 {
            let shape = MlpShape { inputs: width, width, layers: 1, skip: None, outputs: coefficients };
            Some(Mlp::new("hexplane.sh", shape, 0.0, rng.fork(2 + GEOMETRY_HEADS.len() as u64), p)?)
        } else {
            None
        };
        Ok(Self { spec, planes, trunk, heads, sh })
    }

    /// The same tables over another box. Errors: corners that are none.
    pub fn with_box(&self, [low, high]: [[f64; 3]; 2]) -> Result<Self> {
        let spec = HexplaneSpec { low, high, ..self.spec.clone() };
        spec.check()?;
        Ok(Self { spec, ..self.clone() })
    }

    /// The planes.
    pub fn planes(&self) -> &Planes {
        &self.planes
    }

    /// Names of the networks' column groups.
    pub fn network_columns(&self) -> Vec<String> {
        let heads = self.heads.iter().flatten().chain(&self.sh);
        std::iter::once(&self.trunk).chain(heads).flat_map(|m| m.columns().iter().cloned()).collect()
    }

    /// t in the clip's [0, 1]; outside it the ends (to which the planes clamp).
    fn share<F: Real>(&self, t: f64) -> F {
        let [first, last] = self.spec.clip;
        F::of(if last > first { ((t - first) / (last - first)).clamp(-1.0, 2.0) } else { 0.0 })
    }

    /// Features and trunk of rows `from..` of a query into `w`.
    fn trunk<F: Real>(&self, p: &Params<F>, lines: &Lines<F>, x: &[[F; 3]], w: &mut Activations<F>) {
        w.features.resize(x.len() * self.spec.planes.features(), F::ZERO);
        w.hidden.resize(x.len() * self.spec.net_width, F::ZERO);
        self.planes.forward(p, lines, self.spec.levels(), x, &mut w.features);
        self.trunk.forward_keeping(p, &w.features, &mut w.hidden, &mut w.trunk);
        w.hidden.par_chunks_mut(TASK_NUMBERS).for_each(|h| h.iter_mut().for_each(|h| *h = h.max(F::ZERO)));
    }
}

/// Activations of a chunk of rows up to the heads.
#[derive(Default)]
struct Activations<F> {
    /// [n, C·levels]
    features: Vec<F>,
    /// ReLU(trunk), [n, W]
    hidden: Vec<F>,
    trunk: LayerOutputs<F>,
    heads: [LayerOutputs<F>; 4],
    sh: LayerOutputs<F>,
}

/// Scratch of the backward, by chunk of rows: fresh memory every step would cost as much as the products.
#[derive(Default)]
struct Back<F> {
    d_hidden: Vec<F>,
    d_features: Vec<F>,
    waiting: Vec<[F; LANES]>,
}

/// The model's own part of a tape.
#[derive(Default)]
struct Own<F> {
    /// Positions in the box's [0, 1]³.
    x: Vec<[F; 3]>,
    /// Of the last chunk of rows; of all where there is one.
    work: Activations<F>,
    back: Back<F>,
    /// Outputs of the heads, [n, 3], [n, 3], [n, 4], [n, 1]; empty where there is none.
    deltas: [Vec<F>; 4],
    /// The deformed geometry, [n, 11].
    moved: Table<F>,
    /// The deformed colours, [n, 3·K], if there is a head for them.
    sh: Table<F>,
}

fn start<F: Real>(table: &mut Table<F>, name: &'static str, width: usize, rows: usize) {
    if table.width() == width {
        table.resize(rows);
    } else {
        *table = Table::new(&[(name, width)], rows);
    }
}

impl<F: Real> Motion<F> for Hexplane {
    fn spec(&self) -> Spec {
        Spec::Hexplane(self.spec.clone())
    }

    fn with_phase(&self, phase: &Phase) -> Option<Arc<dyn Motion<F>>> {
        let levels = self.spec.planes.multires.len();
        let unlocked = phase.levels.filter(|&n| n < levels).map(|n| n.max(1));
        let spec = HexplaneSpec { unlocked, coarse: phase.rests, ..self.spec.clone() };
        Some(Arc::new(Self { spec, ..self.clone() }))
    }

    /// Place, outputs of the heads and what became of them; features and trunk with their gradients, hidden layers.
    fn scratch_bytes(&self, p: &Params<F>, rows: usize) -> u64 {
        let colors = self.sh.as_ref().map_or(0, |h| h.shape().outputs);
        let heads = self.heads.iter().flatten().chain(&self.sh).count();
        let (width, features) = (self.spec.net_width, self.spec.planes.features());
        let hidden = heads + self.trunk.shape().layers;
        let numbers = 3 + 2 * (p[GEOMETRY].width() + colors) + 2 * (features + width) + hidden * width;
        (rows * numbers * size_of::<F>()) as u64
    }

    fn at(&self, q: &At<'_, F>, cache: &Cache, tape: &mut Tape<F>) {
        if self.spec.coarse {
            return Still.at(q, cache, tape);
        }
        let n = q.len();
        tape.start(n);
        let own: &mut Own<F> = tape.own.get_or_default();
        start(&mut own.moved, "moved", 11, n);
        self.locate(q, &mut own.x);
        let lines = self.planes.lines(q.p, self.share(q.t.0));
        for (head, delta) in self.heads.iter().zip(&mut own.deltas) {
            delta.resize(head.as_ref().map_or(0, |h| n * h.shape().outputs), F::ZERO);
        }
        let colors: usize = self.sh.as_ref().map_or(0, |h| h.shape().outputs);
        let mut d_sh = vec![F::ZERO; n * colors];
        for from in (0..n).step_by(ROWS) {
            let to = n.min(from + ROWS);
            let Own { x, work, deltas, .. } = own;
            self.trunk(q.p, &lines, &x[from..to], work);
            for ((head, delta), kept) in self.heads.iter().zip(deltas).zip(&mut work.heads) {
                if let Some(head) = head {
                    let width = head.shape().outputs;
                    head.forward_keeping(q.p, &work.hidden, &mut delta[from * width..to * width], kept);
                }
            }
            if let Some(head) = &self.sh {
                head.forward_keeping(q.p, &work.hidden, &mut d_sh[from * colors..to * colors], &mut work.sh);
            }
        }
        let deltas = Deltas { heads: own.deltas.each_ref().map(Vec::as_slice), reach: F::of(self.spec.reach()) };
        fill(&Forward { geometry: &q.p[GEOMETRY], deltas }, [&mut tape.out, &mut own.moved], q.rows);
        if colors > 0 {
            start(&mut own.sh, "sh", colors, n);
            let base = &q.p[SH];
            crate::scene::table::par_split([own.sh.view_mut()], &|[mut view]| {
                for j in view.first..view.first + view.rows {
                    for c in 0..colors {
                        view.write(j, c, [base.get(q.rows.id(j), c) + d_sh[j * colors + c]]);
                    }
                }
                0.0
            });
        }
    }

    fn color<'a>(&self, q: &At<'a, F>, tape: &'a Tape<F>) -> Color<'a, F> {
        match (&self.sh, tape.own.get::<Own<F>>()) {
            (Some(_), Some(own)) if !self.spec.coarse => {
                Color::Sh { table: &own.sh, rows: Rows::All, weights: None, base: false }
            }
            _ => Color::Sh { table: &q.p[SH], rows: q.rows, weights: None, base: true },
        }
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
        if self.spec.coarse {
            return Still.backward(q, cache, tape, d_out, d_cache, d);
        }
        let n = q.len();
        let own: &mut Own<F> = tape.own.get_or_default();
        assert_eq!(own.x.len(), n, "a backward follows the forward of the same query");
        let lines = self.planes.lines(q.p, self.share(q.t.0));
        let mut d_rows = Table::new(&[("d_rows", 11)], n);
        fill(&Activated { moved: &own.moved, d_out: d_out.out }, [&mut d_rows], Rows::All);
        let d_deltas: [Vec<F>; 4] = std::array::from_fn(|i| match &self.heads[i] {
            Some(_) => {
                let (_, first, width) = GEOMETRY_HEADS[i];
                let scale = if first == 0 { F::of(self.spec.reach()) } else { F::ONE };
                row_major(&d_rows, first, width, scale)
            }
            None => Vec::new(),
        });
        let d_sh = match (&self.sh, d_out.color) {
            (Some(head), Some(color)) => row_major(color, 0, head.shape().outputs, F::ONE),
            _ => Vec::new(),
        };
        let mut d_x = vec![[F::ZERO; 3]; n];
        let mut d_time = 0.0;
        for from in (0..n).step_by(ROWS) {
            let to = n.min(from + ROWS);
            let Own { x, work, back, .. } = own;
            let x = &x[from..to];
            if n > ROWS {
                self.trunk(q.p, &lines, x, work);
                // What is kept of the heads is of the last chunk alone.
                (work.heads, work.sh) = Default::default();
            }
            let Back { d_hidden, d_features, waiting } = back;
            d_hidden.resize(work.hidden.len(), F::ZERO);
            d_features.resize(work.features.len(), F::ZERO);
            let heads = self.heads.iter().zip(&d_deltas).zip(&work.heads);
            let heads = heads.map(|((head, d), kept)| (head, d, kept)).chain([(&self.sh, &d_sh, &work.sh)]);
            let mut first = true;
            for (head, d_delta, kept) in heads {
                let (Some(head), false) = (head, d_delta.is_empty()) else { continue };
                let width = head.shape().outputs;
                let d_delta = &d_delta[from * width..to * width];
                let d_input = if std::mem::take(&mut first) { InputGrad::Overwrite } else { InputGrad::Add };
                head.backward(q.p, Passed::kept(&work.hidden, kept), d_delta, d_input(d_hidden), d);
            }
            if first {
                // Without heads nothing depends on the planes.
                continue;
            }
            let pairs = d_hidden.par_chunks_mut(TASK_NUMBERS).zip(work.hidden.par_chunks(TASK_NUMBERS));
            pairs.for_each(|(d, h)| {
                d.iter_mut().zip(h).for_each(|(d, h)| *d = if *h > F::ZERO { *d } else { F::ZERO });
            });
            let d_input = InputGrad::Overwrite(d_features);
            self.trunk.backward(q.p, Passed::kept(&work.features, &work.trunk), d_hidden, d_input, d);
            let d_x = &mut d_x[from..to];
            d_time += self.planes.backward(q.p, &lines, self.spec.levels(), x, d_features, d_x, waiting, d).f64();
        }
        let sides = std::array::from_fn(|k| F::of(1.0 / (self.spec.high[k] - self.spec.low[k])));
        scatter(&Gather { d_rows: &d_rows, d_x: &d_x, sides }, d.of([GEOMETRY]), q.rows);
        if let (Some(_), Some(color)) = (&self.sh, d_out.color) {
            let width = color.width();
            super::for_rows(d.of([SH]), q.rows, |j, id, [d_sh]| {
                for c in 0..width {
                    d_sh.add(id, c, [color.get(j, c)]);
                }
                0.0
            });
        }
        let [first, last] = self.spec.clip;
        if last > first { d_time / (last - first) } else { 0.0 }
    }
}

impl Hexplane {
    /// Positions of the requested rows in the box's [0, 1]³.
    fn locate<F: Real>(&self, q: &At<'_, F>, x: &mut Vec<[F; 3]>) {
        let (low, high) = (self.spec.low, self.spec.high);
        let origin: [F; 3] = std::array::from_fn(|k| F::of(low[k]));
        let sides: [F; 3] = std::array::from_fn(|k| F::of(1.0 / (high[k] - low[k])));
        x.resize(q.len(), [F::ZERO; 3]);
        let geometry = &q.p[GEOMETRY];
        x.par_chunks_mut(TASK_ROWS).enumerate().for_each(|(task, x)| {
            for (j, x) in x.iter_mut().enumerate() {
                let mean = geometry.read::<3>(q.rows.id(task * TASK_ROWS + j), 0);
                *x = std::array::from_fn(|k| (mean[k] - origin[k]) * sides[k]);
            }
        });
    }
}

/// Neighbouring columns times a factor as a row-major array.
fn row_major<F: Real>(table: &Table<F>, first: usize, width: usize, scale: F) -> Vec<F> {
    let mut out = vec![F::ZERO; table.rows() * width];
    out.par_chunks_mut(TASK_ROWS * width.max(1)).enumerate().for_each(|(task, out)| {
        for (j, out) in out.chunks_exact_mut(width).enumerate() {
            for (c, out) in out.iter_mut().enumerate() {
                *out = scale * table.get(task * TASK_ROWS + j, first + c);
            }
        }
    });
    out
}

/// The heads' outputs, compact and row-major.
struct Deltas<'a, F> {
    heads: [&'a [F]; 4],
    reach: F,
}

/// Canonical rows and deltas → splats and deformed rows.
struct Forward<'a, F> {
    geometry: &'a Table<F>,
    deltas: Deltas<'a, F>,
}

impl<F: Real> Work<F, 2> for Forward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out, moved]: &mut [TableMut<'_, F>; 2]) -> f64 {
        let mut g: [Lane<F>; 11] = batch.ids.read(self.geometry, 0);
        for (delta, (_, first, width)) in self.deltas.heads.iter().zip(GEOMETRY_HEADS) {
            if delta.is_empty() {
                continue;
            }
            let scale = if first == 0 { self.deltas.reach } else { F::ONE };
            for l in (0..BLOCK).filter(|&l| batch.live[l]) {
                let row = &delta[batch.at.row(l) * width..][..width];
                for (c, x) in row.iter().enumerate() {
                    g[first + c][l] += scale * *x;
                }
            }
        }
        batch.write(moved, 0, &g);
        batch.write(out, 0, &activate_lanes(&g));
        0.0
    }
}

/// VJP of the activation, all compact.
struct Activated<'a, F> {
    moved: &'a Table<F>,
    d_out: &'a Table<F>,
}

impl<F: Real> Work<F, 1> for Activated<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_rows]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let rows = activate_backward_lanes(&batch.at.read(self.moved, 0), &batch.at.read(self.d_out, 0));
        batch.write(d_rows, 0, &rows);
        0.0
    }
}

/// Adds the deformed rows' gradient, and what the planes' Jacobian makes of it, to the canonical rows'.
struct Gather<'a, F> {
    d_rows: &'a Table<F>,
    d_x: &'a [[F; 3]],
    sides: [F; 3],
}

impl<F: Real> Work<F, 1> for Gather<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d_geometry]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let mut rows: [Lane<F>; 11] = batch.at.read(self.d_rows, 0);
        for l in (0..BLOCK).filter(|&l| batch.live[l]) {
            let d_x = self.d_x[batch.at.row(l)];
            for k in 0..3 {
                rows[k][l] += self.sides[k] * d_x[k];
            }
        }
        batch.add(d_geometry, 0, &rows);
        0.0
    }
}

#[cfg(test)]
mod tests;
