//! `lab`: studies that vary what methods leave open, on made-up motion, and on runs and captures of one's own.

mod cells;
mod e00;
mod e01;
mod e02;
mod e03;
mod models;
mod study;
mod tables;

use crate::console::Console;

const EXAMPLES: &str = "\
Examples:
  splat4d lab e00                          what does a deformation network learn, and where does it fail?
  splat4d lab e01                          how far does lifted optical flow drift?
  splat4d lab e02 examples/knight          what do the temporal filter and the transport regularisers change?
  splat4d lab e03 runs/knight              how much can be pruned, by which score, and what does the filter cost?
  splat4d lab e03 runs/knight --quick
  splat4d lab models examples/knight       every motion model, three minutes each

A study can be stopped at any time and goes on where it was.";

/// Study methods: tables and curves of what they gain and lose
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    #[command(subcommand)]
    study: Study,
}

#[derive(Debug, clap::Subcommand)]
enum Study {
    E00(e00::Args),
    E01(e01::Args),
    E02(e02::Args),
    E03(e03::Args),
    Models(models::Args),
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    match &args.study {
        Study::E00(args) => e00::run(args, console),
        Study::E01(args) => e01::run(args, console),
        Study::E02(args) => e02::run(args, console),
        Study::E03(args) => e03::run(args, console),
        Study::Models(args) => models::run(args, console),
    }
}
