//! Gaussians as points of a curved space: the 2-Wasserstein geometry of N(μ, Σ) in three dimensions, with gradients.
//!
//! | what | formula |
//! |---|---|
//! | distance | W₂² = ‖μ₁−μ₂‖² + tr(Σ₁+Σ₂−2(Σ₁^½ Σ₂ Σ₁^½)^½) |
//! | map | T = Σ₁^-½ (Σ₁^½ Σ₂ Σ₁^½)^½ Σ₁^-½, so that T Σ₁ T = Σ₂ |
//! | log | v = μ₂−μ₁, V = TΣ₁ + Σ₁T − 2Σ₁ |
//! | exp | ΓΣ₁ + Σ₁Γ = V; μ₁ + v, (I+Γ)Σ₁(I+Γ) |
//! | geodesic | (1−s)μ₁ + sμ₂, MΣ₁M with M = (1−s)I + sT |
//!
//! No gradient is propagated through eigenvectors, which are discontinuous where eigenvalues are equal: roots and maps
//! are differentiated through the equations they solve. All is in f64: one Gaussian is some hundred operations in
//! registers, and products of two nearly flat covariances have condition numbers that 32 bits cannot hold. What was
//! stored in 32 bits is widened.
//!
//! Source: Deng et al. 2024 (Wasserstein 4DGS); Malagò et al. 2018, "Wasserstein Riemannian geometry of Gaussian
//! densities", for log, exp and Lyapunov's equation.

#[cfg(test)]
mod tests;

use super::Real;

/// A 3x3 matrix, row by row; symmetric unless stated otherwise.
pub type Mat3 = [[f64; 3]; 3];

/// 1
pub const IDENTITY: Mat3 = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

/// Eigenvalues of a covariance count as at least this share of its trace: axes 10⁴ times thinner than the longest
/// (methods' relative floor of 1e-4 on lengths). 32-bit covariances are not known better.
pub(crate) const RELATIVE_FLOOR: f64 = 1e-8;
/// And at least this, scene units²: a point has an inverse that 32 bits can still hold.
const ABSOLUTE_FLOOR: f64 = 1e-20;
/// Eigenvalues of a product of two covariances have twice the exponents.
const PRODUCT_FLOOR: f64 = RELATIVE_FLOOR * RELATIVE_FLOOR;
/// I + Γ is clamped to this from below when it leads out of the space of Gaussians (our choice): a step never shrinks
/// an axis to less than a tenth.
pub(crate) const STRETCH_MIN: f64 = 0.1;
/// Sweeps of Jacobi rotations: convergence is quadratic, six suffice for f64.
const SWEEPS: usize = 8;
/// Off-diagonals this small against the diagonal (squared) are rounding.
const OFF_DIAGONAL: f64 = 1e-34;

/// A packed covariance (xx, xy, xz, yy, yz, zz) as a matrix.
#[inline]
pub fn unpack<F: Real>(c: [F; 6]) -> Mat3 {
    let c = c.map(F::f64);
    [[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]]
}

/// The six numbers of a symmetric matrix.
#[inline]
pub(crate) fn pack<F: Real>(m: &Mat3) -> [F; 6] {
    [m[0][0], m[0][1], m[0][2], m[1][1], m[1][2], m[2][2]].map(F::of)
}

/// A gradient to six packed numbers, as that to a symmetric matrix.
#[inline]
pub(crate) fn unpack_gradient<F: Real>(g: [F; 6]) -> Mat3 {
    let h = F::HALF;
    unpack([g[0], g[1] * h, g[2] * h, g[3], g[4] * h, g[5]])
}

/// A gradient to a symmetric matrix, as that to its six numbers: each off-diagonal is in two places.
#[inline]
pub(crate) fn pack_gradient<F: Real>(g: &Mat3) -> [F; 6] {
    [g[0][0], g[0][1] + g[1][0], g[0][2] + g[2][0], g[1][1], g[1][2] + g[2][1], g[2][2]].map(F::of)
}

/// A·B
#[inline]
pub(crate) fn mul(a: &Mat3, b: &Mat3) -> Mat3 {
    std::array::from_fn(|i| std::array::from_fn(|j| a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j]))
}

/// A·x
#[inline]
pub(crate) fn apply(a: &Mat3, x: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i][0] * x[0] + a[i][1] * x[1] + a[i][2] * x[2])
}

/// a·A + b·B
#[inline]
pub(crate) fn mix(a: f64, x: &Mat3, b: f64, y: &Mat3) -> Mat3 {
    std::array::from_fn(|i| std::array::from_fn(|j| a * x[i][j] + b * y[i][j]))
}

/// Σ A∘B
#[inline]
pub(crate) fn inner(a: &Mat3, b: &Mat3) -> f64 {
    (0..3).map(|i| a[i][0] * b[i][0] + a[i][1] * b[i][1] + a[i][2] * b[i][2]).sum()
}

/// (A + Aᵀ)/2
#[inline]
pub(crate) fn symmetric(a: &Mat3) -> Mat3 {
    std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (a[i][j] + a[j][i])))
}

/// (x yᵀ + y xᵀ)/2
#[inline]
pub(crate) fn outer(x: [f64; 3], y: [f64; 3]) -> Mat3 {
    std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (x[i] * y[j] + y[i] * x[j])))
}

/// P A P for symmetric P and A, symmetric to the last bit.
#[inline]
pub(crate) fn sandwich(p: &Mat3, a: &Mat3) -> Mat3 {
    symmetric(&mul(&mul(p, a), p))
}

/// tr A
#[inline]
#[cfg(test)]
pub(crate) fn trace(a: &Mat3) -> f64 {
    a[0][0] + a[1][1] + a[2][2]
}

/// The inverse of a symmetric positive definite matrix, by cofactors.
#[inline]
pub(crate) fn inverse(a: &Mat3) -> Mat3 {
    let [[xx, xy, xz], [_, yy, yz], [_, _, zz]] = *a;
    let (c0, c1, c2) = (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy);
    let det = xx * c0 + xy * c1 + xz * c2;
    let (c3, c4, c5) = (xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy);
    [[c0 / det, c1 / det, c2 / det], [c1 / det, c3 / det, c4 / det], [c2 / det, c4 / det, c5 / det]]
}

/// A symmetric matrix as V diag(λ) Vᵀ; eigenvectors are columns of V, in no particular order.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Eigen {
    /// λ
    pub values: [f64; 3],
    /// V
    pub vectors: Mat3,
}

impl Eigen {
    /// By cyclic Jacobi rotations (Golub & Van Loan §8.5): backward stable, and equal eigenvalues are no special case.
    pub(crate) fn of(m: &Mat3) -> Self {
        let (mut a, mut v) = (*m, IDENTITY);
        for _ in 0..SWEEPS {
            let off = a[0][1] * a[0][1] + a[0][2] * a[0][2] + a[1][2] * a[1][2];
            let on = a[0][0] * a[0][0] + a[1][1] * a[1][1] + a[2][2] * a[2][2];
            if off <= OFF_DIAGONAL * on {
                break;
            }
            for (p, q) in [(0, 1), (0, 2), (1, 2)] {
                rotate(&mut a, &mut v, p, q);
            }
        }
        Self { values: [a[0][0], a[1][1], a[2][2]], vectors: v }
    }

    /// That of a covariance: eigenvalues are lifted to the floors.
    pub(crate) fn of_covariance(m: &Mat3) -> Self {
        let mut e = Self::of(m);
        e.lift(RELATIVE_FLOOR, ABSOLUTE_FLOOR);
        e
    }

    fn lift(&mut self, share: f64, least: f64) {
        let sum: f64 = self.values.iter().map(|x| x.max(0.0)).sum();
        let floor = (share * sum).max(least);
        self.values = self.values.map(|x| x.max(floor));
    }

    /// V diag(f(λ)) Vᵀ
    pub(crate) fn map(&self, f: impl Fn(f64) -> f64) -> Mat3 {
        let w = self.values.map(f);
        let v = &self.vectors;
        std::array::from_fn(|i| {
            std::array::from_fn(|j| v[i][0] * w[0] * v[j][0] + v[i][1] * w[1] * v[j][1] + v[i][2] * w[2] * v[j][2])
        })
    }

    /// V (f(i, j) ∘ (Vᵀ X V)) Vᵀ for symmetric X: a linear map that is diagonal in the eigenbasis, and its own adjoint.
    pub(crate) fn weigh(&self, x: &Mat3, f: impl Fn(f64, f64) -> f64) -> Mat3 {
        let v = &self.vectors;
        let turned: Mat3 = std::array::from_fn(|i| std::array::from_fn(|j| v[j][i]));
        let inside = mul(&mul(&turned, x), v);
        let inside: Mat3 =
            std::array::from_fn(|i| std::array::from_fn(|j| inside[i][j] * f(self.values[i], self.values[j])));
        symmetric(&mul(&mul(v, &inside), &turned))
    }
}

#[inline]
fn rotate(a: &mut Mat3, v: &mut Mat3, p: usize, q: usize) {
    if a[p][q] == 0.0 {
        return;
    }
    let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
    // Where θ² overflows, t is 0, which is what it tends to.
    let t = 1.0f64.copysign(theta) / (theta.abs() + (theta * theta + 1.0).sqrt());
    let c = 1.0 / (t * t + 1.0).sqrt();
    let s = t * c;
    let r = 3 - p - q;
    let off = a[p][q];
    a[p][p] -= t * off;
    a[q][q] += t * off;
    let (x, y) = (a[r][p], a[r][q]);
    (a[r][p], a[r][q]) = (c * x - s * y, s * x + c * y);
    (a[p][r], a[q][r]) = (a[r][p], a[r][q]);
    (a[p][q], a[q][p]) = (0.0, 0.0);
    for row in v {
        let (x, y) = (row[p], row[q]);
        (row[p], row[q]) = (c * x - s * y, s * x + c * y);
    }
}

/// The Γ with ΓΣ + ΣΓ = V (Lyapunov's equation).
#[cfg(test)]
pub(crate) fn lyapunov(sigma: &Eigen, v: &Mat3) -> Mat3 {
    sigma.weigh(v, |x, y| 1.0 / (x + y))
}

/// The optimal map between two covariances, and what its gradient needs.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Transport {
    /// T, symmetric positive definite.
    pub map: Mat3,
    /// Σ₁^½ and Σ₁^-½.
    half: [Mat3; 2],
    /// Of C = Σ₁^½ Σ₂ Σ₁^½.
    product: Eigen,
}

impl Transport {
    /// From Σ₁ to Σ₂.
    pub(crate) fn new(from: &Mat3, to: &Mat3) -> Self {
        let e = Eigen::of_covariance(from);
        let half = [e.map(f64::sqrt), e.map(|x| 1.0 / x.sqrt())];
        let mut product = Eigen::of(&sandwich(&half[0], to));
        product.lift(PRODUCT_FLOOR, ABSOLUTE_FLOOR * ABSOLUTE_FLOOR);
        Self { map: sandwich(&half[1], &product.map(f64::sqrt)), half, product }
    }

    /// T⁻¹: the map from Σ₂ to Σ₁.
    pub(crate) fn back(&self) -> Mat3 {
        sandwich(&self.half[0], &self.product.map(|x| 1.0 / x.sqrt()))
    }

    /// VJP of T: gradients to Σ₁ and Σ₂.
    ///
    /// From TΣ₁T = Σ₂: dTΣ₁T + TΣ₁dT = dΣ₂ − TdΣ₁T; with X = Σ₁^½ dT Σ₁^½ it is XC^½ + C^½X = Σ₁^½(…)Σ₁^½.
    pub(crate) fn backward(&self, d_map: &Mat3) -> (Mat3, Mat3) {
        let d_x = sandwich(&self.half[1], d_map);
        let solved = self.product.weigh(&d_x, |x, y| 1.0 / (x.sqrt() + y.sqrt()));
        let z = sandwich(&self.half[0], &solved);
        (mix(-1.0, &sandwich(&self.map, &z), 0.0, &IDENTITY), z)
    }
}

/// The covariances' part of W₂² (the squared Bures distance), and its gradients to Σ₁ and Σ₂: I − T and I − T⁻¹.
pub fn bures(a: &Mat3, b: &Mat3) -> (f64, Mat3, Mat3) {
    if a == b {
        return (0.0, [[0.0; 3]; 3], [[0.0; 3]; 3]);
    }
    let t = Transport::new(a, b);
    // tr (T−I)Σ₁(T−I) = ‖(T−I)Σ₁^½‖²: the trace formula would cancel for neighbours.
    let m = mul(&mix(1.0, &t.map, -1.0, &IDENTITY), &t.half[0]);
    (inner(&m, &m), mix(1.0, &IDENTITY, -1.0, &t.map), mix(1.0, &IDENTITY, -1.0, &t.back()))
}

/// The covariances' part of the logarithm at Σ₁ of Σ₂: V = TΣ₁ + Σ₁T − 2Σ₁. The means' part is μ₂ − μ₁.
#[cfg(test)]
pub(crate) fn log(from: &Mat3, to: &Mat3) -> Mat3 {
    let t = Transport::new(from, to);
    mix(2.0, &symmetric(&mul(&t.map, from)), -2.0, from)
}

/// The covariances' part of the exponential at Σ of V: (I+Γ)Σ(I+Γ) with ΓΣ + ΣΓ = V, I+Γ kept above `STRETCH_MIN`.
#[cfg(test)]
pub(crate) fn exp(sigma: &Mat3, v: &Mat3) -> Mat3 {
    let gamma = lyapunov(&Eigen::of_covariance(sigma), v);
    let stretch = Eigen::of(&mix(1.0, &IDENTITY, 1.0, &gamma)).map(|x| x.max(STRETCH_MIN));
    sandwich(&stretch, sigma)
}

/// A point of the geodesic from Σ₁ (s = 0) through Σ₂ (s = 1). With s < 0 or s > 1 it is Exp(s·Log), the constant
/// velocity of Gaussians, and the stretch is kept above [`STRETCH_MIN`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Geodesic {
    /// MΣ₁M
    pub point: Mat3,
    s: f64,
    from: Mat3,
    /// `None`: both ends are one covariance, where everything is linear.
    path: Option<Path>,
}

#[derive(Clone, Copy, Debug)]
struct Path {
    transport: Transport,
    stretch: Mat3,
    /// Of T, where the stretch had to be clamped.
    clamped: Option<Eigen>,
}

impl Geodesic {
    /// The point at s.
    pub(crate) fn new(from: &Mat3, to: &Mat3, s: f64) -> Self {
        if from == to {
            return Self { point: *from, s, from: *from, path: None };
        }
        let transport = Transport::new(from, to);
        let mut stretch = mix(1.0 - s, &IDENTITY, s, &transport.map);
        let mut clamped = None;
        if !(0.0..=1.0).contains(&s) {
            let e = Eigen::of(&transport.map);
            if e.values.iter().any(|&x| 1.0 - s + s * x < STRETCH_MIN) {
                stretch = e.map(|x| stretched(s, x));
                clamped = Some(e);
            }
        }
        let point = sandwich(&stretch, from);
        Self { point, s, from: *from, path: Some(Path { transport, stretch, clamped }) }
    }

    /// VJP: gradients to Σ₁, Σ₂ and s.
    pub(crate) fn backward(&self, d_point: &Mat3) -> (Mat3, Mat3, f64) {
        let s = self.s;
        let Some(Path { transport, stretch, clamped }) = &self.path else {
            // T is I: d(MΣ₁M) = (1−s)dΣ₁ + s dΣ₂ exactly, and no step along a path without length changes anything.
            let zero = [[0.0; 3]; 3];
            return (mix(1.0 - s, d_point, 0.0, &zero), mix(s, d_point, 0.0, &zero), 0.0);
        };
        let d_stretch = mix(2.0, &symmetric(&mul(&mul(d_point, stretch), &self.from)), 0.0, &IDENTITY);
        let (d_map, d_s) = match clamped {
            None => (mix(s, &d_stretch, 0.0, &IDENTITY), inner(&d_stretch, &mix(1.0, &transport.map, -1.0, &IDENTITY))),
            // Derivative of a function of a matrix: divided differences (Daleckii & Krein 1965).
            Some(e) => (
                e.weigh(&d_stretch, |x, y| divided(s, x, y)),
                inner(&d_stretch, &e.map(|x| if 1.0 - s + s * x > STRETCH_MIN { x - 1.0 } else { 0.0 })),
            ),
        };
        let (d_from, d_to) = transport.backward(&d_map);
        (mix(1.0, &d_from, 1.0, &sandwich(stretch, d_point)), d_to, d_s)
    }
}

fn stretched(s: f64, x: f64) -> f64 {
    (1.0 - s + s * x).max(STRETCH_MIN)
}

/// Of [`stretched`]; the slope where both are nearly one.
fn divided(s: f64, x: f64, y: f64) -> f64 {
    /// Closer than this, relatively, a difference of differences is only rounding.
    const NEAR: f64 = 1e-9;
    if (x - y).abs() > NEAR * (x.abs() + y.abs()) {
        return (stretched(s, x) - stretched(s, y)) / (x - y);
    }
    if 1.0 - s + 0.5 * s * (x + y) > STRETCH_MIN { s } else { 0.0 }
}

/// A matrix with its eigenvalues lifted to `floor`, and the VJP of that for a constant floor.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Lifted {
    /// The result.
    pub matrix: Mat3,
    /// `None`: nothing had to be lifted.
    eigen: Option<Eigen>,
    floor: f64,
}

impl Lifted {
    /// Lifts.
    pub(crate) fn new(a: &Mat3, floor: f64) -> Self {
        let e = Eigen::of(a);
        if e.values.iter().all(|&x| x >= floor) {
            return Self { matrix: *a, eigen: None, floor };
        }
        Self { matrix: e.map(|x| x.max(floor)), eigen: Some(e), floor }
    }

    /// The gradient to the matrix.
    pub(crate) fn backward(&self, d: &Mat3) -> Mat3 {
        let floor = self.floor;
        let Some(e) = &self.eigen else { return *d };
        e.weigh(d, |x, y| {
            if x != y {
                return (x.max(floor) - y.max(floor)) / (x - y);
            }
            if x > floor { 1.0 } else { 0.0 }
        })
    }
}
