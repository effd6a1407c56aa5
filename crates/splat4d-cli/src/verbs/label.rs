//! `label`: learns labels and features of a trained run from masks and feature images.

use crate::console::Console;
use crate::interrupt;
use splat4d_workflow::labelling;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  splat4d label runs/take                      masks that its capture.json names (docs/labels.md)
  splat4d label runs/take --from segmented/    masks of another capture of the same cameras
  splat4d render runs/take --channel label -o labels.mp4
  splat4d edit runs/take --delete 'not label(hand)' -o hand.s4d

`train` does it at its end if the capture has labels or features. Geometry and colours stay unchanged.";

/// Learn a label of each Gaussian from masks, and its features from feature images
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// The capture with masks and features [default: the run's]
    #[arg(long, value_name = "CAPTURE")]
    from: Option<PathBuf>,
    /// Passes over the images
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=100))]
    rounds: Option<u16>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let stop = interrupt::flag("stopping");
    interrupt::stop_not_polled("the same command begins again");
    let rounds = args.rounds.map(usize::from);
    labelling::label(&args.run, args.from.as_deref(), rounds, &stop, console)?;
    console.next("view", &args.run);
    Ok(())
}
