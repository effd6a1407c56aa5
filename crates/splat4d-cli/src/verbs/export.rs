//! `export`: moments of a scene as plain 3DGS .ply files.

use crate::console::Console;
use crate::files;
use crate::freeze::freeze;
use crate::sequence;
use crate::source::{Source, not_empty};
use serde_json::json;
use splat4d::{Error, format};
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  splat4d export runs/knight -o now.ply --time 0.5         one moment; every 3DGS viewer opens it
  splat4d export runs/knight --sequence frames/            frames/frame_00000.ply ...; SuperSplat plays them
  splat4d export runs/knight --sequence frames/ --fps 10 --from 0.2 --to 0.8";

/// Write moments of a scene as 3DGS .ply files
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run, scene file or .ply
    #[arg(value_name = "RUN|FILE", required_unless_present = "model")]
    source: Option<PathBuf>,
    /// The file of one moment
    #[arg(short, long, value_name = "OUT.ply", required_unless_present = "sequence")]
    output: Option<PathBuf>,
    /// The moment, seconds of the scene [default: the clip's start]
    #[arg(long, value_name = "T", allow_negative_numbers = true, conflicts_with = "sequence")]
    time: Option<f64>,
    /// A folder for one file a frame
    #[arg(long, value_name = "FOLDER", conflicts_with = "output")]
    sequence: Option<PathBuf>,
    /// Files a second of a sequence [default: the capture's frames a second]
    #[arg(long, value_name = "N", requires = "sequence")]
    fps: Option<f64>,
    /// First second of a sequence
    #[arg(long, value_name = "S", requires = "sequence", allow_negative_numbers = true)]
    from: Option<f64>,
    /// Last second of a sequence
    #[arg(long, value_name = "S", requires = "sequence", allow_negative_numbers = true)]
    to: Option<f64>,

    #[arg(short = 'm', long = "model-path", alias = "model_path", hide = true, conflicts_with = "source")]
    model: Option<PathBuf>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let path = args.source.as_ref().or(args.model.as_ref()).expect("clap asks for a source");
    for (name, value) in [("--time", args.time), ("--fps", args.fps), ("--from", args.from), ("--to", args.to)] {
        if value.is_some_and(|v| !v.is_finite() || (name == "--fps" && !(0.01..=1000.0).contains(&v))) {
            return Err(Error::input(format!("{name} is out of range"))
                .remedy("Give a plain, sensible number.")
                .into());
        }
    }
    let source = Source::open(path)?;
    let scene = &source.scene;
    not_empty(scene, path)?;
    let write = |time: f64, out: &Path| -> anyhow::Result<usize> {
        let params = freeze(scene, time);
        let mut bytes = Vec::new();
        format::ply::write(&params, &mut bytes)?;
        files::write(out, &bytes)?;
        Ok(params.len())
    };
    if let Some(folder) = &args.sequence {
        let (fps, times) = sequence::moments(scene, args.fps, [args.from, args.to])?;
        let pattern = sequence::Pattern::in_folder(folder);
        files::make_folder(folder)?;
        for (i, &time) in times.iter().enumerate() {
            write(time, &pattern.file(i))?;
            console.phase("exporting", i + 1, times.len());
        }
        console.clear();
        let (from, to) = (times[0], times[times.len() - 1]);
        console.say(&format!("{} files, {fps} a second, from {from} to {to} s", times.len()));
        console.written(folder);
        return Ok(());
    }
    let out = args.output.as_ref().expect("clap asks for an output");
    if out.extension().is_none_or(|e| !e.eq_ignore_ascii_case("ply")) && !out.starts_with("/dev") {
        return Err(Error::input("only .ply files are written").at(out.display()).remedy("Use -o NAME.ply.").into());
    }
    let time = args.time.unwrap_or(scene.clip[0]);
    let n = write(time, out)?;
    if n == 0 {
        console.warn(&format!(
            "nothing is alive at {time} s: the file is empty. The scene lasts from {} to {} s.",
            scene.clip[0], scene.clip[1]
        ));
    }
    console.say(&format!("{} Gaussians at {time} s", files::grouped(n)));
    console.emit(&json!({"type": "exported", "gaussians": n, "time": time}));
    console.written(out);
    Ok(())
}
