//! As rigid as possible, and smooth in time: losses on positions alone, for control nodes and for any model.
//!
//! Every function adds `weight` times its gradient and returns `weight` times its value; the same bits with any number
//! of threads.

use super::graph::{Graph, add_to, length, over_points, square, sub, turn, turn_back};
use rayon::prelude::*;
use splat4d::math::Real;
use splat4d::math::mat3::procrustes;

/// Added to a value before it divides itself (SC-GS).
pub(crate) const OWN_FLOOR: f64 = 1e-5;

/// The rotation of every point's neighbourhood from `second` to `first`: R_i = argmin Σ_j w ‖e¹_ij − R e²_ij‖².
///
/// A neighbourhood that has not moved, or is alone, gives the identity.
pub(crate) fn rotations<F: Real>(graph: &Graph<F>, first: &[[F; 3]], second: &[[F; 3]]) -> Vec<[[F; 3]; 3]> {
    let n = graph.len();
    assert!([first.len(), second.len()] == [n; 2], "{n} points");
    let one = |i: usize| {
        let mut cov = [[F::ZERO; 3]; 3];
        for (e, j) in graph.edges_from(i) {
            let (a, b, w) = (sub(first[j], first[i]), sub(second[j], second[i]), graph.weights()[e]);
            for r in 0..3 {
                add_to(&mut cov[r], b, w * a[r]);
            }
        }
        procrustes(cov)
    };
    (0..n).into_par_iter().with_min_len(64).map(one).collect()
}

/// As rigid as possible between two times: Σ w ‖e¹ − R̂ e²‖² / Σ w, (scene units)². Each point's R̂ is that of
/// [`rotations`]; being the best, it needs no derivative (the envelope theorem). Adds to the gradients of both times.
///
/// Source: Sorkine and Alexa 2007; SC-GS (Huang et al. 2024).
pub(crate) fn arap<F: Real>(
    graph: &Graph<F>,
    [first, second]: [&[[F; 3]]; 2],
    weight: f64,
    [d_first, d_second]: [&mut [[F; 3]]; 2],
) -> f64 {
    let n = graph.len();
    assert!([d_first.len(), d_second.len()] == [n; 2], "{n} points");
    let rotations = rotations(graph, first, second);
    let total: f64 = graph.weights().iter().map(|w| w.f64()).sum();
    let scale = weight / total.max(f64::MIN_POSITIVE.sqrt());
    let factor = F::of(2.0 * scale);
    let edge = |i: usize, e: usize, j: usize| {
        let r = sub(sub(first[j], first[i]), turn(&rotations[i], sub(second[j], second[i])));
        let w = graph.weights()[e];
        (w * square(r), r.map(|x| factor * w * x))
    };
    let mut d: Vec<(&mut [F; 3], &mut [F; 3])> = d_first.iter_mut().zip(d_second).collect();
    scale
        * over_points(&mut d, |i, (d_first, d_second)| {
            let mut sum = 0.0;
            for (e, j) in graph.edges_from(i) {
                let (value, g) = edge(i, e, j);
                sum += value.f64();
                add_to(d_first, g, -F::ONE);
                add_to(d_second, turn_back(&rotations[i], g), F::ONE);
            }
            for (e, from) in graph.edges_to(i) {
                let (_, g) = edge(from, e, i);
                add_to(d_first, g, F::ONE);
                add_to(d_second, turn_back(&rotations[from], g), -F::ONE);
            }
            sum
        })
}

/// V / (stopgrad\[V\] + `floor`), V the mean over edges of the variance of their lengths over the times, (scene
/// units)²: its gradient is that of ln V, whatever the unit. Adds to the gradients of every time.
///
/// Source: SC-GS (Huang et al. 2024), with `floor` = [`OWN_FLOOR`] and eight times.
pub(crate) fn elastic<F: Real>(
    graph: &Graph<F>,
    at: &[&[[F; 3]]],
    floor: f64,
    weight: f64,
    d: &mut [&mut [[F; 3]]],
) -> f64 {
    let (n, times) = (graph.len(), at.len());
    assert!(d.len() == times && at.iter().all(|x| x.len() == n) && d.iter().all(|x| x.len() == n), "{n} points");
    if times == 0 || graph.edges() == 0 {
        return 0.0;
    }
    let lengths = |i: usize, j: usize| (0..times).map(move |t| length(sub(at[t][j], at[t][i])));
    let mean = |i: usize, j: usize| lengths(i, j).fold(F::ZERO, |a, b| a + b) / F::of(times as f64);
    let mut unused = vec![(); n];
    let variance = over_points(&mut unused, |i, ()| {
        let edge = |(_, j): (usize, usize)| {
            let m = mean(i, j);
            lengths(i, j).map(|l| ((l - m) * (l - m)).f64()).sum::<f64>()
        };
        graph.edges_from(i).map(edge).sum()
    }) / (graph.edges() * times) as f64;
    let scale = weight / (variance + floor);
    let factor = F::of(2.0 * scale / (graph.edges() * times) as f64);
    for (t, d) in d.iter_mut().enumerate() {
        over_points(d, |i, d| {
            // The same for an edge from either end: its length has no direction.
            for j in graph.edges_from(i).map(|x| x.1).chain(graph.edges_to(i).map(|x| x.1)) {
                let v = sub(at[t][i], at[t][j]);
                let long = length(v);
                if long > F::ZERO {
                    add_to(d, v, factor * (long - mean(i, j)) / long);
                }
            }
            0.0
        });
    }
    scale * variance
}

/// A / (stopgrad\[A\] + `floor`), A the mean of ‖x(t−δ) − 2 x(t) + x(t+δ)‖, scene units: against jitter, whatever the
/// unit. Adds to the gradients of the three times.
///
/// Source: SC-GS (Huang et al. 2024), with `floor` = [`OWN_FLOOR`] and δ = 3 frames.
pub(crate) fn acceleration<F: Real>(at: [&[[F; 3]]; 3], floor: f64, weight: f64, d: [&mut [[F; 3]]; 3]) -> f64 {
    let n = at[0].len();
    assert!(at.iter().all(|x| x.len() == n) && d.iter().all(|x| x.len() == n), "{n} points");
    let second = |i: usize| -> [F; 3] { std::array::from_fn(|k| at[0][i][k] - F::TWO * at[1][i][k] + at[2][i][k]) };
    let mut unused = vec![(); n];
    let mean = over_points(&mut unused, |i, ()| length(second(i)).f64()) / n.max(1) as f64;
    let scale = weight / (mean + floor);
    let factor = F::of(scale / n.max(1) as f64);
    for (d, share) in d.into_iter().zip([F::ONE, -F::TWO, F::ONE]) {
        over_points(d, |i, d| {
            let v = second(i);
            let long = length(v);
            if long > F::ZERO {
                add_to(d, v, factor * share / long);
            }
            0.0
        });
    }
    scale * mean
}

#[cfg(test)]
mod tests;
