//! Dragging: handles pull control nodes over time, the others follow as rigidly as possible, and Gaussians follow them.

use super::parts::{parts, wrap};
use super::{Context, Selected};
use crate::layers::{Evaluation, Layer, Scene, freeze_rows, sweep};
use crate::math::quat;
use crate::math::se3::{add, norm, sub};
use crate::motion::Still;
use crate::motion::arap::{Elastic, Handle};
use crate::motion::edited::{Change, DragSpec, Edited, NodeOffset, NodeOffsets, eased};
use crate::motion::skin::farthest_points;
use crate::scene::splats::SPLAT_OPACITY;
use crate::scene::{LifeKind, Rows, Space, Table, Time};
use crate::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Nodes by default (SC-GS).
const NODES: usize = 512;
/// Rounds of turning and moving: more make no visible difference.
const ROUNDS: usize = 8;
/// Most times at which nodes are followed.
const MOST_TIMES: usize = 256;
/// Nodes that pull a Gaussian, and the next one, whose kernel is taken off theirs so that nothing jumps where
/// neighbours change.
const PULLING: usize = 4;
/// Fainter Gaussians carry no node.
const OPAQUE: f32 = 0.1;
/// Kernels are at least this, so that something far from all nodes follows the nearest.
const FLOOR: f64 = 1e-9;

pub(super) fn usual_nodes() -> usize {
    NODES
}

/// The pulled point.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DragHandle {
    /// Centre of the sphere whose nodes are held, scene units.
    pub place: [f64; 3],
    /// Its radius; the nearest node is always held.
    #[serde(default)]
    pub radius: f64,
    /// Its path, piecewise linear, constant before the first and after the last key.
    pub keys: Vec<DragKey>,
}

/// Displacement of a handle.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DragKey {
    /// Seconds.
    pub t: f64,
    /// Scene units.
    pub by: [f64; 3],
    /// Whether the motion eases in and out.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub ease: bool,
}

/// A drag as requested.
pub(super) struct DragRequest<'a> {
    pub at: f64,
    pub nodes: usize,
    pub handles: &'a [DragHandle],
    pub pins: &'a [[f64; 4]],
}

impl DragRequest<'_> {
    fn check_time(&self, scene: &Scene<f32>) -> Result<()> {
        let bad = |what: String, remedy: &str| Err(Error::input(what).remedy(remedy.to_owned()));
        if !(scene.clip[0]..=scene.clip[1]).contains(&self.at) {
            return bad(format!("{} s is outside the clip", self.at), "Give a second of the clip as `at`");
        }
        if self.nodes != 0 && !(2..=MOST_TIMES * PULLING).contains(&self.nodes) {
            return bad(
                format!("invalid number of nodes {}", self.nodes),
                "Give 2 to 1024, or 0 for those that the model has",
            );
        }
        Ok(())
    }

    fn check(&self, scene: &Scene<f32>) -> Result<()> {
        let bad = |what: String, remedy: &str| Err(Error::input(what).remedy(remedy.to_owned()));
        self.check_time(scene)?;
        let sound = |h: &DragHandle| {
            let numbers = h.keys.iter().flat_map(|k| k.by.into_iter().chain([k.t]));
            !h.keys.is_empty()
                && h.keys.windows(2).all(|k| k[0].t < k[1].t)
                && numbers.chain(h.place).chain([h.radius]).all(f64::is_finite)
        };
        if self.handles.is_empty() || !self.handles.iter().all(sound) {
            return bad(
                "a drag needs handles, each with keys in ascending order of time".into(),
                "Write handles = [{ place = [0, 0, 1], keys = [{ t = 0.0, by = [0, 0, 0] }, { t = 1.0, by = [0, 0, 1] }] }]",
            );
        }
        Ok(())
    }

    /// Frames of the clip, thinned out, with all key times and `at`; and the position of `at` among them.
    fn times(&self, scene: &Scene<f32>) -> (Vec<f64>, usize) {
        let [start, end] = scene.clip;
        let frames = ((end - start) * scene.fps.max(1.0)).round().max(0.0) as usize;
        let steps = frames.clamp(1, MOST_TIMES / 2);
        let mut times: Vec<f64> = (0..=steps).map(|i| start + (end - start) * i as f64 / steps as f64).collect();
        let keys = self.handles.iter().flat_map(|h| h.keys.iter().map(|k| k.t));
        times.extend(keys.filter(|t| (start..=end).contains(t)).take(MOST_TIMES));
        times.push(self.at);
        times.sort_by(f64::total_cmp);
        times.dedup();
        let first = times.iter().position(|t| *t == self.at).expect("it was just added");
        (times, first)
    }
}

/// The displacement of a handle at t.
fn displaced(keys: &[DragKey], t: f64) -> [f64; 3] {
    let after = keys.partition_point(|k| k.t <= t);
    if after == 0 || after == keys.len() {
        return keys[after.min(keys.len() - 1)].by;
    }
    let (a, b) = (&keys[after - 1], &keys[after]);
    let u = eased((t - a.t) / (b.t - a.t), [a.ease, b.ease]);
    std::array::from_fn(|k| a.by[k] * (1.0 - u) + b.by[k] * u)
}

/// Numbers of nodes within a sphere; the nearest in any case.
fn within(nodes: &[[f64; 3]], place: [f64; 3], radius: f64) -> Vec<usize> {
    let far: Vec<f64> = nodes.iter().map(|x| norm(sub(*x, place))).collect();
    let nearest = (0..nodes.len()).min_by(|a, b| far[*a].total_cmp(&far[*b]));
    (0..nodes.len()).filter(|k| far[*k] <= radius || Some(*k) == nearest).collect()
}

/// Bends the selected Gaussians, which get layers of their own.
pub(super) fn run(
    scene: &mut Scene<f32>,
    selected: &Selected,
    asked: &DragRequest<'_>,
    context: &dyn Context,
) -> Result<()> {
    asked.check(scene)?;
    let (times, first) = asked.times(scene);
    let (start, paths) = carried(scene, selected, asked, (&times, first), context)?;
    let elastic = Elastic::new(&start);
    let held = Held::of(&start, asked.handles.iter(), asked.pins)?;
    let offsets = |(t, rest): (&f64, &Vec<[f64; 3]>)| {
        let by: Vec<[f64; 3]> = asked.handles.iter().map(|h| displaced(&h.keys, *t)).collect();
        held.offsets(&elastic.at_rest(rest), rest, &by)
    };
    let moments: Vec<_> = times.par_iter().zip(&paths).map(offsets).collect::<Result<_>>()?;
    let all: Vec<_> = moments.into_iter().flatten().collect();
    let bend = Bend { start: &start, paths: &paths, times: &times, at: asked.at };
    for (place, pulls) in bend.around(scene, selected)? {
        fill(&mut scene.layers[place], &NodeOffsets { nodes: all.clone(), pulls });
    }
    Ok(())
}

/// The nodes that are held: those that stay, and those of every handle.
struct Held {
    pinned: Vec<usize>,
    pulled: Vec<Vec<usize>>,
}

impl Held {
    /// Errors: all nodes of all handles are pinned.
    fn of<'a>(nodes: &[[f64; 3]], handles: impl Iterator<Item = &'a DragHandle>, pins: &[[f64; 4]]) -> Result<Self> {
        let held = |at: [f64; 4]| within(nodes, [at[0], at[1], at[2]], at[3]);
        let pinned: Vec<usize> = pins.iter().flat_map(|p| held(*p)).collect();
        let pulled: Vec<Vec<usize>> = handles
            .map(|h| held([h.place[0], h.place[1], h.place[2], h.radius]))
            .map(|nodes| nodes.into_iter().filter(|n| !pinned.contains(n)).collect())
            .collect();
        if pulled.iter().all(Vec::is_empty) {
            return Err(
                Error::input("every node of every handle is pinned").remedy("Move the pins away from the handles")
            );
        }
        Ok(Self { pinned, pulled })
    }

    /// Positions of nodes at `rest` after the handles are displaced.
    fn offsets(&self, elastic: &Elastic, rest: &[[f64; 3]], by: &[[f64; 3]]) -> Result<Vec<NodeOffset>> {
        let mut handles: Vec<Handle> = Vec::new();
        let mut hold = |node: usize, by: [f64; 3]| {
            // A node of two handles follows the first.
            if !handles.iter().any(|h| h.node == node) {
                handles.push(Handle { node, target: add(rest[node], by), rotation: None });
            }
        };
        self.pinned.iter().for_each(|&n| hold(n, [0.0; 3]));
        for (nodes, by) in self.pulled.iter().zip(by) {
            nodes.iter().for_each(|&n| hold(n, *by));
        }
        if handles.iter().all(|h| h.target == rest[h.node]) {
            return Ok(unmoved(rest));
        }
        let dragged = elastic.drag(&handles, ROUNDS)?;
        let turns = dragged.rotations.iter().map(quat::from_rotation);
        let moved = rest.iter().zip(&dragged.positions).zip(turns);
        Ok(moved.map(|((from, to), turn)| (*from, sub(*to, *from), turn)).collect())
    }
}

fn unmoved(rest: &[[f64; 3]]) -> Vec<NodeOffset> {
    rest.iter().map(|x| (*x, [0.0; 3], [1.0, 0.0, 0.0, 0.0])).collect()
}

/// An interactive drag: one time of a scene whose nodes are pulled repeatedly. It shows what a step with the same
/// nodes, handles and pins makes of that time; away from the second at which places are meant nearly so, because who
/// follows which node then depends on their current positions.
#[derive(Clone, Debug)]
pub struct Dragging {
    scene: Scene<f32>,
    elastic: Elastic,
    /// Defining positions of the nodes, and those at the shown time.
    places: Vec<[f64; 3]>,
    nodes: Vec<[f64; 3]>,
    /// Of the layers that bend: their place, and which nodes pull their rows.
    bent: Vec<(usize, Vec<(u32, f32)>)>,
}

impl Dragging {
    /// Grabs the selection at second `now` by nodes whose positions are given at second `at`.
    ///
    /// Errors: as of the step; a scene with a pixel head.
    pub fn new(
        scene: &Scene<f32>,
        selected: &Selected,
        [at, now]: [f64; 2],
        nodes: usize,
        context: &dyn Context,
    ) -> Result<Self> {
        scene.without_head("a drag under the hand")?;
        let asked = DragRequest { at, nodes, handles: &[], pins: &[] };
        asked.check_time(scene)?;
        DragRequest { at: now, ..asked }.check_time(scene)?;
        // Frame by frame, as a step follows them.
        let between = |t: &f64| (at.min(now)..=at.max(now)).contains(t);
        let mut times: Vec<f64> = asked.times(scene).0.into_iter().filter(between).chain([now]).collect();
        times.sort_by(f64::total_cmp);
        times.dedup();
        let place = |t: f64| times.iter().position(|x| *x == t).expect("both ends are among them");
        let (places, mut paths) = carried(scene, selected, &asked, (&times, place(at)), context)?;
        let start = paths.swap_remove(place(now));
        let at = now;
        let (mut still, mut chosen) = (Scene { layers: Vec::new(), ..scene.clone() }, Vec::new());
        let mut ids = Vec::new();
        for (layer, selected) in scene.layers.iter().zip(selected) {
            if layer.active(Time(at), &mut ids) {
                ids = (0..layer.params.len() as u32).collect();
            }
            for wanted in [false, true] {
                let rows: Vec<u32> = ids.iter().copied().filter(|id| selected[*id as usize] == wanted).collect();
                if !rows.is_empty() {
                    chosen.push(vec![wanted; rows.len()]);
                    let params = freeze_rows(layer, &rows, Time(at));
                    still.layers.push(Layer::new(&layer.name, params, Arc::new(Still), LifeKind::Infinite));
                }
            }
        }
        let (paths, times) = ([start.clone()], [at]);
        let bent = Bend { start: &start, paths: &paths, times: &times, at }.around(&mut still, &chosen)?;
        // The ties are those of the positions, as in a step.
        let elastic = Elastic::new(&places).at_rest(&start);
        let mut out = Self { scene: still, elastic, places, nodes: start, bent };
        out.fill(&unmoved(&out.nodes));
        Ok(out)
    }

    /// Defining positions of the nodes: they determine what handles and pins take.
    pub fn places(&self) -> &[[f64; 3]] {
        &self.places
    }

    /// Positions of the nodes before any pull.
    pub fn nodes(&self) -> &[[f64; 3]] {
        &self.nodes
    }

    /// The deformed scene, constant in time.
    pub fn scene(&self) -> &Scene<f32> {
        &self.scene
    }

    /// Displaces handles, whose keys do not count; without any, all is as it was. Returns where the nodes are.
    ///
    /// Errors: all nodes of all handles are pinned; numbers that are not finite.
    pub fn pull(&mut self, handles: &[(DragHandle, [f64; 3])], pins: &[[f64; 4]]) -> Result<Vec<[f64; 3]>> {
        let offsets = if handles.is_empty() {
            unmoved(&self.nodes)
        } else {
            let by: Vec<[f64; 3]> = handles.iter().map(|h| h.1).collect();
            Held::of(&self.places, handles.iter().map(|h| &h.0), pins)?.offsets(&self.elastic, &self.nodes, &by)?
        };
        self.fill(&offsets);
        Ok(offsets.iter().map(|(place, shift, _)| add(*place, *shift)).collect())
    }

    fn fill(&mut self, offsets: &[NodeOffset]) {
        for (place, pulls) in &self.bent {
            fill(&mut self.scene.layers[*place], &NodeOffsets { nodes: offsets.to_vec(), pulls: pulls.clone() });
        }
    }
}

/// Writes a drag into the layer that `Bend::around` put it around.
fn fill(layer: &mut Layer<f32>, offsets: &NodeOffsets) {
    let motion = layer.motion.clone();
    let edited = Edited::of(motion.as_ref()).expect("the drag was put around it");
    edited.fill_drag(offsets, &mut layer.params);
}

/// Places of nodes at one time, and [times, nodes] at all of them.
type Carried = (Vec<[f64; 3]>, Vec<Vec<[f64; 3]>>);

/// Nodes at the time `first` of `times`, and at all of them: the model's own, or new ones that are followed.
fn carried(
    scene: &Scene<f32>,
    selected: &Selected,
    asked: &DragRequest<'_>,
    (times, first): (&[f64], usize),
    context: &dyn Context,
) -> Result<Carried> {
    if asked.nodes > 0 {
        let start = nodes(scene, selected, asked)?;
        let paths = context.follow(scene, selected, &start, times, first)?;
        return Ok((start, paths));
    }
    let Some(layer) = own_nodes(scene, selected) else {
        return Err(Error::input("the selection has no control nodes, or belongs to several layers that have some")
            .remedy("Give nodes = 512, or select one layer that a model on control nodes moves"));
    };
    let at = |t: &f64| {
        let seen = Evaluation::of_layer(layer, Space::Nodes, Rows::All, Time(*t));
        let out = seen.tape(0).out();
        (0..out.rows()).map(|j| layer.frame.apply(out.read::<3>(j, 0).map(f64::from))).collect()
    };
    let paths: Vec<Vec<[f64; 3]>> = times.iter().map(at).collect();
    Ok((paths[first].clone(), paths))
}

/// The only layer with selected rows whose model has nodes; none of an edited model, whose nodes are those inside.
pub(super) fn own_nodes<'a>(scene: &'a Scene<f32>, selected: &Selected) -> Option<&'a Layer<f32>> {
    let has = |(l, s): &(&Layer<f32>, &Vec<bool>)| {
        s.contains(&true) && l.params.rows_of(Space::Nodes) > 1 && Edited::of(l.motion.as_ref()).is_none()
    };
    let mut all = scene.layers.iter().zip(selected).filter(has).map(|(l, _)| l);
    all.next().filter(|_| all.next().is_none())
}

/// Nodes at farthest points of the selected Gaussians that can be seen at `at`.
fn nodes(scene: &Scene<f32>, selected: &Selected, asked: &DragRequest<'_>) -> Result<Vec<[f64; 3]>> {
    let mut seen = Evaluation::default();
    scene.at(Time(asked.at), &mut seen);
    let mut carriers = Vec::new();
    for (selected, tape) in selected.iter().zip(seen.tapes()) {
        for j in 0..tape.out().rows() {
            if selected[tape.rows().id(j)] && tape.out().get(j, SPLAT_OPACITY) >= OPAQUE {
                carriers.push(tape.out().read::<3>(j, 0));
            }
        }
    }
    let mut table = Table::new(&[("mean", 3)], carriers.len());
    carriers.iter().enumerate().for_each(|(row, x)| table.write(row, 0, *x));
    let found: Vec<[f64; 3]> =
        farthest_points(&table, asked.nodes).into_iter().map(|x: [f32; 3]| x.map(f64::from)).collect();
    if found.len() < 2 {
        return Err(Error::input(format!("no Gaussian of the selection is visible at {} s", asked.at))
            .remedy("Give another `at`, or another selection"));
    }
    Ok(found)
}

/// Nodes over time.
struct Bend<'a> {
    start: &'a [[f64; 3]],
    paths: &'a [Vec<[f64; 3]>],
    times: &'a [f64],
    at: f64,
}

/// A layer's index in the scene, and for each of its rows the nodes that pull it, with their weights.
type Pulled = (usize, Vec<(u32, f32)>);

impl Bend<'_> {
    /// Puts a drag around the selected Gaussians, which get layers of their own; returns the positions of those, and
    /// which nodes pull their rows. It is to be filled.
    fn around(&self, scene: &mut Scene<f32>, selected: &Selected) -> Result<Vec<Pulled>> {
        let count = self.start.len();
        let neighbours = PULLING.min(count - 1).max(1);
        let index = |layer: &Layer<f32>| (0..).find(|i| layer.params.find(&format!("drag_nodes.{i}")).is_none());
        let indices: Vec<u32> = scene.layers.iter().map(|l| index(l).expect("there are many numbers")).collect();
        let change = |from: usize| {
            let spec = DragSpec { index: indices[from], nodes: count, neighbours, times: self.times.to_vec() };
            Change::Drag(spec)
        };
        wrap(scene, selected, &change)?;
        Ok(parts(selected).into_iter().map(|(_, at)| (at, pulls(&scene.layers[at], self, neighbours))).collect())
    }
}

/// Of every Gaussian the nodes that pull it, by where they are while it is there: kernels of its distances, that of the
/// next node taken off.
fn pulls(layer: &Layer<f32>, bend: &Bend<'_>, neighbours: usize) -> Vec<(u32, f32)> {
    // The time of `bend.times` nearest to `at` at which a row is there.
    let spans = layer.spans();
    let nearest = |t: f64| {
        let after = bend.times.partition_point(|x| *x < t).min(bend.times.len() - 1);
        let before = after.saturating_sub(1);
        if (bend.times[after] - t).abs() < (t - bend.times[before]).abs() { after } else { before }
    };
    let mut asked: Vec<Vec<u32>> = vec![Vec::new(); bend.times.len()];
    for (row, [from, to]) in spans.iter().enumerate() {
        let t = if from <= to { bend.at.max(*from).min(*to) } else { bend.at };
        asked[nearest(t)].push(row as u32);
    }
    let radius = spacing(bend.start);
    let mut out = vec![(0, 0.0); spans.len() * neighbours];
    let queries: Vec<(Rows<'_>, Time)> =
        asked.iter().zip(bend.times).map(|(ids, t)| (Rows::Some(ids), Time(*t))).collect();
    // Tables without any pull yet: the result is that of the model inside.
    sweep(layer, &queries, |k, tape| {
        let nodes = &bend.paths[k];
        let one = |j: usize| {
            let x = tape.out().read::<3>(j, 0).map(f64::from);
            let mut near: Vec<(f64, u32)> =
                nodes.iter().enumerate().map(|(n, y)| (norm(sub(x, *y)), n as u32)).collect();
            let kept = neighbours.min(near.len() - 1);
            near.select_nth_unstable_by(kept, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            // Relative to the nearest, so that far away nothing vanishes.
            let least = near[..=kept].iter().map(|n| n.0).fold(f64::INFINITY, f64::min);
            let kernel = |d: f64| (-(d * d - least * least) / (2.0 * radius * radius)).exp();
            let off = kernel(near[kept].0);
            near.truncate(kept);
            near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            let weights: Vec<f64> = near.iter().map(|n| (kernel(n.0) - off).max(0.0) + FLOOR).collect();
            let sum: f64 = weights.iter().sum();
            near.iter().zip(weights).map(|(n, w)| (n.1, (w / sum) as f32)).collect::<Vec<_>>()
        };
        let found: Vec<Vec<(u32, f32)>> = (0..tape.out().rows()).into_par_iter().map(one).collect();
        for (j, found) in found.into_iter().enumerate() {
            let row = tape.rows().id(j);
            out[row * neighbours..row * neighbours + found.len()].copy_from_slice(&found);
        }
    });
    out
}

/// The median distance of a node to its nearest.
fn spacing(nodes: &[[f64; 3]]) -> f64 {
    let points: Vec<[f32; 3]> = nodes.iter().map(|x| x.map(|x| x as f32)).collect();
    let near = crate::math::knn::knn(&points, 1);
    let mut far: Vec<f64> = near.iter().enumerate().map(|(i, j)| norm(sub(nodes[i], nodes[*j as usize]))).collect();
    far.sort_by(f64::total_cmp);
    far[far.len() / 2].max(f64::MIN_POSITIVE.sqrt())
}
