//! Collects the primitives of the layers and makes nodes of them.

use super::fit::Piece;
use super::sampling::Viewpoints;
use super::tree::Span;
use super::{Errors, TOLERANCE};
use crate::format::playback::{Node, Primitive, primitives};
use crate::layers::Layer;
use crate::{Error, ErrorKind, Result};
use std::collections::BTreeMap;

/// Most primitives of a scene: about 3 GB of memory while baking, 300 MB of file.
const MAX_PRIMITIVES: usize = 10_000_000;

/// Primitives and statistics of the processed layers.
#[derive(Default)]
pub(super) struct Tally {
    /// By span of the tree, and which of the windows cuts it.
    pub(super) spans: BTreeMap<(Span, usize), Vec<Primitive>>,
    pub(super) windows: Vec<[f64; 2]>,
    pub(super) errors: Vec<f64>,
    pub(super) primitives: usize,
    pub(super) unseen: usize,
    pub(super) split: usize,
    pub(super) done: usize,
}

impl Tally {
    /// Adds all segments of one Gaussian of a layer that is seen during `window`.
    pub(super) fn add(&mut self, window: [f64; 2], pieces: impl IntoIterator<Item = Piece>) -> Result<()> {
        let place = match self.windows.iter().position(|w| *w == window) {
            Some(place) => place,
            None => {
                self.windows.push(window);
                self.windows.len() - 1
            }
        };
        let (mut count, mut error) = (0, 0.0f64);
        for piece in pieces.into_iter().filter(|p| is_sound(&p.primitive)) {
            (count, error) = (count + 1, error.max(piece.error));
            self.spans.entry((piece.span, place)).or_default().push(piece.primitive);
        }
        self.done += 1;
        match count {
            0 => self.unseen += 1,
            _ => self.errors.push(error),
        }
        self.split += usize::from(count > 1);
        self.primitives += count;
        bounded(self.primitives)
    }
}

/// Whether every number fits into the file's f32.
fn is_sound(p: &Primitive) -> bool {
    let wide = p.mean.iter().chain([&p.center, &p.softness]).all(|x| (*x as f32).is_finite());
    let shape = p.quat.iter().chain(&p.scales).chain(&p.velocity).chain(&p.turn);
    wide && !p.half_width.is_nan() && shape.chain(&p.base_color).chain(&p.sh_rest).all(|x| x.is_finite())
}

pub(super) fn bounded(primitives: usize) -> Result<()> {
    if primitives <= MAX_PRIMITIVES {
        return Ok(());
    }
    Err(Error::new(ErrorKind::Memory, format!("the baked scene would have more than {MAX_PRIMITIVES} primitives"))
        .remedy("Raise --tolerance, or bake a shorter clip or fewer Gaussians."))
}

/// A layer of a playback file: its segments are kept unchanged in their span. Their importance is not in the file.
pub(super) fn page(layer: &Layer<f32>, sampling: &Viewpoints, tally: &mut Tally) -> Result<Option<Node>> {
    let mut all = primitives(layer);
    let before = all.len();
    all.retain(|p| is_sound(p) && p.opacity >= crate::layers::ALPHA_MIN as f32);
    for p in &mut all {
        let mut sizes = p.scales;
        sizes.sort_by(f32::total_cmp);
        let pixels = sampling.pixels(p.mean) as f32;
        let importance = p.opacity * sizes[2] * sizes[1] * pixels * pixels;
        p.importance = if importance.is_finite() { importance } else { 0.0 };
    }
    tally.done += before;
    tally.unseen += before - all.len();
    tally.primitives += all.len();
    tally.errors.resize(tally.errors.len() + all.len(), 0.0);
    bounded(tally.primitives)?;
    let [from, to] = layer.span;
    Ok((!all.is_empty()).then_some(Node { from, to, primitives: all }))
}

/// The remaining part of a node of a layer that is seen during `window` only.
pub(super) fn cut(mut node: Node, [first, last]: [f64; 2]) -> Option<Node> {
    let (from, to) = (node.from.max(first), node.to.min(last));
    if [from, to] != [node.from, node.to] {
        // What has an infinite lifespan counts from the middle, so that nothing is far from where it was rounded.
        let middle = 0.5 * (from + to);
        for p in node.primitives.iter_mut().filter(|p| p.half_width == f64::INFINITY && p.turn == [0.0; 3]) {
            (0..3).for_each(|k| p.mean[k] += f64::from(p.velocity[k]) * (middle - p.center));
            p.center = middle;
        }
        (node.from, node.to) = (from, to);
    }
    (from < to).then_some(node)
}

/// Sorts nodes by their beginning; of those that begin together the longest, which contains the others, is first. Those
/// of one span are merged.
pub(super) fn in_order(mut nodes: Vec<Node>) -> Vec<Node> {
    nodes.sort_by(|a, b| a.from.total_cmp(&b.from).then(b.to.total_cmp(&a.to)));
    let mut out: Vec<Node> = Vec::with_capacity(nodes.len());
    for node in nodes {
        match out.last_mut() {
            Some(last) if last.from == node.from && last.to == node.to => last.primitives.extend(node.primitives),
            _ => out.push(node),
        }
    }
    out
}

/// The highest degree with a coefficient that is not zero.
pub(super) fn sh_degree(nodes: &[Node]) -> usize {
    let mut used = 0;
    for primitive in nodes.iter().flat_map(|n| &n.primitives) {
        // Coefficient k = 1 + i/3 belongs to the degree ⌊√k⌋.
        let last = primitive.sh_rest.iter().rposition(|c| *c != 0.0).map_or(0, |i| 1 + i / 3);
        used = used.max(last.isqrt());
    }
    used
}

pub(super) fn quantiles(mut errors: Vec<f64>, tolerance: Option<f64>) -> Errors {
    errors.sort_by(f64::total_cmp);
    let at = |share: f64| match errors.len() {
        0 => 0.0,
        n => errors[((n as f64 * share) as usize).min(n - 1)],
    };
    let unit = tolerance.filter(|t| t.is_finite()).unwrap_or(TOLERANCE);
    let bins = [0.0, 0.125, 0.25, 0.5, 1.0, 2.0, 8.0].map(|share| share * unit).to_vec();
    let mut counts = vec![0; bins.len() + 1];
    for error in &errors {
        counts[bins.partition_point(|b| b < error)] += 1;
    }
    Errors { median: at(0.5), p90: at(0.9), p99: at(0.99), worst: at(1.0), bins, counts }
}
