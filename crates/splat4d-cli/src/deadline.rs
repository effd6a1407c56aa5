//! [`Deadline`]: what is left of `--minutes` for what follows training.

use splat4d_train::run::Stopwatch;

/// When a command is to be done.
#[derive(Clone, Debug)]
pub(crate) struct Deadline {
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
    /// At so many minutes of a clock; none: never.
    pub(crate) fn of(clock: Stopwatch, minutes: Option<f64>) -> Self {
        Self { clock, end: minutes.map_or(f64::INFINITY, |m| 60.0 * m) }
    }

    /// Whether there is one.
    pub(crate) fn is_set(&self) -> bool {
        self.end.is_finite()
    }

    /// Seconds of the clock so far.
    pub(crate) fn now(&self) -> f64 {
        self.clock.seconds()
    }

    /// Seconds that are left; infinite where there is no end, negative where it is over.
    pub(crate) fn left(&self) -> f64 {
        self.end - self.now()
    }
}
