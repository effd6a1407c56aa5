//! The importance of each splat to an image, in three scores that one walk as forward's sums over the pixels.
//!
//! *Contribution*: Σ over pixels of α_i T_i, T_i = Π_{j<i} (1 − α_j): the gradient of a channel's sum to that channel,
//! which the backward pass would compute together with eleven other numbers. *Removal*: the change that it makes to be
//! without the splat, Σ over pixels and channels of (α_i T_i (b_i − c_i))², b_i the colour of all that is behind: exact
//! for one splat alone (pixels that had stopped stay stopped). A splat before others of its colour contributes much and
//! changes little.
//!
//! *Sensitivity*: how strongly the image depends on a splat. A pixel's channels depend on its shape through ln α alone,
//! with the slope v_c = αT(c − b), and ln α = ln o − ½ dᵀ Q d, d = μ − p, Q the conic. Its gradient to (μ, Q) is a
//! polynomial s(d) of second degree, so that Σ over pixels and channels of the products of gradients is known from the
//! moments Σ_p (Σ_c v_c²) dx^i dy^j of degree 2 to 4: twelve sums per splat, exact. Slow and clear: it is meant for
//! scores, not for steps.

use super::Renderer;
use super::bin::{BIN, id};
use super::blend::{
    BATCH, Exponent, Limits, PAIR_OF_ROWS, ROW, Tile, Visit, alpha, begin, columns, highest, offsets, pass,
    strip_range, strips, sum_lanes, walk,
};
use super::gather::{CHANNELS, Record, SIDE, TILE, TILES};
use super::parallel::{Ragged, for_each_group};
use super::project::{Projected, ProjectedGrads, Projection, View, project_backward};
use super::rasterize::{CHUNK, Pass, Raster};
use super::simd::{Kernel, Simd, dispatch, least, select};
use super::{RenderConfig, Shot, project, shade};
use crate::math::{Real, sym3};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::{Camera, Splats};
use rayon::prelude::*;
use std::marker::PhantomData;
use std::sync::atomic::Ordering;

/// Powers of dx and dy whose products with Σ_c v_c² are summed.
const POWERS: [[usize; 2]; 12] =
    [[2, 0], [1, 1], [0, 2], [3, 0], [2, 1], [1, 2], [0, 3], [4, 0], [3, 1], [2, 2], [1, 3], [0, 4]];
/// The moments, and Σ of (Σ_c v_c²)/α².
const MOMENTS: usize = POWERS.len() + 1;

/// The result of an image to changes of one splat.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sensitivity {
    /// Upper triangle, row by row, of the 6x6 block Σ over pixels and channels of ∇I ∇Iᵀ with respect to the mean (3,
    /// world) and the standard deviations along the covariance's axes (3, longest first), scene units⁻². Colour does
    /// not count as depending on the direction. Source: PUP 3D-GS (Hanson et al. 2025), its spatial Fisher block.
    pub fisher: [f64; 21],
    /// Σ over pixels and channels of (dI/dg)², g the splat's bare bell e^(−½ dᵀ Q d). Source: Speedy-Splat (Hanson et
    /// al. 2025), its efficient pruning score.
    pub squared: f64,
}

/// The scores in f32. Nothing of it is generic, so that it is compiled here and not again in every crate that scores.
#[derive(Debug)]
pub struct Importance {
    renderer: Renderer<f32>,
}

impl Importance {
    /// A renderer of its own, without memory yet.
    pub fn new(config: RenderConfig) -> Self {
        Self { renderer: Renderer::new(config) }
    }

    /// See `Renderer::contributions`.
    pub fn contributions(&mut self, splats: &Splats<'_>, camera: &Camera, out: &mut Vec<f32>) {
        self.renderer.contributions(splats, camera, out);
    }

    /// See `Renderer::last_contributions`.
    pub fn last_contributions(&mut self, out: &mut Vec<f32>) {
        self.renderer.last_contributions(out);
    }

    /// See `Renderer::removals`.
    pub fn removals(&mut self, shot: &Shot<'_>, out: &mut Vec<f32>) {
        self.renderer.removals(shot, out);
    }

    /// See [`Renderer::sensitivities`].
    pub fn sensitivities(&mut self, shot: &Shot<'_>, out: &mut Vec<Sensitivity>) {
        self.renderer.sensitivities(shot, out);
    }

    /// Splats as a camera sees them, before any is blended, one per splat.
    pub(crate) fn project(&mut self, splats: &Splats<'_>, camera: &Camera) -> &[Projected] {
        self.renderer.list(splats, camera);
        self.renderer.projected()
    }

    /// See `Renderer::projected`.
    pub fn projected(&self) -> &[Projected] {
        self.renderer.projected()
    }
}

impl<F: Real> Renderer<F> {
    /// Σ over pixels of α_i Π_{j<i} (1 − α_j) of every splat: how much of the image it is. No colour is examined.
    ///
    /// `out` is overwritten, one per splat; exactly 0 where no pixel shows it. Renders no image; no backward may
    /// follow. Costs less than a render's blend. Source: the significance of LightGaussian (Fan et al. 2024) and the
    /// spatial score of 4DGS-1K (Yuan et al. 2025).
    pub(crate) fn contributions(&mut self, splats: &Splats<'_, F>, camera: &Camera, out: &mut Vec<F>) {
        self.list(splats, camera);
        self.last_contributions(out);
    }

    /// `Renderer::contributions` of what was rendered last. A backward may still follow.
    pub(crate) fn last_contributions(&mut self, out: &mut Vec<F>) {
        self.score_all::<Contribution>(None, out);
    }

    /// Σ over pixels and channels of the squared change that a splat's removal would make to the image, one per splat,
    /// exact for each alone.
    ///
    /// Neither head nor further channels are examined: it is the base colours' image that changes. `out` is
    /// overwritten, one per splat. Renders on its own; no backward may follow.
    pub(crate) fn removals(&mut self, shot: &Shot<'_, F>, out: &mut Vec<F>) {
        self.list_and_blend(shot);
        self.score_all::<Removal>(Some(shot.background), out);
    }

    /// The sensitivity of the image to each splat: exact sums over its pixels, for splats that stay in front of and
    /// behind the same others. Neither head nor further channels are examined: the image is that of the base colours.
    ///
    /// `out` is overwritten, one per splat; zeros where no pixel shows it. Renders on its own; no backward may follow.
    pub fn sensitivities(&mut self, shot: &Shot<'_, F>, out: &mut Vec<Sensitivity>) {
        let view = self.list_and_blend(shot);
        let splats = shot.splats;
        let mut sums = vec![[0.0; MOMENTS]; splats.len()];
        let pass = Pass {
            projected: &self.projected,
            footprints: &self.footprints,
            channels: &self.channels,
            background: shot.background,
            config: &self.config,
        };
        let add = |sums: &mut [f64; MOMENTS], pair: &[F; MOMENTS]| {
            sums.iter_mut().zip(pair).for_each(|(sum, x)| *sum += x.f64());
        };
        self.raster.score::<Moments, MOMENTS, _>(&pass, &mut sums, add);
        out.clear();
        out.resize(splats.len(), Sensitivity::default());
        let mut first = 0;
        for part in &splats.parts {
            let count = part.out.rows();
            let rows = out[first..first + count].par_iter_mut().enumerate().with_min_len(256);
            rows.for_each(|(j, out)| {
                let (row, sums) = (&self.projected[first + j], &sums[first + j]);
                if row.radius > F::ZERO && sums[MOMENTS - 1] > 0.0 {
                    let geometry = (part.out.read(j, 0), part.out.read(j, COV), part.out.get(j, SPLAT_OPACITY));
                    let opacity = row.opacity.f64();
                    let squared = sums[MOMENTS - 1] * opacity * opacity;
                    *out = Sensitivity { fisher: fisher(&view, geometry, row, sums), squared };
                }
            });
            first += count;
        }
    }

    /// Sums one number a splat of what was listed and, with a background, blended last.
    fn score_all<S: Score<F, 1>>(&mut self, background: Option<[F; 3]>, out: &mut Vec<F>) {
        out.clear();
        out.resize(self.projected.len(), F::ZERO);
        let pass = Pass {
            projected: &self.projected,
            footprints: &self.footprints,
            channels: &self.channels,
            background: background.unwrap_or([F::ZERO; 3]),
            config: &self.config,
        };
        self.raster.score::<S, 1, _>(&pass, out, |sum, pair| *sum += pair[0]);
    }

    /// Lists, colours and blends what an image shows.
    fn list_and_blend(&mut self, shot: &Shot<'_, F>) -> View<F> {
        let view = self.list(shot.splats, shot.camera);
        self.channels.resize(shot.splats.len(), [F::ZERO; CHANNELS]);
        let simd = self.config.simd;
        let projection = Projection { splats: shot.splats, view: &view, simd, projected: &self.projected };
        shade::forward(&projection, shot.sh_degree, &mut self.channels);
        self.raster.blend(&Pass {
            projected: &self.projected,
            footprints: &self.footprints,
            channels: &self.channels,
            background: shot.background,
            config: &self.config,
        });
        view
    }

    /// Projects splats and makes their lists.
    fn list(&mut self, splats: &Splats<'_, F>, camera: &Camera) -> View<F> {
        let (n, simd) = (splats.len(), self.config.simd);
        let view = View::new(camera, &self.config);
        // An image of another size than any: a backward is refused.
        self.size = [0; 2];
        self.projected.resize(n, Projected::default());
        self.footprints.resize(n, Default::default());
        self.radii.resize(n, F::ZERO);
        project::forward(splats, &view, simd, &mut self.projected, &mut self.footprints, &mut self.radii);
        self.raster.prepare(&self.projected, &self.footprints, camera.width, camera.height, simd);
        view
    }
}

impl<F: Real> Raster<F> {
    /// Sums a score over the pixels of every splat that was prepared, after [`Raster::blend`] of the same pass where
    /// the score uses colours. `add` adds a pair of bin and splat to the splat's row of `out`, in the order of its
    /// bins.
    fn score<S: Score<F, NUMBERS>, const NUMBERS: usize, A: Send>(
        &mut self,
        pass: &Pass<'_, F>,
        out: &mut [A],
        add: impl Fn(&mut A, &[F; NUMBERS]) + Sync,
    ) {
        for run in 0..self.bins.runs.len() {
            self.hold(pass.projected, pass.footprints, run);
            self.score_run::<S, NUMBERS>(pass);
            let (place, bins) = (&self.place, &self.bins);
            let scores = self.pair_scores.as_chunks::<NUMBERS>().0;
            out.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, out)| {
                for (i, out) in out.iter_mut().enumerate() {
                    let splat = chunk * CHUNK + i;
                    for slot in &place[bins.slots(splat, &pass.footprints[splat])] {
                        add(out, &scores[slot.load(Ordering::Relaxed) as usize]);
                    }
                }
            });
        }
    }

    /// The scores of the current run's pairs.
    fn score_run<S: Score<F, NUMBERS>, const NUMBERS: usize>(&mut self, pass: &Pass<'_, F>) {
        let (simd, bins, limits) = (self.simd.unwrap_or(Simd::Scalar), &self.bins, Limits::new(pass.config));
        let (width, height, tiles, background) = (self.width, self.height, &self.tiles, pass.background);
        let pairs = bins.keys.len();
        self.pair_scores.resize(NUMBERS * pairs, F::ZERO);
        self.place.resize_with(pairs, Default::default);
        let (place, run) = (&self.place, &bins.runs[bins.current]);
        let data = (Ragged(&mut self.records), Ragged(self.pair_scores.as_chunks_mut::<NUMBERS>().0));
        for_each_group(&bins.starts, data, &|bin, (records, scores)| {
            if !run.contains(&bin) {
                return;
            }
            let (start, end) = (bins.starts[bin] as usize, bins.starts[bin + 1] as usize);
            let (bx, by) = (bin % bins.across, bin / bins.across);
            for (i, (r, key)) in records.0.iter_mut().zip(&bins.keys[start..end]).enumerate() {
                let splat = id(*key);
                if S::COLORS {
                    r.channels = pass.channels[splat];
                }
                // Every slot is written by exactly one task, so that the order of writes cannot matter.
                let slot = bins.first[splat].wrapping_add(pass.footprints[splat].rank(bx, by) as u32);
                place[slot as usize].store((start + i) as u32, Ordering::Relaxed);
            }
            scores.0.fill([F::ZERO; NUMBERS]);
            let inside = [width - bx * BIN, height - by * BIN];
            let tiles = &tiles[bin * TILES..(bin + 1) * TILES];
            let (records, out, score) = (&*records.0, scores.0, PhantomData::<S>);
            dispatch(simd, Walk { records, tiles, background, inside, limits, out, score });
        });
    }
}

/// A splat in a pixel.
struct Pixel<F> {
    /// α
    alpha: F,
    /// α T; 0 where the pixel has stopped.
    weight: F,
    /// α T c, c the splat's colour; only where the score uses colours.
    own: [F; CHANNELS],
    /// α/(1 − α) times what the pixel shows of all that is behind: α T b. As `own`; 0 where the pixel has stopped.
    hidden: [F; CHANNELS],
    /// Whether α follows the splat here: it does not where nothing is rendered or α is at its maximum.
    felt: bool,
    /// The splat's centre less the pixel's, pixels.
    offset: [F; 2],
}

/// `NUMBERS` sums a splat.
trait Score<F, const NUMBERS: usize>: Sync {
    /// Whether it uses [`Pixel::own`] and [`Pixel::hidden`].
    const COLORS: bool;
    /// The terms of one pixel.
    fn of(pixel: &Pixel<F>) -> [F; NUMBERS];
}

/// The share of the image.
struct Contribution;

impl<F: Real> Score<F, 1> for Contribution {
    const COLORS: bool = false;
    #[inline(always)]
    fn of(pixel: &Pixel<F>) -> [F; 1] {
        [pixel.weight]
    }
}

/// The squared change without the splat: what is behind shines through, (1 − α) T b becomes T b.
struct Removal;

impl<F: Real> Score<F, 1> for Removal {
    const COLORS: bool = true;
    #[inline(always)]
    fn of(pixel: &Pixel<F>) -> [F; 1] {
        let mut sum = F::ZERO;
        for c in 0..CHANNELS {
            let change = pixel.hidden[c] - pixel.own[c];
            sum += change * change;
        }
        [sum]
    }
}

/// The moments of a sensitivity.
struct Moments;

impl<F: Real> Score<F, MOMENTS> for Moments {
    const COLORS: bool = true;
    #[inline(always)]
    fn of(pixel: &Pixel<F>) -> [F; MOMENTS] {
        let mut square = F::ZERO;
        for c in 0..CHANNELS {
            let v = pixel.own[c] - pixel.hidden[c];
            square += v * v;
        }
        // Nothing passes where α is 0 or at its ceiling.
        let (square, [dx, dy], a) = (select(pixel.felt, square, F::ZERO), pixel.offset, pixel.alpha);
        let power = |base: F, n: usize| (0..n).fold(F::ONE, |p, _| p * base);
        let mut out = [F::ZERO; MOMENTS];
        for (out, [m, n]) in out.iter_mut().zip(POWERS) {
            *out = square * power(dx, m) * power(dy, n);
        }
        out[MOMENTS - 1] = select(pixel.felt, square / (a * a), F::ZERO);
        out
    }
}

/// The score of one bin: a traversal as in the forward pass that, for a score of colours, has at every pixel the light
/// of all that is behind each splat.
struct Walk<'a, F, S, const NUMBERS: usize> {
    records: &'a [Record<F>],
    /// As the blend left them.
    tiles: &'a [Tile<F>],
    background: [F; CHANNELS],
    /// Pixels from the bin's corner to the image's right and lower ends.
    inside: [usize; 2],
    limits: Limits<F>,
    /// One a record; those that no pixel meets are not written.
    out: &'a mut [[F; NUMBERS]],
    score: PhantomData<S>,
}

impl<F: Real, S: Score<F, NUMBERS>, const NUMBERS: usize> Kernel for Walk<'_, F, S, NUMBERS> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        self.walk::<FMA, ROW>();
    }
    #[inline(always)]
    fn run_wide<const FMA: bool>(self) {
        self.walk::<FMA, PAIR_OF_ROWS>();
    }
}

impl<F: Real, S: Score<F, NUMBERS>, const NUMBERS: usize> Walk<'_, F, S, NUMBERS> {
    #[inline(always)]
    fn walk<const FMA: bool, const N: usize>(self) {
        let mut tiles = [Tile::default(); TILES];
        let open = begin(&mut tiles, self.inside);
        // From here on a tile's colour is the remaining light.
        for (tile, drawn) in tiles.iter_mut().zip(self.tiles).filter(|_| S::COLORS) {
            for (c, rest) in tile.color.iter_mut().enumerate() {
                for (rest, (light, t)) in rest.iter_mut().zip(drawn.color[c].iter().zip(&drawn.t)) {
                    *rest = *light + t.abs() * self.background[c];
                }
            }
        }
        let alpha_max = self.limits.ceiling::<FMA>();
        let sums = [[[F::ZERO; TILE]; NUMBERS]; BATCH];
        let (limits, score, out) = (self.limits, self.score, self.out);
        let mut visit = Passing::<F, S, N, NUMBERS> { tiles, limits, alpha_max, score, sums, out };
        walk::<F, _, FMA>(self.records, open, &mut visit);
    }
}

/// Sums a score over the tiles.
struct Passing<'a, F, S, const N: usize, const NUMBERS: usize> {
    tiles: [Tile<F>; TILES],
    limits: Limits<F>,
    alpha_max: F,
    score: PhantomData<S>,
    /// Sums of a batch's splats over all tiles, column by column.
    sums: [[[F; TILE]; NUMBERS]; BATCH],
    out: &'a mut [[F; NUMBERS]],
}

impl<F: Real, S: Score<F, NUMBERS>, const N: usize, const NUMBERS: usize> Visit<F> for Passing<'_, F, S, N, NUMBERS> {
    #[inline(always)]
    fn splat<const FMA: bool>(&mut self, t: usize, i: usize, r: &Record<F>) {
        let (tx, ty, limits) = (t % SIDE, t / SIDE, self.limits);
        let range = strip_range::<N>(r.tile_rows(tx, ty));
        let mut e = Exponent::<F, N>::new::<FMA>(r, tx, ty, range.start, &limits);
        let (channels, mut dy, dx) = (r.channels, e.dy, offsets::<F, N>(r, tx));
        let Tile { t, color } = &mut self.tiles[t];
        let [reds, greens, blues] = color.each_mut().map(|plane| strips::<F, N>(plane, range.clone()));
        let ts = strips::<F, N>(t, range);
        let mut sums = [[F::ZERO; N]; NUMBERS];
        for (((ts, reds), greens), blues) in ts.iter_mut().zip(reds).zip(greens).zip(blues) {
            let (mut after, mut rest) = (*ts, [*reds, *greens, *blues]);
            for l in 0..N {
                let a = alpha::<F, FMA>(least(e.raw::<FMA>(l), e.top), &limits);
                let (kept, weight, open) = pass(after[l], a, &limits);
                after[l] = kept;
                let (mut own, mut hidden) = ([F::ZERO; CHANNELS], [F::ZERO; CHANNELS]);
                if S::COLORS {
                    let odds = select(open, a / (F::ONE - a), F::ZERO);
                    for c in 0..CHANNELS {
                        own[c] = weight * channels[c];
                        rest[c][l] -= own[c];
                        hidden[c] = odds * rest[c][l];
                    }
                }
                let felt = open & (a > F::ZERO) & (a < self.alpha_max);
                let adds = S::of(&Pixel { alpha: a, weight, own, hidden, felt, offset: [dx[l], dy[l]] });
                sums.iter_mut().zip(adds).for_each(|(sum, x)| sum[l] += x);
                dy[l] -= e.steps[1];
                e.step(l);
            }
            *ts = after;
            if S::COLORS {
                [*reds, *greens, *blues] = rest;
            }
        }
        for (totals, sum) in self.sums[i].iter_mut().zip(sums) {
            for (total, v) in totals.iter_mut().zip(columns(sum)) {
                *total += v;
            }
        }
    }

    #[inline(always)]
    fn stopped(&self, t: usize) -> bool {
        highest(&self.tiles[t].t) < F::ZERO
    }

    #[inline(always)]
    fn passed(&mut self, first: usize, count: usize) {
        for (out, sums) in self.out[first..].iter_mut().zip(&mut self.sums[..count]) {
            *out = std::mem::replace(sums, [[F::ZERO; TILE]; NUMBERS]).map(sum_lanes);
        }
    }
}

/// J M Jᵀ: M the moments of s sᵀ, J the Jacobian from (μ, Q) to mean and standard deviations.
fn fisher<F: Real>(
    view: &View<F>,
    (mean, cov, opacity): ([F; 3], [F; 6], F),
    row: &Projected<F>,
    sums: &[f64; MOMENTS],
) -> [f64; 21] {
    // s = (−Q d, −½ dx², −dx dy, −½ dy²), each a list of coefficients of dx^i dy^j.
    let [a, b, c] = row.conic.map(F::f64);
    type Terms = [([usize; 2], f64); 2];
    let s: [Terms; 5] = [
        [([1, 0], -a), ([0, 1], -b)],
        [([1, 0], -b), ([0, 1], -c)],
        [([2, 0], -0.5), ([0, 0], 0.0)],
        [([1, 1], -1.0), ([0, 0], 0.0)],
        [([0, 2], -0.5), ([0, 0], 0.0)],
    ];
    let moment = |p: [usize; 2]| POWERS.iter().position(|q| *q == p).map_or(0.0, |k| sums[k]);
    let product = |x: &Terms, y: &Terms| -> f64 {
        let terms = x.iter().flat_map(|(p, u)| y.iter().map(move |(q, v)| ([p[0] + q[0], p[1] + q[1]], u * v)));
        terms.filter(|(_, w)| *w != 0.0).map(|(p, w)| w * moment(p)).sum()
    };
    let (values, axes) = sym3::eigen(cov.map(F::f64));
    let one = |k: usize| -> [f64; 6] {
        let mut d = ProjectedGrads::default();
        if k < 2 {
            d.mean2d[k] = F::ONE;
        } else {
            d.conic[k - 2] = F::ONE;
        }
        let g = project_backward(view, mean, cov, opacity, row, &d);
        let h = g.cov.map(F::f64);
        // d/d s_k of Σ s² v vᵀ is 2 s v vᵀ; a packed off-diagonal represents both positions.
        let along = |n: usize| {
            let v = [axes[0][n], axes[1][n], axes[2][n]];
            let quadratic = h[0] * v[0] * v[0] + h[3] * v[1] * v[1] + h[5] * v[2] * v[2];
            let mixed = h[1] * v[0] * v[1] + h[2] * v[0] * v[2] + h[4] * v[1] * v[2];
            2.0 * values[n].max(0.0).sqrt() * (quadratic + mixed)
        };
        [g.mean[0].f64(), g.mean[1].f64(), g.mean[2].f64(), along(0), along(1), along(2)]
    };
    let jacobian: [[f64; 6]; 5] = std::array::from_fn(one);
    let inner: [[f64; 5]; 5] = std::array::from_fn(|i| std::array::from_fn(|j| product(&s[i], &s[j])));
    let mut out = [0.0; 21];
    let mut at = 0;
    for i in 0..6 {
        for j in i..6 {
            out[at] = (0..5).map(|p| (0..5).map(|q| jacobian[p][i] * inner[p][q] * jacobian[q][j]).sum::<f64>()).sum();
            at += 1;
        }
    }
    out
}
