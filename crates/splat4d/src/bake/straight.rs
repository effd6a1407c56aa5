//! Linear motion: primitives are computed from the parameters exactly, without samples.

use super::fit::{COLORS, Piece, home, is_visible, primitive, seen};
use super::life::{Envelope, Lives};
use super::sample::own_colors;
use super::sampling::Viewpoints;
use super::shape::Shape;
use super::tree::Tree;
use crate::layers::Layer;
use crate::math::quat;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Key};

/// Motion of a layer that moves linearly.
#[derive(Clone, Copy, Debug)]
pub(super) struct Line {
    velocities: Option<Key>,
    /// Origin of Δ for Gaussians that have infinite lifespans.
    origin: f64,
}

impl Line {
    /// The layer's motion, where it is straight and its opacities are those of its lifespans.
    pub(super) fn of(layer: &Layer<f32>) -> Option<Self> {
        let motion = layer.motion.polynomial().filter(|p| p.is_straight() && !layer.cross_fades())?;
        Some(Self { velocities: motion.velocities, origin: motion.origin })
    }

    /// The primitive of row `id`; none where it is never seen in the clip or is not finite.
    pub(super) fn piece(
        &self,
        layer: &Layer<f32>,
        lives: &Lives<'_>,
        id: usize,
        span: [f64; 2],
        tree: &Tree,
        sampling: &Viewpoints,
    ) -> Option<Piece> {
        let seen = seen(tree, span)?;
        let node = home(tree, seen)?;
        let row = layer.params[GEOMETRY].read::<11>(id, 0);
        let opacity = f64::from(1.0 / (1.0 + (-row[OPACITY]).exp()));
        let shape = learnt(&row);
        let velocity = self.velocities.map_or([0.0; 3], |key| layer.params[key].read::<3>(id, 0).map(f64::from));
        let colors: [f32; COLORS] = own_colors(layer, id);
        let mean: [f64; 3] = std::array::from_fn(|k| f64::from(row[k]));
        let own = lives.envelope(id);
        let finite = row.iter().chain(&colors).all(|x| x.is_finite()) && velocity.iter().all(|x| x.is_finite());
        if !finite || !is_visible(opacity) || !(own.center + own.softness).is_finite() {
            return None;
        }
        let origin = if lives.has_centers() { own.center } else { self.origin };
        let [from, to] = [tree.border(node[0]), tree.border(node[1])];
        // Infinite lifespans count from the middle of the node: nothing is further from it than half the node.
        let life = if own.is_forever() { Envelope::forever(0.5 * (from + to)) } else { own };
        let at = |t: f64| std::array::from_fn(|k| mean[k] + velocity[k] * (t - origin));
        let shown = [seen[0].max(from), seen[1].min(to)];
        let pixels = sampling.pixels(at(0.5 * (shown[0] + shown[1])));
        // A clip of one time has no length to be visible for a share of.
        let [first, last] = tree.clip();
        let share = if first < last { ((shown[1] - shown[0]) / (to - from)).clamp(0.0, 1.0) } else { 1.0 };
        let area = pixels * pixels * share;
        let primitive = primitive(at(life.center), &life, &shape, opacity, velocity, &colors, area);
        Some(Piece { span: node, primitive, error: 0.0 })
    }
}

/// Learnt rotation and scales.
pub(super) fn learnt(row: &[f32; 11]) -> Shape {
    let q = std::array::from_fn(|k| f64::from(row[QUAT + k]));
    let scales = std::array::from_fn(|k| f64::from(row[LOG_SCALE + k]).exp());
    Shape { quat: quat::normalize(q).0, scales, turn: [0.0; 3] }
}
