//! [`Mlp`]: a perceptron over many rows, forward and backward a chunk of rows at a time, so that all layers of a chunk
//! are worked on while it is in the cache.
//!
//! a₀ = x, aᵢ₊₁ = max(0, aᵢ Wᵢᵀ + bᵢ), out = a_D W_Dᵀ + b_D; where `skip` = s the input of layer s + 1 is [a_{s+1}, x].
//! Backward: dWᵢ = dYᵢᵀ aᵢ, dbᵢ = Σ_rows dYᵢ, daᵢ = dYᵢ Wᵢ, masked where aᵢ is not positive. Weight gradients are
//! summed over a fixed number of runs of chunks and then in the order of the runs, so that the bits do not depend on
//! the number of threads.
//! Source: Yang et al. 2024 (Deformable 3D Gaussians) §3; weights start as He et al. 2015 §2.2.

use super::matmul::{Matrix, product};
use crate::math::{Real, Rng};
use crate::scene::{Grads, Key, Params};
use crate::simd::{Pass, Simd, dispatch_pass, greatest};
use crate::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Most numbers that a layer takes or gives.
pub(crate) const MAX_WIDTH: usize = 4096;
/// Most hidden layers.
pub(crate) const MAX_LAYERS: usize = 64;
/// Most weights in all, 64 MB in f32: eight layers of 1400.
pub(crate) const MAX_WEIGHTS: usize = 1 << 24;

/// Shape of a perceptron: `layers` hidden layers of `width` with ReLU, and a linear one; `layers` 0 is one linear map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MlpShape {
    /// Number of inputs.
    pub inputs: usize,
    /// Numbers in a hidden layer; not read where there is none.
    pub width: usize,
    /// Hidden layers.
    pub layers: usize,
    /// The input is appended again to the output of this hidden layer (counted from 0).
    pub skip: Option<usize>,
    /// Number of outputs.
    pub outputs: usize,
}

impl MlpShape {
    /// (inputs, outputs) of every linear map. Errors: a shape that no perceptron has, or that is too large.
    pub fn maps(&self) -> Result<Vec<(usize, usize)>> {
        let bad = |what: String| {
            Err(Error::input(format!("a network cannot have {what}"))
                .remedy("The file is damaged or was written by another program; export it again"))
        };
        if self.layers > MAX_LAYERS {
            return bad(format!("{} hidden layers: at most {MAX_LAYERS} are possible", self.layers));
        }
        let hidden = if self.layers > 0 { self.width } else { 1 };
        for (name, n) in [("inputs", self.inputs), ("width", hidden), ("outputs", self.outputs)] {
            if !(1..=MAX_WIDTH).contains(&n) {
                return bad(format!("{name} {n}: 1 to {MAX_WIDTH} is possible"));
            }
        }
        if self.skip.is_some_and(|s| s >= self.layers) {
            return bad(format!("a skip after hidden layer {:?} of {}", self.skip, self.layers));
        }
        let map = |i: usize| {
            let extra = if i > 0 && self.skip == Some(i - 1) { self.inputs } else { 0 };
            let inputs = if i == 0 { self.inputs } else { self.width + extra };
            (inputs, if i == self.layers { self.outputs } else { self.width })
        };
        let maps: Vec<(usize, usize)> = (0..=self.layers).map(map).collect();
        let weights: usize = maps.iter().map(|(i, o)| (i + 1) * o).sum();
        if weights > MAX_WEIGHTS {
            return bad(format!("{weights} weights: at most {MAX_WEIGHTS} are possible"));
        }
        Ok(maps)
    }
}

/// One linear map of a perceptron.
#[derive(Clone, Copy, Debug)]
struct Map {
    weight: Key,
    bias: Key,
    inputs: usize,
    outputs: usize,
}

/// A perceptron whose weights are in a layer's [`Params`].
#[derive(Clone, Debug)]
pub struct Mlp {
    shape: MlpShape,
    maps: Vec<Map>,
    columns: Vec<String>,
}

/// Record of a forward pass for its backward: the hidden activations of as many rows as `LayerOutputs::BYTES` hold. The
/// others are computed again, to the same bits.
#[derive(Clone, Debug, Default)]
pub struct LayerOutputs<F> {
    data: Vec<F>,
    chunks: usize,
}

impl<F> LayerOutputs<F> {
    /// Memory for activations: 65,000 rows of 8x256. Writing and reading them costs a fifth of computing them again.
    pub(crate) const BYTES: usize = 512 << 20;
}

/// A forward pass, for its backward.
#[derive(Clone, Copy, Debug)]
pub struct Passed<'a, F> {
    /// Its input, [n, inputs].
    pub x: &'a [F],
    /// Its shifts; see `Mlp::forward_shifted`.
    pub shifts: &'a [Vec<F>],
    /// The activations that it kept, of the same input, shifts and weights; without them they are computed again.
    pub kept: Option<&'a LayerOutputs<F>>,
}

impl<'a, F> Passed<'a, F> {
    /// A pass without shifts, of which nothing was kept.
    pub fn of(x: &'a [F]) -> Self {
        Self { x, shifts: &[], kept: None }
    }

    /// A pass without shifts, of which activations were kept.
    pub fn kept(x: &'a [F], kept: &'a LayerOutputs<F>) -> Self {
        Self { x, shifts: &[], kept: Some(kept) }
    }
}

/// The gradient to a network's input, [n, inputs].
#[derive(Debug)]
pub enum InputGrad<'a, F> {
    /// Not requested.
    Skip,
    /// Written.
    Overwrite(&'a mut [F]),
    /// Added to: for several networks that read the same input.
    Add(&'a mut [F]),
}

/// Numbers in one layer's activations of a chunk: half of a 1 MB second-level cache in f32, where weights and gradients
/// are too.
const CHUNK_NUMBERS: usize = 1 << 16;
/// Rows in a chunk, at least and at most.
const CHUNK_ROWS: [usize; 2] = [128, 2048];
/// Runs of chunks with a weight gradient each, at most: enough for as many threads.
const RUNS: usize = 16;
/// Numbers of a weight gradient that one task adds up.
const REDUCE: usize = 1 << 13;

impl Mlp {
    /// Makes or claims the tables `{name}.{i}.weight` (row-major [outputs, inputs]) and `{name}.{i}.bias`, all
    /// `Space::Fixed` of one column.
    ///
    /// Weights start uniform in ±√(6/inputs) (He et al. 2015), those of the last map times `last` (0: the zero map),
    /// biases at 0. Errors: see [`MlpShape::maps`]; loaded arrays of the wrong shape.
    pub fn new<F: Real>(name: &str, shape: MlpShape, last: f64, rng: Rng, p: &mut Params<F>) -> Result<Self> {
        let mut maps = Vec::new();
        let mut columns = Vec::new();
        for (i, (inputs, outputs)) in shape.maps()?.into_iter().enumerate() {
            let bound = (6.0 / inputs as f64).sqrt() * if i == shape.layers { last } else { 1.0 };
            let rng = rng.fork(i as u64);
            let names = [format!("{name}.{i}.weight"), format!("{name}.{i}.bias")];
            let weight = p.array(&names[0], inputs * outputs, |w| {
                for (j, w) in w.iter_mut().enumerate() {
                    *w = F::of(bound * (2.0 * rng.uniform(j as u64) - 1.0));
                }
            })?;
            let bias = p.array(&names[1], outputs, |_| {})?;
            maps.push(Map { weight, bias, inputs, outputs });
            columns.extend(names);
        }
        Ok(Self { shape, maps, columns })
    }

    /// The shape.
    pub fn shape(&self) -> MlpShape {
        self.shape
    }

    /// Names of the column groups that learn.
    pub(crate) fn columns(&self) -> &[String] {
        &self.columns
    }

    /// Weights and biases in all.
    pub(crate) fn weights(&self) -> usize {
        self.maps.iter().map(|m| (m.inputs + 1) * m.outputs).sum()
    }

    /// x [n, inputs] → out [n, outputs], row-major. Panics: lengths that are not n rows.
    pub fn forward<F: Real>(&self, p: &Params<F>, x: &[F], out: &mut [F]) {
        self.forward_keeping(p, x, out, &mut LayerOutputs { data: Vec::new(), chunks: usize::MAX });
    }

    /// As [`forward`](Self::forward), and remembers activations for [`backward`](Self::backward).
    pub fn forward_keeping<F: Real>(&self, p: &Params<F>, x: &[F], out: &mut [F], kept: &mut LayerOutputs<F>) {
        self.forward_shifted(p, x, &[], out, kept);
    }

    /// As [`forward_keeping`](Self::forward_keeping), where `shifts[i]`, unless absent or empty, is added to the bias
    /// of map i: what all rows share (a time's features) need not be repeated in every row.
    pub(crate) fn forward_shifted<F: Real>(
        &self,
        p: &Params<F>,
        x: &[F],
        shifts: &[Vec<F>],
        out: &mut [F],
        kept: &mut LayerOutputs<F>,
    ) {
        let n = self.rows(x, out);
        let biases = self.biases(p, shifts);
        let (rows, hidden) = (self.chunk_rows(), self.hidden());
        // `forward` requests nothing to be kept by a count that no pass can have.
        let wanted = if kept.chunks == usize::MAX { 0 } else { n.div_ceil(rows) };
        let per_chunk = rows * hidden;
        kept.chunks = wanted.min(LayerOutputs::<F>::BYTES / size_of::<F>() / per_chunk.max(1));
        kept.data.resize((kept.chunks * per_chunk).min(n * hidden), F::ZERO);
        let mut stores: Vec<&mut [F]> = kept.data.chunks_mut(per_chunk.max(1)).take(kept.chunks).collect();
        stores.resize_with(n.div_ceil(rows), || &mut []);
        let (inputs, outputs) = (self.shape.inputs, self.shape.outputs);
        x.par_chunks(rows * inputs).zip(out.par_chunks_mut(rows * outputs)).zip(stores).for_each_init(
            Vec::new,
            |scratch: &mut Vec<F>, ((x, out), store)| {
                let count = x.len() / inputs;
                let hidden = if store.is_empty() {
                    scratch.resize(per_chunk, F::ZERO);
                    &mut scratch[..count * hidden]
                } else {
                    store
                };
                self.activate(p, &biases, x, hidden);
                let last = self.shape.layers;
                self.map(p, &biases, last, self.input(last, x, hidden), out);
            },
        );
    }

    /// The VJP of a forward pass: adds weight gradients to `d` and returns the gradient to every map's shift.
    pub fn backward<F: Real>(
        &self,
        p: &Params<F>,
        passed: Passed<'_, F>,
        d_out: &[F],
        d_x: InputGrad<'_, F>,
        d: &mut Grads<F>,
    ) -> Vec<Vec<F>> {
        let Passed { x, shifts, kept } = passed;
        let n = self.rows(x, d_out);
        let biases = self.biases(p, shifts);
        let rows = self.chunk_rows();
        let chunks = n.div_ceil(rows);
        let runs = chunks.min(RUNS);
        let inputs = self.shape.inputs;
        // Every run is this many whole chunks, whichever thread works on it.
        let ends: Vec<usize> = (0..=runs).map(|r| (r * chunks / runs.max(1) * rows).min(n)).collect();
        let (mut rest, overwrite) = match d_x {
            InputGrad::Skip => (&mut [][..], false),
            InputGrad::Overwrite(d_x) => (d_x, true),
            InputGrad::Add(d_x) => (d_x, false),
        };
        let wanted = !rest.is_empty();
        assert!(!wanted || rest.len() == x.len(), "a gradient has the shape of its value");
        let mut parts: Vec<&mut [F]> = Vec::new();
        for run in ends.windows(2) {
            let (head, tail) = rest.split_at_mut(if wanted { (run[1] - run[0]) * inputs } else { 0 });
            parts.push(head);
            rest = tail;
        }
        let partial: Vec<Vec<F>> = parts
            .into_par_iter()
            .enumerate()
            .map(|(r, d_x)| {
                let mut run = Run::new(self);
                for first in (ends[r]..ends[r + 1]).step_by(rows) {
                    let count = rows.min(ends[r + 1] - first);
                    let x = &x[first * inputs..][..count * inputs];
                    let d_out = &d_out[first * self.shape.outputs..][..count * self.shape.outputs];
                    let from = (first - ends[r]) * inputs;
                    let d_x = if wanted { &mut d_x[from..from + count * inputs] } else { &mut [][..] };
                    if overwrite {
                        d_x.fill(F::ZERO);
                    }
                    let hidden = self.hidden();
                    let store = kept.filter(|kept| first / rows < kept.chunks);
                    let store = store.map(|kept| &kept.data[first * hidden..][..count * hidden]);
                    run.chunk(p, &biases, x, store, d_out, d_x);
                }
                run.d_weights
            })
            .collect();
        self.reduce(&partial, d)
    }

    /// Adds the runs' gradients in their order; returns those to the biases alone.
    fn reduce<F: Real>(&self, partial: &[Vec<F>], d: &mut Grads<F>) -> Vec<Vec<F>> {
        let mut first = 0;
        let mut biases = Vec::new();
        for map in &self.maps {
            for (key, len) in [(map.weight, map.inputs * map.outputs), (map.bias, map.outputs)] {
                let [table] = d.of([key]);
                table.data_mut()[..len].par_chunks_mut(REDUCE).enumerate().for_each(|(i, sum)| {
                    for part in partial {
                        for (sum, g) in sum.iter_mut().zip(&part[first + i * REDUCE..first + len]) {
                            *sum += *g;
                        }
                    }
                });
                first += len;
            }
            let from = first - map.outputs;
            let sum = |o: usize| partial.iter().fold(F::ZERO, |sum, part| sum + part[from + o]);
            biases.push((0..map.outputs).map(sum).collect());
        }
        biases
    }

    /// The biases with what is added to them.
    fn biases<F: Real>(&self, p: &Params<F>, shifts: &[Vec<F>]) -> Vec<Vec<F>> {
        let biases = self.maps.iter().map(|m| p[m.bias].data()[..m.outputs].to_vec());
        let mut biases: Vec<Vec<F>> = biases.collect();
        for (bias, shift) in biases.iter_mut().zip(shifts) {
            assert!(shift.is_empty() || shift.len() == bias.len(), "a shift has the shape of the bias it is added to");
            bias.iter_mut().zip(shift).for_each(|(b, s)| *b += *s);
        }
        biases
    }

    /// Whether the last map is zero, and so are all outputs; only it has a gradient then.
    pub(crate) fn is_zero<F: Real>(&self, p: &Params<F>) -> bool {
        let Map { weight, bias, .. } = self.maps[self.shape.layers];
        [weight, bias].iter().all(|&key| p[key].data().iter().all(|x| *x == F::ZERO))
    }

    /// Keys of every table.
    pub(crate) fn keys(&self) -> impl Iterator<Item = Key> + '_ {
        self.maps.iter().flat_map(|m| [m.weight, m.bias])
    }

    fn rows<F>(&self, x: &[F], out: &[F]) -> usize {
        let n = x.len() / self.shape.inputs;
        let expected = (n * self.shape.inputs, n * self.shape.outputs);
        assert_eq!((x.len(), out.len()), expected, "a network takes whole rows and gives as many");
        n
    }

    /// Rows of a chunk: by the shape alone.
    fn chunk_rows(&self) -> usize {
        (CHUNK_NUMBERS / self.shape.width.max(1)).clamp(CHUNK_ROWS[0], CHUNK_ROWS[1])
    }

    /// Numbers per row that the hidden layers give, with the input where it is next to them.
    fn hidden(&self) -> usize {
        self.maps[1..].iter().map(|m| m.inputs).sum()
    }

    /// The input [count, maps[i].inputs] of map i among x and the activations of a chunk.
    fn input<'a, F>(&self, i: usize, x: &'a [F], hidden: &'a [F]) -> &'a [F] {
        if i == 0 {
            return x;
        }
        let count = x.len() / self.shape.inputs;
        let first: usize = self.maps[1..i].iter().map(|m| m.inputs).sum();
        &hidden[count * first..count * (first + self.maps[i].inputs)]
    }

    /// Fills the activations of a chunk, map input after map input.
    fn activate<F: Real>(&self, p: &Params<F>, biases: &[Vec<F>], x: &[F], hidden: &mut [F]) {
        let count = x.len() / self.shape.inputs;
        let (mut before, mut rest) = (x, hidden);
        for i in 0..self.shape.layers {
            let stride = self.maps[i + 1].inputs;
            let (next, tail) = rest.split_at_mut(count * stride);
            self.map(p, biases, i, before, next);
            if stride > self.shape.width {
                for (row, x) in next.chunks_exact_mut(stride).zip(x.chunks_exact(self.shape.inputs)) {
                    row[self.shape.width..].copy_from_slice(x);
                }
            }
            (before, rest) = (next, tail);
        }
    }

    /// out = x Wᵢᵀ + bᵢ: hidden layers are clamped at zero, in rows as far apart as the next map's inputs.
    fn map<F: Real>(&self, p: &Params<F>, biases: &[Vec<F>], i: usize, x: &[F], out: &mut [F]) {
        let next = self.maps.get(i + 1);
        let (stride, relu) = (next.map_or(self.shape.outputs, |map| map.inputs), next.is_some());
        let Map { weight, inputs, outputs, .. } = self.maps[i];
        let w = Matrix::new(p[weight].data(), outputs, inputs, inputs);
        product(Matrix::new(x, x.len() / inputs, inputs, inputs), w.t(), out, stride, false);
        dispatch_pass(Simd::detect(), &Finish { bias: &biases[i], stride, relu }, &mut (), out);
    }
}

/// One run of chunks of a backward pass.
struct Run<'a, F> {
    mlp: &'a Mlp,
    /// Weight and bias of every map, one after the other.
    d_weights: Vec<F>,
    hidden: Vec<F>,
    /// Gradients to two maps' inputs, by turns.
    d_inputs: [Vec<F>; 2],
}

impl<'a, F: Real> Run<'a, F> {
    fn new(mlp: &'a Mlp) -> Self {
        Self { mlp, d_weights: vec![F::ZERO; mlp.weights()], hidden: Vec::new(), d_inputs: [Vec::new(), Vec::new()] }
    }

    /// Adds a chunk's weight gradients, and to d_x unless it is empty.
    fn chunk(&mut self, p: &Params<F>, biases: &[Vec<F>], x: &[F], kept: Option<&[F]>, d_out: &[F], d_x: &mut [F]) {
        let (mlp, simd) = (self.mlp, Simd::detect());
        let MlpShape { inputs: wide, width, layers, outputs, .. } = mlp.shape;
        let count = x.len() / wide;
        let hidden = match kept {
            Some(hidden) => hidden,
            None => {
                self.hidden.resize(mlp.chunk_rows() * mlp.hidden(), F::ZERO);
                mlp.activate(p, biases, x, &mut self.hidden[..count * mlp.hidden()]);
                &self.hidden[..]
            }
        };
        let mut end = self.d_weights.len();
        let [even, odd] = &mut self.d_inputs;
        for i in (0..=layers).rev() {
            let (into, from) = if i % 2 == 0 { (&mut *even, &*odd) } else { (&mut *odd, &*even) };
            // The gradient to what map i gives, in rows `stride` apart.
            let (d_y, stride) = if i == layers { (d_out, outputs) } else { (&from[..], mlp.maps[i + 1].inputs) };
            let Map { weight, inputs, outputs, .. } = mlp.maps[i];
            let d_map = &mut self.d_weights[end - (inputs + 1) * outputs..end];
            end -= d_map.len();
            let (d_w, d_b) = d_map.split_at_mut(inputs * outputs);
            let a = mlp.input(i, x, hidden);
            let dy = Matrix::new(d_y, count, outputs, stride);
            product(dy.t(), Matrix::new(a, count, inputs, inputs), d_w, inputs, true);
            dispatch_pass(simd, &Sum { rows: d_y, stride }, &mut (), d_b);
            let w = Matrix::new(p[weight].data(), outputs, inputs, inputs);
            if i == 0 {
                if !d_x.is_empty() {
                    product(dy, w, d_x, wide, true);
                }
                break;
            }
            into.resize(count * inputs, F::ZERO);
            product(dy, w, into, inputs, false);
            if inputs > width && !d_x.is_empty() {
                for (d_x, d_in) in d_x.chunks_exact_mut(wide).zip(into.chunks_exact(inputs)) {
                    d_x.iter_mut().zip(&d_in[width..]).for_each(|(d_x, d)| *d_x += *d);
                }
            }
            dispatch_pass(simd, &Mask { activations: a }, &mut (), into.as_mut_slice());
        }
    }
}

/// Adds the bias to every row, and clamps at zero.
struct Finish<'a, F> {
    bias: &'a [F],
    stride: usize,
    relu: bool,
}

impl<F: Real> Pass for Finish<'_, F> {
    type Scratch = ();
    type Into = [F];
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(&self, (): &mut (), out: &mut [F]) {
        for row in out.chunks_exact_mut(self.stride) {
            for (y, b) in row.iter_mut().zip(self.bias) {
                // A NaN stays one, so that the trainer's guard finds it.
                *y = if self.relu { greatest(*y + *b, F::ZERO) } else { *y + *b };
            }
        }
    }
}

/// Adds rows to one.
struct Sum<'a, F> {
    rows: &'a [F],
    stride: usize,
}

impl<F: Real> Pass for Sum<'_, F> {
    type Scratch = ();
    type Into = [F];
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(&self, (): &mut (), sum: &mut [F]) {
        for row in self.rows.chunks_exact(self.stride) {
            for (sum, x) in sum.iter_mut().zip(row) {
                *sum += *x;
            }
        }
    }
}

/// Takes gradients from where an activation is not positive.
struct Mask<'a, F> {
    activations: &'a [F],
}

impl<F: Real> Pass for Mask<'_, F> {
    type Scratch = ();
    type Into = [F];
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(&self, (): &mut (), d: &mut [F]) {
        for (d, a) in d.iter_mut().zip(self.activations) {
            *d = if *a > F::ZERO { *d } else { F::ZERO };
        }
    }
}

#[cfg(test)]
mod tests;
