//! `compress`: a trained run becomes one that is many times smaller and faster to play, measured before and after.

use crate::console::Console;
use crate::device::Device;
use crate::interrupt;
use crate::measuring::MeasureArgs;
use splat4d_train::compress::{Compression, Level, MOST_PRUNED};
use splat4d_workflow::adopting::OnCapture;
use splat4d_workflow::compressing::{CompressOptions, GUARD, Work};
use splat4d_workflow::device::chosen;
use splat4d_workflow::measure::SIZE;
use splat4d_workflow::paths::parse_size;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  splat4d compress runs/knight                     pruned, masked, quantised, fine-tuned
  splat4d compress runs/knight --prune 0.8         keep a fifth of the Gaussians
  splat4d compress runs/knight --max-mb 0.5        best quality within half a megabyte
  splat4d compress runs/knight --level 1           only quantised and fine-tuned
  splat4d compress runs/knight --set rounds=3 --set temporal=width
  splat4d compress --resume runs/knight-compressed    continue exactly
  splat4d compress output/room --capture room -o small    another program's scene of this capture

The result is a run: DIR/scene.s4d plays anywhere, DIR/report.html compares before and after. The original run is \
unchanged. docs/compression.md explains the settings.";

/// Make a trained run smaller and faster to play: prune, mask, quantise, fine-tune; measured before and after
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = long_help())]
pub(crate) struct Args {
    /// The run; its capture must be where it was during training. With --capture any scene: a file, numbered files, an
    /// output folder
    #[arg(value_name = "RUN", required_unless_present = "resume")]
    run: Option<PathBuf>,
    /// Capture that a scene of another program was trained on
    #[arg(long, value_name = "CAPTURE", conflicts_with = "resume", help_heading = "Scenes of other programs")]
    capture: Option<PathBuf>,
    /// Views that are held out of --capture, as `train` takes them [default: the capture's convention]
    #[arg(long, value_name = "VIEWS", requires = "capture", help_heading = "Scenes of other programs")]
    hold_out: Option<String>,
    /// Divide the images' size by this with --capture
    #[arg(long, value_name = "K", requires = "capture", help_heading = "Scenes of other programs")]
    downscale: Option<usize>,
    /// Output folder [default: RUN-compressed, or RUN-compressed-2 ... if it exists]
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Continue this compression from its newest checkpoint
    #[arg(long, value_name = "DIR", conflicts_with_all = ["run", "output", "level", "prune", "score", "max_mb",
        "fine_tune", "set", "force", "guard", "unpruned"])]
    resume: Option<PathBuf>,
    /// Replace the run in the -o folder (only files that splat4d wrote) once the new run has begun
    #[arg(long)]
    force: bool,
    /// 0: the plain file; 1: quantised and fine-tuned; 2: also pruned and masked, coarser codes, a smaller palette
    #[arg(long, value_name = "0|1|2", default_value_t = 2, value_parser = clap::value_parser!(u8).range(0..=2))]
    level: u8,
    /// Share of the Gaussians to remove, 0 to 0.98
    #[arg(long, value_name = "SHARE", conflicts_with = "max_mb", value_parser = share)]
    prune: Option<f64>,
    /// Score of Gaussians: change, share, both, opacity, light-gaussian, pup or speedy [default: change]
    #[arg(long, value_name = "NAME")]
    score: Option<String>,
    /// Coarsen and prune until the file has at most this size in megabytes (10⁶ bytes)
    #[arg(long, value_name = "MB", value_parser = positive)]
    max_mb: Option<f64>,
    /// Total steps of fine-tuning [default: by level, a share of the run's steps]
    #[arg(long, value_name = "STEPS")]
    fine_tune: Option<usize>,
    /// Largest loss of training views in dB; beyond it half as much is pruned, at most twice (with --prune: only a
    /// warning). 0: no guard
    #[arg(long, value_name = "DB", default_value_t = GUARD, value_parser = natural)]
    guard: f64,
    /// Also train the unpruned scene for as many steps and compare with it; takes as long again
    #[arg(long)]
    unpruned: bool,
    /// Change a setting of the level, repeatable
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Skip evaluation, guard, comparison and report
    #[arg(long)]
    no_eval: bool,
    /// Image size at which playback is timed [default: 800x800]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    size: Option<[usize; 2]>,
    /// Device that renders during fine-tuning; the CPU does the rest
    #[arg(long, value_enum, default_value = "auto", help_heading = "Device")]
    device: Device,
    #[command(flatten)]
    measure: MeasureArgs,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    args.measure.check()?;
    let work = match &args.resume {
        Some(dir) => Work::reopen(dir)?,
        None => Work::begin(args.run.as_ref().expect("clap requires a run"), &options(args), console)?,
    };
    let work = work.timed_at(args.size.unwrap_or(SIZE)).on(chosen(args.device.into(), "fine-tuning", console));
    let stop = interrupt::flag("stopping");
    let dir = work.run(!args.no_eval, &args.measure.options(), &stop, console)?;
    console.next("view", &dir);
    Ok(())
}

/// The requested work.
fn options(args: &Args) -> CompressOptions {
    let on = args.capture.clone().map(|capture| OnCapture {
        capture,
        hold_out: args.hold_out.clone(),
        downscale: args.downscale,
    });
    CompressOptions {
        on,
        output: args.output.clone(),
        force: args.force,
        level: args.level,
        prune: args.prune,
        score: args.score.clone(),
        max_bytes: args.max_mb.map(|mb| (mb * 1e6) as u64),
        fine_tune: args.fine_tune,
        guard: args.guard,
        unpruned: args.unpruned,
        set: args.set.clone(),
        ..CompressOptions::default()
    }
}

fn number(text: &str, fits: impl Fn(f64) -> bool, need: &str) -> Result<f64, String> {
    let value: Option<f64> = text.parse().ok().filter(|v| fits(*v));
    value.ok_or_else(|| format!("expected {need}"))
}

fn share(text: &str) -> Result<f64, String> {
    number(text, |v| (0.0..=MOST_PRUNED).contains(&v), &format!("a share from 0 to {MOST_PRUNED}, for instance 0.5"))
}

fn positive(text: &str) -> Result<f64, String> {
    number(text, |v| v > 0.0 && v <= 1e6, "megabytes above 0, for instance 1.5")
}

fn natural(text: &str) -> Result<f64, String> {
    number(text, |v| (0.0..=100.0).contains(&v), "decibels from 0 on, for instance 0.5")
}

/// The examples, and every setting with its default by level.
fn long_help() -> String {
    let mut text =
        format!("{EXAMPLES}\n\nSettings (--set KEY=VALUE) as level 2 has them after 7,000 training steps:\n");
    let all = Compression::level(Level::Pruned, 7000).to_toml();
    all.lines().for_each(|line| text += &format!("  {line}\n"));
    text
}
