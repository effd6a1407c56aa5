//! The backward pass: each kernel against its twin, then all of it against the CPU's, which is checked against finite
//! differences (render/tests.rs).

use super::*;
use crate::render::{ProjectedGrads, View, project};
use frame::RECORD_BYTES;

/// Largest difference of a pair's sum from the same sum in f64, of the root of the mean square of all pairs' sums.
const RECORD: f64 = 1e-3;
/// Largest relative difference of a gradient, as a vector, where both render the same lists: rounding.
const VECTOR: f64 = 1e-4;
/// Of the whole chain, where a splat at the α cut-off may be rendered by one side only.
const CHAIN: f64 = 2e-3;

/// A gradient to an image: of both signs, different in all planes.
fn gradient(seed: u64, channels: usize, camera: &Camera) -> Planes<f32> {
    let mut out = Planes::new(channels, camera.height, camera.width);
    let rng = Rng::new(seed, "gradient", channels as u64);
    for (i, v) in out.data.iter_mut().enumerate() {
        *v = 1e-3 * rng.normal(i as u64) as f32;
    }
    out
}

/// Gradients to colour, alpha and depth.
struct Pulled([Planes<f32>; 3]);

impl Pulled {
    fn new(seed: u64, camera: &Camera) -> Self {
        Self([gradient(seed, 3, camera), gradient(seed + 1, 1, camera), gradient(seed + 2, 1, camera)])
    }

    fn all(&self) -> ImageGrads<'_, f32> {
        let [color, alpha, depth] = &self.0;
        ImageGrads { color, alpha: Some(alpha), depth: Some(depth), extra: None }
    }
}

/// Renders and runs the backward pass; tables of colours get their gradients in `d_sh`.
fn back(
    r: &mut dyn Backend<f32>,
    shot: &Shot<'_>,
    grads: &ImageGrads<'_, f32>,
) -> (Image<f32>, RenderGrads<f32>, Vec<Option<Table<f32>>>) {
    let (mut image, mut d) = (Image::default(), RenderGrads::default());
    let mut d_sh: Vec<Option<Table<f32>>> = shot
        .splats
        .parts
        .iter()
        .map(|p| match p.color {
            Color::Sh { table, base: true, .. } => Some(table.zeros_like()),
            _ => None,
        })
        .collect();
    r.render(shot, &mut image).expect("it is drawn");
    let mut targets: Vec<_> = d_sh.iter_mut().map(Option::as_mut).collect();
    r.vjp(shot, grads, &mut targets, &mut d).expect("it goes back");
    (image, d, d_sh)
}

/// |a - b| / |b| of vectors, in f64.
fn apart(a: impl Iterator<Item = f64>, b: impl Iterator<Item = f64>) -> f64 {
    let (mut off, mut all) = (0.0, 0.0);
    for (a, b) in a.zip(b) {
        off += (a - b) * (a - b);
        all += b * b;
    }
    if all == 0.0 { off.sqrt() } else { (off / all).sqrt() }
}

/// All columns of a table, row after row.
fn numbers(table: &Table<f32>, columns: std::ops::Range<usize>) -> Vec<f64> {
    let rows = 0..table.rows();
    rows.flat_map(|j| columns.clone().map(move |c| (j, c))).map(|(j, c)| f64::from(table.get(j, c))).collect()
}

/// Every gradient by name, as numbers.
fn named(d: &RenderGrads<f32>, d_sh: &[Option<Table<f32>>]) -> Vec<(String, Vec<f64>)> {
    let mut out = Vec::new();
    let mut put = |name: String, v: Vec<f64>| out.push((name, v));
    for (i, part) in d.parts.iter().enumerate() {
        for (name, columns) in [("means", 0..3), ("covariances", 3..9), ("opacities", 9..10)] {
            put(format!("{name} of part {i}"), numbers(&part.out, columns));
        }
        for (name, table) in [("colours", &part.color), ("weights", &part.weights), ("SH", &d_sh[i])] {
            if let Some(table) = table {
                put(format!("{name} of part {i}"), numbers(table, 0..table.width()));
            }
        }
    }
    put("pose".into(), d.camera.to_vec());
    put("focal".into(), vec![d.focal]);
    put("background".into(), d.background.iter().map(|v| f64::from(*v)).collect());
    put("screen".into(), d.mean2d.iter().map(|v| f64::from(*v)).collect());
    put("absolute".into(), d.mean2d_abs.iter().map(|v| f64::from(*v)).collect());
    out
}

/// Asserts equal gradients. Returns the worst relative difference.
fn compare(r: &mut GpuRenderer, shot: &Shot<'_>, grads: &ImageGrads<'_, f32>, what: &str) -> f64 {
    let (_, d, d_sh) = back(r, shot, grads);
    let mut cpu = Renderer::new(r.config);
    let (_, expected, expected_sh) = back(&mut cpu, shot, grads);
    let mut worst = 0.0f64;
    for ((name, a), (other, b)) in named(&d, &d_sh).iter().zip(&named(&expected, &expected_sh)) {
        assert!(name == other && a.len() == b.len());
        // Depth is a pass of its own on the CPU, and passes are summed apart.
        if name == "absolute" && grads.depth.is_some() {
            continue;
        }
        let off = apart(a.iter().copied(), b.iter().copied());
        assert!(off < CHAIN, "{what}: {name} differ by {off:.1e}");
        worst = worst.max(off);
    }
    let cpu: &dyn Backend = &cpu;
    let radii = Backend::radii(r).iter().zip(cpu.radii());
    let otherwise = radii.filter(|(a, b)| (**a - **b).abs() > 2e-3 * b.abs().max(1.0)).count();
    // The CPU tests ellipses against bins, the GPU against tiles.
    assert!(otherwise <= 2 + d.mean2d.len() / 100, "{what}: {otherwise} radii are others");
    println!("{what}: worst relative difference {worst:.1e}");
    worst
}

#[test]
fn gradients_equal_the_cpus() {
    let Some(mut r) = renderer() else { return };
    let scenes = [Scenery::new(30, 1500, 1.2, 0.04), Scenery::new(31, 200, 1.0, 0.3)];
    let cameras = [camera([0.0, 0.5, -4.0], 131, 77), skewed(97, 45), camera([0.2, 0.1, -0.3], 33, 65)];
    let mut all = Vec::new();
    for (s, scene) in scenes.iter().enumerate() {
        for (c, camera) in cameras.iter().enumerate() {
            for antialias in [Antialias::Off, Antialias::On] {
                (r.config.antialias, r.config.abs_grads) = (antialias, s == 0);
                let (splats, pulled) = (scene.splats(), Pulled::new(32, camera));
                let what = format!("scene {s}, camera {c}, {antialias:?}");
                all.push(compare(&mut r, &shot(&splats, camera), &pulled.all(), &what));
                let flat = Shot::new(&splats, camera, BACKGROUND);
                let color = ImageGrads { color: &pulled.0[0], alpha: None, depth: None, extra: None };
                all.push(compare(&mut r, &flat, &color, &format!("{what}, colour alone")));
            }
        }
    }
    all.sort_by(f64::total_cmp);
    let median = all[all.len() / 2];
    assert!(median < VECTOR, "mostly both draw the same: {median:.1e}");
}

#[test]
fn every_kind_of_colour_backpropagates() {
    let Some(mut r) = renderer() else { return };
    let camera = camera([0.0, 0.5, -4.0], 70, 50);
    let (n, pulled) = (300, Pulled::new(33, &camera));
    let (scene, small) = (Scenery::new(34, n, 1.0, 0.08), Scenery::new(35, 33, 1.0, 0.2));
    let (mut direct, mut weights) = (Table::new(&[("rgb", 4)], n), Table::new(&[("weights", 2)], n));
    let (mut large, ids) = (Table::new(&[("sh", 24)], 2 * n), (0..n as u32).map(|i| 2 * i + 1).collect::<Vec<_>>());
    let rng = Rng::new(36, "colour", 0);
    for j in 0..n {
        (0..4).for_each(|c| direct.set(j, c, rng.fork(j as u64).uniform(c as u64) as f32));
        weights.write(j, 0, [direct.get(j, 0), direct.get(j, 2) - 0.5]);
        (0..24).for_each(|c| large.set(2 * j + 1, c, scene.sh.get(j, c)));
    }
    let colors = [
        Color::Direct { table: &direct },
        Color::Sh { table: &large, rows: Rows::Some(&ids), weights: Some(&weights), base: true },
    ];
    for (i, color) in colors.into_iter().enumerate() {
        let (rest, none) = (small.splats(), Scenery::new(37, 0, 1.0, 1.0));
        let parts = vec![Part::new(&scene.out, color), none.splats().parts[0], rest.parts[0]];
        let splats = Splats { parts, head: None };
        compare(&mut r, &shot(&splats, &camera), &pulled.all(), &format!("colour {i} and two layers"));
    }
    let nothing = Splats { parts: vec![], head: None };
    compare(&mut r, &shot(&nothing, &camera), &pulled.all(), "nothing");
}

/// Σ over a tile's pixels of what a record holds of each of its pairs, front to back in f64; the background's last.
fn records_of(
    camera: &Camera,
    config: &RenderConfig,
    (place, list): ([usize; 2], &[(u32, u32)]),
    (shapes, colors): (&[[f32; 8]], &[[f32; 4]]),
    pulled: &Pulled,
) -> (Vec<[f64; 12]>, [f64; 3]) {
    let mut out = vec![[0.0; 12]; list.len()];
    let mut d_background = [0.0; 3];
    let (w, h) = (camera.width, camera.height);
    for y in place[1] * TILE..((place[1] + 1) * TILE).min(h) {
        for x in place[0] * TILE..((place[0] + 1) * TILE).min(w) {
            let at = y * w + x;
            let plane = |p: &Planes<f32>, c: usize| f64::from(p.plane(c)[at]);
            let g = [0, 1, 2, 3].map(|c| if c < 3 { plane(&pulled.0[0], c) } else { plane(&pulled.0[2], 0) });
            // Weights first, so that the remaining light is known exactly.
            let (mut t, mut seen) = (1.0, Vec::new());
            for (i, &(_, owner)) in list.iter().enumerate() {
                let splat = (owner & 0x0fff_ffff) as usize;
                let [cx, cy, _, _, a, b, c, opacity] = shapes[splat].map(f64::from);
                let (dx, dy) = (cx - x as f64 - 0.5, cy - y as f64 - 0.5);
                let power = -0.5 * (a * dx * dx + 2.0 * b * dx * dy + c * dy * dy);
                let raw = opacity * power.min(0.0).exp();
                if raw < config.alpha_min {
                    continue;
                }
                let alpha = raw.min(config.alpha_max);
                if t * (1.0 - alpha) < config.transmittance_min {
                    break;
                }
                let light: f64 = (0..4).map(|c| g[c] * f64::from(colors[splat][c])).sum();
                seen.push((i, splat, alpha, alpha * t, light, dx, dy, raw < config.alpha_max));
                t *= 1.0 - alpha;
            }
            let behind: f64 = (0..3).map(|c| g[c] * f64::from(BACKGROUND[c])).sum();
            let mut rest = t * (behind - plane(&pulled.0[1], 0));
            (0..3).for_each(|c| d_background[c] += t * g[c]);
            for &(i, splat, alpha, weight, light, dx, dy, free) in seen.iter().rev() {
                let v = if free { weight * light - alpha / (1.0 - alpha) * rest } else { 0.0 };
                rest += weight * light;
                let [a, b, c] = [4, 5, 6].map(|k| f64::from(shapes[splat][k]));
                let geometry = [v, v * dx, v * dx * dx, v * dy, v * dx * dy, v * dy * dy];
                let absolute = [v.abs() * (a * dx + b * dy).abs(), v.abs() * (b * dx + c * dy).abs()];
                for (k, s) in geometry.into_iter().chain(g.map(|g| weight * g)).chain(absolute).enumerate() {
                    out[i][k] += s;
                }
            }
        }
    }
    (out, d_background)
}

#[test]
fn each_kernel_equals_its_twin() {
    let Some(mut r) = renderer() else { return };
    println!("on {}", r.gpu.describe());
    each_equals_its_twin(&mut r);
}

#[test]
fn without_subgroups_each_kernel_equals_its_twin_too() {
    let Some(gpu) = gpu() else { return };
    let portable = gpu.tuned(Tuning { subgroups: false, ..Tuning::default() });
    assert!(!portable.has_subgroups());
    each_equals_its_twin(&mut GpuRenderer::new(portable, RenderConfig::default()).expect("the kernels compile"));
}

#[test]
fn with_pixels_in_vectors_each_kernel_equals_its_twin_too() {
    let Some(gpu) = gpu() else { return };
    let vectors = gpu.tuned(Tuning { back_vectors: true, ..Tuning::default() });
    each_equals_its_twin(&mut GpuRenderer::new(vectors, RenderConfig::default()).expect("the kernels compile"));
}

#[test]
fn with_a_lane_per_splat_each_kernel_equals_its_twin_too() {
    let Some(mut r) = with_lanes() else { return };
    each_equals_its_twin(&mut r);
}

/// A renderer whose blend's backward pass has a lane per splat.
fn with_lanes() -> Option<GpuRenderer> {
    let lanes = gpu()?.tuned(Tuning { back_lanes: true, ..Tuning::default() });
    println!("{} lanes on {}", lanes.lanes(), lanes.describe());
    assert_eq!(lanes.lanes() > 0, lanes.has_subgroups());
    Some(GpuRenderer::new(lanes, RenderConfig::default()).expect("the kernels compile"))
}

fn each_equals_its_twin(r: &mut GpuRenderer) {
    r.config.abs_grads = true;
    for (scene, camera) in [
        (Scenery::new(40, 500, 1.2, 0.06), camera([0.0, 0.5, -4.0], 131, 77)),
        (Scenery::new(41, 60, 0.8, 0.4), skewed(50, 61)),
    ] {
        let (splats, n) = (scene.splats(), scene.out.rows());
        let (shot, pulled) = (shot(&splats, &camera), Pulled::new(42, &camera));
        let (_, d, _) = back(r, &shot, &pulled.all());
        let (across, down) = (camera.width.div_ceil(TILE), camera.height.div_ceil(TILE));
        let pairs = r.stats().pairs;
        let shapes: Vec<[f32; 8]> = read(&r.gpu, &r.buffers.shapes, n);
        let colors: Vec<[f32; 4]> = read(&r.gpu, &r.buffers.colors, n);
        let marks: Vec<u32> = read(&r.gpu, &r.buffers.marks, n);
        let ranges: Vec<[u32; 3]> = read(&r.gpu, &r.buffers.ranges, across * down);
        let values: Vec<u32> = read(&r.gpu, &r.buffers.pair_values[frame::tile_passes(across * down) % 2], pairs);
        let owners: Vec<u32> = read(&r.gpu, &r.buffers.owners, pairs);
        let records: Vec<[f32; 12]> = read(&r.gpu, &r.buffers.records, pairs);
        assert_eq!(size_of_val(&records[0]) as u64, RECORD_BYTES);
        // 1: the tiles' records.
        let (mut expected, mut d_background) = (vec![[0.0; 12]; pairs], [0.0; 3]);
        for (tile, [first, end, _]) in ranges.iter().enumerate() {
            let list: Vec<(u32, u32)> =
                values[*first as usize..*end as usize].iter().map(|&p| (p, owners[p as usize])).collect();
            let place = [tile % across, tile / across];
            let (sums, background) = records_of(&camera, &r.config, (place, &list), (&shapes, &colors), &pulled);
            list.iter().zip(sums).for_each(|((pair, _), sum)| expected[*pair as usize] = sum);
            (0..3).for_each(|c| d_background[c] += background[c]);
        }
        let mut outside = 0;
        for k in 0..12 {
            let rms = (expected.iter().map(|e| e[k] * e[k]).sum::<f64>() / pairs as f64).sqrt();
            assert!(rms > 0.0, "sum {k} is always 0");
            outside +=
                records.iter().zip(&expected).filter(|(a, b)| (f64::from(a[k]) - b[k]).abs() > RECORD * rms).count();
        }
        // A pixel at the α cut-off may count on one side only.
        assert!(outside * 500 <= 12 * pairs, "{outside} of {} sums are others than in f64", 12 * pairs);
        assert!(apart(d.background.iter().map(|v| f64::from(*v)), d_background.into_iter()) < VECTOR);
        // 2: the sums of each splat, in the order of its pairs: the same bits.
        let sums: Vec<[f32; 12]> = read(&r.gpu, &r.buffers.sums, n);
        let mut added = vec![[0.0f32; 12]; n];
        for (record, owner) in records.iter().zip(&owners) {
            let sum = &mut added[(owner & 0x0fff_ffff) as usize];
            (0..12).for_each(|k| sum[k] += record[k]);
        }
        for j in (0..n).filter(|&j| marks[j] != 0) {
            assert_eq!(sums[j], added[j], "splat {j}");
        }
        // 3: the projection's VJP.
        let view = View::new(&camera, &r.config);
        let rows: Vec<[f32; 20]> = read(&r.gpu, &r.buffers.back, n);
        let mut pairs_of_rows: Vec<(f64, f64)> = Vec::new();
        for j in 0..n {
            let (mean, cov) = (scene.out.read(j, 0), scene.out.read(j, 3));
            let opacity = scene.out.get(j, 9);
            let Some(p) = project::project(&view, mean, cov, opacity).filter(|_| marks[j] == 2) else {
                assert_eq!(rows[j], [0.0; 20], "splat {j} was not drawn");
                continue;
            };
            let (s, [a, b, c]) = (sums[j], p.conic);
            let d = ProjectedGrads {
                mean2d: [-(a * s[1] + b * s[3]), -(b * s[1] + c * s[3])],
                conic: [-0.5 * s[2], -s[4], -0.5 * s[5]],
                opacity: s[0] / p.opacity,
                depth: s[9],
                ..ProjectedGrads::default()
            };
            let g = project::project_backward(&view, mean, cov, opacity, &p, &d);
            let twin = g.mean.into_iter().chain([g.opacity]).chain(g.cov);
            // Each number against the largest of its splat's, so that large splats do not hide small ones.
            let most = g.mean.iter().chain(&g.cov).fold(g.opacity.abs(), |m, v| m.max(v.abs())).max(f32::MIN_POSITIVE);
            pairs_of_rows.extend(rows[j].into_iter().zip(twin).map(|(a, b)| ((a / most).into(), (b / most).into())));
        }
        assert!(pairs_of_rows.len() > n, "the test must see something");
        let (a, b) = (pairs_of_rows.iter().map(|p| p.0), pairs_of_rows.iter().map(|p| p.1));
        let off = apart(a, b);
        assert!(off < 2e-3, "the projection's VJP is off by {off:.1e}");
    }
}

#[test]
fn the_backward_pass_repeats_bit_for_bit_in_bands() {
    for r in [own_renderer(), with_lanes()].into_iter().flatten() {
        repeats_in_bands(r);
    }
}

fn repeats_in_bands(mut r: GpuRenderer) {
    r.for_training().expect("the kernels compile");
    let (scene, camera) = (Scenery::new(50, 4000, 1.2, 0.08), camera([0.0, 0.5, -4.0], 150, 110));
    let (splats, pulled) = (scene.splats(), Pulled::new(51, &camera));
    let shot = shot(&splats, &camera);
    let (_, first, first_sh) = back(&mut r, &shot, &pulled.all());
    let (pairs, most) = (r.stats().pairs, r.most_pairs);
    let (_, second, second_sh) = back(&mut r, &shot, &pulled.all());
    let all = |d: &RenderGrads<f32>, sh: &[Option<Table<f32>>]| {
        named(d, sh).into_iter().filter(|(name, _)| name != "background").collect::<Vec<_>>()
    };
    assert!(first.background == second.background && all(&first, &first_sh) == all(&second, &second_sh));
    assert!(r.timings().back_total > 0.0 && r.timings().back_wait > 0.0);
    // Smaller buffers than one image's pairs: bands, whose records are made one after the other.
    r.most_pairs = pairs / 3;
    (r.buffers, r.groups) = (Buffers::new(), None);
    let (_, bands, bands_sh) = back(&mut r, &shot, &pulled.all());
    assert!(r.stats().bands > 2 && r.stats().pairs == pairs);
    assert!(all(&first, &first_sh) == all(&bands, &bands_sh), "bands change no bit");
    assert!(first.background == bands.background);
    // Small buffers at first, which must overflow, then larger ones.
    (r.most_pairs, r.buffers, r.groups) = (most, Buffers::new(), None);
    r.make_room_for_pairs(1000).expect("a little room");
    let (_, grown, grown_sh) = back(&mut r, &shot, &pulled.all());
    assert!(r.stats().bands == 1 && all(&first, &first_sh) == all(&grown, &grown_sh), "room changes no bit");
}

#[test]
fn small_bindings_cut_tables_and_images_and_change_no_bit() {
    /// Bytes of the largest binding: 2,720 rows of colours of degree 3.
    const SMALL: u64 = 1 << 19;
    let Some(mut r) = own_renderer() else { return };
    let small = Gpu::open_within(Adapters::Any, SMALL).expect("there is one");
    assert_eq!(largest_binding(&small), SMALL);
    let mut poor = GpuRenderer::new(small, RenderConfig::default()).expect("the kernels compile");
    for r in [&mut r, &mut poor] {
        r.for_training().expect("the kernels compile");
        r.tables = Tables::Constant;
    }
    let (scene, camera) = (Scenery::new(90, 6000, 1.2, 0.02), camera([0.0, 0.5, -4.0], 250, 170));
    let pulled = Pulled::new(91, &camera);
    // All rows, then two of three.
    let ids: Vec<u32> = (0..6000).filter(|i| i % 3 != 1).collect();
    let some = Scenery::new(92, ids.len(), 1.2, 0.02);
    for (what, geometry, rows) in [("all", &scene, Rows::All), ("some", &some, Rows::Some(&ids))] {
        let color = Color::Sh { table: &scene.sh, rows, weights: None, base: true };
        let splats = Splats { parts: vec![Part::new(&geometry.out, color)], head: None };
        let shot = shot(&splats, &camera);
        let (expected, d, d_sh) = back(&mut r, &shot, &pulled.all());
        assert!(r.upload.draws.len() == 1 && r.stats().bands == 1, "{what}: there is room");
        // The second time its colours are there.
        for again in [false, true] {
            let (image, other, other_sh) = back(&mut poor, &shot, &pulled.all());
            assert!(poor.upload.draws.len() == 3 && poor.stats().bands > 1, "{what}: {:?}", poor.stats());
            assert!(image == expected, "{what}, {again}: the picture in pages is the same, bit for bit");
            for ((name, a), (_, b)) in named(&d, &d_sh).into_iter().zip(named(&other, &other_sh)) {
                // The camera's are summed by workgroup, of which every page has its own, the background's by band.
                let most = if ["pose", "focal", "background"].contains(&&*name) { VECTOR } else { 0.0 };
                let off = apart(b.into_iter(), a.into_iter());
                assert!(off <= most, "{what}, {again}: {name} differs by {off:.1e}");
            }
        }
        compare(&mut poor, &shot, &pulled.all(), what);
    }
    // Pairs that no page can hold are an error: here a row of tiles.
    let wide = Camera { width: 6000, ..camera };
    let splats = scene.splats();
    let error = poor.render(&shot(&splats, &wide), &mut Image::default()).expect_err("it is too wide");
    assert!(error.to_string().contains("too large for the GPU"), "{error}");
}

#[test]
fn a_device_that_is_lost_is_an_error_and_not_a_panic() {
    let Some(mut r) = own_renderer() else { return };
    let (scene, camera) = (Scenery::new(70, 200, 1.0, 0.1), camera([0.0, 0.5, -4.0], 40, 30));
    let (splats, pulled) = (scene.splats(), Pulled::new(71, &camera));
    let shot = shot(&splats, &camera);
    let (mut image, mut d) = (Image::default(), RenderGrads::default());
    r.render(&shot, &mut image).expect("it is drawn");
    r.gpu.device.destroy();
    assert!(r.vjp(&shot, &pulled.all(), &mut [None], &mut d).is_err(), "it does not come back");
    assert!(r.render(&shot, &mut image).is_err(), "it is not drawn");
}

#[test]
fn a_non_finite_gradient_is_an_error_and_the_next_is_not() {
    let Some(mut r) = renderer() else { return };
    let (scene, camera) = (Scenery::new(60, 300, 1.0, 0.1), camera([0.0, 0.5, -4.0], 40, 30));
    let (splats, mut pulled) = (scene.splats(), Pulled::new(61, &camera));
    let shot = shot(&splats, &camera);
    pulled.0[0].data[600] = f32::NAN;
    let (mut image, mut d) = (Image::default(), RenderGrads::default());
    r.render(&shot, &mut image).expect("it is drawn");
    let error = r.vjp(&shot, &pulled.all(), &mut [None], &mut d).expect_err("NaN is no gradient");
    assert!(error.to_string().contains("not a finite number"), "{error}");
    pulled.0[0].data[600] = 0.0;
    compare(&mut r, &shot, &pulled.all(), "after an error");
}
