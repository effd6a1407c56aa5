//! Which nodes pull a Gaussian, and how strongly.
//!
//! With d² = |x_i − p_k|² + |h_i − h_k|², the kernel of SC-GS is κ_k = exp(−d²/(2 r_k²))·sigmoid(w_k) = exp(−e_k). Only
//! its ratios matter, so that all are taken relative to the strongest (e_0), and far from every node nothing
//! underflows:
//!
//! > v_k = exp(e_0 − e_k), a_k = (v_k − v_c + ε) / Σ_j (v_j − v_c + ε) over the K strongest nodes,
//!
//! where c is the strongest one that does not count. A node that enters or leaves the K strongest does so with weight
//! (nearly) zero: no cracks open where neighbours switch (the reference cuts off sharply). Σ a = 1 exactly as the sum
//! of quotients, and ε keeps the sum above zero where K + 1 nodes pull alike.

use super::tasks::{sum_parts, task_rows};
use super::{MAX_HYPER, MAX_NEIGHBOURS, NODE_HYPER, NODE_LOG_RADIUS, SPARE_CANDIDATES, Skin};
use crate::math::Real;
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, GEOMETRY, Grads, Params, Table};
use crate::simd::{Kernel, Simd, dispatch, each, total};
use rayon::prelude::*;

/// ε: least weight of a node that counts, relative to the strongest.
const FLOOR: f64 = 1e-6;
/// Energy of what is infinitely far: finite also in f32, so that differences are.
const FAR: f64 = 1e30;
/// Numbers that are worked on together; a node's and a Gaussian's coordinates are padded with zeros to whole runs.
const RUN: usize = 16;
/// Runs of coordinates at most: position and hyper coordinates.
const MAX_RUNS: usize = (3 + MAX_HYPER).div_ceil(RUN);
/// Gaussians that take each step together: exp is a long chain of operations, and those of several Gaussians overlap.
const ABREAST: usize = 8;
/// Candidates at most, and more.
const MAX_LIST: usize = 16;
const _: () = assert!(MAX_NEIGHBOURS + SPARE_CANDIDATES <= MAX_LIST, "a list fits into one run");

/// The weights of all Gaussians.
#[derive(Clone, Debug, Default)]
pub struct Weights<F> {
    /// Nodes that count per Gaussian, and whether one more cuts off.
    neighbours: usize,
    cut: bool,
    /// [N, neighbours + cut], strongest first.
    nodes: Vec<u32>,
    /// [N, neighbours], Σ = 1.
    values: Vec<F>,
}

/// Nodes as rows of runs: [1/(2r²), −ln sigmoid(w), 0 …], then their coordinates.
struct NodeRows<F> {
    coordinates: usize,
    width: usize,
    data: Vec<[F; RUN]>,
}

impl<F: Real> NodeRows<F> {
    fn new(table: &Table<F>) -> Self {
        let coordinates = 3 + table.width() - NODE_HYPER;
        let width = 1 + coordinates.div_ceil(RUN);
        let mut data = vec![[F::ZERO; RUN]; width * table.rows()];
        for (k, row) in data.chunks_exact_mut(width).enumerate() {
            let [log_radius, logit] = table.read::<2>(k, NODE_LOG_RADIUS);
            row[0][0] = F::HALF * (-F::TWO * log_radius).exp();
            row[0][1] = softplus(-logit);
            for c in 0..coordinates {
                row[1 + c / RUN][c % RUN] = table.get(k, if c < 3 { c } else { NODE_HYPER + c - 3 });
            }
        }
        Self { coordinates, width, data }
    }

    #[inline(always)]
    fn of(&self, node: usize) -> &[[F; RUN]] {
        &self.data[node * self.width..(node + 1) * self.width]
    }

    /// d² of a point.
    #[inline(always)]
    fn square(&self, node: usize, x: &[[F; RUN]]) -> F {
        let mut sum = [F::ZERO; RUN];
        for (x, p) in x.iter().zip(&self.of(node)[1..]) {
            for c in 0..RUN {
                sum[c] += (x[c] - p[c]) * (x[c] - p[c]);
            }
        }
        total(sum)
    }

    /// e of a point; a number that is not finite counts as infinitely far.
    #[inline(always)]
    fn energy(&self, node: usize, x: &[[F; RUN]]) -> F {
        let head = &self.of(node)[0];
        let e = self.square(node, x) * head[0] + head[1];
        if e < F::of(FAR) { e } else { F::of(FAR) }
    }
}

/// ln(1 + e^x), without overflow.
fn softplus<F: Real>(x: F) -> F {
    x.max(F::ZERO) + (F::ONE + (-x.abs()).exp()).ln()
}

/// Position and hyper coordinates of a Gaussian, in runs.
#[inline(always)]
fn coordinates<'a, F: Real>(
    skin: &Skin,
    p: &Params<F>,
    id: usize,
    into: &'a mut [[F; RUN]; MAX_RUNS],
) -> &'a [[F; RUN]] {
    let hyper = &p[skin.hyper];
    let into = &mut into[..(3 + hyper.width()).div_ceil(RUN)];
    let x = p[GEOMETRY].read::<3>(id, 0);
    into[0][..3].copy_from_slice(&x);
    for c in 0..hyper.width() {
        into[(3 + c) / RUN][(3 + c) % RUN] = hyper.get(id, c);
    }
    into
}

/// The strongest nodes of a Gaussian: energies and numbers, ordered; more than are requested mean nothing.
type Best<F> = ([F; MAX_LIST], [u32; MAX_LIST]);

impl<F: Real> Weights<F> {
    /// Nodes that count per Gaussian: K, or all where there are fewer.
    pub(crate) fn neighbours(&self) -> usize {
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
        let (nodes, simd) = (NodeRows::new(&p[skin.nodes]), Simd::detect());
        let run = task_rows(count);
        let tasks = self.nodes.par_chunks_mut(run * n).zip(self.values.par_chunks_mut(run * k)).enumerate();
        tasks.for_each(|(task, (ids, values))| {
            dispatch(simd, Fill { skin, p, nodes: &nodes, first: task * run, ids, values, k, n });
        });
    }

    /// The VJP of [`fill`](Self::fill) from `d_values`, [N, neighbours].
    pub(super) fn backward(&self, skin: &Skin, p: &Params<F>, d_values: &[F], d: &mut Grads<F>) {
        let count = skin.count(p);
        if count == 0 {
            return;
        }
        let (nodes, simd) = (NodeRows::new(&p[skin.nodes]), Simd::detect());
        let blocks = task_rows(count) / BLOCK;
        let [d_geometry, d_hyper, d_nodes] = d.of([GEOMETRY, skin.hyper, skin.nodes]);
        let views: Vec<_> = d_geometry.chunks_mut(blocks).zip(d_hyper.chunks_mut(blocks)).collect();
        let parts: Vec<Vec<[F; RUN]>> = views
            .into_par_iter()
            .map(|views| {
                let mut sums = vec![[F::ZERO; RUN]; nodes.data.len()];
                dispatch(simd, Back { of: self, skin, p, nodes: &nodes, d_values, views, sums: &mut sums });
                sums
            })
            .collect();
        let sums = sum_parts(parts, nodes.data.len());
        for (node, sum) in sums.chunks_exact(nodes.width).enumerate() {
            let [s, b] = [sum[0][0], sum[0][1]];
            let logit = p[skin.nodes].get(node, super::NODE_LOGIT);
            // s = ½ e^(−2 log r), b = softplus(−w).
            let d_log_radius = -F::TWO * nodes.of(node)[0][0] * s;
            let d_logit = -(-logit).sigmoid() * b;
            d_nodes.add(node, 0, [sum[1][0], sum[1][1], sum[1][2], d_log_radius, d_logit]);
            for c in 3..nodes.coordinates {
                d_nodes.add(node, NODE_HYPER + c - 3, [sum[1 + c / RUN][c % RUN]]);
            }
        }
    }
}

/// The weights of one task's rows.
struct Fill<'a, F> {
    skin: &'a Skin,
    p: &'a Params<F>,
    nodes: &'a NodeRows<F>,
    first: usize,
    ids: &'a mut [u32],
    values: &'a mut [F],
    k: usize,
    n: usize,
}

impl<F: Real> Kernel for Fill<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let Self { skin, p, nodes, first, ids, values, k, n } = self;
        let mut x = [[F::ZERO; RUN]; MAX_RUNS];
        let mut best = [([F::ZERO; MAX_LIST], [0; MAX_LIST]); ABREAST];
        let groups = ids.chunks_mut(ABREAST * n).zip(values.chunks_mut(ABREAST * k)).enumerate();
        for (g, (ids, values)) in groups {
            let rows = ids.len() / n;
            for (i, best) in best[..rows].iter_mut().enumerate() {
                let id = first + g * ABREAST + i;
                *best = strongest(skin, p, nodes, id, coordinates(skin, p, id, &mut x));
            }
            let rows = best.iter().zip(ids.chunks_exact_mut(n).zip(values.chunks_exact_mut(k)));
            for ((energies, numbers), (ids, values)) in rows {
                let [_, s] = shares(energies, k, n);
                let mut sum = F::ZERO;
                for s in &s[..k] {
                    sum += *s;
                }
                ids.copy_from_slice(&numbers[..n]);
                for (value, s) in values.iter_mut().zip(&s) {
                    *value = *s / sum;
                }
            }
        }
    }
}

/// The VJP of the weights of one task's rows.
struct Back<'a, F> {
    of: &'a Weights<F>,
    skin: &'a Skin,
    p: &'a Params<F>,
    nodes: &'a NodeRows<F>,
    d_values: &'a [F],
    /// Of the geometry and of the hyper coordinates.
    views: (TableMut<'a, F>, TableMut<'a, F>),
    /// As [`NodeRows::data`]: dL/d(1/2r²), dL/d(−ln sigmoid(w)), and dL/d coordinates.
    sums: &'a mut [[F; RUN]],
}

impl<F: Real> Kernel for Back<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let Self { of, skin, p, nodes, d_values, views: (mut d_geometry, mut d_hyper), sums } = self;
        let (k, n, width) = (of.neighbours, of.neighbours + usize::from(of.cut), nodes.width);
        let mut x = [[F::ZERO; RUN]; MAX_RUNS];
        let end = d_geometry.first + d_geometry.rows;
        let mut asked = [(0, [F::ZERO; MAX_LIST], [F::ZERO; MAX_LIST]); ABREAST];
        let mut next = d_geometry.first;
        while next < end {
            // Squared distances and energies of the next rows that took part; others must not be touched.
            let mut count = 0;
            while count < ABREAST && next < end {
                let id = next;
                next += 1;
                if d_values[id * k..(id + 1) * k].iter().all(|&g| g == F::ZERO) {
                    continue;
                }
                let x = coordinates(skin, p, id, &mut x);
                let (mut squares, mut energies) = ([F::ZERO; MAX_LIST], [F::of(FAR); MAX_LIST]);
                for (i, &node) in of.nodes[id * n..(id + 1) * n].iter().enumerate() {
                    let head = &nodes.of(node as usize)[0];
                    squares[i] = nodes.square(node as usize, x);
                    let e = squares[i] * head[0] + head[1];
                    energies[i] = if e < F::of(FAR) { e } else { F::of(FAR) };
                }
                asked[count] = (id, squares, energies);
                count += 1;
            }
            for (id, _, energies) in &mut asked[..count] {
                *energies = energies_backward(energies, k, n, &d_values[*id * k..(*id + 1) * k]);
            }
            for &(id, squares, d_e) in &asked[..count] {
                let x = coordinates(skin, p, id, &mut x);
                let mut d_x = [[F::ZERO; RUN]; MAX_RUNS];
                for (i, &node) in of.nodes[id * n..(id + 1) * n].iter().enumerate() {
                    let (row, g) = (nodes.of(node as usize), d_e[i]);
                    let sum = &mut sums[node as usize * width..(node as usize + 1) * width];
                    // e = d² s + b: the sums are of dL/ds and dL/db.
                    sum[0][0] += g * squares[i];
                    sum[0][1] += g;
                    let slope = F::TWO * g * row[0][0];
                    for (r, x) in x.iter().enumerate() {
                        // Whole runs at once: two sums in one loop are compiled number by number.
                        let part: [F; RUN] = each(|c| slope * (x[c] - row[1 + r][c]));
                        d_x[r] = each(|c| d_x[r][c] + part[c]);
                        sum[1 + r] = each(|c| sum[1 + r][c] - part[c]);
                    }
                }
                d_geometry.add(id, 0, [d_x[0][0], d_x[0][1], d_x[0][2]]);
                for c in 0..d_hyper.width {
                    d_hyper.add(id, c, [d_x[(3 + c) / RUN][(3 + c) % RUN]]);
                }
            }
        }
    }
}

/// The nodes of a Gaussian's list by energy; equal energies in the list's order.
#[inline(always)]
fn strongest<F: Real>(skin: &Skin, p: &Params<F>, nodes: &NodeRows<F>, id: usize, x: &[[F; RUN]]) -> Best<F> {
    let list = &p[skin.candidates];
    let count = p[skin.nodes].rows();
    let len = list.width().min(count).min(MAX_LIST);
    let (mut energies, mut numbers) = ([F::of(FAR); MAX_LIST], [0; MAX_LIST]);
    for c in 0..len {
        // A damaged file may hold any number here.
        let node = (list.get(id, c).i32().max(0) as usize).min(count - 1);
        energies[c] = nodes.energy(node, x);
        numbers[c] = node as u32;
    }
    // Places are counted and not swapped: a branch for every comparison would be mispredicted every other time.
    let mut place = [0u32; MAX_LIST];
    for c in 0..len {
        let e = energies[c];
        for i in 0..MAX_LIST {
            place[i] += u32::from(e < energies[i] || (e == energies[i] && c < i));
        }
    }
    let mut best = ([F::of(FAR); MAX_LIST], [0; MAX_LIST]);
    for c in 0..len {
        let to = place[c] as usize % MAX_LIST;
        (best.0[to], best.1[to]) = (energies[c], numbers[c]);
    }
    best
}

/// v_i = exp(e_0 − e_i) and v_i − v_c + ε of ordered energies, of which the one after the first `k` cuts off if n > k.
#[inline(always)]
fn shares<F: Real>(energies: &[F; MAX_LIST], k: usize, n: usize) -> [[F; MAX_LIST]; 2] {
    let v: [F; MAX_LIST] = each(|i| (energies[0] - energies[i]).exp());
    let cut = if n > k { v[k] } else { F::ZERO };
    [v, each(|i| v[i] - cut + F::of(FLOOR))]
}

/// dL/de of the weights a = shares / Σ shares.
#[inline(always)]
fn energies_backward<F: Real>(energies: &[F; MAX_LIST], k: usize, n: usize, d_a: &[F]) -> [F; MAX_LIST] {
    let [v, s] = shares(energies, k, n);
    let (mut sum, mut mean) = (F::ZERO, F::ZERO);
    for (s, g) in s.iter().zip(d_a) {
        sum += *s;
        mean += *s * *g;
    }
    mean /= sum;
    let mut d_e = [F::ZERO; MAX_LIST];
    let mut d_cut = F::ZERO;
    for i in 0..n {
        let d_v = if i < k {
            let d_s = (d_a[i] - mean) / sum;
            d_cut -= d_s;
            d_s
        } else {
            d_cut
        };
        // v_i = exp(e_0 − e_i); v_0 is 1 whatever e_0.
        d_e[i] -= v[i] * d_v;
        d_e[0] += v[i] * d_v;
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
        let mut x = [[F::ZERO; RUN]; MAX_RUNS];
        let mut best = vec![(F::of(FAR), u32::MAX); width];
        for id in view.first..view.first + view.rows {
            best.fill((F::of(FAR), u32::MAX));
            let x = &coordinates(skin, p, id, &mut x).as_flattened()[..nodes.coordinates];
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

/// Numbers of a node before its coordinates: 1/(2r²), −ln sigmoid(w).
const HEAD: usize = 2;

/// Nodes sixteen at a time: [block][1/(2r²), −ln sigmoid(w), coordinates][16].
struct NodeLanes<F> {
    count: usize,
    coordinates: usize,
    data: Vec<[F; BLOCK]>,
}

impl<F: Real> NodeLanes<F> {
    fn new(table: &Table<F>) -> Self {
        let rows = NodeRows::new(table);
        let (count, coordinates) = (table.rows(), rows.coordinates);
        let mut data = Vec::new();
        for b in 0..count.div_ceil(BLOCK) {
            for c in 0..HEAD + coordinates {
                // The head is in the first run of a row, coordinates in those after it.
                let c = if c < HEAD { c } else { RUN + c - HEAD };
                let of = |node: usize| rows.of(node).as_flattened()[c];
                data.push(each(|l| if b * BLOCK + l < count { of(b * BLOCK + l) } else { F::ZERO }));
            }
        }
        Self { count, coordinates, data }
    }
}

/// Keeps the least energies, ordered; equal ones by number.
#[inline(always)]
fn insert<F: Real>(best: &mut [(F, u32)], new: (F, u32)) {
    let mut i = best.len() - 1;
    let before = |a: (F, u32), b: (F, u32)| a.0 < b.0 || (a.0 == b.0 && a.1 < b.1);
    if !before(new, best[i]) {
        return;
    }
    while i > 0 && before(new, best[i - 1]) {
        best[i] = best[i - 1];
        i -= 1;
    }
    best[i] = new;
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
        for (b, block) in self.nodes.data.chunks_exact(HEAD + self.nodes.coordinates).enumerate() {
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

/// At most `count` of the rows of a geometry table, each the farthest from all before it; the first is the one nearest
/// to the centroid. Rows that are not finite are left out. Equal distances: the lower row.
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
        // From the second on these are squared distances to the nearest chosen point; duplicates get no node.
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
