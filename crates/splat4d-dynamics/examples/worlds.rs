//! The ladder on worlds with known physics, from their true nodes: mean node error by horizon, and what fitting took.
//!
//! `cargo run --release -p splat4d-dynamics --example worlds [STEPS [WORLD...]]`

use splat4d_dynamics::Result;
use splat4d_dynamics::actions::Actions;
use splat4d_dynamics::learnt::Training;
use splat4d_dynamics::models::{Fitted, Model, Settings};
use splat4d_dynamics::paths::Paths;
use splat4d_dynamics::score::node_errors;
use splat4d_dynamics::worlds::{FRAMES, NAMES, World};
use std::time::Instant;

/// Frames that are observed.
const OBSERVED: usize = 120;
/// Frames ahead at which errors are reported.
const HORIZONS: [usize; 5] = [1, 5, 10, 20, 30];

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let steps = arguments.next().and_then(|s| s.parse().ok()).unwrap_or(1500);
    let names: Vec<String> = arguments.collect();
    println!("| world | model | {} | fitted in |", HORIZONS.map(|h| format!("{h} ahead")).join(" | "));
    println!("|---|---|{}---|", "---|".repeat(HORIZONS.len()));
    for name in NAMES.iter().filter(|n| names.is_empty() || names.iter().any(|m| m == *n)) {
        let world = World::new(name)?;
        let points: Vec<_> = (0..FRAMES).map(|t| world.nodes(t)).collect();
        let paths = Paths::of_points(&points[..OBSERVED]).turned_by_neighbours();
        let truth = Paths::of_points(&points[OBSERVED..]).moments;
        let tell = |label: &str, model: Model, actions: Option<&Actions>| -> Result<()> {
            let gravity = Some([0.0, -1.0, 0.0]);
            let settings = Settings { training: Training { steps, seed: 0 }, gravity, floor: Some(0.0) };
            let started = Instant::now();
            let fitted = Fitted::fit(model, &paths, actions, &settings)?;
            let seconds = started.elapsed().as_secs_f64();
            let errors = node_errors(&fitted.rollout(&paths, actions, truth.len()), &truth);
            let cells = HORIZONS.map(|h| format!("{:.4}", errors[h - 1])).join(" | ");
            println!("| {name} | {label} | {cells} | {seconds:.1} s |");
            Ok(())
        };
        for model in Model::ALL.into_iter().filter(|m| *m != Model::Extrapolate) {
            tell(model.name(), model, None)?;
            if let Some(actions) = world.actions.as_ref().filter(|_| model.is_trained()) {
                tell(&format!("{}, with actions", model.name()), model, Some(actions))?;
            }
        }
    }
    Ok(())
}
