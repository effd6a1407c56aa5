//! The renderer's stages, one by one and together, on 30,000 synthetic Gaussians with spherical harmonics of degree 3
//! at 400x400, on one and two threads: `cargo bench -p splat4d-core`. `studies bench` measures real scenes against the
//! roofline.

use divan::{Bencher, black_box};
use splat4d::math::{Rng, Se3, sh, sym3};
use splat4d::render::bin::Footprint;
use splat4d::render::project::Projection;
use splat4d::render::rasterize::{CHANNELS, Geometry, Pass, PassGrads, PixelGrads, Raster};
use splat4d::render::{Image, ImageGrads, Projected, ProjectedGrads, RenderConfig, RenderGrads, Renderer, Shot, View};
use splat4d::render::{project, roofline, shade};
use splat4d::scene::splats::{Part, SPLAT_COLUMNS};
use splat4d::scene::{Camera, Color, Planes, Rows, Splats, Table};

const GAUSSIANS: usize = 30_000;
const SIZE: usize = 400;
const THREADS: [usize; 2] = [1, 2];
/// Timed calls of each.
const SAMPLES: u32 = 30;

fn main() {
    divan::main();
}

fn pool(threads: usize) -> rayon::ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be started")
}

/// A cloud of Gaussians 8 to 12 pixels across at the α cut-off, and a camera before it.
struct Made {
    out: Table<f32>,
    sh: Table<f32>,
    camera: Camera,
    /// A gradient to the image.
    grad: Planes<f32>,
}

impl Made {
    fn new() -> Self {
        let rng = Rng::new(1, "bench", 0);
        let mut out = Table::<f32>::new(&SPLAT_COLUMNS, GAUSSIANS);
        let mut sh = Table::<f32>::new(&[("sh", 48)], GAUSSIANS);
        for j in 0..GAUSSIANS {
            let r = rng.fork(j as u64);
            let mean: [f32; 3] = std::array::from_fn(|k| (2.4 * r.uniform(k as u64) - 1.2) as f32);
            let q: [f32; 4] = std::array::from_fn(|k| r.normal(10 + k as u64) as f32);
            // With f = 1.2·width and z = 4 a scale of .012 is σ = 1.4 px.
            let s: [f32; 3] = std::array::from_fn(|k| (0.012f64.ln() + 0.4 * r.normal(20 + k as u64)) as f32);
            out.write(j, 0, mean);
            out.write(j, 3, sym3::from_quat_log_scales(q, s));
            out.set(j, 9, (0.05 + 0.9 * r.uniform(4)) as f32);
            for c in 0..48 {
                sh.set(j, c, (0.2 * r.normal(30 + c as u64)) as f32);
            }
        }
        let pose = Se3::look_at([0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0]);
        let camera = Camera::with_fov_y(pose, 2.0 * (0.5f64 / 1.2).atan(), SIZE, SIZE);
        let mut grad = Planes::new(3, SIZE, SIZE);
        for (i, v) in grad.data.iter_mut().enumerate() {
            *v = rng.normal(i as u64) as f32;
        }
        Self { out, sh, camera, grad }
    }

    fn splats(&self) -> Splats<'_> {
        let color = Color::Sh { table: &self.sh, rows: Rows::All, weights: None, base: true };
        Splats { parts: vec![Part::new(&self.out, color)], head: None }
    }
}

/// Data between the stages.
struct Stages {
    config: RenderConfig,
    projected: Vec<Projected>,
    footprints: Vec<Footprint>,
    radii: Vec<f32>,
    channels: Vec<[f32; CHANNELS]>,
    raster: Raster,
}

impl Stages {
    /// Everything up to and with the blend.
    fn run(made: &Made) -> Self {
        let config = RenderConfig::default();
        let mut stages = Self {
            config,
            projected: vec![Projected::default(); GAUSSIANS],
            footprints: vec![Footprint::default(); GAUSSIANS],
            radii: vec![0.0; GAUSSIANS],
            channels: vec![[0.0; CHANNELS]; GAUSSIANS],
            raster: Raster::default(),
        };
        stages.project(made);
        stages.shade(made);
        stages.bin();
        stages.blend();
        stages
    }

    fn project(&mut self, made: &Made) {
        let view = View::new(&made.camera, &self.config);
        let (rows, feet, radii) = (&mut self.projected, &mut self.footprints, &mut self.radii);
        project::forward(&made.splats(), &view, self.config.simd, rows, feet, radii);
    }

    fn shade(&mut self, made: &Made) {
        let view = View::new(&made.camera, &self.config);
        let (degree, simd) = (sh::MAX_DEGREE, self.config.simd);
        let splats = made.splats();
        let projection = Projection { splats: &splats, view: &view, simd, projected: &self.projected };
        shade::forward(&projection, degree, &mut self.channels);
    }

    fn bin(&mut self) {
        self.raster.prepare(&self.projected, &self.footprints, SIZE, SIZE, self.config.simd);
    }

    fn blend(&mut self) {
        let Self { config, projected, footprints, channels, raster, .. } = self;
        raster.blend(&Pass { projected, footprints, channels, background: [0.0; CHANNELS], config });
    }
}

/// Times `stage` on `threads` threads, after everything before it was done.
fn stage(bencher: Bencher<'_, '_>, threads: usize, stage: impl Fn(&mut Stages, &Made) + Sync) {
    let (made, pool) = (Made::new(), pool(threads));
    let mut stages = Stages::run(&made);
    bencher.bench_local(|| pool.install(|| stage(&mut stages, &made)));
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn a_project(bencher: Bencher<'_, '_>, threads: usize) {
    stage(bencher, threads, |stages, made| stages.project(made));
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn b_shade(bencher: Bencher<'_, '_>, threads: usize) {
    stage(bencher, threads, |stages, made| stages.shade(made));
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn c_bin(bencher: Bencher<'_, '_>, threads: usize) {
    stage(bencher, threads, |stages, _| stages.bin());
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn d_blend(bencher: Bencher<'_, '_>, threads: usize) {
    stage(bencher, threads, |stages, _| stages.blend());
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn e_blend_backward(bencher: Bencher<'_, '_>, threads: usize) {
    let (made, pool) = (Made::new(), pool(threads));
    let mut stages = Stages::run(&made);
    let mut d = vec![ProjectedGrads::default(); GAUSSIANS];
    let mut d_channels = vec![[0.0; CHANNELS]; GAUSSIANS];
    let channels = [Some(made.grad.plane(0)), Some(made.grad.plane(1)), Some(made.grad.plane(2))];
    let pixels = PixelGrads { channels, alpha: None };
    bencher.bench_local(|| {
        pool.install(|| {
            let Stages { config, projected, footprints, channels, raster, .. } = &mut stages;
            let pass = Pass { projected, footprints, channels, background: [0.0; CHANNELS], config };
            let geometry = Geometry::Overwrite;
            raster.backward(&pass, &pixels, &mut PassGrads { geometry, projected: &mut d, channels: &mut d_channels })
        })
    });
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn f_forward(bencher: Bencher<'_, '_>, threads: usize) {
    let (made, pool) = (Made::new(), pool(threads));
    let (mut renderer, mut image) = (Renderer::new(RenderConfig::default()), Image::default());
    let splats = made.splats();
    bencher.bench_local(|| pool.install(|| renderer.render(&Shot::new(&splats, &made.camera, [0.0; 3]), &mut image)));
}

#[divan::bench(args = THREADS, sample_count = SAMPLES)]
fn g_forward_and_backward(bencher: Bencher<'_, '_>, threads: usize) {
    let (made, pool) = (Made::new(), pool(threads));
    let (mut renderer, mut image) = (Renderer::new(RenderConfig::default()), Image::default());
    let (mut d, mut d_sh) = (RenderGrads::default(), made.sh.zeros_like());
    let splats = made.splats();
    let grads = ImageGrads { color: &made.grad, alpha: None, depth: None, extra: None };
    bencher.bench_local(|| {
        pool.install(|| {
            renderer.render(&Shot::new(&splats, &made.camera, [0.0; 3]), &mut image);
            renderer.backward(&Shot::new(&splats, &made.camera, [0.0; 3]), &grads, &mut [Some(&mut d_sh)], &mut d);
        })
    });
}

/// The yardstick itself: one measurement takes some 100 ms.
#[divan::bench(sample_count = 3, sample_size = 1)]
fn z_roofline() -> f64 {
    black_box(roofline::blend(RenderConfig::default().simd))
}
