//! `localise`: finds the pose and time of images of a scene.

use crate::console::Console;
use splat4d_workflow::localising::{LocaliseOptions, localise};
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  splat4d localise runs/knight photo.jpg                   pose and time of an image
  splat4d localise runs/knight a.png b.png -o found.json   cameras in the format of `cameras.json`
  splat4d localise scene.ply photo.jpg --start cam.json    near this camera, with its lens

Images must be undistorted and have the aspect ratio of the start cameras. The lens is that of the best start camera, or \
found with --lens. Exposure and white balance may differ from the scene's. A start camera within about 20° of the image \
is needed. An image is refused if the final difference is more than a third of its difference from one plain colour.";

/// Find pose and time of images of a scene
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run or scene file
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    /// The images: JPEG, PNG or WebP, each localised independently
    #[arg(value_name = "IMAGE", required = true)]
    pictures: Vec<PathBuf>,
    /// Start from this camera (a camera file), or these (a cameras.json) [default: the run's cameras]
    #[arg(long, value_name = "FILE")]
    start: Option<PathBuf>,
    /// Also find the focal length
    #[arg(long)]
    lens: bool,
    /// Write the cameras found to this file, as `cameras.json`
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let options = LocaliseOptions { start: args.start.clone(), lens: args.lens, output: args.output.clone() };
    localise(&args.scene, &args.pictures, &options, console)?;
    Ok(())
}
