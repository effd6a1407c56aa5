//! The project's own chores: `cargo run --release -p xtask -- CHORE`.
//!
//! # Code map
//!
//! | module | content |
//! |---|---|
//! | `capture.rs`, `scene.rs`, `raster.rs` and others | render the bundled capture with a small renderer of their own |
//! | `fuzz.rs`, `chaos/` | damaged inputs for every reader; kills, full disks and second processes for every command that writes |

mod camera;
mod capture;
mod captures;
mod chaos;
mod count;
mod files;
mod film;
mod fuzz;
mod glb;
mod light;
mod long;
mod material;
mod mesh;
mod metrics;
mod photos;
mod picture;
mod raster;
mod scene;
mod skin;
mod still;
mod strip;
mod texture;
mod truth;
mod vector;
mod videos;
mod world;
mod yard;
mod yard_materials;

use anyhow::{Context, Result, bail, ensure};
use std::path::Path;
use std::process::ExitCode;

const USAGE: &str = "usage: cargo run --release -p xtask -- CHORE

chores:
  capture [FOLDER]           draws the \
                     bundled capture into FOLDER (default: examples/knight)
  capture --truth FOLDER     the same \
                     with depth, flow and labels (integer PNG) of every image: some 80 MB
  capture --check [N]       \
                      draws N random images (default 3) and compares them with examples/knight byte for byte
  \
                     capture --still CHARACTER.glb FOLDER [--views N] [--size PIXELS] [--pose CLIP SECONDS] [--drop \
                     NODE...]
                             draws a character frozen in one pose, cut out, from N \
                     (default 100) cameras on a
                             hemisphere, PIXELS (default 400) wide \
                     and high; every 8th is held out
  capture --videos FOLDER    draws the scene as eight \
                     unsynchronised, uncalibrated, differently exposed videos with sound,
                            \
                      for `splat4d import`, and truth.json next to them
  capture --world NAME [--truth] FOLDER
       \
                                           draws a world of known physics for `splat4d predict`: pendulum, circle, \
                     pushed-block, bounce,
                             rolling, collision, cloth or wind; true paths of \
                     its nodes and actions next to it, with --truth also depth, flow and labels
  capture --long SECONDS FOLDER [--size WxH] [--cameras N]
                             draws a take of any length, 30 frames a second, with images of any size (default 200x150) from N cameras \
                     (default 20); a frame in memory at a time
  capture --film FAULTS FOLDER [--size WxH]
                             draws the scene with ground-truth poses and cameras that are not ideal: FAULTS are rolling (a shutter of
                             30 ms), blur (exposures of 1/40 s), drift (of exposure and white balance) and vignetting (corners lose 45 %), joined by
                             commas, or none
  strip-character IN.glb OUT.glb CLIP... \
                     [--drop NODE...]
                             keeps the named animation clips of a character, \
                     drops the named nodes' meshes
  fuzz [--minutes N] [--seed S] [--reader NAME]
                   \
                               mutates sound inputs of every reader and prints how many were read (default: 2 \
                     minutes)
  chaos [--trials N] [--seed N] [--verb NAME] [--program FILE]
                         \
                         disturbs every verb that writes (kill -9, full disk, two owners, clock jumps, read-only
     \
                                             folders) and compares its result with the undisturbed one; needs the \
                     release build
  count [FOLDER]             counts lines of code, without tests, comments and \
                     blank lines, of the repository FOLDER";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match run(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &[String]) -> Result<()> {
    let (chore, rest) = arguments.split_first().context(USAGE)?;
    match chore.as_str() {
        "capture" => captures::command(rest),
        "chaos" => chaos::command(rest),
        "count" => count::command(rest),
        "fuzz" => fuzz::command(rest),
        "strip-character" => strip_character(rest),
        _ => bail!("unknown chore {chore}\n{USAGE}"),
    }
}

fn strip_character(arguments: &[String]) -> Result<()> {
    ensure!(arguments.len() >= 2, "{USAGE}");
    let (paths, names) = arguments.split_at(2);
    let split = names.iter().position(|n| n == "--drop").unwrap_or(names.len());
    let (clips, drop) = (&names[..split], names.get(split + 1..).unwrap_or(&[]));
    let bytes = std::fs::read(&paths[0]).with_context(|| paths[0].clone())?;
    let stripped = strip::strip(&glb::Glb::parse(&bytes)?, clips, drop)?.to_bytes();
    skin::Character::load(&glb::Glb::parse(&stripped)?).context("the stripped file cannot be read back")?;
    files::write_file(Path::new(&paths[1]), &stripped)?;
    println!("{}: {} KB, was {} KB", paths[1], stripped.len() / 1000, bytes.len() / 1000);
    Ok(())
}
