//! `priors`: depth, flow, masks and tracks of a capture, by networks that the user brings.

use crate::console::Console;
use crate::interrupt;
use splat4d::{Error, Result};
use splat4d_workflow::models::{Description, PUBLISHED, published};
use splat4d_workflow::priors::{Part, Priors, priors};
use std::collections::BTreeMap;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  splat4d priors --describe                      ready-made descriptions and their sources
  splat4d priors --describe midas-v2 > model.toml    a description, for changes
  splat4d priors my-take --depth depth.onnx      described by depth.toml or model.toml
  splat4d priors my-take --depth d.onnx --described depth-anything-v2
  splat4d train my-take                          uses what it finds in my-take/priors/

The program never downloads weights. The same command continues interrupted work.";

/// Compute depth, flow, masks and tracks of a capture by networks (.onnx) that you bring
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The capture; results go to its folder priors/
    #[arg(value_name = "CAPTURE", required_unless_present = "describe")]
    capture: Option<PathBuf>,
    /// A network for depth or inverse depth
    #[arg(long, value_name = "ONNX")]
    depth: Option<PathBuf>,
    /// A network for optical flow of two images
    #[arg(long, value_name = "ONNX")]
    flow: Option<PathBuf>,
    /// A network for foreground masks, for instance of people
    #[arg(long, value_name = "ONNX")]
    masks: Option<PathBuf>,
    /// A network for matches of two images, which become point tracks
    #[arg(long, value_name = "ONNX")]
    tracks: Option<PathBuf>,
    /// Ready-made descriptions to use instead of files next to the networks
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    described: Vec<String>,
    /// Print a ready-made description; without a name, list them
    #[arg(long, value_name = "NAME", num_args = 0..=1, conflicts_with = "capture")]
    describe: Option<Option<String>>,
    /// Replace what another network wrote
    #[arg(long)]
    force: bool,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    match (&args.describe, &args.capture) {
        (Some(Some(name)), _) => {
            console.result(published(name)?.trim_end());
            Ok(())
        }
        (None, Some(capture)) => compute(args, capture.clone(), console),
        _ => {
            for (name, text) in PUBLISHED {
                let described = Description::parse(text)?;
                let kind = described.output.kind.name();
                console.result(&format!(
                    "{name}: {kind}. {}\n  {}\n  {}",
                    described.name, described.source, described.licence
                ));
            }
            Ok(())
        }
    }
}

fn compute(args: &Args, capture: PathBuf, console: &Console) -> anyhow::Result<()> {
    let given = [&args.depth, &args.flow, &args.masks, &args.tracks];
    let networks: BTreeMap<Part, PathBuf> =
        Part::ALL.into_iter().zip(given).filter_map(|(part, path)| Some((part, path.clone()?))).collect();
    let described = args.described.iter().map(|name| Ok((part_of(name)?, name.clone()))).collect::<Result<_>>()?;
    let stop = interrupt::flag("stopping");
    let made = priors(&Priors { capture: capture.clone(), networks, described, force: args.force }, &stop, console)?;
    if console.json() {
        console.emit(&made.json());
    } else {
        console.result(&made.text());
        console.result(&format!("wrote {}; `train` uses it", made.folder.display()));
        console.next("train", &capture);
    }
    Ok(())
}

/// What a ready-made description is for. Errors: another name.
fn part_of(name: &str) -> Result<Part> {
    let kind = Description::parse(published(name)?)?.output.kind;
    Part::of(kind).ok_or_else(|| {
        Error::input(format!("{name} finds {}, which no prior is made of", kind.name()))
            .remedy("Give it to `splat4d import --keypoints` (docs/networks.md)")
    })
}
