//! Skinning: Gaussians follow sparse control nodes, whatever drives the nodes (Huang et al. 2024, "SC-GS").
//!
//! Node k has a rest position p_k, a log radius, a weight logit w_k and hyper coordinates h_k; Gaussian i its canonical
//! position x_i and hyper coordinates h_i. A [`Trajectory`] gives every node a shift T_k(t) and a rotation R_k(t) about
//! its own position. With weights a_ik (see `weights`) a Gaussian moves to
//!
//! > x_i(t) = Σ_k a_ik [R_k (x_i − p_k) + p_k + T_k] (linear blend skinning),
//! > q_i(t) = normalize(Σ_k a_ik s_k u_k) ⊗ q_i,
//!
//! where u_k is the unit quaternion of R_k and s_k = ±1 aligns it to the nearest node's. Scales stay. With a motion
//! mask m_i = sigmoid(`motion_mask`) a Gaussian moves by the share m_i: x_i + m_i (x_i(t) − x_i), and likewise for the
//! quaternion, from the identity.
//!
//! Nothing is detached (the reference stops the gradient at x and p inside the blend): finite differences hold for
//! every table. The choice of nodes is not learnt: every Gaussian has a list of the nearest ones, refreshed by
//! `Skinned::bind` now and then; among them the weights choose again at every step, continuously.

mod blend;
mod offset;
mod tasks;
#[cfg(test)]
mod tests;
mod weights;

pub use blend::node_frame;
pub use weights::{Weights, farthest_points};

use super::lanes::fill;
use super::{At, Cache, Motion, Slot, Spec, Tape, fill_rows};
use crate::math::knn::mean_square_distance;
use crate::math::{Real, Rng};
use crate::scene::{GEOMETRY, Grads, Key, Params, RowEdit, Rows, Space, SplatGrads, Table, Time};
use crate::{Error, Result};
use blend::Frames;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Most nodes of a skin: a bound for files, far above the 512 to 1,024 of the literature.
pub const MAX_NODES: usize = 1 << 16;
/// Most nodes that pull one Gaussian.
pub const MAX_NEIGHBOURS: usize = 8;
/// Most hyper coordinates.
pub(crate) const MAX_HYPER: usize = 32;
/// Nodes on a Gaussian's list beyond those that pull it, so that weights can shift between two refreshes.
const SPARE_CANDIDATES: usize = 5;
/// Spread of the nodes' hyper coordinates at the start, in node spacings: enough to break the tie (SC-GS: 1e-2).
const HYPER_NOISE: f64 = 1e-2;
/// The motion mask's logit at the start: Gaussians follow their nodes almost completely.
const MASK_LOGIT: f64 = 3.0;
/// Numbers of a frame: a 3 × 4 matrix.
const FRAME: usize = 12;
/// Radius of nodes that have no neighbours, scene units.
const LONE_RADIUS: f64 = 1.0;

/// Column of the log radius in the table of nodes.
pub const NODE_LOG_RADIUS: usize = 3;
/// Column of the weight logit in the table of nodes.
pub(crate) const NODE_LOGIT: usize = 4;
/// First column of the hyper coordinates in the table of nodes.
pub const NODE_HYPER: usize = 5;
/// Numbers of a node's pose: shift 3, quaternion residual about the identity 4.
pub(crate) const POSE: usize = 7;
/// Columns of a table of poses.
pub(crate) const POSE_COLUMNS: [(&str, usize); 2] = [("shift", 3), ("turn", 4)];

/// The trajectories of control nodes.
pub trait Trajectory<F: Real>: Send + Sync {
    /// Once per step with all its times: scans, networks.
    fn prepare(&self, _p: &Params<F>, _times: &[Time], _cache: &mut Slot) {}

    /// Node poses at t, one of the prepared times: fills `out` [nodes, 7] with the displacement 3 (scene units) and the
    /// quaternion's residual about the identity 4 (rotation = normalize((1,0,0,0) + r), about the node's own position).
    fn poses(&self, p: &Params<F>, t: Time, cache: &Slot, out: &mut Table<F>);

    /// Adds the gradient of `poses` to `d_cache` (or `d`); returns dL/dt. May be called several times for one t.
    fn poses_backward(
        &self,
        p: &Params<F>,
        t: Time,
        cache: &Slot,
        d_out: &Table<F>,
        d_cache: &mut Slot,
        d: &mut Grads<F>,
    ) -> f64;

    /// Once per step: the VJP of `prepare`.
    fn finish(&self, _p: &Params<F>, _times: &[Time], _cache: &mut Slot, _d_cache: &mut Slot, _d: &mut Grads<F>) {}

    /// Bytes that a step keeps of `prepare` for [`finish`](Self::finish).
    fn scratch_bytes(&self, p: &Params<F>) -> u64;

    /// After a node edit (densify, prune) has gathered every table of the nodes.
    fn on_edit(&self, _p: &mut Params<F>, _edit: &RowEdit) {}
}

/// A skin as plain data.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SkinSpec {
    /// Nodes that training starts with, 0 to [`MAX_NODES`]; a file has as many as its arrays.
    pub nodes: usize,
    /// Nodes that pull each Gaussian, 1 to [`MAX_NEIGHBOURS`].
    pub neighbours: usize,
    /// Hyper coordinates of Gaussians and nodes, 0 to `MAX_HYPER`.
    pub hyper: usize,
    /// Whether Gaussians have a motion mask.
    pub mask: bool,
}

impl Default for SkinSpec {
    /// 512 nodes, 3 of them a Gaussian, 8 hyper coordinates, no mask (SC-GS).
    fn default() -> Self {
        Self { nodes: 512, neighbours: 3, hyper: 8, mask: false }
    }
}

impl SkinSpec {
    /// Errors: a number out of its range.
    pub(crate) fn check(&self) -> Result<()> {
        let ranges = [
            ("nodes", self.nodes, 0, MAX_NODES),
            ("neighbours", self.neighbours, 1, MAX_NEIGHBOURS),
            ("hyper", self.hyper, 0, MAX_HYPER),
        ];
        for (name, value, low, high) in ranges {
            if !(low..=high).contains(&value) {
                return Err(Error::input(format!("invalid skin: {name} = {value}, expected {low} to {high}"))
                    .remedy("The file is damaged or was written by another program; export it again"));
            }
        }
        Ok(())
    }
}

/// The tables of a skin.
#[derive(Clone, Copy, Debug)]
pub struct Skin {
    /// The settings it was made with.
    pub spec: SkinSpec,
    /// Nodes: `node_means` 3, `node_log_radii` 1, `node_logits` 1, `node_hyper` h.
    pub nodes: Key,
    /// Gaussians: `hyper` h.
    pub hyper: Key,
    /// Gaussians: `motion_mask` 1 (a logit), or no column.
    pub mask: Key,
    /// Gaussians: `node_candidates`, numbers of the nearest nodes; not learnt.
    pub candidates: Key,
}

impl Skin {
    /// Makes or claims the tables in `p`: nodes at farthest points of the Gaussians, as wide as they are apart, all
    /// bound.
    ///
    /// If the layer has fewer Gaussians than `spec.nodes`, there are as many nodes as Gaussians. Errors: numbers of the
    /// spec out of range, loaded arrays of the wrong shape.
    pub(crate) fn new<F: Real>(spec: SkinSpec, seed: u64, p: &mut Params<F>) -> Result<Self> {
        spec.check()?;
        let rows = p.len();
        let loaded = p.unclaimed().iter().find(|a| a.name == "node_means").map(|a| a.rows);
        let centers = if loaded.is_some() { Vec::new() } else { farthest_points(&p[GEOMETRY], spec.nodes) };
        let count = loaded.unwrap_or(centers.len());
        if count > MAX_NODES {
            return Err(Error::input(format!("{count} control nodes are too many: {MAX_NODES} are possible"))
                .remedy("The file is damaged or was written by another program; export it again"));
        }
        let mut columns = vec![("node_means", 3), ("node_log_radii", 1), ("node_logits", 1)];
        if spec.hyper > 0 {
            columns.push(("node_hyper", spec.hyper));
        }
        let rng = Rng::new(seed, "nodes", 0);
        let nodes = p.entry("nodes", Space::Nodes, &columns, count, |t| start_nodes(t, &centers, rng))?;
        let columns: &[_] = if spec.hyper > 0 { &[("hyper", spec.hyper)] } else { &[] };
        let hyper = p.entry("hyper", Space::Gaussians, columns, rows, |_| {})?;
        let columns: &[_] = if spec.mask { &[("motion_mask", 1)] } else { &[] };
        let fill =
            |t: &mut Table<F>| (0..if spec.mask { rows } else { 0 }).for_each(|r| t.set(r, 0, F::of(MASK_LOGIT)));
        let mask = p.entry("motion_mask", Space::Gaussians, columns, rows, fill)?;
        let width = spec.neighbours + SPARE_CANDIDATES;
        let mut fresh = false;
        let candidates =
            p.entry("node_candidates", Space::Gaussians, &[("node_candidates", width)], rows, |_| fresh = true)?;
        p.info_mut(candidates).trainable = false;
        let skin = Self { spec, nodes, hyper, mask, candidates };
        if fresh {
            skin.bind(p);
        }
        Ok(skin)
    }

    /// The skin of a layer that has one, by its tables' names.
    pub fn find<F: Real>(p: &Params<F>) -> Option<Self> {
        let key = |name: &str| p.find(name);
        let (nodes, hyper, mask) = (key("nodes")?, key("hyper")?, key("motion_mask")?);
        let candidates = key("node_candidates")?;
        let spec = SkinSpec {
            nodes: p[nodes].rows(),
            neighbours: p[candidates].width() - SPARE_CANDIDATES,
            hyper: p[hyper].width(),
            mask: p[mask].width() > 0,
        };
        Some(Self { spec, nodes, hyper, mask, candidates })
    }

    /// Refreshes every Gaussian's list of nearest nodes.
    pub fn bind<F: Real>(&self, p: &mut Params<F>) {
        let mut list = std::mem::take(&mut p[self.candidates]);
        weights::nearest(self, p, &mut list);
        p[self.candidates] = list;
    }

    /// The weights of all Gaussians.
    pub fn weigh<F: Real>(&self, p: &Params<F>, out: &mut Weights<F>) {
        out.fill(self, p);
    }

    /// Number of nodes.
    pub fn count<F: Real>(&self, p: &Params<F>) -> usize {
        p[self.nodes].rows()
    }
}

/// Nodes at `centers`: as wide as the distance to their neighbours, of equal weight, with a little noise in the hyper
/// coordinates.
fn start_nodes<F: Real>(t: &mut Table<F>, centers: &[[F; 3]], rng: Rng) {
    let points: Vec<[f32; 3]> = centers.iter().map(|c| c.map(|x| x.f64() as f32)).collect();
    let spacing = mean_square_distance(&points);
    for (k, (c, square)) in centers.iter().zip(spacing).enumerate() {
        let radius = f64::from(square).sqrt();
        let radius = if radius > 0.0 && radius.is_finite() { radius } else { LONE_RADIUS };
        t.write(k, 0, [c[0], c[1], c[2], F::of(radius.ln()), F::ZERO]);
        for col in NODE_HYPER..t.width() {
            t.set(k, col, F::of(HYPER_NOISE * radius * rng.fork(k as u64).normal(col as u64)));
        }
    }
}

/// Motion by a skin and a model that drives its nodes. Queries of [`Space::Nodes`] return isotropic splats: the node's
/// position, its radius, sigmoid(logit) as opacity.
pub struct Skinned<F: Real> {
    /// Which Gaussian follows which nodes.
    pub skin: Skin,
    trajectory: Arc<dyn Trajectory<F>>,
    spec: Spec,
}

/// Values that a step computes once: weights, and the nodes' frames at all its times.
struct Prepared<F> {
    weights: Weights<F>,
    times: Vec<Time>,
    frames: Vec<Frames<F>>,
    poses: Table<F>,
    trajectory: Slot,
}

impl<F: Real> Default for Prepared<F> {
    fn default() -> Self {
        Self {
            weights: Weights::default(),
            times: Vec::new(),
            frames: Vec::new(),
            poses: Table::new(&POSE_COLUMNS, 0),
            trajectory: Slot::default(),
        }
    }
}

/// Gradients that wait for `finish`.
#[derive(Default)]
struct Pending<F> {
    /// dL/d weights, [N, K] row-major; empty: none.
    weights: Vec<F>,
    trajectory: Slot,
}

impl<F: Real> Skinned<F> {
    /// `spec`: what files store of it. The trajectory must give as many poses as the skin has nodes.
    pub(crate) fn new(skin: Skin, trajectory: Box<dyn Trajectory<F>>, spec: Spec) -> Self {
        Self { skin, trajectory: trajectory.into(), spec }
    }

    /// The same motion with nodes displaced at all times, for editing: `offsets` [nodes, 7] are shifts to be added and
    /// rotations to be done after the nodes' own, as [`arap`](super::arap) gives them. Files cannot hold it.
    ///
    /// Panics: not as many offsets as nodes, when it is queried.
    pub fn with_offsets(&self, offsets: Table<F>) -> Self {
        let trajectory = Arc::new(offset::Offset { of: self.trajectory.clone(), by: offsets });
        Self { skin: self.skin, trajectory, spec: Spec::Custom(format!("{} with displaced nodes", self.spec.name())) }
    }

    /// The same, as a layer holds it.
    pub(crate) fn shared(skin: Skin, trajectory: Box<dyn Trajectory<F>>, spec: Spec) -> Arc<dyn Motion<F>> {
        Arc::new(Self::new(skin, trajectory, spec))
    }

    /// Refreshes every Gaussian's list of nearest nodes; training does so now and then.
    pub(crate) fn bind(&self, p: &mut Params<F>) {
        self.skin.bind(p);
    }

    /// Node poses at t, [nodes, 7].
    pub fn poses(&self, p: &Params<F>, t: Time) -> Table<F> {
        let mut cache = Slot::default();
        self.trajectory.prepare(p, &[t], &mut cache);
        let mut out = Table::new(&POSE_COLUMNS, self.skin.count(p));
        self.trajectory.poses(p, t, &cache, &mut out);
        out
    }

    fn prepared<'a>(&self, cache: &'a Cache, t: Time) -> (&'a Prepared<F>, &'a Frames<F>) {
        let c: &Prepared<F> = cache.get().expect("`prepare` precedes every query");
        let i = c.times.iter().position(|x| same(*x, t)).expect("every time of a step was prepared");
        (c, &c.frames[i])
    }
}

/// Whether two times are one, NaN included.
fn same(a: Time, b: Time) -> bool {
    a.0.to_bits() == b.0.to_bits()
}

impl<F: Real> Motion<F> for Skinned<F> {
    fn spec(&self) -> Spec {
        self.spec.clone()
    }

    /// Weights of the nodes that pull a Gaussian, their gradients, and its blended frame.
    fn scratch_bytes(&self, p: &Params<F>, rows: usize) -> u64 {
        let numbers = 4 * self.skin.spec.neighbours + 2 * FRAME;
        (rows * numbers * size_of::<F>()) as u64 + self.trajectory.scratch_bytes(p)
    }

    fn prepare(&self, p: &Params<F>, q: &[At<'_, F>], cache: &mut Cache) {
        let c: &mut Prepared<F> = cache.get_or_default();
        c.times.clear();
        for at in q {
            if !c.times.iter().any(|t| same(*t, at.t)) {
                c.times.push(at.t);
            }
        }
        if q.iter().any(|at| at.of == Space::Gaussians) {
            c.weights.fill(&self.skin, p);
        }
        self.trajectory.prepare(p, &c.times, &mut c.trajectory);
        c.frames.resize_with(c.times.len(), Frames::default);
        c.poses.resize(self.skin.count(p));
        for (t, frames) in c.times.iter().zip(&mut c.frames) {
            self.trajectory.poses(p, *t, &c.trajectory, &mut c.poses);
            frames.fill(&p[self.skin.nodes], &c.poses);
        }
    }

    fn at(&self, q: &At<'_, F>, cache: &Cache, tape: &mut Tape<F>) {
        let (c, frames) = self.prepared(cache, q.t);
        tape.start(q.len());
        if q.of == Space::Nodes {
            fill_rows(&mut tape.out, q.rows, |id| frames.splat(&q.p[self.skin.nodes], id));
            return;
        }
        let ask = blend::SkinQuery { skin: &self.skin, p: q.p, weights: &c.weights, frames };
        fill(&ask, [&mut tape.out], q.rows);
    }

    fn backward(
        &self,
        q: &At<'_, F>,
        cache: &Cache,
        _tape: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        let count = self.skin.count(q.p);
        let (c, frames) = self.prepared(cache, q.t);
        let pending: &mut Pending<F> = d_cache.get_or_default();
        // Gaussians pull on nodes: all of them take part.
        d.activate(Space::Nodes, Rows::All);
        let mut d_poses = Table::new(&POSE_COLUMNS, count);
        if q.of == Space::Nodes {
            let [d_nodes] = d.of([self.skin.nodes]);
            for j in 0..q.len() {
                let id = q.rows.id(j);
                let g = d_out.out.read::<10>(j, 0);
                d_poses.add(id, 0, [g[0], g[1], g[2]]);
                d_nodes.add(id, 0, Frames::splat_backward(&q.p[self.skin.nodes], id, g));
            }
        } else {
            let width = c.weights.neighbours() * q.p.len();
            pending.weights.resize(width, F::ZERO);
            let ask = blend::SkinQuery { skin: &self.skin, p: q.p, weights: &c.weights, frames };
            let d_frames = ask.backward(q.rows, d_out.out, &mut pending.weights, d);
            let [d_nodes] = d.of([self.skin.nodes]);
            frames.backward(&d_frames, &mut d_poses, d_nodes);
        }
        debug_assert!(frames.len() == count, "a frame a node");
        self.trajectory.poses_backward(q.p, q.t, &c.trajectory, &d_poses, &mut pending.trajectory, d)
    }

    fn finish(&self, p: &Params<F>, _q: &[At<'_, F>], cache: &mut Cache, d_cache: &mut Cache, d: &mut Grads<F>) {
        let c: &mut Prepared<F> = cache.get_or_default();
        let pending: &mut Pending<F> = d_cache.get_or_default();
        if !pending.weights.is_empty() {
            c.weights.backward(&self.skin, p, &pending.weights, d);
        }
        self.trajectory.finish(p, &c.times, &mut c.trajectory, &mut pending.trajectory, d);
    }

    /// Lists name nodes by number: an edit of the nodes makes them again.
    fn on_edit(&self, p: &mut Params<F>, edit: &RowEdit, _rng: &Rng) {
        if edit.space == Space::Nodes {
            self.trajectory.on_edit(p, edit);
            self.bind(p);
        }
    }
}
