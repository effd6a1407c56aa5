//! Learning behind a codec: the same image as the file's, gradients past the rounding, a palette that is a sum, a state
//! that round-trips.

use super::*;
use crate::capture::frames::{Frames, Picture};
use crate::loss::terms::StepInfo;
use crate::maintenance::Limits;
use crate::step::chain::{Chain, Losses, Step, View};
use crate::step::loss::TrainLoss;
use crate::step::tests::Made;
use crate::step::trainer::{Settings, Trainer};
use splat4d::format::playback::{Draft, Node, Primitive, WriteConfig, read, read_pages, write, write_pages};
use splat4d::math::Rng;
use splat4d::render::{RenderConfig, Renderer};
use splat4d::scene::{GEOMETRY, Rows};

/// Colour of the synthetic sky, about.
const SKY: [f32; 3] = [0.2, 0.3, 0.6];
/// So coarse that a rounding is seen.
fn coarse() -> Depths {
    Depths { position: 9, scale: 5, opacity: 4, rotation: 6, shift: 5, color: 4, ..Depths::default() }
}

/// The bytes of a file of random Gaussians: one page for all the clip, one for its first half.
fn file(rows: usize) -> Vec<u8> {
    let rng = Rng::new(4, "file", 0);
    let primitive = |i: usize| {
        let rng = rng.fork(i as u64);
        let f = |k: u64| rng.normal(k) as f32;
        Primitive {
            mean: [0u64, 1, 2].map(|k| 0.5 * rng.normal(k)),
            center: 0.2 * rng.uniform(3),
            half_width: if i.is_multiple_of(3) { f64::INFINITY } else { 0.05 * rng.uniform(4) },
            softness: 0.02 + 0.03 * rng.uniform(5),
            quat: [f(6), f(7), f(8), f(9)],
            scales: [10u64, 11, 12].map(|k| 0.2 * (0.3 * f(k)).exp()),
            opacity: 0.2 + 0.6 * rng.uniform(13) as f32,
            velocity: [f(14), f(15), 0.0],
            turn: [0.2 * f(16), 0.0, 0.1],
            base_color: [17u64, 18, 19].map(|k| rng.uniform(k) as f32),
            sh_rest: std::array::from_fn(|k| if k < 9 { 0.1 * f(20 + k as u64) } else { 0.0 }),
            importance: rng.uniform(70) as f32,
            label: None,
            features: Vec::new(),
        }
    };
    let meta =
        Meta { clip: [0.0, 0.3], fps: 10.0, up: [0.0, 1.0, 0.0], background: SKY, sh_degree: 1, ..Meta::default() };
    let node =
        |to: f64, from: usize| Node { from: 0.0, to, primitives: (from..from + rows / 2).map(primitive).collect() };
    let draft = Draft { meta, nodes: vec![node(0.3, 0), node(0.15, rows / 2)], poster: None };
    let mut bytes = Vec::new();
    write(&draft, &WriteConfig { palette: 40, ..WriteConfig::default() }, &mut bytes).unwrap();
    bytes
}

/// The pages of a file as a codec's scene.
fn begun(rows: usize, depths: Depths) -> (Arc<Quantised>, Scene<f32>, Pages) {
    let pages = read_pages(&file(rows)).unwrap();
    let codec = Quantised::new(depths, Rate::constant(0.02)).unwrap();
    let mut scene = Scene::default();
    codec.begin(pages.clone(), &mut scene);
    (codec, scene, pages)
}

/// Gradients as if the rows alive at t had been examined.
fn gradients(scene: &Scene<f32>, t: Time, seed: u64) -> Vec<Grads<f32>> {
    let mut ids = Vec::new();
    let one = |(l, layer): (usize, &Layer<f32>)| {
        let mut d = Grads::new(&layer.params);
        layer.active(t, &mut ids);
        d.activate(Space::Gaussians, Rows::Some(&ids));
        let [table] = d.of([SH]);
        for &row in &ids {
            for c in 0..table.width() {
                let x = Rng::new(seed, "gradient", l as u64).normal(u64::from(row) * 64 + c as u64);
                table.set(row as usize, c, x as f32);
            }
        }
        d
    };
    scene.layers.iter().enumerate().map(one).collect()
}

/// Panics unless both scenes show the same at t, and hold the same but for colours above degree 0.
fn assert_same(a: &Scene<f32>, b: &Scene<f32>, t: Time) {
    for (a, b) in a.layers.iter().zip(&b.layers) {
        for key in a.params.keys().filter(|k| *k != SH) {
            assert!(a.params[key] == b.params[key], "table {}", a.params.info(key).name);
        }
        let (mut ids, mut other) = (Vec::new(), Vec::new());
        assert_eq!((a.active(t, &mut ids), &ids), (b.active(t, &mut other), &other));
        for row in ids {
            let colors = |l: &Layer<f32>| l.params[SH].read::<12>(row as usize, 0);
            assert_eq!(colors(a), colors(b), "row {row}");
        }
    }
}

#[test]
fn previews_equal_the_saved_file() {
    let (codec, mut scene, pages) = begun(1500, coarse());
    assert!(scene.layers.len() >= 2 && pages.palette.is_some());
    codec.reset();
    let mut shown = scene.clone();
    for step in 0..12 {
        let t = Time(0.1 * f64::from(step % 3));
        codec.show(&scene, &[t], &mut shown);
        assert_same(&shown, &codec.whole(&scene), t);
        let mut d = gradients(&scene, t, 7);
        assert!(codec.learn(&mut d, 0.0, 1.0));
        // As Adam does: only rows that were active move.
        for (layer, d) in scene.layers.iter_mut().zip(&d) {
            for row in (0..layer.params.len()).filter(|&r| d.active(Space::Gaussians)[r]) {
                for c in 0..11 {
                    *layer.params[GEOMETRY].get_mut(row, c) += 0.01 * (c as f32 - 5.0);
                }
            }
        }
    }
    let config = WriteConfig { depths: coarse(), ..WriteConfig::default() };
    let mut bytes = Vec::new();
    write_pages(&codec.pages(&scene, pages.meta).unwrap().draft(None), &config, &mut bytes).unwrap();
    let (decoded, whole) = (read(&bytes).unwrap(), codec.whole(&scene));
    assert_eq!(decoded.layers.len(), whole.layers.len());
    for (a, b) in decoded.layers.iter().zip(&whole.layers) {
        for key in a.params.keys() {
            assert!(a.params[key].data() == b.params[key].data(), "table {}", a.params.info(key).name);
        }
    }
    assert!(scene.layers[0].params != whole.layers[0].params, "the depths are coarse");
}

#[test]
fn an_entry_gets_the_sum_of_its_rows() {
    let (codec, scene, pages) = begun(600, Depths::default());
    let d = gradients(&scene, Time(0.1), 3);
    let palette = pages.palette.unwrap();
    let mut expected = vec![[0.0f64; 9]; palette.entries];
    let mut rows = 0;
    for ((d, labels), layer) in d.iter().zip(&pages.labels).zip(&scene.layers) {
        for row in (0..layer.params.len()).filter(|&r| d.active(Space::Gaussians)[r]) {
            let x = d.table(SH).read::<9>(row, 3);
            (0..9).for_each(|k| expected[usize::from(labels[row])][k] += f64::from(x[k]));
            rows += 1;
        }
    }
    assert!(rows > palette.entries, "entries are shared: {rows} rows");
    let mut memory = codec.memory();
    let shared = memory.as_mut().unwrap().shared.as_mut().unwrap();
    assert!(shared.gather(&d, &pages.labels));
    let tolerance = 1e-5;
    for (entry, expected) in expected.iter().enumerate() {
        for (plane, x) in expected.iter().enumerate() {
            let got = f64::from(shared.gradient().get(entry, plane));
            assert!((got - x).abs() < tolerance * (1.0 + x.abs()), "entry {entry}, plane {plane}: {got}, not {x}");
        }
    }
    // Adam's first step is the rate, against the gradient's sign; entries that no step used stay.
    let before = shared.tables()[0].clone();
    drop(memory);
    assert!(codec.learn(&mut d.clone(), 0.0, 0.5));
    let memory = codec.memory();
    let after = memory.as_ref().unwrap().shared.as_ref().unwrap().tables()[0];
    for (entry, expected) in expected.iter().enumerate() {
        for (plane, x) in expected.iter().enumerate() {
            let moved = f64::from(after.get(entry, plane) - before.get(entry, plane));
            let step = if *x == 0.0 { 0.0 } else { -0.01 * x.signum() };
            assert!((moved - step).abs() < 1e-6, "entry {entry}, plane {plane}: {moved}, not {step}");
        }
    }
}

fn trainer(scene: Scene<f32>, stages: Vec<Stage>) -> Trainer<'static> {
    let settings = Settings {
        seed: 5,
        limits: Limits { cap: 10_000, extent: 4.0, min_opacity: 0.005 },
        background: SKY,
        sh_degree: 1,
        exposure_lr: 0.0,
    };
    let draw = Box::new(Renderer::new(RenderConfig::default()));
    Trainer::new(scene, stages, Arc::new(Made::new(4, 3, 24)), draw, TrainLoss::photometric(0.2), settings)
}

const COLUMNS: [(&str, f64); 6] = [
    ("means", 0.005),
    ("quats", 0.005),
    ("log_scales", 0.01),
    ("opacity_logits", 0.02),
    ("velocities", 0.02),
    ("life_centers", 0.002),
];

fn tuning(iterations: usize, codec: Option<Arc<Quantised>>) -> Stage {
    let every =
        |(c, rate): (&str, f64)| Group { layer: EVERY, ..Group::new(c, Rate { start: rate, end: FALL * rate }) };
    let mut groups: Vec<Group> = COLUMNS.into_iter().map(every).collect();
    let part = codec.is_some().then_some((0, 3));
    groups.push(Group { part, ..every(("sh", 0.01)) });
    let codec = codec.map(|c| c as Arc<dyn Codec<f32>>);
    Stage { batch: 4, groups, codec, ..Stage::new("tuning", iterations) }
}

#[test]
fn gradients_of_quantised_values_reach_the_parameters() {
    let (codec, scene, _) = begun(300, coarse());
    let whole = codec.whole(&scene);
    let stage = Stage { batch: 1, ..tuning(1, Some(codec)) };
    let mut t = trainer(scene.clone(), vec![stage]);
    t.step().unwrap().unwrap();
    // The same view of what a reader would see, without any codec.
    let frames = Made::new(4, 3, 24);
    let (mut picture, mut loss) = (Picture::default(), TrainLoss::photometric(0.2));
    let mut found = 0;
    for i in 0..frames.len() {
        frames.load(i, &mut picture).unwrap();
        let view = View {
            camera: frames.camera(i),
            t: frames.time(i),
            background: SKY,
            truth: &picture.color,
            mask: None,
            weight: None,
            depth: None,
            flow: None,
            measured: None,
            tracks: None,
            frame: i,
            rig: 0,
            shutter: None,
        };
        let info = StepInfo { iteration: 0, times: vec![view.t], seed: 5, progress: 0.0 };
        let mut d: Vec<Grads<f32>> = whole.layers.iter().map(|l| Grads::new(&l.params)).collect();
        let mut image = loss.of_step(&mut [], None);
        let mut losses = Losses { image: &mut image, probes: &[], params: &[] };
        let mut renderer = Renderer::new(RenderConfig::default());
        let step = Step { scene: &whole, views: &[view], info: &info, sh_degree: 1 };
        Chain::default().step(&step, &mut renderer, &mut losses, &mut d, &mut |_| {}).unwrap();
        // Adam's first step goes against the gradient's sign: of one of the views in every number.
        let mut right = true;
        let mut count = 0;
        for ((before, after), d) in scene.layers.iter().zip(&t.scene().layers).zip(&d) {
            for row in 0..before.params.len() {
                for c in 0..11 {
                    let moved = after.params[GEOMETRY].get(row, c) - before.params[GEOMETRY].get(row, c);
                    let g = d.table(GEOMETRY).get(row, c);
                    // Below that Adam's ε and the rounding of large numbers hide the sign.
                    if g.abs() > 1e-7 {
                        right &= moved * g < 0.0;
                        count += 1;
                    } else if g == 0.0 {
                        right &= moved == 0.0;
                    }
                }
            }
        }
        found += usize::from(right && count > 500);
    }
    assert_eq!(found, 1, "the step was that of one view");
}

#[test]
fn tuning_recovers_quality_lost_to_coarse_codes() {
    let pages = read_pages(&file(400)).unwrap();
    let mut plain = trainer(pages.scene(), vec![tuning(220, None)]);
    let mut losses = Vec::new();
    while !plain.is_done() {
        losses.push(plain.step().unwrap().unwrap().report.loss);
    }
    let mean = |l: &[f64]| l.iter().sum::<f64>() / l.len() as f64;
    let floats = mean(&losses[losses.len() - 12..]);
    let codec = Quantised::new(coarse(), Rate { start: 5e-3, end: 5e-4 }).unwrap();
    let mut scene = Scene::default();
    codec.begin(Pages { layers: plain.train_state.into_scene().layers, ..pages }, &mut scene);
    let mut t = trainer(scene, vec![tuning(200, Some(codec))]);
    let mut losses = Vec::new();
    while !t.is_done() {
        losses.push(t.step().unwrap().unwrap().report.loss);
    }
    let (rounded, tuned) = (losses[0], mean(&losses[losses.len() - 12..]));
    assert!(rounded > 1.1 * floats, "rounding is seen: {floats}, then {rounded}");
    let won = (rounded - tuned) / (rounded - floats);
    assert!(won > 0.5, "tuning wins back most of it: {floats}, rounded {rounded}, tuned {tuned}");
}

#[test]
fn codec_state_round_trips_and_damage_is_refused() {
    let (codec, scene, pages) = begun(301, coarse());
    assert!(codec.learn(&mut gradients(&scene, Time(0.1), 3), 0.0, 1.0));
    let words = codec.state();
    let other = Quantised::new(coarse(), Rate::constant(0.02)).unwrap();
    assert!(other.state().is_empty() && other.pages(&scene, pages.meta.clone()).is_err());
    other.restore(&words).unwrap();
    assert_eq!(other.state(), words);
    assert_eq!(other.pages(&scene, pages.meta.clone()).unwrap().labels, pages.labels);
    // The next step is the same one.
    for c in [&codec, &other] {
        assert!(c.learn(&mut gradients(&scene, Time(0.0), 4), 0.0, 1.0));
    }
    assert_eq!(other.state(), codec.state());
    let mut longer = words.clone();
    longer.push(0);
    assert!(other.restore(&longer).is_err());
    for cut in (1..words.len()).step_by(37) {
        assert!(other.restore(&words[..cut]).is_err(), "{cut} of {} words", words.len());
    }
    for (place, value) in
        [(0, 4), (0, 0), (1, 1), (1, u32::MAX), (2, u32::MAX), (3, u32::MAX), (4, 70_000), (5, u32::MAX)]
    {
        let mut bad = words.clone();
        bad[place] = value;
        assert!(other.restore(&bad).is_err(), "word {place} = {value}");
    }
    other.restore(&[]).unwrap();
    assert!(other.state().is_empty());
}

#[test]
fn a_number_that_is_not_finite_is_a_fault() {
    let (codec, scene, _) = begun(60, Depths::default());
    let mut d = gradients(&scene, Time(0.1), 3);
    let row = (0..scene.layers[0].params.len()).find(|&r| d[0].active(Space::Gaussians)[r]).unwrap();
    d[0].of([SH])[0].set(row, 5, f32::NAN);
    assert!(!codec.learn(&mut d, 0.0, 1.0));
}
