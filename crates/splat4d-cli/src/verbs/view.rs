//! `view`: a scene in the browser's player.

use crate::console::Console;
use crate::interrupt;
use crate::playable::Playable;
use crate::serving::{self, Place};
use serde_json::json;
use splat4d_serve::Config;
use std::path::Path;

const EXAMPLES: &str = "\
Examples:
  splat4d view runs/knight              play a run; works while it trains, too (its newest checkpoint)
  splat4d view scene.splat4d            or a playback file, a scene.safetensors, a 3DGS .ply
  splat4d view https://example.org/a.splat4d
  splat4d view runs/knight --no-open --port 8080

On a machine without a screen it says how to look from another one through ssh. A scene on another web server is read
by the browser itself: that server must allow it (Access-Control-Allow-Origin, and best ranges). Ctrl-C stops.";

/// Play a scene in the browser
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run, scene file, .ply, playback file, or the address of a playback file
    #[arg(value_name = "RUN|FILE|URL")]
    source: String,
    #[command(flatten)]
    place: Place,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let config = if ["http://", "https://"].iter().any(|scheme| args.source.starts_with(scheme)) {
        let name = args.source.split(['?', '#']).next().and_then(|path| path.rsplit('/').next()).unwrap_or_default();
        Config { foreign: Some(args.source.clone()), about: json!({ "title": name }), ..Config::default() }
    } else {
        let Playable { title, content } = Playable::open(Path::new(&args.source), console)?;
        Config { content, about: json!({ "title": title }), ..Config::default() }
    };
    let stop = interrupt::flag("stopping");
    let running = serving::start(config, &args.place, console)?;
    console.say("Ctrl-C stops it");
    serving::wait(&stop);
    running.stop();
    Ok(())
}
