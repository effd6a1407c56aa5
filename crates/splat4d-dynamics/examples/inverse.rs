//! Inverse dynamics on worlds with known actions, from their true nodes: the error of actions that led through the last
//! frames, next to that of simple guesses.
//!
//! `cargo run --release -p splat4d-dynamics --example inverse [STEPS [SEEDS [WORLD...]]]`

use splat4d::math::Rng;
use splat4d_dynamics::Result;
use splat4d_dynamics::actions::Actions;
use splat4d_dynamics::learnt::Training;
use splat4d_dynamics::models::{Fitted, Model, Settings};
use splat4d_dynamics::paths::Paths;
use splat4d_dynamics::worlds::{FRAMES, World};

/// Frames whose actions are known.
const OBSERVED: usize = 120;
/// Frames over which a recovered action is constant.
const HOLDS: [usize; 2] = [1, 4];
/// Noise of positions, of the extent: none, and about that of nodes that were followed through a reconstruction.
const NOISES: [f64; 2] = [0.0, 0.001];

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let mut number = |default| arguments.next().and_then(|s| s.parse().ok()).unwrap_or(default);
    let (steps, seeds) = (number(1500), number(1) as u64);
    let mut names: Vec<String> = std::env::args().skip(3).collect();
    if names.is_empty() {
        names = ["pushed-block", "driven-pendulum"].map(String::from).to_vec();
    }
    println!(
        "| world | noise | seed | mean action | linear in velocity and its change | model | one a frame | one for 4 frames |"
    );
    println!("|---|---:|---:|---:|---:|---|---:|---:|");
    for name in &names {
        let world = World::new(name)?;
        let Some(actions) = world.actions.clone() else { continue };
        let known = Actions { names: actions.names.clone(), rows: actions.rows[..OBSERVED].to_vec() };
        let size = rms(actions.rows[OBSERVED..FRAMES - 1].iter().flatten().copied());
        for noise in NOISES {
            for seed in 0..seeds {
                let paths = noisy(&world, noise, seed);
                let error = |rows: &[Vec<f64>]| {
                    let pairs = rows.iter().flatten().zip(actions.rows[OBSERVED..FRAMES - 1].iter().flatten());
                    rms(pairs.map(|(a, b)| a - b)) / size
                };
                let mean = mean(&known.rows);
                let flat = error(&vec![mean; FRAMES - 1 - OBSERVED]);
                let linear = error(&linear(&paths, &known));
                for model in [Model::Causal, Model::Graph] {
                    let gravity = Some([0.0, -1.0, 0.0]);
                    let settings = Settings { training: Training { steps, seed }, gravity, floor: None };
                    let fitted = Fitted::fit(model, &paths.first(OBSERVED), Some(&known), &settings)?;
                    let mut cells = Vec::new();
                    for hold in HOLDS {
                        cells.push(error(&fitted.infer_actions(&paths, &known, hold)?.rows[OBSERVED..]));
                    }
                    println!(
                        "| {name} | {noise} | {seed} | {flat:.3} | {linear:.3} | {} | {:.3} | {:.3} |",
                        model.name(),
                        cells[0],
                        cells[1]
                    );
                }
            }
        }
    }
    Ok(())
}

/// The world's nodes with normal noise.
fn noisy(world: &World, noise: f64, seed: u64) -> Paths {
    let points: Vec<Vec<[f64; 3]>> = (0..FRAMES).map(|t| world.nodes(t)).collect();
    let size = noise * Paths::of_points(&points).extent();
    let moved = |(t, nodes): (usize, &Vec<[f64; 3]>)| {
        let rng = Rng::new(seed, "noise of nodes", t as u64);
        let of = |(k, x): (usize, &[f64; 3])| std::array::from_fn(|c| x[c] + size * rng.normal((3 * k + c) as u64));
        nodes.iter().enumerate().map(of).collect::<Vec<[f64; 3]>>()
    };
    Paths::of_points(&points.iter().enumerate().map(moved).collect::<Vec<_>>())
}

fn rms(numbers: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = numbers.fold((0.0, 0), |(sum, count), x| (sum + x * x, count + 1));
    (sum / f64::from(count.max(1))).sqrt()
}

fn mean(rows: &[Vec<f64>]) -> Vec<f64> {
    (0..rows[0].len()).map(|c| rows.iter().map(|r| r[c]).sum::<f64>() / rows.len() as f64).collect()
}

/// Actions by least squares from the mean velocity of the nodes, its change and a constant: no model of the world.
fn linear(paths: &Paths, known: &Actions) -> Vec<Vec<f64>> {
    const INPUTS: usize = 7;
    let velocities: Vec<Vec<f64>> = paths
        .velocities()
        .iter()
        .map(|v| (0..3).map(|c| v.iter().map(|v| v[c]).sum::<f64>() / v.len() as f64).collect())
        .collect();
    // The action after tick t changes the velocity from that of t − 1 to that of t.
    let input = |t: usize| -> Vec<f64> {
        let (now, next) = (&velocities[t - 1], &velocities[t]);
        now.iter().copied().chain(now.iter().zip(next).map(|(a, b)| b - a)).chain([1.0]).collect()
    };
    let columns = known.names.len();
    let mut a = vec![[0.0; INPUTS]; INPUTS];
    let mut b = vec![vec![0.0; columns]; INPUTS];
    for t in 1..known.rows.len() {
        let x = input(t);
        for i in 0..INPUTS {
            (0..INPUTS).for_each(|j| a[i][j] += x[i] * x[j]);
            (0..columns).for_each(|c| b[i][c] += x[i] * known.rows[t][c]);
        }
    }
    // Directions without any motion have no diagonal.
    (0..INPUTS).for_each(|i| a[i][i] += 1e-9);
    for k in 0..INPUTS {
        for i in (0..INPUTS).filter(|i| *i != k) {
            let share = a[i][k] / a[k][k];
            (0..INPUTS).for_each(|j| a[i][j] -= share * a[k][j]);
            (0..columns).for_each(|c| b[i][c] -= share * b[k][c]);
        }
    }
    let row = |t: usize| -> Vec<f64> {
        let x = input(t);
        (0..columns).map(|c| (0..INPUTS).map(|i| x[i] * b[i][c] / a[i][i]).sum()).collect()
    };
    (known.rows.len()..paths.len() - 1).map(row).collect()
}
