//! Offsets of control nodes over time, and the Gaussians that they pull.

use super::{Affine, path};
use crate::math::{Real, quat};
use crate::scene::{Key, Params, Space, Table};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Most nodes, most key times and most nodes a Gaussian: bounds for files.
const MOST: [usize; 3] = [1 << 14, 4096, 8];
/// Numbers of a node at a key time: its place 3, its shift 3, the residual of its turn about the identity 4.
const NODE: usize = 10;

/// A drag as plain data; its numbers are tables.
///
/// `drag_nodes.INDEX` holds place p, shift T and turn R of every node at every key time, along broken lines between
/// them. `drag_pulls@INDEX` holds for every Gaussian K node numbers and K weights a_k with Σ a_k ≤ 1; with weights of
/// zero it stays as given by the inner model. μ' = μ + Σ a_k (R_k (μ − p_k) + p_k + T_k − μ).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DragSpec {
    /// Distinguishes the drags of a layer.
    pub index: u32,
    /// Nodes.
    pub nodes: usize,
    /// Nodes that pull a Gaussian, K.
    pub neighbours: usize,
    /// Key times, seconds, rising.
    pub times: Vec<f64>,
}

impl DragSpec {
    pub(super) fn check(&self) -> Result<()> {
        let counts = [self.nodes, self.times.len(), self.neighbours];
        let rising = self.times.windows(2).all(|t| t[0] < t[1]) && self.times.iter().all(|t| t.is_finite());
        if rising && counts.iter().zip(MOST).all(|(n, most)| (1..=most).contains(n)) {
            return Ok(());
        }
        Err(Error::input(format!("a drag of {} nodes at {} times", self.nodes, self.times.len()))
            .remedy(format!("{} nodes and {} rising times are possible", MOST[0], MOST[1])))
    }
}

/// Place, shift, and the turn as a unit quaternion.
pub(crate) type NodeOffset = ([f64; 3], [f64; 3], [f64; 4]);

/// Numbers of a drag, to be written into its tables.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct NodeOffsets {
    /// [times, nodes]: position, shift, and the turn as a unit quaternion.
    pub nodes: Vec<NodeOffset>,
    /// [Gaussians, K]: node and weight.
    pub pulls: Vec<(u32, f32)>,
}

/// The tables of a drag.
#[derive(Clone, Copy, Debug)]
pub(super) struct Keys {
    nodes: Key,
    pulls: Key,
}

impl Keys {
    /// Makes or claims the tables; new ones move nothing.
    pub(super) fn new<F: Real>(spec: &DragSpec, p: &mut Params<F>) -> Result<Self> {
        let numbers = spec.nodes * spec.times.len() * NODE;
        let nodes = p.array(&format!("drag_nodes.{}", spec.index), numbers, |_| {})?;
        let rows = p.len();
        let columns = [("drag_pulls", 2 * spec.neighbours)];
        let pulls = p.page("drag_pulls", spec.index, Space::Gaussians, &columns, rows, |_| {})?;
        for key in [nodes, pulls] {
            p.info_mut(key).trainable = false;
        }
        let table = &p[pulls];
        let wrong = |row: usize| {
            (0..spec.neighbours).any(|k| {
                let (node, weight) = (table.get(row, k).f64(), table.get(row, spec.neighbours + k).f64());
                !(0.0..spec.nodes as f64).contains(&node) || !(0.0..=1.0 + 1e-3).contains(&weight)
            })
        };
        if (0..rows).any(wrong) {
            return Err(Error::input("a drag's Gaussians follow nodes that it does not have")
                .remedy("The file is damaged or was written by another program; export it again"));
        }
        Ok(Self { nodes, pulls })
    }

    /// Writes the numbers of a drag.
    pub(super) fn fill<F: Real>(&self, spec: &DragSpec, from: &NodeOffsets, p: &mut Params<F>) {
        assert_eq!(from.nodes.len(), spec.nodes * spec.times.len(), "a place for every node and key time");
        assert_eq!(from.pulls.len(), p.len() * spec.neighbours, "pulls for every Gaussian");
        for (i, (place, shift, turn)) in from.nodes.iter().enumerate() {
            let q = if turn[0] < 0.0 { turn.map(|x| -x) } else { *turn };
            let numbers = place.iter().chain(shift).copied().chain([q[0] - 1.0, q[1], q[2], q[3]]);
            numbers.enumerate().for_each(|(k, x)| p[self.nodes].set(i * NODE + k, 0, F::of(x)));
        }
        let table = &mut p[self.pulls];
        for (i, (node, weight)) in from.pulls.iter().enumerate() {
            let (row, k) = (i / spec.neighbours, i % spec.neighbours);
            table.set(row, k, F::of(f64::from(*node)));
            table.set(row, spec.neighbours + k, F::of(f64::from(*weight)));
        }
    }
}

/// R (rows), p + T − R p, unit quaternion.
type Rigid<F> = ([[F; 3]; 3], [F; 3], [F; 4]);

/// The nodes' rigid motions at one time, and the Gaussians that follow them.
pub(super) struct Pulls<'a, F> {
    nodes: Vec<Rigid<F>>,
    /// By Gaussian.
    table: &'a Table<F>,
}

impl<'a, F: Real> Pulls<'a, F> {
    pub(super) fn at(spec: &DragSpec, keys: &Keys, p: &'a Params<F>, t: f64) -> Self {
        let (a, b, u) = path::around(spec.times.len(), |k| spec.times[k], t);
        let numbers = p[keys.nodes].data();
        let node = |k: usize| {
            let [a, b] = [a, b].map(|time| &numbers[(time * spec.nodes + k) * NODE..][..NODE]);
            let x: [F; NODE] = std::array::from_fn(|i| a[i] * F::of(1.0 - u) + b[i] * F::of(u));
            let q = quat::normalize([F::ONE + x[6], x[7], x[8], x[9]]).0;
            let r = quat::to_rotation(q);
            let place = [x[0], x[1], x[2]];
            (r, std::array::from_fn(|i| place[i] + x[3 + i] - crate::math::vec3::dot(r[i], place)), q)
        };
        Self { nodes: (0..spec.nodes).map(node).collect(), table: &p[keys.pulls] }
    }

    /// Displacement of Gaussian `id`; none if it is not dragged.
    #[inline(always)]
    pub(super) fn of(&self, id: usize) -> Option<Affine<F>> {
        let count = self.table.width() / 2;
        let (mut m, mut b) = ([[F::ZERO; 3]; 3], [F::ZERO; 3]);
        let (mut turn, mut rest) = ([F::ZERO; 4], F::ONE);
        for k in 0..count {
            let weight = self.table.get(id, count + k);
            if weight <= F::ZERO {
                continue;
            }
            let (r, c, q) = &self.nodes[self.table.get(id, k).f64() as usize];
            for i in 0..3 {
                (0..3).for_each(|j| m[i][j] += weight * r[i][j]);
                b[i] += weight * c[i];
            }
            // w ≥ 0 in all of them: aligned to the identity.
            (0..4).for_each(|i| turn[i] += weight * q[i]);
            rest -= weight;
        }
        if rest == F::ONE {
            return None;
        }
        (0..3).for_each(|i| m[i][i] += rest);
        turn[0] += rest;
        Some(Affine { m, b, q: quat::to_rotation(quat::normalize(turn).0) })
    }
}
