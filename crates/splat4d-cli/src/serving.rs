//! The player's server as verbs use it: options, its messages, the browser, and a run that is being watched.

use crate::console::Console;
use serde_json::{Value, json};
use splat4d::{Error, Result};
use splat4d_serve::{Config, EditResponse, Editing, News, Running, Server};
use splat4d_train::capture::Capture;
use splat4d_train::event::Event as Training;
use splat4d_train::run::Stopwatch;
use splat4d_workflow::editor::token;
use splat4d_workflow::events::{Event, Listener};
use splat4d_workflow::run_folder::Run;
use splat4d_workflow::{capture_page, playable};
use std::cell::{Cell, OnceCell};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// How often a waiting program checks for Ctrl-C.
const POLL: Duration = Duration::from_millis(50);
/// A new image of the scene in training about so often: shorter than a user waits before reloading, longer than a page
/// needs to update.
const SNAPSHOT_INTERVAL: Duration = Duration::from_secs(3);
/// Time for the last news to reach pages before the server ends.
const FAREWELL: Duration = Duration::from_millis(250);

/// Address of the server.
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
    /// Whether any of it was printed.
    pub(crate) fn is_printed(&self) -> bool {
        self.port.is_some() || self.host.is_some() || self.no_open || self.player_folder.is_some()
    }
}

/// Starts a server, prints its address, and opens the browser; that page may edit, or control the run, by the token.
pub(crate) fn start_for(config: Config, place: &Place, token: Option<&str>, console: &Console) -> Result<Running> {
    let host = place.host.clone().unwrap_or(config.host);
    let right = match (&config.editing, &config.assist) {
        (Some(_), _) => "edit",
        (_, Some(_)) => "assist",
        _ => "control",
    };
    let what = if config.assist.is_some() { "page" } else { "player" };
    let running =
        Server::start(Config { host, port: place.port, player_folder: place.player_folder.clone(), ..config })?;
    // Behind `#` a browser sends nothing to other sites, and linked pages do not see it.
    let url = token.map_or(running.url().to_owned(), |token| format!("{}#{right}={token}", running.url()));
    console.print_line(&format!("the {what} is at {url}"));
    console.emit(&json!({"type": "serving", "url": url}));
    if !running.address().ip().is_loopback() {
        console.warn("every computer that reaches this machine over the network can view the scene.");
    }
    if !place.no_open && !open_browser(&url) {
        let port = running.address().port();
        console.print_line(&format!(
            "this machine has no screen. On your own computer: ssh -L {port}:localhost:{port} {}, then open \
             http://localhost:{port}/{}",
            machine(),
            token.map_or(String::new(), |token| format!("#{right}={token}"))
        ));
    }
    Ok(running)
}

/// Waits for Ctrl-C.
pub(crate) fn wait(stop: &AtomicBool) {
    while !stop.load(Ordering::SeqCst) {
        std::thread::sleep(POLL);
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
    let is_set = |name: &str| std::env::var_os(name).is_some_and(|v| !v.is_empty());
    let mut command = if cfg!(target_os = "macos") {
        Command::new("open")
    } else if cfg!(windows) {
        Command::new("explorer")
    } else if is_set("DISPLAY") || is_set("WAYLAND_DISPLAY") {
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

/// Pause and stop of a run, as its page requests them.
///
/// A pause blocks the trainer between two steps, so that the result stays the same to the bit.
#[derive(Debug)]
pub(crate) struct Control {
    stop: Arc<AtomicBool>,
    paused: AtomicBool,
    began: Instant,
    /// Total time of pauses.
    waited: Mutex<Duration>,
}

impl Control {
    /// `stop` ends the run as Ctrl-C does.
    pub(crate) fn new(stop: Arc<AtomicBool>) -> Arc<Self> {
        let waited = Mutex::new(Duration::ZERO);
        Arc::new(Self { stop, paused: AtomicBool::new(false), began: Instant::now(), waited })
    }

    /// Seconds since the command began, without pauses: a paused run keeps its minutes.
    pub(crate) fn clock(self: &Arc<Self>) -> Stopwatch {
        let control = self.clone();
        Stopwatch::of(move || control.began.elapsed().saturating_sub(control.waited()).as_secs_f64())
    }

    fn waited(&self) -> Duration {
        *self.waited.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_paused(&self) -> bool {
        self.paused.load(Ordering::SeqCst) && !self.stop.load(Ordering::SeqCst)
    }

    /// Waits until the run is continued or stopped.
    fn wait(&self) {
        let began = Instant::now();
        while self.is_paused() {
            std::thread::sleep(POLL);
        }
        *self.waited.lock().unwrap_or_else(PoisonError::into_inner) += began.elapsed();
    }

    /// Does what a page requests.
    fn answer(&self, asked: &Value) -> Result<EditResponse> {
        let state = match asked["do"].as_str() {
            Some("pause") => "pausing",
            Some("continue") => "training",
            Some("stop") => {
                self.stop.store(true, Ordering::SeqCst);
                "stopping"
            }
            _ => return Err(Error::input("unknown request of the page").remedy("Reload the page")),
        };
        self.paused.store(state == "pausing", Ordering::SeqCst);
        Ok(EditResponse { result: json!({ "state": state }), scene: None })
    }
}

/// A listener that passes events to the console and, with `--view`, to a page. What fails with the page never costs the
/// run.
pub(crate) struct Watched<'a> {
    console: &'a Console,
    place: Option<&'a Place>,
    control: Arc<Control>,
    /// The page's server, once training has begun.
    running: OnceCell<Running>,
    /// The held-out score of the newest snapshot, dB.
    held_out: Cell<Option<f64>>,
}

impl Listener for Watched<'_> {
    fn on_event(&self, event: &Event<'_>) {
        match event {
            Event::Begun { title, run, capture } => self.begin(title, run, *capture),
            Event::Warning(message) => self.publish(|| News::Note(json!({ "message": message }))),
            Event::Training(event) => self.on_training(event),
            _ => {}
        }
        self.console.on_event(event);
    }

    fn snapshots(&self) -> Option<Duration> {
        self.is_on().then_some(SNAPSHOT_INTERVAL)
    }
}

impl<'a> Watched<'a> {
    /// `place`: where the page is served; none: nowhere.
    pub(crate) fn new(place: Option<&'a Place>, control: &Arc<Control>, console: &'a Console) -> Self {
        Self { console, place, control: control.clone(), running: OnceCell::new(), held_out: Cell::new(None) }
    }

    /// Starts to serve a run that is about to train; a server that cannot be started is a warning. The capture's
    /// cameras and images are shown next to the render, where it can be opened.
    fn begin(&self, title: &str, run: &Path, capture: Option<&Arc<Capture>>) {
        let Some(place) = self.place else { return };
        let of_run = || Some(Arc::new(Run::open(run).ok()?.open_capture().ok()?.0));
        match self.serve(title, capture.cloned().or_else(of_run), place) {
            Ok(running) => drop(self.running.set(running)),
            Err(error) => self.console.warn(&format!("training continues without the page: {error}")),
        }
    }

    fn serve(&self, title: &str, capture: Option<Arc<Capture>>, place: &Place) -> Result<Running> {
        let token = token()?;
        let (asked, mut about) = (self.control.clone(), json!({ "title": title }));
        let photos = capture.map(|capture| {
            let (cameras, photos) = capture_page::cameras(capture);
            about["cameras"] = cameras;
            photos
        });
        let control = Some(Editing::new(token.clone(), move |value| asked.answer(&value)));
        let config = Config { live: true, background: true, about, control, photos, ..Config::default() };
        start_for(config, place, Some(&token), self.console)
    }

    /// Whether the run is served.
    pub(crate) fn is_on(&self) -> bool {
        self.running.get().is_some()
    }

    fn publish(&self, news: impl FnOnce() -> News) {
        if let Some(running) = self.running.get() {
            running.publish(&news());
        }
    }

    /// Passes an event of training to the page, and waits after a step while the page has paused the run.
    fn on_training(&self, event: &Training) {
        let Some(running) = self.running.get() else { return };
        let state = |state: &str| running.publish(&News::Control(json!({ "state": state })));
        match event {
            Training::Snapshot { iteration, bytes, held_out } => {
                self.held_out.set(*held_out);
                running.set_scene(bytes.clone(), &json!({ "iteration": iteration, "held_out": held_out }));
            }
            Training::Progress { .. } => {
                let mut step = serde_json::to_value(event).expect("events are plain data");
                step["held_out"] = json!(self.held_out.get());
                running.publish(&News::Step(step));
                if self.control.is_paused() {
                    state("paused");
                    self.control.wait();
                    state("training");
                }
            }
            Training::RolledBack { iteration, to, what } => {
                let message = format!("step {iteration} was not finite ({what}); rolled back to step {to}");
                running.publish(&News::Note(json!({ "message": message })));
            }
            Training::Finished { iteration, seconds, gaussians, .. } => running.publish(&News::Done(json!({
                "iteration": iteration, "seconds": seconds, "gaussians": gaussians,
            }))),
            _ => {}
        }
    }

    /// The run was stopped and saved; `resume` continues it. The server may end after this.
    pub(crate) fn stopped(&self, iteration: usize, resume: &str) {
        let Some(running) = self.running.get() else { return };
        running.publish(&News::Control(json!({ "state": "stopped", "iteration": iteration, "resume": resume })));
        std::thread::sleep(FAREWELL);
    }

    /// Shows a finished run's playback file, where there is one.
    pub(crate) fn show(&self, run: &Path, iteration: usize) {
        let Some(running) = self.running.get() else { return };
        if let Ok(bytes) = splat4d_workflow::files::read(&playable::of_run(run)) {
            running.set_scene(bytes.into(), &json!({ "iteration": iteration }));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_paused_run_stops_its_clock_and_can_continue_or_stop() {
        let stop = Arc::new(AtomicBool::new(false));
        let control = Control::new(stop.clone());
        let ask = |what: &str| control.answer(&json!({ "do": what })).map(|a| a.result["state"].clone());
        assert!(ask("explode").is_err() && !control.is_paused());
        for way in ["continue", "stop"] {
            assert_eq!(ask("pause").unwrap(), "pausing");
            let (clock, waiting) = (control.clock(), control.clone());
            let trainer = std::thread::spawn(move || {
                let (before, began) = (clock.seconds(), Instant::now());
                waiting.wait();
                (clock.seconds() - before, began.elapsed().as_secs_f64())
            });
            std::thread::sleep(3 * POLL);
            assert!(!trainer.is_finished(), "it waits");
            ask(way).unwrap();
            let (counted, passed) = trainer.join().unwrap();
            assert!(counted < 0.5 * passed, "{counted} s of {passed} s are counted");
        }
        assert!(stop.load(Ordering::SeqCst), "stop ends the run as Ctrl-C does");
    }
}
