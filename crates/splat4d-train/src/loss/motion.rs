//! Losses on how the splats of any motion model move: from means and covariances at several times, without quaternions.
//!
//! The rotation that [`rigid`](super::rigid) reads from a Gaussian's quaternion is here its neighbourhood's, the best
//! rotation of its neighbours' offsets ([`arap::rotations`](super::arap::rotations)), held constant in the gradient:
//! for the sum of squares that is exact (the envelope theorem), for the robust forms below it is one step of
//! reweighting. Every function adds `weight` times its gradient to all times and returns `weight` times its value; the
//! same bits with any number of threads.

use super::LossSettings;
use super::arap::{self, OWN_FLOOR};
use super::graph::{Graph, add_to, length, over_points, square, sub, turn, turn_back};
use splat4d::math::Real;
use splat4d::scene::Table;
use splat4d::scene::splats::COV;

/// Keeps a root's derivative finite where nothing moved (Luiten et al. 2024).
const UNDER_ROOT: f64 = 1e-20;

/// Whether any of the losses on motion is on.
pub(crate) fn is_on(w: &LossSettings) -> bool {
    is_wide(w) || is_far(w) || [w.rigid, w.rot, w.velocity, w.least_motion].iter().any(|weight| *weight != 0.0)
}

/// Whether a loss reads four frames.
pub(super) fn is_wide(w: &LossSettings) -> bool {
    w.elastic > 0.0 || w.jerk > 0.0 || w.acceleration > 0.0
}

/// Whether a loss reads any other time of the clip.
pub(super) fn is_far(w: &LossSettings) -> bool {
    w.iso > 0.0 || w.arap > 0.0
}

/// Scales of the losses.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scale {
    /// 1/extent.
    pub unit: f64,
    /// Frames of the clip.
    pub clip: f64,
}

/// All losses on motion that are on: adds their gradients to `d` and returns `loss` plus their values. `seen`: splats
/// at the view's time and a frame later; if [`is_wide`], a frame before and two frames later; if [`is_far`], at any
/// other time.
///
/// A new loss is its formula below, a line here, and its weight in [`LossSettings`].
pub(super) fn terms<F: Real>(
    w: &LossSettings,
    scale: Scale,
    graph: &Graph<F>,
    seen: &[Table<F>],
    d: &mut [Table<F>],
    mut loss: f64,
) -> f64 {
    let x: Vec<Vec<[F; 3]>> = seen.iter().map(|t| (0..t.rows()).map(|r| t.read(r, 0)).collect()).collect();
    let mut g: Vec<Vec<[F; 3]>> = x.iter().map(|x| vec![[F::ZERO; 3]; x.len()]).collect();
    let Scale { unit, clip } = scale;
    if w.least_motion > 0.0 {
        let [before, now, ..] = &mut g[..] else { unreachable!("two times are always requested") };
        loss += least([&x[1], &x[0]], w.least_motion * unit, [now, before]);
    }
    if w.rigid > 0.0 || w.rot > 0.0 || w.velocity > 0.0 {
        let rotations = arap::rotations(graph, &x[1], &x[0]);
        let [before, now, ..] = &mut g[..] else { unreachable!("two times are always requested") };
        if w.rigid > 0.0 {
            let way = [&x[1][..], &x[0][..]];
            loss += rigidity(graph, &rotations, way, w.rigid * unit, [now, before]);
        }
        if w.velocity > 0.0 {
            // From scene units per frame to extents a clip.
            let weight = w.velocity * (unit * clip).powi(2);
            loss += velocity(graph, [&x[1], &x[0]], weight, [now, before]);
        }
        if w.rot > 0.0 {
            let cov: [Vec<[F; 6]>; 2] = [1, 0].map(|t| (0..seen[t].rows()).map(|r| seen[t].read(r, COV)).collect());
            let mut d_cov = [0, 1].map(|_| vec![[F::ZERO; 6]; seen[0].rows()]);
            let [d_now, d_before] = &mut d_cov;
            loss += rotation(graph, &rotations, [&cov[0], &cov[1]], w.rot, [d_now, d_before]);
            for (t, d_cov) in [1, 0].into_iter().zip(&d_cov) {
                d_cov.iter().enumerate().for_each(|(r, v)| d[t].add(r, COV, *v));
            }
        }
    }
    if is_wide(w) {
        // In the order of time: before, at, after, after that.
        let [at, after, before, last, ..] = &mut g[..] else { unreachable!("four times were requested") };
        let x = [&x[2][..], &x[0][..], &x[1][..], &x[3][..]];
        if w.jerk > 0.0 {
            loss += jerk(x, w.jerk * unit, [before, at, after, last]);
        }
        if w.acceleration > 0.0 {
            loss += acceleration([x[0], x[1], x[2]], w.acceleration * unit * unit, [before, at, after]);
        }
        if w.elastic > 0.0 {
            let mut d: [&mut [[F; 3]]; 4] = [before, at, after, last];
            loss += arap::elastic(graph, &x, OWN_FLOOR / (unit * unit), w.elastic, &mut d);
        }
    }
    if is_far(w) {
        let (far, others) = g.split_last_mut().expect("times were requested");
        let pair = [&x[0][..], &x[x.len() - 1][..]];
        if w.iso > 0.0 {
            loss += isometry(graph, pair, w.iso * unit, [&mut others[0], far]);
        }
        if w.arap > 0.0 {
            loss += arap::arap(graph, pair, w.arap * unit * unit, [&mut others[0], far]);
        }
    }
    for (d, g) in d.iter_mut().zip(&g) {
        g.iter().enumerate().for_each(|(r, v)| d.add(r, 0, *v));
    }
    loss
}

/// Rigidity: mean over edges of √(w ‖e − R_i e⁰‖² + ε), scene units; e now, e⁰ before, R_i the turn of i's neighbours.
///
/// Source: Luiten et al. 2024, equation 8, with the neighbourhood's turn in place of the Gaussian's own.
pub(crate) fn rigidity<F: Real>(
    graph: &Graph<F>,
    rotations: &[[[F; 3]; 3]],
    [now, before]: [&[[F; 3]]; 2],
    weight: f64,
    [d_now, d_before]: [&mut [[F; 3]]; 2],
) -> f64 {
    let n = graph.len();
    assert!([now.len(), before.len(), rotations.len(), d_now.len(), d_before.len()] == [n; 5], "{n} points");
    let scale = weight / graph.edges().max(1) as f64;
    let (eps, factor) = (F::of(UNDER_ROOT), F::of(scale));
    let edge = |i: usize, e: usize, j: usize| {
        let r = sub(sub(now[j], now[i]), turn(&rotations[i], sub(before[j], before[i])));
        let w = graph.weights()[e];
        let root = (w * square(r) + eps).sqrt();
        (root, r.map(|x| factor * w * x / root))
    };
    let mut d: Vec<(&mut [F; 3], &mut [F; 3])> = d_now.iter_mut().zip(d_before).collect();
    scale
        * over_points(&mut d, |i, (d_now, d_before)| {
            let mut sum = 0.0;
            for (e, j) in graph.edges_from(i) {
                let (value, g) = edge(i, e, j);
                sum += value.f64();
                add_to(d_now, g, -F::ONE);
                add_to(d_before, turn_back(&rotations[i], g), F::ONE);
            }
            for (e, from) in graph.edges_to(i) {
                let (_, g) = edge(from, e, i);
                add_to(d_now, g, F::ONE);
                add_to(d_before, turn_back(&rotations[from], g), -F::ONE);
            }
            sum
        })
}

fn full<F: Real>([xx, xy, xz, yy, yz, zz]: [F; 6]) -> [[F; 3]; 3] {
    [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
}

/// Rotation: mean over the points that have neighbours of √(‖Σ − R Σ⁰ Rᵀ‖² + ε)/tr Σ⁰, no unit: a Gaussian turns as its
/// neighbourhood does. Covariances are packed (xx xy xz yy yz zz); the trace is held constant in the gradient, so that
/// nothing is gained by growing.
///
/// Source: ours; Luiten et al. 2024, equation 9, for models that result with covariances.
pub(crate) fn rotation<F: Real>(
    graph: &Graph<F>,
    rotations: &[[[F; 3]; 3]],
    [now, before]: [&[[F; 6]]; 2],
    weight: f64,
    [d_now, d_before]: [&mut [[F; 6]]; 2],
) -> f64 {
    let n = graph.len();
    assert!([now.len(), before.len(), rotations.len(), d_now.len(), d_before.len()] == [n; 5], "{n} points");
    let count = (0..n).filter(|&i| graph.edges_from(i).next().is_some()).count();
    let scale = weight / count.max(1) as f64;
    let (eps, factor) = (F::of(UNDER_ROOT), F::of(scale));
    let pack = |g: [[F; 3]; 3]| [g[0][0], F::TWO * g[0][1], F::TWO * g[0][2], g[1][1], F::TWO * g[1][2], g[2][2]];
    let mut d: Vec<(&mut [F; 6], &mut [F; 6])> = d_now.iter_mut().zip(d_before).collect();
    scale
        * over_points(&mut d, |i, (d_now, d_before)| {
            let trace = before[i][0] + before[i][3] + before[i][5];
            if graph.edges_from(i).next().is_none() || trace <= F::ZERO {
                return 0.0;
            }
            let (r, a, b) = (&rotations[i], full(now[i]), full(before[i]));
            // The residual relative to the size, so that squares of small covariances stay in f32's range.
            let rb: [[F; 3]; 3] =
                std::array::from_fn(|k| std::array::from_fn(|l| (0..3).map(|m| r[k][m] * b[m][l]).sum()));
            let e: [[F; 3]; 3] = std::array::from_fn(|k| {
                std::array::from_fn(|l| (a[k][l] - (0..3).map(|m| rb[k][m] * r[l][m]).sum::<F>()) / trace)
            });
            let root = (e.iter().map(|row| square(*row)).sum::<F>() + eps).sqrt();
            let g = e.map(|row| row.map(|x| factor * x / root / trace));
            add_to(d_now, pack(g), F::ONE);
            // −Rᵀ G R
            let gr: [[F; 3]; 3] =
                std::array::from_fn(|k| std::array::from_fn(|l| (0..3).map(|m| g[k][m] * r[m][l]).sum()));
            let back: [[F; 3]; 3] =
                std::array::from_fn(|k| std::array::from_fn(|l| (0..3).map(|m| r[m][k] * gr[m][l]).sum()));
            add_to(d_before, pack(back), -F::ONE);
            root.f64()
        })
}

/// Isometry: mean over edges of √(w (‖e‖ − ‖e*‖)² + ε), scene units: distances are alike at any two times.
///
/// Source: Luiten et al. 2024, equation 10, with another time in place of the first frame.
pub(crate) fn isometry<F: Real>(
    graph: &Graph<F>,
    [one, other]: [&[[F; 3]]; 2],
    weight: f64,
    [d_one, d_other]: [&mut [[F; 3]]; 2],
) -> f64 {
    let n = graph.len();
    assert!([one.len(), other.len(), d_one.len(), d_other.len()] == [n; 4], "{n} points");
    let scale = weight / graph.edges().max(1) as f64;
    let (eps, factor) = (F::of(UNDER_ROOT), F::of(scale));
    let edge = |i: usize, e: usize, j: usize| {
        let (a, b) = (sub(one[j], one[i]), sub(other[j], other[i]));
        let (la, lb, w) = (length(a), length(b), graph.weights()[e]);
        let root = (w * (la - lb) * (la - lb) + eps).sqrt();
        let g = factor * w * (la - lb) / root;
        let along = |v: [F; 3], l: F| if l > F::ZERO { v.map(|x| x * g / l) } else { [F::ZERO; 3] };
        (root, along(a, la), along(b, lb))
    };
    let mut d: Vec<(&mut [F; 3], &mut [F; 3])> = d_one.iter_mut().zip(d_other).collect();
    scale
        * over_points(&mut d, |i, (d_one, d_other)| {
            let mut sum = 0.0;
            for (e, j) in graph.edges_from(i) {
                let (value, a, b) = edge(i, e, j);
                sum += value.f64();
                add_to(d_one, a, -F::ONE);
                add_to(d_other, b, F::ONE);
            }
            for (e, from) in graph.edges_to(i) {
                let (_, a, b) = edge(from, e, i);
                add_to(d_one, a, F::ONE);
                add_to(d_other, b, -F::ONE);
            }
            sum
        })
}

/// Velocity: mean over edges of ‖v_i − v_j‖², (scene units)², v = x − x⁰ the displacement from one time to the next:
/// neighbours move alike. Edges count alike, independent of the graph's weights.
pub(crate) fn velocity<F: Real>(
    graph: &Graph<F>,
    [now, before]: [&[[F; 3]]; 2],
    weight: f64,
    [d_now, d_before]: [&mut [[F; 3]]; 2],
) -> f64 {
    let n = graph.len();
    assert!([now.len(), before.len(), d_now.len(), d_before.len()] == [n; 4], "{n} points");
    let scale = weight / graph.edges().max(1) as f64;
    let factor = F::of(2.0 * scale);
    let differ = |i: usize, j: usize| sub(sub(now[j], before[j]), sub(now[i], before[i]));
    let mut d: Vec<(&mut [F; 3], &mut [F; 3])> = d_now.iter_mut().zip(d_before).collect();
    scale
        * over_points(&mut d, |i, (d_now, d_before)| {
            let (mut sum, mut g) = (0.0, [F::ZERO; 3]);
            for (_, j) in graph.edges_from(i) {
                let r = differ(i, j);
                sum += square(r).f64();
                add_to(&mut g, r, -factor);
            }
            for (_, from) in graph.edges_to(i) {
                add_to(&mut g, differ(from, i), factor);
            }
            add_to(d_now, g, F::ONE);
            add_to(d_before, g, -F::ONE);
            sum
        })
}

/// Jerk: mean over points of ‖x₃ − 3 x₂ + 3 x₁ − x₀‖, scene units, of four times one step apart: steady acceleration
/// is free, jitter is not.
pub(crate) fn jerk<F: Real>(at: [&[[F; 3]]; 4], weight: f64, d: [&mut [[F; 3]]; 4]) -> f64 {
    let n = at[0].len();
    assert!(at.iter().all(|x| x.len() == n) && d.iter().all(|x| x.len() == n), "{n} points");
    const BINOMIAL: [f64; 4] = [-1.0, 3.0, -3.0, 1.0];
    let third = |i: usize| {
        let mut v = [F::ZERO; 3];
        (0..4).for_each(|t| add_to(&mut v, at[t][i], F::of(BINOMIAL[t])));
        v
    };
    let scale = weight / n.max(1) as f64;
    let mut unused = vec![(); n];
    let sum = over_points(&mut unused, |i, ()| length(third(i)).f64());
    for (d, share) in d.into_iter().zip(BINOMIAL) {
        over_points(d, |i, d| {
            let v = third(i);
            let long = length(v);
            if long > F::ZERO {
                add_to(d, v, F::of(scale * share) / long);
            }
            0.0
        });
    }
    scale * sum
}

/// Acceleration: mean over points of ½‖s⁺ + s⁻‖², s⁺ = x₂ − x₁ the flow to the next time and s⁻ = x₀ − x₁ to the last
/// one, scene units²: steady motion is free.
///
/// Source: Li et al. 2021 (NSFF), temporal scene flow smoothness.
pub(crate) fn acceleration<F: Real>(at: [&[[F; 3]]; 3], weight: f64, d: [&mut [[F; 3]]; 3]) -> f64 {
    let n = at[0].len();
    assert!(at.iter().all(|x| x.len() == n) && d.iter().all(|x| x.len() == n), "{n} points");
    let second = |i: usize| -> [F; 3] { std::array::from_fn(|k| at[2][i][k] - F::TWO * at[1][i][k] + at[0][i][k]) };
    let scale = weight / n.max(1) as f64;
    let mut unused = vec![(); n];
    let sum = over_points(&mut unused, |i, ()| 0.5 * square(second(i)).f64());
    for (d, share) in d.into_iter().zip([1.0, -2.0, 1.0]) {
        over_points(d, |i, d| {
            add_to(d, second(i), F::of(scale * share));
            0.0
        });
    }
    scale * sum
}

/// Least motion: mean over points of ‖x₁ − x₀‖₁, scene units: what need not move stays.
///
/// Source: Li et al. 2021 (NSFF), minimal scene flow.
pub(crate) fn least<F: Real>([now, before]: [&[[F; 3]]; 2], weight: f64, [d_now, d_before]: [&mut [[F; 3]]; 2]) -> f64 {
    let n = now.len();
    assert!([before.len(), d_now.len(), d_before.len()] == [n; 3], "{n} points");
    let scale = weight / n.max(1) as f64;
    let mut d: Vec<(&mut [F; 3], &mut [F; 3])> = d_now.iter_mut().zip(d_before).collect();
    scale
        * over_points(&mut d, |i, (d_now, d_before)| {
            let way = sub(now[i], before[i]);
            let sign = |x: F| {
                if x > F::ZERO {
                    F::ONE
                } else if x < F::ZERO {
                    -F::ONE
                } else {
                    F::ZERO
                }
            };
            let signs = way.map(sign);
            add_to(d_now, signs, F::of(scale));
            add_to(d_before, signs, F::of(-scale));
            way.iter().map(|x| x.abs().f64()).sum()
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::arap::rotations;
    use crate::loss::graph::Weigh;
    use splat4d::math::sym3::from_quat_log_scales;
    use splat4d::math::{Rng, quat};

    const N: usize = 30;
    type Points = Vec<[f64; 3]>;

    fn normals<const W: usize>(purpose: &str, size: f64) -> Vec<[f64; W]> {
        let rng = Rng::new(11, purpose, 0);
        (0..N as u64).map(|i| std::array::from_fn(|a| size * rng.fork(i).normal(a as u64))).collect()
    }

    fn plus<const W: usize>(a: &[[f64; W]], b: Vec<[f64; W]>) -> Vec<[f64; W]> {
        a.iter().zip(b).map(|(a, b)| std::array::from_fn(|k| a[k] + b[k])).collect()
    }

    /// Finite differences of every kind of table in `at`.
    fn check<const W: usize>(
        at: &[Vec<[f64; W]>],
        loss: impl Fn(&[Vec<[f64; W]>], &mut [Vec<[f64; W]>]) -> f64,
    ) -> f64 {
        let zeros: Vec<Vec<[f64; W]>> = at.iter().map(|a| vec![[0.0; W]; a.len()]).collect();
        let mut d = zeros.clone();
        let value = loss(at, &mut d);
        for t in 0..at.len() {
            for i in [0, 11, 29] {
                for k in 0..W {
                    let by = |h: f64| {
                        let mut at = at.to_vec();
                        at[t][i][k] += h;
                        loss(&at, &mut zeros.clone())
                    };
                    let fd = (by(1e-6) - by(-1e-6)) / 2e-6;
                    assert!((fd - d[t][i][k]).abs() < 1e-7 * (1.0 + fd.abs()), "{t} {i} {k}: {fd} {}", d[t][i][k]);
                }
            }
        }
        value
    }

    fn two(d: &mut [Points]) -> [&mut [[f64; 3]]; 2] {
        let [a, b] = d else { panic!("two instants") };
        [a, b]
    }

    #[test]
    fn gradients_equal_finite_differences() {
        let rest: Points = normals("rest", 1.0);
        let g = Graph::new(&rest, 6, Weigh::Median(1.0));
        let at = [plus(&rest, normals("a", 0.2)), plus(&rest, normals("b", 0.2))];
        let r = rotations(&g, &at[0], &at[1]);
        let values = [
            check(&at, |at, d| rigidity(&g, &r, [&at[0], &at[1]], 0.7, two(d))),
            check(&at, |at, d| isometry(&g, [&at[0], &at[1]], 0.7, two(d))),
            check(&at, |at, d| velocity(&g, [&at[0], &at[1]], 0.7, two(d))),
        ];
        assert!(values.iter().all(|v| *v > 0.01), "{values:?}");
        let at: [Points; 4] = ["a", "b", "c", "d"].map(|p| plus(&rest, normals(p, 0.1)));
        check(&at, |at, d| {
            let [a, b, c, e] = d else { panic!("four instants") };
            jerk([&at[0], &at[1], &at[2], &at[3]], 0.7, [a, b, c, e])
        });
        check(&at[..3], |at, d| {
            let [a, b, c] = d else { panic!("three instants") };
            acceleration([&at[0], &at[1], &at[2]], 0.7, [a, b, c])
        });
        check(&at[..2], |at, d| least([&at[0], &at[1]], 0.7, two(d)));
        let steady: [Points; 3] = [0.0, 1.0, 2.0].map(|t| rest.iter().map(|p| p.map(|x| x + 0.3 * t)).collect());
        let mut d = vec![vec![[0.0; 3]; N]; 3];
        let [a, b, c] = &mut d[..] else { panic!("three instants") };
        assert!(acceleration([&steady[0], &steady[1], &steady[2]], 1.0, [a, b, c]) < 1e-12, "steady motion is free");
        let cov = |p: &str| -> Vec<[f64; 6]> {
            normals::<7>(p, 0.5)
                .iter()
                .map(|x| from_quat_log_scales([x[0], x[1], x[2], x[3]], [x[4], x[5], x[6]]))
                .collect()
        };
        // The trace by which it is divided is held: the value to differentiate keeps that of the base.
        let (now, before) = (cov("now"), cov("before"));
        let at = [now.clone()];
        check(&at, |at, d| rotation(&g, &r, [&at[0], &before], 0.7, [&mut d[0], &mut vec![[0.0; 6]; N]]));
        let trace = |i: usize, c: &[[f64; 6]]| c[i][0] + c[i][3] + c[i][5];
        let base: Vec<f64> = (0..N).map(|i| trace(i, &before)).collect();
        let mut d = vec![[0.0; 6]; N];
        rotation(&g, &r, [&now, &before], 0.7, [&mut vec![[0.0; 6]; N], &mut d]);
        for (i, k) in [(0, 0), (3, 1), (7, 4), (29, 5)] {
            let one = |h: f64| {
                let mut moved = before.clone();
                moved[i][k] += h;
                let only = |c: &[[f64; 6]]| {
                    // Point i's own term, with its trace put back to the base's.
                    let (a, b) = (full(now[i]), full(c[i]));
                    let mut sum = 0.0;
                    for p in 0..3 {
                        for q in 0..3 {
                            let mut turned = 0.0;
                            for m in 0..3 {
                                for l in 0..3 {
                                    turned += r[i][p][m] * b[m][l] * r[i][q][l];
                                }
                            }
                            sum += ((a[p][q] - turned) / base[i]).powi(2);
                        }
                    }
                    0.7 * sum.sqrt() / N as f64
                };
                only(&moved)
            };
            let fd = (one(1e-6) - one(-1e-6)) / 2e-6;
            assert!((fd - d[i][k]).abs() < 1e-7 * (1.0 + fd.abs()), "{i} {k}: {fd} {}", d[i][k]);
        }
    }

    #[test]
    fn only_non_rigid_motion_has_a_loss() {
        let rest: Points = normals("rest", 1.0);
        let g = Graph::new(&rest, 6, Weigh::Median(1.0));
        let q = quat::normalize([0.4, 0.7, -0.2, 0.3]).0;
        let m = quat::to_rotation(q);
        let moved: Points = rest.iter().map(|&p| turn(&m, p).map(|x| x + 3.0)).collect();
        let shapes: Vec<[f64; 7]> = normals("shape", 0.5);
        let cov = |by: [f64; 4]| -> Vec<[f64; 6]> {
            let one = |x: &[f64; 7]| {
                let own = quat::product(by, [x[0], x[1], x[2], x[3]]);
                from_quat_log_scales(own, [x[4], x[5], x[6]])
            };
            shapes.iter().map(one).collect()
        };
        let r = rotations(&g, &moved, &rest);
        let value = |now: &Points, before: &Points| {
            let mut d = vec![vec![[0.0; 3]; N]; 2];
            let mut e = d.clone();
            [rigidity(&g, &r, [now, before], 1.0, two(&mut d)), isometry(&g, [now, before], 1.0, two(&mut e))]
        };
        let turned = |now: &[[f64; 6]], before: &[[f64; 6]]| {
            rotation(&g, &r, [now, before], 1.0, [&mut vec![[0.0; 6]; N], &mut vec![[0.0; 6]; N]])
        };
        let still = [1.0, 0.0, 0.0, 0.0];
        assert!(value(&moved, &rest).iter().all(|v| *v < 1e-9) && turned(&cov(q), &cov(still)) < 1e-9);
        assert!(turned(&cov(still), &cov(still)) > 0.1, "shapes that stay while their neighbourhood turns");
        assert!(value(&plus(&moved, normals("shake", 0.1)), &rest).iter().all(|v| *v > 0.01));
    }
}
