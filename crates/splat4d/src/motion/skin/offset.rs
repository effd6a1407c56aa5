//! A trajectory on top of another: nodes that were dragged keep moving as they did.

use super::{POSE, Trajectory};
use crate::math::{Real, quat};
use crate::motion::Slot;
use crate::scene::{Grads, Params, RowEdit, Table, Time};
use std::sync::Arc;

/// Shifts added to those of another trajectory, rotations done after its.
pub(super) struct Offset<F: Real> {
    pub of: Arc<dyn Trajectory<F>>,
    /// [nodes, 7]
    pub by: Table<F>,
}

impl<F: Real> Offset<F> {
    /// Unit quaternion of an offset.
    fn turn(&self, node: usize) -> [F; 4] {
        let r = self.by.read::<4>(node, 3);
        quat::normalize([F::ONE + r[0], r[1], r[2], r[3]]).0
    }
}

impl<F: Real> Trajectory<F> for Offset<F> {
    fn prepare(&self, p: &Params<F>, times: &[Time], cache: &mut Slot) {
        self.of.prepare(p, times, cache);
    }

    fn scratch_bytes(&self, p: &Params<F>) -> u64 {
        self.of.scratch_bytes(p)
    }

    fn poses(&self, p: &Params<F>, t: Time, cache: &Slot, out: &mut Table<F>) {
        self.of.poses(p, t, cache, out);
        assert_eq!(out.rows(), self.by.rows(), "there must be as many offsets as nodes");
        for node in 0..out.rows() {
            let (pose, by) = (out.read::<POSE>(node, 0), self.by.read::<3>(node, 0));
            // Not normalised: its use does that, and this way the gradient is that of a product.
            let q = quat::product(self.turn(node), [F::ONE + pose[3], pose[4], pose[5], pose[6]]);
            out.write(node, 0, std::array::from_fn::<F, 3, _>(|k| pose[k] + by[k]));
            out.write(node, 3, [q[0] - F::ONE, q[1], q[2], q[3]]);
        }
    }

    fn poses_backward(
        &self,
        p: &Params<F>,
        t: Time,
        cache: &Slot,
        d_out: &Table<F>,
        d_cache: &mut Slot,
        d: &mut Grads<F>,
    ) -> f64 {
        let mut d_own = d_out.clone();
        for node in 0..d_own.rows() {
            let [w, x, y, z] = self.turn(node);
            let g = d_out.read::<4>(node, 3);
            d_own.write(node, 3, quat::product([w, -x, -y, -z], g));
        }
        self.of.poses_backward(p, t, cache, &d_own, d_cache, d)
    }

    fn finish(&self, p: &Params<F>, times: &[Time], cache: &mut Slot, d_cache: &mut Slot, d: &mut Grads<F>) {
        self.of.finish(p, times, cache, d_cache, d);
    }

    fn on_edit(&self, p: &mut Params<F>, edit: &RowEdit) {
        self.of.on_edit(p, edit);
    }
}
