//! Pruning and masks take part in any model's training: a deformation model, whose Gaussians nodes carry, with a
//! lifespan.

use super::nodes::Skinned;
use super::*;
use crate::maintenance::importance::{MaskConfig, ScoreConfig, Spatial, key_masks, prune, score};
use crate::maintenance::{Prune, PruneSettings};
use crate::train_state::TrainState;

/// A deformation model whose nodes move between its two pages, and whose first ten Gaussians are short-lived.
fn deformed(rows: usize) -> Scene<f32> {
    let mut params = cloud::<f32>(rows, LifeKind::GaussHalf, 3);
    let centers = [[0.3, 0.0, 0.0], [-0.3, 0.1, 0.0], [0.0, -0.3, 0.2]];
    let mut model = Skinned::new(&mut params, &centers);
    model.add_page(&mut params);
    let key = params.find("poses@1").expect("the second page");
    shake(&mut params, key, 0.1, 6);
    (0..10).for_each(|r| params[LIFE].write(r, 0, [0.1, 0.004f32.ln()]));
    one_layer(params, Arc::new(model), LifeKind::GaussHalf)
}

#[test]
fn a_deformation_model_is_scored_pruned_masked_and_trained_on() {
    let made = Made::new(4, 3, 16);
    let scene = deformed(120);
    let scores = score(&scene, &made, &ScoreConfig::default(), &mut |_, _| {}).unwrap();
    assert!(scores.layers[0].iter().filter(|s| **s > 0.0).count() > 60);
    // Its times are examined with the nodes where they are then, not at rest.
    let mut rested = scene.clone();
    let key = rested.layers[0].params.find("poses@1").unwrap();
    rested.layers[0].params[key].fill(0.0);
    assert_ne!(score(&rested, &made, &ScoreConfig::default(), &mut |_, _| {}).unwrap().spatial, scores.spatial);

    let edits = prune(&scene, &scores, 0.5);
    let weights = |s: &Scene<f32>, row: usize| {
        let skin = s.layers[0].params.find("skin").unwrap();
        s.layers[0].params[skin].read::<4>(row, 0)
    };
    let old = scene.clone();
    let mut train_state = TrainState::new(scene);
    train_state.apply(0, &edits[0], &Rng::new(0, "prune", 0));
    let mut scene = train_state.into_scene();
    assert_eq!(scene.len(), 60);
    assert!(edits[0].parent.iter().all(|&p| p >= 10), "those of a moment go first");
    assert!((0..60).all(|r| weights(&scene, r) == weights(&old, edits[0].parent[r] as usize)), "the skin goes along");
    let nodes = scene.layers[0].params.find("nodes").unwrap();
    assert_eq!(scene.layers[0].params[nodes].rows(), 3, "nodes stay");

    let config = MaskConfig { interval: 2, ..MaskConfig::default() };
    key_masks(&mut scene, &made, &config, &mut |_, _| {}).unwrap();
    let mut active = Vec::new();
    scene.layers[0].active(Time(0.05), &mut active);
    assert!(active.len() > 30, "{} are drawn", active.len());
    let masks = scene.layers[0].masks.clone().expect("made above");
    assert!((0..60).all(|r| masks.allows(0.05, r) == active.contains(&(r as u32))), "all of them live throughout");

    let mut stage = Stage::new("tune", 40);
    stage.groups = groups(&ORDINARY);
    stage.keep(Prune { settings: PruneSettings { interval: 20, ratio: 0.2, views: 12, spatial: Spatial::Change } });
    let mut t = trainer(scene, vec![stage], 60);
    let losses = finish_stage(&mut t);
    assert_falls(&losses, 0.8, "with half and then fewer of its Gaussians");
    assert_eq!(t.scene().len(), 48);
    assert_eq!(t.scene().layers[0].masks.as_ref().unwrap().rows(), 48, "masks follow pruning");
}
