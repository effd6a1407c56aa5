//! Every stage against its twin on the CPU, then whole images. Without an adapter each test prints "skipped"; with
//! REQUIRE_GPU=1 that is a failure.

mod back;
mod compare;
mod pictures;
mod stages;

use super::*;
use crate::math::{Rng, Se3, sym3};
use crate::render::Renderer;
use crate::scene::splats::{Part, SPLAT_COLUMNS};
use crate::scene::{Camera, Color, Rows, Splats};
use buffers::Grown;
use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// An adapter of any kind.
pub(super) fn gpu() -> Option<Gpu> {
    match Gpu::open(Adapters::Any) {
        Ok(gpu) => Some(gpu),
        Err(e) => {
            assert!(std::env::var_os("REQUIRE_GPU").is_none(), "REQUIRE_GPU is set: {e}");
            println!("skipped: {e}");
            None
        }
    }
}

pub(super) fn own_renderer() -> Option<GpuRenderer> {
    gpu().map(|gpu| GpuRenderer::new(gpu, RenderConfig::default()).expect("the kernels compile"))
}

/// The renderer that the tests share, with its defaults: on lavapipe compiling the kernels takes longer than most of
/// them. Memory that an earlier test left behind must not matter.
pub(super) fn renderer() -> Option<impl DerefMut<Target = GpuRenderer>> {
    static SHARED: Mutex<Option<Box<GpuRenderer>>> = Mutex::new(None);
    /// A lock whose content is there.
    struct Held(MutexGuard<'static, Option<Box<GpuRenderer>>>);
    impl Deref for Held {
        type Target = GpuRenderer;
        fn deref(&self) -> &GpuRenderer {
            self.0.as_deref().expect("it was made")
        }
    }
    impl DerefMut for Held {
        fn deref_mut(&mut self) -> &mut GpuRenderer {
            self.0.as_deref_mut().expect("it was made")
        }
    }
    // A test that failed holds nothing that the next one reads.
    let mut shared = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
    if shared.is_none() {
        *shared = own_renderer().map(Box::new);
    }
    shared.as_ref()?;
    let mut held = Held(shared);
    held.config = RenderConfig::default();
    held.tables = Tables::Changing;
    held.most_pairs = MOST_PAIRS;
    held.clock = if held.gpu.has_timestamps() { StageClock::Gpu } else { StageClock::Off };
    Some(held)
}

/// The first `n` numbers of a buffer.
pub(super) fn read<T: bytemuck::AnyBitPattern + bytemuck::NoUninit>(gpu: &Gpu, buffer: &Grown, n: usize) -> Vec<T> {
    let bytes = (n * size_of::<T>()) as u64;
    let mut staging = Grown::new("test", wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST);
    staging.ensure(gpu, bytes).expect("a small buffer");
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    encoder.copy_buffer_to_buffer(buffer.get(), 0, staging.get(), 0, bytes);
    gpu.queue.submit([encoder.finish()]);
    staging.get().map_async(wgpu::MapMode::Read, .., |_| ());
    gpu.wait().expect("the copy runs");
    let view = staging.get().get_mapped_range(..).expect("it is mapped");
    bytemuck::pod_collect_to_vec(&view[..bytes as usize])
}

/// A storage buffer that holds `data`.
fn storage<T: bytemuck::NoUninit>(gpu: &Gpu, data: &[T]) -> Grown {
    let mut buffer = Grown::storage("test");
    buffer.ensure(gpu, size_of_val(data) as u64).expect("a small buffer");
    gpu.queue.write_buffer(buffer.get(), 0, bytemuck::cast_slice(data));
    buffer
}

/// Random Gaussians about the origin: small and large, thin and round, some of them behind any camera near it.
struct Scenery {
    out: Table<f32>,
    sh: Table<f32>,
}

impl Scenery {
    /// `spread`: half the side of the cube of means; `size`: typical scale.
    fn new(seed: u64, n: usize, spread: f64, size: f64) -> Self {
        let rng = Rng::new(seed, "gpu", 0);
        let (mut out, mut sh) = (Table::new(&SPLAT_COLUMNS, n), Table::new(&[("sh", 48)], n));
        for j in 0..n {
            let r = rng.fork(j as u64);
            let mean: [f32; 3] = std::array::from_fn(|k| (spread * (2.0 * r.uniform(k as u64) - 1.0)) as f32);
            let q: [f32; 4] = std::array::from_fn(|k| r.normal(10 + k as u64) as f32);
            let s: [f32; 3] = std::array::from_fn(|k| (size.ln() + 0.9 * r.normal(20 + k as u64)) as f32);
            out.write(j, 0, mean);
            out.write(j, 3, sym3::from_quat_log_scales(q, s));
            out.set(j, 9, r.uniform(4) as f32);
            for c in 0..48 {
                sh.set(j, c, (0.3 * r.normal(30 + c as u64)) as f32);
            }
        }
        Self { out, sh }
    }

    fn splats(&self) -> Splats<'_, f32> {
        let color = Color::Sh { table: &self.sh, rows: Rows::All, weights: None, base: true };
        Splats { parts: vec![Part::new(&self.out, color)], head: None }
    }
}

/// Looks at the origin from `eye`.
pub(super) fn camera(eye: [f64; 3], width: usize, height: usize) -> Camera {
    Camera::with_fov_y(Se3::look_at(eye, [0.1, -0.1, 0.0], [0.0, 1.0, 0.0]), 0.8, width, height)
}

/// Off-centre principal point, unequal focal lengths.
fn skewed(width: usize, height: usize) -> Camera {
    let mut camera = camera([1.5, 1.0, -2.5], width, height);
    let k = &mut camera.intrinsics;
    (k.fx, k.cx, k.cy) = (1.3 * k.fx, 0.3 * k.cx, 1.4 * k.cy);
    camera
}

/// Everything that the GPU renders.
fn shot<'a>(splats: &'a Splats<'a, f32>, camera: &'a Camera) -> Shot<'a> {
    Shot { depth: true, ..Shot::new(splats, camera, BACKGROUND) }
}

fn on_cpu(shot: &Shot<'_>, config: &RenderConfig) -> (Renderer<f32>, Image<f32>) {
    let (mut renderer, mut image) = (Renderer::new(*config), Image::default());
    renderer.render(shot, &mut image);
    (renderer, image)
}

/// Items in a block of a sum or of a sort.
fn block() -> usize {
    Tuning::default().block()
}

const BACKGROUND: [f32; 3] = [0.2, 0.5, 0.9];
