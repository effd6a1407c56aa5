//! A motion model of your own: Gaussians that sway, μ(t) = μ + a·sin(2πt/T), with a learnable amplitude a each.
//!
//! `cargo run --release -p splat4d-core --example own_motion [FOLDER]` checks its gradient, renders it at several times and, if a
//! folder is given, writes the images there. Layers, the renderer, densification and training only call the trait, without
//! knowing the model (`tests/own_motion.rs` of `splat4d-train` trains it, bakes it and plays the file).

use splat4d::layers::{Evaluation, Layer, Scene};
use splat4d::math::sh::rgb_to_dc;
use splat4d::math::{Real, Rng, Se3};
use splat4d::motion::still::{activate, activate_backward};
use splat4d::motion::{At, Cache, Motion, Spec, Tape, fill_rows, for_rows};
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::splats::SPLAT_COLUMNS;
use splat4d::scene::{Camera, GEOMETRY, Grads, Key, LifeKind, Params, SH, Space, SplatGrads, Table, Time};
use std::f64::consts::TAU;
use std::sync::Arc;

/// Immutable, like every model: plain data and the keys of its tables. Learned values are in the layer's parameters.
pub(crate) struct Sway {
    /// Seconds of one swing.
    period: f64,
    /// [N, 3], scene units.
    amplitudes: Key,
}

impl Sway {
    /// Makes or claims the model's table in `p`.
    pub(crate) fn new<F: Real>(period: f64, p: &mut Params<F>) -> splat4d::Result<Self> {
        // One constructor for a fresh scene and for a loaded one: `entry` claims the array of this name, if there is one.
        let rows = p.len();
        let amplitudes = p.entry("amplitudes", Space::Gaussians, &[("amplitudes", 3)], rows, |_| {})?;
        Ok(Self { period, amplitudes })
    }

    fn swing(&self, t: Time) -> f64 {
        (TAU * t.0 / self.period).sin()
    }
}

impl<F: Real> Motion<F> for Sway {
    fn spec(&self) -> Spec {
        Spec::Custom("sway".into())
    }

    fn scratch_bytes(&self, _p: &Params<F>, _rows: usize) -> u64 {
        0
    }

    /// Row `id` of the parameters becomes a splat: mean 3, covariance 6, opacity 1.
    fn at(&self, q: &At<'_, F>, _cache: &Cache, tape: &mut Tape<F>) {
        tape.start(q.len());
        let (geometry, amplitudes) = (&q.p[GEOMETRY], &q.p[self.amplitudes]);
        let s = F::of(self.swing(q.t));
        fill_rows(&mut tape.out, q.rows, |id| {
            let mut row = geometry.read::<11>(id, 0);
            let a = amplitudes.read::<3>(id, 0);
            for axis in 0..3 {
                row[axis] += a[axis] * s;
            }
            activate(row)
        });
    }

    /// Backward pass: adds to the gradients of both tables and returns dL/dt.
    fn backward(
        &self,
        q: &At<'_, F>,
        _cache: &Cache,
        _tape: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        _d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        let (geometry, amplitudes) = (&q.p[GEOMETRY], &q.p[self.amplitudes]);
        let s = F::of(self.swing(q.t));
        let speed = F::of(TAU / self.period * (TAU * q.t.0 / self.period).cos());
        for_rows(d.of([GEOMETRY, self.amplitudes]), q.rows, |j, id, [d_geometry, d_amplitudes]| {
            // Activation does not depend on the mean, so the unmoved row serves.
            let d_row = activate_backward(geometry.read::<11>(id, 0), d_out.out.read::<10>(j, 0));
            d_geometry.add(id, 0, d_row);
            d_amplitudes.add(id, 0, [d_row[0] * s, d_row[1] * s, d_row[2] * s]);
            let a = amplitudes.read::<3>(id, 0);
            ((a[0] * d_row[0] + a[1] * d_row[1] + a[2] * d_row[2]) * speed).f64()
        })
    }
}

/// A field of grass-like blobs; those further up sway more.
pub(crate) fn scene() -> splat4d::Result<Scene<f32>> {
    const ROWS: usize = 400;
    let mut params = Params::<f32>::new(ROWS, 1, LifeKind::Infinite.columns());
    let motion = Sway::new(2.0, &mut params)?;
    for i in 0..ROWS {
        let r = Rng::new(1, "grass", 0).fork(i as u64);
        let [x, y, z] = [0, 1, 2].map(|k| r.uniform(k) as f32);
        params[GEOMETRY].write(i, 0, [2.0 * x - 1.0, y, 2.0 * z - 1.0]);
        params[GEOMETRY].write(i, QUAT, [1.0, 0.0, 0.0, 0.0]);
        params[GEOMETRY].write(i, LOG_SCALE, [-3.5, -2.3, -3.5]);
        params[GEOMETRY].set(i, OPACITY, 2.0);
        params[SH].write(i, 0, [0.2 + 0.3 * y, 0.4 + 0.5 * y, 0.1].map(rgb_to_dc));
        params[motion.amplitudes].write(i, 0, [0.4 * y * y, 0.0, 0.0]);
    }
    let layer = Layer::new("grass", params, Arc::new(motion), LifeKind::Infinite);
    Ok(Scene { layers: vec![layer], clip: [0.0, 2.0], fps: 30.0, up: [0.0, 1.0, 0.0], ..Scene::default() })
}

/// dL/dt and one dL/d amplitude of L = Σ out against central differences, in f64: the trait is generic for this.
fn check_gradient() -> splat4d::Result<()> {
    let mut p = Params::<f64>::new(1, 1, &[]);
    let model = Sway::new(1.7, &mut p)?;
    p[GEOMETRY].write(0, QUAT, [0.9, 0.1, -0.3, 0.2]);
    p[model.amplitudes].write(0, 0, [0.3, -0.2, 0.1]);
    let query = |p: &Params<f64>, t: f64| {
        let mut tape = Tape::default();
        let rows = splat4d::scene::Rows::All;
        model.at(&At { p, of: Space::Gaussians, rows, t: Time(t) }, &Cache::default(), &mut tape);
        tape.out.read::<10>(0, 0).iter().sum::<f64>()
    };
    let (t, h) = (0.4, 1e-6);
    let mut ones = Table::<f64>::new(&SPLAT_COLUMNS, 1);
    ones.fill(1.0);
    let mut grads = Grads::new(&p);
    let q = At { p: &p, of: Space::Gaussians, rows: splat4d::scene::Rows::All, t: Time(t) };
    let d_out = SplatGrads { out: &ones, color: None, weights: None };
    let (mut cache, mut tape) = (Cache::default(), Tape::default());
    let d_time = model.backward(&q, &Cache::default(), &mut tape, &d_out, &mut cache, &mut grads);
    let by_time = (query(&p, t + h) - query(&p, t - h)) / (2.0 * h);
    let mut moved = p.clone();
    *moved[model.amplitudes].get_mut(0, 0) += h;
    let by_amplitude = (query(&moved, t) - query(&p, t)) / h;
    let d_amplitude = grads.table(model.amplitudes).get(0, 0);
    println!(
        "dL/dt {d_time:.6}, by differences {by_time:.6}; dL/da {d_amplitude:.6}, by differences {by_amplitude:.6}"
    );
    assert!((d_time - by_time).abs() < 1e-6 && (d_amplitude - by_amplitude).abs() < 1e-6, "the gradient is wrong");
    Ok(())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    check_gradient()?;
    let scene = scene()?;
    let pose = Se3::look_at([0.0, 1.0, -4.5], [0.0, 0.5, 0.0], scene.up);
    let camera = Camera::with_fov_y(pose, 0.7, 160, 120);
    let (mut renderer, mut instant, mut image) =
        (Renderer::new(RenderConfig::default()), Evaluation::default(), Image::default());
    for k in 0..4 {
        let t = 0.25 * f64::from(k);
        scene.at(Time(t), &mut instant);
        renderer.render(&Shot::new(&scene.splats(&instant), &camera, [1.0; 3]), &mut image);
        println!("t = {t:.2} s: {} splats drawn", renderer.stats().visible);
        if let Some(folder) = std::env::args().nth(1) {
            std::fs::create_dir_all(&folder)?;
            let bytes: Vec<u8> = image.color.interleaved().iter().map(|c| (c.clamp(0.0, 1.0) * 255.0) as u8).collect();
            let head = format!("P6\n{} {}\n255\n", camera.width, camera.height);
            std::fs::write(format!("{folder}/sway{k}.ppm"), [head.as_bytes(), &bytes].concat())?;
        }
    }
    Ok(())
}
