//! Ctrl-C: the first asks to stop (training saves a checkpoint), the second ends the program at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Exit code that shells expect of a program ended by Ctrl-C: 128 + SIGINT.
const ENDED_BY_INTERRUPT: i32 = 130;

/// A flag that the first Ctrl-C (or SIGTERM) raises. `first` is then said on stderr.
pub fn flag(first: &'static str) -> Arc<AtomicBool> {
    let flag = Arc::new(AtomicBool::new(false));
    let raised = flag.clone();
    // Where no handler can be set, Ctrl-C simply ends the program; checkpoints on disk stay valid.
    let _ = ctrlc::set_handler(move || {
        if raised.swap(true, Ordering::SeqCst) {
            std::process::exit(ENDED_BY_INTERRUPT);
        }
        eprintln!("\n{first} (Ctrl-C again ends at once)");
    });
    flag
}
