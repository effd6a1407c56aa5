//! From a Gaussian in the world to an ellipse on the screen (EWA splatting), and back.
//!
//! Source: Zwicker et al. 2001; Kerbl et al. 2023 section 4; clamp of x/z and y/z inside J and the compensation ρ as
//! in gsplat; no 3σ cap on the extent (SnugBox, Hanson et al. 2024).

use super::bin::{BIN, Footprint, MASK_SIDE};
use super::simd::{Kernel, Simd, dispatch, greatest, least, select};
use super::{Antialias, PartGrads, RenderConfig};
use crate::math::Real;
use crate::math::vec3::dot;
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::{BLOCK, Camera, Splats, Table};
use rayon::prelude::*;

#[cfg(test)]
mod tests;

/// x/z inside J may leave the image by this share of its half-width's tangent (Inria, gsplat).
const J_MARGIN: f64 = 0.3;
/// Least compensation ρ of the antialiased mode (gsplat).
const RHO_MIN: f64 = 0.005;
/// Added to τ, so that rounding never loses a pixel at the α cut-off; the blend decides about each pixel itself.
pub(super) const TAU_MARGIN: f64 = 1e-3;
/// Radius in standard deviations that `radius` reports (Inria).
const RADIUS_SIGMAS: f64 = 3.0;
/// Rows in a task: whole blocks of a table.
pub(super) const CHUNK_ROWS: usize = 1024;

/// Numbers of the 16 splats of a table's block.
pub(super) type Lanes<F> = [F; BLOCK];

/// One splat on the screen. Plain old data.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Projected<F = f32> {
    /// Centre, pixels (the first pixel's centre is at 0.5).
    pub mean2d: [F; 2],
    /// Inverse of the screen covariance with low-pass: xx, xy, yy, px⁻².
    pub conic: [F; 3],
    /// Opacity, times ρ in the antialiased mode.
    pub opacity: F,
    /// z in camera axes.
    pub depth: F,
    /// 3σ of the larger axis, pixels; 0: culled, and nothing else in the row means anything.
    pub radius: F,
    /// Half width and height of the box of the ellipse on which α is the cut-off, pixels.
    pub half: [F; 2],
    /// dᵀ conic d on that ellipse.
    pub tau: F,
    /// The compensation ρ; 1 without antialiasing.
    pub rho: F,
}

impl<F: Real> Projected<F> {
    /// About how many pixels of an image of this size (width, height) it may touch: its ellipse's area, times the
    /// share of
    /// the ellipse's box that is in the image. 0: culled.
    pub fn pixels(&self, size: [usize; 2]) -> f64 {
        if self.radius <= F::ZERO {
            return 0.0;
        }
        let [a, b, c] = self.conic.map(Real::f64);
        let area = std::f64::consts::PI * self.tau.f64() / (a * c - b * b).sqrt();
        let inside = (0..2).map(|k| {
            let (at, half) = (self.mean2d[k].f64(), self.half[k].f64());
            ((at + half).min(size[k] as f64) - (at - half).max(0.0)).max(0.0) / (2.0 * half)
        });
        area * inside.product::<f64>()
    }
}

/// Gradient to one [`Projected`]. Plain old data.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ProjectedGrads<F = f32> {
    /// To the centre.
    pub mean2d: [F; 2],
    /// Sum over pixels of the absolute gradient to the centre (AbsGS).
    pub mean2d_abs: [F; 2],
    /// To the conic's three numbers.
    pub conic: [F; 3],
    /// To the opacity after compensation.
    pub opacity: F,
    /// To the depth.
    pub depth: F,
}

/// A camera and a configuration as the projection needs them.
#[derive(Clone, Copy, Debug)]
pub struct View<F = f32> {
    /// Rows of the rotation cam_from_world.
    pub rotation: [[F; 3]; 3],
    /// Translation of cam_from_world.
    pub translation: [F; 3],
    /// The camera's centre in the world.
    pub center: [F; 3],
    /// fx, fy, pixels.
    pub focal: [F; 2],
    /// cx, cy, pixels.
    pub principal: [F; 2],
    /// Least x/z and y/z inside J.
    pub low: [F; 2],
    /// Largest x/z and y/z inside J.
    pub high: [F; 2],
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    near: F,
    low_pass: F,
    alpha_min: F,
    antialias: Antialias,
}

impl<F: Real> View<F> {
    /// Of `camera` (rendered as a pinhole) under `config`.
    pub fn new(camera: &Camera, config: &RenderConfig) -> Self {
        let k = &camera.intrinsics;
        let pose = &camera.cam_from_world;
        let (w, h) = (camera.width as f64, camera.height as f64);
        let margin = [J_MARGIN * 0.5 * w / k.fx, J_MARGIN * 0.5 * h / k.fy];
        Self {
            rotation: pose.rotation.map(|r| r.map(F::of)),
            translation: pose.translation.map(F::of),
            center: camera.center().map(F::of),
            focal: [F::of(k.fx), F::of(k.fy)],
            principal: [F::of(k.cx), F::of(k.cy)],
            low: [F::of(-(k.cx / k.fx + margin[0])), F::of(-(k.cy / k.fy + margin[1]))],
            high: [F::of((w - k.cx) / k.fx + margin[0]), F::of((h - k.cy) / k.fy + margin[1])],
            width: camera.width,
            height: camera.height,
            near: F::of(camera.near),
            low_pass: F::of(config.low_pass),
            alpha_min: F::of(config.alpha_limits()[0]),
            antialias: config.antialias,
        }
    }
}

/// The part of a projection that forward and backward share.
struct Ellipse<F> {
    /// Mean in camera axes.
    p: [F; 3],
    inv_z: F,
    /// x/z, y/z.
    uv: [F; 2],
    /// The same inside J.
    clamped: [F; 2],
    /// M = J W, 2x3.
    m: [[F; 3]; 2],
    /// M Σ, 2x3.
    ms: [[F; 3]; 2],
    /// Screen covariance before the low-pass: xx, xy, yy.
    s0: [F; 3],
    /// Its determinant, never below 0.
    det0: F,
    /// Determinant after the low-pass.
    det1: F,
}

#[inline(always)]
fn sym_vec<F: Real>(s: [F; 6], v: [F; 3]) -> [F; 3] {
    [
        s[0] * v[0] + s[1] * v[1] + s[2] * v[2],
        s[1] * v[0] + s[3] * v[1] + s[4] * v[2],
        s[2] * v[0] + s[4] * v[1] + s[5] * v[2],
    ]
}

#[inline(always)]
fn in_camera<F: Real>(view: &View<F>, mean: [F; 3]) -> [F; 3] {
    let (r, t) = (&view.rotation, &view.translation);
    [dot(r[0], mean) + t[0], dot(r[1], mean) + t[1], dot(r[2], mean) + t[2]]
}

#[inline(always)]
fn ellipse<F: Real>(view: &View<F>, p: [F; 3], cov: [F; 6]) -> Ellipse<F> {
    let r = &view.rotation;
    let inv_z = F::ONE / p[2];
    let uv = [p[0] * inv_z, p[1] * inv_z];
    let clamped: [F; 2] = std::array::from_fn(|k| least(greatest(uv[k], view.low[k]), view.high[k]));
    // Row k of J W is (f_k/z)(W_k − clamped_k W_2).
    let m: [[F; 3]; 2] = std::array::from_fn(|k| {
        let s = view.focal[k] * inv_z;
        std::array::from_fn(|i| s * (r[k][i] - clamped[k] * r[2][i]))
    });
    let ms = [sym_vec(cov, m[0]), sym_vec(cov, m[1])];
    let s0 = [dot(ms[0], m[0]), dot(ms[0], m[1]), dot(ms[1], m[1])];
    // det(Σ0 + λI) = det Σ0 + λ tr Σ0 + λ²: written so, a needle's determinant cannot cancel to nothing.
    let det0 = greatest(s0[0] * s0[2] - s0[1] * s0[1], F::ZERO);
    let det1 = det0 + view.low_pass * (s0[0] + s0[2] + view.low_pass);
    Ellipse { p, inv_z, uv, clamped, m, ms, s0, det0, det1 }
}

/// ρ = √max(ρ_min², det Σ0/det Σ1), and whether it is at its floor.
#[inline(always)]
fn compensation<F: Real>(view: &View<F>, e: &Ellipse<F>) -> (F, bool) {
    if view.antialias == Antialias::Off {
        return (F::ONE, true);
    }
    let (square, floor) = (e.det0 / e.det1, F::of(RHO_MIN * RHO_MIN));
    let square = greatest(square, floor);
    (square.sqrt(), square == floor)
}

/// Projects one Gaussian: mean and packed covariance in the world, opacity in (0,1).
///
/// `None`, culled: z ≤ near, opacity (after ρ) below the α cut-off, determinant ≤ 0, anything not finite.
#[cfg(test)]
#[inline(always)]
pub(crate) fn project<F: Real>(view: &View<F>, mean: [F; 3], cov: [F; 6], opacity: F) -> Option<Projected<F>> {
    let (out, drawn) = screen(view, mean, cov, opacity);
    drawn.then_some(out)
}

/// `project` without a branch, so that a loop over it is a loop over vectors; `false`: culled, and any numbers.
#[inline(always)]
fn screen<F: Real>(view: &View<F>, mean: [F; 3], cov: [F; 6], opacity: F) -> (Projected<F>, bool) {
    let p = in_camera(view, mean);
    let e = ellipse(view, p, cov);
    let (xx, yy) = (e.s0[0] + view.low_pass, e.s0[2] + view.low_pass);
    let (rho, _) = compensation(view, &e);
    let shown = opacity * rho;
    let inv = F::ONE / e.det1;
    let tau = F::TWO * (shown / view.alpha_min).lane_ln() + F::of(TAU_MARGIN);
    let mid = F::HALF * (xx + yy);
    let largest = mid + greatest(mid * mid - e.det1, F::ZERO).sqrt();
    let out = Projected {
        mean2d: std::array::from_fn(|k| view.focal[k] * e.uv[k] + view.principal[k]),
        conic: [yy * inv, -e.s0[1] * inv, xx * inv],
        opacity: shown,
        depth: p[2],
        radius: F::of(RADIUS_SIGMAS) * largest.sqrt(),
        half: [(tau * xx).sqrt(), (tau * yy).sqrt()],
        tau,
        rho,
    };
    // A sum is finite only where all its terms are. Comparisons are phrased so that a NaN is culled too.
    let [x, y] = out.mean2d;
    let all = x + y + out.conic[0] + out.conic[1] + out.conic[2] + out.half[0] + out.half[1] + shown + p[2];
    let drawn = (p[2] > view.near)
        & (opacity >= view.alpha_min)
        & (shown >= view.alpha_min)
        & (e.det1 > F::ZERO)
        & (xx > F::ZERO)
        & (yy > F::ZERO)
        & all.is_finite()
        & (out.radius > F::ZERO);
    (out, drawn)
}

/// Numbers of a camera's gradient: six of its pose, one of its focal lengths.
pub(crate) const CAMERA: usize = 7;

/// Gradients of one Gaussian's inputs.
#[derive(Clone, Copy, Debug)]
pub(crate) struct GaussianGrads<F> {
    /// To the world mean.
    pub mean: [F; 3],
    /// To the six packed numbers of the world covariance.
    pub cov: [F; 6],
    /// To the opacity before compensation.
    pub opacity: F,
    /// To a left perturbation of cam_from_world: translation, rotation; then to the logarithm of the focal lengths,
    /// both at once.
    pub camera: [F; CAMERA],
}

/// VJP of `project` for a row that was not culled; without a branch.
///
/// Source: gsplat and Kerbl et al. 2023, appendix; d_conic → d_Σ' = −Σ'⁻¹ G Σ'⁻¹.
#[inline(always)]
pub(crate) fn project_backward<F: Real>(
    view: &View<F>,
    mean: [F; 3],
    cov: [F; 6],
    opacity: F,
    row: &Projected<F>,
    d: &ProjectedGrads<F>,
) -> GaussianGrads<F> {
    let e = ellipse(view, in_camera(view, mean), cov);
    let r = &view.rotation;
    let h = F::HALF;
    // Conic to Σ1, as a full symmetric matrix [xx, xy, yy].
    let k = row.conic;
    let g = [d.conic[0], h * d.conic[1], d.conic[2]];
    let kg = [
        [k[0] * g[0] + k[1] * g[1], k[0] * g[1] + k[1] * g[2]],
        [k[1] * g[0] + k[2] * g[1], k[1] * g[1] + k[2] * g[2]],
    ];
    let mut s = [
        -(kg[0][0] * k[0] + kg[0][1] * k[1]),
        -(kg[0][0] * k[1] + kg[0][1] * k[2]),
        -(kg[1][0] * k[1] + kg[1][1] * k[2]),
    ];
    // Opacity and ρ: ∂ρ²/∂Σ0 = adj(Σ0)/det Σ1 − ρ² Σ1⁻¹.
    let (rho, at_floor) = compensation(view, &e);
    if view.antialias == Antialias::On {
        let d_square = select(at_floor, F::ZERO, d.opacity * opacity / (F::TWO * rho));
        let (inv, square) = (F::ONE / e.det1, rho * rho);
        s[0] += d_square * (e.s0[2] * inv - square * k[0]);
        s[1] += d_square * (-e.s0[1] * inv - square * k[1]);
        s[2] += d_square * (e.s0[0] * inv - square * k[2]);
    }
    // Σ0 = M Σ Mᵀ.
    let m = &e.m;
    let gm: [[F; 3]; 2] = [
        std::array::from_fn(|i| s[0] * m[0][i] + s[1] * m[1][i]),
        std::array::from_fn(|i| s[1] * m[0][i] + s[2] * m[1][i]),
    ];
    let full = |i: usize, j: usize| m[0][i] * gm[0][j] + m[1][i] * gm[1][j];
    let d_cov = [full(0, 0), F::TWO * full(0, 1), F::TWO * full(0, 2), full(1, 1), F::TWO * full(1, 2), full(2, 2)];
    // d_M = 2 G M Σ, d_J = d_M Wᵀ.
    let d_m: [[F; 3]; 2] = [
        std::array::from_fn(|i| F::TWO * (s[0] * e.ms[0][i] + s[1] * e.ms[1][i])),
        std::array::from_fn(|i| F::TWO * (s[1] * e.ms[0][i] + s[2] * e.ms[1][i])),
    ];
    let d_j: [[F; 3]; 2] = std::array::from_fn(|a| std::array::from_fn(|b| dot(d_m[a], r[b])));
    // J = f/z (1, −clamped) in its two rows; the mean's path comes on top.
    let iz = e.inv_z;
    let mut d_p = [F::ZERO, F::ZERO, d.depth];
    // Longer focal lengths move the centre away from the principal point and stretch M; where J is clamped, its bound
    // is this many pixels, and its column of z stays.
    let mut d_focal = F::ZERO;
    for a in 0..2 {
        let f = view.focal[a];
        let stays = select(e.uv[a] == e.clamped[a], F::ZERO, d_j[a][2] * f * iz * e.clamped[a]);
        d_focal += d.mean2d[a] * f * e.uv[a] + dot(d_m[a], m[a]) + stays;
        let inside = select(e.uv[a] == e.clamped[a], d_j[a][2] * f * iz, F::ZERO);
        let d_uv = d.mean2d[a] * f - inside;
        d_p[a] += d_uv * iz;
        d_p[2] += -d_uv * e.uv[a] * iz - f * iz * iz * (d_j[a][a] - d_j[a][2] * e.clamped[a]);
    }
    let d_mean = std::array::from_fn(|i| r[0][i] * d_p[0] + r[1][i] * d_p[1] + r[2][i] * d_p[2]);
    // Q = Jᵀ d_J for the rotation's path through the covariance.
    let j = [
        [view.focal[0] * iz, F::ZERO, -view.focal[0] * iz * e.clamped[0]],
        [F::ZERO, view.focal[1] * iz, -view.focal[1] * iz * e.clamped[1]],
    ];
    let q = |a: usize, b: usize| j[0][a] * d_j[0][b] + j[1][a] * d_j[1][b];
    let p = e.p;
    let camera = [
        d_p[0],
        d_p[1],
        d_p[2],
        p[1] * d_p[2] - p[2] * d_p[1] + q(2, 1) - q(1, 2),
        p[2] * d_p[0] - p[0] * d_p[2] + q(0, 2) - q(2, 0),
        p[0] * d_p[1] - p[1] * d_p[0] + q(1, 0) - q(0, 1),
        d_focal,
    ];
    GaussianGrads { mean: d_mean, cov: d_cov, opacity: d.opacity * rho, camera }
}

/// Projects all splats and finds the bins that each can touch. A splat that touches no pixel is culled.
///
/// Shapes: `projected`, `footprints`, `radii` [all splats], overwritten; `radii` are those of the rows.
pub fn forward<F: Real>(
    splats: &Splats<'_, F>,
    view: &View<F>,
    simd: Simd,
    projected: &mut [Projected<F>],
    footprints: &mut [Footprint],
    radii: &mut [F],
) {
    let n = splats.len();
    assert!(projected.len() == n && footprints.len() == n && radii.len() == n, "one row a splat");
    let (mut rows, mut feet, mut radii) = (projected, footprints, radii);
    for part in &splats.parts {
        let n = part.out.rows();
        let head = rows.split_off_mut(..n).expect("as many rows as splats");
        let head_feet = feet.split_off_mut(..n).expect("as many footprints as splats");
        let head_radii = radii.split_off_mut(..n).expect("as many radii as splats");
        let tasks = head.par_chunks_mut(CHUNK_ROWS).zip(head_feet.par_chunks_mut(CHUNK_ROWS));
        tasks.zip(head_radii.par_chunks_mut(CHUNK_ROWS)).enumerate().for_each(|(chunk, ((rows, feet), radii))| {
            dispatch(simd, Forward { out: part.out, view, first: chunk * CHUNK_ROWS, rows, feet, radii });
        });
    }
}

/// The ten columns of a block of splats.
#[inline(always)]
fn columns<F: Real>(out: &Table<F>, block: usize) -> &[Lanes<F>; SPLAT_OPACITY + 1] {
    out.block(block).as_chunks().0.try_into().expect("a part's table has ten columns")
}

/// Mean, covariance and opacity of one lane of a block.
#[inline(always)]
fn gaussian<F: Real>(block: &[Lanes<F>; SPLAT_OPACITY + 1], l: usize) -> ([F; 3], [F; 6], F) {
    (std::array::from_fn(|k| block[k][l]), std::array::from_fn(|k| block[COV + k][l]), block[SPLAT_OPACITY][l])
}

/// One task's share of [`forward`].
struct Forward<'a, F> {
    out: &'a Table<F>,
    view: &'a View<F>,
    first: usize,
    rows: &'a mut [Projected<F>],
    feet: &'a mut [Footprint],
    radii: &'a mut [F],
}

impl<F: Real> Kernel for Forward<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let view = *self.view;
        let blocks = self.rows.chunks_mut(BLOCK).zip(self.feet.chunks_mut(BLOCK)).zip(self.radii.chunks_mut(BLOCK));
        for (g, ((rows, feet), radii)) in blocks.enumerate() {
            let block = columns(self.out, self.first / BLOCK + g);
            let mut p = Projected::<Lanes<F>>::default();
            let mut boxes = [[0i32; BLOCK]; 4];
            for l in 0..BLOCK {
                let (mean, cov, opacity) = gaussian(block, l);
                let (one, drawn) = screen(&view, mean, cov, opacity);
                let (bins, met) = bin_range(&one, &view);
                for k in 0..2 {
                    (p.mean2d[k][l], p.half[k][l]) = (one.mean2d[k], one.half[k]);
                }
                for k in 0..3 {
                    p.conic[k][l] = one.conic[k];
                }
                (p.opacity[l], p.depth[l], p.tau[l], p.rho[l]) = (one.opacity, one.depth, one.tau, one.rho);
                p.radius[l] = select(drawn & met, one.radius, F::ZERO);
                for k in 0..4 {
                    boxes[k][l] = bins[k];
                }
            }
            for (l, ((row, foot), radius)) in rows.iter_mut().zip(feet).zip(radii).enumerate() {
                if p.radius[l] > F::ZERO {
                    *row = lane(&p, l);
                    *foot = Footprint::of_bins(row, std::array::from_fn(|k| boxes[k][l]), &view);
                    *radius = row.radius;
                    if !foot.is_empty() {
                        continue;
                    }
                }
                (*row, *foot, *radius) = (Projected::default(), Footprint::default(), F::ZERO);
            }
        }
    }
}

/// One of sixteen rows.
#[inline(always)]
fn lane<F: Real>(p: &Projected<Lanes<F>>, l: usize) -> Projected<F> {
    Projected {
        mean2d: [p.mean2d[0][l], p.mean2d[1][l]],
        conic: [p.conic[0][l], p.conic[1][l], p.conic[2][l]],
        opacity: p.opacity[l],
        depth: p.depth[l],
        radius: p.radius[l],
        half: [p.half[0][l], p.half[1][l]],
        tau: p.tau[l],
        rho: p.rho[l],
    }
}

/// Splats that were projected: what shading reads, and the ways back.
#[derive(Clone, Copy, Debug)]
pub struct Projection<'a, F = f32> {
    /// The Gaussians.
    pub splats: &'a Splats<'a, F>,
    /// The camera, ready for the kernels.
    pub view: &'a View<F>,
    /// Instructions to use.
    pub simd: Simd,
    /// Their ellipses, one row a splat.
    pub projected: &'a [Projected<F>],
}

/// VJP of [`forward`]: overwrites `parts[..].out` (culled rows get 0) and adds to the camera's gradient.
///
/// `partial` is scratch. Sums run in a fixed order: rows in a chunk, then chunks.
pub(crate) fn backward<F: Real>(
    projection: &Projection<'_, F>,
    d: &[ProjectedGrads<F>],
    parts: &mut [PartGrads<F>],
    camera: &mut [f64; CAMERA],
    partial: &mut Vec<[f64; CAMERA]>,
) {
    let Projection { splats, view, simd, projected } = *projection;
    assert_eq!(parts.len(), splats.parts.len(), "one gradient a part");
    let mut first = 0;
    for (part, out) in splats.parts.iter().zip(parts) {
        let n = part.out.rows();
        let (rows, d_rows) = (&projected[first..first + n], &d[first..first + n]);
        first += n;
        let width = out.out.width();
        assert!(width == part.out.width() && out.out.rows() == n, "a part's gradient has the part's shape");
        let blocks = out.out.data_mut().par_chunks_mut(CHUNK_ROWS * width);
        blocks
            .zip(rows.par_chunks(CHUNK_ROWS).zip(d_rows.par_chunks(CHUNK_ROWS)))
            .enumerate()
            .map(|(chunk, (data, (rows, d)))| {
                dispatch(simd, Backward { out: part.out, view, first: chunk * CHUNK_ROWS, rows, d, data })
            })
            .collect_into_vec(partial);
        for sum in partial.iter() {
            for k in 0..CAMERA {
                camera[k] += sum[k];
            }
        }
    }
}

/// One task's share of [`backward`]; returns its sum of the camera's gradient.
struct Backward<'a, F> {
    out: &'a Table<F>,
    view: &'a View<F>,
    first: usize,
    rows: &'a [Projected<F>],
    d: &'a [ProjectedGrads<F>],
    /// Blocks of the gradient's table.
    data: &'a mut [F],
}

impl<F: Real> Kernel for Backward<'_, F> {
    type Out = [f64; CAMERA];
    #[inline(always)]
    fn run<const FMA: bool>(self) -> [f64; CAMERA] {
        let view = *self.view;
        let mut sums = [[0.0; BLOCK]; CAMERA];
        let (outs, _) = self.data.as_chunks_mut::<BLOCK>();
        let (outs, _) = outs.as_chunks_mut::<{ SPLAT_OPACITY + 1 }>();
        for (g, (out, (rows, d_rows))) in
            outs.iter_mut().zip(self.rows.chunks(BLOCK).zip(self.d.chunks(BLOCK))).enumerate()
        {
            *out = [[F::ZERO; BLOCK]; SPLAT_OPACITY + 1];
            if rows.iter().all(|row| row.radius <= F::ZERO) {
                continue;
            }
            let (mut conic, mut radius) = ([[F::ZERO; BLOCK]; 3], [F::ZERO; BLOCK]);
            let mut d = ProjectedGrads::<Lanes<F>>::default();
            for (l, (row, from)) in rows.iter().zip(d_rows).enumerate() {
                radius[l] = row.radius;
                for k in 0..3 {
                    (conic[k][l], d.conic[k][l]) = (row.conic[k], from.conic[k]);
                }
                (d.mean2d[0][l], d.mean2d[1][l]) = (from.mean2d[0], from.mean2d[1]);
                (d.opacity[l], d.depth[l]) = (from.opacity, from.depth);
            }
            let block = columns(self.out, self.first / BLOCK + g);
            let mut camera = [[F::ZERO; BLOCK]; CAMERA];
            for l in 0..BLOCK {
                let (mean, cov, opacity) = gaussian(block, l);
                let row = Projected { conic: std::array::from_fn(|k| conic[k][l]), ..Projected::default() };
                let d = ProjectedGrads {
                    mean2d: [d.mean2d[0][l], d.mean2d[1][l]],
                    conic: std::array::from_fn(|k| d.conic[k][l]),
                    opacity: d.opacity[l],
                    depth: d.depth[l],
                    ..ProjectedGrads::default()
                };
                let g = project_backward(&view, mean, cov, opacity, &row, &d);
                // Culled rows may hold NaN.
                let drawn = radius[l] > F::ZERO;
                for k in 0..3 {
                    out[k][l] = select(drawn, g.mean[k], F::ZERO);
                }
                for k in 0..6 {
                    out[COV + k][l] = select(drawn, g.cov[k], F::ZERO);
                }
                for k in 0..CAMERA {
                    camera[k][l] = select(drawn, g.camera[k], F::ZERO);
                }
                out[SPLAT_OPACITY][l] = select(drawn, g.opacity, F::ZERO);
            }
            for k in 0..CAMERA {
                for l in 0..BLOCK {
                    sums[k][l] += camera[k][l].f64();
                }
            }
        }
        sums.map(|lanes| lanes.iter().sum())
    }
}

/// A table [rows, 10] for the gradient of a part's `out`, reusing `table` where its shape allows.
pub(crate) fn reshape<F: Real>(table: &mut Table<F>, like: &Table<F>) {
    if table.width() == like.width() {
        table.resize(like.rows());
    } else {
        *table = Table::with_columns(like.columns().to_vec(), like.rows());
    }
}

/// First and last column and row of bins with pixels whose centres are in the box of the ellipse and in the image,
/// and whether there are any.
#[inline(always)]
fn bin_range<F: Real>(p: &Projected<F>, view: &View<F>) -> ([i32; 4], bool) {
    let size = [view.width, view.height];
    let mut out = [0; 4];
    let mut met = true;
    for k in 0..2 {
        // Pixel i has its centre at i + ½; −⌊−x⌋ is ⌈x⌉.
        let past = F::of(size[k] as f64);
        let first = greatest(-(F::HALF + p.half[k] - p.mean2d[k]).floor(), F::ZERO);
        let last = least((p.mean2d[k] + p.half[k] - F::HALF).floor(), past - F::ONE);
        met &= first <= last;
        out[2 * k] = least(first, past).lane_i32() >> BIN.ilog2();
        out[2 * k + 1] = greatest(last, F::ZERO).lane_i32() >> BIN.ilog2();
    }
    (out, met)
}

impl Footprint {
    /// The bins that hold a pixel centre inside the cut-off ellipse of `p` in the image of `view`.
    #[cfg(test)]
    pub(crate) fn new<F: Real>(p: &Projected<F>, view: &View<F>) -> Self {
        let (bins, met) = bin_range(p, view);
        if met { Self::of_bins(p, bins, view) } else { Self::default() }
    }

    /// `Footprint::new` of a box that has bins: first and last column, first and last row.
    #[inline(always)]
    fn of_bins<F: Real>(p: &Projected<F>, bins: [i32; 4], view: &View<F>) -> Self {
        let [x0, x1, y0, y1] = bins.map(|v| v as usize);
        let (right, lower) = (x1 - x0, y1 - y0);
        let depth = p.depth.f64() as f32;
        if right.max(lower) >= MASK_SIDE {
            return Self::rectangle([x0, x1 + 1, y0, y1 + 1], depth);
        }
        let columns = u64::from(u8::MAX) >> (MASK_SIDE - 1 - right);
        let rows = FIRST_COLUMN >> (MASK_SIDE * (MASK_SIDE - 1 - lower));
        let mut mask = columns * rows;
        // A connected ellipse meets every bin of a single row or column of its own box. Where the image's edge has cut
        // the box, a bin too many does no harm.
        if right.min(lower) > 0 {
            mask &= met_bins(p, [x0, y0], lower, view);
        }
        Self::masked([x0, y0], mask, depth)
    }
}

/// First bit of each row of a mask.
const FIRST_COLUMN: u64 = u64::from_ne_bytes([1; MASK_SIDE]);

/// Bit 8·row + column: the ellipse holds a point of the bin's box of pixel centres; of rows 0 to `lower`, and of eight
/// columns, a vector.
#[inline(always)]
fn met_bins<F: Real>(p: &Projected<F>, first: [usize; 2], lower: usize, view: &View<F>) -> u64 {
    let (y_slope, x_slope) = (-p.conic[1] / p.conic[2], -p.conic[1] / p.conic[0]);
    let (x0, y0) = (F::of((first[0] * BIN) as f64), F::of((first[1] * BIN) as f64));
    let (width, height) = (F::of(view.width as f64), F::of(view.height as f64));
    let mut mask = 0;
    for by in 0..=lower {
        let top = y0 + F::of((by * BIN) as f64);
        let y = [top + F::HALF - p.mean2d[1], least(top + F::of(BIN as f64), height) - F::HALF - p.mean2d[1]];
        let mut hits = [false; MASK_SIDE];
        for (bx, hit) in hits.iter_mut().enumerate() {
            let left = x0 + F::of((bx * BIN) as f64);
            let x = [left + F::HALF - p.mean2d[0], least(left + F::of(BIN as f64), width) - F::HALF - p.mean2d[0]];
            *hit = ellipse_distance(p.conic, y_slope, x_slope, x, y) <= p.tau;
        }
        for (bx, hit) in hits.into_iter().enumerate() {
            mask |= u64::from(hit) << (by * MASK_SIDE + bx);
        }
    }
    mask
}

/// Least dᵀ conic d over a rectangle of offsets from the centre; exact.
///
/// The least point is on a side that faces the centre, so a clamped minimum along each facing side finds it; for a
/// centre inside the range of a side the candidate is an inner point, which is allowed too. `y_slope` = −b/c and
/// `x_slope` = −b/a are the lines of those minima.
#[inline(always)]
pub(super) fn ellipse_distance<F: Real>(conic: [F; 3], y_slope: F, x_slope: F, x: [F; 2], y: [F; 2]) -> F {
    let clamp = |v: F, r: [F; 2]| {
        let v = if v > r[0] { v } else { r[0] };
        if v < r[1] { v } else { r[1] }
    };
    let q = |dx: F, dy: F| conic[0] * dx * dx + F::TWO * conic[1] * dx * dy + conic[2] * dy * dy;
    let (ex, ey) = (clamp(F::ZERO, x), clamp(F::ZERO, y));
    let along_x = q(ex, clamp(y_slope * ex, y));
    let along_y = q(clamp(x_slope * ey, x), ey);
    if along_x < along_y { along_x } else { along_y }
}
