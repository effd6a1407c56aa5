//! The time and memory of a run of several stages.

use super::bed::{bytes, settings};
use crate::run::tests::Place;
use crate::run::{TrainOptions, train};
use std::sync::atomic::AtomicBool;

/// One line a model with stages of its own.
const MODELS: [&str; 6] = [
    "motion=hexplane plane_channels=16 plane_resolution=6 net_width=16",
    "motion=deform-mlp deform_width=16",
    "motion=control control_nodes=10",
    "motion=ssm control_nodes=10 ssm_width=8 ssm_states=4 ssm_warm_up=0.1",
    "motion=tracked rigid_neighbours=5",
    "motion=spacetime filter=geodesic",
];

#[test]
fn minutes_fix_a_run_of_any_model() {
    let place = Place::new();
    for (k, line) in MODELS.iter().enumerate() {
        let asked = settings(line).with(|r| {
            r.run.iterations = 7000;
            r.densify.from = 0;
            r.densify.until = 0;
            r.densify.interval = 0;
        });
        let run = place.run(&k.to_string());
        let options = TrainOptions { minutes: Some(0.001), ..TrainOptions::default() };
        train(place.open(&asked), asked.clone(), &run, &options, &AtomicBool::new(false), &mut |_| {}).unwrap();
        let text = std::fs::read_to_string(run.join("recipe.toml")).unwrap();
        let fixed = crate::recipe::Recipe::from_toml(&text).unwrap();
        assert!((50..7000).contains(&fixed.run.iterations), "{line}: {} steps in 0.06 s", fixed.run.iterations);
        let again = format!("{k} again");
        place.train(&again, &fixed).unwrap();
        assert!(place.scene(&again) == place.scene(&k.to_string()), "{line}: the recipe does not repeat");
        let scene = splat4d::format::scene::read(&place.scene(&again)).unwrap();
        assert!(bytes(&scene) == place.scene(&again));
    }
}
