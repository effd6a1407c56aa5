//! [`Neighbourhood`]: the losses on motion, switched by recipe on any model.

use super::LossSettings;
use super::graph::{Graph, Weigh};
use super::motion;
use super::near::{NEIGHBOURS, Near};
use super::terms::{Probe, ProbeLoss, StepInfo};
use splat4d::layers::Scene;
use splat4d::math::{Real, Rng};
use splat4d::scene::{GEOMETRY, Space, Table, Time};
use std::sync::Mutex;

/// Gaussians a step whose neighbourhoods are examined, other ones in each: this bounds the cost.
pub(crate) const CENTRES: usize = 1024;
/// exp(−c d²/median) of an edge; 1 keeps the typical edge and drops the far ones.
const FALLOFF: f64 = 1.0;

/// Rigidity, rotation, isometry, ARAP, elasticity, velocity, jerk, acceleration and least motion of the Gaussians of
/// every layer that moves, over random neighbourhoods of those alive at the view's time.
///
/// Neighbours are those of the raw means, searched again every 200 steps and after every edit of rows; an edge counts
/// only where both of its ends are alive. The neighbourhoods of a step are a function of seed and step.
pub(crate) struct Neighbourhood<F> {
    weights: LossSettings,
    /// 1/extent
    unit: f64,
    /// Seconds of a frame.
    frame: f64,
    clip: [f64; 2],
    near: Near,
    /// Of the step that is in flight: a graph over the rows of each probe.
    graphs: Mutex<Vec<Graph<F>>>,
}

impl<F: Real> Neighbourhood<F> {
    /// For a scene of this extent (scene units), over a clip (seconds) of this many frames per second.
    pub(crate) fn new(weights: LossSettings, extent: f64, clip: [f64; 2], fps: f64) -> Self {
        Self { weights, unit: 1.0 / extent, frame: 1.0 / fps, clip, near: Near::default(), graphs: Mutex::default() }
    }

    /// Times of a step: two a frame apart from the first view's time on; then, if requested, one frame before and one
    /// after them; then any other.
    fn times(&self, info: &StepInfo, layer: usize) -> Option<Vec<Time>> {
        let seconds = self.clip[1] - self.clip[0];
        let t = info.times.first()?.0;
        let wide = motion::is_wide(&self.weights);
        let (before, after) = if wide { (self.frame, 2.0 * self.frame) } else { (0.0, self.frame) };
        if seconds < before + after {
            return None;
        }
        let t = t.clamp(self.clip[0] + before, self.clip[1] - after);
        let mut times = vec![Time(t), Time(t + self.frame)];
        if wide {
            times.extend([Time(t - self.frame), Time(t + 2.0 * self.frame)]);
        }
        if motion::is_far(&self.weights) {
            let any = Rng::new(info.seed, "far instant", info.iteration as u64).uniform(layer as u64);
            times.push(Time(self.clip[0] + any * seconds));
        }
        Some(times)
    }
}

impl<F: Real> ProbeLoss<F> for Neighbourhood<F> {
    fn name(&self) -> &str {
        "motion"
    }

    fn probes(&self, scene: &Scene<F>, info: &StepInfo) -> Vec<Probe> {
        let mut graphs = self.graphs.lock().expect("no thread panics while it holds the graphs");
        graphs.clear();
        let mut probes = Vec::new();
        for (layer, l) in scene.layers.iter().enumerate() {
            let n = l.params.len();
            let Some(times) = self.times(info, layer) else { continue };
            if n <= NEIGHBOURS || !l.motion.capabilities().moves || !l.spans_over(times[0]) {
                continue;
            }
            let means = &l.params[GEOMETRY];
            let mut alive = Vec::new();
            if l.active(times[0], &mut alive) {
                alive = (0..n as u32).collect();
            }
            let rng = Rng::new(info.seed, "neighbours", info.iteration as u64);
            let (rows, graph) = self.near.with(layer, means, info.iteration, |near| sample(means, near, &alive, rng));
            if graph.edges() > 0 {
                probes.push(Probe { layer, of: Space::Gaussians, rows: Some(rows), times });
                graphs.push(graph);
            }
        }
        probes
    }

    fn eval(&self, _scene: &Scene<F>, probes: &[Probe], seen: &[Vec<Table<F>>], d: &mut [Vec<Table<F>>]) -> f64 {
        let graphs = self.graphs.lock().expect("no thread panics while it holds the graphs");
        assert_eq!(graphs.len(), probes.len(), "`eval` gets the probes of the same step");
        let clip = (self.clip[1] - self.clip[0] + self.frame) / self.frame;
        // From scene units per frame to extents a clip. In the order of time: before, at, after, after that.
        let scale = motion::Scale { unit: self.unit, clip };
        let layers = graphs.iter().zip(seen).zip(d);
        layers.fold(0.0, |loss, ((graph, seen), d)| motion::terms(&self.weights, scale, graph, seen, d, loss))
    }

    fn on_edit(&self) {
        self.near.forget();
    }

    fn state(&self) -> Vec<u32> {
        self.near.state()
    }

    fn restore(&self, state: &[u32]) {
        self.near.restore(state);
    }
}

/// Up to [`CENTRES`] of the rows `alive`, with their neighbours among them: the rows, ascending, and a graph in which
/// only the centres' edges count.
fn sample<F: Real>(means: &Table<F>, near: &[u32], alive: &[u32], rng: Rng) -> (Vec<u32>, Graph<F>) {
    let count = alive.len().min(CENTRES);
    // One of every stratum: sorted and never twice.
    let pick = |s: usize| {
        let at = (s as f64 + rng.uniform(s as u64)) * alive.len() as f64 / count as f64;
        alive[(at as usize).min(alive.len() - 1)]
    };
    let mut centres: Vec<u32> = if count == alive.len() { alive.to_vec() } else { (0..count).map(pick).collect() };
    centres.dedup();
    let of = |c: u32| &near[c as usize * NEIGHBOURS..(c as usize + 1) * NEIGHBOURS];
    let lives = |j: &u32| alive.binary_search(j).is_ok();
    let mut rows: Vec<u32> = centres.iter().flat_map(|&c| of(c).iter().copied().filter(lives).chain([c])).collect();
    rows.sort_unstable();
    rows.dedup();
    let place = |row: u32| rows.binary_search(&row).ok().map(|p| p as u32);
    let mut local: Vec<u32> = (0..rows.len() as u32).flat_map(|i| [i; NEIGHBOURS]).collect();
    for &c in &centres {
        let at = place(c).expect("centres are among the rows") as usize * NEIGHBOURS;
        for (slot, &j) in local[at..at + NEIGHBOURS].iter_mut().zip(of(c)) {
            if lives(&j) {
                *slot = place(j).expect("living neighbours are among the rows");
            }
        }
    }
    let points: Vec<[F; 3]> = rows.iter().map(|&r| means.read(r as usize, 0)).collect();
    (rows, Graph::of(&points, local, Weigh::Median(FALLOFF)))
}

#[cfg(test)]
mod tests;
