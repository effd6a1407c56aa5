use super::*;
use crate::paths::Pose;
use crate::score::{node_errors, skill};
use crate::worlds::World;
use splat4d::math::se3::{norm, sub};

/// Of the 1,500 that the models have: as many as the pendulum requires of each.
const CAUSAL_STEPS: usize = 200;
const GRAPH_STEPS: usize = 100;

/// True node paths of a world: the first `seen` frames with rotations, and the later frames.
fn world(name: &str, seen: usize) -> (Paths, Vec<Moment>, Option<Actions>) {
    let world = World::new(name).unwrap();
    let all: Vec<Vec<[f64; 3]>> = (0..crate::worlds::FRAMES).map(|t| world.nodes(t)).collect();
    let later = Paths::of_points(&all[seen..]).moments;
    (Paths::of_points(&all[..seen]).turned_by_neighbours(), later, world.actions)
}

/// Mean error of the nodes after `horizon` frames.
fn error_after(model: Model, name: &str, horizon: usize, steps: usize, with_actions: bool) -> f64 {
    let (paths, truth, actions) = world(name, 120);
    let actions = actions.filter(|_| with_actions);
    let gravity = Some([0.0, -1.0, 0.0]);
    let settings = Settings { training: Training { steps, seed: 0 }, gravity, ..Settings::default() };
    let fitted = Fitted::fit(model, &paths, actions.as_ref(), &settings).unwrap();
    node_errors(&fitted.rollout(&paths, actions.as_ref(), horizon), &truth)[horizon - 1]
}

#[test]
fn on_a_circle_the_linear_model_is_ten_times_better_than_a_straight_line() {
    let [line, linear] = [Model::Velocity, Model::Koopman].map(|m| error_after(m, "circle", 20, 0, false));
    assert!(10.0 * linear < line, "{linear} of {line}");
}

#[test]
fn on_a_pendulum_linear_and_trained_models_are_three_times_better_than_a_straight_line() {
    let line = error_after(Model::Velocity, "pendulum", 20, 0, false);
    for (model, steps) in [(Model::Koopman, 0), (Model::Causal, CAUSAL_STEPS), (Model::Graph, GRAPH_STEPS)] {
        let error = error_after(model, "pendulum", 20, steps, false);
        assert!(3.0 * error < line, "{}: {error} of {line}", model.name());
    }
}

#[test]
fn static_points_are_forecast_static() {
    let world = World::new("circle").unwrap();
    let paths = Paths::of_points(&vec![world.nodes(0); 40]);
    let size = paths.extent();
    for model in Model::ALL.into_iter().filter(|m| *m != Model::Extrapolate) {
        let settings = Settings { training: Training { steps: 3, seed: 0 }, ..Settings::default() };
        let out = Fitted::fit(model, &paths, None, &settings).unwrap().rollout(&paths, None, 100);
        let far = out.iter().flat_map(|m| m.iter().zip(paths.last())).map(|(a, b)| norm(sub(a.x, b.x)));
        assert!(far.fold(0.0, f64::max) < 1e-4 * size, "{}", model.name());
    }
}

#[test]
fn a_forecast_does_not_use_later_frames() {
    let (paths, truth, _) = world("bounce", 40);
    let mut other = paths.clone();
    other.moments.extend(truth.into_iter().map(|m| m.iter().map(|p| Pose::at(p.x.map(|x| 7.0 * x))).collect()));
    for model in Model::ALL.into_iter().filter(|m| *m != Model::Extrapolate) {
        let settings = Settings { training: Training { steps: 4, seed: 0 }, ..Settings::default() };
        let run = |p: &Paths| Fitted::fit(model, p, None, &settings).unwrap().rollout(p, None, 5);
        assert_eq!(run(&paths), run(&other.first(40)), "{}: the same bits, of the same past", model.name());
    }
}

#[test]
fn freezing_has_no_skill_and_bad_input_is_explained() {
    let (paths, truth, actions) = world("pushed-block", 120);
    let settings = Settings::default();
    let frozen = Fitted::fit(Model::Freeze, &paths, None, &settings).unwrap().rollout(&paths, None, 30);
    let error = node_errors(&frozen, &truth);
    assert!(error[29] > 0.01 && error.iter().all(|e| skill(*e, *e) == 0.0));
    let few = Fitted::fit(Model::Koopman, &paths.first(3), None, &settings).unwrap_err();
    assert!(few.to_string().contains("too few"), "{few}");
    let short = Actions { rows: actions.unwrap().rows[..50].to_vec(), names: vec!["x".into()] };
    let short = Fitted::fit(Model::Graph, &paths, Some(&short), &settings).unwrap_err();
    assert!(short.to_string().contains("50 rows"), "{short}");
    assert!(Model::from_name("oracle").unwrap_err().to_string().contains("koopman"));
}
