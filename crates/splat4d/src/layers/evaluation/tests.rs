//! Which queries are merged, and that forward and backward equal those of the motion models.

use super::*;
use crate::math::Rng;
use crate::motion::control::{ControlSpec, Curve, TrajectorySpec};
use crate::motion::skin::SkinSpec;
use crate::motion::{SpacetimeSpec, Spec, build_as};
use crate::scene::params::{OPACITY, QUAT};
use crate::scene::splats::SPLAT_COLUMNS;
use crate::scene::{GEOMETRY, Key, LIFE, LifeKind, Params};

/// Relative error of central differences in f64.
const TOLERANCE: f64 = 2e-6;
/// Their step.
const STEP: f64 = 1e-6;
const ROWS: usize = 20;

fn layer(spec: &Spec, life: LifeKind, seed: u64) -> Layer<f64> {
    let rng = Rng::new(seed, "evaluation", 0);
    let mut params = Params::new(ROWS, 1, life.columns());
    for r in 0..ROWS {
        let n = |c: usize| 0.4 * rng.normal((r * 16 + c) as u64);
        params[GEOMETRY].write(r, 0, std::array::from_fn::<f64, 11, _>(|c| n(c) + f64::from(u8::from(c == QUAT))));
        params[GEOMETRY].set(r, OPACITY, 1.0 + n(11));
        // Some are born late, some die early.
        (0..params[LIFE].width()).for_each(|c| params[LIFE].set(r, c, if c == 0 { 1.5 * n(12) } else { -1.0 }));
    }
    let motion = build_as(spec, &mut params).unwrap();
    for key in params.keys().filter(|k| *k > LIFE).collect::<Vec<_>>() {
        let table = &mut params[key];
        let lane = rng.fork(u64::from(key.0));
        (0..table.rows()).for_each(|r| {
            (0..table.width()).for_each(|c| *table.get_mut(r, c) += 0.05 * lane.normal((64 * r + c) as u64))
        });
    }
    Layer::new("made", params, motion, life)
}

/// One layer with lifespans, and one whose motion model prepares and finishes.
fn layers() -> Vec<Layer<f64>> {
    let skin = SkinSpec { nodes: 5, neighbours: 3, hyper: 2, mask: false };
    let trajectory = TrajectorySpec::Keys { curve: Curve::Cubic, keys: 4 };
    vec![
        layer(&Spec::Spacetime(SpacetimeSpec { order: 2, ..SpacetimeSpec::default() }), LifeKind::GaussHalf, 1),
        layer(&Spec::Control(ControlSpec { seed: 1, clip: [0.0, 1.0], skin, trajectory }), LifeKind::Infinite, 2),
    ]
}

fn ids(rows: Rows<'_>) -> Option<Vec<u32>> {
    match rows {
        Rows::All => None,
        Rows::Some(ids) => Some(ids.to_vec()),
    }
}

#[test]
fn equal_queries_are_merged_with_their_rows() {
    let mut e = Evaluation::<f64>::default();
    let t = Time(0.3);
    assert_eq!(e.request(0, Space::Gaussians, Rows::Some(&[1, 4, 9]), t), 0);
    assert_eq!(e.request(0, Space::Gaussians, Rows::Some(&[0, 4, 5, 12]), t), 0);
    assert_eq!(ids(e.tape(0).rows()), Some(vec![0, 1, 4, 5, 9, 12]));
    assert_eq!(e.request(1, Space::Gaussians, Rows::Some(&[3]), t), 1, "another layer");
    assert_eq!(e.request(0, Space::Nodes, Rows::Some(&[3]), t), 2, "another space");
    assert_eq!(e.request(0, Space::Gaussians, Rows::Some(&[3]), Time(0.4)), 3, "another time");
    assert_eq!(e.request(0, Space::Gaussians, Rows::All, t), 0);
    assert_eq!(ids(e.tape(0).rows()), None, "all rows hold every other");
    e.request(0, Space::Gaussians, Rows::Some(&[2]), t);
    assert_eq!((ids(e.tape(0).rows()), e.len()), (None, 4));
    assert_eq!((e.find(0, Space::Nodes, t), e.find(1, Space::Nodes, t)), (Some(2), None));
    e.request(0, Space::Gaussians, Rows::Some(&[0]), Time(f64::NAN));
    assert_eq!(e.request(0, Space::Gaussians, Rows::Some(&[1]), Time(f64::NAN)), 4, "no time is one time");
    e.begin();
    assert!(e.is_empty() && e.find(0, Space::Gaussians, t).is_none());
}

#[test]
fn active_rows_are_merged_with_requested_rows() {
    let layer = &layers()[0];
    let (t, mut alive) = (Time(0.3), Vec::new());
    assert!(!layer.active(t, &mut alive) && !alive.is_empty() && alive.len() < ROWS);
    let dead = (0..ROWS as u32).find(|id| !alive.contains(id)).unwrap();
    let mut e = Evaluation::default();
    e.request_active(0, layer, t);
    assert_eq!(ids(e.tape(0).rows()), Some(alive.clone()));
    let mut both = alive;
    both.push(dead);
    both.sort_unstable();
    for asks_first in [false, true] {
        e.begin();
        let rows = [dead];
        let ask = |e: &mut Evaluation<f64>| assert_eq!(e.request(0, Space::Gaussians, Rows::Some(&rows), t), 0);
        if asks_first {
            ask(&mut e);
        }
        assert_eq!(e.request_active(0, layer, t), 0);
        if !asks_first {
            ask(&mut e);
        }
        assert_eq!(ids(e.tape(0).rows()), Some(both.clone()));
    }
}

/// The queries of the tests below: a layer, its rows, a time.
const ASKED: [(usize, Option<&[u32]>, f64); 4] =
    [(0, Some(&[1, 4, 17]), 0.3), (1, None, 0.3), (0, Some(&[4, 5]), 0.7), (1, Some(&[0, 9]), 0.6)];

fn evaluation(layers: &[Layer<f64>]) -> Evaluation<f64> {
    let mut e = Evaluation::default();
    for (layer, rows, t) in ASKED {
        e.request(layer, Space::Gaussians, rows.map_or(Rows::All, Rows::Some), Time(t));
    }
    e.evaluate(layers);
    e
}

/// dL/d out of query i, row j, column c; L is linear in all results.
fn weight(i: usize, j: usize, c: usize) -> f64 {
    0.3 + 0.17 * j as f64 - 0.21 * c as f64 + 0.05 * (c * c) as f64 + 0.4 * i as f64
}

fn loss(layers: &[Layer<f64>]) -> f64 {
    let of = |(i, tape): (usize, &LayerTape<f64>)| -> f64 {
        let rows = 0..tape.out().rows();
        rows.map(|j| (0..10).map(|c| weight(i, j, c) * tape.out().get(j, c)).sum::<f64>()).sum()
    };
    evaluation(layers).tapes().enumerate().map(of).sum()
}

fn d_outs(e: &Evaluation<f64>) -> Vec<Table<f64>> {
    let table = |(i, tape): (usize, &LayerTape<f64>)| {
        let mut d = Table::new(&SPLAT_COLUMNS, tape.out().rows());
        (0..d.rows()).for_each(|j| (0..10).for_each(|c| d.set(j, c, weight(i, j, c))));
        d
    };
    e.tapes().enumerate().map(table).collect()
}

/// Gradients of the layers, and dL/dt by query.
fn gradients(layers: &[Layer<f64>]) -> (Vec<Grads<f64>>, Vec<f64>) {
    let mut e = evaluation(layers);
    let mut d: Vec<Grads<f64>> = layers.iter().map(|l| Grads::new(&l.params)).collect();
    e.activate(&mut d);
    for (i, mut d_out) in d_outs(&e).into_iter().enumerate() {
        match i {
            // Half comes from an image and half from a loss on splats.
            0 => {
                d_out.data_mut().iter_mut().for_each(|x| *x *= 0.5);
                e.add_gradient(0, &mut d_out.clone(), &mut None, &mut None);
                e.d_out(0).data_mut().iter_mut().zip(d_out.data()).for_each(|(a, b)| *a += *b);
            }
            _ => e.add_gradient(i, &mut d_out, &mut None, &mut None),
        }
    }
    e.backward(layers, &mut d);
    let times = e.queries.iter().map(|q| q.d_time).collect();
    (d, times)
}

fn bits(d: &Grads<f64>, params: &Params<f64>) -> Vec<(Key, Vec<u64>)> {
    params.keys().map(|k| (k, d.table(k).data().iter().map(|x| x.to_bits()).collect())).collect()
}

#[test]
fn the_backward_pass_equals_the_motion_model_bit_for_bit() {
    let layers = layers();
    let (got, got_times) = gradients(&layers);
    let d_outs = d_outs(&evaluation(&layers));
    for (index, layer) in layers.iter().enumerate() {
        let mine: Vec<usize> = (0..ASKED.len()).filter(|&i| ASKED[i].0 == index).collect();
        let mut tapes: Vec<LayerTape<f64>> = mine.iter().map(|_| LayerTape::default()).collect();
        for (tape, &i) in tapes.iter_mut().zip(&mine) {
            tape.request(Space::Gaussians, ASKED[i].1.map_or(Rows::All, Rows::Some), Time(ASKED[i].2));
        }
        let (mut cache, mut d_cache, mut d) = (Cache::default(), Cache::default(), Grads::new(&layer.params));
        let queries: Vec<At<'_, f64>> = tapes.iter().map(|t| t.query(&layer.params)).collect();
        layer.motion.prepare(&layer.params, &queries, &mut cache);
        for (tape, &i) in tapes.iter_mut().zip(&mine) {
            layer.at(&cache, tape);
            let d_out = SplatGrads { out: &d_outs[i], color: None, weights: None };
            assert_eq!(got_times[i], layer.backward(&cache, tape, &d_out, &mut d_cache, &mut d));
        }
        let queries: Vec<At<'_, f64>> = tapes.iter().map(|t| t.query(&layer.params)).collect();
        layer.motion.finish(&layer.params, &queries, &mut cache, &mut d_cache, &mut d);
        assert_eq!(bits(&got[index], &layer.params), bits(&d, &layer.params), "layer {index}");
    }
}

#[test]
fn gradients_through_two_layers_equal_finite_differences() {
    let layers = layers();
    let (d, _) = gradients(&layers);
    let moved = |layer: usize, key: Key, row: usize, col: usize, by: f64| {
        let mut all = layers.clone();
        *all[layer].params[key].get_mut(row, col) += by;
        loss(&all)
    };
    for (index, layer) in layers.iter().enumerate() {
        for key in layer.params.keys() {
            let (table, got) = (&layer.params[key], d[index].table(key));
            for row in (0..table.rows()).filter(|r| [0, 1, 4, 9, 17].contains(r)) {
                for col in 0..table.width() {
                    let fd = (moved(index, key, row, col, STEP) - moved(index, key, row, col, -STEP)) / (2.0 * STEP);
                    let (name, got) = (layer.params.column_name(key, col), got.get(row, col));
                    assert!((fd - got).abs() < TOLERANCE * (1.0 + fd.abs()), "{index} {name} {row}: {fd} {got}");
                }
            }
        }
    }
}

#[test]
fn earlier_queries_do_not_change_results() {
    let layers = layers();
    let scene = Scene { layers, ..Scene::default() };
    let (mut used, mut fresh) = (Evaluation::default(), Evaluation::default());
    scene.at(Time(0.9), &mut used);
    let mut d: Vec<Grads<f64>> = scene.layers.iter().map(|l| Grads::new(&l.params)).collect();
    used.d_out(0).fill(1.0);
    used.backward(&scene.layers, &mut d);
    scene.at(Time(0.3), &mut used);
    scene.at(Time(0.3), &mut fresh);
    let numbers = |e: &Evaluation<f64>| e.tapes().map(|t| t.out().data().to_vec()).collect::<Vec<_>>();
    assert_eq!(numbers(&used), numbers(&fresh));
    assert!(used.d_out(0).data().iter().all(|x| *x == 0.0), "gradients begin anew");
    assert_eq!(scene.splats(&used).len(), used.splats(&scene, Time(0.3)).len());
}

#[test]
fn a_sweep_equals_single_queries() {
    for layer in &layers() {
        let asked = [(Rows::Some(&[2, 3][..]), Time(0.1)), (Rows::All, Time(0.6)), (Rows::Some(&[0][..]), Time(0.1))];
        let mut shown = 0;
        sweep(layer, &asked, |i, tape| {
            let (rows, t) = asked[i];
            let alone = Evaluation::of_layer(layer, Space::Gaussians, rows, t);
            assert_eq!(alone.tape(0).out().data(), tape.out().data());
            shown += 1;
        });
        assert_eq!(shown, asked.len());
    }
}
