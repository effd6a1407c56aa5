//! The player's server as verbs use it: options, what is said about it, the browser, and a run that is being watched.

use crate::console::Console;
use serde_json::json;
use splat4d_serve::{Config, News, Running, Server};
use splat4d_train::event::Event;
use splat4d_workflow::playable;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// How often a waiting program looks whether Ctrl-C was pressed.
const LOOK: Duration = Duration::from_millis(50);

/// Where to serve.
#[derive(Clone, Debug, Default, clap::Args)]
pub(crate) struct Place {
    /// Port of the page; 0: any free one [default: 4440, or a free one after it]
    #[arg(long, value_name = "N", help_heading = "Serving")]
    pub port: Option<u16>,
    /// Serve at this name or address, also to other machines [default: this machine only]
    #[arg(long, value_name = "NAME", help_heading = "Serving")]
    pub host: Option<String>,
    /// Print the address and open no browser
    #[arg(long, help_heading = "Serving")]
    pub no_open: bool,
    /// Read the player from this folder, for its development
    #[arg(long, value_name = "DIR", hide = true)]
    pub player_folder: Option<PathBuf>,
}

impl Place {
    /// Whether any of it was said.
    pub(crate) fn is_told(&self) -> bool {
        self.port.is_some() || self.host.is_some() || self.no_open || self.player_folder.is_some()
    }
}

/// Starts a server, says where, and opens the browser.
pub(crate) fn start(config: Config, place: &Place, console: &Console) -> splat4d::Result<Running> {
    start_for(config, place, None, console)
}

/// The same; the page that is opened here may edit by this token.
pub(crate) fn start_for(
    config: Config,
    place: &Place,
    token: Option<&str>,
    console: &Console,
) -> splat4d::Result<Running> {
    let host = place.host.clone().unwrap_or(config.host);
    let running =
        Server::start(Config { host, port: place.port, player_folder: place.player_folder.clone(), ..config })?;
    // Behind `#` a browser sends nothing to anybody, and pages that are linked to do not see it.
    let url = token.map_or(running.url().to_owned(), |token| format!("{}#edit={token}", running.url()));
    console.say(&format!("the player is at {url}"));
    console.emit(&json!({"type": "serving", "url": url}));
    if !running.address().ip().is_loopback() {
        console.warn("every computer that reaches this machine over the network can view the scene.");
    }
    if !place.no_open && !open_browser(&url) {
        let port = running.address().port();
        console.say(&format!(
            "this machine has no screen. On your own computer: ssh -L {port}:localhost:{port} {}, then open \
             http://localhost:{port}/{}",
            machine(),
            token.map_or(String::new(), |token| format!("#edit={token}"))
        ));
    }
    Ok(running)
}

/// Waits for Ctrl-C.
pub(crate) fn wait(stop: &AtomicBool) {
    while !stop.load(Ordering::SeqCst) {
        std::thread::sleep(LOOK);
    }
}

/// How a shell elsewhere names this machine, as far as that is known.
fn machine() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let name = name.trim();
    if name.is_empty() { "THIS-MACHINE".into() } else { name.to_owned() }
}

/// Opens the user's browser; false where there is no screen, or nothing that opens pages.
fn open_browser(url: &str) -> bool {
    let told = |name: &str| std::env::var_os(name).is_some_and(|v| !v.is_empty());
    let mut command = if cfg!(target_os = "macos") {
        Command::new("open")
    } else if cfg!(windows) {
        Command::new("explorer")
    } else if told("DISPLAY") || told("WAYLAND_DISPLAY") {
        Command::new("xdg-open")
    } else {
        return false;
    };
    let child = command.arg(url).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
    match child {
        Ok(mut child) => {
            // Waited for elsewhere, so that it does not stay behind as a dead process.
            std::thread::spawn(move || child.wait());
            true
        }
        Err(_) => false,
    }
}

/// A run that is watched while it trains. What goes wrong with watching never costs the run.
pub(crate) struct Watch {
    running: Option<Running>,
}

impl Watch {
    /// Nobody looks.
    pub(crate) fn nobody() -> Self {
        Self { running: None }
    }

    /// Starts to serve a run that is about to train; a server that cannot be started is a warning.
    pub(crate) fn start(title: &str, place: &Place, console: &Console) -> Self {
        let config = Config { live: true, background: true, about: json!({ "title": title }), ..Config::default() };
        match start(config, place, console) {
            Ok(running) => Self { running: Some(running) },
            Err(error) => {
                console.warn(&format!("training continues without the page: {error}"));
                Self::nobody()
            }
        }
    }

    /// Whether somebody could look.
    pub(crate) fn is_on(&self) -> bool {
        self.running.is_some()
    }

    /// Passes an event on.
    pub(crate) fn hear(&self, event: &Event) {
        let Some(running) = &self.running else { return };
        match event {
            Event::Snapshot { iteration, bytes } => {
                running.set_scene(bytes.clone(), &json!({ "iteration": iteration }));
            }
            Event::Progress { .. } => {
                running.publish(&News::Step(serde_json::to_value(event).expect("events are plain data")));
            }
            Event::Warning { message } => running.publish(&News::Note(json!({ "message": message }))),
            Event::RolledBack { iteration, to, what } => {
                let message = format!("step {iteration} was not finite ({what}); rolled back to step {to}");
                running.publish(&News::Note(json!({ "message": message })));
            }
            Event::Finished { iteration, seconds, gaussians, .. } => running.publish(&News::Done(json!({
                "iteration": iteration, "seconds": seconds, "gaussians": gaussians,
            }))),
            _ => {}
        }
    }

    /// Shows a finished run's playback file, where there is one.
    pub(crate) fn show(&self, run: &Path, iteration: usize) {
        let Some(running) = &self.running else { return };
        if let Ok(bytes) = splat4d_workflow::files::read(&playable::of_run(run)) {
            running.set_scene(bytes.into(), &json!({ "iteration": iteration }));
        }
    }
}
