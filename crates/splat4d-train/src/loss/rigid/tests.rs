use super::*;
use crate::loss::graph::Weigh;
use splat4d::math::Rng;

const N: usize = 40;

fn normals<const W: usize>(purpose: &str) -> Vec<[f64; W]> {
    let rng = Rng::new(6, purpose, 0);
    (0..N as u64).map(|i| std::array::from_fn(|a| rng.fork(i).normal(a as u64))).collect()
}

struct Case {
    graph: Graph<f64>,
    before: (Vec<[f64; 3]>, Vec<[f64; 4]>),
    now: (Vec<[f64; 3]>, Vec<[f64; 4]>),
}

fn poses<'a>(p: &'a (Vec<[f64; 3]>, Vec<[f64; 4]>)) -> Poses<'a, f64> {
    Poses { x: &p.0, q: &p.1 }
}

/// A cloud, moved by one rotation and shift, with quaternions of any length and sign.
fn rigid(turn_by: [f64; 4], shift: [f64; 3]) -> Case {
    let x: Vec<[f64; 3]> = normals("x");
    let q: Vec<[f64; 4]> = normals("q");
    let unit = quat::normalize(turn_by).0;
    let r = quat::to_rotation(unit);
    let moved = x.iter().map(|&p| std::array::from_fn(|k| turn(&r, p)[k] + shift[k])).collect();
    let turned =
        q.iter().enumerate().map(|(i, &q)| quat::product(unit, q).map(|v| v * (0.5 + 0.1 * i as f64))).collect();
    Case { graph: Graph::new(&x, 6, Weigh::Median(1.0)), before: (x, q), now: (moved, turned) }
}

fn shaken() -> Case {
    let mut case = rigid([0.9, 0.2, -0.3, 0.1], [0.3, -0.2, 0.5]);
    for (x, by) in case.now.0.iter_mut().zip(normals::<3>("shake x")) {
        add_to(x, by, 0.2);
    }
    for (q, by) in case.now.1.iter_mut().zip(normals::<4>("shake q")) {
        add_to(q, by, 0.2);
    }
    case
}

type Loss = fn(&Case, &mut [[f64; 3]], &mut [[f64; 4]]) -> f64;
const LOSSES: [(&str, Loss); 3] = [
    ("rigidity", |c, d_x, d_q| rigidity(&c.graph, poses(&c.now), poses(&c.before), 0.7, d_x, d_q)),
    ("rotation", |c, _, d_q| rotation(&c.graph, &c.now.1, &c.before.1, 0.7, d_q)),
    ("isometry", |c, d_x, _| isometry(&c.graph, &c.now.0, 0.7, d_x)),
];

fn eval(loss: Loss, case: &Case) -> (f64, Vec<[f64; 3]>, Vec<[f64; 4]>) {
    let (mut d_x, mut d_q) = (vec![[0.0; 3]; N], vec![[0.0; 4]; N]);
    let value = loss(case, &mut d_x, &mut d_q);
    (value, d_x, d_q)
}

#[test]
fn a_rigid_motion_has_no_loss() {
    let case = rigid([0.5, -0.7, 0.1, 0.4], [3.0, 1.0, -2.0]);
    for (name, loss) in LOSSES {
        let value = eval(loss, &case).0;
        assert!(value < 1e-9, "{name}: {value}");
        assert!(eval(loss, &shaken()).0 > 1e-2, "{name} must feel what is not rigid");
    }
}

#[test]
fn gradients_equal_finite_differences_at_quaternions_of_any_length() {
    for (name, loss) in LOSSES {
        let (_, d_x, d_q) = eval(loss, &shaken());
        for i in [0, 3, 17, 39] {
            for k in 0..7 {
                let at = |h: f64| {
                    let mut case = shaken();
                    if k < 3 {
                        case.now.0[i][k] += h;
                    } else {
                        case.now.1[i][k - 3] += h;
                    }
                    eval(loss, &case).0
                };
                let fd = (at(1e-6) - at(-1e-6)) / 2e-6;
                let got = if k < 3 { d_x[i][k] } else { d_q[i][k - 3] };
                assert!((fd - got).abs() < 1e-8, "{name} {i},{k}: {fd} {got}");
            }
        }
    }
}

#[test]
fn rotation_and_stretch_are_distinguished() {
    let mut case = rigid([1.0, 0.0, 0.0, 0.0], [0.0; 3]);
    for (q, by) in case.now.1.iter_mut().zip(normals::<4>("own turns")) {
        add_to(q, by, 0.5);
    }
    let value = |i: usize, case: &Case| eval(LOSSES[i].1, case).0;
    assert!(value(1, &case) > 0.05 && value(2, &case) < 1e-9);
    // Everything larger by a share: as much as the edges are long.
    let mut case = rigid([0.4, 0.1, 0.9, 0.0], [1.0; 3]);
    case.now.0.iter_mut().flatten().for_each(|x| *x *= 1.01);
    let g = &case.graph;
    let mean = g.weights().iter().zip(g.lengths()).map(|(w, d)| w.sqrt() * d).sum::<f64>() / g.edges() as f64;
    let got = value(2, &case);
    assert!((got - 0.7 * 0.01 * mean).abs() < 1e-9, "{got} {mean}");
}

#[test]
fn a_rotation_of_the_world_keeps_the_loss() {
    let world = quat::normalize([0.2, 0.5, -0.6, 0.3]).0;
    let r = quat::to_rotation(world);
    let case = shaken();
    let mut turned = shaken();
    for side in [&mut turned.before, &mut turned.now] {
        side.0.iter_mut().for_each(|x| *x = turn(&r, *x));
        side.1.iter_mut().for_each(|q| *q = quat::product(world, *q));
    }
    for (name, loss) in LOSSES {
        let (a, b) = (eval(loss, &case).0, eval(loss, &turned).0);
        assert!((a - b).abs() < 1e-12, "{name}: {a} {b}");
    }
}

#[test]
fn the_other_sign_of_a_quaternion_is_the_same_turn() {
    let case = shaken();
    let mut flipped = shaken();
    flipped.now.1.iter_mut().step_by(3).for_each(|q| *q = q.map(|x| -x));
    for (name, loss) in LOSSES {
        assert!((eval(loss, &case).0 - eval(loss, &flipped).0).abs() < 1e-12, "{name}");
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let n = 3000;
    let rng = Rng::new(1, "threads", 0);
    let x: Vec<[f32; 3]> = (0..n).map(|i| std::array::from_fn(|a| rng.fork(i).normal(a as u64) as f32)).collect();
    let q: Vec<[f32; 4]> = (0..n).map(|i| std::array::from_fn(|a| rng.fork(i).normal(a as u64 + 9) as f32)).collect();
    let before: Vec<[f32; 3]> = x.iter().map(|p| p.map(|v| 1.1 * v)).collect();
    let mut turned = q.clone();
    turned.rotate_left(1);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let graph = Graph::new(&before, 8, Weigh::Median(1.0));
            let (mut d_x, mut d_q) = (vec![[0.0; 3]; x.len()], vec![[0.0; 4]; x.len()]);
            let before = Poses { x: &before, q: &turned };
            let mut sum = rigidity(&graph, Poses { x: &x, q: &q }, before, 1.0, &mut d_x, &mut d_q);
            sum += rotation(&graph, &q, &turned, 1.0, &mut d_q) + isometry(&graph, &x, 1.0, &mut d_x);
            (sum, d_x, d_q)
        })
    };
    assert!(run(1) == run(3));
}
