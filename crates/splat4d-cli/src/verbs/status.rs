//! `status`: progress and workers of a run; of a long capture in chunks, part by part.

use crate::console::Console;
use splat4d_workflow::status;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  splat4d status runs/concert           parts, who trains which, time left
  splat4d status runs/concert --json    the same as one JSON object, for schedulers

It only reads files: run it at any time, on any machine that has the folder. Steps are those of the last checkpoint.";

/// Print the progress and the workers of a run, part by part
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run
    #[arg(value_name = "RUN")]
    run: PathBuf,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let status = status::of(&args.run)?;
    if console.json() {
        console.emit(&serde_json::to_value(&status).expect("it is plain data"));
        return Ok(());
    }
    console.result(status.text().trim_end());
    Ok(())
}
