use super::*;
use crate::math::quat;
use crate::motion::Still;
use crate::scene::{GEOMETRY, Rows};

/// Twelve Gaussians in a row along x, dragged by `change` at t.
fn at(change: Change, offsets: Option<NodeOffsets>, t: f64) -> Table<f64> {
    let mut p = Params::<f64>::new(12, 1, &[]);
    for row in 0..12 {
        p[GEOMETRY].write(row, 0, [0.1 * row as f64, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -2.0, -3.0, -3.0, 0.0]);
    }
    let model = Edited::around(Arc::new(Still), change, &mut p).unwrap();
    if let Some(offsets) = offsets {
        model.fill_drag(&offsets, &mut p);
    }
    let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: Time(t) };
    let mut tape = Tape::default();
    model.at(&q, &Cache::default(), &mut tape);
    tape.out
}

#[test]
fn a_path_passes_its_keys_and_turns_shapes() {
    let quarter = [0.5f64.sqrt(), 0.0, 0.0, 0.5f64.sqrt()];
    let end = PathKey { t: 2.0, turn: quarter, shift: [0.0, 0.0, 1.0], ..PathKey::default() };
    let keys = vec![PathKey::default(), end];
    let there = at(Change::Path { about: [0.0; 3], keys: keys.clone() }, None, 3.0);
    for row in 0..12 {
        let x = 0.1 * row as f64;
        let mean = there.read::<3>(row, 0);
        assert!((0..3).all(|k| (mean[k] - [0.0, x, 1.0][k]).abs() < 1e-12), "{mean:?}");
        // The long axis was x and is y.
        assert!((there.get(row, COV + 3) - (-4.0f64).exp()).abs() < 1e-12);
    }
    // Half way in time is half way of the angle, about the position that it turns about.
    let about = [0.1, -0.2, 0.3];
    let half = at(Change::Path { about, keys }, None, 1.0).read::<3>(10, 0);
    let angle = |x: [f64; 3]| (x[1] - about[1]).atan2(x[0] - about[0]);
    let turned = angle(half) - angle([1.0, 0.0, 0.0]);
    assert!((turned - std::f64::consts::FRAC_PI_4).abs() < 1e-12 && (half[2] - 0.5).abs() < 1e-12, "{half:?}");
}

#[test]
fn rigidly_moving_nodes_move_their_gaussians_alone() {
    let turn = quat::normalize([0.8, 0.1, -0.3, 0.4]).0;
    let (r, shift) = (quat::to_rotation(turn), [0.2, -0.1, 0.4]);
    let places = [[0.0, 0.1, 0.0], [0.6, 0.0, 0.2], [1.1, 0.0, 0.0]];
    let body = |p: [f64; 3]| -> [f64; 3] { std::array::from_fn(|i| dot(r[i], p) + shift[i]) };
    let moved = |p: [f64; 3]| (p, std::array::from_fn(|k| body(p)[k] - p[k]), turn);
    let rest = places.map(|p| (p, [0.0; 3], [1.0, 0.0, 0.0, 0.0]));
    let nodes = rest.into_iter().chain(places.map(moved)).collect();
    // Odd rows are pulled by two nodes, even ones by none.
    let pulls = (0..12u32).flat_map(|i| [(i % 3, 0.25), ((i + 1) % 3, 0.75)].map(|(n, w)| (n, w * (i % 2) as f32)));
    let offsets = NodeOffsets { nodes, pulls: pulls.collect() };
    let change = Change::Drag(DragSpec { index: 0, nodes: 3, neighbours: 2, times: vec![0.0, 1.0] });
    let (before, after) = (at(change.clone(), Some(offsets.clone()), -1.0), at(change, Some(offsets), 2.0));
    for row in 0..12 {
        let x = [0.1 * row as f64, 0.0, 0.0];
        let (a, b) = (before.read::<3>(row, 0), after.read::<3>(row, 0));
        let to = if row % 2 == 1 { body(x) } else { x };
        assert!((0..3).all(|k| (a[k] - x[k]).abs() < 1e-12 && (b[k] - to[k]).abs() < 1e-6), "row {row}: {b:?} {to:?}");
        let (s, q) = (before.read::<6>(row, COV), after.read::<6>(row, COV));
        let turned = if row % 2 == 1 { congruence(&r, s) } else { s };
        assert!((0..6).all(|k| (q[k] - turned[k]).abs() < 1e-6), "row {row}");
    }
}

#[test]
fn invalid_changes_are_refused() {
    let mut p = Params::<f32>::new(2, 1, &[]);
    let key = |t| PathKey { t, ..PathKey::default() };
    for (change, word) in [
        (Change::Clock { rate: 0.0, offset: 0.0 }, "rate"),
        (Change::Path { about: [0.0; 3], keys: vec![] }, "keys"),
        (Change::Path { about: [0.0; 3], keys: vec![key(1.0), key(1.0)] }, "keys"),
        (Change::Path { about: [0.0; 3], keys: vec![PathKey { scale: 0.0, ..key(0.0) }] }, "similarities"),
        (Change::Fade { keys: vec![FadeKey { t: 0.0, factor: 1.5, ease: false }] }, "factors"),
        (Change::Drag(DragSpec { index: 0, nodes: 0, neighbours: 2, times: vec![0.0] }), "nodes"),
    ] {
        let error = Edited::around(Arc::new(Still), change, &mut p).err().expect("it cannot be").to_string();
        assert!(error.contains(word), "{error}");
    }
}
