//! Losses that tie the poses of a tracked frame to those before: the losses of Luiten et al. 2024 on pages.
//!
//! Over the foreground (all Gaussians where there are no masks), with the graph of its neighbours in frame 0: rigidity,
//! rotation and isometry (see [`super::rigid`]), and a floor, mean max(h − up·x, 0). Over the background: the mean of
//! ‖x − x₀‖₁ + ‖q − q₀‖₁ to frame 0. Over all: the mean of ‖rgb − rgb'‖₁ to the colours that the frame began with.
//!
//! The paper's weights are for metres; here every length is divided by a unit that the program chooses, so that scenes
//! of any unit are treated alike. Gradients are those of the newest page and to the base colour alone.

use super::graph::{Graph, Weigh};
use super::rigid::{Poses, isometry, rigidity, rotation};
use super::terms::{ParamLoss, ResidentLoss, StepInfo};
use rayon::prelude::*;
use splat4d::layers::{Layer, Scene};
use splat4d::math::Real;
use splat4d::math::sh::C0;
use splat4d::motion::tracked::{FOREGROUND, POSE, page_of};
use splat4d::render::ResidentTies;
use splat4d::scene::params::QUAT;
use splat4d::scene::{GEOMETRY, Grads, Key, SH, Space};
use std::sync::{Arc, Mutex, MutexGuard};

/// Weights, as the paper names them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Weights {
    /// Neighbours keep their offsets, turned with each Gaussian.
    pub rigid: f64,
    /// Neighbours turn alike.
    pub rot: f64,
    /// Neighbours keep the distances they had in frame 0.
    pub iso: f64,
    /// The background stays.
    pub bg: f64,
    /// Colours stay.
    pub soft_col: f64,
    /// Nothing sinks below the floor.
    pub floor: f64,
}

/// The settings that do not change while frames are tracked.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Ties {
    /// Neighbours a Gaussian.
    pub neighbours: usize,
    /// The weight of an edge.
    pub weigh: Weigh,
    /// The weights of the losses.
    pub weights: Weights,
    /// Height of the floor along the scene's up direction, scene units.
    pub floor: f64,
    /// Every length is divided by this, scene units.
    pub unit: f64,
}

/// Foreground, background and the graph of neighbours in frame 0.
#[derive(Debug)]
pub(crate) struct Frame0<F> {
    foreground: Vec<u32>,
    background: Vec<u32>,
    /// Of the foreground.
    pub graph: Graph<F>,
}

impl<F: Real> Frame0<F> {
    fn new(layer: &Layer<F>, ties: &Ties) -> Self {
        let p = &layer.params;
        let logits = p.find(FOREGROUND);
        let is_front = |row: &u32| logits.is_none_or(|k| p[k].get(*row as usize, 0) > F::ZERO);
        let (foreground, background): (Vec<u32>, Vec<u32>) = (0..p.len() as u32).partition(is_front);
        let points: Vec<[F; 3]> = foreground.iter().map(|&r| p[GEOMETRY].read(r as usize, 0)).collect();
        Self { graph: Graph::new(&points, ties.neighbours, ties.weigh), foreground, background }
    }
}

/// The shared memory of the frames' losses: the graph, and the colours that the newest frame began with.
#[derive(Debug)]
struct Memory<F> {
    frame0: Option<Arc<Frame0<F>>>,
    frame: usize,
    colors: Vec<[F; 3]>,
}

/// The losses of all frames of a run; [`frame`](Self::frame) gives those of one.
#[derive(Clone, Debug)]
pub(crate) struct Tracking<F> {
    ties: Ties,
    memory: Arc<Mutex<Memory<F>>>,
}

impl<F: Real> Tracking<F> {
    /// Nothing is remembered yet.
    pub(crate) fn new(ties: Ties) -> Self {
        Self { ties, memory: Arc::new(Mutex::new(Memory { frame0: None, frame: 0, colors: Vec::new() })) }
    }

    /// The losses on frame `frame`, from 1 on.
    pub(crate) fn frame(&self, frame: usize) -> Tied<F> {
        assert!(frame > 0, "frame 0 is tied to nothing");
        Tied { of: self.clone(), frame }
    }

    /// The foreground and its graph of neighbours, made again where nothing was cached.
    pub(crate) fn frame0(&self, layer: &Layer<F>) -> Arc<Frame0<F>> {
        let mut memory = self.lock();
        memory.frame0.get_or_insert_with(|| Arc::new(Frame0::new(layer, &self.ties))).clone()
    }

    fn lock(&self) -> MutexGuard<'_, Memory<F>> {
        self.memory.lock().expect("no thread panics while it holds the memory of tracking")
    }
}

/// The losses on one frame.
#[derive(Clone, Debug)]
pub(crate) struct Tied<F> {
    of: Tracking<F>,
    frame: usize,
}

/// Positions and quaternions of some rows of a page.
fn poses<F: Real>(layer: &Layer<F>, key: Key, rows: &[u32]) -> (Vec<[F; 3]>, Vec<[F; 4]>) {
    rows.par_iter()
        .with_min_len(4096)
        .map(|&r| (layer.params[key].read::<3>(r as usize, 0), layer.params[key].read::<4>(r as usize, QUAT)))
        .unzip()
}

/// ‖a − b‖₁, and its gradient.
fn l1<F: Real, const N: usize>(a: [F; N], b: [F; N]) -> (f64, [F; N]) {
    let e: [F; N] = std::array::from_fn(|k| a[k] - b[k]);
    let sign = |x: F| {
        if x > F::ZERO {
            F::ONE
        } else if x < F::ZERO {
            -F::ONE
        } else {
            F::ZERO
        }
    };
    (e.iter().map(|x| x.abs().f64()).sum(), e.map(sign))
}

impl<F: Real> Tied<F> {
    fn foreground(&self, scene: &Scene<F>, frame0: &Frame0<F>, keys: [Key; 2], d: &mut Grads<F>) -> f64 {
        let (layer, rows, ties) = (&scene.layers[0], &frame0.foreground, &self.of.ties);
        let w = ties.weights;
        let (now, before) = (poses(layer, keys[1], rows), poses(layer, keys[0], rows));
        let (now, before) = (Poses { x: &now.0, q: &now.1 }, Poses { x: &before.0, q: &before.1 });
        let (mut d_x, mut d_q) = (vec![[F::ZERO; 3]; rows.len()], vec![[F::ZERO; 4]; rows.len()]);
        let (graph, per) = (&frame0.graph, 1.0 / ties.unit);
        let mut loss = 0.0;
        if w.rigid > 0.0 {
            loss += rigidity(graph, now, before, w.rigid * per, &mut d_x, &mut d_q);
        }
        if w.rot > 0.0 {
            loss += rotation(graph, now.q, before.q, w.rot, &mut d_q);
        }
        if w.iso > 0.0 {
            loss += isometry(graph, now.x, w.iso * per, &mut d_x);
        }
        if w.floor > 0.0 {
            let scale = w.floor * per / rows.len().max(1) as f64;
            let up = scene.up.map(F::of);
            for (x, d_x) in now.x.iter().zip(&mut d_x) {
                let below = F::of(ties.floor) - (up[0] * x[0] + up[1] * x[1] + up[2] * x[2]);
                if below > F::ZERO {
                    loss += scale * below.f64();
                    (0..3).for_each(|k| d_x[k] += F::of(-scale) * up[k]);
                }
            }
        }
        let active = d.active(Space::Gaussians).to_vec();
        let [page] = d.of([keys[1]]);
        for (&r, (d_x, d_q)) in rows.iter().zip(d_x.iter().zip(&d_q)).filter(|(r, _)| active[**r as usize]) {
            page.add(r as usize, 0, *d_x);
            page.add(r as usize, QUAT, *d_q);
        }
        loss
    }

    fn background(&self, layer: &Layer<F>, rows: &[u32], key: Key, d: &mut Grads<F>) -> f64 {
        let weight = self.of.ties.weights.bg;
        if weight == 0.0 || rows.is_empty() {
            return 0.0;
        }
        let active = d.active(Space::Gaussians).to_vec();
        let [page] = d.of([key]);
        let scale = weight / rows.len() as f64;
        let per = 1.0 / self.of.ties.unit;
        let mut loss = 0.0;
        for r in rows.iter().map(|&r| r as usize).filter(|&r| active[r]) {
            let (now, first) = (layer.params[key].read::<POSE>(r, 0), layer.params[GEOMETRY].read::<POSE>(r, 0));
            let (far, d_x) = l1([now[0], now[1], now[2]], [first[0], first[1], first[2]]);
            let q = |pose: [F; POSE]| -> [F; 4] { std::array::from_fn(|k| pose[QUAT + k]) };
            let dot: F = (QUAT..POSE).map(|k| now[k] * first[k]).sum();
            // Both signs of a quaternion are one turn.
            let sign = if dot < F::ZERO { -F::ONE } else { F::ONE };
            let (turned, d_q) = l1(q(now), q(first).map(|x| sign * x));
            loss += scale * (per * far + turned);
            page.add(r, 0, d_x.map(|x| x * F::of(scale * per)));
            page.add(r, QUAT, d_q.map(|x| x * F::of(scale)));
        }
        loss
    }

    fn colors(&self, layer: &Layer<F>, d: &mut Grads<F>) -> f64 {
        let weight = self.of.ties.weights.soft_col;
        let table = &layer.params[SH];
        if weight == 0.0 || table.width() == 0 {
            return 0.0;
        }
        let mut memory = self.of.lock();
        if memory.frame != self.frame || memory.colors.len() != table.rows() {
            memory.frame = self.frame;
            memory.colors = (0..table.rows()).map(|r| table.read(r, 0)).collect();
        }
        let active = d.active(Space::Gaussians).to_vec();
        let [d_sh] = d.of([SH]);
        let scale = weight * C0 / table.rows().max(1) as f64;
        let mut loss = 0.0;
        for r in (0..table.rows()).filter(|&r| active[r]) {
            let (far, d_row) = l1(table.read::<3>(r, 0), memory.colors[r]);
            loss += scale * far;
            d_sh.add(r, 0, d_row.map(|x| x * F::of(scale)));
        }
        loss
    }
}

impl<F: Real> ParamLoss<F> for Tied<F> {
    fn name(&self) -> &str {
        "tracking"
    }

    fn eval(&self, scene: &Scene<F>, _info: &StepInfo, d: &mut [Grads<F>]) -> f64 {
        let layer = &scene.layers[0];
        let key = |frame| page_of(&layer.params, frame);
        let (Some(before), Some(now)) = (key(self.frame - 1), key(self.frame)) else { return 0.0 };
        let frame0 = self.of.frame0(layer);
        self.foreground(scene, &frame0, [before, now], &mut d[0])
            + self.background(layer, &frame0.background, now, &mut d[0])
            + self.colors(layer, &mut d[0])
    }

    /// Colours that learn are the CPU's.
    fn kept(&self) -> Option<ResidentLoss> {
        (self.of.ties.weights.soft_col == 0.0).then_some(ResidentLoss::Ties)
    }

    fn ties(&self, scene: &Scene<F>) -> Option<ResidentTies> {
        let layer = &scene.layers[0];
        let before = page_of(&layer.params, self.frame - 1)?;
        let (frame0, Ties { weights: w, floor, unit, .. }) = (self.of.frame0(layer), &self.of.ties);
        let Frame0 { foreground, background, graph } = frame0.as_ref();
        let share = |weight: f64, of: usize| weight / of.max(1) as f64;
        let single = |x: F| x.f64() as f32;
        let [first, back] = graph.all_to();
        let stays = share(w.bg, background.len());
        Some(ResidentTies {
            points: foreground.clone(),
            background: background.clone(),
            neighbours: graph.k(),
            edges: graph.all().map(|(to, long, weight)| (to, single(long), single(weight))).collect(),
            first: first.to_vec(),
            back: back.to_vec(),
            before: foreground.iter().map(|&r| layer.params[before].read(r as usize, 0).map(single)).collect(),
            rigid: share(w.rigid / unit, graph.edges()),
            rot: share(w.rot, graph.edges()),
            iso: share(w.iso / unit, graph.edges()),
            floor: share(w.floor / unit, foreground.len()),
            height: *floor,
            up: scene.up,
            stays: [stays / unit, stays],
        })
    }

    fn on_edit(&self) {
        let mut memory = self.of.lock();
        (memory.frame0, memory.colors) = (None, Vec::new());
    }

    /// The colours that the frame began with, as bits; who is near whom follows from frame 0.
    fn state(&self) -> Vec<u32> {
        let memory = self.of.lock();
        if memory.frame != self.frame {
            return Vec::new();
        }
        memory.colors.iter().flatten().map(|x| (x.f64() as f32).to_bits()).collect()
    }

    fn restore(&self, state: &[u32]) {
        let mut memory = self.of.lock();
        // Frame 0 itself may have been restored.
        memory.frame0 = None;
        if !state.is_empty() {
            memory.frame = self.frame;
            let value = |bits: u32| F::of(f64::from(f32::from_bits(bits)));
            memory.colors = state.as_chunks::<3>().0.iter().map(|c| c.map(value)).collect();
        } else if memory.frame == self.frame {
            (memory.frame, memory.colors) = (0, Vec::new());
        }
    }
}

#[cfg(test)]
mod tests;
