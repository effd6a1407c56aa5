//! What workflows report while they work, and who listens.

use serde_json::Value;
use std::path::Path;

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
    /// A warning, a sentence.
    Warning(&'a str),
    /// A file was written.
    Written(&'a Path),
}

/// Receives events. Any `Fn(&Event)` is one.
pub trait Listener {
    /// Takes an event.
    fn on_event(&self, event: &Event<'_>);
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

    pub(crate) fn say(&self, text: &str) {
        self.on_event(&Event::Result(text));
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;

    #[test]
    fn closures_listen() {
        let seen = RefCell::new(Vec::new());
        let listen = |event: &Event<'_>| seen.borrow_mut().push(format!("{event:?}"));
        let listener: &dyn Listener = &listen;
        listener.phase("baking", 1, 2);
        listener.warn("too dark");
        (&ignore as &dyn Listener).say("nobody hears it");
        assert_eq!(*seen.borrow(), ["Phase { name: \"baking\", done: 1, total: 2 }", "Warning(\"too dark\")"]);
    }
}
