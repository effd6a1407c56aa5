//! How strongly a picture answers to each splat: sums of squared gradients over pixels and channels, in a walk of its own.
//!
//! A pixel's channels depend on a splat's shape through ln α alone, with the slope v_c = αT(c − b), b the colour of all that
//! lies behind, and ln α = ln o − ½ dᵀ Q d, d = μ − p, Q the conic. Its gradient to (μ, Q) is a polynomial s(d) of second
//! degree, so that Σ over pixels and channels of the products of gradients is known from the moments Σ_p (Σ_c v_c²) dx^i dy^j
//! of degree 2 to 4: twelve sums a splat, exact. Slow and clear: it is meant for scores, not for steps.

use super::behind::{Behind, Pixel, Tally};
use super::bin::{BIN, Footprint, id};
use super::blend::Limits;
use super::gather::TILES;
use super::parallel::{Ragged, for_each_group};
use super::project::{Projected, ProjectedGrads, View, project_backward};
use super::rasterize::{CHANNELS, Raster};
use super::simd::{Simd, dispatch, select};
use crate::math::{Real, sym3};
use crate::scene::Splats;
use crate::scene::splats::{COV, SPLAT_OPACITY};
use rayon::prelude::*;
use std::marker::PhantomData;

/// Powers of dx and dy whose products with Σ_c v_c² are summed.
const POWERS: [[usize; 2]; 12] =
    [[2, 0], [1, 1], [0, 2], [3, 0], [2, 1], [1, 2], [0, 3], [4, 0], [3, 1], [2, 2], [1, 3], [0, 4]];
/// The moments, and Σ of (Σ_c v_c²)/α².
const NUMBERS: usize = POWERS.len() + 1;

/// How a picture answers to one splat.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sensitivity {
    /// Upper triangle, row by row, of the 6x6 block Σ over pixels and channels of ∇I ∇Iᵀ with respect to the mean (3, world) and
    /// the standard deviations along the covariance's axes (3, longest first), scene units⁻². Colour does not count as
    /// depending on the direction. Source: PUP 3D-GS (Hanson et al. 2025), its spatial Fisher block.
    pub fisher: [f64; 21],
    /// Σ over pixels and channels of (dI/dg)², g the splat's bare bell e^(−½ dᵀ Q d). Source: Speedy-Splat (Hanson et al.
    /// 2025), its efficient pruning score.
    pub squared: f64,
}

impl<F: Real> Raster<F> {
    /// After [`Raster::blend`] of `channels`: the sums of every splat into `out`, which is overwritten.
    fn sense(
        &mut self,
        projected: &[Projected<F>],
        footprints: &[Footprint],
        (channels, background): (&[[F; CHANNELS]], [F; CHANNELS]),
        limits: Limits<F>,
        out: &mut [[f64; NUMBERS]],
    ) {
        out.fill([0.0; NUMBERS]);
        for run in 0..self.bins.runs.len() {
            self.hold(projected, footprints, run);
            let (simd, bins) = (self.simd.unwrap_or(Simd::Scalar), &self.bins);
            let (width, height, tiles) = (self.width, self.height, &self.tiles);
            let mut sums = vec![[F::ZERO; NUMBERS]; bins.keys.len()];
            let held = &bins.runs[bins.current];
            for_each_group(&bins.starts, (Ragged(&mut self.records), Ragged(&mut sums)), &|bin, (records, sums)| {
                if !held.contains(&bin) {
                    return;
                }
                let (start, end) = (bins.starts[bin] as usize, bins.starts[bin + 1] as usize);
                for (r, key) in records.0.iter_mut().zip(&bins.keys[start..end]) {
                    r.channels = channels[id(*key)];
                }
                let inside = [width - bin % bins.across * BIN, height - bin / bins.across * BIN];
                let tiles = &tiles[bin * TILES..(bin + 1) * TILES];
                let (records, out, tally) = (&*records.0, sums.0, PhantomData::<Sensed>);
                dispatch(simd, Behind { records, tiles, background, inside, limits, out, tally });
            });
            // Pairs in the order of bins: the order of a sum does not depend on threads.
            for bin in held.clone() {
                for pair in bins.starts[bin] as usize..bins.starts[bin + 1] as usize {
                    let out = &mut out[id(bins.keys[pair])];
                    (0..NUMBERS).for_each(|k| out[k] += sums[pair][k].f64());
                }
            }
        }
    }
}

impl<F: Real> super::Renderer<F> {
    /// How strongly the picture over `background` answers to each splat: exact sums over its pixels, for splats that stay in
    /// front of and behind the same others. A head is not looked at: the picture is that of the base colours.
    ///
    /// `out` is overwritten, one a splat; zeros where no pixel shows it. Draws by itself; no backward may follow.
    pub fn sensitivities(
        &mut self,
        splats: &Splats<'_, F>,
        camera: &crate::scene::Camera,
        background: [F; 3],
        out: &mut Vec<Sensitivity>,
    ) {
        let view = self.list(splats, camera);
        self.channels.resize(splats.len(), [F::ZERO; CHANNELS]);
        let (simd, degree) = (self.config.simd, self.config.sh_degree);
        super::shade::forward(splats, &view, degree, simd, &self.projected, &mut self.channels);
        self.raster.blend(&self.projected, &self.footprints, &self.channels, &self.config);
        let mut sums = vec![[0.0; NUMBERS]; splats.len()];
        let limits = Limits::new(&self.config);
        let light = (&self.channels[..], background);
        self.raster.sense(&self.projected, &self.footprints, light, limits, &mut sums);
        out.clear();
        out.resize(splats.len(), Sensitivity::default());
        let mut first = 0;
        for part in &splats.parts {
            let count = part.out.rows();
            let rows = out[first..first + count].par_iter_mut().enumerate().with_min_len(256);
            rows.for_each(|(j, out)| {
                let (row, sums) = (&self.projected[first + j], &sums[first + j]);
                if row.radius > F::ZERO && sums[NUMBERS - 1] > 0.0 {
                    let geometry = (part.out.read(j, 0), part.out.read(j, COV), part.out.get(j, SPLAT_OPACITY));
                    let opacity = row.opacity.f64();
                    let squared = sums[NUMBERS - 1] * opacity * opacity;
                    *out = Sensitivity { fisher: fisher(&view, geometry, row, sums), squared };
                }
            });
            first += count;
        }
    }
}

/// J M Jᵀ: M the moments of s sᵀ, J the way from (μ, Q) to mean and standard deviations.
fn fisher<F: Real>(
    view: &View<F>,
    (mean, cov, opacity): ([F; 3], [F; 6], F),
    row: &Projected<F>,
    sums: &[f64; NUMBERS],
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
        // d/d s_k of Σ s² v vᵀ is 2 s v vᵀ; a packed off-diagonal stands for both places.
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

/// What a pixel adds to the moments.
struct Sensed;

impl<F: Real> Tally<F, NUMBERS> for Sensed {
    #[inline(always)]
    fn of(pixel: &Pixel<F>) -> [F; NUMBERS] {
        let mut square = F::ZERO;
        for c in 0..CHANNELS {
            let v = pixel.own[c] - pixel.hidden[c];
            square += v * v;
        }
        // Nothing passes where α is 0 or at its ceiling.
        let (square, [dx, dy], a) = (select(pixel.felt, square, F::ZERO), pixel.offset, pixel.alpha);
        let power = |base: F, n: usize| (0..n).fold(F::ONE, |p, _| p * base);
        let mut out = [F::ZERO; NUMBERS];
        for (out, [m, n]) in out.iter_mut().zip(POWERS) {
            *out = square * power(dx, m) * power(dy, n);
        }
        out[NUMBERS - 1] = select(pixel.felt, square / (a * a), F::ZERO);
        out
    }
}
