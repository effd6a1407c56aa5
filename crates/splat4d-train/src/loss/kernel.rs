//! The fused kernel behind [`super::Photometric`]: L1 and SSIM of one strip of rows of one channel, forwards and
//! backwards in one rolling pass.
//!
//! With windowed means ⟨·⟩ (11x11 Gaussian), render x, truth y:
//!
//! ```text
//! S = a1·a2 / (b1·b2),  a1 = 2⟨x⟩⟨y⟩ + C1,        a2 = 2(⟨xy⟩ − ⟨x⟩⟨y⟩) + C2,
//!                       b1 = ⟨x⟩² + ⟨y⟩² + C1,    b2 = ⟨xx + yy⟩ − ⟨x⟩² − ⟨y⟩² + C2
//! ∂S/∂⟨x⟩     = 2 (⟨y⟩(a2 − a1) + ⟨x⟩ S (b1 − b2)) / (b1·b2)
//! ∂S/∂⟨xx+yy⟩ = −S / b2
//! ∂S/∂⟨xy⟩    = 2 a1 / (b1·b2)
//! d_x = ⟨w ∂S/∂⟨x⟩⟩ + 2x ⟨w ∂S/∂⟨xx+yy⟩⟩ + y ⟨w ∂S/∂⟨xy⟩⟩
//! ```
//!
//! Only the sum of the two variances occurs, so four moments do (x, y, xx+yy, xy), not five. Four rows at a time go
//! through the stages: products → vertical means → horizontal means and S's derivatives → vertical means → horizontal
//! means and the gradient. Products and derivatives live in rings of 16 rows, which stay in the second-level cache.
//! The loops are plain ones over a row, because LLVM vectorises those reliably, and blocks of lanes it does not.

use splat4d::math::Real;
use splat4d::simd::Pass;

/// Taps of the window and their reach on either side (Wang 2004; 3DGS `loss_utils`).
pub(super) const TAPS: usize = 11;
const REACH: usize = TAPS / 2;
/// Standard deviation of the window in pixels (Wang 2004).
const SIGMA: f64 = 1.5;
/// (0.01·L)² and (0.03·L)² for the range L = 1 (Wang 2004).
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// Passes run over whole AVX2 registers of f32, so that no loop has a scalar rest.
const LANES: usize = 8;
/// Rows that go through the pipeline together; a vertical pass then loads 14 rows for 44 products.
const GROUP: usize = 4;
/// Rows a group's window spans.
const SPAN: usize = GROUP + TAPS - 1;
/// Rows in a ring: a span, rounded up to a power of two.
const RING: usize = 16;
/// Moments (x, y, xx+yy, xy) and derivatives.
const MOMENTS: usize = 4;
const DERIVATIVES: usize = 3;
/// Widest run of columns worked on at a time, so that the rings fit the second-level cache.
const MAX_COLUMNS: usize = 512;
/// Numbers in a scratch row: columns, a window's halo twice, each rounded up to whole lanes.
const STRIDE: usize = MAX_COLUMNS + 32;

/// One strip's work.
pub(super) struct Strip<'a, F> {
    /// The whole channel of the render, [height, width].
    pub render: &'a [F],
    /// The whole channel of the truth.
    pub truth: &'a [F],
    /// Weight of every pixel, ≥ 0.
    pub weight: Option<&'a [F]>,
    /// Pixels in a row.
    pub width: usize,
    /// Rows of the image.
    pub height: usize,
    /// First row of the strip.
    pub first: usize,
    /// The window, [`window`].
    pub taps: [F; TAPS],
    /// ∂loss/∂(Σ w|x − y|).
    pub d_l1: F,
    /// ∂loss/∂(Σ w S).
    pub d_ssim: F,
}

/// The normalised window.
pub(super) fn window<F: Real>() -> [F; TAPS] {
    let bell = |i: usize| (-(i as f64 - REACH as f64).powi(2) / (2.0 * SIGMA * SIGMA)).exp();
    let sum: f64 = (0..TAPS).map(bell).sum();
    std::array::from_fn(|i| F::of(bell(i) / sum))
}

/// Working rows of one thread.
#[derive(Debug)]
pub(super) struct Scratch<F> {
    /// Ring of products, `[RING, MOMENTS, STRIDE]`.
    products: Vec<[F; STRIDE]>,
    /// Ring of S's derivatives, `[RING, DERIVATIVES, STRIDE]`.
    derivatives: Vec<[F; STRIDE]>,
    /// Vertical means of one group, `[GROUP, MOMENTS, STRIDE]`.
    means: Vec<[F; STRIDE]>,
    /// Weights from column −5 on, 0 outside the image, `[STRIDE]`.
    weights: Box<[F; STRIDE]>,
    /// Results of one row, `[3, STRIDE]`.
    row: Vec<[F; STRIDE]>,
}

impl<F: Real> Scratch<F> {
    /// Rows for any strip.
    pub fn new() -> Self {
        let rows = |n: usize| vec![[F::ZERO; STRIDE]; n];
        Self {
            products: rows(RING * MOMENTS),
            derivatives: rows(RING * DERIVATIVES),
            means: rows(GROUP * MOMENTS),
            weights: Box::new([F::ZERO; STRIDE]),
            row: rows(3),
        }
    }
}

impl<F: Real> Pass for Strip<'_, F> {
    type Scratch = Scratch<F>;
    type Into = [F];
    type Out = [f64; 3];

    /// [Σ w|x − y|, Σ w S, Σ w e²] over the strip, e the error of the render clamped to [0, 1]; writes its gradient into `d` ([rows, width]).
    #[inline(always)]
    fn run<const FMA: bool>(&self, scratch: &mut Scratch<F>, d: &mut [F]) -> [f64; 3] {
        // Column runs of even size, so that no narrow rest pays a full halo.
        let runs = self.width.div_ceil(MAX_COLUMNS);
        let run = self.width.div_ceil(runs).next_multiple_of(LANES);
        let mut sums = [0.0; 3];
        for x0 in (0..self.width).step_by(run) {
            let tile = Tile::new(self, x0, run.min(self.width - x0), d.len() / self.width);
            let part = tile.walk::<FMA>(scratch, d);
            sums[0] += part[0];
            sums[1] += part[1];
            sums[2] += part[2];
        }
        sums
    }
}

/// Some columns of a strip. Its derivative row/column i is the image's `first − 5 + i`, its product row/column i the
/// image's `first − 10 + i`: a derivative at i then needs the products i..i+11, the gradient at i the derivatives
/// i..i+11.
struct Tile<'a, F> {
    job: &'a Strip<'a, F>,
    x0: usize,
    columns: usize,
    rows: usize,
    /// Columns of a pass, in whole lanes.
    derivative_columns: usize,
    product_columns: usize,
}

impl<'a, F: Real> Tile<'a, F> {
    fn new(job: &'a Strip<'a, F>, x0: usize, columns: usize, rows: usize) -> Self {
        let derivative_columns = (columns + TAPS - 1).next_multiple_of(LANES);
        let product_columns = (derivative_columns + TAPS - 1).next_multiple_of(LANES);
        Self { job, x0, columns, rows, derivative_columns, product_columns }
    }

    #[inline(always)]
    fn walk<const FMA: bool>(&self, s: &mut Scratch<F>, d: &mut [F]) -> [f64; 3] {
        let mut sums = [0.0; 3];
        self.fill_weights(s, 0);
        for row in 0..2 * REACH {
            self.fill_products(s, row);
        }
        // At `head`, derivative rows head..head+4 are made, and with them gradient rows head−10..head−6.
        let mut head = 0;
        while head < self.rows + 2 * REACH {
            for row in 0..GROUP {
                self.fill_products(s, head + 2 * REACH + row);
            }
            vertical::<F, FMA, MOMENTS>(&self.job.taps, &s.products, head, self.product_columns, &mut s.means);
            for row in 0..GROUP {
                sums[1] += self.derivatives::<FMA>(s, head + row, row);
            }
            if head + GROUP > 2 * REACH {
                // A group that straddles the strip's first row reads rows before it from the ring; they are not used.
                let from = (head + RING - 2 * REACH) % RING;
                vertical::<F, FMA, DERIVATIVES>(
                    &self.job.taps,
                    &s.derivatives,
                    from,
                    self.derivative_columns,
                    &mut s.means,
                );
                for row in 0..GROUP {
                    if (2 * REACH..self.rows + 2 * REACH).contains(&(head + row)) {
                        let [l1, square] = self.gradient::<FMA>(s, head + row - 2 * REACH, row, d);
                        (sums[0], sums[2]) = (sums[0] + l1, sums[2] + square);
                    }
                }
            }
            head += GROUP;
        }
        sums
    }

    /// The image's row for derivative row `row`, if it has one.
    #[inline(always)]
    fn image_row(&self, row: usize, halo: usize) -> Option<usize> {
        (self.job.first + row).checked_sub(halo).filter(|&y| y < self.job.height)
    }

    /// The scratch columns that lie in the image, of `count` with this halo; the first is image column `x0 + start −
    /// halo`.
    #[inline(always)]
    fn inside(&self, halo: usize, count: usize) -> (usize, usize) {
        let start = halo.saturating_sub(self.x0);
        (start, count.min(self.job.width + halo - self.x0))
    }

    /// Weights of the image row that derivative row `row` stands for (its halo is 5 columns).
    #[inline(always)]
    fn fill_weights(&self, s: &mut Scratch<F>, row: usize) {
        let (start, end) = self.inside(REACH, self.derivative_columns);
        match (self.job.weight, self.image_row(row, REACH)) {
            (None, _) => {
                s.weights.fill(F::ZERO);
                s.weights[start..end].fill(F::ONE);
            }
            (Some(weight), Some(y)) => {
                let from = y * self.job.width + self.x0 + start - REACH;
                s.weights.fill(F::ZERO);
                s.weights[start..end].copy_from_slice(&weight[from..from + end - start]);
            }
            (Some(_), None) => s.weights.fill(F::ZERO),
        }
    }

    /// Products of one row; zero outside the image and where the weight is zero.
    #[inline(always)]
    fn fill_products(&self, s: &mut Scratch<F>, row: usize) {
        let (out, _) = s.products[row % RING * MOMENTS..].split_first_chunk_mut::<MOMENTS>().expect("a ring row");
        let Some(y) = self.image_row(row, 2 * REACH) else {
            out.as_flattened_mut().fill(F::ZERO);
            return;
        };
        let (start, end) = self.inside(2 * REACH, self.product_columns);
        let from = y * self.job.width + self.x0 + start - 2 * REACH;
        let n = end - start;
        let (render, truth) = (&self.job.render[from..from + n], &self.job.truth[from..from + n]);
        for part in out.iter_mut() {
            part[..start].fill(F::ZERO);
            part[end..].fill(F::ZERO);
        }
        let [a, b, c, e] = out.each_mut().map(|part| &mut part[start..end]);
        a.copy_from_slice(render);
        b.copy_from_slice(truth);
        if let Some(weight) = self.job.weight {
            let weight = &weight[from..from + n];
            for i in 0..n {
                if weight[i] <= F::ZERO {
                    (a[i], b[i]) = (F::ZERO, F::ZERO);
                }
            }
        }
        for i in 0..n {
            c[i] = a[i] * a[i] + b[i] * b[i];
            e[i] = a[i] * b[i];
        }
    }

    /// Horizontal means of one row of a group, S and its weighted derivatives; returns Σ w S over the tile's own pixels.
    #[inline(always)]
    fn derivatives<const FMA: bool>(&self, s: &mut Scratch<F>, row: usize, in_group: usize) -> f64 {
        let slot = row % RING * DERIVATIVES;
        if self.image_row(row, REACH).is_none() {
            s.derivatives[slot..slot + DERIVATIVES].as_flattened_mut().fill(F::ZERO);
            return 0.0;
        }
        if self.job.weight.is_some() {
            self.fill_weights(s, row);
        }
        let (out, _) = s.derivatives[slot..].split_first_chunk_mut::<DERIVATIVES>().expect("a ring row");
        let (means, _) = s.means[in_group * MOMENTS..].split_first_chunk::<MOMENTS>().expect("a row of means");
        let map = &mut s.row[0];
        let taps = &self.job.taps;
        let (c1, c2) = (F::of(C1), F::of(C2));
        let [da, db, dc] = out;
        for i in 0..self.derivative_columns.min(STRIDE - TAPS + 1) {
            let mx = along::<F, FMA>(taps, &means[0], i);
            let my = along::<F, FMA>(taps, &means[1], i);
            let sq = along::<F, FMA>(taps, &means[2], i);
            let xy = along::<F, FMA>(taps, &means[3], i);
            let mxy = mx * my;
            let m2 = mx.fma::<FMA>(mx, my * my);
            let a1 = F::TWO.fma::<FMA>(mxy, c1);
            let a2 = F::TWO.fma::<FMA>(xy - mxy, c2);
            let b1 = m2 + c1;
            // Rounding can make a variance negative; b2 must not follow.
            let b2 = (sq - m2).max(F::ZERO) + c2;
            let inv = F::ONE / (b1 * b2);
            let ssim = a1 * a2 * inv;
            let w = s.weights[i];
            let wi = w * inv;
            da[i] = F::TWO * wi * my.fma::<FMA>(a2 - a1, mx * ssim * (b1 - b2));
            db[i] = -(ssim * b1 * wi);
            dc[i] = F::TWO * a1 * wi;
            map[i] = ssim * w;
        }
        let own = (REACH..self.rows + REACH).contains(&row);
        if own { sum(&map[REACH..REACH + self.columns]) } else { 0.0 }
    }

    /// Horizontal means of the derivatives of one row of a group, and the gradient; returns Σ w|x − y| and Σ w e².
    #[inline(always)]
    fn gradient<const FMA: bool>(&self, s: &mut Scratch<F>, row: usize, in_group: usize, d: &mut [F]) -> [f64; 2] {
        if self.job.weight.is_some() {
            self.fill_weights(s, row + REACH);
        }
        let (means, _) = s.means[in_group * DERIVATIVES..].split_first_chunk::<DERIVATIVES>().expect("a row of means");
        let slot = (row + 2 * REACH) % RING * MOMENTS;
        let (px, py) = (&s.products[slot], &s.products[slot + 1]);
        let [out, l1, square] = s.row.first_chunk_mut::<3>().expect("three rows of results");
        let taps = &self.job.taps;
        let (d_l1, d_ssim) = (self.job.d_l1, self.job.d_ssim);
        for i in 0..self.columns.min(STRIDE - TAPS + 1 - REACH) {
            let da = along::<F, FMA>(taps, &means[0], i);
            let db = along::<F, FMA>(taps, &means[1], i);
            let dc = along::<F, FMA>(taps, &means[2], i);
            let (x, y, w) = (px[i + 2 * REACH], py[i + 2 * REACH], s.weights[i + REACH]);
            let diff = x - y;
            let sign = if diff > F::ZERO { F::ONE } else { F::ZERO } - if diff < F::ZERO { F::ONE } else { F::ZERO };
            let inside = if w > F::ZERO { d_ssim } else { F::ZERO };
            let chain = (F::TWO * x).fma::<FMA>(db, y.fma::<FMA>(dc, da));
            out[i] = chain.fma::<FMA>(inside, sign * w * d_l1);
            l1[i] = diff.abs() * w;
            let shown = if x < F::ZERO { F::ZERO } else { x };
            let e = if shown > F::ONE { F::ONE } else { shown } - y;
            square[i] = e * e * w;
        }
        d[row * self.job.width + self.x0..][..self.columns].copy_from_slice(&out[..self.columns]);
        [sum(&l1[..self.columns]), sum(&square[..self.columns])]
    }
}

/// The windowed sum along a row; reads columns `i..i+11`.
#[inline(always)]
fn along<F: Real, const FMA: bool>(taps: &[F; TAPS], row: &[F; STRIDE], i: usize) -> F {
    weigh::<F, FMA>(taps, &row[i..i + TAPS], 0)
}

/// Windowed sums down the columns for [`GROUP`] rows of `MAPS` maps; the first reads ring rows `from..from+11`.
#[inline(always)]
fn vertical<F: Real, const FMA: bool, const MAPS: usize>(
    taps: &[F; TAPS],
    ring: &[[F; STRIDE]],
    from: usize,
    columns: usize,
    out: &mut [[F; STRIDE]],
) {
    let ring = &ring[..RING * MAPS];
    let (out, _) = out.as_chunks_mut::<MAPS>();
    for map in 0..MAPS {
        let rows: [&[F; STRIDE]; SPAN] = std::array::from_fn(|t| &ring[(from + t) % RING * MAPS + map]);
        let [o0, o1, o2, o3] = out.first_chunk_mut::<GROUP>().expect("a group of rows").each_mut().map(|m| &mut m[map]);
        for i in 0..columns.min(STRIDE) {
            let v: [F; SPAN] = std::array::from_fn(|t| rows[t][i]);
            o0[i] = weigh::<F, FMA>(taps, &v, 0);
            o1[i] = weigh::<F, FMA>(taps, &v, 1);
            o2[i] = weigh::<F, FMA>(taps, &v, 2);
            o3[i] = weigh::<F, FMA>(taps, &v, 3);
        }
    }
}

/// Σ taps[t]·v[from + t], by the window's symmetry.
#[inline(always)]
fn weigh<F: Real, const FMA: bool>(taps: &[F; TAPS], v: &[F], from: usize) -> F {
    let mut acc = v[from + REACH] * taps[REACH];
    for t in 0..REACH {
        acc = (v[from + t] + v[from + TAPS - 1 - t]).fma::<FMA>(taps[t], acc);
    }
    acc
}

/// Sum of a row: lane by lane, then in f64.
#[inline(always)]
fn sum<F: Real>(row: &[F]) -> f64 {
    let mut acc = [F::ZERO; LANES];
    let chunks = row.chunks_exact(LANES);
    let rest: f64 = chunks.remainder().iter().map(|x| x.f64()).sum();
    for c in chunks {
        for l in 0..LANES {
            acc[l] += c[l];
        }
    }
    acc.iter().map(|x| x.f64()).sum::<f64>() + rest
}
