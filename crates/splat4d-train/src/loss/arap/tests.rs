use super::*;
use crate::loss::graph::Weigh;
use splat4d::math::{Rng, quat};

const N: usize = 30;

fn cloud(purpose: &str, size: f64) -> Vec<[f64; 3]> {
    let rng = Rng::new(7, purpose, 0);
    (0..N as u64).map(|i| std::array::from_fn(|a| size * rng.fork(i).normal(a as u64))).collect()
}

fn graph(points: &[[f64; 3]]) -> Graph<f64> {
    Graph::new(points, 6, Weigh::Median(1.0))
}

fn moved(points: &[[f64; 3]], q: [f64; 4], shift: f64) -> Vec<[f64; 3]> {
    let r = quat::to_rotation(quat::normalize(q).0);
    points.iter().map(|&p| turn(&r, p).map(|x| x + shift)).collect()
}

fn shaken(points: &[[f64; 3]], purpose: &str) -> Vec<[f64; 3]> {
    points.iter().zip(cloud(purpose, 0.2)).map(|(p, by)| std::array::from_fn(|k| p[k] + by[k])).collect()
}

fn zeros() -> Vec<[f64; 3]> {
    vec![[0.0; 3]; N]
}

/// Gradients of `loss` over several times against finite differences of `value`.
fn check(
    at: &[Vec<[f64; 3]>],
    loss: impl Fn(&[Vec<[f64; 3]>], &mut [Vec<[f64; 3]>]) -> f64,
    value: impl Fn(&[Vec<[f64; 3]>]) -> f64,
) {
    let mut d: Vec<Vec<[f64; 3]>> = at.iter().map(|_| zeros()).collect();
    loss(at, &mut d);
    for t in 0..at.len() {
        for i in [0, 7, 29] {
            for k in 0..3 {
                let by = |h: f64| {
                    let mut at = at.to_vec();
                    at[t][i][k] += h;
                    value(&at)
                };
                let fd = (by(1e-6) - by(-1e-6)) / 2e-6;
                assert!((fd - d[t][i][k]).abs() < 1e-7, "{t} {i} {k}: {fd} {}", d[t][i][k]);
            }
        }
    }
}

fn energy(g: &Graph<f64>, at: &[Vec<[f64; 3]>], d: &mut [Vec<[f64; 3]>]) -> f64 {
    let [a, b] = d else { panic!("two instants") };
    arap(g, [&at[0], &at[1]], 0.7, [a, b])
}

#[test]
fn rigid_motion_has_no_energy_and_either_frame_may_turn() {
    let rest = cloud("rest", 1.0);
    let g = graph(&rest);
    let value = |a: &[[f64; 3]], b: &[[f64; 3]]| arap(&g, [a, b], 1.0, [&mut zeros(), &mut zeros()]);
    assert!(value(&moved(&rest, [0.1, 0.9, -0.4, 0.3], 5.0), &rest) < 1e-20);
    let bent = shaken(&rest, "bent");
    let truth = value(&bent, &rest);
    assert!(truth > 1e-3);
    let q = [0.4, -0.3, 0.2, 0.8];
    for (a, b) in [(moved(&bent, q, -2.0), rest.clone()), (bent.clone(), moved(&rest, q, 1.0))] {
        assert!((value(&a, &b) - truth).abs() < 1e-12, "{} {truth}", value(&a, &b));
    }
}

#[test]
fn the_envelope_gradient_equals_the_gradient_of_the_minimal_energy() {
    let rest = cloud("rest", 1.0);
    let g = graph(&rest);
    let at = [moved(&shaken(&rest, "a"), [0.9, 0.1, 0.4, 0.0], 0.3), shaken(&rest, "b")];
    // The finite differences find the best rotation again.
    check(&at, |at, d| energy(&g, at, d), |at| energy(&g, at, &mut [zeros(), zeros()]));
}

#[test]
fn rotations_are_those_of_the_motion_and_never_mirror() {
    let rest = cloud("rest", 1.0);
    let g = graph(&rest);
    let q = quat::normalize([0.3, 0.5, -0.2, 0.6]).0;
    let truth = quat::to_rotation(q);
    for r in rotations(&g, &moved(&rest, q, 1.0), &rest) {
        assert!(r.as_flattened().iter().zip(truth.as_flattened()).all(|(a, b)| (a - b).abs() < 1e-9));
    }
    let mirrored: Vec<[f64; 3]> = rest.iter().map(|p| [-p[0], p[1], p[2]]).collect();
    for r in rotations(&g, &mirrored, &rest) {
        let det = splat4d::math::Se3 { rotation: r, translation: [0.0; 3] }.det();
        assert!((det - 1.0).abs() < 1e-12);
    }
}

#[test]
fn elastic_loss_is_relative_and_ignores_rigid_motion() {
    let rest = cloud("rest", 1.0);
    let g = graph(&rest);
    let at = [rest.clone(), shaken(&rest, "a"), shaken(&rest, "b")];
    let run = |at: &[Vec<[f64; 3]>], floor: f64, d: &mut [Vec<[f64; 3]>]| {
        let at: Vec<&[[f64; 3]]> = at.iter().map(Vec::as_slice).collect();
        let mut d: Vec<&mut [[f64; 3]]> = d.iter_mut().map(Vec::as_mut_slice).collect();
        elastic(&g, &at, floor, 0.7, &mut d)
    };
    // With a floor far above it the loss is the variance itself, scaled: that is the value to differentiate.
    let variance = |at: &[Vec<[f64; 3]>]| 1e9 * run(at, 1e9, &mut [zeros(), zeros(), zeros()]) / 0.7;
    let at_rest = variance(&at);
    check(&at, |at, d| run(at, OWN_FLOOR, d), |at| 0.7 * variance(at) / (at_rest + OWN_FLOOR));
    assert!((run(&at, OWN_FLOOR, &mut [zeros(), zeros(), zeros()]) - 0.7).abs() < 0.01);
    let turned = [rest.clone(), moved(&rest, [0.2, 0.4, 0.8, 0.1], 2.0)];
    assert!(run(&turned, OWN_FLOOR, &mut [zeros(), zeros()]) < 1e-12);
}

#[test]
fn acceleration_is_penalised_and_uniform_motion_is_not() {
    let rest = cloud("rest", 1.0);
    let step = cloud("step", 0.3);
    let steady: Vec<Vec<[f64; 3]>> = (0..3)
        .map(|t| rest.iter().zip(&step).map(|(x, v)| std::array::from_fn(|k| x[k] + t as f64 * v[k])).collect())
        .collect();
    let run = |at: &[Vec<[f64; 3]>], floor: f64, d: &mut [Vec<[f64; 3]>]| {
        let [a, b, c] = d else { panic!("three instants") };
        acceleration([&at[0], &at[1], &at[2]], floor, 0.7, [a, b, c])
    };
    assert!(run(&steady, OWN_FLOOR, &mut [zeros(), zeros(), zeros()]) < 1e-9);
    let at = [rest.clone(), shaken(&rest, "a"), shaken(&rest, "b")];
    let mean = |at: &[Vec<[f64; 3]>]| 1e9 * run(at, 1e9, &mut [zeros(), zeros(), zeros()]) / 0.7;
    let truth = mean(&at);
    check(&at, |at, d| run(at, OWN_FLOOR, d), |at| 0.7 * mean(at) / (truth + OWN_FLOOR));
}
