//! Dragging control nodes, as rigidly as possible: some nodes are put somewhere, and all others follow so that every
//! neighbourhood keeps its shape.
//!
//! Minimises E = Σ_k Σ_j∈N(k) w_kj ‖(p'_k − p'_j) − R_k (p_k − p_j)‖² over positions p' and rotations R by turns: the
//! best rotation of every neighbourhood (Procrustes), then the best positions, Σ_j w_kj (p'_k − p'_j) = ½ Σ_j w_kj
//! (R_k + R_j)(p_k − p_j), by conjugate gradients with the handles' rows eliminated. Neither step can raise E. Weights are
//! symmetric, so that the matrix is. Everything is f64 and in a fixed order.
//! Source: Sorkine and Alexa 2007; graph as SC-GS (Huang et al. 2024), whose weights are not symmetric.

use super::skin::{POSE, POSE_COLUMNS};
use crate::math::knn::knn;
use crate::math::mat3::procrustes;
use crate::math::se3::{mat_vec, sub};
use crate::math::{Real, quat};
use crate::scene::Table;
use crate::{Error, Result};
use rayon::prelude::*;

/// Neighbours of a node (SC-GS).
pub(crate) const NEIGHBOURS: usize = 10;
/// Of them the nearest this many always count, the others only within [`REACH`] (SC-GS).
const SURE_NEIGHBOURS: usize = 3;
/// Length of an edge beyond the third, of the median distance to the third neighbour: farther nodes are those of
/// another limb (ours; SC-GS has 0.3 scene units).
const REACH: f64 = 2.0;
/// Conjugate gradients stop at this share of the first residual: energies then fall to the last digits that matter.
const CG_TOLERANCE: f64 = 1e-9;
/// ... or after this many steps a node, which only a broken matrix needs.
const CG_STEPS: usize = 4;
/// Nodes of one task of the local step.
const TASK_NODES: usize = 64;

/// A node that is put somewhere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Handle {
    /// Its number.
    pub node: usize,
    /// Target position, scene units.
    pub target: [f64; 3],
    /// How it turns (rows), for handles with six degrees of freedom; `None`: as its neighbours require.
    pub rotation: Option<[[f64; 3]; 3]>,
}

/// The result of a drag.
#[derive(Clone, Debug, PartialEq)]
pub struct Dragged {
    /// Current positions of the nodes.
    pub positions: Vec<[f64; 3]>,
    /// Rotation of every node (rows).
    pub rotations: Vec<[[f64; 3]; 3]>,
    /// E at the start (all nodes follow the handles as one rigid body) and after every iteration.
    pub energies: Vec<f64>,
}

impl Dragged {
    /// Shifts from `from` and quaternion residuals, [nodes, 7]: what [`Skinned::with_offsets`](super::skin::Skinned)
    /// takes.
    pub fn poses<F: Real>(&self, from: &[[f64; 3]]) -> Table<F> {
        let mut out = Table::new(&POSE_COLUMNS, self.positions.len());
        for (k, (p, r)) in self.positions.iter().zip(&self.rotations).enumerate() {
            let shift = sub(*p, from[k]);
            let mut q = quat::from_rotation(r);
            if q[0] < 0.0 {
                q = q.map(|x| -x);
            }
            let pose: [f64; POSE] = [shift[0], shift[1], shift[2], q[0] - 1.0, q[1], q[2], q[3]];
            out.write(k, 0, pose.map(F::of));
        }
        out
    }
}

/// Drags `handles` of nodes at `rest`, with `iterations` rounds (SC-GS: 3). See `Elastic` to drag the same nodes again.
///
/// Errors: a handle that is not a node or occurs twice, a target that is not finite.
pub fn drag(rest: &[[f64; 3]], handles: &[Handle], iterations: usize) -> Result<Dragged> {
    Elastic::new(rest).drag(handles, iterations)
}

/// Nodes tied to their neighbours.
#[derive(Clone, Debug)]
pub(crate) struct Elastic {
    rest: Vec<[f64; 3]>,
    /// Neighbours of node k are `edges[first[k]..first[k + 1]]`, ascending; w_kj = w_jk.
    first: Vec<usize>,
    edges: Vec<(usize, f64)>,
    /// Which connected part a node belongs to.
    part: Vec<usize>,
    parts: usize,
}

impl Elastic {
    /// Ties nodes at `rest`: [`NEIGHBOURS`] nearest, w = exp(−d²/mean d²).
    pub(crate) fn new(rest: &[[f64; 3]]) -> Self {
        let n = rest.len();
        let points: Vec<[f32; 3]> = rest.iter().map(|p| p.map(|x| x as f32)).collect();
        let near = knn(&points, NEIGHBOURS);
        let square = |i: usize, j: usize| sub(rest[i], rest[j]).map(|x| x * x).iter().sum::<f64>();
        let mut thirds: Vec<f64> =
            (0..n).map(|i| square(i, near[i * NEIGHBOURS + SURE_NEIGHBOURS - 1] as usize)).collect();
        thirds.sort_by(f64::total_cmp);
        let reach = thirds.get(n / 2).map_or(0.0, |d| d * REACH * REACH);
        let mut ties: Vec<Vec<usize>> = vec![Vec::new(); n];
        for i in 0..n {
            for (rank, &j) in near[i * NEIGHBOURS..(i + 1) * NEIGHBOURS].iter().enumerate() {
                let j = j as usize;
                if j != i && (rank < SURE_NEIGHBOURS || square(i, j) <= reach) {
                    ties[i].push(j);
                    ties[j].push(i);
                }
            }
        }
        for tie in &mut ties {
            tie.sort_unstable();
            tie.dedup();
        }
        let count: usize = ties.iter().map(Vec::len).sum();
        let pairs = || ties.iter().enumerate().flat_map(|(i, tie)| tie.iter().map(move |&j| (i, j)));
        let mean = pairs().map(|(i, j)| square(i, j)).sum::<f64>() / count.max(1) as f64;
        let weight = |(i, j)| (j, (-square(i, j) / mean.max(f64::MIN_POSITIVE)).exp());
        let edges = pairs().map(weight).collect();
        let mut first = vec![0; n + 1];
        (0..n).for_each(|i| first[i + 1] = first[i] + ties[i].len());
        let (part, parts) = connected(&ties);
        Self { rest: rest.to_vec(), first, edges, part, parts }
    }

    /// The same ties between nodes that rest elsewhere.
    pub(crate) fn at_rest(&self, rest: &[[f64; 3]]) -> Self {
        assert_eq!(rest.len(), self.len(), "the same nodes");
        Self { rest: rest.to_vec(), ..self.clone() }
    }

    /// Nodes.
    pub(crate) fn len(&self) -> usize {
        self.rest.len()
    }

    fn ties(&self, k: usize) -> &[(usize, f64)] {
        &self.edges[self.first[k]..self.first[k + 1]]
    }

    /// Puts handles where they belong and lets all others follow. Parts without a handle stay.
    ///
    /// Errors: a handle that is not a node or occurs twice, a target that is not finite.
    pub(crate) fn drag(&self, handles: &[Handle], iterations: usize) -> Result<Dragged> {
        let n = self.len();
        let mut held: Vec<Option<Handle>> = vec![None; n];
        for h in handles {
            if h.node >= n || held[h.node].is_some() {
                return Err(Error::input(format!("handle {} is not one of {n} nodes, or is given twice", h.node))
                    .remedy("Give every node at most one target"));
            }
            let turns = h.rotation.iter().flatten().flatten();
            if h.target.iter().chain(turns).any(|x| !x.is_finite()) {
                return Err(
                    Error::input(format!("the target of handle {} is not finite", h.node)).remedy("Give plain numbers")
                );
            }
            held[h.node] = Some(*h);
        }
        let mut has_handle = vec![false; self.parts];
        handles.iter().for_each(|h| has_handle[self.part[h.node]] = true);
        let free: Vec<bool> = (0..n).map(|k| held[k].is_none() && has_handle[self.part[k]]).collect();
        let bodies: Vec<Rigid> = (0..self.parts).map(|part| self.fit(part, handles)).collect();
        let mut rotations: Vec<_> = (0..n).map(|k| bodies[self.part[k]].rotation).collect();
        let turn = |k: usize, r: [[f64; 3]; 3]| held[k].and_then(|h| h.rotation).unwrap_or(r);
        rotations.iter_mut().enumerate().for_each(|(k, r)| *r = turn(k, *r));
        let mut positions: Vec<[f64; 3]> =
            (0..n).map(|k| held[k].map_or_else(|| bodies[self.part[k]].apply(self.rest[k]), |h| h.target)).collect();
        self.settle(&rotations, &free, &mut positions);
        let mut energies = vec![self.energy(&positions, &rotations)];
        for _ in 0..iterations {
            rotations = self.turns(&positions);
            rotations.iter_mut().enumerate().for_each(|(k, r)| *r = turn(k, *r));
            self.settle(&rotations, &free, &mut positions);
            energies.push(self.energy(&positions, &rotations));
        }
        Ok(Dragged { positions, rotations, energies })
    }

    /// The rigid motion that brings a part's handles closest to their targets; where they leave a choice, the one that
    /// turns least.
    fn fit(&self, part: usize, handles: &[Handle]) -> Rigid {
        let of_part: Vec<&Handle> = handles.iter().filter(|h| self.part[h.node] == part).collect();
        let n = of_part.len().max(1) as f64;
        let mut body = Rigid { rotation: IDENTITY, from: [0.0; 3], to: [0.0; 3] };
        for h in &of_part {
            (0..3).for_each(|k| body.from[k] += self.rest[h.node][k] / n);
            (0..3).for_each(|k| body.to[k] += h.target[k] / n);
        }
        let mut cov = [[0.0; 3]; 3];
        for h in &of_part {
            add_outer(&mut cov, 1.0, sub(h.target, body.to), sub(self.rest[h.node], body.from));
        }
        body.rotation = procrustes(cov);
        body
    }

    /// The local step: argmin over R_k of the energy.
    fn turns(&self, positions: &[[f64; 3]]) -> Vec<[[f64; 3]; 3]> {
        let one = |k: usize| {
            let mut cov = [[0.0; 3]; 3];
            for &(j, w) in self.ties(k) {
                add_outer(&mut cov, w, sub(positions[k], positions[j]), sub(self.rest[k], self.rest[j]));
            }
            procrustes(cov)
        };
        (0..self.len()).into_par_iter().with_min_len(TASK_NODES).map(one).collect()
    }

    /// The global step: positions of the free nodes for given rotations, from where they are (conjugate gradients with
    /// the diagonal as preconditioner).
    fn settle(&self, rotations: &[[[f64; 3]; 3]], free: &[bool], x: &mut [[f64; 3]]) {
        let nodes: Vec<usize> = (0..self.len()).filter(|&k| free[k]).collect();
        // Residual b − A x of the free rows; what is held is in x and so on the right-hand side.
        let mut r = vec![[0.0; 3]; self.len()];
        let mut diagonal = vec![1.0; self.len()];
        for &k in &nodes {
            diagonal[k] = self.ties(k).iter().map(|t| t.1).sum::<f64>().max(f64::MIN_POSITIVE);
            for &(j, w) in self.ties(k) {
                let edge = sub(self.rest[k], self.rest[j]);
                let (a, b) = (mat_vec(&rotations[k], edge), mat_vec(&rotations[j], edge));
                (0..3).for_each(|c| r[k][c] += w * (0.5 * (a[c] + b[c]) - (x[k][c] - x[j][c])));
            }
        }
        let mut step = vec![[0.0; 3]; self.len()];
        let mut product = vec![[0.0; 3]; self.len()];
        // Three systems of one matrix, one a coordinate.
        let (mut old, mut start) = ([0.0; 3], [0.0; 3]);
        for round in 0..nodes.len() * CG_STEPS {
            let now = sum3(&nodes, |k, c| r[k][c] * r[k][c] / diagonal[k]);
            if round == 0 {
                start = now;
            }
            let done = |c: usize| now[c] <= CG_TOLERANCE * CG_TOLERANCE * start[c].max(f64::MIN_POSITIVE);
            if (0..3).all(done) {
                break;
            }
            let share = |c: usize| if round == 0 || old[c] == 0.0 { 0.0 } else { now[c] / old[c] };
            let beta = [share(0), share(1), share(2)];
            for &k in &nodes {
                (0..3).for_each(|c| step[k][c] = r[k][c] / diagonal[k] + beta[c] * step[k][c]);
            }
            for &k in &nodes {
                let mut sum = step[k].map(|s| diagonal[k] * s);
                for &(j, w) in self.ties(k) {
                    // A held node has no step.
                    (0..3).for_each(|c| sum[c] -= w * step[j][c]);
                }
                product[k] = sum;
            }
            let along = sum3(&nodes, |k, c| step[k][c] * product[k][c]);
            let length = |c: usize| if along[c] > 0.0 && !done(c) { now[c] / along[c] } else { 0.0 };
            let alpha = [length(0), length(1), length(2)];
            for &k in &nodes {
                for c in 0..3 {
                    x[k][c] += alpha[c] * step[k][c];
                    r[k][c] -= alpha[c] * product[k][c];
                }
            }
            old = now;
        }
    }

    /// E of positions and rotations, (scene units)².
    pub(crate) fn energy(&self, positions: &[[f64; 3]], rotations: &[[[f64; 3]; 3]]) -> f64 {
        let of_edge = |k: usize, j: usize| {
            let turned = mat_vec(&rotations[k], sub(self.rest[k], self.rest[j]));
            sub(sub(positions[k], positions[j]), turned).map(|x| x * x).iter().sum::<f64>()
        };
        (0..self.len()).map(|k| self.ties(k).iter().map(|&(j, w)| w * of_edge(k, j)).sum::<f64>()).sum()
    }
}

const IDENTITY: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

/// x ↦ R (x − from) + to
struct Rigid {
    rotation: [[f64; 3]; 3],
    from: [f64; 3],
    to: [f64; 3],
}

impl Rigid {
    fn apply(&self, x: [f64; 3]) -> [f64; 3] {
        let turned = mat_vec(&self.rotation, sub(x, self.from));
        std::array::from_fn(|k| turned[k] + self.to[k])
    }
}

/// m += w a bᵀ
fn add_outer(m: &mut [[f64; 3]; 3], w: f64, a: [f64; 3], b: [f64; 3]) {
    for (row, a) in m.iter_mut().zip(a) {
        (0..3).for_each(|k| row[k] += w * a * b[k]);
    }
}

fn sum3(nodes: &[usize], f: impl Fn(usize, usize) -> f64) -> [f64; 3] {
    let mut out = [0.0; 3];
    for &k in nodes {
        (0..3).for_each(|c| out[c] += f(k, c));
    }
    out
}

/// The connected part of every node, and how many there are.
fn connected(ties: &[Vec<usize>]) -> (Vec<usize>, usize) {
    let mut part = vec![usize::MAX; ties.len()];
    let (mut count, mut open) = (0, Vec::new());
    for k in 0..ties.len() {
        if part[k] != usize::MAX {
            continue;
        }
        part[k] = count;
        open.push(k);
        while let Some(i) = open.pop() {
            for &j in &ties[i] {
                if part[j] == usize::MAX {
                    part[j] = count;
                    open.push(j);
                }
            }
        }
        count += 1;
    }
    (part, count)
}

#[cfg(test)]
mod tests;
