//! Linear blend skinning of a cloud at one time, and its VJP.

use super::{POSE, Skin, Weights};
use crate::math::{Real, quat};
use crate::motion::still::{activate, activate_backward};
use crate::scene::params::QUAT;
use crate::scene::splats::COV;
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, GEOMETRY, Grads, Key, Params, Rows, Table};
use rayon::prelude::*;

/// Numbers of a node's frame: R 9 (rows), p + T 3, unit quaternion 4, p 3, the raw quaternion's norm.
pub(super) const FRAME: usize = 20;
/// Where the parts of a frame begin.
const TARGET: usize = 9;
const TURN: usize = 12;
const REST: usize = 16;
const NORM: usize = 19;
/// Numbers of a frame that have a gradient of their own: R, p + T, quaternion.
const LEARNT: usize = 16;
/// Rows a task takes at least.
const TASK_ROWS: usize = 1024;
/// A task's rows a node at least: then adding up all tasks' gradients to nodes is a small part of the work.
const TASK_ROWS_A_NODE: usize = 4;

/// The nodes' rigid motions at one time, row-major [nodes, 20].
#[derive(Default)]
pub(super) struct Frames<F>(Vec<F>);

/// Position and rotation (rows) of a node of pose (shift 3, quaternion residual 4) at rest position `rest`.
pub fn node_frame<F: Real>(rest: [F; 3], pose: [F; POSE]) -> ([F; 3], [[F; 3]; 3]) {
    let (unit, _) = quat::normalize([F::ONE + pose[3], pose[4], pose[5], pose[6]]);
    (std::array::from_fn(|k| rest[k] + pose[k]), quat::to_rotation(unit))
}

impl<F: Real> Frames<F> {
    /// Numbers held.
    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    pub(super) fn fill(&mut self, nodes: &Table<F>, poses: &Table<F>) {
        self.0.clear();
        for k in 0..nodes.rows() {
            let (pose, rest) = (poses.read::<POSE>(k, 0), nodes.read::<3>(k, 0));
            let (unit, norm) = quat::normalize([F::ONE + pose[3], pose[4], pose[5], pose[6]]);
            self.0.extend(quat::to_rotation(unit).as_flattened());
            self.0.extend((0..3).map(|a| rest[a] + pose[a]));
            self.0.extend(unit);
            self.0.extend(rest);
            self.0.push(norm);
        }
    }

    #[inline(always)]
    fn of(&self, node: usize) -> &[F; FRAME] {
        self.0[node * FRAME..].first_chunk().expect("a frame a node")
    }

    /// A node as a splat.
    pub(super) fn splat(&self, nodes: &Table<F>, id: usize) -> [F; 10] {
        let f = self.of(id);
        let [log_radius, logit] = nodes.read::<2>(id, super::NODE_LOG_RADIUS);
        let (v, z) = ((F::TWO * log_radius).exp(), F::ZERO);
        [f[TARGET], f[TARGET + 1], f[TARGET + 2], v, z, z, v, z, v, logit.sigmoid()]
    }

    /// The gradient of [`splat`](Self::splat) to the node's first five columns; its shift gets that of the mean too.
    pub(super) fn splat_backward(nodes: &Table<F>, id: usize, g: [F; 10]) -> [F; 5] {
        let [log_radius, logit] = nodes.read::<2>(id, super::NODE_LOG_RADIUS);
        let v = (F::TWO * log_radius).exp();
        let o = logit.sigmoid();
        [g[0], g[1], g[2], F::TWO * v * (g[COV] + g[COV + 3] + g[COV + 5]), g[9] * o * (F::ONE - o)]
    }

    /// From gradients of frames, [nodes, 16], to poses and rest positions.
    pub(super) fn backward(&self, d_frames: &[F], d_poses: &mut Table<F>, d_nodes: &mut Table<F>) {
        for (k, g) in d_frames.as_chunks::<LEARNT>().0.iter().enumerate() {
            let f = self.of(k);
            let unit: [F; 4] = std::array::from_fn(|i| f[TURN + i]);
            let through = quat::to_rotation_backward(unit, rows(g));
            let d_unit = std::array::from_fn(|i| g[TURN + i] + through[i]);
            let d_turn = quat::normalize_backward(unit, f[NORM], d_unit);
            let d_target: [F; 3] = std::array::from_fn(|i| g[TARGET + i]);
            d_poses.add(k, 0, d_target);
            d_poses.add(k, 3, d_turn);
            // p stands in the target and, turned, in the arm x − p.
            let r = rows(f);
            let d_rest = |i: usize| d_target[i] - (0..3).map(|j| r[j][i] * d_target[j]).sum();
            d_nodes.add(k, 0, std::array::from_fn::<F, 3, _>(d_rest));
        }
    }
}

#[inline(always)]
fn rows<F: Real, const N: usize>(f: &[F; N]) -> [[F; 3]; 3] {
    [[f[0], f[1], f[2]], [f[3], f[4], f[5]], [f[6], f[7], f[8]]]
}

/// a ⊗ b
#[inline(always)]
pub(super) fn product<F: Real>(a: [F; 4], b: [F; 4]) -> [F; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

#[inline(always)]
fn conjugate<F: Real>(q: [F; 4]) -> [F; 4] {
    [q[0], -q[1], -q[2], -q[3]]
}

/// A Gaussian where its nodes bring it.
struct Moved<F> {
    /// The learnable row, moved.
    row: [F; 11],
    /// Where it would go without a mask.
    mean: [F; 3],
    /// The blended quaternion before it is masked, and the signs that aligned it.
    turn: [F; 4],
    signs: [F; super::MAX_NEIGHBOURS],
    /// The quaternion that turns it, and the norm of what that was made from.
    unit: [F; 4],
    norm: F,
    /// The mask.
    mask: F,
}

#[inline(always)]
fn moved<F: Real>(mask: Key, p: &Params<F>, w: &Weights<F>, frames: &Frames<F>, id: usize) -> Moved<F> {
    let mut row = p[GEOMETRY].read::<11>(id, 0);
    let x = [row[0], row[1], row[2]];
    let (nodes, a) = w.row(id);
    let (mut mean, mut turn) = ([F::ZERO; 3], [F::ZERO; 4]);
    let mut signs = [F::ONE; super::MAX_NEIGHBOURS];
    if nodes.is_empty() {
        (mean, turn) = (x, [F::ONE, F::ZERO, F::ZERO, F::ZERO]);
    }
    for (k, (&node, &a)) in nodes.iter().zip(a).enumerate() {
        let f = frames.of(node as usize);
        let arm: [F; 3] = std::array::from_fn(|i| x[i] - f[REST + i]);
        for i in 0..3 {
            mean[i] += a * (f[3 * i] * arm[0] + f[3 * i + 1] * arm[1] + f[3 * i + 2] * arm[2] + f[TARGET + i]);
        }
        // q and −q are one rotation: all must point the way of the first.
        let along: F = (0..4).map(|i| f[TURN + i] * turn[i]).sum();
        signs[k] = if along < F::ZERO { -F::ONE } else { F::ONE };
        for i in 0..4 {
            turn[i] += signs[k] * a * f[TURN + i];
        }
    }
    let (mut m, mut masked) = (F::ONE, turn);
    if p[mask].width() > 0 {
        m = p[mask].get(id, 0).sigmoid();
        masked = turn.map(|t| m * t);
        masked[0] += F::ONE - m;
    }
    let (unit, norm) = quat::normalize(masked);
    for i in 0..3 {
        row[i] = x[i] + m * (mean[i] - x[i]);
    }
    let q = product(unit, [row[QUAT], row[QUAT + 1], row[QUAT + 2], row[QUAT + 3]]);
    row[QUAT..QUAT + 4].copy_from_slice(&q);
    Moved { row, mean, turn, signs, unit, norm, mask: m }
}

/// Gaussian `id` as a splat.
pub(super) fn forward<F: Real>(mask: Key, p: &Params<F>, w: &Weights<F>, frames: &Frames<F>, id: usize) -> [F; 10] {
    activate(moved(mask, p, w, frames, id).row)
}

/// One question about Gaussians.
pub(super) struct Ask<'a, F> {
    pub skin: &'a Skin,
    pub p: &'a Params<F>,
    pub weights: &'a Weights<F>,
    pub frames: &'a Frames<F>,
}

impl<F: Real> Ask<'_, F> {
    /// Adds gradients of geometry and mask to `d` and of weights to `d_weights`; returns those of frames, [nodes, 16].
    ///
    /// Tasks take rows in runs whose length depends on sizes alone, and their node gradients are added in order.
    pub(super) fn backward(&self, asked: Rows<'_>, d_out: &Table<F>, d_weights: &mut [F], d: &mut Grads<F>) -> Vec<F> {
        let nodes = self.p[self.skin.nodes].rows();
        let blocks = task_rows(nodes) / BLOCK;
        let width = self.weights.neighbours();
        let [d_geometry, d_mask] = d.of([GEOMETRY, self.skin.mask]);
        let views: Vec<_> = d_geometry.chunks_mut(blocks).zip(d_mask.chunks_mut(blocks)).collect();
        // Without nodes there are no weights to share out.
        let mut shares: Vec<&mut [F]> = d_weights.chunks_mut((blocks * BLOCK * width).max(1)).collect();
        shares.resize_with(views.len(), Default::default);
        let parts: Vec<Vec<F>> = views
            .into_par_iter()
            .zip(shares)
            .map(|(views, share)| self.task(asked, d_out, views, share, nodes))
            .collect();
        sum_parts(parts, nodes * LEARNT)
    }

    fn task(
        &self,
        asked: Rows<'_>,
        d_out: &Table<F>,
        (mut d_geometry, mut d_mask): (TableMut<'_, F>, TableMut<'_, F>),
        d_weights: &mut [F],
        nodes: usize,
    ) -> Vec<F> {
        let mut sums = vec![F::ZERO; nodes * LEARNT];
        let (first, end) = (d_geometry.first, d_geometry.first + d_geometry.rows);
        let (from, to) = match asked {
            Rows::All => (first, end),
            Rows::Some(ids) => {
                (ids.partition_point(|&i| (i as usize) < first), ids.partition_point(|&i| (i as usize) < end))
            }
        };
        let width = self.weights.neighbours();
        for j in from..to {
            let id = asked.id(j);
            let m = moved(self.skin.mask, self.p, self.weights, self.frames, id);
            let own = (id - first) * width;
            let (d_row, d_m) = self.row(id, &m, d_out.read(j, 0), &mut d_weights[own..own + width], &mut sums);
            d_geometry.add(id, 0, d_row);
            if d_mask.width > 0 {
                d_mask.add(id, 0, [d_m]);
            }
        }
        sums
    }

    /// The gradient of one Gaussian: to its learnable row and its mask's logit; adds to its weights and the nodes.
    #[inline(always)]
    fn row(&self, id: usize, m: &Moved<F>, g: [F; 10], d_weights: &mut [F], sums: &mut [F]) -> ([F; 11], F) {
        let raw = self.p[GEOMETRY].read::<11>(id, 0);
        let mut d = activate_backward(m.row, g);
        // q(t) = u ⊗ q, so that dq = ū ⊗ g and du = g ⊗ q̄.
        let d_q = [d[QUAT], d[QUAT + 1], d[QUAT + 2], d[QUAT + 3]];
        let q = [raw[QUAT], raw[QUAT + 1], raw[QUAT + 2], raw[QUAT + 3]];
        d[QUAT..QUAT + 4].copy_from_slice(&product(conjugate(m.unit), d_q));
        let d_masked = quat::normalize_backward(m.unit, m.norm, product(d_q, conjugate(q)));
        let d_turn = d_masked.map(|x| m.mask * x);
        let d_mean = [d[0], d[1], d[2]];
        let mut d_m: F = (0..3).map(|i| d_mean[i] * (m.mean[i] - raw[i])).sum();
        d_m += (0..4).map(|i| d_masked[i] * m.turn[i]).sum::<F>() - d_masked[0];
        let d_blend = d_mean.map(|x| m.mask * x);
        let (nodes, a) = self.weights.row(id);
        let mut d_x: [F; 3] = std::array::from_fn(|i| d_mean[i] - d_blend[i]);
        if nodes.is_empty() {
            d_x = d_mean;
        }
        for (k, (&node, &a)) in nodes.iter().zip(a).enumerate() {
            let f = self.frames.of(node as usize);
            let sum: &mut [F; LEARNT] = sums[node as usize * LEARNT..].first_chunk_mut().expect("a gradient a node");
            let arm: [F; 3] = std::array::from_fn(|i| raw[i] - f[REST + i]);
            let pull = d_blend.map(|x| a * x);
            let mut d_a = F::ZERO;
            for i in 0..3 {
                let turned = f[3 * i] * arm[0] + f[3 * i + 1] * arm[1] + f[3 * i + 2] * arm[2];
                d_a += d_blend[i] * (turned + f[TARGET + i]);
                for c in 0..3 {
                    sum[3 * i + c] += pull[i] * arm[c];
                    d_x[c] += pull[i] * f[3 * i + c];
                }
                sum[TARGET + i] += pull[i];
            }
            for i in 0..4 {
                let signed = m.signs[k] * d_turn[i];
                d_a += signed * f[TURN + i];
                sum[TURN + i] += a * signed;
            }
            d_weights[k] += d_a;
        }
        d[..3].copy_from_slice(&d_x);
        (d, d_m * m.mask * (F::ONE - m.mask))
    }
}

/// Rows of one task: a function of sizes alone.
pub(super) fn task_rows(nodes: usize) -> usize {
    (nodes * TASK_ROWS_A_NODE).max(TASK_ROWS).next_multiple_of(BLOCK)
}

/// Adds up the tasks' results in order.
pub(super) fn sum_parts<F: Real>(parts: Vec<Vec<F>>, len: usize) -> Vec<F> {
    let mut parts = parts.into_iter();
    let mut sum = parts.next().unwrap_or_else(|| vec![F::ZERO; len]);
    for part in parts {
        sum.iter_mut().zip(part).for_each(|(s, x)| *s += x);
    }
    sum
}
