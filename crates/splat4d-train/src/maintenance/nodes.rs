//! Nodes of a skin: lists of nearest nodes are refreshed, nodes are added where Gaussians cannot follow, and nodes
//! that no Gaussian follows are removed.
//!
//! Source: Huang et al. 2024 (SC-GS), there every 5,000 of 80,000 steps from 1,000 to 25,000 with the gradient to
//! positions in space; here with that to positions in the image, which densification gathers anyway.

use super::{At, Change, Context, DensifySettings, Every, Maintenance, RunOrder};
use crate::Result;
use crate::settings::settings;
use crate::train_state::TrainState;
use splat4d::math::Rng;
use splat4d::motion::skin::{NODE_HYPER, Skin, Weights};
use splat4d::scene::{Born, GEOMETRY, RowEdit, Space};

/// Nodes are never fewer than this: a Gaussian's three and the one that cuts off.
const LEAST_NODES: usize = 4;

settings! {
    /// Settings of the maintenance of control nodes.
    #[derive(Copy)]
    pub struct NodeSettings
    when (Is("run.motion", &["control", "ssm"])) {
        /// Iterations between refreshes of the lists of nearest nodes.
        bind_interval: usize = 100 => at_least(1).unit("iterations");
        /// Iterations between additions and removals of nodes, while Gaussians densify; 0: never.
        adapt_interval: usize = 0 => any().unit("iterations");
        /// Mean 2D gradient of a node's Gaussians above which it gets a second one (NDC units).
        threshold: f64 = 4e-4 => any().when(On("nodes.adapt_interval"));
        /// Largest number of nodes.
        cap: usize = 1024 => any().when(On("nodes.adapt_interval"));
    }
}

/// See the module's documentation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct AdaptNodes {
    /// How, and how often.
    pub settings: NodeSettings,
    /// First and last step that adds or removes nodes.
    pub span: (usize, usize),
}

impl AdaptNodes {
    /// With these settings.
    pub(crate) fn of(settings: NodeSettings, densify: &DensifySettings) -> Self {
        Self { settings, span: (densify.from, densify.until) }
    }

    fn edits_at(&self, step: usize) -> bool {
        let (first, last) = self.span;
        Every { first, last, interval: self.settings.adapt_interval }.is_due(step)
    }
}

impl Maintenance for AdaptNodes {
    fn name(&self) -> &str {
        "nodes"
    }

    fn order(&self) -> RunOrder {
        RunOrder::Nodes
    }

    fn due(&self, at: &At) -> bool {
        let interval = self.settings.bind_interval;
        self.edits_at(at.step) || (interval > 0 && at.step.is_multiple_of(interval))
    }

    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        for layer in 0..train_state.scene().layers.len() {
            let Some(skin) = Skin::find(&train_state.scene().layers[layer].params) else { continue };
            if self.edits_at(c.at.step) {
                self.settings.edit(&skin, train_state, layer, &c.rng("adapt"));
            }
            skin.bind(&mut train_state.scene_mut().layers[layer].params);
        }
        train_state.neighbours_changed();
        Ok(Change::default())
    }

    fn in_tuning(&self) -> bool {
        true
    }
}

/// The pull on a node of the Gaussians that follow it.
#[derive(Clone, Copy, Default)]
struct Pull {
    /// Σ a and Σ a g.
    weight: f64,
    gradient: f64,
    /// Σ a g x.
    place: [f64; 3],
}

impl NodeSettings {
    fn edit(&self, skin: &Skin, train_state: &mut TrainState, layer: usize, rng: &Rng) {
        let (p, stats) = (&train_state.scene().layers[layer].params, train_state.stats());
        let count = skin.count(p);
        let mut weights = Weights::default();
        skin.weigh(p, &mut weights);
        let mut pulls = vec![Pull::default(); count];
        let mut hyper = vec![0.0; count * skin.spec.hyper];
        for i in 0..p.len() {
            let g = f64::from(stats.gradient(layer, i));
            let x = p[GEOMETRY].read::<3>(i, 0);
            let (nodes, a) = weights.row(i);
            for (&node, &a) in nodes.iter().zip(a) {
                let (node, a) = (node as usize, f64::from(a));
                let pull = &mut pulls[node];
                pull.weight += a;
                pull.gradient += a * g;
                (0..3).for_each(|k| pull.place[k] += a * g * f64::from(x[k]));
                for c in 0..skin.spec.hyper {
                    hyper[node * skin.spec.hyper + c] += a * g * f64::from(p[skin.hyper].get(i, c));
                }
            }
        }
        let keep = |k: usize| pulls[k].weight > 0.0 || count <= LEAST_NODES;
        let mut edit = RowEdit::prune(Space::Nodes, (0..count).map(keep));
        let kept = edit.len();
        let mean = |k: usize| pulls[k].gradient / pulls[k].weight.max(f64::MIN_POSITIVE);
        let mut strained: Vec<usize> = (0..count).filter(|&k| keep(k) && mean(k) > self.threshold).collect();
        strained.sort_by(|&a, &b| mean(b).total_cmp(&mean(a)).then(a.cmp(&b)));
        strained.truncate(self.cap.saturating_sub(kept));
        if kept < LEAST_NODES.min(count) || (kept == count && strained.is_empty()) {
            return;
        }
        strained.iter().for_each(|&k| edit.push(k as u32, Born::Clone));
        train_state.apply(layer, &edit, rng);
        let nodes = &mut train_state.scene_mut().layers[layer].params[skin.nodes];
        for (j, &k) in strained.iter().enumerate() {
            nodes.write(kept + j, 0, pulls[k].place.map(|x| (x / pulls[k].gradient) as f32));
            for c in 0..skin.spec.hyper {
                let mean = hyper[k * skin.spec.hyper + c] / pulls[k].gradient;
                nodes.set(kept + j, NODE_HYPER + c, mean as f32);
            }
        }
    }
}
