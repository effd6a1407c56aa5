//! Identities of the geometry, and every VJP against central differences.

use super::*;
use crate::math::{Rng, sym3};

/// Half the step of central differences.
const H: f64 = 1e-6;
/// Differences against gradients, relative and for what is nearly zero.
const FD: f64 = 1e-6;
/// Identities in f64.
const EXACT: f64 = 1e-10;

type Normal = ([f64; 3], Mat3);

/// A Gaussian whose axes are exp(spread · normal) long.
fn normal(rng: Rng, spread: f64) -> Normal {
    let x: [f64; 10] = std::array::from_fn(|k| rng.normal(k as u64));
    let cov = sym3::from_quat_log_scales([x[0], x[1], x[2], x[3]], [x[4], x[5], x[6]].map(|s| spread * s));
    ([x[7], x[8], x[9]], unpack(cov))
}

fn normals<const N: usize>(seed: u64, spread: f64) -> [Normal; N] {
    std::array::from_fn(|i| normal(Rng::new(seed, "spd", 0).fork(i as u64), spread))
}

/// W₂ of two Gaussians.
fn w2(a: &Normal, b: &Normal) -> f64 {
    let means: f64 = (0..3).map(|k| (a.0[k] - b.0[k]).powi(2)).sum();
    (means + bures(&a.1, &b.1).0).sqrt()
}

fn largest(a: &Mat3) -> f64 {
    a.iter().flatten().fold(0.0, |m, x| m.max(x.abs()))
}

fn assert_near(a: &Mat3, b: &Mat3, tolerance: f64, what: &str) {
    let off = largest(&mix(1.0, a, -1.0, b));
    assert!(off <= tolerance * largest(a).max(largest(b)).max(1e-300), "{what}: {a:?} and {b:?} differ by {off}");
}

/// Gradients of f to the packed numbers of matrices against central differences.
fn check<const N: usize>(at: [Mat3; N], d: [Mat3; N], f: impl Fn(&[Mat3; N]) -> f64, what: &str) {
    for i in 0..N {
        let got: [f64; 6] = pack_gradient(&d[i]);
        for k in 0..6 {
            let moved = |h: f64| {
                let mut x = at;
                let mut c: [f64; 6] = pack(&x[i]);
                c[k] += h;
                x[i] = unpack(c);
                f(&x)
            };
            let fd = (moved(H) - moved(-H)) / (2.0 * H);
            assert!((fd - got[k]).abs() <= FD * (1.0 + fd.abs()), "{what}, matrix {i} entry {k}: {fd} and {}", got[k]);
        }
    }
}

fn weights(seed: u64) -> Mat3 {
    let w: [f64; 6] = std::array::from_fn(|k| Rng::new(seed, "weights", 0).normal(k as u64));
    unpack(w)
}

#[test]
fn eigenvalues_rebuild_the_matrix_and_may_be_equal() {
    for seed in 0..50 {
        let [(_, a)] = normals(seed, 1.0);
        let e = Eigen::of(&a);
        assert_near(&e.map(|x| x), &a, 1e-13, "V diag V'");
        let mut sorted = e.values;
        sorted.sort_by(|x, y| y.total_cmp(x));
        let (truth, _) = sym3::eigen(pack(&a));
        assert!((0..3).all(|k| (sorted[k] / truth[k] - 1.0).abs() < 1e-10));
    }
    for a in [IDENTITY, [[0.0; 3]; 3], [[2.0, 1.0, 1.0], [1.0, 2.0, 1.0], [1.0, 1.0, 2.0]]] {
        assert_near(&Eigen::of(&a).map(|x| x), &a, 1e-14, "equal eigenvalues");
    }
    let [(_, a)] = normals(7, 1.0);
    assert_near(&mul(&inverse(&a), &a), &IDENTITY, 1e-10, "inverse");
}

#[test]
fn the_distance_is_a_metric() {
    for seed in 0..200 {
        let [a, b, c] = normals(seed, 0.8);
        assert_eq!(w2(&a, &a), 0.0);
        assert!((w2(&a, &b) - w2(&b, &a)).abs() < EXACT * w2(&a, &b), "symmetric");
        assert!(w2(&a, &c) <= w2(&a, &b) + w2(&b, &c) + EXACT, "triangle");
        // The formula by its trace.
        let half = Eigen::of(&a.1).map(f64::sqrt);
        let root = trace(&Eigen::of(&sandwich(&half, &b.1)).map(f64::sqrt));
        let means: f64 = (0..3).map(|k| (a.0[k] - b.0[k]).powi(2)).sum();
        let formula = means + trace(&a.1) + trace(&b.1) - 2.0 * root;
        assert!((w2(&a, &b).powi(2) - formula).abs() < EXACT * (1.0 + formula), "{formula}");
    }
}

#[test]
fn covariances_that_commute_differ_by_their_axes() {
    for seed in 0..50 {
        let x: [f64; 10] = std::array::from_fn(|k| Rng::new(seed, "commute", 0).normal(k as u64));
        let cov = |l: [f64; 3]| unpack(sym3::from_quat_log_scales([x[0], x[1], x[2], x[3]], l));
        let (p, q) = ([x[4], x[5], x[6]], [x[7], x[8], x[9]]);
        let truth: f64 = (0..3).map(|k| (p[k].exp() - q[k].exp()).powi(2)).sum();
        assert!((bures(&cov(p), &cov(q)).0 - truth).abs() < EXACT * (1.0 + truth));
    }
    // Diagonal: Σ (√a − √b)².
    let d = |x: [f64; 3]| [[x[0], 0.0, 0.0], [0.0, x[1], 0.0], [0.0, 0.0, x[2]]];
    let found = bures(&d([4.0, 9.0, 0.25]), &d([1.0, 16.0, 0.25])).0;
    assert!((found - 2.0).abs() < EXACT, "{found}");
}

/// A covariance of condition 1e4.
fn stiff(seed: u64) -> Mat3 {
    let x: [f64; 4] = std::array::from_fn(|k| Rng::new(seed, "stiff", 0).normal(k as u64));
    unpack(sym3::from_quat_log_scales(x, [0.0, -(10f64.ln()), -(100f64.ln())]))
}

#[test]
fn the_map_carries_one_to_the_other() {
    for seed in 0..100 {
        let [(_, a), (_, b)] = normals(seed, 0.8);
        let t = Transport::new(&a, &b);
        assert_near(&sandwich(&t.map, &a), &b, EXACT, "f64");
        assert_near(&mul(&t.map, &t.back()), &IDENTITY, 1e-9, "the backward pass");
        assert_near(&Transport::new(&b, &a).map, &t.back(), 1e-9, "the backward pass");
        let (a, b) = (stiff(seed), stiff(seed + 1000));
        assert_near(&sandwich(&Transport::new(&a, &b).map, &a), &b, EXACT, "f64, condition 1e4");
        // As stored in 32 bits.
        let [a, b] = [a, b].map(|m| unpack::<f32>(pack(&m)));
        let t = unpack::<f32>(pack(&Transport::new(&a, &b).map));
        assert_near(&sandwich(&t, &a), &b, 1e-4, "f32, condition 1e4");
    }
}

#[test]
fn exponential_and_logarithm_are_inverse() {
    for seed in 0..100 {
        // Within reach: no axis shrinks to less than the clamp.
        let [a, b] = normals(seed, 0.3);
        let v = log(&a.1, &b.1);
        assert_near(&exp(&a.1, &v), &b.1, EXACT, "Exp(Log)");
        assert_near(&exp(&a.1, &[[0.0; 3]; 3]), &a.1, 1e-14, "Exp(0)");
        // The tangent's norm is the distance: tr ΓΣΓ + ‖v‖².
        let gamma = lyapunov(&Eigen::of(&a.1), &v);
        let means: f64 = (0..3).map(|k| (a.0[k] - b.0[k]).powi(2)).sum();
        let norm = means + inner(&mul(&gamma, &a.1), &gamma);
        assert!((norm - w2(&a, &b).powi(2)).abs() < EXACT * (1.0 + norm));
        // Constant velocity is the geodesic backwards; a large one is clamped in both.
        let predicted = Geodesic::new(&a.1, &b.1, -1.0).point;
        assert_near(&predicted, &exp(&a.1, &mix(-1.0, &v, 0.0, &v)), 1e-9, "Exp(-Log)");
        assert!(Eigen::of(&predicted).values.iter().all(|x| *x > 0.0), "{predicted:?}");
    }
}

#[test]
fn geodesics_have_constant_speed() {
    for seed in 0..60 {
        let [a, b] = normals(seed, 0.8);
        let all = w2(&a, &b);
        for s in [0.0, 0.2, 0.5, 0.9, 1.0] {
            let mean = std::array::from_fn(|k| (1.0 - s) * a.0[k] + s * b.0[k]);
            let point = (mean, Geodesic::new(&a.1, &b.1, s).point);
            assert!((w2(&a, &point) - s * all).abs() < 1e-9 * (1.0 + all), "{s}");
        }
        assert_near(&Geodesic::new(&a.1, &b.1, 1.0).point, &b.1, EXACT, "the end");
    }
}

#[test]
fn a_rigid_motion_of_both_changes_no_distance() {
    for seed in 0..60 {
        let [a, b, turn] = normals(seed, 0.8);
        let r = Eigen::of(&turn.1).vectors;
        let transposed: Mat3 = std::array::from_fn(|i| std::array::from_fn(|j| r[j][i]));
        let moved = |n: &Normal| {
            let mean = apply(&r, n.0);
            (std::array::from_fn(|k| mean[k] + turn.0[k]), symmetric(&mul(&mul(&r, &n.1), &transposed)))
        };
        assert!((w2(&moved(&a), &moved(&b)) - w2(&a, &b)).abs() < EXACT * (1.0 + w2(&a, &b)));
    }
}

#[test]
fn gradients_equal_differences() {
    let mut clamped = 0;
    for seed in 0..20 {
        let [(_, a), (_, b)] = normals(seed, 0.4);
        let w = weights(seed);
        let (_, d_a, d_b) = bures(&a, &b);
        check([a, b], [d_a, d_b], |[a, b]| bures(a, b).0, "distance");
        let t = Transport::new(&a, &b);
        let (d_a, d_b) = t.backward(&w);
        check([a, b], [d_a, d_b], |[a, b]| inner(&Transport::new(a, b).map, &w), "map");
        // Between, and far beyond either end, where the stretch is clamped.
        for s in [0.3, 0.8, -0.5, -1.0, -4.0, 2.5] {
            let g = Geodesic::new(&a, &b, s);
            let (d_a, d_b, d_s) = g.backward(&w);
            check([a, b], [d_a, d_b], |[a, b]| inner(&Geodesic::new(a, b, s).point, &w), "geodesic");
            let at = |s: f64| inner(&Geodesic::new(&a, &b, s).point, &w);
            let fd = (at(s + H) - at(s - H)) / (2.0 * H);
            assert!((fd - d_s).abs() < FD * (1.0 + fd.abs()), "s = {s}: {fd} and {d_s}");
        }
        clamped += usize::from(Geodesic::new(&a, &b, -4.0).path.is_some_and(|p| p.clamped.is_some()));
        let floor = 0.5 * (Eigen::of(&a).values[0] + Eigen::of(&a).values[1]);
        check([a], [Lifted::new(&a, floor).backward(&w)], |[a]| inner(&Lifted::new(a, floor).matrix, &w), "lifted");
    }
    assert!(clamped > 5, "the clamp was reached {clamped} times");
}

#[test]
fn equal_ends_are_the_limit_of_neighbours() {
    for seed in 0..20 {
        let [(_, a), (_, b)] = normals(seed, 0.4);
        let near = mix(1.0, &a, 1e-7, &b);
        let w = weights(seed);
        for s in [0.4, -1.0] {
            let (x, y, _) = Geodesic::new(&a, &a, s).backward(&w);
            let (p, q, _) = Geodesic::new(&a, &near, s).backward(&w);
            assert_near(&x, &p, 1e-4, "from");
            assert_near(&y, &q, 1e-4, "to");
        }
    }
}

#[test]
fn no_covariance_of_32_bits_gives_nan() {
    const COUNT: u64 = if cfg!(debug_assertions) { 20_000 } else { 1_000_000 };
    let rng = Rng::new(11, "fuzz", 0);
    let mut last = [IDENTITY; 2];
    for i in 0..COUNT {
        let draw = |k: u64| rng.uniform(i * 8 + k) as f32;
        let q: [f32; 4] = std::array::from_fn(|k| draw(k as u64) - 0.5);
        // Axes from 1e-9 to 1e4, flat ones and needles among them.
        let l: [f32; 3] = std::array::from_fn(|k| 30.0 * draw(4 + k as u64) - 20.7);
        let mut c = sym3::from_quat_log_scales(q, l);
        if i % 7 == 0 {
            // Rounding may leave a flat splat slightly indefinite, or a point.
            c = c.map(|x| if i % 14 == 0 { 0.0 } else { x * (1.0 + 1e-6 * (draw(7) - 0.5)) });
        }
        let now = unpack(c);
        let (value, d_a, d_b) = bures(&last[1], &now);
        let whole = largest(&d_a) + largest(&d_b) + value;
        assert!((whole as f32).is_finite(), "row {i}: {last:?} {now:?}");
        last = [last[1], now];
        if i % 8 != 0 {
            continue;
        }
        let g = Geodesic::new(&last[1], &last[0], -1.0);
        let (d_c, d_d, d_s) = g.backward(&IDENTITY);
        let whole = [g.point, d_c, d_d].map(|m| largest(&m)).iter().sum::<f64>() + d_s;
        // NaN and what 32 bits cannot hold both fail.
        assert!((whole as f32).is_finite(), "row {i}: {last:?}");
    }
}
