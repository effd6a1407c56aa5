//! [`Stopwatch`]: the seconds that `--minutes` counts.

use std::fmt;
use std::sync::Arc;
use std::time::Instant;

/// Seconds since a command began, as the system's clock or a test states.
#[derive(Clone)]
pub struct Stopwatch(Arc<dyn Fn() -> f64 + Send + Sync>);

impl Stopwatch {
    /// Seconds since now.
    pub fn start() -> Self {
        let start = Instant::now();
        Self::of(move || start.elapsed().as_secs_f64())
    }

    /// Time returned by a function; it never decreases.
    pub fn of(seconds: impl Fn() -> f64 + Send + Sync + 'static) -> Self {
        Self(Arc::new(seconds))
    }

    /// Elapsed seconds.
    pub fn seconds(&self) -> f64 {
        (self.0)()
    }
}

impl Default for Stopwatch {
    fn default() -> Self {
        Self::start()
    }
}

impl fmt::Debug for Stopwatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Stopwatch({} s)", self.seconds())
    }
}
