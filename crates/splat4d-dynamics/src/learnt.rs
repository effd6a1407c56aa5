//! Networks that predict accelerations: their interface, training over whole rollouts, and forecasts.
//!
//! Time is counted in frames: v ← v + a, x ← x + v (semi-implicit Euler). A network may remember (`hidden`): then it
//! first processes the observed ticks before a window.

use crate::actions::Actions;
use crate::optimise::Optimiser;
use crate::paths::{Moment, Neighbours, Paths, Pose};
use splat4d::math::se3::{norm, scale, sub};
use splat4d::math::vec3::dot;
use splat4d::math::{Real, Rng};
use splat4d::scene::{Grads, Params};
use splat4d::{Error, Result};

/// Typical sizes: of the scene, of displacements a frame and of their changes, scene units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scales {
    /// L.
    pub length: f64,
    /// S.
    pub velocity: f64,
    /// A.
    pub acceleration: f64,
}

/// Several copies of the nodes side by side: x and v \[rows, 3], rows = copies · nodes.
#[derive(Clone, Debug, Default)]
pub struct State<F> {
    /// Positions.
    pub x: Vec<F>,
    /// Displacements a frame.
    pub v: Vec<F>,
}

impl<F: Real> State<F> {
    /// Zeros for this many rows.
    pub(crate) fn zeros(rows: usize) -> Self {
        Self { x: vec![F::ZERO; 3 * rows], v: vec![F::ZERO; 3 * rows] }
    }
}

/// Scaled inputs of a copy: vectors \[3 each], then scalars.
pub type Action<F> = Vec<F>;

/// Gradients to the inputs of a tick.
#[derive(Debug)]
pub struct InputGrads<'a, F> {
    /// To positions and velocities.
    pub state: &'a mut State<F>,
    /// To the scaled actions, one a copy.
    pub actions: &'a mut [Action<F>],
}

/// A network whose weights are in a [`Params`].
pub trait Network: Clone {
    /// State for a step's backward.
    type Tape<F: Real>: Default;

    /// Nodes.
    fn nodes(&self) -> usize;
    /// Sizes that it was made for.
    fn scales(&self) -> Scales;
    /// Ticks that it needs before a forecast.
    fn warm_up(&self) -> usize {
        0
    }
    /// State that it keeps for a row.
    fn memory(&self) -> usize {
        0
    }
    /// Accelerations \[rows, 3], scene units a frame²; moves `hidden` \[rows, memory] on by a tick. `actions`: one a
    /// copy.
    fn accelerations<F: Real>(
        &self,
        p: &Params<F>,
        state: &State<F>,
        actions: &[Action<F>],
        hidden: &mut Vec<F>,
        tape: &mut Self::Tape<F>,
    ) -> Vec<F>;
    /// The VJP of [`accelerations`](Self::accelerations): adds to the gradients of state, actions (one a copy) and
    /// weights, and turns the gradient to `hidden` after the tick into that before it.
    fn backward<F: Real>(
        &self,
        p: &Params<F>,
        tape: &Self::Tape<F>,
        d_a: &[F],
        d_inputs: InputGrads<'_, F>,
        d_hidden: &mut Vec<F>,
        d: &mut Grads<F>,
    );
}

pub(crate) fn row<F: Real>(x: &[F], i: usize) -> [F; 3] {
    [x[3 * i], x[3 * i + 1], x[3 * i + 2]]
}

/// x_i += s a
pub(crate) fn put<F: Real>(x: &mut [F], i: usize, s: F, a: [F; 3]) {
    (0..3).for_each(|c| x[3 * i + c] += s * a[c]);
}

/// Settings of training.
#[derive(Clone, Debug)]
pub struct Training {
    /// Steps in all.
    pub steps: usize,
    /// Seed of weights, windows and noise: an ensemble differs in it.
    pub seed: u64,
}

impl Default for Training {
    fn default() -> Self {
        Self { steps: 1500, seed: 0 }
    }
}

/// Fewest ticks to learn from.
pub const LEAST_TICKS: usize = 6;
/// Horizons of the windows, each for an equal share of the steps.
const HORIZONS: [usize; 5] = [1, 2, 4, 8, 16];
/// Weight of a frame, of the one before.
const FADE: f64 = 0.95;
/// Weight of velocities next to positions.
const VELOCITY_WEIGHT: f64 = 0.1;
/// Up to this share of L errors count by their square, beyond by themselves (Huber).
const HUBER: f64 = 0.01;
/// Noise on the positions that a window starts from, of L, and on its velocities, of S; zero after this share of the
/// steps.
const NOISE: [f64; 2] = [0.003, 0.1];
const NOISE_UNTIL: f64 = 1.0 / 3.0;
/// Approximate rows of a step: the number of windows follows from it, at most this many.
const ROWS: usize = 96;
const MOST_WINDOWS: usize = 8;
/// In forecasts no acceleration is larger than this multiple of the largest that was observed: what was never seen
/// drifts and does not explode.
const STEEPEST: f64 = 3.0;
/// Smallest scale of velocities and accelerations, of L: static nodes have no scale of their own.
const STILLEST: f64 = 1e-6;

/// A trained network.
#[derive(Clone, Debug)]
pub struct Learnt<N> {
    pub(crate) net: N,
    /// Its weights.
    pub params: Params<f32>,
    /// One over the size of each vector and scalar of an action.
    pub(crate) units: Vec<f64>,
    pub(crate) columns: (Vec<usize>, Vec<usize>),
    steepest: f64,
    /// Mean loss of the last tenth of training.
    pub loss: f64,
}

/// One window of training: where it starts and what is true after each frame.
pub(crate) struct Window<F> {
    /// Ticks before, and what acted then.
    pub before: Vec<(State<F>, Vec<Action<F>>)>,
    pub state: State<F>,
    /// \[horizon]\[graphs]
    pub actions: Vec<Vec<Action<F>>>,
    /// \[horizon]: positions and velocities.
    pub truth: Vec<State<F>>,
}

impl<N: Network> Learnt<N> {
    /// Learns from observed paths, and from the actions on them, with the network that `make` makes for scales, numbers
    /// of vectors and scalars of an action, and a seed. Nothing after the last tick is examined.
    ///
    /// Errors: fewer than [`LEAST_TICKS`] ticks; those of `make`.
    pub(crate) fn fit(
        paths: &Paths,
        actions: Option<&Actions>,
        training: &Training,
        make: impl FnOnce(Scales, [usize; 2], u64) -> Result<(N, Params<f32>)>,
    ) -> Result<Self> {
        let ticks = paths.len();
        if ticks < LEAST_TICKS {
            return Err(Error::input(format!("{ticks} observed frames are too few to learn motion from"))
                .remedy(format!("Observe more: {LEAST_TICKS} at least, and several periods of periodic motion")));
        }
        let columns = actions.map(Actions::columns).unwrap_or_default();
        let velocities = paths.velocities();
        let changes: Vec<f64> = velocities
            .windows(2)
            .flat_map(|w| w[0].iter().zip(&w[1]).map(|(a, b)| norm(sub(*b, *a))).collect::<Vec<_>>())
            .collect();
        let length = paths.extent().max(f64::MIN_POSITIVE);
        let least = STILLEST * length;
        let speeds: Vec<f64> = velocities.iter().flatten().map(|v| norm(*v)).collect();
        let scales = Scales { length, velocity: rms(&speeds).max(least), acceleration: rms(&changes).max(least) };
        let steepest = STEEPEST * changes.iter().copied().fold(0.0, f64::max);
        let (net, params) = make(scales, [columns.0.len(), columns.1.len()], training.seed)?;
        let units = actions.map_or_else(Vec::new, |a| units(a, &columns, ticks));
        let mut model = Self { net, params, units, columns, steepest, loss: 0.0 };
        // What was static needs no force, and gives nothing to learn.
        if rms(&speeds) > least {
            model.train(paths, actions, training);
        }
        Ok(model)
    }

    fn train(&mut self, paths: &Paths, actions: Option<&Actions>, training: &Training) {
        let graphs = (ROWS / paths.nodes()).clamp(1, MOST_WINDOWS);
        let mut optimiser = Optimiser::new(&self.params);
        let (mut sum, mut count) = (0.0, 0);
        for step in 0..training.steps {
            let done = step as f64 / training.steps as f64;
            let stage = (done * HORIZONS.len() as f64) as usize;
            let horizon = HORIZONS[stage].min(paths.len() - 2 - self.warm_up(paths));
            let rng = Rng::new(training.seed, "windows", step as u64);
            let noise = NOISE.map(|n| n * (1.0 - done / NOISE_UNTIL).max(0.0));
            // The first tick has no velocity.
            let earliest = 1 + self.warm_up(paths);
            let starts: Vec<usize> =
                (0..graphs).map(|g| earliest + rng.below(g as u64, paths.len() - earliest - horizon)).collect();
            let mut window = self.window(paths, &starts, horizon, |tick| self.action(actions, tick));
            let scales = self.net.scales();
            let sizes = [scales.length, scales.velocity];
            let State { x, v } = &mut window.state;
            for (part, numbers) in [x, v].into_iter().enumerate() {
                let (rng, size) = (rng.fork(part as u64), (noise[part] * sizes[part]) as f32);
                numbers.iter_mut().enumerate().for_each(|(i, x)| *x += size * rng.normal(i as u64) as f32);
            }
            let net = &self.net;
            let mut loss = 0.0;
            optimiser.step(&mut self.params, done, |p, d| loss = rollout_loss(net, p, &window, Some(d)).0.f64());
            if 10 * step >= 9 * training.steps {
                sum += loss;
                count += 1;
            }
        }
        self.loss = sum / f64::from(count.max(1));
    }

    /// Windows of this many frames from observed states, side by side. `action`: the scaled action after a tick.
    pub(crate) fn window(
        &self,
        paths: &Paths,
        starts: &[usize],
        horizon: usize,
        action: impl Fn(usize) -> Action<f32>,
    ) -> Window<f32> {
        let n = paths.nodes();
        let tick = |start: &usize, h: isize| start.checked_add_signed(h).expect("a window begins after its warm-up");
        let state = |h: isize| {
            let mut out = State::default();
            for tick in starts.iter().map(|start| tick(start, h)) {
                for k in 0..n {
                    let (x, before) = (paths.moments[tick][k].x, paths.moments[tick - 1][k].x);
                    out.x.extend(x.map(|x| x as f32));
                    out.v.extend(sub(x, before).map(|x| x as f32));
                }
            }
            out
        };
        let acts = |h: isize| starts.iter().map(|start| action(tick(start, h))).collect::<Vec<_>>();
        let before = (1..=self.warm_up(paths) as isize).rev().map(|h| (state(-h), acts(-h))).collect();
        let actions = (0..horizon as isize).map(acts).collect();
        Window { before, state: state(0), actions, truth: (1..=horizon as isize).map(state).collect() }
    }

    /// Ticks before a window: as many as the network needs, and at most a third of what there is.
    pub(crate) fn warm_up(&self, paths: &Paths) -> usize {
        self.net.warm_up().min(paths.len() / 3)
    }

    /// The scaled action between a tick and the next.
    pub(crate) fn action(&self, actions: Option<&Actions>, tick: usize) -> Action<f32> {
        let Some(row) = actions.map(|a| &a.rows[tick]) else { return Vec::new() };
        let (vectors, scalars) = &self.columns;
        let parts = vectors.iter().map(|&c| &row[c..c + 3]).chain(scalars.iter().map(|&c| &row[c..=c]));
        parts.zip(&self.units).flat_map(|(part, unit)| part.iter().map(move |x| (x * unit) as f32)).collect()
    }

    /// The row of a table, of this many columns, that has a scaled action.
    pub(crate) fn unscaled(&self, action: &[f64], columns: usize) -> Vec<f64> {
        let (vectors, scalars) = &self.columns;
        let mut out = vec![0.0; columns];
        let places = vectors.iter().map(|&c| c..c + 3).chain(scalars.iter().map(|&c| c..c + 1));
        let mut numbers = action.iter();
        for (place, unit) in places.zip(&self.units) {
            out[place].iter_mut().zip(&mut numbers).for_each(|(to, x)| *to = x / unit);
        }
        out
    }

    /// The times after the last of `paths`; row t of the actions acts after tick t.
    pub fn rollout(&self, paths: &Paths, actions: Option<&Actions>, horizon: usize) -> Vec<Moment> {
        let ticks = paths.len();
        let mut hidden = vec![0.0; self.net.memory() * paths.nodes()];
        let mut tape = N::Tape::default();
        for t in ticks - 1 - self.warm_up(paths).min(ticks - 2)..ticks - 1 {
            let action = self.action(actions, t);
            self.net.accelerations(&self.params, &state_at(paths, t), &[action], &mut hidden, &mut tape);
        }
        let mut now = paths.last().clone();
        let before = &paths.moments[ticks - 2];
        let mut state = state_at(paths, ticks - 1);
        // Positions add up in f64, from the very numbers that were observed.
        let mut velocity: Vec<[f64; 3]> = now.iter().zip(before).map(|(a, b)| sub(a.x, b.x)).collect();
        let rest = now.clone();
        let frames = Neighbours::new(&rest);
        (0..horizon)
            .map(|h| {
                let action = self.action(actions, ticks - 1 + h);
                let a = self.net.accelerations(&self.params, &state, &[action], &mut hidden, &mut tape);
                for (k, (p, v)) in now.iter_mut().zip(&mut velocity).enumerate() {
                    let a = row(&a, k).map(f64::from);
                    let size = norm(a);
                    let a = if size > self.steepest { scale(a, self.steepest / size) } else { a };
                    *v = std::array::from_fn(|c| v[c] + a[c]);
                    *p = Pose { x: std::array::from_fn(|c| p.x[c] + v[c]), q: p.q };
                    for c in 0..3 {
                        (state.x[3 * k + c], state.v[3 * k + c]) = (p.x[c] as f32, v[c] as f32);
                    }
                }
                frames.turn(&rest, &mut now);
                now.clone()
            })
            .collect()
    }
}

/// Positions and velocities at a tick. The first has no velocity.
fn state_at(paths: &Paths, tick: usize) -> State<f32> {
    let (now, before) = (&paths.moments[tick], &paths.moments[tick.saturating_sub(1)]);
    State {
        x: now.iter().flat_map(|p| p.x.map(|x| x as f32)).collect(),
        v: now.iter().zip(before).flat_map(|(a, b)| sub(a.x, b.x).map(|x| x as f32)).collect(),
    }
}

/// Root of the mean square.
pub(crate) fn rms(x: &[f64]) -> f64 {
    (x.iter().map(|x| x * x).sum::<f64>() / x.len().max(1) as f64).sqrt()
}

/// One over the size of every vector and scalar over the observed ticks; 1 where it is nothing all the time.
fn units(actions: &Actions, (vectors, scalars): &(Vec<usize>, Vec<usize>), ticks: usize) -> Vec<f64> {
    let size = |columns: std::ops::Range<usize>| {
        let rows = actions.rows.iter().take(ticks - 1);
        let sizes: Vec<f64> = rows.map(|r| r[columns.clone()].iter().map(|x| x * x).sum::<f64>().sqrt()).collect();
        let size = rms(&sizes);
        if size > 0.0 { 1.0 / size } else { 1.0 }
    };
    vectors.iter().map(|&c| size(c..c + 3)).chain(scalars.iter().map(|&c| size(c..c + 1))).collect()
}

/// The loss of a rollout from a window's start, and with `d` the gradient to the weights, to the start and to the
/// actions of every frame.
pub(crate) fn rollout_loss<N: Network, F: Real>(
    net: &N,
    p: &Params<F>,
    w: &Window<F>,
    d: Option<&mut Grads<F>>,
) -> (F, State<F>, Vec<Vec<Action<F>>>) {
    let mut state = w.state.clone();
    let (rows, length) = (state.x.len() / 3, net.scales().length);
    let mut hidden = vec![F::ZERO; rows * net.memory()];
    let mut warm = Vec::new();
    for (state, actions) in &w.before {
        let mut tape = N::Tape::default();
        net.accelerations(p, state, actions, &mut hidden, &mut tape);
        warm.push(tape);
    }
    let (mut loss, mut tapes, mut errors) = (F::ZERO, Vec::new(), Vec::new());
    let all: f64 = (0..w.truth.len()).map(|h| FADE.powi(h as i32)).sum();
    for (h, truth) in w.truth.iter().enumerate() {
        let mut tape = N::Tape::default();
        let a = net.accelerations(p, &state, &w.actions[h], &mut hidden, &mut tape);
        for i in 0..a.len() {
            state.v[i] += a[i];
            state.x[i] += state.v[i];
        }
        let weight = FADE.powi(h as i32) / (all * rows as f64 * length);
        let mut error = State::zeros(rows);
        loss += huber(&state.x, &truth.x, weight, length, &mut error.x);
        loss += huber(&state.v, &truth.v, VELOCITY_WEIGHT * weight, length, &mut error.v);
        tapes.push(tape);
        errors.push(error);
    }
    let mut d_state = State::zeros(rows);
    let zeros = |actions: &Vec<Action<F>>| actions.iter().map(|a| vec![F::ZERO; a.len()]).collect::<Vec<_>>();
    let mut d_actions: Vec<Vec<Action<F>>> = w.actions.iter().map(zeros).collect();
    if let Some(d) = d {
        let mut d_hidden = vec![F::ZERO; hidden.len()];
        for ((tape, error), d_actions) in tapes.iter().zip(&errors).zip(&mut d_actions).rev() {
            for i in 0..3 * rows {
                d_state.x[i] += error.x[i];
                d_state.v[i] += error.v[i] + d_state.x[i];
            }
            let d_a = d_state.v.clone();
            net.backward(p, tape, &d_a, InputGrads { state: &mut d_state, actions: d_actions }, &mut d_hidden, d);
        }
        // Observations have no gradient, but the memory state depends on the weights.
        let (nothing, mut unused) = (vec![F::ZERO; 3 * rows], State::zeros(rows));
        for (tape, (_, actions)) in warm.iter().zip(&w.before).rev() {
            let mut d_actions = zeros(actions);
            let d_inputs = InputGrads { state: &mut unused, actions: &mut d_actions };
            net.backward(p, tape, &nothing, d_inputs, &mut d_hidden, d);
        }
    }
    (loss, d_state, d_actions)
}

/// weight · Σ ρ(|found − truth|) over rows, and its gradient; ρ is half the square below [`HUBER`] · length, in its
/// units.
fn huber<F: Real>(found: &[F], truth: &[F], weight: f64, length: f64, d: &mut [F]) -> F {
    let (weight, delta, half) = (F::of(weight), F::of(HUBER * length), F::of(0.5));
    let mut sum = F::ZERO;
    for i in 0..found.len() / 3 {
        let (a, b) = (row(found, i), row(truth, i));
        let e: [F; 3] = std::array::from_fn(|c| a[c] - b[c]);
        let size = dot(e, e).sqrt();
        let (value, slope) = match size < delta {
            true => (half * size * size / delta, F::ONE / delta),
            false => (size - half * delta, F::ONE / size),
        };
        sum += weight * value;
        put(d, i, weight * slope, e);
    }
    sum
}
