//! One Gaussian of space and time and its slice at t, with gradients. Generic and branch-free, so that loops over lanes
//! vectorise.
//!
//! Everything here is in the coordinates (x, y, z, κt), κ in scene units per second. A rotation of four dimensions is a
//! pair of unit quaternions, X ↦ l X r̄ with X = κt + xi + yj + zk. With L = R·diag(s), its last row ℓ, c = ‖ℓ‖² and v
//! = L₃ℓᵀ, the slice has the mean μ + v·τ/c, τ = κ(t − μ_t), and the covariance L₃(1 − ℓᵀℓ/c)L₃ᵀ. The bracket is a
//! projector, so that the covariance is KKᵀ, K = L₃(1 − ℓᵀℓ/c): no difference of large numbers, never indefinite.
//! Source: Yang et al. 2024 ("Real-time 4DGS") §4; the projector is our own.

use crate::math::{Real, quat};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::simd::{each, greatest, least, select};

/// Columns of the model's own table: time of the mean (seconds), log scale in time (log seconds), right quaternion 4.
pub(super) const OWN: usize = 6;
/// Column of the log scale in time.
pub(super) const LOG_TIME_SCALE: usize = 1;
/// First column of the right quaternion.
pub(super) const RIGHT: usize = 2;
/// The lifespan's exponent stops at −30: e⁻³⁰ is invisible, and in f32 products with it do not become subnormal.
const FAINTEST: f64 = 60.0;

/// Parameters of a slice in addition to the row: see [`super::Native4dSpec`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Frame<F> {
    /// κ, scene units per second.
    pub speed: F,
    /// Least c, scene units².
    pub floor: F,
    /// Largest log scale in time, log seconds.
    pub ceiling: F,
}

/// The sixteen products l_i·r_j from which a rotation is made by additions alone.
#[inline(always)]
fn products<F: Real>(l: [F; 4], r: [F; 4]) -> [[F; 4]; 4] {
    each(|i| each(|j| l[i] * r[j]))
}

/// R from the products: column b holds l e_b r̄, rows and columns in the order x, y, z, t.
#[inline(always)]
pub(super) fn from_products<F: Real>(a: [[F; 4]; 4]) -> [[F; 4]; 4] {
    [
        [
            a[0][0] + a[1][1] - a[2][2] - a[3][3],
            a[1][2] + a[2][1] - a[0][3] - a[3][0],
            a[0][2] + a[1][3] + a[2][0] + a[3][1],
            a[1][0] + a[3][2] - a[0][1] - a[2][3],
        ],
        [
            a[0][3] + a[1][2] + a[2][1] + a[3][0],
            a[0][0] + a[2][2] - a[1][1] - a[3][3],
            a[2][3] + a[3][2] - a[0][1] - a[1][0],
            a[1][3] + a[2][0] - a[0][2] - a[3][1],
        ],
        [
            a[1][3] + a[3][1] - a[0][2] - a[2][0],
            a[0][1] + a[1][0] + a[2][3] + a[3][2],
            a[0][0] + a[3][3] - a[1][1] - a[2][2],
            a[2][1] + a[3][0] - a[0][3] - a[1][2],
        ],
        [
            a[0][1] + a[3][2] - a[1][0] - a[2][3],
            a[0][2] + a[1][3] - a[2][0] - a[3][1],
            a[0][3] + a[2][1] - a[1][2] - a[3][0],
            a[0][0] + a[1][1] + a[2][2] + a[3][3],
        ],
    ]
}

/// The VJP of [`from_products`]; a quarter of it undoes a rotation: the map is orthogonal but for the factor 2.
#[inline(always)]
pub(super) fn to_products<F: Real>(d: [[F; 4]; 4]) -> [[F; 4]; 4] {
    [
        [
            d[0][0] + d[1][1] + d[2][2] + d[3][3],
            d[3][0] + d[2][1] - d[1][2] - d[0][3],
            d[3][1] + d[0][2] - d[2][0] - d[1][3],
            d[1][0] + d[3][2] - d[0][1] - d[2][3],
        ],
        [
            d[2][1] + d[0][3] - d[3][0] - d[1][2],
            d[0][0] + d[3][3] - d[1][1] - d[2][2],
            d[1][0] + d[0][1] - d[3][2] - d[2][3],
            d[2][0] + d[3][1] + d[0][2] + d[1][3],
        ],
        [
            d[0][2] + d[1][3] - d[2][0] - d[3][1],
            d[1][0] + d[0][1] + d[3][2] + d[2][3],
            d[1][1] + d[3][3] - d[0][0] - d[2][2],
            d[2][1] + d[1][2] - d[3][0] - d[0][3],
        ],
        [
            d[1][0] + d[2][3] - d[0][1] - d[3][2],
            d[2][0] + d[0][2] - d[3][1] - d[1][3],
            d[3][0] + d[2][1] + d[1][2] + d[0][3],
            d[2][2] + d[3][3] - d[0][0] - d[1][1],
        ],
    ]
}

/// The rotation X ↦ l X r̄ of two unit quaternions (wxyz), rows and columns x, y, z, t. l = r is the rotation of space
/// by that quaternion.
#[inline(always)]
pub(crate) fn rotation4<F: Real>(l: [F; 4], r: [F; 4]) -> [[F; 4]; 4] {
    from_products(products(l, r))
}

/// The VJP of [`rotation4`].
#[inline(always)]
fn rotation4_backward<F: Real>(l: [F; 4], r: [F; 4], d: [[F; 4]; 4]) -> ([F; 4], [F; 4]) {
    let a = to_products(d);
    let dot = |x: [F; 4], y: [F; 4]| x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3];
    (each(|i| dot(a[i], r)), each(|j| dot([a[0][j], a[1][j], a[2][j], a[3][j]], l)))
}

/// The unit quaternions of a rotation of four dimensions (up to the sign that both share).
pub(super) fn quaternions(r: [[f64; 4]; 4]) -> [[f64; 4]; 2] {
    let a = to_products(r);
    // The products are a matrix of rank one: its largest row is the right quaternion, and names the left one.
    let norm = |row: &[f64; 4]| row.iter().map(|x| x * x).sum::<f64>();
    let largest = (0..4).max_by(|&i, &j| norm(&a[i]).total_cmp(&norm(&a[j]))).expect("four rows");
    let right = quat::normalize(a[largest]).0;
    let left = std::array::from_fn(|i| (0..4).map(|j| a[i][j] * right[j]).sum());
    [quat::normalize(left).0, right]
}

/// Intermediate values common to forward and backward.
struct Parts<F> {
    /// Unit quaternions with their norms.
    left: ([F; 4], F),
    right: ([F; 4], F),
    rotation: [[F; 4]; 4],
    scales: [F; 4],
    /// R·diag(s).
    l: [[F; 4]; 4],
    /// ‖ℓ‖², and the same but not below the floor.
    c: F,
    lifted: F,
    /// 1/lifted.
    inverse: F,
    v: [F; 3],
    k: [[F; 4]; 3],
    /// κ(t − μ_t).
    tau: F,
    /// τ²/c, at most [`FAINTEST`], and whether it is less.
    square: F,
    near: bool,
}

#[inline(always)]
fn time_scale<F: Real>(own: &[F; OWN], frame: &Frame<F>) -> F {
    frame.speed * least(own[LOG_TIME_SCALE], frame.ceiling).exp()
}

#[inline(always)]
fn quats<F: Real>(g: &[F; 11], own: &[F; OWN]) -> [[F; 4]; 2] {
    [each(|i| g[QUAT + i]), each(|i| own[RIGHT + i])]
}

#[inline(always)]
fn parts<F: Real>(g: &[F; 11], own: &[F; OWN], t: F, frame: &Frame<F>) -> Parts<F> {
    let [left, right] = quats(g, own).map(quat::normalize);
    let rotation = rotation4(left.0, right.0);
    let scales = [g[LOG_SCALE].exp(), g[LOG_SCALE + 1].exp(), g[LOG_SCALE + 2].exp(), time_scale(own, frame)];
    let l: [[F; 4]; 4] = each(|i| each(|k| rotation[i][k] * scales[k]));
    let e = l[3];
    let squares: [F; 4] = each(|k| e[k] * e[k]);
    let c = squares[0] + squares[1] + squares[2] + squares[3];
    let lifted = greatest(c, frame.floor);
    let inverse = F::ONE / lifted;
    let v: [F; 3] = each(|i| l[i][0] * e[0] + l[i][1] * e[1] + l[i][2] * e[2] + l[i][3] * e[3]);
    // The projector's diagonal as sums of the other squares: 1 − ℓ_k²/c would lose the digits that matter.
    let rest = lifted - c;
    let diagonal = [
        (squares[1] + squares[2] + squares[3] + rest) * inverse,
        (squares[0] + squares[2] + squares[3] + rest) * inverse,
        (squares[0] + squares[1] + squares[3] + rest) * inverse,
        (squares[0] + squares[1] + squares[2] + rest) * inverse,
    ];
    let scaled: [F; 4] = each(|k| e[k] * inverse);
    let k: [[F; 4]; 3] = each(|i| {
        let along: [F; 4] = each(|j| l[i][j] * e[j]);
        [
            l[i][0] * diagonal[0] - (along[1] + along[2] + along[3]) * scaled[0],
            l[i][1] * diagonal[1] - (along[0] + along[2] + along[3]) * scaled[1],
            l[i][2] * diagonal[2] - (along[0] + along[1] + along[3]) * scaled[2],
            l[i][3] * diagonal[3] - (along[0] + along[1] + along[2]) * scaled[3],
        ]
    });
    let tau = frame.speed * (t - own[0]);
    let square = tau * tau * inverse;
    let near = square < F::of(FAINTEST);
    Parts {
        left,
        right,
        rotation,
        scales,
        l,
        c,
        lifted,
        inverse,
        v,
        k,
        tau,
        square: least(square, F::of(FAINTEST)),
        near,
    }
}

/// The splat at t of a row (geometry 11, own columns 6): mean 3, covariance 6, opacity with the lifespan in it.
#[inline(always)]
pub(super) fn slice<F: Real>(g: &[F; 11], own: &[F; OWN], t: F, frame: &Frame<F>) -> [F; 10] {
    let p = parts(g, own, t, frame);
    let shift = p.tau * p.inverse;
    // What the floor adds to c leaves a part of v in the slice.
    let blur = (p.lifted - p.c) * p.inverse * p.inverse;
    let cov = |i: usize, j: usize| {
        p.k[i][0] * p.k[j][0]
            + p.k[i][1] * p.k[j][1]
            + p.k[i][2] * p.k[j][2]
            + p.k[i][3] * p.k[j][3]
            + p.v[i] * p.v[j] * blur
    };
    let life = (-F::HALF * p.square).exp();
    [
        g[0] + p.v[0] * shift,
        g[1] + p.v[1] * shift,
        g[2] + p.v[2] * shift,
        cov(0, 0),
        cov(0, 1),
        cov(0, 2),
        cov(1, 1),
        cov(1, 2),
        cov(2, 2),
        g[OPACITY].sigmoid() * life,
    ]
}

/// The VJP of [`slice`]: gradients to geometry, own columns and t.
#[inline(always)]
pub(super) fn slice_backward<F: Real>(
    g: &[F; 11],
    own: &[F; OWN],
    t: F,
    frame: &Frame<F>,
    d: &[F; 10],
) -> ([F; 11], [F; OWN], F) {
    let p = parts(g, own, t, frame);
    let two = F::TWO;
    let half = |c: usize| F::HALF * d[COV + c];
    let m = [[d[COV], half(1), half(2)], [half(1), d[COV + 3], half(4)], [half(2), half(4), d[COV + 5]]];
    let dot = |a: [F; 3], b: [F; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let d_mean = [d[0], d[1], d[2]];
    let o = g[OPACITY].sigmoid();
    let life = (-F::HALF * p.square).exp();
    let d_logit = d[SPLAT_OPACITY] * life * o * (F::ONE - o);
    // h·w, zero where the exponent has stopped.
    let fade = select(p.near, d[SPLAT_OPACITY] * o * life, F::ZERO);
    let d_tau = p.inverse * (dot(d_mean, p.v) - fade * p.tau);
    // Where c is free, the terms of dL/dc join those of dL/dv: K is in L's place, and −τ·dτ/c is left along ℓ.
    let free = p.c > frame.floor;
    let side: [F; 3] = each(|i| p.inverse * (d_mean[i] * p.tau - two * dot(m[i], p.v)));
    let along = select(free, -p.tau * p.inverse * d_tau, F::ZERO);
    let mut d_scales = [F::ZERO; 4];
    let mut d_rotation = [[F::ZERO; 4]; 4];
    for k in 0..4 {
        let e = p.l[3][k];
        let column = [p.k[0][k], p.k[1][k], p.k[2][k]];
        let through = if free { column } else { [p.l[0][k], p.l[1][k], p.l[2][k]] };
        let shift = p.tau * p.inverse * e;
        for i in 0..4 {
            let d_l = if i < 3 { two * dot(m[i], column) + d_mean[i] * shift } else { dot(side, through) + along * e };
            d_scales[k] += d_l * p.rotation[i][k];
            d_rotation[i][k] = d_l * p.scales[k];
        }
    }
    let (d_left, d_right) = rotation4_backward(p.left.0, p.right.0, d_rotation);
    let d_left = quat::normalize_backward(p.left.0, p.left.1, d_left);
    let d_right = quat::normalize_backward(p.right.0, p.right.1, d_right);
    let d_time = frame.speed * d_tau;
    let grows = own[LOG_TIME_SCALE] < frame.ceiling;
    let d_log = select(grows, d_scales[3] * p.scales[3], F::ZERO);
    (
        [
            d[0],
            d[1],
            d[2],
            d_left[0],
            d_left[1],
            d_left[2],
            d_left[3],
            d_scales[0] * p.scales[0],
            d_scales[1] * p.scales[1],
            d_scales[2] * p.scales[2],
            d_logit,
        ],
        [-d_time, d_log, d_right[0], d_right[1], d_right[2], d_right[3]],
        d_time,
    )
}

/// c of a row, not below the floor: κ² times the variance of its lifespan in seconds.
#[inline(always)]
pub(super) fn variance<F: Real>(g: &[F; 11], own: &[F; OWN], frame: &Frame<F>) -> F {
    let [left, right] = quats(g, own).map(|q| quat::normalize(q).0);
    let e = rotation4(left, right)[3];
    let s = [g[LOG_SCALE].exp(), g[LOG_SCALE + 1].exp(), g[LOG_SCALE + 2].exp(), time_scale(own, frame)];
    let l: [F; 4] = each(|k| e[k] * s[k]);
    greatest(l[0] * l[0] + l[1] * l[1] + l[2] * l[2] + l[3] * l[3], frame.floor)
}

/// v/c, scene units for every κ seconds: the velocity over κ.
#[inline(always)]
pub(super) fn slope<F: Real>(g: &[F; 11], own: &[F; OWN], frame: &Frame<F>) -> [F; 3] {
    let p = parts(g, own, own[0], frame);
    each(|i| p.v[i] * p.inverse)
}
