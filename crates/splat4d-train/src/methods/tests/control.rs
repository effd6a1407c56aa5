//! Control nodes in training: losses on nodes reach what drives them, nodes are added and removed where they should be,
//! and a scene on nodes learns.

use super::*;
use crate::maintenance::tests::context;
use crate::maintenance::{AdaptNodes, At, Context, Maintenance, NodeSettings};
use crate::methods::control::losses::{MaskSize, NodeAcceleration, NodeArap, NodeElastic, Sparse};
use crate::train_state::{Observation, TrainState};
use splat4d::layers::Evaluation;
use splat4d::motion::control::{ControlSpec, Curve, TrajectorySpec};
use splat4d::motion::skin::{Skin, SkinSpec};
use splat4d::scene::Rows;

fn skinned<F: Real>(rows: usize, nodes: usize, trajectory: TrajectorySpec) -> Scene<F> {
    let mut p = cloud::<F>(rows, LifeKind::Infinite, 3);
    let skin = SkinSpec { nodes, neighbours: 3, hyper: 2, mask: true };
    let spec = Spec::Control(ControlSpec { seed: 1, clip: [0.0, 0.2], skin, trajectory });
    let motion = build_as(&spec, &mut p).unwrap();
    one_layer(p, motion, LifeKind::Infinite)
}

fn spline() -> TrajectorySpec {
    TrajectorySpec::Keys { curve: Curve::Cubic, keys: 5 }
}

#[test]
fn image_gradients_reach_nodes_and_all_their_parameters() {
    let mut scene = skinned::<f64>(12, 7, spline());
    let p = &mut scene.layers[0].params;
    let keys = p.find("node_keys").unwrap();
    shake(p, keys, 0.1, 1);
    let reached = check_gradients(&scene, &shots(&[(0, 0.03), (1, 0.13), (2, 0.13)]), &Vec::new());
    assert_reached(&reached[0], &["geometry", "sh", "nodes", "hyper", "motion_mask", "node_keys"]);
}

/// Each loss alone, followed downhill, falls: it reaches the keys, and its sign is right.
#[test]
fn losses_on_nodes_fall_when_followed() {
    let clip = [0.0, 0.2];
    let losses: [Box<dyn ProbeLoss<f64>>; 3] = [
        Box::new(NodeArap { weight: 1.0, extent: 1.0, clip }),
        Box::new(NodeElastic { weight: 1.0, clip }),
        Box::new(NodeAcceleration { weight: 1.0, clip, step: 0.02 }),
    ];
    for loss in losses {
        let mut scene = skinned::<f64>(30, 20, spline());
        let keys = scene.layers[0].params.find("node_keys").unwrap();
        shake(&mut scene.layers[0].params, keys, 0.05, 2);
        let name = loss.name().to_owned();
        let probes: Probes = vec![loss];
        let shot = shots(&[(0, 0.07)]);
        let run = |scene: &Scene<f64>| {
            let (with, d, _) = step(scene, &shot, &probes, &mut Oracle(smooth()));
            (with.loss - value(scene, &shot, &Vec::new()), d)
        };
        let (first, d) = run(&scene);
        let g = d[0].table(keys).clone();
        let norm = g.data().iter().map(|g| g * g).sum::<f64>().sqrt();
        assert!(first > 0.0 && norm > 0.0, "{name}: {first}, gradient {norm}");
        let values = scene.layers[0].params[keys].data_mut();
        values.iter_mut().zip(g.data()).for_each(|(x, g)| *x -= 1e-3 * g / norm);
        // Elastic and acceleration divide themselves by their own value: what falls is that value.
        let (after, _) = run(&scene);
        assert!(after < first, "{name} went from {first} to {after}");
    }
}

#[test]
fn losses_on_parameters_have_the_gradients_of_their_values() {
    let mut scene = skinned::<f64>(9, 6, TrajectorySpec::LowRank { bases: 2, keys: 4 });
    let p = &mut scene.layers[0].params;
    let (mask, coefficients) = (p.find("motion_mask").unwrap(), p.find("node_coefficients").unwrap());
    shake(p, coefficients, 0.3, 1);
    let losses: [(Box<dyn ParamLoss<f64>>, Key); 2] = [
        (Box::new(MaskSize { weight: 0.7 }), mask),
        (Box::new(Sparse { weight: 0.7, table: "node_coefficients" }), coefficients),
    ];
    let info = StepInfo { iteration: 0, times: vec![], seed: 0, progress: 0.0 };
    for (loss, key) in losses {
        let eval = |scene: &Scene<f64>| {
            let mut d = [Grads::new(&scene.layers[0].params)];
            d[0].activate(Space::Gaussians, Rows::All);
            (loss.eval(scene, &info, &mut d), d)
        };
        let (_, d) = eval(&scene);
        for row in 0..scene.layers[0].params[key].rows() {
            let moved = |by: f64| {
                let mut s = scene.clone();
                s.layers[0].params[key].add(row, 0, [by]);
                eval(&s).0
            };
            assert_close(d[0].table(key).get(row, 0), (moved(H) - moved(-H)) / (2.0 * H), loss.name());
        }
    }
}

#[test]
fn nodes_are_added_where_gaussians_strain_and_removed_where_there_are_none() {
    let mut scene = skinned::<f32>(200, 20, spline());
    let p = &mut scene.layers[0].params;
    let skin = Skin::find(p).unwrap();
    // Node 5 leaves for where no Gaussian is; Gaussians near node 2 strain.
    p[skin.nodes].write(5, 0, [50.0, 0.0, 0.0]);
    skin.bind(p);
    let home = p[skin.nodes].read::<3>(2, 0);
    let mean2d: Vec<f32> = (0..200)
        .map(|r| {
            let x = p[GEOMETRY].read::<3>(r, 0);
            let square: f32 = (0..3).map(|k| (x[k] - home[k]).powi(2)).sum();
            if square < 0.09 { 1.0 } else { 0.0 }
        })
        .collect();
    let mut train_state = TrainState::new(scene);
    train_state.stats_mut().observe(Observation { layer: 0, rows: Rows::All, mean2d: &mean2d, radii: &[1.0; 200] });
    let settings = NodeSettings { bind_interval: 10, adapt_interval: 100, threshold: 0.2, cap: 21 };
    let mut adapt = AdaptNodes { settings, span: (100, 1000) };
    let at = |step: usize| At { step, steps: 2000 };
    assert!(adapt.due(&at(10)) && !adapt.due(&at(15)) && adapt.due(&at(500)));
    let limits = Limits { cap: 200, extent: 1.0, min_opacity: 0.0 };
    adapt.run(&mut train_state, &Context { at: at(100), ..context(limits, 0, 0) }).unwrap();
    let (p, moments) = (&train_state.scene().layers[0].params, train_state.moments());
    assert!(skin.count(p) > 19 && skin.count(p) <= 21, "{} nodes", skin.count(p));
    assert!((0..skin.count(p)).all(|k| p[skin.nodes].get(k, 0) < 49.0), "a node without Gaussians stays");
    // The strongest strain comes first: the node that was born for it is among its Gaussians.
    let born = p[skin.nodes].read::<3>(19, 0);
    let off: f32 = (0..3).map(|k| (born[k] - home[k]).powi(2)).sum::<f32>().sqrt();
    assert!(off < 0.2, "the new node is {off} away from what strains");
    assert_eq!(moments[0].table(skin.nodes).rows(), skin.count(p));
    assert!(moments[0].table(skin.nodes).read::<3>(19, 0) == [0.0; 3], "a new node starts without momentum");
    // Lists of nearest nodes are those of the new nodes.
    let list = p[skin.candidates].clone();
    skin.bind(&mut train_state.scene_mut().layers[0].params);
    assert_eq!(list, train_state.scene().layers[0].params[skin.candidates]);
}

#[test]
fn a_scene_on_nodes_learns_with_every_trajectory() {
    let network = TrajectorySpec::Network { width: 16, layers: 2, position_levels: 2, time_levels: 3 };
    let trajectories = [spline(), TrajectorySpec::LowRank { bases: 3, keys: 4 }, network];
    for trajectory in trajectories {
        let scene = skinned::<f32>(90, 12, trajectory);
        let mut all = groups(&ORDINARY);
        let own = [("node_means", 1e-3), ("node_log_radii", 5e-3), ("node_logits", 5e-3), ("hyper", 1e-3)];
        all.extend(groups(&own));
        let driven = ["node_shifts", "node_turns", "shift_coefficients", "turn_coefficients", "bases"];
        all.extend(driven.map(|c| Group::new(c, Rate::constant(5e-3))));
        let network = (0..3).flat_map(|i| ["weight", "bias"].map(|w| format!("trajectory.{i}.{w}")));
        all.extend(network.map(|c| Group::new(&c, Rate::constant(2e-3))));
        let settings = NodeSettings { bind_interval: 10, adapt_interval: 20, threshold: 1e-4, cap: 16 };
        let probe: Box<dyn ProbeLoss<f32>> = Box::new(NodeArap { weight: 0.1, extent: 4.0, clip: [0.0, 0.2] });
        let stage = Stage {
            batch: 4,
            groups: all,
            probes: vec![probe],
            maintenance: vec![Box::new(AdaptNodes { settings, span: (20, 60) })],
            ..Stage::new("nodes", 80)
        };
        let mut t = trainer(scene, vec![stage], 90);
        assert_falls(&finish_stage(&mut t), 0.6, &format!("{trajectory:?}"));
        assert!(t.scene().layers[0].params.rows_of(Space::Nodes) > 12, "no node was added");
    }
}

/// Shaken nodes settle in training, independent of the images.
#[test]
fn losses_on_nodes_reduce_jitter() {
    let clip = [0.0, 0.2];
    type Make = fn([f64; 2]) -> Box<dyn ProbeLoss<f32>>;
    let losses: [Make; 3] = [
        |clip| Box::new(NodeArap { weight: 1e6, extent: 1.0, clip }),
        |clip| Box::new(NodeElastic { weight: 10.0, clip }),
        |clip| Box::new(NodeAcceleration { weight: 10.0, clip, step: 0.02 }),
    ];
    for (k, make) in losses.iter().enumerate() {
        let mut scene = skinned::<f32>(40, 12, spline());
        let keys = scene.layers[0].params.find("node_keys").unwrap();
        shake(&mut scene.layers[0].params, keys, 0.1, 2);
        let stage = Stage {
            groups: vec![Group::new("node_shifts", Rate { start: 1e-2, end: 1e-4 })],
            probes: vec![make(clip)],
            ..Stage::new("calm", 120)
        };
        let unease = |scene: &Scene<f32>| {
            let at = |t: f64| {
                let seen = Evaluation::of_layer(&scene.layers[0], Space::Nodes, Rows::All, Time(t));
                let out = seen.tape(0).out();
                (0..out.rows()).map(|r| out.read::<3>(r, 0)).collect::<Vec<_>>()
            };
            let [a, b, c] = [0.04, 0.1, 0.16].map(at);
            let graph = crate::loss::graph::Graph::new(&a, 4, crate::loss::graph::Weigh::Uniform);
            let mut d = [0, 1, 2].map(|_| vec![[0.0; 3]; a.len()]);
            let [d_a, d_b, d_c] = &mut d;
            match k {
                0 => crate::loss::arap::arap(&graph, [&a, &c], 1.0, [d_a, d_c]),
                // A floor so high that the value is not divided by itself.
                1 => crate::loss::arap::elastic(&graph, &[&a, &b, &c], 1.0, 1.0, &mut [d_a, d_b, d_c]),
                _ => crate::loss::arap::acceleration([&a, &b, &c], 1.0, 1.0, [d_a, d_b, d_c]),
            }
        };
        let before = unease(&scene);
        let mut t = trainer(scene, vec![stage], 90);
        finish_stage(&mut t);
        let after = unease(t.scene());
        assert!(after < 0.5 * before, "loss {k} went from {before} to {after}");
    }
}
