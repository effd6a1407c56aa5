//! A step in the steady state allocates next to nothing: every buffer is an arena that is used again.
#![allow(unsafe_code)] // a counting allocator is one by definition

use splat4d::Result;
use splat4d::math::{Rng, Se3};
use splat4d::render::{RenderConfig, Renderer};
use splat4d::scene::params::{LOG_SCALE, QUAT};
use splat4d::scene::{Camera, GEOMETRY, LIFE, Planes, Time};
use splat4d_train::capture::frames::{Frames, Picture};
use splat4d_train::init;
use splat4d_train::maintenance::Limits;
use splat4d_train::methods::TrainContext;
use splat4d_train::recipe::Recipe;
use splat4d_train::step::loss::TrainLoss;
use splat4d_train::step::trainer::{Settings, Trainer};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Allocations a step: lists of a few views, cameras and queries, and blocks of the thread pool's queues.
const STEADY_ALLOCATIONS: usize = 60;
/// Bytes per step. One number a Gaussian would be 20,000 already.
const STEADY_BYTES: usize = 12_000;

const GAUSSIANS: usize = 5000;
const CAMERAS: usize = 3;
const TIMES: usize = 2;

struct Counting;

static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);
static BYTES: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call is passed unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        BYTES.fetch_add(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller keeps the contract of `alloc`, which is the same.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the pointer is from `alloc` above, that is from the system.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Grey images from three sides at two times: what they show does not matter here.
struct Grey(Vec<Camera>);

impl Frames for Grey {
    fn len(&self) -> usize {
        CAMERAS * TIMES
    }
    fn camera(&self, i: usize) -> &Camera {
        &self.0[i % CAMERAS]
    }
    fn time(&self, i: usize) -> Time {
        Time((i / CAMERAS) as f64 * 0.1)
    }
    fn rig(&self, i: usize) -> usize {
        i % CAMERAS
    }
    fn name(&self, i: usize) -> String {
        format!("frame {i}")
    }
    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        let camera = self.camera(i);
        let color: &mut Planes<f32> = &mut out.color;
        color.reset(3, camera.height, camera.width);
        color.data.fill(0.4);
        Ok(())
    }
}

fn trainer() -> Result<Trainer<'static>> {
    let camera = |i: usize| {
        let a = std::f64::consts::TAU * i as f64 / CAMERAS as f64;
        let pose = Se3::look_at([3.0 * a.cos(), 0.5, 3.0 * a.sin()], [0.0; 3], [0.0, 1.0, 0.0]);
        Camera::with_fov_y(pose, 0.8, 96, 80)
    };
    let grey = Grey((0..CAMERAS).map(camera).collect());
    let mut recipe = Recipe::default();
    let points = format!("num_pts={GAUSSIANS}");
    for setting in ["iterations=1000", "init=random", &points, "sh_degree=1", "half_size_until=0", "strategy=none"] {
        recipe.set(setting)?;
    }
    let plan = TrainContext {
        extent: 3.3,
        center: [0.0; 3],
        clip: [0.0, 0.1],
        fps: 10.0,
        times: TIMES,
        fixed_cameras: 3,
        moments: (0..TIMES).map(|k| (0.1 * k as f64, 3)).collect(),
        masks: false,
        ..recipe.plan()
    };
    let program = recipe.program()?;
    let seeds = init::seeds(&plan, &recipe.init, &grey, None, true)?;
    let mut scene = init::scene(&plan, &recipe.init, program.as_ref(), &seeds, [0.0; 3], [0.0, 1.0, 0.0])?;
    // Some are alive at one of the times only, so that the active set is a list and not everything.
    let params = &mut scene.layers[0].params;
    let rng = Rng::new(3, "lives", 0);
    for row in 0..params.len() {
        params[GEOMETRY].write(row, QUAT, [1.0, 0.0, 0.0, 0.0]);
        params[GEOMETRY].write(row, LOG_SCALE, [-3.0; 3]);
        params[LIFE].write(row, 0, [0.1 * rng.uniform(row as u64) as f32, -3.0]);
    }
    Ok(Trainer::new(
        scene,
        program.stages(&plan),
        Arc::new(grey),
        Box::new(Renderer::new(RenderConfig::default())),
        TrainLoss::photometric(0.2),
        Settings {
            seed: 0,
            limits: Limits { cap: GAUSSIANS, extent: 3.3, min_opacity: 0.005 },
            background: [0.0; 3],
            sh_degree: 1,
            exposure_lr: 0.0,
        },
    ))
}

#[test]
fn a_steady_step_stays_within_its_allocation_limit() {
    let mut trainer = trainer().unwrap();
    let mut steps = |count: usize| {
        for _ in 0..count {
            trainer.step().unwrap().expect("all is finite");
        }
    };
    steps(40);
    let count = || (ALLOCATIONS.load(Ordering::Relaxed), BYTES.load(Ordering::Relaxed));
    let before = count();
    // Few steps: what a Gaussian's growth makes larger (bins, active sets) is the arena's business, not the step's.
    let measured = 12;
    steps(measured);
    let after = count();
    let (allocations, bytes) = ((after.0 - before.0) / measured, (after.1 - before.1) / measured);
    assert!(allocations <= STEADY_ALLOCATIONS, "{allocations} allocations a step, {bytes} bytes");
    assert!(bytes <= STEADY_BYTES, "{bytes} bytes a step in {allocations} allocations");
}
