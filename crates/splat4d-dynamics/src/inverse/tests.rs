use crate::actions::Actions;
use crate::learnt::Training;
use crate::models::{Fitted, Model, Settings};
use crate::paths::Paths;
use crate::worlds::{FRAMES, World};

/// Of the 1,500 that models have.
const STEPS: usize = 150;
const OBSERVED: usize = 120;

/// A model of a world's first frames, its whole paths, and its actions.
fn fitted(world: &str, model: Model) -> (Fitted, Paths, Actions) {
    let world = World::new(world).unwrap();
    let paths = Paths::of_points(&(0..FRAMES).map(|t| world.nodes(t)).collect::<Vec<_>>());
    let actions = world.actions.unwrap();
    let settings = Settings {
        training: Training { steps: STEPS, seed: 0 },
        gravity: Some([0.0, -1.0, 0.0]),
        ..Settings::default()
    };
    let fitted = Fitted::fit(model, &paths.first(OBSERVED), Some(&actions), &settings).unwrap();
    (fitted, paths, actions)
}

/// Root of the mean square of differences in these rows.
fn apart(a: &Actions, b: &[Vec<f64>], rows: std::ops::Range<usize>) -> f64 {
    let squares: Vec<f64> =
        rows.flat_map(|t| a.rows[t].iter().zip(&b[t]).map(|(a, b)| (a - b).powi(2)).collect::<Vec<_>>()).collect();
    (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
}

#[test]
fn the_action_between_two_states_is_recovered() {
    for (world, model) in [("pushed-block", Model::Graph), ("driven-pendulum", Model::Graph)] {
        let (fitted, paths, actions) = fitted(world, model);
        let known = Actions { names: actions.names.clone(), rows: actions.rows[..OBSERVED].to_vec() };
        let found = fitted.infer_actions(&paths, &known, 1).unwrap();
        assert_eq!(found.rows.len(), FRAMES - 1);
        assert_eq!(found.rows[..OBSERVED], known.rows[..], "known rows stay");
        let rows = OBSERVED..FRAMES - 1;
        let none = vec![vec![0.0; actions.names.len()]; FRAMES];
        let (error, size) = (apart(&actions, &found.rows, rows.clone()), apart(&actions, &none, rows));
        assert!(error < 0.5 * size, "{world}: {error} of {size}");
        assert_eq!(found, fitted.infer_actions(&paths, &known, 1).unwrap(), "the same bits");
    }
}

#[test]
fn bad_input_is_explained() {
    let (fitted, paths, actions) = fitted("driven-pendulum", Model::Causal);
    let known = |rows: usize| Actions { names: actions.names.clone(), rows: actions.rows[..rows].to_vec() };
    let message = |r: crate::Result<Actions>| r.unwrap_err().to_string();
    assert!(message(fitted.infer_actions(&paths, &known(3), 1)).contains("too few"));
    assert!(message(fitted.infer_actions(&paths, &known(OBSERVED), 0)).contains("one frame"));
    let other = Actions { names: vec!["x".into(), "y".into()], rows: vec![vec![0.0; 2]; OBSERVED] };
    assert!(message(fitted.infer_actions(&paths, &other, 1)).contains("not trained with these"));
    assert!(message(Fitted::Freeze.infer_actions(&paths, &known(OBSERVED), 1)).contains("takes no actions"));
    // Groups that do not fill: 29 frames in fours.
    let found = fitted.infer_actions(&paths, &known(OBSERVED), 4).unwrap();
    assert_eq!(found.rows.len(), FRAMES - 1);
    assert!(found.rows[OBSERVED..OBSERVED + 4].iter().all(|r| *r == found.rows[OBSERVED]));
}
