//! [`Deadline`]: the time left of `--minutes` for the work after training, and whether the work was stopped.

use splat4d::{Error, ErrorKind, Result};
use splat4d_train::run::Stopwatch;
use std::sync::atomic::{AtomicBool, Ordering};

/// An error where `stop` was raised.
pub(crate) fn unless_stopped(stop: &AtomicBool) -> Result<()> {
    if stop.load(Ordering::SeqCst) {
        return Err(Error::new(ErrorKind::Interrupted, "stopped").remedy("Run the same command again."));
    }
    Ok(())
}

/// When a command is to be done.
#[derive(Clone, Debug)]
pub struct Deadline {
    clock: Stopwatch,
    /// Seconds of the clock.
    end: f64,
}

impl Default for Deadline {
    /// None.
    fn default() -> Self {
        Self { clock: Stopwatch::start(), end: f64::INFINITY }
    }
}

impl Deadline {
    /// At this many minutes of a clock; none: never.
    pub fn of(clock: Stopwatch, minutes: Option<f64>) -> Self {
        Self { clock, end: minutes.map_or(f64::INFINITY, |m| 60.0 * m) }
    }

    /// The end of what may take this share of what is left.
    pub fn part(&self, share: f64) -> Self {
        Self { clock: self.clock.clone(), end: self.now() + share * self.left().max(0.0) }
    }

    /// Whether there is one.
    pub fn is_set(&self) -> bool {
        self.end.is_finite()
    }

    /// Elapsed seconds.
    pub fn now(&self) -> f64 {
        self.clock.seconds()
    }

    /// Seconds that are left; infinite where there is no end, negative where it is over.
    pub fn left(&self) -> f64 {
        self.end - self.now()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_ends_within_the_remaining_time() {
        let clock = Stopwatch::of(|| 30.0);
        assert_eq!(Deadline::of(clock.clone(), Some(1.0)).part(0.2).left(), 6.0);
        assert_eq!(Deadline::of(clock.clone(), Some(0.25)).part(0.2).left(), 0.0, "it is over");
        assert!(!Deadline::of(clock, None).part(0.2).is_set());
    }
}
