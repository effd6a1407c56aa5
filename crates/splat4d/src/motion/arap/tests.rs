use super::*;
use crate::math::{Rng, Se3};
use std::time::Instant;

/// A rod of nodes along x, with a little noise.
fn rod(n: usize, at: [f64; 3], seed: u64) -> Vec<[f64; 3]> {
    let rng = Rng::new(seed, "rod", 0);
    let place = |i: usize| [0.02 * i as f64, 0.0, 0.0];
    (0..n).map(|i| std::array::from_fn(|k| at[k] + place(i)[k] + 0.05 * rng.fork(i as u64).uniform(k as u64))).collect()
}

fn turned(angle: f64) -> [[f64; 3]; 3] {
    let (s, c) = angle.sin_cos();
    [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
}

fn far(a: &[[f64; 3]], b: &[[f64; 3]]) -> f64 {
    a.iter().zip(b).map(|(a, b)| sub(*a, *b).iter().map(|x| x.abs()).fold(0.0, f64::max)).fold(0.0, f64::max)
}

#[test]
fn rigid_drags_are_rigid_and_a_zero_drag_keeps_the_scene() {
    let rest = rod(120, [0.3, -0.2, 0.1], 1);
    let motion = Se3 { rotation: turned(1.1), translation: [0.4, -1.0, 2.0] };
    let handle = |k: usize, m: &Se3| Handle { node: k, target: m.apply(rest[k]), rotation: None };
    for (pose, name) in [(motion, "a rigid motion"), (Se3::IDENTITY, "no motion")] {
        let handles: Vec<Handle> = [0, 31, 60, 90, 119].map(|k| handle(k, &pose)).to_vec();
        let out = drag(&rest, &handles, 3).unwrap();
        let expected: Vec<_> = rest.iter().map(|x| pose.apply(*x)).collect();
        assert!(far(&out.positions, &expected) < 1e-6, "{name}: {}", far(&out.positions, &expected));
        let worst = out.rotations.iter().map(|r| far(r, &pose.rotation)).fold(0.0, f64::max);
        assert!(worst < 1e-6, "{name}: rotations are off by {worst}");
        let poses = out.poses::<f64>(&rest);
        for k in 0..rest.len() {
            let (p, r) = super::super::skin::node_frame(rest[k], poses.read(k, 0));
            assert!(far(&[p], &[expected[k]]) < 1e-6 && far(&r, &pose.rotation) < 1e-6);
        }
    }
}

#[test]
fn energy_never_rises_and_handles_stay_at_their_targets() {
    let rest = rod(150, [0.0; 3], 2);
    // One end is bent far round, the other one held.
    let mut handles: Vec<Handle> = (0..6).map(|k| Handle { node: k, target: rest[k], rotation: None }).collect();
    handles.push(Handle { node: 149, target: [1.2, 1.8, 0.4], rotation: Some(turned(1.5)) });
    let out = drag(&rest, &handles, 20).unwrap();
    for pair in out.energies.windows(2) {
        assert!(pair[1] <= pair[0] * (1.0 + 1e-9), "energy rose: {:?}", out.energies);
    }
    assert!(out.energies[20] < 0.9 * out.energies[0], "{:?}", out.energies);
    assert!(handles.iter().all(|h| out.positions[h.node] == h.target));
    assert_eq!(out.rotations[149], turned(1.5));
    // Neighbours keep their distances far better than under a plain Laplacian, and the bits are always the same.
    assert_eq!(out, drag(&rest, &handles, 20).unwrap());
}

#[test]
fn untied_gaussians_stay() {
    let mut rest = rod(80, [0.0; 3], 3);
    rest.extend(rod(80, [0.0, 3.0, 0.0], 4));
    let handles = [0, 40, 79].map(|k| Handle {
        node: k,
        target: [rest[k][0], rest[k][1] + 0.3 * (k > 40) as u8 as f64, rest[k][2]],
        rotation: None,
    });
    let out = drag(&rest, &handles, 4).unwrap();
    assert_eq!(out.positions[80..], rest[80..], "the other leg moved");
    assert!(out.rotations[80..].iter().all(|r| far(r, &IDENTITY) < 1e-12));
    assert!(far(&out.positions[60..79], &rest[60..79]) > 0.1, "the dragged leg did not follow");
}

#[test]
fn odd_queries_have_results() {
    assert!(drag(&[], &[], 3).unwrap().positions.is_empty());
    let one = Handle { node: 0, target: [1.0, 2.0, 3.0], rotation: None };
    assert_eq!(drag(&[[0.0; 3]], &[one], 3).unwrap().positions, [[1.0, 2.0, 3.0]]);
    assert_eq!(drag(&[[0.5; 3]; 20], &[one], 3).unwrap().positions[0], [1.0, 2.0, 3.0]);
    let error = |h: &[Handle]| drag(&[[0.0; 3]], h, 3).unwrap_err().to_string();
    assert!(error(&[Handle { node: 4, ..one }]).contains("handle 4"));
    assert!(error(&[one, one]).contains("twice"));
    assert!(error(&[Handle { target: [f64::NAN; 3], ..one }]).contains("finite"));
}

#[test]
fn a_thousand_nodes_are_dragged_at_once() {
    let rng = Rng::new(9, "ball", 0);
    let rest: Vec<[f64; 3]> = (0..1000).map(|i| std::array::from_fn(|k| rng.fork(i).normal(k as u64))).collect();
    let handles: Vec<Handle> =
        (0..20).map(|k| Handle { node: 50 * k, target: rest[50 * k].map(|x| 1.1 * x), rotation: None }).collect();
    let body = Elastic::new(&rest);
    let best = (0..5).map(|_| {
        let clock = Instant::now();
        body.drag(&handles, 3).unwrap();
        clock.elapsed()
    });
    let best = best.min().expect("five runs");
    println!("dragging 1000 nodes: {best:?}");
    // Fifteen milliseconds are the aim on a quiet machine; a machine that others use may take several times that.
    assert!(best.as_millis() < 150, "{best:?}");
}
