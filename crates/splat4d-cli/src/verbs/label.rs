//! `label`: labels and features learnt into a trained run from masks and pictures of features.

use crate::console::Console;
use crate::run_folder::Run;
use crate::{finish, labelling};
use splat4d_train::output::OutputFolder;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  splat4d label runs/take                      from what its capture.json names (docs/labels.md)
  splat4d label runs/take --from segmented/    from another capture's masks, of the same cameras
  splat4d render runs/take --channel label -o labels.mp4
  splat4d edit runs/take --delete 'not label(hand)' -o hand.s4d

`train` does it at its end where the capture has labels or features. Shapes, places and colours stay as they are.";

/// Learn what each Gaussian is part of from masks of labels, and its features from pictures of features
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// The capture whose masks and features are meant [default: the run's]
    #[arg(long, value_name = "CAPTURE")]
    from: Option<PathBuf>,
    /// Passes over the pictures
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=100))]
    rounds: Option<u16>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    Run::open(&args.run)?;
    let _folder = OutputFolder::amend(&args.run, "label")?;
    labelling::label(&args.run, args.from.as_deref(), args.rounds.map(usize::from), console)?;
    finish::playback(&args.run, console)?;
    finish::write_page(&args.run, console)
}
