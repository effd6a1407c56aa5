//! Two-view geometry: fundamental and essential matrices, and the motion between their cameras.

use super::algebra::{
    Mat3, add, eliminate, least_vector, multiply, null_space, orthonormal, roots, rotation, skew, svd, value,
};
use super::sample::{Consensus, Data, Search, consensus};
use splat4d::math::se3::{cross, dot, mat_mul, mat_vec, norm, normalize, transpose};
use splat4d::math::{Rng, Se3};
use std::sync::LazyLock;

/// A position as the first and the second image show it.
pub(crate) type Pair = [[f64; 2]; 2];

/// Samples, at most: enough for seven clean of thirty per cent clean data with a chance of one half, and for five of
/// them with any chance.
const MOST: usize = 3000;
/// Chance of leaving too early.
const MISSED: f64 = 1e-3;

fn long([x, y]: [f64; 2]) -> [f64; 3] {
    [x, y, 1.0]
}

/// Squared first-order distance of a pair from a fundamental matrix (Sampson 1982), in the pair's unit.
pub(crate) fn sampson(f: &Mat3, &[a, b]: &Pair) -> f64 {
    let (a, b) = (long(a), long(b));
    let forth = mat_vec(f, a);
    let back = mat_vec(&transpose(f), b);
    let off = dot(b, forth);
    off * off / (forth[0] * forth[0] + forth[1] * forth[1] + back[0] * back[0] + back[1] * back[1])
}

/// The row of the linear system that a pair gives: its product with the matrix, row by row, is zero.
fn row(&[a, b]: &Pair) -> [f64; 9] {
    let (a, b) = (long(a), long(b));
    std::array::from_fn(|k| b[k / 3] * a[k % 3])
}

fn matrix(v: &[f64; 9]) -> Mat3 {
    [[v[0], v[1], v[2]], [v[3], v[4], v[5]], [v[6], v[7], v[8]]]
}

fn det(m: &Mat3) -> f64 {
    dot(m[0], cross(m[1], m[2]))
}

/// The fundamental matrices of seven pairs: those of rank two among b·F·a = 0.
fn seven(sample: &[Pair]) -> Vec<Mat3> {
    let rows: Vec<[f64; 9]> = sample.iter().map(row).collect();
    let null = null_space(&rows);
    let (p, q) = (matrix(&null[0]), matrix(&null[1]));
    // det(p + x q): of four values the cubic's coefficients.
    let at = |x: f64| det(&std::array::from_fn(|i| std::array::from_fn(|k| p[i][k] + x * q[i][k])));
    let (zero, one, minus, lead) = (det(&p), at(1.0), at(-1.0), det(&q));
    let even = 0.5 * (one + minus) - zero;
    let odd = 0.5 * (one - minus) - lead;
    roots(&[zero, odd, even, lead])
        .into_iter()
        .map(|x| std::array::from_fn(|i| std::array::from_fn(|k| p[i][k] + x * q[i][k])))
        .collect()
}

/// Pairs in which a fundamental matrix is searched for, about the images' middles and in units of their size, so that
/// the system is well conditioned (Hartley 1997).
struct Uncalibrated<'a> {
    pairs: &'a [Pair],
    unit: f64,
}

impl Data for Uncalibrated<'_> {
    type Model = Mat3;
    const SAMPLE: usize = 7;

    fn len(&self) -> usize {
        self.pairs.len()
    }

    fn fit(&self, sample: &[usize]) -> Vec<Mat3> {
        let pairs: Vec<Pair> = sample.iter().map(|&k| self.pairs[k]).collect();
        seven(&pairs)
    }

    fn error(&self, f: &Mat3, k: usize) -> f64 {
        sampson(f, &self.pairs[k]) * self.unit * self.unit
    }

    fn polish(&self, f: &Mat3, inliers: &[usize]) -> Option<Mat3> {
        if inliers.len() < 8 {
            return None;
        }
        let mut sum = [[0.0; 9]; 9];
        for &k in inliers {
            let (a, b) = (long(self.pairs[k][0]), long(self.pairs[k][1]));
            let (forth, back) = (mat_vec(f, a), mat_vec(&transpose(f), b));
            let slope = forth[0].powi(2) + forth[1].powi(2) + back[0].powi(2) + back[1].powi(2);
            let r = row(&self.pairs[k]);
            for i in 0..9 {
                (0..9).for_each(|j| sum[i][j] += r[i] * r[j] / slope);
            }
        }
        let (u, s, v) = svd(&matrix(&least_vector(sum)));
        let us: Mat3 = std::array::from_fn(|i| [u[i][0] * s[0], u[i][1] * s[1], 0.0]);
        Some(mat_mul(&us, &transpose(&v)))
    }
}

/// The fundamental matrix F that most pairs agree with (b·F·a = 0 within `tolerance` pixels).
///
/// Pixel positions are about the images' middles (subtract them before); `size` is the larger side of the images. F is
/// for positions in pixels. `None`: fewer than seven pairs, or no model.
pub(crate) fn fundamental(pairs: &[Pair], size: f64, tolerance: f64, rng: Rng) -> Option<Consensus<Mat3>> {
    let unit = 0.5 * size;
    let small: Vec<Pair> = pairs.iter().map(|p| p.map(|q| q.map(|v| v / unit))).collect();
    let search = Search { tolerance, most: MOST, missed: MISSED };
    let mut found = consensus(&Uncalibrated { pairs: &small, unit }, search, rng)?;
    let scale = [1.0 / unit, 1.0 / unit, 1.0];
    found.model = std::array::from_fn(|i| std::array::from_fn(|k| found.model[i][k] * scale[i] * scale[k]));
    Some(found)
}

/// How far a fundamental matrix is from one of two cameras of this focal length: 1 − σ₂/σ₁ of the essential matrix,
/// whose first two singular values are equal. 0 is perfect.
pub(crate) fn unlike_focal(f: &Mat3, focal: f64) -> f64 {
    let k = [focal, focal, 1.0];
    let e: Mat3 = std::array::from_fn(|i| std::array::from_fn(|j| f[i][j] * k[i] * k[j]));
    let (_, s, _) = svd(&e);
    if s[0] > 0.0 { 1.0 - s[1] / s[0] } else { 1.0 }
}

/// Exponents of x, y and z of the monomials of degree three and less, in the order of Nistér 2004, so that ten of them
/// can be eliminated and the remaining equations are polynomials in z times x, y and 1.
const MONOMIALS: [[usize; 3]; 20] = [
    [3, 0, 0],
    [0, 3, 0],
    [2, 1, 0],
    [1, 2, 0],
    [2, 0, 1],
    [2, 0, 0],
    [0, 2, 1],
    [0, 2, 0],
    [1, 1, 1],
    [1, 1, 0],
    [1, 0, 2],
    [1, 0, 1],
    [1, 0, 0],
    [0, 1, 2],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 3],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];

/// A polynomial in x, y and z: a coefficient for each of [`MONOMIALS`].
type Cubic = [f64; 20];

/// The position of every product of two monomials in [`MONOMIALS`]; 20: of degree above three.
static PRODUCTS: LazyLock<[[usize; 20]; 20]> = LazyLock::new(|| {
    let place = |a: [usize; 3], b: [usize; 3]| {
        let sum: [usize; 3] = std::array::from_fn(|k| a[k] + b[k]);
        MONOMIALS.iter().position(|m| *m == sum).unwrap_or(20)
    };
    std::array::from_fn(|i| std::array::from_fn(|k| place(MONOMIALS[i], MONOMIALS[k])))
});

/// The essential matrices of five pairs of rays (depth 1): b·E·a = 0, det E = 0 and 2 E Eᵀ E = tr(E Eᵀ) E (Nistér 2004,
/// "An efficient solution to the five-point relative pose problem").
pub(crate) fn five(sample: &[Pair; 5]) -> Vec<Mat3> {
    let rows: Vec<[f64; 9]> = sample.iter().map(row).collect();
    let null = null_space(&rows);
    let place = &*PRODUCTS;
    let times = |a: &Cubic, b: &Cubic| {
        let mut out = [0.0; 20];
        for (i, x) in a.iter().enumerate().filter(|(_, x)| **x != 0.0) {
            for (k, y) in b.iter().enumerate().filter(|(_, y)| **y != 0.0) {
                out[place[i][k]] += x * y;
            }
        }
        out
    };
    let plus = |a: Cubic, factor: f64, b: &Cubic| -> Cubic { std::array::from_fn(|k| a[k] + factor * b[k]) };
    // E = x null₀ + y null₁ + z null₂ + null₃
    let entry = |k: usize| {
        let mut p = [0.0; 20];
        (p[12], p[15], p[18], p[19]) = (null[0][k], null[1][k], null[2][k], null[3][k]);
        p
    };
    let e: [[Cubic; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|k| entry(3 * i + k)));
    let sum = |terms: [(f64, Cubic); 3]| terms.iter().fold([0.0; 20], |s, (f, t)| plus(s, *f, t));
    let gram: [[Cubic; 3]; 3] = std::array::from_fn(|i| {
        std::array::from_fn(|j| sum(std::array::from_fn(|k| (1.0, times(&e[i][k], &e[j][k])))))
    });
    let trace = sum(std::array::from_fn(|k| (1.0, gram[k][k])));
    let mut system: Vec<Vec<f64>> = Vec::with_capacity(10);
    for i in 0..3 {
        for j in 0..3 {
            let left = sum(std::array::from_fn(|k| (1.0, times(&gram[i][k], &e[k][j]))));
            system.push(plus(left, -0.5, &times(&trace, &e[i][j])).to_vec());
        }
    }
    let minor = |a: usize, b: usize| plus(times(&e[1][a], &e[2][b]), -1.0, &times(&e[1][b], &e[2][a]));
    let zero = sum([
        (1.0, times(&e[0][0], &minor(1, 2))),
        (1.0, times(&e[0][1], &minor(2, 0))),
        (1.0, times(&e[0][2], &minor(0, 1))),
    ]);
    system.push(zero.to_vec());
    if !eliminate(&mut system) {
        return Vec::new();
    }
    // Of rows that begin with m·z and with m, the first less z times the second has no m left.
    let polynomial = |r: usize, lowest_last: std::ops::Range<usize>| -> Vec<f64> {
        system[r][lowest_last].iter().rev().copied().collect()
    };
    let less = |r: usize, range: std::ops::Range<usize>| {
        let shifted = multiply(&polynomial(r + 1, range.clone()), &[0.0, 1.0]);
        add(&polynomial(r, range), -1.0, &shifted)
    };
    let b: Vec<[Vec<f64>; 3]> = [4, 6, 8].map(|r| [less(r, 10..13), less(r, 13..16), less(r, 16..20)]).to_vec();
    let two = |a: usize, c: usize| add(&multiply(&b[1][a], &b[2][c]), -1.0, &multiply(&b[1][c], &b[2][a]));
    let parts = [multiply(&b[0][0], &two(1, 2)), multiply(&b[0][1], &two(2, 0)), multiply(&b[0][2], &two(0, 1))];
    let tenth = parts.iter().fold(Vec::new(), |s, p| add(&s, 1.0, p));
    let mut out = Vec::new();
    for z in roots(&tenth) {
        let at: Mat3 = std::array::from_fn(|i| std::array::from_fn(|k| value(&b[i][k], z)));
        let crossed = [cross(at[0], at[1]), cross(at[1], at[2]), cross(at[2], at[0])];
        let v = crossed.into_iter().max_by(|a, b| norm(*a).total_cmp(&norm(*b))).expect("there are three");
        if v[2] == 0.0 {
            continue;
        }
        let (x, y) = (v[0] / v[2], v[1] / v[2]);
        let all: [f64; 9] = std::array::from_fn(|k| x * null[0][k] + y * null[1][k] + z * null[2][k] + null[3][k]);
        let length = all.iter().map(|v| v * v).sum::<f64>().sqrt();
        if length.is_finite() && length > 0.0 {
            out.push(matrix(&all.map(|v| v / length)));
        }
    }
    out
}

/// The product `[t]× R` of the motion from the first camera's axes to the second's.
pub(crate) fn essential_of(motion: &Se3) -> Mat3 {
    mat_mul(&skew(motion.translation), &motion.rotation)
}

/// The four motions of an essential matrix, with translations of length one.
pub(crate) fn motions(e: &Mat3) -> [Se3; 4] {
    let (u, _, v) = svd(e);
    let turn = |sign: f64| {
        let w = [[0.0, -sign, 0.0], [sign, 0.0, 0.0], [0.0, 0.0, 1.0]];
        orthonormal(&mat_mul(&mat_mul(&u, &w), &transpose(&v)))
    };
    let t = [u[0][2], u[1][2], u[2][2]];
    let back = t.map(|x| -x);
    [(1.0, t), (1.0, back), (-1.0, t), (-1.0, back)].map(|(s, t)| Se3 { rotation: turn(s), translation: t })
}

/// Depths along the two rays of a pair at which they are nearest to each other.
pub(crate) fn depths(motion: &Se3, &[a, b]: &Pair) -> [f64; 2] {
    let a = mat_vec(&motion.rotation, long(a));
    let b = long(b);
    let c = cross(b, a);
    let square = dot(c, c);
    [-dot(c, cross(b, motion.translation)) / square, -dot(c, cross(a, motion.translation)) / square]
}

/// The angle between the two rays of a pair, radians.
pub(crate) fn parallax(motion: &Se3, &[a, b]: &Pair) -> f64 {
    let a = normalize(mat_vec(&motion.rotation, long(a)));
    let b = normalize(long(b));
    norm(cross(a, b)).atan2(dot(a, b))
}

/// Pairs of rays in which an essential matrix is searched for.
struct Calibrated<'a> {
    rays: &'a [Pair],
    focal: f64,
}

impl Data for Calibrated<'_> {
    type Model = Mat3;
    const SAMPLE: usize = 5;

    fn len(&self) -> usize {
        self.rays.len()
    }

    fn fit(&self, sample: &[usize]) -> Vec<Mat3> {
        five(&std::array::from_fn(|k| self.rays[sample[k]]))
    }

    fn error(&self, e: &Mat3, k: usize) -> f64 {
        sampson(e, &self.rays[k]) * self.focal * self.focal
    }

    fn polish(&self, e: &Mat3, inliers: &[usize]) -> Option<Mat3> {
        let rays: Vec<Pair> = inliers.iter().map(|&k| self.rays[k]).collect();
        // Which of the four motions does not matter: all have this matrix.
        Some(essential_of(&polish_motion(&motions(e)[0], &rays)))
    }
}

/// The motion of least squares of the first-order distances of pairs of rays, near a given one: Gauss-Newton on the
/// rotation and on the direction of the translation.
pub(crate) fn polish_motion(start: &Se3, rays: &[Pair]) -> Se3 {
    /// From a good start the steps shrink as fast as rounding allows.
    const STEPS: usize = 10;
    let mut motion = *start;
    for _ in 0..STEPS {
        let t = normalize(motion.translation);
        let e = essential_of(&motion);
        let side = normalize(cross(t, if t[0].abs() < 0.9 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] }));
        let other = cross(t, side);
        let (mut h, mut g) = ([[0.0; 5]; 5], [0.0; 5]);
        for &[a, b] in rays {
            let (a, b) = (long(a), long(b));
            let (forth, back) = (mat_vec(&e, a), mat_vec(&transpose(&e), b));
            let slope = (forth[0].powi(2) + forth[1].powi(2) + back[0].powi(2) + back[1].powi(2)).sqrt();
            let turned = mat_vec(&motion.rotation, a);
            // b·(t × Ra), by the rotation and by t.
            let by_turn = cross(turned, cross(b, t));
            let by_t = cross(turned, b);
            let j = [by_turn[0], by_turn[1], by_turn[2], dot(by_t, side), dot(by_t, other)].map(|v| v / slope);
            let off = dot(b, forth) / slope;
            for i in 0..5 {
                (0..5).for_each(|k| h[i][k] += j[i] * j[k]);
                g[i] -= j[i] * off;
            }
        }
        let mut system: Vec<Vec<f64>> = (0..5).map(|i| h[i].iter().copied().chain([g[i]]).collect()).collect();
        if !eliminate(&mut system) {
            break;
        }
        let step: [f64; 5] = std::array::from_fn(|k| system[k][5]);
        let size = step.iter().map(|s| s * s).sum::<f64>().sqrt();
        if !size.is_finite() || size > 1.0 {
            break;
        }
        motion.rotation = orthonormal(&mat_mul(&rotation([step[0], step[1], step[2]]), &motion.rotation));
        motion.translation = normalize(std::array::from_fn(|k| t[k] + step[3] * side[k] + step[4] * other[k]));
        if size < 1e-15 {
            break;
        }
    }
    motion
}

/// Two cameras and the pairs that agree with their motion.
#[derive(Clone, Debug)]
pub(crate) struct Relative {
    /// From the first camera's axes to the second's; the translation has length one.
    pub motion: Se3,
    /// Pairs that agree and are before both cameras, ascending.
    pub inliers: Vec<usize>,
    /// The median angle between their rays, radians.
    pub angle: f64,
}

/// The motion that most pairs of rays agree with, within `tolerance` pixels at this focal length.
pub(crate) fn relative(rays: &[Pair], focal: f64, tolerance: f64, rng: Rng) -> Option<Relative> {
    let search = Search { tolerance, most: MOST, missed: MISSED };
    let found = consensus(&Calibrated { rays, focal }, search, rng)?;
    let before = |motion: &Se3| -> Vec<usize> {
        found.inliers.iter().copied().filter(|&k| depths(motion, &rays[k]).iter().all(|z| *z > 0.0)).collect()
    };
    let candidates = motions(&found.model).map(|m| (before(&m), m));
    let (inliers, motion) = candidates.into_iter().max_by_key(|(inliers, _)| inliers.len())?;
    let mut angles: Vec<f64> = inliers.iter().map(|&k| parallax(&motion, &rays[k])).collect();
    if angles.is_empty() {
        return None;
    }
    let middle = angles.len() / 2;
    let angle = *angles.select_nth_unstable_by(middle, f64::total_cmp).1;
    Some(Relative { motion, inliers, angle })
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::align::turn_between;
    use splat4d::math::se3::sub;

    fn scene(step: u64, n: usize) -> (Se3, Vec<Pair>) {
        let rng = Rng::new(5, "two views", step);
        let motion = Se3 {
            rotation: rotation(std::array::from_fn(|k| 0.4 * rng.normal(k as u64))),
            translation: normalize(std::array::from_fn(|k| rng.normal(10 + k as u64))),
        };
        let mut pairs = Vec::new();
        let mut k = 100;
        while pairs.len() < n {
            let x: [f64; 3] = [rng.normal(k), rng.normal(k + 1), 4.0 + rng.normal(k + 2)];
            k += 3;
            let y = motion.apply(x);
            if x[2] > 0.5 && y[2] > 0.5 {
                pairs.push([[x[0] / x[2], x[1] / x[2]], [y[0] / y[2], y[1] / y[2]]]);
            }
        }
        (motion, pairs)
    }

    #[test]
    fn five_exact_pairs_give_the_motion_to_nine_digits() {
        let mut exact = 0;
        for step in 0..40 {
            let (truth, pairs) = scene(step, 12);
            let sample: [Pair; 5] = std::array::from_fn(|k| pairs[k]);
            let found = five(&sample);
            let best = found
                .iter()
                .flat_map(motions)
                .map(|m| polish_motion(&m, &pairs[..6]))
                .map(|m| turn_between(&m.rotation, &truth.rotation) + norm(sub(m.translation, truth.translation)))
                .fold(f64::INFINITY, f64::min);
            assert!(best < 1e-9, "scene {step}: {best:e} of {} solutions", found.len());
            let raw = found.iter().flat_map(motions).map(|m| turn_between(&m.rotation, &truth.rotation));
            exact += usize::from(raw.fold(f64::INFINITY, f64::min) < 1e-6);
        }
        assert!(exact >= 36, "{exact} of 40 before any polish");
    }

    #[test]
    fn the_motion_is_found_among_noise_and_outliers_and_without_a_focal_length() {
        let focal = 500.0;
        let (truth, mut pairs) = scene(77, 200);
        let rng = Rng::new(6, "noise", 0);
        for (k, pair) in pairs.iter_mut().enumerate() {
            let wrong = k % 10 < 3;
            for (i, v) in pair.as_flattened_mut().iter_mut().enumerate() {
                let draw = (4 * k + i) as u64;
                *v = if wrong { rng.uniform(draw) - 0.5 } else { *v + 0.5 / focal * rng.normal(draw) };
            }
        }
        let found = relative(&pairs, focal, 2.0, Rng::new(7, "search", 0)).unwrap();
        assert!((120..=150).contains(&found.inliers.len()), "{}", found.inliers.len());
        assert!(turn_between(&found.motion.rotation, &truth.rotation) < 0.01);
        assert!(norm(sub(found.motion.translation, truth.translation)) < 0.03);
        let pixels: Vec<Pair> = pairs.iter().map(|p| p.map(|q| q.map(|v| v * focal))).collect();
        let found = fundamental(&pixels, 800.0, 2.0, Rng::new(8, "search", 0)).unwrap();
        assert!((120..=160).contains(&found.inliers.len()), "{}", found.inliers.len());
        let unlike = |f: f64| unlike_focal(&found.model, f);
        assert!(unlike(focal) < 0.1 && unlike(focal) < unlike(0.6 * focal) && unlike(focal) < unlike(1.8 * focal));
        let again = relative(&pairs, focal, 2.0, Rng::new(7, "search", 0)).unwrap();
        assert_eq!(again.inliers, relative(&pairs, focal, 2.0, Rng::new(7, "search", 0)).unwrap().inliers);
    }
}
