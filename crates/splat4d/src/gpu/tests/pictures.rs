//! Whole images against the CPU's.

use super::*;
use crate::render::RenderStats;

/// Largest difference of a colour or an alpha. A splat at the α cut-off may be rendered on one side only, which is
/// 1/255 of what is left of the light there.
const PIXEL: f32 = 2e-3;
/// Largest difference of Σ z α T, of the scene's depth.
const DEPTH: f32 = 2e-3;
/// Least PSNR of colour, dB.
const PSNR: f64 = 60.0;

fn worst(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

fn psnr(a: &[f32], b: &[f32]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    -10.0 * (sum / a.len() as f64).log10()
}

/// Asserts equal renders, and returns the PSNR.
fn compare(r: &mut GpuRenderer, shot: &Shot<'_>, what: &str) -> (f64, RenderStats) {
    let mut image = Image::default();
    r.render(shot, &mut image).expect("it is drawn");
    let (cpu, expected) = on_cpu(shot, &r.config);
    let far = cpu.projected().iter().filter(|p| p.radius > 0.0).map(|p| p.depth).fold(1.0, f32::max);
    let (color, alpha) =
        (worst(&image.color.data, &expected.color.data), worst(&image.alpha.data, &expected.alpha.data));
    let depth = worst(&image.depth.data, &expected.depth.data) / far;
    let db = psnr(&image.color.data, &expected.color.data);
    println!("{what}: {db:.1} dB, worst colour {color:.1e}, alpha {alpha:.1e}, depth {depth:.1e}");
    assert!(color < PIXEL && alpha < PIXEL && depth < DEPTH && db > PSNR, "{what} differs from the CPU's picture");
    (db, cpu.stats())
}

#[test]
fn images_equal_the_cpus() {
    let Some(mut r) = renderer() else { return };
    println!("{}", r.gpu().describe());
    let scenes = [Scenery::new(10, 2000, 1.2, 0.03), Scenery::new(11, 200, 1.0, 0.3), Scenery::new(12, 1, 0.1, 0.2)];
    let cameras = [
        camera([0.0, 0.5, -4.0], 131, 77),
        camera([3.0, 1.5, 1.0], 64, 160),
        skewed(250, 33),
        // Among the splats: many are behind.
        camera([0.2, 0.1, -0.3], 97, 113),
        camera([0.0, 0.0, -3.0], 1, 1),
        camera([0.0, 0.0, -3.0], 17, 300),
    ];
    for (s, scene) in scenes.iter().enumerate() {
        for (c, camera) in cameras.iter().enumerate() {
            for antialias in [Antialias::Off, Antialias::On] {
                r.config.antialias = antialias;
                compare(&mut r, &shot(&scene.splats(), camera), &format!("scene {s}, camera {c}, {antialias:?}"));
            }
        }
    }
}

#[test]
fn every_kind_of_colour_is_rendered() {
    let Some(mut r) = renderer() else { return };
    let camera = camera([0.0, 0.5, -4.0], 100, 60);
    let n = 500;
    let scene = Scenery::new(13, n, 1.0, 0.06);
    let mut direct = Table::new(&[("rgb", 4)], n);
    let mut gray = Table::new(&[("rgb", 1)], n);
    let mut weights = Table::new(&[("weights", 2)], n);
    // Twice the rows, of which every other one is meant, with two blocks of degree 1.
    let (mut large, ids) = (Table::new(&[("sh", 24)], 2 * n), (0..n as u32).map(|i| 2 * i + 1).collect::<Vec<_>>());
    let rng = Rng::new(14, "colour", 0);
    for j in 0..n {
        for c in 0..4 {
            direct.set(j, c, rng.fork(j as u64).uniform(c as u64) as f32);
        }
        gray.set(j, 0, direct.get(j, 1));
        weights.write(j, 0, [direct.get(j, 0), direct.get(j, 2) - 0.5]);
        for c in 0..24 {
            large.set(2 * j + 1, c, scene.sh.get(j, c));
            large.set(2 * j, c, 9.0);
        }
    }
    let small = Scenery::new(15, 33, 1.0, 0.2);
    let sh = |table, rows, weights| Color::Sh { table, rows, weights, base: false };
    let colors = [
        Color::Direct { table: &direct },
        Color::Direct { table: &gray },
        sh(&large, Rows::Some(&ids), Some(&weights)),
        sh(&large, Rows::Some(&ids), None),
    ];
    for (i, color) in colors.into_iter().enumerate() {
        // 24 columns without weights are eight coefficients a channel, of which degree 1 is whole.
        let sh_degree = if i == 3 { 1 } else { 3 };
        let (mut splats, rest) = (Splats { parts: vec![Part::new(&scene.out, color)], head: None }, small.splats());
        compare(&mut r, &Shot { sh_degree, ..shot(&splats, &camera) }, &format!("colour {i}"));
        // A second layer, then an empty one.
        let none = Scenery::new(16, 0, 1.0, 1.0);
        splats.parts.push(rest.parts[0]);
        splats.parts.push(none.splats().parts[0]);
        compare(&mut r, &Shot { sh_degree, ..shot(&splats, &camera) }, &format!("colour {i} with a second layer"));
    }
}

#[test]
fn an_empty_scene_renders_the_background() {
    let Some(mut r) = renderer() else { return };
    let camera = camera([0.0, 0.0, -4.0], 40, 30);
    let empty = Scenery::new(17, 0, 1.0, 1.0);
    let behind = Scenery::new(18, 100, 1.0, 0.1);
    let mut away = camera.clone();
    away.cam_from_world = Se3::look_at([0.0, 0.0, -4.0], [0.0, 0.0, -9.0], [0.0, 1.0, 0.0]);
    for (splats, camera) in
        [(Splats { parts: vec![], head: None }, &camera), (empty.splats(), &camera), (behind.splats(), &away)]
    {
        let mut image = Image::default();
        r.render(&shot(&splats, camera), &mut image).expect("it is drawn");
        for (c, b) in BACKGROUND.iter().enumerate() {
            assert!(image.color.plane(c).iter().all(|v| v == b));
        }
        assert!(image.alpha.data.iter().chain(&image.depth.data).all(|v| *v == 0.0));
        assert_eq!((r.stats().visible, r.stats().pairs), (0, 0));
    }
    let mut image = Image::default();
    let flat = Camera { width: 0, ..camera };
    r.render(&shot(&behind.splats(), &flat), &mut image).expect("a picture without pixels");
    assert!(image.color.data.is_empty());
}

/// A scene of which one number, and one whole row, is each of `values`.
fn spoilt(values: &[f32]) -> Scenery {
    let mut scene = Scenery::new(19, 500, 1.0, 0.08);
    for (i, &v) in values.iter().enumerate() {
        for column in 0..10 {
            scene.out.set(10 * i + column, column, v);
        }
        scene.out.write(100 + i, 0, [v; 10]);
    }
    scene
}

#[test]
fn absurd_values_are_not_rendered() {
    let Some(mut r) = renderer() else { return };
    let camera = camera([0.0, 0.5, -4.0], 90, 70);
    let scene = spoilt(&[f32::NAN, f32::INFINITY, f32::NEG_INFINITY]);
    compare(&mut r, &shot(&scene.splats(), &camera), "NaN and infinities");
    // Numbers of which squares overflow mean nothing on either side, but they end, and in a finite image.
    let scene = spoilt(&[1e38, -1e38, 1e30, -1e30, 1e-38]);
    let mut image = Image::default();
    r.render(&shot(&scene.splats(), &camera), &mut image).expect("it is drawn");
    assert!(image.color.data.iter().chain(&image.alpha.data).all(|v| v.is_finite()));
    // And cameras that are no cameras: neither hang nor failure.
    for broken in [f64::NAN, f64::INFINITY, 0.0, -1.0, 1e300] {
        let mut camera = camera.clone();
        camera.intrinsics.fx = broken;
        r.render(&shot(&scene.splats(), &camera), &mut image).expect("it ends");
    }
}

#[test]
fn bands_make_the_same_image() {
    let Some(mut r) = own_renderer() else { return };
    let (scene, camera) = (Scenery::new(20, 20_000, 1.2, 0.05), camera([0.0, 0.5, -4.0], 300, 210));
    let (mut whole, mut bands) = (Image::default(), Image::default());
    r.render(&shot(&scene.splats(), &camera), &mut whole).expect("it is drawn");
    let (pairs, one) = (r.stats().pairs, r.stats().bands);
    assert!(one == 1 && pairs > 1 << 16, "{pairs} pairs must be more than there was room for at first");
    // A renderer without memory yet, so that its buffers are small.
    let Some(mut r) = own_renderer() else { return };
    r.most_pairs = pairs / 4;
    r.render(&shot(&scene.splats(), &camera), &mut bands).expect("it is drawn");
    assert!(r.stats().bands > 1 && r.stats().pairs == pairs);
    assert!(whole == bands, "a picture in bands is the same, bit for bit");
    // A row of tiles holds more than that.
    let mut r = GpuRenderer { most_pairs: 10, buffers: Buffers::new(), groups: None, ..r };
    let error = r.render(&shot(&scene.splats(), &camera), &mut bands);
    assert!(error.is_err_and(|e| e.to_string().contains("too many")), "too many pairs are an error");
}

#[test]
fn a_second_frame_is_the_same_and_allocates_nothing() {
    let Some(mut r) = renderer() else { return };
    let (scene, camera) = (Scenery::new(21, 2000, 1.2, 0.05), camera([0.0, 0.5, -4.0], 150, 110));
    let (mut first, mut second) = (Image::default(), Image::default());
    r.tables = Tables::Constant;
    r.render(&shot(&scene.splats(), &camera), &mut first).expect("it is drawn");
    let bytes = r.memory_bytes();
    r.render(&shot(&scene.splats(), &camera), &mut second).expect("it is drawn");
    assert!(first == second && r.memory_bytes() == bytes);
    let t = r.timings();
    assert!(t.total > 0.0 && t.wait > 0.0 && (t.gpu() > 0.0) == (r.clock == StageClock::Gpu));
    r.clock = StageClock::Wall;
    r.render(&shot(&scene.splats(), &camera), &mut second).expect("it is drawn");
    assert!(first == second && r.timings().rasterize > 0.0 && r.timings().project > 0.0);
    // Other colours at another address are seen, those of a table that changes too.
    let other = Scenery::new(22, 2000, 1.2, 0.05);
    let color = Color::Sh { table: &other.sh, rows: Rows::All, weights: None, base: true };
    let splats = Splats { parts: vec![Part::new(&scene.out, color)], head: None };
    compare(&mut r, &shot(&splats, &camera), "other colours");
}

#[test]
fn bytes_are_the_image_clamped_and_rounded() {
    let Some(mut r) = own_renderer() else { return };
    let (scene, camera) = (Scenery::new(23, 3000, 1.2, 0.1), camera([0.0, 0.5, -4.0], 131, 77));
    let splats = scene.splats();
    let shot = Shot::new(&splats, &camera, BACKGROUND);
    let (mut image, mut whole, mut bands) = (Image::default(), Vec::new(), vec![[7; 4]; 3]);
    r.render(&shot, &mut image).expect("it is drawn");
    assert!(r.render_bytes(&shot, &mut whole).expect("it is drawn"), "the GPU has such a way");
    assert_eq!(whole.len(), 131 * 77);
    for (i, pixel) in whole.iter().enumerate() {
        for (c, byte) in pixel.iter().enumerate() {
            let v = if c < 3 { image.color.plane(c)[i] } else { image.alpha.data[i] };
            assert_eq!(*byte, (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8, "pixel {i}, channel {c}: {v}");
        }
    }
    r.most_pairs = r.stats().pairs / 4;
    (r.buffers, r.groups) = (Buffers::new(), None);
    assert!(r.render_bytes(&shot, &mut bands).expect("it is drawn") && r.stats().bands > 1);
    assert!(bands == whole, "in bands too");
    let mut none = vec![[1; 4]];
    assert!(!crate::device::cpu(RenderConfig::default()).render_bytes(&shot, &mut none).expect("nothing fails"));
    assert_eq!(none, [[1; 4]], "the CPU has no such way, and does nothing");
}
