//! Nodes on scenes that are synthetic, and the futures that are made of them.

use super::*;
use crate::future::{Clock, predicted};
use crate::models::{Fitted, Model, Settings};
use splat4d::layers::{Layer, PREDICTED};
use splat4d::math::Rng;
use splat4d::motion::{SpacetimeSpec, Spec, build};
use splat4d::scene::{GEOMETRY, LIFE, LifeKind, Params};

const FPS: f64 = 10.0;
const STILL: usize = 300;
const BODY: usize = 80;
/// Scene units per second.
const VELOCITY: [f64; 3] = [0.5, 0.2, 0.0];

/// A still room and a body that drifts through it. If `lives` is set, no Gaussian of the body has a lifespan longer
/// than a third of a second: others take over along its way.
fn scene(lives: bool) -> Scene<f32> {
    let generations = if lives { 8 } else { 1 };
    let mut params = Params::new(STILL + BODY * generations, 1, LifeKind::GaussHalf.columns());
    let motion = build(&Spec::Spacetime(SpacetimeSpec::default()), &mut params).unwrap();
    let key = params.find("velocities").unwrap();
    for row in 0..params.len() {
        let rng = Rng::new(1, "rows", row as u64);
        let x: [f64; 3] = std::array::from_fn(|c| rng.uniform(c as u64) - 0.5);
        let body = row >= STILL;
        let center = if lives && body { 0.25 * ((row - STILL) / BODY) as f64 } else { 1.0 };
        // The model moves about the middle of a lifespan.
        let place = |c: usize| if body { 0.4 * x[c] - 0.5 + VELOCITY[c] * center } else { 4.0 * x[c] };
        let logs = [-3.0f32; 3];
        let x: [f32; 3] = std::array::from_fn(|c| place(c) as f32);
        params[GEOMETRY].write(row, 0, [x[0], x[1], x[2], 1.0, 0.0, 0.0, 0.0, logs[0], logs[1], logs[2], 3.0]);
        params[LIFE].write(row, 0, [center as f32, if lives && body { (0.15f32).ln() } else { 5.0 }]);
        if body {
            (0..3).for_each(|c| params[key].set(row, c, VELOCITY[c] as f32));
        }
    }
    let layer = Layer::new("all", params, motion, LifeKind::GaussHalf);
    Scene { layers: vec![layer], clip: [0.0, 1.5], fps: FPS, ..Scene::default() }
}

fn ticks() -> Vec<f64> {
    (0..=15).map(|i| f64::from(i) / FPS).collect()
}

#[test]
fn nodes_follow_moving_regions_of_short_lived_gaussians() {
    for lives in [false, true] {
        let scene = scene(lives);
        let seen = observe(&scene, &ticks(), 12).unwrap();
        assert_eq!((seen.paths.nodes(), seen.paths.len()), (12, 16));
        // Who has hardly any neighbour but what moves goes along with it (the room is thin here); all others are left
        // out.
        let middle = add([-0.5; 3], se3::scale(VELOCITY, 1.5));
        let at = |i: usize| scene.layers[0].params[GEOMETRY].read::<3>(i, 0).map(f64::from);
        let far = |i: &usize| norm(sub(at(*i), middle)) > 1.3;
        assert_eq!((0..STILL).filter(|&i| seen.moving[0][i]).filter(far).count(), 0);
        assert!((0..STILL).filter(|&i| !seen.moving[0][i]).count() > 9 * STILL / 10);
        let tolerance = if lives { 0.05 } else { 1e-3 };
        for k in 0..12 {
            for (t, moment) in seen.paths.moments.iter().enumerate() {
                let way = sub(seen.paths.last()[k].x, moment[k].x);
                let truth = se3::scale(VELOCITY, (15 - t) as f64 / FPS);
                assert!(norm(sub(way, truth)) < tolerance, "node {k} at {t}: {way:?}, {truth:?}");
            }
        }
        // The scene was not evaluated after the last tick: its content there does not matter.
        let shorter = observe(&scene, &ticks()[..10], 12).unwrap();
        assert_eq!(shorter.paths.len(), 10);
    }
}

#[test]
fn a_model_is_evaluated_after_its_clip() {
    let scene = scene(false);
    let seen = observe(&scene, &ticks(), 6).unwrap();
    let later: Vec<f64> = (15..=25).map(|i| f64::from(i) / FPS).collect();
    let out = follow(&scene, seen.paths.last(), &later);
    let way = sub(out[10][3].x, seen.paths.last()[3].x);
    assert!(out.len() == 11 && norm(sub(way, VELOCITY)) < 1e-3, "{way:?}");
}

#[test]
fn a_predicted_scene_equals_the_scene_and_then_continues() {
    let scene = scene(true);
    let seen = observe(&scene, &ticks(), 12).unwrap();
    let moments =
        Fitted::fit(Model::Velocity, &seen.paths, None, &Settings::default()).unwrap().rollout(&seen.paths, None, 20);
    let clock = Clock { until: 1.5, fps: FPS };
    let future = predicted(&scene, &seen, &moments, clock).unwrap();
    assert_eq!((future.clip, future.predicted_from()), ([0.0, 3.5], Some(1.55)));
    assert_eq!(scene.predicted_from(), None);
    let means = |scene: &Scene<f32>, t: f64| -> Vec<[f32; 3]> {
        let mut now = Evaluation::default();
        scene.at(Time(t), &mut now);
        let of = |tape: &splat4d::layers::LayerTape<f32>| {
            (0..tape.out().rows()).map(|r| tape.out().read::<3>(r, 0)).collect()
        };
        now.tapes().flat_map(|t| -> Vec<[f32; 3]> { of(t) }).collect()
    };
    for t in [0.0, 0.7, 1.5] {
        assert_eq!(means(&scene, t), means(&future, t), "as it was learnt at {t} s");
    }
    let centre =
        |points: &[[f32; 3]], x: usize| points.iter().map(|p| f64::from(p[x])).sum::<f64>() / points.len() as f64;
    let moving = future.layers.iter().find(|l| l.name.contains("moving")).unwrap();
    assert!(moving.name.starts_with(PREDICTED));
    let body = |t: f64| {
        let seen = Evaluation::of_layer(moving, Space::Gaussians, Rows::All, Time(t));
        (0..moving.params.len()).map(|r| seen.tape(0).out().read::<3>(r, 0)).collect::<Vec<_>>()
    };
    // Between frames too, and a frame before its end.
    for t in [1.6, 2.25, 3.5] {
        for c in 0..3 {
            let way = centre(&body(t), c) - centre(&body(1.5), c);
            assert!((way - VELOCITY[c] * (t - 1.5)).abs() < 0.05, "{way} at {t}");
        }
    }
    let mut bytes = Vec::new();
    splat4d::format::scene::write(&future, &mut bytes).unwrap();
    let again = splat4d::open(&bytes).unwrap();
    assert_eq!(means(&again, 2.5), means(&future, 2.5));
    assert_eq!(again.predicted_from(), future.predicted_from());
    assert!(predicted(&scene, &seen, &[], clock).is_err());
}

#[test]
fn impossible_observations_are_refused_with_a_reason() {
    let scene = scene(false);
    let message = |ticks: &[f64], nodes| observe(&scene, ticks, nodes).unwrap_err().to_string();
    assert!(message(&ticks()[..3], 12).contains("too few"));
    assert!(message(&ticks(), 0).contains("1 to 128") && message(&ticks(), 129).contains("1 to 128"));
    let mut still = scene.clone();
    let key = still.layers[0].params.find("velocities").unwrap();
    still.layers[0].params[key].data_mut().fill(0.0);
    let nothing = observe(&still, &ticks(), 12).unwrap_err().to_string();
    assert!(nothing.contains("nothing moves"), "{nothing}");
}
