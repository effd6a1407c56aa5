//! What training will take, before it starts: tables of parameters are counted exactly, on a model made of a few rows;
//! what steps need beside them is estimated.

use crate::Result;
use crate::capture::Capture;
use crate::methods::{Plan, program_of};
use crate::recipe::Recipe;
use splat4d::math::Rng;
use splat4d::motion::deform::Input;
use splat4d::motion::{Spec, build};
use splat4d::nn::{HashShape, Kept, encoding};
use splat4d::scene::splats::SPLAT_COLUMNS;
use splat4d::scene::{GEOMETRY, Params, Space};

/// Bytes a Gaussian takes in the renderer: records, gradient records, projections (measured: about 1.2 kB).
const RENDER_BYTES: u64 = 1200;
/// Bytes a Gaussian's pose takes, a frame.
const PAGE_BYTES: u64 = 28;
/// Bytes a pixel takes in training: pictures, gradients and the loss's scratch, all f32.
const PIXEL_BYTES: u64 = 200;
/// Bytes a pixel takes in the picture store: colour of 8 bits, or of 16 where pictures are reduced, and a mask.
const STORED_BYTES: [u64; 2] = [4, 7];
/// Bytes that nothing below counts: the program, threads, what the allocator holds back. Chosen on the runs of
/// docs/models.md.
const PROCESS_BYTES: u64 = 80 << 20;
/// While a checkpoint is written, values and moments stand twice more in memory: as rows, and as the file. Of the tables.
const CHECKPOINT: [u64; 2] = [3, 2];
/// Bytes of a number.
const F32: u64 = 4;
/// Numbers of a learnable number: itself, its gradient, two moments.
const LEARNT: u64 = 4;
/// Numbers a splat has in an answer, and as many in its gradient.
const ANSWER: u64 = 2 * splat_numbers();
/// Numbers a node has at a tick of a scan: its pose and the gradient to it.
const TICK: u64 = 32;
/// Heads of a deformation: position (or screw), rotation, scale.
const DEFORM_HEADS: u64 = 13;
/// Rows on which a model without nodes is made.
const FEW: usize = 16;

const fn splat_numbers() -> u64 {
    let (mut sum, mut i) = (0, 0);
    while i < SPLAT_COLUMNS.len() {
        sum += SPLAT_COLUMNS[i].1 as u64;
        i += 1;
    }
    sum
}

/// Estimated peak memory of training, bytes: pictures in the cache and in flight, and Gaussians at the cap with what
/// their model has beside them: networks, planes, nodes, the state of a filter.
pub fn memory_estimate(capture: &Capture, recipe: &Recipe) -> u64 {
    let frames = || capture.train.iter().map(|&i| &capture.frames[i]);
    let cap = recipe.max_cap as u64;
    let frame = frames().map(|f| (f.view.width * f.view.height) as u64).max();
    let pixels = frame.unwrap_or(0);
    let stored = STORED_BYTES[usize::from(capture.downscale > 1)];
    let images = (pixels * stored * capture.train.len() as u64).min(recipe.image_memory);
    let mut sum = PROCESS_BYTES + images + pixels * PIXEL_BYTES * recipe.batch_size as u64 + cap * RENDER_BYTES;
    if recipe.motion == "tracked" {
        // The result itself: a pose a Gaussian and frame.
        let first = frames().map(|f| f.index).min().unwrap_or(0);
        let last = frames().map(|f| f.index).max().unwrap_or(0);
        sum += cap * PAGE_BYTES * (last - first) as u64;
    }
    if capture.train.is_empty() {
        return sum;
    }
    let plan = super::run::plan(capture, recipe);
    // A recipe that no model can be made of has an error of its own.
    sum + model(&plan, recipe.max_cap).unwrap_or(0)
}

/// Bytes of a model's tables in training, and of what a step with it needs, at `rows` Gaussians.
fn model(plan: &Plan, rows: usize) -> Result<u64> {
    let spec = program_of(&plan.recipe)?.spec(plan);
    let tables = tables(plan, &spec, rows)?;
    let checkpoint = tables * CHECKPOINT[0] / CHECKPOINT[1];
    Ok(tables + checkpoint + rows as u64 * plan.recipe.batch_size as u64 * F32 * scratch(plan, &spec, rows))
}

/// Bytes of all tables at `rows` Gaussians: values, gradients, two moments and the steps that a row has taken.
fn tables(plan: &Plan, spec: &Spec, rows: usize) -> Result<u64> {
    let r = &plan.recipe;
    let nodes = matches!(innermost(spec), Spec::Control(_) | Spec::Ssm(_));
    let most = if r.control_adapt_interval > 0 { r.control_max_nodes.max(r.control_nodes) } else { r.control_nodes };
    let few = if nodes { most.min(rows) } else { FEW };
    let life = program_of(r)?.life(plan);
    let mut p = Params::<f32>::new(few, (r.sh_degree + 1) * (r.sh_degree + 1), life.columns());
    let rng = Rng::new(0, "memory", 0);
    for row in 0..few {
        // Nodes start at different places.
        p[GEOMETRY].write(row, 0, [0, 1, 2].map(|k| rng.fork(k).uniform(row as u64) as f32));
    }
    build::<f32>(&with_nodes(spec.clone(), few), &mut p)?;
    let bytes = |key| {
        let count = if p.info(key).space == Space::Gaussians { rows } else { p[key].rows() };
        count as u64 * (LEARNT * p[key].width() as u64 + 1) * F32
    };
    Ok(p.keys().map(bytes).sum())
}

fn innermost(spec: &Spec) -> &Spec {
    match spec {
        Spec::Filtered(f) => innermost(&f.inner),
        other => other,
    }
}

/// The same model with another number of nodes, where it has any.
fn with_nodes(mut spec: Spec, nodes: usize) -> Spec {
    match &mut spec {
        Spec::Control(s) => s.skin.nodes = nodes,
        Spec::Ssm(s) => s.skin.nodes = nodes,
        Spec::Filtered(f) => *f.inner = with_nodes((*f.inner).clone(), nodes),
        _ => {}
    }
    spec
}

/// Numbers that a Gaussian takes in the answer to one question: the answer, its gradient, and what the model remembers
/// for its backward.
fn scratch(plan: &Plan, spec: &Spec, rows: usize) -> u64 {
    ANSWER
        + match spec {
            Spec::DeformMlp(s) => {
                let hash = |s: &HashShape| s.levels * s.features;
                let inputs = match &s.input {
                    Input::Encoded { x_levels, .. } => encoding::encoded(3, *x_levels),
                    Input::Hashed { space, time } => hash(space) + 3 * hash(time),
                };
                let most = (Kept::<f32>::BYTES / rows.max(1)) as u64 / F32;
                2 * (inputs as u64 + DEFORM_HEADS) + ((s.layers * s.width) as u64).min(most)
            }
            Spec::Hexplane(s) => {
                let colors = if s.heads.sh { 3 * (plan.recipe.sh_degree as u64 + 1).pow(2) } else { 0 };
                // Place, what the heads said, what became of it; features and trunk with their gradients, hidden layers.
                let heads = [s.heads.position, s.heads.scale, s.heads.rotation, s.heads.opacity, s.heads.sh];
                let hidden = heads.iter().filter(|on| **on).count() + s.defor_depth.max(1) - 1;
                3 + 2 * (11 + colors) + (2 * (s.planes.features() + s.net_width) + hidden * s.net_width) as u64
            }
            Spec::Control(s) => skinned(s.skin.neighbours),
            Spec::Ssm(s) => skinned(s.skin.neighbours) + (s.skin.nodes * s.ticks) as u64 * TICK / rows.max(1) as u64,
            Spec::Filtered(f) => {
                // The model's answers now and earlier; a state of each, and the gradients to them.
                let earlier = 1 + f.history.max(f.baseline + 1) as u64;
                earlier * (scratch(plan, &f.inner, rows) + splat_numbers())
            }
            _ => 0,
        }
}

/// Weights of the nodes that pull a Gaussian, their gradients, and its blended frame.
fn skinned(neighbours: usize) -> u64 {
    4 * neighbours as u64 + 2 * 12
}

/// Peak resident memory of this process, bytes; 0 where the system does not tell.
pub fn peak_memory() -> u64 {
    std::fs::read_to_string("/proc/self/status")
        .ok()
        .and_then(|s| {
            let line = s.lines().find(|l| l.starts_with("VmHWM:"))?.to_owned();
            line.split_whitespace().nth(1)?.parse::<u64>().ok()
        })
        .map_or(0, |kib| kib * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::run::tests::{Place, recipe};

    /// The tables of a run that stands at its cap, counted, are what was estimated.
    #[test]
    fn tables_are_counted_with_networks_planes_nodes_and_gains() {
        let place = Place::new();
        // What tables round up to: rows to whole blocks.
        const ROUNDED: f64 = 1.02;
        for line in [
            "motion=spacetime",
            "motion=native4d sh_harmonics=2 life=interval",
            "motion=deform-mlp deform_trunk=mlp",
            "motion=deform-mlp deform_trunk=hash",
            "motion=hexplane plane_channels=16 plane_resolution=24",
            "motion=control control_nodes=64 control_mask=true",
            "motion=ssm control_nodes=64",
            "motion=control control_nodes=64 filter=geodesic",
        ] {
            let r = recipe(&line.split(' ').chain(["num_pts=4096", "max_cap=4096"]).collect::<Vec<_>>()).resolve();
            let bench = super::super::run::Bench::new(place.open(&r), &r).unwrap();
            let plan = bench.plan(&r);
            let trainer = bench.trainer(&plan, bench.initial_scene(&plan).unwrap()).unwrap();
            let p = &trainer.scene().layers[0].params;
            let values: usize = p.keys().map(|k| size_of_val(p[k].data())).sum();
            let counted = values + splat4d::scene::Grads::new(p).bytes() + trainer.learner.moments()[0].bytes();
            let spec = program_of(&r).unwrap().spec(&plan);
            let estimated = tables(&plan, &spec, trainer.scene().len()).unwrap() as f64;
            let off = counted as f64 / estimated;
            assert!((1.0 / ROUNDED..ROUNDED).contains(&off), "{line}: {counted} bytes, estimated {estimated}");
        }
    }

    #[test]
    fn what_takes_more_is_estimated_to_take_more() {
        let place = Place::new();
        let estimate = |line: &str| {
            let r = recipe(&line.split(' ').collect::<Vec<_>>()).resolve();
            memory_estimate(&place.open(&r), &r)
        };
        for [less, more] in [
            ["motion=still", "motion=spacetime"],
            ["motion=deform-mlp deform_trunk=small", "motion=deform-mlp deform_trunk=mlp"],
            ["motion=hexplane plane_resolution=16", "motion=hexplane plane_resolution=64"],
            ["motion=ssm ssm_ticks=16", "motion=ssm ssm_ticks=4096"],
            ["motion=control", "motion=control filter=geodesic"],
            ["motion=control filter=geodesic", "motion=control filter=geodesic filter_history=8"],
        ] {
            let [a, b] = [less, more].map(estimate);
            assert!(a < b, "{less}: {a}, {more}: {b}");
        }
    }
}
