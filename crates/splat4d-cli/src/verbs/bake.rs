//! `bake`: a run or a scene becomes one file for playback.

use crate::console::Console;
use splat4d::Error;
use splat4d::bake::{MAX_REPEAT, Options, SEGMENT, TOLERANCE};
use splat4d::format::playback::{MAX_PALETTE, WriteConfig};
use splat4d_workflow::baking::{Baking, SoundChoice, bake};
use splat4d_workflow::files::parse_bytes;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  splat4d bake runs/knight -o knight.s4d              one small file that plays anywhere
  splat4d bake runs/knight -o small.s4d --size 4MB    motion is split as finely as that allows
  splat4d bake runs/knight -o tight.s4d --tolerance 0.1
  splat4d bake runs/knight -o long.s4d --repeat 20    repeat the clip twenty times
  splat4d bake runs/knight -o steps.s4d --ladder 1,2,4   the player chooses by the connection

`train` does this at its end: the file is RUN/scene.s4d.";

/// Bake a scene into one seekable file for the player
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run, scene file or .ply
    #[arg(value_name = "RUN|FILE")]
    source: PathBuf,
    /// The file to write
    #[arg(short, long, value_name = "OUT.s4d")]
    output: PathBuf,
    /// Size limit of the file: motion is split into as many segments as fit, up to 40 dB against the model [default:
    /// the size of the learned scene, and 1.5 MB per second]
    #[arg(long, value_name = "SIZE", value_parser = parse_bytes)]
    size: Option<u64>,
    /// Split every segment that misses by more pixels of the capture's cameras, without a size limit
    #[arg(long, value_name = "PX", conflicts_with = "size")]
    tolerance: Option<f64>,
    /// Bitrate ladder: nested parts of the file that stay within these rates, rising; the player chooses one by the
    /// connection and the device
    #[arg(long, value_name = "MBIT/S,...", value_delimiter = ',')]
    ladder: Vec<f64>,
    /// Approximate seconds that a seek loads
    #[arg(long, value_name = "S", default_value_t = SEGMENT)]
    segment: f64,
    /// Repeat the clip N times
    #[arg(long, value_name = "N", default_value_t = 1)]
    repeat: usize,
    /// Largest number of palette entries (view-dependent colours)
    #[arg(long, value_name = "N", default_value_t = WriteConfig::default().palette)]
    palette: usize,
    /// Leave out the poster image that is shown during loading
    #[arg(long)]
    no_poster: bool,
    /// Sound: none, or a file with a sound track, which begins with the clip [default: the capture's, or that of the file]
    #[arg(long, value_name = "FILE|none")]
    sound: Option<PathBuf>,
    /// Write settings and quality as JSON
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let out = &args.output;
    if !(1..=MAX_REPEAT).contains(&args.repeat) || !(1..=MAX_PALETTE).contains(&args.palette) {
        return Err(Error::input("--repeat or --palette is out of range")
            .remedy(format!("Give --repeat 1 to {MAX_REPEAT} and --palette 1 to {MAX_PALETTE}."))
            .into());
    }
    let baking = Baking {
        options: Options {
            tolerance: args.tolerance.unwrap_or(TOLERANCE),
            segment: args.segment,
            repeat: args.repeat,
            ..Options::default()
        },
        tolerance: args.tolerance,
        bytes: args.size,
        palette: args.palette,
        poster: !args.no_poster,
        ladder: args.ladder.clone(),
        sound: match &args.sound {
            None => SoundChoice::Kept,
            Some(none) if none.as_os_str() == "none" => SoundChoice::None,
            Some(file) => SoundChoice::File(file.clone()),
        },
        ..Baking::default()
    };
    bake(&args.source, out, args.report.as_deref(), &baking, console)?;
    console.next("view", out);
    Ok(())
}
