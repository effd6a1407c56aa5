//! [`Bakery`]: a scene that is sampled once and cut into segments as often as is needed.

use super::fit::{Fitter, Piece, Subject, seen};
use super::life::Lives;
use super::rank::{peel, rank};
use super::rate::{PRICES, Rate, Sums, price};
use super::repeat::Rounds;
use super::sample::{self, Framed, Row, Samples};
use super::sampling::Viewpoints;
use super::straight::{Line, learnt};
use super::tally::{Tally, bounded, cut, in_order, page, quantiles, sh_degree};
use super::tree::{Span, Tree};
use super::weights::Weights;
use super::{Baked, MAX_REPEAT, Options, Report, TOLERANCE};
use crate::format::playback::{Node, Primitive, features_of, is_page, labels_of};
use crate::layers::{Layer, Scene};
use crate::scene::GEOMETRY;
use crate::{Error, Result};
use rayon::prelude::*;
use std::borrow::Cow;

/// Rows of a straight layer between two calls of the progress listener.
const STRAIGHT_RUN: usize = 1 << 16;
/// Samples of a scene are kept up to this many numbers (512 MiB), and sampled again for every cut beyond that.
const KEPT: usize = 128 << 20;
/// Rows of a task that measures.
const ROWS: usize = 128;
/// The time between samples is not halved beyond this many of them: 30,000 Gaussians at 266 times.
const REFINED: usize = 8_000_000;
/// Gaussians of a layer whose motion between time samples is examined.
const PROBED: usize = 400;
/// Mean squared error of images by motion between time samples that is let pass: 46 dB, a quarter of what 40 dB allow.
const BETWEEN: f64 = 2.5e-5;

/// Criterion for splits of nonlinear motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Cut {
    /// If a segment misses by more than this many pixels.
    Tolerance(f64),
    /// If it lowers the mean squared error of images by more than this price of a segment ([`Curve`]).
    Price(f64),
}

/// How many segments which error costs: by a price, the cut with the least error + price · segments.
#[derive(Clone, Debug)]
pub struct Curve {
    /// Primitives of layers that are straight already.
    straight: usize,
    rate: Rate,
}

impl Curve {
    /// Primitives at the least: one for each Gaussian.
    #[cfg(test)]
    pub(crate) fn least(&self) -> f64 {
        self.straight as f64 + self.rate.pieces[PRICES - 1]
    }

    /// Primitives and mean squared error of images (of channels from 0 to 1, the Gaussians' errors taken as
    /// independent).
    pub fn at(&self, of: f64) -> [f64; 2] {
        let place = (of / price(0)).ln() / (price(1) / price(0)).ln();
        let place = place.clamp(0.0, (PRICES - 1) as f64);
        let (g, share) = (place as usize, place.fract());
        let between = |values: &[f64; PRICES]| {
            let [a, b] = [values[g], values[(g + 1).min(PRICES - 1)]];
            if a > 0.0 && b > 0.0 { a * (b / a).powf(share) } else { a + (b - a) * share }
        };
        [self.straight as f64 + between(&self.rate.pieces), between(&self.rate.error)]
    }

    /// The lowest price with at most this many primitives; the highest there is, where there are more at any.
    pub fn price_of(&self, primitives: f64) -> f64 {
        self.first(|[pieces, _]| pieces <= primitives).unwrap_or(price(PRICES - 1))
    }

    /// The highest price with at most this error. None: the lowest has more.
    pub fn price_for(&self, error: f64) -> Option<f64> {
        if self.at(price(0))[1] > error {
            return None;
        }
        Some(self.first(|[_, e]| e > error).unwrap_or(price(PRICES - 1)))
    }

    /// The lowest price at which `holds`, which holds at all that are higher.
    fn first(&self, holds: impl Fn([f64; 2]) -> bool) -> Option<f64> {
        let (mut low, mut high) = (price(0), price(PRICES - 1));
        if holds(self.at(low)) {
            return Some(low);
        }
        if !holds(self.at(high)) {
            return None;
        }
        // Forty halvings of the logarithm: beyond what the interpolation can resolve.
        for _ in 0..40 {
            let middle = (low * high).sqrt();
            if holds(self.at(middle)) { high = middle } else { low = middle }
        }
        Some(high)
    }
}

/// A scene that is being cut into segments.
pub struct Bakery<'a> {
    scene: &'a Scene<f32>,
    options: &'a Options,
    tree: Tree,
    sampling: Viewpoints,
    weights: Option<Weights>,
    /// By layer and run, where they are kept.
    kept: Vec<Vec<Samples>>,
}

/// A layer whose motion is not straight.
struct Curved<'a> {
    layer: &'a Layer<f32>,
    lives: Lives<'a>,
    frame: Framed,
    /// Gaussians that are seen in the clip, and when.
    rows: Vec<(usize, [f64; 2])>,
    /// Numbers of a colour that changes; 0: it does not.
    colors: usize,
}

impl<'a> Curved<'a> {
    fn new(layer: &'a Layer<f32>, tree: &Tree) -> Self {
        let shown = |(id, span): (usize, &[f64; 2])| seen(tree, *span).map(|s| (id, s));
        let rows: Vec<_> = layer.spans().iter().enumerate().filter_map(shown).collect();
        let colors = if rows.is_empty() { 0 } else { sample::color_width(layer, tree.clip()[0]) };
        Self { layer, lives: Lives::new(layer), frame: Framed::of(layer), rows, colors }
    }

    fn sample(&self, rows: &[(usize, [f64; 2])], tree: &Tree) -> Samples {
        sample::sample_rows(self.layer, &self.frame, rows, tree, self.colors)
    }

    /// Calls `each` with one run of samples after the other: those that were kept, or new ones.
    fn runs(&self, tree: &Tree, kept: &[Samples], each: &mut dyn FnMut(Cow<'_, Samples>) -> Result<()>) -> Result<()> {
        if !kept.is_empty() {
            return kept.iter().try_for_each(|samples| each(Cow::Borrowed(samples)));
        }
        let mut rest = self.rows.as_slice();
        while !rest.is_empty() {
            let (run, later) = rest.split_at(sample::run_length(rest, tree, self.colors));
            rest = later;
            each(Cow::Owned(self.sample(run, tree)))?;
        }
        Ok(())
    }
}

impl<'a> Bakery<'a> {
    /// A scene before sampling. Errors: a scene with a pixel head; options out of range; an invalid clip.
    pub fn new(scene: &'a Scene<f32>, options: &'a Options) -> Result<Self> {
        scene.without_head("a playback file")?;
        // An endless tolerance is allowed: nothing is split then.
        if options.tolerance.is_nan() || options.tolerance <= 0.0 {
            return Err(
                Error::input(format!("a tolerance of {} pixels", options.tolerance)).remedy("Give pixels above 0.")
            );
        }
        if !(1..=MAX_REPEAT).contains(&options.repeat) {
            return Err(Error::input(format!("{} rounds", options.repeat)).remedy(format!("Give 1 to {MAX_REPEAT}.")));
        }
        let tree = Tree::new(scene.clip, scene.fps, options.sample_rate, options.segment, usize::MAX)?;
        let cameras: Vec<_> =
            options.cameras.iter().chain(options.path.iter().map(|(_, camera)| camera)).cloned().collect();
        let sampling = Viewpoints::new(&cameras, &means(scene));
        let mut bakery = Self { scene, options, tree, sampling, weights: None, kept: Vec::new() };
        bakery.tree = bakery.tree_of(options.sample_rate)?;
        Ok(bakery)
    }

    /// Whether some motion is not straight, so that there is something to split.
    pub(crate) fn is_curved(&self) -> bool {
        self.layers().iter().any(|l| self.is_split(l) && !Curved::new(l, &self.tree).rows.is_empty())
    }

    /// Samples the model and measures the curve of segments and errors. None: all motion is straight, and there is
    /// nothing to choose. `progress` is called with all finished work.
    pub fn measure(&mut self, progress: &mut dyn FnMut(usize, usize)) -> Result<Option<Curve>> {
        let layers = self.layers();
        let count = |l: &Cow<'_, Layer<f32>>| if self.is_split(l) { l.params.len() } else { 0 };
        let total: usize = layers.iter().map(count).sum();
        let mut curve = Curve { straight: self.scene.len() - total, rate: Rate::default() };
        if !self.is_curved() {
            return Ok(None);
        }
        let Options { cameras, path, .. } = self.options;
        let renders = self.options.renders;
        self.weights = Some(Weights::measure(self.scene, cameras, path, renders, &mut |_, _| progress(0, total)));
        self.refine(&layers)?;
        let numbers = |l: &Cow<'_, Layer<f32>>| {
            let curved = Curved::new(l, &self.tree);
            let frames = |(_, seen): &(usize, [f64; 2])| self.tree.around(*seen).map(|k| k as f64);
            let all: f64 = curved.rows.iter().map(frames).map(|[first, last]| last - first + 1.0).sum();
            all * (sample::GEOMETRY + curved.colors) as f64
        };
        let keeps = layers.iter().filter(|l| self.is_split(l)).map(numbers).sum::<f64>() <= KEPT as f64;
        let (mut kept, mut done) = (vec![Vec::new(); layers.len()], 0);
        for (index, layer) in layers.iter().enumerate().filter(|(_, l)| self.is_split(l)) {
            let curved = Curved::new(layer, &self.tree);
            curved.runs(&self.tree, &[], &mut |samples| {
                let rates: Vec<Rate> = samples
                    .rows
                    .par_chunks(ROWS)
                    .map(|rows| {
                        let mut sum = Rate::default();
                        for sums in rows.iter().filter_map(|row| self.sums(&self.tree, &curved, index, &samples, row)) {
                            sum.add(&sums.rate(self.tree.root()));
                        }
                        sum
                    })
                    .collect();
                rates.iter().for_each(|rate| curve.rate.add(rate));
                done += samples.rows.len();
                if keeps {
                    kept[index].push(samples.into_owned());
                }
                progress(done, total);
                Ok(())
            })?;
        }
        self.kept = kept;
        Ok(Some(curve))
    }

    /// Cuts the scene into segments. A price needs what [`measure`](Self::measure) found. `progress` is called with the
    /// finished number of Gaussians and their total.
    ///
    /// Errors: a model that would become too many primitives. Panics: a price before anything was measured.
    pub fn bake(&self, by: Cut, progress: &mut dyn FnMut(usize, usize)) -> Result<Baked> {
        let total = self.scene.len();
        let tolerance = match by {
            Cut::Tolerance(tolerance) => Some(tolerance),
            Cut::Price(_) => None,
        };
        let fitter = Fitter {
            tree: &self.tree,
            sampling: &self.sampling,
            tolerance: tolerance.unwrap_or(TOLERANCE),
            accepted: tolerance.unwrap_or(f64::INFINITY),
        };
        let mut tally = Tally::default();
        progress(0, total);
        let mut pages = Vec::new();
        for (index, layer) in self.layers().iter().enumerate() {
            if self.is_kept(layer) {
                pages.extend(page(layer, &self.sampling, &mut tally)?);
                progress(tally.done, total);
                continue;
            }
            match Line::of(layer) {
                Some(line) => copy(layer, &line, &fitter, &mut tally, &mut |n| progress(n, total))?,
                None => self.follow((index, layer), &fitter, by, &mut tally, &mut |n| progress(n, total))?,
            }
        }
        self.finish(tally, pages, tolerance)
    }

    /// The nodes of what was found, in order, all rounds.
    fn finish(&self, mut tally: Tally, pages: Vec<Node>, tolerance: Option<f64>) -> Result<Baked> {
        let (tree, options) = (&self.tree, self.options);
        let single = |span: &Span| span[1] - span[0] == 1 && tree.frames() > 1;
        let key_states = tally.spans.iter().filter(|((span, _), _)| single(span)).map(|s| s.1.len()).sum();
        let errors = quantiles(std::mem::take(&mut tally.errors), tolerance);
        let spans = std::mem::take(&mut tally.spans);
        let node = |((span, window), primitives): ((Span, usize), Vec<Primitive>)| {
            cut(Node { from: tree.border(span[0]), to: tree.border(span[1]), primitives }, tally.windows[window])
        };
        let mut nodes = in_order(spans.into_iter().filter_map(node).chain(pages).collect());
        match (options.rank, options.peel) {
            (true, true) => peel(&mut nodes, self.scene, options),
            (true, false) => rank(&mut nodes, self.scene, options),
            (false, _) => {}
        }
        let mut clip = self.scene.clip;
        if options.repeat > 1 {
            let one: usize = nodes.iter().map(|n| n.primitives.len()).sum();
            bounded(one.saturating_mul(options.repeat))?;
            let length = tree.border(tree.frames()) - clip[0];
            let rounds = Rounds { first: clip[0], length, count: options.repeat };
            nodes = rounds.spread(nodes, &self.sampling, options.tolerance);
            clip[1] += length * (options.repeat - 1) as f64;
        }
        let report = Report {
            gaussians: self.scene.len(),
            unseen: tally.unseen,
            split: tally.split,
            primitives: nodes.iter().map(|n| n.primitives.len()).sum(),
            key_states,
            nodes: nodes.len(),
            tolerance,
            errors,
        };
        Ok(Baked { sh_degree: sh_degree(&nodes), nodes, clip, report })
    }

    fn layers(&self) -> Vec<Cow<'a, Layer<f32>>> {
        self.scene.layers.iter().map(Layer::with_frame_absorbed).collect()
    }

    /// Whether the layer's pages are kept unchanged.
    fn is_kept(&self, layer: &Layer<f32>) -> bool {
        self.options.repeat == 1 && is_page(layer)
    }

    /// Whether the layer is fitted and not copied.
    fn is_split(&self, layer: &Layer<f32>) -> bool {
        !self.is_kept(layer) && Line::of(layer).is_none()
    }

    /// The tree with this many samples a second, as far as their number is allowed.
    fn tree_of(&self, rate: f64) -> Result<Tree> {
        let rows: usize = self.scene.layers.iter().filter(|l| self.is_split(l)).map(|l| l.params.len()).sum();
        let most = self.options.samples.checked_div(rows).unwrap_or(usize::MAX);
        let Scene { clip, fps, .. } = *self.scene;
        Tree::new(clip, fps, rate, self.options.segment, most)
    }

    /// Halves the time between samples while the motion between them would show.
    fn refine(&mut self, layers: &[Cow<'_, Layer<f32>>]) -> Result<()> {
        loop {
            let finer = self.tree_of(2.0 * self.tree.rate())?;
            // Every second sample of the finer tree is one of this tree's: a segment over two of its steps misses the
            // middle.
            let gaussians: usize = layers.iter().filter(|l| self.is_split(l)).map(|l| l.params.len()).sum();
            if finer.frames() < 2 * self.tree.frames() - 1 || gaussians * finer.frames() > REFINED {
                return Ok(());
            }
            let mut error = 0.0;
            for (index, layer) in layers.iter().enumerate().filter(|(_, l)| self.is_split(l)) {
                let curved = Curved::new(layer, &finer);
                let stride = curved.rows.len().div_ceil(PROBED).max(1);
                let rows: Vec<_> = curved.rows.iter().copied().step_by(stride).collect();
                let samples = curved.sample(&rows, &finer);
                let of = |row: &Row| {
                    let sums = self.sums(&finer, &curved, index, &samples, row)?;
                    Some((0..finer.frames()).step_by(2).map(|k| sums.error([k, k + 2])).sum::<f64>())
                };
                let errors: Vec<Option<f64>> = samples.rows.par_iter().map(of).collect();
                error += errors.iter().flatten().sum::<f64>() * stride as f64 / finer.frames() as f64;
            }
            if error <= BETWEEN {
                return Ok(());
            }
            self.tree = finer;
        }
    }

    /// Running sums of one row. None: none of its samples is finite.
    fn sums<'s>(
        &self,
        tree: &'s Tree,
        curved: &Curved<'_>,
        layer: usize,
        samples: &'s Samples,
        row: &'s Row,
    ) -> Option<Sums<'s>> {
        let weights = self.weights.as_ref().expect("weights are measured before anything else");
        Sums::new(tree, samples, row, curved.lives.envelope(row.id), |look| {
            weights.of(layer, row.id, look, &self.sampling)
        })
    }

    /// A layer whose motion is not straight.
    fn follow(
        &self,
        (index, layer): (usize, &Layer<f32>),
        fitter: &Fitter<'_>,
        by: Cut,
        tally: &mut Tally,
        progress: &mut dyn FnMut(usize),
    ) -> Result<()> {
        let curved = Curved::new(layer, &self.tree);
        let (labels, features) = (labels_of(&layer.params), features_of(&layer.params));
        let never = layer.params.len() - curved.rows.len();
        (tally.done, tally.unseen) = (tally.done + never, tally.unseen + never);
        let kept = self.kept.get(index).map_or(&[][..], Vec::as_slice);
        curved.runs(&self.tree, kept, &mut |samples| {
            let pieces = |row: &Row| {
                let subject = Subject {
                    samples: &samples,
                    row,
                    life: curved.lives.envelope(row.id),
                    cross_fades: layer.cross_fades(),
                    own: curved.frame.shape(&learnt(&layer.params[GEOMETRY].read::<11>(row.id, 0))),
                    colors: (curved.colors == 0).then(|| curved.frame.colors(sample::own_colors(layer, row.id))),
                };
                // Colours that are not finite would show as black; what cannot be rendered is left out.
                if !subject.colors.is_none_or(|c| c.iter().all(|x| x.is_finite())) {
                    return Vec::new();
                }
                let mut spans = vec![self.tree.root()];
                if let Cut::Price(price) = by {
                    spans.clear();
                    if let Some(sums) = self.sums(&self.tree, &curved, index, &samples, row) {
                        sums.cut(self.tree.root(), price, &mut spans);
                    }
                }
                let mut pieces: Vec<Piece> = spans.iter().flat_map(|&span| fitter.pieces(&subject, span)).collect();
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
            Ok(())
        })
    }
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
            let mut piece = line.piece(layer, &lives, id, spans[id], fitter.tree, fitter.sampling)?;
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

/// All finite means.
fn means(scene: &Scene<f32>) -> Vec<[f64; 3]> {
    scene.layers.iter().flat_map(Layer::means).filter(|m| m.iter().all(|x| x.is_finite())).collect()
}
