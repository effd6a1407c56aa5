//! The residual block of a sequence model, for sixteen sequences at a time: LayerNorm → state space, in one or both
//! directions → GELU → linear → residual.
//!
//! Numbers are as [rows, ticks] of lanes, so that a layer that mixes rows is one matrix product for all ticks, and a
//! scan reads one row from end to end. Gradients of weights are added to; those of activations are written over where a
//! function states so.

use super::matmul::{Matrix, product};
use super::ssm::{self, Direction, Discrete, LANES, Lane, Pair};
use crate::math::{Real, Rng};
use crate::simd::{Kernel, Simd, dispatch, total};
use std::ops::Range;

/// Keeps a norm from dividing by zero (the usual value).
const NORM_FLOOR: f64 = 1e-5;
/// x·σ(1.702x) is within 0.02 of GELU (Hendrycks and Gimpel 2016).
const GELU_SLOPE: f64 = 1.702;

/// Named parts of one long slice of weights.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Layout {
    parts: Vec<(String, Range<usize>)>,
    len: usize,
}

impl Layout {
    /// Appends a part of `numbers`; returns its position.
    pub(crate) fn push(&mut self, name: String, numbers: usize) -> Range<usize> {
        let at = self.len..self.len + numbers;
        self.len = at.end;
        self.parts.push((name, at.clone()));
        at
    }

    /// Names and positions, in order.
    pub(crate) fn parts(&self) -> &[(String, Range<usize>)] {
        &self.parts
    }

    /// Numbers in all.
    pub(crate) fn len(&self) -> usize {
        self.len
    }
}

/// Runs a loop over lanes compiled for the best SIMD level.
#[inline(always)]
pub(crate) fn fast(work: impl FnOnce()) {
    struct Do<W>(W);
    impl<W: FnOnce()> Kernel for Do<W> {
        type Out = ();
        #[inline(always)]
        fn run<const FMA: bool>(self) {
            (self.0)();
        }
    }
    dispatch(Simd::detect(), Do(work));
}

/// out = W·x + b: W \[outputs, inputs\], b \[outputs\] or nothing, x \[inputs, ticks\], out \[outputs, ticks\].
pub(crate) fn linear<F: Real>(w: &[F], bias: &[F], inputs: usize, x: &[Lane<F>], out: &mut [Lane<F>]) {
    let (outputs, columns) = (w.len() / inputs, x.len() / inputs * LANES);
    product(
        Matrix::new(w, outputs, inputs, inputs),
        Matrix::new(x.as_flattened(), inputs, columns, columns),
        out.as_flattened_mut(),
        columns,
        false,
    );
    for (row, b) in out.chunks_exact_mut(columns / LANES).zip(bias) {
        row.as_flattened_mut().iter_mut().for_each(|y| *y += *b);
    }
}

/// VJP of [`linear`]: adds to d_w, d_bias (may be empty) and d_x.
pub(crate) fn linear_backward<F: Real>(
    w: &[F],
    inputs: usize,
    x: &[Lane<F>],
    d_out: &[Lane<F>],
    (d_w, d_bias): (&mut [F], &mut [F]),
    d_x: &mut [Lane<F>],
) {
    let (outputs, columns) = (w.len() / inputs, x.len() / inputs * LANES);
    let of = |x, rows| Matrix::new(x, rows, columns, columns);
    let (x, d_out) = (x.as_flattened(), d_out.as_flattened());
    product(of(d_out, outputs), of(x, inputs).t(), d_w, inputs, true);
    product(Matrix::new(w, outputs, inputs, inputs).t(), of(d_out, outputs), d_x.as_flattened_mut(), columns, true);
    for (row, d) in d_out.chunks_exact(columns).zip(d_bias) {
        *d += sum(row.as_chunks().0);
    }
}

/// The sum over ticks and lanes.
pub(crate) fn sum<F: Real>(row: &[Lane<F>]) -> F {
    let mut sums = [F::ZERO; LANES];
    for lane in row {
        for l in 0..LANES {
            sums[l] += lane[l];
        }
    }
    total(sums)
}

/// x·σ(1.702x)
pub(crate) fn gelu<F: Real>(x: &[Lane<F>], out: &mut [Lane<F>]) {
    fast(|| {
        for (x, out) in x.iter().zip(out) {
            for l in 0..LANES {
                out[l] = x[l] * (F::of(GELU_SLOPE) * x[l]).sigmoid();
            }
        }
    });
}

/// VJP of [`gelu`], in place: the gradient to the output becomes that to x.
pub(crate) fn gelu_backward<F: Real>(x: &[Lane<F>], d: &mut [Lane<F>]) {
    fast(|| {
        for (x, d) in x.iter().zip(d) {
            for l in 0..LANES {
                let s = (F::of(GELU_SLOPE) * x[l]).sigmoid();
                d[l] *= s * (F::ONE + F::of(GELU_SLOPE) * x[l] * (F::ONE - s));
            }
        }
    });
}

/// Normalises over rows: `unit` \[rows, ticks\] gets (x − mean)/deviation, `inverse` \[ticks\] 1/deviation.
pub(crate) fn norm<F: Real>(x: &[Lane<F>], rows: usize, unit: &mut [Lane<F>], inverse: &mut [Lane<F>]) {
    let ticks = x.len() / rows;
    let share = F::of(1.0 / rows as f64);
    let mut mean = vec![[F::ZERO; LANES]; ticks];
    fast(|| {
        for row in x.chunks_exact(ticks) {
            for (mean, x) in mean.iter_mut().zip(row) {
                for l in 0..LANES {
                    mean[l] += share * x[l];
                }
            }
        }
        inverse.fill([F::of(NORM_FLOOR); LANES]);
        for (row, unit) in x.chunks_exact(ticks).zip(unit.chunks_exact_mut(ticks)) {
            for (((x, unit), mean), square) in row.iter().zip(unit).zip(&mean).zip(inverse.iter_mut()) {
                for l in 0..LANES {
                    unit[l] = x[l] - mean[l];
                    square[l] += share * unit[l] * unit[l];
                }
            }
        }
        for square in inverse.iter_mut() {
            for l in 0..LANES {
                square[l] = F::ONE / square[l].sqrt();
            }
        }
        for unit in unit.chunks_exact_mut(ticks) {
            for (unit, inverse) in unit.iter_mut().zip(inverse.iter()) {
                for l in 0..LANES {
                    unit[l] *= inverse[l];
                }
            }
        }
    });
}

/// VJP of [`norm`]: adds (d_unit − mean(d_unit) − unit·mean(d_unit·unit))/deviation to d_x.
pub(crate) fn norm_backward<F: Real>(unit: &[Lane<F>], inverse: &[Lane<F>], d_unit: &[Lane<F>], d_x: &mut [Lane<F>]) {
    let ticks = inverse.len();
    let share = F::of(ticks as f64 / unit.len() as f64);
    let mut means = vec![[[F::ZERO; LANES]; 2]; ticks];
    fast(|| {
        for (unit, d) in unit.chunks_exact(ticks).zip(d_unit.chunks_exact(ticks)) {
            for ((unit, d), [mean, along]) in unit.iter().zip(d).zip(&mut means) {
                for l in 0..LANES {
                    mean[l] += share * d[l];
                    along[l] += share * d[l] * unit[l];
                }
            }
        }
        let rows = unit.chunks_exact(ticks).zip(d_unit.chunks_exact(ticks)).zip(d_x.chunks_exact_mut(ticks));
        for ((unit, d), d_x) in rows {
            let of_tick = unit.iter().zip(d).zip(d_x).zip(&means).zip(inverse);
            for ((((unit, d), d_x), [mean, along]), inverse) in of_tick {
                for l in 0..LANES {
                    d_x[l] += inverse[l] * (d[l] - mean[l] - unit[l] * along[l]);
                }
            }
        }
    });
}

/// One residual block: positions of its weights.
#[derive(Clone, Debug)]
pub(crate) struct Block {
    /// Rows of numbers.
    width: usize,
    norm: [Range<usize>; 2],
    scans: Scans,
    mix: [Range<usize>; 2],
}

/// The state-space layers of a block, one a direction.
#[derive(Clone, Debug)]
pub(crate) struct Scans {
    shape: ssm::Shape,
    /// One of the past, or one of the past and one of the future.
    ways: Vec<(Direction, Range<usize>)>,
    /// Index of the first one among the net's discretised layers.
    first: usize,
}

impl Scans {
    /// Appends the layers' weights. `both`: also from the last tick to the first.
    pub(crate) fn new(name: &str, shape: ssm::Shape, ways: &[Direction], first: usize, layout: &mut Layout) -> Self {
        let mut place = |way: Direction| {
            let side = if way == Direction::Forward { "past" } else { "future" };
            let at = ssm::arrays(shape).map(|(array, n)| layout.push(format!("{name}.{side}.{array}"), n));
            (way, at[0].start..at[5].end)
        };
        Self { shape, ways: ways.iter().map(|&w| place(w)).collect(), first }
    }

    /// Number of scans.
    pub(crate) fn count(&self) -> usize {
        self.ways.len()
    }

    /// First weights.
    pub(crate) fn init<F: Real>(&self, ticks: usize, rng: Rng, w: &mut [F]) {
        for (i, (_, at)) in self.ways.iter().enumerate() {
            ssm::init(self.shape, ticks, rng.fork(i as u64), &mut w[at.clone()]);
        }
    }

    /// The layers as the scan needs them.
    pub(crate) fn discrete<F: Real>(&self, w: &[F], gaps: &[f64]) -> Vec<Discrete<F>> {
        self.ways.iter().map(|(_, at)| Discrete::new(self.shape, &w[at.clone()], gaps)).collect()
    }

    /// VJP of [`discrete`](Self::discrete): `d` are those of the whole net.
    pub(crate) fn discrete_backward<F: Real>(&self, w: &[F], gaps: &[f64], d: &[Discrete<F>], d_w: &mut [F]) {
        for ((_, at), d) in self.ways.iter().zip(&d[self.first..]) {
            Discrete::backward(&w[at.clone()], gaps, d, &mut d_w[at.clone()]);
        }
    }

    /// The scans of u \[rows, ticks\], one below the other in y \[ways·rows, ticks\].
    pub(crate) fn forward<F: Real>(
        &self,
        layers: &[Discrete<F>],
        u: &[Lane<F>],
        y: &mut [Lane<F>],
        marks: &mut Vec<Vec<Pair<F>>>,
    ) {
        marks.resize_with(self.count(), Vec::new);
        let scans = self.ways.iter().zip(&layers[self.first..]).zip(y.chunks_exact_mut(u.len())).zip(marks);
        for ((((way, _), layer), y), marks) in scans {
            layer.scan(*way, u, y, &mut layer.rest(), marks);
        }
    }

    /// VJP of [`forward`](Self::forward): adds to d_u and to the gradients of the net's layers.
    pub(crate) fn backward<F: Real>(
        &self,
        layers: &[Discrete<F>],
        (u, marks): (&[Lane<F>], &[Vec<Pair<F>>]),
        d_y: &[Lane<F>],
        d_u: &mut [Lane<F>],
        d: &mut [Discrete<F>],
    ) {
        for (i, ((way, _), marks)) in self.ways.iter().zip(marks).enumerate() {
            let (layer, d) = (&layers[self.first + i], &mut d[self.first + i]);
            let d_y = &d_y[i * u.len()..(i + 1) * u.len()];
            layer.scan_backward(*way, u, marks, d_y, d_u, &mut layer.rest(), d);
        }
    }
}

/// Record of a block's forward for its backward.
#[derive(Clone, Debug, Default)]
pub(crate) struct BlockTape<F> {
    unit: Vec<Lane<F>>,
    inverse: Vec<Lane<F>>,
    normed: Vec<Lane<F>>,
    seen: Vec<Lane<F>>,
    marks: Vec<Vec<Pair<F>>>,
}

/// Makes a buffer `len` long, all zero.
pub(crate) fn clear<F: Real>(buffer: &mut Vec<Lane<F>>, len: usize) {
    buffer.clear();
    buffer.resize(len, [F::ZERO; LANES]);
}

impl Block {
    /// Appends a block's weights to the layout; its layers are the net's from number `first` on.
    pub(crate) fn new(
        name: &str,
        width: usize,
        states: usize,
        ways: &[Direction],
        first: usize,
        layout: &mut Layout,
    ) -> Self {
        let norm = ["norm.scale", "norm.shift"].map(|part| layout.push(format!("{name}.{part}"), width));
        let shape = ssm::Shape { channels: width, states, copies: 1 };
        let scans = Scans::new(name, shape, ways, first, layout);
        let inputs = scans.count() * width;
        let mix = [("mix.weight", inputs * width), ("mix.bias", width)]
            .map(|(part, n)| layout.push(format!("{name}.{part}"), n));
        Self { width, norm, scans, mix }
    }

    /// The state-space layers.
    pub(crate) fn scans(&self) -> &Scans {
        &self.scans
    }

    /// First weights: norms with unit weights, S4D-Lin, uniform linear maps.
    pub(crate) fn init<F: Real>(&self, ticks: usize, rng: Rng, w: &mut [F]) {
        w[self.norm[0].clone()].fill(F::ONE);
        self.scans.init(ticks, rng.fork(1), w);
        uniform(&mut w[self.mix[0].clone()], self.scans.count() * self.width, rng.fork(2));
    }

    /// x \[width, ticks\] ← x + W·gelu(scans(norm(x))) + b
    pub(crate) fn forward<F: Real>(&self, w: &[F], layers: &[Discrete<F>], x: &mut [Lane<F>], tape: &mut BlockTape<F>) {
        let (ticks, inputs) = (x.len() / self.width, self.scans.count() * self.width);
        clear(&mut tape.unit, x.len());
        clear(&mut tape.inverse, ticks);
        clear(&mut tape.normed, x.len());
        clear(&mut tape.seen, inputs * ticks);
        norm(x, self.width, &mut tape.unit, &mut tape.inverse);
        let [scale, shift] = [0, 1].map(|k| &w[self.norm[k].clone()]);
        for (row, (normed, unit)) in tape.normed.chunks_exact_mut(ticks).zip(tape.unit.chunks_exact(ticks)).enumerate()
        {
            affine(unit, scale[row], shift[row], normed);
        }
        self.scans.forward(layers, &tape.normed, &mut tape.seen, &mut tape.marks);
        let mut bent = vec![[F::ZERO; LANES]; tape.seen.len()];
        gelu(&tape.seen, &mut bent);
        let mut step = vec![[F::ZERO; LANES]; x.len()];
        linear(&w[self.mix[0].clone()], &w[self.mix[1].clone()], inputs, &bent, &mut step);
        add(x, &step);
    }

    /// VJP of [`forward`](Self::forward): d_x, the gradient to the output, becomes that to the input.
    pub(crate) fn backward<F: Real>(
        &self,
        w: &[F],
        layers: &[Discrete<F>],
        tape: &BlockTape<F>,
        d_x: &mut [Lane<F>],
        (d_w, d_layers): (&mut [F], &mut [Discrete<F>]),
    ) {
        let (ticks, inputs) = (d_x.len() / self.width, self.scans.count() * self.width);
        let zero = [F::ZERO; LANES];
        let (mut bent, mut d_seen) = (vec![zero; tape.seen.len()], vec![zero; tape.seen.len()]);
        gelu(&tape.seen, &mut bent);
        let [d_mix, d_bias] = d_w.get_disjoint_mut(self.mix.clone()).expect("a layout's parts are apart");
        linear_backward(&w[self.mix[0].clone()], inputs, &bent, d_x, (d_mix, d_bias), &mut d_seen);
        gelu_backward(&tape.seen, &mut d_seen);
        let mut d_normed = vec![zero; d_x.len()];
        self.scans.backward(layers, (&tape.normed, &tape.marks), &d_seen, &mut d_normed, d_layers);
        let [d_scale, d_shift] = d_w.get_disjoint_mut(self.norm.clone()).expect("a layout's parts are apart");
        let scale = &w[self.norm[0].clone()];
        for (row, (d, unit)) in d_normed.chunks_exact_mut(ticks).zip(tape.unit.chunks_exact(ticks)).enumerate() {
            let (by_scale, by_shift) = affine_backward(unit, scale[row], d);
            d_scale[row] += by_scale;
            d_shift[row] += by_shift;
        }
        norm_backward(&tape.unit, &tape.inverse, &d_normed, d_x);
    }
}

/// First weights of a linear map from `inputs` rows: uniform in ±1/√inputs.
pub(crate) fn uniform<F: Real>(w: &mut [F], inputs: usize, rng: Rng) {
    let bound = 1.0 / (inputs.max(1) as f64).sqrt();
    w.iter_mut().enumerate().for_each(|(i, w)| *w = F::of(bound * (2.0 * rng.uniform(i as u64) - 1.0)));
}

/// a += b
pub(crate) fn add<F: Real>(a: &mut [Lane<F>], b: &[Lane<F>]) {
    a.as_flattened_mut().iter_mut().zip(b.as_flattened()).for_each(|(a, b)| *a += *b);
}

fn affine<F: Real>(x: &[Lane<F>], scale: F, shift: F, out: &mut [Lane<F>]) {
    out.as_flattened_mut().iter_mut().zip(x.as_flattened()).for_each(|(y, x)| *y = scale * *x + shift);
}

/// The gradient to the output becomes that to x; returns those to scale and shift.
fn affine_backward<F: Real>(x: &[Lane<F>], scale: F, d: &mut [Lane<F>]) -> (F, F) {
    let (mut by_scale, mut by_shift) = ([F::ZERO; LANES], [F::ZERO; LANES]);
    for (x, d) in x.iter().zip(d) {
        for l in 0..LANES {
            by_scale[l] += x[l] * d[l];
            by_shift[l] += d[l];
            d[l] *= scale;
        }
    }
    (total(by_scale), total(by_shift))
}

#[cfg(test)]
mod tests;
