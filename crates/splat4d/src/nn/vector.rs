//! Vector neurons: layers whose numbers are vectors of space, and which turn and mirror with them exactly.
//!
//! A vector channel is three rows, [channels, 3, ticks] of lanes. Linear maps mix channels and leave x, y, z alone,
//! hence commute with every orthogonal matrix; so does a linear recurrence in time whose numbers are shared by the
//! three (a state-space layer with three copies). Nonlinear are the VN-ReLU, q − ⟨q,k⟩k/‖k‖² where ⟨q,k⟩ < 0, and gates
//! by norms.
//!
//! Source: Deng et al. 2021 (vector neurons); the equivariant state space is our own.

use super::sequence::{Layout, Scans, add, clear, fast, linear, linear_backward, uniform};
use super::ssm::{self, Direction, Discrete, LANES, Lane, Pair};
use crate::math::{Real, Rng};
use crate::simd::total;
use std::ops::Range;

/// Keeps norms from zero, where they have no slope; squared units of normalised vectors.
const NORM_FLOOR: f64 = 1e-6;

/// A vector of sixteen sequences.
type Vector<F> = [Lane<F>; 3];

#[inline(always)]
fn read<F: Real>(x: &[Lane<F>], channel: usize, ticks: usize, t: usize) -> Vector<F> {
    [0, 1, 2].map(|k| x[(3 * channel + k) * ticks + t])
}

#[inline(always)]
fn write<F: Real>(x: &mut [Lane<F>], channel: usize, ticks: usize, t: usize, v: &Vector<F>) {
    for k in 0..3 {
        x[(3 * channel + k) * ticks + t] = v[k];
    }
}

#[inline(always)]
fn dot<F: Real>(a: &Vector<F>, b: &Vector<F>) -> Lane<F> {
    let mut out = [F::ZERO; LANES];
    for l in 0..LANES {
        out[l] = a[0][l] * b[0][l] + a[1][l] * b[1][l] + a[2][l] * b[2][l];
    }
    out
}

/// VN-ReLU of q with directions k, all \[channels, 3, ticks\]: where ⟨q,k⟩ < 0, q loses what points along k.
pub(crate) fn relu<F: Real>(ticks: usize, q: &[Lane<F>], k: &[Lane<F>], out: &mut [Lane<F>]) {
    fast(|| {
        for c in 0..q.len() / (3 * ticks) {
            for t in 0..ticks {
                let (q, k) = (read(q, c, ticks, t), read(k, c, ticks, t));
                let (along, square) = (dot(&q, &k), dot(&k, &k));
                let mut v = q;
                for l in 0..LANES {
                    let share = along[l].min(F::ZERO) / (square[l] + F::of(NORM_FLOOR));
                    for x in 0..3 {
                        v[x][l] = q[x][l] - share * k[x][l];
                    }
                }
                write(out, c, ticks, t, &v);
            }
        }
    });
}

/// VJP of [`relu`]: writes d_q and d_k.
pub(crate) fn relu_backward<F: Real>(
    ticks: usize,
    (q, k): (&[Lane<F>], &[Lane<F>]),
    d_out: &[Lane<F>],
    d_q: &mut [Lane<F>],
    d_k: &mut [Lane<F>],
) {
    fast(|| {
        for c in 0..q.len() / (3 * ticks) {
            for t in 0..ticks {
                let [q, k, g] = [q, k, d_out].map(|x| read(x, c, ticks, t));
                let (along, square, by_k) = (dot(&q, &k), dot(&k, &k), dot(&g, &k));
                let (mut to_q, mut to_k) = (g, [[F::ZERO; LANES]; 3]);
                for l in 0..LANES {
                    let inverse = F::ONE / (square[l] + F::of(NORM_FLOOR));
                    let on = if along[l] < F::ZERO { F::ONE } else { F::ZERO };
                    let (share, pull) = (on * along[l] * inverse, on * by_k[l] * inverse);
                    for x in 0..3 {
                        to_q[x][l] = g[x][l] - pull * k[x][l];
                        to_k[x][l] = F::TWO * share * pull * k[x][l] - share * g[x][l] - pull * q[x][l];
                    }
                }
                write(d_q, c, ticks, t, &to_q);
                write(d_k, c, ticks, t, &to_k);
            }
        }
    });
}

/// Gates by norms: v_c ← v_c·σ(α_c‖v_c‖ + β_c); v \[channels, 3, ticks\], α and β \[channels\].
pub(crate) fn gate<F: Real>(ticks: usize, alpha: &[F], beta: &[F], v: &mut [Lane<F>]) {
    for (c, (&alpha, &beta)) in alpha.iter().zip(beta).enumerate() {
        fast(|| {
            for t in 0..ticks {
                let mut x = read(v, c, ticks, t);
                let square = dot(&x, &x);
                for l in 0..LANES {
                    let open = (alpha * (square[l] + F::of(NORM_FLOOR)).sqrt() + beta).sigmoid();
                    (0..3).for_each(|k| x[k][l] *= open);
                }
                write(v, c, ticks, t, &x);
            }
        });
    }
}

/// VJP of [`gate`], v being what went in: d becomes the gradient to it; adds to those of α and β.
pub(crate) fn gate_backward<F: Real>(
    ticks: usize,
    (alpha, beta): (&[F], &[F]),
    v: &[Lane<F>],
    d: &mut [Lane<F>],
    (d_alpha, d_beta): (&mut [F], &mut [F]),
) {
    for (c, (&alpha, &beta)) in alpha.iter().zip(beta).enumerate() {
        let (mut by_alpha, mut by_beta) = ([F::ZERO; LANES], [F::ZERO; LANES]);
        for t in 0..ticks {
            let (x, mut g) = (read(v, c, ticks, t), read(d, c, ticks, t));
            let (square, along) = (dot(&x, &x), dot(&g, &x));
            for l in 0..LANES {
                let norm = (square[l] + F::of(NORM_FLOOR)).sqrt();
                let open = (alpha * norm + beta).sigmoid();
                let slope = along[l] * open * (F::ONE - open);
                by_alpha[l] += slope * norm;
                by_beta[l] += slope;
                (0..3).for_each(|k| g[k][l] = g[k][l] * open + slope * alpha / norm * x[k][l]);
            }
            write(d, c, ticks, t, &g);
        }
        d_alpha[c] += total(by_alpha);
        d_beta[c] += total(by_beta);
    }
}

/// Divides all vectors of a tick by the root of their mean square: `unit` \[channels, 3, ticks\], `inverse` \[ticks\].
pub(crate) fn norm<F: Real>(x: &[Lane<F>], unit: &mut [Lane<F>], inverse: &mut [Lane<F>]) {
    let ticks = inverse.len();
    let share = F::of(3.0 * ticks as f64 / x.len() as f64);
    fast(|| {
        inverse.fill([F::of(NORM_FLOOR); LANES]);
        for row in x.chunks_exact(ticks) {
            for (square, x) in inverse.iter_mut().zip(row) {
                (0..LANES).for_each(|l| square[l] += share * x[l] * x[l]);
            }
        }
        for square in inverse.iter_mut() {
            (0..LANES).for_each(|l| square[l] = F::ONE / square[l].sqrt());
        }
        for (unit, row) in unit.chunks_exact_mut(ticks).zip(x.chunks_exact(ticks)) {
            for ((unit, x), inverse) in unit.iter_mut().zip(row).zip(inverse.iter()) {
                (0..LANES).for_each(|l| unit[l] = x[l] * inverse[l]);
            }
        }
    });
}

/// VJP of [`norm`]: adds to d_x.
pub(crate) fn norm_backward<F: Real>(unit: &[Lane<F>], inverse: &[Lane<F>], d_unit: &[Lane<F>], d_x: &mut [Lane<F>]) {
    let ticks = inverse.len();
    let share = F::of(3.0 * ticks as f64 / unit.len() as f64);
    let mut means = vec![[F::ZERO; LANES]; ticks];
    for (unit, d) in unit.chunks_exact(ticks).zip(d_unit.chunks_exact(ticks)) {
        for ((mean, unit), d) in means.iter_mut().zip(unit).zip(d) {
            (0..LANES).for_each(|l| mean[l] += share * unit[l] * d[l]);
        }
    }
    let rows = unit.chunks_exact(ticks).zip(d_unit.chunks_exact(ticks)).zip(d_x.chunks_exact_mut(ticks));
    for ((unit, d), d_x) in rows {
        for ((((d_x, unit), d), mean), inverse) in d_x.iter_mut().zip(unit).zip(d).zip(&means).zip(inverse) {
            (0..LANES).for_each(|l| d_x[l] += inverse[l] * (d[l] - unit[l] * mean[l]));
        }
    }
}

/// A residual block of vectors: norm → state space → VN-ReLU with its two linear maps → gate → residual.
#[derive(Clone, Debug)]
pub(crate) struct VectorBlock {
    channels: usize,
    scans: Scans,
    maps: [Range<usize>; 2],
    gates: [Range<usize>; 2],
}

/// Record of a block's forward for its backward.
#[derive(Clone, Debug, Default)]
pub(crate) struct VectorTape<F> {
    unit: Vec<Lane<F>>,
    inverse: Vec<Lane<F>>,
    seen: Vec<Lane<F>>,
    marks: Vec<Vec<Pair<F>>>,
    q: Vec<Lane<F>>,
    k: Vec<Lane<F>>,
    bent: Vec<Lane<F>>,
}

impl VectorBlock {
    /// Appends a block's weights to the layout; its layers are the net's from number `first` on.
    pub(crate) fn new(
        name: &str,
        channels: usize,
        states: usize,
        ways: &[Direction],
        first: usize,
        layout: &mut Layout,
    ) -> Self {
        let scans = Scans::new(name, ssm::Shape { channels, states, copies: 3 }, ways, first, layout);
        let inputs = scans.count() * channels;
        let maps = ["map", "direction"].map(|part| layout.push(format!("{name}.{part}.weight"), inputs * channels));
        let gates = ["gate.scale", "gate.shift"].map(|part| layout.push(format!("{name}.{part}"), channels));
        Self { channels, scans, maps, gates }
    }

    /// The state-space layers.
    pub(crate) fn scans(&self) -> &Scans {
        &self.scans
    }

    /// First weights: S4D-Lin, uniform linear maps, gates half open.
    pub(crate) fn init<F: Real>(&self, ticks: usize, rng: Rng, w: &mut [F]) {
        self.scans.init(ticks, rng.fork(1), w);
        for (i, map) in self.maps.iter().enumerate() {
            uniform(&mut w[map.clone()], self.scans.count() * self.channels, rng.fork(2 + i as u64));
        }
        w[self.gates[0].clone()].fill(F::ONE);
    }

    /// x \[channels, 3, ticks\] ← x + gate(relu(W·y, U·y)), y = scans(norm(x))
    pub(crate) fn forward<F: Real>(
        &self,
        w: &[F],
        layers: &[Discrete<F>],
        x: &mut [Lane<F>],
        tape: &mut VectorTape<F>,
    ) {
        let ticks = x.len() / (3 * self.channels);
        clear(&mut tape.unit, x.len());
        clear(&mut tape.inverse, ticks);
        clear(&mut tape.seen, self.scans.count() * x.len());
        for buffer in [&mut tape.q, &mut tape.k, &mut tape.bent] {
            clear(buffer, x.len());
        }
        norm(x, &mut tape.unit, &mut tape.inverse);
        self.scans.forward(layers, &tape.unit, &mut tape.seen, &mut tape.marks);
        let inputs = self.scans.count() * self.channels;
        linear(&w[self.maps[0].clone()], &[], inputs, &tape.seen, &mut tape.q);
        linear(&w[self.maps[1].clone()], &[], inputs, &tape.seen, &mut tape.k);
        relu(ticks, &tape.q, &tape.k, &mut tape.bent);
        let mut step = tape.bent.clone();
        gate(ticks, &w[self.gates[0].clone()], &w[self.gates[1].clone()], &mut step);
        add(x, &step);
    }

    /// VJP of [`forward`](Self::forward): d_x, the gradient to the output, becomes that to the input.
    pub(crate) fn backward<F: Real>(
        &self,
        w: &[F],
        layers: &[Discrete<F>],
        tape: &VectorTape<F>,
        d_x: &mut [Lane<F>],
        (d_w, d_layers): (&mut [F], &mut [Discrete<F>]),
    ) {
        let zero = [F::ZERO; LANES];
        let (ticks, inputs) = (tape.inverse.len(), self.scans.count() * self.channels);
        let mut d_bent = d_x.to_vec();
        let [d_alpha, d_beta] = d_w.get_disjoint_mut(self.gates.clone()).expect("a layout's parts are apart");
        let gates = (&w[self.gates[0].clone()], &w[self.gates[1].clone()]);
        gate_backward(ticks, gates, &tape.bent, &mut d_bent, (d_alpha, d_beta));
        let (mut d_q, mut d_k) = (vec![zero; d_x.len()], vec![zero; d_x.len()]);
        relu_backward(ticks, (&tape.q, &tape.k), &d_bent, &mut d_q, &mut d_k);
        let mut d_seen = vec![zero; tape.seen.len()];
        for (map, d) in self.maps.iter().zip([&d_q, &d_k]) {
            linear_backward(&w[map.clone()], inputs, &tape.seen, d, (&mut d_w[map.clone()], &mut []), &mut d_seen);
        }
        let mut d_unit = vec![zero; d_x.len()];
        self.scans.backward(layers, (&tape.unit, &tape.marks), &d_seen, &mut d_unit, d_layers);
        norm_backward(&tape.unit, &tape.inverse, &d_unit, d_x);
    }
}

#[cfg(test)]
mod tests;
