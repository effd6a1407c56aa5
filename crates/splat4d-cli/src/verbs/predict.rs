//! `predict`: forecasts of a run that was trained on the first part of its clip, compared with the rest.

use crate::console::Console;
use crate::interrupt;
use splat4d::{Error, Result};
use splat4d_dynamics::actions::Actions;
use splat4d_dynamics::learnt::Training;
use splat4d_dynamics::models::Model;
use splat4d_dynamics::nodes::MAX_NODES;
use splat4d_workflow::files;
use splat4d_workflow::predicting::{NODES, PredictOptions, STEPS, predict};
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  splat4d train my-take --observe 0.8 -o runs/seen      keep the last fifth from training
  splat4d predict runs/seen                             all models, as far as there are images
  splat4d predict runs/seen --model koopman --horizon 90   three seconds, partly without comparison
  splat4d predict runs/seen --model graph --seeds 3     an ensemble, with its uncertainty
  splat4d predict runs/block --actions actions.csv      known actions, one row per frame
  splat4d predict runs/seen --oracle runs/all           compare with a run trained on the whole clip
  splat4d predict runs/seen --assimilate                correct by each new frame

Models, each a baseline for the next: freeze, velocity, acceleration, extrapolate (the motion model at later times), \
koopman (decaying oscillations), causal (state space), graph (messages along edges). RUN/predict contains report.html, \
predict.json, dynamics.safetensors and the predicted scene as scene.s4d and scene.safetensors. With several models, the \
scene uses the one with the best forecasts within the observed part.";

/// Largest horizon, frames: a minute at 60 frames per second.
const MAX_HORIZON: usize = 3600;
/// Most members of an ensemble.
const MAX_SEEDS: u64 = 16;

/// Forecast a scene, and compare with the part of the capture that was kept from training
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run, trained with --observe; its capture must be where it was during training
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Frames to predict [default: as many as have images]
    #[arg(long, value_name = "FRAMES", value_parser = clap::value_parser!(u32).range(1..=MAX_HORIZON as i64))]
    horizon: Option<u32>,
    /// freeze, velocity, acceleration, extrapolate, koopman, causal, graph or all
    #[arg(long, value_name = "NAME", default_value = "all")]
    model: String,
    /// Known actions: a header of up to 8 names, then one row per frame from the first of the clip. Columns NAME.x,
    /// NAME.y, NAME.z are a vector
    #[arg(long, value_name = "CSV")]
    actions: Option<PathBuf>,
    /// Members of the ensembles of the trained models
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=MAX_SEEDS))]
    seeds: u64,
    /// Largest number of nodes on dynamic regions
    #[arg(long, value_name = "N", default_value_t = NODES as u32, value_parser = clap::value_parser!(u32).range(1..=MAX_NODES as i64))]
    nodes: u32,
    /// Training steps of causal and graph
    #[arg(long, value_name = "STEPS", default_value_t = STEPS as u32, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    steps: u32,
    /// Give causal and graph the down direction
    #[arg(long)]
    gravity: bool,
    /// Correct the prediction by each new frame: predict, render, compare, update
    #[arg(long)]
    assimilate: bool,
    /// A run of the same capture, trained on the whole clip: the upper bound
    #[arg(long, value_name = "RUN")]
    oracle: Option<PathBuf>,
    /// Skip films of truth and prediction
    #[arg(long)]
    no_film: bool,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let models = match args.model.as_str() {
        "all" => Model::ALL.to_vec(),
        name => name.split(',').map(|n| Model::from_name(n.trim())).collect::<Result<_>>()?,
    };
    let read = |path: &PathBuf| Actions::parse(&files::read_text(path)?).map_err(|e: Error| e.at(path.display()));
    let options = PredictOptions {
        run: args.run.clone(),
        horizon: args.horizon.map(|h| h as usize),
        models,
        actions: args.actions.as_ref().map(read).transpose()?,
        seeds: args.seeds,
        nodes: args.nodes as usize,
        training: Training { steps: args.steps as usize, seed: 0 },
        gravity: args.gravity,
        assimilate: args.assimilate,
        oracle: args.oracle.clone(),
        film: !args.no_film,
    };
    let stop = interrupt::flag("stopping");
    interrupt::stop_not_polled("the same command begins again");
    let folder = predict(options, &stop, console)?;
    console.next("view", &folder.join("scene.s4d"));
    Ok(())
}
