use super::*;
use crate::actions::Actions;
use crate::learnt::{Learnt, Training, Window, rollout_loss};
use crate::paths::{Paths, Pose, exp};
use splat4d::math::quat;
use splat4d::math::se3::mat_vec;

/// Half the step of central differences.
const H: f64 = 1e-6;
const SCALES: Scales = Scales { length: 1.5, velocity: 0.1, acceleration: 0.02 };

fn moment(n: usize, seed: u64) -> Moment {
    let rng = Rng::new(seed, "moment", 0);
    (0..n as u64).map(|k| Pose::at([0, 1, 2].map(|c| rng.normal(3 * k + c)))).collect()
}

fn spec() -> GraphSpec {
    let gravity = Some([0.0, -1.0, 0.0]);
    GraphSpec { width: 6, layers: 2, gravity, floor: Some(-2.0), momentum: false, actions: [1, 1] }
}

/// A network all of whose weights matter, among nodes that are not at rest.
fn made(n: usize, spec: GraphSpec) -> (GraphNet, Params<f64>, State<f64>) {
    let (net, mut p) = GraphNet::new(spec, SCALES, &moment(n, 1), 5).unwrap();
    for key in p.keys().collect::<Vec<_>>() {
        let rng = Rng::new(9, "weights", u64::from(key.0));
        let rows = p[key].rows();
        p[key].data_mut()[..rows].iter_mut().enumerate().for_each(|(i, x)| *x += 0.2 * rng.normal(i as u64));
    }
    let flat = |seed| moment(n, seed).iter().flat_map(|p| p.x).collect::<Vec<f64>>();
    let x = flat(1).iter().zip(flat(2)).map(|(a, b)| a + 0.1 * b).collect();
    (net, p, State { x, v: flat(3).iter().map(|x| 0.1 * x).collect() })
}

const ACTION: [f64; 4] = [0.3, -0.2, 0.9, 0.5];

fn apply(net: &GraphNet, p: &Params<f64>, s: &State<f64>, action: [f64; 4]) -> Vec<f64> {
    net.accelerations(p, s, &[action.to_vec()], &mut Vec::new(), &mut Step::default())
}

#[test]
fn a_turned_and_moved_scene_accelerates_turned() {
    // Without a floor: a floor is somewhere.
    let (mut net, p, s) = made(7, GraphSpec { floor: None, ..spec() });
    let a = apply(&net, &p, &s, ACTION);
    let size = a.iter().map(|x| x * x).sum::<f64>().sqrt();
    for seed in 0..50 {
        let rng = Rng::new(seed, "turn", 0);
        let r = quat::to_rotation(exp([0, 1, 2].map(|c| 2.0 * rng.normal(c))));
        let shift = [3, 4, 5].map(|c| rng.normal(c));
        let turned = |x: &[f64], shift: [f64; 3]| -> Vec<f64> {
            x.chunks_exact(3)
                .flat_map(|x| {
                    let y = mat_vec(&r, [x[0], x[1], x[2]]);
                    [0, 1, 2].map(|c| y[c] + shift[c])
                })
                .collect()
        };
        net.spec.gravity = Some(mat_vec(&r, [0.0, -1.0, 0.0]));
        let u = mat_vec(&r, [ACTION[0], ACTION[1], ACTION[2]]);
        let there = State { x: turned(&s.x, shift), v: turned(&s.v, [0.0; 3]) };
        let found = apply(&net, &p, &there, [u[0], u[1], u[2], ACTION[3]]);
        let apart = found.iter().zip(turned(&a, [0.0; 3])).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        assert!(apart < 1e-9 * size, "{apart} of {size}");
    }
    // The control: turned without its gravity it is another scene.
    net.spec.gravity = Some([1.0, 0.0, 0.0]);
    let other = apply(&net, &p, &s, ACTION);
    assert!(a.iter().zip(other).any(|(a, b)| (a - b).abs() > 1e-3 * size));
}

#[test]
fn the_order_of_nodes_does_not_matter() {
    let n = 6;
    let (net, p, s) = made(n, spec());
    let order = [3, 0, 5, 1, 4, 2];
    let (other, mut q) = GraphNet::new(spec(), SCALES, &order.map(|i| moment(n, 1)[i]).to_vec(), 5).unwrap();
    for (a, b) in p.keys().zip(q.keys().collect::<Vec<_>>()) {
        q[b] = p[a].clone();
    }
    for (to, from) in order.iter().enumerate() {
        let e = p[net.embedding].data()[EMBEDDING * from..][..EMBEDDING].to_vec();
        q[other.embedding].data_mut()[EMBEDDING * to..][..EMBEDDING].copy_from_slice(&e);
    }
    let gather = |x: &[f64]| order.iter().flat_map(|&i| row(x, i)).collect::<Vec<f64>>();
    let found = apply(&other, &q, &State { x: gather(&s.x), v: gather(&s.v) }, ACTION);
    for (a, b) in found.iter().zip(gather(&apply(&net, &p, &s, ACTION))) {
        assert!((a - b).abs() < 1e-12, "{a} {b}");
    }
}

#[test]
fn forces_along_edges_conserve_momentum() {
    let sum = |momentum| {
        let (net, p, s) = made(8, GraphSpec { momentum, ..spec() });
        let a = apply(&net, &p, &s, ACTION);
        let size: f64 = a.iter().map(|x| x.abs()).sum();
        (0..3).map(|c| a.chunks_exact(3).map(|a| a[c]).sum::<f64>().abs()).fold(0.0, f64::max) / size
    };
    assert!(sum(true) < 1e-12, "{}", sum(true));
    assert!(sum(false) > 1e-3, "with gravity, drag and actions they do not");
}

#[test]
fn gradients_through_a_rollout_are_those_of_finite_differences() {
    const HORIZON: usize = 4;
    let (net, mut p, state) = made(5, spec());
    let noisy = |seed: u64| State {
        x: state.x.iter().zip(moment(5, seed).iter().flat_map(|p| p.x)).map(|(a, b)| a + 0.05 * b).collect(),
        v: state.v.clone(),
    };
    let actions = vec![vec![ACTION.to_vec()]; HORIZON];
    let mut w = Window {
        before: Vec::new(),
        state: state.clone(),
        actions,
        truth: (0..HORIZON as u64).map(|h| noisy(20 + h)).collect(),
    };
    let mut d = Grads::new(&p);
    let (_, d_state, d_actions) = rollout_loss(&net, &p, &w, Some(&mut d));
    let mut checked = 0;
    for key in p.keys().filter(|&k| p[k].rows() > 0).collect::<Vec<_>>() {
        let rows = p[key].rows();
        for i in (0..rows).step_by(1 + rows / 3) {
            let value = p[key].data()[i];
            let mut at = |x: f64| {
                p[key].data_mut()[i] = x;
                rollout_loss(&net, &p, &w, None).0
            };
            let slope = (at(value + H) - at(value - H)) / (2.0 * H);
            at(value);
            let found = d.table(key).data()[i];
            assert!((found - slope).abs() < 1e-6 * (1.0 + slope.abs()), "{:?} {i}: {found}, {slope}", key);
            checked += usize::from(slope.abs() > 1e-8);
        }
    }
    assert!(checked > 20, "{checked} weights matter");
    for i in 0..state.x.len() {
        for part in 0..2 {
            let mut at = |h: f64| {
                w.state = state.clone();
                [&mut w.state.x, &mut w.state.v][part][i] += h;
                rollout_loss(&net, &p, &w, None).0
            };
            let slope = (at(H) - at(-H)) / (2.0 * H);
            let found = [&d_state.x, &d_state.v][part][i];
            assert!((found - slope).abs() < 1e-6 * (1.0 + slope.abs()), "state {part} {i}: {found}, {slope}");
        }
    }
    w.state = state.clone();
    for h in 0..w.actions.len() {
        for i in 0..ACTION.len() {
            let mut at = |x: f64| {
                w.actions[h][0][i] = ACTION[i] + x;
                rollout_loss(&net, &p, &w, None).0
            };
            let slope = (at(H) - at(-H)) / (2.0 * H);
            at(0.0);
            let found = d_actions[h][0][i];
            assert!((found - slope).abs() < 1e-6 * (1.0 + slope.abs()), "action {h} {i}: {found}, {slope}");
            assert!(slope.abs() > 1e-9, "the action matters");
        }
    }
}

#[test]
fn friction_and_pushes_are_learnt_from_a_few_steps() {
    // A body of four nodes: v ← 0.9 v + push.
    let rng = Rng::new(4, "push", 0);
    let rows: Vec<Vec<f64>> =
        (0..90u64).map(|t| vec![0.05 * rng.normal(t / 6), 0.0, 0.05 * rng.normal(100 + t / 6)]).collect();
    let actions = Actions { names: ["push.x", "push.y", "push.z"].map(String::from).to_vec(), rows };
    let corners = [[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.4]];
    let (mut x, mut v) = ([0.0; 3], [0.0; 3]);
    let mut points = Vec::new();
    for t in 0..90 {
        points.push(corners.iter().map(|c| std::array::from_fn(|i| c[i] + x[i])).collect::<Vec<[f64; 3]>>());
        v = std::array::from_fn(|c| 0.9 * v[c] + actions.rows[t][c]);
        x = std::array::from_fn(|c| x[c] + v[c]);
    }
    let (all, seen) = (Paths::of_points(&points), Paths::of_points(&points[..70]));
    let spec = GraphSpec { width: 16, layers: 1, ..GraphSpec::default() };
    let training = Training { steps: 250, seed: 1 };
    let error = |actions: Option<&Actions>| {
        let model = Learnt::<GraphNet>::fit(&seen, actions, &training, |scales, actions, seed| {
            GraphNet::new(GraphSpec { actions, ..spec.clone() }, scales, seen.last(), seed)
        })
        .unwrap();
        let out = model.rollout(&seen, actions, 19);
        norm(sub(out[18][0].x, all.moments[88][0].x))
    };
    let (with, without) = (error(Some(&actions)), error(None));
    assert!(2.0 * with < without, "{with} with actions, {without} without");
}
