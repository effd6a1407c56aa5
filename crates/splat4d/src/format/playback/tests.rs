//! Round trips, error bounds, partial and hostile files.

mod coder;
mod conformance;
mod features;
mod grow;
mod hostile;
mod labels;
mod ladder;
mod masks;
mod sound;

use super::block::encode_page;
use super::index::crc;
use super::page::{Record, parse_page};
use super::*;
use crate::layers::{Evaluation, Scene};
use crate::math::{Rng, Se3, quat};
use crate::render::{Image, RenderConfig, Renderer, Shot};
use crate::scene::{Camera, Time};

/// A file that version 1.0 of the writer made from [`tiny`], byte for byte.
const GOLDEN: &[u8] = include_bytes!("../../../tests/data/tiny.s4d");

/// A Gaussian of a synthetic scene. One in three has an infinite lifespan.
fn primitive(r: Rng) -> Primitive {
    let three = |first: u64, by: f64| std::array::from_fn(|k| (by * r.normal(first + k as u64)) as f32);
    let width = if r.below(0, 3) == 0 { f64::INFINITY } else { (r.uniform(1) - 0.5).max(0.0) };
    let size = -3.5 + 0.5 * r.normal(2);
    Primitive {
        mean: std::array::from_fn(|k| 0.8 * r.normal(10 + k as u64)),
        center: 1.2 * r.uniform(3) - 0.1,
        half_width: width,
        softness: (-3.0 + r.normal(4)).exp(),
        quat: std::array::from_fn(|k| r.normal(20 + k as u64) as f32),
        scales: std::array::from_fn(|k| (size + 0.5 * r.normal(30 + k as u64)).exp() as f32),
        opacity: r.uniform(5) as f32,
        velocity: three(40, 0.5),
        turn: three(50, 1.0),
        base_color: std::array::from_fn(|k| (0.5 + 0.3 * r.normal(60 + k as u64)) as f32),
        sh_rest: std::array::from_fn(|k| (0.05 * r.normal(100 + k as u64)) as f32),
        importance: r.uniform(6) as f32,
        label: None,
        features: Vec::new(),
    }
}

/// A clip of one second with a root and two halves, `n` Gaussians in all.
fn made_up(n: usize, sh_degree: usize, seed: u64) -> Draft {
    let rng = Rng::new(seed, "made up", 0);
    let spans = [[0.0, 1.04], [0.0, 0.5], [0.5, 1.04]];
    let nodes = spans.iter().enumerate().map(|(node, &[from, to])| {
        let count = if node == 0 { n - 2 * (n / 4) } else { n / 4 };
        let primitives = (0..count).map(|i| primitive(rng.fork((node * n + i) as u64))).collect();
        Node { from, to, primitives }
    });
    let camera =
        NamedCamera { name: "left".into(), width: 64, height: 48, fx: 60.0, fy: 60.0, ..NamedCamera::default() };
    let meta = Meta {
        clip: [0.0, 1.0],
        fps: 25.0,
        up: [0.0, -1.0, 0.0],
        background: [0.1, 0.2, 0.3],
        sh_degree,
        title: "Größe \"1\"".into(),
        cameras: vec![camera],
        ..Meta::default()
    };
    Draft { meta, nodes: nodes.collect(), poster: Some(b"not really a picture".to_vec()) }
}

/// A draft that the golden file was made of: simple numbers, two nodes, degree 1, one Gaussian that moves, one that
/// turns.
fn tiny() -> Draft {
    let still = Primitive {
        mean: [0.0, 0.5, 2.0],
        center: 0.5,
        half_width: f64::INFINITY,
        softness: 1.0,
        quat: [1.0, 0.0, 0.0, 0.0],
        scales: [0.1, 0.2, 0.3],
        opacity: 0.8,
        velocity: [0.0; 3],
        turn: [0.0; 3],
        base_color: [0.25, 0.5, 0.75],
        sh_rest: std::array::from_fn(|k| if k < 9 { 0.01 * k as f32 } else { 0.0 }),
        importance: 1.0,
        label: None,
        features: Vec::new(),
    };
    let moving = Primitive {
        mean: [1.0, -0.5, 3.0],
        center: 0.25,
        half_width: 0.1,
        softness: 0.05,
        velocity: [2.0, 0.0, -1.0],
        turn: [0.0, 1.5, 0.0],
        opacity: 1.0,
        sh_rest: [0.0; 45],
        ..still.clone()
    };
    let mut draft = made_up(4, 1, 0);
    draft.nodes = vec![
        Node { from: 0.0, to: 1.04, primitives: vec![still] },
        Node { from: 0.0, to: 0.52, primitives: vec![moving] },
    ];
    draft
}

fn bytes_of(draft: &Draft, config: &WriteConfig) -> (Vec<u8>, Summary) {
    let mut bytes = Vec::new();
    let summary = write(draft, config, &mut bytes).unwrap();
    (bytes, summary)
}

fn stored<'a>(bytes: &'a [u8], e: &Entry) -> &'a [u8] {
    &bytes[e.offset as usize..e.offset as usize + e.stored as usize]
}

/// Rows as one page, encoded and decoded.
fn through(rows: &[(&Primitive, u16)], span: [f64; 2]) -> Page {
    let entry = Entry {
        kind: Kind::Page,
        required: true,
        offset: 0,
        stored: 0,
        bytes: 0,
        crc: 0,
        codec: Codec::Raw,
        tier: 0,
        degree: 0,
        count: rows.len() as u32,
        span,
        palette: None,
        page: None,
    };
    parse_page(&encode_page(rows, span, &Depths::default()), &entry).unwrap()
}

#[test]
fn every_attribute_stays_within_half_a_step() {
    let draft = made_up(4000, 0, 1);
    for node in &draft.nodes {
        let span = [node.from, node.to];
        let rows: Vec<_> = node.primitives.iter().enumerate().map(|(i, p)| (p, i as u16)).collect();
        let page = through(&rows, span);
        let mut worst = [0.0f64; 9];
        for (i, (p, label)) in rows.iter().enumerate() {
            let (r, h) = (page.record(i), page.headers[i / BLOCK_GAUSSIANS].map(f64::from));
            assert_eq!(r.label, *label);
            let through_all = p.center - p.half_width <= span[0] && span[1] <= p.center + p.half_width;
            assert_eq!(r.half_width.is_infinite(), through_all);
            let length = span[1] - span[0];
            let reach = if through_all { 0.5 * length } else { (r.half_width + 3.0 * r.softness).min(length) };
            let ratio = |error: f64, step: f64| error.abs() / (0.5 * step).max(1e-12);
            let mut see = |k: usize, x: f64| worst[k] = worst[k].max(x);
            for k in 0..3 {
                let there = p.mean[k] + f64::from(p.velocity[k]) * (r.center - p.center);
                see(0, ratio(r.mean[k] - there, (h[3 + k] - h[k]) / 65_535.0));
                see(1, ratio((r.scales[k] / f64::from(p.scales[k])).ln(), (h[11] - h[10]) / 255.0));
                see(2, ratio((r.velocity[k] - f64::from(p.velocity[k])) * reach, h[12] / 511.0));
                see(3, ratio(r.base_color[k] - f64::from(p.base_color[k]), (h[21 + k] - h[18 + k]) / 255.0));
            }
            see(4, ratio(r.opacity - f64::from(p.opacity), 1.0 / 255.0));
            if !through_all {
                see(5, ratio(r.center - p.center, (h[7] - h[6]) / 65_535.0));
                see(6, ratio((r.softness / p.softness).ln(), (h[17] - h[16]) / 255.0));
                // Widths far below the softness become zero by intent.
                let wide = p.half_width > 0.02 * p.softness;
                let error = if wide { (r.half_width / p.half_width).ln() } else { r.half_width };
                see(7, ratio(error, (h[15] - h[14]) / 253.0));
            }
            // The rotation that the motion has at the decoded centre, and 2.5/511 radians as quant.rs declares.
            let start = quat::normalize(p.quat.map(f64::from)).0;
            let rate = page::rate(start, p.turn.map(f64::from));
            let q = quat::normalize::<f64>(std::array::from_fn(|k| start[k] + (r.center - p.center) * rate[k])).0;
            let dot = (0..4).map(|k| q[k] * r.quat[k]).sum::<f64>().abs();
            see(8, 2.0 * dot.min(1.0).acos() / (2.5 / 511.0));
        }
        // The range's own rounding to f32 adds a little to the smallest steps.
        assert!(worst.iter().all(|w| (0.4..1.02).contains(w)), "errors in half steps: {worst:?}");
    }
}

#[test]
fn turns_keep_the_rotation_over_the_whole_span() {
    let draft = made_up(800, 0, 2);
    let node = &draft.nodes[0];
    let rows: Vec<_> = node.primitives.iter().map(|p| (p, 0)).collect();
    let page = through(&rows, [node.from, node.to]);
    for (i, p) in node.primitives.iter().enumerate() {
        let r = page.record(i);
        let most = f64::from(page.headers[i / BLOCK_GAUSSIANS][13]);
        for t in [0.0, 0.3, 0.7, 1.0] {
            let at = |q: [f64; 4], w: [f64; 3], delta: f64| {
                let rate = page::rate(q, w);
                quat::normalize::<f64>(std::array::from_fn(|k| q[k] + delta * rate[k])).0
            };
            let want = at(quat::normalize(p.quat.map(f64::from)).0, p.turn.map(f64::from), t - p.center);
            let have = at(r.quat, r.turn, t - r.center);
            let angle = 2.0 * (0..4).map(|k| want[k] * have[k]).sum::<f64>().abs().min(1.0).acos();
            let alive = p.half_width.is_infinite() || (t - p.center).abs() < p.half_width + 3.0 * p.softness;
            // Half a step on three axes over a reach that is at most four times as long for the farthest time, the
            // rotation's own bound, and a rest for the centre's code.
            let bound = 2.5 / 511.0 + 4.0 * 0.87 * most / 511.0 + 0.003;
            assert!(!alive || angle < bound, "Gaussian {i} at {t}: {angle} against {bound}");
        }
    }
}

#[test]
fn a_block_is_alive_whenever_one_of_its_gaussians_is_seen() {
    let draft = made_up(3000, 0, 3);
    let node = &draft.nodes[0];
    let mut order: Vec<u32> = (0..node.primitives.len() as u32).collect();
    order::sort(&mut order, &node.primitives, [node.from, node.to]);
    let rows: Vec<_> = order.iter().map(|&i| (&node.primitives[i as usize], 0)).collect();
    let page = through(&rows, [node.from, node.to]);
    let (mut dead, mut total) = (0, 0);
    for (k, h) in page.headers.iter().enumerate() {
        let records: Vec<Record> = (256 * k..page.len().min(256 * (k + 1))).map(|i| page.record(i)).collect();
        for step in 0..400 {
            let t = node.from + (node.to - node.from) * f64::from(step) / 400.0;
            let seen = |r: &Record| {
                let e = ((t - r.center).abs() - r.half_width).max(0.0) / r.softness;
                let sigma = if r.half_width.is_infinite() { 1.0 } else { (-0.5 * e * e).exp() };
                r.opacity * sigma >= 1.0 / 255.0
            };
            let alive = f64::from(h[8]) <= t && t <= f64::from(h[9]);
            assert!(alive || !records.iter().any(seen), "block {k} is declared dead at {t}");
            dead += usize::from(!alive);
            total += 1;
        }
    }
    assert!(dead * 20 > total, "the order makes blocks that can be culled by life: {dead} of {total}");
}

/// Errors of the means of the first `n` Gaussians of a page after encoding, scene units, the largest first.
fn errors_of_means(primitives: &[Primitive], n: usize) -> Vec<f64> {
    let mut order: Vec<u32> = (0..primitives.len() as u32).collect();
    order::sort(&mut order, primitives, [0.0, 1.0]);
    let rows: Vec<_> = order.iter().map(|&i| (&primitives[i as usize], 0)).collect();
    let page = through(&rows, [0.0, 1.0]);
    let error = |row: usize| {
        let (mean, coded) = (rows[row].0.mean, page.record(row).mean);
        (0..3).map(|k| (mean[k] - coded[k]).abs()).fold(0.0, f64::max)
    };
    let near = (0..rows.len()).filter(|&row| (order[row] as usize) < n);
    let mut errors: Vec<f64> = near.map(error).collect();
    errors.sort_by(|a, b| b.total_cmp(a));
    errors
}

#[test]
fn a_far_shell_takes_no_bits_from_what_is_near() {
    let rng = Rng::new(4, "shell", 0);
    let still = |i: usize| {
        let rest = [0.0; 3];
        let p = primitive(rng.fork(i as u64));
        Primitive { half_width: f64::INFINITY, center: 0.5, velocity: rest, turn: rest, ..p }
    };
    let far = |i: usize| {
        let p = still(i);
        let size = p.mean.iter().map(|x| x * x).sum::<f64>().sqrt();
        Primitive { mean: p.mean.map(|x| 2000.0 * x / size), scales: [30.0; 3], ..p }
    };
    // As many near ones as fill their blocks, and a few more: those share a block with far ones.
    for (n, mixed) in [(12 * 256, 0), (12 * 256 + 100, 100)] {
        let near: Vec<Primitive> = (0..n).map(still).collect();
        let both: Vec<Primitive> = near.iter().cloned().chain((n..n + 1500).map(far)).collect();
        let (alone, together) = (errors_of_means(&near, n), errors_of_means(&both, n));
        assert!(together[mixed] <= 1.1 * alone[0], "{n}: {} against {}", together[mixed], alone[0]);
    }
}

/// An image from in front at time t.
fn picture(scene: &Scene<f32>, t: f64) -> Vec<f32> {
    let camera = Camera::with_fov_y(Se3::look_at([0.5, -1.0, -4.0], [0.0; 3], scene.up), 0.8, 96, 80);
    let (mut instant, mut image) = (Evaluation::default(), Image::default());
    scene.at(Time(t), &mut instant);
    Renderer::new(RenderConfig::default())
        .render(&Shot::new(&scene.splats(&instant), &camera, scene.background), &mut image);
    image.color.data
}

/// The draft's floats as a scene, without quantisation.
fn floats(draft: &Draft) -> Scene<f32> {
    use crate::motion::{Spacetime, SpacetimeSpec};
    use crate::scene::{GEOMETRY, LIFE, LifeKind, Params, SH};
    let coefficients = crate::math::sh::coeffs(draft.meta.sh_degree);
    let layer = |node: &Node| {
        let life = LifeKind::Interval;
        let mut params = Params::new(node.primitives.len(), coefficients, life.columns());
        let spec = SpacetimeSpec { order: 1, rotation: true, ..SpacetimeSpec::default() };
        let motion = Spacetime::new(spec, &mut params).unwrap();
        let [geometry, sh, lives, velocities, rates] =
            params.get_mut([GEOMETRY, SH, LIFE, motion.velocities(), motion.rates()]);
        for (i, p) in node.primitives.iter().enumerate() {
            let q = quat::normalize(p.quat).0;
            geometry.write(i, 0, p.mean.map(|x| x as f32));
            geometry.write(i, 3, q);
            geometry.write(i, 7, p.scales.map(f32::ln));
            geometry.set(i, 10, (p.opacity / (1.0 - p.opacity)).ln());
            sh.write(i, 0, p.base_color.map(crate::math::sh::rgb_to_dc));
            (3..3 * coefficients).for_each(|c| sh.set(i, c, p.sh_rest[c - 3]));
            lives.write(i, 0, [p.center, p.half_width.clamp(1e-9, 1e9).ln(), p.softness.ln()].map(|x| x as f32));
            velocities.write(i, 0, p.velocity);
            rates.write(i, 0, page::rate(q.map(f64::from), p.turn.map(f64::from)).map(|x| x as f32));
        }
        let span = [node.from, node.to];
        crate::layers::Layer { span, ..crate::layers::Layer::new("", params, std::sync::Arc::new(motion), life) }
    };
    Scene {
        layers: draft.nodes.iter().map(layer).collect(),
        background: draft.meta.background,
        clip: draft.meta.clip,
        fps: draft.meta.fps,
        up: draft.meta.up,
        ..Scene::default()
    }
}

#[test]
fn images_of_the_file_are_those_of_the_floats() {
    // Synthetic coefficients are noise, the worst case for a palette: here they have an entry each, like degree 0 to 2.
    for (degree, least) in [(0, 45.0), (2, 40.0)] {
        let draft = made_up(2400, degree, 4);
        let (bytes, summary) = bytes_of(&draft, &WriteConfig::default());
        let (back, truth) = (read(&bytes).unwrap(), floats(&draft));
        assert_eq!((back.len(), summary.gaussians), (2400, 2400));
        assert_eq!(
            (back.clip, back.fps, back.up, back.background),
            (truth.clip, truth.fps, truth.up, truth.background)
        );
        for t in [0.0, 0.21, 0.5, 0.93] {
            let (a, b) = (picture(&truth, t), picture(&back, t));
            let error = a.iter().zip(&b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / a.len() as f64;
            let psnr = -10.0 * error.log10();
            assert!(psnr > least, "degree {degree} at {t}: {psnr:.1} dB");
            assert!(a.iter().any(|x| (x - a[0]).abs() > 0.2), "there is something to see");
        }
    }
}

#[test]
fn sections_are_ordered_as_a_player_needs_them() {
    let draft = made_up(40_000, 1, 5);
    let config = WriteConfig { kmeans_rounds: 1, ..WriteConfig::default() };
    let (bytes, summary) = bytes_of(&draft, &config);
    let index = Index::parse(&bytes, None).unwrap();
    assert_eq!(summary.bytes, bytes.len() as u64);
    let order: Vec<(String, u16, f64)> = index.sections.iter().map(|e| (e.kind.name(), e.tier, e.span[0])).collect();
    let want = [
        ("POST", 0, 0.0),
        ("PAGE", 0, 0.0), // the important part of the root, and of the first half
        ("PAGE", 0, 0.0),
        ("PALT", 0, 0.0),
        ("PAGE", 1, 0.0),
        ("PAGE", 1, 0.0),
        ("PAGE", 0, 0.5),
        ("PAGE", 1, 0.5),
    ];
    assert_eq!(order, want.map(|(k, tier, from)| (k.to_owned(), tier, from)));
    assert!(index.sections.is_sorted_by_key(|e| e.offset), "the table's order is the file's");
    // What is in the first tier is more important than what is not.
    let least = |e: &Entry| decode_page(e, stored(&bytes, e)).unwrap().len();
    let pages: Vec<usize> = index.pages_at(0.2).iter().map(|(_, e)| least(e)).collect();
    assert_eq!(pages, [8000, 4096, 12_000, 5904]);
    assert_eq!(index.pages_at(0.7).len(), 4);
    assert_eq!(index.pages_at(9.0).len(), 4, "times are clamped to the clip");
}

#[test]
fn more_gaussians_than_a_page_holds() {
    let mut draft = made_up(4, 0, 6);
    let node = &mut draft.nodes[0];
    let first = node.primitives[0].clone();
    node.primitives = (0..90_000).map(|i| Primitive { importance: (i % 7) as f32, ..first.clone() }).collect();
    let (bytes, _) = bytes_of(&draft, &WriteConfig { tier: 10_000, ..WriteConfig::default() });
    let index = Index::parse(&bytes, None).unwrap();
    let counts: Vec<(u16, u32)> = index.pages().map(|(_, e)| (e.tier, e.count)).filter(|c| c.1 > 1).collect();
    assert_eq!(counts, [(0, 10_000), (1, 40_000), (2, 40_000)]);
    assert_eq!(index.sections.iter().filter(|e| e.kind == Kind::Palette).count(), 0, "degree 0 needs no palette");
    assert_eq!(read(&bytes).unwrap().len(), 90_002);
}

#[test]
fn a_large_scene_begins_with_a_coarse_image_below_1_mb() {
    let mut draft = made_up(4, 0, 6);
    let rng = Rng::new(6, "large", 0);
    draft.nodes =
        vec![Node { primitives: (0..150_000).map(|i| primitive(rng.fork(i))).collect(), from: 0.0, to: 1.04 }];
    let (bytes, _) = bytes_of(&draft, &WriteConfig { deflate_level: 1, ..WriteConfig::default() });
    let index = Index::parse(&bytes, None).unwrap();
    let counts: Vec<u32> = index.pages().map(|(_, e)| e.count).collect();
    let first = index.pages().find(|(_, e)| e.tier == 0).map(|(_, e)| e.offset + u64::from(e.stored)).unwrap();
    assert!(first < 1_000_000, "{first} bytes of {}", bytes.len());
    assert!(counts.len() > 2 && counts[0] < counts[1] && counts.iter().sum::<u32>() == 150_000, "{counts:?}");
}

#[test]
fn the_same_bytes_with_any_number_of_threads() {
    let draft = made_up(6000, 2, 7);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| crc(&bytes_of(&draft, &WriteConfig::default()).0))
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn the_first_pages_of_a_file_render() {
    let (bytes, _) = bytes_of(&made_up(40_000, 1, 8), &WriteConfig { kmeans_rounds: 1, ..WriteConfig::default() });
    assert_eq!(Index::needed(b"").unwrap(), 64);
    assert_eq!(Index::needed(&bytes[..63]).unwrap(), 64);
    let needed = Index::needed(&bytes[..64]).unwrap();
    let index = Index::parse(&bytes[..needed], Some(bytes.len() as u64)).unwrap();
    assert_eq!(index, Index::parse(&bytes, None).unwrap());
    assert!(Index::parse(&bytes[..needed - 1], None).is_err());
    let (_, page) = index.pages().next().unwrap();
    let cut = &bytes[..(page.offset + u64::from(page.stored)) as usize];
    let page = decode_page(page, stored(cut, page)).unwrap();
    assert_eq!(page.record(0).scales.len(), 3);
    let error = read(cut).unwrap_err().to_string();
    assert!(error.contains("cut short"), "{error}");
}

#[test]
fn a_file_of_version_1_0_stays_readable() {
    let index = Index::parse(GOLDEN, Some(GOLDEN.len() as u64)).unwrap();
    let mut meta = tiny().meta;
    meta.gaussians = 2;
    assert_eq!((index.version, index.meta), ([1, 0], meta));
    let kinds: Vec<Kind> = index.sections.iter().map(|e| e.kind).collect();
    assert_eq!(kinds, [Kind::Poster, Kind::Page, Kind::Page, Kind::Palette]);
    assert_eq!(stored(GOLDEN, &index.sections[0]), b"not really a picture");
    let palette = decode_palette(&index.sections[3], stored(GOLDEN, &index.sections[3])).unwrap();
    for (e, node) in index.sections[1..3].iter().zip(&tiny().nodes) {
        let (r, p) = (decode_page(e, stored(GOLDEN, e)).unwrap().record(0), &node.primitives[0]);
        let close = |a: f64, b: f64| assert!((a - b).abs() < 2e-3 * (1.0 + b.abs()), "{a} is not {b}: {r:?}");
        assert_eq!(e.span, [node.from, node.to]);
        let center = if p.half_width.is_finite() { p.center } else { 0.52 };
        close(r.center, center);
        (0..3).for_each(|k| close(r.mean[k], p.mean[k]));
        (0..3).for_each(|k| close(r.scales[k], f64::from(p.scales[k])));
        (0..3).for_each(|k| close(r.velocity[k], f64::from(p.velocity[k])));
        (0..3).for_each(|k| close(r.turn[k], f64::from(p.turn[k])));
        (0..3).for_each(|k| close(r.base_color[k], f64::from(p.base_color[k])));
        (0..4).for_each(|k| close(r.quat[k], f64::from(p.quat[k])));
        (0..9).for_each(|k| {
            close(f64::from(palette.value(usize::from(r.label), k)), f64::from(p.sh_rest[k]));
        });
        close(r.opacity, f64::from(p.opacity));
        if p.half_width.is_finite() {
            close(r.half_width, p.half_width);
            close(r.softness, p.softness);
        } else {
            assert!(r.half_width.is_infinite());
        }
    }
}

/// Writes the golden file again when `UPDATE_GOLDEN` is set: only for a new version of the format.
#[test]
fn golden_file_is_written_only_on_request() {
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        let place = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/tiny.s4d");
        std::fs::write(place, bytes_of(&tiny(), &WriteConfig::default()).0).unwrap();
    }
}

#[test]
fn unsupported_content_is_named_when_writing() {
    let refused = |change: fn(&mut Draft)| {
        let mut draft = made_up(40, 1, 9);
        change(&mut draft);
        write(&draft, &WriteConfig::default(), &mut Vec::new()).unwrap_err().to_string()
    };
    assert!(refused(|d| d.nodes[1].primitives[3].mean[2] = f64::NAN).contains("node 1: Gaussian 3"));
    assert!(refused(|d| d.nodes[0].primitives[0].sh_rest[44] = f32::INFINITY).contains("Gaussian 0"));
    assert!(refused(|d| d.nodes[2].to = 0.1).contains("node 2"));
    assert!(refused(|d| d.meta.clip = [1.0, 0.0]).contains("clip"));
    assert!(refused(|d| d.meta.sh_degree = 4).contains("sh_degree"));
    // Nothing at all is a file without pages, and odd Gaussians are rendered as well as they can be.
    let mut empty = made_up(4, 1, 9);
    empty.nodes.clear();
    assert_eq!(read(&bytes_of(&empty, &WriteConfig::default()).0).unwrap().len(), 0);
    let mut odd = made_up(40, 1, 9);
    odd.nodes[0].primitives[0].scales = [0.0; 3];
    odd.nodes[0].primitives[1].quat = [0.0; 4];
    odd.nodes[0].primitives[2].softness = 0.0;
    odd.nodes[0].primitives[3].mean = [1e30, -1e30, 0.0];
    assert!(picture(&read(&bytes_of(&odd, &WriteConfig::default()).0).unwrap(), 0.2).iter().all(|x| x.is_finite()));
}
