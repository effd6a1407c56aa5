//! Fits linear segments to one Gaussian, in the deepest nodes that hold its lifespan; segments that miss are halved.

use super::life::Envelope;
use super::sample::{GEOMETRY, Row, Samples};
use super::sampling::Viewpoints;
use super::shape::{Shape, decompose, difference};
use super::tree::{Span, Tree};
use crate::format::playback::Primitive;
use crate::layers::ALPHA_MIN;
use crate::math::se3::{norm, sub};
use crate::math::sh::{MAX_COEFFS, dc_to_rgb};

/// Error of a full step of opacity (or of colour, 0 to 1), pixels. A Gaussian one pixel wide that is d pixels off
/// changes its neighbourhood by up to 0.6·d, but with both signs, so that most of it cancels; a wrong opacity does
/// not, and is held five times as strictly.
pub(super) const LEVEL_PIXELS: f64 = 8.0;
/// Weight of a time sample at which the Gaussian is invisible: it keeps a line through two frames defined.
const FAINT: f64 = 1e-4;
/// Share of the trace by which a covariance may differ before it counts as turned or stretched: f32 rounding.
const SAME_SHAPE: f64 = 1e-5;
/// The envelope's centre may be this many reaches away from a node before rounded velocities matter; a segment further
/// out gets a centre of its own.
const FAR: f64 = 8.0;
/// SH coefficients of all channels.
pub(super) const COLORS: usize = 3 * MAX_COEFFS;

/// A primitive and where it belongs.
#[derive(Clone, Debug)]
pub(super) struct Piece {
    /// The node.
    pub span: Span,
    /// The primitive rendered there.
    pub primitive: Primitive,
    /// Largest error over its frames, pixels.
    pub error: f64,
}

/// Inputs common to all fits.
#[derive(Clone, Copy)]
pub(super) struct Fitter<'a> {
    pub tree: &'a Tree,
    pub sampling: &'a Viewpoints,
    /// Errors of shape and lifespan that need not be improved, pixels.
    pub tolerance: f64,
    /// Largest error that is not split further, pixels.
    pub accepted: f64,
}

/// One Gaussian and everything that was seen of it.
pub(super) struct Subject<'a> {
    pub samples: &'a Samples,
    pub row: &'a Row,
    pub life: Envelope,
    /// Whether its layer fades in or out.
    pub cross_fades: bool,
    /// Learnt rotation and scales: exact where motion leaves shapes alone.
    pub own: Shape,
    /// Colour, where it is the same at all times.
    pub colors: Option<[f32; COLORS]>,
}

/// One time sample, in f64.
struct FrameSample {
    time: f64,
    mean: [f64; 3],
    cov: [f64; 6],
    alpha: f64,
    frame: usize,
}

impl Fitter<'_> {
    /// The segments of one Gaussian in a span, in time order.
    pub(super) fn pieces(&self, subject: &Subject<'_>, span: Span) -> Vec<Piece> {
        let mut out = Vec::new();
        self.place(subject, span, &mut out);
        out
    }

    /// Descends while one half holds the whole visible time, then fits; if the fit misses, continues in both halves.
    fn place(&self, subject: &Subject<'_>, span: Span, out: &mut Vec<Piece>) {
        match narrow(self.tree, subject.row.seen, span) {
            Place::Nowhere => return,
            Place::In(half) => return self.place(subject, half, out),
            Place::Here => {}
        }
        match (self.fit(subject, span), self.tree.split(span)) {
            (Some((primitive, error)), _) if error <= self.accepted => out.push(Piece { span, primitive, error }),
            // Where nothing could be fitted, a half may still hold a valid frame.
            (_, Some(halves)) => halves.into_iter().for_each(|half| self.place(subject, half, out)),
            (Some((primitive, error)), None) => out.push(Piece { span, primitive, error }),
            (None, None) => {}
        }
    }

    /// The best primitive of a node, and its error in pixels. None: no sample is finite, or the node is split whatever
    /// its shape is.
    fn fit(&self, subject: &Subject<'_>, span: Span) -> Option<(Primitive, f64)> {
        let samples = self.samples(subject, span);
        let single = span[1] - span[0] == 1;
        let first = samples.first().filter(|l| !single || l.frame == span[0])?;
        // The sample at a node's end belongs to the next node. The line goes through it, so that motion is continuous
        // between frames too, but a single frame is exact.
        let held = if single { &samples[..1] } else { &samples[..] };

        let weight = |l: &FrameSample| l.alpha + FAINT;
        let total: f64 = samples.iter().map(weight).sum();
        let time = samples.iter().map(|l| weight(l) * l.time).sum::<f64>() / total;
        let mean: [f64; 3] =
            std::array::from_fn(|k| samples.iter().map(|l| weight(l) * l.mean[k]).sum::<f64>() / total);
        let spread: f64 = samples.iter().map(|l| weight(l) * (l.time - time).powi(2)).sum();
        let velocity: [f64; 3] = std::array::from_fn(|k| {
            let sum: f64 = samples.iter().map(|l| weight(l) * (l.time - time) * (l.mean[k] - mean[k])).sum();
            if spread > 0.0 { sum / spread } else { 0.0 }
        });

        let (life, opacity) = self.life(subject, span, held);
        let pixels = self.sampling.pixels(mean);
        let colors = colors(subject, held);
        let center: [f64; 3] = std::array::from_fn(|k| mean[k] + velocity[k] * (life.center - time));
        let worst = |shape: Option<&Shape>| {
            let mut error = 0.0f64;
            for look in held {
                let delta = look.time - life.center;
                let at: [f64; 3] = std::array::from_fn(|k| center[k] + velocity[k] * delta);
                let level = (opacity * life.sigma(look.time) - look.alpha).abs();
                let strength = look.alpha.max(opacity * life.sigma(look.time));
                let outline = shape.map_or(0.0, |shape| difference(shape.covariance(delta), look.cov));
                let mut off = norm(sub(at, look.mean)).max(outline) * pixels;
                if subject.colors.is_none() {
                    let seen = &subject.samples.at(subject.row, look.frame)[GEOMETRY..];
                    off = off.max(LEVEL_PIXELS * color_difference(&colors, seen));
                }
                // NaN must end as an error, not as a fit.
                let worst = (strength * off).max(LEVEL_PIXELS * level);
                error = if worst.is_finite() { error.max(worst) } else { f64::INFINITY };
            }
            error
        };
        // Shapes take most of the time of a fit.
        if !single && worst(None) > self.accepted {
            return None;
        }
        let shape = self.shape(subject, &samples, held, life.center, pixels);
        let error = worst(Some(&shape));
        let ends = self.shown(subject, span);
        let share = ((ends[1] - ends[0]) / (self.tree.border(span[1]) - self.tree.border(span[0]))).clamp(0.0, 1.0);
        let sound = first.mean.iter().chain(&velocity).chain(&shape.scales).all(|x| x.is_finite());
        let primitive = primitive(center, &life, &shape, opacity, velocity, &colors, share * pixels * pixels);
        sound.then_some((primitive, error))
    }

    /// The target shape of a segment's samples. That of a single frame turns on to the next one's, so that what is seen
    /// between them is whole, where it then misses its own by no more than is allowed, and both by less.
    fn shape(
        &self,
        subject: &Subject<'_>,
        samples: &[FrameSample],
        held: &[FrameSample],
        center: f64,
        pixels: f64,
    ) -> Shape {
        let own = shape(subject, held, center);
        if held.len() == samples.len() {
            return own;
        }
        let turning = shape(subject, samples, center);
        let miss = |shape: &Shape, look: &FrameSample| {
            look.alpha * difference(shape.covariance(look.time - center), look.cov) * pixels
        };
        let worst = |shape: &Shape| samples.iter().map(|l| miss(shape, l)).fold(0.0, f64::max);
        let allowed = held.iter().all(|l| miss(&turning, l) <= self.tolerance);
        if allowed && worst(&turning) < worst(&own) { turning } else { own }
    }

    /// The finite samples at a span's frames, its end included.
    fn samples(&self, subject: &Subject<'_>, span: Span) -> Vec<FrameSample> {
        let [first, last] = subject.row.frames;
        let look = |frame: usize| {
            let v = subject.samples.at(subject.row, frame);
            v.iter().all(|x| x.is_finite()).then(|| FrameSample {
                time: self.tree.time(frame),
                mean: std::array::from_fn(|k| f64::from(v[k])),
                cov: std::array::from_fn(|k| f64::from(v[3 + k])),
                alpha: f64::from(v[9]),
                frame,
            })
        };
        (first.max(span[0])..=last.min(span[1])).filter_map(look).collect()
    }

    /// The seconds of a span in which the Gaussian can be seen.
    fn shown(&self, subject: &Subject<'_>, span: Span) -> [f64; 2] {
        [subject.row.seen[0].max(self.tree.border(span[0])), subject.row.seen[1].min(self.tree.border(span[1]))]
    }

    /// Envelope and opacity: the learnt lifespan, or a constant where the samples differ from it.
    fn life(&self, subject: &Subject<'_>, span: Span, samples: &[FrameSample]) -> (Envelope, f64) {
        let [from, to] = [self.tree.border(span[0]), self.tree.border(span[1])];
        let still = Envelope::forever(0.5 * (from + to));
        let range = samples.iter().fold([1.0f64, 0.0], |r, l| [r[0].min(l.alpha), r[1].max(l.alpha)]);
        let constant = (0.5 * (range[0] + range[1])).clamp(0.0, 1.0);
        let own = subject.life;
        if own.is_forever() {
            return self.or_tail(subject, samples, (still, constant), 0.5 * (range[1] - range[0]));
        }
        let (mut above, mut below) = (0.0, 0.0);
        for look in samples {
            let sigma = own.sigma(look.time);
            above += look.alpha * sigma * (look.alpha + FAINT);
            below += sigma * sigma * (look.alpha + FAINT);
        }
        let opacity = if below > 0.0 { (above / below).clamp(0.0, 1.0) } else { 0.0 };
        let miss = samples.iter().map(|l| (opacity * own.sigma(l.time) - l.alpha).abs()).fold(0.0, f64::max);
        let ends = self.shown(subject, span);
        let reach = (own.half + 3.0 * own.softness).min(to - from);
        let far = ends.iter().map(|t| (t - own.center).abs()).fold(0.0, f64::max) > FAR * reach;
        let flat = 0.5 * (range[1] - range[0]);
        let enough = LEVEL_PIXELS * flat <= self.tolerance;
        let (life, opacity, miss) =
            if (far && enough) || flat < miss { (still, constant, flat) } else { (own, opacity, miss) };
        self.or_tail(subject, samples, (life, opacity), miss)
    }

    /// The found envelope, or one side of an envelope where a cross-fade makes that a better fit.
    fn or_tail(
        &self,
        subject: &Subject<'_>,
        samples: &[FrameSample],
        found: (Envelope, f64),
        miss: f64,
    ) -> (Envelope, f64) {
        if !subject.cross_fades || LEVEL_PIXELS * miss <= self.tolerance {
            return found;
        }
        let of = |&(life, opacity): &(Envelope, f64)| {
            samples.iter().map(|l| (opacity * life.sigma(l.time) - l.alpha).abs()).fold(0.0, f64::max)
        };
        tail(samples).filter(|tail| of(tail) < miss).unwrap_or(found)
    }
}

/// An envelope about the strongest sample that falls as the samples do: σ = exp(−½y²), y = (x − h)/s beyond h, is a
/// line through √(−2 ln(α/α_max)).
fn tail(samples: &[FrameSample]) -> Option<(Envelope, f64)> {
    /// Samples close to full strength or close to zero, carry little information about the slope.
    const TELLING: std::ops::Range<f64> = 0.02..0.98;
    let peak = samples.iter().max_by(|a, b| a.alpha.total_cmp(&b.alpha))?;
    let share = |l: &FrameSample| l.alpha / peak.alpha;
    let weighted: Vec<[f64; 3]> = samples
        .iter()
        .filter(|l| TELLING.contains(&share(l)))
        .map(|l| [(l.time - peak.time).abs(), (-2.0 * share(l).ln()).sqrt(), share(l)])
        .collect();
    let total: f64 = weighted.iter().map(|t| t[2]).sum();
    let mean = |k: usize| weighted.iter().map(|t| t[2] * t[k]).sum::<f64>() / total;
    let (x, y) = (mean(0), mean(1));
    let spread: f64 = weighted.iter().map(|t| t[2] * (t[0] - x).powi(2)).sum();
    // Through the strongest sample, where there is but one other.
    let slope = if spread > 0.0 {
        weighted.iter().map(|t| t[2] * (t[0] - x) * (t[1] - y)).sum::<f64>() / spread
    } else {
        y / x
    };
    let half = (x - y / slope).max(0.0);
    let softness = if half > 0.0 { 1.0 / slope } else { x / y };
    let sound = softness.is_finite() && softness > 0.0 && half.is_finite();
    sound.then_some((Envelope { center: peak.time, half, softness }, peak.alpha))
}

/// The shape: the learnt one where the samples agree with it, else turning at a steady rate.
fn shape(subject: &Subject<'_>, samples: &[FrameSample], center: f64) -> Shape {
    let own = subject.own;
    let same = |cov: [f64; 6], other: [f64; 6]| {
        let trace = (cov[0] + cov[3] + cov[5]).abs();
        cov.iter().zip(other).all(|(a, b)| (a - b).abs() <= SAME_SHAPE * trace)
    };
    let learnt = own.covariance(0.0);
    if samples.iter().all(|l| same(l.cov, learnt)) {
        return own;
    }
    let clearest = samples.iter().max_by(|a, b| a.alpha.total_cmp(&b.alpha)).expect("a fit has samples");
    let start = if same(clearest.cov, learnt) { own } else { decompose(clearest.cov) };
    if samples.iter().all(|l| same(l.cov, clearest.cov)) {
        return start;
    }
    let seen: Vec<_> = samples.iter().map(|l| (l.time - center, l.alpha + FAINT, l.cov)).collect();
    start.fit(&seen)
}

/// SH coefficients: the Gaussian's own, or the weighted mean of what is seen.
fn colors(subject: &Subject<'_>, samples: &[FrameSample]) -> [f32; COLORS] {
    if let Some(own) = subject.colors {
        return own;
    }
    let mut sum = [0.0f64; COLORS];
    let total: f64 = samples.iter().map(|l| l.alpha + FAINT).sum();
    for look in samples {
        let seen = &subject.samples.at(subject.row, look.frame)[GEOMETRY..];
        sum.iter_mut().zip(seen).for_each(|(s, c)| *s += (look.alpha + FAINT) / total * f64::from(*c));
    }
    sum.map(|x| x as f32)
}

/// The largest channel's difference of colour, root mean square over all directions (Parseval: |Y| integrates to 1).
fn color_difference(a: &[f32; COLORS], b: &[f32]) -> f64 {
    let mut square = [0.0f64; 3];
    for (k, (a, b)) in a.iter().zip(b).enumerate() {
        square[k % 3] += f64::from(a - b).powi(2);
    }
    (square.into_iter().fold(0.0, f64::max) / (4.0 * std::f64::consts::PI)).sqrt()
}

/// Assembles a primitive. `area` weighs its importance: pixels² per unit² times the share of the node in which it is
/// alive.
pub(super) fn primitive(
    mean: [f64; 3],
    life: &Envelope,
    shape: &Shape,
    opacity: f64,
    velocity: [f64; 3],
    colors: &[f32; COLORS],
    area: f64,
) -> Primitive {
    let mut sizes = shape.scales;
    sizes.sort_by(f64::total_cmp);
    // How much of the image it covers, how strongly, for how long: the most important come first.
    let importance = (opacity * sizes[2] * sizes[1] * area) as f32;
    Primitive {
        mean,
        center: life.center,
        half_width: life.half,
        softness: life.softness,
        quat: shape.quat.map(|x| x as f32),
        scales: shape.scales.map(|x| x as f32),
        opacity: opacity as f32,
        velocity: velocity.map(|x| x as f32),
        turn: shape.turn.map(|x| x as f32),
        base_color: std::array::from_fn(|k| dc_to_rgb(colors[k])),
        sh_rest: std::array::from_fn(|k| colors[k + 3]),
        importance: if importance.is_finite() { importance } else { 0.0 },
        label: None,
        features: Vec::new(),
    }
}

/// Relation of a node to a Gaussian's visible time.
pub(super) enum Place {
    /// The Gaussian is invisible in the node.
    Nowhere,
    /// All of it is in this half, and the node is longer than a segment.
    In(Span),
    /// The node may hold it.
    Here,
}

pub(super) fn narrow(tree: &Tree, seen: [f64; 2], span: Span) -> Place {
    let [from, to] = [tree.border(span[0]), tree.border(span[1])];
    if !(seen[1] >= from && seen[0] < to) {
        return Place::Nowhere;
    }
    if let Some([left, right]) = tree.split(span).filter(|_| tree.is_coarse(span)) {
        let middle = tree.border(left[1]);
        if seen[1] < middle {
            return Place::In(left);
        }
        if seen[0] >= middle {
            return Place::In(right);
        }
    }
    Place::Here
}

/// The span of a Gaussian with linear motion: the deepest that holds its whole visible time.
pub(super) fn home(tree: &Tree, seen: [f64; 2]) -> Option<Span> {
    let mut span = tree.root();
    loop {
        match narrow(tree, seen, span) {
            Place::Nowhere => return None,
            Place::In(half) => span = half,
            Place::Here => return Some(span),
        }
    }
}

/// The seconds of the clip in which something of this envelope and opacity can be seen.
pub(super) fn seen(tree: &Tree, [from, to]: [f64; 2]) -> Option<[f64; 2]> {
    let clip = tree.clip();
    let seen = [from.max(clip[0]), to.min(clip[1])];
    // NaN compares as never: such rows are not rendered by the renderer either.
    (from <= to && seen[0] <= seen[1]).then_some(seen)
}

/// A Gaussian fainter than this is never rendered.
pub(super) fn is_visible(opacity: f64) -> bool {
    opacity >= ALPHA_MIN
}
