//! Every switch of the recipe in real training: each must do what it states, and the scene must still learn.

use super::bed::{Bed, Ran, bytes, places};
use crate::loss::graph::{Graph, Weigh};
use splat4d::math::Real;
use splat4d::scene::{LIFE, Space, Time};

/// Learns, moves something, and is the same after it was written and read.
fn sound(line: &str, ran: &Ran, share: f64) {
    assert!(ran.left() < share, "{line}: {:.3} of the error is left", ran.left());
    let scene = ran.scene();
    let [a, b] = scene.clip.map(|t| places(scene, 0, Space::Gaussians, t));
    let far = |(a, b): (&[f32; 3], &[f32; 3])| (0..3).map(|k| (a[k] - b[k]).abs()).fold(0.0, f32::max);
    let moved = a.iter().zip(&b).map(far).fold(0.0, f32::max);
    assert!(moved > 1e-4, "{line}: nothing moves ({moved})");
    let file = bytes(scene);
    let back = splat4d::format::scene::read(&file).unwrap();
    assert!(bytes(&back) == file, "{line}: the file does not say all");
    assert!(places(&back, 0, Space::Gaussians, scene.clip[1]) == b, "{line}: what was read is another scene");
}

#[test]
fn every_network_learns() {
    let bed = Bed::new();
    for (line, share) in [
        ("motion=deform-mlp deform_width=16 deform_time_noise=0.5", 0.7),
        ("motion=deform-mlp deform_trunk=mlp deform_lr_init=2e-4 iterations=24 loss.moving=0", 0.7),
        ("motion=deform-mlp deform_width=16 deform_time_net=true deform_rigid=true", 0.7),
        ("motion=deform-mlp deform_width=16 deform_trunk=hash deform_unlock=0.6", 0.7),
        ("motion=deform-mlp deform_width=16 deform_trunk=hash-linear", 0.7),
        ("motion=hexplane coarse_iterations=10 plane_channels=16 plane_resolution=6 net_width=16 no_do=false", 0.7),
        ("motion=hexplane coarse_iterations=5 plane_channels=16 plane_resolution=6 no_dshs=false defor_depth=2", 0.7),
    ] {
        sound(line, &bed.run(line), share);
    }
}

#[test]
fn every_trajectory_of_nodes_learns() {
    let bed = Bed::new();
    let nodes = "control_nodes=10 control_adapt_interval=6 control_grad_threshold=1e-6 control_max_nodes=14";
    for motion in [
        "motion=control",
        "motion=control control_trajectory=linear control_keys=3",
        "motion=control control_trajectory=slerp control_mask=true",
        "motion=control control_trajectory=low-rank control_bases=3 lambda_sparse=0.1",
        "motion=control control_trajectory=network control_width=16 control_layers=2",
        "motion=ssm ssm_width=8 ssm_states=4",
        "motion=ssm ssm_width=8 ssm_states=4 ssm_mode=causal ssm_output=twist ssm_warm_up=0.2",
        "motion=ssm ssm_width=8 ssm_states=4 ssm_equivariance=frames ssm_warm_up=0.2",
        "motion=ssm ssm_width=8 ssm_states=4 ssm_equivariance=frames ssm_mode=causal",
        "motion=ssm ssm_width=8 ssm_states=4 ssm_equivariance=vector ssm_warm_up=0.2",
        "motion=ssm ssm_width=8 ssm_states=4 ssm_equivariance=vector ssm_mode=causal ssm_output=twist",
    ] {
        let line = format!("{motion} {nodes}");
        let ran = bed.run(&line);
        sound(&line, &ran, 0.75);
        assert!(ran.nodes() > 10 && ran.nodes() <= 14, "{line}: {} nodes", ran.nodes());
    }
}

#[test]
fn nodes_without_gaussians_are_removed() {
    let bed = Bed::new();
    // More nodes than Gaussians need; none is added.
    let ran = bed.run("motion=control control_nodes=60 control_adapt_interval=6 control_grad_threshold=1e9 num_pts=40");
    assert!(ran.nodes() < 60 && ran.nodes() >= 4, "{} nodes", ran.nodes());
    sound("pruned nodes", &ran, 1.0);
}

/// How much the nodes' motion stretches what is between them, and how much it turns aside.
fn unease(ran: &Ran) -> [f64; 2] {
    let [a, b, c] = [0.0, 0.1, 0.2].map(|t| places(ran.scene(), 0, Space::Nodes, t));
    let graph = Graph::new(&a, 1, Weigh::Uniform);
    let (mut stretch, mut jerk) = (0.0, 0.0);
    for i in 0..a.len() {
        let j = graph.edges_from(i).next().expect("a node has a neighbour").1;
        let length = |x: &[[f32; 3]]| (0..3).map(|k| (x[i][k] - x[j][k]).powi(2)).sum::<f32>().sqrt();
        stretch += f64::from((length(&a) - length(&c)).abs());
        jerk += (0..3).map(|k| f64::from(a[i][k] - 2.0 * b[i][k] + c[i][k]).powi(2)).sum::<f64>().sqrt();
    }
    [stretch, jerk]
}

#[test]
fn losses_on_nodes_reduce_their_value() {
    let bed = Bed::new();
    let base = "motion=control control_nodes=20 control_shift_lr_init=5e-3 strategy=none";
    let plain = unease(&bed.run(base));
    for (k, weight) in ["lambda_node_elastic=0.1", "lambda_node_acceleration=1e-3"].iter().enumerate() {
        let held = unease(&bed.run(&format!("{base} {weight}")));
        assert!(held[k] < 0.7 * plain[k], "{weight}: {} instead of {}", held[k], plain[k]);
    }
}

#[test]
fn a_motion_mask_shrinks_with_its_weight() {
    let bed = Bed::new();
    let mean = |weight: &str| {
        let ran = bed.run(&format!("motion=control control_nodes=12 control_mask=true {weight}"));
        let p = &ran.scene().layers[0].params;
        let mask = p.find("motion_mask").unwrap();
        (0..p.len()).map(|r| f64::from(p[mask].get(r, 0)).sigmoid()).sum::<f64>() / p.len() as f64
    };
    let [free, held] = ["lambda_motion_mask=0", "lambda_motion_mask=10"].map(mean);
    assert!(held < free - 0.05, "{held} with the weight, {free} without");
}

#[test]
fn relocation_moves_faint_gaussians_and_keeps_the_count() {
    let line = "strategy=none relocate_interval=5 relocate_from_iter=5 relocate_opacity=0.15 relocate_share=0.1";
    let ran = Bed::new().run(line);
    assert!(ran.change.moved > 10 && ran.change.added + ran.change.removed == 0, "{:?}", ran.change);
    assert!(ran.rows.iter().all(|&n| n == ran.rows[0]));
    sound(line, &ran, 0.8);
}

#[test]
fn clones_get_a_time_of_their_own() {
    let bed = Bed::new();
    for (retime, twins) in [(false, true), (true, false)] {
        let (mut seen, mut before) = (0, 80);
        bed.watch(&format!("retime_clones={retime} percent_dense=1 adc.life_threshold=0"), |trainer, change| {
            let p = &trainer.scene().layers[0].params;
            if change.added > 0 && change.removed == 0 && seen == 0 {
                // Clones are behind the existing rows; no step has moved them yet.
                let centers: Vec<f32> = (0..p.len()).map(|r| p[LIFE].get(r, 0)).collect();
                let (old, new) = centers.split_at(before);
                assert_eq!(new.len(), change.added);
                assert_eq!(new.iter().all(|c| old.contains(c)), twins, "retime_clones={retime}");
                let [first, last] = trainer.scene().clip.map(|t| t as f32);
                assert!(twins || new.iter().all(|c| (first..=last).contains(c)));
                seen += 1;
            }
            before = p.len();
        });
        assert_eq!(seen, 1, "nothing was cloned");
    }
}

#[test]
fn crowds_are_thinned_and_the_rest_learns() {
    let bed = Bed::new();
    // Losses over neighbours use the cloud after every thinning.
    let losses = "lambda_rigid=1 lambda_jerk=0.1 lambda_velocity=0.1";
    for line in [
        "crowding=merge motion=spacetime",
        "crowding=prune motion=spacetime",
        "crowding=merge motion=control control_nodes=10 control_adapt_interval=6",
        "crowding=prune motion=hexplane coarse_iterations=10 plane_channels=16 plane_resolution=6 net_width=16",
    ] {
        let line = format!("{line} crowding_interval=10 crowding_distance=1.5 strategy=none {losses}");
        let ran = bed.run(&line);
        assert!(ran.change.removed > 0 && *ran.rows.last().unwrap() < ran.rows[0], "{line}: {:?}", ran.change);
        sound(&line, &ran, 0.95);
    }
}

#[test]
fn static_gaussians_become_a_layer_and_both_layers_train() {
    let bed = Bed::new();
    for (motion, reach) in [
        ("spacetime", 0.003),
        ("deform-mlp deform_width=16", 0.01),
        ("native4d", 0.003),
        ("tracked rigid_neighbours=5", 0.001),
    ] {
        let line = format!("motion={motion} static_split={reach} static_split_from=0.5 lambda_rigid=1");
        let mut at_the_split: Option<Vec<[f32; 3]>> = None;
        let ran = bed.watch(&line, |trainer, _| {
            if let (Some(still), None) = (trainer.scene().layers.get(1), &at_the_split) {
                assert!(!still.params.is_empty());
                at_the_split = Some(places(trainer.scene(), 1, Space::Gaussians, 0.0));
            }
        });
        let layers = &ran.scene().layers;
        assert_eq!(layers.len(), 2, "{line}: nothing was split off");
        assert_eq!(layers[1].motion.spec().name(), "still");
        let learns = at_the_split.unwrap() != places(ran.scene(), 1, Space::Gaussians, 0.0);
        // Only the newest page of `tracked` learns: the static background rests.
        assert_eq!(learns, !motion.starts_with("tracked"), "{line}");
        assert!(!learns || ran.left() < 0.8, "{line}: {}", ran.left());
    }
}

#[test]
fn tracked_and_central_velocities_render_after_training() {
    let bed = Bed::new();
    let hexplane = "motion=hexplane coarse_iterations=5 plane_channels=16 plane_resolution=6 net_width=16";
    for line in ["motion=tracked rigid_neighbours=5 track_lr_init=5e-3", hexplane] {
        let ran = bed.run(line);
        let scene = ran.scene();
        // Between two frames of the one and two grid points of the other, where paths are straight.
        let (t, h) = (0.043, 0.01);
        let mut instant = splat4d::layers::Evaluation::default();
        scene.at(Time(t), &mut instant);
        let velocities = splat4d::flow::velocities(scene, &instant);
        let [a, b] = [t - h, t + h].map(|t| places(scene, 0, Space::Gaussians, t));
        let largest = velocities.data().iter().fold(0.0f32, |m, v| m.max(v.abs()));
        assert!(velocities.data().iter().all(|v| v.is_finite()) && largest > 1e-4, "{line}: {largest}");
        for r in 0..a.len() {
            let v = velocities.read::<3>(r, 0);
            let error = (0..3).map(|k| (v[k] - (b[r][k] - a[r][k]) / (2.0 * h as f32)).abs()).fold(0.0, f32::max);
            assert!(error < 0.05 * largest + 1e-3, "{line}: row {r}: {v:?} is off by {error}");
        }
    }
}
