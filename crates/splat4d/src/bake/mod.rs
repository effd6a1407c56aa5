//! Bakes a scene for playback: whatever moves it, it becomes kinematic primitives in a tree of time spans.
//!
//! Every Gaussian goes to the deepest node that holds all the time in which it can be seen. There a straight line, a
//! steady turn, one shape, one colour and its own life are fitted to what the model shows frame by frame; where that
//! misses by more than the tolerance, both halves of the node are tried in its stead, down to single frames, which are
//! what the model is then and go straight on to the next frame (key states). A take of few frames a second is looked at
//! between them too. Motion that is straight already is copied and not fitted.
//!
//! Errors are pixels as the cameras see them, weighted by how visible the Gaussian is: distance and outline on the
//! screen, and opacity and colour converted to pixels. The model is looked at in runs of rows, each at all its frames,
//! so that memory does not grow with frames times Gaussians.

mod compare;
mod fit;
mod life;
mod lookout;
mod repeat;
mod sample;
mod shape;
mod straight;
#[cfg(test)]
mod tests;
mod tree;

use crate::format::playback::{Node, Primitive, features_of, is_page, labels_of, primitives};
pub use compare::{Likeness, Moment, Shown, compare};

use crate::layers::{Layer, Scene};
use crate::scene::{Camera, GEOMETRY};
use crate::{Error, ErrorKind, Result};
use fit::{Fitter, Piece, Subject, seen};
use life::Lives;
use lookout::Lookout;
use rayon::prelude::*;
use repeat::Rounds;
use std::collections::BTreeMap;
use straight::{Line, learnt};
use tree::{Span, Tree};

/// Default of [`Options::tolerance`], pixels: on models that no straight line holds, baked and model then differ by
/// less than 40 dB can tell (measured; see the tests), at a fraction of the pieces that a tenth of it would need.
pub const TOLERANCE: f64 = 0.25;
/// Default of [`Options::segment`], seconds: what a player fetches for a seek; shorter ones repeat too much.
pub const SEGMENT: f64 = 1.0;
/// Default of [`Options::looks`]: what players show. A network between the frames of a slow take is no line.
pub const LOOKS: f64 = 30.0;
/// Most rounds of [`Options::repeat`].
pub const MAX_REPEAT: usize = 10_000;
/// Most primitives of a scene: about 3 GB of memory while baking, 300 MB of file.
const MAX_PRIMITIVES: usize = 10_000_000;
/// Rows of a straight layer between two calls of the progress listener.
const STRAIGHT_RUN: usize = 1 << 16;

/// Options of baking.
#[derive(Clone, Debug)]
pub struct Options {
    /// Largest error that is not split further, pixels.
    pub tolerance: f64,
    /// About how long a segment lasts, seconds.
    pub segment: f64,
    /// Looks at the model a second, at least; each of the take's frames is one in any case.
    pub looks: f64,
    /// The take is played so many times over.
    pub repeat: usize,
    /// The cameras whose pixels count. None: a 1080p picture that the scene fills.
    pub cameras: Vec<Camera>,
}

impl Default for Options {
    fn default() -> Self {
        Self { tolerance: TOLERANCE, segment: SEGMENT, looks: LOOKS, repeat: 1, cameras: Vec::new() }
    }
}

/// A baked scene.
#[derive(Clone, Debug)]
pub struct Baked {
    /// Primitives by the span in which they are drawn; spans rise, longer ones first.
    pub nodes: Vec<Node>,
    /// First and last second, all rounds.
    pub clip: [f64; 2],
    /// Highest degree of spherical harmonics that is not zero.
    pub sh_degree: usize,
    /// Statistics of the baking.
    pub report: Report,
}

/// Statistics of a baking.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct Report {
    /// Gaussians of the model.
    pub gaussians: usize,
    /// Those that nobody would see in the clip, or that hold no numbers.
    pub unseen: usize,
    /// Those that became more than one primitive.
    pub split: usize,
    /// Primitives in all nodes.
    pub primitives: usize,
    /// Primitives that last one frame: key states.
    pub key_states: usize,
    /// Nodes with primitives.
    pub nodes: usize,
    /// Largest error allowed, pixels.
    pub tolerance: f64,
    /// Errors of Gaussians (of each its worst primitive, pixels).
    pub errors: Errors,
}

/// Quantiles and a histogram of errors a Gaussian, pixels.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct Errors {
    /// Half of the Gaussians are better.
    pub median: f64,
    /// Nine tenths are better.
    pub p90: f64,
    /// 99 of 100 are better.
    pub p99: f64,
    /// The worst; above the tolerance only where single frames miss too.
    pub worst: f64,
    /// Upper ends of the histogram's bins, pixels; the last bin has none.
    pub bins: Vec<f64>,
    /// Gaussians in each bin, one more than `bins`.
    pub counts: Vec<usize>,
}

/// Bakes a scene. `progress` hears how many Gaussians of how many are done.
///
/// Errors: a scene with a pixel head; options out of range; a clip that is no clip; a model that would become too many
/// primitives.
pub fn bake(scene: &Scene<f32>, options: &Options, progress: &mut dyn FnMut(usize, usize)) -> Result<Baked> {
    scene.without_head("a playback file")?;
    // An endless tolerance is allowed: nothing is split then.
    if options.tolerance.is_nan() || options.tolerance <= 0.0 {
        return Err(Error::input(format!("a tolerance of {} pixels", options.tolerance)).remedy("Give pixels above 0."));
    }
    if !(1..=MAX_REPEAT).contains(&options.repeat) {
        return Err(Error::input(format!("{} rounds", options.repeat)).remedy(format!("Give 1 to {MAX_REPEAT}.")));
    }
    let tree = Tree::new(scene.clip, scene.fps, options.looks, options.segment)?;
    let lookout = Lookout::new(&options.cameras, &means(scene));
    let fitter = Fitter { tree: &tree, lookout: &lookout, tolerance: options.tolerance };
    let total = scene.len();
    let mut tally = Tally::default();
    progress(0, total);
    let mut pages = Vec::new();
    for layer in scene.layers.iter().map(Layer::with_frame_absorbed) {
        if options.repeat == 1 && is_page(&layer) {
            pages.extend(page(&layer, &lookout, &mut tally)?);
            progress(tally.done, total);
            continue;
        }
        match Line::of(&layer) {
            Some(line) => copy(&layer, &line, &fitter, &mut tally, &mut |n| progress(n, total))?,
            None => follow(&layer, &fitter, &mut tally, &mut |n| progress(n, total))?,
        }
    }
    let key_states =
        tally.spans.iter().filter(|((s, _), _)| s[1] - s[0] == 1 && tree.frames() > 1).map(|s| s.1.len()).sum();
    let errors = quantiles(std::mem::take(&mut tally.errors), options.tolerance);
    let spans = std::mem::take(&mut tally.spans);
    let cut = |((span, window), primitives): ((Span, usize), Vec<Primitive>)| {
        cut(Node { from: tree.border(span[0]), to: tree.border(span[1]), primitives }, tally.windows[window])
    };
    let mut nodes = in_order(spans.into_iter().filter_map(cut).chain(pages).collect());
    let mut clip = scene.clip;
    if options.repeat > 1 {
        let one: usize = nodes.iter().map(|n| n.primitives.len()).sum();
        bounded(one.saturating_mul(options.repeat))?;
        let length = tree.border(tree.frames()) - clip[0];
        let rounds = Rounds { first: clip[0], length, count: options.repeat };
        nodes = rounds.spread(nodes, &lookout, options.tolerance);
        clip[1] += length * (options.repeat - 1) as f64;
    }
    let report = Report {
        gaussians: total,
        unseen: tally.unseen,
        split: tally.split,
        primitives: nodes.iter().map(|n| n.primitives.len()).sum(),
        key_states,
        nodes: nodes.len(),
        tolerance: options.tolerance,
        errors,
    };
    Ok(Baked { sh_degree: sh_degree(&nodes), nodes, clip, report })
}

/// Primitives and statistics of the layers so far.
#[derive(Default)]
struct Tally {
    /// By span of the tree, and which of the windows cuts it.
    spans: BTreeMap<(Span, usize), Vec<Primitive>>,
    windows: Vec<[f64; 2]>,
    errors: Vec<f64>,
    primitives: usize,
    unseen: usize,
    split: usize,
    done: usize,
}

impl Tally {
    /// Adds all pieces of one Gaussian of a layer that is seen during `window`.
    fn add(&mut self, window: [f64; 2], pieces: impl IntoIterator<Item = Piece>) -> Result<()> {
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

fn bounded(primitives: usize) -> Result<()> {
    if primitives <= MAX_PRIMITIVES {
        return Ok(());
    }
    Err(Error::new(ErrorKind::Memory, format!("the baked scene would have more than {MAX_PRIMITIVES} primitives"))
        .remedy("Raise --tolerance, or bake a shorter clip or fewer Gaussians."))
}

/// A layer of a playback file: pieces already, which stay as they are in their span. Their importance is not in the file.
fn page(layer: &Layer<f32>, lookout: &Lookout, tally: &mut Tally) -> Result<Option<Node>> {
    let mut all = primitives(layer);
    let before = all.len();
    all.retain(|p| is_sound(p) && p.opacity >= crate::layers::ALPHA_MIN as f32);
    for p in &mut all {
        let mut sizes = p.scales;
        sizes.sort_by(f32::total_cmp);
        let pixels = lookout.pixels(p.mean) as f32;
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

/// What is left of a node of a layer that is seen during `window` only.
fn cut(mut node: Node, [first, last]: [f64; 2]) -> Option<Node> {
    let (from, to) = (node.from.max(first), node.to.min(last));
    if [from, to] != [node.from, node.to] {
        // What lives for ever counts from the middle, so that nothing is far from where it was rounded.
        let middle = 0.5 * (from + to);
        for p in node.primitives.iter_mut().filter(|p| p.half_width == f64::INFINITY && p.turn == [0.0; 3]) {
            (0..3).for_each(|k| p.mean[k] += f64::from(p.velocity[k]) * (middle - p.center));
            p.center = middle;
        }
        (node.from, node.to) = (from, to);
    }
    (from < to).then_some(node)
}

/// Nodes by their beginning; of those that begin together the longest, which holds the others, comes first. Those of one
/// span are one.
fn in_order(mut nodes: Vec<Node>) -> Vec<Node> {
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

/// A straight layer.
fn copy(
    layer: &Layer<f32>,
    line: &Line,
    fitter: &Fitter<'_>,
    tally: &mut Tally,
    progress: &mut dyn FnMut(usize),
) -> Result<()> {
    let (lives, spans) = (Lives::new(layer), layer.spans());
    let (labels, features) = (labels_of(&layer.params), features_of(&layer.params));
    for first in (0..spans.len()).step_by(STRAIGHT_RUN) {
        let ids = first..spans.len().min(first + STRAIGHT_RUN);
        let piece = |id: usize| {
            let mut piece = line.piece(layer, &lives, id, spans[id], fitter.tree, fitter.lookout)?;
            (piece.primitive.label, piece.primitive.features) = (labels[id], features[id].clone());
            Some(piece)
        };
        let all: Vec<Option<Piece>> = ids.into_par_iter().map(piece).collect();
        for piece in all {
            tally.add(layer.span, piece)?;
        }
        progress(tally.done);
    }
    Ok(())
}

/// Any other layer.
fn follow(layer: &Layer<f32>, fitter: &Fitter<'_>, tally: &mut Tally, progress: &mut dyn FnMut(usize)) -> Result<()> {
    let lives = Lives::new(layer);
    let spans = layer.spans();
    let (labels, features) = (labels_of(&layer.params), features_of(&layer.params));
    let shown = |(id, span): (usize, &[f64; 2])| seen(fitter.tree, *span).map(|s| (id, s));
    let rows: Vec<(usize, [f64; 2])> = spans.iter().enumerate().filter_map(shown).collect();
    (tally.done, tally.unseen) = (tally.done + spans.len() - rows.len(), tally.unseen + spans.len() - rows.len());
    if rows.is_empty() {
        return Ok(());
    }
    let colors = sample::color_width(layer, fitter.tree.clip()[0]);
    let frame = sample::Framed::of(layer);
    let mut rest = rows.as_slice();
    while !rest.is_empty() {
        let (run, later) = rest.split_at(sample::run_length(rest, fitter.tree, colors));
        rest = later;
        let samples = sample::look(layer, &frame, run, fitter.tree, colors);
        let pieces = |row: &sample::Row| {
            let subject = Subject {
                samples: &samples,
                row,
                life: lives.envelope(row.id),
                cross_fades: layer.cross_fades(),
                own: frame.shape(&learnt(&layer.params[GEOMETRY].read::<11>(row.id, 0))),
                colors: (colors == 0).then(|| frame.colors(sample::own_colors(layer, row.id))),
            };
            // Colours that are no numbers would show as black; what cannot be drawn is left out.
            let sound = subject.colors.is_none_or(|c| c.iter().all(|x| x.is_finite()));
            let mut pieces = if sound { fitter.pieces(&subject) } else { Vec::new() };
            for p in &mut pieces {
                (p.primitive.label, p.primitive.features) = (labels[row.id], features[row.id].clone());
            }
            pieces
        };
        let all: Vec<Vec<Piece>> = samples.rows.par_iter().map(pieces).collect();
        for pieces in all {
            tally.add(layer.span, pieces)?;
        }
        progress(tally.done);
    }
    Ok(())
}

/// All finite means.
fn means(scene: &Scene<f32>) -> Vec<[f64; 3]> {
    scene.layers.iter().flat_map(Layer::means).filter(|m| m.iter().all(|x| x.is_finite())).collect()
}

/// The highest degree with a coefficient that is not zero.
fn sh_degree(nodes: &[Node]) -> usize {
    let mut used = 0;
    for primitive in nodes.iter().flat_map(|n| &n.primitives) {
        // Coefficient k = 1 + i/3 belongs to the degree ⌊√k⌋.
        let last = primitive.sh_rest.iter().rposition(|c| *c != 0.0).map_or(0, |i| 1 + i / 3);
        used = used.max(last.isqrt());
    }
    used
}

fn quantiles(mut errors: Vec<f64>, tolerance: f64) -> Errors {
    errors.sort_by(f64::total_cmp);
    let at = |share: f64| match errors.len() {
        0 => 0.0,
        n => errors[((n as f64 * share) as usize).min(n - 1)],
    };
    let unit = if tolerance.is_finite() { tolerance } else { TOLERANCE };
    let bins = [0.0, 0.125, 0.25, 0.5, 1.0, 2.0, 8.0].map(|share| share * unit).to_vec();
    let mut counts = vec![0; bins.len() + 1];
    for error in &errors {
        counts[bins.partition_point(|b| b < error)] += 1;
    }
    Errors { median: at(0.5), p90: at(0.9), p99: at(0.99), worst: at(1.0), bins, counts }
}
