//! `convert`: from any scene to the formats of other programs; see [`converting`].

use crate::console::Console;
use clap::builder::PossibleValuesParser;
use splat4d::format::dialect;
use splat4d::format::dialect::WriteOptions;
use splat4d::format::{DIALECTS, Linear};
use splat4d_workflow::converting::{self, Conversion, written};
use splat4d_workflow::files::either;
use splat4d_workflow::programs::{PROGRAMS, Program};
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  splat4d convert scene.ply scene.spz                 .spz, version 3; --spz-version 4: the newest
  splat4d convert scene.sog scene.ply --up y          y up instead of the format's y down
  splat4d convert scene.ply small.compressed.ply --sh 1
  splat4d convert runs/knight knight.splatv           dynamic: splaTV and gsplat.js play it
  splat4d convert runs/knight now.spz --time 0.5      one time
  splat4d convert runs/knight 'frames/f_%04d.spz' --frames
  splat4d convert runs/knight 'frames/f_%04d.ply' --frames --constant     for motion blur
  splat4d convert runs/knight 'take/' --frames --for unreal               z up, cm, left-handed
  splat4d convert runs/knight knight.usdz             USD with time samples
  splat4d convert frames/ all.safetensors --fps 25    numbered files become one dynamic scene
  splat4d convert runs/field field.ply --world        positions in the capture's map
  splat4d convert lengths.ply scene.ply --linear scales --linear opacities";

/// Text below the help: examples, and the formats of the list.
fn after_help() -> String {
    let read = DIALECTS.iter().filter(|d| !d.is_written()).map(|d| format!("{} ({})", d.name, d.ending));
    format!(
        "{EXAMPLES}\n\nWritten: .s4d {} .safetensors.\nAlso read: {}, folders of SOG. docs/formats.md states what each \
         format holds and which axes it assumes.",
        written(|_| true).join(" "),
        read.collect::<Vec<_>>().join(", ")
    )
}

/// Convert between Gaussian file formats, and report what is lost
#[derive(Debug, clap::Args)]
#[command(after_help = after_help())]
pub(crate) struct Args {
    #[arg(value_name = "IN", help = format!("A run, scene, {} file, a SOG folder, or a folder of numbered files",
          either(&dialect::extensions(|_| true))))]
    input: PathBuf,
    /// The file to write; its extension selects the format. With --frames a folder, or a pattern such as f_%04d.spz
    #[arg(value_name = "OUT")]
    output: PathBuf,
    /// One time, seconds of the scene
    #[arg(long, value_name = "T", allow_negative_numbers = true, conflicts_with = "frames")]
    time: Option<f64>,
    /// One file per frame
    #[arg(long)]
    frames: bool,
    /// Write the same Gaussians in the same order to every file of --frames, with opacity 0 outside their lifespans
    #[arg(long, requires = "frames")]
    constant: bool,
    /// Replace a sequence that splat4d wrote to the folder, even a longer one
    #[arg(long, requires = "frames")]
    force: bool,
    /// Frames per second of a sequence that is read (30), of --frames or of USD (the scene's)
    #[arg(long, value_name = "N")]
    fps: Option<f64>,
    /// First second of --frames
    #[arg(long, value_name = "S", requires = "frames", allow_negative_numbers = true)]
    from: Option<f64>,
    /// Last second of --frames
    #[arg(long, value_name = "S", requires = "frames", allow_negative_numbers = true)]
    to: Option<f64>,
    /// Rotate the scene so that this axis is up [default: by the format]
    #[arg(long, value_name = "AXIS", value_enum, allow_hyphen_values = true)]
    up: Option<Up>,
    /// Highest degree of spherical harmonics to keep
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(0..=3))]
    sh: Option<u8>,
    /// Leave out the provenance of a playback file
    #[arg(long)]
    no_provenance: bool,
    /// Refuse a format that cannot store lifespans exactly, instead of fitting them
    #[arg(long)]
    exact: bool,
    /// Add the scene's offset: positions in the capture's world, in double precision (.ply)
    #[arg(long)]
    world: bool,
    /// Read these values of the input as they are, not as logarithms, logits or coefficients, repeatable
    #[arg(long, value_name = "WHAT", value_enum)]
    linear: Vec<LinearValues>,
    /// Version of .spz to write: 3 for most programs, 2 for GaussianSplats3D and spz-js, 4 for PlayCanvas' engine
    #[arg(long, value_name = "V", default_value_t = WriteOptions::default().spz_version,
          value_parser = clap::value_parser!(u32).range(2..=4))]
    spz_version: u32,
    /// Axes, unit and file names of this program; with --frames also --constant
    #[arg(long = "for", value_name = "PROGRAM", value_parser = PossibleValuesParser::new(PROGRAMS.map(|p| p.name)))]
    program: Option<String>,
}

/// Which axis is up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Up {
    /// The axes stay as they are
    Keep,
    #[value(name = "y")]
    Y,
    #[value(name = "-y")]
    MinusY,
    #[value(name = "z")]
    Z,
    #[value(name = "-z")]
    MinusZ,
    #[value(name = "x")]
    X,
    #[value(name = "-x")]
    MinusX,
}

impl Up {
    fn of(up: Option<Self>) -> converting::Up {
        converting::Up::Axis(match up {
            None => return converting::Up::Format,
            Some(Self::Keep) => return converting::Up::Keep,
            Some(Self::X) => [1.0, 0.0, 0.0],
            Some(Self::MinusX) => [-1.0, 0.0, 0.0],
            Some(Self::Y) => [0.0, 1.0, 0.0],
            Some(Self::MinusY) => [0.0, -1.0, 0.0],
            Some(Self::Z) => [0.0, 0.0, 1.0],
            Some(Self::MinusZ) => [0.0, 0.0, -1.0],
        })
    }
}

/// Values that some programs do not store as logarithms, logits or coefficients.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum LinearValues {
    /// Scales are lengths
    Scales,
    /// Opacities are alphas from 0 to 1, 100 or 255
    Opacities,
    /// Base colours are RGB from 0 to 1 or 255
    Colours,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let linear = |what: &LinearValues| match what {
        LinearValues::Scales => Linear::Scales,
        LinearValues::Opacities => Linear::Opacities,
        LinearValues::Colours => Linear::Colours,
    };
    let conversion = Conversion {
        input: args.input.clone(),
        output: args.output.clone(),
        time: args.time,
        frames: args.frames,
        constant: args.constant,
        force: args.force,
        fps: args.fps,
        from: args.from,
        to: args.to,
        up: Up::of(args.up),
        sh: args.sh,
        no_provenance: args.no_provenance,
        exact: args.exact,
        world: args.world,
        linear: args.linear.iter().map(linear).collect(),
        spz_version: args.spz_version,
        program: args.program.as_deref().and_then(Program::of),
    };
    converting::run(&conversion, console)?;
    if !conversion.frames {
        console.next("view", &conversion.output);
    }
    Ok(())
}
