//! Memory of training, before it starts: tables of parameters are counted exactly, on a model made of a few rows;
//! what steps need next to them is estimated.

use crate::Result;
use crate::capture::Capture;
use crate::methods::{Method, TrainContext};
use crate::recipe::Recipe;
use splat4d::math::Rng;
use splat4d::motion::Motion;
use splat4d::scene::splats::SPLAT_COLUMNS;
use splat4d::scene::{GEOMETRY, Params, Space};
use std::sync::Arc;

/// Bytes a Gaussian takes in the renderer: records, gradient records, projections (measured: about 1.2 kB).
const RENDER_BYTES: u64 = 1200;
/// Bytes a pixel takes in training: images, gradients and the loss's scratch, all f32.
const PIXEL_BYTES: u64 = 200;
/// Bytes a pixel takes in the image store: colour of 8 bits, or of 16 where images are reduced, and a mask.
const STORED_BYTES: [u64; 2] = [4, 7];
/// The same of measured depth; and a scan, next to the part of it that is read at a time.
const MEASURED_BYTES: [u64; 2] = [2, 32 << 20];
/// Bytes that nothing below counts: the program, threads, what the allocator holds back. Chosen on the runs of
/// docs/models.md.
const PROCESS_BYTES: u64 = 80 << 20;
/// While a checkpoint is written, values and moments are in memory twice more: as rows, and as the file. Of the tables.
const CHECKPOINT: [u64; 2] = [3, 2];
/// Bytes of a number.
const F32: u64 = 4;
/// Numbers per learnable number: itself, its gradient, two moments.
const LEARNT: u64 = 4;
/// Numbers a splat has in a result, and as many in its gradient.
const ANSWER: u64 = 2 * splat_numbers();
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

/// Estimated peak memory of training, bytes: images in the cache and in flight, and Gaussians at the cap with what
/// their model has next to them: networks, planes, nodes, the state of a filter.
pub fn memory_estimate(capture: &Capture, recipe: &Recipe) -> u64 {
    let frames = || capture.train.iter().map(|&i| &capture.frames[i]);
    let cap = recipe.densify.max_cap as u64;
    let frame = frames().map(|f| (f.view.width * f.view.height) as u64).max();
    let pixels = frame.unwrap_or(0);
    let [measured, scan] = if capture.geometry.is_some() { MEASURED_BYTES } else { [0, 0] };
    let stored = STORED_BYTES[usize::from(capture.downscale > 1)] + measured;
    let images = (pixels * stored * capture.train.len() as u64).min(recipe.run.image_memory);
    let sum = PROCESS_BYTES + scan + images + pixels * PIXEL_BYTES * recipe.run.batch_size as u64 + cap * RENDER_BYTES;
    if capture.train.is_empty() {
        return sum;
    }
    let plan = super::open::plan(capture, recipe);
    // A recipe that no model can be made of has an error of its own.
    sum + model(recipe, &plan, recipe.densify.max_cap).unwrap_or(0)
}

/// Bytes of a model's tables in training, and of what a step with it needs, at `rows` Gaussians.
fn model(recipe: &Recipe, plan: &TrainContext, rows: usize) -> Result<u64> {
    let program = recipe.program()?;
    let few = Few::new(program.as_ref(), plan, rows)?;
    let tables = few.tables(rows);
    let checkpoint = tables * CHECKPOINT[0] / CHECKPOINT[1];
    let query = rows as u64 * ANSWER * F32 + few.motion.scratch_bytes(&few.params, rows);
    Ok(tables + checkpoint + program.growth_bytes(plan, rows) + plan.batch_size as u64 * query)
}

/// A program's model on few rows: as many as it needs for its nodes.
struct Few {
    params: Params<f32>,
    motion: Arc<dyn Motion<f32>>,
    /// Most nodes.
    nodes: usize,
}

impl Few {
    fn new(program: &dyn Method, plan: &TrainContext, rows: usize) -> Result<Self> {
        let nodes = program.nodes(plan).min(rows);
        let (few, coefficients) = (FEW.max(nodes), (plan.common.appearance.sh_degree + 1).pow(2));
        let mut params = Params::<f32>::new(few, coefficients, program.life(plan).columns());
        let rng = Rng::new(0, "memory", 0);
        for row in 0..few {
            // Nodes start at different places.
            params[GEOMETRY].write(row, 0, [0, 1, 2].map(|k| rng.fork(k).uniform(row as u64) as f32));
        }
        let motion = program.build(plan, &mut params)?;
        Ok(Self { params, motion, nodes })
    }

    /// Bytes of all tables at `rows` Gaussians: values, gradients, two moments and a row's step count.
    fn tables(&self, rows: usize) -> u64 {
        let p = &self.params;
        let bytes = |key| {
            let count = match p.info(key).space {
                Space::Gaussians => rows,
                Space::Nodes => self.nodes,
                _ => p[key].rows(),
            };
            count as u64 * (LEARNT * p[key].width() as u64 + 1) * F32
        };
        p.keys().map(bytes).sum()
    }
}

/// Bytes of memory that the system could give a program now, within what its group may take; `None`: it does not report
/// it.
pub fn available_memory() -> Option<u64> {
    let number = |path: &str| std::fs::read_to_string(path).ok()?.trim().parse::<u64>().ok();
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix("MemAvailable:"))?;
    let system = line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? << 10;
    let group = number("/sys/fs/cgroup/memory.max").zip(number("/sys/fs/cgroup/memory.current"));
    Some(group.map_or(system, |(most, now)| system.min(most.saturating_sub(now))))
}

/// Peak resident memory of this process, bytes; 0 where the system does not report it.
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
    use crate::run::tests::{Place, recipe};

    /// The tables of a run that is at its cap, counted, are what was estimated.
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
            let opened = super::super::open::OpenCapture::new(place.open(&r), &r).unwrap();
            let plan = opened.plan(&r);
            let trainer = opened.trainer(&r, &plan, opened.initial_scene(&r, &plan).unwrap()).unwrap();
            let p = &trainer.scene().layers[0].params;
            let values: usize = p.keys().map(|k| size_of_val(p[k].data())).sum();
            let counted = values + splat4d::scene::Grads::new(p).bytes() + trainer.train_state.moments()[0].bytes();
            let rows = trainer.scene().len();
            let few = Few::new(r.program().unwrap().as_ref(), &plan, rows).unwrap();
            let estimated = few.tables(rows) as f64;
            let off = counted as f64 / estimated;
            assert!((1.0 / ROUNDED..ROUNDED).contains(&off), "{line}: {counted} bytes, estimated {estimated}");
        }
    }

    #[test]
    fn memory_estimates_grow_with_the_work() {
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
