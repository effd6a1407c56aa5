//! A diagonal complex state-space layer (S4D): sixteen sequences at a time, each with its own channels.
//!
//! h'(τ) = Λh + Bu, y = Re(Ch) + Du with Λ = −exp(a) + iω, held constant over a tick (zero-order hold): hₙ = Āhₙ₋₁ +
//! B̄uₙ, z = ΔΛ·gap, Ā = e^z, B̄ = Δ·gap·φ(z)·B, φ(z) = (e^z − 1)/z. Real parts of Λ are negative by construction,
//! hence |Ā| < 1. The backward is the reverse scan λₙ = conj(C)gₙ + conj(Āₙ₊₁)λₙ₊₁; states are not kept but made again,
//! [`CHUNK`] ticks at a time, from marks that the forward scan leaves.
//!
//! Source: Gu et al. 2022 (S4D). Gradients of complex numbers are ∂L/∂Re + i·∂L/∂Im throughout.

use crate::math::{Real, Rng};
use crate::scene::BLOCK;
use crate::simd::{Kernel, Simd, dispatch, total};

/// Sequences that are scanned together.
pub(crate) const LANES: usize = BLOCK;
/// Ticks between two marks, from which the backward makes states again.
pub(crate) const CHUNK: usize = 16;
/// Below this |z| the quotients φ and φ' are taken from their series (the terms left out are below 1e-15).
const SERIES: f64 = 1e-2;
/// Ā falls to e^-40 at most in a tick: faster decay makes no difference, and 0/0 is avoided.
const STRONGEST_DECAY: f64 = 40.0;
/// Steps are at most e³ ticks, whatever a file states.
const LONGEST_LOG_STEP: f64 = 3.0;
/// Decay that all modes start with: Re Λ = −½ (S4D-Lin).
const FIRST_DECAY: f64 = 0.5;

/// One number of sixteen sequences.
pub(crate) type Lane<F> = [F; LANES];
/// A complex number.
pub(crate) type Complex<F> = [F; 2];
/// A complex number of sixteen sequences.
pub(crate) type Pair<F> = [Lane<F>; 2];

/// Sizes of a layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Shape {
    /// Channels H, each with its own Λ, Δ, B, C, D.
    pub channels: usize,
    /// Complex states N of a channel.
    pub states: usize,
    /// Rows of numbers that share a channel: 1, or 3 where a channel is a vector.
    pub copies: usize,
}

/// Names of a layer's learnable arrays, in the order in which they are in its slice of weights, and numbers of each: a
/// \[H,N\], ω \[H,N\], B and C \[H,N\] (re, im), D \[H\], log Δ \[H\] (ticks of the grid over the clip: see [`init`]).
pub(crate) fn arrays(shape: Shape) -> [(&'static str, usize); 6] {
    let (h, n) = (shape.channels, shape.channels * shape.states);
    [("log_decay", n), ("frequency", n), ("input", 2 * n), ("output", 2 * n), ("skip", h), ("log_step", h)]
}

/// Numbers of a layer's weights.
pub(crate) fn weights(shape: Shape) -> usize {
    arrays(shape).iter().map(|a| a.1).sum()
}

/// S4D-Lin: a = log ½, ω = πn, B = 1, C normal with variance 1/N, D = 1, log Δ uniform in [log 1/`ticks`, log 1/N]: the
/// slowest channel remembers the whole grid, the fastest has ωΔ < π.
pub(crate) fn init<F: Real>(shape: Shape, ticks: usize, rng: Rng, w: &mut [F]) {
    let (h, n) = (shape.channels, shape.states);
    let s = Slices::of(shape, w);
    for i in 0..h * n {
        s.log_decay[i] = F::of(FIRST_DECAY.ln());
        s.frequency[i] = F::of(std::f64::consts::PI * (i % n) as f64);
        s.input[2 * i] = F::ONE;
        s.input[2 * i + 1] = F::ZERO;
        for part in 0..2 {
            let normal = rng.fork(part).normal(i as u64);
            s.output[2 * i + part as usize] = F::of(normal * (0.5 / n as f64).sqrt());
        }
    }
    let (slow, fast) = (-(ticks.max(2) as f64).ln(), -(n.max(2) as f64).ln());
    for (i, step) in s.log_step.iter_mut().enumerate() {
        *step = F::of(slow + (fast - slow) * rng.fork(2).uniform(i as u64));
    }
    s.skip.fill(F::ONE);
}

/// A layer's slice of weights, by array.
struct Slices<'a, F> {
    log_decay: &'a mut [F],
    frequency: &'a mut [F],
    input: &'a mut [F],
    output: &'a mut [F],
    skip: &'a mut [F],
    log_step: &'a mut [F],
}

impl<'a, F> Slices<'a, F> {
    fn of(shape: Shape, w: &'a mut [F]) -> Self {
        assert_eq!(w.len(), weights(shape), "a layer's weights have its shape");
        let mut rest = w;
        let [log_decay, frequency, input, output, skip, log_step] = arrays(shape).map(|(_, n)| {
            let (head, tail) = std::mem::take(&mut rest).split_at_mut(n);
            rest = tail;
            head
        });
        Self { log_decay, frequency, input, output, skip, log_step }
    }
}

/// Direction of a scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Direction {
    /// From the first tick to the last: uses the past.
    Forward,
    /// From the last tick to the first: uses the future.
    Backward,
}

/// Discretised parameters of a layer, for all ticks: Ā and B̄ \[gaps,H,N\], C \[H,N\], D \[H\]; also the gradient to
/// it.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Discrete<F> {
    shape: Shape,
    /// 1 where ticks are evenly spaced, else one per tick.
    gaps: usize,
    decay: Vec<Complex<F>>,
    drive: Vec<Complex<F>>,
    output: Vec<Complex<F>>,
    skip: Vec<F>,
}

/// Zero-order hold of one state over one gap, in f64.
struct Hold {
    step: f64,
    z: Complex<f64>,
    /// Whether z still feels a and ω (they were not clamped), and step its logarithm.
    free: [bool; 3],
}

impl Hold {
    fn new(log_decay: f64, frequency: f64, log_step: f64, gap: f64) -> Self {
        let step = log_step.min(LONGEST_LOG_STEP).exp();
        // ωΔ above π aliases: such a mode gets the fastest frequency that ticks can show.
        let turn = (frequency * step).clamp(-std::f64::consts::PI, std::f64::consts::PI);
        let decay = (log_decay.exp() * step).min(STRONGEST_DECAY / gap.max(1.0));
        Self {
            step: step * gap,
            z: [-decay * gap, turn * gap],
            free: [decay == log_decay.exp() * step, turn == frequency * step, log_step <= LONGEST_LOG_STEP],
        }
    }

    /// e^z, φ(z), φ'(z)
    fn quotients(&self) -> [Complex<f64>; 3] {
        let z = self.z;
        let e = z[0].exp();
        let power = [e * z[1].cos(), e * z[1].sin()];
        if z[0].hypot(z[1]) < SERIES {
            // φ = Σ z^k/(k+1)!, φ' = Σ k z^(k−1)/(k+1)!, by Horner.
            let (mut phi, mut slope) = ([0.0; 2], [0.0; 2]);
            for k in (0..=7u32).rev() {
                let factorial = |n: u32| (1..=n).map(f64::from).product::<f64>();
                phi = times(phi, z);
                phi[0] += 1.0 / factorial(k + 1);
                if k > 0 {
                    slope = times(slope, z);
                    slope[0] += f64::from(k) / factorial(k + 1);
                }
            }
            return [power, phi, slope];
        }
        let phi = over([power[0] - 1.0, power[1]], z);
        [power, phi, over([power[0] - phi[0], power[1] - phi[1]], z)]
    }
}

fn times(a: Complex<f64>, b: Complex<f64>) -> Complex<f64> {
    [a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]]
}

fn over(a: Complex<f64>, b: Complex<f64>) -> Complex<f64> {
    let square = b[0] * b[0] + b[1] * b[1];
    let [re, im] = times(a, [b[0], -b[1]]);
    [re / square, im / square]
}

/// conj(a)·b
fn against(a: Complex<f64>, b: Complex<f64>) -> Complex<f64> {
    times([a[0], -a[1]], b)
}

impl<F: Real> Discrete<F> {
    /// Of a layer's weights. `gaps`: time since the tick before, in ticks: one number for evenly spaced ones, else one
    /// a tick (the first as the others; a scan backwards takes the gap to the tick after).
    pub(crate) fn new(shape: Shape, w: &[F], gaps: &[f64]) -> Self {
        let mut out = Self::zeros(shape, gaps.len());
        let mut w = w.to_vec();
        let s = Slices::of(shape, &mut w);
        let n = shape.states;
        for (g, &gap) in gaps.iter().enumerate() {
            for i in 0..shape.channels * n {
                let hold = Hold::new(s.log_decay[i].f64(), s.frequency[i].f64(), s.log_step[i / n].f64(), gap);
                let [power, phi, _] = hold.quotients();
                let drive = times(phi, [s.input[2 * i].f64(), s.input[2 * i + 1].f64()]);
                let at = g * shape.channels * n + i;
                out.decay[at] = power.map(F::of);
                out.drive[at] = drive.map(|x| F::of(x * hold.step));
            }
        }
        for i in 0..shape.channels * n {
            out.output[i] = [s.output[2 * i], s.output[2 * i + 1]];
        }
        out.skip.copy_from_slice(s.skip);
        out
    }

    /// A gradient that nothing was added to.
    pub(crate) fn zeros(shape: Shape, gaps: usize) -> Self {
        let n = shape.channels * shape.states;
        let complex = |n| vec![[F::ZERO; 2]; n];
        Self {
            shape,
            gaps,
            decay: complex(gaps * n),
            drive: complex(gaps * n),
            output: complex(n),
            skip: vec![F::ZERO; shape.channels],
        }
    }

    /// A gradient to this layer that nothing was added to.
    pub(crate) fn none(&self) -> Self {
        Self::zeros(self.shape, self.gaps)
    }

    /// Adds another gradient.
    pub(crate) fn add(&mut self, other: &Self) {
        let pairs =
            [(&mut self.decay, &other.decay), (&mut self.drive, &other.drive), (&mut self.output, &other.output)];
        for (to, from) in pairs {
            to.iter_mut().zip(from).for_each(|(a, b)| (0..2).for_each(|k| a[k] += b[k]));
        }
        self.skip.iter_mut().zip(&other.skip).for_each(|(a, b)| *a += *b);
    }

    /// The VJP of [`new`](Self::new): adds to the gradient of the weights. `d` is the gradient to what `new` gave.
    pub(crate) fn backward(w: &[F], gaps: &[f64], d: &Self, d_w: &mut [F]) {
        let (shape, n) = (d.shape, d.shape.states);
        let mut w = w.to_vec();
        let s = Slices::of(shape, &mut w);
        let to = Slices::of(shape, d_w);
        for (g, &gap) in gaps.iter().enumerate() {
            for i in 0..shape.channels * n {
                let hold = Hold::new(s.log_decay[i].f64(), s.frequency[i].f64(), s.log_step[i / n].f64(), gap);
                let [power, phi, slope] = hold.quotients();
                let b = [s.input[2 * i].f64(), s.input[2 * i + 1].f64()];
                let at = g * shape.channels * n + i;
                let (d_power, d_drive) = (d.decay[at].map(F::f64), d.drive[at].map(F::f64));
                let by_b = against(phi, d_drive);
                to.input[2 * i] += F::of(by_b[0] * hold.step);
                to.input[2 * i + 1] += F::of(by_b[1] * hold.step);
                let (decay, drive) = (against(power, d_power), against(times(slope, b), d_drive));
                let mut d_z = [decay[0] + hold.step * drive[0], decay[1] + hold.step * drive[1]];
                (0..2).filter(|&k| !hold.free[k]).for_each(|k| d_z[k] = 0.0);
                let d_step = against(times(phi, b), d_drive)[0] * hold.step + hold.z[0] * d_z[0] + hold.z[1] * d_z[1];
                to.log_decay[i] += F::of(hold.z[0] * d_z[0]);
                to.frequency[i] += F::of(hold.step * d_z[1]);
                to.log_step[i / n] += F::of(if hold.free[2] { d_step } else { 0.0 });
            }
        }
        for i in 0..shape.channels * n {
            to.output[2 * i] += d.output[i][0];
            to.output[2 * i + 1] += d.output[i][1];
        }
        to.skip.iter_mut().zip(&d.skip).for_each(|(a, b)| *a += *b);
    }

    /// Rows of numbers: channels times copies.
    pub(crate) fn rows(&self) -> usize {
        self.shape.channels * self.shape.copies
    }

    /// States of all rows before the first tick, all zero: \[rows,N\].
    pub(crate) fn rest(&self) -> Vec<Pair<F>> {
        vec![[[F::ZERO; LANES]; 2]; self.rows() * self.shape.states]
    }

    /// The impulse response K_m = Re(C Ā^m B̄) (+ D at m = 0) of a channel, m < `ticks`; for evenly spaced ticks.
    #[cfg(test)]
    pub(crate) fn response(&self, channel: usize, ticks: usize) -> Vec<f64> {
        let own = channel * self.shape.states..(channel + 1) * self.shape.states;
        let mut out = vec![0.0; ticks];
        for i in own {
            let mut h = self.drive[i].map(F::f64);
            for y in &mut out {
                *y += times(self.output[i].map(F::f64), h)[0];
                h = times(self.decay[i].map(F::f64), h);
            }
        }
        if let Some(first) = out.first_mut() {
            *first += self.skip[channel].f64();
        }
        out
    }

    /// The scan. Shapes: u, y \[rows, ticks\]; `state` \[rows,N\] is the state before the first tick and becomes that
    /// after the last; `marks` gets the states at the start of every chunk, \[rows, chunks, N\].
    pub(crate) fn scan(
        &self,
        way: Direction,
        u: &[Lane<F>],
        y: &mut [Lane<F>],
        state: &mut [Pair<F>],
        marks: &mut Vec<Pair<F>>,
    ) {
        let ticks = u.len() / self.rows();
        let n = self.shape.states;
        marks.clear();
        marks.reserve(self.rows() * ticks.div_ceil(CHUNK) * n);
        for row in 0..self.rows() {
            let own = row * ticks..(row + 1) * ticks;
            let state = &mut state[row * n..(row + 1) * n];
            let of = self.channel(row, way);
            dispatch(Simd::detect(), Scan { of, u: &u[own.clone()], y: &mut y[own], state, marks });
        }
    }

    /// The VJP of [`scan`](Self::scan): adds to `d_u` and to the gradient `d`; `d_state` \[rows,N\] is the gradient to
    /// the state after the last tick and becomes that to the state before the first.
    #[expect(
        clippy::too_many_arguments,
        reason = "a scan's backward has all that its forward has, and their gradients"
    )]
    pub(crate) fn scan_backward(
        &self,
        way: Direction,
        u: &[Lane<F>],
        marks: &[Pair<F>],
        d_y: &[Lane<F>],
        d_u: &mut [Lane<F>],
        d_state: &mut [Pair<F>],
        d: &mut Self,
    ) {
        let ticks = u.len() / self.rows();
        let (n, chunks) = (self.shape.states, ticks.div_ceil(CHUNK));
        let zero = [[F::ZERO; LANES]; 2];
        let (mut states, mut sums) = (vec![zero; (CHUNK + 1) * n], vec![[zero; 3]; n]);
        for row in 0..self.rows() {
            let own = row * ticks..(row + 1) * ticks;
            let of = self.channel(row, way);
            sums.fill([zero; 3]);
            let mut reverse = Reverse {
                of,
                u: &u[own.clone()],
                d_y: &d_y[own.clone()],
                d_u: &mut d_u[own],
                adjoint: &mut d_state[row * n..(row + 1) * n],
                marks: &marks[row * chunks * n..(row + 1) * chunks * n],
                states: &mut states,
                sums: &mut sums,
                row,
                d,
            };
            dispatch(Simd::detect(), &mut reverse);
        }
    }

    fn channel(&self, row: usize, way: Direction) -> Channel<'_, F> {
        let (h, n) = (row / self.shape.copies, self.shape.states);
        Channel { of: self, first: h * n, n, skip: self.skip[h], way }
    }
}

/// One row's numbers.
#[derive(Clone, Copy)]
struct Channel<'a, F> {
    of: &'a Discrete<F>,
    first: usize,
    n: usize,
    skip: F,
    way: Direction,
}

impl<'a, F: Real> Channel<'a, F> {
    /// The tick that the scan meets as its i-th.
    #[inline(always)]
    fn tick(&self, i: usize, ticks: usize) -> usize {
        if self.way == Direction::Forward { i } else { ticks - 1 - i }
    }

    /// The gap over which the scan reaches its i-th tick.
    #[inline(always)]
    fn gap(&self, i: usize, ticks: usize) -> usize {
        match (self.of.gaps, self.way) {
            (1, _) => 0,
            (_, Direction::Forward) => i,
            (_, Direction::Backward) => (ticks - i) % ticks,
        }
    }

    /// Place of Ā and B̄ of the first state for the i-th tick.
    #[inline(always)]
    fn place(&self, i: usize, ticks: usize) -> usize {
        self.gap(i, ticks) * self.of.shape.channels * self.of.shape.states + self.first
    }

    #[inline(always)]
    fn held(&self, i: usize, ticks: usize) -> [&'a [Complex<F>]; 3] {
        let at = self.place(i, ticks);
        let own = at..at + self.n;
        [&self.of.decay[own.clone()], &self.of.drive[own], &self.of.output[self.first..self.first + self.n]]
    }
}

/// h ← Āh + B̄u
#[inline(always)]
fn advance<F: Real, const FMA: bool>(h: &Pair<F>, a: Complex<F>, b: Complex<F>, u: &Lane<F>) -> Pair<F> {
    let mut next = [[F::ZERO; LANES]; 2];
    for l in 0..LANES {
        next[0][l] = a[0].fma::<FMA>(h[0][l], (-a[1]).fma::<FMA>(h[1][l], b[0] * u[l]));
        next[1][l] = a[0].fma::<FMA>(h[1][l], a[1].fma::<FMA>(h[0][l], b[1] * u[l]));
    }
    next
}

struct Scan<'a, F> {
    of: Channel<'a, F>,
    u: &'a [Lane<F>],
    y: &'a mut [Lane<F>],
    state: &'a mut [Pair<F>],
    marks: &'a mut Vec<Pair<F>>,
}

impl<F: Real> Kernel for Scan<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let ticks = self.u.len();
        for i in 0..ticks {
            if i % CHUNK == 0 {
                self.marks.extend_from_slice(self.state);
            }
            let t = self.of.tick(i, ticks);
            let u = self.u[t];
            let mut y = [F::ZERO; LANES];
            for l in 0..LANES {
                y[l] = self.of.skip * u[l];
            }
            let [decay, drive, output] = self.of.held(i, ticks);
            for (((h, &a), &b), &c) in self.state.iter_mut().zip(decay).zip(drive).zip(output) {
                let next = advance::<F, FMA>(h, a, b, &u);
                for l in 0..LANES {
                    y[l] = c[0].fma::<FMA>(next[0][l], (-c[1]).fma::<FMA>(next[1][l], y[l]));
                }
                *h = next;
            }
            self.y[t] = y;
        }
    }
}

struct Reverse<'a, 'b, F> {
    of: Channel<'a, F>,
    u: &'b [Lane<F>],
    d_y: &'b [Lane<F>],
    d_u: &'b mut [Lane<F>],
    /// conj(Ā)λ of the tick after.
    adjoint: &'b mut [Pair<F>],
    marks: &'b [Pair<F>],
    /// \[CHUNK + 1, N\]: before the chunk's first tick, and after each.
    states: &'b mut [Pair<F>],
    /// By state: gradients to Ā, B̄, C.
    sums: &'b mut [[Pair<F>; 3]],
    row: usize,
    d: &'b mut Discrete<F>,
}

impl<F: Real> Kernel for &mut Reverse<'_, '_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let (ticks, n) = (self.u.len(), self.of.n);
        let mut d_skip = [F::ZERO; LANES];
        for chunk in (0..ticks.div_ceil(CHUNK)).rev() {
            let (first, end) = (chunk * CHUNK, ((chunk + 1) * CHUNK).min(ticks));
            self.states[..n].copy_from_slice(&self.marks[chunk * n..(chunk + 1) * n]);
            for i in first..end {
                let u = self.u[self.of.tick(i, ticks)];
                let [decay, drive, _] = self.of.held(i, ticks);
                let (old, new) = self.states[(i - first) * n..].split_at_mut(n);
                for (((h, next), &a), &b) in old.iter().zip(new.iter_mut()).zip(decay).zip(drive) {
                    *next = advance::<F, FMA>(h, a, b, &u);
                }
            }
            for i in (first..end).rev() {
                let t = self.of.tick(i, ticks);
                let (u, g) = (self.u[t], self.d_y[t]);
                let [decay, drive, output] = self.of.held(i, ticks);
                let (old, new) = self.states[(i - first) * n..(i - first + 2) * n].split_at(n);
                let mut d_u = self.d_u[t];
                for l in 0..LANES {
                    d_u[l] = self.of.skip.fma::<FMA>(g[l], d_u[l]);
                    d_skip[l] = g[l].fma::<FMA>(u[l], d_skip[l]);
                }
                let states = old.iter().zip(new).zip(self.adjoint.iter_mut()).zip(self.sums.iter_mut());
                for ((((old, new), adjoint), sums), ((&a, &b), &c)) in states.zip(decay.iter().zip(drive).zip(output)) {
                    let [d_a, d_b, d_c] = sums;
                    let (mut re, mut im) = ([F::ZERO; LANES], [F::ZERO; LANES]);
                    for l in 0..LANES {
                        re[l] = c[0].fma::<FMA>(g[l], adjoint[0][l]);
                        im[l] = (-c[1]).fma::<FMA>(g[l], adjoint[1][l]);
                    }
                    for l in 0..LANES {
                        d_a[0][l] += re[l].fma::<FMA>(old[0][l], im[l] * old[1][l]);
                        d_a[1][l] += im[l].fma::<FMA>(old[0][l], -(re[l] * old[1][l]));
                    }
                    for l in 0..LANES {
                        d_b[0][l] = re[l].fma::<FMA>(u[l], d_b[0][l]);
                        d_b[1][l] = im[l].fma::<FMA>(u[l], d_b[1][l]);
                        d_c[0][l] = g[l].fma::<FMA>(new[0][l], d_c[0][l]);
                        d_c[1][l] = (-g[l]).fma::<FMA>(new[1][l], d_c[1][l]);
                    }
                    for l in 0..LANES {
                        d_u[l] = b[0].fma::<FMA>(re[l], b[1].fma::<FMA>(im[l], d_u[l]));
                        adjoint[0][l] = a[0].fma::<FMA>(re[l], a[1] * im[l]);
                        adjoint[1][l] = a[0].fma::<FMA>(im[l], -(a[1] * re[l]));
                    }
                }
                self.d_u[t] = d_u;
                if self.d.gaps > 1 {
                    self.flush(self.of.place(i, ticks));
                }
            }
        }
        if self.d.gaps == 1 {
            self.flush(self.of.first);
        }
        self.d.skip[self.row / self.d.shape.copies] += total(d_skip);
    }
}

impl<F: Real> Reverse<'_, '_, F> {
    /// Adds the sums over lanes to the gradient, for the gap whose first state is at `place`.
    fn flush(&mut self, place: usize) {
        for (i, [d_a, d_b, d_c]) in self.sums.iter_mut().enumerate() {
            for k in 0..2 {
                self.d.decay[place + i][k] += total(d_a[k]);
                self.d.drive[place + i][k] += total(d_b[k]);
                self.d.output[self.of.first + i][k] += total(d_c[k]);
            }
            [*d_a, *d_b, *d_c] = [[[F::ZERO; LANES]; 2]; 3];
        }
    }
}

#[cfg(test)]
mod tests;
