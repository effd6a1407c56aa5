//! M2: a causal diagonal state space of every node on vector channels, which is exactly equivariant: linear recurrences
//! in time commute with rotations (after Gu et al. 2022, "S4D", and Deng et al. 2021, "Vector neurons").
//!
//! Inputs u of a node are vectors: its velocity, the mean velocity of its neighbours, their mean offset, gravity, and
//! those of actions. With complex channels and z = −exp(a) + iω, one tick is
//!
//! > h ← e^z h + B u, y = Re(W h) + D u, acceleration = A Σ_o φ_o(|y|², y·v, e, scalars) y_o.
//!
//! Re z < 0, so that |e^z| < 1: memory fades for any weights. It depends on the past alone.

use crate::learnt::{Action, InputGrads, Network, Scales, State, put, row};
use crate::optimise::no_gaussians;
use crate::paths::{Moment, nearest};
use splat4d::Result;
use splat4d::math::vec3::dot;
use splat4d::math::{Real, Rng};
use splat4d::nn::{InputGrad, LayerOutputs, Mlp, MlpShape, Passed};
use splat4d::scene::{Grads, Key, Params};

/// Neighbours of a node.
const NEIGHBOURS: usize = 8;
/// Input vectors of a node, without those of actions.
const INPUTS: usize = 4;
/// Learnt numbers of a node.
const EMBEDDING: usize = 8;
/// Decay that all modes start with, of a tick: memory of some ten ticks; frequencies start evenly up to [`FASTEST`].
const FIRST_DECAY: f64 = 0.1;
const FASTEST: f64 = 1.0;
/// Ticks of context.
const CONTEXT: usize = 10;
/// The last map starts at this share: nearly no force.
const FIRST: f64 = 0.1;

/// Shape and physics of the network.
#[derive(Clone, Debug, PartialEq)]
pub struct CausalSpec {
    /// Complex channels.
    pub channels: usize,
    /// Output vectors.
    pub outputs: usize,
    /// Hidden numbers of the gates.
    pub width: usize,
    /// Unit vector of gravity.
    pub gravity: Option<[f64; 3]>,
    /// Vectors and scalars of an action.
    pub actions: [usize; 2],
}

impl Default for CausalSpec {
    /// 16 channels, 8 vectors, 64 numbers.
    fn default() -> Self {
        Self { channels: 16, outputs: 8, width: 64, gravity: None, actions: [0, 0] }
    }
}

/// The network.
#[derive(Clone, Debug)]
pub struct CausalNet {
    spec: CausalSpec,
    scales: Scales,
    near: Vec<Vec<usize>>,
    /// a and ω \[channels]; B \[channels, inputs]; W \[outputs, channels] (re, im); D \[outputs, inputs].
    decay: Key,
    frequency: Key,
    drive: Key,
    read: Key,
    skip: Key,
    embedding: Key,
    gates: Mlp,
}

/// A forward tick, for its backward.
#[derive(Clone, Debug, Default)]
pub struct Tick<F> {
    state: State<F>,
    before: Vec<F>,
    after: Vec<F>,
    inputs: Vec<[F; 3]>,
    outputs: Vec<[F; 3]>,
    invariants: Vec<F>,
    kept: LayerOutputs<F>,
    gates: Vec<F>,
}

fn axpy<F: Real>(to: &mut [F; 3], s: F, a: [F; 3]) {
    (0..3).for_each(|c| to[c] += s * a[c]);
}

impl CausalNet {
    /// A network for nodes positioned like `rest`, and its weights. Errors: a width that no perceptron has.
    pub fn new<F: Real>(spec: CausalSpec, scales: Scales, rest: &Moment, seed: u64) -> Result<(Self, Params<F>)> {
        let mut p = no_gaussians();
        let rng = |part: u64| Rng::new(seed, "causal", part);
        let (c, o) = (spec.channels, spec.outputs);
        let inputs = INPUTS + spec.actions[0];
        let normal = |p: &mut Params<F>, name: &str, part: u64, numbers: usize, size: f64| {
            p.array(name, numbers, |x| {
                x.iter_mut().enumerate().for_each(|(i, x)| *x = F::of(size * rng(part).normal(i as u64)));
            })
        };
        let drive = normal(&mut p, "drive", 0, c * inputs, (1.0 / inputs as f64).sqrt())?;
        let read = normal(&mut p, "read", 1, 2 * o * c, FIRST_DECAY)?;
        let skip = normal(&mut p, "skip", 2, o * inputs, (1.0 / inputs as f64).sqrt())?;
        let embedding = normal(&mut p, "embedding", 3, EMBEDDING * rest.len(), 0.1)?;
        let decay = p.array("log_decay", c, |x| x.fill(F::of(FIRST_DECAY.ln())))?;
        let frequency = p.array("frequency", c, |x| {
            x.iter_mut().enumerate().for_each(|(i, x)| *x = F::of(FASTEST * i as f64 / c as f64));
        })?;
        let shape = MlpShape {
            inputs: 2 * o + EMBEDDING + spec.actions[1],
            width: spec.width,
            layers: 2,
            skip: None,
            outputs: o,
        };
        let gates = Mlp::new("gates", shape, FIRST, rng(4), &mut p)?;
        let near = nearest(rest, NEIGHBOURS);
        Ok((Self { spec, scales, near, decay, frequency, drive, read, skip, embedding, gates }, p))
    }

    fn inputs(&self) -> usize {
        INPUTS + self.spec.actions[0]
    }

    /// e^z of every channel (re, im).
    fn steps<F: Real>(&self, p: &Params<F>) -> Vec<[F; 2]> {
        let of = |i: usize| {
            let (size, w) = ((-p[self.decay].data()[i].exp()).exp(), p[self.frequency].data()[i]);
            [size * w.cos(), size * w.sin()]
        };
        (0..self.spec.channels).map(of).collect()
    }

    /// Input vectors of a row.
    fn vectors<F: Real>(&self, s: &State<F>, action: &[F], i: usize, out: &mut Vec<[F; 3]>) {
        let n = self.near.len();
        let (k, first) = (i % n, i - i % n);
        let [l, v1] = [self.scales.length, self.scales.velocity].map(|x| F::of(1.0 / x));
        let share = F::of(1.0 / self.near[k].len().max(1) as f64);
        let (x, v) = (row(&s.x, i), row(&s.v, i));
        let (mut around, mut offset) = ([F::ZERO; 3], [F::ZERO; 3]);
        for &j in &self.near[k] {
            axpy(&mut around, share * v1, row(&s.v, first + j));
            axpy(&mut offset, share * l, row(&s.x, first + j));
            axpy(&mut offset, -share * l, x);
        }
        out.extend([v.map(|v| v * v1), around, offset, self.spec.gravity.unwrap_or([0.0; 3]).map(F::of)]);
        out.extend((0..self.spec.actions[0]).map(|u| row(action, u)));
    }
}

impl Network for CausalNet {
    type Tape<F: Real> = Tick<F>;

    fn nodes(&self) -> usize {
        self.near.len()
    }

    fn scales(&self) -> Scales {
        self.scales
    }

    fn warm_up(&self) -> usize {
        CONTEXT
    }

    fn memory(&self) -> usize {
        6 * self.spec.channels
    }

    fn accelerations<F: Real>(
        &self,
        p: &Params<F>,
        s: &State<F>,
        actions: &[Action<F>],
        hidden: &mut Vec<F>,
        tick: &mut Tick<F>,
    ) -> Vec<F> {
        let (rows, c, o, inputs) = (s.x.len() / 3, self.spec.channels, self.spec.outputs, self.inputs());
        let (steps, big) = (self.steps(p), F::of(self.scales.acceleration));
        let [drive, read, skip] = [self.drive, self.read, self.skip].map(|k| p[k].data());
        tick.state = s.clone();
        tick.before.clone_from(hidden);
        (tick.inputs, tick.outputs, tick.invariants) = (Vec::new(), Vec::new(), Vec::new());
        for i in 0..rows {
            let action = &actions[i / self.near.len()];
            self.vectors(s, action, i, &mut tick.inputs);
            let u = &tick.inputs[i * inputs..];
            let h = &mut hidden[6 * c * i..][..6 * c];
            for (j, [re, im]) in steps.iter().enumerate() {
                let (a, b) = (row(h, 2 * j), row(h, 2 * j + 1));
                let mut real: [F; 3] = std::array::from_fn(|x| *re * a[x] - *im * b[x]);
                let turned: [F; 3] = std::array::from_fn(|x| *re * b[x] + *im * a[x]);
                (0..inputs).for_each(|q| axpy(&mut real, drive[j * inputs + q], u[q]));
                h[6 * j..][..3].copy_from_slice(&real);
                h[6 * j + 3..][..3].copy_from_slice(&turned);
            }
            let first = tick.outputs.len();
            for q in 0..o {
                let mut y = [F::ZERO; 3];
                for j in 0..c {
                    axpy(&mut y, read[2 * (q * c + j)], row(h, 2 * j));
                    axpy(&mut y, -read[2 * (q * c + j) + 1], row(h, 2 * j + 1));
                }
                (0..inputs).for_each(|x| axpy(&mut y, skip[q * inputs + x], u[x]));
                tick.outputs.push(y);
            }
            for y in &tick.outputs[first..] {
                tick.invariants.extend([dot(*y, *y), dot(*y, u[0])]);
            }
            let e = EMBEDDING * (i % self.near.len());
            tick.invariants.extend_from_slice(&p[self.embedding].data()[e..e + EMBEDDING]);
            tick.invariants.extend_from_slice(&action[3 * self.spec.actions[0]..]);
        }
        tick.after.clone_from(hidden);
        tick.gates = vec![F::ZERO; rows * o];
        self.gates.forward_keeping(p, &tick.invariants, &mut tick.gates, &mut tick.kept);
        let mut a = vec![F::ZERO; 3 * rows];
        for (q, (y, gate)) in tick.outputs.iter().zip(&tick.gates).enumerate() {
            put(&mut a, q / o, big * *gate, *y);
        }
        a
    }

    fn backward<F: Real>(
        &self,
        p: &Params<F>,
        tick: &Tick<F>,
        d_a: &[F],
        d_inputs: InputGrads<'_, F>,
        d_hidden: &mut Vec<F>,
        d: &mut Grads<F>,
    ) {
        let InputGrads { state: d_state, actions: d_actions } = d_inputs;
        let (rows, c, o, inputs) = (tick.state.x.len() / 3, self.spec.channels, self.spec.outputs, self.inputs());
        let (steps, big, n) = (self.steps(p), F::of(self.scales.acceleration), self.near.len());
        let [drive, read, skip] = [self.drive, self.read, self.skip].map(|k| p[k].data());
        let d_gates: Vec<F> = tick.outputs.iter().enumerate().map(|(q, y)| big * dot(row(d_a, q / o), *y)).collect();
        let mut d_invariants = vec![F::ZERO; tick.invariants.len()];
        let passed = Passed::kept(&tick.invariants, &tick.kept);
        self.gates.backward(p, passed, &d_gates, InputGrad::Overwrite(&mut d_invariants), d);
        let width = d_invariants.len() / rows.max(1);
        let mut d_steps = vec![[F::ZERO; 2]; c];
        let [d_drive, d_read, d_skip, d_embedding] = d.of([self.drive, self.read, self.skip, self.embedding]);
        let [d_drive, d_read, d_skip, d_embedding] =
            [d_drive.data_mut(), d_read.data_mut(), d_skip.data_mut(), d_embedding.data_mut()];
        for i in 0..rows {
            let (u, h) = (&tick.inputs[i * inputs..][..inputs], &tick.after[6 * c * i..][..6 * c]);
            let d_h = &mut d_hidden[6 * c * i..][..6 * c];
            let d_inv = &d_invariants[i * width..][..width];
            let mut d_u = vec![[F::ZERO; 3]; inputs];
            for q in 0..o {
                let (y, gate) = (tick.outputs[i * o + q], tick.gates[i * o + q]);
                let mut d_y = row(d_a, i).map(|x| x * big * gate);
                axpy(&mut d_y, F::TWO * d_inv[2 * q], y);
                axpy(&mut d_y, d_inv[2 * q + 1], u[0]);
                axpy(&mut d_u[0], d_inv[2 * q + 1], y);
                for j in 0..c {
                    let at = 2 * (q * c + j);
                    d_read[at] += dot(d_y, row(h, 2 * j));
                    d_read[at + 1] -= dot(d_y, row(h, 2 * j + 1));
                    put(d_h, 2 * j, read[at], d_y);
                    put(d_h, 2 * j + 1, -read[at + 1], d_y);
                }
                for x in 0..inputs {
                    d_skip[q * inputs + x] += dot(d_y, u[x]);
                    axpy(&mut d_u[x], skip[q * inputs + x], d_y);
                }
            }
            let e = EMBEDDING * (i % n);
            (0..EMBEDDING).for_each(|x| d_embedding[e + x] += d_inv[2 * o + x]);
            let before = &tick.before[6 * c * i..][..6 * c];
            for (j, [re, im]) in steps.iter().enumerate() {
                let (real, turned) = (row(d_h, 2 * j), row(d_h, 2 * j + 1));
                let (a, b) = (row(before, 2 * j), row(before, 2 * j + 1));
                d_steps[j][0] += dot(a, real) + dot(b, turned);
                d_steps[j][1] += dot(a, turned) - dot(b, real);
                for x in 0..inputs {
                    d_drive[j * inputs + x] += dot(real, u[x]);
                    axpy(&mut d_u[x], drive[j * inputs + x], real);
                }
                for x in 0..3 {
                    d_h[6 * j + x] = *re * real[x] + *im * turned[x];
                    d_h[6 * j + 3 + x] = *re * turned[x] - *im * real[x];
                }
            }
            let [l, v1] = [self.scales.length, self.scales.velocity].map(|x| F::of(1.0 / x));
            let share = F::of(1.0 / self.near[i % n].len().max(1) as f64);
            let d_action = &mut d_actions[i / n];
            d_u[INPUTS..].iter().enumerate().for_each(|(u, d_u)| put(d_action, u, F::ONE, *d_u));
            let scalars = &d_inv[2 * o + EMBEDDING..];
            d_action[3 * self.spec.actions[0]..].iter_mut().zip(scalars).for_each(|(d, g)| *d += *g);
            put(&mut d_state.v, i, v1, d_u[0]);
            for &j in &self.near[i % n] {
                let j = i - i % n + j;
                put(&mut d_state.v, j, share * v1, d_u[1]);
                put(&mut d_state.x, j, share * l, d_u[2]);
                put(&mut d_state.x, i, -share * l, d_u[2]);
            }
        }
        // d e^z: z = −e^a + iω.
        let [d_decay, d_frequency] = d.of([self.decay, self.frequency]);
        for (j, ([re, im], [d_re, d_im])) in steps.iter().zip(d_steps).enumerate() {
            let rate = p[self.decay].data()[j].exp();
            d_decay.data_mut()[j] -= rate * (*re * d_re + *im * d_im);
            d_frequency.data_mut()[j] += *re * d_im - *im * d_re;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learnt::{Window, rollout_loss};
    use crate::paths::{Pose, exp};
    use splat4d::math::quat;
    use splat4d::math::se3::mat_vec;

    const H: f64 = 1e-6;

    fn made(n: usize) -> (CausalNet, Params<f64>, impl Fn(u64) -> State<f64>) {
        let numbers = move |seed: u64, part: u64| -> Vec<f64> {
            let rng = Rng::new(seed, "numbers", part);
            (0..3 * n as u64).map(|i| rng.normal(i)).collect()
        };
        let rest: Moment = numbers(1, 0).chunks_exact(3).map(|x| Pose::at([x[0], x[1], x[2]])).collect();
        let gravity = Some([0.0, -1.0, 0.0]);
        let spec = CausalSpec { channels: 3, outputs: 2, width: 5, gravity, actions: [1, 1] };
        let scales = Scales { length: 1.5, velocity: 0.3, acceleration: 0.05 };
        let (net, mut p) = CausalNet::new(spec, scales, &rest, 2).unwrap();
        for key in p.keys().collect::<Vec<_>>() {
            let (rng, rows) = (Rng::new(8, "weights", u64::from(key.0)), p[key].rows());
            p[key].data_mut()[..rows].iter_mut().enumerate().for_each(|(i, x)| *x += 0.3 * rng.normal(i as u64));
        }
        (net, p, move |seed| State { x: numbers(seed, 0), v: numbers(seed, 1).iter().map(|x| 0.3 * x).collect() })
    }

    const ACTION: [f64; 4] = [0.3, -0.2, 0.9, 0.5];

    #[test]
    fn forecasts_are_equivariant_to_rigid_motion_of_the_past() {
        let (mut net, p, state) = made(5);
        let run = |net: &CausalNet, r: &[[f64; 3]; 3], shift: [f64; 3]| {
            let mut hidden = vec![0.0; net.memory() * 5];
            let turned = |x: Vec<f64>, shift: [f64; 3]| -> Vec<f64> {
                let turn = |x: &[f64]| mat_vec(r, [x[0], x[1], x[2]]);
                x.chunks_exact(3).flat_map(|x| std::array::from_fn::<f64, 3, _>(|c| turn(x)[c] + shift[c])).collect()
            };
            let u = mat_vec(r, [ACTION[0], ACTION[1], ACTION[2]]);
            let mut a = Vec::new();
            for t in 0..6 {
                let State { x, v } = state(t);
                let s = State { x: turned(x, shift), v: turned(v, [0.0; 3]) };
                let action = vec![u[0], u[1], u[2], ACTION[3]];
                a = net.accelerations(&p, &s, &[action], &mut hidden, &mut Tick::default());
            }
            a
        };
        let id = quat::to_rotation([1.0, 0.0, 0.0, 0.0]);
        let a = run(&net, &id, [0.0; 3]);
        let size = a.iter().map(|x| x.abs()).fold(0.0, f64::max);
        for seed in 0..50 {
            let rng = Rng::new(seed, "turn", 0);
            let r = quat::to_rotation(exp([0, 1, 2].map(|c| 2.0 * rng.normal(c))));
            net.spec.gravity = Some(mat_vec(&r, [0.0, -1.0, 0.0]));
            let found = run(&net, &r, [3, 4, 5].map(|c| rng.normal(c)));
            for (f, a) in found.chunks_exact(3).zip(a.chunks_exact(3)) {
                let want = mat_vec(&r, [a[0], a[1], a[2]]);
                assert!((0..3).all(|c| (f[c] - want[c]).abs() < 1e-9 * size));
            }
        }
        net.spec.gravity = Some([1.0, 0.0, 0.0]);
        assert!(run(&net, &id, [0.0; 3]).iter().zip(&a).any(|(x, y)| (x - y).abs() > 1e-3 * size), "the control");
    }

    #[test]
    fn gradients_through_memory_and_rollout_are_those_of_finite_differences() {
        let (net, mut p, state) = made(4);
        let act = vec![ACTION.to_vec()];
        let before = (0..3).map(|t| (state(40 + t), act.clone())).collect();
        let near = |seed: u64| {
            let (a, b) = (state(5), state(seed));
            State { x: a.x.iter().zip(&b.x).map(|(a, b)| a + 0.05 * b).collect(), v: a.v }
        };
        let truth = (0..4).map(|h| near(60 + h)).collect();
        let mut w = Window { before, state: state(5), actions: vec![act; 4], truth };
        let mut d = Grads::new(&p);
        let (_, d_state, d_actions) = rollout_loss(&net, &p, &w, Some(&mut d));
        let mut checked = 0;
        for key in p.keys().filter(|&k| p[k].rows() > 0).collect::<Vec<_>>() {
            let rows = p[key].rows();
            for i in (0..rows).step_by(1 + rows / 4) {
                let value = p[key].data()[i];
                let mut at = |x: f64| {
                    p[key].data_mut()[i] = x;
                    rollout_loss(&net, &p, &w, None).0
                };
                let slope = (at(value + H) - at(value - H)) / (2.0 * H);
                at(value);
                let found = d.table(key).data()[i];
                assert!((found - slope).abs() < 1e-6 * (1.0 + slope.abs()), "{key:?} {i}: {found}, {slope}");
                checked += usize::from(slope.abs() > 1e-8);
            }
        }
        assert!(checked > 15, "{checked} weights matter");
        for i in 0..w.state.x.len() {
            for part in 0..2 {
                let mut at = |h: f64| {
                    w.state = state(5);
                    [&mut w.state.x, &mut w.state.v][part][i] += h;
                    rollout_loss(&net, &p, &w, None).0
                };
                let slope = (at(H) - at(-H)) / (2.0 * H);
                let found = [&d_state.x, &d_state.v][part][i];
                assert!((found - slope).abs() < 1e-6 * (1.0 + slope.abs()), "state {part} {i}: {found}, {slope}");
            }
        }
        w.state = state(5);
        for h in 0..w.actions.len() {
            for i in 0..ACTION.len() {
                let mut at = |x: f64| {
                    w.actions[h][0][i] = ACTION[i] + x;
                    rollout_loss(&net, &p, &w, None).0
                };
                let slope = (at(H) - at(-H)) / (2.0 * H);
                at(0.0);
                let found = d_actions[h][0][i];
                assert!((found - slope).abs() < 1e-6 * (1.0 + slope.abs()), "action {h} {i}: {found}, {slope}");
                assert!(slope.abs() > 1e-9, "the action matters");
            }
        }
    }
}
