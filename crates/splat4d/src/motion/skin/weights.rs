//! Which nodes pull a Gaussian, and how strongly.
//!
//! With d² = |x_i − p_k|² + |h_i − h_k|², the kernel of SC-GS is κ_k = exp(−d²/(2 r_k²))·sigmoid(w_k) = exp(−e_k). Only its
//! ratios matter, so that all are taken relative to the strongest (e_0), and far from every node nothing underflows:
//!
//! > v_k = exp(e_0 − e_k), a_k = (v_k − v_c + ε) / Σ_j (v_j − v_c + ε) over the K strongest nodes,
//!
//! where c is the strongest one that does not count. A node that enters or leaves the K strongest does so with weight
//! (nearly) zero: no cracks open where neighbours switch (the reference cuts off sharply). Σ a = 1 exactly as the sum of
//! quotients, and ε keeps the sum above zero where K + 1 nodes pull alike.

use super::blend::{sum_parts, task_rows};
use super::{MAX_HYPER, MAX_NEIGHBOURS, NODE_HYPER, NODE_LOG_RADIUS, Skin};
use crate::math::Real;
use crate::scene::{BLOCK, GEOMETRY, Grads, Params, Table};
use crate::simd::{Kernel, Simd, dispatch, each};
use rayon::prelude::*;

/// ε: least weight of a node that counts, relative to the strongest.
const FLOOR: f64 = 1e-6;
/// Energy of what is infinitely far: finite also in f32, so that differences are.
const FAR: f64 = 1e30;
/// Coordinates of the metric at most: position and hyper coordinates.
const MAX_COORDINATES: usize = 3 + MAX_HYPER;
/// Numbers of a node before its coordinates: 1/(2r²), −ln sigmoid(w).
const HEAD: usize = 2;

/// The weights of all Gaussians.
#[derive(Clone, Debug, Default)]
pub struct Weights<F> {
    /// Nodes that count a Gaussian, and whether one more cuts off.
    neighbours: usize,
    cut: bool,
    /// [N, neighbours + cut], strongest first.
    nodes: Vec<u32>,
    /// [N, neighbours], Σ = 1.
    values: Vec<F>,
}

/// Nodes as rows: 1/(2r²), −ln sigmoid(w), coordinates.
struct NodeRows<F> {
    width: usize,
    data: Vec<F>,
}

impl<F: Real> NodeRows<F> {
    fn new(table: &Table<F>) -> Self {
        let width = HEAD + 3 + table.width() - NODE_HYPER;
        let mut data = Vec::with_capacity(width * table.rows());
        for k in 0..table.rows() {
            let [log_radius, logit] = table.read::<2>(k, NODE_LOG_RADIUS);
            data.push(F::HALF * (-F::TWO * log_radius).exp());
            data.push(softplus(-logit));
            data.extend((0..3).map(|c| table.get(k, c)));
            data.extend((NODE_HYPER..table.width()).map(|c| table.get(k, c)));
        }
        Self { width, data }
    }

    #[inline(always)]
    fn of(&self, node: usize) -> &[F] {
        &self.data[node * self.width..(node + 1) * self.width]
    }

    /// d² of a point.
    #[inline(always)]
    fn square(&self, node: usize, x: &[F]) -> F {
        let coordinates = &self.of(node)[HEAD..];
        let mut sum = F::ZERO;
        for (a, b) in x.iter().zip(coordinates) {
            sum += (*a - *b) * (*a - *b);
        }
        sum
    }

    /// e of a point; a number that is not finite counts as infinitely far.
    #[inline(always)]
    fn energy(&self, node: usize, x: &[F]) -> F {
        let head = self.of(node);
        let e = self.square(node, x) * head[0] + head[1];
        if e < F::of(FAR) { e } else { F::of(FAR) }
    }
}

/// ln(1 + e^x), without overflow.
fn softplus<F: Real>(x: F) -> F {
    x.max(F::ZERO) + (F::ONE + (-x.abs()).exp()).ln()
}

/// Position and hyper coordinates of a Gaussian.
#[inline(always)]
fn coordinates<'a, F: Real>(skin: &Skin, p: &Params<F>, id: usize, into: &'a mut [F; MAX_COORDINATES]) -> &'a [F] {
    into[..3].copy_from_slice(&p[GEOMETRY].read::<3>(id, 0));
    let hyper = &p[skin.hyper];
    for c in 0..hyper.width() {
        into[3 + c] = hyper.get(id, c);
    }
    &into[..3 + hyper.width()]
}

impl<F: Real> Weights<F> {
    /// Nodes that count a Gaussian: K, or all where there are fewer.
    pub fn neighbours(&self) -> usize {
        self.neighbours
    }

    /// A Gaussian's nodes, strongest first, and their weights.
    #[inline(always)]
    pub fn row(&self, id: usize) -> (&[u32], &[F]) {
        let (k, n) = (self.neighbours, self.neighbours + usize::from(self.cut));
        (&self.nodes[id * n..id * n + k], &self.values[id * k..(id + 1) * k])
    }

    /// Computes the weights of every Gaussian from its list of candidates.
    pub(super) fn fill(&mut self, skin: &Skin, p: &Params<F>) {
        let (rows, count) = (p.len(), skin.count(p));
        self.neighbours = skin.spec.neighbours.min(count);
        self.cut = count > skin.spec.neighbours;
        let (k, n) = (self.neighbours, self.neighbours + usize::from(self.cut));
        self.nodes.resize(rows * n, 0);
        self.values.resize(rows * k, F::ZERO);
        if count == 0 {
            return;
        }
        let nodes = NodeRows::new(&p[skin.nodes]);
        let run = task_rows(count);
        let tasks = self.nodes.par_chunks_mut(run * n).zip(self.values.par_chunks_mut(run * k)).enumerate();
        tasks.for_each(|(task, (ids, values))| {
            let mut x = [F::ZERO; MAX_COORDINATES];
            for (i, (ids, values)) in ids.chunks_exact_mut(n).zip(values.chunks_exact_mut(k)).enumerate() {
                let id = task * run + i;
                let mut best = [(F::of(FAR), u32::MAX); MAX_NEIGHBOURS + 1];
                strongest(skin, p, &nodes, id, coordinates(skin, p, id, &mut x), &mut best[..n]);
                let v = shares(&best[..n], k);
                let sum: F = v[..k].iter().copied().sum();
                ids.iter_mut().zip(&best).for_each(|(id, b)| *id = b.1);
                values.iter_mut().zip(v).for_each(|(value, v)| *value = v / sum);
            }
        });
    }

    /// The VJP of [`fill`](Self::fill) from `d_values`, [N, neighbours].
    pub(super) fn backward(&self, skin: &Skin, p: &Params<F>, d_values: &[F], d: &mut Grads<F>) {
        let count = skin.count(p);
        if count == 0 {
            return;
        }
        let nodes = NodeRows::new(&p[skin.nodes]);
        let blocks = task_rows(count) / BLOCK;
        let [d_geometry, d_hyper, d_nodes] = d.of([GEOMETRY, skin.hyper, skin.nodes]);
        let views: Vec<_> = d_geometry.chunks_mut(blocks).zip(d_hyper.chunks_mut(blocks)).collect();
        let width = nodes.width;
        let (k, n) = (self.neighbours, self.neighbours + usize::from(self.cut));
        let parts: Vec<Vec<F>> = views
            .into_par_iter()
            .map(|(mut d_geometry, mut d_hyper)| {
                let mut sums = vec![F::ZERO; count * width];
                let mut x = [F::ZERO; MAX_COORDINATES];
                for id in d_geometry.first..d_geometry.first + d_geometry.rows {
                    let d_a = &d_values[id * k..(id + 1) * k];
                    // Rows that took no part must not be touched.
                    if d_a.iter().all(|&g| g == F::ZERO) {
                        continue;
                    }
                    let x = coordinates(skin, p, id, &mut x);
                    let ids = &self.nodes[id * n..(id + 1) * n];
                    let mut best = [(F::of(FAR), u32::MAX); MAX_NEIGHBOURS + 1];
                    ids.iter().zip(&mut best).for_each(|(&i, b)| *b = (nodes.energy(i as usize, x), i));
                    let d_e = energies_backward(&best[..n], k, d_a);
                    let mut d_x = [F::ZERO; MAX_COORDINATES];
                    for (&node, &g) in ids.iter().zip(&d_e) {
                        let row = nodes.of(node as usize);
                        let sum = &mut sums[node as usize * width..(node as usize + 1) * width];
                        // e = d² s + b: the sums are of dL/ds and dL/db.
                        sum[0] += g * nodes.square(node as usize, x);
                        sum[1] += g;
                        let slope = F::TWO * g * row[0];
                        for (c, &x) in x.iter().enumerate() {
                            let part = slope * (x - row[HEAD + c]);
                            d_x[c] += part;
                            sum[HEAD + c] -= part;
                        }
                    }
                    d_geometry.add(id, 0, [d_x[0], d_x[1], d_x[2]]);
                    for c in 0..d_hyper.width {
                        d_hyper.add(id, c, [d_x[3 + c]]);
                    }
                }
                sums
            })
            .collect();
        let sums = sum_parts(parts, count * width);
        for (node, sum) in sums.chunks_exact(width).enumerate() {
            let row = nodes.of(node);
            let logit = p[skin.nodes].get(node, super::NODE_LOGIT);
            // s = ½ e^(−2 log r), b = softplus(−w).
            let d_log_radius = -F::TWO * row[0] * sum[0];
            let d_logit = -(-logit).sigmoid() * sum[1];
            d_nodes.add(node, 0, [sum[HEAD], sum[HEAD + 1], sum[HEAD + 2], d_log_radius, d_logit]);
            for c in 3..width - HEAD {
                d_nodes.add(node, NODE_HYPER + c - 3, [sum[HEAD + c]]);
            }
        }
    }
}

/// The nodes of least energy on a Gaussian's list, ordered; equal energies by number.
#[inline(always)]
fn strongest<F: Real>(skin: &Skin, p: &Params<F>, nodes: &NodeRows<F>, id: usize, x: &[F], best: &mut [(F, u32)]) {
    let list = &p[skin.candidates];
    let count = p[skin.nodes].rows();
    for c in 0..list.width().min(count) {
        // A damaged file may hold any number here.
        let node = (list.get(id, c).i32().max(0) as usize).min(count - 1);
        insert(best, (nodes.energy(node, x), node as u32));
    }
    // Doublets of a damaged list leave places empty.
    let first = best[0];
    best.iter_mut().filter(|b| b.1 == u32::MAX).for_each(|b| *b = first);
}

#[inline(always)]
fn insert<F: Real>(best: &mut [(F, u32)], new: (F, u32)) {
    let last = best.len() - 1;
    let before = |a: (F, u32), b: (F, u32)| a.0 < b.0 || (a.0 == b.0 && a.1 < b.1);
    if !before(new, best[last]) || best.iter().any(|b| b.1 == new.1) {
        return;
    }
    let mut i = last;
    while i > 0 && before(new, best[i - 1]) {
        best[i] = best[i - 1];
        i -= 1;
    }
    best[i] = new;
}

/// v_k − v_c + ε of ordered energies, of which the one after the first `k` cuts off.
#[inline(always)]
fn shares<F: Real>(best: &[(F, u32)], k: usize) -> [F; MAX_NEIGHBOURS] {
    let v = |i: usize| (best[0].0 - best[i].0).exp();
    let cut = if best.len() > k { v(k) } else { F::ZERO };
    let mut out = [F::ZERO; MAX_NEIGHBOURS];
    for (i, out) in out[..k].iter_mut().enumerate() {
        *out = v(i) - cut + F::of(FLOOR);
    }
    out
}

/// dL/de of the weights a = shares / Σ shares.
#[inline(always)]
fn energies_backward<F: Real>(best: &[(F, u32)], k: usize, d_a: &[F]) -> [F; MAX_NEIGHBOURS + 1] {
    let s = shares(best, k);
    let sum: F = s[..k].iter().copied().sum();
    let mean: F = s[..k].iter().zip(d_a).map(|(s, g)| *s * *g).sum::<F>() / sum;
    let mut d_e = [F::ZERO; MAX_NEIGHBOURS + 1];
    let mut d_cut = F::ZERO;
    for i in 0..best.len() {
        let v = (best[0].0 - best[i].0).exp();
        let d_v = if i < k {
            let d_s = (d_a[i] - mean) / sum;
            d_cut -= d_s;
            d_s
        } else {
            d_cut
        };
        // v_i = exp(e_0 − e_i); v_0 is 1 whatever e_0.
        d_e[i] -= v * d_v;
        d_e[0] += v * d_v;
    }
    d_e
}

/// Fills every Gaussian's list of candidates: the nodes of least energy, as numbers, nearest first.
pub(super) fn nearest<F: Real>(skin: &Skin, p: &Params<F>, list: &mut Table<F>) {
    let nodes = NodeLanes::new(&p[skin.nodes]);
    let (count, width) = (nodes.count, list.width().min(nodes.count));
    list.fill(F::ZERO);
    if count == 0 {
        return;
    }
    let simd = Simd::detect();
    let views: Vec<_> = list.chunks_mut(TASK_BLOCKS).collect();
    views.into_par_iter().for_each(|mut view| {
        let mut x = [F::ZERO; MAX_COORDINATES];
        let mut best = vec![(F::of(FAR), u32::MAX); width];
        for id in view.first..view.first + view.rows {
            best.fill((F::of(FAR), u32::MAX));
            let x = coordinates(skin, p, id, &mut x);
            dispatch(simd, Search { nodes: &nodes, x, best: &mut best });
            let first = best[0].1;
            for (c, b) in best.iter().enumerate() {
                let node = if b.1 == u32::MAX { first } else { b.1 };
                view.write(id, c, [F::of(f64::from(if node == u32::MAX { 0 } else { node }))]);
            }
        }
    });
}

/// Blocks of rows of one task of the search.
const TASK_BLOCKS: usize = 16;

/// Nodes sixteen at a time: [block][1/(2r²), −ln sigmoid(w), coordinates][16].
struct NodeLanes<F> {
    count: usize,
    width: usize,
    data: Vec<[F; BLOCK]>,
}

impl<F: Real> NodeLanes<F> {
    fn new(table: &Table<F>) -> Self {
        let rows = NodeRows::new(table);
        let (count, width) = (table.rows(), rows.width);
        let mut data = Vec::new();
        for b in 0..count.div_ceil(BLOCK) {
            for c in 0..width {
                data.push(each(|l| if b * BLOCK + l < count { rows.of(b * BLOCK + l)[c] } else { F::ZERO }));
            }
        }
        Self { count, width, data }
    }
}

struct Search<'a, F> {
    nodes: &'a NodeLanes<F>,
    x: &'a [F],
    best: &'a mut [(F, u32)],
}

impl<F: Real> Kernel for Search<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let last = self.best.len() - 1;
        for (b, block) in self.nodes.data.chunks_exact(self.nodes.width).enumerate() {
            let mut square = [F::ZERO; BLOCK];
            for (c, lane) in self.x.iter().zip(&block[HEAD..]) {
                for l in 0..BLOCK {
                    square[l] += (*c - lane[l]) * (*c - lane[l]);
                }
            }
            let energy: [F; BLOCK] = each(|l| square[l] * block[0][l] + block[1][l]);
            let worst = self.best[last].0;
            let some = energy.iter().fold(false, |some, e| some | (*e < worst));
            if some {
                for (l, e) in energy.iter().enumerate() {
                    let id = b * BLOCK + l;
                    if id < self.nodes.count && *e < self.best[last].0 {
                        insert(self.best, (*e, id as u32));
                    }
                }
            }
        }
    }
}

/// At most `count` of the rows of a geometry table, each the farthest from all before it; the first is the one nearest to
/// the centroid. Rows that are not finite are left out. Equal distances: the lower row.
pub fn farthest_points<F: Real>(geometry: &Table<F>, count: usize) -> Vec<[F; 3]> {
    let points: Vec<[F; 3]> =
        (0..geometry.rows()).map(|r| geometry.read::<3>(r, 0)).filter(|x| x.iter().all(|c| c.is_finite())).collect();
    let n = points.len();
    let center: [f64; 3] = each(|k| points.iter().map(|x| x[k].f64()).sum::<f64>() / n.max(1) as f64);
    let square = |a: &[F; 3], b: [f64; 3]| (0..3).map(|k| (a[k].f64() - b[k]).powi(2)).sum::<f64>();
    let mut far: Vec<f64> = points.iter().map(|x| -square(x, center)).collect();
    let mut out = Vec::with_capacity(count.min(n));
    while out.len() < count.min(n) {
        let best = (0..n).fold(0, |best, i| if far[i] > far[best] { i } else { best });
        // From the second on these are squared distances to the nearest chosen point; doubles are not worth a node.
        if !out.is_empty() && far[best] <= 0.0 {
            break;
        }
        let chosen = points[best];
        let at = chosen.map(Real::f64);
        let first = out.is_empty();
        far.par_iter_mut().zip(&points).for_each(|(far, x)| {
            let s = square(x, at);
            *far = if first { s } else { far.min(s) };
        });
        out.push(chosen);
    }
    out
}
