//! Events of workflows, and their listeners.

use serde_json::Value;
use splat4d_train::capture::Capture;
use splat4d_train::event::Event as Training;
use std::cell::RefCell;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

/// A report of a workflow.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub enum Event<'a> {
    /// Progress of a phase: parts that are done, of all; 0 of 0: not countable.
    Phase {
        /// Its name.
        name: &'a str,
        /// Parts that are done.
        done: usize,
        /// All parts.
        total: usize,
    },
    /// The phase has ended.
    PhaseEnded,
    /// A result, a sentence for people.
    Result(&'a str),
    /// A result, for machines.
    Record(&'a Value),
    /// A detail, a sentence for people who requested more.
    Detail(&'a str),
    /// A warning, a sentence.
    Warning(&'a str),
    /// A file was written.
    Written(&'a Path),
    /// A training begins or continues in its folder.
    Begun {
        /// The capture's name.
        title: &'a str,
        /// The run.
        run: &'a Path,
        /// The capture; none: that of the run, which is continued.
        capture: Option<&'a Arc<Capture>>,
    },
    /// An event of training or evaluation. Its warnings are sent as [`Warning`](Self::Warning).
    Training(&'a Training),
    /// From here on the workflow polls its stop flag; the sentence states what it does when the flag is raised.
    StopPolled(&'a str),
    /// From here on the workflow does not poll its stop flag. Ending the process loses nothing, because files are
    /// renamed into place; the sentence states what is kept and how to continue.
    StopNotPolled(&'a str),
}

/// Receives events. Any `Fn(&Event)` is one.
pub trait Listener {
    /// Takes an event.
    fn on_event(&self, event: &Event<'_>);

    /// How often it needs the scene during training ([`Training::Snapshot`]); none: never. Asked after
    /// [`Event::Begun`].
    fn snapshots(&self) -> Option<Duration> {
        None
    }
}

impl<F: Fn(&Event<'_>)> Listener for F {
    fn on_event(&self, event: &Event<'_>) {
        self(event);
    }
}

/// A listener that ignores all events.
pub fn ignore(_: &Event<'_>) {}

impl dyn Listener + '_ {
    pub(crate) fn phase(&self, name: &str, done: usize, total: usize) {
        self.on_event(&Event::Phase { name, done, total });
    }

    pub(crate) fn clear(&self) {
        self.on_event(&Event::PhaseEnded);
    }

    pub(crate) fn result(&self, text: &str) {
        self.on_event(&Event::Result(text));
    }

    pub(crate) fn detail(&self, text: &str) {
        self.on_event(&Event::Detail(text));
    }

    pub(crate) fn event(&self, event: &Training) {
        match event {
            Training::Warning { message } => self.warn(message),
            event => self.on_event(&Event::Training(event)),
        }
    }

    pub(crate) fn stop_polled(&self, reaction: &str) {
        self.on_event(&Event::StopPolled(reaction));
    }

    pub(crate) fn stop_not_polled(&self, kept: &str) {
        self.on_event(&Event::StopNotPolled(kept));
    }

    pub(crate) fn emit(&self, value: &Value) {
        self.on_event(&Event::Record(value));
    }

    pub(crate) fn warn(&self, text: &str) {
        self.on_event(&Event::Warning(text));
    }

    pub(crate) fn written(&self, path: &Path) {
        self.on_event(&Event::Written(path));
    }
}

/// A listener that also keeps the warnings, for a report.
pub(crate) struct Recorded<'a> {
    listener: &'a dyn Listener,
    warnings: RefCell<Vec<String>>,
}

impl<'a> Recorded<'a> {
    pub(crate) fn new(listener: &'a dyn Listener) -> Self {
        Self { listener, warnings: RefCell::default() }
    }

    /// The present warnings.
    pub(crate) fn warnings(&self) -> Vec<String> {
        self.warnings.borrow().clone()
    }
}

impl Listener for Recorded<'_> {
    fn on_event(&self, event: &Event<'_>) {
        let text = match event {
            Event::Warning(text) => Some(flags(&linked(text))),
            Event::Training(event) => rolled_back(event),
            _ => None,
        };
        self.warnings.borrow_mut().extend(text);
        self.listener.on_event(event);
    }

    fn snapshots(&self) -> Option<Duration> {
        self.listener.snapshots()
    }
}

/// A sentence on a training that rolled back; none: another event.
pub fn rolled_back(event: &Training) -> Option<String> {
    let Training::RolledBack { iteration, to, what } = event else { return None };
    Some(format!(
        "step {iteration} was not finite ({what}); training rolled back to step {to} and continues with smaller steps"
    ))
}

/// The text with options of a function (`` option `max_mb` ``) as flags of the command (`--max-mb`).
pub fn flags(text: &str) -> String {
    const OPTION: &str = "option `";
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some((before, after)) = rest.split_once(OPTION) {
        let is_name = |name: &str| !name.is_empty() && name.bytes().all(|b| b.is_ascii_lowercase() || b == b'_');
        out += before;
        match after.split_once('`').filter(|(name, _)| is_name(name)) {
            Some(("output", behind)) => (out, rest) = (out + "-o", behind),
            Some((name, behind)) => (out, rest) = (out + "--" + &name.replace('_', "-"), behind),
            None => (out, rest) = (out + OPTION, after),
        }
    }
    out + rest
}

/// The text with pages of the documentation, of which an installed program has no copy, as links.
pub fn linked(text: &str) -> String {
    const FOLDER: &str = "docs/";
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find(FOLDER) {
        let name = at + FOLDER.len();
        let end = rest[name..].find(|c: char| !(c.is_ascii_lowercase() || c == '-')).map_or(rest.len(), |n| name + n);
        // A path that the user gave is at the beginning or behind another folder.
        let ours = rest[..at].ends_with([' ', '(']) && rest[end..].starts_with(".md");
        out += &rest[..at];
        out += if ours { concat!(env!("CARGO_PKG_REPOSITORY"), "/blob/main/") } else { "" };
        out += &rest[at..end];
        rest = &rest[end..];
    }
    out + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_of_the_documentation_are_links() {
        let pages = concat!(env!("CARGO_PKG_REPOSITORY"), "/blob/main/docs/");
        assert!(pages.starts_with("https://"), "{pages}");
        let text = "docs/a.json: is no list (docs/capture-format.md). See docs/edit.md, my/docs/edit.md or docs/";
        let wanted =
            format!("docs/a.json: is no list ({pages}capture-format.md). See {pages}edit.md, my/docs/edit.md or docs/");
        assert_eq!(linked(text), wanted);
    }

    #[test]
    fn options_are_flags_of_the_command() {
        let text = "Add option `size`, or option `output` DIR; option `max_mb` 2 [option `A b` stays, and option `";
        assert_eq!(flags(text), "Add --size, or -o DIR; --max-mb 2 [option `A b` stays, and option `");
    }

    #[test]
    fn warnings_are_kept_and_passed_on() {
        let passed = RefCell::new(0);
        let count = |_: &Event<'_>| *passed.borrow_mut() += 1;
        let recorded = Recorded::new(&count);
        let listener: &dyn Listener = &recorded;
        listener.event(&Training::Warning { message: "one".into() });
        listener.result("no warning");
        assert_eq!((recorded.warnings(), *passed.borrow()), (vec!["one".to_owned()], 2));
    }

    #[test]
    fn closures_listen() {
        let seen = RefCell::new(Vec::new());
        let listen = |event: &Event<'_>| seen.borrow_mut().push(format!("{event:?}"));
        let listener: &dyn Listener = &listen;
        listener.phase("baking", 1, 2);
        listener.warn("too dark");
        (&ignore as &dyn Listener).result("nobody hears it");
        assert_eq!(*seen.borrow(), ["Phase { name: \"baking\", done: 1, total: 2 }", "Warning(\"too dark\")"]);
    }
}
