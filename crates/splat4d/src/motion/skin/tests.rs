use super::*;
use crate::math::{quat, se3};
use crate::motion::control::{ControlSpec, Curve, Keys, Timeline, TrajectorySpec, skinned};
use crate::motion::still::activate;
use crate::scene::splats::COV;

/// The same poses at all times.
struct Held(Table<f64>);

impl Trajectory<f64> for Held {
    fn scratch_bytes(&self, _p: &Params<f64>) -> u64 {
        0
    }

    fn poses(&self, _: &Params<f64>, _: Time, _: &Slot, out: &mut Table<f64>) {
        *out = self.0.clone();
    }

    fn poses_backward(
        &self,
        _: &Params<f64>,
        _: Time,
        _: &Slot,
        _: &Table<f64>,
        _: &mut Slot,
        _: &mut Grads<f64>,
    ) -> f64 {
        0.0
    }
}

fn cloud<F: Real>(rows: usize, seed: u64) -> Params<F> {
    let mut p = Params::new(rows, 1, &[]);
    let rng = Rng::new(seed, "cloud", 0);
    for row in 0..rows {
        let draw = |c: usize| F::of(0.5 * rng.fork(row as u64).normal(c as u64));
        p[GEOMETRY].write::<11>(row, 0, std::array::from_fn(draw));
        p[GEOMETRY].add(row, 3, [F::ONE]);
    }
    p
}

fn ask<F: Real>(m: &impl Motion<F>, p: &Params<F>, t: f64) -> Table<F> {
    let q = At { p, of: Space::Gaussians, rows: Rows::All, t: Time(t) };
    let (mut cache, mut tape) = (Cache::default(), Tape::default());
    m.prepare(p, &[q], &mut cache);
    m.at(&q, &cache, &mut tape);
    tape.out
}

fn spec(nodes: usize, hyper: usize, mask: bool) -> SkinSpec {
    SkinSpec { nodes, neighbours: 3, hyper, mask }
}

#[test]
fn weights_sum_to_one_also_far_from_every_node() {
    let mut p = cloud::<f64>(60, 1);
    let skin = Skin::new(spec(12, 2, false), 1, &mut p).unwrap();
    p[GEOMETRY].write(7, 0, [1e6, -1e6, 1e6]);
    (0..12).for_each(|k| p[skin.nodes].set(k, NODE_LOGIT, -40.0 * k as f64));
    let mut w = Weights::default();
    w.fill(&skin, &p);
    for id in 0..60 {
        let (nodes, a) = w.row(id);
        assert_eq!(nodes.len(), 3);
        assert!((a.iter().sum::<f64>() - 1.0).abs() < 1e-12 && a.iter().all(|&a| a > 0.0), "{a:?}");
        assert!(a.windows(2).all(|a| a[0] >= a[1]), "the strongest comes first");
    }
    // Fewer nodes than pull, and none at all.
    for nodes in [0, 1, 2] {
        let mut p = cloud::<f64>(10, 2);
        let rest = p[GEOMETRY].clone();
        let skin = Skin::new(spec(nodes, 0, false), 1, &mut p).unwrap();
        let poses = Table::new(&POSE_COLUMNS, nodes);
        let out = ask(&Skinned::new(skin, Box::new(Held(poses)), Spec::Still), &p, 0.0);
        (0..10).for_each(|r| assert!((out.get(r, 0) - rest.get(r, 0)).abs() < 1e-12, "{nodes} nodes"));
    }
}

#[test]
fn candidates_are_the_nodes_of_least_energy() {
    let mut p = cloud::<f64>(150, 3);
    let skin = Skin::new(spec(50, 3, false), 1, &mut p).unwrap();
    let rng = Rng::new(3, "shake", 0);
    for k in 0..50 {
        for c in NODE_LOG_RADIUS..NODE_HYPER + 3 {
            *p[skin.nodes].get_mut(k, c) += 0.4 * rng.fork(k as u64).normal(c as u64);
        }
    }
    skin.bind(&mut p);
    for id in 0..150 {
        let energy = |k: usize| {
            let n = &p[skin.nodes];
            let mut square = (0..3).map(|c| (p[GEOMETRY].get(id, c) - n.get(k, c)).powi(2)).sum::<f64>();
            square += (0..3).map(|c| (p[skin.hyper].get(id, c) - n.get(k, NODE_HYPER + c)).powi(2)).sum::<f64>();
            let r = n.get(k, NODE_LOG_RADIUS).exp();
            square / (2.0 * r * r) - n.get(k, NODE_LOGIT).sigmoid().ln()
        };
        let mut order: Vec<usize> = (0..50).collect();
        order.sort_by(|&a, &b| energy(a).total_cmp(&energy(b)));
        let list = p[skin.candidates].read::<8>(id, 0).map(|x| x as usize);
        assert_eq!(list[..], order[..8], "Gaussian {id}");
    }
}

#[test]
fn weights_are_continuous_where_neighbours_switch() {
    let mut p = cloud::<f64>(40, 4);
    let skin = Skin::new(spec(30, 0, false), 1, &mut p).unwrap();
    let (from, to) = (p[GEOMETRY].read::<3>(0, 0), p[GEOMETRY].read::<3>(25, 0));
    let steps = 20_000;
    let (mut before, mut switches, mut last) = (vec![0.0; 30], 0, Vec::new());
    for i in 0..=steps {
        let s = f64::from(i) / f64::from(steps);
        p[GEOMETRY].write(0, 0, std::array::from_fn::<f64, 3, _>(|k| from[k] + s * (to[k] - from[k])));
        skin.bind(&mut p);
        let mut w = Weights::default();
        w.fill(&skin, &p);
        let (nodes, a) = w.row(0);
        let mut dense = vec![0.0; 30];
        nodes.iter().zip(a).for_each(|(&k, &a)| dense[k as usize] = a);
        let mut set = nodes.to_vec();
        set.sort_unstable();
        if i > 0 {
            let jump = dense.iter().zip(&before).map(|(a, b)| f64::abs(a - b)).fold(0.0, f64::max);
            assert!(jump < 5e-3, "a weight jumps by {jump} at {s}");
            switches += usize::from(set != last);
        }
        (before, last) = (dense, set);
    }
    assert!(switches >= 4, "the path crosses too few borders to show anything: {switches}");
}

#[test]
fn one_motion_of_all_nodes_moves_every_gaussian_rigidly() {
    let mut p = cloud::<f64>(50, 5);
    let skin = Skin::new(spec(9, 2, false), 1, &mut p).unwrap();
    let (q, _) = quat::normalize([0.8, 0.3, -0.5, 0.2]);
    let body = se3::Se3 { rotation: quat::to_rotation(q), translation: [0.3, -2.0, 0.7] };
    let mut poses = Table::new(&POSE_COLUMNS, 9);
    for k in 0..9 {
        let rest = p[skin.nodes].read::<3>(k, 0);
        let shift = se3::sub(body.apply(rest), rest);
        // Half of them are the same rotation with the other sign.
        let s = if k % 2 == 0 { 1.0 } else { -1.0 };
        poses.write(k, 0, [shift[0], shift[1], shift[2], s * q[0] - 1.0, s * q[1], s * q[2], s * q[3]]);
    }
    let out = ask(&Skinned::new(skin, Box::new(Held(poses)), Spec::Still), &p, 0.0);
    for r in 0..50 {
        let rest = activate(p[GEOMETRY].read::<11>(r, 0));
        let mean = body.apply([rest[0], rest[1], rest[2]]);
        let c: [f64; 6] = std::array::from_fn(|k| rest[COV + k]);
        let full = [[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]];
        let m = se3::mat_mul(&se3::mat_mul(&body.rotation, &full), &se3::transpose(&body.rotation));
        let expected = [mean[0], mean[1], mean[2], m[0][0], m[0][1], m[0][2], m[1][1], m[1][2], m[2][2], rest[9]];
        for (c, e) in expected.iter().enumerate() {
            assert!((out.get(r, c) - e).abs() < 1e-9, "row {r} column {c}");
        }
    }
}

#[test]
fn an_edit_of_nodes_keeps_the_image() {
    let spec = ControlSpec {
        skin: spec(14, 2, true),
        trajectory: TrajectorySpec::Keys { curve: Curve::Cubic, keys: 5 },
        ..ControlSpec::default()
    };
    let mut p = cloud::<f64>(40, 6);
    let motion = skinned(&spec, &mut p).unwrap();
    let keys = p.find("node_keys").unwrap();
    let rng = Rng::new(6, "keys", 0);
    for (k, c) in (0..14).flat_map(|k| (0..35).map(move |c| (k, c))) {
        p[keys].set(k, c, 0.1 * rng.fork(k as u64).normal(c as u64));
    }
    let before = ask(&motion, &p, 0.37);
    let mut edit = RowEdit::identity(Space::Nodes, 14);
    edit.parent.reverse();
    p.apply(&edit);
    motion.on_edit(&mut p, &edit, &rng);
    let after = ask(&motion, &p, 0.37);
    assert!(before.data().iter().zip(after.data()).all(|(a, b)| (a - b).abs() < 1e-12));
    // A file states how many nodes there are now, whatever the spec began with.
    let mut edit = RowEdit::identity(Space::Nodes, 14);
    edit.push(3, crate::scene::Born::Clone);
    p.apply(&edit);
    motion.on_edit(&mut p, &edit, &rng);
    assert_eq!((motion.skin.count(&p), ask(&motion, &p, 0.1).rows()), (15, 40));
}

#[test]
fn dragged_nodes_take_their_gaussians_along() {
    let mut p = cloud::<f64>(40, 7);
    let motion = skinned(&ControlSpec { skin: spec(10, 0, false), ..ControlSpec::default() }, &mut p).unwrap();
    let rest: Vec<[f64; 3]> = (0..10).map(|k| p[motion.skin.nodes].read(k, 0)).collect();
    let (s, c) = 0.7f64.sin_cos();
    let body = se3::Se3 { rotation: [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], translation: [1.0, 0.0, -0.5] };
    let handles: Vec<_> = (0..10)
        .map(|node| crate::motion::arap::Handle { node, target: body.apply(rest[node]), rotation: None })
        .collect();
    let dragged = crate::motion::arap::drag(&rest, &handles, 2).unwrap();
    let out = ask(&motion.with_offsets(dragged.poses(&rest)), &p, 0.5);
    for r in 0..40 {
        let expected = body.apply(p[GEOMETRY].read(r, 0));
        assert!((0..3).all(|k| (out.get(r, k) - expected[k]).abs() < 1e-6), "row {r}");
    }
}

/// Two bones, hinged at the origin, turn by different angles; nodes learn poses from where points went.
#[test]
fn nodes_recover_the_rotations_of_two_bones() {
    let rng = Rng::new(8, "bones", 0);
    let mut p = Params::<f64>::new(240, 1, &[]);
    for r in 0..240 {
        let side = if r % 2 == 0 { -1.0 } else { 1.0 };
        let u = |k: u64| rng.fork(r as u64).uniform(k) - 0.5;
        p[GEOMETRY].write(r, 0, [side * (1.1 + u(0)), 0.3 * u(1), 0.3 * u(2), 1.0, 0.0, 0.0, 0.0]);
    }
    let angles = [0.5, -0.35];
    let turn = |a: f64, x: [f64; 3]| [a.cos() * x[0] - a.sin() * x[1], a.sin() * x[0] + a.cos() * x[1], x[2]];
    let bone = |x: [f64; 3]| usize::from(x[0] > 0.0);
    let skin = Skin::new(spec(12, 0, false), 1, &mut p).unwrap();
    let line = Timeline::new(Curve::Linear, 2, [0.0, 1.0]).unwrap();
    let keys = Keys::new(line, &skin, &mut p).unwrap();
    let motion = Skinned::new(skin, Box::new(keys), Spec::Still);
    let goal: Vec<[f64; 3]> = (0..240).map(|r| p[GEOMETRY].read(r, 0)).map(|x| turn(angles[bone(x)], x)).collect();
    // Plain momentum on the second key.
    let mut speed = p[keys.table()].zeros_like();
    for _ in 0..1500 {
        let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: Time(1.0) };
        let (mut cache, mut d_cache, mut tape) = (Cache::default(), Cache::default(), Tape::default());
        let mut d = Grads::new(&p);
        motion.prepare(&p, &[q], &mut cache);
        motion.at(&q, &cache, &mut tape);
        let mut d_out = tape.out.zeros_like();
        for (r, goal) in goal.iter().enumerate() {
            d_out.write(r, 0, se3::sub(tape.out.read(r, 0), *goal));
        }
        let grads = SplatGrads { out: &d_out, color: None, weights: None };
        motion.backward(&q, &cache, &mut tape, &grads, &mut d_cache, &mut d);
        motion.finish(&p, &[q], &mut cache, &mut d_cache, &mut d);
        let table = d.table(keys.table());
        for (s, g) in speed.data_mut().iter_mut().zip(table.data()) {
            *s = 0.9 * *s - 0.02 * g;
        }
        p[keys.table()].data_mut().iter_mut().zip(speed.data()).for_each(|(x, s)| *x += s);
    }
    let poses = motion.poses(&p, Time(1.0));
    for k in 0..12 {
        let rest = p[skin.nodes].read::<3>(k, 0);
        let (_, r) = node_frame(rest, poses.read(k, 0));
        let angle = r[1][0].atan2(r[0][0]);
        let off = (angle - angles[bone(rest)]).abs().to_degrees();
        assert!(off < 2.0, "node {k} at {rest:?} turned {}°, off by {off}°", angle.to_degrees());
    }
}

#[test]
fn damaged_files_and_wrong_specs_are_no_panic() {
    let bad = [
        SkinSpec { nodes: MAX_NODES + 1, ..SkinSpec::default() },
        SkinSpec { neighbours: 0, ..SkinSpec::default() },
        SkinSpec { hyper: 1000, ..SkinSpec::default() },
    ];
    for spec in bad {
        assert!(Skin::new(spec, 0, &mut cloud::<f32>(5, 1)).is_err(), "{spec:?}");
    }
    let mut p = cloud::<f64>(30, 1);
    let skin = Skin::new(spec(9, 0, false), 1, &mut p).unwrap();
    for r in 0..30 {
        p[skin.candidates].write(r, 0, [f64::NAN, -5.0, 1e300, 3.0, 3.0, 3.0, 3.0, f64::INFINITY]);
    }
    p[skin.nodes].write(3, 0, [f64::NAN; 3]);
    let poses = Table::new(&POSE_COLUMNS, 9);
    assert_eq!(ask(&Skinned::new(skin, Box::new(Held(poses)), Spec::Still), &p, 0.0).rows(), 30);
}
