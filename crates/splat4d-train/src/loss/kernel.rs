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
//! Only the sum of the two variances occurs, so four moments do (x, y, xx+yy, xy), not five. Four rows at a time pass
//! through the stages: products → vertical means → horizontal means and S's derivatives → vertical means → horizontal
//! means and the gradient. Products and derivatives are in rings of 16 rows, which stay in the second-level cache. The
//! loops are plain ones over a row, because LLVM vectorises those reliably, and blocks of lanes it does not.
//!
//! A windowed sum is eleven loads, five additions and six multiply-adds, so loads are what it waits for: scratch rows
//! start at cache lines, rings are arrays whose offsets are constants, and sums are kept by column until a strip ends.

use splat4d::math::Real;
use splat4d::simd::{Pass, each};

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
/// Rows that pass the pipeline together; a vertical pass then loads 14 rows for 44 products.
const GROUP: usize = 4;
/// Rows a group's window spans.
const SPAN: usize = GROUP + TAPS - 1;
/// Rows in a ring: a span, rounded up to a power of two.
const RING: usize = 16;
/// Rows by which the position of the gradient's derivatives in the ring, ten rows back, is past a whole group.
const LAG: usize = (RING - 2 * REACH) % GROUP;
/// Moments (x, y, xx+yy, xy) and derivatives.
const MOMENTS: usize = 4;
const DERIVATIVES: usize = 3;
/// Widest run of columns worked on at a time, so that the rings fit the second-level cache.
const MAX_COLUMNS: usize = 512;
/// Numbers in a scratch row, whole cache lines: columns, the products' halo on both sides, and space for [`READ`] from
/// the derivatives' first column on.
const STRIDE: usize = MAX_COLUMNS + 3 * PRODUCT_HALO;
/// Most numbers that a horizontal pass reads of a row: a window's rest more than it makes.
const READ: usize = MAX_COLUMNS + 2 * DERIVATIVE_HALO + TAPS - 1;
/// Columns of derivatives and of products on either side of the gradient's: a window's reach and twice that, in whole
/// lanes.
const DERIVATIVE_HALO: usize = 8;
const PRODUCT_HALO: usize = 16;
/// First column of a window less the column of its result, one pass being a halo of 8 further in.
const SHIFT: usize = DERIVATIVE_HALO - REACH;

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

/// Rows of maps.
type Rows<F, const MAPS: usize, const N: usize> = [[[F; STRIDE]; MAPS]; N];

/// Starts at a cache line, as every row then does: half the registers of a row elsewhere would span two lines.
#[derive(Debug)]
#[repr(align(64))]
struct Lines<T>(T);

/// Working rows of one thread.
#[derive(Debug)]
pub(super) struct Scratch<F> {
    /// Ring of products, `[RING, MOMENTS, STRIDE]`.
    products: Box<Lines<Rows<F, MOMENTS, RING>>>,
    /// Ring of S's derivatives ½∂S/∂⟨x⟩, −∂S/∂⟨xx+yy⟩, ½∂S/∂⟨xy⟩, which need fewest operations,
    /// `[RING, DERIVATIVES, STRIDE]`.
    derivatives: Box<Lines<Rows<F, DERIVATIVES, RING>>>,
    /// Vertical means of one group of moments, `[GROUP, MOMENTS, STRIDE]`; zero outside the image.
    moments: Box<Lines<Rows<F, MOMENTS, GROUP>>>,
    /// Vertical means of one group of derivatives, `[GROUP, DERIVATIVES, STRIDE]`.
    means: Box<Lines<Rows<F, DERIVATIVES, GROUP>>>,
    /// Weights of a row of derivatives, 0 outside the image, `[STRIDE]`.
    weights: Box<Lines<[F; STRIDE]>>,
    /// The sums, by column: |x − y|, S and squared error, with weights.
    totals: Box<Lines<[[F; STRIDE]; 3]>>,
}

impl<F: Real> Scratch<F> {
    /// Rows for any strip.
    pub(crate) fn new() -> Self {
        Self {
            products: Box::new(Lines([[[F::ZERO; STRIDE]; MOMENTS]; RING])),
            derivatives: Box::new(Lines([[[F::ZERO; STRIDE]; DERIVATIVES]; RING])),
            moments: Box::new(Lines([[[F::ZERO; STRIDE]; MOMENTS]; GROUP])),
            means: Box::new(Lines([[[F::ZERO; STRIDE]; DERIVATIVES]; GROUP])),
            weights: Box::new(Lines([F::ZERO; STRIDE])),
            totals: Box::new(Lines([[F::ZERO; STRIDE]; 3])),
        }
    }
}

impl<F: Real> Pass for Strip<'_, F> {
    type Scratch = Scratch<F>;
    type Into = [F];
    type Out = [f64; 3];

    /// [Σ w|x − y|, Σ w S, Σ w e²] over the strip, e the error of the render clamped to [0, 1]; writes its gradient
    /// into `d` ([rows, width]).
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

/// Some columns of a strip. Its derivative row i is the image's `first − 5 + i`, its product row i the image's
/// `first − 10 + i`: a derivative at i then needs the products i..i+11, the gradient at i the derivatives i..i+11.
/// Columns have halos of [`DERIVATIVE_HALO`] and [`PRODUCT_HALO`] instead; nothing outside the image is computed.
struct Tile<'a, F> {
    job: &'a Strip<'a, F>,
    x0: usize,
    columns: usize,
    rows: usize,
    /// Scratch columns of derivatives that are in the image, rounded up to whole lanes.
    derivatives: [usize; 2],
    /// Scratch columns of products that are in the image.
    products: [usize; 2],
}

impl<'a, F: Real> Tile<'a, F> {
    fn new(job: &'a Strip<'a, F>, x0: usize, columns: usize, rows: usize) -> Self {
        let [start, end] = inside(job.width, x0, DERIVATIVE_HALO, columns + 2 * DERIVATIVE_HALO);
        let derivatives = [start, end.next_multiple_of(LANES)];
        let products = inside(job.width, x0, PRODUCT_HALO, columns + 2 * PRODUCT_HALO);
        Self { job, x0, columns, rows, derivatives, products }
    }

    #[inline(always)]
    fn walk<const FMA: bool>(&self, s: &mut Scratch<F>, d: &mut [F]) -> [f64; 3] {
        s.totals.0.as_flattened_mut().fill(F::ZERO);
        clear(&mut s.products.0[..], self.products);
        clear(&mut s.moments.0[..], self.products);
        clear(&mut s.derivatives.0[..], self.derivatives);
        clear(&mut s.means.0[..], self.derivatives);
        self.fill_weights(s, 0);
        for row in 0..2 * REACH {
            self.fill_products::<FMA>(s, row);
        }
        // At `head`, derivative rows head..head+4 are made, and with them gradient rows head−10..head−6.
        let mut head = 0;
        while head < self.rows + 2 * REACH {
            for row in 0..GROUP {
                self.fill_products::<FMA>(s, head + 2 * REACH + row);
            }
            vertical::<F, FMA, MOMENTS, 0>(&self.job.taps, &s.products.0, head, self.products, &mut s.moments.0);
            for row in 0..GROUP {
                self.derivatives::<FMA>(s, head + row, row);
            }
            if head + GROUP > 2 * REACH {
                // A group that straddles the strip's first row reads rows before it from the ring; they are not used.
                vertical::<F, FMA, DERIVATIVES, LAG>(
                    &self.job.taps,
                    &s.derivatives.0,
                    head + RING - 2 * REACH - LAG,
                    self.derivatives,
                    &mut s.means.0,
                );
                for row in 0..GROUP {
                    if (2 * REACH..self.rows + 2 * REACH).contains(&(head + row)) {
                        self.gradient::<FMA>(s, head + row - 2 * REACH, row, d);
                    }
                }
            }
            head += GROUP;
        }
        let [l1, ssim, square] = &s.totals.0;
        let own = DERIVATIVE_HALO..DERIVATIVE_HALO + self.columns;
        [sum(&l1[..self.columns]), sum(&ssim[own]), sum(&square[..self.columns])]
    }

    /// The image's row for derivative row `row`, if it has one.
    #[inline(always)]
    fn image_row(&self, row: usize, halo: usize) -> Option<usize> {
        (self.job.first + row).checked_sub(halo).filter(|&y| y < self.job.height)
    }

    /// Weights of the image row that derivative row `row` represents.
    #[inline(always)]
    fn fill_weights(&self, s: &mut Scratch<F>, row: usize) {
        let [start, end] = inside(self.job.width, self.x0, DERIVATIVE_HALO, self.columns + 2 * DERIVATIVE_HALO);
        match (self.job.weight, self.image_row(row, REACH)) {
            (None, _) => {
                s.weights.0.fill(F::ZERO);
                s.weights.0[start..end].fill(F::ONE);
            }
            (Some(weight), Some(y)) => {
                let from = y * self.job.width + self.x0 + start - DERIVATIVE_HALO;
                s.weights.0.fill(F::ZERO);
                s.weights.0[start..end].copy_from_slice(&weight[from..from + end - start]);
            }
            (Some(_), None) => s.weights.0.fill(F::ZERO),
        }
    }

    /// Products of one row; zero outside the image and where the weight is zero.
    #[inline(always)]
    fn fill_products<const FMA: bool>(&self, s: &mut Scratch<F>, row: usize) {
        let [start, end] = self.products;
        let out = s.products.0[row % RING].each_mut().map(|part| &mut part[start..end]);
        let Some(y) = self.image_row(row, 2 * REACH) else {
            out.into_iter().for_each(|part| part.fill(F::ZERO));
            return;
        };
        let from = y * self.job.width + self.x0 + start - PRODUCT_HALO;
        let (render, truth) = (&self.job.render[from..from + end - start], &self.job.truth[from..from + end - start]);
        let [a, b, c, e] = out;
        match self.job.weight {
            None => products::<F, FMA>(render, truth, a, b, c, e),
            Some(weight) => {
                let weight = &weight[from..from + end - start];
                products_in::<F, FMA>(weight, render, truth, a, b, c, e);
            }
        }
    }

    /// Horizontal means of one row of a group, S and its weighted derivatives.
    #[inline(always)]
    fn derivatives<const FMA: bool>(&self, s: &mut Scratch<F>, row: usize, in_group: usize) {
        if self.image_row(row, REACH).is_none() {
            s.derivatives.0[row % RING].as_flattened_mut().fill(F::ZERO);
            return;
        }
        if self.job.weight.is_some() {
            self.fill_weights(s, row);
        }
        let (out, means) = (&mut s.derivatives.0[row % RING], &s.moments.0[in_group]);
        let total = &mut s.totals.0[1];
        let twice = if (REACH..self.rows + REACH).contains(&row) { F::TWO } else { F::ZERO };
        let taps = &self.job.taps;
        let (c1, c2) = (F::of(C1), F::of(C2));
        let [start, end] = self.derivatives;
        // Arrays and a length that the compiler can prove to be within them: no bound is checked in the loop.
        let n = (end - start).min(READ - TAPS + 1);
        let [x, y, squares, cross] = means.each_ref().map(|row| read(row, start + SHIFT));
        let [da, db, dc] = out.each_mut().map(|row| write(row, start));
        let (weights, total) = (read(&s.weights.0, start), write(total, start));
        for i in 0..n {
            let mx = along::<F, FMA>(taps, x, i);
            let my = along::<F, FMA>(taps, y, i);
            let sq = along::<F, FMA>(taps, squares, i);
            let xy = along::<F, FMA>(taps, cross, i);
            let mxy = mx * my;
            let m2 = mx.fma::<FMA>(mx, my * my);
            let half_a1 = mxy + c1 * F::HALF;
            let half_a2 = (xy - mxy) + c2 * F::HALF;
            let b1 = m2 + c1;
            // Rounding can make a variance negative; b2 must not follow.
            let b2 = (sq - m2).max(F::ZERO) + c2;
            let inv = F::TWO / (b1 * b2);
            let half_s = half_a1 * half_a2 * inv;
            let w = weights[i];
            let wi = w * inv;
            da[i] = wi * my.fma::<FMA>(half_a2 - half_a1, mx * half_s * (b1 - b2));
            db[i] = half_s * b1 * wi;
            dc[i] = half_a1 * wi;
            total[i] += half_s * (w * twice);
        }
    }

    /// Horizontal means of the derivatives of one row of a group, and the gradient.
    #[inline(always)]
    fn gradient<const FMA: bool>(&self, s: &mut Scratch<F>, row: usize, in_group: usize, d: &mut [F]) {
        if self.job.weight.is_some() {
            self.fill_weights(s, row + REACH);
        }
        let means = &s.means.0[in_group];
        let [px, py, ..] = &s.products.0[(row + 2 * REACH) % RING];
        let [l1, _, square] = &mut s.totals.0;
        let d = &mut d[row * self.job.width + self.x0..][..self.columns];
        let taps = &self.job.taps;
        let (d_l1, twice) = (self.job.d_l1, F::TWO * self.job.d_ssim);
        let n = d.len().min(READ - TAPS + 1);
        let [a, b, c] = means.each_ref().map(|row| read(row, SHIFT));
        let d = &mut d[..n];
        let (px, py) = (read(px, PRODUCT_HALO), read(py, PRODUCT_HALO));
        let (weights, l1, square) = (read(&s.weights.0, DERIVATIVE_HALO), write(l1, 0), write(square, 0));
        for i in 0..n {
            let da = along::<F, FMA>(taps, a, i);
            let db = along::<F, FMA>(taps, b, i);
            let dc = along::<F, FMA>(taps, c, i);
            let (x, y, w) = (px[i], py[i], weights[i]);
            let diff = x - y;
            let sign = if diff > F::ZERO { F::ONE } else { F::ZERO } - if diff < F::ZERO { F::ONE } else { F::ZERO };
            let inside = if w > F::ZERO { twice } else { F::ZERO };
            let chain = y.fma::<FMA>(dc, (-x).fma::<FMA>(db, da));
            d[i] = chain.fma::<FMA>(inside, sign * w * d_l1);
            l1[i] += diff.abs() * w;
            let shown = if x < F::ZERO { F::ZERO } else { x };
            let e = if shown > F::ONE { F::ONE } else { shown } - y;
            square[i] += e * e * w;
        }
    }
}

/// The part of a row that a horizontal pass reads.
#[inline(always)]
fn read<F>(row: &[F; STRIDE], from: usize) -> &[F; READ] {
    row[from..].first_chunk().expect("a row has room for the widest tile")
}

/// The part of a row that a horizontal pass writes.
#[inline(always)]
fn write<F>(row: &mut [F; STRIDE], from: usize) -> &mut [F; READ] {
    row[from..].first_chunk_mut().expect("a row has room for the widest tile")
}

/// The windowed sum along a row; reads columns `i..i+11`.
#[inline(always)]
fn along<F: Real, const FMA: bool>(taps: &[F; TAPS], row: &[F; READ], i: usize) -> F {
    weigh::<F, FMA>(taps, &row[i..i + TAPS], 0)
}

/// The scratch columns that are in the image, of `count` with this halo; the first is image column
/// `x0 + start − halo`.
#[inline(always)]
fn inside(width: usize, x0: usize, halo: usize, count: usize) -> [usize; 2] {
    [halo.saturating_sub(x0), count.min(width + halo - x0)]
}

/// Zeroes what is next to these columns.
fn clear<F: Real, const MAPS: usize>(rows: &mut [[[F; STRIDE]; MAPS]], [start, end]: [usize; 2]) {
    for part in rows.as_flattened_mut() {
        part[..start].fill(F::ZERO);
        part[end..].fill(F::ZERO);
    }
}

/// x, y, xx + yy and xy of a row.
#[inline(always)]
fn products<F: Real, const FMA: bool>(x: &[F], y: &[F], a: &mut [F], b: &mut [F], c: &mut [F], e: &mut [F]) {
    let n = x.len();
    let (y, a, b, c, e) = (&y[..n], &mut a[..n], &mut b[..n], &mut c[..n], &mut e[..n]);
    for i in 0..n {
        (a[i], b[i]) = (x[i], y[i]);
        c[i] = x[i].fma::<FMA>(x[i], y[i] * y[i]);
        e[i] = x[i] * y[i];
    }
}

/// The same, zero where the weight is zero.
#[inline(always)]
fn products_in<F: Real, const FMA: bool>(
    weight: &[F],
    x: &[F],
    y: &[F],
    a: &mut [F],
    b: &mut [F],
    c: &mut [F],
    e: &mut [F],
) {
    let n = x.len();
    let (w, y, a, b, c, e) = (&weight[..n], &y[..n], &mut a[..n], &mut b[..n], &mut c[..n], &mut e[..n]);
    for i in 0..n {
        let x = if w[i] > F::ZERO { x[i] } else { F::ZERO };
        let y = if w[i] > F::ZERO { y[i] } else { F::ZERO };
        (a[i], b[i]) = (x, y);
        c[i] = x.fma::<FMA>(x, y * y);
        e[i] = x * y;
    }
}

/// Windowed sums down these columns for [`GROUP`] rows of `MAPS` maps; the first reads ring rows
/// `head + PHASE..head + PHASE + 11`, `head` whole groups.
#[inline(always)]
fn vertical<F: Real, const FMA: bool, const MAPS: usize, const PHASE: usize>(
    taps: &[F; TAPS],
    ring: &Rows<F, MAPS, RING>,
    head: usize,
    columns: [usize; 2],
    out: &mut Rows<F, MAPS, GROUP>,
) {
    // Where the group is in the ring is a constant of each copy of the loop, which then needs one pointer, not 14.
    match head % RING / GROUP {
        0 => vertical_at::<F, FMA, MAPS>(taps, ring, PHASE, columns, out),
        1 => vertical_at::<F, FMA, MAPS>(taps, ring, GROUP + PHASE, columns, out),
        2 => vertical_at::<F, FMA, MAPS>(taps, ring, 2 * GROUP + PHASE, columns, out),
        _ => vertical_at::<F, FMA, MAPS>(taps, ring, 3 * GROUP + PHASE, columns, out),
    }
}

/// The same from one position of the ring on.
#[inline(always)]
fn vertical_at<F: Real, const FMA: bool, const MAPS: usize>(
    taps: &[F; TAPS],
    ring: &Rows<F, MAPS, RING>,
    from: usize,
    [start, end]: [usize; 2],
    out: &mut Rows<F, MAPS, GROUP>,
) {
    for map in 0..MAPS {
        for i in start..end.min(STRIDE) {
            let v: [F; SPAN] = each(|t| ring[(from + t) % RING][map][i]);
            out[0][map][i] = weigh::<F, FMA>(taps, &v, 0);
            out[1][map][i] = weigh::<F, FMA>(taps, &v, 1);
            out[2][map][i] = weigh::<F, FMA>(taps, &v, 2);
            out[3][map][i] = weigh::<F, FMA>(taps, &v, 3);
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
