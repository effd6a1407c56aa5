//! `compare`: runs, and results of other programs, in one table.

use crate::console::Console;
use splat4d_workflow::comparison;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  splat4d compare runs/*                              a table of all runs
  splat4d compare runs/a runs/b -o compared.html      images side by side, and curves
  splat4d compare runs/a other/results.json -o table.csv

Results of other programs are results.json files as 3DGS or nerfstudio write them. Scores can only be compared if capture, \
image size and held-out views are equal: what differs is printed.";

/// Compare runs and results of other programs in a table
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Runs, or results.json files of other programs and their folders
    #[arg(value_name = "RUN", required = true)]
    runs: Vec<PathBuf>,
    /// Also write the table: .csv, .md, or .html with images side by side and curves
    #[arg(short, long, value_name = "FILE")]
    output: Vec<PathBuf>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    Ok(comparison::compare(&args.runs, &args.output, console)?)
}
