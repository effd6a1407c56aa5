//! Ctrl-C: the first requests a stop (training saves a checkpoint), the second ends the program at once.
//!
//! Work that does not poll for the stop (`ends`) is ended after a short wait. This is safe: all files are written under
//! temporary names, and locks of dead processes are taken over, so the same command continues.

use std::borrow::Cow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Exit code that shells expect of a program ended by Ctrl-C: 128 + SIGINT.
const ENDED_BY_INTERRUPT: i32 = 130;
/// Exit code of interrupted work (docs/exit-codes.md).
const INTERRUPTED: i32 = 1;
/// Time for work that polls; users accept two seconds.
const PATIENCE: Duration = Duration::from_millis(1200);

/// Current effect of Ctrl-C.
struct State {
    raised: bool,
    /// Message on the first one.
    first: Cow<'static, str>,
    /// Where the program ends soon: the message then.
    last: Option<String>,
    /// Whether another program has called, which must not be ended.
    embedded: bool,
}

static STATE: Mutex<State> =
    Mutex::new(State { raised: false, first: Cow::Borrowed("stopping"), last: None, embedded: false });

fn state() -> MutexGuard<'static, State> {
    STATE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Effects of Ctrl-C.
#[derive(Debug, PartialEq)]
enum Reaction {
    /// The program ends now.
    Exit,
    /// The work stops on request.
    Stops,
    /// The work may stop on request; otherwise the program soon ends with this message.
    Ends(String),
}

impl State {
    fn signalled(&mut self) -> Reaction {
        if std::mem::replace(&mut self.raised, true) {
            return Reaction::Exit;
        }
        match &self.last {
            Some(last) if !self.embedded => Reaction::Ends(last.clone()),
            _ => Reaction::Stops,
        }
    }
}

/// A flag that the first Ctrl-C (or SIGTERM) raises. `first` is then printed on stderr.
pub fn flag(first: &'static str) -> Arc<AtomicBool> {
    let flag = Arc::new(AtomicBool::new(false));
    let raised = flag.clone();
    stop_polled(first);
    // Where no handler can be set, Ctrl-C simply ends the program; checkpoints on disk stay valid.
    let _ = ctrlc::set_handler(move || {
        let reaction = state().signalled();
        raised.store(true, Ordering::SeqCst);
        match reaction {
            Reaction::Exit => std::process::exit(ENDED_BY_INTERRUPT),
            Reaction::Stops => {}
            Reaction::Ends(last) => drop(std::thread::spawn(move || {
                std::thread::sleep(PATIENCE);
                end(&last);
            })),
        }
        eprintln!("\n{} (Ctrl-C again ends at once)", state().first);
    });
    flag
}

/// From now on the work reads the flag and does what `first` states.
pub(crate) fn stop_polled(first: impl Into<Cow<'static, str>>) {
    let mut state = state();
    (state.first, state.last) = (first.into(), None);
}

/// From now on a Ctrl-C ends the program after a moment, also where the work does not read the flag; `last` states what
/// is kept and how to continue. An earlier Ctrl-C without effect ends it now.
pub(crate) fn stop_not_polled(last: impl Into<String>) {
    let last = last.into();
    let mut state = state();
    if state.raised && !state.embedded {
        end(&last);
    }
    (state.first, state.last) = ("stopping".into(), Some(last));
}

/// Another program has called: it must not be ended.
pub(crate) fn embedded() {
    state().embedded = true;
}

fn end(last: &str) -> ! {
    eprintln!("\nstopped: {last}");
    std::process::exit(INTERRUPTED);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interrupt_ends_work_that_never_polls_it_and_waits_for_other_work() {
        let state = |last: Option<&str>, embedded| State {
            raised: false,
            first: "stopping".into(),
            last: last.map(str::to_owned),
            embedded,
        };
        let mut asking = state(None, false);
        assert_eq!([asking.signalled(), asking.signalled()], [Reaction::Stops, Reaction::Exit]);
        let mut ending = state(Some("all is kept"), false);
        assert_eq!([ending.signalled(), ending.signalled()], [Reaction::Ends("all is kept".into()), Reaction::Exit]);
        assert_eq!(state(Some("all is kept"), true).signalled(), Reaction::Stops, "another program is not ended");
    }
}
