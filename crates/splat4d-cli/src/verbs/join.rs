//! `join`: the finished chunks of a long capture become one scene and one file.

use crate::console::Console;
use crate::interrupt;
use crate::measuring::MeasureArgs;
use crate::storage::{self, StorageArgs};
use splat4d_train::output::OutputFolder;
use splat4d_train::run::chunks::Chunked;
use splat4d_workflow::chunked;
use splat4d_workflow::deadline::Deadline;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  splat4d join runs/concert   after `train concert -o runs/concert --chunk I` for every I";

/// Join the chunks of a long capture into one scene and file, measure and report
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Only the scene and its file; skip evaluation, film and report
    #[arg(long)]
    no_eval: bool,
    #[command(flatten)]
    measure: MeasureArgs,
    #[command(flatten)]
    storage: StorageArgs,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    args.measure.check()?;
    let stop = interrupt::flag("stopping");
    interrupt::stop_not_polled("all parts are kept, and the same command joins them");
    if storage::is_address(&args.run) {
        return on_storage(args, &stop, console);
    }
    let chunked = Chunked::open(&args.run)?;
    let _folder = OutputFolder::amend(&args.run, "join")?;
    chunked::join(&args.run, &chunked, args.no_eval, &args.measure.options(), &Deadline::default(), &stop, console)?;
    console.next("view", &args.run);
    Ok(())
}

#[cfg(feature = "storage")]
fn on_storage(args: &Args, stop: &std::sync::atomic::AtomicBool, console: &Console) -> anyhow::Result<()> {
    let storage = args.storage.open();
    splat4d_workflow::storage::join(&args.run, args.no_eval, &args.measure.options(), &storage, stop, console)?;
    console.next("status", &args.run);
    Ok(())
}

#[cfg(not(feature = "storage"))]
fn on_storage(args: &Args, _: &std::sync::atomic::AtomicBool, _: &Console) -> anyhow::Result<()> {
    let Args { storage: _, .. } = args;
    storage::refused()
}
