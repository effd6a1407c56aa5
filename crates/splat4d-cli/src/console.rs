//! Output during work: a progress bar on a terminal, plain lines elsewhere, JSON lines for machines. Results go to
//! stdout; progress, warnings and errors go to stderr (with `--json`, all of them are lines on stdout).

use crate::bar::Bar;
use crate::interrupt;
use serde_json::{Value, json};
use splat4d::text;
use splat4d_train::event::Event;
use splat4d_train::output::rfc3339;
use splat4d_train::path_text::in_command;
use splat4d_workflow::events::{Listener, flags, linked, rolled_back};
use splat4d_workflow::files::{grouped, human_bytes, human_seconds};
use std::borrow::Cow;
use std::cell::RefCell;
use std::io::{IsTerminal, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

/// Verbosity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Loudness {
    /// Warnings and errors only.
    Quiet,
    /// Progress and results.
    Normal,
    /// Details too.
    Verbose,
}

/// Seconds between progress lines where stderr is no terminal.
const PLAIN_INTERVAL: Duration = Duration::from_secs(10);
/// Time between two objects of one phase, with `--json`.
const JSON_INTERVAL: Duration = Duration::from_secs(1);
/// Columns of a report's headings.
const HEADING: usize = 16;
/// Renditions of ECMA-48.
const BOLD: u8 = 1;
const RED: u8 = 31;
const GREEN: u8 = 32;
const YELLOW: u8 = 33;
/// A shorter phase shows no time left.
const LEAST_PACE: Duration = Duration::from_secs(3);

/// The one place that prints.
#[derive(Debug)]
pub struct Console {
    loudness: Loudness,
    json: bool,
    terminal: bool,
    state: RefCell<State>,
}

/// When a phase began, and how much was done then.
#[derive(Debug)]
struct Pace {
    name: String,
    first: usize,
    began: Instant,
}

#[derive(Debug, Default)]
struct State {
    pace: Option<Pace>,
    bar: Option<Bar>,
    phase: String,
    last_line: Option<Instant>,
    /// The first iteration after a pause gets a plain line of its own.
    said_progress: bool,
    /// Objects that `--json` would print, for a program that needs them; none: they are printed.
    objects: Option<Vec<Value>>,
}

impl Listener for Console {
    fn on_event(&self, event: &splat4d_workflow::events::Event<'_>) {
        use splat4d_workflow::events::Event;
        match *event {
            Event::Phase { name, done, total } => self.phase(name, done, total),
            Event::PhaseEnded => self.clear(),
            Event::Result(text) => self.print_line(text),
            Event::Record(value) => self.emit(value),
            Event::Detail(text) => self.detail(text),
            Event::Warning(text) => self.warn(text),
            Event::Written(path) => self.written(path),
            Event::Training(event) => self.event(event),
            Event::StopPolled(reaction) => interrupt::stop_polled(reaction.to_owned()),
            Event::StopNotPolled(kept) => interrupt::stop_not_polled(kept),
            _ => {}
        }
    }
}

impl Console {
    pub fn new(loudness: Loudness, json: bool) -> Self {
        let terminal = std::io::stderr().is_terminal() && std::env::var_os("TERM").is_none_or(|t| t != "dumb");
        Self { loudness, json, terminal, state: RefCell::default() }
    }

    /// A console that prints nothing but warnings and keeps the objects of `--json`.
    pub(crate) fn keeping_objects() -> Self {
        let console = Self::new(Loudness::Quiet, true);
        console.state.borrow_mut().objects = Some(Vec::new());
        console
    }

    /// The objects that were kept.
    pub(crate) fn into_objects(self) -> Vec<Value> {
        self.state.into_inner().objects.unwrap_or_default()
    }

    /// Whether machines are listening.
    pub fn json(&self) -> bool {
        self.json
    }

    /// Whether a person at a terminal is listening.
    pub(crate) fn terminal(&self) -> bool {
        self.terminal && !self.json
    }

    /// A result, on stdout; not with `--json`, not when quiet.
    pub fn print_line(&self, text: &str) {
        if !self.json && self.loudness > Loudness::Quiet {
            self.above_bar(|| print(&stamped(&flags(text))));
        }
    }

    /// A detail, on stderr, with `-v`.
    pub(crate) fn detail(&self, text: &str) {
        if !self.json && self.loudness == Loudness::Verbose {
            self.above_bar(|| eprint_line(&flags(text)));
        }
    }

    /// Prints the verb's result on stdout at every level of output.
    pub fn result(&self, text: &str) {
        self.above_bar(|| print(text));
    }

    /// The same for a health report: its headings, its lines of problems (`! …`) and its last line, the verdict, have
    /// colours on a terminal.
    pub(crate) fn report(&self, text: &str, healthy: bool) {
        let text = text::shown(text);
        let colours = has_colours(&std::io::stdout());
        self.above_bar(|| print_shown(&if colours { painted(&text, healthy) } else { text.into_owned() }));
    }

    /// One JSON line; only with `--json`.
    pub fn emit(&self, value: &Value) {
        if let Some(objects) = &mut self.state.borrow_mut().objects {
            objects.push(value.clone());
        } else if self.json {
            self.emit_now(value.clone());
        }
    }

    /// One JSON line with the time at which it was printed.
    fn emit_now(&self, mut value: Value) {
        value["time"] = json!(rfc3339(SystemTime::now()));
        print(&one_json_line(&value));
    }

    /// A file was written.
    pub fn written(&self, path: &Path) {
        self.print_line(&format!("wrote {}", path.display()));
        self.emit(&json!({"type": "written", "path": path.to_string_lossy()}));
    }

    /// The next command to type, as the last line of a verb.
    pub(crate) fn next(&self, verb: &str, path: &Path) {
        self.print_line(&format!("next: splat4d {verb} {}", in_command(path)));
    }

    /// A warning: always printed.
    pub(crate) fn warn(&self, message: &str) {
        let message = &flags(&linked(message));
        if self.json {
            self.emit(&json!({"type": "warning", "message": message}));
        } else {
            self.above_bar(|| eprint_labelled("warning:", YELLOW, &text::in_line(message)));
        }
    }

    /// For people only, on stderr even with `--json`: where stdout is one JSON document.
    pub fn aside(&self, text: &str) {
        self.above_bar(|| eprint_line(text));
    }

    /// The same, but of progress: not when quiet, not with `--json`.
    pub fn note(&self, text: &str) {
        if !self.json && self.loudness > Loudness::Quiet {
            self.aside(text);
        }
    }

    /// The error that ends the program: one paragraph.
    pub(crate) fn error(&self, message: &str, code: u8) {
        self.clear();
        let paragraph = flags(&linked(&message.split_whitespace().collect::<Vec<_>>().join(" ")));
        let end = if paragraph.ends_with(['.', '?', '!']) { "" } else { "." };
        eprint_labelled("error:", RED, &format!("{paragraph}{end}"));
        self.emit(&json!({"type": "error", "message": paragraph, "code": code}));
    }

    /// Shows an event of the trainer.
    pub fn event(&self, event: &Event) {
        if let Event::Warning { message } = event {
            return self.warn(message);
        }
        if let (Event::Phase { name, done, total }, true) = (event, self.json) {
            return self.phase(name, *done, *total);
        }
        if self.json {
            return self.emit(&serde_json::to_value(event).expect("events are plain data"));
        }
        match event {
            Event::Phase { name, done, total } => self.phase(name, *done, *total),
            Event::Started { run, iteration, iterations, gaussians, memory_estimate } => {
                self.clear();
                let from =
                    if *iteration > 0 { format!("from step {} on, ", grouped(*iteration)) } else { String::new() };
                self.print_line(&format!(
                    "training {from}{} steps, {} Gaussians at the start, about {} of memory, into {}",
                    grouped(*iterations),
                    grouped(*gaussians),
                    human_bytes(*memory_estimate),
                    run.display()
                ));
            }
            Event::Predicted { iterations, gaussians, size: [width, height], seconds, memory_estimate } => {
                self.clear();
                self.print_line(&format!(
                    "{} steps on images of {width}x{height}, at most {} Gaussians: about {} minutes in total and {} \
                     of memory",
                    grouped(*iterations),
                    grouped(*gaussians),
                    human_seconds(*seconds),
                    human_bytes(*memory_estimate)
                ));
            }
            Event::Replanned { iteration, iterations, seconds, minutes } => self.detail(&format!(
                "step {}: at this speed training would take {} instead of {}; planned steps are now {}",
                grouped(*iteration),
                human_seconds(*seconds),
                human_seconds(60.0 * minutes),
                grouped(*iterations)
            )),
            Event::Progress { iteration, iterations, stage, loss, psnr, gaussians, seconds, seconds_left } => {
                let words = format!(
                    "PSNR {psnr:.2} dB  {} Gaussians  {} left",
                    grouped(*gaussians),
                    human_seconds(*seconds_left)
                );
                self.advance(stage, *iteration, *iterations, &words, || {
                    format!(
                        "step {}/{}  {words}  loss {loss:.4}  {} spent",
                        grouped(*iteration),
                        grouped(*iterations),
                        human_seconds(*seconds)
                    )
                });
            }
            Event::Device { why, .. } => {
                self.clear();
                self.print_line(why);
            }
            Event::Chosen { motion, why } => {
                self.clear();
                self.print_line(&format!("motion model: {motion}, because {why}"));
            }
            Event::Counted { gaussians, why } => {
                self.clear();
                self.print_line(&format!("at most {} Gaussians: {why}", grouped(*gaussians)));
            }
            Event::Shell { distance, why } => {
                self.clear();
                let what = distance.map_or("no far shell".into(), |d| format!("far shell at {d:.1} scene units"));
                self.print_line(&format!("{what}: {why}"));
            }
            Event::Geometry { measured, error, worst, worst_error } => {
                self.clear();
                let percent = |share: f64| format!("{:.1} %", 100.0 * share);
                let by = match (error, worst, worst_error) {
                    (Some(error), Some(worst), Some(most)) => format!(
                        "; median error of depth {}, the largest for camera {worst} ({})",
                        percent(*error),
                        percent(*most)
                    ),
                    _ => "; too few to compare".into(),
                };
                self.print_line(&format!("measured geometry: in {} of the pixels{by}", percent(*measured)));
            }
            Event::Checkpoint { iteration, path } => {
                self.detail(&format!("checkpoint of step {} in {}", grouped(*iteration), path.display()));
            }
            Event::RolledBack { .. } => self.warn(&rolled_back(event).unwrap_or_default()),
            Event::Finished { iteration, seconds, gaussians, peak_memory, advice } => {
                self.clear();
                let memory = match peak_memory {
                    0 => String::new(),
                    m => format!(", {} of memory at most", human_bytes(*m)),
                };
                self.print_line(&format!(
                    "trained {} steps in {}: {} Gaussians{memory}",
                    grouped(*iteration),
                    human_seconds(*seconds),
                    grouped(*gaussians)
                ));
                advice.iter().for_each(|advice| self.print_line(advice));
            }
            _ => {}
        }
    }

    /// Progress of a preparation or of rendering.
    pub fn phase(&self, name: &str, done: usize, total: usize) {
        if self.json {
            if self.is_due(name, done, total) {
                self.emit(&json!({"type": "phase", "name": name, "done": done, "total": total}));
            }
            return;
        }
        let left = self.left(name, done, total).map(|s| format!("about {} left", human_seconds(s)));
        let words = left.unwrap_or_default();
        self.advance(name, done, total, &words, || match total {
            0 => format!("{name} ..."),
            _ => {
                let comma = if words.is_empty() { "" } else { ", " };
                format!("{name} {}/{}{comma}{words}", grouped(done), grouped(total))
            }
        });
    }

    /// Whether an object is printed: at the start and the end of a phase, and once per second between them.
    fn is_due(&self, name: &str, done: usize, total: usize) -> bool {
        let mut state = self.state.borrow_mut();
        let ends = total > 0 && done >= total;
        let due = state.phase != name || ends || state.last_line.is_none_or(|t| t.elapsed() >= JSON_INTERVAL);
        if due {
            state.phase = name.to_owned();
            state.last_line = Some(Instant::now());
        }
        due
    }

    /// Seconds that are left of a phase, by its average pace; none: too early to estimate.
    fn left(&self, name: &str, done: usize, total: usize) -> Option<f64> {
        let mut state = self.state.borrow_mut();
        let fresh = state.pace.as_ref().is_none_or(|p| p.name != name || done < p.first);
        if fresh {
            state.pace = Some(Pace { name: name.to_owned(), first: done, began: Instant::now() });
        }
        let pace = state.pace.as_ref().expect("it was just set");
        time_left(pace.began.elapsed(), done.saturating_sub(pace.first), total.saturating_sub(done))
    }

    fn advance(&self, name: &str, done: usize, total: usize, words: &str, line: impl FnOnce() -> String) {
        if self.loudness == Loudness::Quiet {
            return;
        }
        let mut state = self.state.borrow_mut();
        let fresh = state.phase != name;
        if fresh {
            if let Some(mut bar) = state.bar.take() {
                bar.erase();
            }
            state.phase = name.to_owned();
            state.said_progress = false;
        }
        if self.terminal {
            let bar = state.bar.get_or_insert_default();
            bar.show(&text::in_line(name), done, total, &text::in_line(words));
            return;
        }
        let due = state.last_line.is_none_or(|t| t.elapsed() >= PLAIN_INTERVAL);
        let ends = total > 0 && done >= total;
        // A phase that is over at once needs no second line.
        if fresh || due || (ends && state.said_progress) {
            state.last_line = Some(Instant::now());
            state.said_progress = !ends && !fresh;
            eprint_line(&line());
        }
    }

    /// Ends the bar.
    pub fn clear(&self) {
        let mut state = self.state.borrow_mut();
        if let Some(mut bar) = state.bar.take() {
            bar.erase();
        }
        state.phase.clear();
    }

    fn above_bar(&self, f: impl FnOnce()) {
        // Taken out while `f` runs: it may print by this console.
        let bar = self.state.borrow_mut().bar.take();
        match bar {
            Some(mut bar) => {
                bar.suspend(f);
                self.state.borrow_mut().bar = Some(bar);
            }
            None => f(),
        }
    }
}

fn time_left(elapsed: Duration, done: usize, left: usize) -> Option<f64> {
    (elapsed >= LEAST_PACE && done > 0 && left > 0).then(|| elapsed.as_secs_f64() * left as f64 / done as f64)
}

/// JSON in one line, in which no character acts on a terminal: outside strings JSON has none, and inside they are
/// escaped.
fn one_json_line(value: &Value) -> String {
    let line = value.to_string();
    if !line.contains(text::acts) {
        return line;
    }
    line.chars().map(|c| if text::acts(c) { format!("\\u{:04x}", u32::from(c)) } else { c.into() }).collect()
}

/// Whether a stream shows colours: a terminal that is not dumb, and the user does not refuse them (https://no-color.org).
fn has_colours(stream: &impl IsTerminal) -> bool {
    stream.is_terminal()
        && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty())
        && std::env::var_os("TERM").is_none_or(|t| t != "dumb")
}

/// Text in a rendition of ECMA-48.
fn paint(text: &str, rendition: u8) -> String {
    format!("\x1b[{rendition}m{text}\x1b[0m")
}

/// A report in colours: headings bold, lines of problems yellow, the verdict green or red.
fn painted(report: &str, healthy: bool) -> String {
    let verdict = paint(report.lines().last().unwrap_or_default(), if healthy { GREEN } else { RED });
    let above = report.lines().count().saturating_sub(1);
    let line = |line: &str| match heading(line) {
        _ if line.trim_start().starts_with("! ") => paint(line, YELLOW),
        Some((name, rest)) => paint(name, BOLD) + rest,
        None => line.to_owned(),
    };
    let body = report.lines().take(above).map(|text| line(text) + "\n");
    body.collect::<String>() + &verdict
}

/// The heading of a line of a report, which fills a column, and the rest.
fn heading(line: &str) -> Option<(&str, &str)> {
    let (column, rest) = line.split_at_checked(HEADING)?;
    let name = column.trim_end();
    (rest.starts_with(' ') && !name.is_empty() && !line.starts_with(' ')).then(|| line.split_at(name.len()))
}

/// Prints a line on stdout, safe for a terminal.
fn print(line: &str) {
    print_shown(&text::shown(line));
}

/// Prints sanitised text on stdout. A closed reader (`| head`) ends the program without an error; a full disk is an
/// error.
fn print_shown(line: &str) {
    let mut out = std::io::stdout().lock();
    if let Err(error) = writeln!(out, "{line}").and_then(|()| out.flush()) {
        if error.kind() == std::io::ErrorKind::BrokenPipe {
            std::process::exit(0);
        }
        eprint_line(&format!(
            "error: standard output cannot be written ({error}). {}",
            splat4d_workflow::files::WRITE_REMEDY
        ));
        std::process::exit(crate::FAILED.into());
    }
}

/// Prints a line on stderr, safe for a terminal; nothing happens if that is closed.
pub(crate) fn eprint_line(line: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{}", text::shown(&stamped(line)));
}

/// The same with a label, which has a colour on a terminal.
fn eprint_labelled(label: &str, colour: u8, text: &str) {
    let line = text::shown(text);
    let label = if has_colours(&std::io::stderr()) { paint(label, colour) } else { label.to_owned() };
    let _ = writeln!(std::io::stderr().lock(), "{}", stamped(&format!("{label} {line}")));
}

/// Whether lines begin with the time.
static LOG_TIME: AtomicBool = AtomicBool::new(false);

/// From now on lines of progress, warnings and errors begin with the time.
pub(crate) fn log_time() {
    LOG_TIME.store(true, Ordering::Relaxed);
}

/// A line with the time before it, where that is needed.
fn stamped(line: &str) -> Cow<'_, str> {
    match LOG_TIME.load(Ordering::Relaxed) {
        true => format!("{} {line}", rfc3339(SystemTime::now())).into(),
        false => line.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_output_has_the_ends_of_a_phase_and_few_events_between() {
        let console = Console::keeping_objects();
        (0..=100).for_each(|done| console.phase("baking", done, 100));
        console.phase("writing", 0, 0);
        let objects = console.into_objects();
        assert!((3..=5).contains(&objects.len()), "{objects:?}");
        assert_eq!(objects[0], json!({"type": "phase", "name": "baking", "done": 0, "total": 100}));
        assert!(objects.iter().any(|o| o["done"] == 100) && objects.last().unwrap()["name"] == "writing");
    }

    #[test]
    fn phases_print_the_time_left_once_the_pace_is_known() {
        assert_eq!(time_left(Duration::from_secs(10), 2, 6), Some(30.0));
        for (seconds, done, left) in [(1, 2, 6), (10, 0, 6), (10, 6, 0)] {
            assert_eq!(time_left(Duration::from_secs(seconds), done, left), None);
        }
    }

    #[test]
    fn headings_problems_and_verdict_are_coloured() {
        let text = "cameras          3\nheld-out scores  PSNR\n  ! one is dark\n                 ###\n! no points\ndoes not look healthy";
        let lines = [
            "\x1b[1mcameras\x1b[0m          3",
            "\x1b[1mheld-out scores\x1b[0m  PSNR",
            "\x1b[33m  ! one is dark\x1b[0m",
            "                 ###",
            "\x1b[33m! no points\x1b[0m",
            "\x1b[31mdoes not look healthy\x1b[0m",
        ];
        assert_eq!(painted(text, false), lines.join("\n"));
        assert_eq!(painted("looks healthy", true), "\x1b[32mlooks healthy\x1b[0m");
    }

    #[test]
    fn json_lines_contain_no_terminal_escapes() {
        let value = json!({"title": "a\u{1b}]0;x\u{7}\u{9b}2J\u{202e}\n"});
        let line = one_json_line(&value);
        assert!(!line.contains(text::acts), "{line}");
        assert_eq!(serde_json::from_str::<Value>(&line).unwrap(), value);
    }
}
