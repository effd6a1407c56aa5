//! Every backend against the oracle through the trait, refusals, and the way from a device that fails to the CPU.

use super::probe::Work;
use super::*;
use crate::ErrorKind;
use crate::math::{Real, Rng, Se3, sym3};
use crate::render::backend::refusal;
use crate::render::{ImageGrads, Oracle, RenderGrads};
use crate::scene::head::{HIDDEN, INPUTS};
use crate::scene::splats::SPLAT_COLUMNS;
use crate::scene::{Camera, Color, HeadWeights, Part, Planes, Rows, Splats};

fn view() -> Camera {
    Camera::with_fov_y(Se3::look_at([0.0, 0.0, -1.0], [0.0; 3], [0.0, -1.0, 0.0]), 1.0, 3, 2)
}

const BACKGROUND: [f32; 3] = [0.25, 0.5, 0.75];

#[test]
fn the_cpu_is_always_available() {
    for device in [Device::Cpu, Device::Auto, Device::Gpu] {
        let mut opened = open(device, RenderConfig::default(), &Abilities::default(), Tables::Constant);
        let (splats, camera, mut image) = (Splats::default(), view(), Image::default());
        assert!(draw(&mut opened.backend, &Shot::new(&splats, &camera, BACKGROUND), &mut image).is_none());
        assert_eq!(image.color.data[..7], [0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.5]);
        assert!(opened.why.starts_with("rendering on "), "{}", opened.why);
        assert_eq!(opened.fell_back, device != Device::Cpu && opened.backend.name() == "the CPU");
    }
}

#[test]
fn work_unsupported_by_the_device_runs_on_the_cpu() {
    for wanted in [Abilities { head: true, ..Abilities::default() }, Abilities { extra: true, ..Abilities::default() }]
    {
        let opened = open(Device::Gpu, RenderConfig::default(), &wanted, Tables::Changing);
        assert!(opened.fell_back && opened.backend.can(&wanted).is_ok(), "{}", opened.why);
    }
}

/// A device whose driver fails at its second image, or at the backward pass from it.
struct Failing {
    renderer: Renderer<f32>,
    drawn: usize,
    going_back: bool,
}

impl Backend for Failing {
    fn can(&self, wanted: &Abilities) -> Result<()> {
        if wanted.extra { Err(refusal("it", "blend further channels")) } else { Ok(()) }
    }
    fn render(&mut self, shot: &Shot<'_>, out: &mut Image) -> Result<()> {
        self.drawn += 1;
        if self.drawn > 1 && !self.going_back {
            return Err(Error::new(ErrorKind::Unsupported, "the driver is gone"));
        }
        Backend::render(&mut self.renderer, shot, out)
    }
    fn vjp(
        &mut self,
        shot: &Shot<'_>,
        grads: &ImageGrads<'_>,
        d_sh: &mut [Option<&mut Table>],
        d: &mut RenderGrads,
    ) -> Result<()> {
        if self.drawn > 1 {
            return Err(Error::new(ErrorKind::Unsupported, "the driver is gone"));
        }
        Backend::vjp(&mut self.renderer, shot, grads, d_sh, d)
    }
    fn radii(&self) -> &[f32] {
        Backend::radii(&self.renderer)
    }
    fn config(&self) -> &RenderConfig {
        &self.renderer.config
    }
    fn name(&self) -> &str {
        "failing"
    }
}

#[test]
fn a_device_that_fails_is_replaced_by_the_cpu() {
    let config = RenderConfig { low_pass: 0.5, ..RenderConfig::default() };
    let mut backend: Box<dyn Backend> =
        Box::new(Failing { renderer: Renderer::new(config), drawn: 0, going_back: false });
    let (splats, camera, mut image) = (Splats::default(), view(), Image::default());
    let shot = Shot::new(&splats, &camera, BACKGROUND);
    assert!(draw(&mut backend, &shot, &mut image).is_none() && backend.name() == "failing");
    image.color.data.fill(9.0);
    let error = draw(&mut backend, &shot, &mut image).expect("the driver is gone");
    assert!(error.to_string().contains("gone") && backend.name() == "the CPU");
    assert!(image.color.plane(0).iter().all(|v| *v == BACKGROUND[0]), "the CPU has drawn instead");
    assert_eq!(backend.config().low_pass, 0.5, "with the same limits");
    assert!(draw(&mut backend, &shot, &mut image).is_none(), "and goes on");
}

#[test]
fn training_continues_on_the_cpu_with_equal_gradients() {
    let made = scene(3, 2).cast::<f32>();
    let camera = Camera::with_fov_y(Se3::look_at([0.0, 0.5, -4.0], [0.0; 3], [0.0, -1.0, 0.0]), 0.8, 40, 30);
    let direct = |out| Part::new(out, Color::Direct { table: &made.direct });
    let splats = Splats { parts: made.outs.iter().map(direct).collect(), head: None };
    let mut color = Planes::new(3, 30, 40);
    color.data.iter_mut().enumerate().for_each(|(i, v)| *v = ((i * 31) % 17) as f32 - 8.0);
    let (plain, extra) = (
        Shot::new(&splats, &camera, BACKGROUND),
        Shot { extra: made.extra.as_ref(), ..Shot::new(&splats, &camera, BACKGROUND) },
    );
    let returned = |backend: &mut dyn Backend, shot: &Shot<'_>| {
        let (mut image, mut d) = (Image::default(), RenderGrads::default());
        backend.render(shot, &mut image).expect("somebody draws it");
        let grads = ImageGrads { color: &color, alpha: None, depth: None, extra: None };
        backend.vjp(shot, &grads, &mut [None, None], &mut d).expect("and takes it back");
        (image, d.parts, backend.radii().to_vec())
    };
    let config = RenderConfig::default();
    let (with_extra, without) = (returned(cpu(config).as_mut(), &extra), returned(cpu(config).as_mut(), &plain));
    for going_back in [false, true] {
        let mut backend = WithCpu::new(Box::new(Failing { renderer: Renderer::new(config), drawn: 0, going_back }));
        // Refused work is reported once, and does not end it.
        for _ in 0..2 {
            assert!(returned(&mut backend, &extra) == with_extra);
        }
        assert!(backend.notice().is_some_and(|n| n.contains("blend further channels")) && backend.notice().is_none());
        assert!(returned(&mut backend, &plain) == without && backend.name() == "failing" && backend.notice().is_none());
        // Its failure is reported too, and nothing of the step is lost.
        assert!(returned(&mut backend, &plain) == without && backend.name() == CPU);
        let notice = backend.notice().expect("it is told");
        assert!(notice.contains("continues on the CPU") && notice.contains("the driver is gone"), "{notice}");
        assert!(returned(&mut backend, &plain) == without && backend.notice().is_none());
    }
}

/// The renderer of the CPU with a fault in the image or in the backward pass.
struct Crooked(Renderer<f32>, [f32; 2]);

impl Backend for Crooked {
    fn can(&self, _: &Abilities) -> Result<()> {
        Ok(())
    }
    fn render(&mut self, shot: &Shot<'_>, out: &mut Image) -> Result<()> {
        Backend::render(&mut self.0, shot, out)?;
        out.color.data[70] += self.1[0];
        Ok(())
    }
    fn vjp(
        &mut self,
        shot: &Shot<'_>,
        grads: &ImageGrads<'_>,
        d_sh: &mut [Option<&mut Table>],
        d: &mut RenderGrads,
    ) -> Result<()> {
        Backend::vjp(&mut self.0, shot, grads, d_sh, d)?;
        d.parts.iter_mut().for_each(|p| p.out.data_mut().iter_mut().for_each(|v| *v *= 1.0 + self.1[1]));
        Ok(())
    }
    fn radii(&self) -> &[f32] {
        Backend::radii(&self.0)
    }
    fn config(&self) -> &RenderConfig {
        &self.0.config
    }
    fn name(&self) -> &str {
        "crooked"
    }
}

#[test]
fn a_device_with_wrong_results_is_not_used() {
    for (faults, good) in [
        ([0.0, 0.0], true),
        ([0.005, 0.01], true),
        ([0.1, 0.0], false),
        ([0.0, 0.1], false),
        ([f32::NAN, 0.0], false),
        ([0.0, f32::NAN], false),
    ] {
        let said = Work::Step.trusted(&mut Crooked(Renderer::new(RenderConfig::default()), faults));
        assert_eq!(said.is_ok(), good, "{faults:?}: {said:?}");
        assert!(said.is_ok() || said.is_err_and(|e| e.to_string().contains("self-test")));
        // Gradients do not count where there is no backward pass.
        let rendered = Work::Image.trusted(&mut Crooked(Renderer::new(RenderConfig::default()), faults));
        assert_eq!(rendered.is_ok(), faults[0].abs() < 0.01, "{faults:?}: {rendered:?}");
    }
}

#[test]
fn auto_prefers_the_cpu_to_a_slower_device() {
    assert!(Work::Step.compared([0.004, 0.004]).is_ok());
    let slower = Work::Step.compared([0.0123, 0.0045]).expect_err("the CPU is faster").to_string();
    assert_eq!(slower, "it takes 12.3 ms for a test step, the CPU 4.5 ms");
    // A device that fails is not used either.
    let mut failing = Failing { renderer: Renderer::new(RenderConfig::default()), drawn: 0, going_back: false };
    let failed = Work::Image.slower(&mut failing).expect_err("its driver is gone").to_string();
    assert!(failed.contains("the driver is gone"), "{failed}");
}

#[test]
#[cfg(feature = "gpu")]
fn a_driver_that_fails_the_self_test_is_tried_without_subgroups_and_left_then() {
    let config = RenderConfig::default();
    let open = || Gpu::open(Adapters::Any);
    let whole = match open() {
        Ok(gpu) => gpu.describe(),
        Err(e) => {
            assert!(std::env::var_os("REQUIRE_GPU").is_none(), "REQUIRE_GPU is set: {e}");
            return println!("skipped: {e}");
        }
    };
    let portable = open().unwrap().tuned(Tuning { subgroups: false, ..Tuning::default() }).describe();
    // Where a device has none, both attempts are the same.
    assert_eq!(whole.contains("subgroups"), whole != portable);
    let wrong = || Error::new(ErrorKind::Unsupported, "it fails a self-test");
    // Attempts that fail, by how many do; then the truth about what is left.
    let tried = |bad: usize| {
        let mut attempts = 0;
        let mut test = |backend: &mut dyn Backend| {
            attempts += 1;
            if attempts > bad { Work::Step.trusted(backend) } else { Err(wrong().at(attempts)) }
        };
        let came = tested(&open, config, Work::Step, &mut test);
        let boxed = came.map(|(gpu, name)| (Box::new(gpu) as Box<dyn Backend>, name));
        (attempts, or_cpu(config, boxed))
    };
    for (bad, expected) in [(0, &whole), (1, &portable)] {
        let (attempts, opened) = tried(bad);
        assert!(attempts == bad + 1 && !opened.fell_back && opened.name == *expected, "{bad}: {}", opened.why);
    }
    let (attempts, opened) = tried(2);
    assert!(attempts == 2 && opened.fell_back && opened.name == CPU && opened.backend.name() == CPU);
    let first = format!("rendering on the CPU: {whole}: 1: it fails a self-test");
    assert_eq!(opened.why, first, "what failed first is told");
}

/// Largest difference of a value from the oracle's, of the largest depth for depth: a splat at the α cut-off may be
/// rendered by one backend only, which is 1/255 of what is left of the light there.
const PIXEL: f64 = 5e-3;
/// Largest root of the mean square of the differences: f32 against f64, and a few such splats.
const RMS: f64 = 2e-4;

/// Everything that a shot can hold, in f64 for the oracle and in f32 for the others.
struct Scene<F> {
    outs: [Table<F>; 2],
    sh: Table<F>,
    direct: Table<F>,
    /// Of parts of nine channels, what a head makes of them.
    head: Option<[Vec<F>; 2]>,
    extra: Option<Table<F>>,
}

/// A rotation.
const AXES: [[f64; 3]; 3] = [[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]];
/// Splats in each part.
const EACH: usize = 300;

/// Parts coloured by spherical harmonics and directly; `channels` of the latter, 3 or the 9 that a head sees.
fn scene(channels: usize, extra: usize) -> Scene<f64> {
    let rng = Rng::new(3, "backends", channels as u64);
    let noise = |seed: u64, columns: &[(&'static str, usize)], rows: usize, mean: f64, deviation: f64| {
        let mut table = Table::new(columns, rows);
        for j in 0..rows {
            (0..table.width())
                .for_each(|c| table.set(j, c, mean + deviation * rng.fork(seed).fork(j as u64).normal(c as u64)));
        }
        table
    };
    let outs = std::array::from_fn(|part| {
        let mut out = Table::new(&SPLAT_COLUMNS, EACH);
        for j in 0..EACH {
            let r = rng.fork(100 + part as u64).fork(j as u64);
            out.write(j, 0, std::array::from_fn::<f64, 3, _>(|k| 2.4 * r.uniform(k as u64) - 1.2));
            let scales = std::array::from_fn(|k| -2.6 + 0.7 * r.normal(20 + k as u64));
            out.write(j, 3, sym3::from_quat_log_scales(std::array::from_fn(|k| r.normal(10 + k as u64)), scales));
            out.set(j, 9, 0.05 + 0.9 * r.uniform(4));
        }
        out
    });
    let weights = |seed: u64, n: usize| noise(seed, &[("w", 1)], n, 0.0, 0.5).column_to_rows(0, 1);
    Scene {
        outs,
        sh: noise(1, &[("sh", 48)], EACH, 0.1, 0.25),
        direct: noise(2, &[("channels", channels)], EACH, 0.5, 0.2),
        head: (channels == 9).then(|| [weights(3, HIDDEN * INPUTS), weights(4, 3 * HIDDEN)]),
        extra: (extra > 0).then(|| noise(5, &[("extra", extra)], 2 * EACH, 0.0, 1.0)),
    }
}

impl<F: Real> Scene<F> {
    fn cast<G: Real>(&self) -> Scene<G> {
        let numbers = |v: &Vec<F>| v.iter().map(|x| G::of(x.f64())).collect();
        Scene {
            outs: self.outs.each_ref().map(Table::cast),
            sh: self.sh.cast(),
            direct: self.direct.cast(),
            head: self.head.as_ref().map(|head| head.each_ref().map(numbers)),
            extra: self.extra.as_ref().map(Table::cast),
        }
    }

    /// The image of a backend, if it can render it.
    fn drawn(&self, backend: &mut dyn Backend<F>, camera: &Camera, sh_degree: usize, depth: bool) -> Option<Image<F>> {
        let sh = Color::Sh { table: &self.sh, rows: Rows::All, weights: None, base: true };
        // Harmonics in axes of their own, and in the world's.
        let layer_from_world = self.extra.is_none().then_some(AXES.map(|row| row.map(F::of)));
        let parts = vec![
            Part { layer_from_world, ..Part::new(&self.outs[0], sh) },
            Part::new(&self.outs[1], Color::Direct { table: &self.direct }),
        ];
        let head = self.head.as_ref().map(|[first, second]| HeadWeights { first, second });
        let splats = Splats { parts, head };
        let background = BACKGROUND.map(|v| F::of(f64::from(v)));
        let shot = Shot { extra: self.extra.as_ref(), sh_degree, depth, ..Shot::new(&splats, camera, background) };
        let mut image = Image::default();
        match (backend.can(&shot.abilities()), backend.render(&shot, &mut image)) {
            (Ok(()), Ok(())) => Some(image),
            (Err(refused), Err(_)) => {
                println!("{}: {refused}", backend.name());
                None
            }
            (can, rendered) => panic!("{}: {can:?} was said, {rendered:?} came", backend.name()),
        }
    }
}

/// Root of the mean square and largest of the differences.
fn differences<F: Real>(a: &Planes<F>, b: &Planes<f64>, unit: f64) -> [f64; 2] {
    assert_eq!([a.channels, a.height, a.width], [b.channels, b.height, b.width]);
    let all = a.data.iter().zip(&b.data).map(|(a, b)| (a.f64() - b).abs() / unit);
    let (sum, most) = all.fold((0.0, 0.0f64), |(sum, most), d| (sum + d * d, most.max(d)));
    [(sum / a.data.len().max(1) as f64).sqrt(), most]
}

#[test]
fn every_backend_renders_as_the_reference_does() {
    let mut backends = vec![cpu(RenderConfig::default())];
    #[cfg(feature = "gpu")]
    match gpu(Device::Gpu, RenderConfig::default(), &Abilities::default(), Tables::Changing) {
        Ok((gpu, name)) => {
            println!("{name}");
            backends.push(gpu);
        }
        Err(e) => {
            assert!(std::env::var_os("REQUIRE_GPU").is_none(), "REQUIRE_GPU is set: {e}");
            println!("skipped: {e}");
        }
    }
    let pose = |eye| Se3::look_at(eye, [0.1, -0.1, 0.0], [0.0, -1.0, 0.0]);
    let cameras = [
        Camera::with_fov_y(pose([0.0, 0.5, -4.0]), 0.8, 83, 61),
        Camera::with_fov_y(pose([2.0, 1.0, 1.5]), 0.9, 40, 70),
    ];
    let mut refused = Vec::new();
    for (what, scene, sh_degree, depth) in [
        ("colours", scene(3, 0), 3, false),
        ("colours and depth", scene(3, 0), 1, true),
        ("further channels", scene(3, 4), 2, true),
        ("a head", scene(9, 0), 3, false),
    ] {
        let single = scene.cast::<f32>();
        for camera in &cameras {
            let truth =
                scene.drawn(&mut Oracle::default(), camera, sh_degree, depth).expect("the oracle draws everything");
            let far = truth.depth.data.iter().copied().fold(1.0, f64::max);
            for backend in &mut backends {
                let Some(image) = single.drawn(backend.as_mut(), camera, sh_degree, depth) else {
                    refused.push((what, backend.name() == "the CPU"));
                    continue;
                };
                let pairs = [
                    (&image.color, &truth.color, 1.0),
                    (&image.alpha, &truth.alpha, 1.0),
                    (&image.depth, &truth.depth, far),
                    (&image.extra, &truth.extra, 1.0),
                ];
                for (a, b, unit) in pairs {
                    let [rms, most] = differences(a, b, unit);
                    assert!(rms < RMS && most < PIXEL, "{what} by {}: {rms:.1e}, at most {most:.1e}", backend.name());
                }
            }
        }
    }
    let only = |r: &(&str, bool)| !r.1 && ["further channels", "a head"].contains(&r.0);
    assert!(refused.iter().all(only), "the CPU renders everything, a GPU all but {refused:?}");
}

#[test]
fn the_reference_renderer_refuses_a_backward_pass() {
    let (mut oracle, wanted) = (Oracle::default(), Abilities { backward: true, ..Abilities::default() });
    let error = oracle.can(&wanted).expect_err("it is a forward alone").to_string();
    assert!(error.contains("the oracle does not take gradients back"), "{error}");
    let (splats, camera, color) = (Splats::default(), view(), Planes::new(3, 2, 3));
    let grads = ImageGrads { color: &color, alpha: None, depth: None, extra: None };
    let shot = Shot::new(&splats, &camera, [0.0; 3]);
    assert!(oracle.vjp(&shot, &grads, &mut [], &mut RenderGrads::default()).is_err());
    assert!(cpu(RenderConfig::default()).can(&wanted).is_ok());
}
