//! `view`: a scene in the browser's player.

use crate::console::Console;
use crate::interrupt;
use crate::serving::{self, Place};
use serde_json::json;
use splat4d::Error;
use splat4d_serve::{Config, Content, Editing};
use splat4d_train::capture::{Capture, is_metadata};
use splat4d_train::recipe::Recipe;
use splat4d_train::run::open_capture;
use splat4d_workflow::baking::{Baking, pack, title};
use splat4d_workflow::capture_page;
use splat4d_workflow::editor::{self, Editor};
use splat4d_workflow::parts::left_out;
use splat4d_workflow::playable::Playable;
use splat4d_workflow::run_folder::Run;
use splat4d_workflow::source::{Source, bundle, not_empty};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::Arc;

const EXAMPLES: &str = "\
Examples:
  splat4d view runs/knight              play a run, also during training (its newest checkpoint)
  splat4d view scene.s4d                or a playback file, a scene.safetensors, a 3DGS .ply
  splat4d view https://example.org/a.s4d
  splat4d view my-take                  a capture: its cameras, images and points
  splat4d view runs/knight --edit edits.toml    edit in the browser, saved as a list (docs/edit.md)
  splat4d view runs/knight --no-open --port 8080

Without a screen it prints how to connect from another machine through ssh. The browser itself reads a scene on another \
web server, which must allow it (Access-Control-Allow-Origin, and preferably ranges). Ctrl-C stops.";

/// Play a scene in the browser, or look at a capture
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run, scene file, .ply, playback file, capture, or the address of a playback file
    #[arg(value_name = "RUN|FILE|CAPTURE|URL")]
    source: OsString,
    /// Edit in the page and save the list of edits in this file; it is created if it does not exist
    #[arg(long, value_name = "FILE")]
    edit: Option<PathBuf>,
    #[command(flatten)]
    place: Place,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    if !cfg!(feature = "serve") {
        return Err(left_out("`view`", "serve").into());
    }
    let address = args.source.to_str().filter(|s| ["http://", "https://"].iter().any(|scheme| s.starts_with(scheme)));
    let mut token = None;
    let config = if let Some(file) = &args.edit {
        if let Some(address) = address {
            return Err(Error::input("a scene on another server cannot be edited")
                .at(address)
                .remedy("Download it first.")
                .into());
        }
        token = Some(editor::token()?);
        editing(Path::new(&args.source), file, token.clone().expect("it was just made"), console)?
    } else if let Some(address) = address {
        let name = address.split(['?', '#']).next().and_then(|path| path.rsplit('/').next()).unwrap_or_default();
        Config { foreign: Some(address.to_owned()), about: json!({ "title": name }), ..Config::default() }
    } else if let Some(capture) = capture_at(Path::new(&args.source))? {
        of_capture(capture, console)?
    } else {
        let path = Path::new(&args.source);
        let Playable { title, content } = Playable::open(path, console)?;
        let config = Config { content, about: json!({ "title": title }), ..Config::default() };
        // A run whose capture is still there is shown next to its images.
        match Run::is(path).then(|| Run::open(path)?.open_capture()) {
            Some(Ok((capture, _))) => with_cameras(config, Arc::new(capture)),
            _ => config,
        }
    };
    let stop = interrupt::flag("stopping");
    let running = serving::start_for(config, &args.place, token.as_deref(), console)?;
    console.print_line("Ctrl-C stops it");
    serving::wait(&stop);
    running.stop();
    Ok(())
}

/// The capture at a path, if that is one: a marker file, or a folder that is not a run.
fn capture_at(path: &Path) -> splat4d::Result<Option<Capture>> {
    if is_metadata(path) {
        return open_capture(path, &Recipe::default()).map(Some);
    }
    // What is wrong with a folder that is neither is said by the reader of scenes.
    let maybe = path.is_dir() && !Run::is(path) && !bundle::is_scene(path);
    Ok(if maybe { open_capture(path, &Recipe::default()).ok() } else { None })
}

/// A page with the cameras, images and points of a capture.
fn of_capture(capture: Capture, console: &Console) -> anyhow::Result<Config> {
    let capture = Arc::new(capture);
    if capture.points.is_none() {
        console.print_line("the capture has no points: the page shows its cameras and images");
    }
    let title = capture.name.clone();
    let source = Source::own(capture_page::points(&capture));
    let packed = pack(&source, &title, &Baking { poster: false, ..Baking::default() }, console)?;
    console.clear();
    let about = json!({ "title": title, "frusta": true });
    Ok(with_cameras(Config { content: Content::Bytes(packed.bytes.into()), about, ..Config::default() }, capture))
}

fn with_cameras(mut config: Config, capture: Arc<Capture>) -> Config {
    let (cameras, photos) = capture_page::cameras(capture);
    config.about["cameras"] = cameras;
    Config { photos: Some(photos), ..config }
}

/// A server whose pages may edit the scene by a list.
fn editing(path: &Path, file: &Path, token: String, console: &Console) -> anyhow::Result<Config> {
    let source = Source::open(path)?.finite();
    not_empty(&source.scene, path)?;
    source.warnings.lines().iter().for_each(|w| console.warn(&format!("{w}.")));
    let title = title(&source, path);
    let editor = Editor::new(source, title.clone(), file)?;
    let content = match editor.start(console)? {
        Some(bytes) => Content::Bytes(bytes.into()),
        None => Playable::open(path, console)?.content,
    };
    let editing = Some(Editing::new(token, move |asked| editor.answer(asked)));
    Ok(Config { content, editing, about: json!({ "title": title }), ..Config::default() })
}
