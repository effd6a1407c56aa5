//! Studies of open choices of the methods, on synthetic motion and on your own runs and captures. Not shipped: `cargo
//! run --release -p splat4d-studies -- e00`.
//!
//! # Code map
//!
//! A module imports only modules above it; `xtask/tests/tidy.rs` checks the order.
//!
//! | module | content |
//! |---|---|
//! | `cells.rs`, `study.rs`, `tables.rs` | cells that are computed once, tables, curves |
//! | `deformation.rs`, `lifting.rs` | synthetic motion with known truth |
//! | `made/` | synthetic captures, each hard for one reason |
//! | `e00.rs`, `e01.rs`, `e02.rs`, `e03.rs`, `models.rs` | the studies; `e02/` is the ablation of the filter |
//! | `replay.rs` | a capture that is recorded again while it is trained (docs/follow.md) |
//! | `suite/` | the recipe on a list of captures (docs/suite.md) |
//! | `best.rs` | the page of the best figures (docs/best.md) |
//! | `bench.rs`, `bench/` | pinned scenes, stages, training steps, growth, GPU stages, playback, other programs (`other_programs/with_gsplat.py`); each time with its lower bound (docs/benchmarks.md) |

mod bench;
mod best;
mod cells;
mod deformation;
mod e00;
mod e01;
mod e02;
mod e03;
mod lifting;
mod made;
mod models;
mod replay;
mod study;
mod suite;
mod tables;

use clap::{Parser, Subcommand};
use splat4d_cli::{Globals, verbs};
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  studies e00                          what does a deformation network learn, and where does it fail?
  studies e01                          how far does lifted optical flow drift?
  studies e02 examples/knight          what do the temporal filter and the transport regularisers change?
  studies e03 runs/knight              how much can be pruned, by which score, and what does the filter cost?
  studies e03 runs/knight --quick
  studies models examples/knight       every motion model, three minutes each
  studies replay examples/knight       how much does training frame by frame lose?
  studies suite --data sets            the recipe on captures of every kind
  studies bench                        speed of this machine, stage by stage
  studies best                         the best figure of every capture and model, next to published ones
  studies make one-wall runs/one-wall  a synthetic capture that is hard for one reason

A study can be stopped at any time and continues where it was.";

/// Studies of the methods: tables and curves of what they gain and lose
#[derive(Debug, Parser)]
#[command(name = "studies", version, after_help = EXAMPLES, max_term_width = 110)]
struct Cli {
    #[command(flatten)]
    globals: Globals,
    #[command(subcommand)]
    study: Study,
}

#[derive(Debug, Subcommand)]
enum Study {
    E00(e00::Args),
    E01(e01::Args),
    E02(e02::Args),
    E03(e03::Args),
    Models(models::Args),
    Replay(replay::Args),
    Suite(suite::Args),
    Bench(Box<bench::Args>),
    Best(best::Args),
    /// Render a synthetic capture that is hard for one reason
    Make(made::Args),
    /// `splat4d train`, for `models`: a cell is a process, so that its peak of memory is its own.
    #[command(hide = true)]
    Train(Box<verbs::train::Args>),
}

fn main() -> ExitCode {
    splat4d_cli::parsed(|cli: Cli| {
        let (study, threads) = (cli.study, cli.globals.threads);
        (cli.globals, move |console: &_| match study {
            Study::E00(args) => e00::run(&args, console),
            Study::E01(args) => e01::run(&args, console),
            Study::E02(args) => e02::run(&args, console),
            Study::E03(args) => e03::run(&args, console),
            Study::Models(args) => models::run(&args, console),
            Study::Replay(args) => replay::run(&args, console),
            Study::Suite(args) => suite::run(&args, console),
            Study::Bench(args) => bench::run(&args, threads, console),
            Study::Best(args) => best::run(&args, console),
            Study::Make(args) => made::run(&args, console),
            Study::Train(args) => verbs::train::run(&args, console),
        })
    })
}
