//! The fast renderer against the oracle and against finite differences, in f64 and f32.

mod head;

use super::*;
use crate::math::{Rng, Se3, sym3};
use crate::scene::splats::{Part, SPLAT_COLUMNS};
use crate::scene::{Camera, Color, Intrinsics, Lens, Rows, Splats};

/// f32 against the f64 oracle, where no pixel is at a threshold.
const F32_TOLERANCE: f64 = 2e-5;
/// f64 fast path against the oracle.
const F64_TOLERANCE: f64 = 1e-9;
/// Analytic against central differences in f64, relative.
const FD_TOLERANCE: f64 = 2e-5;
/// Share of pixels that may sit within rounding of the 1/255 skip or the early stop in f32.
const THRESHOLD_SHARE: f64 = 2e-3;

/// A rotation: the axes of the foreign SH.
const AXES: [[f64; 3]; 3] = [[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]];

/// Three layers: the layer's own SH through a row list, foreign SH of two weighted blocks in axes of their own, and
/// direct colours.
#[derive(Clone)]
struct Scene<F> {
    outs: [Table<F>; 3],
    own: Table<F>,
    ids: Vec<u32>,
    foreign: Table<F>,
    weights: Table<F>,
    direct: Table<F>,
    extra: Table<F>,
}

impl<F: Real> Scene<F> {
    fn splats(&self) -> Splats<'_, F> {
        let own = Color::Sh { table: &self.own, rows: Rows::Some(&self.ids), weights: None, base: true };
        let foreign = Color::Sh { table: &self.foreign, rows: Rows::All, weights: Some(&self.weights), base: false };
        let colors = [own, foreign, Color::Direct { table: &self.direct }];
        let mut parts: Vec<_> = self.outs.iter().zip(colors).map(|(out, color)| Part::new(out, color)).collect();
        parts[1].layer_from_world = Some(AXES.map(|row| row.map(F::of)));
        Splats { parts, head: None }
    }

    fn cast<G: Real>(&self) -> Scene<G> {
        Scene {
            outs: std::array::from_fn(|k| self.outs[k].cast()),
            own: self.own.cast(),
            ids: self.ids.clone(),
            foreign: self.foreign.cast(),
            weights: self.weights.cast(),
            direct: self.direct.cast(),
            extra: self.extra.cast(),
        }
    }
}

/// Splats of about `pixels` px in front of a camera at 4 units, [n, 10].
fn cloud(rng: Rng, n: usize, size: f64) -> Table<f64> {
    let mut out = Table::new(&SPLAT_COLUMNS, n);
    for j in 0..n {
        let r = rng.fork(j as u64);
        let u = |k: u64| 2.0 * r.uniform(k) - 1.0;
        let q: [f64; 4] = std::array::from_fn(|k| r.normal(10 + k as u64));
        let s: [f64; 3] = std::array::from_fn(|k| size.ln() + 0.5 * r.normal(20 + k as u64));
        out.write(j, 0, [1.4 * u(0), 1.4 * u(1), 1.4 * u(2)]);
        out.write(j, 3, sym3::from_quat_log_scales(q, s));
        out.set(j, 9, 0.1 + 0.85 * r.uniform(4));
    }
    out
}

fn noise(rng: Rng, columns: &[(&'static str, usize)], n: usize, mean: f64, sigma: f64) -> Table<f64> {
    let mut out = Table::new(columns, n);
    for j in 0..n {
        for c in 0..out.width() {
            out.set(j, c, mean + sigma * rng.fork(j as u64).normal(c as u64));
        }
    }
    out
}

fn scene(seed: u64, n: usize, size: f64) -> Scene<f64> {
    let rng = Rng::new(seed, "render test", 0);
    let ids: Vec<u32> = (0..n as u32).map(|i| 2 * i + i % 3 / 2).collect();
    Scene {
        outs: std::array::from_fn(|k| cloud(rng.fork(k as u64), n + 3 * k, size)),
        own: noise(rng.fork(10), &[("sh", 48)], 2 * n + 5, 0.1, 0.25),
        ids,
        foreign: noise(rng.fork(11), &[("sh", 24)], n + 3, 0.2, 0.2),
        weights: noise(rng.fork(12), &[("w", 2)], n + 3, 0.7, 0.2),
        direct: noise(rng.fork(13), &[("rgb", 3)], n + 6, 0.5, 0.3),
        extra: noise(rng.fork(14), &[("f", 5)], 3 * n + 9, 0.0, 1.0),
    }
}

fn camera(width: usize, height: usize) -> Camera {
    let pose = Se3::look_at([0.8, -0.5, -4.0], [0.0; 3], [0.1, -1.0, 0.0]);
    let f = 0.9 * width.max(height) as f64;
    let intrinsics = Intrinsics { fx: f, fy: 1.1 * f, cx: 0.47 * width as f64, cy: 0.52 * height as f64 };
    Camera { cam_from_world: pose, intrinsics, lens: Lens::Pinhole, width, height, near: Camera::NEAR }
}

/// Differentiates all that there is.
fn complete() -> RenderConfig {
    RenderConfig { abs_grads: true, ..RenderConfig::default() }
}

/// No pixel can be at a threshold.
fn smooth() -> RenderConfig {
    RenderConfig { alpha_min: 1e-14, alpha_max: 1.0, transmittance_min: 0.0, ..complete() }
}

const BACKGROUND: [f64; 3] = [0.2, 0.5, 0.9];

/// Depth too.
fn shot<'a, F: Real>(
    splats: &'a Splats<'a, F>,
    camera: &'a Camera,
    background: [F; 3],
    extra: Option<&'a Table<F>>,
) -> Shot<'a, F> {
    Shot { extra, depth: true, ..Shot::new(splats, camera, background) }
}

fn draw<F: Real>(scene: &Scene<F>, camera: &Camera, config: RenderConfig) -> Image<F> {
    let mut out = Image::default();
    Renderer::new(config).render(&shot(&scene.splats(), camera, BACKGROUND.map(F::of), Some(&scene.extra)), &mut out);
    out
}

fn draw_oracle<F: Real>(scene: &Scene<F>, camera: &Camera, config: RenderConfig) -> Image<f64> {
    oracle::render(&shot(&scene.splats(), camera, BACKGROUND.map(F::of), Some(&scene.extra)), &config)
}

/// Largest difference, relative where values are above 1, and the share of values beyond `tolerance`.
fn difference<F: Real>(a: &Image<F>, b: &Image<f64>, tolerance: f64) -> (f64, f64) {
    let planes = [(&a.color, &b.color), (&a.alpha, &b.alpha), (&a.depth, &b.depth), (&a.extra, &b.extra)];
    let (mut worst, mut beyond, mut count) = (0.0f64, 0usize, 0usize);
    for (a, b) in planes {
        assert_eq!((a.channels, a.height, a.width), (b.channels, b.height, b.width));
        for (a, b) in a.data.iter().zip(&b.data) {
            let e = (a.f64() - b).abs() / b.abs().max(1.0);
            assert!(e.is_finite(), "a pixel is not finite: {a} {b}");
            worst = worst.max(e);
            beyond += usize::from(e > tolerance);
            count += 1;
        }
    }
    (worst, beyond as f64 / count.max(1) as f64)
}

#[test]
fn f64_equals_the_oracle_at_every_size() {
    for (i, &(w, h)) in [(1, 1), (17, 3), (33, 65), (64, 64), (100, 40)].iter().enumerate() {
        for antialias in [Antialias::Off, Antialias::On] {
            for (size, alpha_max) in [(0.02, 0.99), (0.15, 0.7), (0.8, 0.99)] {
                let s = scene(i as u64, 40, size);
                let config = RenderConfig { antialias, alpha_max, ..complete() };
                let (worst, _) =
                    difference(&draw(&s, &camera(w, h), config), &draw_oracle(&s, &camera(w, h), config), 0.0);
                assert!(worst < F64_TOLERANCE, "{w}x{h} {antialias:?} size {size}: {worst}");
            }
        }
    }
}

#[test]
fn f32_equals_the_oracle() {
    for simd in [Simd::Scalar, Simd::Avx2, Simd::Avx512] {
        for size in [0.02, 0.1, 0.5] {
            let s = scene(7, 60, size).cast::<f32>();
            let view = camera(90, 70);
            let config = RenderConfig { simd, ..smooth() };
            let (worst, _) = difference(&draw(&s, &view, config), &draw_oracle(&s, &view, config), 0.0);
            assert!(worst < F32_TOLERANCE, "{simd:?} {size}: {worst}");
            let config = RenderConfig { simd, ..complete() };
            let (worst, share) = difference(&draw(&s, &view, config), &draw_oracle(&s, &view, config), F32_TOLERANCE);
            assert!(share < THRESHOLD_SHARE && worst < 0.05, "{simd:?} {size}: {worst}, share {share}");
        }
    }
}

/// A random linear loss of the image, and its gradient planes.
struct Loss {
    color: Planes<f64>,
    alpha: Planes<f64>,
    depth: Planes<f64>,
    extra: Planes<f64>,
}

impl Loss {
    fn new(view: &Camera, extra: usize) -> Self {
        let plane = |purpose: &str, c: usize| {
            let rng = Rng::new(1, purpose, 0);
            let mut p = Planes::new(c, view.height, view.width);
            for (i, v) in p.data.iter_mut().enumerate() {
                *v = rng.normal(i as u64);
            }
            p
        };
        Self { color: plane("c", 3), alpha: plane("a", 1), depth: plane("d", 1), extra: plane("e", extra) }
    }

    fn of(&self, image: &Image<f64>) -> f64 {
        let dot = |a: &Planes<f64>, b: &Planes<f64>| a.data.iter().zip(&b.data).map(|(x, y)| x * y).sum::<f64>();
        dot(&self.color, &image.color)
            + dot(&self.alpha, &image.alpha)
            + dot(&self.depth, &image.depth)
            + dot(&self.extra, &image.extra)
    }

    fn grads(&self) -> ImageGrads<'_, f64> {
        ImageGrads { color: &self.color, alpha: Some(&self.alpha), depth: Some(&self.depth), extra: Some(&self.extra) }
    }
}

fn gradients(s: &Scene<f64>, view: &Camera, config: RenderConfig, loss: &Loss) -> (RenderGrads<f64>, Table<f64>) {
    let mut renderer = Renderer::new(config);
    let (splats, mut out, mut d) = (s.splats(), Image::default(), RenderGrads::default());
    let mut own = s.own.zeros_like();
    renderer.render(&shot(&splats, view, BACKGROUND, Some(&s.extra)), &mut out);
    let mut d_sh = [Some(&mut own), None, None];
    renderer.backward(&shot(&splats, view, BACKGROUND, Some(&s.extra)), &loss.grads(), &mut d_sh, &mut d);
    (d, own)
}

fn close(fd: f64, got: f64, what: &str) {
    assert!((fd - got).abs() < FD_TOLERANCE * (1.0 + fd.abs()), "{what}: differences {fd}, analytic {got}");
}

/// A small left motion of axis `k` (translation 0-2, rotation 3-5), to second order exact rotations.
fn nudge(k: usize, h: f64) -> Se3 {
    let mut m = Se3::IDENTITY;
    if k < 3 {
        m.translation[k] = h;
        return m;
    }
    let (a, b) = ((k - 3 + 1) % 3, (k - 3 + 2) % 3);
    m.rotation[a][a] = h.cos();
    m.rotation[b][b] = h.cos();
    m.rotation[a][b] = -h.sin();
    m.rotation[b][a] = h.sin();
    m
}

#[test]
fn every_gradient_equals_finite_differences() {
    // Wide splats next to the image put some x/z at J's clamp.
    for (antialias, size, n) in [(Antialias::Off, 0.15, 12), (Antialias::On, 0.04, 12), (Antialias::Off, 0.5, 5)] {
        let mut s = scene(21, n, size);
        s.outs[1].write(0, 0, [4.0, 0.3, -1.0]);
        s.outs[1].write(0, COV_FOR_TESTS, [1.0, 0.1, 0.0, 1.2, 0.2, 0.8]);
        let view = camera(40, 33);
        let config = RenderConfig { antialias, ..smooth() };
        let loss = Loss::new(&view, s.extra.width());
        let (d, own) = gradients(&s, &view, config, &loss);
        let value = |s: &Scene<f64>| loss.of(&draw(s, &view, config));
        let check = |pick: &dyn Fn(&mut Scene<f64>) -> &mut f64, got: f64, what: &str| {
            let mut moved = s.clone();
            let h = 1e-5 * pick(&mut moved).abs().max(0.1);
            *pick(&mut moved) += h;
            let up = value(&moved);
            *pick(&mut moved) -= 2.0 * h;
            close((up - value(&moved)) / (2.0 * h), got, what);
        };
        for p in 0..3 {
            for j in 0..4 {
                for c in 0..10 {
                    let got = d.parts[p].out.get(j, c);
                    check(&|s| s.outs[p].get_mut(j, c), got, &format!("{antialias:?} part {p} row {j} column {c}"));
                }
            }
        }
        for c in 0..48 {
            let id = s.ids[1] as usize;
            check(&|s| s.own.get_mut(id, c), own.get(id, c), &format!("own SH {c}"));
        }
        let foreign = d.parts[1].color.as_ref().unwrap();
        for c in 0..24 {
            check(&|s| s.foreign.get_mut(2, c), foreign.get(2, c), &format!("foreign SH {c}"));
        }
        for c in 0..2 {
            let got = d.parts[1].weights.as_ref().unwrap().get(3, c);
            check(&|s| s.weights.get_mut(3, c), got, &format!("weight {c}"));
        }
        for c in 0..3 {
            let got = d.parts[2].color.as_ref().unwrap().get(1, c);
            check(&|s| s.direct.get_mut(1, c), got, &format!("direct colour {c}"));
        }
        for c in 0..5 {
            let j = n + 1;
            check(&|s| s.extra.get_mut(j, c), d.extra.as_ref().unwrap().get(j, c), &format!("extra {c}"));
        }
        for c in 0..3 {
            let over = |h: f64| {
                let (mut b, mut out) = (BACKGROUND, Image::default());
                b[c] += h;
                Renderer::new(config).render(&shot(&s.splats(), &view, b, Some(&s.extra)), &mut out);
                loss.of(&out)
            };
            close((over(1e-5) - over(-1e-5)) / 2e-5, d.background[c], "background");
        }
        for k in 0..6 {
            let at = |h: f64| {
                let moved = Camera { cam_from_world: nudge(k, h).after(&view.cam_from_world), ..view.clone() };
                loss.of(&draw(&s, &moved, config))
            };
            close((at(1e-6) - at(-1e-6)) / 2e-6, d.camera[k], &format!("{antialias:?} pose {k}"));
        }
        let zoomed = |h: f64| {
            let mut camera = view.clone();
            (camera.intrinsics.fx, camera.intrinsics.fy) = (h.exp() * view.intrinsics.fx, h.exp() * view.intrinsics.fy);
            loss.of(&draw(&s, &camera, config))
        };
        close((zoomed(1e-6) - zoomed(-1e-6)) / 2e-6, d.focal, &format!("{antialias:?} focal length"));
    }
}

/// First covariance column.
const COV_FOR_TESTS: usize = crate::scene::splats::COV;

/// One direct-coloured splat, or several: mean, isotropic variance, opacity.
fn simple(rows: &[([f64; 3], f64, f64)]) -> (Table<f64>, Table<f64>) {
    let mut out = Table::new(&SPLAT_COLUMNS, rows.len());
    let mut rgb = Table::new(&[("rgb", 3)], rows.len());
    for (j, &(mean, v, o)) in rows.iter().enumerate() {
        out.write(j, 0, mean);
        out.write(j, 3, [v, 0.0, 0.0, v, 0.0, v]);
        out.set(j, 9, o);
        rgb.write(j, 0, [1.0, 0.5, 0.25]);
    }
    (out, rgb)
}

fn direct<'a>(out: &'a Table<f64>, rgb: &'a Table<f64>) -> Splats<'a, f64> {
    Splats { parts: vec![Part::new(out, Color::Direct { table: rgb })], head: None }
}

fn frontal(size: usize, f: f64) -> Camera {
    let c = 0.5 * size as f64;
    let intrinsics = Intrinsics { fx: f, fy: f, cx: c, cy: c };
    Camera {
        cam_from_world: Se3::IDENTITY,
        intrinsics,
        lens: Lens::Pinhole,
        width: size,
        height: size,
        near: Camera::NEAR,
    }
}

#[test]
fn one_gaussian_has_the_profile_and_energy_of_its_equation() {
    let (out, rgb) = simple(&[([0.0, 0.0, 2.0], 0.01, 0.6)]);
    let view = frontal(65, 100.0);
    let mut image = Image::default();
    Renderer::new(smooth()).render(&shot(&direct(&out, &rgb), &view, [0.0; 3], None), &mut image);
    let variance = 0.01 * (100.0f64 / 2.0).powi(2) + 0.3;
    let (mut sum, mut worst) = (0.0, 0.0f64);
    for y in 0..65 {
        for x in 0..65 {
            let r2 = (x as f64 - 32.0).powi(2) + (y as f64 - 32.0).powi(2);
            let truth = 0.6 * (-r2 / (2.0 * variance)).exp();
            worst = worst.max((image.alpha.get(0, y, x) - truth).abs());
            worst = worst.max((image.depth.get(0, y, x) - 2.0 * truth).abs());
            sum += image.alpha.get(0, y, x);
        }
    }
    assert!(worst < 1e-12, "profile: {worst}");
    let energy = 0.6 * 2.0 * std::f64::consts::PI * variance;
    assert!((sum / energy - 1.0).abs() < 1e-6, "energy {sum} {energy}");
}

#[test]
fn gaussians_nearer_than_the_near_plane_are_not_rendered() {
    let (out, rgb) = simple(&[([0.0, 0.0, 0.5], 1e-3, 0.6), ([0.0, 0.0, 2.0], 0.01, 0.6)]);
    let far = simple(&[([0.0, 0.0, 2.0], 0.01, 0.6)]);
    for (near, alone) in [(0.49, false), (0.5, true), (1.0, true)] {
        let view = Camera { near, ..frontal(33, 50.0) };
        let (mut both, mut one) = (Image::default(), Image::default());
        Renderer::new(smooth()).render(&shot(&direct(&out, &rgb), &view, [0.0; 3], None), &mut both);
        Renderer::new(smooth()).render(&shot(&direct(&far.0, &far.1), &view, [0.0; 3], None), &mut one);
        assert_eq!(both.alpha == one.alpha, alone, "near {near}");
        let truth = oracle::render(&shot(&direct(&out, &rgb), &view, [0.0; 3], None), &smooth());
        assert!(difference(&both, &truth, 1e-9).0 < 1e-9, "the oracle draws the same");
    }
}

#[test]
fn order_of_rows_does_not_matter_and_alpha_is_one_minus_transmittance() {
    let s = scene(3, 30, 0.2);
    let view = camera(50, 41);
    let n = s.outs[2].rows();
    let reverse: Vec<u32> = (0..n as u32).rev().collect();
    let (out, rgb) = (s.outs[2].gather(&reverse), s.direct.gather(&reverse));
    let (mut a, mut b, mut white) = (Image::default(), Image::default(), Image::default());
    let mut renderer = Renderer::new(complete());
    renderer.render(&shot(&direct(&s.outs[2], &s.direct), &view, [0.0; 3], None), &mut a);
    renderer.render(&shot(&direct(&out, &rgb), &view, [0.0; 3], None), &mut b);
    renderer.render(&shot(&direct(&out, &rgb), &view, [1.0; 3], None), &mut white);
    assert_eq!(a, b);
    for i in 0..a.alpha.data.len() {
        let t = white.color.data[i] - b.color.data[i];
        assert!((t + b.alpha.data[i] - 1.0).abs() < 1e-12, "A + T = {}", t + b.alpha.data[i]);
    }
}

#[test]
fn moving_scene_and_camera_together_keeps_the_render() {
    let s = scene(4, 30, 0.15);
    let view = camera(48, 48);
    let motion = Se3::look_at([1.0, 2.0, 3.0], [-2.0, 0.5, 0.0], [0.3, 0.9, 0.1]);
    let mut out = s.outs[2].clone();
    for j in 0..out.rows() {
        out.write(j, 0, motion.apply(out.read::<3>(j, 0)));
        let [xx, xy, xz, yy, yz, zz] = out.read::<6>(j, 3);
        let sigma = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
        let r = &motion.rotation;
        let m = crate::math::se3::mat_mul(&crate::math::se3::mat_mul(r, &sigma), &crate::math::se3::transpose(r));
        out.write(j, 3, [m[0][0], m[0][1], m[0][2], m[1][1], m[1][2], m[2][2]]);
    }
    let moved = Camera { cam_from_world: view.cam_from_world.after(&motion.inverse()), ..view.clone() };
    let (mut a, mut b) = (Image::default(), Image::default());
    let mut renderer = Renderer::new(smooth());
    renderer.render(&shot(&direct(&s.outs[2], &s.direct), &view, BACKGROUND, None), &mut a);
    renderer.render(&shot(&direct(&out, &s.direct), &moved, BACKGROUND, None), &mut b);
    let (worst, _) = difference(&a, &b, 0.0);
    assert!(worst < 1e-9, "{worst}");
}

#[test]
fn degenerate_splats_render_as_the_reference_does() {
    let tiny = 1e-20;
    let cases: Vec<Vec<([f64; 3], f64, f64)>> = vec![
        vec![],
        vec![([0.0, 0.0, 2.0], 0.0, 0.9)],
        vec![([0.0, 0.0, -2.0], 0.1, 0.9), ([0.0, 0.0, 0.0], 0.1, 0.9), ([0.0, 0.0, 0.005], 0.1, 0.9)],
        vec![([0.0, 0.0, 2.0], 1e9, 0.9), ([0.1, 0.0, 3.0], 1e8, 0.99)],
        vec![([0.0, 0.0, 2.0], 0.1, 0.0), ([0.0, 0.0, 2.0], 0.1, 0.001)],
        vec![([f64::NAN, 0.0, 2.0], 0.1, 0.5), ([0.0, 0.0, 2.0], f64::NAN, 0.5), ([0.0, 0.0, 2.0], 0.1, f64::NAN)],
        vec![
            ([f64::INFINITY, 0.0, 2.0], 0.1, 0.5),
            ([0.0, 0.0, 2.0], f64::INFINITY, 0.5),
            ([0.0, 0.0, 2.0], tiny, 0.5),
        ],
        // Not opacity 1: two splats at α = .99 leave T = 1e-4, where rounding decides whether the pixel stops.
        vec![([0.0, 0.0, 2.0], 0.1, 0.98); 40],
    ];
    for (i, rows) in cases.iter().enumerate() {
        let (out, rgb) = simple(rows);
        for size in [1, 17, 70] {
            let view = frontal(size, 50.0);
            let (mut image, mut d) = (Image::default(), RenderGrads::default());
            let mut renderer = Renderer::new(complete());
            let splats = direct(&out, &rgb);
            renderer.render(&shot(&splats, &view, BACKGROUND, None), &mut image);
            let truth = oracle::render(&shot(&splats, &view, BACKGROUND, None), &complete());
            let (worst, _) = difference(&image, &truth, 0.0);
            assert!(worst < 1e-9, "case {i}, {size} px: {worst}");
            let ones = ImageGrads { color: &image.color.clone(), alpha: None, depth: None, extra: None };
            renderer.backward(&shot(&splats, &view, BACKGROUND, None), &ones, &mut [None], &mut d);
            assert!(d.parts[0].out.first_non_finite().is_none(), "case {i}: a gradient is not finite");
            assert!(d.mean2d.iter().all(|v| v.is_finite()) && d.camera.iter().all(|v| v.is_finite()));
        }
    }
    let (mut image, nothing) = (Image::default(), Splats::<f64>::default());
    Renderer::new(complete()).render(&shot(&nothing, &frontal(9, 9.0), BACKGROUND, None), &mut image);
    assert!(image.color.plane(1).iter().all(|&v| v == BACKGROUND[1]), "an empty scene is its background");
}

#[test]
fn no_gradient_passes_a_ceiling() {
    // α is at its maximum on every pixel: only colours and background may have a gradient.
    let (out, rgb) = simple(&[([0.0, 0.0, 2.0], 1e4, 0.95)]);
    let view = frontal(20, 30.0);
    let config = RenderConfig { alpha_max: 0.5, ..complete() };
    let (mut image, mut d) = (Image::default(), RenderGrads::default());
    let mut renderer = Renderer::new(config);
    renderer.render(&shot(&direct(&out, &rgb), &view, BACKGROUND, None), &mut image);
    let g = image.color.clone();
    let grads = ImageGrads { color: &g, alpha: None, depth: None, extra: None };
    renderer.backward(&shot(&direct(&out, &rgb), &view, BACKGROUND, None), &grads, &mut [None], &mut d);
    assert!((0..10).all(|c| d.parts[0].out.get(0, c) == 0.0), "{:?}", d.parts[0].out.read::<10>(0, 0));
    assert!(d.parts[0].color.as_ref().unwrap().get(0, 0) > 0.0 && d.background[0] > 0.0);
}

#[test]
fn tight_boxes_cover_a_three_sigma_circle() {
    // At 3.3σ an opaque splat still has α = .0043 > 1/255: it must be rendered there.
    let (out, rgb) = simple(&[([0.0, 0.0, 2.0], 0.04, 1.0)]);
    let view = frontal(101, 100.0);
    let mut image = Image::default();
    Renderer::new(complete()).render(&shot(&direct(&out, &rgb), &view, [0.0; 3], None), &mut image);
    let sigma = (0.04f64 * 2500.0 + 0.3).sqrt();
    let at = (3.25 * sigma) as usize;
    assert!(image.alpha.get(0, 50, 50 + at) > 1.0 / 255.0, "α at 3.25σ is {}", image.alpha.get(0, 50, 50 + at));
    let drawn = image.alpha.data.iter().filter(|&&a| a > 0.0).count() as f64;
    let area = std::f64::consts::PI * 2.0 * 255f64.ln() * sigma * sigma;
    assert!((drawn / area - 1.0).abs() < 0.02, "{drawn} pixels, the ellipse has {area}");
}

#[test]
fn threads_change_no_bit() {
    let s = scene(9, 3000, 0.03).cast::<f32>();
    let view = camera(150, 131);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut renderer = Renderer::new(complete());
            let (splats, mut image, mut d) = (s.splats(), Image::default(), RenderGrads::default());
            let mut own = s.own.zeros_like();
            for _ in 0..2 {
                own.fill(0.0);
                renderer.render(&shot(&splats, &view, [0.1; 3], Some(&s.extra)), &mut image);
                let (c, a) = (image.color.clone(), image.alpha.clone());
                let e = image.extra.clone();
                let grads = ImageGrads { color: &c, alpha: Some(&a), depth: None, extra: Some(&e) };
                let d_sh = &mut [Some(&mut own), None, None];
                renderer.backward(&shot(&splats, &view, [0.1; 3], Some(&s.extra)), &grads, d_sh, &mut d);
            }
            (image, d.parts, d.extra, d.mean2d, d.mean2d_abs, d.camera, d.background, own)
        })
    };
    let one = run(1);
    assert!(one == run(2) && one == run(3));
    assert!(one.3.iter().zip(&one.4).all(|(m, a)| m <= &(a * 1.001 + 1e-6)), "|Σ g| ≤ Σ |g|");
}

#[test]
fn a_render_of_too_many_pairs_is_split_into_runs_of_bins() {
    // Wide and small splats, on an image of more than 8 bins across.
    for (size, (w, h)) in [(0.8, (300, 100)), (0.05, (150, 131))] {
        let s = scene(17, 40, size);
        let view = camera(w, h);
        let loss = Loss::new(&view, s.extra.width());
        let run = |budget: usize| {
            let mut renderer = Renderer::new(complete());
            renderer.raster.budget = Some(budget);
            let (splats, mut image, mut d) = (s.splats(), Image::default(), RenderGrads::default());
            let mut own = s.own.zeros_like();
            renderer.render(&shot(&splats, &view, BACKGROUND, Some(&s.extra)), &mut image);
            let d_sh = &mut [Some(&mut own), None, None];
            renderer.backward(&shot(&splats, &view, BACKGROUND, Some(&s.extra)), &loss.grads(), d_sh, &mut d);
            let (runs, held) = (renderer.raster.bins.runs.len(), renderer.raster.bins.keys.capacity());
            (runs, held, renderer.stats().pairs, image, d)
        };
        let (runs, held, pairs, image, d) = run(usize::MAX);
        assert!(runs == 1 && held >= pairs);
        for budget in [pairs / 3, 1] {
            let (runs, held, pairs_too, in_runs, d_in_runs) = run(budget);
            assert!(runs > 2 && held < pairs && pairs_too == pairs, "{runs} runs, {held} of {pairs} pairs held");
            assert!(image == in_runs, "the picture does not depend on the budget");
            let close = |a: &Table<f64>, b: &Table<f64>| {
                a.data().iter().zip(b.data()).all(|(a, b)| (a - b).abs() <= 1e-9 * (1.0 + a.abs()))
            };
            assert!(d.parts.iter().zip(&d_in_runs.parts).all(|(a, b)| close(&a.out, &b.out)));
            assert!(close(d.extra.as_ref().unwrap(), d_in_runs.extra.as_ref().unwrap()));
            assert!(d.background == d_in_runs.background);
        }
    }
}

#[test]
fn instruction_levels_agree() {
    let s = scene(5, 200, 0.1).cast::<f32>();
    let view = camera(100, 80);
    let run = |simd| draw(&s, &view, RenderConfig { simd, ..smooth() });
    let scalar = run(Simd::Scalar);
    for simd in [Simd::Avx2, Simd::Avx512] {
        let other = run(simd);
        let worst = scalar.color.data.iter().zip(&other.color.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-5, "{simd:?}: {worst}");
    }
}

#[test]
fn contributions_are_the_oracles_and_sum_to_alpha() {
    let mut s = scene(8, 50, 0.1);
    let n = s.splats().len();
    // A channel of its own for every splat, white there alone: the oracle's images of these channels are the result.
    s.extra = Table::new(&[("own", n)], n);
    (0..n).for_each(|j| s.extra.set(j, j, 1.0));
    let view = camera(75, 41);
    let oracle = draw_oracle(&s, &view, complete());
    let (mut renderer, mut image) = (Renderer::new(complete()), Image::default());
    renderer.render(&shot(&s.splats(), &view, [0.0; 3], None), &mut image);
    let mut share = Vec::new();
    renderer.last_contributions(&mut share);
    for (j, &share) in share.iter().enumerate() {
        let expected: f64 = oracle.extra.plane(j).iter().sum();
        assert!((share - expected).abs() <= 1e-9 * expected, "splat {j}: {share}, {expected} by the oracle");
        assert!(share == 0.0 || renderer.radii()[j] > 0.0);
    }
    let (a, b): (f64, f64) = (share.iter().sum(), image.alpha.data.iter().sum());
    assert!((a - b).abs() < 1e-9 * b && b > 100.0, "{a} {b}");
    assert!(share.contains(&0.0), "some are hidden or outside");

    // Without an image, and a run of bins at a time: the same bits.
    let mut again = Vec::new();
    let mut blind = Renderer::new(complete());
    blind.contributions(&s.splats(), &view, &mut again);
    assert_eq!(again, share);
    blind.raster.budget = Some(40);
    blind.contributions(&s.splats(), &view, &mut again);
    assert_eq!(again, share);
    assert!(blind.raster.bins.runs.len() > 1);
}

#[test]
fn contributions_change_no_gradient_and_do_not_depend_on_threads() {
    let s = scene(9, 300, 0.1).cast::<f32>();
    let view = camera(150, 90);
    let pool = |threads: usize| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let run = |weigh: bool| {
        let (mut renderer, mut image) = (Renderer::new(complete()), Image::default());
        let (mut share, mut d) = (Vec::new(), RenderGrads::default());
        renderer.render(&shot(&s.splats(), &view, [0.5; 3], None), &mut image);
        if weigh {
            renderer.last_contributions(&mut share);
        }
        let ones = Planes { channels: 3, height: 90, width: 150, data: vec![1.0; 3 * 150 * 90] };
        let grads = ImageGrads { color: &ones, alpha: None, depth: None, extra: None };
        renderer.backward(&shot(&s.splats(), &view, [0.5; 3], None), &grads, &mut [None, None, None], &mut d);
        (share, d.mean2d)
    };
    let one = pool(1).install(|| run(true));
    assert_eq!(one, pool(3).install(|| run(true)));
    assert_eq!(one.1, run(false).1);
}

/// A splat's removal is rendered: the same splats with its opacity at 0.
#[test]
fn removals_equal_the_loss_of_an_image_without_each_splat() {
    let mut s = scene(12, 12, 0.15);
    // No pixel stops early, since one that has would continue without the splat.
    s.outs.iter_mut().for_each(|out| (0..out.rows()).for_each(|j| out.set(j, 9, 0.5 * out.get(j, 9))));
    let view = camera(75, 41);
    let whole = draw_oracle(&s, &view, complete());
    let (mut renderer, mut losses) = (Renderer::new(complete()), Vec::new());
    renderer.removals(&Shot::new(&s.splats(), &view, BACKGROUND), &mut losses);
    let (mut n, mut changes) = (0, 0);
    for part in 0..3 {
        for j in 0..s.outs[part].rows() {
            let mut without = s.clone();
            without.outs[part].set(j, 9, 0.0);
            let picture = draw_oracle(&without, &view, complete());
            let pairs = picture.color.data.iter().zip(&whole.color.data);
            let expected: f64 = pairs.map(|(a, b)| (a - b) * (a - b)).sum();
            assert!((losses[n] - expected).abs() <= 1e-8 * expected + 1e-12, "splat {n}: {} {expected}", losses[n]);
            changes += usize::from(expected > 0.1);
            n += 1;
        }
    }
    assert!(changes > 20, "{changes} splats matter");
}

/// Brute force: the oracle's image with each mean and standard deviation moved, and with each opacity.
#[test]
fn sensitivities_are_sums_of_squared_differences() {
    let mut s = scene(12, 4, 0.15);
    s.outs.iter_mut().for_each(|out| (0..out.rows()).for_each(|j| out.set(j, 9, 0.5 * out.get(j, 9))));
    let view = camera(45, 31);
    // Colours that do not depend on the direction, and no thresholds.
    let config = smooth();
    // A bare bell's tail counts like its middle, where it is rendered.
    let cut = complete();
    let plain = |s: &Scene<f64>, config: &RenderConfig| {
        oracle::render(&Shot { sh_degree: 0, ..Shot::new(&s.splats(), &view, BACKGROUND) }, config).color.data
    };
    let [mut found, mut drawn] = [Vec::new(), Vec::new()];
    let splats = s.splats();
    let shot = Shot { sh_degree: 0, ..Shot::new(&splats, &view, BACKGROUND) };
    Renderer::new(config).sensitivities(&shot, &mut found);
    Renderer::new(cut).sensitivities(&shot, &mut drawn);
    let (mut n, mut strong) = (0, 0);
    for part in 0..3 {
        for j in 0..s.outs[part].rows() {
            let (values, axes) = sym3::eigen(s.outs[part].read::<6>(j, 3));
            let moved = |k: usize, h: f64| {
                let mut s = s.clone();
                if k < 3 {
                    *s.outs[part].get_mut(j, k) += h;
                } else {
                    let (n, deviation) = (k - 3, values[k - 3].sqrt());
                    let grown = (deviation + h).powi(2) - deviation.powi(2);
                    for (c, (p, q)) in [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)].into_iter().enumerate() {
                        *s.outs[part].get_mut(j, 3 + c) += grown * axes[p][n] * axes[q][n];
                    }
                }
                plain(&s, &config)
            };
            let slopes: Vec<Vec<f64>> = (0..6)
                .map(|k| moved(k, 1e-5).iter().zip(moved(k, -1e-5)).map(|(a, b)| (a - b) / 2e-5).collect())
                .collect();
            let size: f64 = (0..6).map(|k| slopes[k].iter().map(|x| x * x).sum::<f64>()).sum();
            let mut at = 0;
            for a in 0..6 {
                for b in a..6 {
                    let expected: f64 = slopes[a].iter().zip(&slopes[b]).map(|(x, y)| x * y).sum();
                    let got = found[n].fisher[at];
                    assert!((got - expected).abs() <= 1e-5 * size + 1e-9, "splat {n}, {a} {b}: {got} {expected}");
                    at += 1;
                }
            }
            // dI/dg = dI/do · o/g, pixel by pixel.
            let mut expected = 0.0;
            let out = &s.outs[part];
            let seen = project::project(&View::new(&view, &cut), out.read(j, 0), out.read(j, 3), out.get(j, 9));
            if let Some(p) = seen {
                let with = |h: f64| {
                    let mut s = s.clone();
                    *s.outs[part].get_mut(j, 9) += h;
                    plain(&s, &cut)
                };
                let (up, down) = (with(1e-6), with(-1e-6));
                for (i, (u, d)) in up.iter().zip(&down).enumerate().filter(|(_, (u, d))| u != d) {
                    let pixel = i % (45 * 31);
                    let dx = p.mean2d[0] - (pixel % 45) as f64 - 0.5;
                    let dy = p.mean2d[1] - (pixel / 45) as f64 - 0.5;
                    let g = (-0.5 * (p.conic[0] * dx * dx + 2.0 * p.conic[1] * dx * dy + p.conic[2] * dy * dy)).exp();
                    expected += ((u - d) / 2e-6 * out.get(j, 9) / g).powi(2);
                }
            }
            let got = drawn[n].squared;
            assert!((got - expected).abs() <= 1e-5 * expected + 1e-9, "splat {n}: {got} {expected}");
            strong += usize::from(expected > 0.1 && size > 0.1);
            n += 1;
        }
    }
    assert!(strong > 6, "{strong} splats matter");
}

/// Precision of f32 in the backward pass: behind many opaque splats, the remaining light is a small difference of large
/// sums.
#[test]
fn f32_gradients_are_those_of_f64() {
    let mut s = scene(9, 150, 0.12);
    for out in &mut s.outs {
        for j in 0..out.rows() {
            // Half of them at the ceiling of α.
            out.set(j, 9, if j % 2 == 0 { 0.999 } else { 0.5 });
        }
    }
    let view = camera(80, 60);
    let config = RenderConfig { simd: Simd::detect(), ..RenderConfig::default() };
    let rng = Rng::new(5, "gradient", 0);
    let mut g = Planes::<f64>::new(3, 60, 80);
    g.data.iter_mut().enumerate().for_each(|(i, v)| *v = rng.normal(i as u64));
    fn run<F: Real>(s: &Scene<F>, view: &Camera, config: RenderConfig, g: &Planes<F>) -> Vec<f64> {
        let mut renderer = Renderer::new(config);
        let (splats, mut out, mut d) = (s.splats(), Image::default(), RenderGrads::default());
        let background = BACKGROUND.map(F::of);
        let shot = Shot::new(&splats, view, background);
        renderer.render(&shot, &mut out);
        let grads = ImageGrads { color: g, alpha: None, depth: None, extra: None };
        renderer.backward(&shot, &grads, &mut [None, None, None], &mut d);
        d.parts.iter().flat_map(|p| (0..p.out.rows()).flat_map(|j| p.out.read::<10>(j, 0))).map(F::f64).collect()
    }
    let exact = run(&s, &view, config, &g);
    let g32 = Planes { channels: 3, height: 60, width: 80, data: g.data.iter().map(|&v| v as f32).collect() };
    let fast = run(&s.cast::<f32>(), &view, config, &g32);
    let size: f64 = exact.iter().map(|v| v * v).sum::<f64>().sqrt();
    let error: f64 = exact.iter().zip(&fast).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
    assert!(size > 0.0 && error < 2e-4 * size, "{error} of {size}");
}

#[test]
fn touched_pixels_are_those_of_the_ellipse_inside_the_image() {
    // One round splat of 10 px standard deviation: α = o·exp(−r²/200) is 1/255 on a circle of known radius.
    let (mut out, mut colors) = (Table::<f64>::new(&SPLAT_COLUMNS, 1), Table::<f64>::new(&[("rgb", 3)], 1));
    out.write(0, 3, [0.01, 0.0, 0.0, 0.01, 0.0, 0.01]);
    out.set(0, 9, 0.5);
    colors.write(0, 0, [1.0; 3]);
    let mut view = camera(400, 300);
    view.cam_from_world = Se3 { translation: [0.0, 0.0, 1.0], ..Se3::IDENTITY };
    view.intrinsics = Intrinsics { fx: 100.0, fy: 100.0, cx: 200.0, cy: 150.0 };
    let mut renderer = Renderer::<f64>::new(RenderConfig { low_pass: 0.0, ..smooth() });
    let config = RenderConfig { alpha_min: 1.0 / 255.0, ..renderer.config };
    renderer.config = config;
    let mut image = Image::default();
    let mut pixels = |cx: f64| {
        let mut view = view.clone();
        view.intrinsics.cx = cx;
        let splats = Splats { parts: vec![Part::new(&out, Color::Direct { table: &colors })], head: None };
        renderer.render(&shot(&splats, &view, [0.0; 3], None), &mut image);
        let lit = image.alpha.data.iter().filter(|a| **a > 0.0).count() as f64;
        (renderer.projected()[0].pixels([400, 300]), lit)
    };
    let (told, lit) = pixels(200.0);
    assert!((told / lit - 1.0).abs() < 0.02, "{told} {lit}");
    // Half of it beyond the edge.
    let (told, lit) = pixels(0.0);
    assert!((told / lit - 1.0).abs() < 0.03, "{told} {lit}");
}
