//! Linear blend skinning of a cloud at one time, and its VJP.
//!
//! A node's rigid motion is sixteen numbers, one register or two: R (9, rows), c = p + T − R p (3), and R's unit
//! quaternion (4). A Gaussian blends the numbers of its nodes and moves to M x + c with the blend; it is node by node
//! only that sums are made, and all else is done for sixteen Gaussians at a time.

use super::tasks::{sum_parts, task_rows};
use super::{POSE, Skin, Weights};
use crate::math::{Real, quat};
use crate::motion::lanes::{Batch, Batches, Lane, Work};
use crate::motion::still::{activate_backward_lanes, activate_lanes};
use crate::scene::params::QUAT;
use crate::scene::splats::COV;
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, GEOMETRY, Grads, Params, Rows, Table};
use crate::simd::{Kernel, Simd, dispatch, each, total};
use rayon::prelude::*;

/// Numbers of a rigid motion.
const FRAME: usize = 16;
/// Offset of c.
const SHIFT: usize = 9;
/// Offset of the quaternion.
const TURN: usize = 12;

/// A rigid motion.
type Frame<F> = [F; FRAME];

/// The nodes' rigid motions at one time.
#[derive(Default)]
pub(super) struct Frames<F> {
    of: Vec<Frame<F>>,
    /// p, p + T, and the norm of the raw quaternion.
    rest: Vec<([F; 3], [F; 3], F)>,
}

/// Position and rotation (rows) of a node of pose (shift 3, quaternion residual 4) at rest position `rest`.
pub fn node_frame<F: Real>(rest: [F; 3], pose: [F; POSE]) -> ([F; 3], [[F; 3]; 3]) {
    let (unit, _) = quat::normalize([F::ONE + pose[3], pose[4], pose[5], pose[6]]);
    (std::array::from_fn(|k| rest[k] + pose[k]), quat::to_rotation(unit))
}

impl<F: Real> Frames<F> {
    /// Nodes.
    pub(super) fn len(&self) -> usize {
        self.of.len()
    }

    pub(super) fn fill(&mut self, nodes: &Table<F>, poses: &Table<F>) {
        self.of.clear();
        self.rest.clear();
        for k in 0..nodes.rows() {
            let (pose, rest) = (poses.read::<POSE>(k, 0), nodes.read::<3>(k, 0));
            let (unit, norm) = quat::normalize([F::ONE + pose[3], pose[4], pose[5], pose[6]]);
            let r = quat::to_rotation(unit);
            let target: [F; 3] = each(|a| rest[a] + pose[a]);
            self.of.push(each(|i| match i {
                TURN.. => unit[i - TURN],
                SHIFT.. => target[i - SHIFT] - (0..3).map(|j| r[i - SHIFT][j] * rest[j]).sum(),
                _ => r[i / 3][i % 3],
            }));
            self.rest.push((rest, target, norm));
        }
    }

    /// A node as a splat.
    pub(super) fn splat(&self, nodes: &Table<F>, id: usize) -> [F; 10] {
        let (_, x, _) = self.rest[id];
        let [log_radius, logit] = nodes.read::<2>(id, super::NODE_LOG_RADIUS);
        let (v, z) = ((F::TWO * log_radius).exp(), F::ZERO);
        [x[0], x[1], x[2], v, z, z, v, z, v, logit.sigmoid()]
    }

    /// The gradient of [`splat`](Self::splat) to the node's first five columns; its shift gets that of the mean too.
    pub(super) fn splat_backward(nodes: &Table<F>, id: usize, g: [F; 10]) -> [F; 5] {
        let [log_radius, logit] = nodes.read::<2>(id, super::NODE_LOG_RADIUS);
        let v = (F::TWO * log_radius).exp();
        let o = logit.sigmoid();
        [g[0], g[1], g[2], F::TWO * v * (g[COV] + g[COV + 3] + g[COV + 5]), g[9] * o * (F::ONE - o)]
    }

    /// From gradients of frames to poses and rest positions.
    pub(super) fn backward(&self, d_frames: &[Frame<F>], d_poses: &mut Table<F>, d_nodes: &mut Table<F>) {
        for (k, g) in d_frames.iter().enumerate() {
            let (f, (rest, _, norm)) = (&self.of[k], self.rest[k]);
            let d_shift: [F; 3] = each(|i| g[SHIFT + i]);
            // c = p + T − R p
            let d_r: [[F; 3]; 3] = each(|i| each(|j| g[3 * i + j] - d_shift[i] * rest[j]));
            let unit: [F; 4] = each(|i| f[TURN + i]);
            let through = quat::to_rotation_backward(unit, d_r);
            let d_unit = each(|i| g[TURN + i] + through[i]);
            d_poses.add(k, 0, d_shift);
            d_poses.add(k, 3, quat::normalize_backward(unit, norm, d_unit));
            let d_rest = |j: usize| d_shift[j] - (0..3).map(|i| f[3 * i + j] * d_shift[i]).sum();
            d_nodes.add(k, 0, each::<F, 3>(d_rest));
        }
    }
}

/// One query about Gaussians.
pub(super) struct SkinQuery<'a, F> {
    pub skin: &'a Skin,
    pub p: &'a Params<F>,
    pub weights: &'a Weights<F>,
    pub frames: &'a Frames<F>,
}

/// Sixteen Gaussians where their nodes bring them.
struct Moved<F> {
    /// The learnable rows as they rest, and moved.
    rest: [Lane<F>; 11],
    rows: [Lane<F>; 11],
    /// The nodes' frames, blended, and the signs by which their quaternions were aligned.
    blend: [Lane<F>; FRAME],
    signs: [[F; super::MAX_NEIGHBOURS]; BLOCK],
    /// Their displacement without a mask.
    away: [Lane<F>; 3],
    /// The quaternions that turn them, and the norms of what those were made from.
    unit: [Lane<F>; 4],
    norm: Lane<F>,
    mask: Lane<F>,
}

/// Weights of a node's numbers in a blend: a, and s·a for the quaternion.
#[inline(always)]
fn counts<F: Real>(a: F, sign: F) -> Frame<F> {
    each(|i| if i < TURN { a } else { sign * a })
}

impl<F: Real> SkinQuery<'_, F> {
    /// The blend of one Gaussian's nodes, and the signs.
    #[inline(always)]
    fn blend(&self, id: usize) -> (Frame<F>, [F; super::MAX_NEIGHBOURS]) {
        let (nodes, a) = self.weights.row(id);
        let mut signs = [F::ONE; super::MAX_NEIGHBOURS];
        let mut sum = [F::ZERO; FRAME];
        if nodes.is_empty() {
            // The identity.
            for i in [0, 4, 8, TURN] {
                sum[i] = F::ONE;
            }
        }
        for (k, (&node, &a)) in nodes.iter().zip(a).enumerate() {
            let f = &self.frames.of[node as usize];
            // q and −q are one rotation: all must point the way of the first.
            let along: F = (TURN..FRAME).map(|i| f[i] * sum[i]).sum();
            signs[k] = if along < F::ZERO { -F::ONE } else { F::ONE };
            let count = counts(a, signs[k]);
            for i in 0..FRAME {
                sum[i] += count[i] * f[i];
            }
        }
        (sum, signs)
    }

    #[inline(always)]
    fn moved(&self, batch: &Batch) -> Moved<F> {
        let rest: [Lane<F>; 11] = batch.ids.read(&self.p[GEOMETRY], 0);
        let mut blend = [[F::ZERO; BLOCK]; FRAME];
        let mut signs = [[F::ONE; super::MAX_NEIGHBOURS]; BLOCK];
        for l in 0..BLOCK {
            if batch.live[l] {
                let (frame, sign) = self.blend(batch.ids.row(l));
                signs[l] = sign;
                for i in 0..FRAME {
                    blend[i][l] = frame[i];
                }
            }
        }
        let logits = &self.p[self.skin.mask];
        let mut mask = [F::ONE; BLOCK];
        if logits.width() > 0 {
            let [logit] = batch.ids.read::<F, 1>(logits, 0);
            mask = each(|l| logit[l].sigmoid());
        }
        let (mut rows, mut away) = (rest, [[F::ZERO; BLOCK]; 3]);
        let (mut unit, mut norm) = ([[F::ZERO; BLOCK]; 4], [F::ZERO; BLOCK]);
        for l in 0..BLOCK {
            let (x, m) = ([rest[0][l], rest[1][l], rest[2][l]], mask[l]);
            for i in 0..3 {
                let row = [blend[3 * i][l], blend[3 * i + 1][l], blend[3 * i + 2][l]];
                away[i][l] = row[0] * x[0] + row[1] * x[1] + row[2] * x[2] + blend[SHIFT + i][l] - x[i];
                rows[i][l] = x[i] + m * away[i][l];
            }
            let turn = [
                m * blend[TURN][l] + (F::ONE - m),
                m * blend[TURN + 1][l],
                m * blend[TURN + 2][l],
                m * blend[TURN + 3][l],
            ];
            let (u, n) = quat::normalize(turn);
            let q = quat::product(u, [rest[QUAT][l], rest[QUAT + 1][l], rest[QUAT + 2][l], rest[QUAT + 3][l]]);
            for i in 0..4 {
                unit[i][l] = u[i];
                rows[QUAT + i][l] = q[i];
            }
            norm[l] = n;
        }
        Moved { rest, rows, blend, signs, away, unit, norm, mask }
    }

    /// Adds gradients of geometry and mask to `d` and of weights to `d_weights`; returns those of frames.
    ///
    /// Tasks take rows in runs whose length depends on sizes alone, and their node gradients are added in order.
    pub(super) fn backward(
        &self,
        asked: Rows<'_>,
        d_out: &Table<F>,
        d_weights: &mut [F],
        d: &mut Grads<F>,
    ) -> Vec<Frame<F>> {
        let nodes = self.frames.len();
        let blocks = task_rows(nodes) / BLOCK;
        let width = self.weights.neighbours();
        let [d_geometry, d_mask] = d.of([GEOMETRY, self.skin.mask]);
        let views: Vec<_> = d_geometry.chunks_mut(blocks).zip(d_mask.chunks_mut(blocks)).collect();
        // Without nodes there are no weights to share out.
        let mut shares: Vec<&mut [F]> = d_weights.chunks_mut((blocks * BLOCK * width).max(1)).collect();
        shares.resize_with(views.len(), Default::default);
        let simd = Simd::detect();
        let parts: Vec<Vec<Frame<F>>> = views
            .into_par_iter()
            .zip(shares)
            .map(|(views, d_weights)| {
                let mut sums = vec![[F::ZERO; FRAME]; nodes];
                dispatch(simd, Back { ask: self, asked, d_out, views, d_weights, sums: &mut sums });
                sums
            })
            .collect();
        sum_parts(parts, nodes)
    }
}

impl<F: Real> Work<F, 1> for SkinQuery<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, F>; 1]) -> f64 {
        batch.write(out, 0, &activate_lanes(&self.moved(batch).rows));
        0.0
    }
}

/// The VJP of one task's rows.
struct Back<'a, F> {
    ask: &'a SkinQuery<'a, F>,
    asked: Rows<'a>,
    d_out: &'a Table<F>,
    /// Of the geometry and of the masks.
    views: (TableMut<'a, F>, TableMut<'a, F>),
    d_weights: &'a mut [F],
    sums: &'a mut [Frame<F>],
}

impl<F: Real> Kernel for Back<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(mut self) {
        let (first, end) = (self.views.0.first, self.views.0.first + self.views.0.rows);
        for batch in Batches::new(self.asked, first, end) {
            let m = self.ask.moved(&batch);
            let mut d = activate_backward_lanes(&m.rows, &batch.at.read(self.d_out, 0));
            let mut d_blend = [[F::ZERO; BLOCK]; FRAME];
            let mut d_mask = [F::ZERO; BLOCK];
            for l in 0..BLOCK {
                // q(t) = u ⊗ q, so that dq = ū ⊗ g and du = g ⊗ q̄.
                let d_q = [d[QUAT][l], d[QUAT + 1][l], d[QUAT + 2][l], d[QUAT + 3][l]];
                let q = [m.rest[QUAT][l], m.rest[QUAT + 1][l], m.rest[QUAT + 2][l], m.rest[QUAT + 3][l]];
                let unit = [m.unit[0][l], m.unit[1][l], m.unit[2][l], m.unit[3][l]];
                let d_rest = quat::product(quat::conjugate(unit), d_q);
                let d_turn = quat::normalize_backward(unit, m.norm[l], quat::product(d_q, quat::conjugate(q)));
                let (mask, mut d_m) = (m.mask[l], -d_turn[0]);
                for i in 0..4 {
                    d[QUAT + i][l] = d_rest[i];
                    d_m += d_turn[i] * m.blend[TURN + i][l];
                    d_blend[TURN + i][l] = mask * d_turn[i];
                }
                let d_mean = [d[0][l], d[1][l], d[2][l]];
                for i in 0..3 {
                    d_m += d_mean[i] * m.away[i][l];
                    let pull = mask * d_mean[i];
                    d_blend[SHIFT + i][l] = pull;
                    d[i][l] -= pull;
                    for c in 0..3 {
                        d_blend[3 * i + c][l] = pull * m.rest[c][l];
                    }
                }
                for i in 0..3 {
                    for c in 0..3 {
                        d[c][l] += d_blend[SHIFT + i][l] * m.blend[3 * i + c][l];
                    }
                }
                d_mask[l] = d_m * mask * (F::ONE - mask);
            }
            for l in (0..BLOCK).filter(|&l| batch.live[l]) {
                let id = batch.ids.row(l);
                let g: Frame<F> = each(|i| d_blend[i][l]);
                let (nodes, a) = self.ask.weights.row(id);
                let own = &mut self.d_weights[(id - first) * nodes.len()..][..nodes.len()];
                for (k, (&node, &a)) in nodes.iter().zip(a).enumerate() {
                    let (f, sum) = (&self.ask.frames.of[node as usize], &mut self.sums[node as usize]);
                    let count = counts(a, m.signs[l][k]);
                    for i in 0..FRAME {
                        sum[i] += count[i] * g[i];
                    }
                    let sides = counts(F::ONE, m.signs[l][k]);
                    own[k] += total(each(|i| sides[i] * f[i] * g[i]));
                }
            }
            batch.add(&mut self.views.0, 0, &d);
            if self.views.1.width > 0 {
                batch.add(&mut self.views.1, 0, &[d_mask]);
            }
        }
    }
}
