//! Local rigidity between two times: neighbours keep their offsets, their turns and their distances.
//!
//! For every edge i → j of a [`Graph`], with q_rel = q̂_t ⊗ conj(q̂_{t−1}) of the normalised quaternions, R its matrix,
//! e = x_j − x_i now and e⁰ before:
//! - rigidity: mean √(w ‖R_iᵀ e − e⁰‖² + ε), scene units;
//! - rotation: mean √(w ‖q_rel,j − s q_rel,i‖² + ε), no unit; s = ±1 picks the nearer of the two signs of one turn
//!   (ours);
//! - isometry: mean √(w (‖e‖ − d0)² + ε), scene units; d0 is the graph's length at rest, not the time before.
//!
//! The root makes them robust, like an L1: one torn edge does not move its neighbours. Gradients are those of the later
//! time; the earlier state is fixed. Every function adds `weight` times its gradient and returns `weight` times its
//! value; the same bits with any number of threads.
//! Source: Luiten et al. 2024, "Dynamic 3D Gaussians", equations 8 to 10.

use super::graph::{Graph, add_to, length, over_edges, over_points, square, sub, turn, turn_back};
use rayon::prelude::*;
use splat4d::math::{Real, quat};

/// Keeps the root's derivative finite where an edge is exactly as it was (Luiten et al. 2024).
const UNDER_ROOT: f64 = 1e-20;

/// Positions and rotations of points at a time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Poses<'a, F> {
    /// Positions, scene units.
    pub x: &'a [[F; 3]],
    /// Raw quaternions, wxyz.
    pub q: &'a [[F; 4]],
}

/// The turn from one time to the next.
fn relative<F: Real>(now: [F; 4], before: [F; 4]) -> [F; 4] {
    quat::product(quat::normalize(now).0, quat::conjugate(quat::normalize(before).0))
}

/// From the gradient of q_rel to that of the raw quaternion now.
fn relative_backward<F: Real>(now: [F; 4], before: [F; 4], d_rel: [F; 4]) -> [F; 4] {
    let (unit, norm) = quat::normalize(now);
    quat::normalize_backward(unit, norm, quat::product(d_rel, quat::normalize(before).0))
}

fn turns<F: Real>(now: Poses<'_, F>, before: Poses<'_, F>) -> Vec<[F; 4]> {
    now.q.par_iter().zip(before.q).with_min_len(1024).map(|(&now, &before)| relative(now, before)).collect()
}

/// Rigidity; see the module. Adds to `d_x` and `d_q`, the gradients of the poses now.
///
/// Panics: numbers of points that differ.
pub(crate) fn rigidity<F: Real>(
    graph: &Graph<F>,
    now: Poses<'_, F>,
    before: Poses<'_, F>,
    weight: f64,
    d_x: &mut [[F; 3]],
    d_q: &mut [[F; 4]],
) -> f64 {
    let n = graph.len();
    assert!([now.x.len(), before.x.len(), now.q.len(), before.q.len(), d_x.len(), d_q.len()] == [n; 6], "{n} points");
    let rotations: Vec<[[F; 3]; 3]> = turns(now, before).into_iter().map(quat::to_rotation).collect();
    let scale = weight / graph.edges().max(1) as f64;
    let (eps, factor) = (F::of(UNDER_ROOT), F::of(scale));
    let mut d: Vec<(&mut [F; 3], &mut [F; 4])> = d_x.iter_mut().zip(d_q).collect();
    let near = |i: usize, (d_x, d_q): &mut (&mut [F; 3], &mut [F; 4]), forces: &mut [[F; 3]]| {
        let (mut sum, mut d_rotation) = (0.0, [[F::ZERO; 3]; 3]);
        for (e, j) in graph.edges_from(i) {
            let now_e = sub(now.x[j], now.x[i]);
            let r = sub(turn_back(&rotations[i], now_e), sub(before.x[j], before.x[i]));
            let w = graph.weights()[e];
            let root = (w * square(r) + eps).sqrt();
            sum += root.f64();
            // The gradient to the residual, in the axes of the time before.
            let by = factor * w / root;
            let g = r.map(|x| by * x);
            let force = turn(&rotations[i], g);
            add_to(d_x, force, -F::ONE);
            forces[e - i * graph.k()] = force;
            for b in 0..3 {
                add_to(&mut d_rotation[b], g, now_e[b]);
            }
        }
        let d_rel = quat::to_rotation_backward(relative(now.q[i], before.q[i]), d_rotation);
        add_to(d_q, relative_backward(now.q[i], before.q[i], d_rel), F::ONE);
        sum
    };
    scale * over_edges(graph, &mut d, near, |(d_x, _), force| add_to(d_x, force, F::ONE))
}

/// Rotation; see the module. Adds to `d_q`, the gradient of the quaternions now. Panics: numbers of points that differ.
pub(crate) fn rotation<F: Real>(
    graph: &Graph<F>,
    now: &[[F; 4]],
    before: &[[F; 4]],
    weight: f64,
    d_q: &mut [[F; 4]],
) -> f64 {
    let n = graph.len();
    assert!([now.len(), before.len(), d_q.len()] == [n; 3], "{n} points");
    let rel = turns(Poses { x: &[], q: now }, Poses { x: &[], q: before });
    let scale = weight / graph.edges().max(1) as f64;
    let (eps, factor) = (F::of(UNDER_ROOT), F::of(scale));
    let mut d_rel = vec![[F::ZERO; 4]; n];
    let near = |i: usize, d_rel: &mut [F; 4], forces: &mut [[F; 4]]| {
        let mut sum = 0.0;
        for (e, j) in graph.edges_from(i) {
            let (a, b) = (rel[i], rel[j]);
            let dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
            let sign = if dot < F::ZERO { -F::ONE } else { F::ONE };
            let r: [F; 4] = std::array::from_fn(|k| b[k] - sign * a[k]);
            let w = graph.weights()[e];
            let root = (w * square(r) + eps).sqrt();
            sum += root.f64();
            let by = factor * w / root;
            let g = r.map(|x| by * x);
            add_to(d_rel, g, -sign);
            forces[e - i * graph.k()] = g;
        }
        sum
    };
    let sum = over_edges(graph, &mut d_rel, near, |d_rel, g| add_to(d_rel, g, F::ONE));
    over_points(d_q, |i, d_q| {
        add_to(d_q, relative_backward(now[i], before[i], d_rel[i]), F::ONE);
        0.0
    });
    scale * sum
}

/// Isometry; see the module. Adds to `d_x`, the gradient of the positions. Panics: numbers of points that differ.
pub(crate) fn isometry<F: Real>(graph: &Graph<F>, x: &[[F; 3]], weight: f64, d_x: &mut [[F; 3]]) -> f64 {
    let n = graph.len();
    assert!([x.len(), d_x.len()] == [n; 2], "{n} points");
    let scale = weight / graph.edges().max(1) as f64;
    let (eps, factor) = (F::of(UNDER_ROOT), F::of(scale));
    let near = |i: usize, d_x: &mut [F; 3], forces: &mut [[F; 3]]| {
        let mut sum = 0.0;
        for (e, j) in graph.edges_from(i) {
            let v = sub(x[j], x[i]);
            let long = length(v);
            let (stretch, w) = (long - graph.lengths()[e], graph.weights()[e]);
            let root = (w * stretch * stretch + eps).sqrt();
            sum += root.f64();
            // Where two points coincide no direction is better than another.
            let along = if long > F::ZERO { factor * w * stretch / (root * long) } else { F::ZERO };
            let force = v.map(|x| x * along);
            add_to(d_x, force, -F::ONE);
            forces[e - i * graph.k()] = force;
        }
        sum
    };
    scale * over_edges(graph, d_x, near, |d_x, force| add_to(d_x, force, F::ONE))
}

#[cfg(test)]
mod tests;
