//! Rate and distortion: how many segments a Gaussian needs for how small an error of the images.
//!
//! Every node of the tree of time spans has the error that one segment leaves there: closed forms of running sums, so
//! that a node costs the same for any number of samples. For a price λ of a segment the best cut of the tree is known
//! from its leaves upwards (a node is cut where its halves and their price cost less). Cuts at all prices of a ladder
//! at once give the curve of the whole scene, on which a budget of segments or a requested error is a price. (Optimal
//! tree pruning: Chou, Lookabaugh, Gray 1989.)

use super::fit::{Place, narrow};
use super::life::Envelope;
use super::sample::{GEOMETRY, Row, Samples};
use super::tree::{Span, Tree};
use super::weights::Weight;
use crate::math::sym3;

/// Prices of the ladder.
pub(super) const PRICES: usize = 32;
/// The lowest price, mean squared error of an image over the clip, and the factor from price to price: from what is not
/// could see of a million segments to more than one Gaussian can weigh.
const LOWEST: f64 = 1e-14;
const FACTOR: f64 = 2.5;
/// Share of a Gaussian's energy by which a relative change of its covariance by 1 (Frobenius) changes images: (tr² +
/// 2‖·‖²)/16 of a bell, between the values of a change along the axes and of a shear.
const SHAPE: f64 = 0.125;
/// Axes whose relative difference of squares is below this cannot be distinguished: a shear between them is not a turn.
const ROUND: f64 = 0.05;
/// A thin axis counts at least as this share of the longest.
const THIN: f64 = 0.05;
/// Weight of a sample at which the Gaussian is invisible.
const FAINT: f64 = 1e-6;

/// Numbers of a sample before its colours, whose running sums are kept.
const NUMBERS: usize = 29;
/// Their positions.
mod at {
    pub(super) const W: usize = 0;
    pub(super) const WT: usize = 1;
    pub(super) const WTT: usize = 2;
    pub(super) const MEAN: usize = 3;
    pub(super) const MEAN_T: usize = 6;
    pub(super) const MEAN_SQUARE: usize = 9;
    pub(super) const COV: usize = 10;
    pub(super) const COV_T: usize = 16;
    pub(super) const COV_SQUARE: usize = 22;
    pub(super) const COUNT: usize = 23;
    pub(super) const ALPHA: usize = 24;
    pub(super) const ALPHA_SQUARE: usize = 25;
    pub(super) const ALPHA_SIGMA: usize = 26;
    pub(super) const SIGMA_SQUARE: usize = 27;
    pub(super) const COLOR_SQUARE: usize = 28;
}
/// Entries of a packed matrix that occur twice in the full matrix.
const OFF_DIAGONAL: [usize; 3] = [1, 2, 4];

/// Segments and error at every price.
#[derive(Clone, Debug)]
pub(super) struct Rate {
    /// Segments.
    pub pieces: [f64; PRICES],
    /// Mean squared error of an image, summed over the samples.
    pub error: [f64; PRICES],
}

impl Default for Rate {
    fn default() -> Self {
        Self { pieces: [0.0; PRICES], error: [0.0; PRICES] }
    }
}

impl Rate {
    pub(super) fn add(&mut self, other: &Self) {
        for g in 0..PRICES {
            self.pieces[g] += other.pieces[g];
            self.error[g] += other.error[g];
        }
    }
}

/// The g-th price.
pub(super) fn price(g: usize) -> f64 {
    LOWEST * FACTOR.powi(g as i32)
}

/// Running sums of one Gaussian's samples.
pub(super) struct Sums<'a> {
    tree: &'a Tree,
    row: &'a Row,
    weight: Weight,
    /// Of the covariance's off-diagonal entries: whether a turn explains them.
    turns: [bool; 3],
    /// Greatest opacity.
    peak: f64,
    colors: usize,
    width: usize,
    /// [samples + 1, width]
    sums: Vec<f64>,
}

impl<'a> Sums<'a> {
    /// Sums over the samples of `row`. `weigh` gives the weight of its errors from its clearest sample. None: no sample
    /// is finite.
    pub(super) fn new(
        tree: &'a Tree,
        samples: &Samples,
        row: &'a Row,
        life: Envelope,
        weigh: impl FnOnce(&[f32]) -> Weight,
    ) -> Option<Self> {
        let [first, last] = row.frames;
        let look = |k: usize| Some(samples.at(row, k)).filter(|v| v.iter().all(|x| x.is_finite()));
        let clearest = (first..=last).filter_map(look).reduce(|a, b| if b[9] > a[9] { b } else { a })?;
        let (weight, peak) = (weigh(clearest), f64::from(clearest[9]).max(FAINT));
        let colors = clearest.len() - GEOMETRY;
        let width = NUMBERS + colors;
        let origin: [f64; 3] = std::array::from_fn(|k| f64::from(clearest[k]));
        let (values, axes) = sym3::eigen(std::array::from_fn(|k| f64::from(clearest[3 + k])));
        let longest = values[0].max(f64::MIN_POSITIVE);
        let sizes = values.map(|v| v.max(THIN * THIN * longest).sqrt());
        let turns = [[0, 1], [0, 2], [1, 2]]
            .map(|[i, j]: [usize; 2]| (values[i] - values[j]).abs() > ROUND * sizes[i] * sizes[j]);
        let mut sums = vec![0.0; (last + 2 - first) * width];
        for k in first..=last {
            let (before, after) = sums.split_at_mut((k + 1 - first) * width);
            let (before, after) = (&before[(k - first) * width..], &mut after[..width]);
            after.copy_from_slice(before);
            let Some(v) = look(k) else { continue };
            let alpha = f64::from(v[9]);
            let share = weight.share(tree.time(k));
            let (t, w) = (tree.time(k) - tree.time(first), share * (alpha / peak).powi(2) + FAINT);
            let x: [f64; 3] = std::array::from_fn(|k| f64::from(v[k]) - origin[k]);
            let mean: [f64; 3] = std::array::from_fn(|c| (c..3).map(|r| weight.mean[r][c] * x[r]).sum());
            let cov = inside(&axes, &sizes, std::array::from_fn(|k| f64::from(v[3 + k])));
            let square: f64 =
                cov.iter().map(|c| c * c).sum::<f64>() + OFF_DIAGONAL.map(|k| cov[k] * cov[k]).iter().sum::<f64>();
            let sigma = life.sigma(tree.time(k));
            for (place, value) in [
                (at::W, w),
                (at::WT, w * t),
                (at::WTT, w * t * t),
                (at::MEAN_SQUARE, w * mean.iter().map(|m| m * m).sum::<f64>()),
                (at::COV_SQUARE, w * square),
                (at::COUNT, share),
                (at::ALPHA, share * alpha),
                (at::ALPHA_SQUARE, share * alpha * alpha),
                (at::ALPHA_SIGMA, share * alpha * sigma),
                (at::SIGMA_SQUARE, share * sigma * sigma),
            ] {
                after[place] += value;
            }
            for c in 0..3 {
                after[at::MEAN + c] += w * mean[c];
                after[at::MEAN_T + c] += w * t * mean[c];
            }
            for c in 0..6 {
                after[at::COV + c] += w * cov[c];
                after[at::COV_T + c] += w * t * cov[c];
            }
            for (c, value) in v[GEOMETRY..].iter().enumerate() {
                let value = f64::from(*value);
                after[NUMBERS + c] += w * value;
                after[at::COLOR_SQUARE] += w * value * value;
            }
        }
        Some(Self { tree, row, weight, turns, peak, colors, width, sums })
    }

    /// The error that one segment over a span leaves, summed over its samples; those at its ends, which its neighbours
    /// share, count half.
    pub(super) fn error(&self, span: Span) -> f64 {
        let [first, last] = self.row.frames;
        let (a, b) = (first.max(span[0]), last.min(span[1]));
        // A single frame is exact, and moves linearly to the next.
        if span[1] - span[0] <= 1 || a >= b {
            return 0.0;
        }
        let before = |k: usize| &self.sums[(k - first) * self.width..(k + 1 - first) * self.width];
        let [s0, s1, s2, s3] = [a, a + 1, b, b + 1].map(before);
        let between = |place: usize| 0.5 * (s3[place] - s0[place] + s2[place] - s1[place]);
        let sums: [f64; NUMBERS] = std::array::from_fn(between);
        let sum = |place: usize| sums[place];
        let w = sum(at::W);
        if w <= 0.0 {
            return 0.0;
        }
        let time = sum(at::WT) / w;
        let spread = sum(at::WTT) - w * time * time;
        let about = |square: f64, level: &mut dyn Iterator<Item = f64>| square - level.map(|s| s * s).sum::<f64>() / w;
        let slope = |place: usize, level: usize| sum(place) - time * sum(level);
        let part = |x: f64| if spread > 0.0 { x / spread } else { 0.0 };

        let mut mean = about(sum(at::MEAN_SQUARE), &mut (0..3).map(|c| sum(at::MEAN + c)));
        mean -= part((0..3).map(|c| slope(at::MEAN_T + c, at::MEAN + c).powi(2)).sum());
        let double = |c: usize| if OFF_DIAGONAL.contains(&c) { std::f64::consts::SQRT_2 } else { 1.0 };
        let mut cov = about(sum(at::COV_SQUARE), &mut (0..6).map(|c| double(c) * sum(at::COV + c)));
        for (&c, _) in OFF_DIAGONAL.iter().zip(self.turns).filter(|(_, turns)| *turns) {
            cov -= part(2.0 * slope(at::COV_T + c, at::COV + c).powi(2));
        }
        let square = sum(at::ALPHA_SQUARE);
        let constant = square - sum(at::ALPHA).powi(2) / sum(at::COUNT).max(f64::MIN_POSITIVE);
        let sigmas = sum(at::SIGMA_SQUARE);
        let own = if sigmas > 0.0 { square - sum(at::ALPHA_SIGMA).powi(2) / sigmas } else { square };
        let alpha = constant.min(own) / (self.peak * self.peak);
        let color = match self.colors {
            0 => 0.0,
            n => about(sum(at::COLOR_SQUARE), &mut (0..n).map(|c| between(NUMBERS + c))),
        };
        let Weight { opacity, color: of_color, .. } = &self.weight;
        let positive = |x: f64| if x > 0.0 { x } else { 0.0 };
        // What rounding turned negative, or what is not finite, costs nothing.
        let [mean, cov] = [mean, SHAPE * opacity * cov].map(positive);
        let [alpha, color] = [opacity * alpha, of_color * color].map(positive);
        // Being further off than a Gaussian is wide is no worse.
        let (off, most) = (mean + cov, w * self.weight.most);
        let off = if off > 0.0 { off * most / (off + most) } else { 0.0 };
        off + alpha + color
    }

    /// Segments and error of the best cut below a span, at every price. Errors count by the share of the clip.
    pub(super) fn rate(&self, span: Span) -> Rate {
        let mut out = Rate::default();
        match narrow(self.tree, self.row.seen, span) {
            Place::Nowhere => {}
            Place::In(half) => return self.rate(half),
            Place::Here => {
                let error = self.error(span) / self.tree.frames() as f64;
                (out.pieces, out.error) = ([1.0; PRICES], [error; PRICES]);
                let Some([left, right]) = self.tree.split(span).filter(|_| error > LOWEST) else { return out };
                let mut halves = self.rate(left);
                halves.add(&self.rate(right));
                for g in 0..PRICES {
                    if halves.error[g] + price(g) * halves.pieces[g] < error + price(g) {
                        (out.pieces[g], out.error[g]) = (halves.pieces[g], halves.error[g]);
                    }
                }
            }
        }
        out
    }

    /// Appends the spans of the best cut at one price; returns what it costs.
    pub(super) fn cut(&self, span: Span, price: f64, out: &mut Vec<Span>) -> f64 {
        match narrow(self.tree, self.row.seen, span) {
            Place::Nowhere => 0.0,
            Place::In(half) => self.cut(half, price, out),
            Place::Here => {
                let whole = self.error(span) / self.tree.frames() as f64 + price;
                let before = out.len();
                if let Some([left, right]) = self.tree.split(span).filter(|_| whole > price + LOWEST) {
                    let halves = self.cut(left, price, out) + self.cut(right, price, out);
                    if halves < whole {
                        return halves;
                    }
                    out.truncate(before);
                }
                out.push(span);
                whole
            }
        }
    }
}

/// A covariance along axes of these sizes.
fn inside(axes: &[[f64; 3]; 3], sizes: &[f64; 3], c: [f64; 6]) -> [f64; 6] {
    let full = [[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]];
    let half: [[f64; 3]; 3] = std::array::from_fn(|i| {
        std::array::from_fn(|k| (0..3).map(|j| full[i][j] * axes[j][k]).sum::<f64>() / sizes[k])
    });
    let entry = |a: usize, b: usize| (0..3).map(|i| axes[i][a] * half[i][b]).sum::<f64>() / sizes[a];
    [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)]
}
