//! `status`: progress and workers of a run; of a long capture in chunks, part by part.

use crate::console::Console;
use crate::storage::{self, StorageArgs};
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
    #[command(flatten)]
    storage: StorageArgs,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let status = read(args)?;
    if console.json() {
        console.emit(&serde_json::to_value(&status).expect("it is plain data"));
        return Ok(());
    }
    console.result(status.text().trim_end());
    Ok(())
}

#[cfg(feature = "storage")]
fn read(args: &Args) -> anyhow::Result<status::Status> {
    if storage::is_address(&args.run) {
        return Ok(splat4d_workflow::storage::status(&args.run, &args.storage.open())?);
    }
    Ok(status::of(&args.run)?)
}

#[cfg(not(feature = "storage"))]
fn read(Args { run, storage: _ }: &Args) -> anyhow::Result<status::Status> {
    if storage::is_address(run) { storage::refused() } else { Ok(status::of(run)?) }
}
