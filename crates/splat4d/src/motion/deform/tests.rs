use super::*;
use crate::scene::params::QUAT;
use crate::scene::{Rows, SH};

const ENCODED: Input = Input::Encoded { x_levels: 4, t_levels: 3, time_net: true };
const GRIDS: Input = Input::Hashed {
    space: HashShape { levels: 3, features: 2, log2_size: 8, base: 3, finest: 16 },
    time: HashShape { levels: 2, features: 2, log2_size: 8, base: 3, finest: 8 },
};

fn spec(input: Input, layers: usize, rigid: bool) -> DeformSpec {
    let skip = (layers > 2).then_some(1);
    DeformSpec { seed: 3, clip: [0.5, 2.5], input, width: 12, layers, skip, rigid }
}

fn every() -> Vec<DeformSpec> {
    let mut out = Vec::new();
    for rigid in [false, true] {
        out.extend([spec(ENCODED, 3, rigid), spec(GRIDS, 2, rigid), spec(GRIDS, 0, rigid), spec(ENCODED, 0, rigid)]);
    }
    out
}

fn cloud<F: Real>(rows: usize, shift: [f64; 3]) -> Params<F> {
    let mut p = Params::<F>::new(rows, 1, &[]);
    for i in 0..rows {
        let rng = Rng::new(8, "cloud", i as u64);
        let row: [f64; 11] = std::array::from_fn(|k| rng.normal(k as u64) + if k < 3 { shift[k] } else { 0.0 });
        p[GEOMETRY].write(i, 0, row.map(F::of));
        p[GEOMETRY].add(i, QUAT, [F::ONE]);
    }
    p
}

/// A model whose networks are not zero.
fn moving<F: Real>(spec: &DeformSpec, p: &mut Params<F>) -> Deform {
    let model = Deform::new(spec.clone(), p).unwrap();
    for key in p.keys().skip(3).filter(|&k| p.info(k).trainable).collect::<Vec<_>>() {
        let rng = Rng::new(u64::from(key.0), "moved", 0);
        p[key].data_mut().iter_mut().enumerate().for_each(|(i, x)| *x += F::of(0.3 * rng.normal(i as u64)));
    }
    model
}

fn ask<F: Real>(model: &Deform, p: &Params<F>, t: f64) -> Tape<F> {
    let mut tape = Tape::default();
    model.at(&At { p, of: Space::Gaussians, rows: Rows::All, t: Time(t) }, &Cache::default(), &mut tape);
    tape
}

fn back<F: Real>(model: &Deform, p: &Params<F>, t: f64, tape: &mut Tape<F>, d_out: &Table<F>) -> (Grads<F>, f64) {
    let mut d = Grads::new(p);
    d.activate(Space::Gaussians, Rows::All);
    let q = At { p, of: Space::Gaussians, rows: Rows::All, t: Time(t) };
    let d_out = SplatGrads { out: d_out, color: None, weights: None };
    let d_t = model.backward(&q, &Cache::default(), tape, &d_out, &mut Cache::default(), &mut d);
    (d, d_t)
}

#[test]
fn zero_heads_give_the_static_cloud_bit_for_bit() {
    for spec in every() {
        let mut p = cloud::<f32>(40, [0.0; 3]);
        let model = Deform::new(spec, &mut p).unwrap();
        let mut still = Tape::default();
        let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: Time(1.1) };
        Still.at(&q, &Cache::default(), &mut still);
        assert_eq!(ask(&model, &p, 1.1).out.data(), still.out.data());
        // A nonzero head moves.
        let mut q = p.clone();
        let last = q.keys().last().unwrap();
        q[last].fill(0.5);
        assert_ne!(ask(&model, &q, 1.1).out.data(), still.out.data());
    }
}

#[test]
fn the_network_is_detached_from_the_mean() {
    for spec in every().into_iter().filter(|s| !s.rigid) {
        let mut p = cloud::<f64>(20, [0.0; 3]);
        let model = moving(&spec, &mut p);
        let mut tape = ask(&model, &p, 1.3);
        let d_out = tape.out.clone();
        let (d, d_t) = back(&model, &p, 1.3, &mut tape, &d_out);
        for i in 0..20 {
            assert_eq!(d.table(GEOMETRY).read::<3>(i, 0), d_out.read::<3>(i, 0), "dL/dx is dL/dx_t");
        }
        assert!(d_t != 0.0 && !d.touched(SH));
        assert!(!d.touched(model.bounds), "the box does not learn");
    }
}

#[test]
fn a_frozen_network_is_not_evaluated() {
    let mut p = cloud::<f32>(20, [0.0; 3]);
    let model = Deform::new(spec(ENCODED, 3, false), &mut p).unwrap();
    let touched = |p: &Params<f32>| {
        let mut tape = ask(&model, p, 1.0);
        let d_out = tape.out.clone();
        let (d, _) = back(&model, p, 1.0, &mut tape, &d_out);
        assert!(d.touched(GEOMETRY));
        model.trunk.keys().any(|k| d.touched(k) && d.table(k).data().iter().any(|x| *x != 0.0))
    };
    let learns = |p: &mut Params<f32>, on: bool| model.trunk.keys().for_each(|k| p.info_mut(k).trainable = on);
    learns(&mut p, false);
    assert!(!touched(&p));
    learns(&mut p, true);
    assert!(touched(&p), "from zero heads there is a way out");
    assert_eq!(model.network_columns().len(), 8 + 4 + 2 + 2);
    assert!(model.network_columns().iter().all(|c| p.find(c).is_some()));
}

#[test]
fn outside_the_clip_it_is_as_at_its_ends() {
    for spec in every() {
        let mut p = cloud::<f64>(20, [0.0; 3]);
        let model = moving(&spec, &mut p);
        for (outside, end) in [(-3.0, 0.5), (9.0, 2.5), (f64::NEG_INFINITY, 0.5), (f64::INFINITY, 2.5)] {
            let mut tape = ask(&model, &p, outside);
            assert_eq!(tape.out.data(), ask(&model, &p, end).out.data());
            let d_out = tape.out.clone();
            assert_eq!(back(&model, &p, outside, &mut tape, &d_out).1, 0.0);
        }
        assert_ne!(ask(&model, &p, 0.5).out.data(), ask(&model, &p, 2.5).out.data());
    }
}

#[test]
fn moving_the_scene_moves_the_result() {
    for spec in every() {
        let shift = [4.0, -2.0, 8.0];
        let (mut a, mut b) = (cloud::<f64>(30, [0.0; 3]), cloud::<f64>(30, shift));
        let (ma, mb) = (moving(&spec, &mut a), moving(&spec, &mut b));
        let (ta, tb) = (ask(&ma, &a, 1.7).out, ask(&mb, &b, 1.7).out);
        for i in 0..30 {
            let (x, y) = (ta.read::<10>(i, 0), tb.read::<10>(i, 0));
            for c in 0..10 {
                let expected = x[c] + if c < 3 { shift[c] } else { 0.0 };
                assert!((y[c] - expected).abs() < 1e-9 * expected.abs().max(1.0), "row {i} column {c}");
            }
        }
    }
}

#[test]
fn scales_have_a_floor() {
    let mut p = cloud::<f64>(5, [0.0; 3]);
    let model = Deform::new(spec(ENCODED, 1, false), &mut p).unwrap();
    // The bias of δs alone: far below minus any scale.
    let last = p.keys().last().unwrap();
    for k in 7..10 {
        p[last].set(k, 0, -1e6);
    }
    let mut tape = ask(&model, &p, 1.0);
    for i in 0..5 {
        let cov = tape.out.read::<6>(i, 3);
        assert!((cov[0] + cov[3] + cov[5] - 3e-12).abs() < 1e-15, "{cov:?}");
    }
    let d_out = tape.out.clone();
    let (d, _) = back(&model, &p, 1.0, &mut tape, &d_out);
    assert!((0..5).all(|i| d.table(GEOMETRY).read::<3>(i, 7) == [0.0; 3]), "what is clamped has no gradient");
}

#[test]
fn impossible_specifications_are_refused() {
    let good = spec(ENCODED, 3, false);
    let clip = |clip| DeformSpec { clip, ..good.clone() };
    let levels = |n| Input::Encoded { x_levels: n, t_levels: n, time_net: false };
    for bad in [
        clip([1.0, 0.0]),
        clip([f64::NAN, 1.0]),
        clip([0.0, f64::INFINITY]),
        DeformSpec { input: levels(usize::MAX / 8), ..good.clone() },
        DeformSpec { layers: 1_000_000, ..good.clone() },
        DeformSpec { width: 0, ..good.clone() },
        DeformSpec { width: 4096, layers: 60, ..good.clone() },
        DeformSpec { skip: Some(2), ..good.clone() },
        DeformSpec { skip: Some(usize::MAX), ..good.clone() },
        DeformSpec {
            input: Input::Hashed {
                space: HashShape { levels: 3, features: 2, log2_size: 63, base: 3, finest: 16 },
                time: HashShape { levels: 3, features: 2, log2_size: 8, base: 3, finest: 16 },
            },
            ..good.clone()
        },
    ] {
        assert!(Deform::new(bad.clone(), &mut cloud::<f32>(3, [0.0; 3])).is_err(), "{bad:?}");
    }
}

/// A toy of known motions: a third each of the points moves along a line, a circle and a sinusoid.
fn truth(i: usize, t: f64) -> [f64; 3] {
    let rng = Rng::new(21, "toy", i as u64);
    let home: [f64; 3] = std::array::from_fn(|k| 2.0 * rng.uniform(k as u64) - 1.0);
    let angle = std::f64::consts::TAU * t;
    let step = match i % 3 {
        0 => [0.6 * (t - 0.5), 0.2 * (t - 0.5), 0.0],
        1 => [0.3 * angle.cos(), 0.3 * angle.sin(), 0.0],
        _ => [0.0, 0.0, 0.4 * angle.sin()],
    };
    std::array::from_fn(|k| home[k] + step[k])
}

#[test]
fn learns_known_motions_better_than_the_static_mean_at_every_time() {
    const POINTS: usize = 50;
    const TIMES: usize = 20;
    const STEPS: usize = 300;
    let mut p = Params::<f32>::new(POINTS, 1, &[]);
    let time = |k: usize| k as f64 / (TIMES - 1) as f64;
    let mean = |i: usize| -> [f64; 3] {
        std::array::from_fn(|c| (0..TIMES).map(|k| truth(i, time(k))[c]).sum::<f64>() / TIMES as f64)
    };
    for i in 0..POINTS {
        p[GEOMETRY].write(i, 0, mean(i).map(|x| x as f32));
        p[GEOMETRY].set(i, QUAT, 1.0);
    }
    let input = Input::Encoded { x_levels: 4, t_levels: 3, time_net: false };
    let toy = DeformSpec { seed: 1, clip: [0.0, 1.0], input, width: 48, layers: 2, skip: None, rigid: false };
    let model = Deform::new(toy, &mut p).unwrap();
    let keys: Vec<Key> = model.network_columns().iter().map(|c| p.find(c).unwrap()).collect();
    let mut moments: Vec<[Vec<f64>; 2]> =
        keys.iter().map(|&k| [vec![0.0; p[k].rows()], vec![0.0; p[k].rows()]]).collect();
    let error = |out: &Table<f32>, t: f64, d_out: &mut Table<f32>| {
        let mut sum = 0.0;
        for i in 0..POINTS {
            let (x, y) = (out.read::<3>(i, 0), truth(i, t));
            let off: [f64; 3] = std::array::from_fn(|c| f64::from(x[c]) - y[c]);
            sum += off.iter().map(|e| e * e).sum::<f64>();
            d_out.write(i, 0, off.map(|e| e as f32));
        }
        sum
    };
    for step in 0..STEPS {
        let t = time(Rng::new(2, "times", 0).below(step as u64, TIMES));
        let mut tape = ask(&model, &p, t);
        let mut d_out = tape.out.zeros_like();
        error(&tape.out, t, &mut d_out);
        let (d, _) = back(&model, &p, t, &mut tape, &d_out);
        // Adam.
        let (c1, c2) = (1.0 - 0.9f64.powi(step as i32 + 1), 1.0 - 0.99f64.powi(step as i32 + 1));
        for (&key, [m, v]) in keys.iter().zip(&mut moments) {
            for i in 0..m.len() {
                let g = f64::from(d.table(key).get(i, 0));
                m[i] = 0.9 * m[i] + 0.1 * g;
                v[i] = 0.99 * v[i] + 0.01 * g * g;
                *p[key].get_mut(i, 0) -= (5e-3 * (m[i] / c1) / ((v[i] / c2).sqrt() + 1e-12)) as f32;
            }
        }
    }
    for k in 0..TIMES {
        let mut spare = ask(&model, &p, 0.0).out;
        let learnt = error(&ask(&model, &p, time(k)).out, time(k), &mut spare);
        let fixed: f64 =
            (0..POINTS).map(|i| (0..3).map(|c| (truth(i, time(k))[c] - mean(i)[c]).powi(2)).sum::<f64>()).sum();
        assert!(learnt < 0.65 * fixed, "at {}: {learnt} against {fixed} of the static mean", time(k));
    }
}
